# SPDX-License-Identifier: MIT
"""A process data object that the drive expects, as a third kind of supervision: it carries nothing.

A drive may watch that a receive PDO comes (event timer, sub-index 5 of 0x1400 on; CiA 301, 7.5.2.35). What it does when
one stays away is the maker's matter, and often only a message (0x8250): the dead-man's proof shows which. The PDO maps
a dummy entry, an UNSIGNED8 that the drive throws away (CiA 301, 7.5.2.36), so that it can command nothing, and so that
a thread that sends it knows nothing of the controlword.
"""

from __future__ import annotations

import contextlib

from pmsmtool.drive.borrowed_pdo import BorrowedPdo
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.objects import DriveObject
from pmsmtool.errors import BusError, NotAvailable, SdoAbort

NUMBERS = (4, 3, 2, 1)
"""Receive PDOs in the order in which they are tried: the first ones are what a master uses."""
DUMMY_BYTE = 0x0005_0008
DUMMY = b"\0"
_AT_ONCE = 255


def event_timer(number: int) -> DriveObject:
    """Return the object of the time within which a receive PDO is expected (ms)."""
    return DriveObject(0x1400 + number - 1, 5, "H")


def expects_pdos(node: DriveNode) -> bool:
    """Whether the drive has such a time for any of its receive PDOs."""
    return any(node.has(event_timer(number).index, 5) for number in NUMBERS)


def expect_pdo(node: DriveNode, within_ms: float) -> int | None:
    """Make the drive expect an empty PDO within a time; return its COB-ID, None where it takes none.

    What the PDO was is brought back when the node is closed; the time, an object like others, by who writes it.
    """
    for number in NUMBERS:
        if not node.has(event_timer(number).index, 5):
            continue
        communication, mapping = 0x1400 + number - 1, 0x1600 + number - 1
        ours = 0x100 + 0x100 * number + node.node
        try:
            pdo = BorrowedPdo.read(node, communication, mapping, 1)
        except (SdoAbort, NotAvailable):  # another one may do
            continue

        def back(pdo: BorrowedPdo = pdo) -> None:
            """Give the PDO back; a bus that is lost ended the work already, and its own error says more."""
            with contextlib.suppress(BusError):
                pdo.bring_back(node)

        node.before_close.append(back)
        try:
            pdo.switch_off(node)
            pdo.change(node, [DUMMY_BYTE], _AT_ONCE)
            node.put(event_timer(number), within_ms)
            node.sdo.download(communication, 1, ours.to_bytes(4, "little"))
        except SdoAbort:  # fixed, or without dummy entries
            node.before_close.remove(back)
            back()
            continue
        return ours
    return None
