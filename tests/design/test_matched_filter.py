# SPDX-License-Identifier: MIT
"""The filter against the covariance written out, and against what it must not see."""

from __future__ import annotations

import numpy as np
import pytest

from pmsmtool.design.prediction import matched_filter

ROWS = 40
T = np.linspace(0.0, 1.0, ROWS)


def written_out(change: np.ndarray, runs: np.ndarray, variance: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
    covariance = np.cov(runs, rowvar=False) + np.diag(variance)
    weights = np.linalg.solve(covariance, change)
    return np.asarray(weights / (weights @ change))


@pytest.mark.parametrize("seed", range(5))
def test_weights_and_left_out_amplitudes_are_those_of_the_covariance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    runs = rng.standard_normal((12, ROWS)).cumsum(axis=1)
    change, variance = rng.standard_normal(ROWS), rng.uniform(0.5, 2.0, ROWS)
    weights, amplitudes = matched_filter(change, runs, variance)
    assert weights == pytest.approx(written_out(change, runs, variance), abs=1e-12)
    for k, amplitude in enumerate(amplitudes):
        others = np.delete(runs, k, axis=0)
        expected = (runs[k] - others.mean(axis=0)) @ written_out(change, others, variance)
        assert amplitude == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_what_the_runs_have_in_common_counts_for_little(seed: int) -> None:
    """A nuisance much like the change: its amplitude is 0.061 to 0.062 of what weights over the variance alone see."""
    rng = np.random.default_rng(seed)
    change, nuisance = np.exp(-5.0 * T), np.exp(-2.0 * T)
    runs = rng.standard_normal((96, 1)) * nuisance + 0.01 * rng.standard_normal((96, ROWS))
    variance = runs.var(axis=0, ddof=1) + 1e-4
    weights, amplitudes = matched_filter(change, runs, variance)
    plain = change / variance / (change**2 / variance).sum()
    assert weights @ change == pytest.approx(1.0)
    assert np.std(amplitudes) < 0.1 * np.std((runs - runs.mean(axis=0)) @ plain)
