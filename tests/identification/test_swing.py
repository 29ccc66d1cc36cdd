# SPDX-License-Identifier: MIT
"""The frequency at which torque pulses swing a shaft, beside a resonance that a small torque shows."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from pmsmtool.identification.swing import FREQUENCIES, swing_of
from pmsmtool.trace import Trace

ROWS, T_S = 122, 3e-4
STEP = 2.0 * math.pi / 2**14
FREQUENCY_LIMIT = 0.1
"""Distance of two frequencies that are tried, of 60 from 55 to 667 Hz: 0.043."""


def push(swing_hz: float, ratio: float, sign: float = 1.0) -> Trace:
    """A pulse of 1600 rad/s2 on two masses that swing, damped by 3 %; ratio 0: a rigid shaft."""
    t = T_S * np.arange(ROWS, dtype=np.float64)
    w = 2.0 * math.pi * swing_hz
    theta = 1600.0 * (0.5 * t**2 + ratio / w**2 * (1.0 - np.exp(-0.03 * w * t) * np.cos(w * t)))
    signals = {"i_d_a": 0.0 * t, "i_q_a": 0.0 * t + sign, "theta_M_rad": STEP * np.floor(sign * theta / STEP)}
    return Trace(t, signals, dict.fromkeys(signals, "1"))


def torque(i_d: NDArray[np.float64], i_q: NDArray[np.float64]) -> NDArray[np.float64]:
    return 0.15 * i_q


def pushes(swing_hz: float, ratio: float) -> list[Trace]:
    return [push(swing_hz, ratio, sign) for sign in (1.0, -1.0)]


def test_pushes_of_two_masses_swing_at_their_resonance() -> None:
    assert FREQUENCIES == 60
    assert swing_of(pushes(150.0, 3.0), torque) == pytest.approx(150.0, rel=FREQUENCY_LIMIT)
    assert swing_of(pushes(150.0, 3.0), torque, 31.0, 2.0) == pytest.approx(150.0, rel=FREQUENCY_LIMIT)


def test_a_resonance_that_explains_the_pushes_stands_and_a_rigid_shaft_swings_at_none() -> None:
    assert swing_of(pushes(150.0, 3.0), torque, 149.0, 3.0) == 0.0
    assert swing_of(pushes(150.0, 3.0), torque, 140.0, 1.0) == 0.0, "an elastic shaft whose resonance is a little off"
    assert swing_of(pushes(150.0, 0.0), torque) == 0.0
    assert swing_of(pushes(150.0, 3.0), torque, 400.0, 3.0) == 0.0, "nothing above it that the rows show"


def added(first: list[Trace], second: list[Trace], share: float) -> list[Trace]:
    """Pushes whose positions are the first's, and a share of what the second's swing adds to a rigid shaft."""
    rigid = pushes(150.0, 0.0)
    moved = [
        a["theta_M_rad"] + share * (b["theta_M_rad"] - r["theta_M_rad"])
        for a, b, r in zip(first, second, rigid, strict=True)
    ]
    return [
        Trace(a.t_s, {**a.signals, "theta_M_rad": theta}, dict.fromkeys(a.signals, "1"))
        for a, theta in zip(first, moved, strict=True)
    ]


def test_a_swing_that_is_not_clear_says_nothing() -> None:
    assert swing_of(pushes(150.0, 3.0), torque, 100.0, 1.0) == 0.0, "less than twice as fast"
    noise = np.random.default_rng(2)
    loud = [
        Trace(p.t_s, {**p.signals, "theta_M_rad": p["theta_M_rad"] + 0.01 * noise.standard_normal(ROWS)},
              dict.fromkeys(p.signals, "1"))
        for p in pushes(150.0, 0.0)
    ]  # fmt: skip
    assert swing_of(loud, torque) == 0.0, "no frequency explains half of it"


def test_a_resonance_stands_where_it_explains_half_as_much_as_a_faster_swing() -> None:
    both = added(pushes(150.0, 3.0), pushes(70.0, 3.0), 0.15)  # they explain 0.57 and 0.40
    assert swing_of(both, torque) == pytest.approx(150.0, rel=FREQUENCY_LIMIT)
    assert swing_of(both, torque, 70.0, 1.0) == 0.0
    assert swing_of(pushes(150.0, 3.0), torque, 70.0, 1.0) == pytest.approx(150.0, rel=FREQUENCY_LIMIT)


def test_a_load_that_bounces_in_its_play_swings_at_no_one_frequency() -> None:
    """From 60 to 250 Hz within the push: one swing explains 0.32 of it, 18 Hz 0.03."""
    bouncing = []
    for p in pushes(150.0, 0.0):
        bounce = 4e-3 * np.sin(2.0 * math.pi * (60.0 + 2600.0 * p.t_s) * p.t_s)
        bouncing.append(Trace(p.t_s, {**p.signals, "theta_M_rad": p["theta_M_rad"] + bounce}, dict(p.units)))
    assert 60.0 < swing_of(bouncing, torque, 18.0, 1.0) < 250.0
    assert swing_of(bouncing, torque) == 0.0, "no resonance is known that it contradicts"


def test_what_is_slowest_of_all_that_a_push_shows_is_friction_and_no_swing() -> None:
    """Two turns of 55 Hz are in the push: 40 Hz look like them."""
    assert swing_of(pushes(40.0, 3.0), torque) == 0.0
    assert swing_of(pushes(65.0, 3.0), torque) == pytest.approx(65.0, rel=FREQUENCY_LIMIT)
