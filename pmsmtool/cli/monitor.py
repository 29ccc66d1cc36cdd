# SPDX-License-Identifier: MIT
"""``pmsmtool monitor``: live values of a drive."""

from __future__ import annotations

import math
import re
import sys
from typing import TYPE_CHECKING

import click

from pmsmtool.cli.drive_access import LOOKING_S, map_option, open_node, read_map, warn_of_other_drive
from pmsmtool.cli.options import FILE, FREQUENCY, TIME, BusOptions, bus_options, examples, output_options
from pmsmtool.cli.output import Output, table
from pmsmtool.errors import ConfigError
from pmsmtool.files import read_bytes
from pmsmtool.plain_text import counted

if TYPE_CHECKING:
    from pathlib import Path

    from pmsmtool.drive.logged_values import Column

DEFAULT_RATE_HZ = 5.0


@click.command(
    "monitor",
    epilog=examples(
        "pmsmtool -i pmsmsim monitor --for 1s -g 'i_.*|omega'",
        "pmsmtool -n 5 monitor --rate 20Hz --csv > live.csv",
        "pmsmtool -n 5 monitor --pdo --rate 100Hz -g 'i_d_a|i_q_a|omega' --csv > fast.csv",
        "pmsmtool -n 5 monitor --log bus.asc --map epos4 --csv > recorded.csv",
    ),
)
@click.option("--rate", "rate_hz", type=FREQUENCY, help=f"Readings per second; default {DEFAULT_RATE_HZ:g}Hz.")
@click.option("--for", "seconds", type=TIME, help="End after this time; default: Ctrl-C.")
@click.option("-g", "pattern", metavar="REGEX", help="Only quantities whose name matches.")
@click.option("--pdo", is_flag=True, help="Let the drive send them (at most 6); its PDOs are restored afterwards.")
@click.option(
    "--log", "log_file", type=FILE, help="Read a recorded bus instead of a drive: .log, .asc, .trc, .blf, .mf4."
)
@click.option("--eds", "eds_file", type=FILE, metavar="FILE", help="With --log: names and PDOs from an EDS or DCF.")
@map_option
@click.option("--csv", "as_csv", is_flag=True, help="Print comma-separated values; the second row holds units.")
@bus_options
@output_options
def monitor_command(
    bus: BusOptions,
    out: Output,
    rate_hz: float | None,
    seconds: float | None,
    pattern: str | None,
    pdo: bool,
    log_file: Path | None,
    eds_file: Path | None,
    map_file: Path | None,
    as_csv: bool,
) -> None:
    """Show live values with their minimum, maximum and standard deviation; one JSON object per reading with --json.

    --log reads a recorded bus (candump -L, Vector ASC and others; --trace-can writes them) and needs no drive. What a
    PDO carries is read from the log, else from --eds. --map gives names and units; without it the reference objects.
    """
    from pmsmtool.drive.logged_values import Column, available, readings, sent
    from pmsmtool.drive.objects import signal_unit

    try:
        wanted = re.compile(pattern or "")
    except re.error as error:
        raise ConfigError(
            f"-g {pattern!r} is no regular expression: {error}",
            hint="escape what is meant literally, or give a part of a name: -g i_q",
        ) from error
    if log_file is not None:
        if pdo or rate_hz or seconds:
            raise click.UsageError("--log reads what was recorded: leave --pdo, --rate and --for out")
        _show_log(log_file, eds_file, map_file, wanted, bus.node, out, as_csv)
        return
    if eds_file or map_file:
        raise click.UsageError("--eds and --map are for --log: a drive is asked for what it has")
    period_s = 1.0 / (rate_hz or DEFAULT_RATE_HZ)
    with open_node(bus, within_s=LOOKING_S) as node:
        warn_of_other_drive(node, out)
        names = available(node, wanted.search)
        node.sdo.finish_within(math.inf)
        if as_csv:
            click.echo(",".join(["t_s", *names]))
            click.echo(",".join(["s", *map(signal_unit, names)]))
        columns = {name: Column() for name in names}
        try:
            source = sent if pdo else readings
            for t_s, values in source(node, names, period_s, seconds):
                for name, value in values.items():
                    columns[name].add(value)
                if as_csv:
                    click.echo(",".join(f"{x:.9g}" for x in (t_s, *values.values())))
                elif out.json:
                    out.json_line("monitor", {"t_s": t_s, "values": values})
                elif sys.stdout.isatty():
                    _show(columns)
                sys.stdout.flush()
        except KeyboardInterrupt:
            if seconds is not None:
                raise  # asked for a time and interrupted before
    if not (as_csv or out.json or sys.stdout.isatty()):
        click.echo("\n".join(_lines(columns)))


def _show_log(
    path: Path,
    eds: Path | None,
    map_file: Path | None,
    wanted: re.Pattern[str],
    node: int | None,
    out: Output,
    as_csv: bool,
) -> None:
    from pmsmtool.bus.bus_log import BusLog
    from pmsmtool.drive.logged_values import Column, logged_values, quantities
    from pmsmtool.drive_maps.eds import parse_eds

    sheet = None if eds is None else parse_eds(read_bytes(eds), str(eds), node)
    named = quantities(read_map(map_file), sheet)
    log = BusLog(path)
    frames = list(log.frames())
    if log.left_out:
        out.warn(f"{path}: {counted(log.left_out, 'line')} left out, no CAN frame: {log.first_wrong}")
    drive, source = logged_values(frames, node, named, sheet, str(path))
    rows = [(t_s, kept) for t_s, values in source if (kept := {n: v for n, v in values.items() if wanted.search(n)})]
    for cob_id, count in sorted(drive.unknown.items()):
        out.warn(
            f"PDO 0x{cob_id:03X}: {counted(count, 'frame')} not decoded, the log does not hold its mapping: give --eds"
        )
    for line in drive.emergencies:
        out.note(line)
    if not rows:
        raise ConfigError(
            f"{counted(len(frames), 'frame')}, and none holds a quantity that is asked for", where=str(path),
            hint="give the drive's --map or --eds, another node (-n), or another -g",
        )  # fmt: skip
    columns = {name: Column() for name in dict.fromkeys(name for _, values in rows for name in values)}
    units = {quantity.name: quantity.unit for quantity in named.values()}
    if as_csv:
        click.echo(",".join(["t_s", *columns]))
        click.echo(",".join(["s", *(units[name] for name in columns)]))
    for t_s, values in rows:
        for name, value in values.items():
            columns[name].add(value)
        if as_csv:
            latest = ("" if math.isnan(column.last) else f"{column.last:.9g}" for column in columns.values())
            click.echo(",".join([f"{t_s:.9g}", *latest]))
        elif out.json:
            out.json_line("monitor", {"t_s": t_s, "values": values})
    if not (as_csv or out.json):
        click.echo("\n".join(_lines(columns, units)))
    out.note(f"node {drive.node}: {counted(len(frames), 'frame')} in {frames[-1].t_s:.6g} s")


def _lines(columns: dict[str, Column], units: dict[str, str] | None = None) -> list[str]:
    from pmsmtool.drive.objects import signal_unit

    rows = [
        (
            name,
            f"{c.last:.6g}",
            units[name] if units else signal_unit(name),
            f"{c.low:.6g}",
            f"{c.high:.6g}",
            f"{c.std:.3g}",
        )
        for name, c in columns.items()
    ]
    return table(("quantity", "value", "unit", "min", "max", "std"), rows)


def _show(columns: dict[str, Column]) -> None:
    """Draw the table over the last one."""
    lines = _lines(columns)
    click.echo("\x1b[H\x1b[2J" + "\n".join(lines))
