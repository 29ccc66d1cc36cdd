# SPDX-License-Identifier: MIT
"""Objects of a drive that the guard lets be changed: what they held before, and how it is brought back.

A program that is killed brings nothing back, and what is stored next would keep its lowered limits. So of a drive with
a serial number a file says what is lent, and the next command that opens the drive brings it back.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable
from pathlib import Path

from pmsmtool.bus.sdo import Mode
from pmsmtool.bus.sdo_transfer import is_busy, when_ready
from pmsmtool.drive import objects
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.drive_node import DriveNode, is_safe
from pmsmtool.drive.port import Identity
from pmsmtool.errors import ConfigError, DriveFault, SdoAbort, VerifyMismatch
from pmsmtool.files import make_folder, read_text, user_folder, write_file

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
