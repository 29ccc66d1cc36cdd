# SPDX-License-Identifier: MIT
"""Margins by simulation: the same bytes whoever works, and what is judged."""

from __future__ import annotations

import concurrent.futures
import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from pmsmtool.cli.main import cli
from pmsmtool.design.design_file import Design, design_text
from pmsmtool.design.loops.margins import MarginRequest
from pmsmtool.design.tolerance import Samples, tolerance_box
from pmsmtool.design.tune import tune
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.proof import simulated_margins as monte_carlo
from pmsmtool.proof.simulated_margins import (
    BLOCK,
    SimulatedMargins,
    SimulationTask,
    run_task,
    simulated_margins,
    torque_reversals,
)
from pmsmtool.sim.closed_loop import DriveRuns, simulate_many

PROFILES = Path(__file__).resolve().parents[2] / "profiles"
DRIVES = 2 * BLOCK + 5


@pytest.fixture(scope="module")
def design() -> Design:
    return tune(load_machine_file(PROFILES / "interior-2k2.toml"))


def judged(design: Design, drives: int = DRIVES, **given: object) -> SimulatedMargins:
    scenario = replace(torque_reversals(design), duration_s=0.09)
    box = tolerance_box(design.machine)
    return simulated_margins(design, box, drives=drives, scenario=scenario, seed=3, **given)  # type: ignore[arg-type]


class Backwards:
    """An executor that works from the last task to the first."""

    def map(
        self, function: Callable[[SimulationTask], DriveRuns], tasks: Iterable[SimulationTask], /
    ) -> Iterator[DriveRuns]:
        return iter(reversed([function(task) for task in reversed(list(tasks))]))


class Dying:
    """An executor that loses its workers after one block."""

    def map(
        self, function: Callable[[SimulationTask], DriveRuns], tasks: Iterable[SimulationTask], /
    ) -> Iterator[DriveRuns]:
        for count, task in enumerate(tasks):
            if count == 1:
                raise concurrent.futures.BrokenExecutor("a worker died")
            yield function(task)


@pytest.mark.chain
def test_the_result_is_the_same_whoever_works(design: Design) -> None:
    alone = judged(design, threads=1)
    assert judged(design, threads=3) == alone
    assert judged(design, executor=Backwards()) == alone
    assert judged(design, executor=Dying()) == alone
    with concurrent.futures.ProcessPoolExecutor(2) as pool:
        assert judged(design, executor=pool) == alone


@pytest.mark.chain
def test_a_machine_with_a_flux_map_is_sent_to_another_process() -> None:
    design = tune(load_machine_file(PROFILES / "saturated-pmsyrm.toml"))
    alone = judged(design, BLOCK + 1)
    with concurrent.futures.ProcessPoolExecutor(1) as pool:
        assert judged(design, BLOCK + 1, executor=pool) == alone


def test_one_call_runs_the_blocks_that_tasks_run_singly(design: Design, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[int, int, int]] = []

    def watched(task: SimulationTask) -> DriveRuns:
        asked.append((task.first, task.blocks, task.threads))
        return run_task(task)

    monkeypatch.setattr(monte_carlo, "run_task", watched)
    judged(design, threads=2)
    assert asked == [(0, 3, 2)]


def test_the_worst_drive_is_the_named_one(design: Design) -> None:
    found = judged(design, drives=BLOCK + 3)
    current = next(q for q in found.quantities if q.name == "simulated_current")
    box = tolerance_box(design.machine)
    sample = Samples(box.names, np.array([list(current.worst_sample.values())]))
    scenario = replace(torque_reversals(design), duration_s=0.09)
    machine = replace(design.machine, simulation={})
    again = simulate_many(machine, design.parameter_set(), scenario, monte_carlo.variations(sample, 0, 0), threads=1)
    assert 1.0 - again.i_peak_a[0] / design["motor.I_max_apk"] == current.worst
    assert current.worst <= current.percentiles[1.0] <= current.percentiles[50.0]
    assert current.nominal != current.worst


def test_what_was_asked_is_judged_at_the_percentile(design: Design) -> None:
    free = judged(design, drives=BLOCK)
    at = next(q for q in free.quantities if q.name == "simulated_current").percentiles[5.0]
    assert judged(design, drives=BLOCK, request=MarginRequest(current_headroom=at - 1e-9)).ok
    assert not judged(design, drives=BLOCK, request=MarginRequest(current_headroom=at + 1e-9)).ok


def test_tripped_drives_are_counted_and_fail(design: Design) -> None:
    low = design.values["protection.i_trip_apk"]
    broken = replace(design, values={**design.values, "protection.i_trip_apk": replace(low, value=3.0)})
    found = judged(broken, drives=BLOCK)
    assert found.trips == {"continuous over-current at the output": BLOCK}
    assert not found.ok


@pytest.mark.chain
def test_command(design: Design, tmp_path: Path) -> None:
    path = tmp_path / "design.toml"
    path.write_text(design_text(design))

    def run(*arguments: str) -> tuple[int, str]:
        result = CliRunner().invoke(cli, ["margins", str(path), "--simulate", "70", "--scenario", "q-step", *arguments])
        return int(getattr(result.exception, "exit_code", result.exit_code)), result.stdout

    code, text = run("--workers", "1")
    assert code == 0
    assert "70 drives in closed loop, scenario q-step" in text and "tripped: none" in text
    assert run("--scheduler", "local") == (code, text)
    code, first = run("--json", "--workers", "1")
    assert json.loads(first)["simulated"]["drives"] == 70
    assert run("--json", "--workers", "2") == (code, first)
    assert run("--current-headroom", "0.9")[0] == 1
    assert run("--scenario", "no-such")[0] == 2
