# SPDX-License-Identifier: MIT
"""What a user reads has the field's words: no coined term, no sentence that readers did not understand."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from tests.test_layers import parsed

ROOT = Path(__file__).resolve().parents[1]
COINED = {
    r"tiers?": "capability level",
    r"push(es|ed)?": "torque pulse",
    r"(not )?told( apart)?|tells?": "identified, not identifiable, shown, separated",
    r"nobody('s)?|somebody('s)?|whoever": "no terminal, no node, another program",
    r"(all )?(our|ours)": "the reference drive; pmsmtool",
    r"closed drives?|closed stage": "drive with fixed firmware",
    r"held design": "quantised design",
    r"ways? out": "line-circle intersection; however a command ends",
    r"lost voltage|hold voltage": "voltage model error, steady-state controller voltage",
    r"dead-man": "supervision",
    r"promise[ds]?|believe[ds]?|doubts?|claim(s|ed)?": "guarantee, predicted, no personification",
    r"borrowed": "temporarily changed",
    r"(ring|row) recorder": "the maker's name",
    r"(drives?|maps?) (says?|knows?|thinks?|wants?)": "reports, states",
    r"for its tier|as far as this drive goes": "PARTIAL: n of 7 stages ran",
}
"""Terms that this project made up, and what is written instead (docs/glossary.md)."""
NOT_UNDERSTOOD = (
    "whose proof fails when it is designed with the inductances of one bias",
    "and says what that costs",
    "come true",
    "a fifth of what was said",
    "no current shows them",
    "act as another DC link",
    "as it holds them",
    "needs a loop that is all ours",
    "hold no speed or no current",
    "is as it was",
    "can be asked for consent",
    "hold the designed bytes",
    "waved through",
)
"""Parts of sentences that readers could not follow."""
PATTERN = re.compile(
    rf"(?<![\w.'-])(?:{'|'.join(COINED)})(?![\w'=(-])|{'|'.join(map(re.escape, NOT_UNDERSTOOD))}", re.IGNORECASE
)
LONGEST_SENTENCE = 30
"""Words; most have fewer than 20."""
NO_SENTENCES = ("firmware", "papers", "sim")
"""Rooms whose long texts are C, tables and scenario files."""
PAGES = sorted([*(ROOT / "docs").glob("*.md"), ROOT / "README.md", ROOT / "firmware-params/README.md"])
SOURCES = sorted((ROOT / "pmsmtool").rglob("*.py"))


@cache
def prose(source: str) -> tuple[str, ...]:
    """String literals that a person may read: those with a blank, docstrings of commands alone; no expressions."""
    tree = parsed(source)
    unread, read = set(), []
    for node in ast.walk(tree):
        for statement in getattr(node, "body", None) or [] if not isinstance(node, (ast.Lambda, ast.IfExp)) else []:
            if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
                unread.add(statement.value)
        if isinstance(node, ast.FunctionDef) and any(".command(" in ast.unparse(d) for d in node.decorator_list):
            unread -= {first.value for first in node.body[:1] if isinstance(first, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            unread |= {part for part in node.values if isinstance(part, ast.Constant)}
            read.append("".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in node.values))
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in unread and " " in node.value:
            read.append(node.value)
    return tuple(read)


def found(text: str) -> list[str]:
    """Coined terms and sentences that are not understood, each with its surroundings."""
    return [text[max(0, match.start() - 40) : match.end() + 40] for match in PATTERN.finditer(text)]


@pytest.mark.parametrize("room", sorted({path.relative_to(ROOT / "pmsmtool").parts[0] for path in SOURCES}))
def test_no_coined_term_stands_in_what_the_program_says(room: str) -> None:
    for path in SOURCES:
        if path.relative_to(ROOT / "pmsmtool").parts[0] == room:
            source = path.read_text(encoding="utf-8")
            for text in prose(source) if PATTERN.search(source) else ():
                assert found(text) == [], path.relative_to(ROOT)


def sentences(text: str) -> Iterator[str]:
    """Parts of a message that are read in one go: up to a full stop, a colon, a semicolon, or a new line of a list."""
    yield from re.split(r"(?<=[.;:?!])\s+|\n\s*\n|\n  - |  +", text)


@pytest.mark.chain
def test_a_message_has_no_sentence_that_is_too_long_and_no_optional_plural() -> None:
    for path in SOURCES:
        if path.relative_to(ROOT / "pmsmtool").parts[0] not in NO_SENTENCES:
            for text in prose(path.read_text(encoding="utf-8")):
                long = [part for part in sentences(text) if len(part.split()) > LONGEST_SENTENCE]
                assert long == [] and not re.search(r"[a-z]\(s\)", text), path.relative_to(ROOT)


def test_no_coined_term_stands_in_the_report_s_templates() -> None:
    for path in sorted((ROOT / "pmsmtool/report/templates").iterdir()):
        if path.name.endswith(".js.j2"):
            continue
        text = re.sub(r"<script.*?</script>|\{[{%#].*?[}%#]\}", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
        assert found(text) == [], path.name


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_no_coined_term_stands_in_a_page(page: Path) -> None:
    assert found(page.read_text(encoding="utf-8")) == []


def test_a_coined_term_is_found() -> None:
    source = '''
@click.command("x")
def x_command():
    """Takes what the tier gives."""
    raise Error(f"psi {name} not told: {told(why)}", hint="our objects")
def inner():
    """The tier in a docstring of the code."""
    key = "tier"
'''
    assert [len(found(text)) for text in prose(source)] == [1, 1, 1]
    assert found("the drive says 5") and found("a map knows it") and not found("the drive map states it")
    assert list(sentences("One. Two: three; 3.5 A")) == ["One.", "Two:", "three;", "3.5 A"]
    assert found("an hour, a tool, retold, tier=inject, --tell") == []
