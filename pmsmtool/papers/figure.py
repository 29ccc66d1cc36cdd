# SPDX-License-Identifier: MIT
"""What a reproduced figure or table is: tables, checked numbers and panels; and how it is drawn and written.

A figure is a function ``(seed: int, ...) -> Reproduction`` with its own keyword arguments for smaller sizes; a row of
:mod:`pmsmtool.papers.registry` makes it a name of ``pmsmtool reproduce``. matplotlib is imported only to draw.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pmsmtool.arrays import Array
from pmsmtool.errors import ConfigError
from pmsmtool.report.plots import thinned

if TYPE_CHECKING:
    from matplotlib.figure import Figure


Cell = str | int | float | None
"""Entry of a table; None and NaN are shown as "-"."""


@dataclass(frozen=True, slots=True)
class Column:
    """Head of a column."""

    name: str
    """Quantity."""
    unit: str = ""
    """SI unit or ``%``, ``ms``, ``rpm``; empty for text and pure numbers."""
    digits: int = 4
    """Significant digits shown."""

    @property
    def head(self) -> str:
        """Name with its unit."""
        return f"{self.name} / {self.unit}" if self.unit else self.name


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of numbers under named columns."""

    title: str
    """What it shows, and under which conditions."""
    columns: tuple[Column, ...]
    """Heads."""
    rows: tuple[tuple[Cell, ...], ...]
    """One cell per column."""

    def __post_init__(self) -> None:
        wrong = [row for row in self.rows if len(row) != len(self.columns)]
        if wrong:
            raise ValueError(f"table {self.title!r}: {len(self.columns)} columns, but a row {wrong[0]!r}")

    def shown(self) -> list[tuple[str, ...]]:
        """Return the rows as text."""
        return [
            tuple(_text(cell, column.digits) for cell, column in zip(row, self.columns, strict=True))
            for row in self.rows
        ]


@dataclass(frozen=True, slots=True)
class Check:
    """One number of a paper, or one that follows from it, beside ours."""

    what: str
    """The number, with its conditions."""
    expected: float
    """The number in ``where``; NaN where only a bound is."""
    ours: float
    """As computed here, same unit."""
    unit: str
    """Unit of both."""
    low: float
    high: float
    """Allowed range of ``ours``, ends included; infinite where one-sided."""
    where: str = ""
    """Where the number comes from: what prints it, what curve it was read off, or what it was derived from."""
    printed: bool = False
    """Whether the paper prints this very number in ``where``; false for one read off a figure or derived."""

    def __post_init__(self) -> None:
        if math.isfinite(self.expected) and not self.where:
            raise ValueError(f"{self.what}: an expected number needs its source")

    @property
    def within(self) -> bool:
        """Whether ours lies in the allowed range; a number that is not finite does not."""
        return math.isfinite(self.ours) and self.low <= self.ours <= self.high

    @property
    def two_columns(self) -> tuple[float | None, float | None]:
        """What the paper prints, and what is expected otherwise; None for the other one."""
        number = self.expected if math.isfinite(self.expected) else None
        return (number, None) if self.printed else (None, number)

    @property
    def allowed(self) -> str:
        """The range as text."""
        if math.isinf(self.low):
            return f"<= {self.high:.6g}"
        return f">= {self.low:.6g}" if math.isinf(self.high) else f"{self.low:.6g} .. {self.high:.6g}"


def near(
    what: str,
    expected: float,
    ours: float,
    unit: str,
    *,
    absolute: float = 0.0,
    relative: float = 0.0,
    where: str = "",
) -> Check:
    """Return a check of a number against an expected one within an absolute plus a relative tolerance."""
    room = absolute + relative * abs(expected)
    return Check(what, expected, ours, unit, expected - room, expected + room, where)


def as_printed(what: str, printed: float, ours: float, unit: str, *, where: str) -> Check:
    """Return a check of a number against the one that the paper prints, to the digits a float holds."""
    room = 1e-12 * abs(printed)
    return Check(what, printed, ours, unit, printed - room, printed + room, where, printed=True)


def at_most(what: str, ours: float, limit: float, unit: str, *, expected: float = math.nan, where: str = "") -> Check:
    """Return a check of a number against an upper limit."""
    return Check(what, expected, ours, unit, -math.inf, limit, where)


def at_least(what: str, ours: float, limit: float, unit: str, *, expected: float = math.nan, where: str = "") -> Check:
    """Return a check of a number against a lower limit."""
    return Check(what, expected, ours, unit, limit, math.inf, where)


@dataclass(frozen=True, slots=True)
class Series:
    """One line or cloud of points of a panel."""

    name: str
    """In the legend; empty: not in the legend."""
    x: Array
    y: Array
    """In the units of the panel's axes. Shape (n,)."""
    style: str = "-"
    """matplotlib's short form: ``-`` response, ``--`` reference, ``:`` limit, ``.`` or ``o`` points."""
    colour: int | None = None
    """Number of the colour, to pair lines; None: the next one. Negative: grey."""


@dataclass(frozen=True, slots=True)
class Panel:
    """One pair of axes."""

    title: str
    """Above the axes."""
    x_label: str
    y_label: str
    """Quantity and unit, ``i_q / A``."""
    series: tuple[Series, ...]
    """What is drawn."""
    equal: bool = False
    """Same scale on both axes (current plane)."""
    x_log: bool = False
    y_log: bool = False
    """Logarithmic axes."""
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    """Shown range; all where None."""


@dataclass(frozen=True, slots=True)
class Reproduction:
    """A figure or table of a paper, recomputed; its name and title are in the registry."""

    source: str
    """Paper and figure, DOI."""
    tables: tuple[Table, ...] = ()
    """Numbers."""
    panels: tuple[Panel, ...] = ()
    """Plot; empty for a table alone."""
    checks: tuple[Check, ...] = ()
    """Printed and expected numbers beside ours."""
    notes: tuple[str, ...] = ()
    """Conditions, assumptions, and what differs from the paper and why."""
    columns: int = 1
    """Panels side by side."""

    @property
    def good(self) -> bool:
        """Whether every checked number is within its range."""
        return all(check.within for check in self.checks)


def check_table(checks: Sequence[Check]) -> Table:
    """Return the checks as a table."""
    heads = ("number", "printed", "expected", "pmsmtool", "unit", "allowed", "within", "source")
    rows = tuple(
        (c.what, *c.two_columns, c.ours, c.unit, c.allowed, "yes" if c.within else "NO", c.where) for c in checks
    )
    title = "checked numbers: printed in the paper, or expected from its source"
    return Table(title, tuple(Column(head) for head in heads), rows)


def _text(cell: Cell, digits: int) -> str:
    if cell is None or (isinstance(cell, float) and math.isnan(cell)):
        return "-"
    return f"{cell:.{digits}g}" if isinstance(cell, float) else str(cell)


COLOURS = ("#1f5fa8", "#c2410c", "#15803d", "#7e22ce", "#111827", "#0891b2", "#db2777", "#65a30d")
GREY = "#9ca3af"
_WIDTH, _HEIGHT = 7.5, 2.6


def figure_of(found: Reproduction, title: str) -> Figure:
    """Return the panels of a reproduction as one figure. Raises ConfigError: it is a table without a plot."""
    if not found.panels:
        raise ConfigError(f"a table, there is nothing to plot: {title}", where="reproduce", hint="leave --plot out")
    from matplotlib.figure import Figure

    columns = min(found.columns, len(found.panels))
    rows = -(-len(found.panels) // columns)
    width = _WIDTH if columns == 1 else 0.72 * _WIDTH * columns
    tall = 1.7 if any(panel.equal for panel in found.panels) else 1.0
    figure = Figure(figsize=(width, 0.4 + _HEIGHT * tall * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    for cell, panel in zip(axes.ravel(), found.panels, strict=False):
        _draw(cell, panel)
    for cell in axes.ravel()[len(found.panels) :]:
        cell.set_axis_off()
    figure.suptitle(title, fontsize=10)
    return figure


def _draw(axes: Any, panel: Panel) -> None:
    fresh = iter(COLOURS * (1 + len(panel.series) // len(COLOURS)))
    for series in panel.series:
        if series.colour is None:
            colour = next(fresh)
        else:
            colour = GREY if series.colour < 0 else COLOURS[series.colour % len(COLOURS)]
        points = series.style in (".", "o", "x", "+")
        x, y = (series.x, series.y) if points or panel.equal else thinned(series.x, series.y)
        axes.plot(x, y, series.style, color=colour, linewidth=1.1, markersize=3.5, label=series.name or None)
    axes.set_title(panel.title, loc="left", fontsize=9)
    axes.set(xlabel=panel.x_label, ylabel=panel.y_label)
    if panel.x_log:
        axes.set_xscale("log")
    if panel.y_log:
        axes.set_yscale("log")
    if panel.equal:
        axes.set_aspect("equal")
    if panel.x_range is not None:
        axes.set_xlim(*panel.x_range)
    if panel.y_range is not None:
        axes.set_ylim(*panel.y_range)
    axes.grid(color="0.9")
    if sum(bool(series.name) for series in panel.series) > 1:
        axes.legend(fontsize=7, ncols=2 if len(panel.series) > 6 else 1)


def tables_of(found: Reproduction) -> Sequence[Table]:
    """Return all tables of a reproduction, the checked numbers last."""
    return (*found.tables, check_table(found.checks)) if found.checks else found.tables


def csv_text(found: Reproduction) -> str:
    """Return what is plotted as comma-separated values: one point per line."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(("panel", "series", "x", "y", "x_axis", "y_axis"))
    for panel in found.panels:
        for series in panel.series:
            for x, y in zip(series.x.tolist(), series.y.tolist(), strict=True):
                cells = ("" if math.isnan(v) else repr(v) for v in (x, y))
                writer.writerow((panel.title, series.name, *cells, panel.x_label, panel.y_label))
    return out.getvalue()
