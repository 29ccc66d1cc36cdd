"""One square-wave shot on one axis and its simulation: what the machine, inverter and sensor make of the voltage."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pmsmtool.estimators.output_error import AxisModel, bend, recursion, respond
from pmsmtool.estimators.refusals import refuse

Vector = NDArray[np.float64]

SKIP_SAMPLES = 10
"""First samples that are simulated but not compared: the voltage before the record and the sensor's start."""
SLOW_FRACTION = 4.0
"""Injection frequency over the highest frequency that is projected out."""
PASSES = 2
"""Passes of the small non-linear terms; each shrinks what is left by R T/L, the bend or K (h T_s)^2/L."""
EDGE_SHARE = 0.75
"""Weight of the nearer sample at the edge where a leg's error depends on its current: a quarter of a period away."""


@dataclass(frozen=True, slots=True)
class VoltageError:
    """Inverter error along the axis about the bias, in two parts that act at different edges of the pulses.

    A leg that feeds current out loses its dead time at the rising edge whatever the current is; what depends on the
    current, the slow commutation of a small one, happens at the falling edge, three quarters of a period after the
    sample. A leg that takes current in loses it at the rising edge, after one quarter. A slope of the error therefore
    looks like an inductance of +-slope T_s/4.

    Attributes
    ----------
    i_a : ndarray, shape (n,)
        Currents along the axis, increasing (A).
    early_v, late_v : ndarray, shape (n,)
        Errors of the legs that take current in, and of those that feed it out (V).
    """

    i_a: Vector
    early_v: Vector
    late_v: Vector

    def lost_v(self, i_a: Vector) -> Vector:
        """Mean error in each interval between samples of the current (V), shape (n - 1,)."""
        early, late = np.interp(i_a, self.i_a, self.early_v), np.interp(i_a, self.i_a, self.late_v)
        before = EDGE_SHARE * early + (1.0 - EDGE_SHARE) * late
        after = (1.0 - EDGE_SHARE) * early + EDGE_SHARE * late
        return np.asarray(before[:-1] + after[1:], dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Shot:
    """One record of a square wave on one axis, frozen frame.

    Attributes
    ----------
    u_v, i_a : ndarray, shape (n,)
        Voltage computed and current sampled at each instant.
    cross_a : ndarray, shape (n,)
        Current of the other axis.
    half_period : int
        Samples between sign changes.
    period_s : float
        Control period (s).
    error : VoltageError or None
        Inverter error from the DC levels.
    """

    u_v: Vector
    i_a: Vector
    cross_a: Vector
    half_period: int
    period_s: float
    error: VoltageError | None = None

    def slow_basis(self) -> NDArray[np.float64]:
        """Orthonormal cosines slower than the injection, shape (n - SKIP_SAMPLES, j)."""
        n = len(self.i_a) - SKIP_SAMPLES
        count = max(1, round(n / (self.half_period * SLOW_FRACTION)))
        k = np.arange(n) + 0.5
        basis = np.cos(np.pi * np.outer(k, np.arange(count)) / n)
        return np.asarray(basis / np.sqrt(np.sum(basis**2, axis=0)))


@dataclass(frozen=True, slots=True)
class Response:
    """Everything one shot is simulated with."""

    model: AxisModel
    start_a: float
    c_2: float
    c_3: float
    motion: float


def simulate(response: Response, shot: Shot, slow: NDArray[np.float64]) -> Vector:
    """Modelled current of a shot at the compared samples, without its mean (A), shape (n - SKIP_SAMPLES,)."""
    model, T_s = response.model, shot.period_s
    count = len(shot.i_a) - SKIP_SAMPLES
    linear = respond(model, shot.u_v - np.mean(shot.u_v), T_s, response.start_a)
    centre_a = float(np.mean(shot.i_a))
    curved = response.c_2 != 0.0 or response.c_3 != 0.0
    if not curved and response.motion == 0.0 and shot.error is None:
        return linear[-count - 1 : -1]
    rate = model.R_ohm * T_s / model.L_h
    pole = math.exp(-rate)
    gain = T_s / model.L_h * (-math.expm1(-rate) / rate if abs(rate) > 1e-9 else 1.0)
    # the slow part of the modelled current stands for nothing: the starting current alone decides it
    i = y = linear
    for _ in range(PASSES):
        bent = bend(fast_part(y, slow), response.c_2, response.c_3)
        i = y + bent
        lost = model.R_ohm * bent  # the bent part of the current drops R i too
        if response.motion != 0.0:
            lost = lost + response.motion * _fast_charge(i, slow, T_s)
        middle = 0.5 * (lost[1:] + lost[:-1])
        if shot.error is not None:
            middle = middle + shot.error.lost_v(fast_part(i, slow) + centre_a)
        y = linear + recursion(pole, -gain * (middle - np.mean(middle)), 0.0)
    i = y + bend(fast_part(y, slow), response.c_2, response.c_3)
    # sample n - 1 of the record is the last but one of the response
    return i[-count - 1 : -1]


def fast_part(i: Vector, slow: NDArray[np.float64]) -> Vector:
    """What is faster than the slow cosines of the compared samples; before them only the mean is taken off (A)."""
    rows = slow.shape[0]
    fast = i - np.mean(i[-rows:])
    fast[-rows:] -= slow @ (slow.T @ fast[-rows:])
    return np.asarray(fast, dtype=np.float64)


def _fast_charge(i: Vector, slow: NDArray[np.float64], T_s: float) -> Vector:
    """Integral of the fast part of a current (A s)."""
    rows = slow.shape[0]
    fast = fast_part(i, slow)
    charge = np.concatenate([[0.0], np.cumsum(0.5 * (fast[1:] + fast[:-1]))]) * T_s
    charge[-rows:] -= slow @ (slow.T @ charge[-rows:])
    return charge


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
    i, v = shot.i_a[SKIP_SAMPLES:], shot.u_v[SKIP_SAMPLES - delay : len(shot.u_v) - delay]
    columns = np.stack([i[:-1], v[:-1], np.ones(len(i) - 1)], axis=1)
    x, *_ = np.linalg.lstsq(columns, i[1:], rcond=None)
    residual = i[1:] - columns @ x
    a, b = float(x[0]), float(x[1])
    power = float(residual @ residual)
    if not 0.0 < a < 1.0 or not b > 0.0:
        return initial_inductance(shot), 0.0, power
    R = (1.0 - a) / b
    return -R * shot.period_s / math.log(a), R, power
