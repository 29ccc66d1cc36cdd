# SPDX-License-Identifier: MIT
"""psi_f and the encoder offset on drives outside the estimator's model class."""

import math
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.cross_check import cross_check
from pmsmtool.estimators.estimate import SensorTolerance, Verdict, statistical_half_width
from pmsmtool.estimators.flux.linkage import (
    MAGNET_CHANGE,
    FluxResult,
    check_magnet,
    estimate_flux_linkage,
)
from pmsmtool.estimators.flux.linkage_rows import fastest_pair, mean_inverter_error
from pmsmtool.estimators.injection.inductance import InductanceResult
from pmsmtool.estimators.injection.sampling_instant import Sampling
from pmsmtool.estimators.inverter_error import InverterCurve, Modulation
from pmsmtool.identification.evaluate import Evaluation, _beside_speeds, magnet_checked
from pmsmtool.machine.parameters import Estimate
from pmsmtool.trace import Trace
from tests.estimators.plant import Drives, curve_points, draw, repeat, run

pytestmark = pytest.mark.chain

Change = Callable[[Trace], Mapping[str, np.ndarray]]

D, Q = 0.45, 0.3  # currents of the windows, of the rated one
STATIONS = [
    (sense * share, vector)
    for sense in (1.0, -1.0)
    for share, levels in ((0.40, (1.0,)), (0.55, (1.0,)), (0.70, (1 / 3, 1.0)), (0.85, (1 / 3, 1.0)))
    for vector in [(sign * level * D, 0.0) for level in levels for sign in (1.0, -1.0)]
    + [(0.0, sign * Q) for sign in (1.0, -1.0) if share == 0.70]
]
SETTLE, WINDOW = 600, 1700
PSI_P90, PSI_MAX = 1e-4, 3e-4  # targets 1e-3 and 3e-3; measured 0.6e-5 to 1.7e-5 and 0.8e-5 to 4.1e-5, seeds 11 to 15
OFFSET_P90_RAD, OFFSET_MAX_RAD = math.radians(0.005), math.radians(0.01)  # measured 0.0007 and 0.0012 deg


class Population:
    """12 drives, 28 windows each, in one run."""

    def __init__(self, seed: int, count: int = 12) -> None:
        rng = np.random.default_rng(seed)
        self.drives = draw(count, rng)
        many = repeat(self.drives, len(STATIONS))
        factor = np.repeat([speed for speed, _ in STATIONS], count)
        d, q = (np.repeat([vector[axis] for _, vector in STATIONS], count) for axis in (0, 1))
        self.w = factor * many.w_base
        self.result = run(
            many,
            rng,
            SETTLE + WINDOW,
            bias_d=d * many.I_r,
            bias_q=q * many.I_r,
            imposed_speed=self.w,
            bandwidth=2 * math.pi * 200.0,
            substeps=4,
        )
        turn = 2 * math.pi / (np.abs(self.w) * many.T_s)
        self.length = np.round(turn * np.maximum(1, np.floor(WINDOW / turn))).astype(int)  # whole turns
        self.length = np.minimum(self.length, WINDOW)

    def speeds(self, k: int) -> Trace:
        """Means over the windows, as the drive delivers them."""
        r = self.result
        rows = [k + j * self.drives.n for j in range(len(STATIONS))]

        def mean(values: np.ndarray, first: int = SETTLE, part: float = 1.0) -> np.ndarray:
            return np.array([values[first : first + int(self.length[j] * part), j].mean() for j in rows])

        w = self.w[rows]
        signals = {
            "u_d_v": mean(r.u_d, SETTLE - 1),
            "u_q_v": mean(r.u_q, SETTLE - 1),
            "i_d_a": mean(r.i_d),
            "i_q_a": mean(r.i_q),
            "omega_e_rad_s": w,
            "omega_first_rad_s": w,
            "omega_second_rad_s": w,
            "half_s": 0.5 * self.length[rows] * self.drives.T_s[k],
            "T_magnet_c": np.full_like(w, math.nan),
            "i_d_first_a": mean(r.i_d, part=0.5),
            "i_q_first_a": mean(r.i_q, part=0.5),
            "i_d_second_a": mean(r.i_d, SETTLE + WINDOW // 2, 0.5),
            "i_q_second_a": mean(r.i_q, SETTLE + WINDOW // 2, 0.5),
        }
        return Trace(np.arange(float(len(rows))), signals, dict.fromkeys(signals, "1"))

    def estimate(self, k: int) -> FluxResult:
        curve = InverterCurve(*curve_points(self.drives, k), 0.0)
        d = self.drives
        return estimate_flux_linkage(self.speeds(k), d.R[k], period_s=d.T_s[k], inverter=curve)


@pytest.fixture(scope="module")
def population() -> Population:
    return Population(11)


def test_psi_and_offset_over_drives(population: Population) -> None:
    drives: Drives = population.drives
    results = [population.estimate(k) for k in range(drives.n)]
    errors = np.array([abs(r.psi_measured.value / drives.psi[k] - 1.0) for k, r in enumerate(results)])
    half_widths = np.array([statistical_half_width(r.psi_measured) / drives.psi[k] for k, r in enumerate(results)])
    offsets = np.array([abs(r.frame_offset.value - drives.offset[k]) for k, r in enumerate(results)])
    assert np.quantile(errors, 0.9) < PSI_P90
    assert np.max(errors) < PSI_MAX
    assert np.quantile(offsets, 0.9) < OFFSET_P90_RAD
    assert np.max(offsets) < OFFSET_MAX_RAD
    assert np.sum(errors <= half_widths) >= 9  # of 12: the 2 % quantile at 92 % coverage
    assert np.median(half_widths) < 1e-3


def test_the_q_inductance_comes_out_beside(population: Population) -> None:
    errors = [
        abs(population.estimate(k).L_q_app.value / population.drives.L_q[k] - 1.0) for k in range(population.drives.n)
    ]
    assert np.median(errors) < 0.05  # a check of L_q, not a measurement: 10 % of I_r only


def test_the_q_inductance_is_doubted_by_what_the_inverter_leaves_on_d(population: Population) -> None:
    """A share of the error at a q current lies on d: L_q is off by it, and within what it claims."""
    d = population.drives
    for k in range(d.n):
        curve = InverterCurve(*curve_points(d, k), 0.0)
        trace = population.speeds(k)
        q = np.abs(trace["i_q_a"]) > 0.5 * Q * d.I_r[k]
        turned = 0.05 * np.abs(mean_inverter_error(curve, (trace["i_d_a"], trace["i_q_a"]))[1])
        u_d = trace["u_d_v"] - np.where(q, turned * np.sign(trace["omega_e_rad_s"] * trace["i_q_a"]), 0.0)
        found = estimate_flux_linkage(_changed(trace, u_d_v=u_d), d.R[k], period_s=d.T_s[k], inverter=curve)
        plain = population.estimate(k)
        off = float(np.mean(turned[q]) / np.mean(np.abs(trace["omega_e_rad_s"] * trace["i_q_a"])[q]))
        assert found.L_q_app.value - plain.L_q_app.value == pytest.approx(off, rel=0.1)
        assert found.L_q_app.value - plain.L_q_app.value < 0.9 * found.L_q_app.std


def test_the_q_currents_are_a_second_method_that_agrees(population: Population) -> None:
    for k in range(population.drives.n):
        found = population.estimate(k)
        assert found.driven is not None
        check = cross_check("psi_f_wb_driven", "psi_f_wb", found.driven, found.psi_f, found.voltage_scale_std)
        assert check.agrees, check.verdict
        assert abs(check.difference) < 2e-3


def test_samples_of_the_start_show_no_other_instant(population: Population) -> None:
    """The plant samples at the start of the period and has no ripple, whatever is told of them."""
    d = population.drives
    for k in range(2):
        T_s, curve = float(d.T_s[k]), InverterCurve(*curve_points(d, k), 0.0)
        switched = Modulation(float(d.U_dc[k]), (float(d.L_d[k]), float(d.L_q[k])), T_s, 1e-6)
        for late in (0.0, 0.3):
            found = estimate_flux_linkage(
                population.speeds(k), d.R[k], period_s=T_s, inverter=curve, modulation=switched,
                sampling=Sampling(late * T_s),
            )  # fmt: skip
            assert found.shown is not None and abs(found.shown.value_s) < 3.0 * found.shown.std_s  # measured 0.8
            assert found.psi_measured.value == pytest.approx(d.psi[k], rel=1e-3)  # measured 3e-4, all of it ripple


def test_a_disagreement_is_reported(population: Population) -> None:
    """A part of the flux that only shows beside a q current, as of a saturating q axis, or a wrong angle delay."""
    d = population.drives
    trace = population.speeds(0)
    q = np.abs(trace["i_q_a"]) > 0.5 * Q * d.I_r[0]
    u_q = trace["u_q_v"] - np.where(q, 0.02 * d.psi[0] * trace["omega_e_rad_s"], 0.0)
    found = estimate_flux_linkage(
        _changed(trace, u_q_v=u_q), d.R[0], period_s=d.T_s[0], inverter=InverterCurve(*curve_points(d, 0), 0.0)
    )
    assert found.driven is not None
    apart = found.apart_wb * found.psi_f.value / found.psi_measured.value
    assert apart == pytest.approx(0.02 * found.psi_f.value, rel=0.1), "it is a standard deviation of the flux linkage"
    alone = replace(found.psi_f, std=math.sqrt(found.psi_f.std**2 - apart**2))
    check = cross_check("psi_f_wb_driven", "psi_f_wb", found.driven, alone, found.voltage_scale_std)
    assert not check.agrees and "DISAGREES with psi_f_wb: -2" in check.verdict


@pytest.mark.parametrize(
    ("value", "std", "word"),
    [(1.01, 0.01, "agrees with"), (1.05, 0.01, "DISAGREES with"), (1.4, 0.5, "too uncertain to judge")],
)
def test_a_check_says_what_it_can(value: float, std: float, word: str) -> None:
    first = Estimate(1.0, 0.001, 0.0, "H")
    assert cross_check("L_q_h_apparent", "L_q_h", Estimate(value, std, 0.0, "H"), first).verdict.startswith(word)


@pytest.mark.parametrize(
    ("std", "common", "half_width"),
    [
        (0.02, 0.0, 2.0 * math.sqrt(2.0) * 0.02),
        (0.02, 0.019, 2.0 * math.sqrt(2.0 * (0.02**2 - 0.019**2))),
        (0.02, 0.02 * (1.0 + 1e-9), 0.0),  # all that both doubt is common, to rounding
    ],
)
def test_what_two_methods_have_in_common_is_no_excuse(std: float, common: float, half_width: float) -> None:
    """Both are off by the same scale of the voltage: what sets them apart is something else."""
    first, second = Estimate(0.5, 0.5 * std, 0.0, "Wb"), Estimate(0.505, 0.505 * std, 0.0, "Wb")
    found = cross_check("a", "b", second, first, common)
    assert found.half_width == pytest.approx(half_width, rel=0.03, abs=1e-9)
    assert found.agrees == (half_width > 0.01)


def test_a_doubtful_bridge_does_not_hide_a_disagreement(population: Population) -> None:
    """Its thresholds scale both flux linkages: 0.5 % of doubt, and 0.3 % that only the q currents show."""
    d = population.drives
    trace = population.speeds(0)
    q = np.abs(trace["i_q_a"]) > 0.5 * Q * d.I_r[0]
    tolerance = SensorTolerance(bridge_threshold_v=0.5, U_dc_v=100.0)
    for share, apart in ((0.0, 0.0), (0.003, 0.003)):
        u_q = trace["u_q_v"] - np.where(q, share * d.psi[0] * trace["omega_e_rad_s"], 0.0)
        found = estimate_flux_linkage(
            _changed(trace, u_q_v=u_q),
            d.R[0],
            period_s=d.T_s[0],
            inverter=InverterCurve(*curve_points(d, 0), 0.0),
            tolerance=tolerance,
        )
        assert found.apart_wb == pytest.approx(apart * d.psi[0], rel=0.1)
        assert found.psi_measured.std / d.psi[0] == pytest.approx(math.hypot(0.005, apart), rel=0.05)


def test_without_q_currents_there_is_no_second_method(population: Population) -> None:
    trace = population.speeds(0)
    rows = np.abs(trace["i_q_a"]) < 0.5 * Q * population.drives.I_r[0]
    bare = Trace(trace.t_s[rows], {n: v[rows] for n, v in trace.signals.items()}, trace.units, trace.meta)
    assert estimate_flux_linkage(bare, population.drives.R[0], period_s=population.drives.T_s[0]).driven is None


def test_without_the_sampled_data_correction_psi_is_low(population: Population) -> None:
    """Omitting the division by sinc costs (w T_s)^2/24."""
    drives = population.drives
    k = int(np.argmax(drives.w_base * drives.T_s))
    curve = InverterCurve(*curve_points(drives, k), 0.0)
    uncorrected = estimate_flux_linkage(population.speeds(k), drives.R[k], period_s=1e-9, inverter=curve)
    fast, slow = (-((share * drives.w_base[k] * drives.T_s[k]) ** 2) / 24.0 for share in (0.85, 0.4))
    error = uncorrected.psi_measured.value / drives.psi[k] - 1.0
    assert 1.2 * fast < error < slow


def test_temperature_moves_psi_to_its_reference(population: Population) -> None:
    trace = population.speeds(0)
    warm = replace(trace, signals={**trace.signals, "T_magnet_c": np.full(len(trace), 70.0)})
    result = estimate_flux_linkage(warm, population.drives.R[0], period_s=population.drives.T_s[0])
    assert result.psi_f.value == pytest.approx(result.psi_measured.value / (1.0 - 0.0012 * 50.0), rel=1e-12)
    assert result.psi_f.systematic > result.psi_measured.systematic
    cold = estimate_flux_linkage(trace, population.drives.R[0], period_s=population.drives.T_s[0])
    assert "not normalised" in cold.psi_f.fallback


def _changed(trace: Trace, **signals: np.ndarray) -> Trace:
    return replace(trace, signals={**trace.signals, **signals}, units={**trace.units, **dict.fromkeys(signals, "1")})


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda t: {"omega_e_rad_s": np.abs(t["omega_e_rad_s"])}, "E_EXCITATION"),
        (lambda t: {"i_d_a": np.abs(t["i_d_a"])}, "E_EXCITATION"),
        (lambda t: {"omega_e_rad_s": -t["omega_e_rad_s"]}, "E_NOT_IDENTIFIABLE"),
        (lambda t: {"omega_second_rad_s": 1.5 * t["omega_first_rad_s"]}, "E_NOT_SETTLED"),
        (lambda t: {"i_d_second_a": t["i_d_first_a"] + np.max(np.abs(t["i_q_a"]))}, "E_NOT_SETTLED"),
        (lambda t: {"flagged": 3.0 * (t["omega_e_rad_s"] > 0.0)}, "E_CLIPPED: voltage or current limited in"),
    ],
)
def test_refusals(population: Population, change: Change, reason: str) -> None:
    trace = population.speeds(0)
    with pytest.raises(IdentificationError, match=reason):
        estimate_flux_linkage(
            _changed(trace, **change(trace)), population.drives.R[0], period_s=population.drives.T_s[0]
        )


def test_limited_windows_are_left_out_and_told(population: Population) -> None:
    """A motor at its voltage limit in two driven windows of 40 lost psi and mechanics."""
    trace = population.speeds(0)
    R, T_s = population.drives.R[0], population.drives.T_s[0]
    last = np.arange(len(trace)) == len(trace) - 1
    limited = _changed(trace, flagged=1.0 * last, u_q_v=np.where(last, 0.5, 1.0) * trace["u_q_v"])
    whole, rest = (estimate_flux_linkage(t, R, period_s=T_s).psi_f for t in (trace, limited))
    assert rest.value == pytest.approx(whole.value, rel=1e-3)  # measured 1.1e-4
    assert rest.fallback.startswith("2 of ") and "left out, limited by voltage" in rest.fallback


def test_a_shaft_that_stops_asks_for_more_speed(population: Population) -> None:
    trace = population.speeds(0)
    stops = _changed(trace, omega_second_rad_s=1.5 * trace["omega_first_rad_s"])
    with pytest.raises(IdentificationError, match="E_NOT_SETTLED") as caught:
        estimate_flux_linkage(stops, population.drives.R[0], period_s=population.drives.T_s[0])
    assert "speed limit too low" in caught.value.likely and "--speed-max" in caught.value.hint


PSI, R, T_S = 0.3, 0.4, 1e-4


def _windows(flux: Callable[[np.ndarray], np.ndarray], *, odd_v: float = 0.0, slope: float = 0.0) -> Trace:
    """Windows of an ideal inverter whose q voltage is w psi_d(i_d) and an error that is odd in i_d."""
    w = np.array([400.0 * speed for speed, _ in STATIONS])
    i_d, i_q = (np.array([10.0 * vector[axis] for _, vector in STATIONS]) for axis in (0, 1))
    x = 0.5 * w * T_S
    u_q = w * flux(i_d) * np.sin(x) / x + R * i_q + odd_v * np.sign(w) * np.sign(i_d)
    half = 0.05 + 0.0 * w
    a = slope * w
    signals = {"u_d_v": R * i_d - 5e-3 * w * i_q, "u_q_v": u_q, "i_d_a": i_d, "i_q_a": i_q, "omega_e_rad_s": w,
               "omega_first_rad_s": w - 0.5 * half * a, "omega_second_rad_s": w + 0.5 * half * a, "half_s": half,
               "T_magnet_c": np.full_like(w, math.nan)}  # fmt: skip
    signals |= {f"i_{axis}_{part}_a": signals[f"i_{axis}_a"] for axis in "dq" for part in ("first", "second")}
    return Trace(np.arange(float(len(w))), signals, dict.fromkeys(signals, "1"))


@pytest.mark.parametrize("bend", [0.0, 3e-3])
def test_a_saturating_axis_is_taken_back_to_zero_current(bend: float) -> None:
    trace = _windows(lambda i: PSI * (1.0 + bend * i * i) + 4e-3 * i, odd_v=0.7)
    found = estimate_flux_linkage(trace, R, period_s=T_S)
    assert found.psi_measured.value == pytest.approx(PSI, rel=1e-5)
    assert found.curvature == pytest.approx(bend * (10.0 * D) ** 2, abs=1e-4)
    assert found.low_wb == pytest.approx(PSI * (1.0 + bend * (10.0 * D / 3.0) ** 2), rel=1e-5)
    assert found.low_i_d_a == pytest.approx(10.0 * D / 3.0)
    way = bend * (10.0 * D / 3.0) ** 2  # what is extrapolated is doubted, in part
    assert 0.1 * way < found.psi_measured.std / PSI < 2e-4 + 0.3 * way


@pytest.mark.parametrize(
    ("chi2", "apparent", "widened"), [(7.9, 2.8e-3, True), (7.9, 8.0e-3, False), (1.0, 2.8e-3, False)]
)
def test_an_L_q_that_misses_its_shots_and_the_speeds_is_no_narrow_value(
    chi2: float, apparent: float, widened: bool
) -> None:
    """L_q of 2.06 mH came out as 8.4 mH at +-13 %: a phase current lay within the inverter's knee.

    A d axis that its own model misses (2.0, saturation) says nothing of L_q, which was 0.7 % off at +-23 %.
    """
    L_q = Estimate(8.4e-3, 0.35e-3, 0.8e-3, "H", chi2=chi2)
    found = InductanceResult(L_q, L_q, {}, 0.0, 0.0, (), 0.0, Verdict.WARN)
    beside = _beside_speeds(found, Estimate(apparent, 0.6e-3, 0.0, "H")).L_q
    assert (statistical_half_width(beside) > 8.4e-3 - 2.06e-3) == widened
    assert ("shows 2.8 mH" in beside.fallback) == widened and beside.value == L_q.value


def test_run_over_speeds_that_hardly_shows_L_q_takes_no_good_one_along() -> None:
    """A motor of 2 kN m: 0.445 mH at +-1.5 %, 0.80 +- 0.35 mH at speed. L_q became +-160 %, and was refused."""
    L_q = Estimate(0.445e-3, 3.3e-6, 6.3e-6, "H", chi2=7.9)
    found = InductanceResult(L_q, L_q, {}, 0.0, 0.0, (), 0.0, Verdict.WARN)
    beside = _beside_speeds(found, Estimate(0.801e-3, 0.172e-3, 0.011e-3, "H")).L_q
    assert 0.8e-3 - 0.445e-3 - 2.0 * 0.172e-3 < statistical_half_width(beside) < 0.5 * L_q.value


@pytest.mark.parametrize("share", [0.1, 0.5, 0.95])
def test_a_shaft_that_friction_would_stop_is_driven_through_its_windows(share: float) -> None:
    """A q current keeps the speed, of the largest d current. From 0.1 of it on psi_f and all that needs it was lost.

    It saturates the d axis, too, which no window shows without it: that much is in the interval.
    """
    bend = 1e-3
    trace = _windows(lambda i: PSI * (1.0 - bend * i * i) + 4e-3 * i)
    w, x = trace["omega_e_rad_s"], 0.5 * trace["omega_e_rad_s"] * T_S
    held = share * 10.0 * D * np.sign(w) * (trace["i_q_a"] == 0.0)
    across = R * held - w * PSI * bend * held**2 * np.sin(x) / x
    i_q = trace["i_q_a"] + held
    u_d, u_q = trace["u_d_v"] - 5e-3 * w * held, trace["u_q_v"] + across
    driven = _changed(trace, i_q_a=i_q, i_q_first_a=i_q, i_q_second_a=i_q, u_d_v=u_d, u_q_v=u_q)
    found = estimate_flux_linkage(driven, R, period_s=T_S).psi_measured
    lost = bend * (share * 10.0 * D) ** 2
    # measured -2.0e-4, -5.1e-3 and -7.4e-3: in the widest interval the driven windows, which hold less, count, too
    assert -lost - 1e-4 < found.value / PSI - 1.0 < 1e-4
    assert abs(found.value / PSI - 1.0) < statistical_half_width(found) / PSI < 3.0 * lost + 2e-3


@pytest.mark.parametrize("bend", [0.0, 3e-3])
def test_saturation_does_not_turn_the_frame(bend: float) -> None:
    """A frame ahead of the d axis sees all of psi_d on its q axis, and with it what currents of both axes bend."""
    eps = 0.01
    trace = _windows(lambda i: PSI * (1.0 + bend * i * i))
    w, x = trace["omega_e_rad_s"], 0.5 * trace["omega_e_rad_s"] * T_S
    flux = PSI * (1.0 + bend * trace["i_d_a"] ** 2 - 2.0 * bend * trace["i_q_a"] ** 2)
    turned = _changed(trace, u_d_v=trace["u_d_v"] + eps * w * flux * np.sin(x) / x)
    assert estimate_flux_linkage(turned, R, period_s=T_S).frame_offset.value == pytest.approx(eps, rel=1e-3)


def test_a_speed_that_lags_while_the_shaft_slows_down_is_put_right() -> None:
    trace = _windows(lambda i: 0.0 * i + PSI, slope=-0.4)
    wrong = estimate_flux_linkage(trace, R, period_s=T_S).psi_measured.value
    # the rotor is where the shown speed was a lag ago: shown = true + 0.4 lag
    right = estimate_flux_linkage(trace, R, period_s=T_S, lag_s=3e-3).psi_measured.value
    assert right / wrong == pytest.approx(1.0 / (1.0 - 0.4 * 3e-3), rel=1e-4)


def test_what_an_old_angle_hides_of_psi_is_in_its_interval() -> None:
    """The voltage of the magnets leaves the q axis by w t: psi is low by its cosine, as no late sample makes it."""
    trace, old_s = _windows(lambda i: PSI + 4e-3 * i), 3.0 * T_S
    ahead = np.exp(1j * trace["omega_e_rad_s"] * old_s)
    pairs = [("u_d_v", "u_q_v"), *((f"i_d{k}_a", f"i_q{k}_a") for k in ("", "_first", "_second"))]
    turned = {d: (trace[d] + 1j * trace[q]) * ahead for d, q in pairs}
    shown = {name: part for d, q in pairs for name, part in ((d, turned[d].real), (q, turned[d].imag))}
    pulses = Modulation(400.0, (4e-3, 5e-3), T_S, 0.0)
    rows, step_s = _changed(trace, **shown), 0.01 * T_S
    found, plain, later = (
        estimate_flux_linkage(rows, R, period_s=T_S, modulation=pulses, sampling=Sampling(late_s))
        for rows, late_s in ((rows, 0.0), (trace, 0.0), (rows, step_s))
    )
    assert found.shown is not None and found.shown.value_s == pytest.approx(old_s, rel=0.1)
    lost = PSI - found.psi_measured.value
    assert lost > 3e-3 * PSI
    as_late = (later.psi_measured.value - found.psi_measured.value) / step_s * old_s
    added = found.psi_measured.systematic - plain.psi_measured.systematic
    assert added == pytest.approx(abs(lost - as_late), rel=0.05)


@pytest.mark.parametrize("lost", [0.05, 0.1, 0.2, 0.3])
def test_a_shaft_that_slows_down_in_a_window_costs_nothing(lost: float) -> None:
    """The mean voltage belongs to the mean speed: the doubt of the lag alone grows, 0.02 % per 10 % lost."""
    trace = _windows(lambda i: 0.0 * i + PSI, slope=-lost / 0.05)
    lag_s = 1.0 / 300.0
    a = (trace["omega_second_rad_s"] - trace["omega_first_rad_s"]) / trace["half_s"]
    shown = trace["omega_e_rad_s"] - (lag_s + 1.5 * T_S) * a
    found = estimate_flux_linkage(_changed(trace, omega_e_rad_s=shown), R, period_s=T_S, lag_s=lag_s).psi_measured
    assert found.value == pytest.approx(PSI, rel=1e-9)
    assert found.std > 0.02 * lag_s * lost / 0.05 * PSI


def test_windows_driven_at_a_higher_speed_are_no_fastest_pair(population: Population) -> None:
    """A light shaft with friction had them; repeated without their i_q, they showed a magnet 3.5 % weaker."""
    speeds = population.speeds(0)
    k = fastest_pair(speeds)[0]
    driven = {"i_d_a": 0.0, "i_q_a": 4.0, "omega_e_rad_s": 1.2 * speeds["omega_e_rad_s"][k]}
    rows = {
        name: np.concatenate([values[:k], [driven.get(name, values[k])], values[k:]])
        for name, values in speeds.signals.items()
    }
    assert fastest_pair(Trace(np.arange(len(speeds.t_s) + 1.0), rows, speeds.units)) == (k + 1, k + 2)


@pytest.mark.parametrize("T_after_c", [math.nan, 24.0, 40.0])
def test_a_magnet_that_lost_flux_is_told_from_a_warmer_one(T_after_c: float, population: Population) -> None:
    before = population.speeds(0)
    before = Trace(before.t_s, {**before.signals, "T_magnet_c": np.full_like(before.t_s, 24.0)}, before.units)
    flux = population.estimate(0)
    alpha = -0.002
    warmth = 1.0 + alpha * (T_after_c - 24.0) if math.isfinite(T_after_c) else 1.0
    pair = list(fastest_pair(before))
    assert np.sign(before["i_d_a"][pair]).sum() == 0.0 and len(set(before["omega_e_rad_s"][pair])) == 1

    def again(share: float) -> Trace:
        rows = {name: values[pair] for name, values in before.signals.items()}
        rows |= {"u_q_v": share * warmth * rows["u_q_v"], "T_magnet_c": np.full(2, T_after_c)}
        return Trace(before.t_s[:2], rows, before.units)

    check_magnet(before, again(1.0 - 0.9 * MAGNET_CHANGE), flux, alpha)
    for share in (1.0 - 1.1 * MAGNET_CHANGE, 1.0 + 1.1 * MAGNET_CHANGE, 0.97, math.nan):
        with pytest.raises(IdentificationError, match="E_MAGNET_CHANGED"):
            check_magnet(before, again(share), flux, alpha)
    # a little less takes the flux map along, and psi_f holds it; a magnet that lost more, or none, does not
    for change, refused_map in ((0.0, False), (-0.02, True)):
        refused: dict[str, IdentificationError] = {}
        traces = {"speeds": before, "speeds_after_map": again(1.0 + change)}
        nothing: Any = None
        found = magnet_checked(traces, Evaluation(nothing, flux=flux), alpha, refused).flux
        assert found is not None and (list(refused) == ["map"]) == refused_map
        wider = math.hypot(flux.psi_f.std, change * flux.psi_f.value)
        assert found.psi_f.std == pytest.approx(wider, rel=1e-3) and bool(found.psi_f.fallback) >= refused_map
    for share in (0.94, math.nan):
        lost = {"speeds": before, "speeds_after_map": again(share)}
        with pytest.raises(IdentificationError, match="E_MAGNET_CHANGED"):
            magnet_checked(lost, Evaluation(nothing, flux=flux), alpha, {})


@pytest.mark.parametrize(("share", "lost"), [(0.9, False), (1.1, True)])
def test_a_magnet_may_change_by_three_times_the_scatter_of_two_windows(
    share: float, lost: bool, population: Population
) -> None:
    before, flux = population.speeds(0), population.estimate(0)
    scatter = 0.01  # of the flux linkage; three times that of a pair is 4.2 %
    noisy = replace(flux, residual_wb=np.full_like(flux.residual_wb, scatter * flux.psi_measured.value))
    pair = list(fastest_pair(before))
    rows = {name: values[pair] for name, values in before.signals.items()}
    rows |= {"u_q_v": (1.0 - share * 3.0 * math.sqrt(2.0) * scatter) * rows["u_q_v"]}
    again = Trace(before.t_s[:2], rows, before.units)
    with pytest.raises(IdentificationError, match="E_MAGNET_CHANGED") if lost else nullcontext():
        check_magnet(before, again, noisy, 0.0)
