# SPDX-License-Identifier: MIT
"""What is printed: text that is harmless whoever wrote it, in lines and tables as wide as a terminal."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from itertools import zip_longest
from textwrap import wrap
from typing import NamedTuple

LONGEST_REASON = 300
"""Letters of another library's error message that are shown."""
_KEPT = "\n\t"
_WORDS = re.compile(r"\s+|(?<=[a-zA-Z]-)(?=[a-zA-Z])")
"""Between what a cell of a table may be broken."""


def plain(text: str) -> str:
    r"""Return a text in which nothing steers a terminal; lines stay lines.

    Escape sequences, other control characters and the invisible ones that turn the direction of writing are shown as
    Python writes them (``\x1b``).
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in _KEPT else _shown(c) for c in text)


def counted(count: int, noun: str) -> str:
    """Return a number with its noun: ``1 object``, ``2 objects``."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def by_reason(reasons: Iterable[tuple[str, str]], between: str = ": ") -> list[str]:
    """Return one line per reason, with all the names (first of each pair) that it is given for."""
    named: dict[str, list[str]] = {}
    for name, why in reasons:
        named.setdefault(why, []).append(name)
    return [f"{', '.join(names)}{between}{why}" for why, names in named.items()]


def one_line(text: str, longest: int | None = None) -> str:
    """Return a text as :func:`plain` does, on one line, and cut to ``longest`` letters."""
    if longest is not None and len(text) > longest:
        text = text[:longest] + " ..."
    return "".join(c if c.isprintable() else _shown(c) for c in text)


def reason(error: BaseException) -> str:
    """Return another library's error in one line, without the traceback some put into their messages."""
    text = str(error).split("Traceback (most recent call last)")[0].strip()
    return one_line(text.splitlines()[0] if text else type(error).__name__, LONGEST_REASON)


def table(heads: Sequence[str], rows: Iterable[Sequence[object]], width: int | None = None) -> list[str]:
    """Return aligned lines: text to the left, numbers to the right, two blanks between columns.

    With ``width`` (letters) the widest columns of text are broken between words until the table fits, if it can.
    """
    body = [[one_line(str(cell)) for cell in row] for row in rows]
    columns = list(zip(heads, *body, strict=True))
    widths = [max(map(len, column)) for column in columns]
    numeric = [bool(body) and all(_is_number(row[k]) for row in body) for k in range(len(heads))]
    if width is not None:
        words = [max(len(word) for cell in column for word in _WORDS.split(cell)) for column in columns]
        while sum(widths) + 2 * (len(widths) - 1) > width and widths != words:
            widest = max(range(len(widths)), key=lambda k: (widths[k] > words[k], widths[k]))
            widths[widest] -= 1
    lines = []
    for row in ([*heads], *body):
        cells = [folded(cell, space, hanging=0) for cell, space in zip(row, widths, strict=True)]
        for parts in zip_longest(*cells, fillvalue=""):
            aligned = (
                part.rjust(space) if right else part.ljust(space)
                for part, space, right in zip(parts, widths, numeric, strict=True)
            )
            lines.append("  ".join(aligned).rstrip())
    return lines


class Summary(NamedTuple):
    """What a result shows of itself: a line, a table by its heads and rows, and lines below it."""

    head: str
    heads: Sequence[str]
    rows: Sequence[Sequence[object]]
    notes: Sequence[str] = ()


class Summarised(ABC):
    """A result that shows a table of itself: as text, and as HTML in a notebook."""

    __slots__ = ()

    @abstractmethod
    def summary(self) -> Summary:
        """Return what is shown."""

    def __repr__(self) -> str:
        shown = self.summary()
        return "\n".join((shown.head, *table(shown.heads, shown.rows), *shown.notes))

    def _repr_html_(self) -> str:
        from html import escape

        shown = self.summary()
        rows = [("th", shown.heads), *(("td", row) for row in shown.rows)]
        lines = ("".join(f"<{tag}>{escape(one_line(str(cell)))}</{tag}>" for cell in row) for tag, row in rows)
        notes = "".join(f"<p>{escape(one_line(note))}</p>" for note in shown.notes)
        body = "".join(f"<tr>{line}</tr>" for line in lines)
        return f"<p>{escape(one_line(shown.head))}</p><table>{body}</table>{notes}"


def folded(line: str, width: int, *, hanging: int = 2) -> list[str]:
    """Return a line broken between words into lines of ``width`` letters; a longer word stays whole.

    What follows the first line stands under the last of its columns; without columns ``hanging`` blanks further in.
    """
    if len(line) <= width:
        return [line]
    gaps = [gap.end() for gap in re.finditer(r"(?<=\S)  +(?=\S)|^ +\w+: +(?=\S)", line)]
    lead = len(line) - len(line.lstrip())
    start = max((end for end in gaps if end <= width * 5 // 8), default=lead)
    return wrap(
        line[start:], width, initial_indent=line[:start], replace_whitespace=False, break_long_words=False,
        subsequent_indent=" " * (start if start > lead else lead + hanging), break_on_hyphens=hanging == 0,
    )  # fmt: skip


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return text in ("", "-")
    return True


def _shown(letter: str) -> str:
    return letter.encode("unicode_escape").decode("ascii")
