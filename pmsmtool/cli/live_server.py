# SPDX-License-Identifier: MIT
"""A live page: a ring of samples, and a server on 127.0.0.1 that streams them to browsers.

``scope`` streams signals, ``report --follow`` the number of its latest drawing.

One thread writes the ring and waits for nobody. Each browser has a thread of its own that follows the ring
(Server-Sent Events, HTML standard, section 9.2); one that does not read is dropped, one that is late misses samples.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import os
import re
import socketserver
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler
from typing import TYPE_CHECKING, Any

from pmsmtool.errors import ConfigError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pmsmtool.trace import Trace

HOST = "127.0.0.1"
MOST_NUMBERS = 2_000_000
"""Numbers that the ring holds, 16 MB; as CSV they stay below what is read back (``files.ROWS_BYTES``)."""
MOST_CONNECTIONS = 32
"""Connections at a time; more are closed unanswered."""
PATIENCE_S = 5.0
"""A browser that sends no request, or does not read, for this long is dropped."""
REFRESH_S = 0.05
"""Samples go to the page this often."""
ALIVE_S = 1.0
"""Without samples a comment is sent this often, so that a browser that is gone is noticed."""
MOST_ROWS = 500
"""Samples of one event: a browser that joins late gets the ring in pieces, and the others their turn in between."""
GOODBYE_S = 1.0
"""Time for the browsers to hear how it ended, before the server goes."""


class Samples:
    """The latest samples of some signals.

    Raises
    ------
    ConfigError
        More numbers than are kept (:data:`MOST_NUMBERS`).
    """

    def __init__(self, names: Sequence[str], rows: int) -> None:
        import numpy as np

        numbers = rows * (1 + len(names))
        if numbers > MOST_NUMBERS:
            raise ConfigError(
                f"{rows} samples of {len(names)} signals are {numbers} numbers, and {MOST_NUMBERS} are kept",
                where="--keep",
                hint="keep a shorter time, choose fewer signals, or a lower --rate",
            )
        self.names = tuple(names)
        self.count = 0
        self.ended: Mapping[str, Any] | None = None
        self._ring = np.empty((rows, 1 + len(names)))
        self._arrived = threading.Condition()

    def add(self, t_s: float, values: Iterable[float]) -> None:
        """Take a sample; one that is not later than the last is left out."""
        ring = self._ring
        with self._arrived:
            if self.count and t_s <= ring[(self.count - 1) % len(ring), 0]:
                return
            ring[self.count % len(ring)] = (t_s, *values)
            self.count += 1
            self._arrived.notify_all()

    def end(self, text: str, *, good: bool) -> None:
        """Say how it ended, once."""
        with self._arrived:
            self.ended = self.ended or {"text": text, "good": good}
            self._arrived.notify_all()

    def since(self, number: int, timeout_s: float = 0.0, most: int | None = None) -> tuple[int, NDArray[np.float64]]:
        """Wait for samples from ``number`` on; return the number after them, and them, shape (n, 1 + signals)."""
        import numpy as np

        with self._arrived:
            self._arrived.wait_for(lambda: self.count > number or self.ended is not None, timeout_s)
            first = max(number, self.count - len(self._ring))
            last = self.count if most is None else min(self.count, first + most)
            return last, self._ring[np.arange(first, last) % len(self._ring)]

    def trace(self, units: Mapping[str, str], facts: Mapping[str, Any]) -> Trace:
        """Return what is kept."""
        from pmsmtool.trace import Trace

        _, rows = self.since(0)
        return Trace(rows[:, 0], {name: rows[:, k] for k, name in enumerate(self.names, 1)}, dict(units), facts)


class LiveServer(socketserver.ThreadingTCPServer):
    """Serves one page, and the samples to it. Raises ConfigError: the port cannot be had.

    Parameters
    ----------
    port : int
        Where to listen on this computer; 0 chooses a free one.
    page : str
        The page; its scripts stand in it.
    head : mapping
        What the page is told first: ``title``, ``keep_s``, ``signals`` with ``name`` and ``unit``.
    """

    allow_reuse_address = os.name == "posix"  # Windows would let two servers share a port
    daemon_threads = True
    block_on_close = False
    request_queue_size = MOST_CONNECTIONS

    def __init__(self, port: int, page: str, samples: Samples, head: Mapping[str, Any]) -> None:
        try:
            super().__init__((HOST, port), _Request)
        except OSError as error:
            raise ConfigError(
                f"cannot listen: {error.strerror or error}", where=f"{HOST}:{port}",
                likely="another program listens there", hint="choose another --port; 0 takes a free one",
            ) from error  # fmt: skip
        self.show(page)
        self.samples = samples
        self.head = head
        self.streams = 0
        port = self.server_address[1]
        self.url = f"http://{HOST}:{port}/"
        self.hosts = frozenset({f"{HOST}:{port}", f"localhost:{port}"})
        self._places = threading.BoundedSemaphore(MOST_CONNECTIONS)
        self._lock = threading.Lock()

    def show(self, page: str) -> None:
        """Serve another page from now on."""
        scripts = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
        hashes = (base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in scripts)
        allowed = " ".join(f"'sha256-{text}'" for text in hashes)
        policy = (
            f"default-src 'none'; style-src 'unsafe-inline'; connect-src 'self'; img-src data:; script-src {allowed}"
        )
        self.shown = page.encode(), f"{policy} 'wasm-unsafe-eval'"

    @contextmanager
    def streaming(self) -> Iterator[None]:
        """Count a browser that follows the samples."""
        with self._lock:
            self.streams += 1
        try:
            yield
        finally:
            with self._lock:
                self.streams -= 1

    def process_request(self, request: Any, client_address: Any) -> None:
        """Give a connection its thread, or close it where there are too many."""
        if self._places.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer one connection."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._places.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Pass over browsers that went away; anything else is a bug and is shown."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)

    @contextmanager
    def serving(self) -> Iterator[None]:
        """Serve; at the end the browsers get a moment to hear why."""
        threading.Thread(target=self.serve_forever, args=(0.1,), name="scope page", daemon=True).start()
        try:
            yield
        finally:
            self.samples.end("pmsmtool has ended", good=False)
            latest = time.monotonic() + GOODBYE_S
            while self.streams and time.monotonic() < latest:
                time.sleep(0.02)
            self.shutdown()
            self.server_close()


class _Request(BaseHTTPRequestHandler):
    """One request: the page, or the samples as they come."""

    server: LiveServer
    timeout = PATIENCE_S
    server_version, sys_version = "pmsmtool", ""

    def do_GET(self) -> None:
        """Answer; a page of another site that got hold of our address (DNS rebinding) is told nothing."""
        if [host.strip().lower() for host in self.headers.get_all("Host", [])][:2] not in self._allowed():
            self.send_error(403, "not the address of this page")
        elif self.path == "/":
            page, policy = self.server.shown
            self._begin("text/html; charset=utf-8", policy)
            self.wfile.write(page)
        elif self.path == "/samples":
            self._begin("text/event-stream")
            with self.server.streaming():
                self._stream()
        else:
            self.send_error(404)

    def _allowed(self) -> list[list[str]]:
        return [[host] for host in self.server.hosts]

    def _begin(self, kind: str, policy: str = "default-src 'none'") -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Content-Security-Policy", policy)
        self.end_headers()

    def _stream(self) -> None:
        samples, number = self.server.samples, 0
        self._event("head", json.dumps(self.server.head))
        while True:
            ended = samples.ended  # before the samples: those that came until then are sent
            number, rows = samples.since(number, ALIVE_S, MOST_ROWS)
            if len(rows):
                self._event("samples", _json_rows(rows.tolist()))
            elif ended is not None:
                self._event("end", json.dumps(ended))
                return
            else:
                self.wfile.write(b":\n\n")
            if len(rows) < MOST_ROWS and ended is None:
                time.sleep(REFRESH_S)

    def _event(self, name: str, text: str) -> None:
        self.wfile.write(f"event: {name}\ndata: {text}\n\n".encode())

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing: what a browser asks is no news at the terminal."""

    def finish(self) -> None:
        """Close; whoever went away meanwhile is no error."""
        with suppress(OSError):
            super().finish()


def _json_rows(rows: list[list[float]]) -> str:
    """Return samples as JSON, which has no word for a number that is not finite but null."""
    texts = (",".join(f"{x:.8g}" if math.isfinite(x) else "null" for x in row) for row in rows)
    return f"[{','.join(f'[{text}]' for text in texts)}]"
