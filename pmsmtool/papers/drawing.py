# SPDX-License-Identifier: MIT
"""A reproduction as a figure and as files. matplotlib is imported when something is drawn."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from pmsmtool.errors import ConfigError
from pmsmtool.papers.figure import Panel, Reproduction, Table, check_table
from pmsmtool.report.plots import thinned

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
