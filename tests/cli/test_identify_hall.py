# SPDX-License-Identifier: MIT
"""``identify hall`` on a simulated drive: swapped wires are named, and a drive without sensors is refused."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from pmsmtool.machine.key import Value
from pmsmtool.machine.machine_file import dump_machine_file, load_machine_file
from tests.cli.conftest import Tool


def drive(folder: Path, **halls: Value) -> str:
    base = load_machine_file("jercic-2017")
    path = folder / "drive.toml"
    path.write_text(dump_machine_file(replace(base, simulation={**base.simulation, **halls})), encoding="utf-8")
    return f"{path}?nv=:memory:"


@pytest.mark.chain
def test_swapped_wires_are_named(tool: Tool, tmp_path: Path) -> None:
    sim = drive(tmp_path, hall_order="bac", hall_offset_rad=0.2, hall_error_c_rad=0.15)
    code, printed, said = tool("identify", "hall", "--sim", sim, "--yes", "--json")
    assert code == 0, said
    found = json.loads(printed)
    assert found["order"] == "bac" and "Hall wires 1 and 2 are swapped" in said
    assert math.degrees(abs(found["offset_rad"] - 0.25)) < 2.0  # measured 0.2
    assert "voltage off, drive restored" in said and (Path(found["run"]) / "traces" / "hall.npz").is_file()


@pytest.mark.chain
def test_a_drive_without_encoder_commutates_by_what_was_found(tool: Tool, tmp_path: Path) -> None:
    """Any axes let a current vector turn the rotor; with those that are found the drive turns with it."""
    base = drive(tmp_path, encoder_kind="none", hall_order="bca", hall_offset_rad=0.2, hall_error_a_rad=0.15)
    sim = ("--sim", base.replace(":memory:", str(tmp_path / "drive.nv")), "--yes")
    code, printed, _ = tool("check", *sim, "--json")
    assert code != 0 and "0x7305" in printed, "without commutation there is no angle"
    assert tool("param", "set", "--store", "hall.commutation=2", *sim)[0] == 0
    code, printed, said = tool("identify", "hall", *sim, "--json")
    assert code == 0, said
    found = json.loads(printed)
    command = next(line for line in said.splitlines() if "pmsmtool param set" in line)
    assert tool("param", "set", "--store", *command.split("param set ")[1].split(), *sim)[0] == 0
    truth = [0.2 + 2.0 * math.pi / 3.0 * k + (0.15 if k == 0 else 0.0) for k in (1, 2, 0)]
    for axis, true in zip((found[f"hall.axis_{k}_rad"] for k in (1, 2, 3)), truth, strict=True):
        assert math.degrees(abs(math.remainder(axis - true, 2.0 * math.pi))) < 3.0  # measured 1.1
    code, printed, _ = tool("check", *sim, "--json")
    rows = {row["looked_at"]: row for row in json.loads(printed)["findings"]}
    assert rows["Hall wires"]["verdict"] == "ok" and "from hall.axis_1_rad" in rows["Hall wires"]["shown"]
    code, printed, said = tool("identify", "poles", *sim, "--json")
    assert code == 0, said
    encoder = load_machine_file(next(tmp_path.glob("runs/*/machine.toml"))).encoder
    assert encoder.hall_commutation == 2 and encoder.hall_axis_2_rad == pytest.approx(
        found["hall.axis_2_rad"], abs=1e-4
    )
    code, printed, said = tool("identify", "mechanics", *sim)
    assert code == 9 and "needs an encoder" in said
