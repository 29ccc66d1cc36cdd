# SPDX-License-Identifier: MIT
"""R_s from DC levels at two control frequencies, extrapolated to zero: dead time of any shape falls out.

What the dead time takes from a period does not depend on the period's length, so its voltage is f g(i); the devices'
own drop d(i) does not know the frequency. At the levels that both sequences hold, one fit of

    v = R i + (f / f_1) g(|i|) sgn(i) + V sgn(i) [+ c sgn(i) / |i|^p] + v0(f)

leaves g free at every level, so no shape is assumed of it; only the rest, the devices, has one (docs/identification.md,
3.1 no. 10).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pmsmtool.estimators.estimate import SensorTolerance, Verdict, chi2_gate, condition_gate, information_weights
from pmsmtool.estimators.inverter_error import InverterCurve
from pmsmtool.estimators.least_squares import linear_solve
from pmsmtool.estimators.noise import Noise
from pmsmtool.estimators.refusals import refuse
from pmsmtool.estimators.resistance import MEAN_NOISE_FACTOR, Copper, ResistanceResult, normalised
from pmsmtool.trace import Trace

STAGE = "resistance"
Vector = NDArray[np.float64]

REST_MODELS: tuple[tuple[int, ...], ...] = ((), (1,), (2,))
"""Tails that what does not depend on the frequency may have, as powers of 1/|i|."""
SAME_LEVEL = 0.03
"""Distance of two currents, of the largest, that are the same level; levels are 0.08 apart."""
LEAST_LEVELS = 5
"""Levels of one magnitude that both sequences must hold."""
SCATTER_FLOOR = 3e-5
"""Smallest model error of a level, of R I: with noise alone chi-square was 0.5 to 2.1 on 24 switched drives."""
SCATTER_MOST = 2e-4
"""Largest one, as for a single frequency."""
MODEL_STD = 5.5e-4
"""What else is off, of R: the rms error over 24 switched drives without the thresholds' share, 0.02 % of it noise. The
mean is -0.045 %: dead time delays the edges, and the sample before them is no longer in their middle."""
DRIFT_SECOND_ORDER = 0.04
"""Part of a drift that its linear term may leave in R: twice that of one frequency, as the extrapolation doubles it."""
LEAST_SPREAD = 1.2
"""Ratio of the two periods below which nothing is extrapolated."""


@dataclass(frozen=True, slots=True)
class FrequencySplit:
    """The voltage error of one phase in its two parts.

    Attributes
    ----------
    R_ohm, std_ohm : float
        Loop resistance at the temperature of the measurement, and its statistical standard deviation.
    chi2, verdict : float, Verdict
        Of the fit.
    V_device_v, V_device_std_v : float
        Plateau of the part that does not depend on the frequency, and its statistical standard deviation (V).
    V_dead_std_v : float
        Statistical standard deviation of :attr:`V_dead_v` (V).
    curve : InverterCurve
        Part that scales with the frequency, at the drive's own one: dead time and slow edges.
    drift : float
        Relative change of R over both sequences.
    periods_s : tuple of float
        The two control periods.
    """

    R_ohm: float
    std_ohm: float
    chi2: float
    verdict: Verdict
    V_device_v: float
    V_device_std_v: float
    V_dead_std_v: float
    curve: InverterCurve
    drift: float
    periods_s: tuple[float, float]

    @property
    def V_dead_v(self) -> float:
        """Part that scales with the frequency at the largest current, at the drive's own frequency (V)."""
        return float(self.curve.u_error_v[-1])

    def dead_time_s(self, U_dc_v: float) -> float:
        """Return the dead time that takes this voltage from a DC link (s)."""
        return self.V_dead_v * self.periods_s[0] / U_dc_v


@dataclass(frozen=True, slots=True)
class _Rows:
    """Levels of both sequences that have a partner: the fit's rows."""

    i: Vector
    v: Vector
    t: Vector
    share: Vector
    group: NDArray[np.int64]
    peak: float


def split_by_frequency(
    levels: Trace,
    slower: Trace,
    noise: Noise,
    *,
    phase_factor: float = math.sqrt(3.0) / 2.0,
    tolerance: SensorTolerance | None = None,
    least_current: float = 0.0,
) -> FrequencySplit:
    """Fit the levels of two control frequencies together.

    Parameters
    ----------
    levels, slower : Trace
        As for ``estimate_resistance``, at the drive's own period and at a longer one; ``meta["period_s"]`` of the
        slower one and ``meta["own_period_s"]`` are the two periods. Voltages are those at one winding temperature.
    noise : Noise
        From the zero-current trace.
    phase_factor : float
        Phase current over vector current.
    tolerance : SensorTolerance
        Declared sensor tolerances.
    least_current : float
        Share of the largest current below which a level does not enter.

    Raises
    ------
    IdentificationError
        ``E_EXCITATION`` when the sequences share too few levels or the periods are too near to each other,
        ``E_MODEL_MISMATCH``, ``E_NOT_IDENTIFIABLE``.
    """
    tolerance = tolerance or SensorTolerance()
    periods = float(slower.meta["own_period_s"]), float(slower.meta["period_s"])
    if periods[1] < LEAST_SPREAD * periods[0]:
        raise refuse(
            "E_EXCITATION", f"the control periods {periods[0]:.3g} and {periods[1]:.3g} s are the same", stage=STAGE
        )
    rows = _matched(levels, slower, periods[0] / periods[1], least_current)
    samples = min(int(levels.meta["samples"]), int(slower.meta["samples"]))
    fits = [_fit(rows, powers, 1.0) for powers in REST_MODELS]
    R_0 = float(fits[0][0][0])
    noise_v = MEAN_NOISE_FACTOR * abs(R_0) * noise.sigma_a / math.sqrt(samples)
    least = math.hypot(noise_v, SCATTER_FLOOR * abs(R_0) * rows.peak)
    scatter = math.sqrt(min(fit[2] / fit[3] for fit in fits)) / least
    sigma = min(max(1.0, scatter) * least, math.hypot(noise_v, SCATTER_MOST * abs(R_0) * rows.peak))
    fits = [_fit(rows, powers, sigma) for powers in REST_MODELS]
    weights = information_weights([fit[2] + len(fit[0]) * math.log(len(rows.i)) for fit in fits])
    x = np.sum([w * _common(fit[0], powers) for w, fit, powers in zip(weights, fits, REST_MODELS, strict=True)], axis=0)
    R, V_device, drift = float(x[0]), phase_factor * float(x[1]), float(x[4]) / float(x[0])
    best = min(fits, key=lambda fit: fit[2] / fit[3])
    verdict, widen = chi2_gate(best[2] / best[3], STAGE)
    condition_gate(best[4], "R_s and the dead time", STAGE)
    stds = [
        math.sqrt(
            sum(w * (fit[1][k, k] * widen**2 + (fit[0][k] - x[k]) ** 2) for w, fit in zip(weights, fits, strict=True))
        )
        for k in range(len(x))
    ]
    model = math.hypot(MODEL_STD, DRIFT_SECOND_ORDER * abs(drift), tolerance.voltage_scale_std)
    std = math.hypot(stds[0], model * R)
    magnitude = np.array([np.mean(np.abs(rows.i[rows.group == k])) for k in range(int(rows.group.max()) + 1)])
    curve = InverterCurve(phase_factor * magnitude, phase_factor * x[5:], 0.0)
    V_stds = phase_factor * stds[1], phase_factor * stds[-1]
    return FrequencySplit(R, std, best[2] / best[3], verdict, V_device, *V_stds, curve, drift, periods)


def _matched(levels: Trace, slower: Trace, share: float, least_current: float) -> _Rows:
    i = np.concatenate([levels["i_d_a"], slower["i_d_a"]])
    v = np.concatenate([levels["u_d_v"], slower["u_d_v"]])
    t = np.concatenate([levels.t_s, slower.t_s + levels.t_s[-1] + (levels.t_s[-1] - levels.t_s[-2])])
    slow = np.arange(len(i)) >= len(levels)
    peak = float(np.max(np.abs(i)))
    order = np.argsort(np.abs(i), kind="stable")
    steps = np.diff(np.abs(i)[order], prepend=0.0) > SAME_LEVEL * peak
    group = np.empty(len(i), dtype=np.int64)
    group[order] = np.cumsum(steps)
    kept = np.zeros(len(i), dtype=bool)
    for k in np.unique(group):
        mine = group == k
        signs = [set(np.sign(i[mine & (slow == which)])) for which in (False, True)]
        kept |= mine & (np.abs(i) >= least_current * peak) & (signs[0] == signs[1] == {1.0, -1.0})
    _, group = np.unique(group[kept], return_inverse=True)
    count = int(group.max()) + 1 if len(group) else 0
    if count < LEAST_LEVELS:
        raise refuse(
            "E_EXCITATION", f"both control frequencies share {count} levels, {LEAST_LEVELS} are needed", stage=STAGE
        )
    return _Rows(i[kept], v[kept], t[kept], np.where(slow[kept], share, 1.0), group, peak)


_Fit = tuple[Vector, NDArray[np.float64], float, int, float]
"""Solution, covariance, chi-square, degrees of freedom, condition number."""


def _fit(rows: _Rows, powers: tuple[int, ...], sigma_v: float) -> _Fit:
    """Columns: i, sgn, even part of each frequency, drift, g at each level, tails of the rest."""
    sign = np.sign(rows.i)
    fast = rows.share == 1.0
    centre = float(np.sum(rows.t * rows.i**2) / np.sum(rows.i**2))
    drift = rows.i * (rows.t - centre) / float(np.ptp(rows.t))
    dead = [np.where(rows.group == k, sign * rows.share, 0.0) for k in range(int(rows.group.max()) + 1)]
    tails = [sign / (np.abs(rows.i) / rows.peak) ** p for p in powers]
    columns = np.stack([rows.i, sign, fast * 1.0, ~fast * 1.0, drift, *dead, *tails], axis=1)
    x, covariance, residual, condition = linear_solve(columns, rows.v, np.full_like(rows.v, 1.0 / sigma_v))
    return x, covariance, float(residual @ residual), len(rows.v) - len(x), condition


def _common(x: Vector, powers: tuple[int, ...]) -> Vector:
    """Return the solution without its tails."""
    return x[: len(x) - len(powers)]


def extrapolated(
    result: ResistanceResult, split: FrequencySplit, copper: Copper, tolerance: SensorTolerance
) -> ResistanceResult:
    """Return a result of one frequency with the resistance of two; its curve is that of the drive's own frequency."""
    measured = replace(
        result.R_measured,
        value=split.R_ohm,
        std=split.std_ohm,
        systematic=tolerance.impedance * split.R_ohm,
        n=4 * len(split.curve.i_phase_a),
        chi2=split.chi2,
        method="multi-level DC at two control frequencies, extrapolated to zero",
    )
    R_s = normalised(measured, copper, tolerance)
    notes = [note for note in (R_s.fallback, result.R_s.fallback) if note]
    curve = result.curve
    plateau = split.V_dead_v + split.V_device_v
    return replace(
        result,
        R_s=replace(R_s, fallback="; ".join(dict.fromkeys(notes))),
        R_measured=measured,
        curve=replace(curve, u_error_v=curve.u_error_v + (result.R_measured.value - split.R_ohm) * curve.i_phase_a),
        V_dead_v=plateau,
        drift=split.drift,
        hardness=abs(plateau) / (split.R_ohm * measured.i_d_apk),
        verdict=split.verdict,
    )
