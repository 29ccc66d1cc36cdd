# SPDX-License-Identifier: MIT
"""Answers that are none, or one too many: what came is named, and two nodes on one id are told from late frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import can
import pytest

from pmsmtool.bus.connect import Connection
from pmsmtool.bus.examination import examine
from pmsmtool.bus.sdo import SdoChannel
from pmsmtool.bus.sdo_transfer import LATEST_S
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.errors import BusError, DriveTimeout
from tests.bus.scripted import NODE, ScriptedBus, ScriptedSlave

NUMBER, TABLE = (0x2010, 2), (0x2042, 0)
IDENTITY = {(0x1018, sub): sub.to_bytes(4, "little") for sub in range(5)}


Then = Callable[[bytes, bytes], list[bytes]]
"""From a request and its answer to what is sent."""


class Altered(ScriptedSlave):
    """A correct server whose answers are altered, or followed by others, on the way."""

    def __init__(self) -> None:
        super().__init__({NUMBER: b"\1\2\3\4", TABLE: bytes(20), (0x1000, 0): b"\x92\1\2\0", **IDENTITY})
        self.then: Then = lambda request, answer: [answer]

    def answer(self, data: bytes) -> Iterator[bytes]:
        for frame in super().answer(data):
            yield from self.then(data, frame)


@pytest.fixture
def slave() -> Altered:
    return Altered()


@pytest.fixture
def node(slave: Altered) -> Iterator[DriveNode]:
    with Connection(ScriptedBus(slave)) as connection:
        yield DriveNode(connection, NODE)


def abort(request: bytes, code: int) -> bytes:
    return b"\x80" + request[1:4] + code.to_bytes(4, "little")


def test_a_segment_with_the_wrong_toggle_bit_is_named(slave: Altered, node: DriveNode) -> None:
    def toggled(request: bytes, answer: bytes) -> list[bytes]:
        return [bytes((answer[0] ^ 0x10,)) + answer[1:] if request[0] & 0xEF == 0x60 else answer]

    slave.then = toggled
    with pytest.raises(DriveTimeout, match="but a segment with the wrong toggle bit") as caught:
        node.sdo.upload(*TABLE)
    assert "answers wrongly" in caught.value.likely and "does not answer" not in caught.value.likely


def test_an_answer_for_another_object_is_named(slave: Altered, node: DriveNode) -> None:
    slave.then = lambda request, answer: [answer[:1] + b"\x18\x10\x04" + answer[4:]]
    with pytest.raises(DriveTimeout, match="but an answer for 0x1018:04") as caught:
        node.sdo.read(*NUMBER)
    assert "two nodes share this node id" in caught.value.likely


def test_a_node_that_gives_up_is_not_called_silent(slave: Altered, node: DriveNode) -> None:
    slave.then = lambda request, answer: [abort(request, 0x05040000)]
    with pytest.raises(DriveTimeout, match="0x05040000") as caught:
        node.sdo.read(*NUMBER)
    assert "busy" in caught.value.likely and "info" in caught.value.hint


def test_silence_is_silence(slave: Altered, node: DriveNode) -> None:
    slave.then = lambda request, answer: []
    with pytest.raises(DriveTimeout) as caught:
        node.sdo.read(*NUMBER)
    assert "but an" not in caught.value.what and "nothing was heard" in caught.value.likely


def test_frames_of_can_fd_are_no_answers(node: DriveNode) -> None:
    """Eight bytes at the server's identifier: a classic frame would be an abort of this very transfer."""
    frame = can.Message(
        arbitration_id=0x580 + NODE, data=b"\x80\x10\x20\x02\x00\x00\x02\x06", is_extended_id=False, is_fd=True
    )  # fmt: skip
    bus = node.connection.bus
    assert isinstance(bus, ScriptedBus)
    bus.clock.after(20e-6, lambda: bus.inbox.append(frame))
    assert node.sdo.read(*NUMBER) == b"\1\2\3\4" and node.sdo.discarded == 0


SECOND: dict[str, Then] = {
    "refuses": lambda request, answer: [answer, abort(request, 0x06020000)],
    "refuses first": lambda request, answer: [abort(request, 0x06020000), answer] if request[3] > 1 else [answer],
    "another value": lambda request, answer: [answer, answer[:4] + b"\x63" + answer[5:]],
}


@pytest.mark.parametrize("second", SECOND)
def test_two_nodes_that_answer_are_refused(slave: Altered, node: DriveNode, second: str) -> None:
    slave.then = SECOND[second]
    with pytest.raises(BusError, match=f"two nodes answer on node id {NODE}") as caught:
        node.identity()
    assert caught.value.exit_code == 3 and caught.value.hint


ONE_NODE: dict[str, Then] = {
    "duplicated": lambda request, answer: [answer, answer],
    "gives up late": lambda request, answer: [answer, abort(request, 0x05040000)],
    "of another object": lambda request, answer: [answer, answer[:3] + b"\x77" + answer[4:]],
}


@pytest.mark.parametrize("second", ONE_NODE)
def test_one_node_that_sends_too_much_is_not_two(slave: Altered, node: DriveNode, second: str) -> None:
    slave.then = ONE_NODE[second]
    assert node.identity().vendor == 1 and node.sdo.contradiction == ""


def test_the_late_answer_to_a_lost_request_contradicts_nothing(node: DriveNode, slave: Altered) -> None:
    """The first answer is 0.9 s late, when the object already holds, and shows, something else."""
    bus, sdo = node.connection.bus, node.sdo
    assert isinstance(bus, ScriptedBus)
    slave.then = lambda request, answer: [] if request[1:4] == b"\x10\x20\x02" and bus.clock.now() < 0.1 else [answer]
    bus.clock.after(0.9, lambda: bus.deliver(0x580 + NODE, b"\x43\x10\x20\x02\x09\x09\x09\x09"))
    for _ in range(60):
        assert sdo.read(*NUMBER) == b"\1\2\3\4" or bus.clock.now() < 1.0
        bus.clock.wait(0.05)
    assert sdo.contradiction == "" and bus.clock.now() > LATEST_S
    bus.deliver(0x580 + NODE, b"\x43\x10\x20\x02\x09\x09\x09\x09")
    assert sdo.read(0x1000, 0) and sdo.contradiction != "", "long after the loss it is another node's"


def test_channel_without_a_node_has_nothing_to_compare(slave: Altered) -> None:
    with Connection(ScriptedBus(slave)) as connection:
        channel = SdoChannel(connection, NODE)
        channel.connection.bus.deliver(0x580 + NODE, b"\x43\x10\x20\x02\x09\x09\x09\x09")  # type: ignore[attr-defined]
        assert channel.read(*NUMBER) == b"\1\2\3\4"
        assert (channel.contradiction, channel.discarded) == ("", 1)


@pytest.mark.parametrize("second", SECOND)
def test_an_examination_tells_two_nodes_on_one_id(slave: Altered, second: str) -> None:
    then = SECOND[second]
    slave.then = lambda request, answer: then(request, answer) if request[1:3] == b"\x00\x10" else [answer]
    with Connection(ScriptedBus(slave)) as connection:
        found = examine(connection, None, listen_s=0.1)
    told = [text for verdict, text in found.findings if verdict == "FAIL"]
    if second == "refuses first":  # its answers to this object are the same
        assert told == []
    else:
        assert (
            len(told) == 1
            and f"node {NODE}: two nodes answer on this id, an answer for 0x1000:00 came twice" in told[0]
        )


def test_two_channels_of_this_program_are_no_two_nodes(node: DriveNode) -> None:
    """What one of them writes is answered in the mailbox of the other, which has read the same object before."""
    other = SdoChannel(node.connection, NODE)
    assert node.sdo.read(*NUMBER) == b"\1\2\3\4"
    other.download(*NUMBER, b"\1\2\3\5")
    assert node.sdo.read(*NUMBER) == b"\1\2\3\5" and not node.sdo.contradiction and not other.contradiction
    assert node.identity().vendor == 1
