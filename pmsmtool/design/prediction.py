# SPDX-License-Identifier: MIT
"""The predicted bands of responses, what is derived from them, and what they look like when something is wrong.

A prediction is made of simulated runs of one design on machines drawn from their intervals. The band of an
experiment is simultaneous: all its judged signals lie inside at all times. Its width comes from the largest of ``n``
runs, so that it holds at least 95 % of the responses with the confidence 1 - 0.95^n (Wilks 1941,
DOI 10.1214/aoms/1177731788): 99.3 % for 96 runs. Everything the verdict needs is in the prediction: what is committed
before the first step is what is judged by.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from pmsmtool.arrays import Array

Key = TypeVar("Key")

MODEL_ALLOWANCE = 1.3
"""Half width over that of the simulated runs, for what the averaged model of the inverter leaves out."""
QUANTITY_ALLOWANCE = 2.0
"""The same of a derived quantity, which is weighed against what the drawn machines vary in and nothing else (of three
random drives, healthy: at most 0.33 of the band then; K_p 20 % off: 2.7 times and more)."""
LEAST_CHANGE = 0.1
"""Half width of a derived quantity is never less than this part of the change its two sets of runs differ by: 4.5 % of
the loop gain, a tenth of a period. No fault is smaller, and no model that precise."""
FLOOR_SHARE = 0.005
"""Standard deviation that every point has at least, of the scale of its signal: ripple, quantisation, cogging."""
LEAST_FACTOR = 2.0
"""Half width over the standard deviation is never less: a signal that no drawn parameter moves keeps its floor."""
NORMALISING_QUANTILE = 0.9
"""Quantile of the runs' largest deviations that makes signals comparable before the largest is taken."""
NEARBY = 128
"""The variance is the largest within this part of a response, either way."""


@dataclass(frozen=True, slots=True)
class Band:
    """Predicted band of one signal of one experiment."""

    mean: Array
    std: Array
    """Of the simulated runs, the floor included. Shape (n,)."""
    factor: float
    """Half width over ``std``, without ripple."""
    ripple: float = 0.0
    """What the record itself shows of it, in the signal's unit."""

    @property
    def half(self) -> Array:
        """Half width, shape (n,)."""
        return self.factor * self.std + self.ripple

    @property
    def low(self) -> Array:
        """Lower edge, shape (n,)."""
        return self.mean - self.half

    @property
    def high(self) -> Array:
        """Upper edge, shape (n,)."""
        return self.mean + self.half

    def largest(self, measured: Array) -> tuple[float, int]:
        """Return the largest deviation over the half width, and its row; what is no number deviates infinitely."""
        share = np.abs(measured - self.mean) / self.half
        share = np.where(np.isfinite(share), share, math.inf)
        row = int(np.argmax(share))
        return float(share[row]), row


@dataclass(frozen=True, slots=True)
class Quantity:
    """A derived quantity: the amplitude of a signature in the deviation, by generalised least squares."""

    nominal: float
    """Value without deviation."""
    unit: str
    """Unit of the value."""
    low: float
    high: float
    """Predicted band."""
    signature: Mapping[tuple[str, str], Array]
    """Deviation per amplitude, already over the covariance: the inner product with a deviation is the amplitude.
    Mapping of (experiment, signal) to ndarray."""
    below: str = ""
    above: str = ""
    """What is wrong when it lies below its band, or above; empty when nothing is known to do that."""

    def of(self, deviation: Mapping[tuple[str, str], Array]) -> float:
        """Return the quantity that a deviation from the mean shows."""
        return self.nominal + sum(float(np.vdot(weights, deviation[key])) for key, weights in self.signature.items())

    @property
    def band(self) -> str:
        """The predicted band with its unit, as a person reads it."""
        return f"{self.low:.3g} to {self.high:.3g}{'' if self.unit == '1' else f' {self.unit}'}"


@dataclass(frozen=True, slots=True)
class Fault:
    """What the signals look like when something is wrong: mean and standard deviation by (experiment, signal)."""

    text: str
    mean: Mapping[tuple[str, str], Array]
    std: Mapping[tuple[str, str], Array]


@dataclass(frozen=True, slots=True)
class Prediction:
    """What a drive will do, before it does it."""

    t_s: Mapping[str, Array]
    """Time base of each experiment, in the order they are run."""
    bands: Mapping[tuple[str, str], Band]
    """What is judged. Mapping of (experiment, signal) to Band."""
    quantities: Mapping[str, Quantity] = field(default_factory=dict)
    """Derived quantities with their bands."""
    faults: Mapping[str, Fault] = field(default_factory=dict)
    """Signatures of what may be wrong."""
    facts: Mapping[str, Any] = field(default_factory=dict)
    """Design hash, conditions, seed, number of runs; JSON-serialisable."""

    def signals(self, experiment: str) -> tuple[str, ...]:
        """Return the judged signals of an experiment."""
        return tuple(signal for name, signal in self.bands if name == experiment)


Runs = Mapping[tuple[str, str], Array]
"""Simulated responses by (experiment, signal), shape (runs, rows)."""


@dataclass(frozen=True, slots=True)
class Direction:
    """How a derived quantity is made: two sets of runs that differ in nothing but the quantity.

    ``high`` and ``low`` are responses of the same machines at the values ``at_high`` and ``at_low``; ``below`` and
    ``above`` as for :class:`Quantity`. ``least_change`` is the least half width, as :data:`LEAST_CHANGE`.
    """

    nominal: float
    unit: str
    high: Runs
    low: Runs
    at_high: float
    at_low: float
    below: str = ""
    above: str = ""
    least_change: float = LEAST_CHANGE


def predict(
    t_s: Mapping[str, Array],
    runs: Runs,
    scales: Mapping[tuple[str, str], float],
    *,
    directions: Mapping[str, Direction] | None = None,
    faults: Mapping[str, tuple[str, Runs]] | None = None,
    facts: Mapping[str, Any] | None = None,
    allowances: Mapping[str, float] | None = None,
) -> Prediction:
    """Return the prediction that simulated runs make.

    Parameters
    ----------
    t_s : mapping of str to ndarray
        Time base of each experiment.
    runs : mapping
        Responses of the healthy drive on the drawn machines.
    scales : mapping
        Scale of each signal, for the floor of its standard deviation.
    directions : mapping of str to Direction, optional
        Derived quantities; one that changes no response, as the decoupling at standstill, is left out.
    faults : mapping of str to (text, runs), optional
        Responses of drives with something wrong.
    facts : mapping, optional
        Kept with it.
    allowances : mapping of str to float, optional
        By experiment; :data:`MODEL_ALLOWANCE` where not given.
    """
    floors = {key: FLOOR_SHARE * scale for key, scale in scales.items()}
    spread = {key: _spread(values, floors[key]) for key, values in runs.items()}
    shown = {name: direction for name, direction in (directions or {}).items() if _shows(direction)}
    filters = {name: _filtered(direction, runs, spread) for name, direction in shown.items()}
    largest = {key: _largest_left_out(values, floors[key]) for key, values in runs.items()}
    factors: dict[tuple[str, str], float] = {}
    for name in t_s:
        allowance = (allowances or {}).get(name, MODEL_ALLOWANCE)
        factors |= _factors({key: v for key, v in largest.items() if key[0] == name}, allowance)
    deviations = {name: np.abs(a - np.median(a)) / _least_std(a) for name, (_, a) in filters.items()}
    quantity_factors = _factors(deviations, QUANTITY_ALLOWANCE)
    return Prediction(
        dict(t_s),
        {key: Band(*spread[key], factors[key]) for key in runs},
        {name: _quantity(direction, *filters[name], quantity_factors[name]) for name, direction in shown.items()},
        {name: _fault(text, wrong, floors) for name, (text, wrong) in (faults or {}).items()},
        dict(facts or {}),
    )


def _factors(deviations: Mapping[Key, Array], allowance: float) -> dict[Key, float]:
    """Return half widths over standard deviations such that the band of all signals together holds every run."""
    normal = {key: float(np.quantile(v, NORMALISING_QUANTILE)) for key, v in deviations.items()}
    common = max((float(np.max(v)) / normal[key] for key, v in deviations.items() if normal[key] > 0.0), default=1.0)
    return {key: max(LEAST_FACTOR, allowance * common * q) for key, q in normal.items()}


def _spread(values: Array, floor: float) -> tuple[Array, Array]:
    variance = _widest_nearby(np.var(values, axis=0, ddof=1))
    return np.mean(values, axis=0), np.sqrt(variance + floor**2)


def _widest_nearby(variance: Array) -> Array:
    """Largest variance within a few rows: what comes a little earlier or later in one run is no deviation."""
    reach = variance.shape[-1] // NEARBY
    padded = np.pad(variance, [(0, 0)] * (variance.ndim - 1) + [(reach, reach)], mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1, axis=-1)
    return np.asarray(windows.max(axis=-1))


def _largest_left_out(values: Array, floor: float) -> Array:
    """Largest deviation of each run over the standard deviation, both judged by the other runs, shape (runs,)."""
    n = len(values)
    centred = values - np.mean(values, axis=0)
    out = centred * (n / (n - 1.0))
    variance = np.maximum((np.sum(centred**2, axis=0) - centred * out) / (n - 2.0), 0.0)
    return np.asarray(np.max(np.abs(out) / np.sqrt(_widest_nearby(variance) + floor**2), axis=1))


def _shows(direction: Direction) -> bool:
    return any(bool(np.any(direction.high[key] != direction.low[key])) for key in direction.high)


def _filtered(
    direction: Direction, runs: Runs, spread: Mapping[tuple[str, str], tuple[Array, Array]]
) -> tuple[dict[tuple[str, str], Array], Array]:
    """Return the signature, normalised so that the change itself has amplitude one, and the amplitudes of the runs."""
    keys = list(direction.high)
    change = np.concatenate([np.mean(direction.high[key] - direction.low[key], axis=0) for key in keys])
    variance = np.concatenate([spread[key][1] ** 2 for key in keys])
    weights, amplitudes = matched_filter(
        change / (direction.at_high - direction.at_low), np.concatenate([runs[key] for key in keys], axis=1), variance
    )
    ends = np.cumsum([len(spread[key][0]) for key in keys])
    return dict(zip(keys, np.split(weights, ends[:-1]), strict=True)), amplitudes


def _least_std(values: Array) -> float:
    return max(float(np.std(values, ddof=1)), 1e-12)


def _quantity(
    direction: Direction, signature: Mapping[tuple[str, str], Array], amplitude: Array, factor: float
) -> Quantity:
    middle = direction.nominal + float(np.median(amplitude))
    half = max(factor * _least_std(amplitude), direction.least_change * abs(direction.at_high - direction.at_low))
    return Quantity(
        direction.nominal, direction.unit, middle - half, middle + half, signature, direction.below, direction.above
    )


def _fault(text: str, runs: Runs, floors: Mapping[tuple[str, str], float]) -> Fault:
    spread = {key: _spread(values, floors[key]) for key, values in runs.items()}
    return Fault(text, {key: m for key, (m, _) in spread.items()}, {key: s for key, (_, s) in spread.items()})


def matched_filter(change: Array, runs: Array, variance: Array) -> tuple[Array, Array]:
    """Return the weights of a change, and the amplitude each run has by the weights of the other runs.

    The weights are the change over the covariance of simulated runs (generalised least squares; Kay, Fundamentals of
    Statistical Signal Processing, vol. 1, theorem 4.2), so that what the runs have in common among themselves, such as
    the shape that an unknown dead time leaves, counts for nothing. Fewer runs than points make the covariance singular;
    it is regularised with its own diagonal, as if what the runs leave out were as large again and differed from point
    to point. Everything is solved between the runs (Woodbury): n by n, however many points there are.

    Parameters
    ----------
    change : ndarray, shape (points,)
        The change of shape per unit.
    runs : ndarray, shape (n, points)
        What varies without it.
    variance : ndarray, shape (points,)
        Of a point, positive.

    Returns
    -------
    weights : ndarray, shape (points,)
        Their inner product with a deviation from the mean is its amplitude; with the change itself it is one.
    amplitudes : ndarray, shape (n,)
        Of the runs, each left out of mean and covariance.
    """
    n = len(runs)
    centred = runs - np.mean(runs, axis=0)
    scaled = centred / variance
    gram = scaled @ centred.T
    seen = scaled @ change
    power = float(np.sum(change**2 / variance))
    solved = np.linalg.solve(np.eye(n) + gram / (n - 1.0), seen) / (n - 1.0)
    weights = change / variance - solved @ scaled
    amplitudes = np.array([_left_out(k, gram, seen, power) for k in range(n)])
    return weights / max(float(weights @ change), 1e-300), amplitudes


def _left_out(k: int, gram: Array, seen: Array, power: float) -> float:
    """Amplitude of run ``k`` by the mean and the covariance of the others; in it the mean of all is the origin."""
    n = len(seen)
    others = np.arange(n) != k
    block = gram[np.ix_(others, others)]
    rows = np.mean(block, axis=0)
    block = block - rows - rows[:, None] + np.mean(rows)
    toward = seen[others] - np.mean(seen[others])
    solved = np.linalg.solve(np.eye(n - 1) + block / (n - 2.0), toward) / (n - 2.0)
    away = n / (n - 1.0)  # from the mean of the others, whose mean is -1/(n - 1) of the run
    across = gram[k, others] - np.mean(gram[k, others])
    return float(away * (seen[k] - across @ solved) / max(power - float(toward @ solved), 1e-300))
