# SPDX-License-Identifier: MIT
"""The object dictionary at run time: typed entries with range checks, and hooks of the application behind them.

:class:`Face` is what a simulated drive needs of a dictionary that it shows instead of its own.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator
from functools import cache
from typing import TYPE_CHECKING, Protocol

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.errors import ConfigError
from pmsmtool.sim.node.objects import ObjectRow, object_rows

if TYPE_CHECKING:
    from pmsmtool.bus.clock import Schedule
    from pmsmtool.sim.node.power_drive import Plant, PowerDrive
    from pmsmtool.sim.node.session import Session

Sink = Callable[[bytes], bool | None]
"""Takes the bytes of a write; returns True when the write is confirmed later (slow store)."""
Source = Callable[[], bytes]


class Refused(Exception):
    """An access the node refuses, with the SDO abort code it answers."""

    def __init__(self, code: int) -> None:
        super().__init__(f"0x{code:08X}")
        self.code = code


class Entry:
    """One sub-object of the running node.

    Attributes
    ----------
    value : bytes
        Stored value, little endian, when no ``source`` computes it.
    source, sink : callables or None
        The application's hooks for reading and writing.
    """

    def __init__(self, row: ObjectRow, node: int = 0) -> None:
        self.row = row
        kind = row.data_type
        self.size = kind.size
        self.code = struct.Struct("<" + kind.letter) if kind.letter else None
        self._is_float = kind.is_float
        bits = 8 * self.size
        self._range = (-(1 << bits - 1), (1 << bits - 1) - 1) if kind.is_signed else (0, (1 << bits) - 1)
        self.low, self.high = (_held_as(self.code, bound) if kind.is_float else bound for bound in (row.low, row.high))
        self.nan_allowed = row.default == "nan"
        self.readable = row.access != "wo"
        self.writable = row.access in ("rw", "wo")
        self.source: Source | None = None
        self.sink: Sink | None = None
        self.value = row.default_bytes(node)

    def twin(self, node: int) -> Entry:
        """Return an entry as this one began, of a node: what only depends on the row is not worked out again."""
        twin = object.__new__(Entry)
        twin.__dict__ = self.__dict__.copy()
        if "$NODEID" in self.row.default:
            twin.value = self.row.default_bytes(node)
        return twin

    def read(self) -> bytes:
        """Return the bytes of the value."""
        return self.value if self.source is None else self.source()

    def shows(self, value: Callable[[], float]) -> None:
        """Let a number of the application be read."""
        self.source = lambda: self.encode(value())

    def number(self) -> float:
        """Return the value as a number."""
        if self.code is None:
            raise TypeError(f"{self.row.key} is not a number")
        return self.decode(self.read())

    def decode(self, data: bytes) -> float:
        """Return the number that bytes of this type are; 0 where it has no number."""
        return 0.0 if self.code is None else self.code.unpack(data)[0]

    def integer(self) -> int:
        """Return the value of an integer type."""
        return int(self.number())

    def encode(self, number: float) -> bytes:
        """Return a number as bytes of this type, cut to the range of the type."""
        code = self.code
        if code is None:
            raise TypeError(f"{self.row.key} is not a number")
        if self._is_float:
            return code.pack(number)
        lowest, highest = self._range
        return code.pack(min(max(round(number), lowest), highest))

    def put(self, number: float) -> None:
        """Set the stored value."""
        self.value = self.encode(number)

    def check(self, data: bytes) -> None:
        """Refuse bytes of a wrong length or outside the bounds.

        Raises Refused: 0x06070012/13 for the length, 0x06090030/31/32 for the value.
        """
        size = self.size
        if size and len(data) != size:
            raise Refused(AbortCode.TOO_LONG if len(data) > size else AbortCode.TOO_SHORT)
        code = self.code
        if code is None:
            return
        value = code.unpack(data)[0]
        if self._is_float and not math.isfinite(value):
            if not (self.nan_allowed and math.isnan(value)):
                raise Refused(AbortCode.VALUE)
            return
        if self.high is not None and value > self.high:
            raise Refused(AbortCode.VALUE_HIGH)
        if self.low is not None and value < self.low:
            raise Refused(AbortCode.VALUE_LOW)


def _held_as(code: struct.Struct | None, bound: float | None) -> float | None:
    """Return a bound as its type holds it; None where it lies beyond every number of the type, and says nothing."""
    try:
        return None if bound is None or code is None else float(code.unpack(code.pack(bound))[0])
    except OverflowError:
        return None


@cache
def _entries_of_rows() -> dict[int, Entry]:
    return {row.index << 8 | row.sub: Entry(row) for row in object_rows()}


class Dictionary:
    """All entries of one node, by object and by key.

    Attributes
    ----------
    on_change : callable
        Called with the entry after a value that can be stored was changed from outside.
    node : int
        Node id that identifiers follow.
    """

    def __init__(self, node: int) -> None:
        self.node = node
        self._entries = {key: entry.twin(node) for key, entry in _entries_of_rows().items()}
        self._indices = {key >> 8 for key in self._entries}
        self.by_key = {entry.row.key: entry for entry in self._entries.values() if entry.row.key}
        self.on_change: Callable[[Entry], None] = lambda entry: None
        self._hidden: set[int] = set()

    def __iter__(self) -> Iterator[Entry]:
        return iter(self._entries.values())

    def __getitem__(self, key: str) -> Entry:
        return self.by_key[key]

    def find(self, index: int, sub: int) -> Entry:
        """Return an entry. Raises Refused: 0x06020000 or 0x06090011."""
        entry = self._entries.get(index << 8 | sub)
        if entry is None:
            raise Refused(AbortCode.NO_SUBINDEX if index in self._indices else AbortCode.NO_OBJECT)
        return entry

    def hide(self, index: int, sub: int | None = None) -> None:
        """Fault injection: answer as if there were no such object; the application still finds it by key.

        Raises ConfigError: there is no such object.
        """
        own = range(index << 8, index + 1 << 8)
        hidden = [key for key in (own if sub is None else own[sub : sub + 1]) if key in self._entries]
        if not hidden and index not in self._hidden:
            raise ConfigError(
                f"the drive has no object 0x{index:04X}" + ("" if sub is None else f":{sub:02X}"),
                where="[[absent]]",
                hint="give an object that `pmsmtool export dcf` lists",
            )
        for key in hidden:
            del self._entries[key]
        self._hidden.add(index)
        if not any(key in self._entries for key in own):
            self._indices.discard(index)

    def show(self, entry: Entry) -> None:
        """Answer with this entry at its object from now on; the application still finds its own by key."""
        self._entries[entry.row.index << 8 | entry.row.sub] = entry
        self._indices.add(entry.row.index)

    def readable(self, index: int, sub: int) -> Entry:
        """Return an entry that can be read, else refuse."""
        entry = self.find(index, sub)
        if not entry.readable:
            raise Refused(AbortCode.WRITE_ONLY)
        return entry

    def writable(self, index: int, sub: int) -> Entry:
        """Return an entry that can be written, else refuse."""
        entry = self.find(index, sub)
        if not entry.writable:
            raise Refused(AbortCode.READ_ONLY)
        return entry

    def write(self, entry: Entry, data: bytes) -> bool:
        """Write an entry; returns True when the application confirms it later.

        Raises Refused: wrong length, out of range, or the application's own reason.
        """
        entry.check(data)
        if entry.sink is not None:
            before = entry.value
            pending = bool(entry.sink(data))
            changed = before != entry.value
        else:
            changed = entry.value != data
            entry.value = bytes(data)
            pending = False
        if changed and entry.row.stored:
            self.on_change(entry)
        return pending


class Guarding(Protocol):
    """Node guarding (objects 0x100C, 0x100D)."""

    def asked(self) -> None:
        """Take a remote frame."""


class DriveFace(Protocol):
    """Another dictionary over the same application."""

    @property
    def vendor_product(self) -> tuple[int, int]:
        """Vendor and product that 0x1018 shows."""

    @property
    def label(self) -> str:
        """Beginning of the device name."""

    def dress(self, dictionary: Dictionary) -> None:
        """Change a dictionary whose application is not hooked up yet."""

    def attach(self, dictionary: Dictionary, plant: Plant, power: PowerDrive, schedule: Schedule) -> None:
        """Put own functions over the running application."""

    def guarding(self, session: Session) -> Guarding | None:
        """Return node guarding where the drive has it."""
