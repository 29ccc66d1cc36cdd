# SPDX-License-Identifier: MIT
"""On which line of a TOML text a key stands."""

from __future__ import annotations

import re

_HEADER = re.compile(r"\s*\[([^\[\]]+)\]")
_KEY = re.compile(r"""\s*("[^"]*"|'[^']*'|[A-Za-z0-9_-]+)\s*=""")
_PART = re.compile(r""""([^"]*)"|'([^']*)'|([A-Za-z0-9_-]+)""")


def line_of(text: str, path: tuple[str, ...]) -> int:
    """Return the line (from 1) of a key in a TOML text, or of the nearest table or row around it.

    Both ways of writing a row are found: a table of its own, and ``"name" = { ... }``.
    """
    best, depth = 1, 0
    table: tuple[str, ...] = ()
    for number, line in enumerate(text.splitlines(), 1):
        header, key = _HEADER.match(line), _KEY.match(line)
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
    return tuple(next(filter(None, found), "") for found in _PART.findall(text))  # "" is a key, too
