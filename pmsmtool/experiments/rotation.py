"""Turn a current vector slowly forward and back: the rotor follows, and the encoder is counted."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pmsmtool.drive.port import Drive
from pmsmtool.errors import IdentificationError
from pmsmtool.experiments.signals import table
from pmsmtool.trace import Trace

MAX_POLE_PAIRS = 32
"""A machine with more is not found by turning its vector; the run ends with E_POLE_PAIRS."""

ALIGN_S = 0.3
BACK_AT_MOST = 1.15
"""Steps of the way back, of those of the way there: a rotor that lags or sticks at a turning point needs more."""
STEP_RAD = math.radians(15.0)
"""Electrical angle of one step."""
SWING = 2.0
"""Largest speed of a rotor that is led by steps, over the mean one."""
SLOWEST_STEP_S = 0.2
"""Longest time per step: a machine of twenty pole pairs then takes some three minutes for both ways."""
LEAD_STEPS = 8
"""Steps before the recorded ones: the rotor's own transient after standstill or reversal."""


@dataclass(frozen=True, slots=True)
class RotationPlan:
    """How the vector is turned.

    Attributes
    ----------
    i_a : float
        Length of the vector (A peak).
    step_rad : float
        Electrical angle of one step.
    dwell_s : float
        Time per step (s).
    turns_mechanical : float
        Mechanical turns in each direction.
    """

    i_a: float
    step_rad: float = STEP_RAD
    dwell_s: float = 0.015
    turns_mechanical: float = 1.02


def dwell_within(dwell_s: float, omega_max_rad_s: float) -> float:
    """Return a time per step (s) at which the shaft keeps to a speed limit, however few pole pairs it has.

    Parameters
    ----------
    dwell_s : float
        Time per step where the limit allows it (s).
    omega_max_rad_s : float
        Largest mechanical speed (rad/s). The pole pairs are what is to be found: one is assumed.

    Raises
    ------
    IdentificationError
        ``E_EXCITATION``: the limit is too low for a turn in reasonable time.
    """
    least_s = SWING * STEP_RAD / omega_max_rad_s
    if least_s > SLOWEST_STEP_S:
        rpm = 30.0 / math.pi
        raise IdentificationError(
            "E_EXCITATION",
            f"the slow turn of the shaft needs a speed limit of {rpm * SWING * STEP_RAD / SLOWEST_STEP_S:.3g} rpm, "
            f"{rpm * omega_max_rad_s:.3g} are allowed",
            where="slow turn",
            likely="pole pairs are not known before it: a machine of one must keep to the limit, too",
            hint=f"allow at least --speed-max {math.ceil(rpm * SWING * STEP_RAD / SLOWEST_STEP_S)}rpm",
        )
    return max(dwell_s, least_s)


def rotate_vector(drive: Drive, plan: RotationPlan, *, start_rad: float = 0.0) -> tuple[Trace, Trace]:
    """Turn the vector until the shaft has made its turns, then back; return the two runs.

    The drive is enabled on entry; the vector stands where it started, at zero current, on return.

    Returns
    -------
    forward, backward : Trace
        ``theta_imposed_rad`` (electrical, unwrapped) and ``theta_M_rad`` (mechanical, unwrapped), one row per step.
    """
    drive.command_current(plan.i_a, 0.0, fixed_angle_rad=start_rad)
    drive.wait(ALIGN_S)
    angle, forward = _run(drive, plan, start_rad, plan.step_rad, None)
    drive.wait(ALIGN_S)
    angle, backward = _run(drive, plan, angle, -plan.step_rad, len(forward))
    drive.command_current(0.0, 0.0, fixed_angle_rad=angle)
    return forward, backward


def _run(drive: Drive, plan: RotationPlan, angle: float, step: float, count: int | None) -> tuple[float, Trace]:
    """Turn in one direction: a lead-in that brings the rotor to speed, then the turns, and ``count`` steps."""
    for _ in range(LEAD_STEPS):
        angle += step
        _step(drive, plan, angle)
    rows = [_row(drive, angle)]
    limit = round(2.0 * math.pi * MAX_POLE_PAIRS * plan.turns_mechanical / plan.step_rad)
    if count is not None:
        limit = min(limit, round(BACK_AT_MOST * count))
    while len(rows) < limit:
        angle += step
        rows.append(_step(drive, plan, angle))
        way = abs(rows[-1]["theta_M_rad"] - rows[0]["theta_M_rad"])
        if way >= 2.0 * math.pi * plan.turns_mechanical and len(rows) >= (count or 0):
            break
    return angle, table(rows, [k * plan.dwell_s for k in range(len(rows))], i_command_a=plan.i_a)


def _step(drive: Drive, plan: RotationPlan, angle: float) -> dict[str, float]:
    drive.command_current(plan.i_a, 0.0, fixed_angle_rad=angle)
    drive.wait(plan.dwell_s)
    return _row(drive, angle)


def _row(drive: Drive, angle: float) -> dict[str, float]:
    measured = drive.average(("theta_m_rad",), max(1, round(0.002 / drive.period_s)))
    return {"theta_imposed_rad": angle, "theta_M_rad": measured["theta_m_rad"]}
