# SPDX-License-Identifier: MIT
"""Means made from records: two windows of one record, and rows that no harmonic of a turning machine folds onto."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from pmsmtool.bus.connect import Connection
from pmsmtool.drive import objects
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.guard import guarded
from pmsmtool.drive.recorded_means import AT_REST, LOOK, TURNING, RecordingDrive, spacing
from pmsmtool.sim.bus import PmsmSimBus

SIGNALS = ("u_d_v", "i_d_a", "theta_m_rad", "T_winding_c")


@pytest.fixture
def drive() -> Iterator[RecordingDrive]:
    with Connection(PmsmSimBus("interior-2k2?nv=:memory:&level=inject")) as connection:
        made = RecordingDrive(connection, 1)
        yield made
        made.close()


def test_a_window_at_rest_is_two_runs_of_rows_one_right_after_the_other(drive: RecordingDrive) -> None:
    first, second, samples = drive.halves(SIGNALS, 800)
    assert set(first) == set(second) == set(SIGNALS)
    assert samples == 2 * AT_REST and drive.node.whole(objects.TRACE_DECIMATION) == 1
    assert first["T_winding_c"] == pytest.approx(drive.live("T_winding_c"), abs=0.5)
    assert first["theta_m_rad"] == pytest.approx(second["theta_m_rad"], abs=0.01)
    assert first["i_d_a"] != second["i_d_a"]  # two windows, each with its own noise
    drive.average(SIGNALS, 800)
    assert drive.node.whole(objects.TRACE_DEPTH) == LOOK


def test_a_window_of_a_turning_shaft_is_one_record(drive: RecordingDrive) -> None:
    with guarded(drive, Envelope(i_max_apk=5.0, speed_max_rad_s=200.0, duration_s=20.0)) as guard:
        guard.enable()
        guard.command_current(0.0, 1.5)
        guard.wait(0.3)
        guard.command_current(0.0, 0.0)
        periods = 1200
        first, second, samples = guard.halves(("omega_e_rad_s", "i_q_a"), periods)
        spanned = samples * drive.node.whole(objects.TRACE_DECIMATION)
    assert TURNING // 2 <= samples <= TURNING and 0.98 * 2 * periods < spanned <= 2 * periods
    assert first["omega_e_rad_s"] > 20.0 and second["omega_e_rad_s"] > 20.0


def test_a_recorder_that_is_set_up_is_only_armed(drive: RecordingDrive) -> None:
    drive.average(SIGNALS, 100)
    drive.node.put(objects.TRACE_DEPTH, 5)
    drive.average(SIGNALS, 100)
    assert drive.node.whole(objects.TRACE_DEPTH) == 5  # the same mean again: nothing is written
    drive.recorder.forget()
    drive.average(SIGNALS, 100)
    assert drive.node.whole(objects.TRACE_DEPTH) == LOOK


def test_a_drive_with_averages_takes_them_one_after_the_other() -> None:
    with Connection(PmsmSimBus("interior-2k2?nv=:memory:")) as connection:
        made = CanopenDrive(connection, 1)
        assert made.halves(("i_d_a",), 64).samples == 128
        made.close()


def left_of_the_sixth(periods: int, step: int, turns_per_period: float) -> float:
    """Share of the inverter's sixth harmonic in the mean of half a window that is thinned out."""
    rows = np.arange(periods // step // 2)
    return float(abs(np.mean(np.exp(2j * math.pi * 6.0 * turns_per_period * step * rows))))


@pytest.mark.parametrize("periods", [600, 1260, 4000])
def test_rows_are_not_taken_in_step_with_a_harmonic(periods: int) -> None:
    least = math.ceil(periods / 128)
    speeds = [float(turns) for turns in np.linspace(1e-3, 2e-2, 400) if 6.0 * turns * periods > 8.0]
    chosen = [spacing(periods, 128, turns) for turns in speeds]
    assert all(least <= step < 2 * least for step in chosen)
    assert max(left_of_the_sixth(periods, step, turns) for step, turns in zip(chosen, speeds, strict=True)) < 0.2
    if least > 8:  # rows so far apart that the sixth folds onto them at some of these speeds
        assert max(left_of_the_sixth(periods, least, turns) for turns in speeds) > 0.9
