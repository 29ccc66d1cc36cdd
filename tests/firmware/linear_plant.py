# SPDX-License-Identifier: MIT
"""A linear PMSM in the stationary frame for closed loops around the core: exact over each period. Test code only."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import expm


@dataclass
class LinearPlant:
    """Constant speed; the voltage computed at t_k acts on [t_{k+1}, t_{k+2}) with a delay, else on [t_k, t_{k+1})."""

    R: float
    L_d: float
    L_q: float
    psi: float
    T_s: float
    omega: float = 0.0
    delayed: bool = True
    theta: float = 0.0
    i: np.ndarray = field(default_factory=lambda: np.zeros(2))
    waiting: np.ndarray = field(default_factory=lambda: np.zeros(2))
    transitions: dict[float, np.ndarray] = field(default_factory=dict)

    def transition(self) -> np.ndarray:
        """State (psi_d - psi, psi_q, u_d, u_q, 1); u is fixed in the stator frame."""
        if self.omega not in self.transitions:
            w = self.omega
            A = np.zeros((5, 5))
            A[0] = (-self.R / self.L_d, w, 1, 0, 0)
            A[1] = (-w, -self.R / self.L_q, 0, 1, -w * self.psi)
            A[2, 3], A[3, 2] = w, -w
            self.transitions[self.omega] = expm(A * self.T_s)[:2]
        return self.transitions[self.omega]

    def phases(self) -> tuple[float, float, float]:
        alpha = math.cos(self.theta) * self.i[0] - math.sin(self.theta) * self.i[1]
        beta = math.sin(self.theta) * self.i[0] + math.cos(self.theta) * self.i[1]
        return alpha, -alpha / 2 + math.sqrt(0.75) * beta, -alpha / 2 - math.sqrt(0.75) * beta

    def advance(self, u_alpha: float, u_beta: float) -> None:
        """One period with the voltage just computed."""
        computed = np.array([u_alpha, u_beta])
        acting, self.waiting = (self.waiting, computed) if self.delayed else (computed, computed)
        c, s = math.cos(self.theta), math.sin(self.theta)
        u_d, u_q = c * acting[0] + s * acting[1], c * acting[1] - s * acting[0]
        z = np.array([self.L_d * self.i[0], self.L_q * self.i[1], u_d, u_q, 1.0])
        flux = self.transition() @ z
        self.i = np.array([flux[0] / self.L_d, flux[1] / self.L_q])
        self.theta = math.remainder(self.theta + self.omega * self.T_s, 2 * math.pi)
