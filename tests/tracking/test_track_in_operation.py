"""A served drive that runs by itself (``sim serve --scenario operation``), for a person who wants to try ``track``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from pmsmtool.bus.connect import Connection, connect
from pmsmtool.cia402 import State
from pmsmtool.cli.main import run as program
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.stop import quick_stop
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.machine.profile import machine_path
from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.sim.channel import build_line, parse_channel
from pmsmtool.sim.drive_kernel import KernelCore
from pmsmtool.sim.node.node import Node
from pmsmtool.sim.operation import POINT_S, POINTS, START_S, Operation, operate
from pmsmtool.sim.signals import Truth
from pmsmtool.sim.simulated_machine import device_slope_ohm, settings_of
from pmsmtool.workflow.identify import nameplate_of
from pmsmtool.workflow.track import follow, known_of, observe_process_data
from tests.drive.served import serving
from tests.simulated_bus import settle

PSI_F_WB = 0.545 * (1.0 - 0.0012 * (25.0 - 20.0))
"""Of the profile, at the temperature of its magnets."""
RPM = 0.10471975511965977


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settle(tmp_path, monkeypatch)


@pytest.fixture
def bus() -> Iterator[Connection]:
    with connect("pmsmsim", "interior-2k2?nv=:memory:") as connection:
        yield connection


def operated(connection: Connection, said: list[str]) -> Node:
    """Set the drive of the line going, and wait until it runs."""
    node: Node = connection.bus.line.nodes[0]  # type: ignore[attr-defined]
    Operation(node, load_machine_file(machine_path("interior-2k2")), said.append)
    connection.wait(0.5)
    return node


def test_track_follows_it(bus: Connection) -> None:
    said: list[str] = []
    node = operated(bus, said)
    drive = CanopenDrive(bus, 1)
    described = nameplate_of(drive, "drive")
    known = known_of(described, compensated=drive.read("inverter.deadtime_compensation") != 0.0)
    found = follow(observe_process_data(drive.node, 20.0, 100.0), known, described).track
    drive.close()
    assert isinstance(node.core, KernelCore)
    machine = load_machine_file(machine_path("interior-2k2"))
    truth = {
        "R_s_ohm": node.core.simulation.signal(Truth.R) + device_slope_ohm(settings_of(machine)),
        "psi_f_wb": PSI_F_WB,
    }
    for name, value in truth.items():
        std = float(found.std[name][-1])
        assert abs(float(found.value[name][-1]) - value) < 3.0 * std, name
        assert std < {"R_s_ohm": 0.03, "psi_f_wb": 0.003}[name] * value, "measured 2.1 % and 0.12 %"
    assert said == [] and drive.node.supervision.foreign_requests == 0


def test_it_runs_through_its_points(bus: Connection) -> None:
    node = operated(bus, [])
    seen = []
    for _ in POINTS:
        bus.wait(POINT_S)
        assert node.session is not None and node.session.power.state is State.OPERATION_ENABLED
        seen.append(node.session.power.omega_m() / (1500.0 * RPM))
    wanted = [speed for speed, _ in POINTS]
    assert sorted(seen) == pytest.approx(sorted(wanted), abs=0.03), "measured within 0.01"


def test_a_stop_ends_it_for_good_and_takes_the_load_away(bus: Connection) -> None:
    said: list[str] = []
    node = operated(bus, said)
    drive = DriveNode(bus, 1)
    bus.wait(2.0 * POINT_S)
    quick_stop(drive)
    bus.wait(3.0)
    assert drive.state() is State.SWITCH_ON_DISABLED
    assert node.session is not None and abs(node.session.power.omega_m()) < 5.0, "nothing drives the shaft"
    assert len(said) == 1 and said[0].startswith("node 1: ") and said[0].endswith("the operation is over")
    drive.close()


def test_it_runs_before_anybody_joins() -> None:
    """A client that is quick must not see the boot with which the drive takes its design over."""
    line = build_line(parse_channel("interior-2k2?nv=:memory:&nodes=2"), instant=True)
    operate(line, load_machine_file(machine_path("interior-2k2")))
    assert line.clock.now() < START_S
    with Connection(PmsmSimBus(line=line)) as connection:
        drives = [DriveNode(connection, node) for node in (1, 2)]
        connection.wait(0.5)
        for drive in drives:
            assert drive.state() is State.OPERATION_ENABLED
            assert drive.supervision.boot_ups == 0
            drive.close()


@pytest.mark.wall_clock
def test_served_to_another_process() -> None:
    with serving("--scenario", "operation") as server:
        with server.connect() as connection:
            node = DriveNode(connection, 1)
            assert node.state() is State.OPERATION_ENABLED
            quick_stop(node)
            assert node.state() is State.SWITCH_ON_DISABLED
            node.close()
        assert server.process.poll() is None, "the server goes on serving"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--nv", "drive.nv"), "--scenario gives the drive a set of its own"),
        (("interior-2k2?drive=epos4",), "only the reference drive runs by itself"),
        (("interior-2k2?tier=recorder",), "only the reference drive runs by itself"),
    ],
)
def test_what_cannot_run_by_itself_is_refused(
    arguments: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert program(["sim", "serve", "--port", "0", "--scenario", "operation", *arguments]) == 2
    assert said in capsys.readouterr().err
