# SPDX-License-Identifier: MIT
"""Shortest possible current transfer under a voltage limit: the bound every controller is held against.

di/dt = F i + G u + e at constant speed, |u| <= V_max (circle) or u inside the inverter's hexagon, which stands still in
the stator frame and so turns in this one. A time T is enough iff for every direction q the target lies inside the
reachable set: q . (i_to - i_free(T)) - rho <= integral of the largest q . e^(F t) G u; the smallest such T is a root.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.errors import DesignInfeasible

VoltageSet = Literal["circle", "hexagon"]

DIRECTIONS = 72
"""Directions of the reachable set's support; the worst one is refined, so this only has to find it."""

QUADRATURE = 40
"""Points of Gauss and Legendre's rule over the transfer; 40 and 80 agree to 1e-11 over half a turn (circle)."""

TIME_RESOLUTION = 1e-9
"""Relative resolution of the time."""

LONGEST_S = 1.0
"""A transfer that takes longer is reported as impossible."""


@dataclass(frozen=True, slots=True)
class TransferProblem:
    """Machine, speed and voltage of a current transfer."""

    R: float
    L_d: float
    L_q: float
    psi_f: float
    """Constants (ohm, H, H, Wb)."""
    omega_e: float
    """Electrical speed (rad/s), constant."""
    V_max: float
    """Radius of the circle (V); the hexagon has this radius as its inscribed circle."""

    def system(self) -> tuple[Array, Array, Array]:
        """Return F, G and e."""
        w, L = self.omega_e, np.array([self.L_d, self.L_q])
        F = np.array([[-self.R / L[0], w * L[1] / L[0]], [-w * L[0] / L[1], -self.R / L[1]]])
        return F, np.diag(1.0 / L), np.array([0.0, -w * self.psi_f / L[1]])


def minimum_time(
    problem: TransferProblem,
    i_from: tuple[float, float],
    i_to: tuple[float, float],
    *,
    radius: float = 0.0,
    voltage: VoltageSet = "circle",
    theta_e: float = 0.0,
) -> float:
    """Return the shortest time (s) from one current to another, or to a ball around it, by the support function.

    Raises DesignInfeasible: the target cannot be reached within ``LONGEST_S``.

    Parameters
    ----------
    problem : TransferProblem
        Machine, speed, voltage.
    i_from, i_to : tuple of float
        Currents (A).
    radius : float
        Radius of the ball (A), e.g. the 2 % band.
    voltage : {"circle", "hexagon"}
        Set of voltages.
    theta_e : float
        Rotor angle at the start (rad), for the hexagon.
    """
    start, end = np.asarray(i_from, dtype=np.float64), np.asarray(i_to, dtype=np.float64)
    if float(np.hypot(*(end - start))) <= radius:
        return 0.0
    reach = _Reach(problem, start, end, radius, voltage, theta_e)
    low, f_low = 0.0, reach.shortfall(0.0)
    growth = _GROWTH
    high = flux_time(problem, start, end - radius * (end - start) / float(np.hypot(*(end - start)))) / growth
    while (f_high := reach.shortfall(high)) > 0.0:
        low, f_low, high, growth = high, f_high, growth * high, growth * growth
        if high > LONGEST_S:
            raise DesignInfeasible(
                f"the current ({end[0]:.4g}, {end[1]:.4g}) A cannot be reached",
                where="minimum time",
                likely="its steady-state voltage lies beyond the limit",
                hint="take a smaller current, a lower speed, or a larger voltage",
            )
    side = 0
    while high - low > TIME_RESOLUTION * high:  # bracketed secant (Illinois)
        middle = low + (high - low) * f_low / (f_low - f_high)
        middle = min(max(middle, low + 0.25 * TIME_RESOLUTION * high), high - 0.25 * TIME_RESOLUTION * high)
        f = reach.shortfall(middle)
        if f > 0.0:
            low, f_low, f_high, side = middle, f, f_high * (0.5 if side > 0 else 1.0), 1
        else:
            high, f_high, f_low, side = middle, f, f_low * (0.5 if side < 0 else 1.0), -1
    return high


_GROWTH = 1.05
"""First growth of the upper end, from a little below the time of straight flux steering; squared at each step."""

_HALF_TURNS_MAX = 12
"""More half turns than this are not resolved: a transfer that long ends at rest in the steady state anyway."""


@cache
def _rule(points: int) -> tuple[Array, Array]:
    nodes, weights = np.polynomial.legendre.leggauss(points)
    return nodes, weights


class _Reach:
    """How far the target is out of the reachable set after a time."""

    def __init__(
        self,
        problem: TransferProblem,
        start: Array,
        end: Array,
        radius: float,
        voltage: VoltageSet,
        theta_e: float,
    ) -> None:
        self.problem, self.start, self.end, self.radius = problem, start, end, radius
        self.voltage, self.theta_e = voltage, theta_e
        self.F, self.G, self.e = problem.system()
        self.flow = Flow(self.F)
        # the hexagon's support has corners in time: more points
        self.density = QUADRATURE * (8 if voltage == "hexagon" else 1)

    def shortfall(self, T: float) -> float:
        """Return max over q of q . (i_to - i_free) - rho - reach(q); not positive when T is enough."""
        half_turns = abs(self.problem.omega_e) * T / math.pi
        nodes, weights = _rule(self.density * min(math.ceil(1.0 + half_turns), _HALF_TURNS_MAX))
        t = 0.5 * T * (nodes + 1.0)
        # what a voltage at time T - t contributes at T is e^(F t) G u
        pushes = self.G @ np.swapaxes(self.flow.at(t), 1, 2)
        free = self.flow.at(np.array([T]))[0] @ self.start + self.flow.integral(T) @ self.e

        def gap(angles: Array) -> Array:
            q = np.array([np.cos(angles), np.sin(angles)])
            reach = 0.5 * T * (weights @ self._support(pushes @ q, T - t))
            return np.asarray((self.end - free) @ q - self.radius - reach)

        angles = 2.0 * math.pi * np.arange(DIRECTIONS) / DIRECTIONS
        values = gap(angles)
        best = int(np.argmax(values))
        centre, width = float(angles[best]), 2.0 * math.pi / DIRECTIONS
        for _ in range(_ZOOMS):
            around = centre + width * np.linspace(-1.0, 1.0, 9)
            values = gap(around)
            centre, width = float(around[int(np.argmax(values))]), 0.25 * width
        return float(values.max())

    def _support(self, g: Array, at: Array) -> Array:
        """Largest g . u over the voltages, g of shape (t, 2, n)."""
        V = self.problem.V_max
        size = np.hypot(g[:, 0], g[:, 1])
        if self.voltage == "circle":
            return np.asarray(V * size)
        # corners at multiples of 60 degree in the stator frame, radius V/cos(30 deg)
        stator = np.arctan2(g[:, 1], g[:, 0]) + (self.theta_e + self.problem.omega_e * at)[:, None]
        off = np.mod(stator + math.pi / 6.0, math.pi / 3.0) - math.pi / 6.0
        return np.asarray(V / math.cos(math.pi / 6.0) * np.cos(off) * size)


_ZOOMS = 8
"""Refinements of the worst direction: 2 pi / 72 * 0.25^8 = 1e-6 rad, an error of its square."""


class Flow:
    """e^(F t) and its integral in closed form for a 2 x 2 matrix."""

    def __init__(self, F: Array) -> None:
        self.F = F
        self.mean = 0.5 * float(np.trace(F))
        self.rest = F - self.mean * np.eye(2)
        self.root = cmath.sqrt(-float(np.linalg.det(self.rest)))

    def at(self, t: Array) -> Array:
        """Return e^(F t) at times (s), shape (n, 2, 2)."""
        s = self.root
        if abs(s) * float(np.max(np.abs(t), initial=0.0)) < 1e-8:
            even, odd = np.ones_like(t), t
        else:
            even, odd = np.cosh(s * t).real, (np.sinh(s * t) / s).real
        scale = np.exp(self.mean * t)
        return np.asarray((scale * even)[:, None, None] * np.eye(2) + (scale * odd)[:, None, None] * self.rest)

    def integral(self, T: float) -> Array:
        """Return the integral of e^(F t) from 0 to T."""
        if abs(float(np.linalg.det(self.F))) > 1e-12 * float(np.abs(self.F).max()) ** 2:
            return np.asarray(np.linalg.solve(self.F, self.at(np.array([T]))[0] - np.eye(2)))
        nodes, weights = np.polynomial.legendre.leggauss(QUADRATURE)
        return np.asarray(0.5 * T * np.einsum("t,tab->ab", weights, self.at(0.5 * T * (nodes + 1.0))))


def flux_time(problem: TransferProblem, start: Array, end: Array) -> float:
    """Return the time (s) to steer the stator flux in a straight line, the drop taken at the mean current.

    Smallest root of |e^(j w T) b - a + R T (i + r)/2| = V_max T; exact without resistance, at any saliency.
    """
    L_d, L_q, psi, R = problem.L_d, problem.L_q, problem.psi_f, problem.R
    a = complex(psi + L_d * start[0], L_q * start[1])
    b = complex(psi + L_d * end[0], L_q * end[1])
    drop = 0.5 * R * complex(start[0] + end[0], start[1] + end[1])

    def lack(T: float) -> float:
        return abs(cmath.exp(1j * problem.omega_e * T) * b - a + drop * T) - problem.V_max * T

    high = 1e-5
    while lack(high) > 0.0:
        high *= 1.05
        if high > LONGEST_S:
            return 1e-3
    low = high / 1.05
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if lack(middle) > 0.0 else (low, middle)
    return high
