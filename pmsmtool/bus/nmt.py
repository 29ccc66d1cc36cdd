# SPDX-License-Identifier: MIT
"""Network management: commands to nodes, states they report, waiting for their boot-up (CiA 301, section 7.2.8)."""

from __future__ import annotations

from enum import IntEnum

from pmsmtool.bus.connection import Connection
from pmsmtool.errors import DriveTimeout

NMT_ID = 0x000
HEARTBEAT_ID = 0x700
TOOL_NODE = 0x7E
"""Node id the tool's heartbeat carries; 0x7F is left to a PLC or configuration tool."""
BOOT_TIMEOUT_S = 5.0
"""A drive's firmware is up again within this time; the simulated one needs a fraction of a second."""


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
    """Reset a node and return when its boot-up message came.

    Raises
    ------
    DriveTimeout
        No boot-up within ``timeout_s``.
    """
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
