# SPDX-License-Identifier: MIT
"""Ratings, protections, inverter and encoder: what the machine file gives, and what is assumed where it is silent.

Every assumption is the value's method, so that it stands in the design file beside the number.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np

from pmsmtool.design.design_file import Design, DesignValue
from pmsmtool.design.lookup.table import torque_limits
from pmsmtool.design.operating_machine import at_temperature
from pmsmtool.errors import ConfigError
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.parameters import MachineParameters, dead_time_compensation
from pmsmtool.machine.temperature import loop_coefficient_per_k
from pmsmtool.machine.uncontrolled_generation import FaultReaction, Protection, fault_reaction
from pmsmtool.params.catalogue import BY_NAME
from pmsmtool.params.parameter_set import ASSUMED
from pmsmtool.units import RPM_PER_RAD_S

TRIP_CURRENT_RATIO = 1.5
"""Trip over I_max: room for the overshoot of a current step under 40 % too little inductance, and for noise."""

SAG_SHARE = 0.7
"""Share of its voltage to which the DC link may sag: what that costs is said, and a table reaches as far."""

TRIP_SPEED_RATIO = 1.2
"""Overspeed trip over the largest speed."""

U_DC_RANGE = (0.5, 1.25)
"""Under- and overvoltage trip over the nominal DC-link voltage."""

WINDING_LIMIT_C = 155.0
"""Winding temperature limit of insulation class F (IEC 60085)."""

OVERLOAD_S = 10.0
"""Time I_max may flow where the machine file states none."""

MAGNET_SHARE = 0.7
"""Share of the magnet's flux linkage that i_d may oppose where no demagnetisation limit is given."""

GIVEN = "machine file"


@dataclass(frozen=True, slots=True)
class Ratings:
    """Currents, speed and torque the design works with."""

    I_nom_apk: float
    I_max_apk: float
    I_cont_apk: float
    """Rated, time-limited and continuous current (A peak)."""
    n_max_rpm: float
    """Largest mechanical speed (rpm)."""
    tau_max_nm: float
    """Largest torque the speed controller may ask for (N m)."""
    i_d_min_a: float
    """Most negative i_d (A)."""
    U_dc_max_v: float
    n_trip_rpm: float
    """Overvoltage (V) and overspeed (rpm) trip."""
    reaction: FaultReaction
    """What a fault does to the inverter."""
    base_speed_rpm: float
    """Speed at which rated torque takes the whole voltage (rpm)."""
    methods: Mapping[str, str]
    """How each of them was found."""


def ratings(source: MachineFile, V_limit_v: float, protection: Protection | None = None) -> Ratings:
    """Collect the ratings, at most the speed at which a fault can still be handled.

    Raises ConfigError: no current rating at all; DesignInfeasible: as
    :func:`~pmsmtool.machine.uncontrolled_generation.fault_reaction`.

    Parameters
    ----------
    source : MachineFile
        Machine, inverter and limits.
    V_limit_v : float
        Voltage in use (V peak), for the base speed.
    protection : str, optional
        What holds the DC link at over-speed, as asked for (``TuneRequest.overspeed_protection``).
    """
    machine, limits = source.machine, source.limits
    if machine.I_nom_apk is None and machine.I_max_apk is None:
        raise ConfigError(
            "no current rating is given",
            where="machine.I_nom_apk, machine.I_max_apk",
            hint="put the rated and the largest current (A peak) into [machine]",
        )
    methods = dict.fromkeys(("I_nom", "I_max", "I_cont", "n_max", "tau_max", "i_d_min"), GIVEN)
    I_max = machine.I_max_apk
    if I_max is None:
        assert machine.I_nom_apk is not None
        I_max, methods["I_max"] = machine.I_nom_apk, "I_nom: no larger current is given"
    I_nom = machine.I_nom_apk
    if I_nom is None or I_nom > I_max:
        I_nom, methods["I_nom"] = I_max, "I_max: no rated current below it is given"
    I_cont = limits.I_cont_apk
    if I_cont is None:
        I_cont, methods["I_cont"] = I_nom, "rated current"
    I_cont = min(I_cont, I_max)
    i_d_min = limits.i_d_min_apk
    if i_d_min is None:
        i_d_min, methods["i_d_min"] = _assumed_i_d_min(machine, I_nom, I_max)
    elif i_d_min < -I_max:
        i_d_min, methods["i_d_min"] = -I_max, "-I_max: nearer than the machine file's limit"
    base = base_speed_rpm(source, I_nom, i_d_min, V_limit_v)
    n_max = machine.n_max_rpm
    if n_max is None:
        if machine.n_nom_rpm is not None:
            n_max, methods["n_max"] = machine.n_nom_rpm, "rated speed: no largest speed is given"
        else:
            n_max, methods["n_max"] = base, "base speed at rated current: no speed is given"
    U_max, methods["U_dc_max"] = _either(
        limits.U_dc_max_v,
        min(U_DC_RANGE[1] * source.inverter.U_dc_v, BY_NAME["protection.U_dc_max_v"].maximum),
        f"{U_DC_RANGE[1]:g} U_dc",
    )
    n_trip, methods["n_trip"] = _either(limits.n_trip_rpm, TRIP_SPEED_RATIO * n_max, f"{TRIP_SPEED_RATIO:g} n_max")
    if protection is None and source.inverter.U_dc_chopper_v is not None:
        protection = "chopper"
    stands = i_d_min if limits.i_d_min_apk is None else limits.i_d_min_apk
    reaction = fault_reaction(machine, source.inverter.U_dc_v, U_max, n_trip, stands, protection)
    if n_trip > reaction.trip_most_rpm:
        n_trip, methods["n_trip"] = reaction.trip_most_rpm, "speed of uncontrolled generation"
    if n_max > reaction.n_most_rpm:
        n_max, methods["n_max"] = reaction.n_most_rpm, "below uncontrolled generation: nothing holds the link there"
    plane = at_temperature(machine, source.flux_map)
    shaft = float(torque_limits(plane, [0.0], [_UNLIMITED_V], I_max, i_d_min).largest_nm[0, 0])
    methods["tau_max"] = "torque of least current at I_max"
    if limits.tau_max_nm is not None and limits.tau_max_nm < shaft:
        shaft, methods["tau_max"] = limits.tau_max_nm, GIVEN
    return Ratings(I_nom, I_max, I_cont, n_max, shaft, i_d_min, U_max, n_trip, reaction, base, methods)


def ratings_of(design: Design) -> Ratings:
    """Return the ratings that a design was made with."""
    V_limit = (1.0 - design["field_weakening.margin"]) * design.machine.inverter.V_max_v
    return ratings(design.machine, V_limit, cast("Protection | None", design.request.get("overspeed_protection")))


def _either(given: float | None, assumed: float, how: str) -> tuple[float, str]:
    return (assumed, how) if given is None else (given, GIVEN)


_UNLIMITED_V = 1e9


def _assumed_i_d_min(machine: MachineParameters, I_nom: float, I_max: float) -> tuple[float, str]:
    """Return the most negative i_d (A) where no demagnetisation limit is given, and how it was found."""
    if machine.psi_f_wb <= 0.0:
        return -I_max, "-I_max: no magnet to demagnetise"
    weakened = MAGNET_SHARE * machine.psi_f_wb / machine.L_d_decoupling_h
    if weakened < I_nom:
        return -weakened, f"assumed: -{MAGNET_SHARE:g} psi_f/L_d, no i_d_min_apk is given"
    return -I_nom, "assumed: -I_nom, no i_d_min_apk is given"


def base_speed_rpm(source: MachineFile, I_apk: float, i_d_min_a: float, V_limit_v: float) -> float:
    """Return the speed at which the largest torque of a current takes the whole voltage (rpm)."""
    machine = at_temperature(source.machine, source.flux_map)
    top = torque_limits(machine, [0.0], [_UNLIMITED_V], I_apk, i_d_min_a)
    i_d, i_q = float(top.largest_i_d_a[0, 0]), float(top.largest_i_q_a[0, 0])
    psi_d, psi_q = (float(x) for x in machine.flux(i_d, i_q))
    # |v|^2 = (R i)^2 + 2 R w t + (w psi)^2 = V^2
    t, g, h = psi_d * i_q - psi_q * i_d, psi_d**2 + psi_q**2, (machine.R * math.hypot(i_d, i_q)) ** 2
    room = V_limit_v**2 - h
    if room <= 0.0 or g == 0.0:
        return 0.0
    omega = (-machine.R * t + math.sqrt((machine.R * t) ** 2 + g * room)) / g
    return omega / machine.pole_pairs * RPM_PER_RAD_S


def rating_values(source: MachineFile, rated: Ratings) -> dict[str, DesignValue]:
    """Return the catalogue values of motor, inverter, protection and encoder."""
    return {**_motor(source, rated), **_inverter(source), **_protection(source, rated), **_encoder(source)}


def _motor(source: MachineFile, rated: Ratings) -> dict[str, DesignValue]:
    machine, how = source.machine, rated.methods
    app = "apparent" if machine.L_d_app_h is not None or machine.L_q_app_h is not None else "as incremental"
    time, time_how = (machine.I_max_time_s, GIVEN) if machine.I_max_time_s is not None else (OVERLOAD_S, ASSUMED)
    given: dict[str, float] = {
        "pole_pairs": machine.pole_pairs,
        "R_s_ohm": machine.R_s_ohm,
        "L_d_h": machine.L_d_h,
        "L_q_h": machine.L_q_h,
        "psi_f_wb": machine.psi_f_wb,
        "T_ref_c": machine.T_ref_c,
        "alpha_R_per_k": loop_coefficient_per_k(machine),
        "alpha_psi_per_k": machine.alpha_psi_per_k,
    }
    values = {f"motor.{name}": DesignValue(float(value), GIVEN) for name, value in given.items()}
    for name, value in (("J_kgm2", machine.J_kgm2), ("B_nms", machine.B_nms), ("tau_c_nm", machine.tau_c_nm)):
        values[f"motor.{name}"] = DesignValue(value or 0.0, "not known" if value is None else GIVEN)
    values["motor.I_max_apk"] = DesignValue(rated.I_max_apk, how["I_max"])
    values["motor.I_nom_apk"] = DesignValue(rated.I_nom_apk, how["I_nom"])
    values["motor.I_max_time_s"] = DesignValue(time, time_how)
    values["motor.n_max_rpm"] = DesignValue(rated.n_max_rpm, how["n_max"])
    values["motor.L_d_app_h"] = DesignValue(machine.L_d_decoupling_h, app)
    values["motor.L_q_app_h"] = DesignValue(machine.L_q_decoupling_h, app)
    return values


def _inverter(source: MachineFile) -> dict[str, DesignValue]:
    inverter = source.inverter
    V_dead, i_knee, how = dead_time_compensation(inverter)
    on, usual = V_dead > 0.0, inverter.overmodulates or not inverter.min_off_time_s
    utilisation = GIVEN if usual else "machine file, at most the linear range that min_off_time_s leaves"
    return {
        "inverter.T_s_ns": DesignValue(round(1e9 * inverter.T_s), GIVEN),
        "inverter.voltage_utilisation": DesignValue(inverter.voltage_utilisation, utilisation),
        "inverter.dead_time_ns": DesignValue(round(1e9 * inverter.dead_time_s), GIVEN),
        "inverter.delay_periods": DesignValue(inverter.delay_periods, GIVEN),
        "inverter.deadtime_compensation": DesignValue(float(on), how),
        "inverter.V_dead_v": DesignValue(V_dead, how),
        "inverter.i_knee_apk": DesignValue(i_knee, how),
        "inverter.U_dc_nom_v": DesignValue(inverter.U_dc_v, GIVEN),
        **{f"inverter.{name}": DesignValue(value, GIVEN) for name, value in inverter.shunt_values().items()},
    }


def _protection(source: MachineFile, rated: Ratings) -> dict[str, DesignValue]:
    limits, how, low = source.limits, rated.methods, U_DC_RANGE[0]
    i_trip = _either(limits.i_trip_apk, TRIP_CURRENT_RATIO * rated.I_max_apk, f"{TRIP_CURRENT_RATIO:g} I_max")
    U_min = _either(limits.U_dc_min_v, low * source.inverter.U_dc_v, f"{low:g} U_dc")
    T_max = _either(limits.T_winding_max_c, WINDING_LIMIT_C, "insulation class F assumed")
    return {
        "protection.i_trip_apk": DesignValue(*i_trip),
        "protection.U_dc_min_v": DesignValue(*U_min),
        "protection.U_dc_max_v": DesignValue(rated.U_dc_max_v, how["U_dc_max"]),
        "protection.n_trip_rpm": DesignValue(rated.n_trip_rpm, how["n_trip"]),
        "protection.T_winding_max_c": DesignValue(*T_max),
        "protection.I_cont_apk": DesignValue(rated.I_cont_apk, how["I_cont"]),
        "protection.n_short_circuit_rpm": DesignValue(rated.reaction.short_from_rpm, rated.reaction.how),
        "governor.I_transient_apk": DesignValue(rated.I_max_apk, "I_max"),
    }


def voltage_facts(source: MachineFile, rated: Ratings, V_limit_v: float) -> dict[str, float]:
    """Return the torque share that a sagged link leaves at base and largest speed, and overmodulation's current."""
    plane, facts = at_temperature(source.machine, source.flux_map), {}
    for where, rpm in (("base_speed", rated.base_speed_rpm), ("n_max", rated.n_max_rpm)):
        V = [SAG_SHARE * V_limit_v, V_limit_v]
        found = torque_limits(plane, [rpm / RPM_PER_RAD_S * plane.pole_pairs], V, rated.I_max_apk, rated.i_d_min_a)
        sagged, full = (float(x) for x in np.nan_to_num(found.largest_nm[0]))
        facts[f"sag_torque_share_{where}"] = max(sagged, 0.0) / full if full > 0.0 else 0.0
    harmonic = source.inverter.harmonic_flux_wb(rated.base_speed_rpm / RPM_PER_RAD_S * plane.pole_pairs)
    return facts if harmonic == 0.0 else {**facts, "overmodulation_harmonic_apk": harmonic / source.machine.L_d_h}


def _encoder(source: MachineFile) -> dict[str, DesignValue]:
    encoder, offset = source.encoder, math.remainder(source.encoder.offset_rad, 2.0 * math.pi)
    given = {"encoder.offset_rad": offset, "encoder.reversed": float(encoder.direction == -1), **encoder.halls}
    return {name: DesignValue(value, GIVEN) for name, value in given.items()}
