# SPDX-License-Identifier: MIT
"""``pmsmtool backup``: everything a drive holds, in one file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from pmsmtool.cli.drive_access import OWN_FAMILY, WHOLE_SET_S, map_of_drive, map_option, new_file, open_node
from pmsmtool.cli.options import BusOptions, bus_options, examples, output_options
from pmsmtool.cli.output import Output
from pmsmtool.errors import ConfigError

if TYPE_CHECKING:
    from pmsmtool.flash.whole_drive import Listed

SHOWN = 3
"""Objects that are named of those left out for one reason."""


@click.command(
    "backup",
    epilog=examples(
        "pmsmtool -i pmsmsim backup -o drive.json",
        "pmsmtool -n 5 backup -o drive.json",
        "pmsmtool -n 5 backup --eds maker.eds -o drive.json      # another maker's drive: all of it",
    ),
)
@new_file("path", required=True, help="File to write (.json).")
@click.option("--eds", metavar="FILE", help="Save every setting that this EDS or DCF lists, byte for byte; no map.")
@map_option
@bus_options
@output_options
def backup_command(bus: BusOptions, out: Output, path: Path, map_file: Path | None, eds: str | None) -> None:
    """Save every parameter and table of a drive; `pmsmtool restore` brings them back, byte for byte.

    With --eds every object of the maker's file that can be written is saved in the order of writing, but commands, set
    points, outputs, node id and serial number. `pmsmtool restore FILE --other-drive` brings it to a spare part.
    """
    from pmsmtool.cli.flash_session import checked_identity
    from pmsmtool.flash.journal import write_snapshot
    from pmsmtool.flash.restore import old_marks, take_backup
    from pmsmtool.flash.whole_drive import other_product, require_read, take_whole_backup

    if eds is not None and map_file is not None:
        raise ConfigError("--eds saves bytes, --map values", hint="give one of them")
    listed = None if eds is None else _listed(eds)
    left_out: dict[str, str] = {}
    drive_map = map_of_drive(bus, map_file, OWN_FAMILY) if listed is None else None
    with open_node(bus, drive_map, within_s=WHOLE_SET_S) as node:

        def progress(done: int, total: int) -> None:
            out.status(f"{done}/{total}")

        if listed is None:
            identity = checked_identity(node, out)
            snapshot = take_backup(node, identity, progress=progress)
        else:
            identity = node.identity()
            if eds is not None and (warning := other_product(eds, identity)):
                out.warn(warning)
            snapshot, left_out = take_whole_backup(node, identity, listed, progress=progress)
            if not snapshot.entries:
                raise ConfigError("the file names no setting of this drive", where=str(eds), hint="give its own file")
    write_snapshot(path, snapshot)
    for reason in dict.fromkeys(left_out.values()):
        labels = [label for label, why in left_out.items() if why == reason]
        shown = labels if out.verbosity > 0 else labels[:SHOWN]
        more = f" and {len(labels) - len(shown)} more (-v names them)" if len(shown) < len(labels) else ""
        out.note(f"not saved, {reason}: {', '.join(shown)}{more}")
    count = len(snapshot.entries) - len(old_marks(snapshot))  # as `restore` counts: the marks follow from the rest
    found = {"identity": identity, "file": path, "content": snapshot.content, "objects": count, "left_out": left_out}
    out.result("backup", found, [f"{count} objects of serial {identity.serial} in {path}"])
    require_read(left_out, path)


def _listed(eds: str) -> list[Listed]:
    """Return the objects of an EDS, a DCF or ``TABLE.csv#FAMILY`` that can be read and written."""
    from pmsmtool.flash.whole_drive import Listed
    from pmsmtool.sim.foreign.file_rows import read_makers_objects

    rows = read_makers_objects(eds).rows.values()
    return [Listed(row.index, row.sub, row.name, row.copied, row.data_type.size) for row in rows if row.access == "rw"]
