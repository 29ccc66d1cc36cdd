# SPDX-License-Identifier: MIT
"""A file or a drive that is not the map's, and value by value what is written, what is not, and why."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from unittest.mock import Mock

import pytest

from pmsmtool.cli.main import run
from pmsmtool.commissioning import axis_design
from pmsmtool.drive_maps.drive_map_file import map_hash
from pmsmtool.drive_maps.eds import parse_eds
from pmsmtool.drive_maps.sheet_check import map_of_sheet
from pmsmtool.drive_maps.shipped_maps import family_names, load_family
from pmsmtool.errors import DesignInfeasible
from pmsmtool.params.catalogue import BY_NAME, OWN_SCALES
from pmsmtool.params.parameter_set import ParameterSet
from tests.foreign.data_sheets import Row, copley, epos4, write_eds
from tests.simulated_bus import settle

GAINS = {"current.K_p_q_v_per_a": 3.0, "current.K_i_q_v_per_as": 90.0, "motor.R_s_ohm": 0.5, "governor.k_max": 4.0}
NOT_SAID = "0x3002:01 holds it; its scale"


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    settle(tmp_path, monkeypatch)
    (tmp_path / "params.toml").write_text(ParameterSet(GAINS).to_toml())
    return tmp_path


def sheet(home: Path, rows: tuple[Row, ...], head: str = "") -> Path:
    path = write_eds(home / "theirs.eds", rows)
    path.write_text(path.read_text().replace("[DeviceInfo]", f"[DeviceInfo]\n{head}"))
    return path


def exported(home: Path, into: Path, *more: str) -> int:
    out = home / "out.dcf"
    return run(
        ["export", "dcf", str(home / "params.toml"), "--into", str(into), "--map", "epos4", "-o", str(out), *more]
    )


# ---- a file of another drive ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("product", "head", "said"),
    [
        (0x65510000, "", ""),
        (0x63220000, "", "product 0x63220000, the map 'epos4' is for 0x60500000, 0x61500000"),
        (0x65510000, "VendorNumber=0xAB\nProductNumber=0x20B", "vendor 0x000000ab, the map 'epos4' is for 0x000000fb"),
        (0x65510000, "VendorNumber=0\nProductNumber=0", ""),
    ],
)
def test_export_says_that_file_and_map_are_of_two_drives(
    home: Path, capsys: pytest.CaptureFixture[str], product: int, head: str, said: str
) -> None:
    assert exported(home, sheet(home, epos4(product=product), head)) == 0
    told = capsys.readouterr().err
    assert ("the file is for" in told) is bool(said) and said in told
    flash = ["--sim", "interior-2k2?nv=:memory:&drive=epos4", "--yes", "flash-params", str(home / "out.dcf")]
    assert run([*flash, "--map", "epos4", "--dry-run"]) == (2 if said else 0)
    assert said in capsys.readouterr().err, "what was exported into it is not flashed as this map's"


def test_a_row_that_the_file_contradicts_is_named_and_nothing_is_written(
    home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = tuple(row for row in epos4() if row[:2] != (0x30A0, 2))
    rows = tuple((*row[:2], "I32", *row[3:]) if row[:2] == (0x30A0, 1) else row for row in rows)
    assert exported(home, sheet(home, rows)) == 2
    told = capsys.readouterr().err
    source = load_family("epos4").sources["being"]
    assert f"epos4 current.K_p_q_v_per_a 0x30A0:01 UNSIGNED32 (being: {source}): the file has INTEGER32" in told
    assert f"epos4 current.K_i_q_v_per_as 0x30A0:02 UNSIGNED32 (being: {source}): the file has no such" in told
    assert not (home / "out.dcf").exists()


# ---- value by value ---------------------------------------------------------------------------------


def test_export_says_value_by_value_why_not(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exported(home, sheet(home, epos4())) == 0
    told = capsys.readouterr().err
    assert f"not written: motor.R_s_ohm: {NOT_SAID}" in told and "governor.k_max: " not in told
    assert exported(home, home / "theirs.eds", "-v") == 0
    told = capsys.readouterr().err
    assert "not written: governor.k_max: the map 'epos4' has no row for it" in told
    assert "written: epos4 current.K_p_q_v_per_a 0x30A0:01 UNSIGNED32" in told
    assert run(["export", "csv", str(home / "params.toml"), "--map", "epos4"]) == 0
    rows = {row["name"]: row for row in csv.DictReader(io.StringIO(capsys.readouterr().out))}
    for name in GAINS:
        assert bool(rows[name]["object"]) != bool(rows[name]["not written because"])


@pytest.mark.parametrize("family", [name for name in family_names() if name != "pmsmsim"])
def test_caps_says_of_every_parameter_whether_it_is_written(
    family: str, home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drive_map = load_family(family)
    assert run(["--sim", f"interior-2k2?nv=:memory:&drive={family}", "caps", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    written, not_written = facts["written"], facts["not_written"]
    assert set(written) | set(not_written) == set(BY_NAME) and not set(written) & set(not_written)
    assert set(written) == (set(drive_map.cells) - {*OWN_SCALES} if drive_map.vendor else set())
    assert all(not_written.values()) and {**not_written, **drive_map.left_out}.keys() >= not_written.keys()
    assert run(["--sim", f"interior-2k2?nv=:memory:&drive={family}", "caps"]) == 0
    out = capsys.readouterr().out
    assert [line.split()[1] for line in out.splitlines() if line.startswith("written: ")] == list(written)
    assert "`flash-params` writes what is listed here as written; nothing is written now" in out
    for name, why in drive_map.left_out.items():
        assert name not in BY_NAME or f"not written: {name}: {why}" in out
    assert run(["--sim", f"interior-2k2?nv=:memory:&drive={family}", "caps", "-v"]) == 0
    out = capsys.readouterr().out
    assert all(f"written: {drive_map.row_text(name)}" in out for name in written)


def test_caps_says_what_is_missing_once(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What several quantities lack for a method is one line: a person reads twenty lines, not fifty."""
    assert run(["--sim", "interior-2k2?nv=:memory:&drive=epos4", "caps", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)["quantities"]
    assert run(["--sim", "interior-2k2?nv=:memory:&drive=epos4", "caps"]) == 0
    lines = capsys.readouterr().out.splitlines()
    missing = [line.removeprefix("not available: ") for line in lines if line.startswith("not available: ")]
    said = {(quantity, what.split(" by ")[-1]) for what in (m.split(": needs ")[0] for m in missing)
            for quantity in what.split(" by ")[0].split(", ")}  # fmt: skip
    assert said == {(row["quantity"], row["method"]) for row in facts if not row["available"]}
    needs = [tuple(m.split(" by ")[1].split(": needs ")) for m in missing]
    assert len(set(needs)) == len(needs)
    had = {(row["quantity"], row["method"]) for row in facts if row["available"] and row["method"] != "manual"}
    assert {tuple(line.split()[:2]) for line in lines if tuple(line.split()[:2]) in had} == had


def test_caps_says_which_rows_the_drive_contradicts(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Resistance and inductance in other sizes than the map's, and the torque slope is not there."""
    rows = tuple((*row[:2], "U32", *row[3:]) if row[:2] == (0x6410, 7) else row for row in copley())
    eds = write_eds(home / "drive.eds", rows)
    assert run(["caps", "--eds", str(eds)]) == 0
    out = capsys.readouterr().out
    said = [line for line in out.splitlines() if line.startswith("not written: ")]
    assert any("motor.R_s_ohm: the drive holds 4 bytes in 0x6410:07" in line for line in said)
    assert any("torque_slope" in line and "the drive has no object" in line for line in said)
    assert any(line.split()[:3] == ["written:", "motor.L_q_h", "0x6410:08"] for line in out.splitlines())
    assert "serial" not in out.splitlines()[0], "no drive was asked"


LIMITS = {(0x30A0, 1): (0, 2_000_000), (0x30A0, 2): (0, 2_000_000), (0x6081, 0): (5, 1)}
TOO_MUCH = "current.K_p_q_v_per_a: 0x30A0:01: 3 V/A is 3000000 in its counts, the drive takes at most 2000000 (2 V/A)"


def test_a_makers_file_is_a_map_with_its_limits(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What a drive refuses was noticed when it was flashed, as an abort code."""
    more: tuple[Row, ...] = (
        (0x30A1, 1, "U16", "rw", "1"), (0x6081, 0, "U32", "rw", "1"), (0x6083, 0, "U32", "ro", "1")
    )  # fmt: skip
    rows = (*(row for row in epos4() if row[:2] not in {one[:2] for one in more} | {(0x30A2, 2)}), *more)
    path = write_eds(home / "theirs.eds", rows, LIMITS)
    narrow, family = map_of_sheet(parse_eds(path.read_bytes())), load_family("epos4")
    assert map_hash(narrow) == map_hash(family) and narrow.whole == family, "flashed through either, it is the same map"
    name = "reference.profile_speed_rpm"
    assert narrow.cells[name] == family.cells[name], "limits in the wrong order limit nothing"
    assert "the file has no such object" in narrow.left_out["speed.K_i_nm_per_rad"]
    assert "the file has UNSIGNED16" in narrow.left_out["position.pid_p_nm_per_rad"]
    assert narrow.left_out["reference.profile_acceleration_rpm_per_s"] == "0x6083:00: the file lets it only be read"
    assert narrow.cells["current.K_p_q_v_per_a"].largest == 2_000_000

    assert run(["export", "csv", str(home / "params.toml"), "--map", str(path)]) == 0
    told = capsys.readouterr()
    held = {row["name"]: row for row in csv.DictReader(io.StringIO(told.out))}
    assert f"not written: {TOO_MUCH}" in told.err
    assert held["current.K_p_q_v_per_a"]["not written because"] == TOO_MUCH.split(": ", 1)[1]
    assert "not without current.K_p_q" in held["current.K_i_q_v_per_as"]["not written because"], "it fits, alone"
    assert run(["param", "diff", str(home / "params.toml"), str(home / "params.toml"), "--map", str(path)]) == 0
    assert f"not compared, not written: {TOO_MUCH}" in capsys.readouterr().err
    assert exported(home, path) == 2
    assert TOO_MUCH.replace(": ", " -> ", 1) in capsys.readouterr().err and not (home / "out.dcf").exists()


@pytest.mark.chain
def test_what_of_a_design_is_refused_is_named_before_a_bus_is_opened(
    home: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Gains that their objects do not hold make a slower current loop; less than a tenth of it, and nothing moves."""
    slower = {(0x30A0, 1): (0, 100_000_000), (0x30A0, 2): (0, 10_000_000)}
    limits = {(0x30A0, 1): (0, 10_000_000), (0x30A0, 2): (0, 1_000_000)}
    both = {"current.K_p_q_v_per_a", "current.K_i_q_v_per_as"}
    for given, refused, hertz in (({}, set(), ""), (slower, set(), "442.1 Hz"), (limits, both, "")):
        path = write_eds(home / "theirs.eds", epos4(), given)
        assert run(["caps", "interior-2k2", "--eds", str(path), "--json"]) == 0
        told = capsys.readouterr()
        assert set(json.loads(told.out)["refused"]) == refused
        assert told.err.count("of the design of interior-2k2 this drive refuses") == len(refused)
        assert f"current loops of {hertz}, slower by" in told.err if hertz else "slower by" not in told.err
    asked = ["commission", "interior-2k2", "--eds", str(path), "--speed-max", "400rpm"]  # nobody to consent
    assert run(asked) == 9 and capsys.readouterr().err.count("this drive refuses current.K_") == 2
    assert run([*asked, "--bandwidth-hz", "30"]) == 7 and "this drive refuses" not in capsys.readouterr().err
    infeasible = Mock(side_effect=DesignInfeasible("no gains have these margins"))
    monkeypatch.setattr(axis_design, "refused_by_limits", infeasible)
    assert run(["caps", "interior-2k2", "--eds", str(path)]) == 0
    assert "a design of interior-2k2 is not known: no gains have these margins" in capsys.readouterr().err


def test_a_value_counted_by_another_has_its_reason_in_the_table(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The table of a whole design for a drive by CiA 402 ended with exit code 2."""
    (home / "whole.toml").write_text(ParameterSet({**GAINS, "speed.tau_max_nm": 3.0, "motor.n_max_rpm": 9.0}).to_toml())
    assert run(["export", "csv", str(home / "whole.toml"), "--map", "cia402"]) == 0
    told = capsys.readouterr()
    rows = {row["name"]: row for row in csv.DictReader(io.StringIO(told.out))}
    assert rows["motor.n_max_rpm"]["object"] == "0x6080:00"
    assert "needs reference.tau_rated_nm in the same set" in rows["speed.tau_max_nm"]["not written because"]
    assert "not written: speed.tau_max_nm: 0x6072:00: needs" in told.err


def test_diff_says_what_is_equal_and_what_is_not_compared(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (home / "new.toml").write_text(ParameterSet({**GAINS, "current.K_p_q_v_per_a": 2.0}).to_toml())
    command = ["param", "diff", str(home / "params.toml"), str(home / "new.toml"), "--map", "epos4"]
    assert run([*command, "--json"]) == 0
    told = capsys.readouterr()
    facts = json.loads(told.out)
    assert [row["name"] for row in facts["differences"]] == ["current.K_p_q_v_per_a"]
    assert facts["equal"] == ["current.K_i_q_v_per_as"]
    assert set(facts["not_written"]) == {"motor.R_s_ohm", "governor.k_max"}
    assert f"not compared, not written: motor.R_s_ohm: {NOT_SAID}" in told.err
    assert "1 entries that the map has no row for" in told.err
