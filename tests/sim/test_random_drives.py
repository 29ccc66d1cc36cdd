# SPDX-License-Identifier: MIT
"""Random drives follow from their seed, are valid machine files, and stay inside the declared ranges."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from benchmarks.random_drives import (
    CATALOGUE_SHARE,
    data_sheet,
    draw_around,
    draw_drive,
    true_loop_resistance,
)
from benchmarks.whole_commission import fill_memory
from pmsmtool.bus.connect import connect
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.files import data_folder
from pmsmtool.machine.machine_file import dump_machine_file, load_machine_file, parse_machine
from pmsmtool.sim.simulated_machine import device_slope_ohm, settings_of


@pytest.mark.parametrize("seed", range(40))
def test_a_drawn_drive_is_a_valid_machine_file(seed: int) -> None:
    drive = draw_drive(seed, ("ideal", "timing", "gains")[seed % 3])
    text = dump_machine_file(drive)
    assert parse_machine(text) == drive
    assert dump_machine_file(draw_drive(seed, ("ideal", "timing", "gains")[seed % 3])) == text


def test_the_population_spans_its_ranges() -> None:
    drives = [draw_drive(seed) for seed in range(200)]
    resistive = [d.machine.R_s_ohm * (d.machine.I_nom_apk or 0) for d in drives]
    emf = [d.machine.psi_f_wb * (d.machine.n_nom_rpm or 0) * math.pi / 30 * d.machine.pole_pairs for d in drives]
    shares = [r / e for r, e in zip(resistive, emf, strict=True)]
    assert min(shares) >= 0.02 and max(shares) <= 0.12 and max(shares) - min(shares) > 0.09
    saliency = [d.machine.L_q_h / d.machine.L_d_h for d in drives]
    assert min(saliency) >= 1.0 and max(saliency) <= 2.2
    assert {d.inverter.U_dc_v for d in drives} == {24.0, 48.0, 325.0, 560.0}
    hard = [d for d in drives if _dead_voltage(d) > 3 * d.machine.R_s_ohm * (d.machine.I_nom_apk or 0)]
    assert hard, "some drives must have a dead-time voltage above three times R I"


def _dead_voltage(drive) -> float:  # type: ignore[no-untyped-def]
    return drive.inverter.U_dc_v * drive.inverter.dead_time_s / drive.inverter.T_s


def test_only_the_truth_changes_around_a_machine() -> None:
    base = load_machine_file(data_folder("profiles") / "jercic-2017.toml")
    drive = draw_around(base, 3)
    assert drive.machine == base.machine
    truth = drive.simulation_settings()
    assert truth["R_s_ohm"] != base.machine.R_s_ohm
    assert true_loop_resistance(drive) == truth["R_s_ohm"]


def test_directions_and_temperatures_are_drawn() -> None:
    truths = [draw_drive(seed).simulation for seed in range(200)]
    for key in ("encoder_reversed", "leads_swapped"):
        assert 70 < sum(bool(truth[key]) for truth in truths) < 130
    temperatures = [float(str(truth["T_winding_c"])) for truth in truths]
    assert 5.0 <= min(temperatures) < 10.0 and 85.0 < max(temperatures) <= 90.0


def test_a_data_sheet_is_within_its_tolerances_and_tells_no_truth() -> None:
    for key, share in CATALOGUE_SHARE.items():
        off = []
        for seed in range(100):
            drive = draw_drive(seed)
            sheet = data_sheet(drive, seed)
            assert not sheet.simulation and sheet.machine.pole_pairs == drive.machine.pole_pairs
            truth = getattr(drive.machine, key)
            if key == "R_s_ohm":  # a catalogue's is the winding's
                truth -= device_slope_ohm(settings_of(drive))
                assert sheet.machine.R_winding_ohm == sheet.machine.R_s_ohm
            off.append(getattr(sheet.machine, key) / truth - 1.0)
        assert -share <= min(off) < -0.9 * share and 0.9 * share < max(off) <= share


def test_a_memory_that_holds_another_motor_is_what_the_drive_starts_with(tmp_path: Path) -> None:
    drive, other = draw_drive(1), draw_drive(2)
    (tmp_path / "drive.toml").write_text(dump_machine_file(drive), encoding="utf-8")
    fill_memory(tmp_path / "held.nv", drive, other)
    with connect("pmsmsim", f"{tmp_path / 'drive.toml'}?nv={tmp_path / 'held.nv'}") as connection:
        opened = CanopenDrive(connection, 1)
        assert opened.read("motor.psi_f_wb") == pytest.approx(other.machine.psi_f_wb)
        assert opened.read("motor.I_nom_apk") == pytest.approx(drive.machine.I_nom_apk)
        assert opened.read("encoder.reversed") == settings_of(other).flag("encoder_reversed")
        opened.close()
