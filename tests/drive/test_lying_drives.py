# SPDX-License-Identifier: MIT
"""A fixed part of ``benchmarks/lying_drives.py``: drives that lie, against commands that move and write."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from benchmarks.lying_drives import COMMANDS, UNKNOWABLE, VICES, Liar, case_of, examine
from tests.simulated_bus import settle

SEEDS = tuple(seed for seed in range(60) if "commission" not in case_of(seed, [])[1])[:24]


@pytest.mark.chain
@pytest.mark.parametrize("seed", SEEDS)
def test_a_lie_ends_with_a_word_and_the_voltage_off(seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settle(tmp_path, monkeypatch)
    what, code, text, wrong = examine(seed, [])
    assert not wrong, (what, code, text)


@pytest.mark.chain
def test_the_harness_sees_a_drive_that_stays_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A drive that takes the controlword and does not obey it: the stop is not confirmed."""
    settle(tmp_path, monkeypatch)
    liar = Liar(random.Random(1), {"deaf": 1})
    monkeypatch.setattr(
        "benchmarks.lying_drives.case_of",
        lambda seed, files: ("interior-2k2?nv=:memory:", "--yes jog --current 1Apk --for 0.2s", liar),
    )
    _, code, text, wrong = examine(0, [])
    assert (code, wrong, liar.energised) == (8, [], True), text


def test_every_command_that_moves_or_writes_is_there() -> None:
    words = {command.removeprefix("--yes ").split()[0] for command in COMMANDS}
    assert {
        "identify",
        "check",
        "jog",
        "move",
        "commission",
        "flash-params",
        "param",
        "restore",
        "prove",
        "map",
    } <= words
    assert UNKNOWABLE < set(VICES)
