# SPDX-License-Identifier: MIT
"""Adapters as they are: echoes, silence after unplugging, missing states, altered buffers, spinning, bus-off.

These run on the wall clock with the connection's own reader thread.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import can
import pytest

from pmsmtool.bus.clock import VirtualClock
from pmsmtool.bus.connect import Connection
from pmsmtool.bus.examination import _state
from pmsmtool.bus.sdo import Mode, SdoChannel
from pmsmtool.bus.supervision import HeartbeatLost, SecondMaster, Supervision
from pmsmtool.errors import BusError, DriveTimeout
from tests.bus.scripted import NODE, ScriptedSlave

pytestmark = pytest.mark.wall_clock

A = (0x2010, 2)
TABLE = (0x2042, 0)
BODY = bytes(range(250)) * 8


class _Answers:
    """What ScriptedSlave needs of a bus when it is driven frame by frame."""

    def reply(self, data: bytes, delay: float = 0.0) -> None:
        raise AssertionError("this slave answers at once")


class SlaveThread:
    """A slave with a heartbeat behind a stock virtual bus."""

    def __init__(self, channel: str, beat_s: float = 0.05) -> None:
        self.slave = ScriptedSlave({A: b"\1\2\3\4", TABLE: BODY})
        self.slave.attach(_Answers())  # type: ignore[arg-type]
        self.bus = can.Bus(interface="virtual", channel=channel, ignore_config=True)
        self.plugged = True
        self._end = threading.Event()
        self._beat_s = beat_s
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        beat = time.monotonic()
        while not self._end.is_set():
            if time.monotonic() >= beat and self.plugged:
                self.send(0x700 + NODE, b"\x05")
                beat += self._beat_s
            message = self.bus.recv(0.005)
            if message is not None and message.arbitration_id == 0x600 + NODE and self.plugged:
                for frame in self.slave._step(bytes(message.data)):
                    self.send(0x580 + NODE, frame)

    def send(self, cob_id: int, data: bytes) -> None:
        self.bus.send(can.Message(arbitration_id=cob_id, data=data, is_extended_id=False))

    def stop(self) -> None:
        self._end.set()
        self._thread.join()
        self.bus.shutdown()


class Adapter(can.BusABC):
    """Wraps a stock bus and behaves as badly as asked."""

    def __init__(self, channel: str, **stock: Any) -> None:
        self.inner = can.Bus(interface="virtual", channel=channel, ignore_config=True, **stock)
        self.channel_info = "bad adapter"
        self.pads = self.mute = self.send_fails = self.spins = self.echo_received = False
        self.recv_error: Exception | None = None
        super().__init__(channel=channel)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if self.send_fails:
            raise can.CanOperationError("write failed", 19)
        self.inner.send(msg)
        if self.pads:
            msg.data[:] = b"\xff" * len(msg.data)  # gs_usb pads what it was given, in place

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if self.recv_error is not None:
            raise self.recv_error
        if self.spins:
            return None, False
        if self.mute:
            time.sleep(timeout or 0.0)
            return None, False
        message = self.inner.recv(timeout)
        if message is not None and self.echo_received:
            message.is_rx = True
        return message, False

    @property  # type: ignore[misc]
    def state(self) -> can.BusState:
        raise NotImplementedError("as python-can #736")

    def shutdown(self) -> None:
        super().shutdown()
        self.inner.shutdown()


Rig = tuple[Adapter, SlaveThread, Connection, Supervision, SdoChannel]


@contextmanager
def rig(name: str, change: Callable[[Adapter], None] = lambda adapter: None, **stock: Any) -> Iterator[Rig]:
    slave = SlaveThread(name)
    adapter = Adapter(name, **stock)
    change(adapter)
    with Connection(adapter) as connection:
        supervision = Supervision(connection, NODE)
        supervision.heartbeat_period_s = 0.05
        yield adapter, slave, connection, supervision, SdoChannel(connection, NODE, check=supervision.check)
    slave.stop()


def transfers(channel: SdoChannel) -> None:
    assert channel.read(*A) == b"\1\2\3\4"
    channel.download(*A, b"\5\6\7\x08")
    assert channel.read(*A) == b"\5\6\7\x08"
    assert channel.upload(*TABLE, size=len(BODY)).mode is Mode.BLOCK
    channel.download(*TABLE, BODY[::-1])
    assert channel.upload(*TABLE, size=len(BODY)).data == BODY[::-1]


def test_own_frames_marked_as_own(request: pytest.FixtureRequest) -> None:
    with rig(request.node.name, receive_own_messages=True) as (_, _, connection, supervision, channel):
        transfers(channel)
        connection.wait(0.05)
        supervision.check()
        assert supervision.foreign_requests == 0 and channel.discarded == 0


def test_own_frames_that_look_received(request: pytest.FixtureRequest) -> None:
    def change(adapter: Adapter) -> None:
        adapter.echo_received = True

    with rig(request.node.name, change, receive_own_messages=True) as (_, slave, connection, supervision, channel):
        transfers(channel)
        connection.wait(0.05)
        supervision.check()
        assert supervision.foreign_requests == 0
        slave.send(0x600 + NODE, b"\x40\x41\x60\x00" + bytes(4))
        connection.wait(0.05)
        with pytest.raises(SecondMaster):
            channel.read(*A)


@pytest.mark.parametrize("late", [True, False])
def test_an_echo_behind_its_answer_is_no_second_master(late: bool) -> None:
    """Adapter and node race for the queue; without echoes a request that repeats our last one is another master's."""
    connection = ScriptedConnection()
    supervision = Supervision(connection, NODE)  # type: ignore[arg-type]
    requests = [bytes((0x40, k, 0x60, 0)) + bytes(4) for k in range(4)]
    for request in requests:
        connection.sent[0x600 + NODE].append(request)
        connection.arrive(0x580 + NODE)
        if late:
            connection.arrive(0x600 + NODE, request)
    assert supervision.foreign_requests == 0
    for repeated in range(2):
        connection.arrive(0x600 + NODE, requests[-1])
        assert supervision.foreign_requests == repeated + 1


class ScriptedConnection:
    """Hands frames to their subscribers in a written order."""

    def __init__(self) -> None:
        self.clock = VirtualClock()
        self.sent: dict[int, deque[bytes]] = {}
        self.echo: tuple[int, bytes, float] | None = None
        self.arrived = 0
        self.deaf_s = 0.0
        self._subscribers: dict[int, list[Callable[[int, bytes, float], None]]] = {}

    def subscribe(self, cob_id: int, callback: Callable[[int, bytes, float], None]) -> None:
        self._subscribers.setdefault(cob_id, []).append(callback)

    def arrive(self, cob_id: int, data: bytes = bytes(8)) -> None:
        self.arrived += 1
        for callback in self._subscribers.get(cob_id, ()):
            callback(cob_id, data, 1e-3 * self.arrived)


def test_buffers_altered_on_send(request: pytest.FixtureRequest) -> None:
    def change(adapter: Adapter) -> None:
        adapter.pads = True

    with rig(request.node.name, change) as (_, _, _, supervision, channel):
        transfers(channel)
        supervision.check()


def test_recv_that_never_raises_when_unplugged(request: pytest.FixtureRequest) -> None:
    """Gone is what the heartbeat and the sending tell, never recv alone."""
    with rig(request.node.name) as (adapter, _, connection, _, channel):
        channel.read(*A)
        connection.wait(0.15)
        adapter.mute = True
        gone = time.monotonic()
        with pytest.raises(HeartbeatLost):
            for _ in range(100):
                channel.read(*A)
        assert time.monotonic() - gone < 1.0
        connection.raise_if_failed()


def test_send_that_fails(request: pytest.FixtureRequest) -> None:
    with rig(request.node.name) as (adapter, _, _, _, channel):
        adapter.send_fails = True
        with pytest.raises(BusError, match="adapter is gone"):
            channel.read(*A)


def test_full_transmit_queue_says_that_nobody_acknowledges(request: pytest.FixtureRequest) -> None:
    def full(msg: can.Message, timeout: float | None = None) -> None:
        raise can.CanOperationError("Transmit buffer full", 105)

    with rig(request.node.name) as (adapter, _, _, _, channel):
        adapter.send = full  # type: ignore[method-assign]
        with pytest.raises(BusError, match="no other node acknowledges"):
            channel.read(*A)


def test_transmit_queue_that_empties_again(request: pytest.FixtureRequest) -> None:
    with rig(request.node.name) as (adapter, _, _, _, channel):
        send, refusals = adapter.send, [3]

        def sometimes(msg: can.Message, timeout: float | None = None) -> None:
            if refusals[0]:
                refusals[0] -= 1
                raise can.CanOperationError("Transmit buffer full", 105)
            send(msg)

        adapter.send = sometimes  # type: ignore[method-assign]
        assert channel.read(*A) == b"\1\2\3\4"


def test_reader_that_raises_bus_off(request: pytest.FixtureRequest) -> None:
    with rig(request.node.name) as (adapter, _, _, _, channel):
        adapter.recv_error = can.CanOperationError("bus off")
        time.sleep(0.3)
        with pytest.raises(BusError, match="bus off"):
            channel.read(*A)


def test_backend_that_spins_is_noticed_within_two_seconds(request: pytest.FixtureRequest) -> None:
    """socketcand after its server died: recv returns at once, with nothing, for ever."""
    with rig(request.node.name) as (adapter, slave, _, supervision, channel):
        supervision.heartbeat_period_s = None
        slave.plugged = False
        adapter.spins = True
        started, cpu = time.monotonic(), time.process_time()
        with pytest.raises(BusError) as caught:
            channel.read(*A)
        assert not isinstance(caught.value, DriveTimeout) and "without waiting" in str(caught.value)
        assert time.monotonic() - started < 2.0 and time.process_time() - cpu < 1.5


def test_controller_state_that_is_missing() -> None:
    adapter = Adapter("no state")
    assert _state(adapter) == ""
    adapter.shutdown()


def test_call_from_the_reader_thread_is_refused(request: pytest.FixtureRequest) -> None:
    met: list[BaseException] = []
    with rig(request.node.name) as (_, _, connection, _, channel):

        def callback(cob_id: int, data: bytes, timestamp: float) -> None:
            if not met:
                try:
                    channel.read(*A)
                except Exception as error:
                    met.append(error)

        connection.subscribe(0x700 + NODE, callback)
        assert connection.wait_until(lambda: bool(met), 2.0)
        assert "callback" in str(met[0])
        assert channel.read(*A) == b"\1\2\3\4"
