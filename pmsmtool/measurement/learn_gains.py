# SPDX-License-Identifier: MIT
"""``map learn``, its first part: change a gain by a known ratio, and see how the drive's speed loop answers."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.envelope import Envelope, largest_acceleration, voltage_speed
from pmsmtool.drive.guard import OVERSHOOT, GuardedDrive
from pmsmtool.drive.motion_objects import limits_speed
from pmsmtool.drive.port import Excitation, Injection, Shape
from pmsmtool.drive.speed_loop_drive import SpeedLoopDrive
from pmsmtool.errors import IdentificationError, SafetyRefusal
from pmsmtool.identification.asked_current import asked_share, fit_asked_current, held_apart, shows_asked
from pmsmtool.identification.learned_gains import NO_DOUBT, Observation, emf_doubt, lag_doubt
from pmsmtool.identification.speed_loop_response import (
    Emf,
    SpeedLoop,
    StepRecord,
    fit_pulses,
    fit_speed_loop,
    phase_margin_rad,
)
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.parameters import LINEAR_UTILISATION, Brake, Load, Shaft
from pmsmtool.measurement.changed_gains import (
    DOWN,
    GAIN,
    INTEGRAL,
    GainObject,
    Put,
    changing,
    refuse_unsafe,
    while_changed,
)
from pmsmtool.measurement.speed_unit import find_speed_unit
from pmsmtool.trace import Trace
from pmsmtool.units import rad_s_from_rpm

GAIN_LITTLE_DOWN = 0.85
"""First change of the gain where 0.7 of it would leave too little margin beside an integral part of its own."""
INTEGRAL_DOWN, LITTLE_DOWN = 0.8, 0.9
"""First change of an integral part: where it is a time, its gain rises by 1.25, less where the margin needs it."""
FURTHER_DOWN = 0.5
"""Second change of an integral part, towards the smaller gain."""
SURE = 0.4
"""Share of the first change that must be seen before the second: noise and friction leave a fifth."""
LEAST_MARGIN_RAD, LEAST_MARGIN_DOWN_RAD = math.radians(40.0), math.radians(30.0)
"""Predicted phase margin below which nothing is changed: where a gain may rise, and where it can only fall."""
TRIP = 3.0
"""Oscillation over the one with the drive's own gains, at which the voltage is removed."""
LOW_SHARE, HIGH_SHARE = 0.15, 0.7
"""Speeds between which the reference climbs and falls, of the speed limit."""
HIGH_UNLIMITED, TRIP_UNLIMITED, MOST = 0.45, 0.65, 1.3
"""The higher one on a drive that has no speed limit of its own, the speed at which the samples end its steps, and the
speed that a shaft may have when the voltage is off, of the limit: the steps' current is what leaves that between."""
STEP_CURRENT = 0.5
"""Current of a step, of what drive and envelope allow: large against friction and the inverter's dead time."""
FIRST_STEP = 0.02
"""First step of speed, of the speeds between which it climbs."""
GROWN, ENOUGH, TRIES = 4.0, 0.75, 6
CLIMB, RETURN = 0.3, 0.6
"""Acceleration of the reference up and back, of what a step begins with: on the way up the current keeps its sign, for
after a step it swings back by up to a fifth of its peak, and through zero the inverter's dead time would delay it."""
STEPS = (2, 6)
"""Steps of one way up, at least and at most."""
TICK_S = 5e-3
"""Time between the small steps that make a climb."""
FIRST_BANDWIDTH = 50.0
"""K_p / J that the first steps are made for (1/s)."""
HOLD_SHARES = (1.0, 0.6)
HOLD_S, HOLD_TIMES, HOLD_INTEGRAL = (0.04, 0.3), 5.0, 1.5
"""How long a step is held: these many times the time constants of loop and integral; less in every other way."""
SETTLE_S, REST_AT_LOW_S, LEAST_S = 0.8, 0.4, 2.4
SETTLE_TIMES, LONGEST_S = 8.0, 4.0
"""Time constants of the integral for which the first speed is held, and at most how long; half of them at half gain.
With six of them K_p of a Nanotec PD4-C (1226) seemed to move by 20 % with the integral part."""
LONGER = 2
"""Times as long the records last that scales rest on, where the current that is asked for is not shown, and where
shorter ones did not decide: in these ripple moved K_i by 3 to 10 %."""
PULSES, PULSE_JUMP, PULSE_LEAST = 4, 0.4, 0.25
"""How many torque pulses; their jump of the reference, of the speeds between which it climbs (a loop whose integral
winds up goes as far beyond it); their least current, of that of the steps."""
PULSE_TIMES, PULSE_SHOWN_S = 3.0, 0.02
"""How long a pulse lasts: time constants of the current loop's integral, and time beside them (s)."""
TIMES = {"lag": "the loop's lag", "late": "the delay of a reference", "age": "the age of the current"}
LEAST_AT_REST = 40
"""Samples before the first step that the noise is read from."""
SPEED_SHARE, UNLIMITED_SHARE = 0.4, 0.8
"""Speed limit where none is asked for, of the machine's largest speed; where the drive has none of its own, of that and
of the speed at which the EMF takes the whole voltage. With 0.4 the free shafts of three catalogue motors, which the
rated torque accelerates by 20 000 to 50 000 rad/s2, had 3 to 11 % of their current, and friction took most of that."""
DURATION_S = 180.0
SEEN_S = 0.03
"""A speed beyond its limit is seen in the samples, and the voltage off, within this time."""
REST_S, REST_RAD = 0.3, 2e-3
ROUNDING = 1.0 / math.sqrt(12.0)


@dataclass(frozen=True, slots=True)
class LearnedLoop:
    """Everything that was measured: loops with the drive's own gains, and with each changed (None: not changed)."""

    base: Sequence[Observation]
    gain_changed: Observation | None
    integral_changed: Sequence[Observation]
    speed_unit_rad_s: float
    notes: Sequence[str]
    by_asked: bool = False
    """Whether everything rests on the current that the loop asks for; else on the one that flows."""


Decided = Callable[[LearnedLoop], bool]
"""Whether what was measured decides the unit of every gain that it can decide."""


def high_share(node: DriveNode) -> float:
    """Return the largest speed of the steps, of the speed limit."""
    return HIGH_SHARE if limits_speed(node) else HIGH_UNLIMITED


def trip_share(node: DriveNode) -> float:
    """Return the speed at which the samples remove the voltage, of the speed limit."""
    return OVERSHOOT if limits_speed(node) else TRIP_UNLIMITED


def largest_speed(node: DriveNode, file: MachineFile) -> float:
    """Return the speed limit where none is asked for (rad/s)."""
    machine, top = file.machine, rad_s_from_rpm(file.machine.top_rpm or 0.0)
    if limits_speed(node):
        return SPEED_SHARE * top
    flux = machine.pole_pairs * machine.psi_f_wb
    return UNLIMITED_SHARE * (min(top, file.inverter.U_dc_v * LINEAR_UTILISATION / flux) if flux > 0.0 else top)


def share_of_current(node: DriveNode, acceleration: float | None, room_rad_s: float, seen_s: float) -> float:
    """Return the largest share of a current with which the shaft needs ``seen_s`` (s) for a rise by ``room_rad_s``.

    ``acceleration``: what the whole current gives (rad/s2); None: not known, and nothing is cut.

    The drive's own loop keeps the speed, also when the tool is dead; this is for a loop that runs away, until it is
    seen and the voltage off. A drive with a speed limit of its own keeps it; of any other the current is cut.
    """
    if limits_speed(node) or acceleration is None:
        return 1.0
    return min(1.0, room_rad_s / (acceleration * seen_s))


def learning_envelope(
    drive: SpeedLoopDrive,
    file: MachineFile,
    i_max_apk: float | None,
    speed_max_rad_s: float | None,
    shaft: Shaft | None,
    load: Load,
    brake: Brake,
) -> Envelope:
    """Return the limits within which gains are learned, from what was asked for."""
    machine = file.machine
    speed_max = speed_max_rad_s or largest_speed(drive.node, file)
    i_max = i_max_apk or min(drive.rated_apk, drive.shows_apk)
    room = (MOST - TRIP_UNLIMITED) * speed_max
    i_max *= share_of_current(drive.node, largest_acceleration(machine, i_max), room, SEEN_S)
    return Envelope(
        i_max_apk=i_max, speed_max_rad_s=speed_max, duration_s=DURATION_S, shaft=shaft or "free", load=load,
        brake=brake, acceleration_rad_s2=largest_acceleration(machine, i_max),
        voltage_speed_rad_s=voltage_speed(file, i_max),
    )  # fmt: skip


def _refuse_turning(drive: SpeedLoopDrive) -> None:
    first = drive.live("theta_m_rad")
    drive.node.connection.wait(REST_S)
    if abs(drive.live("theta_m_rad") - first) > REST_RAD:
        raise SafetyRefusal(
            "the shaft turns although the drive is off", where=f"node {drive.node.node}",
            likely="it is moved from outside", hint="bring it to rest",
        )  # fmt: skip


def learn_speed_loop(
    drive: SpeedLoopDrive,
    gain: GainObject,
    integral: GainObject,
    envelope: Envelope,
    emf: Emf,
    say: Callable[[str], None],
    decided: Decided = lambda measured: True,
) -> LearnedLoop:
    """Measure the speed loop with the drive's own gains and with each changed; the drive is as before on return.

    What is not ``decided`` by short records is measured once more, by longer ones.

    Raises SafetyRefusal, LimitExceeded: refused, or the loop began to oscillate: the voltage is off and the gains are
    back; NotAvailable: the drive does not follow its velocity mode, or a gain cannot be changed.
    """
    refuse_unsafe(drive.node, envelope)
    _refuse_turning(drive)
    with changing(drive, (gain, integral), envelope, say) as (guard, put):
        drive.send_samples()
        with contextlib.ExitStack() as last:
            last.callback(drive.end_samples)
            drive.fastest_rad_s = envelope.speed_max_rad_s * trip_share(drive.node)
            last.callback(guard.quick_stop)
            return _Learner(guard, drive, put, emf, say).run(gain, integral, decided)


def _margin(own: Observation, worst: tuple[float, float]) -> float:
    """Return the least phase margin (rad) where K_p and K_i may have changed by these ratios, whatever the form.

    The inverter's dead time makes less of K_p at a small current, so that of the response counts, too. A current loop
    has an integral, so that K_i keeps what is asked for: that one is used where it is known.
    """
    K_i, lag_s = own.loops[-1].K_i_per_J, max(loop.lag_s for loop in own.loops)
    return min(
        phase_margin_rad(loop.K_p_per_J * p, K_i * i, lag_s)
        for loop in own.loops for p in (1.0, worst[0]) for i in (1.0, worst[0], worst[1])
    )  # fmt: skip


def _smaller(base: Observation, after: Observation, ratio: float) -> float | None:
    """Return in which ratio counts must change to make K_i smaller; None where that is not sure.

    K_i / K_p must show it, for the fit tells K_i and K_p apart least; K_i must not show the contrary.
    """
    own, changed = list(zip(base.loops, after.loops, strict=False))[-1]
    sure = SURE * abs(math.log(ratio))
    K_i = math.log(changed.K_i_per_J / own.K_i_per_J)
    relative = K_i - math.log(changed.K_p_per_J / own.K_p_per_J)
    if relative < -sure and K_i < 0.5 * sure:
        return FURTHER_DOWN
    return 1.0 / FURTHER_DOWN if relative > sure and K_i > -0.5 * sure else None


def _by_asked(measured: LearnedLoop) -> LearnedLoop:
    """Return everything as the current that was asked for shows it."""
    return replace(
        measured, base=[one.by_asked() for one in measured.base],
        gain_changed=measured.gain_changed and measured.gain_changed.by_asked(),
        integral_changed=[one.by_asked() for one in measured.integral_changed], by_asked=True,
    )  # fmt: skip


def staircase(
    low: float, step: float, number: int, bandwidth: float, hold_s: float, least_s: float = LEAST_S
) -> tuple[list[float], list[tuple[float, float]]]:
    """Return speeds (rad/s), one per tick, that rise from ``low`` by steps on a ramp, and when the ways up are (s).

    ``bandwidth``: K_p / J of the loop (1/s); ``least_s``: how long it lasts at least.
    """
    tick = step * bandwidth * TICK_S
    speeds = [low] * round(REST_AT_LOW_S / TICK_S)
    ways: list[tuple[float, float]] = []
    while len(speeds) * TICK_S < least_s or not ways:
        ticks = max(1, round(HOLD_SHARES[len(ways) % 2] * hold_s / TICK_S))
        begin = len(speeds) - 1
        speeds += [low + step * (k // ticks + 1) + CLIMB * tick * (k + 1) for k in range(number * ticks)]
        ways.append((TICK_S * begin, TICK_S * len(speeds)))
        while speeds[-1] > low:
            speeds.append(max(low, speeds[-1] - RETURN * tick))
        speeds += [low] * ticks
    return speeds, ways


class _Learner:
    """One run; the guard has the drive."""

    def __init__(
        self,
        guard: GuardedDrive,
        drive: SpeedLoopDrive,
        put: Put,
        emf: Emf,
        say: Callable[[str], None],
    ) -> None:
        self.guard, self.drive, self.put, self.emf, self.say = guard, drive, put, emf, say
        limit = guard.envelope.speed_max_rad_s
        self.low, self.span = LOW_SHARE * limit, (high_share(drive.node) - LOW_SHARE) * limit
        self.bandwidth, self.hold_s, self.settle_s = FIRST_BANDWIDTH, HOLD_TIMES / FIRST_BANDWIDTH, SETTLE_S
        self.notes: list[str] = []
        self.shares: list[float] = []
        self.apart = 0.0
        self.asks = self.long = False
        self.step_current_a = 0.0, math.inf
        self.unit = math.nan
        self.first: SpeedLoop | None = None

    def run(self, gain: GainObject, integral: GainObject, decided: Decided) -> LearnedLoop:
        """Measure everything; with longer records once more where everything was changed and that did not decide."""
        step, counts = self.prepare(gain, integral)
        prepared = list(self.notes)
        measured = self.observe(gain, integral, step, counts)
        if not self.long and measured.gain_changed and measured.integral_changed and not decided(measured):
            self.long, self.notes = True, prepared
            measured = self.observe(gain, integral, step, counts)
        return measured

    def prepare(self, gain: GainObject, integral: GainObject) -> tuple[float, dict[str, float]]:
        """Return the step (rad/s) that suits the loop, and the counts of its gains, by name."""
        guard, drive = self.guard, self.drive
        guard.enable()
        self.unit = find_speed_unit(guard, drive, 0.5 * guard.envelope.speed_max_rad_s)
        self.say(
            f"one count of 0x60FF is {self.unit:.5g} rad/s; the steps are taken between {self.low:.4g} and "
            f"{self.low + self.span:.4g} rad/s"
        )
        counts = {GAIN: gain.counts, INTEGRAL: integral.counts}
        step = self._size(FIRST_STEP * self.span)
        own = self._observe("with the drive's own gains", step, counts)
        self.bandwidth = own.loops[-1].K_p_per_J
        integral_s = self.bandwidth / own.loops[-1].K_i_per_J
        self.settle_s = min(max(SETTLE_S, SETTLE_TIMES * integral_s), LONGEST_S)
        wanted_s = max(HOLD_TIMES / self.bandwidth, HOLD_INTEGRAL * integral_s)
        self.hold_s = min(max(wanted_s, HOLD_S[0]), HOLD_S[1])
        self.first, step = own.loop, self._size(step)
        self.long = not self.asks
        if not self.asks:
            self._show_current_loop(step)
        return step, counts

    def observe(self, gain: GainObject, integral: GainObject, step: float, counts: Mapping[str, float]) -> LearnedLoop:
        """Measure the loop with its own gains, with half of the step, and with each gain changed."""
        drive = self.drive
        own = self._observe(f"with steps held for {1e3 * self.hold_s:.0f} ms", step, counts, self.first)
        drive.oscillation.limit_a = TRIP * max(drive.oscillation.largest_a, drive.current_count_a)
        half = self._observe("with steps of half the size", 0.5 * step, counts, own.loop, own.loop.lag_s)
        down = DOWN if _margin(own, (DOWN, DOWN)) >= LEAST_MARGIN_DOWN_RAD else GAIN_LITTLE_DOWN
        gain_changed = self._changed(gain, down, own, (down, down), step, counts)
        little = _margin(own, (1.0, 1.0 / INTEGRAL_DOWN)) < LEAST_MARGIN_RAD
        ratio = LITTLE_DOWN if little else INTEGRAL_DOWN
        integral_changed = [self._changed(integral, ratio, own, (1.0, 1.0 / ratio), step, counts)]
        further = None if integral_changed[0] is None else _smaller(own, integral_changed[0], ratio)
        if further is not None:
            integral_changed.append(self._changed(integral, further, own, (1.0, FURTHER_DOWN), step, counts))
        found = [observation for observation in integral_changed if observation is not None]
        measured = LearnedLoop((own, half), gain_changed, found, self.unit, self.notes)
        if all(one is None or one.asked for one in (own, half, gain_changed, *found)):
            return _by_asked(measured)
        self.notes.append(
            "the current that the speed loop asks for is not shown, or not surely: the intervals hold what current "
            "loop and dead time may take from it"
        )
        return measured

    @property
    def risen(self) -> float:
        """By how many steps the reference rises in the longest hold, with the step itself."""
        return 1.0 + CLIMB * self.bandwidth * self.hold_s

    def _size(self, step: float) -> float:
        """Return the step of speed whose current is large against friction and small against every limit.

        ``step``: the first one that is tried (rad/s).
        """
        drive, guard = self.drive, self.guard
        wanted = STEP_CURRENT * min(guard.envelope.i_max_apk, drive.current_limit_apk, drive.rated_apk)
        most = self.span / (STEPS[0] * self.risen)
        step = min(step, most)
        for _ in range(TRIES):
            record = self._record(step, most_steps=STEPS[0], least_s=0.0)
            held = float(np.median(record.current_a[record.t_s < record.references[1][0]]))
            self.step_current_a = abs(held), float(np.abs(record.current_a).max())
            shown = np.abs(record.current_a - held)
            ratio = wanted / max(float(shown.max()), drive.current_count_a)
            if ENOUGH < ratio < 1.0 / ENOUGH:
                break
            grown = min(step * min(ratio, GROWN), most)
            if grown == step:
                break
            step = grown
        return step

    def _show_current_loop(self, step: float) -> None:
        """Take from torque pulses what the EMF and the dead time take from the current, where they show it.

        The reference jumps, so that the speed loop asks for all that the drive's own limit allows: that is lowered to
        what a step needs, or to less where the speeds leave no time for it.
        """
        guard, jump = self.guard, PULSE_JUMP * self.span
        lasts_s = PULSE_TIMES / self.emf.corner_rad_s + PULSE_SHOWN_S
        held_a, peak_a = self.step_current_a
        level = min(1.0, jump / (step * (1.0 + self.bandwidth * lasts_s)))
        limit_a = guard.limit_current(held_a + level * (peak_a - held_a)) if level > PULSE_LEAST else None
        if limit_a is None:
            return
        up, down = round((lasts_s + 1.0 / self.bandwidth) / TICK_S), round(self.settle_s / TICK_S)
        rest = [self.low] * round(REST_AT_LOW_S / TICK_S)
        trace = self._taken(rest + ([self.low + jump] * up + [self.low] * down) * PULSES)
        guard.limit_current(math.inf)
        guard.quick_stop()
        t, current = trace.t_s, trace["i_q_a"]
        begins = [at for at, speed in trace.meta["steps"] if speed > self.low + 0.5 * jump]
        parts = [(t > at) & (t < at + up * TICK_S) for at in begins]
        held = np.median(current[t < begins[0]])
        sign = np.sign(np.median(current[np.logical_or.reduce(parts)]) - held)
        above = sign * (current - held) / max(limit_a - sign * held, self.drive.current_count_a)
        shown = fit_pulses([(t[part] - at, above[part]) for at, part in zip(begins, parts, strict=True)], self.emf)
        if shown is not None:
            self.emf = shown
            self.say(
                f"the EMF takes {100 * shown.share:.2g} % of the current of torque pulses, "
                f"{100 * (shown.at_once or 0.0):.0f} % of it flows at once"
            )
        else:
            self.notes.append(
                f"torque pulses at {limit_a:.3g} A contradict the motor file, or did not last: what the EMF takes from "
                "the current is taken from R, L and psi of the file, in a wide interval"
            )
        guard.enable()

    def _taken(self, speeds: Sequence[float]) -> Trace:
        """Record speeds that follow each other tick by tick, from the first one, which is held before."""
        self.guard.command_speed(self.low)
        self.guard.wait(self.settle_s)
        hold = round(TICK_S / self.drive.period_s)
        excitation = Excitation(Shape.BUFFER, Injection.SPEED, 0.0, hold_periods=hold, buffer=speeds)
        return self.guard.record(("theta_m_rad", "i_q_a"), hold * len(speeds), excitation=excitation)

    def _record(self, step: float, most_steps: int = STEPS[1], least_s: float | None = None) -> StepRecord:
        drive = self.drive
        least_s = (LONGER * LEAST_S if self.long else LEAST_S) if least_s is None else least_s
        number = min(most_steps, max(STEPS[0], int(self.span / (step * self.risen))))
        speeds, ways = staircase(self.low, step, number, self.bandwidth, self.hold_s, least_s)
        trace = self._taken(speeds)
        t, position, current = trace.t_s, trace["theta_m_rad"], trace["i_q_a"]
        references = [(float(at), float(value)) for at, value in trace.meta["steps"]]
        still = t < references[1][0]
        if np.count_nonzero(still) < LEAST_AT_REST:
            raise IdentificationError(
                "E_EXCITATION", "too few samples of the steps",
                likely="the bus is busy", hint="leave the bus to this program, then run the command again",
            )  # fmt: skip
        speed, at = np.polyfit(t[still], position[still], 1)
        unit = float(speed) / references[0][1]  # the integral leaves no error: this is the speed that was asked for
        references = [(when, unit * value) for when, value in references]
        count = 2.0 * math.pi / abs(drive.counts_per_turn)
        noise_rad = math.hypot(float(np.std(position[still] - speed * t[still] - at)), ROUNDING * count)
        noise_a = math.hypot(float(np.std(current[still])), ROUNDING * drive.current_count_a)
        return StepRecord(
            t, position, current, references, ways, noise_rad, noise_a, trace.signals.get("i_q_ref_a"),
            trace.meta["asked_later_s"],
        )  # fmt: skip

    def _observe(
        self,
        what: str,
        step: float,
        counts: Mapping[str, float],
        first: SpeedLoop | None = None,
        lag_s: float | None = None,
    ) -> Observation:
        record = self._record(step)
        self.guard.quick_stop()  # a fit takes longer than the drive waits for a heartbeat
        loop = fit_speed_loop(record, self.emf, first, lag_s)
        model_std = NO_DOUBT
        if first is not None and lag_s is None:  # what scales rest on
            most = self.emf.share_std
            shares = (self.emf.share - most, self.emf.share + most)
            low, high = (fit_speed_loop(record, self.emf._replace(share=share), loop) for share in shares)
            placed = lag_doubt(loop, fit_speed_loop(record, self.emf, loop, forward=True))
            K_p, K_i, rate = map(math.hypot, emf_doubt(low, high, most), placed)
            model_std = K_p, K_i, rate
        if lag_s is None:
            self.shares.append(asked_share(record, loop, self.emf))
            self.apart = max(self.apart, held_apart(record))
            self.asks = shows_asked(self.shares, self.emf, self.apart)
        asked = fit_asked_current(record, loop) if self.asks else None
        peak = float(np.abs(record.current_a).max())
        share = peak / self.drive.rated_apk
        found = Observation(counts[GAIN], counts[INTEGRAL], loop, share, model_std, asked, self.emf.at_once)
        margin, seen = math.degrees(_margin(found, (1.0, 1.0))), found.loops[-1]
        self.say(
            f"{what}: K_p/J {seen.K_p_per_J:.4g} 1/s, K_i/K_p {seen.K_i_per_J / seen.K_p_per_J:.3g} 1/s, "
            f"phase margin about {margin:.0f} deg"
        )
        self.guard.enable()
        return found

    def _changed(
        self,
        gain: GainObject,
        ratio: float,
        own: Observation,
        worst: tuple[float, float],
        step: float,
        counts: Mapping[str, float],
    ) -> Observation | None:
        """Change one gain while the voltage is off, measure, and bring it back; None where it must not be changed.

        ``worst`` is by what K_p and K_i may have changed whatever the form: the margin is predicted for each.
        """
        if time := own.loops[-1].at_bound:
            self.notes.append(
                f"{gain.name}: not changed, for the fit of the response ended at the bound of {TIMES[time]}"
            )
            return None
        margin = _margin(own, worst)
        least = LEAST_MARGIN_RAD if max(worst) > 1.0 else LEAST_MARGIN_DOWN_RAD
        if margin < least:
            self.notes.append(
                f"{gain.name}: not changed, for the predicted phase margin is {math.degrees(margin):.0f} deg, below "
                f"{math.degrees(least):.0f}"
            )
            return None
        return while_changed(
            gain, ratio, self.guard, self.put, self.notes,
            lambda what, new: self._observe(what, step, {**counts, gain.name: new}, own.loop, own.loop.lag_s),
        )  # fmt: skip
