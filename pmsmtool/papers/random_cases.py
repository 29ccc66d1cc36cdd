# SPDX-License-Identifier: MIT
"""Random current steps of the machine of Jercic et al. 2017 and what a law makes of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.design.minimum_time import TransferProblem, minimum_time
from pmsmtool.papers.governed_drive import GovernedDrive, Plant, V_max, plant_of, source
from pmsmtool.papers.statistics import BAND, settling_s
from pmsmtool.units import RAD_S_PER_RPM

SPEED_RPM, STANDSTILL_SHARE = 1000.0, 0.05
"""Speeds are uniform up to this, but for a share of cases at standstill."""
LEAST_STEP_A = 10.0
START_SHARE, TARGET_SHARE = 0.98, 0.92
"""Largest steady-state voltage of start and target over V_max."""
FEASIBLE_SHARE = 0.92
"""The same for both ends when the plant is not the controller's."""
SLOW_S = 1e-3
"""Steps whose least time is longer than this are limited by the voltage rather than by the period."""

Pair = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Case:
    """One step: speed (rpm), current before and after (A)."""

    rpm: float
    start: Pair
    target: Pair

    @property
    def size(self) -> float:
        """Length of the step (A)."""
        return math.dist(self.start, self.target)


def _draw(rng: np.random.Generator, radius: float) -> Case:
    rpm = 0.0 if rng.uniform() < STANDSTILL_SHARE else float(rng.uniform(-SPEED_RPM, SPEED_RPM))
    ends = []
    for _ in range(2):
        size, angle = radius * math.sqrt(rng.uniform()), rng.uniform(0.0, 2.0 * math.pi)
        ends.append((size * math.cos(angle), size * math.sin(angle)))
    return Case(rpm, ends[0], ends[1])


def _wanted(count: int, seed: int, keep: Callable[[Case], bool]) -> tuple[Case, ...]:
    rng = np.random.default_rng(seed)
    radius = source().machine.I_max_apk
    assert radius is not None
    found: list[Case] = []
    while len(found) < count:
        case = _draw(rng, radius)
        if keep(case):
            found.append(case)
    return tuple(found)


def _share(plant: Plant, i: Pair, rpm: float) -> float:
    return float(plant.voltage(np.asarray(i), rpm)) / V_max()


@cache
def reachable(count: int, seed: int) -> tuple[Case, ...]:
    """Return steps whose ends the voltage limit can hold; the target with the reserve of field weakening."""
    plant = plant_of()

    def keep(case: Case) -> bool:
        return (
            case.size > LEAST_STEP_A
            and _share(plant, case.start, case.rpm) <= START_SHARE
            and _share(plant, case.target, case.rpm) <= TARGET_SHARE
        )

    return _wanted(count, seed, keep)


@cache
def unreachable(count: int, seed: int) -> tuple[Case, ...]:
    """Return steps to currents that need more voltage than there is."""
    plant = plant_of()

    def keep(case: Case) -> bool:
        return _share(plant, case.start, case.rpm) <= START_SHARE and _share(plant, case.target, case.rpm) > 1.0

    return _wanted(count, seed, keep)


@cache
def feasible_for(plant: Plant, count: int, seed: int) -> tuple[Case, ...]:
    """Return steps whose ends both the plant and the nominal machine can hold.

    The start is also held to the nominal limit, so that every law can be brought there.
    """

    def keep(case: Case) -> bool:
        return (
            case.size > LEAST_STEP_A
            and _share(plant, case.start, case.rpm) <= FEASIBLE_SHARE
            and _share(plant, case.target, case.rpm) <= FEASIBLE_SHARE
        )

    return _wanted(count, seed, keep)


@cache
def least_time_s(case: Case) -> float:
    """Return the least time (s) to the 2 % ball around the target, nominal machine, circle."""
    plant = plant_of()
    problem = TransferProblem(
        plant.R, plant.L_d, plant.L_q, plant.psi, RAD_S_PER_RPM * plant.pole_pairs * case.rpm, V_max()
    )
    return minimum_time(problem, case.start, case.target, radius=BAND * case.size)


def nearest_held(case: Case, plant: Plant, limit_a: float, eps: float = 0.0) -> Pair:
    """Return the current nearest to the target that (1 - eps) V_max can hold and a current limit allows.

    Projection on ellipse and disc: on one of them where that lies in the other, else on a corner of the two. Where they
    have no common point the projection on the ellipse, the voltage goes first.
    """
    w = RAD_S_PER_RPM * plant.pole_pairs * case.rpm
    M = np.array([[plant.R, -w * plant.L_q], [w * plant.L_d, plant.R]])
    c, r = np.array([0.0, w * plant.psi]), np.asarray(case.target)
    gram, pull = M.T @ M, M.T @ c

    def excess(i: Array) -> float:
        return float(np.hypot(*(M @ i + c))) - (1.0 - eps) * V_max()

    def point(multiplier: float) -> Array:
        return np.asarray(np.linalg.solve(np.eye(2) + multiplier * gram, r - multiplier * pull))

    held = r if excess(r) <= 0.0 else point(_root(lambda m: excess(point(m)), 0.0, _above(lambda m: excess(point(m)))))
    if float(np.hypot(*held)) <= limit_a:
        return float(held[0]), float(held[1])
    inner = r * min(1.0, limit_a / float(np.hypot(*r)))
    if excess(inner) <= 0.0:
        return float(inner[0]), float(inner[1])
    corners = _corners(lambda angle: excess(limit_a * np.array([math.cos(angle), math.sin(angle)])))
    if not corners:
        return float(held[0]), float(held[1])
    points = [(limit_a * math.cos(angle), limit_a * math.sin(angle)) for angle in corners]
    return min(points, key=lambda corner: math.dist(corner, case.target))


def _above(gap: Callable[[float], float]) -> float:
    high = 1.0
    while gap(high) > 0.0:
        high *= 4.0
    return high


def _root(gap: Callable[[float], float], low: float, high: float) -> float:
    """Bisect a gap that is positive at ``low`` and not at ``high``."""
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if gap(middle) > 0.0 else (low, middle)
    return high


def _corners(gap: Callable[[float], float]) -> list[float]:
    angles = np.linspace(0.0, 2.0 * math.pi, _CIRCLE + 1)
    gaps = [gap(float(angle)) for angle in angles]
    found = []
    for k in range(_CIRCLE):
        a, b = float(angles[k]), float(angles[k + 1])
        if gaps[k] > 0.0 >= gaps[k + 1]:
            found.append(_root(gap, a, b))
        elif gaps[k] <= 0.0 < gaps[k + 1]:
            found.append(_root(gap, b, a))
    return found


_BISECTIONS, _CIRCLE = 60, 180


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a law made of a set of cases, one entry per case."""

    settling_s: Array
    """Time of the first sample from which on the current stays in the band (s); infinite for never."""
    peak_a: Array
    """Largest current (A)."""
    demand: Array
    """Largest demanded voltage over V_max."""
    applied: Array
    """Largest voltage after the limiter over V_max."""
    final_a: Array
    """Distance from the target at the end (A)."""


def run_cases(
    drive: GovernedDrive, cases: Sequence[Case], targets: Sequence[Pair], bands_a: Sequence[float], duration_s: float
) -> Outcome:
    """Run every case and judge it against a target and a band of its own."""
    rows = []
    for case, target, band in zip(cases, targets, bands_a, strict=True):
        response = drive.step(case.rpm, case.start, case.target, duration_s)
        error = response.i - np.asarray(target)
        rows.append(
            (
                settling_s(response.i, target, band, response.T_s),
                float(np.hypot(*response.i.T).max()),
                float(np.hypot(*response.demanded.T).max()) / V_max(),
                float(np.hypot(*response.applied.T).max()) / V_max(),
                float(np.hypot(*error[-1])),
            )
        )
    return Outcome(*np.array(rows).T)
