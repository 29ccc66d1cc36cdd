# SPDX-License-Identifier: MIT
"""Length of a classic CAN frame on the wire, bit by bit (ISO 11898-1:2015, 10.4 and 10.5).

Start of frame to the end of the CRC is stuffed: after five equal bits one opposite bit is inserted. CRC delimiter,
acknowledge, end of frame and the three bits of intermission are not. Both the CRC and the stuffing are carried byte
by byte in tables, because every frame on a paced simulated bus is counted.
"""

from __future__ import annotations

from functools import lru_cache

TRAILER_BITS = 13
"""CRC delimiter 1, acknowledge slot and delimiter 2, end of frame 7, intermission 3."""
CRC_BITS = 15
_CRC_POLYNOMIAL = 0x4599
_CRC_MASK = 0x7FFF
_STANDARD_HEADER_BITS = 19
_EXTENDED_HEADER_BITS = 39
# State of the stuffing: 4 * last bit + (run - 1), run 1..4; a fifth equal bit is stuffed at once.
_IDLE_STATE = 4  # recessive bus: the start bit begins a new run


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte << 7
        for _ in range(8):
            crc = (crc << 1) ^ (_CRC_POLYNOMIAL if crc & 0x4000 else 0)
        table.append(crc & _CRC_MASK)
    return tuple(table)


def _stuff_bit(state: int, bit: int) -> tuple[int, int]:
    """Return the state after one bit, and the stuff bits inserted behind it."""
    last, run = state >> 2, (state & 3) + 1
    if bit != last:
        return 4 * bit, 0
    if run == 4:
        return 4 * (1 - bit), 1
    return state + 1, 0


def _stuff_bits(state: int, value: int, width: int) -> tuple[int, int]:
    stuffed = 0
    for position in range(width - 1, -1, -1):
        state, extra = _stuff_bit(state, value >> position & 1)
        stuffed += extra
    return state, stuffed


def _stuff_table(width: int) -> tuple[tuple[int, ...], ...]:
    """Return ``table[state][value]`` = 8 * inserted bits + new state."""
    rows = []
    for state in range(8):
        row = []
        for value in range(1 << width):
            new, stuffed = _stuff_bits(state, value, width)
            row.append(8 * stuffed + new)
        rows.append(tuple(row))
    return tuple(rows)


_CRC = _crc_table()
_STUFF_8 = _stuff_table(8)
_STUFF_7 = _stuff_table(7)


def _header(can_id: int, extended: bool, remote: bool, dlc: int) -> tuple[int, int]:
    """Return the bits from start of frame to the length code as (value, width)."""
    if extended:
        base, low = can_id >> 18, can_id & 0x3FFFF
        value = (base << 2 | 0b11) << 18 | low  # SRR and IDE recessive
        return value << 7 | remote << 6 | dlc, _EXTENDED_HEADER_BITS  # two reserved bits dominant
    return can_id << 7 | remote << 6 | dlc, _STANDARD_HEADER_BITS  # IDE and r0 dominant


@lru_cache(maxsize=4096)
def _header_state(can_id: int, extended: bool, remote: bool, dlc: int) -> tuple[int, int, int]:
    """Return CRC register, stuffing state and stuffed length after the header."""
    value, width = _header(can_id, extended, remote, dlc)
    crc = 0  # leading zeros leave it zero, so the header may be padded to whole bytes
    for shift in range(32, -1, -8):
        crc = (crc << 8 & _CRC_MASK) ^ _CRC[(crc >> 7) ^ (value >> shift & 0xFF)]
    state, stuffed = _stuff_bits(_IDLE_STATE, value, width)
    return crc, state, width + stuffed


def frame_bits(
    can_id: int, data: bytes | bytearray = b"", *, extended: bool = False, remote: bool = False, dlc: int | None = None
) -> int:
    """Return the bits a classic CAN frame occupies, intermission included.

    Parameters
    ----------
    can_id : int
        Identifier, 11 or 29 bits.
    data : bytes
        Payload, at most 8 bytes; ignored in a remote frame.
    extended, remote : bool
        Frame format.
    dlc : int, optional
        Length code of a remote frame.
    """
    payload = b"" if remote else data
    crc, state, bits = _header_state(can_id, extended, remote, len(payload) if dlc is None else dlc)
    stuffed = 0
    for byte in payload:
        crc = (crc << 8 & _CRC_MASK) ^ _CRC[(crc >> 7) ^ byte]
        step = _STUFF_8[state][byte]
        state = step & 7
        stuffed += step >> 3
    step = _STUFF_7[state][crc >> 8]
    stuffed += (step >> 3) + (_STUFF_8[step & 7][crc & 0xFF] >> 3)
    return bits + 8 * len(payload) + stuffed + CRC_BITS + TRAILER_BITS


def unstuffed_bits(length: int) -> int:
    """Return the length (bits) of a frame with an 11-bit identifier and ``length`` data bytes without any stuff bit."""
    return _STANDARD_HEADER_BITS + 8 * length + CRC_BITS + TRAILER_BITS
