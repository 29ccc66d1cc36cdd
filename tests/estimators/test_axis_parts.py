# SPDX-License-Identifier: MIT
"""The model of one axis, its parameters and priors step by step, against matrix exponentials and written-out sums."""

from __future__ import annotations

import cmath
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from pmsmtool.arrays import Array
from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.injection import axis_layout, axis_response, output_error
from pmsmtool.estimators.injection.axis_layout import Effects, Layout, Motion, Timing
from pmsmtool.estimators.injection.axis_response import (
    LINE_GAIN,
    SKIP_SAMPLES,
    Response,
    Shot,
    VoltageError,
    arx_guess,
    fast_part,
    initial_inductance,
    projected,
    simulate,
    with_line,
)
from pmsmtool.estimators.injection.output_error import (
    AxisModel,
    acting_voltages,
    bend,
    eddy_current,
    recursion,
    respond,
)
from pmsmtool.estimators.injection.sampling_instant import ShownInstant

EXACT = 1e-9
"""The same numbers by another formula (relative); measured: below 1e-10."""
EFFECT = 0.2
"""Of a small effect, of which what is slow is projected out in another order; measured: 0.05 to 0.15."""
T_S, L_H, R = 1e-4, 2e-3, 0.7
RNG = np.random.default_rng(21)
COMMAND = RNG.standard_normal(60)


def close(found: Array, expected: Array, tolerance: float = EXACT) -> bool:
    """Whether all are equal, to a share of the largest."""
    return bool(np.max(np.abs(np.asarray(found) - expected)) <= tolerance * float(np.max(np.abs(expected))))


# ---- the response of an axis ------------------------------------------------------------------------------------


@pytest.mark.parametrize("pole", [0.0, 1e-9, 0.3, 0.6, 0.601, 0.95, 1.0, 1.02])
@pytest.mark.parametrize("n", [1, 2, 60])
def test_a_recursion_is_a_filter_of_first_order(pole: float, n: int) -> None:
    expected = [0.8]
    for drive in COMMAND[:n]:
        expected.append(pole * expected[-1] + drive)
    assert close(recursion(pole, COMMAND[:n], 0.8), np.array(expected))


@pytest.mark.parametrize("delay", [0.0, 0.3, 1.0, 1.7, 2.0, 2.5, 3.2, 5.0])
def test_the_command_acts_a_delay_after_its_sample(delay: float) -> None:
    early, late, fraction = acting_voltages(COMMAND, delay)
    first = max(3, math.floor(delay) + 1)
    at = np.arange(first, len(COMMAND))
    assert fraction == pytest.approx(delay % 1.0, abs=1e-12) and len(early) == len(late) == len(at)
    assert np.array_equal(late, COMMAND[np.floor(at + fraction - delay + 1e-9).astype(int)])
    assert np.array_equal(early, COMMAND[np.floor(at - delay + 1e-9).astype(int) - (fraction == 0.0)])


def _exact(L_h: float, R_ohm: float, lag_s: float, h: float) -> Array:
    """Exponential of current, sensor output and voltage over a step."""
    A = np.array([[-R_ohm / L_h, 0.0, 1.0 / L_h], [1.0 / lag_s, -1.0 / lag_s, 0.0], [0.0, 0.0, 0.0]])
    return np.asarray(expm(A * h))


@pytest.mark.parametrize("R_ohm", [0.0, 1e-9, R, -0.2])
@pytest.mark.parametrize("lag_s", [0.0, 3e-5, 2e-4])
@pytest.mark.parametrize("h", [0.2e-4, 0.9e-4])
def test_one_step_of_current_and_sensor(R_ohm: float, lag_s: float, h: float) -> None:
    a, b, e, c, d = AxisModel(L_H, R_ohm, 1.0, lag_s).advance(h)
    exact = _exact(L_H, R_ohm, lag_s or 1e-9, h)
    assert (a, b) == pytest.approx((exact[0, 0], exact[0, 2]), rel=EXACT)
    if lag_s:
        assert (e, c, d) == pytest.approx((exact[1, 1], exact[1, 0], exact[1, 2]), rel=1e-6)  # d of small terms
    else:
        assert (e, c, d) == (0.0, a, b)
    risen = output_error._stepped(AxisModel(L_H, R_ohm, 1.0, lag_s), np.array([[0.5 * h, h]]))
    expected = [_exact(L_H, R_ohm, lag_s or 1e-9, part * h)[:2, 2] for part in (0.5, 1.0)]
    if not lag_s:
        expected = [np.array([each[0], each[0]]) for each in expected]
    assert risen[:, 0] == pytest.approx(np.array(expected).T, rel=1e-6)


@pytest.mark.parametrize("delay", [0.4, 1.0, 1.65])
@pytest.mark.parametrize("lag_s", [0.0, 8e-5])
def test_the_response_is_that_of_the_differential_equations(delay: float, lag_s: float) -> None:
    model = AxisModel(L_H, R, delay, lag_s)
    early, late, fraction = acting_voltages(COMMAND, delay)
    one, two = (_exact(L_H, R, lag_s or 1e-9, part * T_S) for part in (fraction, 1.0 - fraction))
    state, expected = np.array([0.3, 0.3]), [0.3]
    for u, v in zip(early, late, strict=True):
        state = one[:2, :2] @ state + one[:2, 2] * u
        state = two[:2, :2] @ state + two[:2, 2] * v
        expected.append(float(state[1] if lag_s else state[0]))
    other = replace(model, L_h=2.0 * L_H)
    found = respond([model, other], COMMAND, T_S, np.array([0.3, 0.1]))
    assert close(found[0], np.array(expected))
    assert close(found[1], respond([other], COMMAND, T_S, np.array([0.1]))[0])


def test_an_eddy_current_is_the_flux_that_a_first_order_lags_behind() -> None:
    tau = 1.3e-4
    model = AxisModel(L_H, R, 1.4, 0.0, 3e-5, tau)
    early, late, fraction = acting_voltages(COMMAND, 1.4)
    slope, expected = 0.0, [0.0]
    for u, v in zip(early, late, strict=True):
        for voltage, part in ((u, fraction), (v, 1.0 - fraction)):
            slope = voltage + (slope - voltage) * math.exp(-part * T_S / tau)
        expected.append(3e-5 / L_H * slope)
    assert close(eddy_current(model, COMMAND, T_S), np.array(expected))


def test_the_inductance_of_the_flux_is_the_slope_of_the_impedance() -> None:
    """Complex step; measured: 1e-16."""
    model = AxisModel(L_H, R, 1.0, 0.0, 4e-4, 1.2e-3)
    s = 1e-8j
    admittance = 1.0 / (R + s * L_H) + model.eddy_s / L_H / (1.0 + s * model.eddy_tau_s)
    assert model.flux_inductance_h == pytest.approx((1.0 / admittance).imag / s.imag, rel=EXACT)
    Y = 1.0 / (R + 2e3j * L_H) + model.eddy_s / L_H / (1.0 + 2e3j * model.eddy_tau_s)
    assert (1.0 - model.fall(2e3)) * model.flux_inductance_h == pytest.approx((1.0 / Y).imag / 2e3, rel=EXACT)
    assert replace(model, eddy_s=0.0).fall(2e3) == pytest.approx(0.0, abs=EXACT) and model.fall(2e3) > 0.07
    assert bend(np.array([2.0, -3.0]), 0.5, 0.1).tolist() == pytest.approx([2.0 + 0.8, 4.5 - 2.7])
    assert cmath.isfinite(admittance)


# ---- a shot -----------------------------------------------------------------------------------------------------


def _shot(n: int = 240, half_period: int = 6, **parts: object) -> Shot:
    k = np.arange(n)
    u = 5.0 * np.where((k + half_period // 2) // half_period % 2 == 0, 1.0, -1.0) + 0.4
    (i,) = respond([AxisModel(L_H, R, 1.0, 0.0)], u - np.mean(u), T_S, np.zeros(1))
    i = np.concatenate([np.zeros(n - len(i) + 1), i[:-1]]) + 3.0
    return replace(Shot(u, i, np.zeros(n), half_period, T_S), **parts)


def test_half_of_an_error_belongs_to_the_edge_a_quarter_of_a_period_from_each_sample() -> None:
    error = VoltageError(np.array([-10.0, 10.0]), np.array([-1.0, 1.0]), np.array([-4.0, 4.0]))
    found = error.lost_v(np.array([1.0, 3.0, -2.0]))
    # early 0.1 i, three quarters of it by the sample before; late 0.4 i, three quarters by the sample after
    expected = [0.1 * (0.75 * a + 0.25 * b) + 0.4 * (0.25 * a + 0.75 * b) for a, b in ((1.0, 3.0), (3.0, -2.0))]
    assert found == pytest.approx(expected, rel=EXACT)


def test_pulses_have_the_height_of_the_bridge_and_a_width_by_the_command() -> None:
    shot = replace(_shot(), u_v=np.array([5.0, -2.0, 0.0, 30.0]), pulse_v=20.0)
    pulses = shot.pulses
    assert pulses is not None and _shot().pulses is None
    assert pulses.share == pytest.approx([0.25, 0.1, 1e-4, 1.0]) and pulses.height_v == pytest.approx([20, -20, 0, 30])
    assert pulses.rest_v == pytest.approx(-33.0 / 4.0)


def test_what_is_slower_than_a_quarter_of_the_injection_is_projected_out() -> None:
    shot = _shot(250, 6)
    basis = shot.slow_basis()
    assert basis.shape == (240, 10)  # 240 samples are 40 half periods: cosines of 0 to 9 half turns
    assert basis.T @ basis == pytest.approx(np.eye(10), abs=1e-12)
    k = np.arange(240) + 0.5
    rows = np.stack([np.cos(math.pi * j * k / 240.0) for j in (3, 9, 10)])
    left = projected(rows, basis)
    assert close(left[2], rows[2]) and np.max(np.abs(left[:2])) < 1e-12
    assert _shot(13 + SKIP_SAMPLES).slow_basis().shape == (13, 1)
    lines = replace(shot, lines_hz=(1234.0,)).slow_basis()
    wave = np.cos(2.0 * math.pi * 1234.0 * T_S * k + 0.7)
    assert lines.shape == (240, 12) and np.max(np.abs(projected(wave[None, :], lines))) < 1e-12
    assert lines.T @ lines == pytest.approx(np.eye(12), abs=1e-12)


def test_the_fast_part_is_less_the_mean_before_the_compared_samples() -> None:
    slow = _shot(50).slow_basis()
    i = RNG.standard_normal((2, 47)) + 5.0
    found = fast_part(i, slow)
    mean = np.mean(i[:, -40:], axis=1, keepdims=True)
    assert close(found[:, :7], i[:, :7] - mean)
    assert close(found[:, 7:], (i[:, 7:] - mean) - (i[:, 7:] - mean) @ slow @ slow.T)


def test_the_fast_charge_is_a_sum_of_trapezoids() -> None:
    slow = _shot(50).slow_basis()
    fast = RNG.standard_normal((1, 47))
    charge = np.concatenate([[0.0], np.cumsum(0.5 * (fast[0, 1:] + fast[0, :-1]) * T_S)])
    charge[-40:] -= slow @ (slow.T @ charge[-40:])
    assert close(axis_response._fast_charge(fast, slow, T_S)[0], charge)


@pytest.mark.parametrize("R_ohm", [0.0, R, -0.3])
def test_the_pole_and_the_gain_of_one_period(R_ohm: float) -> None:
    exact = _exact(L_H, R_ohm, 1.0, T_S)
    assert AxisModel(L_H, R_ohm, 1.0, 0.0).advance(T_S)[:2] == pytest.approx((exact[0, 0], exact[0, 2]), rel=EXACT)


def test_without_further_effects_a_shot_is_the_response() -> None:
    shot = _shot()
    found = simulate([Response(AxisModel(L_H, R, 1.0, 0.0), 0.0, 0.0, 0.0, 0.0)], shot, shot.slow_basis())
    assert close(found[0], shot.i_a[SKIP_SAMPLES:] - 3.0)
    eddy = AxisModel(L_H, R, 1.0, 0.0, 2e-5, 1e-4)
    more = simulate([Response(eddy, 0.0, 0.0, 0.0, 0.0)], shot, shot.slow_basis()) - found
    current = eddy_current(eddy, shot.u_v - np.mean(shot.u_v), T_S)
    assert close(more[0], current[-1 - len(more[0]) : -1], 1e-7)


@pytest.mark.parametrize("effect", ["motion", "bend", "symmetric", "error"])
def test_small_effects_are_those_of_a_simulation_in_small_steps(effect: str) -> None:
    """A rotor that follows, a bent magnetisation, an error that depends on the current."""
    K, c_2, c_3, slope = 0.0, 0.0, 0.0, 0.0
    if effect == "motion":
        K = 0.02 * L_H / (6.0 * T_S) ** 2
    elif effect == "bend":
        c_2, c_3 = 0.02, 0.01
    elif effect == "symmetric":
        c_3 = 0.02
    else:
        slope = 0.2
    n = 240
    # the mean current is 3 A: a leg that loses nothing below it
    error = (
        VoltageError(np.array([-50.0, 3.0, 50.0]), np.zeros(3), slope * np.array([0.0, 0.0, 47.0])) if slope else None
    )
    shot = replace(_shot(), error=error)
    u, a = shot.u_v - np.mean(shot.u_v), math.exp(-R * T_S / L_H)
    # begin where the square wave has been running: nothing but the effect is slow
    start = float(np.sum(a ** np.arange(11.0, -1.0, -1.0) * (1.0 - a) / R * u[2:14]) / (1.0 - a**12))
    fine, out = 16, []
    h, x, charge = T_S / fine, start, 0.0

    def bent(x: float) -> float:
        return x + c_2 * x**2 + c_3 * x**3

    for k in range(n):
        out.append(bent(x))
        for step in range(fine if k >= 3 else 0):  # from the first sample that is modelled
            if step == 3 * fine // 4:  # what depends on the current acts three quarters after the sample
                x -= T_S * slope * max(0.0, x) / L_H
            middle = x + 0.5 * h * (u[k - 1] - R * bent(x) - K * charge) / L_H
            x += h * (u[k - 1] - R * bent(middle) - K * (charge + 0.5 * h * bent(x))) / L_H
            charge += h * bent(middle)
    slow, model = shot.slow_basis(), AxisModel(L_H, R, 1.0, 0.0)
    plain, found = (
        simulate([Response(model, start, *more)], each, slow)[0]
        for more, each in (((0.0, 0.0, 0.0), replace(shot, error=None)), ((c_2, c_3, K), shot))
    )
    # the current at the start is a parameter of a fit: what decays from there stands for nothing
    decay = np.exp(-R * T_S / L_H * np.arange(n - SKIP_SAMPLES))
    beside = np.linalg.qr(np.column_stack([slow, decay]))[0]
    change, off = projected(np.stack([np.array(out[SKIP_SAMPLES:]) - plain, found - out[SKIP_SAMPLES:]]), beside)
    # what is slow at the ends of a record is not what is slow within it
    assert np.max(np.abs(off[30:-30])) < EFFECT * np.max(np.abs(change))


def test_a_sine_that_stands_out_of_the_residual_is_found() -> None:
    """Share of the power against noise: of 230 samples from 60 on; on a harmonic of the injection it stays."""
    shot, n = _shot(), 230
    k = np.arange(n)
    noise = np.random.default_rng(23).standard_normal(n)
    noise *= 1.0 / np.sqrt(np.mean(noise**2))
    injected = 1.0 / (12.0 * T_S)
    for hz, share, found in (
        (5.37 * injected, 0.5, True),
        (5.37 * injected, 0.33, True),
        (5.37 * injected, 0.12, False),
        (3.0 * injected, 0.9, False),
    ):
        sine = math.sqrt(2.0 * share / (1.0 - share)) * np.cos(2.0 * math.pi * hz * k * T_S + 0.4)
        new = with_line(shot, noise + sine)
        assert (new is not shot) is found
        if found:
            assert new.lines_hz[-1] == pytest.approx(hz, abs=0.1 / (n * T_S))
            again = with_line(new, noise + sine)
            assert len(again.lines_hz) == 2
    flat = np.zeros(n)
    flat[0] = 1.0  # a share of nothing: its power is spread over all frequencies
    assert with_line(shot, flat) is shot and LINE_GAIN == 60.0


def test_the_first_guess_is_the_voltage_over_the_slope() -> None:
    k = np.arange(300)
    wave = np.where(k // 5 % 2 == 0, 1.0, -1.0)
    triangle = np.concatenate([[0.0], np.cumsum(wave)[:-1]]) * 7.0 * T_S / L_H
    shot = Shot(7.0 * wave + 10.0, triangle + 2.0, 0.0 * triangle, 5, T_S)
    assert initial_inductance(shot) == pytest.approx(L_H, rel=EXACT)
    with pytest.raises(IdentificationError, match="E_EXCITATION"):
        initial_inductance(replace(shot, i_a=np.ones(300)))


@pytest.mark.parametrize("delay", [0, 1, 2])
def test_a_recursion_without_noise_gives_inductance_and_resistance(delay: int) -> None:
    u = np.random.default_rng(24).standard_normal(200)
    a, i = math.exp(-R * T_S / L_H), np.zeros(200)
    for k in range(2, 199):
        i[k + 1] = a * i[k] + (1.0 - a) / R * u[k - delay] + 0.01
    shot = Shot(u, i, 0.0 * i, 6, T_S)
    L, found, power = arx_guess(shot, delay)
    assert (L, found) == pytest.approx((L_H, R), rel=1e-6) and power < 1e-20
    wrong = arx_guess(replace(shot, u_v=-u), delay)
    assert wrong[:2] == (initial_inductance(replace(shot, u_v=-u)), 0.0)


# ---- parameters and priors --------------------------------------------------------------------------------------

TIMING = Timing(1.2, 0.03, -2.0, 0.4, 1.15, 0.02, 50.0, 60.0, 5.0)
SHOWN = ShownInstant(2e-6, 1e-6, T_S, 1e-6, 1.0, np.linspace(0.0, 1e-5, 11)[:, None] + np.linspace(0.0, 1e-6, 13))
ALL = Effects(lag=True, bend=True, motion=True, dispersion=True, eddy=True)
FULL = Layout(2, ALL, L_H, R, T_S, 0.5, 40.0)
VECTOR = np.array([0.1, 1.2, 1.4, -2.5, 0.7, -0.3, 2.0, 0.05, -0.08, 0.4, -1.0, 0.6, -0.9])


def test_every_value_of_the_vector_has_its_place_and_its_size() -> None:
    one, two = FULL.responses(VECTOR)
    lag, eddy, tau = math.exp(-2.5) * T_S, 0.4 * T_S, math.exp(-1.0) * T_S
    assert one.model == AxisModel(L_H * math.exp(0.1), 1.2 * R, 1.4, lag, eddy, tau)
    assert two.model.L_h == pytest.approx(L_H * math.exp(0.15), rel=EXACT)
    assert two.model.R_ohm == pytest.approx(1.2 * R * 0.92, rel=EXACT)
    assert (one.start_a, two.start_a) == pytest.approx((0.3, -0.45)) and one.motion == two.motion == 80.0
    assert (one.c_2, one.c_3) == pytest.approx((0.1 * 0.7 / 0.5, 0.1 * -0.3 / 0.25)) and two.c_2 == one.c_2
    symmetric = replace(FULL, symmetric=True, effects=Effects(bend=True))
    bent = symmetric.responses(np.array([0.0, 1.0, 1.0, 0.0, 0.8, 0.0, 0.0]))[0]
    assert (bent.c_2, bent.c_3) == (0.0, pytest.approx(0.1 * 0.8 / 0.25))
    plain = replace(FULL, effects=Effects(lag=False)).responses(np.array([0.0, 1.0, 1.0, 0.2, 0.4]))
    assert plain[1] == Response(AxisModel(L_H, R, 1.0, 0.0, 0.0, T_S), 0.2, 0.0, 0.0, 0.0)
    assert [length for _, length in FULL.blocks()] == [3, 1, 2, 1, 2, 2, 2]
    assert dict(replace(FULL, shots=3).blocks())["dispersion"] == 4 and dict(symmetric.blocks())["bend"] == 1


def test_priors_are_distances_in_their_deviations() -> None:
    found = FULL.prior(VECTOR)
    expected = [
        0.2 / axis_layout.EDDY_R_PRIOR_STD, 0.4,
        (-2.5 - math.log(axis_layout.LAG_CENTRE)) / axis_layout.LAG_PRIOR_STD,
        0.7 / axis_layout.BEND_PRIOR_STD, -0.3 / axis_layout.BEND_PRIOR_STD, 2.0 / axis_layout.MOTION_PRIOR_STD,
        0.05 / axis_layout.RATIO_PRIOR_STD, -0.08 / axis_layout.RATIO_PRIOR_STD, 0.4,
        (-1.0 - math.log(axis_layout.EDDY_TAU_CENTRE)) / axis_layout.EDDY_TAU_PRIOR_STD,
    ]  # fmt: skip
    assert found == pytest.approx(expected, rel=EXACT)
    known = replace(FULL, motion=Motion(70.0, 4.0), timing=TIMING, instant=SHOWN).prior(VECTOR)
    total = (1.4 + math.exp(-2.5) - 1.2) / math.hypot(0.03, axis_layout.TIMING_FLOOR)
    distance = SHOWN.distance(1.4, math.exp(-2.5) * T_S)
    assert known[2:5] == pytest.approx([total, -0.5 / 0.4, distance], rel=EXACT)
    assert known[7] == pytest.approx((80.0 - 70.0) / 4.0, rel=EXACT) and len(known) == len(found) + 2
    short = replace(FULL, effects=Effects(lag=False), timing=TIMING, instant=SHOWN).prior(
        np.array([0.0, 1.3, 1.1, 0, 0])
    )
    without = [0.3 / axis_layout.R_PRIOR_STD, 0.1, (1.1 - 1.15) / math.hypot(0.02, 1e-3), SHOWN.distance(1.1, 0.0)]
    assert short == pytest.approx(without, rel=EXACT)
    assert (TIMING.criterion(True), TIMING.criterion(False)) == (50.0, 60.0)


def test_a_layout_changes_to_more_effects_or_to_none_of_the_lag() -> None:
    base = replace(FULL, effects=Effects())
    start = np.array([0.1, 1.2, 1.4, -2.5, 0.6, -0.9])
    richer, x = base.changed(start, ALL)
    assert richer.effects == ALL
    assert x == pytest.approx([0.1, 1.2, 1.4, -2.5, 0, 0, 0, 0, 0, 0, math.log(0.5), 0.6, -0.9])
    _, x = base.changed(start, Effects(lag=False))
    assert x == pytest.approx([0.1, 1.2, 1.4 + math.exp(-2.5), 0.6, -0.9])
    _, late = base.changed(np.array([0.1, 1.2, 6.0, 1.0, 0.6, -0.9]), Effects(lag=False))
    assert late[2] == SKIP_SAMPLES - 3.5
    _, longer = replace(base, shots=3).changed(np.zeros(7), Effects(dispersion=True))
    assert len(longer) == 4 + 4 + 3
    assert len(replace(base, symmetric=True).changed(start, Effects(bend=True))[1]) == len(start) + 1
    eddy = FULL.with_eddy(VECTOR, 0.3, 0.05, 1.0)
    expected = VECTOR.copy()
    expected[[1, 2, 9, 10]] = 1.0, 1.0, 0.3, math.log(0.05)
    assert eddy == pytest.approx(expected) and FULL.with_eddy(VECTOR, 0.3, 0.05, None)[2] == 1.4


@pytest.mark.parametrize(
    ("at", "most"),
    [(0, axis_layout.LARGEST_LOG_L), (3, axis_layout.LARGEST_LOG_LAG), (4, axis_layout.BEND_LIMIT),
     (5, axis_layout.BEND_LIMIT), (10, axis_layout.LARGEST_LOG_LAG)],
)  # fmt: skip
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_model_is_defined_within_its_region(at: int, most: float, sign: float) -> None:
    x = np.array([0.0, 1.0, 1.4, -2.5, 0.7, -0.3, 2.0, 0.0, 0.0, 0.4, -1.0, 0.6, -0.9])
    for share in (0.99, 1.01):
        x[at] = sign * share * most
        assert FULL.defined(x) is (share < 1.0)
    x[at] = sign * most
    assert FULL.defined(x)


def test_the_model_is_defined_for_delays_and_decays_that_a_record_can_show() -> None:
    x = np.array([0.0, 1.0, 1.4, -2.5, 0.7, -0.3, 2.0, 0.0, 0.0, 0.4, -1.0, 0.6, -0.9])
    for delay, inside in ((-0.01, False), (0.0, True), (SKIP_SAMPLES - 3.0, True), (SKIP_SAMPLES - 2.99, False)):
        x[2] = delay
        assert FULL.defined(x) is inside
    x[2] = 1.4
    for decay, inside in ((-0.29, True), (-0.31, False), (4.9, True), (5.1, False)):
        x[1] = decay / (R * T_S / L_H)
        assert FULL.defined(x) is inside
    x[1], x[7] = 1.0, 2.9
    assert FULL.defined(x)
    x[0] = 0.2  # of the second shot it is 3.1 then
    assert not FULL.defined(x)
    x[0], x[7], x[8] = 0.0, 0.0, -20.0
    assert FULL.defined(x) is (-19.0 * R * T_S / L_H > -0.3)
