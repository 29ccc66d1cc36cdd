# SPDX-License-Identifier: MIT
"""Co-energy of a machine as a tensor-product B-spline of the currents: a flux map that is reciprocal by construction.

W(i_d, i_q) = sum c_ab B_a(i_d) B_b(i_q) of degree 4; psi_d = dW/di_d and psi_q = dW/di_q are linear in c
(docs/identification.md, 3.3). Basis and derivatives by the recursion of Cox and de Boor (C. de Boor, A Practical
Guide to Splines, DOI 10.1007/978-1-4612-6333-3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pmsmtool.arrays import Array

DEGREE = 4
SPACING_D, SPACING_Q = 1.4, 1.6
"""Exponents of the break points, denser near zero where iron bridges saturate."""


def break_points(low: float, high: float, count: int, exponent: float) -> Array:
    """Return ``count`` points from ``low`` below zero to ``high`` above it, denser near zero, zero among them."""
    u = np.linspace(-1.0, 1.0, count if count % 2 else count + 1)
    shape = np.sign(u) * np.abs(u) ** exponent
    return np.where(shape < 0.0, -shape * low, shape * high)


def basis(breaks: Array, x: Array, derivative: int = 0) -> Array:
    """Return the clamped B-splines (or their derivative), shape (n, len(breaks) + DEGREE - 1).

    Parameters
    ----------
    breaks : ndarray, shape (k,)
        Increasing break points.
    x : ndarray, shape (n,)
        Arguments within the break points.
    derivative : int
        Order of the derivative.
    """
    knots = np.concatenate([np.full(DEGREE, breaks[0]), breaks, np.full(DEGREE, breaks[-1])])
    return _basis(knots, x, DEGREE, derivative)


def _basis(knots: Array, x: Array, degree: int, derivative: int) -> Array:
    if degree == 0:
        # the last interval is closed, so that the end of the range belongs to it
        last = len(knots) - 1 - int(np.argmax(knots[::-1] < knots[-1]))
        index = np.minimum(np.searchsorted(knots, x, side="right") - 1, last)
        out = np.zeros((len(x), len(knots) - 1))
        out[np.arange(len(x)), index] = 1.0
        return out
    lower = _basis(knots, x, degree - 1, max(derivative - 1, 0))
    width = knots[degree:] - knots[:-degree]
    per = np.divide(1.0, width, out=np.zeros_like(width), where=width > 0.0)
    if derivative > 0:
        scaled = degree * per * lower
        return np.asarray(scaled[:, :-1] - scaled[:, 1:])
    left = (x[:, None] - knots[None, :-degree]) * per * lower
    right = (knots[None, degree:] - x[:, None]) * per * lower
    return np.asarray(left[:, :-1] + right[:, 1:])


@dataclass(frozen=True, slots=True, eq=False)
class CoenergySpline:
    """The spline space over a rectangle of currents."""

    breaks_d: Array
    breaks_q: Array
    """Break points (A)."""

    @classmethod
    def over(cls, i_d_a: Array, i_q_a: Array, pieces: tuple[int, int]) -> CoenergySpline:
        """Span the range of the data; i_q symmetrically, so that the space has an even half."""
        largest = float(np.max(np.abs(i_q_a)))
        return cls(
            break_points(float(np.min(i_d_a)), float(np.max(i_d_a)), pieces[0], SPACING_D),
            break_points(-largest, largest, pieces[1], SPACING_Q),
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Number of functions along i_d and i_q."""
        return len(self.breaks_d) + DEGREE - 1, len(self.breaks_q) + DEGREE - 1

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return self.shape[0] * self.shape[1]

    def derivative(self, i_d_a: Array, i_q_a: Array, by_d: int, by_q: int) -> Array:
        """Return the rows of a partial derivative of W, shape (n, size)."""
        d = basis(self.breaks_d, np.clip(i_d_a, self.breaks_d[0], self.breaks_d[-1]), by_d)
        q = basis(self.breaks_q, np.clip(i_q_a, self.breaks_q[0], self.breaks_q[-1]), by_q)
        return np.asarray((d[:, :, None] * q[:, None, :]).reshape(len(d), -1))

    def flux(self, c: Array, i_d_a: Array, i_q_a: Array) -> Array:
        """Return psi_d, psi_q (Wb), shape (2, n)."""
        return np.stack([self.derivative(i_d_a, i_q_a, 1, 0) @ c, self.derivative(i_d_a, i_q_a, 0, 1) @ c])

    def inductance(self, c: Array, i_d_a: Array, i_q_a: Array) -> Array:
        """Return L_dd, L_dq, L_qq (H), shape (3, n)."""
        orders = ((2, 0), (1, 1), (0, 2))
        return np.stack([self.derivative(i_d_a, i_q_a, *order) @ c for order in orders])

    def even(self) -> Array:
        """Return the matrix (size, k) whose columns span the functions that are even in i_q."""
        n_d, n_q = self.shape
        half = (n_q + 1) // 2
        fold = np.zeros((n_q, half))
        for b in range(half):
            fold[b, b] = fold[n_q - 1 - b, b] = 1.0
        return np.asarray(np.kron(np.eye(n_d), fold), np.float64)

    def roughness(self) -> Array:
        """Return the quadratic form of the squared third differences of the coefficients, shape (size, size)."""
        n_d, n_q = self.shape
        third_d, third_q = (np.diff(np.eye(n), 3, axis=0) for n in (n_d, n_q))
        along_d, along_q = np.kron(third_d, np.eye(n_q)), np.kron(np.eye(n_d), third_q)
        return np.asarray(along_d.T @ along_d + along_q.T @ along_q)
