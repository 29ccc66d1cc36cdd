# SPDX-License-Identifier: MIT
"""``pmsmtool restore``: bring a backup, or an interrupted download, back."""

from __future__ import annotations

from pathlib import Path

import click

from pmsmtool.cli.drive_access import WHOLE_SET_S, map_option, open_node, read_map
from pmsmtool.cli.options import (
    ANY_PATH,
    BusOptions,
    MotionOptions,
    bus_options,
    examples,
    output_options,
    write_options,
)
from pmsmtool.cli.output import Output
from pmsmtool.errors import ConfigError, Partial


@click.command(
    "restore",
    epilog=examples(
        "pmsmtool -n 5 restore                 # what the drive held before the last download",
        "pmsmtool -n 5 restore drive.json",
        "pmsmtool -n 6 restore drive.json --other-drive --dry-run",
    ),
)
@click.argument("snapshot_file", metavar="[FILE]", type=ANY_PATH, required=False)
@click.option("--other-drive", is_flag=True, help="The backup is of another drive of this kind (a spare part).")
@click.option("--dry-run", is_flag=True, help="Show what would change and stop.")
@map_option
@bus_options
@write_options
@output_options
def restore_command(
    bus: BusOptions,
    motion: MotionOptions,
    out: Output,
    snapshot_file: Path | None,
    other_drive: bool,
    dry_run: bool,
    map_file: Path | None,
) -> None:
    """Bring back what a backup holds, or without FILE what this drive held before its last download.

    The journal is found by the drive's vendor, product and serial number. An interrupted download ends here too. Where
    the drive holds it all already, nothing is written, stored or reset: a second restore changes nothing.

    A backup by --eds needs no map. Objects that the drive refuses are named, and the exit code is 10; all others are
    brought back. Identifiers that follow the node id are those of this drive.
    """
    from pmsmtool.cli.flash_session import checked_identity, told, write_plan
    from pmsmtool.drive.objects import STORE_ALL
    from pmsmtool.drive_maps.shipped_maps import family_of
    from pmsmtool.flash.download import describe, set_named
    from pmsmtool.flash.journal import JournalFolder, read_snapshot
    from pmsmtool.flash.restore import check_snapshot, due_of_journal, nothing_written, old_marks, plan_restore
    from pmsmtool.flash.whole_drive import is_whole, readdressed, whole_map

    drive_map = read_map(map_file)
    given = None if snapshot_file is None else read_snapshot(snapshot_file)
    if given is not None and is_whole(given) and map_file is not None:
        raise ConfigError("the backup holds bytes by address, --map scales values", hint="leave out --map")
    with set_named() as jobs, open_node(bus, within_s=WHOLE_SET_S) as node:
        identity = node.identity()
        if map_file is not None:
            node.map = drive_map
            checked_identity(node, out)
        folder = JournalFolder(identity)
        snapshot = given or folder.last()
        if snapshot is None:
            raise ConfigError(
                f"there is no journal of {describe(identity)}",
                where=str(folder.path),
                likely="nothing was ever written to this drive from this account",
                hint="give the file of a backup",
            )
        if is_whole(snapshot):
            node.map = whole_map(identity)
            snapshot = readdressed(snapshot, node.node) if given is not None else snapshot
        else:
            node.map = drive_map if map_file is not None else family_of(*identity.vendor_product) or drive_map
            checked_identity(node, out)
        check_snapshot(node.map, snapshot, identity, other_drive=other_drive)
        state = f", state {snapshot.state}" if snapshot.kind != "backup" else ""
        out.note(
            f"{snapshot.kind} of serial {snapshot.identity.serial}{state}; listed: now in the drive -> brought back"
        )
        plan = plan_restore(node, snapshot)
        if snapshot_file is None and (due := due_of_journal(snapshot, plan, folder)) is not plan:
            out.note("the last download was killed before it wrote anything: the drive holds what it held before it")
            out.note(f"`pmsmtool restore {folder.path}` undoes the download before that one")
            plan = due
        if dry_run:
            out.result("restore", {"identity": identity, **plan.facts()}, plan.lines())
            return
        if not plan.changes and snapshot.state != "open":
            outcome = nothing_written(node, plan, folder)
            same = "the file states" if snapshot_file is not None else "before its last download"
            text = f"{told(outcome, node)}: already as {same}, nothing was done"
            out.result("restore", {"identity": identity, **plan.facts(), "outcome": outcome}, [text])
            return
        keeps = not is_whole(snapshot) or node.has(*STORE_ALL)
        outcome = write_plan(
            node, jobs, identity, plan, old_marks(snapshot), bus, motion, out,
            restoring=snapshot_file is None, store=keeps,
        )  # fmt: skip
        out.result("restore", {"identity": identity, **plan.facts(), "outcome": outcome}, [told(outcome, node)])
        missed = [f"not restored: {name}: {reason}" for name, reason in outcome.refused.items()]
        if not keeps:
            missed.append("not stored: the drive cannot store all (0x1010:01); it holds them until its next reset")
        if missed:
            raise Partial(
                f"{len(plan.entries) - len(outcome.refused)} of {len(plan.entries)} objects are as saved",
                where=f"node {node.node}",
                missing=missed,
                hint="compare firmware and product of both drives; set what is named by the maker's own tool",
            )
