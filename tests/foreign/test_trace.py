# SPDX-License-Identifier: MIT
"""The trace of a Copley amplifier that a file has, and what `map learn` does with it."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pmsmtool.bus.connect import connect
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.guard import guarded
from pmsmtool.drive.recorders.choice import recorder_of
from pmsmtool.drive.speed_loop_drive import SpeedLoopDrive
from pmsmtool.drive_maps.drive_map_file import dump_drive_map, parse_drive_map
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import Interrupted, LimitExceeded, NotAvailable, SdoAbort
from pmsmtool.flash.gain_journal import any_left
from pmsmtool.identification.current_loop_response import CurrentLoop, Winding
from pmsmtool.identification.speed_loop_response import SpeedLoop
from pmsmtool.machine.machine_file import load_machine_file, machine_path
from pmsmtool.measurement import learn_current_gains
from pmsmtool.measurement.learn_current_gains import CURRENT_GAIN, CURRENT_INTEGRAL
from pmsmtool.measurement.speed_unit import find_speed_unit
from pmsmtool.units import rad_s_from_rpm
from tests.foreign.data_sheets import Row, copley, write_eds

SEED = 4
TRACE: tuple[Row, ...] = (
    (0x2500, 0, "U8", "ro", "6"), *((0x2500, sub, "U16", "rw", "") for sub in range(1, 7)),
    (0x2501, 0, "U16", "ro", ""), (0x2502, 0, "U32", "ro", ""), (0x2503, 0, "U16", "ro", ""),
    (0x2504, 0, "U16", "ro", ""), (0x2505, 0, "U16", "rw", ""), (0x2506, 0, "OSTR", "rw", ""),
    (0x2507, 0, "I16", "rw", ""), (0x2508, 0, "U16", "rw", ""), (0x2509, 0, "OSTR", "ro", ""),
)  # fmt: skip
GAINS: tuple[Row, ...] = (
    (0x221D, 0, "I16", "ro", ""), *((index, sub, "I16", "rw", "") for index in (0x60F6, 0x60F9) for sub in (1, 2)),
)  # fmt: skip
SIGNALS = ("U_dc_v", "i_q_ref_a", "i_q_a")
CURRENT_TOL = 0.03
"""Largest error of a current gain (relative); measured 0.01."""


@pytest.fixture
def channel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setenv("PMSMTOOL_HOME", str(tmp_path))
    eds = write_eds(tmp_path / "copley.eds", (*copley(), *TRACE, *GAINS))
    return f"interior-2k2?nv=:memory:&eds={eds}&gains={SEED}"


@pytest.fixture
def node(channel: str) -> Iterator[DriveNode]:
    with connect("pmsmsim", channel) as connection:
        found = DriveNode(connection, 1, drive_map=load_family("copley"))
        found.identity()
        yield found
        found.close()


def behind(node: DriveNode) -> Any:
    return node.connection.bus.line.nodes[0].face.behind  # type: ignore[attr-defined]


def test_the_trace_holds_rows_of_what_was_chosen_and_stops_when_it_is_full(node: DriveNode) -> None:
    recorder = recorder_of(node, 0.0)
    recorder.arm(SIGNALS, 100, 2, 0, at_excitation=False)
    node.connection.wait(0.02)
    trace = recorder.fetch(SIGNALS, 2)
    assert trace.t_s.shape == (100,) and trace.period_s == pytest.approx(2e-9 * behind(node).plant.core.period_ns)
    assert np.allclose(trace["U_dc_v"], behind(node).U_dc_v(), atol=0.2)
    assert np.abs(trace["i_q_a"]).max() < 0.5
    node.write_bytes(0x2505, 0, b"\x01\0")
    node.write_bytes(0x2508, 0, b"\x01\0")
    node.connection.wait(0.5)
    assert node.sdo.read(0x2501, 0) == b"\0\0" and node.sdo.read(0x2503, 0) == node.sdo.read(0x2504, 0)


def test_a_running_trace_takes_no_other_variables_and_shows_nothing(node: DriveNode) -> None:
    for sub, number in enumerate((6, 6), 1):
        node.write_bytes(0x2500, sub, struct.pack("<H", number))
    with pytest.raises(SdoAbort):
        node.write_bytes(0x2500, 3, struct.pack("<H", 999))
    node.write_bytes(0x2505, 0, b"\x08\0")
    node.write_bytes(0x2508, 0, b"\x01\0")
    node.connection.wait(0.1)
    with pytest.raises(SdoAbort):
        node.write_bytes(0x2500, 3, struct.pack("<H", 14))
    assert node.sdo.read(0x2509, 0) == b""
    with pytest.raises(SdoAbort):
        node.write_bytes(0x2508, 0, b"\x02\0")


def test_the_position_counter_goes_on_when_a_trace_is_started(node: DriveNode) -> None:
    """The core takes whole turns off the angles that it records."""
    shaft = behind(node)
    angle = 2.0 * np.pi * 3.3
    core = shaft.plant.core
    shown = [angle]
    shaft.plant = SimpleNamespace(
        look=lambda: None, core=SimpleNamespace(signal=lambda which: shown[0], record=lambda setup: shown.clear())
    )
    assert shaft.position(1000.0) == 3300
    shaft.record(None)
    shown.append(angle - 2.0 * np.pi * 3.0 + 0.01)
    assert shaft.position(1000.0) == 3302
    shown[0] += 2.0 * np.pi
    assert shaft.position(1000.0) == 4302
    assert core is not shaft.plant.core


class Shaft:
    """A drive of which everything but its current gains is known."""

    def __init__(self, connection: Any, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(learn_current_gains, "RECORDS", 2)
        monkeypatch.setattr(learn_current_gains, "SETTLE_S", 0.3)
        motor = load_machine_file(machine_path("interior-2k2")).machine
        self.drive = SpeedLoopDrive(connection, 1, drive_map=load_family("copley"))
        self.drawn = connection.bus.line.nodes[0].face.gains
        limit = 0.4 * rad_s_from_rpm(motor.n_max_rpm or 0.0)
        self.envelope = Envelope(self.drive.rated_apk, limit, duration_s=180.0)
        with guarded(self.drive, self.envelope) as guard:
            guard.enable()
            find_speed_unit(guard, self.drive, 0.5 * limit)
        J, K_T = motor.J_kgm2 or 0.0, 1.5 * motor.pole_pairs * motor.psi_f_wb
        self.loop = SpeedLoop(self.drawn.K_p_nms_per_rad * self.drawn.counts[0] / J, 1.0, 1e-3, 0.0, J / K_T)
        self.winding = Winding(motor.L_q_h, 0.005, motor.R_s_ohm)

    def counts(self) -> list[bytes]:
        return [self.drive.node.sdo.read(0x60F6, sub) for sub in (1, 2)]

    def learn(self) -> Any:
        found = learn_current_gains.current_gain_objects(self.drive.node, {CURRENT_GAIN: None})
        return learn_current_gains.learn_current_gains(
            self.drive, found, self.envelope, self.loop, self.winding, lambda text: None
        )  # fmt: skip


@pytest.mark.chain
def test_an_interruption_beside_a_changed_gain_puts_it_back(channel: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with connect("pmsmsim", channel) as connection:
        shaft = Shaft(connection, monkeypatch)
        before, seen = shaft.counts(), []

        def fit(*_: Any) -> CurrentLoop:
            seen.append(shaft.counts())
            if seen[-1] != before:
                raise KeyboardInterrupt
            return CurrentLoop(2000.0, 300.0, 1.0, 0.01)

        monkeypatch.setattr(learn_current_gains, "fit_current_loop", fit)
        with pytest.raises(Interrupted):
            shaft.learn()
        assert len(seen) == 3 and shaft.counts() == before and not any_left()
        shaft.drive.close()


@pytest.mark.chain
def test_current_gains_of_a_drive_are_the_drawn_ones_and_are_put_back(
    channel: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with connect("pmsmsim", channel) as connection:
        shaft = Shaft(connection, monkeypatch)
        before = shaft.counts()
        learned, stopped = shaft.learn()
        assert shaft.counts() == before and stopped is None
        shaft.drive.close()
    current = shaft.drawn.current
    gain, integral = learned[CURRENT_GAIN], learned[CURRENT_INTEGRAL]
    assert gain.scale == pytest.approx(current.K_p_nms_per_rad, rel=CURRENT_TOL), gain
    assert integral.form == {"parallel": "value", "rate": "rate", "time": "time"}[current.form]
    assert integral.scale == pytest.approx(current.integral_scale, rel=CURRENT_TOL), integral


def test_without_a_recorder_at_the_rate_of_the_loop_no_current_gain_is_tried(node: DriveNode) -> None:
    asked = {CURRENT_INTEGRAL: None}
    assert set(learn_current_gains.current_gain_objects(node, asked)) == {CURRENT_GAIN, CURRENT_INTEGRAL}
    assert not learn_current_gains.current_gain_objects(node, {"speed.K_p_nms_per_rad": None})
    node.connection.bus.line.nodes[0].session.dictionary.find(0x2502, 0).source = lambda: struct.pack("<I", 300_000)  # type: ignore[attr-defined]
    assert not learn_current_gains.current_gain_objects(node, asked)


@pytest.mark.parametrize("first", [True, False])
def test_a_row_in_volts_replaces_the_output_of_unknown_worth(first: bool) -> None:
    text = dump_drive_map(load_family("copley"))
    volts, before = '[recorder.u_q_v]\nnumber = 20\nunit = "0.1 V"\n\n', "[recorder.asked_u_q]" if first else "[tables]"
    text = text.replace(before, volts + before)
    found = parse_drive_map(text, "map").recorder.channels
    assert found["u_q_v"].number == 20 and "asked_u_q" not in found
    recorder: Any = SimpleNamespace(signals=tuple(found))
    assert learn_current_gains.recorded_signals(recorder) == ("i_q_ref_a", "i_q_a", "u_q_v")


def test_what_stops_the_current_steps_leaves_what_was_learned_before(monkeypatch: pytest.MonkeyPatch) -> None:
    for error in (LimitExceeded("speed", 2.0, 1.0, "rad/s"), NotAvailable("the trace is damaged")):

        def fails(*_: Any, error: Exception = error) -> None:
            raise error

        monkeypatch.setattr(learn_current_gains, "learn_current_loop", fails)
        nothing: Any = None
        found, stopped = learn_current_gains.learn_current_gains(
            nothing, {CURRENT_GAIN: nothing, CURRENT_INTEGRAL: nothing}, nothing, nothing, nothing, print
        )
        assert set(found) == {CURRENT_GAIN, CURRENT_INTEGRAL} and found[CURRENT_GAIN].scale is None
        assert found[CURRENT_GAIN].why and (stopped is error) == isinstance(error, LimitExceeded)


@pytest.mark.parametrize(("K_p_per_T", "speed"), [(0.9, 50.0), (0.1, 600.0)])
def test_a_gain_is_not_changed_where_margin_or_bandwidth_would_be_too_small(K_p_per_T: float, speed: float) -> None:
    T = 6e-5
    learner = object.__new__(learn_current_gains._CurrentLearner)
    learner.period_s, learner.notes = T, []
    learner.speed_loop = SpeedLoop(speed, 1.0, 1e-3, 0.0, 0.02)
    gain: Any = SimpleNamespace(name="g", counts=1000.0, address="0x60F6:01", item=SimpleNamespace(letter="h", size=2))
    own = CurrentLoop(K_p_per_T / T, 300.0, 1.0, 0.01)
    assert learner._changed(gain, 0.8, own, (1.0, 1.25), {}) is None
    assert "not changed" in learner.notes[0]


def test_steps_are_as_large_as_the_voltage_lets_them() -> None:
    """24 V and 4.9 V/A: steps of 2.1 A reached the limit in 0.3 % of the samples, and K_p came out 4.5 % too small."""
    learner = object.__new__(learn_current_gains._CurrentLearner)
    learner._largest_a = lambda: 7.0  # type: ignore[method-assign]
    learner._reference = lambda size: [-70.0, 70.0]  # type: ignore[method-assign]
    loop = CurrentLoop(4.9 / 5.5e-4, 150.0, 1.0, 0.01)
    fits = 0.8 * (24.0 / math.sqrt(3.0) - 3.5 - 0.588) / (4.9 * 0.275 * 7.0)
    for U_dc, wanted in ((24.0, fits), (325.0, 1.0), (5.0, learn_current_gains.LEAST)):
        learner.winding = Winding(5.5e-4, 0.005, 0.12, U_dc / math.sqrt(3.0), 0.05)
        assert learner._within_voltage(loop) == pytest.approx(wanted)
    learner.winding = Winding(5.5e-4, 0.005, 0.12)
    assert learner._within_voltage(loop) == 1.0, "a voltage that is not known limits nothing"
