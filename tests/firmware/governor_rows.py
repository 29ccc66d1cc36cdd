# SPDX-License-Identifier: MIT
"""Prediction rows of the governor, built from the matrices of Jercic et al. 2017 ((20), (27)). Test code only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Table1:
    """Machine, tuning and limits of docs/control.md, 1 (V_dc 210 V)."""

    R: float = 0.137
    L_d: float = 0.0023
    L_q: float = 0.0021
    psi: float = 0.41
    p: int = 4
    T_s: float = 1 / 12000
    alpha: float = 4000.0
    V_max: float = 210 / np.sqrt(3)

    @property
    def gains(self) -> tuple[float, float, float]:
        """K_p d, K_p q, K_i."""
        return self.alpha * self.L_d, self.alpha * self.L_q, self.alpha * self.R


def system_matrix(m: Table1) -> np.ndarray:
    """(20): states i_d, i_q, I_ed, I_eq, i_d*, i_q*."""
    K_pd, K_pq, K_i = m.gains
    A = np.eye(6)
    for axis, (L, K_p) in enumerate(((m.L_d, K_pd), (m.L_q, K_pq))):
        A[axis, axis] = 1 - m.T_s * (m.R + K_p) / L
        A[axis, 2 + axis] = m.T_s * K_i / L
        A[axis, 4 + axis] = m.T_s * K_p / L
        A[2 + axis, axis] = -m.T_s
        A[2 + axis, 4 + axis] = m.T_s
    return A


def output_matrix(m: Table1, omega: float) -> np.ndarray:
    """(27)."""
    K_pd, K_pq, K_i = m.gains
    return np.array([[-K_pd, -omega * m.L_q, K_i, 0, K_pd, 0], [omega * m.L_d, -K_pq, 0, K_i, 0, K_pq]])


def paper_rows(
    m: Table1, omega: float, i: np.ndarray, integrals: np.ndarray, k_max: int, eps: float
) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """(M, c, V) of rows 0..k_max and of the tightened steady-state row."""
    A, C = system_matrix(m), output_matrix(m, omega)
    emf = np.array([0, omega * m.psi])
    rows = []
    for _ in range(k_max + 1):
        rows.append((C[:, 4:], C[:, :4] @ np.concatenate([i, integrals]) + emf, m.V_max))
        C = C @ A
    M_inf = np.array([[m.R, -omega * m.L_q], [omega * m.L_d, m.R]])
    return [*rows, (M_inf, emf, (1 - eps) * m.V_max)]
