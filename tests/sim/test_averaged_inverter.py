# SPDX-License-Identifier: MIT
"""The averaged inverter: shapes of the voltage error, open phases, delays, and the magnetics behind the terminals."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pmsmtool.firmware.image import pack_image
from pmsmtool.sim.kernel import Application, Rotor, Setup, Simulation, Target, Truth
from tests.sim.bench import (
    L_D,
    L_Q,
    POLE_PAIRS,
    PSI,
    R_S,
    T_S,
    TURN,
    U_DC,
    VOLTAGE,
    open_simulation,
    plant_run,
    record,
    turning,
    values,
)
from tests.sim.reference import SCENARIOS, setup_of

NONE, SIGN, ATAN, TANH, CAPACITIVE = range(5)
SHAPES = {
    NONE: lambda x: 0.0 * x,
    SIGN: np.sign,
    ATAN: lambda x: 2.0 / np.pi * np.arctan(x),
    TANH: np.tanh,
    CAPACITIVE: lambda x: np.where(np.abs(x) < 1.0, 0.5 * x, np.sign(x) * (1.0 - 0.5 / np.maximum(np.abs(x), 1e-9))),
}
DEAD, KNEE = 2e-6, 0.4


def lossy(shape: int, *, drop: float = 0.0, slope: float = 0.0, dead: tuple[float, float, float] = (DEAD,) * 3):
    def change(setup: Setup) -> None:
        setup.inverter.shape = shape
        setup.inverter.dead_time[:] = dead
        setup.inverter.i_knee = KNEE
        setup.inverter.V_switch, setup.inverter.r_switch = drop, slope

    return change


def steady_voltage(simulation: Simulation, i_d: float, i_q: float) -> complex:
    simulation.reference.i_d_ref, simulation.reference.i_q_ref = i_d, i_q
    simulation.run(4000)
    u_alpha, u_beta = np.mean(record(simulation, [Truth.U_ALPHA, Truth.U_BETA], 50), axis=1)
    return complex(u_alpha, u_beta)


@pytest.mark.parametrize(
    ("shape", "i"),  # the sign shape is resolved as tanh within what one substep can move, 0.5 A here
    [(shape, i) for shape in SHAPES for i in (0.3, 6.0) if shape != SIGN or i > 1.0],
)
def test_shape_along_d_and_q(shape, i):
    """0 deg: (2/3)(f(i) + f(i/2)) V; 90 deg: (2/sqrt 3) f(0.866 i) V (docs/identification.md, 2)."""
    V = U_DC * DEAD / T_S
    f = SHAPES[shape]
    along_d = steady_voltage(open_simulation(lossy(shape)), i, 0.0)
    along_q = steady_voltage(open_simulation(lossy(shape)), 0.0, i)
    expected_d = R_S * i + 2.0 / 3.0 * (f(np.array(i / KNEE)) + f(np.array(0.5 * i / KNEE))) * V
    expected_q = R_S * i + 2.0 / math.sqrt(3.0) * f(np.array(0.5 * math.sqrt(3.0) * i / KNEE)) * V
    limit = 2e-3 if shape == SIGN else 2e-5
    assert along_d.real == pytest.approx(float(expected_d), rel=limit, abs=2e-5)
    assert along_q.imag == pytest.approx(float(expected_q), rel=limit, abs=2e-5)


def test_device_drop_and_slope():
    u = steady_voltage(open_simulation(lossy(NONE, drop=0.9, slope=0.1)), 8.0, 0.0)
    assert u.real == pytest.approx((R_S + 0.1) * 8.0 + 4.0 / 3.0 * 0.9, rel=1e-5)


def test_unequal_legs_and_a_bad_joint():
    mismatch = steady_voltage(open_simulation(lossy(TANH, dead=(3e-6, 1e-6, 2e-6))), 20.0, 0.0)
    even = steady_voltage(open_simulation(lossy(TANH)), 20.0, 0.0)
    step = U_DC * 1e-6 / T_S
    assert mismatch - even == pytest.approx(step / 3.0 + 1j * step / math.sqrt(3.0), rel=1e-3)

    def joint(setup: Setup) -> None:
        setup.inverter.r_leg[0] = 0.3

    u = steady_voltage(open_simulation(joint), 10.0, 0.0)
    assert u.real == pytest.approx((R_S + 2.0 / 3.0 * 0.3) * 10.0, rel=1e-5)


def uneven(setup: Setup) -> None:
    setup.machine.L_6, setup.machine.L_imbalance = 0.05, 0.04


def test_uneven_inductances_at_a_standing_rotor():
    """The slope of a short pulse along alpha, at an angle: the inverse of (1 - L_6 cos 6 theta) and of phase a's."""
    theta, u, h = 0.2, 10.0, 1e-7

    def change(setup: Setup) -> None:
        uneven(setup)
        setup.machine.R_copper, setup.theta_M = 1e-9, theta / POLE_PAIRS

    i = plant_run(open_simulation(change), [u] * 10, h)[-1] * np.exp(1j * theta)
    mean, half = (0.5 * (1.0 / L_D + sign / L_Q) for sign in (1.0, -1.0))
    rotor = (1.0 - 0.05 * math.cos(6.0 * theta)) * (mean + half * np.exp(2j * theta))
    assert i == pytest.approx((rotor - 0.02 * mean) * u * 10 * h, rel=1e-9)


def test_uneven_inductances_conserve_energy():
    """A short-circuited machine without resistance: what the field holds, the shaft has lost."""
    J = 2e-3

    def change(setup: Setup) -> None:
        uneven(setup)
        machine = setup.machine
        machine.R_copper, machine.rotor, machine.J = 1e-9, Rotor.FREE, J
        machine.psi_6 = 0.02 * PSI
        setup.omega_M = 40.0

    simulation = open_simulation(change, mode=VOLTAGE)
    signals = [Truth.I_D, Truth.I_Q, Truth.PSI_D, Truth.PSI_Q, Truth.THETA_E, Truth.OMEGA_M]
    i_d, i_q, psi_d, psi_q, theta, omega = record(simulation, signals, 3000)
    harmonic = 0.02 * PSI * np.exp(-6j * theta)
    field = 0.75 * ((psi_d - PSI - harmonic.real) * i_d + (psi_q - harmonic.imag) * i_q)
    energy = 0.5 * J * omega**2 + field
    assert np.ptp(field) > 0.2 * energy[0]
    assert np.ptp(energy) < 1e-6 * energy[0]


def test_a_loaded_link_falls_by_what_its_supply_drops():
    """U (U_0 - U)/R_source is the power of the machine, here of its resistance."""
    R_source, i = 0.5, 20.0

    def change(setup: Setup) -> None:
        setup.U_dc_source, setup.U_dc_source_time = R_source, 1e-3

    simulation = open_simulation(change)
    steady_voltage(simulation, i, 0.0)
    U = float(record(simulation, [Truth.U_DC], 50)[0].mean())
    assert U * (U_DC - U) / R_source == pytest.approx(1.5 * R_S * i**2, rel=1e-3)


def test_steep_error_stays_stable():
    """13 V of dead time behind a knee of 5 mA: the slope alone would be 100 times what one RK4 step can take."""
    change = lossy(TANH)

    def steep(setup: Setup) -> None:
        change(setup)
        setup.inverter.i_knee = 5e-3

    simulation = open_simulation(steep)
    simulation.schedule(Target.I_D, [0.0, 0.1, 0.1], [-0.5, -0.5, 0.5])
    i_d = record(simulation, [Truth.I_D], 4000)[0]
    assert np.abs(i_d).max() < 1.5
    assert i_d[999] == pytest.approx(-0.5, abs=1e-3)
    assert np.ptp(i_d[-100:]) < 1e-5
    assert i_d[-1] == pytest.approx(0.5, abs=1e-4)


# ---- open phase ------------------------------------------------------------------------------------------------


def opened(phase: int, *changes):
    def change(setup: Setup) -> None:
        for one in changes:
            one(setup)
        setup.inverter.open[phase] = 1

    return change


@pytest.mark.parametrize("model", [0, 1])
@pytest.mark.parametrize("phase", [0, 1, 2])
def test_open_phase_carries_nothing_and_stays_stable(model, phase):
    """One second of current control that cannot succeed, at speed, with dead time: bounded, one phase dead."""

    def change(setup: Setup) -> None:
        opened(phase, turning(80.0), lossy(TANH, drop=0.8))(setup)
        setup.inverter.model = model
        setup.inverter.V_diode = 0.8

    simulation = open_simulation(change)
    simulation.reference.i_q_ref = 5.0
    currents = record(simulation, [Truth.I_A, Truth.I_B, Truth.I_C], 10_000)
    others = [x for x in range(3) if x != phase]
    assert np.abs(currents[phase]).max() < 1e-9
    assert np.abs(currents[others[0]] + currents[others[1]]).max() < 1e-9
    assert 1.0 < np.abs(currents).max() < 100.0
    assert simulation.counts()["event_overruns"] == 0


def test_open_phase_on_a_saturated_machine():
    setup, keep = setup_of(SCENARIOS[3])
    setup.inverter.open[1] = 1
    simulation = Simulation(setup, pack_image(SCENARIOS[3].values()), keep)
    simulation.reference.mode, simulation.reference.i_q_ref = 2, 3.0
    currents = record(simulation, [Truth.I_A, Truth.I_B, Truth.I_C], 12_000)
    assert np.abs(currents[1]).max() < 1e-6
    assert 0.5 < np.abs(currents).max() < 40.0


def test_open_phase_is_an_r_l_circuit_of_two_phases():
    """Locked at 0 with phase a open: b and c in series see 2 R and 2 L_q, driven by u_b - u_c."""
    simulation = open_simulation(opened(0), mode=VOLTAGE)
    simulation.reference.u_q_inject = 6.0
    t, i_b = record(simulation, [Truth.T, Truth.I_B], 600)
    expected = 6.0 * math.sqrt(3.0) / (2.0 * R_S) * (1.0 - np.exp(-R_S / L_Q * np.maximum(t - T_S, 0.0)))
    assert np.abs(i_b - expected).max() < 1e-6 * expected.max()


def test_nothing_connected_is_all_back_emf():
    def change(setup: Setup) -> None:
        turning(100.0)(setup)
        setup.inverter.open[:] = [1, 1, 1]

    simulation = open_simulation(change)
    simulation.reference.i_q_ref = 5.0
    assert not record(simulation, [Truth.I_A, Truth.I_B, Truth.I_C, Truth.TORQUE], 500).any()


def test_phase_can_open_while_current_flows():
    simulation = open_simulation(turning(80.0))
    simulation.reference.i_q_ref = 8.0
    simulation.run(1000)
    simulation.library.pmsm_sim_set_open(simulation.sim, 1, 0, 0)
    i_a, i_b = record(simulation, [Truth.I_A, Truth.I_B], 2000)
    assert np.abs(i_a).max() < 1e-9
    assert np.abs(i_b).max() < 100.0
    simulation.library.pmsm_sim_set_open(simulation.sim, 0, 0, 0)
    simulation.run(3000)
    assert simulation.signal(Truth.I_Q) == pytest.approx(8.0, rel=1e-3)


# ---- timing -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("whole", "first"), [(0, 1), (1, 2), (2, 3)])
def test_computation_delay(whole, first):
    """The voltage of row 0 shows in the current of row 1 + delay, and not before."""

    def change(setup: Setup) -> None:
        setup.delay = whole

    simulation = open_simulation(change, mode=VOLTAGE)
    simulation.reference.u_d_inject = 30.0
    i_d = record(simulation, [Truth.I_D], 6)[0]
    assert not i_d[:first].any()
    rise = 30.0 / R_S * (1.0 - math.exp(-R_S / L_D * T_S))
    assert i_d[first] == pytest.approx(rise, rel=1e-6)


@pytest.mark.parametrize("model", [0, 1])
@pytest.mark.parametrize("shift", [0.1, -0.1])
def test_sampling_shift_moves_the_sample_along_the_current(shift, model):
    def change(setup: Setup) -> None:
        setup.sampling_shift = shift * T_S
        setup.inverter.model = model

    simulation = open_simulation(change, mode=VOLTAGE)
    simulation.schedule(Target.U_D, [0.0, 0.02, 0.02], [20.0, 20.0, 0.0])
    sampled, exact = record(simulation, [1, Truth.I_D], 400)
    decay = exact[250] * math.exp(-R_S / L_D * shift * T_S)
    # the truth is recorded where the drive runs: at t_k for an early sample, at the sample for a late one
    assert sampled[250] == pytest.approx(exact[250] if shift > 0 else decay, rel=3e-7 if model == 0 else 3e-3)


def test_shift_changes_nothing_for_a_current_at_rest():
    def change(setup: Setup) -> None:
        setup.sampling_shift = 0.1 * T_S

    shifted, plain = open_simulation(change), open_simulation()
    for simulation in (shifted, plain):
        simulation.reference.i_d_ref = 5.0
        simulation.run(3000)
    assert shifted.signal(Truth.I_D) == pytest.approx(plain.signal(Truth.I_D), rel=1e-5)


# ---- magnetics and temperatures ----------------------------------------------------------------------------------


def test_resistance_and_flux_follow_the_temperatures():
    def change(setup: Setup) -> None:
        turning(100.0)(setup)
        setup.machine.R_copper, setup.machine.R_fixed = 0.4, 0.1
        setup.T_winding, setup.T_magnet = 90.0, 70.0

    simulation = open_simulation(change)
    assert simulation.signal(Truth.R) == pytest.approx(0.4 * (1.0 + 0.00393 * 70.0) + 0.1, rel=1e-12)
    assert simulation.signal(Truth.PSI_D) == pytest.approx(PSI * (1.0 - 0.0012 * 50.0), rel=1e-12)
    simulation.library.pmsm_sim_set_temperatures(simulation.sim, 20.0, 20.0)
    assert simulation.signal(Truth.R) == pytest.approx(0.5, rel=1e-12)


def test_copper_loss_heats_the_winding():
    R_th, C_th = 2.0, 5.0

    def change(setup: Setup) -> None:
        setup.machine.alpha_R = 0.0
        setup.machine.thermal_resistance, setup.machine.thermal_capacity = R_th, C_th
        setup.machine.T_ambient = 30.0
        setup.T_winding = 30.0
        setup.sensors.T_lag = 0.5

    simulation = open_simulation(change)
    simulation.reference.i_d_ref = 10.0
    simulation.run(500)
    start = simulation.signal(Truth.T_WINDING)
    t, T, shown = record(simulation, [Truth.T, Truth.T_WINDING, 22], 100_000, 100)  # Signal.T_WINDING
    loss = 1.5 * R_S * 100.0
    final = 30.0 + R_th * loss
    expected = final + (start - final) * np.exp(-(t - t[0]) / (R_th * C_th))
    assert np.abs(T - expected).max() < 2e-3
    slope = loss / C_th
    assert T[50] - shown[50] == pytest.approx(slope * 0.5 * (1.0 - math.exp(-t[50] / 0.5)), rel=0.1)


def test_iron_loss_takes_a_current_and_brakes():
    R_iron, omega = 300.0, 200.0

    def change(setup: Setup) -> None:
        turning(omega)(setup)
        setup.machine.R_iron = R_iron

    simulation = open_simulation(change)
    simulation.reference.i_d_ref = simulation.reference.i_q_ref = 0.0
    simulation.run(2000)
    i_d, i_q, torque = np.mean(record(simulation, [Truth.I_D, Truth.I_Q, Truth.TORQUE], 200), axis=1)
    # the drive holds the terminal current at zero: the iron current comes out of the magnetising one
    emf = POLE_PAIRS * omega * PSI
    assert i_q == pytest.approx(-emf / R_iron, rel=0.02)
    assert torque * omega == pytest.approx(-1.5 * emf**2 / R_iron, rel=0.02)
    assert abs(i_d) < 0.05
    # a sample that holds none of it: the drive holds the magnetising current at zero, and that makes no torque
    hidden = open_simulation(lambda setup: (change(setup), setattr(setup, "iron_hidden", 1.0))[0])
    hidden.run(2000)
    i_d, i_q, torque = np.mean(record(hidden, [Truth.I_D, Truth.I_Q, Truth.TORQUE], 200), axis=1)
    assert abs(torque) < 0.05 and math.hypot(i_d, i_q) < 0.05


def test_eddy_branch_lowers_the_inductance_that_fast_changes_see():
    share, tau = 0.2, 2e-3

    def change(setup: Setup) -> None:
        setup.machine.R_copper = 1e-9
        setup.machine.eddy_d = share / ((1.0 - share) * L_D)
        setup.machine.eddy_q = share / ((1.0 - share) * L_Q)
        setup.machine.eddy_rate = 1.0 / tau

    h = 1e-6
    fast = plant_run(open_simulation(change), np.full(20, 10.0 + 0j), h)
    slow = plant_run(open_simulation(change), np.full(40_000, 10.0 + 0j), h)
    assert 10.0 * h / (fast[19] - fast[18]).real == pytest.approx((1.0 - share) * L_D, rel=0.02)
    assert 10.0 * h / (slow[-1] - slow[-2]).real == pytest.approx(L_D, rel=1e-4)
    i = 10.0 * (h * 40_000) / L_D + share / ((1.0 - share) * L_D) * 10.0 * tau
    assert slow[-1].real == pytest.approx(i, rel=1e-6)


def test_eddy_currents_stay_when_temperatures_are_set():
    def change(setup: Setup) -> None:
        setup.machine.eddy_d, setup.machine.eddy_q, setup.machine.eddy_rate = 0.25 / L_D, 0.25 / L_Q, 500.0

    simulation = open_simulation(change)
    before = plant_run(simulation, np.full(20, 10.0 + 0j), 1e-5)[-1].real
    simulation.library.pmsm_sim_set_temperatures(simulation.sim, 20.0, 20.0)
    assert simulation.signal(Truth.I_D) == pytest.approx(before, rel=1e-12)


@pytest.mark.parametrize("T_magnet_c", [20.0, 70.0])
def test_flux_harmonics_are_in_the_back_emf_and_conserve_power(T_magnet_c: float):
    """They are the magnets', so they weaken with the fundamental."""
    psi_6, omega = 2e-3, 100.0

    def change(setup: Setup) -> None:
        turning(omega)(setup)
        setup.T_magnet = T_magnet_c
        setup.machine.psi_6, setup.machine.psi_12 = psi_6, 0.5 * psi_6
        setup.machine.R_copper = 1e-9
        setup.machine.L_d = setup.machine.L_q = 1.0  # next to no current: the voltage integral is the magnet's flux

    h, n = 1e-5, 2000
    simulation = open_simulation(change)
    psi_d = np.empty(n)
    for k in range(n):
        plant_run(simulation, [0j], h)
        psi_d[k] = simulation.signal(Truth.PSI_D)
    theta = POLE_PAIRS * omega * h * np.arange(1, n + 1)
    i_d = np.array(simulation.signal(Truth.I_D))
    assert np.isfinite(i_d)
    # flux in the stator frame stays, so i = (psi_stator - psi_magnet)/L: the start value minus the harmonics
    strength = 1.0 - 0.0012 * (T_magnet_c - 20.0)
    magnet = strength * (PSI + psi_6 * np.exp(-6j * theta) + 0.5 * psi_6 * np.exp(-12j * theta))
    start = strength * (PSI + 1.5 * psi_6)
    found = simulation.signal(Truth.I_D) + 1j * simulation.signal(Truth.I_Q)
    expected = start * np.exp(-1j * theta[-1]) - magnet[-1]
    assert found == pytest.approx(expected, rel=1e-6)
    assert psi_d[-1] == pytest.approx((start * np.exp(-1j * theta[-1])).real, rel=1e-6)


def test_cogging_free_torque_of_the_harmonics_averages_to_the_back_emf_constant():
    """With sinusoidal current the mean torque is 1.5 p psi i_q, its ripple 6 and 12 times per period."""
    psi_6, omega = 3e-3, 40.0

    def change(setup: Setup) -> None:
        turning(omega)(setup)
        setup.machine.psi_6 = psi_6
        setup.machine.L_d = setup.machine.L_q = 20e-3

    params = values(
        motor__L_d_h=20e-3,
        motor__L_q_h=20e-3,
        motor__L_d_app_h=20e-3,
        motor__L_q_app_h=20e-3,
        current__K_p_d_v_per_a=24.0,
        current__K_p_q_v_per_a=24.0,
    )
    simulation = open_simulation(change, params=params)
    simulation.reference.i_q_ref = 10.0
    simulation.run(3000)
    periods = round(1.0 / (POLE_PAIRS * omega / TURN) / T_S)  # one electrical turn
    torque = record(simulation, [Truth.TORQUE], 5 * periods)[0]
    mean = 1.5 * POLE_PAIRS * PSI * 10.0
    assert np.mean(torque) == pytest.approx(mean, rel=1e-3)
    ripple = 1.5 * POLE_PAIRS * 5.0 * psi_6 * 10.0  # psi_6 (1 - 6) in q times i_q
    assert 0.5 * np.ptp(torque) == pytest.approx(ripple, rel=0.1)


def test_saturated_free_rotor_uses_the_map():
    setup, keep = setup_of(SCENARIOS[3], Application.CORE)
    setup.machine.rotor, setup.omega_M, setup.machine.J = Rotor.FREE, 0.0, 0.02
    simulation = Simulation(setup, pack_image(SCENARIOS[3].values()), keep)
    simulation.reference.mode, simulation.reference.i_q_ref, simulation.reference.i_d_ref = 2, 6.0, -3.0
    t, omega, torque = record(simulation, [Truth.T, Truth.OMEGA_M, Truth.TORQUE], 2400)
    integral = np.concatenate(([0.0], np.cumsum(0.5 * (torque[1:] + torque[:-1]) * np.diff(t)))) / 0.02
    assert np.abs(omega - integral).max() < 2e-3 * omega.max()


@pytest.mark.parametrize("model", [0, 1])
def test_the_dead_time_acts_on_the_iron_current_too(model: int):
    """The bridge carries it, so with i_d alone at the terminals the lost voltage is the one without iron loss.

    Measured: 1.6 % apart in both models; without the iron current in the legs 12 %.
    """
    omega = 2.0 * math.pi / (400.0 * T_S * POLE_PAIRS)

    def voltage(dead: float, R_iron: float) -> complex:
        def change(setup: Setup) -> None:
            lossy(SIGN, dead=(dead,) * 3)(setup)
            turning(omega)(setup)
            setup.inverter.model = model
            setup.machine.R_iron = R_iron

        simulation = open_simulation(change)
        simulation.reference.i_d_ref = 6.0
        simulation.run(4000)
        u_alpha, u_beta, theta = record(simulation, [Truth.U_ALPHA, Truth.U_BETA, Truth.THETA_E], 800)
        return complex(np.mean((u_alpha + 1j * u_beta) * np.exp(-1j * theta)))

    with_iron, without = (voltage(DEAD, R_iron) - voltage(0.0, R_iron) for R_iron in (25.0, 0.0))
    assert with_iron == pytest.approx(without, rel=0.02)
