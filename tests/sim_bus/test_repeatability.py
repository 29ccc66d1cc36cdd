"""Same seed, same frames and same trace bytes: twice, in fresh processes, on other Python versions."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).with_name("repeatable_run.py")
OTHER_PYTHONS = [name for name in os.environ.get("PMSMTOOL_OTHER_PYTHONS", "").split(os.pathsep) if name]
"""Further interpreters with the package's dependencies, for the comparison across versions."""


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


@pytest.mark.parametrize("python", OTHER_PYTHONS)
def test_other_python_versions_agree(python: str) -> None:
    assert run(python, 1, "1") == run(sys.executable, 1, "1")
