# SPDX-License-Identifier: MIT
"""R(T) and psi(T) followed during operation, by an unscented Kalman filter on means of voltage, current and speed.

The model is in ``tracking_model``. R and psi walk at random; size and tail of the inverter's error, the inductances and
the lag of the drive's speed are constants, known within their intervals, so that what they leave open stays in the
intervals of R and psi. The noise comes from the data (second differences), the walk is the likeliest of a few, and the
mean normalised innovation (NIS, 2 is ideal) must agree with both: above the gate the noise is inflated, and what would
need too much of that is refused. What the excitation cannot tell apart is refused by name.

References
----------
Julier, Uhlmann 2004, DOI 10.1109/JPROC.2003.823141; Bar-Shalom, Li, Kirubarajan 2001, section 5.4 (consistency).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.estimators.estimate import MEDIAN_TO_STD
from pmsmtool.estimators.tracking_model import (
    STATES,
    TRACKED,
    Known,
    inputs,
    model_slopes,
    model_voltage,
    ripple_v,
)
from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace

STAGE = "tracking"
WALK = {"R_s_ohm": 2e-3, "psi_f_wb": 3e-4}
"""Relative random walk in one second: half a kelvin of copper, a quarter of one of magnets."""
WALK_FACTORS = (1.0, 5.0, 25.0)
"""Factors on it, of which the likeliest is taken."""
LIMIT = {"R_s_ohm": 0.05, "psi_f_wb": 0.02}
"""Largest relative standard deviation of a tracked value; above it nothing was learned that is worth a number."""
NIS_GATE = (1.5, 2.6)
"""Mean normalised innovation squared of a consistent filter; two per observation is ideal."""
INFLATION_MAX = 2.0
"""Most that the noise's variance may be inflated: beyond, the model is wrong and not the noise."""
MINIMUM = 16
"""Observations for a noise estimate."""
SETTLED = 8
"""First observations that the mean innovation leaves out."""
FLOOR: Mapping[str, float] = {"R_s_ohm": 0.0, "psi_f_wb": 8e-4}
"""Relative standard deviation beside the filter's: psi_f by recordings was 0.053 to 0.093 % low on ten runs of the
default machine, whose noise is 0.035 %; what the ripple does to the inverter's error is not in the model."""
NOISE_FLOOR = 1e-4
"""Least noise of a mean voltage, of the largest: quantisation and slow errors of the drive."""
_ALPHA, _BETA, _KAPPA = 0.5, 2.0, 0.0


@dataclass(frozen=True, slots=True)
class Track:
    """What was followed."""

    t_s: Array
    """Instants of the observations. Shape (n,)."""
    value: Mapping[str, Array]
    std: Mapping[str, Array]
    """By name of ``tracking_model.TRACKED``; the standard deviation contains the inflation and :data:`FLOOR`.
    Shape (n,)."""
    nis: float
    """Mean normalised innovation squared, before an inflation."""
    inflation: float
    """Factor on the noise's variance; 1: none was needed."""
    noise_v: tuple[float, float]
    """Standard deviation of one observation of u_d and u_q (V), inflated."""
    restarts: int = 0
    """How often the filter lost its covariance and began again."""
    notes: tuple[str, ...] = field(default=())
    """What a reader should know."""


# ---- the filter -----------------------------------------------------------------------------------------------


class Tracker:
    """The filter, one observation at a time.

    Parameters
    ----------
    known : Known
        What is known before.
    noise_v : tuple of float
        Standard deviation of one observation of u_d and u_q (V).
    walk : float
        Factor on the random walk of :data:`WALK`.

    Attributes
    ----------
    log_likelihood : float
        Of all innovations so far.
    restarts : int
        How often the covariance was lost.
    """

    def __init__(self, known: Known, noise_v: tuple[float, float], walk: float = 1.0) -> None:
        from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

        self._known = known
        size = len(STATES)
        points = MerweScaledSigmaPoints(size, _ALPHA, _BETA, _KAPPA)
        self._filter: Any = UnscentedKalmanFilter(
            size, 2, 1.0, lambda x, given: model_voltage(x, given, known.scale), lambda x, dt: x, points
        )
        self._noise = np.diag(np.square(noise_v))
        self._walk = walk * np.array([WALK.get(name, 0.0) for name in STATES])
        self._last_s: float | None = None
        self.log_likelihood = 0.0
        self.restarts = 0
        self._restart()

    def _restart(self) -> None:
        self._filter.x = self._known.start
        self._filter.P = np.diag(self._known.start_std**2)

    def update(self, t_s: float, given: Array, u_v: Array, ripple: Array | None = None) -> float:
        """Take one observation; return its normalised innovation squared.

        Parameters
        ----------
        t_s : float
            Instant (s), not decreasing.
        given : ndarray, shape (10,)
            Row of the inputs.
        u_v : ndarray, shape (2,)
            Measured u_d, u_q (V).
        ripple : ndarray, shape (2,), optional
            Further deviation of both (V).
        """
        if not (np.all(np.isfinite(given)) and np.all(np.isfinite(u_v))):
            raise ValueError("an observation is not a number")  # filterpy would take it without a word
        step = 0.0 if self._last_s is None else max(t_s - self._last_s, 0.0)
        self._last_s = t_s
        try:
            self._filter.Q = np.diag(self._walk**2 * step)
            self._filter.predict()
            noise = self._noise if ripple is None else self._noise + np.diag(np.square(ripple))
            self._filter.update(u_v, R=noise, given=given)
        except np.linalg.LinAlgError:
            self.restarts += 1
            self._restart()
            return math.nan
        # P - K S K' loses symmetry and definiteness by rounding (filterpy issues 62 and 218)
        P = 0.5 * (self._filter.P + self._filter.P.T)
        self._filter.P = P + np.diag(np.maximum(1e-14 - np.diag(P), 0.0) + 1e-16)
        innovation = np.asarray(self._filter.y).reshape(2)
        nis = float(innovation @ np.linalg.solve(self._filter.S, innovation))
        self.log_likelihood -= 0.5 * (nis + math.log(float(np.linalg.det(self._filter.S))))
        return nis

    def state(self) -> tuple[Array, Array]:
        """Return values and standard deviations of ``tracking_model.STATES``."""
        scale = self._known.scale
        return self._filter.x * scale, np.sqrt(np.diag(self._filter.P)) * scale


def observation_noise(observations: Trace, known: Known) -> tuple[float, float]:
    """Standard deviation of one observation of u_d and u_q (V), from second differences against the start's model.

    Raises IdentificationError: ``E_EXCITATION``: too few observations.
    """
    if len(observations) < MINIMUM:
        raise refuse(
            "E_EXCITATION", f"{len(observations)} usable observations, {MINIMUM} are needed", stage=STAGE,
            likely="a short record, or a machine that was limited or off most of the time",
            hint="track for longer (--for), while the machine runs",
        )  # fmt: skip
    given = inputs(observations, known)
    model = np.array([model_voltage(known.start, row, known.scale) for row in given])
    measured = np.column_stack([observations["u_d_v"], observations["u_q_v"]])
    curvature = np.diff(measured - model, n=2, axis=0)
    largest = float(np.max(np.hypot(*measured.T)))
    spread = MEDIAN_TO_STD * np.median(np.abs(curvature), axis=0) / math.sqrt(6.0)
    return tuple(np.maximum(spread, NOISE_FLOOR * largest).tolist())


def track(observations: Trace, known: Known, wanted: Sequence[str] = TRACKED) -> Track:
    """Follow R and psi through observations.

    Raises IdentificationError: ``E_EXCITATION``, ``E_NOT_IDENTIFIABLE`` naming the pair, or ``E_MODEL_MISMATCH`` when
    the innovations stay inconsistent.

    Parameters
    ----------
    observations : Trace
        Signals of ``tracking_model.SIGNALS``, one row per window (``tracking_model.windows``).
    known : Known
        What is known before.
    wanted : sequence of str
        Out of ``tracking_model.TRACKED``: what must be identifiable.
    """
    noise = observation_noise(observations, known)
    given = inputs(observations, known)
    runs = [_consistent(observations, known, given, noise, walk) for walk in WALK_FACTORS]
    best = max(runs, key=lambda run: run.log_likelihood)
    _refuse_inconsistent(best)
    found, nis, inflation = best.track, best.first_nis, best.inflation
    notes = []
    if inflation > 1.0:
        notes.append(f"innovations {nis:.2g} instead of 2: the noise's variance is inflated by {inflation:.3g}")
    if best.walk > 1.0:
        notes.append(f"the values change {best.walk:g} times faster than temperatures usually do")
    if nis < NIS_GATE[0]:
        notes.append(f"innovations {nis:.2g} instead of 2: the intervals are wider than they need be")
    _refuse_entangled(found, given, known, found.noise_v, wanted)
    return replace(found, nis=nis, inflation=inflation, notes=tuple(notes))


@dataclass(frozen=True, slots=True)
class _Run:
    """One pass over the observations, its noise inflated until the innovations agree with it."""

    track: Track
    walk: float
    first_nis: float
    last_nis: float
    inflation: float
    log_likelihood: float


def _consistent(observations: Trace, known: Known, given: Array, noise: tuple[float, float], walk: float) -> _Run:
    found, nis, likelihood = _pass(observations, known, given, noise, walk)
    first, inflation = nis, 1.0
    while nis > NIS_GATE[1] and inflation <= INFLATION_MAX:  # by more than 1.3 each time: three times at most
        inflation *= 0.5 * nis
        wider = (math.sqrt(inflation) * noise[0], math.sqrt(inflation) * noise[1])
        found, nis, likelihood = _pass(observations, known, given, wider, walk)
    return _Run(found, walk, first, nis, inflation, likelihood)


def _pass(
    observations: Trace, known: Known, given: Array, noise: tuple[float, float], walk: float
) -> tuple[Track, float, float]:
    tracker = Tracker(known, noise, walk)
    measured = np.column_stack([observations["u_d_v"], observations["u_q_v"]])
    nis, states, stds = [], [], []
    for t, row, u, ripple in zip(observations.t_s, given, measured, ripple_v(observations, given), strict=True):
        nis.append(tracker.update(float(t), row, u, ripple))
        value, std = tracker.state()
        states.append(value)
        stds.append(std)
    x, s = np.array(states), np.array(stds)
    columns = {name: STATES.index(name) for name in TRACKED}
    found = Track(
        observations.t_s,
        {name: x[:, k] for name, k in columns.items()},
        {name: np.hypot(s[:, k], FLOOR[name] * np.abs(x[:, k])) for name, k in columns.items()},
        math.nan,
        1.0,
        noise,
        tracker.restarts,
    )
    return found, float(np.nanmean(nis[SETTLED:])), tracker.log_likelihood


def _refuse_inconsistent(run: _Run) -> None:
    if run.last_nis > NIS_GATE[1] or run.inflation > INFLATION_MAX:
        raise refuse(
            "E_MODEL_MISMATCH",
            f"mean normalised innovation {run.first_nis:.3g} instead of 2, still {run.last_nis:.3g} with the noise's "
            f"variance inflated by {run.inflation:.3g} (limit {INFLATION_MAX:g})",
            stage=STAGE,
            likely="another machine than the file's, a wrong inverter error, or saturation",
            hint="identify again, or give the machine file of this machine",
        )


def _refuse_entangled(
    found: Track, given: Array, known: Known, noise: tuple[float, float], wanted: Sequence[str]
) -> None:
    """Refuse a quantity that the data leave as open as it was, naming what it cannot be told from."""
    lost = [n for n in wanted if not found.std[n][-1] <= LIMIT[n] * abs(found.value[n][-1])]
    if not lost:
        return
    name = lost[0]
    relative = 100.0 * float(found.std[name][-1] / abs(found.value[name][-1]))
    information = np.diag(np.concatenate([[1e-9, 1e-9], 1.0 / known.start_std[2:] ** 2]))
    weight = np.diag(1.0 / np.square(noise))
    for row in given:
        slope = model_slopes(row, known.scale)
        information = information + slope.T @ weight @ slope
    covariance = np.linalg.inv(information)
    std = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(std, std)
    own = STATES.index(name)
    partner = max((other for other in STATES if other != name), key=lambda o: abs(correlation[own, STATES.index(o)]))
    blind = {"R_s_ohm": "no current flows", "psi_f_wb": "the shaft hardly turns"}[name]
    seen = float(information[own, own]) ** -0.5 <= LIMIT[name]  # alone, all else given
    told = f"{name} and {partner} cannot be separated" if seen else f"{name} shows in nothing: {blind}"
    raise refuse(
        "E_NOT_IDENTIFIABLE",
        f"{told}; its standard deviation is {relative:.3g} %, limit {100.0 * LIMIT[name]:g} %",
        stage=STAGE,
        likely="a constant operating point: only R i + omega psi shows there",
        hint="let current and speed vary while tracking, or ask for the other quantity alone",
    )
