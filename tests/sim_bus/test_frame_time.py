# SPDX-License-Identifier: MIT
"""Frame lengths against a bit-by-bit frame builder written from the standard, and the figures of the references."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pmsmtool.bus.frame_time import frame_bits, unstuffed_bits


def transmitted_bits(
    can_id: int, data: bytes, extended: bool, remote: bool = False, dlc: int | None = None
) -> list[int]:
    """Build the frame as a list of bits: fields, CRC by long division, stuffing by counting."""

    def field(value: int, width: int) -> list[int]:
        return [int(digit) for digit in f"{value:0{width}b}"]

    length = len(data) if dlc is None else dlc
    bits = [0]
    if extended:
        bits += [*field(can_id >> 18, 11), 1, 1, *field(can_id & 0x3FFFF, 18), int(remote), 0, 0]
    else:
        bits += [*field(can_id, 11), int(remote), 0, 0]
    bits += field(length, 4)
    if not remote:
        for byte in data:
            bits += field(byte, 8)
    register = 0
    for bit in bits:
        invert = bit ^ (register >> 14 & 1)
        register = register << 1 & 0x7FFF
        if invert:
            register ^= 0x4599
    bits += field(register, 15)
    stuffed: list[int] = []
    for bit in bits:
        stuffed.append(bit)
        if len(stuffed) >= 5 and len(set(stuffed[-5:])) == 1 and _run_length(stuffed) == 5:
            stuffed.append(1 - bit)
    return stuffed + [1] * 13


def _run_length(bits: list[int]) -> int:
    run = 1
    while run < len(bits) and bits[-run - 1] == bits[-1]:
        run += 1
    return run


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
def test_standard_frames_match_the_bit_by_bit_frame(can_id: int, data: bytes) -> None:
    assert frame_bits(can_id, data) == len(transmitted_bits(can_id, data, extended=False))


@given(st.integers(0, 0x1FFFFFFF), st.binary(max_size=8))
def test_extended_frames_match_the_bit_by_bit_frame(can_id: int, data: bytes) -> None:
    assert frame_bits(can_id, data, extended=True) == len(transmitted_bits(can_id, data, extended=True))


@given(st.integers(0, 0x7FF), st.integers(0, 8), st.booleans())
def test_remote_frames_match_the_bit_by_bit_frame(can_id: int, dlc: int, extended: bool) -> None:
    expected = len(transmitted_bits(can_id, b"", extended, remote=True, dlc=dlc))
    assert frame_bits(can_id, b"", remote=True, dlc=dlc, extended=extended) == expected


@pytest.mark.parametrize(("data", "bits"), [(b"", 47), (bytes(range(1, 9)), 111)])
def test_unstuffed_length_is_the_textbook_number(data: bytes, bits: int) -> None:
    assert unstuffed_bits(len(data)) == bits


def test_average_sdo_frame_lies_where_the_references_count_it() -> None:
    """docs/canopen.md, 4: an 8-byte frame has 111 bits unstuffed, 135 worst; SDO traffic averages 114-123."""
    random_data = random.Random(1)
    lengths = [frame_bits(0x581, bytes([index % 127 + 1]) + random_data.randbytes(7)) for index in range(2000)]
    assert min(lengths) > 111
    assert max(lengths) <= 135
    assert 114 <= sum(lengths) / len(lengths) <= 123
    assert frame_bits(0x000, bytes(8)) > 123
