# SPDX-License-Identifier: MIT
"""Torque pushes both ways, recorded at loop rate: what a drive without injection can still be asked for.

The shaft swings between two speeds under constant torque currents of several sizes and both signs, so that the
recorded voltages contain every current at every speed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pmsmtool.drive.port import Drive
from pmsmtool.experiments.shaft_answer import OVER_FRICTION, ShaftAnswer, acceleration_per_ampere, brake_shaft
from pmsmtool.experiments.signals import readable
from pmsmtool.trace import Trace

SIGNALS = ("i_d_a", "i_q_a", "u_d_v", "u_q_v", "omega_e_rad_s", "theta_m_rad", "flags")
ANSWER_SHARE = 0.04
"""Speed change, of the wanted one, that counts as an answer of the shaft."""
LEAST_RAMP_S = 0.05
VOLTAGE_SHARE = 0.8
"""Largest voltage of a push, of the largest sine's: the current control keeps the rest for the reversal."""
USUAL = 0.9
"""Quantile of a record's voltages that its own reversal does not decide."""
PAUSE_S = 0.1
"""Without torque before the first push of a size: a step from one sign to the other kicks the d current twice as far
as one from zero, which on two shipped machines was 2.1 times the commanded current."""


@dataclass(frozen=True, slots=True)
class PushPlan:
    """How the shaft is swung.

    Attributes
    ----------
    i_test_a : float
        Largest torque current (A peak).
    omega_m_rad_s : float
        Mechanical speed the swing goes to, both ways (rad/s).
    shares : tuple of float
        Torque currents, of the largest.
    u_max_v : float
        Largest sinusoidal voltage (V); infinity: not known.
    i_max_a : float
        Largest current vector that is allowed (A peak).
    samples : int
        Samples of one record.
    omega_failure_rad_s : float
        Speed that must not be reached although the tool fails during a push (rad/s); infinity: the drive sees to it.
    off_s : float
        Time until the voltage is off then (s).
    """

    i_test_a: float
    omega_m_rad_s: float
    shares: tuple[float, ...] = (0.2, 0.3, 0.45, 0.6, 0.8, 1.0)
    samples: int = 1024
    u_max_v: float = math.inf
    i_max_a: float = math.inf
    omega_failure_rad_s: float = math.inf
    off_s: float = 0.5


def swing(
    drive: Drive,
    plan: PushPlan,
    keep: Callable[[str, Trace], None],
    answered: Callable[[ShaftAnswer], None] = lambda answer: None,
) -> None:
    """Swing the shaft and keep a record of every push as ``push_<k>``; the shaft is nearly at rest on return.

    ``answered`` is called as soon as it is known how the shaft answers.
    Larger currents go to a smaller speed where the pushes before say that voltage or current would leave their limits.

    Raises
    ------
    IdentificationError
        ``E_EXCITATION``: the shaft does not answer.
    """
    answer = acceleration_per_ampere(
        drive, plan.i_test_a, lambda way, seconds: 2.0 * way / seconds > ANSWER_SHARE * plan.omega_m_rad_s
    )
    answered(answer)
    count, speed = 0, plan.omega_m_rad_s
    largest = min(plan.i_test_a, answer.most_a(plan.omega_failure_rad_s - speed, plan.off_s))
    last: list[Trace] = []
    for share, larger in zip(plan.shares, (*plan.shares[1:], plan.shares[-1]), strict=True):
        current = max(share * largest, min(OVER_FRICTION * answer.friction_a, plan.i_test_a))
        ramp_s = max(LEAST_RAMP_S, speed / (answer.per_ampere * current))
        drive.command_current(0.0, -current)
        drive.wait(ramp_s)
        drive.command_current(0.0, 0.0)
        drive.wait(PAUSE_S)
        for sign in (1.0, -1.0, 1.0, -1.0):
            trace = _recorded(drive, plan, sign * current, 2.0 * ramp_s)
            keep(f"push_{count}", trace)
            last.append(trace)
            count += 1
        brake_shaft(drive, current, answer)
        larger_a = larger * largest
        speed *= min(1.0, *(_slower(trace, larger / share, larger_a, plan) for trace in last[-4:]))


def _slower(trace: Trace, times: float, current_a: float, plan: PushPlan) -> float:
    """Return how much slower a push with so many times the current must stay, from the record of a smaller one.

    Across the magnets' axis nearly all of the voltage is the reactance of that current, and a step of it kicks the d
    current in proportion to its size and to the speed.
    """
    voltage_v = float(np.quantile(np.hypot(times * trace["u_d_v"], trace["u_q_v"]), USUAL))
    kick_a = times * float(np.max(np.abs(trace["i_d_a"])))
    room_a = math.sqrt(max(0.0, plan.i_max_a**2 - current_a**2))
    by_current = room_a / kick_a if kick_a > 0.0 else math.inf
    by_voltage = VOLTAGE_SHARE * plan.u_max_v / voltage_v if voltage_v > 0.0 else math.inf
    return min(by_voltage, by_current)


def _recorded(drive: Drive, plan: PushPlan, i_q_a: float, seconds: float) -> Trace:
    """Command a torque current and record the push; the record starts right behind the command."""
    drive.command_current(0.0, i_q_a)
    decimation = max(1, round(0.97 * seconds / (plan.samples * drive.period_s)))
    trace = drive.record(SIGNALS, plan.samples, decimation=decimation)
    return readable(trace, i_command_a=i_q_a, decimation=decimation)
