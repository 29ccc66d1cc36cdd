# SPDX-License-Identifier: MIT
"""Moves from rest to rest: their limits, their time by the closed form, and what they leave of a load's swing."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pmsmtool.axis.move import Profile, jerk_limited, plan
from pmsmtool.errors import ConfigError

LIMITS = Profile(20.0, 400.0, 20_000.0)


@pytest.mark.parametrize("distance", [1e-4, -0.03, 0.7, -60.0])
def test_a_move_keeps_its_limits_and_arrives(distance: float) -> None:
    move = plan(distance, LIMITS)
    t = np.linspace(0.0, move.duration_s, 40_001)
    angle, speed, acceleration = move.at(t)
    jerk = np.diff(acceleration) / np.diff(t)
    for values, limit in ((speed, LIMITS.speed), (acceleration, LIMITS.acceleration), (jerk, LIMITS.jerk)):
        assert np.max(np.abs(values)) <= limit * (1.0 + 1e-6)
    assert angle[-1] == pytest.approx(distance, rel=1e-12) and abs(speed[-1]) < 1e-9
    assert np.max(np.abs(np.gradient(angle, t)[1:-1] - speed[1:-1])) < 1e-3 * np.max(np.abs(speed))


def test_a_long_move_takes_the_time_of_the_closed_form() -> None:
    v, a, j = LIMITS.speed, LIMITS.acceleration, LIMITS.jerk
    assert plan(60.0, LIMITS).duration_s == pytest.approx(60.0 / v + v / a + a / j, rel=1e-12)
    assert plan(60.0, Profile(v, a)).duration_s == pytest.approx(60.0 / v + v / a, rel=1e-12)


def test_a_short_move_uses_the_whole_jerk() -> None:
    """Four ramps of the jerk alone: L = 2 j t^3."""
    move = plan(1e-3, LIMITS)
    assert move.duration_s == pytest.approx(4.0 * (1e-3 / (2.0 * LIMITS.jerk)) ** (1.0 / 3.0), rel=1e-12)


def test_a_ramp_of_one_period_leaves_the_load_at_rest() -> None:
    """x'' + w^2 x = acceleration of the move; half a period leaves it swinging."""
    f_a, dt = 40.0, 1e-5

    def left(ramp_s: float) -> float:
        move = plan(3.0, jerk_limited(22.0, 400.0, ramp_s))
        t = np.arange(0.0, move.duration_s + dt, dt)
        wave = np.exp(-2j * math.pi * f_a * t)
        return float(abs(np.sum(move.at(t)[2] * wave) * dt))

    assert left(1.0 / f_a) < 1e-3 * left(0.5 / f_a)


def test_no_motion_without_limits_or_distance() -> None:
    assert plan(0.0, LIMITS).duration_s == 0.0
    with pytest.raises(ConfigError, match="positive limits"):
        Profile(1.0, 0.0)
