# SPDX-License-Identifier: MIT
"""Every key of ``[simulation]`` moves something, and only where it should: off, the drive is ideal."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from pmsmtool.machine.key import Value
from pmsmtool.machine.simulation_keys import SIMULATION_KEYS
from pmsmtool.sim.scenarios import Scenario
from pmsmtool.sim.simulate import SimulatedDrive, find_drive, run_scenario
from pmsmtool.trace import Trace

IDEAL: Mapping[str, Value] = {
    "inverter_model": "averaged",
    "deadtime_shape": "none",
    "dead_time_s": 0.0,
    "device_drop_v": 0.0,
    "device_slope_ohm": 0.0,
    "diode_drop_v": 0.0,
    "diode_slope_ohm": 0.0,
    "output_capacitance_f": 0.0,
    "sensor_gain_a": 1.0,
    "sensor_gain_b": 1.0,
    "sensor_gain_c": 1.0,
    "sensor_offset_a_apk": 0.0,
    "sensor_offset_b_apk": 0.0,
    "sensor_offset_c_apk": 0.0,
    "sensor_lag_s": 0.0,
    "sensor_noise_apk": 0.0,
    "adc_bits": 0,
    "encoder_bits": 0,
    "thermal_on": False,
    "T_winding_c": 20.0,
    "T_magnet_c": 20.0,
    "T_ambient_c": 20.0,
    "U_dc_gain": 1.0,
}
"""Every effect off."""

DEAD = {"deadtime_shape": "tanh", "dead_time_s": 2e-6}
EDGES = {"inverter_model": "switched", "dead_time_s": 2e-6}
DEVICES = {**EDGES, "device_drop_v": 1.0, "diode_drop_v": 1.0}
HEATED = {"thermal_on": True, "thermal_capacity_j_per_k": 10.0}
BRAKED = {"rotor": "driven", "driven_rpm": -400.0}
ELASTIC = {"J_load_kgm2": 0.01, "coupling_stiffness_nm_per_rad": 500.0}

SWITCHES: dict[str, tuple[Value, Mapping[str, Value]]] = {
    "inverter_model": ("switched", {}),
    "deadtime_shape": ("sign", DEAD),
    "dead_time_s": (1e-6, DEAD),
    "i_knee_apk": (2.0, DEAD),
    "device_drop_v": (1.0, {}),
    "device_slope_ohm": (0.1, {"T_winding_c": 120.0}),  # a part of R_s_ohm, the loop, that does not warm up
    "diode_drop_v": (2.0, DEVICES),
    "diode_slope_ohm": (0.1, DEVICES),
    "output_capacitance_f": (1e-9, EDGES),
    "minimum_pulse_s": (3e-5, {"inverter_model": "switched"}),
    "leg_mismatch_s": (5e-7, DEAD),
    "compensation": ("right", DEAD),
    "recorded_voltage": ("after", {**DEAD, "compensation": "right"}),
    "U_dc_v": (500.0, {}),
    "U_dc_ripple_v": (20.0, {}),
    "U_dc_ripple_hz": (100.0, {"U_dc_ripple_v": 20.0}),
    "U_dc_source_ohm": (2.0, {}),
    "U_dc_source_s": (0.01, {"U_dc_source_ohm": 2.0}),
    "U_dc_capacitance_f": (1e-3, BRAKED),
    "U_dc_chopper_v": (541.0, {**BRAKED, "U_dc_capacitance_f": 1e-3}),
    "U_dc_chopper_ohm": (2000.0, {**BRAKED, "U_dc_capacitance_f": 1e-3, "U_dc_chopper_v": 541.0}),
    "sensor_gain_a": (1.05, {}),
    "sensor_gain_b": (1.05, {}),
    "sensor_gain_c": (1.05, {}),
    "sensor_offset_a_apk": (0.1, {}),
    "sensor_offset_b_apk": (0.1, {}),
    "sensor_offset_c_apk": (0.1, {}),
    "sensor_drift_apk_per_s": (0.1, {}),
    "sensor_cubic": (0.01, {"adc_full_scale_apk": 40.0}),
    "sensor_lag_s": (1e-5, {}),
    "sensor_noise_apk": (0.01, {}),
    "adc_bits": (10, {}),
    "adc_full_scale_apk": (40.0, {"adc_bits": 10}),
    "sampling_shift_s": (5e-6, {"inverter_model": "switched"}),
    "U_dc_gain": (1.05, {}),
    "encoder_bits": (10, {}),
    "encoder_offset_rad": (0.3, {}),
    "encoder_reversed": (True, {}),
    "leads_swapped": (True, {}),
    "encoder_once_rad": (0.01, {}),
    "encoder_twice_rad": (0.01, {}),
    "encoder_lines": (500, {"encoder_line_rad": 1e-3}),
    "encoder_line_rad": (1e-3, {"encoder_lines": 500}),
    "encoder_line_twice_rad": (1e-3, {"encoder_lines": 500}),
    "encoder_noise_rad": (0.001, {}),
    "encoder_latency_s": (2e-5, {}),
    "shunt_blind_s": (4e-5, {}),
    "T_winding_c": (120.0, {}),
    "T_magnet_c": (100.0, {}),
    "alpha_psi_per_k": (-0.002, {"T_magnet_c": 100.0}),
    "T_ambient_c": (60.0, {**HEATED, "thermal_resistance_k_per_w": 0.01}),
    "thermal_on": (True, {"thermal_capacity_j_per_k": 10.0}),
    "thermal_capacity_j_per_k": (20.0, HEATED),
    "thermal_resistance_k_per_w": (0.001, HEATED),
    "T_sensor_lag_s": (10.0, HEATED),
    "J_kgm2": (0.1, {}),
    "B_nms": (0.1, {}),
    "tau_c_nm": (2.0, {}),
    "stribeck_share": (0.5, {"tau_c_nm": 2.0, "stribeck_rpm": 30.0}),
    "stribeck_rpm": (60.0, {"tau_c_nm": 2.0, "stribeck_share": 0.5}),
    "friction_once": (0.5, {"tau_c_nm": 2.0}),
    "drag_nms2": (0.01, {}),
    "load_nm": (1.0, {}),
    "load_viscous_nms": (0.1, {}),
    "J_load_kgm2": (0.02, ELASTIC),
    "coupling_stiffness_nm_per_rad": (900.0, ELASTIC),
    "coupling_damping_nms_per_rad": (0.5, ELASTIC),
    "backlash_rad": (0.01, ELASTIC),
    "rotor": ("locked", {}),
    "driven_rpm": (400.0, {"rotor": "driven"}),
    "theta_M_start_rad": (0.4, {}),
    "cogging_nm": (0.5, {"cogging_periods": 36}),
    "cogging_periods": (18, {"cogging_nm": 0.5, "cogging_periods": 36}),
    "cogging_slot_nm": (0.5, {"cogging_slot_periods": 36}),
    "cogging_slot_periods": (18, {"cogging_slot_nm": 0.5, "cogging_slot_periods": 36}),
    "cogging_pole_nm": (0.5, {"cogging_pole_periods": 6}),
    "cogging_pole_periods": (12, {"cogging_pole_nm": 0.5, "cogging_pole_periods": 6}),
    "R_s_ohm": (4.0, {}),
    "L_d_h": (0.04, {}),
    "L_q_h": (0.06, {}),
    "psi_f_wb": (0.6, {}),
    "pole_pairs": (4, {}),
    "resistance_imbalance": (0.03, {}),
    "inductance_imbalance": (0.03, {}),
    "inductance_6": (0.03, {}),
    "iron_loss_ohm": (500.0, {}),
    "eddy_share": (0.1, {}),
    "eddy_time_s": (5e-3, {"eddy_share": 0.1}),
    "psi_6_wb": (0.005, {}),
    "psi_7_wb": (0.005, {}),
    "psi_12_wb": (0.005, {}),
    "phase_open": ("b", {}),
    "drive_fault": ("unbalanced", {}),
    "seed": (7, {"sensor_noise_apk": 0.01}),
}
"""Key: another value, and what must be on for it to matter."""

HALL = {"encoder_kind", "hall_order", "hall_offset_rad", *(f"hall_error_{phase}_rad" for phase in "abc")}
LIMITS = {"limit_switch_negative_rad", "limit_switch_positive_rad"}
ELSEWHERE = {"serial", *HALL, *LIMITS}
"""Keys that no trace of `simulate` shows: serial number and limit switches are objects of the node (tests/node), and so
are the Hall wires (tests/cli/test_identify_hall). The kind of encoder is tried in tests/firmware/test_hall."""

SCENARIO = Scenario(
    "switches",
    0.05,
    "current",
    {"i_q_a": ((0.0, 0.0), (0.005, 0.0), (0.005, 4.0)), "i_d_a": ((0.0, 0.0), (0.02, 0.0), (0.02, -2.0))},
)


@pytest.fixture(scope="module")
def drive() -> SimulatedDrive:
    return find_drive("interior-2k2")


def run(drive: SimulatedDrive, changes: Mapping[str, Value]) -> Trace:
    return run_scenario(drive, SCENARIO, simulation={**IDEAL, **changes})


def test_every_key_is_here() -> None:
    assert set(SWITCHES) | ELSEWHERE == {key.name for key in SIMULATION_KEYS}
    assert set(IDEAL) <= set(SWITCHES)


@pytest.mark.parametrize("key", SWITCHES)
def test_the_key_moves_something(key: str, drive: SimulatedDrive) -> None:
    value, needed = SWITCHES[key]
    assert needed.get(key, IDEAL.get(key)) != value
    without, with_it = run(drive, needed), run(drive, {**needed, key: value})
    moved = [name for name in without.signals if not np.array_equal(without[name], with_it[name])]
    assert moved
    assert all(np.all(np.isfinite(with_it[name])) for name in with_it.signals)


def test_ideal_is_ideal(drive: SimulatedDrive) -> None:
    """What the drive sees is the truth, to the float32 of the core, and the limited voltage is the machine's."""
    trace = run(drive, {"rotor": "driven", "driven_rpm": 300.0})
    for axis in "dq":
        seen, true = trace[f"i_{axis}_a"], trace[f"i_{axis}_true_a"]
        assert np.abs(seen - true)[600 // 2 :].max() < 1e-3 * np.abs(true).max()
    assert set(trace["U_dc_v"]) == {540.0}
    assert set(trace["T_winding_true_c"]) == {20.0}
    assert not trace["trip"].any()
