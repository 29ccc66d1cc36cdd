# SPDX-License-Identifier: MIT
"""A picture of a terminal session: lines of text as SVG, readable at any size, in a light and a dark page."""

from __future__ import annotations

import re
from collections.abc import Sequence
from html import escape

ROW_PX = 19
CHARACTER_PX = 7.83
"""Width of a character of the monospaced font at 13 px; lines are set to it, whatever font is there."""
MARGIN_PX = 16
_COLOURS = (
    (re.compile(r"\bPASS\b"), "#4ade80"),
    (re.compile(r"\bPARTIAL\b|\bNOT AVAILABLE\b|\bNOT CHECKED\b"), "#fbbf24"),
    (re.compile(r"\bFAIL\b"), "#f87171"),
)


def terminal_svg(lines: Sequence[str], title: str) -> str:
    """Return the lines as one SVG picture.

    Parameters
    ----------
    lines : sequence of str
        What stands in the terminal; a line that begins with ``$`` is what a person typed.
    title : str
        What a screen reader says about the picture.

    Returns
    -------
    str
        SVG text with light letters on dark ground; the same bytes for the same lines.
    """
    width = round(max((len(line) for line in lines), default=0) * CHARACTER_PX) + 2 * MARGIN_PX
    height = len(lines) * ROW_PX + 2 * MARGIN_PX
    rows = "\n".join(_row(line, MARGIN_PX + (n + 1) * ROW_PX - 5) for n, line in enumerate(lines))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        f'role="img" font-family="ui-monospace, Menlo, Consolas, monospace" font-size="13" fill="#e5e7eb">\n'
        f"<title>{escape(title)}</title>\n"
        f'<rect width="{width}" height="{height}" rx="8" fill="#111827"/>\n{rows}\n</svg>\n'
    )


def _row(line: str, y: int) -> str:
    text = escape(line, quote=False)
    for pattern, colour in _COLOURS:
        text = pattern.sub(rf'<tspan fill="{colour}">\g<0></tspan>', text)
    bold = ' font-weight="bold"' if line.startswith("$") else ""
    length = f' textLength="{len(line) * CHARACTER_PX:.1f}"' if line else ""
    return f'<text x="{MARGIN_PX}" y="{y}" xml:space="preserve"{length}{bold}>{text}</text>'
