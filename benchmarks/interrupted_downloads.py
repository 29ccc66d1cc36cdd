"""Interrupt a download after every frame, by power cut and by killing the tool, and count what is found.

Run from the repository: ``python benchmarks/interrupted_downloads.py [--stride N]``. Every run asserts that the
drive acts on, and has stored, exactly the old or exactly the new set, and that a second run or ``restore`` finishes.
"""

from __future__ import annotations

import argparse
import logging
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))

from tests.flash.interrupted import How, frames_of, interrupt
from tests.flash.rig import SMALL, with_tables


def main() -> None:
    """Print one line per set and kind of interruption."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stride", type=int, default=1, help="take every Nth frame only")
    stride = parser.parse_args().stride
    logging.disable(logging.CRITICAL)
    kinds: tuple[How, ...] = ("power cut", "killed")
    for name, wanted in (("4 values", SMALL), ("4 values and 9x9 tables", with_tables())):
        with tempfile.TemporaryDirectory() as folder:
            frames = frames_of(wanted, Path(folder) / "whole")
            for how in kinds:
                started = time.perf_counter()
                held: Counter[str] = Counter()
                for at in range(1, frames + 1, stride):
                    finish = "again" if at % 2 else "restore"
                    root = Path(folder) / f"{how} {at}"
                    held[interrupt(wanted, root, at, how, finish=finish).held] += 1  # type: ignore[arg-type]
                seconds = time.perf_counter() - started
                print(f"{name}, {how}: {sum(held.values())} of {frames} frames, {dict(held)}, 0 mixed, {seconds:.0f} s")


if __name__ == "__main__":
    main()
