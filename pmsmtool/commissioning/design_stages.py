# SPDX-License-Identifier: MIT
"""The stages that compute: control, look-up table, margins. Files of the run in, files of the run and criteria out.

Of a drive that cannot be reflashed the limits keep it out of saturation: the governor is projected onto
what the drive offers (``design/closed_drive.py``); the stage is judged by the guarantee.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, cast

from pmsmtool.commissioning.axis_design import Designed, design_for, why_not_judged
from pmsmtool.design.closed_drive import (
    CURRENT,
    GAINS,
    RATED,
    SLOPE,
    SPEED,
    TORQUE,
    ClosedDrive,
    tune_closed,
)
from pmsmtool.design.design_file import Design, DesignValue, design_text, load_design, load_machine_or_design
from pmsmtool.design.lookup.design import LookupDesign, LookupRequest, design_table
from pmsmtool.design.lookup.file import lut_values, table_csv, table_facts, table_npz
from pmsmtool.design.lookup.table import loci
from pmsmtool.design.loops.margins import JUDGED_PERCENTILE, MarginRequest, Spread, margin_report
from pmsmtool.design.loops.sampled_loop import LoopMargins
from pmsmtool.design.ratings import ratings, ratings_of
from pmsmtool.design.tolerance import tolerance_box
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.drive_maps.drive_map import DriveMap
from pmsmtool.errors import DesignInfeasible, NotAvailable
from pmsmtool.machine.flux_map import FluxMap
from pmsmtool.machine.machine_file import MachineFile, load_machine_file
from pmsmtool.machine.uncontrolled_generation import Protection
from pmsmtool.params.catalogue import CATALOGUE, FIELD_WEAKENING_MODES
from pmsmtool.proof.stage import ROUNDING
from pmsmtool.run_directory import Acceptance, RunDirectory, Stage

SHOWN = (
    "current.K_p_d_v_per_a", "current.K_i_d_v_per_as", "current.K_p_q_v_per_a", "current.K_i_q_v_per_as",
    "speed.K_p_nms_per_rad", "speed.K_i_nm_per_rad",
)  # fmt: skip
"""Values of a design that the record names; all of them stand in ``design.toml``."""
MARGIN_SAMPLES = 4096
"""Random machines drawn from the tolerance box: the 5 % quantile to about +-0.7 % of probability; 0.4 s."""
SPEED_PHASE_MARGIN_DEG = 40.0
"""Least phase margin of the speed loop: below it a step rings visibly (30 % overshoot)."""


def tune_stage(run: RunDirectory, request: TuneRequest, designed: Designed = tune) -> Stage:
    """Design the control of the identified machine; writes ``design.toml``.

    Not available where the drive takes no gains: then nothing of the loops is judged.

    Raises DesignInfeasible: the margins asked for cannot be met.
    """
    design = designed(load_machine_file(run.path / "machine.toml"), request)
    run.save("design.toml", design_text(design))
    if reason := why_not_judged(design):
        return Stage(
            "tune", "not available", 0.0, note=reason, files={"design.toml": ""}, fallbacks=design.notes
        )  # fmt: skip
    criteria = [line for name, loop in design.loops.items() for line in _loop_criteria(name, loop, request)]
    values: list[Mapping[str, Any]] = [
        {"name": n, "value": design[n], "method": design.values[n].method} for n in SHOWN
    ]
    current = [loop for name, loop in design.loops.items() if name.startswith("current")]
    hertz = float(design.facts["current_bandwidth_rad_s"]) / (2.0 * math.pi)
    phase, gain = min(loop.phase_margin_deg for loop in current), min(loop.gain_margin_db for loop in current)
    summary = f"current loops {hertz:.4g} Hz, {phase:.1f} deg, {gain:.1f} dB"
    if "speed" in design.loops:
        loop = design.loops["speed"]
        summary += f"; speed loop {loop.crossover_rad_s / (2.0 * math.pi):.4g} Hz, {loop.phase_margin_deg:.1f} deg"
    return _stage("tune", summary, criteria, values=values, files=("design.toml",), fallbacks=design.notes)


def _loop_criteria(name: str, loop: LoopMargins, request: TuneRequest) -> list[Acceptance]:
    current = name.startswith("current")
    phase = request.phase_margin_deg if current else SPEED_PHASE_MARGIN_DEG
    lines = [_at_least(f"{name}: phase margin", loop.phase_margin_deg, phase, "deg", loop.stable)]
    if current:
        lines.append(_at_least(f"{name}: gain margin", loop.gain_margin_db, request.gain_margin_db, "dB", loop.stable))
    return lines


def _at_least(what: str, value: float, least: float, unit: str, stable: bool) -> Acceptance:
    measured = f"{value:.1f} {unit}" if stable else "unstable"
    return Acceptance(what, measured, f">= {least:g} {unit}", stable and value >= least)


def lut(
    source: str | Path | Design | MachineFile,
    request: LookupRequest | None = None,
    *,
    voltage_margin: float | None = None,
    overspeed_protection: Protection | None = None,
    loss_map: FluxMap | None = None,
) -> LookupDesign:
    """Make the current references of a machine, as the command of the same name does.

    Parameters
    ----------
    source : str, Path, Design or MachineFile
        Machine and inverter; text names a file, a run directory or a shipped profile.
    request : LookupRequest, optional
        What is asked; the defaults of the class.
    voltage_margin, overspeed_protection
        As in a :class:`~pmsmtool.design.tune_request.TuneRequest`; those of the design, or the defaults.
    loss_map : FluxMap, optional
        Iron loss (``OperatingMachine.loss_map``).

    Raises
    ------
    ConfigError, DesignInfeasible
        What is wrong with the source; as :func:`~pmsmtool.design.lookup.design.design_table`.

    Examples
    --------
    >>> import pmsmtool
    >>> made = pmsmtool.lut("jercic-2017", pmsmtool.LookupRequest(torque_points=9, y_points=5))
    >>> made.table.i_d_a.shape
    (9, 5, 1)
    """
    machine, design = load_machine_or_design(source)
    margin = voltage_margin
    if margin is None:
        margin = TuneRequest().voltage_margin if design is None else design["field_weakening.margin"]
    stated = overspeed_protection or (None if design is None else design.request.get("overspeed_protection"))
    rated = ratings(machine, (1.0 - margin) * machine.inverter.V_max_v, cast("Protection | None", stated))
    made = design_table(machine, rated, request or LookupRequest(), margin, loss_map)
    return replace(made, notes=(*made.notes, *filter(None, [rated.reaction.note])))


def lut_stage(run: RunDirectory, request: LookupRequest) -> Stage:
    """Make the look-up table of the design.

    Writes ``lut.npz``, ``lut.csv``, the design with it, and ``params.toml``, the set that is flashed. The table goes
    into the drive when the design takes its references from one (``field_weakening.mode``).

    Raises DesignInfeasible: not even a table within the widest of ``lookup.design.BOUNDS`` fits the drive's memory.
    """
    design = load_design(run.path / "design.toml")
    made = design_table(design.machine, ratings_of(design), request, design["field_weakening.margin"])
    table, error = made.table, made.error
    used = design["field_weakening.mode"] == FIELD_WEAKENING_MODES["lookup"]
    if used:
        design = with_table(design, made)
    run.save("lut.npz", table_npz(table, table_facts(table, made.stored, error), loci(table)))
    run.save("lut.csv", table_csv(table))
    run.save("design.toml", design_text(design))
    run.save("params.toml", design.parameter_set().to_toml())
    torque = float(max(abs(table.torque_nm[0]), table.torque_nm[-1]))
    criteria = [
        _at_most("torque error between nodes", error.torque_nm / torque, made.torque_bound),
        _at_most(
            "voltage beyond the limit between nodes", error.voltage_v / float(table.V_max_v.min()), made.voltage_bound
        ),
    ]
    shape = " x ".join(map(str, table.i_d_a.shape))
    names, counts = table.binding_counts()
    values: list[Mapping[str, Any]] = [
        {"name": "cells", "value": shape, "method": made.stored},
        *({"name": f"cells bound by {name}", "value": count} for name, count in zip(names, counts, strict=True)),
    ]
    files = ("lut.npz", "lut.csv", "design.toml", "params.toml")
    summary = f"{shape} cells, {made.stored}; torque to {torque:.4g} N m, speed to {table.y[-1]:.5g} rpm"
    notes = made.notes if used else (*made.notes, "the table is not used: the drive calculates the references")
    return _stage("lut", summary, criteria, values=values, files=files, fallbacks=notes)


def _at_most(what: str, value: float, largest: float) -> Acceptance:
    return Acceptance(what, f"{100.0 * value:.2g} %", f"<= {100.0 * largest:g} %", value <= largest)


def margins_stage(run: RunDirectory, request: MarginRequest) -> Stage:
    """Judge the design over what the machine may be: interval corners and random samples; writes nothing.

    Raises NotAvailable: the drive takes no gains, so there is no loop to judge.
    """
    design = load_design(run.path / "design.toml")
    if reason := why_not_judged(design):
        raise NotAvailable(reason, hint="the maker's tool sets and judges the loops of such a drive")
    report = margin_report(design, tolerance_box(design.machine), request, samples=MARGIN_SAMPLES)
    criteria = [line for spread in report.loops for line in _spread_criteria(spread)]
    criteria += [line for spread in report.headroom for line in _spread_criteria(spread)]
    phase = min((s for s in report.loops if s.name.endswith("phase")), key=lambda s: s.worst)
    gain = min(
        (s for s in report.loops if s.name.startswith("current") and s.name.endswith("gain")), key=lambda s: s.worst
    )
    summary = (
        f"over {report.corners} corners and {report.samples} samples: phase {phase.worst:.1f} deg ({phase.name}), "
        f"gain {gain.worst:.1f} dB ({gain.name})"
    )
    beyond = [spread for spread in report.headroom if spread.unjudged]
    if beyond:
        shares = ", ".join(f"{spread.name.removeprefix('headroom_')} {spread.worst:.2g}" for spread in beyond)
        summary += f"; headroom below 0 at a corner, not judged, reasons in the report: {shares}"
    values = [_spread_value(spread) for spread in (*report.loops, *report.headroom)]
    return _stage("margins", summary, criteria, values=values, files=(), fallbacks=report.notes)


def _spread_criteria(spread: Spread) -> list[Acceptance]:
    if spread.least is None:
        return []
    limit = f">= {spread.least:g} {spread.unit}"
    found = {"worst corner": spread.worst, "5 % of samples": spread.percentiles[JUDGED_PERCENTILE]}
    return [
        Acceptance(f"{spread.name}: {where}", f"{value:.1f} {spread.unit}", limit, value >= spread.least)
        for where, value in found.items()
    ]


def _spread_value(spread: Spread) -> Mapping[str, Any]:
    percentiles = {f"p{percentile:g}": value for percentile, value in spread.percentiles.items()}
    return {
        "name": spread.name, "unit": spread.unit, "value": spread.nominal, "worst": spread.worst,
        "at": spread.worst_cell, "least": spread.least, **percentiles,
    }  # fmt: skip


def with_table(design: Design, made: LookupDesign) -> Design:
    """Return a design with a look-up table in it."""
    values, tables = lut_values(made.table, made.stored)
    how = f"look-up table, {made.stored}, error-bounded grid"
    entries = {**design.values, **{name: DesignValue(value, how) for name, value in values.items()}}
    return replace(
        design, values={row.name: entries[row.name] for row in CATALOGUE}, tables={**design.tables, **tables}
    )


def _stage(
    name: str,
    summary: str,
    criteria: list[Acceptance],
    *,
    values: list[Mapping[str, Any]],
    files: tuple[str, ...],
    fallbacks: tuple[str, ...] = (),
) -> Stage:
    good = all(line.ok for line in criteria)
    return Stage(
        name,
        "pass" if good else "fail",
        0.0,
        values=values,
        acceptance=criteria,
        files=dict.fromkeys(files, ""),
        fallbacks=fallbacks,
        summary=summary,
        note="" if good else f"{sum(not line.ok for line in criteria)} of {len(criteria)} criteria are not met",
    )


LIMITS = "limits that keep the drive out of saturation"
NO_BANDWIDTH = (
    "needs the bandwidth of its current control, whose gains cannot be written: --drive-bandwidth-hz, as the maker's "
    "tool or manual says"
)
NO_INERTIA = "needs the inertia: J_kgm2 in a machine file"
FACT = "closed_drive_"
"""Beginning of the names of the guarantee's facts in a design."""
WRITTEN = (RATED, SLOPE, TORQUE, CURRENT, SPEED)
"""Values of the closed-drive set, as far as the drive has objects for them."""

NAMES = ("current", "speed")
"""Limits of a design that can be accepted below the machine's ratings."""


def why_no_limits(drive_map: DriveMap, bandwidth_hz: float | None, source: MachineFile | None = None) -> str:
    """Return why the limits of a drive cannot be designed; empty when they can.

    Raises ConfigError: the bandwidth is no positive number.

    Parameters
    ----------
    drive_map : DriveMap
        Which objects it has.
    bandwidth_hz : float or None
        Bandwidth of its current control, where it is known.
    source : MachineFile, optional
        The machine; None: not known yet, and not asked for.
    """
    try:
        drive = ClosedDrive(drive_map.name, frozenset(drive_map.cells), bandwidth_hz)
    except NotAvailable as error:
        return error.what
    if bandwidth_hz is None and not drive.offers >= set(GAINS):
        return NO_BANDWIDTH
    return NO_INERTIA if source is not None and source.machine.J_kgm2 is None else ""


def closed_stage(run: RunDirectory, request: TuneRequest, drive_map: DriveMap, bandwidth_hz: float | None) -> Stage:
    """Design a closed drive: gains as far as it takes them, and its limits; writes ``design.toml``.

    Where no limits can be designed the gains are designed without, and the stage says why.

    Raises ConfigError: the bandwidth is no positive number; DesignInfeasible: the margins asked for cannot be met.
    """
    reason = why_no_limits(drive_map, bandwidth_hz, load_machine_file(run.path / "machine.toml"))
    if not reason:
        drive = ClosedDrive(drive_map.name, frozenset(drive_map.cells), bandwidth_hz)
        try:
            stage = tune_stage(run, request, partial(design_for, drive_map, partial(_limited, drive)))
            return _judged(stage, load_design(run.path / "design.toml"), drive)
        except DesignInfeasible as error:
            reason = "; ".join(text for text in (error.what, error.likely) if text)
    stage = tune_stage(run, request, partial(design_for, drive_map, tune))
    return replace(stage, fallbacks=(*stage.fallbacks, f"{LIMITS}: not available: {reason}"))


def closed_design(
    source: MachineFile, request: TuneRequest, drive_map: DriveMap, *, rise_s: float, bandwidth_hz: float | None,
    speed_rpm: float | None, acceleration_rpm_per_s: float | None,
) -> Design:  # fmt: skip
    """Return the design of a closed drive: its gains and its limits; of one without objects for limits the gains.

    Raises ConfigError, DesignInfeasible: as :func:`~pmsmtool.design.closed_drive.tune_closed`; NotAvailable: the drive
    has objects for neither, or none for limits of which something is stated.

    Parameters
    ----------
    rise_s, bandwidth_hz, speed_rpm, acceleration_rpm_per_s : float
        As of a :class:`~pmsmtool.design.closed_drive.ClosedDrive`; None: not stated.
    """
    stated = bandwidth_hz, speed_rpm, acceleration_rpm_per_s
    try:
        drive = ClosedDrive(
            drive_map.name, frozenset(drive_map.cells), bandwidth_hz, rise_s, speed_rpm, acceleration_rpm_per_s
        )
    except NotAvailable as lacking:
        if any(value is not None for value in stated) or not drive_map.cells.keys() >= set(GAINS):
            raise
        design = design_for(drive_map, tune, source, request)
        return replace(design, notes=(*design.notes, f"{LIMITS}: not available: {lacking.what}"))
    return design_for(drive_map, partial(_limited, drive), source, request)


def guaranteed(design: Design) -> bool:
    """Whether a design holds limits of a closed drive with their guarantee."""
    return f"{FACT}demand_v" in design.facts


def _limited(drive: ClosedDrive, source: MachineFile, request: TuneRequest) -> Design:
    return tune_closed(source, request, drive)[0]


def _judged(stage: Stage, design: Design, drive: ClosedDrive) -> Stage:
    """Add the guarantee to the stage: what is written, what it is judged by, and the cost in one line."""
    fact = {name.removeprefix(FACT): value for name, value in design.facts.items()}
    demand, limit, current = (float(fact[name]) for name in ("demand_v", "limit_v", "current_apk"))
    peak, I_max = current + float(fact["current_deviation_a"]), design.machine.machine.I_max_apk
    criteria = [Acceptance("voltage demand within the limits", f"<= {demand:.4g} V", f"{limit:.4g} V", demand <= limit)]
    if I_max is not None:
        criteria.append(Acceptance("current within the limits", f"<= {peak:.4g} A", f"{I_max:.4g} A", peak <= I_max))
    good = stage.status == "pass" and all(line.ok for line in criteria)
    written = [name for name in WRITTEN if name in drive.offers]
    values = [{"name": n, "value": design[n], "method": design.values[n].method} for n in written]
    cost = (
        f"; never saturates up to {float(fact['torque_nm']):.4g} N m and {float(fact['speed_rpm']):.4g} rpm, which "
        f"costs {float(fact['torque_loss_percent']):.1f} % of the full governor's torque there"
    )
    return replace(
        stage, status="pass" if good else "fail", values=[*stage.values, *values],
        acceptance=[*stage.acceptance, *criteria], summary=stage.summary + cost,
    )  # fmt: skip


def within_ratings(run: RunDirectory, stage: Stage, accepted: Sequence[str] = ()) -> Stage:
    """Judge the design of a run by the ratings in its machine file; returns its stage with these criteria.

    Parameters
    ----------
    run : RunDirectory
        Holds ``design.toml``.
    stage : Stage
        The stage that made it.
    accepted : sequence of str
        Out of :data:`NAMES`: limits that a person accepts.
    """
    if stage.status not in ("pass", "not available"):
        return stage
    lines, taken = [], []
    for name, held, rated, unit in _limits(load_design(run.path / "design.toml")):
        ok = held >= rated * (1.0 - ROUNDING)
        what, measured = f"rated {name} within the design", f"{held:.4g} {unit}"
        if ok or name not in accepted:
            hint = "" if ok else f" (or --accept-limit {name})"
            lines.append(Acceptance(what, measured, f">= {rated:.4g} {unit}{hint}", ok))
        else:
            lines.append(Acceptance(what, measured, f"accepted below {rated:.4g} {unit}", True))
            taken.append(f"accepted (--accept-limit {name}): the design ends at {measured}, rated {rated:.4g} {unit}")
    if all(line.ok for line in lines):
        shown = lines if stage.status == "pass" else ()
        return replace(stage, acceptance=[*stage.acceptance, *shown], accepted=[*stage.accepted, *taken])
    broken = [f"{line.what}: {line.measured}, limit {line.limit}" for line in lines if not line.ok]
    return replace(stage, status="fail", acceptance=[*stage.acceptance, *lines], note="; ".join(broken))


def _limits(design: Design) -> list[tuple[str, float, float, str]]:
    """Return name, what the design allows, the rating that the machine file states, and the unit."""
    machine = design.machine.machine
    current, speed = design["motor.I_max_apk"], design["motor.n_max_rpm"]
    if guaranteed(design):  # a drive with fixed firmware is flashed with what its guarantee allows
        current = min(current, float(design.facts[f"{FACT}current_apk"]))
        speed = min(speed, float(design.facts[f"{FACT}speed_rpm"]))
    rows = (("current", current, machine.I_nom_apk, "A pk"), ("speed", speed, machine.n_nom_rpm, "rpm"))
    return [(name, held, rated, unit) for name, held, rated, unit in rows if rated is not None]
