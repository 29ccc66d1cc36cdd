# SPDX-License-Identifier: MIT
"""More speed is asked for than the drive's own limit allows: as for the current, a limit that does not act is none."""

from __future__ import annotations

import math
from collections.abc import Callable

from pmsmtool.drive.port import Drive
from pmsmtool.experiments.current_limit import MOST, OVER, LimitShown
from pmsmtool.experiments.speed_run import COAST_BAND, reach

LimitSpeed = Callable[[float], float | None]
"""Sets the drive's own limit (rad/s), at most to the envelope's; returns what it keeps, None where it takes none."""
SHARE = 0.10
"""The limit for the trial, of the largest speed of the run."""
REACH_S, REST_S = 2.0, 1.0
"""Longest time until the speed stands, and until the shaft rests again (s)."""
SEEN_S = 0.2
"""Shortest window in which the speed is looked at (s), and at least one turn."""


def show_speed_limit(drive: Drive, limit_speed: LimitSpeed, largest_rad_s: float, pole_pairs: int) -> LimitShown | None:
    """Ask for one and a half times a lowered limit and see what the shaft does; None where there is no limit.

    Parameters
    ----------
    drive : Drive
        Off, at rest, with a speed controller that holds the machine; off and at rest on return.
    limit_speed : callable
        As :data:`LimitSpeed`.
    largest_rad_s : float
        Largest mechanical speed of the run.
    pole_pairs : int
        Of the machine.
    """
    kept = limit_speed(SHARE * largest_rad_s)
    if kept is None:
        return None
    try:
        drive.enable()
        asked = min(OVER * kept, largest_rad_s)
        drive.command_speed(asked)
        reach(drive, kept * pole_pairs, limit_s=REACH_S, band_rad_s=COAST_BAND * kept * pole_pairs)
        periods = math.ceil(max(SEEN_S, 2.0 * math.pi / kept) / drive.period_s)
        seen = abs(drive.average(("omega_e_rad_s",), periods)["omega_e_rad_s"]) / pole_pairs
        drive.command_speed(0.0)
        reach(drive, 0.0, limit_s=REST_S, band_rad_s=COAST_BAND * kept * pole_pairs)
        drive.disable()
    finally:
        limit_speed(math.inf)
    return LimitShown(asked, kept, seen, MOST * kept, "speed", "rad/s")
