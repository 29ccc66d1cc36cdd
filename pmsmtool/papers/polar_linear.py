# SPDX-License-Identifier: MIT
"""Figs 7 to 10 of Miyajima et al. 2013: linear range at 0 and 400 rpm, without and with noise; the improved laws."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pmsmtool.papers.figure import Check, Column, Panel, Reproduction, Series, Table
from pmsmtool.papers.polar_scene import (
    ASSUMED,
    BASELINES,
    EXPECTED,
    EXPERIMENT,
    FOC_CDM,
    LINEAR,
    PRINTED,
    QUIET_NOISY,
    REGULARISED,
    SIMULATION,
    SOURCE,
    UNIFIED_TUNED,
    Bench,
    Controller,
    Response,
    at_least,
    at_most,
    near,
    run,
    steps,
)
from pmsmtool.papers.polar_steps import panels
from pmsmtool.papers.statistics import Staircase, phase_step_rms, staircase

LEAD_S, EACH_S = 0.02, 0.02
LOW_RPM, HIGH_RPM = 0.0, 400.0

STAIRS = (0.0, 1.0, 0.0, -1.0, 0.0)
REVERSAL = (0.0, 1.0, -1.0, 1.0)

REGULARISED_HALF = replace(REGULARISED, name="regularised polar map, b = 0.5", values=(("polar.b", 0.5),))
REGULARISED_ONE = replace(REGULARISED, name="regularised polar map, b = 1", values=(("polar.b", 1.0),))
REGULARISED_WIDE = replace(
    REGULARISED, name="regularised polar map, eps = 0.05 V_max", values=(("polar.eps_ratio", 0.05),)
)
DELAYED = Bench("one period of delay", 1.5, SIMULATION.simulation)

LAWS = (
    LINEAR,
    PRINTED,
    REGULARISED_ONE,
    REGULARISED_HALF,
    REGULARISED,
    UNIFIED_TUNED,
    FOC_CDM,
    *BASELINES,
)


def response(
    law: Controller, rpm: float, bench: Bench = SIMULATION, levels_nm: Sequence[float] = STAIRS, seed: int = 0
) -> Response:
    """Return the response to a staircase of torque at a speed."""
    torque = steps([(0.0 if k == 0 else LEAD_S + EACH_S * (k - 1), level) for k, level in enumerate(levels_nm)])
    return run(law, bench, torque, [(0.0, rpm)], LEAD_S + EACH_S * (len(levels_nm) - 1), seed=seed)


def measured(r: Response, levels_nm: Sequence[float] = STAIRS) -> Staircase:
    """Return the measures of such a response."""
    starts = LEAD_S + EACH_S * np.arange(len(levels_nm) - 1)
    return staircase(r, starts.astype(np.float64), np.array(levels_nm, dtype=np.float64))


_COLUMNS = (
    Column("controller"),
    *(
        Column(f"{rpm:g} rpm: {name}", unit, 3)
        for rpm in (LOW_RPM, HIGH_RPM)
        for name, unit in (("overshoot", "%"), ("settling", "ms"), ("peak i_d", "A"), ("i_d of the step", "%"))
    ),
)


def _row(name: str, pair: Sequence[Staircase]) -> tuple[str | float, ...]:
    return (name, *(x for m in pair for x in (m.over, m.settle_ms, m.i_d_a, m.i_d_percent)))


def _pair(law: Controller, bench: Bench, levels: Sequence[float], seed: int) -> tuple[Staircase, Staircase]:
    low, high = (measured(response(law, rpm, bench, levels, seed), levels) for rpm in (LOW_RPM, HIGH_RPM))
    return low, high


def _stairs(
    laws: Sequence[Controller], bench: Bench, seed: int
) -> tuple[Table, dict[str, tuple[Staircase, Staircase]]]:
    found = {law.name: _pair(law, bench, STAIRS, seed) for law in laws}
    rows = tuple(_row(name, pair) for name, pair in found.items())
    return Table(f"0 -> 1 -> 0 -> -1 -> 0 N m, worst step; {bench.name}", _COLUMNS, rows), found


def _figure(rpm: float, bench: Bench, seed: int, checks: Sequence[Check]) -> Reproduction:
    table, _ = _stairs((LINEAR, *BASELINES), bench, seed)
    plots = panels(response(LINEAR, rpm, bench, seed=seed), LEAD_S - 0.005)
    return Reproduction(SOURCE, (table,), plots, tuple(checks), ASSUMED, columns=2)


def figure_7(seed: int) -> Reproduction:
    """Fig. 7: linear range at 0 rpm, simulation."""
    m = measured(response(LINEAR, LOW_RPM, seed=seed))
    checks = (
        near("overshoot at 0 rpm", 18.5, m.over, "%", absolute=1.5),
        near("settling at 0 rpm", 2.6, m.settle_ms, "ms", absolute=0.3),
        at_most("peak i_d at 0 rpm", m.i_d_a, 0.01, "A", expected=0.0),
    )
    return _figure(LOW_RPM, SIMULATION, seed, checks)


def figure_8(seed: int) -> Reproduction:
    """Fig. 8: linear range at 400 rpm, simulation."""
    low, high = _pair(LINEAR, SIMULATION, STAIRS, seed)
    printed = measured(response(PRINTED, HIGH_RPM, seed=seed))
    blind = measured(response(PRINTED, LOW_RPM, seed=seed))
    checks = (
        at_most("overshoot at 400 rpm", high.over, 20.5, "%", expected=18.7),
        Check("peak i_d at 400 rpm", 0.18, high.i_d_a, "A", 0.1, 0.45, EXPECTED),
        near(
            "settling, 400 rpm over 0 rpm",
            1.0,
            high.settle_ms / low.settle_ms,
            "1",
            absolute=0.12,
            where="section IV.C",
        ),
        at_least("(15) as printed: settling at 400 rpm", min(printed.settle_ms, 1e3), 19.9, "ms"),
        at_least("(15) as printed: peak i_d at 400 rpm", printed.i_d_a, 3.0, "A", expected=8.2),
        near("(15) as printed: overshoot at 0 rpm", 18.5, blind.over, "%", absolute=1.5),
    )
    return _figure(HIGH_RPM, SIMULATION, seed, checks)


def figure_9(seed: int) -> Reproduction:
    """Fig. 9: the experiment at 0 rpm, here on the whole simulated drive: the phase oscillates where V_a is small."""
    r = response(LINEAR, LOW_RPM, EXPERIMENT, seed=seed)
    rest = phase_step_rms(r, LEAD_S + 3.5 * EACH_S)
    checks = (
        at_least("rms phase step at 0 N m, 0 rpm", rest, 0.2, "rad", expected=0.5, where="Fig. 9 (d); " + EXPECTED),
    )
    return _figure(LOW_RPM, EXPERIMENT, seed, checks)


def figure_10(seed: int) -> Reproduction:
    """Fig. 10: the experiment at 400 rpm: no oscillation."""
    r = response(LINEAR, HIGH_RPM, EXPERIMENT, seed=seed)
    rest = phase_step_rms(r, LEAD_S + 3.5 * EACH_S)
    checks = (
        at_most(
            "rms phase step at 0 N m, 400 rpm", rest, 0.05, "rad", expected=0.0143, where="Fig. 10 (d); " + EXPECTED
        ),
    )
    return _figure(HIGH_RPM, EXPERIMENT, seed, checks)


def compared(seed: int) -> Reproduction:
    """Every linear-range law in the scenario of Figs 7 and 8, with reversals, twice the torque and a delay."""
    table, found = _stairs(LAWS, SIMULATION, seed)
    with_delay, late = _stairs(LAWS, DELAYED, seed)
    rows = []
    for law in (LINEAR, REGULARISED, UNIFIED_TUNED, *BASELINES):
        for factor, bench in ((1.0, SIMULATION), (2.0, SIMULATION), (2.0, DELAYED)):
            levels = [factor * level for level in REVERSAL]
            delay = ", one period of delay" if bench is DELAYED else ""
            rows.append(_row(f"{law.name}: +-{factor:g} N m{delay}", _pair(law, bench, levels, seed)))
    reversals = Table("reversals of the torque, worst step", _COLUMNS, tuple(rows))
    checks: list[Check] = []
    for law in (REGULARISED, UNIFIED_TUNED):
        low, high = found[law.name]
        checks += [
            at_most(f"{law.name}: overshoot, 400 against 0 rpm", abs(high.over - low.over), 0.5, "%", expected=0.0),
            at_most(f"{law.name}: overshoot at 400 rpm", high.over, 3.5, "%", expected=2.8),
            at_most(f"{law.name}: i_d at 400 rpm, of the step", high.i_d_percent, 1.0, "%", expected=0.7),
        ]
        worst, same = (max(one.over for one in runs[law.name]) for runs in (late, found))
        checks.append(at_most(f"{law.name}: overshoot, delayed", worst, 4.0, "%", expected=same, where="without delay"))
    shown = (LINEAR, REGULARISED, UNIFIED_TUNED, *BASELINES)
    runs = [(law.name, response(law, HIGH_RPM, seed=seed)) for law in shown]
    t = 1e3 * (runs[0][1].t - LEAD_S)
    plots = (
        Panel("400 rpm, q-axis current", "time / ms", "i_q / A", tuple(Series(name, t, r.i_q) for name, r in runs)),
        Panel("400 rpm, d-axis current", "time / ms", "i_d / A", tuple(Series(name, t, r.i_d) for name, r in runs)),
    )
    return Reproduction(SOURCE, (table, with_delay, reversals), plots, tuple(checks), ASSUMED)


# ---- noise at zero voltage -------------------------------------------------------------------------------------

REST_S, SKIPPED_S = 0.25, 0.08
SPIKE_LEAD_S, SPIKE_S = 0.03, 0.01
NOISY_LAWS = (LINEAR, REGULARISED, REGULARISED_WIDE, UNIFIED_TUNED, *BASELINES)


@dataclass(frozen=True, slots=True)
class AtRest:
    """Ripple at standstill with noise: rms phase step (rad), std of i_d and i_q (A), largest |i_d| of steps (A)."""

    phase_rad: float
    i_d_a: float
    i_q_a: float
    spikes_a: tuple[float, ...]


def at_rest(law: Controller, torque_nm: float, realisations: int, spikes: int, seed: int, rpm: float = 0.0) -> AtRest:
    """Return the means over noise realisations, and the spike of i_d in each of several 1 N m steps."""
    rows = []
    for k in range(realisations):
        r = run(law, QUIET_NOISY, [(0.0, torque_nm)], [(0.0, rpm)], REST_S, seed=seed + 1 + k)
        kept = slice(r.index(SKIPPED_S), None)
        rows.append((phase_step_rms(r, SKIPPED_S), r.i_d[kept].std(), r.i_q[kept].std()))
    phase, i_d, i_q = np.mean(rows, axis=0)
    step = steps([(0.0, 0.0), (SPIKE_LEAD_S, 1.0)])
    seen = []
    for k in range(spikes):
        r = run(law, QUIET_NOISY, step, [(0.0, rpm)], SPIKE_LEAD_S + SPIKE_S, seed=seed + 100 + k)
        seen.append(float(np.abs(r.i_d[r.index(SPIKE_LEAD_S) :]).max()))
    return AtRest(float(phase), float(i_d), float(i_q), tuple(seen))


def at_zero_voltage(seed: int, realisations: int = 16, spikes: int = 30) -> Reproduction:
    """Phase oscillation, current ripple and step spikes at standstill, 0.05 A of noise per axis."""
    columns = (
        Column("controller"),
        Column("torque", "N m", 2),
        Column("speed", "rpm", 3),
        Column("rms phase step", "rad", 3),
        Column("std of i_d", "A", 3),
        Column("std of i_q", "A", 3),
        Column("i_d spike, median", "A", 2),
        Column("i_d spike, largest", "A", 2),
    )
    found = {law.name: at_rest(law, 0.0, realisations, spikes, seed) for law in NOISY_LAWS}
    rows: list[tuple[str | float | None, ...]] = [
        (name, 0.0, 0.0, m.phase_rad, m.i_d_a, m.i_q_a, float(np.median(m.spikes_a)), max(m.spikes_a))
        for name, m in found.items()
    ]
    for torque, rpm in ((0.1, 0.0), (0.0, HIGH_RPM)):
        for law in NOISY_LAWS:
            m = at_rest(law, torque, realisations, 0, seed, rpm)
            rows.append((law.name, torque, rpm, m.phase_rad, m.i_d_a, m.i_q_a, None, None))
    papers = found[LINEAR.name]
    checks = [
        near("paper's law: rms phase step", 0.50, papers.phase_rad, "rad", relative=0.3),
        near("paper's law: std of i_d", 0.0303, papers.i_d_a, "A", relative=0.3),
    ]
    for law in (REGULARISED, UNIFIED_TUNED):
        m = found[law.name]
        checks += [
            at_most(f"{law.name}: phase step / paper's", m.phase_rad / papers.phase_rad, 1 / 15, "1"),
            at_most(f"{law.name}: std of i_d / paper's", m.i_d_a / papers.i_d_a, 1.0, "1"),
            at_most(f"{law.name}: std of i_q / paper's", m.i_q_a / papers.i_q_a, 1.0, "1"),
            at_most(f"{law.name}: largest i_d spike", max(m.spikes_a), 0.12, "A", expected=0.07),
        ]
    plots = tuple(
        Panel(law.name, "time / ms", "delta / rad", (Series("delta", 1e3 * r.t, r.delta),))
        for law in (LINEAR, UNIFIED_TUNED)
        for r in (run(law, QUIET_NOISY, steps([(0.0, 0.0), (0.05, 1.0)]), [(0.0, 0.0)], 0.1, seed=seed),)
    )
    notes = (
        *ASSUMED,
        "means over noise realisations; V_a = 0 at standstill without torque is the uncontrollable point of (13)",
    )
    return Reproduction(
        SOURCE,
        (Table("0.05 A of noise per axis, no delay", columns, tuple(rows)),),
        plots,
        tuple(checks),
        notes,
    )
