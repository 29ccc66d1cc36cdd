# SPDX-License-Identifier: MIT
"""Numeric arrays of MATLAB files, level 5 (what ``save`` writes unless told ``-v7.3`` or ``-v4``).

Read here, because the common reader ends the whole process with a segmentation fault on some damaged files
(scipy 1.16, found by ``benchmarks/fuzz.py``). Format: MathWorks, "MAT-File Format", level 5.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pmsmtool.errors import ConfigError, next_step
from pmsmtool.files import read_bytes, too_large

NEXT_STEP = "save it as -v7 or older, or give the map as .csv or .npz"

Content = dict[str, Any]
"""Name -> array, or the content of a structure."""

_HEADER_BYTES = 128
_DEEPEST = 8
"""Structures inside structures."""
_MOST_ELEMENTS = 10_000
"""Beside each other; a structure has four and one for each of its fields."""
_MATRIX, _COMPRESSED = 14, 15
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
"""Data types of an element -> numpy's letter."""
_STRUCT_CLASS = 2
_NUMERIC_CLASSES = range(6, 16)
_COMPLEX_FLAG = 0x0800
_LARGEST_BYTES = 16 << 20
"""Of the file, and of all it unpacks to; a flux map has some 100 kB."""


class _Damaged(Exception):
    """The bytes are not those of a MATLAB file."""


@dataclass(frozen=True, slots=True)
class _Element:
    kind: int
    data: bytes


@next_step(NEXT_STEP)
def read_mat(path: Path) -> Content:
    """Return the numeric arrays and the structures of them; texts, cells and objects are left out.

    Raises ConfigError: missing, another level of the format, or damaged.
    """
    where = str(path)
    content = read_bytes(path, largest=_LARGEST_BYTES)
    if content[:8] == b"\x89HDF\r\n\x1a\n" or content[512:520] == b"\x89HDF\r\n\x1a\n":
        raise ConfigError("is a MATLAB 7.3 file", where=where, hint="save it with -v7, or export .csv")
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128])
    if order is None:
        raise ConfigError("is not a MATLAB file of level 5", where=where, hint="save it with -v7, or export .csv")
    found: Content = {}
    room = _LARGEST_BYTES
    try:
        for element in _elements(content[_HEADER_BYTES:], order):
            whole = _unpacked(element, order, room)
            room -= len(whole.data)
            if room <= 0:
                raise too_large("the unpacked content", _LARGEST_BYTES, where)
            if whole.kind == _MATRIX:
                name, value = _matrix(whole.data, order, 0)
                if name and value is not None:
                    found[name] = value
    except ConfigError:
        raise
    except (_Damaged, ValueError, struct.error, zlib.error) as error:
        raise ConfigError(f"is not a readable .mat file ({error})", where=where, likely="truncated") from None
    return found


def _elements(data: bytes, order: str) -> Iterator[_Element]:
    """Walk through the elements; small ones hold size and type in one word."""
    at, count = 0, 0
    while at + 8 <= len(data):
        count += 1
        if count > _MOST_ELEMENTS:
            raise _Damaged(f"more than {_MOST_ELEMENTS} elements in one")
        kind, size = struct.unpack_from(f"{order}II", data, at)
        if kind >> 16:
            kind, size, start = kind & 0xFFFF, kind >> 16, at + 4
            if size > 4:
                raise _Damaged(f"a small element of {size} bytes")
            after = at + 8
        else:
            start = at + 8
            after = start + size + (-size % 8 if kind != _COMPRESSED else 0)
        if start + size > len(data):
            raise _Damaged(f"{size} bytes announced, {len(data) - start} there")
        yield _Element(kind, data[start : start + size])
        at = after


def _unpacked(element: _Element, order: str, room: int) -> _Element:
    """Return an element, of a compressed one what is in it, cut at ``room`` bytes."""
    if element.kind != _COMPRESSED:
        return element
    data = zlib.decompressobj().decompress(element.data, room + 8)
    if len(data) > room:
        return _Element(_COMPRESSED, data)
    inner = next(_elements(data, order), None)
    if inner is None:
        raise _Damaged("an empty compressed element")
    return inner


def _matrix(data: bytes, order: str, depth: int) -> tuple[str, Any]:
    """Return name and content of a matrix element; the content is None when it is not numbers."""
    parts = list(_elements(data, order))
    if len(parts) < 3 or len(parts[0].data) < 4 or depth > _DEEPEST:
        raise _Damaged("an array without its description")
    (flags,) = struct.unpack_from(f"{order}I", parts[0].data)
    shape = tuple(int(n) for n in np.frombuffer(parts[1].data, f"{order}i4"))
    name = parts[2].data.decode("latin-1")
    if any(n < 0 for n in shape):
        raise _Damaged(f"a shape of {shape}")
    kind = flags & 0xFF
    if kind == _STRUCT_CLASS and math.prod(shape) == 1:
        return name, _structure(parts[3:], order, depth)
    if kind not in _NUMERIC_CLASSES:
        return name, None
    values = _numbers(parts, 3, shape, order)
    if flags & _COMPLEX_FLAG:
        values = values + 1j * _numbers(parts, 4, shape, order)
    return name, np.squeeze(values)


def _numbers(parts: list[_Element], which: int, shape: tuple[int, ...], order: str) -> NDArray[Any]:
    if which >= len(parts) or parts[which].kind not in _STORED:
        raise _Damaged("an array without its numbers")
    values = np.frombuffer(parts[which].data, f"{order}{_STORED[parts[which].kind]}")
    if values.size != math.prod(shape):
        raise _Damaged(f"{values.size} numbers for a shape of {shape}")
    return values.reshape(shape, order="F").astype(values.dtype.newbyteorder("="))


def _structure(parts: list[_Element], order: str, depth: int) -> Content:
    if len(parts) < 2 or len(parts[0].data) != 4:
        raise _Damaged("a structure without field names")
    (length,) = struct.unpack(f"{order}i", parts[0].data)
    if length <= 0 or len(parts[1].data) % length:
        raise _Damaged(f"field names of {length} bytes")
    names = [
        parts[1].data[k : k + length].split(b"\0")[0].decode("latin-1") for k in range(0, len(parts[1].data), length)
    ]
    found: Content = {}
    for name, part in zip(names, parts[2:], strict=False):
        if part.kind == _MATRIX and part.data:
            _, value = _matrix(part.data, order, depth + 1)
            if value is not None:
                found[name] = value
    return found
