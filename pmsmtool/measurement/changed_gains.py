# SPDX-License-Identifier: MIT
"""Gains of a connected drive that ``map learn`` changes by a known ratio: where they are, and how they come back.

The journal is on disk before the first change; every change happens with the voltage off; the first one is a step
down. The drive holds its own gains again when this ends, and the next connection sees to it where this cannot.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

from pmsmtool.drive.drive_node import NOT_READ, DriveNode
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.guard import GuardedDrive, guarded
from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive.torque_drives import TorqueDrive
from pmsmtool.drive_maps.drive_map import LETTERS, Cell, DriveMap
from pmsmtool.errors import IdentificationError, NotAvailable, PmsmtoolError, SafetyRefusal, SdoAbort
from pmsmtool.flash.gain_journal import GainJournal
from pmsmtool.flash.journal import Entry

GAIN, INTEGRAL = "speed.K_p_nms_per_rad", "speed.K_i_nm_per_rad"
STANDARD = {GAIN: (0x60F9, 1), INTEGRAL: (0x60F9, 2)}
"""Where CiA 402 puts the gains of the speed loop; what one count is worth it leaves to the maker."""
ADDRESS = re.compile(r"0x([0-9A-F]{4}):([0-9A-F]{2})")
RANGE = re.compile(r"\((\d+)\.\.(\d+)\)")
"""Smallest and largest count of them, where such a reason has it: "0x2331:01 (1..255) has no unit ..."."""
HOLDS = re.compile(r" (?:has|holds) ")
"""Reasons why a map leaves a gain out begin with its objects: "0x2331:01 or 0x60F9:01 has no unit ..."."""
BACK = "the next `pmsmtool` command that opens this drive restores them, and so does a reset"
DOWN = 0.7
"""First change of a gain."""
COARSEST = 0.12
"""Largest deviation of a ratio in whole counts from the one wanted."""
FLOATS_FROM = 0x20000000
"""Whole number from which four bytes of unknown type are rather a REAL32: 0.7 of its bits would be another gain."""


@dataclass(frozen=True, slots=True)
class GainObject:
    """Where the drive keeps a gain, and what it held before."""

    name: str
    item: DriveObject
    counts: float
    limits: tuple[float, float] = (-math.inf, math.inf)
    """Smallest and largest count that it takes, as far as its map says so."""

    @property
    def address(self) -> str:
        """Index and sub-index."""
        return f"0x{self.item.index:04X}:{self.item.sub:02X}"


Put = Callable[[GainObject, float], None]
"""Stops the drive, notes counts of a gain in the journal, and writes them."""
Seen = TypeVar("Seen")


def gain_address(node: DriveNode, name: str) -> tuple[int, int]:
    """Return where a drive keeps a gain: by its map, by what the map says of a gain without unit, else by CiA 402.

    Raises NotAvailable: the drive has none of these objects.
    """
    if name in node.map.cells:
        return node.map.address(name)
    told = named_addresses(node.map, name)
    for address in (*told, STANDARD[name]):
        if node.has(*address):
            return address
    known = " or ".join(f"0x{index:04X}:{sub:02X}" for index, sub in dict.fromkeys((*told, STANDARD[name])))
    raise NotAvailable(
        f"no object of this drive is known to hold {name}: it has no {known}", where=f"node {node.node}",
        hint=f"where its manual names one: `pmsmtool map learn {name}=0xINDEX:SUB`",
    )  # fmt: skip


def named_addresses(drive_map: DriveMap, name: str) -> list[tuple[int, int]]:
    """Return the objects that the map of a drive names for a gain whose unit nobody publishes."""
    return [(int(index, 16), int(sub, 16)) for index, sub in ADDRESS.findall(_told(drive_map, name))]


def _told(drive_map: DriveMap, name: str) -> str:
    return HOLDS.split(drive_map.left_out.get(name, ""))[0]


def _limits(node: DriveNode, name: str, cell: Cell | None) -> tuple[float, float]:
    if cell is not None:
        return cell.low, cell.high
    told = RANGE.search(_told(node.map, name))
    return (float(told[1]), float(told[2])) if told else (-math.inf, math.inf)


def gain_object(node: DriveNode, name: str, index: int, sub: int, *, may_be_zero: bool = False) -> GainObject:
    """Return the object of a gain, its type by the map, else by its size.

    Raises NotAvailable: the drive has no such object, or its type is not known, or it is too small to be changed by a
    known ratio.
    """
    cell = node.map.cells.get(name)
    wire = LETTERS[cell.wire] if cell is not None and (cell.index, cell.sub) == (index, sub) else None
    where = f"node {node.node}, 0x{index:04X}:{sub:02X}"
    try:
        data = node.sdo.read(index, sub)
    except SdoAbort as abort:
        if abort.code not in NOT_READ:
            raise
        raise NotAvailable(
            f"{name}: the drive has no such object", where=where,
            hint=f"name the one that its manual calls this gain: `pmsmtool map learn {name}=0xINDEX:SUB`",
        ) from abort  # fmt: skip
    letter = wire or {1: "B", 2: "H", 4: "I"}.get(len(data), "")
    if not letter or DriveObject(index, sub, letter).size != len(data):
        raise NotAvailable(f"{name}: {len(data)} bytes are no number that this program changes", where=where)
    item = DriveObject(index, sub, letter)
    held = item.decode(data)
    if wire is None and held >= FLOATS_FROM:
        raise NotAvailable(
            f"{name}: its bytes {data.hex()} may be a whole number or a REAL32", where=where,
            hint="give the object with its type in a map: --map FILE",
        )  # fmt: skip
    found = GainObject(name, item, held, _limits(node, name, cell))
    if not may_be_zero:
        changed_counts(found, DOWN)
    return found


def changed_counts(gain: GainObject, ratio: float) -> float:
    """Return counts in about a ratio to those held: whole ones, but of a REAL32.

    Raises NotAvailable: whole counts are too coarse for it, or it holds no gain.
    """
    counts = gain.counts * ratio
    if gain.item.letter == "f":
        counts = gain.item.decode(gain.item.encode(counts))
    else:
        signed = (1 << 8 * gain.item.size - 1) - 1
        counts = round(counts)
        if gain.counts <= signed:  # nothing says whether the object has a sign
            counts = min(counts, signed)
    if not 0.0 < gain.counts < math.inf or not 1.0 - COARSEST < counts / (gain.counts * ratio) < 1.0 + COARSEST:
        raise NotAvailable(
            f"{gain.name} holds {gain.counts:.9g}: it cannot be changed by {ratio:g}", where=gain.address
        )
    return counts


def while_changed(
    gain: GainObject,
    ratio: float,
    guard: GuardedDrive,
    put: Put,
    notes: list[str],
    observe: Callable[[str, float], Seen],
) -> Seen | None:
    """Change one gain while the voltage is off, observe, and bring it back; None, and why in ``notes``, where not.

    ``observe`` takes a name for what it observes, and the counts of the gain.
    """
    try:
        new = changed_counts(gain, ratio)
    except NotAvailable as error:
        notes.append(f"{gain.name}: {error.what}")
        return None
    try:
        put(gain, new)
    except SdoAbort as abort:
        notes.append(f"{gain.name}: the drive does not take {new:.9g}: {abort.what}")
        guard.enable()
        return None
    guard.enable()
    found = None
    try:
        found = observe(f"{gain.address} {gain.counts:.9g} -> {new:.9g}", new)
    except IdentificationError as error:
        notes.append(f"{gain.name}: {error.what}")
    put(gain, gain.counts)  # after anything else the guard does it, and nothing is enabled again
    guard.enable()
    return found


def refuse_unsafe(node: DriveNode, envelope: Envelope) -> None:
    """Refuse what rules out a change of gains: a drive that saves by itself, a coupled shaft, gravity, a turning shaft.

    Raises SafetyRefusal: with what it is.
    """
    if envelope.shaft != "free" or envelope.load != "none":
        raise SafetyRefusal(
            f"gains are changed only with a free shaft and no load; given are shaft {envelope.shaft}, load "
            f"{envelope.load}",
            where=f"node {node.node}", hint="uncouple the machine, then give --shaft free",
        )  # fmt: skip
    for sub in (1, 2, 3):
        word = node.held(DriveObject(0x1010, sub, "I"))
        if word is not None and int(word) & 2:
            raise SafetyRefusal(
                "the drive stores parameters by itself: a changed gain would survive", hint="learn it on another drive",
                where=f"node {node.node}, 0x1010:{sub:02X} = {int(word):#x}",
            )  # fmt: skip


@contextmanager
def changing(
    drive: TorqueDrive, gains: Sequence[GainObject], envelope: Envelope, say: Callable[[str], None]
) -> Iterator[tuple[GuardedDrive, Put]]:
    """Guard a drive whose gains are changed; on leaving it is off, and holds what it held before."""
    entries = [Entry(gain.name, gain.item.index, gain.item.sub, gain.item.encode(gain.counts)) for gain in gains]
    journal = GainJournal(drive.identity, entries)
    journal.begin()
    try:
        with guarded(drive, envelope, say=say) as guard:

            def put(gain: GainObject, counts: float) -> None:
                data = gain.item.encode(counts)
                guard.quick_stop()
                journal.note(gain.item.index, gain.item.sub, data)
                guard.change(gain.item, data)

            yield guard, put
    except PmsmtoolError:
        try:
            journal.end(drive.node)
        except PmsmtoolError:  # what is not back stays in the journal
            places = ", ".join(gain.address for gain in gains)
            say(f"gains in {places} may be changed: {BACK}")
        raise
    journal.end(drive.node)
