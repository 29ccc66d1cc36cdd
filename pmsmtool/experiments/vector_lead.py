# SPDX-License-Identifier: MIT
"""Lead a current vector onto a rotor that stands anywhere: neither angle nor pole pairs are known yet.

Current that is switched on at some angle lets the rotor fall onto it from up to half an electrical turn away, and with
little friction it swings for seconds: one part in a hundred of the rated torque takes 3 degrees of it per half swing
on 0.35 of the rated current. Current that rises slowly from less than friction holds takes the rotor along instead: it
creeps whenever the torque exceeds friction by a little. The vector turns meanwhile, so that a rotor half a turn off it,
on which no current pulls, does not stay there until the current is large.
"""

from __future__ import annotations

import math

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
