# SPDX-License-Identifier: MIT
"""Operating points by brute force: dense search zoomed in, on its own evaluation of the machine.

Nothing here comes from the product: the machine is a function of currents, the map is scipy's spline, and every
answer is a search over a grid that is shrunk around its best point.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Flux = Callable[[Array, Array], tuple[Array, Array]]

COLUMNS, LATER_COLUMNS, ROWS = 121, 41, 97
"""Points of the first and of the later searches along i_d, and along i_q for each of them."""

SHRINK = 0.06
"""Half width of the next search around the best column, relative to this one: more than 2 / 40, a later column's."""

ROUNDS = 9
"""0.06^9 = 1e-11 of the first width."""

BISECTIONS = 46


@dataclass(frozen=True, slots=True)
class Case:
    """A machine and its limits; ``edge`` = (i_d least, i_d largest, |i_q| largest) of the data."""

    flux: Flux
    pole_pairs: int
    R: float
    omega: float
    V: float
    I_max: float
    i_d_min: float = -math.inf
    edge: tuple[float, float, float] = (-math.inf, math.inf, math.inf)

    def torque(self, i_d: Array, i_q: Array) -> Array:
        psi_d, psi_q = self.flux(i_d, i_q)
        return np.asarray(1.5 * self.pole_pairs * (psi_d * i_q - psi_q * i_d))

    def voltage(self, i_d: Array, i_q: Array) -> Array:
        psi_d, psi_q = self.flux(i_d, i_q)
        return np.hypot(self.R * i_d - self.omega * psi_q, self.R * i_q + self.omega * psi_d)

    def on_branch(self, i_d: Array, i_q: Array) -> NDArray[np.bool_]:
        """Where torque rises with i_q, here and at i_q = 0: the tables leave the other branch of a machine out."""
        step = 1e-5 * self.I_max
        rises = self.torque(i_d, i_q + step) > self.torque(i_d, i_q - step)
        return np.asarray(rises & (self.torque(i_d, i_q * 0.0 + step) > self.torque(i_d, i_q * 0.0 - step)))

    def i_d_range(self) -> tuple[float, float]:
        return max(-self.I_max, self.i_d_min, self.edge[0]), min(self.I_max, self.edge[1])

    def i_q_reach(self, i_d: Array) -> Array:
        return np.minimum(np.sqrt(np.maximum(self.I_max**2 - i_d**2, 0.0)), self.edge[2])


def bisect(function: Callable[[Array], Array], low: Array, high: Array) -> Array:
    """Roots of columns with a sign change between low and high."""
    below = function(low) > 0.0
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        same = (function(middle) > 0.0) == below
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return 0.5 * (low + high)


def crossings(case: Case, i_d: Array, level: Callable[[Array, Array], Array]) -> tuple[Array, Array]:
    """All (i_d, i_q) inside the current limit where ``level`` changes sign along i_q."""
    reach = case.i_q_reach(i_d)
    i_q = reach * np.linspace(-1.0, 1.0, ROWS)[:, None]
    value = level(np.broadcast_to(i_d, i_q.shape), i_q)
    at = np.argwhere((value[:-1] > 0.0) != (value[1:] > 0.0))
    columns = i_d[at[:, 1]]
    low, high = i_q[at[:, 0], at[:, 1]], i_q[at[:, 0] + 1, at[:, 1]]
    return columns, bisect(lambda q: level(columns, q), low, high)


def zoom(case: Case, best_of: Callable[[Array], tuple[Array, Array, Array]]) -> tuple[float, float, float]:
    """Shrink a search along i_d; ``best_of`` gives candidates (i_d, i_q, cost). Infinite cost: no point."""
    low, high = case.i_d_range()
    # The coarsest search starts from several best columns, so that one wrong hill does not decide.
    spans, best = [(low, high)], (math.nan, math.nan, math.inf)
    for round_ in range(ROUNDS):
        found: list[tuple[float, float, float]] = []
        for start, end in spans:
            i_d, i_q, cost = best_of(np.linspace(start, end, LATER_COLUMNS if round_ else COLUMNS))
            order = np.argsort(cost)[: 40 if round_ == 0 else 1]
            found += [(float(i_d[k]), float(i_q[k]), float(cost[k])) for k in order if math.isfinite(cost[k])]
        found.sort(key=lambda point: point[2])
        if found and found[0][2] < best[2]:
            best = found[0]
        centres = [point[0] for point in found] if round_ == 0 else [best[0]]
        width = (high - low) * SHRINK ** (round_ + 1)
        spans = _apart([(max(c - width, low), min(c + width, high)) for c in centres if math.isfinite(c)], width)
        if not spans:
            break
    return best


def _apart(spans: list[tuple[float, float]], width: float) -> list[tuple[float, float]]:
    kept: list[tuple[float, float]] = []
    for span in spans:
        if all(abs(span[0] - other[0]) > 0.5 * width for other in kept):
            kept.append(span)
    return kept[:4]


def least_current(case: Case, torque: float) -> tuple[float, float, float]:
    """(i_d, i_q, |i|) of least current with the torque inside all limits; infinite when there is none."""

    def candidates(i_d: Array) -> tuple[Array, Array, Array]:
        if torque == 0.0:
            columns, i_q = i_d, np.zeros_like(i_d)
        else:
            columns, i_q = crossings(case, i_d, lambda d, q: case.torque(d, q) - torque)
        allowed = (case.voltage(columns, i_q) <= case.V) & case.on_branch(columns, i_q)
        cost = np.where(allowed, np.hypot(columns, i_q), np.inf)
        return columns, i_q, cost

    return zoom(case, candidates)


def extreme_torque(case: Case, sign: float) -> tuple[float, float, float]:
    """(i_d, i_q, torque) of the largest (sign +1) or least (-1) torque inside all limits; NaN torque: none."""

    def candidates(i_d: Array) -> tuple[Array, Array, Array]:
        reach = case.i_q_reach(i_d)
        columns, i_q = crossings(case, i_d, lambda d, q: case.voltage(d, q) - case.V)
        inside = np.linspace(-1.0, 1.0, 41)[:, None] * reach
        # along the edge of the data the torque may have an extreme of its own
        step = 1e-5 * case.I_max
        at_edge = i_d[[0, -1]]
        turning, i_q_turning = crossings(
            case, at_edge, lambda d, q: case.torque(d, q + step) - case.torque(d, q - step)
        )
        columns = np.concatenate((columns, np.broadcast_to(i_d, inside.shape).ravel(), turning))
        i_q = np.concatenate((i_q, inside.ravel(), i_q_turning))
        allowed = (case.voltage(columns, i_q) <= case.V * (1.0 + 1e-12)) & case.on_branch(columns, i_q)
        return columns, i_q, np.where(allowed, -sign * case.torque(columns, i_q), np.inf)

    i_d, i_q, cost = zoom(case, candidates)
    return i_d, i_q, -sign * cost if math.isfinite(cost) else math.nan
