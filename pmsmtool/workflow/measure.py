"""The order of the experiments on one drive: each uses what the ones before it found, and leaves its traces.

Noise and phases at five percent of the rated current come first, then resistance and inverter, pole pairs and offset,
inductances at standstill, and last what turns the shaft. Between two experiments the drive is off while what was found
goes into its parameters, so that its own control fits the machine; the guard puts everything back at the end.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from pmsmtool.design.current_loop import imc
from pmsmtool.drive.port import Drive
from pmsmtool.errors import IdentificationError, LimitExceeded
from pmsmtool.estimators.encoder import EncoderResult, check_encoder_counts, estimate_encoder
from pmsmtool.estimators.estimate import SensorTolerance
from pmsmtool.estimators.noise import Noise, estimate_noise
from pmsmtool.estimators.phase_check import PhaseCheck, check_pairs, check_phases
from pmsmtool.estimators.prediction import check_prediction, predict
from pmsmtool.estimators.refusals import refuse
from pmsmtool.estimators.resistance import ResistanceResult
from pmsmtool.experiments import rotation, speed_run, square_injection, standstill
from pmsmtool.trace import Trace
from pmsmtool.workflow import frequency_stage, map_stage, mechanics_stage
from pmsmtool.workflow.evaluate import resistance_of, tolerance_on
from pmsmtool.workflow.half_frequency import measure_at_half_frequency

PHASE_CHECK_SHARE = 0.05
LEVELS = 12
LOWEST_LEVEL = 0.08
"""Lowest DC level of the sweep, of the largest; the low ones serve the inverter curve."""
CURVE_SHARES = (0.02, 0.04)
"""Levels for the inverter curve alone: a speed run at small current lives there."""
TURN_SHARE = 0.15
"""Current that turns the rotor over, of the test current."""
ROTATIONS = ((0.35, 0.015), (0.18, 0.03), (0.09, 0.03))
"""Current, of the test current, and time per step (s) of every try. Above psi/(L_q - L_d) a d current is no stable
position: a reluctance machine follows a smaller vector only, and swings longer on it."""
OFF_THE_VECTOR = ("E_ROTOR_MOVED", "E_POLE_PAIRS")
BIAS_SHARE = 0.5
BIAS_TRIES = 4
BIAS_OFF_RAD = math.radians(6.0)
"""Angle between rotor and bias vector that a load or friction may make (electrical)."""
ALIGN_TRIES = 3
"""Times the frame follows a rotor that was moved by the change of the frame itself."""
NOISE_RIPPLE = 25.0
"""Smallest ripple, peak to peak, in noise of one sample: an inverter's knee biases less than a ripple that drowns."""
BIAS_ON_RAD = math.radians(2.0)
"""The same, of a vector that was put on the rotor's axis: more is motion."""
BIAS_MOST = 0.8
"""Largest bias, of the test current: the ripple comes on top."""
RIPPLE_SHARE = 0.25
RIPPLE_LEAST = 0.2
"""Smallest ripple, of the wanted one, that the inverter's knee may leave: below, noise decides."""
CROSSING = 0.433
"""A ripple on q reaches the phases at half the bias by sqrt(3)/4 of its peak-to-peak value (reference, 3.2)."""
U_SHARE = 0.5
"""Largest injection amplitude, of the largest voltage."""
RUN_BANDWIDTH_RAD_S = 2.0 * math.pi * 120.0
"""Current bandwidth of the runs that turn the shaft, at most a fifteenth of the sampling rate; the flux run may have
more."""
PUSH_SHARE = 0.5
PUSH_SPEED_SHARE = 0.12
PUSH_SAMPLES = 1024
SPEED_LOOP_RAD_S = 25.0
RUN_I_D_SHARE = 0.45
"""Largest d current of the flux run, of the test current: a third of it is still beyond the inverter's knee."""
SATURATED = 1.5
"""Largest ratio of the chord of psi_d over the run's i_d to the rough L_d, which is that of a saturated bias."""
RUN_I_Q_SPEED_SHARE = 0.15
RUN_I_Q_S = 0.08
"""A q current of the flux run may change the speed by this share of the largest in this time."""
REACTANCE_SHARE = 0.25
"""Voltage that the accelerating current may need at the largest speed, of the largest voltage."""
REST_SHARE = 0.02
"""Speed that counts as standstill, of the largest of the flux run."""
EMF_SHARE = 0.8
"""Largest speed of the flux run: back-emf of this share of the largest voltage."""

QUANTITIES = ("R", "L", "psi", "encoder", "poles", "inverter", "mechanics")
"""What is measured unless something is asked for: all that current and speed control need."""
NEEDS: Mapping[str, tuple[str, ...]] = {
    "R": ("levels",),
    "inverter": ("levels",),
    "poles": ("rotation",),
    "encoder": ("levels", "rotation", "square", "speeds"),
    "L": ("levels", "rotation", "square"),
    "psi": ("levels", "rotation", "square", "speeds"),
    "mechanics": ("levels", "rotation", "square", "speeds", "coasting"),
    "map": ("levels", "rotation", "square", "speeds", "map"),
    "frf": ("levels", "rotation", "square", "speeds", "response"),
}
"""Experiments behind each quantity."""
HELD = ("levels", "map")
"""Experiments that a held rotor allows."""


def steps_of(quantities: Iterable[str], held: bool = False) -> set[str]:
    """Return the experiments behind quantities; of a held rotor only those that it allows."""
    steps = {step for quantity in quantities for step in NEEDS[quantity]}
    return steps & set(HELD) if held else steps


@dataclass(frozen=True, slots=True)
class Limits:
    """What the experiments may use.

    Attributes
    ----------
    I_nom_apk : float
        Rated current; the scale of every amplitude (A peak).
    i_max_apk : float
        Largest current of the envelope (A peak).
    omega_max_rad_s : float
        Largest mechanical speed of the envelope (rad/s).
    V_max_v : float
        Largest voltage (V peak).
    """

    I_nom_apk: float
    i_max_apk: float
    omega_max_rad_s: float
    V_max_v: float

    @property
    def I_test_apk(self) -> float:
        """Largest steady current of an experiment: the rated one, or what the envelope leaves."""
        return min(self.I_nom_apk, self.i_max_apk / 1.1)


def clear_ripple(wanted_a: float, bias_a: float, knee_a: float, angle_rad: float = 0.0) -> float:
    """Return the ripple (A peak to peak) that keeps every phase current above the knee, or the least useful one.

    The smallest phase current of a bias at a (small) stator angle is its share cos(60 deg + |angle|).
    """
    smallest = bias_a * math.cos(math.pi / 3.0 + abs(angle_rad))
    return max(RIPPLE_LEAST * wanted_a, min(wanted_a, (smallest - knee_a) / CROSSING))


def bias_and_ripple(I_test_apk: float, ripple_share: float, knee_a: float) -> tuple[float, float]:
    """Return the d bias and the ripple, peak to peak (A), of the square wave.

    No phase current may come into the inverter's knee: bias above 2 (0.433 ripple + knee) (identification reference,
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


COMPENSATION = "inverter.deadtime_compensation"


@dataclass(slots=True)
class Measurement:
    """One run of the experiments.

    Parameters
    ----------
    drive : Drive
        Guarded, and off.
    limits : Limits
        What may be used.
    keep : callable
        Stores a trace under its name as soon as it is there.
    say : callable
        Told one line per experiment.
    ripple_share : float
        Ripple of the injection, peak to peak, of the rated current.
    held : bool
        Whether the shaft is locked.
    half_frequency : bool
        Whether R is measured at half the control frequency, too.
    spent : callable or None
        Seconds energised and copper loss so far (s, J), told after every stage.
    """

    drive: Drive
    limits: Limits
    keep: Callable[[str, Trace], None]
    say: Callable[[str], None]
    ripple_share: float = RIPPLE_SHARE
    held: bool = False
    half_frequency: bool = False
    spent: Callable[[], tuple[float, float]] | None = None

    def run(self, quantities: tuple[str, ...]) -> None:
        """Run what the quantities need.

        Raises
        ------
        IdentificationError
            A trap was seen; nothing more is moved.
        """
        steps = steps_of(quantities, self.held)
        if self.drive.read(COMPENSATION) != 0.0:
            self.drive.write({COMPENSATION: 0.0})  # of an earlier commissioning: the inverter's own error is asked for
        noise = self._zero_current()
        phases = self._phase_check(noise)
        self._predict(noise, phases, steps)
        self._tell_spent()
        start = standstill.PHASE_ANGLES_RAD[-1]
        if "rotation" in steps:
            self._encoder_counts(start, standstill.DC_ANGLE_RAD)
            start = standstill.DC_ANGLE_RAD
        resistance = self._levels(noise, start) if "levels" in steps else None
        self._tell_spent()
        encoder = self._rotation() if "rotation" in steps else None
        self._tell_spent()
        if resistance is not None and encoder is not None:
            inductances = self._square(noise, resistance, encoder) if "square" in steps else None
            self._tell_spent()
            if inductances is not None and "speeds" in steps:
                self._turn(resistance, encoder, inductances)
                self._tell_spent()
                if "coasting" in steps:
                    mechanics_stage.measure_mechanics(self.drive, self.limits, self.keep, self.say)
                    self._tell_spent()
                if "response" in steps:
                    frequency_stage.measure_frequency_response(self.drive, self.limits, self.keep, self.say)
                    self._tell_spent()
        if resistance is not None and "map" in steps:
            map_stage.measure_map(self.drive, self.limits, noise, resistance, self.held, self.keep, self.say)

    def _zero_current(self) -> Noise:
        self.say("noise: currents of the drive at rest")
        trace = standstill.record_zero_current(self.drive)
        self.keep("zero_current", trace)
        return estimate_noise(trace)

    def _tell_spent(self) -> None:
        if self.spent is not None:
            seconds, energy = self.spent()
            self.say(f"  so far energised for {seconds:.1f} s, {energy:.3g} J in the winding")

    def _predict(self, noise: Noise, phases: PhaseCheck, steps: set[str]) -> None:
        """Say how good the numbers will be, and stop here where they cannot be good enough."""
        limits = self.limits
        if "levels" not in steps:
            return
        prediction = predict(
            noise,
            standstill.calm_sequence(self._magnitudes()),
            standstill.LEVEL_WINDOW,
            self.ripple_share * limits.I_test_apk,
            2 * square_injection.SHOT_SAMPLES,
            max(abs(z * i) for z, i in zip(phases.impedance_ohm, phases.currents_a, strict=True)),
            EMF_SHARE * limits.V_max_v * speed_run.SHARES[1],
            tolerance_on(SensorTolerance(), math.sqrt(3.0) * limits.V_max_v),
        )
        self.say(prediction.line())
        check_prediction(prediction)

    def _magnitudes(self) -> list[float]:
        """DC levels that are held with both signs (A)."""
        largest = self.limits.I_test_apk
        ratio = (1.0 / LOWEST_LEVEL) ** (1.0 / (LEVELS - 1))
        magnitudes = [largest * max(LOWEST_LEVEL, (k + 1) / LEVELS) for k in range(LEVELS)]
        magnitudes[:2] = [largest * LOWEST_LEVEL, largest * LOWEST_LEVEL * ratio]
        return sorted(set(magnitudes))

    def _phase_check(self, noise: Noise) -> PhaseCheck:
        i_a = PHASE_CHECK_SHARE * self.limits.I_test_apk
        self.say(f"phases: three vectors of {i_a:.3g} A")
        self.drive.enable()
        trace = standstill.hold_phase_vectors(self.drive, i_a)
        self.keep("phase_vectors", trace)
        return check_phases(trace, noise)

    def _encoder_counts(self, start_rad: float, end_rad: float) -> None:
        trace = standstill.turn_and_look(self.drive, TURN_SHARE * self.limits.I_test_apk, start_rad, end_rad)
        self.keep("first_turn", trace)
        check_encoder_counts(trace)

    def _levels(self, noise: Noise, start_rad: float) -> ResistanceResult:
        largest = self.limits.I_test_apk
        low = [largest * share for share in CURVE_SHARES]
        plan = standstill.LevelPlan(
            standstill.calm_sequence(self._magnitudes(), low),
            turn_a=TURN_SHARE * largest,
            start_rad=start_rad,
        )
        self.say(f"R and inverter: {len(plan.levels_a)} levels up to {largest:.3g} A")
        trace = standstill.hold_levels(self.drive, plan)
        self.keep("levels", trace)
        resistance = resistance_of(trace, noise)
        measure_at_half_frequency(self.drive, plan, resistance, self.half_frequency, self.keep, self.say)
        strongest = max(standstill.PAIR_SHARES) * largest
        self.say(f"pairs of phases: two currents up to {strongest:.3g} A through each")
        pairs = standstill.hold_pairs(self.drive, largest, TURN_SHARE * largest, standstill.DC_ANGLE_RAD)
        self.keep("phase_pairs", pairs)
        check_pairs(pairs, noise, resistance.curve)
        return resistance

    def _rotation(self) -> EncoderResult:
        """Turn the vector; with less current and slower again when the rotor did not stay on it."""
        for share, dwell_s in ROTATIONS:
            plan = rotation.RotationPlan(i_a=share * self.limits.I_test_apk, dwell_s=dwell_s)
            self.say(f"pole pairs, direction, offset: one slow turn each way with {plan.i_a:.3g} A")
            forward, backward = rotation.rotate_vector(self.drive, plan)
            self.keep("rotation_forward", forward)
            self.keep("rotation_backward", backward)
            try:
                return estimate_encoder(forward, backward)
            except IdentificationError as error:
                if error.reason not in OFF_THE_VECTOR or (share, dwell_s) == ROTATIONS[-1]:
                    raise
        raise AssertionError("the last try returns or raises")

    def _square(self, noise: Noise, resistance: ResistanceResult, encoder: EncoderResult) -> tuple[float, float]:
        """Record the shots; return rough inductances (H) from ripple and voltage, enough for a current controller."""
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
        knee = resistance.curve.knee_a(max(0.0, resistance.V_dead_v))
        bias, ripple = bias_and_ripple(limits.I_test_apk, self.ripple_share, knee)
        plan = square_injection.SquarePlan(bias_d_a=bias, ripple_a=ripple, u_max_v=U_SHARE * limits.V_max_v)
        plan = self._hold_stable_bias(plan, encoder, knee, noise)
        rough: list[float] = []
        first_v = None
        for axis in ("d", "q"):
            amplitude = square_injection.find_amplitude(self.drive, plan, axis, first_v)
            first_v = square_injection.NEXT_SHARE * amplitude
            for half_period in plan.half_periods:
                shot = square_injection.inject_square(self.drive, plan, axis, half_period, amplitude)
                self.keep(f"square_{axis}_{half_period}", shot)
            found = square_injection.ripple_of(shot, axis)
            rough.append(amplitude * plan.half_periods[-1] * self.drive.period_s / found)
        self.drive.command_current(0.0, 0.0, fixed_angle_rad=plan.angle_rad)
        return rough[0], rough[1]

    def _hold_stable_bias(
        self, plan: square_injection.SquarePlan, encoder: EncoderResult, knee_a: float, noise: Noise
    ) -> square_injection.SquarePlan:
        """Hold the bias, or as much of it as leaves the rotor's d axis on the vector; returns the plan with it."""
        wanted = plan.ripple_a
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
                if abs(ahead) <= BIAS_ON_RAD:
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
        periods = max(1, round(0.02 / self.drive.period_s))
        theta_M = self.drive.average(("theta_m_rad",), periods)["theta_m_rad"]
        theta_e = encoder.direction * encoder.pole_pairs.value * theta_M - encoder.offset.value
        return math.remainder(theta_e - plan.angle_rad, 2.0 * math.pi)

    # ---- what turns the shaft ---------------------------------------------------------------------

    def _turn(self, resistance: ResistanceResult, encoder: EncoderResult, L: tuple[float, float]) -> None:
        pole_pairs = round(encoder.pole_pairs.value)
        alpha = min(RUN_BANDWIDTH_RAD_S, 1.0 / (15.0 * self.drive.period_s))
        d, q = (imc(resistance.R_measured.value, inductance, alpha) for inductance in L)
        self.drive.disable()
        self.drive.write(
            {
                "motor.L_d_h": L[0],
                "motor.L_q_h": L[1],
                "motor.L_d_app_h": L[0],
                "motor.L_q_app_h": L[1],
                "current.K_p_d_v_per_a": d.K_p,
                "current.K_i_d_v_per_as": d.K_i,
                "current.K_p_q_v_per_a": q.K_p,
                "current.K_i_q_v_per_as": q.K_i,
            }
        )
        self.drive.enable()
        psi, J = self._pushes(resistance, pole_pairs)
        self._speeds(psi, J, pole_pairs, L, resistance.V_dead_v)

    def _pushes(self, resistance: ResistanceResult, pole_pairs: int) -> tuple[float, float]:
        """Push the rotor there and back; return flux linkage (Wb) and inertia (kg m2), good for a speed controller."""
        limits = self.limits
        self.say("flux and inertia, roughly: short pushes both ways")
        target = PUSH_SPEED_SHARE * limits.omega_max_rad_s
        rate = self._acceleration_per_ampere(target, pole_pairs)
        current = PUSH_SHARE * limits.I_test_apk
        decimation = max(1, round(target / (rate * current) / (PUSH_SAMPLES * self.drive.period_s)))
        pushes = [self._push(sign * current, PUSH_SAMPLES, decimation, pole_pairs) for sign in (1.0, -1.0)]
        for k, push in enumerate(pushes):
            self.keep(f"push_{k}", push)
        fastest = max(pushes, key=lambda trace: float(abs(trace["omega_e_rad_s"][-64:].mean())))
        tail = slice(-64, None)
        omega = float(fastest["omega_e_rad_s"][tail].mean())
        i_q = float(fastest["i_q_a"][tail].mean())
        error = resistance.V_dead_v * (1.0 if i_q > 0.0 else -1.0) * 4.0 / math.pi
        psi = (float(fastest["u_q_v"][tail].mean()) - resistance.R_measured.value * i_q - error) / omega
        if not psi > 0.0:
            raise refuse(
                "E_EXCITATION",
                f"the voltage at {omega:.3g} rad/s shows no flux linkage ({psi:.3g} Wb)",
                stage="speed run",
                likely="the pushes were too slow for this inverter's dead time",
                hint="allow a higher --speed-max",
            )
        return psi, 1.5 * pole_pairs * psi / rate

    def _acceleration_per_ampere(self, target: float, pole_pairs: int) -> float:
        """Return the acceleration per ampere (rad/s2/A), from pushes that grow until the shaft answers."""
        current, seconds = 0.1 * self.limits.I_test_apk, 0.02
        for _ in range(8):
            decimation = max(1, round(seconds / (256 * self.drive.period_s)))
            push = self._push(current, 256, decimation, pole_pairs)
            omega = push["omega_e_rad_s"] / pole_pairs
            change = float(omega[-16:].mean() - omega[:16].mean())
            self._push(-current, 256, decimation, pole_pairs)
            if abs(change) > 0.15 * target:
                # from the current that flowed: a slow loop, or a dead time, lets it rise late
                return abs(change) / abs(float(np.sum(push["i_q_a"][8:-8])) * push.period_s)
            if current < 0.4 * self.limits.I_test_apk:
                current *= 2.0
            else:
                seconds *= min(4.0, 0.5 * target / max(abs(change), 1e-3 * target))
        raise refuse(
            "E_EXCITATION",
            "the shaft does not answer a push",
            stage="speed run",
            likely="a locked shaft, a brake that is closed, or an encoder that does not count",
        )

    def _push(self, i_q_a: float, samples: int, decimation: int, pole_pairs: int) -> Trace:
        omega_e = 0.9 * pole_pairs * self.limits.omega_max_rad_s
        return speed_run.push_and_record(self.drive, i_q_a, samples, decimation, omega_e)

    def _speeds(self, psi: float, J: float, pole_pairs: int, L: tuple[float, float], V_dead_v: float) -> None:
        limits = self.limits
        run_i_d = RUN_I_D_SHARE * limits.I_test_apk
        flux = psi + SATURATED * L[0] * run_i_d
        largest = min(limits.omega_max_rad_s / 1.1, EMF_SHARE * limits.V_max_v / (flux * pole_pairs))
        if largest <= 0.0:
            raise LimitExceeded("speed", 0.0, largest, "rad/s")
        # the accelerating current must leave voltage for itself: omega_e L_q i_q stands beside the back-emf
        i_run = min(0.5 * limits.I_test_apk, REACTANCE_SHARE * limits.V_max_v / (largest * pole_pairs * max(L)))
        per_ampere = 1.5 * pole_pairs * psi / J
        i_q = min(0.5 * i_run, RUN_I_Q_SPEED_SHARE * largest / (RUN_I_Q_S * per_ampere))
        # a current that is slow because the inverter's error is steep would not be steady in its window
        loop = speed_run.steady_loop(
            self.drive.read("motor.R_s_ohm"),
            L,
            V_dead_v,
            min(map(min, speed_run.D_SHARES)) * run_i_d,
            self.drive.period_s,
            min(RUN_BANDWIDTH_RAD_S, 1.0 / (15.0 * self.drive.period_s)),
        )
        self._off_and_write(
            {
                "current.K_p_d_v_per_a": loop.K_p_v_per_a[0],
                "current.K_p_q_v_per_a": loop.K_p_v_per_a[1],
                "current.K_i_d_v_per_as": loop.K_i_v_per_as[0],
                "current.K_i_q_v_per_as": loop.K_i_v_per_as[1],
                "motor.psi_f_wb": psi,
                "motor.J_kgm2": J,
                "current.options": 7.0,
                "speed.K_p_nms_per_rad": 2.0 * SPEED_LOOP_RAD_S * J,
                "speed.K_i_nm_per_rad": SPEED_LOOP_RAD_S**2 * J,
                "speed.tau_max_nm": 1.6 * J * per_ampere * i_run,
                "speed.acceleration_rpm_per_s": per_ampere * i_run * 30.0 / math.pi,
            }
        )
        self.drive.enable()
        fastest_rpm = largest * 30.0 / math.pi
        self.say(f"psi_f and fine offset: coasting from up to {fastest_rpm:.0f} rpm, i_d up to {run_i_d:.3g} A")
        plan = speed_run.SpeedPlan(largest, run_i_d, i_q, settle_s=loop.settle_s, first_s=2.0 * loop.settle_s)
        rows = speed_run.coast_through(self.drive, plan, pole_pairs)
        speed_run.reach(self.drive, 0.0, limit_s=1.0, band_rad_s=REST_SHARE * largest * pole_pairs)
        lag_s = 2.0 / self.drive.read("encoder.pll_bandwidth_rad_s")  # its poles are a double one
        facts = {"pole_pairs": pole_pairs, "U_dc_v": math.sqrt(3.0) * limits.V_max_v, "speed_lag_s": lag_s}
        self.keep("speeds", speed_run.speeds_trace(rows, facts))

    def _off_and_write(self, values: Mapping[str, float]) -> None:
        self.drive.disable()
        self.drive.write(values)
