# SPDX-License-Identifier: MIT
"""The first turn of a shaft nobody has seen turn yet: a small vector leads it half a turn at the most, and back."""

from __future__ import annotations

import math

from pmsmtool.drive.port import Drive
from pmsmtool.errors import IdentificationError
from pmsmtool.experiments.mechanics_run import acceleration_per_ampere
from pmsmtool.experiments.rotation import REST_LIMIT_S, ROW_S, come_to_rest, turn_vector
from pmsmtool.experiments.signals import table
from pmsmtool.trace import Trace

WAY_S = 2.5
"""Time of one way, if its steps can be sent in it: a slow vector leads a rotor that swings at 6 rad/s, too."""
STEP_RAD = math.radians(20.0)
"""Largest electrical angle of one step, in the midst of a way."""
STEPS = 48
LEAST_DWELL_S = 0.004
"""Fewest steps of a way, and least time for one: 32 pole pairs take 3.5 s."""
HALF_TURN_RAD = math.pi
MARGIN = 0.9
"""Of half a turn, for the swing at its end."""

SIGNALS = ("theta_m_rad", "U_dc_v")
HALL = "hall_pattern"
"""Levels of the Hall wires: read once a step, as their mean says nothing."""

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


def lead_half_a_turn(
    drive: Drive, i_a: float, pole_pairs: int, start_rad: float, *, signals: tuple[str, ...] = SIGNALS
) -> Trace:
    """Lead the rotor forward and back and return both ways, one row per step.

    The way ends at half a turn by the pole pairs that are stated, or by the encoder, whichever comes first: one of them
    may be wrong.

    Parameters
    ----------
    drive : Drive
        Enabled; it holds zero current on return.
    i_a : float
        Length of the vector (A peak).
    pole_pairs : int
        As stated.
    start_rad : float
        Electrical angle of the vector that was held last.
    signals : tuple of str
        What the drive shows of :data:`SIGNALS`, of ``i_q_a``, and of :data:`HALL`.

    Returns
    -------
    Trace
        ``theta_imposed_rad`` (electrical, unwrapped), ``theta_M_rad`` (mechanical), what else is shown;
        ``at_rest`` 1 in the three rows before, between and after the two ways.
    """
    turn_vector(drive, i_a, start_rad, 0.0)
    come_to_rest(drive, i_a, 0.0, limit_s=REST_LIMIT_S)
    rows = [_row(drive, 0.0, signals, at_rest=True)]
    way_rad = pole_pairs * MARGIN * HALF_TURN_RAD
    steps = max(STEPS, math.ceil(2.0 * way_rad / STEP_RAD))
    dwell_s = max(LEAST_DWELL_S, WAY_S / steps - ROW_S)
    for angle in _smooth(way_rad, steps):
        rows.append(_led(drive, i_a, angle, dwell_s, signals))
        if abs(rows[-1]["theta_M_rad"] - rows[0]["theta_M_rad"]) >= MARGIN * HALF_TURN_RAD:
            break
    end = rows[-1]["theta_imposed_rad"]
    come_to_rest(drive, i_a, end, limit_s=REST_LIMIT_S)
    rows.append(_row(drive, end, signals, at_rest=True))
    rows += [_led(drive, i_a, end - angle, dwell_s, signals) for angle in _smooth(end, steps)]
    come_to_rest(drive, i_a, 0.0, limit_s=REST_LIMIT_S)
    rows.append(_row(drive, 0.0, signals, at_rest=True))
    drive.command_current(0.0, 0.0, fixed_angle_rad=0.0)
    return table(rows, [k * (dwell_s + ROW_S) for k in range(len(rows))], i_command_a=i_a)


def _smooth(way_rad: float, steps: int) -> list[float]:
    """Return the angles of a way from rest to rest, without a jump of the acceleration."""
    shares = [k / steps for k in range(1, steps + 1)]
    return [way_rad * (share - math.sin(2.0 * math.pi * share) / (2.0 * math.pi)) for share in shares]


def _led(drive: Drive, i_a: float, angle_rad: float, dwell_s: float, signals: tuple[str, ...]) -> dict[str, float]:
    drive.command_current(i_a, 0.0, fixed_angle_rad=angle_rad)
    drive.wait(dwell_s)
    return _row(drive, angle_rad, signals, at_rest=False)


def _row(drive: Drive, angle_rad: float, signals: tuple[str, ...], *, at_rest: bool) -> dict[str, float]:
    means = dict(drive.average([name for name in signals if name != HALL], max(1, round(ROW_S / drive.period_s))))
    row = {"theta_imposed_rad": angle_rad, "theta_M_rad": means.pop("theta_m_rad"), "at_rest": float(at_rest)}
    return row | means | ({HALL: drive.live(HALL)} if HALL in signals else {})


def push_forth_and_back(drive: Drive, i_a: float, speed_rad_s: float, *, link: bool = False) -> Trace:
    """Push with a torque current one way, brake it, and the other way; one row per push.

    Raises IdentificationError: ``E_EXCITATION``: the shaft does not answer, and the current flows.

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
