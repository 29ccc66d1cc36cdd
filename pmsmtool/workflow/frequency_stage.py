# SPDX-License-Identifier: MIT
"""The frequency response's part of an identification: random torque on the drive, the response from its traces."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from pmsmtool.drive.port import Drive
from pmsmtool.errors import SafetyRefusal
from pmsmtool.estimators.estimate import SensorTolerance
from pmsmtool.estimators.frequency_response import FrequencyResponse, estimate_frequency_response
from pmsmtool.experiments import frequency_response
from pmsmtool.experiments.frequency_response import FrequencyPlan
from pmsmtool.machine.torque import torque_per_ampere
from pmsmtool.npz_file import npz_bytes
from pmsmtool.trace import Trace
from pmsmtool.units import rpm_from_rad_s
from pmsmtool.workflow.mechanics_stage import in_frame, numbered, torque_doubt, torque_of
from pmsmtool.workflow.run_directory import RunDirectory

if TYPE_CHECKING:
    from pmsmtool.workflow.evaluate import Evaluation
    from pmsmtool.workflow.limits import Limits

TRACE = "frf_"
"""Followed by the number of a record."""
RESPONSE_FILE = "frequency_response.npz"
I_SHARE = 0.4
"""Level of the sequence, of the test current."""
SPEED_SHARE = 0.15
"""Steady speed, of the largest that back-emf and envelope allow: slow, for the position is recorded in binary32."""
EMF_SHARE = 0.6
ABORT_SHARE = 0.95
NOISE_DOUBT = 0.3
"""Relative standard deviation of the torque's scale, of the share of the noise in the power of the current: noise of
the input makes a response too small."""
SAMPLE_DOUBT = 0.5
"""The same, of the displacement of the samples by a dead time, of the current's deviation. With both, errors of the
inertia of seven random drives up to 1.2 % were up to 1.1 standard deviations; without them up to 3.2."""
REST_S = 0.5
"""Time at zero speed before the voltage is removed."""
PLAN_LINE = "the shaft turns steadily while a random torque shakes it"


def measure_frequency_response(
    drive: Drive,
    limits: Limits,
    keep: Callable[[str, Trace], None],
    say: Callable[[str], None],
    planned: Callable[[FrequencyPlan], None] | None = None,
) -> None:
    """Record the answers; the drive holds gains, flux linkage and rough inertia of the runs before.

    ``planned`` is told the plan before anything of it moves the shaft.

    Raises
    ------
    SafetyRefusal
        The envelope leaves no current for the sequence.
    """
    pole_pairs = round(drive.read("motor.pole_pairs"))
    psi, J = drive.read("motor.psi_f_wb"), drive.read("motor.J_kgm2")
    largest = min(limits.omega_max_rad_s, EMF_SHARE * limits.V_max_v / (pole_pairs * psi))
    level = I_SHARE * limits.I_test_apk
    if not level > 0.0:
        raise SafetyRefusal(
            f"the current limit of {limits.i_max_apk:.4g} A leaves none for the sequence", hint="raise --i-max"
        )
    plan = frequency_response.plan_frequency_response(
        level, SPEED_SHARE * largest, J, torque_per_ampere(pole_pairs, psi), drive.period_s
    )
    say(
        f"frequency response: random current of {plan.i_q_a:.3g} A at {rpm_from_rad_s(plan.omega_rad_s):.0f} rpm, "
        f"{plan.duration_s(drive.period_s):.2g} s"
    )
    if planned is not None:
        planned(plan)
    drive.command_speed(0.0)
    drive.wait(REST_S)
    drive.disable()
    # the d current of the run over speeds would take part in the torque that the bias is measured for
    drive.write({"field_weakening.i_d_lm_a": 0.0})
    drive.enable()
    keep_part = numbered(drive, TRACE, keep)
    abort = ABORT_SHARE * pole_pairs * limits.omega_max_rad_s
    frequency_response.excite_at_speed(drive, plan, pole_pairs, abort, keep_part)
    drive.wait(REST_S)


def frequency_response_of(
    traces: Mapping[str, Trace],
    result: Evaluation,
    tolerance: SensorTolerance | None = None,
    dead_time_s: float = 0.0,
) -> FrequencyResponse | None:
    """Return the response; None without the run, or without a flux linkage.

    ``dead_time_s`` is that of a leg; it displaces the samples of the current.

    Raises
    ------
    IdentificationError
        As the estimator refuses.
    """
    parts = [traces[f"{TRACE}{k}"] for k in range(sum(name.startswith(TRACE) for name in traces))]
    if not parts or result.flux is None or result.encoder is None or result.offset is None:
        return None
    behind = result.offset.value - float(parts[0].meta["offset_rad"])
    return estimate_frequency_response(
        [in_frame(part, behind) for part in parts],
        torque_of(result, round(result.encoder.pole_pairs.value)),
        direction=int(parts[0].meta["direction"]),
        scale_std=_doubt(parts[0], result, dead_time_s),
        tolerance=tolerance,
    )


def small_signal_doubt(sigma_a: float, displaced_a: float, deviation_a: float) -> float:
    """Return what a small current's noise, and what a dead time displaces its samples by, may do to the torque's scale.

    Parameters
    ----------
    sigma_a, displaced_a, deviation_a : float
        Noise of a sample, displacement of the samples, and deviation of the current itself (A).
    """
    return math.hypot(NOISE_DOUBT * (sigma_a / deviation_a) ** 2, SAMPLE_DOUBT * displaced_a / deviation_a)


def _doubt(record: Trace, result: Evaluation, dead_time_s: float) -> float:
    """Relative standard deviation of the scale of the torque that shakes the shaft."""
    assert result.flux is not None and result.encoder is not None
    doubt = torque_doubt(result.flux, mapped=result.flux_map is not None)
    deviation = float(np.std(record["i_q_a"]))
    if result.inductance is None or deviation == 0.0:
        return doubt
    turned = float(np.ptp(record["theta_M_rad"])) / (float(record.t_s[-1]) - float(record.t_s[0]))
    emf = round(result.encoder.pole_pairs.value) * turned * result.flux.psi_measured.value
    displaced = 0.5 * dead_time_s * emf / result.inductance.L_q.value
    return math.hypot(doubt, small_signal_doubt(result.noise.sigma_a, displaced, deviation))


def save_response(run: RunDirectory, result: FrequencyResponse | None) -> dict[str, str]:
    """Write the table of the response into the run; returns its name as a stage lists it."""
    if result is None:
        return {}
    run.save(RESPONSE_FILE, npz_bytes(result.arrays()))
    return {RESPONSE_FILE: ""}


def response_summary(result: FrequencyResponse | None) -> str:
    """Return what a person reads of the response behind the other values."""
    return "" if result is None else f"; frequency response: {result.reason}"
