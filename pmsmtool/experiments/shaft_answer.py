# SPDX-License-Identifier: MIT
"""How fast the shaft answers a torque current: short pushes forth and back that grow until it moves."""

from __future__ import annotations

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
    """

    per_ampere: float
    friction_a: float = 0.0

    def most_a(self, gain_rad_s: float, seconds: float) -> float:
        """Return the current (A peak) that adds at most a speed (rad/s) in a time (s), or just overcomes friction."""
        return max(gain_rad_s / (self.per_ampere * seconds), OVER_FRICTION * self.friction_a)


def acceleration_per_ampere(drive: Drive, i_test_a: float, answered: Callable[[float, float], bool]) -> ShaftAnswer:
    """Return acceleration and friction from two pushes of different currents.

    Parameters
    ----------
    drive : Drive
        Enabled, at rest, in torque mode.
    i_test_a : float
        Largest torque current (A peak).
    answered : callable
        Whether an angle (rad) turned in a time (s) counts as an answer.

    Raises
    ------
    IdentificationError
        ``E_EXCITATION``: the shaft does not answer.
    """
    current, seconds = FIRST_SHARE * i_test_a / GROWTH**BELOW, FIRST_S
    for _ in range(MOST_TRIES):
        way = _pushed(drive, current, seconds)
        if answered(way, seconds):
            # another current on the same shaft: what friction takes of both is the same
            second = min(GROWTH, i_test_a / current) * current
            if second <= 1.1 * current or answered(SURELY * way, seconds):
                second = LESS * current
            other = _pushed(drive, second, seconds)
            if second < current and not answered(SURELY * other, seconds):  # friction holds it
                second = min(GROWTH * current, i_test_a)
                other = _pushed(drive, second, seconds)
            slope = (other - way) / (second - current)
            slope = max(slope, way / current)  # friction takes some of it, or nothing
            friction = current - way / slope
            return ShaftAnswer(2.0 * slope / (seconds * seconds), max(0.0, friction))
        if GROWTH * current <= i_test_a:
            current *= GROWTH
        else:
            seconds *= LONGER
    raise IdentificationError(
        "E_EXCITATION",
        "the shaft does not move under a torque pulse",
        where="torque pulse",
        likely="a locked shaft or a closed brake, a motor lead that is not connected, or a drive whose commutation is "
        "not set up",
        hint="free the shaft, run the maker's own set-up first; `pmsmtool check` looks at the wiring",
    )


def _pushed(drive: Drive, current_a: float, seconds: float) -> float:
    """Push forth and back, let the shaft come to rest, and return the angle (rad) of the way forth."""
    before = drive.live("theta_m_rad")
    drive.command_current(0.0, current_a)
    drive.wait(seconds)
    way = abs(drive.live("theta_m_rad") - before)
    drive.command_current(0.0, -current_a)
    drive.wait(seconds)
    drive.command_current(0.0, 0.0)
    drive.wait(2.0 * seconds)  # friction braked forth and back: what it left takes as long again
    return way
