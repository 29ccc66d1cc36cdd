# SPDX-License-Identifier: MIT
"""``pmsmtool flash-params``: a parameter set into a drive, as a transaction, or into several with one consent."""

from __future__ import annotations

import contextlib
import datetime
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pmsmtool.cli.drive_access import OWN_FAMILY, WHOLE_SET_S, map_of_drive, map_option, open_node, read_map
from pmsmtool.cli.options import (
    ANY_PATH,
    DIR,
    FILE,
    NODE,
    BusOptions,
    MotionOptions,
    bus_options,
    examples,
    output_options,
    write_options,
)
from pmsmtool.cli.output import Output, table
from pmsmtool.errors import CheckFailed, ConfigError, Declined, PmsmtoolError

if TYPE_CHECKING:
    from pathlib import Path

    from pmsmtool.drive_maps.drive_map import DriveMap
    from pmsmtool.flash.download import Download, Outcome
    from pmsmtool.params.parameter_set import ParameterSet


class NodeList(click.ParamType[tuple[int, ...]]):
    """Node ids as people write them: ``1-3,7``."""

    name = "nodes"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, ...]:
        """Return the ids in rising order, each once."""
        if isinstance(value, tuple):
            return value
        found: set[int] = set()
        for part in str(value).split(","):
            first, dash, last = part.partition("-")
            low = NODE.convert(first.strip(), param, ctx)
            high = NODE.convert(last.strip(), param, ctx) if dash else low
            if high < low:
                self.fail(f"{part!r} counts down", param, ctx)
            found |= set(range(low, high + 1))
        return tuple(sorted(found))


def flash_fleet(
    nodes: tuple[int, ...],
    wanted: ParameterSet,
    drive_map: DriveMap,
    bus: BusOptions,
    motion: MotionOptions,
    out: Output,
    *,
    store: bool | None,
    dry_run: bool,
    check: bool,
    serials: Path | None = None,
    canary: Path | None = None,
) -> None:
    """Plan for every node, ask once, write one after the other.

    With a person at the terminal a failure on one does not spare the others. With ``serials`` nobody is asked: the
    checks of ``flash.unattended`` take the place of the person, and the first failure ends it.
    """
    from pmsmtool.cli.flash_session import checked_identity
    from pmsmtool.drive.drive_lock import claim
    from pmsmtool.drive.drive_node import DriveNode
    from pmsmtool.flash.download import Download, refuse_empty, run_all, set_named
    from pmsmtool.flash.journal import JournalFolder
    from pmsmtool.flash.map_gate import check_nodes
    from pmsmtool.flash.restore import marks_of, plan_download, tell_lacking

    _refuse_serial(motion)
    alone = _Unattended(serials, canary, wanted, drive_map) if serials is not None else None
    with set_named() as jobs, contextlib.ExitStack() as notes, bus.connect() as connection:
        for node_id in nodes:
            claim(connection, node_id)
        found = [DriveNode(connection, node_id, drive_map=drive_map) for node_id in nodes]
        check_nodes(drive_map, [node.identity() for node in found])
        for node_id, node in zip(nodes, found, strict=True):
            identity = checked_identity(node, out)
            folder = JournalFolder(identity)
            if not (dry_run or check):
                notes.enter_context(folder.preparing())
            plan = plan_download(node, wanted)
            marks = marks_of(plan.content, datetime.datetime.now())
            jobs.append(Download(node, identity, plan, marks, folder, say=_prefixed(out, node_id)))
        plans = {str(job.node.node): job.plan.facts() for job in jobs}
        lines = _grouped(jobs)
        if dry_run or check:
            out.result("flash-params", {"nodes": plans}, lines)
            for job in jobs:
                refuse_empty(job.node, job.plan)
            different = sum(bool(job.plan.changes) for job in jobs)
            if check and different:
                raise CheckFailed(
                    f"{different} of {len(jobs)} drives differ",
                    hint="the lists above show them; without --check they are written",
                )
            return
        for job in jobs:
            job.admit(store=store)
        due = [job for job in jobs if job.has_work(store=store)]
        if alone is not None:
            for job in jobs:
                tell_lacking(job.node, job.plan)  # nobody reads the lists before
            alone.check(jobs, due, motion, out, lines)
        elif due:
            _ask(lines, due, bus, motion, out, store=store)
        results = run_all(jobs, store=store, to_the_end=alone is None)
    rows = [_row(job, result) for job, result in zip(jobs, results, strict=True)]
    heads = ("node", "serial", "result", "written", "held already", "CRC-32", "repeated")
    facts = {"nodes": plans, "results": [dict(zip(heads, row, strict=True)) for row in rows]}
    out.result("flash-params", facts, lambda: table(heads, rows))
    if failed := next((result for result in results if isinstance(result, PmsmtoolError)), None):
        raise failed
    for job in jobs:
        tell_lacking(job.node, job.plan)


def _grouped(jobs: list[Download]) -> list[str]:
    """Return the lists of differences; drives with the same list share it."""
    lists: dict[tuple[str, ...], list[Download]] = {}
    for job in jobs:
        lists.setdefault(tuple(job.plan.lines()), []).append(job)
    return [
        line
        for text, of in lists.items()
        for line in (", ".join(f"node {job.node.node} (serial {job.identity.serial})" for job in of) + ":", *text)
    ]


class _Unattended:
    """What stands in for the person: the list of serial numbers, and a canary on which the set was proven."""

    def __init__(self, serials: Path, canary: Path | None, wanted: ParameterSet, drive_map: DriveMap) -> None:
        from pmsmtool.commissioning.parameter_source import load_parameters
        from pmsmtool.flash.unattended import check_canary, read_serials
        from pmsmtool.run_directory import RunDirectory

        if canary is None:
            raise ConfigError(
                "--serials needs the run of a drive on which this set was proven",
                hint="name a run directory as SOURCE, or give --canary RUN_DIR",
            )
        self._serials = read_serials(serials)
        self._record = RunDirectory(canary).read()
        proven = load_parameters(canary, drive_map)
        check_canary(self._record, same_set=proven.content_hash() == wanted.content_hash(), where=str(canary))

    def check(
        self, jobs: list[Download], due: list[Download], motion: MotionOptions, out: Output, lines: list[str]
    ) -> None:
        """Refuse what no person allowed; show the lists of differences."""
        from pmsmtool.flash.unattended import STILL_S, check_drives, wait_still

        for line in lines:
            out.note(line)
        check_drives([job.identity for job in jobs], self._serials, self._record.drive)
        if not motion.yes:
            raise Declined("--serials without --yes: nothing was done", hint="add --yes to write these drives")
        if due:
            out.note(f"{len(jobs)} drives must be off and stand still for {STILL_S:g} s")
            wait_still([job.node for job in jobs])


def _ask(
    lines: list[str], due: list[Download], bus: BusOptions, motion: MotionOptions, out: Output, *, store: bool | None
) -> None:
    from pmsmtool.cli.consent import ask_writing, person_present

    if motion.yes and not bus.simulated() and not person_present():
        raise Declined(
            "no terminal to ask for consent to write to these drives: nothing was done",
            likely="--yes of several drives needs the list of their serial numbers",
            hint="--yes --serials FILE, with a line `node serial` for each drive as `pmsmtool scan` shows them",
        )
    after = [f"node {job.node.node}: {line}" for job in due for line in job.plan.after_lines(store=store is not False)]
    serial = min(job.identity.serial for job in due)  # 0 where one of them tells none
    ask_writing([*lines, *after], motion, simulated=bus.simulated(), serial=serial, out=out)


def _refuse_serial(motion: MotionOptions) -> None:
    if motion.serial is not None:
        raise ConfigError(
            "--serial names one drive", where="--nodes",
            hint="answer the prompt, or list all drives: --yes --serials FILE",
        )  # fmt: skip


def _row(job: Download, result: Outcome | Exception | None) -> tuple[Any, ...]:
    node, serial = job.node.node, job.identity.serial
    if result is None:
        return node, serial, "NOT BEGUN", "-", "-", "-", "-"
    if isinstance(result, Exception):
        return node, serial, f"FAIL {getattr(result, 'what', result)}".splitlines()[0], "-", "-", "-", "-"
    crc = "-" if result.crc is None else f"{result.crc:#010x}"
    return node, serial, f"PASS {result.kept}", result.written, result.equal, crc, result.retries


def _prefixed(out: Output, node_id: int) -> Any:
    return lambda text: out.note(f"node {node_id}: {text}")


@click.command(
    "flash-params",
    epilog=examples(
        "pmsmtool -i pmsmsim --yes flash-params params.toml",
        "pmsmtool -n 5 flash-params design.toml --dry-run",
        "pmsmtool -n 5 flash-params params.toml --check     # exit code 1 when the drive differs",
        "pmsmtool -i socketcan -c can0 flash-params RUN_DIR --nodes 2-6 --yes --serials serials.txt",
    ),
)
@click.argument("source", type=ANY_PATH)
@click.option("--dry-run", is_flag=True, help="Show what would change and stop.")
@click.option("--check", is_flag=True, help="As --dry-run; exit code 1 when something would change.")
@click.option("--nodes", type=NodeList(), metavar="LIST", help="Several drives of the bus, e.g. 1-3,7.")
@click.option("--serials", type=FILE, help="With --nodes and --yes, without a prompt: a file with a line NODE "
              "SERIAL per drive.")  # fmt: skip
@click.option("--canary", type=DIR, metavar="RUN_DIR", help="Run of a drive "
              "of this kind that passed `prove` with this set; needed by --serials.  [default: SOURCE]")  # fmt: skip
@click.option("--store/--no-store", default=None, help="Store it even where nothing changes; or let it act until the "
              "next reset only.  [default: store what is written]")  # fmt: skip
@map_option
@bus_options
@write_options
@output_options
def flash_params_command(
    bus: BusOptions,
    motion: MotionOptions,
    out: Output,
    source: Path,
    dry_run: bool,
    check: bool,
    store: bool | None,
    nodes: tuple[int, ...] | None,
    serials: Path | None,
    canary: Path | None,
    map_file: Path | None,
) -> None:
    """Write a parameter set, a design, a DCF or a run's parameters to the drive and store it.

    Only what differs is written; where nothing does, nothing is stored either, and there is no reset. Before the first
    write the old contents are in a journal; everything is read back, activated together, stored, and compared again
    after a reset. Whatever fails, the old set comes back; after a power cut or a killed tool, the same command or
    `pmsmtool restore` finishes.
    """
    from pmsmtool.cli.flash_session import carry_out
    from pmsmtool.commissioning.parameter_source import load_parameters
    from pmsmtool.flash.download import set_named

    drive_map = read_map(map_file)
    wanted = load_parameters(source, None if map_file is None else drive_map)  # what cannot be read needs no bus
    if (source / "run.json").is_file():
        from pmsmtool.commissioning.report_page import verdict

        if (found := verdict(source)).word != "PASS":
            out.warn(f"the run ended so: {found.headline}")
    if nodes is None and (serials or canary):
        raise click.UsageError("--serials and --canary go with --nodes")
    if map_file is None:
        drive_map = map_of_drive(bus if nodes is None else replace(bus, node=nodes[0]), None, OWN_FAMILY)
        wanted = load_parameters(source, drive_map)
    if nodes is not None:
        flash_fleet(
            nodes, wanted, drive_map, bus, motion, out, store=store, dry_run=dry_run, check=check,
            serials=serials, canary=canary or (source if source.is_dir() else None),
        )  # fmt: skip
        return
    with set_named() as jobs, open_node(bus, drive_map, within_s=WHOLE_SET_S) as node:
        carry_out(
            node, jobs, wanted, bus, motion, out,
            command="flash-params", store=store, dry_run=dry_run, check=check,
        )  # fmt: skip
