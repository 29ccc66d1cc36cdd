# SPDX-License-Identifier: MIT
"""Before a move the shaft turns a little with little current: a loop that counts the other way runs away slowly."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest

from pmsmtool.errors import SafetyRefusal
from pmsmtool.experiments.move import TRY_CURRENTS, TRY_RAD, _try_direction

I_MAX, PER_AMPERE = 6.0, 1900.0
WAY = 2.0 * math.pi
"""The motor of a drive that was written apart from this program: 1.6e-4 kg m2."""


class Shaft:
    """A shaft behind a stiff position loop, which is drive and guard in one; ``sense`` -1: it counts the other way."""

    def __init__(self, sense: float, friction_a: float, *, has_limit: bool = True) -> None:
        self.envelope, self.rad_per_count = SimpleNamespace(i_max_apk=I_MAX), 2.0 * math.pi / 36000.0
        self.node = SimpleNamespace(node=9, connection=SimpleNamespace(clock=self))
        self.sense, self.friction_a, self.has_limit = sense, friction_a, has_limit
        self.limit, self.limits, self.enabled = I_MAX, [], False
        self.t = self.angle = self.speed = self.target = self.fastest = 0.0

    def now(self) -> float:
        return self.t

    def limit_current(self, apk: float) -> float | None:
        self.limits.append(apk)
        self.limit = apk if self.has_limit else self.limit
        return apk if self.has_limit else None

    def enable(self) -> None:
        self.enabled, self.target, self.speed = True, self.angle, 0.0

    def quick_stop(self) -> None:
        self.enabled = False

    def live(self, name: str) -> float:
        return self.sense * self.angle

    def move_to(self, angle: float) -> None:
        self.target = angle

    def wait(self, seconds: float) -> None:
        for _ in range(round(seconds / 1e-4)):
            error = self.target - self.sense * self.angle
            current = max(-self.limit, min(self.limit, 500.0 * (error - 0.02 * self.sense * self.speed)))
            held = self.speed == 0.0 and abs(current) < self.friction_a
            net = 0.0 if held else current - math.copysign(self.friction_a, self.speed or current)
            self.speed += 1e-4 * PER_AMPERE * net
            self.angle += 1e-4 * self.speed
            self.fastest, self.t = max(self.fastest, abs(self.speed)), self.t + 1e-4


def turned(shaft: Shaft, *, seen: bool = False) -> Shaft:
    both: Any = shaft
    assert _try_direction(both, both, WAY) is seen
    return shaft


def test_a_shaft_that_turns_the_other_way_is_stopped_while_it_is_slow() -> None:
    """30 rad/s; with all of the current it came to 214 rad/s and 8 turns, before its drive tripped."""
    shaft = Shaft(-1.0, 0.12)
    with pytest.raises(SafetyRefusal, match="10% of the current, the shaft turned the other way"):
        turned(shaft)
    assert not shaft.enabled and shaft.fastest < 30.0 and abs(shaft.angle) < 0.3


def test_a_healthy_shaft_turns_once_and_has_its_limit_again() -> None:
    shaft = turned(Shaft(1.0, 0.12), seen=True)
    assert shaft.limits == [TRY_CURRENTS[0] * I_MAX, I_MAX] and not shaft.enabled
    assert abs(shaft.angle) < 4.0 * TRY_RAD


def test_a_shaft_that_friction_holds_is_not_seen_to_turn() -> None:
    shaft = turned(Shaft(1.0, 5.0))
    assert shaft.limits == [*(share * I_MAX for share in TRY_CURRENTS), I_MAX] and shaft.angle == 0.0


def test_without_a_limit_to_lower_nothing_is_turned() -> None:
    shaft = turned(Shaft(-1.0, 0.12, has_limit=False))
    assert shaft.t == 0.0 and shaft.angle == 0.0
