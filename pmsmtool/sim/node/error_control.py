# SPDX-License-Identifier: MIT
"""Heartbeat, node guarding, emergencies, error register and history (CiA 301: 7.2.7, 7.2.8, 0x1001 to 0x1017)."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import TYPE_CHECKING

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.clock import NS, Schedule, Timer
from pmsmtool.sim.node.dictionary import Dictionary, Entry, Refused

if TYPE_CHECKING:
    from pmsmtool.sim.node.session import Session

CONSUMERS = 4
TOGGLE = 0x80
"""Bit of the answer to a remote frame that changes from one to the next."""
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


def guarding_of(session: Session) -> NodeGuarding | None:
    """Return node guarding where the dictionary shows its objects."""
    entries = {(entry.row.index, entry.row.sub): entry for entry in session.dictionary}
    guard_ms, factor = entries.get((0x100C, 0)), entries.get((0x100D, 0))
    if guard_ms is None or factor is None:
        return None
    return NodeGuarding(
        guard_ms, factor, entries.get((0x1017, 0)), session.schedule, session.answer_guarding,
        lambda: session.power.connection_lost(0), session.power.connection_regained,
    )  # fmt: skip


_EMCY = struct.Struct("<HB5s")
_HISTORY = 8
_GENERIC = 0x01
# Error register bit of each code group (CiA 301, object 0x1001).
_REGISTER = {0x2: 0x02, 0x3: 0x04, 0x4: 0x08, 0x81: 0x10, 0x82: 0x10, 0xF: 0x80}


def register_bits(code: int) -> int:
    """Return the error register bits of an error code."""
    return _GENERIC | _REGISTER.get(code >> 8, _REGISTER.get(code >> 12, 0))


class Emergency:
    """Errors present, their history, and the messages about them."""

    def __init__(self, dictionary: Dictionary, schedule: Schedule, send: Callable[[int, bytes], None]) -> None:
        self._present: set[int] = set()
        self._history: list[int] = []
        self._dictionary = dictionary
        self._schedule = schedule
        self._send = send
        self._free_ns = 0
        entry = dictionary["error.register"]
        entry.source = lambda: bytes((self.register,))
        dictionary["error.history_length"].source = lambda: bytes((len(self._history),))
        dictionary["error.history_length"].sink = self._clear_history
        for number in range(_HISTORY):
            dictionary[f"error.history_{number + 1}"].source = self._history_source(number)

    @property
    def register(self) -> int:
        """Error register: the bits of all errors present."""
        bits = 0
        for code in self._present:
            bits |= register_bits(code)
        return bits

    def _history_source(self, number: int) -> Callable[[], bytes]:
        return lambda: (self._history[number] if number < len(self._history) else 0).to_bytes(4, "little")

    def _clear_history(self, data: bytes) -> None:
        self._history.clear()  # the bounds of the object admit only zero

    def raise_error(self, code: int, detail: bytes = b"") -> None:
        """Report an error: register, history, message."""
        self._present.add(code)
        self._history.insert(0, code)
        del self._history[_HISTORY:]
        self._message(code, detail)

    def clear(self, code: int | None = None) -> None:
        """One error is gone, or all are; the message "error reset" shows in its register what is left."""
        gone = self._present if code is None else self._present & {code}
        if gone:
            self._present = self._present - gone
            self._message(0, b"")

    def _message(self, code: int, detail: bytes) -> None:
        cob_id = self._dictionary["emergency.cob_id"].integer()
        if cob_id & 1 << 31:
            return
        frame = _EMCY.pack(code, self.register, detail)
        inhibit_ns = self._dictionary["emergency.inhibit"].integer() * NS // 10_000
        start_ns = max(self._schedule.now_ns, self._free_ns)
        self._free_ns = start_ns + inhibit_ns
        if start_ns == self._schedule.now_ns:
            self._send(cob_id & 0x7FF, frame)
        else:
            self._schedule.at(start_ns, lambda: self._send(cob_id & 0x7FF, frame))
