# SPDX-License-Identifier: MIT
"""Gains of an axis: the stiffest control whose margins hold over the whole tolerance box.

Maximised is K_i K_v, of a speed loop without position loop K_i times its crossover. The inverse of K_i K_v is the
integral of the position error after a step of load torque (K. J. Astrom, H. Panagopoulos, T. Hagglund, Automatica 34
(1998) 585). In a cascade the error of a move goes with 1 / K_v, too: v / K_v where nothing feeds the speed forward,
else a t / K_v, where the loop sees the speed t late. So K_v counts thrice there, and K_i K_v^3 is maximised: half of
the stiffness is given for 1.4 times K_v. One PID derives demand and position alike. Constraints are least phase margin
and largest |S|, of the speed loop alone and of both loops together.

A loop is looked at on a grid of frequencies that has points inside every resonance: those of the path and those of the
closed loop, whose poles are known. So no narrow peak lies between two points. Extrema are looked at again between their
neighbours, crossings on the loop itself.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array, Complex
from pmsmtool.axis.loops import AxisGains, AxisPath, Lifted, Loop, closed_loop_poles, lifted, open_loop
from pmsmtool.design.loops.sampled_loop import LoopMargins
from pmsmtool.design.loops.speed_loop import Notch
from pmsmtool.errors import DesignInfeasible
from pmsmtool.machine.two_masses import Mechanics

LOOPS: tuple[Loop, ...] = ("speed", "position")

INTEGRAL_RATIOS = (3.0, 4.0, 6.0, 9.0, 14.0)
POSITION_RATIOS = (1.25, 1.5, 2.0, 3.0, 4.0)
"""Ratios tried: crossover K_p / J over K_i / K_p, and over K_v."""
NOTCH_WIDTHS = (0.25, 0.5, 1.0)
"""Denominator dampings of the notch tried."""
NOTCH_DEPTH = 0.1
"""Numerator over denominator damping: 20 dB at the centre."""
NOTCH_RATE = 0.4
"""Largest frequency of a notch times the period of the loops: half of the rate is the end."""
SLOWEST = 1e-4
"""A crossover is looked for down to this share of 1 / lag."""
STEPS = 44
HALVINGS = 8
BACK = 0.98
"""Step by which a crossover is taken back where the exact margins are just below those of the grid."""
BACKS = 40

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
class Case:
    """One corner of the box: a factor of the torque over the inertia, and of the resonance and its damping.

    ``shaft``: another one than the nominal, which this one may be.
    """

    gain: float = 1.0
    frequency: float = 1.0
    damping: float = 1.0
    shaft: Mechanics | None = None

    def of(self, nominal: Mechanics) -> Mechanics:
        """Return the shaft of this corner."""
        return (self.shaft or nominal).scaled(1.0, self.frequency, self.damping)

    def __str__(self) -> str:
        if self.shaft is not None:
            swings = f"load {self.shaft.load_ratio:.3g} times the motor, swinging at {self.shaft.resonance_hz:.3g} Hz"
            return f"gain x {self.gain:.3g}, {swings}"
        return f"gain x {self.gain:.3g}, resonance x {self.frequency:.3g}, its damping x {self.damping:.3g}"


@dataclass(frozen=True, slots=True)
class Limits:
    """Least phase margin (degree) and largest |S| (dB)."""

    phase_deg: float = 45.0
    S_db: float = 6.0

    def __str__(self) -> str:
        return f"{self.phase_deg:.3g} deg and {self.S_db:.3g} dB"

    def holds(self, found: AxisMargins) -> bool:
        """Whether a loop is stable and keeps both."""
        loop = found.loop
        return loop.stable and loop.phase_margin_deg >= self.phase_deg and found.S_peak_db <= self.S_db


@dataclass(frozen=True, slots=True)
class Judged:
    """Margins of one loop: with the nominal shaft, and the least of each over the box with the case it belongs to."""

    nominal: AxisMargins
    phase_deg: float
    phase_case: Case
    S_db: float
    S_case: Case
    T_db: float


class Box:
    """The path of an axis at every corner of its tolerance box.

    Parameters
    ----------
    path : AxisPath
        With the nominal shaft.
    cases : sequence of Case
        Corners; the nominal one is looked at besides.
    """

    def __init__(self, path: AxisPath, cases: Sequence[Case]) -> None:
        self.path = path
        self.cases = (Case(), *cases)
        self._shafts = {case: case.of(path.shaft) for case in self.cases}
        self._plants = {shaft: lifted(replace(path, shaft=shaft)) for shaft in dict.fromkeys(self._shafts.values())}
        self._seen: dict[Mechanics, tuple[Array, Complex]] = {}
        for shaft, plant in self._plants.items():
            omega = grid(plant)
            self._seen[shaft] = omega, plant.at(omega)

    def may_hold(self, gains: AxisGains, limits: Limits, loops: Sequence[Loop] = LOOPS) -> bool:
        """Whether loops keep the limits on the grid, at every corner, and are stable."""
        sensitivity = 10.0 ** (-limits.S_db / 20.0)
        least = math.radians(limits.phase_deg)
        for shaft, (omega, seen) in reversed(self._seen.items()):  # the nominal one rejects least
            plant = self._plants[shaft]
            for loop in loops:
                values = open_loop(plant, self.path, gains, loop, omega, seen)
                for case in self.cases:
                    if self._shafts[case] != shaft:
                        continue
                    scaled = values * case.gain
                    if float(np.min(np.abs(1.0 + scaled))) < sensitivity:
                        return False
                    at, angle = gain_crossings(scaled)
                    if not at.size or float(np.min(np.abs(angle))) < least:
                        return False
        return all(
            bool(np.all(np.abs(closed_loop_poles(self._scaled(case), self.path, gains, loop)) < 1.0))
            for case in self.cases
            for loop in loops
        )

    @property
    def plant(self) -> Lifted:
        """The path with the nominal shaft."""
        return self._plants[self._shafts[Case()]]

    @property
    def plants(self) -> Iterator[Lifted]:
        """The path at every corner, the nominal one first."""
        return map(self._scaled, self.cases)

    def _scaled(self, case: Case) -> Lifted:
        plant = self._plants[self._shafts[case]]
        return replace(plant, b=plant.b * case.gain, d=plant.d * case.gain)

    def judged(self, gains: AxisGains, loop: Loop) -> Judged:
        """Return the margins of a loop over the box."""
        found = {case: axis_margins(self._scaled(case), self.path, gains, loop) for case in self.cases}
        phase = min(found, key=lambda case: _phase(found[case]))
        peak = max(found, key=lambda case: found[case].S_peak_db)
        most = max(one.T_peak_db for one in found.values())
        return Judged(found[Case()], _phase(found[phase]), phase, found[peak].S_peak_db, peak, most)

    def holds(self, gains: AxisGains, limits: Limits, loops: Sequence[Loop] = LOOPS) -> bool:
        """Whether loops are stable and keep the limits at every corner, exactly."""
        return all(
            limits.holds(axis_margins(self._scaled(case), self.path, gains, loop))
            for case in self.cases
            for loop in loops
        )


def _phase(found: AxisMargins) -> float:
    return found.loop.phase_margin_deg if found.loop.stable else -math.inf


def _notches(path: AxisPath, allowed: bool) -> Iterator[Notch]:
    yield Notch()
    if allowed and path.shaft.elastic and path.shaft.resonance_hz * path.T < NOTCH_RATE:
        for width in NOTCH_WIDTHS:
            yield Notch(path.shaft.resonance_hz, NOTCH_DEPTH * width, width)


def stiffest(box: Box, limits: Limits, *, notch: bool = True, loops: Sequence[Loop] = LOOPS) -> AxisGains:
    """Return the stiffest gains that keep the limits over the box. Raises DesignInfeasible: none does.

    Parameters
    ----------
    notch : bool
        Whether the drive has a notch to set.
    loops : sequence of str
        Those that these gains decide; of ``speed`` alone K_v is not looked at.
    """
    path = box.path
    positions = POSITION_RATIOS if "position" in loops else POSITION_RATIOS[:1]
    power = 3 if "position" in loops and path.structure == "cascade" else 1
    best: AxisGains | None = None
    for shape in sorted(
        itertools.product(INTEGRAL_RATIOS, positions, _notches(path, notch)), key=lambda one: one[0] * one[1] ** power
    ):
        floor = 0.0 if best is None else _least(best, path, shape, power)
        found = _fastest(box, limits, shape, floor, loops)
        if found is not None:
            best = found
    if best is None:
        raise DesignInfeasible(
            f"no gains have {limits.phase_deg:g} degree and |S| below {limits.S_db:g} dB over the tolerance box",
            where="axis",
            likely=f"the loops see and act too late ({1e3 * path.lag_s:.3g} ms) for this resonance and its interval",
            hint="ask for smaller margins, or give the drive's own rate and filter",
        )
    return best


Shape = tuple[float, float, Notch]


def _gains(path: AxisPath, shape: Shape, omega_c: float) -> AxisGains:
    integral, position, notch = shape
    K_p = path.shaft.J * omega_c
    return AxisGains(K_p, K_p * omega_c / integral, omega_c / position, notch)


def _least(best: AxisGains, path: AxisPath, shape: Shape, power: int) -> float:
    """Return the crossover from which a shape has more K_i K_v^power than the best so far."""
    wanted = best.K_i * best.K_v**power / path.shaft.J * shape[0] * shape[1] ** power
    return float(wanted ** (1.0 / (2.0 + power)))


def _fastest(box: Box, limits: Limits, shape: Shape, floor: float, loops: Sequence[Loop]) -> AxisGains | None:
    """Return the gains of a shape with the largest crossover above ``floor``, None where none keeps the limits."""
    path = box.path
    top = 1.0 / path.lag_s
    tried = [omega for omega in np.geomspace(1.0, SLOWEST, STEPS) * top if omega > floor]
    tried += [floor] if floor else []  # the fastest may lie between it and the last of these
    for k, omega in enumerate(tried):
        if not box.may_hold(_gains(path, shape, float(omega)), limits, loops):
            continue
        low, high = float(omega), float(tried[k - 1]) if k else float(omega)
        for _ in range(HALVINGS):
            middle = math.sqrt(low * high)
            low, high = (middle, high) if box.may_hold(_gains(path, shape, middle), limits, loops) else (low, middle)
        for _ in range(BACKS):
            if low <= floor:
                return None
            gains = _gains(path, shape, low)
            if box.holds(gains, limits, loops):
                return gains
            low *= BACK
        return None
    return None


@dataclass(frozen=True, slots=True)
class AxisMargins:
    """What a loop tolerates."""

    loop: LoopMargins
    """As of every other loop of a design."""
    S_peak_db: float
    T_peak_db: float
    """Largest sensitivity and complementary sensitivity (dB)."""


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
    closed = np.abs(values / (1.0 + values))
    following = _largest(lambda w: np.abs((found := at(w)) / (1.0 + found)), omega, closed)
    below = np.flatnonzero(closed < math.sqrt(0.5))
    found = LoopMargins(
        stable=bool(np.all(np.abs(poles) < 1.0)),
        phase_margin_deg=math.degrees(float(phases[worst])) if worst >= 0 else math.inf,
        gain_margin=float(up.min()) if up.size else math.inf,
        gain_reduction=float(down.max()) if down.size else 0.0,
        delay_margin_s=float(np.min(lags / crossings)) if crossings.size else math.inf,
        modulus_margin=distance,
        crossover_rad_s=float(crossings[worst]) if worst >= 0 else math.nan,
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
