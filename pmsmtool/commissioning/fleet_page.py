# SPDX-License-Identifier: MIT
"""Statistics of many runs as a page: a table per motor, each quantity over the runs, what stands out first."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pmsmtool.identification.compared_runs import Series
from pmsmtool.plain_text import counted
from pmsmtool.report.report import Figure, drawn, template
from pmsmtool.units import format_quantity

HEADS = ("quantity", "runs", "median", "spread", "interval of one", "drift", "stand out")


@dataclass(frozen=True, slots=True)
class Motor:
    """The runs of one motor: their number, that of the drives, and the statistics of each quantity."""

    name: str
    runs: int
    drives: int
    rows: Sequence[Series]

    @property
    def title(self) -> str:
        """Name and numbers in one line."""
        return f"{self.name}: {counted(self.runs, 'run')}, {counted(self.drives, 'drive')}"


def cells(row: Series) -> tuple[str, ...]:
    """Return the statistics of a quantity as text, "-" where there is none."""

    def text(value: float, digits: int = 2) -> str:
        return "-" if math.isnan(value) else format_quantity(value, row.unit, digits)

    drift = "-" if math.isnan(row.drift) else f"{'+' if row.drift > 0.0 else ''}{text(row.drift)}"
    return (
        row.name, str(row.runs), text(row.median, 4), text(row.spread), f"+-{text(row.interval)}", drift,
        ", ".join(row.odd) or "-",
    )  # fmt: skip


def fleet_page(motors: Sequence[Motor], figures: Mapping[str, Sequence[Figure]], left_out: Sequence[str]) -> str:
    """Return the page as HTML.

    Parameters
    ----------
    motors : sequence of Motor
        In reading order.
    figures : mapping of str to sequence of Figure
        Of each motor by its name.
    left_out : sequence of str
        Runs without values, each with its reason.
    """
    odd = [
        f"{motor.name}: {row.name} of {', '.join(row.odd)} stands out of {row.runs} runs"
        for motor in motors
        for row in motor.rows
        if row.odd
    ]
    odd += [
        f"{motor.name}: {row.name} drifts by {cells(row)[5]} over {row.runs} runs"
        for motor in motors
        for row in motor.rows
        if not math.isnan(row.drift)
    ]
    runs = counted(sum(motor.runs for motor in motors), "run")
    return template("fleet.html.j2").render(
        title="Fleet of drives",
        headline=f"{counted(len(odd), 'remark')} on {runs}" if odd else f"{runs}, nothing stands out",
        subtitle=f"{counted(len(motors), 'motor')}, {counted(sum(motor.drives for motor in motors), 'drive')}",
        odd=odd,
        motors=[
            {
                "name": motor.title,
                "table": (HEADS, [[(text, "") for text in cells(row)] for row in motor.rows]),
                "figures": [drawn(figure) for figure in figures.get(motor.name, ())],
            }
            for motor in motors
        ],
        left_out=list(left_out),
    )
