# SPDX-License-Identifier: MIT
"""A recorded command is run again and compared with what its page shows."""

from __future__ import annotations

import re
from collections.abc import Sequence

import pytest

from benchmarks.recorded_sessions import RUN, as_cut, printed, with_present_run

NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
NEAREST = re.compile(r"(?<=nearest to its edge: )\S+ \w+, \d+ %")
"""Which quantity of a proof comes nearest to its edge: the noise decides, and an answer that comes a frame later, for a
rounding of this processor, meets other noise. 30 % of one quantity stood here and 33 % of another."""
SESSION_TOLERANCE = 0.05
"""How far numbers of a session may differ: last digits depend on the platform's linear algebra."""


def as_shown(line: str) -> tuple[str, list[float]]:
    """Return a line without its numbers and without the columns' widths, and its numbers."""
    line = NEAREST.sub("WHICH", RUN.sub("RUN", line))
    return " ".join(NUMBER.sub("#", line).split()), [float(text) for text in NUMBER.findall(line)]


def assert_printed(typed: str, shown: Sequence[str]) -> None:
    """Run a command in the present folder; its lines and numbers must be those shown."""
    told = as_cut(printed(with_present_run(typed)), shown)
    assert [as_shown(line)[0] for line in told] == [as_shown(line)[0] for line in shown]
    for line, expected in zip(told, shown, strict=True):
        assert as_shown(line)[1] == pytest.approx(as_shown(expected)[1], rel=SESSION_TOLERANCE), (line, expected)
