# SPDX-License-Identifier: MIT
"""Records of voltage and current over whole turns of a coasting shaft, for the harmonics of the back-EMF.

At every speed the d current is held with both signs: the inverter's error changes its sign with the current, and the
back-EMF does not. Speeds in both directions tell from it what does not grow with the speed, or looks like a delay.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from pmsmtool.drive.port import Drive
from pmsmtool.experiments.signals import readable
from pmsmtool.experiments.speed_run import SpeedPlan, reach_and_hold
from pmsmtool.trace import Trace

SHARES = (0.45, 0.7, 1.0)
"""Of the largest speed of the flux run, both directions."""
SIGNALS = ("u_d_v", "u_q_v", "i_d_a", "i_q_a", "theta_m_rad", "flags")
ROWS = 1000
"""Most rows of a record, which the bus takes some 0.4 s for."""
ROWS_PER_TURN = 50
"""Least rows of an electrical turn: four of the 13th harmonic's period."""
TURNS_LEAST = 4
"""Least electrical turns of a record; of a machine with more pole pairs one turn of the shaft, over which the errors of
an encoder that is off centre average out."""


def record_turns(drive: Drive, plan: SpeedPlan, pole_pairs: int, keep: Callable[[Trace], None]) -> None:
    """Record at every speed and with both signs of the d current; each trace is handed over as soon as it is there.

    The drive is enabled on entry with a speed controller that holds the machine; it is asked for standstill on return.
    """
    before = 0.0
    for sense in (1.0, -1.0):
        for share in SHARES:
            speed = sense * share * plan.omega_max_rad_s
            for sign in (1.0, -1.0):
                held = reach_and_hold(drive, plan, speed, before, pole_pairs)
                before = speed
                drive.command_current(sign * plan.i_d_a, held)
                drive.wait(plan.first_s)
                samples, decimation = rows_of(2.0 * math.pi / abs(speed * pole_pairs) / drive.period_s, pole_pairs)
                keep(readable(drive.record(SIGNALS, samples, decimation=decimation)))
    drive.command_speed(0.0)


def rows_of(turn_periods: float, pole_pairs: int) -> tuple[int, int]:
    """Return samples and decimation of a record; an electrical turn is so many control periods long."""
    turns = max(TURNS_LEAST, pole_pairs)
    decimation = math.ceil(turns * turn_periods / ROWS)
    if turn_periods < ROWS_PER_TURN * decimation:
        decimation = max(1, int(turn_periods / ROWS_PER_TURN))
        turns = max(1, int(ROWS * decimation / turn_periods))
    return min(ROWS, math.ceil(turns * turn_periods / decimation)), decimation
