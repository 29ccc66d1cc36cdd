# SPDX-License-Identifier: MIT
"""The chain without identification: from an identified machine to a drive that is proven, and every way out."""

from __future__ import annotations

import shutil
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import pytest

from benchmarks.prove_verdicts import Shared
from pmsmtool.bus.connect import Connection
from pmsmtool.commissioning import commission, level_stages
from pmsmtool.commissioning.commission import STAGES, Commissioning, begin_run, due_stages
from pmsmtool.commissioning.export import image_of
from pmsmtool.commissioning.flash_stages import _map_option
from pmsmtool.design.loops.margins import MarginRequest
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.drive_node import is_safe
from pmsmtool.drive.parameters import DriveParameters
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import (
    CheckFailed,
    ConfigError,
    Contradiction,
    Declined,
    ExitCode,
    Interrupted,
    SafetyRefusal,
    VerifyMismatch,
)
from pmsmtool.files import data_folder
from pmsmtool.firmware.image import crc32
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.params.parameter_set import read_parameter_set
from pmsmtool.proof import stage as proof_stage
from pmsmtool.proof.stage import ProofRequest
from pmsmtool.run_directory import Acceptance, RunDirectory, Stage
from pmsmtool.sim.bus import PmsmSimBus

pytestmark = pytest.mark.chain

PROFILE = "interior-2k2"
FEW_MACHINES = ProofRequest(runs=16, experiments=("speed_step", "q_steps"))
"""The proof's own tests draw more machines and run every experiment; here it is one of the stages."""
SHARED = Shared()
"""Every chain here ends at the same design, and needs its prediction once."""


class Told:
    """A person who agrees unless told otherwise, and notes what was shown."""

    def __init__(self, *, writes: bool = True) -> None:
        self.writes = writes
        self.shown: list[Sequence[str]] = []
        self.moved: list[Sequence[str]] = []

    def allow_motion(self, lines: Sequence[str]) -> None:
        self.moved.append(lines)

    def allow_writing(self, lines: Sequence[str]) -> None:
        self.shown.append(lines)
        if not self.writes:
            raise Declined("no")


class Noted:
    """Notes which stages ran and which were skipped."""

    def __init__(self) -> None:
        self.skipped: list[str] = []
        self.ended: list[tuple[str, str]] = []

    def skip(self, stage: Stage, number: int, count: int) -> None:
        self.skipped.append(stage.name)

    def begin(self, name: str, number: int, count: int) -> None:
        pass

    def say(self, text: str) -> None:
        pass

    def end(self, stage: Stage, number: int, count: int) -> None:
        self.ended.append((stage.name, stage.status))


@contextmanager
def drive_on(channel: str) -> Iterator[CanopenDrive]:
    with Connection(PmsmSimBus(channel)) as connection:
        drive = CanopenDrive(connection, 1)
        try:
            yield drive
        finally:
            drive.close()


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PMSMTOOL_HOME", str(tmp_path / "home"))
    monkeypatch.setattr(proof_stage, "predict_proof", SHARED.predict)


@pytest.fixture
def drive(tmp_path: Path) -> Iterator[CanopenDrive]:
    with drive_on(f"{PROFILE}?nv={tmp_path / 'drive.nv'}") as found:
        yield found


@dataclass(frozen=True)
class Ended:
    """A chain that has ended: folder of ``run`` and the drive's memory; frames, stages, consents, and what acts."""

    folder: Path
    frames: int
    progress: Noted
    person: Told
    active_crc: int


@pytest.fixture(scope="module")
def ended_once(tmp_path_factory: pytest.TempPathFactory) -> Ended:
    folder = tmp_path_factory.mktemp("ended")
    with pytest.MonkeyPatch.context() as patch, drive_on(f"{PROFILE}?nv={folder / 'drive.nv'}") as drive:
        patch.setenv("PMSMTOOL_HOME", str(folder / "home"))
        patch.setattr(proof_stage, "predict_proof", SHARED.predict)
        run, person = identified(folder, drive), Told()
        frames, progress = _frames(run, drive, patch, None, person)
        assert is_safe(drive.node.state())
        crc = active_crc(drive)
    run.path.rename(folder / "run")
    return Ended(folder, frames, progress, person, crc)


@pytest.fixture
def ended(ended_once: Ended, tmp_path: Path) -> Iterator[tuple[RunDirectory, CanopenDrive]]:
    """A copy of that chain, and a drive with its memory."""
    shutil.copytree(ended_once.folder / "run", tmp_path / "run")
    shutil.copy(ended_once.folder / "drive.nv", tmp_path / "drive.nv")
    with drive_on(f"{PROFILE}?nv={tmp_path / 'drive.nv'}") as found:
        yield RunDirectory(tmp_path / "run"), found


EXACTLY = ("std", "systematic", "total_95")
"""Parts of the interval of a value."""


def identified(folder: Path, drive: CanopenDrive) -> RunDirectory:
    """A run whose identification has passed, as if the profile's own numbers had been measured."""
    run = begin_run(drive, folder)
    shutil.copy(data_folder("profiles") / f"{PROFILE}.toml", run.path / "machine.toml")
    good = [Acceptance("measured", "yes", "yes", True)]
    run.add(Stage("identify", "pass", 9.0, acceptance=good, files={"machine.toml": ""}))
    return run


def finish(run: RunDirectory, drive: CanopenDrive, person: Told | None = None, **asked: object) -> Noted:
    progress = Noted()
    asked = {"prove": FEW_MACHINES, **asked}
    Commissioning(run, drive, person or Told(), progress, **asked).carry_out()  # type: ignore[arg-type]
    return progress


def active_crc(drive: CanopenDrive) -> int:
    return DriveParameters(drive.node).crc_active


def test_the_drive_holds_the_design_and_the_record_says_so(
    ended_once: Ended, ended: tuple[RunDirectory, CanopenDrive]
) -> None:
    (run, drive), person, progress = ended, ended_once.person, ended_once.progress
    assert progress.skipped == ["identify"]
    assert progress.ended == [(name, "pass") for name in STAGES[1:]]
    assert len(person.shown) == 1 and any("current.K_p_d_v_per_a" in line for line in person.shown[0])
    wanted = read_parameter_set(run.path / "params.toml")
    assert ended_once.active_crc == DriveParameters(drive.node).crc_stored == crc32(image_of(wanted))
    record = run.read()
    assert all(record.passed(name) for name in STAGES)
    assert all(line.ok for stage in record.stages for line in stage.acceptance)
    recorded = {name: digest for stage in record.stages for name, digest in stage.files.items()}
    assert {name: run.sha256(name) for name in recorded} == recorded
    proof = {name for name in recorded if name.startswith("prove/")}
    assert {name.rsplit("/", 1)[1] for name in proof} >= {"prediction.npz", "speed_step.npz", "q_steps.npz"}
    assert set(recorded) - proof == {"machine.toml", "design.toml", "lut.npz", "lut.csv", "params.toml"}
    assert len(person.moved) == 1 and any("speed step" in line for line in person.moved[0])
    assert due_stages(run, record) == ()
    assert finish(run, drive, Told(writes=False)).skipped == list(STAGES)


def test_a_chain_that_ended_goes_on_where_it_ended(
    tmp_path: Path, drive: CanopenDrive, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ended before every stage in turn: each time the one stage that was missing runs, and no other."""
    run = identified(tmp_path, drive)
    steps = Commissioning._steps
    for done, missing in pairwise(STAGES):

        def ending(self: Commissioning, missing: str = missing) -> dict[str, Callable[[], Stage]]:
            def end() -> Stage:
                raise KeyboardInterrupt

            return {**steps(self), missing: end}

        progress = Noted()
        monkeypatch.setattr(Commissioning, "_steps", ending)
        with pytest.raises(Interrupted):
            Commissioning(run, drive, Told(), progress, prove=FEW_MACHINES).carry_out()
        ran = [name for name, status in progress.ended if status == "pass"]
        assert ran == ([] if done == "identify" else [done])
        record = run.read()
        assert record.stages[-1].status == "interrupted"
        assert {key: record.account[key] for key in ("state", "stage", "exit_code")} == {
            "state": "interrupted", "stage": missing, "exit_code": 130
        }  # fmt: skip
        assert record.account["files"]["machine.toml"] == run.sha256("machine.toml")
    monkeypatch.setattr(Commissioning, "_steps", steps)
    assert finish(run, drive).ended == [(STAGES[-1], "pass")]
    assert run.read().account["state"] == "complete"


def test_an_interruption_while_the_stage_is_announced_is_its_end(tmp_path: Path, drive: CanopenDrive) -> None:
    """Its end was not recorded: the report said "begun, and its end was not recorded"."""

    class Announcing(Noted):
        def begin(self, name: str, number: int, count: int) -> None:
            raise KeyboardInterrupt

    run = identified(tmp_path, drive)
    with pytest.raises(Interrupted):
        Commissioning(run, drive, Told(), Announcing()).carry_out()
    assert (run.read().stages[-1].name, run.read().stages[-1].status) == ("tune", "interrupted")


@pytest.mark.parametrize("lost", ["machine.toml", "design.toml", "lut.npz", "params.toml"])
def test_a_lost_file_has_its_stage_and_all_later_ones_run_again(
    lost: str, ended: tuple[RunDirectory, CanopenDrive]
) -> None:
    run, _ = ended
    assert due_stages(run, run.read()) == ()
    (run.path / lost).unlink()
    first = {"machine.toml": "identify", "design.toml": "tune"}.get(lost, "lut")
    assert due_stages(run, run.read()) == STAGES[STAGES.index(first) :]


def test_a_stage_that_ran_again_makes_the_later_ones_stale(ended: tuple[RunDirectory, CanopenDrive]) -> None:
    run, _ = ended
    run.add(run.read().stage("tune"))  # type: ignore[arg-type]
    assert due_stages(run, run.read()) == STAGES[2:]


@pytest.mark.parametrize("name", ["machine.toml", "design.toml", "params.toml", "lut.csv"])
def test_an_edited_file_is_named_and_nothing_is_done(name: str, ended: tuple[RunDirectory, CanopenDrive]) -> None:
    run, drive = ended
    crc = active_crc(drive)
    with (run.path / name).open("a") as file:
        file.write("# mine\n")
    with pytest.raises(ConfigError, match=name) as caught:
        finish(run, drive)
    assert caught.value.exit_code == ExitCode.USAGE
    assert active_crc(drive) == crc


def test_declined_writing_changes_nothing_and_can_be_taken_back(tmp_path: Path, drive: CanopenDrive) -> None:
    run, crc = identified(tmp_path, drive), active_crc(drive)
    with pytest.raises(Declined):
        finish(run, drive, Told(writes=False))
    assert active_crc(drive) == crc
    assert (run.read().stages[-1].name, run.read().stages[-1].status) == ("flash", "refused")
    assert finish(run, drive).ended == [("flash", "pass"), ("verify", "pass"), ("prove", "pass")]


def test_the_chain_ends_at_the_first_criterion_that_is_not_met(tmp_path: Path, drive: CanopenDrive) -> None:
    run, crc, person = identified(tmp_path, drive), active_crc(drive), Told()
    with pytest.raises(CheckFailed, match="current_d_phase") as caught:
        finish(run, drive, person, margins=MarginRequest(phase_margin_deg=75.0))
    assert caught.value.exit_code == ExitCode.CHECK_FAILED
    assert person.shown == [] and active_crc(drive) == crc
    assert run.read().stages[-1].name == "margins" and run.read().stages[-1].status == "fail"


def test_verify_finds_a_byte_that_somebody_changed(ended: tuple[RunDirectory, CanopenDrive]) -> None:
    run, drive = ended
    record = run.read()
    run.write(replace(record, stages=[stage for stage in record.stages if stage.name != "verify"]))
    drive.write({"motor.R_s_ohm": 2.0})
    with pytest.raises(VerifyMismatch, match=r"motor\.R_s_ohm: 2 instead of 3\.6") as caught:
        finish(run, drive)
    assert caught.value.exit_code == ExitCode.CHECK_FAILED
    assert [line.ok for line in run.read().stages[-1].acceptance] == [False, False, True]


def test_another_drive_is_refused(tmp_path: Path, drive: CanopenDrive) -> None:
    run = identified(tmp_path, drive)
    run.write(replace(run.read(), drive={**run.read().drive, "serial": 4711}))
    with pytest.raises(SafetyRefusal, match="instead of 4711"):
        finish(run, drive)
    assert len(run.read().stages) == 1


def test_ctrl_c_in_the_middle_leaves_old_or_new_and_goes_on(
    tmp_path: Path, ended_once: Ended, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Signals while a frame is awaited, one after the other in one run: twice in the writing, and in the proof.

    Each comes after a share of all the frames that the chain takes; what had ended before is not done again.
    """
    with drive_on(f"{PROFILE}?nv={tmp_path / 'second.nv'}") as second:
        run, crc = identified(tmp_path / "cut", second), active_crc(second)
        for share, stage in ((0.02, "flash"), (0.4, "flash"), (0.97, "prove")):
            with pytest.raises(Interrupted) as caught:
                _frames(run, second, monkeypatch, int(share * ended_once.frames))
            assert caught.value.exit_code == ExitCode.INTERRUPTED
            assert is_safe(second.node.state())
            assert active_crc(second) in (crc, crc32(image_of(read_parameter_set(run.path / "params.toml"))))
            last = run.read().stages[-1]
            assert (last.name, last.status) == (stage, "interrupted")
        assert finish(run, second).ended == [("prove", "pass")]


def _frames(
    run: RunDirectory,
    drive: CanopenDrive,
    monkeypatch: pytest.MonkeyPatch,
    stop_at: int | None,
    person: Told | None = None,
) -> tuple[int, Noted]:
    count = 0
    bus = drive.node.connection.bus
    send = bus.send

    def counted(*arguments: object, **options: object) -> None:
        nonlocal count
        count += 1
        if count == stop_at:
            signal.raise_signal(signal.SIGINT)
        send(*arguments, **options)  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        patch.setattr(bus, "send", counted)
        progress = finish(run, drive, person)
    return count, progress


def test_every_stage_has_a_step(tmp_path: Path, drive: CanopenDrive) -> None:
    assert tuple(Commissioning(identified(tmp_path, drive), drive, Told(), Noted())._steps()) == STAGES
    assert set(commission.OUTPUTS) <= set(STAGES)


def test_a_measured_flux_that_contradicts_the_file_ends_the_chain(
    tmp_path: Path, drive: CanopenDrive, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Full level, flux 65 % and inertia 5 times too high in the file: nothing is designed, nothing written."""
    truth = load_machine_file(data_folder("profiles") / f"{PROFILE}.toml")
    machine = truth.machine
    assert machine.J_kgm2 is not None
    wrong = replace(machine, psi_f_wb=1.65 * machine.psi_f_wb, J_kgm2=5.0 * machine.J_kgm2)
    values = [
        {"name": key, "value": getattr(machine, key), "unit": "1", "T_c": 20.0, **dict.fromkeys(EXACTLY, 0.0)}
        for key in ("pole_pairs", "R_s_ohm", "L_d_h", "L_q_h", "psi_f_wb", "J_kgm2")
    ]
    measured = Stage("identify", "pass", 1.0, values=values)
    monkeypatch.setattr(level_stages, "identify", lambda *_, **__: measured)
    before = active_crc(drive)
    run = begin_run(drive, tmp_path)
    person = Told()
    sheet = replace(truth, machine=wrong, std={})
    chain = Commissioning(run, drive, person, Noted(), sheet, accept_contradictions=("J_kgm2",))
    with pytest.raises(Contradiction) as ended:
        chain.carry_out()
    text = str(ended.value)
    assert "psi_f_wb: the data sheet states" in text and "measured 0.545 Wb" in text and "J_kgm2:" not in text
    assert ended.value.exit_code == ExitCode.CHECK_FAILED
    assert active_crc(drive) == before and not person.shown and not (run.path / "design.toml").exists()
    rows = {row["name"]: row["verdict"] for row in run.read().stage("identify").comparison}  # type: ignore[union-attr]
    assert (rows["psi_f_wb"], rows["J_kgm2"], rows["R_s_ohm"]) == ("contradicts", "accepted", "agrees")


def test_differences_that_follow_from_unchecked_values_say_so(tmp_path: Path, drive: CanopenDrive) -> None:
    run = identified(tmp_path, drive)
    stage = run.read().stages[0]
    row = {"name": "R_s_ohm", "verdict": "NOT CHECKED", "source": "data sheet", "text": "", "unit": "ohm"}
    run.write(replace(run.read(), stages=(replace(stage, comparison=[row]),)))
    person = Told(writes=False)
    with pytest.raises(Declined):
        finish(run, drive, person)
    marked = {line.split()[0] for line in person.shown[0] if line.endswith("from R: NOT CHECKED")}
    assert {"motor.R_s_ohm", "current.K_i_d_v_per_as", "current.K_i_q_v_per_as"} <= marked
    assert "current.K_p_d_v_per_a" not in marked
    assert person.shown[0][-1] == "undo      `pmsmtool restore` brings the old values back"
    assert _map_option(load_family("epos4")) == " --map epos4"
    assert _map_option(replace(load_family("epos4"), name="mine")) == " --map FILE", "no shipped family"
