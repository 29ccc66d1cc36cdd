# SPDX-License-Identifier: MIT
"""Loop margins of many machines at once: the loops of ``current_loop`` and ``speed_loop``, evaluated as arrays.

Crossings are bracketed on a grid of frequencies and refined on the loop itself (Illinois), so they are as exact as the
polynomial roots of ``sampled_loop`` unless two crossings lie between neighbouring grid points; a current loop has no
resonance that could do that.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pmsmtool.arrays import Array, Complex
from pmsmtool.design.loops.current_loop import HOLD_PERIODS, CurrentGains
from pmsmtool.design.loops.sampled_loop import SampledLoop

Response = Callable[[Array], Complex]
"""Loop of n machines at frequencies (rad/s) of shape (m,) or (n, m); returns shape (n, m)."""

GRID_POINTS = 40
"""Frequencies of the grid, logarithmic up to Nyquist."""

GRID_START = 0.05
"""Where the grid starts, over the crossover that was designed for."""

REFINEMENTS = 14
"""Bracketed secant steps; the last change is below 1e-12 of the frequency (measured)."""


@dataclass(frozen=True, slots=True, eq=False)
class VectorMargins:
    """Margins of n loops, each shape (n,): degree, dB, s; an unstable loop has a negative phase or gain margin."""

    phase_deg: Array
    gain_db: Array
    delay_s: Array


def vector_margins(loop: Response, T_s: float, crossover: float) -> VectorMargins:
    """Return the margins of loops that are stable when cut; ``crossover`` (rad/s) is about where they cross.

    The phase margin is that of the gain crossing nearest to -1: of a resonance, L may turn back on the positive side.
    The gain margin is that at the lowest phase crossing above the first gain crossing or, when the loop already
    encircles -1, below 0 dB; both are negative then.
    """
    nyquist = math.pi / T_s
    grid = np.geomspace(min(GRID_START * crossover, 0.1 * nyquist), nyquist, GRID_POINTS)
    values = loop(grid)
    size = np.log(np.abs(values))
    phase, omega = _phase_margins(loop, grid, size)
    worst = np.argmin(np.where(np.isnan(phase), np.inf, np.abs(phase)), axis=1)
    rows = np.arange(len(values))
    least, at = phase[rows, worst], omega[rows, worst]
    gain = _gain_margins(loop, grid, values)
    least = np.where(gain < 0.0, -np.abs(least), least)
    with np.errstate(invalid="ignore"):
        delay = np.where(least > 0.0, least / at, 0.0)
    return VectorMargins(np.degrees(np.where(np.isnan(least), np.inf, least)), gain, delay)


_CROSSINGS = 3
"""Gain crossings looked at per loop."""


def _phase_margins(loop: Response, grid: Array, size: Array) -> tuple[Array, Array]:
    """Phase margin (rad) and frequency (rad/s) of up to ``_CROSSINGS`` gain crossings, NaN where there are fewer."""
    crossed = np.signbit(size[:, :-1]) != np.signbit(size[:, 1:])
    n = len(size)
    phase, omega = np.full((n, _CROSSINGS), np.nan), np.full((n, _CROSSINGS), np.nan)
    left = crossed.copy()
    for k in range(_CROSSINGS):
        some = left.any(axis=1)
        if not some.any():
            break
        first = np.argmax(left, axis=1)
        left[np.arange(n), first] = False
        low, high = grid[first], grid[first + 1]
        found = _refine(lambda w: np.log(np.abs(loop(w[:, None])[:, 0])), low, high)
        # angle of -L in (-pi, pi]: the smaller turn that reaches -1
        margin = np.angle(-loop(found[:, None])[:, 0])
        phase[some, k], omega[some, k] = margin[some], found[some]
    return phase, omega


def _gain_margins(loop: Response, grid: Array, values: Complex) -> Array:
    """Gain margin (dB): the lowest phase crossing with Re L < 0; Nyquist counts as one."""
    turns = np.signbit(values.imag[:, :-1]) != np.signbit(values.imag[:, 1:])
    negative = (values.real[:, :-1] < 0.0) & (values.real[:, 1:] < 0.0)
    crossed = turns & negative
    some = crossed.any(axis=1)
    first = np.argmax(crossed, axis=1)
    found = _refine(lambda w: loop(w[:, None])[:, 0].imag, grid[first], grid[first + 1])
    at = np.abs(loop(found[:, None])[:, 0])
    last = values[:, -1].real
    with np.errstate(divide="ignore"):
        end = -20.0 * np.log10(-np.minimum(last, 0.0))
        return np.asarray(np.where(some, np.minimum(-20.0 * np.log10(at), end), end), dtype=np.float64)


def _refine(function: Callable[[Array], Array], low: Array, high: Array) -> Array:
    """Zero between two frequencies for every machine (Illinois); machines without a sign change give nonsense."""
    low, high = low.copy(), high.copy()
    f_low, f_high = function(low), function(high)
    middle = high
    for _ in range(REFINEMENTS):
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.where(f_low == f_high, 0.5, f_low / (f_low - f_high))
        middle = low + np.clip(np.nan_to_num(share, nan=0.5), 0.0, 1.0) * (high - low)
        f = function(middle)
        turned = np.signbit(f) != np.signbit(f_high)
        low, f_low = np.where(turned, high, low), np.where(turned, f_high, 0.5 * f_low)
        high, f_high = middle, f
    return middle


def current_response(
    gains: CurrentGains,
    R: Array,
    L: Array,
    T_s: float,
    delay_periods: float,
    model: tuple[float, float] | None = None,
) -> Response:
    """Return the loop of ``current_loop.axis_loop`` for plants R (ohm), L (H) of shape (n, 1).

    ``model`` = (R, L) of the one-step predictor, None without.
    """
    extra = delay_periods - HOLD_PERIODS
    whole = math.floor(extra + 1e-12)
    fraction = max(0.0, extra - whole)
    x = R * T_s / L
    decay = np.exp(-x)
    early = -np.expm1(-(1.0 - fraction) * x) / R
    late = np.exp(-(1.0 - fraction) * x) * -np.expm1(-fraction * x) / R
    K_p, K_i_T = gains.K_p, gains.K_i * T_s

    def loop(omega: Array) -> Complex:
        z = np.exp(1j * np.asarray(omega) * T_s)
        plant = (early + late / z) / (z - decay) * z**-whole
        if model is None:
            return np.asarray((K_p + K_i_T / (z - 1.0)) * plant)
        drop = 0.5 * T_s * model[0]
        a, b = (model[1] - drop) / (model[1] + drop), T_s / (model[1] + drop)
        return np.asarray((K_p * a + K_i_T / (z - 1.0)) / (1.0 + K_p * b / z) * plant)

    return loop


def speed_response(nominal: SampledLoop, gain: Array, closed: Response, closed_nominal: Response) -> Response:
    """Return the speed loops of machines from the nominal one.

    Parameters
    ----------
    nominal : SampledLoop
        Speed loop of the nominal machine (lifted, exact).
    gain : ndarray, shape (n, 1)
        Torque per demanded torque over inertia, relative to nominal.
    closed, closed_nominal : Response
        Current loops whose closed forms L/(1 + L) replace each other; far below the sampling rate of the speed
        controller that is exact, at its crossover it is within 0.1 degree (measured).
    """

    def loop(omega: Array) -> Complex:
        ours, theirs = closed(omega), closed_nominal(omega)
        ratio = (ours / (1.0 + ours)) / (theirs / (1.0 + theirs))
        return np.asarray(gain * ratio * nominal.at(omega))

    return loop
