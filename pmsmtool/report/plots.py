# SPDX-License-Identifier: MIT
"""Figures of traces: matplotlib's Figure class only, the same bytes for the same trace.

matplotlib is imported inside the functions: commands without a plot do not pay for it.

Signals over time as lines of text, for a terminal without a browser.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pmsmtool.trace import Trace

if TYPE_CHECKING:
    from matplotlib.figure import Figure

POINTS_MAX = 4000
"""Points of a line; a longer signal is shown as the least and the largest value of each of its stretches."""

SMALLEST_SHARE = 1e-4
"""Least span of an axis over the largest value of its unit in the figure: what is smaller is rounding, no signal."""

RPM_PER_RAD_S = 9.549296585513721


@dataclass(frozen=True, slots=True)
class Panel:
    """One pair of axes: a label with its unit, and the signals drawn in it.

    Attributes
    ----------
    label : str
        Quantity and unit of the axis.
    lines : sequence of (signal, name, style)
        Signal of the trace, name in the legend, ``-`` for a measurement and ``--`` for a reference.
    factor : float
        From the signal's unit to the axis's.
    """

    label: str
    lines: Sequence[tuple[str, str, str]]
    factor: float = 1.0


PANELS: tuple[Panel, ...] = (
    Panel("i_d / A", (("i_d_a", "i_d", "-"), ("i_d_ref_a", "reference", "--"))),
    Panel("i_q / A", (("i_q_a", "i_q", "-"), ("i_q_ref_a", "reference", "--"))),
    Panel("voltage / V", (("u_d_lim_v", "u_d", "-"), ("u_q_lim_v", "u_q", "-"))),
    Panel("torque / N m", (("torque_true_nm", "air gap", "-"), ("torque_nm", "drive", "-"), ("load_nm", "load", "--"))),
    Panel("speed / rpm", (("omega_m_rad_s", "speed", "-"),), RPM_PER_RAD_S),
)
"""What a simulated trace shows; panels whose signals are missing are left out."""


def trace_figure(trace: Trace, panels: Sequence[Panel] = PANELS, title: str = "") -> Figure:
    """Return a figure of a trace, one panel below the other over the same time.

    Raises ValueError: the trace has none of the signals.
    """
    from matplotlib.figure import Figure

    shown = [panel for panel in panels if any(name in trace.signals for name, _, _ in panel.lines)]
    if not shown:
        raise ValueError("the trace has none of the signals that are drawn")
    figure = Figure(figsize=(9.0, 0.8 + 1.6 * len(shown)), layout="constrained")
    axes = np.atleast_1d(figure.subplots(len(shown), 1, sharex=True))
    for panel, at in zip(shown, axes, strict=True):
        _draw(at, trace, panel)
        unit = panel.label.rpartition(" / ")[2]
        alike = [other for other in shown if other.label.rpartition(" / ")[2] == unit]
        _widen(at, SMALLEST_SHARE * max(_largest(trace, other) for other in alike))
    axes[-1].set_xlabel("time / s")
    if title:
        figure.suptitle(title, fontsize=10)
    return figure


def _draw(axes: Any, trace: Trace, panel: Panel) -> None:
    present = [line for line in panel.lines if line[0] in trace.signals]
    for name, label, style in present:
        t, value = thinned(trace.t_s, panel.factor * trace[name])
        axes.plot(t, value, style, linewidth=1.0 if style == "-" else 0.9, label=label)
    axes.set_ylabel(panel.label)
    axes.grid(color="0.9")
    if len(present) > 1:
        axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)


def _largest(trace: Trace, panel: Panel) -> float:
    values = [panel.factor * np.abs(trace[name]) for name, _, _ in panel.lines if name in trace.signals]
    return max((float(np.nanmax(value, initial=0.0)) for value in values), default=0.0)


def _widen(axes: Any, least: float) -> None:
    """Let the axis span at least ``least`` about its middle."""
    low, high = axes.get_ylim()
    if high - low < least:
        axes.set_ylim(0.5 * (low + high - least), 0.5 * (low + high + least))


def thinned(t_s: NDArray[np.float64], value: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return at most about :data:`POINTS_MAX` points that keep every extreme value.

    Parameters
    ----------
    t_s, value : ndarray, shape (n,)
        A signal over time.

    Returns
    -------
    tuple of ndarray
        The same arrays when they are short; else the least and the largest value of each stretch, in order of time.
    """
    n = len(t_s)
    if n <= POINTS_MAX:
        return t_s, value
    stretch = -(-n // (POINTS_MAX // 2))
    starts = range(0, n, stretch)
    index = [start + int(pick(value[start : start + stretch])) for start in starts for pick in (np.argmin, np.argmax)]
    kept = np.unique([0, *index, n - 1])
    return t_s[kept], value[kept]


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
