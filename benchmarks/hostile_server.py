# SPDX-License-Identifier: MIT
"""A drive and a socketcand server that do anything: every reading command and ``stop`` against random behaviours.

Run from the repository: ``python -m benchmarks.hostile_server [N] [FIRST] [PROCESSES]`` (default 500 behaviours from
seed 0 in 4 processes). A behaviour is drawn from its seed: how the server greets, whether the drive falls silent,
drops, delays, doubles or damages frames, how long its objects and names are and what stands in them. Counted are
commands that take longer than they may, tracebacks (exit 70), control characters on the terminal, and stops that end
otherwise than with 0, 8, or 3 where no adapter opened. Exit code 1 says that something was found.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import multiprocessing
import os
import random
import socket
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

from pmsmtool.cli.drive_access import LOOKING_S, WHOLE_SET_S
from pmsmtool.cli.main import run

NODE = 5
OPEN_S = 12.0
"""An adapter that does not open."""
MARGIN_S = 4.0
"""Start of the command, two cores shared with other work."""
STOP_S = 12.0
"""2 s of silence, the states of a drive that answers slowly; no ramp here lasts longer than 4 s."""
SET_FILE = "set.toml"
COMMANDS: tuple[tuple[tuple[str, ...], float], ...] = (
    (("scan",), LOOKING_S),
    (("info",), LOOKING_S),
    (("info", "--json"), LOOKING_S),
    (("caps",), LOOKING_S),
    (("param", "get", "0x1008", "0x2010:01", "0x1018:04", "0x2042", "0x6041"), LOOKING_S),
    (("param", "get", "motor.*"), LOOKING_S),
    (("fault", "show"), LOOKING_S),
    (("monitor", "--for", "1s"), LOOKING_S),
    (("doctor",), LOOKING_S),
    (("param", "dump"), WHOLE_SET_S),
    (("param", "diff", "default", "device"), WHOLE_SET_S),
    (("verify", SET_FILE), WHOLE_SET_S),
    (("backup", "-o", "backup.json"), WHOLE_SET_S),
    (("flash-params", SET_FILE, "--dry-run"), WHOLE_SET_S),
    (("restore", "--dry-run"), WHOLE_SET_S),
    (("stop",), STOP_S),
    (("stop", "--all"), STOP_S),
)
GREETINGS = (
    b"",
    b"<",
    b"< hi >",
    b"\x1b[2J< hi >",
    b"< error \x1b]0;owned\x07 >",
    b"HTTP/1.1 400\r\n\r\n",
    b"\xff\xfe\0",
)
NAMES = (
    b"AX20",
    b"\x1b[2J\x1b[31mgone\r\nnode 1  stopped",
    b"\x9b31m\x07\x08\x7f",
    bytes(range(256)),
    b"\xe2\x80\xae drive",
    b"x" * 200_000,
    b"",
)
JUNK = (
    b"< frame 585 0.0 zz >",
    b"< frame 585 nan 4308100000000000 >",
    b"< frame 585 inf 43 >",
    b"< frame 585 0.0 " + b"43" * 64 + b" >",
    b"< frame 00000585 0.0 43 >",
    b"< frame >",
    b"< error 20000004 0.0 >",
    b"<<<<>>>> \x1b[2J",
    b"< frame 585",
    b"\xff\xff",
)


@dataclass(frozen=True)
class Nature:
    """What a behaviour is made of."""

    greeting: bytes | None
    silent_after: int
    drop: float
    double: float
    late: float
    late_s: float
    damage: float
    refuse: float
    stray: float
    text: float
    segments: str
    announced: str
    names: bytes
    status: int | None
    speed: int
    flood: bool
    close_after: int

    @classmethod
    def drawn(cls, rng: random.Random) -> Nature:
        """Draw one; most have few vices, so that commands get far."""

        def sometimes(value: float, share: float = 0.2) -> float:
            return value if rng.random() < share else 0.0

        return cls(
            rng.choice(GREETINGS) if rng.random() < 0.08 else None,
            rng.randrange(60) if rng.random() < 0.2 else 1 << 40,
            sometimes(rng.uniform(0.0, 0.5)),
            sometimes(rng.uniform(0.0, 1.0)),
            sometimes(rng.uniform(0.0, 1.0)),
            rng.choice((0.05, 0.29, 0.31, 0.5, 1.0)),
            sometimes(rng.uniform(0.0, 0.5)),
            sometimes(rng.uniform(0.0, 0.3)),
            sometimes(rng.uniform(0.0, 0.5)),
            sometimes(rng.uniform(0.0, 0.3), 0.1),
            rng.choice(("right", "right", "right", "endless", "empty", "single", "stuck toggle", "short")),
            rng.choice(("right", "right", "none", "huge", "zero", "other")),
            rng.choice(NAMES),
            rng.choice((None, None, None, 0x27, 0x0000, 0xFFFF, 0x08, 0x07)),
            rng.choice((0, 0, 1_000_000, 0x7FFFFFFF, -0x80000000)),
            rng.random() < 0.05,
            rng.randrange(100) if rng.random() < 0.05 else 1 << 40,
        )


class Drive:
    """An SDO server with the vices of a nature; frames go out through ``send``."""

    def __init__(self, nature: Nature, rng: random.Random) -> None:
        self.nature = nature
        self.rng = rng
        self.answers = 0
        self.state = rng.choice((0x40, 0x21, 0x27))
        self.body = b""
        self.position = 0
        self.toggle = 0
        self.written: tuple[int, int] | None = None

    def requested(self, data: bytes) -> Iterator[bytes]:
        """Yield the answers to a request."""
        self.answers += 1
        nature, rng = self.nature, self.rng
        if self.answers > nature.silent_after or rng.random() < nature.drop:
            return
        for frame in self._answers(data.ljust(8, b"\0")):
            if rng.random() < nature.damage:
                kind = rng.randrange(4)
                frame = (
                    rng.randbytes(8) if kind == 0 else bytes((rng.randrange(256),)) + frame[1:] if kind == 1
                    else frame[: rng.randrange(9)] if kind == 2 else frame[:1] + rng.randbytes(3) + frame[4:]
                )  # fmt: skip
            yield frame
            if rng.random() < nature.double:
                yield frame

    def _answers(self, data: bytes) -> list[bytes]:
        kind, head = data[0] >> 5, data[1:4]
        index, sub = data[1] | data[2] << 8, data[3]
        if kind in (1, 2, 5, 6) and self.rng.random() < self.nature.refuse:
            code = self.rng.choice(
                (0x06020000, 0x05040000, 0x08000000, 0x06090011, 0x05040001, self.rng.getrandbits(32))
            )
            return [b"\x80" + head + code.to_bytes(4, "little")]
        if kind == 1:
            if index == 0x6040:
                self._controlword(data[4])
            return [b"\x60" + head + bytes(4)]
        if kind == 2:
            return [self._upload(index, sub, head)]
        if kind == 3:
            return [self._segment()]
        if kind in (5, 6):
            return self._block(data, head)
        return []

    def _controlword(self, word: int) -> None:
        if not word & 0x02 or not word & 0x04:
            self.state = 0x40

    def _upload(self, index: int, sub: int, head: bytes) -> bytes:
        body = self._object(index, sub)
        if body is None:
            return b"\x80" + head + (0x06020000).to_bytes(4, "little")
        self.body, self.position, self.toggle = body, 0, 0
        announced = {"right": len(body), "huge": 0xFFFFFFFF, "zero": 0, "other": self.rng.getrandbits(16)}
        if 0 < len(body) <= 4 and self.nature.announced != "other":
            return bytes((0x43 | (4 - len(body)) << 2,)) + head + body.ljust(4, b"\0")
        size = announced.get(self.nature.announced)
        return (b"\x40" if size is None else b"\x41") + head + (size or 0).to_bytes(4, "little")

    def _segment(self) -> bytes:
        kind = self.nature.segments
        count = {"empty": 0, "single": 1, "short": 3}.get(kind, 7)
        piece = self.body[self.position : self.position + count].ljust(count if kind == "endless" else 0, b"\x1b")
        self.position += count
        last = self.position >= len(self.body) and kind not in ("endless", "empty")
        frame = bytes((self.toggle | (7 - len(piece)) << 1 | last,)) + piece.ljust(7, b"\0")
        self.toggle ^= 0x00 if kind == "stuck toggle" else 0x10
        return frame

    def _block(self, data: bytes, head: bytes) -> list[bytes]:
        kind = self.rng.randrange(4)
        if kind == 0:
            return [b"\x80" + head + (0x05040001).to_bytes(4, "little")]
        if data[0] & 0xE3 == 0xA0:
            return [bytes((0xC0 | self.rng.choice((0, 2, 4, 6)),)) + head + self.rng.randbytes(4)]
        if data[0] & 0xE3 == 0xA3 or data[0] & 0xE3 == 0xA2:
            count = self.rng.choice((0, 1, 5, 127))
            return [bytes((k + 1,)) + bytes(7) for k in range(count)] * (1 if kind < 3 else 5)
        return [
            bytes((0xA0 | self.rng.randrange(8), self.rng.choice((0, 1, 200)), self.rng.choice((0, 4, 127)))) + bytes(5)
        ]

    def _object(self, index: int, sub: int) -> bytes | None:
        if index == 0x6041:
            return (self.state if self.nature.status is None else self.nature.status).to_bytes(2, "little")
        if index in (0x1008, 0x1009, 0x100A):
            return self.nature.names
        known = {
            (0x1000, 0): (402).to_bytes(4, "little"), (0x1001, 0): b"\0", (0x1017, 0): b"\x64\0",
            (0x1018, 0): b"\x04", (0x1018, 1): b"\x07\0\0\0", (0x1018, 2): b"\x08\0\0\0",
            (0x1018, 3): b"\x01\0\0\0", (0x1018, 4): b"\x2a\0\0\0", (0x603F, 0): b"\x10\x23", (0x605A, 0): b"\x02\0",
            (0x606C, 0): self.nature.speed.to_bytes(4, "little", signed=True), (0x6085, 0): b"\0\x04\0\0",
            (0x2042, 0): bytes(3000), (0x2010, 1): b"\x07\0\0\0",
        }  # fmt: skip
        return known.get(
            (index, sub), self.rng.randbytes(self.rng.choice((1, 2, 4, 4, 4, 9))) if index > 0x2000 else None
        )


class Server:
    """A socketcand server with one drive, and whatever else its nature puts on the bus."""

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)
        self.nature = Nature.drawn(self.rng)
        self._drive = Drive(self.nature, self.rng)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._ended = threading.Event()
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        """Stop listening and talking."""
        self._ended.set()
        self._listener.close()

    def _accept(self) -> None:
        while not self._ended.is_set():
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            threading.Thread(target=self._serve, args=(client,), daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        with contextlib.suppress(OSError, ValueError, IndexError), client:
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if self.nature.greeting is not None:
                client.sendall(self.nature.greeting)
                self._ended.wait(60.0)
                return
            client.sendall(b"< hi >")
            buffer, lock = b"", threading.Lock()
            talking = False
            while not self._ended.is_set():
                data = client.recv(65536)
                if not data:
                    return
                *words, buffer = (buffer + data).split(b">")
                for word in words:
                    text = word.strip().removeprefix(b"<").split()
                    if text[:1] == [b"send"]:
                        self._frame(client, lock, text)
                    else:
                        client.sendall(b"< ok >")
                    if text[:1] == [b"rawmode"] and not talking:
                        talking = True
                        threading.Thread(target=self._talk, args=(client, lock), daemon=True).start()

    def _talk(self, client: socket.socket, lock: threading.Lock) -> None:
        """Send what nobody asked for."""
        rng, nature = self.rng, self.nature
        with contextlib.suppress(OSError):
            self._ended.wait(0.1)
            while not self._ended.is_set():
                if rng.random() < nature.text:
                    with lock:
                        client.sendall(rng.choice(JUNK))
                if rng.random() < nature.stray:
                    cob_id = rng.choice((0x080, 0x180, 0x580, 0x600, 0x700, 0x77E - NODE, -NODE)) + NODE
                    _send(client, lock, cob_id, rng.randbytes(rng.randrange(9)))
                if nature.flood:
                    for _ in range(20):
                        _send(client, lock, 0x580 + NODE, rng.randbytes(8))
                self._ended.wait(0.005 if nature.flood else 0.1)

    def _frame(self, client: socket.socket, lock: threading.Lock, words: list[bytes]) -> None:
        cob_id, count = int(words[1], 16), int(words[2], 16)
        data = bytes(int(word, 16) for word in words[3 : 3 + count])
        if cob_id != 0x600 + NODE:
            return
        if self._drive.answers > self.nature.close_after:
            client.close()
        for frame in self._drive.requested(data):
            if self.rng.random() < self.nature.late:
                late = threading.Timer(self.nature.late_s, _send, (client, lock, 0x580 + NODE, frame))
                late.daemon = True
                late.start()
            else:
                _send(client, lock, 0x580 + NODE, frame)


def _send(client: socket.socket, lock: threading.Lock, cob_id: int, data: bytes) -> None:
    with contextlib.suppress(OSError), lock:
        client.sendall(f"< frame {cob_id:03X} {time.time():.6f} {data.hex()} >".encode())


def examine(seed: int, command: tuple[str, ...], limit_s: float) -> tuple[str, float, str]:
    """Run one command against one behaviour.

    Returns
    -------
    verdict, seconds, text
        ``exit N`` when nothing is wrong, else what is.
    """
    server = Server(seed)
    node = () if seed % 4 == 0 or "--all" in command else ("-n", str(NODE))
    place = {"host": "127.0.0.1", "port": server.port, "tcp_tune": True}
    out, err = io.StringIO(), io.StringIO()
    began = time.monotonic()
    with (
        mock.patch.dict(os.environ, {"CAN_CONFIG": json.dumps(place)}),
        mock.patch("click.utils.should_strip_ansi", return_value=False),
        mock.patch("click.style", lambda text, **given: text),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        code = run(["-i", "socketcand", "-c", "vcan0", *node, *command])
    seconds = time.monotonic() - began
    server.close()
    text = out.getvalue() + err.getvalue()
    odd = {c for c in text if not (c.isprintable() or c in "\n\t")}
    if code == 70 or "Traceback" in text:
        return "TRACEBACK", seconds, text
    if odd:
        return "CONTROL CHARACTERS", seconds, f"{sorted(map(repr, odd))} in {text!r}"
    if len(text) > 40_000 and "--json" not in command:
        return "ENDLESS TEXT", seconds, text[:1000]
    if seconds > limit_s + MARGIN_S + (OPEN_S if server.nature.greeting is not None else 0.0):
        return "TOO LONG", seconds, text
    if command[0] == "stop" and code not in (0, 8) and not (code == 3 and server.nature.greeting is not None):
        return f"STOP ENDS WITH {code}", seconds, text
    return f"exit {code}", seconds, text


def _work(seeds: list[int], results: multiprocessing.Queue[tuple[int, tuple[str, ...], str, float, str]]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        os.environ["PMSMTOOL_HOME"] = folder
        Path(SET_FILE).write_text('schema = "pmsmtool.params/1"\n[motor]\nR_s_ohm = 0.25\n')
        for seed in seeds:
            command, limit_s = COMMANDS[seed % len(COMMANDS)]
            results.put((seed, command, *examine(seed, command, limit_s)))


def main() -> int:
    """Print what was found; 1 when something was."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in (("count", 500), ("first", 0), ("processes", 4)):
        parser.add_argument(name, nargs="?", type=int, default=default)
    asked = parser.parse_args()
    count, first, processes = asked.count, asked.first, asked.processes
    context = multiprocessing.get_context("spawn")
    results: multiprocessing.Queue[tuple[int, tuple[str, ...], str, float, str]] = context.Queue()
    seeds = range(first, first + count)
    workers = [context.Process(target=_work, args=(list(seeds[k::processes]), results)) for k in range(processes)]
    for worker in workers:
        worker.start()
    ended: dict[str, Counter[str]] = {}
    longest: dict[str, float] = {}
    bad = 0
    for _ in seeds:
        seed, command, verdict, seconds, text = results.get(timeout=600.0)
        name = " ".join(command[:2])
        ended.setdefault(name, Counter())[verdict] += 1
        longest[name] = max(longest.get(name, 0.0), seconds)
        if not verdict.startswith("exit"):
            bad += 1
            print(f"seed {seed}: {' '.join(command)}: {verdict} ({seconds:.1f} s)\n{text[-1500:]}\n", flush=True)
    for worker in workers:
        worker.join()
    for name, found in sorted(ended.items()):
        print(f"{name:<20} longest {longest[name]:6.1f} s  {dict(sorted(found.items()))}")
    print(f"{count} behaviours: {bad} wrong")
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
