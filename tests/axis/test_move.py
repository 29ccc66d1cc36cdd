# SPDX-License-Identifier: MIT
"""What a recorded move says, from records whose numbers are known."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest

from pmsmtool.axis.move import Profile, compared_moves, followed, move_result, plan, same_move, shown
from pmsmtool.errors import IdentificationError
from pmsmtool.identification.move_mechanics import halves_of_moves
from pmsmtool.trace import Trace

WAY = 1.5


def record(late_s: float, rest_a: float = 0.3, *, way: float = WAY, speed: float = 8.0) -> Trace:
    """A shaft that follows its demand late by a fixed time, there and back, at 1 kHz; 2 A per 100 rad/s2."""
    t = np.arange(0.0, 2.0, 1e-3)
    move = plan(way, Profile(speed, 120.0))

    def path(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        there, _, up = move.at(at - 0.2)
        back, _, down = move.at(at - 1.1)
        return there - back, up - down

    (demand, acceleration), (angle, _) = path(t), path(t - late_s)
    signals = {"theta_ref_rad": demand, "theta_m_rad": angle, "i_q_a": rest_a + 0.02 * acceleration}
    return Trace(t, signals, {"theta_ref_rad": "rad", "theta_m_rad": "rad", "i_q_a": "A"}, {"way_rad": way})


def test_a_shaft_that_follows_late_has_the_error_of_its_speed() -> None:
    found = move_result(record(5e-3))
    assert found.error_peak_rad == pytest.approx(8.0 * 5e-3, rel=1e-6)  # at constant speed
    assert found.current_peak_a == pytest.approx(2.4, rel=1e-6)  # 120 rad/s2, the current at rest taken off
    assert found.moving_s == pytest.approx(2.0 * plan(WAY, Profile(8.0, 120.0)).duration_s, abs=0.02)
    assert found.error_end_rad < 1e-5  # the last samples of a rest see the next move begin


def test_settling_is_the_last_time_outside_one_percent_of_the_way() -> None:
    """At the end of a braking ramp the late shaft is 60 t^2 rad short: outside 15 mrad until 16 ms before it rests."""
    found = move_result(record(40e-3))
    assert found.settling_s == pytest.approx(40e-3 - np.sqrt(0.015 / 60.0), abs=3e-3)


def test_an_error_that_stays_outside_has_not_settled() -> None:
    """A tenth of a radian is left of 1.5: more than 1 %."""
    trace = record(5e-3)
    left = np.where(trace.t_s > 0.5, 0.1, 0.0)
    stuck = {**trace.signals, "theta_m_rad": trace["theta_m_rad"] - left}
    found = move_result(Trace(trace.t_s, stuck, trace.units, trace.meta))
    assert found.settling_s == np.inf and found.error_end_rad == pytest.approx(0.1, rel=1e-3)
    rows = {row.name: row for row in compared_moves(found, found)}
    assert rows["settling_s"].shown_ratio == "-" and shown(found.settling_s, "s") == "not within the record"


@pytest.mark.parametrize("seed", range(4))
def test_a_demand_that_is_noisy_at_rest_rests(seed: int) -> None:
    """A demand of position and following error: all moves of a record were one, of 3.2 s, and none ever ended."""
    trace = record(5e-3)
    noise = 5e-4 * np.random.default_rng(seed).standard_normal(trace.t_s.size) * (trace.t_s > 0.2)
    noisy = Trace(trace.t_s, trace.signals | {"theta_ref_rad": trace["theta_ref_rad"] + noise}, trace.units, trace.meta)
    found = move_result(noisy)
    assert found.moving_s == pytest.approx(move_result(trace).moving_s, abs=0.02)
    assert np.isfinite(found.settling_s) and len(halves_of_moves(noisy)) == 4


def test_the_same_move_has_the_same_way_and_speed() -> None:
    assert same_move(record(40e-3), record(2e-3))
    assert not same_move(record(2e-3), record(2e-3, way=1.03 * WAY))
    assert not same_move(record(2e-3), record(2e-3, speed=6.0))


def test_a_move_is_as_slow_as_keeps_its_error_from_the_one_that_ends_it() -> None:
    """Two Nanotec PD4-C stayed 30.1 and 30.4 degrees behind with the designed gains, and 30 end a move of 60."""
    fast = Profile(100.0, 400.0, 8000.0)
    tried: list[Profile] = []

    def behind(share: float, profile: Profile) -> float:
        tried.append(profile)
        return share * profile.speed / fast.speed

    assert followed(-2.0, fast, partial(behind, 0.9)) is fast and tried == [fast]
    slow = followed(-2.0, fast, partial(behind, 3.0))
    assert slow is not None and 0.8 < 3.0 * slow.speed / fast.speed <= 0.9
    assert slow.acceleration / slow.speed == pytest.approx(4.0)
    assert slow.jerk / slow.acceleration == pytest.approx(20.0), "the load is at rest after the same ramp"
    assert followed(2.0, fast, lambda profile: 0.95) is None, "friction: no slower move helps"
    assert followed(2.0, fast, lambda profile: math.inf) is None


def test_two_moves_number_by_number() -> None:
    rows = {row.name: row for row in compared_moves(move_result(record(8e-3)), move_result(record(2e-3)))}
    assert rows["error_peak_rad"].ratio == pytest.approx(0.25, rel=1e-6)
    assert rows["way_rad"].ratio == 1.0


def test_a_demand_that_does_not_move_is_refused() -> None:
    trace = record(5e-3)
    still = {**trace.signals, "theta_ref_rad": np.zeros(trace.t_s.size)}
    with pytest.raises(IdentificationError, match="demand moved"):
        move_result(Trace(trace.t_s, still, trace.units, trace.meta))
