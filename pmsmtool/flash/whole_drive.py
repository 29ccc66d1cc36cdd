# SPDX-License-Identifier: MIT
"""A drive saved and brought back object by object, byte for byte: no unit is involved, so no map is needed.

Which objects there are is said by the maker's data sheet. That says not which of them are settings: commands, set
points, outputs and what belongs to one device alone are left out by the rules below. An entry's name begins with its
address. One refused object takes nothing of the others along: it is named.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.sdo import SdoChannel
from pmsmtool.drive import objects
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.parameters import DriveParameters, Progress
from pmsmtool.drive.port import Identity
from pmsmtool.drive_maps.drive_map import DriveMap, address_in
from pmsmtool.drive_maps.eds import Eds, parse_eds, parse_integer
from pmsmtool.errors import ConfigError, Partial, SdoAbort
from pmsmtool.files import read_bytes
from pmsmtool.flash.journal import MARKS, Entry, Snapshot

ROUNDS = 3
"""An object may be refused until another one is written (limits of each other), or be changed by it."""
OWN_MAKERS = 0x2000
"""First index of the makers' and the profile's objects; below it stands communication."""
PDO_OFF = 0x8000_0000
"""Bit 31 of a PDO's identifier: it does not exist (CiA 301, 7.5.2.35)."""
_COUNTED_AT = 0x200
"""From the communication record of a PDO to its mapping record."""
_NODE_BITS, _FUNCTION_BITS = 0x7F, 0x780
"""Of an identifier of the pre-defined connection set (CiA 301, 7.3.5)."""

ABSENT, UNREAD = "this drive does not have it, or only takes it", "the drive does not let it be read"
"""Why an object of the data sheet is not saved; of the second kind something is missing in the backup."""
_ABSENT = frozenset({AbortCode.NO_OBJECT, AbortCode.NO_SUBINDEX, AbortCode.WRITE_ONLY})
_FLAGGED = "its file says that no backup reads or no download writes it (ObjFlags)"
_COMMAND, _SET_POINT = "a command", "a set point"
_BY_INDEX: Mapping[int, str] = {
    **dict.fromkeys((0x1003, 0x1010, 0x1011, 0x1013, *range(0x1023, 0x1027), 0x6040), _COMMAND),
    **dict.fromkeys(range(0x1F50, 0x1F58), "firmware download"),
    **dict.fromkeys((0x6042, 0x6071, 0x607A, 0x60B0, 0x60B1, 0x60B2, 0x60C1, 0x60FF), _SET_POINT),
    **dict.fromkeys((*range(0x6061, 0x6065), 0x606B, 0x606C, 0x6077, 0x6078, 0x6079), "shown by the drive"),
    0x1018: "of one device alone",
    0x1020: "the date of the configuration, written last",
    0x60FE: "outputs, which may open a brake",
}
_BY_NAME: tuple[tuple[re.Pattern[str], str], ...] = (
    (re.compile(r"\bserial\b", re.IGNORECASE), "of one device alone"),
    (re.compile(r"\bnode[ _-]?id\b", re.IGNORECASE), "of one device alone"),
    (re.compile(r"(control ?word|\bcontrol)$", re.IGNORECASE), _COMMAND),
    (re.compile(r"\b(setting|demand) value$", re.IGNORECASE), _SET_POINT),
)
"""Of the makers' own objects, whose names alone are public: EPOS2 starts its auto-tuning by one named "... Control"."""


@dataclass(frozen=True, slots=True)
class Listed:
    """An object that the data sheet says can be read and written; ``copied``: also by a backup and a download.

    ``size``: bytes of its type, 0 where they are not fixed.
    """

    index: int
    sub: int
    name: str
    copied: bool = True
    size: int = 0

    @property
    def label(self) -> str:
        """Address and name, by which a backup calls it."""
        return f"0x{self.index:04X}:{self.sub:02X} {self.name}".rstrip()


def kept_objects(listed: Iterable[Listed]) -> tuple[tuple[Listed, ...], dict[str, str]]:
    """Return the settings in the order they are written, and why each other object is left out, by its label.

    The machine's objects come first, communication last: a wrong step there may end the conversation.
    """
    kept, left_out = [], {}
    for item in listed:
        reason = _BY_INDEX.get(objects.on_first_axis(item.index), "") or ("" if item.copied else _FLAGGED)
        if not reason and item.index >= OWN_MAKERS:
            reason = next((why for pattern, why in _BY_NAME if pattern.search(item.name)), "")
        if reason:
            left_out[item.label] = reason
        else:
            kept.append(item)
    return tuple(sorted(kept, key=lambda item: _order(item.index, item.sub))), left_out


def _order(index: int, sub: int) -> tuple[bool, int, int]:
    return index < OWN_MAKERS, index, sub


def whole_map(identity: Identity) -> DriveMap:
    """Return a map of this very drive that scales nothing."""
    return DriveMap("objects by address", identity.vendor, identity.product, {})


def is_whole(snapshot: Snapshot) -> bool:
    """Whether a snapshot holds objects by address."""
    return any(address_in(entry.name) is not None for entry in snapshot.entries)


def take_whole_backup(
    node: DriveNode, identity: Identity, listed: Iterable[Listed], *, progress: Progress = lambda done, total: None
) -> tuple[Snapshot, dict[str, str]]:
    """Read every setting that the data sheet lists.

    Returns
    -------
    snapshot : Snapshot
        A backup in the order of writing, then the marks.
    left_out : dict of str to str
        Why, by label: what is no setting, and what this drive does not have or does not let be read.
    """
    kept, left_out = kept_objects(listed)
    entries = []
    for count, item in enumerate(kept, 1):
        if item.size:
            node.sdo.usual_lengths[item.index, item.sub] = item.size
        try:
            entries.append(Entry(item.label, item.index, item.sub, node.sdo.upload(item.index, item.sub).data))
        except SdoAbort as abort:
            left_out[item.label] = ABSENT if abort.code in _ABSENT else f"{UNREAD}: {abort.what}"
        progress(count, len(kept))
    content = hashlib.sha256(b"".join(entry.name.encode() + entry.old for entry in entries)).hexdigest()
    for name, index, sub in MARKS[1:]:
        try:
            entries.append(Entry(name, index, sub, node.sdo.read(index, sub)))
        except SdoAbort:
            continue  # the drive does not keep this mark
    return Snapshot("backup", "done", identity, 0, f"sha256:{content}", tuple(entries)), left_out


def require_read(left_out: Mapping[str, str], path: Path) -> None:
    """Make sure that a backup lacks nothing that the drive has.

    Raises Partial: an object could not be read; each is named.
    """
    unread = [f"{label}: {why}" for label, why in left_out.items() if why.startswith(UNREAD)]
    if unread:
        raise Partial(
            f"objects that are not in the backup: {len(unread)}", where=str(path), missing=unread,
            hint="run the command again; what stays is set by the maker's own tool",
        )  # fmt: skip


def readdressed(snapshot: Snapshot, node: int) -> Snapshot:
    """Return the snapshot for a drive of another node id: identifiers of the pre-defined connection set follow it."""
    before = snapshot.identity.node
    if node == before:
        return snapshot
    return replace(snapshot, entries=tuple(_readdressed(entry, before, node) for entry in snapshot.entries))


def _readdressed(entry: Entry, before: int, node: int) -> Entry:
    pdo = _pdo_of(entry.index)
    identifier = entry.index == 0x1014 or (entry.sub == 1 and pdo is not None and entry.index == pdo)
    word = int.from_bytes(entry.old, "little")
    if not identifier or len(entry.old) != 4 or word & _NODE_BITS != before or not word & _FUNCTION_BITS:
        return entry
    return replace(entry, old=(word & ~_NODE_BITS | node).to_bytes(4, "little"))


def _pdo_of(index: int) -> int | None:
    """Return the communication record of the PDO an object belongs to, None for others."""
    for first in (0x1400, 0x1800):
        if first <= index < first + 2 * _COUNTED_AT:
            return index if index < first + _COUNTED_AT else index - _COUNTED_AT
    return None


class WholeDrive(DriveParameters):
    """Access to the objects of one drive by their addresses.

    Attributes
    ----------
    refused : dict of str to str
        What the drive did not take, or takes and does not keep, and why.
    """

    def __init__(self, node: DriveNode) -> None:
        super().__init__(node)
        self.refused: dict[str, str] = {}

    def read(self, names: Iterable[str], *, progress: Progress = lambda done, total: None) -> dict[str, bytes]:
        """Return the bytes of objects by name; empty where the drive does not let one be read."""
        wanted, found = tuple(names), {}
        for count, name in enumerate(wanted, 1):
            try:
                found[name] = self.node.sdo.upload(*self.map.address(name)).data
            except SdoAbort:
                found[name] = b""
            progress(count, len(wanted))
        return found

    def replace(self, new: Mapping[str, bytes], *, progress: Progress = lambda done, total: None) -> None:
        """Write what differs and read it back, again where others stood in its way; :attr:`refused` names the rest."""
        wanted = {name: data for name, data in new.items() if data}  # an object that was not there cannot come back
        due = self._different(wanted)
        for _ in range(ROUNDS):
            if self.node.before_write is not None:
                for name in due:
                    self.node.before_write(*self.map.address(name), wanted[name])
            self._write_in_order(due, wanted)
            progress(len(wanted) - len(due), len(wanted))
            before, due = due, self._different(wanted)
            if not due or due == before:
                break
        for name in [name for name in self.refused if name in wanted and name not in due]:
            del self.refused[name]
        for name, data in due.items():
            self.refused.setdefault(name, f"wrote {data[:8].hex(' ')}, reads something else")

    def _different(self, wanted: Mapping[str, bytes]) -> dict[str, bytes]:
        found = self.read(wanted)
        return {name: data for name, data in wanted.items() if found[name] != data}

    def _write_in_order(self, due: Mapping[str, bytes], wanted: Mapping[str, bytes]) -> None:
        places = {name: self.map.address(name) for name in wanted}
        pdos = {pdo for name in due if (pdo := _pdo_of(places[name][0])) is not None}
        for name in sorted(due, key=lambda name: _order(*places[name])):
            if _pdo_of(places[name][0]) is None:
                self._write(name, *places[name], due[name])
        for pdo in sorted(pdos):
            held = {places[name]: name for name in wanted if _pdo_of(places[name][0]) == pdo}
            self._write_pdo(pdo, held, due, wanted)

    def _write_pdo(
        self, pdo: int, held: Mapping[tuple[int, int], str], due: Mapping[str, bytes], wanted: Mapping[str, bytes]
    ) -> None:
        """Switch the PDO off, empty its mapping, fill it, switch it on (CiA 301, 7.5.2.36)."""
        sdo = self.node.sdo
        switch, count = (pdo, 1), (pdo + _COUNTED_AT, 0)
        last: list[tuple[tuple[int, int], bytes]] = []
        for place, emptied in ((switch, None), (count, b"\0")):
            now = _read_or_none(sdo, place)
            if now is None:
                continue
            last.insert(0, (place, wanted[held[place]] if place in held else now))
            data = (int.from_bytes(now, "little") | PDO_OFF).to_bytes(4, "little") if emptied is None else emptied
            if place == count and not any(at[0] == count[0] and held[at] in due for at in held):
                last.pop(0)  # the mapping stays as it is
            elif data != now:
                self._write(f"0x{place[0]:04X}:{place[1]:02X}", *place, data, note=False)
        for place in sorted(held):
            if place not in (switch, count) and held[place] in due:
                self._write(held[place], *place, due[held[place]])
        for place, data in last:
            self._write(held.get(place, ""), *place, data, note=place in held)

    def _write(self, name: str, index: int, sub: int, data: bytes, *, note: bool = True) -> None:
        try:
            self.node.sdo.download(index, sub, data)
        except SdoAbort as abort:
            if note:
                self.refused[name] = abort.what
        else:
            self.refused.pop(name, None)


def _read_or_none(sdo: SdoChannel, place: tuple[int, int]) -> bytes | None:
    try:
        return sdo.read(*place)
    except SdoAbort:
        return None


def parameters_of(node: DriveNode) -> DriveParameters:
    """Return the access that fits the node's map: by catalogue name, or by address where it scales nothing."""
    return DriveParameters(node) if node.map.scales else WholeDrive(node)


def _stated_vendor(sheet: Eds) -> int | None:
    """Return the vendor in the file's own 0x1018; makers leave [DeviceInfo] as a template had it."""
    item = sheet.objects.get((objects.IDENTITY, 1))
    try:
        return None if item is None else parse_integer(item.value or item.default or "0")
    except ValueError:
        return None


def other_product(eds: str, identity: Identity) -> str:
    """Return a warning where a data sheet is for another product than the drive; empty where it is not, or a table.

    Raises ConfigError: it is for another vendor.
    """
    if eds.partition("#")[0].lower().endswith(".csv"):
        return ""
    sheet = parse_eds(read_bytes(Path(eds)), eds)
    if sheet.vendor and identity.vendor not in (sheet.vendor, _stated_vendor(sheet)):
        raise ConfigError(
            f"the file is for vendor {sheet.vendor:#010x}, the drive is of vendor {identity.vendor:#010x}", where=eds,
            likely="the file of another maker was given, or another drive answers on this node",
            hint="give the EDS or DCF of this drive; nothing was saved",
        )  # fmt: skip
    if not sheet.product or sheet.product == identity.product:
        return ""
    return (
        f"{eds} is for product {sheet.product:#x}, the drive is product {identity.product:#x}: objects that the file "
        "lacks are not saved"
    )
