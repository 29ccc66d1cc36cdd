# SPDX-License-Identifier: MIT
"""The regression over torque pulses and its spread between the pushes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pmsmtool.estimators.estimate import CONDITION_LIMIT
from pmsmtool.estimators.refusals import refuse

Vector = NDArray[np.float64]
Push = TypeVar("Push")


def regress(columns: Sequence[Vector], measured: Vector, *, what: str, stage: str) -> Vector:
    """Return the least-squares coefficients, shape (k,); columns are scaled to unit mean square.

    Parameters
    ----------
    columns : sequence of ndarray, shape (n,)
        Regressors.
    measured : ndarray, shape (n,)
        Left side.
    what, stage : str
        What is to be told apart and where, for the refusal.

    Raises
    ------
    IdentificationError
        ``E_NOT_IDENTIFIABLE``: a column of zeros, or columns that are nearly one another's sum.
    """
    matrix = np.column_stack(columns)
    scale = np.sqrt(np.mean(matrix**2, axis=0))
    if np.any(scale == 0.0):
        raise refuse("E_NOT_IDENTIFIABLE", f"the shaft did not turn during the torque pulses, for {what}", stage=stage)
    solution, _, _, singular = np.linalg.lstsq(matrix / scale, measured, rcond=None)
    condition = float(singular[0] / singular[-1]) if singular[-1] > 0.0 else math.inf
    if condition > CONDITION_LIMIT:
        raise refuse("E_NOT_IDENTIFIABLE", f"condition {condition:.3g} of {what} together", stage=stage)
    return np.asarray(solution / scale)


def jackknife_variance(estimate: Callable[[Sequence[Push]], Vector], pushes: Sequence[Push]) -> Vector:
    """Return the variance of an estimate over pushes left out one by one, shape (k,).

    What is wrong with a push (friction, heating) is the same in all its samples, so that the samples' own scatter
    would promise too much.

    References
    ----------
    Tukey, J. W. Ann. Math. Statist. 29, 614 (1958), DOI 10.1214/aoms/1177706647.
    """
    n = len(pushes)
    without = np.array([estimate([*pushes[:k], *pushes[k + 1 :]]) for k in range(n)])
    return np.asarray((n - 1) / n * np.sum((without - without.mean(axis=0)) ** 2, axis=0))
