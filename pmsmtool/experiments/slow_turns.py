# SPDX-License-Identifier: MIT
"""Turns at a low speed under the speed controller, both ways: current and position show what torque the angle adds.

Fast coasting hides a torque of a high order: its ripple of the position falls with the square of order and speed.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from pmsmtool.drive.port import Drive
from pmsmtool.experiments.signals import readable
from pmsmtool.experiments.speed_run import reach
from pmsmtool.trace import Trace

SIGNALS = ("i_d_a", "i_q_a", "theta_m_rad", "flags")
SPEED_RAD_S = math.pi
"""30 rpm: the noise of the position rises with the square of the speed, and slower ones come near to sticking."""
TURNS = 2.1
ROWS = 2000
"""Five per period of order 180."""
SETTLE_S, REACH_S, BAND = 0.5, 4.0, 0.3
"""Time after the speed is reached; longest time for that; relative band, within which cogging may move it."""


def record_slow_turns(drive: Drive, pole_pairs: int, speed_rad_s: float, keep: Callable[[Trace], None]) -> None:
    """Record turns in either direction; each trace is handed over as soon as it is there.

    The drive is enabled on entry with a speed controller that holds the machine; it is asked for standstill on return.
    """
    for speed in (speed_rad_s, -speed_rad_s):
        drive.command_speed(speed)
        omega_e = pole_pairs * speed
        reach(drive, omega_e, limit_s=REACH_S, band_rad_s=BAND * abs(omega_e))
        drive.wait(SETTLE_S)
        periods = round(TURNS * 2.0 * math.pi / abs(speed) / drive.period_s)
        decimation = math.ceil(periods / ROWS)
        keep(readable(drive.record(SIGNALS, periods // decimation, decimation=decimation)))
    drive.command_speed(0.0)
