# SPDX-License-Identifier: MIT
"""A library that is loaded while the drive is energised keeps the heartbeat away longer than the drive waits for it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from pmsmtool.drive.dead_man import CONSUMER_MS

WATCHED = """
import sys
from pmsmtool.cli.main import main
from pmsmtool.drive.guard import GuardedDrive

begin, stop, known = GuardedDrive.begin, GuardedDrive.stop, []

def begun(self, **options):
    begin(self, **options)
    known.append(set(sys.modules))

def stopped(self):
    if known:
        late = {name.split(".")[0] for name in set(sys.modules) - known[-1]} - {"numpy", "pmsmtool"}
        print("LATE", *sorted(name for name in late if name not in sys.stdlib_module_names))
    return stop(self)

GuardedDrive.begin, GuardedDrive.stop = begun, stopped
sys.argv = ["pmsmtool", *sys.argv[1:]]
main()
"""


@pytest.mark.chain
@pytest.mark.parametrize(
    "arguments", [("identify", "R", "--accuracy", "0.01"), ("check",), ("jog", "--speed", "100rpm")]
)
def test_nothing_slow_is_loaded_while_the_drive_is_energised(arguments: tuple[str, ...], tmp_path: Path) -> None:
    """scipy.optimize took 0.54 and 0.79 s on a busy computer: identify of a served drive ended there, 5 of 5 times."""
    assert CONSUMER_MS <= 500
    command = [sys.executable, "-c", WATCHED, *arguments, "--sim", "interior-2k2?nv=:memory:", "--yes"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=300)
    late = [line for line in done.stdout.splitlines() if line.startswith("LATE")]
    assert late and set(late) == {"LATE"}, done.stdout + done.stderr
