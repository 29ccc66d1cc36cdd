# SPDX-License-Identifier: MIT
"""Figures of a table: loci in the current plane, torque over speed, and where it has how much margin."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from pmsmtool.design.lookup.loci import Locus
from pmsmtool.design.lookup.table import LookupTable, electrical_speed

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
