# SPDX-License-Identifier: MIT
"""A simulated drive's own identification behind the OS command objects that its map names (0x1023, 0x1024 of CiA 301).

What is measured, and how, stands in ``own_measurements``. Here it is started, given up when the drive leaves operation
or somebody asks for it, and answered.
"""

from __future__ import annotations

from collections.abc import Generator

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.clock import NS, Timer
from pmsmtool.cia402 import State
from pmsmtool.drive_maps.drive_map import Cell, DriveMap
from pmsmtool.drive_maps.vendor_tuning import (
    ABORT,
    COMMAND_BYTES,
    DONE,
    DONE_WITH_DATA,
    EXECUTE_AT_ONCE,
    FAILED_WITH_CODE,
    OS_COMMAND,
    OS_COMMAND_MODE,
    VendorTuning,
)
from pmsmtool.errors import ConfigError
from pmsmtool.sim.node.dictionary import Dictionary, Entry, Refused
from pmsmtool.sim.node.objects import ObjectRow
from pmsmtool.sim.node.own_measurements import Measured, MeasurementFailed, OwnMeasurements
from pmsmtool.sim.node.power_drive import Plant, PowerDrive
from pmsmtool.sim.node.schedule import Schedule

NOT_ALLOWED, GIVEN_UP, NO_COMMAND = 251, 252, 254
"""Error codes of every OS command."""
AT_PROGRESS, PER_S = 100, 10.0
"""Status of a running command at its start, and what it grows by per second, to 199."""


def attach(drive_map: DriveMap, dictionary: Dictionary, plant: Plant, power: PowerDrive, schedule: Schedule) -> None:
    """Put the map's own identification into a running session."""
    if drive_map.vendor_tuning is not None:
        OsCommands(drive_map.vendor_tuning, dictionary, plant, power, schedule)


class OsCommands:
    """Objects 0x1023 and 0x1024; one measurement after the other runs on the node's schedule."""

    def __init__(
        self, tuning: VendorTuning, dictionary: Dictionary, plant: Plant, power: PowerDrive, schedule: Schedule
    ) -> None:
        self._tuning, self._dictionary, self._plant = tuning, dictionary, plant
        self._power, self._schedule = power, schedule
        self._measurements = OwnMeasurements(dictionary, plant, one_inductance="motor.L_d_h" not in tuning.results)
        self._names = {step.command: step.name for step in tuning.steps.values()}
        self._running: Generator[float, None, None] | None = None
        self._timer: Timer | None = None
        self._began_ns = 0
        self._answer = bytes(COMMAND_BYTES)
        self._unread = False
        self._mode = Entry(_row(OS_COMMAND_MODE, 0, "U8", "rw", "0"), 0)
        self._mode.sink = self._write_mode
        self._command = Entry(_row(OS_COMMAND, 1, "DOMAIN", "rw"), 0)
        self._command.value, self._command.sink = bytes(COMMAND_BYTES), self._take
        status = Entry(_row(OS_COMMAND, 2, "U8", "ro", "0"), 0)
        status.source = lambda: self._shown()[:1]
        answer = Entry(_row(OS_COMMAND, 3, "DOMAIN", "ro"), 0)
        answer.source = self._fetch
        for entry in (Entry(_row(OS_COMMAND, 0, "U8", "ro", "3"), 0), self._command, status, answer, self._mode):
            dictionary.show(entry)

    # ---- the objects ----------------------------------------------------------------------------

    def _shown(self) -> bytes:
        if self._running is None:
            return self._answer
        passed_s = (self._schedule.now_ns - self._began_ns) / NS
        return bytes((AT_PROGRESS + min(99, round(PER_S * passed_s)),)).ljust(COMMAND_BYTES, b"\0")

    def _fetch(self) -> bytes:
        self._unread = self._unread and self._running is not None
        return self._shown()

    def _write_mode(self, data: bytes) -> None:
        if data[0] not in (EXECUTE_AT_ONCE, ABORT):
            raise Refused(AbortCode.VALUE)
        self._mode.value = bytes(data)
        if data[0] == ABORT and self._running is not None:
            self._running.close()
            self._ended()
            self._reply(FAILED_WITH_CODE, bytes((GIVEN_UP,)))

    def _take(self, data: bytes) -> None:
        if len(data) != COMMAND_BYTES:
            raise Refused(AbortCode.TOO_LONG if len(data) > COMMAND_BYTES else AbortCode.TOO_SHORT)
        if self._running is not None:
            raise Refused(AbortCode.LOCAL_CONTROL)
        if self._unread or self._mode.value[0] != EXECUTE_AT_ONCE:
            return  # ignored, as long as an answer waits
        self._command.value = bytes(data)
        name = self._names.get(data[0])
        if name is None or not self._ready:
            self._reply(FAILED_WITH_CODE, bytes((NO_COMMAND if name is None else NOT_ALLOWED,)))
            return
        self._began_ns = self._schedule.now_ns
        self._running = self._steps(name)
        self._go_on()

    def _reply(self, status: int, data: bytes) -> None:
        self._answer = (bytes((status, 0)) + data).ljust(COMMAND_BYTES, b"\0")
        self._unread = True

    # ---- a measurement --------------------------------------------------------------------------

    @property
    def _ready(self) -> bool:
        """Whether the drive is enabled in the mode that a measurement needs."""
        shown = int.from_bytes(self._dictionary.find(0x6061, 0).read(), "little", signed=True)
        return self._power.state is State.OPERATION_ENABLED and shown == self._tuning.mode

    def _go_on(self) -> None:
        self._timer = None
        if self._running is None:
            return
        self._plant.look()
        try:
            seconds = next(self._running)
        except StopIteration:
            self._ended()
            return
        self._timer = self._schedule.after(seconds, self._go_on)

    def _ended(self) -> None:
        self._running = None
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._plant.core.excite(None)
        self._power.apply()  # the references of the mode: none

    def _steps(self, name: str) -> Generator[float, None, None]:
        cell = self._tuning.results.get(name)
        try:
            value = yield from self._watched(self._measurements.measurement(name)())
            data = b"" if cell is None else self._encoded(cell, value)
        except MeasurementFailed as failed:
            self._reply(FAILED_WITH_CODE, bytes((failed.code,)))
            return
        self._reply(DONE_WITH_DATA if data else DONE, data[::-1] if self._tuning.order == "big" else data)

    def _watched(self, measured: Measured) -> Measured:
        """Pass a measurement on, which fails as soon as the drive is not ready any more."""
        while True:
            if not self._ready:
                measured.close()
                raise MeasurementFailed(GIVEN_UP)
            try:
                seconds = next(measured)
            except StopIteration as done:
                return float(done.value)
            yield seconds

    def _encoded(self, cell: Cell, value: float) -> bytes:
        """Return a result as the map counts it, relative to what the drive is set to."""
        values = {cell.gain: self._plant.parameter(cell.gain)} if cell.gain else {}
        try:
            return cell.encode(value, values)
        except ConfigError as error:  # it does not fit
            raise MeasurementFailed(GIVEN_UP) from error


def _row(index: int, sub: int, kind: str, access: str, default: str = "") -> ObjectRow:
    return ObjectRow(index, sub, "", "Own identification", kind, access, "0", "", default, None, None, False)
