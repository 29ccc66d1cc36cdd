# SPDX-License-Identifier: MIT
"""Time on the wire: what jobs take on a paced simulated bus, as a multiple of the least their frames need.

Run from the repository: ``python benchmarks/time_on_wire.py``. The time of a job is the virtual time that passed on the
bus (frame by frame, bit by bit, turn-around of the drive zero) plus the CPU time of this process, tool and drive
together. The least is the same frames back to back, counted here from the protocol (CiA 301), not from the run:
nothing else on the wire, nobody thinking. Random data, best of three runs.
"""

from __future__ import annotations

import random
import struct
import sys
import time
from binascii import crc_hqx
from collections.abc import Callable, Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))

from benchmarks.transfers import TABLE, Rig, rig
from pmsmtool.bus.frame_time import frame_bits
from pmsmtool.bus.sdo import Mode

RUNS = 3
WRITES = 300
REQUEST, ANSWER = 0x601, 0x581
HEAD = struct.Struct("<BHB")
OBJECT = (0x2050, 3)
"""A REAL32 that only waits to be used: writing it costs the drive nothing."""
Frames = Iterator[tuple[int, bytes]]


def written_frames(values: list[bytes]) -> Frames:
    """Yield the frames of expedited writes, each read back."""
    for value in values:
        yield REQUEST, HEAD.pack(0x23, *OBJECT) + value
        yield ANSWER, HEAD.pack(0x60, *OBJECT) + bytes(4)
        yield REQUEST, HEAD.pack(0x40, *OBJECT) + bytes(4)
        yield ANSWER, HEAD.pack(0x43, *OBJECT) + value


def block_frames(data: bytes, sender: int, receiver: int) -> Frames:
    """Yield the segments of a block transfer with their acknowledgements, in sub-blocks of 127."""
    segments = [data[start : start + 7].ljust(7, b"\0") for start in range(0, len(data), 7)]
    for start in range(0, len(segments), 127):
        part = segments[start : start + 127]
        for number, segment in enumerate(part, 1):
            last = 0x80 if start + number == len(segments) else 0
            yield sender, bytes((number | last,)) + segment
        yield receiver, bytes((0xA2, len(part), 127, 0, 0, 0, 0, 0))
    yield sender, bytes((0xC1 | -len(data) % 7 << 2,)) + crc_hqx(data, 0).to_bytes(2, "little") + bytes(5)
    yield receiver, b"\xa1" + bytes(7)


def upload_frames(data: bytes) -> Frames:
    """Yield the frames of a block upload."""
    yield REQUEST, HEAD.pack(0xA4, *TABLE) + bytes((127, 4, 0, 0))
    yield ANSWER, HEAD.pack(0xC6, *TABLE) + len(data).to_bytes(4, "little")
    yield REQUEST, b"\xa3" + bytes(7)
    yield from block_frames(data, ANSWER, REQUEST)


def download_frames(data: bytes) -> Frames:
    """Yield the frames of a block download."""
    yield REQUEST, HEAD.pack(0xC6, *TABLE) + len(data).to_bytes(4, "little")
    yield ANSWER, HEAD.pack(0xA4, *TABLE) + bytes((127, 0, 0, 0))
    yield from block_frames(data, REQUEST, ANSWER)


def least_s(frames: Frames, bitrate: int) -> float:
    """Return the time frames need back to back (s)."""
    return sum(frame_bits(can_id, data) for can_id, data in frames) / bitrate


def taken_s(bench: Rig, job: Callable[[], None]) -> tuple[float, float]:
    """Return virtual time and CPU time of a job (s)."""
    clock = bench.connection.clock
    cpu, virtual = time.process_time(), clock.now()
    job()
    return clock.now() - virtual, time.process_time() - cpu


def jobs(bench: Rig) -> Iterator[tuple[str, Callable[[], None], Callable[[], Frames]]]:
    """Yield the jobs: name, what the tool does, the frames that it needs."""
    generator = random.Random(1)
    values = [struct.pack("<f", generator.uniform(-1.0, 1.0)) for _ in range(WRITES)]
    table, trace = generator.randbytes(16384), generator.randbytes(65536)

    def write() -> None:
        for value in values:
            bench.channel.download(*OBJECT, value)
            if bench.channel.read(*OBJECT) != value:
                raise RuntimeError("read back another value")

    def download() -> None:
        bench.channel.download(*TABLE, table, mode=Mode.BLOCK)

    def upload() -> None:
        bench.memory[:] = trace
        if bench.channel.upload(*TABLE, size=len(trace), mode=Mode.BLOCK).data != trace:
            raise RuntimeError("read other data")

    yield f"{WRITES} writes, each read back", write, lambda: written_frames(values)
    yield "16 KiB block download", download, lambda: download_frames(table)
    yield "64 KiB block upload", upload, lambda: upload_frames(trace)


def main() -> None:
    """Print one row per job and bit rate."""
    print("| job | kbit/s | least | virtual | CPU | ratio |\n|---|---|---|---|---|---|")
    for bitrate in (1_000_000, 500_000):
        with rig(bitrate=bitrate) as bench:
            for name, job, frames in jobs(bench):
                least = least_s(frames(), bitrate)
                virtual, cpu = min((taken_s(bench, job) for _ in range(RUNS)), key=sum)
                cells = (f"{1e3 * seconds:.1f} ms" for seconds in (least, virtual, cpu))
                print(f"| {name} | {bitrate // 1000} | {' | '.join(cells)} | {(virtual + cpu) / least:.2f} |")


if __name__ == "__main__":
    main()
