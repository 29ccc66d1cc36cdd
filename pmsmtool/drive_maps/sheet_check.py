# SPDX-License-Identifier: MIT
"""Whether a maker's data sheet and a drive map are of one drive: identity, and every row the sheet contradicts."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping

from pmsmtool.data_types import DATA_TYPES
from pmsmtool.drive_maps.drive_map import Cell, DriveMap, SignalCell
from pmsmtool.drive_maps.eds import Eds, parse_integer
from pmsmtool.drive_maps.motion_objects import MotionObject
from pmsmtool.drive_maps.shipped_maps import GENERIC, family_of, load_family, only_family, unnamed_drive
from pmsmtool.errors import ConfigError
from pmsmtool.params.catalogue import OWN_SCALES

_IDENTITY = 0x1018
_TYPE_NAMES = {row.code: row.name for row in DATA_TYPES.values()}


def other_identity(sheet: Eds, drive_map: DriveMap) -> str:
    """Say which vendor or product of a data sheet is not the map's; empty where they agree, or one says nothing."""
    products = {drive_map.product, *drive_map.more_products}
    checks = (("vendor", 1, sheet.vendor, {drive_map.vendor}), ("product", 2, sheet.product, products))
    lines = [
        f"{name} {number:#010x}, the map {drive_map.name!r} is for {', '.join(f'{one:#010x}' for one in sorted(known))}"
        for name, sub, stated, known in checks
        for number in sorted({*_told(sheet, sub), *([stated] if stated else [])} - known)
        if any(known)  # 0 in a map: no source stated it
    ]
    return f"the file is for {'; '.join(lines)}" if lines else ""


def identity_of_sheet(sheet: Eds) -> tuple[int, int]:
    """Return vendor and product of a data sheet's drive, 0 where the sheet does not say."""
    stated = ((1, sheet.vendor), (2, sheet.product))
    vendor, product = (next(_told(sheet, sub), number) or 0 for sub, number in stated)
    return vendor, product


def family_of_sheet(sheet: Eds) -> DriveMap | None:
    """Return the shipped map for the drive of a data sheet, None where there is none or the sheet does not say.

    A sheet that leaves its product blank is of the only family of its vendor, if there is one alone. Where others have
    that identity, too, name or marks of the family must be in the sheet.
    """
    vendor, product = identity_of_sheet(sheet)
    found = family_of(vendor, product)
    if found is None and not product:
        found = only_family(vendor)
    if found is None or any(word.lower() in sheet.product_name.lower() for word in found.identity.names):
        return found
    return found if all((index, sub) in sheet.objects for index, sub, _ in found.identity.marks) else None


def unnamed_sheet(sheet: Eds, where: str) -> ConfigError:
    """Return the refusal of a file whose drive no shipped map names, where none was given."""
    return unnamed_drive(
        *identity_of_sheet(sheet), where=where,
        hint="give with --map a map with the rows that its manual documents; nothing was written",
    )  # fmt: skip


def _told(sheet: Eds, sub: int) -> Iterator[int]:
    """Yield the numbers that the file's identity object states; 0 and blank state nothing."""
    entry = sheet.objects.get((_IDENTITY, sub))
    for text in (entry.value, entry.default) if entry is not None else ():
        try:
            number = parse_integer(text) if text else 0
        except ValueError:
            continue
        if number:
            yield number


def map_of_sheet(sheet: Eds) -> DriveMap:
    """Return the map of a data sheet's drive: its family's, or that of CiA 402, as far as the file agrees."""
    written = {at for at, entry in sheet.objects.items() if "w" in entry.access}
    return as_in_file(family_of_sheet(sheet) or load_family(GENERIC), types_of(sheet), limits_of(sheet), written)


def as_in_file(
    drive_map: DriveMap,
    types: Mapping[tuple[int, int], str],
    limits: Mapping[tuple[int, int], tuple[float, float]],
    written: Collection[tuple[int, int]],
) -> DriveMap:
    """Return a map as far as a file agrees: its rows have the file's limits.

    Rows that the file contradicts, or lets only be read, are left out with the reason.

    Parameters
    ----------
    types, limits : mapping by (index, sub)
        Data types of the file's objects; smallest and largest number.
    written : collection of (index, sub)
        Objects that can be written.
    """
    gone = {}
    for name, cell in drive_map.cells.items():
        if wrong := contradictions(drive_map, types, [name]):
            gone[name] = wrong[0].removeprefix(f"{drive_map.name} {name} ")
        elif (cell.index, cell.sub) not in written and name not in OWN_SCALES:
            gone[name] = f"0x{cell.index:04X}:{cell.sub:02X}: the file lets it only be read"
    found = drive_map.limited(limits)
    return found.without(gone) if gone else found


def limits_of(sheet: Eds) -> dict[tuple[int, int], tuple[float, float]]:
    """Return smallest and largest number of the objects for which a sheet states one of both."""
    return {
        at: (-math.inf if entry.low is None else entry.low, math.inf if entry.high is None else entry.high)
        for at, entry in sheet.objects.items()
        if entry.low is not None or entry.high is not None
    }


def types_of(sheet: Eds) -> dict[tuple[int, int], str]:
    """Return the data types of a sheet's objects by address; one that CiA 301 does not know is empty."""
    return {address: _TYPE_NAMES.get(entry.data_type, "") for address, entry in sheet.objects.items()}


def contradictions(
    drive_map: DriveMap, types: Mapping[tuple[int, int], str], names: Iterable[str] | None = None
) -> list[str]:
    """Return the rows of a map that a maker's file does not have, or has in another type, with family and source.

    Parameters
    ----------
    types : mapping of (index, sub) to str
        Data types of the file's objects (:func:`types_of`).
    names : iterable of str, optional
        Rows to look at: parameters, signals, motion; all of them when not given.
    """
    rows: dict[str, Cell | SignalCell | MotionObject] = {**drive_map.motion, **drive_map.signals, **drive_map.cells}
    lines = []
    for name in rows if names is None else names:
        row = rows[name]
        if not row.index:
            continue  # a number that the maker fixes
        found = types.get((row.index, row.sub))
        if found is None:
            lines.append(f"{drive_map.row_text(name)}: the file has no such object")
        elif found != row.wire:
            lines.append(f"{drive_map.row_text(name)}: the file has {found or 'another type'}")
    return lines
