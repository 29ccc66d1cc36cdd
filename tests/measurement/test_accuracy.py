# SPDX-License-Identifier: MIT
"""``identify --accuracy``: less is collected where that is enough, and what is not reached is said."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from benchmarks.random_drives import true_loop_resistance
from pmsmtool.bus.connect import Connection
from pmsmtool.cli.main import run as main
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.errors import ConfigError, ExitCode, NotAvailable
from pmsmtool.experiments.mechanics_run import MechanicsPlan
from pmsmtool.files import data_folder
from pmsmtool.identification.prediction import Prediction
from pmsmtool.identification.request import IdentifyRequest, accuracy_facts, accuracy_line, dump_request, parse_request
from pmsmtool.machine.machine_file import dump_machine_file, load_machine_file
from pmsmtool.machine.parameters import Estimate
from pmsmtool.measurement import effort, measure
from pmsmtool.measurement.effort import (
    ALL,
    COASTINGS,
    LEVEL_EFFORTS,
    MECHANICS,
    SPEED_EFFORTS,
    Effort,
    coasting_for,
    effort_for,
)
from pmsmtool.measurement.identify import identify
from pmsmtool.measurement.limits import Limits
from pmsmtool.measurement.measure import starting_gains
from pmsmtool.measurement.speeds import SpeedStage
from pmsmtool.report.verdict import verdict_of
from pmsmtool.run_directory import RunDirectory, Stage, new_record
from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.trace import read_trace

MOST_S = 19.5
"""Machine time of all default quantities of ``interior-2k2`` with 1 %; measured: 18.0 s, without an accuracy 46.5 s."""


def identified(folder: Path, accuracy: float | None, said: list[str]) -> tuple[RunDirectory, Stage]:
    record = new_record(["test"], drive={}, bus={}, versions={}, operator="nobody")
    run = RunDirectory.create(folder, 1, record)
    with Connection(PmsmSimBus("interior-2k2?nv=:memory:")) as connection:
        drive = CanopenDrive(connection, 1)
        request = IdentifyRequest(quantities=("R",), accuracy=accuracy)
        stage = identify(run, drive, request, lambda lines: None, said.append)
    return run, stage


# ---- the choice ---------------------------------------------------------------------------------------------


def predicting(R: float, L: float, psi: float) -> Callable[[Effort], Prediction]:
    """Standard deviations of all levels and samples, which grow with the root of what is left out."""

    def predicted(one: Effort) -> Prediction:
        levels = math.sqrt(len(ALL.levels.magnitudes(1.0)) / len(one.levels.magnitudes(1.0)))
        return Prediction(R * levels, L * math.sqrt(ALL.shot_samples / one.shot_samples), psi)

    return predicted


def test_without_an_accuracy_all_is_collected() -> None:
    assert effort_for(None, predicting(1e-6, 1e-6, 1e-6)) == ALL == Effort()


def test_each_experiment_is_chosen_by_what_it_would_reach() -> None:
    chosen = effort_for(0.01, predicting(1e-3, 4e-3, 1e-2))
    assert chosen.levels == LEVEL_EFFORTS[0]
    assert chosen.shot_samples == ALL.shot_samples
    assert chosen.speeds == ALL.speeds
    assert effort_for(0.01, predicting(1e-2, 1e-3, 1e-3)).speeds == SPEED_EFFORTS[0]


def test_what_an_effort_leaves_out_is_said_by_quantity() -> None:
    assert ALL.left_out == {}
    quick = effort_for(0.01, predicting(1e-4, 1e-4, 1e-4))
    assert quick.left_out == {
        "R": "12 of 28 levels",
        "L": "one of two fast square waves, up to 1792 of 2048 samples of a square wave",
        "psi": "2 of 4 speeds in each direction, down to 50 % of the largest speed, 4 of 8 d currents",
        "mechanics": "1600 of 2000 rows of a torque pulse",
    }
    assert "psi" not in effort_for(0.01, predicting(1e-4, 1e-4, 1e-1)).left_out


def test_the_speed_of_the_flux_run_is_what_its_prediction_asks() -> None:
    def predicted(one: Effort) -> Prediction:
        return Prediction(1e-4, 1e-4, 2e-3 / one.speeds.speed_share)

    shares = [effort_for(share, predicted).speeds.speed_share for share in (0.01, 0.006)]
    assert shares == [0.5, 1.0]
    assert effort_for(0.001, predicted).speeds == ALL.speeds


def test_less_accuracy_never_takes_more() -> None:
    found = [effort_for(share, predicting(2e-3, 1e-3, 2e-3)) for share in (0.003, 0.006, 0.01, 0.03)]
    for collected in (
        [len(one.levels.magnitudes(1.0)) for one in found],
        [one.shot_samples for one in found],
        [len(one.speeds.shares) for one in found],
    ):
        assert collected == sorted(collected, reverse=True)
        assert collected[0] > collected[-1]


def test_a_coasting_is_as_long_as_its_prediction_asks() -> None:
    plan = MechanicsPlan(1.0, 0.3, 100.0, 2.0)
    within = COASTINGS[1]

    def predicted(one: MechanicsPlan) -> dict[str, float]:
        return dict.fromkeys(MECHANICS, 0.004 if one.coast_units >= within else 0.006)

    assert coasting_for(0.01, plan, predicted)[0] == replace(plan, coast_units=within)
    assert coasting_for(None, plan, predicted)[0] == plan
    # what the longest would not reach either asks for no more than is as good
    assert coasting_for(0.001, plan, predicted)[0] == replace(plan, coast_units=within)
    assert coasting_for(0.001, plan, lambda one: dict.fromkeys(MECHANICS, 0.01 / one.coast_units))[0] == plan
    # a friction that the run over speeds does not show asks for all of it
    assert coasting_for(0.01, plan, lambda one: {"J_kgm2": 1e-3})[0] == plan


def test_an_accuracy_takes_quicker_gains_at_standstill() -> None:
    limits = Limits(5.0, 7.5, 300.0, 30.0)
    slow, quick = (starting_gains(limits, accuracy) for accuracy in (None, 0.01))
    assert quick["current.K_i_d_v_per_as"] == 2.0 * slow["current.K_i_d_v_per_as"]
    assert quick["current.K_p_d_v_per_a"] == slow["current.K_p_d_v_per_a"]


# ---- the run ------------------------------------------------------------------------------------------------


@pytest.mark.chain
def test_a_percent_takes_less_machine_time_and_the_truth_is_in_the_intervals(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ("identify", "--accuracy", "0.01", "--sim", "interior-2k2", "--yes", "--json", "--runs", str(tmp_path))
    assert main(asked) == 0
    out, err = capsys.readouterr()
    data = json.loads(out)
    (folder,) = tmp_path.iterdir()
    (stage,) = RunDirectory(folder).read().stages
    assert stage.seconds < MOST_S
    drive = load_machine_file(data_folder("profiles") / "interior-2k2.toml")
    truth = {key: getattr(drive.machine, key) for key in ("L_d_h", "L_q_h", "psi_f_wb", "J_kgm2")}
    truth["R_s_ohm"] = true_loop_resistance(drive)
    values = {value["name"]: value for value in data["values"]}
    outside = {key for key, true in truth.items() if abs(values[key]["value"] - true) > values[key]["total_95"]}
    assert not outside
    assert "sampling_instant_s" in values, "three pairs of the largest d current on either side show it"
    facts = data["accuracy"]
    assert set(facts) == {"R_s_ohm", "L_d_h", "L_q_h", "psi_f_wb"}
    for key, fact in facts.items():
        assert fact["reached"] and fact["asked"] == 0.01
        assert fact["statistical_95"] == pytest.approx(values[key]["statistical_95"] / abs(values[key]["value"]))
        assert fact["statistical_95"] <= 0.01
        assert values[key]["systematic"] > 0.0, "the sensors' part stands beside it"
    assert accuracy_line(facts) in err and "; reached" in err
    for key, quantity in (("R_s_ohm", "R"), ("L_d_h", "L"), ("psi_f_wb", "psi")):
        told = facts[key]["left_out"]
        assert any("left out for the accuracy" in line and f"{told} ({quantity})" in line for line in data["warnings"])
    traces = {path.stem for path in (folder / "traces").iterdir()}
    assert "first_turn" not in traces and "rotation_forward" not in traces
    assert "current limit proven: " in err and "speed limit proven: " in err

    before = (folder / "machine.toml").read_bytes()
    (folder / "machine.toml").unlink()
    assert main(("identify", "--replay", str(folder), "--json")) == 0
    assert json.loads(capsys.readouterr().out)["accuracy"] == facts
    assert (folder / "machine.toml").read_bytes() == before


@pytest.mark.chain
def test_what_is_not_reached_is_said_and_the_value_stays(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = ("identify", "R", "--accuracy", "0.0005", "--sim", "interior-2k2", "--yes", "--json", "--runs")
    assert main((*asked, str(tmp_path))) == ExitCode.PARTIAL
    out, err = capsys.readouterr()
    data = json.loads(out)
    assert data["status"] == "partial" and not data["refused"]
    assert data["accuracy"]["R_s_ohm"]["reached"] is False
    line = accuracy_line(data["accuracy"])
    assert line.endswith("not reached: R_s") and line in err
    assert any(line in warning for warning in data["warnings"])
    (folder,) = tmp_path.iterdir()
    verdict = verdict_of(json.loads((folder / "run.json").read_text()), ("identify",))
    assert verdict.kind == "partial" and any(line in told for told in verdict.lines)
    assert "R_s_ohm" in load_machine_file(folder / "machine.toml").estimates
    assert main(("identify", "--replay", str(folder), "--json")) == ExitCode.PARTIAL
    assert json.loads(capsys.readouterr().out)["accuracy"] == data["accuracy"]


@pytest.mark.chain
def test_levels_that_are_not_good_enough_are_followed_by_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    monkeypatch.setattr(measure, "effort_for", lambda accuracy, predicted: Effort(LEVEL_EFFORTS[0]))
    run, stage = identified(tmp_path, 0.001, said)
    assert sum("more levels" in line for line in said) == 1
    trace = read_trace(run.path / "traces" / "levels.npz")
    assert len(trace) == 2 * (len(LEVEL_EFFORTS[1].magnitudes(1.0)) + len(LEVEL_EFFORTS[1].low))
    assert stage.status == "partial"


@pytest.mark.chain
def test_few_samples_still_hold_the_periods_of_a_slow_square_wave(tmp_path: Path) -> None:
    base = load_machine_file(data_folder("profiles") / "interior-2k2.toml")
    fast = replace(base, inverter=replace(base.inverter, f_s_hz=24e3))  # 560 samples are 20 periods of 0.6 ms each
    (tmp_path / "fast.toml").write_text(dump_machine_file(fast), encoding="utf-8")
    run = RunDirectory.create(tmp_path, 1, new_record(["test"], drive={}, bus={}, versions={}, operator="nobody"))
    with Connection(PmsmSimBus(f"{tmp_path / 'fast.toml'}?nv=:memory:")) as connection:
        request = IdentifyRequest(quantities=("L",), accuracy=0.01)
        stage = identify(run, CanopenDrive(connection, 1), request, lambda lines: None, lambda text: None)
    assert not stage.refused
    assert {"L_d_h", "L_q_h"} <= {value["name"] for value in stage.values}


def test_speeds_that_are_not_enough_are_followed_by_all(monkeypatch: pytest.MonkeyPatch) -> None:
    ran: list[Any] = []
    monkeypatch.setattr(SpeedStage, "_pushes", lambda *given: (0.1, 1e-3))
    monkeypatch.setattr(SpeedStage, "_speeds", lambda self, *known: ran.append(self.effort))
    drive: Any = SimpleNamespace(period_s=1e-4, disable=lambda: None, enable=lambda: None, write=lambda values: None)
    encoder: Any = SimpleNamespace(pole_pairs=SimpleNamespace(value=3.0))
    resistance: Any = SimpleNamespace(R_measured=SimpleNamespace(value=1.0), V_dead_v=1.0)
    for chosen, enough, expected in (
        (SPEED_EFFORTS[0], True, [SPEED_EFFORTS[0]]),
        (SPEED_EFFORTS[0], False, [SPEED_EFFORTS[0], effort.ALL_SPEEDS]),
        (effort.ALL_SPEEDS, False, [effort.ALL_SPEEDS]),
    ):
        ran.clear()
        stage = SpeedStage(drive, Limits(10.0, 12.0, 300.0, 150.0), lambda *kept: None, lambda text: None, chosen)
        stage.measure(resistance, encoder, (1e-3, 1e-3), lambda good=enough: good)
        assert ran == expected


# ---- what is asked and what is said -------------------------------------------------------------------------


def test_a_request_keeps_its_accuracy_and_one_without_its_bytes() -> None:
    asked = IdentifyRequest(accuracy=0.01)
    assert parse_request(dump_request(asked), where="run").accuracy == 0.01
    assert "accuracy" not in json.loads(dump_request(IdentifyRequest()))
    assert parse_request(dump_request(IdentifyRequest()), where="run").accuracy is None


def test_an_accuracy_of_nothing_that_has_one_is_refused() -> None:
    with pytest.raises(ConfigError, match="--accuracy"):
        IdentifyRequest(quantities=("poles",), accuracy=0.01).check()
    with pytest.raises(NotAvailable):
        IdentifyRequest(quantities=("R", "poles"), accuracy=0.01, shaft="locked").check()


def test_with_replay_the_run_decides(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(("identify", "--replay", str(tmp_path), "--accuracy", "0.01")) == ExitCode.USAGE
    assert "that of the run" in capsys.readouterr().err


def test_a_value_that_is_not_there_is_not_reached() -> None:
    found = {"R_s_ohm": Estimate(2.0, 0.002, 0.1, "ohm", dof=math.inf)}
    facts = accuracy_facts(0.01, ("R", "psi"), found, {})
    assert facts["R_s_ohm"]["reached"] and facts["R_s_ohm"]["statistical_95"] == pytest.approx(0.00196, rel=1e-3)
    assert accuracy_facts(0.01, ("R",), found, {"R": "2 levels"})["R_s_ohm"]["left_out"] == "2 levels"
    assert facts["psi_f_wb"] == {"asked": 0.01, "statistical_95": None, "reached": False}
    assert accuracy_line(facts).endswith("R_s 0.2 %, psi_f no value; not reached: psi_f")
    assert accuracy_facts(None, ("R",), found, {}) == {} and accuracy_line({}) == ""
