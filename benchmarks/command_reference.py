# SPDX-License-Identifier: MIT
"""The command reference of the documentation, from the commands: ``python -m benchmarks.command_reference [--write]``.

Without ``--write`` the text is printed; with it the part of docs/commands.md between the two markers is replaced. A
test compares both, so that the page cannot say what the program does not.
"""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

import click

from pmsmtool.cli.command_table import COMMANDS, Row, Section, leaves
from pmsmtool.cli.main import PROGRAM, cli, report
from pmsmtool.errors import ConfigError

PAGE = "docs/commands.md"
BEGIN = "<!-- made by python -m benchmarks.command_reference --write; do not edit -->"
END = "<!-- end of the command reference -->"

_SHARED: tuple[tuple[str, frozenset[str]], ...] = (
    ("bus", frozenset({"interface", "channel", "bitrate", "node", "sim", "trace_can"})),
    ("motion", frozenset({"i_max", "speed_max", "shaft", "serial", "load", "brake", "yes"})),
    ("write", frozenset({"serial", "yes"})),
    ("output", frozenset({"json_output", "verbose", "quiet"})),
    ("text", frozenset({"verbose", "quiet"})),
)
"""Groups of options that many commands share, named once instead of everywhere; larger groups first."""


def reference() -> str:
    """Return the reference as Markdown."""
    parts = [_shared_text()]
    for section in Section:
        rows = [row for row in COMMANDS if row.section is section]
        if rows:
            parts.append(f"## {section.value}\n")
            parts += [_command_text(typed, command) for row in rows for typed, command in leaves([row])]
    return "\n".join(parts).rstrip("\n") + "\n"


def _shared_text() -> str:
    lines = ["Options that many commands share are named by their group in brackets:", ""]
    seen: set[str] = set()
    known: dict[str | None, click.Parameter] = {}
    for row in COMMANDS:  # the first that has one: a command that moves says of --yes what the later ones leave out
        for parameter in _parameters(row):
            known.setdefault(parameter.name, parameter)
    for name, members in _SHARED:
        found = [known[member] for member in known if member in members]
        if found and not {parameter.name for parameter in found} <= seen:
            lines += _wrapped(f"- *[{name}]* " + " · ".join(_option(parameter) for parameter in found))
        elif found:
            lines.append(f"- *[{name}]* of these: " + ", ".join(f"`{_longest(parameter)}`" for parameter in found))
        seen |= {str(parameter.name) for parameter in found}
    return "\n".join([*lines, ""])


def _parameters(row: Row) -> Iterator[click.Parameter]:
    for _, command in leaves([row]):
        yield from command.params


def _command_text(typed: str, command: click.Command) -> str:
    context = click.Context(command, info_name=typed)
    pieces = [PROGRAM, typed, *(p.make_metavar(context) for p in command.params if isinstance(p, click.Argument))]
    own = [p for p in command.params if isinstance(p, click.Option) and not p.hidden]
    names = {p.name for p in own}
    groups = []
    for name, members in _SHARED:
        if members <= names:
            groups.append(f"*[{name}]*")
            names -= members
    options = [_option(p) for p in own if p.name in names]
    text = " ".join((command.help or "").split("\n\n")[0].split())
    head = f"- **`{' '.join(pieces)}`** {' '.join([*groups, text])}"
    return "\n".join([*_wrapped(head + ("  " if options else "")), *_wrapped("  " + " · ".join(options)), ""])


def _wrapped(text: str) -> list[str]:
    """Break a line of a list; two blanks at its end (a line break of Markdown) are kept."""
    lines = textwrap.wrap(text, 118, subsequent_indent="  ", break_on_hyphens=False, break_long_words=False)
    return [*lines[:-1], lines[-1] + "  "] if lines and text.endswith("  ") else lines


def _longest(parameter: click.Parameter) -> str:
    return max(parameter.opts, key=len)


def _option(parameter: click.Parameter) -> str:
    assert isinstance(parameter, click.Option)
    context = click.Context(cli)
    names = ", ".join([*parameter.opts, *parameter.secondary_opts])
    takes = "" if parameter.is_flag or parameter.count else f" {parameter.make_metavar(context)}"
    return f"`{names}{takes}` {_first_sentence(parameter.help)}"


def _first_sentence(text: str | None) -> str:
    """Return the help of an option as part of a list: without the default it may state, no capital, no stop."""
    sentence = " ".join((text or "").split("  [")[0].split()).rstrip(".")
    word = sentence.split(" ", 1)[0]
    keeps_capital = word[1:] != word[1:].lower() or len(word) == 1
    return sentence if keeps_capital else sentence[:1].lower() + sentence[1:]


def replaced(page: str) -> str:
    """Return the page with the present reference between its markers.

    Raises
    ------
    ConfigError
        The markers are not there, or not in order.
    """
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ConfigError(
            "the markers of the command reference are missing",
            where=PAGE,
            hint="put both markers of benchmarks/command_reference.py around the section",
        )
    return f"{before}{BEGIN}\n\n{reference()}\n{END}{after}"


def main(arguments: list[str]) -> int:
    """Print the reference, or write it into its page below the current folder."""
    if arguments != ["--write"]:
        click.echo(reference(), nl=False)
        return 0
    path = Path(PAGE)
    try:
        path.write_text(replaced(path.read_text(encoding="utf-8")), encoding="utf-8")
    except (OSError, ConfigError) as error:
        return report(error)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
