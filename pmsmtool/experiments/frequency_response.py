# SPDX-License-Identifier: MIT
"""Random torque on a steady speed: currents and positions for the mechanical frequency response.

The speed keeps its sign, so that Coulomb friction is a constant and the response is linear. A binary sequence on the q
current moves the shaft; its sum is bounded, and so is what it adds to the speed: its level is what the limits leave,
and what keeps that small. Without a bound the speed of a light shaft walked away with a twentieth of the current.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pmsmtool.drive.port import Drive, Excitation, Injection, Shape
from pmsmtool.experiments.signals import readable
from pmsmtool.experiments.speed_run import REACH_LIMIT_S, reach
from pmsmtool.trace import Trace

SIGNALS = ("i_d_a", "i_q_a", "theta_m_rad", "flags")
ROWS = 4000
"""Rows of four signals that 64 kB hold."""
ROW_RATE_HZ = 4000.0
"""Rows per second: a record of a second tells frequencies a hertz apart."""
BIT_RATE_HZ = 2000.0
"""Bits of the sequence per second; it excites evenly up to 0.4 of that."""
REPEATS = 6
"""Records: their spread is the noise of a line."""
LEAD_S = 0.1
"""Sequence before a record."""
BITS, BITS_AHEAD = 2048, 12
"""Bits of the sequence, which then repeats, and by how many its sum leaves zero: evenly from 5 Hz on."""
WALK_SHARE = 0.2
"""Most that the sequence, or an error of the bias within a record, changes the speed by, of the speed."""
BUS_ALLOWANCE_S = 0.5
"""Time the recorder may be started late; the sequence lasts longer by it."""
BIAS_SETTLE_S, BIAS_WINDOW_S = 0.1, 0.2
"""Time for which a bias is held, and that in which the change of the speed is then seen (s)."""
BIAS_TRIES, AGAIN_TRIES = 6, 2
"""Times it is corrected by that, before the first record and before each further one. A speed controller may shake an
elastic shaft at its resonance, and the mean of its current is then no bias: with it the shaft stopped in five of six
records, and J came out 3.1 to 3.9 % too large."""
AGAIN_S = 1.0
"""Longest wait for a speed that the shaft had before: with cogging a light one never stays near it, and took 300 s."""


@dataclass(frozen=True, slots=True)
class FrequencyPlan:
    """Random torque on a speed."""

    i_q_a: float
    """Level of the sequence (A peak)."""
    omega_rad_s: float
    """Steady mechanical speed (rad/s)."""
    hold_periods: int
    """Control periods per bit."""
    decimation: int
    """Control periods per row."""
    per_ampere_rad_s2: float
    """Rough mechanical acceleration per q current (rad/s2/A)."""

    def bias_doubt_a(self, period_s: float) -> float:
        """Return the error of the bias that changes the speed by :data:`WALK_SHARE` within a record (A)."""
        longest = LEAD_S + ROWS * self.decimation * period_s
        return WALK_SHARE * self.omega_rad_s / (self.per_ampere_rad_s2 * longest)

    def duration_s(self, period_s: float) -> float:
        """Time of the records with their leads (s)."""
        return REPEATS * (LEAD_S + ROWS * self.decimation * period_s)


def plan_frequency_response(
    i_q_a: float, omega_rad_s: float, J_kgm2: float, torque_per_a: float, period_s: float
) -> FrequencyPlan:
    """Return the level of the sequence: the largest current, or less where the speed would walk too far.

    Parameters
    ----------
    i_q_a : float
        Largest level (A peak).
    omega_rad_s : float
        Steady mechanical speed (rad/s).
    J_kgm2 : float
        Rough inertia.
    torque_per_a : float
        Torque per q current (N m/A).
    period_s : float
        Control period (s).
    """
    decimation = max(1, round(1.0 / (ROW_RATE_HZ * period_s)))
    hold = max(1, round(1.0 / (BIT_RATE_HZ * period_s)))
    per_ampere = torque_per_a / J_kgm2
    level = WALK_SHARE * omega_rad_s / (per_ampere * BITS_AHEAD * hold * period_s)
    return FrequencyPlan(min(i_q_a, level), omega_rad_s, hold, decimation, per_ampere)


def bounded_sequence(k: int) -> list[float]:
    """Return the signs of record k, shape (BITS,), whose sum starts and ends at zero and is never beyond BITS_AHEAD."""
    signs, ahead = np.random.default_rng(k).choice([-1.0, 1.0], BITS), 0.0
    for bit, left in enumerate(range(BITS, 0, -1)):
        if abs(ahead + signs[bit]) > min(BITS_AHEAD, left - 1):
            signs[bit] = -signs[bit]
        ahead += signs[bit]
    return [float(sign) for sign in signs]


def linear_level(i_q_a: float, room_v: float, K_p_v_per_a: float) -> float:
    """Return the level (A peak), or less where a bit, a step of twice that, takes more voltage than there is.

    Parameters
    ----------
    i_q_a : float
        Level that is asked for (A peak).
    room_v : float
        Voltage beside the back-EMF (V).
    K_p_v_per_a : float
        Proportional gain of the q current (V/A).
    """
    return min(i_q_a, 0.5 * room_v / K_p_v_per_a) if K_p_v_per_a > 0.0 else i_q_a


def excite_at_speed(
    drive: Drive, plan: FrequencyPlan, pole_pairs: int, abort_speed_rad_s: float, keep: Callable[[Trace], None]
) -> None:
    """Record the answer to the sequence several times; each trace is handed over as soon as it is there.

    The drive is enabled on entry with a speed controller that holds the machine, and asked for standstill on
    return; the guard stops it on every other way out. It ends a sequence by itself at the abort speed (electrical
    rad/s).
    """
    bias: float | None = None
    for k in range(REPEATS):
        bias = keep_speed(drive, plan, pole_pairs, bias)
        excitation = Excitation(
            shape=Shape.BUFFER,
            point=Injection.I_Q,
            amplitude=plan.i_q_a,
            buffer=[plan.i_q_a * sign for sign in bounded_sequence(k)],
            bias_q_a=bias,
            hold_periods=plan.hold_periods,
            duration_s=LEAD_S + BUS_ALLOWANCE_S + ROWS * plan.decimation * drive.period_s,
            abort_speed_rad_s=abort_speed_rad_s,
            lead_s=LEAD_S,
        )
        keep(readable(drive.record(SIGNALS, ROWS, decimation=plan.decimation, excitation=excitation)))
    drive.command_speed(0.0)


def keep_speed(drive: Drive, plan: FrequencyPlan, pole_pairs: int, bias: float | None) -> float:
    """Bring the shaft to its speed and hold the q current that keeps it there; return it (A).

    ``bias`` is that of the record before; None: the speed controller's mean is the first one.
    """
    half = round(0.5 * BIAS_WINDOW_S / drive.period_s)
    for _ in range(BIAS_TRIES if bias is None else AGAIN_TRIES):
        drive.command_speed(plan.omega_rad_s)
        reach(drive, pole_pairs * plan.omega_rad_s, limit_s=REACH_LIMIT_S if bias is None else AGAIN_S)
        if bias is None:
            bias = drive.average(("i_q_a",), 2 * half)["i_q_a"]
        drive.command_current(0.0, bias)
        drive.wait(BIAS_SETTLE_S)
        first, second, _ = drive.halves(("omega_e_rad_s",), half)
        change = (second["omega_e_rad_s"] - first["omega_e_rad_s"]) / (pole_pairs * half * drive.period_s)
        wrong = change / plan.per_ampere_rad_s2
        bias -= wrong
        if abs(wrong) <= plan.bias_doubt_a(drive.period_s):
            break
    assert bias is not None
    return bias
