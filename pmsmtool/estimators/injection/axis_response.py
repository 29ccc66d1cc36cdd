# SPDX-License-Identifier: MIT
"""One square-wave shot on one axis and its simulation: what the machine, inverter and sensor make of the voltage."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.estimators.injection.output_error import AxisModel, Pulses, bend, eddy_current, recursion, respond
from pmsmtool.refusals import refuse

SKIP_SAMPLES = 10
"""First samples that are simulated but not compared: the voltage before the record and the sensor's start."""
SLOW_FRACTION = 4.0
"""Injection frequency over the highest frequency that is projected out."""
PASSES = 2
"""Passes of the small non-linear terms; each shrinks what is left by R T/L, the bend or K (h T_s)^2/L."""
SMALLEST_SHARE = 1e-4
"""Shortest pulse (T_s): a command of zero has a height, too."""
EDGE_SHARE = 0.75
"""Weight of the nearer sample at the edge where a leg's error depends on its current: a quarter of a period away."""


@dataclass(frozen=True, slots=True)
class VoltageError:
    """Inverter error along the axis about the bias, in two parts that act at different edges of the pulses.

    A leg that feeds current out loses its dead time at the rising edge whatever the current is; what depends on the
    current, the slow commutation of a small one, happens at the falling edge, three quarters of a period after the
    sample. A leg that takes current in loses it at the rising edge, after one quarter. A slope of the error therefore
    looks like an inductance of +-slope T_s/4.
    """

    i_a: Array
    """Currents along the axis, increasing (A). Shape (n,)."""
    early_v: Array
    late_v: Array
    """Errors of the legs that take current in, and of those that feed it out (V). Shape (n,)."""

    def lost_v(self, i_a: NDArray[np.float64]) -> NDArray[np.float64]:
        """Mean error in each interval between samples of currents (V), shape (..., n - 1)."""
        both = np.interp(i_a, self.i_a, self.early_v + 1j * self.late_v)  # one search for the two
        early, late = both.real, both.imag
        before = EDGE_SHARE * early + (1.0 - EDGE_SHARE) * late
        after = (1.0 - EDGE_SHARE) * early + EDGE_SHARE * late
        return np.asarray(before[..., :-1] + after[..., 1:], dtype=np.float64)


LINE_GAIN = 60.0
"""Power of a sine, over that of one sample of a residual, from which on it is taken out (white noise: at most 24).

4 % of ripple on a DC link is 1600 of 2000. 870 beside a chi-square of 1.8 passed for eddy currents: L_d 13 % off.
"""
LINE_APART, LINE_FINER = 1.5, 16
"""Distance from the injection's harmonics, in the record's own resolution, and steps of the search in one of those."""


@dataclass(frozen=True, slots=True)
class Shot:
    """One record of a square wave on one axis, frozen frame."""

    u_v: Array
    i_a: Array
    """Voltage computed and current sampled at each instant. Shape (n,)."""
    cross_a: Array
    """Current of the other axis. Shape (n,)."""
    half_period: int
    """Samples between sign changes."""
    period_s: float
    """Control period (s)."""
    error: VoltageError | None = None
    """Inverter error from the DC levels."""
    pulse_v: float = math.inf
    """Voltage of the bridge's pulses along the axis (V); infinite: the mean voltage is taken for all of the period."""
    lines_hz: tuple[float, ...] = ()
    """Frequencies that are not the injection's and count as slow: ripple of the DC link."""

    @property
    def pulses(self) -> Pulses | None:
        """The commands as the bridge applies them, None where its pulses are not known."""
        if math.isinf(self.pulse_v):
            return None
        share = np.clip(np.abs(self.u_v) / self.pulse_v, SMALLEST_SHARE, 1.0)
        return Pulses(share, self.u_v / share, -float(np.mean(self.u_v)))

    def slow_basis(self) -> NDArray[np.float64]:
        """Orthonormal cosines slower than the injection, and its lines, shape (n - SKIP_SAMPLES, j)."""
        n = len(self.i_a) - SKIP_SAMPLES
        count = max(1, round(n / (self.half_period * SLOW_FRACTION)))
        k = np.arange(n) + 0.5
        basis = np.cos(np.pi * np.outer(k, np.arange(count)) / n)
        basis /= np.sqrt(np.sum(basis**2, axis=0))
        if self.lines_hz:
            turns = 2.0 * np.pi * np.outer(k * self.period_s, self.lines_hz)
            basis = np.linalg.qr(np.column_stack([basis, np.cos(turns), np.sin(turns)]))[0]
        return np.asarray(basis)


@dataclass(frozen=True, slots=True)
class Response:
    """Everything one shot is simulated with."""

    model: AxisModel
    start_a: float
    c_2: float
    c_3: float
    motion: float


def simulate(responses: Sequence[Response], shot: Shot, slow: NDArray[np.float64]) -> NDArray[np.float64]:
    """Modelled currents of a shot at the compared samples, without their means (A), shape (m, n - SKIP_SAMPLES).

    One row per response; they may differ in everything but the whole part of their delays. Together they cost less than
    one by one: what projects the slow part out is one product of matrices.
    """
    T_s = shot.period_s
    count = len(shot.i_a) - SKIP_SAMPLES
    command, pulses = shot.u_v - np.mean(shot.u_v), shot.pulses
    starts = np.array([response.start_a for response in responses])
    linear = respond([response.model for response in responses], command, T_s, starts, pulses)
    if any(response.model.eddy_s for response in responses):
        linear = linear + np.stack([eddy_current(response.model, command, T_s) for response in responses])
    centre_a = float(np.mean(shot.i_a))
    c_2, c_3, motion, R = (
        np.array(values)[:, None]
        for values in zip(*((r.c_2, r.c_3, r.motion, r.model.R_ohm) for r in responses), strict=True)
    )
    curved, moves = bool(np.any(c_2) or np.any(c_3)), bool(np.any(motion))
    if not curved and not moves and shot.error is None:
        return linear[:, -count - 1 : -1]
    poles, gains = np.array([response.model.advance(T_s)[:2] for response in responses]).T[..., np.newaxis]
    # the slow part of the modelled current stands for nothing: the starting current alone decides it
    y = linear
    fast = fast_part(y, slow)
    for remaining in reversed(range(PASSES)):
        bent = bend(fast, c_2, c_3) if curved else np.zeros_like(y)
        fast_i = fast_part(y + bent, slow) if curved else fast
        lost = R * bent  # the bent part of the current drops R i too
        if moves:
            lost = lost + motion * _fast_charge(fast_i, slow, T_s)
        middle = 0.5 * (lost[:, 1:] + lost[:, :-1])
        if shot.error is not None:
            middle = middle + shot.error.lost_v(fast_i + centre_a)
        middle -= np.mean(middle, axis=1, keepdims=True)
        y = linear + recursion(poles, -gains * middle, 0.0)
        if curved or remaining:
            fast = fast_part(y, slow)
    i = y + bend(fast, c_2, c_3) if curved else y
    # sample n - 1 of the record is the last but one of the response
    return i[:, -count - 1 : -1]


def projected(rows: NDArray[np.float64], slow: NDArray[np.float64]) -> NDArray[np.float64]:
    """What is left of rows of compared samples without their slow part."""
    return np.asarray(rows - (rows @ slow) @ slow.T, dtype=np.float64)


def fast_part(i: NDArray[np.float64], slow: NDArray[np.float64]) -> NDArray[np.float64]:
    """What is faster than the slow cosines of the compared samples; before them only the mean is taken off (A)."""
    rows = slow.shape[0]
    fast = i - np.mean(i[..., -rows:], axis=-1, keepdims=True)
    fast[..., -rows:] = projected(fast[..., -rows:], slow)
    return np.asarray(fast, dtype=np.float64)


def _fast_charge(fast: NDArray[np.float64], slow: NDArray[np.float64], T_s: float) -> NDArray[np.float64]:
    """Fast part of the integral of a fast current (A s)."""
    rows = slow.shape[0]
    charge = np.zeros_like(fast)
    np.cumsum(0.5 * T_s * (fast[:, 1:] + fast[:, :-1]), axis=1, out=charge[:, 1:])
    charge[:, -rows:] = projected(charge[:, -rows:], slow)
    return charge


def with_line(shot: Shot, residual: Array) -> Shot:
    """Return the shot with the frequency of the largest sine in a fit's residual; the same where none stands out.

    The ripple of a DC link is a voltage that the drive does not know. What lies on the injection's harmonics stays.
    """
    n = len(residual)
    power = np.abs(np.fft.rfft(residual, LINE_FINER * n)) ** 2
    hz = np.arange(len(power)) / (LINE_FINER * n * shot.period_s)
    injected = 0.5 / (shot.half_period * shot.period_s)
    power[np.abs(hz - injected * np.round(hz / injected)) < LINE_APART / (n * shot.period_s)] = 0.0
    at = int(np.argmax(power))
    if 2.0 * power[at] < LINE_GAIN * float(residual @ residual):
        return shot
    return replace(shot, lines_hz=(*shot.lines_hz, float(hz[at])))


def initial_inductance(shot: Shot) -> float:
    """Inductance from the ripple: voltage times the half period over the swing (H); a starting value only."""
    u = shot.u_v - np.mean(shot.u_v)
    window = 2 * shot.half_period
    i = shot.i_a
    swings = [np.ptp(i[k : k + window]) for k in range(SKIP_SAMPLES, len(i) - window, window)]
    swing = float(np.median(swings)) if swings else 0.0
    if not swing > 0.0:
        raise refuse("E_EXCITATION", "the current does not follow the square wave at all", stage="inductance")
    return float(np.mean(np.abs(u))) * shot.half_period * shot.period_s / swing


def arx_guess(shot: Shot, delay: int) -> tuple[float, float, float]:
    """Least squares of i[k+1] on (i[k], v[k - delay], 1): L (H), R (ohm) and residual power; a starting value only.

    Noise on i attenuates it (1.1 to 8 times the bound, -1.8 % bias): never a result.
    """
    rough = initial_inductance(shot)  # refuses a current that does not follow: rounding would fit it
    i, v = shot.i_a[SKIP_SAMPLES:], shot.u_v[SKIP_SAMPLES - delay : len(shot.u_v) - delay]
    columns = np.stack([i[:-1], v[:-1], np.ones(len(i) - 1)], axis=1)
    x, *_ = np.linalg.lstsq(columns, i[1:], rcond=None)
    residual = i[1:] - columns @ x
    a, b = float(x[0]), float(x[1])
    power = float(residual @ residual)
    if not 0.0 < a < 1.0 or not b > 0.0:
        return rough, 0.0, power
    R = (1.0 - a) / b
    return -R * shot.period_s / math.log(a), R, power
