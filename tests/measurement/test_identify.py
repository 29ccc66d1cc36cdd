# SPDX-License-Identifier: MIT
"""Identification as a program sees it: Ctrl-C at any moment, the request and its record, the square wave's bias."""

from __future__ import annotations

import math
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.random_drives import draw_around
from pmsmtool.bus.clock import VirtualClock
from pmsmtool.bus.connect import Connection
from pmsmtool.cli.main import run as main
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.drive_node import is_safe
from pmsmtool.drive.parameters import DriveParameters
from pmsmtool.errors import ConfigError, ExitCode, IdentificationError, Interrupted, NotAvailable
from pmsmtool.estimators.estimate import SensorTolerance
from pmsmtool.files import data_folder
from pmsmtool.identification.evaluate import tolerance_on
from pmsmtool.identification.replay import replay
from pmsmtool.identification.request import MACHINE, REPLAYED, REQUEST, IdentifyRequest, dump_request, parse_request
from pmsmtool.machine.machine_file import dump_machine_file, load_machine_file
from pmsmtool.measurement.by_injection import nameplate_of
from pmsmtool.measurement.identify import identify
from pmsmtool.measurement.square_waves import BIAS_MOST, CROSSING, RIPPLE_LEAST, bias_and_ripple
from pmsmtool.run_directory import RunDirectory, Stage, new_record
from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.sim.simulated_machine import settings_of
from pmsmtool.trace import read_trace

pytestmark = pytest.mark.chain

COARSE_RAD = math.radians(2.0)  # measured: 0.03 to 0.41 deg
CHANNEL = "interior-2k2?nv=:memory:"


def identified(
    drive: CanopenDrive,
    folder: Path,
    quantities: tuple[str, ...],
    tolerance: SensorTolerance | None = None,
    accuracy: float | None = None,
) -> tuple[RunDirectory, Stage]:
    record = new_record(["test"], drive={}, bus={}, versions={}, operator="nobody")
    run = RunDirectory.create(folder, drive.identity.serial, record)
    request = IdentifyRequest(quantities=quantities, tolerance=tolerance or SensorTolerance(), accuracy=accuracy)
    stage = identify(run, drive, request, lambda lines: None, lambda text: None)
    run.add(stage)
    return run, stage


def state_of(drive: CanopenDrive) -> tuple[int, int, list[bytes]]:
    limits = [
        drive.node.sdo.read(*where) for where in ((0x6073, 0), (0x6080, 0), (0x1016, 1), (0x6007, 0), (0x6060, 0))
    ]
    parameters = DriveParameters(drive.node)
    return parameters.crc_active, parameters.crc_stored, limits


# ---- Ctrl-C -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("moment", [1, 20, 47, 53, 120, 400, 800, 1100, 1230, 1500])
def test_ctrl_c_at_any_moment_leaves_a_drive_that_is_off_and_as_before(
    moment: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One run waits 1600 times: the dead-man up to 48, phases to 155, levels to 731, rotation to 1073, square wave to
    1206, pushes to 1256, and the speeds to the end. All moments: ``benchmarks/interrupted_commands.py``.
    """
    count = 0
    pass_time = VirtualClock.wait

    def interrupted(self: VirtualClock, seconds: float) -> None:
        nonlocal count
        count += 1
        if count == moment:
            signal.raise_signal(signal.SIGINT)
        pass_time(self, seconds)

    with Connection(PmsmSimBus(CHANNEL)) as connection:
        drive = CanopenDrive(connection, 1)
        before = state_of(drive)
        with monkeypatch.context() as patch:
            patch.setattr(VirtualClock, "wait", interrupted)
            with pytest.raises((Interrupted, KeyboardInterrupt)) as caught:
                identified(drive, tmp_path, IdentifyRequest().quantities)
        assert count >= moment
        if isinstance(caught.value, Interrupted):
            assert caught.value.exit_code == ExitCode.INTERRUPTED
        assert is_safe(drive.node.state())
        assert not drive.may_be_energised
        assert state_of(drive) == before
        drive.close()
    (folder,) = tmp_path.iterdir()
    stages = RunDirectory(folder).read().stages  # what was measured before is kept, and never passes for the whole
    assert all(stage.status == "interrupted" and "mechanics" in stage.refused for stage in stages)
    assert (folder / "machine.toml").is_file() is any(stage.values for stage in stages)


def test_a_speed_limit_that_tells_nothing_is_refused_before_anybody_is_asked(tmp_path: Path) -> None:
    asked: list[object] = []
    request = IdentifyRequest(quantities=("psi",), speed_max_rad_s=math.pi / 30.0)
    run = RunDirectory.create(tmp_path, 1, new_record(["test"], drive={}, bus={}, versions={}, operator="nobody"))
    with Connection(PmsmSimBus(CHANNEL)) as connection:
        drive = CanopenDrive(connection, 1)
        nameplate = nameplate_of(drive, "bench")
        with pytest.raises(IdentificationError, match="E_EXCITATION: the speed limit 1 rpm"):
            identify(run, drive, request, asked.append, asked.append, known=(nameplate, "bench"))
        assert not drive.may_be_energised
        drive.close()
    assert asked == []


# ---- a rotor on the turning vector ---------------------------------------------------------------------------------


def test_the_shaft_turns_no_faster_than_allowed_while_its_pole_pairs_are_counted(tmp_path: Path) -> None:
    allowed = 60.0 * math.pi / 30.0
    request = IdentifyRequest(quantities=("poles",), speed_max_rad_s=allowed)
    run = RunDirectory.create(tmp_path, 1, new_record(["test"], drive={}, bus={}, versions={}, operator="nobody"))
    with Connection(PmsmSimBus(CHANNEL)) as connection:
        drive = CanopenDrive(connection, 1)
        stage = identify(run, drive, request, lambda lines: None, lambda text: None)
        drive.close()
    assert stage.status == "pass", stage.acceptance  # the coarse offset of the slow turn is not judged
    turn = read_trace(run.path / "traces" / "rotation_forward.npz")
    speeds = np.diff(turn["theta_M_rad"]) / np.diff(turn.t_s)
    assert 0.0 < np.max(np.abs(speeds)) < allowed


def test_a_reluctance_machine_follows_the_first_vector(tmp_path: Path) -> None:
    """On the largest one alone it rests 44 degrees beside it."""
    base = load_machine_file(data_folder("profiles") / "saturated-pmsyrm.toml")
    drive_file = draw_around(replace(base, simulation={"inverter_model": "switched"}), 0, spread=0.1)
    path = tmp_path / "drive.toml"
    path.write_text(dump_machine_file(drive_file, embed_flux_map=True), encoding="utf-8")
    with Connection(PmsmSimBus(f"{path}?nv=:memory:")) as connection:
        drive = CanopenDrive(connection, 1)
        run, _ = identified(drive, tmp_path, ("poles",))
        drive.close()
    found = load_machine_file(run.path / MACHINE)
    assert found.machine.pole_pairs == base.machine.pole_pairs
    offset = settings_of(drive_file).number("encoder_offset_rad")
    off = math.remainder(found.estimates["offset_rad"].value - offset, 2.0 * math.pi)
    assert abs(off) < COARSE_RAD, math.degrees(off)


def test_a_machine_without_magnets_is_named_and_the_rest_identified(tmp_path: Path) -> None:
    """A vector pulls the axis of the larger inductance onto itself, so that is L_d; both within 0.2 %."""
    with Connection(PmsmSimBus(f"{CHANNEL}&psi_f_wb=0&L_q_h=0.12")) as connection:
        drive = CanopenDrive(connection, 1)
        run, stage = identified(drive, tmp_path, ("poles", "R", "L", "psi"), accuracy=0.01)
        drive.close()
    assert stage.status == "partial" and stage.refused["psi"].startswith("E_NO_MAGNET")
    found = load_machine_file(run.path / MACHINE)
    assert found.machine.pole_pairs == 3 and {"R_s_ohm", "L_d_h", "L_q_h"} <= set(found.estimates)
    assert found.machine.L_d_h == pytest.approx(0.12, rel=0.01)
    assert found.machine.L_q_h == pytest.approx(0.036, rel=0.01)


@pytest.mark.parametrize(("factor", "quantities"), [(0.01, ("poles",)), (1000.0, ("poles", "L"))])
def test_the_gains_of_another_motor_serve_nobody(factor: float, quantities: tuple[str, ...], tmp_path: Path) -> None:
    """Too weak, no phase looked connected; too strong, the drive tripped, or its bias rang. They are put back."""
    with Connection(PmsmSimBus(CHANNEL)) as connection:
        drive = CanopenDrive(connection, 1)
        names = [f"current.K_{name}" for name in ("p_d_v_per_a", "i_d_v_per_as", "p_q_v_per_a", "i_q_v_per_as")]
        drive.write({name: factor * drive.read(name) for name in names})
        drive.write({"motor.L_d_h": 0.01 * factor, "motor.L_q_h": 0.01 * factor})
        names += ["motor.L_d_h", "motor.L_q_h"]
        held = [drive.read(name) for name in names]
        _, stage = identified(drive, tmp_path, quantities, accuracy=0.01 if "L" in quantities else None)
        assert stage.status == "pass" and not stage.refused
        assert [drive.read(name) for name in names] == held
        drive.close()


# ---- the request and its record -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def measured_once(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Stage]:
    """A run that has measured R for sensors of 2 %."""
    with Connection(PmsmSimBus(CHANNEL)) as connection:
        drive = CanopenDrive(connection, 1)
        run, stage = identified(drive, tmp_path_factory.mktemp("once"), ("R",), SensorTolerance(0.02, 0.02))
        drive.close()
    return run.path, stage


@pytest.fixture
def measured(measured_once: tuple[Path, Stage], tmp_path: Path) -> tuple[RunDirectory, Stage]:
    """A copy of it."""
    shutil.copytree(measured_once[0], tmp_path / "run")
    return RunDirectory(tmp_path / "run"), measured_once[1]


def test_what_was_asked_comes_back_from_its_record() -> None:
    request = IdentifyRequest(("R", "L"), i_max_apk=3.0, shaft="coupled", tolerance=SensorTolerance(0.02, 0.003))
    assert parse_request(dump_request(request), where="here") == request
    for text in ("", "[]", "{}", '{"quantities": ["R"], "tolerance": {"nonsense": 1}}'):
        with pytest.raises(ConfigError, match="damaged"):
            parse_request(text, where="here")
    with pytest.raises(NotAvailable):
        IdentifyRequest(("psi",), shaft="locked").check()


def test_a_replay_takes_the_recorded_tolerance_and_another_one_is_recorded(
    measured: tuple[RunDirectory, Stage],
) -> None:
    run, stage = measured
    made = (run.path / MACHINE).read_bytes()
    assert stage.values[0]["systematic"] == pytest.approx(0.02 * math.sqrt(2.0) * stage.values[0]["value"], rel=0.3)
    assert replay(run).values == stage.values
    assert (run.path / MACHINE).read_bytes() == made and len(run.read().stages) == 1
    tighter = replay(run, SensorTolerance(0.001, 0.001))
    assert tighter.values[0]["systematic"] < 0.5 * stage.values[0]["systematic"]
    assert (run.path / MACHINE).read_bytes() != made
    record = run.read()
    assert len(record.stages) == 2 and record.stages[-1].files[MACHINE] == run.sha256(MACHINE)
    assert replay(run).values == tighter.values and len(run.read().stages) == 2
    (run.path / REQUEST).unlink()
    with pytest.raises(ConfigError, match="no request.json"):
        replay(run)


def test_a_replay_leaves_a_run_with_a_design_as_it_is(
    measured: tuple[RunDirectory, Stage], capsys: pytest.CaptureFixture[str]
) -> None:
    run, stage = measured
    (run.path / "design.toml").write_text("made from machine.toml", encoding="utf-8")

    def held() -> dict[str, bytes]:
        return {str(path): path.read_bytes() for path in run.path.rglob("*") if path.is_file()}

    before = held()
    assert replay(run).values == stage.values
    assert held() == before and not (run.path / REPLAYED).exists()
    other = replay(run, SensorTolerance(0.001, 0.001))
    assert other.values[0]["systematic"] < 0.5 * stage.values[0]["systematic"]
    after = held()
    (new,) = set(after) - set(before)
    assert Path(new) == run.path / REPLAYED / MACHINE and {name: after[name] for name in before} == before
    assert f"{REPLAYED}/{MACHINE}" in other.files and MACHINE not in other.files
    assert load_machine_file(Path(new)).systematic["R_s_ohm"] == pytest.approx(other.values[0]["systematic"])

    assert main(("identify", "--replay", str(run.path), "--sensor-tol", "0.001")) == 0
    assert "stay as they are" in capsys.readouterr().err and {name: held()[name] for name in before} == before


def test_the_bridge_of_the_nameplate_widens_the_statistical_part(measured: tuple[RunDirectory, Stage]) -> None:
    """0.35 V of 540 V: 0.065 % of R, in the root sum of squares; a bridge of MOSFETs has no threshold."""
    assert tolerance_on(SensorTolerance(), 540.0).voltage_scale_std == pytest.approx(0.35 / 540.0)
    assert tolerance_on(SensorTolerance(), 48.0).voltage_scale_std == 0.0
    run, stage = measured
    nameplate = load_machine_file(run.path / "nameplate.toml")
    low = replace(nameplate, inverter=replace(nameplate.inverter, U_dc_v=270.0))
    (run.path / "nameplate.toml").write_text(dump_machine_file(low))
    value, std = stage.values[0]["value"], stage.values[0]["std"]
    wider = replay(run).values[0]["std"]
    assert math.sqrt(wider**2 - std**2) == pytest.approx(math.sqrt(3.0) * 0.35 / 540.0 * value, rel=0.05)


# ---- the bias of the square wave ---------------------------------------------------------------------------------


@pytest.mark.parametrize("knee", [0.0, 0.05, 0.139, 0.15, 0.25, 0.3, 0.38, 0.5, 2.0])
def test_no_phase_current_comes_into_the_knee_where_the_current_allows(knee: float) -> None:
    I_test = 6.0
    bias, ripple = bias_and_ripple(I_test, 0.25, knee * I_test)
    assert 0.5 * I_test <= bias <= BIAS_MOST * I_test
    assert RIPPLE_LEAST * 0.25 * I_test <= ripple <= 0.25 * I_test
    clear = bias >= 2.0 * (CROSSING * ripple + knee * I_test) * (1.0 - 1e-12)
    assert clear == (knee <= 0.5 * BIAS_MOST - CROSSING * RIPPLE_LEAST * 0.25)
    if knee < 0.1:
        assert (bias, ripple) == (0.5 * I_test, 0.25 * I_test)
