# SPDX-License-Identifier: MIT
"""Lead a current vector onto a rotor that stands anywhere, and turn it so that the rotor goes with it without a swing.

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
from collections import deque

from pmsmtool.drive.port import Drive

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
SLOW_LOOKS = 4
"""Looks of a half swing from which on it is braked: of a quicker one the looks show too little."""


def rising(steps: int) -> tuple[float, ...]:
    """Return the speed of a vector in the steps of a ramp, of its final one: half a cosine, between 0 and 1."""
    return tuple(0.5 - 0.5 * math.cos(math.pi * (k + 0.5) / steps) for k in range(steps))


def turn_vector(drive: Drive, i_a: float, start_rad: float, end_rad: float, turn_s: float = TURN_S) -> float:
    """Turn a current vector along half a cosine, so that the rotor follows instead of jumping; return the time (s).

    A rotor left half an electrical turn off its vector stands on a top: friction holds it there until the current is
    large, and then it falls over with all of it.
    """
    steps = round(turn_s / TURN_DWELL_S)
    for k in range(1, steps + 1):
        way = 0.5 - 0.5 * math.cos(math.pi * k / steps)
        drive.command_current(i_a, 0.0, fixed_angle_rad=start_rad + (end_rad - start_rad) * way)
        drive.wait(TURN_DWELL_S)
    return steps * TURN_DWELL_S


def come_to_rest(drive: Drive, i_a: float, angle_rad: float, *, limit_s: float = REST_LIMIT_S + BRAKED_S) -> float:
    """Wait until the encoder shows a shaft at rest on its vector, or a limit is over; return the time (s).

    One that swings on slowly is braked: on a current vector it is a pendulum on a spring as stiff as the current. From
    a turning point to its largest speed a small current pulls it, from there to the next turning point all of it.
    """
    periods = max(1, round(0.25 * LOOK_S / drive.period_s))
    seen: deque[float] = deque(maxlen=LOOKS)
    waited, way, fastest, looks, slow, small = 0.0, 0.0, 0.0, 0, False, False
    while waited < limit_s and (len(seen) < (seen.maxlen or LOOKS) or max(seen) - min(seen) > REST_SPAN_RAD):
        drive.wait(LOOK_S)
        waited += LOOK_S
        seen.append(drive.average(("theta_m_rad",), periods)["theta_m_rad"])
        before, way = way, seen[-1] - seen[-2] if len(seen) > 1 else 0.0
        turned = way * before <= 0.0
        if turned and waited > REST_LIMIT_S:  # the end of a long swing looks like rest
            seen = deque(seen, max(LOOKS, looks))
        fastest, looks, slow = (
            (abs(way), 0, looks >= SLOW_LOOKS) if turned else (max(fastest, abs(way)), looks + 1, slow)
        )
        returns = slow and (turned or (small and abs(way) >= fastest))
        if waited > REST_LIMIT_S and returns is not small:
            small = returns
            drive.command_current(i_a * (BRAKED_SHARE if small else 1.0), 0.0, fixed_angle_rad=angle_rad)
    if small:
        drive.command_current(i_a, 0.0, fixed_angle_rad=angle_rad)
    return waited


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
