# SPDX-License-Identifier: MIT
"""The README says what is so: its blocks, its first session, its pictures; and it is short."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from xml.etree import ElementTree

import pytest

import pmsmtool
from benchmarks.recorded_sessions import (
    CUT,
    PICTURES,
    RUN,
    as_cut,
    printed,
    session,
    terminal_picture,
    with_present_run,
)
from tests.pages import fenced, sentences
from tests.simulated_bus import settle

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
LINES_MAX = 220
"""Of a README that is read to its end; it had 728."""
WORDS_MEDIAN_MAX, WORDS_MAX = 18, 30
"""Words of a sentence; the text measures 10 and 23."""
SESSION_TOLERANCE = 0.05
"""How far numbers of the session may differ: last digits depend on the platform's linear algebra."""


def test_the_first_two_blocks_set_up_run_and_test() -> None:
    first, second = fenced(README, "sh")[:2]
    assert first.splitlines()[0] == second.splitlines()[0] == "python3 -m venv .venv"
    assert first.splitlines()[1:] == [
        ".venv/bin/python -m pip install .",
        ".venv/bin/pmsmtool commission --sim interior-2k2 --yes",
    ]
    assert second.splitlines()[1] == ".venv/bin/python -m pip install -e '.[test]'"
    for tool in ("ruff check .", "mypy", "python -m pytest"):
        assert f".venv/bin/{tool}" in second


def test_the_readme_is_short_and_so_are_its_sentences() -> None:
    assert len(README.splitlines()) <= LINES_MAX
    lengths = sorted(len(sentence.split()) for sentence in sentences(README))
    assert len(lengths) > 30
    assert lengths[len(lengths) // 2] <= WORDS_MEDIAN_MAX
    longest = max(sentences(README), key=lambda sentence: len(sentence.split()))
    assert len(longest.split()) <= WORDS_MAX, longest


def test_what_was_not_tried_stands_before_the_first_session() -> None:
    start = README.split("\n## ")[0]
    assert "No real drive has been on this code" in start and "not tried" in start


def test_the_documentation_says_what_the_version_is() -> None:
    assert f"## {pmsmtool.__version__}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["readme"] == "README.md"


# ---- the first session and its pictures --------------------------------------------------------------------


def as_shown(line: str) -> tuple[str, list[float]]:
    """A line without its numbers and without the columns' widths, and its numbers."""
    line = RUN.sub("RUN", line)
    return " ".join(NUMBER.sub("#", line).split()), [float(text) for text in NUMBER.findall(line)]


@pytest.mark.chain
def test_the_first_session_is_what_the_program_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settle(tmp_path, monkeypatch)
    commands = session(README)
    assert commands[0][0].split()[:2] == ["pmsmtool", "commission"]
    for typed, shown in commands:
        told = as_cut(printed(with_present_run(typed)), shown)
        assert [as_shown(line)[0] for line in told] == [as_shown(line)[0] for line in shown]
        for line, expected in zip(told, shown, strict=True):
            assert as_shown(line)[1] == pytest.approx(as_shown(expected)[1], rel=SESSION_TOLERANCE), (line, expected)


def test_the_terminal_picture_is_the_recorded_session() -> None:
    drawn = (PICTURES / "session.svg").read_text(encoding="utf-8")
    assert drawn == terminal_picture(README), "run python -m benchmarks.recorded_sessions README.md"
    assert "[7/7] prove" in drawn and CUT not in drawn


def test_the_figures_are_of_the_recorded_session() -> None:
    proof = ElementTree.parse(PICTURES / "proof.svg").getroot().findtext("{*}title")
    assert proof is not None and proof.split(": ", 1)[1] in README
    envelope = (PICTURES / "torque-speed.svg").read_text(encoding="utf-8")
    assert ElementTree.fromstring(envelope).findtext("{*}title") is not None
    assert "torque / N m" in envelope and "speed / rpm" in envelope


def test_a_cut_keeps_as_many_lines_as_stood_on_both_sides() -> None:
    assert as_cut(list("abcdef"), ["1", CUT, "2", "3"]) == ["a", CUT, "e", "f"]
    assert as_cut(list("ab"), ["1"]) == ["a", "b"]
