# SPDX-License-Identifier: MIT
"""One program per drive: who comes second is told who was first, and a lock ends with its owner."""

from __future__ import annotations

import getpass
import os
import random
import re
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.two_tools import FAILED, race
from pmsmtool.bus.connection import Connection
from pmsmtool.bus.supervision import SecondMaster
from pmsmtool.cli.main import run
from pmsmtool.drive.drive_lock import claim, claim_identity, claim_layer_setting
from pmsmtool.drive_maps.drive_map import reference_map
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


@pytest.mark.parametrize("says", [True, False])
def test_a_holder_that_has_not_said_who_it_is_is_waited_for(
    says: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It says so after it has the lock: of two downloads the second was told "unknown"."""
    monkeypatch.setenv("PMSMTOOL_HOME", str(tmp_path))
    claim(connection(monkeypatch, 42), NODE)
    (lock,) = (tmp_path / "locks").iterdir()
    lock.write_text("")
    second, waits = connection(monkeypatch, 42), []

    def wait(seconds: float) -> None:
        waits.append(seconds)
        if says and len(waits) == 2:
            lock.write_text("ada")

    monkeypatch.setattr(second.clock, "wait", wait)
    with pytest.raises(SecondMaster, match="this drive: ada" if says else "this drive: unknown"):
        claim(second, NODE)
    assert len(waits) == 2 if says else 0.1 < sum(waits) < 0.5


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("long", [False, True])
def test_the_owner_of_a_lock_is_named_by_process_user_time_and_command(
    known: bool, long: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On one line, of 200 letters at most, whatever stands in the command."""
    monkeypatch.setenv("PMSMTOOL_HOME", str(tmp_path))
    monkeypatch.setattr(sys, "argv", ["/opt/bin/pmsmtool", "jog", "--for\n", "x" * 300 if long else "2s"])

    def user() -> str:
        if known:
            return "ada"
        raise KeyError("no such user")

    monkeypatch.setattr(getpass, "getuser", user)
    claim(connection(monkeypatch, 42), NODE)
    with pytest.raises(SecondMaster) as caught:
        claim(connection(monkeypatch, 42), NODE)
    head, _, owner = caught.value.what.partition("works with this drive: ")
    assert head == "another pmsmtool "
    who = "ada" if known else "an unknown user"
    told = re.fullmatch(rf"process {os.getpid()} of {who} since \d{{4}}-\d\d-\d\d \d\d:\d\d:\d\d: (.*)", owner)
    assert told is not None and told[1].startswith("pmsmtool jog --for")
    assert (len(owner) == 200 + owner.count("\\n")) if long else told[1].endswith("2s")


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


@pytest.mark.parametrize("command", [["scan"], ["set-node", "9"]])
def test_one_program_gives_node_ids_on_a_bus(
    command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Answers of layer setting services carry no node id: those to one master would be taken by the other."""
    settle(tmp_path, monkeypatch)
    monkeypatch.setattr(Connection, "shared", True)
    channel = "interior-2k2?nv=:memory:&node=255"
    given = ["-i", "pmsmsim", "-c", channel, "--yes", "lss", *command]
    given = given if command[0] == "set-node" else [word for word in given if word != "--yes"]
    with Connection(PmsmSimBus(channel)) as working:
        claim_layer_setting(working)
        assert run(given) == 3
        assert "another pmsmtool works with the layer setting services of this bus" in capsys.readouterr().err
    assert run(given) == 0


def test_a_drive_without_a_node_id_has_the_same_lock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One gives it an id while the other, to whom it answered before its reset, still writes."""
    monkeypatch.setenv("PMSMTOOL_HOME", str(tmp_path))
    first, second = connection(monkeypatch, 42), connection(monkeypatch, 42)
    claim(first, NODE)
    with pytest.raises(SecondMaster, match="another pmsmtool works with this drive"):
        claim_identity(second, 7, 8, 42)
    claim_identity(second, 7, 8, 43)
    for each in (first, second):  # nothing to tell two of them apart by
        claim_identity(each, 7, 8, 0)
        claim_identity(each, reference_map().vendor, 8, 42)
    first.close()
    claim_identity(second, 7, 8, 42)


@pytest.mark.chain
@pytest.mark.wall_clock
def test_of_two_downloads_one_wins(tmp_path: Path) -> None:
    rng = random.Random(5)
    with serving("--nv", ":memory:") as server:
        ended = [race(server, tmp_path, number, rng) for number in range(2)]
    assert not [one for one in ended if one.startswith(FAILED)]
