# SPDX-License-Identifier: MIT
"""Least squares: a Levenberg-Marquardt that is the same everywhere, and a column-scaled linear solve.

Own code instead of an optimiser from elsewhere so that a replay gives the same bytes on every version of every
library, and so that the fit needs nothing that takes a second to import.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array

Residual = Callable[[Array], Array]

RELATIVE_STEP = 1e-5
"""Relative step of the central differences (docs/identification.md, 4)."""
DAMPING_START, DAMPING_LIMIT = 1e-3, 1e12
"""First damping, and that at which no step along the steepest descent lowers the cost any more."""


@dataclass(frozen=True, slots=True)
class Fit:
    """Result of a non-linear least-squares fit."""

    x: Array
    """Parameters. Shape (k,)."""
    residual: Array
    """Whitened residual at ``x``. Shape (n,)."""
    jacobian: NDArray[np.float64]
    """Its derivative. Shape (n, k)."""
    converged: bool
    """Whether the last step was small."""
    iterations: int
    """Accepted and rejected steps."""

    @property
    def cost(self) -> float:
        """Sum of squares of the whitened residual."""
        return float(self.residual @ self.residual)

    @property
    def dof(self) -> int:
        """Residuals minus parameters."""
        return len(self.residual) - len(self.x)


def central_jacobian(residual: Residual, x: Array, step: Array) -> NDArray[np.float64]:
    """Derivative, shape (n, k), of a residual at ``x`` by central differences of ``step``, both of shape (k,)."""
    columns = []
    for index, h in enumerate(step):
        plus, minus = x.copy(), x.copy()
        plus[index] += h
        minus[index] -= h
        columns.append((residual(plus) - residual(minus)) / (plus[index] - minus[index]))
    return np.stack(columns, axis=1)


def levenberg_marquardt(
    residual: Residual,
    x0: Array,
    scale: Array,
    *,
    iterations: int = 60,
    tolerance: float = 1e-9,
    cost_tolerance: float = 0.0,
    derivative: Callable[[Array], NDArray[np.float64]] | None = None,
) -> Fit:
    """Minimise the sum of squares of ``residual(x)``.

    Parameters
    ----------
    residual : callable
        Whitened residual, shape (n,), of a parameter vector, shape (k,).
    x0 : ndarray, shape (k,)
        Starting values.
    scale : ndarray, shape (k,)
        Typical size of each parameter; sets the difference steps (times 1e-5) and the stopping rule.
    iterations : int
        Largest number of steps.
    tolerance : float
        Stop when a step is below this, relative to ``scale``.
    cost_tolerance : float
        Stop when a step lowers the cost by less than this; 1e-4 of a whitened cost is a hundredth of a standard
        deviation.
    derivative : callable or None
        Jacobian of the residual, shape (n, k); None: central differences.

    References
    ----------
    Marquardt, J. SIAM 11, 431 (1963), DOI 10.1137/0111030.
    """
    x = np.array(x0, dtype=np.float64)
    step = RELATIVE_STEP * np.asarray(scale, dtype=np.float64)
    r = residual(x)
    cost = float(r @ r)
    slope = derivative or (lambda at: central_jacobian(residual, at, step))
    jacobian = slope(x)
    damping, converged, count = DAMPING_START, False, 0
    while count < iterations and not converged:
        count += 1
        columns = np.sqrt(np.sum(jacobian**2, axis=0))
        columns[columns == 0.0] = 1.0
        scaled = jacobian / columns
        normal = scaled.T @ scaled
        gradient = scaled.T @ r
        while True:
            delta = -np.linalg.solve(normal + damping * np.eye(len(x)), gradient) / columns
            trial = x + delta
            with np.errstate(all="ignore"):  # a step that runs away has no finite cost and is taken back
                r_trial = residual(trial)
                cost_trial = float(r_trial @ r_trial)
            small = bool(np.all(np.abs(delta) <= tolerance * scale))
            if np.isfinite(cost_trial) and cost_trial <= cost:
                gain = cost - cost_trial
                x, r, cost = trial, r_trial, cost_trial
                damping = max(damping / 10.0, 1e-12)
                jacobian = slope(x)
                converged = small or gain < cost_tolerance
                break
            if small or damping > DAMPING_LIMIT:
                converged = small
                return Fit(x, r, jacobian, converged, count)
            damping *= 10.0
    return Fit(x, r, jacobian, converged, count)


def linear_solve(
    columns: NDArray[np.float64], target: Array, weight: Array
) -> tuple[Array, NDArray[np.float64], Array, float]:
    """Weighted linear least squares with columns scaled to unit norm.

    Parameters
    ----------
    columns : ndarray, shape (n, k)
        Regressors.
    target : ndarray, shape (n,)
        Left side.
    weight : ndarray, shape (n,)
        One over the standard deviation of each row.

    Returns
    -------
    x : ndarray, shape (k,)
        Solution.
    covariance : ndarray, shape (k, k)
        Inverse of A'A for the weighted rows.
    residual : ndarray, shape (n,)
        Weighted residual, target minus model.
    condition : float
        Condition number of the scaled columns.
    """
    from pmsmtool.estimators.estimate import scaled_covariance

    weighted = columns * weight[:, None]
    rhs = target * weight
    norm = np.sqrt(np.sum(weighted**2, axis=0))
    norm[norm == 0.0] = 1.0
    solution, *_ = np.linalg.lstsq(weighted / norm, rhs, rcond=None)
    x = solution / norm
    covariance, condition = scaled_covariance(weighted)
    return x, covariance, rhs - weighted @ x, condition
