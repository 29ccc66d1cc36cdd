# SPDX-License-Identifier: MIT
"""What a page of Markdown holds: fenced blocks, rows of tables, links, sentences."""

from __future__ import annotations

import re

_FENCE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
_BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"!?\[([^\]]*)\]\(([^)\s]+)\)")


def fenced(text: str, language: str) -> list[str]:
    """Return the fenced blocks of a language; with an empty one those that name none."""
    return [block for name, block in _BLOCK.findall(text) if name == language]


def rows_of(text: str, before: str) -> list[list[str]]:
    """Return the rows of the first table after ``before``, cell by cell, without its head."""
    rest = text.split(before, 1)[1].splitlines()
    first = next(n for n, line in enumerate(rest) if line.startswith("|"))
    rows = []
    for line in rest[first:]:
        if not line.startswith("|"):
            break
        rows.append([cell.strip() for cell in re.split(r"(?<!\\)\|", line.strip("|"))])
    return rows[2:]


def links(text: str) -> list[str]:
    """Return the targets of all links and pictures outside of fenced blocks."""
    return [target for _, target in _LINK.findall(_FENCE.sub("", text))]


def sentences(text: str) -> list[str]:
    """Return the sentences of the running text: no headings, tables, blocks or pictures; items of lists count."""
    parts: list[str] = []
    for paragraph in re.split(r"\n\s*\n|\n(?=\s*(?:[-*]|\d+\.) )", _FENCE.sub("", text)):
        line = " ".join(paragraph.split())
        if not line or line.startswith(("#", "|", "![", "<!--")):
            continue
        line = _LINK.sub(r"\1", re.sub(r"^(?:[-*]|\d+\.) ", "", line)).replace("**", "")
        parts += re.split(r"(?<=[.?!:])\s+(?=[A-Z`\"(])", line)
    return [part for part in parts if part.strip()]
