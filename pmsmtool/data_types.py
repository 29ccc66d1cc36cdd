# SPDX-License-Identifier: MIT
"""The one table of CiA 301 data types (CiA 301, table 44): name, code, bytes and ``struct`` letter of each."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class DataType:
    """One data type."""

    name: str
    short: str
    """As the standard writes it, and as object dictionaries abbreviate it."""
    code: int
    """Index in the object dictionary."""
    size: int
    """Bytes on the wire; 0: any number."""
    letter: str
    """``struct`` letter of a number; empty: no number."""

    @property
    def is_float(self) -> bool:
        """Whether the number is not a whole one."""
        return self.letter in ("f", "d")

    @property
    def is_integer(self) -> bool:
        """Whether it is a whole number (a BOOLEAN counts as one)."""
        return self.letter not in ("", "f", "d")

    @property
    def is_signed(self) -> bool:
        """Whether it is a whole number with a sign."""
        return self.is_integer and self.letter.islower()


DATA_TYPES: dict[str, DataType] = {
    row[0]: DataType(*row)
    for row in (
        ("BOOLEAN", "BOOL", 0x01, 1, "B"),
        ("INTEGER8", "I8", 0x02, 1, "b"),
        ("INTEGER16", "I16", 0x03, 2, "h"),
        ("INTEGER32", "I32", 0x04, 4, "i"),
        ("UNSIGNED8", "U8", 0x05, 1, "B"),
        ("UNSIGNED16", "U16", 0x06, 2, "H"),
        ("UNSIGNED32", "U32", 0x07, 4, "I"),
        ("REAL32", "REAL32", 0x08, 4, "f"),
        ("VISIBLE_STRING", "VSTR", 0x09, 0, ""),
        ("OCTET_STRING", "OSTR", 0x0A, 0, ""),
        ("UNICODE_STRING", "USTR", 0x0B, 0, ""),
        ("DOMAIN", "DOMAIN", 0x0F, 0, ""),
        ("REAL64", "REAL64", 0x11, 8, "d"),
        ("INTEGER64", "I64", 0x15, 8, "q"),
        ("UNSIGNED64", "U64", 0x1B, 8, "Q"),
    )
}
"""All types by name."""
BY_SHORT: dict[str, DataType] = {data_type.short: data_type for data_type in DATA_TYPES.values()}
"""All types by abbreviation."""
SHORT: dict[str, str] = {data_type.name: data_type.short for data_type in DATA_TYPES.values()}
"""Abbreviations by name."""


def codes(*names: str) -> tuple[int, ...]:
    """Return the codes of types."""
    return tuple(DATA_TYPES[name].code for name in names)
