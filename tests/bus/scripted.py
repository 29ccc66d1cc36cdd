# SPDX-License-Identifier: MIT
"""A scripted slave on a virtual-time bus: a correct SDO server of its own, and every way to be a bad one.

Written from CiA 301 for the tests only, so that the client is not checked against the simulated
drive's server alone.
"""

from __future__ import annotations

import random
from binascii import crc_hqx
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass, field

import can

from pmsmtool.bus.clock import VirtualClock

NODE = 5
Serving = Generator[list[bytes], bytes, "list[bytes] | None"]
"""One transfer: receives requests, yields answers, returns the last one."""
Fate = Iterable[float]
"""Delays (s) at which copies of a frame arrive: () drops it, (0, 0) doubles it."""


class ScriptedBus(can.BusABC):
    """A python-can bus with a clock of its own and one slave on it.

    ``to_slave`` and ``to_master`` decide over each frame by its running number and data.
    """

    def __init__(self, slave: ScriptedSlave) -> None:
        self.clock = VirtualClock()
        self.slave = slave
        self.inbox: deque[can.Message] = deque()
        self.sent: list[tuple[int, bytes]] = []
        self.to_slave: Callable[[int, bytes], Fate] = lambda number, data: (0.0,)
        self.to_master: Callable[[int, bytes], Fate] = lambda number, data: (0.0,)
        self.answers = 0
        self.alive = True
        self.echo = False
        self.channel_info = "scripted"
        super().__init__(channel="scripted")
        slave.attach(self)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if not self.alive:
            raise can.CanOperationError("unplugged")
        data = bytes(msg.data)
        self.sent.append((msg.arbitration_id, data))
        if self.echo:
            self.deliver(msg.arbitration_id, data)
        if msg.arbitration_id == 0x600 + NODE:
            for delay in self.to_slave(len(self.sent), data):
                self.clock.after(delay + 50e-6, lambda: self._reach_slave(data))
        elif msg.arbitration_id == 0:
            self.clock.after(50e-6, lambda: self.slave.nmt(data))

    def _reach_slave(self, data: bytes) -> None:
        for frame in self.slave.answer(data):
            self.reply(frame)

    def reply(self, data: bytes, delay: float = 0.0) -> None:
        """Send a frame of the slave's SDO server to the master."""
        self.answers += 1
        for extra in self.to_master(self.answers, data):
            self.clock.after(delay + extra + 50e-6, lambda: self.deliver(0x580 + NODE, data))

    def deliver(self, cob_id: int, data: bytes) -> None:
        """Put any frame into the master's receive queue."""
        stamp = self.clock.now()
        self.inbox.append(can.Message(arbitration_id=cob_id, data=data, is_extended_id=False, timestamp=stamp))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        if not self.alive:
            raise can.CanOperationError("unplugged")
        limit = self.clock.now_ns + round((timeout or 0.0) * 1e9)
        while not self.inbox and self.clock.now_ns < limit:
            with self.clock.held:
                self.clock.step(limit)
        return self.inbox.popleft() if self.inbox else None

    def shutdown(self) -> None:
        self._is_shutdown = True


def lossy(rng: random.Random, share: float) -> Callable[[int, bytes], Fate]:
    """Drop a share of the frames."""
    return lambda number, data: () if rng.random() < share else (0.0,)


@dataclass
class ScriptedSlave:
    """An SDO server; the fields are its virtues and vices."""

    objects: dict[tuple[int, int], bytes] = field(default_factory=dict)
    refuse: dict[tuple[int, int], int] = field(default_factory=dict)
    block: bool = True
    crc: bool = True
    announce: bool = True
    block_size: int = 127
    delay: Callable[[bytes], float] = lambda data: 0.0
    end_early: int | None = None
    lie_size: int | None = None
    gap_acknowledged_at_once: bool = False
    hung: bool = False
    writes: list[tuple[int, int, bytes]] = field(default_factory=list)

    def attach(self, bus: ScriptedBus) -> None:
        self.bus = bus
        self.generator: Serving | None = None
        self.raw = False

    def nmt(self, data: bytes) -> None:
        self.generator = None
        if data[0] in (0x81, 0x82):
            self.bus.deliver(0x700 + NODE, b"\x00")

    def answer(self, data: bytes) -> Iterator[bytes]:
        if self.hung:
            return
        delay = self.delay(data)
        for frame in self._step(data):
            if delay:
                self.bus.reply(frame, delay)
            else:
                yield frame

    # One transfer is a generator that is sent requests and yields lists of frames.
    def _step(self, data: bytes) -> list[bytes]:
        command = data[0]
        if command == 0x80:
            self.generator = None
            return []
        fresh = (
            command >> 5 in (1, 2)
            or (command >> 5 == 5 and command & 3 == 0)
            or (command >> 5 == 6 and not command & 1)
        )
        in_block = self.generator is not None and self.raw
        if fresh and not in_block:
            self.generator = self._serve(data)
            return next(self.generator)
        if self.generator is None:
            return [_abort(data[1] | data[2] << 8, data[3], 0x05040001)]
        try:
            return self.generator.send(data)
        except StopIteration as end:
            self.generator = None
            return end.value or []

    def _serve(self, data: bytes) -> Serving:
        self.raw = False
        index, sub = data[1] | data[2] << 8, data[3]
        kind = data[0] >> 5
        code = self.refuse.get((index, sub))
        if kind in (5, 6) and not self.block:
            code = 0x05040001
        if code is None and kind in (2, 5) and (index, sub) not in self.objects:
            code = 0x06020000
        if code is not None:
            yield [_abort(index, sub, code)]
            return None
        head = bytes((data[1], data[2], data[3]))
        if kind == 1:
            return (yield from self._download(data, head, index, sub))
        if kind == 2:
            return (yield from self._upload(head, index, sub))
        if kind == 5:
            return (yield from self._block_upload(data, head, index, sub))
        return (yield from self._block_download(data, head, index, sub))

    def _store(self, index: int, sub: int, body: bytes) -> None:
        self.objects[index, sub] = body
        self.writes.append((index, sub, body))

    def _download(self, data: bytes, head: bytes, index: int, sub: int) -> Serving:
        if data[0] & 2:
            self._store(index, sub, data[4 : 8 - (data[0] >> 2 & 3)])
            yield [b"\x60" + head + bytes(4)]
            return None
        size = int.from_bytes(data[4:8], "little")
        body, toggle = b"", 0
        request = yield [b"\x60" + head + bytes(4)]
        while True:
            if request[0] & 0x10 != toggle:
                return [_abort(index, sub, 0x05030000)]
            body += request[1 : 8 - (request[0] >> 1 & 7)]
            reply = [bytes((0x20 | toggle,)) + bytes(7)]
            toggle ^= 0x10
            if request[0] & 1:
                if len(body) != size:
                    return [_abort(index, sub, 0x06070010)]
                self._store(index, sub, body)
                return reply
            request = yield reply

    def _upload(self, head: bytes, index: int, sub: int) -> Serving:
        body = self.objects[index, sub]
        if 0 < len(body) <= 4 and self.lie_size is None:
            yield [bytes((0x43 | 4 - len(body) << 2,)) + head + body.ljust(4, b"\0")]
            return None
        size = len(body) if self.lie_size is None else self.lie_size
        request = yield [bytes((0x41 if self.announce else 0x40,)) + head + size.to_bytes(4, "little")]
        toggle, position = 0, 0
        end = len(body) if self.end_early is None else self.end_early
        while True:
            if request[0] != 0x60 | toggle:
                return [_abort(index, sub, 0x05030000)]
            piece = body[position : min(position + 7, end)]
            position += 7
            last = position >= end
            reply = [bytes((toggle | 7 - len(piece) << 1 | last,)) + piece.ljust(7, b"\0")]
            toggle ^= 0x10
            if last:
                return reply
            request = yield reply

    def _block_upload(self, data: bytes, head: bytes, index: int, sub: int) -> Serving:
        body = self.objects[index, sub]
        block_size, threshold = data[4], data[5]
        if threshold and len(body) <= threshold:
            return (yield from self._upload(head, index, sub))
        with_crc = self.crc and data[0] & 4
        size = len(body) if self.lie_size is None else self.lie_size
        first = bytes((0xC0 | (4 if with_crc else 0) | (2 if self.announce else 0),))
        request = yield [first + head + size.to_bytes(4, "little")]
        if request[0] != 0xA3:
            return [_abort(index, sub, 0x05040001)]
        end = len(body) if self.end_early is None else self.end_early
        position = 0
        while True:
            frames: list[bytes] = []
            at = position
            while len(frames) < block_size and (at < end or not end):
                piece = body[at : min(at + 7, end)]
                at += 7
                frames.append(bytes((len(frames) + 1 | (0x80 if at >= end else 0),)) + piece.ljust(7, b"\0"))
                if at >= end:
                    break
            request = yield frames
            if request[0] != 0xA2 or request[1] > len(frames):
                return [_abort(index, sub, 0x05040001 if request[0] != 0xA2 else 0x05040003)]
            position += 7 * request[1]
            block_size = request[2]
            if position >= end:
                break
        sent = body[:end]
        request = yield [bytes((0xC1 | -len(sent) % 7 << 2,)) + crc_hqx(sent, 0).to_bytes(2, "little") + bytes(5)]
        if request[0] != 0xA1:
            return [_abort(index, sub, 0x05040001)]
        return []

    def _block_download(self, data: bytes, head: bytes, index: int, sub: int) -> Serving:
        size = int.from_bytes(data[4:8], "little")
        with_crc = self.crc and data[0] & 4
        body = b""
        self.raw = True
        request = yield [bytes((0xA4 if with_crc else 0xA0,)) + head + bytes((self.block_size, 0, 0, 0))]
        done = False
        while not done:
            taken = 0
            while True:
                number = request[0] & 0x7F
                if number == taken + 1:
                    taken += 1
                    body += request[1:]
                    done = bool(request[0] & 0x80)
                if (
                    done
                    or number == self.block_size
                    or request[0] & 0x80
                    or (self.gap_acknowledged_at_once and number > taken)
                ):
                    break
                request = yield []
            request = yield [bytes((0xA2, taken, self.block_size, 0, 0, 0, 0, 0))]
        self.raw = False
        if request[0] & 0xE3 != 0xC1:
            return [_abort(index, sub, 0x05040001)]
        body = body[: len(body) - (request[0] >> 2 & 7)]
        if with_crc and crc_hqx(body, 0) != int.from_bytes(request[1:3], "little"):
            return [_abort(index, sub, 0x05040004)]
        if len(body) != size:
            return [_abort(index, sub, 0x06070010)]
        self._store(index, sub, body)
        return [b"\xa1" + bytes(7)]


def _abort(index: int, sub: int, code: int) -> bytes:
    return b"\x80" + index.to_bytes(2, "little") + bytes((sub,)) + code.to_bytes(4, "little")
