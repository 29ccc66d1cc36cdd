# SPDX-License-Identifier: MIT
"""The order of the experiments on one drive: each uses what the ones before it found, and leaves its traces.

Noise and phases at five percent of the rated current come first, then resistance and inverter, pole pairs and offset,
inductances at standstill, and last what turns the shaft. Between two experiments the drive is off while what was found
goes into its parameters, so that its own control fits the machine; the guard puts everything back at the end.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from pmsmtool.drive.port import Drive
from pmsmtool.errors import IdentificationError, PmsmtoolError
from pmsmtool.estimators.current_sensors import Noise, estimate_noise
from pmsmtool.estimators.encoder import (
    JUMP_LIMIT_RAD,
    EncoderResult,
    check_encoder_counts,
    estimate_by_rests,
    estimate_encoder,
)
from pmsmtool.estimators.estimate import SensorTolerance, statistical_half_width
from pmsmtool.estimators.flux.linkage import FluxResult
from pmsmtool.estimators.resistance import ResistanceResult
from pmsmtool.experiments import rotation, speed_run, square_injection, standstill
from pmsmtool.experiments.current_limit import (
    LimitCurrent,
    LimitSpeed,
    not_shown,
    require_limit,
    show_current_limit,
    show_speed_limit,
    unproven,
)
from pmsmtool.experiments.frequency_response import FrequencyPlan
from pmsmtool.experiments.mechanics_run import MechanicsPlan
from pmsmtool.experiments.rotation import turn_vector
from pmsmtool.identification.evaluate import Evaluation, evaluate, flux_of, inductance_of, resistance_of, tolerance_on
from pmsmtool.identification.phase_check import PhaseCheck, at_one_temperature, check_pairs, check_phases
from pmsmtool.identification.prediction import Prediction, check_prediction, line_of, predict
from pmsmtool.identification.request import COUNTS, LEFT_OUT, entry, steps_of
from pmsmtool.identification.value_verdict import BEND_NOTED
from pmsmtool.identification.verdicts import ENDED, not_measured
from pmsmtool.identification.wiring import supply_power
from pmsmtool.machine.parameters import Estimate
from pmsmtool.measurement import flux_map, frequency_response, mechanics
from pmsmtool.measurement.effort import (
    ALL,
    QUICK_NOISE_SAMPLES,
    Effort,
    LevelEffort,
    coasting_for,
    effort_for,
    larger_levels,
)
from pmsmtool.measurement.limits import Limits
from pmsmtool.measurement.mechanics import ShaftForecast, forecast_of
from pmsmtool.measurement.speeds import EMF_SHARE, SpeedStage
from pmsmtool.measurement.square_waves import BIAS_SHARE, SquareStage
from pmsmtool.params.catalogue import BY_NAME
from pmsmtool.trace import Trace

PHASE_CHECK_SHARE = 0.05
TURN_SHARES = (0.15, 0.35, 0.6)
"""Currents that turn the rotor over, of the test current: the first that the encoder shows. A load whose friction takes
15 % of the rated torque keeps the rotor from following the first."""
SATURATED = 0.01
"""Change of the flux linkage, mean of both signs of i_d over the one without, from which on a machine is mapped: 0.03
of the saturated profile, below 0.0035 of linear drives, 0.007 to 0.02 beside 5 % of iron loss."""
BESIDE_RAD = math.radians(15.0)
"""Angle by which the offset of the largest current may differ from that of a rotor that jumps with a smaller one; seen
0 to 2.4 deg, and 43 deg where reluctance turns the rotor off its vector."""
OFF_THE_VECTOR = ("E_ROTOR_MOVED", "E_POLE_PAIRS")
RIPPLE_SHARE = 0.25


_Found = TypeVar("_Found")
COMPENSATION = "inverter.deadtime_compensation"
START_GAIN_SHARE = 1.0 / 15.0
"""Proportional gain before anything is known, of V_max / I_nom: an eighth of the limit of stability (L times 1.05 per
period, for a delay of 1.5) where the rated current drops a tenth of the voltage in L and 30 periods are a turn."""
START_INTEGRAL_RATES_RAD_S = (100.0, 200.0)
"""Integral gain over the proportional one, without an accuracy that is enough and with one."""


def starting_gains(limits: Limits, accuracy: float | None = None) -> dict[str, float]:
    """Return gains from the ratings alone; a drive may hold those of another motor, far too weak or unstable here."""
    K_p = START_GAIN_SHARE * limits.V_max_v / limits.I_nom_apk
    gains = {"K_p_d_v_per_a": K_p, "K_p_q_v_per_a": K_p}
    rate = START_INTEGRAL_RATES_RAD_S[accuracy is not None]
    gains |= {f"K_i_{axis}_v_per_as": rate * K_p for axis in "dq"}
    wanted = {f"current.{name}": gain for name, gain in gains.items()}
    # the loop that holds a bias takes its gain from the inductances
    wanted |= {f"motor.L_{axis}_h": K_p / square_injection.BIAS_BANDWIDTH_RAD_S for axis in "dq"}
    return {name: min(value, BY_NAME[name].maximum) for name, value in wanted.items()}


@dataclass(slots=True)
class Measurement:
    """One run of the experiments."""

    drive: Drive
    """Guarded, and off."""
    limits: Limits
    """What may be used."""
    keep: Callable[[str, Trace], None]
    """Stores a trace under its name as soon as it is there."""
    say: Callable[[str], None]
    """Told one line per experiment; what belongs to it follows indented."""
    ripple_share: float = RIPPLE_SHARE
    """Ripple of the injection, peak to peak, of the rated current."""
    held: bool = False
    """Whether the shaft is locked."""
    accuracy: float | None = None
    """Statistical 95 % half width, relative, of R, L and psi that is enough; None: all is collected."""
    map_if_saturated: bool = False
    """Whether a machine that saturates is mapped without being asked for it."""
    spent: Callable[[], tuple[float, float]] | None = None
    """Seconds energised and copper loss so far (s, J), told after every stage."""
    limit_current: LimitCurrent | None = None
    """Sets the drive's own current limit (A peak) and returns what it keeps; with it the limit is shown to act."""
    limit_speed: LimitSpeed | None = None
    """The same of the speed limit (rad/s)."""
    predicted: Callable[[dict[str, Any]], None] | None = None
    """Told every prediction (``identification/request``) before the machine moves for it."""
    turn_share: float = TURN_SHARES[0]
    """Current that turns the rotor over, of the test current; more where it did not follow."""
    unproven: list[str] = field(default_factory=list)
    """What a report says of limits that could not be shown to act."""
    refused: dict[str, IdentificationError] = field(default_factory=dict)
    _kept: dict[str, Trace] = field(default_factory=dict)
    _effort: Effort = ALL

    def run(self, quantities: tuple[str, ...]) -> None:
        """Run what the quantities need; what is refused (:attr:`refused`) takes along only what depends on it.

        Raises IdentificationError: noise, phases, encoder counts or current sensors: nothing more is moved;
        PmsmtoolError: what else ended the run; :attr:`refused` says so of what was not reached.
        """
        try:
            self._run(quantities)
        except IdentificationError:
            raise
        except (PmsmtoolError, KeyboardInterrupt) as error:
            self.refused[ENDED] = not_measured("before it", error)
            raise

    def _run(self, quantities: tuple[str, ...]) -> None:
        steps = steps_of(quantities, self.held)
        if self.drive.read(COMPENSATION) != 0.0:
            self.drive.write({COMPENSATION: 0.0})  # of an earlier commissioning: the inverter's own error is asked for
        noise = self._zero_current()
        phases = self._phase_check(noise)
        self._predict(noise, phases, steps)
        self._tell_spent()
        start = self._phase_angles[-1]
        if "rotation" in steps:
            self._encoder_counts(start, standstill.DC_ANGLE_RAD)
            start = standstill.DC_ANGLE_RAD
        resistance = self._attempt("R", lambda: self._levels(noise, start)) if "levels" in steps else None
        last = standstill.DC_ANGLE_RAD
        if resistance is not None:
            self._spare_supply()
            last = self._pairs(noise, resistance)
        self._tell_spent()
        encoder = self._attempt("encoder", lambda: self._encoder(last)) if "rotation" in steps else None
        self._tell_spent()
        turned = False
        if resistance is not None and encoder is not None:
            turned = self._driven(noise, resistance, encoder, steps)
        mapped = "map" in steps or (turned and self.map_if_saturated and self._saturates(noise, resistance, encoder))
        if resistance is not None and mapped and (self.held or turned):
            known = resistance
            self._attempt(
                "map",
                lambda: flux_map.measure_map(self.drive, self.limits, noise, known, self.held, self.keep, self.say),
            )
            if turned and encoder is not None:
                self.say("flux linkage after the pulses: two windows of the run over speeds once more")
                rows = speed_run.repeat_fastest_pair(self.drive, self._kept["speeds"], round(encoder.pole_pairs.value))
                self.keep("speeds_after_map", speed_run.speeds_trace(rows, {}))

    def _driven(self, noise: Noise, resistance: ResistanceResult, encoder: EncoderResult, steps: set[str]) -> bool:
        """Run what needs the rotor's angle; whether the machine runs under control by what was found."""
        effort = self._effort
        square = SquareStage(
            self.drive,
            self.limits,
            self._keep_for_later,
            self.say,
            self.ripple_share,
            effort.shot_samples,
            self.held,
            effort.quick,
            effort.turn_s is None,
        )
        inductances = (
            self._attempt("L", lambda: square.measure(noise, resistance, encoder)) if "square" in steps else None
        )
        self._tell_spent()
        if inductances is None or "speeds" not in steps:
            return False
        speeds = SpeedStage(
            self.drive, self.limits, self._keep_for_later, self.say, self._effort.speeds, self._speed_limit
        )

        def enough() -> bool:
            with contextlib.suppress(IdentificationError):
                if self._within(self._flux(resistance).psi_f) or self._computed(self._within_sampled):
                    return True
            self._leave_out(replace(self._effort, speeds=ALL.speeds))
            return False

        plan = self._attempt("psi", lambda: speeds.measure(resistance, encoder, inductances, enough))
        ran = plan is not None
        if plan is not None and "turns" in steps:
            self._attempt("harmonics", lambda: speeds.record_harmonics(plan))
        self._tell_spent()
        if ran and steps & set(mechanics.LATER):
            self._shaft(noise, resistance, encoder, steps)
        return ran

    def _saturates(self, noise: Noise, resistance: ResistanceResult | None, encoder: EncoderResult | None) -> bool:
        """Whether a flux map is due, and said so: by the flux of d currents beside psi_f, or by what L_d changes.

        Where L I is small beside psi_f only the square waves show it; deep saturation of q, which holds the vector's
        bias low, shows in the flux alone.
        """
        if resistance is None or encoder is None:
            return False
        I_nom = self.limits.I_nom_apk

        def changes() -> tuple[float, float]:
            flux = self._flux(resistance)
            known = Evaluation(noise, resistance=resistance, encoder=encoder, flux=flux)
            return flux.curvature, inductance_of(self._kept, known, self._tolerance()).d_change(I_nom)

        try:
            curvature, change = self._computed(changes)
        except IdentificationError:
            return False  # the evaluation says so
        shown = []
        if abs(curvature) >= SATURATED:
            shown.append(f"d currents change the flux of their mean by {100.0 * curvature:+.2g} %")
        if abs(change) >= BEND_NOTED:
            shown.append(f"L_d changes by {100.0 * change:+.2g} % up to {I_nom:.3g} A")
        if shown:
            self.say(f"the machine saturates: {', '.join(shown)}; a flux map is measured")
        return bool(shown)

    def _flux(self, resistance: ResistanceResult) -> FluxResult:
        """Return what the speed run shows, with rough inductances and the drive's own temperature coefficient."""
        rough = float(self.drive.read("motor.alpha_psi_per_k"))
        return flux_of(self._kept, resistance, self.drive.period_s, rough, self._tolerance())

    def _within_sampled(self) -> bool:
        """Whether psi_f is as accurate as was asked once L and the instant of sampling are taken into account.

        With currents that count as sampled in time the half width was 1.05 and 2 % where 0.2 % came out.
        """
        alpha = float(self.drive.read("motor.alpha_psi_per_k"))
        found = evaluate(
            self._kept,
            self.drive.period_s,
            alpha_psi_per_k=alpha,
            U_dc_v=math.sqrt(3.0) * self.limits.V_max_v,
            tolerance=self._tolerance(),
        )
        return found.flux is not None and self._within(found.flux.psi_f)

    def _within(self, estimate: Estimate) -> bool:
        """Whether a value is as accurate as was asked; always without that."""
        return self.accuracy is None or statistical_half_width(estimate) <= self.accuracy * abs(estimate.value)

    def _attempt(self, quantity: str, measure: Callable[[], _Found]) -> _Found | None:
        """Measure; a refusal is kept and said, and the drive is off until the next experiment enables it."""
        try:
            return measure()
        except IdentificationError as refusal:
            self.refused[quantity] = refusal
            self.say(f"  {quantity} refused: {refusal.what}")
            self.drive.disable()
            self.drive.enable()
            return None
        except (PmsmtoolError, KeyboardInterrupt) as error:  # the traces of this experiment are not whole
            self.refused[quantity] = not_measured("during it", error)
            raise

    def _shaft(self, noise: Noise, resistance: ResistanceResult, encoder: EncoderResult, steps: set[str]) -> None:
        """Run what measures the shaft, and say before each how well."""
        forecast = self._computed(lambda: self._forecast(noise, resistance, encoder))
        if "coasting" in steps:
            effort = self._effort
            look_s = speed_run.QUICK_LOOK_S if effort.quick else speed_run.LOOK_S
            values: dict[str, float] = {}

            def chosen(plan: MechanicsPlan) -> MechanicsPlan:
                if forecast is None:
                    return plan
                plan, found = self._computed(lambda: coasting_for(self.accuracy, plan, forecast.mechanics))
                values.update(found)
                return plan

            def planned() -> None:
                if forecast is not None:
                    self.say(f"  {mechanics.mechanics_line(values)}")
                    self._tell(entry("mechanics", values, rough=forecast.rough))

            self._attempt(
                "mechanics",
                lambda: mechanics.measure_mechanics(
                    self.drive, self.limits, self.keep, self.say, chosen, planned, effort.speeds.mechanics_rows, look_s
                ),
            )
            self._tell_spent()
        if "slow" in steps:
            slow = (self.drive, self.limits, self.keep, self.say)
            self._attempt("cogging", lambda: mechanics.measure_cogging(*slow))
            self._tell_spent()
        if "response" in steps:

            def sequence(plan: FrequencyPlan) -> None:
                if forecast is not None:
                    found = self._computed(lambda: forecast.response(plan, self.drive.period_s))
                    self.say(f"  {mechanics.response_line(found)}")
                    at = {f"response_{hz:g}_hz": found.at(hz) for hz in mechanics.AT_HZ}
                    values = {"J_kgm2": found.J, **at}
                    self._tell(entry("frequency response", values, coherent_to_hz=found.highest_hz))

            self._attempt(
                "frf",
                lambda: frequency_response.measure_frequency_response(
                    self.drive, self.limits, self.keep, self.say, sequence
                ),
            )
            self._tell_spent()

    def _computed(self, compute: Callable[[], _Found]) -> _Found:
        """Compute with the drive off: it takes 0.2 to 3 s, and an energised drive waits 0.35 s for a heartbeat."""
        self.drive.disable()
        try:
            found = compute()
        except IdentificationError:
            self.drive.enable()
            raise
        self.drive.enable()
        return found

    def _forecast(self, noise: Noise, resistance: ResistanceResult, encoder: EncoderResult) -> ShaftForecast | None:
        """Return what is known of the shaft so far; None, and said, where its traces are refused."""
        try:
            return forecast_of(self.drive, self._kept, noise, resistance, encoder, self._tolerance())
        except IdentificationError as error:
            self.say(f"  {mechanics.not_predicted(error)}")
            self._tell(entry("mechanics", {}, reason=str(error)))
            return None

    def _tolerance(self) -> SensorTolerance:
        return tolerance_on(SensorTolerance(), math.sqrt(3.0) * self.limits.V_max_v)

    def _tell(self, prediction: dict[str, Any]) -> None:
        if self.predicted is not None:
            self.predicted(prediction)

    def _keep_for_later(self, name: str, trace: Trace) -> None:
        self._kept[name] = trace
        self.keep(name, trace)

    def _zero_current(self) -> Noise:
        self.say("noise: currents of the drive at rest")
        samples = standstill.NOISE_SAMPLES if self.accuracy is None else QUICK_NOISE_SAMPLES
        trace = standstill.record_zero_current(self.drive, samples)
        if math.isfinite(self.limits.counts_per_turn):
            trace = replace(trace, meta={**trace.meta, COUNTS: self.limits.counts_per_turn})
        self._keep_for_later("zero_current", trace)
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
        dead_time_v = max(abs(z * i) for z, i in zip(phases.impedance_ohm, phases.currents_a, strict=True))

        def predicted(effort: Effort) -> Prediction:
            return predict(
                noise,
                effort.levels.sequence(limits.I_test_apk),
                effort.levels.window,
                self.ripple_share * limits.I_test_apk,
                2 * effort.shot_samples,
                dead_time_v,
                EMF_SHARE * effort.speeds.speed_share * limits.V_max_v * speed_run.SHARES[1],
                self._tolerance(),
            )

        self._effort = effort_for(self.accuracy, predicted)
        values = predicted(self._effort).values(steps)
        self.say(f"  {line_of(values)}")
        later = mechanics.later_line(steps)
        if later:
            self.say(f"  {later}")
        self._tell(entry("levels", values, later=[what for step, what in mechanics.LATER.items() if step in steps]))
        self._leave_out(self._effort)
        check_prediction(values)

    def _leave_out(self, effort: Effort) -> None:
        """Take an effort as what is collected, and tell what it leaves out."""
        self._effort, self.turn_share = effort, max(self.turn_share, effort.turn_share)
        if self.accuracy is not None:
            self._tell(entry("", {}, **{LEFT_OUT: effort.left_out}))

    @property
    def _phase_angles(self) -> tuple[float, ...]:
        return standstill.PHASE_ANGLES_RAD if self.accuracy is None else standstill.NEAR_ANGLES_RAD

    def _phase_check(self, noise: Noise) -> PhaseCheck:
        i_a = PHASE_CHECK_SHARE * self.limits.I_test_apk
        self.say(f"phases: three vectors of {i_a:.3g} A")
        self.drive.enable()
        trace = standstill.hold_phase_vectors(self.drive, i_a, self._phase_angles)
        self._keep_for_later("phase_vectors", trace)
        found = check_phases(trace, noise)
        if self.limit_current is not None:
            limits, angle = self.limits, self._phase_angles[-1]
            shown = show_current_limit(self.drive, self.limit_current, limits.I_nom_apk, limits.i_max_apk, angle)
            self.say(f"  {shown or not_shown()}")
            require_limit(shown)
            self.unproven += filter(None, [unproven(shown)])
        return found

    def _speed_limit(self, largest_rad_s: float, pole_pairs: int) -> None:
        """Show that the drive keeps its own speed limit, before the run that relies on it."""
        if self.limit_speed is not None:
            quick = self._effort.quick
            shown = show_speed_limit(self.drive, self.limit_speed, largest_rad_s, pole_pairs, quick=quick)
            self.say(f"  {shown or not_shown('speed')}")
            require_limit(shown)
            self.unproven += filter(None, [unproven(shown, "speed")])
            self.limit_speed = None  # once is enough

    def _encoder_counts(self, start_rad: float, end_rad: float) -> None:
        if self._effort.quick:
            with contextlib.suppress(IdentificationError):  # the rotor follows the vectors of the phases already
                check_encoder_counts(self._kept["phase_vectors"])
                return
            start_rad = self._phase_angles[0]
        for share in TURN_SHARES:
            self.turn_share = max(share, self._effort.turn_share)
            current = share * self.limits.I_test_apk
            trace = standstill.turn_and_look(self.drive, current, start_rad, end_rad, self._effort.turn_s)
            with contextlib.suppress(IdentificationError):
                check_encoder_counts(trace)
                break
        self.keep("first_turn", trace)
        check_encoder_counts(trace)

    def _levels(self, noise: Noise, start_rad: float) -> ResistanceResult:
        """Hold levels; a sweep of less effort that is refused, or not as good as was asked, is followed by the next."""
        efforts = (self._effort.levels, *larger_levels(self._effort.levels)[:1])
        for effort in efforts:
            plan = self._level_plan(effort, start_rad)
            self.say(f"R and inverter: {len(plan.levels_a)} levels up to {self.limits.I_test_apk:.3g} A")
            trace = standstill.hold_levels(self.drive, plan)
            start_rad = float(trace.signals.get("theta_imposed_rad", [plan.angle_rad])[-1])
            self._keep_for_later("levels", trace)
            if effort is efforts[-1] or self._enough_levels(trace, noise):
                break
            self.say("  the accuracy asked for is not reached: more levels")
            self._leave_out(replace(self._effort, levels=efforts[-1]))
            self._spare_supply()  # the winding is warmer by now: what the link just bore can trip it
        return resistance_of(trace, noise)

    def _enough_levels(self, trace: Trace, noise: Noise) -> bool:
        if trace["flagged"][-1] > 0.0:
            return True  # the estimator refuses it; nothing is held once more
        try:
            return self._within(resistance_of(trace, noise, tolerance=self._tolerance()).R_s)
        except IdentificationError:
            return False

    def _level_plan(self, effort: LevelEffort, start_rad: float) -> standstill.LevelPlan:
        largest = self.limits.I_test_apk
        return standstill.LevelPlan(
            effort.sequence(largest, [largest * share for share in effort.low]),
            turn_a=self.turn_share * largest,
            start_rad=start_rad,
            window_periods=effort.window,
            settle_s=effort.settle_s,
            drift=effort.drift,
            turn_s=self._effort.turn_s,
            quick=self._effort.quick,
        )

    def _spare_supply(self) -> None:
        """Ask no more of a supply that gives way than what keeps the DC link up, from here on."""
        supply_w, held_w = supply_power(self._kept["zero_current"], self._kept["levels"])
        if supply_w < math.inf:
            self.limits = self.limits.on_supply(supply_w, held_w)
            self.say(
                f"  the DC link gives way under {held_w:.3g} W: what follows takes at most {supply_w:.3g} W, "
                f"{self.limits.I_test_apk:.3g} A at standstill"
            )

    def _pairs(self, noise: Noise, resistance: ResistanceResult) -> float:
        """Compare the phases; return the vector that was held last (rad electrical).

        Current sensors that differ spoil every value, so that ends the run.
        """
        largest = self.limits.I_test_apk
        currents = standstill.PAIR_SHARES[0] * largest, standstill.PAIR_SHARES[1] * largest
        lost_v = np.diff(resistance.curve.vector_error_v(np.array(currents)))[0]
        if lost_v > resistance.R_measured.value * (currents[1] - currents[0]):
            # in the knee of the inverter's curve, of which a chord between two levels is no part
            currents = standstill.pair_currents(self._kept["levels"].meta["i_command_a"], largest)
        self.say(f"pairs of phases: two currents up to {currents[1]:.3g} A through each")
        turn_a, turn_s, quick = self.turn_share * largest, self._effort.turn_s, self._effort.quick
        start = float(self._kept["levels"]["theta_imposed_rad"][-1]) if quick else standstill.DC_ANGLE_RAD
        half = int(self._kept["levels"].meta["samples"]) // 2 if quick else None
        pairs = standstill.hold_pairs(self.drive, currents, turn_a, start, turn_s, quick=quick, half=half)
        self._keep_for_later("phase_pairs", pairs)
        check_pairs(at_one_temperature(pairs, resistance), noise, resistance.curve)
        return start + (2.0 * standstill.PAIR_STEP_RAD if quick else standstill.PHASE_ANGLES_RAD[-1])

    def _encoder(self, start_rad: float) -> EncoderResult:
        """Take the rests for pole pairs, direction and offset, or turn slowly; the rotor is left near angle zero."""
        if self._effort.quick and "phase_pairs" in self._kept:
            try:
                found = estimate_by_rests(self._kept["levels"], self._kept["phase_pairs"])
            except IdentificationError as refusal:
                self.say(f"  {refusal.what}: the shaft is turned")
            else:
                self.say("pole pairs, direction, offset: from the rests on the vectors")
                end = 2.0 * math.pi * round(start_rad / (2.0 * math.pi))
                turn_vector(self.drive, BIAS_SHARE * self.limits.I_test_apk, start_rad, end, self._effort.turn_s)
                return found  # the bias of the square waves waits for the rotor
        return self._rotation(start_rad)

    def _rotation(self, start_rad: float) -> EncoderResult:
        """Turn the vector from where it was last; with less current and slower again when the rotor was not on it.

        Where cogging lets it jump with every current but the largest, or with all, the quietest of the jumping ones
        serves: on the largest current a rotor with much reluctance rests beside the vector.
        """
        jumped: list[tuple[EncoderResult, tuple[Trace, Trace]]] = []
        for share, step_rad, dwell_s, ramp_s in self._effort.rotations:
            step, dwell = rotation.step_within(step_rad, dwell_s, self.limits.omega_max_rad_s)
            plan = rotation.RotationPlan(share * self.limits.I_test_apk, step, dwell, ramp_s=ramp_s)
            how = "" if dwell is not None else ", led by the rotor's own swings"
            self.say(f"pole pairs, direction, offset: one slow turn each way with {plan.i_a:.3g} A{how}")
            turns = rotation.rotate_vector(self.drive, plan, start_rad=start_rad)
            self._keep_turns(turns)
            start_rad = 0.0  # where a turn ends
            last = share == self._effort.rotations[-1][0]
            try:
                found = estimate_encoder(*turns)
            except IdentificationError as error:
                if error.reason not in OFF_THE_VECTOR and dwell is not None:  # swings end after a time, turned or not
                    raise
                with contextlib.suppress(IdentificationError):
                    jumped.append((estimate_encoder(*turns, JUMP_LIMIT_RAD), turns))
                if last and not jumped:
                    raise
                continue
            if not (last and jumped and beside_the_vector(found, jumped[0][0])):
                if dwell is None:
                    self._effort = replace(self._effort, turn_s=None)
                return found
        found, turns = min(jumped, key=lambda one: one[0].offset.std)
        self.say(f"  the rotor jumps behind the vector (cogging?): offset +-{math.degrees(found.offset.std):.2g} deg")
        self._keep_turns(turns)
        return found

    def _keep_turns(self, turns: tuple[Trace, Trace]) -> None:
        self._keep_for_later("rotation_forward", turns[0])
        self._keep_for_later("rotation_backward", turns[1])


def beside_the_vector(strong: EncoderResult, weak: EncoderResult) -> bool:
    """Whether a larger current put the rotor to another angle of its vector than a smaller one."""
    return abs(math.remainder(strong.offset.value - weak.offset.value, 2.0 * math.pi)) > BESIDE_RAD
