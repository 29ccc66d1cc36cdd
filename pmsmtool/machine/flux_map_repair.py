# SPDX-License-Identifier: MIT
"""Repairs of a flux map, each on request and each saying what it changed.

Every function returns a new map whose metadata lists the repairs (``meta["repairs"]``), or the text it would list.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.errors import ConfigError
from pmsmtool.machine.flux_map import FluxMap
from pmsmtool.machine.flux_map_check import flux_range, reciprocal_change


@dataclass(frozen=True, slots=True, eq=False)
class FluxGrid:
    """Grids as read, before they are a map: holes are NaN."""

    i_d_a: Array
    i_q_a: Array
    """Axes (A peak). Shape (n_d,), (n_q,)."""
    psi_d_wb: Array
    psi_q_wb: Array
    """Flux linkages (Wb). Shape (n_d, n_q)."""

    @property
    def holes(self) -> NDArray[np.bool_]:
        """Nodes without a flux, shape (n_d, n_q)."""
        return ~(np.isfinite(self.psi_d_wb) & np.isfinite(self.psi_q_wb))

    def holes_text(self) -> str:
        """Return how many nodes are holes, and the currents of the first five."""
        at = np.argwhere(self.holes)
        places = ", ".join(f"({self.i_d_a[m]:g}, {self.i_q_a[n]:g}) A" for m, n in at[:5])
        more = f" and {len(at) - 5} more" if len(at) > 5 else ""
        return f"{len(at)} of {self.holes.size} nodes are holes: {places}{more}"


def _recorded(flux_map: FluxMap, text: str) -> FluxMap:
    return flux_map.with_meta(repairs=[*flux_map.meta.get("repairs", []), text])


def fill_holes(grid: FluxGrid) -> tuple[FluxGrid, str]:
    """Fill holes by the smoothest surface: least squares of all second divided differences along both axes.

    Linear data are continued exactly. Returns the filled grid and what was done; refuses when less than half of
    the nodes, or less than four per axis, are known.

    Raises ConfigError: too many holes.
    """
    from scipy.sparse.linalg import spsolve  # start-up

    known = ~grid.holes
    if known.mean() < 0.5 or min(np.sum(known.any(axis=1)), np.sum(known.any(axis=0))) < 4:
        raise ConfigError(
            f"too little is left to fill from: {grid.holes_text()}", hint="cut the map to its filled part"
        )
    rows = _second_differences(grid.i_d_a, grid.i_q_a)
    hole = ~known.ravel()
    filled = []
    unknown, normal = rows[:, hole], rows[:, hole].T @ rows[:, hole]
    for values in (grid.psi_d_wb, grid.psi_q_wb):
        flat = np.where(hole, 0.0, values.ravel())
        flat[hole] = spsolve(normal.tocsc(), -(unknown.T @ (rows[:, ~hole] @ flat[~hole])))
        filled.append(flat.reshape(values.shape))
    text = f"holes filled by the smoothest surface; {grid.holes_text()}"
    return replace(grid, psi_d_wb=filled[0], psi_q_wb=filled[1]), text


def _second_differences(axis_d: Array, axis_q: Array) -> Any:
    """Sparse matrix of all second divided differences of a grid, scaled by the mean steps, shape (m, n_d n_q)."""
    from scipy.sparse import diags_array, eye_array, kron, vstack  # start-up

    def along(axis: Array) -> Any:
        h = np.diff(axis) / np.mean(np.diff(axis))
        before, behind = 2 / (h[:-1] * (h[:-1] + h[1:])), 2 / (h[1:] * (h[:-1] + h[1:]))
        diagonals, shape = [before, -before - behind, behind], (len(axis) - 2, len(axis))
        return diags_array(diagonals, offsets=[0, 1, 2], shape=shape)

    along_d, along_q = kron(along(axis_d), eye_array(len(axis_q))), kron(eye_array(len(axis_d)), along(axis_q))
    return vstack([along_d, along_q]).tocsc()


def symmetrise(flux_map: FluxMap) -> FluxMap:
    """Make psi_d even and psi_q odd in i_q; a map of i_q >= 0 (or <= 0) only is mirrored to both signs.

    psi_d <- (psi_d(i_q) + psi_d(-i_q))/2, psi_q <- (psi_q(i_q) - psi_q(-i_q))/2, on the symmetric part of the i_q axis.
    """
    axis = flux_map.i_q_a
    if axis[0] == 0.0 or axis[-1] == 0.0:
        return _mirrored(flux_map)
    reach = min(-axis[0], axis[-1])
    half = np.unique(np.abs(axis[np.abs(axis) <= reach * (1 + 1e-12)]))
    full = np.unique(np.concatenate([-half, [0.0], half]))
    i_d, i_q = np.meshgrid(flux_map.i_d_a, full, indexing="ij")
    up, down = flux_map.flux(i_d, i_q), flux_map.flux(i_d, -i_q)
    psi_d, psi_q = (up[0] + down[0]) / 2.0, (up[1] - down[1]) / 2.0
    change = np.hypot(psi_d - up[0], psi_q - up[1]) / flux_range(flux_map)
    text = (
        f"made symmetric in i_q on +-{reach:g} A: fluxes moved by {100 * np.sqrt(np.mean(change**2)):.3f} % rms, "
        f"{100 * change.max():.3f} % at most of the flux range"
    )
    return _recorded(replace(flux_map, i_q_a=full, psi_d_wb=psi_d, psi_q_wb=psi_q), text)


def _mirrored(flux_map: FluxMap) -> FluxMap:
    sign = 1 if flux_map.i_q_a[0] == 0.0 else -1
    axis = flux_map.i_q_a[::sign]
    psi_d, psi_q = flux_map.psi_d_wb[:, ::sign], flux_map.psi_q_wb[:, ::sign].copy()
    at_zero = float(np.abs(psi_q[:, 0]).max())
    psi_q[:, 0] = 0.0
    order = slice(None, None, sign)
    text = f"mirrored to both signs of i_q; psi_q at i_q = 0 was up to {at_zero:.3g} Wb and is now zero"
    return _recorded(
        replace(
            flux_map,
            i_q_a=np.concatenate([-axis[:0:-1], axis])[order],
            psi_d_wb=np.concatenate([psi_d[:, :0:-1], psi_d], axis=1)[:, order],
            psi_q_wb=np.concatenate([-psi_q[:, :0:-1], psi_q], axis=1)[:, order],
        ),
        text,
    )


def rotate(flux_map: FluxMap, angle_rad: float) -> FluxMap:
    """Turn the dq frame ahead by an electrical angle, for a map whose d axis is not along the magnets.

    psi'(i') = R(-angle) psi(R(angle) i') on the largest rectangle of the same node counts, centred as the old one,
    whose corners lie on the old map. With the angle of the no-load flux the new d axis is the magnets'.
    """
    if not math.isfinite(angle_rad):
        raise ConfigError("the map cannot be turned: it has no magnet flux to turn to", hint="give a map with magnets")
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    scale = _inscribed(flux_map, cos, sin)
    axis_d, axis_q = flux_map.i_d_a * scale, flux_map.i_q_a * scale
    i_d, i_q = np.meshgrid(axis_d, axis_q, indexing="ij")
    psi_d, psi_q = flux_map.flux(cos * i_d - sin * i_q, sin * i_d + cos * i_q)
    text = (
        f"frame turned by {math.degrees(angle_rad):+.4f} deg el; the currents shrank to {scale:.4f} of the "
        "old ranges so that no node lies outside the data"
    )
    return _recorded(
        replace(
            flux_map,
            i_d_a=axis_d,
            i_q_a=axis_q,
            psi_d_wb=cos * psi_d + sin * psi_q,
            psi_q_wb=-sin * psi_d + cos * psi_q,
        ),
        text,
    )


def _inscribed(flux_map: FluxMap, cos: float, sin: float) -> float:
    """Largest scale <= 1 at which the turned rectangle's corners lie inside the old one (zero is inside both)."""
    scale = 1.0
    for d in (flux_map.i_d_a[0], flux_map.i_d_a[-1]):
        for q in (flux_map.i_q_a[0], flux_map.i_q_a[-1]):
            for value, axis in ((cos * d - sin * q, flux_map.i_d_a), (sin * d + cos * q, flux_map.i_q_a)):
                limit = axis[-1] if value > 0 else axis[0]
                if abs(value) > abs(limit):
                    scale = min(scale, float(limit / value))
    if scale < 0.1:
        raise ConfigError(
            "the map cannot be turned by this angle: hardly any current would be left",
            likely="the map ends near zero current on one axis",
            hint="swap or reverse the axes in the source instead",
        )
    return scale


def make_reciprocal(flux_map: FluxMap) -> FluxMap:
    """Move the fluxes by the least amount that gives the map a co-energy (``reciprocal_change``)."""
    change_d, change_q = reciprocal_change(flux_map)
    size = np.hypot(change_d, change_q) / flux_range(flux_map)
    text = (
        f"made reciprocal: fluxes moved by {100 * np.sqrt(np.mean(size**2)):.3f} % rms, {100 * size.max():.3f} % "
        "at most of the flux range"
    )
    return _recorded(
        replace(flux_map, psi_d_wb=flux_map.psi_d_wb + change_d, psi_q_wb=flux_map.psi_q_wb + change_q), text
    )
