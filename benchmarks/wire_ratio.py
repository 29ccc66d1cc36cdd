# SPDX-License-Identifier: MIT
"""Time of transfers over the wire's minimum: (virtual wire time + measured CPU time) / wire minimum.

Run from the repository: ``python benchmarks/wire_ratio.py``. The simulated bus counts every frame bit by bit, so its
time is the wire's; the CPU time is that of the whole process, tool and simulated drive, best of several runs. The
minimum is the length of the frames the transfer needs, back to back: 300 expedited writes and 300 reads, or one block
transfer with sub-blocks of 127.
"""

from __future__ import annotations

import random
import sys
import time
from binascii import crc_hqx
from collections.abc import Callable, Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))

from pmsmtool.bus.connect import Connection
from pmsmtool.bus.frame_time import frame_bits
from pmsmtool.bus.sdo import Mode, SdoChannel
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.sim.bus import PmsmSimBus

WRITES = 300
TABLE = bytes(random.Random(1).randbytes(16384))
TRACE_BYTES = 65536
REPEATS = 5
REQUEST, ANSWER = 0x601, 0x581
OBJECTS = [(0x2050, sub) for sub in (3, 4, 5, 6, 7, 8)]
TARGETS = {1_000_000: (1.6, 1.15, 1.15), 500_000: (1.35, 1.15, 1.15)}


def writes_minimum() -> int:
    """Bits of the writes and of their read-backs."""
    return sum(
        frame_bits(REQUEST, b"\x23" + head + data) + frame_bits(ANSWER, b"\x60" + head + bytes(4))
        + frame_bits(REQUEST, b"\x40" + head + bytes(4)) + frame_bits(ANSWER, b"\x43" + head + data)
        for head, data in _written()
    )  # fmt: skip


def _written() -> Iterator[tuple[bytes, bytes]]:
    rng = random.Random(2)
    for number in range(WRITES):
        index, sub = OBJECTS[number % len(OBJECTS)]
        yield bytes((index & 0xFF, index >> 8, sub)), rng.randbytes(3) + b"\x3f"


def block_minimum(data: bytes, head: bytes, *, upload: bool) -> int:
    """Bits of one block transfer."""
    segments = [data[k : k + 7] for k in range(0, len(data), 7)]
    bits = 0
    for number, piece in enumerate(segments):
        last = number + 1 == len(segments)
        frame = bytes((number % 127 + 1 | (0x80 if last else 0),)) + piece.ljust(7, b"\0")
        bits += frame_bits(ANSWER if upload else REQUEST, frame)
        if last or number % 127 == 126:
            bits += frame_bits(REQUEST if upload else ANSWER, bytes((0xA2, number % 127 + 1, 127, 0, 0, 0, 0, 0)))
    end = bytes((0xC1 | -len(data) % 7 << 2,)) + crc_hqx(data, 0).to_bytes(2, "little") + bytes(5)
    size = len(data).to_bytes(4, "little")
    if upload:
        others = [(REQUEST, b"\xa4" + head + bytes((127, 4, 0, 0))), (ANSWER, b"\xc6" + head + size)]
        others += [(REQUEST, b"\xa3" + bytes(7)), (ANSWER, end), (REQUEST, b"\xa1" + bytes(7))]
    else:
        others = [(REQUEST, b"\xc6" + head + size), (ANSWER, b"\xa4" + head + bytes((127, 0, 0, 0)))]
        others += [(REQUEST, end), (ANSWER, b"\xa1" + bytes(7))]
    return bits + sum(frame_bits(can_id, frame) for can_id, frame in others)


def spent(connection: Connection, run: Callable[[], object]) -> tuple[float, float]:
    """Return wire time and the fastest CPU time (s)."""
    wire, cpu = 0.0, float("inf")
    for _ in range(REPEATS):
        clock, before = connection.clock.now(), time.process_time()
        run()
        cpu = min(cpu, time.process_time() - before)
        wire = connection.clock.now() - clock
    return wire, cpu


def verified_writes(channel: SdoChannel) -> None:
    """Write and read back."""
    for number, (_, data) in enumerate(_written()):
        index, sub = OBJECTS[number % len(OBJECTS)]
        channel.download(index, sub, data)
        if channel.read(index, sub, size=4) != data:
            raise SystemExit("a write was not held")


def fill_trace(channel: SdoChannel) -> None:
    """Record 64 KiB."""
    for number in range(8):
        channel.download(0x2061, number + 1, (0x20700120 + (number << 8)).to_bytes(4, "little"))
    channel.download(0x2060, 2, (2048).to_bytes(4, "little"))
    channel.download(0x2060, 7, b"\1")
    channel.connection.wait(1.0)


def measure(bitrate: int) -> None:
    """Print the three ratios of one bit rate."""
    with Connection(PmsmSimBus(f"interior-2k2?nv=:memory:&bitrate={bitrate}")) as connection:
        node = DriveNode(connection, 1)
        node.identity()
        # Nothing but the transfer shall be on the wire.
        node.sdo.download(0x1017, 0, b"\0\0")
        node.supervision.heartbeat_period_s = None
        channel = node.sdo
        rows = [("300 verified writes", writes_minimum(), *spent(connection, lambda: verified_writes(channel)))]
        channel.download(0x2000, 6, b"\1")
        minimum = block_minimum(TABLE, b"\x42\x20\x00", upload=False)
        rows.append(("16 KiB block download", minimum, *spent(connection, lambda: channel.download(0x2042, 0, TABLE))))
        fill_trace(channel)
        data = channel.upload(0x2062, 0, size=TRACE_BYTES, mode=Mode.BLOCK).data
        minimum = block_minimum(data, b"\x62\x20\x00", upload=True)
        run = lambda: channel.upload(0x2062, 0, size=TRACE_BYTES)  # noqa: E731
        rows.append(("64 KiB block upload", minimum, *spent(connection, run)))
    for (name, bits, wire, cpu), target in zip(rows, TARGETS[bitrate], strict=True):
        least = bits / bitrate
        print(
            f"{bitrate:>8} bit/s  {name:<22} minimum {1e3 * least:7.1f} ms  wire {1e3 * wire:7.1f} ms  "
            f"CPU {1e3 * cpu:6.1f} ms  ratio {(wire + cpu) / least:.3f}  target {target}"
        )


if __name__ == "__main__":
    for rate in TARGETS:
        measure(rate)
