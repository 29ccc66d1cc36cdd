# SPDX-License-Identifier: MIT
"""How fast the shaft answers a torque current: short pushes forth and back that grow until it moves."""

from __future__ import annotations

from collections.abc import Callable

from pmsmtool.drive.port import Drive
from pmsmtool.errors import IdentificationError

FIRST_SHARE, FIRST_S = 0.05, 0.02
"""Current of the first push, of the test current, and its length (s): the inertia is not known before it."""
MOST_TRIES = 11


def acceleration_per_ampere(drive: Drive, i_test_a: float, answered: Callable[[float, float], bool]) -> float:
    """Return the mechanical acceleration per torque current (rad/s2/A).

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
    current, seconds = FIRST_SHARE * i_test_a, FIRST_S
    for _ in range(MOST_TRIES):
        before = drive.live("theta_m_rad")
        drive.command_current(0.0, current)
        drive.wait(seconds)
        way = abs(drive.live("theta_m_rad") - before)
        drive.command_current(0.0, -current)
        drive.wait(seconds)
        drive.command_current(0.0, 0.0)
        if answered(way, seconds):
            return 2.0 * way / (seconds * seconds * current)
        if current < 0.5 * i_test_a:
            current *= 2.0
        else:
            seconds *= 1.6
    raise IdentificationError(
        "E_EXCITATION",
        "the shaft does not answer a torque push",
        where="torque push",
        likely="a locked shaft or a closed brake, or a drive whose commutation is not set up",
        hint="free the shaft; run the maker's own set-up first",
    )
