# SPDX-License-Identifier: MIT
"""The machine of Jercic et al. 2017 under different current control laws, at equal bandwidth, delay and voltage limit.

Every law is what ``tune`` makes of the profile ``jercic-2017`` for a bandwidth and a governor mode; the simulated plant
is the same machine with an ideal averaged inverter and ideal sensors, so that only the laws differ. V_dc is 210 V.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.firmware.image import pack_image
from pmsmtool.machine.key import Value
from pmsmtool.machine.machine_file import MachineFile, load_machine_file
from pmsmtool.machine.torque import torque_per_ampere
from pmsmtool.sim.kernel import Application, Part, Rotor, Setup, Signal, Simulation, Target, Truth
from pmsmtool.sim.scenarios import MODES
from pmsmtool.sim.simulated_machine import build_setup, with_simulation
from pmsmtool.units import RAD_S_PER_RPM

Whole = NDArray[np.int64]

PROFILE = "jercic-2017"
MODULUS_OPTIMUM = 4000.0
"""Bandwidth (rad/s) of the paper's tuning, 1 / (3 T_s) at 12 kHz."""
FAST = 7540.0
"""Bandwidth (rad/s) of the best governor, 2 pi f_s / 10."""

IDEAL: dict[str, Value] = {
    "inverter_model": "averaged",
    "deadtime_shape": "none",
    "dead_time_s": 0.0,
    "device_drop_v": 0.0,
    "device_slope_ohm": 0.0,
    "diode_drop_v": 0.0,
    "diode_slope_ohm": 0.0,
    "output_capacitance_f": 0.0,
    "sensor_offset_a_apk": 0.0,
    "sensor_offset_b_apk": 0.0,
    "sensor_offset_c_apk": 0.0,
    "sensor_lag_s": 0.0,
    "sensor_noise_apk": 0.0,
    "adc_bits": 0,
    "encoder_bits": 0,
    "T_winding_c": 20.0,
    "T_magnet_c": 20.0,
    "thermal_on": False,
    "rotor": "driven",
}
"""What is taken out of the simulated drive: inverter errors, sensor errors, heating."""

NOISE_APK, ADC_LSB_APK = 0.1, 0.05
"""The noisy sensor: standard deviation of a phase current sample, and the grid it is rounded to (A)."""

CURRENT_BACK_CALCULATION, CURRENT_HEXAGON, CURRENT_PREDICTOR = 1 << 2, 1 << 3, 1 << 4
"""Bits of ``current.options``."""

BOOST_V = 700.0
"""DC link while the drive is brought to its initial current, which its own voltage may hold but not reach."""
BOOST_S, REST_S = 0.03, 0.15
"""How long, and the rest at the true DC link before the step, in which the integrators settle with L/R = 17 ms (s)."""


@dataclass(frozen=True, slots=True)
class Law:
    """A control law."""

    name: str
    """In tables and legends."""
    governor: str = "off"
    """Mode of the governor (``design.governor.MODES``)."""
    anti_windup: bool = True
    """Realizable-reference back-calculation; without it the integrators charge against the clipped voltage."""
    alpha: float = FAST
    """Bandwidth of the current loops (rad/s), pole-zero cancellation."""
    hexagon: bool = False
    """The inverter's hexagon instead of the circle."""
    eps: float | None = None
    """Tightening of the steady-state row; None: as ``tune`` chooses."""
    weakening: str = "accelerated"
    """Mode of field weakening."""
    I_transient_apk: float | None = None
    """Current the governor allows on the way; None: I_max."""


@dataclass(frozen=True, slots=True)
class Condition:
    """What the law works with."""

    name: str = "nominal"
    """In tables."""
    delayed: bool = False
    """One period of computation delay; the laws then predict one step (all of them, or none)."""
    noise: bool = False
    """Noisy, quantised current samples."""
    R: float = 1.0
    L: float = 1.0
    psi: float = 1.0
    """Plant over controller."""
    whole: bool = False
    """The drive's whole firmware on the profile's own inverter, sensors and encoder, instead of ideal ones."""


NOMINAL = Condition()
DELAYED = Condition("one-period delay, predictor", delayed=True)
TABLE_2A = Condition("Table 2 (a): 0.7 L", L=0.7)
TABLE_2B = Condition("Table 2 (b): 0.7 psi, 1.5 R", R=1.5, psi=0.7)


@cache
def source() -> MachineFile:
    """Return the machine file of the profile."""
    return load_machine_file(PROFILE)


def V_max() -> float:
    """Return the radius of the voltage circle (V)."""
    return source().inverter.V_max_v


@dataclass(frozen=True, slots=True)
class Plant:
    """Constants of the simulated machine."""

    R: float
    L_d: float
    L_q: float
    psi: float
    """Ohm, H, H, Wb."""
    pole_pairs: int
    """Pole pairs."""

    def voltage(self, i: Array, rpm: Array | float) -> Array:
        """Return the steady-state voltage (V) of currents, shape (..., 2), at a speed."""
        w = RAD_S_PER_RPM * self.pole_pairs * np.asarray(rpm, dtype=np.float64)
        u_d = self.R * i[..., 0] - w * self.L_q * i[..., 1]
        u_q = self.R * i[..., 1] + w * (self.L_d * i[..., 0] + self.psi)
        return np.asarray(np.hypot(u_d, u_q))

    def torque(self, i: Array) -> Array:
        """Return the torque (N m) of currents, shape (..., 2)."""
        return np.asarray(torque_per_ampere(self.pole_pairs, self.psi + (self.L_d - self.L_q) * i[..., 0]) * i[..., 1])


def plant_of(condition: Condition = NOMINAL) -> Plant:
    """Return the plant of a condition."""
    m = source().machine
    return Plant(
        condition.R * m.R_s_ohm, condition.L * m.L_d_h, condition.L * m.L_q_h, condition.psi * m.psi_f_wb, m.pole_pairs
    )


def machine_with(condition: Condition) -> MachineFile:
    """Return the machine file the simulation of a condition reads."""
    plant = plant_of(condition)
    truth: dict[str, Value] = {"R_s_ohm": plant.R, "L_d_h": plant.L_d, "L_q_h": plant.L_q, "psi_f_wb": plant.psi}
    noise: dict[str, Value] = {}
    if condition.noise:
        bits = 12
        noise = {"sensor_noise_apk": NOISE_APK, "adc_bits": bits, "adc_full_scale_apk": ADC_LSB_APK * 2 ** (bits - 1)}
    file = source()
    file = replace(file, inverter=replace(file.inverter, delay_periods=1.5 if condition.delayed else 0.5))
    taken: dict[str, Value] = {"rotor": "driven"} if condition.whole else IDEAL
    return with_simulation(file, {**taken, **truth, **noise})


@cache
def law_values(law: Law, delayed: bool) -> dict[str, float]:
    """Return the drive's parameters: what ``tune`` makes of the nominal machine for this law."""
    file = machine_with(replace(NOMINAL, delayed=delayed))
    request = TuneRequest(
        bandwidth_hz=law.alpha / (2.0 * math.pi),
        phase_margin_deg=20.0,
        gain_margin_db=2.0,
        governor=law.governor,
        eps=law.eps,
        field_weakening=law.weakening,
        predictor=delayed,
    )
    values = dict(tune(file, request).parameter_set().values)
    options = int(values["current.options"])
    options = options if law.anti_windup else options & ~CURRENT_BACK_CALCULATION
    values["current.options"] = float(options | (CURRENT_HEXAGON if law.hexagon else 0))
    if law.I_transient_apk is not None:
        values["governor.I_transient_apk"] = law.I_transient_apk
    return values


@dataclass(frozen=True, slots=True)
class Response:
    """What a run showed, one row per control period, from the step on."""

    t_s: Array
    """Time since the step (s). Shape (n,)."""
    i: Array
    """True current at the sampling instants (A). Shape (n, 2)."""
    reference: Array
    """Governed reference (A). Shape (n, 2)."""
    demanded: Array
    """Voltage the controller asked for (V), before the limiter. Shape (n, 2)."""
    applied: Array
    """After the limiter. Shape (n, 2)."""
    flags: Whole
    """Flags of the core. Shape (n,)."""
    rpm: Array
    theta_e: Array
    """Speed (rpm) and electrical angle (rad). Shape (n,)."""

    @property
    def T_s(self) -> float:
        """Control period (s)."""
        return float(self.t_s[1] - self.t_s[0])


FLAG_FALLBACK = 1 << 6
"""The governor's admissible set was empty (``pmsm_core.h``)."""

_RECORDED = (
    Truth.T, Truth.I_D, Truth.I_Q, Signal.I_D_REF, Signal.I_Q_REF, Signal.U_D, Signal.U_Q, Signal.U_D_LIM,
    Signal.U_Q_LIM, Signal.FLAGS, Truth.OMEGA_M, Truth.THETA_E,
)  # fmt: skip


class GovernedDrive:
    """A law on a plant; every run starts afresh.

    Parameters
    ----------
    law : Law
        Control law.
    condition : Condition
        Plant, delay, noise.
    seed : int
        Seed of the noise of the first run; later runs count upwards.
    values : mapping of str to float, optional
        Other parameters than the law's own.
    """

    def __init__(
        self, law: Law, condition: Condition = NOMINAL, seed: int = 1, values: Mapping[str, float] | None = None
    ) -> None:
        self.law, self.condition, self.seed = law, condition, seed
        file = machine_with(condition)
        self._setup: Setup
        application = Application.DRIVE if condition.whole else Application.CORE
        self._setup, self._keep = build_setup(file, seed=seed, application=application)
        self._setup.machine.rotor = Rotor.DRIVEN
        self._image = pack_image(law_values(law, condition.delayed) if values is None else dict(values))
        self.plant = plant_of(condition)

    def step(self, rpm: float, start: Sequence[float], target: Sequence[float], duration_s: float) -> Response:
        """Hold one current, then ask for another, at constant speed."""
        return self.speed_change(((0.0, rpm),), start, target, duration_s)

    def speed_change(
        self, rpm: Sequence[tuple[float, float]], start: Sequence[float], target: Sequence[float], duration_s: float
    ) -> Response:
        """Hold one current; at time 0 ask for another while the speed follows nodes (s, rpm) from time 0 on."""
        t0 = self._step_time()
        simulation = self._simulation(rpm[0][1])
        for axis, (a, b) in zip((Target.I_D, Target.I_Q), zip(start, target, strict=True), strict=True):
            simulation.schedule(axis, (0.0, t0, t0), (a, a, b))
        if not self.condition.whole:  # which would trip on it, and starts without current
            nominal = source().inverter.U_dc_v
            simulation.schedule(Target.U_DC, (0.0, BOOST_S, BOOST_S), (BOOST_V, BOOST_V, nominal))
        simulation.reference.mode = MODES["current"]
        return self._record(simulation, rpm, t0, duration_s)

    def torque_run(self, rpm: Sequence[tuple[float, float]], torque_nm: float, duration_s: float) -> Response:
        """Ask for a torque from standstill of the current on, while the speed follows nodes (s, rpm)."""
        simulation = self._simulation(rpm[0][1])
        simulation.schedule(Target.TORQUE, (0.0,), (torque_nm,))
        simulation.reference.mode = MODES["torque"]
        return self._record(simulation, rpm, 0.0, duration_s)

    def _step_time(self) -> float:
        """The step falls on a period, whose length the drive counts in ns."""
        T_s = 1e-9 * law_values(self.law, self.condition.delayed)["inverter.T_s_ns"]
        return round((BOOST_S + REST_S) / T_s) * T_s

    def _simulation(self, rpm: float) -> Simulation:
        self._setup.omega_M = RAD_S_PER_RPM * rpm
        self._setup.seed = self.seed
        self.seed += 1
        simulation = Simulation(self._setup, self._image, self._keep)
        simulation.word(Part.ENABLED).value = 1
        return simulation

    def _record(
        self, simulation: Simulation, rpm: Sequence[tuple[float, float]], t0: float, duration_s: float
    ) -> Response:
        times = [0.0, *(t0 + t for t, _ in rpm)]
        simulation.schedule(
            Target.DRIVEN_SPEED, times, [RAD_S_PER_RPM * rpm[0][1], *(RAD_S_PER_RPM * n for _, n in rpm)]
        )
        T_s = 1e-9 * simulation.params.inverter_T_s_ns
        before = round(t0 / T_s)
        simulation.run(before)
        rows = round(duration_s / T_s)
        record = simulation.record(_RECORDED, rows)
        simulation.run(rows)
        table = record.T
        return Response(
            table[0] - table[0, 0], record[:, 1:3].copy(), record[:, 3:5].copy(), record[:, 5:7].copy(),
            record[:, 7:9].copy(), table[9].astype(np.int64), table[10] / RAD_S_PER_RPM, table[11].copy(),
        )  # fmt: skip
