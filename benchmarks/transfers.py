# SPDX-License-Identifier: MIT
"""SDO transfers between the tool's channel and the simulated drive: every size that is special, and lost frames.

Run from the repository: ``python benchmarks/transfers.py`` (a quarter of an hour; ``--quick``: a minute). Two tables:

*Sizes*, no loss: every size from 1 B to three sub-blocks and more (2700 B), then up to 64 KiB every multiple of 889 B
(127 segments of 7) with the 8 sizes on either side and every 97th multiple of 7 with its neighbours, by segments and by
block, to the drive and from it. With ``--every-seven`` also every other multiple of 7, by block (an hour).

*Loss*: frames of the channel dropped at random both ways, 300 transfers for each rate, mode and direction, sizes
log-uniform from 1 B to 64 KiB next to multiples of 7 and of 889, 64 KiB itself among them. *Right* are transfers whose
bytes arrived, *reported* those that ended in an error of the tool, *wrong* those that are neither: there must be none.

The object behind is a plain memory in place of the drive's look-up table, because none of its objects takes 64 KiB.
"""

from __future__ import annotations

import argparse
import math
import random
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))

from pmsmtool.bus.connect import Connection
from pmsmtool.bus.sdo import Mode, SdoChannel
from pmsmtool.errors import PmsmtoolError
from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.sim.channel import Channel, build_line

LARGEST = 65536
SUB_BLOCK = 889
EXHAUSTIVE = 2700
"""Three sub-blocks and a bit: every remainder by 7 and by 889, with one, two, three and four sub-blocks."""
SEVENTH = 97
"""Beyond that every so many-th multiple of 7; no divisor in common with the 127 segments of a sub-block."""
ROUNDS = 300
RATES = (0.001, 0.01)
NEEDED = 0.99
"""Share that must come through at the lower rate, where the tool chooses how to travel."""
TABLE = (0x2042, 0)
FAULTS = '[[frame]]\naction = "drop"\nids = ["0x581", "0x601"]\nprobability = {}\n'
DIRECTIONS = ("to drive", "from drive")


@dataclass
class Outcome:
    """Counts of one row of a table."""

    transfers: int = 0
    right: int = 0
    reported: int = 0
    wrong: int = 0
    tries: int = 0
    repeated: int = 0

    @property
    def share(self) -> float:
        """Share of the transfers that came through."""
        return self.right / max(1, self.transfers)


@dataclass
class Rig:
    """A drive whose table is a plain memory, and the tool's channel to it."""

    connection: Connection
    channel: SdoChannel
    memory: bytearray


@contextmanager
def rig(loss: float = 0.0, seed: int = 1, bitrate: int | None = None) -> Iterator[Rig]:
    """Yield a drive whose channel loses frames, on a bus paced by a bit rate when one is given."""
    channel = Channel(nv=":memory:", seed=seed, bitrate=bitrate)
    with tempfile.TemporaryDirectory() as folder:
        faults = Path(folder) / "faults.toml"
        faults.write_text(FAULTS.format(loss), encoding="utf-8")
        line = build_line(replace(channel, faults=faults) if loss else channel)
    memory = bytearray()
    session = line.nodes[0].session
    if session is None:
        raise RuntimeError("the drive is not running")
    entry = session.dictionary["lut.table_i_d"]

    def take(data: bytes) -> None:
        memory[:] = data

    entry.sink, entry.source = take, lambda: bytes(memory)
    with Connection(PmsmSimBus("transfers", line=line)) as connection:
        yield Rig(connection, SdoChannel(connection, 1), memory)


def transfer(bench: Rig, mode: Mode, direction: str, data: bytes, outcome: Outcome) -> None:
    """Carry out one transfer and judge it."""
    outcome.transfers += 1
    try:
        if direction == "to drive":
            bench.memory.clear()
            done = bench.channel.download(*TABLE, data, mode=mode)
            arrived = bytes(bench.memory)
        else:
            bench.memory[:] = data
            done = bench.channel.upload(*TABLE, size=len(data), mode=mode)
            arrived = done.data
    except PmsmtoolError:
        outcome.reported += 1
        return
    outcome.tries += done.tries
    outcome.repeated += done.retransmitted
    if arrived == data:
        outcome.right += 1
    else:
        outcome.wrong += 1


def special_sizes() -> list[int]:
    """Return the sizes of the first table."""
    near = {SUB_BLOCK * k + d for k in range(1, LARGEST // SUB_BLOCK + 1) for d in range(-8, 9)}
    sevens = {7 * k + d for k in range(SEVENTH, LARGEST // 7 + 1, SEVENTH) for d in (-1, 0, 1)}
    last = set(range(LARGEST - 8, LARGEST + 1))
    return sorted(set(range(1, EXHAUSTIVE + 1)) | {size for size in near | sevens | last if size <= LARGEST})


def size_table(sizes: Sequence[int], modes: Sequence[Mode], tell: Callable[[str], None]) -> list[Outcome]:
    """Transfer every size once per mode and direction."""
    outcomes = []
    with rig() as bench:
        for mode in modes:
            for direction in DIRECTIONS:
                outcome, started = Outcome(), time.process_time()
                for size in sizes:
                    transfer(bench, mode, direction, random.Random(size).randbytes(size), outcome)
                outcomes.append(outcome)
                seconds = time.process_time() - started
                tell(f"| {mode} | {direction} | {row(outcome)} | {seconds:.0f} s |")
    return outcomes


def lossy_size(generator: random.Random, mode: Mode) -> int:
    """Return a size for the second table."""
    if mode is Mode.EXPEDITED:
        return generator.randint(1, 4)
    if generator.random() < 0.03:
        return LARGEST
    size = round(math.exp(math.log(LARGEST) * generator.random()))
    unit = generator.choice((7, SUB_BLOCK))
    return min(LARGEST, max(1, round(size / unit) * unit + generator.randint(-1, 1)))


def loss_row(rate: float, mode: Mode, direction: str, rounds: int, seed: int = 1) -> Outcome:
    """Transfer random sizes over a lossy channel."""
    outcome, generator = Outcome(), random.Random(f"{rate} {mode} {direction} {seed}")
    with rig(rate, seed) as bench:
        for _ in range(rounds):
            transfer(bench, mode, direction, generator.randbytes(lossy_size(generator, mode)), outcome)
    return outcome


def row(outcome: Outcome) -> str:
    """Return the cells of a row."""
    return " | ".join(
        str(number)
        for number in (outcome.transfers, outcome.right, outcome.reported, outcome.wrong, outcome.tries,
                       outcome.repeated)
    )  # fmt: skip


HEADS = "transfers | right | reported | wrong | tries | segments repeated"


def main() -> None:
    """Print both tables; exit with 1 when a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a tenth of the sizes and of the rounds")
    parser.add_argument("--every-seven", action="store_true", help="every multiple of 7 up to 64 KiB, by block")
    chosen = parser.parse_args()

    def tell(line: str) -> None:
        print(line, flush=True)

    tell(f"| mode | direction | {HEADS} | CPU |\n|---|---|---|---|---|---|---|---|---|")
    sizes = special_sizes()[::10] if chosen.quick else special_sizes()
    outcomes = size_table(sizes, (Mode.SEGMENTED, Mode.BLOCK), tell)
    if chosen.every_seven:
        sevens = sorted({7 * k + d for k in range(1, LARGEST // 7 + 1) for d in (-1, 0, 1)})
        outcomes += size_table(sevens, (Mode.BLOCK,), tell)
    met = all(outcome.right == outcome.transfers for outcome in outcomes)

    tell(f"\n| loss | mode | direction | {HEADS} |\n|---|---|---|---|---|---|---|---|---|")
    for rate in RATES:
        for mode in (Mode.EXPEDITED, Mode.SEGMENTED, Mode.BLOCK, Mode.AUTO):
            for direction in DIRECTIONS:
                outcome = loss_row(rate, mode, direction, ROUNDS // 10 if chosen.quick else ROUNDS)
                tell(f"| {rate:.1%} | {mode} | {direction} | {row(outcome)} |")
                met = met and outcome.wrong == 0
                if rate == RATES[0] and mode is not Mode.SEGMENTED:
                    met = met and outcome.share >= NEEDED
    tell(f"\ntargets met: {met}")
    sys.exit(0 if met else 1)


if __name__ == "__main__":
    main()
