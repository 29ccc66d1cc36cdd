"""Figures of a table: loci in the current plane, torque over speed, and where it has how much margin."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from pmsmtool.design.lookup_loci import Locus
from pmsmtool.design.lookup_table import LookupTable, electrical_speed

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PLANE_POINTS = 161
"""Points along each axis of the current plane."""

SPEEDS_SHOWN = 4
"""Voltage limits drawn in the current plane."""


def lookup_figure(table: LookupTable, lines: Mapping[str, Locus]) -> Figure:
    """Return a figure with three panels; matplotlib is imported here."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.0, 4.4), layout="constrained")
    plane, envelope, margin = figure.subplots(1, 3)
    _plane(plane, table, lines)
    _envelope(envelope, lines)
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
    V = float(table.V_max_v.min())
    speeds = np.linspace(0.0, float(table.y.max()), SPEEDS_SHOWN + 1)[1:]
    for omega in electrical_speed(table.machine, speeds):
        axes.contour(i, i, table.machine.voltage_v(i_d, i_q, omega), levels=[V], colors="tab:blue", linewidths=0.8)
    for name, colour in (("mtpa", "tab:green"), ("largest", "tab:red"), ("mtpv", "tab:purple")):
        if name in lines:
            axes.plot(lines[name].i_d_a, lines[name].i_q_a, color=colour, label=name)
    axes.set(xlabel="i_d / A", ylabel="i_q / A", aspect="equal", xlim=(i[0], i[-1]), ylim=(i[0], i[-1]))
    speeds_text = ", ".join(f"{n:.0f}" for n in speeds)
    axes.set_title(f"voltage limits at {speeds_text} rpm", fontsize=9)
    axes.legend(fontsize=8, loc="upper right")


def _envelope(axes: Any, lines: Mapping[str, Locus]) -> None:
    for name, colour in (("largest", "tab:red"), ("least", "tab:orange"), ("mtpv", "tab:purple")):
        if name in lines:
            axes.plot(lines[name].speed_rpm, lines[name].torque_nm, color=colour, label=name)
    reach = [float(np.nanmax(np.abs(lines[name].torque_nm))) for name in ("largest", "least") if name in lines]
    axes.set(xlabel="speed / rpm", ylabel="torque / N m", ylim=(-1.1 * max(reach), 1.3 * max(reach)))
    axes.set_title("torque that can be reached", fontsize=9)
    axes.grid(color="0.9")
    axes.legend(fontsize=8)


def _margin(figure: Any, axes: Any, table: LookupTable) -> None:
    limit = table.V_max_v if table.axis_kind == "speed" else table.y[None, :, None]
    share = np.minimum(table.margin_v / limit, table.margin_i / table.I_max_apk).min(axis=2)
    image = axes.pcolormesh(table.y, table.torque_nm, 100.0 * np.maximum(share, 0.0), shading="nearest", cmap="viridis")
    figure.colorbar(image, ax=axes, label="least margin / %")
    axes.set(xlabel="speed / rpm" if table.axis_kind == "speed" else "flux / Wb", ylabel="torque / N m")
    axes.set_title("least of voltage and current margin", fontsize=9)
