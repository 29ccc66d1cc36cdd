# SPDX-License-Identifier: MIT
"""Live quantities as process data: the drive sends them by itself (TPDOs, CiA 301, section 7.5.2.35 on).

The transmit PDOs 2 to 4 are borrowed: what they were is noted first and brought back at the end, with
the NMT state. One that could not be brought back is passed over. TPDO 1 is left to whoever watches the statusword.

The order of a change is that of CiA 301, 7.5.2.36 and 7.5.2.38: off, no entries, the entries, their number, on. What a
mapping names may be an object that the drive does not let be mapped again, or does not have. So every PDO is first
written with what it holds: a drive that refuses that is known before anything of it has changed.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.nmt import NmtCommand, NmtState, send_nmt
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.objects import LIVE, DriveObject
from pmsmtool.drive.stop import interrupts_deferred
from pmsmtool.errors import BusError, NotAvailable, SdoAbort, VerifyMismatch

BORROWED = (2, 3, 4)
"""Numbers of the transmit PDOs in use."""
PDO_BYTES = 8
EVENT_DRIVEN = 255
_NO_RTR = 1 << 30
_NMT_WAIT_S = 0.05

MOST_ENTRIES = 64
"""Entries of a mapping (CiA 301, 7.5.2.36); larger numbers mean a multiplexed PDO."""
_FIRST_OBJECT = 0x1000
"""Below are the data types, which a mapping may name as dummies (CiA 301, 7.5.2.36)."""
_FIRST_TRANSMITTED = 0x1800
_OFF = 1 << 31
_KIND, _INHIBIT, _EVENT_TIMER = 2, 3, 5
"""Sub-indices of the communication record; a received PDO has no inhibit time."""
_NOT_THERE = (AbortCode.NO_OBJECT, AbortCode.NO_SUBINDEX)


class LiveValues:
    """Latest values, as they arrive.

    Attributes
    ----------
    values : dict of str to float
        By name; a name is there from its first PDO on.
    received : int
        PDOs received.
    on_set : callable
        Called with the bus's time stamp when every PDO has come once more; may only take notes.
    """

    def __init__(self, objects: Mapping[str, DriveObject] = LIVE) -> None:
        self._objects = objects
        self.values: dict[str, float] = {}
        self.received = 0
        self.on_set: Callable[[float], None] = lambda stamp_s: None
        self._fresh: set[int] = set()
        self._layout: dict[int, list[tuple[str, struct.Struct]]] = {}

    def expect(self, cob_id: int, names: Sequence[str]) -> None:
        """Say what a COB-ID carries."""
        self._layout[cob_id] = [(name, struct.Struct("<" + self._objects[name].letter)) for name in names]

    def take(self, cob_id: int, data: bytes, timestamp: float) -> None:
        """Take the values of one PDO; a short one is left out."""
        position = 0
        for name, code in self._layout[cob_id]:
            if position + code.size > len(data):
                return
            self.values[name] = float(code.unpack_from(data, position)[0])
            position += code.size
        self.received += 1
        self._fresh.add(cob_id)
        if cob_id == max(self._layout):  # the drive sends the lowest identifier first
            if len(self._fresh) == len(self._layout):
                self.on_set(timestamp)
            self._fresh.clear()


@contextmanager
def live_values(
    node: DriveNode, names: Sequence[str], period_s: float, objects: Mapping[str, DriveObject] = LIVE
) -> Iterator[LiveValues]:
    """Have the drive send live quantities every ``period_s``, as long as the context lasts.

    Raises NotAvailable: more quantities than the borrowed PDOs hold, or a drive without them.

    Parameters
    ----------
    objects : mapping of str to DriveObject
        Where a drive shows what the names mean; default: the reference drive's.
    """
    objects = {name: node.typed(objects[name]) for name in names}
    groups = _groups(names, objects)
    live = LiveValues(objects)
    before: list[BorrowedPdo] = []
    cob_ids: list[int] = []
    state = node.supervision.nmt_state
    brought_back = False

    def bring_back() -> None:
        nonlocal brought_back
        if brought_back:
            return
        for cob_id in cob_ids:
            node.connection.unsubscribe(cob_id, live.take)
        if state is not NmtState.OPERATIONAL:
            send_nmt(node.connection, NmtCommand.PRE_OPERATIONAL, node.node)
        brought_back = True
        while before:
            before.pop().bring_back(node)

    lost: BusError | None = None
    node.before_close.append(bring_back)  # a signal between two bytecodes of a `with` statement calls no exit
    try:
        left = _usable(node, max(len(group) for group in groups), len(groups))
        for group in groups:
            cob_id = _lend(node, left, before, [objects[name] for name in group], period_s)
            live.expect(cob_id, group)
            cob_ids.append(cob_id)
            node.connection.subscribe(cob_id, live.take)
        send_nmt(node.connection, NmtCommand.START, node.node)
        node.connection.wait(_NMT_WAIT_S)
        yield live
    except SdoAbort as abort:
        raise NotAvailable(
            "the drive cannot send these as process data", where=abort.where, hint="leave --pdo out"
        ) from abort
    except BusError as error:
        lost = error
        raise
    finally:
        with interrupts_deferred() as noted:
            try:
                bring_back()
            except BusError:
                if lost is None:
                    raise  # else what was lost first says more
        if noted:
            raise KeyboardInterrupt


def _usable(node: DriveNode, entries: int, wanted: int) -> list[tuple[int, BorrowedPdo]]:
    """Return the PDOs that can be borrowed by what they hold, with their numbers; writes nothing.

    Raises NotAvailable: fewer than wanted; each other one is named with its reason.
    """
    found: list[tuple[int, BorrowedPdo]] = []
    reasons: list[str] = []
    for number in BORROWED:
        communication, mapping = 0x1800 + number - 1, 0x1A00 + number - 1
        try:
            pdo = BorrowedPdo.read(node, communication, mapping, entries)
        except (NotAvailable, SdoAbort) as reason:
            reasons.append(f"0x{mapping:04X}: {reason.what}")
            continue
        if pdo.has_event_timer:
            found.append((number, pdo))
        else:
            reasons.append(f"0x{communication:04X}: it has no event timer")
    if len(found) < wanted:
        raise NotAvailable(
            f"the drive cannot send these as process data: {'; '.join(reasons)}",
            where=f"node {node.node}", hint="leave --pdo out",
        )  # fmt: skip
    return found


def _lend(
    node: DriveNode, left: list[tuple[int, BorrowedPdo]], before: list[BorrowedPdo], items: Sequence[DriveObject],
    period_s: float,
) -> int:  # fmt: skip
    """Let the next PDO that can be brought back send the items; return its COB-ID."""
    while left:
        number, pdo = left.pop(0)
        cob_id = 0x80 + 0x100 * number + node.node
        before.append(pdo)
        try:
            pdo.switch_off(node)
        except SdoAbort:  # it still holds what it refused
            before.remove(pdo)
            pdo.bring_back(node)
            continue
        pdo.change(node, [item.mapping_word for item in items], EVENT_DRIVEN)
        node.sdo.download(pdo.communication, 5, round(1000.0 * sent_every_s(period_s)).to_bytes(2, "little"))
        node.sdo.download(pdo.communication, 1, (cob_id | _NO_RTR).to_bytes(4, "little"))
        return cob_id
    raise NotAvailable(
        "the drive cannot send these as process data: it refuses what its own PDOs hold",
        where=f"node {node.node}", hint="leave --pdo out",
    )  # fmt: skip


def sent_every_s(period_s: float) -> float:
    """Return the period (s) nearest to the one wanted that an event timer holds, in whole milliseconds."""
    return 1e-3 * min(max(1, round(1000.0 * period_s)), 0xFFFF)


def _groups(names: Sequence[str], objects: Mapping[str, DriveObject]) -> list[list[str]]:
    """Fill the PDOs in order."""
    groups: list[list[str]] = [[]]
    for name in names:
        if sum(objects[other].size for other in [*groups[-1], name]) > PDO_BYTES:
            groups.append([])
        groups[-1].append(name)
    if len(groups) > len(BORROWED):
        raise NotAvailable(
            f"{len(names)} quantities do not fit {len(BORROWED)} process data objects",
            hint="choose fewer with -g, or leave --pdo out",
        )
    return groups


@dataclass(frozen=True, slots=True)
class BorrowedPdo:
    """What a PDO was."""

    communication: int
    mapping: int
    """Its two records."""
    cob_id: int
    """With the bits above the identifier."""
    count: int
    """Entries in force."""
    entries: tuple[int, ...]
    """What is overwritten: those in force, and as many as are needed."""
    rest: dict[int, bytes]
    """Kind, inhibit time unless it is 0, and event timer by sub-index; a drive may lack the times."""

    @property
    def has_event_timer(self) -> bool:
        """Whether its period or the time within which it is expected can be chosen."""
        return _EVENT_TIMER in self.rest

    @classmethod
    def read(cls, node: DriveNode, communication: int, mapping: int, entries: int) -> BorrowedPdo:
        """Read a PDO of which so many entries will be overwritten; writes nothing.

        Raises SdoAbort: the drive has no such PDO, or fewer entries; NotAvailable: it could not be brought back: it is
        multiplexed, or one of its entries names nothing that the drive has.
        """
        read = node.sdo.read
        count = read(mapping, 0, size=1)[0]
        where = f"node {node.node}, 0x{mapping:04X}"
        if count > MOST_ENTRIES:
            raise NotAvailable("the PDO is a multiplexed one", where=where)
        words = [int.from_bytes(read(mapping, sub, size=4), "little") for sub in range(1, max(count, entries) + 1)]
        for sub, word in enumerate(words[:count], 1):
            if not _nameable(node, word):
                raise NotAvailable(
                    f"entry {sub} of the PDO names an object that the drive lacks ({word:#010x}): it might not be "
                    "restored",
                    where=f"{where}:{sub:02X}",
                )  # fmt: skip
        rest = {_KIND: read(communication, _KIND, size=1)}
        for sub in (_INHIBIT, _EVENT_TIMER) if communication >= _FIRST_TRANSMITTED else (_EVENT_TIMER,):
            with contextlib.suppress(SdoAbort):
                data = read(communication, sub, size=2)
                if sub == _EVENT_TIMER or any(data):
                    rest[sub] = data
        cob_id = int.from_bytes(read(communication, 1, size=4), "little")
        return cls(communication, mapping, cob_id, count, tuple(words), rest)

    def switch_off(self, node: DriveNode) -> None:
        """Switch it off, and prove that it can be brought back: its own content is written once.

        Raises
        ------
        SdoAbort
            The drive refuses one of its own values. It still holds it.
        """
        node.sdo.download(self.communication, 1, _word(self.cob_id | _OFF))
        for index, sub, data in self._content():
            node.sdo.download(index, sub, data)

    def change(self, node: DriveNode, words: Sequence[int], kind: int) -> None:
        """Give it other entries while it is off; its inhibit time is 0 from now on."""
        write = node.sdo.download
        write(self.mapping, 0, b"\0")
        for sub, word in enumerate(words, 1):
            write(self.mapping, sub, _word(word))
        write(self.mapping, 0, bytes((len(words),)))
        write(self.communication, _KIND, bytes((kind,)))
        if _INHIBIT in self.rest:
            write(self.communication, _INHIBIT, b"\0\0")

    def bring_back(self, node: DriveNode) -> None:
        """Write what it was, and read it back; a refusal of what the drive still holds is none.

        Raises VerifyMismatch: an object does not hold its old content; each is named.
        """
        off, on = ((self.communication, 1, _word(word)) for word in (self.cob_id | _OFF, self.cob_id))
        refused: dict[tuple[int, int], str] = {}
        for index, sub, data in (off, *self._content(), on):
            try:
                node.sdo.download(index, sub, data)
            except SdoAbort as abort:  # the others must get their content
                refused[index, sub] = abort.what
        held = {(index, sub): data for index, sub, data in (*self._content(), on)}
        lines = [
            f"0x{index:04X}:{sub:02X} does not hold {data.hex(' ')} again: {refused.get((index, sub), 'no refusal')}"
            for (index, sub), data in held.items()
            if node.sdo.read(index, sub) != data
        ]
        if lines:
            raise VerifyMismatch(
                "a PDO could not be restored", where=f"node {node.node}", differences=lines,
                hint="reset the drive: it comes back with what it has stored",
            )  # fmt: skip

    def _content(self) -> list[tuple[int, int, bytes]]:
        """Return everything but the identifier, in the order in which it can be written while the PDO is off."""
        return [
            (self.mapping, 0, b"\0"),
            *((self.mapping, sub, _word(word)) for sub, word in enumerate(self.entries, 1)),
            (self.mapping, 0, bytes((self.count,))),
            *((self.communication, sub, data) for sub, data in self.rest.items()),
        ]


def _word(value: int) -> bytes:
    return value.to_bytes(4, "little")


def _nameable(node: DriveNode, word: int) -> bool:
    """Whether the drive has what an entry names; one that cannot be read is there all the same."""
    if 0 < word >> 16 < _FIRST_OBJECT:
        return True
    try:
        node.sdo.read(word >> 16, word >> 8 & 0xFF)
    except SdoAbort as abort:
        return abort.code not in _NOT_THERE
    return True
