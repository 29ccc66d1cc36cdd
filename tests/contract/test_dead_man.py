# SPDX-License-Identifier: MIT
"""The dead-man with the real thing: the tool killed, kept busy, its cable pulled, the drive without supervision.

``pmsmtool jog`` holds a current in a process of its own; the drive is served by another. Until the tool is gone this
process only listens: a second master on the bus would end the experiment.
"""

from __future__ import annotations

import itertools
import json
import os
import struct
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import can
import pytest

from pmsmtool.bus.connect import Connection
from pmsmtool.bus.nmt import TOOL_NODE
from pmsmtool.cia402 import State
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.dead_man import CONSUMER_MS, REACTION_S
from pmsmtool.drive.heartbeat import Heartbeat
from pmsmtool.errors import ExitCode
from tests.contract.contract import Peer
from tests.drive.bench import sim_bench
from tests.drive.served import ROOT, Server, serving

pytestmark = pytest.mark.wall_clock

DECLARED_S = 1e-3 * CONSUMER_MS + REACTION_S
CONSENT = ("--yes", "--i-max", "3Apk", "--speed-max", "100rpm", "--shaft", "free", "--serial", "22001")
HEARTBEAT_LOST = b"\x30\x81"
GONE_A = 0.2
"""Current after a stop; measured 0.01 A of noise."""


def tool(arguments: Sequence[str], server: Server | None = None) -> subprocess.Popen[str]:
    """Start pmsmtool, on a served bus when one is given."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    if server is not None:
        environment["CAN_CONFIG"] = json.dumps({"port": server.port})
        arguments = (*arguments, "-i", "socketcand", "-c", "vcan0")
    return subprocess.Popen(
        [sys.executable, "-m", "pmsmtool", *arguments],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
    )  # fmt: skip


def wait_for_current(connection: Connection) -> None:
    """Return when the tool has commanded a current (object 0x2052:01)."""
    wanted: list[float] = []

    def note(cob_id: int, data: bytes, stamp: float) -> None:
        if data[1:4] == b"\x52\x20\x01":
            wanted.append(struct.unpack_from("<f", data, 4)[0])

    connection.subscribe(0x601, note)
    assert connection.wait_until(lambda: any(value > 1.0 for value in wanted), 30.0), "no current was commanded"
    connection.wait(0.2)


@pytest.mark.chain
def test_a_killed_tool_leaves_a_stopped_machine() -> None:
    """SIGKILL while 2 A flow: operation is left within the declared 350 ms (measured 194 to 246 ms from the kill)."""
    with serving("--nv", ":memory:") as server, server.connect() as connection:
        jog = tool(("jog", "--current", "2Apk", "--for", "60s", *CONSENT), server)
        try:
            wait_for_current(connection)
            beats: list[float] = []
            lost: list[float] = []
            connection.subscribe(0x700 + TOOL_NODE, lambda cob, data, stamp: beats.append(stamp))
            connection.subscribe(0x081, lambda cob, data, stamp: lost.extend((stamp, time.monotonic())))
            connection.wait(0.2)
            jog.kill()
            killed = time.monotonic()
            assert connection.wait_until(lambda: bool(lost), 3.0), "the drive did not notice"
        finally:
            jog.kill()
            jog.communicate()
        peer = Peer(connection)
        assert peer.number(0x1003, 1) == 0x8130
        assert 1e-3 * CONSUMER_MS <= lost[0] - beats[-1] + 1e-3 <= DECLARED_S, "by the server's time stamps"
        assert lost[1] - killed <= DECLARED_S + 1.0, "as seen from here; a busy computer wakes us late"
        assert State(peer.number(0x6041) & 0x6F) is not State.OPERATION_ENABLED
        connection.wait(0.2)
        assert peer.number(0x6041) & 0x4F == State.SWITCH_ON_DISABLED
        assert abs(struct.unpack("<f", peer.sdo.read(0x2070, 1))[0]) < GONE_A


BUSY = """
import sys, time
from pmsmtool.bus.connect import connect
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.guard import guarded
from tests.drive.bench import ENVELOPE
with connect("socketcand", "vcan0", host="127.0.0.1", port=int(sys.argv[1]), ignore_config=True) as connection:
    with guarded(CanopenDrive(connection, 1), ENVELOPE) as guard:
        guard.enable()
        guard.command_current(2.0, 0.0, fixed_angle_rad=0.0)
        for _ in range(10):
            end = time.monotonic() + float(sys.argv[2])
            while time.monotonic() < end:
                sum(range(20_000))
            guard.wait(0.01)
        print(guard.average(["i_d_a"], 1000)["i_d_a"])
"""


def busy(server: Server, seconds: float) -> tuple[subprocess.Popen[str], list[float]]:
    """Run the program above with so long a pause between two looks; return it and when its heartbeats came."""
    with server.connect() as connection:
        program = [sys.executable, "-c", BUSY, str(server.port), str(seconds)]
        process = subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT)
        wait_for_current(connection)
        beats: list[float] = []
        connection.subscribe(0x700 + TOOL_NODE, lambda cob, data, stamp: beats.append(stamp))
        connection.wait(min(1.5, 10.0 * seconds - 0.3))
        connection.unsubscribe(0x700 + TOOL_NODE)
    return process, beats


@pytest.mark.chain
def test_a_tool_that_looks_often_enough_keeps_its_heartbeat() -> None:
    """The main thread computes for 0.06 s between two looks: the heartbeat comes in time, the current flows."""
    with serving("--nv", ":memory:") as server:
        process, beats = busy(server, 0.06)
        output, said = process.communicate(timeout=30)
        assert process.returncode == 0, said
        assert float(output) == pytest.approx(2.0, abs=0.1)
        assert len(beats) >= 2 and max(b - a for a, b in itertools.pairwise(beats)) < 1e-3 * CONSUMER_MS


@pytest.mark.chain
def test_a_tool_that_computes_for_two_seconds_lets_the_drive_stop() -> None:
    """Nobody watches the machine meanwhile: the heartbeat stays away, and the tool says why nothing was measured."""
    with serving("--nv", ":memory:") as server:
        process, beats = busy(server, 2.0)
        _, said = process.communicate(timeout=30)
        assert process.returncode == 1
        assert "left operation" in said and "this computer or the bus was busy" in said
        assert len(beats) <= 3, "those of the first 0.15 s at most"


# ---- the cable -----------------------------------------------------------------------------------


def test_a_pulled_cable_stops_the_machine_within_the_declared_time() -> None:
    """The drive behind the bus, in virtual time: operation left 250 ms after the last heartbeat it heard."""
    with sim_bench() as bench:
        drive, heartbeat = CanopenDrive(bench.connection, 1), Heartbeat(bench.connection)
        peer = Peer(bench.connection)
        peer.sdo.download(0x1016, 1, (TOOL_NODE << 16 | CONSUMER_MS).to_bytes(4, "little"))
        with heartbeat:
            drive.enable()
            bench.connection.wait(1.0)
            bench.simulated.plugged = False
            pulled = bench.bus.clock.now()
            while bench.session.power.state is State.OPERATION_ENABLED and bench.bus.clock.now() < pulled + 5.0:
                bench.bus.clock.wait(1e-3)
        assert 1e-3 * CONSUMER_MS - 0.06 < bench.bus.clock.now() - pulled <= DECLARED_S
        bench.bus.clock.wait(0.5)
        assert bench.session.power.state is State.SWITCH_ON_DISABLED


@pytest.mark.chain
@pytest.mark.parametrize("fault", ['[[drive]]\naction = "unplug"\nat_s = 3.0\n', "[[adapter]]\nat_s = 3.0\n"])
def test_a_tool_whose_cable_is_pulled_says_so_with_exit_8(tmp_path: Path, fault: str) -> None:
    faults = tmp_path / "faults.toml"
    faults.write_text(fault, encoding="utf-8")
    channel = f"interior-2k2?nv=:memory:&faults={faults}"
    jog = tool(("jog", "-i", "pmsmsim", "-c", channel, "--current", "2Apk", "--for", "10s", "--yes"))
    _, said = jog.communicate(timeout=60)
    assert jog.returncode == ExitCode.STOP_NOT_CONFIRMED
    assert "hardware stop" in said
    assert "Traceback" not in said


@pytest.mark.chain
def test_a_served_drive_whose_cable_is_pulled_stops_by_itself(tmp_path: Path) -> None:
    """All connections to the server end at once; who joins again finds the machine stopped for want of a heartbeat."""
    faults = tmp_path / "faults.toml"
    faults.write_text("[[adapter]]\nat_frame = 700\n", encoding="utf-8")
    with serving("--nv", ":memory:", "--faults", str(faults)) as server:
        jog = tool(("jog", "--current", "2Apk", "--for", "30s", *CONSENT), server)
        _, said = jog.communicate(timeout=60)
        assert jog.returncode == ExitCode.STOP_NOT_CONFIRMED, said
        with server.connect() as connection:
            peer = Peer(connection)
            connection.wait(0.5)
            assert peer.number(0x1003, 1) == 0x8130
            assert peer.number(0x6041) & 0x4F == State.SWITCH_ON_DISABLED


# ---- a drive that would not notice ---------------------------------------------------------------


def controlwords(path: Path) -> list[int]:
    """Return the controlwords written to node 1 in a recorded bus."""
    frames = [bytes(message.data) for message in can.LogReader(str(path)) if message.arbitration_id == 0x601]
    return [int.from_bytes(data[4:6], "little") for data in frames if data[:4] == b"\x2b\x40\x60\x00"]


@pytest.mark.chain
@pytest.mark.parametrize("missing", ["0x1016", "0x6007"])
@pytest.mark.parametrize("where", ["pmsmsim", "sim serve"])
def test_without_supervision_nothing_is_enabled_and_the_exit_is_5(tmp_path: Path, missing: str, where: str) -> None:
    faults, record = tmp_path / "faults.toml", tmp_path / "bus.asc"
    faults.write_text(f'[[absent]]\nobject = "{missing}"\n', encoding="utf-8")
    jog = ("jog", "--current", "2Apk", "--for", "1s", "--trace-can", str(record), *CONSENT)
    if where == "pmsmsim":
        process = tool((*jog, "-i", "pmsmsim", "-c", f"interior-2k2?nv=:memory:&faults={faults}"))
        _, said = process.communicate(timeout=60)
    else:
        with serving("--nv", ":memory:", "--faults", str(faults)) as server:
            process = tool(jog, server)
            _, said = process.communicate(timeout=60)
    assert process.returncode == ExitCode.SAFETY, said
    assert missing in said
    assert 0x0F not in controlwords(record)


@pytest.mark.chain
def test_with_supervision_the_same_command_does_enable(tmp_path: Path) -> None:
    """So that the test above cannot pass for another reason."""
    record = tmp_path / "bus.asc"
    jog = ("jog", "--current", "2Apk", "--for", "0.1s", "--trace-can", str(record), *CONSENT)
    process = tool((*jog, "-i", "pmsmsim", "-c", "interior-2k2?nv=:memory:"))
    _, said = process.communicate(timeout=60)
    assert process.returncode == 0, said
    assert 0x0F in controlwords(record)
