# SPDX-License-Identifier: MIT
"""The first power-on, typed: what is done to a simulated drive is the first wrong row, and the drive is restored."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pmsmtool.commissioning.first_check import fault_row
from pmsmtool.identification.wiring import WRONG, judge_supply
from pmsmtool.machine.machine_file import dump_machine_file, load_machine_file, machine_path
from pmsmtool.refusals import refuse
from tests.cli.conftest import Tool

STATED = "interior-2k2"
"""3 pole pairs; a drive from the factory holds 4."""


def checked(tool: Tool, extra: str) -> tuple[int, dict[str, tuple[str, str]], str]:
    Path("sheet.toml").write_text(dump_machine_file(load_machine_file(machine_path(STATED))), encoding="utf-8")
    text = dump_machine_file(load_machine_file(machine_path(STATED)))
    extra, _, level = extra.partition("&")
    lines = text.splitlines()
    at = lines.index("[simulation]") + 1
    rest = [line for line in lines[at:] if line.partition(" ")[0] != extra.partition(" ")[0]]
    Path("drive.toml").write_text("\n".join([*lines[:at], extra, *rest]), encoding="utf-8")
    channel = f"drive.toml?nv=:memory:&{level}".rstrip("&")
    code, out, told = tool("-i", "pmsmsim", "-c", channel, "check", "sheet.toml", "--yes", "--json")
    rows = json.loads(out)["findings"]
    return code, {row["looked_at"]: (row["verdict"], row["shown"]) for row in rows}, told


@pytest.mark.chain
@pytest.mark.parametrize(
    ("extra", "wrong"),
    [
        ("encoder_bits = 17", ""),
        ('phase_open = "b"', "phases"),
        ("leads_swapped = true", "encoder sign"),
        ("pole_pairs = 4&level=inject", "pole pairs"),  # without averages: every check ended with exit code 4
        ('rotor = "locked"', "shaft"),
        ("U_dc_v = 300.0", "supply"),
        ("encoder_bits = 15", "encoder counts"),
        ("load_nm = 4.0", "shaft"),
        ('drive_fault = "phases_shorted"', "phases"),
        ('drive_fault = "safe_torque_off"', "safe torque off"),
        ('drive_fault = "supply_limit"', "supply"),
        ('hall_order = "abc"', ""),
        ('hall_order = "bac"', "Hall wires"),
        ('hall_order = "abc"\nleads_swapped = true', "encoder sign"),
    ],
)
def test_the_first_wrong_row_is_what_was_done(extra: str, wrong: str, tool: Tool) -> None:
    code, rows, told = checked(tool, extra)
    assert [name for name, (verdict, _) in rows.items() if verdict == "WRONG"][:1] == ([wrong] if wrong else []), rows
    assert code == (1 if wrong else 0)
    assert "duration  at most 15 s" in told and "travel    450 deg" in told
    assert ("voltage off, drive restored" in told) == (extra != "U_dc_v = 300.0")
    assert ("input is open; the DC link has 540 V" in told) == ("safe_torque_off" in extra)


@pytest.mark.chain
def test_swapped_leads_come_before_pole_pairs_that_the_drive_alone_states(tool: Tool) -> None:
    """Without MACHINE, a drive from the factory states 4 pole pairs of a machine of 3: its leads were named last."""
    channel = f"{STATED}?leads_swapped=true&nv=:memory:"
    code, out, told = tool("-i", "pmsmsim", "-c", channel, "check", "--yes", "--json")
    wrong = [row["looked_at"] for row in json.loads(out)["findings"] if row["verdict"] == WRONG]
    assert code == 1 and wrong == ["encoder sign", "pole pairs"]
    first = told.index("not good: encoder sign: counts against the phase order")
    assert first < told.index("wrong, too: pole pairs") < told.index("likely: two motor leads swapped")


def test_the_file_of_another_motor_is_among_the_causes() -> None:
    """A 48 V motor's file at a drive of 540 V: `identify` named the amplitude alone, and `check` the supply."""
    assert "the file of another motor" in judge_supply(540.0, None, 48.0).likely
    assert judge_supply(2.0, None, 48.0).likely == "supply off, or set to another voltage"
    error = refuse("E_SNR", "too wide", stage="plan")
    assert "the machine file of another motor" in error.likely and "`pmsmtool check MACHINE`" in error.hint


def test_nothing_moves_without_consent(tool: Tool) -> None:
    code, out, told = tool("-i", "pmsmsim", "-c", STATED, "check")
    assert code == 7 and not out and "current   at most 1.216 Apk" in told


@pytest.mark.parametrize(
    ("what", "about"),
    [
        ("the drive is in fault 0x2320: current, device output side", "phases"),
        ("emergency 0x3220 (DC-link under-voltage), register 0x04", "supply"),
        ("the drive is in fault 0x7305: encoder fault", "encoder counts"),
        ("the drive stays in SWITCH ON DISABLED and does not enable", "safe torque off"),
        ("the drive is in fault 0x8611: following error", "shaft"),
    ],
)
def test_a_fault_is_about_what_its_class_says(what: str, about: str) -> None:
    row = fault_row(what, "")
    assert (row.looked_at, row.verdict) == (about, WRONG) and row.shown == what and row.likely
    assert fault_row(what, "a cause").likely == "a cause"
