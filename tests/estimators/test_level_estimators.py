# SPDX-License-Identifier: MIT
"""Estimators of the lower capability levels on traces whose truth is written down: values, intervals, refusals."""

from __future__ import annotations

import contextlib
import math

import numpy as np
import pytest

from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.estimate import SensorTolerance, total_half_width
from pmsmtool.estimators.flux.voltage_flux import (
    DEAD_TIME,
    flux_by_undriven_voltage,
    flux_by_voltage_limit,
    voltage_drift,
)
from pmsmtool.estimators.recorded_push import estimate_pushes
from pmsmtool.estimators.shaft.inertia_ratio import estimate_ratios
from pmsmtool.experiments.polled_push import FADED
from pmsmtool.trace import Trace

POLE_PAIRS = 4
PSI, J, TAU_C, B = 0.08, 2.0e-4, 0.05, 1.0e-4
EXACT = SensorTolerance(current_gain=0.0, voltage_gain=0.0)
SEEDS = range(6)
D_LAG_S, SALIENCY_H = 0.02, 8.0e-3
"""Time constant of the d winding, and L_q - L_d."""


def push(
    rng: np.random.Generator,
    i_a: float,
    w_0: float,
    seconds: float,
    *,
    sense: float = 1.0,
    coupling: float = 0.0,
    i_d_0: float = 0.0,
    saturation: float = 0.0,
) -> Trace:
    """A push of the machine above, polled with jitter: encoder of 12 bits, current in permille.

    ``coupling``: voltage per speed and current that the d loop, a PI on the winding's pole, is not told of.
    """  # fmt: skip
    t = np.cumsum(rng.uniform(0.8e-3, 1.2e-3, round(seconds / 1e-3)))
    w, theta = np.empty_like(t), np.empty_like(t)
    speed, angle, before, i_d, flowing, last = w_0, 0.0, 0.0, i_d_0, np.empty_like(t), w_0 * i_a
    for k, now in enumerate(t):
        steps = 20
        for _ in range(steps):
            dt = (now - before) / steps
            i_d += coupling * (speed * i_a - last) - dt / D_LAG_S * i_d
            last = speed * i_a
            flux = PSI - SALIENCY_H * i_d * (1.0 - saturation * i_a)
            torque = 1.5 * POLE_PAIRS * flux * i_a - TAU_C * math.copysign(1.0, speed) - B * speed
            speed += dt * torque / J
            angle += dt * speed
        w[k], theta[k], flowing[k], before = speed, angle, i_d, now
    counts = np.round(sense * theta / (2.0 * math.pi) * 4096.0)
    current = np.round((i_a + 0.01 * rng.standard_normal(len(t))) * 1000.0) / 1000.0
    signals = {"theta_M_rad": counts * 2.0 * math.pi / 4096.0, "i_q_a": current, "w": w, "flowing": flowing}
    return Trace(t, signals, {"theta_M_rad": "rad", "i_q_a": "A", "w": "rad/s", "flowing": "A"})


def swing(
    rng: np.random.Generator,
    *,
    sense: float = 1.0,
    coupling: float = 0.0,
    saturation: float = 0.0,
    sizes: tuple[float, ...] = (1.0, 2.0, 3.0),
    ramp_s: float = 0.1,
) -> list[Trace]:
    pushes, speed, i_d, before = [], 0.0, 0.0, 0.0
    for size in sizes:
        for sign, seconds in ((1.0, ramp_s), (-1.0, 2.0 * ramp_s), (1.0, 2.0 * ramp_s), (-1.0, ramp_s)):
            i_d += coupling * speed * (sign * size - before)
            pushes.append(push(
                rng, sign * size, speed, seconds, sense=sense, coupling=coupling, i_d_0=i_d, saturation=saturation,
            ))  # fmt: skip
            speed, i_d, before = float(pushes[-1]["w"][-1]), float(pushes[-1]["flowing"][-1]), sign * size
    return pushes


@pytest.mark.chain
@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_inertia_and_friction_over_the_flux_linkage(sense: float) -> None:
    """Both senses of the encoder; over twelve seeds J/psi was off by at most 0.12 %, tau_c/psi by 2.8 %."""
    for seed in SEEDS:
        found = estimate_ratios(swing(np.random.default_rng(seed), sense=sense), pole_pairs=POLE_PAIRS, tolerance=EXACT)
        ratio, friction = found["J_per_psi"], found["tau_c_per_psi"]
        assert ratio.value == pytest.approx(J / PSI, rel=2e-3)
        assert friction.value == pytest.approx(TAU_C / PSI, rel=0.05)
        assert abs(ratio.value - J / PSI) <= total_half_width(ratio) <= 0.03 * ratio.value
        assert abs(friction.value - TAU_C / PSI) <= total_half_width(friction)


@pytest.mark.chain
@pytest.mark.parametrize(("saturation", "measured"), [(0.0, False), (0.0, True), (0.1, True)])
def test_a_d_current_that_no_loop_decouples_takes_no_inertia(saturation: float, measured: bool) -> None:
    """J/psi was 14 % too large at +-8 % (12 at +-5 where it saturates); at most 0.8, 0.2 and 2.3 % off now."""
    for seed in SEEDS:
        pushes = swing(np.random.default_rng(seed), coupling=0.01, saturation=saturation)
        if measured:
            pushes = [Trace(p.t_s, {**p.signals, "i_d_a": p["flowing"]}, {**p.units, "i_d_a": "A"}) for p in pushes]
        ratio = estimate_ratios(pushes, pole_pairs=POLE_PAIRS, tolerance=EXACT)["J_per_psi"]
        assert ratio.value == pytest.approx(J / PSI, rel=0.03)
        assert abs(ratio.value - J / PSI) <= total_half_width(ratio) <= 0.08 * ratio.value


@pytest.mark.chain
@pytest.mark.parametrize("size", [0.18, 0.35])
def test_pulses_of_one_size_little_above_friction_give_the_inertia(size: float) -> None:
    """J/psi was up to 2.0 and 0.4 % too large, at +-3.2 to 4.0 and 1.1 to 1.3 %; 0.3 and 0.1 % at +-1.2 % now.

    On another motor, 0.18 A with 0.12 A of friction and some cogging, it was 58 % too large in one run.
    """
    for seed in SEEDS:
        pushes = swing(np.random.default_rng(seed), sizes=(size, 1.02 * size, 1.08 * size), ramp_s=0.05 / size)
        ratio = estimate_ratios(pushes, pole_pairs=POLE_PAIRS, tolerance=EXACT)["J_per_psi"]
        assert ratio.value == pytest.approx(J / PSI, rel=6e-3 if size < 0.2 else 2e-3)
        assert abs(ratio.value - J / PSI) <= total_half_width(ratio) <= 0.02 * ratio.value


def test_a_shaft_that_does_not_follow_the_current_is_refused() -> None:
    rng = np.random.default_rng(1)
    still = [Trace(p.t_s, {**p.signals, "theta_M_rad": 1e-3 * rng.standard_normal(len(p))}, p.units)
             for p in swing(rng)]  # fmt: skip
    with pytest.raises(IdentificationError, match=r"E_NOT_IDENTIFIABLE|E_EXCITATION"):
        estimate_ratios(still, pole_pairs=POLE_PAIRS)
    with pytest.raises(IdentificationError, match="E_EXCITATION"):
        estimate_ratios(swing(rng)[:3], pole_pairs=POLE_PAIRS)


def top(speed_rad_s: float, current_a: float, *, drift: float = 0.0) -> Trace:
    t = np.arange(400) * 1e-3
    theta = speed_rad_s * (t + 0.5 * drift * t**2)
    flat = np.ones_like(t)
    units = {"theta_M_rad": "rad", "i_q_a": "A", "U_dc_v": "V"}
    signals = {"theta_M_rad": theta, "i_q_a": current_a * flat, "U_dc_v": 48.0 * flat}
    return Trace(t, signals, units, {"i_command_a": 1.0})


def test_the_voltage_limit_gives_the_flux_linkage_with_the_dead_time_taken_off() -> None:
    utilisation, share = 0.577, 0.02
    speed = (utilisation - DEAD_TIME * share) * 48.0 / (POLE_PAIRS * PSI)
    found = flux_by_voltage_limit(
        top(speed, 0.3), pole_pairs=POLE_PAIRS, utilisation=utilisation, dead_time_share=share, tolerance=EXACT
    )
    assert found.value == pytest.approx(PSI, rel=1e-6)
    blind = flux_by_voltage_limit(top(speed, 0.3), pole_pairs=POLE_PAIRS, utilisation=utilisation, tolerance=EXACT)
    assert blind.systematic > found.systematic and abs(blind.value - PSI) <= total_half_width(blind)
    loaded = flux_by_voltage_limit(top(speed, 0.75), pole_pairs=POLE_PAIRS, utilisation=utilisation)
    assert loaded.value == blind.value  # friction takes most of a small current, the voltage the rest
    with pytest.raises(IdentificationError, match="E_EXCITATION"):  # friction holds it: the current flows
        flux_by_voltage_limit(top(speed, 0.95), pole_pairs=POLE_PAIRS, utilisation=utilisation)
    with pytest.raises(IdentificationError, match="E_NOT_SETTLED"):
        flux_by_voltage_limit(top(speed, 0.3, drift=0.5), pole_pairs=POLE_PAIRS, utilisation=utilisation)
    for rise, settled in ((0.4, False), (0.1, False), (0.02, True)):  # of the current: 0.12, 0.03, 0.006 more later
        back = top(speed, 0.3)
        back.signals["i_q_a"][:] *= np.linspace(1.0 - rise, 1.0 + rise, len(back))
        refused = pytest.raises(IdentificationError, match="E_NOT_SETTLED.*current")
        with contextlib.nullcontext() if settled else refused:
            flux_by_voltage_limit(back, pole_pairs=POLE_PAIRS, utilisation=utilisation)


def coast(rng: np.random.Generator, w_M: float) -> Trace:
    t = np.arange(200) * 1e-3
    w = w_M * np.exp(-t)
    angle = np.cumsum(w) * 1e-3
    eps, error = 0.05, 0.4 * math.copysign(1.0, w_M)
    noise = 0.05 * rng.standard_normal((2, len(t)))
    w_e = POLE_PAIRS * w
    signals = {
        "theta_M_rad": angle,
        "u_q_v": w_e * PSI * math.cos(eps) + error + noise[0],
        "u_d_v": w_e * PSI * math.sin(eps) + noise[1],
    }
    return Trace(t, signals, {"theta_M_rad": "rad", "u_q_v": "V", "u_d_v": "V"})


def test_the_undriven_voltage_gives_the_flux_linkage_with_a_frame_and_an_inverter_that_are_off() -> None:
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        coasts = [coast(rng, w) for w in (150.0, -150.0, 60.0, -60.0)]
        found = flux_by_undriven_voltage(coasts, pole_pairs=POLE_PAIRS, tolerance=EXACT)
        assert found.value == pytest.approx(PSI, rel=5e-3)
        assert abs(found.value - PSI) <= total_half_width(found) <= 0.02 * PSI
    with pytest.raises(IdentificationError, match="E_EXCITATION"):
        flux_by_undriven_voltage(coasts[:1], pole_pairs=POLE_PAIRS)


@pytest.mark.parametrize(("fading", "more"), [(-0.2, 0.0), (0.0, 1.0)])
def test_a_current_that_fades_or_an_inverter_error_that_changes_is_in_the_interval(fading: float, more: float) -> None:
    """A tenth off in the first record of `mtpv-test`; 3 V at 100 rad/s and 5 V at 20 on `jercic-2017`."""
    rng = np.random.default_rng(SEEDS[0])
    coasts = [coast(rng, w) for w in (150.0, -150.0, 60.0, -60.0)]
    for k, record in enumerate(coasts):
        record.signals["u_q_v"] *= 1.0 + fading * np.exp(-record.t_s / 0.04)
        record.signals["u_q_v"] += more * math.copysign(1.0 if k < 2 else 2.0, coasts[k]["theta_M_rad"][-1])
        assert not fading or voltage_drift(record) > FADED
    found = flux_by_undriven_voltage(coasts, pole_pairs=POLE_PAIRS, tolerance=EXACT)
    assert 0.005 * PSI < abs(found.value - PSI) < total_half_width(found) < 0.1 * PSI
    assert abs(found.value - PSI) > 1.96 * math.hypot(found.std, 0.005 * PSI)  # without both it is outside


def test_a_current_that_is_shown_as_an_amplitude_is_in_the_interval_of_the_inertia() -> None:
    """Dead time without feed-forward makes both currents vary: the amplitude is 2.2 % above i_q here."""
    rng = np.random.default_rng(SEEDS[0])
    pushes = swing(rng)
    for one in pushes:
        turn = 2.0 * math.pi * 90.0 * one.t_s
        i = one["i_q_a"]
        one.signals["i_q_a"] = np.sign(i) * np.hypot(i * (1.0 + 0.3 * np.cos(turn)), 0.3 * i * np.sin(turn))
    found = estimate_ratios(pushes, pole_pairs=POLE_PAIRS, tolerance=EXACT)["J_per_psi"]
    assert 0.015 * J / PSI < abs(found.value - J / PSI) < total_half_width(found) < 0.06 * J / PSI


def recorded(rng: np.random.Generator, i_a: float, *, mismatch_s: float) -> Trace:
    """A recorded push: frame off by an angle that grows with speed, inverter plateau with a tail, noise."""
    period, n, R, L_d, L_q, V, knee = 1e-4, 1024, 0.12, 4e-4, 6e-4, 0.8, 0.6
    t = np.arange(n) * 5.0 * period
    w_M = np.sign(i_a) * np.linspace(-120.0, 120.0, n)
    rate = POLE_PAIRS * (w_M[-1] - w_M[0]) / t[-1]
    w = POLE_PAIRS * w_M
    i_d = 0.02 * i_a * w / 480.0 + 0.01 * rng.standard_normal(n)
    i_q = i_a + 0.02 * rng.standard_normal(n)
    inverter = V * math.copysign(1.0, i_a) * (1.0 - 0.5 * (knee / i_a) ** 2)
    ahead = w + 1.5 * period * rate
    u = R * (i_d + 1j * i_a) + 1j * ahead * (PSI + L_d * i_d + 1j * L_q * i_a) + 1j * inverter
    u *= np.exp(1j * mismatch_s * w)
    x = 0.5 * ahead * period
    u *= np.sin(x) / np.where(x == 0.0, 1.0, x) + (x == 0.0)
    signals = {
        "i_d_a": i_d, "i_q_a": i_q, "u_d_v": u.real, "u_q_v": u.imag, "omega_e_rad_s": w,
        "theta_M_rad": np.cumsum(w_M) * 5.0 * period, "flagged": np.zeros(n),
    }  # fmt: skip
    units = dict.fromkeys(signals, "1")
    return Trace(t, signals, units)


@pytest.mark.parametrize("mismatch_s", [0.0, 3e-6])
def test_resistance_by_recorded_pushes_survives_a_frame_that_turns_with_the_speed(mismatch_s: float) -> None:
    """Over twelve seeds R was off by at most 0.39 %, psi by less than 0.001 %, L_q by 0.18 %."""
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        sizes = (2.0, 3.0, 4.5, 6.0, 8.0, 10.0)
        pushes = [recorded(rng, s * i, mismatch_s=mismatch_s) for i in sizes for s in (1.0, -1.0)]
        found = estimate_pushes(pushes, period_s=1e-4, pole_pairs=POLE_PAIRS, tolerance=EXACT)
        assert found.R is not None and found.R.value == pytest.approx(0.12, rel=0.01)
        assert abs(found.R.value - 0.12) <= total_half_width(found.R)
        assert found.psi_f.value == pytest.approx(PSI, rel=1e-4)
        assert found.L_q.value == pytest.approx(6e-4, rel=3e-3)
