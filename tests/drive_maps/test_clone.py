# SPDX-License-Identifier: MIT
"""``sim clone``: the simulated image of a drive holds its machine, its parameters and its data sheet."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from pmsmtool.bus.connect import connect
from pmsmtool.cli.main import cli
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.parameters import DriveParameters
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.estimators.estimate import total_half_width
from pmsmtool.files import data_folder
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file, load_machine_file
from pmsmtool.machine.parameters import Estimate
from pmsmtool.measurement.clone import drawn_truth


def run(*arguments: str) -> Result:
    outcome = CliRunner().invoke(cli, [*arguments])
    assert outcome.exit_code == 0, outcome.exception
    return outcome


@pytest.fixture
def identified(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A machine file as identification leaves it, other than the profile behind the drive."""
    monkeypatch.chdir(tmp_path)
    base = load_machine_file(data_folder("profiles") / "interior-2k2.toml")
    machine = replace(base.machine, R_s_ohm=1.23, psi_f_wb=0.31)
    estimates = {
        "R_s_ohm": Estimate(1.23, 0.01, 0.02, "ohm", n=12),
        "psi_f_wb": Estimate(0.31, 1e-4, 3e-3, "Wb", n=8),
    }
    encoder = replace(base.encoder, offset_rad=-0.7)
    found = replace(base, machine=machine, estimates=estimates, encoder=encoder, simulation={})
    path = tmp_path / "machine.toml"
    path.write_text(dump_machine_file(found), encoding="utf-8")
    return path


@pytest.mark.chain
def test_the_clone_of_the_reference_drive(identified: Path) -> None:
    outcome = run("--sim", "interior-2k2?nv=:memory:", "sim", "clone", str(identified), "-o", "twin.toml", "--json")
    assert json.loads(outcome.stdout)["files"] == ["twin.toml", "twin.params.toml", "twin.eds"]
    settings = load_machine_file(Path("twin.toml")).simulation_settings()
    assert (settings["R_s_ohm"], settings["psi_f_wb"], settings["encoder_offset_rad"]) == (1.23, 0.31, -0.7)
    assert settings["serial"] == 22001
    assert Path("twin.eds").read_bytes().startswith(b"[FileInfo]")
    # the clone runs, and takes the parameters of the drive it was made from
    run("--sim", "twin.toml?nv=twin.nv", "--yes", "flash-params", "twin.params.toml")
    run("--sim", "twin.toml?nv=twin.nv", "verify", "twin.params.toml")


@pytest.mark.chain
def test_the_clone_can_be_identified(identified: Path) -> None:
    """Its current sensors are noisy, although nothing in the machine file says so; without noise it was refused."""
    run("--sim", "interior-2k2?nv=:memory:", "sim", "clone", str(identified), "-o", "twin.toml")
    settings = load_machine_file(Path("twin.toml")).simulation_settings()
    assert settings["sensor_noise_apk"] == 18.0 / 2048  # 1.5 I_max over half the counts of 12 bits
    outcome = run("--sim", "twin.toml?nv=:memory:", "--yes", "identify", "R", "--json")
    (R,) = (value for value in json.loads(outcome.stdout)["values"] if value["name"] == "R_s_ohm")
    assert R["value"] == pytest.approx(1.23, abs=R["total_95"])


def test_the_clone_of_another_family_shows_its_dictionary(identified: Path) -> None:
    family = load_family("epos4")
    with connect("pmsmsim", "interior-2k2?nv=real.nv&drive=epos4") as connection:
        node = DriveNode(connection, 1, drive_map=family)
        DriveParameters(node).replace({"current.K_p_q_v_per_a": (7_654_321).to_bytes(4, "little")})
        node.identity()
        node.store()
        node.close()
    outcome = run("--sim", "interior-2k2?nv=real.nv&drive=epos4", "sim", "clone", str(identified), "-o", "twin.toml")
    assert "twin.toml?drive=epos4" in outcome.stdout
    assert not Path("twin.eds").exists()  # an EPOS4 has no stored data sheet here
    text = Path("twin.params.toml").read_text(encoding="utf-8")
    assert "7.654321" in text
    outcome = run("--sim", "twin.toml?nv=:memory:&drive=epos4", "info", "--json")
    assert json.loads(outcome.stdout)["identity"]["serial"] == 22001


def test_a_draw_stays_within_what_was_found(identified: Path) -> None:
    found: MachineFile = load_machine_file(identified)
    assert drawn_truth(found, None)["R_s_ohm"] == 1.23
    draws = [drawn_truth(found, seed) for seed in range(400)]
    assert draws[0] == drawn_truth(found, 0) and draws[0] != draws[1]
    for name in ("R_s_ohm", "psi_f_wb"):
        estimate = found.estimates[name]
        off = [(float(draw[name]) - estimate.value) / total_half_width(estimate) for draw in draws]
        inside = sum(abs(x) <= 1.0 for x in off) / len(off)
        assert 0.91 < inside < 0.985  # 95 %, binomial at 400
        assert abs(math.fsum(off) / len(off)) < 0.1
    assert {draw["L_d_h"] for draw in draws} == {found.machine.L_d_h}  # no estimate: nothing to draw from
