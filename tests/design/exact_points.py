# SPDX-License-Identifier: MIT
"""Operating points of a machine with constant inductances, enumerated exactly by roots of polynomials.

Nothing here comes from the product. Under a current circle, a voltage ellipse with resistance and a demagnetisation
limit, every least current and every extreme torque on the branch psi_f + (L_d - L_q) i_d > 0 is a root of a polynomial
of at most fourth degree, in i_d or in exp(j angle). All roots are listed, polished by Newton on the two equations they
come from, and the best admissible one is taken. Lengths are in units of I_max.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Equation = Callable[[Array, Array], tuple[Array, Array, Array]]
"""A curve of the plane: its value and slopes along i_d and i_q."""

NEARLY_REAL = 1e-5
"""How far rounding may push a double root off the real axis or the unit circle: sqrt(1e-16), with room."""

ON_LIMIT = 1e-11
"""A point may lie this far outside a limit, relative, and is on it (polished roots: 1e-14)."""

POLISH_STEPS = 5


@dataclass(frozen=True, slots=True)
class Point:
    """An operating point (A peak); NaN: there is none."""

    i_d: float
    i_q: float


@dataclass(frozen=True)
class LinearCase:
    """Constant inductances (H), magnet (Wb), resistance (ohm), electrical speed (rad/s), limits (V, A)."""

    R: float
    L_d: float
    L_q: float
    psi_f: float
    omega: float
    V: float
    I_max: float
    i_d_min: float = -math.inf

    # -- curves, currents over I_max ----------------------------------------------------------------

    def torque(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Torque over 1.5 p I_max^2."""
        k = self.L_d - self.L_q
        u = self.psi_f / self.I_max + k * x
        return y * u, k * y, u

    def voltage(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """|v|^2 / V^2 - 1."""
        s, w = self.I_max / self.V, self.omega
        v_d = s * (self.R * x - w * self.L_q * y)
        v_q = s * (self.R * y + w * (self.psi_f / self.I_max + self.L_d * x))
        by_d, by_q = self.R * v_d + w * self.L_d * v_q, self.R * v_q - w * self.L_q * v_d
        return v_d**2 + v_q**2 - 1.0, 2.0 * s * by_d, 2.0 * s * by_q

    def circle(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """|i|^2 / I_max^2 - 1."""
        return x * x + y * y - 1.0, 2.0 * x, 2.0 * y

    def level_at(self, point: Point) -> float:
        """Torque over 1.5 p (Wb A)."""
        return point.i_q * (self.psi_f + (self.L_d - self.L_q) * point.i_d)

    def voltage_at(self, point: Point) -> float:
        """Amplitude of the steady-state voltage (V)."""
        v_d = self.R * point.i_d - self.omega * self.L_q * point.i_q
        return math.hypot(v_d, self.R * point.i_q + self.omega * (self.psi_f + self.L_d * point.i_d))

    # -- points -------------------------------------------------------------------------------------

    def admissible(self, x: Array, y: Array) -> NDArray[np.bool_]:
        """Which points keep every limit and lie on the branch."""
        on_branch = self.torque(x, y)[2] > 0.0
        inside = (self.circle(x, y)[0] <= 2.0 * ON_LIMIT) & (self.voltage(x, y)[0] <= 2.0 * ON_LIMIT)
        return np.asarray(on_branch & inside & (x >= self.i_d_min / self.I_max - ON_LIMIT))

    def extreme_torques(self) -> tuple[Point, Point]:
        """Points of least and largest torque inside all limits; NaN where nothing is admissible."""
        turn = 2.0 * math.pi * np.arange(8) / 8.0
        circle = np.cos(turn), np.sin(turn)
        found = [_on_turn(*circle, self.voltage, self.circle), _on_turn(*circle, self.torque, self.circle, True)]
        Z = np.array([[self.R, -self.omega * self.L_q], [self.omega * self.L_d, self.R]])
        if np.linalg.det(Z) != 0.0:
            v = self.V * np.array(circle) - np.array([[0.0], [self.omega * self.psi_f]])
            ellipse = np.linalg.solve(Z, v) / self.I_max
            found.append(_on_turn(ellipse[0], ellipse[1], self.torque, self.voltage, True))
        found.append(self._on_column())
        x, y = (np.concatenate(part) for part in zip(*found, strict=True))
        kept = self.admissible(x, y)
        if not kept.any():
            return Point(math.nan, math.nan), Point(math.nan, math.nan)
        x, y = x[kept], y[kept]
        level = self.torque(x, y)[0]
        ends = int(np.argmin(level)), int(np.argmax(level))
        least, largest = (Point(float(x[k]) * self.I_max, float(y[k]) * self.I_max) for k in ends)
        return least, largest

    def least_current(self, level: float) -> Point:
        """Point of least current whose torque is ``level`` times 1.5 p; NaN when none is admissible."""
        a, k, T = self.psi_f / self.I_max, self.L_d - self.L_q, level / self.I_max**2
        u = np.array([k, a])
        s, w = self.I_max / self.V, self.omega
        A, B = (s * self.R) ** 2 + (s * w * self.L_d) ** 2, (s * self.R) ** 2 + (s * w * self.L_q) ** 2
        C, D, E = 2.0 * s * s * self.R * w * k, 2.0 * (s * w) ** 2 * a * self.L_d, 2.0 * s * s * self.R * w * a
        F = (s * w * a) ** 2 - 1.0
        if T == 0.0:
            x = np.concatenate(([0.0], _real_roots(np.array([A, D, F])), self._column_x()))
        else:
            u2 = np.polymul(u, u)
            mixed = np.polyadd(T * np.polymul([C, E], u), [B * T * T])
            limit = np.polyadd(np.polymul([A, D, F], u2), mixed)
            least = np.polysub(np.polymul(np.polymul(u2, u), [1.0, 0.0]), [k * T * T])
            edge = np.polyadd(np.polymul([1.0, 0.0, -1.0], u2), [T * T])
            x = np.concatenate((_real_roots(limit), _real_roots(least), _real_roots(edge), self._column_x()))
        x = x[a + k * x > 0.0]
        x, y = self._on_contour(x, T)
        kept = self.admissible(x, y)
        if not kept.any():
            return Point(math.nan, math.nan)
        best = int(np.argmin(np.where(kept, np.hypot(x, y), np.inf)))
        return Point(float(x[best]) * self.I_max, float(y[best]) * self.I_max)

    def _on_contour(self, x: Array, T: float) -> tuple[Array, Array]:
        """Each root as it is, and polished onto the voltage ellipse along its torque contour."""
        a, k = self.psi_f / self.I_max, self.L_d - self.L_q
        y = T / (a + k * x) if T != 0.0 else np.zeros_like(x)
        polished = _polished(x, y, lambda p, q: (self.torque(p, q)[0] - T, *self.torque(p, q)[1:]), self.voltage)
        return np.concatenate((x, polished[0])), np.concatenate((y, polished[1]))

    def _column_x(self) -> Array:
        return np.array([self.i_d_min / self.I_max]) if self.i_d_min > -self.I_max else np.empty(0)

    def _on_column(self) -> tuple[Array, Array]:
        """Where the demagnetisation limit meets circle and ellipse; torque is linear along it."""
        x = self._column_x()
        if x.size == 0:
            return x, x
        constant = float(self.voltage(x, np.zeros(1))[0][0])
        sides = [float(self.voltage(x, np.array([q]))[0][0]) for q in (1.0, -1.0)]
        y = _real_roots(np.array([0.5 * sum(sides) - constant, 0.5 * (sides[0] - sides[1]), constant]))
        reach = math.sqrt(1.0 - float(x[0]) ** 2)
        y = np.concatenate((y, [reach, -reach]))
        return np.full(y.size, x[0]), y


def _real_roots(coefficients: Array) -> Array:
    """Real roots in [-2, 2], highest power first, with those that rounding may have made complex."""
    given = coefficients / np.abs(coefficients).max()
    roots = np.roots(given[int(np.argmax(np.abs(given) > 1e-16)) :])
    kept = roots[(np.abs(roots.imag) < NEARLY_REAL) & (np.abs(roots.real) <= 2.0)]
    return np.asarray(kept.real)


def _on_turn(x: Array, y: Array, function: Equation, curve: Equation, slope: bool = False) -> tuple[Array, Array]:
    """Zeros of a quadratic function, or of its slope, along an ellipse given by eight equal steps of its angle."""
    powers = np.fft.fft(function(x, y)[0]) / 8.0  # of exp(j angle): -2 to 2, nothing beyond
    number = np.array([2, 1, 0, -1, -2])
    polynomial = powers[number] * (1j * number if slope else 1.0)
    if not np.abs(polynomial).max() > 0.0:
        return np.empty(0), np.empty(0)
    z = np.roots(polynomial / np.abs(polynomial).max())
    z = z[np.abs(np.abs(z) - 1.0) < NEARLY_REAL]
    z = z / np.abs(z)
    at = []
    for part in (x, y):
        c = np.fft.fft(part) / 8.0
        at.append(np.asarray((c[0] + c[1] * z + c[-1] / z).real))
    if slope:
        return _polished(at[0], at[1], _parallel(function, curve), curve)
    return _polished(at[0], at[1], function, curve)


def _parallel(function: Equation, curve: Equation) -> Equation:
    """Where the gradients of two quadratics are parallel; its slopes from differences, exact for quadratics."""

    def cross(x: Array, y: Array) -> Array:
        _, f_x, f_y = function(x, y)
        _, c_x, c_y = curve(x, y)
        return np.asarray(f_x * c_y - f_y * c_x)

    def equation(x: Array, y: Array) -> tuple[Array, Array, Array]:
        h = 0.5
        by_x, by_y = cross(x + h, y) - cross(x - h, y), cross(x, y + h) - cross(x, y - h)
        return cross(x, y), by_x / (2.0 * h), by_y / (2.0 * h)

    return equation


def _polished(x: Array, y: Array, first: Equation, second: Equation) -> tuple[Array, Array]:
    """Newton on two equations; a root that would wander off stays where it was."""
    start = x, y
    with np.errstate(all="ignore"):
        for _ in range(POLISH_STEPS):
            f, f_x, f_y = first(x, y)
            g, g_x, g_y = second(x, y)
            det = f_x * g_y - f_y * g_x
            x, y = x - (g_y * f - f_y * g) / det, y - (f_x * g - g_x * f) / det
        near = np.hypot(x - start[0], y - start[1]) < 10.0 * NEARLY_REAL
    return np.where(near, x, start[0]), np.where(near, y, start[1])
