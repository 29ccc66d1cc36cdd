# SPDX-License-Identifier: MIT
"""The pages of docs/ say what is so: links, navigation, commands, Python blocks, tables, the command reference."""

from __future__ import annotations

import doctest
import importlib.util
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import pytest

import pmsmtool
from benchmarks.command_reference import BEGIN, END, reference, replaced
from benchmarks.recorded_sessions import arguments, session
from pmsmtool.cli.command_table import COMMANDS, leaves
from pmsmtool.cli.help_topics import EXIT_CODES
from pmsmtool.cli.main import cli
from pmsmtool.errors import ConfigError, ExitCode
from pmsmtool.machine.machine_keys import machine_file_keys
from pmsmtool.params.catalogue import CATALOGUE
from tests.pages import fenced, links, rows_of, sentences
from tests.recorded import assert_printed
from tests.simulated_bus import settle

ROOT = Path(__file__).resolve().parents[1]
PAGES = {path.name: path.read_text(encoding="utf-8") for path in sorted((ROOT / "docs").glob("*.md"))}
README = (ROOT / "README.md").read_text(encoding="utf-8")
WORDS_MAX = 30


def typed_commands(text: str) -> Iterator[str]:
    """Commands of pmsmtool in sh and console blocks and in unmarked ones, and whole ones within the text."""
    for block in [*fenced(text, "sh"), *fenced(text, "")]:
        for line in re.sub(r"\\\n\s*", " ", block).splitlines():
            if re.match(r"(\S*/)?pmsmtool ", line):
                yield line.split(" > ")[0].split(" | ")[0]
    yield from (typed for typed, _ in session(text))
    for code in re.findall(r"(?<!`)`(pmsmtool [^`\n]+)`", re.sub(r"^```.*?^```$", "", text, flags=re.M | re.S)):
        if not re.search(r"\b[A-Z_]{3,}\b(?!=)|[{…]", code):
            yield code


def parsed(typed: str) -> str:
    """Walk a typed command to its leaf and let each level's parser take its options; return the leaf's name.

    Values are not converted: files need not exist. A choice must be one.
    """
    context, rest = click.Context(cli, info_name="pmsmtool"), arguments(typed)
    command: click.Command = cli
    while True:
        values, rest, _ = command.make_parser(context).parse_args(args=list(rest))
        for parameter in command.params:
            value = values.get(parameter.name or "")
            if isinstance(parameter.type, click.Choice) and isinstance(value, str):
                parameter.type.convert(value, parameter, context)
        if not isinstance(command, click.Group) or not rest:
            return str(command.name)
        child = command.get_command(context, rest[0])
        if child is None:
            raise click.UsageError(f"no such command: {typed}")
        context, command, rest = click.Context(child, parent=context, info_name=rest[0]), child, rest[1:]


@pytest.mark.parametrize("name", [*PAGES, "README.md"])
def test_every_typed_command_exists_and_parses(name: str) -> None:
    for typed in typed_commands(PAGES.get(name, README)):
        try:
            parsed(typed)
        except (click.ClickException, ValueError) as error:
            pytest.fail(f"{name}: {typed}: {error}")


def test_a_wrong_command_is_found() -> None:
    for typed in (
        "pmsmtool comission",
        "pmsmtool lut --bound 1",
        "pmsmtool identify --method best",
        "pmsmtool map lern",
    ):
        with pytest.raises(click.ClickException):
            parsed(typed)
    assert parsed("pmsmtool param get 'current.*' --sim interior-2k2") == "get"
    assert list(typed_commands("```sh\npmsmtool -n 5 \\\n  info\n```\n`pmsmtool scan`, `pmsmtool diff RUN RUN`")) == [
        "pmsmtool -n 5  info",
        "pmsmtool scan",
    ]


def test_every_relative_link_leads_somewhere() -> None:
    for name, text in PAGES.items():
        for target in links(text):
            path = target.split("#")[0]
            if not re.match(r"https?:", target) and path:
                assert (ROOT / "docs" / path).is_file(), (name, target)
    for target in links(README):
        assert re.match(r"https?:", target) or (ROOT / target.split("#")[0]).is_file(), target


def test_every_page_is_in_the_navigation() -> None:
    named = re.findall(r"^\s+- .*: (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(named) == sorted(PAGES)


@pytest.mark.skipif(
    importlib.util.find_spec("mkdocs") is None, reason="mkdocs is not installed: pip install -e '.[docs]'"
)
def test_the_site_is_built_without_a_warning(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", str(tmp_path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "your-drive.html").is_file()


def test_no_sentence_of_a_page_is_too_long() -> None:
    for name, text in PAGES.items():
        for sentence in sentences(text.split(BEGIN)[0]):
            assert len(sentence.split()) <= WORDS_MAX, (name, sentence)


def test_the_first_steps_with_an_own_drive_are_what_the_program_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the recorded commands the two that move nothing; the rehearsal itself takes ten seconds."""
    settle(tmp_path, monkeypatch)
    commands = session(PAGES["your-drive.md"])
    assert [typed.split()[1] for typed, _ in commands] == ["machine", "info", "check", "commission"]
    for typed, shown in commands[:2]:
        assert_printed(typed, shown)


def test_the_file_of_bus_options_is_one_that_is_read_on_every_system() -> None:
    """Before, the page named `can.ini`, which python-can reads on Windows alone."""
    from can.util import CONFIG_FILES

    assert CONFIG_FILES[0] == "~/can.conf" and "the file `can.conf` in your home folder" in PAGES["your-drive.md"]


def test_python_blocks_run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(ROOT)
    for text in PAGES.values():
        for block in fenced(text, "python"):
            exec(compile(block, "docs", "exec"), {})
    assert "True" in capsys.readouterr().out


def test_the_notebook_runs_and_shows_what_it_says(monkeypatch: pytest.MonkeyPatch) -> None:
    import matplotlib as mpl

    monkeypatch.chdir(ROOT)
    mpl.use("agg")
    names: dict[str, Any] = {}
    for cell in json.loads((ROOT / "docs/governed-step.ipynb").read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), cell["id"], "exec"), names)
    assert names["held"]["off"] < 0.55 * 40.0 and names["held"]["best"] > 0.9 * 40.0
    assert len(names["top"].lines) == 2


def test_toml_blocks_are_toml() -> None:
    import tomllib

    for text in PAGES.values():
        for block in fenced(text, "toml"):
            tomllib.loads(block)


# ---- tables ------------------------------------------------------------------------------------------------


def test_every_name_of_the_symbol_table_exists() -> None:
    rows = rows_of(PAGES["symbols.md"], "# Symbols and units")
    assert len(rows) >= 15
    members = {row.c_name for row in CATALOGUE} | {"pmsm_cfg.lut"}
    keys = {key.name for key in machine_file_keys()} | {"design.toml", "lut.npz"}
    for row in rows:
        assert set(re.findall(r"`([^`]+)`", row[3])) <= members, row
        assert set(re.findall(r"`([^`]+)`", row[4])) <= keys, row


def test_the_python_names_are_the_documented_ones() -> None:
    named = {name for row in rows_of(PAGES["python.md"], "# From Python") for name in re.findall(r"`(\w+)", row[0])}
    assert named == set(pmsmtool.__all__)
    for name in pmsmtool.__all__:
        assert getattr(pmsmtool, name).__doc__, name
        for example in doctest.DocTestFinder(recurse=False).find(getattr(pmsmtool, name), name):
            assert doctest.DocTestRunner().run(example).failed == 0, name
    with pytest.raises(AttributeError):
        _ = pmsmtool.nonsense


def test_the_exit_codes_are_those_of_the_program() -> None:
    rows = {int(row[0]): row[1].replace("\\|", "|") for row in rows_of(PAGES["files.md"], "## Exit codes")}
    assert rows == {int(code): EXIT_CODES[code] for code in ExitCode}


# ---- the command reference ---------------------------------------------------------------------------------


def test_the_command_reference_is_up_to_date() -> None:
    part = PAGES["commands.md"].split(BEGIN, 1)[1].split(END, 1)[0].strip("\n")
    assert part == reference().strip("\n"), "run python -m benchmarks.command_reference --write"


def test_the_reference_names_every_command_and_option() -> None:
    text = reference()
    for typed, command in leaves(COMMANDS):
        assert f"`pmsmtool {typed}" in text
        for parameter in command.params:
            if parameter.param_type_name == "option":
                assert max(parameter.opts, key=len) in text, (typed, parameter.name)


def test_a_page_without_markers_is_refused() -> None:
    with pytest.raises(ConfigError, match="markers"):
        replaced("# pmsmtool\n")


def test_every_command_the_pages_name_exists() -> None:
    typed = {typed.split()[0] for typed, _ in leaves(COMMANDS)}
    for name, text in {**PAGES, "README.md": README}.items():
        used = set(re.findall(r"(?:`|\$ |bin/)pmsmtool ([a-z][a-z-]+)", text))
        assert used <= typed, (name, used - typed)
