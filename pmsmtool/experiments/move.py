# SPDX-License-Identifier: MIT
"""One move there and back by the drive's own position loop: what it demands, where the shaft is, and the current.

What a count of 0x6081 and 0x6083 is worth most makers leave to their manuals: without a unit in the map it is found by
the demand. The demand (0x6062) has the unit of the position. From the smallest count of speed upwards, short looks show
what a count of speed is worth; whole moves at a part of the speed that is asked for then show the acceleration. All of
them stay within the way of the move.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.axis.move import mirrored, trapezoid_of
from pmsmtool.drive.guard import GuardedDrive
from pmsmtool.drive.position_drive import LARGEST, PositionDrive
from pmsmtool.errors import DriveTimeout, NotAvailable, SafetyRefusal
from pmsmtool.trace import Trace

GROWTH = 8.0
"""Counts are raised by no more than this between two looks: what was not seen stays below what is asked for."""
DEMAND_LOOK_S, WINDOW_S, WINDOW_COUNTS = 0.15, 0.03, 4.0
"""A look at the demand, and the window of a speed in it; fewer counts of the position are no speed."""
TRIAL_SHARE = 0.25
"""Speed of the trial moves, of the one asked for, more where their ramp would not be seen; half of sqrt(way x
acceleration) at most: it is even then."""
FLAT = 0.1
"""Change of the demanded speed between two windows that is none (relative)."""
LOOKS, MOVES = 60, 10
SPEED_WITHIN, RAMP_WITHIN = 0.03, 0.08
"""What is asked for is reached within this (relative)."""
SHORTEST_RAMP_S, SEEN_RAMP_S = 4e-3, 12e-3
"""Ramps that are shorter are not seen in samples of a millisecond; one that is seen within ``RAMP_WITHIN``."""
FURTHEST = 64.0
"""Ramps are changed by no more than this between two moves."""
REST_S, RESTS = 0.1, 10
DEMAND_ARRIVED, NEAR, ENOUGH_WAY = 0.02, 0.1, 0.5
"""Where a demand has arrived, where a shaft has followed, and where a look would end before its speed is seen: from the
end of the move, of its way."""


@dataclass(frozen=True, slots=True)
class MoveProfile:
    """A drive's own profile as its demand showed it: speed (rad/s), acceleration (rad/s2), and the counts it holds."""

    speed_rad_s: float
    acceleration_rad_s2: float
    speed_counts: int
    ramp_counts: int

    def __str__(self) -> str:
        return (
            f"{self.speed_counts} counts of 0x6081 for {self.speed_rad_s:.4g} rad/s, {self.ramp_counts} of 0x6083 for "
            f"{self.acceleration_rad_s2:.4g} rad/s2, by the demand"
        )


def find_profile(
    guard: GuardedDrive, drive: PositionDrive, way_rad: float, speed_rad_s: float, acceleration_rad_s2: float
) -> MoveProfile:
    """Leave counts in the drive with which it moves as is asked for, and return what they are worth.

    The drive is enabled and sends its demand; the shaft moves between where it stands and ``way_rad``, at a quarter of
    the speed, or faster where its ramp would not be seen, and rests where it began. The guard brings the old counts
    back.

    Raises NotAvailable: the demand does not follow the counts, or the drive refuses them; DriveTimeout: a move does not
    end.
    """
    slow = min(speed_rad_s, max(TRIAL_SHARE * speed_rad_s, SEEN_RAMP_S * acceleration_rad_s2))
    slow = min(slow, 0.5 * math.sqrt(abs(way_rad) * acceleration_rad_s2))
    slow = min(slow, acceleration_rad_s2 * DEMAND_LOOK_S / 3.0)  # even at the end of a look
    trial = _Trial(guard, drive, way_rad, acceleration_rad_s2)
    trial.find_speed(slow)
    speed, acceleration = trial.find_ramp(slow)
    trial.go(0.0)
    per_count = speed / trial.speed  # of few counts the nearest may be a tenth off the speed that was aimed at
    trial.speed = speed_rad_s / per_count
    trial.lend()
    return MoveProfile(per_count * trial.speed, acceleration, round(trial.speed), round(trial.ramp))


class _Trial:
    """Counts of speed and ramp that are tried, and the moves that try them."""

    def __init__(self, guard: GuardedDrive, drive: PositionDrive, way: float, acceleration: float) -> None:
        self._guard, self._drive, self._way, self._acceleration = guard, drive, way, acceleration
        self._target = 0.0
        self._resolution = WINDOW_COUNTS * drive.rad_per_count / WINDOW_S
        self.speed = 1.0
        self.ramp = max(1.0, drive.ramp_counts())

    def lend(self) -> None:
        """Write the counts."""
        self.speed, self.ramp = (float(min(LARGEST, max(1, round(n)))) for n in (self.speed, self.ramp))
        self._drive.lend_profile(round(self.speed), round(self.ramp))

    # ---- what a count of speed is worth ---------------------------------------------------------

    def find_speed(self, aim: float) -> None:
        """Raise both until the demand moves evenly at a speed (rad/s), or as near as a count comes to it."""
        tried = set()
        for _ in range(LOOKS):
            seen, even, rise = self._look()
            if seen < self._resolution:
                if self.speed * GROWTH > LARGEST:  # a ramp that takes minutes hides every speed
                    self.speed, self.ramp = 1.0, self.ramp * GROWTH**3
                else:
                    self.speed *= GROWTH
                continue
            if not even:
                if seen > aim:
                    self.speed /= GROWTH
                else:
                    self.ramp *= min(GROWTH, max(1.2, self._acceleration / max(rise, 1e-9)))
                continue
            wanted = max(1.0, round(self.speed * min(GROWTH, max(1.0 / GROWTH, aim / seen))))
            if abs(wanted / self.speed - 1.0) < FLAT or wanted in tried:  # no count between two neighbours
                return
            tried.add(self.speed)
            self.speed = wanted
        raise self._lost("its speed does not follow 0x6081")

    def _look(self) -> tuple[float, bool, float]:
        """Move for a short while; return the largest speed, whether it was even, and how fast it rose."""
        if abs(self._drive.demanded_rad() - self._target) < ENOUGH_WAY * abs(self._way):
            self._rest()
        if abs(self._drive.demanded_rad() - self._target) < DEMAND_ARRIVED * abs(self._way):
            self._target = self._way - self._target
        self.lend()
        began = self._drive.samples
        self._drive.move_to(self._target, at_once=True)
        self._guard.wait(DEMAND_LOOK_S)
        t, demand = self._drive.demand_since(began)
        edges = np.arange(t[-1], t[0], -WINDOW_S)[::-1]
        if edges.size < 3:
            raise self._lost("the drive shows too few samples")
        speeds: Array = np.abs(np.diff(np.interp(edges, t, demand))) / WINDOW_S
        peak, last = float(speeds.max()), float(speeds[-1])
        arrived = abs(float(demand[-1]) - self._target) < DEMAND_ARRIVED * abs(self._way)
        even = arrived or abs(last - float(speeds[-2])) <= FLAT * peak + self._resolution / WINDOW_COUNTS
        return peak, even, (last - float(speeds[-2])) / WINDOW_S

    # ---- what a count of the ramp is worth ------------------------------------------------------

    def find_ramp(self, aim: float) -> tuple[float, float]:
        """Move there and back until speed and acceleration are those asked for; return both by the demand."""
        self.go(0.0)
        end, best = self._way, (0.0, 0.0)
        for _ in range(MOVES):
            t, demand = self.go(end)
            speed, ramp_s = trapezoid_of(*(mirrored(t, demand) if self._drive.brakes_alone else (t, demand)))
            end = self._way - end
            wanted_s = aim / self._acceleration
            best = (speed, speed / max(ramp_s, SHORTEST_RAMP_S))
            slower = max(ramp_s, SHORTEST_RAMP_S) / (wanted_s * speed / aim)
            if ramp_s < 0.5 * SEEN_RAMP_S and slower < 1.0:  # hardly seen: it may be shorter by any factor
                slower = min(slower, 1.0 / GROWTH)
            before = (self.speed, self.ramp)
            if abs(speed / aim - 1.0) > SPEED_WITHIN:
                self.speed *= aim / speed
            if abs(slower - 1.0) > RAMP_WITHIN and (ramp_s >= SHORTEST_RAMP_S or slower < 1.0):
                self.ramp *= min(FURTHEST, max(1.0 / FURTHEST, slower))
            self.lend()
            if before == (self.speed, self.ramp):  # reached, or no count is nearer
                return best
        raise self._lost("its acceleration does not follow 0x6083")

    def go(self, end: float) -> tuple[Array, Array]:
        """Move to an angle, wait until the demand rests there; return times and demands."""
        began, until = self._drive.samples, self._drive.node.connection.clock.now() + LONGEST_S
        self._drive.move_to(end, at_once=True)
        self._target = end
        while abs(self._drive.demanded_rad() - end) > 1.5 * self._drive.rad_per_count:
            if self._drive.node.connection.clock.now() > until:
                raise DriveTimeout(
                    f"the demand does not come to {end:.4g} rad within {LONGEST_S:g} s", where=self._where,
                    likely="a software limit (0x607D), or an interlock of the drive", hint="ask for a shorter way",
                )  # fmt: skip
            self._guard.wait(0.02)
        self._rest()
        return self._drive.demand_since(began)

    def _rest(self) -> None:
        """Wait until demand and shaft are there: a demand that turns round before takes the lag for a fault."""
        for _ in range(RESTS):
            self._guard.wait(REST_S)
            left = abs(self._drive.demanded_rad() - self._target)
            if max(left, abs(self._drive.lag_rad())) < NEAR * abs(self._way):
                return

    @property
    def _where(self) -> str:
        return f"node {self._drive.node.node}, 0x6062"

    def _lost(self, what: str) -> NotAvailable:
        return NotAvailable(
            f"no counts of the drive's own profile move as is asked for: {what}", where=self._where,
            likely="limits of the drive's own (0x607F, 0x60C5), or a profile that is no trapezoid (0x6086)",
            hint="leave --design, --speed and --acceleration out: the drive then moves as it is set up",
        )  # fmt: skip


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
