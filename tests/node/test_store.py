# SPDX-License-Identifier: MIT
"""Storing, restoring and losing parameters: groups, time, power cuts at every write step."""

from __future__ import annotations

import struct
import zlib

import pytest

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.errors import ConfigError
from pmsmtool.params.catalogue import CATALOGUE
from pmsmtool.sim.node import memory as storing
from pmsmtool.sim.node.memory import Memory, RamStorage
from tests.node.bench import Bench, steps_of
from tests.node.conftest import BenchMaker
from tests.node.raw_client import HEAD, Aborted, Lost

SAVE, LOAD = 0x65766173, 0x64616F6C


def save(bench: Bench, sub: int = 1) -> float:
    """Store and return the time until the confirmation (s)."""
    bench.client.timeout_s = 2.0
    started = bench.bus.clock.now()
    bench.client.put(0x1010, sub, SAVE)
    return bench.bus.clock.now() - started


def restart(bench: Bench) -> None:
    bench.nmt(129)
    bench.wait(0.1)
    bench.client.drain()


def values(bench: Bench) -> tuple[float, float, float]:
    """Return one value each of parameter set, communication and application."""
    client = bench.client
    return client.number(0x2010, 2, "f"), client.number(0x1017, 0, "H"), client.number(0x6007, 0, "h")


def change(bench: Bench) -> None:
    bench.client.put(0x2010, 2, 0.25, "f")
    bench.client.put(0x1017, 0, 250, "H")
    bench.client.put(0x6007, 0, 1, "h")


DEFAULT = pytest.approx((0.137, 200, 3))
CHANGED = (0.25, 250, 1)


def test_unsaved_values_are_lost_with_a_reset_and_saved_ones_stay(bench: Bench) -> None:
    change(bench)
    restart(bench)
    assert values(bench) == DEFAULT
    change(bench)
    save(bench)
    restart(bench)
    assert values(bench) == CHANGED
    assert bench.client.number(0x2000, 4) == bench.client.number(0x2000, 3) != 0


@pytest.mark.parametrize(("sub", "kept"), [(2, (0.137, 250, 3)), (3, (0.137, 200, 1)), (4, (0.25, 200, 3))])
def test_groups_are_stored_apart(bench: Bench, sub: int, kept: tuple[float, float, float]) -> None:
    change(bench)
    save(bench, sub)
    restart(bench)
    assert values(bench) == pytest.approx(kept)


@pytest.mark.parametrize(
    ("sub", "kept"), [(1, (0.137, 200, 3)), (2, (0.25, 200, 1)), (3, (0.25, 250, 3)), (4, (0.137, 250, 1))]
)
def test_groups_are_restored_apart_after_the_next_reset(
    bench: Bench, sub: int, kept: tuple[float, float, float]
) -> None:
    change(bench)
    save(bench)
    bench.client.put(0x1011, sub, LOAD)
    assert values(bench) == CHANGED
    restart(bench)
    assert values(bench) == pytest.approx(kept)


def test_a_store_takes_longer_than_a_usual_time_out_and_the_node_is_silent_meanwhile(bench: Bench) -> None:
    client = bench.client
    client.timeout_s = 0.25
    with pytest.raises(Lost):
        client.put(0x1010, 1, SAVE)
    assert client.ask(HEAD.pack(0x40, 0x1018, 4) + bytes(4)) == HEAD.pack(0x60, 0x1010, 1) + bytes(4)
    assert save(bench) > storing.ERASE_S


def test_the_parameter_set_survives_with_its_tables_and_design_id(bench: Bench) -> None:
    client = bench.client
    client.put(0x2000, 6, 1, "B")
    for sub, number in ((1, 1), (3, 2), (4, 2), (5, 1)):
        client.put(0x2041, sub, number, "B")
    parts = {0x2044: (0, 1), 0x2045: (0, 1), 0x2046: (1,), 0x2042: (0, 1, 2, 3), 0x2043: (3, 2, 1, 0)}
    for index, numbers in parts.items():
        client.write(index, 0, struct.pack(f"<{len(numbers)}f", *numbers), segmented=True)
    assert bench.node.session is not None
    client.put(0x2000, 5, zlib.crc32(bench.client.read_block(0x2001)))
    client.put(0x2000, 6, 2, "B")
    client.put(0x2000, 6, 3, "B")
    client.write(0x2000, 9, b"designid", segmented=True)
    image = client.read_block(0x2001)
    save(bench)
    restart(bench)
    assert client.read_block(0x2001) == image == bench.core.image
    assert client.read(0x2000, 9) == b"designid"


def test_nothing_is_stored_while_the_drive_is_enabled(bench: Bench) -> None:
    for word in (6, 7, 15):
        bench.client.put(0x6040, 0, word, "H")
    for index, signature in ((0x1010, SAVE), (0x1011, LOAD)):
        with pytest.raises(Aborted) as caught:
            bench.client.put(index, 1, signature)
        assert caught.value.code == AbortCode.DEVICE_STATE


def full_image(bench: Bench, axis: int, sign: float) -> bytes:
    """Return the factory image with square tables of ``axis`` nodes each way, values of one sign."""
    words = bytearray(bench.client.read_block(0x2001))
    names = [row.name for row in CATALOGUE]
    for name, number in (("lut.format", 1), ("lut.n_x", axis), ("lut.n_y", axis), ("lut.n_z", 1)):
        struct.pack_into("<I", words, 4 * names.index(name), number)
    nodes = struct.pack(f"<{axis}f", *range(axis))
    table = struct.pack(f"<{axis * axis}f", *(sign * number for number in range(axis * axis)))
    return bytes(words) + nodes + nodes + bytes(4) + table + table


def activate(bench: Bench, image: bytes) -> None:
    client = bench.client
    client.put(0x2000, 6, 1, "B")
    client.write_block(0x2001, 0, image)
    client.put(0x2000, 5, zlib.crc32(image))
    client.put(0x2000, 6, 2, "B")
    client.put(0x2000, 6, 3, "B")


@pytest.mark.chain
def test_a_power_cut_at_every_write_step_leaves_the_old_or_the_new_set(make_bench: BenchMaker) -> None:
    """A set of 14 KiB with tables, compared byte by byte; only the last step brings the new one."""
    first = make_bench()
    old, new = full_image(first, 40, 1.0), full_image(first, 40, -1.0)
    activate(first, old)
    save(first)
    content = Memory(first.storage).load()
    assert content is not None
    steps = steps_of(content)
    outcomes = []
    for step in range(1, steps + 1):
        storage = RamStorage()
        for _ in Memory(storage).store(content):
            pass
        faults = f'[[drive]]\naction="power-cut"\nat_store_step={step}\nback_after_s=0.2'
        bench = make_bench(storage=storage, faults=faults, timeout_s=1.0)
        activate(bench, new)
        with pytest.raises(Lost):
            bench.client.put(0x1010, 1, SAVE)
        bench.wait(0.5)
        held = bench.client.read_block(0x2001)
        outcomes.append("old" if held == old else "new" if held == new else "mixed")
        assert bench.client.number(0x2000, 3) == bench.client.number(0x2000, 4) == zlib.crc32(held)
        assert b"\0" in bench.client.heard(0x701)
    assert steps > 15
    assert outcomes == ["old"] * (steps - 1) + ["new"]


def test_a_cut_drive_is_silent_and_boots_when_power_returns(make_bench: BenchMaker) -> None:
    bench = make_bench(faults='[[drive]]\naction="power-cut"\nat_s=0.5\nback_after_s=1.0')
    frames = [(round(message.timestamp, 2), bytes(message.data)) for message in bench.listen(2.0)]
    assert frames[:3] == [(0.2, b"\x7f"), (0.4, b"\x7f"), (1.53, b"\x00")]


def test_a_set_of_another_layout_is_not_taken_and_that_is_said(make_bench: BenchMaker) -> None:
    first = make_bench()
    change(first)
    save(first)
    content = Memory(first.storage).load()
    assert content is not None
    stored = storing.decode(content)
    stored[storing.SIGNATURE_KEY] = b"\1\2\3\4"
    storage = RamStorage()
    for _ in Memory(storage).store(storing.encode(stored)):
        pass
    bench = make_bench(storage=storage)
    restart(bench)
    assert values(bench) == pytest.approx((0.137, 250, 1))
    assert bench.client.heard(0x081)[-1][:2] == b"\x10\x63"


def test_damaged_memory_is_reported_and_the_factory_set_is_active(make_bench: BenchMaker) -> None:
    storage = RamStorage()
    storage.write(0, b"\x01" * 64, durable=True)
    bench = make_bench(storage=storage)
    assert bench.frames(0x081, 0.1)[0][:2] == b"\x30\x55"
    bench.nmt(129)
    assert bench.frames(0x081, 0.1)[0][:2] == b"\x30\x55"
    assert values(bench) == DEFAULT


class BrokenStorage(RamStorage):
    """Can be read, but not written any more after a number of writes."""

    writes_left = 0

    def write(self, offset: int, data: bytes, *, durable: bool) -> None:
        if self.writes_left == 0:
            raise ConfigError("the drive's memory cannot be used: Read-only file system")
        self.writes_left -= 1
        super().write(offset, data, durable=durable)


@pytest.mark.parametrize("writes", [0, 1])
@pytest.mark.parametrize(("index", "signature"), [(0x1010, SAVE), (0x1011, LOAD)])
def test_a_memory_that_cannot_be_written_refuses_the_store(
    make_bench: BenchMaker, index: int, signature: int, writes: int
) -> None:
    storage = BrokenStorage()
    storage.writes_left = writes
    bench = make_bench(storage=storage, timeout_s=2.0)
    with pytest.raises(Aborted) as caught:
        bench.client.put(index, 1, signature)
    assert (caught.value.code, caught.value.index) == (AbortCode.HARDWARE, index)
    assert bench.client.number(0x1003, 1) == 0x5530
    assert bench.client.number(0x2000, 4) == 0, "nothing counts as stored"
    storage.writes_left = 1000
    save(bench)
    assert bench.client.number(0x2000, 4) == bench.client.number(0x2000, 3)


def test_stored_values_encode_and_decode() -> None:
    stored = {0x1017 << 8: b"\x01\x02", storing.IMAGE_KEY: bytes(1000), storing.NODE_ID_KEY: b"\x05"}
    assert storing.decode(storing.encode(stored)) == stored
