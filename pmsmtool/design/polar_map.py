# SPDX-License-Identifier: MIT
"""Control in polar coordinates over speed and torque: conditioning, controllability, stability, gain schedules.

Miyajima, Fujimoto, Fujitsuna 2013, section IV.A: the inputs (V_a, delta) span the current plane wherever V_a is not
zero. Here with numbers: how well they span it, what the two single-loop designs make of the coupled machine, and how
far the gains travel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.design.polar import (
    AMPLITUDE_SIGMA_RAD_S,
    PHASE_SIGMA_RAD_S,
    Equilibrium,
    PolarDesign,
    SurfaceMachine,
    cdm_gains,
    conditioning,
    design_at,
    linearised,
)
from pmsmtool.errors import DesignInfeasible
from pmsmtool.units import RAD_S_PER_RPM

RPM = RAD_S_PER_RPM
RANK_TOLERANCE = 1e-9
"""A direction counts as reached when its singular value exceeds this share of the largest."""


def controllable(machine: SurfaceMachine, point: Equilibrium) -> bool:
    """Return whether [B, AB] has rank 2: lost only where V_a = 0 and omega_e = 0.

    A alone turns the direction that V_a moves, so that a turning machine stays controllable at zero voltage, through
    V_a only and slowly; (13) of the paper looks at B alone.
    """
    a, b = linearised(machine, point)
    values = np.linalg.svd(np.hstack([b, a @ b]), compute_uv=False)
    return bool(values[1] > RANK_TOLERANCE * values[0])


def condition_map(
    machine: SurfaceMachine, V_max: float, speed_rpm: Sequence[float] | Array, torque_nm: Sequence[float] | Array
) -> Array:
    """Return V_max / V_a in the steady states of least loss, shape (n, m).

    Infinite without voltage, NaN out of reach.
    """
    condition = np.full((len(speed_rpm), len(torque_nm)), np.nan)
    for k, rpm in enumerate(speed_rpm):
        for n, torque in enumerate(torque_nm):
            found = conditioning(machine, float(rpm) * RPM * machine.pole_pairs, float(torque), V_max)
            if found.reachable:
                condition[k, n] = found.condition
    return condition


def share_above(condition: Array, limit: float) -> float:
    """Return the share of the reachable points whose condition number exceeds a limit."""
    return float(np.mean(condition[~np.isnan(condition)] > limit))


def stability_map(
    machine: SurfaceMachine, V_max: float, speed_rpm: Sequence[float] | Array, torque_nm: Sequence[float] | Array
) -> Array:
    """Return the real part of the slowest pole of the true two-input loop (rad/s), shape (n, m).

    The single-loop designs promise -600 (phase) and -300 rad/s (amplitude). NaN out of reach, and in field weakening,
    where the amplitude rests at its limit and the phase loop, alone, has the poles it was placed with.
    """
    slowest = np.full((len(speed_rpm), len(torque_nm)), np.nan)
    for k, rpm in enumerate(speed_rpm):
        for n, torque in enumerate(torque_nm):
            found = design_or_none(machine, V_max, float(rpm), float(torque))
            if found is not None and found.point.V_a < V_max:
                slowest[k, n] = found.slowest_rad_s
    return slowest


def design_or_none(machine: SurfaceMachine, V_max: float, rpm: float, torque_nm: float) -> PolarDesign | None:
    """Return the placed loops at a point, None where the torque is out of reach or the loop has no static gain."""
    try:
        return design_at(
            machine,
            rpm * RPM * machine.pole_pairs,
            machine.current_a(torque_nm),
            V_max,
            PHASE_SIGMA_RAD_S,
            AMPLITUDE_SIGMA_RAD_S,
        )
    except DesignInfeasible:
        return None


@dataclass(frozen=True, slots=True)
class ScheduledGains:
    """Gains at one operating point; a current is A peak, a voltage V peak.

    Attributes
    ----------
    rpm, torque_nm : float
        The point.
    phase, amplitude : tuple of float
        K_p, K_i, K_d and a of the PIDs.
    K_P21, K_I21, K_P12, K_I12 : float
        PI gains of the linear range, (28)-(31).
    direct_phase : float
        Gain of the phase PID at high frequency, K_p + K_d a (rad/A): what a step of the reference kicks with.
    """

    rpm: float
    torque_nm: float
    phase: tuple[float, float, float, float]
    amplitude: tuple[float, float, float, float]
    K_P21: float
    K_I21: float
    K_P12: float
    K_I12: float
    direct_phase: float


def gain_schedule(
    machine: SurfaceMachine, V_max: float, T_s: float, points: Sequence[tuple[float, float]]
) -> tuple[ScheduledGains, ...]:
    """Return the gains the drive schedules to at points (rpm, N m); points out of reach are left out."""
    found = []
    for rpm, torque in points:
        design = design_or_none(machine, V_max, rpm, torque)
        if design is None:
            continue
        linear = cdm_gains(machine, design.point.V_a, design.point.delta, V_max, T_s, 10.0 * T_s)
        phase, amplitude = design.phase, design.amplitude
        found.append(
            ScheduledGains(
                rpm,
                torque,
                (phase.K_p, phase.K_i, phase.K_d, phase.a),
                (amplitude.K_p, amplitude.K_i, amplitude.K_d, amplitude.a),
                linear.K_P21,
                linear.K_I21,
                linear.K_P12,
                linear.K_I12,
                phase.K_p + phase.K_d * phase.a,
            )
        )
    return tuple(found)
