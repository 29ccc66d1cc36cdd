# SPDX-License-Identifier: MIT
"""The CiA 402 power drive system of the node: state machine, modes, references, reactions.

Torque values travel in permille of the rated torque 0x6076 (mN m), currents in permille of the rated current 0x6075
(mA rms), speeds in thousandths of a mechanical revolution per minute (mrpm).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.clock import Schedule, Timer
from pmsmtool.cia402 import AbortConnection, Control, FaultReaction, Mode, QuickStop, State, Status
from pmsmtool.sim.kernel import Signal
from pmsmtool.sim.node.dictionary import Dictionary, Refused
from pmsmtool.sim.node.drive_core import Command, ControlMode, DriveCore
from pmsmtool.sim.node.error_control import Emergency
from pmsmtool.sim.node.position_modes import FOLLOWING_ERROR, PositionModes
from pmsmtool.sim.node.position_modes import MODES as _POSITION_MODES
from pmsmtool.sim.node.quick_stop import Stopping
from pmsmtool.units import RAD_S_PER_MRPM

HEARTBEAT_LOST, PDO_MISSED = 0x8130, 0x8250
CONNECTION_ENDED = 0x8100
STANDSTILL_SHARE = 0.002
"""Share of n_max below which the machine counts as standing."""
STANDSTILL_FLOOR_RPM = 2.0
_SLOPE_STEP_S = 0.001
_SLOPE_STEP_NS = 1_000_000
_NO_SLOPE = 10_000_000
# Largest value of object 0x6087 and its default: a set-point is taken at once.
_FILTERED_PERMILLE = 1e-3
# Distance at which a filtered set-point counts as arrived.
_SPEED_MODES = (Mode.PROFILE_VELOCITY, Mode.CYCLIC_VELOCITY)
_TORQUE_MODES = (Mode.PROFILE_TORQUE, Mode.CYCLIC_TORQUE)
_LIMIT_FLAGS = 0x01 | 0x02 | 0x04 | 0x100
# Flags of the core that show as "internal limit active": voltage, duty, current, I2t.


class Plant(Protocol):
    """What the power drive needs of the hardware it sits on."""

    core: DriveCore
    set_point_filter_s: float

    def look(self) -> None:
        """Bring the core to the present instant."""

    def parameter(self, name: str) -> float:
        """Return an active parameter."""


class PowerDrive:
    """State machine and references.

    Attributes
    ----------
    state : State
        Present state.
    on_state, on_leave : callables
        Called after every change of the state; when normal operation ends, by a stop, a fault or another mode.
    speed_injection : bool
        Whether the identification mode needs the speed controller (set by the excitation).
    """

    def __init__(self, dictionary: Dictionary, schedule: Schedule, plant: Plant, emergency: Emergency) -> None:
        self.state = State.SWITCH_ON_DISABLED
        self.on_state: Callable[[], None] = lambda: None
        self.on_leave: Callable[[], None] = lambda: None
        self.speed_injection = False
        self._dictionary = dictionary
        self._schedule = schedule
        self._plant = plant
        self._emergency = emergency
        self._controlword = 0
        self._error_code = 0
        self._torque_demand = self._torque_filtered = 0.0
        self._slope_timer: Timer | None = None
        self._stepped_ns = -_SLOPE_STEP_NS
        self._after_stop = State.SWITCH_ON_DISABLED
        self._stopping = Stopping(
            dictionary,
            schedule,
            plant.core,
            omega_m=self.omega_m,
            standstill_rad_s=self._standstill_rad_s,
            parameter=plant.parameter,
            done=self._stopped,
        )
        self._position = PositionModes(
            dictionary,
            plant.core,
            look=plant.look,
            mode=lambda: self.mode,
            apply=self.apply,
            rated_torque=self._rated_torque_nm,
        )
        self._hook()

    # ---- objects -------------------------------------------------------------------------------

    def _hook(self) -> None:
        entries = self._dictionary.by_key
        entries["cia402.controlword"].sink = self._write_controlword
        entries["cia402.mode"].sink = self._write_mode
        entries["cia402.quick_stop"].sink = self._write_quick_stop
        for key in ("target_torque", "torque_offset", "target_velocity"):
            entries[f"cia402.{key}"].sink = self._reference_sink(f"cia402.{key}")
        for key in ("i_d_a", "i_q_a", "fixed_angle_rad"):
            entries[f"set_point.{key}"].sink = self._reference_sink(f"set_point.{key}")
        sources: dict[str, Callable[[], float]] = {
            "error_code": lambda: self._error_code,
            "statusword": self.statusword,
            "mode_display": lambda: self.mode,
            "velocity": lambda: self.omega_m() / RAD_S_PER_MRPM,
            "torque_demand": lambda: self._torque_demand,
            "torque": lambda: self._signal(Signal.TAU) / self._rated_torque_nm() * 1000.0,
            "current": self._current,
            "dc_link": lambda: 1000.0 * self._signal(Signal.U_DC),
        }
        for key, value in sources.items():
            entries[f"cia402.{key}"].shows(value)
        entries["cia402.encoder_counts"].put(self._plant.core.encoder_counts)

    def _reference_sink(self, key: str) -> Callable[[bytes], None]:
        def sink(data: bytes) -> None:
            self._dictionary[key].value = data
            self.apply()

        return sink

    def _write_quick_stop(self, data: bytes) -> None:
        if int.from_bytes(data, "little", signed=True) not in set(QuickStop):
            raise Refused(AbortCode.VALUE)
        self._dictionary["cia402.quick_stop"].value = data

    def _number(self, key: str) -> float:
        return self._dictionary[f"cia402.{key}"].number()

    def _signal(self, signal: Signal) -> float:
        self._plant.look()
        return self._plant.core.signal(signal)

    def _rated_torque_nm(self) -> float:
        return self._number("rated_torque") / 1000.0

    def _current(self) -> float:
        i_d, i_q = self._signal(Signal.I_D), self._signal(Signal.I_Q)
        milliampere_rms = 1000.0 * math.copysign(math.hypot(i_d, i_q), i_q) / math.sqrt(2.0)
        return 1000.0 * milliampere_rms / self._number("rated_current")

    def omega_m(self) -> float:
        """Return the mechanical speed the drive sees (rad/s)."""
        return self._signal(Signal.OMEGA_E) / max(1.0, self._plant.parameter("motor.pole_pairs"))

    def _standstill_rad_s(self) -> float:
        rpm = max(STANDSTILL_FLOOR_RPM, STANDSTILL_SHARE * self._plant.parameter("motor.n_max_rpm"))
        return 1000.0 * rpm * RAD_S_PER_MRPM

    @property
    def mode(self) -> Mode:
        """Mode of operation."""
        return Mode(self._dictionary["cia402.mode"].integer())

    def statusword(self) -> int:
        """Return the statusword."""
        word = int(self.state) | int(Status.REMOTE)  # plain numbers: it is what a drive is asked for most
        if self._signal(Signal.U_DC) >= self._plant.parameter("protection.U_dc_min_v"):
            word |= int(Status.VOLTAGE_ENABLED)
        if self.state is State.OPERATION_ENABLED:
            if int(self._signal(Signal.FLAGS)) & _LIMIT_FLAGS:
                word |= int(Status.INTERNAL_LIMIT)
            word |= int(self._mode_bits())
        return word

    def _mode_bits(self) -> Status:
        mode = self.mode
        if mode in _SPEED_MODES:
            omega = self.omega_m()
            reached = abs(omega - self._target_speed()) <= self._standstill_rad_s()
            bits = Status.TARGET_REACHED if reached else Status(0)
            return bits | (Status.SPEED_ZERO if abs(omega) <= self._standstill_rad_s() else Status(0))
        if mode in _TORQUE_MODES:
            target = self._target_torque()
            return Status.TARGET_REACHED if self._torque_demand == target else Status(0)
        return self._position.status() if mode in _POSITION_MODES else Status(0)

    # ---- state machine -------------------------------------------------------------------------

    def _write_controlword(self, data: bytes) -> None:
        word = int.from_bytes(data, "little")
        rising = word & ~self._controlword
        self._controlword = word
        self._dictionary["cia402.controlword"].value = data
        self._plant.look()
        if self.state is State.FAULT:
            if rising & Control.FAULT_RESET:
                self._reset_fault()
            return
        if rising & Control.FAULT_RESET:
            self._emergency.clear()  # acknowledges what is past and caused no fault
        if self.state is not State.FAULT_REACTION_ACTIVE:
            self._command(word, rising)

    def _command(self, word: int, rising: int) -> None:
        state = self.state
        if self._plant.core.torque_safely_off:
            return  # it stays in SWITCH ON DISABLED
        if not word & Control.ENABLE_VOLTAGE:
            if state is not State.SWITCH_ON_DISABLED:
                self._to(State.SWITCH_ON_DISABLED)
        elif not word & Control.QUICK_STOP_OFF:
            if state is State.OPERATION_ENABLED:
                self._begin_stop(self._quick_stop_option())
            elif state in (State.READY_TO_SWITCH_ON, State.SWITCHED_ON):
                self._to(State.SWITCH_ON_DISABLED)
        elif not word & Control.SWITCH_ON:
            if state in (State.SWITCH_ON_DISABLED, State.SWITCHED_ON, State.OPERATION_ENABLED):
                self._to(State.READY_TO_SWITCH_ON)
        elif not word & Control.ENABLE_OPERATION:
            if state in (State.READY_TO_SWITCH_ON, State.OPERATION_ENABLED):
                self._to(State.SWITCHED_ON)
        elif state is State.OPERATION_ENABLED:
            self._position.controlword(word, rising)
            self.apply()  # the halt bit may have changed
        elif state in (State.READY_TO_SWITCH_ON, State.SWITCHED_ON) or self._may_resume():
            self._to(State.OPERATION_ENABLED)

    def _may_resume(self) -> bool:
        return self.state is State.QUICK_STOP_ACTIVE and self._quick_stop_option().stays

    def _quick_stop_option(self) -> QuickStop:
        return QuickStop(int(self._number("quick_stop")))

    def _to(self, state: State) -> None:
        was_energised = self.state.energised
        self.state = state
        if state not in (State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE):
            self._stopping.cancel()
        if state is State.OPERATION_ENABLED:
            self._torque_demand = self._torque_filtered = 0.0
            self._position.begin()
            self.apply()
        elif not state.energised:
            self._plant.core.command(Command())
            if was_energised:
                self.on_leave()
        self.on_state()

    def _begin_stop(self, option: QuickStop, *, fault: bool = False) -> None:
        """Quick stop (transition 11) or fault reaction with a ramp (transition 13)."""
        if option is QuickStop.DISABLE:
            self._to(State.FAULT if fault else State.SWITCH_ON_DISABLED)
            return
        control = self._control_mode()
        self.on_leave()
        self._after_stop = State.FAULT if fault else State.SWITCH_ON_DISABLED
        self._stopping.begin(control, option)
        self._to(State.FAULT_REACTION_ACTIVE if fault else State.QUICK_STOP_ACTIVE)

    def _stopped(self) -> None:
        if self._after_stop is State.FAULT or not self._quick_stop_option().stays:
            self._to(self._after_stop)
        else:
            self._plant.core.command(Command())  # stays in quick stop active, without current

    def _reset_fault(self) -> None:
        core = self._plant.core
        core.reset_fault()
        if core.trip():
            return
        self._error_code = 0
        self._emergency.clear()
        self._to(State.SWITCH_ON_DISABLED)

    def fail(self, code: int, detail: bytes = b"", *, ramp: bool = False) -> None:
        """Enter the fault state; with ``ramp`` by the fault reaction option code, else at once."""
        if self.state in (State.FAULT, State.FAULT_REACTION_ACTIVE):
            return
        self._error_code = code
        self._emergency.raise_error(code, detail)
        reaction = FaultReaction(int(self._number("fault_reaction")))
        if ramp and self.state.energised and reaction is not FaultReaction.DISABLE:
            self._begin_stop(QuickStop.QUICK_STOP_RAMP, fault=True)
        else:
            self._to(State.FAULT)

    def check_trip(self) -> None:
        """Report a trip the core has latched."""
        code = self._plant.core.trip()
        if code and self.state is not State.FAULT:
            if self.state is State.FAULT_REACTION_ACTIVE:
                self._error_code = code
                self._to(State.FAULT)
                self._emergency.raise_error(code)
            else:
                self.fail(code)

    def check_position(self) -> None:
        """Report a following error, else go on to the set-point that waited."""
        if self.state is not State.OPERATION_ENABLED:
            return
        if self._position.failed():
            self.fail(FOLLOWING_ERROR, ramp=True)
        else:
            self._position.attend(self._controlword)

    def connection_lost(self, node: int, code: int = HEARTBEAT_LOST) -> None:
        """React to a lost heartbeat, or to a PDO that stays away, as object 0x6007 says."""
        self._plant.look()
        if self._abort_connection() is AbortConnection.FAULT:
            self.fail(code, bytes((node,)), ramp=True)
            return
        self._emergency.raise_error(code, bytes((node,)))
        self._leave_operation()

    def connection_regained(self, code: int = HEARTBEAT_LOST) -> None:
        """What was lost is back; a fault it caused stays until it is reset."""
        if self.state not in (State.FAULT, State.FAULT_REACTION_ACTIVE):
            self._emergency.clear(code)

    def connection_ended(self) -> None:
        """React to an NMT stop or a reset of the communication as object 0x6007 says (CiA 402-2)."""
        self._plant.look()
        if not self.state.energised:
            return
        if self._abort_connection() is AbortConnection.FAULT:
            self.fail(CONNECTION_ENDED, ramp=True)
        else:
            self._leave_operation()

    def _abort_connection(self) -> AbortConnection:
        return AbortConnection(int(self._number("abort_connection")))

    def _leave_operation(self) -> None:
        option = self._abort_connection()
        if option is AbortConnection.DISABLE_VOLTAGE and self.state.energised:
            self._to(State.SWITCH_ON_DISABLED)
        elif option is AbortConnection.QUICK_STOP and self.state is State.OPERATION_ENABLED:
            self._begin_stop(self._quick_stop_option())

    # ---- modes and references ------------------------------------------------------------------

    def _write_mode(self, data: bytes) -> None:
        number = int.from_bytes(data, "little", signed=True)
        if number not in set(Mode):
            raise Refused(AbortCode.VALUE)
        if number in _POSITION_MODES and self._plant.parameter("position.K_p_per_s") <= 0.0:
            raise Refused(AbortCode.DEVICE_STATE)  # not tuned
        changed = self._dictionary["cia402.mode"].value != data
        self._dictionary["cia402.mode"].value = data
        if changed and self.state is State.OPERATION_ENABLED:
            self.on_leave()
            self._torque_demand = self._torque_filtered = 0.0
            self._position.begin()
            self.apply()

    def _control_mode(self) -> ControlMode:
        mode = self.mode
        if mode in _SPEED_MODES or (mode is Mode.IDENTIFICATION and self.speed_injection):
            return ControlMode.SPEED
        if mode in _POSITION_MODES:
            return ControlMode.POSITION
        return ControlMode.TORQUE if mode in _TORQUE_MODES else ControlMode.CURRENT

    def _target_speed(self) -> float:
        if self._controlword & Control.HALT:
            return 0.0
        limit = self._number("max_speed") * 1000.0
        return min(max(self._number("target_velocity"), -limit), limit) * RAD_S_PER_MRPM

    def _target_torque(self) -> float:
        """Return the target torque in permille of rated."""
        if self._controlword & Control.HALT:
            return 0.0
        limit = self._number("max_torque")
        return min(max(self._number("target_torque") + self._number("torque_offset"), -limit), limit)

    def apply(self) -> None:
        """Give the references of the present mode to the core."""
        if self.state is not State.OPERATION_ENABLED:
            return
        self._plant.look()
        control = self._control_mode()
        if control is ControlMode.TORQUE:
            self._step_torque()
        elif control is ControlMode.SPEED:
            self._plant.core.command(Command(control, omega_m_rad_s=self._target_speed()))
        elif control is ControlMode.POSITION:
            halt = bool(self._controlword & Control.HALT)
            self._plant.core.command(Command(control, position=self._position.command(halt=halt)))
        elif self.mode is Mode.IDENTIFICATION and not self._controlword & Control.HALT:
            i_d, i_q, angle = (
                self._dictionary[f"set_point.{key}"].number() for key in ("i_d_a", "i_q_a", "fixed_angle_rad")
            )
            self._plant.core.command(Command(control, i_d_a=i_d, i_q_a=i_q, fixed_angle_rad=angle))
        else:
            self._plant.core.command(Command(control))

    def _step_torque(self) -> None:
        """Move the demand towards the target by the torque slope, once per millisecond however often it is written."""
        if self._slope_timer is not None:
            self._slope_timer.cancel()
            self._slope_timer = None
        if self.state is not State.OPERATION_ENABLED or self._control_mode() is not ControlMode.TORQUE:
            return
        target, now_ns, slope = self._target_torque(), self._schedule.now_ns, self._number("torque_slope")
        at_once = slope >= _NO_SLOPE and self._plant.set_point_filter_s == 0.0
        if at_once or now_ns >= self._stepped_ns + _SLOPE_STEP_NS:
            if self._torque_filtered != target:
                self._stepped_ns = now_ns
            step = slope * _SLOPE_STEP_S
            self._torque_demand += min(max(target - self._torque_demand, -step), step)
            self._filter_torque()
        torque = self._torque_filtered / 1000.0 * self._rated_torque_nm()
        self._plant.core.command(Command(ControlMode.TORQUE, torque_nm=torque))
        if self._torque_demand != target or self._torque_filtered != self._torque_demand:
            self._slope_timer = self._schedule.at(self._stepped_ns + _SLOPE_STEP_NS, self._step_torque)

    def _filter_torque(self) -> None:
        """First-order filter of the set-point, where the drive has one."""
        filter_s, left = self._plant.set_point_filter_s, self._torque_demand - self._torque_filtered
        if filter_s == 0.0 or abs(left) < _FILTERED_PERMILLE:
            self._torque_filtered = self._torque_demand
        else:
            self._torque_filtered -= math.expm1(-_SLOPE_STEP_S / filter_s) * left
