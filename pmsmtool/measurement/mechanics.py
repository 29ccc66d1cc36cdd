# SPDX-License-Identifier: MIT
"""The pushes for inertia and friction: sized and recorded, and before them how good these and a response will be.

Before the first push nothing is known of the shaft, so that nothing can be predicted of it. Afterwards the rough
inertia, how the shaft slows down between the windows of the speed run, the flux linkage's own deviation and the plan
tell (``identification/prediction``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import count
from typing import TYPE_CHECKING

from pmsmtool.drive.port import Drive
from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.current_sensors import Noise
from pmsmtool.estimators.encoder import EncoderResult
from pmsmtool.estimators.estimate import SensorTolerance
from pmsmtool.estimators.resistance import ResistanceResult
from pmsmtool.estimators.shaft.frequency_response import INERTIA_FLOOR
from pmsmtool.estimators.shaft.position import encoder_step
from pmsmtool.experiments import frequency_response, mechanics_run, speed_run
from pmsmtool.experiments.mechanics_run import MechanicsPlan
from pmsmtool.identification import prediction
from pmsmtool.identification.cogging import SLOW_TRACE
from pmsmtool.identification.evaluate import flux_of
from pmsmtool.identification.frequency_response import small_signal_doubt
from pmsmtool.identification.mechanics import SAMPLE_DOUBT, TRACE, torque_doubt
from pmsmtool.identification.prediction import RoughShaft, line_of
from pmsmtool.machine.torque import torque_per_ampere
from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace
from pmsmtool.units import rad_s_from_rpm, rpm_from_rad_s

if TYPE_CHECKING:
    from pmsmtool.measurement.limits import Limits

AT_HZ = (200.0,)
"""Frequencies at which the deviation of the response is told: far below, torque that nobody knows of decides."""
LATER: Mapping[str, str] = {"coasting": "J, B, tau_c", "response": "frequency response"}
"""What of a run's experiments cannot be predicted before the first push."""


def later_line(steps: set[str]) -> str:
    """Return what is said of the quantities of a shaft before anything of it is known; empty where none is asked."""
    asked = [what for step, what in LATER.items() if step in steps]
    if not asked:
        return ""
    return (
        f"not predictable yet: {', '.join(asked)}; the inertia is not known before the first torque pulse; the "
        "prediction follows before the shaft is moved for them"
    )


@dataclass(frozen=True, slots=True)
class ShaftForecast:
    """What is known of the shaft after the rough pushes."""

    shaft: RoughShaft
    """Inertia by the pushes, friction by the run over speeds."""
    sigma_a: float
    doubt: float
    """Noise of one sample (A), and relative standard deviation of the torque's scale but for the samples'
    displacement."""
    R_ohm: float
    L_q_h: float
    psi_wb: float
    dead_time_s: float
    pole_pairs: int
    """For that displacement."""
    bandwidth_rad_s: float
    """Of the current loop."""

    @property
    def rough(self) -> dict[str, float]:
        """The rough values by machine-file key."""
        return {"J_kgm2": self.shaft.J, "B_nms": self.shaft.B, "tau_c_nm": self.shaft.tau_c}

    def mechanics(self, plan: mechanics_run.MechanicsPlan) -> dict[str, float]:
        """Return the relative standard deviations that pushes and coasting will have, by machine-file key."""
        pushes = prediction.PushPlan(plan.i_q_a, plan.unit_s, plan.coast_s, mechanics_run.ROWS)
        emf = self.pole_pairs * self.psi_wb * plan.omega_rad_s
        voltages = [self.R_ohm * plan.i_q_a + share * emf for share in (0.0, 0.5, 1.0)]
        displaced = prediction.displaced_share(voltages, self.L_q_h, plan.i_q_a, self.dead_time_s)
        scale = math.hypot(self.doubt, SAMPLE_DOUBT * displaced)
        return prediction.predict_mechanics(self.shaft, pushes, self.sigma_a, scale)

    def response(self, plan: frequency_response.FrequencyPlan, period_s: float) -> prediction.ResponsePrediction:
        """Return what the lines of the frequency response will be good for."""
        sequence = prediction.ResponsePlan(
            plan.i_q_a,
            plan.omega_rad_s,
            plan.hold_periods * period_s,
            plan.decimation * period_s,
            frequency_response.ROWS,
            frequency_response.REPEATS,
            self.bandwidth_rad_s,
        )
        found = prediction.predict_response(self.shaft, sequence, self.sigma_a)
        emf = self.pole_pairs * self.psi_wb * plan.omega_rad_s
        displaced = 0.5 * self.dead_time_s * emf / self.L_q_h
        small = small_signal_doubt(self.sigma_a, displaced, found.deviation_a)
        return replace(found, J=math.hypot(found.J, self.doubt, small, INERTIA_FLOOR))


def forecast_of(
    drive: Drive,
    traces: Mapping[str, Trace],
    noise: Noise,
    resistance: ResistanceResult,
    encoder: EncoderResult,
    tolerance: SensorTolerance,
) -> ShaftForecast:
    """Return what is known before the shaft is moved for its mechanics.

    Raises IdentificationError: the traces say nothing of flux linkage or encoder; the run itself may still.

    Parameters
    ----------
    drive : Drive
        It holds gains, flux linkage, inductances and inertia as the runs before found them.
    traces : mapping of str to Trace
        ``push_0``, ``push_1``, ``speeds`` and the shots of the inductances.
    noise, resistance, encoder, tolerance :
        What the experiments before say, and what is declared.
    """
    pole_pairs = round(encoder.pole_pairs.value)
    J, psi, L_q = (drive.read(f"motor.{name}") for name in ("J_kgm2", "psi_f_wb", "L_q_h"))
    per_a = torque_per_ampere(pole_pairs, psi)
    flux = flux_of(traces, resistance, drive.period_s, drive.read("motor.alpha_psi_per_k"), tolerance)
    B, tau_c = prediction.rough_friction(traces["speeds"], J, per_a, pole_pairs)
    step = encoder_step([traces[name]["theta_M_rad"] for name in ("push_0", "push_1")])
    U_dc_v = float(traces["speeds"].meta["U_dc_v"])
    return ShaftForecast(
        RoughShaft(J, B, tau_c, per_a, step, pole_pairs),
        noise.sigma_a,
        torque_doubt(flux),
        resistance.R_measured.value,
        L_q,
        psi,
        resistance.dead_time_s(U_dc_v, drive.period_s),
        pole_pairs,
        drive.read("current.K_p_q_v_per_a") / L_q,
    )


def mechanics_line(values: Mapping[str, float]) -> str:
    """Return the prediction as a person reads it, and what it does not hold."""
    if not values:
        return "predicted standard deviation: none, the first torque pulses do not determine J, B, tau_c"
    without = [name for key, name in (("B_nms", "B"), ("tau_c_nm", "tau_c")) if key not in values]
    unseen = f"; {', '.join(without)}: the run over speeds shows none to predict it from" if without else ""
    return line_of(values) + unseen


def response_line(predicted: prediction.ResponsePrediction) -> str:
    """Return the prediction of a frequency response as a person reads it."""
    at = ", ".join(f"{100.0 * predicted.at(hz):.2g} % at {hz:g} Hz" for hz in AT_HZ)
    return (
        f"predicted standard deviation: response {at}, coherent up to {predicted.highest_hz:.3g} Hz, J by it "
        f"{100.0 * predicted.J:.2g} %; that of a resonance is known when one is found"
    )


def not_predicted(error: IdentificationError) -> str:
    """Return why there is no prediction."""
    return f"predicted standard deviation: none for the shaft, {error.reason}"


I_SHARE = 0.5
"""Current of the pushes, of the test current."""
SPEED_SHARE = 0.6
"""Speed they aim at, of the largest that back-emf and envelope allow; the friction's share is not known before."""
EMF_SHARE = 0.6
ABORT_SHARE = 0.95
SLOW_SHARE = 0.2
"""Largest speed of the slow turns, of the speed limit."""
REST_SHARE, AFTER_SHARE = 0.02, 0.1
"""Largest speed before the first push, and after the last coasting, of the speed that a push is to reach."""
PLAN_LINE = "torque pulses turn the shaft both ways, and it coasts with the voltage off"


def numbered(drive: Drive, name: str, keep: Callable[[str, Trace], None]) -> Callable[[Trace], None]:
    """Return what keeps trace after trace as ``name`` 0, 1, ... with offset and direction of the drive's encoder."""
    frame = {
        "offset_rad": drive.read("encoder.offset_rad"),
        "direction": -1 if drive.read("encoder.reversed") else 1,
    }
    number = count()

    def keep_part(trace: Trace) -> None:
        keep(f"{name}{next(number)}", replace(trace, meta={**trace.meta, **frame}))

    return keep_part


def measure_mechanics(
    drive: Drive,
    limits: Limits,
    keep: Callable[[str, Trace], None],
    say: Callable[[str], None],
    chosen: Callable[[MechanicsPlan], MechanicsPlan] = lambda plan: plan,
    planned: Callable[[], None] = lambda: None,
    rows: int = mechanics_run.ROWS,
    look_s: float = speed_run.LOOK_S,
) -> None:
    """Run the steps; the drive holds current gains, flux linkage and rough inertia of the runs before.

    ``chosen`` returns what is run of a plan, and ``planned`` is called before anything of it moves the shaft; ``rows``
    is the largest number per push, ``look_s`` the time of a look at the speed.
    """
    pole_pairs = drive.read("motor.pole_pairs")
    psi, J, L_q = (drive.read(f"motor.{name}") for name in ("psi_f_wb", "J_kgm2", "L_q_h"))
    current = I_SHARE * limits.I_test_apk
    largest = min(limits.omega_max_rad_s, EMF_SHARE * limits.V_max_v / (pole_pairs * math.hypot(psi, L_q * current)))
    per_ampere = torque_per_ampere(pole_pairs, psi)
    current, speed = limits.within_supply(current, SPEED_SHARE * largest, per_ampere)
    plan = mechanics_run.plan_mechanics(current, speed, J, per_ampere)
    plan = chosen(replace(plan, rows=rows))
    say(
        f"J, B, tau_c: torque pulses of {plan.i_q_a:.3g} A up to about {rpm_from_rad_s(plan.omega_rad_s):.0f} rpm and "
        f"coasting with the voltage off, {plan.duration_s:.2g} s"
    )
    planned()
    _come_to_rest(drive, pole_pairs * plan.omega_rad_s, look_s)
    keep_part = numbered(drive, TRACE, keep)
    abort = ABORT_SHARE * pole_pairs * limits.omega_max_rad_s
    mechanics_run.push_and_coast(drive, plan, abort, keep_part)
    drive.enable()
    _come_to_rest(drive, pole_pairs * plan.omega_rad_s, look_s, AFTER_SHARE)


def measure_cogging(
    drive: Drive, limits: Limits, keep: Callable[[str, Trace], None], say: Callable[[str], None]
) -> None:
    """Record slow turns; the drive holds the speed controller of the runs before."""
    speed = min(mechanics_run.SPEED_RAD_S, SLOW_SHARE * limits.omega_max_rad_s)
    say(f"cogging: {mechanics_run.TURNS:g} turns each way at {rpm_from_rad_s(speed):.0f} rpm")
    pole_pairs = round(drive.read("motor.pole_pairs"))
    mechanics_run.record_slow_turns(drive, pole_pairs, speed, numbered(drive, SLOW_TRACE, keep))
    # the records are whole: a shaft that does not come to rest is what the next experiment refuses
    speed_run.reach(drive, 0.0, limit_s=1.0, band_rad_s=REST_SHARE * pole_pairs * limits.omega_max_rad_s)


def _come_to_rest(drive: Drive, reached_rad_s: float, look_s: float, share: float = REST_SHARE) -> None:
    """Stop the shaft by the speed controller, from the speed it has or that of the pushes (electrical), to a share."""
    from_rad_s = max(reached_rad_s, abs(drive.live("omega_e_rad_s")))
    drive.command_speed(0.0)
    band = share * reached_rad_s
    rate = rad_s_from_rpm(drive.read("speed.acceleration_rpm_per_s")) * drive.read("motor.pole_pairs")
    ramp_s = min(speed_run.RAMP_MOST_S, speed_run.RAMP_DOUBT * from_rad_s / rate) if rate > 0.0 else 0.0
    waited = speed_run.reach(drive, 0.0, limit_s=speed_run.REACH_LIMIT_S + ramp_s, band_rad_s=band, look_s=look_s)
    if waited < speed_run.REACH_LIMIT_S + ramp_s:
        return
    drive.command_current(0.0, 0.0)  # a controller that shakes an elastic shaft never stops it, friction does
    alone = speed_run.reach(drive, 0.0, limit_s=speed_run.REACH_LIMIT_S, band_rad_s=band)
    if alone >= speed_run.REACH_LIMIT_S:
        raise refuse(
            "E_EXCITATION",
            f"the shaft is not at rest {waited + alone:.2g} s after it was asked to",
            stage="mechanics",
            likely="something drives the shaft, or it has much inertia for the current that is allowed",
            hint="allow a higher --i-max, or a lower --speed-max",
        )
