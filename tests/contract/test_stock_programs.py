# SPDX-License-Identifier: MIT
"""Programs as python-can and canopen ship them, each in its own process, with no line of pmsmtool on their side."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import can
import pytest

from pmsmtool.files import data_folder
from tests.drive.served import ROOT, Server, serving

pytestmark = pytest.mark.wall_clock

CHANNEL = "interior-2k2?nv=:memory:"
EDS = str(data_folder("firmware-params") / "pmsmsim" / "pmsmsim.eds")
BEAT, REQUEST, ANSWER = 0x701, 0x601, 0x581


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """Return an environment in which the package's entry point is found, installed or not."""
    described = tmp_path / "plug-in" / "pmsmsim_plug_in-0.dist-info"
    described.mkdir(parents=True)
    (described / "METADATA").write_text("Metadata-Version: 2.1\nName: pmsmsim-plug-in\nVersion: 0\n", encoding="utf-8")
    entry = "[can.interface]\npmsmsim = pmsmtool.sim.bus:PmsmSimBus\n"
    (described / "entry_points.txt").write_text(entry, encoding="utf-8")
    return {**os.environ, "PYTHONPATH": os.pathsep.join((str(described.parent), str(ROOT)))}


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with serving("--nv", ":memory:") as running:
        yield running


def at(server: Server) -> list[str]:
    """Return the bus arguments of python-can's programs for a served drive."""
    kwargs = ["host=127.0.0.1", f"port={server.port}", "tcp_tune=True"]
    return ["-i", "socketcand", "-c", "vcan0", "--bus-kwargs", *kwargs]


STARTED: list[subprocess.Popen[str]] = []


@pytest.fixture(autouse=True)
def nobody_is_left() -> Iterator[None]:
    """Programs that a failing test left behind would spin on their closed connection for ever."""
    yield
    while STARTED:
        with STARTED.pop() as process:
            if process.poll() is None:
                process.kill()


def stock(module: str, arguments: Sequence[str], environment: dict[str, str]) -> subprocess.Popen[str]:
    STARTED.append(
        subprocess.Popen(
            [sys.executable, "-u", "-m", module, *arguments],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
        )
    )  # fmt: skip
    return STARTED[-1]


def end(process: subprocess.Popen[str]) -> None:
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=20)
    assert "Traceback" not in said, said


def wait_for_start(logger: subprocess.Popen[str]) -> None:
    """Return when the logger says that it is listening."""
    assert logger.stdout is not None
    assert any("Started on" in line for line in logger.stdout), logger.communicate()


def wait_for_log(path: Path, process: subprocess.Popen[str], enough: int) -> None:
    """Wait until a log file has grown."""
    deadline = time.monotonic() + 30.0
    while not path.exists() or path.stat().st_size < enough:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline, "nothing is logged"
        time.sleep(0.05)


def logged(path: Path) -> Counter[int]:
    return Counter(message.arbitration_id for message in can.LogReader(str(path)))


@pytest.mark.chain
def test_the_logger_sees_heartbeats_in_process(environment: dict[str, str], tmp_path: Path) -> None:
    path = tmp_path / "bus.log"
    logger = stock("can.logger", ["-i", "pmsmsim", "-c", CHANNEL, "-f", str(path)], environment)
    wait_for_log(path, logger, 2000)
    end(logger)
    stamps = [message.timestamp for message in can.LogReader(str(path)) if message.arbitration_id == BEAT]
    assert len(stamps) > 5
    assert stamps[:3] == pytest.approx([0.2, 0.4, 0.6], abs=1e-3)


SDO_PROGRAM = """
import sys, time
import can, canopen
log, eds, arguments = sys.argv[1], sys.argv[2], dict(pair.split("=", 1) for pair in sys.argv[3:])
network = canopen.Network()
if log:
    watched = can.Bus(**arguments)
    notifier = can.Notifier(watched, [can.Logger(log)])
network.connect(**arguments)
node = network.add_node(1, eds)
node.nmt.wait_for_heartbeat(timeout=5.0)
print(node.sdo["Identity"]["Serial number"].raw)
for _ in range(20):
    node.sdo["Motor data"][2].raw = 0.25
    assert node.sdo["Motor data"][2].raw == 0.25
network.disconnect()
if log:
    notifier.stop()
    watched.shutdown()
"""


def sdo_program(arguments: Sequence[str], environment: dict[str, str]) -> None:
    done = subprocess.run(
        [sys.executable, "-c", SDO_PROGRAM, *arguments], capture_output=True, text=True, env=environment, timeout=60
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["22001"]


@pytest.mark.chain
def test_a_notifier_with_a_logger_sees_sdo_traffic_in_process(environment: dict[str, str], tmp_path: Path) -> None:
    path = tmp_path / "bus.log"
    sdo_program([str(path), EDS, "interface=pmsmsim", f"channel={CHANNEL}"], environment)
    found = logged(path)
    assert found[REQUEST] == found[ANSWER] == 41
    assert found[BEAT] > 0


@pytest.mark.chain
def test_the_logger_sees_heartbeats_and_sdo_traffic_of_a_served_drive(
    environment: dict[str, str], tmp_path: Path, server: Server
) -> None:
    path = tmp_path / "bus.log"
    logger = stock("can.logger", [*at(server), "-f", str(path)], environment)
    wait_for_start(logger)
    connection = ["interface=socketcand", "host=127.0.0.1", f"port={server.port}", "channel=vcan0"]
    sdo_program(["", EDS, *connection], environment)
    end(logger)
    found = logged(path)
    assert found[REQUEST] == found[ANSWER] == 41
    assert found[BEAT] > 0


@pytest.mark.chain
def test_the_player_replays_requests_and_the_served_drive_answers(
    environment: dict[str, str], tmp_path: Path, server: Server
) -> None:
    requests, path = tmp_path / "requests.log", tmp_path / "bus.log"
    requests.write_text("".join(f"({k}.0) vcan0 601#4018100{k}00000000\n" for k in range(1, 5)), encoding="ascii")
    logger = stock("can.logger", [*at(server), "-f", str(path)], environment)
    wait_for_start(logger)
    player = stock("can.player", [*at(server), "--ignore-timestamps", str(requests)], environment)
    _, said = player.communicate(timeout=30)
    assert player.returncode == 0, said
    time.sleep(0.3)
    end(logger)
    answers = [bytes(message.data) for message in can.LogReader(str(path)) if message.arbitration_id == ANSWER]
    assert [data[:4].hex() for data in answers] == [f"4318100{k}" for k in range(1, 5)]
