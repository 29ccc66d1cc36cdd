# SPDX-License-Identifier: MIT
"""A run that did not come to its end says so in its own folder, and its report says it, too."""

from __future__ import annotations

import hashlib
import json
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pmsmtool.bus.clock import VirtualClock
from pmsmtool.errors import LimitExceeded, StopNotConfirmed
from pmsmtool.measurement import identify
from pmsmtool.measurement.run_account import RunAccount, account_lines
from pmsmtool.run_directory import RunDirectory, Stage
from tests.cli.conftest import Tool

IDENTIFY = ("-i", "pmsmsim", "-c", "interior-2k2?nv=:memory:", "--yes", "identify", "R")
ENOUGH = 150
"""Waits of the program until it measures: some traces are there, not all."""


@pytest.fixture
def interrupted(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Let Ctrl-C come at the nth wait."""

    def at(wait: int) -> None:
        count, pass_time = 0, VirtualClock.wait

        def waiting(self: VirtualClock, seconds: float) -> None:
            nonlocal count
            count += 1
            if count == wait:
                signal.raise_signal(signal.SIGINT)
            pass_time(self, seconds)

        monkeypatch.setattr(VirtualClock, "wait", waiting)

    return at


def only_run() -> RunDirectory:
    (path,) = Path("runs").iterdir()
    return RunDirectory(path)


def hashes(run: RunDirectory) -> dict[str, str]:
    files = [p for p in run.path.rglob("*") if p.is_file() and p.name not in ("run.json", "report.html")]
    return {p.relative_to(run.path).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def reported(tool: Tool, run: RunDirectory) -> tuple[dict[str, Any], str]:
    code, out, err = tool("report", str(run.path), "--json")
    assert code == 0, err
    return json.loads(out), (run.path / "report.html").read_text()


def test_an_interrupted_identification_says_what_happened_and_what_is_complete(
    tool: Tool, interrupted: Callable[[int], None]
) -> None:
    interrupted(ENOUGH)
    code, _, err = tool(*IDENTIFY)
    run = only_run()
    assert code == 130 and f"what is complete: pmsmtool report {run.path}" in err
    record = run.read()
    account = record.account
    assert (account["state"], account["stage"], account["exit_code"]) == ("interrupted", "identify", 130)
    assert account["error"] == "Interrupted" and "voltage off, and the drive restored" in account["what"]
    assert account["began_utc"] <= account["ended_utc"]
    (restored,) = account["restored"]
    assert restored.startswith("voltage off, drive restored (")
    assert account["files"] == hashes(run) and "traces/zero_current.npz" in account["files"]
    assert account["incomplete"] == []
    assert [(stage.name, stage.status) for stage in record.stages] == [("identify", "interrupted")]
    data, page = reported(tool, run)
    assert data["verdict"] == "PARTIAL"
    assert data["reasons"][0].startswith("interrupted during identify: the machine is stopped, voltage off, and the")
    assert data["ended"] == account_lines(account)
    assert "How the run ended" in page and "exit code 130" in page and "zero_current" in page and restored in page


def test_a_refused_run_names_its_refusal(tool: Tool) -> None:
    code, _, _ = tool(*IDENTIFY, "--load", "gravity")
    assert code == 5
    run = only_run()
    account = run.read().account
    assert (account["state"], account["exit_code"], account["error"]) == ("refused", 5, "SafetyRefusal")
    assert account["restored"] == [] and account["next_step"]
    data, page = reported(tool, run)
    assert any("refused during identify" in line and "exit code 5" in line for line in data["ended"])
    assert any("no stop and no restore was reported" in line for line in data["ended"])
    assert "refused during identify" in page


def test_what_was_measured_before_a_limit_is_data(tool: Tool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing came out on standard output, and the values were in the run alone."""

    def stage(run: RunDirectory, *asked: object, **more: object) -> None:
        error = LimitExceeded("current", 9.0, 7.5, "A", where="node 1")
        value = {"name": "pole_pairs", "value": 3.0, "unit": "1", "source": "pmsmtool"}
        run.add(Stage("identify", "refused", 1.0, values=[value], note=str(error), refused={"L": "not measured"}))
        raise error

    monkeypatch.setattr(identify, "identify", stage)
    code, out, err = tool(*IDENTIFY, "--json")
    shown = json.loads(out)
    assert code == 5 and shown["status"] == "refused" and shown["refused"] == {"L": "not measured"}
    assert [value["value"] for value in shown["values"]] == [3.0]
    assert err.count("is outside the limit") == 1 and len(only_run().read().stages) == 1


@pytest.mark.parametrize(
    ("error", "code", "state"),
    [(RuntimeError("a bug"), 70, "fail"), (StopNotConfirmed("no answer", hint="use the hardware stop"), 8, "fail")],
)
def test_whatever_ends_it_is_written_down(
    error: Exception, code: int, state: str, tool: Tool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stage(*asked: object, **more: object) -> None:
        raise error

    monkeypatch.setattr(identify, "identify", stage)
    assert tool(*IDENTIFY)[0] == code
    account = only_run().read().account
    assert (account["state"], account["exit_code"], account["error"]) == (state, code, type(error).__name__)
    assert account["what"] == str(error.args[0])


def test_a_record_that_cannot_be_read_hides_no_limit(tool: Tool, monkeypatch: pytest.MonkeyPatch) -> None:
    def stage(run: RunDirectory, *asked: object, **more: object) -> None:
        (run.path / "run.json").write_text("{")
        raise LimitExceeded("current", 9.0, 7.5, "A", where="node 1")

    monkeypatch.setattr(identify, "identify", stage)
    code, _, err = tool(*IDENTIFY)
    assert code == 5 and "is outside the limit" in err


def test_a_killed_run_is_not_taken_for_a_complete_one(tool: Tool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A kill and a power cut close nothing: the account stays open, and half a file keeps the name of half a file."""
    monkeypatch.setattr(identify, "identify", lambda run, *rest, **more: stopped_dead(run))
    monkeypatch.setattr(RunAccount, "_ended", lambda *asked: (_ for _ in ()).throw(OSError("no more power")))
    with monkeypatch.context() as dead:
        dead.setattr(RunDirectory, "add", lambda *asked: None)
        tool(*IDENTIFY)
    run = only_run()
    assert run.read().account["state"] == "open" and run.read().stages == ()
    data, page = reported(tool, run)
    assert data["verdict"] == "PARTIAL"
    assert "did not end: the program was killed, or it still runs" in data["ended"][0] and data["ended"][0] in page


def stopped_dead(run: RunDirectory) -> None:
    raise OSError("no more power")


def test_half_a_file_is_named(tool: Tool, monkeypatch: pytest.MonkeyPatch) -> None:
    def stage(run: RunDirectory, *rest: object, **more: object) -> None:
        run.save("request.json", "{}")
        (run.path / "traces" / ".levels.npz.part").write_bytes(b"half")
        raise RuntimeError("disk")

    monkeypatch.setattr(identify, "identify", stage)
    tool(*IDENTIFY)
    account = only_run().read().account
    assert account["incomplete"] == ["traces/.levels.npz.part"] and list(account["files"]) == ["request.json"]
    assert "not completely written: traces/.levels.npz.part" in account_lines(account)


def test_a_declined_run_leaves_nothing(tool: Tool) -> None:
    assert tool(*(word for word in IDENTIFY if word != "--yes"))[0] == 7
    assert not list(Path("runs").iterdir())


@pytest.mark.chain
def test_a_run_that_came_to_its_end_says_nothing_of_it(tool: Tool) -> None:
    code, _, err = tool(*IDENTIFY)
    assert code == 0, err
    run = only_run()
    account = run.read().account
    assert (account["state"], account["exit_code"]) == ("complete", None)
    assert account["files"] == hashes(run) and account["restored"][0] in err
    data, page = reported(tool, run)
    assert data["ended"] == [] and "How the run ended" not in page


def test_a_run_without_an_account_is_read(tool: Tool) -> None:
    """Records of earlier versions have none."""
    tool(*IDENTIFY, "--load", "gravity")
    run = only_run()
    path = run.path / "run.json"
    facts = json.loads(path.read_text())
    del facts["account"]
    path.write_text(json.dumps(facts))
    assert reported(tool, run)[0]["ended"] == []
