# SPDX-License-Identifier: MIT
"""Every wait and every length is bounded, whatever the server does; and late frames are of the past."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator

import can
import pytest

from pmsmtool.bus.connect import Connection, connect
from pmsmtool.bus.sdo import Mode, SdoChannel
from pmsmtool.bus.sdo_transfer import LARGEST_UNKNOWN, OBJECT_LIMIT_S
from pmsmtool.cia402 import State
from pmsmtool.drive.drive_node import LONGEST_NAME, DriveNode
from pmsmtool.drive.stop import BUSY_S, quick_stop
from pmsmtool.errors import BusError, DriveTimeout, SdoAbort, StopNotConfirmed
from tests.bus.scripted import NODE, ScriptedBus, ScriptedSlave

TABLE = (0x2042, 0)
Answers = Callable[[bytes], list[bytes]]


class Hostile(ScriptedSlave):
    """A server whose every answer is scripted."""

    def __init__(self, answers: Answers, delay_s: float = 0.0) -> None:
        super().__init__({})
        self._answers = answers
        self._delay_s = delay_s

    def answer(self, data: bytes) -> Iterator[bytes]:
        for frame in self._answers(data):
            self.bus.reply(frame, self._delay_s)
        yield from ()


def opened(answers: Answers, delay_s: float = 0.0) -> tuple[ScriptedBus, SdoChannel]:
    bus = ScriptedBus(Hostile(answers, delay_s))
    return bus, SdoChannel(Connection(bus), NODE)


def segments(first: bytes, segment: bytes) -> Answers:
    """Begin every upload with ``first`` and go on with the same segment for ever."""

    def answers(request: bytes) -> list[bytes]:
        if request[0] == 0x40:
            return [first[:1] + request[1:4] + first[4:]]
        if request[0] & 0xEF == 0x60:
            return [bytes((segment[0] | request[0] & 0x10,)) + segment[1:]]
        return []

    return answers


FULL, ONE, NOTHING = b"\x00" + bytes(7), b"\x0c" + bytes(7), b"\x0e" + bytes(7)
UNANNOUNCED = b"\x40" + bytes(7)


def test_an_upload_that_never_ends_is_cut_at_the_expected_size() -> None:
    bus, channel = opened(segments(UNANNOUNCED, FULL))
    with pytest.raises(SdoAbort, match="more than the 20 bytes"):
        channel.upload(*TABLE, size=20, mode=Mode.SEGMENTED)
    assert len(bus.sent) < 3 * 8


def test_an_upload_of_unknown_size_is_cut_and_not_tried_again() -> None:
    bus, channel = opened(segments(UNANNOUNCED, FULL))
    with pytest.raises(SdoAbort, match="longer than the 5000 bytes"):
        channel.upload(*TABLE, longest=5000)
    assert len(bus.sent) <= 5000 // 7 + 4
    assert LARGEST_UNKNOWN < 1 << 21


def test_four_gigabytes_announced_are_refused_at_once() -> None:
    bus, channel = opened(segments(b"\x41\0\0\0\xff\xff\xff\xff", FULL))
    with pytest.raises(SdoAbort, match="longer than"):
        channel.upload(*TABLE)
    assert [data[0] for _, data in bus.sent] == [0x40, 0x80]


def test_segments_without_a_byte_are_no_progress() -> None:
    bus, channel = opened(segments(UNANNOUNCED, NOTHING))
    with pytest.raises(SdoAbort, match="0 bytes"):
        channel.upload(*TABLE)
    assert len(bus.sent) < 30


def test_a_server_that_drips_is_given_up_after_the_time_of_an_object() -> None:
    bus, channel = opened(segments(UNANNOUNCED, ONE), delay_s=0.25)
    with pytest.raises(DriveTimeout, match="not complete in time"):
        channel.upload(*TABLE)
    assert bus.clock.now() < OBJECT_LIMIT_S + 2.0


@pytest.mark.parametrize("mode", [Mode.SEGMENTED, Mode.BLOCK])
def test_a_flood_of_other_frames_does_not_prolong_a_wait(mode: Mode) -> None:
    bus, channel = opened(lambda request: [])
    bus.clock.every(0.0005, lambda: bus.deliver(0x580 + NODE, b"\x43\x99\x99\x09\0\0\0\0"))
    with pytest.raises(DriveTimeout):
        channel.upload(*TABLE, mode=mode)
    assert bus.clock.now() < 12.0


def test_a_block_download_of_which_nothing_is_acknowledged_ends() -> None:
    def answers(request: bytes) -> list[bytes]:
        if request[0] & 0xE1 == 0xC0:
            return [b"\xa4" + request[1:4] + b"\x04\0\0\0"]
        return [b"\xa2\x00\x04" + bytes(5)] if request[0] & 0x7F == 4 else []

    bus, channel = opened(answers)
    with pytest.raises(DriveTimeout, match="acknowledges no segment"):  # and it answers no barrier, either
        channel.download(*TABLE, bytes(400), mode=Mode.BLOCK)
    assert len(bus.sent) < 200, "40 000 frames before"


def test_a_block_upload_of_duplicates_ends() -> None:
    def answers(request: bytes) -> list[bytes]:
        if request[0] == 0xA4:
            return [b"\xc4" + request[1:4] + bytes(4)]
        return [b"\x01" + bytes(7)] * 2000 if request[0] in (0xA3, 0xA2) else []

    bus, channel = opened(answers)
    with pytest.raises((SdoAbort, DriveTimeout)):
        channel.upload(*TABLE, mode=Mode.BLOCK)
    assert bus.clock.now() < OBJECT_LIMIT_S + 5.0


def test_the_time_of_a_command_ends_its_transfers() -> None:
    bus, channel = opened(segments(UNANNOUNCED, ONE), delay_s=0.25)
    channel.finish_within(3.0)
    with pytest.raises(DriveTimeout, match="takes too long"):
        channel.upload(*TABLE)
    assert bus.clock.now() < 3.5
    with pytest.raises(DriveTimeout):
        channel.upload(*TABLE)
    assert bus.clock.now() < 3.5


# ---- late frames ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("late_s", [0.31, 0.5, 0.75])
def test_a_late_segment_of_a_given_up_upload_is_not_one_of_the_retry(late_s: float) -> None:
    """The second segment comes late, in order: what the server sends after it is late, too."""
    old, new = bytes(range(1, 15)), bytes(range(101, 115))
    slave = ScriptedSlave({TABLE: old, (0x1000, 0): bytes(4)})
    bus = ScriptedBus(slave)
    channel = SdoChannel(Connection(bus), NODE)
    freed = 0.0

    def in_order(number: int, data: bytes) -> tuple[float]:
        nonlocal freed
        if number == 2:  # the first segment, with the toggle bit every first segment has
            slave.objects[TABLE] = new
            freed = bus.clock.now() + late_s
        return (max(0.0, freed - bus.clock.now()),)

    bus.to_master = in_order
    assert channel.upload(*TABLE).data == new


def test_one_late_segment_alone_is_not_one_of_the_retry() -> None:
    """A gateway that holds a single frame back for half a second."""
    old, new = bytes(range(1, 15)), bytes(range(101, 115))
    slave = ScriptedSlave({TABLE: old, (0x1000, 0): bytes(4)})
    bus = ScriptedBus(slave)
    channel = SdoChannel(Connection(bus), NODE)

    def held(number: int, data: bytes) -> tuple[float]:
        if number == 2:
            slave.objects[TABLE] = new
            return (0.5,)
        return (0.0,)

    bus.to_master = held
    assert channel.upload(*TABLE).data == new


def test_a_node_that_answers_after_the_time_out_is_waited_for() -> None:
    slave = ScriptedSlave({TABLE: b"\x01\x02", (0x1000, 0): bytes(4)}, delay=lambda data: 0.45)
    channel = SdoChannel(Connection(ScriptedBus(slave)), NODE)
    assert channel.upload(*TABLE).data == b"\x01\x02"
    assert channel.upload(*TABLE).tries == 1, "it is known to be slow by now"


# ---- names, stops, servers --------------------------------------------------------------------------------


def test_a_name_is_clean_and_not_endless() -> None:
    objects = {(0x1018, 1): bytes(4), (0x1008, 0): b"A\x1b[2J\r\nB\x9b", (0x1009, 0): bytes(200_000)}
    bus = ScriptedBus(ScriptedSlave(objects))
    identity = DriveNode(Connection(bus), NODE).identity()
    assert identity.name == "A\\x1b[2J\\r\\nB\ufffd"
    assert identity.hardware == f"(longer than {LONGEST_NAME} bytes)"
    assert len(bus.sent) < 100


@pytest.mark.parametrize("flood", [False, True])
def test_a_stop_without_a_valid_answer_ends_within_two_seconds(flood: bool) -> None:
    bus, _ = opened(lambda request: [])
    if flood:
        bus.clock.every(0.001, lambda: bus.deliver(0x580 + NODE, b"\x43\x99\x99\x09\0\0\0\0"))
    with pytest.raises(StopNotConfirmed):
        quick_stop(DriveNode(Connection(bus), NODE))
    assert 1.4 < bus.clock.now() < 2.0
    words = [data[4] for cob, data in bus.sent if data[1:4] == b"\x40\x60\x00" and data[0] & 0xE0 == 0x20]
    assert words[-1] == 0, "the voltage is taken away unheard"


def test_a_stop_whose_answers_begin_and_never_end_does_not_wait_for_them() -> None:
    """Each segmented upload stalls after its first frame: 9.6 s passed before."""
    bus, _ = opened(lambda request: [b"\x41" + request[1:4] + b"\x02\0\0\0"] if request[0] == 0x40 else [])
    with pytest.raises(StopNotConfirmed) as caught:
        quick_stop(DriveNode(Connection(bus), NODE))
    told, error = set(), caught.value.__cause__
    while error is not None:  # what the command line lists behind `also:`
        told.add(type(error).__name__)
        error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)
    assert "OutOfTime" in told and "TransferLost" not in told
    assert 1.4 < bus.clock.now() < 2.2
    words = [data[4] for cob, data in bus.sent if data[1:4] == b"\x40\x60\x00" and data[0] & 0xE0 == 0x20]
    assert words[-1] == 0, "the voltage is taken away unheard"


@pytest.mark.chain
@pytest.mark.parametrize("greeting", [b"", b"<", b"< hi >", b"HTTP/1.1 400 Bad Request\r\n\r\n\x1b[2J"])
def test_a_server_that_does_not_speak_socketcand_is_given_up(greeting: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pmsmtool.bus.connect._SERVER_TIMEOUT_S", 0.2)  # 2 s: two of the greetings leave it waiting
    with socket.create_server(("127.0.0.1", 0)) as server:
        kept = []

        def serve() -> None:
            while True:
                try:
                    client, _ = server.accept()
                except OSError:
                    return
                kept.append(client)
                client.sendall(greeting)

        threading.Thread(target=serve, daemon=True).start()
        began = time.monotonic()
        with pytest.raises(BusError) as caught:
            connect("socketcand", "vcan0", host="127.0.0.1", port=server.getsockname()[1], ignore_config=True)
        assert time.monotonic() - began < 5.0
        assert caught.value.exit_code == 3 and "\x1b" not in caught.value.what and "Traceback" not in caught.value.what


@pytest.mark.parametrize("code", [None, 0x06010001])
def test_a_store_under_way_is_waited_for_and_no_longer(code: int | None) -> None:
    """A drive that stores answers nothing meanwhile; one whose 0x1010 cannot be read has finished when it says so."""
    slave = ScriptedSlave({(0x1010, 1): b"\x01\0\0\0", (0x1000, 0): bytes(4)}, hung=True)
    if code is not None:
        slave.refuse[0x1010, 1] = code
    bus = ScriptedBus(slave)
    bus.clock.after(1.5, lambda: setattr(slave, "hung", False))
    node = DriveNode(Connection(bus), NODE)
    node.wait_for_store()
    assert 1.5 < bus.clock.now() < 3.0


def test_a_stop_of_a_busy_drive_is_asked_for_until_it_answers() -> None:
    """Drives refuse with 0x08000022 while they store or start: 2.5 s here, 3 s are waited for."""
    bus: ScriptedBus

    def answers(request: bytes) -> list[bytes]:
        head = request[1:4]
        if bus.clock.now() < busy_s:
            return [b"\x80" + head + (0x08000022).to_bytes(4, "little")]
        return [b"\x4b" + head + b"\x40\x02\0\0" if request[0] == 0x40 else b"\x60" + head + bytes(4)]

    for busy_s, confirmed in ((2.5, True), (60.0, False)):
        bus, _ = opened(answers)
        node = DriveNode(Connection(bus), NODE)
        if confirmed:
            assert quick_stop(node) is State.SWITCH_ON_DISABLED
            assert busy_s <= bus.clock.now() < busy_s + 0.5
        else:
            with pytest.raises(StopNotConfirmed, match="device state"):
                quick_stop(node)
            assert bus.clock.now() < BUSY_S + 0.5


def test_two_threads_never_write_the_bus_trace_at_once() -> None:
    """A recorded bus had bytes of the memory in it: one thread wrote a sent frame, another a received one."""

    class Writer:
        inside = overlaps = frames = 0

        def __call__(self, message: can.Message) -> None:
            self.inside += 1
            self.overlaps += self.inside > 1
            time.sleep(1e-4)
            self.inside -= 1
            self.frames += 1

        def stop(self) -> None:
            self.overlaps += self.inside > 0

    writer = Writer()
    connection = Connection(ScriptedBus(ScriptedSlave({})), writer=writer)
    workers = [threading.Thread(target=lambda: [connection.send(0x700, b"\x05") for _ in range(40)]) for _ in range(3)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    connection.close()
    assert writer.frames >= 120 and writer.overlaps == 0
