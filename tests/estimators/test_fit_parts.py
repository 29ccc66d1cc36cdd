# SPDX-License-Identifier: MIT
"""What is made of fits: averages over models, information criteria, doubts, and the choice between two models."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from pmsmtool.arrays import Array
from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.estimate import CHI2_WARN, COVERAGE_FACTOR, SensorTolerance, coverage_factor
from pmsmtool.estimators.injection import axis_fit, sampling_instant
from pmsmtool.estimators.injection.axis_fit import DISPERSION_PENALTY, LEAST_R, MOST_R, PENALTY
from pmsmtool.estimators.injection.axis_layout import Effects, Layout, Motion, Timing
from pmsmtool.estimators.injection.axis_response import SKIP_SAMPLES, Shot
from pmsmtool.estimators.injection.sampling_instant import CoastingPairs, shown_instant
from pmsmtool.estimators.inverter_error import InverterCurve, Modulation, edge_curve
from pmsmtool.estimators.least_squares import Fit
from pmsmtool.estimators.shaft import frequency_response as fr
from pmsmtool.estimators.shaft import inertia_ratio, mechanics
from pmsmtool.estimators.shaft.inertia_ratio import FRICTION_FLOOR, MODEL_FLOOR, RATIO_LIMIT, SATURATED_SHARE, SURELY
from pmsmtool.estimators.shaft.model import Run
from pmsmtool.estimators.shaft.response_lines import HALF_WIDTH, local_polynomials
from pmsmtool.identification import swing
from pmsmtool.trace import Trace
from tests.estimators.traces import trace_of

EXACT = 1e-9
"""The same numbers by another formula (relative); measured: below 1e-12."""
T_S = 1e-4


def _fit(x: Sequence[float], cost: float, *, rows: int = 300, seed: int = 0, size: float = 100.0) -> Fit:
    rng = np.random.default_rng(60 + seed)
    residual = rng.standard_normal(rows)
    residual *= math.sqrt(cost / float(residual @ residual))
    return Fit(np.array(x, dtype=np.float64), residual, size * rng.standard_normal((rows, len(x))), True, 5)


# ---- one axis ---------------------------------------------------------------------------------------------------

LAYOUT = Layout(2, Effects(), 2e-3, 0.5, T_S, 0.8, 30.0)


def _layout(**effects: bool) -> Layout:
    return replace(LAYOUT, effects=Effects(**effects))


def test_the_criterion_counts_parameters_and_what_the_other_axis_says() -> None:
    """A rotor that follows is free, a dispersion cheap; what both axes share is paid for once."""
    every = _layout(bend=True, motion=True, dispersion=True)
    fit = _fit(np.zeros(3 + 1 + 2 + 1 + 2 + 2), 50.0)
    own = 50.0 + PENALTY * (11 - 1 - 2) + DISPERSION_PENALTY * 2
    assert axis_fit._criterion(fit, every, None) == pytest.approx(own, rel=EXACT)
    timing = Timing(1.0, 0.1, -2.0, 0.3, 1.1, 0.1, 40.0, 60.0, 13.0)
    assert axis_fit._criterion(fit, every, timing) == pytest.approx(own - PENALTY + 40.0, rel=EXACT)
    plain = _fit(np.zeros(5), 20.0)
    found = axis_fit._criterion(plain, _layout(lag=False), timing)
    assert found == pytest.approx(20.0 + 5.0 * PENALTY + 60.0 + 13.0, rel=EXACT)


def _tried() -> dict[Effects, tuple[Fit, Layout]]:
    start = [0.3, -0.2]
    bent = [0.02, 1.0, 1.10, -1.5, 0.1, 0.2, *start]
    return {
        lay.effects: (_fit(x, cost, seed=k), lay)
        for k, (lay, x, cost) in enumerate([
            (_layout(), [0.01, 1.1, 1.05, -2.0, *start], 40.0), (_layout(lag=False), [0.02, 1.2, 1.2, *start], 47.0),
            (_layout(bend=True), bent, 22.0), (_layout(lag=False, bend=True), [*bent[:3], *bent[4:]], 33.0),
        ])
    }  # fmt: skip


def test_the_timing_is_that_of_the_best_models_with_and_without_lag() -> None:
    """40 and 6 parameters against 22 and 8: the bent ones are better, by 4 and 0 beyond their price."""
    tried = _tried()
    timing = axis_fit._timing(tried)
    criteria = {effects: fit.cost + PENALTY * len(fit.x) for effects, (fit, _) in tried.items()}
    assert timing.lag_criterion == pytest.approx(min(c for e, c in criteria.items() if e.lag), rel=EXACT)
    assert timing.plain_criterion == pytest.approx(min(c for e, c in criteria.items() if not e.lag), rel=EXACT)
    assert timing.bend_gain == pytest.approx(
        min(c for e, c in criteria.items() if not e.bend) - min(c for e, c in criteria.items() if e.bend), rel=EXACT
    )
    fit = tried[Effects(bend=True)][0]
    covariance = np.linalg.inv(fit.jacobian.T @ fit.jacobian)
    slope = np.array([1.0, math.exp(-1.5)])
    assert timing.total == pytest.approx(1.10 + math.exp(-1.5), rel=EXACT) and timing.log_lag == -1.5
    assert timing.total_std == pytest.approx(math.sqrt(slope @ covariance[2:4, 2:4] @ slope), rel=1e-6)
    assert timing.log_lag_std == pytest.approx(math.sqrt(covariance[3, 3]), rel=1e-6)
    without = tried[min((e for e in tried if not e.lag), key=lambda e: criteria[e])][0]
    assert timing.delay == without.x[2]
    assert timing.delay_std == pytest.approx(
        math.sqrt(np.linalg.inv(without.jacobian.T @ without.jacobian)[2, 2]), rel=1e-6
    )


def _shots() -> list[Shot]:
    rng = np.random.default_rng(70)
    k = np.arange(130)
    return [
        Shot(5.0 * np.where(k // h % 2 == 0, 1.0, -1.0), rng.standard_normal(130), np.zeros(130), h, T_S)
        for h in (5, 8)
    ]


def test_an_inductance_is_the_mean_of_the_models_with_their_spread() -> None:
    tried, shots = _tried(), _shots()
    slow = [shot.slow_basis() for shot in shots]
    found = axis_fit._average(shots, slow, 0.05, tried, None)
    criteria = np.array([fit.cost + PENALTY * len(fit.x) for fit, _ in tried.values()])
    share = np.exp(-0.5 * (criteria - np.min(criteria)))
    share /= np.sum(share)
    L = np.array([2e-3 * math.exp(fit.x[0]) for fit, _ in tried.values()])
    mean = share @ L
    variance = [L_m**2 * np.linalg.inv(fit.jacobian.T @ fit.jacobian)[0, 0] + (L_m - mean) ** 2
                for L_m, (fit, _) in zip(L, tried.values(), strict=True)]  # fmt: skip
    assert found.L_h == pytest.approx(mean, rel=EXACT) and found.std_h == pytest.approx(
        math.sqrt(share @ variance), rel=1e-6
    )
    best, layout = tried[Effects(bend=True)]
    assert found.effects == ("lag", "bend") and found.R_ohm == 0.5 and found.delay == 1.10
    assert found.lag_s == pytest.approx(math.exp(-1.5) * T_S) and found.n == 240
    bound = np.sqrt(np.linalg.inv(best.jacobian.T @ best.jacobian)[0, 0])
    assert found.bound_h == pytest.approx(2e-3 * math.exp(0.02) * bound, rel=1e-6)
    problem = axis_fit._Problem(shots, slow, 0.05, layout)
    rest = problem.per_shot(best.x)
    dof = 240 - sum(basis.shape[1] for basis in slow) - 8
    assert found.chi2 == pytest.approx(sum(float(r @ r) for r in rest) / dof, rel=EXACT)
    assert [place[0] for place in found.places] == pytest.approx(share[share > 1e-6]) and problem.rows == 240
    modelled = axis_fit.simulate([layout.responses(best.x)[1]], shots[1], slow[1])[0]
    off = axis_fit.projected((modelled - shots[1].i_a[SKIP_SAMPLES:]) / 0.05, slow[1])
    assert rest[1] == pytest.approx(off, rel=1e-6, abs=1e-9)


def test_what_drives_itself_or_stands_for_something_else_is_no_model() -> None:
    """A negative eddy current or motion, a resistance beside eddy currents of less than 0.8, an inductance of which
    they hide 14.8 % is one, and of which they hide 15.2 % is none."""
    shots = _shots()
    slow = [shot.slow_basis() for shot in shots]
    good = {Effects(): _tried()[Effects()], Effects(lag=False): _tried()[Effects(lag=False)]}
    plain = axis_fit._average(shots, slow, 0.05, good, None).L_h
    for layout, part, R, counts in (
        (_layout(eddy=True), [0.1, -1.0], 1.0, True), (_layout(eddy=True), [-0.1, -1.0], 1.0, False),
        (_layout(eddy=True), [0.1, -1.0], LEAST_R, False), (_layout(eddy=True), [0.0, -1.0], 1.0, True),
        (_layout(eddy=True), [1.08, 1.4], 1.0, True), (_layout(eddy=True), [1.12, 1.4], 1.0, False),
        (_layout(motion=True), [-0.1], 1.0, False),
        (_layout(motion=True), [0.1], 1.0, True), (_layout(motion=True), [0.0], 1.0, True),
        (replace(_layout(motion=True), motion=Motion(0.0, 1.0)), [-0.1], 1.0, True),
    ):  # fmt: skip
        more = (_fit([0.5, R, 1.0, -2.0, *part, 0.3, -0.2], 15.0, seed=9), layout)
        found = axis_fit._average(shots, slow, 0.05, {**good, layout.effects: more}, None).L_h
        assert (found == plain) is not counts
    ringing = {e: (fit, lay) for e, (fit, lay) in good.items()}
    lost = (replace(good[Effects()][0], residual=np.full(300, 1e9)), _layout())
    ringing[Effects()] = lost
    only = axis_fit._average(shots, slow, 0.05, ringing, None)
    assert only.L_h == pytest.approx(2e-3 * math.exp(0.02), rel=EXACT) and only.effects == ()


def test_a_larger_resistance_than_the_loop_s_is_no_model_where_eddy_currents_fit() -> None:
    """The model without them has the better criterion, and a smaller L, in each case."""
    shots = _shots()
    slow = [shot.slow_basis() for shot in shots]
    plain, eddy = _layout(dispersion=True), _layout(eddy=True)
    bare = {_layout(lag=lag).effects: (_fit([0.2, 1.0, 1.0, *[-2.0] * lag, 0.3, -0.2], 900.0), _layout(lag=lag))
            for lag in (True, False)}  # fmt: skip

    def L_h(R: float, R_eddy: float = 1.0, chi2: float = 0.9) -> float:
        x = [0.5, R_eddy, 1.0, -2.0, 0.1, -1.0, 0.3, -0.2]
        tried = {
            plain.effects: (_fit([0.01, R, 1.0, -2.0, 0.05, -0.1, 0.3, -0.2], 100.0), plain),
            eddy.effects: (_fit(x, chi2 * (300 - len(x)), seed=9), eddy),
        }
        return math.log(axis_fit._average(shots, slow, 0.05, bare | tried, None).L_h / 2e-3)

    assert L_h(1.01 * MOST_R) == pytest.approx(0.5, abs=0.02)
    for kept in (L_h(0.99 * MOST_R), L_h(1.01 * MOST_R, 1.01 * MOST_R), L_h(1.01 * MOST_R, chi2=1.01 * CHI2_WARN)):
        assert kept == pytest.approx(0.01, abs=0.02)


@pytest.mark.parametrize(("log_ratio", "share"), [(0.05, 0.5), (-0.05, 1.0)])
def test_two_inductances_are_known_no_better_than_half_their_difference(log_ratio: float, share: float) -> None:
    """Nor, where L falls with the period, than by all of it: no eddy currents do that."""
    shots = _shots()
    slow = [shot.slow_basis() for shot in shots]
    apart = (_fit([0.0, 1.0, 1.0, -2.0, log_ratio, 0.0, 0.3, -0.2], 10.0, size=1e6), _layout(dispersion=True))
    plain = (_fit([0.0, 1.0, 1.0, 0.3, -0.2], 900.0), _layout(lag=False))
    found = axis_fit._average(shots, slow, 0.05, {apart[1].effects: apart, plain[1].effects: plain}, None)
    assert found.L_by_shot_h == pytest.approx((2e-3, 2e-3 * math.exp(log_ratio)), rel=EXACT)
    # the fit's own is 1e-7 of it
    assert found.std_h == pytest.approx(share * 2e-3 * abs(math.expm1(log_ratio)), rel=1e-3)


# ---- the instant of the samples ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("ripple_a", "least"), [(0.3, 0.6), (1.1, 0.715), (2.0, 0.8)])
def test_d_currents_count_from_six_and_a_half_ripples_on(
    monkeypatch: pytest.MonkeyPatch, ripple_a: float, least: float
) -> None:
    """Between 0.6 and 0.8 of the largest; small ones show a wrong voltage here, which counts where they do."""
    monkeypatch.setattr(sampling_instant, "sampled_ripple", lambda voltage, *_: np.zeros((2, len(voltage[0]))))
    L_q = 300.0 * 50e-6 / (8.0 * ripple_a)
    modulation = Modulation(300.0, (3e-3, L_q), 50e-6, 1e-6)
    for share in (0.99 * least, 1.01 * least):
        level = np.repeat(np.where(np.arange(16) < 10, 10.0, share * 10.0), 2)
        w = np.repeat([300.0, 500.0, 700.0, 900.0, 1100.0, -300.0, -500.0, -700.0, -900.0, -1100.0,
                       400.0, 600.0, 800.0, -400.0, -600.0, -800.0], 2)  # fmt: skip
        sign = np.tile([1.0, -1.0], 16)
        u_d = np.where(level < 10.0, 0.3 * np.sin(w), 0.0)
        zero = np.zeros(32)
        rows = CoastingPairs(w, u_d, sign * level, zero, zero, 0.1 * w, [(2 * k, 2 * k + 1) for k in range(16)])
        shown = shown_instant(rows, 0.4, 0.1, modulation, 1.0)
        floor = math.hypot(0.0008 * 50e-6, 0.06 * 1e-6)
        assert shown is not None and (shown.std_s > 1.01 * floor) is (share > least)


def test_five_pairs_show_an_instant(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sampling_instant, "sampled_ripple", lambda voltage, *_: np.zeros((2, len(voltage[0]))))
    w, level = np.repeat([300.0, 500.0, 700.0, -400.0, -900.0], 2), np.tile([10.0, -10.0], 5)
    modulation = Modulation(300.0, (3e-3, 5e-3), 50e-6, 1e-6)
    for n in (5, 4):
        zero = np.zeros(2 * n)
        pairs = [(2 * k, 2 * k + 1) for k in range(n)]
        rows = CoastingPairs(w[: 2 * n], zero, level[: 2 * n], zero, zero, 0.1 * w[: 2 * n], pairs)
        assert (shown_instant(rows, 0.4, 0.1, modulation, 1.0) is not None) is (n == 5)


def test_the_curve_at_an_edge_begins_where_the_capacitance_takes_half_of_the_plateau() -> None:
    modulation = Modulation(300.0, (3e-3, 5e-3), 50e-6, 1e-6)
    assert modulation.plateau_v == pytest.approx(6.0, rel=EXACT)
    curve = InverterCurve(np.array([0.5, 1.0, 5.0]), np.array([4.0, 5.0, 6.6]), 0.2)
    found = edge_curve(curve, modulation)
    first = 0.5 + 4.0 * 50e-6 / (4.0 * 3e-3)
    charge = (6.0 - 4.0) * first
    assert found.i_phase_a[-3:] == pytest.approx([first, 1.0 + 5.0 / 240.0, 5.0 + 6.0 / 240.0], rel=EXACT)
    reached = edge_curve(InverterCurve(curve.i_phase_a, np.array([6.1, 6.1, 6.1]), 0.0), modulation)
    assert reached.u_error_v[-4] == pytest.approx(6.0 - 6e-3 * reached.i_phase_a[-3] / reached.i_phase_a[-4], rel=EXACT)
    below = found.i_phase_a[:-3]
    assert below[0] == pytest.approx(2.0 * charge / 6.0, rel=EXACT) and len(below) == 11
    assert np.diff(np.log(np.append(below, first))) == pytest.approx(
        np.full(11, math.log(first / below[0]) / 11.0), rel=1e-6
    )
    assert found.u_error_v[:-3] == pytest.approx(6.0 - charge / below, rel=EXACT) and found.u_error_v[
        0
    ] == pytest.approx(3.0)


# ---- inertia over flux linkage ----------------------------------------------------------------------------------


def _push(*, i_d: bool = True, turn: float = -5.0) -> Trace:
    """600 rows of 1 ms with a constant acceleration, which turns back after ``turn`` of them, and a rising current."""
    t = 2.0 + 1e-3 * np.arange(600)
    s = t - 2.0
    theta = 0.5 * 90.0 * (s - 1e-3 * turn) ** 2
    signals = {"theta_M_rad": theta, "i_q_a": 3.0 + 2.0 * s}
    return trace_of(t, **signals, **({"i_d_a": 0.4 - s} if i_d else {}))


def test_the_blocks_of_a_push_hold_speeds_and_integrals_without_their_means() -> None:
    """The first 12 % are left out; 24 blocks of 22 rows, of which the last ends a row sooner."""
    part = inertia_ratio._part(_push(turn=-200.0), 0.01, False)
    assert part is not None
    s = 1e-3 * (72.0 + 22.0 * np.arange(24) + 11.0)
    s[-1] -= 0.5e-3
    # at the middle of two rows a sum of trapezoids is interpolated: 1e-7
    expected = (
        90.0 * (s + 0.2), 3.0 * s + s**2, s, 45.0 * ((s + 0.2) ** 2 - 0.04), 1.2 * s - 1.1 * s**2 - 2.0 / 3.0 * s**3, s,
    )  # fmt: skip
    for found, value in zip(part, expected, strict=True):
        assert found == pytest.approx(value - np.mean(value), abs=2e-5 * float(np.ptp(value)))


def test_each_way_of_a_push_has_a_first_speed_of_its_own() -> None:
    split, whole = (inertia_ratio._part(_push(turn=300.0), 0.01, way) for way in (False, True))
    assert split is not None and whole is not None
    s = 1e-3 * (72.0 + 22.0 * np.arange(24) + 11.0)
    s[-1] -= 0.5e-3
    w = 90.0 * (s - 0.3)
    moving = np.abs(w) >= 0.05 * np.max(np.abs(w))
    before = np.count_nonzero(w[moving] < 0.0)
    assert len(whole[0]) == len(split[0]) == np.count_nonzero(moving) < 24
    for k in range(6):
        assert np.mean(split[k][:before]) == pytest.approx(0.0, abs=1e-12)
        assert np.mean(split[k][before:]) == pytest.approx(0.0, abs=1e-12)
        assert np.diff(split[k][:before]) == pytest.approx(np.diff(whole[k][:before]), rel=1e-6)
    assert whole[0] == pytest.approx(w[moving] - np.mean(w[moving]), rel=1e-6)
    assert abs(np.mean(whole[0][:before])) > 1.0


def test_a_push_too_short_out_of_order_or_at_rest_is_none() -> None:
    push = _push()
    assert (
        inertia_ratio._part(trace_of(push.t_s[:28], **{k: v[:28] for k, v in push.signals.items()}), 0.01, False)
        is not None
    )
    assert (
        inertia_ratio._part(trace_of(push.t_s[:26], **{k: v[:26] for k, v in push.signals.items()}), 0.01, False)
        is None
    )
    stuck = push.t_s.copy()
    stuck[72:95] = stuck[72]
    assert inertia_ratio._part(replace(push, t_s=stuck), 0.01, False) is None
    for blocks in (12, 11):
        theta = np.concatenate([np.zeros(72 + 22 * (24 - blocks)), 0.1 * np.arange(22 * blocks)])
        still = replace(push, signals={**push.signals, "theta_M_rad": theta})
        assert (inertia_ratio._part(still, 0.01, False) is None) is (blocks == 11)


def test_what_no_loop_decouples_is_a_high_pass_of_speed_times_current() -> None:
    push = _push(i_d=False)
    t, theta, i = push.t_s, push["theta_M_rad"], push["i_q_a"]
    slope = np.array(
        [
            (theta[min(k + 12, 599)] - theta[max(k - 12, 0)]) / (t[min(k + 12, 599)] - t[max(k - 12, 0)])
            for k in range(600)
        ]
    )
    a = math.exp(-1e-3 / 0.02)
    expected = lfilter([a], [1.0, -a], np.diff(slope * i, prepend=slope[0] * i[0]))
    assert inertia_ratio._left_of_slope(t, theta, i, 22, 0.02) == pytest.approx(expected, rel=1e-6, abs=1e-9)


def test_an_amplitude_shows_too_much_by_its_own_variation() -> None:
    """i (1 + a cos): a^2/2 over 1 + a^2/2, whatever slow course the current has beside. Measured: 2e-3 of it."""
    push = _push()
    wave = 1.0 + 0.2 * np.cos(2.0 * math.pi * 80.0 * push.t_s)
    shown = replace(push, signals={**push.signals, "i_q_a": 5.0 * wave})
    assert inertia_ratio._amplitude_excess([shown]) == pytest.approx(0.02 / 1.02, rel=0.01)
    assert inertia_ratio._amplitude_excess([shown, push]) == pytest.approx(0.01 / 1.02, rel=0.01)
    early = replace(push, signals={**push.signals, "i_q_a": np.where(np.arange(600) < 72, 9.0, push["i_q_a"])})
    assert inertia_ratio._amplitude_excess([early]) < 1e-12


def test_ratios_are_coefficients_over_the_rise_by_the_current() -> None:
    """w = a charge - b signs - c way, to the last digit; the jackknife of exact data is nothing."""
    rng = np.random.default_rng(80)
    parts = []
    for _ in range(5):
        columns = rng.standard_normal((5, 12))
        columns[0] = 7.0 * -columns[1] - 0.4 * columns[2] - 0.1 * columns[3]
        parts.append(tuple(columns))
    found, std = inertia_ratio._with_spread(parts, -1.0, 4, 3)
    assert found == pytest.approx([6.0 / 7.0, 0.4 * 6.0 / 7.0], rel=EXACT) and np.all(std < 1e-9)
    coefficients, rest = inertia_ratio._fit(parts, -1.0, 3)
    assert coefficients == pytest.approx([7.0, -0.4, -0.1], rel=EXACT) and rest < 1e-20
    noisy = [(part[0] + 0.1 * rng.standard_normal(12), *part[1:]) for part in parts]
    _, rest = inertia_ratio._fit(noisy, -1.0, 3)
    w, *others = np.hstack(noisy)[:4]
    assert rest == pytest.approx(np.linalg.lstsq(np.column_stack(others), w, rcond=None)[1][0], rel=1e-6)


def _ratios(
    monkeypatch: pytest.MonkeyPatch, plain: Sequence[float], salient: Sequence[float], stds: tuple[float, float, float],
    *, i_d: bool, whole: Sequence[float] = (3.0, 0.25), pushes: int = 5,
) -> dict[str, Any]:  # fmt: skip
    """Estimates where the regressions without and with a d current have these results; five pushes of 2 and 4 A."""
    monkeypatch.setattr(
        inertia_ratio, "_part", lambda push, lag, whole: (np.ones(20), 4.0 * np.arange(20.0), whole, np.arange(20.0))
    )
    monkeypatch.setattr(inertia_ratio, "_fit", lambda parts, sense, columns: (np.zeros(3), 1.0))
    friction = 0.02

    def spread(parts: Any, sense: float, pole_pairs: int, columns: int) -> tuple[Array, Array]:
        if columns == 3:
            return np.array(plain), np.array([stds[0], friction])
        return (
            (np.array(whole), np.array([stds[2], friction]))
            if parts[0][2]
            else (np.array(salient), np.array([stds[1], friction]))
        )

    monkeypatch.setattr(inertia_ratio, "_with_spread", spread)
    monkeypatch.setattr(inertia_ratio, "_amplitude_excess", lambda _: 0.015)
    return inertia_ratio.estimate_ratios(
        [_push(i_d=i_d)] * pushes, pole_pairs=4, tolerance=SensorTolerance(current_gain=0.02)
    )


@pytest.mark.parametrize("i_d", [True, False])
def test_a_d_current_counts_where_it_surely_changes_the_inertia(monkeypatch: pytest.MonkeyPatch, i_d: bool) -> None:
    """By three of its deviations, or where it is known better with it; without a measurement only downwards: no loop
    takes inertia away from a shaft."""
    std, doubt = 0.01, math.hypot(0.02, MODEL_FLOOR, 0.0 if i_d else 0.015)
    for salient, its_std, taken in (
        (3.0 - 1.01 * SURELY * 0.011, 0.011, True), (3.0 - 0.99 * SURELY * 0.011, 0.011, False),
        (3.0 + 1.01 * SURELY * 0.011, 0.011, i_d), (2.99, 0.0099, True), (2.99, 0.0101, False),
    ):  # fmt: skip
        found = _ratios(monkeypatch, (3.0, 0.3), (salient, 0.2), (std, its_std, 0.012), i_d=i_d, whole=(2.9, 0.25))
        ratio, friction = found["J_per_psi"], found["tau_c_per_psi"]
        J, tau = (2.9, 0.25) if taken else (3.0, 0.3)
        open_ = SATURATED_SHARE * 0.1 if taken else 0.0
        assert (ratio.value, friction.value, ratio.std) == pytest.approx((J, tau, 0.012 if taken else std), rel=EXACT)
        assert ratio.systematic == pytest.approx(math.hypot(J * doubt, open_), rel=EXACT)
        # the weakest push makes 1.5 p times its current: charge over time
        weakest = 6.0 * 4.0
        assert friction.systematic == pytest.approx(math.hypot(0.02 * tau, FRICTION_FLOOR * weakest), rel=EXACT)
        assert (ratio.n, ratio.dof, friction.std) == (100, 4.0, 0.02)


def test_the_least_pushes_are_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    told = pytest.raises(IdentificationError, match="3 usable torque pulses, 4 needed")
    for pushes in (inertia_ratio.LEAST_PUSHES, inertia_ratio.LEAST_PUSHES - 1):
        with nullcontext() if pushes == inertia_ratio.LEAST_PUSHES else told:
            _ratios(monkeypatch, (3.0, 0.3), (3.0, 0.3), (0.01, 9.0, 9.0), i_d=True, pushes=pushes)


def test_an_inertia_that_scatters_by_a_tenth_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    for share in (0.99, 1.01):
        std = share * RATIO_LIMIT * 3.0 / coverage_factor(4.0)
        told = pytest.raises(
            IdentificationError, match=r"J/psi is 3 \+-0.3 kg m2/Wb between the torque pulses, limit 10 %"
        )
        with nullcontext() if share < 1.0 else told:
            _ratios(monkeypatch, (3.0, 0.3), (3.0, 0.3), (std, 9.0, 9.0), i_d=True)


# ---- mechanics --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("cost", "elastic", "driving"), [
    (20.0, False, {}), (20.0, True, {}), (0.0, False, {}), (0.0, False, {1: -0.5}), (0.0, False, {1: -3e-5}),
    (0.0, False, {3: -0.3}), (0.0, True, {2: -0.4, 3: -0.1}),
])  # fmt: skip
def test_friction_is_the_mean_of_models_with_and_without_drag(
    monkeypatch: pytest.MonkeyPatch, cost: float, elastic: bool, driving: dict[int, float]
) -> None:
    """Weighted by their criteria, half at least where noise may hide the drag. What would drive the shaft is held at
    zero: least squares of the others, at their cost; where the data contradict it, half of what it moved counts."""
    runs = [Run(np.linspace(0.0, 1.0 + k, 101), np.full(100, 0.5), 1e-2, np.full(101, 1e-4), 1e-4, k % 2 == 1)
            for k in range(4)]  # fmt: skip
    states = [0.0, 10.0] * 4
    shaft = [driving.get(k, value) for k, value in enumerate((math.log(2e-3), 0.1, 0.5, 0.1))]
    with_drag = _fit([*shaft, *states], 90.0 + cost, rows=404, size=3e3)
    without = _fit([math.log(2.1e-3), 2e-3, 0.06, *states], 104.0, rows=404, seed=1, size=3e3)
    times = 1.5 if cost else 1.0  # a fit with drag that stopped short of its minimum
    short = replace(with_drag, x=times * with_drag.x, residual=times * with_drag.residual)
    monkeypatch.setattr(mechanics, "_explained", lambda *_: (runs, short, 2.0, runs))
    monkeypatch.setattr(mechanics, "_minimum", lambda _, x, scale: with_drag if len(x) > len(without.x) else without)
    monkeypatch.setattr(mechanics, "require_useful", lambda *_: None)
    t = 1e-2 * np.arange(101.0)
    traces = [trace_of(t, {"coasting": k % 2 == 1}, theta_M_rad=0.01 * np.floor(1e2 * (t + t * t)), flagged=0.0 * t)
              for k in range(4)]  # fmt: skip
    found = mechanics.estimate_mechanics(traces, lambda d, q: q, 1.0, 0.01, 0.02, tolerance=SENSORS, elastic=elastic)
    free, held = [k for k in range(len(with_drag.x)) if k not in driving], list(driving)
    others, left, *_ = np.linalg.lstsq(with_drag.jacobian[:, free], with_drag.jacobian[:, held] @ with_drag.x[held])
    braking = np.zeros(len(with_drag.x))
    braking[free] = with_drag.x[free] + others
    more = float(left[0])
    odds = (braking[3] > 0.0) * math.exp(-0.5 * (with_drag.cost + more + mechanics.DRAG_PENALTY - without.cost))
    p = max(odds / (1.0 + odds), 0.5 * elastic)
    moved = 0.5 * (with_drag.x - braking)[:3] if more > 2.0 * COVERAGE_FACTOR**2 else np.zeros(3)
    assert (-3e-5 in driving.values()) is bool(0.0 < more < 2.0 * COVERAGE_FACTOR**2), "both sides of the limit"
    bounds = [np.sqrt(np.diag(np.linalg.inv(fit.jacobian.T @ fit.jacobian)))[:3] for fit in (without, with_drag)]
    means = (without.x[:3] + p * (apart := braking[:3] - without.x[:3])).tolist()
    covariance = np.linalg.inv(with_drag.jacobian.T @ with_drag.jacobian)[:4, :4]
    alone, dearer = mechanics._held_at_zero(with_drag.x[:4], covariance, (1, 3, 2), without=1)
    dearer += with_drag.cost - min(without.cost, with_drag.cost + more + mechanics.DRAG_PENALTY)
    spread = p * (1.0 - p) * apart**2 + moved**2 + 0.5 * (1.0 - math.tanh(0.25 * dearer)) * (alone[:3] - means) ** 2
    stds = np.sqrt(2.0 * ((1.0 - p) * bounds[0] ** 2 + p * bounds[1] ** 2 + spread)).tolist()
    J = math.exp(means[0])
    scale = math.hypot(0.02, mechanics.SCALE_FLOOR)
    for one, value, std in ((found.J, J, J * stds[0]), (found.B, means[1], stds[1]), (found.tau_c, means[2], stds[2])):
        assert one.value == pytest.approx(value, rel=1e-6)
        assert one.std == pytest.approx(math.hypot(std, scale * value), rel=1e-5)
        assert one.systematic == pytest.approx(0.05 * abs(value), rel=1e-6) and one.n == 404
    assert (found.drag is not None) is bool(p > 0.5) and found.chi2 == 2.0
    if (drag := found.drag) is not None:
        std = math.sqrt(2.0 * covariance[3, 3] + (scale * braking[3]) ** 2)
        assert (drag.value, drag.std, drag.systematic) == pytest.approx((braking[3], std, 0.05 * braking[3]), rel=1e-5)


SENSORS = SensorTolerance(current_gain=0.03, voltage_gain=0.04)


def test_means_are_doubted_by_their_scatter_and_the_torques_scale(monkeypatch: pytest.MonkeyPatch) -> None:
    t = 1e-2 * np.arange(101.0)
    traces = [trace_of(t, {"coasting": k % 2 == 1}, theta_M_rad=0.01 * np.floor(1e2 * (t + t * t)), flagged=0.0 * t,
                     i_d_a=0.0 * t, i_q_a=0.5 + 0.0 * t) for k in range(4)]  # fmt: skip
    for nothing in (0.0, -1e-3):
        nothing_found = np.array([nothing, 1e-3, 0.05]), np.eye(3), [], 1.0
        monkeypatch.setattr(mechanics, "_mean_motion", lambda *_, found=nothing_found, **__: found)
        assert mechanics.mean_mechanics(traces, lambda d, q: q, 0.03, 1) == {}
        with pytest.raises(IdentificationError, match="J = "):
            mechanics._start([])
    for stds, kept in (([1e-5, 1e-3, 0.02], 3), ([1e-5, 0.1, 0.02], 1), ([1e-5, 1e-3, 0.3], 1)):
        plain, square = np.diag(np.square(stds)), np.diag(np.square([1e-5, 1e-6, 0.01]))
        for misfit, share in ((1e9, 0.0), (1.0, 0.5), (0.25, 8.0 / 9.0)):  # of friction over the square of the speed
            fits = {False: (np.array([2e-3, 1e-3, 0.05]), plain, [], 1.0),
                    True: (np.array([1.9e-3, 5e-5, 0.07]), square, [], misfit)}  # fmt: skip
            monkeypatch.setattr(mechanics, "_mean_motion", lambda blocks, power, drag, fits=fits: fits[drag])
            found = mechanics.mean_mechanics(traces, lambda d, q: q, 0.03, 1, SENSORS)
            assert share or len(found) == kept
            student = 3.182446 / COVERAGE_FACTOR  # of three degrees of freedom: two pushes, four halves
            for k, one in enumerate(found.values()):
                x, of_square = fits[False][0][k], (1.9e-3, 0.0, 0.07)[k]
                value, own = x + share * (of_square - x), (1.0 - share) * stds[k] ** 2
                own += share * square[k, k] * (k != 1)
                spread = math.sqrt(share * (1.0 - share)) * (of_square - x)
                std = math.hypot(student * math.sqrt(own), 0.05 * value, spread)
                assert (one.value, one.std, one.systematic) == pytest.approx((value, std, 0.05 * value), rel=1e-4)


def test_a_swing_explains_the_share_of_a_regression_beside_the_rigid_shaft() -> None:
    rng = np.random.default_rng(81)
    t = 1e-3 * np.arange(300)
    i = 2.0 + 0.1 * np.cos(40.0 * t)
    theta = (
        0.3
        + t
        + 4.0 * t**2
        + 0.01 * np.exp(-0.05 * 500.0 * t) * np.cos(500.0 * t + 0.7)
        + 1e-3 * rng.standard_normal(300)
    )
    push = trace_of(5.0 + t, theta_M_rad=theta, i_d_a=0.0 * t, i_q_a=i)
    explained = swing._explained([push], lambda d, q: 0.7 * q)
    half = 1 + 300 // 100
    turning = np.sign([theta[min(k + half, 299)] - theta[max(k - half, 0)] for k in range(300)])
    rigid = np.stack(
        [np.ones(300), t, np.cumsum(np.cumsum(i)), np.cumsum(np.cumsum(turning)), np.cumsum(theta - theta[0])], axis=1
    )
    rigid /= np.max(np.abs(rigid), axis=0)

    def left(columns: Array) -> float:
        return float(np.sum((theta - columns @ np.linalg.lstsq(columns, theta, rcond=None)[0]) ** 2))

    for hz in (40.0, 500.0 / 2.0 / math.pi, 120.0):
        w = 2.0 * math.pi * hz
        shares = []
        for zeta in swing.ZETAS:
            waves = np.exp(-zeta * w * t)[:, None] * np.stack([np.cos(w * t), np.sin(w * t)], axis=1)
            shares.append(1.0 - left(np.hstack([rigid, waves])) / left(rigid))
        assert explained(hz) == pytest.approx(max(shares), rel=1e-6)


# ---- a second mass ----------------------------------------------------------------------------------------------


@pytest.mark.chain
def test_a_second_mass_must_explain_more_than_a_rigid_shaft_that_rings() -> None:
    rng = np.random.default_rng(82)
    omega, T = 2.0 * math.pi * np.linspace(10.0, 300.0, 126), 2e-4
    U, noise = (rng.standard_normal((4, 126)) + 1j * rng.standard_normal((4, 126)) for _ in range(2))
    s = 1j * omega
    G = 500.0 * (s**2 + 30.0 * s + 550.0**2) / (s**2 + 70.0 * s + 700.0**2)
    unsure = np.full(126, 0.02)
    tolerance = SensorTolerance()
    found, lines, rigid = fr._judged(omega, U, G * U + 15.0 * noise, T, unsure, (0.01, tolerance))
    inner = slice(HALF_WIDTH, 126 - HALF_WIDTH)
    response, sigma, std, coherence = local_polynomials(U, G * U + 15.0 * noise)
    assert lines.sigma == pytest.approx(np.hypot(sigma, 0.02 * np.abs(response)), rel=EXACT)
    assert lines.omega == pytest.approx(omega[inner]) and lines.back == pytest.approx(np.exp(-1j * omega[inner] * T))
    assert found.frequency_hz == pytest.approx(omega[inner] / 2.0 / math.pi)
    assert found.chi2_rigid == pytest.approx(rigid.cost / (len(rigid.residual) - 2), rel=EXACT)
    start = fr._start(lines.omega, response, std)
    assert start is not None
    two = fr._fit(lines, fr._two_mass, start)
    ringing = fr._fit(lines, lambda at, x: (fr._rigid(at, x)[0], fr._two_mass(at, two.x)[1]), rigid.x)
    chi2 = two.cost / (len(two.residual) - 6)
    penalty = math.log(960.0)  # four records of 120 lines, real and imaginary
    expected = (min(rigid.cost - 8.0 * penalty, ringing.cost) - two.cost) / max(1.0, chi2) - 4.0 * penalty
    assert found.information_gain == pytest.approx(expected, rel=1e-6) and expected > 10.0
    assert (
        found.chi2_two_mass == pytest.approx(chi2, rel=1e-6)
        and found.highest_hz == found.frequency_hz[coherence >= 0.5][-1]
    )
    ratio = (found.found["resonance_hz"].value / found.found["antiresonance_hz"].value) ** 2
    assert found.reason == f"two masses, J_load/J_motor {ratio - 1.0:.3g}, measured up to {found.highest_hz:.3g} Hz"
    assert found.inertia is not None and found.inertia.value == pytest.approx((700.0 / 550.0) ** 2 / 500.0, rel=0.02)


def test_residuals_of_a_fit_are_without_their_transients() -> None:
    """Each record's transient is linear: what two columns explain of a record is no residual."""
    rng = np.random.default_rng(83)
    omega, T = 2.0 * math.pi * np.linspace(10.0, 300.0, 60), 2e-4
    back = np.exp(-1j * omega * T)
    U, noise = (rng.standard_normal((3, 60)) + 1j * rng.standard_normal((3, 60)) for _ in range(2))
    Y = 300.0 * np.exp(-0.2j * omega * T) * U + 40.0 * noise + np.outer([900.0, -500.0, 100.0], 1.0 - back)
    sigma = rng.uniform(30.0, 60.0, 60)
    fit = fr._fit(fr._Lines(omega, back, T, U, Y, sigma), fr._rigid, np.array([math.log(250.0), 0.0]))
    cost = 0.0
    weight = math.sqrt(2.0) / np.tile(sigma, 2)
    basis = np.stack([np.ones(60), back], axis=1)
    columns = np.vstack([basis.real, basis.imag]) * weight[:, None]
    for record in range(3):
        off = Y[record] - math.exp(fit.x[0]) * np.exp(-1j * omega * fit.x[1] * T) * U[record]
        target = np.concatenate([off.real, off.imag]) * weight
        cost += float(np.linalg.lstsq(columns, target, rcond=None)[1][0])
    assert fit.cost == pytest.approx(cost, rel=1e-6)
    assert fit.x == pytest.approx([math.log(300.0), 0.2], abs=0.1)
    assert all(a < b for a, b in pairwise(omega))
