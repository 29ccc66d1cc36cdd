# SPDX-License-Identifier: MIT
"""The few nodes of a flux map that a control law carries: fluxes for its feed-forward, inductances for its gains.

Each node holds psi_d, psi_q/i_q, dpsi_d/di_d and dpsi_q/di_q, bilinear between nodes (``firmware/core/saturation.c``).
The half plane i_q >= 0 is enough: a machine without skew has psi_d even and psi_q odd in i_q. A map that is not quite
so is symmetrised.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.machine.flux_map import FluxMap

NODES_D, NODES_Q = 7, 7
"""784 bytes. Nodes 5 x 5, 9 x 9 and 17 x 33 settle alike (median within 10 %), 4 x 4 takes half as long again on
references that the voltage does not reach; 7 x 7 halves the error of the flux of 5 x 5 (docs/control.md)."""

REACH = 1.1
"""Extent of the table over I_max: what overshoots is on it."""

FORWARD_SHARE = 0.5
"""Extent along positive i_d over that: no design asks for it, a step may pass there."""


@dataclass(frozen=True, slots=True, eq=False)
class SaturationTable:
    """Nodes over an equidistant grid of currents."""

    i_d_a: Array
    i_q_a: Array
    """Axes (A peak); i_q begins at 0. Shape (n_d,), (n_q,)."""
    nodes: Array
    """psi_d (Wb), psi_q/i_q, dpsi_d/di_d, dpsi_q/di_q (H). Shape (n_d, n_q, 4)."""
    flux_error_wb: float
    """Largest distance of its flux from the map's, at currents up to I_max on the table."""

    def descriptor(self) -> dict[str, float]:
        """Return what a parameter set says of it: counts, and ends of the axes (A)."""
        i_d, i_q = self.i_d_a, self.i_q_a
        ends = {"i_d_min_a": float(i_d[0]), "i_d_max_a": float(i_d[-1]), "i_q_max_a": float(i_q[-1])}
        return {"n_d": float(len(i_d)), "n_q": float(len(i_q)), **ends}

    def flux(self, i_d_a: Array, i_q_a: Array) -> tuple[Array, Array]:
        """Return psi_d, psi_q (Wb) between the nodes, at currents (A peak) on the table of any one shape."""
        value = _bilinear(self, i_d_a, np.abs(i_q_a))
        return value[..., 0], value[..., 1] * i_q_a


def saturation_table(flux_map: FluxMap, I_max_apk: float) -> SaturationTable | None:
    """Return the table of a map for currents (A peak) up to ``I_max_apk``.

    None where a node's inductance is not positive: nothing can follow that.
    """
    reach = REACH * I_max_apk
    low, high = max(-reach, flux_map.i_d_a[0]), min(FORWARD_SHARE * reach, flux_map.i_d_a[-1])
    both = flux_map.i_q_a[0] < 0.0
    q_most = min(reach, flux_map.i_q_a[-1], *((-flux_map.i_q_a[0],) if both else ()))
    i_d, i_q = np.linspace(low, high, NODES_D), np.linspace(0.0, q_most, NODES_Q)
    grid_d, grid_q = np.meshgrid(i_d, i_q, indexing="ij")
    sides = (1.0, -1.0) if both else (1.0,)
    psi_d, psi_q, L_d, L_q = (
        np.mean(side, axis=0) for side in zip(*(_side(flux_map, grid_d, s * grid_q, s) for s in sides), strict=True)
    )
    apparent = np.divide(psi_q, grid_q, out=L_q.copy(), where=grid_q > 0.0)
    nodes = np.stack([psi_d, apparent, L_d, L_q], axis=-1)
    if not np.all(nodes[..., 1:] > 0.0):
        return None
    table = SaturationTable(i_d, i_q, nodes, 0.0)
    fine_d, fine_q = np.meshgrid(
        np.linspace(low, high, 4 * NODES_D), np.linspace(0.0, q_most, 4 * NODES_Q), indexing="ij"
    )
    used = np.hypot(fine_d, fine_q) <= I_max_apk
    found, true = table.flux(fine_d, fine_q), flux_map.flux(fine_d, fine_q)
    error = np.hypot(found[0] - true[0], found[1] - true[1])[used]
    return SaturationTable(i_d, i_q, nodes, float(error.max(initial=0.0)))


def _side(flux_map: FluxMap, i_d: Array, i_q: Array, sign: float) -> tuple[Array, Array, Array, Array]:
    """psi_d, sign psi_q, and the incremental inductances of the axes."""
    psi_d, psi_q = flux_map.flux(i_d, i_q)
    jacobian = flux_map.incremental_inductance(i_d, i_q)
    return psi_d, sign * psi_q, jacobian[0, 0], jacobian[1, 1]


def _bilinear(table: SaturationTable, i_d: Array, i_q: Array) -> Array:
    x, row = _place(table.i_d_a, i_d)
    y, column = _place(table.i_q_a, i_q)
    n = table.nodes
    low = n[row, column] + y * (n[row, column + 1] - n[row, column])
    high = n[row + 1, column] + y * (n[row + 1, column + 1] - n[row + 1, column])
    return np.asarray(low + x * (high - low))


def _place(axis: Array, i: Array) -> tuple[Array, NDArray[np.intp]]:
    at = (i - axis[0]) / (axis[1] - axis[0])
    left = np.clip(at.astype(np.intp), 0, len(axis) - 2)
    return (at - left)[..., None], left
