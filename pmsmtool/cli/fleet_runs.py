# SPDX-License-Identifier: MIT
"""``pmsmtool fleet``: statistics over many runs, per motor, as a table, a page or CSV."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pmsmtool.cli.options import DIR, FILE, examples, output_options
from pmsmtool.cli.output import Output, table
from pmsmtool.errors import ConfigError, PmsmtoolError
from pmsmtool.files import write_file

if TYPE_CHECKING:
    from pmsmtool.commissioning.fleet_page import Motor
    from pmsmtool.machine.machine_file import MachineFile
    from pmsmtool.machine.parameters import Estimate
    from pmsmtool.report.report import Figure
    from pmsmtool.run_directory import RunRecord

    Run = tuple[str, RunRecord, dict[str, Estimate]]

MOST_RUNS = 10_000
"""Folders that are looked at."""
LEAST_DRAWN = 3
"""Runs of a quantity from which it is drawn."""


@click.command(
    "fleet",
    epilog=examples(
        "pmsmtool fleet runs",
        "pmsmtool fleet runs -o fleet.html",
        "pmsmtool fleet runs -o fleet.csv",
        "pmsmtool fleet runs --json | jq '.motors[].quantities[].odd'",
    ),
)
@click.argument("folder", type=DIR)
@click.option("-o", "--output", "path", type=FILE, help="Write a page (.html), or every value of every run (.csv).")
@output_options
def fleet_command(folder: Path, path: Path | None, out: Output) -> None:
    """Show the statistics of all runs in a folder, per motor: medians, spread, drift, and the runs that stand out.

    Runs belong to one motor when their machine files have the same name and pole pairs. What a data sheet states is
    left out: it is the same in every run.
    """
    from pmsmtool.commissioning.fleet_page import HEADS, cells, fleet_page

    if path is not None and path.suffix.lower() not in (".html", ".csv"):
        raise ConfigError("a page or a table is written", where=str(path), hint="name a .html or a .csv file")
    by_motor, left_out = _runs(folder)
    motors = [_motor(name, runs) for name, runs in by_motor.items()]
    if path is not None:
        if path.suffix.lower() == ".csv":
            write_file(path, _csv(by_motor, motors))
        else:
            write_file(path, fleet_page(motors, {name: _figures(runs) for name, runs in by_motor.items()}, left_out))
    lines = [line for motor in motors for line in (motor.title, *table(HEADS, map(cells, motor.rows)), "")]
    facts = [
        {"name": m.name, "runs": m.runs, "drives": m.drives, "quantities": [asdict(row) for row in m.rows]}
        for m in motors
    ]
    data = {"runs": sum(motor.runs for motor in motors), "left_out": left_out, "motors": facts}
    out.result("fleet", data, [*lines[:-1], *(f"left out: {text}" for text in left_out)])
    if path is not None:
        out.note(f"wrote {path}")


def _runs(folder: Path) -> tuple[dict[str, list[Run]], list[str]]:
    """Return the runs by their motor, in order of time, and those that hold no values."""
    from pmsmtool.identification.compared_runs import measured
    from pmsmtool.identification.request import read_run

    found: dict[str, list[Run]] = {}
    left_out = []
    for path in sorted(path.parent for path in folder.glob("*/run.json"))[:MOST_RUNS]:
        try:
            record, file = read_run(path)
        except PmsmtoolError as error:
            left_out.append(f"{path.name}: {error.what}")
            continue
        values = measured(file.estimates)
        if values:
            found.setdefault(_name(file), []).append((path.name, record, values))
        else:
            left_out.append(f"{path.name}: nothing in it was measured")
    if not found:
        raise ConfigError(
            "no run with identified values in here" if folder.is_dir() else "no such folder", where=str(folder),
            hint="give the folder that holds the run directories, usually runs",
        )  # fmt: skip
    return found, left_out


def _name(file: MachineFile) -> str:
    return f"{file.name}, {round(file.machine.pole_pairs)} pole pairs"


def _motor(name: str, runs: list[Run]) -> Motor:
    from pmsmtool.commissioning.fleet_page import Motor
    from pmsmtool.identification.compared_runs import DRIVE, series

    drives = {tuple(record.drive.get(key) for key in DRIVE) for _, record, _ in runs}
    return Motor(name, len(runs), len(drives), series((run, values) for run, _, values in runs))


def _figures(runs: list[Run]) -> list[Figure]:
    from pmsmtool.estimators.estimate import total_half_width
    from pmsmtool.report.figures import series_figure

    names = sorted({name for _, _, values in runs for name in values})
    drawn = []
    for name in names:
        points = [(k, values[name]) for k, (_, _, values) in enumerate(runs, 1) if name in values]
        if len(points) >= LEAST_DRAWN:
            numbers, estimates = zip(*points, strict=True)
            halves = [total_half_width(estimate) for estimate in estimates]
            drawn.append(series_figure(name, estimates[0].unit, numbers, [e.value for e in estimates], halves))
    return drawn


def _csv(by_motor: dict[str, list[Run]], motors: list[Motor]) -> str:
    """Return a row per run and quantity."""
    import csv
    import io

    from pmsmtool.estimators.estimate import total_half_width

    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(("motor", "run", "started_utc", "serial", "quantity", "value", "total_95", "unit", "stands_out"))
    for motor in motors:
        odd = {(row.name, run) for row in motor.rows for run in row.odd}
        for run, record, values in by_motor[motor.name]:
            serial = record.drive.get("serial", "")
            for name, e in sorted(values.items()):
                numbers = (f"{e.value:.9g}", f"{total_half_width(e):.3g}")
                stands_out = "yes" if (name, run) in odd else "no"
                rows.writerow((motor.name, run, record.started_utc, serial, name, *numbers, e.unit, stands_out))
    return text.getvalue()
