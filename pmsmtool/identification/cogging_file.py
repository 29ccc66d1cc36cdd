# SPDX-License-Identifier: MIT
"""Cogging torque as a result: one value per order, and a table over the encoder's angle for firmware to compensate."""

from __future__ import annotations

import math

import numpy as np

from pmsmtool.estimators.estimate import COVERAGE_FACTOR
from pmsmtool.estimators.shaft.mechanics import MechanicsResult
from pmsmtool.machine.parameters import Estimate
from pmsmtool.run_directory import RunDirectory

COGGING_CSV = "cogging.csv"
ROWS = 1024
"""Rows of the table over one turn."""


def cogging_estimates(mechanics: MechanicsResult | None) -> dict[str, Estimate]:
    """Return amplitude (N m) and phase (rad) of every order per turn that was found, by the names a stage lists.

    The torque along the phase order is amplitude cos(order theta - phase), theta the encoder's angle along it.
    """
    if mechanics is None:
        return {}
    found: dict[str, Estimate] = {}
    J, turns = mechanics.J, mechanics.harmonics.turns
    for h in mechanics.harmonics.acceleration_rad_s2:
        method = f"order {h.order} per turn, from coasting through {turns:.3g} turns and more each way"
        amplitude, std = J.value * h.amplitude, math.hypot(J.value * h.std, J.std * h.amplitude)
        systematic = J.systematic * h.amplitude
        found[f"cogging_{h.order}_nm"] = Estimate(amplitude, std, systematic, "N m", method=method)
        found[f"cogging_{h.order}_rad"] = Estimate(h.phase_rad, h.std / h.amplitude, 0.0, "rad", method=method)
    return found


def save_cogging(run: RunDirectory, mechanics: MechanicsResult | None, direction: int) -> dict[str, str]:
    """Write the table into the run; returns its name as a stage lists it, nothing where no cogging was found.

    ``theta_m_rad`` is what the drive's encoder shows, ``direction`` its sign along the phase order.
    """
    if mechanics is None or not mechanics.harmonics.acceleration_rad_s2:
        return {}
    theta = np.linspace(0.0, 2.0 * math.pi, ROWS, endpoint=False)
    J, harmonics = mechanics.J.value, mechanics.harmonics
    torque = harmonics.torque_nm(direction * theta, J)
    half = COVERAGE_FACTOR * J * math.sqrt(sum(h.std**2 for h in harmonics.acceleration_rad_s2))
    rows = [f"{angle:.9g},{value:.6g},{half:.3g}" for angle, value in zip(theta, torque, strict=True)]
    text = "\n".join(["theta_m_rad,torque_nm,half_width_95_nm", *rows]) + "\n"
    run.save(COGGING_CSV, text)
    return {COGGING_CSV: ""}
