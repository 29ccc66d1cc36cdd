# SPDX-License-Identifier: MIT
"""``commission`` from the command line: resumed to its end, another process, Ctrl-C, and everything that can be wrong.

The README's own session is a whole chain from an unknown machine; ``benchmarks/whole_commission.py`` draws any number,
and CONTRIBUTING names the command for one that saturates.
What is measured has its tests in ``test_identify.py`` (behind a switched inverter) and ``tests/measurement`` (mapped).
"""

from __future__ import annotations

import json
import re
import shutil
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import pytest

from benchmarks.random_drives import true_loop_resistance
from pmsmtool.bus.clock import VirtualClock
from pmsmtool.bus.connect import Connection
from pmsmtool.cli import consent
from pmsmtool.cli.commission import _kept_nameplate
from pmsmtool.commissioning import commission
from pmsmtool.commissioning.commission import STAGES, has_measured
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.drive_node import is_safe
from pmsmtool.drive_maps.drive_map import REFERENCE_PRODUCT, REFERENCE_VENDOR, reference_map
from pmsmtool.drive_maps.drive_map_file import dump_drive_map
from pmsmtool.files import data_folder
from pmsmtool.flash.restore import take_backup
from pmsmtool.identification.request import NAMEPLATE, REQUEST, IdentifyRequest, dump_request
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file, load_machine_file
from pmsmtool.report.verdict import NEEDED
from pmsmtool.run_directory import RunDirectory, RunRecord, Stage, Status, new_record
from pmsmtool.sim.bus import PmsmSimBus
from tests.cli.conftest import Tool
from tests.drive.served import serving

pytestmark = [pytest.mark.chain, pytest.mark.usefixtures("undrawn")]

TOLERANCE = 0.01
"""Largest deviation of an identified value from the truth with ideal sensor gains; measured 0.2 % (benchmarks/
commissioning.py)."""
BUSY_RETRIES = 5
"""The served drive runs in real time; a machine that is busy with other things may starve it."""


@pytest.fixture
def few_machines(monkeypatch: pytest.MonkeyPatch) -> None:
    """A proof of two experiments, with a sixth of the machines the tool draws, where it is one of the stages."""
    proof_within = commission.proof_within
    monkeypatch.setattr(
        commission,
        "proof_within",
        lambda asked: replace(proof_within(asked), runs=16, experiments=("speed_step", "q_steps")),
    )


def the_run() -> tuple[RunDirectory, RunRecord]:
    (folder,) = Path("runs").iterdir()
    return RunDirectory(folder), RunDirectory(folder).read()


def machine_file(name: str, model: str) -> MachineFile:
    """A profile with one of the two inverter models."""
    base = load_machine_file(data_folder("profiles") / f"{name}.toml")
    return replace(base, simulation={**base.simulation, "inverter_model": model})


def identified(folder: Path, serial: int = 22001, **drive: Any) -> RunDirectory:
    """A run whose identification has passed, as if the profile's own numbers had been measured."""
    reference = {"node": 1, "vendor": REFERENCE_VENDOR, "product": REFERENCE_PRODUCT, "name": "pmsmsim b"}
    drive = {**reference, "serial": serial, **drive}
    run = RunDirectory(folder)
    folder.mkdir(parents=True)
    run.write(new_record(["test"], drive=drive, bus={}, versions={}))
    shutil.copy(data_folder("profiles") / "interior-2k2.toml", folder / "machine.toml")
    values = [{"name": name, "value": 1.0, "std": 0.0, "systematic": 0.0, "unit": "ohm"} for name in NEEDED]
    run.add(Stage("identify", "pass", 9.0, values=values, files={"machine.toml": ""}))
    return run


# ---- to its end --------------------------------------------------------------------------------------


@pytest.mark.usefixtures("few_machines")
def test_a_failed_criterion_ends_the_chain_and_resume_goes_on_there_on_the_runs_own_bus(tool: Tool) -> None:
    bus = ("-i", "pmsmsim", "-c", "interior-2k2?nv=drive.nv", "--yes")
    before = backup("interior-2k2?nv=drive.nv")
    directory = identified(Path("run"))
    remembered = {"interface": "pmsmsim", "channel": "interior-2k2?nv=drive.nv", "bitrate": None, "node": 1}
    directory.write(replace(directory.read(), bus=remembered))
    measured = (directory.path / "machine.toml").read_bytes()
    code, out, err = tool("commission", *bus, "--resume", "run", "--gain-margin-db", "12", "--bandwidth-hz", "900")
    assert code == 1 and out == "" and "asked for: 45 degree, 12 dB" in err
    assert [(stage.name, stage.status) for stage in directory.read().stages] == [("identify", "pass"), ("tune", "fail")]
    assert ">SIMULATED DRIVE, FAIL: tune: " in (directory.path / "report.html").read_text()
    assert backup("interior-2k2?nv=drive.nv") == before
    code, out, err = tool("commission", "--resume", "run", "--yes", "--json")
    assert code == 0, err
    assert "identify  PASS  as recorded, not run again" in err
    found = json.loads(out)
    assert found["schema"] == "pmsmtool.commission/1" and found["verdict"] == "PASS"
    assert [stage["name"] for stage in found["stages"]] == list(STAGES)
    assert found["drive"]["node"] == 1 and found["drive"]["serial"] > 0
    assert any(line.startswith("current   at most") for line in found["limits"])
    assert all(criterion["ok"] for stage in found["stages"] for criterion in stage["criteria"])
    assert 0.0 < found["seconds"]["wall"] and found["seconds"]["bus"] == sum(s["seconds"] for s in found["stages"])
    record = directory.read()
    assert [given["subject"] for given in record.consents] == ["writing", "motion"]
    assert record.stages[-1].name == "prove" and record.stages[-1].status == "pass"
    page = (directory.path / "report.html").read_text()
    assert ">SIMULATED DRIVE, PASS: 7 of 7 stages ran" in page and page.count("<svg") == 10
    assert (directory.path / "machine.toml").read_bytes() == measured
    assert tool("verify", *bus[:-1], "run")[0] == 0
    assert tool("commission", "--resume", "run")[0] == 0, "nothing is left to do, so nobody is asked"


@pytest.mark.wall_clock
@pytest.mark.timeout(200)  # in real time, and with its repetitions where the machine is busy
def test_through_another_process_with_the_limits_a_real_drive_needs(
    tool: Tool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Consents and envelope of the chain; its measurement in real time is that of ``identify``, here of R alone."""
    with serving("--nv", str(tmp_path / "served.nv")) as server:
        monkeypatch.setenv("CAN_INTERFACE", "socketcand")
        monkeypatch.setenv("CAN_CHANNEL", "vcan0")
        monkeypatch.setenv("CAN_CONFIG", json.dumps({"host": "127.0.0.1", "port": server.port}))
        code, _, err = tool("commission", "--yes")
        assert code == 7 and "missing here: --i-max, --speed-max, --shaft, --serial" in err
        assert not list(Path("runs").iterdir())
        limits = ("--i-max", "7.3Apk", "--speed-max", "3000rpm", "--shaft", "free", "--serial", "22001")
        for _ in range(BUSY_RETRIES):
            code, out, err = tool("identify", "R", "--yes", *limits, "--accuracy", "0.02", "--json")
            if code == 0:
                break
            # This machine was too busy for a heartbeat of 0.2 s: the drive was stopped.
            assert "busy" in err or "heartbeat" in err, err
        assert code == 0, err
        (found,) = (value for value in json.loads(out)["values"] if value["name"] == "R_s_ohm")
        truth = true_loop_resistance(load_machine_file(data_folder("profiles") / "interior-2k2.toml"))
        assert found["value"] == pytest.approx(truth, rel=TOLERANCE)


# ---- less than everything ---------------------------------------------------------------------------------

COPLEY = ("-i", "pmsmsim", "-c", "interior-2k2?nv=:memory:&drive=cia402&bitrate=125000", "--yes")
STANDARD: dict[str, Any] = {"vendor": 0, "product": 0, "name": "simulated cia402 interior-2k2"}
"""The identity of that drive."""
SHEET = str(data_folder("profiles") / "interior-2k2.toml")


def test_a_stage_that_is_required_and_cannot_be_had_ends_it_before_anything_moves(tool: Tool) -> None:
    code, out, err = tool("commission", SHEET, *COPLEY, "--require", "tune", "--require", "prove", "--json")
    assert code == 1 and "required, and cannot be had: prove: not available" in err
    assert "Apk" not in err, "no envelope to consent to"
    found = json.loads(out)
    assert (found["verdict"], found["simulated"], found["stages"]) == ("FAIL", True, [])
    directory, record = the_run()
    assert record.request["require"] == ["tune", "prove"]
    assert tool("commission", *COPLEY, "--resume", str(directory.path))[0] == 1, "it stays required"


def test_a_stage_that_turns_out_to_be_missing_ends_a_chain_that_requires_it(tool: Tool) -> None:
    run = str(identified(Path("runs", "begun"), **STANDARD).path)
    code, _, err = tool("commission", *COPLEY, "--resume", run, "--require", "margins")
    assert code == 1 and "margins: not available" in err
    assert [stage.name for stage in the_run()[1].stages][-1] == "margins"


def test_a_design_below_the_ratings_fails_unless_a_person_accepts_each_limit(tool: Tool) -> None:
    run = str(identified(Path("run"), **STANDARD).path)
    resumed = ("commission", *COPLEY, "--drive-bandwidth-hz", "800", "--resume", run)
    code, _, err = tool(*resumed)
    assert code == 1, "--yes does not accept it"
    assert "A pk, limit >= 6.08 A pk (or --accept-limit current)" in err
    assert "rpm, limit >= 1500 rpm (or --accept-limit speed)" in err
    code, _, err = tool(*resumed, "--accept-limit", "speed")
    assert code == 1 and "rated current within the design" in err and "rated speed within" not in err
    code, out, _ = tool(*resumed, "--accept-limit", "speed", "--accept-limit", "current")
    assert code == 10 and out.splitlines()[-1].startswith("SIMULATED DRIVE, PARTIAL: 4 of 7 stages ran")
    assert re.search(r"accepted \(--accept-limit speed\): the design ends at [\d.]+ rpm, rated 1500 rpm", out)


def test_a_script_accepts_no_limit_on_a_real_bus(tool: Tool) -> None:
    code, _, err = tool("commission", "-i", "socketcan", "-c", "none", "--yes", "--accept-limit", "speed")
    assert code == 2 and "--accept-limit and --yes exclude each other on a real bus" in err


# ---- Ctrl-C -----------------------------------------------------------------------------------------------


def backup(channel: str) -> Any:
    """Everything a drive holds and the objects the guard changes; its state must be safe."""
    with Connection(PmsmSimBus(channel)) as connection:
        drive = CanopenDrive(connection, 1)
        assert is_safe(drive.node.state())
        entries = take_backup(drive.node, drive.identity).entries
        limits = [drive.node.sdo.read(*where) for where in ((0x6073, 0), (0x6080, 0), (0x1016, 1), (0x6007, 0))]
        drive.close()
    return entries, limits


@pytest.mark.parametrize(("command", "wait"), [("identify", 20), ("identify", 300), ("commission", 800)])
def test_ctrl_c_while_the_machine_moves(command: str, wait: int, tool: Tool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fifty moments of every moving or writing command are tried by ``benchmarks/interrupted_commands.py``."""
    channel = "interior-2k2?nv=drive.nv"
    count = 0
    pass_time = VirtualClock.wait

    def interrupted(self: VirtualClock, seconds: float) -> None:
        nonlocal count
        count += 1
        if count == wait:
            signal.raise_signal(signal.SIGINT)
        pass_time(self, seconds)

    with PmsmSimBus(channel):  # the drive stays powered when the tool leaves
        before = backup(channel)
        with monkeypatch.context() as patch:
            patch.setattr(VirtualClock, "wait", interrupted)
            code, out, err = tool(command, "-i", "pmsmsim", "-c", channel, "--yes")
        assert count >= wait, "the moment was never reached"
        assert code == 130 and out == "", err
        assert "interrupted: the machine is stopped, voltage off, and the drive restored" in err
        assert "interrupted: interrupted" not in err
        assert backup(channel) == before
    if command == "commission":
        folder = the_run()[0]
        assert (folder.path / NAMEPLATE).is_file() and _kept_nameplate(folder) is None, "it was no data sheet"


def test_a_resumed_run_keeps_its_limits_and_its_machine(tool: Tool) -> None:
    channel = ("-i", "pmsmsim", "-c", "interior-2k2?nv=:memory:")
    assert tool("commission", SHEET, *channel, "--yes", "--load", "gravity")[0] == 5, "it ends before its first stage"
    run = the_run()[0]
    kept = _kept_nameplate(run)
    assert kept is not None and load_machine_file(kept).machine == load_machine_file(Path(SHEET)).machine
    run.save(REQUEST, dump_request(IdentifyRequest(i_max_apk=3.0, speed_max_rad_s=40.0, shaft="coupled")))
    code, _, err = tool("commission", *channel, "--resume", str(run.path))
    assert code == 7 and "current   at most 3 Apk" in err and "speed     at most 382 rpm" in err
    assert "shaft     coupled" in err
    record = run.read()
    run.write(replace(record, request={}, command=("pmsmtool", "identify", "R")))
    assert _kept_nameplate(run) is None, "`identify` is given no machine file"
    run.write(replace(record, drive={**record.drive, "map": "mine"}))
    code, _, err = tool("commission", *channel, "--resume", str(run.path))
    assert code == 2 and "begun with the drive map 'mine', and now 'pmsmsim' is used" in err
    run.write(record)
    err = tool("commission", *channel, "--resume", str(run.path), "--i-max", "2Apk")[2]
    assert "current   at most 2 Apk" in err and "speed     at most 382 rpm" in err


# ---- consents ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("subject", ["motion", "writing"])
def test_each_consent_is_asked_and_each_can_be_declined(
    subject: str, tool: Tool, monkeypatch: pytest.MonkeyPatch
) -> None:
    channel = "interior-2k2?nv=drive.nv"
    before = backup(channel)
    questions: list[str] = []

    def answer(question: str, **_: Any) -> bool:
        questions.append(question)
        return False

    monkeypatch.setattr(consent, "person_present", lambda: True)
    monkeypatch.setattr(click, "confirm", answer)
    begun = ("--resume", str(identified(Path("run")).path)) if subject == "writing" else ()
    code, out, err = tool("commission", "-i", "pmsmsim", "-c", channel, *begun)
    assert code == 7 and out == "", err
    assert len(questions) == 1 and ("Write" in questions[0]) == (subject == "writing")
    assert backup(channel) == before
    assert not list(Path(".").glob("runs/*")), "what was declined before anything moved leaves nothing"
    if subject == "writing":
        record = RunDirectory(Path("run")).read()
        assert (record.stages[-1].name, record.stages[-1].status) == ("flash", "refused")
        assert "current.K_p_d_v_per_a" in err and "objects change" in err


@pytest.mark.parametrize(("status", "kept"), [("partial", True), ("not available", True), ("refused", False)])
def test_a_declined_run_is_removed_only_where_nothing_was_measured(status: Status, kept: bool, tool: Tool) -> None:
    """A mapped drive ends its identification with partial: to decline the writing removed its run."""
    run = identified(Path("run"))
    run.add(Stage("identify", status, 9.0))
    assert has_measured(run) is kept
    (run.path / "traces").mkdir()
    run.save("traces/torque_push_0.npz", b"")
    assert has_measured(run)


# ---- bad input and bad drives ------------------------------------------------------------------------------

DRIVE = ("-i", "pmsmsim", "-c", "interior-2k2?nv=drive.nv", "--yes")
FAULTY = ("-i", "pmsmsim", "--yes", "-c")
BAD: dict[str, tuple[tuple[str, ...], int, str]] = {
    "no such interface": (("-i", "nonsense", "--yes"), 3, "there is no CAN interface 'nonsense'"),
    "no such profile": (("--sim", "interior-2k", "--yes"), 2, "did you mean interior-2k2"),
    "unknown node": ((*DRIVE, "-n", "9"), 3, "only others were heard, node 1"),
    "wrong bit rate": ((*FAULTY, "interior-2k2?bitrate=500000&nv=drive.nv", "-b", "250000"), 3, "wrong bit rate"),
    "another serial number": ((*DRIVE, "--serial", "5"), 7, "serial number is 22001, --serial says 5"),
    "a map for another drive": ((*DRIVE, "--map", "map.toml"), 2, "the map 'other' is for vendor"),
    "nobody to ask": (DRIVE[:-1], 7, "no terminal to ask for consent to move the machine"),
    "drive in fault": ((*FAULTY, "low.toml?nv=drive.nv"), 4, "DC-link under-voltage"),
    "no heartbeat supervision": ((*FAULTY, "interior-2k2?nv=drive.nv&faults=absent.toml"), 5, "0x1016"),
    "write refused": ((*FAULTY, "interior-2k2?nv=drive.nv&faults=refuse.toml", "--resume", "run"), 4, "0x06090030"),
    "another drive than the run's": ((*DRIVE, "--resume", "other"), 5, "serial 22001 instead of 4711"),
    "an edited file": ((*DRIVE, "--resume", "edited"), 2, "machine.toml: not what the stage left"),
    "locked shaft": ((*DRIVE, "--shaft", "locked"), 9, "cannot be identified on a locked shaft"),
    "gravity load": ((*DRIVE, "--load", "gravity"), 5, "a gravity load falls"),
    "a current without a kind": ((*DRIVE, "--i-max", "7A"), 2, "peak or an rms value"),
    "a bandwidth that is none": ((*DRIVE, "--bandwidth-hz", "-1"), 2, "--bandwidth-hz -1.0 is not a positive number"),
    "unwritable folder": ((*DRIVE, "--runs", "taken/below"), 2, "cannot be made"),
    "no such machine file": ((*DRIVE, "nothing.toml"), 2, "no such file"),
    "a machine file that is none": ((*DRIVE, "taken"), 2, "is not TOML"),
    "nothing to resume": (("--resume", "taken"), 2, "no run.json here|is a file"),
    "a machine and a run": (("low.toml", "--resume", "."), 2, "exclude each other"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_and_bad_drives_change_nothing(case: str, tool: Tool) -> None:
    arguments, code, message = BAD[case]
    Path("taken").write_text("not a folder, and not TOML")
    Path("absent.toml").write_text('[[absent]]\nobject = "0x1016"\n')
    Path("refuse.toml").write_text('[[refuse]]\nobject = "0x2020:01"\ncode = "0x06090030"\n')
    Path("map.toml").write_text(dump_drive_map(replace(reference_map(), name="other", vendor=1)))
    identified(Path("run"))
    identified(Path("other"), serial=4711)
    with (identified(Path("edited")).path / "machine.toml").open("a") as file:
        file.write("# mine\n")
    low = machine_file("interior-2k2", "averaged")
    Path("low.toml").write_text(dump_machine_file(replace(low, simulation={**low.simulation, "U_dc_v": 120.0})))
    before = backup("interior-2k2?nv=drive.nv")
    found = tool("commission", *arguments)
    assert (found[0], found[1]) == (code, ""), found[2]
    assert any(part in found[2] for part in message.split("|")), found[2]
    assert "Traceback" not in found[2]
    assert backup("interior-2k2?nv=drive.nv") == before
    runs = [*Path(".").glob("runs/*"), Path("run"), Path("other"), Path("edited")]
    assert not any(RunDirectory(run).read().passed("flash") for run in runs)


def test_a_contradiction_is_accepted_by_a_person_only(tool: Tool) -> None:
    code, _, told = tool("commission", "--sim", "interior-2k2", "--yes", "--accept-contradiction", "R_s_ohm")
    assert code == 2 and "not together with --yes" in told
    code, _, told = tool("commission", "--sim", "interior-2k2", "--accept-contradiction", "pole_pairs")
    assert code == 5 and "pole_pairs cannot be accepted" in told
    assert not Path("runs").exists()
