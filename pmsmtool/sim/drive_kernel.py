# SPDX-License-Identifier: MIT
"""The simulated drive behind the CANopen node, ``node.drive_core.DriveCore`` on the kernel; the supply that feeds it.

Every method reads or writes a few words of the C structs; time passes only in :meth:`KernelCore.run`, N control periods
in one call. What the drive takes over at its next period (an excitation, a recorder set-up) is reported as taken
at once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pmsmtool.drive.port import Excitation
from pmsmtool.errors import ConfigError
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.params.parameter_set import default_set
from pmsmtool.sim.closed_loop import image_of
from pmsmtool.sim.kernel import Part, Signal, Simulation, Truth
from pmsmtool.sim.node.drive_core import (
    BUFFER_SAMPLES,
    TRACE_BYTES,
    TRACE_CHANNELS,
    Averages,
    AverageState,
    Command,
    ControlMode,
    ExcitationState,
    HomingPhase,
    PositionCommand,
    PositionFlag,
    PositionState,
    RecorderSetup,
    RecorderState,
    RecorderStatus,
)
from pmsmtool.sim.simulated_machine import (
    RECORD_COMPENSATION,
    build_setup,
    own_compensation,
    records_compensation,
    settings_of,
)

STOP, ARM, START = 0, 1, 2
"""Commands of excitation, recorder (START: force) and averages (ARM: start) in ``pmsm_application.h``."""

TRIPS = {"phases_shorted": 0x2320, "encoder_signal": 0x7305}
"""Error codes of wiring that fails with the first current (CiA 402-2, 0x603F)."""
LIMITED = 0.6
"""DC link of a supply in current limit, of its voltage without a current."""
IDEAL_ENCODER_COUNTS = 1 << 24
"""Counts per turn that a drive with an ideal encoder (``encoder_bits = 0``) claims."""


class KernelCore:
    """A drive's application with its machine, as the node sees it.

    Attributes
    ----------
    simulation : Simulation
        The kernel, for tests that look at the truth; the node does not.
    """

    def __init__(self, machine_file: MachineFile, seed: int) -> None:
        setup, keep = build_setup(machine_file, seed=seed)
        settings = settings_of(machine_file)
        bits = settings.whole("encoder_bits")
        self._counts = 1 << bits if bits else IDEAL_ENCODER_COUNTS
        self._compensation = own_compensation(machine_file)
        self._records_compensation = records_compensation(machine_file)
        self._image = image_of(machine_file, default_set())
        self._averaged: Sequence[Signal] = ()
        self._fault = settings.text("drive_fault")
        self.torque_safely_off = self._fault == "safe_torque_off"
        self._link_v = settings.number("U_dc_v")
        self.simulation = Simulation(setup, self._image, keep)
        switches = [f"limit_switch_{way}_rad" for way in ("negative", "positive")]
        if any(name in machine_file.simulation for name in switches):
            self.simulation.library.pmsm_sim_set_switches(self.simulation.sim, *map(settings.number, switches))
        self.simulation.library.pmsm_sim_watch(self.simulation.sim, 1)
        self._parameters_changed()

    # ---- parameters and modes --------------------------------------------------------------------------

    @property
    def period_ns(self) -> int:
        """Control period of the loaded parameters (ns)."""
        return int(self.simulation.params.inverter_T_s_ns)

    @property
    def encoder_counts(self) -> int:
        """Encoder counts per mechanical turn."""
        return self._counts

    def load(self, image: bytes) -> None:
        """Take a parameter image; controller memory is kept."""
        self.simulation.load(image)
        self._image = image
        self._parameters_changed()

    def _parameters_changed(self) -> None:
        """Lay the compensation that is built into the drive over the parameters; no object shows it."""
        self.simulation.position.asked.increments = self._counts
        params = self.simulation.params
        for name, value in self._compensation.items():
            member = name.replace(".", "_")
            setattr(params, member, type(getattr(params, member))(value))
        if self._records_compensation:
            params.current_options |= RECORD_COMPENSATION

    def restart(self) -> None:
        """Firmware reset: gates off, memory of the application cleared; the rotor moves on."""
        self.simulation.library.pmsm_drive_init(self.simulation.drive)
        self._averaged = ()
        self.load(self._image)

    def command(self, command: Command) -> None:
        """Set mode and references from the next period on; mode OFF removes the gate signals at once."""
        reference = self.simulation.reference
        reference.mode = int(command.mode)
        reference.i_d_ref, reference.i_q_ref = command.i_d_a, command.i_q_a
        reference.tau_ref, reference.omega_M_ref = command.torque_nm, command.omega_m_rad_s
        reference.u_d_inject = reference.u_q_inject = reference.bias_bandwidth = 0.0
        self.simulation.fixed_angle.value = command.fixed_angle_rad
        if command.position is not None:
            self._command_position(command.position)
        self.simulation.word(Part.QUICK_STOP).value = int(command.quick_stop)
        self.simulation.word(Part.ENABLED).value = int(command.mode != ControlMode.OFF)
        self._fail(command)

    def _fail(self, command: Command) -> None:
        """Let the wiring fail with the first current, and the link fall while one is asked for."""
        asked = bool(command.i_d_a or command.i_q_a or command.torque_nm or command.omega_m_rad_s)
        if asked and self._fault in TRIPS:
            self.simulation.word(Part.TRIP).value = TRIPS[self._fault]
        if self._fault == "supply_limit":
            self.simulation.library.pmsm_sim_set_U_dc(self.simulation.sim, (LIMITED if asked else 1.0) * self._link_v)

    def _command_position(self, command: PositionCommand) -> None:
        asked = self.simulation.position.asked
        asked.profile, asked.target, asked.set_point = command.profile, command.target, command.set_point
        asked.interval, asked.velocity, asked.jerk = command.interval_s, command.velocity, command.jerk
        asked.acceleration, asked.deceleration = command.acceleration, command.deceleration
        asked.stop_deceleration, asked.halt = command.stop_deceleration, command.halt
        asked.minimum, asked.maximum = command.minimum, command.maximum
        asked.window, asked.window_time = command.window, command.window_time_s
        homing = command.homing
        asked.homing.active, asked.homing.start = homing.active, homing.start
        asked.homing.method, asked.homing.home_offset = homing.method, homing.home_offset
        asked.homing.slow, asked.homing.torque = homing.slow, homing.torque_nm

    def position(self) -> PositionState:
        """Return the state of the position controller."""
        now = self.simulation.position
        flags = PositionFlag(now.flags)
        return PositionState(now.actual, now.reference, now.error, flags, now.limits, HomingPhase(now.homing))

    # ---- time --------------------------------------------------------------------------------------------

    def run(self, periods: int) -> int:
        """Run at most ``periods`` control periods; early return when a state that the node reports changed."""
        return self.simulation.run(periods)

    def signal(self, signal: Signal) -> float:
        """Return a signal as it would be recorded now."""
        return float(self.simulation.library.pmsm_application_signal(self.simulation.application, int(signal)))

    def trip(self) -> int:
        """Return the latched trip code, 0 when there is none."""
        return int(self.simulation.word(Part.TRIP).value)

    def reset_fault(self) -> None:
        """Clear the trip latch."""
        self.simulation.library.pmsm_application_reset_fault(self.simulation.application)

    # ---- excitation ----------------------------------------------------------------------------------------

    def excite(self, excitation: Excitation | None) -> None:
        """Start an excitation, change the running one, or end it with None.

        Raises ConfigError: the buffer is longer than the drive's.
        """
        out = self.simulation.excitation
        if excitation is None:
            out.command = STOP
            return
        if len(excitation.buffer) > BUFFER_SAMPLES:
            raise ConfigError(
                f"{len(excitation.buffer)} samples do not fit the buffer of {BUFFER_SAMPLES}",
                hint="give a shorter buffer",
            )
        running = self.excitation_state() is ExcitationState.RUNNING
        out.shape, out.point, out.hold_periods = excitation.shape, excitation.point, excitation.hold_periods
        out.amplitude, out.amplitude_q = excitation.amplitude, excitation.amplitude_q
        out.bias_d, out.bias_q = excitation.bias_d_a, excitation.bias_q_a
        out.bias_bandwidth = excitation.bias_bandwidth_rad_s
        out.f0, out.f1, out.duration = excitation.f0_hz, excitation.f1_hz, excitation.duration_s
        out.fixed_angle = math.nan if excitation.fixed_angle_rad is None else excitation.fixed_angle_rad
        out.i_limit_d, out.i_limit_q = excitation.i_limit_d_a, excitation.i_limit_q_a
        out.i_centre_d = excitation.i_centre_d_a
        out.abort_current, out.abort_speed = excitation.abort_current_apk, excitation.abort_speed_rad_s
        out.buffer_samples = len(excitation.buffer)
        if excitation.buffer:
            self.simulation.floats_at(Part.BUFFER, len(excitation.buffer))[:] = list(excitation.buffer)
        if not running:
            out.command = START

    def excitation_state(self) -> ExcitationState:
        """Return the state; a start or stop that the next period takes over counts as taken."""
        out = self.simulation.excitation
        if out.command == START:
            return ExcitationState.RUNNING
        return ExcitationState.IDLE if out.command == STOP else ExcitationState(out.state)

    # ---- recorder ------------------------------------------------------------------------------------------

    def record(self, setup: RecorderSetup | None) -> None:
        """Arm the recorder, or stop it with None.

        Raises ConfigError: too many channels, or rows that do not fit the memory.
        """
        out = self.simulation.recorder
        if setup is None:
            out.command = STOP
            return
        if len(setup.channels) > TRACE_CHANNELS or 4 * len(setup.channels) * setup.depth > TRACE_BYTES:
            raise ConfigError(
                f"{setup.depth} rows of {len(setup.channels)} channels do not fit the recorder",
                hint="ask for fewer rows or fewer signals",
            )
        out.decimation, out.depth, out.pretrigger = setup.decimation, setup.depth, setup.pretrigger
        out.trigger, out.trigger_signal, out.trigger_level = setup.trigger, setup.source, setup.level
        out.channel[:] = _padded(setup.channels)
        out.command = ARM

    def force_trigger(self) -> None:
        """Trigger an armed recorder now; one that was armed in this instant is not armed yet, so it starts at once."""
        out = self.simulation.recorder
        if out.command == ARM:
            out.trigger = 0
        else:
            out.command = START

    def recorder(self) -> RecorderStatus:
        """Return the state of the recorder."""
        out = self.simulation.recorder
        if out.command == ARM:
            return RecorderStatus(RecorderState.ARMED)
        return RecorderStatus(RecorderState(out.state), out.stored, out.trigger_position)

    def recording(self) -> bytes:
        """Return the stored rows, oldest first."""
        out = self.simulation.recorder
        channels = sum(channel != Signal.NONE for channel in out.channel)
        return bytes(self.simulation.bytes_at(Part.TRACE, 4 * channels * out.stored))

    # ---- averages ------------------------------------------------------------------------------------------

    def average(self, signals: Sequence[Signal], periods: int) -> None:
        """Start a window average over the next ``periods`` periods; 0 stops it."""
        out = self.simulation.average
        self._averaged = tuple(signals)
        out.signal[:] = _padded(signals)
        out.periods = periods
        out.command = ARM if periods else STOP

    def averages(self) -> Averages:
        """Return the state and, when complete, means and standard deviations."""
        out = self.simulation.average
        pending = {STOP: AverageState.IDLE, ARM: AverageState.RUNNING}.get(out.command)
        state = AverageState(out.state) if pending is None else pending
        if state is not AverageState.COMPLETE:
            return Averages(state)
        count = len(self._averaged)
        return Averages(state, tuple(out.mean[:count]), tuple(out.std[:count]))


def _padded(signals: Sequence[Signal]) -> list[int]:
    if len(signals) > TRACE_CHANNELS:
        raise ConfigError(f"{len(signals)} signals do not fit {TRACE_CHANNELS} channels", hint="ask for fewer signals")
    return [*map(int, signals), *[0] * (TRACE_CHANNELS - len(signals))]


def create(machine_file: MachineFile, seed: int) -> KernelCore:
    """Return the application of one simulated drive; what the bus plug-in calls for each drive on a line."""
    return KernelCore(machine_file, seed)


IDLE_W = 4.0
"""Power of the drive without a motor current."""
SWITCHING_S = 1e-7
"""Time by whose share of the control period a phase current loads the link: switching loss."""
GAIN = 0.003
"""Largest error of either display's gain."""
CURRENT_DIGIT_A = 1e-3
VOLTAGE_DIGITS = ((100.0, 0.01), (np.inf, 0.1))
"""Last digit (V) up to a voltage (V)."""


class BenchSupply:
    """A bench supply that feeds one drive: voltage and current as a person reads them off its display.

    The power is what machine and inverter take at standstill: copper, the devices' drops and slopes (switch and diode
    carry each phase current half of the time near zero voltage), switching loss in proportion to the current, and what
    the drive takes by itself. The display rounds, and its gains are off by a fixed part within its class.
    """

    def __init__(self, core: KernelCore, seed: int) -> None:
        self._simulation = core.simulation
        self._period_s = 1e-9 * core.period_ns
        self._rng = np.random.default_rng([20260103, seed])
        self._gains = 1.0 + GAIN * self._rng.uniform(-1.0, 1.0, 2)

    def power_w(self) -> float:
        """Return what drive and machine take now (W)."""
        machine, inverter = self._simulation.setup.machine, self._simulation.setup.inverter
        signal = self._simulation.signal
        rise = signal(Truth.T_WINDING) - machine.T_ref
        R = machine.R_copper * (1.0 + machine.alpha_R * rise) + machine.R_fixed
        two_kinds = inverter.V_switch > 0.0  # else the channel conducts both ways, and diodes in the dead time only
        R += 0.5 * (inverter.r_switch + inverter.r_diode) if two_kinds else inverter.r_switch
        drop = 0.5 * (inverter.V_switch + inverter.V_diode) if two_kinds else 0.0
        drop += signal(Truth.U_DC) * SWITCHING_S / self._period_s
        currents = [signal(part) for part in (Truth.I_A, Truth.I_B, Truth.I_C)]
        return IDLE_W + sum(float(R * i * i + drop * abs(i)) for i in currents)

    def read(self) -> tuple[float, float]:
        """Return voltage (V) and current (A) as they are shown."""
        volts = self._simulation.signal(Truth.U_DC)
        amps = self.power_w() / volts
        digit = next(step for limit, step in VOLTAGE_DIGITS if volts < limit)
        shown = self._gains * (volts, amps) + self._rng.uniform(-0.5, 0.5, 2) * (digit, CURRENT_DIGIT_A)
        return round(shown[0] / digit) * digit, round(shown[1] / CURRENT_DIGIT_A) * CURRENT_DIGIT_A
