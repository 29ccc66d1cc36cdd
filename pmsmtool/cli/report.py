# SPDX-License-Identifier: MIT
"""``pmsmtool report``: the page a person reads and signs.

A page to a PDF, by a browser of this computer without a window.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import click

from pmsmtool.cli.options import FILE, examples, output_options
from pmsmtool.cli.output import Output
from pmsmtool.errors import ConfigError
from pmsmtool.files import write_file


@click.command(
    "report",
    epilog=examples(
        "pmsmtool report runs/20260101T120000Z-000055f1",
        "pmsmtool report --pdf runs/20260101T120000Z-000055f1",
        "pmsmtool report --junit runs/20260101T120000Z-000055f1 -o result.xml",
        "pmsmtool report --anonymous runs/20260101T120000Z-000055f1 -o to-send.json",
    ),
)
@click.argument("run", type=click.Path(path_type=Path))
@click.option("-o", "--output", "path", type=FILE, help="Page to write.  [default: report.html in the run directory]")
@click.option("--anonymous", is_flag=True, help="Instead of the page one JSON file to send: traces, objects, verdicts, "
              "no names.  [default: anonymous.json in the run directory]")  # fmt: skip
@click.option("--junit", is_flag=True, help="Instead of the page JUnit XML for a test system: a case per criterion.  "
              "[default: junit.xml in the run directory]")  # fmt: skip
@click.option("--pdf", is_flag=True, help="The page as PDF as well, by Chromium, Chrome or Edge; beside the page.")
@output_options
def report_command(run: Path, path: Path | None, anonymous: bool, junit: bool, pdf: bool, out: Output) -> None:
    """Write the report of a RUN directory: one self-contained HTML page, verdict first.

    Every figure is drawn from the files of the run. The exit code is that of writing the page, not the verdict of the
    run.

    --anonymous makes a file to send to the authors of pmsmtool: no serial number, no name of a person, drive, machine,
    computer or file, no date, no text of the run. Read it before you send it: it is plain text.
    """
    if anonymous + junit + pdf > 1:
        raise click.UsageError("--anonymous, --junit and --pdf make different files: give one of them")
    if anonymous:
        _write_anonymous(run, run / "anonymous.json" if path is None else path, out)
        return
    from pmsmtool.commissioning.report_page import how_it_ended, report_page, verdict

    if pdf:
        require_browser()
    path = path or run / ("junit.xml" if junit else "report.html")
    found, ended = verdict(run), how_it_ended(run)
    if junit:
        from dataclasses import asdict

        from pmsmtool.report.junit import junit_xml
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


BROWSER = "PMSMTOOL_BROWSER"
"""Environment variable with the program, where it is not found by name."""
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "msedge", "microsoft-edge")
PLACES = {
    "win32": (
        r"C:\Program Files\Google\Chrome\Application\chrome.exe",
        r"C:\Program Files (x86)\Microsoft\Edge\Application\msedge.exe",
    ),
    "darwin": ("/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",),
}
"""Where browsers lie that are not on the path, by ``sys.platform``."""
LIMIT_S = 120.0
"""A browser that takes longer is ended; seen: 2 s, 9 s on a busy computer."""
QUIET = (
    "--headless", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--no-pdf-header-footer",
)  # fmt: skip
_WITHOUT = "or open the page in any browser and print it: it is laid out for A4 and Letter"


def find_browser() -> str | None:
    """Return a program that prints pages: Chromium, Chrome or Edge; None where there is none."""
    given = os.environ.get(BROWSER)
    if given:
        return shutil.which(given)
    found = (shutil.which(name) for name in (*NAMES, *PLACES.get(sys.platform, ())))
    return next((path for path in found if path), None)


def require_browser() -> str:
    """Return the browser; raises ``ConfigError`` where none is found."""
    browser = find_browser()
    if browser is None:
        raise ConfigError(
            "no browser was found to make a PDF", where=os.environ.get(BROWSER, ""),
            likely="Chromium, Chrome and Edge are looked for", hint=f"install one, or name it in {BROWSER}; {_WITHOUT}",
        )  # fmt: skip
    return browser


def print_page(page: Path, pdf: Path) -> None:
    """Print an HTML page to a PDF; raises ``ConfigError`` where no browser is found, or it wrote nothing."""
    browser = require_browser()
    # a browser of the administrator (a container, a build server) does not start inside its own sandbox
    alone = ("--no-sandbox",) if getattr(os, "geteuid", lambda: 1)() == 0 else ()
    with tempfile.TemporaryDirectory(prefix="pmsmtool-", ignore_cleanup_errors=True) as folder:
        made = Path(folder) / "page.pdf"
        command = [browser, *QUIET, *alone, f"--user-data-dir={folder}/profile", f"--print-to-pdf={made}"]
        try:
            subprocess.run([*command, page.resolve().as_uri()], capture_output=True, timeout=LIMIT_S, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise ConfigError(f"the browser made no PDF: {error}", where=browser, hint=_WITHOUT) from error
        if not made.is_file():
            raise ConfigError("the browser made no PDF", where=browser, hint=_WITHOUT)
        try:
            shutil.copyfile(made, pdf)
        except OSError as error:
            hint = "name a file that can be written"
            raise ConfigError(error.strerror or str(error), where=str(pdf), hint=hint) from error
