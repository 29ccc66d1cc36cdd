# SPDX-License-Identifier: MIT
"""Text from outside - drives, files, back ends, servers - made harmless: no control characters, no endless length."""

from __future__ import annotations

LONGEST_REASON = 300
"""Letters of another library's error message that are shown."""
_KEPT = "\n\t"


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


def one_line(text: str, longest: int | None = None) -> str:
    """Return a text as :func:`plain` does, on one line, and cut to ``longest`` letters."""
    if longest is not None and len(text) > longest:
        text = text[:longest] + " ..."
    return "".join(c if c.isprintable() else _shown(c) for c in text)


def reason(error: BaseException) -> str:
    """Return another library's error in one line, without the traceback some put into their messages."""
    text = str(error).split("Traceback (most recent call last)")[0].strip()
    return one_line(text.splitlines()[0] if text else type(error).__name__, LONGEST_REASON)


def _shown(letter: str) -> str:
    return letter.encode("unicode_escape").decode("ascii")
