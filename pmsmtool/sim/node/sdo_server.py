# SPDX-License-Identifier: MIT
"""The node's SDO server: expedited, segmented and block transfers, both ways (CiA 301, 7.2.4).

Written apart from every client, so that the two cannot share a mistake. Differences to common servers, on purpose:
announced sizes are checked at the initiate, during and at the end; an unfinished transfer times out and a new initiate
replaces it; aborts carry the multiplexor of the transfer; a sub-block with a gap is acknowledged up to the gap, after
``REACKNOWLEDGE_S`` of silence also when its last segment was lost.
"""

from __future__ import annotations

import struct
from binascii import crc_hqx
from collections.abc import Callable
from dataclasses import dataclass, field

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.clock import NS, Schedule, Timer
from pmsmtool.sim.node.dictionary import Dictionary, Entry, Refused

TIMEOUT_S = 1.0
"""Silence after which an open transfer is aborted with 0x05040000."""
REACKNOWLEDGE_S = 0.2
"""Silence inside a sub-block after which what arrived in order is acknowledged."""
MAX_SUB_BLOCK = 127
CAPACITY_BYTES = 1 << 20
"""Largest object a client may send without being refused for want of memory."""
_HEAD = struct.Struct("<BHB")
_ABORT = struct.Struct("<BHBI")
_SIZED = struct.Struct("<BHBI")
_NUMBERS = tuple(bytes((number,)) for number in range(256))
_TOGGLE = 0x10
_CONTINUED = 0x80


@dataclass(slots=True)
class _Transfer:
    """One open transfer; ``done`` counts confirmed bytes of an upload."""

    entry: Entry
    expect: Callable[[bytes], None]
    data: bytearray | bytes = b""
    announced: int | None = None
    toggle: int = 0
    done: int = 0
    sub_block: int = 0
    sequence: int = 0
    sent: int = 0
    crc_used: bool = False
    acknowledged: bool = True
    last_frame: bytes = b""
    end_frame: bytes = field(default=b"")


class SdoServer:
    """Server of the default SDO channel.

    Parameters
    ----------
    dictionary : Dictionary
        What is read and written.
    clock : Schedule
        The node's clock, for time-outs.
    send, withdraw : callables
        Send 8 bytes to the client; take back what is not on the wire yet.

    Attributes
    ----------
    distort : callable
        Fault injection: ``(index, sub, data) -> (announced size, data sent)`` of an upload.
    refuse : callable
        Fault injection: abort code for a write to ``(index, sub)``, None to let it pass.
    """

    def __init__(
        self, dictionary: Dictionary, clock: Schedule, send: Callable[[bytes], None], withdraw: Callable[[], None]
    ) -> None:
        self.dictionary = dictionary
        self.distort: Callable[[int, int, bytes], tuple[int, bytes]] | None = None
        self.refuse: Callable[[int, int], int | None] | None = None
        self._clock = clock
        self._send = send
        self._withdraw = withdraw
        self._open: _Transfer | None = None
        self._confirmation: bytes | None = None
        self._pending_entry: Entry | None = None
        self._last_ns = 0
        self._watch: Timer | None = None

    # ---- frames --------------------------------------------------------------------------------

    def receive(self, frame: bytes) -> None:
        """Take one request of the client."""
        if len(frame) != 8:
            return
        if frame[0] == 0x80:
            if self._open is not None or self._confirmation is not None:
                self._withdraw()
            self._close()
            self._confirmation = None
            return
        if self._confirmation is not None:
            return  # storing: a single-threaded drive does not answer meanwhile
        self._last_ns = self._clock.now_ns
        transfer = self._open
        try:
            if transfer is None:
                self._initiate(frame)
            else:
                transfer.expect(frame)
        except Refused as refused:
            self._abort(refused.code, frame)

    def reset(self) -> None:
        """Forget everything without a word (node reset, STOPPED, power off)."""
        self._close()
        self._confirmation = None

    def finish(self, code: int | None = None) -> None:
        """Answer the write whose entry asked to confirm later; with a code, abort it."""
        confirmation, entry = self._confirmation, self._pending_entry
        self._confirmation = None
        if confirmation is None or entry is None:
            return
        if code is None:
            self._send(confirmation)
        else:
            self._send(_ABORT.pack(0x80, entry.row.index, entry.row.sub, code))

    def _abort(self, code: int, frame: bytes) -> None:
        if self._open is not None:
            row = self._open.entry.row
            index, sub = row.index, row.sub
            self._withdraw()
        else:
            _, index, sub = _HEAD.unpack_from(frame)
        self._close()
        self._send(_ABORT.pack(0x80, index, sub, code))

    def _close(self) -> None:
        self._open = None
        if self._watch is not None:
            self._watch.cancel()
            self._watch = None

    def _begin(self, transfer: _Transfer) -> None:
        self._open = transfer
        if self._watch is None:
            self._plan_watch(self._last_ns + round(REACKNOWLEDGE_S * NS))

    def _plan_watch(self, instant_ns: int) -> None:
        self._watch = self._clock.at(instant_ns, self._on_watch)

    def _on_watch(self) -> None:
        self._watch = None
        transfer = self._open
        if transfer is None:
            return
        idle_ns = self._clock.now_ns - self._last_ns
        if idle_ns >= round(TIMEOUT_S * NS):
            self._abort(AbortCode.TIMED_OUT, b"")
            return
        if idle_ns >= round(REACKNOWLEDGE_S * NS):
            if not transfer.acknowledged:
                self._acknowledge(transfer)
            self._plan_watch(self._last_ns + round(TIMEOUT_S * NS))
        else:
            self._plan_watch(self._last_ns + round(REACKNOWLEDGE_S * NS))

    def _initiate(self, frame: bytes) -> None:
        command = frame[0]
        service = command >> 5
        if service == 2:
            self._start_upload(frame)
        elif service == 1:
            self._start_download(frame)
        elif service == 5 and command & 0x03 == 0:
            self._start_block_upload(frame)
        elif service == 6 and command & 0x01 == 0:
            self._start_block_download(frame)
        elif command != 0xA1:  # the late confirmation of an upload's end asks for nothing
            raise Refused(AbortCode.COMMAND)

    def _is_initiate(self, frame: bytes) -> bool:
        service = frame[0] >> 5
        return service in (1, 2) or (service == 5 and frame[0] & 3 == 0) or (service == 6 and frame[0] & 1 == 0)

    def _restart(self, frame: bytes) -> None:
        """Answer a frame that does not belong to the open transfer: a new initiate replaces it."""
        if not self._is_initiate(frame):
            raise Refused(AbortCode.COMMAND)
        self._withdraw()
        self._close()
        self._initiate(frame)

    # ---- upload: node to client ----------------------------------------------------------------

    def _read(self, frame: bytes) -> tuple[Entry, int, bytes]:
        _, index, sub = _HEAD.unpack_from(frame)
        entry = self.dictionary.readable(index, sub)
        data = entry.read()
        announced = len(data)
        if self.distort is not None:
            announced, data = self.distort(index, sub, data)
        return entry, announced, data

    def _start_upload(self, frame: bytes) -> None:
        self._answer_upload(frame, *self._read(frame))

    def _answer_upload(self, frame: bytes, entry: Entry, announced: int, data: bytes) -> None:
        if 0 < len(data) <= 4 and announced == len(data):
            self._send(_NUMBERS[0x43 | (4 - len(data)) << 2] + frame[1:4] + data.ljust(4, b"\0"))
            return
        self._begin(_Transfer(entry, self._upload_segment, data))
        self._send(_SIZED.pack(0x41, entry.row.index, entry.row.sub, announced))

    def _upload_segment(self, frame: bytes) -> None:
        transfer = self._current()
        if frame[0] >> 5 != 3:
            self._restart(frame)
            return
        if frame[0] & _TOGGLE != transfer.toggle:
            raise Refused(AbortCode.TOGGLE)
        piece = bytes(transfer.data[transfer.done : transfer.done + 7])
        transfer.done += len(piece)
        last = transfer.done >= len(transfer.data)
        self._send(_NUMBERS[transfer.toggle | (7 - len(piece)) << 1 | last] + piece.ljust(7, b"\0"))
        transfer.toggle ^= _TOGGLE
        if last:
            self._close()

    def _start_block_upload(self, frame: bytes) -> None:
        entry, announced, data = self._read(frame)
        size, threshold = frame[4], frame[5]
        if not 1 <= size <= MAX_SUB_BLOCK:
            raise Refused(AbortCode.BLOCK_SIZE)
        if threshold and len(data) <= threshold:
            self._answer_upload(frame, entry, announced, data)
            return
        self._begin(_Transfer(entry, self._upload_blocks, data, sub_block=size))
        self._send(_SIZED.pack(0xC6, entry.row.index, entry.row.sub, announced))

    def _upload_blocks(self, frame: bytes) -> None:
        transfer = self._current()
        command = frame[0]
        if command == 0xA3 and transfer.done == 0:
            self._send_sub_block(transfer)
        elif command == 0xA2:
            if frame[1] > transfer.sent:
                raise Refused(AbortCode.SEQUENCE)
            if not 1 <= frame[2] <= MAX_SUB_BLOCK:
                raise Refused(AbortCode.BLOCK_SIZE)
            transfer.done = min(transfer.done + 7 * frame[1], max(len(transfer.data), 1))
            transfer.sub_block = frame[2]
            if transfer.done >= len(transfer.data) and transfer.sent:
                self._end_block_upload(transfer)
            else:
                self._send_sub_block(transfer)
        else:
            self._restart(frame)

    def _send_sub_block(self, transfer: _Transfer) -> None:
        data, start = transfer.data, transfer.done
        rest = max(1, -(-(len(data) - start) // 7))
        count = min(rest, transfer.sub_block)
        transfer.sent = count
        send = self._send
        for number in range(1, count):
            send(_NUMBERS[number] + data[start : start + 7])
            start += 7
        last = _CONTINUED if count == rest else 0
        send(_NUMBERS[count | last] + bytes(data[start : start + 7]).ljust(7, b"\0"))

    def _end_block_upload(self, transfer: _Transfer) -> None:
        unused = -len(transfer.data) % 7 if transfer.data else 7
        crc = crc_hqx(transfer.data, 0)
        transfer.end_frame = _NUMBERS[0xC1 | unused << 2] + crc.to_bytes(2, "little") + bytes(5)
        transfer.expect = self._await_upload_end
        self._send(transfer.end_frame)

    def _await_upload_end(self, frame: bytes) -> None:
        if frame[0] == 0xA1:
            self._close()
        elif frame[0] == 0xA2:
            self._send(self._current().end_frame)  # the client did not see it
        else:
            self._restart(frame)

    # ---- download: client to node --------------------------------------------------------------

    def _target(self, frame: bytes, announced: int | None) -> Entry:
        _, index, sub = _HEAD.unpack_from(frame)
        entry = self.dictionary.writable(index, sub)
        if announced is not None:
            if entry.size and announced != entry.size:
                raise Refused(AbortCode.TOO_LONG if announced > entry.size else AbortCode.TOO_SHORT)
            if announced > CAPACITY_BYTES:
                raise Refused(AbortCode.MEMORY)
        return entry

    def _commit(self, entry: Entry, data: bytes, confirmation: bytes) -> None:
        if self.refuse is not None:
            code = self.refuse(entry.row.index, entry.row.sub)
            if code is not None:
                raise Refused(code)
        pending = self.dictionary.write(entry, data)
        self._close()
        if pending:
            self._confirmation, self._pending_entry = confirmation, entry
        else:
            self._send(confirmation)

    def _start_download(self, frame: bytes) -> None:
        command = frame[0]
        confirmation = b"\x60" + frame[1:4] + bytes(4)
        if command & 0x02:
            length = 4 - (command >> 2 & 3) if command & 0x01 else None
            entry = self._target(frame, length)
            if length is None:
                length = min(entry.size, 4) or 4
            self._commit(entry, bytes(frame[4 : 4 + length]), confirmation)
            return
        announced = int.from_bytes(frame[4:8], "little") if command & 0x01 else None
        entry = self._target(frame, announced)
        self._begin(_Transfer(entry, self._download_segment, bytearray(), announced))
        self._send(confirmation)

    def _download_segment(self, frame: bytes) -> None:
        transfer = self._current()
        command = frame[0]
        if command >> 5 != 0:
            self._restart(frame)
            return
        if command & _TOGGLE != transfer.toggle:
            raise Refused(AbortCode.TOGGLE)
        self._append(transfer, frame[1 : 8 - (command >> 1 & 7)])
        confirmation = _NUMBERS[0x20 | transfer.toggle] + bytes(7)
        transfer.toggle ^= _TOGGLE
        if command & 0x01:
            self._check_complete(transfer, len(transfer.data))
            self._commit(transfer.entry, bytes(transfer.data), confirmation)
        else:
            self._send(confirmation)

    def _append(self, transfer: _Transfer, piece: bytes, padding: int = 0) -> None:
        data = transfer.data
        if not isinstance(data, bytearray):
            raise TypeError("an upload takes no data")
        data += piece
        limit = transfer.announced
        if limit is None:
            if len(data) > CAPACITY_BYTES:
                raise Refused(AbortCode.MEMORY)
        elif len(data) > limit + padding:
            raise Refused(AbortCode.TOO_LONG)

    def _check_complete(self, transfer: _Transfer, length: int) -> None:
        if transfer.announced is not None and length != transfer.announced:
            raise Refused(AbortCode.TOO_LONG if length > transfer.announced else AbortCode.TOO_SHORT)

    def _start_block_download(self, frame: bytes) -> None:
        announced = int.from_bytes(frame[4:8], "little") if frame[0] & 0x02 else None
        entry = self._target(frame, announced)
        crc_used = bool(frame[0] & 0x04)
        self._begin(_Transfer(entry, self._download_blocks, bytearray(), announced, crc_used=crc_used))
        self._send(b"\xa4" + frame[1:4] + _NUMBERS[MAX_SUB_BLOCK] + bytes(3))

    def _download_blocks(self, frame: bytes) -> None:
        transfer = self._current()
        number = frame[0] & 0x7F
        if frame == transfer.last_frame and transfer.sequence == 0 and transfer.acknowledged:
            return  # the segment that ended the last sub-block, duplicated on its way
        transfer.acknowledged = False
        if number == transfer.sequence + 1:
            self._append(transfer, frame[1:], padding=6)
            transfer.sequence = number
            transfer.last_frame = frame
            if frame[0] & _CONTINUED:
                transfer.expect = self._download_end
                self._acknowledge(transfer)
                return
        if number == MAX_SUB_BLOCK or frame[0] & _CONTINUED:
            self._acknowledge(transfer)

    def _acknowledge(self, transfer: _Transfer) -> None:
        transfer.end_frame = bytes((0xA2, transfer.sequence, MAX_SUB_BLOCK, 0, 0, 0, 0, 0))
        transfer.sequence = 0
        transfer.acknowledged = True
        self._send(transfer.end_frame)

    def _download_end(self, frame: bytes) -> None:
        transfer = self._current()
        if frame[0] & 0xE3 != 0xC1:
            if frame[0] & _CONTINUED and frame[0] & 0x60 == 0 and frame[1:] == transfer.last_frame[1:]:
                self._send(transfer.end_frame)  # the client did not see our acknowledgement
                return
            self._restart(frame)
            return
        data = bytes(transfer.data)
        data = data[: len(data) - (frame[0] >> 2 & 7)]
        # The CRC first: what got lost on the way is a matter of the transport, not of the object's length.
        if transfer.crc_used and crc_hqx(data, 0) != int.from_bytes(frame[1:3], "little"):
            raise Refused(AbortCode.CRC)
        self._check_complete(transfer, len(data))
        self._commit(transfer.entry, data, b"\xa1" + bytes(7))

    def _current(self) -> _Transfer:
        if self._open is None:
            raise RuntimeError("no transfer is open")
        return self._open
