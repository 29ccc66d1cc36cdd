# SPDX-License-Identifier: MIT
"""Reading TOML: the one reader behind every TOML file, so that each bad file ends in the same clear error."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pmsmtool.errors import ConfigError, next_step
from pmsmtool.files import read_text

NEXT_STEP = "correct the text there; https://toml.io shows the format"

LARGEST_WHOLE = 1 << 63
"""Whole numbers of TOML 1.0 have 64 bit; the standard library takes any, which no float holds."""


@next_step(NEXT_STEP)
def parse_toml(text: str, *, where: str) -> dict[str, Any]:
    """Return the tables of a TOML text.

    Parameters
    ----------
    text : str
        The document.
    where : str
        Named in errors.

    Raises
    ------
    ConfigError
        Not TOML, or a whole number beyond 64 bit.
    """
    try:
        tables = tomllib.loads(text.removeprefix("\ufeff"))  # Windows editors begin UTF-8 with this mark
    except (ValueError, RecursionError) as error:  # beside its own error: numbers of 5000 digits, brackets 1000 deep
        raise ConfigError(
            f"the file is not TOML: {error}", where=where, likely="a missing quote or bracket, or a decimal comma"
        ) from None
    for name, number in _whole_numbers(tables, ""):
        if not -LARGEST_WHOLE <= number < LARGEST_WHOLE:
            raise ConfigError("is a whole number beyond the 64 bit of TOML", where=f"{where}:{name}")
    return tables


def read_toml(path: Path, *, hint: str = "check the path") -> dict[str, Any]:
    """Return the tables of a TOML file.

    Raises
    ------
    ConfigError
        Missing, unreadable, or as :func:`parse_toml`.
    """
    return parse_toml(read_text(path, hint=hint), where=str(path))


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
