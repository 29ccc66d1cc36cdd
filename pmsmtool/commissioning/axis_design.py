# SPDX-License-Identifier: MIT
"""The design of an axis for a drive: as its map states what it has, with the gains it will hold after rounding."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from pmsmtool.axis.design import (
    AXIS_ROWS,
    CASCADE,
    PID,
    SPEED,
    SPEED_FORWARD,
    AxisDrive,
    AxisRequest,
    assumed_torque,
    at_least_as_good,
    with_axis,
)
from pmsmtool.design.design_file import Design
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.drive_maps.drive_map import Cell, DriveMap
from pmsmtool.errors import DesignInfeasible
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


def own_torque(source: MachineFile, drive_map: DriveMap) -> dict[str, float]:
    """Return what gains in amperes are counted by on a drive that does not hold the torque of an ampere itself."""
    drive = axis_drive(drive_map)
    if not drive.amperes or drive.holds_torque:
        return {}
    return {TORQUE_PER_AMPERE: assumed_torque(source.machine)}


def design_axis(
    source: MachineFile,
    request: TuneRequest,
    axis: AxisRequest,
    drive_map: DriveMap,
    stored: Mapping[str, float] | None = None,
) -> Design:
    """Design the axis of a machine on a drive; with what the drive holds, never for a larger following error than that.

    Raises ConfigError: the machine file has no inertia, or gains do not fit the drive's types; DesignInfeasible: no
    gains keep the margins over the tolerance box.
    """
    drive = axis_drive(drive_map)
    made = with_axis(tune(source, request), axis, drive)
    if stored is not None:
        made = at_least_as_good(made, stored, drive)
    if drive_map.staging:
        return made.design
    lacking = not_offered(drive_map)
    notes = tuple(f"not written: {name}: {why}" for name, why in lacking.items())
    wanted = axis_parameters(made.design)
    fitting = dict(wanted.values)
    for group in GROUPS:
        fitting |= _slowed(drive_map, group, wanted)
    less = _cut(drive_map, wanted)
    slower = [name for name, value in fitting.items() if value < wanted.values[name]]
    faster = [name for name, value in fitting.items() if value > wanted.values[name]]
    held = drive_map.quantised(replace(wanted, values=fitting | less)).values
    design = made.with_held({name: value for name, value in held.items() if drive_map.writes(name, wanted.values)})
    if (
        faster
        and min(float(design.facts[f"axis_{loop}_phase_least_deg"]) for loop in ("speed", "position")) < LEAST_DEG
    ):
        raise DesignInfeasible(
            f"{', '.join(faster)}: the drive's objects hold no gain so small",
            likely="a heavy load, and an object whose longest integral time is short",
            hint="make the unit of that time longer in the drive, where it has one",
        )  # fmt: skip
    notes += tuple(f"{name}: {wanted.values[name]:.4g} is designed, slower by what its objects hold" for name in slower)
    notes += tuple(f"{name}: {wanted.values[name]:.4g} is designed, its object holds no less" for name in faster)
    notes += tuple(f"{name}: {wanted.values[name]:.4g} is designed, its object holds no more" for name in less)
    if CASCADE[2] in less:  # the errors were predicted with all of it
        kept = {name: fact for name, fact in design.facts.items() if name not in PREDICTED}
        design = replace(design, facts=kept)
    return replace(design, notes=(*design.notes, *notes))


GROUPS = ({SPEED[0]: 1, SPEED[1]: 2}, {PID[0]: 2, PID[1]: 3, PID[2]: 1})
"""Gains of one controller, and the power of its crossover with which each grows."""
LEAST_DEG = 35.0
"""Least phase margin over the tolerance box with an integral time shorter than designed."""
SIGNED = ("INTEGER8", "INTEGER16", "INTEGER32")


PREDICTED = ("axis_inertia_ff_share", "axis_following_error_rad", "axis_error_rad")


def _largest(cell: Cell) -> float:
    """Return the largest count of an object."""
    return math.inf if cell.wire == "REAL32" else 2.0 ** (8 * cell.size - (cell.wire in SIGNED)) - 1.0


def _cut(drive_map: DriveMap, wanted: ParameterSet) -> dict[str, float]:
    """Return the feed-forwards that are beyond what their objects hold, as much as these do."""
    found = {}
    for name in (*SPEED_FORWARD, *CASCADE[1:], *PID[3:]):
        if name in drive_map.cells and name in wanted.values and drive_map.writes(name, wanted.values):
            cell = drive_map.cells[name]
            counts = cell.counts(wanted.values[name], wanted.values)
            if counts > _largest(cell):
                found[name] = wanted.values[name] * _largest(cell) / counts
    return found


def _slowed(drive_map: DriveMap, group: dict[str, int], wanted: ParameterSet) -> dict[str, float]:
    """Return the gains of a controller, all of it slower where one of them is beyond what its object can hold.

    An integral time grows when the loop becomes slower: where it is too long, it is the longest that its object holds.
    """
    rows = [
        (drive_map.cells[name], power)
        for name, power in group.items()
        if name in drive_map.cells and name in wanted.values and drive_map.writes(name, wanted.values)
    ]
    share = 1.0
    for cell, power in rows:
        counts = cell.counts(wanted.values[cell.name], wanted.values)
        grows = power - group.get(cell.gain, 0)
        share = min(share, (_largest(cell) / counts) ** (1.0 / grows) if counts and cell.form != "time" else 1.0)
    slowed = {cell.name: wanted.values[cell.name] * share**power for cell, power in rows}
    for cell, _ in rows:
        if cell.form == "time":
            slowed[cell.name] *= max(1.0, cell.counts(slowed[cell.name], {**wanted.values, **slowed}) / _largest(cell))
    return slowed


def not_offered(drive_map: DriveMap) -> dict[str, str]:
    """Return the gains of an axis that a drive has no object for, with the reason its map gives."""
    position = PID[:3] if PID[0] in drive_map.cells else CASCADE
    return drive_map.not_written([name for name in (*SPEED, *position) if name not in drive_map.cells])


def axis_parameters(design: Design) -> ParameterSet:
    """Return what of a design is written for its axis."""
    whole = design.parameter_set()
    other = CASCADE[:2] if design.facts["axis_structure"] == "pid" else ()
    kept = {name: value for name, value in whole.values.items() if name in AXIS_ROWS and name not in other}
    said = {name: text for name, text in whole.provenance.items() if name in kept or name == "machine"}
    return replace(whole, values=kept, tables={}, provenance=said)
