# SPDX-License-Identifier: MIT
"""What stands in for the person when several drives are written unattended."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from pmsmtool.cia402 import State
from pmsmtool.drive.port import Identity
from pmsmtool.errors import ConfigError, SafetyRefusal
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


@pytest.mark.parametrize(("missing", "same"), [("prove", True), ("flash", True), ("", False)])
def test_a_canary_has_proven_the_same_set(missing: str, same: bool) -> None:
    record: Any = SimpleNamespace(passed=lambda name: name != missing)
    with pytest.raises(SafetyRefusal, match=missing or "not the one that was proven"):
        check_canary(record, same_set=same, where="runs/1")
    check_canary(SimpleNamespace(passed=lambda name: True), same_set=True, where="runs/1")  # type: ignore[arg-type]


def test_drives_are_listed_and_of_the_canary_s_kind() -> None:
    check_drives([SECOND, THIRD], {2: 102, 3: 103, 4: 104}, CANARY)
    for serials, canary, reason in (
        ({2: 102}, CANARY, "node 3: not in the list"),
        ({2: 102, 3: 999}, CANARY, "node 3: serial number 103, the list has 999"),
        ({2: 102, 3: 103}, {**CANARY, "software": "1.1"}, "node 2: software 1.0, the canary's is 1.1"),
    ):
        with pytest.raises(SafetyRefusal, match=reason):
            check_drives([SECOND, THIRD], serials, canary)


class _Node:
    """A node that turns by some increments per look."""

    def __init__(self, per_look: float, state: State = State.SWITCH_ON_DISABLED) -> None:
        self.node, self._per_look, self._state, self.looks = 2, per_look, state, 0
        self.connection = SimpleNamespace(wait=lambda seconds: None)

    def state(self) -> State:
        return self._state

    def get(self, item: object) -> float:
        self.looks += 1
        return self._per_look * self.looks


def test_drives_are_off_and_stand_still() -> None:
    for per_look, state, reason in (
        (STILL_COUNTS + 1.0, State.SWITCH_ON_DISABLED, "the shaft turns"),
        (0.0, State.OPERATION_ENABLED, "parameters are not written"),
    ):
        with pytest.raises(SafetyRefusal, match=reason):
            wait_still([_Node(per_look, state)])  # type: ignore[list-item]
    still = _Node(0.1 * STILL_COUNTS)
    wait_still([still])  # type: ignore[list-item]
    assert still.looks > 3
