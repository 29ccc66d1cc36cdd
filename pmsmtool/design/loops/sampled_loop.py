# SPDX-License-Identifier: MIT
"""Exact margins of a sampled feedback loop with a real rational loop transfer function L(z).

On the unit circle |N|^2 - |D|^2 and Im(N D*) / sin(theta) are polynomials in c = cos(theta), so *all* gain and phase
crossings are roots of a polynomial: no frequency grid can step over a resonance. Each root is then polished on L
itself, since c is badly conditioned near 1 (slow loops).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array

_REAL_ROOT = 1e-6
"""Largest |imaginary part| of a root in c taken as real; double roots of degree <= 12 scatter by about 1e-8."""

_MODULUS_GRID, _MODULUS_ROUNDS = 60, 5
"""Points of the grid for the least |1 + L|, and looks between neighbours: the place is known to 1e-7 of itself then."""

_POLISH_STEPS, _POLISHED = 60, 1e-15
"""Bracketed secant steps of a crossing (8 to 12 seen), and the relative change that ends them."""


@dataclass(frozen=True, slots=True)
class SampledLoop:
    """Loop transfer function L(z) = num(z) / den(z), broken at the actuator, negative feedback."""

    num: tuple[float, ...]
    den: tuple[float, ...]
    """Coefficients, highest power of z first."""
    T_s: float
    """Sampling period (s)."""
    delay_s: float = 0.0
    """Delay from a sample to the mean action that L contains (s), for the statement only."""

    def at(self, omega: float | Array) -> NDArray[np.complex128]:
        """Return L(exp(j omega T_s)) at angular frequencies (rad/s)."""
        z = np.exp(1j * np.asarray(omega, dtype=np.float64) * self.T_s)
        return np.asarray(_horner(self.num, z) / _horner(self.den, z), dtype=np.complex128)

    def closed_loop_poles(self) -> NDArray[np.complex128]:
        """Return the roots of den + num."""
        return np.asarray(np.roots(np.polyadd(self.den, self.num)), dtype=np.complex128)


@dataclass(frozen=True, slots=True)
class LoopMargins:
    """What a loop tolerates."""

    stable: bool
    """Whether all closed-loop poles lie inside the unit circle."""
    phase_margin_deg: float
    """Smallest distance of L from -1 in angle over all gain crossings (degree); infinity without a crossing."""
    gain_margin: float
    """Smallest factor above 1 that makes the loop unstable; infinity when none does."""
    gain_reduction: float
    """Largest factor below 1 that makes the loop unstable; 0 when none does."""
    delay_margin_s: float
    """Phase margin over crossover, the least over all crossings (s): the extra delay that makes the loop unstable,
    if it acts as exp(-s tau) on L (for a delay in front of the hold see ``current_loop.maximum_delay_periods``)."""
    modulus_margin: float
    """Least distance of L from -1; its inverse is the peak of the sensitivity."""
    crossover_rad_s: float
    """Gain crossing at which the phase margin is met (rad/s); NaN without a crossing."""
    bandwidth_rad_s: float
    """Where |L / (1 + L)| first falls below 1/sqrt(2) (rad/s); Nyquist when it does not."""
    delay_s: float
    """Delay the loop already contains (s); ``delay_s + delay_margin_s`` is the largest total delay."""

    @property
    def gain_margin_db(self) -> float:
        """Gain margin (dB)."""
        return 20.0 * math.log10(self.gain_margin)


@lru_cache(maxsize=8)
def margins(loop: SampledLoop) -> LoopMargins:
    """Return all margins of a loop, exactly; the last few are remembered, for a design looks at its loops twice.

    Phase crossings include the Nyquist frequency, where L is real: without a computation delay an integrating loop
    meets -180 degree only there.
    """
    gain_crossings = _gain_crossings(loop)
    at_gain = loop.at(gain_crossings)
    phase_margins = np.angle(-at_gain)
    worst = int(np.argmin(np.abs(phase_margins))) if phase_margins.size else -1
    lags = np.mod(phase_margins, 2.0 * math.pi)
    factors = -1.0 / loop.at(_phase_crossings(loop)).real
    up, down = factors[factors > 1.0], factors[factors < 1.0]
    return LoopMargins(
        stable=bool(np.all(np.abs(loop.closed_loop_poles()) < 1.0)),
        phase_margin_deg=math.degrees(float(phase_margins[worst])) if worst >= 0 else math.inf,
        gain_margin=float(up.min()) if up.size else math.inf,
        gain_reduction=float(down.max()) if down.size else 0.0,
        delay_margin_s=float(np.min(lags / gain_crossings)) if lags.size else math.inf,
        modulus_margin=modulus_margin(loop),
        crossover_rad_s=float(gain_crossings[worst]) if worst >= 0 else math.nan,
        bandwidth_rad_s=_bandwidth(loop),
        delay_s=loop.delay_s,
    )


def _square(coefficients: tuple[float, ...]) -> Array:
    """Return |p(exp(j theta))|^2 as a Chebyshev series in cos(theta)."""
    p = np.asarray(coefficients, dtype=np.float64)
    lags = np.correlate(p, p, mode="full")[p.size - 1 :]
    return np.concatenate((lags[:1], 2.0 * lags[1:]))


def _real_roots(series: Array) -> Array:
    """Return the angles theta in (0, pi) at which a Chebyshev series in cos(theta) vanishes."""
    series = np.trim_zeros(series, "b")
    if series.size < 2:
        return np.empty(0)
    roots = np.polynomial.chebyshev.chebroots(series)
    kept = roots[np.abs(roots.imag) < _REAL_ROOT].real
    return np.sort(np.arccos(kept[np.abs(kept) < 1.0]))


_SLOW = np.geomspace(1e-4, 0.3, 800)
"""Angles per sample at which slow crossings are looked for: 1 % apart."""


def _gain_crossings(loop: SampledLoop) -> Array:
    """Angular frequencies (rad/s) at which |L| = 1; those of a slow loop, near 1, are looked for on a grid besides."""
    guesses = _real_roots(np.asarray(np.polynomial.chebyshev.chebsub(_square(loop.num), _square(loop.den))))
    found = _polished(guesses, lambda omega: np.abs(loop.at(omega)) - 1.0, loop)
    omega = _SLOW / loop.T_s
    over = np.abs(loop.at(omega)) - 1.0
    missed = np.flatnonzero(np.diff(np.signbit(over)) & (np.histogram(found, omega)[0] == 0))
    share = over[missed] / (over[missed] - over[missed + 1])
    return np.sort(np.concatenate([found, omega[missed] + share * (omega[missed + 1] - omega[missed])]))


def _phase_crossings(loop: SampledLoop) -> Array:
    """Angular frequencies (rad/s) at which L is real and negative, the Nyquist frequency included."""
    num = np.asarray(loop.num, dtype=np.float64)
    den = np.asarray(loop.den, dtype=np.float64)
    size = max(num.size, den.size)
    num, den = np.pad(num, (size - num.size, 0)), np.pad(den, (size - den.size, 0))
    cross = np.correlate(num, den, mode="full")
    # Im(N D*) = sum_k s_k sin(k theta); correlation lag +k of ascending powers counts against theta.
    sines = cross[: size - 1][::-1] - cross[size:]
    series = np.zeros(size)
    for k, weight in enumerate(sines, start=1):
        # sin(k theta) / sin(theta) = U_(k-1) = 2 (T_(k-1) + T_(k-3) + ...), the T_0 term once
        series[k - 1 :: -2] += 2.0 * weight
        if (k - 1) % 2 == 0:
            series[0] -= weight
    found = _polished(_real_roots(series), lambda omega: loop.at(omega).imag, loop)
    found = np.append(found, math.pi / loop.T_s)
    values = loop.at(found).real
    return found[np.isfinite(values) & (values < 0.0)]


def _polished(theta: Array, function: Callable[[Array], Array], loop: SampledLoop) -> Array:
    """Refine each crossing between the midpoints to its neighbours (Illinois); one without sign change is dropped."""
    if theta.size == 0:
        return theta
    edges = np.concatenate(([theta[0] * 0.5], 0.5 * (theta[1:] + theta[:-1]), [0.5 * (theta[-1] + math.pi)]))
    low, high = edges[:-1] / loop.T_s, edges[1:] / loop.T_s
    f_low, f_high = function(low), function(high)
    crossing = np.signbit(f_low) != np.signbit(f_high)
    low, high, f_low, f_high = low[crossing], high[crossing], f_low[crossing], f_high[crossing]
    for _ in range(_POLISH_STEPS):
        middle = low + (high - low) * f_low / (f_low - f_high)
        f = function(middle)
        if np.all(np.abs(middle - high) <= _POLISHED * middle):
            return np.asarray(middle, dtype=np.float64)
        turned = f * f_high < 0.0
        low, f_low = np.where(turned, high, low), np.where(turned, f_high, 0.5 * f_low)
        high, f_high = middle, np.where(f == 0.0, np.finfo(np.float64).tiny, f)
    return np.asarray(high, dtype=np.float64)


def _horner(coefficients: tuple[float, ...], z: NDArray[np.complex128]) -> NDArray[np.complex128]:
    value = np.full_like(z, coefficients[0])
    for coefficient in coefficients[1:]:
        value = value * z + coefficient
    return value


def modulus_margin(loop: SampledLoop) -> float:
    """Return the least |1 + L| over the unit circle: the extrema of |D + N|^2 / |D|^2 are roots of a polynomial in c.

    The roots of a slow loop lie too near 1 to be told apart. So a grid is looked at besides, and the least of both
    again between its neighbours.
    """
    above, below = _square(tuple(np.polyadd(loop.den, loop.num))), _square(loop.den)
    cheb = np.polynomial.chebyshev
    slope = cheb.chebsub(cheb.chebmul(cheb.chebder(above), below), cheb.chebmul(above, cheb.chebder(below)))
    theta = np.sort(np.append(_real_roots(np.asarray(slope)), np.geomspace(1e-4, 1.0, _MODULUS_GRID) * math.pi))
    theta = theta[np.diff(theta, prepend=0.0) > 0.0]  # each once; np.unique would import the masked arrays, 9 ms
    with np.errstate(divide="ignore", invalid="ignore"):
        for _ in range(_MODULUS_ROUNDS):
            distance = np.abs(1.0 + loop.at(theta / loop.T_s))
            least = int(np.nanargmin(distance))
            low, high = theta[max(least - 1, 0)], theta[min(least + 1, theta.size - 1)]
            theta = np.append(np.linspace(low, high, _MODULUS_GRID), theta[least])
            theta.sort()
        return float(np.nanmin(np.abs(1.0 + loop.at(theta / loop.T_s))))


def _bandwidth(loop: SampledLoop) -> float:
    """First frequency (rad/s) where the complementary sensitivity falls below 1/sqrt(2)."""
    closed = SampledLoop(tuple(np.polyadd(loop.den, loop.num)), tuple(math.sqrt(2.0) * b for b in loop.num), loop.T_s)
    crossings = _gain_crossings(closed)
    return float(crossings[0]) if crossings.size else math.pi / loop.T_s
