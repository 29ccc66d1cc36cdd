# SPDX-License-Identifier: MIT
"""R_s from DC levels on inverter shapes outside the estimator's model class."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.peer_formulas import single_point_resistance, two_point_resistance
from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.current_sensors import Noise
from pmsmtool.estimators.estimate import COVERAGE_FACTOR, SensorTolerance, Verdict, total_half_width
from pmsmtool.estimators.inverter_error import InverterCurve
from pmsmtool.estimators.resistance import (
    R_MEASURED,
    WITHIN_KNEE,
    Copper,
    ResistanceResult,
    at_the_test,
    estimate_resistance,
    settled_levels,
    tail_models,
    unsettled,
)
from pmsmtool.machine.parameters import Estimate
from pmsmtool.trace import Trace
from tests.estimators.plant import SHAPES, Drives, draw, inverter_shape, level_sequence

Change = Callable[[Trace], Mapping[str, np.ndarray]]

ALPHA = 0.00393
LEVELS = (0.004, 0.008, 0.015, 0.025, 0.036, *np.linspace(0.05, 1.0, 20))
SAMPLES = 1600


def levels_of(
    d: Drives,
    k: int,
    rng: np.random.Generator,
    *,
    heating_k: float = 0.0,
    sensor: bool = True,
    offset_v: float = 0.0,
    zero_a: float = 0.0,
    fall: float = 0.0,
) -> Trace:
    """Means of alternating DC levels along 90 degrees, where phase a is idle; what is shown is ``zero_a`` too much.

    The link falls with the power, by a share ``fall`` at the largest level, and the dead time's error with it.
    """
    i = np.array(level_sequence([fraction * d.I_r[k] for fraction in LEVELS]))
    n = len(i)
    T = 20.0 + heating_k * np.linspace(0.0, 1.0, n)
    flows = i - zero_a
    phase = 0.5 * math.sqrt(3.0) * flows
    error = d.dV[k] * inverter_shape(d.shape[k], phase / d.knee[k])
    power = np.abs(flows * (d.R[k] * flows + 2.0 / math.sqrt(3.0) * error))
    link = 1.0 - fall * power / np.max(power)
    error *= link
    error += d.drop[k] * np.tanh(phase / (0.3 * d.knee[k]))
    v = d.R[k] * (1.0 + ALPHA * (T - 20.0)) * flows + 2.0 / math.sqrt(3.0) * error + offset_v
    halves = [i + d.sigma_dq[k] * rng.standard_normal(n) / math.sqrt(SAMPLES / 2) for _ in range(2)]
    signals = {
        "i_d_a": 0.5 * (halves[0] + halves[1]),
        "u_d_v": v,
        "i_d_first_a": halves[0],
        "i_d_second_a": halves[1],
        "u_d_first_v": v,
        "u_d_second_v": v,
        "T_winding_c": T if sensor else np.full(n, math.nan),
        "U_dc_v": 540.0 * link,
    }
    return Trace(np.arange(n, dtype=np.float64) * 0.25, signals, dict.fromkeys(signals, "1"), {"samples": SAMPLES})


def noise_of(d: Drives, k: int) -> Noise:
    return Noise(d.sigma_dq[k], 0.0, 0.0)


def summary(
    count: int, seed: int, *, heating_k: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[ResistanceResult]]:
    """Relative errors, 95 % half widths and V_dead/(R I) of a population."""
    rng = np.random.default_rng(seed)
    d = draw(count, rng)
    results = [estimate_resistance(levels_of(d, k, rng, heating_k=heating_k), noise_of(d, k)) for k in range(count)]
    errors = np.array([abs(r.R_s.value / d.R[k] - 1.0) for k, r in enumerate(results)])
    widths = np.array([COVERAGE_FACTOR * r.R_s.std / d.R[k] for k, r in enumerate(results)])
    return errors, widths, d.dV / (d.R * d.I_r), results


@pytest.mark.chain
def test_accuracy_and_coverage_over_drives() -> None:
    errors, widths, hardness, _ = summary(50, 1)
    easy = hardness < 3.0
    assert np.quantile(errors[easy], 0.9) < 2.5e-3  # measured 0.6e-3
    assert np.max(errors[easy]) < 8e-3  # measured 1.7e-3
    assert np.mean(errors[easy] <= widths[easy]) >= 0.93  # measured 1.00
    assert np.median(widths[easy]) < 4e-3  # an interval that says nothing would cover, too


@pytest.mark.chain
def test_a_simpler_formula_is_ten_times_worse_on_the_same_levels() -> None:
    rng = np.random.default_rng(1)
    d = draw(20, rng)
    ours, two_point, single = [], [], []
    for k in range(d.n):
        levels = levels_of(d, k, rng)
        ours.append(abs(estimate_resistance(levels, noise_of(d, k)).R_s.value / d.R[k] - 1.0))
        two_point.append(abs(two_point_resistance(levels) / d.R[k] - 1.0))
        single.append(abs(single_point_resistance(levels) / d.R[k] - 1.0))
    assert np.quantile(two_point, 0.9) > 10.0 * np.quantile(ours, 0.9)
    assert np.median(single) > 0.2


@pytest.mark.chain
def test_twelve_kelvin_of_heating_do_not_matter() -> None:
    errors, _, hardness, results = summary(20, 3, heating_k=12.0)
    easy = hardness < 3.0
    assert np.quantile(errors[easy], 0.9) < 2.5e-3
    assert results[0].R_s.T_c == pytest.approx(26.0, abs=0.5)


@pytest.mark.chain
def test_without_a_temperature_sensor_the_value_belongs_to_the_mean_heating() -> None:
    rng = np.random.default_rng(4)
    d = draw(20, rng)
    easy = np.flatnonzero(d.dV / (d.R * d.I_r) < 3.0)
    assert len(easy) >= 5
    for k in map(int, easy):
        result = estimate_resistance(levels_of(d, k, rng, heating_k=3.0, sensor=False), noise_of(d, k))
        assert math.isnan(result.R_s.T_c)
        assert "R_s as measured, its interval is that of 5 to 90 degC" in result.R_s.fallback
        truth = d.R[k] * (1.0 + ALPHA * 1.5)
        assert abs(result.R_s.value - truth) < max(3e-3 * truth, COVERAGE_FACTOR * result.R_s.std)
        assert result.drift == pytest.approx(ALPHA * 3.0, rel=0.15)


def test_only_the_copper_part_is_normalised() -> None:
    rng = np.random.default_rng(5)
    d = replace_inverter(draw(1, rng))
    hot = levels_of(d, 0, rng)
    hot = replace(hot, signals={**hot.signals, "T_winding_c": np.full(len(hot), 70.0)})
    all_copper = estimate_resistance(hot, noise_of(d, 0))
    half = estimate_resistance(hot, noise_of(d, 0), copper=Copper(R_winding_ohm=0.5 * d.R[0]))
    R = all_copper.R_measured.value
    assert all_copper.R_s.value == pytest.approx(R / (1.0 + ALPHA * 50.0), rel=1e-9)
    assert half.R_s.value == pytest.approx(R - 0.5 * d.R[0] * ALPHA * 50.0, rel=1e-6)
    # a copper part known to 10 % leaves that of its correction; one that is above the loop is the loop
    stated = Copper(R_winding_ohm=0.5 * d.R[0], winding_half_ohm=0.05 * d.R[0])
    doubted = estimate_resistance(hot, noise_of(d, 0), copper=stated).R_s
    correction = 0.05 * d.R[0] * ALPHA * 50.0
    assert doubted.systematic == pytest.approx(math.hypot(half.R_s.systematic, correction), rel=1e-6)
    above = estimate_resistance(hot, noise_of(d, 0), copper=Copper(R_winding_ohm=2.0 * d.R[0]))
    assert above.R_s.value == pytest.approx(all_copper.R_s.value)
    # not knowing the split widens the total interval by up to 30 % of the correction
    assert total_half_width(all_copper.R_s) > total_half_width(half.R_s) + 0.01 * R


def replace_inverter(d: Drives) -> Drives:
    d.dV[:] = 0.2 * d.R * d.I_r
    d.drop[:] = 0.0
    return d


@pytest.mark.chain
def test_the_inverter_curve_is_the_one_of_the_plant() -> None:
    rng = np.random.default_rng(6)
    d = draw(12, rng)
    for k in range(d.n):
        result = estimate_resistance(levels_of(d, k, rng, offset_v=0.02 * d.dV[k]), noise_of(d, k))
        i = result.curve.i_phase_a
        truth = d.dV[k] * inverter_shape(d.shape[k], i / d.knee[k])
        truth += d.drop[k] * np.tanh(i / (0.3 * d.knee[k]))
        tolerance = 5e-3 * d.R[k] * d.I_r[k] + 0.01 * (d.dV[k] + d.drop[k])
        assert np.max(np.abs(result.curve.u_error_v - truth)) < tolerance
        knee = result.curve.knee_a(result.V_dead_v)
        assert 0.2 * d.knee[k] < knee < 8.0 * d.knee[k]


def test_five_tail_models_that_begin_with_one_over_the_current() -> None:
    assert len(tail_models()) == 5
    assert len(set(tail_models())) == 5
    assert all(powers[0] == 1 for powers in tail_models())


@pytest.mark.chain
def test_a_link_that_falls_with_the_power_takes_no_part_of_R() -> None:
    """The dead time's error falls with it: unseen, that is up to 30 % of R, and nothing in the fit shows it."""
    rng = np.random.default_rng(13)
    d, count = draw(30, rng), 0
    ratios, blind = [], []
    for k in range(30):
        levels = levels_of(d, k, rng, fall=float(rng.uniform(0.01, 0.15)))
        unseen = replace(levels, signals={name: x for name, x in levels.signals.items() if name != "U_dc_v"})
        for trace, found in ((levels, ratios), (unseen, blind)):
            try:
                R = estimate_resistance(trace, noise_of(d, k)).R_measured
            except IdentificationError:
                count += trace is levels
            else:
                assert ("assumed to fall with it" in R.fallback) == (trace is levels)
                found.append(abs(R.value - d.R[k]) / (COVERAGE_FACTOR * R.std))
    assert count <= 2  # measured 0 of 30 (seed 12: one of 60, and one drive 2.9 times beyond its interval at 12 %)
    assert np.mean(np.array(ratios) > 1.0) <= 0.05 and max(ratios) < 1.5  # measured 0 of 30, 0.81
    assert np.mean(np.array(blind) > 2.0) > 0.5  # measured 1.00


@pytest.mark.chain
@pytest.mark.parametrize("straight", [False, True])
def test_levels_within_the_knee_of_the_inverters_error_say_so(straight: bool) -> None:
    """A motor that is small for its bridge: what looks like R is R and the slope of the error, whatever its shape.

    An error that is a straight line up to its knee leaves no bend at all; two of 60 were 18 and 24 intervals off.
    """
    rng = np.random.default_rng(15 if straight else 14)
    d = draw(60, rng)
    small = replace(d, knee=rng.uniform(0.9 if straight else 0.6, 3.0, 60) * d.I_r, drop=np.zeros(60))
    if straight:
        small = replace(small, shape=np.full(60, SHAPES - 1.0))
    ratios: dict[bool, list[float]] = {True: [], False: []}
    for k in range(16):
        levels = levels_of(small, k, rng)
        for told in ratios:
            R = estimate_or_none(levels, noise_of(small, k), told * float(d.dV[k]))
            if R is None:
                continue
            ratios[told].append(abs(R.value - d.R[k]) / total_half_width(R))
            assert WITHIN_KNEE in R.fallback or ratios[told][-1] <= 1.0 or not told
        usual = estimate_or_none(levels_of(d, k, rng), noise_of(d, k), float(d.dV[k]))
        assert usual is None or WITHIN_KNEE not in usual.fallback
    # a misfit that is small beside what the knee may hide refuses none (chi-square 248 on a drive of 0.1 A at 800 V)
    assert len(ratios[True]) >= 15 and max(ratios[True]) <= 1.0  # measured 16, 0.54; straight 16, 0.48
    # without the dead time nothing shows how much: measured 0.75; straight 1.00
    assert np.mean(np.array(ratios[False]) > 1.0) > 0.5


def test_a_knee_that_bends_within_the_levels_hides_less_than_its_plateau() -> None:
    """Levels of 0.4 A at 560 V bent clearly, R was 1.7 % off, and its interval of 103 % had it refused."""
    d, rng = hard_drive(1.0, 0.35)
    d.shape[:], d.drop[:] = 4.0, 0.0
    levels, dead_v, largest = levels_of(d, 0, rng), float(d.dV[0]), 0.5 * math.sqrt(3.0) * float(d.I_r[0])
    R = estimate_resistance(levels, noise_of(d, 0), plateau_v=dead_v).R_measured
    half = total_half_width(R)
    assert abs(R.value - d.R[0]) < half < 0.65 * dead_v / largest and WITHIN_KNEE in R.fallback  # 0.57; 1.19 before


def test_a_threshold_of_the_devices_is_not_taken_for_the_plateau() -> None:
    """0.4 A at 560 V: 1 V and a straight line were 0.31 of the plateau, and R 31 % off at +-3.4 %, exit 0."""
    d, rng = hard_drive(0.4, 1.5)
    trace, volts = levels_of(d, 0, rng), float(d.R[0] * d.I_r[0])
    i = trace["i_d_a"]
    v = dict.fromkeys(("u_d_v", "u_d_first_v", "u_d_second_v"), 1.3 * d.R[0] * i + 0.16 * volts * np.sign(i))
    found = estimate_resistance(replace(trace, signals={**trace.signals, **v}), noise_of(d, 0), plateau_v=0.4 * volts)
    assert abs(found.R_measured.value - d.R[0]) < total_half_width(found.R_measured)  # measured 0.30 within 0.35
    assert WITHIN_KNEE in found.R_measured.fallback


def estimate_or_none(levels: Trace, noise: Noise, plateau_v: float) -> Estimate | None:
    """Return R at the temperature of the test, None where it is refused."""
    try:
        return estimate_resistance(levels, noise, plateau_v=plateau_v).R_measured
    except IdentificationError:
        return None


def test_zeros_of_the_current_sensors_are_no_model_mismatch() -> None:
    """A hard drive like seed 76660: its tail is 0.13 R I at the largest level, its zeros are off by 1.5e-3 of it."""
    rng = np.random.default_rng(8)
    d = draw(1, rng)
    d.shape[:], d.drop[:], d.dV[:], d.knee[:] = 2.0, 0.0, 4.0 * d.R * d.I_r, 0.05 * d.I_r
    true = estimate_resistance(levels_of(d, 0, rng), noise_of(d, 0))
    for zero_a in (1.5e-3 * d.I_r[0], -1.5e-3 * d.I_r[0]):
        off = estimate_resistance(levels_of(d, 0, rng, zero_a=zero_a), noise_of(d, 0))
        assert off.R_measured.chi2 < 1.25  # measured 0.17; 5.6 to 6.1 without the even tail
        assert off.R_s.value == pytest.approx(true.R_s.value, rel=1e-3)  # measured 3e-4
        assert abs(off.R_s.value / d.R[0] - 1.0) < COVERAGE_FACTOR * off.R_s.std / d.R[0]


@pytest.mark.chain
def test_efficiency_against_the_bound_of_the_same_tail_terms() -> None:
    """sd over noise realisations / Cramer-Rao bound of the model with the two tail terms 1/i and 1/i^2."""
    rng = np.random.default_rng(7)
    d = replace_inverter(draw(1, rng))
    d.shape[:] = 1.0  # tanh: the averaging ends at few terms and must not pay for all of them
    values = [estimate_resistance(levels_of(d, 0, rng), noise_of(d, 0)).R_s.value for _ in range(30)]
    i = np.array(level_sequence([fraction * d.I_r[0] for fraction in LEVELS]))
    i = i[np.abs(i) >= 0.28 * d.I_r[0]]
    u = np.abs(i) / d.I_r[0]
    columns = np.stack([i, np.sign(i), np.ones_like(i), np.sign(i) / u, np.sign(i) / u**2], axis=1)
    sigma_v = d.R[0] * d.sigma_dq[0] / math.sqrt(SAMPLES)
    bound = sigma_v * math.sqrt(np.linalg.inv(columns.T @ columns)[0, 0])
    ratio = float(np.std(values, ddof=1)) / bound
    assert ratio < 1.5 * (1.0 + 2.0 / math.sqrt(2.0 * len(values)))


def _flat(t: Trace) -> dict[str, np.ndarray]:
    i = np.sign(t["i_d_a"]) * np.max(t["i_d_a"])
    return {"i_d_a": i, "u_d_v": 0.1 * i}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda t: {"u_d_second_v": t["u_d_first_v"] * 1.05}, "E_NOT_SETTLED"),
        (lambda t: {"u_d_v": -t["u_d_v"]}, "E_EXCITATION"),
        (_flat, "E_EXCITATION"),
        (
            lambda t: {
                "u_d_v": t["u_d_v"]
                + 0.25 * np.linspace(0, 1, len(t)) * 0.8 * np.max(t["u_d_v"] / t["i_d_a"].max()) * t["i_d_a"]
            },
            "E_THERMAL_DRIFT",
        ),
        (
            lambda t: {"u_d_v": t["u_d_v"] + 0.01 * np.max(t["u_d_v"]) * np.cos(np.arange(len(t)) * 1.7)},
            "E_MODEL_MISMATCH",
        ),
    ],
)
def test_refusals(change: Change, reason: str) -> None:
    rng = np.random.default_rng(8)
    d = replace_inverter(draw(1, rng))
    trace = levels_of(d, 0, rng)
    trace = replace(trace, signals={**trace.signals, **change(trace)})
    with pytest.raises(IdentificationError) as caught:
        estimate_resistance(trace, noise_of(d, 0))
    assert caught.value.reason == reason
    assert caught.value.exit_code == 6
    assert caught.value.hint


@pytest.mark.parametrize("seed", [8, 9])
def test_levels_that_scatter_widen_the_interval_before_they_are_refused(seed: int) -> None:
    """Ripple on a link that falls under load: 0.07 % of the largest level, chi-square about 6."""
    rng = np.random.default_rng(seed)
    d = replace_inverter(draw(1, rng))
    trace = levels_of(d, 0, rng)
    v = trace["u_d_v"] + 1e-3 * d.R[0] * d.I_r[0] * np.cos(np.arange(len(trace)) * 1.7)
    quiet = estimate_resistance(trace, noise_of(d, 0)).R_measured
    found = estimate_resistance(replace(trace, signals={**trace.signals, "u_d_v": v}), noise_of(d, 0))
    assert found.R_measured.chi2 > 3.0 and found.verdict is Verdict.WARN and found.R_measured.n == quiet.n
    error = abs(found.R_measured.value / quiet.value - 1.0)
    assert error < COVERAGE_FACTOR * found.R_measured.std / quiet.value < 0.01, error
    assert found.R_measured.std > 2.0 * quiet.std


@pytest.mark.parametrize("tau_s", [0.7, 2.0, 4.3, 10.0, 60.0])
def test_a_winding_that_warms_by_its_own_losses(tau_s: float) -> None:
    """Up to 25 K at the largest level, no sensor. R at a temperature between cold and hot; a line of time refused it.

    Levels of 0.25 s, the warmth of each simulated in steps of 1 ms and averaged over its second half.
    """
    rng = np.random.default_rng(31)
    d = replace_inverter(draw(1, rng))
    trace = levels_of(d, 0, rng, sensor=False)
    i, warm, hot = trace["i_d_a"], 0.0, []
    for current in i:
        steps = []
        for _ in range(250):
            warm += 1e-3 / tau_s * (0.1 * (current / d.I_r[0]) ** 2 - warm)
            steps.append(warm)
        hot.append(float(np.mean(steps[125:])))
    v = trace["u_d_v"] + d.R[0] * np.array(hot) * i
    signals = dict.fromkeys(("u_d_v", "u_d_first_v", "u_d_second_v"), v)
    result = estimate_resistance(replace(trace, signals={**trace.signals, **signals}), noise_of(d, 0))
    expected = d.R[0] * (1.0 + float(np.sum(hot * i**2) / np.sum(i**2)))
    error, half = result.R_measured.value / expected - 1.0, COVERAGE_FACTOR * result.R_measured.std / expected
    assert abs(error) < half < 0.02, (error, half)


def hard_drive(error: float, knee: float) -> tuple[Drives, np.random.Generator]:
    """A drive whose inverter's error is so much of R I, with a soft knee at a share of I."""
    rng = np.random.default_rng(9)
    d = draw(1, rng)
    d.dV[:], d.knee[:], d.shape[:] = error * d.R * d.I_r, knee * d.I_r, 0.0
    return d, rng


def test_a_hard_drive_whose_levels_end_within_its_knee_has_an_interval_that_says_so() -> None:
    d, rng = hard_drive(40.0, 0.3)
    R = estimate_resistance(levels_of(d, 0, rng), noise_of(d, 0)).R_measured
    assert abs(R.value - d.R[0]) < total_half_width(R) and total_half_width(R) > R.value and WITHIN_KNEE in R.fallback


@pytest.mark.parametrize("shape", [1.0, 3.0, 4.0])
def test_levels_within_the_knee_are_left_out_where_the_model_misses_them(shape: float) -> None:
    """R was +13 and -10 % off at +-2 %, and refused; what it moved by is in its interval."""
    d, rng = hard_drive(9.0, 0.12)
    d.shape[:], more = shape, 0.5
    trace, noise = levels_of(d, 0, rng), noise_of(d, 0)
    found = estimate_resistance(trace, noise).R_measured
    assert abs(found.value - d.R[0]) < total_half_width(found)
    assert found.n == np.sum(np.abs(trace["i_d_a"]) >= more * np.max(np.abs(trace["i_d_a"])))
    assert f"levels below {more:g} of the largest left out" in found.fallback
    alone = estimate_resistance(trace, noise, fit_from=more).R_measured
    assert alone.value == found.value and found.std > 1.4 * alone.std  # measured 1.55 and more


def test_levels_within_a_knee_are_left_out_where_the_tails_bend_to_fit_them() -> None:
    """The knee of a motor of 0.08 ohm behind 328 V: R was 9.5 % off at +-1.7 %; measured 0.9 at +-8.4 %."""
    d, rng = hard_drive(6.4, 0.12)
    trace, noise, largest_a = levels_of(d, 0, rng), noise_of(d, 0), float(d.I_r[0])
    i = trace["i_d_a"]
    error_v = 6.4 * d.R[0] * largest_a * np.sign(i) * -np.expm1(-((np.abs(i) / (0.1 * largest_a)) ** 1.2))
    v = dict.fromkeys(("u_d_v", "u_d_first_v", "u_d_second_v"), d.R[0] * i + error_v)
    found = estimate_resistance(replace(trace, signals={**trace.signals, **v}), noise).R_measured
    assert abs(found.value - d.R[0]) < total_half_width(found)


def test_levels_within_a_knee_are_left_out_where_R_moves_by_more_than_its_intervals() -> None:
    """Levels of that motor: 0.52 of chi-square is left, and R was 3.0 % off at +-1.5 %; now 0.2 at +-3.7 %."""
    i = np.array([0.0851, 0.1703, 0.3407, 0.4286, *(0.354852 * np.array([3.0, *np.arange(4.0, 13.0)]))])
    v = [0.3263, 0.63991, 1.1834, 1.40997, 2.16022, 2.26329, 2.31389, 2.34871]
    v += [2.37887, 2.40764, 2.43599, 2.46426, 2.49248, 2.52068]
    d, rng = hard_drive(6.4, 0.12)
    trace = levels_of(d, 0, rng)
    both, volts = np.concatenate([i, -i]), np.concatenate([v, np.negative(v)])
    signals = dict.fromkeys(("i_d_a", "i_d_first_a", "i_d_second_a"), both)
    signals |= dict.fromkeys(("u_d_v", "u_d_first_v", "u_d_second_v"), volts)
    signals |= {"T_winding_c": np.full(len(both), 20.0), "U_dc_v": np.full(len(both), 328.0)}
    levels = Trace(0.25 * np.arange(len(both)), signals, dict.fromkeys(signals, "1"), trace.meta)
    found = estimate_resistance(levels, Noise(0.005, 0.0, 0.0)).R_measured
    assert abs(found.value - 0.07949) < total_half_width(found) < 0.04 * found.value


def test_a_hard_drive_is_refused_by_name_when_the_interval_is_too_wide() -> None:
    d, rng = hard_drive(120.0, 0.1)
    with pytest.raises(IdentificationError) as caught:
        estimate_resistance(levels_of(d, 0, rng), noise_of(d, 0))
    assert caught.value.reason in ("E_NOT_IDENTIFIABLE", "E_MODEL_MISMATCH")


def test_a_bridge_of_unequal_thresholds_is_a_voltage_scale_of_unknown_size() -> None:
    rng = np.random.default_rng(10)
    d = replace_inverter(draw(1, rng))
    levels = levels_of(d, 0, rng)
    mosfet = estimate_resistance(levels, noise_of(d, 0)).R_measured
    igbt = estimate_resistance(levels, noise_of(d, 0), tolerance=SensorTolerance(U_dc_v=100.0)).R_measured
    assert igbt.value == mosfet.value
    assert math.sqrt(igbt.std**2 - mosfet.std**2) == pytest.approx(3.5e-3 * mosfet.value, rel=1e-6)


def test_a_few_levels_that_move_are_told_apart() -> None:
    rng = np.random.default_rng(13)
    d = replace_inverter(draw(1, rng))
    trace = levels_of(d, 0, rng)
    assert not np.any(unsettled(trace, noise_of(d, 0)))
    second = trace["u_d_second_v"].copy()
    second[3] += 0.05 * float(np.max(trace["u_d_v"]))
    moving = replace(trace, signals={**trace.signals, "u_d_second_v": second})
    assert list(np.flatnonzero(unsettled(moving, noise_of(d, 0)))) == [3]


def with_signals(trace: Trace, **signals: np.ndarray) -> Trace:
    units = {**trace.units, **dict.fromkeys(signals, "1")}
    return replace(trace, signals={**trace.signals, **signals}, units=units)


def test_up_to_a_quarter_of_the_levels_may_be_left_out() -> None:
    rng = np.random.default_rng(13)
    d = replace_inverter(draw(1, rng))
    trace = levels_of(d, 0, rng)
    n, noise = len(trace), noise_of(d, 0)
    assert settled_levels(trace, noise) == (trace, 0)
    for count, left_out in ((1, 1), (n // 4, n // 4), (n // 4 + 1, 0)):
        moved = (np.arange(n) < count).astype(float)
        found, out = settled_levels(with_signals(trace, moved=moved), noise)
        assert (out, len(found)) == (left_out, n - left_out)
        assert found["i_d_a"] == pytest.approx(trace["i_d_a"][left_out:])
    flagged = {"moved": np.eye(n)[0] + np.eye(n)[1], "flagged": np.eye(n)[1]}
    found, out = settled_levels(with_signals(trace, **flagged), noise)
    assert out == 1 and found["flagged"][0] == 1.0, "a limit is no motion: the estimator names it"


def test_loops_have_R_as_it_was_measured_where_nobody_knows_its_temperature() -> None:
    measured = Estimate(2.0, 1e-3, 0.0, "ohm")
    unknown, known = replace(measured, value=1.8), replace(measured, value=1.8, T_c=40.0)
    assert at_the_test({"R_s_ohm": unknown, R_MEASURED: measured})["R_s_ohm"] is measured
    assert at_the_test({"R_s_ohm": known, R_MEASURED: measured})["R_s_ohm"] is known
    assert at_the_test({"R_s_ohm": unknown}) == {"R_s_ohm": unknown}


def test_the_low_levels_may_settle_more_slowly_than_those_that_make_R() -> None:
    rng = np.random.default_rng(12)
    d = replace_inverter(draw(1, rng))
    trace = levels_of(d, 0, rng)
    drift = 0.01 * float(np.max(trace["u_d_v"]))
    low = np.abs(trace["i_d_a"]) < 0.2 * d.I_r[0]
    for rows, accepted in ((low, True), (~low, False)):
        second = trace["u_d_first_v"] + drift * rows
        slow = replace(trace, signals={**trace.signals, "u_d_second_v": second})
        if accepted:
            estimate_resistance(slow, noise_of(d, 0))
        else:
            with pytest.raises(IdentificationError, match="E_NOT_SETTLED"):
                estimate_resistance(slow, noise_of(d, 0))


def test_the_ripple_of_a_link_is_no_voltage_that_has_not_settled() -> None:
    """Windows hold no whole periods of it: R, and all that needs R, was refused at 0.0202 V, limit 0.0141."""
    rng = np.random.default_rng(12)
    d = replace_inverter(draw(1, rng))
    trace = levels_of(d, 0, rng)
    ripple = 2e-3 * float(np.max(trace["u_d_v"])) * rng.standard_normal(len(trace))
    shaken = with_signals(trace, u_d_first_v=trace["u_d_v"] - ripple, u_d_second_v=trace["u_d_v"] + ripple)
    found = estimate_resistance(shaken, noise_of(d, 0)).R_s
    assert abs(found.value / d.R[0] - 1.0) < COVERAGE_FACTOR * found.std / d.R[0]


def test_an_inverter_without_an_error_has_a_knee_within_its_levels() -> None:
    """A plateau and a curve of noise: the fit must not run away (it overflowed)."""
    rng = np.random.default_rng(5)
    i = np.geomspace(0.1, 10.0, 12)
    for _ in range(50):
        curve = InverterCurve(i, 1e-6 * rng.standard_normal(len(i)), 0.0)
        assert 0.0099 < curve.knee_a(10.0 ** rng.uniform(-9.0, -5.0)) < 101.0
