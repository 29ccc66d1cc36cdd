# SPDX-License-Identifier: MIT
"""The one home of the torque: T = 1.5 p (psi_d i_q - psi_q i_d) for amplitude-invariant dq quantities."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Values = TypeVar("Values", float, "NDArray[np.float64]")


def air_gap_torque(pole_pairs: float, psi_d_wb: Values, psi_q_wb: Values, i_d_a: Values, i_q_a: Values) -> Values:
    """Return the torque (N m) of fluxes (Wb) and currents (A peak), all of one shape."""
    return 1.5 * pole_pairs * (psi_d_wb * i_q_a - psi_q_wb * i_d_a)


def torque_per_ampere(pole_pairs: float, psi_wb: Values) -> Values:
    """Return the torque per q current (N m/A peak) of a flux linkage along d (Wb) that does not depend on i_q."""
    return 1.5 * pole_pairs * psi_wb


def iron_drag(pole_pairs: float, psi_wb: float, R_iron_ohm: float) -> float:
    """Return the drag (N m s/rad) of a resistor (ohm) across the flux voltage, which coasting counts to B."""
    return torque_per_ampere(pole_pairs, psi_wb) * pole_pairs * psi_wb / R_iron_ohm
