# SPDX-License-Identifier: MIT
"""The commissioning report: one self-contained HTML page, verdict first.

The page is made from the record of a run and from figures drawn elsewhere; nothing is measured or decided here.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from typing import TYPE_CHECKING, Any

from pmsmtool.report.comparison import HEADS, table_cells
from pmsmtool.report.verdict import COMPLETE, comparison_of, latest_of, verdict_of
from pmsmtool.units import format_estimate, format_quantity

if TYPE_CHECKING:
    import jinja2


@dataclass(frozen=True, slots=True)
class Figure:
    """One plot: inline SVG text, its caption, the stage whose numbers it explains, and how well it shows the verdict.

    The figure of the largest ``weight`` stands below the verdict. ``canvas`` is matplotlib's own, for other formats.
    """

    svg: str
    caption: str
    stage: str = ""
    weight: float = 0.0
    canvas: Any = field(default=None, repr=False, compare=False)


Cell = tuple[Any, str]
"""Text of a cell and its class in the page."""
Table = tuple[Sequence[str], Sequence[Sequence[Cell]]]
"""Heads and rows."""


@dataclass(frozen=True, slots=True)
class Change:
    """One parameter of the download, as text with the digits that matter."""

    name: str
    old: str
    asked: str
    held: str
    unit: str


def render(
    record: Mapping[str, Any],
    *,
    figures: Sequence[Figure] = (),
    changes: Sequence[Change] = (),
    not_checked: Sequence[str] = (),
    complete: Sequence[str] = COMPLETE,
    ended: Sequence[str] = (),
    recomputed: Mapping[str, Any] | None = None,
    moves: Table | None = None,
) -> str:
    """Return the report as HTML.

    Parameters
    ----------
    record : mapping
        Content of ``run.json`` (schema ``pmsmtool.run/1``).
    figures : sequence of Figure
        Plots in reading order.
    changes : sequence of Change
        What the download wrote.
    not_checked : sequence of str
        What a reader must not assume; printed as it is.
    complete : sequence of str
        Stages that a pass needs.
    ended : sequence of str
        How a run ended that did not come to its end.
    recomputed : mapping, optional
        Of ``recompute.html.j2``: the step that the page computes again.
    moves : tuple, optional
        Heads and rows of the numbers of a move, beside those of the same move before.
    """
    latest = latest_of(record.get("stages", ()))
    drive = record.get("drive", {})
    name = str(drive.get("name") or "drive")
    found, rows = verdict_of(record, complete), comparison_of(latest)
    first = max(figures, key=lambda figure: figure.weight, default=None)
    left = [figure for figure in figures if figure is not first]
    shown = {stage["name"] for stage in latest}
    # A later stage may write a file of an earlier one again: the last digest is that of the file.
    files = sorted({name: digest for stage in latest for name, digest in stage.get("files", {}).items()}.items())
    return template("report.html.j2").render(
        title=f"Commissioning of {name}, serial {int(drive.get('serial', 0)):#010x}",
        subtitle=f"started {record['started_utc']} by {record['operator']}",
        verdict=found,
        ended=list(ended),
        recomputed=recomputed,
        first=None if first is None else drawn(first),
        stages=[_stage(stage, [figure for figure in left if figure.stage == stage["name"]]) for stage in latest],
        moves=moves,
        comparison=_comparison(rows) if rows else None,
        figures=[drawn(figure) for figure in left if figure.stage not in shown],
        changes=_changes(changes) if changes else None,
        not_checked=list(not_checked),
        signatures=(_SIGNED, [[(role, ""), *[("", "")] * (len(_SIGNED) - 1)] for role in _ROLES]),
        conditions=(("condition", "value"), [[(key, "limit"), (value, "small")] for key, value in _conditions(record)]),
        files=(("file", "SHA-256"), [[(text, "small") for text in row] for row in files]) if files else None,
    )


TITLES = {
    "identify": "Identification", "tune": "Control design", "lut": "Table of current references", "margins": "Margins",
    "flash": "Download", "verify": "What the drive holds", "prove": "Proof on the machine",
}  # fmt: skip
"""Headings by stage."""
_SIGNED = ("role", "name", "date", "signature")
_ROLES = ("commissioned by", "checked by", "released by")
_STATUS = {"pass": "pass", "partial": "partial", "not available": "partial"}
"""Class in the page by the status of a stage; others failed."""
_VERDICTS = {"contradicts": "fail", "accepted": "partial", "NOT CHECKED": "partial"}
"""Class in the page by the verdict of a comparison."""


def _stage(stage: Mapping[str, Any], figures: Sequence[Figure]) -> dict[str, Any]:
    """Return what the page shows of a stage: its values, its criteria, and the figures that explain them."""
    values = [value for value in stage.get("values", ()) if "std" in value or "source" in value]
    criteria = [
        [
            ("PASS" if line["ok"] else "FAIL", "pass" if line["ok"] else "fail"),
            (line["what"], ""), (line["measured"], ""), (line["limit"], "limit"),
        ]
        for line in stage.get("acceptance", ())
    ]  # fmt: skip
    return {
        "title": TITLES.get(str(stage["name"]), str(stage["name"]).capitalize()),
        "status": stage["status"],
        "kind": _STATUS.get(stage["status"], "fail"),
        "note": stage.get("note", ""),
        "fallbacks": list(stage.get("fallbacks", ())),
        "estimates": (_ESTIMATE, [_estimate_row(value) for value in values]) if values else None,
        "criteria": (("result", "criterion", "measured", "limit"), criteria) if criteria else None,
        "figures": [drawn(figure) for figure in figures],
    }


def _comparison(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Return the table *data sheet | drive | measured*, with a drawing of the intervals where there are two."""
    heads = (*HEADS[:-1], "allowed and measured", HEADS[-1])
    body = [
        [
            *((text, "" if column in (0, 2) else "number") for column, text in enumerate(cells[:-1])),
            (_intervals(row), ""), (cells[-1], _VERDICTS.get(cells[-1], "")),
        ]
        for row, cells in zip(rows, table_cells(rows), strict=True)
    ]  # fmt: skip
    used = [k for k in range(len(heads)) if any(row[k][0] for row in body)]
    return [heads[k] for k in used], [[row[k] for k in used] for row in body]


_WIDE, _HIGH, _EDGE = 144.0, 16.0, 0.08
"""Size of the drawing of two intervals, and its margin on either side, of the width."""


def _intervals(row: Mapping[str, Any]) -> Any:
    """Return what the data sheet allows (grey) and the measured interval (blue, red beside it) as SVG; else nothing."""
    import markupsafe

    measured, low, high = row.get("measured"), row.get("low"), row.get("high")
    if measured is None or low is None or high is None or not high > low:
        return ""
    half = float(row.get("interval") or 0.0)
    ends = (float(low), float(high), float(measured) - half, float(measured) + half)
    span = max(ends) - min(ends)

    def x(value: float) -> float:
        return _WIDE * (_EDGE + (1.0 - 2.0 * _EDGE) * (value - min(ends)) / span)

    meet = ends[2] <= ends[1] and ends[0] <= ends[3]
    colour = "#1f5fa8" if meet else "#c2410c"
    text = "the intervals overlap" if meet else "the intervals do not overlap"
    return markupsafe.Markup(
        f'<svg class="interval" viewBox="0 0 {_WIDE:g} {_HIGH:g}" role="img" aria-label="{text}">'
        f'<rect x="{x(ends[0]):.1f}" y="4" width="{x(ends[1]) - x(ends[0]):.1f}" height="8" fill="#b8c0c8"/>'
        f'<path d="M{x(ends[2]):.1f} 8H{x(ends[3]):.1f}" stroke="{colour}" stroke-width="2"/>'
        f'<circle cx="{x(float(measured)):.1f}" cy="8" r="3" fill="{colour}"/></svg>'
    )


def _changes(changes: Sequence[Change]) -> Table:
    heads = ("parameter", "before", "asked", "held by the drive", "unit")
    return heads, [
        [(row.name, ""), (row.old, "number"), (row.asked, "number"), (row.held, "number"), (row.unit, "")]
        for row in changes
    ]


def drawn(figure: Figure) -> dict[str, Any]:
    """Return a figure as the templates take it."""
    return {"svg": _trusted_svg(figure.svg), "caption": figure.caption}


def template(name: str) -> jinja2.Template:
    """Return a page's template; what it is given is escaped."""
    import jinja2

    folder = resources.files("pmsmtool.report").joinpath("templates")
    loader = jinja2.FunctionLoader(lambda part: folder.joinpath(part).read_text(encoding="utf-8"))
    pages = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    pages.filters["parts"] = lambda text: re.split(r" (?=\+-|\()", str(text))  # of a number that must not break within
    return pages.get_template(name)


_ESTIMATE = (
    "quantity", "value \u00b1 total 95 %", "statistical (1 \u03c3)", "systematic (95 %)", "at", "method, source",
)  # fmt: skip


def _estimate_row(value: Mapping[str, Any]) -> list[Cell]:
    unit = str(value["unit"])
    method = ", ".join(str(value[key]) for key in ("method", "source") if value.get(key))
    if "std" not in value:
        only = format_quantity(float(value["value"]), unit)
        return [(value["name"], ""), (only, "number"), ("none", ""), ("none", ""), ("", ""), (method, "")]
    total = total_interval(float(value["std"]), float(value["systematic"]), float(value.get("coverage_factor", 1.96)))
    conditions = []
    if _finite(value.get("T_c")):
        conditions.append(f"{value['T_c']:.1f} \u00b0C")
    if _finite(value.get("i_d_apk")) or _finite(value.get("i_q_apk")):
        bias = (float(value[key]) if _finite(value.get(key)) else 0.0 for key in ("i_d_apk", "i_q_apk"))
        conditions.append("i_d {:.3g}, i_q {:.3g} A pk".format(*bias))
    parts = (format_estimate(float(value["value"]), total, unit),
             *(format_quantity(float(value[key]), unit, 2) for key in ("std", "systematic")))  # fmt: skip
    if is_integer(float(value["value"]), total):
        parts = f"{value['value']:.0f}", INTEGER, ""
    return [
        (value["name"], ""),
        *((part, "number") for part in parts),
        (", ".join(conditions), ""),
        (method, ""),
    ]


INTEGER = "an integer"
"""In place of the interval of pole pairs: they are that, or refused."""


def is_integer(value: float, total: float) -> bool:
    """Whether a value is an integer by its kind: no interval, and no fraction either."""
    return total == 0.0 and value.is_integer()


def total_interval(std: float, systematic: float, coverage_factor: float = 1.96) -> float:
    """Return the half width of the total 95 % interval: statistical and systematic part in quadrature.

    GUM (JCGM 100:2008) section 5.1.2 for independent parts; ``systematic`` is itself a 95 % half width.
    """
    return math.hypot(coverage_factor * std, systematic)


def _conditions(record: Mapping[str, Any]) -> list[tuple[str, str]]:
    rows = [("command", " ".join(map(str, record.get("command", ()))))]
    for group in ("drive", "bus", "envelope", "versions"):
        known = {key: value for key, value in record.get(group, {}).items() if value not in (None, "")}
        rows += [(f"{group}: {key}", _readable(key, value)) for key, value in known.items()]
    rows += [("instrument", str(line)) for line in record.get("instruments", ())]
    for consent in record.get("consents", ()):
        rows.append(("consent", ", ".join(f"{key}: {_readable(key, value)}" for key, value in consent.items())))
    return rows


_HEX = frozenset({"vendor", "product", "revision"})
"""Numbers of the drive that the command line shows in hexadecimal."""


def _readable(key: str, value: Any) -> str:
    """Return a recorded fact as a person reads it; nothing of it is left out."""
    if isinstance(value, Mapping):
        return ", ".join(f"{name}: {_readable(name, part)}" for name, part in value.items())
    if isinstance(value, list | tuple):
        return "; ".join(_readable(key, part) for part in value)
    if key in _HEX and isinstance(value, int):
        return f"{value:#010x}" if key == "vendor" else f"{value:#x}"
    return str(value)


def _finite(value: Any) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def _trusted_svg(svg: str) -> Any:
    """Mark our own SVG as safe, without the XML prologue a page must not carry in its body."""
    import markupsafe

    return markupsafe.Markup(svg[svg.index("<svg") :])
