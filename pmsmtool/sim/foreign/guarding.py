# SPDX-License-Identifier: MIT
"""Node guarding of a simulated drive: the remote frame it answers, and life guarding (CiA 301, 7.2.8.2.2.1)."""

from __future__ import annotations

from collections.abc import Callable

from pmsmtool.bus.clock import Timer
from pmsmtool.sim.node.dictionary import Entry
from pmsmtool.sim.node.schedule import Schedule

_MS = 1_000_000
TOGGLE = 0x80


class NodeGuarding:
    """Answers the master's remote frames, and watches that they come.

    It watches from the first remote frame on, and only while there is a life time (0x100C x 0x100D) and no heartbeat.

    Parameters
    ----------
    guard_ms, factor, heartbeat_ms : Entry
        Objects 0x100C, 0x100D and 0x1017.
    schedule : Schedule
        Of the session.
    answer : callable
        Sends the NMT state with the toggle bit (0 or ``TOGGLE``).
    lost, regained : callable
        Called when no remote frame came within the life time; when one comes again.
    """

    def __init__(
        self,
        guard_ms: Entry,
        factor: Entry,
        heartbeat_ms: Entry | None,
        schedule: Schedule,
        answer: Callable[[int], None],
        lost: Callable[[], None],
        regained: Callable[[], None],
    ) -> None:
        self._guard_ms, self._factor, self._heartbeat_ms = guard_ms, factor, heartbeat_ms
        self._schedule = schedule
        self._answer, self._lost, self._regained = answer, lost, regained
        self._toggle = 0
        self._deadline_ns = 0
        self._timer: Timer | None = None
        self._missing = False

    def asked(self) -> None:
        """Take a remote frame."""
        if self._heartbeat_ms is not None and self._heartbeat_ms.integer():
            return  # a node does not guard and send heartbeats at once
        self._answer(self._toggle)
        self._toggle ^= TOGGLE
        if self._missing:
            self._missing = False
            self._regained()
        self._deadline_ns = self._schedule.now_ns + self._life_ns()
        if self._timer is None and self._life_ns():
            self._plan()

    def _life_ns(self) -> int:
        return self._guard_ms.integer() * self._factor.integer() * _MS

    def _plan(self) -> None:
        self._timer = self._schedule.at(self._deadline_ns, self._check)

    def _check(self) -> None:
        self._timer = None
        if not self._life_ns():
            return
        if self._deadline_ns > self._schedule.now_ns:
            self._plan()
            return
        self._missing = True
        self._lost()
