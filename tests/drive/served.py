# SPDX-License-Identifier: MIT
"""A simulated drive in a process of its own, joined over socketcand."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pmsmtool.bus.connect import Connection, connect
from tests.wall_clock import listen

ROOT = Path(__file__).parents[2]


@dataclass
class Server:
    """The process and where it listens."""

    process: subprocess.Popen[str]
    port: int

    def connect(self) -> Connection:
        """Join the bus."""
        return connect("socketcand", "vcan0", host="127.0.0.1", port=self.port, ignore_config=True)


@contextlib.contextmanager
def serving(*arguments: str, profile: str = "interior-2k2") -> Iterator[Server]:
    """Run ``pmsmtool sim serve`` on a free port."""
    command = [sys.executable, "-m", "pmsmtool", "sim", "serve", profile, "--port", "0", "--json", *arguments]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None and process.stderr is not None
        listen(process.stderr)
        yield Server(process, json.loads(process.stdout.readline())["port"])
    finally:
        process.terminate()
        process.wait(10)
