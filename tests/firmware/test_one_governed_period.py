# SPDX-License-Identifier: MIT
"""One governed period of the core in double from a random memory, against solvers that are written out here."""

from __future__ import annotations

import cmath
import math

import numpy as np
import pytest
from scipy.optimize import brentq

from pmsmtool.firmware.core_binding import core
from tests.firmware.closed_loop import (
    BEST,
    CURRENT_ROW,
    FLAG_ACTIVE,
    FLAG_FALLBACK,
    HEXAGON,
    LINE,
    LINEARISED,
    MINIMUM_TIME,
    MODE_CURRENT,
    MODE_TORQUE,
    OBSERVE,
    PAPER,
    PRE_PROJECTION,
    PREDICTOR,
    RPM,
    Loop,
    reference_case,
)
from tests.firmware.governor_rows import Table1, paper_rows
from tests.firmware.test_one_period import close, dq, flux, put, saturated, turned

V_DC, STEERED, EMPTY, NONE = 210.0, 250, 254, 255
NEAREST_A = 3e-5
"""Of the exchange from the enumeration; measured 9e-6, by binary32 parameters."""
BINDING_STEADY = 253
TIME, DIRECTION = 2e-3, 1e-3
"""Of T and V: the search ends where the gap is below 1 % of V T, with a last Newton step; measured 8e-4, 3e-4."""


def governed(mode: int, **changes: float) -> Loop:
    loop = Loop(core(double=True), reference_case(4000.0, governor__mode=mode, **changes), omega=1.0, U_dc=V_DC)
    loop.step(mode=MODE_CURRENT)
    return loop


def nearest_under_planes(a: np.ndarray, b: np.ndarray, r: np.ndarray) -> tuple[np.ndarray | None, set[int]]:
    """Of r itself, its foot on each line and each corner, the nearest that all planes allow; and the planes there."""
    size = np.linalg.norm(a, axis=1)
    a, b = a / size[:, None], b / size
    j, k = np.triu_indices(len(b), 1)
    det = a[j, 0] * a[k, 1] - a[j, 1] * a[k, 0]
    j, k, det = j[abs(det) > 1e-9], k[abs(det) > 1e-9], det[abs(det) > 1e-9]
    corners = [(b[j] * a[k, 1] - b[k] * a[j, 1]) / det, (b[k] * a[j, 0] - b[j] * a[k, 0]) / det]
    points = np.concatenate([[r], r - (a @ r - b)[:, None] * a, np.stack(corners, axis=1)])
    allowed = points[(points @ a.T - b).max(axis=1) < 1e-9]
    if not len(allowed):
        return None, set()
    x = allowed[np.linalg.norm(allowed - r, axis=1).argmin()]
    return x, set(np.flatnonzero(np.abs(a @ x - b) < 1e-6).tolist())


@pytest.mark.parametrize("k_max", [0, 3, 200])
def test_linearised_rows_are_the_papers_with_octagons(k_max: int) -> None:
    """The nearest point under all faces of all rows, by enumeration; the binding row is one of its faces'."""
    eps = 0.02
    loop, rng = governed(LINEARISED, governor__eps=eps, governor__k_max=k_max), np.random.default_rng(1)
    machine, seen = Table1(T_s=loop.plant.T_s), set()
    rows_most = min(k_max, 15)
    normals = np.array([[math.cos(k * math.pi / 4), math.sin(k * math.pi / 4)] for k in range(8)])
    for _ in range(25 if k_max < 100 else 8):
        omega = loop.plant.omega = float(rng.uniform(-900, 900)) * RPM
        i = loop.plant.i = rng.uniform(-25, 25, 2)
        x = put(loop.state.integrator, rng.uniform(-15, 15, 2))
        target = rng.uniform(-45, 45, 2)
        live = loop.step(mode=MODE_CURRENT, i_d_ref=target[0], i_q_ref=target[1])
        v = np.array([live.i_d_ref, live.i_q_ref])
        rows = paper_rows(machine, omega, i, x / machine.gains[2], rows_most, eps)
        a = np.concatenate([normals @ M for M, _, _ in rows])
        b = np.concatenate([math.cos(math.pi / 8) * V - normals @ c for _, c, V in rows])
        expected, faces = nearest_under_planes(a, b, target)
        assert bool(live.flags & FLAG_FALLBACK) == (expected is None)
        if expected is not None:
            assert np.abs(v - expected).max() < NEAREST_A
            bound = {BINDING_STEADY if face // 8 == len(rows) - 1 else face // 8 for face in faces} or {NONE}
            assert live.binding in bound
            assert bool(live.flags & FLAG_ACTIVE) == (live.binding != NONE)
            seen |= bound
    assert len(seen) > 1


def test_observe_says_what_the_rows_would_and_lets_the_reference_pass() -> None:
    """As the law of the same rows, which does not let it pass."""
    settings = {
        "governor__eps": 0.01,
        "governor__observer_gain": 0.0,
        "governor__options": CURRENT_ROW,
        "governor__I_transient_apk": 30.0,
    }
    watching, acting = governed(OBSERVE, **settings), governed(BEST, **settings)
    rng, bindings = np.random.default_rng(2), set()
    for _ in range(60):
        omega, i, x, held = rng.choice([60.0, 600.0, 1200.0]) * rng.uniform(-1, 1) * RPM, *rng.uniform(-20, 20, (3, 2))
        target, live = rng.uniform(-90, 90, 2) * rng.choice([0.2, 1.0]), []
        for loop in (watching, acting):
            loop.plant.omega, loop.plant.theta, loop.plant.i = omega, 0.3, i.copy()
            put(loop.state.integrator, x)
            put(loop.state.reference_held, held)
            live.append(loop.step(mode=MODE_CURRENT, i_d_ref=target[0], i_q_ref=target[1]))
        request = np.array([live[0].i_d_req, live[0].i_q_req])
        close([live[0].i_d_ref, live[0].i_q_ref], request)
        if live[1].flags & FLAG_FALLBACK:
            assert live[0].binding == EMPTY
        else:
            assert live[0].binding == live[1].binding
            v, way = np.array([live[1].i_d_ref, live[1].i_q_ref]), request - held
            share = 1.0 if (v == request).all() else float(np.clip((v - held) @ way / (way @ way), 0.0, 1.0))
            assert live[1].kappa == pytest.approx(share, abs=1e-12)
            assert live[0].kappa == pytest.approx(share, abs=2e-6)  # row 0 is met to rounding afterwards
        bindings.add(live[0].binding)
    assert bindings == {0, 252, BINDING_STEADY, EMPTY, NONE}


def hexagon(angle: float, U_dc: float) -> float:
    """Radius (V) of the inverter's hexagon in a direction of the stator."""
    return U_dc / math.sqrt(3) / math.cos(angle % (math.pi / 3) - math.pi / 6)


def test_row_zero_reaches_to_the_hexagon() -> None:
    """Equal gains of both axes: the nearest reference keeps the direction of the demand, in which it is as long."""
    L = {f"motor__L_{axis}{kind}_h": 0.002 for axis in "dq" for kind in ("", "_app")}
    K = {f"current__K_p_{axis}_v_per_a": 8.0 for axis in "dq"}
    loop = governed(BEST, governor__options=HEXAGON, governor__observer_gain=0.0, **L, **K)
    rng = np.random.default_rng(3)
    for _ in range(30):
        omega = loop.plant.omega = rng.uniform(-200, 200) * RPM
        loop.plant.i, theta = rng.uniform(-10, 10, 2), loop.plant.theta
        x = put(loop.state.integrator, rng.uniform(-5, 5, 2))
        target = 38.0 * np.array([math.cos(k := rng.uniform(0, 2 * math.pi)), math.sin(k)])
        live = loop.step(mode=MODE_CURRENT, i_d_ref=target[0], i_q_ref=target[1])
        i, psi = np.array([live.i_d, live.i_q]), loop.params.motor_psi_f_wb
        asked = 8.0 * (target - i) + x + omega * np.array([-0.002 * i[1], 0.002 * i[0] + psi])
        angle = cmath.phase(complex(*asked)) + theta + 0.5 * loop.plant.T_s * omega
        size = math.hypot(*asked)
        radius = hexagon(angle, V_DC)
        assert size > radius
        assert [live.u_d, live.u_q] == pytest.approx(asked * radius / size, abs=1e-4)  # measured 6e-5: INSIDE
        assert live.binding == 0


@pytest.mark.parametrize("law", ["now", "predicted", "late", "saturated"])
def test_the_minimum_time_direction(law: str) -> None:
    """|m(T)| = V T by a bracketing search for the smallest T, the voltage of the period along m(T)."""
    changes: dict[str, float] = {
        "governor__options": MINIMUM_TIME | (PREDICTOR if law == "predicted" else 0),
        "governor__I_transient_apk": 300.0,
        "inverter__delay_periods": {"predicted": 1.5, "late": 1.0}.get(law, 0.5),
    }
    if law == "saturated":
        loop, _ = saturated(governor__mode=BEST, inverter__voltage_utilisation=1 / math.sqrt(3), **changes)
        loop.U_dc = loop.measurement.U_dc = V_DC
    else:
        loop = governed(BEST, **changes)
    p, state, plant, rng = loop.params, loop.state, loop.plant, np.random.default_rng(4)
    V, T_s, R, found = p.inverter_voltage_utilisation * V_DC, plant.T_s, p.motor_R_s_ohm, 0
    rpm, size = (150.0, 9.0) if law == "saturated" else (600.0, 45.0)
    for _ in range(120):
        omega = plant.omega = float(rng.choice([-1, 1]) * rng.uniform(0.3, 1.0) * rpm) * RPM
        plant.i, theta = rng.uniform(-size, size, 2), plant.theta
        target, acting = rng.uniform(-size, size, 2), rng.uniform(-60, 60, 2)
        put(state.integrator, rng.uniform(-2, 2, 2))
        put(state.disturbance, rng.uniform(-2, 2, 2))
        state.voltage_committed.d, state.voltage_committed.q = acting
        state.time_to_go, state.landing = 0.0, 0
        live = loop.step(mode=MODE_CURRENT, i_d_ref=target[0], i_q_ref=target[1])
        if live.binding != STEERED:
            continue
        d, i = dq(state.disturbance), np.array([live.i_d, live.i_q])  # as the observer has left it
        m = state.local if law == "saturated" else state.derived.nominal
        psi, drop = np.array([m.psi_f + m.L_d_app * i[0], m.L_q_app * i[1]]), 0.5 * T_s * R
        if law in ("predicted", "late"):
            L, fixed = np.array([m.L_d, m.L_q]), psi + T_s * (turned(acting, theta) - d) - drop * i
            ahead = (L * i + turned(fixed, omega * T_s) - psi) / (L + drop)
            psi, i = turned(fixed, omega * T_s) - drop * ahead, ahead
        b = flux(target) if law == "saturated" else (m.psi_f + m.L_d_app * target[0], m.L_q_app * target[1])
        halves = 0.5 * complex(*(R * i + d)), 0.5 * complex(*(R * target + d))

        def way(T: float, start: complex, end: complex, halves: tuple[complex, complex], omega: float) -> complex:
            turn = cmath.exp(1j * omega * T)
            return turn * end - start + (halves[0] + turn * halves[1]) * T

        case = complex(*psi), complex(*b), halves, omega
        grid = np.linspace(T_s, 120 * T_s, 1500)
        first = next(k for k, T in enumerate(grid) if abs(way(T, *case)) < V * T)
        T = brentq(lambda T, *case: abs(way(T, *case)) - V * T, grid[first - 1], grid[first], args=case)
        w = way(T, *case) * cmath.exp(-0.5j * omega * T_s)
        assert state.time_to_go == pytest.approx(T, rel=TIME)
        assert abs(complex(live.u_d, live.u_q) - w * V / abs(w)) < DIRECTION * V
        assert state.landing == (law != "late")
        found += 1
    assert found > 20


@pytest.mark.parametrize("axis", ["d", "q"])
def test_a_controller_without_a_proportional_part_is_not_governed(axis: str) -> None:
    loop = governed(BEST, **{f"current__K_p_{axis}_v_per_a": 0.0})
    live = loop.step(mode=MODE_CURRENT, i_d_ref=-50.0, i_q_ref=10.0)
    close([live.i_d_ref, live.i_q_ref, live.binding, live.kappa], [-50.0, 10.0, NONE, 1.0])


@pytest.mark.parametrize("alpha", [4000.0, 9000.0])
def test_a_transfer_lands_with_a_quarter_of_its_error(alpha: float) -> None:
    """On the machine's model, as far as the request is admissible; far from the end not beyond the voltage."""
    loop = Loop(core(double=True), reference_case(alpha, governor__mode=BEST, governor__options=MINIMUM_TIME,
                                                  governor__observer_gain=0.0), omega=50.0, U_dc=V_DC)  # fmt: skip
    loop.step(mode=MODE_CURRENT)
    p, state, T_s = loop.params, loop.state, loop.plant.T_s
    L, K = (np.array([getattr(p, name.format(axis)) for axis in "dq"])
            for name in ("motor_L_{}_h", "current_K_p_{}_v_per_a"))  # fmt: skip
    gain = 0.74 * L / (K * T_s)
    assert (gain > 1.0).all() == (alpha < 5000)
    for step, left, landing in ((1.0, 2.0, 1), (1.0, 20.0, 1), (6.0 if alpha < 5000 else 2.0, 20.0, 1), (1.0, 2.0, 0)):
        i, r = np.array([2.0, 3.0]), np.array([2.0, 3.0]) + step
        loop.plant.i = i.copy()
        put(state.integrator, np.array([0.0, 0.0]))
        state.landing, state.time_to_go = landing, left * T_s
        live = loop.step(mode=MODE_CURRENT, i_d_ref=r[0], i_q_ref=r[1])
        i = np.array([live.i_d, live.i_q])
        lands = landing and gain[0] > 1.0
        expected = i + gain * (r - i) if lands else r
        u = K * (expected - i) + loop.plant.omega * np.array([-p.motor_L_q_app_h * i[1],
                                                             p.motor_L_d_app_h * i[0] + p.motor_psi_f_wb])  # fmt: skip
        beyond = math.hypot(*u) > p.inverter_voltage_utilisation * V_DC
        assert beyond == (step == 6.0 and bool(lands))
        close([live.i_d_ref, live.i_q_ref], r if beyond else expected, 10.0)
        assert (live.binding == STEERED) == (landing and not beyond)
        assert (state.landing, state.time_to_go) == (0, 0.0)


def test_a_transfer_waits_while_the_look_up_searches() -> None:
    """A torque far beyond the current limit: the period has time for row 0 alone, the transfer stays as it is."""
    torque = np.linspace(-80.0, 80.0, 17)
    i_q = np.repeat(torque[:, None] / 2.0, 2, axis=1)
    parts = (torque, [0.0, 1000.0], [V_DC], np.zeros((17, 2)), i_q)
    lut = b"".join(np.asarray(part, dtype=np.float32).tobytes() for part in parts)
    descriptor = {"format": 1, "n_x": 17, "n_y": 2, "n_z": 1, "axis_kind": 0}
    equal = {f"motor__L_{axis}{kind}_h": 0.002 for axis in "dq" for kind in ("", "_app")}
    equal |= {f"current__K_p_{axis}_v_per_a": 8.0 for axis in "dq"}
    values = reference_case(
        4000.0, governor__mode=BEST, governor__options=MINIMUM_TIME, governor__observer_gain=0.0, motor__I_max_apk=18.0,
        protection__I_cont_apk=18.0, field_weakening__mode=1, **equal,
        **{f"lut__{key}": value for key, value in descriptor.items()},
    )  # fmt: skip
    loop = Loop(core(double=True), values, omega=100.0, U_dc=V_DC, lut=lut)
    loop.step(mode=MODE_TORQUE)
    for tau, searching in ((75.0, True), (-75.0, True), (30.0, False)):
        loop.plant.i = np.array([0.0, 0.0])
        loop.state.lut_cut, loop.state.time_to_go = 0, 5 * loop.plant.T_s
        x = put(loop.state.integrator, np.array([-90.0, 10.0]))
        live = loop.step(mode=MODE_TORQUE, tau_ref=tau)
        request = np.array([live.i_d_req, live.i_q_req])
        close(request, [0.0, math.copysign(min(abs(tau) / 2.0, 18.0), tau)])
        assert (live.binding == 0 and loop.state.time_to_go == 5 * loop.plant.T_s) == searching
        if searching:
            u = 8.0 * request + x + [0.0, loop.plant.omega * loop.params.motor_psi_f_wb]
            V = loop.params.inverter_voltage_utilisation * V_DC
            assert [live.u_d, live.u_q] == pytest.approx(u * V / math.hypot(*u), abs=1e-4)


class Hasty(Table1):
    """Integrators that do not cancel the plant's pole: the largest voltage may be a predicted one."""

    @property
    def gains(self) -> tuple[float, float, float]:
        return self.alpha * self.L_d, self.alpha * self.L_q, 60.0 * self.alpha * self.R


def test_a_request_passes_where_all_rows_of_the_paper_admit_it() -> None:
    """Along its own trajectory, whatever the integrators hold: as (20) and (27) say of row after row."""
    k_max, eps = 6, 0.01
    K_i = {f"current__K_i_{axis}_v_per_as": Hasty().gains[2] for axis in "dq"}
    loop, rng = governed(PAPER, governor__eps=eps, governor__k_max=k_max, **K_i), np.random.default_rng(6)
    machine, seen = Hasty(T_s=loop.plant.T_s), []
    for _ in range(200):
        omega = loop.plant.omega = float(rng.uniform(-700, 700)) * RPM
        i = loop.plant.i = rng.uniform(-20, 20, 2)
        x = put(loop.state.integrator, rng.uniform(-110, 110, 2))
        target = i + rng.uniform(-15, 15, 2)
        live = loop.step(mode=MODE_CURRENT, i_d_ref=target[0], i_q_ref=target[1])
        rows = paper_rows(machine, omega, i, x / machine.gains[2], k_max, eps)
        excess = [math.hypot(*(M @ target + c)) / V - 1.0 for M, c, V in rows]
        if abs(max(excess)) > 1e-4:
            assert bool(live.flags & FLAG_ACTIVE) == (max(excess) > 0.0)
            only = max(excess) > 0.0 and max(excess[0], excess[-1]) < 0.0  # rows that are predicted, one by one
            seen.append(tuple(np.flatnonzero(np.array(excess) > 0.0).tolist()) if only else max(excess) > 0.0)
    assert {False, True, (1, 2), (k_max,)} <= set(seen)


@pytest.mark.parametrize("mode", [BEST, LINE])
def test_without_a_current_row_the_reachable_request_knows_none(mode: int) -> None:
    """A voltage limit below the current, in numbers: 23 V, 40 A."""
    loop = governed(mode, governor__options=PRE_PROJECTION, governor__observer_gain=0.0)
    put(loop.state.reference_held, np.array([0.0, 40.0]))
    loop.measurement.U_dc, loop.plant.omega, loop.plant.i = 40.0, 5.0, np.array([0.0, 40.0])
    put(loop.state.integrator, np.array([0.0, 0.0]))
    live = loop.step(mode=MODE_CURRENT, i_d_ref=0.0, i_q_ref=40.0)
    close([live.i_d_ref, live.i_q_ref, live.binding], [0.0, 40.0, NONE])
    assert (loop.state.reachable_age, loop.state.cornered) == (0, 0)
