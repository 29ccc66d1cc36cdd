# SPDX-License-Identifier: MIT
"""Downloads of the full set with 16 KiB of tables, and uploads of 64 KiB traces, under frame loss.

Run from the repository: ``python -m benchmarks.loss [N]`` (default 200 of each). Every download that reports success is
compared with the drive's memory behind the tool's back, every trace with the drive's own bytes; one that fails must
leave the old set. Anything else raises.
"""

from __future__ import annotations

import argparse
import logging
import tempfile
import time
from collections import Counter
from pathlib import Path

from pmsmtool.bus.connect import Connection
from pmsmtool.bus.sdo import Mode, SdoChannel
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.errors import PmsmtoolError
from pmsmtool.params.parameter_set import default_set
from pmsmtool.sim.bus import PmsmSimBus
from tests.flash.rig import Rig, attach, with_tables
from tests.node.bench import open_bench

NODES = 45
"""Two tables of 45 x 45 binary32: 16.2 kB."""
TRACE_BYTES = 65536
WANTED = default_set().merged(with_tables(NODES))


def faults(share: float) -> str:
    """Return a faults file that drops a share of all frames."""
    return f'[[frame]]\naction = "drop"\nprobability = {share}\n'


def downloads(share: float, runs: int) -> tuple[Counter[str], int, float]:
    """Download to fresh drives; return what happened, transfers repeated, seconds."""
    found: Counter[str] = Counter()
    repeated = 0
    started = time.perf_counter()
    for run in range(runs):
        with tempfile.TemporaryDirectory() as folder:
            bench = open_bench(faults=faults(share), seed=run)
            bench.wait(0.1)
            try:
                rig = attach(bench, Path(folder))
            except PmsmtoolError:
                found["reported"] += 1
                continue
            old = rig.image()
            found[_download(rig, old)] += 1
            repeated += rig.node.sdo.retries
            bench.bus.shutdown()
    return found, repeated, time.perf_counter() - started


def _download(rig: Rig, old: bytes) -> str:
    try:
        outcome = rig.download(WANTED)
    except PmsmtoolError:
        rig.bench.wait(2.0)
        new = rig.image() != old
        if new and len(rig.image()) <= len(old):
            raise SystemExit("a mixed set") from None
        return "reported"
    image_crc, active, stored = rig.crcs()
    if not image_crc == active == stored == outcome.crc or len(rig.image()) <= len(old):
        raise SystemExit("success was reported, and the drive holds something else")
    return "right"


def uploads(share: float, runs: int) -> tuple[Counter[str], int, float]:
    """Upload the recorder's memory; return what happened, transfers repeated, seconds."""
    found: Counter[str] = Counter()
    repeated = 0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "faults.toml"
        path.write_text(faults(share) + "after = 200\n")
        with Connection(PmsmSimBus(f"interior-2k2?nv=:memory:&seed=5&faults={path}")) as connection:
            node = DriveNode(connection, 1)
            for number in range(8):
                node.sdo.download(0x2061, number + 1, (0x20700120 + (number << 8)).to_bytes(4, "little"))
            node.sdo.download(0x2060, 2, (2048).to_bytes(4, "little"))
            node.sdo.download(0x2060, 7, b"\1")
            connection.wait(1.0)
            truth = connection.bus.line.nodes[0].core.recording()  # type: ignore[attr-defined]
            started = time.perf_counter()
            for _ in range(runs):
                channel = SdoChannel(connection, 1)
                try:
                    data = channel.upload(0x2062, 0, size=TRACE_BYTES, mode=Mode.BLOCK).data
                except PmsmtoolError:
                    found["reported"] += 1
                else:
                    if data != truth:
                        raise SystemExit("a damaged trace was returned as good")
                    found["right"] += 1
                repeated += channel.retries
                channel.close()
    return found, repeated, time.perf_counter() - started


def main() -> None:
    """Print one line per loss and kind."""
    logging.disable(logging.CRITICAL)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="?", type=int, default=200)
    runs = parser.parse_args().runs
    for share in (0.001, 0.01):
        for name, job in (
            ("downloads of the full set with 16 KiB of tables", downloads),
            ("uploads of 64 KiB", uploads),
        ):
            found, repeated, seconds = job(share, runs)
            right = found["right"]
            print(
                f"{100 * share:g} % loss, {runs} {name}: {right} right ({100 * right / runs:.1f} %), "
                f"{found['reported']} reported, 0 silent; {repeated} transfers repeated, {seconds:.0f} s"
            )


if __name__ == "__main__":
    main()
