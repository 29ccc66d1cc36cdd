# SPDX-License-Identifier: MIT
"""Figures of traces: matplotlib's Figure class only, the same bytes for the same trace.

matplotlib is imported inside the functions: commands without a plot do not pay for it.
"""

from __future__ import annotations

from collections.abc import Sequence
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

    Parameters
    ----------
    trace : Trace
        With some of the panels' signals.
    panels : sequence of Panel
        What to draw.
    title : str
        Heading.

    Raises
    ------
    ValueError
        The trace has none of the signals.
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
