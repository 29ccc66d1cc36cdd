# SPDX-License-Identifier: MIT
"""The commands that look at, move and write a drive, on the simulated one; the table of bad buses and bad drives."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import can
import pytest

from pmsmtool.bus.examination import no_rate
from pmsmtool.bus.sdo import SdoChannel
from pmsmtool.cli.main import run
from pmsmtool.cli.options import BusOptions
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive_maps.drive_map import reference_map
from pmsmtool.drive_maps.drive_map_file import dump_drive_map
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import SdoAbort
from pmsmtool.params.parameter_set import ParameterSet, parse_parameter_set
from pmsmtool.report.verdict import ENCODER_SIGN
from pmsmtool.run_directory import RunDirectory, Stage, new_record
from pmsmtool.sim.bus import PmsmSimBus
from tests.cli.conftest import Result, Tool
from tests.simulated_bus import settle

ROOT = Path(__file__).resolve().parents[2]
WANTED = ParameterSet({"motor.R_s_ohm": 0.25, "motor.L_d_h": 0.003, "current.K_p_d_v_per_a": 7.5})


@pytest.fixture
def tool(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Tool:
    """Run a command line in this process, in an empty folder, on a simulated drive with a memory file there."""
    settle(tmp_path, monkeypatch)

    def call(*arguments: str, channel: str = "interior-2k2?seed=3") -> Result:
        capsys.readouterr()
        code = run(["-i", "pmsmsim", "-c", channel, *arguments])
        printed = capsys.readouterr()
        return code, printed.out, printed.err

    return call


def loaded(result: Result) -> dict[str, Any]:
    code, out, err = result
    assert code == 0, err
    found: dict[str, Any] = json.loads(out)
    return found


# ---- looking ----------------------------------------------------------------------------------------------


def test_scan_lists_all_nodes(tool: Tool) -> None:
    found = loaded(tool("scan", "--json", channel="interior-2k2?nodes=3&nv=:memory:"))
    assert found["schema"] == "pmsmtool.scan/1"
    assert [(n["node"], n["profile"], n["state"]) for n in found["nodes"]] == [
        (k, 402, "switch-on-disabled") for k in (1, 2, 3)
    ]
    assert len({n["serial"] for n in found["nodes"]}) == 3


def test_info(tool: Tool) -> None:
    found = loaded(tool("info", "--json"))
    assert found["identity"]["serial"] == 22001 and found["parameter_set"]["known"] is True
    assert found["parameter_set"]["stored"] is False and found["configured"] is None
    code, text, _ = tool("info")
    assert code == 0 and "serial 22001" in text and "SWITCH ON DISABLED" in text


def test_the_only_drive_is_found_and_several_must_be_named(tool: Tool) -> None:
    assert tool("info", channel="interior-2k2?node=42&nv=:memory:")[0] == 0
    code, _, err = tool("info", channel="interior-2k2?nodes=2&nv=:memory:")
    assert code == 2 and "1, 2" in err and "-n" in err


def test_monitor_counts_and_prints_units(tool: Tool) -> None:
    code, out, _ = tool("monitor", "--for", "1s", "--rate", "10Hz", "-g", "i_[dq]_a|U_dc", "--csv")
    rows = out.splitlines()
    assert code == 0 and rows[0] == "t_s,i_d_a,i_q_a,U_dc_v" and rows[1] == "s,A,A,V" and len(rows) == 12
    code, out, _ = tool("monitor", "--for", "0.5s", "--json")
    readings = [json.loads(line) for line in out.splitlines()]
    assert code == 0 and len(readings) == 3 and readings[0]["values"]["U_dc_v"] == pytest.approx(540.0, rel=0.05)


def test_monitor_by_process_data(tool: Tool) -> None:
    code, out, _ = tool("monitor", "--pdo", "--for", "0.5s", "--rate", "100Hz", "-g", "^i_[dq]_a$", "--csv")
    assert code == 0 and 45 <= len(out.splitlines()) <= 55
    assert tool("monitor", "--pdo", "--for", "0.1s")[0] == 9, "more than the PDOs hold"


def test_monitor_of_nothing(tool: Tool) -> None:
    assert tool("monitor", "-g", "nothing")[0] == 9
    assert tool("monitor", "-g", "(")[0] == 2


def test_fault_show_and_reset(tool: Tool, tmp_path: Path) -> None:
    code, out, _ = tool("fault", "show")
    assert code == 0 and "no error" in out
    found = loaded(tool("fault", "reset", "--json"))
    assert found["state"] == "switch-on-disabled" and found["error_code"] == 0
    assert found["schema"] == "pmsmtool.fault-reset/1"
    assert loaded(tool("fault", "show", "--json"))["schema"] == "pmsmtool.fault-show/1"


def test_doctor_passes_on_a_good_bus(tool: Tool) -> None:
    found = loaded(tool("doctor", "--json", channel="interior-2k2?nv=:memory:&bitrate=500000"))
    assert found["examination"]["error_frames"] == 0
    assert {verdict for verdict, _ in found["examination"]["findings"]} == {"PASS"}
    assert any(a["name"] == "virtual" and a["ready"] for a in found["adapters"])


def test_doctor_names_the_wrong_bit_rate(tool: Tool) -> None:
    code, out, err = tool("-b", "250000", "doctor", channel="interior-2k2?nv=:memory:&bitrate=500000")
    assert code == 3 and "wrong bit rate" in out and "wrong bit rate" in err
    assert "try:    `pmsmtool doctor --find-bitrate` listens" in err


@pytest.mark.chain
def test_doctor_finds_the_bit_rate(tool: Tool) -> None:
    found = loaded(tool("doctor", "--find-bitrate", "--json", channel="interior-2k2?nv=:memory:&bitrate=250000"))
    good = [rate for rate, counts in found["bitrates"].items() if counts["frames"] and not counts["error_frames"]]
    assert good == ["250000"]
    _, out, _ = tool("doctor", "--find-bitrate", channel="interior-2k2?nv=:memory:&bitrate=250000")
    assert out.splitlines()[-1] == "PASS  the bus runs at 250000 bit/s: give -b 250000" and "FAIL" not in out


def test_doctor_names_a_missing_terminator(tool: Tool) -> None:
    """A bus that damages every frame at every bit rate: before, it could not be simulated and the search ended by 0."""
    bare = "interior-2k2?nv=:memory:&terminator=missing"
    code, out, err = tool("doctor", "--find-bitrate", channel=bare)
    assert code == 3 and "only error frames, at every bit rate: termination" in out
    assert "120 ohm is one missing resistor" in out and "--find-bitrate" not in err
    code, _, err = tool("info", channel=bare)
    assert code == 3 and "a bus without termination" in err
    code, _, err = tool("info", channel="interior-2k2?terminator=mising")
    assert code == 2 and "must be one of fitted, missing" in err


def test_silence_at_every_rate_is_no_missing_terminator() -> None:
    assert "switch a node on" in no_rate({500_000: (0, 0), 250_000: (0, 3)}) and "switch a node on" in no_rate({})
    assert no_rate({500_000: (0, 2), 250_000: (0, 3)}).startswith("only error frames")


# ---- parameters -------------------------------------------------------------------------------------------


def test_param_get_by_name_wildcard_and_object(tool: Tool) -> None:
    found = loaded(tool("param", "get", "motor.R_*", "0x2010:01", "0x1018:04", "--json"))["parameters"]
    assert [(p["name"], p["value"]) for p in found[:2]] == [("motor.R_s_ohm", 0.137), ("motor.pole_pairs", 4)]
    assert bytes.fromhex(found[2]["bytes"]) == (22001).to_bytes(4, "little")


def test_param_get_reads_addresses_raw_on_a_foreign_drive_and_gives_each_its_result(tool: Tool) -> None:
    """There 0x2010:01 is no object; in our map it is a parameter."""
    foreign = "interior-2k2?drive=epos4&nv=:memory:"
    code, out, err = tool("param", "get", "0x1018:01", "0x2010:01", "0x6041", "--json", channel=foreign)
    entries = json.loads(out)["parameters"]
    assert code == 4 and "0x2010:01" in err
    assert [entry["object"] for entry in entries] == ["0x1018:01", "0x2010:01", "0x6041:00"]
    assert entries[0]["bytes"] == "fb000000" and len(entries[2]["bytes"]) == 4
    assert "error" in entries[1] and not entries[1].get("bytes")
    assert tool("param", "get", "0x1018:01", "0x6041", channel=foreign)[0] == 0


def test_info_shows_who_a_node_without_a_statusword_is(tool: Tool, monkeypatch: pytest.MonkeyPatch) -> None:
    read = SdoChannel.read

    def without(self: SdoChannel, index: int, sub: int, **given: Any) -> bytes:
        if index == 0x6041:
            raise SdoAbort(0x06020000, index, sub, "node refused")
        return read(self, index, sub, **given)

    monkeypatch.setattr(SdoChannel, "read", without)
    code, out, _ = tool("info")
    assert code == 0 and "serial 22001" in out and "no CiA 402 drive" in out


def test_param_get_unknown(tool: Tool) -> None:
    code, _, err = tool("param", "get", "motor.R_s")
    assert code == 2 and "did you mean motor.R_s_ohm" in err


def test_param_set_acts_until_the_reset_and_store_keeps(tool: Tool) -> None:
    code, out, err = tool("param", "set", "motor.R_s_ohm=0.2", "motor.L_d_h=2.5mH", "--yes", "--store")
    assert code == 0 and "stored" in out and "0.137" in err
    found = loaded(tool("param", "get", "motor.R_s_ohm", "motor.L_d_h", "--json"))["parameters"]
    assert [p["value"] for p in found] == [0.2, 0.0025], "kept by the drive's memory over its power-off"
    assert tool("param", "set", "motor.R_s_ohm=0.3", "--yes")[0] == 0
    assert loaded(tool("param", "get", "motor.R_s_ohm", "--json"))["parameters"][0]["value"] == 0.2


@pytest.mark.parametrize(
    ("assignment", "code", "text"),
    [
        ("motor.R_s_ohm", 2, "NAME=VALUE"),
        ("motor.R_s_ohm=abc", 2, "motor.R_s_ohm"),
        ("motor.R_s_ohm=5mH", 2, "inductance"),
        ("motor.R_s_ohm=-1", 2, "outside"),
        ("0x6040:00=6", 2, "map"),
    ],
)
def test_param_set_refuses(tool: Tool, assignment: str, code: int, text: str) -> None:
    found = tool("param", "set", assignment, "--yes")
    assert found[0] == code and text in found[2]


def test_param_dump_is_what_flash_params_takes(tool: Tool, tmp_path: Path) -> None:
    code, out, _ = tool("param", "dump", "--all")
    assert code == 0 and len(parse_parameter_set(out).values) > 80
    (tmp_path / "all.toml").write_text(out)
    assert tool("verify", "all.toml")[0] == 0
    code, out, _ = tool("param", "dump")
    assert code == 0 and "R_s_ohm" not in out and "I_max_apk" in out


def test_param_diff(tool: Tool, tmp_path: Path) -> None:
    (tmp_path / "wanted.toml").write_text(WANTED.to_toml())
    found = loaded(tool("param", "diff", "device", "wanted.toml", "--json"))["differences"]
    assert {d["name"]: d["new"] for d in found} == WANTED.values
    assert tool("param", "diff", "device", "wanted.toml", "--check")[0] == 1
    assert tool("param", "diff", "wanted.toml", "wanted.toml", "--check")[0] == 0


def test_param_help(tool: Tool, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["param", "help", "governor.*"]) == 0
    assert "horizon in T_s" in capsys.readouterr().out


# ---- writing ----------------------------------------------------------------------------------------------


@pytest.fixture
def wanted(tmp_path: Path) -> str:
    (tmp_path / "wanted.toml").write_text(WANTED.to_toml())
    return "wanted.toml"


def test_a_set_of_a_run_that_did_not_pass_says_so_first(tool: Tool, tmp_path: Path) -> None:
    """Gains of a run that found two motor leads swapped were listed like any other's."""
    record = new_record(["commission"], drive={}, bus={}, versions={}, operator="nobody")
    made = RunDirectory.create(tmp_path, 1, record)
    made.save("params.toml", WANTED.to_toml())
    made.add(Stage("identify", "partial", 1.0, refused={ENCODER_SIGN: "the position falls under positive torque"}))
    code, out, err = tool("flash-params", str(made.path), "--dry-run")
    assert code == 0 and "the run ended so: " in err and "encoder sign WRONG" in err and "3 of 3 objects change" in out


@pytest.mark.chain
def test_flash_verify_backup_restore(tool: Tool, wanted: str, tmp_path: Path) -> None:
    saved = loaded(tool("backup", "-o", "before.json", "--json"))["objects"]
    dry = loaded(tool("flash-params", wanted, "--dry-run", "--json"))
    assert {c["name"]: c["wanted"] for c in dry["changes"]} == WANTED.values
    assert tool("flash-params", wanted, "--check")[0] == 1
    done = loaded(tool("flash-params", wanted, "--yes", "--json"))
    assert done["outcome"]["written"] == 3 and done["outcome"]["stored"] is True
    code, out, _ = tool("verify", wanted)
    assert code == 0 and "values only; run prove to test behaviour" in out
    code, _, err = tool("verify", "before.json")
    assert code == 1 and "restore before.json" in err
    assert tool("flash-params", wanted, "--check")[0] == 0
    assert tool("restore", "--yes")[0] == 0
    assert f"{saved} of {saved} objects match" in tool("verify", "before.json")[1]
    code, _, err = tool("verify", wanted)
    assert code == 1 and "motor.R_s_ohm" in err and f"listed: drive -> {Path(wanted).name}" in err
    _, _, err = tool("restore", "--dry-run")
    assert "listed: now in the drive -> brought back" in err
    code, out, _ = tool("restore")  # a second one is no redo, and needs no consent
    assert code == 0 and "already as before its last download, nothing was done" in out
    assert tool("verify", "before.json")[0] == 0
    outcome = loaded(tool("restore", "before.json", "--json"))["outcome"]  # without --yes: nothing to consent to
    assert outcome["written"] == 0 and outcome["starts"] == 0
    assert "nothing was done" in tool("restore", "before.json", "--yes")[1]


KILLED_BEFORE_ITS_JOURNAL = """
import os, sys
from pmsmtool.cli.main import run
from pmsmtool.flash.journal import JournalFolder
JournalFolder.begin = lambda folder, snapshot: os._exit(9)
run(sys.argv[1:])
"""


@pytest.mark.chain
def test_restore_after_a_tool_killed_before_its_journal_goes_back_no_further(tool: Tool, wanted: str) -> None:
    assert tool("flash-params", wanted, "--yes")[0] == 0
    Path("later.toml").write_text(ParameterSet({"motor.R_s_ohm": 0.5}).to_toml())
    command = ("-i", "pmsmsim", "-c", "interior-2k2", "--yes", "flash-params", "later.toml")
    killed = subprocess.run([sys.executable, "-c", KILLED_BEFORE_ITS_JOURNAL, *command], check=False)
    assert killed.returncode == 9
    for _ in range(2):
        code, out, err = tool("restore", "--yes")
        assert code == 0 and "nothing was done" in out and "killed before it wrote anything" in err
    assert tool("verify", wanted)[0] == 0, "the set that was held before the killed download"
    path = err.partition("`pmsmtool restore ")[2].partition("`")[0]
    assert tool("restore", path, "--yes")[0] == 0 and tool("verify", wanted)[0] == 1
    assert tool("flash-params", wanted, "--yes")[0] == 0 and tool("restore", "--yes")[0] == 0
    assert tool("verify", wanted)[0] == 1, "a download that came to its end is undone again"


def test_restore_refuses_a_journal_when_another_program_wrote_since(
    tool: Tool, wanted: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert tool("flash-params", wanted, "--yes")[0] == 0
    Path("later.toml").write_text(ParameterSet({"motor.R_s_ohm": 0.5}).to_toml())
    with monkeypatch.context() as elsewhere:
        elsewhere.setenv("PMSMTOOL_HOME", str(tmp_path / "other account"))
        assert tool("flash-params", "later.toml", "--yes")[0] == 0
    code, _, err = tool("restore", "--yes")
    assert code == 5 and "neither its old nor its new set" in err
    assert tool("verify", "later.toml")[0] == 0


@pytest.mark.chain
def test_backup_into_a_spare_part(tool: Tool, wanted: str) -> None:
    assert tool("flash-params", wanted, "--yes")[0] == 0
    assert tool("backup", "-o", "one.json")[0] == 0
    assert tool("backup", "-o", "one.json")[0] == 2, "a backup is not overwritten"
    spare = "interior-2k2?nv=spare.nv&nodes=2"
    code, _, err = tool("-n", "2", "restore", "one.json", "--yes", channel=spare)
    assert code == 2 and "serial number 22001" in err and "--other-drive" in err
    assert tool("-n", "2", "restore", "one.json", "--yes", "--other-drive", channel=spare)[0] == 0
    assert tool("-n", "2", "verify", wanted, channel=spare)[0] == 0


@pytest.mark.parametrize("command", [("flash-params",), ("flash-params", "--nodes", "1")])
def test_a_map_that_is_refused_is_refused_before_the_consent(tool: Tool, wanted: str, command: tuple[str, ...]) -> None:
    channel = "interior-2k2?nv=:memory:&drive=copley"
    Path("nobodys.toml").write_text(dump_drive_map(replace(load_family("copley"), vendor=0)), encoding="utf-8")
    code, _, err = tool(*command, wanted, "--map", "nobodys.toml", channel=channel)
    assert code == 2 and "does not state whose drive it is for" in err
    assert "->" not in err and "consent" not in err, "nothing to consent to was shown"


def test_restore_without_a_journal(tool: Tool) -> None:
    code, _, err = tool("restore", "--yes")
    assert code == 2 and "no journal" in err


def test_nobody_to_ask_writes_nothing(tool: Tool, wanted: str, tmp_path: Path) -> None:
    code, _, err = tool("flash-params", wanted)
    assert code == 7 and "nothing was written" in err and "motor.R_s_ohm" in err
    assert not (tmp_path / "home").exists(), "not even a journal"
    assert tool("verify", wanted)[0] == 1


def test_map_of_another_drive_is_refused_before_writing(tool: Tool, wanted: str, tmp_path: Path) -> None:
    other = replace(reference_map(), name="other", vendor=0x1234)
    (tmp_path / "other.toml").write_text(dump_drive_map(other))
    code, _, err = tool("flash-params", wanted, "--map", "other.toml", "--yes")
    assert code == 2 and "0x00001234" in err and "0x706d736d" in err and "nothing was moved or written" in err


def test_faults_on_purpose_leave_the_old_set(tool: Tool, wanted: str, tmp_path: Path) -> None:
    (tmp_path / "faults.toml").write_text('[[refuse]]\nobject = "0x2010:03"\ncode = 0x06090031\n')
    code, _, err = tool("flash-params", wanted, "--yes", channel="interior-2k2?faults=faults.toml")
    assert code == 4 and "motor.L_d_h" in err and "old set again" in err
    assert tool("verify", wanted)[0] == 1


@pytest.mark.chain
def test_fleet_gets_the_same_set_and_one_table(tool: Tool, wanted: str, tmp_path: Path) -> None:
    fleet = "interior-2k2?nodes=3&nv=fleet.nv"
    assert tool("flash-params", wanted, "--nodes", "1-3", "--check", channel=fleet)[0] == 1
    code, out, _ = tool("flash-params", wanted, "--nodes", "1-3", "--yes", channel=fleet)
    assert code == 0 and out.count("PASS stored") == 3 and len(out.splitlines()) == 4
    for node in "123":
        assert tool("-n", node, "verify", wanted, channel=fleet)[0] == 0
    assert len(list((tmp_path / "home" / "journals").iterdir())) == 3


def test_an_unattended_fleet_needs_a_proven_set_and_its_serial_numbers(tool: Tool, wanted: str) -> None:
    Path("serials.txt").write_text("1 22001\n", encoding="utf-8")
    given = ("flash-params", wanted, "--nodes", "1", "--yes", "--serials", "serials.txt")
    code, _, err = tool(*given)
    assert code == 2 and "--canary RUN_DIR" in err
    assert tool("flash-params", wanted, "--yes", "--serials", "serials.txt")[0] == 2, "it is about several nodes"


def test_yes_for_several_drives_asks_for_their_list(tool: Tool, wanted: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before, it asked for --serial, which a command for several drives refuses."""
    monkeypatch.setattr(BusOptions, "simulated", lambda _: False)
    code, _, err = tool("flash-params", wanted, "--nodes", "1", "--yes")
    assert code == 7 and "--yes --serials FILE" in err and "--serial " not in err


def test_a_wrong_node_id_is_told_in_one_short_line(tool: Tool) -> None:
    code, _, err = tool("info", "-n", "5")
    assert code == 3 and "no answer to the upload request within 0.3 s (3 tries)\n" in err
    assert "only others were heard, node 1: wrong node id?" in err and "`pmsmtool scan` without -n" in err


def test_fleet_with_one_bad_drive_serves_the_others(tool: Tool, wanted: str, tmp_path: Path) -> None:
    (tmp_path / "faults.toml").write_text('[[refuse]]\nobject = "0x1010:01"\ncode = 0x08000020\ncount = 1\n')
    fleet = "interior-2k2?nodes=2&nv=fleet.nv&faults=faults.toml"
    code, out, _ = tool("flash-params", wanted, "--nodes", "1,2", "--yes", channel=fleet)
    assert code == 4 and out.count("FAIL") >= 1
    assert [line[:4].strip() for line in out.splitlines() if line[:4].strip()] == ["node", "1", "2"]


@pytest.mark.parametrize("nodes", ["0", "3-1", "1,x", "200"])
def test_node_lists_that_are_none(tool: Tool, wanted: str, nodes: str) -> None:
    assert tool("flash-params", wanted, "--nodes", nodes)[0] == 2


# ---- moving -----------------------------------------------------------------------------------------------


def test_jog_current(tool: Tool) -> None:
    found = loaded(tool("jog", "--current", "2Apk", "--angle", "90deg", "--for", "0.5s", "--yes", "--json"))
    assert found["readings"][-1]["i_d_a"] == pytest.approx(2.0, abs=0.1)
    assert found["dead_man"]["measured_s"] <= found["dead_man"]["declared_s"]


def test_a_speed_jog_whose_shaft_stands_says_so(tool: Tool) -> None:
    """Factory memory has speed gains of 0."""
    code, _, err = tool("jog", "--speed", "100rpm", "--for", "0.5s", "--yes")
    assert code == 10 and "the shaft ran at 0 rpm in place of 100 rpm" in err and "speed.K*" in err


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (("--for", "1s", "--yes"), 2, "one of --current and --speed"),
        (("--current", "2Apk"), 7, "at most 2 Apk"),
        (("--current", "50Apk", "--yes"), 5, "the machine's largest"),
        (("--speed", "9000rpm", "--yes"), 5, "the machine's largest"),
        (("--speed", "100rpm", "--shaft", "locked", "--yes"), 5, "--shaft locked is given"),
        (("--current", "2Apk", "--i-max", "0Apk", "--yes"), 2, "above zero"),
        (("--current", "2Apk", "--for", "0s", "--yes"), 2, "above zero"),
        (("--current", "2Apk", "--load", "gravity", "--yes"), 5, "gravity"),
        (("--current", "2A", "--yes"), 2, "peak"),
    ],
)
def test_jog_refuses(tool: Tool, arguments: tuple[str, ...], code: int, text: str) -> None:
    found = tool("jog", *arguments)
    assert found[0] == code and text in found[2]


def test_stop(tool: Tool) -> None:
    found = loaded(tool("stop", "--all", "--json", channel="interior-2k2?nodes=2&nv=:memory:"))
    assert [entry["node"] for entry in found["stopped"]] == [1, 2]


def test_stop_that_is_not_confirmed_is_exit_8(tool: Tool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(DriveNode, "state", lambda self: None)
    code, _, err = tool("-n", "1", "stop")
    assert code == 8 and "STOP NOT CONFIRMED" in err and "hardware stop" in err


@pytest.mark.parametrize("whom", [("-n", "99", "stop"), ("stop",), ("stop", "--all")])
def test_stop_that_reaches_no_drive_is_exit_8(
    tool: Tool, monkeypatch: pytest.MonkeyPatch, whom: tuple[str, ...]
) -> None:
    """Exit code 3 only where no adapter opened: here it did."""
    monkeypatch.setattr("pmsmtool.bus.nmt.find_nodes", lambda connection: [])
    code, _, err = tool(*whom)
    assert code == 8 and "STOP NOT CONFIRMED" in err and "hardware stop" in err


# ---- bad buses and bad drives -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "channel", "code", "text"),
    [
        (("info",), "no-such-profile", 2, "no profile"),
        (("info",), "interior-2k2?sed=1", 2, "did you mean seed"),
        (("-n", "77", "info"), "interior-2k2?nv=:memory:", 3, "only others were heard, node 1"),
        (("-b", "250000", "-n", "1", "info"), "interior-2k2?nv=:memory:&bitrate=500000", 3, "only error frames"),
        (("-b", "250000", "scan"), "interior-2k2?nv=:memory:&bitrate=500000", 3, "wrong bit rate"),
        (("--trace-can", "bus.xyz", "scan"), "interior-2k2?nv=:memory:", 2, ".asc"),
        (("--trace-can", "no/folder/bus.asc", "scan"), "interior-2k2?nv=:memory:", 2, "cannot be written"),
        (("flash-params", "missing.toml", "--yes"), "interior-2k2?nv=:memory:", 2, "missing.toml"),
        (("restore", "missing.json", "--yes"), "interior-2k2?nv=:memory:", 2, "missing.json"),
        (("verify", "missing.toml", "--map", "none.toml"), "interior-2k2?nv=:memory:", 2, "none.toml"),
    ],
)
def test_bad_bus_message_and_exit_code(
    tool: Tool, arguments: tuple[str, ...], channel: str, code: int, text: str
) -> None:
    found = tool(*arguments, channel=channel)
    assert (found[0], found[1]) == (code, "") and text in found[2], found


def test_trace_records_both_directions(tool: Tool, tmp_path: Path) -> None:
    assert tool("--trace-can", "bus.asc", "info")[0] == 0
    with can.LogReader(str(tmp_path / "bus.asc")) as reader:
        ids = {message.arbitration_id for message in reader}
    assert {0x601, 0x581} <= ids


@pytest.mark.chain
def test_python_cans_own_configuration_decides(tmp_path: Path) -> None:
    environment = {
        **os.environ,
        "HOME": str(tmp_path),
        "PYTHONPATH": str(ROOT),
        "CAN_INTERFACE": "virtual",
        "CAN_CHANNEL": "nobody",
    }
    done = subprocess.run(
        [sys.executable, "-m", "pmsmtool", "scan"], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 3 and "nobody" in done.stderr


def test_no_interface_at_all_says_how_to_name_one(tmp_path: Path) -> None:
    environment = {k: v for k, v in os.environ.items() if not k.startswith("CAN_")} | {
        "HOME": str(tmp_path),
        "PYTHONPATH": str(ROOT),
    }
    done = subprocess.run(
        [sys.executable, "-m", "pmsmtool", "scan"], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 3 and "no CAN interface is configured" in done.stderr and "-i pmsmsim" in done.stderr


# ---- network ----------------------------------------------------------------------------------------------


def test_nmt(tool: Tool) -> None:
    assert loaded(tool("nmt", "start", "--json"))["nmt_state"] == "operational"
    assert loaded(tool("nmt", "reset-node", "--json"))["nmt_state"] == "boot-up"
    code, out, err = tool("nmt", "stop")
    assert code == 0 and "STOPPED" in out, err


def test_nmt_is_refused_while_enabled(tool: Tool, monkeypatch: pytest.MonkeyPatch) -> None:
    from pmsmtool.cia402 import State

    monkeypatch.setattr(DriveNode, "state", lambda self: State.OPERATION_ENABLED)
    assert tool("nmt", "reset-node")[0] == 5


def test_lss_finds_a_node_without_an_id_and_gives_it_one(tool: Tool) -> None:
    fresh = "interior-2k2?node=255&nv=fresh.nv"
    assert loaded(tool("lss", "scan", "--json", channel=fresh))["found"]["serial"] == 22001
    assert tool("lss", "set-node", "9", channel=fresh)[0] == 7
    code, out, err = tool("lss", "set-node", "9", "--store", "--yes", channel=fresh)
    assert code == 0 and "serial 22001 is node 9" in out, err
    assert loaded(tool("scan", "--json", channel="interior-2k2?nv=fresh.nv"))["nodes"][0]["node"] == 9


@pytest.mark.parametrize("command", [("jog", "--current", "0.1Apk"), ("identify", "R"), ("commission",)])
def test_a_current_limit_that_limits_nothing_is_refused_before_anything_is_energised(
    tool: Tool, command: tuple[str, ...]
) -> None:
    code, _, err = tool(*command, "--i-max", "100000Apk", "--yes")
    assert code == 5, err
    assert "the current limit of 1e+05 A (peak) is none" in err and "at most 30 times that" in err
    assert "0x6075" in err and "--i-max" in err
    assert "supervision tested" not in err


def test_lss_works_as_often_as_it_is_asked_between_two_power_ons(tool: Tool) -> None:
    """The drive keeps its power: a scan left it in the configuration state, where no other scan finds it."""
    fresh = "interior-2k2?node=255&nv=fresh.nv"
    bus = PmsmSimBus(fresh)
    try:
        for _ in range(2):
            assert loaded(tool("lss", "scan", "--json", channel=fresh))["found"]["serial"] == 22001
        assert tool("lss", "set-node", "9", channel=fresh)[0] == 7, "declined"
        assert loaded(tool("lss", "scan", "--json", channel=fresh))["found"]["serial"] == 22001
        assert tool("lss", "set-node", "9", "--yes", channel=fresh)[0] == 0
    finally:
        bus.shutdown()


def test_lss_with_nobody_to_configure(tool: Tool) -> None:
    assert "no unconfigured node" in tool("lss", "scan")[1]
    assert tool("lss", "set-node", "9", "--yes")[0] == 3
    assert tool("lss", "set-node", "1", "--yes")[0] == 2, "the id is taken"


@pytest.mark.parametrize("command", ["flash_params", "restore", "param", "monitor"])
def test_looking_at_a_drive_before_writing_has_a_deadline(
    command: str, tool: Tool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every answer may come in time and the command still not end; the time of the person's answer does not count."""
    arguments = {
        "flash_params": ("flash-params", "set.toml", "--yes"),
        "restore": ("restore", "--yes"),
        "param": ("param", "set", "speed.filter_hz=150", "--yes"),
        "monitor": ("monitor", "--for", "1s"),
    }[command]
    Path("set.toml").write_text(ParameterSet({"motor.pole_pairs": 5.0}).to_toml(), encoding="utf-8")
    assert tool("flash-params", "set.toml", "--yes")[0] == 0
    limit = "LOOKING_S" if command == "monitor" else "WHOLE_SET_S"
    monkeypatch.setattr(f"pmsmtool.cli.{command}.{limit}", 1e-3)
    code, _, told = tool(*arguments)
    assert code == 3 and "the command takes too long" in told, (code, told)
