# SPDX-License-Identifier: MIT
"""The verdict on measured responses by a prediction, and what a deviation looks most like.

The prediction is the arrays of the ``.npz`` file that is committed before the first step.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.design.prediction import Band, Fault, Prediction, Quantity
from pmsmtool.errors import ConfigError, next_step
from pmsmtool.proof.plan import SPEED, TURN_ORDERS
from pmsmtool.trace import Trace

NEXT_STEP = "prove again: the prediction beside the traces was damaged"

SCHEMA = "pmsmtool.prediction/1"


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


@next_step(NEXT_STEP)
def from_arrays(arrays: Mapping[str, NDArray[Any]], *, where: str = "prediction") -> Prediction:
    """Read what :func:`to_arrays` made. Raises ConfigError: it is not a prediction."""
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


EXPLAINED = 0.5
CLEARLY = 0.7
"""A fault is named when it leaves at most this share of the squared deviation, and at most this share of what the next
one leaves (measured on the spoiled drives of the tests: 0.32 and 0.37; on a saturated machine without a map: 0.88)."""

RIPPLE_MOST = 1.0
"""Most ripple that counts, of the half width without: what shakes more than it may be off is not healthy."""
SHAKES = (
    "the machine shakes in steady state by more than the band: an encoder off centre behind a stiff speed loop, a "
    "shaft that is elastic or has play, cogging, or a link with ripple"
)
SPEED_STEP = ("speed_step", "i_q_a")
OSCILLATES = (
    "the speed loop oscillates: a load behind an elastic shaft that identification did not see, or too coarse an "
    "encoder (a slower loop: tune --speed-bandwidth-hz)"
)
SWINGS_MORE = 3
"""Swings between half of the largest predicted current and minus that, beyond the predicted ones, that count as one: a
load of 13 times the inertia behind 450 Hz made 3 at standstill, and a wrong sign of the decoupling was named."""
TOLD_APART = 0.05
"""Least mean square by which patterns differ in a wave over the angle that is taken out of them; most is 0.5."""
RIPPLE_SIGMAS = 3.0
"""Largest of some hundred averages, in their standard deviations."""
LEAST_STEADY_ROWS = 16
RIPPLE_TOLD = 0.1
"""Ripple is said from this part of the half width on."""


@dataclass(frozen=True, slots=True)
class Seen:
    """One judged signal or quantity."""

    what: str
    """Experiment and signal, or the quantity."""
    share: float
    """Largest deviation over the half width of the band; at most one is inside."""
    where: str
    """Where the largest deviation is, or value and band of a quantity."""

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


def with_ripple(prediction: Prediction, traces: Mapping[str, Trace]) -> Prediction:
    """Return the prediction with its bands wider by the ripple that the records show where nothing is asked.

    Cogging, harmonics of the back-EMF, an encoder off centre and the ripple of the link shake a healthy machine; at
    what angle is not known before. Of a steady end it is the largest deviation from a straight line; of a pattern
    that was repeated, what an average over the repeats still holds of what :func:`patterns` differ by.
    """
    bands = dict(prediction.bands)
    for (experiment, signal), band in prediction.bands.items():
        if experiment not in traces:
            continue
        repeats = patterns(traces[experiment], signal, len(band.mean))
        steady = prediction.facts.get("steady_rows", {}).get(experiment, 0)
        ripple = 0.0
        if len(repeats) > 1:
            ripple = RIPPLE_SIGMAS * math.sqrt(float(np.mean(np.var(repeats, axis=0, ddof=1))) / len(repeats))
        elif steady >= LEAST_STEADY_ROWS:
            end, k = (repeats[0] - band.mean)[-steady:], np.arange(steady)
            ripple = float(np.max(np.abs(end - np.polyval(np.polyfit(k, end, 1), k))))
        bands[experiment, signal] = replace(
            band, ripple=min(ripple, _most_ripple(band)) if math.isfinite(ripple) else 0.0
        )
    return replace(prediction, bands=bands)


def patterns(trace: Trace, signal: str, rows: int) -> Array:
    """Return the repeated patterns of a record, shape (repeats, rows), without what turns with the rotor.

    Harmonics of the back-EMF, dead times, offsets and gains of the current sensors make waves over the electrical angle
    (:data:`TURN_ORDERS`). Each pattern meets other angles, and the response is the same in all of them: least squares
    on what they differ by. Averages of eight still held 0.4 of 0.85 A of a 7th of 1.4 %, which failed a healthy drive.
    """
    values = trace[signal].reshape(-1, rows)
    angle = np.cumsum(trace[SPEED] * trace.period_s) if len(values) > 1 else np.array([math.nan])
    if not math.isfinite(angle[-1]):
        return values
    turning = np.exp(1j * np.multiply.outer(angle, TURN_ORDERS))
    waves = np.concatenate([turning.real, turning.imag], axis=1).reshape(len(values), rows, -1)
    differing = (waves - waves.mean(axis=0)).reshape(values.size, -1)
    power, modes = np.linalg.eigh(differing.T @ differing / values.size)
    shown = power > TOLD_APART
    along = modes[:, shown].T @ (differing.T @ values.ravel()) / values.size
    return np.asarray(values - waves @ (modes[:, shown] @ (along / power[shown])))


def judge(prediction: Prediction, measured: Mapping[tuple[str, str], Array]) -> Judgement:
    """Compare measured responses with the prediction. Raises ConfigError: a response has another length than predicted.

    Parameters
    ----------
    prediction : Prediction
        As committed.
    measured : mapping
        Response by (experiment, signal); experiments that were not run any more are left out.
    """
    seen = []
    for (experiment, signal), band in prediction.bands.items():
        if (experiment, signal) not in measured:
            continue
        values = measured[experiment, signal]
        if values.shape != band.mean.shape:
            raise ConfigError(
                f"{experiment}: {len(values)} rows of {signal}, {len(band.mean)} were predicted",
                hint="prove the design again: the record is not of this prediction",
            )
        share, row = band.largest(values)
        at = prediction.t_s[experiment][row]
        seen.append(
            Seen(
                f"{experiment}: {signal}",
                share,
                f"{values[row]:.4g} at {at:.4g} s, {band.low[row]:.4g} to {band.high[row]:.4g} predicted"
                + (f", +-{band.ripple:.2g} of it ripple" if band.ripple > RIPPLE_TOLD * band.half[row] else ""),
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
    if SPEED_STEP in keys and _swings_more(measured[SPEED_STEP], prediction.bands[SPEED_STEP].mean):
        return Judgement(found.seen, OSCILLATES)
    cause = likely_cause(prediction, {key: measured[key] for key in sorted(keys)}, measured)
    if not cause and only_quantities:  # no response alone is far enough off to tell, but what they tell together is
        cause = _cause_of_quantities(prediction, deviation)
    if not cause and any(b.ripple >= _most_ripple(b) for b in map(prediction.bands.__getitem__, keys)):
        cause = SHAKES
    return Judgement(found.seen, cause)


def _swings_more(response: Array, predicted: Array) -> bool:
    """Return whether a response goes between half of the largest predicted value and minus that, and was not to."""
    swings = []
    for values in (response, predicted):
        large = values[np.abs(values) > 0.5 * np.max(np.abs(predicted))]
        swings.append(int(np.sum(np.diff(np.sign(large)) != 0.0)))
    return swings[0] >= swings[1] + SWINGS_MORE


def _most_ripple(band: Band) -> float:
    """Return the ripple from which on no more counts."""
    return RIPPLE_MOST * float(np.median(band.factor * band.std))


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
    return Seen(name, share, f"{value:.3g}, {quantity.band} predicted")


def likely_cause(
    prediction: Prediction, deviating: Mapping[tuple[str, str], Array], measured: Mapping[tuple[str, str], Array]
) -> str:
    """Return the text of the fault whose signature is clearly nearest to what deviates; empty when none is.

    A healthy drive must not be clearly nearer to all that was ``measured``: wrong pole pairs were named where current
    steps were off, beside a speed step as predicted.
    """
    healthy, scores = _scores(prediction, deviating)
    texts: dict[str, str] = {}  # two sizes of the same fault do not compete
    for name in sorted(scores, key=lambda name: scores[name]):
        texts.setdefault(prediction.faults[name].text, name)
    nearest, *others = texts.values() or [""]
    if not nearest or scores[nearest] > EXPLAINED * healthy:
        return ""
    if others and scores[nearest] > CLEARLY * scores[others[0]]:
        return ""
    healthy, scores = _scores(prediction, measured)
    return prediction.faults[nearest].text if healthy >= CLEARLY * scores[nearest] else ""


def _scores(prediction: Prediction, measured: Mapping[tuple[str, str], Array]) -> tuple[float, dict[str, float]]:
    """Return how far responses are from those of a healthy drive, and from those of each fault, by its name."""
    means = {key: prediction.bands[key].mean for key in measured}
    stds = {key: prediction.bands[key].std for key in measured}
    scores: dict[str, float] = {}
    for name, fault in prediction.faults.items():
        widest = {key: np.maximum(fault.std[key], stds[key]) for key in measured}
        # minus twice the log-likelihood per point: what may look like anything is not near to everything
        wider = 2.0 * float(np.mean([np.mean(np.log(widest[key] / stds[key])) for key in measured]))
        scores[name] = _distance(measured, fault.mean, widest) + wider
    return _distance(measured, means, stds), scores


def _distance(
    measured: Mapping[tuple[str, str], Array],
    mean: Mapping[tuple[str, str], Array],
    std: Mapping[tuple[str, str], Array],
) -> float:
    """Mean squared deviation over the variance, each signal with the same weight."""
    shares = [float(np.mean(((values - mean[key]) / std[key]) ** 2)) for key, values in measured.items()]
    return float(np.mean(shares)) if np.all(np.isfinite(shares)) else math.inf
