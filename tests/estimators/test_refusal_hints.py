# SPDX-License-Identifier: MIT
"""A refusal names no option, command or setting that does not exist."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

import pmsmtool.estimators
from pmsmtool.cli.identify import identify_command
from pmsmtool.cli.main import cli
from pmsmtool.cli.track import track_command
from pmsmtool.identification.request import NEEDS
from pmsmtool.refusals import REFUSALS

SETTINGS = {
    "amplitude": "--i-max",
    "current (": "--i-max",
    "more current": "--i-max",
    "speed (": "--speed-max",
    "more speed": "--speed-max",
    "settling time": None,
    "number of samples": None,
    "bias": None,
    "dither": None,
    "injection": None,
}
"""What a hint may ask a person to change, and the option that does; None: nothing does."""


def texts() -> Iterator[str]:
    """Cause and next step of every refusal: the table's, and those that estimators give instead."""
    for row in REFUSALS.values():
        yield from (row.likely, row.next_step)
    for path in sorted(Path(pmsmtool.estimators.__path__[0]).glob("*.py")):
        tree = ast.parse(path.read_text())
        named = {
            target.id: ast.unparse(node.value)
            for node in tree.body
            if isinstance(node, ast.Assign)
            for target in node.targets
            if isinstance(target, ast.Name)
        }
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "refuse":
                for keyword in node.keywords:
                    if keyword.arg in ("likely", "hint"):
                        text = ast.unparse(keyword.value)
                        yield named.get(text, text)
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "_check_settled":
                yield from (named[ast.unparse(argument)] for argument in node.args if ast.unparse(argument) in named)


def options(command: click.Command) -> set[str]:
    return {name for parameter in command.params for name in parameter.opts}


TEXTS = sorted(set(texts()))


def test_the_texts_are_found() -> None:
    assert len(TEXTS) > 2 * len(REFUSALS)
    assert any("--speed-max" in text and "coast" not in text for text in TEXTS)
    assert any("--for" in text for text in TEXTS), "track's own"


@pytest.mark.parametrize("text", TEXTS)
def test_every_option_and_command_exists(text: str) -> None:
    known = options(identify_command) | options(track_command)
    assert set(re.findall(r"--[a-z][a-z-]*", text)) <= known
    for command in re.findall(r"`([^`]+)`", text):
        words = command.removeprefix("pmsmtool ").split()
        found = cli.get_command(click.Context(cli), words[0])
        assert found is not None, command
        assert words[0] != "identify" or set(words[1:]) <= set(NEEDS)


@pytest.mark.parametrize("name", REFUSALS)
def test_the_table_names_options_of_identify(name: str) -> None:
    assert set(re.findall(r"--[a-z][a-z-]*", REFUSALS[name].next_step)) <= options(identify_command)


@pytest.mark.parametrize("name", REFUSALS)
def test_what_is_to_be_changed_can_be_changed(name: str) -> None:
    step = REFUSALS[name].next_step
    for setting, option in SETTINGS.items():
        if setting in step:
            assert option is not None and option in step, f"{setting}: {step}"
