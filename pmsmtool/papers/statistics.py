# SPDX-License-Identifier: MIT
"""Settling, overshoot, and paired differences with bootstrap intervals."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.papers.figure import Column, Table

RESAMPLES = 2000
"""Bootstrap resamples; the ends of a 95 % interval then stand on 50 of them each."""
CONFIDENCE = 0.95

BAND = 0.02
"""Settling band, share of the step."""


def settling_s(i: Array, target: Sequence[float], band_a: float, T_s: float) -> float:
    """Return the time (s) of the first sample from which on |i - target| stays within a band; infinite for never.

    Parameters
    ----------
    i : ndarray, shape (n, 2)
        Currents at the sampling instants from the step on (A).
    target : sequence of 2 float
        A.
    band_a : float
        Radius of the band (A).
    T_s : float
        Time between samples (s).
    """
    outside = np.flatnonzero(np.hypot(*(i - np.asarray(target)).T) > band_a)
    if not len(outside):
        return 0.0
    return math.inf if outside[-1] == len(i) - 1 else float(outside[-1] + 1) * T_s


def overshoot(i: Array, start: Sequence[float], target: Sequence[float]) -> float:
    """Return how far the current runs past the target along the step, as a share of the step; 0 at least."""
    way = np.asarray(target, dtype=np.float64) - np.asarray(start, dtype=np.float64)
    return max(0.0, float(((i - np.asarray(target)) @ way).max()) / float(way @ way))


@dataclass(frozen=True, slots=True)
class Difference:
    """A statistic of a minus that of b over the same cases, with its interval."""

    value: float
    low: float
    high: float

    @property
    def verdict(self) -> str:
        """What may be claimed."""
        if self.high < 0.0:
            return "less"
        return "more" if self.low > 0.0 else "nothing"


STATISTICS: dict[str, Callable[[Array], Array]] = {
    "median": lambda x: np.asarray(np.median(x, axis=-1)),
    "mean": lambda x: np.asarray(np.mean(x, axis=-1)),
    "p95": lambda x: np.asarray(np.percentile(x, 95.0, axis=-1)),
}
"""What is compared, over the last axis."""


def paired(a: Array, b: Array, statistic: str, rng: np.random.Generator) -> Difference:
    """Return statistic(a) - statistic(b) with a percentile bootstrap interval over the pairs.

    Cases are resampled as pairs, so what both laws have in common cancels (Efron, Tibshirani 1993, chapter 13).

    Parameters
    ----------
    a, b : ndarray, shape (n,)
        The same cases under two laws.
    statistic : str
        A key of :data:`STATISTICS`.
    rng : numpy Generator
        Draws the resamples.
    """
    of = STATISTICS[statistic]
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        return Difference(math.nan, math.nan, math.nan)
    value = float(of(a) - of(b))
    drawn = rng.integers(0, len(a), (RESAMPLES, len(a)))
    differences = of(a[drawn]) - of(b[drawn])
    low, high = np.percentile(differences, (50.0 * (1.0 - CONFIDENCE), 50.0 * (1.0 + CONFIDENCE)))
    return Difference(value, float(low), float(high))


def lower_end(values: Array, statistic: str, rng: np.random.Generator) -> float:
    """Return the lower end of the bootstrap interval of a statistic."""
    drawn = rng.integers(0, len(values), (RESAMPLES, len(values)))
    return float(np.percentile(STATISTICS[statistic](values[drawn]), 50.0 * (1.0 - CONFIDENCE)))


def difference_table(
    title: str, rows: Sequence[tuple[str, str, Array, Array]], rng: np.random.Generator, unit: str = ""
) -> Table:
    """Return paired differences as a table.

    Parameters
    ----------
    title : str
        What is compared.
    rows : sequence of (law, baseline, a, b)
        The same cases under both.
    rng : numpy Generator
        Draws the resamples.
    unit : str
        Unit of the values.
    """
    found = []
    for law, baseline, a, b in rows:
        for statistic in STATISTICS:
            d = paired(a, b, statistic, rng)
            found.append((f"{law} - {baseline}", statistic, d.value, d.low, d.high, d.verdict))
    heads = (
        Column("difference"), Column("of"), Column("value", unit, 3), Column("low", unit, 3), Column("high", unit, 3),
        Column("shown"),
    )  # fmt: skip
    return Table(f"{title}; paired, {100 * CONFIDENCE:g} % bootstrap interval", heads, tuple(found))
