# SPDX-License-Identifier: MIT
"""Kill ``pmsmtool flash-params`` with SIGKILL at random moments, over a bus to a drive in another process.

Run from the repository: ``python -m benchmarks.killed_downloads [N]`` (default 50). Each run asserts that the drive
works with exactly the old or exactly the new set and reports its CRC-32, and that the same command or ``restore``
finishes.
"""

from __future__ import annotations

import argparse
import random
import tempfile
import time
from collections import Counter
from pathlib import Path

from tests.drive.served import serving
from tests.flash.rig import with_tables
from tests.flash.test_killed import OTHER, kill_and_recover


def main() -> None:
    """Print what the drives held."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="?", type=int, default=50)
    runs = parser.parse_args().runs
    rng = random.Random(1)
    found: Counter[str] = Counter()
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder, serving("--nv", ":memory:") as server:
        for run in range(runs):
            home = Path(folder) / str(run)
            home.mkdir()
            wanted = home / "wanted.toml"
            wanted.write_text((with_tables() if run % 2 else OTHER).to_toml())
            finish = "again" if run % 3 else "restore"
            found[kill_and_recover(server, home, wanted, rng.uniform(0.0, 1.2), finish=finish)] += 1
    seconds = time.perf_counter() - started
    print(f"{runs} SIGKILLs: {dict(found)} set held afterwards, 0 mixed, all finished, {seconds:.0f} s")


if __name__ == "__main__":
    main()
