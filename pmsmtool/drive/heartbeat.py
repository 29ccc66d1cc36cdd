# SPDX-License-Identifier: MIT
"""The tool's own heartbeat, its remote frames of node guarding or its empty PDO: the drive stops when they stay away.

It runs on the bus clock as a job of its own (a thread on a real bus), so that its period does not depend on what the
main thread does. It is sent only while somebody watches the machine: a tool that is killed stops the machine, and so
does one whose main thread hangs.

A process data object that the drive expects, as a third kind of supervision: it carries nothing.

A drive may watch that a receive PDO comes (event timer, sub-index 5 of 0x1400 on; CiA 301, 7.5.2.35). What it does when
one stays away is the maker's matter, and often only a message (0x8250): the dead-man's proof shows which. The PDO maps
a dummy entry, an UNSIGNED8 that the drive throws away (CiA 301, 7.5.2.36), so that it can command nothing, and so that
a thread that sends it knows nothing of the controlword.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from types import TracebackType

from pmsmtool.bus.clock import Ticker
from pmsmtool.bus.connection import SEND_PATIENCE_S, Connection
from pmsmtool.bus.nmt import HEARTBEAT_ID, TOOL_NODE, NmtState
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive.process_data import BorrowedPdo
from pmsmtool.errors import BusError, NotAvailable, SdoAbort

PERIOD_S = 0.05
"""Five heartbeats within the drive's consumer time of ``dead_man.CONSUMER_MS``."""

LATE_PERIODS = 2.0
"""A heartbeat that did not come for so many periods is late."""


class Heartbeat:
    """Producer of the tool's heartbeat.

    Parameters
    ----------
    connection : Connection
        The bus.
    is_watched : callable
        Whether the machine is watched, or off; while it says no, no heartbeat is sent.

    Attributes
    ----------
    guarded_node : int or None
        Node that is asked for its state by remote frames (node guarding) instead of being sent heartbeats.
    expected_pdo : int or None
        COB-ID of an empty PDO that is sent instead.
    """

    def __init__(self, connection: Connection, *, is_watched: Callable[[], bool] = lambda: True) -> None:
        self._connection = connection
        self._is_watched = is_watched
        self._ticker: Ticker | None = None
        self._last_s = 0.0
        self._longest_s = 0.0
        self._failed = False
        self.guarded_node: int | None = None
        self.expected_pdo: int | None = None

    @property
    def kind(self) -> str:
        """What is sent, by its name."""
        if self.expected_pdo is not None:
            return "process data"
        return "heartbeat" if self.guarded_node is None else "node guarding"

    def __enter__(self) -> Heartbeat:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def start(self) -> None:
        """Send the first heartbeat now and one every period."""
        if self._ticker is None:
            self._last_s, self._longest_s = self._connection.clock.now(), 0.0
            self._send()
            self._failed = False
            self._ticker = self._connection.clock.every(PERIOD_S, self._beat)

    def resume(self) -> None:
        """Make sure that the drive is watching: start when stopped, send one at once when the last failed or is late.

        A drive whose supervision has ended operation watches again from the next heartbeat on, not before (CiA 301,
        section 7.2.8.2.2).

        Raises BusError: it cannot be sent.
        """
        if self._ticker is None:
            self.start()
        elif self._failed or self._connection.clock.now() - self._last_s > LATE_PERIODS * PERIOD_S:
            self._send()
            self._failed = False

    def _send(self, patience_s: float = SEND_PATIENCE_S) -> None:
        if self.expected_pdo is not None:
            self._connection.send(self.expected_pdo, DUMMY, patience_s=patience_s)
        elif self.guarded_node is None:
            data = bytes((NmtState.OPERATIONAL,))
            self._connection.send(HEARTBEAT_ID + TOOL_NODE, data, patience_s=patience_s)
        else:
            self._connection.request(HEARTBEAT_ID + self.guarded_node, 1)

    def stop(self) -> None:
        """Send no more; the drive notices after its consumer time."""
        ticker, self._ticker = self._ticker, None
        if ticker is not None:
            ticker.stop()

    def longest_gap_s(self) -> float:
        """Return the longest time (s) without a heartbeat since the start: whether this computer kept the period."""
        return max(self._longest_s, self._connection.clock.now() - self._last_s)

    def _beat(self) -> None:
        if not self._is_watched():
            return
        before = self._connection.clock.now()
        # Nobody catches here: the drive notices a lost heartbeat, the next request meets the failed bus.
        try:
            self._send(0.0)
            self._failed = False
        except BusError:
            self._failed = True
        self._longest_s = max(self._longest_s, self._connection.clock.now() - self._last_s)
        self._last_s = before


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
    return any(node.takes(event_timer(number)) for number in NUMBERS)


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
