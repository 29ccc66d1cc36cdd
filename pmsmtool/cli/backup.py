# SPDX-License-Identifier: MIT
"""``pmsmtool backup``: everything a drive holds, in one file."""

from __future__ import annotations

from pathlib import Path

import click

from pmsmtool.cli.drive_access import WHOLE_SET_S, map_option, open_node, read_map
from pmsmtool.cli.options import FILE, BusOptions, bus_options, examples, output_options
from pmsmtool.cli.output import Output


@click.command(
    "backup", epilog=examples("pmsmtool -i pmsmsim backup -o drive.json", "pmsmtool -n 5 backup -o drive.json")
)
@click.option("-o", "--output", "path", type=FILE, required=True, help="File to write (.json).")
@click.option("--force", is_flag=True, help="Replace the file.")
@map_option
@bus_options
@output_options
def backup_command(bus: BusOptions, out: Output, path: Path, force: bool, map_file: Path | None) -> None:
    """Save every parameter and table of a drive; `pmsmtool restore` brings them back, byte for byte."""
    from pmsmtool.cli.flash_session import checked_identity
    from pmsmtool.errors import ConfigError
    from pmsmtool.flash.journal import write_snapshot
    from pmsmtool.flash.restore import take_backup

    if path.exists() and not force:
        raise ConfigError("the file exists", where=str(path), hint="choose another name, or --force")
    with open_node(bus, read_map(map_file), within_s=WHOLE_SET_S) as node:
        identity = checked_identity(node)
        snapshot = take_backup(node, identity, progress=lambda done, total: out.status(f"{done}/{total}"))
    write_snapshot(path, snapshot)
    data = {"identity": identity, "file": path, "content": snapshot.content, "objects": len(snapshot.entries)}
    out.result("backup", data, [f"{len(snapshot.entries)} objects of serial {identity.serial} in {path}"])
