# SPDX-License-Identifier: MIT
"""The second plant of the benchmarks against closed forms, and against the project's plant through the same drive."""

from __future__ import annotations

import cmath
import contextlib
import math
from collections.abc import Iterator

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from benchmarks import second_plant
from benchmarks.analytic_saturation import BridgeSaturation
from pmsmtool.errors import ConfigError
from pmsmtool.files import data_folder
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.packaging.compiler import CompilerError
from pmsmtool.sim.kernel import Application, Part, Rotor, Setup, Simulation, Truth
from pmsmtool.sim.simulated_machine import build_setup
from tests.sim.bench import (
    L_D,
    L_Q,
    POLE_PAIRS,
    PSI,
    R_S,
    T_S,
    U_DC,
    VOLTAGE,
    Change,
    free,
    open_simulation,
    plant_run,
    record,
    turning,
    values,
)

ELECTRICAL = 5e-5
"""Of the largest current: the trapezoid's error at its longest step (measured 8e-6)."""
SHAFT = 1e-8
"""Of the first speed (measured 5e-10)."""
SWING = 1e-3
"""Of the amplitude after many swings, whose phase drifts with the square of the step (measured 3e-4)."""
BRIDGE = 1e-3
"""Of the lost voltage: ripple moves the instants of commutation (measured 5e-4)."""


SATURATED = 1e-9
"""Of the largest current, eight steps a period (measured 1.5e-11)."""


def locked(**machine: float) -> Change:
    return free(rotor=Rotor.LOCKED, **machine)


def switched(omega_rad_s: float = 0.0, **inverter: float) -> Change:
    """Rotor turned at a speed on a switched bridge."""

    def change(setup: Setup) -> None:
        turning(omega_rad_s)(setup)
        setup.inverter.model = 1
        for name, value in inverter.items():
            if name == "dead_time":
                setup.inverter.dead_time[:] = [value] * 3
            else:
                setattr(setup.inverter, name, value)

    return change


SMOOTH = values(motor__L_d_h=0.1, motor__L_q_h=0.1, current__K_p_d_v_per_a=100.0, current__K_p_q_v_per_a=100.0)


def hardly_any_ripple(change: Change) -> Change:
    def smooth(setup: Setup) -> None:
        change(setup)
        setup.machine.L_d = setup.machine.L_q = 0.1

    return smooth


def without_current(change: Change, omega_rad_s: float = 0.0) -> Simulation:
    """The shaft alone: no phase is connected."""

    def start(setup: Setup) -> None:
        change(setup)
        setup.omega_M = omega_rad_s
        setup.inverter.open[:] = [1, 1, 1]

    return open_simulation(start)


def coasting(change: Change, omega_rad_s: float, signals: list[Truth], periods: int) -> np.ndarray:
    return record(without_current(change, omega_rad_s), signals, periods)


@contextlib.contextmanager
def compiled() -> Iterator[str]:
    try:
        second_plant.build()
    except CompilerError as error:
        pytest.skip(f"no compiler: {error}")
    with second_plant.used() as digest:
        yield digest


@pytest.fixture
def second() -> Iterator[str]:
    with compiled() as digest:
        yield digest


@pytest.mark.usefixtures("second")
class TestMachine:
    def test_a_step_rises_with_the_time_constants_of_both_axes(self) -> None:
        found = plant_run(open_simulation(locked()), [10.0 + 5.0j] * 300, T_S)
        t = T_S * np.arange(1, 301)
        wanted = (10.0 * (1.0 - np.exp(-t * R_S / L_D)) + 5.0j * (1.0 - np.exp(-t * R_S / L_Q))) / R_S
        assert np.abs(found - wanted).max() < ELECTRICAL * np.abs(wanted).max()

    def test_short_circuited_it_brakes_by_its_back_emf(self) -> None:
        omega = 100.0 * POLE_PAIRS
        found = plant_run(open_simulation(turning(100.0)), [0.0] * 2000, T_S)[-1]
        scale = omega * PSI / (R_S**2 + omega**2 * L_D * L_Q)
        wanted = -scale * (omega * L_Q + 1.0j * R_S)
        assert abs(found - wanted) < ELECTRICAL * abs(wanted)

    def test_open_coils_link_the_magnet_and_its_space_harmonics(self) -> None:
        harmonics = {"psi_6": 4e-3, "psi_7": 3e-3, "psi_12": 1e-3}

        def change(setup: Setup) -> None:
            turning(80.0)(setup)
            setup.inverter.open[:] = [1, 1, 1]
            setup.T_magnet = 70.0
            for name, value in harmonics.items():
                setattr(setup.machine, name, value)

        alpha, theta = record(open_simulation(change), [Truth.PSI_ALPHA, Truth.THETA_E], 400)
        hot = 1.0 - 0.0012 * 50.0
        wanted = hot * (
            PSI * np.cos(theta) + 4e-3 * np.cos(5 * theta) + 3e-3 * np.cos(7 * theta) + 1e-3 * np.cos(11 * theta)
        )
        assert np.abs(alpha - wanted).max() < 1e-12

    def test_the_terminals_energy_is_heat_and_work(self) -> None:
        """Over one electrical turn in the steady state, saliency and harmonics included."""
        omega, h = 60.0, 2.0 * math.pi / (60.0 * POLE_PAIRS * 4000.0)

        def change(setup: Setup) -> None:
            turning(omega)(setup)
            setup.machine.psi_6, setup.machine.psi_7 = 4e-3, 2e-3

        simulation = open_simulation(change)
        rotor = np.exp(2.0j * math.pi * np.arange(4000) / 4000.0)
        voltage = (4.0 + 24.0j) * rotor * np.exp(0.5j * omega * POLE_PAIRS * h)
        for _ in range(6):
            plant_run(simulation, voltage, h)
        current, torque = np.empty(4001, complex), np.empty(4001)
        turn = np.append(rotor, 1.0)
        for k in range(4001):
            current[k] = turn[k] * complex(simulation.signal(Truth.I_D), simulation.signal(Truth.I_Q))
            torque[k] = simulation.signal(Truth.TORQUE)
            if k < 4000:
                plant_run(simulation, voltage[k : k + 1], h)
        middle = 0.5 * (current[1:] + current[:-1])
        supplied = 1.5 * h * float(np.sum((voltage * middle.conj()).real))
        heat = 1.5 * R_S * h * float(np.sum(np.abs(middle) ** 2))
        work = omega * h * float(np.sum(torque[:-1]))
        assert supplied - heat == pytest.approx(work, rel=1e-5)
        assert np.ptp(torque) > 0.05 * abs(float(np.mean(torque)))

    def test_eddy_currents_are_a_branch_beside_the_inductance(self) -> None:
        share, rate, omega = 0.2, 5000.0, 3000.0
        eddy = share / ((1.0 - share) * L_D)
        simulation = open_simulation(locked(eddy_d=eddy, eddy_q=eddy, eddy_rate=rate))
        h, n = 2.0 * math.pi / omega / 1000.0, 20_000
        t = h * (np.arange(n) + 0.5)
        found = plant_run(simulation, 10.0 * np.cos(omega * t), h).real
        back = found[-1000:] @ np.exp(-1.0j * omega * (t[-1000:] + 0.5 * h)) / 500.0
        wanted = 10.0 / (R_S + 1.0 / (1.0 / (1.0j * omega * L_D) + eddy / (rate + 1.0j * omega)))
        assert abs(back - wanted) < 3e-4 * abs(wanted)

    def test_the_core_is_a_resistor_across_the_flux_voltage(self) -> None:
        def change(setup: Setup) -> None:
            turning(200.0)(setup)
            setup.machine.R_iron = 50.0

        simulation = open_simulation(change)
        theta = 200.0 * POLE_PAIRS * T_S * np.arange(3000)
        turned = plant_run(simulation, 60.0j * np.exp(1.0j * (theta + 100.0 * POLE_PAIRS * T_S)), T_S)
        m = turned[-1]
        core = 1.0j * 200.0 * POLE_PAIRS * (L_D * m.real + PSI + 1.0j * L_Q * m.imag) / 50.0
        terminal = complex(simulation.signal(Truth.I_A), 0.0)
        shown = (m + core) * cmath.exp(1.0j * simulation.signal(Truth.THETA_E))
        assert terminal.real == pytest.approx(shown.real, abs=2e-2 * abs(core))
        assert abs(core) > 0.02 * abs(m)


@pytest.mark.usefixtures("second")
class TestShaft:
    def test_a_spinning_shaft_coasts_and_stays_at_rest(self) -> None:
        J, B, tau_c, omega = 2e-3, 4e-3, 0.08, 60.0
        t, found = coasting(free(J=J, B=B, tau_c=tau_c), omega, [Truth.T, Truth.OMEGA_M], 10_000)
        wanted = np.maximum((omega + tau_c / B) * np.exp(-B * t / J) - tau_c / B, 0.0)
        assert np.abs(found - wanted).max() < SHAFT * omega
        assert found[-1] == 0.0

    def test_the_air_slows_it_by_the_square_of_its_speed(self) -> None:
        t, found = coasting(free(J=2e-3, drag=2e-4), -60.0, [Truth.T, Truth.OMEGA_M], 5000)
        assert np.abs(found + 60.0 / (1.0 + 2e-4 * 60.0 * t / 2e-3)).max() < SHAFT * 60.0

    @pytest.mark.parametrize("load", [0.09, 0.11])
    def test_friction_holds_up_to_its_torque(self, load: float) -> None:
        simulation = without_current(free(tau_c=0.1))
        simulation.library.pmsm_sim_set_load(simulation.sim, load)
        simulation.run(1000)
        moved = -(load - 0.1) / 2e-3 * 0.1 if load > 0.1 else 0.0
        assert simulation.signal(Truth.OMEGA_M) == pytest.approx(moved, rel=1e-6, abs=0.0)

    def test_a_second_mass_swings_at_the_resonance_of_both(self) -> None:
        J, J_load, stiffness, load = 2e-3, 5e-3, 400.0, 0.3

        def change(setup: Setup) -> None:
            free(J=J, J_load=J_load, coupling_stiffness=stiffness)(setup)
            setup.load = load

        t, found = coasting(change, 0.0, [Truth.T, Truth.TWIST], 2000)
        omega = math.sqrt(stiffness * (1.0 / J + 1.0 / J_load))
        size = load / (J_load * omega**2)
        assert np.abs(found - size * (1.0 - np.cos(omega * t))).max() < SWING * size

    def test_it_swings_in_the_cogging_torque(self) -> None:
        J, cogging, periods = 2e-3, 0.5, 24.0
        omega, small = math.sqrt(cogging * periods / J), 1e-3

        def change(setup: Setup) -> None:
            free(J=J, cogging=cogging, cogging_periods=periods)(setup)
            setup.theta_M = small

        t, found = coasting(change, 0.0, [Truth.T, Truth.THETA_M], 1000)
        assert np.abs(found - small * np.cos(omega * t)).max() < SWING * small


@pytest.mark.usefixtures("second")
class TestBridge:
    def test_dead_time_takes_six_steps_of_voltage(self) -> None:
        """Per leg U_dc t_dead / T_s against the current; its fundamental is 4 / pi of that, along the current."""
        omega, dead = 2.0 * math.pi / (800.0 * T_S * POLE_PAIRS), 2e-6
        simulation = open_simulation(hardly_any_ripple(switched(omega, dead_time=dead)), params=SMOOTH)
        simulation.reference.i_q_ref = 15.0
        simulation.run(2400)
        names = [Truth.U_ALPHA, Truth.U_BETA, Truth.U_ALPHA_MEAN, Truth.U_BETA_MEAN, Truth.I_A, Truth.I_B]
        u_alpha, u_beta, mean_alpha, mean_beta, i_a, i_b = record(simulation, names, 803)
        lost = (u_alpha + 1.0j * u_beta)[:-3] - (mean_alpha + 1.0j * mean_beta)[2:-1]  # acts a period later
        current = i_a + 1.0j * (i_a + 2.0 * i_b) / math.sqrt(3.0)
        along = np.mean(lost * (0.5 * (current[1:-2] + current[2:-1])).conj()) / np.mean(np.abs(current))
        assert along.real == pytest.approx(4.0 / math.pi * U_DC * dead / T_S, rel=BRIDGE)

    def test_the_nodes_capacitance_gives_back_what_its_charge_holds(self) -> None:
        """Where the current moves the node within the dead time the leg loses U t_dead - C U^2 / (2 i)."""
        dead, capacitance, i = 2e-6, 1e-9, 10.0

        change = hardly_any_ripple(switched(0.0, dead_time=dead, capacitance=capacitance))
        simulation = open_simulation(change, params=SMOOTH)
        simulation.reference.i_d_ref = i
        simulation.run(2000)
        demanded, mean = (simulation.signal(name) for name in (Truth.U_ALPHA, Truth.U_ALPHA_MEAN))
        lost = [U_DC * dead - capacitance * U_DC**2 / (2.0 * each) for each in (i, 0.5 * i)]
        assert demanded - mean == pytest.approx(2.0 / 3.0 * (lost[0] + lost[1]) / T_S, rel=BRIDGE)

    def test_switch_and_diode_drop_by_the_share_they_conduct(self) -> None:
        V_switch, V_diode, i = 1.5, 0.9, 10.0
        simulation = open_simulation(switched(0.0, V_switch=V_switch, V_diode=V_diode))
        simulation.reference.i_d_ref = i
        simulation.run(3000)
        u, mean = (simulation.signal(name) for name in (Truth.U_ALPHA, Truth.U_ALPHA_MEAN))
        duty = 0.5 + 0.75 * u / U_DC  # of a; the other two are as far below the half with half the current each
        out = duty * V_switch + (1.0 - duty) * V_diode
        assert u - mean == pytest.approx(2.0 / 3.0 * (out + out), rel=BRIDGE)

    def test_with_the_gates_off_the_diodes_rectify(self) -> None:
        """The peak of the line voltage below the link: no current. Above: a brake."""
        below, above = ((share * U_DC + 2.0) / (math.sqrt(3.0) * PSI * POLE_PAIRS) for share in (0.95, 1.3))
        for speed, conducts in ((below, False), (above, True)):

            def change(setup: Setup, speed: float = speed) -> None:
                switched(speed, V_diode=1.0)(setup)
                setup.application = Application.DRIVE

            simulation = open_simulation(change)
            simulation.word(Part.ENABLED).value = 0
            i_a, torque = record(simulation, [Truth.I_A, Truth.TORQUE], 1000)
            assert (np.abs(i_a).max() > 1.0) == conducts
            assert (float(np.mean(torque)) < -0.05) == conducts

    def test_an_open_phase_leaves_one_loop(self) -> None:
        def change(setup: Setup) -> None:
            setup.inverter.open[:] = [0, 0, 1]
            setup.machine.L_q = L_D

        simulation = open_simulation(change, mode=VOLTAGE)
        simulation.reference.u_d_inject = 6.0
        found = record(simulation, [Truth.I_A, Truth.I_B, Truth.I_C], 1000)
        assert found[0, -1] == pytest.approx(4.5 / R_S, rel=1e-4)  # (u_a - u_b) / (2 R)
        assert found[1, -1] == -found[0, -1]
        assert np.abs(found[2]).max() < 1e-12


def test_both_plants_agree_on_a_drive_that_speeds_up() -> None:
    """A switched bridge with capacitances, a salient machine, its shaft with friction and cogging, under one control.

    Measured: current 3e-4 of its peak (the commutation of the nodes), speed 2e-5.
    """
    found = []

    def change(setup: Setup) -> None:
        switched(dead_time=1e-6, V_switch=0.8, V_diode=1.0, r_switch=0.02, r_diode=0.03, capacitance=5e-10)(setup)
        free(rotor=Rotor.FREE, tau_c=0.05, B=1e-3, cogging=0.05, cogging_periods=36.0)(setup)

    for block in (compiled(), contextlib.nullcontext()):
        with block:
            simulation = open_simulation(change)
            simulation.reference.i_q_ref = 8.0
            found.append(record(simulation, [Truth.I_A, Truth.I_B, Truth.OMEGA_M], 2000))
    for mine, theirs, share in zip(*found, (1e-3, 1e-3, 1e-4), strict=True):
        assert np.abs(mine - theirs).max() < share * np.abs(theirs).max()
    assert not np.array_equal(found[0], found[1])


@pytest.mark.usefixtures("second")
def test_it_refuses_a_flux_map() -> None:
    setup, keep = build_setup(load_machine_file(data_folder("profiles") / "saturated-pmsyrm.toml"))
    with pytest.raises(ConfigError, match="cannot simulate a flux map"):
        Simulation(setup, b"", keep)


@pytest.mark.chain
def test_a_saturating_machine_moves_as_its_closed_form_says() -> None:
    form, omega_e, u = BridgeSaturation(), 60.0 * POLE_PAIRS, 40.0 + 25.0j

    def slope(t: float, psi: np.ndarray) -> list[float]:
        i_d, i_q = form.current(*psi)
        u_dq = u * cmath.exp(-1j * omega_e * t)
        return [u_dq.real - R_S * i_d + omega_e * psi[1], u_dq.imag - R_S * i_q - omega_e * psi[0]]

    rest = [float(x) for x in form.flux(0.0, 0.0)]
    t = T_S * np.arange(1, 101)
    wanted = form.current(*solve_ivp(slope, (0.0, t[-1]), rest, "DOP853", t, rtol=1e-11, atol=1e-13).y)
    try:
        with second_plant.saturated(form):
            found = plant_run(open_simulation(turning(60.0)), [u] * len(t), T_S)
    except CompilerError as error:
        pytest.skip(f"no compiler: {error}")
    wanted = wanted[0] + 1j * wanted[1]
    assert np.ptp(np.abs(wanted)) > 5.0
    assert np.abs(found - wanted).max() < SATURATED * np.abs(wanted).max()
