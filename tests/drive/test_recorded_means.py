# SPDX-License-Identifier: MIT
"""Means made from records: two windows of one record, and rows that no harmonic of a turning machine folds onto."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import pytest

from pmsmtool.bus.connect import Connection
from pmsmtool.drive import objects
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.guard import guarded
from pmsmtool.drive.recorder_drives import AT_REST, LOOK, TURNING, RecordedMeans, RecordingDrive, spacing
from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.trace import Trace

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


class Armed(RecordedMeans):
    """Means of a shaft that turns at a given speed, and how their records were set up."""

    def __init__(self, omega_e_rad_s: float) -> None:
        self._period_s = 1e-4
        self.omega_e_rad_s = omega_e_rad_s
        self.armed: list[tuple[tuple[str, ...], int, int, int]] = []

    def arm(
        self, signals: Sequence[str], samples: int, decimation: int, pretrigger: int, *, at_excitation: bool,
        at_move: bool = False,
    ) -> None:  # fmt: skip
        assert not at_excitation and not at_move
        self.armed.append((tuple(signals), samples, decimation, pretrigger))

    def fetch(self, signals: Sequence[str], decimation: int) -> Trace:
        rows = np.arange(float(self.armed[-1][1]))
        assert (tuple(signals), decimation) == (self.armed[-1][0], self.armed[-1][2])
        return Trace(1e-4 * decimation * rows, dict.fromkeys(signals, rows), dict.fromkeys(signals, "1"))

    def _omega_e_rad_s(self) -> float:
        return self.omega_e_rad_s

    def take(self, periods: int) -> Mapping[str, float]:
        self.start_average(("i_q_a",), periods)
        return self.finish_average(("i_q_a",))


def test_at_rest_a_look_is_32_rows_and_half_a_window_256() -> None:
    for omega in (0.0, 20.0):
        means = Armed(omega)
        assert means.take(800) == {"i_q_a": 15.5}
        assert means.halves(means.take, 800).samples == 2 * 256
        assert means.halves(means.take, 100).samples == 2 * 100
        assert means.armed == [(("i_q_a",), rows, 1, 0) for rows in (32, 256, 256, 100, 100)]


def test_of_a_turning_shaft_both_halves_are_128_rows_out_of_step_with_it() -> None:
    for omega in (20.1, 700.0, 1400.0, 2800.0):
        means = Armed(omega)
        first, second, samples = means.halves(means.take, 1600)
        ((_, rows, decimation, before),) = means.armed
        assert decimation == spacing(3200, 128, omega * 1e-4 / (2.0 * math.pi)) >= 25
        assert (rows, before, samples) == (3200 // decimation, 0, 2 * (rows // 2)) and rows <= 128
        assert (first["i_q_a"], second["i_q_a"]) == (0.5 * (rows // 2 - 1), rows - 0.5 * (rows // 2 + 1))
        means.take(1600)
        assert means.armed[-1][2] == spacing(1600, 32, omega * 1e-4 / (2.0 * math.pi)) >= 50
    assert Armed(700.0).take(1) == {"i_q_a": 0.0}


def test_an_angle_goes_on_where_records_begin_again() -> None:
    for sense in (1.0, -1.0):
        means = Armed(0.0)
        for angle in sense * np.arange(2.9, 40.0, 2.9):
            assert means.continued(math.remainder(angle, 2.0 * math.pi)) == pytest.approx(angle)


def left_of(harmonic: int, periods: int, step: int, turns_per_period: float) -> float:
    """Share of a harmonic of the inverter's error in the mean of half a window that is thinned out."""
    rows = np.arange(periods // step // 2)
    return float(abs(np.mean(np.exp(2j * math.pi * harmonic * turns_per_period * step * rows))))


@pytest.mark.parametrize("periods", [600, 1260, 4000])
def test_rows_are_not_taken_in_step_with_a_harmonic(periods: int) -> None:
    least = math.ceil(periods / 128)
    speeds = [float(turns) for turns in np.linspace(1e-3, 2e-2, 400) if 6.0 * turns * periods > 8.0]
    chosen = [spacing(periods, 128, turns) for turns in speeds]
    assert all(least <= step < 2 * least for step in chosen)
    for harmonic in (6, 12, 18, 24):
        left = [left_of(harmonic, periods, step, turns) for step, turns in zip(chosen, speeds, strict=True)]
        assert max(left) < 0.2
    if least > 8:  # rows so far apart that the sixth folds onto them at some of these speeds
        assert max(left_of(6, periods, least, turns) for turns in speeds) > 0.9


def test_the_narrowest_rows_are_taken_at_which_every_harmonic_beats_twice() -> None:
    assert spacing(3200, 128, 1.0 / 150.0) == 26  # the sixth: 25 periods apart never, 26 apart 2.5 times, 27 apart 4.7
    # at 36 rows a turn the twelfth or the eighteenth fold onto 2, 3 and 4 of them; 5 would leave half a record too few
    assert spacing(256, 128, 1.0 / 36.0) == 2
