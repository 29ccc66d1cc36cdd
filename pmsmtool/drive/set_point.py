# SPDX-License-Identifier: MIT
"""Profile position mode (CiA 402-2, clause 11): a target, and the handshake by which a drive takes it."""

from __future__ import annotations

from pmsmtool.cia402 import Command, Control
from pmsmtool.drive import objects
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.objects import DriveObject
from pmsmtool.errors import DriveTimeout

TARGET_POSITION = DriveObject(0x607A, 0, "i")
POSITION_DEMAND = DriveObject(0x6062, 0, "i")
FOLLOWING_ERROR = DriveObject(0x60F4, 0, "i")
"""Demand less position, as of the same instant (CiA 402-2)."""
NEW_SET_POINT, ACKNOWLEDGED = 0x0010, 0x1000
"""Bits of controlword and statusword in profile position mode (CiA 402-2, 11.4)."""
ACKNOWLEDGE_S = 0.5
WHOLE = 2.0**32


def start_move(node: DriveNode, counts: float, *, at_once: bool = False) -> None:
    """Start a move to a position (increments, modulo 2^32) of a drive that is enabled in profile position mode.

    Without ``at_once`` a drive that moves already goes there after its move.

    Raises DriveTimeout: the drive does not take the set-point.
    """
    node.put(TARGET_POSITION, (round(counts) + WHOLE / 2) % WHOLE - WHOLE / 2)
    word = Command.ENABLE_OPERATION | (Control.AT_ONCE if at_once else 0)
    node.command(objects.CONTROLWORD, word | NEW_SET_POINT)
    until = node.connection.clock.now() + ACKNOWLEDGE_S
    while not node.whole(objects.STATUSWORD) & ACKNOWLEDGED:
        if node.connection.clock.now() > until:
            raise DriveTimeout(
                f"the drive does not acknowledge a set-point within {ACKNOWLEDGE_S:g} s",
                where=f"node {node.node}, 0x6041 bit 12",
                likely="the drive expects homing first, or the target is beyond its software limits (0x607D)",
                hint="home it, or widen the limits with the maker's software",
            )  # fmt: skip
    node.command(objects.CONTROLWORD, word)
