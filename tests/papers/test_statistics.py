# SPDX-License-Identifier: MIT
"""Settling, overshoot and paired differences on data whose answer is known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pmsmtool.papers.statistics import difference_table, lower_end, overshoot, paired, settling_s


def path(*q: float) -> np.ndarray:
    return np.array([(0.0, value) for value in q])


def test_settling_is_the_first_sample_that_stays_inside() -> None:
    i = path(0.0, 5.0, 9.9, 12.0, 10.1, 10.0)
    assert settling_s(i, (0.0, 10.0), 0.2, 1e-3) == pytest.approx(4e-3)
    assert settling_s(i, (0.0, 10.0), 20.0, 1e-3) == 0.0
    assert settling_s(i[:4], (0.0, 10.0), 0.2, 1e-3) == math.inf


def test_settling_looks_at_the_vector() -> None:
    i = np.array([(3.0, 10.0), (0.0, 10.0)])
    assert settling_s(i, (0.0, 10.0), 0.2, 1e-3) == pytest.approx(1e-3)


def test_overshoot_is_along_the_step() -> None:
    assert overshoot(path(0.0, 11.0, 10.0), (0.0, 0.0), (0.0, 10.0)) == pytest.approx(0.1)
    assert overshoot(path(0.0, 9.0), (0.0, 0.0), (0.0, 10.0)) == 0.0
    assert overshoot(np.array([(5.0, 10.0)]), (0.0, 0.0), (0.0, 10.0)) == 0.0
    assert overshoot(path(0.0, -11.0), (0.0, 0.0), (0.0, -10.0)) == pytest.approx(0.1)


def test_pairing_shows_a_small_shift_that_scatter_would_hide() -> None:
    rng = np.random.default_rng(3)
    b = rng.normal(10.0, 3.0, 200)
    a = b - 0.1 + rng.normal(0.0, 0.02, 200)
    found = paired(a, b, "mean", np.random.default_rng(1))
    assert found.low < -0.1 < found.high
    assert found.high - found.low < 0.01
    assert found.verdict == "less"
    assert paired(b, a, "mean", np.random.default_rng(1)).verdict == "more"
    unpaired = paired(a, rng.permutation(b), "mean", np.random.default_rng(1))
    assert unpaired.verdict == "nothing"


def test_the_interval_covers_as_often_as_it_says() -> None:
    rng = np.random.default_rng(5)
    hits = 0
    for _ in range(100):
        b = rng.normal(0.0, 1.0, 60)
        d = paired(b + rng.normal(0.3, 0.5, 60), b, "mean", rng)
        hits += d.low <= 0.3 <= d.high
    assert 88 <= hits <= 99  # 95 of 100 expected; measured 95


def test_a_law_that_never_settles_claims_nothing() -> None:
    a = np.array([1.0, math.inf, 2.0])
    found = paired(a, a, "median", np.random.default_rng(1))
    assert math.isnan(found.low)
    assert found.verdict == "nothing"


def test_the_table_has_a_line_per_statistic_and_repeats() -> None:
    a, b = np.arange(20.0), np.arange(20.0) + 1.0
    tables = [difference_table("t", [("x", "y", a, b)], np.random.default_rng(9)) for _ in range(2)]
    assert [row[1] for row in tables[0].rows] == ["median", "mean", "p95"]
    assert all(row[2] == pytest.approx(-1.0) and row[5] == "less" for row in tables[0].rows)
    assert tables[0] == tables[1]


def test_lower_end_lies_below_the_statistic() -> None:
    values = np.random.default_rng(2).normal(5.0, 1.0, 100)
    low = lower_end(values, "p95", np.random.default_rng(1))
    assert np.percentile(values, 80.0) < low < np.percentile(values, 95.0)
