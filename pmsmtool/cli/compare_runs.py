# SPDX-License-Identifier: MIT
"""``pmsmtool diff``: two runs compared with their intervals."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click

from pmsmtool.cli.options import ANY_PATH, FILE, Quantity, examples, output_options
from pmsmtool.cli.output import Output, figure_format, save_figure, table
from pmsmtool.errors import CheckFailed, ConfigError


@click.command(
    "diff",
    epilog=examples(
        "pmsmtool diff runs/20260101T120000Z-000055f1 runs/20260301T090000Z-000055f1",
        "pmsmtool diff BEFORE AFTER --check && echo nothing changed",
    ),
)
@click.argument("first", type=ANY_PATH)
@click.argument("second", type=ANY_PATH)
@click.option("--check", is_flag=True, help="Exit code 1 where a value differs beyond its interval, or one is missing.")
@click.option("--tol", type=Quantity("ratio"), help="Limit in place of the intervals, e.g. 2%; of parameters, too.")
@click.option("--plot", "plot_path", type=FILE, help="Differences over their intervals to write (.svg, .png, .pdf).")
@output_options
def diff_command(
    first: Path, second: Path, check: bool, tol: float | None, plot_path: Path | None, out: Output
) -> None:
    """Compare what two runs identified, with the 95 % interval of the difference; their verdicts and parameters.

    Runs of one drive share its sensors, so only what scatters counts; of two drives the whole interval does. Resistance
    and flux linkage are compared at their reference temperature, with what the way there leaves open.

    Of two runs of `pmsmtool move`: following error, settling and current of the same move, number by number. The exit
    code with --check is then 1 where the second one follows worse.
    """
    from pmsmtool.commissioning.report_page import verdict
    from pmsmtool.identification import compared_runs as compared
    from pmsmtool.identification.request import read_run

    if tol is not None and not 0.0 <= tol < 1.0:
        raise click.UsageError(f"--tol is {100.0 * tol:g} %; give it as a share or with its unit, e.g. 2%")
    if plot_path is not None:
        figure_format(plot_path)
    if _moved(first, second):
        if plot_path is not None:
            raise click.UsageError("--plot draws what two runs identified, not two moves")
        _diff_of_moves(first, second, check, out)
        return
    (record, file), (other_record, other) = read_run(first), read_run(second)
    same = compared.same_drive(record.drive, other_record.drive)
    had = [compared.measured(each.estimates) for each in (file, other)]
    rows = compared.differences(*had, same_sensors=same, machine=file.machine)
    rows = rows if tol is None else compared.within(rows, tol)
    cells = [(*compared.told(row), row.verdict) for row in rows]
    changed = [row.name for row in rows if row.verdict != "agrees"]
    alone = sum("only" in row.verdict for row in rows)
    last = f"{len(rows) - len(changed)} of {len(rows) - alone} quantities agree"
    if tol is None:
        last += " (one drive: without its sensors' part)" if same else " (two drives: with the sensors' part)"
    last += f"; {alone} in one run alone" if alone else ""
    given = sorted({*file.estimates, *other.estimates} - {*had[0], *had[1]})
    last += f"; as given, not compared: {', '.join(given)}" if given else ""
    words = [verdict(path).word for path in (first, second)]
    sets = compared.other_parameters(first, second, tol or 0.0)
    lines = [last, f"verdict: {' -> '.join(words)}"]
    if sets is not None:
        more = "; `pmsmtool param diff FIRST SECOND` lists them" if sets else ""
        lines.append(f"parameters: {len(sets)} differ{more}")
    if words[0] != words[1]:
        changed.append("verdict")
    data = [{**_facts(row), "verdict": row.verdict} for row in rows]
    heads = ("quantity", "first", "second", "difference", "interval" if tol is None else "limit", "verdict")
    facts = {"same_drive": same, "quantities": data, "verdicts": words, "parameters": sets}
    out.result("diff", facts, [*table(heads, cells), *lines])
    if plot_path is not None:
        from pmsmtool.report.figures import difference_figure

        drawn = {row.name: (row.difference, row.interval) for row in rows if row.interval > 0.0}
        if not drawn:
            raise ConfigError(
                "the runs have no quantity in common that could be drawn", where=str(second), hint="leave --plot out"
            )
        save_figure(difference_figure(drawn, "").canvas, plot_path)
    if check and changed:
        raise CheckFailed(
            f"{', '.join(changed)}: not the same in both runs", where=str(second),
            likely="the machine, its temperature or its wiring changed between the runs",
            hint="`pmsmtool report RUN` shows what each run saw",
        )  # fmt: skip


MOVE = "move"
WORSE = 1.02
"""Following error, over the first one's, from which the second move is worse: whole counts of the encoder differ."""


def _moved(first: Path, second: Path) -> bool:
    """Whether both runs are of a move."""
    from pmsmtool.run_directory import RunDirectory

    return all(RunDirectory(path).read().stage(MOVE) is not None for path in (first, second))


def _diff_of_moves(first: Path, second: Path, check: bool, out: Output) -> None:
    from pmsmtool.axis.move import compared_moves, demanded, move_result, same_move, shown
    from pmsmtool.commissioning.move import TRACE
    from pmsmtool.run_directory import RunDirectory
    from pmsmtool.trace import read_trace

    traces = [read_trace(path / TRACE) for path in (first, second)]
    if not same_move(*traces):
        moves = " and ".join(f"{shown(way, 'rad')} at {speed:.3g} rad/s" for way, speed in map(demanded, traces))
        raise ConfigError(
            f"two moves that differ: {moves} on average", where=str(second),
            hint="compare the same move: the same --by, --speed and --acceleration",
        )  # fmt: skip
    before, after = map(move_result, traces)
    stages = [RunDirectory(path).read().stage(MOVE) for path in (first, second)]
    rows = compared_moves(before, after, [() if stage is None else stage.values for stage in stages])
    cells = [(row.name, shown(row.first, row.unit), shown(row.second, row.unit), row.shown_ratio) for row in rows]
    data = [{**_facts(row), "ratio": row.ratio} for row in rows]
    out.result("diff", {"moves": data}, table(("move", "first", "second", "second / first"), cells))
    worse = [row.name for row in rows if row.name in ("error_peak_rad", "error_rms_rad") and row.ratio > WORSE]
    if check and worse:
        raise CheckFailed(
            f"{', '.join(worse)}: the second move follows worse", where=str(second),
            likely="the new gains do not fit this load", hint="`pmsmtool restore` brings the old gains back",
        )  # fmt: skip


def _facts(row: object) -> dict[str, object]:
    return asdict(row)  # type: ignore[call-overload,no-any-return]
