# SPDX-License-Identifier: MIT
"""An analytic saturating machine with cross-saturation: i(psi) in closed form, reciprocal by construction.

The machine of the profile ``saturated-pmsyrm``. The currents are the gradient of one field energy, so the flux map made
from them has no reciprocity error of its own.

References
----------
M. Lelli, M. Hinkkanen, F. Giulii Capponi, "A saturation model based on a simplified equivalent magnetic circuit for
permanent magnet machines", ICEM 2024, DOI 10.1109/ICEM60801.2024.10700403: the form of the model; the constants are
those published for a 5.6-kW PM-assisted synchronous reluctance machine.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pmsmtool.machine.flux_map import FluxMap

Array = NDArray[np.float64]

MAP_DIGITS = 10
"""Decimals of the tabulated fluxes (Wb): the same text whatever the platform's power function rounds to."""

_NEWTON_STEPS = 100
_NEWTON_TOLERANCE_A = 1e-11


@dataclass(frozen=True, slots=True)
class BridgeSaturation:
    """i_d = g_d psi_d + g_b psi_b, i_q = (g_q + k_q g_b) psi_q with psi_b = psi_d - psi_n.

    g_d = a_d0 + a_dd psi_d^4 + (a_dq/3) |psi_d| |psi_q|^3, g_q = a_q0 + a_qq psi_q^6 + (a_dq/3) |psi_d|^3 |psi_q|,
    g_b = a_b s/(1 + s), s = psi_b^2 + k_q psi_q^2 (the saturating iron bridges). Reluctances in A/Wb, psi_n in Wb.
    """

    a_d0: float = 3.96
    a_dd: float = 28.5
    a_q0: float = 5.89
    a_qq: float = 2.67
    a_dq: float = 41.5
    a_b: float = 81.75
    k_q: float = 0.1
    psi_n: float = 0.804

    def current(self, psi_d_wb: ArrayLike, psi_q_wb: ArrayLike) -> tuple[Array, Array]:
        """Return i_d, i_q (A peak) at fluxes (Wb) of any shape."""
        d, q = np.asarray(psi_d_wb, float), np.asarray(psi_q_wb, float)
        bridge = d - self.psi_n
        s = bridge**2 + self.k_q * q**2
        g_b = self.a_b * s / (1.0 + s)
        g_d = self.a_d0 + self.a_dd * d**4 + self.a_dq / 3.0 * np.abs(d) * np.abs(q) ** 3
        g_q = self.a_q0 + self.a_qq * q**6 + self.a_dq / 3.0 * np.abs(d) ** 3 * np.abs(q)
        return g_d * d + g_b * bridge, (g_q + self.k_q * g_b) * q

    def flux(self, i_d_a: ArrayLike, i_q_a: ArrayLike) -> tuple[Array, Array]:
        """Return psi_d, psi_q (Wb) at currents (A peak) of any shape, by damped Newton.

        Raises
        ------
        ArithmeticError
            A point does not converge (the currents are far outside the machine).
        """
        want = np.array(np.broadcast_arrays(np.asarray(i_d_a, float), np.asarray(i_q_a, float)))
        psi = np.stack([np.full(want.shape[1:], 0.4), 0.05 * want[1]])
        residual = np.array(self.current(*psi)) - want
        for _ in range(_NEWTON_STEPS):
            error = np.abs(residual).max(axis=0)
            if np.all(error <= _NEWTON_TOLERANCE_A):
                return psi[0], psi[1]
            step = self._newton_step(psi, residual)
            size = np.ones(want.shape[1:])
            for _ in range(30):
                trial = psi - size * step
                after = np.array(self.current(*trial)) - want
                worse = np.abs(after).max(axis=0) > np.maximum(error, _NEWTON_TOLERANCE_A)
                if not worse.any():
                    break
                size = np.where(worse, size / 2.0, size)
            psi, residual = trial, after
        raise ArithmeticError(f"no flux found for {int(np.sum(error > _NEWTON_TOLERANCE_A))} currents")

    def _newton_step(self, psi: Array, residual: Array) -> Array:
        """J^-1 residual with J = d i/d psi by central differences."""
        h = 1e-6
        by_d = (np.array(self.current(psi[0] + h, psi[1])) - np.array(self.current(psi[0] - h, psi[1]))) / (2 * h)
        by_q = (np.array(self.current(psi[0], psi[1] + h)) - np.array(self.current(psi[0], psi[1] - h))) / (2 * h)
        det = by_d[0] * by_q[1] - by_q[0] * by_d[1]
        step_d = (by_q[1] * residual[0] - by_q[0] * residual[1]) / det
        step_q = (by_d[0] * residual[1] - by_d[1] * residual[0]) / det
        return np.stack([step_d, step_q])


def saturated_pmsyrm_map(form: BridgeSaturation = BridgeSaturation()) -> FluxMap:
    """Return a flux map like that of the profile ``saturated-pmsyrm``: 53 x 53 nodes, +-26 A, the trip current."""
    i_d = i_q = np.arange(-26.0, 27.0)
    psi_d, psi_q = form.flux(*np.meshgrid(i_d, i_q, indexing="ij"))
    origin = "analytic model, Lelli, Hinkkanen, Giulii Capponi, ICEM 2024, 5.6-kW PM-SyRM"
    # + 0.0 turns -0.0 into 0.0
    tabulated_d, tabulated_q = (np.round(psi, MAP_DIGITS) + 0.0 for psi in (psi_d, psi_q))
    return FluxMap(i_d, i_q, tabulated_d, tabulated_q, meta={"origin": origin})
