# SPDX-License-Identifier: MIT
"""A record of a drive that follows a speed: when its references and samples were, by the clock of the bus."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest

from pmsmtool.drive.port import Excitation, Injection, Recording, Shape
from pmsmtool.drive.speed_loop_drive import POSITION, Oscillation, SpeedLoopDrive

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


def test_a_reference_is_written_in_the_middle_of_its_transfer(monkeypatch: pytest.MonkeyPatch) -> None:
    """The time between a reference and what the loop makes of it is a measured value (``map learn``)."""
    bus = Bus()
    drive = object.__new__(SpeedLoopDrive)
    supervision = SimpleNamespace(check=lambda: None)
    drive.node = SimpleNamespace(node=1, connection=bus, get=bus.transfer, put=bus.transfer, supervision=supervision)  # type: ignore[assignment]
    drive.oscillation, drive.sends, drive.period_s, drive.rad_s_per_count = Oscillation(), False, PERIOD_S, 0.5
    drive.counts_per_turn, drive._polled = 4000.0, ()
    drive._current = SimpleNamespace(item=object(), per_count=0.1)  # type: ignore[assignment]
    monkeypatch.setattr(SpeedLoopDrive, "check_operating", lambda self: None)
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
