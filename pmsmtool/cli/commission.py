# SPDX-License-Identifier: MIT
"""``pmsmtool commission``: from an unknown machine to flashed and proven parameters, in one command."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pmsmtool.cli.drive_access import REHEARSED, map_option, new_run, read_map, rehearsal_bus, runs_option
from pmsmtool.cli.options import (
    DIR,
    FILE,
    HZ,
    BusOptions,
    MotionOptions,
    bus_options,
    examples,
    motion_options,
    output_options,
    overspeed_option,
)
from pmsmtool.cli.output import Output
from pmsmtool.cli.progress import StageProgress
from pmsmtool.errors import ConfigError, Contradiction, Declined, ExitCode, IdentificationError, NotAvailable
from pmsmtool.files import read_text

if TYPE_CHECKING:
    from pmsmtool.drive.canopen_drive import CanopenDrive
    from pmsmtool.drive_maps.drive_map import DriveMap
    from pmsmtool.measurement.capabilities import Capabilities
    from pmsmtool.report.verdict import Verdict
    from pmsmtool.run_directory import RunDirectory

STAGES = ("identify", "tune", "lut", "margins", "flash", "verify", "prove")
LIMITS = ("current", "speed")
"""As in ``commissioning.commission`` and ``commissioning.closed_stage``, which take too long to import for
``--help``."""


@click.command(
    "commission",
    epilog=examples(
        "pmsmtool commission --sim interior-2k2 --yes",
        "pmsmtool commission --sim saturated-pmsyrm --flux-map --i-max 20Apk --yes",
        "pmsmtool commission drive.toml -i socketcan -c can0 -n 5 --map epos4 --i-max 12Apk --speed-max 3000rpm",
        "pmsmtool commission --resume runs/20260101T120000Z-000055f1",
    ),
)
@click.argument("machine", required=False, type=FILE)
@click.option("--resume", type=DIR, metavar="RUN_DIR", help="Go on with a run where it ended, with its motor file "
              "and its limits; options of the design are given again.")  # fmt: skip
@click.option("--rehearse", is_flag=False, flag_value="", metavar="FAMILY", help="Rehearse: MACHINE, simulated, behind "
              "the map of a drive family, or with --eds alone.")  # fmt: skip
@click.option("--eds", metavar="FILE", help="Rehearse: MACHINE, simulated, behind the EDS or DCF of its drive.")
@runs_option
@click.option("--flux-map", is_flag=True, help="Measure the flux map, and design with it, whether the machine "
              "saturates or not.")  # fmt: skip
@click.option("--bandwidth-hz", type=HZ, metavar="HZ", help="Bandwidth of the current loops.  [default: modulus "
              "optimum, lowered to the margins]")  # fmt: skip
@click.option("--phase-margin-deg", type=float, default=45.0, metavar="DEG", help="Least phase margin of the design.")
@click.option("--gain-margin-db", type=float, default=6.0, metavar="DB", help="Least gain margin of the design.")
@click.option(
    "--field-weakening",
    type=click.Choice(["lookup", "accelerated", "gradient", "off"]),
    default="lookup",
    help="Where the drive's current references come from: the table, or an optimisation in the drive.",
)
@overspeed_option
@click.option("--drive-bandwidth-hz", type=click.FloatRange(0.0, min_open=True), metavar="HZ", help="Current "
              "bandwidth of a drive with fixed firmware; its limits are then designed.")  # fmt: skip
@click.option("--require", multiple=True, type=click.Choice(STAGES), metavar="STAGE", help="A stage without which the "
              "run fails (exit 1) instead of ending partial (exit 10); may be repeated.")  # fmt: skip
@click.option("--accept-limit", "accept_limits", multiple=True, type=click.Choice(LIMITS), metavar="NAME",
              help="Accept a design that ends below the machine's rated current or speed; may be repeated. On a real "
              "bus not together with --yes.")  # fmt: skip
@click.option("--sensor-tol", type=click.FloatRange(0.0, 0.2), default=0.01, help="95 % tolerance of sensor gains.")
@click.option("--accept-contradiction", "accept", multiple=True, metavar="NAME", help="Go on although MACHINE states "
              "another R_s_ohm, L_q_h or J_kgm2 than was measured or the drive holds; never with --yes.")  # fmt: skip
@map_option
@bus_options
@motion_options
@output_options
def commission_command(
    bus: BusOptions,
    motion: MotionOptions,
    out: Output,
    machine: Path | None,
    resume: Path | None,
    rehearse: str | None,
    eds: str | None,
    runs: Path,
    map_file: Path | None,
    sensor_tol: float,
    accept: tuple[str, ...],
    flux_map: bool,
    drive_bandwidth_hz: float | None,
    require: tuple[str, ...],
    accept_limits: tuple[str, ...],
    **design: Any,
) -> None:
    """Identify the machine, design its control, make the table, judge the margins, flash, verify, prove, report.

    MACHINE is a machine file with what is known (ratings, limits), or a profile. Without it the drive's own ratings
    are the start.
    Consents are asked one by one: the motion envelope before anything moves, the list of differences before anything
    is written, and the envelope of the proof, which runs the flashed drive up to its designed limits. The chain ends
    at the first criterion that is not met, with the drive off and restored; --resume goes on there. A simulated drive
    starts from factory memory unless its channel names a memory file (nv=).

    On a drive that gives less than the reference drive (`pmsmtool caps`) every stage runs as far as its capability
    level and its map allow. What is not measured is taken from MACHINE and marked so; a stage that cannot run names
    what it needs.
    --rehearse and --eds need no hardware: MACHINE runs simulated behind the dictionary of such a drive.

    The verdict is PASS (exit 0) only when all seven stages ran and nothing stayed unchecked, FAIL (exit 1) when a
    criterion is not met, a stage of --require is missing, or the design ends below the machine's rated current or
    speed, else PARTIAL (exit 10), with the reason for every stage that did not run.
    """
    from pmsmtool.cli.caps import refused_of_design
    from pmsmtool.cli.consent import refuse_unattended
    from pmsmtool.commissioning.commission import Commissioning
    from pmsmtool.commissioning.compared_stage import check_accepted
    from pmsmtool.flash.journal import JournalFolder
    from pmsmtool.flash.map_gate import forget_map
    from pmsmtool.machine.machine_file import load_machine_file
    from pmsmtool.run_directory import RunDirectory
    from pmsmtool.sim.foreign.drive import assumptions_of

    if rehearse is not None or eds is not None:
        if resume is not None:
            raise click.UsageError("--resume goes on with the drive of its run: not together with --rehearse or --eds")
        if rehearse == "" and eds is None:
            raise click.UsageError("--rehearse needs the name of a drive family, or --eds FILE")
        bus = rehearsal_bus(bus, eds=eds, family=rehearse or None, machine=machine)
        if machine is None:
            out.note(f"no MACHINE is given: the motor of {REHEARSED} is simulated, its values are unknown")
        for line in assumptions_of(eds, load_machine_file(machine)) if eds is not None and machine is not None else ():
            out.warn(f"{eds}: {line}")
    if accept and motion.yes:
        raise click.UsageError("--accept-contradiction needs a person at the terminal: not together with --yes")
    check_accepted(accept)
    refuse_unattended("--accept-limit", accept_limits, motion, simulated=bus.simulated())

    begun = RunDirectory(resume) if resume is not None else None
    if begun is not None and machine is not None:
        raise ConfigError("MACHINE and --resume exclude each other", hint="a run keeps the machine it began with")
    known = machine if begun is None else _kept_nameplate(begun)
    limits = motion if begun is None else _limits_as_begun(motion, begun)
    asked = _asked(known, eds, limits, sensor_tol, flux_map, design)
    if begun is not None:
        bus = _as_begun(bus, begun)
    elif bus.simulated():
        _erase_memory(bus, out)
    given = None if map_file is None else read_map(map_file)
    with _opened(bus, given, eds) as (drive, found):
        if drive_bandwidth_hz is not None and found.drive_map.staging:
            raise ConfigError(
                f"--drive-bandwidth-hz: for a drive that cannot be reflashed, and {found.drive_map.name!r} is none",
                hint="leave it out: the designed gains can be written to this drive",
            )
        if begun is None and _starts_blank(bus):
            forget_map(JournalFolder(found.identity))
        run = begun or new_run(bus, drive, runs, found.level)
        progress = StageProgress(out)
        person = _Person(run, drive, bus, motion, out, progress)
        chain = Commissioning(run, drive, person, progress, **asked, capabilities=found)
        chain.drive_bandwidth_hz = drive_bandwidth_hz
        chain.accept_contradictions = accept
        chain.require, chain.accept_limits = require, accept_limits
        for line in chain.stages.plan_lines():
            out.note(line)
        refused = refused_of_design(machine, found, out, asked["tune"])
        if refused and (eds or rehearse) is not None:
            raise NotAvailable(
                f"a drive with these objects does not hold the design of {machine}: {', '.join(refused)}",
                likely="a drive for other motors, or a value of MACHINE in a wrong unit",
                hint="take another drive, correct MACHINE, or ask for less (--bandwidth-hz); nothing was moved",
            )
        with _reported(run, out, fresh=begun is None):
            chain.carry_out()


@contextmanager
def _opened(bus: BusOptions, given: DriveMap | None, eds: str | None) -> Iterator[tuple[CanopenDrive, Capabilities]]:
    """Open the drive with what it has; without a map, the one of its identity is used."""
    from pmsmtool.cli.caps import as_in_file
    from pmsmtool.cli.drive_access import claimed_node
    from pmsmtool.drive.drive_node import DriveNode
    from pmsmtool.measurement.capabilities import examine
    from pmsmtool.measurement.identify import open_for_level

    with bus.connect() as connection:
        node = DriveNode(connection, claimed_node(connection, bus.node))
        node.refuse_late()
        may_try = bus.simulated() and "&eds=" in (bus.channel or "")
        found = as_in_file(examine(node, given, may_try=may_try), eds)
        node.close()
        drive = open_for_level(connection, node.node, found)
        yield drive, found
        drive.close()


def _kept_nameplate(run: RunDirectory) -> Path | None:
    """Return the machine file that the run was begun with; what the drive held at its start is no data sheet."""
    from pmsmtool.commissioning.commission import GIVEN
    from pmsmtool.identification.request import NAMEPLATE

    path, record = run.path / NAMEPLATE, run.read()
    given = record.request.get(GIVEN, "identify" not in record.command)  # `identify` takes no machine file
    return path if given and path.is_file() else None


def _limits_as_begun(motion: MotionOptions, run: RunDirectory) -> MotionOptions:
    """Fill in the motion limits of a run where the command line names none; they bound its proof, too."""
    from pmsmtool.identification.request import REQUEST, parse_request

    path = run.path / REQUEST
    if not path.is_file():
        return motion
    asked = parse_request(read_text(path), where=str(path))
    return replace(
        motion,
        i_max_apk=motion.i_max_apk or asked.i_max_apk,
        speed_max_rad_s=motion.speed_max_rad_s or asked.speed_max_rad_s,
        shaft=motion.shaft or asked.shaft,
        load=asked.load if motion.load == "none" else motion.load,
        brake=asked.brake if motion.brake == "none" else motion.brake,
    )


def _asked(
    machine: Path | None, eds: str | None, motion: MotionOptions, sensor_tol: float, flux_map: bool, design: Any
) -> dict[str, Any]:
    """Check and collect what is asked of the chain, before anything is opened."""
    from pmsmtool.design.tune_request import TuneRequest
    from pmsmtool.estimators.estimate import SensorTolerance
    from pmsmtool.identification.request import QUANTITIES, IdentifyRequest
    from pmsmtool.sim.foreign.drive import rehearsed_motor

    wanted = IdentifyRequest(
        quantities=(*QUANTITIES, "map") if flux_map else QUANTITIES,
        map_if_saturated=not flux_map,
        resonance=True,
        i_max_apk=motion.i_max_apk,
        speed_max_rad_s=motion.speed_max_rad_s,
        shaft=motion.shaft or "free",
        load=motion.load,
        brake=motion.brake,
        tolerance=SensorTolerance(current_gain=sensor_tol, voltage_gain=sensor_tol),
    )
    wanted.check()
    return {
        "nameplate": None if machine is None else rehearsed_motor(machine, eds),
        "identify": wanted,
        "tune": TuneRequest(**design),
    }


def _as_begun(bus: BusOptions, run: RunDirectory) -> BusOptions:
    """Fill in the bus of a run where the command line names none."""
    recorded = run.read().bus
    if bus.interface is None and bus.channel is None:
        bus = replace(bus, **{key: recorded.get(key) for key in bus.recorded})
    return replace(bus, node=recorded.get("node")) if bus.node is None else bus


def _starts_blank(bus: BusOptions) -> bool:
    """Whether the drive is a simulated one without a memory of its own file: nothing was written to it before."""
    channel = str(bus.channel or "")
    return bus.simulated() and ("nv=" not in channel or "nv=:memory:" in channel)


def _erase_memory(bus: BusOptions, out: Output) -> None:
    from pmsmtool.sim.channel import erase_memory

    channel = bus.channel
    if channel is None and bus.interface is None:
        from pmsmtool.bus.connect import configuration

        channel = configuration({}).get("channel")
    for path in erase_memory(None if channel is None else str(channel)):
        out.detail(f"erased {path}: the simulated drive starts from factory memory")


class _Person:
    """Asks on the terminal, or lets ``--yes`` answer; keeps what was agreed to in the record."""

    def __init__(
        self,
        run: RunDirectory,
        drive: CanopenDrive,
        bus: BusOptions,
        motion: MotionOptions,
        out: Output,
        progress: StageProgress,
    ) -> None:
        self._run = run
        self._progress = progress
        self._asked: dict[str, Any] = {
            "options": motion, "simulated": bus.simulated(), "serial": drive.identity.serial, "out": out,
        }  # fmt: skip

    def allow_motion(self, lines: Sequence[str]) -> None:
        """Ask for the motion envelope."""
        from pmsmtool.cli.consent import ask_motion

        self._ask(ask_motion, lines)

    def allow_writing(self, lines: Sequence[str]) -> None:
        """Ask for the list of differences."""
        from pmsmtool.cli.consent import ask_writing

        self._ask(ask_writing, lines)

    def _ask(self, ask: Any, lines: Sequence[str]) -> None:
        from pmsmtool.cli.consent import keep

        self._progress.pause()
        given = ask(lines, **self._asked)
        self._progress.resume()
        keep(self._run, given)


@contextmanager
def _reported(run: RunDirectory, out: Output, *, fresh: bool) -> Iterator[None]:
    """Write the report whatever ends the chain; a run that was declined before anything was measured is removed."""
    from pmsmtool.commissioning.commission import has_measured, write_report

    begun = time.monotonic()
    try:
        yield
    except BaseException as error:
        if isinstance(error, Declined) and fresh and not has_measured(run):
            shutil.rmtree(run.path, ignore_errors=True)
            raise
        try:
            write_report(run)
            _show(run, out, begun, ended=True)
            out.note(_next_step(run, error))
        except Exception as second:  # whatever it is, what ended the chain outranks it
            out.warn(f"the report could not be written: {type(second).__name__}: {second}")
        raise
    out.status("writing the report ...")
    write_report(run)
    found = _show(run, out, begun)

    if found.kind == "partial":  # the verdict is the last line: nothing is said after it
        raise click.exceptions.Exit(int(ExitCode.PARTIAL))


def _next_step(run: RunDirectory, error: BaseException) -> str:
    """Say what leads on: a run whose machine was not identified, or that this drive cannot do, begins anew."""
    if isinstance(error, NotAvailable | IdentificationError | Contradiction):
        return "to go on, remove the cause and begin a new run: this one would end the same way"
    return f"go on with: pmsmtool commission --resume {run.path}"


def _show(run: RunDirectory, out: Output, begun: float, *, ended: bool = False) -> Verdict:
    """Show the verdict; of a run that an error ended as one object with ``--json``, else beside the error."""
    from pmsmtool.commissioning.report_page import verdict

    record, found = run.read(), verdict(run.path)
    latest = [record.stage(name) for name in dict.fromkeys(stage.name for stage in record.stages)]
    stages = [
        {key: getattr(stage, key) for key in ("name", "status", "summary", "note", "seconds", "refused")}
        | {"criteria": stage.acceptance}
        for stage in latest
        if stage is not None
    ]
    identified = record.stage("identify")
    data = {
        "run": run.path,
        "report": run.path / "report.html",
        "verdict": found.word,
        "simulated": found.simulated,
        "reasons": found.lines,
        "drive": record.drive,
        "limits": [line for given in record.consents if given["subject"] == "motion" for line in given["text"]],
        "seconds": {"wall": time.monotonic() - begun, "bus": sum(stage.seconds for stage in latest if stage)},
        "stages": stages,
        "values": [] if identified is None else list(identified.values),
        "comparison": [] if identified is None else list(identified.comparison),
    }
    report = f"report: {run.path / 'report.html'}"
    caps = f"caps --sim '{record.bus['channel']}'" if found.simulated and record.bus.get("channel") else "caps"
    more = f"`pmsmtool {caps}` lists what this drive can measure; --require STAGE makes a missing stage exit 1"
    advice = [f"try: {more}"] if found.kind == "partial" else []
    lines = [*(f"  - {line}" for line in found.details), *advice, report, found.headline]
    if ended and not out.json:
        for line in (*lines[: len(found.details)], report, found.headline.splitlines()[0]):
            out.note(line)
    else:
        out.result("commission", data, lines)
    return found
