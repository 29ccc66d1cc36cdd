# SPDX-License-Identifier: MIT
"""What the writing commands share: plan, consent, download, one result."""

from __future__ import annotations

import datetime
import math
from typing import TYPE_CHECKING

from pmsmtool.cli.options import BusOptions, MotionOptions
from pmsmtool.cli.output import Output
from pmsmtool.errors import CheckFailed
from pmsmtool.plain_text import counted

if TYPE_CHECKING:
    from pmsmtool.drive.drive_node import DriveNode
    from pmsmtool.drive.port import Identity
    from pmsmtool.flash.download import Download, Outcome
    from pmsmtool.flash.plan import Plan
    from pmsmtool.params.parameter_set import ParameterSet


def carry_out(
    node: DriveNode,
    jobs: list[Download],
    wanted: ParameterSet,
    bus: BusOptions,
    motion: MotionOptions,
    out: Output,
    *,
    command: str,
    store: bool | None = None,
    dry_run: bool = False,
    check: bool = False,
) -> None:
    """Plan, ask, write, print; the download is put into ``jobs`` (``flash.download.set_named``)."""
    from pmsmtool.flash.download import refuse_empty
    from pmsmtool.flash.restore import plan_download, tell_lacking

    if dry_run or check:
        identity, plan = checked_identity(node, out), plan_download(node, wanted)
        out.result(command, {"identity": identity, **plan.facts()}, plan.lines())
        refuse_empty(node, plan)
        if check and plan.changes:
            different = f"the drive differs in {counted(len(plan.changes), 'object')}"
            raise CheckFailed(different, where=f"node {node.node}", hint="run without --check to write them")
        return
    identity, plan, outcome = flashed(node, jobs, wanted, bus, motion, out, store=store)
    out.result(command, {"identity": identity, **plan.facts(), "outcome": outcome}, [told(outcome, node)])
    tell_lacking(node, plan)


def flashed(
    node: DriveNode, jobs: list[Download], wanted: ParameterSet, bus: BusOptions, motion: MotionOptions, out: Output,
    *, store: bool | None = None,
) -> tuple[Identity, Plan, Outcome]:  # fmt: skip
    """Plan, ask and write; return the drive, the plan and what became of it."""
    from pmsmtool.flash.journal import JournalFolder
    from pmsmtool.flash.restore import marks_of, plan_download

    identity = checked_identity(node, out)
    with JournalFolder(identity).preparing():
        plan = plan_download(node, wanted)
        marks = marks_of(plan.content, datetime.datetime.now())
        return identity, plan, write_plan(node, jobs, identity, plan, marks, bus, motion, out, store=store)


def write_plan(
    node: DriveNode,
    jobs: list[Download],
    identity: Identity,
    plan: Plan,
    marks: dict[str, bytes],
    bus: BusOptions,
    motion: MotionOptions,
    out: Output,
    *,
    store: bool | None = None,
    restoring: bool = False,
) -> Outcome:
    """Ask for the consent to a plan and carry it out."""
    from pmsmtool.cli.consent import ask_writing
    from pmsmtool.flash.download import Download
    from pmsmtool.flash.journal import JournalFolder

    job = Download(
        node, identity, plan, marks, JournalFolder(identity), say=out.note,
        progress=lambda done, total: out.status(f"{done}/{total}"),
    )  # fmt: skip
    jobs.append(job)
    job.admit(store=store)  # nobody is asked for what would be refused after his consent
    node.sdo.finish_within(math.inf)  # a person may take his time, and a download has limits of its own
    if job.has_work(store=store):
        lines = [*plan.lines(), *plan.after_lines(store=store is not False)]
        ask_writing(lines, motion, simulated=bus.simulated(), serial=identity.serial, out=out)
    return job.run(store=store, restoring=restoring)


def checked_identity(node: DriveNode, out: Output) -> Identity:
    """Read the identity, refuse a drive the map is not for, and say where no source of the map knows its firmware.

    Raises ConfigError: vendor or product are not the map's.
    """
    from pmsmtool.flash.map_gate import check_family, unknown_firmware

    identity = node.identity()
    check_family(node.map, identity)
    firmware = unknown_firmware(node.map, identity)
    if firmware:
        out.warn(f"node {node.node}: {firmware}")
    return identity


def told(outcome: Outcome, node: DriveNode) -> str:
    """Return the outcome of a download in one line."""
    crc = "" if outcome.crc is None else f", CRC-32 {outcome.crc:#010x}"
    retries = f", {counted(outcome.retries, 'transfer')} repeated" if outcome.retries else ""
    return f"node {node.node}  {outcome.written} written, {outcome.equal} held already, {outcome.kept}{crc}{retries}"
