# SPDX-License-Identifier: MIT
"""Excitation, trace recorder, window averages and live values of the node (objects 0x2050 to 0x2070).

The node checks and translates; what happens every control period is the core's. Trace channels, the trigger source
and the averaged signals are named by mapping words of live values (index << 16 | sub << 8 | bits).
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Callable, Sequence
from functools import partial

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.cia402 import EXCITATION_ABORTED, Mode, State
from pmsmtool.drive.port import Excitation, Injection, Shape
from pmsmtool.sim.kernel import Signal
from pmsmtool.sim.node.dictionary import Dictionary, Refused
from pmsmtool.sim.node.drive_core import (
    BUFFER_SAMPLES,
    TRACE_BYTES,
    TRACE_CHANNELS,
    Averages,
    AverageState,
    ExcitationState,
    RecorderSetup,
    RecorderState,
    Trigger,
)
from pmsmtool.sim.node.power_drive import Plant, PowerDrive

LIVE_SIGNALS: dict[str, Signal] = {
    "i_d_a": Signal.I_D,
    "i_q_a": Signal.I_Q,
    "i_d_ref_a": Signal.I_D_REF,
    "i_q_ref_a": Signal.I_Q_REF,
    "u_d_v": Signal.U_D,
    "u_q_v": Signal.U_Q,
    "omega_e_rad_s": Signal.OMEGA_E,
    "U_dc_v": Signal.U_DC,
    "i_d_req_a": Signal.I_D_REQ,
    "i_q_req_a": Signal.I_Q_REQ,
    "theta_e_rad": Signal.THETA_E,
    "u_d_lim_v": Signal.U_D_LIM,
    "u_q_lim_v": Signal.U_Q_LIM,
    "i_a_a": Signal.I_A,
    "i_b_a": Signal.I_B,
    "i_c_a": Signal.I_C,
    "flags": Signal.FLAGS,
    "T_winding_c": Signal.T_WINDING,
    "T_magnet_c": Signal.T_MAGNET,
    "theta_m_rad": Signal.THETA_M,
    "torque_nm": Signal.TAU,
    "kappa": Signal.KAPPA,
    "binding": Signal.BINDING,
    "iterations": Signal.ITERATIONS,
    "following_error_rad": Signal.FOLLOWING_ERROR,
    "hall_pattern": Signal.HALL,
}
"""Live values (key behind ``live.``) and the core's signal behind each."""

_WHILE_RUNNING = ("amplitude", "bias_d_a", "bias_q_a", "f0_hz", "fixed_angle_rad")
# Fields of the excitation that change the running one when they are written.
_FLOAT_FIELDS = (
    "amplitude",
    "bias_d_a",
    "bias_q_a",
    "bias_bandwidth_rad_s",
    "f0_hz",
    "f1_hz",
    "duration_s",
    "amplitude_q",
    "i_limit_d_a",
    "i_limit_q_a",
    "i_centre_d_a",
    "abort_current_apk",
    "abort_speed_rad_s",
)


class Measurement:
    """Objects 0x2050 to 0x2070 of one session."""

    def __init__(self, dictionary: Dictionary, plant: Plant, power: PowerDrive) -> None:
        self._dictionary = dictionary
        self._plant = plant
        self._power = power
        self._armed = False
        self._signals = self._signal_words()
        self._hook_live()
        self._hook_excitation()
        self._hook_recorder()
        self._hook_averages()
        power.on_leave = self.end_excitation

    # ---- live values and mapping words ---------------------------------------------------------

    def _signal_words(self) -> dict[int, Signal]:
        keys = {f"live.{name}": signal for name, signal in LIVE_SIGNALS.items()}
        keys |= {"governor.kappa": Signal.KAPPA, "governor.binding": Signal.BINDING}
        words = {}
        for key, signal in keys.items():
            row = self._dictionary[key].row
            words[row.index << 16 | row.sub << 8 | 8 * row.data_type.size] = signal
        return words

    def _source(self, key: str, value: Callable[[], float]) -> None:
        entry = self._dictionary[key]

        def source() -> bytes:
            self._plant.look()
            return entry.encode(value())

        entry.source = source

    def _live_source(self, key: str, signal: Signal) -> None:
        self._source(key, lambda: self._plant.core.signal(signal))

    def _hook_live(self) -> None:
        for name, signal in LIVE_SIGNALS.items():
            self._live_source(f"live.{name}", signal)
        self._live_source("governor.kappa", Signal.KAPPA)
        self._live_source("governor.binding", Signal.BINDING)
        self._source("governor.horizon_used", lambda: self._plant.parameter("governor.k_max"))

    def _take_word(self, key: str, data: bytes) -> None:
        word = int.from_bytes(data, "little")
        if word and word not in self._signals:
            raise Refused(AbortCode.NOT_MAPPABLE)
        self._dictionary[key].value = data

    def _channels(self, prefix: str) -> Sequence[Signal]:
        words = [self._dictionary[f"{prefix}.channel_{number + 1}"].integer() for number in range(TRACE_CHANNELS)]
        return [self._signals[word] for word in words if word]

    # ---- excitation ----------------------------------------------------------------------------

    def _hook_excitation(self) -> None:
        entries = self._dictionary.by_key
        entries["excitation.command"].sink = self._command_excitation
        entries["excitation.buffer"].sink = self._write_buffer
        self._source("excitation.state", self.excitation_state)
        buffer = entries["excitation.buffer"]
        self._source("excitation.buffer_samples", lambda: len(buffer.value) // 4)
        for name in _WHILE_RUNNING:
            entries[f"excitation.{name}"].sink = partial(self._change_running, f"excitation.{name}")

    def _write_buffer(self, data: bytes) -> None:
        if len(data) % 4 or len(data) > 4 * BUFFER_SAMPLES:
            raise Refused(AbortCode.TOO_LONG if len(data) > 4 * BUFFER_SAMPLES else AbortCode.LENGTH)
        if not all(map(math.isfinite, struct.unpack(f"<{len(data) // 4}f", data))):
            raise Refused(AbortCode.VALUE)
        self._dictionary["excitation.buffer"].value = data

    def _change_running(self, key: str, data: bytes) -> None:
        self._dictionary[key].value = data
        self._plant.look()
        if self._plant.core.excitation_state() is ExcitationState.RUNNING:
            self._plant.core.excite(self._excitation())

    def _excitation(self) -> Excitation:
        entries = self._dictionary.by_key
        floats = {name: entries[f"excitation.{name}"].number() for name in _FLOAT_FIELDS}
        angle = entries["excitation.fixed_angle_rad"].number()
        buffer = entries["excitation.buffer"].value
        return Excitation(
            shape=Shape(entries["excitation.shape"].integer()),
            point=Injection(entries["excitation.point"].integer()),
            hold_periods=entries["excitation.hold_periods"].integer(),
            fixed_angle_rad=None if math.isnan(angle) else angle,
            buffer=struct.unpack(f"<{len(buffer) // 4}f", buffer),
            **floats,
        )

    def excitation_state(self) -> ExcitationState:
        """Return object 0x2050:0E."""
        return ExcitationState.ARMED if self._armed else self._plant.core.excitation_state()

    def _command_excitation(self, data: bytes) -> None:
        self._plant.look()
        command = data[0]
        if command == 2:
            self._start_excitation()
        else:
            self._plant.core.excite(None)
            self._armed = command == 1
            self._use_speed_controller(False)
        self._dictionary["excitation.command"].value = data

    def _start_excitation(self) -> None:
        excitation = self._excitation()
        speed = excitation.point is Injection.SPEED
        mode = self._power.mode
        fits = mode is Mode.IDENTIFICATION or (speed and mode in (Mode.PROFILE_VELOCITY, Mode.CYCLIC_VELOCITY))
        if self._power.state is not State.OPERATION_ENABLED or not fits or excitation.shape is Shape.NONE:
            raise Refused(AbortCode.DEVICE_STATE)
        if excitation.shape is Shape.BUFFER and not excitation.buffer:
            raise Refused(AbortCode.NO_DATA)
        self._armed = False
        self._use_speed_controller(speed)
        self._plant.core.excite(excitation)

    def _use_speed_controller(self, wanted: bool) -> None:
        if wanted != self._power.speed_injection:
            self._power.speed_injection = wanted
            self._power.apply()

    def end_excitation(self) -> None:
        """The power drive leaves normal operation: nothing is injected any more."""
        self._armed = False
        self._power.speed_injection = False
        if self._plant.core.excitation_state() is ExcitationState.RUNNING:
            self._plant.core.excite(None)

    def attend(self) -> None:
        """Look after what the core has finished or aborted."""
        if self._power.state.energised and self._plant.core.excitation_state() is ExcitationState.ABORTED:
            self._power.fail(EXCITATION_ABORTED)

    # ---- recorder ------------------------------------------------------------------------------

    def _hook_recorder(self) -> None:
        entries = self._dictionary.by_key
        entries["trace.command"].sink = self._command_recorder
        for key in ("trace.source", *(f"trace.channel_{number + 1}" for number in range(TRACE_CHANNELS))):
            entries[key].sink = partial(self._take_word, key)
        core = self._plant.core
        self._source("trace.state", lambda: core.recorder().state)
        self._source("trace.stored", lambda: core.recorder().stored)
        self._source("trace.position", lambda: core.recorder().trigger_position)
        self._source("trace.crc", lambda: zlib.crc32(self._recording()))
        self._source("trace.period_ns", lambda: core.period_ns * entries["trace.decimation"].integer())
        self._source("trace.voltage_lag", lambda: round(self._plant.parameter("inverter.delay_periods") - 0.5))
        entries["trace.data"].source = self._recording

    def _recording(self) -> bytes:
        self._plant.look()
        core = self._plant.core
        if core.recorder().state in (RecorderState.ARMED, RecorderState.TRIGGERED):
            raise Refused(AbortCode.DEVICE_STATE)
        return core.recording()

    def _command_recorder(self, data: bytes) -> None:
        self._plant.look()
        core = self._plant.core
        if data[0] == 1:
            core.record(self._recorder_setup())
        elif data[0] == 2:
            core.force_trigger()
        else:
            core.record(None)
        self._dictionary["trace.command"].value = data

    def _recorder_setup(self) -> RecorderSetup:
        entries = self._dictionary.by_key
        channels = self._channels("trace")
        depth, pretrigger = entries["trace.depth"].integer(), entries["trace.pretrigger"].integer()
        if not channels:
            raise Refused(AbortCode.NO_DATA)
        if 4 * depth * len(channels) > TRACE_BYTES:
            raise Refused(AbortCode.PDO_LENGTH)
        if pretrigger >= depth:
            raise Refused(AbortCode.INCOMPATIBLE)
        trigger = Trigger(entries["trace.trigger"].integer())
        source = entries["trace.source"].integer()
        if trigger in (Trigger.RISING, Trigger.FALLING, Trigger.WINDOW) and not source:
            raise Refused(AbortCode.INCOMPATIBLE)
        return RecorderSetup(
            channels=channels,
            depth=depth,
            decimation=entries["trace.decimation"].integer(),
            pretrigger=pretrigger,
            trigger=trigger,
            source=self._signals[source] if source else Signal.NONE,
            level=entries["trace.level"].number(),
        )

    # ---- window averages -----------------------------------------------------------------------

    def _hook_averages(self) -> None:
        entries = self._dictionary.by_key
        entries["average.command"].sink = self._command_averages
        self._source("average.state", lambda: self._plant.core.averages().state)
        for number in range(TRACE_CHANNELS):
            key = f"average.channel_{number + 1}"
            entries[key].sink = partial(self._take_word, key)
            self._source(f"average.mean_{number + 1}", partial(self._averaged, number, lambda result: result.mean))
            self._source(f"average.std_{number + 1}", partial(self._averaged, number, lambda result: result.std))

    def _averaged(self, number: int, pick: Callable[[Averages], Sequence[float]]) -> float:
        result = self._plant.core.averages()
        values = pick(result)
        return values[number] if result.state is AverageState.COMPLETE and number < len(values) else math.nan

    def _command_averages(self, data: bytes) -> None:
        self._plant.look()
        if data[0]:
            signals = self._channels("average")
            if not signals:
                raise Refused(AbortCode.NO_DATA)
            self._plant.core.average(signals, self._dictionary["average.periods"].integer())
        else:
            self._plant.core.average((), 0)
        self._dictionary["average.command"].value = data
