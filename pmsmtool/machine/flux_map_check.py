# SPDX-License-Identifier: MIT
"""Checks of a flux map, with numbers: reciprocity, monotonicity, rotation, asymmetry.

A map from measurements or finite elements is never perfect; a map with swapped axes, a turned frame or bad cells is
common. The report says how far it is from a machine, and where.

Reciprocity of a flux map: loop integrals of the co-energy, and the nearest map that has one.

A lossless machine has a co-energy W(i) with psi = grad W, so d psi_d/d i_q = d psi_q/d i_d and the integral of
psi . di around every loop is zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.machine.flux_map import FluxMap, jacobian_samples

RECIPROCITY_LIMIT = 0.002
"""Largest accepted distance (rms, of the flux range) to the nearest reciprocal map. Measured: 0.0002 on a carefully
measured 21 x 27 map; 0.0055 is known of a measured map that is not reciprocal."""

ROTATION_LIMIT_RAD = math.radians(1.0)
"""Largest accepted angle between the d axis and the flux at zero current."""

ASYMMETRY_LIMIT = 0.005
"""Largest accepted asymmetry in i_q (rms, of the flux range)."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One number of a report."""

    name: str
    """What was looked at."""
    ok: bool
    """Whether it is inside its limit."""
    text: str
    """The number, its place and its limit, one sentence."""


@dataclass(frozen=True, slots=True)
class FluxMapReport:
    """What was found in a map."""

    det_min_h2: float
    """Smallest determinant of the incremental inductance (H^2); must be positive."""
    L_qq_h: tuple[float, float]
    """Smallest and largest q self inductance of the map (H)."""
    not_monotonic: int
    """Sample points (3 x 3 per cell) where the map does not rise with the current."""
    reciprocity_rms: float
    """Root mean square distance to the nearest reciprocal map, of the flux range."""
    curl_max_h: float
    """Largest cell mean of d psi_d/d i_q - d psi_q/d i_d (H)."""
    no_load_angle_rad: float
    """Angle of the flux at zero current against the d axis; NaN without magnet flux."""
    psi_f_wb: float
    """Its magnitude (Wb)."""
    asymmetry_rms: float
    asymmetry_max: float
    """Deviation from psi_d even, psi_q odd in i_q, of the flux range; NaN where one side is missing."""
    findings: tuple[Finding, ...]
    """The verdicts, worst first."""

    @property
    def ok(self) -> bool:
        """Whether every number is inside its limit."""
        return all(finding.ok for finding in self.findings)

    @property
    def complaints(self) -> tuple[str, ...]:
        """What is outside its limit, one sentence each, for whoever goes on with the map."""
        return tuple(f"flux map, {finding.name}: {finding.text}" for finding in self.findings if not finding.ok)


def check_flux_map(flux_map: FluxMap) -> FluxMapReport:
    """Measure a map against what a machine can be."""
    i_d, i_q, jac = jacobian_samples(flux_map)
    det = jac[0, 0] * jac[1, 1] - jac[0, 1] * jac[1, 0]
    bad = (det <= 0.0) | (jac[0, 0] <= 0.0) | (jac[1, 1] <= 0.0)
    worst = int(np.argmin(np.where(bad, det, np.inf)) if bad.any() else np.argmin(det))
    change_d, change_q = reciprocal_change(flux_map)
    span = flux_range(flux_map)
    loops = LoopIntegrals(flux_map.i_d_a, flux_map.i_q_a)
    curl = loops(flux_map.psi_d_wb, flux_map.psi_q_wb) / np.outer(np.diff(flux_map.i_d_a), np.diff(flux_map.i_q_a))
    at_d, at_q = (int(n) for n in np.unravel_index(int(np.argmax(np.abs(curl))), curl.shape))
    distance = np.hypot(change_d, change_q) / span
    rms, largest = float(np.sqrt(np.mean(distance**2))), float(distance.max())
    psi_0 = flux_map.flux(0.0, 0.0)
    psi_f = float(np.hypot(*psi_0))
    angle = math.atan2(float(psi_0[1]), float(psi_0[0])) if psi_f > 1e-6 * span else math.nan
    asymmetry = _asymmetry(flux_map) / span
    asym_rms = float(np.sqrt(np.mean(asymmetry**2))) if asymmetry.size else math.nan
    asym_max = float(asymmetry.max()) if asymmetry.size else math.nan
    findings = (
        Finding(
            "monotonic",
            not bad.any(),
            f"flux rises with current at {det.size - int(bad.sum())} of {det.size} points; smallest determinant "
            f"{det[worst]:.3g} H^2 at i_d = {i_d[worst]:.4g} A, i_q = {i_q[worst]:.4g} A",
        ),
        Finding(
            "reciprocal",
            rms <= RECIPROCITY_LIMIT,
            f"{100 * rms:.3f} % rms, {100 * largest:.3f} % at most of the flux range away from a reciprocal map "
            f"(limit {100 * RECIPROCITY_LIMIT:g} % rms); largest curl {1e3 * curl[at_d, at_q]:.3g} mH in the cell at "
            f"i_d = {flux_map.i_d_a[at_d]:.4g} A, i_q = {flux_map.i_q_a[at_q]:.4g} A",
        ),
        _rotation_finding(angle, psi_f),
        Finding(
            "symmetric in i_q",
            not asym_rms > ASYMMETRY_LIMIT,
            f"{100 * asym_rms:.3f} % rms, {100 * asym_max:.3f} % at most of the flux range "
            f"(limit {100 * ASYMMETRY_LIMIT:g} % rms)"
            if asymmetry.size
            else "i_q has one sign only: symmetry is not known",
        ),
    )
    return FluxMapReport(
        det_min_h2=float(det.min()),
        L_qq_h=(float(jac[1, 1].min()), float(jac[1, 1].max())),
        not_monotonic=int(bad.sum()),
        reciprocity_rms=rms,
        curl_max_h=float(np.abs(curl).max()),
        no_load_angle_rad=angle,
        psi_f_wb=psi_f,
        asymmetry_rms=asym_rms,
        asymmetry_max=asym_max,
        findings=tuple(sorted(findings, key=lambda finding: finding.ok)),
    )


def _rotation_finding(angle: float, psi_f: float) -> Finding:
    if math.isnan(angle):
        return Finding("d axis", True, "no magnet flux: the d axis cannot be checked at zero current")
    text = f"flux at zero current {psi_f:.4g} Wb, {math.degrees(angle):+.3f} deg el from the d axis"
    if abs(abs(angle) - math.pi / 2) < math.pi / 8:
        text += "; d and q look swapped"
    elif abs(angle) > math.pi * 7 / 8:
        text += "; the d axis looks reversed"
    return Finding("d axis", abs(angle) <= ROTATION_LIMIT_RAD, f"{text} (limit {math.degrees(ROTATION_LIMIT_RAD):g})")


def flux_range(flux_map: FluxMap) -> float:
    """Return the larger of the two flux ranges (Wb), the reference of relative deviations."""
    return max(float(np.ptp(flux_map.psi_d_wb)), float(np.ptp(flux_map.psi_q_wb)))


def _asymmetry(flux_map: FluxMap) -> Array:
    """Half the deviation from psi_d even, psi_q odd in i_q (Wb) at nodes whose mirror is on the map; may be empty."""
    positive = flux_map.i_q_a[(flux_map.i_q_a > 0) & (flux_map.i_q_a <= -flux_map.i_q_a[0])]
    i_d, i_q = np.meshgrid(flux_map.i_d_a, positive, indexing="ij")
    up, down = flux_map.flux(i_d, i_q), flux_map.flux(i_d, -i_q)
    return np.asarray(np.hypot(up[0] - down[0], up[1] + down[1]) / 2.0).ravel()


CG_TOLERANCE = 1e-13
"""Relative residual at which the reciprocal projection stops."""


def spline_slopes_matrix(axis: Array) -> Array:
    """Return the matrix (n, n) that maps node values to the node slopes of their not-a-knot cubic spline."""
    n, h = len(axis), np.diff(axis)
    left, right = np.zeros((n, n)), np.zeros((n, n))
    for m in range(1, n - 1):
        left[m, m - 1 : m + 2] = h[m], 2.0 * (h[m - 1] + h[m]), h[m - 1]
        right[m, m - 1] = -3.0 * h[m] / h[m - 1]
        right[m, m + 1] = 3.0 * h[m - 1] / h[m]
        right[m, m] = -right[m, m - 1] - right[m, m + 1]
    for row, a, b, sign in ((0, h[0], h[1], 1), (n - 1, h[-1], h[-2], -1)):
        order = (0, 1, 2) if sign > 0 else (n - 1, n - 2, n - 3)
        left[row, order[0]], left[row, order[1]] = b, a + b
        d_0, d_1 = (3.0 * a + 2.0 * b) * b / (a + b), a * a / (a + b)  # of the slopes of the end intervals
        right[row, order[0]] -= sign * d_0 / a
        right[row, order[1]] += sign * (d_0 / a - d_1 / b)
        right[row, order[2]] += sign * d_1 / b
    return np.asarray(np.linalg.solve(left, right))


def _edge_integrals(axis: Array) -> Array:
    """Matrix (n - 1, n): integral of the spline through node values over each interval."""
    n, h = len(axis), np.diff(axis)
    average = np.zeros((n - 1, n))
    average[np.arange(n - 1), np.arange(n - 1)] = average[np.arange(n - 1), np.arange(1, n)] = 0.5
    slopes = spline_slopes_matrix(axis)
    return np.asarray(h[:, None] * average + (h**2 / 12.0)[:, None] * (slopes[:-1] - slopes[1:]))


class LoopIntegrals:
    """Loop integral of psi . di around each cell, and its adjoint.

    A reciprocal map has a co-energy, so every loop integral is zero. Edges are integrated on the splines of
    the map, so that a smooth reciprocal machine is not accused of its curvature.
    """

    def __init__(self, i_d_a: Array, i_q_a: Array) -> None:
        self.along_d, self.along_q = _edge_integrals(i_d_a), _edge_integrals(i_q_a)

    def __call__(self, psi_d: Array, psi_q: Array) -> Array:
        """Loop integrals (J), shape (n_d - 1, n_q - 1)."""
        return np.asarray(np.diff(self.along_d @ psi_d, axis=1) - np.diff(psi_q @ self.along_q.T, axis=0))

    def adjoint(self, weight: Array) -> tuple[Array, Array]:
        """Adjoint of the call."""
        pad_d, pad_q = np.pad(weight, ((0, 0), (1, 1))), np.pad(weight, ((1, 1), (0, 0)))
        return self.along_d.T @ -np.diff(pad_d, axis=1), np.diff(pad_q, axis=0) @ self.along_q


def reciprocal_change(flux_map: FluxMap) -> tuple[Array, Array]:
    """Return the least change of (psi_d, psi_q) (Wb, in the sum of squares over the nodes) that makes all loops zero.

    Minimum-norm solution -C' (C C')^-1 C psi of C (psi + change) = 0 by conjugate gradients.
    """
    loops = LoopIntegrals(flux_map.i_d_a, flux_map.i_q_a)
    residual = loops(flux_map.psi_d_wb, flux_map.psi_q_wb)
    weight, direction = np.zeros_like(residual), residual.copy()
    square = first = float(np.sum(residual**2))
    for _ in range(4 * residual.size):
        if square <= CG_TOLERANCE**2 * first or square == 0.0:
            break
        image = loops(*loops.adjoint(direction))
        length = square / float(np.sum(direction * image))
        weight += length * direction
        residual = residual - length * image
        last, square = square, float(np.sum(residual**2))
        direction = residual + (square / last) * direction
    change_d, change_q = loops.adjoint(weight)
    return -change_d, -change_q
