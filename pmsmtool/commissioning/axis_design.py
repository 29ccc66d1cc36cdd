# SPDX-License-Identifier: MIT
"""A design, and that of its axis, as a drive will hold them: gains in its counts, and the loops these make.

A loop whose gains the drive has no object for is not judged: its margins would be those of numbers nobody writes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from pmsmtool.axis.design import with_axis
from pmsmtool.axis.drive import (
    AXIS_ROWS,
    CASCADE,
    DERIVATIVE,
    LEAD,
    PID,
    SPEED,
    SPEED_FORWARD,
    AxisDrive,
    AxisRequest,
    assumed_torque,
)
from pmsmtool.axis.stored_gains import at_least_as_good
from pmsmtool.design.closed_drive import RATED, STATED
from pmsmtool.design.design_file import Design, DesignValue, Scalar, load_design
from pmsmtool.design.loops.designed_loops import (
    CURRENT_GAINS,
    CURRENT_LOOPS,
    SPEED_GAINS,
    SPEED_LOOP,
    lacking_gains,
    one_pair,
    with_gains,
)
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.drive.envelope import largest_torque
from pmsmtool.drive_maps.drive_map import DriveMap
from pmsmtool.errors import ConfigError, DesignInfeasible
from pmsmtool.flash.journal import read_snapshot
from pmsmtool.flash.plan import without_assumed
from pmsmtool.flash.restore import snapshot_set
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.params.catalogue import TORQUE_PER_AMPERE
from pmsmtool.params.parameter_set import ParameterSet
from pmsmtool.run_directory import RunDirectory

Designed = Callable[[MachineFile, TuneRequest], Design]
"""A rule from machine and request to a design."""


def design_for(drive_map: DriveMap, designed: Designed, source: MachineFile, request: TuneRequest) -> Design:
    """Return what a drive holds of a rule's design (:func:`held_design`).

    Current loops whose gains are beyond what the drive's objects hold are designed slower, and a note says so.
    """
    design, slower = _fitting(drive_map, designed, source, request)
    return held_design(replace(design, notes=(*design.notes, *slower)), drive_map)


LEAST_SHARE = 0.1
"""Slowest current loop, of the one designed, that is taken for the limits of its objects: below, the drive does not fit
the motor."""


def _fitting(
    drive_map: DriveMap, designed: Designed, source: MachineFile, request: TuneRequest
) -> tuple[Design, list[str]]:
    """Return a rule's design, its current loops so slow that the drive's objects hold their gains; and what is slower.

    That is one line, or none.
    """
    design = designed(source, request)
    wanted = replace(design, values={**design.values, **one_pair(design, drive_map.cells)}).parameter_set()
    held = _slowed(drive_map, dict.fromkeys(CURRENT_GAINS, 1), wanted)
    slower = [name for name, value in held.items() if value < wanted.values[name]]
    share = min((held[name] / wanted.values[name] for name in slower), default=1.0)
    if drive_map.staging or not LEAST_SHARE < share < 1.0:
        return design, []
    hertz = share * float(design.facts["current_bandwidth_rad_s"]) / math.tau
    made = designed(source, replace(request, method="imc", bandwidth_hz=hertz))
    return made, [f"current loops of {hertz:.4g} Hz, slower by what the objects of {', '.join(slower)} hold"]


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


def refused_by_limits(
    source: MachineFile, drive_map: DriveMap, request: TuneRequest | None = None
) -> tuple[dict[str, str], list[str]]:
    """Return which values of a machine's design (the usual one) the objects of a drive do not hold, and why.

    With them, what is slower for these objects, one line or none.

    Raises ConfigError, DesignInfeasible: the machine has no such design.
    """
    asked = replace(request or TuneRequest(), governor="off", field_weakening="off", predictor=False)  # no such objects
    made, slower = _fitting(drive_map, tune, source, asked)
    wanted = replace(made, values={**made.values, **one_pair(made, drive_map.cells)}).parameter_set()
    refused = drive_map.refused(without_assumed(drive_map, wanted)[0])
    return refused, slower


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


def flashed_design(source: str, request: TuneRequest, drive_map: DriveMap) -> Design | None:
    """Return the design that a run directory wrote to the reference drive; None for others, and where more is asked.

    An axis added to it leaves the rest of the set as the drive holds it, so that `prove` finds that there.
    """
    folder = Path(source)
    if not drive_map.staging or request != TuneRequest() or not (folder / "design.toml").is_file():
        return None
    return load_design(folder / "design.toml") if RunDirectory(folder).read().passed("flash") else None


def stored_in(
    backup: Path | None, drive_map: DriveMap, source: MachineFile
) -> tuple[Mapping[str, float] | None, float | None]:
    """Return what a backup of a drive holds, by catalogue name, and the limit of its current (A peak).

    Raises ConfigError: it is not of a drive of the map.
    """
    if backup is None:
        return None, None
    snapshot = read_snapshot(backup)
    if not drive_map.is_for(snapshot.identity.vendor, snapshot.identity.product):
        raise ConfigError(
            f"the backup is not of a drive of the map {drive_map.name!r}", where=str(backup),
            hint="`pmsmtool backup --map NAME` of the drive that is tuned makes one",
        )  # fmt: skip
    held = snapshot_set(drive_map, snapshot.entries, own_torque(source, drive_map))
    return held.values, snapshot.current_limit_apk


def design_axis(
    source: MachineFile,
    request: TuneRequest,
    axis: AxisRequest,
    drive_map: DriveMap,
    stored: Mapping[str, float] | None = None,
    limit_apk: float | None = None,
    flashed: Design | None = None,
) -> Design:
    """Design the axis of a machine on a drive; what it holds is kept where that follows better with enough margin.

    Raises ConfigError: the machine file has no inertia, or gains do not fit the drive's types; DesignInfeasible: no
    gains keep the margins over the tolerance box.

    ``limit_apk``: the drive's own limit of its current (A peak), where that is known. ``flashed``: the design that the
    drive holds, which keeps all but its axis; its gains are the stored ones where no others are given.
    """
    drive = axis_drive(drive_map)
    if limit_apk is not None:
        drive = replace(drive, torque_nm=largest_torque(source.machine, limit_apk))
    made = with_axis(flashed or tune(source, request), axis, drive)
    if stored is None and flashed is not None:
        stored = flashed.parameter_set().values
    if stored is not None:
        made = at_least_as_good(made, stored, drive)
    elif drive.offers & {CASCADE[0], PID[0]}:
        made = made.noted({}, "whether the gains in the drive follow better is not known: --stored compares them")
    if drive_map.staging:
        return made.design
    lacking = not_offered(drive_map)
    notes = tuple(f"not written: {name}: {why}" for name, why in lacking.items())
    wanted = axis_parameters(made.design)
    fitting = dict(wanted.values)
    if DERIVATIVE in fitting:
        part = drive_map.cells[DERIVATIVE]
        fitting[DERIVATIVE] = max(part.low, 0.0) * part.factor
    for group in GROUPS:
        fitting |= _slowed(drive_map, group, wanted)
    if CASCADE[0] in fitting and fitting.get(SPEED[0], 0.0) > 0.0:  # no faster than the speed loop below it
        share = fitting[SPEED[0]] / wanted.values[SPEED[0]]
        fitting[CASCADE[0]] = min(fitting[CASCADE[0]], share * wanted.values[CASCADE[0]])
    less = _cut(drive_map, wanted)
    faster = [name for name, value in fitting.items() if value > wanted.values[name]]

    def as_held(share: float) -> Design:
        slowed = {name: share * fitting[name] for name in CASCADE[:1] if name in fitting}
        held = drive_map.quantised(replace(wanted, values=fitting | slowed | less)).values
        return made.with_held({name: value for name, value in held.items() if drive_map.writes(name, wanted.values)})

    design = as_held(1.0)
    if faster and CASCADE[0] in fitting and not design.facts["axis_margins_kept"]:
        # a speed loop with more integral gain than designed turns further, and leaves less to the position loop above
        slower_ones = (as_held(share) for share in SLOWER)
        design = next((found for found in slower_ones if found.facts["axis_margins_kept"]), design)
        fitting[CASCADE[0]] = min(fitting[CASCADE[0]], design[CASCADE[0]])
    slower = [name for name, value in fitting.items() if value < wanted.values[name]]
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
    if not design.facts["axis_margins_kept"]:
        phase, peak = (
            worst(float(design.facts[f"axis_{loop}_{fact}"]) for loop in ("speed", "position"))
            for worst, fact in ((min, "phase_least_deg"), (max, "S_peak_db"))
        )
        notes += (f"margins not met: {phase:.3g} deg and {peak:.3g} dB, asked for are {made.limits}",)
    if less.keys() & {CASCADE[2], LEAD} or CASCADE[0] in slower:  # the errors were predicted with all of it
        kept = {name: fact for name, fact in design.facts.items() if name not in PREDICTED}
        design = replace(design, facts=kept)
    return replace(design, notes=(*design.notes, *notes))


GROUPS = ({SPEED[0]: 1, SPEED[1]: 2}, {CASCADE[0]: 1}, {PID[0]: 2, PID[1]: 3, PID[2]: 1})
"""Gains of one controller, and the power of its crossover with which each grows."""
LEAST_DEG = 35.0
"""Least phase margin over the tolerance box with an integral time shorter than designed."""
SLOWER = (0.85, 0.7, 0.55, 0.4)
"""Position gains, over the designed one, that are tried in turn above such a speed loop."""
PREDICTED = ("axis_inertia_ff_share", "axis_following_error_rad", "axis_error_rad")


def _cut(drive_map: DriveMap, wanted: ParameterSet) -> dict[str, float]:
    """Return the feed-forwards that are beyond what their objects hold, as much as these do."""
    found = {}
    for name in (*SPEED_FORWARD, *CASCADE[1:], LEAD, *PID[3:]):
        if name in drive_map.cells and name in wanted.values and drive_map.writes(name, wanted.values):
            cell = drive_map.cells[name]
            counts = cell.counts(wanted.values[name], wanted.values)
            if counts > cell.largest:
                found[name] = wanted.values[name] * cell.largest / counts
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
        if counts and grows and cell.form != "time":
            share = min(share, (cell.largest / counts) ** (1.0 / grows))
    slowed = {cell.name: wanted.values[cell.name] * share**power for cell, power in rows}
    for cell, _ in rows:
        if cell.form == "time":
            slowed[cell.name] *= max(1.0, cell.counts(slowed[cell.name], {**wanted.values, **slowed}) / cell.largest)
    return slowed


def not_offered(drive_map: DriveMap) -> dict[str, str]:
    """Return the gains of an axis that a drive has no object for, with the reason its map gives."""
    position = PID[:3] if PID[0] in drive_map.cells else CASCADE[: 2 if LEAD in drive_map.cells else 3]
    return drive_map.not_written([name for name in (*SPEED, *position) if name not in drive_map.cells])


def axis_parameters(design: Design) -> ParameterSet:
    """Return what of a design is written for its axis."""
    whole = design.parameter_set()
    other = CASCADE[:2] if design.facts["axis_structure"] == "pid" else CASCADE[2:] if LEAD in whole.values else ()
    kept = {name: value for name, value in whole.values.items() if name in AXIS_ROWS and name not in other}
    said = {name: text for name, text in whole.provenance.items() if name in kept or name == "machine"}
    return replace(whole, values=kept, tables={}, provenance=said)
