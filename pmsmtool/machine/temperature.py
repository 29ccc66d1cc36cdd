# SPDX-License-Identifier: MIT
"""The one home of R(T), psi(T) and the temperature coefficients.

R(T) = R_s + R_winding alpha_R (T - T_ref): only the copper part of the loop warms with the winding; where the split is
not known all of it counts as copper. psi(T) = psi_f (1 + alpha_psi (T - T_ref)).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pmsmtool.machine.parameters import MachineParameters

COPPER_ALPHA_PER_K = 0.00393
"""Temperature coefficient of copper at 20 degC (IEC 60028: annealed copper)."""
MAGNET_ALPHA_PER_K = -0.0012
"""Temperature coefficient of the flux linkage where no machine file says it: sintered NdFeB, -0.11 to -0.12 %/K."""
ASSUMED_MAGNET_PER_K = 0.0009
"""95 % half width of that assumption: from samarium-cobalt, -0.03 %/K, to ferrite, -0.2 %/K."""
WINDING_TOLERANCE = 0.10
"""Relative 95 % half width of a winding's resistance that a file states without a deviation: a data sheet's."""
WARMING = "winding_k_per_a2s"
"""Of a machine file's conditions: what the winding warms by per square of a current (A peak) and time (K/(A2 s))."""
UNKNOWN_T_RANGE_C = (5.0, 90.0)
"""Winding and magnets of a machine whose temperature nothing tells (degC)."""

Degrees = TypeVar("Degrees", float, "NDArray[np.float64]")


def copper_ohm(machine: MachineParameters) -> float:
    """Return the copper part of R_s at T_ref (ohm); all of it where the split is not known."""
    return machine.R_s_ohm if machine.R_winding_ohm is None else machine.R_winding_ohm


def loop_coefficient_per_k(machine: MachineParameters) -> float:
    """Return the temperature coefficient of the whole loop R_s (1/K): that of its copper part, times its share.

    What a drive heats all of R_s by: R_s (1 + this (T - T_ref)) is :func:`resistance_at`.
    """
    return machine.alpha_R_per_k * copper_ohm(machine) / machine.R_s_ohm


def resistance_at(machine: MachineParameters, T_winding_c: Degrees) -> Degrees:
    """Return the loop resistance (ohm) at winding temperatures (degC) of any shape."""
    return machine.R_s_ohm + copper_ohm(machine) * machine.alpha_R_per_k * (T_winding_c - machine.T_ref_c)


def magnet_tolerance_per_k(machine: MachineParameters) -> float:
    """Return the 95 % half width of the magnets' coefficient (1/K).

    What the file states; without that, nothing for a coefficient of its own, and the range of magnets for the default.
    """
    if machine.alpha_psi_tolerance_per_k is not None:
        return machine.alpha_psi_tolerance_per_k
    return ASSUMED_MAGNET_PER_K if math.isclose(machine.alpha_psi_per_k, MAGNET_ALPHA_PER_K, rel_tol=1e-6) else 0.0


def magnet_flux_at(machine: MachineParameters, T_magnet_c: Degrees) -> Degrees:
    """Return the magnet flux linkage (Wb) at magnet temperatures (degC), (36) of Jercic et al. 2017."""
    return machine.psi_f_wb * (1.0 + machine.alpha_psi_per_k * (T_magnet_c - machine.T_ref_c))
