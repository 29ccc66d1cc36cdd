# SPDX-License-Identifier: MIT
"""A sample of ``benchmarks/transfers.py``: special sizes in every mode, and lossy channels, on the simulated drive."""

from __future__ import annotations

import pytest

from benchmarks.transfers import LARGEST, RATES, loss_row, size_table, special_sizes
from pmsmtool.bus.sdo import Mode

pytestmark = pytest.mark.chain


@pytest.mark.parametrize(("mode", "largest"), [(Mode.SEGMENTED, 3000), (Mode.BLOCK, LARGEST)])
def test_special_sizes_arrive_both_ways_at_the_first_try(mode: Mode, largest: int) -> None:
    """A hundredth of them; all: ``python benchmarks/transfers.py``."""
    sizes = [size for size in special_sizes()[::101] if size <= largest] + [LARGEST]
    for outcome in size_table(sizes, (mode,), lambda line: None):
        assert (outcome.right, outcome.tries) == (len(sizes), len(sizes))


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("direction", ["to drive", "from drive"])
def test_the_tool_gets_through_a_lossy_channel(rate: float, direction: str) -> None:
    """20 transfers here, 300 in the benchmark: there all at 0.1 %, and 98 % at 1 %."""
    outcome = loss_row(rate, Mode.AUTO, direction, 20)
    assert outcome.wrong == 0
    assert outcome.repeated > 0, "something was lost"
    assert outcome.right >= (20 if rate == RATES[0] else 18)


def test_by_segments_a_lost_frame_costs_the_transfer_but_is_reported() -> None:
    outcome = loss_row(RATES[0], Mode.SEGMENTED, "from drive", 20)
    assert outcome.wrong == 0
    assert 0 < outcome.reported < 20
