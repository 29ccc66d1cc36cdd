"""The commissioning report: one self-contained HTML page, verdict first.

The page is made from the record of a run and from figures drawn elsewhere; nothing is measured or decided here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from typing import Any

from pmsmtool.report.comparison import HEADS, headline, table_cells, unchecked
from pmsmtool.units import format_estimate, format_quantity

COMPLETE = ("identify", "tune", "margins", "lut", "flash", "verify", "prove")
"""Stages of a full commissioning; one that is missing keeps the verdict open."""

VENDOR = "vendor"
"""Source of a value that the drive measured by itself: without an interval."""

AS_GIVEN = "as given"
"""Source of a value that a person brought in a machine file."""

UNAVAILABLE = "not available"
"""Status of a stage that the drive cannot give."""


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
        Stages that a green verdict needs.
    ended : sequence of str
        How a run ended that did not come to its end.
    """
    import jinja2

    source = resources.files("pmsmtool.report").joinpath("templates/report.html.j2").read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    latest = _latest(record.get("stages", ()))
    drive = record.get("drive", {})
    name = str(drive.get("name") or "drive")
    return environment.from_string(source).render(
        title=f"Commissioning of {name}, serial {int(drive.get('serial', 0)):#010x}",
        subtitle=f"started {record['started_utc']} by {record['operator']}",
        verdict=verdict_of(latest, complete),
        ended=list(ended),
        stages=latest,
        estimates=[
            _estimate_row(value)
            for stage in latest
            for value in stage.get("values", ())
            if "std" in value or "source" in value
        ],
        comparison=[HEADS, *table_cells(_comparison(latest))] if _comparison(latest) else [],
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


def _latest(stages: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return the last entry of every stage, in the order the stages were first run."""
    return list({stage["name"]: stage for stage in stages}.values())


@dataclass(frozen=True, slots=True)
class Verdict:
    """The first thing a reader sees: ``kind`` is ``pass``, ``fail`` or ``open``; ``lines`` are its reasons."""

    kind: str
    word: str
    lines: tuple[str, ...]


def verdict_of(stages: Sequence[Mapping[str, Any]], complete: Sequence[str] = COMPLETE) -> Verdict:
    """Return the verdict on the stages of a run; the last entry of each counts.

    Parameters
    ----------
    stages : sequence of mapping
        ``stages`` of ``run.json``.
    complete : sequence of str
        Stages that a green verdict needs.
    """
    latest = _latest(stages)
    rows = _comparison(latest)
    first, left = headline(rows)
    found = _verdict_of(latest, complete, unchecked(rows))
    return replace(found, lines=(*first, *found.lines, *left))


def _comparison(latest: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return the rows *data sheet | drive | measured* of a run."""
    return [row for stage in latest for row in stage.get("comparison", ())]


def _verdict_of(latest: list[Mapping[str, Any]], complete: Sequence[str], not_checked: Mapping[str, str]) -> Verdict:
    failed = [stage for stage in latest if stage["status"] not in ("pass", "partial", UNAVAILABLE)]
    done = {stage["name"] for stage in latest}
    missing = [name for name in complete if name not in done]
    if failed:
        return Verdict("fail", "FAIL", tuple(f"{_with_status(stage)}: {_failure(stage)}" for stage in failed))
    if missing:
        return Verdict("open", "NOT COMPLETE", (f"not run yet: {', '.join(missing)}",))
    criteria = sum(len(stage.get("acceptance", ())) for stage in latest)
    lacking = [stage for stage in latest if stage["status"] == UNAVAILABLE]
    values = [value for stage in latest for value in stage.get("values", ())]
    bare = [value for value in values if "source" in value and "std" not in value and value["name"] not in not_checked]
    refused = [f"{name} refused: {why}" for stage in latest for name, why in stage.get("refused", {}).items()]
    if refused:
        return Verdict("open", "PARTIAL", tuple(refused))
    if lacking or bare or not_checked:
        passed = [stage for stage in latest if stage["status"] in ("pass", "partial")]
        return _partial(passed, lacking, _bare_lines(bare), criteria)
    head = f"{latest[0]['name']} alone" if len(latest) == 1 else f"{len(latest)} stages"
    met = {0: "no criteria", 1: "1 criterion, met"}.get(criteria, f"{criteria} criteria, all met")
    return Verdict("pass", "PASS", (f"{head}, {met}",))


def _partial(
    passed: list[Mapping[str, Any]],
    lacking: list[Mapping[str, Any]],
    taken: list[str],
    criteria: int,
) -> Verdict:
    """Return the verdict on a drive that cannot give everything: green for its tier, and what that leaves open."""
    if not passed:
        return Verdict("open", "NOTHING AVAILABLE", tuple(f"{s['name']}: not available: {s['note']}" for s in lacking))
    names = ", ".join(str(stage["name"]) for stage in passed)
    behaviour = "" if any(stage["name"] == "prove" for stage in passed) else "; its behaviour was not proven"
    head = f"as far as this drive goes: {names}; {criteria} criteria, all met{behaviour}"
    missing = (f"{stage['name']}: not available: {stage['note']}" for stage in lacking)
    return Verdict("pass", "PASS FOR ITS TIER", (head, *taken, *missing))


def _bare_lines(values: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return one line per source of values that were not measured by this program."""
    names: dict[str, list[str]] = {}
    for value in values:
        names.setdefault(str(value["source"]), []).append(str(value["name"]))
    heads = {VENDOR: "the drive's own, without an interval", AS_GIVEN: "taken as given, not measured"}
    return [
        f"{heads.get(source, f'taken from {source}, not measured')}: {', '.join(named)}"
        for source, named in names.items()
    ]


def _with_status(stage: Mapping[str, Any]) -> str:
    """Return the name of a stage, with how it ended where that says more than that it failed."""
    return str(stage["name"]) if stage["status"] == "fail" else f"{stage['name']} {stage['status']}"


def _failure(stage: Mapping[str, Any]) -> str:
    broken = [line for line in stage.get("acceptance", ()) if not line["ok"]]
    if broken:
        return "; ".join(f"{line['what']}: {line['measured']}, limit {line['limit']}" for line in broken)
    return str(stage.get("note") or stage["status"])


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
