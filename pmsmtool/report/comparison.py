# SPDX-License-Identifier: MIT
"""The table *data sheet | drive | measured* of a recorded identification, as text; nothing is judged here."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from pmsmtool.units import format_quantity

HEADS = ("quantity", "data sheet", "allowed by", "drive", "measured", "verdict")
SHORT = {
    "R_s_ohm": "R", "L_d_h": "L_d", "L_q_h": "L_q", "psi_f_wb": "psi", "J_kgm2": "J", "pole_pairs": "pole pairs",
    "encoder_counts": "encoder counts",
}  # fmt: skip


def contradictions(rows: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return the recorded rows that contradict and were not accepted."""
    return [row for row in rows if row["verdict"] == "contradicts"]


def unchecked(rows: Iterable[Mapping[str, Any]]) -> dict[str, str]:
    """Return what was not checked, with where it comes from."""
    return {str(row["name"]): str(row["source"]) for row in rows if row["verdict"] == "NOT CHECKED"}


def headline(rows: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[str]]:
    """Return what a verdict says of recorded rows: accepted contradictions first, what was not checked last."""
    first = [f"CONTRADICTION ACCEPTED: {row['text']}" for row in rows if row["verdict"] == "accepted"]
    by_source: dict[str, list[str]] = {}
    for name, source in unchecked(rows).items():
        by_source.setdefault(source, []).append(name)
    return first, [not_checked(names, source) for source, names in by_source.items()]


def not_checked(names: Iterable[str], source: str) -> str:
    """Return that values were taken from a source and not measured."""
    return f"NOT CHECKED ({source}): {', '.join(SHORT.get(name, name) for name in names)}"


def table_cells(rows: Iterable[Mapping[str, Any]]) -> list[tuple[str, str, str, str, str, str]]:
    """Return recorded rows as text: quantity, data sheet, its tolerance, drive, measured, verdict."""
    cells = []
    for row in rows:
        unit, half = str(row["unit"]), float(row["interval"])
        held = told(row["held"], unit) + (" (factory default)" if row["held"] is not None and row["factory"] else "")
        measured = told(row["measured"], unit)
        measured += f" +-{told(half, unit, 2)}" if row["measured"] is not None and half and unit != "1" else ""
        cells.append((row["name"], told(row["stated"], unit), row["tolerance"], held, measured, row["verdict"]))
    return cells


_FOLLOWS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("current.K_p_d", ("L_d_h",)),
    ("current.K_p_q", ("L_q_h",)),
    ("current.K_i_d", ("R_s_ohm", "L_d_h")),
    ("current.K_i_q", ("R_s_ohm", "L_q_h")),
    ("speed.K_", ("J_kgm2",)),
    ("speed.tau_max", ("psi_f_wb", "pole_pairs")),
    ("speed.acceleration", ("J_kgm2", "psi_f_wb", "pole_pairs")),
    ("reference.", ("psi_f_wb", "pole_pairs")),
    ("field_weakening.", ("L_d_h", "L_q_h", "psi_f_wb")),
    ("governor.", ("R_s_ohm", "L_d_h", "L_q_h", "psi_f_wb")),
    ("lut.", ("L_d_h", "L_q_h", "psi_f_wb", "pole_pairs")),
    ("polar.", ("R_s_ohm", "L_d_h", "L_q_h", "psi_f_wb")),
    ("motor.L_d_app", ("L_d_h",)),
    ("motor.L_q_app", ("L_q_h",)),
)
"""Quantities that parameters follow from, by how their names begin; ``motor.<key>`` follows from its own."""
_NOT_OF_THE_MACHINE = ("lut.format", "lut.axis_kind", "governor.mode", "governor.options", "field_weakening.mode")


def marks(names: Iterable[str], rows: Iterable[Mapping[str, Any]]) -> dict[str, str]:
    """Return which parameters follow from values that were not checked, and from which."""
    open_ = unchecked(row for row in rows if row.get("measured") is None)
    found = {}
    for name in names:
        own = (name.removeprefix("motor."),) if name.startswith("motor.") else ()
        of = [key for start, keys in _FOLLOWS if name.startswith(start) for key in keys]
        hit = [SHORT.get(key, key) for key in dict.fromkeys((*own, *of)) if key in open_]
        if hit and name not in _NOT_OF_THE_MACHINE:
            found[name] = f"from {', '.join(hit)}: NOT CHECKED"
    return found


def told(value: float | None, unit: str, digits: int = 4) -> str:
    """Return a value with its unit; nothing for none."""
    if value is None:
        return ""
    return f"{value:.10g}" if unit == "1" or math.isinf(value) else format_quantity(value, unit, digits)
