# SPDX-License-Identifier: MIT
"""One move there and back by the drive's own position loop: what it demands, where the shaft is, and the current."""

from __future__ import annotations

import math

from pmsmtool.drive.guard import GuardedDrive
from pmsmtool.drive.position_drive import PositionDrive
from pmsmtool.errors import DriveTimeout, SafetyRefusal
from pmsmtool.experiments.move_profile import MoveProfile, find_profile
from pmsmtool.trace import Trace

HOLD_S = 0.2
"""The shaft is held before the move: what is seen then is noise."""
LONGEST_S = 20.0
ARRIVED = 1e-3
"""The demand has arrived when it is this near to its end, of the way."""
TRY_RAD, TRY_SHARE, TRY_COUNTS = math.radians(1.0), 0.1, 8
"""First turn, at most and of the way, and the least of it in counts of the position."""
TRY_CURRENTS, TRY_S, LOOK_S = (0.1, 0.3), 0.3, 0.01
"""Currents of the first turns, of the envelope's, how long the shaft is looked at, and how often. A loop whose position
counts the other way took a shaft of 1.6e-4 kg m2 to 2046 rpm and 8 turns at once with 6 A, before its drive tripped."""


UNSEEN = "before the move little current did not turn the shaft: nothing showed that its position counts the right way"
BRAKES_ALONE = (
    "the drive's deceleration (0x6084) can only be read: it brakes by that, or by 0x6083 where it has one ramp for both"
)


def record_move(
    guard: GuardedDrive, drive: PositionDrive, way_rad: float, settle_s: float, times: int = 1,
    find: tuple[float, float] | None = None,
) -> tuple[Trace, MoveProfile | None]:  # fmt: skip
    """Move by an angle and back, each time waiting until the demand has arrived and ``settle_s`` longer; stop.

    Raises DriveTimeout: the demand does not arrive; LimitExceeded: current, speed, travel or following error; the
    voltage is off.

    Parameters
    ----------
    find : tuple of float, optional
        Speed (rad/s) and acceleration (rad/s2) of the moves, for which counts are found first.

    Returns
    -------
    Trace
        ``theta_m_rad``, ``theta_ref_rad`` (from the start), ``i_q_a``; ``meta``: ``way_rad``, ``doubts``:
        what these moves do not rest on, one line each.
    MoveProfile or None
        What was found.
    """
    found = None
    seen = _try_direction(guard, drive, way_rad)
    guard.enable()
    drive.begin_samples()
    try:
        if find is not None:
            found = find_profile(guard, drive, way_rad, *find)
            drive.forget_samples()
        guard.wait(HOLD_S)
        for target in (way_rad, 0.0) * times:
            drive.move_to(target)
            _arrive(guard, drive, target, way_rad)
            guard.wait(settle_s)
    finally:
        try:
            guard.quick_stop()
        finally:
            trace = drive.end_samples()
    alone = [BRAKES_ALONE] if drive.brakes_alone else []
    doubts = [*([] if seen else [UNSEEN]), *alone, *filter(None, [trace.meta["speed_doubt"]])]
    meta = {**trace.meta, "way_rad": way_rad, "doubts": doubts}
    return Trace(trace.t_s, trace.signals, trace.units, meta), found


def _try_direction(guard: GuardedDrive, drive: PositionDrive, way: float) -> bool:
    """Turn the shaft a little with little current, so that one that runs away from its demand does so slowly.

    Returns whether it was seen to turn: not where friction holds it, or where the drive's current limit stays.

    Raises SafetyRefusal: it turns against the demand; the voltage is off.
    """
    clock = drive.node.connection.clock
    least = max(min(TRY_RAD, TRY_SHARE * abs(way)), TRY_COUNTS * drive.rad_per_count)
    turned = 0.0
    for share in TRY_CURRENTS:
        if turned > 0.5 * least or guard.limit_current(share * guard.envelope.i_max_apk) is None:
            break
        guard.enable()
        start = drive.live("theta_m_rad")
        drive.move_to(math.copysign(least, way))
        until = clock.now() + TRY_S
        while clock.now() < until and abs(turned) <= 0.5 * least:
            guard.wait(LOOK_S)
            turned = math.copysign(1.0, way) * (drive.live("theta_m_rad") - start)
        guard.quick_stop()
        if turned < -0.5 * least:
            raise SafetyRefusal(
                f"asked to turn by {math.degrees(math.copysign(least, way)):.3g} deg with {share:.0%} of the current, "
                "the shaft turned the other way",
                where=f"node {drive.node.node}",
                likely="the encoder counts the other way, two motor leads are swapped, or a load turns the shaft",
                hint="the voltage is off; `pmsmtool check` looks at the encoder's sign",
            )
    guard.limit_current(guard.envelope.i_max_apk)
    return turned > 0.5 * least


def _arrive(guard: GuardedDrive, drive: PositionDrive, target: float, way: float) -> None:
    clock = drive.node.connection.clock
    until = clock.now() + LONGEST_S
    while abs(drive.demanded_rad() - target) > ARRIVED * abs(way):
        if clock.now() > until:
            raise DriveTimeout(
                f"the demand is {drive.demanded_rad():.4g} rad after {LONGEST_S:g} s, not {target:.4g} rad",
                where=f"node {drive.node.node}, 0x6062",
                likely=f"a profile that is too slow ({drive.profile()}), a software limit (0x607D), or an interlock of "
                "the drive", hint="give --speed and --acceleration, or ask for a shorter way",
            )  # fmt: skip
        guard.wait(0.02)
        drive.look_at_speed()
