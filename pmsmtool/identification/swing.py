# SPDX-License-Identifier: MIT
"""At which frequency a shaft swings behind a torque pulse, beside what a rigid shaft under friction would do.

The position of a push is fitted by a rigid shaft (place, speed, friction, integral of the torque), and by a damped
swing beside it. A linear shaft swings at one frequency whatever the torque; one with play swings slower the
smaller the torque is, for more of its way is in the play (Nordin and Gutman, Automatica 38, 2002,
DOI 10.1016/S0005-1098(02)00047-X).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.estimators.shaft.mechanics import Torque
from pmsmtool.trace import Trace

ZETAS = (0.01, 0.05, 0.2)
FREQUENCIES = 60
SPEED_SPANS = 50
"""Spans of a push that have one speed each, for the sign of the friction."""
FASTEST = 0.2
"""Largest frequency, of the rate of rows."""
LEAST_TURNS = 2.0
"""Swings within a push, below which friction and speed look like one."""
ABOVE, NEAR = 2.0, 1.2
"""Frequency of a large torque, of that of a small one, from which on it is another; NEAR where that shows nothing."""
CLEAR = 0.5
"""Share of what a rigid shaft leaves that one swing must explain before it says anything, and share of that which the
frequency of the small torque must explain (a gear with 1.1 degrees of play: 0.75 at 140 Hz, 0.21 at its 31 Hz)."""
FAINT, BOUNCING = 0.1, 0.2
"""What is next to nothing, and what the other must then explain (0.006 and 0.24): a bounce does not decay so."""


def swing_of(pushes: Sequence[Trace], torque: Torque, resonance_hz: float = 0.0, doubt_hz: float = 0.0) -> float:
    """Return the frequency (Hz) at which pushes clearly swing, above a resonance that less torque shows; else 0.

    Parameters
    ----------
    pushes : sequence of Trace
        ``i_d_a i_q_a theta_M_rad`` while the torque acts.
    torque : callable
        Torque (N m) of arrays of i_d, i_q (A).
    resonance_hz, doubt_hz : float
        The resonance, and how far it may be off (Hz); 0: none.
    """
    explained = _explained(pushes, torque)
    longest = max(float(push.t_s[-1] - push.t_s[0]) for push in pushes)
    highest = FASTEST / max(push.period_s for push in pushes)
    first = max(LEAST_TURNS / longest, NEAR * resonance_hz)
    if first >= highest:
        return 0.0
    tried = [float(hz) for hz in np.geomspace(first, highest, FREQUENCIES)]
    most, best_hz = max((explained(hz), hz) for hz in tried)
    near = np.linspace(resonance_hz - doubt_hz, resonance_hz + doubt_hz, 5) if resonance_hz > 0.0 else ()
    claimed = max((explained(float(hz)) for hz in near), default=0.0)
    clear = most >= CLEAR and claimed < CLEAR * most and best_hz >= ABOVE * resonance_hz
    bounces = resonance_hz > 0.0 and most >= BOUNCING and claimed < FAINT * most
    return best_hz if best_hz > tried[0] and (clear or bounces) else 0.0  # the slowest: friction, no swing


def _explained(pushes: Sequence[Trace], torque: Torque) -> Callable[[float], float]:
    """Return the share of what a rigid shaft leaves of all pushes that a swing explains, of its frequency (Hz)."""
    parts = []
    for push in pushes:
        t = push.t_s - push.t_s[0]
        theta, amperes = push["theta_M_rad"], (push["i_d_a"], push["i_q_a"])
        k, half = np.arange(len(theta)), 1 + len(theta) // (2 * SPEED_SPANS)
        turning = np.sign(theta[np.minimum(k + half, k[-1])] - theta[np.maximum(k - half, 0)])
        ways = (np.cumsum(np.cumsum(drive)) for drive in (torque(*amperes), turning))
        rigid = np.stack([np.ones_like(t), t, *ways, np.cumsum(theta - theta[0])], axis=1)
        Q, _ = np.linalg.qr(rigid / np.max(np.abs(rigid), axis=0))
        parts.append((t, Q, theta - Q @ (Q.T @ theta)))
    left = sum(float(rest @ rest) for _, _, rest in parts)

    def explained(hz: float) -> float:
        return max(sum(_power(t, Q, rest, 2.0 * math.pi * hz, zeta) for t, Q, rest in parts) / left for zeta in ZETAS)

    return explained


def _power(t: Array, Q: Array, rest: Array, omega: float, zeta: float) -> float:
    """Square sum of a rest that a damped swing explains."""
    swing = np.exp(-zeta * omega * t)[:, None] * np.stack([np.cos(omega * t), np.sin(omega * t)], axis=1)
    P, _ = np.linalg.qr(swing - Q @ (Q.T @ swing))
    return float(np.sum((P.T @ rest) ** 2))
