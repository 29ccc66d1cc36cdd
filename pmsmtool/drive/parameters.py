# SPDX-License-Identifier: MIT
"""Parameters of a drive, read and written as bytes; a set is taken over as a whole where the drive can.

The reference drive stages: writes go to a copy, are read back from it, validated against the CRC-32
the tool expects of the *whole* set, and act only when the copy is activated. On a drive without that
each object is written and read back.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Mapping
from enum import IntEnum
from functools import partial

from pmsmtool.bus.sdo import Mode, Retry
from pmsmtool.bus.sdo_transfer import when_ready
from pmsmtool.drive import objects
from pmsmtool.drive.drive_node import NOT_READ, DriveNode
from pmsmtool.drive_maps.drive_map import DriveMap
from pmsmtool.drive_maps.map_tables import look_up_words
from pmsmtool.errors import BusError, DriveFault, DriveTimeout, NotAvailable, SdoAbort, VerifyMismatch
from pmsmtool.firmware.image import ImageStatus, crc32, pack_image, unpack_image
from pmsmtool.params.catalogue import SCHEMA_VERSION, layout_signature
from pmsmtool.params.parameter_set import LUT_NAMES, SATURATION, TABLE_NAMES
from pmsmtool.plain_text import counted

Progress = Callable[[int, int], None]
"""Called with objects done and objects in all."""
BUSY_S = 0.5
"""A value that the drive is too busy to take is written again for so long."""


class SetCommand(IntEnum):
    """Commands of object 0x2000:06."""

    BEGIN = 1
    VALIDATE = 2
    ACTIVATE = 3
    DISCARD = 4


class SetState(IntEnum):
    """States of object 0x2000:07."""

    NONE = 0
    STAGING = 1
    VALID = 2
    ACTIVE = 3
    REJECTED = 4


_STAGED = (SetState.STAGING, SetState.VALID, SetState.REJECTED)


def _no_progress(done: int, total: int) -> None:
    """Nobody wants to know."""


class DriveParameters:
    """Access to the parameters of one drive."""

    def __init__(self, node: DriveNode) -> None:
        self.node = node
        self.map: DriveMap = node.map

    # ---- reading --------------------------------------------------------------------------------

    def read(self, names: Iterable[str], *, progress: Progress = _no_progress) -> dict[str, bytes]:
        """Return the bytes of parameters and tables by name."""
        wanted = tuple(names)
        found = {}
        for count, name in enumerate(wanted, 1):
            index, sub = self.map.address(name)
            if name in self.map.tables:
                found[name] = self.node.sdo.upload(index, sub, mode=Mode.BLOCK).data
            else:
                found[name] = self.node.sdo.read(index, sub, size=self.map.cells[name].size)
            progress(count, len(wanted))
        return found

    def read_value(self, name: str) -> float:
        """Return one parameter in SI. Raises NotAvailable: the drive has no object for it."""
        if name not in self.map.cells:
            raise NotAvailable(f"drive family {self.map.name} has no object for {name}", where=f"node {self.node.node}")
        cell = self.map.cells[name]
        values = {cell.gain: self.read_value(cell.gain)} if cell.gain else {}
        return cell.decode(self.read([name])[name], values)

    def held_value(self, name: str) -> float | None:
        """Return one parameter in SI; None where map or drive have no object for it, or the drive has another type.

        What the standard or a family has, a drive may lack: a row of a map is no promise.
        """
        cell = self.map.cells.get(name)
        gain = self.held_value(cell.gain) if cell is not None and cell.gain else None
        if cell is None or (cell.gain and gain is None):
            return None
        self.node.sdo.usual_lengths.setdefault((cell.index, cell.sub), cell.size)
        try:
            data = self.node.sdo.read(cell.index, cell.sub)
        except SdoAbort as abort:
            if abort.code in NOT_READ:
                return None
            raise
        return cell.decode(data, {} if gain is None else {cell.gain: gain}) if len(data) == cell.size else None

    def check_layout(self) -> None:
        """Refuse a drive whose parameter set this program does not know.

        Raises NotAvailable: schema version or layout signature differ.
        """
        if not self.map.staging:
            return
        schema, signature = self.node.whole(objects.SET_SCHEMA), self.node.whole(objects.SET_SIGNATURE)
        if (schema, signature) != (SCHEMA_VERSION, layout_signature()):
            raise NotAvailable(
                f"the drive's parameter set has schema {schema}, signature {signature:#010x}; "
                f"pmsmtool supports schema {SCHEMA_VERSION}, signature {layout_signature():#010x}",
                where=f"node {self.node.node}, 0x2000:02",
                likely="firmware and tool are of different versions",
                hint="update the older of the two",
            )

    def settle(self) -> bool:
        """Discard a staged copy that an interrupted run left: reads would show it instead of the active set.

        Returns
        -------
        bool
            Whether there was one.
        """
        if not self.is_staged():
            return False
        self.node.command(objects.SET_COMMAND, SetCommand.DISCARD)
        return True

    def is_staged(self) -> bool:
        """Whether a staged copy is open."""
        return self.map.staging and self.node.whole(objects.SET_STATE) in _STAGED

    @property
    def crc_active(self) -> int:
        """CRC-32 of the set the drive works with."""
        return self.node.whole(objects.SET_CRC_ACTIVE)

    @property
    def crc_stored(self) -> int:
        """CRC-32 of the set in the drive's non-volatile memory, 0 when there is none."""
        return self.node.whole(objects.SET_CRC_STORED)

    def is_stored(self) -> bool:
        """Whether the drive would come back from a reset with the set it works with; False when unknown."""
        return self.map.staging and self.crc_active == self.crc_stored

    def expected_crc(self, new: Mapping[str, bytes]) -> int:
        """Return the CRC-32 of the drive's whole set after a change.

        Raises ConfigError: the set that results cannot be used: ranges, or tables that do not fit their descriptor.
        """
        values, words = unpack_image(self.node.sdo.upload(*objects.SET_IMAGE, mode=Mode.BLOCK).data)
        values = dict(values)
        for name, data in new.items():
            if name in self.map.cells:
                values[name] = self.map.cells[name].decode(data, values)
        if any(name in TABLE_NAMES or name.startswith(("lut.", "saturation.")) for name in new):
            used = (*(LUT_NAMES if values["lut.format"] else ()), *((SATURATION,) if values["saturation.n_d"] else ()))
            missing = [name for name in used if name not in new]
            words = look_up_words({**self.read(missing), **{n: new[n] for n in used if n in new}})
        return crc32(pack_image(values, words))

    # ---- writing --------------------------------------------------------------------------------

    def replace(self, new: Mapping[str, bytes], *, progress: Progress = _no_progress) -> None:
        """Write parameters and read all of them back; with staging they act together or not at all.

        Raises DriveFault: the drive refused values, or the set; the message names each; VerifyMismatch: something reads
        back differently.

        Parameters
        ----------
        new : mapping of str to bytes
            Contents by catalogue or table name.
        """
        if self.node.before_write is not None:
            for name, data in new.items():
                self.node.before_write(*self.map.address(name), data)
        if not self.map.staging:
            self._write_all(new, progress)
            return
        expected = self.expected_crc(new)
        self.node.command(objects.SET_COMMAND, SetCommand.BEGIN)
        try:
            self._write_all(new, progress)
            self.node.command(objects.SET_CRC_EXPECTED, expected)
            self._validate()
            self._activate(expected)
        except BaseException:
            with contextlib.suppress(BusError, DriveFault):
                self.node.command(objects.SET_COMMAND, SetCommand.DISCARD)
            raise

    def write_live(self, new: Mapping[str, bytes]) -> None:
        """Write single parameters that act at once (live gains of an enabled drive), and read them back."""
        if self.node.before_write is not None:
            for name, data in new.items():
                self.node.before_write(*self.map.address(name), data)
        self._write_all(new, _no_progress)

    def _write_all(self, new: Mapping[str, bytes], progress: Progress) -> None:
        refused, hints = [], set()
        total = 2 * len(new)
        patience_s = BUSY_S
        for count, (name, data) in enumerate(new.items(), 1):
            write = partial(self.node.sdo.download, *self.map.address(name), data)
            try:
                when_ready(self.node.connection, write, patience_s)
            except SdoAbort as abort:
                refused.append(f"{name} ({abort.where}): {abort.what}{f'; {abort.likely}' if abort.likely else ''}")
                hints.add(abort.hint)
                patience_s = 0.0  # an enabled drive refuses every one as if it were busy
            progress(count, total)
        if refused:
            raise DriveFault(
                "\n  - ".join([f"the drive refused {len(refused)} of {counted(len(new), 'value')}", *refused]),
                where=f"node {self.node.node}",
                hint="; ".join(sorted(hints)),
            )
        found = self.read(new, progress=lambda done, count: progress(count + done, total))
        wrong = [
            f"{name}: wrote {new[name][:8].hex(' ')}, reads {found[name][:8].hex(' ')}"
            for name in new
            if found[name] != new[name]
        ]
        if wrong:
            raise VerifyMismatch(
                "the drive does not hold what was written",
                where=f"node {self.node.node}",
                differences=wrong,
                likely="the drive rounds or limits silently, or its map is wrong",
                hint="`pmsmtool verify` shows what it holds; compare the map's types with its manual",
            )

    def _validate(self) -> None:
        self.node.command(objects.SET_COMMAND, SetCommand.VALIDATE)
        state = self.node.whole(objects.SET_STATE)
        if state == SetState.VALID:
            return
        offender = self.node.whole(objects.SET_OFFENDER)
        index, sub, reason = offender >> 16, offender >> 8 & 0xFF, offender & 0xFF
        names = [name for name in (*self.map.cells, *self.map.tables) if self.map.address(name) == (index, sub)]
        text = ImageStatus(reason).name.lower() if reason in set(ImageStatus) else f"reason {reason}"
        raise DriveFault(
            f"the drive rejects the staged set at {names[0] if names else 'its check'}: {text}",
            where=f"node {self.node.node}, 0x{index:04X}:{sub:02X}",
            hint="nothing acts yet; compare the set with `pmsmtool param help`",
        )

    def _activate(self, expected: int) -> None:
        try:
            self.node.command(objects.SET_COMMAND, SetCommand.ACTIVATE, retry=Retry.NEVER)
        except DriveTimeout:
            # The answer was lost: the CRC tells whether the set acts. Only if not is it asked for again.
            if self.crc_active != expected:
                self.node.command(objects.SET_COMMAND, SetCommand.ACTIVATE, retry=Retry.NEVER)
        active = self.crc_active
        if active != expected:
            raise VerifyMismatch(
                "the active set is not the one that was written",
                where=f"node {self.node.node}, 0x2000:03",
                differences=[f"CRC-32 {active:#010x} instead of {expected:#010x}"],
                hint="`pmsmtool verify` shows what it holds; write the set again",
            )
