# SPDX-License-Identifier: MIT
"""``pmsmtool scope``: live signals of a drive against time, on a page of this computer."""

from __future__ import annotations

import math
import shutil
import sys
import time
from collections.abc import Callable
from contextlib import closing
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pmsmtool.cli.drive_access import LOOKING_S, new_file, open_node, warn_of_other_drive
from pmsmtool.cli.options import DURATION, RATE, BusOptions, WholeNumber, bus_options, examples, output_options
from pmsmtool.cli.output import Output
from pmsmtool.errors import ConfigError, NotAvailable, PmsmtoolError

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

    from pmsmtool.cli.live_server import Samples
    from pmsmtool.drive.drive_node import DriveNode

RATE_HZ = 20.0
KEEP_S = 60.0
SHOWN = ("i_d_a", "i_q_a", "u_d_v", "u_q_v", "omega_e_rad_s", "U_dc_v")
"""Without a choice: as many as process data hold."""
STATUS_S = 1.0
PLAIN_S = 0.25
CLEAR = "\x1b[H\x1b[2J"


def _complete(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    from click.shell_completion import CompletionItem

    from pmsmtool.drive.objects import LIVE, signal_unit

    return [CompletionItem(name, help=signal_unit(name)) for name in LIVE if name.startswith(incomplete)]


@click.command(
    "scope",
    epilog=examples(
        "pmsmtool --sim interior-2k2 scope --for 30s",
        "pmsmtool -n 5 scope i_d_a i_q_a 'u_*' --rate 50Hz",
        "pmsmtool -n 5 scope --pdo --rate 200Hz --keep 20s -o last.csv",
        "pmsmtool -n 5 scope --plain i_q_a",
    ),
)
@click.argument("signals", nargs=-1, metavar="[SIGNAL]...", shell_complete=_complete)
@click.option("--rate", "rate_hz", type=RATE, default=f"{RATE_HZ:g}Hz", help="Readings per second.")
@click.option("--for", "seconds", type=DURATION, help="End after this time; default: Ctrl-C.")
@click.option("--keep", "keep_s", type=DURATION, help=f"The latest time that is kept, drawn and written; default "
              f"{KEEP_S:g}s, or all of --for.")  # fmt: skip
@click.option("--pdo", is_flag=True, help="Let the drive send them (at most 6); its PDOs are restored afterwards.")
@click.option("--plain", is_flag=True, help="Draw in the terminal; no page, no browser.")
@click.option("--port", type=WholeNumber("port", 0, 65535), default=0, help="Port of the page; 0 takes a free one.")
@new_file("path", help="Trace to write at the end (.npz or .csv).")
@bus_options
@output_options
def scope_command(
    bus: BusOptions,
    out: Output,
    signals: tuple[str, ...],
    rate_hz: float,
    seconds: float | None,
    keep_s: float | None,
    pdo: bool,
    plain: bool,
    port: int,
    path: Path | None,
) -> None:
    """Show live signals against time on a page in the browser; nothing is commanded.

    SIGNAL is a name of `monitor`, or several with * and ?. The page is at the address that is printed, for browsers on
    this computer only (127.0.0.1). It zooms and moves, has two cursors and a trigger, and writes CSV and PNG. The
    simulated drive of this process runs at the pace of the wall clock. --plain draws in the terminal instead.
    """
    from pmsmtool.cli.live_server import LiveServer, Samples
    from pmsmtool.drive.objects import signal_unit
    from pmsmtool.report.report import template

    _check(signals, path)
    keep_s = keep_s or seconds or KEEP_S
    with open_node(bus, within_s=LOOKING_S) as node:
        warn_of_other_drive(node, out)
        names = _chosen(node, signals)
        identity = node.identity()
        node.sdo.finish_within(math.inf)
        samples = Samples(names, math.ceil(keep_s * rate_hz) + 1)
        told = [{"name": name, "unit": signal_unit(name)} for name in names]
        if plain:
            _draw_plainly(node, samples, 1.0 / rate_hz, seconds, out, pdo)
            if path is not None and samples.count:
                _write(samples, path, f"node {identity.node}", out)
            return
        title = f"{identity.name or 'drive'}, node {identity.node}, serial {identity.serial}"
        server = LiveServer(port, template("scope.html.j2").render(), samples, {
            "title": title, "keep_s": keep_s, "signals": told,
        })  # fmt: skip
        with server.serving():
            data = {"url": server.url, "node": identity.node, "signals": told, "rate_hz": rate_hz, "keep_s": keep_s}
            out.result("scope", data, [server.url])
            sys.stdout.flush()
            out.note("open it in a browser on this computer; " + (f"{seconds:g} s" if seconds else "Ctrl-C ends it"))
            try:
                _follow(node, samples, 1.0 / rate_hz, seconds, out, pdo=pdo)
            finally:
                if path is not None and samples.count:
                    _write(samples, path, title, out)


def _draw_plainly(
    node: DriveNode, samples: Samples, period_s: float, seconds: float | None, out: Output, pdo: bool
) -> None:
    """Draw the signals over the last drawing while they come; where the output is no terminal, once at the end."""
    from pmsmtool.drive.objects import signal_unit
    from pmsmtool.report.plots import ASCII, BLOCKS, terminal_plot

    units = {name: signal_unit(name) for name in samples.names}
    levels = BLOCKS if (sys.stdout.encoding or "").lower().replace("-", "") == "utf8" else ASCII

    def draw(before: str = CLEAR) -> None:
        trace = samples.trace(units, {})
        width = shutil.get_terminal_size().columns
        click.echo(before + "\n".join(terminal_plot(trace.t_s, trace.signals, units, width, levels)))

    live = sys.stdout.isatty()
    try:
        _follow(node, samples, period_s, seconds, out, pdo=pdo, shown=draw if live else None)
    finally:
        if samples.count:
            draw(CLEAR if live else "")


def _check(signals: tuple[str, ...], path: Path | None) -> None:
    """Refuse before anything is asked what could only fail at the end."""
    from difflib import get_close_matches

    from pmsmtool.drive.objects import LIVE

    for pattern in signals:
        if not any(fnmatchcase(name, pattern) for name in LIVE):
            near = get_close_matches(pattern, LIVE, n=1, cutoff=0.5)  # iq
            hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(LIVE)}"
            raise ConfigError(f"no live quantity is called {pattern}", where="SIGNAL", hint=hint)
    if path is not None and path.suffix.lower() not in (".npz", ".csv"):
        raise ConfigError(f"{path.name} has no trace format", where=str(path), hint="use .npz or .csv")


def _chosen(node: DriveNode, signals: tuple[str, ...]) -> list[str]:
    """Return the names that are wanted; one that was typed and that the drive lacks is refused."""
    from pmsmtool.drive.logged_values import available
    from pmsmtool.drive.objects import LIVE

    wanted = signals or SHOWN
    names = available(node, lambda name: any(fnmatchcase(name, pattern) for pattern in wanted))
    lacking = [name for name in signals if name in LIVE and name not in names]
    if lacking:
        raise NotAvailable(
            f"the drive does not show {', '.join(lacking)}", where=f"node {node.node}", hint="leave them out"
        )
    return names


def _follow(
    node: DriveNode, samples: Samples, period_s: float, seconds: float | None, out: Output, *, pdo: bool,
    shown: Callable[[], None] | None = None,
) -> None:  # fmt: skip
    """Read until the time is over, Ctrl-C or an error, at the pace of the wall clock; the page hears which it was."""
    from pmsmtool.drive.logged_values import readings, sent

    read = sent if pdo else readings
    begun, said_s = time.monotonic(), 0.0
    try:
        with closing(read(node, list(samples.names), period_s, seconds)) as source:
            for t_s, values in source:
                samples.add(t_s, values.values())
                if shown is not None and t_s - said_s >= PLAIN_S:
                    said_s = t_s
                    shown()
                elif shown is None and t_s - said_s >= STATUS_S:
                    said_s = t_s
                    out.status(f"{t_s:.0f} s, {samples.count} readings")
                time.sleep(max(0.0, begun + t_s - time.monotonic()))  # time of a simulated bus passes at once
        samples.end(f"the time that was asked for is over: {samples.count} readings", good=True)
    except KeyboardInterrupt:
        samples.end("ended with Ctrl-C", good=True)
        if seconds is not None:
            raise  # asked for a time and interrupted before
    except PmsmtoolError as error:
        samples.end(f"{error.where}: {error.what}" if error.where else error.what, good=False)
        raise


def _write(samples: Samples, path: Path, title: str, out: Output) -> None:
    from pmsmtool.drive.objects import signal_unit
    from pmsmtool.trace import write_trace

    trace = samples.trace({name: signal_unit(name) for name in samples.names}, {"source": "scope", "drive": title})
    write_trace(trace, path)
    of = f"{len(trace)}" if len(trace) == samples.count else f"the latest {len(trace)} of {samples.count}"
    out.note(f"wrote {path}: {of} readings")
