# SPDX-License-Identifier: MIT
"""What a command prints: data on stdout (text or one JSON object), everything else on stderr.

Files a command writes, and the run directory or file it is given.
"""

from __future__ import annotations

import dataclasses
import enum
import math
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import click

from pmsmtool import plain_text
from pmsmtool.errors import ConfigError
from pmsmtool.files import write_file
from pmsmtool.plain_text import folded, one_line, plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def jsonable(value: Any) -> Any:
    """Return a value as plain JSON types.

    Dataclasses become objects, arrays lists, numbers stay SI numbers without formatting; what is not a finite
    number becomes null, because JSON has no other word for it.

    Raises TypeError: a type that has no obvious JSON form.
    """
    if isinstance(value, enum.Flag):
        return jsonable(value.value)
    if isinstance(value, enum.Enum):
        return value.name.lower().replace("_", "-")
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: jsonable(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(jsonable(key)): jsonable(entry) for key, entry in value.items()}
    if isinstance(value, (set, frozenset)):
        return [jsonable(entry) for entry in sorted(value)]
    if hasattr(value, "tolist"):  # a numpy array or scalar, without importing numpy here
        return jsonable(value.tolist())
    if isinstance(value, Iterable) and not isinstance(value, (bytes, bytearray)):
        return [jsonable(entry) for entry in value]
    raise TypeError(f"{type(value).__name__} has no JSON form")


def table(heads: Sequence[str], rows: Iterable[Sequence[object]], indent: int = 0) -> list[str]:
    """Return the lines of :func:`plain_text.table`, cells broken to fit a terminal or a file, behind an indent."""
    return plain_text.table(heads, rows, (terminal_width(sys.stdout) or FILE_WIDTH) - indent)


FILE_WIDTH = 120
"""Letters of a line of a table that goes to no terminal."""


def terminal_width(stream: TextIO) -> int | None:
    """Return how many letters a line of a terminal has; None where the stream is none."""
    return shutil.get_terminal_size().columns if stream.isatty() else None


def show(text: str, label: str = "", *, err: bool = False) -> None:
    """Print lines with their verdicts in colour; on a terminal broken between words to its width.

    Elsewhere a line stays one line, for programs that read it.
    """
    width = terminal_width(sys.stderr if err else sys.stdout)
    text = click.unstyle(label) + plain(text)
    if width is not None:
        text = "\n".join(part for line in text.split("\n") for part in folded(line, width))
    click.echo(coloured(text, label), err=err)


_GOOD, _PART, _BAD = "green", "yellow", "red"
_COLOURS = {
    "PASS": _GOOD, "PARTIAL": _PART, "NOT AVAILABLE": _PART, "NOT CHECKED": _PART, "WARN": _PART,
    "FAIL": _BAD, "REFUSED": _BAD, "WRONG": _BAD, "STOP NOT CONFIRMED": _BAD,
}  # fmt: skip
_VERDICT = re.compile(rf"\b(?:{'|'.join(_COLOURS)})\b")


def coloured(text: str, label: str = "") -> str:
    """Return a text with its verdicts in colour; click takes colours out where no terminal is, NO_COLOR everywhere.

    ``label`` is the beginning of the text, in colour already.
    """
    if os.environ.get("NO_COLOR"):
        return text
    body = text[len(click.unstyle(label)) :]
    return label + _VERDICT.sub(lambda found: click.style(found[0], fg=_COLOURS[found[0]]), body)


@dataclasses.dataclass(slots=True)
class Output:
    """The only way a command prints."""

    json: bool = False
    """Print one JSON object instead of text."""
    verbosity: int = 0
    """-1 quiet, 0 normal, 1 (``-v``) details, 2 (``-vv``) logs and tracebacks."""
    _status_width: int = 0

    def result(self, command: str, data: Mapping[str, Any], text: Iterable[str] | Callable[[], Iterable[str]]) -> None:
        """Print the result of a command on stdout.

        Parameters
        ----------
        command : str
            Name in the schema, ``pmsmtool.<command>/1``.
        data : mapping
            What ``--json`` prints: SI numbers, see :func:`jsonable`.
        text : lines, or a function that makes them
            What a person reads.
        """
        self._clear_status()
        if self.json:
            self.json_line(command, data)
            return
        for line in text() if callable(text) else text:
            show(line)

    def json_line(self, command: str, data: Mapping[str, Any]) -> None:
        """Print one JSON object on a line of its own (``monitor`` prints many)."""
        import json

        content = {"schema": f"pmsmtool.{command}/1", **data}
        click.echo(json.dumps(jsonable(content), allow_nan=False))

    def note(self, text: str) -> None:
        """Say a step of the work on stderr, unless quiet."""
        if self.verbosity >= 0:
            self._say(text)

    def detail(self, text: str) -> None:
        """Say on stderr what only ``-v`` wants to know."""
        if self.verbosity >= 1:
            self._say(text)

    def warn(self, text: str) -> None:
        """Say on stderr what must be read even when quiet."""
        self._say(text, click.style("warning", fg="yellow", bold=True) + ": ")

    def status(self, text: str) -> None:
        """Show progress in one line that is overwritten; nothing where stderr is no terminal."""
        if self.verbosity >= 0 and sys.stderr.isatty():
            text = one_line(text)[: shutil.get_terminal_size().columns - 1]
            click.echo(f"\r{text.ljust(self._status_width)}", nl=False, err=True)
            self._status_width = len(text)

    def _say(self, text: str, label: str = "") -> None:
        self._clear_status()
        show(text, label, err=True)

    def _clear_status(self) -> None:
        if self._status_width:
            click.echo(f"\r{' ' * self._status_width}\r", nl=False, err=True)
            self._status_width = 0


def set_up_logging(verbosity: int) -> None:
    """Send the logs of python-can and canopen to stderr from ``-v`` on, with ``-q`` errors; else none."""
    import logging

    if verbosity == 0:  # modules without their driver complain while they are looked at, whoever's adapter is meant
        if not logging.getLogger().handlers:
            logging.getLogger().addHandler(logging.NullHandler())
        return

    class Plain(logging.Formatter):
        def format(self, record: logging.LogRecord) -> str:
            return plain(super().format(record))

    levels = {-1: logging.ERROR, 1: logging.INFO}
    shown = logging.StreamHandler(sys.stderr)
    shown.setFormatter(Plain("%(levelname)s %(name)s: %(message)s"))
    logging.basicConfig(level=levels.get(verbosity, logging.DEBUG), handlers=[shown])


def save_figure(figure: Figure, path: Path) -> None:
    """Save a figure in the format of the suffix, the same bytes for the same figure.

    Raises ConfigError: a suffix matplotlib does not know, or a file that cannot be written.
    """
    import io

    import matplotlib

    suffix = figure_format(path)
    if figure.get_layout_engine() is None:
        figure.set_layout_engine("constrained")  # laid out before, for the fonts of a page
    out = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "pmsmtool", "svg.fonttype": "path"}):
        figure.savefig(out, format=suffix, metadata=_FIGURE_METADATA[suffix])
    write_file(path, out.getvalue())


_FIGURE_METADATA: dict[str, dict[str, None]] = {
    "svg": {"Date": None},
    "png": {"Software": None},
    "pdf": {"CreationDate": None},
}


def figure_format(path: Path) -> str:
    """Return the format that the suffix of a figure asks for; raises ``ConfigError`` when there is none."""
    suffix = path.suffix.lower().lstrip(".")
    if suffix not in _FIGURE_METADATA:
        raise ConfigError(f"{path.name} has no figure format", where=str(path), hint="use .svg, .png or .pdf")
    return suffix


def inside(path: Path, name: str) -> Path:
    """Return a file, or the file of that name in a run directory."""
    return path / name if path.is_dir() else path
