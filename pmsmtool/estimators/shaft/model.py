# SPDX-License-Identifier: MIT
"""Whitened residual of the positions of pushes and coasting: the model behind estimate and prediction.

Sigma = s_theta^2 I + s_T^2 G G', G_kj = (k - j - 1/2) T^2/J for j < k (docs/identification.md, 3.5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pmsmtool.estimators.shaft.motion import positions

Array = NDArray[np.float64]

SHAFT = 3
"""Parameters of the shaft without drag: ln J, B, tau_c."""


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """A trace in blocks: positions (n + 1,), mean torques (n,), period; deviations of positions (n + 1,) and torque."""

    theta: Array
    torque: Array
    T: float
    theta_std: Array
    torque_std: float
    coasting: bool

    @property
    def square(self) -> Array:
        """Square of the speed in every block, with its sign (rad2/s2), shape (n,)."""
        speed = np.diff(self.theta) / self.T
        return np.asarray(speed * np.abs(speed))


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Whitened residual of all traces; a trace knows the common parameters and its own two.

    Common are ln J, B and tau_c, and with ``shared`` 4 the drag: a torque against the square of the speed, which the
    positions show well enough.
    """

    runs: Sequence[Run]
    factors: Sequence[Array]
    step: Array
    shared: int = SHAFT

    def of_run(self, k: int, x: Array) -> Array:
        """Whitened residual of one trace."""
        run, first = self.runs[k], self.shared + 2 * k
        own = np.append(x[:SHAFT], x[first : first + 2])
        torque = run.torque if self.shared == SHAFT else run.torque - x[SHAFT] * run.square
        return np.asarray(self.factors[k] @ (positions(torque, run.T, own) - run.theta))

    def residual(self, x: Array) -> Array:
        """Whitened residual, shape (n,)."""
        return np.concatenate([self.of_run(k, x) for k in range(len(self.runs))])

    def jacobian(self, x: Array) -> Array:
        """Its derivative by central differences, shape (n, k)."""
        blocks = []
        for k, run in enumerate(self.runs):
            block = np.zeros((len(run.theta), len(x)))
            for column in (*range(self.shared), self.shared + 2 * k, self.shared + 2 * k + 1):
                plus, minus = x.copy(), x.copy()
                plus[column] += self.step[column]
                minus[column] -= self.step[column]
                change = self.of_run(k, plus) - self.of_run(k, minus)
                block[:, column] = change / (plus[column] - minus[column])
            blocks.append(block)
        return np.concatenate(blocks)


def whitener(run: Run, J: float) -> Array:
    """Return the inverse of the Cholesky factor of the position residual's covariance."""
    n = len(run.theta)
    if run.torque_std == 0.0:
        return np.diag(1.0 / run.theta_std)
    lag = np.arange(n)[:, None] - np.arange(n - 1)[None, :] - 0.5
    G = np.where(lag > 0.0, lag, 0.0) * run.T**2 / J
    covariance = np.diag(run.theta_std**2) + run.torque_std**2 * (G @ G.T)
    factor = np.linalg.cholesky(covariance)
    return np.asarray(np.linalg.inv(factor))
