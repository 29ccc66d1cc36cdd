# SPDX-License-Identifier: MIT
"""The real installation that a fresh machine makes: pip, a new environment, a copy of the sources, and no compiler.

Dependencies are left out (``--no-deps``): what is asked here is what this package does itself. The editable
installation is the one that these tests run in; what each kind requires says ``test_compiler.py``.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import venv
from dataclasses import dataclass
from pathlib import Path

import pytest

from pmsmtool.packaging import backend
from pmsmtool.packaging.compiler import CANDIDATES, KERNELS

ROOT = Path(__file__).resolve().parents[2]
NO_INDEX = ("No matching distribution found for", "Could not find a version that satisfies", "ConnectionError")

pytestmark = [
    pytest.mark.slow_install,
    pytest.mark.skipif(sys.platform == "win32", reason="paths of a POSIX environment"),
]

PROBE = """
import sys
from pmsmtool.native import LIBRARY_FOLDER, load
from pmsmtool.files import data_folder
for name in sys.argv[1:]:
    load(name)
print(LIBRARY_FOLDER)
for name in ("profiles", "firmware-params"):
    folder = data_folder(name)
    print(folder, *sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()))
"""


@dataclass(frozen=True)
class Installation:
    """Where pmsmtool was installed, and what the build said."""

    python: Path
    sources: Path
    log: str

    def probe(self, folder: Path) -> list[str]:
        """Load every kernel and find the data, from a folder that is not the checkout."""
        command = [str(self.python), "-c", PROBE, *(kernel.name for kernel in KERNELS)]
        env = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout.splitlines()


def install(folder: Path) -> Installation:
    """Install a copy of this checkout in a fresh environment, where no compiler is found."""
    sources = folder / "checkout"
    for name, path in backend.source_files(ROOT).items():
        (sources / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, sources / name)
    for name in backend.DATA_FOLDERS:
        (sources / name).mkdir(exist_ok=True)
    venv.create(folder / "environment", with_pip=False)
    python = folder / "environment" / "bin" / "python"
    env = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "CC")}
    env["PATH"] = str(folder / "environment" / "bin")
    assert not any(shutil.which(name, path=env["PATH"]) for name in CANDIDATES)
    command = [sys.executable, "-m", "pip", "--python", str(python), "install", "-v", "--no-deps", "--no-compile",
               str(sources)]  # fmt: skip
    done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True)
    log = done.stdout + done.stderr
    if done.returncode != 0 and any(text in log for text in NO_INDEX):
        pytest.skip("no package index can be reached")
    assert done.returncode == 0, log
    return Installation(python, sources, log)


def data_lines(root: Path) -> list[str]:
    """What the probe prints for the data folders that stand in ``root``."""
    files = {name: [p for p in backend.source_files(ROOT) if p.startswith(f"{name}/")] for name in backend.DATA_FOLDERS}
    return [
        " ".join([str(root / name), *(p.removeprefix(f"{name}/") for p in sorted(found))])
        for name, found in files.items()
    ]


def test_installed_wheel_has_kernels_and_data_and_leaves_the_sources_clean(tmp_path: Path) -> None:
    found = install(tmp_path)
    assert "compiled by ziglang" in found.log
    package = next((tmp_path / "environment").rglob("site-packages")) / "pmsmtool"
    assert found.probe(tmp_path) == [str(package / "_native"), *data_lines(package / "_data")]
    left = {path.name for path in found.sources.iterdir()} - {name.split("/")[0] for name in backend.source_files(ROOT)}
    assert left <= set(backend.DATA_FOLDERS)
    assert not (found.sources / "pmsmtool" / "_native").exists()
    help_text = subprocess.run([tmp_path / "environment/bin/pmsmtool", "--version"], capture_output=True, text=True)
    assert "No module named 'click'" in help_text.stderr  # the entry point is there; its dependencies were left out
