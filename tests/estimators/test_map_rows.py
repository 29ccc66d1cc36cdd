# SPDX-License-Identifier: MIT
"""The inverter's error over an interval of the current: the mean of what it is on the way."""

from __future__ import annotations

import numpy as np
import pytest

from pmsmtool.estimators.flux.map_rows import mean_error, ramp

KNEE_A = 0.5
ROUNDING, SHARP = 1e-12, 0.05
"""Exact where the error is linear; a knee within an interval meets two points: measured 0.006 and 0.030 V of 1 V."""


@pytest.mark.parametrize(
    ("begin", "end", "tolerance"),
    [
        ((0.1, -0.2), (0.3, 0.05), ROUNDING), ((-0.4, 0.1), (0.4, -0.1), ROUNDING), ((2.0, 0.1), (3.0, 0.2), ROUNDING),
        ((0.0, 0.0), (2.0, 0.0), SHARP), ((-0.1, 0.3), (1.5, 0.9), SHARP),
    ],
)  # fmt: skip
def test_an_error_is_the_mean_over_the_interval(
    begin: tuple[float, float], end: tuple[float, float], tolerance: float
) -> None:
    curve = ramp(KNEE_A)
    way = np.linspace(0.0, 1.0, 20_001)[:, None]
    path = (1.0 - way) * np.array(begin) + way * np.array(end)
    expected = np.mean(np.stack(curve.error_dq_v(path[:, 0], path[:, 1], np.zeros(len(path)))), axis=1)
    found = mean_error(curve, np.array([begin, end, begin]).T)
    assert found.shape == (2, 2)
    assert found[:, 0] == pytest.approx(expected, abs=tolerance) and found[:, 1] == pytest.approx(
        found[:, 0], abs=1e-12
    )
