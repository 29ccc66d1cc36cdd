# SPDX-License-Identifier: MIT
"""Loop resistance from the power of a bench supply at several currents, where the drive shows no voltage.

At a rotor that rests on a current vector of length i the supply gives

    P = P_0 + k i + 3/2 R i^2:

what the drive takes by itself, drops and switching losses in proportion to the current, and the loop resistance. What
grows with the square of the current besides it cannot be separated, and is doubt.
"""

from __future__ import annotations

import math

import numpy as np

from pmsmtool.estimators.estimate import SensorTolerance, statistical_half_width
from pmsmtool.machine.parameters import Estimate
from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace

STAGE = "bench supply"
SUPPLY_TOLERANCE = 0.01
"""Relative 95 % tolerance of the power that a person reads: 0.5 % and a digit each of voltage and current."""
LOSS_DOUBT = 0.01
"""Relative 95 % doubt of the losses besides R that grow with the square of the current."""
STATISTICAL_LIMIT = 0.15
"""Largest relative statistical half width: beyond it the display is too coarse for this drive's copper loss."""
LEAST_LEVELS = 5
ONE_VECTOR = "along one current vector: by how much the phases differ is not in the interval"


def resistance_by_supply(levels: Trace, *, tolerance: SensorTolerance | None = None) -> Estimate:
    """Return the loop resistance per phase (ohm) at the temperature of the run.

    Raises IdentificationError: ``E_EXCITATION``: too few readings; ``E_NOT_CONNECTED``: no power comes with the
    current; ``E_SNR``: the readings do not tell the copper loss.

    Parameters
    ----------
    levels : Trace
        ``i_command_a`` (A peak), ``supply_v``, ``supply_i_a``, one row per reading; some currents more than once.
    tolerance : SensorTolerance, optional
        That of the current gain counts twice: the copper loss goes with its square.
    """
    i = np.asarray(levels["i_command_a"], dtype=np.float64)
    power = np.asarray(levels["supply_v"] * levels["supply_i_a"], dtype=np.float64)
    if len(i) < LEAST_LEVELS or len(np.unique(i)) < 3:
        raise refuse("E_EXCITATION", f"{len(i)} readings at {len(np.unique(i))} currents", stage=STAGE)
    x = i / np.max(np.abs(i))
    matrix = np.column_stack([np.ones_like(x), np.abs(x), x**2])
    inverse = np.linalg.inv(matrix.T @ matrix)
    solution = inverse @ matrix.T @ power
    residual = power - matrix @ solution
    dof = len(x) - 3
    scale = 1.0 / (1.5 * float(np.max(i**2)))
    value = scale * float(solution[2])
    std = scale * math.sqrt(float(residual @ residual) / dof * float(inverse[2, 2]))
    if not value > 0.0:
        raise refuse("E_NOT_CONNECTED", f"{value:.3g} ohm: the power does not grow with the current", stage=STAGE)
    doubt = math.hypot(2.0 * (tolerance or SensorTolerance()).current_gain, SUPPLY_TOLERANCE, LOSS_DOUBT)
    found = Estimate(
        value, std, doubt * value, "ohm", n=len(x), method="power of a bench supply, read at several currents",
        dof=float(dof), fallback=ONE_VECTOR,
    )  # fmt: skip
    half = statistical_half_width(found) / value
    if half > STATISTICAL_LIMIT:
        raise refuse(
            "E_SNR",
            f"the readings determine R to {100.0 * half:.0f} %, limit {100.0 * STATISTICAL_LIMIT:.0f} %",
            stage=STAGE,
            likely="a display too coarse for the copper loss of this machine, or readings that were mixed up",
            hint="allow more current (--i-max), lower the DC link, or read a power meter with more digits",
        )
    return found
