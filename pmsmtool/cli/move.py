# SPDX-License-Identifier: MIT
"""``pmsmtool move``: a move by the drive's own position loop, there and back, and how well it followed."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pmsmtool.cli.drive_access import (
    WHOLE_SET_S,
    claimed_node,
    map_of_drive,
    map_option,
    new_file,
    new_run,
    open_node,
    runs_option,
)
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
    from pmsmtool.cli.consent import Consent
    from pmsmtool.machine.parameters import Estimate

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
        "pmsmtool -n 5 move --by 0.4rad --design axis.toml --flash --map epos4",
        "pmsmtool -n 5 move --by 90deg --speed 200rpm --acceleration 400 --map epos4",
    ),
)
@click.option("--by", "way_rad", type=Quantity("angle"), required=True, metavar="ANGLE", help="Way of the shaft there "
              "and back, e.g. 90deg.")  # fmt: skip
@click.option("--design", type=FILE, metavar="FILE", help="Take the limits of the move from this design of the axis, "
              "within the current limit.")  # fmt: skip
@click.option("--flash", is_flag=True, help="With --design: then write its values, once you agree to their list, and "
              "move again. One consent is for both moves.")  # fmt: skip
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
    bus: BusOptions, motion: MotionOptions, out: Output, way_rad: float, design: Path | None, flash: bool,
    speed_rad_s: float | None, acceleration: float | None, machine: str | None, path: Path | None, times: int | None,
    settle_s: float, runs: Path, map_file: Path | None,
) -> None:  # fmt: skip
    """Move the shaft by an angle and back with the position loop that the drive holds, and record how it followed.

    The drive runs the move itself (profile position mode) and shows its demand, so that following error, settling and
    current are those of its own loop. Nothing of the drive is changed for longer than the move. Do it before and after
    `flash-params`, then `pmsmtool diff RUN RUN` compares both: the same move with the stored and with the new gains.
    --flash does all three.

    With --identify: inertia and Coulomb friction of MACHINE from the current of the moves, for a drive without a torque
    mode. They rest on the flux linkage and the pole pairs of MACHINE. Exit code 6 when the moves do not identify them.
    """
    from pmsmtool.axis.drive import PROFILE
    from pmsmtool.axis.move import move_result
    from pmsmtool.cli.consent import ask_motion, keep
    from pmsmtool.cli.flash_session import flashed
    from pmsmtool.cli.flash_session import told as written
    from pmsmtool.commissioning.designed_move import (
        asked_profile,
        foretold_move,
        lent_profile,
        limits_of_move,
        move_stage,
        moved_machine,
    )
    from pmsmtool.commissioning.parameter_source import load_parameters
    from pmsmtool.design.design_file import load_design
    from pmsmtool.drive.envelope import Envelope, largest_acceleration
    from pmsmtool.drive.guard import guarded
    from pmsmtool.drive.motion_objects import first_of_axes, held_current_limits, low_limits
    from pmsmtool.drive.own_limits import refuse_no_current
    from pmsmtool.drive.position_drive import PositionDrive
    from pmsmtool.errors import ConfigError, LimitExceeded
    from pmsmtool.experiments.move import record_move
    from pmsmtool.files import write_file
    from pmsmtool.flash.download import set_named
    from pmsmtool.flash.map_gate import check_motion
    from pmsmtool.flash.restore import tell_lacking
    from pmsmtool.machine.machine_file import dump_machine_file, load_machine_file
    from pmsmtool.params.catalogue import BY_NAME
    from pmsmtool.plain_text import counted
    from pmsmtool.trace import trace_npz
    from pmsmtool.units import rad_s_from_rpm

    if not way_rad:
        raise ConfigError("--by 0 moves nothing", hint="give a way, e.g. --by 90deg")
    if flash and (design is None or machine is not None):
        raise click.UsageError("--flash writes the values of --design, and goes without --identify")
    source = None if machine is None else load_machine_file(machine)
    times = times or (1 if source is None else IDENTIFY_TIMES)
    drive_map = map_of_drive(bus, map_file)
    agreed: tuple[Any, Consent] | None = None
    predicted: list[str] = []
    made = None if design is None else load_design(design)

    def moved(after: str = "") -> dict[str, Any]:
        """Move there and back, keep the run, and return what is told of it."""
        nonlocal agreed
        with bus.connect() as connection:
            drive = PositionDrive(connection, claimed_node(connection, bus.node), drive_map=drive_map)
            check_motion(drive.node.map, drive.identity)
            i_max = motion.i_max_apk or drive.current_allowed_apk
            kept = held_current_limits(drive.node, drive.rated_apk)
            given = min([i_max, *(apk for _, apk in kept)])
            refuse_no_current(drive.node, given)
            limits = None if made is None else limits_of_move(made, given, speed_rad_s, acceleration)
            profile = asked_profile(limits, speed_rad_s, acceleration)
            lent, find = lent_profile(drive, profile)
            speed = profile.get(PROFILE[0]) or (drive.read(PROFILE[0]) if PROFILE[0] in drive.node.map.cells else None)
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
            foretold = None
            if made is not None and limits is not None:
                foretold = foretold_move(made, drive.node.map, gains, way_rad, limits, given)
            lines = [
                *envelope.lines(),
                *first_of_axes(drive.node),
                *low_limits(drive.node, drive.rated_apk),
                f"the shaft moves by {math.degrees(way_rad):.4g} deg and back with the drive's own position loop, "
                f"{counted(times, 'time')}",
                f"voltage off where the shaft is {math.degrees(ERROR_SHARE * abs(way_rad)):.3g} deg behind and comes "
                "no nearer",
                *(foretold.lines(drive.error_limit_rad) if foretold else []),
                "before that it turns by a degree with little current, to see that it does not run away",
                *([] if find is None else ["its profile is found first by slower moves within this way"]),
                *(f"changed for the move: {name} {value:.5g} {BY_NAME[name].unit}" for name, value in lent.items()),
                "nothing is stored in the drive; every changed object is restored",
                *([after] if after else []),
            ]  # fmt: skip
            same = (drive.identity.serial, envelope, lent, find)
            if agreed is None or agreed[0] != same:  # one consent is for both moves, and for nothing else
                asked = ask_motion(lines, motion, simulated=bus.simulated(), serial=drive.identity.serial, out=out)
                agreed = same, asked
            elif foretold:
                out.note(foretold.lines(drive.error_limit_rad)[0])
            run = new_run(bus, drive, runs)
            keep(run, agreed[1])
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
        run.add(move_stage(found, gains, foretold, seconds, doubts, TRACE))
        told: dict[str, Estimate] = {}
        if source is not None:
            completed, told = moved_machine(source, trace, drive, run)
            if "tau_c_nm" not in told:
                out.warn("tau_c_nm not identified: these moves show no friction above zero; longer ones (--by) may")
            if path is not None:
                write_file(path, dump_machine_file(completed))
                out.note(f"wrote {path}")
        predicted[:] = [f"predicted: {foretold}"] if foretold else []
        out.note(f"run: {run.path}")
        return {"run": run.path, "move": asdict(found), "gains": gains, "lent": lent, "profile": counts,
                "identified": told, "predicted": foretold and asdict(foretold)}  # fmt: skip

    if design is None or not flash:
        data = moved()
        out.result("move", data, lambda: [*_lines(data), *predicted, *_told(data["identified"])])
        return
    data = {"run": None, "move": None, "before": None}
    ended: LimitExceeded | None = None
    try:
        data["before"] = moved(f"then the values of {design} are written, once you agree, and it moves again")
    except LimitExceeded as error:
        out.warn(f"the drive's own gains cannot do this move: {error.what}")
    with set_named() as jobs, open_node(bus, drive_map, within_s=WHOLE_SET_S) as node:
        _, plan, outcome = flashed(node, jobs, load_parameters(design, drive_map), bus, motion, out)
        out.note(written(outcome, node))
    try:
        data |= moved()
    except LimitExceeded as error:
        ended = error
    out.result("move", data, lambda: [*_lines(data), *predicted])
    if ended is not None:
        raise ended
    tell_lacking(node, plan)


IDENTIFY_TIMES = 4
"""Moves there and back for inertia and friction: sixteen halves."""


def _told(found: dict[str, Estimate]) -> list[str]:
    from pmsmtool.estimators.estimate import total_half_width

    rows = [
        (name, f"{e.value:.4g}", f"{total_half_width(e):.2g}", e.unit, e.fallback or "-") for name, e in found.items()
    ]
    return ["", *table(("identified", "value", "+- 95 %", "unit", "note"), rows)] if rows else []


def _lines(data: dict[str, Any]) -> list[str]:
    """Return what a person reads of a move, beside the one before the values were written."""
    from pmsmtool.axis.move import UNITS, shown

    moves = {"before": data["before"], "after": data} if "before" in data else {"value": data}
    rows = [
        (name.rpartition("_")[0] or name,
         *(shown(one["move"][name], unit) if one and one["move"] else "cannot do it" for one in moves.values()))
        for name, unit in UNITS.items()
    ]  # fmt: skip
    return table(("move", *moves), rows)
