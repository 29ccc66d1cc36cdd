# SPDX-License-Identifier: MIT
"""A spare part: every setting of a maker's drive saved, the drive swapped, all of it brought back and compared.

    python -m benchmarks.spare_part TABLE.csv [--family NAME ...] [--seed 1] [--refuse 3]

A node of every family of the table holds random numbers in every object it takes them in; its backup goes into a node
with another serial number and the stored values of the file. Compared are the objects themselves, after the reset,
object by object. `--refuse` lets that many objects of the spare refuse: each must be named. One row per node; exit
code 1 where an object differs that is not named.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import cast

from benchmarks.makers_drives import files_of
from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.connect import connect
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.objects import STORE_ALL
from pmsmtool.errors import ConfigError, SdoAbort
from pmsmtool.flash.download import Download
from pmsmtool.flash.journal import JournalFolder
from pmsmtool.flash.restore import old_marks, plan_restore
from pmsmtool.flash.whole_drive import Listed, kept_objects, take_whole_backup, whole_map
from pmsmtool.sim.foreign.file_rows import read_makers_objects
from pmsmtool.sim.node.node import Node

HERE, SPARE = "interior-2k2", "mtpv-test"


@contextmanager
def opened(machine: str, file: str) -> Iterator[DriveNode]:
    """Open a simulated node of a file."""
    with connect("pmsmsim", f"{machine}?nv=:memory:&eds={file}") as connection:
        node = DriveNode(connection, 1)
        yield node
        node.close()


def fill(node: DriveNode, listed: list[Listed], rng: random.Random) -> int:
    """Write random bytes of the right size where the drive takes them; return how many."""
    taken = 0
    for item in listed:
        if item.index < 0x2000 and item.index not in (0x1006, 0x1007, 0x1014, 0x1015, 0x1029):
            continue  # supervision and PDOs are filled below
        for _ in range(4):
            size = len(node.sdo.read(item.index, item.sub))
            data = rng.randrange(1 << min(8 * size, 14)).to_bytes(size, "little") if size else b""
            try:
                node.sdo.download(item.index, item.sub, data)
            except SdoAbort:
                continue
            taken += bool(data)
            break
    for index, sub, data in ((0x1A00, 0, b"\0"), (0x1800, 2, b"\1"), (0x1017, 0, b"\x64\0")):
        try:
            if index == 0x1A00:
                cob = node.sdo.read(0x1800, 1)
                node.sdo.download(0x1800, 1, (int.from_bytes(cob, "little") | 1 << 31).to_bytes(4, "little"))
            node.sdo.download(index, sub, data)
            taken += 1
        except SdoAbort:
            continue
    return taken


def row_of(file: str, seed: int, refuse: int, folder: Path) -> tuple[list[str], bool]:
    """Return one row of the table, and whether all was equal or named."""
    rng = random.Random(f"{seed} {file}")
    rows = read_makers_objects(file).rows.values()
    listed, _ = kept_objects(Listed(row.index, row.sub, row.name) for row in rows if row.access == "rw")
    with opened(HERE, file) as node:
        taken = fill(node, list(listed), rng)
        backup, left_out = take_whole_backup(node, node.identity(), listed)
    with opened(SPARE, file) as node:
        identity = node.identity()
        node.map = whole_map(identity)
        plan = plan_restore(node, backup)
        refusing = {(c.index, c.sub) for c in rng.sample(plan.changes, min(refuse, len(plan.changes)))}
        simulated = cast(Node, node.connection.bus.line.nodes[0])  # type: ignore[attr-defined]
        if refusing:
            simulated.set_faults(
                refuse=lambda index, sub: AbortCode.VALUE if (index, sub) in refusing else None,
                distort=None, store_scale=1.0,
            )  # fmt: skip
        job = Download(node, identity, plan, old_marks(backup), JournalFolder(identity, folder))
        outcome = job.run(store=node.has(*STORE_ALL))
        different = []
        for entry in backup.entries:
            if entry.name[:2] == "0x" and node.sdo.upload(entry.index, entry.sub).data != entry.old:
                different.append(entry.name)
    unnamed = [name for name in different if name not in outcome.refused]
    missing = [name for name in outcome.refused if name not in different]
    good = not unnamed and not missing and len(outcome.refused) >= len(refusing)
    label = file.partition("#")[2] or Path(file).name
    counts = [len(listed), taken, len(backup.entries), len(plan.changes), outcome.written, len(refusing)]
    told = "; ".join(f"{name}: {why}" for name, why in outcome.refused.items()) or "-"
    stored = "yes" if outcome.stored else "no 0x1010"
    return [label, *map(str, counts), str(len(unnamed)), stored, told, str(len(left_out))], good


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="+", metavar="FILE")
    parser.add_argument("--family", action="append", default=[])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--refuse", type=int, default=0)
    options = parser.parse_args()
    head = ("node", "settings", "filled", "saved", "differ", "written", "made to refuse", "unequal and not named",
            "stored", "named", "not saved")  # fmt: skip
    print("| " + " | ".join(head) + " |\n|" + "---|" * len(head))
    good = True
    with tempfile.TemporaryDirectory() as folder:
        for file in files_of(options.sources, options.family):
            try:
                row, fine = row_of(file, options.seed, options.refuse, Path(folder))
            except ConfigError as error:  # a controller of another profile
                row, fine = [file.partition("#")[2], *["-"] * 8, error.what, "-"], True
            good = good and fine
            print("| " + " | ".join(row) + " |", flush=True)
    print("every object equal or named" if good else "NOT every object equal or named")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
