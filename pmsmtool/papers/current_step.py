# SPDX-License-Identifier: MIT
"""Figures 10 and 12 (b) of Jercic et al. 2017: a step of i_q under a voltage limit, by its governor and by others.

The experiments, figures 10 (b) and 12 (b), are on the simulated whole drive: where the simulations (a) have ideal
sensors and an ideal inverter, the drive's whole firmware runs on the switched bridge of the profile with dead time and
drops, noisy 12-bit samples, an encoder, and one period of computation delay.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.design.minimum_time import TransferProblem, minimum_time
from pmsmtool.papers.figure import (
    Check,
    Column,
    Panel,
    Reproduction,
    Series,
    Table,
    at_least,
    at_most,
)
from pmsmtool.papers.governed_drive import (
    DELAYED,
    MODULUS_OPTIMUM,
    NOMINAL,
    Condition,
    GovernedDrive,
    Law,
    Plant,
    Response,
    V_max,
    law_values,
    source,
)
from pmsmtool.papers.registry import JERCIC
from pmsmtool.papers.statistics import BAND, overshoot, settling_s
from pmsmtool.papers.weakening import (
    BEGIN_S,
    COMPENSATED,
    COMPENSATED_RAMP,
    CURRENT_A,
    MARGIN,
    SWEEP_S,
    TORQUE_NM,
    UNCOMPENSATED,
    Sweep,
    sweep,
)
from pmsmtool.units import RAD_S_PER_RPM

EPS = 1e-3
"""Tightening of the steady-state row in all laws of a comparison."""

Pair = tuple[float, float]
STEPS: tuple[tuple[float, Pair, Pair], ...] = (
    (0.0, (0.0, 0.0), (0.0, 28.0)),
    (310.0, (0.0, 0.0), (0.0, 28.0)),
    (620.0, (0.0, 0.0), (0.0, 28.0)),
    (800.0, (-40.0, 0.0), (-40.0, 28.0)),
)
"""Speed (rpm), current before and after (A)."""

SHOWN_S, LENGTH_S = 0.010, 0.060

REFERENCE_MS = {"paper": (0.92, 1.25, 4.92, 5.67), "best": (0.92, 1.25, 3.75, 3.5)}
"""Settling times (ms) computed independently under the same conditions; one period of slack is allowed."""
OVERSHOOT_LIMIT = 1e-3
"""Of the step; measured 5e-5."""


def laws(alpha: float) -> tuple[Law, ...]:
    """Return the laws of the comparison at one bandwidth."""
    plain = Law("plain clipping", anti_windup=False, alpha=alpha)
    return (
        Law("paper", "paper", alpha=alpha, eps=EPS),
        Law("best", "best", alpha=alpha, eps=EPS),
        Law("line search", "line", alpha=alpha, eps=EPS),
        Law("linearised [18]", "linearised", alpha=alpha, eps=EPS),
        Law("back-calculation", alpha=alpha),
        plain,
    )


def transfer(plant: Plant, rpm: float) -> TransferProblem:
    """Return the minimum-time problem of a plant at a speed, V_dc as in the profile."""
    return TransferProblem(plant.R, plant.L_d, plant.L_q, plant.psi, RAD_S_PER_RPM * plant.pole_pairs * rpm, V_max())


@cache
def bounds(problem: TransferProblem, start: Pair, target: Pair, band_a: float, theta_e: float) -> tuple[float, float]:
    """Return the least times (s) to a ball around the target in the circle and in the hexagon."""
    circle = minimum_time(problem, start, target, radius=band_a)
    return circle, minimum_time(problem, start, target, radius=band_a, voltage="hexagon", theta_e=theta_e)


def q_steps(seed: int) -> Reproduction:
    """Step i_q from 0 to 28 A at four speeds with every law, without and with computation delay."""
    rows, checks, panels = [], [], []
    for condition in (NOMINAL, DELAYED):
        shown: dict[float, list[tuple[Law, Response]]] = {}
        for law in (*laws(MODULUS_OPTIMUM), replace(laws(MODULUS_OPTIMUM)[1], name="best, hexagon", hexagon=True)):
            drive = GovernedDrive(law, condition, seed)
            for rpm, start, target in STEPS:
                response = drive.step(rpm, start, target, LENGTH_S)
                row = _row(law, condition, drive.plant, rpm, start, target, response)
                rows.append(row)
                shown.setdefault(rpm, []).append((law, response))
                if condition == NOMINAL:
                    checks += _checks(law, rpm, row, response.T_s)
        if condition == NOMINAL:
            panels = _panels(shown[620.0])
    heads = (
        Column("law"), Column("condition"), Column("speed", "rpm"), Column("settling 2 %", "ms"),
        Column("overshoot", "%", 2), Column("demand/V_max"), Column("peak |i|", "A"),
        Column("T_min circle", "ms"), Column("ratio"), Column("T_min hexagon", "ms"), Column("ratio hexagon"),
    )  # fmt: skip
    table = Table(
        "step of i_q from 0 to 28 A, i_d = 0 (800 rpm: i_d = -40 A); 2 % of the step, vector", heads, tuple(rows)
    )
    eps_by_tune = law_values(Law("", "paper", alpha=MODULUS_OPTIMUM), False)["governor.eps"]
    notes = (
        f"V_dc {source().inverter.U_dc_v:g} V (not printed), V_max {V_max():.5g} V; alpha {MODULUS_OPTIMUM:g} rad/s in "
        "all laws, pole-zero cancellation; ideal averaged inverter and ideal sensors",
        f"eps {EPS:g} in all governors (tune chooses {eps_by_tune:.3g}); best: offset-free rows, pre-projection, "
        "current row at I_max = 56 A, minimum-time direction; all laws but the last of each group keep to the circle",
        "T_min: least time to the 2 % ball under the voltage limit, as circle and as hexagon at the angle of the step",
        "linearised: octagon inscribed in the circle, the faces of [18] are not printed here",
        "the paper prints no numbers for this figure: checked against an independent computation of the same case",
    )
    return Reproduction(
        f"{JERCIC}, figure 10",
        (table,),
        tuple(panels),
        tuple(checks),
        notes,
    )


def _row(
    law: Law, condition: Condition, plant: Plant, rpm: float, start: Pair, target: Pair, response: Response
) -> tuple[str | float, ...]:
    band = BAND * math.dist(start, target)
    time = settling_s(response.i, target, band, response.T_s)
    problem = transfer(plant, rpm)
    theta = round(float(response.theta_e[0]), 9)
    circle, hexagon = bounds(problem, start, target, band, theta)
    return (
        law.name, condition.name, rpm, 1e3 * time, 100.0 * overshoot(response.i, start, target),
        float(np.hypot(*response.demanded.T).max()) / V_max(), float(np.hypot(*response.i.T).max()),
        1e3 * circle, math.nan if law.hexagon else time / circle, 1e3 * hexagon, time / hexagon,
    )  # fmt: skip


def _checks(law: Law, rpm: float, row: tuple[str | float, ...], T_s: float) -> list[Check]:
    if law.name not in REFERENCE_MS:
        return []
    speed = [rpm for rpm, _, _ in STEPS].index(rpm)
    expected, time, past, demand, circle = REFERENCE_MS[law.name][speed], *(float(row[k]) for k in (3, 4, 5, 7))
    what, where = f"{law.name}, {rpm:g} rpm", "derived: independent computation of the case of fig. 10"
    return [
        at_most(f"settling, {what}", time, expected + 1e3 * T_s, "ms", expected=expected, where=where),
        at_least(f"settling, {what}: not below T_min - T_s", time, circle - 1e3 * T_s, "ms", where="physics"),
        at_most(f"overshoot, {what}", past, 100.0 * OVERSHOOT_LIMIT, "%", where=where),
        at_most(f"demanded voltage / V_max, {what}", demand, 1.0 + 1e-5, "1", where="(18)"),
    ]


def _panels(shown: list[tuple[Law, Response]]) -> list[Panel]:
    currents, references, voltages = [], [], []
    for colour, (law, response) in enumerate(shown):
        n = round(SHOWN_S / response.T_s)
        t = 1e3 * response.t_s[:n]
        currents.append(Series(law.name, t, response.i[:n, 1], "-", colour))
        if law.governor != "off":
            references.append(Series(f"{law.name}", t, response.reference[:n, 1], "-", colour))
        voltages.append(Series(law.name, t, np.hypot(*response.demanded[:n].T), "-", colour))
    ends = np.array([0.0, 1e3 * SHOWN_S])
    limit = Series("V_max", ends, np.full(2, V_max()), ":", -1)
    asked = Series("requested", ends, np.full(2, 28.0), "--", -1)
    return [
        Panel("current, 620 rpm, no computation delay", "time / ms", "i_q / A", (*currents, asked)),
        Panel("governed reference i_q**", "time / ms", "i_q / A", tuple(references), y_range=(-10.0, 40.0)),
        Panel("demanded voltage", "time / ms", "|v| / V", (*voltages, limit), y_range=(0.0, 2.9 * V_max())),
    ]


WHOLE = replace(NOMINAL, name="whole drive", delayed=True, whole=True)
LAWS = (
    Law("paper", "paper", alpha=MODULUS_OPTIMUM, eps=EPS),
    Law("best", "best", alpha=MODULUS_OPTIMUM, eps=EPS),
    Law("back-calculation", alpha=MODULUS_OPTIMUM),
)
SPEEDS_RPM, TARGET, WHOLE_LENGTH_S = (310.0, 620.0), (0.0, 28.0), 0.060
REPEATS = 8
"""Steps with other noise, at other angles of the rotor."""
WHOLE_BAND = 0.05
"""Of the step: the mean current is 0.1 A off at its end (offsets, what is left of the dead time), so that the 2 % of
the simulation are reached by chance."""
OVERSHOOT, REST_NOISE_A, BEST_SHARE = 1.0, 0.15, 0.6
"""Overshoot (%), deviation of i_q at rest (A), and at the higher speed, where the voltage decides, settling of the best
governor over that without one, that must hold; measured 0.31, 0.066 and 0.44."""
UNCOMPENSATED_LEAST = 5.0
"""Voltage over V_m (%) that the uncompensated law commands at least; measured 7.9, of the compensated one 0.65."""


def figures_b(seed: int) -> Reproduction:
    """Return steps of i_q and a sweep into field weakening and back, on the whole drive with noise."""
    steps, step_checks, shown = _steps(seed)
    sweeps, sweep_checks, runs = _sweeps()
    notes = (
        f"V_dc {source().inverter.U_dc_v:g} V (not printed), alpha {MODULUS_OPTIMUM:g} rad/s, one step of prediction; "
        "[simulation] of the profile: switched bridge, dead time, drops, 12 bit, noise, 17-bit encoder",
        "the paper prints no numbers for its experiments: checked is what it says of them, that the demanded voltage "
        "keeps to V_max, and field weakening to its own limit",
        "dead time and drops take a part of the commanded voltage: the machine's own stays below V_m by as much",
    )
    return Reproduction(
        f"{JERCIC}, figures 10 (b) and 12 (b)", (steps, sweeps), (*_step_panels(shown), *_sweep_panels(runs)),
        (*step_checks, *sweep_checks), notes, columns=2,
    )  # fmt: skip


def _steps(seed: int) -> tuple[Table, list[Check], dict[str, Response]]:
    rows, checks, shown = [], [], {}
    for rpm in SPEEDS_RPM:
        settled: dict[str, float] = {}
        for law in LAWS:
            drive = GovernedDrive(law, WHOLE, seed)
            seen = [drive.step(rpm, (0.0, 0.0), TARGET, WHOLE_LENGTH_S) for _ in range(REPEATS)]
            times = [1e3 * settling_s(one.i, TARGET, WHOLE_BAND * TARGET[1], one.T_s) for one in seen]
            past = 100.0 * max(overshoot(one.i, (0.0, 0.0), TARGET) for one in seen)
            demand = max(float(np.hypot(*one.demanded.T).max()) for one in seen) / V_max()
            rest = max(float(np.std(one.i[-len(one.i) // 4 :, 1])) for one in seen)
            settled[law.name] = float(np.median(times))
            rows.append((law.name, rpm, settled[law.name], max(times), past, demand, rest))
            shown[law.name] = seen[0]
            what = f"{law.name}, {rpm:g} rpm"
            checks.append(at_most(f"overshoot, {what}", past, OVERSHOOT, "%", where="fig. 10 (b)"))
            checks.append(at_most(f"deviation of i_q at rest, {what}", rest, REST_NOISE_A, "A", where="fig. 10 (b)"))
            if law.governor != "off":
                checks.append(at_most(f"demanded voltage / V_max, {what}", demand, 1.0 + 1e-5, "1", where="(18)"))
    ratio = settled["best"] / settled["back-calculation"]
    checks.append(at_most(f"settling of best over back-calculation, {rpm:g} rpm", ratio, BEST_SHARE, "1", where="ours"))
    heads = (
        Column("law"), Column("speed", "rpm"), Column("settling 5 %", "ms"), Column("slowest", "ms"),
        Column("overshoot", "%", 2), Column("demand/V_max"), Column("deviation at rest", "A", 2),
    )  # fmt: skip
    title = f"step of i_q from 0 to {TARGET[1]:g} A on the whole drive, median of {REPEATS}"
    return Table(title, heads, tuple(rows)), checks, shown


def _commanded(run: Sweep) -> Array:
    """Return the commanded voltage over V_m (%), the mean over a period of field weakening: what the law sees."""
    periods = round(law_values(run.law, delayed=True)["field_weakening.N_fw"])
    amplitude = np.hypot(*run.response.applied.T) / ((1.0 - MARGIN) * V_max())
    return np.asarray(100.0 * (np.convolve(amplitude, np.ones(periods) / periods, mode="same") - 1.0))


def _sweeps() -> tuple[Table, list[Check], list[Sweep]]:
    rows, checks = [], []
    runs = [sweep(law, WHOLE, SWEEP_S, SWEEP_S[-1][0]) for law in (COMPENSATED, UNCOMPENSATED)]
    for run in runs:
        begin = round(BEGIN_S / run.response.T_s)
        inner = slice(begin, -begin)
        over, demand = float(_commanded(run)[inner].max()), float(np.hypot(*run.response.demanded.T).max()) / V_max()
        i, current = run.response.i, float(np.hypot(*run.response.i.T).max())
        lost = float(np.abs(run.torque_nm[inner] - TORQUE_NM).max())
        rows.append((run.law.name, over, float(run.error[inner].max()), lost, float(i[:, 0].min()), current))
        what = f"{run.law.name}: "
        checks += [
            at_most(f"{what}demanded voltage / V_max", demand, 1.0 + 1e-5, "1", where="(18)"),
            at_most(f"{what}peak current", current, CURRENT_A, "A", where="(17)"),
            at_most(f"{what}commanded over V_m", over, COMPENSATED_RAMP, "%", where="fig. 12 (b)")
            if run.law is COMPENSATED
            else at_least(f"{what}commanded over V_m", over, UNCOMPENSATED_LEAST, "%", where="fig. 11"),
        ]  # fmt: skip
    heads = (
        Column("field weakening"), Column("commanded over V_m", "%", 3), Column("machine's own over V_m", "%", 3),
        Column("largest torque error", "N m", 3), Column("least i_d", "A"), Column("peak |i|", "A"),
    )  # fmt: skip
    return Table(f"{TORQUE_NM:g} N m held, 400 to 800 rpm in 0.6 s and back", heads, tuple(rows)), checks, runs


def _step_panels(shown: dict[str, Response]) -> list[Panel]:
    currents, voltages = [], []
    for colour, (name, response) in enumerate(shown.items()):
        n = round(SHOWN_S / response.T_s)
        t = 1e3 * response.t_s[:n]
        currents.append(Series(name, t, response.i[:n, 1], "-", colour))
        voltages.append(Series(name, t, np.hypot(*response.demanded[:n].T), "-", colour))
    limit = Series("V_max", np.array([0.0, 1e3 * SHOWN_S]), np.full(2, V_max()), ":", -1)
    title = f"{SPEEDS_RPM[-1]:g} rpm, whole drive"
    return [
        Panel(title, "time / ms", "i_q / A", tuple(currents)),
        Panel("demanded voltage", "time / ms", "|v| / V", (*voltages, limit)),
    ]


def _sweep_panels(runs: list[Sweep]) -> list[Panel]:
    currents = [Series(run.law.name, run.response.t_s, run.response.i[:, 0]) for run in runs]
    voltages = [Series(run.law.name, run.response.t_s, _commanded(run)) for run in runs]
    return [
        Panel("sweep, whole drive", "time / s", "i_d / A", tuple(currents)),
        Panel("commanded voltage, mean of a period of field weakening", "time / s", "over V_m / %", tuple(voltages)),
    ]
