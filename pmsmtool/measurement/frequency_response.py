# SPDX-License-Identifier: MIT
"""The random torque for the frequency response on the drive: sized, and recorded."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from pmsmtool.drive.port import Drive
from pmsmtool.errors import SafetyRefusal
from pmsmtool.experiments import frequency_response
from pmsmtool.experiments.frequency_response import FrequencyPlan
from pmsmtool.identification.frequency_response import TRACE
from pmsmtool.machine.torque import torque_per_ampere
from pmsmtool.measurement.mechanics import numbered
from pmsmtool.trace import Trace
from pmsmtool.units import rpm_from_rad_s

if TYPE_CHECKING:
    from pmsmtool.measurement.limits import Limits

I_SHARE = 0.4
"""Level of the sequence, of the test current."""
SPEED_SHARE = 0.15
"""Steady speed, of the largest that back-emf and envelope allow: slow, for the position is recorded in binary32."""
EMF_SHARE = 0.6
VOLTAGE_SHARE = 0.85
"""Voltage that a bit of the sequence may take, of the largest: where it is limited there is no response."""
ABORT_SHARE = 0.95
REST_S = 0.5
"""Time at zero speed before the voltage is removed."""
PLAN_LINE = "the shaft turns at a constant speed with a random torque added"


def measure_frequency_response(
    drive: Drive,
    limits: Limits,
    keep: Callable[[str, Trace], None],
    say: Callable[[str], None],
    planned: Callable[[FrequencyPlan], None] | None = None,
) -> None:
    """Record the answers; the drive holds gains, flux linkage and rough inertia of the runs before.

    ``planned`` is told the plan before anything of it moves the shaft.

    Raises SafetyRefusal: the envelope leaves no current for the sequence.
    """
    pole_pairs = round(drive.read("motor.pole_pairs"))
    psi, J = drive.read("motor.psi_f_wb"), drive.read("motor.J_kgm2")
    largest = min(limits.omega_max_rad_s, EMF_SHARE * limits.V_max_v / (pole_pairs * psi))
    level = I_SHARE * limits.I_test_apk
    if not level > 0.0:
        raise SafetyRefusal(
            f"the current limit of {limits.i_max_apk:.4g} A leaves none for the sequence", hint="raise --i-max"
        )
    per_ampere = torque_per_ampere(pole_pairs, psi)
    speed = SPEED_SHARE * largest
    room_v = VOLTAGE_SHARE * limits.V_max_v - pole_pairs * speed * psi
    level = frequency_response.linear_level(level, room_v, drive.read("current.K_p_q_v_per_a"))
    level, speed = limits.within_supply(level, speed, per_ampere)
    plan = frequency_response.plan_frequency_response(level, speed, J, per_ampere, drive.period_s)
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
