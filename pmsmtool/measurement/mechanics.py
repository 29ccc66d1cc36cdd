# SPDX-License-Identifier: MIT
"""The pushes for inertia and friction on the drive: sized, and recorded."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from typing import TYPE_CHECKING

from pmsmtool.drive.port import Drive
from pmsmtool.experiments import mechanics_run, speed_run
from pmsmtool.experiments.mechanics_run import MechanicsPlan
from pmsmtool.identification.cogging import SLOW_TRACE
from pmsmtool.identification.mechanics import TRACE
from pmsmtool.machine.torque import torque_per_ampere
from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace
from pmsmtool.units import rad_s_from_rpm, rpm_from_rad_s

if TYPE_CHECKING:
    from pmsmtool.measurement.limits import Limits

I_SHARE = 0.5
"""Current of the pushes, of the test current."""
SPEED_SHARE = 0.6
"""Speed they aim at, of the largest that back-emf and envelope allow; the friction's share is not known before."""
EMF_SHARE = 0.6
ABORT_SHARE = 0.95
SLOW_SHARE = 0.2
"""Largest speed of the slow turns, of the speed limit."""
REST_SHARE = 0.02
"""Largest speed before the first push, of the speed that it is to reach."""
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
) -> None:
    """Run the steps; the drive holds current gains, flux linkage and rough inertia of the runs before.

    ``chosen`` returns what is run of a plan, and ``planned`` is called before anything of it moves the shaft; ``rows``
    is the largest number per push.
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
    _come_to_rest(drive, pole_pairs * plan.omega_rad_s)
    keep_part = numbered(drive, TRACE, keep)
    abort = ABORT_SHARE * pole_pairs * limits.omega_max_rad_s
    mechanics_run.push_and_coast(drive, plan, abort, keep_part)
    drive.enable()
    _come_to_rest(drive, pole_pairs * plan.omega_rad_s)


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


def _come_to_rest(drive: Drive, reached_rad_s: float) -> None:
    """Stop the shaft by the speed controller, from the speed it has or that of the pushes (electrical)."""
    from_rad_s = max(reached_rad_s, abs(drive.live("omega_e_rad_s")))
    drive.command_speed(0.0)
    band = REST_SHARE * reached_rad_s
    rate = rad_s_from_rpm(drive.read("speed.acceleration_rpm_per_s")) * drive.read("motor.pole_pairs")
    ramp_s = min(speed_run.RAMP_MOST_S, speed_run.RAMP_DOUBT * from_rad_s / rate) if rate > 0.0 else 0.0
    waited = speed_run.reach(drive, 0.0, limit_s=speed_run.REACH_LIMIT_S + ramp_s, band_rad_s=band)
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
