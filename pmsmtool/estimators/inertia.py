"""Inertia and Coulomb friction from pushes with several constant q currents in both directions.

While the current is constant, J dw/dt = k i_q - tau_c sgn(w) with k = 1.5 p psi: torque over acceleration is a straight
line whose slope is J and whose intercept is the friction. A first mechanical model, good to a percent or so; the
whitened output-error fit over position is the fine one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pmsmtool.estimators.estimate import SensorTolerance, condition_gate
from pmsmtool.estimators.least_squares import linear_solve
from pmsmtool.estimators.refusals import refuse
from pmsmtool.machine.parameters import Estimate
from pmsmtool.trace import Trace

STAGE = "inertia"
TRANSIENT_SHARE = 0.3
"""Share of a push that the current and the speed estimate need to follow."""
MODEL_FLOOR = 0.01
"""Relative standard deviation for what a constant acceleration leaves out: viscous friction, the estimate's lag."""
MINIMUM_PUSHES = 4


@dataclass(frozen=True, slots=True)
class InertiaResult:
    """Inertia (kg m2) and Coulomb friction (N m)."""

    J: Estimate
    tau_c: Estimate


def estimate_inertia(
    pushes: Sequence[Trace], psi_wb: Estimate, pole_pairs: int, tolerance: SensorTolerance | None = None
) -> InertiaResult:
    """Inertia and friction from pushes.

    Parameters
    ----------
    pushes : sequence of Trace
        ``i_q_a omega_e_rad_s`` during each push, at least two currents and both directions.
    psi_wb : Estimate
        Flux linkage at the temperature of the run (Wb).
    pole_pairs : int
        Pole pairs.
    tolerance : SensorTolerance
        Declared sensor tolerances.

    Raises
    ------
    IdentificationError
        ``E_EXCITATION``, ``E_NOT_IDENTIFIABLE``.
    """
    tolerance = tolerance or SensorTolerance()
    if len(pushes) < MINIMUM_PUSHES:
        raise refuse("E_EXCITATION", f"{len(pushes)} pushes, {MINIMUM_PUSHES} needed", stage=STAGE)
    rows = [_push(push, psi_wb.value, pole_pairs) for push in pushes]
    torque, acceleration, sign = (np.array(column) for column in zip(*rows, strict=True))
    x, covariance, residual, condition = linear_solve(
        np.stack([acceleration, sign], axis=1), torque, np.ones_like(torque)
    )
    condition_gate(condition, "J and tau_c", STAGE)
    dof = len(rows) - 2
    scatter = float(np.sum(np.square(residual))) / dof
    std_J, std_tau = (math.sqrt(scatter * float(covariance[k, k])) for k in range(2))
    J, tau_c = float(x[0]), float(x[1])
    if not J > 0.0:
        raise refuse("E_NOT_IDENTIFIABLE", f"J = {J:.3g} kg m2", stage=STAGE, likely="the shaft is held or driven")
    relative = math.hypot(tolerance.inertia, psi_wb.std / psi_wb.value)
    common = {"n": len(rows), "dof": float(dof), "method": "acceleration at constant current, both directions"}
    return InertiaResult(
        Estimate(J, math.hypot(std_J, MODEL_FLOOR * J), relative * J, "kg m2", **common),  # type: ignore[arg-type]
        Estimate(tau_c, math.hypot(std_tau, MODEL_FLOOR * abs(tau_c)), relative * abs(tau_c), "N m", **common),  # type: ignore[arg-type]
    )


def _push(push: Trace, psi: float, pole_pairs: int) -> tuple[float, float, float]:
    """Return mean torque (N m), acceleration (rad/s2) and sign of the motion of the settled part."""
    start = round(TRANSIENT_SHARE * len(push))
    omega = push["omega_e_rad_s"][start:] / pole_pairs
    t = push.t_s[start:] - push.t_s[start]
    slope = float(np.polyfit(t, omega, 1)[0])
    return 1.5 * pole_pairs * psi * float(np.mean(push["i_q_a"][start:])), slope, float(np.sign(np.mean(omega)))
