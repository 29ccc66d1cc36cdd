# SPDX-License-Identifier: MIT
"""Reads a concise DCF back, for the tests of what writes it."""

from __future__ import annotations

import struct

from pmsmtool.drive_maps.dcf import Entry
from pmsmtool.errors import ConfigError


def read_concise(data: bytes, where: str = "concise DCF") -> list[Entry]:
    """Return the entries of a concise DCF.

    Raises
    ------
    ConfigError
        If it ends early, or carries more than it announces.
    """
    entries: list[Entry] = []
    try:
        (count,) = struct.unpack_from("<I", data)
        offset = 4
        for _ in range(count):
            index, sub, size = struct.unpack_from("<HBI", data, offset)
            offset += 7
            if offset + size > len(data):
                raise struct.error
            entries.append(Entry(index, sub, data[offset : offset + size]))
            offset += size
    except struct.error:
        raise ConfigError(f"ends in entry {len(entries) + 1}", where=where, likely="the file is cut") from None
    if offset != len(data):
        raise ConfigError(f"{len(data) - offset} bytes after the announced {count} entries", where=where)
    return entries
