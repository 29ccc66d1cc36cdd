# SPDX-License-Identifier: MIT
"""Signals as text: where the line is high, what has no number, and that a width is kept."""

from __future__ import annotations

import numpy as np
import pytest

from pmsmtool.report.plots import ASCII, BLOCKS, HEIGHT, terminal_plot


@pytest.mark.parametrize("levels", [BLOCKS, ASCII])
@pytest.mark.parametrize("count", [1, 7, 5000])
def test_a_ramp_rises_over_the_width(levels: str, count: int) -> None:
    t = np.linspace(0.0, 2.0, count)
    lines = terminal_plot(t, {"i_q_a": 3.0 * t}, {"i_q_a": "A"}, 80, levels)
    assert len(lines) == 1 + HEIGHT + 1 and all(len(line) < 80 for line in lines)
    assert lines[0] == f"i_q_a {3.0 * t[-1]:.5g} A"
    heights = [sum(levels.index(line[k]) for line in lines[1:-1]) for k in range(11, 79)]
    assert heights == sorted(heights)
    if count > 1:
        assert heights[0] == 1 and heights[-1] == HEIGHT * (len(levels) - 1) and lines[-1].endswith("2 s")


def test_what_has_no_number_is_empty_and_rounding_is_flat() -> None:
    t = np.arange(400.0)
    gap = np.where((t > 100) & (t < 200), np.nan, 1.0 + 1e-9 * np.sin(t))
    lines = terminal_plot(t, {"a": gap}, {"a": "1"}, 60)
    columns = {"".join(line[k] for line in lines[1:-1]) for k in range(11, 59)}
    assert len(columns) == 2 and "   " in columns
    assert terminal_plot(t[:1], {"a": gap[:1] * np.nan}, {"a": "1"}, 60)[0] == "a no number 1"
