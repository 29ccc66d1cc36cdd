# SPDX-License-Identifier: MIT
"""A simulated drive's own identification behind the objects that its map names: OS commands, or a mode of its own.

What is measured, and how, stands in ``own_measurements``. Here it is started, told how far it is, given up when the
drive leaves operation or somebody asks for it, and answered.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.clock import NS, Timer
from pmsmtool.cia402 import State
from pmsmtool.data_types import SHORT
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
AT_PROGRESS = 100
"""Status of a running command at 0 %."""
EXPECTED_S = {"motor.pole_pairs": 4.0, "motor.R_s_ohm": 0.7, "motor.psi_f_wb": 6.0}
"""About how long a measurement takes, for its progress."""
OTHERS_S = 1.0
IDENTIFICATION_FAILED = 0xFF20
"""Error code of a drive whose set-up mode finds no result."""


def attach(drive_map: DriveMap, dictionary: Dictionary, plant: Plant, power: PowerDrive, schedule: Schedule) -> None:
    """Put the map's own identification into a running session."""
    tuning = drive_map.vendor_tuning
    if tuning is None:
        return
    runner = _Runner(tuning, dictionary, plant, power, schedule)
    if tuning.kind == "os_command":
        OsCommands(runner)
    else:
        SetUpMode(runner)


class _Runner:
    """Runs one measurement after the other on the node's schedule."""

    def __init__(
        self, tuning: VendorTuning, dictionary: Dictionary, plant: Plant, power: PowerDrive, schedule: Schedule
    ) -> None:
        self.tuning = tuning
        self.dictionary = dictionary
        self.plant = plant
        self.power = power
        self.measurements = OwnMeasurements(dictionary, plant, one_inductance="motor.L_d_h" not in tuning.results)
        self._schedule = schedule
        self._running: Generator[float, None, None] | None = None
        self._timer: Timer | None = None
        self._began_ns = 0

    @property
    def running(self) -> bool:
        """Whether a measurement is under way."""
        return self._running is not None

    @property
    def ready(self) -> bool:
        """Whether the drive is enabled in the mode that a measurement needs."""
        shown = int.from_bytes(self.dictionary.find(0x6061, 0).read(), "little", signed=True)
        return self.power.state is State.OPERATION_ENABLED and shown == self.tuning.mode

    @property
    def passed_s(self) -> float:
        """Time since the last start (s)."""
        return (self._schedule.now_ns - self._began_ns) / NS

    def start(self, steps: Generator[float, None, None]) -> None:
        """Begin; the generator sees to its own end."""
        self._began_ns = self._schedule.now_ns
        self._running = steps
        self._go_on()

    def stop(self) -> None:
        """Give up what runs: no current any more."""
        if self._running is None:
            return
        self._running.close()
        self._ended()

    def _ended(self) -> None:
        self._running = None
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self.plant.core.excite(None)
        self.power.apply()  # the references of the mode: none

    def _go_on(self) -> None:
        self._timer = None
        if self._running is None:
            return
        self.plant.look()
        try:
            seconds = next(self._running)
        except StopIteration:
            self._ended()
            return
        self._timer = self._schedule.after(seconds, self._go_on)

    def watched(self, measured: Measured) -> Measured:
        """Pass a measurement on, which fails as soon as the drive is not ready any more."""
        while True:
            if not self.ready:
                measured.close()
                raise MeasurementFailed(GIVEN_UP)
            try:
                seconds = next(measured)
            except StopIteration as done:
                return float(done.value)
            yield seconds

    def encoded(self, cell: Cell, value: float) -> bytes:
        """Return a result as the map counts it; relative to what the drive is set to.

        Raises
        ------
        MeasurementFailed
            It does not fit.
        """
        values = {cell.gain: self.plant.parameter(cell.gain)} if cell.gain else {}
        try:
            return cell.encode(value, values)
        except ConfigError as error:
            raise MeasurementFailed(GIVEN_UP) from error


class OsCommands:
    """Objects 0x1023 and 0x1024 (CiA 301)."""

    def __init__(self, runner: _Runner) -> None:
        self._runner = runner
        self._names = {step.command: step.name for step in runner.tuning.steps.values()}
        self._answer = bytes(COMMAND_BYTES)
        self._unread = False
        self._expected_s = OTHERS_S
        self._mode = Entry(_row(OS_COMMAND_MODE, 0, "U8", "rw", "0"), 0)
        for entry in self._entries():
            runner.dictionary.show(entry)

    def _entries(self) -> Iterator[Entry]:
        highest = Entry(_row(OS_COMMAND, 0, "U8", "ro", "3"), 0)
        command = Entry(_row(OS_COMMAND, 1, "DOMAIN", "rw"), 0)
        status = Entry(_row(OS_COMMAND, 2, "U8", "ro", "0"), 0)
        answer = Entry(_row(OS_COMMAND, 3, "DOMAIN", "ro"), 0)
        command.value = bytes(COMMAND_BYTES)
        command.sink = self._take(command)
        status.source = lambda: self._shown()[:1]
        answer.source = self._fetch
        self._mode.sink = self._write_mode
        yield from (highest, command, status, answer, self._mode)

    def _shown(self) -> bytes:
        if not self._runner.running:
            return self._answer
        share = min(1.0, self._runner.passed_s / self._expected_s)
        return bytes((AT_PROGRESS + round(99 * share),)).ljust(COMMAND_BYTES, b"\0")

    def _fetch(self) -> bytes:
        if not self._runner.running:
            self._unread = False
        return self._shown()

    def _write_mode(self, data: bytes) -> None:
        if data[0] not in (EXECUTE_AT_ONCE, ABORT):
            raise Refused(AbortCode.VALUE)
        self._mode.value = bytes(data)
        if data[0] == ABORT and self._runner.running:
            self._runner.stop()
            self._fail(GIVEN_UP)

    def _take(self, entry: Entry) -> Callable[[bytes], None]:
        def sink(data: bytes) -> None:
            if len(data) != COMMAND_BYTES:
                raise Refused(AbortCode.TOO_LONG if len(data) > COMMAND_BYTES else AbortCode.TOO_SHORT)
            if self._runner.running:
                raise Refused(AbortCode.LOCAL_CONTROL)
            if self._unread or self._mode.value[0] != EXECUTE_AT_ONCE:
                return  # ignored, as long as an answer waits
            entry.value = bytes(data)
            self._begin(data[0])

        return sink

    def _begin(self, command: int) -> None:
        name = self._names.get(command)
        if name is None:
            self._fail(NO_COMMAND)
        elif not self._runner.ready:
            self._fail(NOT_ALLOWED)
        else:
            self._expected_s = EXPECTED_S.get(name, OTHERS_S)
            self._runner.start(self._steps(name))

    def _steps(self, name: str) -> Generator[float, None, None]:
        runner = self._runner
        try:
            value = yield from runner.watched(runner.measurements.measurement(name)())
            cell = runner.tuning.results.get(name)
            data = b"" if cell is None else runner.encoded(cell, value)
        except MeasurementFailed as failed:
            self._fail(failed.code)
            return
        ordered = data[::-1] if runner.tuning.order == "big" else data
        status = DONE_WITH_DATA if data else DONE
        self._reply(bytes((status, 0)) + ordered)

    def _fail(self, code: int) -> None:
        self._reply(bytes((FAILED_WITH_CODE, 0, code)))

    def _reply(self, answer: bytes) -> None:
        self._answer = answer.ljust(COMMAND_BYTES, b"\0")
        self._unread = True


class SetUpMode:
    """A mode that identifies: started by a bit of the controlword, ended by one of the statusword."""

    def __init__(self, runner: _Runner) -> None:
        self._runner = runner
        self._found: dict[str, bytes] = {}
        self._done = False
        dictionary, tuning = runner.dictionary, runner.tuning
        for name, cell in tuning.results.items():
            dictionary.show(self._result(name, cell))
        self._start, self._end = 1 << tuning.start_bit, 1 << tuning.done_bit
        control, status = dictionary["cia402.controlword"], dictionary["cia402.statusword"]
        inner_sink, inner_source = control.sink, status.source
        assert inner_sink is not None and inner_source is not None

        def write(data: bytes) -> None:
            before = int.from_bytes(control.value, "little")
            inner_sink(data)
            self._command(int.from_bytes(data, "little"), before)

        def read() -> bytes:
            word = int.from_bytes(inner_source(), "little")
            if runner.ready:
                word = word & ~self._end | (self._end if self._done else 0)
            return word.to_bytes(2, "little")

        control.sink, status.source = write, read

    def _result(self, name: str, cell: Cell) -> Entry:
        entry = Entry(_row(cell.index, cell.sub, SHORT[cell.wire], "ro", "0"), 0)
        empty = entry.value
        entry.source = lambda: self._found.get(name, empty)
        return entry

    def _command(self, word: int, before: int) -> None:
        if not word & self._start:
            self._runner.stop()
            self._done = False
        elif not before & self._start and self._runner.ready and not self._runner.running:
            self._done = False
            self._runner.start(self._steps())

    def _steps(self) -> Generator[float, None, None]:
        runner = self._runner
        try:
            yield from runner.watched(runner.measurements.measurement("")())
            for name, cell in runner.tuning.results.items():
                value = yield from runner.watched(runner.measurements.measurement(name)())
                self._found[name] = runner.encoded(cell, value)
        except MeasurementFailed as failed:
            if runner.power.state is State.OPERATION_ENABLED:
                runner.power.fail(IDENTIFICATION_FAILED, bytes((failed.code,)))
            return
        self._done = True


def _row(index: int, sub: int, kind: str, access: str, default: str = "") -> ObjectRow:
    return ObjectRow(index, sub, "", "Own identification", kind, access, "0", "", default, None, None, False)
