# SPDX-License-Identifier: MIT
"""A second hand at the projections of the core, in numpy binary32 and in the core's order of operations.

Used by ``governor_twin`` and ``weakening_twin`` to compare the core bit for bit. Test code only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tests.firmware.core_twin import Vector, f

ROW_TOLERANCE, PAIR_TOLERANCE, VIOLATION, STALL, SINGULAR = f(1e-6), f(1e-6), f(5e-6), f(2e-5), f(1e-6)
ROUNDS, CORNER_STEPS, NONE = 16, 6, 255
BUDGET = 17
"""Newton steps of a period."""
ZERO, ONE, TWO, HALF = f(0), f(1), f(2), f(0.5)
Symmetric = tuple[np.float32, np.float32, np.float32]
Factor = tuple[Symmetric, np.float32]


@dataclass
class Steps:
    """Newton steps so far."""

    count: int = 0


@dataclass(frozen=True)
class Row:
    dd: np.float32
    dq: np.float32
    qd: np.float32
    qq: np.float32
    c: Vector
    V: np.float32

    def voltage(self, v: Vector) -> Vector:
        return (self.dd * v[0] + self.dq * v[1]) + self.c[0], (self.qd * v[0] + self.qq * v[1]) + self.c[1]

    def change(self, step: Vector) -> Vector:
        return self.dd * step[0] + self.dq * step[1], self.qd * step[0] + self.qq * step[1]

    def transposed(self, w: Vector) -> Vector:
        return self.dd * w[0] + self.qd * w[1], self.dq * w[0] + self.qq * w[1]

    def excess(self, v: Vector) -> np.float32:
        return square(self.voltage(v)) * (ONE / (self.V * self.V)) - ONE

    def gram(self) -> Symmetric:
        """M M^T."""
        return (
            self.dd * self.dd + self.dq * self.dq,
            self.dd * self.qd + self.dq * self.qq,
            self.qd * self.qd + self.qq * self.qq,
        )

    def reference_of(self, w: Vector) -> Vector:
        inverse = ONE / (self.dd * self.qq - self.dq * self.qd)
        d, q = w[0] - self.c[0], w[1] - self.c[1]
        return (self.qq * d - self.dq * q) * inverse, (self.dd * q - self.qd * d) * inverse


def square(x: Vector) -> np.float32:
    return x[0] * x[0] + x[1] * x[1]


def dot(x: Vector, y: Vector) -> np.float32:
    return x[0] * y[0] + x[1] * y[1]


def factor(a: np.float32, b: np.float32, c: np.float32) -> Factor:
    return (a, b, c), ONE / (a * c - b * b)


def solve(S: Factor, x: Vector) -> Vector:
    (a, b, c), inverse = S
    return (c * x[0] - b * x[1]) * inverse, (a * x[1] - b * x[0]) * inverse


def times(s: Symmetric, x: Vector) -> Vector:
    return s[0] * x[0] + s[1] * x[1], s[1] * x[0] + s[2] * x[1]


def project_row(row: Row, r: Vector, steps: Steps | None = None) -> Vector:
    return project_row_from(row, r, ZERO, BUDGET, steps)[0]


def project_row_from(
    row: Row, r: Vector, multiplier: np.float32, most: int, steps: Steps | None = None
) -> tuple[Vector, np.float32]:
    """Point and multiplier after so many steps from a first guess of the multiplier."""
    steps = steps or Steps()
    a = row.voltage(r)
    power = square(a)
    if power <= row.V * row.V:
        return r, ZERO
    K, enough = row.gram(), row.V * (ONE + ROW_TOLERANCE)
    S, w, least = factor(ONE, ZERO, ONE), a, ZERO
    if multiplier > 0:
        S = factor(ONE + multiplier * K[0], multiplier * K[1], ONE + multiplier * K[2])
        w, least = solve(S, a), row.V * (ONE - ROW_TOLERANCE)
        power = square(w)
    last = min(steps.count + most, BUDGET)
    while steps.count < last:
        size = np.sqrt(power)
        if least <= size <= enough:
            break
        steps.count += 1
        multiplier = multiplier + (size - row.V) * power / (row.V * dot(w, solve(S, times(K, w))))
        multiplier, least = max(multiplier, ZERO), ZERO
        S = factor(ONE + multiplier * K[0], multiplier * K[1], ONE + multiplier * K[2])
        w = solve(S, a)
        power = square(w)
    step = row.transposed(w)
    return (r[0] - multiplier * step[0], r[1] - multiplier * step[1]), multiplier


def smallest_voltage(goal: Row, limit: Row, steps: Steps | None = None) -> Vector:
    steps = steps or Steps()
    inverse = ONE / (limit.dd * limit.qq - limit.dq * limit.qd)
    back = Row(limit.qq * inverse, -limit.dq * inverse, -limit.qd * inverse, limit.dd * inverse, (ZERO, ZERO), ONE)
    rest = goal.voltage(back.voltage((-limit.c[0], -limit.c[1])))
    B = Row(
        goal.dd * back.dd + goal.dq * back.qd,
        goal.dd * back.dq + goal.dq * back.qq,
        goal.qd * back.dd + goal.qq * back.qd,
        goal.qd * back.dq + goal.qq * back.qq,
        (ZERO, ZERO),
        ONE,
    )
    G = (B.dd * B.dd + B.qd * B.qd, B.dd * B.dq + B.qd * B.qq, B.dq * B.dq + B.qq * B.qq)
    right, enough = B.transposed(rest), limit.V * (ONE + ROW_TOLERANCE)
    mu, y, size = SINGULAR * (G[0] + G[2]), (ZERO, ZERO), ZERO
    while True:
        S = factor(G[0] + mu, G[1], G[2] + mu)
        y = solve(S, right)
        power = square(y)
        size = np.sqrt(power)
        if size <= enough or steps.count >= BUDGET:
            break
        mu = mu + (size - limit.V) * power / (limit.V * dot(y, solve(S, y)))
        steps.count += 1
    scale = -limit.V / size if size > limit.V else f(-1)
    return back.voltage((scale * y[0] - limit.c[0], scale * y[1] - limit.c[1]))


def find_corner(
    first: Row, second: Row, r: Vector, v: Vector, most: int = CORNER_STEPS, steps: Steps | None = None
) -> tuple[Vector, bool]:
    """Last point of Newton's method, and whether it is the optimum."""
    steps = steps or Steps()
    limits = first.V * first.V, second.V * second.V
    for _ in range(most):
        if steps.count >= BUDGET:
            break
        w1, w2 = first.voltage(v), second.voltage(v)
        f1, f2 = HALF * (square(w1) - limits[0]), HALF * (square(w2) - limits[1])
        n1, n2 = first.transposed(w1), second.transposed(w2)
        det = n1[0] * n2[1] - n1[1] * n2[0]
        if det * det <= SINGULAR * (square(n1) * square(n2)):
            return v, False
        inverse = ONE / det
        step = (f1 * n2[1] - f2 * n1[1]) * inverse, (f2 * n1[0] - f1 * n2[0]) * inverse
        v = v[0] - step[0], v[1] - step[1]
        steps.count += 2
        if all(
            square(row.change(step)) <= PAIR_TOLERANCE * limit
            for row, limit in zip((first, second), limits, strict=True)
        ):
            pull = r[0] - v[0], r[1] - v[1]
            l1 = (pull[0] * n2[1] - pull[1] * n2[0]) * inverse
            l2 = (pull[1] * n1[0] - pull[0] * n1[1]) * inverse
            return v, bool(l1 >= 0 and l2 >= 0)
    return v, False


def project_pair(
    first: Row, second: Row, r: Vector, outside: Vector, best: Vector, steps: Steps | None = None
) -> tuple[Vector | None, bool]:
    """Last point of the search for the corner of both rows, None where there is none, and whether it is the optimum."""
    depth = -second.excess(best)
    if depth < -VIOLATION:
        return None, False
    a, b, within = first.voltage(outside), first.voltage(best), max(depth, ZERO)
    t = ONE - np.sqrt(within / (within + second.excess(outside)))
    chord = a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])
    scale = first.V / np.sqrt(square(chord))
    start = first.reference_of((scale * chord[0], scale * chord[1]))
    return find_corner(first, second, r, start, CORNER_STEPS, steps)


Solution = tuple[Vector, list[int]]


def exchange(rows: list[Row], k: int, r: Vector, x: Vector, basis: list[int], steps: Steps) -> Solution | None:
    alone = project_row(rows[k], r, steps)
    inside = alone == r
    met = [b == NONE or bool(rows[b].excess(alone) <= VIOLATION) for b in basis]
    if all(met):
        return alone, [k, NONE]
    for j, other in enumerate(basis):
        if met[j]:
            continue
        first, second, start = (rows[other], rows[k], x) if inside else (rows[k], rows[other], alone)
        best, rest = smallest_voltage(second, first, steps), basis[1 - j]
        both, found = project_pair(first, second, r, start, best, steps)
        if both is not None and found and (rest == NONE or rows[rest].excess(both) <= VIOLATION):
            return both, [k, other]
    return None


def project_rows(
    rows: list[Row], r: Vector, start: Solution | None = None, steps: Steps | None = None
) -> Solution | None:
    """Point and active rows, the one added last first; None when the rows have no common point."""
    steps = steps or Steps()
    x, basis = (r, [NONE, NONE]) if start is None else start
    for _ in range(ROUNDS):
        values = [row.excess(x) for row in rows]
        k = int(np.argmax(values))
        if values[k] <= VIOLATION or (k in basis and values[k] <= STALL):
            return x, basis
        found = None if k in basis else exchange(rows, k, r, x, basis, steps)
        if found is None:
            return None
        x, basis = found
    return None


def row_share(row: Row, p: Vector, way: Vector, slack: np.float32) -> np.float32:
    a = row.voltage(p)
    e = row.dd * way[0] + row.dq * way[1], row.qd * way[0] + row.qq * way[1]
    aa, bb, limit = square(e), a[0] * e[0] + a[1] * e[1], row.V * row.V
    cc = square(a) - limit
    if cc > slack * limit:
        return f(-1)
    cc = min(cc, ZERO)
    root = np.sqrt(bb * bb - aa * cc)
    if bb > 0:
        return -cc / (bb + root)
    return (root - bb) / aa if aa > 0 else ONE


def scale_voltage(row: Row, v: Vector) -> Vector:
    w = row.voltage(v)
    inverse = (ONE - row.V / np.sqrt(square(w))) / (row.dd * row.qq - row.dq * row.qd)
    return (v[0] - (row.qq * w[0] - row.dq * w[1]) * inverse, v[1] - (row.dd * w[1] - row.qd * w[0]) * inverse)
