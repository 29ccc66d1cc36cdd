# SPDX-License-Identifier: MIT
"""One move there and back by the drive's own position loop: what it demands, where the shaft is, and the current."""

from __future__ import annotations

from pmsmtool.drive.guard import GuardedDrive
from pmsmtool.drive.position_drive import PositionDrive
from pmsmtool.errors import DriveTimeout
from pmsmtool.trace import Trace

HOLD_S = 0.2
"""The shaft is held before the move: what is seen then is noise."""
LONGEST_S = 20.0
SLOW_S, SLOW_SHARE = 1.0, 0.02
"""A demand that has made less than this share of its way in this time is on a ramp that was never set up (one count by
the file); it has shown what a count is worth."""
ARRIVED = 1e-3
"""The demand has arrived when it is this near to its end, of the way."""


def record_move(guard: GuardedDrive, drive: PositionDrive, way_rad: float, settle_s: float, times: int = 1) -> Trace:
    """Move by an angle and back, each time waiting until the demand has arrived and ``settle_s`` longer; stop.

    Returns
    -------
    Trace
        ``theta_m_rad``, ``theta_ref_rad`` (from the start), ``i_q_a``; ``meta``: ``way_rad``.

    Raises
    ------
    DriveTimeout
        The demand does not arrive.
    LimitExceeded
        Current, speed, travel or following error; the voltage is off.
    """
    guard.enable()
    drive.begin_samples()
    try:
        guard.wait(HOLD_S)
        for target in (way_rad, 0.0) * times:
            drive.move_to(target)
            _arrive(guard, drive, target, way_rad)
            guard.wait(settle_s)
    finally:
        guard.stop()
        trace = drive.end_samples()
    return Trace(trace.t_s, trace.signals, trace.units, {**trace.meta, "way_rad": way_rad})


def _arrive(guard: GuardedDrive, drive: PositionDrive, target: float, way: float) -> None:
    clock, began_rad = drive.node.connection.clock, drive.demanded_rad()
    began = clock.now()
    until = began + LONGEST_S
    while abs(drive.demanded_rad() - target) > ARRIVED * abs(way):
        if clock.now() > until:
            raise DriveTimeout(
                f"the demand is {drive.demanded_rad():.4g} rad after {LONGEST_S:g} s, not {target:.4g} rad",
                where=f"node {drive.node.node}, 0x6062",
                likely=f"a profile that is too slow ({drive.profile()}), a software limit (0x607D), or an interlock of "
                "the drive", hint="ask for a shorter way, or raise the drive's profile with its maker's software",
            )  # fmt: skip
        spent, share = clock.now() - began, abs(drive.demanded_rad() - began_rad) / abs(target - began_rad)
        if drive.ramp_lent == 1.0 and spent > SLOW_S and 0.0 < share < SLOW_SHARE:
            drive.lend_ramp(0.5 / (share * (SLOW_S / spent) ** 2))  # half of the way in SLOW_S
            drive.move_to(target)
        guard.wait(0.02)
