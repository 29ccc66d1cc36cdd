# SPDX-License-Identifier: MIT
"""``pmsmtool reproduce``: figures and tables of the papers, with the numbers beside the plot."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pmsmtool.cli.options import ANY_PATH, FILE, WholeNumber, examples, output_options
from pmsmtool.cli.output import Output, figure_format, jsonable, save_figure, table
from pmsmtool.errors import CheckFailed, ConfigError
from pmsmtool.files import make_folder, write_file

if TYPE_CHECKING:
    from pmsmtool.papers.figure import Reproduction
    from pmsmtool.papers.registry import Row

_SEED = WholeNumber("seed", 0, 2**32 - 1)
_SUFFIXES = (".json", ".csv", ".txt")


@click.command(
    "reproduce",
    epilog=examples(
        "pmsmtool reproduce --list",
        "pmsmtool reproduce jercic-fig10 --plot fig10.svg",
        "pmsmtool reproduce jercic-table2 -o figures/",
        "pmsmtool reproduce all -o figures/ --seed 7",
    ),
)
@click.argument("figure", metavar="FIGURE|all", required=False)
@click.option(
    "-o", "--output", "path", type=ANY_PATH, metavar="DIR|FILE", help="Folder, or one file (.json, .csv, .txt)."
)
@click.option("--plot", "figure_path", type=FILE, help="Figure to write (.svg, .png, .pdf).")
@click.option("--seed", type=_SEED, default=1, show_default=True, help="Seed of random cases and of noise.")
@click.option("--list", "list_only", is_flag=True, help="List the figures.")
@output_options
def reproduce_command(
    figure: str | None, path: Path | None, figure_path: Path | None, seed: int, list_only: bool, out: Output
) -> None:
    """Recompute FIGURE and print its tables; each number stands beside the printed one.

    A folder for -o receives the tables (.txt, .json), what is plotted (.csv) and the plot (.svg). Exit code 1 when a
    checked number is out of its range. Same seed, same bytes. Nothing is touched.
    """
    if list_only:
        _list(out)
        return
    if figure is None:
        raise click.UsageError("missing argument FIGURE: a name of --list, or all")
    if figure == "all" and (figure_path is not None or (path is not None and path.suffix.lower() in _SUFFIXES)):
        raise click.UsageError("all figures need a folder: -o DIR")
    from pmsmtool.papers.registry import FIGURES, find, reproduce

    if figure_path is not None:
        figure_format(figure_path)
    _check_file(path)
    rows = FIGURES if figure == "all" else (find(figure),)
    outside: list[str] = []
    data: list[dict[str, Any]] = []
    for row in rows:
        out.status(f"{row.name} (about {row.run_s:g} s)")
        found = reproduce(row.name, seed)
        _write(row, found, path, figure_path, out)
        data.append(_data(row, found))
        if not out.json:
            out.result("reproduce", {}, (*_text(row, found), *([""] if len(rows) > 1 else [])))
        outside += [f"{row.name}: {check.what}" for check in found.checks if not check.within]
    if out.json:
        out.json_line("reproduce", {"figures": data} if figure == "all" else data[0])
    if outside:
        raise CheckFailed(
            f"checked numbers are out of range: {len(outside)}",
            where="reproduce",
            likely="; ".join(outside),
            hint="the table shows the printed or expected number, the recomputed one and the allowed range",
        )


def _check_file(path: Path | None) -> None:
    """Refuse a file name that means neither a folder nor one of the formats, before anything is computed."""
    if path is not None and not path.is_dir() and path.suffix and path.suffix.lower() not in _SUFFIXES:
        raise ConfigError(
            f"{path.name} has no format", where=str(path), hint="a folder, or .json, .csv, .txt; the plot is --plot"
        )


def _list(out: Output) -> None:
    from pmsmtool.papers.registry import FIGURES

    rows = [{"name": r.name, "title": r.title, "source": r.source, "run_s": r.run_s} for r in FIGURES]
    shown = [(r.name, r.title, f"{r.run_s:g}", r.source) for r in FIGURES]
    out.result("reproduce", {"figures": rows}, table(("figure", "shows", "s", "source"), shown))


def _data(row: Row, found: Reproduction) -> dict[str, Any]:
    return {
        "name": row.name,
        "title": row.title,
        "source": found.source,
        "ok": found.good,
        "checks": [
            {"what": c.what, **dict(zip(("printed", "expected"), c.two_columns, strict=True)), "ours": c.ours,
             "unit": c.unit, "low": c.low, "high": c.high, "within": c.within, "where": c.where}
            for c in found.checks
        ],
        "tables": [
            {"title": t.title, "columns": [c.name for c in t.columns], "units": [c.unit for c in t.columns],
             "rows": t.rows}
            for t in found.tables
        ],
        "notes": found.notes,
    }  # fmt: skip


def _series(found: Reproduction) -> list[Mapping[str, Any]]:
    return [
        {"title": p.title, "x": p.x_label, "y": p.y_label, "series": [
            {"name": s.name, "x": s.x, "y": s.y} for s in p.series]}
        for p in found.panels
    ]  # fmt: skip


def _text(row: Row, found: Reproduction) -> Iterator[str]:
    from pmsmtool.papers.figure import tables_of

    yield f"{row.name}: {row.title}"
    yield found.source
    for shown in tables_of(found):
        yield ""
        yield shown.title
        yield from table([column.head for column in shown.columns], shown.shown())
    if found.notes:
        yield ""
        yield from (f"note: {note}" for note in found.notes)


def _write(row: Row, found: Reproduction, path: Path | None, figure_path: Path | None, out: Output) -> None:
    from pmsmtool.papers.figure import csv_text, figure_of

    targets: list[Path] = []
    if path is not None and path.suffix.lower() in _SUFFIXES and not path.is_dir():
        targets = [path]
    elif path is not None:
        make_folder(path)
        targets = [path / f"{row.name}{suffix}" for suffix in _SUFFIXES]
        if found.panels:
            save_figure(figure_of(found, row.title), path / f"{row.name}.svg")
            out.note(f"wrote {path / row.name}.svg")
    for target in targets:
        write_file(target, _content(row, found, target.suffix.lower(), csv_text))
        out.note(f"wrote {target}")
    if figure_path is not None:
        save_figure(figure_of(found, row.title), figure_path)
        out.note(f"wrote {figure_path}")


def _content(row: Row, found: Reproduction, suffix: str, csv_text: Any) -> str:
    if suffix == ".csv":
        return str(csv_text(found))
    if suffix == ".txt":
        return "\n".join((*_text(row, found), ""))
    import json

    content = {"schema": "pmsmtool.reproduce/1", **_data(row, found), "panels": _series(found)}
    return json.dumps(jsonable(content), allow_nan=False, indent=1) + "\n"
