# SPDX-License-Identifier: MIT
"""Projection on intersections of ellipses and of half planes against a general solver and the optimality conditions."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize, root

from pmsmtool.firmware.core_binding import CoreBinding, core
from tests.firmware.governor_rows import Table1, paper_rows

Row = tuple[np.ndarray, np.ndarray, float]
EMPTY = 255
INSTANCES = 200
"""Of them the general solver takes 5 ms each; 1000 had the same largest distance."""
DISTANCE_DOUBLE = 1e-7  # A; measured 1.1e-9
DISTANCE_FLOAT = 2e-3  # A; measured 1.4e-4
STEPS_MAX = 30  # Newton steps of one call; measured 12


def instances(count: int, k_max: int = 10) -> list[tuple[list[Row], np.ndarray]]:
    """Governor problems of the Table 1 machine at random states, references and speeds up to 1000 rpm."""
    m, rng, out = Table1(), np.random.default_rng(17), []
    for n in range(count):
        omega = rng.uniform(-1, 1) * 1000 * np.pi / 30 * m.p
        angle, radius = rng.uniform(0, 2 * np.pi, 2), 56 * np.sqrt(rng.uniform(0, 1, 2))
        i, r = (radius[k] * np.array([np.cos(angle[k]), np.sin(angle[k])]) for k in range(2))
        integrals = (m.R * i + rng.normal(0, 2, 2) * (n % 2)) / m.gains[2]
        out.append((paper_rows(m, omega, i, integrals, k_max, 0.01), r))
    return out


def c_rows(binding: CoreBinding, rows: list[Row]) -> Any:
    kind = binding.types["pmsm_row"]
    return (kind * len(rows))(*(kind(*M.ravel(), *c, V) for M, c, V in rows))


def project(binding: CoreBinding, rows: list[Row], r: np.ndarray) -> tuple[int, np.ndarray, int]:
    """Status, point, Newton steps."""
    dq = binding.types["pmsm_dq"]
    v, active, steps = dq(), ctypes.c_uint32(), ctypes.c_uint32()
    status = binding.library.pmsm_project_rows(
        c_rows(binding, rows), len(rows), dq(*r), ctypes.byref(v), ctypes.byref(active), ctypes.byref(steps)
    )
    return status, np.array([v.d, v.q]), steps.value


def excess(rows: list[Row], v: np.ndarray) -> float:
    return max(float(np.sum((M @ v + c) ** 2)) / V**2 - 1 for M, c, V in rows)


def general_solution(rows: list[Row], r: np.ndarray, near: np.ndarray, rng: np.random.Generator) -> np.ndarray | None:
    """SLSQP from a few starts, then a root of the optimality conditions with the rows it found active.

    SLSQP alone leaves up to 1e-5 A along nearly parallel rows; its multipliers, which say what is active, are safe.
    """
    constraints = [
        {
            "type": "ineq",
            "fun": lambda v, M=M, c=c, V=V: 1 - np.sum((M @ v + c) ** 2) / V**2,
            "jac": lambda v, M=M, c=c, V=V: -2 * (M.T @ (M @ v + c)) / V**2,
        }
        for M, c, V in rows
    ]
    for precision, scatter in ((1e-14, 0.5), (1e-12, 0.1), (1e-15, 1.0), (1e-10, 2.0)):
        start = near + rng.normal(0, scatter, 2)
        found = minimize(
            lambda v: np.sum((v - r) ** 2),
            start,
            jac=lambda v: 2 * (v - r),
            constraints=constraints,
            method="SLSQP",
            options={"ftol": precision, "maxiter": 300},
        )
        if excess(rows, found.x) <= 1e-6:
            point = optimal_point([row for row in rows if excess([row], found.x) > -1e-6], r, found.x)
            if point is not None and excess(rows, point) <= 1e-12:
                return point
    return None


def optimal_point(active: list[Row], r: np.ndarray, near: np.ndarray) -> np.ndarray | None:
    """Root of v - r + sum of l_k grad g_k = 0, g_k = 0; None when a multiplier is negative or no root is found."""
    if len(active) > 2:
        return None

    def normals(v: np.ndarray) -> np.ndarray:
        return np.array([2 * M.T @ (M @ v + c) / V**2 for M, c, V in active]).reshape(-1, 2)

    def conditions(x: np.ndarray) -> np.ndarray:
        return np.concatenate([x[:2] - r + x[2:] @ normals(x[:2]), [excess([row], x[:2]) for row in active]])

    weights = np.linalg.lstsq(normals(near).T, r - near, rcond=None)[0] if active else np.zeros(0)
    found = root(conditions, np.concatenate([near, weights]), options={"xtol": 1e-15})
    if np.abs(conditions(found.x)).max() > 1e-10 or (found.x[2:] < 0).any():
        return None
    return np.asarray(found.x[:2])


def smallest_excess(rows: list[Row]) -> float:
    """min over v of the largest |w|^2/V^2 - 1: positive means the rows have no common point."""
    constraints = [
        {
            "type": "ineq",
            "fun": lambda v, M=M, c=c, V=V: v[2] - np.sum((M @ v[:2] + c) ** 2) / V**2,
            "jac": lambda v, M=M, c=c, V=V: np.append(-2 * (M.T @ (M @ v[:2] + c)) / V**2, 1.0),
        }
        for M, c, V in rows
    ]
    start = [0.0, 0.0, excess(rows, np.zeros(2)) + 1]
    found = minimize(
        lambda v: v[2],
        start,
        jac=lambda v: np.array([0.0, 0.0, 1.0]),
        constraints=constraints,
        method="SLSQP",
        options={"ftol": 1e-14, "maxiter": 500},
    )
    return float(found.x[2]) - 1


@pytest.mark.chain
def test_exact_projection_against_slsqp() -> None:
    double, single = core(double=True), core()
    counts = dict.fromkeys((0, 1, 2, EMPTY), 0)
    rng = np.random.default_rng(3)
    for rows, r in instances(INSTANCES):
        status, v, steps = project(double, rows, r)
        status_float, v_float, steps_float = project(single, rows, r)
        counts[status] += 1
        assert max(steps, steps_float) <= STEPS_MAX
        assert (status == EMPTY) == (status_float == EMPTY)
        if status == EMPTY:
            assert smallest_excess(rows) > 1e-9  # none flagged falsely
            continue
        assert excess(rows, v) <= 1.1e-10
        assert np.linalg.norm(v - v_float) <= DISTANCE_FLOAT
        assert excess(rows, v_float) <= 2.5e-5
        if status == 0:
            assert (v == r).all()
            continue
        general = general_solution(rows, r, v, rng)
        assert general is not None
        assert np.linalg.norm(general - v) <= DISTANCE_DOUBLE
    assert min(counts.values()) > 0.02 * INSTANCES  # every outcome was met


def test_projection_satisfies_the_optimality_conditions() -> None:
    """r - v is a non-negative combination of the gradients of the rows that v touches."""
    binding = core(double=True)
    checked = 0
    for rows, r in instances(600, k_max=2):
        status, v, _ = project(binding, rows, r)
        if status not in (1, 2):
            continue
        normals = np.array([M.T @ (M @ v + c) / V for M, c, V in rows if abs(np.linalg.norm(M @ v + c) / V - 1) < 1e-9])
        weights, *_ = np.linalg.lstsq(normals.T, r - v, rcond=None)
        if len(normals) == status:
            checked += 1
            assert weights.min() >= 0
            assert np.linalg.norm(normals.T @ weights - (r - v)) <= 1e-7
    assert checked > 200


def test_smallest_voltage_on_a_row() -> None:
    binding = core(double=True)
    dq = binding.types["pmsm_dq"]
    angle = np.linspace(0, 2 * np.pi, 721)
    outside = 0
    for rows, _ in instances(200, k_max=0):
        limit, goal = rows
        steps = ctypes.c_uint32()
        pair = c_rows(binding, [goal, limit])
        point = binding.library.pmsm_smallest_voltage(pair[0], pair[1], ctypes.byref(steps))
        v = np.array([point.d, point.q])
        assert steps.value <= 16
        assert np.linalg.norm(limit[0] @ v + limit[1]) <= limit[2] * (1 + 1e-9)
        best = np.linalg.norm(goal[0] @ v + goal[1])
        for share in (0.3, 0.8, 1.0):
            ring = share * limit[2] * np.stack([np.cos(angle), np.sin(angle)])
            candidates = np.linalg.solve(limit[0], ring - limit[1][:, None])
            assert np.linalg.norm(goal[0] @ candidates + goal[1][:, None], axis=0).min() >= best - 1e-7
        outside += int(best > 1e-3)
        assert isinstance(point, dq)
    assert outside > 50


@pytest.mark.chain
def test_half_planes_against_slsqp() -> None:
    rng = np.random.default_rng(8)
    for binding, limit in ((core(double=True), 1e-7), (core(), 1e-3)):
        dq, real = binding.types["pmsm_dq"], binding.types["pmsm_real"]
        statuses = set()
        for n in range(150):
            count = int(rng.integers(1, 9))
            normals = rng.normal(size=(count, 2))
            bounds = rng.uniform(-0.4 if n % 3 == 0 else 0.1, 1.5, count)
            r = rng.normal(scale=3, size=2)
            v, active, steps = dq(), ctypes.c_uint32(), ctypes.c_uint32()
            status = binding.library.pmsm_project_half_planes(
                (dq * count)(*(dq(*a) for a in normals)),
                (real * count)(*bounds),
                count,
                dq(*r),
                ctypes.byref(v),
                ctypes.byref(active),
                ctypes.byref(steps),
            )
            statuses.add(status)
            constraint = {"type": "ineq", "fun": lambda x, a=normals, b=bounds: b - a @ x}
            found = minimize(
                lambda x, r=r: np.sum((x - r) ** 2),
                np.zeros(2),
                constraints=[constraint],
                method="SLSQP",
                options={"ftol": 1e-15, "maxiter": 300},
            )
            if status == EMPTY:
                assert (bounds - normals @ found.x).min() < 0
            else:
                assert (bounds - normals @ [v.d, v.q]).min() >= -1e-5
                if found.success:
                    assert np.sum((np.array([v.d, v.q]) - r) ** 2) <= np.sum((found.x - r) ** 2) + limit
        assert {0, 1, 2, EMPTY} <= statuses


@pytest.mark.parametrize("double", [False, True])
def test_a_row_that_is_met_is_left_alone(double: bool) -> None:
    binding = core(double=double)
    row = (np.array([[9.2, 0.0], [0.0, 8.4]]), np.array([3.0, -4.0]), 121.0)
    steps = ctypes.c_uint32()
    point = binding.library.pmsm_project_row(
        c_rows(binding, [row])[0], binding.types["pmsm_dq"](1.5, -2.25), ctypes.byref(steps)
    )
    assert (point.d, point.q, steps.value) == (1.5, -2.25, 0)


@pytest.mark.parametrize("double", [False, True])
def test_of_equal_rows_the_first_binds_and_on_the_border_none(double: bool) -> None:
    """3, 4, 5 and 1, 0 are exact in binary arithmetic."""
    binding = core(double=double)
    dq, real = binding.types["pmsm_dq"], binding.types["pmsm_real"]
    circle = (np.eye(2), np.zeros(2), 5.0)
    for r, expected in (((6.0, 8.0), (1, 0, (3.0, 4.0))), ((3.0, 4.0), (0, 255, (3.0, 4.0)))):
        v, active, steps = dq(), ctypes.c_uint32(), ctypes.c_uint32()
        status = binding.library.pmsm_project_rows(
            c_rows(binding, [circle] * 3), 3, dq(*r), ctypes.byref(v), ctypes.byref(active), ctypes.byref(steps)
        )
        assert (status, active.value) == expected[:2]
        assert (v.d, v.q) == pytest.approx(expected[2], rel=2e-6)
    for x, shown in ((3.0, (1, 0, 1.0)), (1.0, (0, 255, 1.0))):
        v, active, steps = dq(), ctypes.c_uint32(), ctypes.c_uint32()
        planes = (dq * 3)(*([dq(1.0, 0.0)] * 3)), (real * 3)(1.0, 1.0, 1.0), 3
        status = binding.library.pmsm_project_half_planes(
            *planes, dq(x, 2.0), ctypes.byref(v), ctypes.byref(active), ctypes.byref(steps)
        )
        assert (status, active.value, v.d, v.q) == (*shown, 2.0)
