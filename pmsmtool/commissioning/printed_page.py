# SPDX-License-Identifier: MIT
"""A page to a PDF, by a browser of this computer without a window."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from pmsmtool.errors import ConfigError

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
            likely="neither Chromium nor Chrome nor Edge is installed where programs are looked for",
            hint=f"install one, or name it in {BROWSER}; {_WITHOUT}",
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
