# SPDX-License-Identifier: MIT
"""A file of the wrong kind, or a run that ended early: the message names the command that comes first."""

from __future__ import annotations

from pathlib import Path

import pytest

import pmsmtool
from pmsmtool.bus.connect import _why_closed
from pmsmtool.commissioning.printed_page import BROWSER
from pmsmtool.machine.machine_file import machine_path
from tests.cli.conftest import Tool


def test_a_machine_is_designed_before_it_is_exported(tool: Tool) -> None:
    Path("m.toml").write_bytes(machine_path("interior-2k2").read_bytes())
    for source in ("interior-2k2", "m.toml"):
        code, _, told = tool("export", "c", source, "-o", "firmware")
        assert code == 2 and f"`pmsmtool tune {source} -o design.toml`" in told


def test_a_run_that_ended_early_is_resumed(tool: Tool) -> None:
    Path("run").mkdir()
    code, _, told = tool("export", "c", "run", "-o", "firmware")
    assert code == 2 and "`pmsmtool tune` writes one" in told
    Path("run/run.json").touch()
    code, _, told = tool("export", "c", "run", "-o", "firmware")
    assert code == 2 and "commission --resume run" in told and "ended before" in told


def test_a_run_is_flashed_not_restored(tool: Tool) -> None:
    Path("run").mkdir()
    code, _, told = tool("restore", "run", "--sim", "interior-2k2?nv=:memory:", "--yes")
    assert code == 2 and "flash-params run" in told


def test_without_a_browser_no_page_is_made_first(tool: Tool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(BROWSER, "no-such-browser")
    Path("run").mkdir()  # no run: a page could not be made
    code, _, told = tool("report", "--pdf", "run")
    assert code == 2 and "no browser was found" in told


def test_a_missing_library_is_no_wrong_channel() -> None:
    assert "library for pcan" in _why_closed("pcan", Exception("pcanbasic library not found."))
    assert "wrong channel" in _why_closed("pcan", Exception("The value of a handle is invalid"))


def test_a_design_takes_a_name_and_names_its_own() -> None:
    design = pmsmtool.tune("interior-2k2")
    assert design == pmsmtool.tune(pmsmtool.load_machine_file("interior-2k2"))
    with pytest.raises(KeyError, match="did you mean current.K_p_d_v_per_a"):
        design["current.K_p"]
