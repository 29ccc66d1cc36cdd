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

PLANE_POINTS = 161
"""Points along each axis of the current plane."""

LIMITS_SHOWN = 4
"""Voltage (or flux) limits drawn in the current plane."""


def lookup_figure(table: LookupTable, lines: Mapping[str, Locus]) -> Figure:
    """Return a figure with three panels; matplotlib is imported here."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.0, 4.4), layout="constrained")
    plane, envelope, margin = figure.subplots(1, 3)
    _plane(plane, table, lines)
    _envelope(envelope, table, lines)
    _margin(figure, margin, table)
    return figure


def _plane(axes: Any, table: LookupTable, lines: Mapping[str, Locus]) -> None:
    I_max = table.I_max_apk
    angle = np.linspace(0.0, 2.0 * math.pi, 181)
    axes.plot(I_max * np.cos(angle), I_max * np.sin(angle), color="0.5", linewidth=1.0, label="I_max")
    i = np.linspace(-1.05 * I_max, 1.05 * I_max, PLANE_POINTS)
    i_d, i_q = np.meshgrid(i, i)
    torque = table.machine.torque_nm(i_d, i_q)
    axes.contour(i, i, torque, levels=10, colors="0.8", linewidths=0.6)
    if table.axis_kind == "speed":
        V = float(table.V_max_v.min())
        shown = np.linspace(0.0, float(table.y.max()), LIMITS_SHOWN + 1)[1:]
        for omega in electrical_speed(table.machine, shown):
            demand = table.machine.voltage_v(i_d, i_q, omega)
            axes.contour(i, i, demand, levels=[V], colors="tab:blue", linewidths=0.8)
        title = "voltage limits at " + ", ".join(f"{n:.0f}" for n in shown) + " rpm"
    else:
        shown = np.linspace(float(table.y.min()), float(table.y.max()), LIMITS_SHOWN)
        demand = np.hypot(*table.machine.flux(i_d, i_q))
        axes.contour(i, i, demand, levels=shown, colors="tab:blue", linewidths=0.8)
        title = "flux limits " + ", ".join(f"{psi:.3g}" for psi in shown) + " Wb"
    for name, colour in (("mtpa", "tab:green"), ("largest", "tab:red"), ("mtpv", "tab:purple")):
        if name in lines and not np.isnan(lines[name].i_q_a).all():
            axes.plot(lines[name].i_d_a, lines[name].i_q_a, color=colour, label=name)
    axes.set(xlabel="i_d / A", ylabel="i_q / A", aspect="equal", xlim=(i[0], i[-1]), ylim=(i[0], i[-1]))
    axes.set_title(title, fontsize=9)
    axes.legend(fontsize=8, loc="upper right")


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
    axes.legend(fontsize=8)


def _margin(figure: Any, axes: Any, table: LookupTable) -> None:
    limit = table.V_max_v if table.axis_kind == "speed" else table.y[None, :, None]
    share = np.minimum(table.margin_v / limit, table.margin_i / table.I_max_apk).min(axis=2)
    image = axes.pcolormesh(table.y, table.torque_nm, 100.0 * np.maximum(share, 0.0), shading="nearest", cmap="viridis")
    figure.colorbar(image, ax=axes, label="least margin / %")
    axes.set(xlabel=_y_label(table), ylabel="torque / N m")
    axes.set_title(f"least of {'voltage' if table.axis_kind == 'speed' else 'flux'} and current margin", fontsize=9)


def _y_label(table: LookupTable) -> str:
    return "speed / rpm" if table.axis_kind == "speed" else "flux / Wb"
