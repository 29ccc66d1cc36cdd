"""The frequency response's part of an identification: random torque on the drive, the response from its traces."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from pmsmtool.drive.port import Drive
from pmsmtool.errors import SafetyRefusal
from pmsmtool.estimators.frequency_response import FrequencyResponse, estimate_frequency_response
from pmsmtool.experiments import frequency_response
from pmsmtool.npz_file import npz_bytes
from pmsmtool.trace import Trace
from pmsmtool.workflow.mechanics_stage import in_frame, numbered, torque_of
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
REST_S = 0.5
"""Time at zero speed before the voltage is removed."""
PLAN_LINE = "the shaft turns steadily while a random torque shakes it"


def measure_frequency_response(
    drive: Drive, limits: Limits, keep: Callable[[str, Trace], None], say: Callable[[str], None]
) -> None:
    """Record the answers; the drive holds gains, flux linkage and rough inertia of the runs before.

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
        level, SPEED_SHARE * largest, J, 1.5 * pole_pairs * psi, drive.period_s
    )
    say(
        f"frequency response: random current of {plan.i_q_a:.3g} A at {plan.omega_rad_s * 30.0 / math.pi:.0f} rpm, "
        f"{plan.duration_s(drive.period_s):.2g} s"
    )
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


def frequency_response_of(traces: Mapping[str, Trace], result: Evaluation) -> FrequencyResponse | None:
    """Return the response; None without the run, or without a flux linkage.

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
    )


def save_response(run: RunDirectory, result: FrequencyResponse | None) -> dict[str, str]:
    """Write the table of the response into the run; returns its name as a stage lists it."""
    if result is None:
        return {}
    run.save(RESPONSE_FILE, npz_bytes(result.arrays()))
    return {RESPONSE_FILE: ""}


def response_summary(result: FrequencyResponse | None) -> str:
    """Return what a person reads of the response behind the other values."""
    return "" if result is None else f"; frequency response: {result.reason}"
