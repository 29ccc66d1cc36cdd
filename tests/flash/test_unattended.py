# SPDX-License-Identifier: MIT
"""What stands in for the person when several drives are written unattended."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from pmsmtool.cia402 import State
from pmsmtool.drive.motion_objects import POSITION
from pmsmtool.drive.port import Identity
from pmsmtool.errors import ConfigError, NotAvailable, SafetyRefusal, SdoAbort
from pmsmtool.flash.unattended import STILL_COUNTS, check_canary, check_drives, read_serials, wait_still

SECOND, THIRD = (Identity(node, 1, 2, 3, 100 + node, "drive", "A", "1.0") for node in (2, 3))
CANARY = {"vendor": 1, "product": 2, "revision": 3, "hardware": "A", "software": "1.0", "serial": 101}


def test_the_list_of_serial_numbers(tmp_path: Path) -> None:
    path = tmp_path / "serials.txt"
    path.write_text("# line 1\n2 102\n 3\t0x67  # spare\n\n", encoding="utf-8")
    assert read_serials(path) == {2: 102, 3: 103}
    path.write_text("2 0\nthree 103\n2 102\n", encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        read_serials(path)
    assert [line.split(":")[0] for line in caught.value.violations] == ["line 1", "line 2", "line 3"]
    path.write_text("# nothing\n", encoding="utf-8")
    with pytest.raises(ConfigError, match="it names no drive"):
        read_serials(path)


@pytest.mark.parametrize(("missing", "same"), [("prove", True), ("flash", True), ("verify", True), ("", False)])
def test_a_canary_has_proven_the_same_set(missing: str, same: bool) -> None:
    record: Any = SimpleNamespace(passed=lambda name: name != missing)
    with pytest.raises(SafetyRefusal, match=missing or "not the one that was proven"):
        check_canary(record, same_set=same, where="runs/1")
    check_canary(SimpleNamespace(passed=lambda name: True), same_set=True, where="runs/1")  # type: ignore[arg-type]


def test_a_drive_without_a_serial_number_is_none_of_the_list() -> None:
    nameless = Identity(2, 1, 2, 3, 0, "drive", "A", "1.0")
    with pytest.raises(SafetyRefusal, match="serial number 0, the list has 0"):
        check_drives([nameless], {2: 0}, CANARY)


def test_drives_are_listed_and_of_the_canary_s_kind() -> None:
    check_drives([SECOND, THIRD], {2: 102, 3: 103, 4: 104}, CANARY)
    for serials, canary, reason in (
        ({2: 102}, CANARY, "node 3: not in the list"),
        ({2: 102, 3: 999}, CANARY, "node 3: serial number 103, the list has 999"),
        ({2: 102, 3: 103}, {**CANARY, "software": "1.1"}, "node 2: software 1.0, the canary's is 1.1"),
        ({2: 102, 3: 103}, {**CANARY, "vendor": 9}, "node 3: vendor 0x1, the canary's is 0x9"),
        ({2: 102, 3: 103}, {**CANARY, "product": 9}, "node 2: product 0x2, the canary's is 0x9"),
        ({2: 102, 3: 103}, {**CANARY, "revision": 9}, "node 2: revision 0x3, the canary's is 0x9"),
        ({2: 102, 3: 103}, {**CANARY, "hardware": "B"}, "node 2: hardware A, the canary's is B"),
    ):
        with pytest.raises(SafetyRefusal, match=reason):
            check_drives([SECOND, THIRD], serials, canary)


class _Node:
    """A node that turns by some increments per look."""

    def __init__(
        self, per_look: float, state: State = State.SWITCH_ON_DISABLED, start: float = 1000.0, node: int = 2
    ) -> None:
        self.node, self._per_look, self._state, self._start, self.looks = node, per_look, state, start, 0
        self.connection = SimpleNamespace(wait=self._wait)
        self.t_s = 0.0

    def _wait(self, seconds: float) -> None:
        self.t_s += seconds

    def state(self) -> State:
        return self._state

    def other_axes(self) -> dict[int, State | None]:
        return {}

    def get(self, item: object) -> float:
        assert item == POSITION
        self.looks += 1
        return self._start + self._per_look * (self.looks - 1)


@pytest.mark.parametrize(
    ("per_look", "state", "reason"),
    [
        (STILL_COUNTS + 1.0, State.SWITCH_ON_DISABLED, r"turns: \+3 increments within 0.4 s"),
        (-STILL_COUNTS - 1.0, State.SWITCH_ON_DISABLED, "turns: -3 increments within 0.4 s"),
        (0.41, State.SWITCH_ON_DISABLED, r"turns: \+2 increments within 2 s"),
        (0.0, State.OPERATION_ENABLED, "parameters are not written"),
    ],
)
def test_a_drive_that_turns_or_may_is_refused(per_look: float, state: State, reason: str) -> None:
    """Two increments in 2 s, looked at every 0.4 s, wherever the encoder stands."""
    nodes: list[Any] = [_Node(0.0), _Node(per_look, state, -5000.0, node=3)]
    with pytest.raises(SafetyRefusal, match=reason) as caught:
        wait_still(nodes)
    assert "node 3" in caught.value.where


def test_drives_that_stand_still_are_looked_at_for_two_seconds() -> None:
    nodes: list[Any] = [_Node(0.4), _Node(-0.4, start=0.0, node=3)]
    wait_still(nodes)
    assert nodes[0].looks == nodes[1].looks == 6 and nodes[0].t_s == pytest.approx(2.0)


@pytest.mark.parametrize("error", [SdoAbort(0x06020000, 0x6064, 0, "no object"), NotAvailable("nothing")])
def test_a_drive_that_shows_no_position_is_not_written_unattended(error: Exception) -> None:
    class Blind(_Node):
        def get(self, item: object) -> float:
            raise error

    with pytest.raises(SafetyRefusal, match="does not show its position"):
        wait_still([Blind(0.0)])  # type: ignore[list-item]
