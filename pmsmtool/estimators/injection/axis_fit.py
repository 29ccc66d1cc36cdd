# SPDX-License-Identifier: MIT
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
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.estimators.estimate import CHI2_WARN, information_weights, scaled_covariance
from pmsmtool.estimators.injection.axis_layout import Effects, Layout, Motion, Timing
from pmsmtool.estimators.injection.axis_response import SKIP_SAMPLES, Shot, arx_guess, projected, simulate
from pmsmtool.estimators.injection.output_error import respond
from pmsmtool.estimators.injection.sampling_instant import ShownInstant
from pmsmtool.estimators.least_squares import RELATIVE_STEP, Fit, levenberg_marquardt
from pmsmtool.refusals import refuse

DISPERSION_SHARE = 0.5
"""Standard deviation of L, of its difference between the injection frequencies where the fit found one."""
DELAY_STARTS = (0.05, 0.45, 0.95, 1.45, 1.95)
LAG_STARTS = ((0.02, 0.1), (0.4, 0.8))
"""Delays and lags tried before the fit (T_s); one fit begins at the best of each group of lags."""
EDDY_STARTS, TAU_STARTS = (0.05, 0.3, 1.2), (0.05, 1.0)
"""Eddy currents (of T_s/L) from each of which a fit begins, and time constants (T_s) tried before it."""
ITERATIONS, FIRST_ITERATIONS = 30, 8
"""Steps of a fit, and of those beside which only the best is carried on."""
STEP_TOLERANCE = 1e-7
"""Relative size of the last step."""
COST_TOLERANCE = 1e-4
"""Fall of the whitened cost below which a fit is done: a hundredth of a standard deviation."""
PENALTY, DISPERSION_PENALTY = 7.0, 4.0
"""Prices of a parameter in the information criterion (AIC 2; BIC about 8).

A dispersion that is there and left out biases L by more than a bend or a lag (on a measured map, 0.2 %): it costs less.
"""
NEGLIGIBLE_WEIGHT = 1e-6
"""Information weight below which a model does not count."""
DECIDED = -2.0 * math.log(NEGLIGIBLE_WEIGHT)
"""Difference of information criteria that makes such a weight."""
LEAST_R = 0.8
"""Resistance beside eddy currents, of the loop's, below which they stand for something else: with 0.2 to 0.7 of it, and
time constants of 13 periods, the ripple of a link put L 13 to 40 % off."""
MOST_FALL = 0.15
"""Part of L that eddy currents hide at the lowest injection frequency, above which they stand for something else: iron
loss of 3 to 8 % hid 2 to 5 %; 26 % stood for a phase current within the inverter's knee, and L_q 49 % off."""
MOST_R = 1.25
"""Resistance, of the loop's or of a model with eddy currents that fits, above which a model without them stands for
them: with 1.4 to 3.6 of it, and an L that falls with the frequency, branches of 3 to 7 % put L 2.6 to 5.5 % off."""
UNPHYSICAL = 1e9
"""Residual outside the region where the model is defined."""


@dataclass(frozen=True, slots=True)
class AxisFit:
    """Result of one axis."""

    L_h: float
    std_h: float
    """Incremental inductance along the axis at the shortest half period, standard deviation before gates (H)."""
    bound_h: float
    """Cramer-Rao bound of the best model (H)."""
    L_by_shot_h: tuple[float, ...]
    """Inductance of each shot; all equal unless the data show a difference (H)."""
    R_ohm: float
    """Effective resistance at the injection (ohm)."""
    delay: float
    """Sample to acting voltage (T_s)."""
    lag_s: float
    """Sensor time constant, 0 where the data do not ask for one (s); far below T_s only delay + lag/T_s is known."""
    motion_per_f: float
    """Back-EMF per charge of the moving rotor, 1.5 p^2 psi^2/J (1/F)."""
    chi2: float
    """Reduced chi-square of the best model."""
    n: int
    """Samples that the fit counts."""
    residuals: tuple[Array, ...]
    """Whitened residual of the best model, per shot."""
    effects: tuple[str, ...]
    """Effects of the best model."""
    condition: float
    """Condition number of its scaled Jacobian."""
    timing: Timing
    """What the axis says about delay and lag, for the other one."""
    places: tuple[tuple[float, float, float], ...] = ()
    """Information weight, delay (T_s) and lag (s) of every model that counts."""
    eddy_s: float = 0.0
    eddy_tau_s: float = 1.0
    """Eddy currents of the best model, per voltage and 1/L (s), and their time constant; 0 where it has none."""
    bend_per_a: float = 0.0
    """Relative change of the incremental inductance per current of the axis at the bias, by the best model (1/A)."""


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

    def per_shot(self, x: Array) -> list[Array]:
        out = []
        for shot, slow, response in zip(self.shots, self.slow, self.layout.responses(x), strict=True):
            r = (simulate([response], shot, slow)[0] - shot.i_a[SKIP_SAMPLES:]) / self.sigma_a
            out.append(projected(r, slow))
        return out

    def __call__(self, x: Array) -> Array:
        prior = self.layout.prior(x)
        if not self.layout.defined(x):
            return np.full(self.rows + len(prior), UNPHYSICAL)
        return np.concatenate([*self.per_shot(x), prior])

    def derivative(self, x: Array) -> NDArray[np.float64]:
        """Jacobian: differences for what shots share, the decay of a starting current in closed form.

        One-sided: a step of 1e-5 leaves 1e-5 of a column, and central ones would double the time of a fit. All columns
        of a shot are simulated at once, and only those that change it.
        """
        shared = len(x) - self.layout.shots
        steps = np.full(shared, RELATIVE_STEP)
        if math.floor(x[2] + steps[2]) != math.floor(x[2]):
            steps[2] = -steps[2]  # a whole delay changes the first sample that is modelled
        asides = x + np.eye(shared, len(x)) * steps[:, None]
        here, prior = self.layout.responses(x), self.layout.prior(x)
        moved = [self.layout.responses(aside) for aside in asides]
        out = np.zeros((self.rows + len(prior), len(x)))
        for k, aside in enumerate(asides):
            out[self.rows :, k] = (self.layout.prior(aside) - prior) / steps[k]
        first = 0
        for index, (shot, slow) in enumerate(zip(self.shots, self.slow, strict=True)):
            changed = [k for k in range(shared) if moved[k][index] != here[index]]
            at, *others = simulate([here[index], *(moved[k][index] for k in changed)], shot, slow)
            rest, one = np.zeros(len(shot.u_v)), np.ones(1)
            (decay,) = respond([here[index].model], rest, shot.period_s, one)[:, -len(slow) - 1 : -1]
            columns = [
                *((other - at) / steps[k] for k, other in zip(changed, others, strict=True)),
                self.layout.ripple_a * decay,
            ]
            rows = slice(first, first + len(slow))
            out[rows, [*changed, shared + index]] = projected(np.stack(columns) / self.sigma_a, slow).T
            first += len(slow)
        return out

    def fit(self, x: Array, iterations: int = ITERATIONS) -> Fit:
        size, stop = np.ones(len(x)), {"tolerance": STEP_TOLERANCE, "cost_tolerance": COST_TOLERANCE}
        return levenberg_marquardt(self, x, size, iterations=iterations, derivative=self.derivative, **stop)


def fit_axis(
    shots: Sequence[Shot],
    sigma_a: float,
    R_guess: float,
    *,
    torque: bool,
    motion: Motion | None = None,
    other: AxisFit | None = None,
    instant: ShownInstant | None = None,
) -> AxisFit:
    """Fit one axis jointly over its shots.

    Raises IdentificationError: ``E_EXCITATION`` when the current does not follow, ``E_NOT_CONVERGED``.

    Parameters
    ----------
    shots : sequence of Shot
        At least one, the shortest half period first; two half periods separate delay and motion from L.
    sigma_a : float
        Noise of one current sample (A).
    R_guess : float
        Loop resistance (ohm), a starting value.
    torque : bool
        Whether it is the axis that makes torque: the rotor may follow the injection, and there is no bias on it.
    motion : Motion or None
        What other experiments say of it; then it is in every model.
    other : AxisFit or None
        The other axis, fitted before. Delay and lag belong to the drive, and a rotor that follows looks like them; a
        machine that bends on its d axis saturates on q as well, however little of it the noise leaves to see: what
        the bend gains there counts here.
    instant : ShownInstant or None
        What a turning machine shows of delay and lag.
    """
    slow = [shot.slow_basis() for shot in shots]
    ripple = max(float(np.std(shot.i_a[SKIP_SAMPLES:])) for shot in shots)
    L_0 = min((arx_guess(shots[0], delay) for delay in (0, 1, 2)), key=lambda guess: guess[2])[0]
    T_s = shots[0].period_s
    motion_scale = 0.01 * L_0 / (shots[0].half_period * T_s) ** 2
    timing = None if other is None else other.timing
    base = Layout(len(shots), Effects(), L_0, R_guess, T_s, ripple, motion_scale, timing, motion, torque, instant)
    problem = _Problem(shots, slow, sigma_a, base)
    # a long lag and a longer delay are two valleys: begin in each, on a first guess of L either may look better
    valleys = [[(delay, math.log(lag)) for delay in DELAY_STARTS for lag in lags] for lags in LAG_STARTS]
    if timing is not None:  # both axes lie in the same one
        valleys = [[(max(0.0, timing.total - math.exp(timing.log_lag)), timing.log_lag)]]
    firsts = []
    for valley in valleys:
        starts = [np.array([0.0, 1.0, *place, *([0.0] * len(shots))]) for place in valley]
        firsts.append(problem.fit(min(starts, key=lambda x: float(np.sum(problem(x) ** 2)))))
    first = min(firsts, key=lambda fit: fit.cost)
    # what is there, whether this axis can show it or not
    current = Effects(
        bend=timing is not None and timing.bend_gain > DECIDED,
        motion=torque and motion is not None,
    )
    optional = {"bend": not current.bend, "motion": torque and motion is None, "dispersion": len(shots) > 1}
    wanted = [name for name, open_to_data in optional.items() if open_to_data]
    layout, start = base.changed(first.x, current)
    tried = {current: (first if current == Effects() else _Problem(shots, slow, sigma_a, layout).fit(start), layout)}
    while True:
        fit, layout = tried[current]
        for name in wanted:
            richer = replace(current, **{name: True})
            if richer not in tried:
                new_layout, start = layout.changed(fit.x, richer)
                tried[richer] = (_Problem(shots, slow, sigma_a, new_layout).fit(start), new_layout)
        best = min(tried, key=lambda effects: _criterion(*tried[effects], timing))
        if not set(best.names) > set(current.names):
            break
        current = best
    fit = tried[current][0]
    if current.dispersion or fit.cost > CHI2_WARN * fit.dof:
        # what makes L fall with the frequency, or a residual in step with it
        for bend in {current.bend, optional["bend"] and current.bend, not optional["bend"]}:
            new_layout, start = base.changed(first.x, Effects(bend=bend, motion=current.motion, eddy=True))
            branch = _Problem(shots, slow, sigma_a, new_layout)
            fits = []
            for eddy in EDDY_STARTS:
                places = [new_layout.with_eddy(start, eddy, tau, delay) for tau in TAU_STARTS for delay in (None, 1.0)]
                costs = [float(np.sum(branch(x) ** 2)) for x in places]
                fits.append(branch.fit(places[costs.index(min(costs))], FIRST_ITERATIONS))
            nearest = min(fits, key=lambda found: found.cost)
            tried[new_layout.effects] = (nearest if nearest.converged else branch.fit(nearest.x), new_layout)
    criteria = {effects: _criterion(*found, timing) for effects, found in tried.items()}
    # each without its lag, not the best alone: with one choice made before it, the average over models was none
    for effects in [e for e, criterion in criteria.items() if criterion - min(criteria.values()) < DECIDED]:
        fit, layout = tried[effects]
        without_lag, start = layout.changed(fit.x, replace(effects, lag=False))
        tried[without_lag.effects] = (_Problem(shots, slow, sigma_a, without_lag).fit(start), without_lag)
    return _average(shots, slow, sigma_a, tried, timing)


def _criterion(fit: Fit, layout: Layout, timing: Timing | None) -> float:
    """Information criterion; a rotor that follows is free of charge: it is there, whether it can be seen or not.

    With the timing of another axis it is the criterion of both together, which share the lag; and a machine that the
    other axis shows to saturate does so on this one.
    """
    effects, lengths = layout.effects, dict(layout.blocks())
    cheap = lengths.get("dispersion", 0)
    own = fit.cost + PENALTY * (len(fit.x) - effects.motion - cheap) + DISPERSION_PENALTY * cheap
    if timing is None:
        return own
    return own - PENALTY * effects.lag + timing.criterion(effects.lag) + (0.0 if effects.bend else timing.bend_gain)


def _timing(tried: dict[Effects, tuple[Fit, Layout]]) -> Timing:
    """Delay and lag of the best models with and without lag."""
    best: dict[bool, tuple[float, Array, NDArray[np.float64]]] = {}
    for effects, (fit, layout) in tried.items():
        criterion = _criterion(fit, layout, None)
        if effects.lag not in best or criterion < best[effects.lag][0]:
            best[effects.lag] = criterion, fit.x, scaled_covariance(fit.jacobian)[0]
    (with_lag, x, covariance), (without, x_0, covariance_0) = best[True], best[False]
    straight, bent = (
        min((_criterion(*found, None) for effects, found in tried.items() if effects.bend == bend), default=math.inf)
        for bend in (False, True)
    )
    slope = np.array([1.0, math.exp(float(x[3]))])
    return Timing(
        total=float(x[2] + slope[1]),
        total_std=math.sqrt(float(slope @ covariance[2:4, 2:4] @ slope)),
        log_lag=float(x[3]),
        log_lag_std=math.sqrt(float(covariance[3, 3])),
        delay=float(x_0[2]),
        delay_std=math.sqrt(float(covariance_0[2, 2])),
        lag_criterion=with_lag,
        plain_criterion=without,
        bend_gain=max(0.0, straight - bent),
    )


def most_resistance(rows: Sequence[tuple[Effects, Fit, Layout, Array]]) -> float:
    """Return the resistance, of the loop's, of a model without eddy currents from which on it stands for them."""
    fitting = [float(fit.x[1]) for effects, fit, *_ in rows if effects.eddy and fit.cost < CHI2_WARN * fit.dof]
    return MOST_R * max(1.0, min(fitting)) if fitting else math.inf


def _average(
    shots: Sequence[Shot],
    slow: Sequence[NDArray[np.float64]],
    sigma_a: float,
    tried: dict[Effects, tuple[Fit, Layout]],
    timing: Timing | None,
) -> AxisFit:
    rows = [(effects, fit, layout, scaled_covariance(fit.jacobian)[0]) for effects, (fit, layout) in tried.items()]
    rows = [row for row in rows if np.isfinite(row[3][0, 0]) and row[1].cost < UNPHYSICAL]
    # a rotor cannot push back: where the data alone decide, such a model fitted something else. A value that other
    # experiments put near zero scatters to both sides of it, and is in every model. Eddy currents drive nothing
    firsts = [(row, row[2].responses(row[1].x)[0]) for row in rows]
    firsts = [(row, at) for row, at in firsts if row[2].motion is not None or at.motion >= 0.0]
    seen_rad_s = math.pi / (shots[-1].half_period * shots[-1].period_s)
    rows = [row for row, at in firsts if at.model.eddy_s >= 0.0 and at.model.fall(seen_rad_s) < MOST_FALL]
    rows = [row for row in rows if not row[0].eddy or row[1].x[1] > LEAST_R]
    most_R = most_resistance(rows)
    rows = [row for row in rows if row[0].eddy or row[1].x[1] < most_R]
    if not rows:
        raise refuse("E_NOT_CONVERGED", "no model of the axis could be fitted", stage="inductance")
    weights = information_weights([_criterion(fit, layout, timing) for _, fit, layout, _ in rows])
    L_each = [layout.responses(fit.x)[0].model.flux_inductance_h for _, fit, layout, _ in rows]
    L = float(weights @ np.array(L_each))
    variance = 0.0
    for w, L_m, (_, fit, layout, covariance) in zip(weights, L_each, rows, strict=True):
        if w > NEGLIGIBLE_WEIGHT:
            sizes = [response.model.flux_inductance_h for response in layout.responses(fit.x)]
            # an inductance that depends on the frequency is not known better than by half that difference, by all of it
            # where it falls with the period: no eddy currents do that, but a rotor that friction does not let follow
            spread = (DISPERSION_SHARE if sizes[0] == min(sizes) else 1.0) * (max(sizes) - min(sizes))
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
        bound_h=first.model.flux_inductance_h * math.sqrt(float(covariance[0, 0])),
        L_by_shot_h=tuple(response.model.flux_inductance_h for response in responses),
        R_ohm=first.model.R_ohm,
        delay=first.model.delay,
        lag_s=first.model.lag_s,
        motion_per_f=first.motion,
        chi2=float(sum(r @ r for r in residuals)) / dof,
        n=problem.rows,
        residuals=residuals,
        effects=effects.names,
        condition=condition,
        timing=_timing(tried),
        places=tuple(
            (float(w), model.delay, model.lag_s)
            for w, (_, fit, layout, _) in zip(weights, rows, strict=True)
            if w > NEGLIGIBLE_WEIGHT
            for model in [layout.responses(fit.x)[0].model]
        ),
        eddy_s=first.model.eddy_s * first.model.flux_inductance_h / first.model.L_h,
        eddy_tau_s=first.model.eddy_tau_s,
        bend_per_a=-2.0 * first.c_2,
    )
