# SPDX-License-Identifier: MIT
"""``pmsmtool verify``: compare what a drive holds, byte by byte."""

from __future__ import annotations

from pathlib import Path

import click

from pmsmtool.cli.drive_access import OWN_FAMILY, WHOLE_SET_S, map_of_drive, map_option, open_node
from pmsmtool.cli.options import ANY_PATH, BusOptions, bus_options, examples, output_options
from pmsmtool.cli.output import Output
from pmsmtool.errors import VerifyMismatch


@click.command(
    "verify",
    epilog=examples(
        "pmsmtool -i pmsmsim verify params.toml",
        "pmsmtool -n 5 verify runs/20260101T120000Z-000055f1 --json",
        "pmsmtool -n 5 verify drive.json       # a backup",
    ),
)
@click.argument("source", type=ANY_PATH)
@click.option("--other-drive", is_flag=True, help="The backup is of another drive of this kind (a spare part).")
@map_option
@bus_options
@output_options
def verify_command(bus: BusOptions, out: Output, source: Path, other_drive: bool, map_file: Path | None) -> None:
    """Compare the drive's bytes with a parameter set, a design, a DCF, a run or a backup; exit code 1 when they differ.

    Bytes only. Whether the machine behaves as designed is what `pmsmtool prove` shows.
    """
    from pmsmtool.cli.flash_session import checked_identity
    from pmsmtool.commissioning.parameter_source import load_parameters
    from pmsmtool.flash.journal import read_snapshot
    from pmsmtool.flash.restore import check_snapshot, plan_download, plan_restore
    from pmsmtool.flash.whole_drive import is_whole, readdressed, whole_map

    drive_map = map_of_drive(bus, map_file, OWN_FAMILY)
    snapshot = read_snapshot(source) if source.suffix == ".json" else None
    with open_node(bus, drive_map, within_s=WHOLE_SET_S) as node:
        if snapshot is not None and is_whole(snapshot):  # bytes by address need no map
            node.map, snapshot = whole_map(node.identity()), readdressed(snapshot, node.node)
        identity = checked_identity(node, out)
        if snapshot is None:
            plan = plan_download(node, load_parameters(source, drive_map))
        else:
            check_snapshot(node.map, snapshot, identity, other_drive=other_drive)
            plan = plan_restore(node, snapshot)
    equal = len(plan.entries) - len(plan.changes)
    text = [f"{equal} of {len(plan.entries)} objects match (values only; run prove to test behaviour)"]
    out.result("verify", {"identity": identity, "ok": not plan.changes, **plan.facts()}, text)
    if plan.changes:
        chosen = "" if map_file is None else f" --map {map_file}"
        command = f"restore{' --other-drive' if other_drive else ''}" if snapshot else "flash-params"
        raise VerifyMismatch(
            f"{len(plan.changes)} of {len(plan.entries)} objects hold something else; listed: drive -> {source.name}",
            where=f"node {identity.node}",
            differences=plan.lines()[: len(plan.changes)],
            hint=f"`pmsmtool {command} {source}{chosen}` brings them to the drive",
        )
