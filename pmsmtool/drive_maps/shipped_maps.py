# SPDX-License-Identifier: MIT
"""The drive maps that come with the program, by family name and by a drive's identity."""

from __future__ import annotations

from difflib import get_close_matches
from functools import cache

from pmsmtool.drive_maps.drive_map import DriveMap
from pmsmtool.drive_maps.drive_map_file import parse_drive_map
from pmsmtool.errors import ConfigError, NotAvailable
from pmsmtool.files import data_folder

MAP_NAME = "map.toml"
GENERIC = "cia402"
"""Family of a drive of which nothing but CiA 402 is known."""
UNKNOWN_VENDOR = 0
"""Vendor of a map whose maker's number no source confirmed: it fits no real drive until a person fills it in."""


@cache
def family_names() -> tuple[str, ...]:
    """Return the families with a shipped map."""
    return tuple(sorted(path.parent.name for path in data_folder("firmware-params").glob(f"*/{MAP_NAME}")))


def load_family(name: str) -> DriveMap:
    """Return the shipped map of a family. Raises ConfigError: there is no such family."""
    if name not in family_names():
        near = get_close_matches(name.lower(), family_names(), 1)
        raise ConfigError(
            f"no drive family {name!r}" + (f", did you mean {near[0]}?" if near else ""),
            hint=f"one of {', '.join(family_names())}, or the path of a map file",
        )
    return _shipped_map(name)


@cache
def _shipped_map(name: str) -> DriveMap:
    """Read a map once: a search by identity looks at all of them, 7 ms each."""
    path = data_folder("firmware-params") / name / MAP_NAME
    return parse_drive_map(path.read_text(encoding="utf-8"), str(path))


def family_of(vendor: int, product: int) -> DriveMap | None:
    """Return the shipped map of a drive's identity, None when there is none."""
    if vendor == UNKNOWN_VENDOR:
        return None
    maps = (load_family(name) for name in family_names())
    return next((drive_map for drive_map in maps if drive_map.is_for(vendor, product)), None)


def only_family(vendor: int) -> DriveMap | None:
    """Return the shipped map of a maker's drives where it is the only one of this vendor number, else None."""
    maps = [load_family(name) for name in family_names()]
    own = [one for one in maps if one.vendor == vendor != UNKNOWN_VENDOR]
    return own[0] if len(own) == 1 else None


def kin_of(vendor: int) -> str:
    """Return the families of other products of a maker, as a message names them; empty: there are none."""
    maps = [load_family(name) for name in family_names()]
    own = [one.name for one in maps if one.vendor == vendor != UNKNOWN_VENDOR and not one.identity.shared]
    return ", ".join(own)


def unnamed_drive(vendor: int, product: int, *, where: str, hint: str) -> ConfigError:
    """Return the refusal to write what no shipped map describes; maps of the same maker are named."""
    kin = kin_of(vendor)
    likely = (
        f"another product of the maker whose drives {kin} describes: compare the rows with your manual, and copy it"
    )
    return ConfigError(
        f"no map names this drive: vendor {vendor:#010x} product {product:#x}",
        where=where,
        likely=likely if kin else "a drive whose gains stand in no shipped map",
        hint=hint,
    )


def nothing_to_write(drive_map: DriveMap, where: str) -> NotAvailable:
    """Return the refusal of a set of which a map has no object for any value."""
    return NotAvailable(
        f"the map {drive_map.name!r} has no object for any value of the set on this drive", where=where,
        hint="enter the values with the maker's software, or write the rows of your manual into a map",
    )  # fmt: skip
