# SPDX-License-Identifier: MIT
"""A drive that is a table of objects behind a correct SDO server, with the states of CiA 402 and nothing that turns."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

from pmsmtool.bus.connect import Connection
from pmsmtool.cia402 import Command
from pmsmtool.drive import objects
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive_maps.drive_map import DriveMap
from tests.bus.scripted import NODE, ScriptedBus, ScriptedSlave

Held = Mapping[DriveObject, float]
STATES: dict[int, int] = {  # controlword to statusword: no ramp and no fault
    Command.DISABLE_VOLTAGE: 0x0240, Command.SHUTDOWN: 0x0231, Command.SWITCH_ON: 0x0233,
    Command.ENABLE_OPERATION: 0x0237, Command.QUICK_STOP: 0x0240,
}  # fmt: skip
IDENTITY = {(0x1018, 1): 0x1234, (0x1018, 2): 0x5678, (0x1018, 3): 0x00010000, (0x1018, 4): 77}


class TableDrive(ScriptedSlave):
    """The server: what is written is held, the mode is displayed, and the controlword acts at once.

    Attributes
    ----------
    shown : dict of DriveObject to callable
        Values that are computed whenever they are read.
    fixed : dict of (int, int) to int
        Objects that refuse a write, with the abort code.
    """

    def __init__(self, held: Held) -> None:
        raw = {(0x1000, 0): b"\x92\x01\x02\x00"} | {key: n.to_bytes(4, "little") for key, n in IDENTITY.items()}
        super().__init__(raw | {(item.index, item.sub): item.encode(value) for item, value in held.items()})
        self.objects.setdefault((0x6041, 0), (0x0240).to_bytes(2, "little"))
        self.shown: dict[DriveObject, Callable[[], float]] = {}
        self.fixed: dict[tuple[int, int], int] = {}

    def answer(self, data: bytes) -> Iterator[bytes]:
        for item, value in self.shown.items():
            self.objects[item.index, item.sub] = item.encode(value())
        return super().answer(data)

    def _step(self, data: bytes) -> list[bytes]:
        code = self.fixed.get((data[1] | data[2] << 8, data[3])) if data[0] >> 5 == 1 else None
        return super()._step(data) if code is None else [b"\x80" + data[1:4] + code.to_bytes(4, "little")]

    def _store(self, index: int, sub: int, body: bytes) -> None:
        super()._store(index, sub, body)
        if index == objects.CONTROLWORD.index:
            status = STATES.get(body[0] & 0x8F)
            if status is not None:
                self.objects[0x6041, 0] = status.to_bytes(2, "little")
        elif index == objects.MODE.index:
            self.objects[objects.MODE_DISPLAY.index, 0] = body

    def number(self, item: DriveObject) -> float:
        """Return what an object holds."""
        return item.decode(self.objects[item.index, item.sub])

    def written(self, *items: DriveObject) -> list[tuple[DriveObject, float]]:
        """Return what was written to some objects, in order."""
        known = {(item.index, item.sub): item for item in items}
        return [(known[i, s], known[i, s].decode(data)) for i, s, data in self.writes if (i, s) in known]


@contextmanager
def opened(held: Held) -> Iterator[tuple[TableDrive, Connection]]:
    """Open the bus of a drive with these objects; its node id is ``NODE``."""
    table = TableDrive(held)
    with Connection(ScriptedBus(table)) as connection:
        yield table, connection


@contextmanager
def node_of(held: Held, drive_map: DriveMap | None = None) -> Iterator[tuple[TableDrive, DriveNode]]:
    """Open the node of a drive with these objects."""
    with opened(held) as (table, connection):
        yield table, DriveNode(connection, NODE, drive_map=drive_map)
