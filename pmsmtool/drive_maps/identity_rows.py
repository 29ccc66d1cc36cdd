# SPDX-License-Identifier: MIT
"""Table ``[identity]`` of a drive map: what beyond vendor and product tells whether a drive is the map's.

A maker may keep the serial number outside 0x1018, two makers may share a vendor number, and a map is taken from files
of certain firmware. None of it scales a value, so that none of it counts in the map's hash.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from pmsmtool.data_types import DATA_TYPES

TABLE = "identity"
_KEYS = ("serial", "revisions", "names", "marks", "source")
_SERIAL_TYPES = ("UNSIGNED16", "UNSIGNED32", "UNSIGNED64")

Complain = Callable[[tuple[str, ...], str], None]


@dataclass(frozen=True, slots=True)
class IdentityRows:
    """What else identifies a drive of the family."""

    serial: tuple[int, int, int] | None = None
    """Index, sub-index and size in bytes of the serial number where 0x1018:04 is absent or 0; empty: nowhere else."""
    revisions: tuple[int, ...] = ()
    """Major revisions (upper half of 0x1018:03) of the files the map was taken from; empty: they do not say."""
    names: tuple[str, ...] = ()
    """Words of the device name (0x1008) by which a maker is known that shares its vendor number."""
    marks: tuple[tuple[int, int, int], ...] = ()
    """Objects by which it is known where the name does not tell; with neither, the vendor number is the maker's alone.
    Tuple of (index, sub, size)."""
    source: str = ""
    """Key of ``DriveMap.sources``."""

    @property
    def shared(self) -> bool:
        """Whether another maker uses the vendor number, too."""
        return bool(self.names or self.marks)


def parse_identity(table: Mapping[str, Any], sources: Mapping[str, str], complain: Complain) -> IdentityRows:
    """Return the table of a map file; tells what is wrong with it."""

    def tell(key: str, what: str) -> None:
        complain((TABLE, key), f"{TABLE}.{key}: {what}")

    for key in table:
        if key not in _KEYS:
            tell(key, "unknown key")
    serial = _object(table["serial"], _SERIAL_TYPES) if "serial" in table else None
    if "serial" in table and serial is None:
        tell("serial", f"needs index, sub and a type of {', '.join(_SERIAL_TYPES)}")
    marks = [_object(row, tuple(DATA_TYPES)) for row in _list(table, "marks")]
    if None in marks:
        tell("marks", "every mark needs index, sub and type")
    revisions, names = _list(table, "revisions"), _list(table, "names")
    if not all(type(number) is int and 0 <= number <= 0xFFFF for number in revisions):
        tell("revisions", "not a list of major revisions (0 .. 0xFFFF, the upper half of 0x1018:03)")
    if not all(isinstance(word, str) and word for word in names):
        tell("names", "not a list of words")
    if table and table.get("source") not in sources:
        tell("source", f"source {table.get('source')!r} is not in [sources]")
    good = tuple(mark for mark in marks if mark is not None)
    return IdentityRows(serial, tuple(revisions), tuple(names), good, str(table.get("source", "")))


def dump_identity(rows: IdentityRows) -> dict[str, Any]:
    """Return the table as a map file has it; empty where nothing is said."""
    table: dict[str, Any] = {} if rows.serial is None else {"serial": _row(rows.serial)}
    table |= {key: list(getattr(rows, key)) for key in ("revisions", "names") if getattr(rows, key)}
    table |= {"marks": [_row(mark) for mark in rows.marks]} if rows.marks else {}
    return table | ({"source": rows.source} if rows.source else {})


def _list(table: Mapping[str, Any], key: str) -> list[Any]:
    found = table.get(key, [])
    return found if isinstance(found, list) else [None]


def _object(row: Any, types: tuple[str, ...]) -> tuple[int, int, int] | None:
    if not isinstance(row, dict) or set(row) != {"index", "sub", "type"} or row["type"] not in types:
        return None
    index, sub = row["index"], row["sub"]
    good = type(index) is int and type(sub) is int and 0x1000 <= index <= 0x9FFF and 0 <= sub <= 0xFE
    return (index, sub, DATA_TYPES[row["type"]].size) if good else None


def _row(place: tuple[int, int, int]) -> dict[str, Any]:
    index, sub, size = place
    return {"index": index, "sub": sub, "type": f"UNSIGNED{8 * size}"}
