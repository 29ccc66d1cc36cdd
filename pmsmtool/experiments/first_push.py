# SPDX-License-Identifier: MIT
"""The first push of a shaft whose drive commutates by itself: forth and back by a small torque, with its sign."""

from __future__ import annotations

import math

from pmsmtool.drive.port import Drive
from pmsmtool.errors import IdentificationError
from pmsmtool.experiments.shaft_answer import acceleration_per_ampere
from pmsmtool.experiments.signals import table
from pmsmtool.trace import Trace

ANSWER_RAD = 0.02
"""Angle that counts as an answer: an encoder of 1024 increments has three of them."""
WAY_RAD = 0.3
"""Way of a push until it is braked: some electrical angles, of which an open phase has weak ones."""
FASTEST_RAD_S = 10.0
"""A light shaft is pushed by less, to this speed: a third of the speed limit."""
SHORTEST_S, LONGEST_S = 0.02, 0.5
STEP_S = 0.005
"""Time between two looks at the shaft."""
BRAKED = 2.0
"""Longest braking, of the push: a slow current loop reverses late."""
HELD_S = 0.3
"""Slow current loops have settled by then."""
CURRENT_FLOWS = 0.5
"""Current shown, of the one asked for, from which it is the shaft that does not move: with an open phase at an angle
where the shaft stands still 0.07 to 0.38 were seen."""
LEAST_NET = 0.3
"""Of the current, what accelerates at least: friction is known roughly."""


def push_forth_and_back(drive: Drive, i_a: float, speed_rad_s: float, *, link: bool = False) -> Trace:
    """Push with a torque current one way, brake it, and the other way; one row per push.

    Parameters
    ----------
    drive : Drive
        Enabled, at rest, in torque mode; it holds zero current on return.
    i_a : float
        Current (A peak).
    speed_rad_s : float
        Mechanical speed that a push is to stay below.
    link : bool
        Whether the drive shows its DC link.

    Returns
    -------
    Trace
        ``i_command_a``, ``i_q_a`` at the end of the push (A peak), ``way_rad`` until then, ``U_dc_v`` where shown.

    Raises
    ------
    IdentificationError
        ``E_EXCITATION``: the shaft does not answer, and the current flows.
    """
    try:
        answer = acceleration_per_ampere(drive, i_a, _answered)
    except IdentificationError as error:
        if error.reason != "E_EXCITATION":
            raise
        return _held(drive, i_a, error, link)
    fastest = min(FASTEST_RAD_S, speed_rad_s)
    most = answer.friction_a + fastest / (SHORTEST_S * answer.per_ampere)
    i_a = min(i_a, most)
    net = answer.per_ampere * max(i_a - answer.friction_a, LEAST_NET * i_a)
    seconds = min(math.sqrt(2.0 * WAY_RAD / net), fastest / net, LONGEST_S)
    rows = [_pushed(drive, current, seconds, link) for current in (i_a, -i_a)]
    return table(rows, [4.0 * seconds * k for k in range(len(rows))])


def _pushed(drive: Drive, current: float, seconds: float, link: bool) -> dict[str, float]:
    """Push until the time or the way is over, and brake until the shaft turns back; return the end of the push.

    What a short push shows of the acceleration is too little where the current loop is slow.
    """
    before = drive.live("theta_m_rad")
    drive.command_current(0.0, current)
    lasted = way = 0.0
    while lasted < seconds and abs(way) < WAY_RAD:
        drive.wait(STEP_S)
        lasted += STEP_S
        way = drive.live("theta_m_rad") - before
    row = {"i_command_a": current, **_shown(drive, link), "way_rad": way}
    drive.command_current(0.0, -current)
    left, furthest = BRAKED * lasted, abs(way)
    while left > 0.0 and abs(way) >= furthest:
        furthest = abs(way)
        drive.wait(STEP_S)
        left -= STEP_S
        way = drive.live("theta_m_rad") - before
    drive.command_current(0.0, 0.0)
    drive.wait(2.0 * lasted)
    return row


def _shown(drive: Drive, link: bool) -> dict[str, float]:
    return {name: drive.live(name) for name in ("i_q_a", *(("U_dc_v",) if link else ()))}


def _answered(way_rad: float, seconds: float) -> bool:
    if way_rad <= ANSWER_RAD and seconds > LONGEST_S:
        raise IdentificationError(
            "E_EXCITATION", "the shaft does not answer a tenth of the rated current", where="torque pulse",
            likely="brake shut, or the shaft is held; a commutation that is not set up",
            hint="free the shaft; run the maker's own set-up first",
        )  # fmt: skip
    return way_rad > ANSWER_RAD


def _held(drive: Drive, i_a: float, error: IdentificationError, link: bool) -> Trace:
    """Return what is shown of the current where the shaft stands still, or raise: it flows, so the shaft is held."""
    rows = []
    for current in (i_a, -i_a):
        drive.command_current(0.0, current)
        drive.wait(HELD_S)
        rows.append({"i_command_a": current, **_shown(drive, link), "way_rad": 0.0})
    drive.command_current(0.0, 0.0)
    if all(row["i_q_a"] / row["i_command_a"] > CURRENT_FLOWS for row in rows):
        raise IdentificationError(
            error.reason, "the shaft does not move under a torque pulse, and the current flows", where=error.where,
            likely="the encoder does not count (its cable or supply), a locked shaft or a closed brake, or a "
            "commutation that is not set up",
            hint=error.hint,
        ) from error  # fmt: skip
    return table(rows, [HELD_S * k for k in range(len(rows))])
