# SPDX-License-Identifier: MIT
"""How much of a known change of shape a response shows, against what else varies: generalised least squares.

The weights are the change over the covariance of simulated runs (matched filter; Kay, Fundamentals of Statistical
Signal Processing, vol. 1, theorem 4.2), so that what the runs have in common among themselves, such as the shape that
an unknown dead time leaves, counts for nothing. Fewer runs than points make the covariance singular; it is
regularised with its own diagonal, as if what the runs leave out were as large again and differed from point to point.
Everything is solved between the runs (Woodbury): n by n, however many points there are.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def matched_filter(change: Array, runs: Array, variance: Array) -> tuple[Array, Array]:
    """Return the weights of a change, and the amplitude each run has by the weights of the other runs.

    Parameters
    ----------
    change : ndarray, shape (points,)
        The change of shape per unit.
    runs : ndarray, shape (n, points)
        What varies without it.
    variance : ndarray, shape (points,)
        Of a point, positive.

    Returns
    -------
    weights : ndarray, shape (points,)
        Their inner product with a deviation from the mean is its amplitude; with the change itself it is one.
    amplitudes : ndarray, shape (n,)
        Of the runs, each left out of mean and covariance.
    """
    n = len(runs)
    centred = runs - np.mean(runs, axis=0)
    scaled = centred / variance
    gram = scaled @ centred.T
    seen = scaled @ change
    power = float(np.sum(change**2 / variance))
    solved = np.linalg.solve(np.eye(n) + gram / (n - 1.0), seen) / (n - 1.0)
    weights = change / variance - solved @ scaled
    amplitudes = np.array([_left_out(k, gram, seen, power) for k in range(n)])
    return weights / max(float(weights @ change), 1e-300), amplitudes


def _left_out(k: int, gram: Array, seen: Array, power: float) -> float:
    """Amplitude of run ``k`` by the mean and the covariance of the others; in it the mean of all is the origin."""
    n = len(seen)
    others = np.arange(n) != k
    block = gram[np.ix_(others, others)]
    rows = np.mean(block, axis=0)
    block = block - rows - rows[:, None] + np.mean(rows)
    toward = seen[others] - np.mean(seen[others])
    solved = np.linalg.solve(np.eye(n - 1) + block / (n - 2.0), toward) / (n - 2.0)
    away = n / (n - 1.0)  # from the mean of the others, whose mean is -1/(n - 1) of the run
    across = gram[k, others] - np.mean(gram[k, others])
    return float(away * (seen[k] - across @ solved) / max(power - float(toward @ solved), 1e-300))
