"""The same numbers on a Dask cluster on loopback, with a worker killed midway."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from pmsmtool.cli.scheduler import executor
from pmsmtool.design.margins import BLOCK, margin_report
from pmsmtool.design.tolerance import tolerance_box
from pmsmtool.design.tune import tune
from pmsmtool.errors import BusError, NotAvailable
from pmsmtool.machine.machine_file import load_machine_file

PROFILES = Path(__file__).resolve().parents[2] / "profiles"


def test_a_cluster_with_a_lost_worker_gives_the_local_numbers() -> None:
    distributed = pytest.importorskip("distributed")
    design = tune(load_machine_file(PROFILES / "jercic-2017.toml"))
    box = tolerance_box(design.machine)
    count = 24 * BLOCK
    alone = margin_report(design, box, samples=count, seed=3)
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, host="127.0.0.1"
    ) as cluster:
        victims = [worker.pid for worker in cluster.workers.values()]

        def kill_one(done: int, wanted: int) -> None:
            if victims and done >= wanted // 4:
                os.kill(victims.pop(), signal.SIGKILL)
                victims.clear()

        with executor(cluster.scheduler_address) as pool:
            shared = margin_report(design, box, samples=count, seed=3, executor=pool, progress=kill_one)
    assert not victims
    assert shared == alone


def test_a_cluster_that_is_not_there_is_said_so() -> None:
    pytest.importorskip("distributed")
    with pytest.raises(BusError, match="scheduler"), executor("tcp://127.0.0.1:9"):
        pass


def test_without_its_package_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    with pytest.raises(NotAvailable) as caught, executor("tcp://127.0.0.1:9"):
        pass
    assert "cluster" in caught.value.hint
