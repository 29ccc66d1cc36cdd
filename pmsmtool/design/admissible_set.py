# SPDX-License-Identifier: MIT
"""Prediction model of the reference governor and its horizon: how many voltage rows describe all of them.

State x = (i_d, i_q, I_ed, I_eq, v_d, v_q) with the integrated errors I_e (A s) and the held reference v, forward
Euler: x(k+1) = A x(k), (20); demanded voltage now w = (A_d x, A_q x + w_e psi), (26)-(27) of Jercic et al. 2017, DOI
10.1080/00051144.2018.1453441. A does not depend on speed; the rows are affine in it.

A has two eigenvalues 1 (the references), so the recursion (28)-(30) does not end by itself: a steady-state row
|w_inf| <= (1 - eps) V_max is added, and what remains is asked directly: k_max is the smallest k for which no state that
satisfies rows 0..k and the steady-state row violates row k + 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.design.loops.current_loop import CurrentGains
from pmsmtool.errors import DesignInfeasible

REDUNDANT = 1e-6
"""A row is redundant when no admissible state exceeds it by more than this share of V_max."""

HORIZON_CAP = 400
"""Horizons beyond this are reported as not finitely determined."""

START_DIRECTIONS = 8
"""Directions from which the largest next voltage is sought, before refinement to the maximum."""

_REFINEMENTS, _PULL = 12, 0.9
"""Turns of a direction towards its own optimum; share of the way a start is pulled back inside."""

_BARRIER_START, _BARRIER_GROWTH, _GAP = 1.0, 30.0, 1e-8
"""Barrier weight per disc at the start, its growth, and the remaining gap of the objective (share of V_max)."""

_NEWTON_STEPS, _NEWTON_DONE, _RIDGE, _STEP_INSIDE = 40, 1e-4, 1e-15, 0.95
"""Newton steps per weight, the decrement that ends them, the diagonal added, the share of the way to the border."""

_ROUNDING, _TINY = 1e-13, 1e-300
_RANK = 1e-11
"""Singular values below this share of the largest belong to states a voltage does not depend on."""


TAYLOR_TERMS = 14


def matrix_exponential(X: Array) -> Array:
    """Matrix exponential by its series; the entries are a period's and small."""
    total = term = np.broadcast_to(np.eye(X.shape[-1]), X.shape).copy()
    for k in range(1, TAYLOR_TERMS):
        term = term @ X / k
        total = total + term
    return total


@dataclass(frozen=True, slots=True)
class PredictionModel:
    """Machine and controller as the governor predicts them (constant parameters, Euler)."""

    R: float
    """Resistance (ohm)."""
    L_d: float
    L_q: float
    """Inductances (H)."""
    psi_f: float
    """Magnet flux linkage (Wb)."""
    T_s: float
    """Control period (s)."""
    gains_d: CurrentGains
    gains_q: CurrentGains
    """PI gains."""

    def system_matrix(self) -> Array:
        """Return A of (20), shape (6, 6)."""
        A = np.eye(6)
        for axis, (L, gains) in enumerate(((self.L_d, self.gains_d), (self.L_q, self.gains_q))):
            i, integral, v = axis, axis + 2, axis + 4
            A[i, i] -= self.T_s * (self.R + gains.K_p) / L
            A[i, integral] = self.T_s * gains.K_i / L
            A[i, v] = self.T_s * gains.K_p / L
            A[integral, i], A[integral, v] = -self.T_s, self.T_s
        return A

    def voltage_rows(self, omega_e: float) -> Array:
        """Return A_d and A_q of (27), shape (2, 6)."""
        d, q = self.gains_d, self.gains_q
        return np.array(
            [
                [-d.K_p, -omega_e * self.L_q, d.K_i, 0.0, d.K_p, 0.0],
                [omega_e * self.L_d, -q.K_p, 0.0, q.K_i, 0.0, q.K_p],
            ]
        )

    def steady_state_rows(self, omega_e: float) -> Array:
        """Return the voltage that holds v, as a function of x, shape (2, 6)."""
        rows = np.zeros((2, 6))
        rows[0, 4:] = self.R, -omega_e * self.L_q
        rows[1, 4:] = omega_e * self.L_d, self.R
        return rows

    def predicted_rows(self, omega_e: float, count: int) -> Array:
        """Return C A^j for j = 0..count - 1, shape (count, 2, 6)."""
        rows = np.empty((count, 2, 6))
        rows[0] = self.voltage_rows(omega_e)
        A = self.system_matrix()
        for j in range(1, count):
            rows[j] = rows[j - 1] @ A
        return rows

    def offset(self, omega_e: float) -> Array:
        """Return the voltage at x = 0, (0, w_e psi)."""
        return np.array([0.0, omega_e * self.psi_f])

    def closed_loop_poles(self) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Return the two poles of each axis."""
        A = self.system_matrix()
        return tuple(np.linalg.eigvals(A[np.ix_((k, k + 2), (k, k + 2))]) for k in (0, 1))  # type: ignore[return-value]

    def has_straight_segment(self) -> bool:
        """Whether both axes cancel the plant's pole at one bandwidth.

        Then without integrated error the predicted voltage moves on a straight segment from now to the steady state,
        and rows 0 and infinity are all there are.
        """
        alphas = [g.K_p / L for g, L in ((self.gains_d, self.L_d), (self.gains_q, self.L_q))]
        cancels = all(
            math.isclose(g.K_i / g.K_p, self.R / L, rel_tol=1e-9)
            for g, L in ((self.gains_d, self.L_d), (self.gains_q, self.L_q))
        )
        return cancels and math.isclose(*alphas, rel_tol=1e-9)


@dataclass(frozen=True, slots=True)
class StateBounds:
    """Limits of the states that can occur: |i|, |v| (A) and |K_i I_e - R i| (V)."""

    I_a: float
    zeta_v: float


@dataclass(frozen=True, slots=True)
class Horizon:
    """Horizon of a design."""

    k_max: int | None
    """None: not finitely determined below ``HORIZON_CAP``."""
    eps: float | None
    """Tightening of the steady-state row; None without that row."""

    @property
    def by_tolerance(self) -> bool:
        """Whether only the tolerance ``REDUNDANT`` ended the search.

        Without a tightened steady-state row later rows approach the limit for ever: what is found then is the row from
        which on they gain less than the tolerance, not a horizon.
        """
        return not self.eps and self.k_max is not None and self.k_max > 0

    @property
    def text(self) -> str:
        """The number, or that there is none."""
        if self.by_tolerance:
            return f"not finitely determined ({self.k_max} within {REDUNDANT:g})"
        return "not finitely determined" if self.k_max is None else str(self.k_max)


@lru_cache(maxsize=256)
def horizon(
    model: PredictionModel,
    omega_e: float,
    V_max: float,
    eps: float | None,
    bounds: StateBounds | None = None,
    cap: int = HORIZON_CAP,
) -> Horizon:
    """Find k_max by the global redundancy test.

    Raises DesignInfeasible: the closed loop is not stable in Euler's prediction.

    Parameters
    ----------
    model : PredictionModel
        What is predicted.
    omega_e : float
        Electrical speed (rad/s).
    V_max : float
        Voltage limit (V).
    eps : float or None
        Tightening of the steady-state row; None leaves that row out, as the paper prints it.
    bounds : StateBounds, optional
        Only states inside; all states where none are given.
    cap : int
        Largest horizon looked at.
    """
    if max(float(np.abs(poles).max()) for poles in model.closed_loop_poles()) >= 1.0:
        raise DesignInfeasible(
            "the Euler prediction of the current loop is unstable",
            where="governor",
            hint="lower the bandwidth below 2/T_s",
        )
    test = _Redundancy(model, omega_e, V_max, eps, bounds, cap)
    low, high = -1, 0
    # Horizons are short where they exist: search upwards in growing steps, then bisect.
    while test.excess(high) > REDUNDANT:
        if high == cap:
            return Horizon(None, eps)
        low, high = high, min(2 * high + 1, cap)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if test.excess(middle) <= REDUNDANT else (middle, high)
    return Horizon(high, eps)


class _Redundancy:
    """Largest |w_(k+1)| / V_max over the admissible states.

    Maximising |y| over a convex set is a sweep over directions u of max u . y: each a linear objective over discs,
    solved by a logarithmic barrier. From a direction's optimum y the next direction is y/|y|, which can only rise: the
    grid of directions leaves no error at a local maximum. (With the same poles in both axes one direction would do and
    the discs were strips; with different R/L two slow modes nearly cancel along u and reach a little further.)
    """

    def __init__(
        self,
        model: PredictionModel,
        omega_e: float,
        V_max: float,
        eps: float | None,
        bounds: StateBounds | None,
        cap: int,
    ) -> None:
        offset = model.offset(omega_e) / V_max
        predicted = model.predicted_rows(omega_e, cap + 2) / V_max
        steady = model.steady_state_rows(omega_e) / V_max
        always = [] if eps is None else [(steady, offset, 1.0 - eps)]
        if bounds is None:
            # every state may be shifted so that its steady state takes the offset up: the set is symmetric about it
            offset = np.zeros(2)
            always = [(rows, offset, radius) for rows, _, radius in always]
            states = _independent(np.concatenate((steady[None], predicted)))
            self.start: Array | None = np.zeros(states.shape[1])
        else:
            always += _bound_discs(model, bounds)
            integrals = (bounds.zeta_v / gains.K_i for gains in (model.gains_d, model.gains_q))
            states = np.diag([bounds.I_a, bounds.I_a, *integrals, bounds.I_a, bounds.I_a])
            self.start = _inner_state(model, bounds, states, predicted[0] @ states, offset, 1.0 - (eps or 0.0))
        self.rows, self.offset = predicted @ states, offset
        self.always = [(rows @ states, shift, radius) for rows, shift, radius in always]
        turn = math.pi if bounds is None else 2.0 * math.pi
        self.directions = turn * np.arange(START_DIRECTIONS) / START_DIRECTIONS

    def excess(self, k: int) -> float:
        """Return max |w_(k+1)| / V_max - 1 over the states that satisfy rows 0..k; infinity when unbounded."""
        rows, shift, radius = self._discs(k)
        target = self.rows[k + 1]
        if self.start is None:
            return -1.0
        if _unbounded(rows, target):
            return math.inf
        best = -1.0
        directions = np.stack([np.cos(self.directions), np.sin(self.directions)], axis=1)
        x = np.tile(self.start, (len(directions), 1))
        for _ in range(_REFINEMENTS):
            x = _furthest(rows, shift, radius, target, self.offset, directions, x)
            y = x @ target.T + self.offset
            size = np.hypot(y[:, 0], y[:, 1])
            best = max(best, float(size.max()) - 1.0)
            turning = (y * directions).sum(axis=1) < size * (1.0 - 1e-7)
            if best > REDUNDANT or not turning.any():
                break
            directions = (y / size[:, None])[turning]
            x = self.start + _PULL * (x[turning] - self.start)
        return best

    def _discs(self, k: int) -> tuple[Array, Array, Array]:
        """Rows (m, 2, n), centres (m, 2) and radii (m,) of the discs of horizon k."""
        rows = np.concatenate((self.rows[: k + 1], *(disc[None] for disc, _, _ in self.always)))
        shift = np.concatenate((np.tile(self.offset, (k + 1, 1)), *(s[None] for _, s, _ in self.always)))
        return rows, shift, np.concatenate((np.ones(k + 1), [r for _, _, r in self.always]))


def _unbounded(rows: Array, target: Array) -> bool:
    """Whether the target moves along a state that no disc holds."""
    flat = rows.reshape(-1, rows.shape[2])
    _, sizes, directions = np.linalg.svd(flat, full_matrices=len(flat) < flat.shape[1])
    rank = int(np.sum(sizes > _RANK * sizes[0]))
    free = directions[rank:]
    return bool(free.size and np.abs(target @ free.T).max() > _RANK * np.abs(target).max())


def _furthest(
    rows: Array, shift: Array, radius: Array, target: Array, offset: Array, directions: Array, x: Array
) -> Array:
    """Maximise each direction . (target x) over |rows x + shift| <= radius: Newton on a logarithmic barrier.

    One row of ``x`` (inside) per direction, all in step. Where one has passed the limit there is nothing left to ask.
    """
    count, n = len(rows), x.shape[1]
    flat, square = rows.reshape(-1, n), radius**2
    weight = _BARRIER_START * count
    objective = directions @ target
    while True:
        for _ in range(_NEWTON_STEPS):
            y = (x @ flat.T).reshape(len(x), -1, 2) + shift
            room = square - np.einsum("nmk,nmk->nm", y, y)
            inside = room.min(axis=1) > _ROUNDING  # else on the border to rounding: nothing left to gain
            if not inside.any():
                return x
            slack = 1.0 / np.maximum(room, _ROUNDING)
            pull = (y[:, :, 0, None] * rows[:, 0] + y[:, :, 1, None] * rows[:, 1]) * slack[:, :, None]
            gradient = weight * objective - 2.0 * pull.sum(axis=1)
            hessian = 2.0 * (flat.T * np.repeat(slack, 2, axis=1)[:, None]) @ flat
            hessian += 4.0 * pull.transpose(0, 2, 1) @ pull
            hessian += _RIDGE * np.trace(hessian, axis1=1, axis2=2)[:, None, None] * np.eye(n)
            try:
                step = np.linalg.solve(hessian, gradient[:, :, None])[:, :, 0]
            except np.linalg.LinAlgError:  # close to one disc's border all others round away: the shortest step
                step = np.stack([np.linalg.lstsq(h, g)[0] for h, g in zip(hessian, gradient, strict=True)])
            share = _STEP_INSIDE * _inside_share((step @ flat.T).reshape(len(x), -1, 2), y, square)
            x = x + np.where(inside, np.minimum(1.0, share), 0.0)[:, None] * step
            if float(np.hypot(*(x @ target.T + offset).T).max()) - 1.0 > REDUNDANT:
                return x
            if not (inside & ((gradient * step).sum(axis=1) > _NEWTON_DONE)).any():
                break
        if count <= _GAP * weight:
            return x
        weight *= _BARRIER_GROWTH


def _inside_share(step: Array, y: Array, square: Array) -> Array:
    """Largest share of each step that stays inside every disc."""
    a, b, c = (np.einsum("nmk,nmk->nm", *pair) for pair in ((step, step), (step, y), (y, y)))
    c -= square
    root = np.sqrt(np.maximum(b * b - a * c, 0.0))
    return np.asarray(((root - b) / np.maximum(a, _TINY)).min(axis=1))


def _independent(rows: Array) -> Array:
    """Return a basis of the states the voltages depend on, scaled so that rows are of size one."""
    flat = rows.reshape(-1, 6)
    scale = np.abs(flat).max(axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    _, sizes, directions = np.linalg.svd(flat / scale, full_matrices=False)
    kept = sizes > _RANK * sizes[0]
    return np.asarray((directions[kept] / scale).T / sizes[kept])


def _inner_state(
    model: PredictionModel, bounds: StateBounds, states: Array, now: Array, offset: Array, radius: float
) -> Array | None:
    """Return an equilibrium (v = i on the d axis, zeta = 0) inside every limit, in scaled states; None for none."""
    for share in np.linspace(0.0, -0.98, 99):
        current = share * bounds.I_a
        x = np.array([current, 0.0, model.R * current / model.gains_d.K_i, 0.0, current, 0.0])
        scaled = np.linalg.solve(states, x)
        if float(np.hypot(*(now @ scaled + offset))) < 0.999 * radius:
            return scaled
    return None


def _bound_discs(model: PredictionModel, bounds: StateBounds) -> list[tuple[Array, Array, float]]:
    """Discs of |i|, |v| and zeta = K_i I_e - R i, each scaled to radius one."""
    zero = np.zeros(2)
    current, reference, zeta = np.zeros((2, 6)), np.zeros((2, 6)), np.zeros((2, 6))
    for axis, gains in enumerate((model.gains_d, model.gains_q)):
        current[axis, axis] = 1.0 / bounds.I_a
        reference[axis, axis + 4] = 1.0 / bounds.I_a
        zeta[axis, axis + 2] = gains.K_i / bounds.zeta_v
        zeta[axis, axis] = -model.R / bounds.zeta_v
    return [(current, zero, 1.0), (reference, zero, 1.0), (zeta, zero, 1.0)]
