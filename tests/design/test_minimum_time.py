# SPDX-License-Identifier: MIT
"""The minimum-time bound: two methods against each other, against the reference's numbers and against a brute force."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pmsmtool.design.minimum_time import Flow, TransferProblem, flux_time, minimum_time
from pmsmtool.errors import DesignInfeasible
from tests.design.shooting import shoot

AGREEMENT = 1e-8
"""Support function against shooting, relative (measured 1e-12 to 3e-11)."""
FLOW = 1e-12
"""Closed form against the matrix exponential (measured 6e-16)."""


def problem(rpm: float, U_dc: float = 210.0) -> TransferProblem:
    return TransferProblem(0.137, 2.3e-3, 2.1e-3, 0.41, rpm * 4.0 * math.pi / 30.0, U_dc / math.sqrt(3.0))


STEPS = [
    (0.0, (0.0, 0.0), (0.0, 28.0), 0.493, 0.483),
    (310.0, (0.0, 0.0), (0.0, 28.0), 0.889, 0.871),
    (620.0, (0.0, 0.0), (0.0, 28.0), 3.352, 3.300),
    (800.0, (-40.0, 0.0), (-40.0, 28.0), 3.091, 3.048),
    (620.0, (0.0, 28.0), (0.0, -28.0), 0.515, 0.505),
]


@pytest.mark.parametrize(("rpm", "start", "end", "ms", "ms_ball"), STEPS)
def test_reference_steps_by_both_methods(
    rpm: float, start: tuple[float, float], end: tuple[float, float], ms: float, ms_ball: float
) -> None:
    radius = 0.02 * math.dist(start, end)
    exact, ball = minimum_time(problem(rpm), start, end), minimum_time(problem(rpm), start, end, radius=radius)
    assert (1e3 * exact, 1e3 * ball) == pytest.approx((ms, ms_ball), abs=6e-4)
    assert shoot(problem(rpm), start, end) == pytest.approx(exact, rel=AGREEMENT)
    assert shoot(problem(rpm), start, end, radius) == pytest.approx(ball, rel=AGREEMENT)


@pytest.mark.parametrize(("U_dc", "ms"), [(200.0, 4.20), (210.0, 3.35), (230.0, 2.20)])
def test_the_bound_depends_on_the_dc_link(U_dc: float, ms: float) -> None:
    assert 1e3 * minimum_time(problem(620.0, U_dc), (0.0, 0.0), (0.0, 28.0)) == pytest.approx(ms, abs=6e-3)


@pytest.mark.chain
def test_both_methods_agree_on_salient_machines_too() -> None:
    rng = np.random.default_rng(11)
    for _ in range(8):
        L_d = 10.0 ** rng.uniform(-3.3, -2.3)
        machine = TransferProblem(
            rng.uniform(0.02, 0.5),
            L_d,
            L_d * rng.uniform(0.6, 2.5),
            rng.uniform(0.05, 0.3),
            rng.uniform(-400.0, 400.0),
            120.0,
        )
        start, end = tuple(rng.uniform(-30.0, 30.0, 2)), tuple(rng.uniform(-30.0, 30.0, 2))
        assert shoot(machine, start, end) == pytest.approx(minimum_time(machine, start, end), rel=AGREEMENT)


def test_without_resistance_the_flux_goes_straight() -> None:
    machine = TransferProblem(0.0, 1e-3, 2.5e-3, 0.1, 500.0, 100.0)
    start, end = (-20.0, 10.0), (-60.0, -40.0)
    expected = flux_time(machine, np.array(start), np.array(end))
    assert minimum_time(machine, start, end) == pytest.approx(expected, rel=1e-8)


@pytest.mark.chain
def test_hexagon_is_never_slower_than_its_circle_nor_faster_than_its_corners() -> None:
    start, end = (0.0, 0.0), (0.0, 28.0)
    circle = minimum_time(problem(620.0), start, end)
    corners = minimum_time(problem(620.0, 210.0 / math.cos(math.pi / 6.0)), start, end)
    for theta in (0.0, 0.2, 0.4, 0.8):
        hexagon = minimum_time(problem(620.0), start, end, voltage="hexagon", theta_e=theta)
        assert corners < hexagon < circle
    turned = minimum_time(problem(620.0), start, end, voltage="hexagon", theta_e=0.2 + math.pi / 3.0)
    assert turned == pytest.approx(minimum_time(problem(620.0), start, end, voltage="hexagon", theta_e=0.2), rel=1e-7)


def test_no_voltage_sequence_is_faster() -> None:
    """Discretised control: the least end error over piecewise constant voltages vanishes only from T_min on."""
    optimize = pytest.importorskip("scipy.optimize")
    linalg = pytest.importorskip("scipy.linalg")
    case = problem(310.0)
    F, G, e = case.system()
    start, end, pieces = np.zeros(2), np.array([0.0, 28.0]), 16
    T_min = minimum_time(case, (0.0, 0.0), (0.0, 28.0))

    def end_error(T: float) -> float:
        h = T / pieces
        joint = np.zeros((5, 5))
        joint[:2, :2], joint[:2, 2:4], joint[:2, 4] = F, G, e
        step = linalg.expm(h * joint)

        def final(angles: np.ndarray) -> np.ndarray:
            i = start
            for angle in angles:
                u = case.V_max * np.array([math.cos(angle), math.sin(angle)])
                i = step[:2, :2] @ i + step[:2, 2:4] @ u + step[:2, 4]
            return np.asarray(i - end)

        found = optimize.least_squares(final, np.full(pieces, 1.8), xtol=1e-12, ftol=1e-12)
        return float(np.hypot(*found.fun))

    assert end_error(0.97 * T_min) > 0.2
    assert end_error(1.01 * T_min) < 1e-3


def test_out_of_reach_is_said_and_nothing_takes_no_time() -> None:
    weak = TransferProblem(1.0, 2e-3, 2e-3, 0.0, 0.0, 5.0)
    assert minimum_time(weak, (0.0, 0.0), (4.9, 0.0)) == pytest.approx(2e-3 * math.log(5.0 / 0.1), rel=1e-8)
    with pytest.raises(DesignInfeasible, match="cannot be reached"):
        minimum_time(weak, (0.0, 0.0), (5.1, 0.0))
    assert minimum_time(problem(310.0), (1.0, 2.0), (1.0, 2.0)) == 0.0
    assert minimum_time(problem(310.0), (1.0, 2.0), (1.1, 2.0), radius=0.2) == 0.0


@pytest.mark.parametrize(
    "F",
    [
        [[-60.0, 250.0], [-240.0, -65.0]],
        [[0.0, 0.0], [0.0, 0.0]],
        [[-90.0, 0.0], [0.0, 0.0]],
        [[-90.0, 40.0], [0.0, 0.0]],
    ],
    ids=["turning", "nothing", "one axis", "singular and coupled"],
)
def test_the_flow_is_the_matrix_exponential_and_its_integral(F: list[list[float]]) -> None:
    """e^[[F, 1], [0, 0]]T holds both: e^(F T) above left, its integral above right."""
    linalg = pytest.importorskip("scipy.linalg")
    flow, T = Flow(np.array(F)), 7e-3
    joint = np.zeros((4, 4))
    joint[:2, :2], joint[:2, 2:] = F, np.eye(2)
    exact = linalg.expm(T * joint)
    assert flow.at(np.array([T]))[0] == pytest.approx(exact[:2, :2], rel=FLOW, abs=FLOW)
    assert flow.integral(T) == pytest.approx(exact[:2, 2:], rel=FLOW, abs=FLOW * T)


def test_without_resistance_and_speed_the_voltage_pulls_the_flux_straight() -> None:
    """V T = |L (end - start)|."""
    machine = TransferProblem(0.0, 1e-3, 2.5e-3, 0.1, 0.0, 100.0)
    expected = math.hypot(1e-3 * 40.0, 2.5e-3 * 50.0) / 100.0
    assert minimum_time(machine, (-20.0, 10.0), (-60.0, -40.0)) == pytest.approx(expected, rel=AGREEMENT)
