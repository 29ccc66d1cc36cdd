# SPDX-License-Identifier: MIT
"""The voltage error of one inverter phase as data: what the drive loses between command and terminal."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.estimators.least_squares import levenberg_marquardt

KNEE_RANGE = 10.0
"""Ratio by which a knee may lie below the smallest level, or above the largest."""
SAME_LEVEL = 1.1
"""Ratio of currents above which two points are different levels."""


@dataclass(frozen=True, slots=True)
class InverterCurve:
    """Voltage error of one phase, odd in its current.

    Attributes
    ----------
    i_phase_a : ndarray, shape (n,)
        Phase current, increasing and positive (A).
    u_error_v : ndarray, shape (n,)
        Command minus terminal voltage beyond R i, mean of both signs (V).
    asymmetry_v : float
        Largest difference between the signs (V).
    """

    i_phase_a: Array
    u_error_v: Array
    asymmetry_v: float

    def error_v(self, i_phase_a: Array) -> Array:
        """Error at any phase current: linear between the points and through zero, constant beyond the last (V)."""
        magnitude = np.abs(i_phase_a)
        x = np.concatenate([[0.0], self.i_phase_a])
        y = np.concatenate([[0.0], self.u_error_v])
        return np.asarray(np.sign(i_phase_a) * np.interp(magnitude, x, y), dtype=np.float64)

    def error_dq_v(self, i_d_a: Array, i_q_a: Array, theta_e_rad: Array) -> tuple[Array, Array]:
        """Error of the three phases in a frame at ``theta_e_rad`` (V, amplitude-invariant)."""
        c, s = np.cos(theta_e_rad), np.sin(theta_e_rad)
        i_alpha, i_beta = c * i_d_a - s * i_q_a, s * i_d_a + c * i_q_a
        root = math.sqrt(3.0)
        e_a = self.error_v(i_alpha)
        e_b = self.error_v(-0.5 * i_alpha + 0.5 * root * i_beta)
        e_c = self.error_v(-0.5 * i_alpha - 0.5 * root * i_beta)
        e_alpha, e_beta = (2.0 * e_a - e_b - e_c) / 3.0, (e_b - e_c) / root
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


def curve_from_levels(i_vector_a: Array, u_vector_v: Array, phase_factor: float) -> InverterCurve:
    """Curve of one phase from the remainder of DC levels along a vector with one phase idle.

    Parameters
    ----------
    i_vector_a, u_vector_v : ndarray, shape (n,)
        Vector current and v - R i - v0 of each level, both signs.
    phase_factor : float
        Phase current over vector current, sqrt(3)/2 at 30 + k 60 degrees; the phase error is the vector error times
        the same factor, because v_beta = (e_b - e_c)/sqrt 3 with e_b = -e_c.
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
    return InverterCurve(phase_factor * np.array(x), phase_factor * np.array(y), phase_factor * max(differences))
