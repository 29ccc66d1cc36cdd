# SPDX-License-Identifier: MIT
"""What a drive will give, before it is bought: asked of a node made from its maker's file, without a bus."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from pmsmtool.bus.connect import Connection, connect
from pmsmtool.cli.drive_access import rehearsal_bus
from pmsmtool.cli.main import cli
from pmsmtool.cli.options import BusOptions
from pmsmtool.commissioning import level_stages
from pmsmtool.commissioning.commission import begin_run
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.motion_objects import encoder_counts, held_current_limits, rated_apk
from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive.port import Identity
from pmsmtool.drive_maps.drive_map import LETTERS
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import ConfigError, IdentificationError, NotAvailable
from pmsmtool.files import data_folder
from pmsmtool.flash.download import Download
from pmsmtool.flash.journal import JournalFolder
from pmsmtool.flash.map_gate import memory_of
from pmsmtool.flash.restore import plan_download
from pmsmtool.identification.by_pulses import either_reading, over_torque_constant
from pmsmtool.identification.request import IdentifyRequest
from pmsmtool.machine.machine_file import load_machine_file, machine_path
from pmsmtool.machine.parameters import Estimate
from pmsmtool.measurement.capabilities import examine
from pmsmtool.measurement.identify import open_for_level
from pmsmtool.params.parameter_set import ParameterSet
from pmsmtool.run_directory import Stage
from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.sim.channel import parse_channel
from tests.foreign.data_sheets import GUARDING, Row, copley, epos4, unknown, write_eds


def run(*arguments: str) -> Result:
    return CliRunner().invoke(cli, [*arguments])


def asked(
    path: Path, rows: tuple[Row, ...], limits: dict[tuple[int, int], tuple[int, int]] | None = None
) -> dict[str, object]:
    outcome = run("caps", "--eds", str(write_eds(path / "my drive&co.eds", rows, limits)), "--json")
    assert outcome.exit_code == 0, outcome.exception
    facts: dict[str, object] = json.loads(outcome.stdout)
    return facts


def ways(facts: dict[str, object]) -> dict[tuple[str, str], dict[str, object]]:
    rows = facts["quantities"]
    assert isinstance(rows, list)
    return {(row["quantity"], row["method"]): row for row in rows}


def test_what_an_eds_will_give(tmp_path: Path) -> None:
    facts = asked(tmp_path, epos4())
    assert facts["level"] == "standard" and facts["map"] == "epos4" and facts["replaced"] == []
    row = ways(facts)["mechanics", "standard"]
    assert row["available"] and row["expected"] == [], "a promise of 1.5 % would be of a current whose kind is known"
    assert "peak or rms" in str(row["note"])


def test_what_replaces_a_missing_limit_is_said(tmp_path: Path) -> None:
    facts = asked(tmp_path, copley())
    assert facts["level"] == "standard" and facts["map"] == "copley"
    assert "0x6080" in str(facts["replaced"]) and "this program looks" in str(facts["replaced"])


def test_without_supervision_nothing_is_moved(tmp_path: Path) -> None:
    facts = asked(tmp_path, tuple(row for row in copley() if row not in GUARDING))
    assert facts["level"] == "manual"
    assert "consumer heartbeat (0x1016), or node guarding (0x100C, 0x100D)" in str(ways(facts)["psi", "standard"])


@pytest.mark.parametrize(
    ("row", "limits"),
    [
        ((0x1016, 1, "U32", "ro", "0"), None),
        ((0x6071, 0, "I16", "ro", "0"), None),
        ((0x6071, 0, "I16", "rw", "0"), {(0x6071, 0): (-100, 100)}),
    ],
)
def test_what_a_push_writes_and_the_file_does_not_let_be_written_is_missing(
    tmp_path: Path, row: Row, limits: dict[tuple[int, int], tuple[int, int]] | None
) -> None:
    """Found by writing to the simulated drive; before, the promise was broken by the first push."""
    assert ways(asked(tmp_path, unknown()))["mechanics", "standard"]["available"]
    assert not ways(asked(tmp_path, unknown("0x2D", row), limits))["mechanics", "standard"]["available"]


def test_a_rehearsal_is_a_channel_of_the_simulated_bus(tmp_path: Path) -> None:
    bus = rehearsal_bus(BusOptions(), eds=str(tmp_path / "a&b c.eds"), machine=tmp_path / "motor.toml")
    channel = parse_channel(bus.channel)
    assert bus.simulated() and channel.nv == ":memory:"
    assert channel.eds == str(tmp_path / "a&b c.eds") and channel.name == str(tmp_path / "motor.toml")
    assert parse_channel(rehearsal_bus(BusOptions(), eds="t.csv#a b").channel).eds == "t.csv#a b"
    assert parse_channel(rehearsal_bus(BusOptions(), eds=None, family="epos4").channel).drive == "epos4"
    with pytest.raises(ConfigError, match="two drives"):
        rehearsal_bus(BusOptions(), eds="x.eds", family="epos4")
    with pytest.raises(ConfigError, match="needs no bus"):
        rehearsal_bus(BusOptions("socketcan", "can0"), eds="x.eds")


@pytest.mark.parametrize("family", ["copley", "epos2", "epos4", "faulhaber", "nanotec"])
def test_a_family_shows_the_makers_own_objects_for_the_standards(family: str) -> None:
    """By its map alone a Copley was known by 0x6075, whose amperes nobody states, and a Faulhaber gave nothing."""
    own = load_family(family).motion
    with Connection(PmsmSimBus(f"interior-2k2?nv=:memory:&drive={family}")) as connection:
        node = DriveNode(connection, 1)
        assert ("mechanics", "standard", True) in [(r.quantity, r.method, r.available) for r in examine(node).rows()]
        assert abs(rated_apk(node) / 6.08 - 1.0) < 1e-3, "as rms where the map leaves it open"
        assert encoder_counts(node) == 131072
        row = own["current_limit"]
        limits = {q.item.index: apk for q, apk in held_current_limits(node, rated_apk(node))}
        assert abs(limits[row.index] / 12.0 - 1.0) < 1e-3, "that of the motor"
        node.put(DriveObject(row.index, row.sub, LETTERS[row.wire]), 1000)
        limits = {q.item.index: apk for q, apk in held_current_limits(node, rated_apk(node))}
        assert abs(limits[row.index] / (1000 * row.per_count) - 1.0) < 1e-9
        node.close()


def test_commission_rehearses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A drive that gives nothing: the chain says so before anything moves, as on a real one."""
    monkeypatch.chdir(tmp_path)
    eds = ["--eds", str(write_eds(tmp_path / "x.eds", epos4(0x25)))]
    for option in (eds, ["--rehearse", *eds]):
        error = run("commission", *option, "--yes").exception
        assert isinstance(error, NotAvailable) and "identify: needs" in str(error) and "torque mode" in str(error)
    assert run("commission", "--eds", "x.eds", "--resume", "runs/1").exit_code == 2


def test_the_file_of_the_reference_drive_is_no_makers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before, the rehearsal moved the machine and ended with 'parameter image: 0 bytes, the scalars alone take 372'."""
    monkeypatch.chdir(tmp_path)
    file = data_folder("firmware-params") / "pmsmsim" / "pmsmsim.eds"
    outcome = run("commission", "interior-2k2", "--eds", str(file), "--yes")
    assert isinstance(outcome.exception, ConfigError) and "reference drive" in outcome.exception.what
    assert "--sim MACHINE" in outcome.exception.hint and not Path("runs").exists()


def test_a_rehearsal_knows_nothing_of_an_earlier_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The simulated drive has one serial number; its memory begins anew."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PMSMTOOL_HOME", str(tmp_path))
    eds = str(write_eds(tmp_path / "x.eds", epos4(0x25)))
    held = memory_of(JournalFolder(Identity(1, 0xFB, 0x65510000, 0, 22001)))
    held.parent.mkdir(parents=True)
    for channel, kept in (("--eds", eds), False), (("--sim", f"interior-2k2?nv=a.nv&eds={eds}"), True):
        held.write_text('{"map": "epos4", "sha256": "of another map"}')
        run("commission", *channel, "--yes")
        assert held.exists() == kept


def test_an_undecided_current_gives_an_interval_of_both_readings() -> None:
    """Read as rms 1.0; were it peak, it would be 0.707: both lie within with their own 2 %, and little else."""
    found = either_reading(Estimate(1.0, 0.0, 0.02, "kg m2/Wb", n=500))
    low, high = found.value - found.systematic, found.value + found.systematic
    assert low < 0.98 * math.sqrt(0.5) and high > 1.02 * 0.999 and high - low < 0.35
    assert "peak or rms" in found.fallback


def test_without_pole_pairs_the_torque_constant_divides() -> None:
    """K_T = 1.5 p psi: J/psi of one pole pair over 1.5."""
    ratios = {"J_per_psi": Estimate(0.03, 3e-4, 3e-4, "kg m2/Wb"), "tau_c_per_psi": Estimate(0.3, 0.1, 0.1, "N m/Wb")}
    found = over_torque_constant(ratios)
    assert set(found) == {"J_per_kt", "tau_c_per_kt"}
    assert found["J_per_kt"].value == pytest.approx(0.02) and found["J_per_kt"].std == pytest.approx(2e-4)
    assert found["tau_c_per_kt"].unit == "A"


@pytest.mark.parametrize("sheet", [True, False])
def test_an_inertia_that_is_not_known_closely_enough_ends_no_rehearsal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sheet: bool
) -> None:
    """A light bare shaft behind a drive without a speed limit: what the machine file states stands in."""

    def too_wide(*args: object, **named: object) -> Stage:
        raise IdentificationError("E_NOT_IDENTIFIABLE", "J/psi is 1 +-1", likely="a bare shaft", hint="add inertia")

    monkeypatch.setattr(level_stages, "identify", too_wide)
    nameplate = load_machine_file(machine_path("interior-2k2")) if sheet else None
    with connect("pmsmsim", f"interior-2k2?nv=:memory:&eds={write_eds(tmp_path / 'x.eds', epos4())}") as connection:
        node = DriveNode(connection, 1)
        found = examine(node)
        node.close()
        drive = open_for_level(connection, 1, found)
        begun = begin_run(drive, tmp_path / "runs", level=found.level)
        stages = level_stages.LevelStages(begun, drive, found, nameplate)
        if sheet:
            stage = stages.identify(IdentifyRequest(), lambda lines: None, lambda text: None)
            assert stage.status == "not available" and "add inertia" in stage.note and "machine.toml" in stage.files
        else:
            with pytest.raises(IdentificationError):
                stages.identify(IdentifyRequest(), lambda lines: None, lambda text: None)
        drive.close()


def test_a_drive_that_cannot_store_is_not_written(tmp_path: Path) -> None:
    eds = write_eds(tmp_path / "x.eds", epos4())
    with connect("pmsmsim", f"interior-2k2?nv=:memory:&eds={eds}") as connection:
        node = DriveNode(connection, 1, drive_map=load_family("epos4"))
        identity = node.identity()
        plan = plan_download(node, ParameterSet({"current.K_p_q_v_per_a": 2.0}))
        job = Download(node, identity, plan, {}, JournalFolder(identity, tmp_path))
        before = node.sdo.read(0x30A0, 1)
        with pytest.raises(NotAvailable, match="0x1010:01"):
            job.run()
        assert node.sdo.read(0x30A0, 1) == before
        job.run(store=False)
        assert node.sdo.read(0x30A0, 1) != before
        node.close()
