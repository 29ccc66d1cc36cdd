# SPDX-License-Identifier: MIT
"""``pmsmtool report``: the page a person reads and signs."""

from __future__ import annotations

from pathlib import Path

import click

from pmsmtool.cli.options import FILE, examples, output_options
from pmsmtool.cli.output import Output
from pmsmtool.files import write_file


@click.command(
    "report",
    epilog=examples(
        "pmsmtool report runs/20260101T120000Z-000055f1",
        "pmsmtool report runs/20260101T120000Z-000055f1 -o commissioning.html",
        "pmsmtool report runs/20260101T120000Z-000055f1 --json | jq .verdict",
    ),
)
@click.argument("run", type=click.Path(path_type=Path))
@click.option("-o", "--output", "path", type=FILE, help="Page to write.  [default: report.html in the run directory]")
@output_options
def report_command(run: Path, path: Path | None, out: Output) -> None:
    """Write the report of a RUN directory: one self-contained HTML page, verdict first.

    Every figure is drawn again from the files of the run. The exit code says whether the page was written, not whether
    the run was good.
    """
    from pmsmtool.commissioning.report_page import how_it_ended, report_page, verdict

    path = run / "report.html" if path is None else path
    write_file(path, report_page(run))
    found, ended = verdict(run), how_it_ended(run)
    data = {"file": path, "verdict": found.word, "simulated": found.simulated, "reasons": found.lines, "ended": ended}
    out.result("report", data, [found.headline, *found.details, *ended])
    out.note(f"wrote {path}")
