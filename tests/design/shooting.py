# SPDX-License-Identifier: MIT
"""The shortest current transfer by shooting: u = V_max G l/|G l| with dl/dt = -F^T l; unknown are l's angle and T."""

from __future__ import annotations

import cmath
import math

import numpy as np
from numpy.typing import NDArray

from pmsmtool.design.minimum_time import QUADRATURE, Flow, TransferProblem, flux_time
from pmsmtool.errors import DesignInfeasible

Array = NDArray[np.float64]

SHOOTING_STEPS = 60
SHOOTING_DONE_A = 1e-9
"""End error of a shot (A) that counts as a hit."""


def shoot(
    problem: TransferProblem, i_from: tuple[float, float], i_to: tuple[float, float], radius: float = 0.0
) -> float:
    """Return the shortest time (s) under the circle by the costate equations, from the flux-steering start.

    Raises
    ------
    DesignInfeasible
        Newton does not converge from any start (the target may be out of reach).
    """
    F, G, e = problem.system()
    flow, back = Flow(F), Flow(-F.T)
    nodes, weights = np.polynomial.legendre.leggauss(QUADRATURE)
    start, end = np.asarray(i_from, dtype=np.float64), np.asarray(i_to, dtype=np.float64)

    def miss(angle: float, T: float) -> Array:
        t = 0.5 * T * (nodes + 1.0)
        costate = back.at(t) @ np.array([math.cos(angle), math.sin(angle)])
        pushed = costate @ G
        u = problem.V_max * pushed / np.hypot(pushed[:, 0], pushed[:, 1])[:, None]
        driven = np.einsum("tab,tb->ta", flow.at(T - t), u @ G + e)
        final = flow.at(np.array([T]))[0] @ start + 0.5 * T * weights @ driven
        last = back.at(np.array([T]))[0] @ np.array([math.cos(angle), math.sin(angle)])
        return np.asarray(final + radius * last / np.hypot(*last) - end)

    shots = (_newton(miss, angle, T) for angle, T in _starts(problem, start, end))
    found = [T for T in shots if T is not None]
    if not found:
        raise DesignInfeasible(
            "no time-optimal transfer was found",
            where="minimum time",
            likely="out of reach",
            hint="take a target nearer to the start, or a larger voltage",
        )
    return min(found)


def _starts(problem: TransferProblem, start: Array, end: Array) -> list[tuple[float, float]]:
    """Times and costate angles around steering the stator flux straight, as without resistance."""
    T = flux_time(problem, start, end)
    L = np.array([problem.L_d, problem.L_q])
    guesses = []
    for time in (T, 0.7 * T, 1.4 * T):
        turn = cmath.exp(1j * problem.omega_e * time)
        a = complex(problem.psi_f + L[0] * start[0], L[1] * start[1])
        b = complex(problem.psi_f + L[0] * end[0], L[1] * end[1])
        direction = turn * b - a
        # G l is along the voltage: l = L direction
        angle = math.atan2(L[1] * direction.imag, L[0] * direction.real)
        guesses += [(angle + shift, time) for shift in (0.0, 0.3, -0.3, 0.8, -0.8)]
    return guesses


def _newton(miss, angle: float, T: float) -> float | None:  # type: ignore[no-untyped-def]
    error = miss(angle, T)
    for _ in range(SHOOTING_STEPS):
        if float(np.hypot(*error)) <= SHOOTING_DONE_A:
            return T
        h_angle, h_T = 1e-7, 1e-7 * T
        slope = np.column_stack(((miss(angle + h_angle, T) - error) / h_angle, (miss(angle, T + h_T) - error) / h_T))
        if abs(float(np.linalg.det(slope))) == 0.0:
            return None
        step = np.linalg.solve(slope, -error)
        share = min(1.0, 0.5 / max(abs(float(step[0])), 1e-300), 0.5 * T / max(abs(float(step[1])), 1e-300))
        for _ in range(20):
            trial = miss(angle + share * step[0], T + share * step[1])
            if float(np.hypot(*trial)) < float(np.hypot(*error)):
                break
            share *= 0.5
        else:
            return T if float(np.hypot(*error)) <= 1e3 * SHOOTING_DONE_A else None
        angle, T, error = angle + share * float(step[0]), T + share * float(step[1]), trial
    return None
