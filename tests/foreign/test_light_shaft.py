# SPDX-License-Identifier: MIT
"""Torque pushes on a shaft so light that the shortest ramp at the test current would go beyond its speed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np
import pytest

from pmsmtool.drive.port import Drive
from pmsmtool.experiments.polled_push import LEAST_RAMP_S, PolledPushPlan, push_both_ways
from pmsmtool.trace import Trace


class Shaft:
    """A shaft without friction that gains ``rate`` rad/s2 per ampere at once."""

    period_s = 1e-3

    def __init__(self, rate: float) -> None:
        self.rate, self.current, self.speed, self.angle, self.fastest = rate, 0.0, 0.0, 0.0, 0.0
        self.asked: list[float] = []

    def command_current(self, i_d_a: float, i_q_a: float) -> None:
        self.current = i_q_a
        self.asked.append(abs(i_q_a))

    def wait(self, seconds: float) -> None:
        gain = self.rate * self.current * seconds
        self.angle += (self.speed + 0.5 * gain) * seconds
        self.speed += gain
        self.fastest = max(self.fastest, abs(self.speed))

    def live(self, name: str) -> float:
        return self.angle

    def record(self, signals: Sequence[str], samples: int) -> Trace:
        rows = []
        for _ in range(samples):
            rows.append((self.angle, self.current))
            self.wait(self.period_s)
        angle, current = np.array(rows).T
        units = {"theta_m_rad": "rad", "i_q_a": "A"}
        return Trace(np.arange(samples) * self.period_s, {"theta_m_rad": angle, "i_q_a": current}, units, {})


@pytest.mark.parametrize("rate", [100.0, 1e3, 4e3])
def test_no_push_goes_beyond_the_plans_speed(rate: float) -> None:
    """7 A on 4e3 rad/s2/A would be 1100 rad/s after the shortest ramp, of 40 that are planned."""
    shaft, plan = Shaft(rate), PolledPushPlan(10.0, 40.0, 100.0)
    push_both_ways(cast(Drive, shaft), plan, lambda name, trace: None)
    assert shaft.fastest < 1.3 * plan.omega_m_rad_s
    if rate * 7.0 * LEAST_RAMP_S < 40.0:
        assert max(shaft.asked) == pytest.approx(7.0), "a heavier shaft is pushed as before"
