# SPDX-License-Identifier: MIT
"""The same numbers on a Dask cluster on loopback, with a worker killed midway."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from pmsmtool.cli.main import cli
from pmsmtool.cli.margins import executor
from pmsmtool.design.design_file import design_text
from pmsmtool.design.loops.margins import BLOCK, margin_report
from pmsmtool.design.tolerance import tolerance_box
from pmsmtool.design.tune import tune
from pmsmtool.errors import BusError, NotAvailable
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.proof import simulated_margins as monte_carlo
from pmsmtool.proof.simulated_margins import simulated_margins, torque_reversals

PROFILES = Path(__file__).resolve().parents[2] / "profiles"


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    distributed = pytest.importorskip("distributed", reason="the package distributed (extra: cluster) is not installed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, host="127.0.0.1"
    ) as made:
        yield made


class Killer:
    """Progress that kills one worker when a quarter is done."""

    def __init__(self, cluster: Any) -> None:
        self.victims = [worker.pid for worker in cluster.workers.values()]

    def __call__(self, done: int, wanted: int) -> None:
        if self.victims and done >= wanted // 4:
            os.kill(self.victims.pop(), signal.SIGKILL)
            self.victims.clear()


def test_a_cluster_with_a_lost_worker_gives_the_local_numbers(cluster: Any) -> None:
    design = tune(load_machine_file(PROFILES / "jercic-2017.toml"))
    box = tolerance_box(design.machine)
    count = 24 * BLOCK
    alone = margin_report(design, box, samples=count, seed=3)
    kill = Killer(cluster)
    with executor(cluster.scheduler_address) as pool:
        shared = margin_report(design, box, samples=count, seed=3, executor=pool, progress=kill)
    assert not kill.victims
    assert shared == alone


def test_simulated_drives_on_a_cluster_with_a_lost_worker_are_the_local_ones(cluster: Any, tmp_path: Path) -> None:
    """The printed bytes of the command, and the values with a worker killed on the way; a machine with a flux map."""
    design = tune(load_machine_file(PROFILES / "saturated-pmsyrm.toml"))
    box, scenario = tolerance_box(design.machine), replace(torque_reversals(design), duration_s=0.15)
    drives = 7 * monte_carlo.BLOCK + 1
    alone = simulated_margins(design, box, drives=drives, scenario=scenario, threads=1)
    cluster.wait_for_workers(2, timeout=300)  # the killed one comes back, late on a busy machine
    kill = Killer(cluster)
    with executor(cluster.scheduler_address) as pool:
        shared = simulated_margins(design, box, drives=drives, scenario=scenario, executor=pool, progress=kill)
    assert not kill.victims
    assert shared == alone
    path = tmp_path / "design.toml"
    path.write_text(design_text(design))
    asked = ["margins", str(path), "--simulate", "70", "--scenario", "q-step", "--monte-carlo", "3000", "--json"]
    local = CliRunner().invoke(cli, [*asked, "--scheduler", "local"])
    there = CliRunner().invoke(cli, [*asked, "--scheduler", cluster.scheduler_address])
    assert local.exit_code == there.exit_code == 0
    assert there.stdout_bytes == local.stdout_bytes


def test_a_cluster_that_is_not_there_is_said_so() -> None:
    pytest.importorskip("distributed")
    with pytest.raises(BusError, match="scheduler"), executor("tcp://127.0.0.1:9"):
        pass


def test_without_its_package_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    with pytest.raises(NotAvailable) as caught, executor("tcp://127.0.0.1:9"):
        pass
    assert "cluster" in caught.value.hint
