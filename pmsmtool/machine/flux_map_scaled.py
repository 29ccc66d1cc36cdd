# SPDX-License-Identifier: MIT
"""A flux map as another machine of the same kind has it: other inductances and another magnet, nothing fitted again.

psi_d' = k_psi psi_f + k_d (psi_d - psi_f), psi_q' = k_q psi_q. The inverse table i(psi), which is the simulated
machine, holds polynomials over normalised cells: stretching its flux axes is the scaled machine exactly, and all
machines share the cells. Of the forward table a simulation asks only for the flux without current and for the smallest
inductance; it is replaced by one cell with just these.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pmsmtool.machine.flux_map import FluxMap
from pmsmtool.machine.flux_map_cells import FluxMapStruct, pointer

Array = NDArray[np.float64]

_AXIS = np.array([-1.0, 1.0])
"""Nodes (A) of the one forward cell; beyond, it is continued linearly."""


@dataclass(frozen=True, slots=True)
class FluxScale:
    """Factors over the nominal machine.

    Attributes
    ----------
    L_d, L_q : float
        Of what the currents add to the flux along each axis.
    psi_f : float
        Of the magnet's flux.
    """

    L_d: float = 1.0
    L_q: float = 1.0
    psi_f: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class ScalableMap:
    """A map prepared for many machines.

    Attributes
    ----------
    base : FluxMapStruct
        Both tables of the nominal machine.
    psi_f_wb : float
        Magnet flux (Wb) that ``FluxScale.psi_f`` applies to.
    psi_zero_wb : tuple of float
        Fluxes without current (Wb).
    L_least_h : float
        Smallest differential inductance over the nodes (H).
    """

    base: FluxMapStruct
    psi_f_wb: float
    psi_zero_wb: tuple[float, float]
    L_least_h: float

    @classmethod
    def of(cls, flux_map: FluxMap, psi_f_wb: float) -> ScalableMap:
        """Prepare a map; ``ConfigError`` when it cannot be inverted."""
        psi_d, psi_q = flux_map.flux(0.0, 0.0)
        L = np.moveaxis(flux_map.incremental_inductance(*np.meshgrid(flux_map.i_d_a, flux_map.i_q_a)), (0, 1), (-2, -1))
        least = np.linalg.eigvalsh(0.5 * (L + np.swapaxes(L, -2, -1)))[..., 0]
        return cls(flux_map.as_struct(), psi_f_wb, (float(psi_d), float(psi_q)), float(least[least > 0.0].min()))

    def struct(self, scale: FluxScale) -> FluxMapStruct:
        """Return the scaled machine for the simulation; the struct keeps its arrays alive."""
        base, shift = self.base, (scale.psi_f - scale.L_d) * self.psi_f_wb
        L = min(scale.L_d, scale.L_q) * self.L_least_h
        cells = np.zeros((1, 1, 4, 4, 2))
        cells[0, 0, 0, 0] = scale.L_d * self.psi_zero_wb[0] + shift - L, scale.L_q * self.psi_zero_wb[1] - L
        cells[0, 0, 0, 1, 0] = cells[0, 0, 1, 0, 1] = 2.0 * L
        made = FluxMapStruct.from_buffer_copy(base)
        made.i_d = made.i_q = pointer(_AXIS)
        made.i_d_per_step = made.i_q_per_step = 0.5
        made.n_i_d = made.n_i_q = len(_AXIS)
        made.cells = pointer(cells)
        made.psi_d_min = scale.L_d * base.psi_d_min + shift
        made.psi_d_step, made.psi_d_per_step = scale.L_d * base.psi_d_step, base.psi_d_per_step / scale.L_d
        made.psi_q_min = scale.L_q * base.psi_q_min
        made.psi_q_step, made.psi_q_per_step = scale.L_q * base.psi_q_step, base.psi_q_per_step / scale.L_q
        made.arrays = (*base.arrays, cells)
        return made
