# SPDX-License-Identifier: MIT
"""The experiments of Jercic et al. 2017, figures 10 (b) and 12 (b), on the simulated whole drive.

Where the simulations (a) have ideal sensors and an ideal inverter, here the drive's whole firmware runs on the switched
bridge of the profile with dead time and drops, noisy 12-bit samples, an encoder, and one period of computation delay.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.papers.current_step import EPS, SHOWN_S
from pmsmtool.papers.figure import Check, Column, Panel, Reproduction, Series, Table, at_least, at_most
from pmsmtool.papers.governed_drive import (
    MODULUS_OPTIMUM,
    NOMINAL,
    GovernedDrive,
    Law,
    Response,
    V_max,
    law_values,
    source,
)
from pmsmtool.papers.registry import JERCIC
from pmsmtool.papers.statistics import overshoot, settling_s
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

WHOLE = replace(NOMINAL, name="whole drive", delayed=True, whole=True)
LAWS = (
    Law("paper", "paper", alpha=MODULUS_OPTIMUM, eps=EPS),
    Law("best", "best", alpha=MODULUS_OPTIMUM, eps=EPS),
    Law("back-calculation", alpha=MODULUS_OPTIMUM),
)
SPEEDS_RPM, TARGET, LENGTH_S = (310.0, 620.0), (0.0, 28.0), 0.060
REPEATS = 8
"""Steps with other noise, at other angles of the rotor."""
BAND = 0.05
"""Of the step: the mean current is 0.1 A off at its end (offsets, what is left of the dead time), so that the 2 % of
the simulation are reached by chance."""
OVERSHOOT, REST_NOISE_A, BEST_SHARE = 1.0, 0.15, 0.6
"""Overshoot (%), deviation of i_q at rest (A), and at the higher speed, where the voltage decides, settling of the best
governor over that without one, that must hold; measured 0.31, 0.066 and 0.44."""
UNCOMPENSATED_LEAST = 5.0
"""Voltage over V_m (%) that the uncompensated law commands at least; measured 7.9, of the compensated one 0.65."""


def experiments(seed: int) -> Reproduction:
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
            seen = [drive.step(rpm, (0.0, 0.0), TARGET, LENGTH_S) for _ in range(REPEATS)]
            times = [1e3 * settling_s(one.i, TARGET, BAND * TARGET[1], one.T_s) for one in seen]
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
