# SPDX-License-Identifier: MIT
"""The sampling instant's model against time-domain integrations written down independently of it."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pmsmtool.estimators.injection.output_error import AxisModel, Pulses, respond
from pmsmtool.estimators.injection.sampling_instant import (
    INSTANTS,
    LAGS,
    CoastingPairs,
    Sampling,
    ShownInstant,
    course_s2,
    sampled_ripple,
    shown_instant,
    standstill_instant_s,
)
from pmsmtool.estimators.inverter_error import Modulation

T_S = 50e-6
U_DC = 300.0
L_H = (3e-3, 5e-3)
GRID = 20000  # instants per period of the reference
MODULATION = Modulation(U_DC, L_H, T_S, 1e-6)


def _lagged(t: np.ndarray, x: np.ndarray, lag_s: float) -> np.ndarray:
    """A periodic signal behind a first-order lag, by its Fourier series."""
    order = np.fft.fftfreq(len(t), T_S / len(t))
    return np.real(np.fft.ifft(np.fft.fft(x) / (1.0 + 2j * math.pi * order * lag_s)))


def _legs_ripple(u_d: float, u_q: float, i_d: float, i_q: float, sampling: Sampling) -> tuple[float, float]:
    """Sampled ripple by summing the volt-seconds of switched legs over a fine grid, averaged over twelve angles."""
    t = (np.arange(GRID) + 0.5) * T_S / GRID
    out = np.zeros(2)
    for theta in (np.arange(12) + 0.5) * math.pi / 36.0:
        legs = []
        for k in range(3):
            a = theta - 2.0 * math.pi * k / 3.0
            legs.append((math.cos(a) * u_d - math.sin(a) * u_q, math.cos(a) * i_d - math.sin(a) * i_q, a))
        middle = 0.5 * (max(v for v, _, _ in legs) + min(v for v, _, _ in legs))
        u = np.zeros((2, GRID))
        for v, i, a in legs:
            duty = 0.5 + (v - middle) / U_DC
            on, off = 0.5 * (1.0 - duty) * T_S, 0.5 * (1.0 + duty) * T_S
            if i > 0.0:
                on += MODULATION.dead_time_s
            else:
                off += MODULATION.dead_time_s
            gate = ((t >= on) & (t < off)) * U_DC
            u += 2.0 / 3.0 * np.stack([math.cos(a) * gate, -math.sin(a) * gate])
        for axis in (0, 1):
            flux = np.cumsum(u[axis] - np.mean(u[axis])) * T_S / GRID
            i_axis = (flux - np.mean(flux)) / L_H[axis]
            if sampling.lag_s > 0.0:
                i_axis = _lagged(t, i_axis, sampling.lag_s)
            out[axis] += np.interp(sampling.instant_s, t, i_axis, period=T_S) / 12.0
    return float(out[0]), float(out[1])


@pytest.mark.chain
@settings(max_examples=12, deadline=None)
@given(
    st.floats(-40.0, 40.0),
    st.floats(20.0, 140.0),
    st.floats(-0.25, 0.15),
    st.sampled_from([0.0, 0.01, 0.05, 0.3, 1.0]),
)
@example(-30.0, 140.0, -0.16, 0.01)
def test_ripple_is_that_of_the_switched_legs(u_d: float, u_q: float, instant: float, lag: float) -> None:
    """An instant before the start, of an angle that is old, is one of the period before, whose pulses still last.

    Taken for one after them, a lag of 1 % made 24 A of a ripple of 0.06 A, and a healthy machine had no psi.
    """
    sampling = Sampling(instant * T_S, lag * T_S)
    voltage, current = (np.array([u_d]), np.array([u_q])), (np.array([4.0]), np.array([0.3]))
    found = sampled_ripple(voltage, current, MODULATION, sampling)[:, 0]
    expected = _legs_ripple(u_d, u_q, 4.0, 0.3, sampling)
    # the grid of the reference: 2.4e-5 A, and 3.0e-4 where the edge of a leg is near the sample
    assert found == pytest.approx(expected, abs=5e-4)


@pytest.mark.chain
@given(st.floats(-0.1, 0.9), st.floats(0.01, 3.0))
def test_course_of_a_turning_machine(instant: float, lag: float) -> None:
    t = np.arange(GRID) * T_S / GRID
    plain = (t - 0.5 * T_S) ** 2 - T_S**2 / 12.0
    expected = np.interp(instant * T_S, t, _lagged(t, plain, lag * T_S), period=T_S)
    assert course_s2(Sampling(instant * T_S, lag * T_S), T_S) == pytest.approx(expected, abs=1e-6 * T_S**2)


@pytest.mark.parametrize("lag", [0.0, 0.05, 0.2, 0.6])
@pytest.mark.parametrize("instant", [0.0, 0.05, 0.1])
def test_standstill_is_the_limit_of_a_small_voltage(instant: float, lag: float) -> None:
    sampling = Sampling(instant * T_S, lag * T_S)
    no_dead_time = Modulation(U_DC, L_H, T_S, 0.0)
    u_q = 0.5
    ripple = sampled_ripple((np.zeros(1), np.array([u_q])), (np.ones(1), np.zeros(1)), no_dead_time, sampling)[1, 0]
    late_s = standstill_instant_s(sampling, no_dead_time)
    assert ripple == pytest.approx(-u_q / L_H[1] * late_s, abs=2e-4 * u_q / L_H[1] * T_S)  # measured 1.8e-5


def test_dead_time_moves_the_pulses_of_two_legs_by_half() -> None:
    assert standstill_instant_s(Sampling(), MODULATION) == -0.5 * MODULATION.dead_time_s


def test_a_resistance_too_small_to_divide_by_is_none() -> None:
    u = 20.0 * np.sign(np.sin(2 * math.pi * np.arange(60) / 12.0 + 0.1))
    share = np.abs(u) / 100.0
    models = [AxisModel(3e-3, R_ohm, 1.0, 0.0) for R_ohm in (1e-3, 1e-12)]
    small, none = respond(models, u, T_S, np.array([0.3, 0.3]), Pulses(share, u / share, 0.0))
    assert np.max(np.abs(small - none)) < 1e-3 * np.max(np.abs(none))  # measured 3e-4: R T_s/L each period


@pytest.mark.parametrize("lag_s", [0.0, 6e-6, 40e-6])
@pytest.mark.parametrize("delay", [0.9, 1.0, 1.05, 0.7])
def test_pulses_against_steps_between_all_edges(delay: float, lag_s: float) -> None:
    model = AxisModel(3e-3, 2.0, delay, lag_s)
    rng = np.random.default_rng(3)
    u = 20.0 * np.sign(np.sin(2 * math.pi * np.arange(60) / 12.0 + 0.1)) + rng.standard_normal(60)
    share, rest_v = np.abs(u) / 100.0, -0.7
    found = respond([model], u, T_S, np.array([0.3]), Pulses(share, u / share, rest_v))[0]

    # every edge and every sample on one axis of time; between them a constant voltage and a matrix exponential
    edges = {float(k) for k in range(3, 50)}
    for k, w in enumerate(share):
        edges |= {k + delay + c + s * 0.25 * w for c in (0.25, 0.75) for s in (-1.0, 1.0)}
    state, expected = np.array([0.3, 0.3]), [0.3]
    times = sorted(x for x in edges if 3.0 <= x <= 49.0)
    for start, stop in itertools.pairwise(times):
        middle = 0.5 * (start + stop) - delay
        k = math.floor(middle)
        inside = any(abs(middle - k - c) < 0.25 * share[k] for c in (0.25, 0.75))
        v = rest_v + (u[k] / share[k] if inside else 0.0)
        h = (stop - start) * T_S
        steady = v / model.R_ohm
        fall = math.exp(-model.R_ohm / model.L_h * h)
        i = steady + (state[0] - steady) * fall
        if lag_s > 0.0:
            rate, mu = model.R_ohm / model.L_h, 1.0 / lag_s
            e = math.exp(-mu * h)
            y = steady * (1.0 - e) + (state[0] - steady) * mu * (fall - e) / (mu - rate) + state[1] * e
        else:
            y = i
        state = np.array([i, y])
        if stop == round(stop):
            expected.append(float(state[1]))
    assert found[: len(expected)] == pytest.approx(expected, abs=1e-9)  # the polynomial of the widths: measured 2e-11


def _run(instant: float, lag: float, age_s: float = 0.0) -> CoastingPairs:
    """Pairs as a machine gives them whose samples are late: i_q is what the ripple makes the controller believe."""
    psi, R = 0.1, 0.4
    w = np.repeat([300.0, 500.0, 700.0, 900.0, -300.0, -500.0, -700.0, -900.0], 2)
    i_d = np.tile([5.0, -5.0], 8)
    sampling = Sampling(instant * T_S, lag * T_S)
    v_q = psi * w
    voltage, current = (np.zeros(16), v_q), (i_d, np.zeros(16))
    beyond = sampled_ripple(voltage, current, MODULATION, sampling) - sampled_ripple(
        voltage, current, MODULATION, Sampling()
    )
    course = course_s2(sampling, T_S) - course_s2(Sampling(), T_S)
    u_d = w * L_H[1] * beyond[1] - R * 0.5 * w**2 * psi / L_H[0] * course + 1e-3 * w - psi * w**2 * age_s
    return CoastingPairs(w, u_d, i_d, np.zeros(16), np.zeros(16), v_q, [(2 * k, 2 * k + 1) for k in range(8)])


@pytest.mark.parametrize(("instant", "lag"), [(0.0, 0.0), (0.06, 0.0), (0.1, 0.02), (0.03, 0.3), (0.08, 0.6)])
def test_shown_is_what_was_put_in(instant: float, lag: float) -> None:
    shown = shown_instant(_run(instant, lag), 0.4, 0.1, MODULATION, 1.0)
    assert shown is not None
    delay = 1.0 - instant + 0.5 * MODULATION.dead_time_s / T_S
    assert abs(shown.distance(delay, lag * T_S)) * shown.std_s < 6e-4 * T_S  # the grid: measured 3.5e-4
    assert abs(shown.distance(delay - 0.05, lag * T_S)) > 4.0  # a slow sensor hides most of it: 5.1
    assert shown.sampling(delay, lag * T_S).instant_s == pytest.approx(instant * T_S)


def test_an_old_angle_looks_like_a_late_sample() -> None:
    fresh = shown_instant(_run(0.0, 0.0), 0.4, 0.1, MODULATION, 1.0)
    old = shown_instant(_run(0.0, 0.0, age_s=2e-6), 0.4, 0.1, MODULATION, 1.0)
    assert fresh is not None and old is not None
    assert old.value_s - fresh.value_s == pytest.approx(2e-6, rel=1e-6)


def test_a_q_current_that_rises_with_the_speed_shows_no_instant() -> None:
    rows = _run(0.0, 0.0)
    i_q = 1e-3 * rows.w
    driven = replace(rows, i_q=i_q, u_d=rows.u_d - rows.w * L_H[1] * i_q)
    without, found = (shown_instant(each, 0.4, 0.1, MODULATION, 1.0) for each in (rows, driven))
    assert without is not None and found is not None
    assert found.value_s == pytest.approx(without.value_s, abs=1e-9 * T_S)  # measured 8e-17; L_q i_q stands for T_s


def test_the_deviation_is_that_of_a_regression_on_eight_pairs() -> None:
    rows = _run(0.0, 0.0)
    noise = np.random.default_rng(5).standard_normal(8)
    shown = shown_instant(replace(rows, u_d=rows.u_d + np.repeat(noise, 2)), 0.4, 0.1, MODULATION, 1.0)
    columns = np.stack([-0.1 * rows.w[::2] ** 2, rows.w[::2], np.ones(8)], axis=1)
    squares = np.linalg.lstsq(columns, noise, rcond=None)[1][0]
    expected = math.sqrt(squares / (8 - 3) * np.linalg.inv(columns.T @ columns)[0, 0])
    assert shown is not None and shown.std_s == pytest.approx(expected, rel=1e-3)  # measured 1.8e-5: the floor


def test_the_prediction_keeps_rising_past_the_end_of_the_zero_vectors() -> None:
    """With the least slope of 0.7 where the ripple turns back, and as the ripple says before."""
    shown = shown_instant(_run(0.0, 0.0), 0.4, 0.1, MODULATION, 1.0)
    assert shown is not None
    slope = np.diff(shown.predicted_s, axis=0) / (np.diff(INSTANTS) * T_S)[:, None]
    late = np.array(INSTANTS[1:]) > 0.12
    assert np.all(slope[late] >= 0.7 - 1e-9) and np.any(np.isclose(slope[late], 0.7)) and np.max(slope) < 1.5
    assert np.any(slope[~late] < 0.7)


def test_too_few_pairs_show_nothing() -> None:
    rows = _run(0.0, 0.0)
    few = CoastingPairs(rows.w, rows.u_d, rows.i_d, rows.i_q, rows.v_d, rows.v_q, list(rows.pairs)[:4])
    assert shown_instant(few, 0.4, 0.1, MODULATION, 1.0) is None


def test_between_the_points_of_the_grid_the_prediction_is_bilinear() -> None:
    table = np.random.default_rng(4).standard_normal((len(INSTANTS), len(LAGS))) * T_S
    shown = ShownInstant(0.2 * T_S, 0.01 * T_S, T_S, 0.0, 1.0, table)
    instant, lag = 0.3 * INSTANTS[4] + 0.7 * INSTANTS[5], 0.6 * LAGS[7] + 0.4 * LAGS[8]
    expected = np.array([0.3, 0.7]) @ table[4:6, 7:9] @ np.array([0.6, 0.4])
    assert shown.distance(1.0 - instant, lag * T_S) == pytest.approx((expected - 0.2 * T_S) / (0.01 * T_S), rel=1e-9)


def test_just_beyond_the_grid_the_distance_goes_on() -> None:
    """A sample older than the grid knows: without a slope there L came out 50 % wide (encoder age 1 us of 34)."""
    table = np.tile(np.array(INSTANTS)[:, None] * T_S, (1, len(LAGS)))
    shown = ShownInstant(0.0, 0.01 * T_S, T_S, 0.0, 1.0, table)
    for delay in (1.05, 0.9, 0.8):
        assert shown.distance(delay, 0.0) == pytest.approx((1.0 - delay) / 0.01)
    late = [shown.distance(delay, 0.0) for delay in (1.0601, 1.0701, 1.3, 3.0)]
    assert late[1] - late[0] < -0.5 and late[2] > -9.0 and late[3] > -9.0, "what lies far outside is no instant"
    assert [shown.outside(delay) for delay in (1.05, 0.77, 1.07, 1.75, 0.7)] == pytest.approx([0, 0, 0.01, 0.69, 0.06])
    assert [shown.knows(delay) for delay in (1.05, 1.08, 1.1, 0.74, 0.72)] == [True, True, False, True, False]
