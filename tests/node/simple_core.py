# SPDX-License-Identifier: MIT
"""A small drive application for tests of the node: first-order currents and speed, no machine model behind it."""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Sequence

from pmsmtool.drive.port import Excitation, Injection, Shape
from pmsmtool.sim.kernel import Signal
from pmsmtool.sim.node.drive_core import (
    TRACE_BYTES,
    Averages,
    AverageState,
    Command,
    ControlMode,
    ExcitationState,
    PositionFlag,
    PositionState,
    RecorderSetup,
    RecorderState,
    RecorderStatus,
    Trigger,
)
from pmsmtool.sim.node.parameter_set import ParameterImage

R_OHM, L_H = 0.5, 0.002
CURRENT_SHARE = 0.2
"""Share of the way to its reference a current goes per period."""
SPEED_SLOPE = 400.0
"""Largest acceleration (rad/s2, mechanical)."""
COAST_PER_S = 0.5
K_T = 0.4
U_DC = 300.0


class SimpleCore:
    """Implements the DriveCore protocol in plain Python."""

    encoder_counts = 4096
    torque_safely_off = False

    def __init__(self) -> None:
        self.image = b""
        self.parameters: ParameterImage | None = None
        self.period_ns = 100_000
        self.calls = 0
        self.periods = 0
        self.restarts = 0
        self.i_d = self.i_q = self.omega = self.theta = self.u_d = self.u_q = 0.0
        self.flags = 0
        self.position_flags = PositionFlag(0)
        self.driven = False
        self.command_seen = Command()
        self.persistent_trip = 0
        self.trip_at: dict[int, int] = {}
        self._trip = 0
        self._excitation: Excitation | None = None
        self._excitation_state = ExcitationState.IDLE
        self._excitation_count = 0
        self._setup: RecorderSetup | None = None
        self._recorder = RecorderState.IDLE
        self._rows: deque[tuple[float, ...]] = deque()
        self._trigger_row = 0
        self._after = 0
        self._last_source = math.nan
        self._recorded_periods = 0
        self._average: tuple[Sequence[Signal], int] = ((), 0)
        self._samples: list[tuple[float, ...]] = []
        self._average_state = AverageState.IDLE

    # ---- parameters and modes ------------------------------------------------------------------

    def load(self, image: bytes) -> None:
        self.image = image
        self.parameters = ParameterImage.of_bytes(image)
        self.period_ns = int(self.parameters.get("inverter.T_s_ns"))

    def restart(self) -> None:
        self.restarts += 1
        self.command_seen = Command()
        self._trip = 0
        self._excitation, self._excitation_state = None, ExcitationState.IDLE
        self._recorder, self._average_state = RecorderState.IDLE, AverageState.IDLE
        self._rows.clear()

    def command(self, command: Command) -> None:
        self.command_seen = command

    # ---- time ----------------------------------------------------------------------------------

    def _state(self) -> tuple[object, ...]:
        return self._trip, self._excitation_state, self._recorder, self._average_state

    def run(self, periods: int) -> int:
        self.calls += 1
        before = self._state()
        for number in range(1, periods + 1):
            self._period()
            if self._state() != before:
                return number
        return periods

    def _period(self) -> None:
        self.periods += 1
        code = self.trip_at.pop(self.periods, 0) or self.persistent_trip
        if code and not self._trip:
            self._trip = code
            self.command_seen = Command()
        self._move(self.period_ns * 1e-9)
        self._excite()
        self._record()
        self._sample_average()

    def _move(self, T_s: float) -> None:
        command = self.command_seen
        i_d, i_q = command.i_d_a, command.i_q_a
        if command.quick_stop or command.mode is ControlMode.OFF:
            i_d = i_q = 0.0
        elif command.mode is ControlMode.TORQUE:
            i_d, i_q = 0.0, command.torque_nm / K_T
        elif command.mode is ControlMode.SPEED:
            i_d = i_q = 0.0
        if self._excitation is not None:
            i_d, i_q = i_d + self._excitation.bias_d_a, i_q + self._excitation.bias_q_a
        self.i_d += CURRENT_SHARE * (i_d - self.i_d)
        self.i_q += CURRENT_SHARE * (i_q - self.i_q)
        if self.driven:
            pass  # something stronger turns the shaft
        elif command.mode is ControlMode.SPEED:
            target = 0.0 if command.quick_stop else command.omega_m_rad_s
            step = SPEED_SLOPE * T_s
            self.omega += min(max(target - self.omega, -step), step)
        else:
            self.omega -= COAST_PER_S * T_s * self.omega
        self.theta += self.omega * T_s

    # ---- excitation ----------------------------------------------------------------------------

    def excite(self, excitation: Excitation | None) -> None:
        if excitation is not None and self._excitation is None:
            self._excitation_count = 0
        self._excitation = excitation
        self._excitation_state = ExcitationState.IDLE if excitation is None else ExcitationState.RUNNING

    def _excite(self) -> None:
        excitation = self._excitation
        if excitation is None:
            return
        self._excitation_count += 1
        sign = -1.0 if (self._excitation_count // max(1, excitation.hold_periods)) % 2 else 1.0
        value = excitation.amplitude * (sign if excitation.shape is Shape.SQUARE else 1.0)
        if excitation.shape is Shape.BUFFER:
            value = excitation.buffer[min(self._excitation_count, len(excitation.buffer)) - 1]
        self.u_d = value if excitation.point is Injection.U_D else 0.0
        self.u_q = value if excitation.point is Injection.U_Q else 0.0
        if excitation.abort_current_apk and math.hypot(self.i_d, self.i_q) > excitation.abort_current_apk:
            self._end_excitation(ExcitationState.ABORTED)
        elif excitation.duration_s and self._excitation_count * self.period_ns >= excitation.duration_s * 1e9:
            self._end_excitation(ExcitationState.DONE)

    def _end_excitation(self, state: ExcitationState) -> None:
        self._excitation, self._excitation_state = None, state
        self.u_d = self.u_q = 0.0

    def excitation_state(self) -> ExcitationState:
        return self._excitation_state

    # ---- recorder ------------------------------------------------------------------------------

    def record(self, setup: RecorderSetup | None) -> None:
        if setup is None:
            self._recorder = RecorderState.IDLE
            return
        assert 4 * setup.depth * len(setup.channels) <= TRACE_BYTES
        self._setup = setup
        self._rows = deque(maxlen=setup.depth)
        self._recorder = RecorderState.ARMED
        self._recorded_periods = 0
        self._last_source = math.nan

    def force_trigger(self) -> None:
        if self._recorder is RecorderState.ARMED and self._setup is not None:
            self._begin(self._setup)

    def _begin(self, setup: RecorderSetup) -> None:
        while len(self._rows) > setup.pretrigger:
            self._rows.popleft()
        self._recorder = RecorderState.TRIGGERED
        self._trigger_row = len(self._rows)

    def _triggers(self, setup: RecorderSetup) -> bool:
        value, last = self.signal(setup.source), self._last_source
        self._last_source = value
        return {
            Trigger.NOW: len(self._rows) >= setup.pretrigger,
            Trigger.RISING: last < setup.level <= value,
            Trigger.FALLING: last > setup.level >= value,
            Trigger.WINDOW: abs(value) > setup.level,
            Trigger.EXCITATION_START: self._excitation_count == 1 and self._excitation is not None,
            Trigger.FAULT: self._trip != 0,
        }[setup.trigger]

    def _record(self) -> None:
        setup = self._setup
        if setup is None or self._recorder not in (RecorderState.ARMED, RecorderState.TRIGGERED):
            return
        if self._recorder is RecorderState.ARMED and self._triggers(setup):
            self._begin(setup)
        self._recorded_periods += 1
        if (self._recorded_periods - 1) % setup.decimation:
            return
        self._rows.append(tuple(self.signal(signal) for signal in setup.channels))
        if self._recorder is RecorderState.TRIGGERED and len(self._rows) == setup.depth:
            self._recorder = RecorderState.COMPLETE

    def recorder(self) -> RecorderStatus:
        return RecorderStatus(self._recorder, len(self._rows), self._trigger_row)

    def recording(self) -> bytes:
        return b"".join(struct.pack(f"<{len(row)}f", *row) for row in self._rows)

    # ---- averages and live values --------------------------------------------------------------

    def average(self, signals: Sequence[Signal], periods: int) -> None:
        self._average = tuple(signals), periods
        self._samples = []
        self._average_state = AverageState.RUNNING if periods else AverageState.IDLE

    def _sample_average(self) -> None:
        if self._average_state is AverageState.RUNNING:
            self._samples.append(tuple(self.signal(signal) for signal in self._average[0]))
            if len(self._samples) == self._average[1]:
                self._average_state = AverageState.COMPLETE

    def averages(self) -> Averages:
        if self._average_state is not AverageState.COMPLETE:
            return Averages(self._average_state)
        columns = list(zip(*self._samples, strict=True))
        means = [sum(column) / len(column) for column in columns]
        stds = [
            math.sqrt(sum((value - mean) ** 2 for value in column) / len(column))
            for column, mean in zip(columns, means, strict=True)
        ]
        return Averages(AverageState.COMPLETE, means, stds)

    def position(self) -> PositionState:
        count = round(self.theta / (2.0 * math.pi) * self.encoder_counts)
        return PositionState((count + (1 << 31)) % (1 << 32) - (1 << 31), 0, 0.0, self.position_flags)

    def trip(self) -> int:
        return self._trip

    def reset_fault(self) -> None:
        self._trip = self.persistent_trip

    def signal(self, signal: Signal) -> float:
        pole_pairs = 1.0 if self.parameters is None else self.parameters.get("motor.pole_pairs")
        return {
            Signal.I_D: self.i_d,
            Signal.I_Q: self.i_q,
            Signal.U_D: self.u_d,
            Signal.U_Q: self.u_q,
            Signal.OMEGA_E: pole_pairs * self.omega,
            Signal.TAU: K_T * self.i_q,
            Signal.U_DC: U_DC,
            Signal.THETA_M: self.theta,
            Signal.FLAGS: float(self.flags),
            Signal.KAPPA: 1.0,
            Signal.BINDING: 255.0,
            Signal.T_WINDING: 25.0,
        }.get(signal, 0.0)
