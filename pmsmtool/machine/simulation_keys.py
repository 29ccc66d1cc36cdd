# SPDX-License-Identifier: MIT
"""Keys of ``[simulation]``: what only the simulated drive may know. Design commands validate them and look away.

The truth the drive is simulated with: sensor errors, inverter details, temperatures, load, faults. A key
whose default is another key (``[machine] R_s_ohm``) lets the truth differ from what the file tells the design.
"""

from __future__ import annotations

import math

from pmsmtool.machine.key import Key, Value
from pmsmtool.machine.parameters import HALL_ORDERS, MAX_POLE_PAIRS, MachineParameters
from pmsmtool.machine.torque import torque_per_ampere
from pmsmtool.units import format_quantity

_TABLE = "simulation"
_PI2 = 2.0 * math.pi

NOISE_SHARE = 5e-4
"""Standard deviation of a phase current sample, of full scale; that of the shipped profiles."""
ENCODER_BITS = 17
FRICTION_SHARE = 0.02
"""Coulomb friction of the rated torque; the shipped profiles have 0.5 to 3 %."""
ACCELERATION_RAD_S2 = 5000.0
"""Of the rotor under rated torque where no inertia is stated; servo motors have 3000 to 30000."""


def _number(
    name: str, unit: str, low: float, high: float, default: float | None, meaning: str, falls_back: str = ""
) -> Key:
    return Key(_TABLE, name, "float", unit, low, high, default, meaning, falls_back=falls_back)


def _whole(name: str, low: float, high: float, default: int | None, meaning: str, falls_back: str = "") -> Key:
    return Key(_TABLE, name, "int", "1", low, high, default, meaning, falls_back=falls_back)


def _choice(name: str, choices: tuple[str, ...], default: str, meaning: str) -> Key:
    return Key(_TABLE, name, "text", "", -math.inf, math.inf, default, meaning, choices=choices)


def _flag(name: str, meaning: str) -> Key:
    return Key(_TABLE, name, "bool", "", 0, 1, False, meaning)


SIMULATION_KEYS: tuple[Key, ...] = (
    # the inverter
    _choice("inverter_model", ("averaged", "switched"), "averaged", "one voltage per period, or every edge"),
    _choice(
        "deadtime_shape",
        ("none", "sign", "atan", "tanh", "capacitive"),
        "tanh",
        "voltage error over current of the averaged model",
    ),
    _number("dead_time_s", "s", 0, 2e-5, None, "dead time per edge", "[inverter] dead_time_s"),
    _number("i_knee_apk", "A", 1e-4, 1e4, 0.5, "current at which the averaged error reaches its plateau"),
    _number("device_drop_v", "V", 0, 10, 0.0, "threshold of a switch"),
    _number("device_slope_ohm", "ohm", 0, 10, 0.0, "slope resistance of a switch"),
    _number("diode_drop_v", "V", 0, 10, 0.0, "threshold of a diode"),
    _number("diode_slope_ohm", "ohm", 0, 10, 0.0, "slope resistance of a diode"),
    _number("output_capacitance_f", "F", 0, 1e-6, 0.0, "capacitance of a leg's output node"),
    _number("minimum_pulse_s", "s", 0, 1e-4, 0.0, "pulses shorter than this are not made"),
    _number("leg_mismatch_s", "s", -1e-5, 1e-5, 0.0, "dead time of leg a more, of leg b less than nominal"),
    _choice("compensation", ("off", "right", "wrong"), "off", "the drive's own dead-time compensation"),
    _choice("recorded_voltage", ("before", "after"), "before", "recorded voltage: before or after compensation"),
    _number("U_dc_v", "V", 0, 2000, None, "actual DC-link voltage", "[inverter] U_dc_v"),
    _number("U_dc_ripple_v", "V", 0, 500, 0.0, "amplitude of the DC-link ripple"),
    _number("U_dc_ripple_hz", "Hz", 0, 1e5, 300.0, "frequency of the DC-link ripple"),
    _number("U_dc_source_ohm", "ohm", 0, 100, 0.0, "resistance of the supply: the link falls under load"),
    _number("U_dc_source_s", "s", 0, 10, 1e-3, "time constant of that resistance and the link's capacitor"),
    _number("U_dc_capacitance_f", "F", 0, 10, 0.0, "capacitor of a supply that feeds only; 0: it holds the link"),
    _number("U_dc_chopper_v", "V", 0, 2000, None, "brake chopper of that link", "[inverter] U_dc_chopper_v"),
    _number("U_dc_chopper_ohm", "ohm", 0, 1e4, 0.0, "its resistor; 0: it holds its voltage"),
    # the sensors
    _number("sensor_gain_a", "1", 0.5, 2, 1.0, "gain of the current sensor of phase a"),
    _number("sensor_gain_b", "1", 0.5, 2, 1.0, "gain of the current sensor of phase b"),
    _number("sensor_gain_c", "1", 0.5, 2, 1.0, "gain of the current sensor of phase c"),
    _number("sensor_offset_a_apk", "A", -1e3, 1e3, 0.0, "offset of the current sensor of phase a"),
    _number("sensor_offset_b_apk", "A", -1e3, 1e3, 0.0, "offset of the current sensor of phase b"),
    _number("sensor_offset_c_apk", "A", -1e3, 1e3, 0.0, "offset of the current sensor of phase c"),
    _number("sensor_drift_apk_per_s", "A/s", -10, 10, 0.0, "drift of the offset of phase a; phase b drifts against it"),
    _number("sensor_cubic", "1", -0.1, 0.1, 0.0, "cubic error at full scale, share of it"),
    _number("sensor_lag_s", "s", 0, 1e-3, 0.0, "time constant of the current sensors"),
    _number("sensor_noise_apk", "A", 0, 100, 0.0, "standard deviation of a phase current sample"),
    _whole("adc_bits", 0, 24, 12, "resolution of the current ADC, 0 none"),
    _number("adc_full_scale_apk", "A", 1e-3, 1e5, None, "full scale of the ADC; default 1.5 I_max, or 3 I_nom"),
    _number("sampling_shift_s", "s", -1e-4, 1e-4, 0.0, "sampling instant after the PWM centre"),
    _number("U_dc_gain", "1", 0.5, 2, 1.0, "gain of the DC-link measurement"),
    _whole("encoder_bits", 0, 32, 17, "resolution of the encoder per turn, 0 none"),
    _number("encoder_offset_rad", "rad", -_PI2, _PI2, None, "true electrical offset", "[encoder] offset_rad"),
    _flag("encoder_reversed", "the encoder counts against the phase order of the machine"),
    _flag("leads_swapped", "leads b and c exchanged; load and traces follow the drive's phase order"),
    _number("encoder_once_rad", "rad", -0.1, 0.1, 0.0, "encoder error once per turn, amplitude (mechanical)"),
    _number("encoder_twice_rad", "rad", -0.1, 0.1, 0.0, "encoder error twice per turn, amplitude (mechanical)"),
    _whole("encoder_lines", 0, 1000000, 0, "lines of the encoder per turn, between which it interpolates"),
    _number("encoder_line_rad", "rad", -0.1, 0.1, 0.0, "encoder error once per line, amplitude (mechanical)"),
    _number("encoder_line_twice_rad", "rad", -0.1, 0.1, 0.0, "encoder error twice per line, amplitude (mechanical)"),
    _number("encoder_noise_rad", "rad", 0.0, 0.01, 0.0, "encoder noise, white, standard deviation (mechanical)"),
    _number("encoder_latency_s", "s", 0, 1e-3, 0.0, "age of an encoder sample"),
    _choice("encoder_kind", ("absolute", "index", "none"), "absolute", "index: counts from it once it was passed"),
    _choice("hall_order", ("none", *HALL_ORDERS), "none", "Hall sensors: phase of the sensor on wires 1, 2, 3"),
    _number("hall_offset_rad", "rad", -_PI2, _PI2, 0.0, "electrical angle by which all sensors are turned"),
    _number("hall_error_a_rad", "rad", -1, 1, 0.0, "placement error of the sensor of phase a, electrical"),
    _number("hall_error_b_rad", "rad", -1, 1, 0.0, "placement error of the sensor of phase b, electrical"),
    _number("hall_error_c_rad", "rad", -1, 1, 0.0, "placement error of the sensor of phase c, electrical"),
    _number("shunt_blind_s", "s", 0, 1e-4, 0.0, "low-side pulses shorter than this cannot be read, 0 in-phase sensors"),
    # temperatures
    _number("T_winding_c", "degC", -60, 300, 20.0, "winding temperature at the start"),
    _number("T_magnet_c", "degC", -60, 300, 20.0, "magnet temperature"),
    _number("T_ambient_c", "degC", -60, 150, 20.0, "temperature the machine cools to"),
    _flag("thermal_on", "the winding heats by its copper loss"),
    _number("thermal_capacity_j_per_k", "J/K", 1e-3, 1e7, 1000.0, "heat capacity of the winding"),
    _number("thermal_resistance_k_per_w", "K/W", 1e-4, 1e4, 0.5, "winding to ambient"),
    _number("T_sensor_lag_s", "s", 0, 1e4, 0.0, "time constant of the temperature sensor"),
    # the shaft
    _number("J_kgm2", "kg m2", 1e-9, 1e4, None, "inertia of rotor and what is rigid with it", "[machine] J_kgm2"),
    _number("B_nms", "N m s", 0, 1e4, None, "viscous friction", "[machine] B_nms"),
    _number("tau_c_nm", "N m", 0, 1e5, None, "Coulomb friction torque", "[machine] tau_c_nm"),
    _number("stribeck_share", "1", 0, 5, 0.0, "friction at rest above tau_c_nm, share of it"),
    _number("stribeck_rpm", "rpm", 1e-3, 1e5, 1.0, "speed at which 1/e of that is left"),
    _number("friction_once", "1", 0, 0.9, 0.0, "tau_c_nm over the angle: sine once per turn, share of it"),
    _number("drag_nms2", "N m s2", 0, 1e4, 0.0, "drag of air: torque per square of the speed"),
    _number("load_nm", "N m", -1e6, 1e6, 0.0, "load torque, positive against positive rotation"),
    _number("load_viscous_nms", "N m s", 0, 1e4, 0.0, "load torque per speed"),
    _number("J_load_kgm2", "kg m2", 0, 1e4, 0.0, "second mass behind an elastic shaft, 0 none"),
    _number("coupling_stiffness_nm_per_rad", "N m/rad", 0, 1e9, 0.0, "stiffness of the elastic shaft"),
    _number("coupling_damping_nms_per_rad", "N m s/rad", 0, 1e6, 0.0, "damping of the elastic shaft, 0: 1 %"),
    _number("backlash_rad", "rad", 0, 1, 0.0, "play of the elastic shaft, from end to end"),
    _choice("rotor", ("free", "locked", "driven"), "free", "free, held, or turned by a load machine"),
    _number("driven_rpm", "rpm", -1e6, 1e6, 0.0, "speed of a driven rotor"),
    _number("limit_switch_negative_rad", "rad", -1e6, 1e6, -1e6, "limit switch, active below this angle of the shaft"),
    _number("limit_switch_positive_rad", "rad", -1e6, 1e6, 1e6, "limit switch, active above this angle of the shaft"),
    _number("theta_M_start_rad", "rad", -_PI2, _PI2, 0.0, "mechanical angle at the start"),
    _number("cogging_nm", "N m", 0, 1e4, 0.0, "amplitude of the cogging torque"),
    _whole("cogging_periods", 0, 10000, 0, "cogging periods per mechanical turn"),
    _number("cogging_slot_nm", "N m", 0, 1e4, 0.0, "cogging of the tolerances of the magnets, amplitude"),
    _whole("cogging_slot_periods", 0, 10000, 0, "its periods per mechanical turn: slots"),
    _number("cogging_pole_nm", "N m", 0, 1e4, 0.0, "cogging of the tolerances of the stator, amplitude"),
    _whole("cogging_pole_periods", 0, 10000, 0, "its periods per mechanical turn: poles"),
    # the machine, where the truth differs from the file
    _number("R_s_ohm", "ohm", 1e-5, 1e3, None, "true loop resistance at T_ref", "[machine] R_s_ohm"),
    _number("L_d_h", "H", 1e-7, 10, None, "true d inductance", "[machine] L_d_h"),
    _number("L_q_h", "H", 1e-7, 10, None, "true q inductance", "[machine] L_q_h"),
    _number("psi_f_wb", "Wb", 0, 100, None, "true PM flux linkage at T_ref", "[machine] psi_f_wb"),
    _number("resistance_imbalance", "1", 0, 0.9, 0.0, "phase a above the mean R_s_ohm of the phases, share of it"),
    _number("inductance_imbalance", "1", -0.5, 0.5, 0.0, "phase a above the mean inductance, share of it"),
    _number("inductance_6", "1", -0.5, 0.5, 0.0, "sixth harmonic of the inductances over the electrical angle"),
    _number(
        "alpha_psi_per_k", "1/K", -0.01, 0.001, None, "true coefficient of the magnets", "[machine] alpha_psi_per_k"
    ),
    _whole("pole_pairs", 1, MAX_POLE_PAIRS, None, "true pole pairs", "[machine] pole_pairs"),
    _number("iron_loss_ohm", "ohm", 0, 1e6, 0.0, "iron-loss resistance in parallel with the flux voltage, 0 none"),
    _number("eddy_share", "1", 0, 0.9, 0.0, "share of the inductances that fast changes do not see"),
    _number("eddy_time_s", "s", 1e-6, 1, 1e-3, "time constant of that share"),
    _number("psi_6_wb", "Wb", 0, 10, 0.0, "flux harmonic of order 6 in dq, the 5th of a phase"),
    _number("psi_7_wb", "Wb", 0, 10, 0.0, "7th flux harmonic of a phase, of order 6 in dq, too"),
    _number("psi_12_wb", "Wb", 0, 10, 0.0, "flux harmonic of order 12 in dq, the 11th of a phase"),
    # faults and identity
    _choice("phase_open", ("none", "a", "b", "c"), "none", "a phase that is not connected"),
    Key(_TABLE, "drive_fault", "text", "", -math.inf, math.inf, "none", "misbehaviour of the simulated drive by name"),
    _whole("serial", 0, 2**32 - 1, 1, "serial number of the simulated drive"),
    _whole("seed", 0, 2**63 - 1, 0, "seed of its noise"),
)


PEAK_SHARE = 2.0
"""Short-time over rated current where only one is stated; servo motors have 2 to 4."""
FULL_SCALE_SHARE = 1.5
"""Full scale of the current measurement over the largest current."""


def resolved_simulation(given: dict[str, Value], tables: dict[str, dict[str, Value]]) -> dict[str, Value]:
    """Return every simulation key with its value.

    Parameters
    ----------
    given : dict
        The valid ``[simulation]`` table.
    tables : dict
        Values of the other tables (``machine``, ``inverter``, ``encoder``), for keys that fall back to them.

    Returns
    -------
    dict
        A key without value anywhere (an inertia that nobody gave) is left out.
    """
    resolved: dict[str, Value] = {}
    for key in SIMULATION_KEYS:
        value = given.get(key.name, key.default)
        if value is None and key.falls_back:
            table, name = key.falls_back[1:].split("] ")
            value = tables.get(table, {}).get(name)
        if value is None and key.name == "adc_full_scale_apk":
            largest, rated = (tables.get("machine", {}).get(name) for name in ("I_max_apk", "I_nom_apk"))
            if isinstance(largest, float | int):
                value = FULL_SCALE_SHARE * largest
            elif isinstance(rated, float | int):
                value = FULL_SCALE_SHARE * PEAK_SHARE * rated
        if value is not None:
            resolved[key.name] = value
    return resolved


def simulation_of(machine: MachineParameters, encoder_bits: int | None) -> tuple[dict[str, Value], list[str]]:
    """Return the table, and one line per value that is assumed.

    Parameters
    ----------
    machine : MachineParameters
        As the datasheet says it; its own values are the simulated machine's where the table has none.
    encoder_bits : int or None
        Resolution per turn.
    """
    table: dict[str, Value] = {"encoder_bits": ENCODER_BITS if encoder_bits is None else encoder_bits}
    assumed = [] if encoder_bits is not None else [f"encoder of {ENCODER_BITS} bits per turn"]
    rated = machine.I_nom_apk or (machine.I_max_apk or 0.0) / PEAK_SHARE
    if not rated:
        return {**table, "adc_bits": 0}, [*assumed, "no rated current is given: no current measurement is modelled"]
    full_scale = FULL_SCALE_SHARE * (machine.I_max_apk or PEAK_SHARE * rated)
    table |= {"adc_full_scale_apk": full_scale, "sensor_noise_apk": NOISE_SHARE * full_scale}
    assumed.append(f"current measurement to {format_quantity(full_scale, 'A', 3)} peak, noise {NOISE_SHARE:g} of it")
    torque = torque_per_ampere(machine.pole_pairs, machine.psi_f_wb) * rated
    if machine.tau_c_nm is None:
        table["tau_c_nm"] = FRICTION_SHARE * torque
        assumed.append(f"Coulomb friction {100.0 * FRICTION_SHARE:g} % of the rated torque")
    if machine.J_kgm2 is None:
        table["J_kgm2"] = torque / ACCELERATION_RAD_S2
        assumed.append(f"inertia: {ACCELERATION_RAD_S2:g} rad/s2 under rated torque (none is given)")
    return table, assumed
