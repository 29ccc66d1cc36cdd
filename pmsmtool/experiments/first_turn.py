# SPDX-License-Identifier: MIT
"""The first turn of a shaft nobody has seen turn yet: a small vector leads it half a turn at the most, and back."""

from __future__ import annotations

import math

from pmsmtool.drive.port import Drive
from pmsmtool.experiments.rotation import ROW_S
from pmsmtool.experiments.signals import table
from pmsmtool.experiments.vector_turn import REST_LIMIT_S, come_to_rest, turn_vector
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
