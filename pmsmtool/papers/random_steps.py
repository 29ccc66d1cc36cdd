# SPDX-License-Identifier: MIT
"""Random current steps: reachable ones against minimum time, unreachable ones, a plant that is not the model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.design.governor import EPS_LEAST
from pmsmtool.papers.figure import Cell, Check, Column, Panel, Reproduction, Series, Table, at_most
from pmsmtool.papers.governed_drive import (
    DELAYED,
    FAST,
    MODULUS_OPTIMUM,
    NOISE_APK,
    NOMINAL,
    TABLE_2A,
    TABLE_2B,
    Condition,
    GovernedDrive,
    Law,
    plant_of,
)
from pmsmtool.papers.random_cases import (
    SLOW_S,
    Case,
    Outcome,
    Pair,
    feasible_for,
    least_time_s,
    nearest_held,
    reachable,
    run_cases,
    unreachable,
)
from pmsmtool.papers.registry import JERCIC
from pmsmtool.papers.statistics import BAND, difference_table, lower_end

EPS = 1e-3
OURS = "no figure of the paper; conditions of its section 5, " + JERCIC
BACK = Law("back-calculation")
BEST = Law("best", "best", eps=EPS_LEAST)
PAPER = Law("paper", "paper", alpha=MODULUS_OPTIMUM, eps=EPS)
I_MAX_A = 56.0
"""Current limit of the profile (A)."""
WIDE_A = 80.0
"""Transient current limit of the laws that are judged against the voltage alone (A)."""

NOISY = replace(DELAYED, name="delay, predictor, noise", noise=True)
NOISE_BAND_A = 4.0 * NOISE_APK
"""Added to the band where the samples are noisy (A)."""

VOLTAGE_LIMIT = 1e-5
"""Relative excess of the demanded voltage in binary32; measured 9e-7."""

DURATION_S = 0.04


def random_steps(seed: int, cases: int = 300) -> Reproduction:
    """Return settling over minimum time on random reachable steps, paired with back-calculation."""
    drawn = reachable(cases, seed)
    least = np.array([least_time_s(case) for case in drawn])
    rows: list[tuple[Cell, ...]] = []
    checks: list[Check] = []
    outcomes: dict[tuple[str, float, str], Outcome] = {}
    laws = (
        PAPER, replace(BACK, alpha=MODULUS_OPTIMUM), BEST, Law("line search", "line", eps=EPS),
        replace(PAPER, alpha=FAST), BACK,
    )  # fmt: skip
    for condition in (NOMINAL, DELAYED, NOISY):
        for law in laws:
            found = _outcome(law, condition, drawn, seed)
            outcomes[law.name, law.alpha, condition.name] = found
            rows.append((*_names(law, condition), *_ratios(found, least), _peak(found), float(found.demand.max())))
            checks += _step_checks(law, condition, found, least)
    slow = least > SLOW_S
    pairs = []
    for condition in (NOMINAL, DELAYED, NOISY):
        for law in (PAPER, replace(PAPER, alpha=FAST), BEST):
            a, b = (outcomes[name, law.alpha, condition.name] for name in (law.name, "back-calculation"))
            names = (f"{law.name} {law.alpha:g}, {condition.name}", "back-calculation")
            pairs.append((*names, (a.settling_s / least)[slow], (b.settling_s / least)[slow]))
    heads = (
        Column("law"), Column("alpha", "rad/s"), Column("condition"), Column("unsettled"),
        Column("median"), Column("p95"), Column("largest"),
        Column("median, all"), Column("p95, all"), Column("peak |i|", "A"), Column("demand/V_max"),
    )  # fmt: skip
    table = Table(
        f'settling to 2 % over T_min, {cases} random reachable steps; without "all": the {int(slow.sum())} with '
        f"T_min > {1e3 * SLOW_S:g} ms",
        heads,
        tuple(rows),
    )
    differences = difference_table("settling over T_min, T_min > 1 ms", pairs, np.random.default_rng(seed))
    panel = _distribution(outcomes, least, slow)
    return Reproduction(
        OURS, (table, differences),
        (panel,), tuple(checks), _notes(),
    )  # fmt: skip


def _notes() -> tuple[str, ...]:
    return (
        "steps longer than 10 A between currents in the 56 A disc, speed within 1000 rpm, 5 % at standstill; "
        "|v_ss| at most 0.98 V_max before and 0.92 V_max after; V_dc 210 V, circle",
        "settling: the first sample from which on the vector stays within 2 % of the step",
        f"with noise ({NOISE_APK:g} A rms, 0.05 A grid) the band is {NOISE_BAND_A:g} A wider",
        "a difference counts only where its interval leaves out zero",
        "paper mode: its p95 over 1459 such steps is 1.410 (1.384 to 1.455), over the some 140 of one seed 1.33 to "
        "1.58 by chance (seeds 1 to 10: 1.35 to 1.52), so the lower end of its bootstrap interval is checked",
        "that tail is the law's own: back-calculation has 1.448, the best mode at the same bandwidth 1.292 "
        "(benchmarks/tables/settling_tail.txt)",
    )


def _outcome(law: Law, condition: Condition, cases: Sequence[Case], seed: int) -> Outcome:
    wider = NOISE_BAND_A if condition.noise else 0.0
    bands = [BAND * case.size + wider for case in cases]
    return run_cases(GovernedDrive(law, condition, seed), cases, [case.target for case in cases], bands, DURATION_S)


def _names(law: Law, condition: Condition) -> tuple[str, float, str]:
    return law.name, law.alpha, condition.name


def _ratios(found: Outcome, least: Array) -> tuple[float, ...]:
    slow = least > SLOW_S
    ratio = found.settling_s / least
    return (
        int(np.isinf(ratio).sum()), float(np.median(ratio[slow])), float(np.percentile(ratio[slow], 95.0)),
        float(ratio[slow].max()), float(np.median(ratio)), float(np.percentile(ratio, 95.0)),
    )  # fmt: skip


def _peak(found: Outcome) -> float:
    return float(found.peak_a.max())


RESAMPLING_SEED = 1
RATIO_LIMITS = {
    ("paper", MODULUS_OPTIMUM, NOMINAL.name): (1.25, 1.40),
    ("best", FAST, NOMINAL.name): (1.06, 1.10),
    ("best", FAST, DELAYED.name): (1.11, 1.18),
}
"""Median and 95th percentile of settling over minimum time that must hold, steps with T_min > 1 ms."""


def _step_checks(law: Law, condition: Condition, found: Outcome, least: Array) -> list[Check]:
    checks = []
    if law.governor != "off":
        checks.append(_demand_check(law, condition, found))
    limits = RATIO_LIMITS.get(_names(law, condition))
    if limits is not None:
        ratio = (found.settling_s / least)[least > SLOW_S]
        what = f"{law.name}, {law.alpha:g} rad/s, {condition.name}: settling / T_min"
        checks += [
            at_most(f"{what}, median", float(np.median(ratio)), limits[0], "1"),
        ]
        if law.governor == "paper":
            low = lower_end(ratio, "p95", np.random.default_rng(RESAMPLING_SEED))
            name = f"{what}, p95, lower end of its interval"
            checks.append(at_most(name, low, limits[1], "1"))
        else:
            p95 = float(np.percentile(ratio, 95.0))
            checks.append(at_most(f"{what}, p95", p95, limits[1], "1"))
    return checks


def _demand_check(law: Law, condition: Condition, found: Outcome) -> Check:
    what = f"{law.name}, {law.alpha:g} rad/s, {condition.name}: demanded voltage / V_max"
    return at_most(what, float(found.demand.max()), 1.0 + VOLTAGE_LIMIT, "1", where="(18)")


def _distribution(outcomes: dict[tuple[str, float, str], Outcome], least: Array, slow: NDArray[np.bool_]) -> Panel:
    series = []
    for (name, alpha, condition), found in outcomes.items():
        if condition == NOMINAL.name:
            ratio = np.sort((found.settling_s / least)[slow])
            series.append(Series(f"{name}, {alpha:g} rad/s", ratio, np.arange(1, len(ratio) + 1) / len(ratio)))
    return Panel(
        "distribution over the steps with T_min > 1 ms, no delay", "settling / T_min", "share of the steps",
        tuple(series), x_range=(1.0, 2.0),
    )  # fmt: skip


# -- unreachable references --------------------------------------------------------------------------------------

HOLD_S = 0.1
UNREACHABLE_P95_MS, CORNER_P95_MS = 6.0, 7.0
"""95th percentile of the settling time that must hold in best mode with the voltage alone in the way (measured 5.1 to
5.6, seeds 1 to 6), and with the current row at I_max besides (5.6 to 6.2: the way is then bound to 56 A)."""
BAND_LEAST_A = 0.2


WANDER_A = 2.5
"""Largest error (A) of the best mode 100 ms after the step; measured 0.8 with noisy samples: the observer's noise moves
the steady-state row, on which the reference then stands."""


def unreachable_references(seed: int, cases: int = 300) -> Reproduction:
    """Return how laws settle when the reference asks for more voltage than there is."""
    drawn = unreachable(cases, seed)
    best = (BEST, replace(BEST, I_transient_apk=WIDE_A))
    others = (
        replace(best[1], governor="line", name="line search"), replace(PAPER, eps=1e-2), PAPER, BACK,
        Law("plain clipping", anti_windup=False),
    )  # fmt: skip
    rows, checks, times, panels = [], [], {}, []
    ends: dict[tuple[str, str], Array] = {}
    for condition in (NOMINAL, DELAYED, NOISY):
        for law in (*best, *others) if condition == NOMINAL else (*best, BACK):
            limit = law.I_transient_apk or (math.inf if law.governor in ("off", "paper") else I_MAX_A)
            targets = [nearest_held(case, plant_of(), limit, law.eps or 0.0) for case in drawn]
            found = _held(law, condition, drawn, targets, seed)
            ms = 1e3 * found.settling_s
            label = law.name if law.I_transient_apk is None else f"{law.name}, current row {WIDE_A:g} A"
            ends[label, condition.name] = found.final_a
            late = int(np.isinf(ms).sum())
            p95 = float(np.percentile(ms, 95.0, method="higher"))
            rows.append((
                label, law.alpha, law.eps or math.nan, condition.name, int((ms > 20.0).sum()), late,
                float(np.median(ms)), p95, float(found.final_a.max()), _peak(found),
            ))  # fmt: skip
            if law.governor == "best":
                checks.append(_demand_check(replace(law, name=label), condition, found))
                limit_ms = UNREACHABLE_P95_MS if law.I_transient_apk else CORNER_P95_MS
                checks += _unreachable_checks(f"{label}, {condition.name}", condition, late, (p95, limit_ms), found)
            if condition == NOMINAL:
                times[label if law.eps is None else f"{label}, eps {law.eps:g}"] = np.sort(np.minimum(ms, 1e3 * HOLD_S))
    share = np.arange(1, cases + 1) / cases
    panels.append(
        Panel(
            "no delay; 100 ms: not settled", "settling / ms", "share of the cases",
            tuple(Series(name, ms, share) for name, ms in times.items()), x_log=True, x_range=(0.1, 1e3 * HOLD_S),
        )
    )  # fmt: skip
    heads = (
        Column("law"), Column("alpha", "rad/s"), Column("eps"), Column("condition"), Column("> 20 ms"),
        Column("> 100 ms"), Column("median", "ms"), Column("p95", "ms"), Column("largest error at the end", "A"),
        Column("peak |i|", "A"),
    )  # fmt: skip
    title = f"{cases} references beyond V_max; band 2 % or {BAND_LEAST_A} A around the nearest held current"
    table = Table(title, heads, tuple(rows))
    pairs = [
        (f"best, {name}", BACK.name, ends[BEST.name, name], ends[BACK.name, name])
        for name in (NOMINAL.name, DELAYED.name, NOISY.name)
    ]
    differences = difference_table("error after 100 ms", pairs, np.random.default_rng(seed), "A")
    notes = (
        "target: the current nearest to the reference that (1 - eps) V_max holds, inside the current row where the law "
        "has one",
        "the paper's governor stalls on its steady-state row, the slower the smaller eps; without pre-projection its "
        "reference crawls along the boundary",
        "back-calculation and clipping do not know where to go: their error stays",
        "with noise the observer moves the steady-state row by some tenths of a volt, and what stands on it wanders",
    )
    return Reproduction(
        OURS, (table, differences),
        tuple(panels), tuple(checks), notes,
    )  # fmt: skip


def _unreachable_checks(
    name: str, condition: Condition, late: int, p95_ms: tuple[float, float], found: Outcome
) -> list[Check]:
    checks = [at_most(f"{name}: error after 100 ms", float(found.final_a.max()), WANDER_A, "A")]
    if condition.noise:
        return checks
    checks.append(at_most(f"{name}: unsettled after 100 ms", late, 0, "cases"))
    if condition == NOMINAL:
        what = f"{name}: p95 of settling"
        checks.append(at_most(what, p95_ms[0], p95_ms[1], "ms"))
    return checks


def _held(law: Law, condition: Condition, cases: Sequence[Case], targets: Sequence[Pair], seed: int) -> Outcome:
    wider = NOISE_BAND_A if condition.noise else 0.0
    bands = [
        max(BAND_LEAST_A, BAND * math.dist(case.start, target)) + wider
        for case, target in zip(cases, targets, strict=True)
    ]
    return run_cases(GovernedDrive(law, condition, seed), cases, targets, bands, HOLD_S)


# -- plant mismatch ------------------------------------------------------------------------------------------------

MISMATCHES = (
    TABLE_2A,
    Condition("1.43 L", L=1.43),
    TABLE_2B,
    Condition("1.1 psi", psi=1.1),
    Condition("1.5 R", R=1.5),
)
CONVERGED_A = 1.0
MISMATCH_S = 0.06


def plant_mismatch(seed: int, cases: int = 300) -> Reproduction:
    """Return which laws reach their reference on a plant that is not the model."""
    rows, checks, pairs = [], [], []
    for condition in MISMATCHES:
        outcomes: dict[tuple[str, bool], Outcome] = {}
        drawn = feasible_for(plant_of(condition), cases, seed)
        targets = [case.target for case in drawn]
        bands = [BAND * case.size for case in drawn]
        for law, delayed in ((BEST, False), (BEST, True), (PAPER, False), (BACK, False), (BACK, True)):
            case = replace(condition, delayed=delayed)
            found = run_cases(GovernedDrive(law, case, seed), drawn, targets, bands, MISMATCH_S)
            outcomes[law.name, delayed] = found
            lost = int((found.final_a > CONVERGED_A).sum())
            rows.append((
                condition.name, law.name, law.alpha, "yes" if delayed else "no", lost, float(found.final_a.max()),
                _peak(found), float(found.demand.max()),
            ))  # fmt: skip
            if law.governor == "best":
                name = f"{condition.name}{', delayed' if delayed else ''}"
                checks.append(at_most(f"best, {name}: not converged", lost, 0, "cases"))
                checks.append(_demand_check(law, replace(condition, name=name), found))
        for delayed in (False, True):
            best, back = (outcomes[law.name, delayed] for law in (BEST, BACK))
            name = f"best, {condition.name}{', delayed' if delayed else ''}"
            pairs.append((name, "back-calculation", 1e3 * best.settling_s, 1e3 * back.settling_s))
    heads = (
        Column("plant"), Column("law"), Column("alpha", "rad/s"), Column("delay, predictor"), Column("not converged"),
        Column("largest error at the end", "A"), Column("peak |i|", "A"), Column("demand/V_max"),
    )  # fmt: skip
    table = Table(f"{cases} random steps per plant, reference feasible for the plant; error after 60 ms", heads,
                  tuple(rows))  # fmt: skip
    differences = difference_table("settling to 2 %", pairs, np.random.default_rng(seed), "ms")
    notes = (
        "the paper's rows carry no disturbance: they see the nominal flux and veto currents the plant could hold",
        "the offset-free rows of the best mode take what the integrators or the observer hold for constant",
    )
    return Reproduction(
        OURS,
        (table, differences),
        (),
        tuple(checks),
        notes,
    )


# -- the voltage limit itself ----------------------------------------------------------------------------------

VOLTAGE_S = 0.01


def voltage_limit(seed: int, cases: int = 1000) -> Reproduction:
    """Return the largest demanded and applied voltage over random steps, reachable or not."""
    drawn = (*reachable(cases // 2, seed + 1), *unreachable(cases - cases // 2, seed + 1))
    targets = [case.target for case in drawn]
    bands = [BAND * case.size for case in drawn]
    rows, checks = [], []
    for condition in (NOMINAL, DELAYED, NOISY, TABLE_2A, TABLE_2B):
        for law in (BEST, PAPER, Law("line search", "line", eps=EPS), BACK):
            found = run_cases(GovernedDrive(law, condition, seed), drawn, targets, bands, VOLTAGE_S)
            over = int((found.demand > 1.0 + VOLTAGE_LIMIT).sum())
            rows.append((law.name, condition.name, over, float(found.demand.max()), float(found.applied.max())))
            if law.governor != "off":
                checks.append(_demand_check(law, condition, found))
                name = f"{law.name}, {condition.name}: applied voltage / V_max"
                checks.append(at_most(name, float(found.applied.max()), 1.0 + APPLIED_LIMIT, "1"))
    heads = (
        Column("law"), Column("condition"), Column("cases over"), Column("demand/V_max", "", 8),
        Column("applied/V_max", "", 8),
    )  # fmt: skip
    table = Table(f"{cases} random steps, half of them to unreachable currents, 10 ms each", heads, tuple(rows))
    notes = ("a check only: row 0 can always be met, and the applied voltage is limited whatever is demanded",)
    return Reproduction(OURS, (table,), (), tuple(checks), notes)


APPLIED_LIMIT = 1e-6
"""Relative excess of the applied voltage in binary32; measured 1.3e-7."""
