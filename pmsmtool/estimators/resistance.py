# SPDX-License-Identifier: MIT
"""R_s and the inverter's voltage error from many DC levels of alternating sign.

A current vector at 30 + k 60 degrees electrical leaves one phase idle; the other two carry +-0.866 i. The voltage is

    v = R i + V sgn(i) + v0 + sum_p c_p sgn(i) / |i|^p + e / |i|^2

on the levels above 0.28 of the largest. R is *defined* as the asymptotic slope: the shape of the inverter error near
zero is not assumed, its tail is 1/|i| and at most one more term out of p = 2, 3, 4, 6, and all five fits are averaged
with their information weights (docs/identification.md, 3.1). The last term is what zero errors of the
current sensors leave: the tail belongs to another current than the one that is shown, by the same amount at both signs.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.current_sensors import Noise
from pmsmtool.estimators.estimate import (
    CHI2_REFUSE,
    CHI2_WARN,
    COVERAGE_FACTOR,
    SensorTolerance,
    Verdict,
    chi2_gate,
    condition_gate,
    information_weights,
)
from pmsmtool.estimators.inverter_error import PHASE_FACTOR, InverterCurve, curve_from_levels
from pmsmtool.estimators.least_squares import linear_solve
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.parameters import Estimate
from pmsmtool.machine.temperature import COPPER_ALPHA_PER_K, UNKNOWN_T_RANGE_C, WINDING_TOLERANCE
from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace

STAGE = "resistance"
R_MEASURED = "R_s_ohm_measured"
"""Name of the resistance at the temperature of the test: what no normalisation widens."""

TAIL_POWERS = (1, 2, 3, 4, 6)
TAIL_TERMS = 2
SHARED = 5
"""Columns before the tails: R, V, v_0, drift, what of V falls with the link."""
LEADING = 1
"""Power that every tail has: a small current commutates slowly, and its error falls off as 1/|i|. A tail that could
begin with 1/|i|^2 fits as well where levels scatter by 1e-4, and takes the rest for resistance: a machine of hardness
1.7 had R +1.3 to +1.5 % off, with this 0.05 %; 13 switched drives p90 0.20 %, with this 0.16 %.
"""
EVEN_POWER = 2.0
"""Power of the tail that both signs share: with zeros off by o, c sgn(i)/|i - o| = c sgn(i)/|i| + c o/|i|^2. Six of
99 hard drives, their zeros off by 1.5e-3 of the largest level, had chi-square 3 to 11.5 without it; with it the largest
is 0.5. R stays: both signs have the same levels (p90 of 259 other drives 0.139 %, as before).
"""
FIT_FROM = 0.28
"""Fraction of the largest level from which on levels enter the fit; the lower ones serve the inverter curve."""
FIT_FROM_FURTHER, KNEE_GAIN, LACKING = (0.4, 0.5), 0.5, 0.05
"""The same where the first level lies within the knee: there the error has no such tail. The part of chi-square that
must be left, where R stays within both intervals; what the error lacks there to its highest, of R times the largest:
0.11 to 3.2 in knees, 0.02 and less elsewhere. Whether the tails fit is not asked: they bend, and R of 300 drawn drives
with an error of 2 to 12 R I was outside its interval on 26, at 5.3 of it; now on none (0.93), half widths are 3.9
instead of 3.1 % (median)."""
CHI2_HOPELESS = 100.0
"""Reduced chi-square above which no number is given; from the usual limit on, what the fit leaves (0.05 % of R I_r at
6.2, on a link that falls by 6 % under load and has 4 % of ripple) is a standard deviation of R besides."""
LINK_SHARE, LINK_SHARE_STD = 0.75, 0.25
"""Share of the inverter's error that is in proportion to the DC link, and its standard deviation: dead time and edges
are, thresholds are not. A supply of 10 ohm fell by 11 % at the largest level of jercic-2017, and R was 28 % too low."""
LINK_TOLD, LINK_DEGREE = 0.01, 3
"""Fall of the link from which on that is told: below, it moves R by less than 3 %; and its degree in the power."""
MODEL_FLOOR = 2e-4
"""Largest model error of every level, of R I_r: the deliberate one of docs/identification.md, 3.1."""
MODEL_FLOOR_LEAST = 1.2e-4
"""Smallest one. Between them the scatter of the levels decides: with 2e-4 throughout, chi-square was 0.02 to 0.1 on a
switched inverter, and models without the tail that is there were preferred; with 7e-5, 11 of 13 drives were covered."""
MEAN_NOISE_FACTOR = 1.05
"""Noise of the mean current seen through R and the slope of the tail."""
TEMPERATURE_PASSES = 3
MOVED_SHARE = 0.25
"""Largest share of levels that may be left out; with more the estimator sees them, and refuses what has not settled."""
WARMING_S, WARMING_TOLERANCE = (0.3, 120.0), 0.02
"""Time constants of a winding that warms by its own losses (s), and how finely one is sought (of its logarithm)."""
WARMING_GAIN = 10.0
"""Fall of chi-square for which that counts instead of a line of time: one shape more, at three standard deviations."""
SENSED_K = 1.0
"""Change of the winding's sensor (K) from which on it may be the shape; its noise is none."""
LATE = 0.75
"""Middle of a level's window, of the level: its first half settles."""
DRIFT_LIMIT = 0.15
"""Largest change of R over the sweep (relative), 40 K of copper; beyond it E_THERMAL_DRIFT."""
DRIFT_SECOND_ORDER = 0.02
"""Part of a drift that the linear drift term may leave in R: 12 K in one sweep left 0.6 % of 4.7 % without any term."""
SETTLE_SIGMA = 6.0
SETTLE_FLOOR = 2e-3
"""Change of v - R i between the halves of one window, of R I_r, that still counts as settled."""
CURVE_SETTLE = 0.02
"""The same, of the largest voltage, for the low levels that only draw the inverter curve: they do not enter R."""
HALF_WIDTH_LIMIT = 0.1
"""Relative 95 % half width above which R and V_dead count as not told apart. Below, what a design needs of R decides:
of 60 drives whose link falls by 1 to 15 % a limit of 3 % refused six; five of these are within their intervals."""
KNEE_SHARE = 0.5
"""Knee of the inverter's error, of the largest level, from which on the levels do not show its asymptotic slope. Motors
of 0.1 to 1 A on a bridge whose knee is 0.5 A: 0.94 to 1.2, and R was -9.5 to +28 % off; others at most 0.15."""
PLATEAU_SEEN = 0.6
"""Plateau that is found, of the one that the dead time makes, below which the levels do not reach it. Up to its knee
the error of a capacitance is a straight line: 0.27 A on a knee of 0.77 A had 0.055 of it, and R was 73 % off; with a
threshold of the devices of 1 V 0.31, and 31 %. Of 130 recorded sets of levels the others have 0.7 and more."""
DEAD_TIME_MOST, DEVICES_MOST_V, PLATEAU_BEYOND, TOP_LEVELS = 1.15, 1.2, 1.5, 4
"""Largest dead time over the drive's, threshold of an IGBT (V), fitted plateau over both from which on that counts, and
levels whose slope counts. R of 0.4 A at 560 V: 1.7 % off, +-41 %, +-103 % by the plateau alone, and refused."""
KNEE_TOLD = 0.01
"""Part of R that the knee may hide from which on it is told: an inverter without an error has any knee."""
WITHIN_KNEE = "the levels end within the knee of the inverter's error, part of which may be taken for R"
HARD_RATIO = 3.0
"""V_dead/(R I) above which the reference method covered 79 % only."""
HARD_FACTOR = 2.0
"""Widening of the standard deviation there."""


@dataclass(frozen=True, slots=True)
class Copper:
    """What is known of the winding's temperature coefficient."""

    T_ref_c: float = 20.0
    """Temperature R_s is normalised to (degC)."""
    alpha_per_k: float = COPPER_ALPHA_PER_K
    """Temperature coefficient of the copper part (1/K)."""
    R_winding_ohm: float | None = None
    """The copper part of the loop at ``T_ref_c``, where a meter or a data sheet gave it (ohm)."""
    winding_half_ohm: float = 0.0
    """Its 95 % half width (ohm)."""


def copper_of(file: MachineFile) -> Copper:
    """Return what a machine file says of the winding; without a deviation it has a data sheet's tolerance."""
    machine, name = file.machine, "R_winding_ohm"
    winding = machine.R_winding_ohm or 0.0
    half = COVERAGE_FACTOR * file.std[name] + file.systematic.get(name, 0.0) if name in file.std else math.nan
    stated = half if math.isfinite(half) else WINDING_TOLERANCE * winding
    return Copper(machine.T_ref_c, machine.alpha_R_per_k, machine.R_winding_ohm, stated)


@dataclass(frozen=True, slots=True)
class ResistanceResult:
    """Loop resistance and inverter error."""

    R_s: Estimate
    """Loop resistance at the reference temperature (ohm); ``T_c`` is the temperature it was measured at."""
    R_measured: Estimate
    """Loop resistance at the temperature of the measurement (ohm)."""
    curve: InverterCurve
    """Voltage error of one phase against its current."""
    V_dead_v: float
    """Plateau of that error, without the device slope that R contains (V)."""
    drift: float
    """Relative change of R over the sweep that the temperature reading does not explain."""
    verdict: Verdict
    """``warn`` when the fit is above its chi-square limit."""
    copper: Copper = Copper()
    """What R is taken to another temperature by."""

    def dead_time_s(self, U_dc_v: float, period_s: float) -> float:
        """Return the dead time that the plateau stands for (s)."""
        return max(0.0, self.V_dead_v) * period_s / U_dc_v


@dataclass(frozen=True, slots=True)
class _TailFit:
    x: Array
    covariance: NDArray[np.float64]
    chi2: float
    dof: int
    condition: float


def tail_models() -> tuple[tuple[int, ...], ...]:
    """Subsets of the tail powers with at most two elements, one of them the leading power."""
    sizes = range(1, TAIL_TERMS + 1)
    subsets = (subset for size in sizes for subset in itertools.combinations(TAIL_POWERS, size))
    return tuple(subset for subset in subsets if LEADING in subset)


def estimate_resistance(
    levels: Trace,
    noise: Noise,
    *,
    tolerance: SensorTolerance | None = None,
    copper: Copper | None = None,
    plateau_v: float = 0.0,
    fit_from: float = FIT_FROM,
) -> ResistanceResult:
    """Loop resistance from DC levels.

    Raises IdentificationError: ``E_EXCITATION``, ``E_CLIPPED``, ``E_NOT_SETTLED``, ``E_THERMAL_DRIFT``,
    ``E_NOT_IDENTIFIABLE``, ``E_MODEL_MISMATCH``.

    Parameters
    ----------
    levels : Trace
        One row per level: ``i_d_a`` and ``u_d_v`` along the vector (means of a window), ``u_d_first_v``,
        ``u_d_second_v``, ``i_d_first_a``, ``i_d_second_a`` (its halves), ``T_winding_c`` (NaN without a sensor),
        ``U_dc_v`` where it was recorded;
        ``meta["samples"]`` is the window in samples.
    noise : Noise
        From the zero-current trace.
    tolerance : SensorTolerance
        Declared sensor tolerances.
    copper : Copper
        Temperature coefficient and reference.
    plateau_v : float
        Error of one phase that the drive's dead time makes, U_dc t_d / T_s (V); 0: not known.
    fit_from : float
        As :data:`FIT_FROM`; more is tried where the model misses the levels.
    """
    tolerance = tolerance or SensorTolerance()
    copper = copper or Copper()
    if "flagged" in levels.signals and float(np.max(levels["flagged"])) > 0.0:
        raise refuse("E_CLIPPED", f"{int(np.sum(levels['flagged'] > 0))} levels with limited samples", stage=STAGE)
    i, v = levels["i_d_a"], levels["u_d_v"]
    samples = int(levels.meta["samples"])
    peak = float(np.max(np.abs(i)))
    used = np.abs(i) >= fit_from * peak
    R_0 = two_point_slope(i, v)
    _check_levels(levels, i, used, noise)
    noise_v = MEAN_NOISE_FACTOR * R_0 * noise.sigma_a / math.sqrt(samples)
    T = levels["T_winding_c"]
    known_T = bool(np.all(np.isfinite(T)))
    fall = _link_fall(levels, i, v - R_0 * i, noise_v)
    sigma_v = math.hypot(noise_v, MODEL_FLOOR * R_0 * peak)
    warmth = _warmth(levels.t_s, T, fall, i, v, used, sigma_v)
    sigma_v = _level_sigma(warmth[used], fall[used], i[used], v[used], R_0, noise_v)
    T_w = float(np.sum(T * i**2) / np.sum(i**2)) if known_T else math.nan
    R_w, v_w = R_0, v
    fits: list[_TailFit] = []
    weights = np.array([])
    for _ in range(TEMPERATURE_PASSES if known_T else 1):
        # R at T_w: what the copper part adds at each level's own temperature moves to the left side
        slope = _per_k(R_w, copper, T_w)
        v_w = v - slope * (T - T_w) * i if known_T else v
        fits = [_fit_tail(warmth[used], fall[used], i[used], v_w[used], sigma_v, powers) for powers in tail_models()]
        weights = information_weights([_criterion(fit, len(i)) for fit in fits])
        R_w = float(sum(w * fit.x[0] for w, fit in zip(weights, fits, strict=True)))
    V_vector, v_0, drift, V_link = (
        float(sum(w * fit.x[k] for w, fit in zip(weights, fits, strict=True))) for k in range(1, 5)
    )
    drift /= R_w
    _check_drift(drift)  # before the fit is judged: heating that is no straight line in time is no model mismatch
    best = min(fits, key=lambda fit: fit.chi2 / fit.dof)
    chi2 = best.chi2 / best.dof
    V_dead = V_vector * PHASE_FACTOR
    curve = curve_from_levels(i, v_w - R_w * i - v_0 - V_link * np.sign(i) * fall)
    highest_v = max(abs(V_dead), float(np.max(curve.u_error_v)))  # of an R that is too large the plateau is too low
    lacking_v = highest_v - float(curve.error_v(np.array([PHASE_FACTOR * fit_from * peak]))[0])
    within = lacking_v > LACKING * R_w * peak
    if within and (more := [share for share in FIT_FROM_FURTHER if share > fit_from]):
        with contextlib.suppress(IdentificationError):
            further = estimate_resistance(
                levels, noise, tolerance=tolerance, copper=copper, plateau_v=plateau_v, fit_from=more[0]
            )
            scatter_ohm = math.sqrt(sum(w * fit.covariance[0, 0] for w, fit in zip(weights, fits, strict=True)))
            both_ohm = COVERAGE_FACTOR * math.hypot(further.R_measured.std, scatter_ohm)
            apart = abs(further.R_measured.value - R_w) > both_ohm  # the scatter of the levels is in both chi-squares
            if apart or further.R_measured.chi2 < KNEE_GAIN * chi2:
                half_ohm = 0.5 * (further.R_measured.value - R_w)  # other knees leave up to 0.6 of what they had
                R_s, measured = (replace(e, std=math.hypot(e.std, half_ohm)) for e in (further.R_s, further.R_measured))
                return replace(further, R_s=R_s, R_measured=measured)
    threshold_v = DEVICES_MOST_V * (tolerance.bridge_threshold_v > 0.0)
    hidden = _hidden_in_knee(curve, V_dead, plateau_v, threshold_v, chi2 > CHI2_WARN and within and fit_from > FIT_FROM)
    misfit_ohm = math.sqrt(chi2) * sigma_v / peak
    # a misfit that is small beside what the knee may hide is no reason to lose R, and what needs any of it
    if CHI2_REFUSE < chi2 <= CHI2_HOPELESS or (CHI2_HOPELESS < chi2 and misfit_ohm < hidden):
        verdict, widen = Verdict.WARN, math.sqrt(chi2)
    else:
        (verdict, widen), misfit_ohm = chi2_gate(chi2, STAGE), 0.0
    condition_gate(best.condition, "R_s and the inverter error", STAGE)
    variance = sum(
        w * (fit.covariance[0, 0] * widen**2 + (fit.x[0] - R_w) ** 2) for w, fit in zip(weights, fits, strict=True)
    )
    hardness = abs(V_dead) / (R_w * peak)
    std = math.sqrt(float(variance)) * (HARD_FACTOR if hardness > HARD_RATIO else 1.0)
    std = math.hypot(std, DRIFT_SECOND_ORDER * abs(drift) * R_w, tolerance.voltage_scale_std * R_w, misfit_ohm)
    _check_result(R_w, std, math.inf if COVERAGE_FACTOR * std < hidden else HALF_WIDTH_LIMIT)
    told_of_link, left_out = _told_of_the_link(float(np.ptp(fall))), ""
    if fit_from > FIT_FROM:
        left_out = f"levels below {fit_from:g} of the largest left out: within the knee of the inverter's error"
    R_measured = Estimate(
        value=R_w,
        std=std,
        systematic=math.hypot(tolerance.impedance * R_w, hidden),
        unit="ohm",
        n=int(np.sum(used)),
        chi2=chi2,
        T_c=T_w,
        method="multi-level DC, asymptotic slope",
        i_d_apk=peak,
        dof=math.inf,
        fallback="; ".join(filter(None, (told_of_link, left_out, WITHIN_KNEE if hidden > KNEE_TOLD * R_w else ""))),
    )
    return ResistanceResult(
        R_s=normalised(R_measured, copper, tolerance),
        R_measured=R_measured,
        curve=curve,
        V_dead_v=V_dead,
        drift=drift,
        verdict=verdict,
        copper=copper,
    )


def _hidden_in_knee(
    curve: InverterCurve, V_dead_v: float, plateau_v: float, threshold_v: float, within: bool = False
) -> float:
    """Return how much of R (ohm) may be the inverter's error, where the levels do not come out of its knee.

    The error grows up to a plateau: R is too large by what lacks to that at most, too small by what it still rises.
    """
    i, error, fitted_v = curve.i_phase_a, curve.u_error_v, abs(V_dead_v)
    if not within and fitted_v >= PLATEAU_SEEN * plateau_v and curve.knee_a(V_dead_v) < KNEE_SHARE * i[-1]:
        return 0.0
    stated_v = DEAD_TIME_MOST * plateau_v + threshold_v
    most_v = stated_v if fitted_v < PLATEAU_BEYOND * stated_v else fitted_v
    hidden = max(0.0, (most_v - error[-1]) / i[-1], np.polyfit(i[-TOP_LEVELS:], error[-TOP_LEVELS:], 1)[0])
    return float(min(hidden, max(fitted_v, plateau_v) / i[-1]))


def _link_fall(levels: Trace, i: Array, error_v: Array, noise_v: float) -> Array:
    """Return by how much the DC link stands below its highest at each level, by its power (relative, negative).

    0 where it is not recorded, or moves the error by less than the noise. Ripple of its means would hide that it falls.
    """
    power_w = levels["u_d_v"] * i
    U_dc = np.polyval(np.polyfit(power_w, levels.signals.get("U_dc_v", np.ones_like(i)), LINK_DEGREE), power_w)
    fall = np.asarray(U_dc / np.max(U_dc) - 1.0)
    return fall if np.ptp(fall) * np.max(np.abs(error_v)) > noise_v else np.zeros_like(i)


def _told_of_the_link(fall: float) -> str:
    """Return what R rests on where the link fell by a share; empty where it hardly did."""
    share = f"{100.0 * LINK_SHARE:.0f} +- {200.0 * LINK_SHARE_STD:.0f} % of the inverter's error"
    told = f"the DC link falls by {100.0 * fall:.2g} % under the test current: {share} is assumed to fall with it"
    return told if fall >= LINK_TOLD else ""


def _warmth(t: Array, T: Array, fall: Array, i: Array, v: Array, used: NDArray[np.bool_], sigma_v: float) -> Array:
    """Return how the winding warms from level to level (1): with time, or where that does not fit, by losses or sensor.

    What a sensor shows is a shape, too: of the loop only the copper warms, and how much of it that is, is not known.
    Every level warms it; those ``used`` tell how. From the coldest to the warmest it is 1.
    """
    from scipy.optimize import minimize_scalar

    def misfit(warmth: Array) -> float:
        columns, target, weight = _tail_rows(warmth[used], fall[used], i[used], v[used], sigma_v)
        rows, shared = columns * weight[:, None], [*range(SHARED + 1), -1]  # each model has one column more, at most
        q = np.linalg.qr(rows[:, shared])[0]
        further = np.column_stack([target * weight, rows[:, SHARED + 1 : -1]])
        left = further - q @ (q.T @ further)
        v_left, tails = left[:, 0], left[:, 1:]
        return float(v_left @ v_left - np.max((v_left @ tails) ** 2 / np.sum(tails**2, axis=0)))

    found = minimize_scalar(
        lambda log_tau: misfit(_heated(t, i, math.exp(log_tau))),
        bounds=(math.log(WARMING_S[0]), math.log(WARMING_S[1])), method="bounded", options={"xatol": WARMING_TOLERANCE},
    )  # fmt: skip
    shapes = [_heated(t, i, math.exp(found.x))]
    if np.all(np.isfinite(T)) and np.ptp(T) > SENSED_K:
        shapes.append(T)
    best = min(shapes, key=misfit)
    chosen = best if misfit(best) < misfit(t) - WARMING_GAIN else t
    return np.asarray(chosen / np.ptp(chosen))


def _heated(t: Array, i: Array, tau_s: float) -> Array:
    """Return the warmth of a winding of one time constant (1), cold before the first level: late in every level."""
    passed = np.diff(t, prepend=t[0] - np.median(np.diff(t))) / tau_s
    out, warm = [], 0.0
    for rest, late, heat in zip(
        -np.expm1(-passed), -np.expm1(-LATE * passed), (i / np.max(np.abs(i))) ** 2, strict=True
    ):
        out.append(warm + late * (heat - warm))
        warm += rest * (heat - warm)
    return np.array(out)


def _level_sigma(warmth: Array, fall: Array, i: Array, v: Array, R_0: float, noise_v: float) -> float:
    """Standard deviation of one level (V): noise of the mean, and a model error as large as the levels scatter."""
    peak = float(np.max(np.abs(i)))
    least = math.hypot(noise_v, MODEL_FLOOR_LEAST * R_0 * peak)
    fits = (_fit_tail(warmth, fall, i, v, least, powers) for powers in tail_models())
    scatter = min(fit.chi2 / fit.dof for fit in fits)
    return min(max(1.0, math.sqrt(scatter)) * least, math.hypot(noise_v, MODEL_FLOOR * R_0 * peak))


def two_point_slope(i: Array, v: Array) -> float:
    """Slope between the largest level and the one nearest to 60 % of it, mean of both signs (ohm)."""
    peak = float(np.max(np.abs(i)))
    high = np.abs(i) > 0.97 * peak
    middle = np.abs(np.abs(i) - 0.6 * peak) < 0.06 * peak
    if not np.any(middle):
        middle = np.abs(i) < 0.7 * peak
    if not np.any(middle):
        raise refuse("E_EXCITATION", "all levels have the same magnitude", stage=STAGE)

    def mean(mask: NDArray[np.bool_]) -> tuple[float, float]:
        sign = np.sign(i[mask])
        return float(np.mean(sign * i[mask])), float(np.mean(sign * v[mask]))

    (i_1, v_1), (i_2, v_2) = mean(middle), mean(high)
    R_0 = (v_2 - v_1) / (i_2 - i_1)
    if not R_0 > 0.0:
        raise refuse("E_EXCITATION", f"the voltage does not rise with the current ({R_0:.3g} ohm)", stage=STAGE)
    return R_0


def _check_levels(levels: Trace, i: Array, used: NDArray[np.bool_], noise: Noise) -> None:
    peak, least = float(np.max(np.abs(i))), float(np.min(np.abs(i[used])))
    for sign in (1.0, -1.0):
        count = len(set(np.round(i[used & (np.sign(i) == sign)] / (0.02 * peak))))
        if count < TAIL_TERMS + 3:
            what = f"{count} different levels of one sign from {least:.3g} to {peak:.3g} A, {TAIL_TERMS + 3} needed"
            raise refuse("E_EXCITATION", what, stage=STAGE)
    change, limit = _settling(levels, noise)
    worst = int(np.argmax(np.abs(change) / limit))
    if abs(change[worst]) > limit[worst]:
        what = f"at {i[worst]:.3g} A the voltage still moves by {change[worst]:.3g} V in one window"
        raise refuse("E_NOT_SETTLED", f"{what}, limit {limit[worst]:.3g} V", stage=STAGE)


def _settling(levels: Trace, noise: Noise) -> tuple[Array, Array]:
    """Change of v - R i between the halves of each window, and its limit (V)."""
    i = levels["i_d_a"]
    peak, R_0 = float(np.max(np.abs(i))), two_point_slope(i, levels["u_d_v"])
    change = (levels["u_d_second_v"] - levels["u_d_first_v"]) - R_0 * (levels["i_d_second_a"] - levels["i_d_first_a"])
    # what most windows change by, but not all one way, is the ripple of a link: they hold no whole periods of it
    one_way = np.ones_like(i), np.sign(i), levels["u_d_v"]
    ripple = min(float(np.median(np.abs(change - shape * np.median(change / shape)))) for shape in one_way)
    sigma = 2.0 * R_0 * noise.sigma_a / math.sqrt(int(levels.meta["samples"]))  # difference of two halves
    fit_limit = max(SETTLE_SIGMA * max(sigma, ripple), SETTLE_FLOOR * R_0 * peak)
    curve_limit = max(fit_limit, CURVE_SETTLE * float(np.max(np.abs(levels["u_d_v"]))))
    return change, np.where(np.abs(i) >= FIT_FROM * peak, fit_limit, curve_limit)


def unsettled(levels: Trace, noise: Noise) -> NDArray[np.bool_]:
    """Levels whose voltage still moves: at some currents the rotor of a reluctance machine leaves the vector slowly."""
    change, limit = _settling(levels, noise)
    return np.asarray(np.abs(change) > limit)


def settled_levels(levels: Trace, noise: Noise) -> tuple[Trace, int]:
    """Return the levels at which shaft and voltage stood still, and how many were left out: not more than a quarter.

    A reluctance machine has currents at which its rotor leaves the vector so slowly that it never comes to rest.
    """
    moved = levels.signals.get("moved", np.zeros(len(levels))) > 0.0
    flagged = levels.signals.get("flagged", np.zeros(len(levels))) > 0.0
    if np.any(flagged):
        moved &= ~flagged  # a limit is no motion: the estimator names it
    else:
        moved |= unsettled(levels, noise)
    left_out = int(np.sum(moved))
    if not 0 < left_out <= MOVED_SHARE * len(levels):
        return levels, 0
    signals = {name: values[~moved] for name, values in levels.signals.items()}
    return Trace(levels.t_s[~moved], signals, levels.units, levels.meta), left_out


def resistance_warmed(R: Estimate, T_c: float, copper: Copper) -> float:
    """Return a measured resistance at another temperature of the winding (ohm); as it is where either is unknown."""
    known = math.isfinite(T_c) and math.isfinite(R.T_c)
    return R.value + (_per_k(R.value, copper, R.T_c) * (T_c - R.T_c) if known else 0.0)


def _per_k(R_ohm: float, copper: Copper, T_c: float) -> float:
    """Change per kelvin of a loop resistance whose winding is at ``T_c`` (ohm/K): that of its copper part."""
    all_copper = R_ohm / (1.0 + copper.alpha_per_k * (T_c - copper.T_ref_c))
    return copper.alpha_per_k * min(copper.R_winding_ohm or math.inf, all_copper)


def _tail_rows(warmth: Array, fall: Array, i: Array, v: Array, sigma_v: float) -> tuple[Array, Array, Array]:
    """Return columns, target and weights of the levels: R, V, v_0, drift, what of V falls with the link, all tails."""
    sign, u = np.sign(i), np.abs(i) / np.max(np.abs(i))
    centre = float(np.sum(warmth * i**2) / np.sum(i**2))
    drift = i * (warmth - centre)  # zero at the mean heating: R belongs to T_w
    odd_tail = (sign / u**p for p in TAIL_POWERS)
    columns = np.stack([i, sign, np.ones_like(i), drift, sign * fall, *odd_tail, u**-EVEN_POWER], axis=1)
    # one row more: how much of V falls with the link is known about as well
    share = np.zeros((1, columns.shape[1]))
    share[0, [1, 4]] = -LINK_SHARE, 1.0
    off = u - np.mean(u)
    V_rough = abs(float(np.mean(np.abs(v)) - np.mean(u) * (off @ np.abs(v)) / (off @ off)))
    weight = 1.0 / np.append(np.full_like(v, sigma_v), LINK_SHARE_STD * max(V_rough, sigma_v))
    return np.vstack([columns, share]), np.append(v, 0.0), weight


def _fit_tail(warmth: Array, fall: Array, i: Array, v: Array, sigma_v: float, powers: tuple[int, ...]) -> _TailFit:
    """Fit the levels by a tail of some powers."""
    columns, target, weight = _tail_rows(warmth, fall, i, v, sigma_v)
    kept = [*range(SHARED), *(SHARED + TAIL_POWERS.index(p) for p in powers), -1]
    x, covariance, residual, condition = linear_solve(columns[:, kept], target, weight)
    return _TailFit(x, covariance, float(residual @ residual), len(residual) - len(x), condition)


def _criterion(fit: _TailFit, levels: int) -> float:
    return fit.chi2 + len(fit.x) * math.log(levels)


def _check_drift(drift: float) -> None:
    if abs(drift) > DRIFT_LIMIT:
        what = f"R changed by {100 * drift:+.2g} % over the sweep, limit {100 * DRIFT_LIMIT:g} %"
        raise refuse("E_THERMAL_DRIFT", what, stage=STAGE)


def _check_result(R: float, std: float, limit: float) -> None:
    if not R > 0.0 or COVERAGE_FACTOR * std > limit * R:
        what = f"R_s and V_dead cannot be separated: R = {R:.4g} +- {COVERAGE_FACTOR * std:.2g} ohm (95 %)"
        more = "allow a higher peak current (--i-max)"
        raise refuse("E_NOT_IDENTIFIABLE", f"{what}, limit {100 * HALF_WIDTH_LIMIT:g} %", stage=STAGE, hint=more)


def normalised(measured: Estimate, copper: Copper, tolerance: SensorTolerance) -> Estimate:
    """Return R with its copper part moved from its measured temperature to the reference temperature.

    Where no sensor tells the temperature, the value is the measured one, which is what loops meet, and its systematic
    half width reaches to what it would be at the reference temperature, had the winding had 5 or 90 degC.
    """
    if not math.isfinite(measured.T_c):
        low, high = UNKNOWN_T_RANGE_C
        off = max(abs(_at_reference_ohm(measured.value, copper, T) - measured.value) for T in UNKNOWN_T_RANGE_C)
        return replace(
            measured,
            systematic=math.hypot(measured.systematic, off),
            dof=math.inf,
            fallback=f"winding temperature unknown: R_s as measured, its interval is that of {low:g} to {high:g} degC",
        )
    rise = copper.alpha_per_k * (measured.T_c - copper.T_ref_c)
    value = _at_reference_ohm(measured.value, copper, measured.T_c)
    unknown = tolerance.device_share_max if copper.R_winding_ohm is None else copper.winding_half_ohm / value
    scale = value / measured.value
    systematic = math.hypot(measured.systematic * scale, unknown * abs(rise) * value)
    systematic = math.hypot(systematic, copper.alpha_per_k * tolerance.temperature_k * value)
    return Estimate(value=value, std=measured.std * scale, systematic=systematic, unit="ohm", n=measured.n,
                    chi2=measured.chi2, T_c=measured.T_c, method=measured.method, i_d_apk=measured.i_d_apk)  # fmt: skip


def _at_reference_ohm(R_ohm: float, copper: Copper, T_c: float) -> float:
    """Return a loop resistance of a winding at ``T_c`` as it is at the reference temperature (ohm)."""
    return R_ohm - _per_k(R_ohm, copper, T_c) * (T_c - copper.T_ref_c)


def at_the_test(estimates: Mapping[str, Estimate]) -> dict[str, Estimate]:
    """Return estimates with R of an unknown temperature as it was measured: loops do not see the doubt of T_ref."""
    R, measured = estimates.get("R_s_ohm"), estimates.get(R_MEASURED)
    unknown = R is not None and measured is not None and not math.isfinite(R.T_c)
    return {**estimates, "R_s_ohm": measured} if unknown and measured is not None else dict(estimates)
