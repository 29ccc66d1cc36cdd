# SPDX-License-Identifier: MIT
"""``pmsmtool move``: a move by the drive's own position loop, there and back, and how well it followed."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pmsmtool.cli.drive_access import claimed_node, map_of_drive, map_option, new_file, new_run, runs_option
from pmsmtool.cli.options import (
    DURATION,
    FILE,
    SPEED,
    BusOptions,
    MotionOptions,
    Quantity,
    bus_options,
    examples,
    motion_options,
    output_options,
)
from pmsmtool.cli.output import Output, table

if TYPE_CHECKING:
    from pmsmtool.axis.move import MoveResult, Profile
    from pmsmtool.drive.position_drive import PositionDrive
    from pmsmtool.machine.machine_file import MachineFile
    from pmsmtool.machine.parameters import Estimate
    from pmsmtool.run_directory import RunDirectory
    from pmsmtool.trace import Trace

TRAVEL_MARGIN, SPEED_MARGIN = 1.5, 1.5
"""Limits over what is asked for: more ends the move. Calm gains of makers' tools go 30 % beyond a way of 60 degrees."""
ERROR_SHARE = 0.5
"""Following error at which the voltage is removed, of the way."""
DURATION_S = 45.0
TRACE = "traces/move.npz"


@click.command(
    "move",
    epilog=examples(
        "pmsmtool -n 5 move --by 90deg --map epos4 --shaft coupled",
        "pmsmtool -n 5 move --by 0.4rad --design axis.toml --map epos4",
        "pmsmtool -n 5 move --by 90deg --speed 200rpm --acceleration 400 --map epos4",
    ),
)
@click.option("--by", "way_rad", type=Quantity("angle"), required=True, metavar="ANGLE", help="Way of the shaft there "
              "and back, e.g. 90deg.")  # fmt: skip
@click.option("--design", type=FILE, metavar="FILE", help="Take the limits of the move from this design of the axis, "
              "within the current limit.")  # fmt: skip
@click.option("--speed", "speed_rad_s", type=SPEED, help="Speed of the move.  [default: as the drive holds it]")
@click.option("--acceleration", type=float, metavar="RAD/S2", help="Acceleration of the move.  [default: as the drive "
              "holds it]")  # fmt: skip
@click.option("--identify", "machine", metavar="MACHINE", help="Find inertia and friction of this machine (a machine "
              "file) from the moves.")  # fmt: skip
@new_file("path", help="Machine file to write with what --identify found.  [default: machine.toml of the run]")
@click.option("--times", type=click.IntRange(1, 20), help="Moves there and back.  [default: 1, with --identify 4]")
@click.option("--settle", "settle_s", type=DURATION, default="0.5s", help="How long to look on after the demand ended.")
@runs_option
@map_option
@bus_options
@motion_options
@output_options
def move_command(
    bus: BusOptions, motion: MotionOptions, out: Output, way_rad: float, design: Path | None, speed_rad_s: float | None,
    acceleration: float | None, machine: str | None, path: Path | None, times: int | None, settle_s: float, runs: Path,
    map_file: Path | None,
) -> None:  # fmt: skip
    """Move the shaft by an angle and back with the position loop that the drive holds, and record how it followed.

    The drive runs the move itself (profile position mode) and shows its demand, so that following error, settling and
    current are those of its own loop. Nothing of the drive is changed for longer than the move. Do it before and after
    `flash-params`, then `pmsmtool diff RUN RUN` compares both: the same move with the stored and with the new gains.

    With --identify: inertia and Coulomb friction of MACHINE from the current of the moves, for a drive without a torque
    mode. They rest on the flux linkage and the pole pairs of MACHINE. Exit code 6 when the moves do not identify them.
    """
    from pmsmtool.axis.move import UNITS, move_result, shown
    from pmsmtool.cli.consent import ask_motion, keep
    from pmsmtool.commissioning.designed_move import foretold_move, limits_of_move
    from pmsmtool.design.design_file import load_design
    from pmsmtool.drive.envelope import Envelope, largest_acceleration
    from pmsmtool.drive.guard import guarded
    from pmsmtool.drive.motion_objects import first_of_axes, held_current_limits, low_limits
    from pmsmtool.drive.own_limits import refuse_no_current
    from pmsmtool.drive.position_drive import PositionDrive
    from pmsmtool.errors import ConfigError
    from pmsmtool.experiments.move import record_move
    from pmsmtool.flash.map_gate import check_motion
    from pmsmtool.machine.machine_file import load_machine_file
    from pmsmtool.run_directory import Stage
    from pmsmtool.trace import trace_npz
    from pmsmtool.units import rad_s_from_rpm

    if not way_rad:
        raise ConfigError("--by 0 moves nothing", hint="give a way, e.g. --by 90deg")
    source = None if machine is None else load_machine_file(machine)
    times = times or (1 if source is None else IDENTIFY_TIMES)
    drive_map = map_of_drive(bus, map_file)
    with bus.connect() as connection:
        drive = PositionDrive(connection, claimed_node(connection, bus.node), drive_map=drive_map)
        check_motion(drive.node.map, drive.identity)
        i_max = motion.i_max_apk or drive.current_allowed_apk
        kept = held_current_limits(drive.node, drive.rated_apk)
        given = min([i_max, *(apk for _, apk in kept)])
        refuse_no_current(drive.node, given)
        made = None if design is None else load_design(design)
        limits = None if made is None else limits_of_move(made, given, speed_rad_s, acceleration)
        profile = _asked(limits, speed_rad_s, acceleration)
        lent, find = _lent(drive, profile)
        speed = profile.get(_SPEED) or _held(drive, _SPEED)
        speed_max = motion.speed_max_rad_s or (SPEED_MARGIN * rad_s_from_rpm(speed) if speed else None)
        if speed_max is None:
            unknown = "the speed of the drive's own move is not known: its map has no row for it"
            raise ConfigError(unknown, hint="give --speed and --acceleration, or --speed-max")
        envelope = Envelope(
            i_max_apk=i_max, speed_max_rad_s=speed_max, duration_s=DURATION_S * times, load=motion.load,
            travel_rad=TRAVEL_MARGIN * abs(way_rad), shaft=motion.shaft or "free", brake=motion.brake,
            acceleration_rad_s2=None if made is None else largest_acceleration(made.machine.machine, i_max),
        )  # fmt: skip
        envelope.refuse_gravity()
        gains = drive.held_gains()
        drive.error_limit_rad = ERROR_SHARE * abs(way_rad)
        foretold = made and limits and foretold_move(made, drive.node.map, gains, way_rad, limits, given)
        lines = [
            *envelope.lines(),
            *first_of_axes(drive.node),
            *low_limits(drive.node, drive.rated_apk),
            f"the shaft moves by {math.degrees(way_rad):.4g} deg and back with the drive's own position loop, {times} "
            f"time{'s' if times > 1 else ''}",
            f"voltage off where the shaft is {math.degrees(drive.error_limit_rad):.3g} deg behind and comes no nearer",
            *(foretold.lines(drive.error_limit_rad) if foretold else []),
            "before that it turns by a degree with little current, to see that it does not run away",
            *([] if find is None else ["its profile is found first by slower moves within this way"]),
            *(f"changed for the move: {name} {value:.5g} {_unit(name)}" for name, value in lent.items()),
            "nothing is stored in the drive; every changed object is restored",
        ]  # fmt: skip
        consent = ask_motion(lines, motion, simulated=bus.simulated(), serial=drive.identity.serial, out=out)
        run = new_run(bus, drive, runs)
        keep(run, consent)
        with guarded(drive, envelope, say=out.note) as guard:
            guard.write(lent)
            began = connection.clock.now()
            trace, counts = record_move(guard, drive, way_rad, settle_s, times, find)
            seconds = connection.clock.now() - began
        drive.close()
    if counts is not None:
        out.note(f"changed for the move: {counts}")
    run.save(TRACE, trace_npz(trace))
    found = move_result(trace)
    for line in (doubts := trace.meta["doubts"]):
        out.warn(line)
    values = [{"name": name, "value": float(getattr(found, name)), "unit": unit} for name, unit in UNITS.items()]
    values += [{"name": name, "value": value, "unit": _unit(name)} for name, value in gains.items()]
    summary = f"following error at most {shown(found.error_peak_rad, 'rad')}"
    if foretold:
        values += foretold.rows()
        summary += f" (predicted: {foretold})"
    run.add(
        Stage(
            "move", "pass", seconds, values=values, files={TRACE: ""}, fallbacks=doubts,
            summary=f"{summary}, settling: {shown(found.settling_s, 's')}",
        )
    )  # fmt: skip
    told = {} if source is None else _identified(source, trace, drive, run, path, out)
    data = {"run": run.path, "move": asdict(found), "gains": gains, "lent": lent, "profile": counts, "identified": told,
            "predicted": foretold and asdict(foretold)}  # fmt: skip
    out.result("move", data, lambda: [*_lines(found), *([f"predicted: {foretold}"] if foretold else []), *_told(told)])
    out.note(f"run: {run.path}")


IDENTIFY_TIMES = 4
"""Moves there and back for inertia and friction: sixteen halves."""


def _identified(
    source: MachineFile, trace: Trace, drive: PositionDrive, run: RunDirectory, path: Path | None, out: Output
) -> dict[str, Estimate]:
    """Find inertia and friction, write the machine file, and return both."""
    from pmsmtool.commissioning.compared_stage import refuse_inertia
    from pmsmtool.commissioning.contradiction import flux_doubt
    from pmsmtool.files import write_file
    from pmsmtool.identification.completed_machine import PER_PSI, completed_machine
    from pmsmtool.identification.move_mechanics import move_mechanics
    from pmsmtool.machine.machine_file import dump_machine_file

    ratios = move_mechanics(
        trace, pole_pairs=source.machine.pole_pairs, undecided=drive.current_undecided, rated_apk=drive.rated_apk
    )
    refuse_inertia(source, ratios["J_per_psi"], run)
    made = completed_machine(source, ratios, "as given", flux_doubt(source)).machine
    assert made is not None
    if "tau_c_per_psi" not in ratios:
        out.warn("tau_c_nm not identified: these moves show no friction above zero; longer ones (--by) may")
    text = dump_machine_file(made)
    run.save("machine.toml", text)
    if path is not None:
        write_file(path, text)
        out.note(f"wrote {path}")
    return {name: made.estimates[name] for ratio, name in PER_PSI.items() if ratio in ratios}


def _told(found: dict[str, Estimate]) -> list[str]:
    from pmsmtool.estimators.estimate import total_half_width

    rows = [
        (name, f"{e.value:.4g}", f"{total_half_width(e):.2g}", e.unit, e.fallback or "-") for name, e in found.items()
    ]
    return ["", *table(("identified", "value", "+- 95 %", "unit", "note"), rows)] if rows else []


_SPEED, _UP, _DOWN, _JERK = (
    "reference.profile_speed_rpm", "reference.profile_acceleration_rpm_per_s",
    "reference.profile_deceleration_rpm_per_s", "reference.profile_jerk_rpm_per_s2",
)  # fmt: skip


def _unit(name: str) -> str:
    from pmsmtool.params.catalogue import BY_NAME

    return BY_NAME[name].unit


def _asked(limits: Profile | None, speed_rad_s: float | None, acceleration: float | None) -> dict[str, float]:
    """Return the limits of the move by catalogue name: those of a design, or those that are asked for."""
    from pmsmtool.units import rpm_from_rad_s

    given = (speed_rad_s, acceleration, None) if limits is None else (limits.speed, limits.acceleration, limits.jerk)
    rows = ((_SPEED,), (_UP, _DOWN), (_JERK,))
    return {
        name: rpm_from_rad_s(value) for value, names in zip(given, rows, strict=True) if value for name in names
    }  # fmt: skip


def _lent(drive: PositionDrive, profile: dict[str, float]) -> tuple[dict[str, float], tuple[float, float] | None]:
    """Return what of a profile this drive can be lent by its map, and what is to be found by its demand (rad/s)."""
    from pmsmtool.errors import ConfigError
    from pmsmtool.units import rad_s_from_rpm

    cells = drive.node.map.cells
    if not profile or all(name in cells for name in profile if name != _JERK):
        return {name: value for name, value in profile.items() if name in cells}, None
    if not {_SPEED, _UP} <= set(profile):
        lacks = f"the map {drive.node.map.name!r} lacks units of the profile"
        raise ConfigError(lacks, hint="give both --speed and --acceleration")
    return {}, (rad_s_from_rpm(profile[_SPEED]), rad_s_from_rpm(profile[_UP]))


def _held(drive: PositionDrive, name: str) -> float | None:
    return drive.read(name) if name in drive.node.map.cells else None


def _lines(found: MoveResult) -> list[str]:
    from pmsmtool.axis.move import UNITS, shown

    rows = [(name.rpartition("_")[0] or name, shown(float(getattr(found, name)), unit)) for name, unit in UNITS.items()]
    return table(("move", "value"), rows)
