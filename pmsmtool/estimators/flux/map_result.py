# SPDX-License-Identifier: MIT
"""From a fitted co-energy to a flux map that design can use: coverage, intervals, tests, and what lies outside."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.errors import ConfigError, IdentificationError
from pmsmtool.estimators.current_sensors import Noise
from pmsmtool.estimators.estimate import SensorTolerance
from pmsmtool.estimators.flux.map_fit import CoenergyFit, MagnetFlux, fit_coenergy
from pmsmtool.estimators.flux.map_rows import Frame
from pmsmtool.estimators.injection.sampling_instant import Sampling
from pmsmtool.estimators.inverter_error import Modulation
from pmsmtool.estimators.resistance import ResistanceResult, resistance_warmed
from pmsmtool.machine.flux_map import FluxMap, require_monotonic
from pmsmtool.machine.flux_map_check import reciprocal_change
from pmsmtool.machine.parameters import Estimate
from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace

STAGE = "flux map"
NODES = 41
"""Nodes per axis of the exported map."""
TURNS_LEAST = 4
"""Turns of the voltage on every axis it acts on: two whole cycles."""
KNOWN_SHARE = 0.02
"""Largest standard deviation of a flux that counts as identified, of the flux range; without the magnet's, which is
judged as psi_f. Twice what all of them may have (``DEVIATION_LIMIT``): pulses that went there leave less."""
COVERED_SHARE = 0.99
"""Nodes of a disc that must be identified for the disc to count."""
RADII = (1.0, 0.97, 0.94, 0.91, 0.88, 0.85, 0.8)
"""Discs that are tried, of the largest current; below the last the scan has not filled the plane."""
MISFIT_LIMIT = 0.02
"""Largest flux misfit, of the flux range: it is in the interval of every flux, beyond it is not the pulses' machine."""
TRAINS_LEFT_OUT = 2
"""Most trains that may be left out: the plane of the others is judged by itself."""
UNSEEN_NOTED = 0.01
"""What the angles of the pulses leave open of the inductance, relative, above which it is reported."""
POINT_ANGLES = 181
POINT_LEAST = 0.1
"""Least d current, of the vector, at which an apparent L_d means anything."""
RECIPROCITY_NOTED = 0.002
"""Distance to a reciprocal map, of the flux range, above which it is reported: a machine has none."""


@dataclass(frozen=True, slots=True, eq=False)
class FluxMapResult:
    """A measured flux map."""

    flux_map: FluxMap
    """At the reference temperature; outside the disc of ``radius_a`` continued linearly."""
    identified: NDArray[np.bool_]
    """Nodes that data support. Shape (n_d, n_q)."""
    psi_std_wb: Array
    """Standard deviations of psi_d, psi_q. Shape (2, n_d, n_q)."""
    L_h: Array
    L_std_h: Array
    """Incremental L_dd, L_dq, L_qq and their standard deviations; NaN where not identified. Shape (3, n_d, n_q)."""
    radius_a: float
    """Current up to which the plane is known (A peak)."""
    span_wb: float
    """Flux range, the reference of relative numbers."""
    misfit: float
    asymmetry: float
    skew: float
    """Flux residual beyond noise, flux that breaks the symmetry in i_q, distance of the freer model to a reciprocal
    map; rms, of the flux range."""
    fit: CoenergyFit
    """Behind it all."""
    systematic_flux: float
    systematic_current: float
    """Relative 95 % half widths of the two scales that no experiment sees."""
    notes: tuple[str, ...]
    """What a reader should know."""

    @property
    def deviation(self) -> float:
        """Rms standard deviation of the fluxes within ``radius_a``, of their range; without the magnet's."""
        i_d, i_q = np.meshgrid(self.flux_map.i_d_a, self.flux_map.i_q_a, indexing="ij")
        variance = np.square(self.psi_std_wb[:, np.hypot(i_d, i_q) <= self.radius_a])
        variance[0] -= self.fit.magnet_std_wb**2
        return math.sqrt(float(np.mean(variance))) / self.span_wb

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return what the map's own file cannot say, for a ``.npz`` beside it."""
        names = ("L_dd", "L_dq", "L_qq")
        return {
            "i_d_a": self.flux_map.i_d_a,
            "i_q_a": self.flux_map.i_q_a,
            "identified": self.identified,
            "psi_d_std_wb": self.psi_std_wb[0],
            "psi_q_std_wb": self.psi_std_wb[1],
            **{f"{name}_h": self.L_h[k] for k, name in enumerate(names)},
            **{f"{name}_std_h": self.L_std_h[k] for k, name in enumerate(names)},
        }

    def at_rated_current(self, pole_pairs: int, I_apk: float) -> dict[str, Estimate]:
        """Return incremental and apparent inductances (H) at the largest torque of a current, by machine-file key.

        Parameters
        ----------
        pole_pairs : int
            Pole pairs.
        I_apk : float
            Current (A peak); at most what the map knows.
        """
        current = min(I_apk, self.radius_a)
        angle = np.linspace(0.5 * math.pi, math.pi, POINT_ANGLES)
        torque = self.flux_map.torque_nm(pole_pairs, current * np.cos(angle), current * np.sin(angle))
        best = float(angle[int(np.argmax(torque))])
        i_d, i_q = np.array([current * math.cos(best)]), np.array([current * math.sin(best)])
        L, L_std = self.fit.inductance(i_d, i_q)[:, 0], self.fit.inductance_std(i_d, i_q)[:, 0]
        psi_std = self.fit.flux_std(i_d, i_q)[:, 0]
        L_d_app, L_q_app = (float(x[0]) for x in self.flux_map.apparent_inductance(i_d, i_q))
        rows = {
            "L_d_h": (L[0], L_std[0]),
            "L_q_h": (L[2], L_std[2]),
            "L_q_app_h": (L_q_app, psi_std[1] / abs(i_q[0])),
        }
        if abs(i_d[0]) > POINT_LEAST * current:  # psi_d - psi_f over nothing is no inductance
            rows["L_d_app_h"] = (L_d_app, math.sqrt(2.0) * psi_std[0] / abs(i_d[0]))
        relative = math.hypot(self.systematic_flux, self.systematic_current)
        return {
            name: Estimate(
                float(value), float(std), relative * abs(float(value)), "H", n=self.fit.n, chi2=self.fit.chi2,
                method="co-energy spline of voltage pulses", i_d_apk=float(i_d[0]), i_q_apk=float(i_q[0]),
            )
            for name, (value, std) in rows.items()
        }  # fmt: skip


def estimate_flux_map(
    traces: Sequence[Trace],
    noise: Noise,
    resistance: ResistanceResult,
    frame: Frame,
    magnet: MagnetFlux,
    *,
    to_reference_wb: float = 0.0,
    align: bool = False,
    tolerance: SensorTolerance | None = None,
    U_dc_v: float = math.inf,
    sampling: Sampling | None = None,
) -> FluxMapResult:
    """Estimate the flux map from pulse traces.

    Raises IdentificationError: ``E_CLIPPED``, ``E_EXCITATION`` (pulses or plane incomplete), ``E_MODEL_MISMATCH``,
    ``E_NOT_IDENTIFIABLE`` (a flux that does not rise with its current).

    Parameters
    ----------
    traces : sequence of Trace
        From ``experiments.flux_map_scan``; ``meta["i_max_a"]``.
    noise : Noise
        From the zero-current trace.
    resistance : ResistanceResult
        Resistance and inverter error.
    frame : Frame
        Pole pairs and offsets.
    magnet : MagnetFlux
        Flux at zero current at the temperature of the pulses.
    to_reference_wb : float
        What the magnets' temperature adds to psi_d on the way to the reference temperature (Wb).
    align : bool
        Take the axis of symmetry as d axis: a held rotor, whose offset no speed run has measured.
    tolerance : SensorTolerance
        Declared sensor tolerances.
    U_dc_v : float
        DC link (V); infinite where it is not known: the ripple within a period is then none.
    sampling : Sampling, optional
        When and how the currents are sampled, where that is known.
    """
    tolerance = tolerance or SensorTolerance()
    traces, left_out = _whole_pulses(traces)
    R_ohm, T_s = _R_at(resistance, traces), float(traces[0].meta["control_period_s"])
    fit = fit_coenergy(
        traces, frame, resistance.curve, R_ohm=R_ohm, sigma_a=noise.sigma_a, magnet=magnet, align=align,
        legs=(Modulation(U_dc_v, (math.nan, math.nan), T_s, resistance.dead_time_s(U_dc_v, T_s)), sampling)
        if math.isfinite(U_dc_v) else None,
    )  # fmt: skip
    i_max = max(float(trace.meta["i_max_a"]) for trace in traces)
    axis_d, axis_q = _axis(fit.spline.breaks_d, i_max), _axis(fit.spline.breaks_q, i_max)
    i_d, i_q = (grid.ravel() for grid in np.meshgrid(axis_d, axis_q, indexing="ij"))
    shape = (len(axis_d), len(axis_q))
    psi = fit.flux(i_d, i_q)
    # the magnet's flux is not the pulses': what is open of it says nothing of where they went
    shown = replace(fit, magnet_std_wb=0.0).flux_std(i_d, i_q)
    inside = np.hypot(i_d, i_q) <= RADII[-1] * i_max
    span = float(np.max(np.ptp(psi[:, inside], axis=1)))
    misfit = fit.misfit_a * float(np.median(np.max(fit.inductance(i_d[inside], i_q[inside])[[0, 2]], axis=0))) / span
    if misfit > MISFIT_LIMIT:
        raise refuse(
            "E_MODEL_MISMATCH",
            f"the pulses leave {100 * misfit:.2g} % of the flux range unexplained, limit {100 * MISFIT_LIMIT:g} %",
            stage=STAGE,
            likely="an encoder that does not follow the rotor, a wrong number of pole pairs, or eddy currents",
        )
    radius, psi = _supported(fit, axis_d, axis_q, shown, span, i_max)
    at_end = (i_d <= radius / i_max * axis_d[0]) | (i_d >= radius / i_max * axis_d[-1])
    known = (np.hypot(i_d, i_q) <= radius) & ~at_end & np.all(shown <= KNOWN_SHARE * span, axis=0)
    L = np.where(known, fit.inductance(i_d, i_q), math.nan)
    skew, asymmetry = _skew(fit, radius) / span, fit.asymmetry / span
    # a sensor whose offset drifts by 1 % within the pulses moves fluxes by 0.27 % of their range and leaves no misfit:
    # all that shows it is a map of 0.24 % that no machine has
    fit = replace(fit, unphysical_wb=span * math.hypot(skew, 0.0 if fit.symmetric else asymmetry))
    psi[0] += to_reference_wb
    notes = (*left_out, *_notes(fit, asymmetry, skew, radius, i_max))
    meta = _meta(fit, traces, radius, misfit, asymmetry, skew, notes)
    return FluxMapResult(flux_map=FluxMap(axis_d, axis_q, psi[0].reshape(shape), psi[1].reshape(shape), meta=meta),
                         identified=known.reshape(shape), psi_std_wb=fit.flux_std(i_d, i_q).reshape(2, *shape),
                         L_h=L.reshape(3, *shape),
                         L_std_h=np.where(known, fit.inductance_std(i_d, i_q), math.nan).reshape(3, *shape),
                         radius_a=radius, span_wb=span, misfit=misfit, asymmetry=asymmetry, skew=skew, fit=fit,
                         systematic_flux=tolerance.flux, systematic_current=tolerance.current_gain,
                         notes=notes)  # fmt: skip


def _whole_pulses(traces: Sequence[Trace]) -> tuple[Sequence[Trace], Sequence[str]]:
    """Return the trains without up to :data:`TRAINS_LEFT_OUT` that tell nothing, and what was left out."""
    whole: list[Trace] = []
    refusals: list[IdentificationError] = []
    for k, trace in enumerate(traces):
        try:
            _check_pulses(k, trace)
            whole.append(trace)
        except IdentificationError as refusal:
            refusals.append(refusal)
    if len(refusals) > TRAINS_LEFT_OUT:
        raise refusals[0]
    return whole, [f"flux map: left out: {refusal.what.removeprefix(f'{refusal.reason}: ')}" for refusal in refusals]


def _check_pulses(k: int, trace: Trace) -> None:
    flagged = int(np.sum(trace["flagged"] > 0.0))
    if flagged:
        raise refuse("E_CLIPPED", f"{flagged} samples of pulse train {k} are limited or clipped", stage=STAGE)
    for axis in "dq":
        u = trace[f"u_{axis}_v"][1:]
        turns = int(np.count_nonzero(np.diff(np.sign(u))))
        if float(np.max(np.abs(u))) > 0.0 and turns < TURNS_LEAST:
            raise refuse(
                "E_EXCITATION",
                f"pulse train {k} turned the {axis} voltage {turns} times, {TURNS_LEAST} needed",
                stage=STAGE,
                likely="too little voltage for the inductance of this axis, or a record too short",
            )


def _R_at(resistance: ResistanceResult, traces: Sequence[Trace]) -> float:
    """Resistance at the mean temperature of the pulses (ohm)."""
    known = [float(np.mean(trace["T_winding_c"])) for trace in traces if "T_winding_c" in trace.signals]
    T = sum(known) / len(known) if known else math.nan
    return resistance_warmed(resistance.R_measured, T, resistance.copper)


def _axis(breaks: Array, i_max: float) -> Array:
    """Nodes from the lowest to the highest current of the data, zero among them, at most to i_max."""
    low, high = max(-i_max, float(breaks[0])), min(i_max, float(breaks[-1]))
    half = NODES // 2 + 1
    return np.concatenate([np.linspace(low, 0.0, half), np.linspace(0.0, high, half)[1:]])


def _supported(
    fit: CoenergyFit, axis_d: Array, axis_q: Array, std: Array, span: float, i_max: float
) -> tuple[float, Array]:
    """Return the largest radius (A) that data cover and from which the map goes on rising, and the fluxes (Wb)."""
    i_d, i_q = (grid.ravel() for grid in np.meshgrid(axis_d, axis_q, indexing="ij"))
    covered = 0.0
    for share in RADII:
        inside = np.hypot(i_d, i_q) <= share * i_max
        covered = float(np.mean(np.all(std[:, inside] <= KNOWN_SHARE * span, axis=0)))
        if covered < COVERED_SHARE:
            continue
        psi = _continued(fit, i_d, i_q, share * i_max, (share * axis_d[0], share * axis_d[-1]))
        try:
            require_monotonic(FluxMap(axis_d, axis_q, *psi.reshape(2, len(axis_d), len(axis_q))))
        except ConfigError:
            continue
        return share * i_max, psi
    if covered >= COVERED_SHARE:
        raise refuse("E_NOT_IDENTIFIABLE", "a flux falls where its current rises", stage=STAGE)
    raise refuse(
        "E_EXCITATION",
        f"only {100 * covered:.0f} % of the current plane up to {RADII[-1] * i_max:.3g} A is covered by data, "
        f"{100 * COVERED_SHARE:g} % needed",
        stage=STAGE,
        likely="pulses that did not reach their currents, or a held rotor with an unknown encoder offset in the drive",
    )


def _continued(fit: CoenergyFit, i_d: Array, i_q: Array, radius: float, ends_d: tuple[float, float]) -> Array:
    """Return the fluxes, beyond the disc and the d currents in it continued linearly with the inductance of the edge.

    The largest d currents of the pulses are those that noise made larger: there the flux seems to stay or to fall.
    """
    length = np.hypot(i_d, i_q)
    share = np.where(length > radius, radius / np.maximum(length, 1e-30), 1.0)
    e_d, e_q = np.clip(share * i_d, *ends_d), share * i_q
    psi = fit.flux(e_d, e_q)
    L_dd, L_dq, L_qq = fit.inductance(e_d, e_q)
    d, q = i_d - e_d, i_q - e_q
    return np.asarray(psi + np.stack([L_dd * d + L_dq * q, L_dq * d + L_qq * q]))


def _skew(fit: CoenergyFit, radius: float) -> float:
    """Distance (rms, Wb) of the freer model to the nearest reciprocal map, on the square inside the disc."""
    side = radius / math.sqrt(2.0)
    axis = np.linspace(-side, side, 17)
    i_d, i_q = (grid.ravel() for grid in np.meshgrid(axis, axis, indexing="ij"))
    psi = fit.spline.flux(fit.skew.gradient, i_d, i_q)
    psi[0] += fit.skew.spline.derivative(i_d, i_q, 0, 0) @ fit.skew.c
    shape = (len(axis), len(axis))
    change = reciprocal_change(FluxMap(axis, axis, psi[0].reshape(shape), psi[1].reshape(shape)))
    return math.sqrt(float(np.mean(np.square(change[0]) + np.square(change[1]))))


def _notes(fit: CoenergyFit, asymmetry: float, skew: float, radius: float, i_max: float) -> tuple[str, ...]:
    notes = []
    if not fit.symmetric:
        notes.append(
            f"flux map: not symmetric in i_q, {100 * asymmetry:.2g} % of the flux range rms; "
            f"its axis of symmetry stands {math.degrees(fit.axis_rad):+.3g} deg (electrical) from the d axis"
        )
    if skew > RECIPROCITY_NOTED:
        notes.append(
            f"flux map: a freer model is {100 * skew:.2g} % of the flux range rms away from a reciprocal map, "
            "which no machine is: the pulses see something else, eddy currents or a load on the shaft"
        )
    if fit.unseen > UNSEEN_NOTED:
        notes.append(
            f"flux map: measured at too few angles of the rotor: {100 * fit.unseen:.2g} % of its inductances, "
            "as slots and unequal phases may change them, are in its intervals"
        )
    if radius < i_max:
        notes.append(f"flux map: known up to {radius:.3g} A of {i_max:.3g} A; continued linearly beyond")
    return tuple(notes)


def _meta(
    fit: CoenergyFit, traces: Sequence[Trace], radius: float, misfit: float, asymmetry: float, skew: float,
    notes: Sequence[str],
) -> Mapping[str, Any]:  # fmt: skip
    return {
        "origin": "pmsmtool identify: co-energy spline regression of voltage pulses",
        "rotor": "held" if traces[0].meta.get("held") else "free",
        "identified_to_apk": radius,
        "symmetric": fit.symmetric,
        "asymmetry_share": asymmetry,
        "skew_share": skew,
        "misfit_share": misfit,
        "chi2": fit.chi2,
        "residuals": fit.n,
        "current_delay_s": fit.delay_s,
        "notes": list(notes),
    }
