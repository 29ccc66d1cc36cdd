# SPDX-License-Identifier: MIT
"""Record the console blocks of the documentation again, and draw its pictures.

``python -m benchmarks.recorded_sessions [PAGE...]`` runs every command of the ``console`` blocks of README.md and of
the pages in docs/ (or of those named), in a folder of its own per page, and writes what each prints in place of what
stood there. A line `` ⋮`` stands for what a block leaves out: as many lines as stood before and after it are kept. From
the session of the README the pictures in docs/pictures are made: the terminal, and two figures of the run's report.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import re
import shlex
import tempfile
from collections.abc import Iterator, Sequence
from html import escape, unescape
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PICTURES = ROOT / "docs/pictures"
FIRST = ROOT / "README.md"
RUN = re.compile(r"runs/\d{8}T\d{6}Z-[0-9a-f]{8}(?:-\d+)?")
CUT = " ⋮"
_BLOCK = re.compile(r"^```console\n(.*?)^```\n", re.MULTILINE | re.DOTALL)
_FIGURES = {"torque-speed": "Torque over speed", "proof": "Proof 4"}
"""Pictures that are figures of the run's report, and how the captions of those begin."""
ROW_PX = 19
CHARACTER_PX = 7.83
"""Width of a character of the monospaced font at 13 px; lines are set to it, whatever font is there."""
MARGIN_PX = 16
_COLOURS = (
    (re.compile(r"\bPASS\b"), "#4ade80"),
    (re.compile(r"\bPARTIAL\b|\bNOT AVAILABLE\b|\bNOT CHECKED\b"), "#fbbf24"),
    (re.compile(r"\bFAIL\b"), "#f87171"),
)


def pages() -> list[Path]:
    """Return README.md and the pages of docs/ that hold a console block."""
    return [page for page in (FIRST, *sorted((ROOT / "docs").glob("*.md"))) if _BLOCK.search(page.read_text("utf-8"))]


def commands(block: str) -> Iterator[tuple[str, list[str]]]:
    r"""Yield every command of a console block with the lines it is said to print; ``\`` continues a command."""
    for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
        lines = part.splitlines()
        typed = lines.pop(0)
        while typed.endswith("\\"):
            typed += "\n" + lines.pop(0)
        yield typed, lines


def session(text: str) -> list[tuple[str, list[str]]]:
    """Return the commands of all console blocks of a page, in order."""
    return [command for block in _BLOCK.findall(text) for command in commands(block)]


def arguments(typed: str) -> list[str]:
    """Return the arguments of a typed command after ``pmsmtool``."""
    program, *words = shlex.split(typed.replace("\\\n", " "), comments=True)
    if Path(program).name != "pmsmtool":
        raise ValueError(f"not a command of pmsmtool: {typed}")
    return words


def as_cut(told: Sequence[str], shown: Sequence[str]) -> list[str]:
    """Return what a command printed, with what the block leaves out left out."""
    if CUT not in shown:
        return list(told)
    cut = shown.index(CUT)
    return [*told[:cut], CUT, *told[len(told) - (len(shown) - cut - 1) :]]


def with_present_run(typed: str) -> str:
    """Return a command with the newest run of the present folder in place of the run it names."""
    made = sorted(Path("runs").iterdir()) if Path("runs").exists() else []
    return RUN.sub(f"runs/{made[-1].name}", typed) if made else typed


def printed(typed: str) -> list[str]:
    """Run a typed command in this process and return what a terminal would show of it."""
    from pmsmtool.cli.main import run

    shown = io.StringIO()
    with contextlib.redirect_stderr(shown), contextlib.redirect_stdout(shown):
        run(arguments(typed))
    return shown.getvalue().splitlines()


def recorded(text: str) -> str:
    """Return a page with its console blocks recorded again, in the present folder."""

    def block(found: re.Match[str]) -> str:
        parts = []
        for typed, shown in commands(found[1]):
            typed = with_present_run(typed)
            parts.append("\n".join(["$ " + typed, *as_cut(printed(typed), shown)]))
        return "```console\n" + "\n".join(parts) + "\n```\n"

    return _BLOCK.sub(block, text)


def terminal_lines(text: str) -> list[str]:
    """Return what the picture of the terminal shows of a page: its first command, the stages and the verdict."""
    typed, shown = session(text)[0]
    kept = [line for line in shown if re.match(r"\[\d/\d\]|SIMULATED|report:", line)]
    return [f"$ {typed}", *(_shortened(line) for line in kept)]


def _shortened(line: str, width: int = 112) -> str:
    return line if len(line) <= width else line[: width - 2] + " …"


def terminal_picture(text: str) -> str:
    """Return the picture of the terminal that belongs to a page."""
    lines = terminal_lines(text)
    return terminal_svg(lines, f"Terminal: {lines[0].lstrip('$ ')}")


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


def report_figure(page: str, caption: str) -> str:
    """Return the figure of a report whose caption begins like this, titled with the first sentence of its caption.

    Raises
    ------
    ValueError
        The report has no such figure.
    """
    for found in re.findall(r"<figure>(.*?)</figure>", page, re.DOTALL):
        text = re.search(r"<figcaption>(.*?)</figcaption>", found, re.DOTALL)
        drawn = re.search(r"<svg.*</svg>", found, re.DOTALL)
        if text and drawn and text[1].strip().startswith(caption):
            title = unescape(text[1].strip()).split(". ")[0]
            return re.sub(r"(<svg[^>]*>)", rf"\1\n <title>{escape(title)}</title>", drawn[0], count=1) + "\n"
    raise ValueError(f"the report has no figure {caption!r}")


def main() -> None:
    """Record pages; with README.md the pictures, too."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", nargs="*", type=Path, help="default: README.md and all of docs/")
    names: list[Path] = parser.parse_args().page
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    for page in [name.resolve() for name in names] or pages():
        folder = tempfile.mkdtemp()
        os.environ["PMSMTOOL_HOME"] = folder
        os.chdir(folder)
        text = recorded(page.read_text(encoding="utf-8"))
        page.write_text(text, encoding="utf-8")
        if page == FIRST:
            report = next(Path("runs").glob("*/report.html")).read_text(encoding="utf-8")
            (PICTURES / "session.svg").write_text(terminal_picture(text), encoding="utf-8")
            for name, caption in _FIGURES.items():
                (PICTURES / f"{name}.svg").write_text(report_figure(report, caption), encoding="utf-8")
        print(f"recorded {page.name}")


if __name__ == "__main__":
    main()
