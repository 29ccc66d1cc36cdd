# SPDX-License-Identifier: MIT
"""The README says what is so: its blocks, its first session, its tables, its command reference, its Python names."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

import pmsmtool
from pmsmtool.cli.command_table import COMMANDS
from pmsmtool.cli.lazy_group import leaves
from pmsmtool.cli.main import run
from pmsmtool.cli.reference import BEGIN, END, reference, replaced
from pmsmtool.errors import ConfigError
from pmsmtool.machine.machine_keys import machine_file_keys
from pmsmtool.params.catalogue import CATALOGUE
from tests.simulated_bus import settle

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
RUN = re.compile(r"runs/\d{8}T\d{6}Z-[0-9a-f]{8}(?:-\d+)?")
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
CUT = " ⋮"
SESSION_TOLERANCE = 0.05
"""How far numbers of the session may differ: last digits depend on the platform's linear algebra."""


def fenced(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)


# ---- blocks ------------------------------------------------------------------------------------------------


def test_the_first_two_blocks_set_up_run_and_test() -> None:
    first, second = fenced("sh")[:2]
    assert first.splitlines()[0] == second.splitlines()[0] == "python3 -m venv .venv"
    assert first.splitlines()[1:] == [
        ".venv/bin/python -m pip install .",
        ".venv/bin/pmsmtool commission --sim interior-2k2 --yes",
    ]
    assert second.splitlines()[1] == ".venv/bin/python -m pip install -e '.[test]'"
    for tool in ("ruff check .", "mypy", "python -m pytest"):
        assert f".venv/bin/{tool}" in second


def test_python_blocks_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(ROOT)
    for block in fenced("python"):
        exec(compile(block, "README.md", "exec"), {})
    assert "True" in capsys.readouterr().out


# ---- the first session -------------------------------------------------------------------------------------


def session() -> Iterator[tuple[str, list[str]]]:
    """Every command of the console blocks with the lines it is said to print."""
    for block in fenced("console"):
        for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
            command, *lines = part.splitlines()
            yield command, lines


def as_shown(line: str) -> tuple[str, list[float]]:
    """A line without its numbers and without the columns' widths, and its numbers."""
    line = RUN.sub("RUN", line)
    return " ".join(NUMBER.sub("#", line).split()), [float(text) for text in NUMBER.findall(line)]


@pytest.mark.chain
def test_the_first_session_is_what_the_program_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    settle(tmp_path, monkeypatch)
    commands = list(session())
    assert commands[0][0].split()[:2] == ["pmsmtool", "commission"]
    for command, shown in commands:
        made = str(next(iter(Path("runs").iterdir()), "")) if Path("runs").exists() else ""
        capfd.readouterr()
        code = run(RUN.sub(made, command).split()[1:])
        printed = capfd.readouterr()
        assert code == 0, printed.err
        told = [*printed.err.splitlines(), *printed.out.splitlines()]
        if CUT in shown:
            cut = shown.index(CUT)
            after = len(shown) - cut - 1
            told = [*told[:cut], CUT, *told[len(told) - after :]]
        assert [as_shown(line)[0] for line in told] == [as_shown(line)[0] for line in shown]
        for line, expected in zip(told, shown, strict=True):
            assert as_shown(line)[1] == pytest.approx(as_shown(expected)[1], rel=SESSION_TOLERANCE), (line, expected)


# ---- tables ------------------------------------------------------------------------------------------------


def rows_of(title: str) -> list[list[str]]:
    section = README.split(f"\n## {title}\n", 1)[1].split("\n## ", 1)[0]
    rows = [line.strip("|").split("|") for line in section.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in row] for row in rows[2:]]


def test_every_name_of_the_symbol_table_exists() -> None:
    rows = rows_of("Symbols and units")
    assert len(rows) >= 15
    members = {row.c_name for row in CATALOGUE} | {"pmsm_cfg.lut"}
    keys = {key.name for key in machine_file_keys()} | {"design.toml", "lut.npz"}
    for row in rows:
        assert set(re.findall(r"`([^`]+)`", row[3])) <= members, row
        assert set(re.findall(r"`([^`]+)`", row[4])) <= keys, row


def test_the_python_names_are_the_documented_ones() -> None:
    named = {name for row in rows_of("From Python") for name in re.findall(r"`(\w+)", row[0])}
    assert named == set(pmsmtool.__all__)
    for name in pmsmtool.__all__:
        assert getattr(pmsmtool, name).__doc__, name
    with pytest.raises(AttributeError):
        _ = pmsmtool.nonsense


# ---- the command reference ---------------------------------------------------------------------------------


def test_the_command_reference_is_up_to_date() -> None:
    part = README.split(BEGIN, 1)[1].split(END, 1)[0].strip("\n")
    assert part == reference().strip("\n"), "run python -m pmsmtool.cli.reference --write"


def test_the_reference_names_every_command_and_option() -> None:
    text = reference()
    for typed, command in leaves(COMMANDS):
        assert f"`pmsmtool {typed}" in text
        for parameter in command.params:
            if parameter.param_type_name == "option":
                assert max(parameter.opts, key=len) in text, (typed, parameter.name)


def test_a_readme_without_markers_is_refused() -> None:
    with pytest.raises(ConfigError, match="markers"):
        replaced("# pmsmtool\n")


def test_every_command_the_readme_types_exists() -> None:
    typed = {typed.split()[0] for typed, _ in leaves(COMMANDS)}
    used = set(re.findall(r"(?:^|`|\$ )(?:\.venv/bin/)?pmsmtool ([a-z][a-z-]+)", README, re.MULTILINE))
    assert used <= typed, used - typed


def test_the_version_is_in_the_changes() -> None:
    assert f"### {pmsmtool.__version__}" in README
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["readme"] == "README.md"
