# SPDX-License-Identifier: MIT
"""R at half the control frequency on simulated drives: what it gives, and that every way out puts it back."""

from __future__ import annotations

import json
import math
import signal
from collections.abc import Mapping
from pathlib import Path

import pytest

from pmsmtool.bus.clock import VirtualClock
from pmsmtool.bus.connect import Connection
from pmsmtool.cli.main import run as main
from pmsmtool.drive.canopen_drive import PERIOD, CanopenDrive
from pmsmtool.drive.drive_node import is_safe
from pmsmtool.drive.parameters import DriveParameters
from pmsmtool.errors import ConfigError, DriveFault, ExitCode, Interrupted
from pmsmtool.estimators.resistance import HARD_RATIO
from pmsmtool.experiments import half_frequency
from pmsmtool.experiments.standstill import LevelPlan
from pmsmtool.identification.evaluate import evaluate
from pmsmtool.identification.half_frequency import TRACE
from pmsmtool.identification.replay import MACHINE, replay, stored_traces
from pmsmtool.identification.request import IdentifyRequest, dump_request, parse_request
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file, load_machine_file
from pmsmtool.measurement.half_frequency import measure_at_half_frequency
from pmsmtool.measurement.identify import identify_stage, nameplate_of
from pmsmtool.run_directory import RunDirectory, Stage, new_record
from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.sim.random_drives import draw_drive
from pmsmtool.sim.simulated_machine import Settings, device_slope_ohm

pytestmark = pytest.mark.chain

CHANNEL = "interior-2k2?nv=:memory:"
HARD_SEEDS = (35342, 35909)
"""Drives with dead time and devices of 6.1 and 3.5 R I."""


def identify(
    drive: CanopenDrive, folder: Path, *, half: bool, said: list[str] | None = None
) -> tuple[RunDirectory, Stage]:
    record = new_record(["test"], drive={}, bus={}, versions={}, operator="nobody")
    run = RunDirectory.create(folder, drive.identity.serial, record)
    request = IdentifyRequest(quantities=("R",), half_frequency=half)
    say = (lambda text: None) if said is None else said.append
    stage = identify_stage(run, drive, nameplate_of(drive, "bench"), request, lambda lines: None, say)
    run.add(stage)
    return run, stage


def identified(drive_file: MachineFile, folder: Path) -> tuple[RunDirectory, MachineFile, list[str]]:
    path = folder / "drive.toml"
    path.write_text(dump_machine_file(drive_file), encoding="utf-8")
    said: list[str] = []
    with Connection(PmsmSimBus(f"{path}?nv=:memory:")) as connection:
        drive = CanopenDrive(connection, 1)
        period_s = drive.period_s
        run, _ = identify(drive, folder, half=True, said=said)
        assert drive.period_s == period_s
        drive.close()
    return run, load_machine_file(run.path / MACHINE), said


def true_resistance(drive_file: MachineFile) -> float:
    """Loop at its temperature; only the copper part follows that (ohm)."""
    values = Settings(drive_file.simulation_settings())
    devices, machine = device_slope_ohm(values), drive_file.machine
    rise = values.number("T_winding_c") - machine.T_ref_c
    return devices + (values.number("R_s_ohm") - devices) * (1.0 + machine.alpha_R_per_k * rise)


# ---- what it gives ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", HARD_SEEDS)
def test_a_hard_drive_gets_half_the_interval_and_its_inverter_in_two_parts(seed: int, tmp_path: Path) -> None:
    drive_file = draw_drive(seed)
    run, machine, said = identified(drive_file, tmp_path)
    assert any("at half the control frequency: 18 levels" in line for line in said)
    values, found = Settings(drive_file.simulation_settings()), machine.conditions
    high, low = found["control_frequencies_hz"]
    assert high == pytest.approx(2.0 * low)
    assert high == pytest.approx(drive_file.inverter.f_s_hz, rel=1e-4)
    devices = 0.5 * (values.number("device_drop_v") + values.number("diode_drop_v"))
    assert found["device_drop_v"] == pytest.approx(devices, abs=0.01)  # measured 0.002 V on 24 drives
    assert found["dead_time_equivalent_s"] == pytest.approx(drive_file.inverter.dead_time_s, rel=0.06)  # 0.035
    shown = {value["name"]: value for value in run.read().stages[-1].values}
    assert shown["device_drop_v"]["value"] == found["device_drop_v"]
    assert 0.0 < shown["device_drop_v"]["std"] < 0.02
    assert shown["dead_time_equivalent_s"]["std"] < 1e-3 * found["dead_time_equivalent_s"]
    R_s = machine.estimates["R_s_ohm"]
    assert "two control frequencies" in R_s.method
    rise = R_s.T_c - drive_file.machine.T_ref_c
    at_temperature = R_s.value * (1.0 + drive_file.machine.alpha_R_per_k * rise)
    assert at_temperature == pytest.approx(true_resistance(drive_file), rel=4e-3)  # measured 0.25 % on 24 drives

    traces, inverter = stored_traces(run), machine.inverter
    del traces[TRACE]
    once = evaluate(traces, inverter.T_s, U_dc_v=inverter.U_dc_v).resistance
    assert once is not None and once.hardness > HARD_RATIO
    assert R_s.std < 0.7 * once.R_s.std
    told: list[str] = []
    plan = LevelPlan([1.0], turn_a=1.0)
    with Connection(PmsmSimBus(CHANNEL)) as connection:
        measure_at_half_frequency(CanopenDrive(connection, 1), plan, once, False, traces.__setitem__, told.append)
    assert len(told) == 1 and "no --half-frequency" in told[0] and TRACE not in traces

    text = (run.path / MACHINE).read_bytes()
    (run.path / MACHINE).unlink()
    replay(run)
    assert (run.path / MACHINE).read_bytes() == text


def test_halving_the_frequency_doubles_the_time_of_as_many_periods() -> None:
    with Connection(PmsmSimBus(CHANNEL)) as connection:
        drive = CanopenDrive(connection, 1)

        def seconds_of(periods: int) -> float:
            start = connection.clock.now()
            drive.recorder.start_average(["i_d_a"], periods)
            drive.recorder.finish_average(["i_d_a"])
            return connection.clock.now() - start

        own_s, first_s = drive.period_s, seconds_of(4000)
        assert first_s == pytest.approx(4000 * own_s, rel=0.02)
        drive.write({PERIOD: 2.0 * drive.read(PERIOD)})
        assert drive.period_s == 2.0 * own_s
        assert seconds_of(4000) == pytest.approx(8000 * own_s, rel=0.02)
        drive.close()


# ---- every way out ----------------------------------------------------------------------------------------------


def state_of(drive: CanopenDrive) -> tuple[int, int, float]:
    parameters = DriveParameters(drive.node)
    return parameters.crc_active, parameters.crc_stored, drive.read(PERIOD)


@pytest.mark.parametrize("moment", [1, 2, 120, 250])
def test_ctrl_c_at_half_the_frequency_puts_it_back(
    moment: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``moment`` counts the waits since the frequency was halved; there are some 300."""
    with Connection(PmsmSimBus(CHANNEL)) as connection:
        drive = CanopenDrive(connection, 1)
        before, own_s, count = state_of(drive), drive.period_s, 0
        pass_time = VirtualClock.wait

        def interrupted(self: VirtualClock, seconds: float) -> None:
            nonlocal count
            count += drive.period_s != own_s
            if count == moment:
                count += 1
                signal.raise_signal(signal.SIGINT)
            pass_time(self, seconds)

        with monkeypatch.context() as patch:
            patch.setattr(VirtualClock, "wait", interrupted)
            with pytest.raises((Interrupted, KeyboardInterrupt)):
                identify(drive, tmp_path, half=True)
        assert count > moment
        assert is_safe(drive.node.state()) and not drive.may_be_energised
        assert state_of(drive) == before and drive.period_s == own_s
        drive.close()


def test_a_failure_at_half_the_frequency_puts_it_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*anything: object) -> None:
        raise ZeroDivisionError

    with Connection(PmsmSimBus(CHANNEL)) as connection:
        drive = CanopenDrive(connection, 1)
        before, own_s = state_of(drive), drive.period_s
        monkeypatch.setattr(half_frequency, "hold_levels", fails)
        with pytest.raises(ZeroDivisionError):
            identify(drive, tmp_path, half=True)
        assert is_safe(drive.node.state())
        assert state_of(drive) == before and drive.period_s == own_s
        drive.close()


# ---- a drive that does not allow it --------------------------------------------------------------------------------


def test_a_drive_that_refuses_the_period_is_identified_at_its_own_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = CanopenDrive.write

    def refusing(self: CanopenDrive, values: Mapping[str, float]) -> None:
        if PERIOD in values:
            raise DriveFault("the drive refused 1 of 5 value(s): the period is fixed")
        write(self, values)

    monkeypatch.setattr(CanopenDrive, "write", refusing)
    said: list[str] = []
    with Connection(PmsmSimBus(CHANNEL)) as connection:
        drive = CanopenDrive(connection, 1)
        run, stage = identify(drive, tmp_path, half=True, said=said)
        drive.close()
    assert stage.status == "pass"
    assert any("not used" in line and "the period is fixed" in line for line in said)
    assert "half of it cannot be set" in stage.note
    assert TRACE not in stored_traces(run)
    assert "two control" not in load_machine_file(run.path / MACHINE).estimates["R_s_ohm"].method


# ---- the request ----------------------------------------------------------------------------------------------------


def test_the_request_is_recorded_and_an_older_record_means_no() -> None:
    asked = IdentifyRequest(quantities=("R",), half_frequency=True)
    assert parse_request(dump_request(asked), where="request").half_frequency
    older = json.loads(dump_request(asked))
    del older["half_frequency"]
    older["tolerance"].pop("U_dc_v", math.inf)
    assert not parse_request(json.dumps(older), where="request").half_frequency
    with pytest.raises(ConfigError, match="pole pairs alone"):
        IdentifyRequest(quantities=("poles",), half_frequency=True).check()


def test_the_command_measures_and_refuses_where_it_cannot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["--sim", CHANNEL, "--yes", "identify", "R", "--half-frequency", "--runs", str(tmp_path)])
    shown = capsys.readouterr()
    assert code == ExitCode.OK
    assert "two control frequencies" in shown.out
    assert "device_drop_v" in shown.out and "the control frequency is halved" in shown.err
    run = next(tmp_path.iterdir())
    assert main(["identify", "--replay", str(run)]) == ExitCode.OK
    assert capsys.readouterr().out == shown.out
    assert main(["identify", "--replay", str(run), "--half-frequency"]) == ExitCode.USAGE
    assert "the traces of the run decide" in capsys.readouterr().err
