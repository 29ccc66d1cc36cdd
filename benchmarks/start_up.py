# SPDX-License-Identifier: MIT
"""Time from the prompt to the output, in fresh processes: ``python benchmarks/start_up.py [-n RUNS]``.

Times of a machine are only comparable within one run, so each is printed as a ratio to ``python -c pass`` too. The
commands are run in turn, round after round, so that a busy moment hits all of them. The processor time (user and
system) is what is left of the wall time on an idle machine; the targets hold for the wall time.
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
BARE = "python -c pass"
SIMULATE = "pmsmtool simulate, 1 s"
TARGETS_MS: Mapping[str, float] = {"pmsmtool --help": 100.0, SIMULATE: 250.0}
"""Upper limits of the median, from the start-up budget."""


def commands() -> dict[str, list[str]]:
    """Return name -> arguments after the interpreter."""
    return {
        BARE: ["-c", "pass"],
        "import click": ["-c", "import click"],
        "import numpy": ["-c", "import numpy"],
        "pmsmtool --help": ["-m", "pmsmtool", "--help"],
        SIMULATE: [
            *("-m", "pmsmtool", "simulate", "interior-2k2", "--scenario", "q-step"),
            *("--duration", "1s", "-o", "trace.npz"),
        ],
    }


def measure(runs: int, folder: str) -> dict[str, tuple[float, float, float]]:
    """Return name -> median wall time, median and least processor time (ms) without the first round (cold caches)."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}  # this checkout, installed or not
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # an installed package has its bytecode
    wall: dict[str, list[float]] = {name: [] for name in commands()}
    processor: dict[str, list[float]] = {name: [] for name in commands()}
    for round_number in range(runs + 1):
        for name, arguments in commands().items():
            start, used = time.perf_counter(), _children_s()
            subprocess.run([sys.executable, *arguments], cwd=folder, env=environment, check=True, capture_output=True)
            if round_number:
                wall[name].append(1e3 * (time.perf_counter() - start))
                processor[name].append(1e3 * (_children_s() - used))
    return {
        name: (statistics.median(wall[name]), statistics.median(processor[name]), min(processor[name])) for name in wall
    }


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table; exit 1 when a median is above its target."""
    parser = argparse.ArgumentParser(description="Start-up times in fresh processes.")
    parser.add_argument("-n", "--runs", type=int, default=15, help="rounds, of which the median is taken")
    options = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as folder:
        found = measure(options.runs, folder)
    print(f"{'command':<23} {'ms':>7} {'x bare':>7} {'target ms':>10} {'cpu ms':>7} {'least':>7}")
    late = []
    for name, (median, processor, least) in found.items():
        target = TARGETS_MS.get(name)
        print(
            f"{name:<23} {median:7.1f} {median / found[BARE][0]:7.1f} {target or '':>10} {processor:7.1f} {least:7.1f}"
        )
        if target is not None and median > target:
            late.append(name)
    return 1 if late else 0


if __name__ == "__main__":
    sys.exit(main())
