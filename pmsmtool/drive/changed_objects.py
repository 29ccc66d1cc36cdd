# SPDX-License-Identifier: MIT
"""What the guard changes in a drive that it lends: limits are lowered, offsets cleared, and all brought back.

A program that is killed brings nothing back, and what is stored next would keep its lowered limits. So of a drive with
a serial number a file says what is lent, and the next command that opens the drive brings it back.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from pmsmtool.bus.sdo import Mode
from pmsmtool.bus.sdo_transfer import is_busy, when_ready
from pmsmtool.drive import objects
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.drive_node import DriveNode, is_safe
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.motion_objects import Quantity, allowed, current_limits, rated_apk, speed_limits
from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive.port import Identity
from pmsmtool.errors import ConfigError, DriveFault, NotAvailable, SafetyRefusal, SdoAbort, VerifyMismatch
from pmsmtool.files import make_folder, read_text, user_folder, write_file
from pmsmtool.units import format_current, rpm_from_rad_s

_Object = tuple[int, int]
_MARKS: tuple[_Object, ...] = tuple(
    (mark.index, mark.sub) for mark in (objects.CONFIGURATION_DATE, objects.CONFIGURATION_TIME)
)
"""Cleared by every change of another object."""
FOLDER = "lent"
_COMMANDS = frozenset({objects.MODE.index, 0x6071, 0x607A, 0x60FF})
"""The mode a drive wakes up with, which some take from nobody, and targets, which some take only while enabled: the
drive is off by now."""
OFTEN = 8
"""An object that one run gives more values than these is a command: the record then says that it is lent, not what it
holds. A file for every target torque was half the time of a run without PDO, and stood between two commands."""
BUSY_S = 5.0
"""A drive that refuses because it is busy is asked again for so long."""


class ChangedObjects:
    """Notes the content of every object before its first change, and brings it back."""

    def __init__(self, drive: CanopenDrive) -> None:
        self._drive = drive
        self._node = drive.node
        self._before: dict[_Object, bytes] = {}
        self._lent: dict[_Object, list[bytes]] = {}
        self._sure: set[_Object] = set()

    @property
    def left(self) -> list[str]:
        """Addresses of what was changed and is not known to hold its old content again; the marks are none of them."""
        due = self._before.keys() - self._sure - set(_MARKS)
        return [f"0x{index:04X}:{sub:02X}" for index, sub in sorted(due)]

    def begin(self) -> None:
        """Note the marks now, and from now on every object before it is written."""
        self._node.before_write = self._note
        for mark in _MARKS:
            self._note(*mark)

    def held_before(self, item: objects.DriveObject) -> float | None:
        """Return what an object held before it was changed; None where it was not."""
        data = self._before.get((item.index, item.sub))
        return None if data is None else self._node.typed(item).decode(data)

    def restore(self) -> int:
        """Bring back what was changed, read it back, and note nothing more; return how many objects.

        Raises VerifyMismatch: an object does not hold its old content; each is named; SdoAbort: the drive refuses it,
        for being busy longer than ``BUSY_S``.
        """
        self._node.before_write = None
        back: set[_Object] = set()
        when_ready(self._node.connection, lambda: self._bring_back(back), BUSY_S)
        if self._lent and (path := _path_of(self._drive.identity)) is not None:
            path.unlink(missing_ok=True)
        return len(back)

    def _bring_back(self, back: set[_Object]) -> None:
        drive_map = self._node.map
        staged = (*drive_map.cells, *drive_map.tables) if drive_map.staging else ()
        names = {drive_map.address(name): name for name in staged}
        parameters = {names[key]: data for key, data in self._before.items() if key in names}
        others = {key: data for key, data in self._before.items() if key not in names}
        changed = {n: data for n, data in parameters.items() if self._drive.parameters.read([n])[n] != data}
        self._sure |= {drive_map.address(name) for name in parameters.keys() - changed.keys()}
        lines: list[str] = []
        busy: SdoAbort | None = None
        if changed:
            try:
                self._drive.replace(changed)
                back |= {drive_map.address(name) for name in changed}
                self._sure |= back
            except VerifyMismatch as mismatch:  # the limits must get their content all the same
                lines += mismatch.differences
            except DriveFault as fault:
                if is_busy(fault):
                    raise
                lines += fault.what.splitlines()
        for (index, sub), data in reversed(others.items()):  # the marks, which were noted first, last
            try:
                if self._read(index, sub) != data:
                    self._node.sdo.download(index, sub, data)
                    back.add((index, sub))
                if self._read(index, sub) != data:
                    lines.append(f"0x{index:04X}:{sub:02X} does not hold {data[:8].hex(' ')} again")
                else:
                    self._sure.add((index, sub))
            except SdoAbort as abort:
                if index in _COMMANDS:
                    continue
                if is_busy(abort):  # the others get their content all the same
                    busy = abort
                    continue
                lines.append(f"0x{index:04X}:{sub:02X}: {abort.what}")
        if busy is not None:
            raise busy
        if lines:
            raise VerifyMismatch(
                "not everything could be restored",
                where=f"node {self._node.node}",
                differences=lines,
                hint="reset the drive: it comes back with what it has stored",
            )

    def _note(self, index: int, sub: int, data: bytes = b"") -> None:
        if (index, sub) not in self._before:
            try:
                self._before[index, sub] = self._read(index, sub)
            except SdoAbort:
                return  # cannot be read, so it cannot be restored; nothing the guard writes is of that kind
        if data and not self._node.map.staging:
            # before it is written: a program that is killed between leaves what was written last
            new = self._lent.get((index, sub))
            if new is None or (new and data not in new):
                self._lent[index, sub] = [*(new or ()), data] if len(new or ()) < OFTEN else []
                self._keep()

    def _keep(self) -> None:
        """Say in the drive's file what is lent: old content and ours, the old alone of a command; a kill leaves it."""
        if (path := _path_of(self._drive.identity)) is not None:
            rows = {
                f"{index:04X}:{sub:02X}": [data.hex() for data in (self._before[index, sub], *new)]
                for (index, sub), new in self._lent.items()
            }
            with contextlib.suppress(ConfigError):
                make_folder(path.parent)
                write_file(path, json.dumps(rows))

    def _read(self, index: int, sub: int) -> bytes:
        domain = (index, sub) in (objects.EXCITATION_BUFFER, *self._node.map.tables.values())
        return self._node.sdo.upload(index, sub, mode=Mode.BLOCK if domain else Mode.SEGMENTED).data


def any_lent() -> bool:
    """Whether a run on any drive did not bring back what it was lent; looks at the disk alone."""
    return any((user_folder() / FOLDER).glob("*.json"))


def restore_lent(node: DriveNode, identity: Identity, say: Callable[[str], None]) -> int:
    """Bring back what a killed run left changed, where the drive is off and holds it still; return how many objects.

    What the drive refuses stays in the file, for the next command. A damaged file is said, and removed.
    """
    path, count = _path_of(identity), 0
    if path is None or not path.is_file() or not is_safe(node.state()):
        return 0
    try:
        lent = {
            (name, *(int(part, 16) for part in name.split(":", 1))): (bytes.fromhex(old), [*map(bytes.fromhex, new)])
            for name, (old, *new) in json.loads(read_text(path)).items()
        }
    except (ConfigError, ValueError, TypeError, AttributeError):
        path.unlink()
        say(
            f"node {node.node}: the record of what an interrupted run changed in this drive was damaged, and is "
            f"removed ({path}): its current or speed limit may still be lowered. Reset the drive "
            f"(`pmsmtool -n {node.node} nmt reset-node`) before anything is stored: what it has stored comes back"
        )
        return 0
    refused: dict[str, list[str]] = {}
    for (name, index, sub), (old, new) in reversed(lent.items()):
        try:
            if (held := node.sdo.read(index, sub)) != old and (held in new or not new):
                node.sdo.download(index, sub, old)
                count += 1
        except SdoAbort:
            refused[name] = [old.hex(), *map(bytes.hex, new)]
    if refused:
        write_file(path, json.dumps(dict(reversed(refused.items()))))
    else:
        path.unlink(missing_ok=True)
    return count


def _path_of(identity: Identity) -> Path | None:
    """Return the file of a drive; None of one without a serial number, which another may be taken for."""
    name = f"{identity.vendor:08x}-{identity.product:08x}-{identity.serial}.json"
    return user_folder() / FOLDER / name if identity.serial else None


RATED_RATIO = 30.0
"""Largest current limit over the drive's rated current (0x6075): three times the rated current of a motor ten times as
large as the one that the drive still holds."""
LEAST_COUNTS = 4
"""Steps of its limit below which a drive is not asked to keep a current or speed: they are too coarse."""
_ROUNDING = 1e-6
OFFSETS = (DriveObject(0x60B0, 0, "i"), DriveObject(0x60B1, 0, "i"), DriveObject(0x60B2, 0, "h"))
"""What a drive adds to commands of position, speed and torque, as another master left it (CiA 402-2)."""


class OwnLimits(NamedTuple):
    """The drive's own limits."""

    current: Quantity | None
    speed: Quantity | None
    """The objects in use, None where the drive has none."""
    most_apk: float
    most_rpm: float
    """What they allow after they were lowered to the envelope (A peak, rpm)."""
    refused: tuple[str, ...] = ()
    """Limits that the drive does not let be lowered, one line each."""


NO_LIMITS = OwnLimits(None, None, math.inf, math.inf)


def lower_limits(drive: CanopenDrive, envelope: Envelope) -> OwnLimits:
    """Make the drive itself keep current and speed, by the first object it has for each (0x6073, 0x6080).

    Where it has none, a drive whose every command is a bounded current goes on: its current is commanded and looked
    at by the guard, and its speed may not even overshoot.

    Raises SafetyRefusal: the current limit is none beside the rated current, or beyond what the drive shows of its
    current; or the drive does not hold what was written; NotAvailable: the drive lacks a limit that nothing replaces.
    """
    node = drive.node
    rated = rated_apk(node)
    _refuse_no_limit(node, rated, envelope.i_max_apk)
    if envelope.i_max_apk > drive.shows_apk:
        raise SafetyRefusal(
            f"the current limit of {format_current(envelope.i_max_apk)} cannot be watched: what the drive shows of its "
            f"current ends at {format_current(drive.shows_apk)}",
            where=f"node {node.node}",
            likely="an object of 16 bits in mA, as a drive for small motors has it",
            hint="limit the current to less (--i-max); nothing was energised",
        )
    refused: list[str] = []
    current = _lowered(node, current_limits(node, rated), envelope.i_max_apk, refused)
    speed = _lowered(node, speed_limits(node), rpm_from_rad_s(envelope.speed_max_rad_s), refused)
    if not (current and speed) and not drive.commands_bounded_current:
        lacking = [
            name for found, name in ((current, "current (0x6073, 0x6072)"), (speed, "speed (0x6080)")) if found is None
        ]
        raise NotAvailable(
            "; ".join([f"the drive keeps no limit of its own of its {' and its '.join(lacking)}", *refused]),
            where=f"node {node.node}",
            hint="without it nothing is moved but by a current that this program commands; where the maker has another "
            "object for it, name that in [motion] of a map (current_limit, speed_limit)",
        )
    return OwnLimits(
        None if current is None else current[0],
        None if speed is None else speed[0],
        math.inf if current is None else current[1],
        math.inf if speed is None else speed[1],
        tuple(refused),
    )


def clear_offsets(node: DriveNode) -> None:
    """Make the drive add nothing to a command while it is lent. Raises SafetyRefusal: it goes on adding something."""
    for item in OFFSETS:
        held = node.held(item)
        if not held:
            continue
        with contextlib.suppress(SdoAbort):
            node.put(item, 0.0)
        if node.get(item):
            raise SafetyRefusal(
                f"the drive adds {held:g} to every command, and it cannot be cleared",
                where=f"node {node.node}, 0x{item.index:04X}:00",
                likely="an offset that another master keeps, or that is set by the maker's software",
                hint="set it to 0, and run the command again; nothing was energised",
            )


def put_limit(node: DriveNode, limit: Quantity | None, wanted: float, most: float) -> float | None:
    """Let the drive keep a current (A peak) or a speed (rpm), at most what it allows while it is lent.

    Returns what it keeps; None where it has no such limit, or steps too coarse for it.
    """
    if limit is None:
        return None
    counts = math.floor(min(wanted, most) / limit.per_count + _ROUNDING)
    if counts < LEAST_COUNTS:
        return None
    try:
        _put(node, limit, counts)
    except (SafetyRefusal, SdoAbort):
        return None
    return counts * limit.per_count


def refuse_no_current(node: DriveNode, i_max: float) -> None:
    """Refuse to begin where the drive allows no current; what is no number is told as what limits nothing."""
    if i_max <= 0.0:
        raise SafetyRefusal(
            "the drive allows no current: its rated current or one of its limits (0x6073, 0x6072) is 0",
            where=f"node {node.node}", likely="the drive is as it left its factory: the motor is not set up",
            hint="run the maker's own set-up first",
        )  # fmt: skip


def _refuse_no_limit(node: DriveNode, rated: float, i_max: float) -> None:
    """Refuse a current limit so far above the drive's rated current that it limits nothing."""
    refuse_no_current(node, i_max)
    largest = RATED_RATIO * rated
    if not i_max <= largest:  # what is no number is no limit either
        raise SafetyRefusal(
            f"the current limit of {i_max:.4g} A (peak) is none: the drive is rated {rated:.4g} A (peak), and "
            f"at most {RATED_RATIO:g} times that, {largest:.4g} A, counts as a limit; nothing was energised",
            where=f"node {node.node}, 0x6075:00",
            likely="a wrong digit or unit in --i-max, or the drive holds the rated current of a much smaller motor",
            hint="give --i-max within what the motor can carry, or write the motor's rated current to 0x6075 first",
        )


def _lowered(
    node: DriveNode, limits: Iterator[Quantity], wanted: float, refused: list[str]
) -> tuple[Quantity, float] | None:
    """Lower the drive's own limit to what is wanted and return it with what it allows (A peak or rpm).

    The next one is tried where the drive refuses to: a limit that nobody can lower counts as none.
    """
    for limit in limits:
        found = allowed(node, iter((limit,)))
        if found is None:
            continue
        # Rounded up: a permille of the rated current must not cut what the envelope allows.
        counts = math.ceil(wanted / limit.per_count)
        if counts * limit.per_count >= found[1]:
            return found
        try:
            node.put(limit.item, node.get(limit.item))  # what it refuses now could not be brought back
            _put(node, limit, counts)
        except SdoAbort as abort:
            refused.append(f"limit {limit} stays at what the drive holds ({abort.what}): this program looks instead")
            continue
        return limit, counts * limit.per_count
    return None


def _put(node: DriveNode, limit: Quantity, counts: int) -> None:
    item = limit.item
    node.put(item, counts)
    held = node.get(item)
    if held > counts:
        raise SafetyRefusal(
            f"the drive holds the limit {held:.0f}, not the {counts:.0f} that was written",
            where=f"node {node.node}, 0x{item.index:04X}:{item.sub:02X}",
            likely="the object is locked, or follows another one of the maker's",
            hint="set it with the maker's software; nothing is moved without limits in the drive",
        )
