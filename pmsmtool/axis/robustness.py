# SPDX-License-Identifier: MIT
"""Margins of the loops of an axis: phase, gain, and the peaks of |S| = |1 / (1 + L)| and |T| = |L / (1 + L)|.

A loop is looked at on a grid of frequencies that has points inside every resonance: those of the path and those of the
closed loop, whose poles are known. So no narrow peak lies between two points. Extrema are looked at again between their
neighbours, crossings on the loop itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array, Complex
from pmsmtool.axis.loops import AxisGains, AxisPath, Lifted, Loop, closed_loop_poles, open_loop
from pmsmtool.design.loops.sampled_loop import LoopMargins

GRID_POINTS = 240
GRID_START = 1e-4
"""Logarithmic grid from this share of the Nyquist frequency."""
INSIDE = np.linspace(-6.0, 6.0, 49)
"""Points about a pole, in its real part: |S| between two of them is within 0.8 % of the larger (parabola)."""
NARROW = 0.2
"""Poles with less damping than this get points of their own; the grid is finer than the wider ones."""
ROUNDS, REFINED = 3, 17
"""Looks between the neighbours of an extremum, points of each: the peak is exact to 1e-6 then (measured)."""
SECANTS = 40


@dataclass(frozen=True, slots=True)
class AxisMargins:
    """What a loop tolerates.

    Attributes
    ----------
    loop : LoopMargins
        As of every other loop of a design.
    S_peak_db, T_peak_db : float
        Largest sensitivity and complementary sensitivity (dB).
    """

    loop: LoopMargins
    S_peak_db: float
    T_peak_db: float


def grid(plant: Lifted, *more: Complex) -> Array:
    """Return angular frequencies (rad/s) up to Nyquist, with points inside the resonances of path and other poles."""
    nyquist = math.pi / plant.T
    found = [np.geomspace(GRID_START, 1.0, GRID_POINTS) * nyquist]
    for pole in np.concatenate((np.linalg.eigvals(plant.A), *more)):
        s = np.log(pole) / plant.T if abs(pole) > 0.0 else 0.0
        if s.imag > 0.0 and abs(s.real) < NARROW * abs(s):
            found.append(s.imag + INSIDE * max(abs(s.real), 1e-4 * s.imag))
    omega = np.unique(np.concatenate(found))
    return np.asarray(omega[(omega > 0.0) & (omega <= nyquist)], dtype=np.float64)


def gain_crossings(values: Complex) -> tuple[NDArray[np.intp], Array]:
    """Return before which points |L| crosses 1, and the angle of -L there (rad), interpolated over log |L|."""
    size = np.log(np.abs(values))
    at = np.flatnonzero(np.signbit(size[:-1]) != np.signbit(size[1:]))
    share = size[at] / (size[at] - size[at + 1])
    turn = np.angle(values[at + 1] / values[at])
    return at, np.angle(-values[at] * np.exp(1j * share * turn))


def axis_margins(plant: Lifted, path: AxisPath, gains: AxisGains, loop: Loop) -> AxisMargins:
    """Return all margins of a loop."""
    poles = closed_loop_poles(plant, path, gains, loop)
    omega = grid(plant, poles)

    def at(w: Array) -> Complex:
        return open_loop(plant, path, gains, loop, w, plant.at(w))

    values = at(omega)
    crossings = _crossings(lambda w: np.log(np.abs(at(w))), omega, np.log(np.abs(values)))
    phases = np.angle(-at(crossings)) if crossings.size else np.empty(0)
    worst = int(np.argmin(np.abs(phases))) if phases.size else -1
    turns = _crossings(lambda w: at(w).imag, omega, values.imag)
    factors = -1.0 / at(np.append(turns, math.pi / plant.T)).real
    up, down = factors[factors > 1.0], factors[(factors > 0.0) & (factors < 1.0)]
    lags = np.mod(phases, 2.0 * math.pi)
    distance = -_largest(lambda w: -np.abs(1.0 + at(w)), omega, -np.abs(1.0 + values))
    following = _largest(lambda w: np.abs(at(w) / (1.0 + at(w))), omega, np.abs(values / (1.0 + values)))
    closed = np.abs(values / (1.0 + values))
    below = np.flatnonzero(closed < math.sqrt(0.5))
    found = LoopMargins(
        stable=bool(np.all(np.abs(poles) < 1.0)),
        phase_margin_deg=math.degrees(float(phases[worst])) if worst >= 0 else math.inf,
        gain_margin=float(up.min()) if up.size else math.inf,
        gain_reduction=float(down.max()) if down.size else 0.0,
        delay_margin_s=float(np.min(lags / crossings)) if crossings.size else math.inf,
        modulus_margin=distance,
        crossover_rad_s=float(crossings[worst]) if worst >= 0 else math.nan,
        phase_crossover_rad_s=float(np.append(turns, math.pi / plant.T)[factors == up.min()][0])
        if up.size
        else math.nan,
        bandwidth_rad_s=float(omega[below[0]]) if below.size else math.pi / plant.T,
        delay_s=path.current.delay_s + (0.5 + path.late) * path.T,
    )
    return AxisMargins(found, -20.0 * math.log10(distance), 20.0 * math.log10(following))


def _crossings(function: Callable[[Array], Array], omega: Array, values: Array) -> Array:
    """Return where a function crosses zero between points of a grid (rad/s), by bracketed secants (Illinois)."""
    at = np.flatnonzero(np.signbit(values[:-1]) != np.signbit(values[1:]))
    low, high, f_low, f_high = omega[at], omega[at + 1], values[at], values[at + 1]
    for _ in range(SECANTS):
        if not at.size:
            break
        middle = low + (high - low) * f_low / (f_low - f_high)
        f = function(middle)
        turned = f * f_high < 0.0
        low, f_low = np.where(turned, high, low), np.where(turned, f_high, 0.5 * f_low)
        high, f_high = middle, np.where(f == 0.0, np.finfo(np.float64).tiny, f)
        if np.all(np.abs(high - low) <= 1e-12 * high) or np.all(np.abs(f) < 1e-13):
            break
    return np.asarray(high, dtype=np.float64)


def _largest(function: Callable[[Array], Array], omega: Array, values: Array) -> float:
    """Return the largest value: that of the grid, looked at again between its neighbours."""
    top = int(np.argmax(values))
    low, high = omega[max(top - 1, 0)], omega[min(top + 1, omega.size - 1)]
    best = float(values[top])
    for _ in range(ROUNDS):
        finer = np.linspace(low, high, REFINED)
        found = function(finer)
        top = int(np.argmax(found))
        best = max(best, float(found[top]))
        low, high = finer[max(top - 1, 0)], finer[min(top + 1, REFINED - 1)]
    return best
