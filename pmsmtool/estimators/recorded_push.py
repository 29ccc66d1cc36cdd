# SPDX-License-Identifier: MIT
"""Resistance, flux linkage, L_q and frame offset from recorded torque pulses, as estimates with intervals.

Currents of several sizes and both signs at every speed, and the way from one to the next
(``experiments/recorded_push``), separate what single operating points mix (docs/identification.md, 8). The
regression is that of ``resolved_push``; here its values are judged.

The speed is the encoder's own: a speed observer lags by its bandwidth under acceleration, which is proportional to the
current and would count as resistance. So would the delay between a sample and the middle of its voltage: the
acceleration is carried over it, and half a period of doubt about it goes into the systematic part of R. The observer's
lag turns the frame of the voltages; as much of that as the doubt is of the delay goes into the systematic part of L_q.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pmsmtool.estimators.estimate import SensorTolerance, statistical_half_width, total_half_width
from pmsmtool.estimators.resolved_push import STAGE, push_blocks, resolve
from pmsmtool.machine.parameters import Estimate
from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace

DELAY_DOUBT_PERIODS = 0.5
DELAY_DOUBT = "delay_doubt_periods"
"""Key of a trace's ``meta``: how far the middle of a voltage may be from where ``resolved_push`` takes it, where
less is known of a drive's voltages."""
LEAST_PUSHES = 6
# Model errors: 95 % half widths beyond what fit and shapes show, chosen on 119 random drives (seeds 8000 to 8041 and
# 65000 to 65076 of benchmarks.level_intervals); the errors are theirs.
L_Q_FLOOR = 0.025
"""Of L_q (relative): median 0.2 %, 1.6 % on nine of ten, up to 5 %."""
L_Q_PER_ERROR = 0.015
"""More of it per V over the rms voltage of the reactance."""
PSI_FLOOR = 0.006
"""Of psi (relative): up to 0.2 %."""
PSI_LIMIT = 0.03
"""Largest relative 95 % half width of psi: beyond, nothing of the pushes is to be trusted."""
FRAME_FLOOR_RAD = math.radians(0.3)
"""Of the frame's angle: up to 0.26 deg."""
R_FLOOR = 0.02
"""Of R (relative): median 0.2 %, 1.2 % on nine of ten."""
R_PER_ERROR = 0.012
"""More of it per V over the largest R i: up to 4 % where that is 1 to 5, 34 % on one drive where it was 8."""
R_LIMIT = 0.15
"""Largest relative 95 % half width of R: above, it cannot be told from the inverter's error."""
METHOD = "regression over recorded torque pulses"


@dataclass(frozen=True, slots=True)
class PushResult:
    """What the pushes tell."""

    R: Estimate | None
    """Loop resistance at the temperature of the run. None when the inverter's error hides it."""
    psi_f: Estimate
    L_q: Estimate
    frame_offset: Estimate
    """Flux linkage at the temperature of the run, apparent L_q at the pushes' currents, angle of the frame ahead of
    the d axis (rad electrical)."""
    V_dead_v: float
    """Voltage that changes sign with the current (V)."""


def estimate_pushes(
    pushes: Sequence[Trace], *, period_s: float, pole_pairs: int, tolerance: SensorTolerance | None = None
) -> PushResult:
    """Return the estimates. Raises IdentificationError: ``E_EXCITATION``, ``E_CLIPPED``, ``E_NOT_IDENTIFIABLE``.

    Parameters
    ----------
    pushes : sequence of Trace
        ``i_d_a i_q_a u_d_v u_q_v omega_e_rad_s theta_M_rad flagged``; ``meta["delay_doubt_periods"]`` where it is not
        :data:`DELAY_DOUBT_PERIODS`.
    period_s : float
        Control period (s).
    pole_pairs : int
        Pole pairs.
    tolerance : SensorTolerance
        Declared sensor tolerances.
    """
    tolerance = tolerance or SensorTolerance()
    if len(pushes) < LEAST_PUSHES:
        raise refuse("E_EXCITATION", f"{len(pushes)} torque pulses, {LEAST_PUSHES} needed", stage=STAGE)
    blocks = [push_blocks(push, period_s, pole_pairs) for push in pushes]
    found = resolve(blocks)
    R_ohm, psi_q, psi_d, L_q_h, V_dead = (float(value) for value in found.value)

    def estimate(value: float, std: float, unit: str, systematic: float) -> Estimate:
        return Estimate(
            value, float(std), float(systematic), unit, n=found.rows, method=METHOD, dof=len(pushes) - 1.0
        )  # fmt: skip

    if not psi_q > 0.0:
        raise refuse("E_EXCITATION", f"the voltage over speed is {psi_q:.3g} Wb", stage=STAGE)
    size = math.hypot(psi_q, psi_d)
    psi = estimate(size, found.std[1], "Wb", size * math.hypot(tolerance.flux, PSI_FLOOR))
    if statistical_half_width(psi) > PSI_LIMIT * psi.value:
        raise refuse(
            "E_NOT_IDENTIFIABLE",
            f"psi scatters by {100.0 * statistical_half_width(psi) / psi.value:.2g} % between the torque pulses, limit "
            f"{100.0 * PSI_LIMIT:g} %",
            stage=STAGE,
            likely="torque pulses too short or too weak against friction, or a drive that limits its voltage",
        )
    doubt = max(float(push.meta.get(DELAY_DOUBT, DELAY_DOUBT_PERIODS)) for push in pushes)
    delay = size * doubt * period_s * float(np.median([push.rate / abs(push.i_q) for push in blocks]))
    hidden = V_dead / max(abs(push.i_q) for push in blocks)
    R_systematic = math.hypot(R_ohm * math.hypot(tolerance.impedance, R_FLOOR), R_PER_ERROR * hidden, delay)
    R = estimate(R_ohm, found.std[0], "ohm", R_systematic)
    turned = size * doubt * period_s * float(np.median([abs(push.lag / push.i_q) for push in blocks]))
    floor = math.hypot(L_Q_FLOOR, L_Q_PER_ERROR * V_dead / found.reactance_v)
    L_q_systematic = math.hypot(abs(L_q_h) * math.hypot(tolerance.impedance, floor), turned)
    return PushResult(
        R=R if total_half_width(R) <= R_LIMIT * R_ohm else None,
        psi_f=psi,
        L_q=estimate(L_q_h, found.std[3], "H", L_q_systematic),
        frame_offset=estimate(math.atan2(psi_d, psi_q), found.std[2] / size, "rad", FRAME_FLOOR_RAD),
        V_dead_v=V_dead,
    )
