# SPDX-License-Identifier: MIT
"""Reciprocity of a flux map: loop integrals of the co-energy, and the nearest map that has one.

A lossless machine has a co-energy W(i) with psi = grad W, so d psi_d/d i_q = d psi_q/d i_d and the integral of
psi . di around every loop is zero.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pmsmtool.machine.flux_map import FluxMap

Array = NDArray[np.float64]

CG_TOLERANCE = 1e-13
"""Relative residual at which the reciprocal projection stops."""


def spline_slopes_matrix(axis: Array) -> Array:
    """Return the matrix (n, n) that maps node values to the node slopes of their not-a-knot cubic spline."""
    n, h = len(axis), np.diff(axis)
    left, right = np.zeros((n, n)), np.zeros((n, n))
    for m in range(1, n - 1):
        left[m, m - 1 : m + 2] = h[m], 2.0 * (h[m - 1] + h[m]), h[m - 1]
        right[m, m - 1] = -3.0 * h[m] / h[m - 1]
        right[m, m + 1] = 3.0 * h[m - 1] / h[m]
        right[m, m] = -right[m, m - 1] - right[m, m + 1]
    for row, a, b, sign in ((0, h[0], h[1], 1), (n - 1, h[-1], h[-2], -1)):
        order = (0, 1, 2) if sign > 0 else (n - 1, n - 2, n - 3)
        left[row, order[0]], left[row, order[1]] = b, a + b
        d_0, d_1 = (3.0 * a + 2.0 * b) * b / (a + b), a * a / (a + b)  # of the slopes of the end intervals
        right[row, order[0]] -= sign * d_0 / a
        right[row, order[1]] += sign * (d_0 / a - d_1 / b)
        right[row, order[2]] += sign * d_1 / b
    return np.asarray(np.linalg.solve(left, right))


def _edge_integrals(axis: Array) -> Array:
    """Matrix (n - 1, n): integral of the spline through node values over each interval."""
    n, h = len(axis), np.diff(axis)
    average = np.zeros((n - 1, n))
    average[np.arange(n - 1), np.arange(n - 1)] = average[np.arange(n - 1), np.arange(1, n)] = 0.5
    slopes = spline_slopes_matrix(axis)
    return np.asarray(h[:, None] * average + (h**2 / 12.0)[:, None] * (slopes[:-1] - slopes[1:]))


class LoopIntegrals:
    """Loop integral of psi . di around each cell, and its adjoint.

    A reciprocal map has a co-energy, so every loop integral is zero. Edges are integrated on the splines of
    the map, so that a smooth reciprocal machine is not accused of its curvature.
    """

    def __init__(self, i_d_a: Array, i_q_a: Array) -> None:
        self.along_d, self.along_q = _edge_integrals(i_d_a), _edge_integrals(i_q_a)

    def __call__(self, psi_d: Array, psi_q: Array) -> Array:
        """Loop integrals (J), shape (n_d - 1, n_q - 1)."""
        return np.asarray(np.diff(self.along_d @ psi_d, axis=1) - np.diff(psi_q @ self.along_q.T, axis=0))

    def adjoint(self, weight: Array) -> tuple[Array, Array]:
        """Adjoint of the call."""
        pad_d, pad_q = np.pad(weight, ((0, 0), (1, 1))), np.pad(weight, ((1, 1), (0, 0)))
        return self.along_d.T @ -np.diff(pad_d, axis=1), np.diff(pad_q, axis=0) @ self.along_q


def reciprocal_change(flux_map: FluxMap) -> tuple[Array, Array]:
    """Return the least change of (psi_d, psi_q) (Wb, in the sum of squares over the nodes) that makes all loops zero.

    Minimum-norm solution -C' (C C')^-1 C psi of C (psi + change) = 0 by conjugate gradients.
    """
    loops = LoopIntegrals(flux_map.i_d_a, flux_map.i_q_a)
    residual = loops(flux_map.psi_d_wb, flux_map.psi_q_wb)
    weight, direction = np.zeros_like(residual), residual.copy()
    square = first = float(np.sum(residual**2))
    for _ in range(4 * residual.size):
        if square <= CG_TOLERANCE**2 * first or square == 0.0:
            break
        image = loops(*loops.adjoint(direction))
        length = square / float(np.sum(direction * image))
        weight += length * direction
        residual = residual - length * image
        last, square = square, float(np.sum(residual**2))
        direction = residual + (square / last) * direction
    change_d, change_q = loops.adjoint(weight)
    return -change_d, -change_q
