# SPDX-License-Identifier: MIT
"""`tune --axis` from the command line, and its gains in a simulated EPOS4: written, read back, and compared again."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from pmsmtool.design.design_file import design_text, load_design
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.flash.journal import read_snapshot, write_snapshot
from pmsmtool.machine.datasheet import CONVERSION
from pmsmtool.machine.machine_file import dump_machine_file, load_machine_file
from pmsmtool.machine.parameters import Estimate
from pmsmtool.run_directory import RunDirectory, Stage, new_record
from tests.cli.conftest import Tool

DRIVE = ("--map", "epos4", "--sim", "interior-2k2?drive=epos4&nv=axis.nv")


@pytest.mark.chain
def test_gains_of_the_axis_reach_the_drive(tool: Tool, tmp_path: Path) -> None:
    code, printed, _ = tool("tune", "interior-2k2", "-o", "axis.toml", "--axis", "--map", "epos4", "--json")
    assert code == 0
    made = json.loads(printed)
    assert made["schema"] == "pmsmtool.tune.axis/1" and made["not_written"] == {}
    assert made["loops"]["axis_position"]["phase_margin_deg"] >= 45.0
    assert made["facts"]["axis_position_S_peak_db"] <= 6.0
    assert "current.K_p_q_v_per_a" not in made["values"]
    for source in ("axis.toml", "axis.params.toml"):
        code, _, said = tool("flash-params", source, *DRIVE, "--yes")
        assert code == 0, said
        # the second file is the first one's set: nothing is left to write
        assert ("12 of 12 objects change" in said) is (source == "axis.toml")
    assert tool("verify", "axis.params.toml", *DRIVE)[0] == 0
    # what the drive holds now is as good as what is designed, and the factory's gains are worse
    assert tool("backup", "-o", "stored.json", *DRIVE)[0] == 0
    again = ("tune", "interior-2k2", "-o", "again.toml", "--axis", "--stored", "stored.json", "--json", "--map")
    code, printed, said = tool(*again, "epos4")
    facts = json.loads(printed)["facts"]
    assert facts["axis_stored_gains"] == "as designed" and "holds the designed gains already" in said
    snapshot = read_snapshot(Path("stored.json"))
    assert snapshot.current_limit_apk is not None and "current limit is not known" not in said
    write_snapshot(Path("low.json"), replace(snapshot, current_limit_apk=1.2))
    code, printed, said = tool(*(word.replace("stored.json", "low.json") for word in again), "epos4")
    low = json.loads(printed)["facts"]
    assert low["axis_acceleration_rad_s2"] < 0.2 * facts["axis_acceleration_rad_s2"] and "the move is for that" in said
    assert code == 0 and facts["axis_stored_error_rad"] == pytest.approx(facts["axis_error_rad"], rel=0.05)
    code, _, said = tool(*again, "ingenia")
    assert code == 2 and "not of a drive of the map" in said
    # a gain in amperes is as many N m as the drive's torque per ampere says, which no snapshot holds: bytes go back
    code, _, said = tool("restore", *DRIVE, "--yes")
    assert code == 0 and "12 of 12 objects change" in said and "-> 0x0003F5A1" in said, said
    assert tool("verify", "axis.params.toml", *DRIVE)[0] == 1


@pytest.mark.chain
def test_an_axis_of_a_run_is_compared_with_what_the_run_flashed(tool: Tool, tmp_path: Path) -> None:
    """Gains that follow better than those of the axis were in the drive, and nothing said so."""
    source = load_machine_file("interior-2k2")
    estimate = Estimate(source.machine.J_kgm2 or 0.0, 1e-5, 0.0, "kg m2", method=CONVERSION)
    made = tune(replace(source, estimates={"J_kgm2": estimate}), TuneRequest(eps=0.05))
    run = RunDirectory.create(tmp_path, 1, new_record(["test"], drive={}, bus={}, versions={}, operator="nobody"))
    run.save("design.toml", design_text(made))
    run.save("machine.toml", dump_machine_file(made.machine))
    for status, compared in (("fail", False), ("pass", True)):
        run.add(Stage("flash", status, 1.0))
        code, _, said = tool("tune", str(run.path), "-o", "axis.toml", "--axis")
        assert code == 0 and ("--stored compares them" in said) is not compared
        assert ("axis_stored_gains" in load_design(Path("axis.toml")).facts) is compared
        assert (load_design(Path("axis.toml"))["governor.eps"] == 0.05) is compared  # the rest of the set stays
        assert "as given, not measured: of the motor alone" in said


def test_a_drive_without_units_gets_a_table_and_exit_code_10(tool: Tool) -> None:
    code, printed, said = tool("tune", "interior-2k2", "-o", "axis.toml", "--axis", "--map", "faulhaber")
    assert code == 10 and "axis_K_v_per_s" in printed
    assert "0x2331:01 or 0x60F9:01" in said and "map learn" in said


def test_a_set_without_any_object_is_not_stored(tool: Tool) -> None:
    """Storing keeps what others left in the drive, and a reset loses its homing: both for nothing."""
    drive = ("--map", "nanotec", "--sim", "interior-2k2?drive=nanotec&nv=axis.nv", "--yes")
    assert tool("tune", "interior-2k2", "-o", "axis.toml", "--axis", "--map", "nanotec")[0] == 10
    code, _, said = tool("flash-params", "axis.toml", *drive)
    assert code == 9 and "no object for any value of the set" in said and "storing" not in said


def test_a_rate_without_the_axis_is_refused(tool: Tool) -> None:
    code, _, said = tool("tune", "interior-2k2", "-o", "design.toml", "--loop-rate-hz", "1000")
    assert code == 2 and "--axis" in said
