# SPDX-License-Identifier: MIT
"""What is looked at before a drive is moved: how fast it answers, and what it would take back."""

from __future__ import annotations

import math
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.drive import objects
from pmsmtool.drive.changed_objects import OFFSETS, clear_offsets, lower_limits
from pmsmtool.drive.drive_node import LOOKS, DriveNode
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.guard import guarded
from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import DriveTimeout, SafetyRefusal, SdoAbort
from tests.drive.bench import ENVELOPE, SimBench, sim_bench
from tests.drive.table_drive import node_of


@pytest.fixture
def bench() -> Iterator[SimBench]:
    with sim_bench() as opened:
        yield opened


@pytest.mark.parametrize(("answers_s", "refused"), [([0.02] * LOOKS, False), ([0.0, 0.9] * (LOOKS // 2), True)])
def test_a_drive_that_answers_late_is_refused_at_once(
    answers_s: list[float], refused: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`check` took 114 s to refuse it, by the supervision that could not be tested."""
    with node_of({}, load_family("cia402")) as (_, node):
        left = list(answers_s)
        monkeypatch.setattr(DriveNode, "state", lambda self: self.connection.wait(left.pop()))
        if not refused:
            node.refuse_late()
            return
        with pytest.raises(DriveTimeout, match="450 ms on average and up to 900 ms; .* needs 100 ms") as caught:
            node.refuse_late()
        assert "nothing was energised" in caught.value.hint


def test_a_limit_whose_own_value_the_drive_refuses_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    """0x6073 held 1000, and its file allows 800: it was lowered, and could not be brought back (exit code 1)."""
    limit, put = objects.MAX_CURRENT_PERMILLE, DriveNode.put

    def within_800(self: DriveNode, item: DriveObject, value: float) -> None:
        if item == limit and value > 800:
            raise SdoAbort(0x06090031, item.index, item.sub, "value too high")
        put(self, item, value)

    held = {objects.RATED_CURRENT_MA: 4000, limit: 1000, objects.MAX_SPEED_RPM: 6000}
    with node_of(held, load_family("cia402")) as (table, node):
        monkeypatch.setattr(DriveNode, "put", within_800)
        drive: Any = SimpleNamespace(node=node, commands_bounded_current=True, shows_apk=math.inf)
        found = lower_limits(drive, Envelope(i_max_apk=3.0, speed_max_rad_s=100.0))
        assert found.current is None and "stays at what the drive holds" in found.refused[0]
        assert table.number(limit) == 1000


def test_what_another_master_left_to_be_added_to_commands_is_lent(bench: SimBench) -> None:
    """A torque offset of 30 % turned the machine at a command of nothing."""
    offset = OFFSETS[-1]
    bench.drive.node.put(offset, 300)
    with guarded(bench.drive, ENVELOPE):
        assert bench.drive.node.get(offset) == 0
    assert bench.drive.node.get(offset) == 300


@pytest.mark.parametrize("kept", OFFSETS)
def test_an_offset_that_cannot_be_cleared_moves_nothing(kept: DriveObject) -> None:
    with node_of(dict.fromkeys(OFFSETS, 20), load_family("cia402")) as (table, node):
        clear_offsets(node)
        assert [node.get(item) for item in OFFSETS] == [0, 0, 0]
        node.put(kept, -7)
        table.fixed[kept.index, 0] = AbortCode.READ_ONLY
        with pytest.raises(SafetyRefusal, match=f"node {node.node}, 0x{kept.index:X}:00: the drive adds -7 to every"):
            clear_offsets(node)
