# SPDX-License-Identifier: MIT
"""SDO block transfers with recovery of gaps, lost acknowledgements and lost ends.

A gap is acknowledged after the sub-block, not at once; the peer repeats from there. When everything
fell silent, either our frame or the peer's was lost; what is sent then leads forward in both cases,
and the CRC and the length decide in the end.

Protocol: CiA 301, sections 7.2.4.3.7 to 7.2.4.3.16; CRC polynomial 0x1021, start 0.
"""

from __future__ import annotations

from binascii import crc_hqx
from typing import TYPE_CHECKING

from pmsmtool.bus.abort_codes import BLOCK_REFUSED_CODES, AbortCode
from pmsmtool.bus.sdo_transfer import Attempt, BlockRefused, TransferLost
from pmsmtool.errors import SdoAbort

if TYPE_CHECKING:
    from collections.abc import Callable

    from pmsmtool.bus.sdo import SdoChannel

BLOCK_SIZE = 127
"""Segments per sub-block we ask for; the most the protocol has."""
SWITCH_BYTES = 4
"""Protocol switch threshold: objects of up to this many bytes come expedited (pst, B9)."""
SILENCES = 4
"""Times in a row that nothing new may arrive before the transfer starts over."""
FRAMES_LIMIT = 4 * BLOCK_SIZE
"""Frames in one sub-block, duplicates included, after which the node is taken for one that never ends it."""


def upload(channel: SdoChannel, attempt: Attempt) -> tuple[bytes, bytes | None]:
    """Read an object by block.

    Returns
    -------
    data, normal
        ``normal`` is None, or the frame with which the node began a normal upload instead.
    """
    channel.send(attempt.head(0xA4) + bytes((BLOCK_SIZE, SWITCH_BYTES, 0, 0)))
    first = _initiate(channel, attempt, lambda f: f[0] & 0xE0 == 0x40 or f[0] & 0xF9 == 0xC0)
    if first[0] & 0xE0 == 0x40:
        return b"", first
    announced = int.from_bytes(first[4:8], "little") if first[0] & 0x02 else None
    channel.check_announced(attempt, announced)
    data, acknowledgement = _receive_blocks(channel, attempt, announced)
    end = _await_end(channel, attempt, acknowledgement)
    body = bytes(data[: len(data) - (end[0] >> 2 & 7)])
    channel.check_size(attempt, body, announced)
    if first[0] & 0x04 and crc_hqx(body, 0) != int.from_bytes(end[1:3], "little"):
        raise TransferLost(f"CRC of {len(body)} bytes does not match", AbortCode.CRC)
    channel.send(b"\xa1" + bytes(7))
    return body, None


def _receive_blocks(channel: SdoChannel, attempt: Attempt, announced: int | None) -> tuple[bytearray, bytes]:
    """Return the data with its padding, and the acknowledgement of its last sub-block."""
    limit = (attempt.limit if announced is None else announced) + 7
    data = bytearray()
    silences = 0
    request = b"\xa3" + bytes(7)
    channel.send(request)
    while True:
        count, last, frames = _receive_sub_block(channel, attempt, data)
        silences = 0 if count else silences + 1
        if len(data) > limit:
            raise TransferLost(f"node sent more than {limit - 7} bytes", AbortCode.TOO_LONG)
        channel.raise_if_over(attempt, len(data) - 7)  # the last segment is padded
        if frames:
            request = bytes((0xA2, count, BLOCK_SIZE, 0, 0, 0, 0, 0))
        elif announced is not None and announced - len(data) <= 7:
            silences = SILENCES + 1
        # Else, of a lost request and two or more lost segments, the request is the likelier: it goes again.
        if silences > SILENCES:
            raise TransferLost(f"no segment after byte {len(data)}")
        channel.send(request)
        if last:
            return data, request


def _receive_sub_block(channel: SdoChannel, attempt: Attempt, data: bytearray) -> tuple[int, bool, int]:
    """Append one sub-block; return segments taken in order, whether the last was one, frames seen."""
    taken, frames, previous = 0, 0, b""
    for _ in range(FRAMES_LIMIT):
        frame = channel.receive(attempt.timeout_s)
        if frame is None:
            return taken, False, frames
        command = frame[0]
        number = command & 0x7F
        if number == taken + 1:
            data += frame[1:]
            taken = number
            if command & 0x80:
                return taken, True, frames + 1
        elif command == 0x80:
            channel.raise_if_abort_of(attempt, frame)
            continue
        elif number <= taken or frame == previous:
            attempt.discarded += 1  # a duplicate
            continue
        else:
            attempt.retransmitted += 1  # behind a gap: comes again
        frames += 1
        previous = frame
        if number == BLOCK_SIZE or command & 0x80:
            return taken, False, frames
    raise TransferLost(f"node sends the same segments again and again after byte {len(data)}", AbortCode.SEQUENCE)


def _await_end(channel: SdoChannel, attempt: Attempt, acknowledgement: bytes) -> bytes:
    try:
        return channel.await_answer(attempt, lambda f: f[0] & 0xE3 == 0xC1, "the last acknowledgement")
    except TransferLost as lost:
        if lost.code != AbortCode.TIMED_OUT:
            raise
    # Either the node still waits for the acknowledgement, or its end frame was lost.
    channel.send(acknowledgement)
    return channel.await_answer(attempt, lambda f: f[0] & 0xE3 == 0xC1, "the last acknowledgement")


def download(channel: SdoChannel, attempt: Attempt, data: bytes) -> None:
    """Write an object by block."""
    channel.send(attempt.head(0xC6) + len(data).to_bytes(4, "little"))
    first = _initiate(channel, attempt, lambda f: f[0] & 0xFB == 0xA0)
    has_crc = bool(first[0] & 0x04)
    block_size = first[4]
    position, refused = 0, 0
    while position < len(data):
        if not 1 <= block_size <= 127:
            raise TransferLost(f"node asks for blocks of {block_size} segments", AbortCode.BLOCK_SIZE)
        segments = _segments(data, position, block_size)
        for segment in segments:
            channel.send(segment)
        count, block_size = _acknowledged(channel, attempt, segments, position, has_crc)
        refused = 0 if count else refused + 1
        if refused > SILENCES:
            raise TransferLost(f"node acknowledges no segment from byte {position} on", AbortCode.SEQUENCE)
        attempt.retransmitted += len(segments) - count
        position += 7 * count
    end = bytes((0xC1 | -len(data) % 7 << 2,)) + crc_hqx(data, 0).to_bytes(2, "little") + bytes(5)
    channel.send(end if has_crc else end[:1] + bytes(7))
    channel.await_answer(attempt, lambda f: f[0] & 0xE3 == 0xA1, "the end of the block download")


def _segments(data: bytes, position: int, block_size: int) -> list[bytes]:
    piece = data[position : position + 7 * block_size]
    found = [bytes((k + 1,)) + piece[7 * k : 7 * k + 7] for k in range(-(-len(piece) // 7))]
    if position + 7 * block_size >= len(data):
        found[-1] = bytes((found[-1][0] | 0x80,)) + found[-1][1:].ljust(7, b"\0")
    return found


def _acknowledged(
    channel: SdoChannel, attempt: Attempt, segments: list[bytes], position: int, has_crc: bool
) -> tuple[int, int]:
    """Return how many of the segments the node has, and the size of the next sub-block."""
    nudged = False
    for _ in range(SILENCES):
        try:
            ack = channel.await_answer(attempt, lambda f: f[0] & 0xE3 == 0xA2, f"the sub-block at byte {position}")
        except TransferLost as lost:
            if lost.code != AbortCode.TIMED_OUT or not has_crc:
                raise
            # The node misses the segment that ends the sub-block, or its acknowledgement was lost.
            channel.send(segments[-1])
            attempt.retransmitted += 1
            nudged = True
            continue
        if ack[1] > len(segments):
            raise TransferLost(f"node acknowledges segment {ack[1]} of {len(segments)}", AbortCode.SEQUENCE)
        if nudged and ack[1] == 0 and len(segments) > 1:
            # The node took the nudge for a new sub-block: it has all of this one (the CRC tells if not).
            return len(segments), ack[2]
        return ack[1], ack[2]
    raise TransferLost(f"the sub-block at byte {position} is never acknowledged")


def _initiate(channel: SdoChannel, attempt: Attempt, accept: Callable[[bytes], bool]) -> bytes:
    try:
        return channel.await_answer(attempt, lambda f: accept(f) and attempt.owns(f), "the block request")
    except (TransferLost, SdoAbort) as error:
        if error.code in BLOCK_REFUSED_CODES and not channel.block_supported:
            raise BlockRefused from error
        raise
