# SPDX-License-Identifier: MIT
"""Many different drives, all effects mixed: the numbers stay finite, and every inverter event is resolved."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pmsmtool.firmware.image import pack_image
from pmsmtool.sim.kernel import Part, Setup, Simulation, Target, Truth
from tests.sim.bench import record, values

DRIVES = 80
PERIODS = 400


def random_drive(rng: np.random.Generator) -> tuple[Setup, dict[str, float], float]:
    """Return setup, drive parameters and rated current; ranges as in docs/identification.md, 1."""
    U_dc = float(rng.choice([24.0, 48.0, 325.0, 560.0]))
    low = U_dc < 100.0
    I_r = float(np.exp(rng.uniform(np.log(5.0 if low else 3.0), np.log(60.0 if low else 25.0))))
    T_s_ns = int(1e9 / rng.uniform(8e3, 40e3))
    p, omega_b = int(rng.integers(2, 11)), rng.uniform(400.0, 1600.0)
    psi = rng.uniform(0.6, 0.75) * U_dc / math.sqrt(3.0) / omega_b
    R, L_d = rng.uniform(0.02, 0.12) * psi * omega_b / I_r, rng.uniform(0.1, 0.6) * psi / I_r
    L_q = L_d * rng.uniform(1.0, 2.2)
    dead = rng.uniform(1e-7, 8e-7) if low else rng.uniform(5e-7, 3e-6)

    setup = Setup()
    machine, inverter, sensors = setup.machine, setup.inverter, setup.sensors
    machine.pole_pairs, machine.R_copper, machine.L_d, machine.L_q, machine.psi_f = p, R, L_d, L_q, psi
    machine.T_ref, machine.alpha_R, machine.rotor = 20.0, 0.0039, int(rng.integers(0, 3))
    machine.J, machine.B, machine.tau_c = 10.0 ** rng.uniform(-5.0, -1.5), 1e-5, rng.choice([0.0, 0.01 * p * psi * I_r])
    machine.cogging, machine.cogging_periods = rng.choice([0.0, 0.01 * p * psi * I_r]), 24.0
    if rng.random() < 0.3:
        machine.J_load = machine.J * rng.uniform(0.5, 5.0)
        machine.coupling_stiffness = machine.J * (2.0 * math.pi * rng.uniform(50.0, 500.0)) ** 2
    if rng.random() < 0.3:
        machine.R_iron = rng.uniform(50.0, 500.0) * R
    if rng.random() < 0.3:
        machine.eddy_d, machine.eddy_q, machine.eddy_rate = 0.1 / L_d, 0.1 / L_q, 1e3
    if rng.random() < 0.3:
        machine.psi_6, machine.psi_12 = 0.01 * psi, 0.005 * psi
    inverter.model, inverter.shape = int(rng.integers(0, 2)), int(rng.integers(0, 5))
    inverter.dead_time[:], inverter.i_knee = [1.05 * dead, 0.95 * dead, dead], I_r * rng.uniform(0.005, 0.06)
    inverter.V_switch, inverter.r_switch = rng.choice([0.0, rng.uniform(0.3, 1.2)]), 0.05 * R
    inverter.V_diode, inverter.r_diode = rng.uniform(0.3, 1.2), 0.04 * R
    inverter.capacitance = rng.choice([0.0, max(10.0 ** rng.uniform(-10.0, -8.3), dead**2 / (300.0 * L_d))])
    inverter.minimum_pulse = rng.choice([0.0, 1e-6])
    if rng.random() < 0.15:
        inverter.open[int(rng.integers(0, 3))] = 1
    sensors.gain[:], sensors.U_dc_gain, sensors.noise = [1.0] * 3, 1.0, rng.choice([0.0, 0.005 * I_r])
    sensors.adc_bits, sensors.full_scale, sensors.encoder_bits = 12, 3.0 * I_r, 14
    setup.U_dc, setup.T_winding, setup.T_magnet, setup.delay = U_dc, 20.0, 20.0, int(rng.integers(1, 3))
    setup.sensor_lag = rng.choice([0.0, 2e-6, 10e-6])
    setup.sampling_shift = rng.choice([0.0, 0.05, -0.05]) * 1e-9 * T_s_ns
    setup.omega_M = rng.uniform(-1.0, 1.0) * omega_b / p if machine.rotor != 1 else 0.0

    alpha = 0.15e9 / T_s_ns
    params = values() | {
        "motor.pole_pairs": p, "motor.R_s_ohm": R, "motor.L_d_h": L_d, "motor.L_q_h": L_q,
        "motor.L_d_app_h": L_d, "motor.L_q_app_h": L_q, "motor.psi_f_wb": psi,
        "motor.I_max_apk": 2.0 * I_r, "motor.I_nom_apk": I_r, "protection.I_cont_apk": 2.0 * I_r,
        "protection.i_trip_apk": 100.0 * I_r, "protection.n_trip_rpm": 1e6, "protection.U_dc_min_v": 1.0,
        "inverter.T_s_ns": T_s_ns, "inverter.U_dc_nom_v": U_dc, "inverter.delay_periods": 0.5 + setup.delay,
        "current.K_p_d_v_per_a": alpha * L_d, "current.K_p_q_v_per_a": alpha * L_q,
        "current.K_i_d_v_per_as": alpha * R, "current.K_i_q_v_per_as": alpha * R,
    }  # fmt: skip
    return setup, params, I_r


@pytest.mark.parametrize("seed", range(4))
def test_random_drives_stay_finite_with_every_event_resolved(seed):
    rng = np.random.default_rng(seed)
    for _ in range(DRIVES // 4):
        setup, params, I_r = random_drive(rng)
        simulation = Simulation(setup, pack_image(params))
        simulation.reference.mode = 2
        simulation.word(Part.ENABLED).value = 1
        t = 1e-9 * params["inverter.T_s_ns"] * np.array([0.0, 20.0, 60.0, 60.0, 200.0])
        simulation.schedule(Target.I_D, t, I_r * np.array([0.0, -0.3, -0.3, 0.2, 0.0]))
        simulation.schedule(Target.I_Q, t, I_r * np.array([0.0, 0.5, 0.5, -0.5, 0.02]))
        rows = record(simulation, [Truth.I_A, Truth.I_B, Truth.I_C, Truth.TORQUE, Truth.OMEGA_M], PERIODS)
        simulation.reference.mode = 0
        simulation.run(50)
        assert np.all(np.isfinite(rows))
        assert np.abs(rows[:3]).max() < 30.0 * I_r
        assert np.abs(rows[:3].sum(axis=0)).max() < 1e-9 * I_r
        assert simulation.counts() == {"outside_flux_map": 0, "event_overruns": 0}
