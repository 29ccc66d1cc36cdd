# SPDX-License-Identifier: MIT
"""Small data sheets of drives, written for the tests: the objects by which families are known, and no more."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from pmsmtool.data_types import BY_SHORT
from pmsmtool.drive_maps.drive_map_file import dump_drive_map
from pmsmtool.drive_maps.shipped_maps import load_family

TYPES = {short: row.code for short, row in BY_SHORT.items()}
Row = tuple[int, int, str, str, str]
"""Index, sub-index, type, access, stored value."""

COMMON: tuple[Row, ...] = (
    (0x1000, 0, "U32", "ro", "0x00020192"),
    (0x1017, 0, "U16", "rw", "0"),
    (0x6040, 0, "U16", "rw", "0"),
    (0x6041, 0, "U16", "ro", ""),
    (0x6060, 0, "I8", "rw", "0"),
    (0x6061, 0, "I8", "ro", ""),
    (0x6064, 0, "I32", "ro", ""),
)
HEARTBEAT: tuple[Row, ...] = ((0x1016, 1, "U32", "rw", "0"),)
GUARDING: tuple[Row, ...] = ((0x100C, 0, "U16", "rw", "0"), (0x100D, 0, "U8", "rw", "0"))
EXPECTED_PDO: tuple[Row, ...] = (
    (0x1403, 1, "U32", "rw", "$NODEID+0x80000500"), (0x1403, 2, "U8", "rw", "254"), (0x1403, 5, "U16", "rw", "0"),
    (0x1603, 0, "U8", "rw", "0"), *((0x1603, sub, "U32", "rw", "0") for sub in range(1, 9)),
)  # fmt: skip
"""A receive PDO with an event timer: the drive notices that it stays away."""
TORQUE: tuple[Row, ...] = ((0x6071, 0, "I16", "rw", "0"), (0x6077, 0, "I16", "ro", ""))


def identity(vendor: int, product: int) -> tuple[Row, ...]:
    """Return 0x1018 with a serial number."""
    return (
        (0x1018, 1, "U32", "ro", hex(vendor)), (0x1018, 2, "U32", "ro", hex(product)), (0x1018, 4, "U32", "ro", ""),
    )  # fmt: skip


CIA402: tuple[Row, ...] = (
    *COMMON, *HEARTBEAT, *TORQUE, *identity(0x1234, 1), (0x6007, 0, "I16", "rw", "1"), (0x605A, 0, "I16", "rw", "2"),
    (0x605E, 0, "I16", "rw", "2"), (0x6062, 0, "I32", "ro", "0"), (0x606C, 0, "I32", "ro", "0"),
    (0x6073, 0, "U16", "rw", "0"), (0x6075, 0, "U32", "rw", "0"), (0x6078, 0, "I16", "ro", "0"),
    (0x607A, 0, "I32", "rw", "0"), (0x6080, 0, "U32", "rw", "50000"), (0x608F, 1, "U32", "rw", "4096"),
    (0x608F, 2, "U32", "rw", "1"), (0x60FF, 0, "I32", "rw", "0"), (0x6502, 0, "U32", "ro", "0x00d"),
)  # fmt: skip
"""Of a drive with profile position, velocity and torque mode: what the standard says of its limits, and no more."""


def epos4(modes: int = 0x225, product: int = 0x65510000) -> tuple[Row, ...]:
    """Currents and torque constant in 0x3001, torque by mode 10 only, no 0x6073, 0x6075, 0x6078, 0x608F."""
    return (
        *COMMON, *HEARTBEAT, *TORQUE, *identity(0xFB, product),
        (0x3001, 1, "U32", "rw", "8000"), (0x3001, 2, "U32", "rw", "30000"), (0x3001, 3, "U8", "rw", "1"),
        (0x3001, 5, "U32", "rw", "0"), (0x3010, 1, "U32", "rw", "500"), (0x30A0, 1, "U32", "rw", "1171880"),
        (0x30A0, 2, "U32", "rw", "3906250"), (0x30D0, 0, "I32", "ro", "0"), (0x30D1, 2, "I32", "ro", "0"),
        (0x6007, 0, "I16", "rw", "3"),
        (0x605A, 0, "I16", "rw", "6"), (0x605E, 0, "I16", "rw", "2"), (0x606C, 0, "I32", "ro", "0"),
        (0x6076, 0, "U32", "rw", "0"), (0x6080, 0, "U32", "rw", "50000"), (0x60A9, 0, "U32", "rw", "0x00B44700"),
        (0x60FF, 0, "I32", "rw", "0"), (0x6502, 0, "U32", "ro", hex(modes)),
        *((0x30A1, sub, "U32", "rw", "0") for sub in range(1, 6)),
        *((0x30A2, sub, "U32", "rw", "0") for sub in range(1, 5)),
        *((index, 0, "U32", "rw", "10000") for index in (0x6081, 0x6083, 0x6084)),
    )  # fmt: skip


def copley() -> tuple[Row, ...]:
    """Node guarding and no heartbeat consumer, no 0x6007, no limits of CiA 402, an unsigned 0x6060."""
    rows = [row for row in COMMON if row[0] not in (0x6060, 0x6061)]
    motor = [(0x6410, sub, "U32", "rw", "0") for sub in (12, 23, 34)]
    return (
        *rows, *GUARDING, *TORQUE, *identity(0xAB, 0x20B), (0x6060, 0, "U8", "rw", ""), (0x6061, 0, "U8", "ro", ""),
        (0x2110, 0, "I16", "rw", ""), (0x2111, 0, "I16", "rw", ""), (0x2112, 0, "U16", "rw", ""),
        (0x221C, 0, "I16", "ro", ""), (0x605A, 0, "I16", "rw", ""), (0x6076, 0, "U32", "rw", ""),
        (0x6410, 2, "I16", "rw", ""), (0x6410, 7, "U16", "rw", ""), (0x6410, 8, "U16", "rw", ""), *motor,
        (0x60FF, 0, "I32", "rw", ""), (0x606C, 0, "I32", "ro", ""), (0x6502, 0, "U32", "ro", "1005"),
    )  # fmt: skip


def faulhaber() -> tuple[Row, ...]:
    """No torque mode: velocity mode 3 in rpm, current limits in mA, poles instead of pole pairs."""
    return (
        *COMMON, *HEARTBEAT, *identity(0x147, 0xC4E), (0x2333, 1, "U16", "rw", ""), (0x2333, 2, "U16", "rw", ""),
        (0x2350, 3, "U16", "rw", "4"), (0x606C, 0, "I32", "ro", ""), (0x6078, 0, "I16", "ro", ""),
        (0x608F, 1, "U32", "ro", "4096"), (0x60FF, 0, "I32", "rw", ""), (0x6502, 0, "U32", "ro", "0x25"),
    )  # fmt: skip


def unknown(modes: str = "0x2D", *more: Row, without: tuple[int, ...] = ()) -> tuple[Row, ...]:
    """A maker whom no map names: the objects of CiA 402 alone; rows of ``more`` stand for those of the same index."""
    rows = (
        *COMMON, *HEARTBEAT, *TORQUE, *identity(0x1DD, 0x10305070), (0x6007, 0, "I16", "rw", "2"),
        (0x606C, 0, "I32", "ro", ""), (0x6073, 0, "U16", "rw", "1000"), (0x6075, 0, "U32", "rw", ""),
        (0x6078, 0, "I16", "ro", ""), (0x6080, 0, "U32", "rw", ""), (0x608F, 1, "U32", "rw", "4096"),
        (0x608F, 2, "U32", "rw", "1"), (0x60FF, 0, "I32", "rw", "0"), (0x6502, 0, "U32", "ro", modes),
    )  # fmt: skip
    gone = {*without, *(row[0] for row in more)}
    return (*(row for row in rows if row[0] not in gone), *more)


def write_eds(
    path: Path, rows: Iterable[Row], limits: dict[tuple[int, int], tuple[int | str, int | str]] | None = None
) -> Path:
    """Write the rows as an EDS; limits by address."""
    lines = ["[FileInfo]", "FileName=x.eds", "[DeviceInfo]", "ProductName=drive of a test"]
    heads: set[int] = set()
    subs = {index for index, sub, *_ in rows if sub}
    for index, sub, kind, access, value in sorted(rows):
        if index in subs and index not in heads:
            lines += [f"[{index:04X}]", "ParameterName=record", "ObjectType=9"]
            heads.add(index)
        lines.append(f"[{index:04X}sub{sub:X}]" if index in subs else f"[{index:04X}]")
        lines += ["ParameterName=object", "ObjectType=7", f"DataType={TYPES[kind]:#06x}", f"AccessType={access}"]
        lines.append(f"DefaultValue={value}")
        if limits and (index, sub) in limits:
            low, high = limits[index, sub]
            lines += [f"LowLimit={low}", f"HighLimit={high}"]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")
    return path


def nothing_for_motion(folder: Path) -> Path:
    """Write the map of a drive without the maker's own objects for currents: nothing limits one."""
    path = folder / "bare.toml"
    path.write_text(dump_drive_map(replace(load_family("faulhaber"), motion={})), encoding="utf-8")
    return path
