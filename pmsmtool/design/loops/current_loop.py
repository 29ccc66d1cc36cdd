# SPDX-License-Identifier: MIT
"""Current controllers per axis: PI gains from a bandwidth, and what the sampled loop makes of them.

The axis plant is 1 / (L s + R) behind a zero-order hold, discretised exactly, with the computation delay of the
drive; the controller is the one in ``firmware/core``: u = K_p e + x, then x += K_i T_s e, so
C(z) = K_p + K_i T_s / (z - 1). With decoupling and the voltage rotated ahead by ``delay_periods`` w T_s both axes
are this loop at every speed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.design.loops.sampled_loop import SampledLoop, margins
from pmsmtool.errors import DesignInfeasible

HOLD_PERIODS = 0.5
"""Mean delay of the zero-order hold itself, in periods."""

MANY_PERIODS = 100.0
"""Delay in periods beyond which phase margin over crossover is exact enough: at most 1.4e-4 off in ten loops of 94 to
377 periods. Poles of so many periods took a minute in a loop of 6 Hz."""
_DELAY_STEP = 1.125
"""Factor by which the delay grows in search of instability. A loop with predictor may be stable again beyond its first
limit (to 2.19 periods, and again from 2.81 to 2.95): no larger step than these islands are wide."""

_DELAY_RESOLUTION = 1e-10
"""Relative resolution of the largest delay."""


class Method(StrEnum):
    """Rule that turns a bandwidth into gains."""

    IMC = "imc"
    """Pole-zero cancellation = internal model control (Harnefors, Nee 1998, DOI 10.1109/28.658735)."""
    MODULUS_OPTIMUM = "modulus-optimum"
    """IMC at the bandwidth 1 / (2 T_sigma), T_sigma = sum of the small time constants."""
    SECOND_ORDER = "second-order"
    """Placement of s^2 + 2 zeta w_n s + w_n^2."""


@dataclass(frozen=True, slots=True)
class CurrentGains:
    """Gains of one axis."""

    K_p: float
    """Proportional gain (V/A)."""
    K_i: float
    """Integral gain (V/(A s))."""


@dataclass(frozen=True, slots=True)
class AxisPlant:
    """One axis as the current loop sees it."""

    R: float
    L: float
    """Loop resistance (ohm) and incremental inductance (H)."""
    T_s: float
    """Control period (s)."""
    delay_periods: float
    """Delay from a sample to the mean of the voltage it causes, in periods: 0.5 (hold only) or more."""


def modulus_optimum_bandwidth(T_s: float, delay_periods: float) -> float:
    """Return 1 / (2 T_sigma) (rad/s) with T_sigma = ``delay_periods`` T_s; 1 / (3 T_s) for the usual 1.5."""
    return 1.0 / (2.0 * delay_periods * T_s)


def imc(R: float, L: float, alpha: float) -> CurrentGains:
    """Cancel the plant's pole: K_p = alpha L, K_i = alpha R, closed loop alpha / (s + alpha)."""
    return CurrentGains(alpha * L, alpha * R)


def second_order(R: float, L: float, omega_n: float, zeta: float) -> CurrentGains:
    """Place s^2 + 2 zeta w_n s + w_n^2: K_p = 2 zeta w_n L - R, K_i = w_n^2 L.

    Raises DesignInfeasible: when K_p would not be positive: the plant alone is already faster than that.
    """
    K_p = 2.0 * zeta * omega_n * L - R
    if K_p <= 0.0:
        raise DesignInfeasible(
            f"placing w_n = {omega_n:.4g} rad/s, zeta = {zeta:.3g} needs K_p = {K_p:.4g} V/A",
            likely=f"the plant's own pole R/L = {R / L:.4g} rad/s is faster than 2 zeta w_n",
            hint=f"ask for w_n above {R / (2.0 * zeta * L):.4g} rad/s",
        )
    return CurrentGains(K_p, omega_n**2 * L)


def axis_loop(gains: CurrentGains, plant: AxisPlant, model: AxisPlant | None = None) -> SampledLoop:
    """Return the loop of one axis, broken at the voltage.

    Parameters
    ----------
    gains : CurrentGains
        Gains of the controller.
    plant : AxisPlant
        The axis; any delay from 0.5 periods on, also fractions (exact by the modified z-transform).
    model : AxisPlant, optional
        What the one-step predictor believes; None for a controller without predictor.

    Returns
    -------
    SampledLoop
        L(z) = C(z) P(z).
    """
    if plant.delay_periods < HOLD_PERIODS:
        raise DesignInfeasible(
            f"a delay of {plant.delay_periods:g} periods is shorter than the hold itself",
            where="inverter.delay_periods",
            hint="0.5 without computation delay, 1.5 when the voltage acts one period later",
        )
    K_p, K_i_T = gains.K_p, gains.K_i * plant.T_s
    plant_num, plant_den = _hold_and_delay(plant)
    if model is None:
        control_num, control_den = np.array([K_p, K_i_T - K_p]), np.array([1.0, -1.0])
    else:
        # u = K_p (v - i^) + x with i^ = a i + b u(k-1), the drop at the mean current as in the core; the
        # integrator keeps the measured error.
        drop = 0.5 * plant.T_s * model.R
        a, b = (model.L - drop) / (model.L + drop), plant.T_s / (model.L + drop)
        control_num = np.convolve([K_p * a, K_i_T - K_p * a], [1.0, 0.0])
        control_den = np.convolve([1.0, -1.0], [1.0, K_p * b])
    return SampledLoop(
        tuple(np.convolve(control_num, plant_num).tolist()),
        tuple(np.convolve(control_den, plant_den).tolist()),
        plant.T_s,
        plant.delay_periods * plant.T_s,
    )


def maximum_delay_periods(gains: CurrentGains, plant: AxisPlant, model: AxisPlant | None = None) -> float:
    """Return the least total delay, in periods, that makes the loop unstable; the plant's own delay is part of it.

    Exact up to ``MANY_PERIODS``: the pole radius of the loop with fractional delay, enclosed by secants. Phase margin
    over crossover, which is taken beyond, is an approximation for a sampled loop. The plant's present delay is returned
    when the loop is unstable already.
    """

    def excess(delay: float) -> float:
        loop = axis_loop(gains, replace(plant, delay_periods=delay), model)
        return float(np.abs(loop.closed_loop_poles()).max()) - 1.0

    low, f_low = plant.delay_periods, excess(plant.delay_periods)
    if f_low >= 0.0:
        return low
    around = low + margins(axis_loop(gains, plant, model)).delay_margin_s / plant.T_s
    if around > MANY_PERIODS:
        return around
    high = _DELAY_STEP * low
    while (f_high := excess(high)) < 0.0:
        low, f_low, high = high, f_high, _DELAY_STEP * high
    moved_low: bool | None = None
    while high - low > _DELAY_RESOLUTION * high:
        # Illinois; kept inside by half the resolution, so that the end that would stay comes near too
        inset = 0.5 * _DELAY_RESOLUTION * high
        delay = min(max(low + (high - low) * f_low / (f_low - f_high), low + inset), high - inset)
        f = excess(delay)
        if f < 0.0:
            low, f_low, f_high = delay, f, 0.5 * f_high if moved_low is True else f_high
        else:
            high, f_high, f_low = delay, f, 0.5 * f_low if moved_low is False else f_low
        moved_low = f < 0.0
    return low


def _hold_and_delay(plant: AxisPlant) -> tuple[Array, Array]:
    """Return num, den of exp(-s tau) (1 - exp(-s T))/s / (L s + R), tau = (n + f) T, sampled at T."""
    extra = plant.delay_periods - HOLD_PERIODS
    whole = math.floor(extra + 1e-12)
    fraction = max(0.0, extra - whole)
    x = plant.R * plant.T_s / plant.L
    # (1 - exp(-y x)) / R, continuous at R = 0
    early = _held_gain((1.0 - fraction) * x, (1.0 - fraction) * plant.T_s / plant.L)
    late = math.exp(-(1.0 - fraction) * x) * _held_gain(fraction * x, fraction * plant.T_s / plant.L)
    num = np.array([early]) if fraction == 0.0 else np.array([early, late])
    den = np.array([1.0, -math.exp(-x)])
    delay = whole + (0 if fraction == 0.0 else 1)
    return num, np.concatenate((den, np.zeros(delay)))


def _held_gain(y: float, slope: float) -> float:
    """Return slope (1 - exp(-y)) / y, the current after a unit voltage held for y time constants."""
    return slope if y == 0.0 else slope * -math.expm1(-y) / y
