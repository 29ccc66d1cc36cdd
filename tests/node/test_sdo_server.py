# SPDX-License-Identifier: MIT
"""The SDO server on raw frames: every kind of transfer, sizes, losses, time-outs and abort codes."""

from __future__ import annotations

import random
import struct
from binascii import crc_hqx
from collections.abc import Callable
from functools import partial

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pmsmtool.bus.abort_codes import AbortCode
from tests.node.bench import SERIAL, Bench, open_bench
from tests.node.conftest import BenchMaker
from tests.node.raw_client import HEAD, Aborted, Lost, RawClient

TABLE = 0x2042
"""A DOMAIN of any size while a set is staged."""
SIZES = sorted(
    {1, 2, 3, 4, 5}
    | {7 * k + d for k in (1, 2, 3, 17, 126, 127, 128, 254, 255) for d in (-1, 0, 1)}
    | {889 * k + d for k in (1, 2, 3, 18) for d in (-8, -7, -1, 0, 1, 6, 7, 8)}
    | {16 * 1024, 32 * 1024}
)


def stage(client: RawClient) -> None:
    client.put(0x2000, 6, 1, "B")


def content(size: int) -> bytes:
    return random.Random(size).randbytes(size)


@pytest.mark.parametrize("size", SIZES)
def test_every_size_travels_in_every_mode_both_ways(bench: Bench, size: int) -> None:
    client, data = bench.client, content(size)
    stage(client)
    client.write_block(TABLE, 0, data)
    assert client.read_block(TABLE) == data
    if size <= 3 * 889 + 8:
        assert client.read(TABLE) == data
        client.write(TABLE, 0, data[::-1], segmented=True)
        assert client.read(TABLE) == data[::-1]
        assert client.read_block(TABLE, size=1 + size % 127) == data[::-1]


def test_64_KiB_of_trace_come_by_block(bench: Bench) -> None:
    client = bench.client
    for channel in range(8):
        client.put(0x2061, channel + 1, 0x20700120)
    client.put(0x2060, 2, 2048)
    client.put(0x2060, 7, 1, "B")
    bench.wait(1.0)
    data = client.read_block(0x2062)
    assert len(data) == 65536
    assert data == bench.core.recording()


def test_an_empty_domain_is_no_bytes_in_every_mode(bench: Bench) -> None:
    stage(bench.client)
    assert bench.client.read(TABLE) == b""
    assert bench.client.read_block(TABLE) == b""
    bench.client.write(TABLE, 0, b"1234567", segmented=True)
    bench.client.write(TABLE, 0, b"", segmented=True)
    assert bench.client.read(TABLE) == b""


def test_block_upload_of_a_small_object_switches_to_a_normal_one_below_the_threshold(bench: Bench) -> None:
    bench.client.send(HEAD.pack(0xA4, 0x1018, 1) + bytes((127, 4, 0, 0)))
    assert bench.client.expect("answer")[0] == 0x43
    bench.client.send(HEAD.pack(0xA4, 0x1018, 1) + bytes((127, 0, 0, 0)))
    assert bench.client.expect("answer")[0] == 0xC6


def test_block_download_without_crc_is_taken(bench: Bench) -> None:
    stage(bench.client)
    bench.client.write_block(TABLE, 0, content(1000), with_crc=False)
    assert bench.client.read(TABLE) == content(1000)


# ---- losses --------------------------------------------------------------------------------------


def download_block_dropping(client: RawClient, data: bytes, dropped: set[int]) -> int:
    """Send by block, leaving out the segments of these running numbers once; returns segments sent."""
    client.send(struct.pack("<BHBI", 0xC6, TABLE, 0, len(data)))
    size, position, sent = client.expect("initiate")[4], 0, 0
    while position < len(data):
        rest = -(-(len(data) - position) // 7)
        for number in range(1, min(size, rest) + 1):
            start = position + 7 * (number - 1)
            frame = bytes((number | (0x80 if number == rest else 0),)) + data[start : start + 7].ljust(7, b"\0")
            if sent not in dropped:
                client.send(frame)
            sent += 1
        ack = client.expect("acknowledge")
        position += 7 * ack[1]
    client.send(bytes((0xC1 | (-len(data) % 7) << 2,)) + crc_hqx(data, 0).to_bytes(2, "little") + bytes(5))
    assert client.expect("end")[0] == 0xA1
    return sent


@pytest.mark.parametrize(
    "dropped", [{0}, {1}, {60}, {125}, {126}, {127}, {200}, {253}, {254}, {284}, {285}, {3, 90, 285}]
)
def test_block_download_gaps_are_acknowledged_up_to_the_gap(bench: Bench, dropped: set[int]) -> None:
    """Also the last segment of a sub-block (126, 253) and the very last one (285)."""
    data = content(2000)
    stage(bench.client)
    download_block_dropping(bench.client, data, dropped)
    assert bench.client.read(TABLE) == data


@pytest.mark.parametrize("lost", [0, 1, 63, 125, 126])
def test_block_upload_resumes_behind_what_the_client_acknowledged(bench: Bench, lost: int) -> None:
    client, data = bench.client, content(1500)
    stage(client)
    client.write_block(TABLE, 0, data)
    client.send(HEAD.pack(0xA4, TABLE, 0) + bytes((127, 0, 0, 0)))
    client.expect("initiate")
    client.send(b"\xa3" + bytes(7))
    first = [client.expect("segment") for _ in range(127)]
    assert [frame[0] for frame in first] == list(range(1, 128))
    client.send(bytes((0xA2, lost, 10, 0, 0, 0, 0, 0)))
    again = [client.expect("segment") for _ in range(10)]
    assert [frame[0] for frame in again] == list(range(1, 11))
    assert b"".join(frame[1:] for frame in again) == data[7 * lost : 7 * lost + 70]


def test_lost_end_of_a_block_upload_is_sent_again_when_the_client_acknowledges_again(bench: Bench) -> None:
    client = bench.client
    stage(client)
    client.write_block(TABLE, 0, content(20))
    client.send(HEAD.pack(0xA4, TABLE, 0) + bytes((127, 0, 0, 0)))
    client.expect("initiate")
    client.send(b"\xa3" + bytes(7))
    for _ in range(3):
        client.expect("segment")
    acknowledge = bytes((0xA2, 3, 127, 0, 0, 0, 0, 0))
    end = client.ask(acknowledge)
    assert client.ask(acknowledge) == end


def test_a_duplicated_last_segment_does_not_disturb_the_next_sub_block(make_bench: BenchMaker) -> None:
    bench = make_bench(faults='[[frame]]\naction="duplicate"\nids="0x601"\nprobability=0.1', seed=4)
    data = content(8000)
    for _ in range(20):
        try:
            stage(bench.client)
            bench.client.write_block(TABLE, 0, data)
        except (Aborted, Lost, AssertionError):
            bench.client.abort(TABLE, 0)
            bench.client.drain()
            continue
        assert bench.client.read_block(TABLE) == data
        break
    else:
        pytest.fail("no transfer of 20 came through")


def persist(client: RawClient, index: int, action: Callable[[], None]) -> bool:
    """Try three times, as a careful client does; returns whether one attempt came through."""
    for _ in range(3):
        try:
            action()
        except (Lost, Aborted):
            client.abort(index, 0)
            client.drain()
        else:
            return True
    return False


def read_into(client: RawClient, found: list[bytes]) -> None:
    found[:] = [client.read_block(TABLE)]


def held_by(bench: Bench) -> bytes:
    assert bench.node.session is not None
    return bench.node.session.dictionary["lut.table_i_d"].read()


@pytest.mark.chain
@pytest.mark.parametrize(("probability", "needed"), [(0.001, 0.99), (0.01, 0.9)])
def test_block_transfers_under_loss_are_right_or_reported(
    make_bench: BenchMaker, probability: float, needed: float
) -> None:
    """30 transfers of 4 KiB each way, at most three tries each; of 120 all came through at 0.1 % and at 1 %."""
    bench = make_bench(faults=f'[[frame]]\naction="drop"\nids=["0x601", "0x581"]\nprobability={probability}', seed=9)
    client = bench.client
    succeeded = 0
    assert persist(client, 0x2000, lambda: stage(client))
    for number in range(30):
        data = content(4096 + number)
        if persist(client, TABLE, partial(client.write_block, TABLE, 0, data)):
            succeeded += 1
            assert held_by(bench) == data
        held = held_by(bench)
        found: list[bytes] = []
        if persist(client, TABLE, partial(read_into, client, found)):
            succeeded += 1
            assert found == [held]
    assert succeeded >= needed * 60


# ---- refusals ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frame", "code"),
    [
        (HEAD.pack(0x40, 0x4711, 0) + bytes(4), AbortCode.NO_OBJECT),
        (HEAD.pack(0x40, 0x1018, 9) + bytes(4), AbortCode.NO_SUBINDEX),
        (HEAD.pack(0x23, 0x1018, 1) + bytes(4), AbortCode.READ_ONLY),
        (struct.pack("<BHBI", 0x21, 0x1018, 1, 4), AbortCode.READ_ONLY),
        (struct.pack("<BHBI", 0xC6, 0x2062, 0, 100), AbortCode.READ_ONLY),
        (struct.pack("<BHBI", 0x21, 0x2010, 2, 8), AbortCode.TOO_LONG),
        (struct.pack("<BHBI", 0x21, 0x2010, 2, 2), AbortCode.TOO_SHORT),
        (HEAD.pack(0x2F, 0x2010, 2) + bytes(4), AbortCode.TOO_SHORT),
        (HEAD.pack(0x23, 0x2010, 1) + bytes(4), AbortCode.TOO_LONG),
        (struct.pack("<BHBf", 0x23, 0x2010, 2, 1e4), AbortCode.VALUE_HIGH),
        (struct.pack("<BHBf", 0x23, 0x2010, 2, -1.0), AbortCode.VALUE_LOW),
        (struct.pack("<BHBf", 0x23, 0x2010, 2, float("nan")), AbortCode.VALUE),
        (struct.pack("<BHBf", 0x23, 0x2010, 2, float("inf")), AbortCode.VALUE),
        (struct.pack("<BHBI", 0x23, 0x1010, 1, 0x12345678), AbortCode.NOT_STORED),
        (struct.pack("<BHBI", 0x23, 0x1011, 1, 0x65766173), AbortCode.NOT_STORED),
        (struct.pack("<BHBI", 0x23, 0x2061, 1, 0x10180120), AbortCode.NOT_MAPPABLE),
        (HEAD.pack(0xA4, 0x2001, 0) + bytes((0, 0, 0, 0)), AbortCode.BLOCK_SIZE),
        (HEAD.pack(0xA4, 0x2001, 0) + bytes((128, 0, 0, 0)), AbortCode.BLOCK_SIZE),
        (struct.pack("<BHBI", 0x21, 0x2001, 0, 1 << 30), AbortCode.MEMORY),
        (struct.pack("<BHBI", 0x2F, 0x2000, 6, 3), AbortCode.DEVICE_STATE),
    ],
)
def test_refusals_carry_code_and_multiplexor(bench: Bench, frame: bytes, code: int) -> None:
    answer = bench.client.ask(frame)
    assert answer is not None
    assert answer == b"\x80" + frame[1:4] + int(code).to_bytes(4, "little")


@pytest.mark.parametrize("command", [0x00, 0x60, 0xE0, 0xC1, 0xA2])
def test_a_segment_without_a_transfer_is_05040001(bench: Bench, command: int) -> None:
    answer = bench.client.ask(bytes((command, 1, 127)) + bytes(5))
    assert answer is not None
    assert answer[0] == 0x80
    assert int.from_bytes(answer[4:], "little") == AbortCode.COMMAND


def test_a_stored_value_survives_a_refused_write(bench: Bench) -> None:
    before = bench.client.read(0x2010, 2)
    with pytest.raises(Aborted) as caught:
        bench.client.put(0x2010, 2, 1e9, "f")
    assert caught.value.code == AbortCode.VALUE_HIGH
    assert bench.client.read(0x2010, 2) == before


def block_announcing(client: RawClient, announced: int, data: bytes) -> None:
    client.send(struct.pack("<BHBI", 0xC2, TABLE, 0, announced))
    client.expect("initiate")
    for number in range(1, 16):
        start = 7 * (number - 1)
        mark = 0x80 if number == 15 else 0
        client.send(bytes((number | mark,)) + data[start : start + 7].ljust(7, b"\0"))
    assert client.expect("acknowledge")[1] == 15
    client.send(bytes((0xC1 | 5 << 2,)) + bytes(7))
    client.expect("end")


def segments_announcing(client: RawClient, announced: int, data: bytes) -> None:
    client.send(struct.pack("<BHBI", 0x21, TABLE, 0, announced))
    client.expect("initiate")
    for number in range(15):
        piece = data[7 * number : 7 * number + 7]
        command = (number & 1) << 4 | (7 - len(piece)) << 1 | (number == 14)
        client.send(bytes((command,)) + piece.ljust(7, b"\0"))
        client.expect("segment")


@pytest.mark.parametrize("difference", [-5, -1, 1, 5])
@pytest.mark.parametrize("block", [False, True])
def test_announced_size_is_enforced(bench: Bench, difference: int, block: bool) -> None:
    client, data = bench.client, content(100)
    stage(client)
    announced = len(data) + difference
    code = AbortCode.TOO_SHORT if difference > 0 else AbortCode.TOO_LONG
    with pytest.raises(Aborted) as caught:
        (block_announcing if block else segments_announcing)(client, announced, data)
    assert caught.value.code == code
    assert (caught.value.index, caught.value.sub) == (TABLE, 0)
    assert client.read(TABLE) == b""


def test_wrong_toggle_is_05030000_and_the_next_transfer_works(bench: Bench) -> None:
    client = bench.client
    client.send(HEAD.pack(0x40, 0x1008, 0) + bytes(4))
    client.expect("initiate")
    client.send(b"\x70" + bytes(7))
    with pytest.raises(Aborted) as caught:
        client.expect("segment")
    assert caught.value.code == AbortCode.TOGGLE
    assert client.read(0x1008) == b"test drive"


def test_wrong_crc_is_05040004_and_nothing_is_stored(bench: Bench) -> None:
    client, data = bench.client, content(14)
    stage(client)
    client.send(struct.pack("<BHBI", 0xC6, TABLE, 0, 14))
    client.expect("initiate")
    client.send(b"\x01" + data[:7])
    client.send(b"\x82" + data[7:])
    client.expect("acknowledge")
    client.send(b"\xc1\x11\x22" + bytes(5))
    with pytest.raises(Aborted) as caught:
        client.expect("end")
    assert caught.value.code == AbortCode.CRC
    assert client.read(TABLE) == b""


def test_an_abort_of_the_client_ends_a_block_upload_in_mid_stream(bench: Bench) -> None:
    client = bench.client
    stage(client)
    client.write_block(TABLE, 0, content(5000))
    client.send(HEAD.pack(0xA4, TABLE, 0) + bytes((127, 0, 0, 0)))
    client.expect("initiate")
    client.send(b"\xa3" + bytes(7))
    for _ in range(3):
        client.expect("segment")
    client.abort(TABLE, 0)
    client.drain()
    assert client.number(0x1018, 4) == SERIAL


# ---- time-outs -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "opening",
    [
        HEAD.pack(0x40, 0x1008, 0) + bytes(4),
        struct.pack("<BHBI", 0x21, 0x2051, 0, 100),
        HEAD.pack(0xA4, 0x2001, 0) + bytes((127, 0, 0, 0)),
        struct.pack("<BHBI", 0xC6, 0x2051, 0, 100),
    ],
)
def test_an_abandoned_transfer_times_out_on_the_node_clock(bench: Bench, opening: bytes) -> None:
    client = bench.client
    client.timeout_s = 3.0
    client.send(opening)
    client.expect("initiate")
    started = bench.bus.clock.now()
    with pytest.raises(Aborted) as caught:
        client.expect("time-out")
    assert caught.value.code == AbortCode.TIMED_OUT
    assert HEAD.pack(0, caught.value.index, caught.value.sub)[1:] == opening[1:4]
    assert bench.bus.clock.now() - started == pytest.approx(1.0, abs=0.01)
    assert client.read(0x1008) == b"test drive"


@pytest.mark.parametrize(
    "opening",
    [
        HEAD.pack(0x40, 0x1008, 0) + bytes(4),
        struct.pack("<BHBI", 0x21, 0x2051, 0, 100),
        HEAD.pack(0xA4, 0x2001, 0) + bytes((127, 0, 0, 0)),
    ],
)
def test_a_new_request_replaces_an_abandoned_one(bench: Bench, opening: bytes) -> None:
    bench.client.send(opening)
    bench.client.expect("initiate")
    assert bench.client.number(0x1018, 4) == SERIAL


# ---- states --------------------------------------------------------------------------------------


def test_silent_in_stopped_and_while_booting(bench: Bench) -> None:
    client = bench.client
    client.timeout_s = 0.02
    bench.nmt(2)
    assert client.ask(HEAD.pack(0x40, 0x1018, 4) + bytes(4)) is None
    bench.nmt(128)
    assert client.ask(HEAD.pack(0x40, 0x1018, 4) + bytes(4)) is not None
    bench.nmt(129)
    assert client.ask(HEAD.pack(0x40, 0x1018, 4) + bytes(4)) is None
    bench.wait(0.1)
    assert client.ask(HEAD.pack(0x40, 0x1018, 4) + bytes(4)) is not None


def test_a_reset_in_mid_transfer_leaves_no_trace(bench: Bench) -> None:
    client = bench.client
    stage(client)
    client.write_block(TABLE, 0, content(3000))
    client.send(HEAD.pack(0xA4, TABLE, 0) + bytes((127, 0, 0, 0)))
    client.expect("initiate")
    client.send(b"\xa3" + bytes(7))
    bench.nmt(129)
    client.drain()
    bench.wait(0.1)
    client.drain()
    assert client.heard(0x701)[-1] == b"\x00"
    assert client.number(0x1018, 4) == SERIAL


_FUZZED_IDS = [0x601, 0x000, 0x7E5, 0x080, 0x701, 0x201, 0x77F]


@pytest.mark.chain
@given(st.lists(st.tuples(st.sampled_from(_FUZZED_IDS), st.binary(max_size=8)), max_size=40))
@settings(max_examples=50, deadline=None)
def test_random_frames_never_break_the_node(frames: list[tuple[int, bytes]]) -> None:
    """After any frames at all, a reset node answers again."""
    bench = open_bench()
    for can_id, data in frames:
        bench.client.send(data, can_id)
    bench.client.drain()
    bench.nmt(129, 0)
    bench.wait(0.1)
    bench.client.drain()
    assert bench.client.number(0x1018, 4) == SERIAL
    bench.bus.shutdown()
