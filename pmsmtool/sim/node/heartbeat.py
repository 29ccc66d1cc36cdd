# SPDX-License-Identifier: MIT
"""Heartbeat producer and consumer (CiA 301: 7.2.8.2.2, objects 0x1016 and 0x1017)."""

from __future__ import annotations

from collections.abc import Callable

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.clock import Schedule, Timer
from pmsmtool.sim.node.dictionary import Dictionary, Refused

CONSUMERS = 4
_MS = 1_000_000


class HeartbeatProducer:
    """Sends the NMT state every 0x1017 milliseconds."""

    def __init__(self, dictionary: Dictionary, schedule: Schedule, send_state: Callable[[], None]) -> None:
        self._entry = dictionary["heartbeat.producer_ms"]
        self._entry.sink = self._write
        self._schedule = schedule
        self._send_state = send_state
        self._timer: Timer | None = None

    def start(self) -> None:
        """Begin with the period of the dictionary; zero is off."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._entry.integer():
            self._plan(self._schedule.now_ns)

    def _plan(self, from_ns: int) -> None:
        due_ns = from_ns + self._entry.integer() * _MS
        self._timer = self._schedule.at(due_ns, lambda: self._tick(due_ns))

    def _tick(self, due_ns: int) -> None:
        self._plan(due_ns)
        self._send_state()

    def _write(self, data: bytes) -> None:
        self._entry.value = data
        self.start()


class HeartbeatConsumer:
    """Watches the heartbeats of other nodes; each is watched from its first heartbeat on.

    Parameters
    ----------
    lost : callable
        Called with the node id when a heartbeat is overdue.
    regained : callable
        Called when every heartbeat that was lost has come back.
    """

    def __init__(
        self, dictionary: Dictionary, schedule: Schedule, lost: Callable[[int], None], regained: Callable[[], None]
    ) -> None:
        self._schedule = schedule
        self._lost = lost
        self._regained = regained
        self._missing: set[int] = set()
        self._entries = [dictionary[f"heartbeat.consumer_{number + 1}"] for number in range(CONSUMERS)]
        self._deadline: dict[int, int] = {}
        self._timers: dict[int, Timer] = {}
        for entry in self._entries:
            entry.sink = self._sink(entry.row.key, dictionary)

    def _sink(self, key: str, dictionary: Dictionary) -> Callable[[bytes], None]:
        def sink(data: bytes) -> None:
            node = data[2]
            if node and any(other.row.key != key and other.value[2] == node for other in self._entries):
                raise Refused(AbortCode.INCOMPATIBLE)  # CiA 301: several entries for one producer
            entry = dictionary[key]
            previous = entry.value[2]
            entry.value = data
            was_missing = bool(self._missing)
            for stale in {previous, node}:
                self._forget(stale)
            if was_missing and not self._missing:
                self._regained()

        return sink

    def _forget(self, node: int) -> None:
        self._deadline.pop(node, None)
        self._missing.discard(node)
        timer = self._timers.pop(node, None)
        if timer is not None:
            timer.cancel()

    def _period_ns(self, node: int) -> int:
        for entry in self._entries:
            if entry.value[2] == node:
                return int.from_bytes(entry.value[:2], "little") * _MS
        return 0

    def heard(self, node: int) -> None:
        """A heartbeat of a node has arrived."""
        period_ns = self._period_ns(node)
        if not period_ns:
            return
        if node in self._missing:
            self._missing.remove(node)
            if not self._missing:
                self._regained()
        self._deadline[node] = self._schedule.now_ns + period_ns
        if node not in self._timers:
            self._plan(node)

    def _plan(self, node: int) -> None:
        self._timers[node] = self._schedule.at(self._deadline[node], lambda: self._check(node))

    def _check(self, node: int) -> None:
        self._timers.pop(node, None)
        deadline = self._deadline.get(node)
        if deadline is None:
            return
        if deadline > self._schedule.now_ns:
            self._plan(node)
            return
        self._forget(node)
        self._missing.add(node)
        self._lost(node)
