# SPDX-License-Identifier: MIT
"""SDO transfers by segments, and the uploads of up to four bytes that need none.

A segment names no object: whatever is late from a transfer given up before looks like one of this. ``SdoChannel``
therefore reads a barrier before it tries again.

Protocol: CiA 301, sections 7.2.4.3.3 to 7.2.4.3.6.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.sdo_transfer import Attempt, Mode, TransferLost

if TYPE_CHECKING:
    from pmsmtool.bus.sdo import SdoChannel


def upload(channel: SdoChannel, attempt: Attempt, first: bytes) -> bytes:
    """Return the object whose normal upload the node began with the frame ``first``."""
    if first[0] & 0x02:
        attempt.mode = Mode.EXPEDITED
        usual = attempt.size or channel.usual_lengths.get((attempt.index, attempt.sub), 4)
        length = 4 - (first[0] >> 2 & 3) if first[0] & 0x01 else min(4, usual)
        return channel.check_size(attempt, first[4 : 4 + length], None)
    attempt.mode = Mode.SEGMENTED
    announced = int.from_bytes(first[4:8], "little") if first[0] & 0x01 else None
    channel.check_announced(attempt, announced)
    limit = attempt.limit if announced is None else announced
    attempt.segments = True
    data, toggle, more = bytearray(), 0, True
    while more:
        channel.send(bytes((0x60 | toggle, 0, 0, 0, 0, 0, 0, 0)))
        frame = _await_toggled(channel, attempt, toggle, len(data))
        data += frame[1 : 8 - (frame[0] >> 1 & 7)]
        more = not frame[0] & 0x01
        channel.raise_if_over(attempt, len(data))
        if len(data) > limit:
            raise TransferLost(f"node sent more than the {limit} bytes announced or expected", AbortCode.TOO_LONG)
        if more and frame[0] >> 1 & 7 == 7:
            raise TransferLost("node sends segments of 0 bytes", AbortCode.GENERAL)
        toggle ^= 0x10
    return channel.check_size(attempt, bytes(data), announced)


def download(channel: SdoChannel, attempt: Attempt, data: bytes) -> None:
    """Write an object by segments."""
    channel.send(attempt.head(0x21) + len(data).to_bytes(4, "little"))
    channel.await_answer(attempt, lambda f: f[0] == 0x60 and attempt.owns(f), "the write request")
    toggle = 0
    for start in range(0, max(len(data), 1), 7):
        piece = data[start : start + 7]
        last = start + 7 >= len(data)
        channel.send(bytes((toggle | (7 - len(piece)) << 1 | last,)) + piece.ljust(7, b"\0"))
        _await_toggled(channel, attempt, 0x20 | toggle, start)
        channel.raise_if_over(attempt, start)
        toggle ^= 0x10


def _await_toggled(channel: SdoChannel, attempt: Attempt, command: int, position: int) -> bytes:
    """Return the answer to one segment; one with the other toggle is a duplicate of the last."""
    return channel.await_answer(attempt, lambda f: f[0] & 0xF0 == command, f"the segment at byte {position}")
