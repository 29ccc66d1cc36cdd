"""The predicted band of a response, the verdict on a measured one, and what a deviation looks most like.

A prediction is made of simulated runs of one design on machines drawn from their intervals. The band of an
experiment is simultaneous: all its judged signals lie inside at all times. Its width comes from the largest of ``n``
runs, so that it holds at least 95 % of the responses with the confidence 1 - 0.95^n (Wilks 1941,
DOI 10.1214/aoms/1177731788): 99.3 % for 96 runs. Everything the verdict needs is in the prediction: what is committed
before the first step is what is judged by.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pmsmtool.design.matched_filter import matched_filter
from pmsmtool.errors import ConfigError

Array = NDArray[np.float64]
Key = TypeVar("Key")

SCHEMA = "pmsmtool.prediction/1"

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
EXPLAINED = 0.5
CLEARLY = 0.7
"""A fault is named when it leaves at most this share of the squared deviation, and at most this share of what the next
one leaves (measured on the spoiled drives of the tests: 0.32 and 0.37; on a saturated machine without a map: 0.88)."""


@dataclass(frozen=True, slots=True)
class Band:
    """Predicted band of one signal of one experiment.

    Attributes
    ----------
    mean, std : ndarray, shape (n,)
        Of the simulated runs, the floor included.
    factor : float
        Half width over ``std``.
    """

    mean: Array
    std: Array
    factor: float

    @property
    def low(self) -> Array:
        """Lower edge, shape (n,)."""
        return self.mean - self.factor * self.std

    @property
    def high(self) -> Array:
        """Upper edge, shape (n,)."""
        return self.mean + self.factor * self.std

    def largest(self, measured: Array) -> tuple[float, int]:
        """Return the largest deviation over the half width, and its row; what is no number deviates infinitely."""
        share = np.abs(measured - self.mean) / (self.factor * self.std)
        share = np.where(np.isfinite(share), share, math.inf)
        row = int(np.argmax(share))
        return float(share[row]), row


@dataclass(frozen=True, slots=True)
class Quantity:
    """A derived quantity: the amplitude of a signature in the deviation, by generalised least squares.

    Attributes
    ----------
    nominal : float
        Value without deviation.
    unit : str
        Unit of the value.
    low, high : float
        Predicted band.
    signature : mapping of (experiment, signal) to ndarray
        Deviation per amplitude, already over the covariance: the inner product with a deviation is the amplitude.
    below, above : str
        What is wrong when it lies below its band, or above; empty when nothing is known to do that.
    """

    nominal: float
    unit: str
    low: float
    high: float
    signature: Mapping[tuple[str, str], Array]
    below: str = ""
    above: str = ""

    def of(self, deviation: Mapping[tuple[str, str], Array]) -> float:
        """Return the quantity that a deviation from the mean shows."""
        return self.nominal + sum(float(np.vdot(weights, deviation[key])) for key, weights in self.signature.items())


@dataclass(frozen=True, slots=True)
class Fault:
    """What the signals look like when something is wrong: mean and standard deviation by (experiment, signal)."""

    text: str
    mean: Mapping[tuple[str, str], Array]
    std: Mapping[tuple[str, str], Array]


@dataclass(frozen=True, slots=True)
class Prediction:
    """What a drive will do, before it does it.

    Attributes
    ----------
    t_s : mapping of str to ndarray
        Time base of each experiment, in the order they are run.
    bands : mapping of (experiment, signal) to Band
        What is judged.
    quantities : mapping of str to Quantity
        Derived quantities with their bands.
    faults : mapping of str to Fault
        Signatures of what may be wrong.
    facts : mapping
        Design hash, conditions, seed, number of runs; JSON-serialisable.
    """

    t_s: Mapping[str, Array]
    bands: Mapping[tuple[str, str], Band]
    quantities: Mapping[str, Quantity] = field(default_factory=dict)
    faults: Mapping[str, Fault] = field(default_factory=dict)
    facts: Mapping[str, Any] = field(default_factory=dict)

    def signals(self, experiment: str) -> tuple[str, ...]:
        """Return the judged signals of an experiment."""
        return tuple(signal for name, signal in self.bands if name == experiment)


# ---- making it ------------------------------------------------------------------------------------------------

Runs = Mapping[tuple[str, str], Array]
"""Simulated responses by (experiment, signal), shape (runs, rows)."""


@dataclass(frozen=True, slots=True)
class Direction:
    """How a derived quantity is made: two sets of runs that differ in nothing but the quantity.

    ``high`` and ``low`` are responses of the same machines at the values ``at_high`` and ``at_low``; ``below`` and
    ``above`` as for :class:`Quantity`.
    """

    nominal: float
    unit: str
    high: Runs
    low: Runs
    at_high: float
    at_low: float
    below: str = ""
    above: str = ""


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
    half = max(factor * _least_std(amplitude), LEAST_CHANGE * abs(direction.at_high - direction.at_low))
    return Quantity(
        direction.nominal, direction.unit, middle - half, middle + half, signature, direction.below, direction.above
    )


def _fault(text: str, runs: Runs, floors: Mapping[tuple[str, str], float]) -> Fault:
    spread = {key: _spread(values, floors[key]) for key, values in runs.items()}
    return Fault(text, {key: m for key, (m, _) in spread.items()}, {key: s for key, (_, s) in spread.items()})


# ---- judging by it ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Seen:
    """One judged signal or quantity.

    Attributes
    ----------
    what : str
        Experiment and signal, or the quantity.
    share : float
        Largest deviation over the half width of the band; at most one is inside.
    where : str
        Where the largest deviation is, or value and band of a quantity.
    """

    what: str
    share: float
    where: str

    @property
    def inside(self) -> bool:
        """Whether all of it lies in the band."""
        return self.share <= 1.0


@dataclass(frozen=True, slots=True)
class Judgement:
    """The verdict on measured responses: every signal and quantity, and the likely cause when one is outside."""

    seen: tuple[Seen, ...]
    cause: str = ""

    @property
    def inside(self) -> bool:
        """Whether everything lies in its band."""
        return all(line.inside for line in self.seen)


def judge(prediction: Prediction, measured: Mapping[tuple[str, str], Array]) -> Judgement:
    """Compare measured responses with the prediction.

    Parameters
    ----------
    prediction : Prediction
        As committed.
    measured : mapping
        Response by (experiment, signal); experiments that were not run any more are left out.

    Raises
    ------
    ConfigError
        A response has another length than predicted.
    """
    seen = []
    for (experiment, signal), band in prediction.bands.items():
        if (experiment, signal) not in measured:
            continue
        values = measured[experiment, signal]
        if values.shape != band.mean.shape:
            raise ConfigError(f"{experiment}: {len(values)} rows of {signal}, {len(band.mean)} were predicted")
        share, row = band.largest(values)
        at = prediction.t_s[experiment][row]
        seen.append(
            Seen(
                f"{experiment}: {signal}",
                share,
                f"{values[row]:.4g} at {at:.4g} s, {band.low[row]:.4g} to {band.high[row]:.4g} predicted",
            )
        )
    deviation = {key: measured[key] - prediction.bands[key].mean for key in measured if key in prediction.bands}
    for name, quantity in prediction.quantities.items():
        if set(quantity.signature) <= set(deviation):
            seen.append(_seen_quantity(name, quantity, quantity.of(deviation)))
    found = Judgement(tuple(seen))
    if found.inside:
        return found
    outside = {line.what for line in seen if not line.inside}
    keys = {key for key in measured if f"{key[0]}: {key[1]}" in outside}
    only_quantities = not keys
    keys |= {key for name, q in prediction.quantities.items() if name in outside for key in q.signature}
    cause = likely_cause(prediction, {key: measured[key] for key in sorted(keys)})
    if not cause and only_quantities:  # no response alone is far enough off to tell, but what they tell together is
        cause = _cause_of_quantities(prediction, deviation)
    return Judgement(found.seen, cause)


def _cause_of_quantities(prediction: Prediction, deviation: Mapping[tuple[str, str], Array]) -> str:
    """Return what puts the quantity that is clearly the furthest outside there; empty when two are about as far."""
    shares: list[tuple[float, str]] = []
    for name, quantity in prediction.quantities.items():
        if set(quantity.signature) <= set(deviation):
            value = quantity.of(deviation)
            cause = quantity.below if value < quantity.low else quantity.above
            shares.append((_seen_quantity(name, quantity, value).share, cause))
    (furthest, cause), *others = sorted(shares, reverse=True)
    return "" if others and others[0][0] > CLEARLY * furthest else cause


def _seen_quantity(name: str, quantity: Quantity, value: float) -> Seen:
    middle, half = 0.5 * (quantity.low + quantity.high), 0.5 * (quantity.high - quantity.low)
    share = abs(value - middle) / half if math.isfinite(value) else math.inf
    unit = "" if quantity.unit == "1" else f" {quantity.unit}"
    return Seen(name, share, f"{value:.3g}{unit}, {quantity.low:.3g} to {quantity.high:.3g} predicted")


def likely_cause(prediction: Prediction, measured: Mapping[tuple[str, str], Array]) -> str:
    """Return the text of the fault whose signature is clearly nearest; empty when none is.

    ``measured`` are the responses that deviate.
    """
    means = {key: prediction.bands[key].mean for key in measured}
    stds = {key: prediction.bands[key].std for key in measured}
    healthy = _distance(measured, means, stds)
    scores: dict[str, float] = {}  # by text: two sizes of the same fault do not compete
    for fault in prediction.faults.values():
        widest = {key: np.maximum(fault.std[key], stds[key]) for key in measured}
        distance = _distance(measured, fault.mean, widest)
        # minus twice the log-likelihood per point: what may look like anything is not near to everything
        score = distance + 2.0 * float(np.mean([np.mean(np.log(widest[key] / stds[key])) for key in measured]))
        scores[fault.text] = min(score, scores.get(fault.text, math.inf))
    nearest, *others = sorted(scores, key=lambda text: scores[text]) or [""]
    if not nearest or scores[nearest] > EXPLAINED * healthy:
        return ""
    return "" if others and scores[nearest] > CLEARLY * scores[others[0]] else nearest


def _distance(
    measured: Mapping[tuple[str, str], Array],
    mean: Mapping[tuple[str, str], Array],
    std: Mapping[tuple[str, str], Array],
) -> float:
    """Mean squared deviation over the variance, each signal with the same weight."""
    shares = [float(np.mean(((values - mean[key]) / std[key]) ** 2)) for key, values in measured.items()]
    return float(np.mean(shares)) if np.all(np.isfinite(shares)) else math.inf


# ---- as arrays, for the file that is committed -------------------------------------------------------------------


def to_arrays(prediction: Prediction) -> dict[str, NDArray[Any]]:
    """Return the members of the ``.npz`` file; :func:`from_arrays` brings it back."""
    arrays: dict[str, NDArray[Any]] = {f"time|{name}": t for name, t in prediction.t_s.items()}
    for (experiment, signal), band in prediction.bands.items():
        arrays[f"mean|{experiment}|{signal}"], arrays[f"std|{experiment}|{signal}"] = band.mean, band.std
    for name, quantity in prediction.quantities.items():
        arrays |= {f"signature|{name}|{e}|{s}": weights for (e, s), weights in quantity.signature.items()}
    for name, fault in prediction.faults.items():
        for experiment, signal in fault.mean:
            key = f"{name}|{experiment}|{signal}"
            arrays[f"fault_mean|{key}"] = fault.mean[experiment, signal]
            arrays[f"fault_std|{key}"] = fault.std[experiment, signal]
    facts = {
        "schema": SCHEMA,
        "factor": {f"{e}|{s}": band.factor for (e, s), band in prediction.bands.items()},
        "quantity": {
            name: {
                "nominal": q.nominal,
                "unit": q.unit,
                "low": q.low,
                "high": q.high,
                "below": q.below,
                "above": q.above,
            }
            for name, q in prediction.quantities.items()
        },
        "fault": {name: fault.text for name, fault in prediction.faults.items()},
        "facts": dict(prediction.facts),
    }
    return {**arrays, "_meta": np.array(json.dumps(facts))}


def from_arrays(arrays: Mapping[str, NDArray[Any]], *, where: str = "prediction") -> Prediction:
    """Read what :func:`to_arrays` made.

    Raises
    ------
    ConfigError
        It is not a prediction.
    """
    try:
        facts = json.loads(str(arrays["_meta"]))
        if facts["schema"] != SCHEMA:
            raise ConfigError(f"schema is {facts['schema']!r}, expected {SCHEMA!r}", where=where)
        groups: dict[str, dict[tuple[str, ...], Array]] = {}
        for name, values in arrays.items():
            group, *key = name.split("|")
            groups.setdefault(group, {})[tuple(key)] = np.asarray(values)
        bands = {
            (e, s): Band(mean, groups["std"][e, s], float(facts["factor"][f"{e}|{s}"]))
            for (e, s), mean in groups["mean"].items()
        }
        quantities = {
            name: Quantity(**entry, signature=_under(groups.get("signature", {}), name))
            for name, entry in facts["quantity"].items()
        }
        faults = {
            name: Fault(text, _under(groups.get("fault_mean", {}), name), _under(groups.get("fault_std", {}), name))
            for name, text in facts["fault"].items()
        }
        times = {name: t for (name,), t in groups["time"].items()}
        return Prediction(times, bands, quantities, faults, facts["facts"])
    except (KeyError, ValueError, TypeError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"is no prediction: {error}", where=where) from error


def _under(group: Mapping[tuple[str, ...], Array], name: str) -> dict[tuple[str, str], Array]:
    return {(key[1], key[2]): values for key, values in group.items() if key[0] == name}
