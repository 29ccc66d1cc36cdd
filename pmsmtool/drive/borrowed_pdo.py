# SPDX-License-Identifier: MIT
"""A process data object that is borrowed: read, proven to be writable with its own content, changed, and brought back.

The order is that of CiA 301, 7.5.2.36 and 7.5.2.38: off, no entries, the entries, their number, on. What a mapping
names may be an object that the drive does not let be mapped again, or does not have. So every PDO is first written with
what it holds: a drive that refuses that is known before anything of it has changed.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.errors import NotAvailable, SdoAbort, VerifyMismatch

MOST_ENTRIES = 64
"""Entries of a mapping (CiA 301, 7.5.2.36); larger numbers mean a multiplexed PDO."""
_FIRST_OBJECT = 0x1000
"""Below are the data types, which a mapping may name as dummies (CiA 301, 7.5.2.36)."""
_FIRST_TRANSMITTED = 0x1800
_OFF = 1 << 31
_KIND, _INHIBIT, _EVENT_TIMER = 2, 3, 5
"""Sub-indices of the communication record; a received PDO has no inhibit time."""
_NOT_THERE = (AbortCode.NO_OBJECT, AbortCode.NO_SUBINDEX)


@dataclass(frozen=True, slots=True)
class BorrowedPdo:
    """What a PDO was.

    Attributes
    ----------
    communication, mapping : int
        Its two records.
    cob_id : int
        With the bits above the identifier.
    count : int
        Entries in force.
    entries : tuple of int
        What is overwritten: those in force, and as many as are needed.
    rest : dict of int to bytes
        Kind, inhibit time unless it is 0, and event timer by sub-index; a drive may lack the times.
    """

    communication: int
    mapping: int
    cob_id: int
    count: int
    entries: tuple[int, ...]
    rest: dict[int, bytes]

    @property
    def has_event_timer(self) -> bool:
        """Whether its period or the time within which it is expected can be chosen."""
        return _EVENT_TIMER in self.rest

    @classmethod
    def read(cls, node: DriveNode, communication: int, mapping: int, entries: int) -> BorrowedPdo:
        """Read a PDO of which so many entries will be overwritten; writes nothing.

        Raises
        ------
        SdoAbort
            The drive has no such PDO, or fewer entries.
        NotAvailable
            It could not be brought back: it is multiplexed, or one of its entries names nothing that the drive has.
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

        Raises
        ------
        VerifyMismatch
            An object does not hold its old content; each is named.
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
