# SPDX-License-Identifier: MIT
"""Command lines of one process."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from pmsmtool.cli.main import run
from tests.simulated_bus import settle

Result = tuple[int, str, str]
"""Exit code, standard output, standard error."""
Tool = Callable[..., Result]


@pytest.fixture
def tool(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Tool:
    """Run a command line in this process, in an empty folder."""
    settle(tmp_path, monkeypatch)

    def call(*arguments: str) -> Result:
        capsys.readouterr()
        code = run(arguments)
        printed = capsys.readouterr()
        return code, printed.out, printed.err

    return call
