# SPDX-License-Identifier: MIT
"""Real SIGKILLs: ``pmsmtool flash-params`` against a drive in another process, killed at any moment."""

from __future__ import annotations

import os
import random
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from pmsmtool.bus.connect import Connection
from pmsmtool.bus.sdo import Mode
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.parameters import DriveParameters
from pmsmtool.firmware.image import crc32
from pmsmtool.params.parameter_set import ParameterSet
from tests.drive.served import ROOT, Server, serving
from tests.flash.rig import with_tables

pytestmark = pytest.mark.wall_clock

KILLS = 2
"""One taken back and one finished, of different sets; the full 50 are run by ``benchmarks/killed_downloads.py``."""

OTHER = ParameterSet({"motor.R_s_ohm": 0.5, "motor.L_d_h": 0.005, "current.K_p_d_v_per_a": 3.0, "motor.pole_pairs": 3})


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with serving("--nv", ":memory:") as running:
        yield running


def start(server: Server, home: Path, *arguments: str) -> subprocess.Popen[str]:
    """Run the tool in a process of its own, with journals in ``home``."""
    (home / ".canrc").write_text(
        f"[default]\ninterface = socketcand\nchannel = vcan0\nhost = 127.0.0.1\nport = {server.port}\n"
    )
    environment = {**os.environ, "PMSMTOOL_HOME": str(home), "HOME": str(home), "PYTHONPATH": str(ROOT)}
    consent = ["--yes", "--i-max", "1Apk", "--speed-max", "1rpm", "--shaft", "free", "--serial", "22001"]
    return subprocess.Popen(
        [sys.executable, "-m", "pmsmtool", "-n", "1", *arguments, *consent],
        cwd=home,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def held(connection: Connection) -> tuple[bytes, int, int]:
    """The drive's active image, and its CRC-32 of active and stored set."""
    node = DriveNode(connection, 1)
    node.identity()
    parameters = DriveParameters(node)
    parameters.settle()
    image = node.sdo.upload(0x2001, 0, mode=Mode.BLOCK).data
    crcs = parameters.crc_active, parameters.crc_stored
    node.close()
    return image, *crcs


def wait_until_it_writes(process: subprocess.Popen[str]) -> None:
    """Return when the tool has begun its journal: the moments that matter follow."""
    assert process.stderr is not None
    for line in process.stderr:
        if line.startswith("journal:"):
            return


def kill_and_recover(server: Server, home: Path, wanted: Path, delay_s: float, *, finish: str) -> str:
    """Kill a download ``delay_s`` after its journal, check the drive, finish it; return what the drive held."""
    with server.connect() as connection:
        old, _, old_stored = held(connection)
    process = start(server, home, "flash-params", str(wanted))
    wait_until_it_writes(process)
    time.sleep(delay_s)
    process.kill()
    process.communicate(timeout=30)
    time.sleep(0.6)  # a store that was under way ends
    with server.connect() as connection:
        now, active, stored = held(connection)
    assert crc32(now) == active, "the drive's own CRC is that of what acts"
    arguments = ["flash-params", str(wanted)] if finish == "again" else ["restore"]
    done = start(server, home, *arguments)
    _, text = done.communicate(timeout=60)
    assert done.returncode == 0, text
    with server.connect() as connection:
        after, active, stored_after = held(connection)
    assert active == crc32(after) == stored_after
    if finish == "restore":
        assert after == old
    assert now in (old, after) or finish == "restore"
    assert stored in (old_stored, active, crc32(now))
    return "old" if now == old else "new"


@pytest.mark.chain
@pytest.mark.parametrize("run", range(KILLS))
def test_killed_download_is_finished_or_taken_back(server: Server, tmp_path: Path, run: int) -> None:
    wanted = tmp_path / "wanted.toml"
    wanted.write_text((with_tables() if run % 2 else OTHER).to_toml())
    delay = random.Random(run).uniform(0.0, 1.2)
    kill_and_recover(server, tmp_path, wanted, delay, finish="again" if run % 3 else "restore")
