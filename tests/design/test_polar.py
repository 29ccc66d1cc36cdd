# SPDX-License-Identifier: MIT
"""Polar-coordinate design against the reference's derived numbers, identities and an independent state space."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pmsmtool.design import polar
from pmsmtool.errors import DesignInfeasible
from pmsmtool.machine.parameters import MachineParameters

POWER_TO_PEAK = math.sqrt(2.0 / 3.0)
"""The paper is power-invariant; its amperes, volts and webers times this are ours."""
SET_A = polar.SurfaceMachine(0.157, 0.9e-3, 0.033 * POWER_TO_PEAK, 8)
V_MAX = 36.0 / math.sqrt(3.0)
W_800 = 800 * 2 * math.pi / 60 * 8
IDENTITY_TOLERANCE = 1e-9  # measured 3e-16 to 2e-13
EQUILIBRIUM_TOLERANCE = 1e-6  # A/s, measured 6e-11
POLYNOMIAL_TOLERANCE = 1e-6  # measured 4e-12

speeds = st.floats(-1500.0, 1500.0).filter(lambda w: abs(w) > 1.0)
currents = st.floats(-10.0, 10.0)


def _evaluate(plant: polar.SecondOrderPlant, s: complex) -> complex:
    return (plant.n1 * s + plant.n0) / (s * s + plant.d1 * s + plant.d0)


@pytest.mark.chain
@given(speeds, currents, st.floats(1.0, 2000.0))
def test_transfer_functions_are_those_of_the_state_space(omega_e: float, i_q: float, frequency: float) -> None:
    point = polar.equilibrium_without_i_d(SET_A, omega_e, i_q, V_MAX)
    a, b = polar.linearised(SET_A, point)
    s = 1j * frequency
    matrix = np.linalg.solve(s * np.eye(2) - a, b)
    assert _evaluate(polar.amplitude_plant(SET_A, point), s) == pytest.approx(matrix[0, 0], rel=IDENTITY_TOLERANCE)
    assert _evaluate(polar.phase_plant(SET_A, point), s) == pytest.approx(matrix[1, 1], rel=IDENTITY_TOLERANCE)
    assert matrix[1, 1] == pytest.approx(point.V_a * matrix[0, 0], rel=IDENTITY_TOLERANCE, abs=1e-12)
    assert matrix[0, 1] == pytest.approx(-point.V_a * matrix[1, 0], rel=IDENTITY_TOLERANCE, abs=1e-12)


@given(speeds, currents)
def test_determinant_and_condition_number(omega_e: float, i_q: float) -> None:
    point = polar.equilibrium_without_i_d(SET_A, omega_e, i_q, V_MAX)
    _, b = polar.linearised(SET_A, point)
    assert np.linalg.det(b) == pytest.approx(point.V_a / SET_A.L_s_h**2, rel=IDENTITY_TOLERANCE)
    scaled = b @ np.diag([V_MAX, 1.0])
    assert np.linalg.cond(scaled) == pytest.approx(V_MAX / point.V_a, rel=IDENTITY_TOLERANCE)


@given(speeds, currents, st.floats(0.1, 5.0))
def test_beside_an_equilibrium_the_current_moves_by_impedance_over_inductance(
    omega_e: float, i_q: float, off_a: float
) -> None:
    point = polar.equilibrium_without_i_d(SET_A, omega_e, i_q, V_MAX)
    beside = replace(point, i_q=point.i_q + off_a)
    expected = off_a * math.hypot(SET_A.R_s_ohm / SET_A.L_s_h, omega_e)
    assert beside.residual_a_per_s(SET_A) == pytest.approx(expected, rel=IDENTITY_TOLERANCE, abs=EQUILIBRIUM_TOLERANCE)


@given(st.floats(-1500.0, 1500.0), st.floats(-40.0, 40.0), st.floats(0.5, V_MAX))
def test_equilibrium_is_one_even_where_the_torque_is_not_reachable(omega_e: float, i_q: float, V_a: float) -> None:
    point = polar.equilibrium_at_amplitude(SET_A, omega_e, i_q, V_a)
    assert point.residual_a_per_s(SET_A) < EQUILIBRIUM_TOLERANCE
    if point.reachable:
        assert point.i_q == pytest.approx(i_q, abs=1e-9)
    else:  # the nearest torque that this amplitude can hold
        delta = np.linspace(-math.pi, math.pi, 2001)
        back_emf = 1j * omega_e * SET_A.psi_f_wb
        possible = ((1j * V_a * np.exp(1j * delta) - back_emf) / SET_A.impedance(omega_e)).imag
        assert abs(point.i_q - i_q) <= np.min(np.abs(possible - i_q)) + 1e-9


def test_design_at_800_rpm_gives_the_reference_values() -> None:
    design = polar.design_at(SET_A, W_800, 3.788 * POWER_TO_PEAK, V_MAX)
    assert design.point.V_a / POWER_TO_PEAK == pytest.approx(22.83, abs=0.01)
    assert design.point.delta == pytest.approx(0.1003, abs=1e-4)
    # gains per ampere: a current in peak is smaller by sqrt(2/3), so the phase gains are larger
    phase = design.phase
    assert phase.K_p * POWER_TO_PEAK == pytest.approx(3.8e-4, rel=0.02)
    assert phase.K_i * POWER_TO_PEAK == pytest.approx(6.26, rel=2e-3)
    assert phase.K_d * POWER_TO_PEAK == pytest.approx(3.14e-5, rel=2e-3)
    assert phase.a == pytest.approx(2230, rel=2e-3)
    assert design.amplitude.K_p == pytest.approx(-0.124, rel=0.01)
    assert design.amplitude.K_i == pytest.approx(341, rel=2e-3)
    assert design.amplitude.K_d == pytest.approx(9.3e-4, rel=5e-3)
    assert design.amplitude.a == pytest.approx(934, rel=2e-3)


@pytest.mark.chain
@given(st.floats(600.0, 1500.0), st.floats(0.2, 6.0))
def test_each_loop_alone_has_the_placed_polynomial(omega_e: float, i_q: float) -> None:
    point = polar.equilibrium_without_i_d(SET_A, omega_e, i_q, V_MAX)
    if not point.reachable:
        return
    for plant, sigma in (
        (polar.phase_plant(SET_A, point), 600.0),
        (polar.amplitude_plant(SET_A, point), 300.0),
    ):
        poles = polar.circle_poles(SET_A, omega_e, sigma)
        polynomial = polar.closed_loop_polynomial(plant, polar.place_pid(plant, poles))
        assert polynomial == pytest.approx(np.real(np.poly(np.array(poles))), rel=POLYNOMIAL_TOLERANCE)


@pytest.mark.parametrize(("i_q", "slowest"), [(0.5, complex(-181, 494)), (13.0, complex(-153, 468))])
def test_true_two_input_loop_is_slower_than_designed(i_q: float, slowest: complex) -> None:
    design = polar.design_at(SET_A, W_800, i_q * POWER_TO_PEAK, V_MAX)
    eigenvalues = polar.two_input_eigenvalues(SET_A, design.point, design.phase, design.amplitude)
    dominant = max(eigenvalues, key=lambda pole: (round(pole.real, 6), pole.imag))
    assert dominant == pytest.approx(slowest, abs=1.5)
    assert design.stable and design.slowest_rad_s == pytest.approx(slowest.real, abs=1.0)


@pytest.mark.parametrize(
    ("rpm", "torque", "condition"),
    [(0, 0.1, 428), (0, 1.0, 42.8), (10, 0.0, 92), (50, 0.0, 18.4), (100, 0.0, 9.2), (400, 0.0, 2.3), (800, 1.0, 1.12)],
)
def test_condition_number_of_the_map(rpm: float, torque: float, condition: float) -> None:
    result = polar.conditioning(SET_A, rpm * 2 * math.pi / 60 * 8, torque, V_MAX)
    assert result.condition == pytest.approx(condition, rel=0.006)


def test_conditioning_at_standstill_and_at_the_table_points() -> None:
    assert polar.conditioning(SET_A, 0.0, 0.0, V_MAX).condition == math.inf
    for torque, gain, zero in ((1.0, 0.88, 6490), (4.5, 0.60, 1268), (8.0, 0.08, 223)):
        point = polar.conditioning(SET_A, W_800, torque, V_MAX)
        assert point.relative_gain_dc == pytest.approx(gain, abs=0.006)
        assert point.zero_rad_s == pytest.approx(zero, rel=0.003)


def test_cdm_gains_are_continuous_where_the_d_axis_is_slowed() -> None:
    T_s, tau = 1e-4, 1e-3
    above = polar.cdm_gains(SET_A, 0.0100001 * V_MAX, 0.0, V_MAX, T_s, tau)
    below = polar.cdm_gains(SET_A, 0.0099999 * V_MAX, 0.0, V_MAX, T_s, tau)
    jump = above.K_P12 / below.K_P12 - 1.0
    assert abs(jump) < 1e-4
    assert abs(above.K_P12) * POWER_TO_PEAK == pytest.approx(8.2, abs=0.05)
    near_zero = polar.cdm_gains(SET_A, 0.0, 0.0, V_MAX, T_s, tau)
    assert abs(near_zero.K_P12) * POWER_TO_PEAK == pytest.approx(2.7, abs=0.05)
    polynomial = np.array([SET_A.L_s_h, SET_A.R_s_ohm + above.K_P21, above.K_I21]) / SET_A.L_s_h
    assert polynomial == pytest.approx([1.0, 2.5 / tau, 2.5 / tau**2])  # (24), gamma = 2.5


def test_an_interior_machine_is_refused_with_the_number() -> None:
    interior = MachineParameters(3, 3.6, 0.036, 0.051, 0.545)
    with pytest.raises(DesignInfeasible, match=r"differ by 34\.5 %"):
        polar.SurfaceMachine.of(interior)


def test_torque_out_of_reach_is_refused_with_the_largest() -> None:
    with pytest.raises(DesignInfeasible, match="at most"):
        polar.design_at(SET_A, W_800, 40.0, V_MAX)
