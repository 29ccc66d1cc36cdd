# SPDX-License-Identifier: MIT
"""Conditioning, controllability, stability and gains over speed and torque against reference and state space."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pmsmtool.design import polar, polar_values
from pmsmtool.units import RAD_S_PER_RPM
from tests.design.test_polar import POWER_TO_PEAK, SET_A, V_MAX, W_800

SHARE_ABOVE_10, SHARE_ABOVE_100 = 0.066, 0.003  # measured 0.0658 and 0.0033; on 281 x 201 points 0.0623 and 0.0024
SHARE_ROOM = (0.001, 0.0005)


def test_share_of_the_badly_conditioned_area() -> None:
    found = polar_values.condition_map(SET_A, V_MAX, np.linspace(0, 1400, 71), np.linspace(-5, 5, 51))
    assert polar_values.share_above(found, 10.0) == pytest.approx(SHARE_ABOVE_10, abs=SHARE_ROOM[0])
    assert polar_values.share_above(found, 100.0) == pytest.approx(SHARE_ABOVE_100, abs=SHARE_ROOM[1])
    assert found.shape == (71, 51)
    assert np.isnan(found[-1, -1]) == (not _reachable(1400.0, 5.0))


def _reachable(rpm: float, torque: float) -> bool:
    omega = rpm * RAD_S_PER_RPM * SET_A.pole_pairs
    return SET_A.current_a(torque) <= polar.largest_i_q(SET_A, omega, V_MAX)


@pytest.mark.parametrize("rpm", [0.0, 400.0, 800.0, 1300.0])
def test_largest_current_is_the_end_of_the_equilibria(rpm: float) -> None:
    omega = rpm * RAD_S_PER_RPM * SET_A.pole_pairs
    most = polar.largest_i_q(SET_A, omega, V_MAX)
    assert polar.equilibrium_at_amplitude(SET_A, omega, most * 0.9999, V_MAX).reachable
    beyond = polar.equilibrium_at_amplitude(SET_A, omega, most * 1.01, V_MAX)
    assert not beyond.reachable
    assert beyond.i_q == pytest.approx(most, rel=1e-9)


@pytest.mark.parametrize(("rpm", "torque", "expected"), [(0.0, 0.0, False), (10.0, 0.0, True), (0.0, 0.5, True)])
def test_controllability_is_lost_at_standstill_without_current_only(rpm: float, torque: float, expected: bool) -> None:
    omega = rpm * RAD_S_PER_RPM * SET_A.pole_pairs
    point = polar.equilibrium_without_i_d(SET_A, omega, SET_A.current_a(torque), V_MAX)
    if rpm == 10.0:  # the turning machine without voltage: V_a alone, through the rotation
        point = polar.Equilibrium(omega, 0.0, 0.0, point.i_d, point.i_q, True)
    assert polar_values.controllable(SET_A, point) is expected


def test_the_true_loop_is_stable_all_over_the_linear_range() -> None:
    speeds, torques = np.linspace(100, 900, 9), np.linspace(-5, 5, 11)
    slowest = polar_values.stability_map(SET_A, V_MAX, speeds, torques)
    assert np.isfinite(slowest).sum() > 60
    assert np.nanmax(slowest) < -100.0  # measured -126; designed for -300
    assert np.isnan(slowest[-1, -1])  # field weakening: the amplitude loop rests
    at_800 = polar_values.stability_map(SET_A, V_MAX, [800.0], [0.5 * 0.264, 13.0 * 0.264])
    assert at_800[0] == pytest.approx([-181.0, -153.0], abs=1.0)


def test_gain_schedule_has_the_reference_values_and_leaves_out_what_is_not_reachable() -> None:
    found = polar_values.gain_schedule(SET_A, V_MAX, 1e-4, [(800.0, 1.0), (800.0, 12.0), (200.0, 1.0)])
    assert [(gains.rpm, gains.torque_nm) for gains in found] == [(800.0, 1.0), (200.0, 1.0)]
    at_800, slow = found
    assert at_800.phase[1] * POWER_TO_PEAK == pytest.approx(6.26, rel=2e-3)
    assert at_800.direct_phase * POWER_TO_PEAK == pytest.approx(0.070, rel=0.02)
    assert slow.direct_phase > 15 * at_800.direct_phase  # below |p| = 600 the kick of the PID grows
    design = polar.design_at(SET_A, W_800, SET_A.current_a(1.0), V_MAX)
    assert at_800.amplitude == pytest.approx(
        (design.amplitude.K_p, design.amplitude.K_i, design.amplitude.K_d, design.amplitude.a), rel=1e-6
    )


def test_relative_gain_says_which_input_belongs_to_which_current() -> None:
    for omega, gain in ((0.0, 0.0), (W_800, 0.88)):  # standstill: i_q <- V_a, 800 rpm: i_q <- delta
        assert polar.conditioning(SET_A, omega, 1.0, V_MAX).relative_gain_dc == pytest.approx(gain, abs=0.01)
    found = polar_values.condition_map(SET_A, V_MAX, [0.0, 100.0, 800.0], [0.0, 1.0])
    assert math.isinf(found[0, 0])
