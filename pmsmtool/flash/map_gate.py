"""The gate before the first write through a map: it must be this drive's, and still the map of last time.

A parameter set is only as right as the map that scales it. The reference drive shows the layout of its own set
(0x2000:02); another drive shows nothing but its identity. So its map must name that identity, and the hash of the map a
drive was last written through is kept with its journals: another map for the same drive is a decision, not an accident.
"""

from __future__ import annotations

import json
from pathlib import Path

from pmsmtool.drive.port import Identity
from pmsmtool.errors import ConfigError, SafetyRefusal
from pmsmtool.firmware.drive_map import DriveMap
from pmsmtool.firmware.drive_map_file import map_hash
from pmsmtool.firmware.shipped_maps import UNKNOWN_VENDOR
from pmsmtool.flash.journal import JournalFolder

SHOWN = 12
"""Digits of a hash that a message shows."""


def memory_of(folder: JournalFolder) -> Path:
    """Return the file that remembers the map a drive was last written through."""
    return folder.path.with_name("map.json")


def check_map(drive_map: DriveMap, identity: Identity, folder: JournalFolder) -> None:
    """Refuse a map that is not this drive's, or not the one it was last written through; nothing is written.

    Raises
    ------
    ConfigError
        The map is for another identity, or says none.
    SafetyRefusal
        The drive was last written through another map.
    """
    where = f"node {identity.node}, 0x1018"
    if drive_map.vendor == UNKNOWN_VENDOR:
        raise ConfigError(
            f"the map {drive_map.name!r} does not say whose drive it is for (vendor 0): nothing is written through it",
            where=where,
            hint="this drive names no vendor either: nothing can be written to it"
            if identity.vendor == UNKNOWN_VENDOR
            else f"copy it, write vendor = {identity.vendor:#010x}, product = {identity.product:#010x}, give it with "
            "--map",
        )
    if not drive_map.is_for(identity.vendor, identity.product):
        raise ConfigError(
            f"the map {drive_map.name!r} is for vendor {drive_map.vendor:#010x} product {drive_map.product:#x}, the "
            f"drive is vendor {identity.vendor:#010x} product {identity.product:#x}",
            where=where,
            hint="give the map of this drive with --map; nothing was written",
        )
    if drive_map.staging:
        return  # the drive itself shows the layout of its set
    kept, now = _kept(folder), map_hash(drive_map)
    if kept not in ("", now):
        raise SafetyRefusal(
            f"this drive was last written through another map: sha256 {kept[:SHOWN]} then, {now[:SHOWN]} now",
            where=where,
            likely="the map was edited, or another family's was given",
            hint=f"compare the maps; to accept the new one delete {memory_of(folder)}",
        )


def remember_map(drive_map: DriveMap, folder: JournalFolder) -> None:
    """Note the map a drive is written through."""
    if drive_map.staging:
        return
    path = memory_of(folder)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"map": drive_map.name, "sha256": map_hash(drive_map)}) + "\n", encoding="utf-8")
    except OSError as error:
        raise ConfigError(
            f"cannot be written: {error.strerror or error}",
            where=str(path),
            hint="check your rights there and the space on the disk",
        ) from error


def _kept(folder: JournalFolder) -> str:
    path = memory_of(folder)
    if not path.exists():
        return ""
    try:
        return str(json.loads(path.read_text(encoding="utf-8"))["sha256"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"damaged: {error}", where=str(path), hint="delete it if the map in use is the right one"
        ) from error
