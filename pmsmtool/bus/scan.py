# SPDX-License-Identifier: MIT
"""Who is on the bus: every node that answers a read of its device type, or was heard."""

from __future__ import annotations

from dataclasses import dataclass

from pmsmtool.bus.connection import Connection
from pmsmtool.bus.nmt import HEARTBEAT_ID, NmtState

NODES = range(1, 128)
LISTEN_S = 0.3
"""Usual SDO time-out: a node that has not answered by then is slower than stock clients tolerate."""
_DEVICE_TYPE_REQUEST = b"\x40\x00\x10\x00\x00\x00\x00\x00"


@dataclass(frozen=True, slots=True)
class FoundNode:
    """One node.

    Attributes
    ----------
    node : int
        Node id.
    device_type : int or None
        Object 0x1000; None when it did not answer.
    nmt_state : NmtState or None
        From its heartbeat, if one was heard.
    """

    node: int
    device_type: int | None
    nmt_state: NmtState | None

    @property
    def is_drive(self) -> bool:
        """Whether the device profile is CiA 402."""
        return self.device_type is not None and self.device_type & 0xFFFF == 402


def find_nodes(connection: Connection) -> list[FoundNode]:
    """Ask every node id for its device type and return who answered or was heard, by node id."""
    types: dict[int, int | None] = {}
    states: dict[int, NmtState] = {}

    def answered(cob_id: int, data: bytes, timestamp: float) -> None:
        if data[1:4] == _DEVICE_TYPE_REQUEST[1:4]:
            told = int.from_bytes(data[4:8], "little") if data[0] & 0xE0 == 0x40 else None
            types[cob_id - 0x580] = types.get(cob_id - 0x580) if told is None else told

    def beat(cob_id: int, data: bytes, timestamp: float) -> None:
        if data and data[0] & 0x7F in set(NmtState):
            states[cob_id - HEARTBEAT_ID] = NmtState(data[0] & 0x7F)

    subscriptions = [(0x580 + node, answered) for node in NODES] + [(HEARTBEAT_ID + node, beat) for node in NODES]
    for cob_id, callback in subscriptions:
        connection.subscribe(cob_id, callback)
    try:
        for node in NODES:
            connection.send(0x600 + node, _DEVICE_TYPE_REQUEST)
        connection.wait(LISTEN_S)
    finally:
        for cob_id, callback in subscriptions:
            connection.unsubscribe(cob_id, callback)
    return [FoundNode(node, types.get(node), states.get(node)) for node in sorted({*types, *states})]
