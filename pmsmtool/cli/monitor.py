# SPDX-License-Identifier: MIT
"""``pmsmtool monitor``: live values of a drive."""

from __future__ import annotations

import math
import re
import sys

import click

from pmsmtool.cli.drive_access import LOOKING_S, open_node, warn_of_other_drive
from pmsmtool.cli.options import FREQUENCY, TIME, BusOptions, bus_options, examples, output_options
from pmsmtool.cli.output import Output, table

DEFAULT_RATE_HZ = 5.0


class _Column:
    """Running statistics of one quantity (Welford)."""

    def __init__(self) -> None:
        self.last = self.low = self.high = math.nan
        self._count = 0
        self._mean = 0.0
        self._square = 0.0

    def add(self, value: float) -> None:
        self.last = value
        self.low = value if self._count == 0 else min(self.low, value)
        self.high = value if self._count == 0 else max(self.high, value)
        self._count += 1
        step = value - self._mean
        self._mean += step / self._count
        self._square += step * (value - self._mean)

    @property
    def std(self) -> float:
        return math.sqrt(self._square / (self._count - 1)) if self._count > 1 else 0.0


@click.command(
    "monitor",
    epilog=examples(
        "pmsmtool -i pmsmsim monitor --for 1s -g 'i_.*|omega'",
        "pmsmtool -n 5 monitor --rate 20Hz --csv > live.csv",
        "pmsmtool -n 5 monitor --pdo --rate 100Hz -g 'i_d_a|i_q_a|omega' --csv > fast.csv",
        "pmsmtool -n 5 monitor --json | jq .values.U_dc_v",
    ),
)
@click.option("--rate", "rate_hz", type=FREQUENCY, help=f"Readings per second; default {DEFAULT_RATE_HZ:g}Hz.")
@click.option("--for", "seconds", type=TIME, help="End after this time; default: Ctrl-C.")
@click.option("-g", "pattern", metavar="REGEX", help="Only quantities whose name matches.")
@click.option("--pdo", is_flag=True, help="Let the drive send them (at most 6); its PDOs are restored afterwards.")
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
    as_csv: bool,
) -> None:
    """Show live values with their minimum, maximum and standard deviation; one JSON object per reading with --json."""
    from pmsmtool.drive.live_readings import available, readings, sent
    from pmsmtool.drive.objects import signal_unit
    from pmsmtool.errors import ConfigError

    try:
        wanted = re.compile(pattern or "")
    except re.error as error:
        raise ConfigError(
            f"-g {pattern!r} is no regular expression: {error}",
            hint="escape what is meant literally, or give a part of a name: -g i_q",
        ) from error
    period_s = 1.0 / (rate_hz or DEFAULT_RATE_HZ)
    with open_node(bus, within_s=LOOKING_S) as node:
        warn_of_other_drive(node, out)
        names = available(node, wanted.search)
        node.sdo.finish_within(math.inf)
        if as_csv:
            click.echo(",".join(["t_s", *names]))
            click.echo(",".join(["s", *map(signal_unit, names)]))
        columns = {name: _Column() for name in names}
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


def _lines(columns: dict[str, _Column]) -> list[str]:
    from pmsmtool.drive.objects import signal_unit

    rows = [
        (name, f"{c.last:.6g}", signal_unit(name), f"{c.low:.6g}", f"{c.high:.6g}", f"{c.std:.3g}")
        for name, c in columns.items()
    ]
    return table(("quantity", "value", "unit", "min", "max", "std"), rows)


def _show(columns: dict[str, _Column]) -> None:
    """Draw the table over the last one."""
    lines = _lines(columns)
    click.echo("\x1b[H\x1b[2J" + "\n".join(lines))
