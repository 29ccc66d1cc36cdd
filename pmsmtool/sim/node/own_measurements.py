# SPDX-License-Identifier: MIT
"""What a simulated drive measures by itself: simple methods of its own, with their own errors, taking their time.

Each measurement is a generator that yields how long it waits (s) while the machine moves, and returns its result. The
methods are those of an ordinary drive: two levels of current for R, the ripple of a square-wave voltage for L, a vector
turned slowly for the pole pairs, the voltage at speed for psi. Dead time, sensor lag and saturation stay in the result.
They run behind the OS command objects that the map names (0x1023, 0x1024 of CiA 301).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Mapping, Sequence

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.clock import NS, Schedule, Timer
from pmsmtool.cia402 import State
from pmsmtool.drive.port import Excitation, Injection, Shape
from pmsmtool.drive_maps.drive_map import Cell
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
from pmsmtool.sim.kernel import Signal
from pmsmtool.sim.node.dictionary import Dictionary, Entry, Refused
from pmsmtool.sim.node.drive_core import Averages, AverageState, Command, ControlMode
from pmsmtool.sim.node.objects import ObjectRow
from pmsmtool.sim.node.power_drive import Plant, PowerDrive
from pmsmtool.units import rad_s_from_rpm

Measured = Generator[float, None, float]

CURRENT_SHARE = 0.6
"""Test current, of the rated one."""
HEADROOM = 1.2
"""Smallest distance of the test current from the limit of object 0x6073."""
NOT_REACHED = 0
"""Error code of a measurement whose current is not reached."""
NO_ANSWER = 1
"""Error code of a shaft that does not answer."""
REACHED = 0.1
"""Deviation of a current, of what was asked for, up to which it counts as reached."""
OPEN_SHARE = 0.05
"""Current of a phase, of the vector's, below which it counts as open."""
SETTLE_S = 0.3
WINDOW_S = 0.05
ALIGN_S = 4.0
"""Longest time a rotor is given to come to rest on a vector."""
AT_REST_RAD_S = 0.1
REST_S = 0.01
"""Voltage off between two vectors: a wound-up controller must not throw its voltage on another phase."""
TICK_S = 0.005
TURNS, TURN_S = 4, 0.8
"""Electrical turns of the vector that counts the pole pairs, and the time of one."""
INTEGER_WITHIN = 0.2
HALF_PERIOD = 6
RIPPLE_SHARE = 0.2
"""Ripple that the inductance is measured with, of the rated current; its amplitude is found in growing steps."""
FIRST_VOLTAGE_SHARE = 0.005
RIPPLE_PERIODS = 20
SEARCHES = 6
SPEED_SHARE = 0.25
"""Speed at which the voltage is measured, of the largest one."""
RAMP_S, RUN_UP_S = 3.0, 6.0
"""Ramp of the speed; longest time to reach it."""
PUSH_S = 0.02
"""Time over which the voltage is taken while the shaft is driven, and while it is braked."""
FULL_CURRENT_AT = 0.1
"""Speed error, of the target speed, that takes the whole test current."""

NOT_ALLOWED, GIVEN_UP, NO_COMMAND = 251, 252, 254
"""Error codes of every OS command."""
AT_PROGRESS, PER_S = 100, 10.0
"""Status of a running command at its start, and what it grows by per second, to 199."""


class MeasurementFailed(Exception):
    """A measurement that ends without a result, by its error code in the drive."""

    def __init__(self, code: int) -> None:
        super().__init__(f"error code {code}")
        self.code = code


class OwnMeasurements:
    """The measurements of one session.

    Parameters
    ----------
    dictionary : Dictionary
        For the drive's limits.
    plant : Plant
        The drive and its machine.
    one_inductance : bool
        Whether one inductance stands for both axes: that of the axis the rotor is pulled to.
    """

    def __init__(self, dictionary: Dictionary, plant: Plant, *, one_inductance: bool) -> None:
        self._dictionary = dictionary
        self._plant = plant
        self._q_axis = not one_inductance

    def measurement(self, name: str) -> Callable[[], Measured]:
        """Return what measures a result; of any other name the check for open phases."""
        known: Mapping[str, Callable[[], Measured]] = {
            "motor.pole_pairs": self._pole_pairs,
            "motor.R_s_ohm": self._resistance,
            "motor.L_d_h": lambda: self._inductance(Injection.U_D, Signal.I_D),
            "motor.L_q_h": self._inductance_q,
            "motor.psi_f_wb": self._flux_linkage,
        }
        return known.get(name, self._open_phase)

    # ---- means ---------------------------------------------------------------------------------

    @property
    def _current_a(self) -> float:
        """Test current, within the limit of object 0x6073 (A peak)."""
        permille = self._dictionary["cia402.max_current"].number()
        limit = permille * 1e-6 * self._dictionary["cia402.rated_current"].number() * math.sqrt(2.0)
        return min(CURRENT_SHARE * self._plant.parameter("motor.I_nom_apk"), limit / HEADROOM)

    def _vector(self, length_a: float, angle_rad: float) -> None:
        command = Command(ControlMode.CURRENT, i_d_a=length_a, fixed_angle_rad=angle_rad)
        self._plant.core.command(command)

    def _means(self, signals: Sequence[Signal], seconds: float) -> Generator[float, None, Sequence[float]]:
        return (yield from self._averages(signals, seconds)).mean

    def _averages(self, signals: Sequence[Signal], seconds: float) -> Generator[float, None, Averages]:
        core = self._plant.core
        core.average(signals, max(1, round(seconds * 1e9 / core.period_ns)))
        while True:
            yield seconds
            result = core.averages()
            if result.state is AverageState.COMPLETE:
                return result
            seconds = TICK_S

    def _align(self, length_a: float) -> Generator[float, None, None]:
        """Hold a vector until the rotor it pulls has come to rest: its voltage would be taken for a drop."""
        self._vector(length_a, 0.0)
        passed = quiet = 0.0
        while passed < ALIGN_S and quiet < SETTLE_S:
            before = self._plant.core.signal(Signal.THETA_M)
            yield TICK_S
            moved = abs(self._plant.core.signal(Signal.THETA_M) - before)
            passed, quiet = passed + TICK_S, quiet + TICK_S if moved < AT_REST_RAD_S * TICK_S else 0.0

    # ---- measurements --------------------------------------------------------------------------

    def _open_phase(self) -> Measured:
        largest = [0.0, 0.0, 0.0]
        length = 0.5 * self._current_a
        for k in range(3):
            self._plant.core.command(Command())
            yield REST_S
            self._vector(length, 2.0 * math.pi * k / 3.0)
            yield SETTLE_S / 3.0
            means = yield from self._means((Signal.I_A, Signal.I_B, Signal.I_C), WINDOW_S)
            largest = [max(most, abs(mean)) for most, mean in zip(largest, means, strict=True)]
        self._plant.core.command(Command())
        yield REST_S
        if min(largest) < OPEN_SHARE * length:
            raise MeasurementFailed(largest.index(min(largest)))
        return 0.0

    def _pole_pairs(self) -> Measured:
        yield from self._align(self._current_a)
        start = self._plant.core.signal(Signal.THETA_M)
        steps = round(TURNS * TURN_S / TICK_S)
        for k in range(1, steps + 1):
            self._vector(self._current_a, 2.0 * math.pi * TURNS * k / steps)
            yield TICK_S
        yield SETTLE_S
        turned = abs(self._plant.core.signal(Signal.THETA_M) - start) / (2.0 * math.pi)
        count = TURNS / turned if turned > 0.0 else math.inf
        if not count < 0xFF or abs(count - round(count)) > INTEGER_WITHIN * max(1.0, count / 5.0):
            raise MeasurementFailed(NO_ANSWER)
        return float(round(count))

    def _resistance(self) -> Measured:
        levels = []
        for share in (0.5, 1.0):
            yield from self._align(share * self._current_a)
            means = yield from self._means((Signal.U_D, Signal.I_D), WINDOW_S)
            if abs(means[1] - share * self._current_a) > REACHED * self._current_a:
                raise MeasurementFailed(NOT_REACHED)
            levels.append(means)
        (u_1, i_1), (u_2, i_2) = levels
        return (u_2 - u_1) / (i_2 - i_1)

    def _inductance_q(self) -> Measured:
        point, signal = (Injection.U_Q, Signal.I_Q) if self._q_axis else (Injection.U_D, Signal.I_D)
        return self._inductance(point, signal)

    def _inductance(self, point: Injection, signal: Signal) -> Measured:
        core = self._plant.core
        bias = 0.5 * self._current_a
        yield from self._align(bias)
        wanted = RIPPLE_SHARE * self._plant.parameter("motor.I_nom_apk")
        largest_v = core.signal(Signal.U_DC) / math.sqrt(3.0)
        amplitude = FIRST_VOLTAGE_SHARE * largest_v
        for _ in range(SEARCHES):
            ripple = yield from self._ripple(point, signal, amplitude, bias)
            if ripple >= 0.5 * wanted:
                core.excite(None)
                return amplitude * HALF_PERIOD * 1e-9 * core.period_ns / ripple
            amplitude = min(largest_v, amplitude * min(4.0, wanted / max(ripple, 1e-9)))
        core.excite(None)
        raise MeasurementFailed(NOT_REACHED)

    def _ripple(self, point: Injection, signal: Signal, amplitude_v: float, bias_a: float) -> Measured:
        """Return the mean swing of a current (A) under a square-wave voltage."""
        core = self._plant.core
        core.excite(
            Excitation(
                shape=Shape.SQUARE, point=point, amplitude=amplitude_v, bias_d_a=bias_a,
                bias_bandwidth_rad_s=2.0 * math.pi * 15.0, hold_periods=HALF_PERIOD, fixed_angle_rad=0.0,
            )
        )  # fmt: skip
        yield SETTLE_S / 3.0
        periods = 2 * HALF_PERIOD * RIPPLE_PERIODS
        result = yield from self._averages((signal,), periods * 1e-9 * core.period_ns)
        # a triangle of n samples per half wave has the mean square (1/3 + 2 / (3 n^2)) (swing / 2)^2
        return 2.0 * float(result.std[0]) / math.sqrt(1.0 / 3.0 + 2.0 / (3.0 * HALF_PERIOD**2))

    def _flux_linkage(self) -> Measured:
        """Measure the voltage at speed, driving and braking, less the drop at the resistance the drive is set to."""
        limit = self._dictionary["cia402.max_speed"].number()
        target = rad_s_from_rpm(SPEED_SHARE * min(limit, self._plant.parameter("motor.n_max_rpm")))
        pole_pairs = self._plant.parameter("motor.pole_pairs")
        passed = 0.0
        while passed < RAMP_S or abs(self._speed(pole_pairs) - target) > FULL_CURRENT_AT * target:
            if passed > RUN_UP_S:
                raise MeasurementFailed(NO_ANSWER)
            yield from self._steer(min(1.0, passed / RAMP_S) * target, target, pole_pairs)
            passed += TICK_S
        linkages = []
        for i_q in (0.5 * self._current_a, -0.5 * self._current_a):  # dead time adds to one and takes from the other
            self._plant.core.command(Command(ControlMode.CURRENT, i_q_a=i_q))
            yield REST_S
            u_q, i_q, omega_e = yield from self._means((Signal.U_Q, Signal.I_Q, Signal.OMEGA_E), PUSH_S)
            linkages.append((u_q - self._plant.parameter("motor.R_s_ohm") * i_q) / omega_e)
        while passed > 0.0:
            yield from self._steer(min(1.0, passed / RAMP_S) * target, target, pole_pairs)
            passed -= TICK_S
        return 0.5 * (linkages[0] + linkages[1])

    def _speed(self, pole_pairs: float) -> float:
        return self._plant.core.signal(Signal.OMEGA_E) / max(1.0, pole_pairs)

    def _steer(self, wanted: float, target: float, pole_pairs: float) -> Generator[float, None, None]:
        error = (wanted - self._speed(pole_pairs)) / (FULL_CURRENT_AT * target)
        i_q = self._current_a * min(1.0, max(-1.0, error))
        self._plant.core.command(Command(ControlMode.CURRENT, i_q_a=i_q))
        yield TICK_S


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
        self._mode = _entry(OS_COMMAND_MODE, 0, "U8", "rw", "0")
        self._mode.sink = self._write_mode
        self._command = _entry(OS_COMMAND, 1, "DOMAIN", "rw")
        self._command.value, self._command.sink = bytes(COMMAND_BYTES), self._take
        status = _entry(OS_COMMAND, 2, "U8", "ro", "0")
        status.source = lambda: self._shown()[:1]
        answer = _entry(OS_COMMAND, 3, "DOMAIN", "ro")
        answer.source = self._fetch
        for entry in (_entry(OS_COMMAND, 0, "U8", "ro", "3"), self._command, status, answer, self._mode):
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


def _entry(index: int, sub: int, kind: str, access: str, default: str = "") -> Entry:
    return Entry(ObjectRow(index, sub, "", "Own identification", kind, access, default=default))
