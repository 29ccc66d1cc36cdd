# SPDX-License-Identifier: MIT
"""Interrupted downloads: old or new, never mixed, and a way back or forward.

Every 23rd or 131st frame here; ``benchmarks/interrupted_downloads.py`` takes every frame.
"""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from pmsmtool.drive import stop
from pmsmtool.drive.stop import interrupts_deferred
from pmsmtool.params.parameter_set import ParameterSet
from tests.flash.interrupted import How, frames_of, interrupt
from tests.flash.rig import SMALL, with_tables


@pytest.mark.chain
@pytest.mark.parametrize(
    ("wanted", "stride", "how"),
    [
        *((SMALL, 23, how) for how in ("power cut", "killed", "ctrl-c")),
        *((with_tables(), 131, how) for how in ("power cut", "killed")),
    ],
)
def test_drive_holds_the_old_or_the_new_set(tmp_path: Path, wanted: ParameterSet, stride: int, how: How) -> None:
    frames = frames_of(wanted, tmp_path / "whole")
    held = set()
    for run, at in enumerate(range(1, frames, stride)):
        finish = "again" if run % 2 else "restore"
        held.add(interrupt(wanted, tmp_path / str(at), at, how, finish=finish).held)  # type: ignore[arg-type]
    assert held == {"old", "new"}, "interruptions must fall on both sides of the activation"


def test_a_signal_that_is_held_says_why_and_for_how_long_and_no_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    heard: list[int] = []
    now = [100.0]
    monkeypatch.setattr(stop.time, "monotonic", lambda: now[0])
    before = signal.signal(signal.SIGTERM, lambda number, frame: heard.append(number))
    with interrupts_deferred(said.append, "storing") as noted:
        signal.raise_signal(signal.SIGINT)
        now[0] += 20.0
        signal.raise_signal(signal.SIGTERM)
        assert noted == [signal.SIGINT, signal.SIGTERM]
        assert "storing is finished first" in said[0] and "60 s" in said[0] and "40 s" in said[1]
        now[0] += 41.0
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGTERM)
        assert heard == [signal.SIGTERM], "each is handled as it was before"
    signal.signal(signal.SIGTERM, before)


def test_a_signal_that_is_ignored_stays_ignored() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with interrupts_deferred() as noted:
            signal.raise_signal(signal.SIGINT)
        assert noted == []
    finally:
        signal.signal(signal.SIGINT, before)
