# SPDX-License-Identifier: MIT
"""A record of a drive that follows a speed: when its references and samples were, by the clock of the bus."""

from __future__ import annotations

import math
from collections import deque
from types import SimpleNamespace

import numpy as np
import pytest

from pmsmtool.cia402 import Mode
from pmsmtool.drive import objects
from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive.port import Excitation, Injection, Recording, Shape
from pmsmtool.drive.speed_loop_drive import POSITION, Oscillation, SpeedLoopDrive
from pmsmtool.drive.standard_drive import RecorderDrive
from pmsmtool.errors import DriveTimeout
from pmsmtool.trace import Trace

TRANSFER_S = 4e-4
PERIOD_S = 1e-3


class Bus:
    """A clock that a transfer takes along."""

    def __init__(self) -> None:
        self.t_s = 10.0
        self.clock = self

    def now(self) -> float:
        return self.t_s

    def wait(self, seconds: float) -> None:
        self.t_s += seconds

    def transfer(self, item: object, value: float = 0.0) -> float:
        self.t_s += TRANSFER_S
        return 1000.0 if item is POSITION else 3.0


def test_a_record_without_a_sample_says_when_its_steps_were() -> None:
    drive = object.__new__(SpeedLoopDrive)
    drive.sends, drive._samples, drive._written, drive.may_be_energised = True, [], [(10.5, 20.0)], False
    drive.asked = ()
    trace = drive.finish_record(Recording((), 0))
    assert len(trace) == 0 and trace.meta["steps"] == [[10.5, 20.0]]


@pytest.mark.parametrize("late_s", [2.5e-4, 7.9e-4, 8.1e-4])
def test_a_step_behind_the_recorder_begins_when_the_drive_gets_it(
    late_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A row every 0.1 ms, eight more than are asked for: a step may come so much later than the recorder's start."""
    bus, put, armed = Bus(), [], []

    def write(item: DriveObject, value: float) -> None:
        bus.t_s += late_s
        put.append((item, value))

    def fetch(signals: tuple[str, ...], decimation: int) -> Trace:
        t_s = 1e-4 * np.arange(float(armed[0][1]))
        return Trace(t_s, {"i_q_a": t_s}, {"i_q_a": "A"}, {"period_s": 1e-4})

    drive = object.__new__(RecorderDrive)
    drive.node = SimpleNamespace(node=1, connection=bus, put=write)  # type: ignore[assignment]
    drive.may_be_energised = False
    drive.recorder = SimpleNamespace(arm=lambda *set_up, at_excitation: armed.append(set_up), fetch=fetch)  # type: ignore[assignment]
    monkeypatch.setattr(RecorderDrive, "_set_mode", lambda self, mode: put.append(mode))
    recording = Recording(("i_q_a",), 20, 2, Excitation(Shape.STEP, Injection.SPEED, 10.0 * math.pi), 3)

    drive.begin_record(recording, bus.wait)
    assert armed == [(("i_q_a",), 28, 2, 3)]
    assert put == [(objects.TARGET_VELOCITY_MRPM, pytest.approx(300_000.0)), Mode.PROFILE_VELOCITY]
    if late_s > 8e-4:
        with pytest.raises(DriveTimeout, match="came 0.81 ms after"):
            drive.finish_record(recording)
        return
    trace = drive.finish_record(recording)
    assert len(trace) == 20 and trace["i_q_a"] == pytest.approx(trace.t_s + late_s) and trace.t_s[0] == 0.0
    assert trace.meta["late_s"] == pytest.approx(late_s)


def stairs_drive(bus: Bus, monkeypatch: pytest.MonkeyPatch) -> SpeedLoopDrive:
    drive = object.__new__(SpeedLoopDrive)
    supervision = SimpleNamespace(check=lambda: None)
    drive.node = SimpleNamespace(node=1, connection=bus, get=bus.transfer, put=bus.transfer, supervision=supervision)  # type: ignore[assignment]
    drive.oscillation, drive.sends, drive.period_s, drive.rad_s_per_count = Oscillation(), False, PERIOD_S, 0.5
    drive.counts_per_turn, drive._polled, drive.asked, drive.may_be_energised = 4000.0, (), (), False
    drive._seen, drive._seen_s = deque(), 0.0
    drive._current = SimpleNamespace(item=object(), per_count=0.1)  # type: ignore[assignment]
    monkeypatch.setattr(SpeedLoopDrive, "check_operating", lambda self: None)
    return drive


def test_a_bus_too_slow_for_every_step_leaves_steps_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """The staircase is over when it was planned to be: what is fitted are its ways up."""
    bus = Bus()
    drive = stairs_drive(bus, monkeypatch)
    drive.period_s, speeds = 0.7 * TRANSFER_S, [10.0 + k for k in range(40)]
    stairs = Excitation(Shape.BUFFER, Injection.SPEED, 0.0, hold_periods=1, buffer=speeds)
    drive.begin_record(Recording((), 0, excitation=stairs), bus.wait)
    drive.wait(40.0 * drive.period_s)
    steps = drive.finish_record(Recording((), 0)).meta["steps"]
    assert 2 < len(steps) < 40 and steps[-1][1] == speeds[-1]


def test_a_reference_is_written_in_the_middle_of_its_transfer(monkeypatch: pytest.MonkeyPatch) -> None:
    """The time between a reference and what the loop makes of it is a measured value (``map learn``)."""
    bus = Bus()
    drive = stairs_drive(bus, monkeypatch)
    stairs = Excitation(Shape.BUFFER, Injection.SPEED, 0.0, hold_periods=5, buffer=(20.0, 20.0, 30.2))
    recording = Recording((), 0, excitation=stairs)

    drive.begin_record(recording, bus.wait)
    drive.wait(12.0 * PERIOD_S)
    trace = drive.finish_record(recording)

    sampled_s = 10.0 + TRANSFER_S + 0.5 * TRANSFER_S  # the first one is asked for right behind the first reference
    (first_s, first), (second_s, second) = trace.meta["steps"]
    assert sampled_s + first_s == pytest.approx(10.0 + 0.5 * TRANSFER_S, abs=1e-9) and first == 20.0
    late_s = sampled_s + second_s - (10.0 + 10.0 * PERIOD_S + 0.5 * TRANSFER_S)
    assert -1e-9 < late_s < 2.0 * TRANSFER_S, "it waits for no more than the sample that is being asked for"
    assert second == 30.0, "whole counts"
    assert trace["theta_m_rad"][0] == pytest.approx(0.5 * math.pi) and trace["i_q_a"][0] == pytest.approx(0.3)
    assert trace.t_s[0] == 0.0


def test_what_is_asked_for_is_in_the_unit_of_the_current_and_says_when_it_was_read(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Torque demand and torque are permille of the rated torque; the current is what the torque is beside it."""
    bus = Bus()
    drive = stairs_drive(bus, monkeypatch)
    drive.asked = DriveObject(0x6074, 0, "h"), DriveObject(0x6077, 0, "h")
    drive.begin_record(Recording((), 0), bus.wait)
    drive.wait(12.0 * PERIOD_S)
    trace = drive.finish_record(Recording((), 0))
    assert trace["i_q_ref_a"] == pytest.approx(trace["i_q_a"]) and trace["i_q_a"] == pytest.approx(0.3)
    assert trace.meta["asked_later_s"] == pytest.approx(TRANSFER_S)


def test_the_torque_is_taken_away_before_a_record_without_step_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reading may last longer than the push, which would go on."""
    happened: list[object] = []
    drive = object.__new__(RecorderDrive)
    drive.node = SimpleNamespace(node=1, put=lambda item, value: happened.append((item, value)))  # type: ignore[assignment]
    drive.target = SimpleNamespace(cyclic=False, quantity=SimpleNamespace(item="target torque", per_count=0.1))  # type: ignore[assignment]
    drive._asked_a, drive.may_be_energised = 4.0, False
    read = Trace(1e-4 * np.arange(3.0), {"i_q_a": np.zeros(3)}, {"i_q_a": "A"}, {"period_s": 1e-4})
    drive.recorder = SimpleNamespace(fetch=lambda *wanted: happened.append("read") or read)  # type: ignore[assignment]
    drive.finish_record(Recording(("i_q_a",), 3))
    assert happened == [("target torque", 0), "read"] and drive._asked_a == 0.0
