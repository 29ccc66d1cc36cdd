# SPDX-License-Identifier: MIT
"""Interrupt a download after every frame (the full set: at 500 random frames), by power cut and by killing the tool.

Run from the repository: ``python benchmarks/interrupted_downloads.py [--stride N]``. Every run asserts that the
drive acts on, and has stored, exactly the old or exactly the new set, and that a second run or ``restore`` finishes.
"""

from __future__ import annotations

import argparse
import logging
import random
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.insert(0, str(Path(__file__).parent.parent))

from tests.flash.interrupted import How, frames_of, interrupt
from tests.flash.rig import SMALL, with_changed_defaults, with_tables

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pmsmtool.params.parameter_set import ParameterSet


FULL = with_changed_defaults()
RANDOM_FRAMES = 500


def run(name: str, wanted: ParameterSet, moments: Callable[[int], Sequence[int]]) -> None:
    """Interrupt one set at chosen frames, by both kinds, and print what the drives held."""
    kinds: tuple[How, ...] = ("power cut", "killed")
    with tempfile.TemporaryDirectory() as folder:
        frames = frames_of(wanted, Path(folder) / "whole")
        for how in kinds:
            started = time.perf_counter()
            held: Counter[str] = Counter()
            for number, at in enumerate(moments(frames)):
                finish = "again" if number % 2 else "restore"
                root = Path(folder) / f"{how} {number}"
                held[interrupt(wanted, root, at, how, finish=finish).held] += 1  # type: ignore[arg-type]
            seconds = time.perf_counter() - started
            print(f"{name}, {how}: {sum(held.values())} of {frames} frames, {dict(held)}, 0 mixed, {seconds:.0f} s")
            sys.stdout.flush()


def main() -> None:
    """Print one line per set and kind of interruption."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--stride", type=int, default=1, help="take every Nth frame, and of the full set every Nth of 500"
    )
    stride = parser.parse_args().stride
    logging.disable(logging.CRITICAL)
    rng = random.Random(1)
    run("4 values", SMALL, lambda frames: range(1, frames + 1, stride))
    run("4 values and 9x9 tables", with_tables(), lambda frames: range(1, frames + 1, stride))
    run("full set and 9x9 tables", FULL, lambda frames: rng.sample(range(1, frames + 1), RANDOM_FRAMES // stride))


if __name__ == "__main__":
    main()
