# SPDX-License-Identifier: MIT
"""Supervision of a node: reset, silence, emergencies, a second master and our own echo."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from pmsmtool.bus.connect import Connection
from pmsmtool.bus.nmt import TOOL_NODE, NmtCommand, NmtState, reset_node, send_nmt
from pmsmtool.bus.sdo import SdoChannel
from pmsmtool.bus.supervision import EMERGENCIES_MAX, HeartbeatLost, NodeReset, SecondMaster, Supervision
from pmsmtool.errors import DriveFault, DriveTimeout
from tests.bus.scripted import NODE, ScriptedBus, ScriptedSlave

BIG = (0x2042, 0)


@pytest.fixture
def bus() -> ScriptedBus:
    return ScriptedBus(ScriptedSlave({BIG: bytes(4000), (0x1000, 0): bytes(4)}))


@pytest.fixture
def connection(bus: ScriptedBus) -> Iterator[Connection]:
    with Connection(bus) as opened:
        yield opened


@pytest.fixture
def supervision(connection: Connection) -> Supervision:
    return Supervision(connection, NODE)


def test_node_reset_stops_the_transfer_at_once(
    bus: ScriptedBus, connection: Connection, supervision: Supervision
) -> None:
    channel = SdoChannel(connection, NODE, check=supervision.check)
    bus.clock.after(0.004, lambda: bus.deliver(0x700 + NODE, b"\0"))
    bus.clock.after(0.004, lambda: setattr(bus.slave, "hung", True))
    with pytest.raises(NodeReset, match="values not stored are lost"):
        channel.upload(*BIG)
    assert bus.clock.now() < 0.3


def test_wanted_reset_is_no_error(bus: ScriptedBus, connection: Connection, supervision: Supervision) -> None:
    with supervision.expected_reset():
        reset_node(connection, NODE)
    supervision.check()
    assert supervision.boot_ups == 1 and supervision.nmt_state is NmtState.BOOT_UP


def test_reset_without_boot_up_is_reported(bus: ScriptedBus, connection: Connection) -> None:
    bus.slave.nmt = lambda data: None  # type: ignore[method-assign]
    with pytest.raises(DriveTimeout, match="no boot-up within 5 s"):
        reset_node(connection, NODE)


def test_lost_heartbeat_ends_a_download_within_a_second(
    bus: ScriptedBus, connection: Connection, supervision: Supervision
) -> None:
    supervision.heartbeat_period_s = 0.2
    channel = SdoChannel(connection, NODE, check=supervision.check)
    beat = bus.clock.every(0.2, lambda: bus.deliver(0x700 + NODE, b"\x05"))
    connection.wait(1.0)
    supervision.check()
    beat.stop()
    bus.slave.hung = True
    gone = bus.clock.now()
    with pytest.raises(HeartbeatLost):
        write_often(channel)
    assert bus.clock.now() - gone < 1.0


def test_time_in_which_this_computer_did_not_listen_is_no_silence(
    bus: ScriptedBus, connection: Connection, supervision: Supervision
) -> None:
    supervision.heartbeat_period_s = 0.2
    bus.deliver(0x700 + NODE, b"\x05")
    connection.wait(0.01)
    connection.wait(1.0)
    connection.deaf_s += 0.9
    supervision.check()
    connection.wait(0.5)
    with pytest.raises(HeartbeatLost):
        supervision.check()


def write_often(channel: SdoChannel) -> None:
    for _ in range(300):
        channel.download(0x2010, 2, bytes(4))


def test_heartbeats_in_time_raise_nothing(bus: ScriptedBus, connection: Connection, supervision: Supervision) -> None:
    supervision.heartbeat_period_s = 0.2
    bus.clock.every(0.2, lambda: bus.deliver(0x700 + NODE, b"\x05"))
    for _ in range(50):
        connection.wait(0.13)
        supervision.check()
    assert supervision.nmt_state is NmtState.OPERATIONAL


@pytest.mark.parametrize("code", [0x2310, 0x3210, 0x4310, 0x7305])
def test_emergency_of_a_stopping_class(
    bus: ScriptedBus, connection: Connection, supervision: Supervision, code: int
) -> None:
    bus.deliver(0x080 + NODE, code.to_bytes(2, "little") + b"\x03\x01\x02\x03\x04\x05")
    connection.collect()
    with pytest.raises(DriveFault, match=f"{code:#06x}") as caught:
        supervision.check()
    assert ("let it cool" in caught.value.likely) is (code == 0x4310)
    supervision.check()  # told once


def test_other_emergencies_are_kept_and_short_ones_understood(
    bus: ScriptedBus, connection: Connection, supervision: Supervision
) -> None:
    bus.deliver(0x080 + NODE, b"\x30\x81\x11")
    bus.deliver(0x080 + NODE, b"\x00")
    connection.collect()
    supervision.check()
    assert [(e.code, e.register, e.detail) for e in supervision.emergencies] == [(0x8130, 0x11, b"")]


def test_a_flood_of_emergencies_keeps_the_newest_and_tells_them_once(
    bus: ScriptedBus, connection: Connection, supervision: Supervision
) -> None:
    for number in range(1500):
        bus.deliver(0x080 + NODE, b"\x30\x81\x11" + number.to_bytes(5, "little"))
        connection.collect()
        if number == 700:
            supervision.check()
    assert len(supervision.emergencies) == EMERGENCIES_MAX
    assert int.from_bytes(supervision.emergencies[-1].detail, "little") == 1499
    supervision.take_note_of_emergencies()
    for code in (b"\x10\x23", *(b"\x30\x81",) * 1500):  # over-current, and a flood behind it
        bus.deliver(0x080 + NODE, code + b"\x03")
        connection.collect()
    with pytest.raises(DriveFault, match="0x2310"):
        supervision.check()


def test_second_master_is_noticed(bus: ScriptedBus, connection: Connection, supervision: Supervision) -> None:
    channel = SdoChannel(connection, NODE, check=supervision.check)
    channel.read(0x1000, 0)
    bus.deliver(0x600 + NODE, b"\x40\x41\x60\x00" + bytes(4))
    connection.collect()
    with pytest.raises(SecondMaster):
        channel.read(0x1000, 0)


def test_foreign_nmt_command_is_noticed_only_when_it_means_this_node(
    bus: ScriptedBus, connection: Connection, supervision: Supervision
) -> None:
    bus.deliver(0, bytes((1, NODE + 1)))
    connection.collect()
    supervision.check()
    bus.deliver(0, bytes((2, 0)))
    connection.collect()
    with pytest.raises(SecondMaster):
        supervision.check()


def test_own_echo_is_no_second_master(bus: ScriptedBus, connection: Connection, supervision: Supervision) -> None:
    """As udp_multicast does: own frames come back, marked as received."""
    bus.echo = True
    channel = SdoChannel(connection, NODE, check=supervision.check)
    channel.upload(*BIG, size=4000)
    channel.download(*BIG, bytes(2000))
    send_nmt(connection, NmtCommand.START, NODE)
    connection.wait(0.01)
    supervision.check()
    assert supervision.foreign_requests == 0


def test_an_echo_is_told_to_every_supervision_of_the_node(
    bus: ScriptedBus, connection: Connection, supervision: Supervision
) -> None:
    """`check` opens the node twice: over udp_multicast each of its own requests was another master's to the second."""
    bus.echo = True
    second = Supervision(connection, NODE)
    channel = SdoChannel(connection, NODE, check=second.check)
    channel.upload(*BIG, size=4000)
    connection.send(0x700 + TOOL_NODE, b"\x05")
    connection.wait(0.01)
    assert (supervision.foreign_requests, second.foreign_requests) == (0, 0)
    bus.deliver(0x600 + NODE, bytes((0x40, 0x41, 0x60, 0, 0, 0, 0, 0)))
    connection.wait(0.01)
    assert (supervision.foreign_requests, second.foreign_requests) == (1, 1)
    second.close()


def test_any_frame_of_the_node_is_life(bus: ScriptedBus, connection: Connection, supervision: Supervision) -> None:
    supervision.heartbeat_period_s = 0.2
    bus.deliver(0x700 + NODE, b"\x05")
    connection.wait(0.01)
    for base in (0x080, 0x180, 0x280, 0x380, 0x480, 0x580):
        connection.wait(0.4)
        bus.deliver(base + NODE, bytes(8))
        connection.wait(0.2)
        supervision.check()
    connection.wait(0.51)
    with pytest.raises(HeartbeatLost, match="no other frame"):
        supervision.check()


def test_one_lost_heartbeat_is_no_lost_node(bus: ScriptedBus, connection: Connection, supervision: Supervision) -> None:
    supervision.heartbeat_period_s = 0.2
    for _ in range(5):
        bus.deliver(0x700 + NODE, b"\x05")
        connection.wait(0.4)
        supervision.check()


@pytest.mark.parametrize(
    ("cob_id", "frame", "name"),
    [
        (0x600 + NODE, b"\x2b\x40\x60\x00\x06\0\0\0", "a write of 0x6040:00"),
        (0x600 + NODE, b"\x40\x10\x20\x02\0\0\0\0", "a read of 0x2010:02"),
        (0x000, bytes((0x81, NODE)), "an NMT command"),
        (0x77E, b"\x05", "the heartbeat of node 126, another pmsmtool"),
    ],
)
def test_another_master_is_named(
    bus: ScriptedBus, connection: Connection, supervision: Supervision, cob_id: int, frame: bytes, name: str
) -> None:
    bus.deliver(cob_id, frame)
    connection.collect()
    with pytest.raises(SecondMaster, match=name):
        supervision.check()


@pytest.mark.parametrize("index", [0x1000, 0x1018])
def test_who_only_looks_is_no_second_master(
    bus: ScriptedBus, connection: Connection, supervision: Supervision, index: int
) -> None:
    bus.deliver(0x600 + NODE, b"\x40" + index.to_bytes(2, "little") + bytes(5))
    connection.collect()
    supervision.check()


def test_heartbeat_of_a_master_that_the_drive_supervises(
    bus: ScriptedBus, connection: Connection, supervision: Supervision
) -> None:
    bus.deliver(0x701, b"\x05")
    connection.collect()
    supervision.check()
    supervision.expect_master(1)
    bus.deliver(0x701, b"\x05")
    connection.collect()
    with pytest.raises(SecondMaster, match="node 1, a master this drive supervises"):
        supervision.check()
