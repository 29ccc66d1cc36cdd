# SPDX-License-Identifier: MIT
"""``pmsmtool track``: resistance and flux linkage of a machine in operation, followed over time."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pmsmtool.cli.drive_access import map_option, new_run, open_drive, read_map, runs_option
from pmsmtool.cli.options import ANY_PATH, DIR, FREQUENCY, TIME, BusOptions, bus_options, examples, output_options
from pmsmtool.cli.output import Output, table
from pmsmtool.errors import Interrupted, PmsmtoolError
from pmsmtool.units import format_estimate, format_quantity

if TYPE_CHECKING:
    from collections.abc import Callable

    from pmsmtool.drive.canopen_drive import CanopenDrive
    from pmsmtool.drive_maps.drive_map import DriveMap
    from pmsmtool.estimators.tracking_model import Known
    from pmsmtool.identification.track import Tracked
    from pmsmtool.machine.machine_file import MachineFile
    from pmsmtool.run_directory import RunDirectory
    from pmsmtool.trace import Trace

QUANTITIES = {"R": "R_s_ohm", "psi": "psi_f_wb"}


@click.command(
    "track",
    epilog=examples(
        "pmsmtool -n 5 track --machine runs/20260101T120000Z-000055f1 --for 60s",
        "pmsmtool -n 5 track psi --by trace --for 20s --json",
        "pmsmtool track --replay runs/20260101T130000Z-000055f1",
    ),
)
@click.argument("quantities", nargs=-1, metavar="[R|psi]...", type=click.Choice(list(QUANTITIES)))
@click.option("--machine", type=ANY_PATH, help="Machine file, design or run directory; "
              "default: what the drive holds.")  # fmt: skip
@click.option("--for", "seconds", type=TIME, default="10s", help="How long.")
@click.option("--by", type=click.Choice(["pdo", "trace"]), default="pdo", help="Process data, or recordings.")
@click.option("--rate", "rate_hz", type=FREQUENCY, default="100Hz", help="Process data per second.")
@click.option("--replay", type=DIR, metavar="RUN_DIR", help="From what an earlier track kept; asks no drive.")
@runs_option
@map_option
@bus_options
@output_options
def track_command(
    bus: BusOptions,
    out: Output,
    quantities: tuple[str, ...],
    machine: Path | None,
    seconds: float,
    by: str,
    rate_hz: float,
    replay: Path | None,
    runs: Path,
    map_file: Path | None,
) -> None:
    """Follow R(T) and psi(T) while another program runs the machine; nothing is commanded.

    The values, their statistical and systematic intervals and the temperatures they mean are printed. What the
    operating points do not show is refused by name (exit code 6): R needs current, psi needs speed, both need change.
    --replay takes a run of track; runs of identify and commission hold no such observations (exit code 9).
    """
    from pmsmtool.identification.track import follow

    wanted = tuple(QUANTITIES[name] for name in dict.fromkeys(quantities or QUANTITIES))
    if replay is not None:
        observations, known, described, run = _stored(replay, machine)
        found = follow(observations, known, described, wanted)
    else:
        run, found = _live(bus, out, wanted, machine, Watch(seconds, by, rate_hz), runs, read_map(map_file))
    _show(run, found, wanted, out)


@dataclass(frozen=True, slots=True)
class Watch:
    """How long (s), by what and how often (Hz) is observed."""

    seconds: float
    by: str
    rate_hz: float


def _stored(replay: Path, machine: Path | None) -> tuple[Any, Known, MachineFile, RunDirectory]:
    from pmsmtool.design.design_file import load_machine_or_design
    from pmsmtool.identification.track import KNOWN, known_of, load_known, replay_observations
    from pmsmtool.run_directory import RunDirectory

    run = RunDirectory(replay)
    run.read()
    described, _ = load_machine_or_design(machine or replay / "machine.toml")
    kept = replay / KNOWN
    known = load_known(kept) if kept.is_file() and machine is None else known_of(described, compensated=False)
    return replay_observations(run), known, described, run


def _live(
    bus: BusOptions,
    out: Output,
    wanted: tuple[str, ...],
    machine: Path | None,
    watch: Watch,
    runs: Path,
    drive_map: DriveMap,
) -> tuple[RunDirectory, Tracked]:
    """Observe the drive and follow what it showed; the run keeps what was seen, whatever ends it."""
    from pmsmtool.identification.track import follow, known_of, track_stage
    from pmsmtool.machine.machine_file import dump_machine_file
    from pmsmtool.measurement.by_injection import nameplate_of
    from pmsmtool.measurement.run_account import accounted

    with ExitStack() as bus_open:
        drive = bus_open.enter_context(open_drive(bus, drive_map))
        described = _described(machine) if machine else nameplate_of(drive, drive.identity.name or "drive")
        known = known_of(described, compensated=drive.read("inverter.deadtime_compensation") != 0.0)
        run = new_run(bus, drive, runs)
        run.save("machine.toml", dump_machine_file(described))
        with accounted(run, "track", out.note) as say:
            try:
                observations = _observed(drive, watch, run, known, out, say)
                bus_open.close()
                found = follow(observations, known, described, wanted)
            except KeyboardInterrupt:
                raise _interrupted(run) from None
            except PmsmtoolError:
                if _kept(run):
                    out.note(f"what was observed: {_replay(run)}")
                raise
            run.add(track_stage(found, wanted, described))
    return run, found


def _observed(
    drive: CanopenDrive, watch: Watch, run: RunDirectory, known: Known, out: Output, say: Callable[[str], None]
) -> Trace:
    """Observe, and have the run keep it also when something ends it early."""
    from pmsmtool.drive.stop import interrupts_deferred
    from pmsmtool.identification.track import keep
    from pmsmtool.measurement.observe import GIVEN_BACK, Observations, observe_process_data, observe_recordings

    seen = Observations()
    try:
        if watch.by == "pdo":
            observe_process_data(drive.node, watch.seconds, watch.rate_hz, seen, out.detail)
        else:
            observe_recordings(drive, watch.seconds, seen, out.detail)
        say(GIVEN_BACK)
    except KeyboardInterrupt:
        say(GIVEN_BACK)
        raise
    finally:
        with interrupts_deferred():
            observations = seen.trace()
            if len(seen):
                keep(run, observations, known)
    return observations


def _interrupted(run: RunDirectory) -> Interrupted:
    if not _kept(run):
        return Interrupted("interrupted before anything was observed", where=str(run.path), hint="observe for longer")
    return Interrupted("what was observed until then is kept", where=str(run.path), hint=_replay(run))


def _kept(run: RunDirectory) -> bool:
    from pmsmtool.identification.track import OBSERVATIONS

    return (run.path / f"traces/{OBSERVATIONS}.npz").is_file()


def _replay(run: RunDirectory) -> str:
    return f"pmsmtool track --replay {run.path}"


def _described(path: Path) -> MachineFile:
    from pmsmtool.design.design_file import load_machine_or_design

    return load_machine_or_design(path / "machine.toml" if path.is_dir() else path)[0]


def _show(run: RunDirectory, found: Tracked, wanted: tuple[str, ...], out: Output) -> None:
    from pmsmtool.report.report import total_interval

    units = {"R_s_ohm": "ohm", "psi_f_wb": "Wb"}
    path = found.track
    rows = []
    for name in wanted:
        value, std = float(path.value[name][-1]), float(path.std[name][-1])
        systematic = found.systematic[name]
        first, least = float(path.value[name][len(path.t_s) // 4]), format_quantity(1.96 * std, units[name], 2)
        rows.append(
            (
                name,
                format_estimate(value, total_interval(std, systematic), units[name]),
                least,
                format_quantity(systematic, units[name], 2),
                f"{100.0 * (value / first - 1.0):+.2f} %",
            )
        )
    for name, (value, std) in found.temperatures.items():
        rows.append((name, f"{value:.1f} +- {1.96 * std:.1f} degC", "", "", ""))
    data = {
        "run": run.path,
        "t_s": path.t_s,
        "values": {
            name: {"value": path.value[name], "std": path.std[name], "systematic": found.systematic[name]}
            for name in wanted
        },
        "temperatures": {name: {"value": v, "std": s} for name, (v, s) in found.temperatures.items()},
        "innovation": {"nis": path.nis, "inflation": path.inflation, "restarts": path.restarts},
        "notes": list(path.notes),
    }
    heads = ("quantity", "at the end, total 95 %", "statistical", "systematic", "since a quarter")
    out.result("track", data, lambda: table(heads, rows))
    for line in path.notes:
        out.warn(line)
    out.note(f"-> {run.path}")
