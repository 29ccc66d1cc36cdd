# SPDX-License-Identifier: MIT
"""A scripted SDO client on raw frames, written from CiA 301 for these tests; shares no code with the tool's."""

from __future__ import annotations

import struct
from binascii import crc_hqx

import can

from pmsmtool.sim.bus import PmsmSimBus

HEAD = struct.Struct("<BHB")


class Aborted(Exception):
    """The node aborted a transfer."""

    def __init__(self, code: int, index: int, sub: int) -> None:
        super().__init__(f"0x{code:08X} for 0x{index:04X}:{sub:02X}")
        self.code = code
        self.index = index
        self.sub = sub


class Lost(Exception):
    """A transfer did not come to an end; it may be started again."""


class RawClient:
    """One node's SDO client; every wait is on the bus clock."""

    def __init__(self, bus: PmsmSimBus, node: int = 1, timeout_s: float = 0.5) -> None:
        self.bus = bus
        self.node = node
        self.timeout_s = timeout_s
        self.others: list[can.Message] = []

    # ---- frames --------------------------------------------------------------------------------

    def send(self, data: bytes, can_id: int | None = None) -> None:
        can_id = 0x600 + self.node if can_id is None else can_id
        self.bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    def receive(self, timeout_s: float | None = None) -> bytes | None:
        """Return the next SDO frame of the node, None after the time-out; other frames are kept aside."""
        deadline = self.bus.clock.now() + (self.timeout_s if timeout_s is None else timeout_s)
        while (left := deadline - self.bus.clock.now()) > 0:
            message = self.bus.recv(left)
            if message is None:
                return None
            if message.arbitration_id == 0x580 + self.node:
                return bytes(message.data)
            self.others.append(message)
        return None

    def expect(self, what: str) -> bytes:
        frame = self.receive()
        if frame is None:
            raise Lost(what)
        if frame[0] == 0x80:
            _, index, sub, code = struct.unpack("<BHBI", frame)
            raise Aborted(code, index, sub)
        return frame

    def ask(self, data: bytes) -> bytes | None:
        """Send a frame and return the next SDO frame, abort or not."""
        self.send(data)
        return self.receive()

    def drain(self) -> None:
        while self.receive(0.05) is not None:
            pass

    def abort(self, index: int, sub: int, code: int = 0x08000000) -> None:
        self.send(struct.pack("<BHBI", 0x80, index, sub, code))

    def heard(self, can_id: int) -> list[bytes]:
        """Return the data of the frames of another identifier seen so far."""
        return [bytes(message.data) for message in self.others if message.arbitration_id == can_id]

    # ---- transfers -----------------------------------------------------------------------------

    def read(self, index: int, sub: int = 0) -> bytes:
        """Read by a normal upload, expedited or segmented."""
        self.send(HEAD.pack(0x40, index, sub) + bytes(4))
        return self._normal_upload(self.expect("upload"), index, sub)

    def _normal_upload(self, first: bytes, index: int, sub: int) -> bytes:
        assert HEAD.unpack_from(first)[1:] == (index, sub)
        assert first[0] & 0xE0 == 0x40
        if first[0] & 0x02:
            return first[4 : 8 - (first[0] >> 2 & 3)]
        announced = int.from_bytes(first[4:8], "little")
        data, toggle = b"", 0
        while True:
            self.send(bytes((0x60 | toggle,)) + bytes(7))
            frame = self.expect("upload segment")
            if frame[0] & 0xF0 != toggle:
                raise Lost("toggle")
            data += frame[1 : 8 - (frame[0] >> 1 & 7)]
            toggle ^= 0x10
            if frame[0] & 1:
                break
        if len(data) != announced:
            raise Lost(f"{len(data)} of {announced} bytes")
        return data

    def write(self, index: int, sub: int, data: bytes, *, segmented: bool = False) -> None:
        if 0 < len(data) <= 4 and not segmented:
            self.send(HEAD.pack(0x23 | (4 - len(data)) << 2, index, sub) + data.ljust(4, b"\0"))
            assert self.expect("download")[:4] == HEAD.pack(0x60, index, sub)
            return
        self.send(struct.pack("<BHBI", 0x21, index, sub, len(data)))
        assert self.expect("download")[:4] == HEAD.pack(0x60, index, sub)
        toggle, position = 0, 0
        while True:
            piece = data[position : position + 7]
            position += len(piece)
            last = position >= len(data)
            self.send(bytes((toggle | (7 - len(piece)) << 1 | last,)) + piece.ljust(7, b"\0"))
            frame = self.expect("download segment")
            if frame[0] != 0x20 | toggle:
                raise Lost("toggle")
            toggle ^= 0x10
            if last:
                return

    def read_block(self, index: int, sub: int = 0, *, size: int = 127, threshold: int = 0) -> bytes:
        self.send(HEAD.pack(0xA4, index, sub) + bytes((size, threshold, 0, 0)))
        first = self.expect("block upload")
        if first[0] & 0xE0 == 0x40:
            return self._normal_upload(first, index, sub)
        assert first[:4] == HEAD.pack(0xC6, index, sub)
        announced = int.from_bytes(first[4:8], "little")
        self.send(b"\xa3" + bytes(7))
        data = bytearray()
        while True:
            count, last = self._sub_block(data, size)
            self.send(bytes((0xA2, count, size, 0, 0, 0, 0, 0)))
            if last:
                break
        end = self.expect("block end")
        if end[0] & 0xE3 != 0xC1:
            raise Lost("block end")
        del data[len(data) - (end[0] >> 2 & 7) :]
        if len(data) != announced or crc_hqx(bytes(data), 0) != int.from_bytes(end[1:3], "little"):
            self.abort(index, sub, 0x05040004)
            raise Lost("CRC")
        self.send(b"\xa1" + bytes(7))
        return bytes(data)

    def _sub_block(self, data: bytearray, size: int) -> tuple[int, bool]:
        taken = 0
        while True:
            frame = self.receive(self.timeout_s)
            if frame is None:
                if not taken:
                    raise Lost("segments")
                return taken, False
            number = frame[0] & 0x7F
            if frame[0] == 0x80:
                raise Aborted(int.from_bytes(frame[4:8], "little"), *HEAD.unpack_from(frame)[1:])
            if number == taken + 1:
                data += frame[1:]
                taken = number
                if frame[0] & 0x80:
                    return taken, True
            if number == size or frame[0] & 0x80:
                return taken, False

    def write_block(self, index: int, sub: int, data: bytes, *, with_crc: bool = True) -> None:
        self.send(struct.pack("<BHBI", 0xC2 | (4 if with_crc else 0), index, sub, len(data)))
        first = self.expect("block download")
        assert first[:4] == HEAD.pack(0xA4, index, sub)
        size, position = first[4], 0
        while position < len(data):
            rest = -(-(len(data) - position) // 7)
            count = min(size, rest)
            for number in range(1, count + 1):
                start = position + 7 * (number - 1)
                mark = 0x80 if number == rest else 0
                self.send(bytes((number | mark,)) + data[start : start + 7].ljust(7, b"\0"))
            ack = self.expect("block acknowledge")
            if ack[0] != 0xA2 or ack[1] > count:
                raise Lost("block acknowledge")
            position += 7 * ack[1]
            size = ack[2]
        crc = crc_hqx(data, 0) if with_crc else 0
        self.send(bytes((0xC1 | (-len(data) % 7) << 2,)) + crc.to_bytes(2, "little") + bytes(5))
        if self.expect("block download end")[0] != 0xA1:
            raise Lost("block download end")

    def number(self, index: int, sub: int = 0, kind: str = "I") -> float:
        """Read a number of a struct type letter."""
        value: float = struct.unpack("<" + kind, self.read(index, sub))[0]
        return value

    def put(self, index: int, sub: int, value: float, kind: str = "I") -> None:
        """Write a number of a struct type letter."""
        self.write(index, sub, struct.pack("<" + kind, value))
