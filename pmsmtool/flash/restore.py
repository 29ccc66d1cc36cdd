# SPDX-License-Identifier: MIT
"""Backups of a drive, and plans that bring one back."""

from __future__ import annotations

import datetime
import math
from collections.abc import Mapping
from dataclasses import replace

from pmsmtool.bus.sdo import Mode
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.motion_objects import held_current_limits, rated_apk
from pmsmtool.drive.parameters import DriveParameters, Progress
from pmsmtool.drive.port import Identity
from pmsmtool.drive_maps.drive_map import DriveMap, address_in
from pmsmtool.errors import ConfigError, NotAvailable, Partial, SafetyRefusal, SdoAbort
from pmsmtool.flash.download import Outcome, stored
from pmsmtool.flash.journal import MARKS, Entry, JournalFolder, Snapshot
from pmsmtool.flash.map_gate import map_on
from pmsmtool.flash.plan import Change, Plan, make_plan, names_to_read
from pmsmtool.flash.whole_drive import parameters_of
from pmsmtool.params.catalogue import BY_NAME
from pmsmtool.params.parameter_set import ParameterSet, table_unit
from pmsmtool.plain_text import counted

CONFIGURATION_EPOCH = datetime.date(1984, 1, 1)
"""Day 0 of object 0x1020:01 (CiA 301, section 7.5.2.21)."""
DESIGN_ID_BYTES = 8
_MARK_NAMES = frozenset(name for name, _, _ in MARKS)


def marks_of(content: str, when: datetime.datetime) -> dict[str, bytes]:
    """Return the marks of a set written at a moment.

    Parameters
    ----------
    content : str
        Content hash ``sha256:<hex>`` of the set.
    when : datetime
        Becomes configuration date and time; the drive's users read local time there.
    """
    days = (when.date() - CONFIGURATION_EPOCH).days
    midnight = when.replace(hour=0, minute=0, second=0, microsecond=0)
    milliseconds = (when - midnight) // datetime.timedelta(milliseconds=1)
    return {
        "design_id": bytes.fromhex(content.removeprefix("sha256:"))[:DESIGN_ID_BYTES],
        "configuration_date": days.to_bytes(4, "little"),
        "configuration_time": milliseconds.to_bytes(4, "little"),
    }


def plan_download(node: DriveNode, wanted: ParameterSet) -> Plan:
    """Read what a drive holds and return the plan that brings it to a set; nothing is written.

    Raises NotAvailable: the drive's parameter set has another layout than this program's; ConfigError: values out of
    bounds, or that do not fit the drive's types.
    """
    parameters = _settled(node)
    held = map_on(node)
    return make_plan(held, wanted, parameters.read(names_to_read(held, wanted)))


def tell_lacking(node: DriveNode, plan: Plan) -> None:
    """Raise Partial where values of a set have a row in the map and no object on this drive."""
    rows = (name for name in plan.missing if name in node.map.cells and name not in plan.kept)
    lacking = [f"{name}: {plan.reasons[name]}" for name in rows if name in plan.reasons]
    if lacking:
        raise Partial(
            f"{counted(len(lacking), 'value')} with a row in the map {node.map.name!r} left out on this drive",
            where=f"node {node.node}", missing=lacking,
            hint="correct the rows in a copy of the map for this drive, and give it with --map",
        )  # fmt: skip


def plan_restore(node: DriveNode, snapshot: Snapshot) -> Plan:
    """Read what a drive holds and return the plan that brings a snapshot's old contents back."""
    node.sdo.usual_lengths |= {(entry.index, entry.sub): len(entry.old) for entry in snapshot.entries if entry.old}
    return restore_plan(node.map, snapshot, _settled(node).read(names_of(snapshot)))


def _settled(node: DriveNode) -> DriveParameters:
    parameters = parameters_of(node)
    parameters.check_layout()
    parameters.settle()
    return parameters


def take_backup(node: DriveNode, identity: Identity, *, progress: Progress = lambda done, total: None) -> Snapshot:
    """Read every parameter, table and mark of a drive. Raises NotAvailable: there is none that its map names."""
    parameters = _settled(node)
    held = map_on(node)
    if not (held.cells or held.tables):
        raise NotAvailable(
            f"the map {held.name!r} names no parameter that this drive has: there is nothing to save",
            where=f"node {node.node}", hint="`pmsmtool backup --eds FILE` saves every setting of its maker's file",
        )  # fmt: skip
    found = parameters.read([*held.cells, *held.tables], progress=progress)
    entries = [Entry(name, *node.map.address(name), data) for name, data in found.items()]
    for name, index, sub in MARKS:
        if name == "design_id" and not node.map.staging:
            continue  # 0x2000 is another maker's own object
        try:
            entries.append(Entry(name, index, sub, node.sdo.upload(index, sub, mode=Mode.SEGMENTED).data))
        except SdoAbort:
            continue  # the drive does not keep this mark
    content = snapshot_set(node.map, entries).content_hash()
    limit = None if node.map.staging else _current_limit(node)
    return Snapshot("backup", "done", identity, node.map.signature, content, tuple(entries), limit)


def _current_limit(node: DriveNode) -> float | None:
    """Return the smallest limit of the current that a drive holds (A peak); None where its unit is not known."""
    try:
        held = held_current_limits(node, rated_apk(node))
    except NotAvailable:
        return None
    return min((apk for _, apk in held if 0.0 < apk < math.inf), default=None)


def snapshot_set(
    drive_map: DriveMap, entries: list[Entry] | tuple[Entry, ...], given: Mapping[str, float] | None = None
) -> ParameterSet:
    """Return the old contents of a snapshot as a parameter set; ``given`` as of ``DriveMap.decode``."""
    known = {e.name: e.old for e in entries if e.name in drive_map.cells or e.name in drive_map.tables}
    return drive_map.decode(known, given)


def old_marks(snapshot: Snapshot) -> dict[str, bytes]:
    """Return the marks a snapshot holds."""
    return {entry.name: entry.old for entry in snapshot.entries if entry.name in _MARK_NAMES}


def check_snapshot(drive_map: DriveMap, snapshot: Snapshot, identity: Identity, *, other_drive: bool = False) -> None:
    """Refuse a snapshot that is not of this drive.

    Raises ConfigError: another product, another layout, objects the map does not know, or another serial number.

    Parameters
    ----------
    other_drive : bool
        Another serial number of the same product is wanted (a spare part).
    """
    theirs = snapshot.identity
    if (theirs.vendor, theirs.product) != (identity.vendor, identity.product):
        raise ConfigError(
            f"the snapshot is of vendor {theirs.vendor:#010x} product {theirs.product:#010x}, "
            f"the drive is vendor {identity.vendor:#010x} product {identity.product:#010x}",
            hint="give a snapshot of this kind of drive",
        )
    if identity.vendor == 0 and theirs.name != identity.name:
        raise ConfigError(
            f"drive and snapshot name no vendor, and the drive calls itself {identity.name!r}, not {theirs.name!r}",
            where=f"node {identity.node}, 0x1008",
            hint="give a snapshot of this kind of drive",
        )
    if theirs.serial != identity.serial and not other_drive:
        raise ConfigError(
            f"the snapshot is of the drive with serial number {theirs.serial}, this one is {identity.serial}",
            hint="--other-drive when it shall go into this drive (a spare part)",
        )
    if drive_map.staging and snapshot.signature != drive_map.signature:
        raise ConfigError(
            f"the snapshot's layout {snapshot.signature:#010x} is not this program's {drive_map.signature:#010x}",
            likely="it was taken by another version of pmsmtool",
            hint="restore it with that version",
        )
    wrong = [text for entry in snapshot.entries if (text := _strange(drive_map, entry))]
    if wrong:
        raise ConfigError(
            "the drive's map lacks objects of the snapshot",
            likely="it was taken through another map",
            hint="give the map that the snapshot was taken through with --map",
            violations=wrong,
        )


def _strange(drive_map: DriveMap, entry: Entry) -> str:
    """Return what else the map states about an entry's name, object or size; empty when it agrees."""
    if entry.name in _MARK_NAMES:
        expected = next((index, sub) for name, index, sub in MARKS if name == entry.name)
    elif entry.name in drive_map.cells or entry.name in drive_map.tables:
        expected = drive_map.address(entry.name)
    elif not drive_map.scales and (address := address_in(entry.name)) is not None:
        expected = address
    else:
        return f"{entry.name}: is not in the map"
    if (entry.index, entry.sub) != expected:
        return (
            f"{entry.name}: is 0x{entry.index:04X}:{entry.sub:02X}, "
            f"the map states 0x{expected[0]:04X}:{expected[1]:02X}"
        )
    size = drive_map.cells[entry.name].size if entry.name in drive_map.cells else len(entry.old)
    return "" if len(entry.old) == size else f"{entry.name}: has {len(entry.old)} bytes, the map states {size}"


def restore_plan(drive_map: DriveMap, snapshot: Snapshot, found: Mapping[str, bytes]) -> Plan:
    """Return the plan that brings the old contents of a snapshot back, byte for byte."""
    wanted = snapshot_set(drive_map, snapshot.entries).values
    before = drive_map.decode({name: data for name, data in found.items() if name in drive_map.cells}).values
    entries = []
    for entry in snapshot.entries:
        if entry.name in _MARK_NAMES:
            continue
        scalar = entry.name in drive_map.cells
        value = wanted.get(entry.name, math.nan)  # none of gains in amperes, or per increment, of unknown size
        old_value = before.get(entry.name, math.nan)
        by_address = address_in(entry.name) is not None
        unit = BY_NAME[entry.name].unit if scalar else "" if by_address else table_unit(entry.name)
        change = Change(entry.name, entry.index, entry.sub, found[entry.name], entry.old, old_value, value, value, unit)
        entries.append(change)
    return Plan(tuple(entries), {}, snapshot.content)


def due_of_journal(snapshot: Snapshot, plan: Plan, folder: JournalFolder) -> Plan:
    """Return what of the last journal's plan is due: nothing where a later download was killed before it wrote.

    Raises SafetyRefusal: the journal is finished, and the drive was written otherwise since: its old set is more than
    one download back.
    """
    if snapshot.state == "open" or not plan.changes:
        return plan
    if folder.was_preparing:
        return replace(plan, entries=())
    reached = {(entry.index, entry.sub): entry.new for entry in snapshot.entries}
    if snapshot.state == "done" and all(change.old == reached[change.index, change.sub] for change in plan.entries):
        return plan
    raise SafetyRefusal(
        "the last download to this drive is finished, and the drive holds neither its old nor its new set",
        where=str(folder.path),
        likely="another program or account wrote since, or values wait for a reset",
        hint=f"`pmsmtool restore {folder.path}` brings back what it held before that download; nothing was written",
    )


def nothing_written(node: DriveNode, plan: Plan, folder: JournalFolder) -> Outcome:
    """Return the outcome of a plan without a change that is left alone; the drive is only read."""
    crc = DriveParameters(node).crc_active if node.map.staging else None
    return Outcome(0, len(plan.entries), stored(node, plan, folder), crc, node.sdo.retries, 0)


def names_of(snapshot: Snapshot) -> tuple[str, ...]:
    """Return the parameters and tables of a snapshot."""
    return tuple(entry.name for entry in snapshot.entries if entry.name not in _MARK_NAMES)
