# SPDX-License-Identifier: MIT
"""A fixed part of ``benchmarks/hostile_server.py``: random servers and drives against commands that read, and stop."""

from __future__ import annotations

from pathlib import Path
from unittest import mock

import pytest

from benchmarks.hostile_server import COMMANDS, STOP_S, Nature, examine
from pmsmtool.cli.drive_access import LOOKING_S

QUICK = (("info",), ("scan",), ("param", "get", "0x1008", "0x2042"), ("fault", "show"), ("stop",), ("stop", "--all"))


@pytest.mark.chain
@pytest.mark.wall_clock
@pytest.mark.parametrize("seed", [1, 2, 3, 4, 5, 6, 7, 9, 10, 11])
def test_commands_against_a_random_behaviour(seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PMSMTOOL_HOME", str(tmp_path))
    command = QUICK[seed % len(QUICK)]
    verdict, seconds, text = examine(1000 + seed, command, STOP_S if command[0] == "stop" else LOOKING_S)
    assert verdict.startswith("exit"), (verdict, seconds, text)


@pytest.mark.chain
def test_the_harness_sees_what_reaches_the_terminal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PMSMTOOL_HOME", str(tmp_path))
    good = dict.fromkeys(Nature.__dataclass_fields__, 0) | {
        "greeting": None, "silent_after": 1 << 40, "segments": "right", "announced": "right",
        "names": b"\x1b[2J", "status": None, "flood": False, "close_after": 1 << 40, "late_s": 0.1,
    }  # fmt: skip
    with mock.patch.object(Nature, "drawn", return_value=Nature(**good)):  # type: ignore[arg-type]
        verdict, _, text = examine(1, ("info",), LOOKING_S)
        assert (verdict, "\\x1b[2J" in text) == ("exit 0", True), text
        with (
            mock.patch("pmsmtool.drive.drive_node.one_line", lambda text: text),
            mock.patch("pmsmtool.cli.output.plain", lambda text: text),
        ):
            assert examine(1, ("info",), LOOKING_S)[0] == "CONTROL CHARACTERS"


def test_all_commands_that_only_read_are_there() -> None:
    reading = {"scan", "info", "caps", "param", "fault", "monitor", "doctor", "verify", "backup"}
    assert reading | {"stop", "flash-params", "restore"} == {command[0] for command, _ in COMMANDS}
