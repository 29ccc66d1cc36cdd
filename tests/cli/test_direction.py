# SPDX-License-Identifier: MIT
"""A reversed encoder and two swapped leads, on every level of drive: found, taken over, and no fault on the way.

The rotor stands far from the encoder's zero: a speed estimate that meets the new sign there sees it jump by two turns.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from pmsmtool.machine.key import Value
from pmsmtool.machine.machine_file import dump_machine_file, load_machine_file, machine_path
from pmsmtool.sim.simulated_machine import settings_of
from tests.cli.conftest import Tool

pytestmark = pytest.mark.chain

START_RAD = 1.0
"""Mechanical angle at the start; with the estimate's default bandwidth a jump by twice of it is above any trip."""
CASES: dict[str, dict[str, Value]] = {
    "encoder": {"encoder_reversed": True},
    "leads": {"leads_swapped": True},
    "both": {"encoder_reversed": True, "leads_swapped": True},
}
LEVELS = {
    "full": ("", ("poles", "L", "--accuracy", "0.02")),
    "inject": ("&level=inject", ("poles", "L")),
    "recorder": ("&level=recorder", ("psi",)),
    "standard": ("&drive=cia402", ("encoder", "poles")),
}
"""Channel, and the shortest of what this level measures after the direction is known."""
OFFSET_OFF_RAD = math.radians(2.0)


@pytest.mark.parametrize(
    ("case", "level"),
    [
        ("encoder", "full"),
        ("leads", "recorder"),
        ("leads", "standard"),
        ("both", "standard"),
    ],
)
def test_found_and_taken_over_without_a_fault(case: str, level: str, tool: Tool) -> None:
    base = load_machine_file(machine_path("interior-2k2"))
    wrong = {**CASES[case], "theta_M_start_rad": START_RAD, "encoder_offset_rad": 0.8}
    drive = replace(base, simulation={**base.simulation, **wrong})
    Path("drive.toml").write_text(dump_machine_file(drive), encoding="utf-8")
    options, quantities = LEVELS[level]
    channel = f"drive.toml?nv=:memory:{options}"
    code, out, err = tool("identify", *quantities, "-i", "pmsmsim", "-c", channel, "--yes", "--json")
    assert code == 0, err
    found = {value["name"]: value.get("value") for value in json.loads(out)["values"]}
    truth = settings_of(drive)
    assert ("psi" not in quantities) or found["psi_f_wb"] == pytest.approx(base.machine.psi_f_wb, rel=0.015)
    assert ("L" not in quantities) or found["L_q_h"] == pytest.approx(base.machine.L_q_h, rel=0.015)
    if "poles" in quantities:
        (folder,) = Path("runs").iterdir()
        assert found["pole_pairs"] == base.machine.pole_pairs
        if level != "standard":  # whose chain has no whole machine file
            encoder = load_machine_file(folder / "machine.toml").encoder
            assert encoder.direction == (-1 if truth.flag("encoder_reversed") else 1)
            assert ("against the phase order" in (folder / "run.json").read_text()) == (encoder.direction < 0)
    if "encoder" in quantities:
        assert found["direction"] == (-1 if truth.flag("encoder_reversed") else 1)
        off = math.remainder(found["offset_rad"] - truth.number("encoder_offset_rad"), 2.0 * math.pi)
        assert abs(off) < OFFSET_OFF_RAD
