# SPDX-License-Identifier: MIT
"""``pmsmtool identify``: measure the machine on its drive, or recompute a run from its traces."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pmsmtool.cli.drive_access import map_option, runs_option
from pmsmtool.cli.options import DIR, BusOptions, MotionOptions, bus_options, examples, motion_options, output_options
from pmsmtool.cli.output import Output, table
from pmsmtool.errors import Declined, IdentificationError, NotAvailable, Partial
from pmsmtool.plain_text import by_reason
from pmsmtool.units import format_estimate, format_quantity

if TYPE_CHECKING:
    from pmsmtool.bus.connection import Connection
    from pmsmtool.cli.fingerprint import Comparison
    from pmsmtool.experiments.standstill import ReadSupply
    from pmsmtool.identification.fingerprint import Earlier
    from pmsmtool.identification.request import IdentifyRequest, Method
    from pmsmtool.measurement.capabilities import Capabilities
    from pmsmtool.run_directory import RunDirectory, Stage


@click.command(
    "identify",
    epilog=examples(
        "pmsmtool --sim interior-2k2 --yes identify",
        "pmsmtool -i socketcan -c can0 -n 5 identify R L --i-max 6Apk",
        "pmsmtool --sim saturated-pmsyrm --yes identify map --i-max 20Apk",
        "pmsmtool -n 5 identify --fingerprint runs/20260101T120000Z-000055f1  # is that the same motor?",
    ),
)
@click.argument(
    "quantities", nargs=-1, metavar="[R|L|psi|encoder|poles|inverter|mechanics|map|frf|cogging|harmonics|hall|all]..."
)
@click.option(
    "--method",
    type=click.Choice(["auto", "inject", "recorder", "standard", "vendor", "manual"]),
    default="auto",
    help="How; auto: the best that this drive allows (`pmsmtool caps`).",
)
@click.option("--replay", type=DIR, metavar="RUN_DIR", help="Recompute from the traces of a run; moves nothing.")
@click.option("--fingerprint", type=DIR, metavar="RUN", help="Measure R, L, psi, encoder and pole pairs again, in "
              "short, and compare them with those of a run: exit code 1 where one differs.")  # fmt: skip
@runs_option
@click.option(
    "--sensor-tol",
    type=click.FloatRange(0.0, 0.2),
    metavar="SHARE",
    help="95 % tolerance of sensor gains; default 0.01, with --replay what the run was made with.",
)
@click.option(
    "--cal",
    multiple=True,
    metavar="V_dc|I=SHOWN:TRUE:TOL",
    help="What an instrument read while the drive showed SHOWN, and its 95 % tolerance, with units: "
    "V_dc=540V:537V:0.5V, I=5.00Apk:5.02Apk:0.2%; corrects that scale. So does bridge=SWITCH:DIODE:TOL, the "
    "thresholds in the data sheet of the bridge's devices: bridge=0.9V:1.1V:0.2V.",
)
@click.option(
    "--accuracy",
    type=click.FloatRange(0.0, 0.1, min_open=True),
    metavar="SHARE",
    help="95 % half width of R, L and psi, relative, that is enough: the run then collects less. It is without the "
    "sensors' part, which is printed beside it.",
)
@click.option(
    "--supply",
    is_flag=True,
    help="R of a drive that shows no voltage: a person reads the bench supply's power at several currents.",
)
@map_option
@bus_options
@motion_options
@output_options
def identify_command(
    bus: BusOptions,
    motion: MotionOptions,
    out: Output,
    quantities: tuple[str, ...],
    method: str,
    replay: Path | None,
    fingerprint: Path | None,
    runs: Path,
    sensor_tol: float | None,
    cal: tuple[str, ...],
    accuracy: float | None,
    supply: bool,
    map_file: Path | None,
) -> None:
    """Measure resistance, inverter error, inductances, flux linkage, encoder and inertia of the connected machine.

    Without a quantity all but map, frf, cogging, harmonics and hall are measured.

    \b
    map        flux linkages over the current plane, with saturation
    mechanics  inertia, viscous and Coulomb friction: torque pulses, coasting
    frf        mechanical frequency response, and its resonance
    cogging    torque over the angle, in slow turns
    harmonics  5th, 7th, 11th and 13th harmonic of the back-EMF
    hall       order of the wires and alignment of Hall sensors; alone
    A locked rotor (--shaft locked) allows R, inverter and map.

    The limits are printed and consent is asked before anything moves. Every value has a statistical and a systematic
    part; a value that cannot be trusted is refused by name. The run directory keeps the traces and machine.toml.
    Nothing is stored in the drive.

    --method vendor starts the drive's own identification (`pmsmtool caps`); such values have no interval.

    --fingerprint compares the motor with that of an earlier run, for example after a repair. Method, limits and sensor
    tolerances of that run are used where none are given. Each value is SAME or DIFFERENT, with the likely cause.
    """  # noqa: D301 - click reads the control character
    from pmsmtool.cli.fingerprint import compare, earlier_run, like_then
    from pmsmtool.estimators.estimate import SensorTolerance
    from pmsmtool.identification.calibration import calibrated_tolerance
    from pmsmtool.identification.request import NEEDS, QUANTITIES, IdentifyRequest, Method

    if quantities == ("hall",) and replay is None and fingerprint is None:
        from pmsmtool.cli.drive_access import read_map
        from pmsmtool.cli.identify_hall import identify_hall

        identify_hall(bus, motion, out, runs, read_map(map_file))
        return
    declared = None if sensor_tol is None else SensorTolerance(current_gain=sensor_tol, voltage_gain=sensor_tol)
    if replay is not None:
        if fingerprint is not None:
            raise click.UsageError("--fingerprint measures; `pmsmtool diff` compares two runs that are there")
        if accuracy is not None:
            raise click.UsageError("--accuracy says how much is measured; with --replay it is that of the run")
        from pmsmtool.identification.replay import replay as recompute
        from pmsmtool.identification.request import MACHINE, REPLAYED
        from pmsmtool.run_directory import RunDirectory

        run = RunDirectory(replay)
        run.read()
        stage = recompute(run, declared, cal)
        if f"{REPLAYED}/{MACHINE}" in stage.files:
            out.warn(
                f"the design in this run was made from its {MACHINE}: that file, run.json and report.html stay as they "
                f"are, and the other values go to {run.path / REPLAYED / MACHINE}"
            )
        _show(run, stage, out)
        return
    chosen = tuple(NEEDS) if "all" in quantities else quantities or QUANTITIES
    request = IdentifyRequest(
        quantities=tuple(chosen),
        i_max_apk=motion.i_max_apk,
        speed_max_rad_s=motion.speed_max_rad_s,
        shaft=motion.shaft or "free",
        load=motion.load,
        brake=motion.brake,
        accuracy=accuracy,
        tolerance=calibrated_tolerance(declared or SensorTolerance(), cal),
    )
    earlier, asked = None, request.quantities
    if fingerprint is not None:
        earlier, asked = earlier_run(fingerprint, quantities, method)
        own_tolerance = declared is not None or bool(cal)
        request = like_then(replace(request, quantities=asked), earlier, own_tolerance=own_tolerance)
        method = earlier.level
    request.check()
    everything = not quantities and earlier is None
    found, how, request = _choose(bus, map_file, method, request, everything=everything, supply=supply)
    if accuracy is not None and how is not Method.INJECT:
        raise NotAvailable(f"the method {how} has no choice of what it collects", hint="leave --accuracy out")
    if supply and not (how is Method.STANDARD and "R" in request.quantities):
        raise NotAvailable(f"the method {how} reads no bench supply", hint="leave --supply out, or ask for R")
    run, stage = _measure(bus, motion, out, request, runs, found, how, earlier, supply=supply)
    if how is not Method.INJECT:
        _tell_more(found, request, out)
    _show(run, stage, out, None if earlier is None else compare(earlier, run, asked))


def _choose(
    bus: BusOptions, map_file: Path | None, method: str, request: IdentifyRequest, *, everything: bool, supply: bool
) -> tuple[Capabilities, Method, IdentifyRequest]:
    """Ask the drive what it can; return the method, and what of the request it gives."""
    from pmsmtool.cli.drive_access import open_node, read_map
    from pmsmtool.flash.map_gate import check_motion
    from pmsmtool.identification.request import Method
    from pmsmtool.measurement.capabilities import examine, with_supply

    with open_node(bus) as node:
        node.refuse_late()
        found = examine(node, None if map_file is None else read_map(map_file))
    if supply:
        found = with_supply(found)
    check_motion(found.drive_map, found.identity)
    wanted = None if method == "auto" else Method(method)
    how, given, left = found.choose(request.quantities, wanted)
    return found, how, replace(request, quantities=given, left_out={} if everything else left)


def _tell_more(found: Capabilities, request: IdentifyRequest, out: Output) -> None:
    """Name what the drive would measure by itself besides."""
    from pmsmtool.measurement.by_vendor import vendor_quantities

    more = [name for name in vendor_quantities(found) if name not in request.quantities]
    if more:
        out.note(f"{', '.join(more)}: the drive measures them by itself with --method vendor")


def supply_reader(connection: Connection, node: int, *, simulated: bool) -> ReadSupply:
    """Return what reads the supply that feeds a drive: a person is asked while a current flows.

    Raises Declined: nobody can be asked; nothing was moved.

    Parameters
    ----------
    simulated : bool
        The drive is simulated in this process, and its supply with it.
    """
    from pmsmtool.cli.consent import person_present

    def ask(i_a: float) -> tuple[float, float]:
        click.echo(f"{i_a:.4g} Apk in the machine: what does the bench supply show?", err=True)
        shown = [click.prompt(f"  {what}", type=click.FloatRange(min=0.0), err=True) for what in ("volts", "amperes")]
        return shown[0], shown[1]

    if simulated:
        return lambda i_a: connection.bus.read_supply(node)  # type: ignore[attr-defined]
    if not person_present():
        raise Declined(
            "no terminal to ask what the bench supply shows: nothing was done",
            likely="standard input or standard error is not a terminal",
            hint="run it in a terminal, or leave --supply out",
        )
    return ask


def _measure(
    bus: BusOptions,
    motion: MotionOptions,
    out: Output,
    request: IdentifyRequest,
    runs: Path,
    found: Capabilities,
    how: Method,
    earlier: Earlier | None,
    *,
    supply: bool,
) -> tuple[RunDirectory, Stage]:
    from pmsmtool.cli.consent import ask_motion, keep
    from pmsmtool.cli.drive_access import choose_node, new_run
    from pmsmtool.identification.request import Method
    from pmsmtool.measurement.by_injection import nameplate_of, with_limits_of
    from pmsmtool.measurement.identify import identify, open_for_level

    with bus.connect() as connection:
        drive = open_for_level(connection, choose_node(connection, bus.node), found)
        identity = drive.identity
        reader = supply_reader(connection, identity.node, simulated=bus.simulated()) if supply else None
        if earlier is not None and how is Method.INJECT:
            request = with_limits_of(earlier.request, request, nameplate_of(drive))
        run = new_run(bus, drive, runs)

        def allow(lines: Any) -> None:
            keep(run, ask_motion(lines, motion, simulated=bus.simulated(), serial=identity.serial, out=out))

        with _accounted(run, out) as say:
            stage = identify(run, drive, request, allow, say, method=how, found=found, read_supply=reader)
            run.add(stage)
        drive.close()
    return run, stage


@contextmanager
def _accounted(run: RunDirectory, out: Output) -> Iterator[Callable[[str], None]]:
    """Have the run say how it ended, whatever ends it; one that was declined before anything moved leaves no trace."""
    from pmsmtool.measurement.run_account import accounted

    try:
        with accounted(run, "identify", out.note) as say:
            yield say
    except Declined:
        shutil.rmtree(run.path, ignore_errors=True)
        raise
    except BaseException:
        with suppress(Exception):  # what ended the run outranks a record that cannot be read, or a closed output
            stage = run.read().stage("identify")
            if stage is not None and (stage.values or stage.refused):
                _tell(run, stage, out, ended=True)
        out.note(f"how it ended, and what is complete: pmsmtool report {run.path}")
        raise


def _tell(
    run: RunDirectory, stage: Stage, out: Output, comparison: Comparison | None = None, *, ended: bool = False
) -> Mapping[str, Mapping[str, Any]]:
    """Tell what a stage holds, also one that an error ``ended``; return what became of the accuracy asked for."""
    from pmsmtool.identification.request import accuracy_line, accuracy_told
    from pmsmtool.report.report import INTEGER, is_integer, total_interval
    from pmsmtool.report.verdict import on_which_drive

    rows = []
    for value in stage.values:
        if "std" not in value:
            told = format_quantity(value["value"], value["unit"])
            rows.append((value["name"], told, "no interval", "", "", value.get("method", value["source"])))
            continue
        total = total_interval(value["std"], value["systematic"], value["coverage_factor"])
        whole = is_integer(float(value["value"]), total)
        rows.append(
            (
                value["name"],
                f"{value['value']:.0f}" if whole else format_estimate(value["value"], total, value["unit"]),
                INTEGER if whole else format_quantity(value["coverage_factor"] * value["std"], value["unit"], 2),
                "" if whole else format_quantity(value["systematic"], value["unit"], 2),
                "" if value["T_c"] is None else f"{value['T_c']:.1f} degC",
                value["method"],
            )
        )
    heads = ("quantity", "value, total 95 %", "statistical", "systematic", "at", "method")
    warnings = [*stage.fallbacks, *([stage.note] if stage.note else [])]
    data = {
        "run": str(run.path), "values": list(stage.values), "status": stage.status, "refused": dict(stage.refused),
        "warnings": warnings,
    }  # fmt: skip
    accuracy = accuracy_told(stage.values)
    data |= {"accuracy": accuracy} if accuracy else {}
    compared = [] if comparison is None else comparison.lines()
    data |= {} if comparison is None else {"fingerprint": comparison.facts()}
    out.result("identify", data, [*(table(heads, rows) if rows else ()), *compared])
    for line in stage.fallbacks if ended else warnings:  # what ended it is said last
        out.warn(line)
    if accuracy and stage.status == "pass":
        out.note(accuracy_line(accuracy))  # one that is not reached is among the warnings
    out.note(on_which_drive(stage.summary, asdict(run.read())))
    for name in stage.files:
        if not name.startswith(("traces/", "nameplate", "request")):
            out.note(f"-> {run.path / name}")
    return accuracy


def _show(run: RunDirectory, stage: Stage, out: Output, comparison: Comparison | None = None) -> None:
    from pmsmtool.identification.request import accuracy_line

    accuracy = _tell(run, stage, out, comparison)
    if comparison is not None:
        comparison.require_same(run)
    if stage.status == "pass" and comparison is not None:
        comparison.require_whole(run)
        out.note(
            f"SAME motor as in {comparison.earlier.run}: {len(comparison.rows)} of {len(comparison.rows)} values agree"
        )
    if stage.status == "pass":
        return
    refused = by_reason(stage.refused.items())
    if stage.status == "partial":
        where = "machine.toml" if any(name.endswith("machine.toml") for name in stage.files) else "run.json"
        if not stage.refused:
            raise Partial(
                "the accuracy asked for is not reached; the values are good",
                where=str(run.path),
                hint="allow more current or speed (--i-max, --speed-max), or ask for less",
                missing=[accuracy_line(accuracy)],
            )
        raise Partial(
            f"{len(stage.refused)} of the quantities asked for {'is' if len(stage.refused) == 1 else 'are'} refused",
            where=str(run.path),
            hint=f"the accepted values are in {where}; `pmsmtool help refusals` explains each name",
            missing=refused,
        )
    from pmsmtool.commissioning.commission import NOT_ACCEPTED

    broken = [f"{line.what}: {line.measured}, limit {line.limit}" for line in stage.acceptance if not line.ok]
    raise IdentificationError("E_NOT_ACCEPTED", "; ".join(refused or broken), where=str(run.path), hint=NOT_ACCEPTED)
