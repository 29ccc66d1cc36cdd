# SPDX-License-Identifier: MIT
"""The chain on drives of every level and mapped family: partial, and each stage that did not run with its reason."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
from click.testing import CliRunner

from pmsmtool.bus.connect import Connection
from pmsmtool.cli.main import cli
from pmsmtool.commissioning.commission import Commissioning, begin_run, due_stages
from pmsmtool.commissioning.design_stages import LIMITS, NAMES, NO_BANDWIDTH, NO_INERTIA, why_no_limits
from pmsmtool.commissioning.level_stages import NO_STEPS, LevelStages
from pmsmtool.commissioning.report_page import NO_DATA_SHEET, report_page, verdict
from pmsmtool.design.closed_drive import RATED, SLOPE, SPEED, TORQUE
from pmsmtool.design.design_file import load_design
from pmsmtool.design.loops.designed_loops import lacking_gains
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.drive_node import DriveNode, is_safe
from pmsmtool.drive.parameters import DriveParameters
from pmsmtool.drive_maps.drive_map import DriveMap, reference_map
from pmsmtool.drive_maps.shipped_maps import family_names, load_family
from pmsmtool.errors import ConfigError, Contradiction, ExitCode, IdentificationError, LimitExceeded, NotAvailable
from pmsmtool.files import data_folder
from pmsmtool.identification.replay import replay
from pmsmtool.identification.request import REPLAYED, IdentifyRequest
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.measurement import by_pulses
from pmsmtool.measurement.by_injection import with_own_halls
from pmsmtool.measurement.capabilities import Capabilities, CapabilityLevel, examine, reference_capabilities
from pmsmtool.measurement.identify import SET_UP, open_for_level
from pmsmtool.papers.closed_drive import ClosedNode
from pmsmtool.params.parameter_set import read_parameter_set
from pmsmtool.proof.stage import ProofRequest
from pmsmtool.report.verdict import ENCODER_SIGN
from pmsmtool.run_directory import RunDirectory, Stage, new_record
from pmsmtool.sim import channel
from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.sim.node.factory import SET_UP_BANDWIDTH
from pmsmtool.sim.simulated_machine import with_simulation
from tests.commissioning.audience import Quiet, Told
from tests.foreign.data_sheets import nothing_for_motion

pytestmark = [pytest.mark.chain, pytest.mark.usefixtures("undrawn")]

PROFILE = data_folder("profiles") / "interior-2k2.toml"
INJECT_OFF = 2e-3
"""Largest error of an identified value on the inject level, of R ten times that. Seven seeds of the drive's noise: L at
most 0.09 %, psi_f 0.02 %, J 0.05 %, R 0.21 %."""
FEW = ProofRequest(runs=16)
"""The proof's own tests run all of its experiments."""
FOREIGN = [name for name in family_names() if name != "pmsmsim"]
SLOW = "&bitrate=125000"
"""A quarter of the readings of a torque pulse at 1 Mbit/s, for a chain whose test is not of their number."""
SLOWLY = IdentifyRequest(speed_max_rad_s=40.0)
"""Torque pulses of a quarter of their length, and no run-up to the voltage: where the pulses decide nothing."""
ASKED = IdentifyRequest()
UNTIL_KNOWN = IdentifyRequest(accuracy=0.01)
"""On the inject level every mean is read out as a record: no more of them than the values need."""
FILLED_IN = (0x1234, 0x5678)
"""Vendor and product a person writes into a map whose maker's numbers are in no source."""


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PMSMTOOL_HOME", str(tmp_path / "home"))


@contextmanager
def opened(options: str, given: DriveMap | None = None) -> Iterator[tuple[CanopenDrive, Capabilities]]:
    with Connection(PmsmSimBus(f"interior-2k2?nv=:memory:{options}")) as connection:
        node = DriveNode(connection, 1)
        found = examine(node, given)
        node.close()
        drive = open_for_level(connection, 1, found)
        yield drive, found
        drive.close()


def chain(
    run: RunDirectory, drive: CanopenDrive, found: Capabilities, *, sheet: bool = True, proof: ProofRequest = FEW,
    asked: IdentifyRequest = ASKED,
) -> tuple[Quiet, Told]:  # fmt: skip
    progress, person = Quiet(), Told()
    nameplate = load_machine_file(PROFILE) if sheet else None
    Commissioning(run, drive, person, progress, nameplate, asked, prove=proof, capabilities=found).carry_out()
    assert is_safe(drive.node.state())
    return progress, person


@pytest.fixture(scope="module")
def designed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of a drive that takes a rated current alone: its machine file is what was given."""
    with opened(f"&drive={nothing_for_motion(tmp_path_factory.mktemp('map'))}") as (drive, found):
        run = begin_run(drive, tmp_path_factory.mktemp("designed"), level=found.level)
        progress, _ = chain(run, drive, found)
    assert progress.ended == {
        "identify": "not available", "tune": "not available", "lut": "pass", "margins": "not available",
        "flash": "pass", "verify": "pass", "prove": "not available",
    }  # fmt: skip
    found_verdict = verdict(run.path)
    assert (found_verdict.word, found_verdict.kind) == ("PARTIAL", "partial") and found_verdict.simulated
    assert found_verdict.headline.startswith("SIMULATED DRIVE, PARTIAL: 3 of 7 stages ran")
    unchecked = ("pole pairs", "R", "L_d", "L_q", "psi", "J")
    assert f"NOT CHECKED (data sheet): {', '.join(unchecked)}" in found_verdict.headline
    limits = [line for line in run.read().stage("tune").fallbacks if line.startswith(LIMITS)]  # type: ignore[union-attr]
    assert limits == [f"{LIMITS}: not available: {why_no_limits(found.drive_map, None)}"] and SLOPE in limits[0]
    return run.path


def continued(designed: Path, folder: Path, drive: CanopenDrive, found: Capabilities) -> RunDirectory:
    """That run from its design on, as if this drive had been there from its beginning."""
    run = begin_run(drive, folder, level=found.level)
    for name in ("machine.toml", "nameplate.toml"):
        shutil.copy(designed / name, run.path)
    run.write(replace(run.read(), stages=RunDirectory(designed).read().stages[:1]))
    return run


def with_identity(drive_map: DriveMap) -> DriveMap:
    vendor, product = FILLED_IN
    return drive_map if drive_map.vendor else replace(drive_map, vendor=vendor, product=product)


@pytest.mark.parametrize("family", ["cia402", "copley", "elmo", "epos2", "epos4", "ingenia", "synapticon"])
def test_what_a_family_holds_is_shown_before_and_equal_after(
    family: str, designed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A map a person has completed with vendor and product: everything it has an object for, and nothing else.

    Families of one kind once: nanotec, faulhaber and synapticon have rows of the motor alone, elmo and zeroerr none.
    """
    drive_map = with_identity(load_family(family))
    monkeypatch.setattr(channel, "load_family", lambda name: drive_map)
    with opened(f"&drive={family}", drive_map) as (drive, found):
        assert found.map_is_drives
        run = continued(designed, tmp_path, drive, found)
        progress, person = chain(run, drive, found)
        mapped = bool(set(drive_map.cells) & set(read_parameter_set(run.path / "params.toml").values))
        assert progress.ended["flash"] == progress.ended["verify"] == ("pass" if drive_map.cells else "not available")
        assert progress.ended["prove"] == "not available"
        judged = "not available" if lacking_gains(drive_map.cells)["current"] else "pass"
        assert progress.ended["tune"] == progress.ended["margins"] == judged, (
            "loops of gains the drive takes, no others"
        )
        if mapped:
            held = drive_map.quantised(read_parameter_set(run.path / "params.toml"))
            assert all(DriveParameters(drive.node).read_value(name) == value for name, value in held.values.items())
            changes = [row for row in run.read().stage("flash").values if "held" in row]  # type: ignore[union-attr]
            for row in changes:
                line = next(line for line in person.shown if line.startswith(row["name"]))
                assert f"{row['held']:.7g}" in line
    found_verdict = verdict(run.path)
    assert found_verdict.word == "PARTIAL" and found_verdict.kind == "partial"
    assert any(line.startswith("prove: not available: the ") for line in found_verdict.lines)
    assert "behaviour not proven" in found_verdict.headline
    assert due_stages(run, run.read()) == ()  # a stage that is not available is not asked for again


@pytest.mark.parametrize("family", [name for name in FOREIGN if not load_family(name).vendor])
def test_nothing_is_moved_through_a_map_that_names_no_drive(family: str, designed: Path, tmp_path: Path) -> None:
    if family != "cia402":
        refused = pytest.raises(ConfigError, match="does not state whose drive it is for")
        with refused, opened(f"&drive={family}", load_family(family)):
            pytest.fail("a drive was opened through the map of nobody's drive")
        return
    with opened(f"&drive={family}", load_family(family)) as (drive, found):  # CiA 402 holds on every drive
        run = continued(designed, tmp_path, drive, found)
        progress, person = chain(run, drive, found)
    assert progress.ended["flash"] == "not available" and person.shown == []
    assert "needs a map" in run.read().stage("flash").note  # type: ignore[union-attr]


def test_one_pair_of_gains_is_the_smaller_of_both_axes(tmp_path: Path) -> None:
    """EPOS4 has one pair: the q gain of a machine with L_q > L_d would be too large for d; measured by pushes alone."""
    with opened("&drive=epos4" + SLOW) as (drive, found):
        run = begin_run(drive, tmp_path, level=found.level)
        progress, _ = chain(run, drive, found)
        assert progress.ended["identify"] == progress.ended["flash"] == "pass"
        design = load_design(run.path / "design.toml")
        pair = design["current.K_p_q_v_per_a"], design["current.K_p_d_v_per_a"]
        assert pair[0] == pair[1] and design.machine.machine.L_q_h > design.machine.machine.L_d_h
        assert DriveParameters(drive.node).read_value("current.K_p_q_v_per_a") == pytest.approx(pair[0], abs=1e-6)
    machine = load_machine_file(run.path / "machine.toml")
    truth = load_machine_file(PROFILE).machine
    assert machine.machine.J_kgm2 == pytest.approx(truth.J_kgm2, rel=0.16), "0x6075 may be peak or rms"
    assert machine.machine.R_s_ohm == truth.R_s_ohm and "R_s_ohm" not in machine.estimates
    assert "as given: pole_pairs, R_s_ohm" in str(machine.provenance["source"])
    assert "NOT CHECKED (data sheet): pole pairs, R, " in verdict(run.path).headline
    page = report_page(run.path)
    assert "<strong>SIMULATED DRIVE, PARTIAL: 6 of 7 stages ran" in page
    assert page.count(">as given</td>") == 4
    drawn = {value["name"]: value for value in run.read().stage("tune").values}  # type: ignore[union-attr]
    assert drawn["current.K_p_q_v_per_a"]["value"] == design["current.K_p_q_v_per_a"]
    assert design.loops["current_q"].phase_margin_deg > design.loops["current_d"].phase_margin_deg + 5.0


def test_a_drive_that_cannot_be_reflashed_is_kept_out_of_saturation_by_its_limits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Designed, written, read back; and with what the drive then holds no reference saturates it."""
    drive_map = with_identity(load_family("cia402"))
    monkeypatch.setattr(channel, "load_family", lambda name: drive_map)
    sheet = load_machine_file(PROFILE)
    hertz = SET_UP_BANDWIDTH / sheet.inverter.T_s / (2.0 * math.pi)
    assert why_no_limits(drive_map, None) == NO_BANDWIDTH
    with opened("&drive=cia402" + SLOW, drive_map) as (drive, found):
        run = begin_run(drive, tmp_path, level=found.level)
        progress, person = Quiet(), Told()
        chain = Commissioning(
            run, drive, person, progress, sheet, capabilities=found, drive_bandwidth_hz=hertz,
            accept_limits=NAMES,
        )  # fmt: skip
        chain.carry_out()
        held = {name: DriveParameters(drive.node).read_value(name) for name in drive_map.cells}
    assert set(progress.ended.values()) == {"pass", "not available"} and progress.ended["prove"] == "not available"
    design = load_design(run.path / "design.toml")
    assert set(held) == {RATED, SLOPE, TORQUE, SPEED}
    for name, value in held.items():
        assert value == pytest.approx(design[name], rel=2e-3) and any(line.startswith(name) for line in person.shown)
    assert all(held[name] <= design[name] * (1.0 + 1e-14) for name in (SLOPE, TORQUE, SPEED)), "the guarantee's range"
    stage = run.read().stage("tune")
    assert stage is not None and {RATED, SLOPE, TORQUE, SPEED} <= {value["name"] for value in stage.values}
    assert any("Cost: " in line and "no guarantee above" in line for line in stage.fallbacks)
    assert {"voltage demand within the limits", "current within the limits"} <= {a.what for a in stage.acceptance}
    assert "a voltage that it does not record" in run.read().stage("prove").note  # type: ignore[union-attr]
    source, largest = with_simulation(sheet, {"thermal_on": False}), 3.0 * sheet.machine.I_max_apk  # type: ignore[operator]
    references = [(0.05 * k, (-1.0) ** k * largest) for k in range(8)]
    speed = ((0.0, held[SPEED]),)
    assert ClosedNode(source, held, 1).run(speed, references).saturated == 0
    as_delivered = {**held, SLOPE: 1e4 * held[RATED], TORQUE: 10.0 * held[RATED]}
    assert ClosedNode(source, as_delivered, 1).run(speed, references).saturated > 0


def test_without_a_data_sheet_what_is_missing_is_named(tmp_path: Path) -> None:
    with opened("&drive=epos4" + SLOW) as (drive, found):
        run = begin_run(drive, tmp_path, level=found.level)
        progress, _ = chain(run, drive, found, sheet=False)
    assert progress.ended["identify"] == "pass" and progress.ended["tune"] == "not available"
    assert "R_s_ohm, L_d_h, L_q_h" in run.read().stage("tune").note  # type: ignore[union-attr]
    assert not (run.path / "machine.toml").exists()


def test_a_file_of_other_pole_pairs_than_the_drive_holds_writes_nothing(tmp_path: Path) -> None:
    """EPOS4 without mode 11: nothing measures the pole pairs, and somebody has set 3 in the drive."""
    sheet = load_machine_file(PROFILE)
    wrong = replace(sheet, machine=replace(sheet.machine, pole_pairs=7, R_s_ohm=0.46), std={})
    with opened("&drive=epos4") as (drive, found):
        names = list(found.drive_map.cells)
        before = DriveParameters(drive.node).read(names)
        run, person = begin_run(drive, tmp_path, level=found.level), Told()
        with pytest.raises(Contradiction, match="pole_pairs: the data sheet states 7, the drive holds 3") as ended:
            Commissioning(run, drive, person, Quiet(), wrong, SLOWLY, capabilities=found).carry_out()
        assert DriveParameters(drive.node).read(names) == before and not person.shown
        assert is_safe(drive.node.state())
    assert ended.value.exit_code == 1 and "--accept" not in ended.value.hint
    assert "nothing was moved" in ended.value.what and not list(run.path.glob("traces/*"))
    assert "set the drive up for this motor" in ended.value.hint and "set up for another" in ended.value.likely
    assert not (run.path / "design.toml").exists()
    rows = {row["name"]: row for row in run.read().stage("identify").comparison}  # type: ignore[union-attr]
    assert (rows["pole_pairs"]["stated"], rows["pole_pairs"]["held"]) == (7, 3)
    assert rows["R_s_ohm"]["verdict"] == "NOT CHECKED"
    page = report_page(run.path)
    assert "Data sheet, drive, measured" in page and NO_DATA_SHEET not in page
    stage = run.read().stage("identify")
    without = [{**row, "stated": None} for row in stage.comparison]  # type: ignore[union-attr]
    run.write(replace(run.read(), stages=(replace(stage, comparison=without),)))  # type: ignore[type-var]
    assert NO_DATA_SHEET in report_page(run.path)


def test_recorder_level_is_flashed_whole_and_proven_by_a_speed_step(tmp_path: Path) -> None:
    with opened("&level=recorder") as (drive, found):
        run = begin_run(drive, tmp_path, level=found.level)
        progress, _ = chain(run, drive, found, sheet=False)
    assert set(progress.ended.values()) == {"pass"}
    proof = run.read().stage("prove")
    assert proof is not None and any("the drive has no excitation" in line for line in proof.fallbacks)
    assert {str(value["name"]).split(":")[0] for value in proof.values if "where" in value} == {"speed_step"}
    assert all(line.startswith("not shown: ") for line in proof.fallbacks)
    found_verdict = verdict(run.path)
    assert found_verdict.word == "PARTIAL" and found_verdict.lines[0].startswith("7 of 7 stages ran")
    assert f"NOT CHECKED ({SET_UP}): pole pairs, L_d" in found_verdict.headline
    assert "data sheet" not in found_verdict.headline
    assert report_page(run.path).count(">{}</td>".format(SET_UP.replace("'", "&#39;"))) == 3
    given = next(value for value in run.read().stage("identify").values if value["name"] == "L_d_h")  # type: ignore[union-attr]
    assert given["source"] == SET_UP and "std" not in given
    truth = load_machine_file(PROFILE).machine
    found = {value["name"]: value["value"] for value in run.read().stage("identify").values}  # type: ignore[union-attr]
    # random drives are judged by benchmarks.level_intervals
    assert found["psi_f_wb"] == pytest.approx(truth.psi_f_wb, rel=0.015)
    assert found["L_q_app_h"] == pytest.approx(truth.L_q_h, rel=0.05)
    assert found["R_s_ohm"] == pytest.approx(truth.R_s_ohm, rel=0.03)
    # the level does not measure the encoder: its maker's offset must not be overwritten
    offset = load_machine_file(run.path / "machine.toml").encoder.offset_rad
    assert offset == pytest.approx(load_machine_file(PROFILE).encoder.offset_rad, abs=0.01)


def test_inject_level_is_commissioned_whole_and_replayed(tmp_path: Path) -> None:
    with opened("&level=inject") as (drive, found):
        run = begin_run(drive, tmp_path, level=found.level)
        proof = replace(FEW, experiments=("q_steps",))
        progress, _ = chain(run, drive, found, sheet=False, proof=proof, asked=UNTIL_KNOWN)
    assert len(progress.ended) == 7 and set(progress.ended.values()) == {"pass"}
    stage = run.read().stage("identify")
    assert stage is not None and any("means are made from records" in line for line in stage.fallbacks)
    machine, truth = (load_machine_file(path) for path in (run.path / "machine.toml", PROFILE))
    found_values = {name: machine.estimates[name] for name in ("L_d_h", "L_q_h", "psi_f_wb", "J_kgm2")}
    for name, estimate in found_values.items():
        assert estimate.value == pytest.approx(getattr(truth.machine, name), rel=INJECT_OFF), name
    assert machine.estimates["R_s_ohm"].value == pytest.approx(truth.machine.R_s_ohm, rel=10.0 * INJECT_OFF)
    before = (run.path / "machine.toml").read_bytes()
    assert [v["value"] for v in replay(run).values] == [v["value"] for v in stage.values]
    assert (run.path / "machine.toml").read_bytes() == before and not (run.path / REPLAYED).exists()


def test_inject_level_measures_like_the_full_one_with_means_from_records(tmp_path: Path) -> None:
    with opened("&level=inject") as (drive, found):
        assert found.level is CapabilityLevel.INJECT and found.best("L") is not None
        angles = [drive.live("theta_m_rad")]
        for _ in range(2):
            drive.recorder.start_average(("theta_m_rad", "U_dc_v"), 800)
            drive.wait(800 * drive.period_s)
            means = drive.recorder.finish_average(("theta_m_rad", "U_dc_v"))
            angles.append(means["theta_m_rad"])
        assert means["U_dc_v"] == pytest.approx(drive.live("U_dc_v"), rel=0.02)
        assert max(angles) - min(angles) < 0.01  # nothing turned, and no turn was lost


def test_limits_need_objects_a_bandwidth_and_the_inertia() -> None:
    sheet = load_machine_file(PROFILE)
    without = replace(sheet, machine=replace(sheet.machine, J_kgm2=None))
    standard = load_family("cia402")
    assert why_no_limits(standard, None, sheet) == NO_BANDWIDTH and why_no_limits(standard, 95.0, sheet) == ""
    assert why_no_limits(standard, 95.0, without) == NO_INERTIA
    assert SLOPE in why_no_limits(load_family("ingenia"), None, sheet)


def test_a_bandwidth_is_refused_for_a_drive_that_takes_gains(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    asked = ["-i", "pmsmsim", "-c", "interior-2k2?nv=:memory:", "commission", "--drive-bandwidth-hz", "95", "--yes"]
    outcome = CliRunner().invoke(cli, asked)
    assert isinstance(outcome.exception, ConfigError) and "cannot be reflashed" in str(outcome.exception)
    assert not (tmp_path / "runs").exists()


def test_a_map_of_another_drive_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    outcome = CliRunner().invoke(cli, [
        "-i", "pmsmsim", "-c", "interior-2k2?nv=:memory:&drive=epos2", "commission", "--map", "epos4", "--yes"
    ])  # fmt: skip
    assert isinstance(outcome.exception, ConfigError) and "the map 'epos4' is for vendor" in str(outcome.exception)


def test_the_plan_is_told_before_anything_moves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    outcome = CliRunner().invoke(
        cli, ["-i", "pmsmsim", "-c", "interior-2k2?nv=:memory:&drive=elmo", "commission", str(PROFILE)], input=""
    )
    assert outcome.exit_code != 0 and "capability level standard, map elmo" in outcome.stderr
    assert "flash, verify: not available: needs a map" in outcome.stderr
    assert not isinstance(outcome.exception, NotAvailable)


def test_the_plan_of_a_drive_that_takes_nothing_promises_no_loop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    bus = ["-i", "pmsmsim", "-c", f"interior-2k2?nv=:memory:&drive={nothing_for_motion(tmp_path)}"]
    outcome = CliRunner().invoke(cli, [*bus, "commission", str(PROFILE), "--yes"])
    assert outcome.exit_code == ExitCode.PARTIAL, "what it can give: a table for reading"
    plan = outcome.stderr.splitlines()
    assert "lut: with values as given; the drive has no object for the table" in plan
    assert any(line.startswith("tune, margins: not available: needs the gains of the current loops") for line in plan)


def test_what_a_drive_lacks_is_said_before_a_consent_and_leads_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without MACHINE nothing tells the pole pairs: nobody is asked to let it move, and no --resume is advised."""
    monkeypatch.chdir(tmp_path)
    bus = ["-i", "pmsmsim", "-c", "interior-2k2?nv=:memory:&drive=elmo"]
    outcome = CliRunner().invoke(cli, [*bus, "commission", "--yes"])
    error = outcome.exception
    assert isinstance(error, NotAvailable) and "identify: needs the pole pairs" in str(error)
    assert "Apk" not in outcome.stderr, "no envelope to consent to"
    assert "--resume" not in outcome.stderr and "begin a new run" in outcome.stderr
    assert "pmsmtool machine new" in error.hint and "pmsmtool commission MACHINE" in error.hint
    # and that is the step that works
    outcome = CliRunner().invoke(cli, [*bus, "commission", str(PROFILE), "--yes", "--json", "--speed-max", "400rpm"])
    assert outcome.exit_code == ExitCode.PARTIAL and json.loads(outcome.stdout)["verdict"] == "PARTIAL"
    stages = {stage["name"]: stage for stage in json.loads(outcome.stdout)["stages"]}
    assert stages["tune"]["status"] == "not available" and "the map 'elmo' has no object" in stages["tune"]["note"]
    assert all(stage["note"] for stage in stages.values() if stage["status"] == "not available")


def test_a_measured_contradiction_says_what_to_change_also_where_no_push_succeeds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    text = PROFILE.read_text(encoding="utf-8").replace("pole_pairs = 3", "pole_pairs = 4")
    Path("wrong.toml").write_text(text, encoding="utf-8")
    channel = "interior-2k2?nv=:memory:&drive=cia402"
    unmoved = IdentificationError("E_EXCITATION", "the shaft does not answer", likely="it is held")
    monkeypatch.setattr(by_pulses, "push_by_torque", Mock(side_effect=unmoved))
    with PmsmSimBus(channel):  # the drive stays powered when the tool leaves
        outcome = CliRunner().invoke(cli, ["-i", "pmsmsim", "-c", channel, "commission", "wrong.toml", "--yes"])
        with Connection(PmsmSimBus(channel)) as connection:
            assert is_safe(DriveNode(connection, 1).state())
    assert isinstance(outcome.exception, Contradiction) and "correct pole_pairs" in outcome.exception.hint
    assert "pole_pairs: the data sheet states 4, measured 3" in str(outcome.exception)
    (run,) = Path("runs").iterdir()
    assert verdict(run).word == "FAIL"
    assert "--resume" not in outcome.stderr and "begin a new run" in outcome.stderr
    # the push, which tells nothing here, does not take what the turns told along
    stage = RunDirectory(run).read().stage("identify")
    assert stage is not None and list(stage.refused) == ["psi", "mechanics"]
    assert all("the shaft does not answer (likely it is held)" in why for why in stage.refused.values())


def test_a_limit_in_the_pulses_leaves_what_was_measured_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its own record, without values, stood in place of that of the identification."""
    monkeypatch.chdir(tmp_path)
    exceeded = LimitExceeded("current", 9.0, 7.5, "A", where="node 1")
    monkeypatch.setattr(by_pulses, "push_by_torque", Mock(side_effect=exceeded))
    bus = ["-i", "pmsmsim", "-c", "interior-2k2?nv=:memory:&drive=cia402"]
    outcome = CliRunner().invoke(cli, [*bus, "commission", str(PROFILE), "--yes", "--json"])
    assert isinstance(outcome.exception, LimitExceeded) and 'during "pole pairs' in outcome.exception.where
    shown = json.loads(outcome.stdout)
    assert "pole_pairs" in {value["name"] for value in shown["values"]} and len(shown["stages"]) == 1
    assert "current 9 A is outside the limit 7.5 A" in shown["stages"][0]["refused"]["mechanics"]
    assert "measured: pole_pairs 3" in outcome.stderr


def test_a_map_with_every_gain_says_what_a_proof_lacks_besides(tmp_path: Path) -> None:
    """It ended "the map has no object for" and named none."""
    found = SimpleNamespace(drive_map=replace(reference_map(), staging=False))
    stages: Any = SimpleNamespace(found=found, run=_run(tmp_path))
    assert LevelStages._no_proof(stages) == NO_STEPS


def test_a_drive_whose_encoder_counts_backwards_gets_no_gains_and_no_proof(tmp_path: Path) -> None:
    """Swapped leads were named by identify, and the gains written all the same: a loop over that sign runs away."""
    run = _run(tmp_path)
    run.save("design.toml", "")
    run.add(Stage("identify", "partial", 1.0, refused={ENCODER_SIGN: "the position falls under positive torque"}))
    drive: Any = None
    found: Any = SimpleNamespace(identity=SimpleNamespace(node=1))
    stages = LevelStages(run, drive, found, None)
    quiet: Any = None
    for closed in (lambda: stages.flash(quiet, quiet), stages.verify, lambda: stages.prove(quiet, quiet, quiet)):
        with pytest.raises(NotAvailable, match="encoder sign WRONG: swap two motor leads"):
            closed()


def test_a_drive_with_hall_sensors_alone_is_asked_for_no_angle_between_their_edges(tmp_path: Path) -> None:
    """Its set turned the Hall sensors off: fault 0x7305 after the reset, and the roll-back failed, too."""
    drive: Any = SimpleNamespace(identity=SimpleNamespace(node=1, vendor=1, product=1))
    every = reference_capabilities(drive.identity)
    assert LevelStages(_run(tmp_path), drive, every, None).unavailable() == {}
    halls = LevelStages(_run(tmp_path), drive, replace(every, features=every.features - {"encoder"}), None)
    asked = halls._injected(IdentifyRequest())
    assert asked.quantities == ("R", "L", "psi", "encoder", "poles", "inverter") and not asked.resonance
    assert list(asked.left_out) == ["mechanics"] and list(halls.unavailable()) == ["prove"]
    held = {"hall.commutation": 2.0, "hall.axis_1_rad": 0.1, "hall.axis_2_rad": -2.0, "hall.axis_3_rad": 2.1}
    known = load_machine_file(PROFILE)
    own = with_own_halls(known, held.__getitem__)
    assert own.encoder.halls == held and with_own_halls(own, {"hall.commutation": 1.0}.__getitem__) is own
    assert with_own_halls(known, {"hall.commutation": 0.0}.__getitem__) is known


def _run(folder: Path) -> RunDirectory:
    return RunDirectory.create(folder, 1, new_record(["test"], drive={}, bus={}, versions={}, operator="nobody"))
