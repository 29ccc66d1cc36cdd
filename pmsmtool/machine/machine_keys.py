# SPDX-License-Identifier: MIT
"""Keys of a machine file, table by table: validation and documentation in one (``machine_file_keys``)."""

from __future__ import annotations

import math
import re
from dataclasses import replace

from pmsmtool.machine.key import Key, KeyKind, Value
from pmsmtool.machine.parameters import MAX_POLE_PAIRS
from pmsmtool.machine.simulation_keys import SIMULATION_KEYS
from pmsmtool.machine.temperature import COPPER_ALPHA_PER_K, MAGNET_ALPHA_PER_K


def _key(
    table: str,
    name: str,
    unit: str,
    low: float,
    high: float,
    default: Value | None,
    meaning: str,
    *,
    kind: KeyKind = "float",
    required: bool = False,
    besides: tuple[float, ...] = (),
) -> Key:
    return Key(table, name, kind, unit, low, high, default, meaning, required, besides=besides)


def _text(table: str, name: str, meaning: str) -> Key:
    return Key(table, name, "text", "", -math.inf, math.inf, None, meaning)


_PI2 = 2.0 * math.pi

MACHINE_KEYS: tuple[Key, ...] = (
    _key("machine", "pole_pairs", "1", 1, MAX_POLE_PAIRS, None, "pole pairs", kind="int", required=True),
    _key("machine", "R_s_ohm", "ohm", 1e-5, 1e3, None, "loop resistance per phase at T_ref", required=True),
    _key("machine", "L_d_h", "H", 1e-7, 10, None, "incremental d inductance", required=True),
    _key("machine", "L_q_h", "H", 1e-7, 10, None, "incremental q inductance", required=True),
    _key(
        "machine", "psi_f_wb", "Wb", 1e-6, 100, None, "PM flux linkage at T_ref (peak)", required=True, besides=(0.0,)
    ),
    _key("machine", "R_winding_ohm", "ohm", 1e-5, 1e3, None, "copper part of R_s"),
    _key("machine", "L_d_app_h", "H", 1e-7, 10, None, "apparent d inductance, default L_d_h"),
    _key("machine", "L_q_app_h", "H", 1e-7, 10, None, "apparent q inductance, default L_q_h"),
    _key("machine", "T_ref_c", "degC", -60, 200, 20.0, "reference temperature of R_s and psi_f"),
    _key("machine", "alpha_R_per_k", "1/K", 0, 0.01, COPPER_ALPHA_PER_K, "temperature coefficient of the copper"),
    _key("machine", "alpha_psi_per_k", "1/K", -0.01, 0.001, MAGNET_ALPHA_PER_K, "temperature coefficient of psi_f"),
    _key("machine", "alpha_psi_tolerance_per_k", "1/K", 0, 0.01, None, "95 % half width of that coefficient"),
    _key("machine", "I_nom_apk", "A", 1e-3, 1e5, None, "rated current (peak)"),
    _key("machine", "I_max_apk", "A", 1e-3, 1e5, None, "time-limited current (peak)"),
    _key("machine", "I_max_time_s", "s", 0, 3600, None, "time I_max may flow from cold"),
    _key("machine", "n_nom_rpm", "rpm", 1, 1e6, None, "rated speed"),
    _key("machine", "n_max_rpm", "rpm", 1, 1e6, None, "largest mechanical speed"),
    _key("machine", "J_kgm2", "kg m2", 1e-9, 1e4, None, "inertia"),
    _key("machine", "B_nms", "N m s", 0, 1e4, None, "viscous friction"),
    _key("machine", "tau_c_nm", "N m", 0, 1e5, None, "Coulomb friction torque"),
    _key("machine", "resonance_hz", "Hz", 0.01, 1e5, None, "resonance of rotor and load behind an elastic shaft"),
    _key("machine", "antiresonance_hz", "Hz", 0.01, 1e5, None, "antiresonance below it: the load swings alone"),
    _key("machine", "resonance_zeta", "1", 0, 10, None, "damping of the resonance"),
    _text("machine", "flux_map", "file of the flux map, relative to this file"),
    _text("machine", "iron_loss_map", "file of the iron-loss map, relative to this file"),
)

INVERTER_KEYS: tuple[Key, ...] = (
    _key("inverter", "U_dc_v", "V", 1, 2000, None, "nominal DC-link voltage", required=True),
    _key("inverter", "f_s_hz", "Hz", 100, 200_000, None, "sampling and PWM frequency", required=True),
    _key("inverter", "dead_time_s", "s", 0, 2e-5, 0.0, "dead time per switching edge"),
    _key("inverter", "delay_periods", "1", 0.5, 3, 1.5, "delay from sample to mean applied voltage, in periods"),
    _key(
        "inverter",
        "voltage_utilisation",
        "1",
        0.1,
        0.6366198,
        1 / math.sqrt(3.0),
        "V_max / U_dc; above 0.5774: overmodulation, needs min_off_time_s, sample_window_s, shunts",
    ),
    _key("inverter", "V_dead_v", "V", 0, 1e3, None, "plateau of the voltage error of one phase"),
    _key("inverter", "i_knee_apk", "A", 1e-4, 1e4, None, "current at which it reaches its plateau"),
    _key("inverter", "voltage_error_i_apk", "A", -1e5, 1e5, (), "increasing currents of the table", kind="floats"),
    _key("inverter", "voltage_error_v", "V", -1e3, 1e3, (), "voltage error of one phase there", kind="floats"),
    _key("inverter", "current_lag_s", "s", 0, 1e-3, None, "time constant of the current sensors"),
    _key("inverter", "sampling_instant_s", "s", -1e-3, 1e-3, None, "sampling of the currents after the PWM centre"),
    _key("inverter", "U_dc_chopper_v", "V", 1, 2000, None, "voltage at which a brake chopper holds the link"),
    _key("inverter", "min_off_time_s", "s", 0, 2e-5, None, "time a leg's lower switch is on in each period"),
    _key("inverter", "sample_window_s", "s", 0, 2e-5, None, "time that reading a shunt takes"),
    _key(
        "inverter",
        "shunts",
        "1",
        0,
        3,
        None,
        "shunts: 1 in the link, 3 in the legs, 0: sensors in the phases",
        kind="int",
    ),
)

ENCODER_KEYS: tuple[Key, ...] = (
    _key("encoder", "offset_rad", "rad", -_PI2, _PI2, 0.0, "theta_e = direction p theta_M - offset"),
    _key("encoder", "direction", "1", -1, 1, 1, "+1 along the phase order, -1 against it", kind="int"),
    _key("encoder", "bits", "1", 1, 32, None, "resolution per mechanical turn", kind="int"),
    _key("encoder", "hall_commutation", "1", 0, 3, None, "by Hall sensors: 1 start, 2 alone, 3 six steps", kind="int"),
    *(
        _key(
            "encoder",
            f"hall_axis_{k}_rad",
            "rad",
            -_PI2,
            _PI2,
            None,
            f"middle of Hall wire {k}'s high half, electrical",
        )
        for k in (1, 2, 3)
    ),
)

LIMIT_KEYS: tuple[Key, ...] = (
    _key("limits", "i_d_min_apk", "A", -1e5, 0, None, "most negative i_d (demagnetisation)"),
    _key("limits", "i_trip_apk", "A", 1e-3, 1e5, None, "instantaneous trip of any phase current"),
    _key("limits", "I_cont_apk", "A", 1e-3, 1e5, None, "current that may flow for ever"),
    _key("limits", "U_dc_min_v", "V", 0, 2000, None, "undervoltage trip"),
    _key("limits", "U_dc_max_v", "V", 1, 2000, None, "overvoltage trip"),
    _key("limits", "n_trip_rpm", "rpm", 1, 2e6, None, "overspeed trip"),
    _key("limits", "tau_max_nm", "N m", 0, 1e6, None, "largest torque of shaft and load"),
    _key("limits", "T_winding_max_c", "degC", 20, 300, None, "winding over-temperature trip"),
    _key("limits", "T_magnet_max_c", "degC", 20, 300, None, "magnet over-temperature"),
)

ESTIMATE_KEYS: tuple[Key, ...] = (
    _key("estimate", "value", "", -math.inf, math.inf, None, "estimate, SI", required=True),
    _key("estimate", "std", "", 0, math.inf, None, "statistical standard deviation; without it: unknown"),
    _key("estimate", "systematic", "", 0, math.inf, 0.0, "half width of the 95 % systematic part"),
    _text("estimate", "unit", "unit of the three"),
    _key("estimate", "n", "1", 0, 2**53, 0, "samples or levels in the fit", kind="int"),
    _key("estimate", "chi2", "1", 0, 1e30, None, "reduced chi-square of the fit"),
    _key("estimate", "T_c", "degC", -100, 400, None, "winding or magnet temperature"),
    _text("estimate", "method", "how it was found"),
    _text("estimate", "source", "who found it: pmsmtool, vendor, datasheet, meter"),
    _key("estimate", "i_d_apk", "A", -1e5, 1e5, None, "bias point"),
    _key("estimate", "i_q_apk", "A", -1e5, 1e5, None, "bias point"),
    _key("estimate", "dof", "1", 0, 1e15, None, "degrees of freedom behind std"),
    _text("estimate", "fallback", "what the method fell back to"),
)

MEASURABLE: dict[str, Key] = {
    key.name: key for key in (*MACHINE_KEYS, *INVERTER_KEYS, *ENCODER_KEYS) if key.kind in ("float", "int")
}
"""Keys that ``[std]``, ``[systematic]`` and ``[estimate.<key>]`` may speak of."""

_EFFECTS = {
    r"psi_\d+_wb": _key("estimate", "psi_5_wb", "Wb", 0, 100, None, "harmonic of a phase's flux linkage (peak)"),
    r"psi_\d+_rad": _key("estimate", "psi_5_rad", "rad", -_PI2, _PI2, None, "its phase"),
    r"cogging(_\d+)?_nm": _key("estimate", "cogging_nm", "N m", 0, 1e4, None, "cogging torque, largest or of an order"),
    r"cogging_\d+_rad": _key("estimate", "cogging_12_rad", "rad", -_PI2, _PI2, None, "its phase"),
    "iron_loss_ohm": _key("estimate", "iron_loss_ohm", "ohm", 0, 1e6, None, "iron loss, across the flux voltage"),
    "drag_nms2": _key("estimate", "drag_nms2", "N m s2", 0, 1e4, None, "drag of air, of the square of the speed"),
}
"""What no design depends on, as what repeats with the angle: keys of ``[estimate.<key>]`` alone."""


def estimated_key(name: str) -> Key | None:
    """Return the key that ``[estimate.<name>]`` speaks of, a label behind it left out; None: there is none."""
    effect = next((key for pattern, key in _EFFECTS.items() if re.fullmatch(pattern, name)), None)
    return effect or next((key for k, key in MEASURABLE.items() if name == k or name.startswith(f"{k}_")), None)


def deviation_keys(table: str) -> tuple[Key, ...]:
    """Return the keys of ``[std]`` or ``[systematic]``: one non-negative number per measurable key."""
    return tuple(
        Key(table, key.name, "float", key.unit, 0, _span(key), None, f"of {key.meaning}") for key in MEASURABLE.values()
    )


def estimate_keys(key: Key) -> tuple[Key, ...]:
    """Return the keys of ``[estimate.<key>]``: of what is never negative an estimate near zero may be."""
    low = key.minimum if key.minimum > 0 else -max(abs(key.minimum), key.maximum)
    bounds = {"value": (low, key.maximum), "std": (0, _span(key)), "systematic": (0, _span(key))}
    return tuple(
        replace(row, minimum=bounds[row.name][0], maximum=bounds[row.name][1], unit=key.unit, besides=key.besides)
        if row.name in bounds
        else row
        for row in ESTIMATE_KEYS
    )


def _span(key: Key) -> float:
    """Return the largest deviation: from one bound to the other."""
    return key.maximum - key.minimum


def machine_file_keys() -> tuple[Key, ...]:
    """Return every key of a machine file, in file order, with unit, bounds, default and meaning."""
    return (
        *MACHINE_KEYS,
        *INVERTER_KEYS,
        *deviation_keys("std"),
        *deviation_keys("systematic"),
        *ENCODER_KEYS,
        *LIMIT_KEYS,
        *ESTIMATE_KEYS,
        *SIMULATION_KEYS,
    )
