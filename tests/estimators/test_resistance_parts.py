# SPDX-License-Identifier: MIT
"""Each step of the resistance by itself: regression, gates, doubts, temperatures; against other formulas for them."""

from __future__ import annotations

import math
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pmsmtool.arrays import Array
from pmsmtool.errors import IdentificationError
from pmsmtool.estimators import resistance
from pmsmtool.estimators.current_sensors import Noise
from pmsmtool.estimators.estimate import COVERAGE_FACTOR, SensorTolerance, Verdict
from pmsmtool.estimators.inverter_error import InverterCurve
from pmsmtool.estimators.resistance import (
    FIT_FROM,
    HALF_WIDTH_LIMIT,
    HARD_FACTOR,
    KNEE_SHARE,
    LINK_TOLD,
    PLATEAU_SEEN,
    TAIL_TERMS,
    WITHIN_KNEE,
    Copper,
    copper_of,
    estimate_resistance,
    normalised,
    resistance_warmed,
    tail_models,
    two_point_slope,
    unsettled,
)
from pmsmtool.identification.evaluate import warming
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.parameters import Estimate, InverterParameters, MachineParameters
from pmsmtool.trace import Trace

EXACT = 1e-9
"""The same numbers by another formula (relative); measured: below 1e-12."""
ALPHA, R = 0.004, 0.8
PHASE_FACTOR = math.cos(math.pi / 6.0)
COPPER = Copper(T_ref_c=20.0, alpha_per_k=ALPHA, R_winding_ohm=0.6, winding_half_ohm=0.03)


def _levels(*, peak: float = 10.0, low: tuple[float, ...] = (0.02, 0.05, 0.1), **signals: Array) -> Trace:
    """Levels up and down, of both signs; an inverter whose error is V (1 - 0.05/u) of the largest current's share."""
    up = [*low, *np.linspace(0.2, 1.0, 9)]
    u = np.array([sign * x for x in [*up, *up[::-1]] for sign in (1.0, -1.0)])
    i, V = peak * u, 1.5
    v = R * i + V * np.sign(u) * np.where(np.abs(u) < 0.05, 0.1, 1.0 - 0.05 / np.maximum(np.abs(u), 0.05)) + 0.02
    base = {
        "i_d_a": i, "u_d_v": v, "u_d_first_v": v, "u_d_second_v": v, "i_d_first_a": i, "i_d_second_a": i,
        "T_winding_c": np.full_like(i, math.nan),
    }  # fmt: skip
    every = {**base, **signals}
    return Trace(0.25 * np.arange(float(len(i))), every, dict.fromkeys(every, "1"), {"samples": 400})


NOISE = Noise(0.01, 0.0, 0.0)


# ---- levels -----------------------------------------------------------------------------------------------------


def test_the_rough_slope_is_that_of_sixty_percent_to_the_largest_level() -> None:
    """Levels near them count with both signs; what is odd or constant cancels, what lies elsewhere is not met."""
    i = np.array([10.0, -9.8, 6.5, -5.5, 5.3, 0.5, 9.7, 6.7])
    v = R * i + 1.5 * np.sign(i)
    v[5:] = 1e3  # outside of both
    v[4] = -1e3
    assert two_point_slope(i, v) == pytest.approx(R, rel=EXACT)


def test_without_a_level_at_sixty_percent_all_below_seventy_count() -> None:
    i = np.array([10.0, -10.0, 4.0, -3.0, 6.9, 7.0])
    v = R * i + 1.5 * np.sign(i)
    v[5] = 1e3
    assert two_point_slope(i, v) == pytest.approx(R, rel=EXACT)
    with pytest.raises(IdentificationError, match="all levels have the same magnitude"):
        two_point_slope(np.array([10.0, -10.0, 7.1]), np.array([8.0, -8.0, 6.0]))
    with pytest.raises(IdentificationError, match=r"does not rise with the current \(-0.8 ohm\)"):
        two_point_slope(i[:5], -v[:5])


def test_five_levels_of_each_sign_are_needed() -> None:
    """Nine of 0.2 to 1: eight of them are above 0.28; two that differ by less than a fiftieth are one."""
    trace = _levels()
    i = trace["i_d_a"]
    resistance._check_levels(trace, i, np.abs(i) >= FIT_FROM * 10.0, NOISE)
    for sign in (1.0, -1.0):
        for count in (TAIL_TERMS + 3, TAIL_TERMS + 2):
            keep = (i * sign < 0.0) | (np.abs(i) > 10.05 - count) | (np.abs(i) < 0.25 * 10.0)
            few = np.where(keep, i, sign * 10.0)
            refused = pytest.raises(
                IdentificationError, match="E_EXCITATION: 4 different levels of one sign from 3 to 10 A, 5 needed"
            )
            with nullcontext() if count == TAIL_TERMS + 3 else refused:
                resistance._check_levels(trace, few, np.abs(few) >= FIT_FROM * 10.0, NOISE)


@pytest.mark.parametrize("share", [0.97, 1.03, -0.97, -1.03])
@pytest.mark.parametrize(("sigma_a", "high"), [(1e-6, True), (0.5, True), (1e-6, False)])
def test_a_level_whose_voltage_moves_is_refused_beyond_its_limit(share: float, sigma_a: float, high: bool) -> None:
    """2e-3 of R I or six times the noise of a difference of halves; 2 % of the volts for what only draws the curve."""
    trace, noise = _levels(), Noise(sigma_a, 0.0, 0.0)
    i, v = trace["i_d_a"], trace["u_d_v"]
    R_0 = two_point_slope(i, v)
    limit = max(2e-3 * R_0 * 10.0, 6.0 * R_0 * sigma_a * math.sqrt(2.0 / 200.0)) if high else 0.02 * np.max(v)
    at = int(np.flatnonzero(np.isclose(i, 6.0 if high else 1.0))[0])
    moved = np.where(np.arange(len(i)) == at, share * limit + R_0 * 0.3, 0.0)  # R i of the current's own motion is none
    moving = _levels(u_d_second_v=v + moved, i_d_second_a=i + 0.3 * (moved != 0.0))
    assert np.flatnonzero(unsettled(moving, noise)).tolist() == ([at] if abs(share) > 1.0 else [])
    told = f"E_NOT_SETTLED: at {i[at]:.3g} A the voltage still moves by {share * limit:.3g} V .*limit {limit:.3g} V"
    with nullcontext() if abs(share) < 1.0 else pytest.raises(IdentificationError, match=told.replace("+", ".")):
        resistance._check_levels(moving, i, np.abs(i) >= FIT_FROM * 10.0, noise)


@pytest.mark.parametrize("shape", ["one way", "with the sign", "with the voltage"])
def test_a_motion_that_all_windows_share_is_no_ripple(shape: str) -> None:
    trace = _levels()
    i, v = trace["i_d_a"], trace["u_d_v"]
    moved = 0.1 * {"one way": np.ones_like(i), "with the sign": np.sign(i), "with the voltage": v / np.max(v)}[shape]
    high = np.abs(i) >= FIT_FROM * 10.0
    assert np.all(unsettled(_levels(u_d_second_v=v + moved), NOISE)[high & (np.abs(moved) > 0.02)])
    ripple = np.random.default_rng(3).uniform(-0.04, 0.04, len(i))
    assert not np.any(unsettled(_levels(u_d_second_v=v + ripple), NOISE))


def test_limited_levels_are_counted() -> None:
    flagged = np.zeros(48)
    flagged[[3, 5]] = 1.0, 4.0
    with pytest.raises(IdentificationError, match="E_CLIPPED: 2 levels"):
        estimate_resistance(_levels(flagged=flagged), NOISE)
    estimate_resistance(_levels(flagged=0.0 * flagged), NOISE)


# ---- regression -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("powers", tail_models())
def test_the_tail_is_a_weighted_least_squares(powers: tuple[int, ...]) -> None:
    """Rows above 0.28 of the largest, drift about the mean heating, and one row of what falls with the link."""
    rng = np.random.default_rng(4)
    trace = _levels()
    i, t = trace["i_d_a"], trace.t_s
    fall = -0.05 * np.abs(i) / 10.0 * rng.uniform(0.8, 1.2, len(i))
    v, sigma_v = trace["u_d_v"] + 1e-3 * rng.standard_normal(len(i)), 2e-3
    use = np.abs(i) >= FIT_FROM * 10.0
    x, s, u = i[use], np.sign(i[use]), np.abs(i[use]) / 10.0
    heating = (t[use] - np.average(t[use], weights=x**2)) / (t[-1] - t[0])
    columns = np.stack([x, s, s * s, x * heating, s * fall[use], *(s * u**-p for p in powers), u**-2.0], axis=1)
    rough = abs(np.polyfit(np.abs(x), np.abs(v[use]), 1)[1])
    weight = np.append(np.full(len(x), 1.0 / sigma_v), 1.0 / (0.25 * rough))
    extra = np.zeros(columns.shape[1])
    extra[[1, 4]] = -0.75, 1.0  # V of the link less three quarters of V
    matrix = np.vstack([columns, extra]) * weight[:, None]
    size = np.linalg.norm(matrix, axis=0)
    target = np.append(v[use], 0.0) * weight
    solution, chi2, *_ = np.linalg.lstsq(matrix / size, target, rcond=None)
    warmth = t[use] / np.ptp(t)
    fit = resistance._fit_tail(warmth, fall[use], i[use], v[use], sigma_v, powers)
    assert fit.x == pytest.approx(solution / size, rel=1e-6, abs=1e-9) and fit.chi2 == pytest.approx(chi2[0], rel=1e-6)
    covariance = np.linalg.inv((matrix / size).T @ (matrix / size)) / np.outer(size, size)
    assert np.sqrt(np.diag(fit.covariance)) == pytest.approx(np.sqrt(np.diag(covariance)), rel=1e-5)
    assert fit.dof == len(x) + 1 - columns.shape[1]
    assert resistance._criterion(fit, 48) == pytest.approx(fit.chi2 + columns.shape[1] * math.log(48.0), rel=EXACT)


def test_a_winding_warms_as_its_differential_equation_has_it() -> None:
    """Cold one median step before the first level; each value at three quarters of its level. Measured: below 1e-8."""
    i, t, tau_s = np.array([5.0, -10.0, 8.0, 2.0]), np.array([1.0, 1.3, 1.6, 2.1]), 0.7
    found = resistance._heated(t, i, tau_s)
    warm, before = 0.0, 0.7
    for k, now in enumerate(t):
        at = before + 0.75 * (now - before)
        solved = solve_ivp(lambda _, y, k=k: ((i[k] / 10.0) ** 2 - y) / tau_s, (before, now), [warm], t_eval=[at, now],
                           rtol=1e-10, atol=1e-12)  # fmt: skip
        assert found[k] == pytest.approx(solved.y[0, 0], rel=1e-6)
        warm, before = float(solved.y[0, 1]), now


WARMING_TOLERANCE = 0.06
"""A level is an interval with one mean temperature: 4.0 % off at a level of 0.23 time constants."""


def test_what_a_winding_warms_by_is_told_from_its_sensor() -> None:
    """It cools meanwhile to what is around it, whose temperature nothing tells. Without a sensor it is not known."""
    levels, k, tau_s = _levels(), 0.05, 1.1
    T_c = np.full(len(levels), 85.0)
    for n in range(1, len(T_c)):
        end = 80.0 + k * tau_s * levels["i_d_a"][n] ** 2
        T_c[n] = end + (T_c[n - 1] - end) * math.exp(-0.25 / tau_s)
    assert warming(_levels(T_winding_c=T_c)) == pytest.approx(k, rel=WARMING_TOLERANCE)
    assert warming(levels) == 0.0
    assert warming(_levels(T_winding_c=np.full_like(T_c, 20.0))) == pytest.approx(0.0, abs=1e-9)


def test_the_scatter_of_the_levels_decides_between_two_floors() -> None:
    trace = _levels()
    used = np.abs(trace["i_d_a"]) >= FIT_FROM * 10.0
    t, i, v = trace.t_s[used], trace["i_d_a"][used], trace["u_d_v"][used]
    none = np.zeros(len(i))
    noise_v, rough = 3e-4, R * 10.0
    least, most = math.hypot(noise_v, 1.2e-4 * rough), math.hypot(noise_v, 2e-4 * rough)
    assert resistance._level_sigma(t, none, i, v, R, noise_v) == pytest.approx(least, rel=EXACT)
    shape = np.random.default_rng(5).standard_normal(48)[used]
    found = []
    for size in (1.3 * least, 10.0 * least):
        found.append(resistance._level_sigma(t, none, i, v + size * shape, R, noise_v))
        scatter = min(
            (fit := resistance._fit_tail(t, none, i, v + size * shape, 1.0, powers)).chi2 / fit.dof
            for powers in tail_models()
        )
        assert found[-1] == pytest.approx(min(math.sqrt(scatter), most), rel=1e-2)
    assert least < found[0] < found[1] == pytest.approx(most, rel=EXACT)


# ---- link and knee ----------------------------------------------------------------------------------------------


def test_the_link_counts_where_it_moves_the_error_by_more_than_the_noise() -> None:
    i, error = np.array([1.0, -2.0, 3.0, -4.0]), np.array([0.5, -2.0, 1.0, 1.0])
    signals = {"u_d_v": i, "U_dc_v": np.array([99.0, 100.0, 97.0, 98.0])}
    short = Trace(np.arange(4.0), signals, dict.fromkeys(signals, "V"))
    fall = np.array([-0.01, 0.0, -0.03, -0.02])
    assert resistance._link_fall(short, i, error, 0.0599) == pytest.approx(fall, rel=EXACT, abs=1e-9)
    assert np.array_equal(resistance._link_fall(short, i, error, 0.0601), np.zeros(4))
    unknown = replace(short, signals={"u_d_v": i})
    assert np.array_equal(resistance._link_fall(unknown, i, error, 1e-9), np.zeros(4))


def test_ripple_in_the_means_of_a_link_does_not_hide_its_fall() -> None:
    """Real drive 216915: 0.03 % of ripple in the means of a link that falls by 1 %."""
    i = np.array([sign * level for level in np.linspace(0.3, 7.0, 14) for sign in (1.0, -1.0)])
    v = 0.9 * i + 20.0 * np.sign(i)
    fall, ripple = -0.01 * v * i / np.max(v * i), 3e-4 * np.resize([1.0, -1.0, -1.0, 1.0, 1.0], len(i))
    signals = {"u_d_v": v, "U_dc_v": 325.0 * (1.0 + fall + ripple)}
    levels = Trace(np.arange(float(len(i))), signals, dict.fromkeys(signals, "V"))
    off = resistance._link_fall(levels, i, v - 0.9 * i, 1e-3) - fall
    assert np.std(off) < 1.2e-4  # measured 0.6e-4; not smoothed 3e-4


def test_a_link_that_moves_the_error_by_less_than_the_noise_is_none() -> None:
    """1e-4 of 1.5 V beside 4e-4 V of noise."""
    steady = estimate_resistance(_levels(), NOISE)
    falling = estimate_resistance(_levels(U_dc_v=100.0 - 1e-3 * np.abs(_levels()["i_d_a"])), NOISE)
    assert falling.R_measured.value == steady.R_measured.value


def test_what_was_assumed_of_the_link_is_told() -> None:
    assert resistance._told_of_the_link(0.99 * LINK_TOLD) == "" != resistance._told_of_the_link(LINK_TOLD)
    told = resistance._told_of_the_link(0.042)
    assert told.startswith("the DC link falls by 4.2 % under the test current: 75 +- 50 % of the inverter's error")


BEYOND = 1.01 / PLATEAU_SEEN


@pytest.mark.parametrize(
    ("V_dead", "plateau", "knee", "threshold", "hidden_v"),
    [
        (1.0, 0.0, 0.9 * KNEE_SHARE, 0.0, 0.0), (1.0, 1.0 / PLATEAU_SEEN, 0.1, 0.0, 0.0),  # the levels reach it
        (1.0, 0.0, 1.1 * KNEE_SHARE, 0.0, 0.0), (1.0, 0.0, 2.0, 0.0, 0.5),  # flat in the end; half of it lacks
        (1.0, BEYOND, 0.1, 0.0, 1.15 * BEYOND - 1.0),  # a dead time of 1.15 of what the drive says
        (1.0, BEYOND, 0.1, 0.1, 1.15 * BEYOND + 0.1 - 1.0), (1.0, BEYOND, 0.1, 1.2, BEYOND),  # the whole at most
        (1.0, 0.1, 5.0, 0.0, 0.8), (1.0, 0.0, 1.0, 0.0, 1.0),  # just there, and still rising: all of it may go on
        (-1.0, 0.0, 1.1 * KNEE_SHARE, 0.0, 1.0),
    ],
)  # fmt: skip
def test_what_the_knee_may_hide_is_what_its_error_lacks_over_the_largest_level(
    V_dead: float, plateau: float, knee: float, threshold: float, hidden_v: float
) -> None:
    i = np.linspace(0.2, 4.0, 39)
    curve = InverterCurve(i, V_dead * np.minimum(1.0, i / (4.0 * knee)), 0.0)
    found = resistance._hidden_in_knee(curve, V_dead, plateau, threshold)
    within = resistance._hidden_in_knee(curve, V_dead, plateau, threshold, True)  # a model that misses the last levels
    assert within == found or (
        found == 0.0 and within == pytest.approx(max(0.0, 1.15 * plateau + threshold - V_dead) / 4)
    )
    assert found == pytest.approx(hidden_v / 4.0, rel=EXACT, abs=1e-12)


# ---- gates ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("drift", "refused"), [(0.15, False), (-0.15, False), (0.151, True), (-0.151, True)])
def test_a_resistance_that_drifts_is_refused(drift: float, refused: bool) -> None:
    told = f"E_THERMAL_DRIFT: R changed by \\{100.0 * drift:+.2g} % over the sweep, limit 15 %"
    with pytest.raises(IdentificationError, match=told) if refused else nullcontext():
        resistance._check_drift(drift)


@pytest.mark.parametrize(("R_ohm", "share", "refused"), [(2.0, 0.99, False), (2.0, 1.01, True), (-1.0, 0.0, True)])
def test_a_resistance_that_is_not_known_is_refused(R_ohm: float, share: float, refused: bool) -> None:
    half = share * HALF_WIDTH_LIMIT * abs(R_ohm)
    told = f"E_NOT_IDENTIFIABLE.* R = {R_ohm:.4g} .- {half:.2g} ohm .95 %., limit 10 %"
    with pytest.raises(IdentificationError, match=told) if refused else nullcontext():
        resistance._check_result(R_ohm, half / COVERAGE_FACTOR, HALF_WIDTH_LIMIT)
    resistance._check_result(1.0, 0.1, COVERAGE_FACTOR * 0.1)


# ---- temperatures -----------------------------------------------------------------------------------------------


def test_what_a_file_says_of_the_winding() -> None:
    """A deviation is two of them and the systematic part; without one it is the tenth of a data sheet."""
    machine = MachineParameters(pole_pairs=2, R_s_ohm=1.0, L_d_h=1e-3, L_q_h=1e-3, psi_f_wb=0.1, J_kgm2=1e-4,
                                R_winding_ohm=0.6, T_ref_c=25.0, alpha_R_per_k=0.0039)  # fmt: skip
    file = MachineFile("m", machine, InverterParameters(U_dc_v=48.0, f_s_hz=20e3))
    assert copper_of(file) == Copper(25.0, 0.0039, 0.6, pytest.approx(0.06, rel=EXACT))  # type: ignore[arg-type]
    known = replace(file, std={"R_winding_ohm": 0.01}, systematic={"R_winding_ohm": 0.02})
    assert copper_of(known).winding_half_ohm == pytest.approx(COVERAGE_FACTOR * 0.01 + 0.02, rel=EXACT)
    assert copper_of(replace(known, systematic={})).winding_half_ohm == pytest.approx(COVERAGE_FACTOR * 0.01, rel=EXACT)
    none = copper_of(replace(file, machine=replace(machine, R_winding_ohm=None)))
    assert none.R_winding_ohm is None and none.winding_half_ohm == 0.0


@pytest.mark.parametrize(("winding", "copper_ohm"), [(0.6, 0.6), (None, 0.8 / 1.2)])
def test_a_resistance_moves_with_its_copper_part(winding: float | None, copper_ohm: float) -> None:
    """0.8 ohm at 70 degC; at the reference temperature the copper part has ``copper_ohm``, devices have the rest."""
    copper = replace(COPPER, R_winding_ohm=winding)
    measured = Estimate(0.8, 0.01, 0.004, "ohm", T_c=70.0)
    cold = 0.8 - copper_ohm * ALPHA * 50.0
    tolerance = SensorTolerance(temperature_k=2.0, device_share_max=0.3)
    found = normalised(measured, copper, tolerance)
    assert found.value == pytest.approx(cold, rel=EXACT) and found.std == pytest.approx(0.01 * cold / 0.8, rel=EXACT)
    share = 0.3 if winding is None else 0.03 / cold
    parts = (0.004 * cold / 0.8, share * ALPHA * 50.0 * cold, ALPHA * 2.0 * cold)
    assert found.systematic == pytest.approx(math.hypot(*parts), rel=EXACT)
    unknown = normalised(replace(measured, T_c=math.nan), copper, tolerance)
    at_reference = [0.8 - min(winding or math.inf, 0.8 / (1.0 + ALPHA * rise)) * ALPHA * rise for rise in (-15.0, 70.0)]
    off = max(abs(x - 0.8) for x in at_reference)
    assert unknown.value == 0.8 and unknown.systematic == pytest.approx(math.hypot(0.004, off), rel=EXACT)


@pytest.mark.parametrize(("winding", "copper_ohm"), [(None, 0.8 / 1.12), (0.6, 0.6), (2.0, 0.8 / 1.12)])
def test_a_measured_resistance_at_another_temperature(winding: float | None, copper_ohm: float) -> None:
    """0.8 ohm at 50 degC; the copper part is stated at the reference temperature, and is at most all of the loop."""
    copper = replace(COPPER, R_winding_ohm=winding)
    measured = Estimate(0.8, 0.01, 0.0, "ohm", T_c=50.0)
    assert resistance_warmed(measured, 90.0, copper) == pytest.approx(0.8 + copper_ohm * ALPHA * 40.0, rel=EXACT)
    for T, measured_at in ((math.nan, 50.0), (90.0, math.nan)):
        assert resistance_warmed(replace(measured, T_c=measured_at), T, copper) == 0.8


@pytest.mark.parametrize("winding", [None, 0.4])
def test_each_level_counts_at_its_own_temperature(winding: float | None) -> None:
    """A sensor that shows 30 K over the sweep, and R that follows it: R belongs to the mean heating."""
    cold = _levels()
    i = cold["i_d_a"]
    T = 30.0 + 30.0 * np.linspace(0.0, 1.0, 48)
    mean = np.average(T, weights=i**2)
    slope = ALPHA * (R / (1.0 + ALPHA * (mean - 20.0)) if winding is None else winding)
    v = cold["u_d_v"] + slope * (T - mean) * i
    halves = dict.fromkeys(("u_d_v", "u_d_first_v", "u_d_second_v"), v)
    found = estimate_resistance(_levels(T_winding_c=T, **halves), NOISE, copper=replace(COPPER, R_winding_ohm=winding))
    plain = estimate_resistance(cold, NOISE, copper=COPPER)
    assert found.R_measured.value == pytest.approx(R, rel=EXACT)
    assert plain.R_measured.value == pytest.approx(R, rel=EXACT)
    assert found.R_measured.T_c == pytest.approx(mean, rel=EXACT) and math.isnan(plain.R_measured.T_c)
    assert abs(found.drift) < EXACT and found.R_measured.n == 32 and found.R_measured.i_d_apk == 10.0


# ---- the result -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("scatter_v", "marked"), [(1e-3, False), (6e-3, True)])
def test_the_deviation_is_that_of_the_averaged_models_and_of_what_they_do_not_see(
    scatter_v: float, marked: bool
) -> None:
    """The spread of five fits and the deviation of each, the bridge's threshold, the second order of the drift; and
    what the fit leaves over the largest current, where that is more than its limit."""
    trace = _levels()
    i = trace["i_d_a"]
    rng = np.random.default_rng(6)
    v = trace["u_d_v"] + 0.02 * R * i * np.linspace(0.0, 1.0, 48) + scatter_v * rng.standard_normal(48)
    trace = _levels(u_d_v=v, u_d_first_v=v, u_d_second_v=v)
    tolerance = SensorTolerance(bridge_threshold_v=0.4, U_dc_v=50.0, current_gain=0.003, voltage_gain=0.004)
    found = estimate_resistance(trace, NOISE, tolerance=tolerance)
    R_0 = two_point_slope(i, v)
    noise_v = 1.05 * R_0 * 0.01 / 20.0
    used = np.abs(i) >= FIT_FROM * 10.0
    rough_v, T = math.hypot(noise_v, 2e-4 * R_0 * 10.0), trace["T_winding_c"]
    warm = resistance._warmth(trace.t_s, T, np.zeros(48), i, v, used, rough_v)[used]
    shown = (warm, np.zeros_like(warm), i[used], v[used])
    sigma_v = resistance._level_sigma(*shown, R_0, noise_v)
    fits = [resistance._fit_tail(*shown, sigma_v, powers) for powers in tail_models()]
    odds = np.exp(-0.5 * np.array([fit.chi2 + len(fit.x) * math.log(48.0) for fit in fits]))
    share = odds / np.sum(odds)
    each = np.array([fit.x[:4] for fit in fits])
    value, V, v_0, drift = share @ each
    assert found.R_measured.value == pytest.approx(value, rel=EXACT)
    assert found.V_dead_v == pytest.approx(PHASE_FACTOR * V, rel=EXACT)
    assert found.drift == pytest.approx(drift / value, rel=EXACT) and found.drift == pytest.approx(0.02, rel=0.2)
    best = min(fit.chi2 / fit.dof for fit in fits)
    assert found.R_measured.chi2 == pytest.approx(best, rel=EXACT) and (3.0 < best) is marked
    assert (found.verdict is Verdict.WARN) is marked
    widen, misfit = max(1.0, best), math.sqrt(best) * sigma_v / 10.0 if marked else 0.0
    variance = share @ [fit.covariance[0, 0] * widen + (fit.x[0] - value) ** 2 for fit in fits]
    std = math.sqrt(variance + (0.02 * found.drift * value) ** 2 + (0.008 * value) ** 2 + misfit**2)
    assert found.R_measured.std == pytest.approx(std, rel=EXACT)
    assert found.R_measured.systematic == pytest.approx(0.005 * value, rel=EXACT) and not found.R_measured.fallback
    # what is left beside R: the curve of one phase, at currents of both signs
    left = PHASE_FACTOR * np.sign(i) * (v - value * i - v_0)
    for k, level in enumerate(found.curve.i_phase_a):
        near = np.isclose(np.abs(i), level / PHASE_FACTOR, rtol=0.02)
        assert found.curve.u_error_v[k] == pytest.approx(np.mean(left[near]), rel=1e-6)


@pytest.mark.parametrize(("volts", "factor"), [(2.9, 1.0), (3.1, HARD_FACTOR)])
def test_an_error_of_three_times_the_voltage_of_R_widens_its_deviation(volts: float, factor: float) -> None:
    """The columns have the error's shape: what is added changes no deviation, but the doubt of the link."""
    i = _levels()["i_d_a"]
    V = volts * R * 10.0 / PHASE_FACTOR - 1.5
    v = _levels()["u_d_v"] + V * np.sign(i)
    stds = []
    for voltage in (_levels()["u_d_v"], v):
        halves = dict.fromkeys(("u_d_v", "u_d_first_v", "u_d_second_v"), voltage)
        found = estimate_resistance(_levels(**halves), NOISE)
        stds.append(math.sqrt(found.R_measured.std**2 - (0.02 * found.drift * R) ** 2))
    assert found.V_dead_v == pytest.approx(volts * R * 10.0, rel=1e-3)
    assert stds[1] / stds[0] == pytest.approx(factor, rel=0.01)


def test_a_misfit_of_more_than_ten_deviations_is_refused() -> None:
    v = _levels()["u_d_v"] + 30e-3 * np.cos(1.7 * np.arange(48))
    with pytest.raises(IdentificationError, match="E_MODEL_MISMATCH"):
        estimate_resistance(_levels(u_d_v=v, u_d_first_v=v, u_d_second_v=v), NOISE)


def test_levels_within_the_knee_are_told_and_widen_the_systematic_part() -> None:
    i = _levels()["i_d_a"]
    v = R * i + 1.2 * np.tanh(i / 12.0)
    halves = dict.fromkeys(("u_d_v", "u_d_first_v", "u_d_second_v"), v)
    found = estimate_resistance(_levels(**halves), NOISE, plateau_v=1.5)
    assert found.R_measured.fallback == WITHIN_KNEE
    hidden = max(abs(found.V_dead_v), 1.5) / (PHASE_FACTOR * 10.0)
    exact = math.hypot(math.hypot(0.01, 0.01) * found.R_measured.value, hidden)
    assert found.R_measured.systematic == pytest.approx(exact, rel=1e-6)
