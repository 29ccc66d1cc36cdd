# SPDX-License-Identifier: MIT
"""The windows of the three phase pairs, on a drive whose current comes to its set-point late."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pytest

from pmsmtool.drive.port import Halves
from pmsmtool.experiments.standstill import PAIR_ARRIVED, PAIR_SHARES, hold_pairs

I_A = 10.0
PERIOD_S = 1e-4


class LateDrive:
    """A current loop that undershoots: ``short`` of the set-point is missing in the first windows after a command."""

    period_s = PERIOD_S

    def __init__(self, short: float, windows: int) -> None:
        self.short, self.windows = short, windows
        self.wanted_a, self.seen, self.taken = 0.0, 0, 0

    def command_current(self, i_d_a: float, i_q_a: float, *, fixed_angle_rad: float | None = None) -> None:
        self.wanted_a, self.seen = i_d_a, 0

    def wait(self, seconds: float) -> None:
        pass

    def average(self, signals: Sequence[str], periods: int) -> Mapping[str, float]:
        off = self.short if self.seen < self.windows else 0.0
        return {name: (1.0 - off) * self.wanted_a if name == "i_d_a" else 0.0 for name in signals}

    def halves(self, signals: Sequence[str], periods: int) -> Halves:
        row = self.average(signals, periods)
        self.seen += 1
        self.taken += 1
        return Halves(row, row, periods)


@pytest.mark.parametrize("windows", [1, 3])
def test_a_window_waits_until_the_current_is_there(windows: int) -> None:
    drive = LateDrive(0.02, windows)
    rows = hold_pairs(drive, I_A, 1.5, 0.0)  # type: ignore[arg-type]
    assert rows["i_d_a"] == pytest.approx([share * I_A for share in PAIR_SHARES] * 3, rel=PAIR_ARRIVED)
    assert drive.taken == 6 * (windows + 1)


def test_a_current_that_is_there_takes_one_window() -> None:
    drive = LateDrive(0.5 * PAIR_ARRIVED, 99)
    hold_pairs(drive, I_A, 1.5, 0.0)  # type: ignore[arg-type]
    assert drive.taken == 6
