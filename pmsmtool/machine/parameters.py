# SPDX-License-Identifier: MIT
"""The machine and its inverter as numbers: what design, simulation and the drive agree on.

Amplitude-invariant (peak) dq quantities, SI, electrical angle; torque = 1.5 p (psi_d i_q - psi_q i_d),
motoring positive; resistance and inductance per phase (star).
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

import numpy as np

from pmsmtool.machine.temperature import COPPER_ALPHA_PER_K, MAGNET_ALPHA_PER_K
from pmsmtool.machine.torque import air_gap_torque, torque_per_ampere
from pmsmtool.units import RAD_S_PER_RPM, format_quantity

PHASES = "abc"
"""Of three Hall sensors a third of an electrical turn apart, too."""
HALL_ORDERS = tuple("".join(order) for order in itertools.permutations(PHASES))
"""Phase whose sensor is on wires 1, 2 and 3."""
HALL_SECTOR_RAD = math.pi / 3.0
"""Angle over which no wire changes, electrical."""


class HallCommutation(IntEnum):
    """Values of ``hall.commutation``, the enum ``pmsm_hall_commutation`` of the exported C."""

    NONE = 0
    START = 1
    """Until the encoder counts from its index."""
    ALONE = 2
    """In place of an encoder."""
    STEPS = 3
    """The same, in a frame that stands in the middle of the sector: six steps per turn."""


def hall_axis(phase: str) -> float:
    """Return the electrical angle (rad) at the middle of the half turn in which the sensor of a phase is high."""
    return 2.0 * HALL_SECTOR_RAD * PHASES.index(phase)


Shaft = Literal["free", "locked", "coupled"]
Load = Literal["none", "gravity"]
Brake = Literal["open", "drive", "none"]

MAX_POLE_PAIRS = 64
"""Of a machine file, of a drive's object, and of what a slow turn finds: a closed-loop stepper motor has 50."""
RUN_UP_S = (3e-4, 60.0)
"""Time (s) to rated speed at rated torque of rotors and loads in use."""
LARGEST_OWN_FLUX = 10.0
"""Flux that the rated current makes, of the magnet's: some times of it where reluctance gives most of the torque."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """A number that carries its doubt.

    Attributes
    ----------
    value : float
        Estimate in SI.
    std : float
        Statistical standard deviation, same unit.
    systematic : float
        Half width of the 95 % systematic part (sensor gains, references), same unit.
    unit : str
        Unit, as in ``units.UNITS``.
    n : int
        Samples (or levels) in the fit.
    chi2 : float
        Reduced chi-square of the fit; NaN where the method has none.
    T_c : float
        Winding (or magnet) temperature the value was measured at (degC); NaN when unknown.
    method, source : str
        How it was found, and by whom: ``pmsmtool``, ``vendor``, ``datasheet``, ``meter``.
    i_d_apk, i_q_apk : float
        Bias point (A peak); NaN where the quantity has none.
    dof : float
        Degrees of freedom behind ``std`` (Student t); infinity when it is large.
    fallback : str
        What the method fell back to; empty when it did not.
    """

    value: float
    std: float
    systematic: float
    unit: str
    n: int = 0
    chi2: float = math.nan
    T_c: float = math.nan
    method: str = ""
    source: str = "pmsmtool"
    i_d_apk: float = math.nan
    i_q_apk: float = math.nan
    dof: float = math.inf
    fallback: str = ""


@dataclass(frozen=True, slots=True)
class MachineParameters:
    """Constant-parameter machine (``[machine]`` of a machine file); units and bounds in ``machine_keys``."""

    pole_pairs: int
    R_s_ohm: float
    L_d_h: float
    L_q_h: float
    psi_f_wb: float
    R_winding_ohm: float | None = None
    L_d_app_h: float | None = None
    L_q_app_h: float | None = None
    T_ref_c: float = 20.0
    alpha_R_per_k: float = COPPER_ALPHA_PER_K
    alpha_psi_per_k: float = MAGNET_ALPHA_PER_K
    alpha_psi_tolerance_per_k: float | None = None
    I_nom_apk: float | None = None
    I_max_apk: float | None = None
    I_max_time_s: float | None = None
    n_nom_rpm: float | None = None
    n_max_rpm: float | None = None
    J_kgm2: float | None = None
    B_nms: float | None = None
    tau_c_nm: float | None = None
    resonance_hz: float | None = None
    antiresonance_hz: float | None = None
    resonance_zeta: float | None = None
    flux_map: str | None = None
    iron_loss_map: str | None = None

    @property
    def L_d_decoupling_h(self) -> float:
        """Apparent d inductance where known, else the incremental one (H)."""
        return self.L_d_h if self.L_d_app_h is None else self.L_d_app_h

    @property
    def L_q_decoupling_h(self) -> float:
        """Apparent q inductance where known, else the incremental one (H)."""
        return self.L_q_h if self.L_q_app_h is None else self.L_q_app_h

    @property
    def top_rpm(self) -> float | None:
        """Largest speed (rpm); the rated one where only that is stated."""
        return self.n_nom_rpm if self.n_max_rpm is None else self.n_max_rpm

    def torque_nm(self, i_d_a: float, i_q_a: float) -> float:
        """Torque of the linear machine (N m), 1.5 p (psi_d i_q - psi_q i_d)."""
        psi_d = self.psi_f_wb + self.L_d_decoupling_h * i_d_a
        psi_q = self.L_q_decoupling_h * i_q_a
        return air_gap_torque(self.pole_pairs, psi_d, psi_q, i_d_a, i_q_a)


LINEAR_UTILISATION = 1.0 / math.sqrt(3.0)
ROUNDED = 1e-5
"""Share by which a utilisation may be beyond the linear one by rounding."""
SIX_STEPS_MIDDLE, SIX_STEPS_HALF_EDGE = 3.0 / math.pi, (math.sqrt(3.0) - 1.5) / math.pi
"""Fundamental of six steps over the linear limit: of the middles of the hexagon's edges, and of half an edge."""
SIX_STEPS_HARMONIC = math.pi**2 / 9.0 - 1.0
"""Farthest that the flux of six steps, a hexagon, is from its fundamental, over that: at the corners."""


@dataclass(frozen=True, slots=True)
class InverterParameters:
    """Inverter and timing (``[inverter]`` of a machine file).

    ``voltage_error_i_apk`` and ``voltage_error_v`` are the identified voltage error of one phase over its current
    (increasing currents, odd in the current where only positive ones are given); ``V_dead_v`` and ``i_knee_apk``
    are its plateau and knee, what the drive's own compensation takes. ``current_lag_s`` is the time constant of the
    current sensors, ``sampling_instant_s`` when they are sampled after the PWM centre. ``U_dc_chopper_v``
    is the voltage at which a brake chopper holds the link; None: there is none. ``min_off_time_s``, ``sample_window_s``
    and ``shunts`` (1 in the link, 3 in the legs, 0: sensors in the phases) say what overmodulation has to leave.
    """

    U_dc_v: float
    f_s_hz: float
    dead_time_s: float = 0.0
    delay_periods: float = 1.5
    voltage_utilisation: float = 1.0 / math.sqrt(3.0)
    V_dead_v: float | None = None
    i_knee_apk: float | None = None
    voltage_error_i_apk: tuple[float, ...] = ()
    voltage_error_v: tuple[float, ...] = ()
    current_lag_s: float | None = None
    sampling_instant_s: float | None = None
    U_dc_chopper_v: float | None = None
    min_off_time_s: float | None = None
    sample_window_s: float | None = None
    shunts: int | None = None

    @property
    def T_s(self) -> float:
        """Control period (s)."""
        return 1.0 / self.f_s_hz

    @property
    def V_max_v(self) -> float:
        """Largest phase voltage amplitude in use (V peak)."""
        return self.voltage_utilisation * self.U_dc_v

    @property
    def overmodulates(self) -> bool:
        """Whether V_max is beyond what sinusoidal voltages reach, U_dc / sqrt(3)."""
        return self.voltage_utilisation > (1.0 + ROUNDED) * LINEAR_UTILISATION

    @property
    def linear_utilisation(self) -> float:
        """Voltage utilisation up to which the voltages are sinusoidal."""
        return LINEAR_UTILISATION * (1.0 - (self.min_off_time_s or 0.0) * self.f_s_hz)

    def harmonic_flux_wb(self, omega_e_rad_s: float) -> float:
        """Largest flux (Wb) of the harmonics that overmodulation adds at a speed; 0 without (docs/control.md, 8)."""
        return SIX_STEPS_HARMONIC * self.V_max_v / omega_e_rad_s if self.overmodulates else 0.0

    def shunt_values(self) -> dict[str, float]:
        """Parameters ``inverter.*`` of the low-side times (ns) and the shunts; 0 where nothing is stated."""
        return {
            "min_off_time_ns": float(round(1e9 * (self.min_off_time_s or 0.0))),
            "sample_window_ns": float(round(1e9 * (self.sample_window_s or 0.0))),
            "shunts": float(self.shunts or 0),
        }

    @property
    def largest_utilisation(self) -> float:
        """Voltage utilisation whose fundamental six steps have, less what the shunts need (docs/control.md, 8)."""
        used = 1.0 - (self.min_off_time_s or 0.0) * self.f_s_hz
        window = (self.sample_window_s or 0.0) * self.f_s_hz
        edge = 2.0  # halves of an edge of the hexagon
        if self.shunts == 3:
            edge -= 2.0 * max(0.0, 1.0 - (1.0 - window) / used)
        elif self.shunts == 1:
            edge -= 8.0 * window / used
        return self.linear_utilisation * (SIX_STEPS_MIDDLE + SIX_STEPS_HALF_EDGE * edge)


@dataclass(frozen=True, slots=True)
class EncoderParameters:
    """Encoder (``[encoder]`` of a machine file): theta_e = direction p theta_M - offset."""

    offset_rad: float = 0.0
    direction: int = 1
    bits: int | None = None
    hall_commutation: int | None = None
    hall_axis_1_rad: float | None = None
    hall_axis_2_rad: float | None = None
    hall_axis_3_rad: float | None = None

    @property
    def halls(self) -> dict[str, float]:
        """Parameters of the Hall sensors (``hall.commutation`` and so on) that are stated."""
        stated = {name: getattr(self, f"hall_{name}") for name in HALLS}
        return {f"hall.{name}": float(value) for name, value in stated.items() if value is not None}


HALLS = ("commutation", "axis_1_rad", "axis_2_rad", "axis_3_rad")


@dataclass(frozen=True, slots=True)
class MachineLimits:
    """What must not be exceeded (``[limits]`` of a machine file); None: no limit is known."""

    i_d_min_apk: float | None = None
    i_trip_apk: float | None = None
    I_cont_apk: float | None = None
    U_dc_min_v: float | None = None
    U_dc_max_v: float | None = None
    n_trip_rpm: float | None = None
    tau_max_nm: float | None = None
    T_winding_max_c: float | None = None
    T_magnet_max_c: float | None = None


_KNEE_DEFAULT_A = 0.5
_KNEE_LEAST_A = 1e-3


def dead_time_compensation(inverter: InverterParameters) -> tuple[float, float, str]:
    """Return plateau (V), knee (A) and method of the drive's ramp-shaped voltage-error compensation.

    Where only the identified table is given, the plateau is its last value and the knee makes the ramp miss the same
    area below the plateau as the table does.
    """
    if inverter.V_dead_v is not None:
        return inverter.V_dead_v, inverter.i_knee_apk or _KNEE_DEFAULT_A, "machine file"
    current, error = np.asarray(inverter.voltage_error_i_apk), np.asarray(inverter.voltage_error_v)
    positive = current > 0.0
    if not positive.any() or error[positive][-1] <= 0.0:
        return 0.0, _KNEE_DEFAULT_A, "off: no voltage error is identified"
    i, v = np.concatenate(([0.0], current[positive])), np.concatenate(([0.0], error[positive]))
    missing = float(np.sum(np.diff(i) * (v[-1] - 0.5 * (v[1:] + v[:-1]))))
    knee = 2.0 * missing / float(v[-1])
    return float(v[-1]), max(knee, _KNEE_LEAST_A), "ramp of equal area to the identified voltage error"


def implausible(machine: MachineParameters, inverter: InverterParameters) -> list[str]:
    """Return a sentence for each value that is likely in a wrong unit."""
    found: list[str] = []
    tau_e = min(machine.L_d_h, machine.L_q_h) / machine.R_s_ohm
    if not 5e-5 <= tau_e <= 1.0:
        found.append(f"L/R = {format_quantity(tau_e, 's')} is unusual for a machine (50 us to 1 s): check the units")
    if machine.n_nom_rpm is not None:
        emf = machine.psi_f_wb * machine.pole_pairs * machine.n_nom_rpm * RAD_S_PER_RPM
        if emf > inverter.V_max_v:
            found.append(
                f"the back-EMF at rated speed is {emf:.4g} V peak, above the {inverter.V_max_v:.4g} V "
                f"that {inverter.U_dc_v:g} V DC give"
            )
    if not 0.3 <= machine.L_q_h / machine.L_d_h <= 10.0:
        found.append(f"L_q/L_d = {machine.L_q_h / machine.L_d_h:.3g} is unusual: check the axes")
    if machine.I_nom_apk is None or not machine.psi_f_wb > 0.0:
        return found
    own = machine.I_nom_apk * max(machine.L_d_h, machine.L_q_h) / machine.psi_f_wb
    if own > LARGEST_OWN_FLUX:
        found.append(f"L at the rated current makes {own:.3g} times the magnet's flux: check the units of L and K_e")
    drop = machine.R_s_ohm * machine.I_nom_apk
    if drop > inverter.V_max_v:
        found.append(f"R takes {drop:.4g} V at the rated current, of {inverter.V_max_v:.4g} V: check R and the DC link")
    if machine.J_kgm2 is not None and machine.n_nom_rpm is not None:
        torque = torque_per_ampere(machine.pole_pairs, machine.psi_f_wb) * machine.I_nom_apk
        run_up = machine.J_kgm2 * machine.n_nom_rpm * RAD_S_PER_RPM / torque
        if not RUN_UP_S[0] <= run_up <= RUN_UP_S[1]:
            found.append(
                f"J = {machine.J_kgm2:.3g} kg m2 comes to rated speed in {format_quantity(run_up, 's')}, unusual "
                f"({format_quantity(RUN_UP_S[0], 's')} to {RUN_UP_S[1]:g} s): check its unit, g cm2 or kg cm2"
            )
    return found
