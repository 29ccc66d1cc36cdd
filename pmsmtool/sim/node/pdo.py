# SPDX-License-Identifier: MIT
"""Process data objects of the node: four each way, freely mapped (CiA 301: 7.2.2, 7.5.2.35 to 7.5.2.38)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.clock import Schedule, Timer
from pmsmtool.sim.node.dictionary import Dictionary, Entry, Refused
from pmsmtool.sim.node.objects import ObjectRow

COUNT = 4
MAX_OBJECTS = 8
TOO_SHORT = 0x8210
EVENT_TIMER = 5
"""Sub-index of the time within which a receive PDO is expected; the reference drive's have none."""
DUMMY_BYTE = 0x0005_0008
DUMMY_ROW = ObjectRow(5, 0, "", "dummy UNSIGNED8", "U8", "wo", "R")
"""What is received and thrown away (CiA 301, 7.5.2.36)."""
_OFF = 1 << 31
_SYNC_TYPES = range(1, 241)
_EVENT_TYPES = (254, 255)
_TICK_NS = 100_000
_MS_NS = 1_000_000


@dataclass(slots=True)
class _Pdo:
    """One PDO: its keys' prefix, what its objects say, taken over where they are written, and what it carries now."""

    name: str
    entries: list[tuple[Entry, int]] = field(default_factory=list)
    """Objects and their bytes."""
    is_valid: bool = False
    can_id: int = 0
    kind: int = 0
    inhibit_ns: int = 0
    event_ns: int = 0
    last: bytes = b""
    free_ns: int = 0
    sent_ns: int = 0
    syncs: int = 0
    waiting: bytes | None = None
    event: Timer | None = None
    deferred: Timer | None = None
    late: bool = False


class ProcessData:
    """All PDOs of a session.

    Parameters
    ----------
    operational : callable
        Whether the NMT state lets PDOs pass.
    send : callable
        Transmits (COB-ID, data).
    fault : callable
        Reports an emergency code.
    lateness : iterator of float
        How late each PDO is sent (s).
    missed, regained : callable
        Called when a receive PDO that is expected stays away; when it comes again.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        schedule: Schedule,
        operational: Callable[[], bool],
        send: Callable[[int, bytes], None],
        fault: Callable[[int], None],
        lateness: Iterator[float],
        missed: Callable[[], None],
        regained: Callable[[], None],
    ) -> None:
        self._dictionary = dictionary
        self._schedule = schedule
        self._operational = operational
        self._send = send
        self._fault = fault
        self._lateness = lateness
        self._missed, self._regained = missed, regained
        self.receive_ids: dict[int, _Pdo] = {}
        self._rpdos = [_Pdo(f"rpdo{number + 1}") for number in range(COUNT)]
        self._tpdos = [_Pdo(f"tpdo{number + 1}") for number in range(COUNT)]
        for pdo in (*self._rpdos, *self._tpdos):
            self._hook(pdo)
        self.configure()

    # ---- configuration -------------------------------------------------------------------------

    def _number(self, pdo: _Pdo, key: str) -> int:
        return self._dictionary[f"{pdo.name}.{key}"].integer()

    def _hook(self, pdo: _Pdo) -> None:
        entries = self._dictionary.by_key
        entries[f"{pdo.name}.cob_id"].sink = partial(self._take_cob_id, pdo)
        entries[f"{pdo.name}.count"].sink = partial(self._take_count, pdo)
        for number in range(MAX_OBJECTS):
            entries[f"{pdo.name}.object_{number + 1}"].sink = partial(self._take_object, pdo, number)
        if f"{pdo.name}.inhibit" in entries:
            entries[f"{pdo.name}.inhibit"].sink = partial(self._take_inhibit, pdo)
        for key in ("type", "event_ms"):
            if f"{pdo.name}.{key}" in entries:
                entries[f"{pdo.name}.{key}"].sink = partial(self._take_plain, f"{pdo.name}.{key}")

    def _take_plain(self, key: str, data: bytes) -> None:
        if key.endswith("type") and 241 <= data[0] <= 253:
            raise Refused(AbortCode.VALUE)  # reserved, or on remote request only
        self._dictionary[key].value = data
        self.configure()

    def _take_inhibit(self, pdo: _Pdo, data: bytes) -> None:
        self._dictionary[f"{pdo.name}.inhibit"].value = data
        pdo.inhibit_ns = self._number(pdo, "inhibit") * _TICK_NS

    def _take_cob_id(self, pdo: _Pdo, data: bytes) -> None:
        entry = self._dictionary[f"{pdo.name}.cob_id"]
        old, new = entry.integer(), int.from_bytes(data, "little")
        if new & 0x1FFFF800 or (not (old | new) & _OFF and (old ^ new) & 0x7FF):
            raise Refused(AbortCode.VALUE)  # 29-bit identifiers; or a valid PDO's identifier changed
        entry.value = data
        self.configure()

    def _take_object(self, pdo: _Pdo, number: int, data: bytes) -> None:
        if self._number(pdo, "count"):
            raise Refused(AbortCode.ACCESS)
        word = int.from_bytes(data, "little")
        if word:
            self._mapped(pdo, word)
        self._dictionary[f"{pdo.name}.object_{number + 1}"].value = data

    def _take_count(self, pdo: _Pdo, data: bytes) -> None:
        if self._is_on(pdo):
            raise Refused(AbortCode.ACCESS)
        self._collect(pdo, data[0])
        self._dictionary[f"{pdo.name}.count"].value = data
        self.configure()

    def _mapped(self, pdo: _Pdo, word: int) -> tuple[Entry, int]:
        if pdo.name.startswith("rpdo") and word == DUMMY_BYTE:
            return Entry(DUMMY_ROW), 1
        entry = self._dictionary.find(word >> 16, word >> 8 & 0xFF)
        row = entry.row
        direction = "R" if pdo.name.startswith("rpdo") else "T"
        # What can be received is mappable for sending too (its value is read back), not the other way round.
        if row.pdo != direction and not (direction == "T" and row.pdo == "R"):
            raise Refused(AbortCode.NOT_MAPPABLE)
        size = entry.size or (word & 0xFF) // 8  # a maker's object of any length, such as an interpreter's answer
        if word & 0xFF != 8 * size:
            raise Refused(AbortCode.PDO_LENGTH)
        return entry, size

    def _collect(self, pdo: _Pdo, count: int) -> list[tuple[Entry, int]]:
        if count > MAX_OBJECTS:
            raise Refused(AbortCode.PDO_LENGTH)
        words = [self._number(pdo, f"object_{number + 1}") for number in range(count)]
        entries = [self._mapped(pdo, word) for word in words]
        if sum(size for _, size in entries) > 8:
            raise Refused(AbortCode.PDO_LENGTH)
        return entries

    def _mapping(self, pdo: _Pdo) -> list[tuple[Entry, int]]:
        """Return what a PDO carries; nothing when it maps an object this firmware does not have."""
        try:
            return self._collect(pdo, self._number(pdo, "count"))
        except Refused:
            return []

    def configure(self) -> None:
        """Take over what the communication and mapping objects say."""
        self.receive_ids.clear()
        for pdo in (*self._rpdos, *self._tpdos):
            pdo.entries, pdo.kind = self._mapping(pdo), self._number(pdo, "type")
            pdo.can_id = self._number(pdo, "cob_id") & 0x7FF
            pdo.is_valid = bool(pdo.entries) and self._is_on(pdo)
        self.receive_ids.update((pdo.can_id, pdo) for pdo in self._rpdos if self._is_on(pdo))
        for pdo in self._tpdos:
            pdo.inhibit_ns = self._number(pdo, "inhibit") * _TICK_NS
            pdo.event_ns = self._number(pdo, "event_ms") * _MS_NS
            pdo.last = b""
            self._plan_event(pdo)

    def _is_on(self, pdo: _Pdo) -> bool:
        return not self._number(pdo, "cob_id") & _OFF

    # ---- received ------------------------------------------------------------------------------

    def receive(self, can_id: int, data: bytes) -> bool:
        """Take a received PDO; returns whether the identifier is one of ours."""
        pdo = self.receive_ids.get(can_id)
        if pdo is None or not self._operational():
            return pdo is not None
        self._expect_next(pdo)
        length = sum(size for _, size in pdo.entries)
        if len(data) < length:
            self._fault(TOO_SHORT)
        elif pdo.kind in _SYNC_TYPES or pdo.kind == 0:
            pdo.waiting = data
        else:
            self._take(pdo, data)
        return True

    def _expect_next(self, pdo: _Pdo) -> None:
        """Watch for the next one from now on (CiA 301, 7.5.2.35: event timer of a receive PDO)."""
        if pdo.late:
            pdo.late = False
            self._regained()
        if pdo.event is not None:
            pdo.event.cancel()
        within_ns = self._expected_ns(pdo)
        pdo.event = self._schedule.at(self._schedule.now_ns + within_ns, lambda: self._miss(pdo)) if within_ns else None

    def _expected_ns(self, pdo: _Pdo) -> int:
        try:
            timer = self._dictionary.find(0x1400 + self._rpdos.index(pdo), EVENT_TIMER)
        except Refused:
            return 0
        return timer.integer() * _MS_NS

    def _miss(self, pdo: _Pdo) -> None:
        pdo.event = None
        if self._operational() and self._expected_ns(pdo):
            pdo.late = True
            self._missed()

    def _take(self, pdo: _Pdo, data: bytes) -> None:
        position = 0
        for entry, size in pdo.entries:
            piece = data[position : position + size]
            position += size
            try:
                self._dictionary.write(entry, piece)
            except Refused:
                continue  # a PDO is not answered; the value in force stays

    # ---- transmitted ---------------------------------------------------------------------------

    def _content(self, pdo: _Pdo) -> bytes:
        return b"".join(entry.read()[:size].ljust(size, b"\0") for entry, size in pdo.entries)

    def start(self) -> None:
        """The node has become operational: every event-driven PDO is sent once."""
        for pdo in self._tpdos:
            pdo.last = b""
            self._plan_event(pdo)
        self.changed()

    def changed(self) -> None:
        """Send the event-driven PDOs whose content has changed."""
        if not self._operational():
            return
        for pdo in self._tpdos:
            if pdo.is_valid and pdo.kind in _EVENT_TYPES:
                content = self._content(pdo)
                if content != pdo.last:
                    self._emit(pdo, content)

    def _emit(self, pdo: _Pdo, content: bytes) -> None:
        now = self._schedule.now_ns
        if now < pdo.free_ns:
            if pdo.deferred is None:
                pdo.deferred = self._schedule.at(pdo.free_ns, lambda: self._emit_deferred(pdo))
            return
        pdo.last = content
        pdo.free_ns = now + pdo.inhibit_ns
        self._transmit(pdo, content)

    def _transmit(self, pdo: _Pdo, content: bytes) -> None:
        """Send, as late as the node is this time, in the order of the samples."""
        can_id, late_s = pdo.can_id, next(self._lateness)
        if late_s == 0.0:
            self._send(can_id, content)
            return
        pdo.sent_ns = max(self._schedule.now_ns + round(late_s * 1e9), pdo.sent_ns)
        self._schedule.at(pdo.sent_ns, lambda: self._send(can_id, content))

    def _emit_deferred(self, pdo: _Pdo) -> None:
        pdo.deferred = None
        if self._operational() and pdo.is_valid:
            self._emit(pdo, self._content(pdo))

    def _plan_event(self, pdo: _Pdo) -> None:
        if pdo.event is not None:
            pdo.event.cancel()
            pdo.event = None
        if pdo.event_ns and pdo.is_valid and pdo.kind in _EVENT_TYPES and self._operational():
            pdo.event = self._schedule.at(self._schedule.now_ns + pdo.event_ns, lambda: self._on_event(pdo))

    def _on_event(self, pdo: _Pdo) -> None:
        pdo.event = None
        if self._operational() and pdo.is_valid:
            self._emit(pdo, self._content(pdo))
        self._plan_event(pdo)

    def sync(self) -> None:
        """A SYNC has arrived."""
        if not self._operational():
            return
        for pdo in self._rpdos:
            if pdo.waiting is not None:
                data, pdo.waiting = pdo.waiting, None
                self._take(pdo, data)
        for pdo in self._tpdos:
            if pdo.is_valid:
                self._sync_one(pdo)

    def _sync_one(self, pdo: _Pdo) -> None:
        if pdo.kind == 0:
            content = self._content(pdo)
            if content != pdo.last:
                self._emit(pdo, content)
        elif pdo.kind in _SYNC_TYPES:
            pdo.syncs += 1
            if pdo.syncs >= pdo.kind:
                pdo.syncs = 0
                self._emit(pdo, self._content(pdo))
