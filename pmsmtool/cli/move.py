# SPDX-License-Identifier: MIT
"""``pmsmtool move``: a move by the drive's own position loop, there and back, and how well it followed."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
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
from pmsmtool.errors import ConfigError, LimitExceeded
from pmsmtool.files import write_file

if TYPE_CHECKING:
    from pmsmtool.cli.consent import Consent
    from pmsmtool.commissioning.move import PlannedMove
    from pmsmtool.drive_maps.drive_map import DriveMap
    from pmsmtool.machine.machine_file import MachineFile
    from pmsmtool.machine.parameters import Estimate

IDENTIFY_TIMES, COGGING_TIMES = 4, 2
"""Moves there and back for inertia and friction, sixteen halves; and for cogging."""
COGGING_RAD_S, COGGING_RAMP = math.pi, 0.05
"""Speed of these, 30 rpm, where none is given, and both of their ramps, of the way."""
COGGING_SPEEDS, COGGING_TRAVEL = 4.0, 1.1
"""Limits of them over speed and way: cogging pulls the shaft on from one rest to the next."""


@click.command(
    "move",
    epilog=examples(
        "pmsmtool -n 5 move --by 90deg --map epos4 --shaft coupled",
        "pmsmtool -n 5 move --by 0.4rad --design axis.toml --flash --map epos4",
        "pmsmtool -n 5 move --by 90deg --speed 200rpm --acceleration 4000rpm/s --map epos4",
    ),
)
@click.option("--by", "way_rad", type=Quantity("angle"), required=True, metavar="ANGLE", help="Way of the shaft there "
              "and back, e.g. 90deg.")  # fmt: skip
@click.option("--design", type=FILE, metavar="FILE", help="Take the limits of the move from this design of the axis, "
              "within the current limit.")  # fmt: skip
@click.option("--flash", is_flag=True, help="With --design: then write its values, once you agree to their list, and "
              "move again. One consent is for both moves.")  # fmt: skip
@click.option("--speed", "speed_rad_s", type=SPEED, help="Speed of the move.  [default: as the drive holds it]")
@click.option("--acceleration", type=Quantity("angular acceleration", positive=True, bare=True), metavar="ACCELERATION",
              help="Acceleration of the move, e.g. 3000rpm/s.  [default: as the drive holds it]")  # fmt: skip
@click.option("--identify", "machine", metavar="MACHINE", help="Find inertia and friction of this machine (a machine "
              "file) from the moves.")  # fmt: skip
@click.option("--cogging", metavar="MACHINE", help="Find the cogging of this machine over the way, by slow moves: a "
              "part of a turn.")  # fmt: skip
@new_file("path", help="Machine file to write with what was found.  [default: machine.toml of the run]")
@click.option("--times", type=click.IntRange(1, 20), help="Moves there and back.  [default: 1; 2 with --cogging, 4 "
              "with --identify]")  # fmt: skip
@click.option("--settle", "settle_s", type=DURATION, default="0.5s", help="How long to look on after the demand ended.")
@runs_option
@map_option
@bus_options
@motion_options
@output_options
def move_command(
    bus: BusOptions, motion: MotionOptions, out: Output, way_rad: float, design: Path | None, flash: bool,
    speed_rad_s: float | None, acceleration: float | None, machine: str | None, cogging: str | None, path: Path | None,
    times: int | None, settle_s: float, runs: Path, map_file: Path | None,
) -> None:  # fmt: skip
    """Move the shaft by an angle and back with the position loop that the drive holds, and record how it followed.

    The drive runs the move itself (profile position mode) and shows its demand, so that following error, settling and
    current are those of its own loop. Nothing of the drive is changed for longer than the move. Do it before and after
    `flash-params`, then `pmsmtool diff RUN RUN` compares both: the same move with the stored and with the new gains.
    --flash does all three.

    With --identify: inertia and Coulomb friction of MACHINE from the current of the moves, for a drive without a torque
    mode. They rest on the flux linkage and the pole pairs of MACHINE. Exit code 6 when the moves do not identify them.

    With --cogging: torque over the angle of a shaft that may not turn round, by order, and a table of the way (30 rpm
    unless --speed says otherwise). It rests on flux linkage, pole pairs and inertia of MACHINE.
    """
    from pmsmtool.cli.flash_session import flashed
    from pmsmtool.cli.flash_session import told as outcome_line
    from pmsmtool.commissioning.move import inertia_of, moved_cogging, moved_machine, plan_move
    from pmsmtool.commissioning.parameter_source import load_parameters
    from pmsmtool.design.design_file import load_design
    from pmsmtool.drive.envelope import Envelope
    from pmsmtool.flash.download import set_named
    from pmsmtool.flash.restore import tell_lacking
    from pmsmtool.machine.machine_file import load_machine_file

    if not way_rad:
        raise ConfigError("--by 0 moves nothing", hint="give a way, e.g. --by 90deg")
    if flash and (design is None or machine or cogging):
        raise click.UsageError("--flash writes the values of --design, and goes without --identify and --cogging")
    if machine and cogging:
        raise click.UsageError("--identify takes fast moves and --cogging slow ones: one after the other")
    name = machine or cogging
    source = None if name is None else load_machine_file(name)
    drive_map = map_of_drive(bus, map_file)
    speed_max_rad_s, travel_rad = motion.speed_max_rad_s or math.inf, math.inf
    if cogging and source is not None:
        inertia_of(source)  # before anything moves
        speed_rad_s = speed_rad_s or COGGING_RAD_S
        acceleration = acceleration or speed_rad_s**2 / (COGGING_RAMP * abs(way_rad))
        speed_max_rad_s = min(speed_max_rad_s, COGGING_SPEEDS * speed_rad_s)
        travel_rad, times = COGGING_TRAVEL * abs(way_rad), times or COGGING_TIMES
    allowed = Envelope(
        i_max_apk=motion.i_max_apk or math.inf, speed_max_rad_s=speed_max_rad_s, travel_rad=travel_rad,
        shaft=motion.shaft or "free", load=motion.load, brake=motion.brake,
    )  # fmt: skip
    plan = partial(
        plan_move, allowed=allowed, way_rad=way_rad, times=times or (1 if source is None else IDENTIFY_TIMES),
        design=None if design is None else load_design(design), speed_rad_s=speed_rad_s, acceleration=acceleration,
    )  # fmt: skip
    find = moved_cogging if cogging else moved_machine
    moves = _Moves(bus, motion, out, runs, drive_map, plan, find, settle_s, {}, [])
    if design is None or not flash:
        data = moves.make(source, path)
        out.result("move", data, lambda: [*_lines(data), *_told(data["identified"])])
        return
    data = {"run": None, "move": None, "before": None}
    ended: LimitExceeded | None = None
    try:
        then = f"then the values of {design} are written, once you agree, and it moves again"
        data["before"] = moves.make(then=[then])
    except LimitExceeded as error:
        out.warn(f"the drive's own gains cannot do this move: {error.what}")
    with set_named() as jobs, open_node(bus, drive_map, within_s=WHOLE_SET_S) as node:
        _, written, outcome = flashed(node, jobs, load_parameters(design, drive_map), bus, motion, out)
        out.note(outcome_line(outcome, node))
    try:
        data |= moves.make()
    except LimitExceeded as error:
        ended = error
    out.result("move", data, lambda: _lines(data))
    if ended is not None:
        raise ended
    tell_lacking(node, written)


@dataclass(frozen=True, slots=True)
class _Moves:
    """The moves of one command; ``agreed``: the consents that were given, by what each is about."""

    bus: BusOptions
    motion: MotionOptions
    out: Output
    runs: Path
    drive_map: DriveMap
    plan: Callable[..., PlannedMove]
    find: Callable[..., tuple[MachineFile, dict[str, Estimate]]]
    settle_s: float
    agreed: dict[object, Consent]
    planned: list[PlannedMove]
    """The moves so far: each is as the first."""

    def make(
        self, source: MachineFile | None = None, path: Path | None = None, then: Sequence[str] = ()
    ) -> dict[str, Any]:
        """Ask unless it is agreed to, move there and back, keep the run, and return what is told of it.

        ``source``: machine of which something is found, written to ``path``; ``then``: what follows the move.
        """
        from pmsmtool.cli.consent import ask_motion, keep
        from pmsmtool.commissioning.move import make_move
        from pmsmtool.drive.position_drive import PositionDrive
        from pmsmtool.flash.map_gate import check_motion
        from pmsmtool.machine.machine_file import dump_machine_file

        out = self.out
        with self.bus.connect() as connection:
            drive = PositionDrive(connection, claimed_node(connection, self.bus.node), drive_map=self.drive_map)
            check_motion(drive.node.map, drive.identity)
            planned = self.plan(drive, like=self.planned[0] if self.planned else None)
            self.planned.append(planned)
            serial, foretold = drive.identity.serial, planned.foretold
            about = serial, planned.envelope, tuple(planned.lent.items()), planned.find
            if about not in self.agreed:  # one consent is for both moves, and for nothing else
                lines = [*planned.lines(drive), *then]
                self.agreed[about] = ask_motion(
                    lines, self.motion, simulated=self.bus.simulated(), serial=serial, out=out
                )
            elif foretold:
                out.note(foretold.lines(planned.error_limit_rad)[0])
            run = new_run(self.bus, drive, self.runs)
            keep(run, self.agreed[about])
            found, counts, trace = make_move(drive, planned, self.settle_s, run, out.note)
        if counts is not None:
            out.note(f"changed for the move: {counts}")
        for line in trace.meta["doubts"]:
            out.warn(line)
        told: dict[str, Estimate] = {}
        if source is not None:
            completed, told = self.find(source, trace, drive, run)
            stage = run.read().stage("cogging")
            for line in () if stage is None else stage.fallbacks:
                out.warn(line)
            if stage is None and "tau_c_nm" not in told:
                out.warn("tau_c_nm not identified: these moves show no friction above zero; longer ones (--by) may")
            if path is not None:
                write_file(path, dump_machine_file(completed))
                out.note(f"wrote {path}")
        out.note(f"run: {run.path}")
        return {"run": run.path, "move": found, "gains": planned.gains, "lent": planned.lent, "profile": counts,
                "identified": told, "predicted": foretold}  # fmt: skip


def _told(found: dict[str, Estimate]) -> list[str]:
    from pmsmtool.estimators.estimate import total_half_width

    rows = [
        (name, f"{e.value:.4g}", f"{total_half_width(e):.2g}", e.unit, e.fallback or "-") for name, e in found.items()
    ]
    return ["", *table(("identified", "value", "+- 95 %", "unit", "note"), rows)] if rows else []


def _lines(data: dict[str, Any]) -> list[str]:
    """Return what a person reads of a move, beside the one before the values were written."""
    from pmsmtool.axis.move import UNITS, shown

    runs = {"before": data["before"], "after": data} if "before" in data else {"value": data}
    moves = {name: run and run["move"] for name, run in runs.items()}
    rows = [
        (name.rpartition("_")[0] or name,
         *(shown(getattr(move, name), unit) if move else "cannot do it" for move in moves.values()))
        for name, unit in UNITS.items()
    ]  # fmt: skip
    foretold = data.get("predicted")
    return [*table(("move", *moves), rows), *([f"predicted: {foretold}"] if foretold else [])]
