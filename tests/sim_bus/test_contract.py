"""One contract for every way to reach a simulated drive, met with the tool's own connection and SDO channel."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

import pytest

from pmsmtool.bus.connect import Connection, connect
from pmsmtool.bus.sdo import Mode, SdoChannel
from pmsmtool.errors import SdoAbort
from pmsmtool.firmware.image import crc32
from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.sim.channel import build_line, parse_channel
from tests.node.simple_core import SimpleCore
from tests.sim_bus.test_serve import served

TABLE = 0x2042
SIZES = (1, 2, 4, 5, 7, 8, 14, 881, 888, 889, 890, 896, 1778, 4000)


class Contract:
    """What holds on every bus; subclasses provide ``connection``."""

    @pytest.fixture
    def connection(self) -> Iterator[Connection]:
        raise NotImplementedError

    @pytest.fixture
    def channel(self, connection: Connection) -> SdoChannel:
        return SdoChannel(connection, 1)

    def number(self, channel: SdoChannel, index: int, sub: int = 0) -> int:
        return int.from_bytes(channel.read(index, sub), "little")

    def test_identity(self, channel: SdoChannel) -> None:
        assert self.number(channel, 0x1000) == 0x00020192
        assert self.number(channel, 0x1018, 1) == 0x706D736D

    def test_sizes_travel_both_ways_in_every_mode(self, channel: SdoChannel) -> None:
        channel.download(0x2000, 6, b"\1")
        for size in SIZES:
            data = random.Random(size).randbytes(size)
            for mode in (Mode.SEGMENTED, Mode.BLOCK):
                channel.download(TABLE, 0, data, mode=mode)
                assert channel.upload(TABLE, 0, mode=mode).data == data
        channel.download(0x2000, 6, b"\4")

    def test_refusals_are_reported_with_their_code(self, channel: SdoChannel) -> None:
        with pytest.raises(SdoAbort) as caught:
            channel.download(0x2010, 2, b"\0\0\0\x7f")
        assert caught.value.code == 0x06090031
        with pytest.raises(SdoAbort) as caught:
            channel.read(0x4711, 0)
        assert caught.value.code == 0x06020000

    def test_the_image_has_the_crc_the_drive_reports(self, channel: SdoChannel) -> None:
        assert crc32(channel.upload(0x2001, 0, mode=Mode.BLOCK).data) == self.number(channel, 0x2000, 3)

    def test_states_by_controlword(self, channel: SdoChannel) -> None:
        for word, pattern in ((0x06, 0x21), (0x07, 0x23), (0x0F, 0x27), (0x00, 0x40)):
            channel.download(0x6040, 0, word.to_bytes(2, "little"))
            assert self.number(channel, 0x6041) & 0x6F == pattern

    def test_heartbeat_and_reset(self, connection: Connection) -> None:
        seen: list[bytes] = []
        connection.subscribe(0x701, lambda cob_id, data, stamp: seen.append(data))
        assert connection.wait_until(lambda: bool(seen), 1.0)
        connection.send(0, b"\x81\x01")
        assert connection.wait_until(lambda: b"\0" in seen, 1.0)

    def test_saved_values_survive_a_reset(self, connection: Connection, channel: SdoChannel) -> None:
        channel.slow_objects[0x1010, 1] = 3.0
        channel.download(0x1017, 0, (150).to_bytes(2, "little"))
        channel.download(0x1010, 1, b"save")
        booted: list[bytes] = []
        connection.subscribe(0x701, lambda cob_id, data, stamp: booted.append(data))
        connection.send(0, b"\x81\x01")
        assert connection.wait_until(lambda: b"\0" in booted, 1.0)
        assert self.number(channel, 0x1017) == 150


class TestInProcess(Contract):
    @pytest.fixture
    def connection(self) -> Iterator[Connection]:
        text = "interior-2k2?nv=:memory:"
        line = build_line(parse_channel(text), make_core=lambda machine_file, seed: SimpleCore())
        with Connection(PmsmSimBus(text, line=line)) as connection:
            yield connection


class TestWithKernel(Contract):
    @pytest.fixture
    def connection(self) -> Iterator[Connection]:
        with Connection(PmsmSimBus("interior-2k2?nv=:memory:")) as connection:
            yield connection


class TestPaced(Contract):
    @pytest.fixture
    def connection(self) -> Iterator[Connection]:
        text = "interior-2k2?nv=:memory:&bitrate=500000"
        line = build_line(parse_channel(text), make_core=lambda machine_file, seed: SimpleCore())
        with Connection(PmsmSimBus(text, line=line)) as connection:
            yield connection


class TestServed(Contract):
    @pytest.fixture
    def connection(self) -> Iterator[Connection]:
        with served() as port, connect("socketcand", "vcan0", port=port, ignore_config=True) as connection:
            yield connection


def lossy(tmp_path: Path, probability: float) -> Connection:
    faults = tmp_path / "faults.toml"
    faults.write_text(f'[[frame]]\naction = "drop"\nprobability = {probability}\n', encoding="utf-8")
    text = f"interior-2k2?nv=:memory:&faults={faults}&seed=11"
    line = build_line(parse_channel(text), make_core=lambda machine_file, seed: SimpleCore())
    return Connection(PmsmSimBus(text, line=line))


@pytest.mark.parametrize(("probability", "needed"), [(0.001, 0.99), (0.01, 0.97)])
def test_the_tools_channel_under_loss_is_right_or_reports(tmp_path: Path, probability: float, needed: float) -> None:
    """300 transfers, sizes 1 B to 16 KiB, both ways. Measured: 300 of 300 at 0.1 % and at 1 %."""
    generator = random.Random(3)
    with lossy(tmp_path, probability) as connection:
        channel = SdoChannel(connection, 1)
        channel.download(0x2000, 6, b"\1")
        right = 0
        for number in range(150):
            size = generator.choice((1, 4, 7, 100, 889, 1778, 5000, 16384 if number % 10 == 0 else 2000))
            data = generator.randbytes(size)
            try:
                channel.download(TABLE, 0, data)
                right += 1
                assert channel.upload(TABLE, 0, size=size).data == data
                right += 1
            except (SdoAbort, TimeoutError):
                continue
    assert right >= needed * 300
