# SPDX-License-Identifier: MIT
"""What stands behind a foreign drive's objects: the simulated power drive and its machine, in SI and peak values."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from pmsmtool.cia402 import Mode
from pmsmtool.sim.kernel import Signal
from pmsmtool.sim.node.dictionary import Dictionary, Entry
from pmsmtool.sim.node.drive_core import RecorderSetup
from pmsmtool.sim.node.power_drive import Plant, PowerDrive

if TYPE_CHECKING:
    from pmsmtool.machine.machine_file import MachineFile

INNER_MODES = {
    3: Mode.PROFILE_VELOCITY, 4: Mode.PROFILE_TORQUE, 9: Mode.CYCLIC_VELOCITY, 10: Mode.CYCLIC_TORQUE,
    11: Mode.IDENTIFICATION,
}  # fmt: skip
"""Modes that move the simulated machine by themselves; the others, but those of position, are taken without current."""
RAD_S_PER_MRPM = 2.0 * math.pi / 60_000.0
"""Not the tool's: a mistake in its units must not agree with itself here."""
POSITION_BITS = 32
NO_SLOPE = 10_000_000.0
SPEED_RAD_S, SPEED_INTEGRAL = 60.0, 0.25
"""Bandwidth of the speed loop as a set-up tool leaves it, and its integral rate as a share of it."""
STORED_RATIO = 4.0
"""Crossover of the speed over the position gain and over the integral rate, as a maker's tool leaves them."""
ANGLE_COUNTS = 65536
"""Of the commutation angle 0x60EA per electrical turn (CiA 402-2)."""
POSITION_MODES = (1, 8)
"""Modes in which ``position.PositionLoop`` commands the torque."""


@dataclass(frozen=True, slots=True)
class SetUp:
    """The motor as its maker's set-up tool would have entered it."""

    pole_pairs: int
    """Of the motor."""
    R_s_ohm: float
    L_q_h: float
    """Per phase."""
    i_nom_apk: float
    i_max_apk: float
    """Rated and largest current (A peak)."""
    torque_nm: float
    """Rated torque."""
    n_max_rpm: float
    """Largest speed."""
    counts: int
    """Encoder counts per turn."""
    K_p_v_per_a: float
    K_i_v_per_as: float
    """Gains of the current loops."""
    J_kgm2: float
    J_load_kgm2: float = 0.0
    """Inertia of the motor, for the speed loop; of the load besides, for the position loop."""

    @property
    def torque_constant(self) -> float:
        """Torque per current (N m per A peak)."""
        return self.torque_nm / self.i_nom_apk


def set_up_of(machine_file: MachineFile) -> SetUp:
    """Return the motor of a machine file as a maker's tool would enter it."""
    from pmsmtool.sim.drive_kernel import IDEAL_ENCODER_COUNTS
    from pmsmtool.sim.node.factory import factory_values, set_up_values
    from pmsmtool.sim.simulated_machine import settings_of

    values = factory_values(machine_file) | set_up_values(machine_file)
    i_nom = values["motor.I_nom_apk"]
    bits = settings_of(machine_file).whole("encoder_bits")
    return SetUp(
        round(values["motor.pole_pairs"]), values["motor.R_s_ohm"], values["motor.L_q_h"], i_nom,
        values["motor.I_max_apk"], abs(machine_file.machine.torque_nm(0.0, i_nom)) or 1.0, values["motor.n_max_rpm"],
        1 << bits if bits else IDEAL_ENCODER_COUNTS,
        values["current.K_p_q_v_per_a"], values["current.K_i_q_v_per_as"],
        settings_of(machine_file).number("J_kgm2"), settings_of(machine_file).number("J_load_kgm2"),
    )  # fmt: skip


@dataclass(slots=True)
class PositionGains:
    """Gains, torque at the motor; ``pid`` of the position where set, else a cascade."""

    K_p: float
    K_i: float
    K_v: float
    pid: list[float] | None = None
    inertia_ff: float = 0.0
    friction_ff: float = 0.0


def stored_gains(J_kgm2: float) -> PositionGains:
    """Return what a maker's tool leaves: calm, without feed-forward."""
    K_p, rate = SPEED_RAD_S * J_kgm2, SPEED_RAD_S / STORED_RATIO
    K_i = K_p * rate
    return PositionGains(K_p, K_i, rate, [K_p * rate + K_i, K_i * rate, K_p])


@dataclass(slots=True)
class Behind:
    """The machine and the application that the objects show and command."""

    dictionary: Dictionary
    plant: Plant
    power: PowerDrive
    """Of the session."""
    set_up: SetUp
    """The motor."""
    largest_step: float = 0.0
    """Largest change of a torque command while energised in a cyclic mode, share of the rated torque; for tests."""
    velocity_ff: float = 0.0
    acceleration_ff_s: float = 0.0
    """Share of a move's speed that a cascade adds to its speed reference, and how many seconds of its acceleration."""
    derivative_share: float = 0.0
    """Share of the speed of the following error that it adds."""
    position_gains: PositionGains = field(init=False)
    """Of the position modes."""
    _turns_off: int = field(default=0, init=False)
    _before_record: float | None = field(default=None, init=False)
    _torque_nm: float = field(default=0.0, init=False)
    _slope: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        self.position_gains = stored_gains(self.set_up.J_kgm2 + self.set_up.J_load_kgm2)

    @property
    def direction(self) -> float:
        """Sign of the encoder's counts while the shaft turns along the phase order, as the set-up found it."""
        return -1.0 if self.dictionary["encoder.reversed"].integer() else 1.0

    # ---- what is shown --------------------------------------------------------------------------

    def _signal(self, signal: Signal) -> float:
        self.plant.look()
        return self.plant.core.signal(signal)

    def position(self, units_per_turn: float) -> float:
        """Return the angle in units, as a counter of 32 bits."""
        half = 1 << POSITION_BITS - 1
        return (round(self._shaft_turns() * units_per_turn) + half) % (2 * half) - half

    def _shaft_turns(self) -> float:
        seen = self._signal(Signal.THETA_M) / (2.0 * math.pi)
        if self._before_record is not None:  # the shaft has turned by less than half a turn since
            self._turns_off, self._before_record = round(self._before_record - seen), None
        return seen + self._turns_off

    def record(self, setup: RecorderSetup) -> None:
        """Start the recorder of the core; it takes whole turns off the angle, which no counter of a drive forgets."""
        self._before_record = self._shaft_turns()
        self.plant.core.record(setup)

    def turns_per_s(self) -> float:
        """Return the mechanical speed."""
        return self.power.omega_m() / (2.0 * math.pi)

    def i_q_a(self) -> float:
        """Return the torque current (A peak)."""
        return self._signal(Signal.I_Q)

    def i_q_asked_a(self) -> float:
        """Return the torque current that the current loop is asked for (A peak)."""
        return self._signal(Signal.I_Q_REF)

    def i_d_a(self) -> float:
        """Return the flux current (A peak)."""
        return self._signal(Signal.I_D)

    def torque_nm(self) -> float:
        """Return what a drive takes for its torque: the torque current times its torque constant."""
        return self.i_q_a() * self.set_up.torque_constant

    def U_dc_v(self) -> float:
        """Return the DC link (V)."""
        return self._signal(Signal.U_DC)

    # ---- what is commanded ----------------------------------------------------------------------

    def _write(self, key: str, number: float) -> None:
        inner: Entry = self.dictionary[key]
        self.dictionary.write(inner, inner.encode(number))

    def command_mode(self, mode: int) -> None:
        """Choose the mode that acts; a cyclic torque has no slope of the drive's (CiA 402-2, mode 10)."""
        inner = Mode.CYCLIC_TORQUE if mode in POSITION_MODES else INNER_MODES.get(mode, Mode.NONE)
        self._write("cia402.mode", inner)
        if mode in POSITION_MODES:
            self.push(0.0)
        self.torque_slope(self._slope)

    def command_torque(self, torque_nm: float) -> None:
        """Take a torque reference (N m)."""
        step = abs(torque_nm - self._torque_nm) / self.set_up.torque_nm
        if self.power.state.energised and self.dictionary["cia402.mode"].integer() == Mode.CYCLIC_TORQUE:
            self.largest_step = max(self.largest_step, step)
        self._torque_nm = torque_nm
        if self.dictionary["cia402.mode"].integer() == Mode.IDENTIFICATION:
            self._write("set_point.i_q_a", torque_nm / self.set_up.torque_constant)
            return
        self.push(torque_nm)

    def command_angle(self, counts: float) -> None:
        """Take the master's commutation angle: the torque current flows at it, wherever the rotor is."""
        self._write("set_point.fixed_angle_rad", 2.0 * math.pi * counts / ANGLE_COUNTS)

    def push(self, torque_nm: float) -> None:
        """Take a torque of the drive's own position loop (N m)."""
        rated_nm = self.dictionary["cia402.rated_torque"].number() / 1000.0
        self._write("cia402.target_torque", 1000.0 * torque_nm / rated_nm)

    def command_speed(self, turns_per_s: float) -> None:
        """Take a speed reference (turns/s)."""
        self._write("cia402.target_velocity", 2.0 * math.pi * turns_per_s / RAD_S_PER_MRPM)

    def limit_current(self, apk: float) -> None:
        """Keep the current vector (A peak)."""
        rated_apk = 1e-3 * math.sqrt(2.0) * self.dictionary["cia402.rated_current"].number()
        self._write("cia402.max_current", 1000.0 * apk / rated_apk)

    def limit_torque(self, torque_nm: float) -> None:
        """Keep the torque (N m)."""
        rated_nm = self.dictionary["cia402.rated_torque"].number() / 1000.0
        self._write("cia402.max_torque", 1000.0 * torque_nm / rated_nm)

    def limit_speed(self, rpm: float) -> None:
        """Keep the speed (rpm)."""
        self._write("cia402.max_speed", rpm)

    def tune_speed_loop(self) -> None:
        """Leave the gains of the speed loop that its maker's tool would have found."""
        K_p = SPEED_RAD_S * self.set_up.J_kgm2
        self.set_speed_gains(K_p, SPEED_INTEGRAL * SPEED_RAD_S * K_p)

    def set_speed_gains(self, K_p_nms_per_rad: float, K_i_nm_per_rad: float) -> None:
        """Change the gains of the speed loop."""
        self._write("speed.K_p_nms_per_rad", K_p_nms_per_rad)
        self._write("speed.K_i_nm_per_rad", K_i_nm_per_rad)

    def speed_current_loops(self, factor: float) -> None:
        """Make both current loops faster than the maker's tool left them."""
        for axis in "dq":
            for name in (f"current.K_p_{axis}_v_per_a", f"current.K_i_{axis}_v_per_as"):
                self._write(name, factor * self.dictionary[name].number())

    def sample_speed(self, filter_hz: float, decimation: int) -> None:
        """Change the filter of the speed loop's feedback, and how many control periods lie between its samples."""
        self._write("speed.filter_hz", filter_hz)
        self._write("speed.decimation", decimation)

    def torque_slope(self, permille_per_s: float) -> None:
        """Move a profile torque no faster (0: at once)."""
        self._slope = permille_per_s
        cyclic = self.dictionary["cia402.mode"].integer() == Mode.CYCLIC_TORQUE
        self._write("cia402.torque_slope", NO_SLOPE if cyclic or not permille_per_s else permille_per_s)

    def set_gains(self, K_p_v_per_a: float | None = None, K_i_v_per_as: float | None = None) -> None:
        """Change the gains of both current loops."""
        for axis in "dq":
            if K_p_v_per_a is not None:
                self._write(f"current.K_p_{axis}_v_per_a", K_p_v_per_a)
            if K_i_v_per_as is not None:
                self._write(f"current.K_i_{axis}_v_per_as", K_i_v_per_as)
