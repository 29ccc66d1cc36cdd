# SPDX-License-Identifier: MIT
"""Drives drawn at random, to judge identification and design by numbers instead of examples.

Three draws. :func:`draw_drive` takes a whole drive from the population below, :func:`draw_wide` one from a much wider
one; :func:`draw_around` varies a given machine file. The ranges are fixed here, before any run, and every drive follows
from its seed alone. What is drawn goes into ``[simulation]`` (the truth) and into the nameplate; the tool sees the
nameplate only. Half of the encoders count against the phase order, half of the machines have two leads swapped, winding
and magnets have 5 to 90 degC.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pmsmtool.machine.flux_map import FluxMap
from pmsmtool.machine.key import Value
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.parameters import (
    EncoderParameters,
    InverterParameters,
    MachineLimits,
    MachineParameters,
)
from pmsmtool.machine.torque import torque_per_ampere
from pmsmtool.sim.simulated_machine import device_slope_ohm, settings_of
from pmsmtool.units import rpm_from_rad_s

Block = Literal["ideal", "timing", "gains"]
"""Sensors: ideal gains and timing; unknown lag and sampling shift; gains off within their tolerance."""

SENSOR_TOLERANCE = 0.01
"""Declared 95 % tolerance of current and DC-link gains, as ``identify`` assumes by default."""
GAIN_STD = SENSOR_TOLERANCE / 1.96


@dataclass(frozen=True, slots=True)
class VoltageClass:
    """Ranges of one class of drives: currents (A peak), switching frequency (Hz), dead time and device drops."""

    U_dc_v: tuple[float, ...]
    I_nom_apk: tuple[float, float]
    f_s_hz: tuple[float, float]
    dead_time_s: tuple[float, float]
    drop_v: tuple[float, float]
    slope_drop_v: tuple[float, float]
    capacitance_f: tuple[float, float]


LOW_VOLTAGE = VoltageClass(
    (24.0, 48.0), (5.0, 60.0), (16e3, 40e3), (0.1e-6, 0.8e-6), (0.0, 0.0), (0.01, 0.10), (0.3e-9, 3e-9)
)
"""MOSFET bridges: no threshold, the diode never conducts but in the dead time; the slope is their on-resistance."""
HIGH_VOLTAGE = VoltageClass(
    (325.0, 560.0), (3.0, 25.0), (8e3, 24e3), (0.5e-6, 3e-6), (0.3, 1.2), (0.1, 0.8), (0.05e-9, 1e-9)
)
"""IGBT bridges: thresholds of switch and diode drawn apart. ``slope_drop_v`` is the drop on the slope at I_nom."""

BASE_SPEED_RAD_S = (400.0, 1600.0)
EMF_SHARE = (0.60, 0.75)
RESISTIVE_SHARE = (0.02, 0.12)
INDUCTIVE_SHARE = (0.12, 0.45)
SALIENCY = (1.0, 2.2)
POLE_PAIRS = (2, 10)
ADC_NOISE_LSB = (0.5, 2.0)
ADC_SPAN = (1.8, 3.2)
ENCODER_BITS = (12, 19)
ENCODER_OFFSET_RAD = math.radians(180.0)
LEG_MISMATCH_SHARE = 0.05
ACCELERATION_TIME_S = (0.05, 0.4)
T_RANGE_C = (5.0, 90.0)
"""Winding and magnets when the tool meets them, alike and not known to it."""
CATALOGUE_SHARE = {"R_s_ohm": 0.10, "L_d_h": 0.30, "L_q_h": 0.30, "psi_f_wb": 0.10, "J_kgm2": 0.10}
"""Tolerances that a data sheet states."""
MAGNET_TOLERANCE_PER_K = 1e-4
"""The same of the magnets' temperature coefficient, for one grade of NdFeB."""
SENSOR_LAG_S = (0.0, 20e-6)
SAMPLING_SHIFT_SHARE = (0.0, 0.10)


def draw_drive(seed: int, block: Block = "ideal") -> MachineFile:
    """Return drive number ``seed`` of the population (docs/identification.md, 1, with a switched inverter).

    Emf at base speed is 0.60 to 0.75 of U_dc/sqrt(3), the resistive drop at rated current 2 to 12 % and the inductive
    one 12 to 45 % of the emf, L_q/L_d 1 to 2.2; currents are log-uniform.
    """
    rng = np.random.default_rng([20260101, seed])
    kind = LOW_VOLTAGE if rng.random() < 0.5 else HIGH_VOLTAGE
    U_dc = float(rng.choice(kind.U_dc_v))
    I_nom = _log_uniform(rng, kind.I_nom_apk)
    f_s = _log_uniform(rng, kind.f_s_hz)
    omega_base = float(rng.uniform(*BASE_SPEED_RAD_S))
    emf = float(rng.uniform(*EMF_SHARE)) * U_dc / math.sqrt(3.0)
    L_q = float(rng.uniform(*INDUCTIVE_SHARE)) * emf / (omega_base * I_nom)
    pole_pairs = int(rng.integers(POLE_PAIRS[0], POLE_PAIRS[1] + 1))
    psi_f = emf / omega_base
    tau_nom = torque_per_ampere(pole_pairs, psi_f) * I_nom
    omega_M = omega_base / pole_pairs
    J = tau_nom * _log_uniform(rng, ACCELERATION_TIME_S) / omega_M
    n_nom = rpm_from_rad_s(omega_M)
    machine = MachineParameters(
        pole_pairs=pole_pairs,
        R_s_ohm=float(rng.uniform(*RESISTIVE_SHARE)) * emf / I_nom,
        L_d_h=L_q / float(rng.uniform(*SALIENCY)),
        L_q_h=L_q,
        psi_f_wb=psi_f,
        I_nom_apk=I_nom,
        I_max_apk=1.5 * I_nom,
        I_max_time_s=10.0,
        n_nom_rpm=n_nom,
        n_max_rpm=1.5 * n_nom,
        J_kgm2=J,
        B_nms=0.01 * tau_nom / omega_M,
        tau_c_nm=0.01 * tau_nom,
    )
    inverter = InverterParameters(U_dc_v=U_dc, f_s_hz=f_s, dead_time_s=_log_uniform(rng, kind.dead_time_s))
    drive = MachineFile(
        name=f"random-{seed}",
        machine=machine,
        inverter=inverter,
        encoder=EncoderParameters(
            offset_rad=0.0, direction=1, bits=int(rng.integers(ENCODER_BITS[0], ENCODER_BITS[1] + 1))
        ),
        limits=MachineLimits(i_trip_apk=1.35 * 1.5 * I_nom, I_cont_apk=I_nom),
    )
    return _with_truth(drive, kind, rng, seed, block)


WIDE_U_DC_V = (12.0, 24.0, 48.0, 96.0, 160.0, 325.0, 560.0, 800.0)
WIDE_MOSFET_V = 160.0
"""DC link up to which bridges are made of MOSFETs."""
WIDE_POWER_W = (5.0, 6e4)
WIDE_CURRENT_A = (0.1, 250.0)
WIDE_FREQUENCY_HZ = (20.0, 1000.0)
"""Electrical frequency at the largest speed, at most a fourteenth of the control frequency."""
WIDE_EMF_SHARE = (0.55, 0.95)
"""Back-emf at the largest speed, of U_dc/sqrt(3)."""
WIDE_RESISTIVE_SHARE, WIDE_INDUCTIVE_SHARE, WIDE_RIPPLE_SHARE = (0.01, 0.08), (0.05, 0.6), 0.5
"""Of that emf at the rated current; the ripple of the current, from peak to peak, at most that share of it."""
WIDE_SALIENCY, WIDE_POLE_PAIRS, WIDE_ENCODER_BITS = (1.0, 2.5), (1, 24), (11, 23)
WIDE_ACCELERATION_S, WIDE_FRICTION_SHARE = (0.02, 1.5), (0.003, 0.12)


def draw_wide(seed: int, block: Block = "ideal") -> MachineFile:
    """Return drive number ``seed`` of a population from the motor of a watch to that of a lorry.

    5 W to 60 kW at 12 to 800 V, 1 to 24 pole pairs, 20 to 1000 Hz; one half is not salient; friction takes 0.3 to 12 %
    of the rated torque.
    """
    rng = np.random.default_rng([20261126, seed])
    U_dc = float(rng.choice(WIDE_U_DC_V))
    kind = LOW_VOLTAGE if U_dc <= WIDE_MOSFET_V else HIGH_VOLTAGE
    f_s = _log_uniform(rng, kind.f_s_hz)
    omega = 2.0 * math.pi * min(f_s / 14.0, _log_uniform(rng, WIDE_FREQUENCY_HZ))
    emf = float(rng.uniform(*WIDE_EMF_SHARE)) * U_dc / math.sqrt(3.0)
    I_nom = float(np.clip(_log_uniform(rng, WIDE_POWER_W) / (1.5 * emf), *WIDE_CURRENT_A))
    pole_pairs = int(rng.integers(WIDE_POLE_PAIRS[0], WIDE_POLE_PAIRS[1] + 1))
    rippling = U_dc / (8.0 * f_s * WIDE_RIPPLE_SHARE * I_nom)
    L_d = max(_log_uniform(rng, WIDE_INDUCTIVE_SHARE) * emf / (omega * I_nom), rippling)
    tau_nom, omega_M = torque_per_ampere(pole_pairs, emf / omega) * I_nom, omega / pole_pairs
    machine = MachineParameters(
        pole_pairs=pole_pairs,
        R_s_ohm=float(rng.uniform(*WIDE_RESISTIVE_SHARE)) * emf / I_nom,
        L_d_h=L_d,
        L_q_h=L_d * (float(rng.uniform(*WIDE_SALIENCY)) if rng.random() < 0.5 else 1.0),
        psi_f_wb=emf / omega,
        I_nom_apk=I_nom,
        I_max_apk=float(rng.uniform(1.3, 2.5)) * I_nom,
        I_max_time_s=10.0,
        n_nom_rpm=rpm_from_rad_s(float(rng.uniform(0.5, 0.9)) * omega_M),
        n_max_rpm=rpm_from_rad_s(omega_M),
        J_kgm2=tau_nom * _log_uniform(rng, WIDE_ACCELERATION_S) / omega_M,
        B_nms=0.002 * tau_nom / omega_M,
        tau_c_nm=_log_uniform(rng, WIDE_FRICTION_SHARE) * tau_nom,
    )
    inverter = InverterParameters(U_dc_v=U_dc, f_s_hz=f_s, dead_time_s=_log_uniform(rng, kind.dead_time_s))
    bits = int(rng.integers(WIDE_ENCODER_BITS[0], WIDE_ENCODER_BITS[1] + 1))
    trip = 1.35 * (machine.I_max_apk or I_nom)
    drive = MachineFile(
        name=f"wide-{seed}",
        machine=machine,
        inverter=inverter,
        encoder=EncoderParameters(offset_rad=0.0, direction=1, bits=bits),
        limits=MachineLimits(i_trip_apk=trip, I_cont_apk=I_nom),
    )
    return _with_truth(drive, kind, rng, seed, block)


def draw_around(base: MachineFile, seed: int, block: Block = "ideal", *, spread: float = 0.15) -> MachineFile:
    """Return a drive around a machine file: its parameters times log-normal factors of ``spread``.

    Resistance, inductances, flux linkage (of a flux map: all inductances by one factor, which keeps it reciprocal, and
    the magnet's share), temperature, offset, sensors, dead time and devices vary; the nameplate stays, so the tool
    meets a machine it was not told about.
    """
    rng = np.random.default_rng([20260102, seed])
    kind = LOW_VOLTAGE if base.inverter.U_dc_v < 100.0 else HIGH_VOLTAGE
    truth: dict[str, Value] = {}
    names = ("R_s_ohm",) if base.flux_map is not None else ("R_s_ohm", "L_d_h", "L_q_h", "psi_f_wb")
    for name in names:
        truth[name] = float(getattr(base.machine, name)) * math.exp(spread * float(rng.standard_normal()))
    dead_time = base.inverter.dead_time_s * math.exp(0.3 * float(rng.standard_normal()))
    drive = replace(
        base,
        name=f"{base.name}-{seed}",
        inverter=replace(base.inverter, dead_time_s=dead_time),
        simulation={**base.simulation, **truth},
        flux_map=None if base.flux_map is None else _varied(base.flux_map, spread, rng),
    )
    return _with_truth(drive, kind, rng, seed, block)


def _varied(flux_map: FluxMap, spread: float, rng: np.random.Generator) -> FluxMap:
    """Return the map of a machine of the same kind."""
    of_current, of_magnet = (math.exp(spread * float(rng.standard_normal())) for _ in range(2))
    psi_f = float(flux_map.flux(0.0, 0.0)[0])
    return replace(
        flux_map,
        psi_d_wb=of_magnet * psi_f + of_current * (flux_map.psi_d_wb - psi_f),
        psi_q_wb=of_current * flux_map.psi_q_wb,
    )


def _with_truth(
    drive: MachineFile, kind: VoltageClass, rng: np.random.Generator, seed: int, block: Block
) -> MachineFile:
    """Add what only the simulated drive may know: inverter devices, sensors, offset, temperature."""
    machine, inverter = drive.machine, drive.inverter
    I_nom = machine.I_nom_apk or 1.0
    T_s = inverter.T_s
    full_scale = max(float(rng.uniform(*ADC_SPAN)) * I_nom, 1.4 * (machine.I_max_apk or I_nom))
    step = 2.0 * full_scale / 2**12
    slope = float(rng.uniform(*kind.slope_drop_v)) / I_nom
    if machine.R_s_ohm <= slope:  # no loop has less than its devices: what was drawn is the winding
        drive = replace(drive, machine=replace(machine, R_s_ohm=machine.R_s_ohm + slope))
    temperature = float(rng.uniform(*T_RANGE_C))
    truth: dict[str, Value] = {
        "inverter_model": "switched",
        "device_drop_v": float(rng.uniform(*kind.drop_v)),
        "diode_drop_v": float(rng.uniform(*kind.drop_v)) if kind is HIGH_VOLTAGE else 0.7,
        "device_slope_ohm": slope,
        "diode_slope_ohm": slope * (float(rng.uniform(0.7, 1.3)) if kind is HIGH_VOLTAGE else 1.0),
        "output_capacitance_f": _log_uniform(rng, kind.capacitance_f),
        "leg_mismatch_s": LEG_MISMATCH_SHARE * inverter.dead_time_s * float(rng.uniform(-1.0, 1.0)),
        "sensor_offset_a_apk": step * float(rng.uniform(-2.0, 2.0)),
        "sensor_offset_b_apk": step * float(rng.uniform(-2.0, 2.0)),
        "sensor_offset_c_apk": step * float(rng.uniform(-2.0, 2.0)),
        "sensor_noise_apk": step * float(rng.uniform(*ADC_NOISE_LSB)),
        "adc_bits": 12,
        "adc_full_scale_apk": full_scale,
        "sensor_lag_s": 0.0,
        "sampling_shift_s": 0.0,
        "encoder_bits": drive.encoder.bits or 17,
        "encoder_offset_rad": ENCODER_OFFSET_RAD * float(rng.uniform(-1.0, 1.0)),
        "T_winding_c": temperature,
        "T_magnet_c": temperature,
        "T_ambient_c": temperature,
        "thermal_on": False,
        "theta_M_start_rad": float(rng.uniform(-math.pi, math.pi)),
        "serial": 1 + seed,
        "seed": seed,
    }
    if block == "timing":
        truth["sensor_lag_s"] = float(rng.uniform(*SENSOR_LAG_S))
        truth["sampling_shift_s"] = float(rng.uniform(*SAMPLING_SHIFT_SHARE)) * T_s
    if block == "gains":
        common = 1.0 + GAIN_STD * float(rng.standard_normal())
        for phase in "abc":
            truth[f"sensor_gain_{phase}"] = common
        truth["U_dc_gain"] = 1.0 + GAIN_STD * float(rng.standard_normal())
    truth["encoder_reversed"], truth["leads_swapped"] = (bool(rng.random() < 0.5) for _ in range(2))
    return replace(drive, simulation={**drive.simulation, **truth})


def data_sheet(drive: MachineFile, seed: int) -> MachineFile:
    """Return what a right data sheet states of a drive: its ratings, and its machine within :data:`CATALOGUE_SHARE`.

    The resistance is that of the winding alone, as a catalogue's; bridge and cable are not the motor's.
    """
    rng = np.random.default_rng([20260117, seed])
    values = {
        key: (getattr(drive.machine, key) or 0.0) * (1.0 + share * rng.uniform(-1.0, 1.0))
        for key, share in CATALOGUE_SHARE.items()
    }
    settings = settings_of(drive)
    values["R_s_ohm"] *= 1.0 - device_slope_ohm(settings) / settings.number("R_s_ohm")
    values["R_winding_ohm"] = values["R_s_ohm"]
    machine = replace(drive.machine, alpha_psi_tolerance_per_k=MAGNET_TOLERANCE_PER_K, **values)  # type: ignore[arg-type]
    return replace(drive, machine=machine, simulation={})


def true_loop_resistance(drive: MachineFile) -> float:
    """Return R_s at T_ref as the drive can see it (ohm): ``[simulation] R_s_ohm`` is the loop, devices included."""
    return _number(drive.simulation_settings(), "R_s_ohm")


def _number(values: dict[str, Value], key: str) -> float:
    value = values[key]
    if not isinstance(value, int | float):
        raise TypeError(f"{key} is no number")
    return float(value)


def _log_uniform(rng: np.random.Generator, bounds: tuple[float, float]) -> float:
    return float(math.exp(rng.uniform(math.log(bounds[0]), math.log(bounds[1]))))
