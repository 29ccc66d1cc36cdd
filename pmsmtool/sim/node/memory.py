# SPDX-License-Identifier: MIT
"""Non-volatile memory of the simulated drive, two slots that are never torn, and its objects 0x1010 and 0x1011.

A store goes into the slot that does not hold the newest valid content: its header is erased, the pages are written,
and the header with sequence number, length and CRC-32 comes last. Power may fail after any step; what is read
afterwards is exactly the old or exactly the new content. Reads and writes go through a file (its name is part of the
channel string) or through memory that lives as long as the simulated bus.
What is stored is a list of (object, bytes): communication, application (CiA 402) and parameter set can be stored and
restored apart, as CiA 301 groups them. A store takes its time on the node's clock, one memory write per step.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Protocol

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.clock import Schedule
from pmsmtool.errors import ConfigError
from pmsmtool.sim.node.dictionary import Dictionary, Refused

PAGE_BYTES = 1024
SLOT_BYTES = 96 * PAGE_BYTES
"""Header page and content of one slot; the fullest drive (32 KiB of tables) needs half of it."""
_HEADER = struct.Struct("<8sIII")
_MAGIC = b"pmsmNV1\0"
_SLOTS = 2


class Storage(Protocol):
    """Bytes that survive a reset."""

    def read(self, offset: int, length: int) -> bytes:
        """Return at most ``length`` bytes; fewer where nothing was ever written."""

    def write(self, offset: int, data: bytes, *, durable: bool) -> None:
        """Write; with ``durable`` everything written so far has reached the medium on return."""


class RamStorage:
    """Storage that ends with the process."""

    def __init__(self) -> None:
        self._bytes = bytearray()

    def read(self, offset: int, length: int) -> bytes:
        """Return a copy of the bytes."""
        return bytes(self._bytes[offset : offset + length])

    def write(self, offset: int, data: bytes, *, durable: bool) -> None:
        """Write in place."""
        missing = offset + len(data) - len(self._bytes)
        if missing > 0:
            self._bytes += bytes(missing)
        self._bytes[offset : offset + len(data)] = data


class FileStorage:
    """Storage in a file, created with the first write.

    Raises
    ------
    ConfigError
        The path cannot be read or written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def _unusable(self, error: OSError) -> ConfigError:
        return ConfigError(
            f"the drive's memory cannot be used: {error.strerror or error}",
            where=str(self.path),
            likely="the directory is read-only or does not exist",
            hint="choose a file with nv=FILE, or nv=:memory: for a drive that forgets",
        )

    def read(self, offset: int, length: int) -> bytes:
        """Return bytes of the file; nothing when there is no file yet."""
        try:
            with self.path.open("rb") as file:
                file.seek(offset)
                return file.read(length)
        except FileNotFoundError:
            return b""
        except OSError as error:
            raise self._unusable(error) from error

    def write(self, offset: int, data: bytes, *, durable: bool) -> None:
        """Write in place, creating file and folder when needed."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o644)
            try:
                os.lseek(descriptor, offset, os.SEEK_SET)
                view = memoryview(data)
                while view:
                    view = view[os.write(descriptor, view) :]
                if durable:
                    os.fsync(descriptor)
            finally:
                os.close(descriptor)
        except OSError as error:
            raise self._unusable(error) from error


class Memory:
    """Two-slot memory over a storage."""

    def __init__(self, storage: Storage) -> None:
        self._storage = storage

    def load(self) -> bytes | None:
        """Return the newest valid content, None when nothing valid was ever stored."""
        newest = self._newest()
        return None if newest is None else newest[2]

    def is_damaged(self) -> bool:
        """Whether something was written but nothing valid is left."""
        return self._newest() is None and any(self._storage.read(slot * SLOT_BYTES, 1) for slot in range(_SLOTS))

    def _slot(self, slot: int) -> tuple[int, bytes] | None:
        header = self._storage.read(slot * SLOT_BYTES, _HEADER.size)
        if len(header) < _HEADER.size:
            return None
        magic, sequence, length, crc = _HEADER.unpack(header)
        if magic != _MAGIC or length > SLOT_BYTES - PAGE_BYTES:
            return None
        content = self._storage.read(slot * SLOT_BYTES + PAGE_BYTES, length)
        if len(content) != length or zlib.crc32(content, sequence) != crc:
            return None
        return sequence, content

    def _newest(self) -> tuple[int, int, bytes] | None:
        """Return slot, sequence number and content of the newest valid slot."""
        found = [(slot, *held) for slot in range(_SLOTS) if (held := self._slot(slot)) is not None]
        if not found:
            return None
        return max(found, key=lambda held: held[1])

    def store(self, content: bytes) -> Iterator[None]:
        """Store content step by step: every ``next`` performs one write, the iterator's end means stored.

        Raises ValueError: the content does not fit a slot.
        """
        if len(content) > SLOT_BYTES - PAGE_BYTES:
            raise ValueError(f"{len(content)} bytes do not fit the memory")
        newest = self._newest()
        slot, sequence = (0, 1) if newest is None else ((newest[0] + 1) % _SLOTS, newest[1] + 1)
        base = slot * SLOT_BYTES
        return self._steps(base, sequence, content)

    def _steps(self, base: int, sequence: int, content: bytes) -> Iterator[None]:
        self._storage.write(base, bytes(_HEADER.size), durable=True)
        yield
        pages = range(0, len(content), PAGE_BYTES)
        for offset in pages:
            last = offset + PAGE_BYTES >= len(content)
            self._storage.write(base + PAGE_BYTES + offset, content[offset : offset + PAGE_BYTES], durable=last)
            yield
        crc = zlib.crc32(content, sequence)
        self._storage.write(base, _HEADER.pack(_MAGIC, sequence, len(content), crc), durable=True)
        yield


Stored = dict[int, bytes]
"""Bytes by object (index << 8 | sub)."""

IMAGE_KEY, SIGNATURE_KEY = 0x2001 << 8 | 0xFF, 0x2000 << 8 | 0xFF
"""The set and its signature: sub-index 0xFF is nobody's value (CiA 301), another maker's 0x2001 stays its own."""
NODE_ID_KEY = 0
"""Pseudo-object of the node id that LSS stored."""

ERASE_S = 0.3
PAGE_S = 0.005
"""A store takes ERASE_S and PAGE_S per KiB: longer than a usual SDO time-out of 0.3 s."""
_RECORD = struct.Struct("<II")


class Group(Enum):
    """Groups of 0x1010 and 0x1011: key of the object, range of indices."""

    COMMUNICATION = ("communication", range(0x1000, 0x2000))
    APPLICATION = ("application", range(0x6000, 0xA000))
    PARAMETER_SET = ("parameter_set", range(0x2000, 0x6000))

    @property
    def indices(self) -> range:
        """Indices of the group."""
        found: range = self.value[1]
        return found


_ALL = tuple(Group)


def encode(stored: Mapping[int, bytes]) -> bytes:
    """Return the memory content of stored values."""
    return b"".join(_RECORD.pack(key, len(data)) + data for key, data in sorted(stored.items()))


def decode(content: bytes) -> Stored:
    """Return the stored values of a memory content; the inverse of :func:`encode`."""
    stored: Stored = {}
    position = 0
    while position < len(content):
        key, length = _RECORD.unpack_from(content, position)
        position += _RECORD.size
        stored[key] = content[position : position + length]
        position += length
    return stored


def without(stored: Mapping[int, bytes], groups: Collection[Group]) -> Stored:
    """Return stored values without those of some groups."""
    return {key: data for key, data in stored.items() if not any(key >> 8 in group.indices for group in groups)}


class Store:
    """Objects 0x1010 and 0x1011 of one session.

    Parameters
    ----------
    current : callable
        Returns the values of a group as they are now.
    energised : callable
        Whether the power stage may drive current: then nothing is stored.
    finish : callable
        Confirms the pending write, or refuses it with an abort code.
    scale : callable
        Fault injection: returns the factor on the time a store takes.
    step_done : callable
        Fault injection: called after every write step.

    Attributes
    ----------
    stored : dict
        What the memory holds.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        schedule: Schedule,
        memory: Memory,
        *,
        current: Callable[[Group], Stored],
        energised: Callable[[], bool],
        finish: Callable[[int | None], None],
        scale: Callable[[], float] = lambda: 1.0,
        step_done: Callable[[], None] = lambda: None,
    ) -> None:
        content = memory.load()
        self.stored: Stored = {} if content is None else decode(content)
        self._schedule = schedule
        self._memory = memory
        self._current = current
        self._energised = energised
        self._finish = finish
        self._scale = scale
        self._step_done = step_done
        self._busy = False
        for groups, key in ((_ALL, "all"), *(((group,), group.value[0]) for group in Group)):
            dictionary[f"store.{key}"].sink = partial(self._take, b"save", groups)
            dictionary[f"restore.{key}"].sink = partial(self._take, b"load", groups)

    def _take(self, signature: bytes, groups: tuple[Group, ...], data: bytes) -> bool:
        if data != signature:
            raise Refused(AbortCode.NOT_STORED)
        if self._energised() or self._busy:
            raise Refused(AbortCode.DEVICE_STATE)
        content = without(self.stored, groups)
        if signature == b"save":
            for group in groups:
                content |= self._current(group)
        self.write(content, self._finish)
        return True

    @property
    def busy(self) -> bool:
        """Whether a store is under way."""
        return self._busy

    def write(self, content: Stored, done: Callable[[int | None], None]) -> None:
        """Store values step by step, then call ``done`` with None, or with the abort code of what went wrong."""
        self._busy = True
        packed = encode(content)
        steps = self._memory.store(packed)

        def complete(code: int | None) -> None:
            self._busy = False
            if code is None:
                self.stored = content
            done(code)

        self._next_step(steps, ERASE_S, complete)

    def _next_step(self, steps: Iterator[None], seconds: float, complete: Callable[[int | None], None]) -> None:
        def step() -> None:
            try:
                next(steps)
            except StopIteration:
                complete(None)
                return
            except ConfigError:  # the file cannot be written; on a drive: the memory is broken
                complete(AbortCode.HARDWARE)
                return
            self._step_done()
            self._next_step(steps, PAGE_S, complete)

        self._schedule.after(seconds * self._scale(), step)
