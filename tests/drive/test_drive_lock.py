# SPDX-License-Identifier: MIT
"""One program per drive: who comes second is told who was first, and a lock ends with its owner."""

from __future__ import annotations

import os
import random
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.two_tools import race
from pmsmtool.bus.connection import Connection
from pmsmtool.bus.supervision import SecondMaster
from pmsmtool.cli.main import run
from pmsmtool.drive.drive_lock import claim
from pmsmtool.sim.bus import PmsmSimBus
from tests.bus.scripted import NODE, ScriptedBus, ScriptedSlave
from tests.drive.served import serving
from tests.simulated_bus import settle


def connection(monkeypatch: pytest.MonkeyPatch, serial: int) -> Connection:
    """A bus that other programs may share, with a drive of a serial number."""
    objects = {(0x1018, sub): number.to_bytes(4, "little") for sub, number in ((1, 7), (2, 8), (4, serial))}
    monkeypatch.setattr(Connection, "shared", True)
    return Connection(ScriptedBus(ScriptedSlave(objects)))


def test_second_is_told_who_until_the_first_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PMSMTOOL_HOME", str(tmp_path))
    first, second = connection(monkeypatch, 42), connection(monkeypatch, 42)
    claim(first, NODE)
    with pytest.raises(SecondMaster, match=f"process {os.getpid()} of .* since 20"):
        claim(second, NODE)
    claim(connection(monkeypatch, 43), NODE)
    first.close()
    claim(second, NODE)


def test_drives_without_a_serial_number_are_told_apart_by_their_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PMSMTOOL_HOME", str(tmp_path))
    claim(connection(monkeypatch, 0), NODE)
    other = connection(monkeypatch, 0)
    other.bus.channel_info = "another bus"
    claim(other, NODE)
    with pytest.raises(SecondMaster):
        claim(connection(monkeypatch, 0), NODE)


@pytest.mark.chain
def test_a_lock_ends_with_its_owner(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PMSMTOOL_HOME", str(tmp_path))
    code = (
        "import os, signal, pytest\n"
        "from tests.drive.test_drive_lock import *\n"
        "claim(connection(pytest.MonkeyPatch(), 42), NODE)\n"
        "print('locked', flush=True)\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    owner = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, timeout=60)
    assert owner.stdout == "locked\n"
    claim(connection(monkeypatch, 42), NODE)


def test_a_drive_at_work_is_not_reset_by_nmt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    settle(tmp_path, monkeypatch)
    monkeypatch.setattr(Connection, "shared", True)
    command = ["-i", "pmsmsim", "-c", "interior-2k2?nv=:memory:", "nmt", "reset-node"]
    with Connection(PmsmSimBus("interior-2k2?nv=:memory:")) as working:
        claim(working, 1)
        assert run(command) == 3
        assert "another pmsmtool works with this drive" in capsys.readouterr().err
    assert run(command) == 0


@pytest.mark.chain
@pytest.mark.wall_clock
def test_of_two_downloads_one_wins(tmp_path: Path) -> None:
    rng = random.Random(5)
    with serving("--nv", ":memory:") as server:
        ended = [race(server, tmp_path, number, rng) for number in range(2)]
    assert "FAILED" not in ended
