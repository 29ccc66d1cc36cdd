# SPDX-License-Identifier: MIT
"""Sensors: gain, offset, lag, noise, grid, encoder, shunts; and the same bytes for the same seed."""

from __future__ import annotations

import hashlib
import math

import numpy as np
import pytest
from scipy.signal import lsim

from pmsmtool.sim.kernel import Application, Setup, Simulation, Target, Truth
from tests.sim.bench import (
    L_D,
    R_S,
    T_S,
    TURN,
    VOLTAGE,
    open_simulation,
    plant_run,
    record,
    turning,
    values,
)

I_D, U_DC_SIGNAL, I_A, I_B, I_C, THETA_M, OMEGA_E, FLAGS = 1, 21, 18, 19, 20, 24, 12, 17
ADC_CLIPPED = 1 << 9


def with_sensors(**sensors: object):
    def change(setup: Setup) -> None:
        for name, value in sensors.items():
            if isinstance(value, tuple):
                getattr(setup.sensors, name)[:] = value
            else:
                setattr(setup.sensors, name, value)

    return change


def sampled_phases(simulation: Simulation, periods: int) -> tuple[np.ndarray, np.ndarray]:
    columns = record(simulation, [I_A, I_B, I_C, Truth.I_A, Truth.I_B, Truth.I_C], periods)
    return columns[:3], columns[3:]


def test_gain_and_offset_per_phase():
    simulation = open_simulation(with_sensors(gain=(1.02, 0.97, 1.0), offset=(0.1, 0.0, -0.2)), mode=VOLTAGE)
    simulation.reference.u_d_inject = 5.0
    seen, true = sampled_phases(simulation, 200)
    expected = np.array([[1.02], [0.97], [1.0]]) * true + np.array([[0.1], [0.0], [-0.2]])
    assert np.abs(seen - expected).max() < 2e-6  # binary32


def test_cubic_error_and_drift():
    cubic, scale, drift = 0.004, 20.0, 0.5
    simulation = open_simulation(with_sensors(cubic=cubic, full_scale=scale, drift=drift), mode=VOLTAGE)
    simulation.reference.u_d_inject = 5.0
    seen, true = sampled_phases(simulation, 400)
    t = T_S * np.arange(400)
    drifted = true + np.array([drift * t, -drift * t, 0.0 * t])
    assert np.abs(seen - drifted - cubic * scale * (drifted / scale) ** 3).max() < 2e-6  # binary32
    assert np.abs(seen - true).max() > 0.01


def test_grid_and_full_scale():
    bits, full_scale = 10, 8.0
    simulation = open_simulation(with_sensors(adc_bits=bits, full_scale=full_scale), mode=VOLTAGE)
    simulation.schedule(Target.U_D, [0.0, 0.05], [0.0, 8.0])
    seen, true = sampled_phases(simulation, 600)
    lsb = full_scale / 2 ** (bits - 1)
    assert np.array_equal(seen / lsb, np.round(seen / lsb))
    inside = np.abs(true) < full_scale - lsb
    assert np.abs(seen - true)[inside].max() <= 0.5 * lsb + 1e-6
    assert seen.max() == full_scale - lsb
    assert true.max() > full_scale


def test_clipping_is_flagged_also_without_a_grid():
    def change(setup: Setup) -> None:
        with_sensors(full_scale=3.0)(setup)
        setup.application = Application.DRIVE

    simulation = open_simulation(change, mode=VOLTAGE)
    simulation.reference.u_d_inject = 4.0
    flags, i_a = record(simulation, [FLAGS, Truth.I_A], 300)
    clipped = (flags.astype(int) & ADC_CLIPPED) != 0
    assert np.array_equal(clipped, i_a >= 3.0)
    assert clipped.any() and not clipped.all()


def test_noise_has_its_size_in_every_phase():
    sigma = 0.05
    simulation = open_simulation(with_sensors(noise=sigma), mode=0)
    seen, true = sampled_phases(simulation, 40_000)
    assert not true.any()
    for phase in seen:
        assert np.std(phase) == pytest.approx(sigma, rel=0.02)
        assert abs(np.mean(phase)) < 5 * sigma / 200.0
    assert np.abs(np.corrcoef(seen)[np.triu_indices(3, 1)]).max() < 0.03


@pytest.mark.chain
@pytest.mark.parametrize("tau", [2e-6, 20e-6])
def test_lag_is_a_first_order_low_pass(tau):
    """Square wave on a locked machine: the sample lags as scipy's filter of the exact current does."""

    def change(setup: Setup) -> None:
        setup.sensor_lag = tau
        setup.machine.psi_f = 0.0

    simulation = open_simulation(change, mode=VOLTAGE)
    simulation.schedule(Target.U_D, [0.0, 0.0031, 0.0031, 0.0062, 0.0062], [20.0, 20.0, -20.0, -20.0, 20.0])
    seen, exact, u = record(simulation, [I_D, Truth.I_D, Truth.U_ALPHA], 90)
    fine = 400
    t = np.arange(90 * fine) * T_S / fine
    applied = np.repeat(np.concatenate(([0.0], u[:-1])), fine)
    _, current, _ = lsim(([1.0], [L_D, R_S]), applied, t, interp=False)
    _, lagged, _ = lsim(([1.0], [tau, 1.0]), current, t)
    assert np.abs(current[::fine] - exact).max() < 5e-7 * np.abs(exact).max()  # duty ratios are binary32
    assert np.abs(lagged[::fine] - seen).max() < 2e-4 * np.abs(exact).max() * (tau / 20e-6) + 2e-6
    assert np.abs(exact - seen).max() > 50 * np.abs(lagged[::fine] - seen).max()


@pytest.mark.parametrize("model", [0, 1])
def test_a_sensor_with_a_lag_shows_the_iron_current_in_its_period(model):
    """A lag of 1 us once showed it a period late: the samples after a step of 0.8 A were off by all of that.

    Measured: 0.017 A (averaged), 0.010 A (switched): the slope of the current over the lag, and 1 % of the step.
    """
    R_iron = 50.0

    def sampled(tau: float) -> np.ndarray:
        def change(setup: Setup) -> None:
            setup.sensor_lag, setup.machine.R_iron, setup.inverter.model = tau, R_iron, model

        simulation = open_simulation(change, mode=VOLTAGE)
        simulation.schedule(Target.U_D, [0.0, 0.0031, 0.0031, 0.0062, 0.0062], [20.0, 20.0, -20.0, -20.0, 20.0])
        return record(simulation, [I_D], 90)[0]

    late, prompt = sampled(1e-6), sampled(0.0)
    assert np.abs(late - prompt).max() < 0.05 * 2.0 * 20.0 / R_iron


def test_dc_link_gain():
    simulation = open_simulation(with_sensors(U_dc_gain=1.03))
    assert record(simulation, [U_DC_SIGNAL], 3)[0] == pytest.approx(309.0, rel=1e-6)


def driving(change, *, offset: float = 0.0, reversed_: float = 0.0) -> Simulation:
    params = values(encoder__offset_rad=offset, encoder__reversed=reversed_)
    return open_simulation(change, params=params)


@pytest.mark.parametrize("direction", [1, -1])
def test_encoder_offset_and_direction_follow_the_convention(direction):
    """theta_e = direction p theta_M - offset: with the same offset and direction the drive's frame is the machine's."""

    def change(setup: Setup) -> None:
        turning(50.0)(setup)
        with_sensors(encoder_offset_e=0.7, encoder_reversed=int(direction < 0))(setup)

    simulation = driving(change, offset=0.7, reversed_=float(direction < 0))
    simulation.reference.i_d_ref, simulation.reference.i_q_ref = -3.0, 5.0
    simulation.run(1000)
    assert simulation.signal(Truth.I_D) == pytest.approx(-3.0, abs=1e-3)
    assert simulation.signal(Truth.I_Q) == pytest.approx(5.0, abs=1e-3)


def test_frame_ahead_is_cured_by_a_larger_offset():
    eps = 0.2

    def change(setup: Setup) -> None:
        with_sensors(encoder_offset_e=0.0)(setup)

    simulation = driving(change, offset=-eps)  # theta_e of the drive is eps ahead of the d axis
    simulation.reference.i_d_ref = 4.0
    simulation.run(3000)
    assert simulation.signal(Truth.I_D) == pytest.approx(4.0 * math.cos(eps), rel=1e-4)
    assert simulation.signal(Truth.I_Q) == pytest.approx(4.0 * math.sin(eps), rel=1e-4)


def test_encoder_grid_errors_and_latency():
    bits, once, twice, latency, omega = 12, 2e-3, 1e-3, 50e-6, 30.0

    def change(setup: Setup) -> None:
        turning(omega)(setup)
        with_sensors(encoder_once=once, encoder_twice=twice, encoder_latency=latency)(setup)
        setup.application = Application.DRIVE

    exact = open_simulation(change)
    exact.run(1)
    seen, true = record(exact, [THETA_M, Truth.THETA_M], 4000)
    expected = true - omega * latency + once * np.sin(true) + twice * np.sin(2.0 * true)
    assert np.abs(seen - expected).max() < 2e-5  # binary32 at 12 rad

    def interpolating(setup: Setup) -> None:
        change(setup)
        with_sensors(encoder_lines=500.0, encoder_line=2e-4, encoder_line_twice=-1e-4)(setup)

    within = open_simulation(interpolating)
    within.run(1)
    error = record(within, [THETA_M], 4000)[0] - seen
    assert np.abs(error - 2e-4 * np.sin(500.0 * true) + 1e-4 * np.sin(1000.0 * true)).max() < 2e-5

    def noisy(setup: Setup) -> None:
        change(setup)
        setup.sensors.encoder_noise = 1e-3

    scattered = open_simulation(noisy)
    scattered.run(1)
    error = record(scattered, [THETA_M], 4000)[0] - seen
    assert abs(error.mean()) < 5e-5 and error.std() == pytest.approx(1e-3, rel=0.03)  # 0.7 % measured

    def coarse(setup: Setup) -> None:
        turning(omega)(setup)
        with_sensors(encoder_bits=bits)(setup)
        setup.application = Application.DRIVE

    grid = open_simulation(coarse)
    grid.run(1)
    seen, true = record(grid, [THETA_M, Truth.THETA_M], 1000)
    step = TURN / 2**bits
    assert np.abs(seen / step - np.round(seen / step)).max() < 1e-2  # binary32
    assert np.abs(seen - true).max() <= 0.5 * step + 1e-6


def test_stuck_encoder_keeps_its_first_reading():
    def change(setup: Setup) -> None:
        turning(40.0)(setup)
        with_sensors(fault=1)(setup)
        setup.theta_M = 0.3
        setup.application = Application.DRIVE

    simulation = open_simulation(change)
    seen = record(simulation, [THETA_M], 500)[0]
    assert np.all(seen == seen[0])
    assert seen[0] == pytest.approx(0.3, rel=1e-6)


def test_blind_shunt_repeats_its_last_reading():
    """Low-side shunts: a leg whose bottom transistor conducts too shortly shows its last readable current."""

    def change(setup: Setup) -> None:
        setup.machine.psi_f = 0.0
        with_sensors(blind=10e-6)(setup)

    simulation = open_simulation(change, mode=VOLTAGE)
    simulation.schedule(Target.U_D, [0.0, 0.02, 0.02], [10.0, 10.0, 165.0])
    i_a, true, duty = record(simulation, [I_A, Truth.I_A, Truth.DUTY_A], 240)
    blind = np.concatenate(([False], (1.0 - duty[:-1]) * T_S < 10e-6))
    assert blind.any() and not blind.all()
    first = int(np.argmax(blind))
    assert np.all(i_a[blind] == i_a[first - 1])
    assert np.abs(i_a - true)[~blind].max() < 1e-5
    assert true[-1] - i_a[-1] > 1.0


# ---- reproducibility ------------------------------------------------------------------------------------------------


def noisy(seed: int, chunk: int | None = None) -> bytes:
    def change(setup: Setup) -> None:
        turning(100.0)(setup)
        with_sensors(noise=0.03, adc_bits=12, full_scale=30.0, encoder_bits=14)(setup)
        setup.inverter.model = 1
        setup.inverter.dead_time[:] = (1e-6, 1.1e-6, 0.9e-6)
        setup.inverter.V_switch, setup.inverter.V_diode, setup.inverter.capacitance = 0.9, 0.7, 500e-12
        setup.sensor_lag, setup.seed = 2e-6, seed
        setup.application = Application.DRIVE

    simulation = open_simulation(change)
    simulation.reference.i_q_ref = 6.0
    rows = simulation.record([I_A, I_B, I_C, Truth.I_D, Truth.I_Q, Truth.TORQUE, OMEGA_E], 2000)
    left = 2000
    while left:
        left -= simulation.run(min(left, chunk or left))
    return rows.tobytes()


def test_same_seed_same_bytes_however_the_run_is_cut():
    assert noisy(7) == noisy(7) == noisy(7, chunk=1) == noisy(7, chunk=333)
    assert noisy(8) != noisy(7)


def test_bytes_of_the_plant_are_those_of_the_first_platform():
    """No libm, no fused multiply-add: this digest holds wherever doubles are IEEE 754.

    It changes when the plant changes its arithmetic; then it is renewed on purpose.
    """
    simulation = open_simulation(turning(100.0))
    u = 40.0 * np.exp(1j * np.arange(500) * 0.03)
    digest = hashlib.sha256(np.asarray(plant_run(simulation, u, T_S), dtype="<c16").tobytes()).hexdigest()
    assert digest == "81234025f794e9bd5d0e35baf06ab0a4756856f9dd6392c3db3ed65b883412a2"


def test_an_angle_just_below_a_whole_turn_is_rounded_as_a_small_number():
    """An encoder of 17 bits that turns backward from zero: each recorded angle is on its grid within 1.1 roundings."""
    step = 2.0 * math.pi / 2**17

    def change(setup: Setup) -> None:
        turning(-30.0)(setup)
        with_sensors(encoder_bits=17)(setup)
        setup.application = Application.DRIVE

    simulation = open_simulation(change)
    simulation.run(1)
    angle = record(simulation, [THETA_M], 4000)[0]
    assert angle.min() < -1.0 and angle.max() > -0.01
    off = np.abs(angle - step * np.round(angle / step)) / np.spacing(np.abs(angle).astype(np.float32))
    assert off.max() < 1.5
