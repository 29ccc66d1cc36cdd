# SPDX-License-Identifier: MIT
"""The same script of requests has the same answers in this process and from ``sim serve`` in another one."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator

import pytest

from pmsmtool.bus.connect import Connection
from pmsmtool.bus.nmt import NmtCommand, reset_node, send_nmt
from pmsmtool.bus.sdo import Mode
from pmsmtool.errors import SdoAbort
from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.sim.node.objects import ObjectRow, object_rows
from tests.contract.contract import NODE, Peer
from tests.drive.served import serving

pytestmark = pytest.mark.wall_clock

MEASURED = (
    "live.",
    "trace.crc",
    *(f"cia402.{name}" for name in ("velocity", "position", "torque", "current", "dc_link")),
)
"""Keys of objects that show what the sensors see: their noise depends on the instant."""
COMMANDS = ("store.", "restore.", "cia402.controlword", "trace.command", "average.command", "excitation.command")
Answers = list[tuple[str, str]]


def answer(peer: Peer, row: ObjectRow, data: bytes | None = None) -> str:
    """Return what the drive reports to a read or a write, as text."""
    try:
        if data is None:
            mode = Mode.BLOCK if row.type == "DOMAIN" else Mode.AUTO
            return peer.sdo.upload(row.index, row.sub, mode=mode).data.hex()
        peer.sdo.download(row.index, row.sub, data)
    except SdoAbort as abort:
        return f"{abort.code:08X}"
    return "ok"


def values(row: ObjectRow) -> Iterator[bytes]:
    """Yield bytes at, and beyond, what a number may be."""
    kind = row.data_type
    for bound in (row.low, row.high):
        if bound is not None:
            for number in (bound, bound - 1, bound + 1):
                try:
                    yield struct.pack("<" + kind.letter, number if kind.is_float else int(number))
                except (struct.error, OverflowError):
                    continue
    if kind.is_float:
        yield struct.pack("<f", math.nan)
    yield bytes(kind.size)
    yield bytes(kind.size + 1)


def script(peer: Peer) -> Answers:
    """Read every object, write every number at its limits and beyond; walk through the states."""
    found: Answers = []
    for row in object_rows():
        name = f"0x{row.index:04X}:{row.sub:02X} {row.key}"
        before = answer(peer, row)
        if not row.key.startswith(MEASURED):
            found.append((name, before))
        if row.key.startswith(COMMANDS) or not row.data_type.letter:
            continue
        if row.access != "rw":
            found.append((f"{name} = 0", answer(peer, row, bytes(row.data_type.size))))
            continue
        found += [(f"{name} = {data.hex()}", answer(peer, row, data)) for data in values(row)]
        found.append((f"{name} again", answer(peer, row)))
        answer(peer, row, bytes.fromhex(before))
    reset_node(peer.connection, NODE)
    for command in (NmtCommand.START, NmtCommand.PRE_OPERATIONAL):
        send_nmt(peer.connection, command, NODE)
        for word in (0x02, 0x06, 0x07, 0x0F, 0x07, 0x0F, 0x06, 0x00, 0x80, 0x0F):
            peer.sdo.download(0x6040, 0, word.to_bytes(2, "little"))
            found.append((f"controlword {word:#x}", f"{peer.number(0x6041) & 0x6F:#x}"))
    return found


@pytest.mark.chain
def test_the_same_script_has_the_same_answers() -> None:
    with Connection(PmsmSimBus("interior-2k2?nv=:memory:")) as connection:
        reset_node(connection, NODE)
        inside = script(Peer(connection))
    with serving("--nv", ":memory:") as server, server.connect() as connection:
        reset_node(connection, NODE)
        outside = script(Peer(connection))
    assert len(inside) > 1500
    assert [pair for pair in zip(inside, outside, strict=True) if pair[0] != pair[1]] == []
