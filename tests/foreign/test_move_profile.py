# SPDX-License-Identifier: MIT
"""Counts of a drive's own profile, found by its demand, where a count is coarse."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from pmsmtool.drive.guard import GuardedDrive
from pmsmtool.drive.position_drive import PositionDrive
from pmsmtool.experiments.move import SPEED_WITHIN, find_profile
from pmsmtool.units import rad_s_from_rpm

STEP_S = 1e-3


class Profile:
    """A trapezoid of 1 rpm and 1 rpm/s per count, whose demand counts 3600 per turn; the shaft follows at once."""

    rad_per_count = 2.0 * math.pi / 3600.0
    brakes_alone = False

    def __init__(self, speed_unit: float) -> None:
        self.speed_unit, self.angle, self.speed, self.target, self.looks = speed_unit, 0.0, 0.0, 0.0, 0
        self.most = self.ramp = 1.0
        self.rows: list[float] = []
        clock = SimpleNamespace(now=lambda: STEP_S * len(self.rows))
        self.node = SimpleNamespace(node=1, connection=SimpleNamespace(clock=clock))

    @property
    def samples(self) -> int:
        return len(self.rows)

    def ramp_counts(self) -> float:
        return 500.0

    def lend_profile(self, speed: int, ramp: int) -> None:
        self.most, self.ramp = self.speed_unit * speed, rad_s_from_rpm(ramp)

    def move_to(self, target: float, at_once: bool = False) -> None:
        self.target, self.looks = target, self.looks + 1

    def wait(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP_S)):
            left = self.target - self.angle
            most = min(self.most, math.sqrt(2.0 * self.ramp * abs(left)), abs(left) / STEP_S)
            wanted, step = math.copysign(most, left), self.ramp * STEP_S
            self.speed = (
                wanted if abs(wanted) <= abs(self.speed) else min(max(wanted, self.speed - step), self.speed + step)
            )
            self.angle += self.speed * STEP_S
            self.rows.append(round(self.angle / self.rad_per_count) * self.rad_per_count)

    def demanded_rad(self) -> float:
        return self.rows[-1] if self.rows else 0.0

    def lag_rad(self) -> float:
        return 0.0

    def demand_since(self, began: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        demand = np.array(self.rows[began:])
        return STEP_S * np.arange(len(demand)), demand


@pytest.mark.parametrize("rpm_per_count", [1.0, 2.0, 0.33])
def test_a_speed_between_two_coarse_counts_is_scaled_by_what_was_seen(rpm_per_count: float) -> None:
    """Aimed at 5.5 counts, 5 and 6 were tried in turn until the search gave up; in counts of 2 rpm, 40 became 44."""
    unit = rad_s_from_rpm(rpm_per_count)
    drive = Profile(unit)
    found = find_profile(
        cast(GuardedDrive, drive), cast(PositionDrive, drive), math.radians(60.0), rad_s_from_rpm(40.0), 11.6
    )
    moved = unit * found.speed_counts / rad_s_from_rpm(40.0)
    assert abs(moved - 1.0) < 2.0 * SPEED_WITHIN, f"measured 0 to 0.2 %, not {100.0 * moved - 100.0:.1f} %"
    assert found.speed_rad_s == pytest.approx(unit * found.speed_counts, rel=SPEED_WITHIN)
    assert drive.looks < 16, "measured 7 or 8"
