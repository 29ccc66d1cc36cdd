# SPDX-License-Identifier: MIT
"""Each quantity its own verdict: what one refusal leaves, live, in the chain and in a replay."""

from __future__ import annotations

from pathlib import Path

import pytest

from pmsmtool.bus.connect import Connection
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.drive_node import is_safe
from pmsmtool.errors import DriveFault, IdentificationError, LimitExceeded
from pmsmtool.identification.replay import replay
from pmsmtool.identification.request import MACHINE, PREDICTED, REFUSED, IdentifyRequest, refused_in
from pmsmtool.identification.verdicts import DESIGNED_FROM, ESSENTIAL, STEP, blocking, verdicts_of
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.machine.parameters import MachineParameters
from pmsmtool.measurement import mechanics
from pmsmtool.measurement.by_injection import nameplate_of
from pmsmtool.measurement.identify import identify
from pmsmtool.measurement.measure import Measurement
from pmsmtool.measurement.square_waves import SquareStage
from pmsmtool.refusals import refuse
from pmsmtool.run_directory import Acceptance, RunDirectory, Stage, new_record
from pmsmtool.sim.bus import PmsmSimBus

CHANNEL = "interior-2k2?nv=:memory:"


def identified(
    folder: Path, quantities: tuple[str, ...], run: RunDirectory | None = None
) -> tuple[RunDirectory, Stage, MachineParameters]:
    run = run or RunDirectory.create(folder, 1, new_record(["test"], drive={}, bus={}, versions={}, operator="nobody"))
    with Connection(PmsmSimBus(CHANNEL)) as connection:
        drive = CanopenDrive(connection, 1)
        nameplate = nameplate_of(drive, "bench")
        try:
            request = IdentifyRequest(quantities=quantities, accuracy=0.01)
            stage = identify(run, drive, request, lambda lines: None, lambda text: None, known=(nameplate, "bench"))
        finally:
            assert is_safe(drive.node.state()) and not drive.may_be_energised
            drive.close()
    run.add(stage)
    return run, stage, nameplate.machine


@pytest.mark.chain
def test_a_refusal_while_measuring_leaves_what_does_not_depend_on_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The square wave is refused live: R and pole pairs stay, L and psi name the reason, and so does the replay."""

    def refused(*_: object) -> None:
        raise refuse("E_ROTOR_MOVED", "the rotor stands 20 deg off the bias vector", stage="inductance")

    monkeypatch.setattr(SquareStage, "measure", refused)
    run, stage, nameplate = identified(tmp_path, ("R", "poles", "L", "psi"))
    assert stage.status == "partial"
    assert set(stage.refused) == {"L", "psi"}
    assert stage.refused["L"].startswith("E_ROTOR_MOVED: the rotor stands 20 deg")
    assert stage.refused["psi"] == "needs L: E_ROTOR_MOVED"
    written = load_machine_file(run.path / MACHINE)
    assert written.machine.R_s_ohm == pytest.approx(3.6, rel=0.01) and written.machine.pole_pairs == 3
    assert written.machine.L_d_h == nameplate.L_d_h and "L_d_h" not in written.estimates
    assert refused_in(run)["L"].reason == "E_ROTOR_MOVED"
    machine = (run.path / MACHINE).read_bytes()
    monkeypatch.undo()
    again = replay(run)
    assert again.refused == stage.refused and again.values == stage.values
    assert (run.path / MACHINE).read_bytes() == machine


@pytest.mark.chain
def test_a_fault_ends_the_run_and_what_was_measured_before_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fault(*_: object) -> None:
        raise DriveFault("over-speed", where="node 1, 0x603F")

    monkeypatch.setattr(SquareStage, "measure", fault)
    with pytest.raises(DriveFault, match="over-speed"):
        identified(tmp_path, ("R", "poles", "L"))
    (folder,) = tmp_path.iterdir()
    run = RunDirectory(folder)
    (stage,) = run.read().stages
    assert stage.status == "fail" and "over-speed" in stage.note
    assert stage.refused["L"].startswith("E_NOT_MEASURED: the run ended during it: over-speed (try: ")
    assert {value["name"] for value in stage.values} >= {"R_s_ohm", "pole_pairs"}
    assert (run.path / REFUSED).is_file()
    monkeypatch.undo()
    assert set(replay(run).refused) == {"L"}
    assert load_machine_file(run.path / MACHINE).machine.R_s_ohm == pytest.approx(3.6, rel=0.01)


@pytest.mark.chain
def test_a_limit_that_ended_a_run_names_its_experiment_and_hinders_no_later_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A resumed run refused what it had just measured: the refusal of the ended one lay beside its traces."""

    def exceeded(*_: object) -> None:
        raise LimitExceeded("current", 9.0, 7.5, "A", where="node 1")

    monkeypatch.setattr(Measurement, "_levels", exceeded)
    with pytest.raises(LimitExceeded) as caught:
        identified(tmp_path, ("R", "poles"))
    assert caught.value.where.startswith('node 1, during "phases: three vectors of')
    (folder,) = tmp_path.iterdir()
    run = RunDirectory(folder)
    (stage,) = run.read().stages
    assert stage.status == "refused" and not stage.values
    assert stage.refused == {
        "R": "E_NOT_MEASURED: the run ended during it: current 9 A is outside the limit 7.5 A (try: remove the cause, "
        "identify again)",
        "poles": "E_NOT_MEASURED: the run ended before it: current 9 A is outside the limit 7.5 A (try: remove the "
        "cause, identify again)",
    }
    assert replay(run).refused == stage.refused
    monkeypatch.undo()
    _, stage, _ = identified(tmp_path, ("R",), run)
    assert stage.status == "pass" and not (folder / REFUSED).exists()
    assert {path.name for path in (folder / "ended-1").iterdir()} == {"traces", REFUSED, PREDICTED}


@pytest.mark.chain
def test_the_shaft_that_does_not_rest_costs_its_inertia_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise refuse("E_EXCITATION", "the shaft is not at rest", stage="mechanics")

    monkeypatch.setattr(mechanics, "_come_to_rest", refused)
    _, stage, _ = identified(tmp_path, IdentifyRequest().quantities)
    assert set(stage.refused) == {"mechanics"} and stage.status == "partial"
    assert all(line.ok for line in stage.acceptance)


GOOD, BAD = (Acceptance("R_s_ohm", "1 %", "3 %", ok) for ok in (True, False))
ERROR = IdentificationError("E_SNR", "too small", likely="noise", hint="more current")


@pytest.mark.parametrize(
    ("asked", "refused", "had", "acceptance", "status", "reasons"),
    [
        (("R",), {}, ("R",), {"R_s_ohm": GOOD}, "pass", {}),
        (("R",), {}, ("R",), {"R_s_ohm": BAD}, "fail", {"R": "E_NOT_ACCEPTED: R_s_ohm 1 %, limit 3 %"}),
        (("R", "inverter"), {}, ("R",), {"R_s_ohm": BAD}, "partial", {"R": "E_NOT_ACCEPTED"}),
        (("R", "psi"), {"psi": ERROR}, ("R",), {}, "partial", {"psi": "E_SNR: too small (likely: noise; try:"}),
        (("R", "mechanics"), {"psi": ERROR}, ("R", "L"), {}, "partial", {"mechanics": "needs psi: E_SNR: too small"}),
        (("poles",), {}, (), {}, "fail", {"poles": "not measured"}),
    ],
)
def test_the_verdict_on_each_quantity(
    asked: tuple[str, ...],
    refused: dict[str, IdentificationError],
    had: tuple[str, ...],
    acceptance: dict[str, Acceptance],
    status: str,
    reasons: dict[str, str],
) -> None:
    found = verdicts_of(asked, refused, had, acceptance)
    assert found.status == status
    assert set(found.refused) == set(reasons) and set(found.accepted) == set(asked) - set(reasons)
    assert all(found.refused[name].startswith(text) for name, text in reasons.items())
    assert len(found.lines()) == len(reasons)


def test_what_a_design_needs_stops_the_chain_unless_a_person_gave_it() -> None:
    refused = dict.fromkeys(STEP, "E_SNR")
    assert blocking(refused, given=True) == list(ESSENTIAL)
    assert blocking(refused, given=False) == [*ESSENTIAL, *DESIGNED_FROM]
    assert blocking({"mechanics": "", "map": "", "frf": "", "inverter": ""}, given=False) == []
