# SPDX-License-Identifier: MIT
"""The design of an axis for a drive: as its map states what it has, with the gains it will hold after rounding."""

from __future__ import annotations

from dataclasses import replace

from pmsmtool.axis.design import AXIS_ROWS, CASCADE, PID, SPEED, AxisDrive, AxisRequest, with_axis
from pmsmtool.design.design_file import Design
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.drive_maps.drive_map import DriveMap
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.params.catalogue import TORQUE_PER_AMPERE
from pmsmtool.params.parameter_set import ParameterSet


def axis_drive(drive_map: DriveMap) -> AxisDrive:
    """Return what of a drive decides its axis."""
    period = drive_map.motion.get("loop_period")
    return AxisDrive(
        drive_map.name, frozenset(drive_map.cells), drive_map.staging,
        period.number if period is not None and period.number else None,
        any(cell.form == "current" for cell in drive_map.cells.values()), TORQUE_PER_AMPERE in drive_map.cells,
    )  # fmt: skip


def design_axis(source: MachineFile, request: TuneRequest, axis: AxisRequest, drive_map: DriveMap) -> Design:
    """Design the axis of a machine on a drive.

    Raises
    ------
    ConfigError
        The machine file has no inertia, or gains do not fit the drive's types.
    DesignInfeasible
        No gains keep the margins over the tolerance box.
    """
    made = with_axis(tune(source, request), axis, axis_drive(drive_map))
    if drive_map.staging:
        return made.design
    lacking = not_offered(drive_map)
    notes = tuple(f"not written: {name}: {why}" for name, why in lacking.items())
    wanted = axis_parameters(made.design)
    held = drive_map.quantised(wanted).values
    design = made.with_held({name: value for name, value in held.items() if drive_map.writes(name, wanted.values)})
    return replace(design, notes=(*design.notes, *notes))


def not_offered(drive_map: DriveMap) -> dict[str, str]:
    """Return the gains of an axis that a drive has no object for, with the reason its map gives."""
    position = PID[:3] if PID[0] in drive_map.cells else CASCADE
    return drive_map.not_written([name for name in (*SPEED, *position) if name not in drive_map.cells])


def axis_parameters(design: Design) -> ParameterSet:
    """Return what of a design is written for its axis."""
    whole = design.parameter_set()
    kept = {name: value for name, value in whole.values.items() if name in AXIS_ROWS}
    said = {name: text for name, text in whole.provenance.items() if name in kept or name == "machine"}
    return replace(whole, values=kept, tables={}, provenance=said)
