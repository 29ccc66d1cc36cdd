"""Output-error fit of one axis from several square-wave shots: L with delay, sensor lag, saturation and motion.

Free in every fit: ln L, R, the delay D (a real number), the time constant of the current sensor and per shot the
starting current. Three effects are added only where the data ask for them, by an information criterion: a bend of the
magnetisation curve about the bias, the back-EMF of a rotor that follows the injection, and inductances that differ
between the injection frequencies; the sensor lag is dropped by the same criterion. L is the average over the models
tried, with their information weights; the spread between them is part of its variance.

Everything slower than a quarter of the injection frequency is projected out of data and model alike: a swinging rotor,
the loop that holds the bias and heating live there, and none of it carries information on L.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pmsmtool.estimators.estimate import information_weights, scaled_covariance
from pmsmtool.estimators.least_squares import RELATIVE_STEP, Fit, levenberg_marquardt
from pmsmtool.estimators.output_error import AxisModel, bend, recursion, respond
from pmsmtool.estimators.refusals import refuse

Vector = NDArray[np.float64]

SKIP_SAMPLES = 10
"""First samples that are simulated but not compared: the voltage before the record and the sensor's start."""
SLOW_FRACTION = 4.0
"""Injection frequency over the highest frequency that is projected out."""
PASSES = 2
"""Passes of the small non-linear terms; each shrinks what is left by R T/L, the bend or K (h T_s)^2/L."""
LAG_CENTRE = 0.1
"""Centre of the prior of the sensor time constant (T_s)."""
LAG_PRIOR_STD = 1.5
"""Prior standard deviation of ln(lag/T_s): 0.005 to 2 T_s in 95 %; keeps the fit where lag and delay are one."""
R_PRIOR_STD = 0.5
"""Prior of the effective resistance at the injection, relative to the loop resistance (eddy currents raise it)."""
BEND_PRIOR_STD = 3.0
"""Prior of the bend: relative change of L over one rms ripple, in tenths."""
LARGEST_LOG_L, LARGEST_LOG_LAG = 3.0, 10.0
SMALLEST_DECAY, LARGEST_DECAY = -0.3, 5.0
"""Region of the fit: L relative to its first guess, lag relative to T_s, and R T_s/L."""
BEND_LIMIT = 10.0
"""Bend at which L would change by its own size over one rms ripple."""
MOTION_PRIOR_STD = 10.0
"""Prior of the motional term, in hundredths of L over the square of a half period."""
RATIO_PRIOR_STD = 0.3
"""Prior of the relative difference of L and R between injection frequencies."""
DISPERSION_SHARE = 0.5
"""Standard deviation of L, of its difference between the injection frequencies where the fit found one."""
DELAY_STARTS = (0.05, 0.45, 0.95, 1.45, 1.95)
LAG_STARTS = ((0.02, 0.1), (0.4, 0.8))
"""Delays and lags tried before the fit (T_s); one fit begins at the best of each group of lags."""
ITERATIONS = 30
STEP_TOLERANCE = 1e-7
"""Relative size of the last step."""
COST_TOLERANCE = 1e-4
"""Fall of the whitened cost below which a fit is done: a hundredth of a standard deviation."""
PENALTY = 3.0
"""Price of a parameter in the information criterion (AIC 2; BIC about 8, which drops a lag that still biases L)."""
NEGLIGIBLE_WEIGHT = 1e-6
"""Information weight below which a model does not count."""
UNPHYSICAL = 1e9
"""Residual outside the region where the model is defined."""


@dataclass(frozen=True, slots=True)
class VoltageError:
    """Inverter error along the axis at the bias: e(i), increasing grid of currents."""

    i_a: Vector
    u_v: Vector

    def at(self, i_a: Vector) -> Vector:
        """Error at given currents, linear between the points (V)."""
        return np.asarray(np.interp(i_a, self.i_a, self.u_v), dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Shot:
    """One record of a square wave on one axis, frozen frame.

    Attributes
    ----------
    u_v, i_a : ndarray, shape (n,)
        Voltage computed and current sampled at each instant.
    cross_a : ndarray, shape (n,)
        Current of the other axis.
    half_period : int
        Samples between sign changes.
    period_s : float
        Control period (s).
    error : VoltageError or None
        Inverter error from the DC levels.
    """

    u_v: Vector
    i_a: Vector
    cross_a: Vector
    half_period: int
    period_s: float
    error: VoltageError | None = None

    def slow_basis(self) -> NDArray[np.float64]:
        """Orthonormal cosines slower than the injection, shape (n - SKIP_SAMPLES, j)."""
        n = len(self.i_a) - SKIP_SAMPLES
        count = max(1, round(n / (self.half_period * SLOW_FRACTION)))
        k = np.arange(n) + 0.5
        basis = np.cos(np.pi * np.outer(k, np.arange(count)) / n)
        return np.asarray(basis / np.sqrt(np.sum(basis**2, axis=0)))


@dataclass(frozen=True, slots=True)
class Effects:
    """Which optional effects a fit has."""

    lag: bool = True
    bend: bool = False
    motion: bool = False
    dispersion: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects in use."""
        return tuple(name for name in ("lag", "bend", "motion", "dispersion") if getattr(self, name))


@dataclass(frozen=True, slots=True)
class AxisFit:
    """Result of one axis.

    Attributes
    ----------
    L_h, std_h : float
        Incremental inductance along the axis at the shortest half period, standard deviation before gates (H).
    bound_h : float
        Cramer-Rao bound of the best model (H).
    L_by_shot_h : tuple of float
        Inductance of each shot; all equal unless the data show a difference (H).
    R_ohm : float
        Effective resistance at the injection (ohm).
    delay : float
        Sample to acting voltage (T_s).
    lag_s : float
        Sensor time constant, 0 where the data do not ask for one (s); far below T_s only delay + lag/T_s is known.
    motion_per_f : float
        Back-EMF per charge of the moving rotor, 1.5 p^2 psi^2/J (1/F).
    bend_2_per_a, bend_3_per_a2 : float
        Curvature of current over flux about the bias.
    chi2 : float
        Reduced chi-square of the best model.
    residuals : tuple of ndarray
        Whitened residual of the best model, per shot.
    effects : tuple of str
        Effects of the best model.
    condition : float
        Condition number of its scaled Jacobian.
    """

    L_h: float
    std_h: float
    bound_h: float
    L_by_shot_h: tuple[float, ...]
    R_ohm: float
    delay: float
    lag_s: float
    motion_per_f: float
    bend_2_per_a: float
    bend_3_per_a2: float
    chi2: float
    n: int
    residuals: tuple[Vector, ...]
    effects: tuple[str, ...]
    condition: float


@dataclass(frozen=True, slots=True)
class Response:
    """Everything one shot is simulated with."""

    model: AxisModel
    start_a: float
    c_2: float
    c_3: float
    motion: float


@dataclass(frozen=True, slots=True)
class Layout:
    """Where each parameter sits in the vector, and its typical size."""

    shots: int
    effects: Effects
    L_scale: float
    R_scale: float
    period_s: float
    ripple_a: float
    motion_scale: float

    def blocks(self) -> Iterator[tuple[str, int]]:
        """Names and lengths of the parts of the vector."""
        yield "main", 3
        if self.effects.lag:
            yield "lag", 1
        if self.effects.bend:
            yield "bend", 2
        if self.effects.motion:
            yield "motion", 1
        if self.effects.dispersion:
            yield "dispersion", 2 * (self.shots - 1)
        yield "start", self.shots

    def split(self, x: Vector) -> dict[str, list[float]]:
        """The parts of the vector by name."""
        parts, first = {}, 0
        for name, length in self.blocks():
            parts[name] = [float(value) for value in x[first : first + length]]
            first += length
        return parts

    def responses(self, x: Vector) -> list[Response]:
        """Parameters of every shot."""
        parts = self.split(x)
        log_L, R, delay = parts["main"]
        lag = math.exp(parts["lag"][0]) * self.period_s if self.effects.lag else 0.0
        b_2, b_3 = parts.get("bend", [0.0, 0.0])
        motion = parts.get("motion", [0.0])[0] * self.motion_scale
        ratios = [0.0, 0.0, *parts.get("dispersion", [0.0] * (2 * (self.shots - 1)))]
        return [
            Response(
                model=AxisModel(
                    self.L_scale * math.exp(log_L + ratios[2 * k]),
                    R * self.R_scale * (1.0 + ratios[2 * k + 1]),
                    delay,
                    lag,
                ),
                start_a=parts["start"][k] * self.ripple_a,
                c_2=0.1 * b_2 / self.ripple_a,
                c_3=0.1 * b_3 / self.ripple_a**2,
                motion=motion,
            )
            for k in range(self.shots)
        ]

    def prior(self, x: Vector) -> Vector:
        """Residuals of the weak priors that keep an undetermined effect from running away."""
        parts = self.split(x)
        rows = [(parts["main"][1] - 1.0) / R_PRIOR_STD]
        rows += [(value - math.log(LAG_CENTRE)) / LAG_PRIOR_STD for value in parts.get("lag", [])]
        rows += [value / BEND_PRIOR_STD for value in parts.get("bend", [])]
        rows += [value / MOTION_PRIOR_STD for value in parts.get("motion", [])]
        rows += [value / RATIO_PRIOR_STD for value in parts.get("dispersion", [])]
        return np.array(rows)

    def changed(self, x: Vector, effects: Effects) -> tuple[Layout, Vector]:
        """The layout with more effects, or without the lag, and its starting vector."""
        richer = replace(self, effects=effects)
        parts = self.split(x)
        if self.effects.lag and not effects.lag:
            # the pure delay takes over what the lag was, as far as the record allows
            parts["main"][2] = min(parts["main"][2] + math.exp(parts["lag"][0]), SKIP_SAMPLES - 3.5)
        start = {"bend": [0.0, 0.0], "motion": [0.0], "dispersion": [0.0] * (2 * (self.shots - 1))}
        values = [value for name, _ in richer.blocks() for value in parts.get(name, start.get(name, []))]
        return richer, np.array(values)

    def defined(self, x: Vector) -> bool:
        """Whether the model can be evaluated at x."""
        parts = self.split(x)
        (log_L, _, delay), log_lag = parts["main"], parts.get("lag", [0.0])[0]
        sizes = [log_L, *(log_L + ratio for ratio in parts.get("dispersion", [0.0])[::2])]
        bent = max(abs(value) for value in parts.get("bend", [0.0]))
        if max(map(abs, sizes)) > LARGEST_LOG_L or abs(log_lag) > LARGEST_LOG_LAG or bent > BEND_LIMIT:
            return False
        decays = [r.model.R_ohm * self.period_s / r.model.L_h for r in self.responses(x)]
        return 0.0 <= delay <= SKIP_SAMPLES - 3 and min(decays) > SMALLEST_DECAY and max(decays) < LARGEST_DECAY


def simulate(response: Response, shot: Shot, slow: NDArray[np.float64]) -> Vector:
    """Modelled current of a shot at the compared samples, without its mean (A), shape (n - SKIP_SAMPLES,)."""
    model, T_s = response.model, shot.period_s
    count = len(shot.i_a) - SKIP_SAMPLES
    linear = respond(model, shot.u_v - np.mean(shot.u_v), T_s, response.start_a)
    centre_a = float(np.mean(shot.i_a))
    curved = response.c_2 != 0.0 or response.c_3 != 0.0
    if not curved and response.motion == 0.0 and shot.error is None:
        return linear[-count - 1 : -1]
    rate = model.R_ohm * T_s / model.L_h
    pole = math.exp(-rate)
    gain = T_s / model.L_h * (-math.expm1(-rate) / rate if abs(rate) > 1e-9 else 1.0)
    i = y = linear
    for _ in range(PASSES):
        i = bend(y, float(np.mean(y[-count:])), response.c_2, response.c_3)
        lost = model.R_ohm * (i - y)  # the bent part of the current drops R i too
        if shot.error is not None:
            lost = lost + shot.error.at(i - float(np.mean(i[-count:])) + centre_a)
        if response.motion != 0.0:
            lost = lost + response.motion * _fast_charge(i, slow, T_s)
        middle = 0.5 * (lost[1:] + lost[:-1])
        y = linear + recursion(pole, -gain * (middle - np.mean(middle)), 0.0)
    i = bend(y, float(np.mean(y[-count:])), response.c_2, response.c_3)
    # sample n - 1 of the record is the last but one of the response
    return i[-count - 1 : -1]


def _fast_charge(i: Vector, slow: NDArray[np.float64], T_s: float) -> Vector:
    """Integral of the fast part of a current (A s)."""
    rows = slow.shape[0]
    fast = i - np.mean(i[-rows:])
    fast[-rows:] -= slow @ (slow.T @ fast[-rows:])
    charge = np.concatenate([[0.0], np.cumsum(0.5 * (fast[1:] + fast[:-1]))]) * T_s
    charge[-rows:] -= slow @ (slow.T @ charge[-rows:])
    return charge


@dataclass(frozen=True, slots=True)
class _Problem:
    """Shots with their projections; callable as the whitened residual of a parameter vector."""

    shots: Sequence[Shot]
    slow: Sequence[NDArray[np.float64]]
    sigma_a: float
    layout: Layout

    @property
    def rows(self) -> int:
        return sum(len(shot.i_a) - SKIP_SAMPLES for shot in self.shots)

    def per_shot(self, x: Vector) -> list[Vector]:
        out = []
        for shot, slow, response in zip(self.shots, self.slow, self.layout.responses(x), strict=True):
            r = (simulate(response, shot, slow) - shot.i_a[SKIP_SAMPLES:]) / self.sigma_a
            out.append(r - slow @ (slow.T @ r))
        return out

    def __call__(self, x: Vector) -> Vector:
        prior = self.layout.prior(x)
        if not self.layout.defined(x):
            return np.full(self.rows + len(prior), UNPHYSICAL)
        return np.concatenate([*self.per_shot(x), prior])

    def derivative(self, x: Vector) -> NDArray[np.float64]:
        """Jacobian: differences for what all shots share, the decay of a starting current in closed form.

        One-sided: a step of 1e-5 leaves 1e-5 of a column, and central ones would double the time of a fit.
        """
        shared = len(x) - self.layout.shots
        here = self(x)
        sides = []
        for k in range(shared):
            aside = x.copy()
            aside[k] += RELATIVE_STEP
            sides.append((self(aside) - here) / (aside[k] - x[k]))
        columns = [np.stack(sides, axis=1)]
        first = 0
        for shot, slow, response in zip(self.shots, self.slow, self.layout.responses(x), strict=True):
            decay = respond(response.model, np.zeros(len(shot.u_v)), shot.period_s, 1.0)[-len(slow) - 1 : -1]
            column = np.zeros((len(columns[0]), 1))
            scale = self.layout.ripple_a / self.sigma_a
            column[first : first + len(slow), 0] = scale * (decay - slow @ (slow.T @ decay))
            columns.append(column)
            first += len(slow)
        return np.concatenate(columns, axis=1)

    def fit(self, x: Vector) -> Fit:
        with np.errstate(over="ignore", invalid="ignore"):  # a step that runs away has no finite cost and is refused
            return levenberg_marquardt(
                self,
                x,
                np.ones(len(x)),
                iterations=ITERATIONS,
                tolerance=STEP_TOLERANCE,
                cost_tolerance=COST_TOLERANCE,
                derivative=self.derivative,
            )


def initial_inductance(shot: Shot) -> float:
    """Inductance from the ripple: voltage times the half period over the swing (H); a starting value only."""
    u = shot.u_v - np.mean(shot.u_v)
    window = 2 * shot.half_period
    i = shot.i_a
    swings = [np.ptp(i[k : k + window]) for k in range(SKIP_SAMPLES, len(i) - window, window)]
    swing = float(np.median(swings)) if swings else 0.0
    if not swing > 0.0:
        raise refuse("E_EXCITATION", "the current does not follow the square wave at all", stage="inductance")
    return float(np.mean(np.abs(u))) * shot.half_period * shot.period_s / swing


def arx_guess(shot: Shot, delay: int) -> tuple[float, float, float]:
    """Least squares of i[k+1] on (i[k], v[k - delay], 1): L (H), R (ohm) and residual power; a starting value only.

    Noise on i attenuates it (1.1 to 8 times the bound, -1.8 % bias): never a result.
    """
    i, v = shot.i_a[SKIP_SAMPLES:], shot.u_v[SKIP_SAMPLES - delay : len(shot.u_v) - delay]
    columns = np.stack([i[:-1], v[:-1], np.ones(len(i) - 1)], axis=1)
    x, *_ = np.linalg.lstsq(columns, i[1:], rcond=None)
    residual = i[1:] - columns @ x
    a, b = float(x[0]), float(x[1])
    power = float(residual @ residual)
    if not 0.0 < a < 1.0 or not b > 0.0:
        return initial_inductance(shot), 0.0, power
    R = (1.0 - a) / b
    return -R * shot.period_s / math.log(a), R, power


def fit_axis(shots: Sequence[Shot], sigma_a: float, R_guess: float, *, allow_motion: bool) -> AxisFit:
    """Fit one axis jointly over its shots.

    Parameters
    ----------
    shots : sequence of Shot
        At least one, the shortest half period first; two half periods separate delay and motion from L.
    sigma_a : float
        Noise of one current sample (A).
    R_guess : float
        Loop resistance (ohm), a starting value.
    allow_motion : bool
        Whether the axis makes torque, so that the rotor may follow the injection.

    Raises
    ------
    IdentificationError
        ``E_EXCITATION`` when the current does not follow, ``E_NOT_CONVERGED``.
    """
    slow = [shot.slow_basis() for shot in shots]
    ripple = max(float(np.std(shot.i_a[SKIP_SAMPLES:])) for shot in shots)
    L_0 = min((arx_guess(shots[0], delay) for delay in (0, 1, 2)), key=lambda guess: guess[2])[0]
    T_s = shots[0].period_s
    motion_scale = 0.01 * L_0 / (shots[0].half_period * T_s) ** 2
    base = Layout(len(shots), Effects(), L_0, R_guess, T_s, ripple, motion_scale)
    problem = _Problem(shots, slow, sigma_a, base)
    firsts = []
    # a long lag and a longer delay are two valleys: begin in each, on a first guess of L either may look better
    for lags in LAG_STARTS:
        starts = [
            np.array([0.0, 1.0, delay, math.log(lag), *([0.0] * len(shots))]) for delay in DELAY_STARTS for lag in lags
        ]
        firsts.append(problem.fit(min(starts, key=lambda x: float(np.sum(problem(x) ** 2)))))
    tried: dict[Effects, tuple[Fit, Layout]] = {Effects(): (min(firsts, key=lambda fit: fit.cost), base)}
    wanted = ["bend"]
    if allow_motion:
        wanted.append("motion")
    if len(shots) > 1:
        wanted.append("dispersion")
    current = Effects()
    while True:
        fit, layout = tried[current]
        for name in wanted:
            richer = replace(current, **{name: True})
            if richer not in tried:
                new_layout, start = layout.changed(fit.x, richer)
                tried[richer] = (_Problem(shots, slow, sigma_a, new_layout).fit(start), new_layout)
        best = min(tried, key=lambda effects: _criterion(effects, tried[effects][0]))
        if not set(best.names) > set(current.names):
            break
        current = best
    fit, layout = tried[current]
    without_lag, start = layout.changed(fit.x, replace(current, lag=False))
    tried[without_lag.effects] = (_Problem(shots, slow, sigma_a, without_lag).fit(start), without_lag)
    return _average(shots, slow, sigma_a, tried)


def _criterion(effects: Effects, fit: Fit) -> float:
    """Information criterion; a rotor that follows is free of charge: it is there, whether it can be seen or not."""
    return fit.cost + PENALTY * (len(fit.x) - effects.motion)


def _average(
    shots: Sequence[Shot],
    slow: Sequence[NDArray[np.float64]],
    sigma_a: float,
    tried: dict[Effects, tuple[Fit, Layout]],
) -> AxisFit:
    rows = [(effects, fit, layout, scaled_covariance(fit.jacobian)[0]) for effects, (fit, layout) in tried.items()]
    rows = [row for row in rows if np.isfinite(row[3][0, 0]) and row[1].cost < UNPHYSICAL]
    rows = [row for row in rows if row[2].responses(row[1].x)[0].motion >= 0.0]  # a rotor cannot push back
    if not rows:
        raise refuse("E_NOT_CONVERGED", "no model of the axis could be fitted", stage="inductance")
    weights = information_weights([_criterion(effects, fit) for effects, fit, _, _ in rows])
    L = float(sum(w * row[2].L_scale * math.exp(row[1].x[0]) for w, row in zip(weights, rows, strict=True)))
    variance = 0.0
    for w, (_, fit, layout, covariance) in zip(weights, rows, strict=True):
        if w > NEGLIGIBLE_WEIGHT:
            L_m = layout.L_scale * math.exp(float(fit.x[0]))
            sizes = [response.model.L_h for response in layout.responses(fit.x)]
            # an inductance that depends on the frequency is not known better than by half that difference
            spread = DISPERSION_SHARE * (max(sizes) - min(sizes))
            variance += float(w) * (L_m**2 * float(covariance[0, 0]) + (L_m - L) ** 2 + spread**2)
    effects, fit, layout, _ = rows[int(np.argmax(weights))]
    covariance, condition = scaled_covariance(fit.jacobian)
    responses = layout.responses(fit.x)
    problem = _Problem(shots, slow, sigma_a, layout)
    residuals = tuple(problem.per_shot(fit.x))
    dof = problem.rows - sum(basis.shape[1] for basis in slow) - len(fit.x)
    first = responses[0]
    return AxisFit(
        L_h=L,
        std_h=math.sqrt(variance),
        bound_h=first.model.L_h * math.sqrt(float(covariance[0, 0])),
        L_by_shot_h=tuple(response.model.L_h for response in responses),
        R_ohm=first.model.R_ohm,
        delay=first.model.delay,
        lag_s=first.model.lag_s,
        motion_per_f=first.motion,
        bend_2_per_a=first.c_2,
        bend_3_per_a2=first.c_3,
        chi2=float(sum(r @ r for r in residuals)) / dof,
        n=problem.rows,
        residuals=residuals,
        effects=effects.names,
        condition=condition,
    )
