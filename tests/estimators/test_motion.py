# SPDX-License-Identifier: MIT
"""The closed form of a shaft with friction against matrix exponentials between the roots of the speed."""

from __future__ import annotations

import math
from contextlib import nullcontext

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq

from pmsmtool.arrays import Array
from pmsmtool.estimators.shaft.model import DECAY_MOST, _stops_after, positions

J = 2e-4
T = 1e-3
TAU_C = 0.02
EXACT = 3e-12
"""Of the largest way (1); measured: 3e-13 where B T/J is next to nothing, else 3e-14."""


def _interval(theta: float, omega: float, tau: float, B: float) -> tuple[float, float]:
    """One interval, from standstill to standstill and from one sign of the speed to the other."""
    left = T
    while left > 0.0:
        if omega == 0.0 and abs(tau) <= TAU_C:
            return theta, 0.0
        sign = math.copysign(1.0, omega or tau)
        A = np.array([[0.0, 1.0, 0.0], [0.0, -B / J, (tau - TAU_C * sign) / J], [0.0, 0.0, 0.0]])

        def state(t: float, A: Array = A, start: tuple[float, float] = (theta, omega)) -> Array:
            return np.asarray(expm(A * t) @ np.array([*start, 1.0]))

        end = state(left)
        if omega == 0.0 or end[1] * sign > 0.0:
            return float(end[0]), float(end[1])
        stop = float(brentq(lambda t, state=state: state(t)[1], 0.0, left, xtol=1e-17, rtol=1e-14))
        theta, omega, left = float(state(stop)[0]), 0.0, left - stop
    return theta, omega


def _expected(torque: Array, B: float, theta: float, omega: float) -> Array:
    ways = [theta]
    for tau in torque:
        theta, omega = _interval(theta, omega, float(tau), B)
        ways.append(theta)
    return np.array(ways)


TORQUES = {
    "through zero and back": np.repeat([0.1, -0.15, 0.05, 0.2], [6, 9, 8, 5]),
    "sticks and breaks away": np.repeat([0.03, -0.01, 0.015, -0.021, 0.019, 0.08], [3, 7, 4, 3, 6, 4]),
    "only brakes": np.repeat([-0.05, 0.01], [8, 12]),
}


@pytest.mark.parametrize("name", TORQUES)
@pytest.mark.parametrize("decay", [0.0, 1e-12, 9e-4, 0.03, 1.7, -0.02])
@pytest.mark.parametrize("omega", [0.0, 0.9, -0.7])
def test_a_motion_is_that_of_its_differential_equation(name: str, decay: float, omega: float) -> None:
    torque, B = TORQUES[name], decay * J / T
    found = positions(torque, T, np.array([math.log(J), B, TAU_C, 0.0, omega]))
    expected = _expected(torque, B, 0.0, omega)
    assert found == pytest.approx(expected, abs=EXACT * float(np.ptp(expected)))


@pytest.mark.parametrize("decay", [2.0, 49.0, -2.0])
def test_a_long_run_is_summed_up_in_pieces(decay: float) -> None:
    """Sixty intervals of a B T/J of 2 are more than exp(50), which is what one sum of them may have."""
    torque = np.full(60 if decay > 0.0 else 20, 0.1)
    found = positions(torque, T, np.array([math.log(J), decay * J / T, TAU_C, -0.2, 5.0]))
    expected = _expected(torque, decay * J / T, -0.2, 5.0)
    assert found == pytest.approx(expected, rel=EXACT)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_decay_within_a_fraction_of_an_interval_is_no_step_of_a_fit(sign: float) -> None:
    for decay in (DECAY_MOST, 1.001 * DECAY_MOST):
        x = np.array([0.0, sign * decay, TAU_C, 0.0, 1.0])  # J and T are 1
        refused = pytest.raises(OverflowError, match="without a motion")
        with nullcontext() if decay == DECAY_MOST else refused:
            assert np.all(np.isfinite(positions(np.array([0.1]), 1.0, x)))


def test_a_shaft_without_a_net_torque_never_stops() -> None:
    assert _stops_after(1.0, 0.0, 1e-4, J) == math.inf
