# SPDX-License-Identifier: MIT
"""Recorded pushes through a maker's trace: only where a map of the drive's own identity names all that they need."""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from pmsmtool.bus.connect import Connection
from pmsmtool.cli.main import cli
from pmsmtool.drive.drive_node import DriveNode, is_safe
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.guard import guarded
from pmsmtool.drive.port import Excitation, Injection, Recording, Shape
from pmsmtool.drive.recorder_drives import DELAY_DOUBT_PERIODS, RECORDED, MappedRecorderDrive
from pmsmtool.drive.standard_drive import StandardDrive
from pmsmtool.drive.torque_drives import ParameterDrive
from pmsmtool.drive_maps.drive_map_file import dump_drive_map, parse_drive_map
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import Interrupted, NotAvailable, Partial
from pmsmtool.estimators.estimate import total_half_width
from pmsmtool.estimators.recorded_push import DELAY_DOUBT, estimate_pushes
from pmsmtool.identification.by_pulses import PulseResult, pulse_result, read_facts
from pmsmtool.identification.request import Method, stored_traces
from pmsmtool.machine.machine_file import load_machine_file, machine_path
from pmsmtool.measurement.capabilities import Capabilities, CapabilityLevel, examine
from pmsmtool.measurement.identify import open_for_level
from pmsmtool.run_directory import RunDirectory
from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.trace import Trace

pytestmark = pytest.mark.chain

Pushed = tuple[MappedRecorderDrive, PulseResult, list[Trace]]

ADDED = {
    "u_d_v": (19, "0.1 V"),
    "u_q_v": (20, "0.1 V"),
    "omega_M_rad_s": (23, "2.44140625e-05 rev/s"),
    "position_rad": (31, "2.44140625e-04 rev"),
}
"""What a person adds to the map of Copley from his manual, for an encoder of 4096 counts."""
IDENTITY = "vendor = 0xAB\nproduct = 0x1\n"


def completed(*without: str, identity: str = IDENTITY) -> str:
    rows = "".join(
        f'[recorder.{name}]\nnumber = {number}\nunit = "{unit}"\n'
        for name, (number, unit) in ADDED.items()
        if name not in without
    )
    text = dump_drive_map(load_family("copley")).replace("[left_out]", rows + "[left_out]")
    if identity != IDENTITY:  # another maker's: Copley's name and marks do not tell it
        text = re.sub(r"^\[identity\]\n.*?(?=^\[capabilities\])", "", text, flags=re.MULTILINE | re.DOTALL)
    return re.sub(r"^vendor = .*\nproduct = .*\n", identity, text, count=1, flags=re.MULTILINE)


@contextmanager
def opened(folder: Path, text: str, family: str = "") -> Iterator[tuple[Connection, Capabilities]]:
    path = folder / "map.toml"
    path.write_text(text, encoding="utf-8")
    with Connection(PmsmSimBus(f"interior-2k2?nv=:memory:&drive={family or path}")) as connection:
        node = DriveNode(connection, 1)
        found = examine(node, parse_drive_map(text, str(path)))
        node.close()
        yield connection, found


def test_a_completed_map_lifts_a_copley_to_the_level_of_recorders(tmp_path: Path) -> None:
    """Its own limit and rated current, and node guarding: no Copley has 0x1016, 0x6007, 0x6073, 0x6075 and 0x6080."""
    with opened(tmp_path, completed()) as (connection, found):
        assert found.level is CapabilityLevel.RECORDER
        assert found.recorder.startswith("trace of i_d_a, i_q_a, i_q_ref_a, U_dc_v, u_d_v")
        row = found.row("R", Method.RECORDER)
        assert row.available and not row.expected  # what was measured was the reference drive's recorder
        drive = open_for_level(connection, 1, found)
        assert isinstance(drive, MappedRecorderDrive)
        drive.close()


@pytest.mark.parametrize("name", ADDED)
def test_each_of_them_is_needed(tmp_path: Path, name: str) -> None:
    with opened(tmp_path, completed(name)) as (connection, found):
        assert found.level is CapabilityLevel.STANDARD and "recorder" not in found.features
        drive = open_for_level(connection, 1, found)
        assert type(drive) is StandardDrive
        drive.close()


def test_a_map_that_does_not_name_the_drive_sets_up_no_recorder(tmp_path: Path) -> None:
    with opened(tmp_path, completed(identity="vendor = 0\nproduct = 0\n")) as (_, found):
        assert not found.map_is_drives and "recorder" not in found.features


def test_a_drive_that_does_not_have_what_its_map_says_is_no_recorder(tmp_path: Path) -> None:
    with opened(tmp_path, completed(identity="vendor = 0xFB\nproduct = 0x63220000\n"), "epos2") as (connection, found):
        assert found.map_is_drives and "recorder" not in found.features
        assert found.recorder == "not read: the drive has no trace"
        drive = open_for_level(connection, 1, found)
        assert type(drive) in (ParameterDrive, StandardDrive)
        drive.close()


@pytest.fixture(scope="module")
def commissioned(tmp_path_factory: pytest.TempPathFactory) -> tuple[Result, RunDirectory]:
    """The whole chain."""
    folder = tmp_path_factory.mktemp("mapped")
    path = folder / "map.toml"
    path.write_text(completed(), encoding="utf-8")
    bus = ["-i", "pmsmsim", "-c", f"interior-2k2?nv=:memory:&drive={path}"]
    asked = ["commission", str(machine_path("interior-2k2")), "--map", str(path), "--runs", str(folder / "runs")]
    result = CliRunner().invoke(cli, [*bus, *asked, "--speed-max", "3000rpm", "--yes"])  # a Copley limits no speed
    return result, RunDirectory(next((folder / "runs").iterdir()))


@pytest.fixture(scope="module")
def pushed(commissioned: tuple[Result, RunDirectory], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pushed]:
    """Its pushes, and a drive of its kind."""
    run = commissioned[1]
    traces = {name: trace for name, trace in stored_traces(run).items() if name.startswith("push_")}
    with opened(tmp_path_factory.mktemp("opened"), completed()) as (connection, found):
        drive = open_for_level(connection, 1, found)
        assert isinstance(drive, MappedRecorderDrive)
        yield drive, pulse_result(traces, read_facts(run)), list(traces.values())
        drive.close()


def test_resistance_flux_and_inductance_come_from_scaled_integers(
    pushed: Pushed,
) -> None:
    """0.01 A and 0.1 V, a row every few periods: the truth is within every interval."""
    result = pushed[1]
    machine = load_machine_file(machine_path("interior-2k2"))
    simulated = machine.machine
    truth = {
        "R_s_ohm": simulated.R_s_ohm, "psi_f_wb": simulated.psi_f_wb, "L_q_app_h": simulated.L_q_h,
        "frame_offset_rad": 0.0,
    }  # fmt: skip
    for name, value in truth.items():
        estimate = result.estimates[name]
        assert abs(estimate.value - value) <= total_half_width(estimate), name
    assert not result.missing


def test_a_memory_of_fewer_rows_takes_them_further_apart(
    pushed: Pushed,
) -> None:
    for trace in pushed[2]:
        assert len(trace) == 256  # of 341 that fit, a quarter of the 1024 asked for
        assert trace.t_s[1] - trace.t_s[0] == pytest.approx(trace.meta["period_s"])


def test_that_nobody_says_which_period_a_voltage_belongs_to_widens_the_resistance(
    pushed: Pushed,
) -> None:
    drive, _, pushes = pushed
    assert {trace.meta[DELAY_DOUBT] for trace in pushes} == {DELAY_DOUBT_PERIODS}
    wide = estimate_pushes(pushes, period_s=drive.period_s, pole_pairs=3).R
    for trace in pushes:
        del trace.meta[DELAY_DOUBT]  # type: ignore[attr-defined]
    narrow = estimate_pushes(pushes, period_s=drive.period_s, pole_pairs=3).R
    assert wide is not None and narrow is not None
    assert wide.value == narrow.value and wide.systematic > narrow.systematic


def test_samples_at_the_largest_voltage_are_marked(pushed: Pushed, monkeypatch: pytest.MonkeyPatch) -> None:
    """The link of 540 V gives 312 V at most: 95 % of them are 296 V."""
    drive = pushed[0]
    monkeypatch.setattr(drive, "coast", lambda: None)
    u_q_v = np.array([0.0, 290.0, -295.0, -297.5, 310.0])
    columns = {"u_d_v": np.zeros(5), "u_q_v": u_q_v}
    trace = Trace(1e-4 * np.arange(5), columns, dict.fromkeys(columns, "V"), {})
    monkeypatch.setattr(drive.traces, "fetch", lambda signals, decimation: trace)
    taken = drive.finish_record(Recording(("u_d_v", "u_q_v", "flags"), 5))
    assert taken["flags"].tolist() == [0.0, 0.0, 0.0, 1.0, 1.0]
    monkeypatch.setattr(drive, "live", _shows_nothing)
    assert not drive.finish_record(Recording(("u_d_v", "u_q_v", "flags"), 5))["flags"].any()


def _shows_nothing(name: str) -> float:
    raise NotAvailable(f"the drive does not show {name}")


def test_what_it_does_not_show_or_take_is_said(pushed: Pushed) -> None:
    drive = pushed[0]
    assert drive.read("motor.pole_pairs") == 3.0
    assert math.isnan(drive.live("T_winding_c"))
    with pytest.raises(NotAvailable, match="no signal kappa"):
        drive.record(("kappa",), 10)
    step = Excitation(Shape.STEP, Injection.SPEED, 10.0)
    with pytest.raises(NotAvailable, match="only torque pulses"):
        drive.record(("i_q_a",), 10, excitation=step)


def test_the_chain_measures_by_it_and_says_what_is_left(commissioned: tuple[Result, RunDirectory]) -> None:
    result, run = commissioned
    assert result.exit_code == Partial.exit_code, result.output
    assert "recorded torque pulses" in result.output
    for line in ("identify  PASS", "flash     PASS", "verify    PASS", "prove     NOT AVAILABLE"):
        assert line in result.output
    assert "SIMULATED DRIVE, PARTIAL: 4 of 7 stages ran" in result.output
    measured = load_machine_file(run.path / "machine.toml").machine.R_s_ohm
    assert measured != 3.6 and measured == pytest.approx(3.6, rel=0.05)


@pytest.mark.parametrize("interrupted", [False, True])
def test_the_recorder_is_brought_back_as_it_was(tmp_path: Path, interrupted: bool) -> None:
    """Also after a push that ends in its middle, with the trace still running."""
    with opened(tmp_path, completed()) as (connection, found):
        drive = open_for_level(connection, 1, found)
        assert isinstance(drive, MappedRecorderDrive)
        session = connection.bus.line.nodes[0].session  # type: ignore[attr-defined]
        places = [*((0x2500, k) for k in range(1, 7)), (0x2505, 0), (0x2506, 0), (0x2507, 0)]
        session.dictionary.find(0x2500, 1).value = b"\x0e\0"
        session.dictionary.find(0x2505, 0).value = b"\x09\0"
        before = [session.dictionary.find(*place).read() for place in places]
        envelope = Envelope(i_max_apk=5.0, speed_max_rad_s=100.0, duration_s=60.0)
        with contextlib.suppress(KeyboardInterrupt, Interrupted), guarded(drive, envelope) as guard:
            guard.enable()
            guard.record(tuple(RECORDED), 100)
            assert [session.dictionary.find(*place).read() for place in places] != before
            if interrupted:
                drive.begin_record(Recording(tuple(RECORDED), 300, 50), drive.wait)
                raise KeyboardInterrupt
        assert is_safe(drive.node.state())
        assert [session.dictionary.find(*place).read() for place in places] == before
        assert not session.dictionary.find(0x2501, 0).read()[0] & 1
        drive.close()
