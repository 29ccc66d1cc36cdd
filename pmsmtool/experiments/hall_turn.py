# SPDX-License-Identifier: MIT
"""A rotor that a current vector turns slowly over a turn and back, while the Hall wires are read."""

from __future__ import annotations

import math

import numpy as np

from pmsmtool.drive.port import Drive
from pmsmtool.experiments.vector_turn import lead_onto_vector, rising
from pmsmtool.trace import Trace

STEP_RAD = math.radians(2.0)
DWELL_S = 0.04
"""Steps of the vector, and time on each: with the window below 44 degrees per second."""
LOOK_S = 0.005
"""The current is averaged at the end of a step: where a phase current changes its sign, the inverter's dead time takes
the vector up to 9 degrees off what is commanded, and the rotor goes with it."""
WAY_RAD = math.radians(460.0)
"""One way: the turn that is evaluated, behind the way that takes up the friction."""
RAMP_STEPS = 20
SLOWEST = 0.1
"""The vector comes to speed over so many steps, from this share of it: a rotor without friction does not swing."""


def turn_over_halls(drive: Drive, i_a: float) -> Trace:
    """Turn the rotor both ways over more than an electrical turn; the vector stands at the end.

    Parameters
    ----------
    drive : Drive
        Enabled.
    i_a : float
        Length of the vector (A peak).

    Returns
    -------
    Trace
        ``commanded_rad`` and ``angle_rad`` of the vector (electrical), and ``hall_pattern``, by steps.
    """
    steps = round(WAY_RAD / STEP_RAD)
    lead_onto_vector(drive, i_a, 0.0)
    ramp = [max(SLOWEST, share) for share in rising(RAMP_STEPS)]
    periods = max(1, round(LOOK_S / drive.period_s))
    rows: list[tuple[float, float, float, float]] = []
    t_s = 0.0
    for k in (*range(1, steps + 1), *range(steps - 1, -1, -1)):
        gone, commanded = len(rows) % steps, STEP_RAD * k
        drive.command_current(i_a, 0.0, fixed_angle_rad=commanded)
        dwell = DWELL_S / (ramp[gone] if gone < RAMP_STEPS else 1.0)
        drive.wait(dwell)
        seen = drive.average(("i_d_a", "i_q_a"), periods)
        off = math.atan2(seen["i_q_a"], seen["i_d_a"])
        t_s += dwell + LOOK_S
        rows.append((t_s, commanded, commanded + off, drive.live("hall_pattern")))
    table = np.array(rows)
    units = {"commanded_rad": "rad", "angle_rad": "rad", "hall_pattern": "1"}
    return Trace(table[:, 0], dict(zip(units, table[:, 1:].T, strict=True)), units, {"i_a": i_a})
