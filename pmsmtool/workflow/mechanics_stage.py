"""The mechanics' part of an identification: current steps on the drive, inertia and friction from their trace."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pmsmtool.drive.port import Drive
from pmsmtool.estimators.estimate import SensorTolerance
from pmsmtool.estimators.mechanics import MechanicsResult, Torque, estimate_mechanics
from pmsmtool.experiments import mechanics_run
from pmsmtool.trace import Trace

if TYPE_CHECKING:
    from pmsmtool.workflow.evaluate import Evaluation
    from pmsmtool.workflow.measure import Limits

Array = NDArray[np.float64]

TRACE = "inertia_"
"""Followed by a number: push, coasting, push the other way, coasting."""
I_SHARE = 0.5
"""Current of the pushes, of the test current."""
SPEED_SHARE = 0.6
"""Speed they aim at, of the largest that back-emf and envelope allow; the friction's share is not known before."""
EMF_SHARE = 0.6
ABORT_SHARE = 0.95
PLAN_LINE = "pushes turn the shaft both ways, and it coasts with the voltage off"


def measure_mechanics(
    drive: Drive, limits: Limits, keep: Callable[[str, Trace], None], say: Callable[[str], None]
) -> None:
    """Run the steps; the drive holds current gains, flux linkage and rough inertia of the runs before."""
    pole_pairs = drive.read("motor.pole_pairs")
    psi, J = drive.read("motor.psi_f_wb"), drive.read("motor.J_kgm2")
    largest = min(limits.omega_max_rad_s, EMF_SHARE * limits.V_max_v / (pole_pairs * psi))
    per_ampere = 1.5 * pole_pairs * psi
    plan = mechanics_run.plan_mechanics(I_SHARE * limits.I_test_apk, SPEED_SHARE * largest, J, per_ampere)
    say(
        f"J, B, tau_c: pushes of {plan.i_q_a:.3g} A up to about {plan.omega_rad_s * 30.0 / math.pi:.0f} rpm and "
        f"coasting with the voltage off, {plan.duration_s:.2g} s"
    )
    drive.command_speed(0.0)
    drive.wait(REST_S)
    offset, reversed_ = drive.read("encoder.offset_rad"), drive.read("encoder.reversed")
    facts = {"offset_rad": offset, "direction": -1 if reversed_ else 1}
    count = 0

    def keep_part(trace: Trace) -> None:
        nonlocal count
        keep(f"{TRACE}{count}", replace(trace, meta={**trace.meta, **facts}))
        count += 1

    abort = ABORT_SHARE * pole_pairs * limits.omega_max_rad_s
    mechanics_run.push_and_coast(drive, plan, abort, keep_part)
    drive.enable()
    drive.command_speed(0.0)
    drive.wait(REST_S)


REST_S = 0.5
"""Time at zero speed before the first step."""


def mechanics_of(
    traces: Mapping[str, Trace], result: Evaluation, tolerance: SensorTolerance | None
) -> MechanicsResult | None:
    """Return inertia and friction; None without the run, or without a flux linkage.

    Raises
    ------
    IdentificationError
        As the estimator refuses.
    """
    parts = [traces[f"{TRACE}{k}"] for k in range(sum(name.startswith(TRACE) for name in traces))]
    if not parts or result.flux is None or result.encoder is None or result.offset is None:
        return None
    pole_pairs = round(result.encoder.pole_pairs.value)
    behind = result.offset.value - float(parts[0].meta["offset_rad"])
    psi = result.flux.psi_measured
    return estimate_mechanics(
        [in_frame(part, behind) for part in parts],
        torque_of(result, pole_pairs),
        1.5 * pole_pairs * psi.value,
        result.noise.sigma_a,
        psi.std / psi.value,
        direction=int(parts[0].meta["direction"]),
        tolerance=tolerance,
    )


def in_frame(trace: Trace, behind_rad: float) -> Trace:
    """Return a trace with its currents in a frame that stands so much behind the recorded one."""
    c, s = math.cos(behind_rad), math.sin(behind_rad)
    i_d, i_q = trace["i_d_a"], trace["i_q_a"]
    return replace(trace, signals={**trace.signals, "i_d_a": c * i_d - s * i_q, "i_q_a": s * i_d + c * i_q})


def torque_of(result: Evaluation, pole_pairs: int) -> Torque:
    """Torque by the flux map where there is one, else by flux linkage and the difference of the inductances."""
    assert result.flux is not None
    psi = result.flux.psi_measured.value
    if result.flux_map is not None:
        flux_map = result.flux_map.flux_map
        warmer = psi - result.flux.psi_f.value

        def by_map(i_d: Array, i_q: Array) -> Array:
            psi_d, psi_q = flux_map.flux(i_d, i_q)
            return np.asarray(1.5 * pole_pairs * ((psi_d + warmer) * i_q - psi_q * i_d))

        return by_map
    found = result.inductance
    difference = 0.0 if found is None else found.L_d.value - found.L_q.value
    return lambda i_d, i_q: 1.5 * pole_pairs * (psi + difference * i_d) * i_q
