# SPDX-License-Identifier: MIT
"""The live page in a browser without a window: does it lose samples, does it grow? ``python -m benchmarks.live_page``.

Ten signals at 1 kHz go into the ring that ``scope`` fills, at the pace of the wall clock, and the browser shows the
page that it serves. No drive and no bus take part. At every look the page is asked which samples it holds, so that one
that never came leaves a gap, and how much memory its script holds after a garbage collection.

Exit code 1 where a sample was lost, or the page holds more memory than when its ring was full.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import os
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pmsmtool.cli.live_server import LiveServer, Samples
from pmsmtool.commissioning.printed_page import QUIET, find_browser
from pmsmtool.report.report import template

SIGNALS, RATE_HZ, KEEP_S = 10, 1000, 60.0
LOOK_S = 10.0
"""Time between two looks: the page keeps a sample for longer."""
TIMEOUT_S = 60.0
GROWTH = 1.3
"""Memory of the script, over the most it held while its ring was filled. The page lets go of old samples in one piece
when they are a twentieth of all."""
HELD = f"JSON.stringify(rows.map(row => Math.round({RATE_HZ} * row[0])))"


class Page:
    """The page of a browser, asked by the DevTools protocol: JSON over a web socket (RFC 6455)."""

    def __init__(self, port: int) -> None:
        pages: list[str] = []
        until = time.monotonic() + TIMEOUT_S
        while not pages:
            if time.monotonic() > until:
                raise RuntimeError("the browser opened no page")
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=TIMEOUT_S) as found:
                pages = [each["webSocketDebuggerUrl"] for each in json.load(found) if each["type"] == "page"]
            time.sleep(0.1)
        self._socket = socket.create_connection(("127.0.0.1", port), TIMEOUT_S)
        self._stream, self._numbers = self._socket.makefile("rb"), itertools.count(1)
        asked = (
            f"GET {urllib.parse.urlparse(pages[0]).path} HTTP/1.1", f"Host: 127.0.0.1:{port}", "Upgrade: websocket",
            "Connection: Upgrade", "Sec-WebSocket-Version: 13", "Sec-WebSocket-Key: cG1zbXRvb2wgbGl2ZSBwYQ==",
        )  # fmt: skip
        self._socket.sendall("\r\n".join((*asked, "", "")).encode())
        while self._stream.readline().strip():  # the answer's head
            pass

    def call(self, method: str, **given: Any) -> Any:
        """Call a method and return its result; raises ``RuntimeError`` where the browser refuses."""
        number = next(self._numbers)
        text = json.dumps({"id": number, "method": method, "params": given}).ljust(126).encode()  # of a 16-bit length
        self._socket.sendall(
            struct.pack(">BBHI", 0x81, 0x80 | 126, len(text), 0) + text
        )  # a mask of zeros masks nothing
        while (found := json.loads(self._message())).get("id") != number:
            pass
        if "error" in found:
            raise RuntimeError(f"{method}: {found['error']}")
        return found["result"]

    def _message(self) -> bytes:
        parts, last = [], False
        while not last:
            first, size = struct.unpack(">BB", self._stream.read(2))
            last = bool(first & 0x80)
            parts.append(self._stream.read(self._long(size)))
        return b"".join(parts)

    def _long(self, size: int) -> int:
        if size < 126:
            return size
        form = ">H" if size == 126 else ">Q"
        return int(struct.unpack(form, self._stream.read(struct.calcsize(form)))[0])


@contextmanager
def browsing(browser: str, url: str) -> Iterator[Page]:
    """Start a browser without a window on a page, and end it afterwards."""
    quiet = [option for option in QUIET if "pdf" not in option]  # which makes it print and close the page
    alone = ("--no-sandbox",) if getattr(os, "geteuid", lambda: 1)() == 0 else ()
    with tempfile.TemporaryDirectory(prefix="pmsmtool-", ignore_cleanup_errors=True) as folder:
        command = [browser, *quiet, *alone, "--remote-debugging-port=0", f"--user-data-dir={folder}", url]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            said, until = Path(folder) / "DevToolsActivePort", time.monotonic() + TIMEOUT_S
            while not said.is_file() or not said.read_text().strip():
                if process.poll() is not None or time.monotonic() > until:
                    raise RuntimeError(f"{browser} does not start")
                time.sleep(0.1)
            yield Page(int(said.read_text().split()[0]))
        finally:
            process.terminate()
            process.wait()


@dataclass(frozen=True, slots=True)
class Look:
    """What had come until one moment: number of the latest sample, how many are lost, rows and bytes that are held."""

    latest: int
    lost: int
    rows: int
    heap: float


def looked(page: Page, before: Look) -> Look:
    """Ask the page once more; samples that lie between those of ``before`` and the latest and are not held are lost."""
    numbers = json.loads(page.call("Runtime.evaluate", expression=HELD)["result"]["value"])
    page.call("HeapProfiler.collectGarbage")
    heap = page.call("Runtime.getHeapUsage")["usedSize"]
    fresh = [number for number in numbers if number > before.latest]
    latest = fresh[-1] if fresh else before.latest
    return Look(latest, before.lost + latest - before.latest - len(fresh), len(numbers), heap)


def looks(browser: str, seconds: float, look_s: float = LOOK_S) -> Iterator[Look]:
    """Feed the page for so long, and yield what it held."""
    names = [f"signal_{k}" for k in range(SIGNALS)]
    head = {"title": "live page", "keep_s": KEEP_S, "signals": [{"name": name, "unit": "A"} for name in names]}
    samples = Samples(names, math.ceil(KEEP_S * RATE_HZ) + 1)
    count = round(seconds * RATE_HZ)

    def feed() -> None:
        begun = time.monotonic()
        for k in range(count):
            t_s = k / RATE_HZ
            samples.add(t_s, [math.sin(t_s * (j + 1)) for j in range(SIGNALS)])
            time.sleep(max(0.0, begun + t_s - time.monotonic()))

    with (
        LiveServer(0, template("scope.html.j2").render(), samples, head) as server,
        server.serving(),
        browsing(browser, server.url) as page,
    ):
        feeding = threading.Thread(target=feed, daemon=True)
        feeding.start()
        look = Look(-1, 0, 0, 0.0)
        while feeding.is_alive():
            feeding.join(look_s)
            time.sleep(0.5 * (not feeding.is_alive()))  # the last samples are on their way
            look = looked(page, look)
            yield look


def main() -> int:
    """Print one line per look."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=600.0)
    seconds = parser.parse_args().seconds
    browser = find_browser()
    if browser is None:
        print("skipped: no browser on this computer; PMSMTOOL_BROWSER names one")
        return 0
    filled = most = 0.0
    for look in looks(browser, seconds):
        t_s = (look.latest + 1) / RATE_HZ
        print(f"{t_s:7.1f} s  {look.rows} rows, {look.lost} lost, {look.heap / 1e6:.2f} MB", flush=True)
        filled, most = (max(filled, look.heap), most) if t_s < KEEP_S + LOOK_S else (filled, max(most, look.heap))
    lost, whole = look.lost, look.latest + 1 == round(seconds * RATE_HZ)
    print(f"{look.latest + 1} of {round(seconds * RATE_HZ)} samples of {SIGNALS} signals, {lost} lost; "
          f"at most {filled / 1e6:.2f} MB while the ring was filled, {most / 1e6:.2f} MB afterwards")  # fmt: skip
    return int(lost > 0 or not whole or most > GROWTH * filled)


if __name__ == "__main__":
    sys.exit(main())
