# SPDX-License-Identifier: MIT
"""Signals over time as lines of text, for a terminal without a browser."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

BLOCKS = " ▁▂▃▄▅▆▇█"
"""Heights of a column, least to largest."""
ASCII = " _.-=+*#@"
"""The same where the terminal has no block characters."""
HEIGHT = 3
"""Lines of one signal."""
ROUNDING = 1e-6
"""Least span of a signal over its largest value: what is smaller is rounding."""


def terminal_plot(
    t_s: NDArray[np.float64], signals: Mapping[str, NDArray[np.float64]], units: Mapping[str, str],
    width: int, levels: str = BLOCKS,
) -> list[str]:  # fmt: skip
    """Return the lines of a figure: every signal against time, with its range and its last value.

    Parameters
    ----------
    t_s : ndarray, shape (n,)
        Times, increasing; n at least 1.
    signals : mapping of str to ndarray, shape (n,)
        Values; what is not finite leaves its column empty.
    units : mapping of str to str
        By signal.
    width : int
        Columns of the terminal, 40 or more.
    levels : str
        :data:`BLOCKS` or :data:`ASCII`.
    """
    edge = 11
    columns = max(width, 40) - edge - 1
    span = t_s[-1] - t_s[0]
    place = np.minimum((columns * (t_s - t_s[0]) / span).astype(int), columns - 1) if span else np.zeros(len(t_s), int)
    lines = []
    for name, values in signals.items():
        finite = values[np.isfinite(values)]
        low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 0.0)
        last = f"{values[-1]:.5g}" if np.isfinite(values[-1]) else "no number"
        lines.append(f"{name} {last} {units[name]}")
        floor = ROUNDING * max(abs(low), abs(high))
        heights = _heights(values, place, columns, low, high, HEIGHT * (len(levels) - 1), floor)
        for row in reversed(range(HEIGHT)):
            label = f"{high:.4g}" if row == HEIGHT - 1 else f"{low:.4g}" if row == 0 else ""
            full = heights - row * (len(levels) - 1)
            lines.append(f"{label:>{edge - 1}} " + "".join(levels[min(max(h, 0), len(levels) - 1)] for h in full))
    lines.append(f"{'':{edge}}{t_s[0]:.3g} s{f'{t_s[-1]:.3g} s':>{columns - len(f'{t_s[0]:.3g} s')}}")
    return lines


def _heights(
    values: NDArray[np.float64], place: NDArray[np.int64], columns: int, low: float, high: float, steps: int,
    floor: float,
) -> NDArray[np.int64]:  # fmt: skip
    """Return the height of every column in steps: of the mean of its samples, or of the last column that has some.

    0 where these are not finite; the middle where all are alike.
    """
    known = np.isfinite(values)
    count = np.bincount(place[known], minlength=columns)
    mean = np.bincount(place[known], values[known], minlength=columns) / np.maximum(count, 1)
    share = (mean - low) / (high - low) if high - low > floor else np.full(columns, 0.5)
    heights = np.where(count > 0, 1 + np.rint(share * (steps - 1)), 0).astype(np.int64)
    sampled = np.bincount(place, minlength=columns) > 0
    held: NDArray[np.int64] = heights[np.maximum.accumulate(np.where(sampled, np.arange(columns), 0))]
    return held
