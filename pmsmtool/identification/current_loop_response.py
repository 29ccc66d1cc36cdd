# SPDX-License-Identifier: MIT
"""What a current loop's PI gains are, from asked and flowing q current and the loop's output in every period.

    v = K_p e + x,  x' = K_i e,  e = asked - flowing;  L i' = v delayed - R i - EMF

What the output counts may be unknown: over the error it still gives K_i / K_p, which no resistance, dead time or EMF
touches. K_p over the inductance then comes from how the current follows. What the EMF does there is a nuisance: a
constant, and a part that grows with the sum of the current (the shaft turns freely). What the inverter's dead time does
there goes on for many periods: a fit of what it leaves as an autoregression takes it out (generalised least squares).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pmsmtool.arrays import Array

DELAYS = (0.0, 0.5, 1.0, 1.5, 2.0)
"""Periods from a sample to the voltage that answers it; a fraction mixes two periods."""
LATER = (0, 1, 2)
"""Rows by which the loop's output may be recorded later than the error that it answers."""
FIRST_BANDWIDTH = (0.04, 0.12, 0.3)
"""K_p / L times period that a fit begins with: makers leave 0.08 to 0.3 (``learned_gains.CURRENT_BANDWIDTH``)."""
SPAN = (1e-3, 1.2)
"""Of K_p / L times period: less is no current loop, more is unstable."""
LEFT_ORDER = 8
"""Order of the autoregression of what a fit leaves. With a dead time of 1.4 times R I_nom the standard deviation of K_p
fell from 2.9 to 0.8 %."""
UNFILTERED = np.ones(1)
WHITE_FLOOR = 1e-6
"""White noise of what a fit leaves (variance, relative), so that a record without noise has a filter."""
RESISTANCES = (0.3, 4.0)
"""Of the resistance stated: a winding may be warmer by half, and dead time adds to it at small currents."""


@dataclass(frozen=True, slots=True)
class CurrentSteps:
    """One record, a row per period of the loop."""

    period_s: float
    """Of the rows, and of the loop."""
    asked_a: Array
    current_a: Array
    output: Array
    """Asked and flowing q current (A), and the loop's output (counts)."""


@dataclass(frozen=True, slots=True)
class Winding:
    """What the loop acts on."""

    L_h: float
    L_std: float
    """Inductance in q, and its standard deviation (relative)."""
    R_ohm: float
    """Resistance, from which a fit begins."""
    U_max_v: float = math.inf
    """Largest voltage that the inverter has for it (V peak): U_dc / sqrt(3)."""
    emf_vs_per_rad: float = 0.0
    """Voltage that the turning shaft takes of it, per speed of the shaft (V s/rad)."""


@dataclass(frozen=True, slots=True)
class CurrentLoop:
    """What records of one setting say."""

    K_p_per_L: float
    """Gain over the inductance (1/s)."""
    rate_per_s: float
    """K_i / K_p."""
    delay: float
    """Periods; one of :data:`DELAYS`."""
    misfit: float
    """Root mean square of what the loop leaves of the current, over that of what it moves."""
    output_misfit: float = 0.0
    """The same of the loop's output: what is no PI of the error."""
    corner: float = 0.0
    """R / L (1/s) as it follows: of the warm winding, with what the inverter adds."""
    std: tuple[float, float, float] = (math.inf, math.inf, math.inf)
    """Of K_p, K_i and K_i / K_p (relative), by what single records differ in."""


def fit_current_loop(
    records: Sequence[CurrentSteps], winding: Winding, first: CurrentLoop | None = None
) -> CurrentLoop:
    """Return the loop that explains all records; ``first`` gives the delay, and where the fit begins."""
    rate, left = integral_rate(records)
    delays = DELAYS if first is None else (first.delay,)
    found = [_followed(records, rate, winding, delay, first) for delay in delays]
    raw = min(found, key=lambda loop: loop.misfit)
    white = _autoregression([_unexplained(record, raw, UNFILTERED) for record in records])
    found = [_followed(records, rate, winding, delay, raw, white) for delay in delays]
    best = replace(min(found, key=lambda loop: loop.misfit), misfit=raw.misfit, output_misfit=left)
    of_gain = _spread([_followed([record], rate, winding, best.delay, best, white).K_p_per_L for record in records])
    of_rate = _spread([integral_rate([record])[0] for record in records])
    return replace(best, std=(of_gain, math.hypot(of_gain, of_rate), of_rate))


def _spread(values: Sequence[float]) -> float:
    """Return the standard deviation of a mean of single records (relative)."""
    if len(values) < 2 or min(values) <= 0.0:
        return math.inf
    return float(np.log(values).std(ddof=1)) / math.sqrt(len(values))


def integral_rate(records: Sequence[CurrentSteps]) -> tuple[float, float]:
    """Return K_i / K_p (1/s) of the loop's output over the error, and what is left of the output (relative).

    A constant and a ramp of each record are the integral's state, and a feed-forward of the EMF.
    """
    found = []
    for later in LATER:
        rows, outputs = [], []
        for k, record in enumerate(records):
            e = record.asked_a - record.current_a
            before = record.period_s * (np.cumsum(e) - e)
            n = len(e) - later
            ramp = np.linspace(-1.0, 1.0, n)
            nuisance = np.zeros((n, 2 * len(records)))
            nuisance[:, 2 * k], nuisance[:, 2 * k + 1] = 1.0, ramp
            rows.append(np.column_stack([e[:n], before[:n], nuisance]))
            outputs.append(record.output[later:])
        table, output = np.concatenate(rows), np.concatenate(outputs)
        scale = np.linalg.norm(table, axis=0)
        table /= scale
        solved = np.linalg.lstsq(table, output, rcond=None)[0]
        left = float(np.linalg.norm(output - table @ solved))
        found.append((left / max(float(np.linalg.norm(output - output.mean())), 1e-12), solved[:2] / scale[:2]))
    left, (K_p, K_i) = min(found, key=lambda one: one[0])
    return (float(K_i / K_p) if K_p else 0.0), left


def _autoregression(left: Sequence[Array]) -> Array:
    """Return the filter that makes noise without memory of what a fit leaves (Yule-Walker)."""
    from scipy.linalg import solve_toeplitz

    r = [sum(float(x[: len(x) - k] @ x[k:]) for x in left) for k in range(LEFT_ORDER + 1)]
    if r[0] <= 0.0:
        return UNFILTERED
    return np.concatenate([[1.0], -solve_toeplitz([(1.0 + WHITE_FLOOR) * r[0], *r[1:-1]], r[1:])])


def _followed(
    records: Sequence[CurrentSteps], rate: float, winding: Winding, delay: float, first: CurrentLoop | None,
    white: Array = UNFILTERED,
) -> CurrentLoop:  # fmt: skip
    """Return the loop of this delay and K_i / K_p (1/s) that follows what is asked best.

    ``white`` filters what it leaves before that is weighed.
    """
    from scipy.optimize import least_squares

    period_s = records[0].period_s
    moved = math.sqrt(sum(float(np.sum((r.current_a - r.current_a.mean()) ** 2)) for r in records))

    def left(point: Array) -> Array:
        K_p, corner = (math.exp(x) for x in point)
        loop = CurrentLoop(K_p, rate, delay, 0.0, corner=corner)
        return np.concatenate([_unexplained(record, loop, white) for record in records])

    corner = winding.R_ohm / winding.L_h
    low, high = (np.log([share / period_s, of_R * corner]) for share, of_R in zip(SPAN, RESISTANCES, strict=True))
    starts = [first.K_p_per_L] if first else [share / period_s for share in FIRST_BANDWIDTH]
    fits = [least_squares(left, np.log([K_p, corner]), bounds=(low, high), ftol=1e-9) for K_p in starts]
    best = min(fits, key=lambda one: float(one.cost))
    K_p, corner = (float(x) for x in np.exp(best.x))
    return CurrentLoop(K_p, rate, delay, math.sqrt(2.0 * best.cost) / max(moved, 1e-12), corner=corner)


def _unexplained(record: CurrentSteps, of: CurrentLoop, white: Array) -> Array:
    """Return what the loop leaves of the current, filtered, once the nuisances are fitted."""
    from scipy.signal import lfilter

    T, K_p, K_i = record.period_s, of.K_p_per_L, of.K_p_per_L * of.rate_per_s
    corner, delay = of.corner, of.delay
    a = math.exp(-corner * T)
    b = (1.0 - a) / corner
    whole = int(delay)
    held = np.zeros(whole + 3)  # one period lies in the plant: voltage of period k is seen at k + 1
    held[whole + 1 : whole + 3] = 1.0 - (delay - whole), delay - whole
    loop = np.convolve(b * held, [K_p, K_i * T - K_p])
    poles = np.convolve([1.0, -a], [1.0, -1.0])
    closed = np.array(loop)
    closed[: len(poles)] += poles
    base = record.asked_a[0]
    impulse = np.zeros(len(record.asked_a))
    impulse[0] = 1.0
    plant = np.convolve([0.0, b], [1.0, -1.0])
    columns = np.column_stack([
        lfilter(plant, closed, np.ones(len(impulse))), lfilter([1.0, -1.0], closed, impulse),
        lfilter(plant, closed, np.cumsum(record.current_a)),
    ])  # fmt: skip
    target = record.current_a - base - lfilter(loop, closed, record.asked_a - base)
    columns, target = (lfilter(white, 1.0, x, axis=0)[len(white) - 1 :] for x in (columns, target))
    columns /= np.linalg.norm(columns, axis=0)
    return np.asarray(target - columns @ np.linalg.lstsq(columns, target, rcond=None)[0])
