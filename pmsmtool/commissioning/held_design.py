# SPDX-License-Identifier: MIT
"""A design as a drive will hold it: gains in its counts, one pair where it has no more, and the loops these make.

A loop whose gains the drive has no object for is not judged: its margins would be those of numbers nobody writes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from pmsmtool.design.closed_drive import RATED, STATED
from pmsmtool.design.design_file import Design, DesignValue, Scalar
from pmsmtool.design.loops.open_loops import (
    CURRENT_GAINS,
    CURRENT_LOOPS,
    SPEED_GAINS,
    SPEED_LOOP,
    lacking_gains,
    one_pair,
    with_gains,
)
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.drive_maps.drive_map import DriveMap
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.params.parameter_set import ParameterSet

Designed = Callable[[MachineFile, TuneRequest], Design]
"""A rule from machine and request to a design."""


def held_by(drive_map: DriveMap, designed: Designed) -> Designed:
    """Return a rule that designs for a drive: what :func:`held_design` makes of another rule's design."""
    return lambda source, request: held_design(designed(source, request), drive_map)


def held_design(design: Design, drive_map: DriveMap) -> Design:
    """Return a design with the gains that a drive will hold, judged by the loops these make.

    Raises ConfigError: values that do not fit the drive's types.

    Parameters
    ----------
    design : Design
        As designed, or as ``tune_closed`` says it for a closed drive.
    drive_map : DriveMap
        Of the drive; nothing changes for the reference drive, which holds every value as it is.
    """
    if drive_map.staging:
        return design
    design = replace(design, values={**design.values, **_rated(design, drive_map)})
    lacking = lacking_gains(drive_map.cells)
    if STATED in design.request:
        lacking[CURRENT_LOOPS] = ()
    judged = [] if lacking[CURRENT_LOOPS] else [loop for loop, names in lacking.items() if not names]
    chosen = replace(design, values={**design.values, **one_pair(design, drive_map.cells)})
    gains = {n: v for n, v in _quantised(chosen, drive_map).items() if v.value != design[n]}
    notes = [
        f"{_LOOPS[loop]} not judged: the map {drive_map.name!r} has no object for {', '.join(names)}"
        for loop, names in lacking.items()
        if names and any(name.startswith(loop) for name in design.loops)
    ]
    asked: dict[str, Scalar] = {**design.request, "drive": drive_map.name}
    return replace(with_gains(design, gains, judged), notes=(*design.notes, *notes), request=asked)


_LOOPS = {CURRENT_LOOPS: "current loops", SPEED_LOOP: "speed loop"}


def why_not_judged(design: Design) -> str:
    """Return why no loop of a design is judged; empty when one is."""
    if design.loops:
        return ""
    drive = design.request.get("drive", "of the drive")
    return f"the map {drive!r} has no object for the gains of the current loops; the design lists them"


def _rated(design: Design, drive_map: DriveMap) -> dict[str, DesignValue]:
    """Return the rated torque in the drive's counts: a limit relative to it is then held at or below what is asked."""
    if RATED not in design.values or RATED not in drive_map.cells:
        return {}
    held = drive_map.quantised(ParameterSet({RATED: design[RATED]}))
    return {RATED: replace(design.values[RATED], value=held.values[RATED])}


def _quantised(design: Design, drive_map: DriveMap) -> dict[str, DesignValue]:
    """Return the gains as they come back from the drive's counts, with those that follow them."""
    pairs = one_pair(design, drive_map.cells)
    names = [name for name in (*CURRENT_GAINS, *SPEED_GAINS) if name in drive_map.cells and drive_map.writes(name, {})]
    wanted = dict.fromkeys(names)
    for name in names:  # what they are counted relative to
        while name in drive_map.cells and (name := drive_map.cells[name].gain):
            wanted[name] = None
    held = drive_map.quantised(ParameterSet({name: design[name] for name in wanted})).values
    values = {name: replace(design.values[name], value=held[name]) for name in names}
    for name, value in pairs.items():
        partner = name if name in held else name.replace("_d_", "_q_")
        values[name] = DesignValue(held[partner], value.method)
    return values
