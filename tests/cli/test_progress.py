# SPDX-License-Identifier: MIT
"""Progress of a chain: one line per stage for a log, a live line for a person, nothing when quiet."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import pytest

import pmsmtool
from pmsmtool.cli.output import Output, coloured
from pmsmtool.cli.progress import STEPS, StageProgress
from pmsmtool.run_directory import Stage

ROOT = Path(pmsmtool.__file__).parent
PASSED = Stage("tune", "pass", 0.0, summary="current loops 637 Hz")
PASSED_BEFORE = Stage("identify", "pass", 1.0)
NOT_AVAILABLE = Stage("prove", "not available", 0.0, note="needs a loop")
REFUSED = Stage("identify", "refused", 12.34, note="E_SNR: too little\nlikely: noise", summary="not shown")


class Terminal(io.StringIO):
    """Standard error as a person sees it."""

    def isatty(self) -> bool:
        return True


def told(out: Output) -> None:
    progress = StageProgress(out)
    progress.skip(PASSED_BEFORE, 1, 6)
    progress.skip(NOT_AVAILABLE, 6, 6)
    progress.begin("tune", 2, 6)
    progress.say("choosing a bandwidth")
    progress.pause()
    progress.resume()
    progress.say("again")
    progress.end(PASSED, 2, 6)
    progress.begin("identify", 1, 6)
    progress.end(REFUSED, 1, 6)


LINES = [
    "[1/6] identify  PASS  as recorded, not run again",
    "[6/6] prove     NOT AVAILABLE  as recorded, not run again",
    "[2/6] tune      PASS  current loops 637 Hz",
    "[1/6] identify  REFUSED  E_SNR: too little  (12.3 s)",
]


def test_one_line_per_stage_where_nobody_watches(capsys: pytest.CaptureFixture[str]) -> None:
    told(Output())
    printed = capsys.readouterr()
    assert printed.err.splitlines() == LINES and printed.out == ""


def test_every_step_with_v_and_nothing_when_quiet(capsys: pytest.CaptureFixture[str]) -> None:
    told(Output(verbosity=1))
    assert [line.strip() for line in capsys.readouterr().err.splitlines()] == [
        *LINES[:2], "choosing a bandwidth", "again", *LINES[2:],
    ]  # fmt: skip
    told(Output(verbosity=-1))
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("verbosity", [0, 1])
def test_a_live_line_on_a_terminal_that_leaves_one_line_per_stage(
    verbosity: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("NO_COLOR", "1")
    told(Output(verbosity=verbosity))
    shown = terminal.getvalue()
    assert "choosing a bandwidth" in shown and "\x1b[2K" in shown, "the live line is drawn and erased"
    for line in LINES:
        assert line in shown
    assert capsys.readouterr().out == ""


def test_text_of_a_drive_is_no_markup(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    progress = StageProgress(Output(verbosity=1))
    progress.begin("flash", 5, 6)
    progress.say("journal: [/tmp/x] [bold]y[/bold]")
    progress.pause()
    assert "[bold]y[/bold]" in terminal.getvalue()


def test_the_bar_has_share_remaining_time_and_action(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    now = [100.0]
    monkeypatch.setattr("pmsmtool.cli.progress.time.monotonic", lambda: now[0])
    progress = StageProgress(Output())
    progress.begin("prove", 7, 7)
    now[0] += 30.0
    progress.say("i_q steps of +-1 A at 600 rpm")
    progress.end(PASSED, 7, 7)
    assert "60 %" in terminal.getvalue() and "0:20 left" in terminal.getvalue()
    assert "i_q steps of +-1 A" in terminal.getvalue()


def test_an_interrupted_stage_has_no_share_and_no_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last step, in which the voltage goes off, showed 98 % and 0:00 left whatever had been reached."""
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    progress = StageProgress(Output())
    progress.begin("identify", 1, 7)
    for text in ("noise: at rest", "interrupted: stopping the machine", "voltage off, drive restored"):
        progress.say(text)
    progress.end(Stage("identify", "interrupted", 3.0), 1, 7)
    assert "1 %" in terminal.getvalue() and "98 %" not in terminal.getvalue()


def test_every_step_of_the_bar_is_said_somewhere() -> None:
    rooms = ("measurement", "experiments", "drive", "flash", "proof", "identification", "design")
    said = "".join(path.read_text() for room in rooms for path in (ROOT / room).rglob("*.py"))
    for steps in STEPS.values():
        assert [share for _, share in steps if not 0.0 < share < 1.0] == []
        starts = [start.replace("i_q steps", "i_{axis} steps").replace("i_d s", "i_{axis} s") for start, _ in steps]
        assert [start for start in starts if f'"{start}' not in said] == []


def test_verdicts_have_their_colour_on_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NO_COLOR", raising=False)
    assert coloured("[1/7] lut  PASS  PASSED") == "[1/7] lut  \x1b[32mPASS\x1b[0m  PASSED"
    monkeypatch.setenv("NO_COLOR", "1")
    assert coloured("FAIL") == "FAIL"
