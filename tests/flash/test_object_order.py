# SPDX-License-Identifier: MIT
"""Objects by their addresses: the order in which a drive takes them, and identifiers that follow the node id."""

from __future__ import annotations

from dataclasses import replace

import pytest

from pmsmtool.bus.connect import Connection
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive.port import Identity
from pmsmtool.flash.journal import Entry, Snapshot
from pmsmtool.flash.whole_drive import WholeDrive, readdressed, whole_map
from tests.bus.scripted import NODE, ScriptedBus
from tests.drive.table_drive import TableDrive


@pytest.mark.parametrize(
    ("index", "sub", "before", "after"),
    [
        (0x1014, 0, 0x081, 0x087), (0x1400, 1, 0x201, 0x207), (0x15FF, 1, 0x301, 0x307), (0x1800, 1, 0x181, 0x187),
        (0x19FF, 1, 0x481, 0x487), (0x1800, 1, 0xC0000181, 0xC0000187),
        (0x1800, 1, 0x182, 0x182),  # somebody chose it: of another node
        (0x1800, 1, 0x001, 0x001),  # no function code: none of the pre-defined set
        (0x1800, 2, 0x181, 0x181), (0x1A00, 1, 0x181, 0x181), (0x1600, 1, 0x201, 0x201), (0x13FF, 1, 0x201, 0x201),
        (0x1C00, 1, 0x181, 0x181), (0x1200, 1, 0x601, 0x601), (0x2000, 1, 0x181, 0x181),
    ],
)  # fmt: skip
def test_which_identifiers_follow_the_node_id(index: int, sub: int, before: int, after: int) -> None:
    entry = Entry("x", index, sub, before.to_bytes(4, "little"))
    identity = Identity(1, 2, 3, 4, 5, "", "", "")
    moved = readdressed(Snapshot("backup", "done", identity, 0, "", (entry,)), 7)
    assert int.from_bytes(moved.entries[0].old, "little") == after
    short = replace(entry, old=entry.old[:2])
    assert readdressed(Snapshot("backup", "done", identity, 0, "", (short,)), 7).entries[0] == short


PDO = {(0x1800, 1): 4, (0x1800, 2): 1, (0x1A00, 0): 1, (0x1A00, 1): 4, (0x1A00, 2): 4}
"""Sub-objects of one transmit PDO and their bytes."""


class Switched(TableDrive):
    """A drive that takes a PDO's mapping only while the PDO is off and its mapping empty, and limits each other."""

    def _step(self, data: bytes) -> list[bytes]:
        index, sub = data[1] | data[2] << 8, data[3]
        if data[0] >> 5 == 1 and (index, sub) in ((0x1A00, 1), (0x1A00, 2), (0x1A00, 0), (0x1800, 2)):
            off = self.objects[0x1800, 1][3] & 0x80
            if not off or (sub and index == 0x1A00 and self.objects[0x1A00, 0] != b"\0"):
                return [b"\x80" + data[1:4] + (0x06010002).to_bytes(4, "little")]
        if (index, sub) == (0x3000, 1) and data[0] >> 5 == 1 and data[4] > self.objects[0x3000, 2][0]:
            return [b"\x80" + data[1:4] + (0x06090031).to_bytes(4, "little")]
        return super()._step(data)


def whole(name: str) -> str:
    index, sub = (int(part, 16) for part in name.split(":"))
    return f"0x{index:04X}:{sub:02X} object"


def test_objects_are_written_in_an_order_that_a_drive_takes() -> None:
    """The limit that bounds a value, communication after the machine's objects, a PDO off and empty in between."""
    table = Switched({DriveObject(0x3000, 1, "B"): 5, DriveObject(0x3000, 2, "B"): 10, DriveObject(0x1017, 0, "H"): 0})
    table.objects |= {place: bytes(size) for place, size in PDO.items()}
    table.objects[0x1800, 1] = (0x181).to_bytes(4, "little")
    table.objects[0x1A00, 0] = b"\1"
    wanted = {
        whole("1017:0"): b"\x64\0", whole("3000:1"): b"\x14", whole("3000:2"): b"\x28",
        whole("1800:1"): (0x40000181).to_bytes(4, "little"), whole("1800:2"): b"\xff", whole("1A00:0"): b"\2",
        whole("1A00:1"): b"\x10\0\x41\x60", whole("1A00:2"): b"\x20\0\x64\x60", whole("3000:3"): b"",
    }  # fmt: skip
    with Connection(ScriptedBus(table)) as connection:
        node = DriveNode(connection, NODE, drive_map=whole_map(Identity(NODE, 1, 2, 3, 4, "", "", "")))
        drive, told = WholeDrive(node), list[tuple[int, int]]()
        node.before_write = lambda index, sub, _: told.append((index, sub))
        drive.replace(wanted)
        assert drive.refused == {}
        assert {name: table.objects[node.map.address(name)] for name in wanted if wanted[name]} == {
            name: data for name, data in wanted.items() if data
        }
        places = [(index, sub) for index, sub, _ in table.writes]
        assert places.index((0x3000, 2)) < places.index((0x1017, 0)), "communication last"
        pdo = [(index, sub) for index, sub in places if index in (0x1800, 0x1A00)]
        assert pdo == [
            (0x1800, 1), (0x1A00, 0), (0x1800, 2), (0x1A00, 1), (0x1A00, 2), (0x1A00, 0), (0x1800, 1),
        ]  # fmt: skip
        assert (0x3000, 1) in told and (0x3000, 3) not in told
        table.writes.clear()
        drive.replace(wanted)
        assert table.writes == [], "what is held is not written again"
        done: list[tuple[int, int | None]] = []
        drive.replace(wanted | {whole("1800:2"): b"\xfe"}, progress=lambda *at: done.append(at))
        assert done == [(7, 8)], "of the eight that were there one differs"
        assert [place[:2] for place in table.writes] == [(0x1800, 1), (0x1800, 2), (0x1800, 1)], "the mapping stays"
        table.fixed[0x3000, 2] = 0x08000022
        drive.replace({whole("3000:2"): b"\x29", whole("1017:0"): b"\0\0"})
        assert list(drive.refused) == [whole("3000:2")] and "0x08000022" in drive.refused[whole("3000:2")]
        table.fixed.clear()
        drive.replace({whole("3000:2"): b"\x29"})
        assert drive.refused == {}
