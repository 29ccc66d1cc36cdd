# SPDX-License-Identifier: MIT
"""The README says what is so: its blocks, its first session, its pictures; and it is short."""

from __future__ import annotations

import tomllib
from pathlib import Path
from xml.etree import ElementTree

import pytest

import pmsmtool
from benchmarks.recorded_sessions import (
    CUT,
    PICTURES,
    as_cut,
    session,
    terminal_picture,
)
from tests.pages import fenced, sentences
from tests.recorded import assert_printed
from tests.simulated_bus import settle

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
LINES_MAX = 220
"""Of a README that is read to its end; it had 728."""
WORDS_MEDIAN_MAX, WORDS_MAX = 18, 30
"""Words of a sentence; the text measures 10 and 23."""


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


@pytest.mark.chain
def test_the_first_session_is_what_the_program_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settle(tmp_path, monkeypatch)
    commands = session(README)
    assert commands[0][0].split()[:2] == ["pmsmtool", "commission"]
    for typed, shown in commands:
        assert_printed(typed, shown)


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
