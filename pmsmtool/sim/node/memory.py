# SPDX-License-Identifier: MIT
"""Non-volatile memory of the simulated drive: two slots, written page by page, never torn.

A store goes into the slot that does not hold the newest valid content: its header is erased, the pages are written,
and the header with sequence number, length and CRC-32 comes last. Power may fail after any step; what is read
afterwards is exactly the old or exactly the new content. Reads and writes go through a file (its name is part of the
channel string) or through memory that lives as long as the simulated bus.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

from pmsmtool.errors import ConfigError

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
