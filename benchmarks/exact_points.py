# SPDX-License-Identifier: MIT
"""Look-up tables of random machines against operating points enumerated exactly by roots of polynomials.

    python -m benchmarks.exact_points [--machines 1000] [--seed 1] [--map] [--wide]

Each machine has constant inductances (surface, salient either way, nearly without magnet), a resistance from none to
half of the voltage at full current, in a quarter of the cases a demagnetisation limit; its eight speeds run from
standstill to beyond the last reachable one, both ways. Eleven torques per speed: inside, near both limits of that speed
(1e-2 to 1e-6 of its span) and beyond them: 88 cells. ``--map`` gives the same machine as a flux map, whose cubic
cells hold a linear flux exactly, so that the path of a saturated machine meets the same truth. ``--wide`` draws from
:data:`WIDE`: resistances that take up to five times the voltage at full current, reactive flux from a thousandth of
the magnet's to fifty times, saliency up to 30 either way. Printed are the largest errors, and the cells beyond the
limits of this file by kind. Exit code 1 when there are any.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np

from pmsmtool.design.lookup.table import CURRENT, CUT, DEMAGNETISATION, NONE, VOLTAGE, speed_table
from pmsmtool.design.operating_machine import OperatingMachine
from pmsmtool.errors import DesignInfeasible
from pmsmtool.machine.flux_map import FluxMap
from pmsmtool.units import RPM_PER_RAD_S
from tests.design.exact_points import LinearCase, Point

SUBOPTIMAL = 1e-6
"""Current above the least, over I_max; torque short of the extreme, over the machine's largest."""

EXCESS = 1e-9
"""A limit may be exceeded by this, relative."""

AT_LIMIT = 1e-8
"""Demands this near to the last torque, over the span, may count as either."""

BINDS, BINDS_DOUBT = 1e-5, 2e-6
"""A limit binds within the first, relative; within the second of that either answer is right."""

SHARES = (-0.1, 1e-6, 1e-4, 1e-2, 0.5, 0.8, 0.99, 0.9999, 0.999999, 1.05)
"""Demanded torques between the least (0) and the largest (1) of a speed; one more at random."""

SPEEDS = 8


@dataclass(frozen=True, slots=True)
class Ranges:
    """Powers of ten that machines are drawn from."""

    flux: tuple[float, float]
    """L_q I_max over psi_f."""

    saliency: tuple[tuple[float, float], ...]
    """L_q over L_d of surface, interior, inversely salient machines and of those nearly without magnet."""

    magnet: tuple[float, float]
    """Of the last kind, over that of the others."""

    resistance: tuple[float, float]
    """R I_max over the voltage."""


USUAL = Ranges((-1.3, 1.0), ((0.0, 0.0), (0.02, 0.9), (-0.4, -0.01), (0.5, 1.0)), (-2.0, -0.5), (-3.5, -0.3))
WIDE = Ranges((-3.0, 1.7), ((0.0, 0.0), (0.0, 1.5), (-1.5, 0.0), (0.3, 1.5)), (-4.0, -0.5), (-6.0, 0.7))


@dataclass(slots=True)
class Tally:
    """What was found: the largest errors, and cells beyond what is allowed, by kind."""

    cells: int = 0
    largest: dict[str, float] = field(default_factory=dict)
    where: dict[str, str] = field(default_factory=dict)
    wrong: Counter[str] = field(default_factory=Counter)

    def note(self, kind: str, error: float, allowed: float, where: str) -> None:
        """Keep the largest error of a kind; one beyond what is allowed counts as wrong."""
        if not error <= self.largest.get(kind, -math.inf):
            self.largest[kind], self.where[kind] = error, where
        if not error <= allowed:
            self.wrong[kind] += 1


def random_machine(rng: np.random.Generator, ranges: Ranges = USUAL) -> tuple[OperatingMachine, LinearCase]:
    """Draw a machine and its limits; the speed is still 0."""
    pole_pairs, I_max, V = int(rng.integers(1, 9)), 10.0 ** rng.uniform(0.0, 2.7), 10.0 ** rng.uniform(1.0, 2.8)
    psi_f = 10.0 ** rng.uniform(-2.5, 0.0)
    L_q = psi_f / I_max * 10.0 ** rng.uniform(*ranges.flux)
    kind = rng.choice(4, p=[0.25, 0.5, 0.15, 0.1])
    L_d = L_q / 10.0 ** rng.uniform(*ranges.saliency[kind])
    if kind == 3:
        psi_f *= 10.0 ** rng.uniform(*ranges.magnet)
    R = 0.0 if rng.random() < 0.1 else V / I_max * 10.0 ** rng.uniform(*ranges.resistance)
    i_d_min = -I_max * rng.uniform(0.05, 1.0) if rng.random() < 0.25 else -math.inf
    machine = OperatingMachine(pole_pairs, R, L_d, L_q, psi_f)
    return machine, LinearCase(R, L_d, L_q, psi_f, 0.0, V, I_max, i_d_min)


def as_map(machine: OperatingMachine, I_max: float) -> OperatingMachine:
    """Return the machine with its linear flux sampled as a map."""
    grid = np.linspace(-1.25 * I_max, 1.25 * I_max, 11)
    d, q = np.meshgrid(grid, grid, indexing="ij")
    return replace(machine, flux_map=FluxMap(grid, grid, machine.psi_f + machine.L_d * d, machine.L_q * q))


def last_speed(case: LinearCase) -> float:
    """Electrical speed (rad/s) where the voltage at the best of i_d in the circle reaches the limit; no resistance."""
    best = max(-case.I_max, case.i_d_min, -case.psi_f / case.L_d)
    return case.V / max(case.psi_f + case.L_d * best, 0.02 * case.psi_f)


def speeds(rng: np.random.Generator, case: LinearCase) -> list[float]:
    """Return standstill, speeds either way, and some near the last reachable one."""
    base = case.V / math.hypot(case.psi_f, case.L_q * case.I_max)
    spread = base * (1.2 * last_speed(case) / base) ** rng.uniform(0.0, 1.0, SPEEDS - 3)
    near = last_speed(case) * rng.uniform(0.9, 1.02, 2)
    return [0.0, *(float(w) for w in np.concatenate((spread, near)) * rng.choice([-1.0, 1.0], SPEEDS - 1))]


def reach(case: LinearCase) -> float:
    """Largest torque over 1.5 p at standstill, whatever the voltage."""
    free = replace(case, omega=0.0, V=1e6 * case.V)
    return max(abs(case.level_at(point)) for point in free.extreme_torques())


def limits_differ(case: LinearCase, bits: int, at: Point, *, cut: bool | None) -> bool:
    """Whether a cell names other limits than its true point touches; ``cut`` None: either is right."""
    room = (
        (CURRENT, 1.0 - math.hypot(at.i_d, at.i_q) / case.I_max),
        (VOLTAGE, 1.0 - case.voltage_at(at) / case.V),
        (DEMAGNETISATION, (at.i_d - case.i_d_min) / case.I_max),
    )
    wrong = any(bool(bits & bit) != (left < BINDS) for bit, left in room if abs(left - BINDS) > BINDS_DOUBT)
    return wrong or (cut is not None and bool(bits & CUT) != cut)


def check_speed(machine: OperatingMachine, case: LinearCase, rng: np.random.Generator, tally: Tally, name: str) -> None:
    """Solve eleven torques of one speed and compare."""
    scale, ends, top = 1.5 * machine.pole_pairs, case.extreme_torques(), reach(case)
    none = math.isnan(ends[0].i_d)
    low, high = (-top, top) if none else (case.level_at(end) for end in ends)
    level = [low + share * (high - low) for share in (*SHARES, float(rng.uniform(0.0, 1.0)))]
    where = f"{name}, {case.omega:.9g} rad/s"
    try:
        table = speed_table(
            machine, torque_nm=[scale * t for t in level], speed_rpm=[case.omega / machine.pole_pairs * RPM_PER_RAD_S],
            V_max_v=[case.V], I_max_apk=case.I_max, i_d_min_a=case.i_d_min,
        )  # fmt: skip
    except DesignInfeasible as error:
        tally.note("not solved", 1.0, 0.0, f"{where}: {error}")
        return
    tally.cells += len(level)
    for x, wanted in enumerate(level):
        bits, at = int(table.limits[x, 0, 0]), Point(float(table.i_d_a[x, 0, 0]), float(table.i_q_a[x, 0, 0]))
        cell = f"{where}, level {wanted:.12g} of {low:.12g} to {high:.12g}"
        if none or bits & NONE:
            tally.note("feasibility wrong", float(none != bool(bits & NONE)), 0.0, cell)
            continue
        reached = min(max(wanted, low), high)
        current = math.hypot(at.i_d, at.i_q) / case.I_max
        tally.note("|i| beyond I_max", current - 1.0, EXCESS, cell)
        tally.note("|v| beyond its limit", case.voltage_at(at) / case.V - 1.0, EXCESS, cell)
        tally.note("i_d below its limit", (case.i_d_min - at.i_d) / case.I_max, EXCESS, cell)
        tally.note("torque off the nearest, over the largest", abs(case.level_at(at) - reached) / top, SUBOPTIMAL, cell)
        near = [abs(wanted - end) <= AT_LIMIT * top for end in (low, high)]
        if any(near):
            continue
        inside = low < wanted < high
        best = case.least_current(reached) if inside else ends[wanted > low]
        if inside:
            more = current - math.hypot(best.i_d, best.i_q) / case.I_max
            tally.note("current above the least, over I_max", more, SUBOPTIMAL, cell)
            tally.note("current below the least, over I_max", -more, SUBOPTIMAL, cell)
        tally.note("limits named wrong", float(limits_differ(case, bits, best, cut=not inside)), 0.0, cell)


def main() -> int:
    """Print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--machines", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--map", action="store_true", help="give each machine as a flux map")
    parser.add_argument("--wide", action="store_true", help="draw from a wider population")
    options = parser.parse_args()
    tally = Tally()
    for number in range(options.machines):
        rng = np.random.default_rng([options.seed, number])
        machine, case = random_machine(rng, WIDE if options.wide else USUAL)
        solved = as_map(machine, case.I_max) if options.map else machine
        for omega in speeds(rng, case):
            check_speed(solved, replace(case, omega=omega), rng, tally, f"machine {number}")
    kinds = {
        kind: {"largest": tally.largest[kind], "wrong": tally.wrong[kind], "where": tally.where[kind]}
        for kind in tally.largest
    }
    json.dump({"cells": tally.cells, "wrong": sum(tally.wrong.values()), "kinds": kinds}, sys.stdout, indent=1)
    print()
    return int(bool(tally.wrong))


if __name__ == "__main__":
    sys.exit(main())
