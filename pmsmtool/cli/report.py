# SPDX-License-Identifier: MIT
"""``pmsmtool report``: the page a person reads and signs, and the same page while its run goes on."""

from __future__ import annotations

import os
import sys
import time
from contextlib import suppress
from html import escape
from pathlib import Path

import click

from pmsmtool.cli.options import ANY_PATH, DURATION, FILE, WholeNumber, examples, output_options
from pmsmtool.cli.output import Output
from pmsmtool.errors import ConfigError
from pmsmtool.files import write_file

LOOK_S = 1.0
"""The run's folder is looked at this often."""
NICENESS = 5
"""What measures comes first; for the same reason drawing (2 to 5 s of processor time) pauses as long as it took."""
RELOAD = """<script>const shown = {}; const news = new EventSource("/samples");
news.addEventListener("samples", e => {{ if (JSON.parse(e.data).at(-1)[0] > shown) location.reload(); }});
news.addEventListener("end", () => news.close());</script>"""


@click.command(
    "report",
    epilog=examples(
        "pmsmtool report runs/20260101T120000Z-000055f1",
        "pmsmtool report --follow runs",
        "pmsmtool report --junit runs/20260101T120000Z-000055f1 -o result.xml",
        "pmsmtool report --anonymous runs/20260101T120000Z-000055f1 -o to-send.json",
    ),
)
@click.argument("run", type=ANY_PATH)
@click.option("-o", "--output", "path", type=FILE, help="Page to write.  [default: report.html in the run directory]")
@click.option("--anonymous", is_flag=True, help="Instead of the page one JSON file to send: traces, objects, verdicts, "
              "no names.  [default: anonymous.json in the run directory]")  # fmt: skip
@click.option("--junit", is_flag=True, help="Instead of the page JUnit XML for a test system: a case per criterion.  "
              "[default: junit.xml in the run directory]")  # fmt: skip
@click.option("--pdf", is_flag=True, help="The page as PDF as well, by Chromium, Chrome or Edge; beside the page.")
@click.option("--follow", is_flag=True, help="Serve the page to browsers of this computer while the run goes on; "
              "of a folder of runs that of the newest.")  # fmt: skip
@click.option("--for", "seconds", type=DURATION, help="--follow ends after this time; default: Ctrl-C.")
@click.option("--port", type=WholeNumber("port", 0, 65535), default=0, help="Port of --follow; 0 takes a free one.")
@output_options
def report_command(
    run: Path, path: Path | None, anonymous: bool, junit: bool, pdf: bool, follow: bool, seconds: float | None,
    port: int, out: Output,
) -> None:  # fmt: skip
    """Write the report of a RUN directory: one self-contained HTML page, verdict first.

    Every figure is drawn from the files of the run. The exit code is that of writing the page, not the verdict of the
    run.

    --follow shows the page while `identify`, `prove` or `commission` runs in another terminal: figures come as traces
    come, of a proof the committed band first. It is for browsers on this computer only (127.0.0.1).

    --anonymous makes a file to send to the authors of pmsmtool: no serial number, no name of a person, drive, machine,
    computer or file, no date, no text of the run. Read it before you send it: it is plain text.
    """
    if anonymous + junit + pdf + follow > 1:
        raise click.UsageError("--anonymous, --junit, --pdf and --follow exclude each other: give one of them")
    if (follow and path) or (not follow and (seconds or port)):
        raise click.UsageError("--for and --port belong to --follow, which writes no file (-o)")
    kind = ".json" if anonymous else ".xml" if junit else ".html"
    if path is not None and path.suffix.lower() not in ("", kind):
        beside = "; --pdf writes a .pdf beside the page"
        way = " with --anonymous" if anonymous else " with --junit" if junit else beside
        raise click.UsageError(f"{path.name}: what is written is {kind}{way}")
    if follow:
        _follow(run, seconds, port, out)
        return
    if anonymous:
        _write_anonymous(run, run / "anonymous.json" if path is None else path, out)
        return
    from pmsmtool.commissioning.printed_page import print_page, require_browser
    from pmsmtool.commissioning.report_page import how_it_ended, report_page, verdict

    if pdf:
        require_browser()
    path = path or run / ("junit.xml" if junit else "report.html")
    found, ended = verdict(run), how_it_ended(run)
    if junit:
        from dataclasses import asdict

        from pmsmtool.report.verdict import junit_xml
        from pmsmtool.run_directory import RunDirectory

        write_file(path, junit_xml(asdict(RunDirectory(run).read()), found))
    else:
        out.status("writing the report ...")
        write_file(path, report_page(run))
    data = {"file": path, "verdict": found.word, "simulated": found.simulated, "reasons": found.lines, "ended": ended}
    if pdf:
        data["pdf"] = path.with_suffix(".pdf")
        print_page(path, path.with_suffix(".pdf"))
    out.result("report", data, [found.headline, *found.details, *ended])
    out.note(f"wrote {path}" + (f" and {path.with_suffix('.pdf')}" if pdf else ""))


def _write_anonymous(run: Path, path: Path, out: Output) -> None:
    import json

    from pmsmtool.commissioning.anonymous import anonymous_text

    text = anonymous_text(run)
    write_file(path, text)
    found = json.loads(text)
    stages = ", ".join(f"{stage['stage']} {stage['status']}" for stage in found["stages"]) or "no stage"
    counts = {name: len(found[name]) for name in ("traces", "stages", "parameters")}
    out.result("report-anonymous", {"file": path, "verdict": found["verdict"], **counts}, [
        f"{counts['traces']} traces, {counts['parameters']} parameters, {found['verdict']}: {stages}",
        "no names, no serial number, no dates, no texts of the run: look at it before you send it",
    ])  # fmt: skip
    out.note(f"wrote {path}")


def _follow(path: Path, seconds: float | None, port: int, out: Output) -> None:
    """Serve the page of a run, drawn again when a file of the run has changed."""
    from pmsmtool.cli.live_server import LiveServer, Samples

    if not path.is_dir():
        raise ConfigError("there is no such folder", where=str(path), hint="give a run directory, or the folder runs")
    drawings = Samples((), 1)
    begin = f"<!doctype html><title>report</title><p>no run yet in {escape(str(path))}</p>"
    server = LiveServer(port, begin + RELOAD.format(0), drawings, {})
    if hasattr(os, "nice"):
        os.nice(NICENESS)
    latest = time.monotonic() + seconds if seconds else float("inf")
    before: object = None
    with server.serving():
        out.result("report-follow", {"url": server.url}, [server.url])
        sys.stdout.flush()
        out.note("open it in a browser on this computer; " + (f"{seconds:g} s" if seconds else "Ctrl-C ends it"))
        try:
            while time.monotonic() < latest:
                begun = time.process_time()
                run = _newest(path)
                files = run and _files(run)
                if run and files != before:
                    before = files
                    server.show(_page(run, drawings.count + 1))
                    drawings.add(drawings.count + 1, ())
                    out.status(f"{run.name}: drawn {drawings.count} times")
                pause = max(LOOK_S, time.process_time() - begun)
                time.sleep(max(0.0, min(pause, latest - time.monotonic())))
        except KeyboardInterrupt:
            if seconds:
                raise  # asked for a time and interrupted before


def _newest(path: Path) -> Path | None:
    """Return the run that is followed: the folder itself, or the newest run in it; None where there is none yet."""
    from pmsmtool.run_directory import RECORD

    runs = [path] if (path / RECORD).is_file() else [record.parent for record in path.glob(f"*/{RECORD}")]
    return max(runs, default=None)


def _files(run: Path) -> list[tuple[str, int]]:
    """Return what tells whether a run has changed; a file that is being replaced counts when it is there again."""
    found = []
    for path in sorted(run.rglob("*.*")):
        with suppress(OSError):
            found.append((str(path), path.stat().st_mtime_ns))
    return found


def _page(run: Path, number: int) -> str:
    """Return the report of a run as it is now, which loads itself again when a later one is drawn."""
    from pmsmtool.commissioning.report_page import report_page

    try:
        page = report_page(run)
    except ConfigError as error:
        page = f"<!doctype html><title>report</title><p>{escape(str(error))}</p>"
    return page + RELOAD.format(number)
