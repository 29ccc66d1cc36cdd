# SPDX-License-Identifier: MIT
"""Each step of the flux linkage by itself: windows, regressions, doubts, the second method; against other formulas."""

from __future__ import annotations

import math
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from pmsmtool.arrays import Array
from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.cross_check import (
    FLOOR,
    JUDGES,
    LAG_STD,
    RIPPLE_DOUBT,
    SATURATION_DOUBT,
    CrossCheck,
    cross_check,
    driven_flux_linkage,
)
from pmsmtool.estimators.estimate import COVERAGE_FACTOR, SensorTolerance
from pmsmtool.estimators.flux import linkage
from pmsmtool.estimators.flux.linkage import (
    D_SHARE_DOUBT,
    LEVEL_RATIO,
    MODEL_FLOOR,
    PENALTY,
    estimate_flux_linkage,
    normalised,
)
from pmsmtool.estimators.flux.linkage_rows import (
    CURRENT_SETTLE_LIMIT,
    PAIR_RATIO,
    Q_SHARE,
    SPEED_RATIO,
    Corrected,
    check_speeds,
    corrected,
    mean_inverter_error,
    pairs_of,
    usable,
)
from pmsmtool.estimators.injection.sampling_instant import Sampling, course_s2, sampled_ripple
from pmsmtool.estimators.inverter_error import InverterCurve, Modulation, rippled_error_dq_v
from pmsmtool.machine.parameters import Estimate
from pmsmtool.trace import Trace

T_S, R, PSI, L_D, L_Q = 1e-4, 0.4, 0.3, 4e-3, 7e-3
EXACT = 1e-9
"""The same numbers by another formula (relative); measured: below 1e-12."""
CURVE = InverterCurve(np.array([0.2, 1.0, 4.0]), np.array([0.5, 0.9, 1.1]), 0.0)
SWITCHED = Modulation(300.0, (L_D, L_Q), T_S, 1e-6)


def _trace(**signals: Array) -> Trace:
    return Trace(np.arange(float(len(next(iter(signals.values()))))), signals, dict.fromkeys(signals, "1"))


def _windows(levels: tuple[float, ...] = (4.0,), *, slope: float = 0.0) -> Trace:
    """Windows of d currents of both signs at four speeds each way, and two of q currents, of a linear machine."""
    rows = [
        (sense * speed, sign * level, 0.05 * level)
        for sense in (1.0, -1.0) for speed in (170.0, 230.0, 290.0, 350.0) for level in levels for sign in (1.0, -1.0)
    ]  # fmt: skip
    rows += [(speed, 0.02, sign * 3.0) for speed in (260.0, -250.0) for sign in (1.0, -1.0)]
    w, i_d, i_q = np.array(rows).T
    x, a = 0.5 * w * T_S, slope * w
    half = np.full_like(w, 0.05)
    signals = {
        "u_d_v": R * i_d - w * L_Q * i_q * np.sin(x) / x, "u_q_v": R * i_q + w * (PSI + L_D * i_d) * np.sin(x) / x,
        "i_d_a": i_d, "i_q_a": i_q, "omega_e_rad_s": w - 1.5 * T_S * a, "omega_first_rad_s": w - 0.5 * half * a,
        "omega_second_rad_s": w + 0.5 * half * a, "half_s": half, "T_magnet_c": np.full_like(w, 60.0),
    }  # fmt: skip
    signals |= {f"i_{axis}_{part}_a": signals[f"i_{axis}_a"] for axis in "dq" for part in ("first", "second")}
    return _trace(**signals)


def _changed(trace: Trace, **signals: Array) -> Trace:
    return _trace(**{**trace.signals, **signals})


# ---- windows ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("i_d", "i_q", "w", "paired"),
    [
        ((2.0, -2.3), (0.1, 0.1), (90.0, 80.0), True), ((-2.3, 2.0), (0.1, 0.1), (-90.0, -80.0), True),
        ((2.0, 2.0), (0.1, 0.1), (90.0, 80.0), False), ((2.0, -2.0), (0.1, 0.1), (90.0, -80.0), False),
        ((2.0, -2.0 * PAIR_RATIO), (0.1, 0.1), (90.0, 80.0), False),
        ((2.0, -1.99 * PAIR_RATIO), (0.1, 0.1), (90.0, 80.0), True),
        ((2.0, -2.2), (0.0, -1.99 * Q_SHARE), (90.0, 80.0), True),
        ((2.0, -2.2), (0.0, -2.0 * Q_SHARE), (90.0, 80.0), False), ((2.0, -2.2), (0.1, 0.1), (90.0, 0.0), False),
        ((2.0, -2.2), (2.01 * Q_SHARE, 0.0), (90.0, 80.0), False),
        ((2.0, 0.0), (0.0, 0.0), (90.0, 80.0), False),
    ],
)  # fmt: skip
def test_windows_of_opposite_d_currents_are_a_pair(
    i_d: tuple[float, float], i_q: tuple[float, float], w: tuple[float, float], paired: bool
) -> None:
    found = pairs_of(_trace(i_d_a=np.array(i_d), i_q_a=np.array(i_q), omega_e_rad_s=np.array(w)))
    assert found == ([(0, 1)] if paired else [])


def test_a_window_belongs_to_one_pair() -> None:
    i_d = np.array([1.0, 2.0, -2.0, 2.0, -2.0, 2.0])
    speeds = _trace(i_d_a=i_d, i_q_a=0.0 * i_d, omega_e_rad_s=np.full(6, 50.0))
    assert pairs_of(speeds) == [(1, 2), (3, 4)]


def _checked(**signals: Array) -> str:
    whole = _changed(_windows(), **signals)
    left, told = usable(whole)
    check_speeds(left, pairs_of(left), whole)
    return told


def test_a_run_needs_four_pairs_each_way_over_speeds_that_differ() -> None:
    trace = _windows()
    w = trace["omega_e_rad_s"]
    assert _checked() == ""
    for sign, name in ((1.0, "forward"), (-1.0, "backward")):
        for ratio in (SPEED_RATIO, 0.99 * SPEED_RATIO):
            speed = np.where(w * sign > 0.0, sign * np.clip(np.abs(w), 170.0, ratio * 170.0), w)
            refused = pytest.raises(IdentificationError, match=f"E_EXCITATION: 4 pairs of d currents {name}")
            with nullcontext() if ratio == SPEED_RATIO else refused:
                _checked(omega_e_rad_s=speed, omega_first_rad_s=speed, omega_second_rad_s=speed)
        gone = int(np.argmax(w * sign == 170.0))
        with pytest.raises(IdentificationError, match=f"E_EXCITATION: 3 pairs of d currents {name}"):
            _checked(i_d_a=np.where(np.arange(len(w)) == gone, 0.0, trace["i_d_a"]))


def test_a_speed_or_a_current_that_moves_is_told_where_and_by_how_much() -> None:
    """All windows of one direction are lost where the worst of them moves most."""
    trace = _windows()
    w = trace["omega_e_rad_s"]
    more = (w > 0.0) * (1.0 + 0.01 * (np.arange(len(trace)) == 2))
    for share in (0.39, 0.41):
        refused = pytest.raises(
            IdentificationError, match="at 230 rad/s the speed moves by 41 % in one window, limit 40 %"
        )
        with nullcontext() if share == 0.39 else refused:
            _checked(omega_second_rad_s=w + more * share * w, omega_first_rad_s=w)
    largest = math.hypot(4.0, 0.2)
    for axis in ("i_d", "i_q"):
        moved = trace[f"{axis}_first_a"]
        for share in (0.98, 1.05):
            refused = pytest.raises(IdentificationError, match=f"at 230 rad/s {axis} moves by 1.1 A .*limit 1 A")
            with nullcontext() if share < 1.0 else refused:
                _checked(**{f"{axis}_second_a": moved - more * share * CURRENT_SETTLE_LIMIT * largest})


def test_of_a_pair_with_a_window_that_is_limited_or_moves_none_is_left() -> None:
    """One window in which an encoder's error moved i_d lost psi and mechanics of a whole run."""
    whole = _changed(_windows(), flagged=np.zeros(20))
    assert np.array_equal(usable(whole)[0]["u_q_v"], whole["u_q_v"])
    (first, second), alone = pairs_of(whole)[1], next(k for k in range(20) if all(k not in p for p in pairs_of(whole)))
    bad = np.isin(np.arange(20), (second, alone))
    moved = whole["i_d_first_a"] + 3.0 * bad
    for change, why in (
        ({"flagged": 2.0 * bad}, "limited by voltage or current"),
        ({"i_d_second_a": moved}, "not settled"),
        ({"flagged": 2.0 * bad, "i_d_second_a": moved}, "limited by voltage or current or not settled"),
    ):
        kept, told = usable(_changed(whole, **change))
        assert np.array_equal(kept["u_q_v"], np.delete(whole["u_q_v"], [first, second, alone]))
        assert len(kept.t_s) == len(kept) == 17
        assert told == f"3 of 20 windows left out, {why}"
    with pytest.raises(IdentificationError, match="E_CLIPPED: voltage or current limited in 17 windows"):
        _checked(flagged=1.0 * (np.arange(20) < 17))


# ---- what is taken off ------------------------------------------------------------------------------------------


def test_the_error_of_a_window_is_the_mean_over_a_turn() -> None:
    """A sixth of a turn repeats: of 60 angles and of 7200 over the whole turn; measured: 8e-6 V."""
    i_d, i_q = np.array([3.0, -0.5, 0.0]), np.array([0.0, 0.7, -2.0])
    angle = np.tile(np.linspace(0.0, 2.0 * math.pi, 7200, endpoint=False), 3)
    many = (np.repeat(i_d, 7200), np.repeat(i_q, 7200))
    plain = np.stack(CURVE.error_dq_v(*many, angle)).reshape(2, 3, -1).mean(axis=2)
    assert mean_inverter_error(CURVE, (i_d, i_q)) == pytest.approx(plain, abs=3e-5)
    v_d, v_q = np.array([1.0, -20.0, 5.0]), np.array([60.0, -50.0, 90.0])
    angle, i_d, i_q, v_d, v_q = angle[::60], *(np.repeat(part, 120) for part in (i_d, i_q, v_d, v_q))
    rippled = (
        np.stack(rippled_error_dq_v(CURVE, (i_d, i_q), (v_d, v_q), angle, SWITCHED)).reshape(2, 3, -1).mean(axis=2)
    )
    found = mean_inverter_error(CURVE, (i_d[::120], i_q[::120]), (v_d[::120], v_q[::120]), SWITCHED)
    assert found == pytest.approx(rippled, abs=4e-3)  # 120 angles of a turn, each sixth has 20; measured 0.0011 V
    assert np.max(np.abs(found - plain)) > 0.05


def test_windows_without_ripple_show_the_flux_linkages_at_the_time_of_the_voltage() -> None:
    """The drive turns its voltage by the speed it shows, which is old by the lag; u_d has that part of the flux."""
    lag_s, slope = 2e-3, -0.6
    shown = _windows(slope=slope)
    w = shown["omega_e_rad_s"] + 1.5 * T_S * slope * (shown["omega_e_rad_s"] / (1.0 - 1.5 * T_S * slope))
    acceleration = slope * w
    old = _changed(shown, omega_e_rad_s=w - (lag_s + 1.5 * T_S) * acceleration)
    error = mean_inverter_error(CURVE, (old["i_d_a"], old["i_q_a"]))
    turned = 1.5 * T_S * lag_s * acceleration * w * np.median(old["u_q_v"] / w)
    old = _changed(old, u_d_v=old["u_d_v"] + error[0], u_q_v=old["u_q_v"] + error[1])
    # the median of u_q/w is that of the voltage with the error in it
    turned = 1.5 * T_S * lag_s * acceleration * w * np.median(old["u_q_v"] / w)
    rows = corrected(old, R, T_S, CURVE, None, lag_s)
    assert rows.w == pytest.approx(w, rel=EXACT) and rows.acceleration_rad_s2 == pytest.approx(acceleration, rel=EXACT)
    i_d, i_q, x = old["i_d_a"], old["i_q_a"], 0.5 * w * T_S
    assert rows.u_q == pytest.approx(w * (PSI + L_D * i_d), rel=EXACT)
    expected = -w * L_Q * i_q + turned
    assert rows.u_d == pytest.approx(expected, abs=EXACT * float(np.max(np.abs(expected))))
    assert np.all(x / np.sin(x) > 1.0)
    assert rows.ripple_q_v == pytest.approx(np.zeros(len(w))) and rows.curve_q_v == pytest.approx(error[1], rel=EXACT)
    assert np.array_equal(rows.is_d, [True] * 16 + [False] * 4)


@pytest.mark.parametrize("sampling", [None, Sampling(0.04 * T_S, 0.02 * T_S)])
def test_resistance_and_error_follow_the_currents_that_flow(sampling: Sampling | None) -> None:
    """The samples hold a piece of the ripple and of the course within a period; the mean current is without both, and
    the one at the period's start has its own."""
    trace = _windows()
    w, x = trace["omega_e_rad_s"], 0.5 * trace["omega_e_rad_s"] * T_S
    voltage, current = (trace["u_d_v"], trace["u_q_v"]), (trace["i_d_a"], trace["i_q_a"])
    bend = 0.5 * w**2 * np.median(voltage[1] / w) / L_D  # of i_d over the time from the middle of the period
    when = sampling or Sampling()
    mean = np.stack(current) - sampled_ripple(voltage, current, SWITCHED, when)
    mean[0] -= bend * course_s2(when, T_S)
    start = mean + sampled_ripple(voltage, current, SWITCHED, Sampling())
    start[0] += bend * course_s2(Sampling(), T_S)
    error = mean_inverter_error(CURVE, (start[0], start[1]), voltage, SWITCHED)
    flux = (np.stack(voltage) - error - R * mean) * x / np.sin(x)
    flux[1] += w * L_D * bend * (course_s2(when, T_S) - course_s2(Sampling(), T_S))
    rows = corrected(trace, R, T_S, CURVE, SWITCHED, 0.0, sampling)
    assert rows.u_d == pytest.approx(flux[0], rel=EXACT) and rows.u_q == pytest.approx(flux[1], rel=EXACT)
    assert rows.ripple_q_v == pytest.approx(error[1] - mean_inverter_error(CURVE, (start[0], start[1]))[1], rel=EXACT)
    assert rows.curve_q_v == pytest.approx(mean_inverter_error(CURVE, current)[1], rel=EXACT)
    assert (np.max(np.abs(flux[1] / w - PSI - L_D * current[0])) > 1e-4) and np.any(np.abs(mean - current) > 1e-3)


# ---- regressions ------------------------------------------------------------------------------------------------


def _rows(w: Array, i_d: Array, i_q: Array, u_d: Array, u_q: Array, **parts: Array) -> Corrected:
    zero = np.zeros_like(w)
    rest = {name: parts.get(name, zero) for name in ("acceleration_rad_s2", "ripple_q_v", "curve_q_v", "error_d_v")}
    return Corrected(w=w, i_d=i_d, i_q=i_q, u_d=u_d, u_q=u_q, is_d=np.abs(i_q) < Q_SHARE * np.abs(i_d), **rest)


def _scattered(levels: tuple[float, ...], rng: np.random.Generator) -> tuple[Corrected, list[tuple[int, int]]]:
    trace = _windows(levels)
    w, i_d, i_q = trace["omega_e_rad_s"], trace["i_d_a"], trace["i_q_a"]
    w = w * rng.uniform(0.98, 1.02, len(w))
    noise = 0.02 * rng.standard_normal((2, len(w)))
    u_d, u_q = -L_Q * w * i_q + noise[0], w * (PSI + L_D * i_d) + noise[1]
    return _rows(w, i_d, i_q, u_d, u_q, curve_q_v=0.3 * np.sign(i_q)), pairs_of(trace)


def test_one_level_of_d_currents_has_a_weighted_mean() -> None:
    rows, pairs = _scattered((4.0,), np.random.default_rng(1))
    a, b = np.array(pairs).T
    w = rows.w[a] + rows.w[b]
    used = np.concatenate([a, b])
    columns = np.stack([rows.w, rows.w * rows.i_d, np.sign(rows.w * rows.i_d)], axis=1)[used]
    rough = np.linalg.solve(columns.T @ columns, columns.T @ rows.u_q[used])[1]
    left = rows.u_q - rough * rows.w * rows.i_d
    y, weight = (left[a] + left[b]) / w, w**2
    found = linkage._fit_even(rows, pairs)
    mean = np.average(y, weights=weight)
    assert found.flux_wb == pytest.approx(mean, rel=EXACT) and found.curvature == 0.0
    assert found.low_wb == pytest.approx(np.average(y, weights=w * np.sign(w)), rel=EXACT)
    n = len(pairs)
    variance = np.sum(weight * (y - mean) ** 2) / np.sum(weight) / (n - 1)
    assert found.std_wb == pytest.approx(math.sqrt(variance), rel=1e-6)
    assert found.dof == n - 1 and found.low_i_d_a == 4.0
    assert found.low_std_wb == pytest.approx(np.std(y) / math.sqrt(n - 1), rel=EXACT)
    assert found.w == pytest.approx(0.5 * w, rel=EXACT) and found.residual_wb == pytest.approx(y - mean, rel=1e-6)
    share = np.bincount(used, np.tile(weight / np.sum(weight) / w, 2), minlength=len(rows.w))
    assert found.row == pytest.approx(share, rel=EXACT)
    assert found.change(np.arange(20.0)) == pytest.approx(share @ np.arange(20.0), rel=EXACT)


def test_levels_of_d_currents_are_a_polynomial_or_none_as_the_scatter_has_it() -> None:
    """Two models, each by a weighted fit, with the share that their criteria give; the spread of both is doubt."""
    rows, pairs = _scattered((1.5, 4.0), np.random.default_rng(4))
    bent = replace(rows, u_q=rows.u_q + 1.2e-5 * rows.w * rows.i_d**2)
    a, b = np.array(pairs).T
    w, level = bent.w[a] + bent.w[b], 0.5 * np.abs(bent.i_d[a] - bent.i_d[b])
    used = np.concatenate([a, b])
    columns = np.stack([bent.w, bent.w * bent.i_d, np.sign(bent.w * bent.i_d)], axis=1)[used]
    rough = np.linalg.solve(columns.T @ columns, columns.T @ bent.u_q[used])[1]
    left = bent.u_q - rough * bent.w * bent.i_d
    y, s = (left[a] + left[b]) / w, level / 4.0
    weight = np.abs(w) * s / np.mean(np.abs(w) * s)
    n = len(y)
    value, chi, variance, curve = [], [], [], []
    for order in (0, 1):
        c, covariance = np.polyfit(s**2, y, order, w=weight, cov="unscaled")
        value.append(c[-1])
        chi.append(np.sum((weight * (y - np.polyval(c, s**2))) ** 2))
        variance.append(chi[-1] / (n - 1 - order) * covariance[-1, -1])
        curve.append(c[0] if order else 0.0)
    noise = chi[1] / (n - 2) + (MODEL_FLOOR * value[0]) ** 2
    odds = math.exp(-0.5 * ((chi[0] - chi[1]) / noise - PENALTY))
    share = np.array([odds, 1.0]) / (1.0 + odds)
    assert 0.05 < share[0] < 0.95  # both count
    found = linkage._fit_even(bent, pairs)
    mean = share @ value
    assert found.flux_wb == pytest.approx(mean, rel=EXACT)
    assert found.std_wb == pytest.approx(math.sqrt(share @ (variance + (np.array(value) - mean) ** 2)), rel=1e-6)
    assert found.curvature == pytest.approx(share @ curve / mean, rel=1e-6)
    assert found.dof == pytest.approx(share @ [n - 1, n - 2], rel=EXACT) and found.low_i_d_a == pytest.approx(1.5)
    low = level < 2.0
    assert found.low_wb == pytest.approx(np.average(y[low], weights=weight[low]), rel=EXACT)
    assert found.low_std_wb == pytest.approx(np.std(y[low]) / math.sqrt(np.sum(low) - 1), rel=EXACT)
    assert found.change(bent.u_q - rough * bent.w * bent.i_d) == pytest.approx(mean, rel=EXACT)


def _turned(rows: Corrected, unseen_a: float | Array) -> Corrected:
    """Rows whose inverter error of 4 V is turned by a q current that no sample holds."""
    turned = np.sign(rows.w) * 4.0 * unseen_a / np.hypot(rows.i_d, unseen_a) * rows.is_d
    return replace(rows, u_q=rows.u_q + turned, error_d_v=4.0 * np.sign(rows.i_d))


@pytest.mark.parametrize(("unseen_a", "bend"), [(0.25, 0.0), (0.0, -2e-3), (0.0, 0.0)])
def test_a_current_that_no_sample_holds_is_told_from_saturation(unseen_a: float, bend: float) -> None:
    """It turns the inverter's error, which falls with the d current; a bent axis changes with the square of it."""
    rows, pairs = _scattered((1.5, 3.0, 4.5), np.random.default_rng(3))
    bent = replace(rows, u_q=rows.u_q + rows.w * PSI * bend * (rows.i_d / 4.5) ** 2)
    found = linkage._fit_even(_turned(bent, unseen_a), pairs)
    assert found.flux_wb == pytest.approx(PSI, rel=3e-4)  # measured 1.1e-4
    assert found.unseen_a == pytest.approx(unseen_a, abs=8e-3)  # 2.7e-3
    assert found.curvature == pytest.approx(bend, abs=3e-4)  # 1.1e-4
    assert found.low_wb == pytest.approx(PSI * (1.0 + bend / 9.0), rel=3e-4)  # without what it makes of it: 1.7e-4
    if unseen_a:
        assert found.way_wb == pytest.approx(8.5e-3 * PSI, rel=0.05), "all of it is doubted in part"
        alone = linkage._fit_even(replace(_turned(bent, unseen_a), error_d_v=np.zeros_like(rows.w)), pairs)
        assert alone.unseen_a == 0.0 and alone.flux_wb > 1.005 * PSI  # what the polynomial makes of it: 1.0098


def test_driven_windows_tell_which_of_two_rough_models_counts() -> None:
    """A current that grows with the speed fits a polynomial better than the model of one that does not."""
    rows, pairs = _scattered((1.5, 3.0, 4.5), np.random.default_rng(3))
    rough = _turned(rows, 0.3 * (np.abs(rows.w) / 350.0))
    alone = linkage._fit_even(rough, pairs)
    found = linkage._fit_even(rough, pairs, Estimate(PSI, 3e-4 * PSI, 0.0, "Wb"))
    assert alone.flux_wb > 1.008 * PSI and alone.unseen_a == pytest.approx(0.0, abs=1e-6)  # measured 1.0093
    assert found.flux_wb == pytest.approx(PSI, rel=1.5e-3) and found.unseen_a > 0.1  # 1.04e-3, 0.16 A


@pytest.mark.parametrize("levels", [(4.0,), (1.5, 4.0)])
def test_the_d_voltages_give_inductance_and_frame_with_their_deviations(levels: tuple[float, ...]) -> None:
    rows, _ = _scattered(levels, np.random.default_rng(2))
    w, i_d, i_q, d = rows.w, rows.i_d, rows.i_q, rows.is_d
    columns = [-w * i_q, w, -(w**2), -w * i_d, i_d]
    if len(levels) > 1:  # what a bent curve and a frame ahead of a bent axis add
        columns += [np.sign(i_d) * d, w * i_d**2 * d, w * ~d]
    matrix = np.stack(columns, axis=1)
    matrix /= (size := np.linalg.norm(matrix, axis=0))
    inverse = np.linalg.inv(matrix.T @ matrix)
    x = inverse @ matrix.T @ rows.u_d
    dof = len(w) - len(columns)
    std = np.sqrt(np.sum((rows.u_d - matrix @ x) ** 2) / dof * np.diag(inverse)) / size
    turned = D_SHARE_DOUBT * np.abs(rows.curve_q_v) * np.sign(w * i_q) * ~d
    std[0] = math.hypot(std[0], (inverse @ matrix.T @ turned)[0] / size[0])
    found, found_std, found_dof = linkage._fit_d(rows)
    assert found == pytest.approx(x / size, rel=1e-6, abs=1e-9) and found_dof == dof
    assert found_std == pytest.approx(std, rel=1e-6)
    assert found[0] == pytest.approx(L_Q, abs=3.0 * std[0]) and std[0] < 0.02 * L_Q


def test_levels_count_as_two_from_their_ratio_on() -> None:
    for ratio, columns in ((0.99 * LEVEL_RATIO, 5), (1.01 * LEVEL_RATIO, 8)):
        rows, _ = _scattered((3.0, 3.0 * ratio), np.random.default_rng(2))
        assert len(linkage._fit_d(rows)[0]) == columns


# ---- doubts -----------------------------------------------------------------------------------------------------


@pytest.mark.chain
@pytest.mark.parametrize(("late_s", "driven_off"), [(9e-6, 0.0), (-9e-6, 0.03)])
def test_the_deviation_is_made_of_what_each_cause_moves(late_s: float, driven_off: float) -> None:
    """Each cause is put in at the far end, and what it moves of the flux linkage counts by its share.

    A frame that is 0.1 rad off, samples that are late or angles that are old, and what only q currents show.
    """
    trace = _windows(slope=-0.6)
    w, scatter = trace["omega_e_rad_s"], 0.01 * np.random.default_rng(7).standard_normal((2, len(trace)))
    trace = _changed(
        trace, u_d_v=trace["u_d_v"] + 0.1 * PSI * w - PSI * w**2 * late_s + scatter[0],
        u_q_v=trace["u_q_v"] + scatter[1] + driven_off * PSI * w * (np.abs(trace["i_q_a"]) > 1.0),
    )  # fmt: skip
    sampling, lag_s, apart_s = Sampling(0.05 * T_S, 0.1 * T_S), 0.01, 0.01 * T_S
    tolerance = SensorTolerance(voltage_gain=0.01, bridge_threshold_v=0.3, U_dc_v=300.0, encoder_latency_s=2e-6)

    def estimate(trace: Trace, sampling: Sampling = sampling, lag_s: float = lag_s) -> linkage.FluxResult:
        return estimate_flux_linkage(
            trace, R, period_s=T_S, inverter=CURVE, modulation=SWITCHED, lag_s=lag_s, sampling=sampling,
            apart_s=apart_s, tolerance=tolerance,
        )  # fmt: skip

    found = estimate(trace)
    psi = found.psi_measured.value
    rows = corrected(trace, R, T_S, CURVE, SWITCHED, lag_s, sampling)

    second = driven_flux_linkage(rows, linkage._rough_L_d(rows, np.nonzero(rows.is_d)[0]), 0.0, 0.0, lag_s,
                                 replace(tolerance, bridge_threshold_v=0.0), 60.0)  # fmt: skip
    even = linkage._fit_even(rows, pairs_of(trace), second)
    moved = even.change  # the direct part: the models keep their shares, and the median of the d axis stays
    step = 1e-3 * T_S
    later, sooner = (
        corrected(trace, R, T_S, CURVE, SWITCHED, lag_s, replace(sampling, instant_s=t)).u_q
        for t in (sampling.instant_s + step, sampling.instant_s - step)
    )
    per_instant = moved(later - sooner) / (2.0 * step)
    assert found.shown is not None and abs(per_instant) > 1.0
    model = [
        linkage.RIPPLE_DOUBT * moved(rows.ripple_q_v), linkage.CURVE_DOUBT * moved(rows.curve_q_v),
        linkage.CURVATURE_DOUBT * even.way_wb,
        linkage.LAG_STD * lag_s * moved(psi * rows.acceleration_rad_s2),
        per_instant * math.hypot(found.shown.std_s, apart_s), linkage.RELATIVE_FLOOR * psi, 0.001 * psi,
    ]  # fmt: skip
    d_fit, d_std, _ = linkage._fit_d(rows)
    eps = math.atan2(d_fit[1], even.flux_wb)
    assert psi == pytest.approx(math.hypot(d_fit[1], even.flux_wb), rel=EXACT)
    fitted = math.hypot(math.cos(eps) * even.std_wb, math.sin(eps) * d_std[1])
    apart = 0.0
    if driven_off:
        driven = driven_flux_linkage(rows, linkage._rough_L_d(rows, np.nonzero(rows.is_d)[0]), d_fit[1], even.curvature,
                                     lag_s, tolerance, 60.0)  # fmt: skip
        assert driven is not None
        apart = driven.value - psi
    assert found.apart_wb == pytest.approx(apart, rel=EXACT)
    std = math.sqrt(fitted**2 + sum(part**2 for part in model) + apart**2)
    assert found.psi_measured.std == pytest.approx(std, rel=3e-3)  # of the instant a one-sided difference: 1e-4
    assert found.psi_measured.dof == pytest.approx(even.dof * (std / fitted) ** 4, rel=0.01)
    assert found.low_std_wb == pytest.approx(math.hypot(even.low_std_wb, *model), rel=2e-3)
    old = abs(per_instant) * max(0.0, found.shown.value_s)
    assert (old > 1e-4 * psi) is (late_s > 0.0) and found.shown.computation_periods == 1.0
    expected = math.hypot(0.01 * psi, per_instant * 2e-6) + old
    assert found.psi_measured.systematic == pytest.approx(expected, rel=3e-3)  # 1.6e-3
    offset = found.frame_offset
    assert offset.value == pytest.approx(eps, rel=EXACT)
    assert offset.std == pytest.approx(
        math.hypot(math.cos(eps) * d_std[1] / psi, math.sin(eps) * even.std_wb / psi, 1e-4)
    )
    q = ~rows.is_d
    assert found.L_q_app.i_q_apk == pytest.approx(3.0) and found.L_q_app.n == np.sum(q) == 4
    assert found.L_q_app.systematic == pytest.approx(math.hypot(0.01, 0.01) * abs(d_fit[0]), rel=EXACT)


def test_the_frame_is_known_as_well_as_both_parts_of_the_flux_linkage() -> None:
    """0.4 rad off, with 3 V of scatter in both voltages: what turns the vector is across it."""
    trace = _windows()
    w, x = trace["omega_e_rad_s"], 0.5 * trace["omega_e_rad_s"] * T_S
    share = w * PSI * np.sin(x) / x
    scatter = 3.0 * np.random.default_rng(10).standard_normal((2, len(trace)))
    turned = _changed(
        trace, u_d_v=trace["u_d_v"] + share * math.sin(0.4) + 0.1 * scatter[0],
        u_q_v=trace["u_q_v"] + share * (math.cos(0.4) - 1.0) + scatter[1],
    )  # fmt: skip
    rows = corrected(turned, R, T_S, None, None, 0.0)
    even, (fit, std, _) = linkage._fit_even(rows, pairs_of(turned)), linkage._fit_d(rows)
    psi, eps = math.hypot(even.flux_wb, fit[1]), math.atan2(fit[1], even.flux_wb)
    found = estimate_flux_linkage(turned, R, period_s=T_S).frame_offset
    parts = math.cos(eps) * std[1] / psi, math.sin(eps) * even.std_wb / psi, linkage.OFFSET_FLOOR_RAD
    assert found.std == pytest.approx(math.hypot(*parts), rel=EXACT) and parts[1] > 0.5 * parts[0]
    assert found.value == pytest.approx(eps, rel=EXACT)


@pytest.mark.parametrize("off_deg", [29.0, -29.0, 31.0, -31.0, 170.0])
def test_a_voltage_of_the_magnets_far_off_the_q_axis_is_refused(off_deg: float) -> None:
    trace = _windows()
    w, x, off = trace["omega_e_rad_s"], 0.5 * trace["omega_e_rad_s"] * T_S, math.radians(off_deg)
    share = w * PSI * np.sin(x) / x
    trace = _changed(
        trace, u_d_v=trace["u_d_v"] + share * math.sin(off), u_q_v=trace["u_q_v"] + share * (math.cos(off) - 1.0)
    )
    refused = pytest.raises(
        IdentificationError, match=f"E_NOT_IDENTIFIABLE.* lies {off_deg:g} deg off the q axis, limit 30"
    )
    with nullcontext() if abs(off_deg) < 30.0 else refused:
        found = estimate_flux_linkage(trace, R, period_s=T_S)
        assert found.frame_offset.value == pytest.approx(off, abs=1e-6)
        assert found.psi_measured.value == pytest.approx(PSI, rel=1e-6)


def test_flux_linkages_move_to_the_reference_temperature_with_the_doubt_of_both() -> None:
    measured = Estimate(0.3, 0.003, 0.004, "Wb", T_c=70.0)
    tolerance = SensorTolerance(temperature_k=2.0, magnet_per_k=0.0003)
    found = normalised(measured, 20.0, -0.001, tolerance)
    factor = 1.0 - 0.001 * 50.0
    assert (found.value, found.std) == pytest.approx((0.3 / factor, 0.003 / factor), rel=EXACT)
    thermal = found.value * math.hypot(0.001 * 2.0, 0.0003 * 50.0)
    assert found.systematic == pytest.approx(math.hypot(0.004 / factor, thermal), rel=EXACT) and not found.fallback
    unknown = normalised(replace(measured, T_c=math.nan), 20.0, -0.001, tolerance)
    assert (unknown.value, unknown.std, unknown.systematic) == (0.3, 0.003, 0.004) and unknown.fallback


# ---- the second method ------------------------------------------------------------------------------------------


# ---- the second method ------------------------------------------------------------------------------------------


def test_a_check_compares_what_both_do_not_share() -> None:
    found = cross_check("b", "a", Estimate(1.02, 0.05, 0.0, "1"), Estimate(1.0, 0.03, 0.0, "1"), 0.02)
    assert found.difference == pytest.approx(0.02, rel=EXACT)
    own = 1.02**2 * ((0.05 / 1.02) ** 2 - 0.02**2 + 0.03**2 - 0.02**2)  # of a ratio of 1.02
    assert found.half_width == pytest.approx(COVERAGE_FACTOR * math.sqrt(own), rel=EXACT)
    assert found.verdict == f"agrees with a: +2 % off, interval of that {100.0 * found.half_width:.3g} %"


@pytest.mark.parametrize(
    ("difference", "half_width", "word"),
    [
        (-0.1, 0.1, "agrees with"), (0.1001, 0.1, "DISAGREES with"), (-0.1001, 0.1, "DISAGREES with"),
        (0.1, JUDGES, "agrees with"), (0.1, 1.01 * JUDGES, "too uncertain to judge"), (0.4, 0.35, "DISAGREES with"),
    ],
)  # fmt: skip
def test_a_check_agrees_within_its_interval(difference: float, half_width: float, word: str) -> None:
    check = CrossCheck("b", "a", Estimate(1.0, 0.1, 0.0, "1"), difference, half_width)
    assert check.verdict.startswith(word) and check.agrees is not word.startswith("DIS")


def _driven(**parts: Array) -> Corrected:
    w = np.array([100.0, 110.0, -90.0, -95.0, 200.0, 220.0, 50.0])
    i_q = np.array([2.0, -2.5, 3.0, -2.0, -2.0, 2.0, 2.0])
    i_d = np.array([0.1, -0.2, 0.3, 0.1, -0.1, 0.2, 0.0])
    scatter = np.array([0.0, 0.0, 0.003, 0.003, -0.003, -0.003, 9.0])
    u_q = w * (PSI + scatter + L_D * i_d) + 0.8 * np.array([1, -1, 1, -1, -1, 1, 1])
    return _rows(w, i_d, i_q, 0.0 * w, u_q, **parts)


def test_q_currents_of_both_signs_cancel_what_is_odd() -> None:
    """Three pairs; each window belongs to the one next to it, and the last to none."""
    nothing = SensorTolerance(voltage_gain=0.02, bridge_threshold_v=0.0)
    across, value = 0.04, math.hypot(PSI, 0.04)
    found = driven_flux_linkage(_driven(), L_D, across, 0.0, 0.0, nothing, 35.0)
    assert found is not None and (found.n, found.T_c, found.i_d_apk) == (3, 35.0, 0.0)
    assert found.value == pytest.approx(value, rel=EXACT) and found.systematic == pytest.approx(0.02 * value, rel=EXACT)
    scatter = 0.003 / math.sqrt(3.0)
    assert found.std == pytest.approx(math.hypot(scatter, FLOOR * value), rel=EXACT)
    assert found.i_q_apk == pytest.approx(np.mean([2.0, 2.5, 3.0, 2.0, 2.0, 2.0, 2.0]), rel=EXACT)
    w = _driven().w
    every = driven_flux_linkage(
        _driven(ripple_q_v=0.01 * w, acceleration_rad_s2=-5.0 * w), L_D, across, 0.03, 2e-3,
        replace(nothing, bridge_threshold_v=0.5, U_dc_v=100.0), 35.0,
    )  # fmt: skip
    assert every is not None
    parts = (
        scatter, RIPPLE_DOUBT * 0.01, LAG_STD * 2e-3 * value * 5.0, SATURATION_DOUBT * 0.03 * value, FLOOR * value,
        0.005 * value,
    )  # fmt: skip
    assert every.std == pytest.approx(math.hypot(*parts), rel=EXACT)


def test_one_pair_of_q_currents_is_no_second_method() -> None:
    rows = _driven()
    two = Corrected(**{name: getattr(rows, name)[:4] for name in Corrected.__dataclass_fields__})
    one = Corrected(**{name: getattr(rows, name)[:3] for name in Corrected.__dataclass_fields__})
    tolerance = SensorTolerance()
    found = driven_flux_linkage(two, L_D, 0.0, 0.0, 0.0, tolerance, 20.0)
    assert found is not None and found.n == 2
    assert driven_flux_linkage(one, L_D, 0.0, 0.0, 0.0, tolerance, 20.0) is None
    apart = replace(two, is_d=np.array([False, True, False, False]))  # the first two are not next to each other
    assert driven_flux_linkage(apart, L_D, 0.0, 0.0, 0.0, tolerance, 20.0) is None
