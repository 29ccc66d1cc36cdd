# SPDX-License-Identifier: MIT
"""A speed loop out of the current that it asks for, behind a current loop that loses much of a small current."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pmsmtool.identification.asked_current import asked_share, fit_asked_current, held_apart, shows_asked
from pmsmtool.identification.speed_loop_response import Emf, SpeedLoop, StepRecord
from pmsmtool.measurement.learn_gains import TICK_S, staircase

PLANT_S = 1e-4
AMPS_PER_RAD_S2 = 0.011
A, B = 40.0, 320.0
LOST, LAG_S = 0.15, 3e-3
"""What the current loop loses, and its lag: an inverter's dead time at some percent of the rated current."""
EMF = Emf(0.05, 1e4)
RESPONSE = SpeedLoop(0.8 * A, 0.8 * B, 6e-3, 1e-3, AMPS_PER_RAD_S2)
"""What the response alone may say of it."""
K_P_ERROR, K_I_ERROR = 0.02, 0.03
"""Measured: +1.3 %, +1.5 %; with jitter +1.2 %, +0.3 %."""
JITTER_S = 3e-4
"""Of the instants of samples, as a bus tells them: at speed it is an angle."""


def recorded() -> StepRecord:
    rng = np.random.default_rng(1)
    speeds, ways = staircase(20.0, 8.0, 4, 50.0, 0.1)
    omega = filtered = speeds[0]
    angle = integral = torque = 0.0
    rows = []
    for k in range(round(len(speeds) * TICK_S / PLANT_S)):
        error = speeds[int(k * PLANT_S / TICK_S)] - filtered
        integral += B * error * PLANT_S
        asked = A * error + integral
        torque += PLANT_S / LAG_S * (asked / (1.0 + LOST) - torque)
        omega += torque * PLANT_S
        angle += omega * PLANT_S
        filtered += PLANT_S / 8e-4 * (omega - filtered)
        if k % 10 == 0:
            rows.append((k * PLANT_S, angle, AMPS_PER_RAD_S2 * torque, AMPS_PER_RAD_S2 * asked))
    table = np.array(rows)
    count = 2.0 * math.pi / 16384
    steps = [(TICK_S * k, speed) for k, speed in enumerate(speeds) if k == 0 or speed != speeds[k - 1]]
    current = table[:, 2] + rng.normal(0.0, 0.01, len(table))
    position = np.round(table[:, 1] / count) * count
    return StepRecord(table[:, 0], position, current, steps, ways, count / 3.5, 0.01, table[:, 3])


@pytest.mark.chain
def test_what_is_asked_for_tells_the_gains_whatever_the_current_loop_does() -> None:
    record = recorded()
    jitter = np.random.default_rng(0).normal(0.0, JITTER_S, len(record.t_s))
    for one in (record, replace(record, t_s=np.sort(record.t_s + jitter))):
        assert shows_asked([asked_share(one, RESPONSE, EMF)], EMF)
        found = fit_asked_current(one, RESPONSE)
        assert found is not None
        assert found.loop.K_p_per_J == pytest.approx(A, rel=K_P_ERROR)
        assert found.loop.K_i_per_J == pytest.approx(B, rel=K_I_ERROR)
    assert record.asked_a is not None
    for other in (record.current_a, math.sqrt(2.0) * record.asked_a, None):  # the same object, rms for peak, none
        assert not shows_asked([asked_share(replace(record, asked_a=other), RESPONSE, EMF)], EMF)


def test_records_together_say_whether_a_current_is_asked_for() -> None:
    """Of one drive at 0.17 of its rated current two records gave these: the second one alone is none."""
    assert shows_asked([0.085, -0.037], Emf(0.052, 71.0))
    assert not shows_asked([0.03, -0.042], Emf(0.052, 71.0)) and not shows_asked([math.nan, 0.1], EMF)


def test_the_emf_of_a_light_rotor_is_told_from_another_unit_at_a_held_speed() -> None:
    """It takes half of the current of its steps: more than peak over rms. At a held speed it takes none."""
    t = np.linspace(0.0, 1.0, 1001)
    noise = np.random.default_rng(2).normal(0.0, 0.01, t.size)
    record = StepRecord(t, t, 0.1 + noise, [(0.0, 1.0), (0.5, 2.0)], [(0.5, 1.0)], 1e-4, 0.01, np.full_like(t, 0.1))
    assert held_apart(record) < 0.02
    assert held_apart(replace(record, asked_a=np.full_like(t, 0.1 * math.sqrt(2.0)))) == pytest.approx(0.414, abs=0.02)
    for none in (replace(record, current_a=noise), replace(record, asked_a=None)):
        assert math.isinf(held_apart(none)), "too little current, or only one of them"
    light = Emf(0.65, 119.0)
    assert shows_asked([0.31, 0.51], light, held_apart(record))
    assert not shows_asked([0.31, 0.51], light, 0.414) and not shows_asked([0.31, 0.51], light)
    assert not shows_asked([0.05, 0.08], light, held_apart(record)), "both may be the current that flows"
