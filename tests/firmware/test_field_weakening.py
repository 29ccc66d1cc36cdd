# SPDX-License-Identifier: MIT
"""Field weakening by optimisation: Table 2 of Jercic et al. 2017, steady optima, empty sets, iteration counts."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize

from pmsmtool.firmware.core_binding import core
from tests.firmware.closed_loop import (
    BEST,
    CURRENT_ROW,
    FLAG_FW_EMPTY,
    MINIMUM_TIME,
    MODE_TORQUE,
    PRE_PROJECTION,
    RPM,
    Loop,
    reference_case,
)

pytestmark = pytest.mark.chain

V_DC = 210.0
V_M = 0.92 * V_DC / math.sqrt(3)
GRADIENT, ACCELERATED, UNCOMPENSATED = 2, 3, 4
Law = Callable[[int], dict[str, float]]
BIAS_NM = 0.01  # of the torque where it can be reached; measured 0.003
NEAR_A = 0.3  # steady current from the independent optimum; measured 0.02


def weakening(mode: int, **changes: float) -> dict[str, float]:
    return reference_case(4000.0, **{"field_weakening__mode": mode, "governor__eps": 0.001, **changes})


def governed(mode: int, **changes: float) -> dict[str, float]:
    options = CURRENT_ROW | PRE_PROJECTION | MINIMUM_TIME
    return weakening(mode, governor__mode=BEST, governor__options=options, **changes)


def ramp(
    values: dict[str, float],
    torque: float,
    rpm: tuple[float, float],
    *,
    periods: int = 9000,
    plant: tuple[float, float, float] = (1, 1, 1),
) -> dict[str, np.ndarray]:
    """Hold a torque over a speed ramp of 0.55 s and what follows; ``plant`` scales R, L, psi against the controller."""
    loop = Loop(core(), values, omega=rpm[0] * RPM, U_dc=V_DC)
    m = loop.plant
    m.R, m.L_d, m.L_q, m.psi = plant[0] * m.R, plant[1] * m.L_d, plant[1] * m.L_q, plant[2] * m.psi
    rows: dict[str, list[Any]] = {name: [] for name in ("i", "u_ss", "torque", "flags", "iterations")}
    p = values["motor.pole_pairs"]
    for k in range(periods):
        share = min(1.0, max(0, k - 600) / 6600)
        m.omega = round(4 * (rpm[0] + (rpm[1] - rpm[0]) * share) * RPM) / 4  # few transition matrices
        live = loop.step(mode=MODE_TORQUE, tau_ref=torque)
        i_d, i_q = m.i
        rows["i"].append(m.i)
        rows["u_ss"].append(math.hypot(m.R * i_d - m.omega * m.L_q * i_q, m.R * i_q + m.omega * (m.L_d * i_d + m.psi)))
        rows["torque"].append(1.5 * p * (m.psi + (m.L_d - m.L_q) * i_d) * i_q)
        rows["flags"].append(live.flags)
        rows["iterations"].append(live.iterations)
    return {name: np.array(list_) for name, list_ in rows.items()}


# plant (R, L, psi), end speed -> deviation of the compensated law at the end and on the ramp (%), of the uncompensated
TABLE_2: dict[str, tuple[tuple[float, float, float], float, tuple[float, float]]] = {
    "nominal": ((1, 1, 1), 800, (2.0, 3.0)),
    "a": ((1, 0.7, 1), 760, (6.8, 7.8)),
    "b": ((1.5, 1, 0.7), 1150, (-33.0, -29.0)),
}


@pytest.mark.parametrize("case", TABLE_2)
@pytest.mark.parametrize("mode", [GRADIENT, ACCELERATED])
@pytest.mark.parametrize("law", [weakening, governed])
def test_compensated_law_holds_the_voltage_under_table_2(case: str, mode: int, law: Law) -> None:
    plant, rpm, _ = TABLE_2[case]
    seen = ramp(law(mode), 40.0, (400, rpm), plant=plant)
    deviation = 100 * (seen["u_ss"] / V_M - 1)
    assert abs(deviation[-1]) <= 0.1
    assert deviation[3000:].max() <= 1.5
    assert np.linalg.norm(seen["i"], axis=1).max() <= 56.5
    reachable = 40.0 * plant[2]
    assert seen["torque"][-1] == pytest.approx(reachable, abs=0.5)  # the torque is not compensated, only the voltage


@pytest.mark.parametrize("case", TABLE_2)
def test_uncompensated_law_misses_as_the_reference_says(case: str) -> None:
    plant, rpm, (low, high) = TABLE_2[case]
    seen = ramp(weakening(UNCOMPENSATED), 40.0, (400, rpm), plant=plant)
    assert low <= 100 * (seen["u_ss"][-1] / V_M - 1) <= high
    if case == "b":
        assert abs(seen["torque"][-1]) < 0.1
        assert seen["i"][-1, 0] == pytest.approx(-56, abs=0.1)


@pytest.mark.parametrize("mode", [GRADIENT, ACCELERATED])
def test_empty_set_is_flagged_and_kept_in_hand(mode: int) -> None:
    seen = ramp(governed(mode, governor__alpha_rad_s=4000.0), 40.0, (400, 1000))
    assert seen["flags"][-1] & FLAG_FW_EMPTY
    # the point of the circle with the smallest voltage; the accelerated row knows R_s
    assert seen["i"][-1] == pytest.approx([-55.9, -2.4] if mode == GRADIENT else [-55.4, -8.1], abs=0.2)
    assert np.linalg.norm(seen["i"], axis=1).max() <= 56.5
    beyond = ramp(governed(mode), 40.0, (400, 1200))
    assert beyond["flags"][-1] & FLAG_FW_EMPTY
    assert beyond["u_ss"][-1] <= V_DC / math.sqrt(3) * 1.0005
    assert beyond["i"][-1, 1] > -10
    assert np.linalg.norm(beyond["i"], axis=1).max() <= 80
    assert seen["iterations"].max() <= 600  # 8 Armijo steps of at most 9 projections, Newton steps counted


def optimum(values: dict[str, float], omega: float, torque: float, V_m: float, I_m: float) -> np.ndarray:
    """Minimum of (43), h2/h1 = 1e-3, over |v_ss| <= V_m with R_s, |i| <= I_m and i_d <= 0: SLSQP from many starts."""
    R, L_d, L_q = (values[f"motor.{name}"] for name in ("R_s_ohm", "L_d_h", "L_q_h"))
    psi, p = values["motor.psi_f_wb"], values["motor.pole_pairs"]

    def error(i: np.ndarray) -> float:
        return float(torque - 1.5 * p * (psi + (L_d - L_q) * i[0]) * i[1])

    def voltage(i: np.ndarray) -> float:
        return float(1 - ((R * i[0] - omega * L_q * i[1]) ** 2 + (R * i[1] + omega * (L_d * i[0] + psi)) ** 2) / V_m**2)

    limits: list[dict[str, Any]] = [
        {"type": "ineq", "fun": voltage},
        {"type": "ineq", "fun": lambda i: 1 - (i[0] ** 2 + i[1] ** 2) / I_m**2},
        {"type": "ineq", "fun": lambda i: -i[0] / I_m},
    ]
    best: tuple[float, float, np.ndarray] | None = None
    for start in np.random.default_rng(2).uniform([-I_m, -I_m], [0, I_m], (30, 2)):
        found = minimize(
            lambda i: error(i) ** 2 + 1e-3 * i[0] ** 2,
            start,
            constraints=limits,
            method="SLSQP",
            options={"ftol": 1e-13, "maxiter": 400},
        )
        if min(limit["fun"](found.x) for limit in limits) > -1e-7 and (best is None or found.fun < best[0]):
            best = (found.fun, abs(error(found.x)), found.x)
    assert best is not None
    return best[2]


SALIENT = {
    "motor.R_s_ohm": 0.05,
    "motor.L_d_h": 0.001,
    "motor.L_q_h": 0.0025,
    "motor.psi_f_wb": 0.1,
    "motor.L_d_app_h": 0.001,
    "motor.L_q_app_h": 0.0025,
    "motor.I_max_apk": 150.0,
    "motor.I_nom_apk": 100.0,
    "protection.I_cont_apk": 150.0,
}


@pytest.mark.parametrize("mode", [GRADIENT, ACCELERATED])
@pytest.mark.parametrize(("rpm", "torque"), [(600, 30.0), (1500, 60.0), (2400, 100.0), (4000, 60.0), (3000, -30.0)])
def test_steady_current_of_a_salient_machine_is_the_optimum(mode: int, rpm: float, torque: float) -> None:
    """Mild weakening, MTPVA and MTPV of the reference's second machine (limit 100 V, 150 A)."""
    values = weakening(mode, field_weakening__h2=1e-3, field_weakening__iterations=20) | SALIENT
    k_t = 1.5 * 4 * (0.1 + 0.0015 * 100)
    values["field_weakening.beta"] = 0.5 / k_t**2
    for axis in "dq":
        values[f"current.K_p_{axis}_v_per_a"] = 2000 * values[f"motor.L_{axis}_h"]
        values[f"current.K_i_{axis}_v_per_as"] = 2000 * 0.05
    U_dc = 100 / 0.92 * math.sqrt(3)
    loop = Loop(core(), values, omega=rpm * RPM, U_dc=U_dc)
    loop.settle_at(-min(120.0, rpm / 20), 0.0)
    for _ in range(24000 if mode == GRADIENT else 8000):
        live = loop.step(mode=MODE_TORQUE, tau_ref=torque)
    expected = optimum(values, rpm * RPM, torque, 100.0, 150.0)
    T = 6 * (0.1 - 0.0015 * loop.plant.i[0]) * loop.plant.i[1]
    best = 6 * (0.1 - 0.0015 * expected[0]) * expected[1]
    assert abs(best - T) <= (0.15 if mode == GRADIENT else 0.05)  # measured 0.11, 0.033
    # (41) freezes R_s i in the row, so the printed law's MTPV point is a little off; 3.2 A, 0.2 A measured
    assert loop.plant.i == pytest.approx(expected, abs=4.0 if mode == GRADIENT else NEAR_A)
    assert not live.flags & FLAG_FW_EMPTY


@pytest.mark.parametrize("mode", [GRADIENT, ACCELERATED])
@pytest.mark.parametrize(("rpm", "torque"), [(500, 30.0), (700, 50.0), (800, 40.0), (850, -20.0)])
def test_steady_current_of_table_1_is_the_optimum(mode: int, rpm: float, torque: float) -> None:
    values = governed(mode)
    loop = Loop(core(), values, omega=rpm * RPM, U_dc=V_DC)
    for _ in range(6000):
        loop.step(mode=MODE_TORQUE, tau_ref=torque)
    expected = optimum(values, rpm * RPM, torque, V_M, 56.0)
    assert loop.plant.i == pytest.approx(expected, abs=NEAR_A)
    T = 6 * (0.41 + 0.0002 * loop.plant.i[0]) * loop.plant.i[1]
    assert pytest.approx(6 * (0.41 + 0.0002 * expected[0]) * expected[1], abs=BIAS_NM) == T


def test_on_the_bound_of_i_d_the_current_keeps_its_limit() -> None:
    """A salient machine that wants more i_d than it may have, and all torque: the corner of bound and circle."""
    values = weakening(ACCELERATED, field_weakening__h2=1e-3, field_weakening__iterations=20) | SALIENT
    values["field_weakening.i_d_min_a"] = -30.0
    loop = Loop(core(), values, omega=300 * RPM, U_dc=100 / 0.92 * math.sqrt(3))
    for _ in range(2000):
        live = loop.step(mode=MODE_TORQUE, tau_ref=250.0)
    assert (live.i_d_req, live.i_q_req) == pytest.approx((-30.0, math.sqrt(150.0**2 - 30.0**2)), abs=0.2)


def test_only_the_ratio_of_the_weights_counts() -> None:
    """Both four times as large or small, which binary numbers bear exactly: the same steps, the same current."""
    runs = []
    for scale in (1.0, 4.0, 0.25):
        values = governed(ACCELERATED)
        for weight in ("field_weakening.h1", "field_weakening.h2"):
            values[weight] *= scale
        loop = Loop(core(), values, omega=800 * RPM, U_dc=V_DC)
        live = [loop.step(mode=MODE_TORQUE, tau_ref=40.0 if k < 40 else -20.0) for k in range(80)]
        runs.append([loop.plant.i.tolist(), live[-1].i_d_req, live[-1].i_q_req, live[-1].iterations])
    assert runs[0] == runs[1] == runs[2]


FIELD_WEAKENING_STEPS = 14
"""Newton steps of one period, an iteration counted as three: ``STEPS_MOST`` of ``field_weakening.c``."""


def test_iterations_are_few_warm_and_bounded_cold() -> None:
    warm = ramp(governed(ACCELERATED), 40.0, (400, 800))["iterations"]
    called = warm[3000:][warm[3000:] > 0]
    assert np.percentile(called, 95) <= 16  # projections and their Newton steps; 5 FISTA steps
    loop = Loop(core(), weakening(ACCELERATED, field_weakening__iterations=100), omega=800 * RPM, U_dc=V_DC)
    for allowed in (0.2, 0.01):  # measured 0.13, 0.0002
        live = loop.step(mode=MODE_TORQUE, tau_ref=40.0)
        assert 0 < live.iterations <= FIELD_WEAKENING_STEPS
        assert abs(6 * (0.41 + 0.0002 * live.i_d_req) * live.i_q_req - 40) < allowed


def test_accelerated_answers_a_torque_step_at_once_and_the_printed_one_waits() -> None:
    waits = []
    for mode in (GRADIENT, ACCELERATED):
        loop = Loop(core(), governed(mode, field_weakening__N_fw=50), omega=300 * RPM, U_dc=V_DC)
        for _ in range(60):
            loop.step(mode=MODE_TORQUE, tau_ref=0.0)
        waits.append(next(k for k in range(200) if loop.step(mode=MODE_TORQUE, tau_ref=40.0).i_q_req > 10.0))
    assert waits[1] == 0
    assert 30 <= waits[0] <= 50


def test_most_negative_i_d_is_respected() -> None:
    values = governed(ACCELERATED, field_weakening__i_d_min_a=-30.0)
    seen = ramp(values, 40.0, (400, 800))
    assert seen["i"][:, 0].min() >= -30.3
    assert seen["i"][-1, 0] == pytest.approx(-30, abs=0.1)
    assert abs(seen["u_ss"][-1] / V_M - 1) < 2e-3  # i_q gives way instead
    assert seen["torque"][-1] < 38.0
