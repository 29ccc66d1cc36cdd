"""A flux map as another machine of the same kind has it: other inductances and another magnet, nothing fitted again.

psi_d' = k_psi psi_f + k_d (psi_d - psi_f), psi_q' = k_q psi_q. Both tables are polynomials over normalised cells, so
the forward cells are scaled and the flux axes of the inverse table are stretched: the result is exact, not
interpolated anew, and inverse and forward table keep their distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pmsmtool.machine.flux_map import FluxMap
from pmsmtool.machine.flux_map_cells import FluxMapStruct, pointer


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


def scaled_struct(flux_map: FluxMap, scale: FluxScale, psi_f_wb: float) -> FluxMapStruct:
    """Return both tables of the scaled map for C; the struct keeps its arrays alive.

    Parameters
    ----------
    flux_map : FluxMap
        Map of the nominal machine.
    scale : FluxScale
        Factors, positive.
    psi_f_wb : float
        Magnet flux (Wb) that ``scale.psi_f`` applies to.
    """
    base = flux_map.as_struct()
    cells = flux_map.forward.cells * np.array([scale.L_d, scale.L_q])
    shift = (scale.psi_f - scale.L_d) * psi_f_wb
    cells[:, :, 0, 0, 0] += shift
    made = FluxMapStruct.from_buffer_copy(base)
    made.cells = pointer(cells)
    made.psi_d_min = scale.L_d * base.psi_d_min + shift
    made.psi_d_step, made.psi_d_per_step = scale.L_d * base.psi_d_step, base.psi_d_per_step / scale.L_d
    made.psi_q_min = scale.L_q * base.psi_q_min
    made.psi_q_step, made.psi_q_per_step = scale.L_q * base.psi_q_step, base.psi_q_per_step / scale.L_q
    made.arrays = (*base.arrays, cells)
    return made
