# SPDX-License-Identifier: MIT
"""Recorded pushes on the two shipped machines whose current leaves its reference at speed: planned within the envelope.

Their d current was kicked to 1.3 and 1.7 times the envelope's largest current, which ended in a trip of the drive and
of the guard. The torque of that current is told apart.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pmsmtool.cli.main import run as program
from pmsmtool.experiments.polled_push import VOLTAGE_SHARE, PushPlan, _slower
from pmsmtool.trace import Trace, read_trace
from tests.simulated_bus import settle


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settle(tmp_path, monkeypatch)


def identified(profile: str, *quantities: str) -> int:
    channel = f"{profile}?level=recorder&nv=:memory:"
    return program(["-i", "pmsmsim", "-c", channel, "--yes", "identify", *quantities, "--json"])


def largest_current_a() -> float:
    """Of all records of the only run (A peak)."""
    records = [read_trace(path) for path in Path("runs").glob("*/traces/push_*.npz")]
    assert len(records) == 24
    return max(float(np.max(np.hypot(record["i_d_a"], record["i_q_a"]))) for record in records)


@pytest.mark.chain
def test_a_strongly_saturated_machine_gives_what_it_can(capsys: pytest.CaptureFixture[str]) -> None:
    assert identified("saturated-pmsyrm") == 10
    printed = capsys.readouterr()
    values = {value["name"]: value for value in json.loads(printed.out)["values"]}
    psi = values["psi_f_wb"]
    assert abs(psi["value"] - 0.47669) < psi["total_95"] < 0.02 * 0.47669
    ratio = values["J_per_psi"]
    assert abs(ratio["value"] - 0.015 / 0.47669) < ratio["total_95"] < 0.06 * ratio["value"], "off by 3.0 %; 5.26"
    assert largest_current_a() < 1.2 * 12.45 * 1.25, "measured 14.1; 26.0 before"


@pytest.mark.chain
def test_a_d_current_that_flows_takes_no_inertia(capsys: pytest.CaptureFixture[str]) -> None:
    """Its torque is up to 54 % of the magnets'; J/psi was refused, and would have been 24 % too large."""
    assert identified("fast-ipm", "mechanics") == 0
    values = {value["name"]: value for value in json.loads(capsys.readouterr().out)["values"]}
    ratio = values["J_per_psi"]
    assert abs(ratio["value"] - 0.02 / 0.06565) < 0.01 * ratio["value"] < ratio["total_95"] < 0.05 * ratio["value"]
    assert largest_current_a() < 1.2 * 160.0 * 1.25, "measured 204; 333 before"


def test_a_larger_current_stays_slower_by_what_its_voltage_and_its_kick_would_be() -> None:
    columns = {"u_d_v": 30.0, "u_q_v": 80.0, "i_d_a": -4.0, "i_q_a": 8.0}
    record = Trace(np.arange(50.0), {n: np.full(50, v) for n, v in columns.items()}, dict.fromkeys(columns, "1"))
    plan = PushPlan(20.0, 100.0, u_max_v=100.0, i_max_a=24.0)
    assert _slower(record, 2.0, 16.0, plan) == pytest.approx(VOLTAGE_SHARE * 100.0 / np.hypot(60.0, 80.0))
    assert _slower(record, 2.0, 23.9, plan) == pytest.approx(np.sqrt(24.0**2 - 23.9**2) / 8.0)
    assert _slower(record, 2.0, 16.0, PushPlan(20.0, 100.0)) == np.inf, "no limit is known"
