# SPDX-License-Identifier: MIT
"""What a fit does with a step that runs away."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest

from pmsmtool.arrays import Array
from pmsmtool.estimators.least_squares import levenberg_marquardt

LIMIT = 1e-6
"""Of the fitted value (1); measured: 0."""


def test_a_step_that_runs_away_is_taken_back_without_a_word() -> None:
    """The first Gauss-Newton step goes to exp(4.9e5)."""

    def residual(x: Array) -> Array:
        return np.asarray(np.exp(x) - 1e-3)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit = levenberg_marquardt(residual, np.array([-20.0]), np.array([1.0]), cost_tolerance=1e-24)
    assert fit.converged and fit.x[0] == pytest.approx(math.log(1e-3), rel=LIMIT)
