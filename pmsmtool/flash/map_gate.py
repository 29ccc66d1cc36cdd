# SPDX-License-Identifier: MIT
"""The gate before the first motion and the first write through a map: it must be this drive's.

A parameter set is only as right as the map that scales it. The reference drive shows the layout of its own set
(0x2000:02); another drive shows nothing but its identity. So its map must name that identity before anything moves, and
the hash of the map a drive was last written through is kept with its journals: another map for the same drive is a
decision, not an accident.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.drive.drive_node import NOT_READ, DriveNode
from pmsmtool.drive.port import Identity
from pmsmtool.drive_maps.drive_map import Cell, DriveMap
from pmsmtool.drive_maps.drive_map_file import map_hash
from pmsmtool.drive_maps.shipped_maps import GENERIC, UNKNOWN_VENDOR, family_of, load_family, unnamed_drive
from pmsmtool.errors import ConfigError, SafetyRefusal, SdoAbort
from pmsmtool.files import ELSEWHERE, make_folder, read_text, write_file
from pmsmtool.flash.journal import JournalFolder
from pmsmtool.plain_text import counted, one_line

SHOWN = 12
"""Digits of a hash that a message shows."""
SOURCE_LETTERS = 60
"""Of a source: the line stands in every plan, and an EPOS4's is four lines long."""


def memory_of(folder: JournalFolder) -> Path:
    """Return the file that remembers the map a drive was last written through."""
    return folder.path.with_name("map.json")


def check_map(drive_map: DriveMap, identity: Identity, folder: JournalFolder) -> None:
    """Refuse a map that is not this drive's, or not the one it was last written through; nothing is written.

    Raises ConfigError: the map is for another identity, or says none; SafetyRefusal: the drive was last written through
    another map.
    """
    if drive_map.vendor == UNKNOWN_VENDOR and drive_map.scales:
        raise _other_drive(drive_map, identity)
    check_family(drive_map, identity)
    if drive_map.staging or not drive_map.scales:
        return  # the drive itself shows the layout of its set, or nothing is scaled
    kept, now = _kept(folder), map_hash(drive_map)
    if kept not in ("", now):
        raise SafetyRefusal(
            f"this drive was last written through another map: sha256 {kept[:SHOWN]} then, {now[:SHOWN]} now",
            where=_where(identity),
            likely="the map was edited, or another family's was given",
            hint=f"compare the maps; to accept the new one delete {memory_of(folder)}",
        )


def check_family(drive_map: DriveMap, identity: Identity) -> None:
    """Refuse a drive of another identity than its map's; raises ``ConfigError``, nothing was moved or written."""
    if not drive_map.is_for(*identity.vendor_product):
        raise _other_drive(drive_map, identity)


def check_nodes(drive_map: DriveMap, identities: Sequence[Identity]) -> None:
    """Refuse nodes that are not all of the map's family; raises ``ConfigError``, nothing was moved or written."""
    others = [identity for identity in identities if not drive_map.is_for(*identity.vendor_product)]
    if others and len({identity.vendor_product for identity in identities}) > 1:
        families = [(identity, family_of(*identity.vendor_product)) for identity in identities]
        raise ConfigError(
            f"these nodes are drives of several families, and a set is written through one map, here {drive_map.name}",
            violations=[
                f"node {identity.node}: {identity.name}, {f'map {found.name}' if found else 'no shipped map'}"
                for identity, found in families
            ],
            hint="name with --nodes those of one family, and its map with --map; nothing was moved or written",
        )
    for identity in others:
        raise _other_drive(drive_map, identity)


def check_motion(drive_map: DriveMap, identity: Identity) -> None:
    """Refuse to move a drive through the map of another; nothing was moved or written.

    What CiA 402 alone says (the shipped map of :data:`GENERIC`) holds on every drive.

    Raises ConfigError: the map is for another identity, or is no shipped one and says none.
    """
    named = drive_map.vendor != UNKNOWN_VENDOR and drive_map.is_for(*identity.vendor_product)
    if not named and (drive_map.whole or drive_map) != load_family(GENERIC):
        raise _other_drive(drive_map, identity)


def other_drive(drive_map: DriveMap, vendor: int, product: int, doubt: str = "") -> str:
    """Return how a map and a drive differ, empty when the map names the drive."""
    if drive_map.vendor == UNKNOWN_VENDOR:
        return f"the map {drive_map.name!r} does not state whose drive it is for (vendor 0)"
    if drive_map.is_for(vendor, product):
        return doubt
    return (
        f"the map {drive_map.name!r} is for vendor {drive_map.vendor:#010x} product {drive_map.product:#x}, "
        f"the drive is vendor {vendor:#010x} product {product:#x}"
    )


def unknown_firmware(drive_map: DriveMap, identity: Identity) -> str:
    """Say that no source of the map describes the drive's firmware, empty where one does, or nothing is scaled."""
    rows = drive_map.identity
    if drive_map.staging or not drive_map.scales or identity.revision >> 16 in rows.revisions:
        return ""
    known = ", ".join(f"{number:#06x}" for number in rows.revisions)
    source = one_line(drive_map.sources[rows.source], SOURCE_LETTERS) if known else ""
    says = f"describe {known} ({rows.source}: {source})" if known else "do not say for which"
    return (
        f"firmware {identity.revision:#010x} (0x1018:03) of family {drive_map.name}: the map's sources {says}; "
        "compare types and units with your manual"
    )


def map_on(node: DriveNode) -> DriveMap:
    """Return a node's map less the rows whose object the drive does not show, or holds in another size, each told.

    The reference drive shows the layout of its set instead.
    """
    gone: dict[str, str] = {}
    for cell in () if node.map.staging else node.map.cells.values():
        why = _not_there(node, cell) and _not_there(node, cell)  # twice: one answer may be damaged
        if why:
            source = f"source {cell.source!r}" if cell.source else "no source stated"
            gone[cell.name] = f"{why} ({cell.wire} in the map {node.map.name!r}, {source})"
    return node.map.without(gone) if gone else node.map


def _not_there(node: DriveNode, cell: Cell) -> str:
    """Return why a row is not the drive's; empty where its object is there, in the size that the map states."""
    where = f"0x{cell.index:04X}:{cell.sub:02X}"
    node.sdo.usual_lengths.setdefault((cell.index, cell.sub), cell.size)
    try:
        size = len(node.sdo.upload(cell.index, cell.sub).data)
    except SdoAbort as abort:
        if abort.code not in NOT_READ:
            raise
        return f"the drive {'shows nothing in' if abort.code == AbortCode.WRITE_ONLY else 'has no object'} {where}"
    return "" if size == cell.size else f"the drive holds {counted(size, 'byte')} in {where}"


def _other_drive(drive_map: DriveMap, identity: Identity) -> ConfigError:
    """Return the refusal, with what leads on."""
    vendor, product = identity.vendor, identity.product
    if drive_map.staging and family_of(vendor, product) is None:  # nobody gave it: it is the default
        return unnamed_drive(
            vendor,
            product,
            where=_where(identity),
            hint="enter the gains of design.toml with the maker's own tool, or write a map with the rows that its "
            "manual documents and give it with --map; to copy a drive that is set up: `pmsmtool backup --eds FILE`, "
            "then `pmsmtool restore --other-drive`; nothing was moved or written",
        )
    if identity.doubt:
        hint = "if it is one after all, give --map with a copy of the map whose [identity] names it"
    elif drive_map.vendor == vendor == UNKNOWN_VENDOR:
        hint = "this drive names no vendor either: nothing can be written to it"
    elif drive_map.vendor == UNKNOWN_VENDOR:
        hint = f"copy it, write vendor = {vendor:#010x}, product = {product:#010x}, give it with --map"
    else:
        shipped = family_of(vendor, product)
        hint = f"give --map {shipped.name}" if shipped else "give the map of this drive with --map"
    return ConfigError(
        other_drive(drive_map, vendor, product, identity.doubt),
        where=_where(identity),
        likely="the map of another drive was given, or another drive answers on this node",
        hint=f"{hint}; nothing was moved or written",
    )


def _where(identity: Identity) -> str:
    return f"node {identity.node}, 0x1018"


def forget_map(folder: JournalFolder) -> None:
    """Forget the map a drive was written through: it starts from factory memory."""
    memory_of(folder).unlink(missing_ok=True)


def remember_map(drive_map: DriveMap, folder: JournalFolder) -> None:
    """Note the map a drive is written through."""
    if drive_map.staging or not drive_map.scales:
        return
    path = memory_of(folder)
    make_folder(path.parent, hint=ELSEWHERE)
    text = json.dumps({"map": drive_map.name, "sha256": map_hash(drive_map)}) + "\n"
    write_file(path, text, synced=True, hint=ELSEWHERE)


def _kept(folder: JournalFolder) -> str:
    path = memory_of(folder)
    if not path.exists():
        return ""
    text = read_text(path)
    try:
        return str(json.loads(text)["sha256"])
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ConfigError(
            f"damaged: {error}", where=str(path), hint="delete it if the map in use is the right one"
        ) from error
