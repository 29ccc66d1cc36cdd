# SPDX-License-Identifier: MIT
"""One period of the core in double from a random memory, against its equations written out with numpy and scipy."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator
from scipy.signal import bilinear, lfilter

from pmsmtool.firmware.core_binding import core
from tests.firmware.closed_loop import (
    BEST,
    FLAG_CURRENT,
    FLAG_DUTY,
    FLAG_I2T,
    FLAG_VOLTAGE,
    HEXAGON,
    MODE_CURRENT,
    MODE_SPEED,
    MODE_TORQUE,
    MODE_VOLTAGE,
    Loop,
    tuned,
)

NEAR = 1e-9
"""Of the size of each number; measured below 2e-12."""
MODE_POSITION = 6
THIRD = 2 * math.pi / 3


def loop_of(*, omega: float = 400.0, U_dc: float = 300.0, lut: bytes = b"", **changes: float) -> tuple[Loop, Any]:
    """A loop in double that has made its first period, and its parameters as the core holds them."""
    loop = Loop(core(double=True), tuned(**changes), omega=omega, U_dc=U_dc, lut=lut)
    loop.step(mode=MODE_CURRENT)
    return loop, {name: float(np.float32(value)) for name, value in loop.values.items()}


def turned(x: np.ndarray, angle: float) -> np.ndarray:
    """A vector of a frame as a frame ahead by an angle sees it."""
    z = complex(*x) * np.exp(-1j * angle)
    return np.array([z.real, z.imag])


def dq(x: Any) -> np.ndarray:
    return np.array([x.d, x.q])


def put(target: Any, x: np.ndarray) -> np.ndarray:
    target.d, target.q = (float(value) for value in x)
    return x


def close(found: Any, expected: Any, size: float = 1.0) -> None:
    np.testing.assert_allclose(np.asarray(found, float), np.asarray(expected, float), rtol=NEAR, atol=NEAR * size)


N_D, N_Q, I_D, I_Q_MAX = 4, 3, (-20.0, 5.0), 15.0


def nodes() -> np.ndarray:
    """psi_d, psi_q/i_q, L_d, L_q at the nodes of a table that no machine has."""
    rng = np.random.default_rng(2)
    shape = (N_D, N_Q)
    return np.stack([rng.uniform(-0.3, 0.3, shape), *rng.uniform(2e-3, 2e-2, (3, *shape))], axis=-1).astype(np.float32)


def saturated(**changes: float) -> tuple[Loop, Any]:
    table = {"n_d": N_D, "n_q": N_Q, "i_d_min_a": I_D[0], "i_d_max_a": I_D[1], "i_q_max_a": I_Q_MAX}
    return loop_of(lut=nodes().tobytes(), **{f"saturation__{key}": value for key, value in table.items()} | changes)


def at_nodes(i: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The table's nearest point to a current (A, i_q without its sign), and what it has there."""
    axes = np.linspace(*I_D, N_D), np.linspace(0.0, I_Q_MAX, N_Q)
    edge = np.array([np.clip(i[0], *I_D), min(abs(i[1]), I_Q_MAX)])
    return edge, RegularGridInterpolator(axes, nodes().astype(float))(edge)[0]


def flux(i: np.ndarray) -> tuple[float, float]:
    """psi_d, psi_q (Wb): bilinear between the nodes; beyond them it goes on with the inductances of the edge."""
    edge, (psi_d, apparent, L_d, L_q) = at_nodes(i)
    return psi_d + L_d * (i[0] - edge[0]), math.copysign(apparent * edge[1] + L_q * (abs(i[1]) - edge[1]), i[1])


def test_between_and_beyond_the_nodes_of_the_saturation_table() -> None:
    loop, v = saturated()
    rng = np.random.default_rng(3)
    points = [*rng.uniform((-40, -30), (20, 30), (40, 2)), (I_D[0], 0.0), (I_D[1], -I_Q_MAX), (0.0, 2 * I_Q_MAX)]
    for point in points:
        loop.plant.i = np.array(point, dtype=float)
        live = loop.step(mode=MODE_CURRENT)
        i = np.array([live.i_d, live.i_q])
        (_, _, L_d, L_q), psi = at_nodes(i)[1], flux(i)
        m = loop.state.local
        close([m.L_d, m.L_q, m.L_d_app], [L_d, L_q, L_d])
        close([m.psi_f + m.L_d_app * i[0], m.L_q_app * i[1]], psi)
        gains = [v[f"current.K_p_{axis}_v_per_a"] / v[f"motor.L_{axis}_h"] for axis in "dq"]
        close(dq(m.K_p), [L_d * gains[0], L_q * gains[1]])
        close(live.tau, 1.5 * v["motor.pole_pairs"] * (psi[0] * i[1] - psi[1] * i[0]))


def test_a_destroyed_node_leaves_the_magnetics_and_at_first_those_of_the_parameters() -> None:
    for first in (True, False):
        loop, v = saturated()
        loop.plant.i = np.array([-12.0, 4.0])
        if not first:
            loop.step(mode=MODE_CURRENT)
        before = loop.state.local.L_d, loop.state.local.L_q_app
        for kind in range(4):
            lut = nodes()
            lut[..., kind] = math.nan
            loop.lut = (loop.lut._type_ * lut.size).from_buffer_copy(lut.tobytes())
            if first:
                loop.binding.library.pmsm_init(loop.state)
                before = v["motor.L_d_h"], v["motor.L_q_app_h"]
            loop.plant.i = np.array([-2.0, 9.0])
            loop.step(mode=MODE_CURRENT)
            assert (loop.state.local.L_d, loop.state.local.L_q_app) == before


@pytest.mark.parametrize(("options", "delay"), [(23, 1.5), (16, 1.5), (17, 1.0), (20, 1.0)])
def test_the_predictor_and_what_the_integrators_see(options: int, delay: float) -> None:
    """The stator flux under the voltage that acts, R_s i at the mean current of the period."""
    loop, v = loop_of(U_dc=150.0, current__options=options, inverter__delay_periods=delay)
    rng, state, plant = np.random.default_rng(4), loop.state, loop.plant
    T_s, R = plant.T_s, v["motor.R_s_ohm"]
    L, app = (np.array([v[f"motor.L_{axis}{kind}_h"] for axis in "dq"]) for kind in ("", "_app"))
    K_p = np.array([v[f"current.K_p_{axis}_v_per_a"] for axis in "dq"])
    K_i = np.array([v[f"current.K_i_{axis}_v_per_as"] for axis in "dq"])
    psi_f, limited = np.array([v["motor.psi_f_wb"], 0.0]), 0
    for _ in range(20):
        plant.omega = omega = rng.uniform(-900, 900)
        plant.i = rng.uniform(-30, 30, 2)
        x, lost = put(state.integrator, rng.uniform(-9, 9, 2)), put(state.disturbance, rng.uniform(-9, 9, 2))
        acting, realised = rng.uniform(-70, 70, 2), put(state.reference_realised, rng.uniform(-30, 30, 2))
        state.voltage_committed.d, state.voltage_committed.q = acting
        theta = plant.theta
        asked = rng.uniform(-25, 25, 2)
        live = loop.step(mode=MODE_CURRENT, i_d_ref=asked[0], i_q_ref=asked[1])
        i = np.array([live.i_d, live.i_q])
        psi, drop = psi_f + app * i, 0.5 * T_s * R
        fixed = turned(psi + T_s * (turned(acting, theta) - lost) - drop * i, omega * T_s)
        ahead = (L * i + fixed - psi) / (L + drop)
        rotation = omega * np.array([-app[1] * ahead[1], app[0] * ahead[0]]) * (options & 1)
        rotation[1] += omega * psi_f[0] * (options >> 1 & 1)
        u = K_p * (asked - ahead) + x + rotation
        close([live.u_d, live.u_q], u, 100.0)
        close(dq(state.integrator), x + T_s * K_i * (realised - i), 10.0)
        made = np.array([live.u_d_lim, live.u_q_lim])
        V_max = v["inverter.voltage_utilisation"] * loop.U_dc
        close(made, u * min(1.0, V_max / math.hypot(*u)), 100.0)
        cut = (made - u) if options & 4 else np.zeros(2)
        close(dq(state.reference_realised), asked + cut / K_p, 100.0)
        limited += bool(live.flags & FLAG_VOLTAGE)
    assert 0 < limited < 20


def test_a_controller_without_a_proportional_part_holds_at_the_limit() -> None:
    loop, v = loop_of(U_dc=20.0, current__K_p_d_v_per_a=0.0, current__K_p_q_v_per_a=0.0, current__options=4)
    loop.plant.i = np.array([3.0, -4.0])
    put(loop.state.integrator, np.array([0.0, 30.0]))
    live = loop.step(mode=MODE_CURRENT, i_d_ref=0.0, i_q_ref=8.0)
    assert live.flags & FLAG_VOLTAGE
    close(dq(loop.state.reference_realised), [0.0, live.i_q])
    close(loop.state.integrator.q, 30.0)
    close(loop.state.integrator.d, loop.plant.T_s * v["current.K_i_d_v_per_as"] * (0.0 - live.i_d))


@pytest.mark.parametrize("gain", [0.3, 0.0])
@pytest.mark.parametrize("mode", [MODE_SPEED, MODE_POSITION])
def test_the_speed_controller(mode: int, gain: float) -> None:
    """Ramp, PI, limit, and what the integrator learns of torque that was not granted."""
    loop, v = loop_of(
        speed__decimation=3, speed__K_p_nms_per_rad=gain, speed__K_i_nm_per_rad=7.0, speed__tau_max_nm=4.0,
        speed__acceleration_rpm_per_s=900.0, speed__filter_hz=200.0, field_weakening__i_d_lm_a=-3.0,
        motor__L_q_app_h=0.02,
    )  # fmt: skip
    rng, state, p = np.random.default_rng(5), loop.state, v["motor.pole_pairs"]
    T_s = loop.plant.T_s
    T, slope = 3 * T_s, 900.0 * math.pi / 30.0 * 3 * T_s
    step = 2 * math.pi * 200.0 * T_s
    for _ in range(60):
        state.speed_count = int(rng.integers(0, 3))
        count, last = state.speed_count, float(rng.choice([rng.uniform(-4, 4), 0.0]))
        state.tau_speed, state.tau_granted = last, rng.uniform(-5, 5)
        state.speed_integrator, state.omega_ref_ramped = rng.uniform(-3, 3), rng.uniform(-20, 20)
        state.omega_filtered = rng.uniform(-20, 20)
        x, ramped, granted, filtered = (
            state.speed_integrator, state.omega_ref_ramped, state.tau_granted / 0.95, state.omega_filtered,
        )  # fmt: skip
        asked, ahead = float(rng.choice([ramped, rng.uniform(-30, 30)])), rng.uniform(-2, 2)
        omega = loop.plant.omega = rng.uniform(-300, 300)
        live = loop.step(mode=mode, omega_M_ref=asked, tau_ref=ahead)
        filtered += step / (1 + step) * (omega / p - filtered)
        close(state.omega_filtered, filtered)
        assert state.speed_count == (count or 3) - 1
        if count == 0:
            ramped = asked if mode == MODE_POSITION else ramped + np.clip(asked - ramped, -slope, slope)
            wanted = gain32(gain) * (ramped - filtered) + x + (ahead if mode == MODE_POSITION else 0.0)
            limited = np.clip(wanted, -4.0, 4.0)
            between = np.clip(granted, min(last, 0.0), max(last, 0.0))  # of what was asked, in its direction
            back = (limited - wanted + between - last) / gain32(gain) if gain else 0.0
            close(state.omega_ref_ramped, ramped)
            close(state.speed_integrator, x + T * 7.0 * (ramped - filtered + back))
            close(state.tau_speed, limited)
            last = float(limited)
        saliency = v["motor.L_d_app_h"] - v["motor.L_q_app_h"]
        close([live.i_d_req, live.i_q_req], [-3.0, last / (1.5 * p * (v["motor.psi_f_wb"] + saliency * -3.0))])
        flux = v["motor.psi_f_wb"] + saliency * live.i_d_req
        close(state.tau_granted, 1.5 * p * flux * live.i_q_req)


def gain32(gain: float) -> float:
    return float(np.float32(gain))


def test_a_torque_that_no_current_makes_asks_for_none() -> None:
    for L_q, psi, i_d, there in ((0.02, 0.0, 0.0, 0.0), (0.02, 0.01, 30.0, 0.0), (0.02, 0.01, -30.0, 1.0)):
        loop, v = loop_of(motor__psi_f_wb=psi, motor__L_q_app_h=L_q, field_weakening__i_d_lm_a=i_d)
        live = loop.step(mode=MODE_TORQUE, tau_ref=2.0)
        flux = v["motor.psi_f_wb"] + (v["motor.L_d_app_h"] - v["motor.L_q_app_h"]) * i_d
        close(live.i_q_req, there * 2.0 / (1.5 * v["motor.pole_pairs"] * flux) if there else 0.0)


def test_the_notch_is_the_bilinear_one() -> None:
    loop, v = loop_of(
        speed__notch_hz=300.0, speed__notch_zeta_num=0.05, speed__notch_zeta_den=0.4, speed__decimation=2,
        speed__K_p_nms_per_rad=1.0, speed__K_i_nm_per_rad=0.0, speed__tau_max_nm=1e3, speed__filter_hz=1e5,
        speed__acceleration_rpm_per_s=1e9, protection__I_cont_apk=1e5, motor__I_max_apk=1e5,
    )  # fmt: skip
    T = 2 * loop.plant.T_s
    w = 2 / T * math.tan(math.pi * 300.0 * T)
    zeta = [v[f"speed.notch_zeta_{part}"] for part in ("num", "den")]
    b, a = bilinear([1, 2 * zeta[0] * w, w * w], [1, 2 * zeta[1] * w, w * w], 1 / T)
    rng, asked, given = np.random.default_rng(6), [], []
    for _ in range(40):
        loop.state.speed_count, loop.state.speed_integrator, loop.state.tau_granted = 0, 0.0, loop.state.tau_speed
        omega = rng.uniform(-50, 50)
        loop.step(mode=MODE_SPEED, omega_M_ref=omega)
        asked.append(loop.state.omega_ref_ramped - loop.state.omega_filtered)
        given.append(loop.state.tau_speed)
    close(given, lfilter(b, a, asked), 100.0)


def test_no_notch_at_zero_and_near_the_nyquist_frequency() -> None:
    rate = 1e9 / tuned()["inverter.T_s_ns"] / 2
    for share, there in ((0.0, False), (0.45001, False), (0.44999, True), (0.01, True)):
        loop, _ = loop_of(speed__notch_hz=share * rate, speed__decimation=2)
        assert (loop.state.derived.notch_b0 > 0.0) == there


def test_the_thermal_budget_of_a_current() -> None:
    """Of random currents: the integral of i^2 - I_cont^2 over that of I_max; used up at 1, back below 0.9."""
    loop, _ = loop_of(motor__I_max_apk=40.0, protection__I_cont_apk=20.0, motor__I_max_time_s=0.01)
    rng, budget, exhausted, seen = np.random.default_rng(7), 0.0, False, set()
    loop.state.i2t = 0.0
    for k in range(500):
        loop.plant.i = rng.uniform(-1, 1, 2) * (60.0 if 50 < k < 200 else 8.0)
        live = loop.step(mode=MODE_CURRENT, i_q_ref=35.0)
        square = live.i_d**2 + live.i_q**2
        budget += loop.plant.T_s / 0.01 * (square - 20.0**2) / (40.0**2 - 20.0**2)
        budget = min(max(budget, 0.0), 1.0)
        exhausted = budget == 1.0 or (exhausted and budget >= 0.9)
        assert loop.state.i2t == pytest.approx(budget, rel=1e-6, abs=1e-6)  # I_max_time_s is a float
        assert bool(live.flags & FLAG_I2T) == exhausted
        close(live.i_q_req, 20.0 if exhausted else 35.0)
        seen.add((exhausted, budget in (0.0, 1.0)))
    assert len(seen) == 4
    loop, _ = loop_of(motor__I_max_apk=40.0, protection__I_cont_apk=20.0, motor__I_max_time_s=0.0)
    assert loop.state.derived.i2t_rate == 0.0
    close(loop.step(mode=MODE_CURRENT, i_q_ref=35.0).i_q_req, 20.0)
    loop, _ = loop_of(motor__I_max_apk=20.0, protection__I_cont_apk=40.0, motor__I_max_time_s=0.0)
    close(loop.step(mode=MODE_CURRENT, i_q_ref=35.0).i_q_req, 20.0)
    loop.plant.i = np.array([50.0, 0.0])
    assert loop.step(mode=MODE_CURRENT).flags & FLAG_I2T == 0 and loop.state.i2t == 0.0


@pytest.mark.parametrize("U_dc", [300.0, 96.0])
@pytest.mark.parametrize("record", [0, 32])
def test_dead_time_compensation_and_its_record(record: int, U_dc: float) -> None:
    loop, _ = loop_of(
        inverter__deadtime_compensation=1, inverter__V_dead_v=3.0, inverter__i_knee_apk=2.0, current__options=record,
        inverter__delay_periods=1.5, U_dc=U_dc,
    )  # fmt: skip
    rng, plant, clipped = np.random.default_rng(8), loop.plant, 0
    for _ in range(20):
        plant.i, plant.omega = rng.uniform(-4, 4, 2), rng.uniform(-900, 900)
        angle = plant.theta + 1.5 * plant.T_s * plant.omega
        u = 55.0 * np.array([math.cos(k := rng.uniform(0, 2 * math.pi)), math.sin(k)])
        live = loop.step(mode=MODE_VOLTAGE, u_d_inject=u[0], u_q_inject=u[1])
        i = complex(live.i_d, live.i_q) * np.exp(1j * angle)
        legs = np.exp(-1j * THIRD * np.arange(3))
        error = 3.0 * np.clip((i * legs).real / 2.0, -1, 1)
        lost = 2 / 3 * error @ legs.conj() * np.exp(-1j * angle)
        out = loop.output
        made = 2 / 3 * loop.U_dc * np.array([out.duty_a, out.duty_b, out.duty_c]) @ legs.conj()
        close([live.u_d, live.u_q], u, 100.0)
        rest = made * np.exp(-1j * angle) - lost
        shown = rest + (lost if record else 0.0)
        close([live.u_d_lim, live.u_q_lim], [shown.real, shown.imag], 100.0)
        close((max(out.duty_a, out.duty_b, out.duty_c) + min(out.duty_a, out.duty_b, out.duty_c)), 1.0)
        clipped += bool(live.flags & FLAG_DUTY)
        if not live.flags & FLAG_DUTY:
            close([rest.real, rest.imag], u, 100.0)
    assert (clipped > 1) == (U_dc < 100.0)


def test_at_the_voltage_limit_weakening_leaves_i_q_its_share() -> None:
    """Only after a limited period, outside current mode, and where the voltage still reduces i_q."""
    loop, v = loop_of(field_weakening__i_d_min_a=-100.0, field_weakening__i_d_lm_a=-38.0, U_dc=300.0,
                      motor__I_max_apk=40.0, protection__I_cont_apk=40.0)  # fmt: skip
    for i_q, omega, limited in ((30.0, 300.0, True), (30.0, 300.0, False), (30.0, 2500.0, True), (10.0, 300.0, True),
                                (45.0, 300.0, True)):  # fmt: skip
        loop.plant.i, loop.plant.omega = np.array([-5.0, i_q]), omega
        loop.state.live.flags = FLAG_VOLTAGE if limited else 0
        live = loop.step(mode=MODE_TORQUE, tau_ref=0.0)
        V_max = v["inverter.voltage_utilisation"] * loop.U_dc
        flux = v["motor.psi_f_wb"] + v["motor.L_d_app_h"] * live.i_d
        reduces = abs(v["motor.R_s_ohm"] * live.i_q + loop.measurement.omega_e * flux) < V_max
        rest = 40.0**2 - live.i_q**2
        least = -math.sqrt(rest) if limited and reduces and rest > 0 else -math.inf
        assert reduces == (omega < 1000)
        close([live.i_d_req, live.i_d_ref], [-38.0, max(-38.0, least)])
    live = loop.step(mode=MODE_TORQUE, tau_ref=1e4)
    assert live.flags & FLAG_CURRENT
    close(math.hypot(live.i_d_req, live.i_q_req), 40.0)
    loop, _ = loop_of(field_weakening__i_d_min_a=-10.0, field_weakening__i_d_lm_a=-38.0)
    live = loop.step(mode=MODE_TORQUE, tau_ref=0.0)
    assert live.flags & FLAG_CURRENT
    close([live.i_d_req, live.i_q_req], [-10.0, 0.0])


@pytest.mark.parametrize("delay", [0.5, 1.0, 1.5])
def test_the_current_of_the_harmonics_is_taken_out(delay: float) -> None:
    loop, v = loop_of(inverter__voltage_utilisation=0.63, inverter__delay_periods=delay, current__options=0)
    state, plant, rng = loop.state, loop.plant, np.random.default_rng(9)
    assert state.derived.overmodulates
    T_s, R, L = plant.T_s, v["motor.R_s_ohm"], np.array([v["motor.L_d_h"], v["motor.L_q_h"]])
    for _ in range(10):
        plant.i, theta = rng.uniform(-20, 20, 2), plant.theta
        names = ("harmonic_committed", "harmonic_before", "harmonic_flux", "harmonic_mean")
        committed, before, flux, mean = (put(getattr(state, name), rng.uniform(-0.1, 0.1, 2)) for name in names)
        phases = plant.phases()
        live = loop.step(mode=MODE_CURRENT)
        flux = (flux + T_s * (before if delay >= 1 else committed)) / (1 + T_s * R / L[0])
        close(dq(state.harmonic_flux), flux)
        i = turned(flux, theta) / L
        mean = mean + 0.02 * (i - mean)
        close(dq(state.harmonic_mean), mean)
        close(dq(state.harmonic_before), committed)
        sampled = 2 / 3 * np.array(phases) @ np.exp(1j * THIRD * np.arange(3)) * np.exp(-1j * theta)
        close([live.i_d, live.i_q], [sampled.real, sampled.imag])
        close(dq(state.current_before), [sampled.real, sampled.imag] - (i - mean))


def looked_up(torque: list[float], points: list[tuple[float, float]], tau: float, **changes: float) -> np.ndarray:
    """Request for a torque from a table of one speed and link."""
    cells = np.repeat(np.array(points, dtype=float)[:, None, :], 2, axis=1)
    parts = (torque, [-1e4, 1e4], [300.0], cells[..., 0], cells[..., 1])
    lut = b"".join(np.asarray(part, dtype=np.float32).tobytes() for part in parts)
    descriptor = {"lut__format": 1, "lut__n_x": len(torque), "lut__n_y": 2, "lut__n_z": 1}
    loop, _ = loop_of(lut=lut, field_weakening__mode=1, field_weakening__i_d_min_a=-7.0, motor__I_max_apk=8.0,
                      protection__I_cont_apk=8.0, **descriptor, **changes)  # fmt: skip
    loop.state.lut_cut = 0
    live = loop.step(mode=MODE_TORQUE, tau_ref=tau)
    return np.array([live.i_d_req, live.i_q_req])


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_torque_is_cut_where_the_way_from_none_leaves_the_limit(sign: float) -> None:
    """Between nodes either side of no torque; where even that takes more than the limit, i_d keeps its share."""
    way, share = np.array([-4.0, 12.0]), 0.25  # of the cell from -10 to 30 N m: no torque
    points = [np.zeros(2) - share * way, (1.0 - share) * way]
    order = 1 if sign > 0 else -1
    torque = [sign * x for x in (-10.0, 30.0)][::order]
    nodes_ = [(p[0], sign * p[1]) for p in points][::order]
    found = looked_up(torque, nodes_, sign * 29.0)
    close(found, np.array([way[0], sign * way[1]]) * 8.0 / math.hypot(*way))
    shifted = [(p[0] - 6.0, p[1] + sign * 6.0) for p in nodes_]  # no torque takes (-6, 6) A
    inside = (shifted[0] if sign > 0 else shifted[-1])[1] * sign
    assert inside < 6.0
    found = looked_up(torque, shifted, sign * 29.0)
    close(found, [-6.0, sign * math.sqrt(8.0**2 - 36.0)])


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_without_a_point_inside_the_limit_the_voltage_has_its_current(sign: float) -> None:
    hole = (math.nan, math.nan)
    torque = [sign * x for x in (0.0, 10.0, 20.0)][:: int(sign)]
    points = [hole, (-9.0, sign * 9.0), (-9.0, sign * 19.0)][:: int(sign)]
    close(looked_up(torque, points, sign * 15.0), [-7.0, 0.0])


def at_rest(**changes: float) -> Loop:
    """A loop whose angle, speed and current are exactly zero."""
    loop, _ = loop_of(omega=0.0, **changes)
    loop.plant.theta, loop.plant.i = 0.0, np.zeros(2)
    return loop


def test_what_is_exactly_at_a_limit_is_within_it() -> None:
    """Numbers that binary arithmetic meets exactly: 3, 4, 5; duties of 0 and 1; a current at its bound."""
    loop = at_rest(motor__I_max_apk=5.0, protection__I_cont_apk=5.0)
    live = loop.step(mode=MODE_CURRENT, i_d_ref=3.0, i_q_ref=4.0)
    assert (live.i_d_req, live.i_q_req, live.flags & FLAG_CURRENT) == (3.0, 4.0, 0)
    assert loop.state.derived.i2t_rate == 0.0 and loop.state.derived.saturates == 0
    loop = at_rest(current__options=8)
    live = loop.step(mode=MODE_VOLTAGE, u_d_inject=200.0, u_q_inject=0.0)
    assert (loop.output.duty_a, loop.output.duty_b, loop.output.duty_c) == (1.0, 0.0, 0.0)
    assert not live.flags & FLAG_DUTY
    assert loop.step(mode=MODE_VOLTAGE, u_d_inject=200.1).flags & FLAG_DUTY
    loop = at_rest(field_weakening__i_d_min_a=-8.0, field_weakening__i_d_lm_a=-8.0)
    live = loop.step(mode=MODE_TORQUE, tau_ref=0.0)
    assert (live.i_d_req, live.flags & FLAG_CURRENT) == (-8.0, 0)


@pytest.mark.parametrize("U_dc", [0.0, 1e-3, -5.0])
def test_no_link_voltage_makes_no_duties(U_dc: float) -> None:
    for changes in ({}, {"governor__mode": BEST}, {"polar__mode": 6}, {"inverter__voltage_utilisation": 0.63}):
        loop = at_rest(**changes)
        loop.measurement.U_dc = U_dc
        live = loop.step(mode=MODE_CURRENT, i_q_ref=3.0)
        out = loop.output
        assert (out.duty_a, out.duty_b, out.duty_c, loop.state.fault) == (0.5, 0.5, 0.5, 0)
        assert live.i_q_ref == 3.0 and loop.state.polar.delta == 0.0


def test_a_hexagon_without_a_demand_and_a_request_that_stands_still() -> None:
    loop = at_rest(governor__mode=BEST, governor__options=HEXAGON, governor__observer_gain=0.0)
    live = loop.step(mode=MODE_CURRENT, i_d_ref=0.0, i_q_ref=0.0)
    assert (loop.output.duty_a, live.kappa, live.i_q_ref) == (0.5, 1.0, 0.0)
    asked = loop.step(mode=MODE_CURRENT, i_q_ref=90.0).i_q_req
    put(loop.state.reference_held, np.array([0.0, asked]))
    loop.plant.i = np.zeros(2)
    live = loop.step(mode=MODE_CURRENT, i_q_ref=90.0)
    assert live.i_q_ref < asked and live.kappa == 0.0
