# SPDX-License-Identifier: MIT
"""Flux linkage from voltage over speed where nothing records at loop rate: a coasting machine, or its voltage limit.

Undriven (docs/identification.md, 3.4 no. 8): without current the voltage is the machine's own,

    u_q = w psi_q + c_q sgn(w),   u_d = -w psi_d + c_d sgn(w),   psi = hypot(psi_q, psi_d);

the intercepts take what the inverter adds at zero current. At the voltage limit: a machine that a torque no longer
accelerates has w psi = (utilisation - :data:`DEAD_TIME` t_d f_s) U_dc; what a maker adds to it or keeps back is doubt.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pmsmtool.estimators.estimate import SensorTolerance
from pmsmtool.machine.parameters import Estimate
from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace

BLOCKS = 12
UNDRIVEN_FLOOR = 0.01
"""Relative 95 % model error of the undriven voltage: polled speed and voltage are not of the same instant."""
INVERTER_SHARE = 0.5
"""What the inverter's error may differ by between fast and slow, of itself: 3.0 and 5.0 V, for psi 6 % too small."""
DEAD_TIME = 1.07
"""What the dead time takes of the largest voltage, over t_d f_s U_dc, at the small current of the top: fitted to 75
random drives (benchmarks.level_intervals standard --first 5000; constant 0.0 %, rest 0.7 % rms, at most 2.7 %)."""
LIMIT_DOUBT = 0.035
"""Relative 95 % doubt of the largest voltage where the dead time is known."""
BLIND_DOUBT = 0.06
"""The same where it is not: it took up to 6 % of it."""
HELD_SHARE = 0.85
"""Current, of the one asked for, above which it is not the voltage that holds the speed: there all of it flows."""
STEADY = 0.02
"""Largest relative change of the speed over the record of the top."""
RISING = 0.02
"""Largest change of the current over it, of the one asked for: a loop that left its limit slowly made the psi of a
salient motor 14 to 18 % too large, where it rose by 0.037 and more; 0.005 at the most where the voltage ends."""


def flux_by_undriven_voltage(
    coasts: Sequence[Trace], *, pole_pairs: int, tolerance: SensorTolerance | None = None
) -> Estimate:
    """Return the flux linkage (Wb) from ``theta_M_rad``, ``u_d_v`` and ``u_q_v`` of a coasting machine.

    Raises IdentificationError: ``E_EXCITATION``: too few rows, or no speed in one of the directions.
    """
    rows = [row for coast in coasts for row in _means(coast, pole_pairs)]
    if len(rows) < BLOCKS or not min(rows)[0] < 0.0 < max(rows)[0]:
        raise refuse("E_EXCITATION", "the machine did not coast both ways", stage="undriven voltage")
    psi, std, error = _flux(rows)
    early, late = (_flux([row for k, row in enumerate(rows) if k // (BLOCKS // 2) % 2 == half])[0] for half in (0, 1))
    open_ = INVERTER_SHARE * error / np.ptp([abs(row[0]) for row in rows])
    doubt = math.hypot((tolerance or SensorTolerance()).flux, UNDRIVEN_FLOOR, (late - early) / psi, open_ / psi)
    return Estimate(psi, std, doubt * psi, "Wb", n=len(rows), method="undriven voltage over speed", dof=len(rows) - 2.0)


def voltage_drift(coast: Trace) -> float:
    """Return how much the voltage over the speed changes from the first half of a coast to the second (relative)."""
    early, late = np.split(np.array([math.hypot(*u) / abs(w) if w else math.inf for w, *u in _means(coast, 1)]), 2)
    before = float(np.sum(early))
    return float(np.sum(late)) / before - 1.0 if before > 0.0 else 0.0


def _flux(rows: Sequence[tuple[float, float, float]]) -> tuple[float, float, float]:
    """Return the flux linkage (Wb) of electrical speeds and voltages, its deviation, and the inverter's error (V)."""
    w, u_d, u_q = np.array(rows).T
    matrix = np.column_stack([w, np.sign(w)])
    inverse = np.linalg.inv(matrix.T @ matrix)
    parts, errors, variance = [], [], 0.0
    for u in (u_q, u_d):
        solution = inverse @ matrix.T @ u
        residual = u - matrix @ solution
        parts.append(float(solution[0]))
        errors.append(float(solution[1]))
        variance += float(residual @ residual) / (len(rows) - 2) * float(inverse[0, 0])
    return math.hypot(*parts), math.sqrt(variance), math.hypot(*errors)


def _means(coast: Trace, pole_pairs: int) -> list[tuple[float, float, float]]:
    """Return electrical speed and voltages at the blocks of a coast."""
    size = len(coast) // BLOCKS
    rows = []
    for k in range(BLOCKS if size >= 3 else 0):
        part = slice(k * size, (k + 1) * size)
        t, theta = coast.t_s[part], coast["theta_M_rad"][part]
        w = pole_pairs * float(np.polyfit(t - t[0], theta, 1)[0])
        rows.append((w, float(coast["u_d_v"][part].mean()), float(coast["u_q_v"][part].mean())))
    return rows


def flux_by_voltage_limit(
    top: Trace,
    *,
    pole_pairs: int,
    utilisation: float,
    dead_time_share: float | None = None,
    tolerance: SensorTolerance | None = None,
) -> Estimate:
    """Return the flux linkage (Wb) from the speed at which the voltage ends.

    Raises IdentificationError: ``E_NOT_SETTLED``: the speed still changes; ``E_EXCITATION``: the torque asked for is
    friction's.

    Parameters
    ----------
    top : Trace
        ``theta_M_rad``, ``i_q_a`` and ``U_dc_v``; ``i_command_a`` in its meta.
    utilisation : float
        Largest phase voltage amplitude over the DC link.
    dead_time_share : float, optional
        Dead time over control period, where known.
    """
    t = top.t_s - top.t_s[0]
    half = len(top) // 2
    first, second = (
        abs(float(np.polyfit(t[part], top["theta_M_rad"][part], 1)[0])) for part in (slice(0, half), slice(half, None))
    )
    w_M = 0.5 * (first + second)
    if not w_M > 0.0 or abs(second - first) > STEADY * w_M:
        raise refuse("E_NOT_SETTLED", "the speed at the voltage limit is not steady", stage="voltage limit")
    if abs(current_rise(top)) > RISING:
        raise refuse("E_NOT_SETTLED", "the current at the voltage limit is not steady", stage="voltage limit")
    flowing = abs(float(top["i_q_a"].mean()) / float(top.meta["i_command_a"]))
    if flowing > HELD_SHARE:
        raise refuse(
            "E_EXCITATION", f"{100.0 * flowing:.0f} % of the current still flows: the speed is not the voltage's limit",
            stage="voltage limit", likely="friction or a load holds it",
        )  # fmt: skip
    share = utilisation - DEAD_TIME * (dead_time_share or 0.0)
    psi = share * float(top["U_dc_v"].mean()) / (pole_pairs * w_M)
    blind = BLIND_DOUBT if dead_time_share is None else LIMIT_DOUBT
    doubt = math.hypot((tolerance or SensorTolerance()).flux, blind)
    return Estimate(
        psi, psi * abs(second - first) / w_M, doubt * psi, "Wb", n=len(top), method="speed at the voltage limit"
    )


def current_rise(top: Trace) -> float:
    """Return how much more current flows in the second half of a record than in the first, of the one asked for."""
    half = len(top) // 2
    return float(top["i_q_a"][half:].mean() - top["i_q_a"][:half].mean()) / float(top.meta["i_command_a"])
