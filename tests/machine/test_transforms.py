# SPDX-License-Identifier: MIT
"""Clarke and Park: conventions, round trips, power."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.transforms import clarke, electrical_angle, inverse_clarke, inverse_park, park

VALUES = st.floats(-1e6, 1e6)
ANGLES = st.floats(-100.0, 100.0)


def test_amplitude_is_kept_and_alpha_is_phase_a():
    theta = np.linspace(0.0, 2 * math.pi, 50)
    phases = [10.0 * np.cos(theta - k * 2 * math.pi / 3) for k in range(3)]
    alpha, beta = clarke(*phases)
    assert np.allclose(alpha, 10.0 * np.cos(theta))
    assert np.allclose(beta, 10.0 * np.sin(theta))
    d, q = park(alpha, beta, theta)
    assert np.allclose(d, 10.0)
    assert np.allclose(q, 0.0, atol=1e-12)


def test_q_leads_d():
    assert [float(value) for value in park(0.0, 1.0, 0.0)] == [0.0, 1.0]


@given(VALUES, VALUES)
def test_clarke_round_trip(alpha, beta):
    phases = inverse_clarke(alpha, beta)
    scale = 1.0 + abs(alpha) + abs(beta)
    assert abs(sum(phases)) <= 1e-15 * scale * 4
    assert np.allclose(clarke(*phases), [alpha, beta], rtol=0, atol=1e-14 * scale)


@given(VALUES, VALUES, VALUES)
def test_clarke_drops_the_zero_component_only(a, b, zero):
    c = -a - b
    scale = 1.0 + abs(a) + abs(b) + abs(zero)
    assert np.allclose(clarke(a + zero, b + zero, c + zero), clarke(a, b, c), rtol=0, atol=1e-14 * scale)


@given(VALUES, VALUES, ANGLES)
def test_park_round_trip(alpha, beta, theta):
    back = inverse_park(*park(alpha, beta, theta), theta)
    assert np.allclose(back, [alpha, beta], rtol=0, atol=1e-14 * (1.0 + abs(alpha) + abs(beta)))


@given(VALUES, VALUES, VALUES, VALUES, ANGLES)
def test_power_is_three_halves(u_alpha, u_beta, i_alpha, i_beta, theta):
    in_phases = float(np.dot(inverse_clarke(u_alpha, u_beta), inverse_clarke(i_alpha, i_beta)))
    in_dq = 1.5 * float(np.dot(park(u_alpha, u_beta, theta), park(i_alpha, i_beta, theta)))
    scale = 1.0 + (abs(u_alpha) + abs(u_beta)) * (abs(i_alpha) + abs(i_beta))
    assert in_phases == pytest.approx(in_dq, abs=1e-13 * scale)


@given(ANGLES, st.integers(1, 20), st.floats(-6, 6), st.sampled_from([1, -1]))
def test_electrical_angle_is_wrapped(theta_M, pole_pairs, offset, direction):
    theta_e = float(electrical_angle(theta_M, pole_pairs, offset, direction))
    assert -math.pi <= theta_e <= math.pi
    turns = (direction * pole_pairs * theta_M - offset - theta_e) / (2 * math.pi)
    assert turns == pytest.approx(round(turns), abs=1e-9)


def test_a_frame_ahead_is_cured_by_a_larger_offset():
    assert electrical_angle(0.1, 4, 0.05) == pytest.approx(0.35)
    assert electrical_angle(0.1, 4, 0.05 + 0.02) == pytest.approx(0.33)
