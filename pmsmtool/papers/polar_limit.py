# SPDX-License-Identifier: MIT
"""At and beyond the linear modulation limit: overmodulation up to six-step, and torque that no voltage can hold."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.papers.figure import Check, Column, Panel, Reproduction, Series, Table
from pmsmtool.papers.polar_scene import (
    ASSUMED,
    BASELINES,
    CONVENTIONAL,
    CONVENTIONAL_ON_MEASUREMENT,
    K_T,
    LINEAR,
    M_PER_V,
    PEAK,
    PROPOSED,
    PROPOSED_ON_MEASUREMENT,
    REGULARISED,
    SIMULATION,
    SOURCE,
    UNIFIED,
    UNIFIED_TUNED,
    V_DC,
    V_MAX,
    Controller,
    Response,
    at_most,
    machine_file,
    near,
    run,
    steps,
)
from pmsmtool.papers.statistics import peak_current_apk, settling_ms

SIX_STEP = 2.0 * math.sqrt(3.0) / math.pi
"""Fundamental of six-step operation over the largest of the linear range: (2/pi) / (1/sqrt(3)) = 1.1027."""

RATIOS = (0.98, 1.0, 1.02, 1.05, 1.1, 1.15, 1.2)
RPM, SETTLED_S = 800.0, 0.2
HIGH_NM, FAR_NM, BACK_NM = 4.5, 12.0, 1.0


def delivered(ratio: float | Array) -> Array:
    """Return the fundamental the inverter gives for a demand, both over the linear limit.

    The legs of the demand plus the min-max zero sequence are cut at half the link; the fundamental is that of the line
    voltages. An independent statement of what the core's modulation does.
    """
    theta = 2.0 * math.pi * (np.arange(7200) + 0.5) / 7200
    demand = np.atleast_1d(np.asarray(ratio, dtype=np.float64)) / math.sqrt(3.0)
    legs = np.cos(theta[None, :] - 2.0 * math.pi / 3.0 * np.arange(3)[:, None])
    middle = 0.5 * (legs.max(axis=0) + legs.min(axis=0))
    cut = np.clip(demand[:, None, None] * (legs - middle), -0.5, 0.5)
    alpha = (2.0 * cut[:, 0] - cut[:, 1] - cut[:, 2]) / 3.0
    return np.asarray(2.0 * math.sqrt(3.0) * np.mean(alpha * np.cos(theta), axis=1), dtype=np.float64)


def with_utilisation(ratio: float) -> MachineFile:
    """Return the machine behind an inverter whose V_max is this share of the linear limit."""
    source = machine_file(0.5)
    return replace(source, inverter=replace(source.inverter, voltage_utilisation=min(ratio / math.sqrt(3.0), 0.6366)))


@dataclass(frozen=True, slots=True)
class Held:
    """Steady state of a torque: means, peak-to-peak torque (N m), fundamental over the linear limit."""

    torque: float
    ripple: float
    i_d: float
    loss_w: float
    fundamental: float


def held(r: Response, from_s: float, to_s: float) -> Held:
    """Return the steady state within a window."""
    kept = slice(r.index(from_s), r.index(to_s))
    i_d, i_q = r.i_d[kept], r.i_q[kept]
    v = complex(float(r.v_d[kept].mean()), float(r.v_q[kept].mean()))
    return Held(
        float(r.torque[kept].mean()),
        float(np.ptp(r.torque[kept])),
        float(i_d.mean()),
        machine_file().machine.R_s_ohm * float((i_d**2 + i_q**2).mean()),
        abs(v) / V_MAX,
    )


def at_ratio(law: Controller, ratio: float, torque_nm: float) -> Held:
    """Return what a polar law holds at 800 rpm with V_a,max at a share of the linear limit."""
    values = (*law.values, ("polar.V_a_max_ratio", ratio))
    changed = replace(law, name=f"{law.name}, {ratio:g}", values=values)
    torque = steps([(0.0, BACK_NM), (0.02, torque_nm)])
    return held(run(changed, SIMULATION, torque, [(0.0, RPM)], 0.25), SETTLED_S, 0.25)


def _modulator(seed: int) -> tuple[Table, list[Check], list[tuple[float, Held]]]:
    del seed  # nothing here is random
    columns = (
        Column("V_a,max / linear limit", "", 4),
        Column("V_a,max", "V", 4),
        Column("M", "", 4),
        Column("fundamental / linear limit", "", 5),
        Column("the same from the legs", "", 5),
        Column("share of six-step", "%", 4),
        Column("i_d at 4.5 N m", "A", 3),
        Column("torque ripple, peak to peak", "N m", 2),
    )
    found = [(ratio, at_ratio(CONVENTIONAL, ratio, HIGH_NM)) for ratio in RATIOS]
    expected = delivered(np.array(RATIOS))
    rows = tuple(
        (
            ratio,
            ratio * V_MAX,
            M_PER_V * ratio * V_MAX,
            m.fundamental,
            float(own),
            100.0 * m.fundamental / SIX_STEP,
            m.i_d,
            m.ripple,
        )
        for (ratio, m), own in zip(found, expected, strict=True)
    )
    worst = max(abs(m.fundamental - float(own)) for (_, m), own in zip(found, expected, strict=True))
    checks = [
        at_most(
            "fundamental: closed loop against the legs' geometry", worst, 0.01, "1", expected=0.0, where="own statement"
        ),
        near(
            "fundamental without limit on V_a: six-step",
            SIX_STEP,
            float(delivered(1e4)[0]),
            "1",
            absolute=1e-4,
            where="2 sqrt(3) / pi",
        ),
    ]
    title = f"conventional law, V_a,max raised beyond the linear limit of V_dc/sqrt(2) = {V_MAX:.3f} V (M = 1.1547)"
    return Table(title, columns, rows), checks, found


EXACT = (PROPOSED_ON_MEASUREMENT, UNIFIED_TUNED)
BEYOND = (CONVENTIONAL, PROPOSED, PROPOSED_ON_MEASUREMENT, UNIFIED, UNIFIED_TUNED, *BASELINES)


def _laws_beyond(seed: int) -> tuple[Table, list[Check]]:
    columns = (
        Column("controller"),
        Column("V_max / linear limit", "", 4),
        Column("torque, 4.5 asked", "N m", 4),
        Column("torque, 7.9 asked", "N m", 4),
        Column("ripple at 4.5", "N m", 2),
        Column("i_d at 4.5", "A", 3),
        Column("copper loss at 4.5", "W", 4),
        Column("settling up", "ms", 3),
    )
    rows, checks = [], []
    for ratio in (1.0, 1.05, 1.1):
        source = with_utilisation(ratio)
        for law in BEYOND:
            torque = steps([(0.0, BACK_NM), (0.06, HIGH_NM), (0.15, 7.9)])
            r = run(law, SIMULATION, torque, [(0.0, RPM)], 0.3, seed=seed, source=source)
            a, b = r.index(0.06), r.index(0.15)
            low, high = held(r, 0.12, 0.15), held(r, 0.26, 0.3)
            settle = settling_ms(r.t[a:b], r.i_q[a:b], HIGH_NM / K_T, 0.05 * (HIGH_NM - BACK_NM) / K_T)
            rows.append((law.name, ratio, low.torque, high.torque, low.ripple, low.i_d, low.loss_w, settle))
            if law in EXACT and ratio > 1.0:
                what = f"{law.name}: torque at 4.5 N m, V_max = {ratio:g} of the linear limit"
                checks.append(near(what, HIGH_NM, low.torque, "N m", absolute=0.01, where="asked for"))
    return Table("every law with the inverter's V_max raised, 800 rpm", columns, tuple(rows)), checks


UNREACHABLE = (
    CONVENTIONAL,
    CONVENTIONAL_ON_MEASUREMENT,
    PROPOSED,
    PROPOSED_ON_MEASUREMENT,
    LINEAR,
    REGULARISED,
    UNIFIED,
    UNIFIED_TUNED,
    *BASELINES,
)


def unreachable(law: Controller, seed: int = 0) -> tuple[Held, Response]:
    """Return what a law holds when 12 N m are asked for at 800 rpm, and the response, which ends with 1 N m again."""
    torque = steps([(0.0, BACK_NM), (0.06, FAR_NM), (0.16, BACK_NM)])
    r = run(law, SIMULATION, torque, [(0.0, RPM)], 0.3, seed=seed)
    return held(r, 0.13, 0.16), r


def _out_of_reach(seed: int) -> tuple[Table, list[Check], list[tuple[str, Response]]]:
    columns = (
        Column("controller"),
        Column("torque held", "N m", 4),
        Column("ripple", "N m", 3),
        Column("i_d", "A", 4),
        Column("largest current, peak", "A", 3),
        Column("torque after return to 1 N m", "N m", 4),
        Column("settling after it", "ms", 3),
    )
    rows, shown = [], []
    results: dict[str, tuple[Held, Response, float]] = {}
    for law in UNREACHABLE:
        m, r = unreachable(law, seed)
        back = r.index(0.16)
        settle = settling_ms(r.t[back:], r.i_q[back:], BACK_NM / K_T, 0.05 * (HIGH_NM - BACK_NM) / K_T)
        results[law.name] = (m, r, settle)
        rows.append((law.name, m.torque, m.ripple, m.i_d, peak_current_apk(r), float(r.torque[-1]), settle))
        shown.append((law.name, r))
    checks: list[Check] = []
    for law, largest in ((PROPOSED_ON_MEASUREMENT, 8.101), (UNIFIED, 8.101), (UNIFIED_TUNED, 7.787)):
        m, r, settle = results[law.name]
        checks += [
            near(
                f"{law.name}: torque held when 12 N m are asked",
                largest,
                m.torque,
                "N m",
                absolute=0.02,
                where="0.97 of the reach",
            ),
            near(
                f"{law.name}: torque after the return",
                BACK_NM,
                float(r.torque[-1]),
                "N m",
                absolute=0.01,
                where="asked for",
            ),
            at_most(f"{law.name}: largest current, peak", peak_current_apk(r), 40.0, "A", where="I_max of the profile"),
        ]
    checks.append(at_most("unified: settling after the return", results[UNIFIED.name][2], 3.0, "ms"))
    return Table("12 N m asked for at 800 rpm, where 8.42 N m is the most", columns, tuple(rows)), checks, shown


def modulation_limit(seed: int) -> Reproduction:
    """Overmodulation, six-step, and torque out of reach."""
    modulator, checks, found = _modulator(seed)
    beyond, more = _laws_beyond(seed)
    reach, last, shown = _out_of_reach(seed)
    ratios = np.linspace(0.9, 2.0, 111)
    measured = np.array([[ratio, m.fundamental] for ratio, m in found])
    drawn = [pair for pair in shown if pair[0] in (CONVENTIONAL.name, PROPOSED.name, UNIFIED.name, BASELINES[0].name)]
    plots = (
        Panel(
            "fundamental over demand",
            "V_a,max / linear limit",
            "fundamental / linear limit",
            (
                Series("legs", ratios, delivered(ratios)),
                Series("drive", measured[:, 0], measured[:, 1], "o"),
                Series("six-step", np.array([0.9, 2.0]), np.full(2, SIX_STEP), ":", -1),
            ),
        ),
        Panel(
            "12 N m asked for between 60 and 160 ms",
            "time / ms",
            "torque / N m",
            tuple(Series(name, 1e3 * r.t, r.torque) for name, r in drawn),
        ),
    )
    notes = (
        *ASSUMED,
        f"V_a,max of every other figure is the linear limit, V_dc/sqrt(2) = {V_MAX:.3f} V"
        f" ({V_MAX * PEAK:.3f} V peak, V_dc/sqrt(3)), with V_dc = {V_DC:g} V",
        "six-step is approached, not entered: with V_a,max = 1.2 of the linear limit, the largest the drive takes, the"
        " inverter gives 96 % of its fundamental; beyond about 1.1 more V_a,max gives ripple, hardly voltage",
        "the proposed law in its printed form (PID on the error) oscillates where the torque is out of reach; with P"
        " and D on the measurement it holds, because the drive cuts the reference at 0.97 of the reach",
        "in overmodulation the phase loop answers the sixth harmonic: up to 0.5 % more fundamental than the legs give",
        "linear-range laws (modes 3 to 5) lose torque at the voltage limit, down to the wrong sign above base speed",
    )
    return Reproduction(
        SOURCE,
        (modulator, beyond, reach),
        plots,
        (*checks, *more, *last),
        notes,
    )
