# SPDX-License-Identifier: MIT
"""The predicted following error against the same loop stepped sample by sample, without a frequency response."""

from __future__ import annotations

import numpy as np
import pytest

from pmsmtool.axis.loops import AxisGains, AxisPath, Structure, best_share, following_error, lifted
from pmsmtool.axis.move import Profile, plan
from pmsmtool.design.loops.current_loop import AxisPlant, axis_loop, imc
from pmsmtool.machine.two_masses import Mechanics

T = 4e-4
CURRENT = axis_loop(imc(0.5, 2e-3, 900.0), AxisPlant(0.5, 2e-3, T, 1.5))
GAINS = AxisGains(0.15, 0.75, 5.0)
MOVE = plan(3.0, Profile(20.0, 200.0))
SHARE = 0.6
AGREES_RAD = 1e-5
"""Difference to the samples; measured 4e-6, what the third period still has of the first."""


def stepped(path: AxisPath, share: float, *, leads: bool = False) -> np.ndarray:
    """Return the error of the third period of a move there and back."""
    plant = lifted(path)
    half = int(np.ceil((MOVE.duration_s + 0.5) / T))
    place, speed, rise = MOVE.at(np.arange(half) * T)
    place, speed, rise = (
        np.concatenate(pair) for pair in ((place, MOVE.distance - place), (speed, -speed), (rise, -rise))
    )
    K_P, K_I, K_D = GAINS.pid
    pole = 10.0 * K_P / K_D
    x, total, slope, last_error, last = np.zeros(plant.b.size), 0.0, 0.0, 0.0, 0.0
    errors = np.zeros(place.size)
    for _ in range(3):
        for k in range(place.size):
            angle = float(plant.c[0] @ x)
            error = place[k] - angle
            forward, ahead = share * path.shaft.J * rise[k], 0.0
            if leads:
                forward, ahead = 0.0, forward / GAINS.K_p
            if path.structure == "pid":
                slope = (slope + K_D * pole * (error - last_error)) / (1.0 + pole * T)
                torque, total = K_P * error + slope + total + forward, total + K_I * T * error
            else:
                slip = GAINS.K_v * error + speed[k] + ahead - (angle - last) / T
                torque, total = GAINS.K_p * slip + total + forward, total + GAINS.K_i * T * slip
            last_error, last, errors[k] = error, angle, error
            x = plant.A @ x + plant.b * torque
    return errors


@pytest.mark.parametrize(("structure", "leads"), [("cascade", False), ("cascade", True), ("pid", False)])
def test_prediction_is_the_loop_stepped_sample_by_sample(structure: Structure, leads: bool) -> None:
    path = AxisPath(Mechanics(0.015, 0.002, 25.0, 90.0, 0.02), CURRENT, 1, late=1, structure=structure)
    plain, added = following_error(lifted(path), path, GAINS, MOVE, leads=leads)
    ours, theirs = (plain + SHARE * added)[0], stepped(path, SHARE, leads=leads)
    assert np.max(np.abs(ours - ours.mean() - theirs + theirs.mean())) < AGREES_RAD
    share, peak = best_share(plain, added)
    if leads:  # the controller's integral part adds to it
        assert 0.4 < share < 1.0 and peak < 0.65 * np.max(np.abs(plain[0]))
        return
    assert share > 0.8 and peak < 0.1 * np.max(np.abs(plain[0]))
    # the load swings behind this ramp: measured 1.06 of J a
    needed = path.shaft.J * float(np.max(np.abs(MOVE.at(np.linspace(0.0, MOVE.duration_s, 400))[2])))
    assert needed < np.max(np.abs((plain + added)[1])) < 2.0 * needed
