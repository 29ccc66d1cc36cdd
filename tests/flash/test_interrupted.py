"""Interrupted downloads: old or new, never mixed, and a way back or forward.

Every 13th or 67th frame here; ``benchmarks/interrupted_downloads.py`` takes every frame.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from pmsmtool.params.parameter_set import ParameterSet
from tests.flash.interrupted import How, frames_of, interrupt
from tests.flash.rig import SMALL, with_tables


@pytest.mark.parametrize("how", ["power cut", "killed"])
@pytest.mark.parametrize(("wanted", "stride"), [(SMALL, 13), (with_tables(), 67)], ids=["small", "9x9"])
def test_drive_holds_the_old_or_the_new_set(tmp_path: Path, wanted: ParameterSet, stride: int, how: How) -> None:
    frames = frames_of(wanted, tmp_path / "whole")
    held = set()
    for run, at in enumerate(range(1, frames, stride)):
        finish = "again" if run % 2 else "restore"
        held.add(interrupt(wanted, tmp_path / str(at), at, how, finish=finish).held)  # type: ignore[arg-type]
    assert held == {"old", "new"}, "interruptions must fall on both sides of the activation"
