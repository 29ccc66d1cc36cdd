# SPDX-License-Identifier: MIT
"""A flux map from voltage pulses: co-energy spline regression (docs/identification.md, 3.3).

One linear least squares for all spline coefficients, R, the inverter's plateau, iron loss and the delay of the current
sample. A coarse pass gives the inverse incremental inductance that weights the fine one: it turns flux residuals into
current residuals of the measured noise. Symmetry in i_q and reciprocity are tested on freer models, never assumed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.estimators.flux.coenergy_spline import CoenergySpline
from pmsmtool.estimators.flux.map_rows import (
    IRON_PERIODS,
    NUISANCES,
    Frame,
    Legs,
    NormalEquations,
    PulseIntegrals,
    Whitener,
    correlation,
    integrate_pulses,
    normal_equations,
)
from pmsmtool.estimators.injection.angle_dependence import HARMONICS
from pmsmtool.estimators.injection.sampling_instant import Sampling
from pmsmtool.estimators.inverter_error import InverterCurve, Modulation
from pmsmtool.trace import Trace

PIECES = ((9, 11), (11, 13), (13, 15), (15, 17), (17, 19))
"""Break points along i_d and i_q that are tried; the first for weights and alignment. A measured map needs the last; in
it what dead time leaves bends a smooth machine."""
PRICE = 4.0
"""Of a coefficient, in twice the log-likelihood. Below 2.7 such residuals pay for some; above 6.0 that map does not."""
SKEW_PIECES = (4, 4)
ALIGNMENTS = 3
"""Turns of the frame onto the axis of symmetry; each leaves a percent of the angle."""
INDUCTANCE_FLOOR = 0.2
"""Smallest inductance in the weights, of the median."""
COUPLING_MOST = 0.7
"""Largest |L_dq|/sqrt(L_dd L_qq) in the weights: beyond, a bad first pass would decide them."""
ROUGHNESS = 1e-7
"""Weight of the squared third differences, of the mean diagonal: pins what data leave open. The reference's 1e-10 lets
the rim of the disc swing until a flux falls with its current; 1e-6 bends the map (0.03 -> 0.05 % rms of the range)."""
RISING, RISING_ROUNDS = 1e-3, 6
"""Weight, as of ``ROUGHNESS``, of an inductance where the fit falls below its least: no machine's flux falls
with its current. Enough where pulses left a gap, nothing against data. Rounds until none falls; measured 1 to 3."""
LEAST_INDUCTANCE = 0.1
"""Smallest incremental inductance in such a gap, of the median: that of the deepest saturation that is drawn."""
RIDGE = 1e-13
"""The same for the constant of W."""
R_STD = 0.01
"""Relative standard deviation of R in the fit: it follows the winding's temperature."""
INVERTER_STD = 0.1
"""Standard deviation of the factor on the measured inverter curve."""
DELAY_STD_SHARE, DELAY_LEFT_SHARE = 0.1, 0.01
"""Standard deviation of the delay of the current sample, of the control period; and where it is known, of its rest."""
IRON_STD_SHARE = 0.5
"""Standard deviation of what flows in each branch of iron loss, per volt and by the mean inductance, likewise."""
ANCHOR = 1e4
"""Weight of the flux at zero current, of the mean diagonal: the run over speeds knows it, the motion under pulses
hardly does; its deviation is added to the result's."""
SYMMETRIC_SHARE = 0.001
"""Asymmetry (rms, of the flux range) that counts as none whatever its standard deviation: what the fit leaves."""
SYMMETRIC_SIGMA = 3.0
DISC_POINTS = 25
"""Points per axis of the grid on which symmetry is looked at."""


@dataclass(frozen=True, slots=True)
class MagnetFlux:
    """psi_d where another experiment measured it, at the temperature of the pulses."""

    psi_wb: float
    std_wb: float
    """Mean of psi_d over the points (Wb), and its standard deviation."""
    i_d_a: tuple[float, ...] = (0.0,)
    i_q_a: tuple[float, ...] = (0.0,)
    """The points (A); a run with i_d of both signs means the mean of psi_d there, not psi_d at zero current."""
    weight: tuple[float, ...] = (1.0,)
    """Their weights, of sum one."""


@dataclass(frozen=True, slots=True, eq=False)
class CoenergyFit:
    """A fitted co-energy."""

    spline: CoenergySpline
    """Its space."""
    c: Array
    """Coefficients. Shape (k,)."""
    covariance: Array
    """Of the coefficients, widened by the residual and by how much neighbouring residuals say the same.
    Shape (k, k)."""
    delay_s: float
    """Delay of the current sample that fits (s)."""
    sigma_a: float
    """Noise of one sample (A)."""
    chi2: float
    """Reduced chi-square of the current residual against the noise."""
    n: int
    """Residuals."""
    symmetric: bool
    """Whether W is even in i_q."""
    asymmetry: float
    """Rms of the flux that breaks the symmetry in the free fit (Wb)."""
    axis_rad: float
    """Angle of the symmetry axis from the frame's d axis (rad electrical)."""
    skew: FittedSkew
    """Flux that has no co-energy."""
    frame: Frame
    """The angles used."""
    magnet_std_wb: float
    """Standard deviation of the flux at zero current (Wb)."""
    unphysical_wb: float = 0.0
    """Rms of what the pulses show and no machine has (Wb), as a deviation of every flux."""
    unseen: float = 0.0
    """Relative deviation of the inductances that the angles of the pulses leave of their mean over all angles."""

    def flux(self, i_d_a: Array, i_q_a: Array) -> Array:
        """Return psi_d, psi_q (Wb), shape (2, n)."""
        return self.spline.flux(self.c, i_d_a, i_q_a)

    def inductance(self, i_d_a: Array, i_q_a: Array) -> Array:
        """Return L_dd, L_dq, L_qq (H), shape (3, n)."""
        return self.spline.inductance(self.c, i_d_a, i_q_a)

    @property
    def misfit_a(self) -> float:
        """Current residual that noise does not explain (A rms): the spline, or an effect that no column has."""
        return self.sigma_a * math.sqrt(max(0.0, self.chi2 - 1.0))

    def flux_std(self, i_d_a: Array, i_q_a: Array) -> Array:
        """Return the standard deviations of psi_d, psi_q (Wb), shape (2, n): of the fit, and its misfits as flux."""
        fitted = np.stack([self._std(i_d_a, i_q_a, 1, 0), self._std(i_d_a, i_q_a, 0, 1)])
        L_dd, L_dq, L_qq = self.inductance(i_d_a, i_q_a)
        misfit = self.misfit_a * np.stack([np.hypot(L_dd, L_dq), np.hypot(L_dq, L_qq)])
        apart = self.unphysical_wb**2 + np.array([[self.magnet_std_wb], [0.0]]) ** 2
        apart = apart + (self.unseen * (self.flux(i_d_a, i_q_a) - self.flux(np.zeros(1), np.zeros(1)))) ** 2
        return np.asarray(np.sqrt(fitted**2 + misfit**2 + apart))

    def inductance_std(self, i_d_a: Array, i_q_a: Array) -> Array:
        """Return the standard deviations of L_dd, L_dq, L_qq (H), shape (3, n).

        The misfit of the flux changes sign from break point to break point, so its slope is the misfit over their
        distance: that of the finest space, whichever was taken.
        """
        fitted = np.stack([self._std(i_d_a, i_q_a, *order) for order in ((2, 0), (1, 1), (0, 2))])
        L_dd, L_dq, L_qq = self.inductance(i_d_a, i_q_a)
        misfit_d, misfit_q = self.misfit_a * np.hypot(L_dd, L_dq), self.misfit_a * np.hypot(L_dq, L_qq)
        breaks, at = (self.spline.breaks_d, self.spline.breaks_q), (i_d_a, i_q_a)
        h_d, h_q = (
            _spacing(*each) * (len(each[0]) - 1) / most for *each, most in zip(breaks, at, PIECES[-1], strict=True)
        )
        misfit = np.stack([misfit_d / h_d, np.sqrt(misfit_d * misfit_q / (h_d * h_q)), misfit_q / h_q])
        unseen = self.unseen * np.stack([L_dd, np.sqrt(np.abs(L_dd * L_qq)), L_qq])
        return np.asarray(np.sqrt(fitted**2 + misfit**2 + unseen**2))

    def _std(self, i_d_a: Array, i_q_a: Array, by_d: int, by_q: int) -> Array:
        rows = self.spline.derivative(i_d_a, i_q_a, by_d, by_q)
        variance = np.sum((rows @ self.covariance) * rows, axis=1)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _spacing(breaks: Array, x: Array) -> Array:
    """Return the distance of the break points around each x."""
    at = np.clip(np.searchsorted(breaks, x, side="right") - 1, 0, len(breaks) - 2)
    return np.diff(breaks)[at]


@dataclass(frozen=True, slots=True, eq=False)
class FittedSkew:
    """psi_d + skew(i) and psi_q of a fit that need not have a co-energy."""

    gradient: Array
    """Coefficients of its co-energy part."""
    spline: CoenergySpline
    c: Array
    """Space and coefficients of what is added to psi_d."""


@dataclass(frozen=True, slots=True)
class Priors:
    """What other experiments know of the columns behind the spline: means and standard deviations."""

    mean: tuple[float, ...]
    std: tuple[float, ...]


def fit_coenergy(
    traces: Sequence[Trace],
    frame: Frame,
    curve: InverterCurve,
    *,
    R_ohm: float,
    sigma_a: float,
    magnet: MagnetFlux,
    align: bool = False,
    legs: tuple[Modulation, Sampling | None] | None = None,
) -> CoenergyFit:
    """Fit the co-energy.

    Parameters
    ----------
    traces : sequence of Trace
        Pulses in the rotor frame (``experiments.flux_map_scan``).
    frame : Frame
        Angles.
    curve : InverterCurve
        Voltage error of one phase.
    R_ohm : float
        Loop resistance at the temperature of the pulses (ohm).
    sigma_a : float
        Noise of one sample of i_d or i_q (A).
    magnet : MagnetFlux
        Flux at zero current; a held rotor shows increments only.
    align : bool
        Turn the frame onto the axis of symmetry: where the offset of the encoder is not known better.
    legs : (Modulation, Sampling or None), optional
        Link, period and dead time (its inductances are not read), and when currents are sampled where that is known:
        with them the fine pass knows what the current does within a period.
    """
    T_s = float(traces[0].meta["control_period_s"])
    iron = [IRON_STD_SHARE * T_s] * len(IRON_PERIODS)
    mean = (R_ohm, 1.0, *([0.0] * (len(NUISANCES) - 2)))
    priors = Priors(mean, (R_STD * R_ohm, INVERTER_STD, *iron, DELAY_STD_SHARE * T_s))
    for _ in range(ALIGNMENTS if align else 1):
        pulses = [integrate_pulses(trace, frame, curve, R_ohm) for trace in traces]
        i = np.concatenate([p.i for p in pulses], axis=1)
        coarse = CoenergySpline.over(i[0], i[1], PIECES[0])
        sums = normal_equations(pulses, coarse, _flat(pulses))
        x, covariance = _solve(sums, coarse, priors, magnet, _unit(sums, coarse, priors, magnet, sigma_a))
        whiten = _by_inductance(coarse, x[: coarse.size], i)
        if align:
            frame = replace(frame, offset_rad=frame.offset_rad - _symmetry(coarse, x, covariance, i)[2])
    if legs is not None:
        modulation, sampling = legs
        inductances = _inductances(coarse, x[: coarse.size], i)
        typical = np.median(inductances(i[:, ::8]), axis=1)
        known = replace(modulation, L_h=(float(typical[0]), float(typical[1])))
        within = Legs(known, sampling or Sampling(), inductances)
        pulses = [integrate_pulses(trace, frame, curve, R_ohm, within) for trace in traces]
        if sampling is not None:
            priors = replace(priors, std=(*priors.std[:-1], DELAY_LEFT_SHARE * T_s))
    return _fine_fit(pulses, i, frame, whiten, priors, sigma_a, magnet)


def _fine_fit(
    pulses: Sequence[PulseIntegrals],
    i: Array,
    frame: Frame,
    whiten: Whitener,
    priors: Priors,
    sigma_a: float,
    magnet: MagnetFlux,
) -> CoenergyFit:
    tried, weights = [], {id(one.i): whiten(one.i) for one in pulses}  # the same for every space
    for spline in (CoenergySpline.over(i[0], i[1], pieces) for pieces in PIECES):
        sums = normal_equations(pulses, spline, lambda i: weights[id(i)])
        unit = _unit(sums, spline, priors, magnet, sigma_a)
        x, _ = _solve(sums, spline, priors, magnet, unit, even=True)
        tried.append((math.log(sums.squares(x)), PRICE * spline.even().shape[1], unit, spline))
    alike = correlation(pulses, spline, lambda i: weights[id(i)], x)
    *_, unit, spline = min(tried, key=lambda each: sums.n / alike * each[0] + each[1])
    unit *= math.sqrt(alike)
    skew = CoenergySpline.over(i[0], i[1], SKEW_PIECES)
    with_skew = normal_equations(pulses, spline, lambda i: weights[id(i)], skew)
    k, own = spline.size, spline.size + len(NUISANCES)
    sums = NormalEquations(with_skew.A[:own, :own], with_skew.b[:own], with_skew.c, with_skew.n)
    x, covariance = _solve(sums, spline, priors, magnet, unit)
    asymmetry, asymmetry_std, axis = _symmetry(spline, x, covariance, i)
    symmetric = asymmetry <= max(SYMMETRIC_SIGMA * asymmetry_std, SYMMETRIC_SHARE * _span(spline, x, i))
    free, _ = _solve(with_skew, spline, priors, magnet, unit)
    rising = _falling(spline, x, i)
    for _ in range(RISING_ROUNDS):
        x, covariance = _solve(sums, spline, priors, magnet, unit, even=symmetric, rising=rising)
        more = _falling(spline, x, i)
        if not len(more[1]):
            break
        rising = np.concatenate([rising[0], more[0]]), np.concatenate([rising[1], more[1]])
    return CoenergyFit(
        spline, x[:k], covariance[:k, :k], float(x[own - 1]), sigma_a,
        sums.squares(x) / (sigma_a**2 * (sums.n - len(x))), sums.n, symmetric, asymmetry, axis,
        FittedSkew(free[:k], skew, free[own:]), frame, magnet.std_wb, unseen=_unseen(pulses),
    )  # fmt: skip


def _unseen(pulses: Sequence[PulseIntegrals]) -> float:
    """Return the relative deviation of L that the angles of the pulses leave of its mean over all angles."""
    theta = np.concatenate([p.theta for p in pulses])
    return math.sqrt(sum((std * abs(np.mean(np.exp(1j * m * theta)))) ** 2 for m, std in HARMONICS.items()))


def _flat(pulses: Sequence[PulseIntegrals]) -> Whitener:
    """Return equal weights that make of flux about what the currents are (1/H), for the first pass."""
    swing = max(float(np.ptp(p.volt_seconds)) for p in pulses)
    current = max(float(np.ptp(p.i)) for p in pulses)
    return lambda i: np.broadcast_to(np.eye(2) * (current / swing), (i.shape[1], 2, 2))


def _inductances(spline: CoenergySpline, c: Array, i: Array) -> Callable[[Array], Array]:
    """Return L_dd and L_qq (H) over the currents of a first pass, none far below the median."""
    least = INDUCTANCE_FLOOR * np.median(spline.inductance(c, i[0][::8], i[1][::8]), axis=1)[[0, 2]]
    return lambda at: np.maximum(spline.inductance(c, at[0], at[1])[[0, 2]], least[:, None])


def _by_inductance(spline: CoenergySpline, c: Array, i: Array) -> Whitener:
    """Return L^-1: the noise of psi(i + n) is L n, so these rows have the noise of the current."""
    inductances = _inductances(spline, c, i)

    def whiten(at: Array) -> Array:
        L_dd, L_qq = inductances(at)
        most = COUPLING_MOST * np.sqrt(L_dd * L_qq)
        L_dq = np.clip(spline.inductance(c, at[0], at[1])[1], -most, most)
        det = L_dd * L_qq - L_dq**2
        return np.moveaxis(np.array([[L_qq, -L_dq], [-L_dq, L_dd]]) / det, 2, 0)

    return whiten


def _unit(sums: NormalEquations, spline: CoenergySpline, priors: Priors, magnet: MagnetFlux, sigma_a: float) -> float:
    """Return the standard deviation of a whitened residual: the noise, or what the fit leaves if that is more."""
    x, _ = _solve(sums, spline, priors, magnet, sigma_a)
    return max(sigma_a, math.sqrt(max(0.0, sums.squares(x)) / (sums.n - len(x))))


def _solve(
    sums: NormalEquations,
    spline: CoenergySpline,
    priors: Priors,
    magnet: MagnetFlux,
    unit: float,
    *,
    even: bool = False,
    rising: tuple[Array, Array] | None = None,
) -> tuple[Array, Array]:
    """Return the solution and its covariance, with priors and regularisation; ``unit`` is one residual's deviation.

    ``rising`` has the rows of inductances and what they are at least (H).
    """
    k, size = spline.size, len(sums.b)
    A, b = sums.A.copy(), sums.b.copy()
    for column, (mean, std) in enumerate(zip(priors.mean, priors.std, strict=True), start=k):
        weight = (unit / std) ** 2
        A[column, column] += weight
        b[column] += weight * mean
    zero = np.zeros(1)
    mean_diagonal = float(np.trace(sums.A[:k, :k])) / k
    there = np.array(magnet.weight) @ spline.derivative(np.array(magnet.i_d_a), np.array(magnet.i_q_a), 1, 0)
    for known, value in ((there, magnet.psi_wb), (spline.derivative(zero, zero, 0, 1)[0], 0.0)):
        row = np.zeros(size)
        row[:k] = known
        weight = ANCHOR * mean_diagonal / float(row @ row)
        A += weight * np.outer(row, row)
        b += weight * value * row
    A[:k, :k] += mean_diagonal * (ROUGHNESS * spline.roughness() + RIDGE * np.eye(k))
    if rising is not None:
        rows, least = rising
        weights = RISING * mean_diagonal / np.sum(rows**2, axis=1)
        A[:k, :k] += (rows.T * weights) @ rows
        b[:k] += rows.T @ (weights * least)
    behind = np.arange(k + len(NUISANCES), size)
    A[behind, behind] += ROUGHNESS * mean_diagonal * max(1.0, float(np.max(np.diag(sums.A)[behind], initial=0.0)))
    P = np.eye(size)
    if even:
        fold = spline.even()
        P = np.zeros((size, fold.shape[1] + size - k))
        P[:k, : fold.shape[1]] = fold
        P[k:, fold.shape[1] :] = np.eye(size - k)
        A, b = P.T @ A @ P, P.T @ b
    scale = 1.0 / np.sqrt(np.diag(A))  # columns of unit length: spline, R, inverter and delay differ by many decades
    scaled = A * np.outer(scale, scale)
    inverse = np.linalg.inv(scaled)
    x = P @ (scale * np.linalg.solve(scaled, scale * b))
    return x, unit**2 * (P @ (inverse * np.outer(scale, scale)) @ P.T)


def disc(i: Array) -> tuple[Array, Array]:
    """Return i_d, i_q of a grid over the disc that the data fill (A), i_q of both signs."""
    radius = 0.95 * min(float(np.max(np.abs(i[0]))), float(np.max(np.abs(i[1]))))
    axis = np.linspace(-radius, radius, DISC_POINTS)
    i_d, i_q = (grid.ravel() for grid in np.meshgrid(axis, axis, indexing="ij"))
    keep = (np.hypot(i_d, i_q) <= radius) & (i_d >= np.min(i[0])) & (i_d <= np.max(i[0]))
    return i_d[keep], i_q[keep]


def _falling(spline: CoenergySpline, x: Array, i: Array) -> tuple[Array, Array]:
    """Return rows and least values (H) of the inductances that fall below them, within the circle of the data."""
    axes = [np.linspace(float(np.min(j)), float(np.max(j)), 2 * DISC_POINTS) for j in i]
    i_d, i_q = (grid.ravel() for grid in np.meshgrid(*axes, indexing="ij"))
    inside = np.hypot(i_d, i_q) <= float(np.max(np.hypot(*i)))
    found: list[tuple[Array, Array]] = []
    for order in ((2, 0), (0, 2)):
        rows = spline.derivative(i_d[inside], i_q[inside], *order)
        L = rows @ x[: spline.size]
        least = LEAST_INDUCTANCE * float(np.median(L))
        low = least > L
        found.append((rows[low], np.full(int(np.sum(low)), least)))
    return np.concatenate([f[0] for f in found]), np.concatenate([f[1] for f in found])


def _span(spline: CoenergySpline, x: Array, i: Array) -> float:
    return float(np.max(np.ptp(spline.flux(x[: spline.size], *disc(i)), axis=1)))


def _symmetry(spline: CoenergySpline, x: Array, covariance: Array, i: Array) -> tuple[float, float, float]:
    """Return the asymmetry in i_q (Wb), what noise shows, and the angle of the symmetry axis."""
    k = spline.size
    i_d, i_q = disc(i)
    rows = []
    for order, sign in (((1, 0), -1.0), ((0, 1), 1.0)):
        up, down = spline.derivative(i_d, i_q, *order), spline.derivative(i_d, -i_q, *order)
        rows.append(0.5 * (up + sign * down))
    broken = np.concatenate(rows)
    a = broken @ x[:k]
    C = covariance[:k, :k]
    noise = np.sum((broken @ C) * broken, axis=1)
    rms, expected = math.sqrt(float(np.mean(a**2))), math.sqrt(max(0.0, float(np.mean(noise))))
    # a symmetric map seen from a frame that is turned: change J psi - L J i per radian
    psi, (L_dd, L_dq, L_qq) = spline.flux(x[:k], i_d, i_q), spline.inductance(x[:k], i_d, i_q)
    on_q = psi[0] + L_dq * i_q - L_qq * i_d
    # without its mean: a held rotor shows no constant of psi_q
    per_radian = np.concatenate([-psi[1] + L_dd * i_q - L_dq * i_d, on_q - np.mean(on_q)])
    power = float(per_radian @ per_radian)
    return rms, expected, float(per_radian @ a) / power
