# SPDX-License-Identifier: MIT
"""LSS slave with a scripted master and with the stock one of canopen."""

from __future__ import annotations

import struct

import pytest

from pmsmtool.sim.node.memory import RamStorage
from pmsmtool.sim.node.node import PRODUCT, REVISION, VENDOR
from tests.node.bench import SERIAL, Bench
from tests.node.conftest import BenchMaker

REQUEST, ANSWER = 0x7E5, 0x7E4
STOCK_TIMEOUT_S = 0.5
"""Time the LSS master of canopen waits for an answer."""


def lss(bench: Bench, *values: int, number: int | None = None) -> list[bytes]:
    data = bytes(values) if number is None else bytes(values) + struct.pack("<I", number)
    bench.client.send(data.ljust(8, b"\0"), REQUEST)
    return bench.frames(ANSWER, 0.01)


def select(bench: Bench, serial: int = SERIAL) -> list[bytes]:
    answers = []
    for command, number in zip((0x40, 0x41, 0x42, 0x43), (VENDOR, PRODUCT, REVISION, serial), strict=True):
        answers += lss(bench, command, number=number)
    return answers


def test_only_the_addressed_drive_is_selected(make_bench: BenchMaker) -> None:
    bench = make_bench(nodes=3)
    assert select(bench, 0xDEAD) == []
    assert lss(bench, 0x5E) == []
    assert select(bench, SERIAL + 1) == [b"\x44" + bytes(7)]
    assert lss(bench, 0x5E) == [b"\x5e\x02" + bytes(6)]
    assert lss(bench, 0x5D) == [b"\x5d" + struct.pack("<I", SERIAL + 1) + bytes(3)]


def test_a_new_node_id_holds_after_reset_and_when_stored_after_power_cut(make_bench: BenchMaker) -> None:
    storage = RamStorage()
    bench = make_bench(storage=storage)
    lss(bench, 0x04, 1)
    assert lss(bench, 0x11, 0) == [b"\x11\x01" + bytes(6)]
    assert lss(bench, 0x11, 42) == [b"\x11\x00" + bytes(6)]
    assert lss(bench, 0x17) == []
    assert bench.frames(ANSWER, STOCK_TIMEOUT_S) == [b"\x17\x00" + bytes(6)], "when it is stored, not before"
    bench.nmt(130)
    assert bench.frames(0x700 + 42, 0.1) == [b"\x00"]
    bench.client.node = 42
    assert bench.client.number(0x1200, 1) == 0x600 + 42
    again = make_bench(storage=storage)
    assert again.frames(0x700 + 42, 0.25) == [b"\x7f"]


def test_an_unconfigured_drive_is_silent_until_it_gets_an_id(make_bench: BenchMaker) -> None:
    bench = make_bench(node_id=255)
    assert bench.listen(1.0) == []
    assert lss(bench, 0x4C) == [b"\x50" + bytes(7)]
    lss(bench, 0x04, 1)
    lss(bench, 0x11, 7)
    bench.client.send(b"\x04\x00".ljust(8, b"\0"), REQUEST)
    assert bench.frames(0x707, 0.25) == [b"\x00", b"\x7f"]
    bench.client.node = 7
    assert bench.client.number(0x1018, 4) == SERIAL


@pytest.mark.parametrize(
    ("low", "high", "found"), [(0, 0xFFFFFFFF, True), (SERIAL, SERIAL, True), (0, SERIAL - 1, False)]
)
def test_identify_remote_slave_by_ranges(bench: Bench, low: int, high: int, found: bool) -> None:
    answers = []
    for command, number in zip(range(0x46, 0x4C), (VENDOR, PRODUCT, 0, 0xFFFFFFFF, low, high), strict=True):
        answers += lss(bench, command, number=number)
    assert bool(answers) is found


def fastscan(bench: Bench, number: int, bit: int, part: int, following: int) -> bool:
    bench.client.send(struct.pack("<BIBBB", 0x51, number, bit, part, following), REQUEST)
    return bool(bench.frames(ANSWER, 0.005))


def test_fastscan_finds_the_identity_of_an_unconfigured_drive(make_bench: BenchMaker) -> None:
    bench = make_bench(node_id=255)
    assert fastscan(bench, 0, 0x80, 0, 0)
    found = [0, 0, 0, 0]
    for part in range(4):
        for bit in range(31, -1, -1):
            if not fastscan(bench, found[part], bit, part, part):
                found[part] |= 1 << bit
        assert fastscan(bench, found[part], 0, part, (part + 1) & 3)
    assert found == [VENDOR, PRODUCT, REVISION, SERIAL]
    assert lss(bench, 0x5E) == [b"\x5e\xff" + bytes(6)]


def test_bit_timing_is_that_of_the_line_only(make_bench: BenchMaker) -> None:
    bench = make_bench(bitrate=500_000)
    lss(bench, 0x04, 1)
    assert lss(bench, 0x13, 0, 2) == [b"\x13\x00" + bytes(6)]
    assert lss(bench, 0x13, 0, 0) == [b"\x13\x01" + bytes(6)]
    assert lss(bench, 0x13, 1, 2) == [b"\x13\x01" + bytes(6)]


def test_only_the_waiting_state_or_a_reset_ends_the_configuration_state(make_bench: BenchMaker) -> None:
    bench = make_bench()
    lss(bench, 0x04, 1)
    assert lss(bench, 0x04, 2) == [] and lss(bench, 0x5E), "a state that CiA 305 does not know changes nothing"
    lss(bench, 0x04, 0)
    assert lss(bench, 0x5E) == []
    lss(bench, 0x04, 1)
    bench.nmt(130)
    assert bench.frames(0x701, 0.1) == [b"\x00"]
    assert lss(bench, 0x5E) == [], "waiting again"
