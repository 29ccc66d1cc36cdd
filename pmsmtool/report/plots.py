# SPDX-License-Identifier: MIT
"""Figures of traces and tables: matplotlib's Figure class only, the same bytes for the same trace.

matplotlib is imported inside the functions: commands without a plot do not pay for it.

Signals over time as lines of text, for a terminal without a browser.
Of a table: loci in the current plane, torque over speed, and where it has how much margin.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pmsmtool.design.lookup.table import Locus, LookupTable, electrical_speed
from pmsmtool.trace import Trace

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BESIDE = 1.05
"""Edge of the drawn current plane, over I_max."""

PLANE_POINTS = 161
"""Points along each axis of the current plane."""

_LEGEND: dict[str, Any] = {"fontsize": 8, "loc": "upper left", "bbox_to_anchor": (1.0, 1.0), "frameon": False}
"""Beside the axes, clear of what is drawn."""

LIMITS_SHOWN = 4
"""Voltage (or flux) limits drawn in the current plane."""


def lookup_figure(table: LookupTable, lines: Mapping[str, Locus]) -> Figure:
    """Return a figure with three panels; matplotlib is imported here."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14.5, 4.4), layout="constrained")
    plane, envelope, margin = figure.subplots(1, 3)
    _plane(plane, table, lines)
    _envelope(envelope, table, lines)
    _margin(figure, margin, table)
    return figure


def _plane(axes: Any, table: LookupTable, lines: Mapping[str, Locus]) -> None:
    I_max = table.I_max_apk
    angle = np.linspace(0.0, 2.0 * math.pi, 181)
    axes.plot(I_max * np.cos(angle), I_max * np.sin(angle), color="0.5", linewidth=1.0, label="I_max")
    i = np.linspace(-BESIDE * I_max, BESIDE * I_max, PLANE_POINTS)
    i_d, i_q = np.meshgrid(i, i)
    torque = table.machine.torque_nm(i_d, i_q)
    axes.contour(i, i, torque, levels=10, colors="0.8", linewidths=0.6)
    if table.axis_kind == "speed":
        V = float(table.V_max_v.min())
        shown = np.linspace(0.0, float(table.y.max()), LIMITS_SHOWN + 1)[1:]
        for n, omega in zip(shown, electrical_speed(table.machine, shown), strict=True):
            demand = table.machine.voltage_v(i_d, i_q, omega)
            ellipse = axes.contour(i, i, demand, levels=[V], colors="tab:blue", linewidths=0.8)
            _label(axes, ellipse, f"{n:.0f} rpm", I_max)
        title = f"blue: voltage limit of {V:.4g} V at a speed"
    else:
        shown = np.linspace(float(table.y.min()), float(table.y.max()), LIMITS_SHOWN)
        demand = np.hypot(*table.machine.flux(i_d, i_q))
        limits = axes.contour(i, i, demand, levels=shown, colors="tab:blue", linewidths=0.8)
        axes.clabel(limits, fmt="%.3g Wb", fontsize=7)
        title = "blue: flux limits"
    for name, colour in (("mtpa", "tab:green"), ("largest", "tab:red"), ("mtpv", "tab:purple")):
        if name in lines and np.any(np.hypot(lines[name].i_d_a, lines[name].i_q_a) <= BESIDE * I_max):
            axes.plot(lines[name].i_d_a, lines[name].i_q_a, color=colour, label=name)
    axes.set(xlabel="i_d / A", ylabel="i_q / A", aspect="equal", xlim=(i[0], i[-1]), ylim=(i[0], i[-1]))
    axes.set_title(title, fontsize=9)
    axes.legend(**_LEGEND)


def _label(axes: Any, ellipse: Any, text: str, I_max: float) -> None:
    """Write beside an ellipse at its lowest point inside the current limit, away from the loci of positive torque."""
    points = np.concatenate([path.vertices for path in ellipse.get_paths()])
    inside = points[np.hypot(*points.T) <= I_max]
    if len(inside):
        at = inside[np.argmin(inside[:, 1])]
        axes.annotate(text, at, xytext=(3, 3), textcoords="offset points", color="tab:blue", fontsize=7)


def _envelope(axes: Any, table: LookupTable, lines: Mapping[str, Locus]) -> None:
    if table.axis_kind == "speed":
        drawn = {name: (lines[name].speed_rpm, lines[name].torque_nm) for name in ("largest", "least") if name in lines}
        if "mtpv" in lines and not np.isnan(lines["mtpv"].torque_nm).all():
            axes.plot(lines["mtpv"].speed_rpm, lines["mtpv"].torque_nm, color="tab:purple", label="mtpv")
    else:
        bounds = table.torque_limits
        drawn = {"largest": (table.y, bounds.largest_nm[:, 0]), "least": (table.y, bounds.least_nm[:, 0])}
    for name, (x, torque) in drawn.items():
        axes.plot(x, torque, color="tab:red" if name == "largest" else "tab:orange", label=name)
    reach = max((float(np.nanmax(np.abs(torque))) for _, torque in drawn.values()), default=1.0)
    axes.set(xlabel=_y_label(table), ylabel="torque / N m", ylim=(-1.1 * reach, 1.3 * reach))
    axes.set_title("torque that can be reached", fontsize=9)
    axes.grid(color="0.9")
    axes.legend(**_LEGEND)


def _margin(figure: Any, axes: Any, table: LookupTable) -> None:
    limit = table.V_max_v if table.axis_kind == "speed" else table.y[None, :, None]
    share = np.minimum(table.margin_v / limit, table.margin_i / table.I_max_apk).min(axis=2)
    image = axes.pcolormesh(table.y, table.torque_nm, 100.0 * np.maximum(share, 0.0), shading="nearest", cmap="viridis")
    figure.colorbar(image, ax=axes, label="least margin / %")
    axes.set(xlabel=_y_label(table), ylabel="torque / N m")
    axes.set_title(f"least of {'voltage' if table.axis_kind == 'speed' else 'flux'} and current margin", fontsize=9)


def _y_label(table: LookupTable) -> str:
    return "speed / rpm" if table.axis_kind == "speed" else "flux / Wb"


POINTS_MAX = 4000
"""Points of a line; a longer signal is shown as the least and the largest value of each of its stretches."""

SMALLEST_SHARE = 1e-4
"""Least span of an axis over the largest value of its unit in the figure: what is smaller is rounding, no signal."""

RPM_PER_RAD_S = 9.549296585513721


@dataclass(frozen=True, slots=True)
class Panel:
    """One pair of axes: a label with its unit, and the signals drawn in it."""

    label: str
    """Quantity and unit of the axis."""
    lines: Sequence[tuple[str, str, str]]
    """Signal of the trace, name in the legend, ``-`` for a measurement and ``--`` for a reference.
    Sequence of (signal, name, style)."""
    factor: float = 1.0
    """From the signal's unit to the axis's."""


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
