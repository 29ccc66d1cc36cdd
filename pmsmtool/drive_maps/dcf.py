# SPDX-License-Identifier: MIT
"""Write device configuration files: values laid into the text of an EDS or DCF, and concise DCF (CiA 306-1, CiA 302-2).

A user's file keeps every byte that is not a changed ``ParameterValue``: comments, vendor keys, order, line ends.
"""

from __future__ import annotations

import itertools
import math
import struct
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass

from pmsmtool.drive_maps.eds import (
    COMMISSIONING,
    INTEGER_BITS,
    REAL32,
    REAL64,
    SIGNED,
    VISIBLE_STRING,
    Eds,
    decode,
    object_of,
    parse_eds,
    parse_integer,
    parse_real,
    sections_of,
)
from pmsmtool.errors import ConfigError, next_step

NEXT_STEP = "give the EDS or DCF of the drive's maker as it came, or one that `pmsmtool export` wrote"

Address = tuple[int, int]

FIXED_SIZE = {code: bits // 8 for code, bits in INTEGER_BITS.items()} | {REAL32: 4, REAL64: 8}
"""Bytes of the types that have a fixed size."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One value of a concise DCF: object and the encoded bytes."""

    index: int
    sub: int
    data: bytes


@next_step(NEXT_STEP)
def encode(data_type: int, value: float | str | bytes) -> bytes:
    """Return the bytes of a value on the wire (CiA 301, section 7.1.4, little endian).

    Raises ConfigError: if the value does not fit its type.
    """
    if isinstance(value, bytes):
        return value
    if isinstance(value, str):
        return value.encode("latin-1", "replace")
    if data_type in (REAL32, REAL64):
        try:
            return struct.pack("<f" if data_type == REAL32 else "<d", value)
        except OverflowError:
            raise ConfigError(f"{value!r} does not fit binary32") from None
    bits = INTEGER_BITS.get(data_type)
    if bits is None:
        raise ConfigError(f"a number cannot be encoded as data type {data_type:#04x}")
    if not math.isfinite(value) or value != math.floor(value):
        raise ConfigError(f"{value!r} is not an integer, and the object is one")
    try:
        return int(value).to_bytes(bits // 8, "little", signed=data_type in SIGNED)
    except OverflowError:
        raise ConfigError(f"{int(value)} does not fit {bits} bits") from None


@next_step(NEXT_STEP)
def decode_value(data_type: int, text: str, node_id: int | None = None) -> bytes:
    """Return the bytes of a ``ParameterValue`` or ``DefaultValue`` text.

    Raises ConfigError: if the text is no value of the type.
    """
    try:
        if data_type in (REAL32, REAL64):
            return encode(data_type, parse_real(text, data_type))
        if data_type in INTEGER_BITS:
            value = parse_integer(text, node_id)
            bits = INTEGER_BITS[data_type]
            if data_type in SIGNED and 1 << (bits - 1) <= value < 1 << bits:
                value -= 1 << bits
            return encode(data_type, value)
        if data_type == VISIBLE_STRING:
            return text.encode("latin-1", "replace")
        return bytes.fromhex(text)
    except ValueError as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"{text[:40]!r} is not a value of data type {data_type:#04x}") from error


def value_text(data_type: int, data: bytes) -> str:
    """Return the ``ParameterValue`` text of encoded bytes: nine digits for binary32, hex for unsigned numbers."""
    if data_type == REAL32:
        return f"{struct.unpack('<f', data)[0]:.9g}"
    if data_type == REAL64:
        return f"{struct.unpack('<d', data)[0]:.17g}"
    if data_type in SIGNED:
        return str(int.from_bytes(data, "little", signed=True))
    if data_type in INTEGER_BITS:
        return f"0x{int.from_bytes(data, 'little'):0{2 * len(data)}X}"
    return data.decode("latin-1") if data_type == VISIBLE_STRING else data.hex().upper()


@next_step(NEXT_STEP)
def update_dcf(data: bytes, values: Mapping[Address, bytes], where: str = "DCF") -> bytes:
    """Return the file with new ``ParameterValue`` lines and every other byte kept.

    Raises ConfigError: if the file does not describe one of the objects.

    Parameters
    ----------
    data : bytes
        EDS or DCF.
    values : mapping of (index, sub) to bytes
        Encoded values.
    where : str
        Name for messages.
    """
    sheet = parse_eds(data, where)
    _require(sheet, values, where)
    text, encoding = decode(data)
    lines = text.splitlines(keepends=True)
    newline = "\r\n" if any(line.endswith("\r\n") for line in lines) else "\n"
    replaced, inserted = _edits(lines, sheet, values, newline)
    out = []
    for number, line in enumerate(lines):
        out.append(replaced.get(number, line))
        if number in inserted:
            if not out[-1].endswith(("\n", "\r")):
                out[-1] += newline
            out.append(inserted[number])
    return "".join(out).encode(encoding)


def _edits(
    lines: list[str], sheet: Eds, values: Mapping[Address, bytes], newline: str
) -> tuple[dict[int, str], dict[int, str]]:
    """Return the lines to replace and the lines to insert behind others."""
    headers = [*sections_of(lines), (len(lines), "")]
    names = dict(headers)
    replaced: dict[int, str] = {}
    placed: dict[Address, tuple[int, str] | None] = {}
    for (start, section), (end, _) in itertools.pairwise(headers):
        compact = section.endswith("value") and object_of(section[:-5])
        address = object_of(section)
        if address is not None:
            wanted = {"parametervalue": (address[0], address[1] or 0)}
        elif compact:
            wanted = {str(sub): (index, sub) for index, sub in values if index == compact[0]}
        else:
            continue
        last = max((n for n in range(start, end) if lines[n].strip()), default=start)
        for key, target in wanted.items():
            if target not in values or not (compact or names.get(sheet.objects[target].line - 1) == section):
                continue
            name = "ParameterValue" if key == "parametervalue" else key
            new = value_text(sheet.objects[target].data_type, values[target])
            place = _line_of(lines, start + 1, end, key)
            if place is not None:  # in every section of that name, as the last one counts
                replaced[place] = _with_value(lines[place], new)
                placed[target] = None
            else:
                placed.setdefault(target, (last, f"{name}={new}{newline}"))
    listed: dict[int, list[str]] = {}
    for index, sub in sorted(values.keys() - placed.keys()):  # described by CompactSubObj, without a list of values
        text = value_text(sheet.objects[index, sub].data_type, values[index, sub])
        listed.setdefault(index, []).append(f"{sub}={text}{newline}")
    inserted: dict[int, str] = {}
    for last, line in filter(None, placed.values()):
        inserted[last] = inserted.get(last, "") + line
    for index, rows in listed.items():
        head = f"{newline}[{index:04X}Value]{newline}NrOfEntries={len(rows)}{newline}"
        inserted[len(lines) - 1] = inserted.get(len(lines) - 1, "") + head + "".join(rows)
    return replaced, inserted


def _line_of(lines: list[str], start: int, end: int, key: str) -> int | None:
    found = None
    for number in range(start, end):
        head, equals, _ = lines[number].partition("=")
        if equals and head.strip().lower() == key:
            found = number  # the last one counts, as for the reader
    return found


def _with_value(line: str, value: str) -> str:
    head, _, tail = line.partition("=")
    ending = tail[len(tail.rstrip("\r\n")) :]
    spaces = tail[: len(tail) - len(tail.lstrip(" \t"))]
    return f"{head}={spaces}{value}{ending}"


def _require(sheet: Eds, values: Mapping[Address, bytes], where: str) -> None:
    wrong = [
        f"0x{index:04X}:{sub:02X} is not in the file" for index, sub in values if (index, sub) not in sheet.objects
    ]
    for address, data in values.items():
        entry = sheet.objects.get(address)
        size = FIXED_SIZE.get(entry.data_type) if entry else None
        if size is not None and len(data) != size:
            wrong.append(f"0x{address[0]:04X}:{address[1]:02X} takes {size} bytes, {len(data)} given")
    if wrong:
        raise ConfigError(
            "the file does not fit the parameter set",
            where=where,
            likely="the file belongs to another drive or firmware",
            violations=wrong,
        )


@next_step(NEXT_STEP)
def new_dcf(
    eds: bytes, values: Mapping[Address, bytes], *, node_id: int, node_name: str = "", where: str = "EDS"
) -> bytes:
    """Return a DCF made from an EDS: its text, the values, and a DeviceComissioning section (CiA 306-1, 7.3).

    The bit rate is left to the bus; no date is written.
    """
    updated = update_dcf(eds, values, where)
    text, encoding = decode(updated)
    if any(name in COMMISSIONING for _, name in sections_of(text.splitlines())):
        return updated
    newline = "\r\n" if "\r\n" in text else "\n"
    section = ["", "[DeviceComissioning]", f"NodeID=0x{node_id:02X}", f"NodeName={node_name}", ""]
    return (text.rstrip("\r\n") + newline + newline.join(section)).encode(encoding, "replace")


@next_step(NEXT_STEP)
def values_of(sheet: Eds, wanted: Container[Address] | None = None) -> dict[Address, bytes]:
    """Return the ``ParameterValue`` of every object that is wanted (all: None) and has one, encoded.

    Raises ConfigError: listing every value that is none of its type.
    """
    found: dict[Address, bytes] = {}
    wrong = []
    for address, entry in sheet.objects.items():
        if not entry.value or (wanted is not None and address not in wanted):
            continue
        try:
            found[address] = decode_value(entry.data_type, entry.value, sheet.node_id)
        except ConfigError as error:
            wrong.append(f"line {entry.line}: 0x{address[0]:04X}:{address[1]:02X} {error.what}")
    if wrong:
        raise ConfigError("values in the DCF cannot be used", violations=wrong)
    return found


@next_step(NEXT_STEP)
def write_concise(entries: Sequence[Entry]) -> bytes:
    """Return a concise DCF: count, then index, sub, size, data of each (object 0x1F22, CiA 302-2)."""
    parts = [struct.pack("<I", len(entries))]
    parts += [struct.pack("<HBI", entry.index, entry.sub, len(entry.data)) + entry.data for entry in entries]
    return b"".join(parts)
