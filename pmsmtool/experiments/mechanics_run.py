# SPDX-License-Identifier: MIT
"""Pushes and coasting in both directions: positions and currents for inertia and friction.

A push from rest, coasting, a push the other way through standstill, coasting (docs/identification.md, 3.5). The shaft
coasts with the voltage off: the sampled current of a switched bridge is not the mean of its ripple, which at commanded
zero current leaves a torque of a part in a thousand of the rated one, as much as a good bearing's friction. A shaft
that friction stops while its push is read out coasts within the record of the push, without a current: beside such a
friction that torque is small.

Turns at a low speed under the speed controller, both ways: current and position show what torque the angle adds.

Fast coasting hides a torque of a high order: its ripple of the position falls with the square of order and speed.

Before: how fast the shaft answers a torque current, by short pushes forth and back that grow until it moves.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pmsmtool.drive.port import Drive, Excitation, Injection, Shape
from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.shaft.mechanics import POWERED
from pmsmtool.estimators.shaft.position import ENCODER_STEPS_LEAST, encoder_step
from pmsmtool.experiments.signals import readable
from pmsmtool.experiments.speed_run import reach
from pmsmtool.trace import Trace

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
    """What a shaft does with a torque current."""

    per_ampere: float
    """Mechanical acceleration per current beyond friction (rad/s2/A)."""
    friction_a: float = 0.0
    """Current that friction takes (A peak)."""
    direction: int = 1
    """-1 where the position falls under a positive torque current, else 1."""

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


SIGNALS = ("i_d_a", "i_q_a", "theta_m_rad", "flags")
COASTING_SIGNALS = ("theta_m_rad",)
ROWS = 2000
"""Rows of a push: several per block that the estimator averages."""
COASTING_ROWS = 800
"""Rows of a coasting, of which the estimator takes every second or every one."""
UNIT_LEAST_S, UNIT_MOST_S = 0.03, 0.6
"""Shortest and longest push: the current loop needs milliseconds, a person's patience ends somewhere."""
COAST_UNITS, COAST_LEAST_S, COAST_MOST_S = 6.0, 0.5, 2.5
"""Time of coasting, in pushes, and its bounds."""
SHORT = 0.7
"""Speed that a push reaches, of the planned one, below which friction or cogging takes most of it: a stronger one
follows. On a gimbal motor 0.05 A of 1.2 A turned the shaft by six periods of its cogging, and J came out negative."""
STRONGER_TRIES = 3
LEFT_LEAST = 0.5
"""Speed at the begin of a coasting, of that at the end of the push, below which most of it was over before."""
SHORTER = 3.0
"""Current of the pushes of such a shaft, of the planned one, which are shorter by as much: cogging and friction that
stop it soon are then a third of the push."""
STEPS_DOUBT = 1.5
"""Steps of the encoder that such a push is to turn, of the least: a third of 65 of 10 bits were 22, 50 are asked."""
CURRENT_OFF = 0.15
"""Current, of the push's, below which it is over. What flows then is known, and counts as a torque: a loop whose
integral follows the falling back-EMF lets 8 % flow on a light shaft until friction has stopped it."""


@dataclass(frozen=True, slots=True)
class MechanicsPlan:
    """Pushes and coasting."""

    i_q_a: float
    """Current of a push (A peak)."""
    unit_s: float
    """Length of the first push (s); the second is twice as long."""
    omega_rad_s: float
    """Mechanical speed they are to reach (rad/s)."""
    i_most_a: float
    """Largest current of one (A); ``i_q_a`` is smaller for a shaft so light that it reaches the speed at once."""
    rows: int = ROWS
    """Largest number of rows of a push."""
    coast_units: float = COAST_UNITS
    """Time of a coasting, in pushes."""

    @property
    def coast_s(self) -> float:
        """Length of one coasting (s)."""
        return min(COAST_MOST_S, max(COAST_LEAST_S, self.coast_units * self.unit_s))

    @property
    def duration_s(self) -> float:
        """Time of the whole run (s)."""
        return 3.0 * self.unit_s + 2.0 * self.coast_s

    def stronger(self, reached_rad_s: float) -> MechanicsPlan:
        """Return the plan with the current that what a push did not reach asks for, at most twice its own."""
        missing = max(0.0, 1.0 - reached_rad_s / self.omega_rad_s)
        return replace(self, i_q_a=min(self.i_most_a, self.i_q_a * (1.0 + missing)))


def plan_mechanics(i_q_a: float, omega_rad_s: float, J_kgm2: float, torque_per_a: float) -> MechanicsPlan:
    """Return pushes that reach a speed: as long as that takes, or weaker where it takes too little time.

    Parameters
    ----------
    i_q_a : float
        Largest current (A peak).
    omega_rad_s : float
        Largest mechanical speed (rad/s).
    J_kgm2 : float
        Rough inertia.
    torque_per_a : float
        Torque per q current (N m/A).
    """
    unit = J_kgm2 * omega_rad_s / (torque_per_a * i_q_a)
    if unit < UNIT_LEAST_S:
        return MechanicsPlan(i_q_a * unit / UNIT_LEAST_S, UNIT_LEAST_S, omega_rad_s, i_q_a)
    longest = min(unit, UNIT_MOST_S)
    return MechanicsPlan(i_q_a, longest, omega_rad_s * longest / unit, i_q_a)


def push_and_coast(drive: Drive, plan: MechanicsPlan, abort_speed_rad_s: float, keep: Callable[[Trace], None]) -> None:
    """Record push, coasting, push the other way, coasting; each trace is handed over as soon as it is there.

    The drive is enabled and at rest on entry, and off on return. It ends a push by itself at the abort speed
    (electrical rad/s).
    """
    first = _push(drive, plan.i_q_a, plan.unit_s, plan.rows, abort_speed_rad_s)
    coasting = _coast(drive, plan)
    for _ in range(STRONGER_TRIES):
        reached = abs(_speed(first))
        stopped = abs(_speed(coasting)) <= SHORT * reached
        if plan.i_q_a >= plan.i_most_a or not stopped or reached >= SHORT * plan.omega_rad_s:
            break
        plan = plan.stronger(reached)
        drive.enable()
        first = _push(drive, plan.i_q_a, plan.unit_s, plan.rows, abort_speed_rad_s)
        coasting = _coast(drive, plan)
    if abs(_speed(coasting, first_rows=True)) < LEFT_LEAST * abs(_speed(first)):
        times = max(1.0, min(SHORTER, plan.i_most_a / plan.i_q_a, _seen(first)))
        current, push_s = times * plan.i_q_a, plan.unit_s / times
        for sign in (1.0, -1.0):
            drive.enable()
            whole = _push(drive, sign * current, push_s, plan.rows, abort_speed_rad_s, COAST_LEAST_S)
            for part in _parts(whole, sign * current, push_s):
                keep(part)
        drive.disable()
        return
    keep(first)
    keep(coasting)
    reached, left = abs(_speed(first)), abs(_speed(coasting))
    # what the first push really did decides how long the other one may be: the plan's inertia is a rough one
    both = min(2.0 * reached, reached + left, 2.0 * plan.omega_rad_s)
    drive.enable()
    back_s = max(plan.unit_s, plan.unit_s * both / max(reached, 0.1 * plan.omega_rad_s))
    keep(_push(drive, -plan.i_q_a, back_s, plan.rows, abort_speed_rad_s))
    keep(_coast(drive, plan))


def _seen(push: Trace) -> float:
    """Return how many times shorter a push to the same speed may be, of one whose encoder's steps are seen."""
    theta = push["theta_M_rad"]
    try:
        return float(np.ptp(theta)) / (STEPS_DOUBT * ENCODER_STEPS_LEAST * encoder_step([theta]))
    except IdentificationError:  # it turned by fewer steps
        return 1.0


def _coast(drive: Drive, plan: MechanicsPlan) -> Trace:
    drive.disable()
    samples, decimation = _rows(drive, plan.coast_s, COASTING_ROWS)
    trace = readable(drive.record(COASTING_SIGNALS, samples, decimation=decimation))
    return replace(trace, meta={**trace.meta, "coasting": True})


def _parts(whole: Trace, i_q_a: float, push_s: float) -> tuple[Trace, Trace]:
    """Return push and coasting of a record that has both."""
    pushed = int(push_s / whole.period_s)
    over = np.nonzero(np.abs(whole["i_q_a"][pushed:]) <= CURRENT_OFF * abs(i_q_a))[0]
    ends = pushed, min(pushed + (int(over[0]) if len(over) else len(whole)), len(whole) - 2)  # a current may not go
    push, coasting = whole.rows(slice(0, ends[0])), whole.rows(slice(ends[1], None))
    meta = {**whole.meta, "coasting": True, POWERED: True}
    return push, replace(coasting, t_s=coasting.t_s - coasting.t_s[0], meta=meta)


def _speed(trace: Trace, *, first_rows: bool = False) -> float:
    """Mean speed over the last twentieth of a trace, or the first (rad/s mechanical)."""
    rows = max(2, len(trace) // 20)
    theta = trace["theta_M_rad"][:rows] if first_rows else trace["theta_M_rad"][-rows:]
    return float(theta[-1] - theta[0]) / ((rows - 1) * trace.period_s)


def _push(
    drive: Drive, i_q_a: float, seconds: float, rows: int, abort_speed_rad_s: float, coasting_s: float = 0.0
) -> Trace:
    """Push, and go on recording for a while without a current."""
    samples, decimation = _rows(drive, seconds + coasting_s, rows)
    excitation = Excitation(
        shape=Shape.STEP,
        point=Injection.I_Q,
        amplitude=i_q_a,
        duration_s=seconds if coasting_s else samples * decimation * drive.period_s,
        abort_speed_rad_s=abort_speed_rad_s,
    )
    drive.command_current(0.0, 0.0)
    gains = [drive.read(f"current.K_p_{axis}_v_per_a") for axis in "dq"]
    trace = drive.record(SIGNALS, samples, decimation=decimation, excitation=excitation)
    return readable(trace, coasting=False, K_p_v_per_a=gains)


def _rows(drive: Drive, seconds: float, most: int) -> tuple[int, int]:
    """Return samples and decimation of a record of that length."""
    periods = max(2, round(seconds / drive.period_s))
    decimation = max(1, math.ceil(periods / most))
    return periods // decimation, decimation


SPEED_RAD_S = math.pi
"""30 rpm: the noise of the position rises with the square of the speed, and slower ones come near to sticking."""
TURNS = 2.1
SETTLE_S, REACH_S, BAND = 0.5, 4.0, 0.3
"""Time after the speed is reached; longest time for that; relative band, within which cogging may move it."""


def record_slow_turns(drive: Drive, pole_pairs: int, speed_rad_s: float, keep: Callable[[Trace], None]) -> None:
    """Record turns in either direction; each trace is handed over as soon as it is there.

    The drive is enabled on entry with a speed controller that holds the machine; it is asked for standstill on return.
    """
    for speed in (speed_rad_s, -speed_rad_s):
        drive.command_speed(speed)
        omega_e = pole_pairs * speed
        reach(drive, omega_e, limit_s=REACH_S, band_rad_s=BAND * abs(omega_e))
        drive.wait(SETTLE_S)
        periods = round(TURNS * 2.0 * math.pi / abs(speed) / drive.period_s)
        decimation = math.ceil(periods / ROWS)
        keep(readable(drive.record(SIGNALS, periods // decimation, decimation=decimation)))
    drive.command_speed(0.0)
