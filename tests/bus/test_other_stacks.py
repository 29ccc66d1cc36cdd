# SPDX-License-Identifier: MIT
"""The tool's SDO channel and NMT against slaves of other people's stacks; their deviations are named.

canopen's LocalNode is always there; durand where it is installed (``pip install durand``). Both run on python-can's
virtual bus and the wall clock.

Deviations met, and what the channel makes of them:

* canopen 2.4.1 LocalNode: no block transfer (block upload is answered as a normal one, block download aborts
  05040001), no boot-up message after a reset, length errors as 06070010.
* durand 0.5.0: block uploads of a size divisible by 7 end with a wrong CRC (the channel reads by segments then), a gap
  in a block download aborts 05040003 (the channel starts over).
"""

from __future__ import annotations

import importlib
import random
from collections.abc import Callable, Iterator
from typing import Any

import can
import canopen
import pytest
from canopen.objectdictionary import ODVariable, datatypes

from pmsmtool.bus.connect import Connection
from pmsmtool.bus.nmt import NmtCommand, find_nodes, reset_node, send_nmt
from pmsmtool.bus.sdo import Mode, SdoChannel
from pmsmtool.errors import DriveTimeout, SdoAbort
from tests.contract.stacks import END_S

pytestmark = pytest.mark.wall_clock

NODE = 9
NUMBER, BLOB = (0x2000, 0), (0x2001, 0)
SIZES = [1, 4, 5, 6, 7, 8, 14, 29, 888, 889, 890, 1778, 16384]


@pytest.fixture
def connection(request: pytest.FixtureRequest) -> Iterator[Connection]:
    with Connection(can.Bus(interface="virtual", channel=request.node.name, ignore_config=True)) as opened:
        yield opened


@pytest.fixture
def channel(connection: Connection) -> SdoChannel:
    return SdoChannel(connection, NODE)


@pytest.fixture
def local_node(request: pytest.FixtureRequest) -> Iterator[canopen.LocalNode]:
    dictionary = canopen.ObjectDictionary()
    for index, name, kind in ((NUMBER[0], "number", datatypes.UNSIGNED32), (BLOB[0], "blob", datatypes.DOMAIN)):
        variable = ODVariable(name, index)
        variable.data_type, variable.access_type = kind, "rw"
        dictionary.add_object(variable)
    for index, default in ((0x1000, 402), (0x1017, 0)):
        variable = ODVariable(f"standard {index:x}", index)
        variable.data_type, variable.default = datatypes.UNSIGNED32, default
        dictionary.add_object(variable)
    network = canopen.Network()
    network.NOTIFIER_CYCLE = END_S
    network.connect(interface="virtual", channel=request.node.name, ignore_config=True)
    node = network.create_node(NODE, dictionary)
    node.nmt.state = "PRE-OPERATIONAL"
    yield node
    network.disconnect()


class TestLocalNode:
    def test_numbers(self, local_node: canopen.LocalNode, channel: SdoChannel) -> None:
        channel.download(*NUMBER, b"\x01\x02\x03\x04")
        assert channel.read(*NUMBER, size=4) == b"\x01\x02\x03\x04"

    @pytest.mark.chain
    @pytest.mark.parametrize("size", SIZES)
    def test_blobs_fall_back_to_segments(self, local_node: canopen.LocalNode, channel: SdoChannel, size: int) -> None:
        data = random.Random(size).randbytes(size)
        channel.download(*BLOB, data)
        read = channel.upload(*BLOB, size=size)
        assert read.data == data and read.tries == 1 and read.mode is not Mode.BLOCK

    def test_refusals(self, local_node: canopen.LocalNode, channel: SdoChannel) -> None:
        with pytest.raises(SdoAbort) as unknown:
            channel.read(0x3000, 0)
        assert unknown.value.code == 0x06020000

    def test_scan_and_nmt(self, local_node: canopen.LocalNode, connection: Connection) -> None:
        assert [(n.node, n.is_drive) for n in find_nodes(connection)] == [(NODE, True)]
        send_nmt(connection, NmtCommand.START, NODE)
        assert _soon(connection, lambda: local_node.nmt.state == "OPERATIONAL")

    def test_no_boot_up_after_a_reset_is_said(self, local_node: canopen.LocalNode, connection: Connection) -> None:
        with pytest.raises(DriveTimeout, match="no boot-up"):
            reset_node(connection, NODE, timeout_s=0.3)


def _soon(connection: Connection, condition: Callable[[], bool]) -> bool:
    return connection.wait_until(condition, 1.0)


@pytest.fixture
def durand_node(request: pytest.FixtureRequest) -> Iterator[Any]:
    durand = pytest.importorskip("durand")
    kinds = importlib.import_module("durand.datatypes").DatatypeEnum
    variable = importlib.import_module("durand.object_dictionary").Variable
    bus = can.Bus(interface="virtual", channel=request.node.name, ignore_config=True)
    network = durand.CANBusNetwork(bus)
    network._notifier.timeout = END_S
    node = durand.MinimalNode(network, NODE)
    node.object_dictionary[NUMBER[0]] = variable(kinds.UNSIGNED32, "rw", value=0)
    node.object_dictionary[BLOB[0]] = variable(kinds.DOMAIN, "rw", value=b"")
    yield node
    network.stop()
    bus.shutdown()


class TestDurand:
    def test_numbers(self, durand_node: Any, channel: SdoChannel) -> None:
        channel.download(*NUMBER, b"\x01\x02\x03\x04")
        assert channel.read(*NUMBER, size=4) == b"\x01\x02\x03\x04"

    @pytest.mark.chain
    @pytest.mark.parametrize("mode", [Mode.SEGMENTED, Mode.BLOCK])
    @pytest.mark.parametrize("size", [size for size in SIZES if size > 4])
    def test_blobs_both_ways(self, durand_node: Any, channel: SdoChannel, size: int, mode: Mode) -> None:
        data = random.Random(size).randbytes(size)
        channel.download(*BLOB, data, mode=mode)
        read = channel.upload(*BLOB, size=size, mode=mode)
        assert read.data == data
        if mode is Mode.BLOCK:
            # Its CRC is wrong for sizes divisible by 7: three tries, then by segments, and said so.
            assert (read.mode is Mode.SEGMENTED) == (size % 7 == 0)
            assert read.tries == (4 if size % 7 == 0 else 1)

    def test_refusals(self, durand_node: Any, channel: SdoChannel) -> None:
        with pytest.raises(SdoAbort) as unknown:
            channel.read(0x3000, 0)
        assert unknown.value.code == 0x06020000

    def test_reset_boots_up(self, durand_node: Any, connection: Connection, channel: SdoChannel) -> None:
        reset_node(connection, NODE, timeout_s=2.0)
        assert len(channel.read(0x1000, 0)) == 4

    def test_stopped_node_is_silent(self, durand_node: Any, connection: Connection, channel: SdoChannel) -> None:
        send_nmt(connection, NmtCommand.STOP, NODE)
        connection.wait(0.1)
        with pytest.raises(DriveTimeout):
            channel.read(0x1000, 0)
        send_nmt(connection, NmtCommand.PRE_OPERATIONAL, NODE)
        connection.wait(0.1)
        assert len(channel.read(0x1000, 0)) == 4
