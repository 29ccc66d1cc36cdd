# SPDX-License-Identifier: MIT
"""The design stage of a drive that cannot be reflashed: its limits keep it out of saturation, and what that costs.

The governor is projected onto what the drive offers (``design/closed_drive.py``); the stage is judged by the guarantee.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from pmsmtool.commissioning.design_stages import tune_stage
from pmsmtool.commissioning.held_design import held_by
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
from pmsmtool.design.design_file import Design, load_design
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.drive_maps.drive_map import DriveMap
from pmsmtool.errors import DesignInfeasible, NotAvailable
from pmsmtool.machine.machine_file import MachineFile, load_machine_file
from pmsmtool.proof.stage import ROUNDING
from pmsmtool.run_directory import Acceptance, RunDirectory, Stage

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
            stage = tune_stage(run, request, held_by(drive_map, partial(_limited, drive)))
            return _judged(stage, load_design(run.path / "design.toml"), drive)
        except DesignInfeasible as error:
            reason = "; ".join(text for text in (error.what, error.likely) if text)
    stage = tune_stage(run, request, held_by(drive_map, tune))
    return replace(stage, fallbacks=(*stage.fallbacks, f"{LIMITS}: not available: {reason}"))


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
