# SPDX-License-Identifier: MIT
"""Torque pushes of drives without injection, polled at up to 1 kHz or recorded; the speed that the voltage ends at.

Recorded, the shaft swings between two speeds under constant torque currents of several sizes and both signs, so that
the voltages contain every current at every speed.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pmsmtool.drive.port import Drive
from pmsmtool.estimators.flux.voltage_flux import RISING, STEADY, current_rise, voltage_drift
from pmsmtool.experiments.mechanics_run import OVER_FRICTION, ShaftAnswer, acceleration_per_ampere, brake_shaft
from pmsmtool.experiments.signals import readable
from pmsmtool.trace import Trace

POLLED = ("theta_m_rad", "i_q_a")
ANSWER_RAD = 0.02
"""Angle that counts as an answer of the shaft: an encoder of 1024 increments has three of them."""
POLLED_RAMP_S = 0.04
ALIKE = 1.3
"""Ratio of two currents below which inertia and friction are not told apart by them: the shaft coasts between pushes of
the smaller one. Where friction lifted all currents to one, J/psi was up to 52 % off at +-6 %."""
CHECK_S = 0.012
"""Speed is looked at this often while the machine runs up to its voltage."""
RUNNING = 0.2
"""Speed, of the largest one, above which it is looked for."""
PATIENCE = 3.0
"""Longest run-up, over that at the current of the top."""
STALLED_SHARE = 0.25
"""Acceleration, of the first one at the same current, at which the voltage is taken to be the limit."""
STALL_CHECKS = 5
"""Looks over which it is found: one look that comes 1 ms late is more than the acceleration of a light shaft."""
LEAST_NET = 0.5
"""Of a current, what is taken to accelerate at least: friction is known roughly."""
SLOWEST_NET = 0.25
"""The same, where it says how long a run-up may take."""
RUN_SHARE = 0.5
"""Current of the run-up, of the test current."""
HOLD_SHARE = 0.08
"""Current asked for at the top, of the test current: more than friction, little enough to weaken no field."""
HOLD_S = 0.4
HOLDS = 10
"""Records of the top at most: the third was steady on a motor whose friction takes 75 % of the current that is left."""
COAST_S = 0.2
COAST_SHARES = (1.0, -1.0, 0.4, -0.4)
"""Speeds a coast begins at, of the plan's: one speed does not tell the flux from a constant voltage."""
COASTS, FADED = 5, 0.01
"""Records of a coast at most, until the voltage over the speed changes by less within one: a current that fades with
L/R took 9 to 36 % off psi, at +-6 to 23 %."""
STOP_SHARE = 0.3

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
class PolledPushPlan:
    """How the shaft is pushed."""

    i_test_a: float
    """Largest torque current (A peak)."""
    omega_m_rad_s: float
    """Mechanical speed the pushes go to, both ways (rad/s)."""
    omega_top_rad_s: float
    """Speed no run-up goes beyond (rad/s)."""
    shares: tuple[float, ...] = (0.3, 0.5, 0.7)
    """Torque currents of the pushes, of the largest."""
    omega_failure_rad_s: float = math.inf
    """Speed that must not be reached although the tool fails during a push (rad/s); infinity: the drive sees to it."""
    off_s: float = 0.5
    """Time until the voltage is off then (s)."""

    def stop_a(self, answer: ShaftAnswer) -> float:
        """Return the largest current (A peak) that brakes the shaft."""
        return min(STOP_SHARE * self.i_test_a, self.most_a(answer, 0.0))

    def most_a(self, answer: ShaftAnswer, speed_rad_s: float) -> float:
        """Return the largest current (A peak) at a speed (rad/s) from which the tool may fail."""
        return answer.most_a(max(0.0, self.omega_failure_rad_s - abs(speed_rad_s)), self.off_s)


def push_both_ways(
    drive: Drive,
    plan: PolledPushPlan,
    keep: Callable[[str, Trace], None],
    answered: Callable[[ShaftAnswer], None] = lambda answer: None,
) -> ShaftAnswer:
    """Swing the shaft and keep every push as ``torque_push_<k>``; returns how the shaft answers.

    ``answered`` is called as soon as that is known.

    Raises IdentificationError: ``E_EXCITATION``: the shaft does not answer.
    """
    answer = acceleration_per_ampere(drive, plan.i_test_a, lambda way, _: way > ANSWER_RAD)
    answered(answer)
    count = 0
    # the shortest ramp takes a light shaft to its speed with less than the test current
    most = min(plan.omega_m_rad_s / (answer.per_ampere * POLLED_RAMP_S), plan.most_a(answer, plan.omega_m_rad_s))
    largest = min(plan.i_test_a, most / max(plan.shares))
    for share in plan.shares:
        current = max(share * largest, min(OVER_FRICTION * answer.friction_a, plan.i_test_a))
        ramp_s = max(POLLED_RAMP_S, plan.omega_m_rad_s / (answer.per_ampere * current))
        ways = ((1.0, ramp_s), (-1.0, 2.0 * ramp_s), (1.0, 2.0 * ramp_s), (-1.0, ramp_s))
        if share < max(plan.shares) and largest * max(plan.shares) < ALIKE * current:
            coasting_s = max(POLLED_RAMP_S, min(1.0, current / answer.friction_a - 1.0) * ramp_s)
            ways = ((1.0, ramp_s), (0.0, coasting_s), (-1.0, ramp_s), (0.0, coasting_s))
        for sign, seconds in ways:
            keep(f"torque_push_{count}", _polled(drive, sign * current, seconds))
            count += 1
    brake_shaft(drive, plan.stop_a(answer), answer)
    return answer


def run_to_voltage(drive: Drive, plan: PolledPushPlan, answer: ShaftAnswer) -> Trace | None:
    """Run up until the voltage takes the current away and return a record of the speed there.

    Returns
    -------
    Trace or None
        ``theta_M_rad``, ``i_q_a`` and ``U_dc_v``; None when the top speed came first. The shaft is nearly at rest.
    """
    top, found = plan.omega_top_rad_s, None
    hold = min(HOLD_SHARE * plan.i_test_a, plan.most_a(answer, top))
    speed, spent = 0.0, 0.0
    speeds, expected = deque([0.0], STALL_CHECKS + 1), deque([0.0], STALL_CHECKS)
    slowest = answer.per_ampere * max(hold - answer.friction_a, SLOWEST_NET * hold)
    while spent < PATIENCE * top / slowest:
        # what is left to the top is approached by halves, so that a weak voltage is seen before it
        # the speed is a mean, half a look old, and goes on for one more
        ahead = speed + 1.5 * expected[-1]
        nearer = min(0.5 * (top - speed) / (answer.per_ampere * CHECK_S), plan.most_a(answer, ahead))
        current = min(RUN_SHARE * plan.i_test_a, max(hold, nearer))
        drive.command_current(0.0, current)
        speed = _speed(drive)
        spent += CHECK_S
        ends = speed + answer.per_ampere * max(0.0, current - answer.friction_a) * plan.off_s
        if speed > top or ends > plan.omega_failure_rad_s:  # the least that overcomes friction is too much from here
            break
        speeds.append(speed)
        expected.append(answer.per_ampere * max(current - answer.friction_a, LEAST_NET * current) * CHECK_S)
        if speeds[0] > RUNNING * top and speed - speeds[0] < STALLED_SHARE * sum(expected):
            drive.command_current(0.0, hold)
            if _holds(drive, top):
                found = _steady_top(drive, hold, top)
            break
    brake_shaft(drive, plan.stop_a(answer), answer)
    return found


def coast_both_ways(
    drive: Drive,
    plan: PolledPushPlan,
    answer: ShaftAnswer,
    signals: tuple[str, ...],
    keep: Callable[[str, Trace], None],
) -> None:
    """Let the shaft coast without torque from two speeds, both ways, and keep each as ``coast_<k>``."""
    current = min(RUN_SHARE * plan.i_test_a, plan.most_a(answer, plan.omega_m_rad_s))
    for number, share in enumerate(COAST_SHARES):
        drive.command_current(0.0, math.copysign(current, share))
        drive.wait(abs(share) * plan.omega_m_rad_s / (answer.per_ampere * current))
        drive.command_current(0.0, 0.0)
        drive.wait(CHECK_S)
        keep(f"coast_{number}", _faded_coast(drive, signals))
        brake_shaft(drive, plan.stop_a(answer), answer)


def _faded_coast(drive: Drive, signals: tuple[str, ...]) -> Trace:
    """Record a coast until no current fades any more; no further than to half of the speed of the first record."""
    kept, least = None, 0.0
    for _ in range(COASTS):
        trace = readable(drive.record(signals, round(COAST_S / drive.period_s)))
        way = abs(float(trace["theta_M_rad"][-1] - trace["theta_M_rad"][0]))
        if kept is not None and way < least:
            break
        kept, least = trace, least or 0.5 * way
        if abs(voltage_drift(kept)) <= FADED:
            break
    assert kept is not None
    return kept


def _holds(drive: Drive, top_rad_s: float) -> bool:
    """Let the current settle; whether the speed then stays below the top for a record more."""
    first = speed = _speed(drive)
    spent = CHECK_S
    while spent < HOLD_S and speed <= top_rad_s:
        speed = _speed(drive)
        spent += CHECK_S
    return speed + max(0.0, speed - first) <= top_rad_s


def _speed(drive: Drive) -> float:
    """Return the speed (rad/s, no sign) over :data:`CHECK_S`, by the instants at which the position was read.

    A drive that answers so slowly that it is not seen twice is taken to be too fast.
    """
    seen = readable(drive.record(POLLED, 2, decimation=max(1, round(CHECK_S / drive.period_s))))
    if len(seen) < 2 or not seen.t_s[-1] > seen.t_s[0]:
        return math.inf
    return float(abs(seen["theta_M_rad"][-1] - seen["theta_M_rad"][0]) / (seen.t_s[-1] - seen.t_s[0]))


def _steady_top(drive: Drive, command_a: float, top_rad_s: float) -> Trace | None:
    """Record until speed and current are steady, or :data:`HOLDS` times; None where it goes beyond the top speed.

    A small current brings a shaft with friction from where the larger one stalled to the top slowly.
    """
    for _ in range(HOLDS):
        trace = drive.record((*POLLED, "U_dc_v"), round(HOLD_S / drive.period_s))
        found = readable(trace, i_command_a=command_a)
        t, angle = found.t_s, found["theta_M_rad"]
        half = len(t) // 2
        first, second = (abs(angle[k + half - 1] - angle[k]) / (t[k + half - 1] - t[k]) for k in (0, len(t) - half))
        if second + 2.0 * max(0.0, second - first) > top_rad_s:
            return None  # at the end of the next record
        if abs(second - first) <= 0.5 * STEADY * second and abs(current_rise(found)) <= RISING:
            break
    return found


def _polled(drive: Drive, i_q_a: float, seconds: float) -> Trace:
    drive.command_current(0.0, i_q_a)
    return readable(drive.record(POLLED, max(2, round(seconds / drive.period_s))), i_command_a=i_q_a)


@dataclass(frozen=True, slots=True)
class PushPlan:
    """How the shaft is swung."""

    i_test_a: float
    """Largest torque current (A peak)."""
    omega_m_rad_s: float
    """Mechanical speed the swing goes to, both ways (rad/s)."""
    shares: tuple[float, ...] = (0.2, 0.3, 0.45, 0.6, 0.8, 1.0)
    """Torque currents, of the largest."""
    samples: int = 1024
    """Samples of one record."""
    u_max_v: float = math.inf
    """Largest sinusoidal voltage (V); infinity: not known."""
    i_max_a: float = math.inf
    """Largest current vector that is allowed (A peak)."""
    omega_failure_rad_s: float = math.inf
    """Speed that must not be reached although the tool fails during a push (rad/s); infinity: the drive sees to it."""
    off_s: float = 0.5
    """Time until the voltage is off then (s)."""


def swing(
    drive: Drive,
    plan: PushPlan,
    keep: Callable[[str, Trace], None],
    answered: Callable[[ShaftAnswer], None] = lambda answer: None,
) -> None:
    """Swing the shaft and keep a record of every push as ``push_<k>``; the shaft is nearly at rest on return.

    ``answered`` is called as soon as it is known how the shaft answers.
    Larger currents go to a smaller speed where the pushes before say that voltage or current would leave their limits.

    Raises IdentificationError: ``E_EXCITATION``: the shaft does not answer.
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
