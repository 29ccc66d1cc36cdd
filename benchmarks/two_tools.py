# SPDX-License-Identifier: MIT
"""Two tools write to one drive at the same time: one wins, the other is told who.

Run from the repository: ``python -m benchmarks.two_tools [N] [SEED]`` (default 50 races). The drive is served by
another process; the second tool starts up to 0.6 s after the first. With the node named, and without.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from tests.drive.served import Server, serving

CONSENT = ("--yes", "--i-max", "3Apk", "--speed-max", "100rpm", "--shaft", "free", "--serial", "22001")
TOLD = "another pmsmtool works with this drive: process"


FAILED = "FAILED"


def race(server: Server, home: Path, number: int, rng: random.Random) -> str:
    """Run one race and return how it ended."""
    place = json.dumps({"host": "127.0.0.1", "port": server.port})
    environment = {**os.environ, "PMSMTOOL_HOME": str(home), "CAN_CONFIG": place}
    node = ("-n", "1") if number % 2 else ()
    tools = []
    for ohm in (0.1 + 1e-3 * number, 0.3 + 1e-3 * number):
        command = ["param", "set", f"motor.R_s_ohm={ohm}", f"motor.L_d_h={0.01 * ohm}", "--store"]
        where = ("-i", "socketcand", "-c", "vcan0", *node)
        tools.append(
            subprocess.Popen(
                [sys.executable, "-m", "pmsmtool", *command, *where, *CONSENT],
                env=environment,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
            )
        )
        time.sleep(rng.uniform(0.0, 0.6))
    said = [tool.communicate(timeout=60)[1] for tool in tools]
    won = sum(tool.returncode == 0 for tool in tools)
    told = sum(tool.returncode == 3 and TOLD in text for tool, text in zip(tools, said, strict=True))
    codes = [tool.returncode for tool in tools]
    known = {(1, 1): "one won, the other was told who", (2, 0): "one after the other"}
    return known.get((won, told), f"{FAILED}: exit codes {codes}; they said {said}")


def main() -> int:
    """Print how the races ended; 1 when one did otherwise than it must."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in (("runs", 50), ("seed", 1)):
        parser.add_argument(name, nargs="?", type=int, default=default)
    asked = parser.parse_args()
    runs, rng = asked.runs, random.Random(asked.seed)
    with tempfile.TemporaryDirectory() as home, serving("--nv", ":memory:") as server:
        ended = Counter(race(server, Path(home), number, rng) for number in range(runs))
    print(f"{runs} races: {dict(ended)}")
    return int(any(one.startswith(FAILED) for one in ended))


if __name__ == "__main__":
    sys.exit(main())
