# SPDX-License-Identifier: MIT
"""A drive whose speed and position contradict each other: `move` names it, and takes no inertia from it."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import MagicMock

import pytest

from pmsmtool.sim.foreign.behind import Behind, PositionGains
from pmsmtool.sim.foreign.drive import ForeignDrive
from pmsmtool.sim.foreign.position import PositionLoop
from tests.cli.conftest import Tool
from tests.foreign.data_sheets import Row, unknown, write_eds

MOVES: tuple[Row, ...] = (
    (0x6062, 0, "I32", "ro", ""), (0x607A, 0, "I32", "rw", "0"), (0x6081, 0, "U32", "rw", "0"),
    (0x6083, 0, "U32", "rw", "0"),
)  # fmt: skip


def unit(word: str) -> tuple[Row, ...]:
    return ((0x60A9, 0, "U32", "rw", word),) if word else ()


@pytest.mark.chain
@pytest.mark.parametrize(
    ("word", "factor", "named"),
    [
        ("0x00B44700", 1.0, False),
        ("0xFDB40300", 1.0, False),
        ("0x00B44700", 4.0, True),
        ("0xFDB44700", 0.5, True),
        ("", 4.0, False),
    ],
)
def test_a_resolution_that_the_speed_contradicts(
    tool: Tool, monkeypatch: pytest.MonkeyPatch, word: str, factor: float, named: bool
) -> None:
    """0x608F states ``factor`` times what position counts: every angle is as wrong, and nothing had told so."""
    attach = ForeignDrive.attach

    def set_up(self: ForeignDrive, dictionary: Any, *others: Any) -> None:
        attach(self, dictionary, *others)
        entry = dictionary.find(0x608F, 1)
        entry.value = entry.encode(factor * entry.number())

    monkeypatch.setattr(ForeignDrive, "attach", set_up)
    eds = write_eds(Path("x.eds"), unknown("0x2D", *MOVES, *unit(word)))
    asked = ("--yes", "move", "--by", "90deg", "--speed-max", "800rpm", "--settle", "0.2s")
    sim = ("--sim", f"interior-2k2?nv=:memory:&eds={eds}&bitrate=500000")
    code, _, said = tool(*sim, *asked)
    told = re.search("shows ([0-9.]+) times the speed", said)
    assert code == 0 and bool(told) == named, said
    if told:
        assert float(told[1]) == pytest.approx(factor, rel=0.1)  # 0.239 and 3.96 were seen
    if told and factor > 1.0:
        code, _, said = tool(*sim, *asked, "--speed", "150rpm", "--acceleration", "60", "--identify", "interior-2k2")
        assert code == 6 and "E_ENCODER" in said and "0x606C" in said, said


@pytest.mark.chain
@pytest.mark.parametrize("shown", [lambda counts: 0.0, abs])
def test_a_speed_that_shows_nothing_or_magnitudes_is_no_unit(
    tool: Tool, monkeypatch: pytest.MonkeyPatch, shown: Callable[[float], float]
) -> None:
    attach = ForeignDrive.attach

    def set_up(self: ForeignDrive, dictionary: Any, *others: Any) -> None:
        attach(self, dictionary, *others)
        entry, law = dictionary.find(0x606C, 0), self.laws[0x606C, 0].show
        entry.source = lambda: entry.encode(shown(law(self.behind)))  # type: ignore[misc, arg-type]

    monkeypatch.setattr(ForeignDrive, "attach", set_up)
    eds = write_eds(Path("x.eds"), unknown("0x2D", *MOVES, *unit("0xFDB44700")))
    sim = ("--sim", f"interior-2k2?nv=:memory:&eds={eds}")
    code, _, said = tool(*sim, "--yes", "move", "--by", "90deg", "--speed-max", "800rpm", "--settle", "0.2s")
    assert code == 0 and "times the speed" not in said, said


def test_a_derivative_part_adds_its_share_of_the_speed_of_the_error() -> None:
    """Of a Faulhaber (0x2332:02): as assumed, it acts on the following error beside the gain of the position."""
    pushed: list[float] = []
    behind = SimpleNamespace(
        position=lambda per_turn: 0.0, position_gains=PositionGains(2.0, 0.0, 10.0), velocity_ff=0.0, direction=1.0,
        acceleration_ff_s=0.0, derivative_share=0.5, push=pushed.append,
        set_up=SimpleNamespace(i_max_apk=1e6, torque_constant=1.0),
    )  # fmt: skip
    loop = PositionLoop(cast(Behind, behind), MagicMock(), MagicMock(), MagicMock(), 4096.0, 60.0, 1e-3)
    loop._running, loop._enabled = True, lambda: True  # type: ignore[method-assign]
    for demand in (0.0, 0.001, 0.001):
        loop._reference = lambda demand=demand: (demand, 0.0, 0.0)  # type: ignore[method-assign, misc]
        loop._tick()
    error = 2.0 * math.pi * 0.001
    assert pushed == pytest.approx([0.0, 2.0 * (10.0 * error + 0.5 * error / 1e-3), 2.0 * 10.0 * error])
