# SPDX-License-Identifier: MIT
"""Turn a current vector slowly forward and back: the rotor follows while the encoder, or the Hall wires, are read.

Before, the vector is led onto a rotor that stands anywhere, and turns so that the rotor goes with it without a swing.

Current that is switched on at some angle lets the rotor fall onto it from up to half an electrical turn away, and with
little friction it swings for seconds: one part in a hundred of the rated torque takes 3 degrees of it per half swing
on 0.35 of the rated current. Current that rises slowly from less than friction holds takes the rotor along instead: it
creeps whenever the torque exceeds friction by a little. The vector turns meanwhile, so that a rotor half a turn off it,
on which no current pulls, does not stay there until the current is large.

On a current vector a rotor is a mass on a spring, and only friction damps it: of ``Omega``, by which the speed of the
vector jumps, ``Omega / w_swing`` stays as a swing, 40 degrees for many a rotor of large inertia. What comes as a
half sine of acceleration over ``T`` leaves |cos(x)| / |1 - (2 x / pi)^2| of that, x = w_swing T / 2: nothing at one and
a half swings, and never more than 7 % beyond.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pmsmtool.drive.port import Drive
from pmsmtool.errors import IdentificationError
from pmsmtool.experiments.signals import table
from pmsmtool.machine.parameters import MAX_POLE_PAIRS
from pmsmtool.trace import Trace
from pmsmtool.units import RPM_PER_RAD_S

LEAD_S = 3.0
"""Time of the rise. Swing that it leaves of 300 random drives with a friction of 1 % of the rated torque on 0.35 of the
rated current (99 of 100, largest): 16.8 and 28.9 deg after 2 s, 2.7 and 5.9 deg after 3 s."""
LEAD_STEP_S = 0.01
"""Time between two commands: process data and service data of every bus come as fast."""
FIRST_SHARE = 0.014
"""Current at the beginning, of the final one: half of what 1 % of the rated torque as friction holds."""
TURN_RAD = math.radians(120.0)
"""Way of the vector to its angle. After 60 degrees one of 300 rotors still stood on the top."""
TURN_PART = 0.6
"""Part of the rise in which it turns: the rest is the rise on the angle itself."""

RAMP_S = 0.5
"""Time in which the vector comes to speed, of the waits alone: with the bus 0.6 s, two swings of the slowest of 400
random drives (21 rad/s on 0.35 of the test current). Their rotors left the vector by up to 45 deg without it, by 4 to
11 deg with it."""
TURN_S = 0.6
"""Time of a turn from standstill to standstill: as much at 0.15 of the test current, of all but the slowest."""
TURN_DWELL_S = 0.015
SWUNG_RAD = math.pi / 3.0
"""Longest turn by one swing."""
SWING_LOOK_S, LAST_PART = 0.003, 3
"""Time between two looks at a swing (s), and the last part of these that shows its speed: one of so many."""
COUNTS_LEAST = 6.0
"""Steps of the encoder that a rotor turns at least until its speed is looked at."""
SURE = 5.0
"""Standard deviations from which on a speed is one. A parabola's slope at its end, through n looks with noise s, has
s sqrt(192 / n^3)."""
STUCK_S, SWING_MOST_S = 0.12, 2.5
"""A rotor that has not moved by then is held by friction, as the current of the slowest loop has come; and the longest
wait: a load of 26 rotors that needs 100 s to its rated speed has half a swing of 1.9 s."""
LOOK_S = 0.03
LOOKS = 4
"""Looks at the encoder over which a shaft at rest does not move: two alone also find the end of a swing at rest."""
REST_SPAN_RAD = 2e-3
"""Motion of the shaft (mechanical) over these that still is rest: one step of a 12-bit encoder."""
REST_LIMIT_S = 3.0
"""A rotor that has not come to rest by then swings on, by what friction leaves of it for minutes: it is braked."""
BRAKED_SHARE = 0.25
"""Current while it returns, of that while it leaves: every half swing is half of the one before."""
BRAKED_S = 20.0
"""Longest braking (s): ten half swings of a load of 50 times the rotor's inertia on the first current (0.7 Hz)."""
HALF_SWING_LEAST = 3.0
"""Way of a half swing, of what counts as rest and of a step of the encoder: less is no swing."""
STILL_SHARE = 0.75
"""Looks that show rest, of those since the shaft was fastest: a swing of 2 degrees is seen at its turning point."""
SLOW_LOOKS = 4
"""Looks of a half swing from which on it is braked: of a quicker one the looks show too little."""


def rising(steps: int) -> tuple[float, ...]:
    """Return the speed of a vector in the steps of a ramp, of its final one: half a cosine, between 0 and 1."""
    return tuple(0.5 - 0.5 * math.cos(math.pi * (k + 0.5) / steps) for k in range(steps))


def turn_vector(drive: Drive, i_a: float, start_rad: float, end_rad: float, turn_s: float | None = TURN_S) -> float:
    """Turn a current vector along half a cosine, so that the rotor follows instead of jumping; return the time (s).

    A rotor left half an electrical turn off its vector stands on a top: friction holds it there until the current is
    large, and then it falls over with all of it. Without a time the rotor itself says how long a turn takes: it
    swings about the middle of a sixth of a turn, and the vector goes to its end when the rotor turns back there.
    """
    if turn_s is None:
        parts = max(1, math.ceil(abs(end_rad - start_rad) / SWUNG_RAD - 1e-6))
        part, waited = (end_rad - start_rad) / parts, 0.0
        for k in range(parts):
            drive.command_current(i_a, 0.0, fixed_angle_rad=start_rad + (k + 0.5) * part)
            waited += turns_back(drive)
            drive.command_current(i_a, 0.0, fixed_angle_rad=start_rad + (k + 1.0) * part)
        return waited
    steps = round(turn_s / TURN_DWELL_S)
    for k in range(1, steps + 1):
        way = 0.5 - 0.5 * math.cos(math.pi * k / steps)
        drive.command_current(i_a, 0.0, fixed_angle_rad=start_rad + (end_rad - start_rad) * way)
        drive.wait(TURN_DWELL_S)
    return steps * TURN_DWELL_S


def turns_back(drive: Drive, least_rad: float = 0.0) -> float:
    """Wait until a rotor that swings is at its turning point, or stands still; return the time (s).

    A parabola through the last third of the looks shows its speed, and what becomes of it until the current is there:
    differences of a few looks at a slow rotor are steps of its encoder. ``least_rad`` is a way of the shaft that must
    lie behind it, with its sign; 0 where that is not known.
    """
    first = drive.live("theta_m_rad")
    ways, waited, moved, fastest, count = [0.0], 0.0, 0.0, 0.0, math.inf
    while waited < SWING_MOST_S and (moved > REST_SPAN_RAD or waited < STUCK_S):
        drive.wait(SWING_LOOK_S)
        waited += SWING_LOOK_S
        way = math.remainder(drive.live("theta_m_rad") - first, 2.0 * math.pi)
        moved = max(moved, abs(way))
        ways.append(math.copysign(way, way * least_rad) if least_rad else abs(way))
        count = min(count, abs(ways[-1] - ways[-2]) or math.inf)
        last = ways[-max(LOOKS, len(ways) // LAST_PART) :]
        if len(last) < LOOKS or max(ways) <= max(REST_SPAN_RAD, COUNTS_LEAST * count, abs(least_rad)):
            continue
        t = np.arange(1.0 - len(last), 1.0)
        bend, speed, now = np.polyfit(t, last, 2)
        noise = max(float(np.std(np.polyval((bend, speed, now), t) - last)), 0.3 * count)
        if speed > SURE * noise * math.sqrt(192.0 / len(last) ** 3):
            fastest = max(fastest, speed)
        if speed + 2.0 * bend <= 0.0 and speed < 0.5 * fastest:
            break
    return waited


def come_to_rest(drive: Drive, i_a: float, angle_rad: float, *, limit_s: float = REST_LIMIT_S + BRAKED_S) -> float:
    """Wait until the encoder shows a shaft at rest on its vector, or a limit is over; return the time (s).

    One that swings on slowly is braked: on a current vector it is a pendulum on a spring as stiff as the current. From
    a turning point to its largest speed a small current pulls it, from there to the next turning point all of it.
    """
    periods = max(1, round(0.25 * LOOK_S / drive.period_s))
    seen: list[float] = []
    waited, way, fastest, count, slow, small = 0.0, 0.0, 0.0, math.inf, False, False
    fastest_at, shown_at, turned_at = 0, 0, 0
    while waited < limit_s and not _rests(seen, shown_at):
        drive.wait(LOOK_S)
        waited += LOOK_S
        seen.append(drive.average(("theta_m_rad",), periods)["theta_m_rad"])
        before, way = way, seen[-1] - seen[-2] if len(seen) > 1 else 0.0
        turned, count = way * before <= 0.0, min(count, abs(way) or math.inf)
        if turned and abs(seen[-1] - seen[turned_at]) > HALF_SWING_LEAST * max(REST_SPAN_RAD, count):
            slow, shown_at, turned_at = len(seen) - turned_at > SLOW_LOOKS, fastest_at, len(seen) - 1
        if turned or abs(way) > fastest:
            fastest, fastest_at = abs(way), len(seen)
        returns = slow and (turned or (small and len(seen) == fastest_at))
        if waited > REST_LIMIT_S and returns is not small:
            small = returns
            drive.command_current(i_a * (BRAKED_SHARE if small else 1.0), 0.0, fixed_angle_rad=angle_rad)
    if small:
        drive.command_current(i_a, 0.0, fixed_angle_rad=angle_rad)
    return waited


def _rests(seen: Sequence[float], fastest_at: int) -> bool:
    """Return whether the last looks show rest, most of those since the shaft was fastest: a long swing has an end."""
    last = seen[-max(LOOKS, int(STILL_SHARE * (len(seen) - fastest_at))) :]
    return len(seen) >= LOOKS and max(last) - min(last) <= REST_SPAN_RAD


def lead_onto_vector(drive: Drive, i_a: float, angle_rad: float) -> None:
    """Raise a current vector slowly while it turns to an angle; it stands there with all of its current on return.

    Parameters
    ----------
    drive : Drive
        Enabled.
    i_a : float
        Final length of the vector (A peak).
    angle_rad : float
        Final electrical angle (rad).
    """
    steps = round(LEAD_S / LEAD_STEP_S)
    for k in range(1, steps + 1):
        risen = k / steps
        off = TURN_RAD * max(0.0, 1.0 - risen / TURN_PART)
        drive.command_current(i_a * FIRST_SHARE ** (1.0 - risen), 0.0, fixed_angle_rad=angle_rad - off)
        drive.wait(LEAD_STEP_S)


BACK_AT_MOST = 1.15
"""Steps of the way back, of those of the way there: a rotor that lags or sticks at a turning point needs more."""
STEP_RAD = math.radians(15.0)
"""Electrical angle of one step."""
QUICK_STEP_RAD = math.radians(20.0)
QUICK_DWELL_S = 0.008
"""A vector of some 25 rad/s, with the time of a step on the bus. The dead time pulls at the rotor six times a turn of
the vector: 150 rad/s is above the swing of 400 random drives on 0.35 of the test current (21 .. 105 rad/s), and 75 was
in the midst of them. There rotors swung by 14 to 36 degrees in spite of the ramp, beside a large dead time
most; with 150 rad/s by 5 to 14."""
SWING = 2.0
"""Largest speed of a rotor that is led by steps, over the mean one."""
SLOWEST_STEP_S = 0.2
"""Longest time per step: a machine of twenty pole pairs then takes some three minutes for both ways."""
ROW_S = 0.002
"""Time over which the encoder is averaged after every step."""
LEAST_RAMP_STEPS = 4
SLACK_STEPS = 7
"""Steps before a way in which friction, turned round, holds a rotor that swings back now and then."""
LINE_ROWS = 5
"""Rows of a line that shows where a rotor is beside its vector."""
OFF_MOST_RAD = math.radians(30.0)
"""Largest angle of that: more is no swing."""
WAY_LEAST = 0.4
"""Way after which a rotor may turn back, of the expected one: one that swings the other way first is not there yet."""
FASTEST_SWING_RAD_S = 105.0
"""Of 400 random drives on 0.35 of the test current: a rotor that swings a step is fastest halfway, by half of it."""
SWINGS_MOST_S = 100.0
"""Longest way of a rotor that swings from step to step: a turn of eight pole pairs with two seconds per half swing."""
BACK_LEAST_S = 0.3
"""Shortest turn back to a whole electrical turn; the usual time is that of half a turn."""


@dataclass(frozen=True, slots=True)
class RotationPlan:
    """How the vector is turned."""

    i_a: float
    """Length of the vector (A peak)."""
    step_rad: float = STEP_RAD
    """Electrical angle of one step."""
    dwell_s: float | None = 0.015
    """Time per step (s); without one the rotor swings from step to step (:func:`turn_vector`)."""
    turns_mechanical: float = 1.02
    """Mechanical turns in each direction."""
    ramp_s: float = RAMP_S
    """Time in which the vector comes to its speed, and to rest again (s)."""

    @property
    def ramp(self) -> tuple[float, ...]:
        """Return the steps of the ramp, of a whole step; none is larger, so the shaft keeps to its speed limit."""
        if self.dwell_s is None:
            return (1.0,) * SLACK_STEPS
        return rising(max(LEAST_RAMP_STEPS, round(self.ramp_s / (self.dwell_s + ROW_S))))


def dwell_within(dwell_s: float, omega_max_rad_s: float) -> float:
    """Return a time per step (s) at which the shaft keeps to a speed limit, however few pole pairs it has.

    Raises IdentificationError: ``E_EXCITATION``: the limit is too low for a turn in reasonable time.

    Parameters
    ----------
    dwell_s : float
        Time per step where the limit allows it (s).
    omega_max_rad_s : float
        Largest mechanical speed (rad/s). The pole pairs are what is to be found: one is assumed.
    """
    least_s = SWING * STEP_RAD / omega_max_rad_s
    if least_s > SLOWEST_STEP_S:
        rpm = RPM_PER_RAD_S
        raise IdentificationError(
            "E_EXCITATION",
            f"the slow turn of the shaft needs a speed limit of {rpm * SWING * STEP_RAD / SLOWEST_STEP_S:.3g} rpm, "
            f"{rpm * omega_max_rad_s:.3g} are allowed",
            where="slow turn",
            likely="pole pairs are not known before it: a machine of one must keep to the limit, too",
            hint=f"allow at least --speed-max {math.ceil(rpm * SWING * STEP_RAD / SLOWEST_STEP_S)}rpm",
        )
    return max(dwell_s, least_s)


def step_within(step_rad: float, dwell_s: float | None, omega_max_rad_s: float) -> tuple[float, float | None]:
    """Return angle (rad electrical) and time (s) of a step that keep the shaft to a speed limit.

    A limit shortens the step, to half of ``STEP_RAD`` at the least, and then makes it longer in time
    (:func:`dwell_within`); one that the rotor swings, as far as the limit asks.

    Raises IdentificationError: ``E_EXCITATION``, as there.
    """
    if dwell_s is None:
        return min(step_rad, 2.0 * omega_max_rad_s / FASTEST_SWING_RAD_S), None
    shorter = min(step_rad, omega_max_rad_s * (dwell_s + ROW_S) / SWING)
    if shorter >= min(step_rad, 0.5 * STEP_RAD):
        return shorter, dwell_s
    return STEP_RAD, dwell_within(dwell_s, omega_max_rad_s)


def rotate_vector(drive: Drive, plan: RotationPlan, *, start_rad: float = 0.0) -> tuple[Trace, Trace]:
    """Turn the vector until the shaft has made its turns, then back; return the two runs.

    The drive is enabled on entry. On return the current is zero, and the rotor rests where the vector stood last: at a
    whole electrical turn, from where the next one takes it without a jump.

    Parameters
    ----------
    start_rad : float
        Electrical angle of the vector that was held last: the rotor is near it.

    Returns
    -------
    forward, backward : Trace
        ``theta_imposed_rad`` (electrical, unwrapped) and ``theta_M_rad`` (mechanical, unwrapped), one row per step.
    """
    drive.command_current(plan.i_a, 0.0, fixed_angle_rad=start_rad)
    come_to_rest(drive, plan.i_a, start_rad)
    angle, forward = _run(drive, plan, start_rad, plan.step_rad, None)
    come_to_rest(drive, plan.i_a, angle)
    angle, backward = _run(drive, plan, angle, -plan.step_rad, len(forward))
    whole = 2.0 * math.pi * round(angle / (2.0 * math.pi))
    back_s = max(BACK_LEAST_S, TURN_S * abs(whole - angle) / math.pi)
    turn_vector(drive, plan.i_a, angle, whole, None if plan.dwell_s is None else back_s)
    come_to_rest(drive, plan.i_a, whole)
    drive.command_current(0.0, 0.0, fixed_angle_rad=whole)
    return forward, backward


def _run(drive: Drive, plan: RotationPlan, angle: float, step: float, count: int | None) -> tuple[float, Trace]:
    """Turn in one direction: a ramp that brings the rotor to speed, the turns, ``count`` steps at least, a ramp."""
    seen = [_row(drive, angle)]
    for share in plan.ramp:
        angle += share * step
        seen.append(_step(drive, plan, angle, share * step, seen)[0])
    rows, times = [_row(drive, angle)], [0.0]
    limit = round(2.0 * math.pi * MAX_POLE_PAIRS * plan.turns_mechanical / plan.step_rad)
    if count is not None:
        limit = min(limit, round(BACK_AT_MOST * count))
    while len(rows) < limit:
        angle += step
        row, waited = _step(drive, plan, angle, step, seen + rows)
        rows.append(row)
        times.append(times[-1] + waited)
        way = abs(rows[-1]["theta_M_rad"] - rows[0]["theta_M_rad"])
        if way >= 2.0 * math.pi * plan.turns_mechanical and len(rows) >= (count or 0):
            break
        if plan.dwell_s is None and times[-1] > SWINGS_MOST_S:
            break
    for share in reversed(plan.ramp):
        angle += share * step
        _step(drive, plan, angle, share * step, seen + rows)
    return angle, table(rows, times, i_command_a=plan.i_a)


def _step(
    drive: Drive, plan: RotationPlan, angle: float, way: float, seen: Sequence[Mapping[str, float]]
) -> tuple[dict[str, float], float]:
    """Turn the vector by a way to an angle; return what is seen there, and the time (s).

    Without a time the rotor swings about the middle of its own way, from where it stands beside its vector.
    """
    waited = plan.dwell_s
    if waited is None:
        off, turned = _followed(seen)
        drive.command_current(plan.i_a, 0.0, fixed_angle_rad=angle - 0.5 * (way - off))
        waited = turns_back(drive, WAY_LEAST * turned * (way - off))
    drive.command_current(plan.i_a, 0.0, fixed_angle_rad=angle)
    if plan.dwell_s is not None:
        drive.wait(waited)
    return _row(drive, angle), waited


def _followed(rows: Sequence[Mapping[str, float]]) -> tuple[float, float]:
    """Return how far a rotor stands off its vector (rad electrical), and its way (mechanical) of the vector's.

    By a line through the rows so far. A swing that a step leaves is in all later ones, and cogging makes it grow: a
    load of 8 rotors was 37 degrees off after a turn and half a turn back, with the swing taken out up to 10.
    """
    imposed, theta = (np.array([row[name] for row in rows]) for name in ("theta_imposed_rad", "theta_M_rad"))
    if np.ptp(theta) < REST_SPAN_RAD:
        return 0.0, 0.0
    slope, start = np.polyfit(theta, imposed, 1)
    off = slope * theta[-1] + start - imposed[-1] if len(rows) >= LINE_ROWS else 0.0
    return float(np.clip(off, -OFF_MOST_RAD, OFF_MOST_RAD)), float(1.0 / slope)


def _row(drive: Drive, angle: float) -> dict[str, float]:
    measured = drive.average(("theta_m_rad",), max(1, round(ROW_S / drive.period_s)))
    return {"theta_imposed_rad": angle, "theta_M_rad": measured["theta_m_rad"]}


HALL_STEP_RAD = math.radians(2.0)
HALL_DWELL_S = 0.04
"""Steps of the vector, and time on each: with the window below 44 degrees per second."""
HALL_LOOK_S = 0.005
"""The current is averaged at the end of a step: where a phase current changes its sign, the inverter's dead time takes
the vector up to 9 degrees off what is commanded, and the rotor goes with it."""
WAY_RAD = math.radians(460.0)
"""One way: the turn that is evaluated, behind the way that takes up the friction."""
RAMP_STEPS = 20
RAMP_SLOWEST = 0.1
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
    steps = round(WAY_RAD / HALL_STEP_RAD)
    lead_onto_vector(drive, i_a, 0.0)
    ramp = [max(RAMP_SLOWEST, share) for share in rising(RAMP_STEPS)]
    periods = max(1, round(HALL_LOOK_S / drive.period_s))
    rows: list[tuple[float, float, float, float]] = []
    t_s = 0.0
    for k in (*range(1, steps + 1), *range(steps - 1, -1, -1)):
        gone, commanded = len(rows) % steps, HALL_STEP_RAD * k
        drive.command_current(i_a, 0.0, fixed_angle_rad=commanded)
        dwell = HALL_DWELL_S / (ramp[gone] if gone < RAMP_STEPS else 1.0)
        drive.wait(dwell)
        seen = drive.average(("i_d_a", "i_q_a"), periods)
        off = math.atan2(seen["i_q_a"], seen["i_d_a"])
        t_s += dwell + HALL_LOOK_S
        rows.append((t_s, commanded, commanded + off, drive.live("hall_pattern")))
    table = np.array(rows)
    units = {"commanded_rad": "rad", "angle_rad": "rad", "hall_pattern": "1"}
    return Trace(table[:, 0], dict(zip(units, table[:, 1:].T, strict=True)), units, {"i_a": i_a})
