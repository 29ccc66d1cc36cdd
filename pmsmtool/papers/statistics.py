# SPDX-License-Identifier: MIT
"""Settling, overshoot, and paired differences with bootstrap intervals.

Responses of the polar-coordinate figures are in power-invariant amperes, as in the paper.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.papers.figure import Column, Table
from pmsmtool.papers.polar_scene import K_T, PEAK, Response, machine_file

STEP_BAND = 0.05
"""Settling band as a share of the step."""

AREA_S = 0.03
"""Positive i_d is summed over this time after the step down."""

BUMP_S = 0.02
"""A torque bump is the deviation of the torque error from its mean over this time."""


def settling_ms(t: Array, x: Array, target: float, band: float) -> float:
    """Return the time (ms) from the first sample until x stays within +-band of target; infinite when it never does."""
    outside = np.flatnonzero(np.abs(x - target) > band)
    if not len(outside):
        return 0.0
    if outside[-1] + 1 >= len(t):
        return math.inf
    return 1e3 * float(t[outside[-1] + 1] - t[0])


@dataclass(frozen=True, slots=True)
class TorqueStep:
    """A step of the torque up and down again."""

    up_ms: float
    down_ms: float
    """5 % settling of i_q (ms)."""
    over_up: float
    over_down: float
    """Overshoot of i_q (% of the step)."""
    peak_a: float
    """Largest i_d after the step down (A)."""
    area_mas: float
    """Integral of positive i_d over 30 ms after it (mA s)."""
    end_a: float
    """i_d at the end (A)."""
    loss_w: float
    """Copper loss at the end of the large torque (W)."""


def torque_step(r: Response, up_s: float, down_s: float, low_nm: float, high_nm: float) -> TorqueStep:
    """Measure a step from low to high torque at ``up_s`` and back at ``down_s``; mirrored where torque is negative."""
    sign = -1.0 if low_nm + high_nm < 0.0 else 1.0
    low, high = sign * low_nm / K_T, sign * high_nm / K_T
    i_q, step = sign * r.i_q, high - low
    a, b = r.index(up_s), r.index(down_s)
    T_s = float(r.t[1] - r.t[0])
    after = r.i_d[b : b + round(AREA_S / T_s)]
    return TorqueStep(
        up_ms=settling_ms(r.t[a:b], i_q[a:b], high, STEP_BAND * step),
        down_ms=settling_ms(r.t[b:], i_q[b:], low, STEP_BAND * step),
        over_up=100.0 * max(0.0, float(i_q[a:b].max()) - high) / step,
        over_down=100.0 * max(0.0, low - float(i_q[b:].min())) / step,
        peak_a=float(r.i_d[b:].max()),
        area_mas=1e3 * T_s * float(np.maximum(after, 0.0).sum()),
        end_a=float(r.i_d[-50:].mean()),
        loss_w=machine_file().machine.R_s_ohm * float((r.i_d[b - 50 : b] ** 2 + r.i_q[b - 50 : b] ** 2).mean()),
    )


@dataclass(frozen=True, slots=True)
class Staircase:
    """Worst of several steps: overshoot (% of the step), settling (ms), peak of i_d (A, and % of the largest step)."""

    over: float
    settle_ms: float
    i_d_a: float
    i_d_percent: float


def staircase(r: Response, starts_s: Array, levels_nm: Array) -> Staircase:
    """Measure steps of the torque between ``levels_nm``, shape (n,), at ``starts_s``, shape (n - 1,)."""
    levels = levels_nm / K_T
    ends = [*(r.index(t) for t in starts_s), len(r.t)]
    over, settle = 0.0, 0.0
    for k in range(1, len(levels)):
        a, b = ends[k - 1], ends[k]
        step = levels[k] - levels[k - 1]
        beyond = (r.i_q[a:b] - levels[k]) * np.sign(step)
        over = max(over, 100.0 * float(beyond.max()) / abs(step))
        settle = max(settle, settling_ms(r.t[a:b], r.i_q[a:b], float(levels[k]), STEP_BAND * abs(step)))
    first = ends[0]
    i_d, largest = float(np.abs(r.i_d[first:]).max()), float(np.abs(np.diff(levels)).max())
    return Staircase(over, settle, i_d, 100.0 * i_d / largest)


def phase_step_rms(r: Response, from_s: float) -> float:
    """Return the rms change of the phase from period to period (rad), modulo pi: V_a may be negative."""
    change = np.diff(r.delta[r.index(from_s) :])
    return float(np.sqrt(np.mean((np.mod(change + math.pi / 2, math.pi) - math.pi / 2) ** 2)))


def torque_bump(r: Response, from_s: float, to_s: float) -> float:
    """Return the largest deviation of the torque error from its mean over :data:`BUMP_S` (N m)."""
    n = round(BUMP_S / float(r.t[1] - r.t[0]))
    error = r.torque - r.torque_asked
    deviation = np.abs(error - np.convolve(error, np.full(n, 1.0 / n), "same"))
    return float(deviation[r.index(from_s) : r.index(to_s)].max())


def peak_current_apk(r: Response) -> float:
    """Return the largest magnitude of the current (A peak)."""
    return PEAK * float(np.hypot(r.i_d, r.i_q).max())


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
