# SPDX-License-Identifier: MIT
"""TOML files: the one reader, so that each bad file ends in the same clear error; the one writer; lines of keys.

Same tables, same bytes: keys in the order given, floats as the shortest text that reads back to the same number, no
dates, no trailing blanks, LF line ends.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pmsmtool.errors import ConfigError, next_step
from pmsmtool.files import read_text

NEXT_STEP = "correct the text there; https://toml.io shows the format"

LARGEST_WHOLE = 1 << 63
"""Whole numbers of TOML 1.0 have 64 bit; the standard library takes any, which no float holds."""

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_LINE_LENGTH = 110
"""Arrays longer than this are broken over lines."""

_ESCAPES = {'"': '\\"', "\\": "\\\\", "\b": "\\b", "\t": "\\t", "\n": "\\n", "\f": "\\f", "\r": "\\r"}

_TABLE_LINE = re.compile(r"\s*\[([^\[\]]+)\]")
_KEY_LINE = re.compile(r"""\s*("[^"]*"|'[^']*'|[A-Za-z0-9_-]+)\s*=""")
_NAME_PART = re.compile(r""""([^"]*)"|'([^']*)'|([A-Za-z0-9_-]+)""")


@next_step(NEXT_STEP)
def parse_toml(text: str, *, where: str) -> dict[str, Any]:
    """Return the tables of a TOML text. Raises ConfigError: not TOML, or a whole number beyond 64 bit."""
    try:
        tables = tomllib.loads(text.removeprefix("\ufeff"))  # Windows editors begin UTF-8 with this mark
    except (ValueError, RecursionError) as error:  # beside its own error: numbers of 5000 digits, brackets 1000 deep
        likely = "a missing quote or bracket, or a decimal comma"
        likely = "it is JSON, as a backup or the record of a run" if text.lstrip().startswith("{") else likely
        raise ConfigError(f"the file is not TOML: {error}", where=where, likely=likely) from None
    for name, number in _whole_numbers(tables, ""):
        if not -LARGEST_WHOLE <= number < LARGEST_WHOLE:
            raise ConfigError("is a whole number beyond the 64 bit of TOML", where=f"{where}:{name}")
    return tables


def read_toml(path: Path, *, hint: str = "check the path") -> dict[str, Any]:
    """Return the tables of a TOML file. Raises ConfigError: missing, unreadable, or as :func:`parse_toml`."""
    return parse_toml(read_text(path, hint=hint), where=str(path))


def refuse_schema(found: object, *known: str, where: str, likely: str = "", hint: str = "") -> None:
    """Refuse a file of another schema than those that are known; raises ``ConfigError``."""
    if found not in known:
        said = "has no schema" if found is None else f"schema is {found!r}"
        what = f"{said}, expected {' or '.join(map(repr, known))}"
        raise ConfigError(what, where=where, likely=likely, hint=hint)


def written_value(text: str) -> Any:
    """Return the value of ``KEY=VALUE`` as TOML reads it; what is no TOML is text."""
    try:
        return tomllib.loads(f"x = {text}")["x"]
    except (ValueError, RecursionError):
        return text.strip()


def _whole_numbers(value: Any, name: str) -> Iterator[tuple[str, int]]:
    if isinstance(value, dict):
        for key, entry in value.items():
            yield from _whole_numbers(entry, f"{name}.{key}" if name else key)
    elif isinstance(value, list):
        for entry in value:
            yield from _whole_numbers(entry, name)
    elif isinstance(value, int) and not isinstance(value, bool):
        yield name, value


def toml_text(tables: Mapping[str, Any], *, comment: str = "") -> str:
    """Return the TOML document of nested tables.

    Raises TypeError: a value TOML has no form for (``None`` among them: leave the key out).

    Parameters
    ----------
    tables : mapping
        Values are bool, int, float, str, a sequence of such, a mapping (a table) or a sequence of mappings
        (an array of tables). A table's own values are written before its sub-tables.
    comment : str
        Written first, each line after ``# ``.
    """
    lines = [f"# {line}".rstrip() for line in comment.splitlines()]
    if lines:
        lines.append("")
    _write_table(lines, (), tables)
    return "\n".join(lines).strip("\n") + "\n"


def toml_value(value: Any) -> str:
    """Return one value as TOML text."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(int(value))
    if isinstance(value, float):
        return repr(float(value))
    if isinstance(value, str):
        return _string(value)
    if isinstance(value, Sequence):
        return _array(value)
    raise TypeError(f"TOML has no form for {value!r}")


def _string(text: str) -> str:
    escaped = "".join(_ESCAPES.get(c, f"\\u{ord(c):04X}" if ord(c) < 0x20 or ord(c) == 0x7F else c) for c in text)
    return f'"{escaped}"'


def _array(values: Sequence[Any]) -> str:
    items = [toml_value(item) for item in values]
    flat = "[" + ", ".join(items) + "]"
    if len(flat) <= _LINE_LENGTH and "\n" not in flat:
        return flat
    lines, line = [], ""
    for item in items:
        if line and len(line) + len(item) + 6 > _LINE_LENGTH:
            lines.append(line)
            line = ""
        line += f"{item}, "
    lines.append(line)
    return "[\n" + "\n".join(f"    {text.rstrip()}" for text in lines) + "\n]"


def _key(name: str) -> str:
    return name if _BARE_KEY.fullmatch(name) else _string(name)


def _is_tables(value: Any) -> bool:
    return (
        isinstance(value, Sequence)
        and not isinstance(value, str)
        and len(value) > 0
        and all(isinstance(item, Mapping) for item in value)
    )


def _write_table(lines: list[str], path: tuple[str, ...], table: Mapping[str, Any]) -> None:
    for name, value in table.items():
        if not isinstance(value, Mapping) and not _is_tables(value):
            lines.append(f"{_key(name)} = {toml_value(value)}")
    for name, value in table.items():
        below = (*path, name)
        header = ".".join(_key(part) for part in below)
        if isinstance(value, Mapping):
            # a table that only holds tables needs no header of its own
            if not value or any(not isinstance(v, Mapping) and not _is_tables(v) for v in value.values()):
                lines.extend(["", f"[{header}]"])
            _write_table(lines, below, value)
        elif _is_tables(value):
            for item in value:
                lines.extend(["", f"[[{header}]]"])
                _write_table(lines, below, item)


_HEADER = re.compile(r"\s*\[{1,2}\s*([^\[\]#]+?)\s*\]{1,2}\s*(?:#.*)?")
_ASSIGNMENT = re.compile(
    r"""\s*((?:[A-Za-z0-9_-]+|"[^"]*"|'[^']*')(?:\s*\.\s*(?:[A-Za-z0-9_-]+|"[^"]*"|'[^']*'))*)\s*="""
)
_PART = re.compile(r"""[A-Za-z0-9_-]+|"[^"]*"|'[^']*'""")


def toml_lines(text: str) -> dict[tuple[str, ...], int]:
    """Return the line of each table header and key of a TOML text, for messages about them.

    Keys are paths (``("machine", "R_s_ohm")``). A line-by-line reading that ``tomllib`` does not offer: a line inside a
    multi-line text that looks like a key may be listed too.
    """
    lines: dict[tuple[str, ...], int] = {}
    table: tuple[str, ...] = ()
    for number, line in enumerate(text.splitlines(), start=1):
        if header := _HEADER.fullmatch(line):
            table = _path(header[1])
            lines.setdefault(table, number)
        elif assignment := _ASSIGNMENT.match(line):
            lines.setdefault((*table, *_path(assignment[1])), number)
    return lines


def _path(dotted: str) -> tuple[str, ...]:
    return tuple(part.strip("\"'") for part in _PART.findall(dotted))


def line_of(text: str, path: tuple[str, ...]) -> int:
    """Return the line (from 1) of a key in a TOML text, or of the nearest table or row around it.

    Both ways of writing a row are found: a table of its own, and ``"name" = { ... }``.
    """
    best, depth = 1, 0
    table: tuple[str, ...] = ()
    for number, line in enumerate(text.splitlines(), 1):
        header, key = _TABLE_LINE.match(line), _KEY_LINE.match(line)
        if header is not None:
            table = _parts(header.group(1))
            here = table
        elif key is not None:
            here = (*table, *_parts(key.group(1)))
        else:
            continue
        common = len(here) if here == path[: len(here)] else 0
        if common > depth:
            best, depth = number, common
    return best


def _parts(text: str) -> tuple[str, ...]:
    return tuple(next(filter(None, found), "") for found in _NAME_PART.findall(text))  # "" is a key, too
