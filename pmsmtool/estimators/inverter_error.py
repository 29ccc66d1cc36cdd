# SPDX-License-Identifier: MIT
"""The voltage error of one inverter phase as data: what the drive loses between command and terminal.

What the ripple of pulse-width modulation does to an inverter's voltage error near a zero crossing.

Dead time t_d acts at the two edges of each leg, and there the current differs from its sampled value. At the rising
edge a current that leaves the leg waits for the upper switch, one that enters it swings the output by itself; at the
falling edge it is the other way round. With e the measured curve of one leg and T_s/U_dc volts to seconds, the edges
come late by

    tau_rise = t_d - max(0, e(-i_rise)) T_s/U_dc,      tau_fall = t_d - max(0, e(i_fall)) T_s/U_dc,

and the leg loses (tau_rise - tau_fall) U_dc/T_s: e(i) where both edges see i, nothing where the current passes zero
between them. The current at an edge is the sample, in the middle of the zero vector, plus the integral of what the legs
apply beyond their mean, over the inductances of the two axes; it moves the edges, so the two are iterated.

At standstill all legs switch together, and the curve measured then is sharper than what a machine that turns sees. It
is not quite the curve of one edge either: the edges of the two legs that carry the current lie e T_s/U_dc apart, which
makes the current at the edge that swings by itself e T_s/(4 L) larger than the sample.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.estimators.least_squares import levenberg_marquardt

KNEE_RANGE = 10.0
"""Ratio by which a knee may lie below the smallest level, or above the largest."""
PHASE_FACTOR = math.sqrt(3.0) / 2.0
"""Current of a phase over that of a vector that leaves one phase idle; its voltage error has the same factor, because
v_beta = (e_b - e_c)/sqrt 3 with e_b = -e_c."""
SAME_LEVEL = 1.1
"""Ratio of currents above which two points are different levels."""


@dataclass(frozen=True, slots=True)
class InverterCurve:
    """Voltage error of one phase, odd in its current."""

    i_phase_a: Array
    """Phase current, increasing and positive (A). Shape (n,)."""
    u_error_v: Array
    """Command minus terminal voltage beyond R i, mean of both signs (V). Shape (n,)."""
    asymmetry_v: float
    """Largest difference between the signs (V)."""

    def error_v(self, i_phase_a: Array) -> Array:
        """Error at any phase current: linear between the points and through zero, constant beyond the last (V)."""
        magnitude = np.abs(i_phase_a)
        x = np.concatenate([[0.0], self.i_phase_a])
        y = np.concatenate([[0.0], self.u_error_v])
        return np.asarray(np.sign(i_phase_a) * np.interp(magnitude, x, y), dtype=np.float64)

    def vector_error_v(self, i_a: Array) -> Array:
        """Error along a vector that leaves one phase idle, at its currents (V)."""
        return self.error_v(PHASE_FACTOR * i_a) / PHASE_FACTOR

    def error_dq_v(self, i_d_a: Array, i_q_a: Array, theta_e_rad: Array) -> tuple[Array, Array]:
        """Error of the three phases in a frame at ``theta_e_rad`` (V, amplitude-invariant)."""
        e_alpha, e_beta = stator_frame(self.error_v(phases_of(i_d_a, i_q_a, theta_e_rad)))
        c, s = np.cos(theta_e_rad), np.sin(theta_e_rad)
        return c * e_alpha + s * e_beta, c * e_beta - s * e_alpha

    def along_axis(self, frame_rad: float, axis: str, i_a: Array, other_a: float, bias_a: float) -> tuple[Array, Array]:
        """Error along one axis of a frozen frame (V), of the legs that take current in and of those that feed it out.

        Parameters
        ----------
        frame_rad : float
            Angle of the frame (rad electrical).
        axis : str
            ``d`` or ``q``.
        i_a : ndarray, shape (n,)
            Current along the axis (A).
        other_a, bias_a : float
            Constant current of the other axis, and mean current of this one (A): they give the legs their signs.
        """
        early = np.zeros_like(i_a)
        late = np.zeros_like(i_a)
        for k in range(3):
            angle = frame_rad - 2.0 * math.pi / 3.0 * k
            along, across = (math.cos(angle), -math.sin(angle)) if axis == "d" else (-math.sin(angle), math.cos(angle))
            error = 2.0 / 3.0 * along * self.error_v(along * i_a + across * other_a)
            if along * bias_a + across * other_a > 0.0:
                late += error
            else:
                early += error
        return early, late

    def knee_a(self, V_plateau_v: float) -> float:
        """Current at which a ramp to the plateau fits the curve best (A): the drive's compensation has that shape."""
        x, y = self.i_phase_a, self.u_error_v
        if V_plateau_v == 0.0:
            return float(x[0])

        # an inverter without an error has a plateau and a curve of noise, which fit with no knee at all
        low, high = math.log(x[0] / KNEE_RANGE), math.log(x[-1] * KNEE_RANGE)

        def residual(log_knee: Array) -> Array:
            knee = math.exp(min(max(float(log_knee[0]), low), high))
            return np.asarray(y / V_plateau_v - np.minimum(1.0, x / knee), dtype=np.float64)

        # the cost has kinks at the points: start from the best of a coarse scan
        starts = np.log(np.geomspace(0.2 * x[0], x[-1], 40))
        best = min(starts, key=lambda s: float(np.sum(residual(np.array([s])) ** 2)))
        fit = levenberg_marquardt(residual, np.array([best]), np.array([1.0]))
        return math.exp(min(max(float(fit.x[0]), low), high))


def curve_from_levels(i_vector_a: Array, u_vector_v: Array) -> InverterCurve:
    """Curve of one phase from the remainder of DC levels along a vector with one phase idle.

    Parameters
    ----------
    i_vector_a, u_vector_v : ndarray, shape (n,)
        Vector current and v - R i - v0 of each level, both signs.
    """
    magnitude = np.abs(i_vector_a)
    odd = np.sign(i_vector_a) * u_vector_v
    order = np.argsort(magnitude, kind="stable")
    magnitude, odd, positive = magnitude[order], odd[order], (i_vector_a > 0.0)[order]
    edges = np.flatnonzero(magnitude[1:] > SAME_LEVEL * magnitude[:-1]) + 1
    x, y, differences = [], [], [0.0]
    for group in np.split(np.arange(len(magnitude)), edges):
        x.append(float(np.mean(magnitude[group])))
        y.append(float(np.mean(odd[group])))
        if np.any(positive[group]) and not np.all(positive[group]):
            differences.append(abs(float(np.mean(odd[group][positive[group]]) - np.mean(odd[group][~positive[group]]))))
    return InverterCurve(PHASE_FACTOR * np.array(x), PHASE_FACTOR * np.array(y), PHASE_FACTOR * max(differences))


ROOT_3 = math.sqrt(3.0)
LEG_ANGLES = 2.0 * math.pi / 3.0 * np.arange(3.0)

ITERATIONS = 40
STEP, SLOWING = 0.5, 4.0
"""Part of the way to the edges' new delays in the first iteration, and the iteration at which it is half of that: with
a sharp curve the whole way would swing between two states."""
POINTS_BELOW = 12
"""Points of the curve below its smallest level."""
LEAST_CHARGE = 1e-3
"""Least distance of the smallest level from the plateau, of the plateau: noise may make it none."""


@dataclass(frozen=True, slots=True)
class Modulation:
    """What the ripple depends on besides the voltage."""

    U_dc_v: float
    """DC link (V)."""
    L_h: tuple[float, float]
    """Inductances of the machine at the switching frequency, d and q (H)."""
    period_s: float
    """Switching period (s)."""
    dead_time_s: float
    """From the plateau of the measured curve: V_dead T_s/U_dc (s)."""

    @property
    def plateau_v(self) -> float:
        """Error of a leg whose both edges see a large current (V)."""
        return self.dead_time_s * self.U_dc_v / self.period_s


def phases_of(d: Array, q: Array, theta_rad: Array) -> NDArray[np.float64]:
    """Phase quantities, shape (3, n), of a vector in a frame at ``theta_rad``."""
    angle = theta_rad - LEG_ANGLES[:, None]
    return np.asarray(np.cos(angle) * d - np.sin(angle) * q)


def duties(v: NDArray[np.float64], U_dc_v: float) -> NDArray[np.float64]:
    """Duties of the legs for phase voltages, shape (3, n), both zero vectors of one length."""
    return np.asarray(np.clip(0.5 + (v - 0.5 * (np.max(v, axis=0) + np.min(v, axis=0))) / U_dc_v, 0.0, 1.0))


def edge_curve(curve: InverterCurve, modulation: Modulation) -> InverterCurve:
    """Return the curve over the current at the edge, with its course below the smallest level.

    A current i charges the capacitance C of a leg in C U_dc/i; where that is shorter than the dead time it takes
    C U_dc^2/(2 i T_s) from the plateau, which the smallest level shows. Below, the error falls from half of the
    plateau to zero.
    """
    plateau_v = modulation.plateau_v
    flowing = np.minimum(curve.u_error_v, plateau_v) * modulation.period_s / (4.0 * modulation.L_h[0])
    i, u = curve.i_phase_a + flowing, curve.u_error_v
    if 0.5 * plateau_v < u[0]:
        charge = max(plateau_v - float(u[0]), LEAST_CHARGE * plateau_v) * float(i[0])
        below = np.geomspace(2.0 * charge / plateau_v, float(i[0]), POINTS_BELOW)[:-1] if plateau_v > 0.0 else i[:0]
        i, u = np.concatenate([below, i]), np.concatenate([plateau_v - charge / below, u])
    return InverterCurve(i, u, curve.asymmetry_v)


def ripple_at_edges(
    on_s: NDArray[np.float64],
    off_s: NDArray[np.float64],
    theta_rad: Array,
    modulation: Modulation,
    L_h: tuple[float, float] | Array | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Current of each leg beyond its value at the period's ends, at the leg's own rising and falling edge (A).

    Parameters
    ----------
    on_s, off_s : ndarray, shape (3, n)
        Times of the edges in the period (s).
    theta_rad : ndarray, shape (n,)
        Angle of the d axis (rad electrical).
    modulation : Modulation
        Link, inductances and period.
    L_h : ndarray, shape (2, n), optional
        Inductances of each period (H), where they change with the current.
    """
    L_d, L_q = modulation.L_h if L_h is None else L_h
    width = off_s - on_s
    applied = width / modulation.period_s
    angle = theta_rad - LEG_ANGLES[:, None]
    c, s = np.cos(angle), np.sin(angle)

    def at(time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        found = np.empty_like(time_s)
        for x in range(3):
            conducted = np.clip(time_s[x] - on_s, 0.0, width)
            flux = modulation.U_dc_v * (conducted - applied * time_s[x])  # all legs alike make no vector
            i_d, i_q = np.sum(c * flux, axis=0) / L_d, -np.sum(s * flux, axis=0) / L_q
            found[x] = 2.0 / 3.0 * (c[x] * i_d - s[x] * i_q)
        return found

    return at(on_s), at(off_s)


def rippled_error_dq_v(
    curve: InverterCurve,
    current: tuple[Array, Array],
    voltage: tuple[Array, Array],
    theta_rad: Array,
    modulation: Modulation,
) -> tuple[Array, Array]:
    """Error of the three phases in the rotor frame with the ripple at their edges (V).

    Parameters
    ----------
    curve : InverterCurve
        Error of one phase as standstill shows it.
    current, voltage : (ndarray, ndarray)
        d and q values (A, V), shape (n,): the current at the period's start.
    theta_rad : ndarray, shape (n,)
        Angle of the frame (rad electrical).
    modulation : Modulation
        Link, inductances, period and dead time.
    """
    v, i = phases_of(*voltage, theta_rad), phases_of(*current, theta_rad)
    on, off = edges_of(edge_curve(curve, modulation), i, np.zeros_like(i), v, theta_rad, modulation)
    e_alpha, e_beta = edge_error_v(on, off, v, modulation)
    c, s = np.cos(theta_rad), np.sin(theta_rad)
    return c * e_alpha + s * e_beta, c * e_beta - s * e_alpha


def edges_of(
    sharp: InverterCurve,
    i: NDArray[np.float64],
    change: NDArray[np.float64],
    v: NDArray[np.float64],
    theta_rad: Array,
    modulation: Modulation,
    L_h: Array | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return when the legs rise and fall in their periods (s), shape (3, n).

    ``sharp`` is the error over the current at the edge (:func:`edge_curve`); ``i`` the phase currents at the period's
    start, and ``change`` what they are beyond that at its end (A), ``v`` the phase voltages asked for (V), all (3, n);
    the others as of :func:`ripple_at_edges`.
    """
    U_dc, T_s = modulation.U_dc_v, modulation.period_s
    edge = (1.0 - duties(v, U_dc)) * 0.5 * T_s

    def late(i_own: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(modulation.dead_time_s - np.maximum(0.0, sharp.error_v(i_own)) * T_s / U_dc)

    on, off = edge + late(-i), T_s - edge + late(i)
    for k in range(ITERATIONS):
        step = STEP / (1.0 + k / SLOWING)
        at_rise, at_fall = ripple_at_edges(on, off, theta_rad, modulation, L_h)
        at_rise, at_fall = i + change * on / T_s + at_rise, i + change * off / T_s + at_fall
        on, off = on + step * (edge + late(-at_rise) - on), off + step * (T_s - edge + late(at_fall) - off)
    return on, off


def edge_error_v(
    on_s: NDArray[np.float64], off_s: NDArray[np.float64], v: NDArray[np.float64], modulation: Modulation
) -> NDArray[np.float64]:
    """Return what the legs lose in the stator frame (V), shape (2, n), by the times of their edges."""
    U_dc = modulation.U_dc_v
    return stator_frame(U_dc * (duties(v, U_dc) - (off_s - on_s) / modulation.period_s))


def stator_frame(phases: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return alpha and beta, shape (2, n), of three phases; amplitude-invariant, without what all of them share."""
    return np.stack([(2.0 * phases[0] - phases[1] - phases[2]) / 3.0, (phases[1] - phases[2]) / ROOT_3])
