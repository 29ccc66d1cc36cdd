# SPDX-License-Identifier: MIT
"""The inductances' part of an identification: the bias that holds the rotor, and square waves of voltage on it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from pmsmtool.drive.port import Drive
from pmsmtool.estimators.current_sensors import Noise
from pmsmtool.estimators.encoder import EncoderResult
from pmsmtool.estimators.estimate import COVERAGE_FACTOR
from pmsmtool.estimators.injection.angle_dependence import unseen_std
from pmsmtool.estimators.injection.axis_response import SKIP_SAMPLES
from pmsmtool.estimators.injection.inductance import MINIMUM_PERIODS, ROTOR_LIMIT_RAD, rotor_way
from pmsmtool.estimators.resistance import ResistanceResult
from pmsmtool.experiments import square_injection
from pmsmtool.experiments.rotation import turn_vector
from pmsmtool.measurement.limits import Limits
from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace

BIAS_SHARE = 0.5
BIAS_TRIES = 4
BIAS_OFF_RAD = math.radians(20.0)
"""Angle between rotor and bias vector that a load or friction may make (electrical): the frame then goes to the rotor.
Friction at rest 1.6 times the Coulomb torque left 7.9 degrees."""
ALIGN_TRIES = 8
"""Times the frame follows a rotor that was moved by the change of the frame itself."""
NOISE_RIPPLE = 25.0
"""Smallest ripple, peak to peak, in noise of one sample: an inverter's knee biases less than a ripple that drowns."""
BIAS_ON_RAD = math.radians(2.0)
"""The same, of a vector that was put on the rotor's axis: more is motion."""
BIAS_MOST = 0.8
"""Largest bias, of the test current: the ripple comes on top."""
RIPPLE_LEAST = 0.2
"""Smallest ripple, of the wanted one, that the inverter's knee may leave: below, noise decides."""
CROSSING = 0.433
"""A ripple on q reaches the phases at half the bias by sqrt(3)/4 of its peak-to-peak value
(docs/identification.md, 3.2)."""
FURTHER_RAD, FURTHER_STEP_RAD = math.radians(15.0), math.radians(30.0)
"""First further angle of the rotor, and the distance to others that serve as well: every phase carries a quarter of the
bias there, and a quarter of an electrical turn on."""
FURTHER_NEAR_RAD = (math.radians(7.0), math.radians(4.0), math.radians(4.0))
"""Distance from the first, and from a quarter of a turn beyond the last, at which the vector is not corrected any
more."""
UNSEEN_STD = 3e-3
"""Standard deviation of the mean over the angle above which one more is tried, a quarter of a turn on: rotors at
6 and 109 degrees left 0.8 %, at 4 and 114 1.6 %; with the third 0.1 %."""
FURTHER_OFF_RAD = math.radians(9.0)
"""Distance from it at which the rotor may stay: friction held one 6 degrees beside its vector, and let it jump 38."""
FURTHER_TRIES, FURTHER_MOST_RAD = 5, math.radians(20.0)
"""Corrections of the vector that leads it there, and the largest of them."""
FURTHER_TURN_S = 0.12
"""Shortest turn of the vector; a quarter of a turn takes the time of :data:`QUARTER_TURN_S`."""
QUARTER_TURN_S = 0.35
"""The usual time is that of 0.15 of the test current; on the bias a rotor swings 1.8 times as fast."""
FURTHER_LEAD_S = 0.05
"""Lead of a shot there, of a quarter of the samples: the comparison needs a tenth of a percent of L."""
ROUGH_APART = 1.1
"""Longest half period's rough inductance over the smallest: 1.00 to 1.05 on seven motors, 1.2 to 1.9 on three whose
inverter error is most of the voltage."""
LEADS = (1.0, 3.0, 9.0)
"""Leads of a shot, of the usual one, until the rotor stands still in it. The first half wave pushed one by 6 degrees
against friction of 0.2 N m; 0.1 s later it was still on its way back, by 3.1 degrees."""
U_SHARE = 0.5
"""Largest injection amplitude, of the largest voltage."""


def clear_ripple(wanted_a: float, bias_a: float, knee_a: float, angle_rad: float = 0.0) -> float:
    """Return the ripple (A peak to peak) that keeps every phase current above the knee, or the least useful one.

    The smallest phase current of a bias at a (small) stator angle is its share cos(60 deg + |angle|).
    """
    smallest = bias_a * math.cos(math.pi / 3.0 + abs(angle_rad))
    return max(RIPPLE_LEAST * wanted_a, min(wanted_a, (smallest - knee_a) / CROSSING))


def bias_and_ripple(I_test_apk: float, ripple_share: float, knee_a: float) -> tuple[float, float]:
    """Return the d bias and the ripple, peak to peak (A), of the square wave.

    No phase current may come into the inverter's knee: bias above 2 (0.433 ripple + knee) (docs/identification.md,
    3.2). A steep inverter leaves half the test current; a soft one raises the bias, then lowers the ripple.

    Parameters
    ----------
    I_test_apk : float
        Largest steady current (A peak).
    ripple_share : float
        Wanted ripple, peak to peak, of that current.
    knee_a : float
        Phase current at which the measured error curve reaches its plateau (A).
    """
    wanted = ripple_share * I_test_apk
    bias = min(BIAS_MOST * I_test_apk, max(BIAS_SHARE * I_test_apk, 2.0 * (CROSSING * wanted + knee_a)))
    return bias, clear_ripple(wanted, bias, knee_a)


def knee_of(resistance: ResistanceResult) -> float:
    """Return the phase current above which the inverter's error is on its plateau (A).

    A plateau within the interval of R at the largest level is none: such a curve is noise, and any knee fits it. On
    four of six machines without dead time the bias was raised or the ripple lowered for it: L_q was up to 7 % off.
    """
    curve = resistance.curve
    unseen_v = COVERAGE_FACTOR * resistance.R_measured.std * float(curve.i_phase_a[-1])
    return curve.knee_a(resistance.V_dead_v if resistance.V_dead_v > unseen_v else 0.0)


def whole_periods(half_period: int) -> int:
    """Return the least samples of a shot that is evaluated, by its half period (control periods)."""
    return SKIP_SAMPLES + 2 * half_period * MINIMUM_PERIODS


@dataclass(frozen=True, slots=True)
class SquareStage:
    """The shots on one drive, of so many samples; the other fields are those of ``measure.Measurement``.

    With ``quick`` the leads at the first angle are those at the others, a slow square wave takes the place of the
    second, and a rotor near its vector at a further angle is taken as it stands. One that ``swings`` says itself how
    long it takes to get there.
    """

    drive: Drive
    limits: Limits
    keep: Callable[[str, Trace], None]
    say: Callable[[str], None]
    ripple_share: float
    samples: int = square_injection.SHOT_SAMPLES
    held: bool = False
    quick: bool = False
    swings: bool = False

    def measure(self, noise: Noise, resistance: ResistanceResult, encoder: EncoderResult) -> tuple[float, float]:
        """Record the shots; return rough inductances (H) from ripple and voltage, enough for a current controller.

        Returned is the longest half period's, unless a shorter one shows far less: beside a large inverter error it can
        be 1.6 L. At an eleventh of the sampling rate a decoupling by 1.3 L makes the loop unstable, one by 0.8 L slow.
        """
        limits = self.limits
        self.drive.disable()
        self.drive.write(
            {
                "motor.R_s_ohm": resistance.R_measured.value,
                "motor.pole_pairs": encoder.pole_pairs.value,
                "encoder.offset_rad": encoder.offset.value,
                "encoder.reversed": float(encoder.direction < 0),
            }
        )
        self.drive.enable()
        knee = knee_of(resistance)
        bias, ripple = bias_and_ripple(limits.I_test_apk, self.ripple_share, knee)
        plan = square_injection.SquarePlan(bias, ripple, U_SHARE * limits.V_max_v, samples=self.samples)
        plan = replace(plan, lead_s=FURTHER_LEAD_S if self.quick else plan.lead_s)
        plan = self._hold_stable_bias(plan, encoder, knee, noise)
        rough: list[float] = []
        amplitudes: dict[square_injection.Axis, float] = {}
        first_v = None
        axes: tuple[square_injection.Axis, ...] = ("d", "q")
        for axis in axes:
            amplitude = square_injection.find_amplitude(self.drive, plan, axis, first_v)
            first_v = square_injection.NEXT_SHARE * amplitude
            slow, last, least = 0, plan.half_periods[-1], math.inf
            for half_period in plan.half_periods:
                if self.quick and slow:
                    break  # two half periods are enough, and the slow one shows more
                shot = self._shot(f"square_{axis}_{half_period}", encoder, plan, axis, half_period, amplitude)
                L = amplitude * half_period * self.drive.period_s / square_injection.ripple_of(shot, axis)
                least = min(least, L)
                slow = square_injection.slow_half_period(plan, self.drive.period_s, L / resistance.R_measured.value)
            if slow:
                self._shot(f"square_{axis}_{slow}", encoder, plan, axis, slow, amplitude * last / slow)
            rough.append(min(L, ROUGH_APART * least))
            amplitudes[axis] = amplitude
        plan = self._further_angles(plan, encoder, knee, amplitudes)
        self.drive.command_current(0.0, 0.0, fixed_angle_rad=plan.angle_rad)
        return rough[0], rough[1]

    def _further_angles(
        self,
        plan: square_injection.SquarePlan,
        encoder: EncoderResult,
        knee_a: float,
        amplitudes: Mapping[square_injection.Axis, float],
    ) -> square_injection.SquarePlan:
        """Record shots at angles a quarter of an electrical turn apart, as far as the rotor follows the vector."""
        if self.held:
            return plan
        self.say("L_d, L_q over the angle: square waves at more angles of the rotor")
        at = replace(plan, lead_s=FURTHER_LEAD_S, samples=self.samples // 4)
        target, angles = FURTHER_RAD, [self._rotor(encoder, plan.angle_rad)]
        for k, near in enumerate(FURTHER_NEAR_RAD):
            at = self._rotor_to(target, near, at, encoder, elsewhere=not k)
            beside = abs(math.remainder(at.angle_rad, math.pi / 3.0))
            if abs(beside - FURTHER_RAD) > FURTHER_OFF_RAD:
                self.say("  the rotor does not follow the vector to them")
                break
            ripple = clear_ripple(plan.ripple_a, plan.bias_d_a, knee_a, beside)
            for axis, amplitude in amplitudes.items():
                amplitude *= ripple / plan.ripple_a
                self._shot(f"angle_{axis}_{k}", encoder, at, axis, plan.half_periods[0], amplitude)
            angles.append(at.angle_rad)
            if k and unseen_std(angles) < UNSEEN_STD:
                break
            target = at.angle_rad + 0.5 * math.pi
        return at

    def _shot(
        self,
        name: str,
        encoder: EncoderResult,
        plan: square_injection.SquarePlan,
        axis: square_injection.Axis,
        half_period: int,
        amplitude_v: float,
    ) -> Trace:
        """Store a shot, recorded with a longer lead where the rotor still came back from the first half wave in it."""
        samples = max(plan.samples, whole_periods(half_period))  # few samples are enough, few periods are not
        for lead in LEADS:
            at = replace(plan, lead_s=lead * plan.lead_s, samples=samples)
            shot = square_injection.inject_square(self.drive, at, axis, half_period, amplitude_v)
            if rotor_way(encoder.pole_pairs.value * shot["theta_M_rad"]) <= ROTOR_LIMIT_RAD:
                break
        self.keep(name, shot)
        return shot

    def _rotor_to(
        self,
        target_rad: float,
        near_rad: float,
        plan: square_injection.SquarePlan,
        encoder: EncoderResult,
        *,
        elsewhere: bool,
    ) -> square_injection.SquarePlan:
        """Turn the rotor to an angle, the vector as far beyond it as friction asks; the frame then stands on the rotor.

        With ``elsewhere`` a rotor that jumps past it goes on to the next angle that serves. The plan's angle on return
        is that of the rotor (rad electrical).
        """
        vector, wanted = plan.angle_rad, target_rad
        for _ in range(FURTHER_TRIES):
            self._turn(plan, vector, wanted)
            vector = wanted
            rotor = self._rotor(encoder, vector)
            if elsewhere and rotor > target_rad + near_rad:
                target_rad += FURTHER_STEP_RAD
            if abs(rotor - target_rad) <= near_rad:
                break
            wanted = vector + max(-FURTHER_MOST_RAD, min(FURTHER_MOST_RAD, target_rad - rotor))
        if self.quick and abs(rotor - vector) <= BIAS_ON_RAD:
            return replace(plan, angle_rad=vector)
        self._turn(plan, vector, rotor)  # slowly: a frame that jumps there pulls the rotor along
        return replace(plan, angle_rad=self._rotor(encoder, rotor))

    def _turn(self, plan: square_injection.SquarePlan, start_rad: float, end_rad: float) -> None:
        """Turn the bias to an angle, and wait for it."""
        turn_s = max(FURTHER_TURN_S, QUARTER_TURN_S * abs(end_rad - start_rad) / (0.5 * math.pi))
        turn_vector(self.drive, plan.bias_d_a, start_rad, end_rad, None if self.swings else turn_s)
        square_injection.hold_bias(self.drive, replace(plan, angle_rad=end_rad))

    def _rotor(self, encoder: EncoderResult, vector_rad: float) -> float:
        """Electrical angle of the rotor near a vector (rad)."""
        periods = max(1, round(0.02 / self.drive.period_s))
        theta_M = self.drive.average(("theta_m_rad",), periods)["theta_m_rad"]
        theta_e = encoder.direction * encoder.pole_pairs.value * theta_M - encoder.offset.value
        return vector_rad + math.remainder(theta_e - vector_rad, 2.0 * math.pi)

    def _hold_stable_bias(
        self, plan: square_injection.SquarePlan, encoder: EncoderResult, knee_a: float, noise: Noise
    ) -> square_injection.SquarePlan:
        """Hold the bias, or as much of it as leaves the rotor's d axis on the vector; returns the plan with it.

        A rotor that stands on it is shown beside it by what the encoder errs over a turn, wherever the frame goes.
        """
        wanted = plan.ripple_a
        on_rad = BIAS_ON_RAD + encoder.pole_pairs.value * sum(encoder.per_turn_rad)
        floor = NOISE_RIPPLE * noise.sigma_a
        for _ in range(BIAS_TRIES):
            self.say(f"L_d, L_q: square wave on {plan.bias_d_a:.3g} A, {plan.ripple_a:.3g} A peak to peak")
            square_injection.hold_bias(self.drive, plan)
            ahead = self._rotor_ahead(encoder, plan)
            aligned = plan
            for _ in range(ALIGN_TRIES):
                if abs(ahead) > BIAS_OFF_RAD + abs(encoder.lag_rad):
                    break
                # the frame goes to the rotor: a d bias off its axis would pull, and mix the axes
                angle = aligned.angle_rad + ahead
                ripple = max(floor, clear_ripple(wanted, plan.bias_d_a, knee_a, angle))
                aligned = replace(aligned, angle_rad=angle, ripple_a=ripple)
                square_injection.hold_bias(self.drive, aligned)
                ahead = self._rotor_ahead(encoder, aligned)
                if abs(ahead) <= on_rad:
                    return aligned
            wanted, bias = 0.5 * wanted, 0.5 * plan.bias_d_a
            plan = replace(plan, bias_d_a=bias, ripple_a=max(floor, clear_ripple(wanted, bias, knee_a)))
        raise refuse(
            "E_ROTOR_MOVED",
            f"the rotor stands {math.degrees(ahead):.3g} deg (electrical) off the bias vector",
            stage="inductance",
            likely="a load on the shaft, or a machine with much more reluctance than magnet torque",
        )

    def _rotor_ahead(self, encoder: EncoderResult, plan: square_injection.SquarePlan) -> float:
        """Electrical angle of the rotor, with the coarse offset, ahead of the frozen frame (rad)."""
        return self._rotor(encoder, plan.angle_rad) - plan.angle_rad
