# SPDX-License-Identifier: MIT
"""A served drive among clients that vanish, flood it or never read: time of its answers, memory of the server.

Run from the repository: ``python -m benchmarks.serve_soak [CLIENTS [FRAMES [SECONDS]]]`` (default 10 000 vanishing
clients, a flood of 1 000 000 frames, 600 s of both). One client reads 0x1000 all the while.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import random
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parent.parent
READ_SERIAL = b"< send 601 8 40 18 10 04 00 00 00 00 >"
READ_TYPE = b"< send 601 8 40 00 10 00 00 00 00 00 >"
HELLO = b"< open vcan0 >< rawmode >"
FLOOD = b"< send 7DF 8 00 01 02 03 04 05 06 07 >" * 200
LONGEST_ANSWER_S = 0.5
GROWTH_MB = 8.0
"""What the server's memory may grow by: the unread bytes of one client, and what the interpreter keeps."""
EVERY_S = 0.02
DEFAULTS = (10_000, 1_000_000, 600)


@dataclass
class Probe:
    """A client that asks for the drive's type again and again."""

    port: int
    waited_s: list[float] = field(default_factory=list)
    ended: threading.Event = field(default_factory=threading.Event)

    def run(self) -> None:
        """Ask until ``ended``; a time-out counts as ten seconds."""
        with connect(self.port) as connection:
            connection.settimeout(10.0)
            connection.sendall(HELLO)
            held = b""
            while not self.ended.is_set():
                asked = time.monotonic()
                connection.sendall(READ_TYPE)
                while b"43001000" not in held:
                    held = held[-40:] + connection.recv(1 << 16)
                held = b""
                self.waited_s.append(time.monotonic() - asked)
                time.sleep(EVERY_S)


@contextlib.contextmanager
def connect(port: int) -> Iterator[socket.socket]:
    """Open a connection and close it."""
    connection = socket.create_connection(("127.0.0.1", port), timeout=10.0)
    try:
        yield connection
    finally:
        connection.close()


def vanish(port: int, rng: random.Random) -> None:
    """Connect, say a part of the handshake or all of it, and be gone: closed, reset, or with unread frames."""
    with contextlib.suppress(OSError), connect(port) as connection:
        connection.sendall((HELLO + READ_SERIAL)[: rng.randrange(len(HELLO + READ_SERIAL) + 1)])
        if rng.random() < 0.5:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        if rng.random() < 0.1:
            time.sleep(0.001)


def flood(port: int, frames: int) -> None:
    """Send frames as fast as they are taken, and never read one."""
    with contextlib.suppress(OSError), connect(port) as connection:
        connection.settimeout(600.0)
        connection.sendall(HELLO)
        for _ in range(frames // 200):
            connection.sendall(FLOOD)


def memory_mb(pid: int) -> float:
    """Return the resident memory of a process (MB)."""
    status = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    return int(next(line for line in status.splitlines() if line.startswith("VmRSS")).split()[1]) / 1024


@dataclass
class Soaked:
    """What was seen: longest and median wait for an answer (s), answers, growth of the memory (MB)."""

    longest_s: float
    median_s: float
    answers: int
    growth_mb: float

    def ok(self) -> bool:
        """Whether answers came in time and the memory stayed."""
        return self.longest_s <= LONGEST_ANSWER_S and self.growth_mb <= GROWTH_MB


def soak(clients: int, frames: int, seconds: float = 0.0, seed: int = 17) -> Soaked:
    """Let clients vanish, then flood the line, then do both for a time; measure throughout."""
    command = [sys.executable, "-m", "pmsmtool", "sim", "serve", "interior-2k2?nv=:memory:", "--port", "0", "--json"]
    server = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    assert server.stdout is not None
    try:
        port = json.loads(server.stdout.readline())["port"]
        probe = Probe(port)
        thread = threading.Thread(target=probe.run)
        thread.start()
        rng = random.Random(seed)
        for _ in range(200):
            vanish(port, rng)
        flood(port, 2000)  # what the interpreter allocates once is there
        before = memory_mb(server.pid)
        for _ in range(clients):
            vanish(port, rng)
        flood(port, frames)
        end = time.monotonic() + seconds
        for turn in itertools.count():
            if time.monotonic() >= end:
                break
            vanish(port, rng)
            if turn % 100 == 0:
                flood(port, 2000)
        time.sleep(0.5)
        probe.ended.set()
        thread.join(15.0)
        after = memory_mb(server.pid)
        waited = sorted(probe.waited_s) if not thread.is_alive() else [10.0]
        return Soaked(waited[-1], waited[len(waited) // 2], len(waited), after - before)
    finally:
        server.send_signal(signal.SIGINT)
        server.wait(10.0)


def main() -> int:
    """Print what was seen; 1 when it is beyond the limits."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in zip(("clients", "frames", "seconds"), DEFAULTS, strict=True):
        parser.add_argument(name, nargs="?", type=int, default=default)
    asked = parser.parse_args()
    clients, frames, seconds = asked.clients, asked.frames, asked.seconds
    started = time.perf_counter()
    seen = soak(clients, frames, seconds)
    print(
        f"{clients} vanishing clients, {frames} frames, {seconds} s of both: {seen.answers} answers, "
        f"median {1e3 * seen.median_s:.1f} ms, longest {1e3 * seen.longest_s:.0f} ms, "
        f"memory {seen.growth_mb:+.1f} MB, {time.perf_counter() - started:.0f} s"
    )
    return 0 if seen.ok() else 1


if __name__ == "__main__":
    sys.exit(main())
