# SPDX-License-Identifier: MIT
"""The commissioning report: one self-contained HTML page, verdict first.

The page is made from the record of a run and from figures drawn elsewhere; nothing is measured or decided here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import TYPE_CHECKING, Any

from pmsmtool.report.comparison import HEADS, table_cells
from pmsmtool.report.verdict import COMPLETE, comparison_of, latest_of, verdict_of
from pmsmtool.units import format_estimate, format_quantity

if TYPE_CHECKING:
    import jinja2


@dataclass(frozen=True, slots=True)
class Figure:
    """One plot: inline SVG text and its caption."""

    svg: str
    caption: str


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
    """
    latest = latest_of(record.get("stages", ()))
    drive = record.get("drive", {})
    name = str(drive.get("name") or "drive")
    found, rows = verdict_of(record, complete), comparison_of(latest)
    return template("report.html.j2").render(
        title=f"Commissioning of {name}, serial {int(drive.get('serial', 0)):#010x}",
        subtitle=f"started {record['started_utc']} by {record['operator']}",
        verdict=found,
        ended=list(ended),
        stages=latest,
        estimates=[
            _estimate_row(value)
            for stage in latest
            for value in stage.get("values", ())
            if "std" in value or "source" in value
        ],
        comparison=[HEADS, *table_cells(rows)] if rows else [],
        fallbacks=[f"{stage['name']}: {line}" for stage in latest for line in stage.get("fallbacks", ())],
        # the table of stages has the note only where there are no criteria
        notes=[
            f"{stage['name']}: {stage['note']}" for stage in latest if stage.get("acceptance") and stage.get("note")
        ],
        figures=[{"svg": _trusted_svg(figure.svg), "caption": figure.caption} for figure in figures],
        changes=changes,
        not_checked=list(not_checked),
        conditions=list(_conditions(record)),
        # A later stage may write a file of an earlier one again: the last digest is that of the file.
        files=sorted({name: digest for stage in latest for name, digest in stage.get("files", {}).items()}.items()),
    )


def template(name: str) -> jinja2.Template:
    """Return a page's template; what it is given is escaped."""
    import jinja2

    folder = resources.files("pmsmtool.report").joinpath("templates")
    loader = jinja2.FunctionLoader(lambda part: folder.joinpath(part).read_text(encoding="utf-8"))
    return jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True
    ).get_template(name)


def _estimate_row(value: Mapping[str, Any]) -> dict[str, str]:
    unit = str(value["unit"])
    method = ", ".join(str(value[key]) for key in ("method", "source") if value.get(key))
    if "std" not in value:
        told = format_quantity(float(value["value"]), unit)
        return {
            "name": str(value["name"]), "value": told, "std": "none", "systematic": "none", "conditions": "",
            "method": method,
        }  # fmt: skip
    total = total_interval(float(value["std"]), float(value["systematic"]), float(value.get("coverage_factor", 1.96)))
    conditions = []
    if _finite(value.get("T_c")):
        conditions.append(f"{value['T_c']:.1f} °C")
    if _finite(value.get("i_d_apk")) or _finite(value.get("i_q_apk")):
        bias = (float(value[key]) if _finite(value.get(key)) else 0.0 for key in ("i_d_apk", "i_q_apk"))
        conditions.append("i_d {:.3g}, i_q {:.3g} A pk".format(*bias))
    return {
        "name": str(value["name"]),
        "value": format_estimate(float(value["value"]), total, unit),
        "std": format_quantity(float(value["std"]), unit, 2),
        "systematic": format_quantity(float(value["systematic"]), unit, 2),
        "conditions": ", ".join(conditions),
        "method": method,
    }


def total_interval(std: float, systematic: float, coverage_factor: float = 1.96) -> float:
    """Return the half width of the total 95 % interval: statistical and systematic part in quadrature.

    GUM (JCGM 100:2008) section 5.1.2 for independent parts; ``systematic`` is itself a 95 % half width.
    """
    return math.hypot(coverage_factor * std, systematic)


def _conditions(record: Mapping[str, Any]) -> list[tuple[str, str]]:
    rows = [("command", " ".join(map(str, record.get("command", ()))))]
    for group in ("drive", "bus", "envelope", "versions"):
        known = {key: value for key, value in record.get(group, {}).items() if value is not None}
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
