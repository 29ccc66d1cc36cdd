# SPDX-License-Identifier: MIT
"""Network management: commands to nodes, their states and boot-up (CiA 301, section 7.2.8); who is on the bus."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from pmsmtool.bus.connection import Connection
from pmsmtool.errors import DriveTimeout

NMT_ID = 0x000
HEARTBEAT_ID = 0x700
TOOL_NODE = 0x7E
"""Node id the tool's heartbeat carries; 0x7F is left to a PLC or configuration tool."""
BOOT_TIMEOUT_S = 5.0
"""A drive's firmware is up again within this time; the simulated one needs a fraction of a second."""

NODES = range(1, 128)
LISTEN_S = 0.3
"""Usual SDO time-out: a node that has not answered by then is slower than stock clients tolerate."""
ASKED = 2
"""Times all are asked where none answers: one lost frame is no missing drive."""
_DEVICE_TYPE_REQUEST = b"\x40\x00\x10\x00\x00\x00\x00\x00"


class NmtCommand(IntEnum):
    """Command specifiers of the NMT master."""

    START = 0x01
    STOP = 0x02
    PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82


class NmtState(IntEnum):
    """States as heartbeats report them."""

    BOOT_UP = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


def send_nmt(connection: Connection, command: NmtCommand, node: int) -> None:
    """Send an NMT command; node 0 means every node."""
    connection.send(NMT_ID, bytes((command, node)))


def reset_node(connection: Connection, node: int, *, timeout_s: float = BOOT_TIMEOUT_S) -> None:
    """Reset a node and return when its boot-up message came. Raises DriveTimeout: no boot-up within ``timeout_s``."""
    boots: list[float] = []

    def heard(cob_id: int, data: bytes, timestamp: float) -> None:
        if data[:1] == b"\0":
            boots.append(timestamp)

    connection.subscribe(HEARTBEAT_ID + node, heard)
    try:
        send_nmt(connection, NmtCommand.RESET_NODE, node)
        if not connection.wait_until(lambda: bool(boots), timeout_s):
            likely, hint = connection.explain_silence(node)
            raise DriveTimeout(
                f"no boot-up within {timeout_s:g} s after the reset", where=f"node {node}", likely=likely, hint=hint
            )
    finally:
        connection.unsubscribe(HEARTBEAT_ID + node, heard)


@dataclass(frozen=True, slots=True)
class FoundNode:
    """One node."""

    node: int
    """Node id."""
    device_type: int | None
    """Object 0x1000; None when it did not answer."""
    nmt_state: NmtState | None
    """From its heartbeat, if one was heard."""

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
        for _ in range(ASKED):
            for node in NODES:
                connection.send(0x600 + node, _DEVICE_TYPE_REQUEST)
            connection.wait(LISTEN_S)
            if types:
                break
    finally:
        for cob_id, callback in subscriptions:
            connection.unsubscribe(cob_id, callback)
    return [FoundNode(node, types.get(node), states.get(node)) for node in sorted({*types, *states})]
