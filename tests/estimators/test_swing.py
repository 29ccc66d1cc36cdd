# SPDX-License-Identifier: MIT
"""The frequency at which torque pulses swing a shaft, beside a resonance that a small torque shows."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from pmsmtool.estimators.shaft.swing import FREQUENCIES, swing_of
from pmsmtool.trace import Trace

ROWS, T_S = 122, 3e-4
STEP = 2.0 * math.pi / 2**14
FREQUENCY_LIMIT = 0.1
"""Distance of two frequencies that are tried, of 60 from 55 to 667 Hz: 0.043."""


def push(swing_hz: float, ratio: float, sign: float = 1.0) -> Trace:
    """A pulse of 1600 rad/s2 on two masses that swing, damped by 3 %; ratio 0: a rigid shaft."""
    t = T_S * np.arange(ROWS, dtype=np.float64)
    w = 2.0 * math.pi * swing_hz
    theta = 1600.0 * (0.5 * t**2 + ratio / w**2 * (1.0 - np.exp(-0.03 * w * t) * np.cos(w * t)))
    signals = {"i_d_a": 0.0 * t, "i_q_a": 0.0 * t + sign, "theta_M_rad": STEP * np.floor(sign * theta / STEP)}
    return Trace(t, signals, dict.fromkeys(signals, "1"))


def torque(i_d: NDArray[np.float64], i_q: NDArray[np.float64]) -> NDArray[np.float64]:
    return 0.15 * i_q


def pushes(swing_hz: float, ratio: float) -> list[Trace]:
    return [push(swing_hz, ratio, sign) for sign in (1.0, -1.0)]


def test_pushes_of_two_masses_swing_at_their_resonance() -> None:
    assert FREQUENCIES == 60
    assert swing_of(pushes(150.0, 3.0), torque) == pytest.approx(150.0, rel=FREQUENCY_LIMIT)
    assert swing_of(pushes(150.0, 3.0), torque, 31.0, 2.0) == pytest.approx(150.0, rel=FREQUENCY_LIMIT)


def test_a_resonance_that_explains_the_pushes_stands_and_a_rigid_shaft_swings_at_none() -> None:
    assert swing_of(pushes(150.0, 3.0), torque, 149.0, 3.0) == 0.0
    assert swing_of(pushes(150.0, 3.0), torque, 140.0, 1.0) == 0.0, "an elastic shaft whose resonance is a little off"
    assert swing_of(pushes(150.0, 0.0), torque) == 0.0
    assert swing_of(pushes(150.0, 3.0), torque, 400.0, 3.0) == 0.0, "nothing above it that the rows show"
