# SPDX-License-Identifier: MIT
"""`commission` on a drive that identifies its machine by itself: what is measured, taken over and refused."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest

from pmsmtool.bus.connection import Connection
from pmsmtool.commissioning.commission import Commissioning, begin_run
from pmsmtool.commissioning.level_stages import LevelStages
from pmsmtool.commissioning.report_page import report_page, verdict
from pmsmtool.design.tolerance import tolerance_box
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.vendor_tuning import VendorDrive
from pmsmtool.drive_maps.drive_map import DriveMap
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import Contradiction, LimitExceeded
from pmsmtool.identification.request import IdentifyRequest
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.measurement import by_pulses
from pmsmtool.measurement.capabilities import Capabilities, CapabilityLevel, examine
from pmsmtool.measurement.identify import open_for_level
from pmsmtool.proof.stage import ProofRequest
from pmsmtool.run_directory import RunDirectory, Stage
from pmsmtool.sim.bus import PmsmSimBus
from tests.commissioning.audience import Quiet, Told
from tests.measurement.vendor_rig import PROFILE, TRUTH, channel, without_torque

pytestmark = [pytest.mark.chain, pytest.mark.usefixtures("undrawn")]


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PMSMTOOL_HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)


@contextmanager
def begun(
    folder: Path, drive_map: DriveMap, *, set_up: int = 0
) -> Iterator[tuple[RunDirectory, CanopenDrive, Capabilities]]:
    """A run on a simulated drive with this map; ``set_up`` leaves other pole pairs in it."""
    with Connection(PmsmSimBus(channel(folder, drive_map))) as connection:
        probe = VendorDrive(connection, 1, drive_map=drive_map)
        if set_up:
            probe.write({"motor.pole_pairs": set_up})
        found = examine(probe.node, drive_map)
        probe.close()
        drive = open_for_level(connection, 1, found)
        yield begin_run(drive, folder / "runs", level=found.level), drive, found
        drive.close()


def first_stage(folder: Path, drive_map: DriveMap, *, set_up: int = 0) -> tuple[Stage, RunDirectory]:
    """Identification alone, as commission asks for it."""
    with begun(folder, drive_map, set_up=set_up) as (run, drive, found):
        stages = LevelStages(run, drive, found, load_machine_file(PROFILE))
        return stages.identify(IdentifyRequest(), lambda lines: None, lambda text: None), run


def chain(
    folder: Path, drive_map: DriveMap, *, sheet: bool = True, pole_pairs: int = 3
) -> tuple[RunDirectory, Quiet, CapabilityLevel]:
    """The whole chain, with a data sheet that may be another machine's."""
    nameplate = load_machine_file(PROFILE)
    nameplate = replace(nameplate, machine=replace(nameplate.machine, pole_pairs=pole_pairs))
    progress = Quiet()
    with begun(folder, drive_map) as (run, drive, found):
        Commissioning(
            run, drive, Told(), progress, nameplate if sheet else None, identify=IdentifyRequest(),
            prove=ProofRequest(runs=32), capabilities=found,
        ).carry_out()  # fmt: skip
    return run, progress, found.level


def test_commission_of_the_vendor_level_ends_green_with_what_it_gives(tmp_path: Path) -> None:
    run, progress, level = chain(tmp_path, without_torque(load_family("synapticon")))
    assert level is CapabilityLevel.VENDOR
    assert progress.ended["identify"] == progress.ended["lut"] == "pass"
    assert set(progress.ended.values()) == {
        "pass",
        "not available",
    }  # what a closed drive leaves open has its own tests
    found = verdict(run.path)
    assert found.word == "PARTIAL" and found.simulated
    assert "NOT CHECKED (the drive's own measurement, without an interval): pole pairs, R" in found.headline
    machine = load_machine_file(run.path / "machine.toml")
    assert machine.estimates["psi_f_wb"].source == "vendor" and "psi_f_wb" not in machine.std
    assert machine.machine.J_kgm2 == TRUTH.J_kgm2  # given: nothing pushed the shaft
    assert "L_d_h" not in machine.estimates  # one inductance for both axes
    notes = tolerance_box(machine).notes
    assert "R_s_ohm: the drive's own value has no interval, 3 % assumed" in notes
    page = report_page(run.path)
    assert "the drive&#39;s own: " in page and ">none</td>" in page


def test_without_a_data_sheet_the_drives_values_are_told_and_nothing_is_designed(tmp_path: Path) -> None:
    run, progress, _ = chain(tmp_path, without_torque(load_family("synapticon")), sheet=False)
    assert progress.ended["identify"] == "pass" and progress.ended["tune"] == "not available"
    assert "needs L_d_h, L_q_h" in run.read().stage("tune").note  # type: ignore[union-attr]


def test_measured_values_outrank_the_drives_own(tmp_path: Path) -> None:
    """Standard level: J and psi by torque pushes, the rest by the drive; psi of both is compared."""
    stage, run = first_stage(tmp_path, load_family("synapticon"))
    assert stage.status == "pass"
    by_name = {str(value["name"]): value for value in stage.values}
    assert "std" in by_name["psi_f_wb"] and by_name["R_s_ohm"]["source"] == "vendor"
    assert any(line.startswith("psi_f_wb: the drive's own value is") for line in stage.fallbacks)
    machine = load_machine_file(run.path / "machine.toml")
    assert machine.machine.J_kgm2 == pytest.approx(TRUTH.J_kgm2, rel=0.16), "0x6075 may be peak or rms"
    assert machine.estimates["psi_f_wb"].source == "pmsmtool" and machine.estimates["R_s_ohm"].source == "vendor"
    assert "vendor: R_s_ohm, pole_pairs; as given: L_d_h, L_q_h" in str(machine.provenance["source"])


def test_a_limit_that_ends_the_pulses_does_not_take_the_drives_own_values_along(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    exceeded = LimitExceeded("speed", 520.0, 500.0, "rpm")
    monkeypatch.setattr(by_pulses, "push_by_torque", Mock(side_effect=exceeded))
    with pytest.raises(LimitExceeded):
        first_stage(tmp_path, load_family("synapticon"))
    (folder,) = (tmp_path / "runs").iterdir()
    (*_, stage) = RunDirectory(folder).read().stages
    assert stage.status == "refused" and "speed 520 rpm is outside" in stage.note
    assert {"R_s_ohm", "pole_pairs", "psi_f_wb"} <= {value["name"] for value in stage.values}


def test_a_drive_set_to_other_pole_pairs_is_not_pushed(tmp_path: Path) -> None:
    stage, _ = first_stage(tmp_path, load_family("synapticon"), set_up=4)
    assert stage.status == "pass"
    assert any("is set to 4 pole pairs, measures 3" in line for line in stage.fallbacks)
    assert not any("std" in value for value in stage.values)


def test_a_data_sheet_of_another_machine_is_seen(tmp_path: Path) -> None:
    with pytest.raises(Contradiction, match="pole_pairs: the data sheet states 4, measured 3"):
        chain(tmp_path, without_torque(load_family("synapticon")), pole_pairs=4)
