# SPDX-License-Identifier: MIT
"""The switch-level inverter: against an independent fine-step simulation, and where theory gives a number."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pmsmtool.sim.kernel import Setup, Target, Truth
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
    record,
    turning,
    values,
)
from tests.sim.brute_force import Circuit

PHASES = (Truth.I_A, Truth.I_B, Truth.I_C)
DUTIES = (Truth.DUTY_A, Truth.DUTY_B, Truth.DUTY_C)


def switched(**inverter: object):
    """Switch-level model with inverter data; a number for dead_time is that of all legs."""

    def change(setup: Setup) -> None:
        setup.inverter.model = 1  # unless the data say otherwise
        for name, value in inverter.items():
            if name in ("dead_time", "open", "r_leg"):
                getattr(setup.inverter, name)[:] = value if isinstance(value, tuple) else (value,) * 3
            else:
                setattr(setup.inverter, name, value)

    return change


def with_changes(*changes):
    def change(setup: Setup) -> None:
        for one in changes:
            one(setup)

    return change


def no_magnet(setup: Setup) -> None:
    setup.machine.psi_f = 0.0


def space_vector(i_a, i_b, i_c):
    return 2.0 / 3.0 * (i_a + i_b * np.exp(1j * TURN / 3.0) + i_c * np.exp(-1j * TURN / 3.0))


@pytest.mark.chain
@pytest.mark.parametrize(
    ("u", "dead", "limit"),
    [
        (20.0 + 0.0j, (1e-6, 1e-6, 1e-6), 1e-3),  # measured 2e-4: firm currents
        (3.0 + 1.0j, (1e-6, 1e-6, 1e-6), 0.02),  # measured 0.008: 0.1 A, every edge meets a charging node
        (6.0 + 0.0j, (1.3e-6, 0.7e-6, 1e-6), 0.02),  # measured 0.007: unequal legs
    ],
)
def test_against_an_independent_fine_step_simulation(u, dead, limit):
    periods, C = 5, 300e-12
    change = switched(dead_time=dead, V_switch=1.2, r_switch=0.03, V_diode=0.9, r_diode=0.02, capacitance=C)
    simulation = open_simulation(with_changes(change, no_magnet), mode=VOLTAGE)
    simulation.reference.u_d_inject, simulation.reference.u_q_inject = u.real, u.imag
    columns = record(simulation, [*DUTIES, *PHASES], periods + 2)
    duties = np.vstack((np.full((1, 3), 0.5), columns[:3].T))[: periods + 1]  # each acts one period later
    found = space_vector(*columns[3:])
    circuit = Circuit(R_S, L_D, L_Q, U_DC, T_S, dead, 1.2, 0.03, 0.9, 0.02, C, dt=2e-9)
    expected = circuit.run(duties)[: len(found)]
    assert simulation.counts()["event_overruns"] == 0
    assert np.abs(found - expected).max() <= limit * np.abs(expected).max()
    ideal = abs(u) * periods * T_S / L_D
    assert abs(expected[-1]) < 0.8 * ideal  # the devices matter here: an ideal inverter would fail this test


def fast(f_s_hz: float) -> dict[str, float]:
    return values(inverter__T_s_ns=round(1e9 / f_s_hz))


@pytest.mark.parametrize(
    ("f_s_hz", "limit"),
    [(10e3, 4e-3), (40e3, 3e-4), (160e3, 2e-5)],  # measured 1.4e-3, 9e-5, 5.6e-6: falls with T_s squared
)
def test_ideal_devices_agree_with_the_averaged_model(f_s_hz, limit):
    """No dead time, no drops: at the ripple's centre both models see the same current, better with finer PWM."""
    found = []
    for change in (turning(250.0), with_changes(turning(250.0), switched())):
        simulation = open_simulation(change, params=fast(f_s_hz))
        simulation.schedule(Target.I_D, [0.0], [-5.0])
        simulation.schedule(Target.I_Q, [0.0, 0.01, 0.01], [0.0, 0.0, 15.0])
        i_d, i_q = record(simulation, [Truth.I_D, Truth.I_Q], round(0.04 * f_s_hz))
        found.append(i_d + 1j * i_q)
    averaged, resolved = found
    assert np.abs(resolved - averaged).max() <= limit * np.abs(averaged).max()


def test_dead_time_costs_its_share_of_the_dc_link_at_firm_current():
    """Leg error U_dc t_dead/T_s sgn(i) + V: along d with 20 A it adds up to 4/3 of one leg's."""
    dead, V = 2e-6, 1.1
    change = switched(dead_time=dead, V_switch=V, V_diode=V)
    simulation = open_simulation(change)
    simulation.reference.i_d_ref = 20.0
    simulation.run(3000)
    u_d = np.mean(record(simulation, [Truth.U_ALPHA], 200))
    error = 4.0 / 3.0 * (U_DC * dead / T_S + V)
    assert u_d - R_S * 20.0 == pytest.approx(error, rel=2e-3)  # measured 6e-4: the node needs C dV of charge, here none


def test_output_capacitance_takes_voltage_back_at_small_currents():
    """i t_dead < C U_dc: the node does not arrive, and the lost voltage falls with the current."""

    def lost(i_d: float, capacitance: float) -> float:
        simulation = open_simulation(switched(dead_time=2e-6, capacitance=capacitance))
        simulation.reference.i_d_ref = i_d
        simulation.run(4000)
        return float(np.mean(record(simulation, [Truth.U_ALPHA], 400))) - R_S * i_d

    full = 4.0 / 3.0 * U_DC * 2e-6 / T_S
    knee = 2e-9 * U_DC / 2e-6  # 0.3 A
    assert lost(20.0, 2e-9) == pytest.approx(
        full * (1.0 - 0.25 * knee * (0.5 / 20.0 + 1.0 / 20.0) * 4.0 / 3.0), rel=0.02
    )
    assert lost(0.2, 2e-9) < 0.6 * lost(0.2, 0.0)


def test_small_voltages_move_nothing_through_dead_time_and_thresholds():
    simulation = open_simulation(switched(dead_time=1e-6, V_switch=1.0, V_diode=1.0), mode=VOLTAGE)
    simulation.reference.u_d_inject = 1.0
    currents = record(simulation, PHASES, 300)
    assert not currents.any()
    assert simulation.counts()["event_overruns"] == 0


def test_channel_conducts_both_ways_without_threshold():
    """V_switch = 0 is a MOSFET: any voltage drives a current, and the loop is R_s + r."""
    simulation = open_simulation(switched(r_switch=0.25), mode=VOLTAGE)
    simulation.reference.u_d_inject = 1.5
    simulation.run(3000)
    i_d = np.mean(record(simulation, [Truth.I_D], 100))
    assert i_d == pytest.approx(1.5 / (R_S + 0.25), rel=1e-5)  # duty ratios are binary32


def test_unequal_dead_times_offset_the_legs():
    """Leg a 1 us more, leg b 1 us less: with firm currents the difference is a voltage between the legs."""
    equal, unequal = (open_simulation(switched(dead_time=dead), mode=VOLTAGE) for dead in (2e-6, (3e-6, 1e-6, 2e-6)))
    found = []
    for simulation in (equal, unequal):
        simulation.reference.u_d_inject = 25.0
        simulation.run(4000)
        found.append(space_vector(*np.mean(record(simulation, PHASES, 50), axis=1)))
    step = U_DC * 1e-6 / T_S
    # i_a > 0 loses a step more, i_b < 0 gains a step less: (-step, -step, 0) at the legs
    expected = (-step / 3.0 - 1j * step / math.sqrt(3.0)) / R_S
    assert found[1] - found[0] == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("minimum", [0.0, 4e-6])
def test_minimum_pulse_swallows_short_pulses(minimum):
    """At 0.98 modulation the extreme legs ask for pulses of 2 us; where they are not made the voltage is full."""
    simulation = open_simulation(with_changes(switched(minimum_pulse=minimum), no_magnet), mode=VOLTAGE)
    simulation.reference.u_d_inject = 0.98 * U_DC * 0.57735
    simulation.run(1)
    u = [1.0, 1.0]
    for _ in range(3):
        simulation.run(1)
        u.append(simulation.signal(Truth.U_ALPHA_MEAN))
    duty = simulation.signal(Truth.DUTY_A)
    assert 0.0 < (1.0 - duty) * T_S < 10e-6
    full = U_DC * (2.0 * duty - simulation.signal(Truth.DUTY_B) - simulation.signal(Truth.DUTY_C)) / 3.0
    if (1.0 - duty) * T_S < minimum:
        assert u[-1] > full + 1.0
    else:
        assert u[-1] == pytest.approx(full, rel=1e-9)


def test_current_ripple_is_real_and_centred_on_the_sampling_instant():
    """Half a period later the sample stands on the ripple's other extreme; a period later on the same point."""

    def sampled(shift: float) -> float:
        def change(setup: Setup) -> None:
            switched()(setup)
            setup.sampling_shift = shift

        simulation = open_simulation(change, mode=VOLTAGE)
        simulation.reference.u_d_inject = 10.0
        simulation.run(4000)
        return float(np.mean(record(simulation, [1], 20)))  # Signal.I_D, as the drive sampled it

    shift = 0.2 * T_S  # still inside the zero vector that starts and ends the period
    centre, early, late, half = (sampled(t) for t in (0.0, -shift, shift, 0.5 * T_S))
    slope = -R_S * 20.0 / L_D  # the current decays through a zero vector
    assert centre == pytest.approx(10.0 / R_S, rel=1e-4)
    assert late - centre == pytest.approx(slope * shift, rel=0.01)  # 67 mA
    assert early - centre == pytest.approx(-slope * shift, rel=0.01)
    assert half == pytest.approx(centre, rel=1e-4)  # the middle of the other zero vector


def test_gates_off_lets_the_current_die_in_the_diodes_and_stay_away():
    simulation = open_simulation(switched(V_diode=0.8))
    simulation.reference.i_q_ref = 15.0
    simulation.run(1000)
    simulation.reference.mode = 0
    simulation.run(3)
    i_q = simulation.signal(Truth.I_Q)
    assert 0.0 <= i_q < 15.0
    currents = record(simulation, PHASES, 200)
    assert not currents[:, 5:].any()


def test_back_emf_above_the_dc_link_rectifies():
    """A fast rotor charges the DC link through the diodes: braking torque without a single gate pulse."""
    omega_M = 1.3 * U_DC / math.sqrt(3.0) / (POLE_PAIRS * PSI)
    simulation = open_simulation(with_changes(turning(omega_M), switched(V_diode=0.8)), mode=0)
    torque, *currents = record(simulation, [Truth.TORQUE, *PHASES], 3000)
    assert np.mean(torque[1500:]) < -0.5
    assert np.abs(currents).max() > 2.0
    slow = open_simulation(with_changes(turning(0.6 * omega_M), switched(V_diode=0.8)), mode=0)
    assert not record(slow, PHASES, 500).any()
    assert simulation.counts()["event_overruns"] == slow.counts()["event_overruns"] == 0


def test_rectifier_is_the_same_circuit_in_both_models():
    omega_M = 1.3 * U_DC / math.sqrt(3.0) / (POLE_PAIRS * PSI)
    torque = []
    for model in (0, 1):
        simulation = open_simulation(with_changes(turning(omega_M), switched(V_diode=0.8, model=model)), mode=0)
        torque.append(np.mean(record(simulation, [Truth.TORQUE], 2000)[0]))
    assert torque[0] == torque[1] < -1.0


def test_dc_link_ripple_and_schedule_reach_the_machine():
    def change(setup: Setup) -> None:
        setup.U_dc_ripple, setup.U_dc_ripple_hz = 10.0, 300.0

    simulation = open_simulation(change)
    simulation.schedule(Target.U_DC, [0.0, 0.1, 0.1], [U_DC, U_DC, 250.0])
    t, U = record(simulation, [Truth.T, Truth.U_DC], 2000)
    expected = np.where(t + 1e-10 < 0.1, U_DC, 250.0) + 10.0 * np.sin(TURN * 300.0 * (t + 0.5 * T_S))
    assert np.abs(U - expected).max() < 1e-9
