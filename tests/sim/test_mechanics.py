# SPDX-License-Identifier: MIT
"""Rotor, friction, load, coupling: against closed forms and energy."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pmsmtool.sim.kernel import Rotor, Simulation, Target, Truth
from tests.sim.bench import (
    L_D,
    L_Q,
    POLE_PAIRS,
    PSI,
    R_S,
    T_S,
    TURN,
    free,
    open_simulation,
    plant_run,
    record,
    turning,
)


def coasting(setup):
    setup.omega_M = 100.0


def both(*changes):
    def change(setup):
        for one in changes:
            one(setup)

    return change


def idle(simulation: Simulation) -> Simulation:
    """Undo the current paths, so that the shaft is alone."""
    simulation.library.pmsm_sim_set_open(simulation.sim, 1, 1, 1)
    return simulation


def test_viscous_coasting_is_exponential():
    J, B = 2e-3, 4e-3
    simulation = idle(open_simulation(both(free(J=J, B=B), coasting)))
    t, omega = record(simulation, [Truth.T, Truth.OMEGA_M], 5000)
    assert np.abs(omega / (100.0 * np.exp(-B / J * t)) - 1.0).max() < 1e-12  # measured 3e-14


def test_the_iron_brakes_a_rotor_without_current():
    """1.5 p^2 psi^2 omega / R_iron, from the energy balance of the resistor that the back-EMF feeds."""
    J, R_iron = 2e-3, 50.0

    def warm(setup):
        setup.T_magnet = 70.0

    simulation = idle(open_simulation(both(free(J=J, R_iron=R_iron), coasting, warm)))
    t, omega = record(simulation, [Truth.T, Truth.OMEGA_M], 2000)
    psi = PSI * (1.0 - 0.0012 * 50.0)
    drag = 1.5 * POLE_PAIRS**2 * psi**2 / R_iron
    assert np.abs(omega / (100.0 * np.exp(-drag / J * t)) - 1.0).max() < 1e-12  # measured 2e-14


def test_coulomb_friction_stops_the_shaft_and_holds_it():
    J, tau_c = 2e-3, 0.3
    simulation = idle(open_simulation(both(free(J=J, tau_c=tau_c), coasting)))
    t, omega, theta = record(simulation, [Truth.T, Truth.OMEGA_M, Truth.THETA_M], 9000)
    stop = 100.0 * J / tau_c
    expected = np.maximum(100.0 - tau_c / J * t, 0.0)
    assert np.abs(omega - expected).max() < 1e-9
    assert np.all(omega[t > stop + T_S] == 0.0)
    assert theta[-1] == pytest.approx(100.0 * stop / 2.0, rel=1e-9)  # the angle at the instant of standstill


def test_stiction_holds_below_and_slips_above_the_coulomb_torque():
    J, tau_c = 2e-3, 0.3
    simulation = idle(open_simulation(free(J=J, tau_c=tau_c)))
    simulation.schedule(Target.LOAD, [0.0, 0.1, 0.1, 0.3], [0.0, -0.29, -0.31, -0.31])
    t, omega = record(simulation, [Truth.T, Truth.OMEGA_M], 3000)
    assert np.all(omega[t < 0.1] == 0.0)
    slipping = t > 0.1 + 2 * T_S
    assert np.abs(omega[slipping] - 0.01 / J * (t[slipping] - 0.1)).max() < 0.01 / J * 2 * T_S


def test_reversal_through_standstill_loses_no_time():
    """A constant torque against the motion: deceleration with friction, then acceleration against it."""
    J, tau_c, torque = 2e-3, 0.1, 0.5
    simulation = idle(open_simulation(both(free(J=J, tau_c=tau_c), coasting)))
    simulation.library.pmsm_sim_set_load(simulation.sim, torque)
    t, omega = record(simulation, [Truth.T, Truth.OMEGA_M], 8000)
    stop = 100.0 * J / (torque + tau_c)
    expected = np.where(t < stop, 100.0 - (torque + tau_c) / J * t, -(torque - tau_c) / J * (t - stop))
    assert np.abs(omega - expected).max() < 1e-9


def test_friction_takes_its_torque_over_the_angle():
    """J omega^2 / 2 = E_0 - tau_c (theta + f (1 - cos theta)), at speeds where nothing of Stribeck's part is left."""
    J, tau_c, once = 2e-3, 0.05, 0.3
    change = free(J=J, tau_c=tau_c, friction_once=once, stribeck=0.5, stribeck_speed=1.0)
    omega, theta = record(idle(open_simulation(both(change, coasting))), [Truth.OMEGA_M, Truth.THETA_M], 20000)
    expected = 0.5 * J * 100.0**2 - tau_c * (theta + once * (1.0 - np.cos(theta)))
    moving = omega > 10.0
    assert moving.sum() > 1e4
    assert np.abs(0.5 * J * omega**2 - expected)[moving].max() < 1e-8 * expected[0]  # measured 2e-10


def test_stribeck_friction_holds_more_than_it_brakes():
    """At rest 1.5 tau_c holds; a coasting shaft then passes v_s, where 1 + 0.5/e of it brakes."""
    J, tau_c, speed = 2e-3, 0.1, 20.0
    change = free(J=J, tau_c=tau_c, stribeck=0.5, stribeck_speed=speed)
    simulation = idle(open_simulation(change))
    simulation.schedule(Target.LOAD, [0.0, 0.1, 0.1, 0.3], [0.0, -0.149, -0.151, -0.151])
    t, omega = record(simulation, [Truth.T, Truth.OMEGA_M], 1200)
    assert np.all(omega[t < 0.1] == 0.0) and omega[-1] > 0.0
    t, omega = record(idle(open_simulation(both(change, coasting))), [Truth.T, Truth.OMEGA_M], 18000)
    k = int(np.argmax(omega < speed))
    slope = (omega[k + 1] - omega[k - 1]) / (t[k + 1] - t[k - 1])
    assert slope == pytest.approx(-tau_c / J * (1.0 + 0.5 * math.exp(-((omega[k] / speed) ** 2))), rel=1e-6)


def test_a_shaft_with_play_couples_nothing_inside_it():
    """The load falls freely through half of the play, then swings on the shaft around its static twist."""
    J_load, stiffness, play, torque = 5e-3, 400.0, 0.02, 1.0
    change = free(J=2e-3, J_load=J_load, coupling_stiffness=stiffness, tau_c=50.0, backlash=play)
    simulation = idle(open_simulation(change))
    simulation.library.pmsm_sim_set_load(simulation.sim, torque)
    t, twist = record(simulation, [Truth.T, Truth.TWIST], 2000)
    free_time = math.sqrt(play * J_load / torque)
    falling = t < free_time
    assert np.abs(twist - 0.5 * torque / J_load * t**2)[falling].max() < 1e-12
    static = torque / stiffness
    assert twist.max() == pytest.approx(0.5 * play + static + math.sqrt(static**2 + static * play), rel=1e-4)


@pytest.mark.parametrize("name", ["cogging", "cogging_slot", "cogging_pole"])
def test_cogging_conserves_energy(name):
    J, amplitude, periods = 2e-3, 0.05, 12
    simulation = idle(open_simulation(both(free(J=J, **{name: amplitude, f"{name}_periods": periods}), coasting)))
    omega, theta = record(simulation, [Truth.OMEGA_M, Truth.THETA_M], 20000)
    energy = 0.5 * J * omega**2 - amplitude / periods * np.cos(periods * theta)
    assert np.ptp(energy) < 1e-8 * energy[0]
    assert np.ptp(omega) > 1e-2  # it does cog


def test_two_masses_swing_at_their_frequency():
    J, J_load, stiffness = 2e-3, 5e-3, 400.0
    change = free(J=J, J_load=J_load, coupling_stiffness=stiffness)

    def kicked(setup):
        change(setup)
        setup.omega_M = 10.0

    simulation = idle(open_simulation(kicked))
    simulation.library.pmsm_sim_set_load(simulation.sim, 1.0)
    t, omega, load, twist = record(simulation, [Truth.T, Truth.OMEGA_M, Truth.OMEGA_LOAD, Truth.TWIST], 4000)
    w_0 = math.sqrt(stiffness * (1.0 / J + 1.0 / J_load))
    assert np.abs((J * omega + J_load * load) - (10.0 * (J + J_load) - t)).max() < 1e-12  # momentum under 1 N m
    static = J / (J + J_load) / stiffness
    assert np.abs(twist - static * (1.0 - np.cos(w_0 * t))).max() < 1e-6 * static * 2e2  # RK4 over 180 swings


@pytest.mark.parametrize(("load_nm", "held"), [(1.0, True), (1.5, False)])
def test_the_second_mass_swings_while_friction_holds_the_rotor(load_nm, held):
    """Its swing reaches twice the load's torque at the rotor: below the Coulomb torque it holds, above it gives way."""
    J_load, stiffness, tau_c = 5e-3, 400.0, 2.5
    change = free(J=2e-3, J_load=J_load, coupling_stiffness=stiffness, tau_c=tau_c)
    simulation = idle(open_simulation(change))
    simulation.library.pmsm_sim_set_load(simulation.sim, load_nm)
    signals = [Truth.T, Truth.OMEGA_M, Truth.OMEGA_LOAD, Truth.TWIST]
    t, omega, load, twist = record(simulation, signals, 2000)
    expected = load_nm / stiffness * (1.0 - np.cos(math.sqrt(stiffness / J_load) * t))
    if held:
        assert np.all(omega == 0.0)
        assert np.abs(twist - expected).max() < 1e-4 * load_nm / stiffness  # RK4 over 9 swings
        assert np.abs(load).max() == pytest.approx(load_nm / math.sqrt(stiffness * J_load), rel=1e-3)
        return
    moves = int(np.argmax(omega != 0.0))
    assert 0 < moves < len(t) and stiffness * abs(expected[moves]) == pytest.approx(tau_c, rel=0.03)


def test_torque_drives_the_shaft():
    i_q, J = 8.0, 2e-3
    simulation = open_simulation(free(J=J))
    simulation.reference.i_q_ref = i_q
    t, omega, torque = record(simulation, [Truth.T, Truth.OMEGA_M, Truth.TORQUE], 400)
    settled = slice(200, None)
    expected = 1.5 * POLE_PAIRS * PSI * i_q
    assert np.abs(torque[settled] / expected - 1.0).max() < 0.02
    slope = np.polyfit(t[settled], omega[settled], 1)[0]
    assert slope == pytest.approx(np.mean(torque[settled]) / J, rel=1e-4)


@pytest.mark.chain
def test_energy_is_conserved_from_the_terminals_to_the_shaft():
    """Electrical work = copper heat + field + kinetic energy, for a free rotor and turning voltages."""
    h, n, J = 2e-6, 40_000, 5e-4
    simulation = open_simulation(free(J=J))
    w = 300.0
    k = np.arange(n)
    u = 40.0 * np.exp(1j * (w * k * h + 0.7))
    work = heat = 0.0
    chunk_signals = (Truth.I_A, Truth.I_B, Truth.I_C)
    phases = np.exp(1j * TURN / 3.0 * np.array([0, 1, 2]))

    def space_current() -> complex:
        return complex(2.0 / 3.0 * np.dot(phases, [simulation.signal(s) for s in chunk_signals]))

    before = space_current()
    for step in range(n):
        plant_run(simulation, [u[step]], h)
        after = space_current()
        mean = 0.5 * (before + after)
        work += 1.5 * h * (u[step] * mean.conjugate()).real
        heat += 1.5 * h * R_S * (abs(before) ** 2 + abs(before + after) ** 2 + abs(after) ** 2) / 6.0
        before = after
    i_d, i_q, omega = (simulation.signal(s) for s in (Truth.I_D, Truth.I_Q, Truth.OMEGA_M))
    field = 0.75 * (L_D * i_d**2 + L_Q * i_q**2)
    kinetic = 0.5 * J * omega**2
    assert kinetic > 0.1 * work  # it did turn
    assert field + kinetic + heat == pytest.approx(work, rel=2e-6)


def test_steady_state_power_balance():
    """At constant speed and current: 1.5 u i = 1.5 R i^2 + torque omega_M, in the mean over many periods."""
    simulation = open_simulation(turning(200.0))
    simulation.reference.i_d_ref, simulation.reference.i_q_ref = -6.0, 9.0
    simulation.run(2000)
    signals = [
        Truth.U_ALPHA_MEAN, Truth.U_BETA_MEAN, Truth.I_A, Truth.I_B, Truth.I_C, Truth.I_D, Truth.I_Q, Truth.TORQUE,
    ]  # fmt: skip
    u_a, u_b, i_a, i_b, i_c, i_d, i_q, torque = record(simulation, signals, 4000)
    i = 2.0 / 3.0 * (i_a + i_b * np.exp(1j * TURN / 3) + i_c * np.exp(-1j * TURN / 3))
    mean_i = 0.5 * (i[:-1] + i[1:])
    power_in = 1.5 * np.mean((u_a[1:] + 1j * u_b[1:]) * mean_i.conj()).real
    power_out = 1.5 * R_S * np.mean(i_d**2 + i_q**2) + np.mean(torque) * 200.0
    assert power_in == pytest.approx(power_out, rel=2e-3)  # (w T_s)^2 of the current's course inside a period
    assert np.mean(torque) == pytest.approx(1.5 * POLE_PAIRS * (PSI * 9.0 + (L_D - L_Q) * -6.0 * 9.0), rel=1e-6)


def test_locked_rotor_keeps_its_angle_and_driven_rotor_follows_its_profile():
    locked = open_simulation()
    locked.reference.i_q_ref = 10.0
    omega, theta = record(locked, [Truth.OMEGA_M, Truth.THETA_M], 300)
    assert not omega.any() and not theta.any()
    driven = open_simulation(turning(0.0))
    driven.schedule(Target.DRIVEN_SPEED, [0.0, 0.1, 0.1], [0.0, 100.0, -50.0])
    t, omega, theta = record(driven, [Truth.T, Truth.OMEGA_M, Truth.THETA_M], 2000)
    rising = t < 0.1 - 1e-9
    assert np.abs(omega[rising] - 1000.0 * t[rising]).max() < 1e-2
    assert np.all(np.abs(omega[t > 0.1 + 1e-9] + 50.0) < 1e-9)
    assert theta[-1] == pytest.approx(5.0 - 50.0 * (t[-1] - 0.1), abs=1e-4)


def test_rotor_kinds_can_change_between_calls():
    simulation = open_simulation(free())
    simulation.run(10)
    simulation.library.pmsm_sim_set_rotor(simulation.sim, Rotor.DRIVEN, 40.0)
    simulation.run(1000)
    assert simulation.signal(Truth.OMEGA_M) == 40.0
    simulation.library.pmsm_sim_set_rotor(simulation.sim, Rotor.LOCKED, 0.0)
    before = simulation.signal(Truth.THETA_M)
    simulation.run(100)
    assert simulation.signal(Truth.THETA_M) == before
