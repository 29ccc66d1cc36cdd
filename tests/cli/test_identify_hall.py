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
