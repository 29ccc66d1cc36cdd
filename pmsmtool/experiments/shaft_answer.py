# SPDX-License-Identifier: MIT
"""How fast the shaft answers a torque current: short pushes forth and back that grow until it moves."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from pmsmtool.drive.port import Drive
from pmsmtool.errors import IdentificationError

FIRST_SHARE, FIRST_S = 0.05, 0.02
"""Largest current of a first push, of the test current, and its length (s): the inertia is not known before it."""
GROWTH, LONGER = 1.25, 1.6
"""From push to push: of the current, and of the length once the current is at its end. What one push did not move,
the next one brings to little, whatever friction took."""
BELOW = 9
"""Growths below the largest first push at which the first one begins: 0.7 % of the test current."""
MOST_TRIES = 29
SURELY, LESS = 0.25, 0.8
"""Of a way, what answers surely: the second push is then this share of the first, else it is larger."""
BRAKING_STEP_S, LEAST_BRAKING_S = 0.0024, 0.4
BRAKING = 1.5
"""Longest braking, of the time that the current needs by what the shaft answered."""
OVER_FRICTION = 1.3
"""Of the current that friction takes, what surely moves the shaft. Short pushes show too much of it: in their time an
inverter's dead time holds a small current back."""


@dataclass(frozen=True, slots=True)
class ShaftAnswer:
    """What a shaft does with a torque current.

    Attributes
    ----------
    per_ampere : float
        Mechanical acceleration per current beyond friction (rad/s2/A).
    friction_a : float
        Current that friction takes (A peak).
    direction : int
        -1 where the position falls under a positive torque current, else 1.
    """

    per_ampere: float
    friction_a: float = 0.0
    direction: int = 1

    def most_a(self, gain_rad_s: float, seconds: float) -> float:
        """Return the current (A peak) that adds at most a speed (rad/s) in a time (s), or just overcomes friction."""
        return max(gain_rad_s / (self.per_ampere * seconds), OVER_FRICTION * self.friction_a)


def acceleration_per_ampere(drive: Drive, i_test_a: float, answered: Callable[[float, float], bool]) -> ShaftAnswer:
    """Return acceleration and friction from two pushes of different currents.

    Raises IdentificationError: ``E_EXCITATION``: the shaft does not answer.

    Parameters
    ----------
    drive : Drive
        Enabled, at rest, in torque mode.
    i_test_a : float
        Largest torque current (A peak).
    answered : callable
        Whether an angle (rad) turned in a time (s) counts as an answer.
    """
    current, seconds = FIRST_SHARE * i_test_a / GROWTH**BELOW, FIRST_S
    for _ in range(MOST_TRIES):
        turned = _pushed(drive, current, seconds)
        way = abs(turned)
        if answered(way, seconds):
            # another current on the same shaft: what friction takes of both is the same
            second = min(GROWTH, i_test_a / current) * current
            if second <= 1.1 * current or answered(SURELY * way, seconds):
                second = LESS * current
            other = abs(_pushed(drive, second, seconds))
            if second < current and not answered(SURELY * other, seconds):  # friction holds it
                second = min(GROWTH * current, i_test_a)
                other = abs(_pushed(drive, second, seconds))
            slope = (other - way) / (second - current)
            slope = max(slope, way / current)  # friction takes some of it, or nothing
            friction = current - way / slope
            return ShaftAnswer(2.0 * slope / (seconds * seconds), max(0.0, friction), 1 if turned > 0.0 else -1)
        if GROWTH * current <= i_test_a:
            current *= GROWTH
        else:
            seconds *= LONGER
    raise IdentificationError(
        "E_EXCITATION",
        "the shaft does not move under a torque pulse",
        where="torque pulse",
        likely="a locked shaft or a closed brake, an encoder that does not count, a motor lead that is not connected, "
        "or a drive whose commutation is not set up",
        hint="free the shaft, run the maker's own set-up first; `pmsmtool check` looks at the wiring",
    )


def _pushed(drive: Drive, current_a: float, seconds: float) -> float:
    """Push forth and back, let the shaft come to rest, and return the angle (rad) of the way forth, with its sign."""
    before = drive.live("theta_m_rad")
    drive.command_current(0.0, current_a)
    drive.wait(seconds)
    way = drive.live("theta_m_rad") - before
    drive.command_current(0.0, -current_a)
    drive.wait(seconds)
    drive.command_current(0.0, 0.0)
    drive.wait(2.0 * seconds)  # friction braked forth and back: what it left takes as long again
    return way


def brake_shaft(drive: Drive, most_a: float, answer: ShaftAnswer) -> None:
    """Bring the shaft to about rest by torque currents up to one (A peak) against its own sense of turning.

    It takes at most :data:`BRAKING` times what that current needs without friction.
    """
    before, spent, patience_s = drive.live("theta_m_rad"), 0.0, LEAST_BRAKING_S
    drive.wait(BRAKING_STEP_S)
    while spent < patience_s:
        angle = drive.live("theta_m_rad")
        speed = answer.direction * (angle - before) / BRAKING_STEP_S
        before = angle
        push = min(most_a, abs(speed) / (answer.per_ampere * BRAKING_STEP_S))
        if push < 0.1 * most_a:
            break
        if spent == 0.0:
            patience_s = max(patience_s, BRAKING * abs(speed) / (answer.per_ampere * most_a))
        drive.command_current(0.0, -math.copysign(push, speed))
        drive.wait(BRAKING_STEP_S)
        spent += BRAKING_STEP_S
    drive.command_current(0.0, 0.0)
