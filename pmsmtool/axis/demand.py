# SPDX-License-Identifier: MIT
"""Speed and acceleration of a move from its recorded demand: a trapezoid of speed between two places at rest."""

from __future__ import annotations

import numpy as np

from pmsmtool.arrays import Array

SHARES = np.linspace(0.0, 0.5, 51)
"""Time of a ramp over that of the whole move: 0 is a step of the speed, 0.5 a triangle."""
WIDTHS = np.linspace(1.0, 1.15, 31)
"""Time of the move over that in which the demand is seen to change: its ends are softer than a count."""
ROUNDS, NARROWER = 2, 0.12


def trapezoid_of(t_s: Array, demand: Array) -> tuple[float, float]:
    """Return speed (rad/s) and time of a ramp (s) of a move, by least squares; ramps of equal length.

    Parameters
    ----------
    t_s, demand : ndarray
        Times (s) and demands (rad), shape (n,), from before the move until after it; the demand must change.
    """
    first, last = float(demand[0]), float(demand[-1])
    share = (np.asarray(demand, dtype=np.float64) - first) / (last - first)
    moves = np.flatnonzero((share != 0.0) & (share != 1.0))
    middle = float(np.interp(0.5, share, t_s))
    seen = max(float(t_s[moves[-1]] - t_s[moves[0]]) if moves.size else 0.0, float(np.min(np.diff(t_s))))
    ramps, widths = SHARES, WIDTHS * seen
    best = (0.0, seen)
    for _ in range(ROUNDS):
        grid = np.array([(ramp, width) for ramp in ramps for width in widths])
        age = np.abs(t_s - middle) / grid[:, 1:]  # of half a move, which is symmetric: 0.5 at its ends
        ramp = grid[:, :1]
        left = np.maximum(0.5 - age, 0.0)
        rest = np.where(left < ramp, left**2 / np.maximum(2.0 * ramp, 1e-12), left - 0.5 * ramp) / (1.0 - ramp)
        wrong = np.sum((np.where(t_s < middle, rest, 1.0 - rest) - share) ** 2, axis=1)
        best = tuple(grid[int(np.argmin(wrong))])
        ramps = np.clip(best[0] + NARROWER * 0.5 * (SHARES - 0.25), 0.0, 0.5)
        widths = best[1] * (1.0 + NARROWER * (WIDTHS - WIDTHS.mean()))
    ramp_share, duration = best
    return abs(last - first) / (duration * (1.0 - ramp_share)), ramp_share * duration
