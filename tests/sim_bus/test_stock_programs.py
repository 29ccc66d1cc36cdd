# SPDX-License-Identifier: MIT
"""Stock python-can and canopen programs on the simulated bus: no line of pmsmtool on their side."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import canopen
import pytest

from pmsmtool.files import data_folder
from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.sim.node.objects import eds_text
from tests.node.bench import SERIAL, Bench
from tests.node.conftest import BenchMaker

pytestmark = pytest.mark.wall_clock

EDS = str(data_folder("firmware-params") / "pmsmsim" / "pmsmsim.eds")


@pytest.fixture
def network(bench: Bench) -> Iterator[canopen.Network]:
    network = canopen.Network(bench.bus)
    network.connect()
    yield network
    network.bus = None
    assert network.notifier is not None
    network.notifier.stop()


@pytest.fixture
def drive(network: canopen.Network) -> canopen.RemoteNode:
    return network.add_node(1, EDS)


def test_remote_node_reads_and_writes_expedited(drive: canopen.RemoteNode) -> None:
    assert drive.sdo["Identity"]["Serial number"].raw == SERIAL
    for value in (0.2, 0.3):
        drive.sdo[0x2010][2].raw = value
        assert drive.sdo[0x2010][2].raw == pytest.approx(value)


@pytest.mark.chain
def test_remote_node_transfers_segmented_and_by_block(drive: canopen.RemoteNode) -> None:
    drive.sdo[0x2000][6].raw = 1
    data = bytes(range(256)) * 20
    drive.sdo.download(0x2042, 0, data)
    assert drive.sdo.upload(0x2042, 0) == data
    with drive.sdo.open(0x2043, 0, "wb", size=len(data), block_transfer=True) as file:
        file.write(data)
    with drive.sdo.open(0x2043, 0, "rb", block_transfer=True) as file:
        assert file.read() == data


def test_remote_node_gets_the_abort_codes(drive: canopen.RemoteNode) -> None:
    with pytest.raises(canopen.SdoAbortedError) as caught:
        drive.sdo.download(0x2010, 2, b"\0\0\0\x7f")
    assert caught.value.code == 0x06090031


def test_network_sees_heartbeat_boot_up_and_emergency(drive: canopen.RemoteNode, bench: Bench) -> None:
    drive.nmt.wait_for_heartbeat(timeout=2.0)
    drive.nmt.state = "RESET"
    drive.nmt.wait_for_bootup(timeout=2.0)
    drive.nmt.state = "OPERATIONAL"
    drive.nmt.wait_for_heartbeat(timeout=2.0)
    assert drive.nmt.state == "OPERATIONAL"
    bench.core.persistent_trip = 0x2310
    assert drive.emcy.wait(0x2310, timeout=2.0).register == 3


@pytest.mark.chain
def test_network_scans_and_reads_the_data_sheet_from_the_drive(network: canopen.Network) -> None:
    network.scanner.search(10)
    time.sleep(0.3)
    assert network.scanner.nodes == [1]
    node = network.add_node(1, upload_eds=True)
    assert node.sdo["Motor data"]["Pole pairs"].raw == 4
    assert len(eds_text()) > 10_000


def test_pdos_and_the_402_profile_class(network: canopen.Network, bench: Bench) -> None:
    """The class keeps the statusword of the last TPDO, so it must be set up before the first one comes."""
    node: Any = canopen.BaseNode402
    node = node(1, EDS)
    network.add_node(node)
    node.nmt.state = "PRE-OPERATIONAL"
    node.setup_402_state_machine()
    node.nmt.state = "OPERATIONAL"
    node.state = "OPERATION ENABLED"
    assert bench.node.session is not None
    assert bench.node.session.power.state.name == "OPERATION_ENABLED"
    node.state = "SWITCH ON DISABLED"
    assert bench.node.session.power.state.name == "SWITCH_ON_DISABLED"


def test_stock_lss_master_gives_a_new_drive_its_id(make_bench: BenchMaker) -> None:
    bench = make_bench(node_id=255)
    network = canopen.Network(bench.bus)
    network.connect()
    try:
        master: Any = network.lss
        master.RESPONSE_TIMEOUT = 0.05
        found, identity = master.fast_scan()
        assert found
        assert identity[3] == SERIAL
        master.configure_node_id(9)
        master.send_switch_state_global(master.WAITING_STATE)
        node = network.add_node(9, EDS)
        time.sleep(0.1)
        assert node.sdo[0x1018][4].raw == SERIAL
    finally:
        network.bus = None
        assert network.notifier is not None
        network.notifier.stop()


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".log", ".trc"])
def test_a_logger_writes_heartbeats_and_sdo_traffic(bench: Bench, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"bus{suffix}"
    second = PmsmSimBus("bench", line=bench.line)
    with can.Logger(str(path)) as logger:
        assert bench.client.number(0x1018, 4) == SERIAL
        bench.wait(1.0)
        while (message := second.recv(0.0)) is not None:
            logger(message)
    second.shutdown()
    found = [message.arbitration_id for message in can.LogReader(str(path))]
    assert found.count(0x701) == 5
    assert found.count(0x601) == found.count(0x581) == 1


def test_the_plug_in_is_found_by_its_name(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """With or without an installed package: the entry point's target is what python-can is given here."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(can.interfaces.BACKENDS, "pmsmsim", ("pmsmtool.sim.bus", "PmsmSimBus"))
    with can.Bus(interface="pmsmsim", ignore_config=True) as bus:
        heard = bus.recv(1.0)
        assert heard is not None
        assert heard.arbitration_id == 0x701
    assert {"interface": "pmsmsim", "channel": "interior-2k2"} in can.detect_available_configs("pmsmsim")
    with pytest.raises(can.CanInitializationError, match="no profile and no file"):
        can.Bus(interface="pmsmsim", channel="no-such-thing", ignore_config=True)
