# SPDX-License-Identifier: MIT
"""Offset of a slowly turned vector by electrical turns: its value, its spread, its doubt about friction."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pmsmtool.estimators.encoder import estimate_encoder
from pmsmtool.estimators.estimate import total_half_width
from pmsmtool.estimators.shaft.position import ASYMMETRY, FLOOR_RAD, offset_by_turns
from pmsmtool.trace import Trace

PAIRS, STEP = 3, math.radians(15.0)


def run(sign: float, offset: float, lag: float, noise: float, seed: int, start: float = 0.0) -> Trace:
    rng = np.random.default_rng(seed)
    count = round(PAIRS * 1.02 * 2.0 * math.pi / STEP) + 1
    imposed = start + sign * STEP * np.arange(count)
    theta_M = (imposed + offset - sign * lag + noise * rng.standard_normal(count)) / PAIRS
    signals = {"theta_imposed_rad": imposed, "theta_M_rad": theta_M}
    return Trace(0.03 * np.arange(count), signals, dict.fromkeys(signals, "rad"), {})


def both(offset: float, lags: tuple[float, float], noise: float = 0.0, seed: int = 0) -> tuple[Trace, Trace]:
    forward = run(1.0, offset, lags[0], noise, seed)
    return forward, run(-1.0, offset, lags[1], noise, seed + 1, start=float(forward["theta_imposed_rad"][-1]))


@pytest.mark.parametrize("offset", [0.0, 1.0, -3.1, 3.1])
def test_value_and_doubt_without_noise(offset: float) -> None:
    runs = both(offset, (0.1, 0.1))
    found = estimate_encoder(*runs)
    by_turns = offset_by_turns(found, *runs)
    assert abs(math.remainder(by_turns.value - offset, 2.0 * math.pi)) < 1e-9
    assert by_turns.std < 1e-9
    assert by_turns.systematic == pytest.approx(math.hypot(ASYMMETRY * 0.1, FLOOR_RAD))
    assert total_half_width(by_turns) < total_half_width(found.offset)


def test_friction_that_differs_between_the_senses_is_within_the_interval() -> None:
    runs = both(0.4, (0.1, 0.1 * (1.0 + 2.0 * ASYMMETRY) * 0.95))
    by_turns = offset_by_turns(estimate_encoder(*runs), *runs)
    assert 0.0 < abs(by_turns.value - 0.4) <= total_half_width(by_turns)


def test_spread_of_noise_is_covered() -> None:
    hits = 0
    for seed in range(100):
        runs = both(0.4, (0.02, 0.02), noise=0.1, seed=10 * seed)
        by_turns = offset_by_turns(estimate_encoder(*runs), *runs)
        hits += abs(by_turns.value - 0.4) <= total_half_width(by_turns)
    assert hits >= 88  # 95 %, binomial at 100: below 88 once in a thousand


def test_less_than_two_electrical_turns_keep_the_coarse_interval() -> None:
    runs = both(0.4, (0.02, 0.02))
    found = estimate_encoder(*runs)
    short = [Trace(t.t_s[:30], {n: s[:30] for n, s in t.signals.items()}, t.units, t.meta) for t in runs]
    assert offset_by_turns(found, *short) is found.offset
