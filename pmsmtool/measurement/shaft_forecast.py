# SPDX-License-Identifier: MIT
"""How good inertia, friction and frequency response will be: said after the rough pushes, before the runs for them.

Before the first push nothing is known of the shaft, so that nothing can be predicted of it. Afterwards the rough
inertia, how the shaft slows down between the windows of the speed run, the flux linkage's own deviation and the plan
tell (``identification/shaft_prediction``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from pmsmtool.drive.port import Drive
from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.encoder import EncoderResult
from pmsmtool.estimators.estimate import SensorTolerance
from pmsmtool.estimators.noise import Noise
from pmsmtool.estimators.resistance import ResistanceResult
from pmsmtool.estimators.shaft.frequency_response import INERTIA_FLOOR
from pmsmtool.estimators.shaft.position import encoder_step
from pmsmtool.experiments import frequency_response, mechanics_run
from pmsmtool.identification import shaft_prediction
from pmsmtool.identification.evaluate import flux_of
from pmsmtool.identification.frequency_response import small_signal_doubt
from pmsmtool.identification.mechanics import SAMPLE_DOUBT, torque_doubt
from pmsmtool.identification.prediction import line_of
from pmsmtool.identification.shaft_prediction import RoughShaft
from pmsmtool.machine.torque import torque_per_ampere
from pmsmtool.trace import Trace

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
    """What is known of the shaft after the rough pushes.

    Attributes
    ----------
    shaft : RoughShaft
        Inertia by the pushes, friction by the run over speeds.
    sigma_a, doubt : float
        Noise of one sample (A), and relative standard deviation of the torque's scale but for the samples'
        displacement.
    R_ohm, L_q_h, psi_wb, dead_time_s, pole_pairs : float
        For that displacement.
    bandwidth_rad_s : float
        Of the current loop.
    """

    shaft: RoughShaft
    sigma_a: float
    doubt: float
    R_ohm: float
    L_q_h: float
    psi_wb: float
    dead_time_s: float
    pole_pairs: int
    bandwidth_rad_s: float

    @property
    def rough(self) -> dict[str, float]:
        """The rough values by machine-file key."""
        return {"J_kgm2": self.shaft.J, "B_nms": self.shaft.B, "tau_c_nm": self.shaft.tau_c}

    def mechanics(self, plan: mechanics_run.MechanicsPlan) -> dict[str, float]:
        """Return the relative standard deviations that pushes and coasting will have, by machine-file key."""
        pushes = shaft_prediction.PushPlan(plan.i_q_a, plan.unit_s, plan.coast_s, mechanics_run.ROWS)
        emf = self.pole_pairs * self.psi_wb * plan.omega_rad_s
        voltages = [self.R_ohm * plan.i_q_a + share * emf for share in (0.0, 0.5, 1.0)]
        displaced = shaft_prediction.displaced_share(voltages, self.L_q_h, plan.i_q_a, self.dead_time_s)
        scale = math.hypot(self.doubt, SAMPLE_DOUBT * displaced)
        return shaft_prediction.predict_mechanics(self.shaft, pushes, self.sigma_a, scale)

    def response(self, plan: frequency_response.FrequencyPlan, period_s: float) -> shaft_prediction.ResponsePrediction:
        """Return what the lines of the frequency response will be good for."""
        sequence = shaft_prediction.ResponsePlan(
            plan.i_q_a,
            plan.omega_rad_s,
            plan.hold_periods * period_s,
            plan.decimation * period_s,
            frequency_response.ROWS,
            frequency_response.REPEATS,
            self.bandwidth_rad_s,
        )
        found = shaft_prediction.predict_response(self.shaft, sequence, self.sigma_a)
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
    B, tau_c = shaft_prediction.rough_friction(traces["speeds"], J, per_a, pole_pairs)
    step = encoder_step([traces[name]["theta_M_rad"] for name in ("push_0", "push_1")])
    U_dc_v = float(traces["speeds"].meta["U_dc_v"])
    return ShaftForecast(
        RoughShaft(J, B, tau_c, per_a, step, pole_pairs),
        noise.sigma_a,
        torque_doubt(flux),
        resistance.R_measured.value,
        L_q,
        psi,
        max(0.0, resistance.V_dead_v) * drive.period_s / U_dc_v,
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


def response_line(predicted: shaft_prediction.ResponsePrediction) -> str:
    """Return the prediction of a frequency response as a person reads it."""
    at = ", ".join(f"{100.0 * predicted.at(hz):.2g} % at {hz:g} Hz" for hz in AT_HZ)
    return (
        f"predicted standard deviation: response {at}, coherent up to {predicted.highest_hz:.3g} Hz, J by it "
        f"{100.0 * predicted.J:.2g} %; that of a resonance is known when one is found"
    )


def not_predicted(error: IdentificationError) -> str:
    """Return why there is no prediction."""
    return f"predicted standard deviation: none for the shaft, {error.reason}"
