# SPDX-License-Identifier: MIT
"""One parameter set into several drives of a bus, with one consent and one table of results."""

from __future__ import annotations

import contextlib
import datetime
from typing import TYPE_CHECKING, Any

import click

from pmsmtool.cli.options import NODE, BusOptions, MotionOptions
from pmsmtool.cli.output import Output, table

if TYPE_CHECKING:
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
    store: bool,
    dry_run: bool,
    check: bool,
) -> None:
    """Plan for every node, ask once, write one after the other; a failure on one does not spare the others."""
    from pmsmtool.cli.flash_session import checked_identity, plan_facts
    from pmsmtool.drive.drive_lock import claim
    from pmsmtool.drive.drive_node import DriveNode
    from pmsmtool.errors import CheckFailed, PmsmtoolError
    from pmsmtool.flash.download import Download, set_named
    from pmsmtool.flash.journal import JournalFolder
    from pmsmtool.flash.restore import marks_of, plan_download

    _refuse_serial(motion)
    with set_named() as jobs, contextlib.ExitStack() as notes, bus.connect() as connection:
        for node_id in nodes:
            claim(connection, node_id)
            node = DriveNode(connection, node_id, drive_map=drive_map)
            identity = checked_identity(node, out)
            folder = JournalFolder(identity)
            if not (dry_run or check):
                notes.enter_context(folder.preparing())
            plan = plan_download(node, wanted)
            marks = marks_of(plan.content, datetime.datetime.now())
            jobs.append(Download(node, identity, plan, marks, folder, say=_prefixed(out, node_id)))
        plans = {str(job.node.node): plan_facts(job.plan) for job in jobs}
        lines = [
            line for job in jobs for line in (f"node {job.node.node}, serial {job.identity.serial}:", *job.plan.lines())
        ]
        if dry_run or check:
            out.result("flash-params", {"nodes": plans}, lines)
            different = sum(bool(job.plan.changes) for job in jobs)
            if check and different:
                raise CheckFailed(
                    f"{different} of {len(jobs)} drives differ",
                    hint="the lists above show them; without --check they are written",
                )
            return
        for job in jobs:
            job.admit()
        due = [job for job in jobs if job.has_work(store=store)]
        if due:
            _ask(lines, due, bus, motion, out, store=store)
        results = [_run(job, store=store) for job in jobs]
    rows = [_row(job, result) for job, result in zip(jobs, results, strict=True)]
    heads = ("node", "serial", "result", "written", "held already", "CRC-32", "repeated")
    facts = [dict(zip(heads, row, strict=True)) for row in rows]
    out.result("flash-params", {"nodes": plans, "results": facts}, lambda: table(heads, rows))
    failures = [result for result in results if isinstance(result, PmsmtoolError)]
    if failures:
        raise failures[0]


def _ask(
    lines: list[str], due: list[Download], bus: BusOptions, motion: MotionOptions, out: Output, *, store: bool
) -> None:
    from pmsmtool.cli.consent import ask_writing

    after = [f"node {job.node.node}: {line}" for job in due for line in job.plan.after_lines(store=store)]
    serial = min(job.identity.serial for job in due)  # 0 where one of them tells none
    ask_writing([*lines, *after], motion, simulated=bus.simulated(), serial=serial, out=out)


def _refuse_serial(motion: MotionOptions) -> None:
    from pmsmtool.errors import ConfigError

    if motion.serial is not None:
        raise ConfigError("--serial names one drive", where="--nodes", hint="a fleet is confirmed at the prompt")


def _run(job: Download, *, store: bool) -> Outcome | Exception:
    from pmsmtool.errors import Interrupted, PmsmtoolError

    try:
        return job.run(store=store)
    except Interrupted:
        raise
    except PmsmtoolError as error:
        return error


def _row(job: Download, result: Outcome | Exception) -> tuple[Any, ...]:
    node, serial = job.node.node, job.identity.serial
    if isinstance(result, Exception):
        return node, serial, f"FAIL {getattr(result, 'what', result)}".splitlines()[0], "-", "-", "-", "-"
    crc = "-" if result.crc is None else f"{result.crc:#010x}"
    kept = "PASS stored" if result.stored else "PASS until reset"
    return node, serial, kept, result.written, result.equal, crc, result.retries


def _prefixed(out: Output, node_id: int) -> Any:
    return lambda text: out.note(f"node {node_id}: {text}")
