# SPDX-License-Identifier: MIT
"""Same seed, same frames and same trace bytes: twice, in fresh processes, on other Python versions."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.chain

SCRIPT = Path(__file__).with_name("repeatable_run.py")
MODULES = "import can, click, numpy, sys; print(sys.version_info[:2])"
"""What the run needs; an interpreter without them is not compared."""


def other_pythons() -> list[str]:
    """Return interpreters of other versions that can run it: PMSMTOOL_OTHER_PYTHONS, and those on the path."""
    named = [name for name in os.environ.get("PMSMTOOL_OTHER_PYTHONS", "").split(os.pathsep) if name]
    on_path = (shutil.which(f"python3.{minor}") for minor in range(11, 20))
    found = {f"({sys.version_info[0]}, {sys.version_info[1]})"}
    usable = []
    for python in (*named, *filter(None, on_path)):
        asked = subprocess.run([python, "-c", MODULES], capture_output=True, text=True, timeout=60)
        if asked.returncode == 0 and asked.stdout.strip() not in found:
            found.add(asked.stdout.strip())
            usable.append(python)
    return usable


def run(python: str, seed: int, hash_seed: str) -> str:
    environment = {**os.environ, "PYTHONHASHSEED": hash_seed}
    arguments = [python, str(SCRIPT), str(seed)]
    done = subprocess.run(arguments, capture_output=True, text=True, env=environment, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_fresh_processes_agree_and_another_seed_differs() -> None:
    first = run(sys.executable, 1, "1")
    assert len(first.split()) == 2
    assert run(sys.executable, 1, "2") == first
    frames, trace = run(sys.executable, 2, "1").split()
    assert frames != first.split()[0]
    assert trace != first.split()[1]


def test_other_python_versions_agree() -> None:
    """Compared so far: 3.11.7 with numpy 2.4, 3.12.1 and 3.13.0 with numpy 2.5."""
    pythons = other_pythons()
    if not pythons:
        pytest.skip("no other Python >= 3.11 with numpy, can and click; name some in PMSMTOOL_OTHER_PYTHONS")
    expected = run(sys.executable, 1, "1")
    for python in pythons:
        assert run(python, 1, "1") == expected
