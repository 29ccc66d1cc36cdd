# SPDX-License-Identifier: MIT
"""The tool's own heartbeat, its remote frames of node guarding or its empty PDO: the drive stops when they stay away.

It runs on the bus clock as a job of its own (a thread on a real bus), so that its period does not depend on what the
main thread does. It is sent only while somebody watches the machine: a tool that is killed stops the machine, and so
does one whose main thread hangs.
"""

from __future__ import annotations

from collections.abc import Callable
from types import TracebackType

from pmsmtool.bus.clock import Ticker
from pmsmtool.bus.connection import SEND_PATIENCE_S, Connection
from pmsmtool.bus.nmt import HEARTBEAT_ID, TOOL_NODE, NmtState
from pmsmtool.drive.expected_pdo import DUMMY
from pmsmtool.errors import BusError

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
        COB-ID of an empty PDO (``expected_pdo.py``) that is sent instead.
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

        Raises
        ------
        BusError
            It cannot be sent.
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
