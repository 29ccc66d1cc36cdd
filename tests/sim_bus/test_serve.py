# SPDX-License-Identifier: MIT
"""``pmsmtool sim serve``: another process, the wall clock, several programs, the socketcand protocol to the letter."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import canopen
import pytest

from pmsmtool.errors import BusError
from pmsmtool.files import data_folder
from pmsmtool.sim.channel import build_line, parse_channel
from pmsmtool.sim.serve import HOLD_S, PAUSED, SocketcandServer
from tests.node.simple_core import SimpleCore

pytestmark = pytest.mark.wall_clock

READ_SERIAL = bytes.fromhex("4018100400000000")
EDS = str(data_folder("firmware-params") / "pmsmsim" / "pmsmsim.eds")
ROOT = Path(__file__).parents[2]


@contextlib.contextmanager
def served(channel: str = "interior-2k2?nv=:memory:", *, speed: float = 1.0, paced: bool = False) -> Iterator[int]:
    """Serve simple drives in a thread; yields the port."""
    parsed = parse_channel(channel)
    line = build_line(parsed, instant=not paced, make_core=lambda machine_file, seed: SimpleCore())
    server = SocketcandServer(line, port=0, speed=speed, damaged=parsed.terminator == "missing")
    end = threading.Event()
    thread = threading.Thread(target=server.serve, args=(end.is_set,))
    thread.start()
    try:
        yield server.port
    finally:
        end.set()
        thread.join(5.0)


@contextlib.contextmanager
def joined(port: int) -> Iterator[can.BusABC]:
    logging.getLogger("can.interfaces.socketcand").setLevel(logging.CRITICAL)
    bus = can.Bus(
        interface="socketcand", host="127.0.0.1", port=port, channel="vcan0", tcp_tune=True, ignore_config=True
    )
    try:
        yield bus
    finally:
        bus.shutdown()


def message(can_id: int, data: bytes) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=False)


def wait_for(bus: can.BusABC, can_id: int, seconds: float = 2.0) -> can.Message:
    end = time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        heard = bus.recv(left)
        if heard is not None and heard.arbitration_id == can_id:
            return heard
    pytest.fail(f"no frame 0x{can_id:03X} in {seconds} s")


def test_a_stock_bus_asks_and_is_answered() -> None:
    with served() as port, joined(port) as bus:
        bus.send(message(0x601, READ_SERIAL))
        assert wait_for(bus, 0x581).data[:4] == bytes.fromhex("43181004")


def test_a_served_bus_without_a_terminator_has_error_frames_alone() -> None:
    """Before, it was refused: the fault could be rehearsed in one process only."""
    with served("interior-2k2?nv=:memory:&terminator=missing") as port, joined(port) as bus:
        bus.send(message(0x601, READ_SERIAL))
        heard = bus.recv(2.0)
        assert heard is not None and heard.is_error_frame


def test_time_follows_the_wall_clock_times_speed() -> None:
    for speed, expected in ((1.0, 3), (5.0, 15)):
        with served(speed=speed) as port, joined(port) as bus:
            wait_for(bus, 0x701)
            started, beats = time.monotonic(), 0
            while time.monotonic() - started < 0.7:
                heard = bus.recv(0.1)
                beats += heard is not None and heard.arbitration_id == 0x701
            assert expected - 1 <= beats <= expected * 0.7 / 0.6 + 2


def test_time_in_which_the_computer_did_not_run_the_server_is_not_made_up_for() -> None:
    line = build_line(parse_channel("interior-2k2?nv=:memory:"), make_core=lambda machine_file, seed: SimpleCore())
    said: list[str] = []
    server = SocketcandServer(line, port=0, say=said.append)
    try:
        for _ in range(20):
            server._run(0.0)
        assert said == [], "nothing has happened yet"
        before = line.clock.now_ns
        server._started -= 1.0
        for _ in range(20):
            server._run(0.0)
        assert line.clock.now_ns - before < 500_000_000
        assert len(said) == 1
        assert said[0].startswith(f"{PAUSED} 0.9")
    finally:
        server.close()


def test_frames_behind_the_handshake_are_held_not_lost() -> None:
    """A drive that talks constantly: after ``< ok >`` nothing for 50 ms, then everything that was said meanwhile."""
    with served(speed=1.0) as port, joined(port) as first:
        for index, value in ((0x1017, 5),):
            first.send(message(0x601, bytes((0x2B, index & 0xFF, index >> 8, 0, value, 0, 0, 0))))
        wait_for(first, 0x581)
        with socket.create_connection(("127.0.0.1", port)) as raw:
            raw.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            assert raw.recv(256) == b"< hi >"
            raw.sendall(b"< open can0 >")
            assert raw.recv(256) == b"< ok >"
            raw.sendall(b"< rawmode >")
            started = time.monotonic()
            assert raw.recv(256) == b"< ok >"
            received = raw.recv(65536)
            assert time.monotonic() - started > 0.9 * HOLD_S
            assert received.count(b"< frame 701 ") >= 3


def test_programs_hear_each_other() -> None:
    with served() as port, joined(port) as first, joined(port) as second:
        first.send(message(0x123, b"\x01\x02\xff"))
        assert bytes(wait_for(second, 0x123).data) == b"\x01\x02\xff"
        second.send(can.Message(arbitration_id=0x12345678, data=b"", is_extended_id=True))
        heard = wait_for(first, 0x12345678)
        assert heard.is_extended_id
        assert heard.dlc == 0


def test_a_program_that_leaves_does_not_disturb_the_others() -> None:
    with served() as port, joined(port) as first:
        with joined(port):
            pass
        first.send(message(0x601, READ_SERIAL))
        wait_for(first, 0x581)


@pytest.mark.parametrize(
    "nonsense", ["< send >", "< send xyz 1 0 >", "< send 601 9 0 0 0 0 0 0 0 0 0 >", "< send 601 8 1 >", "<>", "x>"]
)
def test_nonsense_is_answered_with_an_error(nonsense: str) -> None:
    with served() as port, socket.create_connection(("127.0.0.1", port)) as raw:
        raw.recv(256)
        raw.sendall(b"< open can0 >")
        raw.recv(256)
        raw.sendall(b"< rawmode >")
        raw.recv(256)
        raw.sendall(nonsense.encode())
        raw.settimeout(2.0)
        assert b"< error" in raw.recv(65536)


def test_an_endless_command_ends_the_connection() -> None:
    with served() as port, socket.create_connection(("127.0.0.1", port)) as raw:
        raw.recv(256)
        raw.sendall(b"x" * 1000)
        raw.settimeout(2.0)
        assert raw.recv(256) == b""


def test_stock_canopen_transfers_by_block_over_the_server() -> None:
    with served() as port, joined(port) as bus:
        network = canopen.Network(bus)
        network.connect()
        try:
            drive = network.add_node(1, EDS)
            drive.nmt.wait_for_heartbeat(timeout=2.0)
            drive.sdo[0x2000][6].raw = 1
            data = bytes(range(251)) * 60
            with drive.sdo.open(0x2042, 0, "wb", size=len(data), block_transfer=True) as file:
                file.write(data)
            with drive.sdo.open(0x2042, 0, "rb", block_transfer=True) as file:
                assert file.read() == data
        finally:
            assert network.notifier is not None
            network.notifier.stop()
            network.bus = None


def test_a_bit_rate_paces_the_served_bus() -> None:
    """20 requests of 114 to 123 bits and their answers at 20 kbit/s: at least 0.2 s."""
    with served("interior-2k2?nv=:memory:&bitrate=20000", paced=True) as port, joined(port) as bus:
        started = time.monotonic()
        for _ in range(20):
            bus.send(message(0x601, READ_SERIAL))
            wait_for(bus, 0x581)
        assert time.monotonic() - started > 0.2


def test_a_pulled_adapter_ends_the_connection(tmp_path: Path) -> None:
    faults = tmp_path / "faults.toml"
    faults.write_text("[[adapter]]\nat_s = 0.3\n", encoding="utf-8")
    with (
        served(f"interior-2k2?nv=:memory:&faults={faults}") as port,
        socket.create_connection(("127.0.0.1", port)) as raw,
    ):
        for command in (b"< open can0 >", b"< rawmode >"):
            raw.recv(256)
            raw.sendall(command)
        raw.settimeout(3.0)
        with pytest.raises((ConnectionError, EOFError)):
            while True:
                if not raw.recv(4096):
                    raise EOFError


def test_a_port_in_use_is_one_clear_error() -> None:
    with served() as port:
        line = build_line(parse_channel("interior-2k2?nv=:memory:"), make_core=lambda machine_file, seed: SimpleCore())
        with pytest.raises(BusError, match="cannot listen"):
            SocketcandServer(line, port=port)


# ---- the command ---------------------------------------------------------------------------------


@contextlib.contextmanager
def command(*arguments: str, folder: Path) -> Iterator[tuple[subprocess.Popen[str], dict[str, Any]]]:
    process = subprocess.Popen(
        [sys.executable, "-c", "from pmsmtool.cli.main import main; main()", "sim", "serve", "--json", *arguments],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        if not line:
            assert process.stderr is not None
            pytest.fail(process.stderr.read())
        yield process, json.loads(line)
    finally:
        process.kill()
        process.communicate()


@pytest.mark.chain
def test_the_command_serves_the_real_drive_to_another_process(tmp_path: Path) -> None:
    with command("--port", "0", "--nodes", "2", "--node", "5", folder=tmp_path) as (process, said):
        assert said["schema"] == "pmsmtool.sim-serve/1"
        assert said["node_ids"] == [5, 6]
        with joined(said["port"]) as bus:
            for node in (5, 6):
                bus.send(message(0x600 + node, READ_SERIAL))
                wait_for(bus, 0x580 + node)
        process.send_signal(signal.SIGINT)
        assert process.wait(5.0) == 0
    assert list(tmp_path.iterdir()) == []


@pytest.mark.chain
@pytest.mark.parametrize("arguments", [["no-such-profile"], ["--speed", "0"], ["--faults", "missing.toml"]])
def test_the_command_refuses_what_it_cannot_serve(tmp_path: Path, arguments: list[str]) -> None:
    done = subprocess.run(
        [sys.executable, "-c", "from pmsmtool.cli.main import main; main()", "sim", "serve", "--port", "0", *arguments],
        capture_output=True, text=True, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)}, timeout=30,
    )  # fmt: skip
    assert done.returncode == 2
    assert done.stdout == ""
    assert "Traceback" not in done.stderr
