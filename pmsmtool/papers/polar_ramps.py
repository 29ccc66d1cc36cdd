# SPDX-License-Identifier: MIT
"""Transitions between linear range and field weakening: torque and speed ramps, every law beside the baselines."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pmsmtool.papers.figure import Check, Column, Panel, Reproduction, Series, Table, at_most
from pmsmtool.papers.polar_scene import (
    ASSUMED,
    BASELINES,
    CONVENTIONAL,
    EXPECTED,
    EXPERIMENT,
    FOC_CDM,
    PROPOSED,
    REGULARISED_TABLE,
    SIMULATION,
    SOURCE,
    SWITCHED,
    UNIFIED,
    UNIFIED_TUNED,
    Bench,
    Controller,
    Response,
    run,
)
from pmsmtool.papers.statistics import torque_bump
from pmsmtool.sim.scenarios import Profile as Nodes

BUMP_NM = 0.025
"""Largest torque bump of the unified law on a ramp."""

CONVENTIONAL_SWITCHED = replace(SWITCHED, name="conventional, switched to the regularised law", law="conventional")
LAWS = (
    CONVENTIONAL,
    PROPOSED,
    CONVENTIONAL_SWITCHED,
    SWITCHED,
    REGULARISED_TABLE,
    UNIFIED,
    UNIFIED_TUNED,
    FOC_CDM,
    *BASELINES,
)


@dataclass(frozen=True, slots=True)
class Ramp:
    """A ramp up and down again; the figures look at what lies between ``from_s`` and ``to_s``."""

    name: str
    torque: Nodes
    speed: Nodes
    from_s: float
    to_s: float
    duration_s: float


TORQUE = Ramp(
    "torque 1 -> 4.5 -> 1 N m in 0.2 s each way at 800 rpm",
    ((0.0, 1.0), (0.10, 1.0), (0.30, 4.5), (0.34, 4.5), (0.54, 1.0)),
    ((0.0, 800.0),),
    0.06,
    0.60,
    0.64,
)
SPEED = Ramp(
    "speed 700 -> 1000 -> 700 rpm in 0.2 s each way at 2 N m",
    ((0.0, 2.0),),
    ((0.0, 700.0), (0.10, 700.0), (0.30, 1000.0), (0.34, 1000.0), (0.54, 700.0)),
    0.06,
    0.60,
    0.64,
)
REVERSAL = Ramp(
    "reversal -1400 -> 1400 -> -1400 rpm in 1 s each way at 2 N m",
    ((0.0, 2.0),),
    ((0.0, -1400.0), (0.10, -1400.0), (1.10, 1400.0), (1.20, 1400.0), (2.20, -1400.0)),
    0.06,
    2.25,
    2.3,
)
"""Through zero voltage, where the phase turns by pi; the phase laws cannot, without their switch."""


def response(law: Controller, ramp: Ramp, bench: Bench = SIMULATION, seed: int = 0) -> Response:
    """Return the response to a ramp."""
    return run(law, bench, ramp.torque, ramp.speed, ramp.duration_s, seed=seed)


def measured(r: Response, ramp: Ramp) -> tuple[float, float, float]:
    """Return torque bump (N m), largest torque error (N m) and largest i_d (A) within the ramp."""
    kept = slice(r.index(ramp.from_s), r.index(ramp.to_s))
    error = float(np.abs(r.torque - r.torque_asked)[kept].max())
    return torque_bump(r, ramp.from_s, ramp.to_s), error, float(r.i_d[kept].max())


def _table(ramp: Ramp, bench: Bench, seed: int) -> tuple[Table, dict[str, tuple[float, float, float]]]:
    columns = (
        Column("controller"),
        Column("torque bump", "N m", 3),
        Column("largest torque error", "N m", 3),
        Column("largest i_d", "A", 3),
    )
    laws = [law for law in LAWS if ramp is not REVERSAL or law not in (CONVENTIONAL, PROPOSED)]
    found = {law.name: measured(response(law, ramp, bench, seed), ramp) for law in laws}
    rows = tuple((name, *m) for name, m in found.items())
    return Table(f"{ramp.name}; {bench.name}", columns, rows), found


def transitions(seed: int) -> Reproduction:
    """Ramps of torque and speed through the limit of the linear range."""
    tables: list[Table] = []
    checks: list[Check] = []
    for ramp in (TORQUE, SPEED):
        table, found = _table(ramp, SIMULATION, seed)
        tables += [table, _table(ramp, EXPERIMENT, seed)[0]]
        for law, derived in ((UNIFIED, (0.022, 0.008)), (UNIFIED_TUNED, (0.006, 0.0))):
            what = f"{law.name}: torque bump, {ramp.name.split()[0]} ramp"
            expected = derived[0 if ramp is TORQUE else 1]
            checks.append(at_most(what, found[law.name][0], BUMP_NM, "N m", expected=expected, where=EXPECTED))
        bump = found[PROPOSED.name][0]
        expected = 0.031 if ramp is TORQUE else 0.020
        what = f"proposed: torque bump, {ramp.name.split()[0]} ramp"
        checks.append(Check(what, expected, bump, "N m", 0.5 * expected, 1.5 * expected, EXPECTED))
    table, found = _table(REVERSAL, SIMULATION, seed)
    tables += [table, _table(REVERSAL, EXPERIMENT, seed)[0]]
    what = f"{UNIFIED_TUNED.name}: torque bump, reversal"
    checks.append(at_most(what, found[UNIFIED_TUNED.name][0], BUMP_NM, "N m", where=EXPECTED))
    plots = []
    for ramp in (TORQUE, SPEED, REVERSAL):
        paper = SWITCHED if ramp is REVERSAL else PROPOSED
        runs = [(law.name, response(law, ramp, seed=seed)) for law in (paper, UNIFIED, UNIFIED_TUNED, *BASELINES)]
        kept = slice(runs[0][1].index(ramp.from_s), runs[0][1].index(ramp.to_s))
        t = 1e3 * runs[0][1].t[kept]
        lines = tuple(Series(name, t, 1e3 * (r.torque - r.torque_asked)[kept]) for name, r in runs)
        plots.append(Panel(ramp.name, "time / ms", "torque error / mN m", lines))
    return Reproduction(SOURCE, tuple(tables), tuple(plots), tuple(checks), ASSUMED)
