# SPDX-License-Identifier: MIT
"""The flux map of an identification, from the traces of its pulses, and its files."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pmsmtool.estimators.estimate import SensorTolerance
from pmsmtool.estimators.flux.map_fit import MagnetFlux
from pmsmtool.estimators.flux.map_result import STAGE, FluxMapResult, estimate_flux_map
from pmsmtool.estimators.flux.map_rows import Frame
from pmsmtool.machine.flux_map_import import flux_map_csv, flux_map_npz
from pmsmtool.machine.parameters import Estimate, MachineParameters
from pmsmtool.npz_file import npz_bytes
from pmsmtool.params.catalogue import BY_NAME
from pmsmtool.refusals import refuse
from pmsmtool.run_directory import Acceptance, RunDirectory
from pmsmtool.trace import Trace
from pmsmtool.units import format_quantity

if TYPE_CHECKING:
    from pmsmtool.identification.evaluate import Evaluation

MAP_FILE = "flux_map.npz"
MAP_CSV = "flux_map.csv"
MAP_INTERVALS = "flux_map_intervals.npz"

SET_UP_BY = ("encoder.offset_rad", "motor.psi_f_wb")
"""Parameters without which a held rotor's map has neither angle nor constant; one with the factory's value was set by
nobody. Pole pairs and direction tell nothing: many a motor has the factory's."""
SALIENT, TURNED_MOST_DEG = 0.2, 10.0
"""Saliency from which on the axes of a held rotor's map count: at it 2.2 % by slots turn them by 3 deg. And how far
they may stand from the drive's (deg electrical); with the machine's own set 0.02 deg and less was measured."""
SAME_SHARE = 1e-6
"""Within this of the factory's value (binary32) it is that."""
CORRECTION_STD = 0.2
"""Standard deviation of what the map takes psi_f back to zero current by, of that correction: its curvature there."""
DEVIATION_LIMIT = 0.01
"""Largest rms deviation of all fluxes within the map's current, of their range: a rotor that stood at one angle leaves
0.6 % for its slots, and of 36 maps of saturated machines none had more than 0.9 %."""


def require_set_up(pole_pairs: float, held: Mapping[str, float]) -> None:
    """Refuse the map of a held rotor where the drive's set cannot tell where its magnets stand, or how strong they are.

    Pulses show increments of flux, and their axes up to a quarter of an electrical turn. A factory set gave a map of
    interior-2k2 with L_d +41 %, its axes swapped, and one of saturated-pmsyrm with +691 %.

    Parameters
    ----------
    pole_pairs : float
        What the drive holds.
    held : mapping of str to float
        The same of :data:`SET_UP_BY`.
    """
    unset = [name for name in SET_UP_BY if math.isclose(held[name], BY_NAME[name].default, rel_tol=SAME_SHARE)]
    if not unset:
        return
    told = ", ".join(f"{name} {format_quantity(held[name], BY_NAME[name].unit)}" for name in unset)
    raise refuse(
        "E_NOT_SET_UP",
        f"a held rotor shows neither psi_f nor the d axis, and the drive holds the factory's {told} "
        f"({pole_pairs:.0f} pole pairs)",
        stage=STAGE,
        hint="free the shaft and `commission`, which measures and stores them; or `param set motor.pole_pairs=P "
        "encoder.offset_rad=RAD motor.psi_f_wb=WB --store` (a true 0 as 6.2831853, a true 0.41 as 0.41001). "
        "R and inverter need neither",
    )


def flux_map_of(
    traces: Mapping[str, Trace], result: Evaluation, tolerance: SensorTolerance | None, U_dc_v: float
) -> FluxMapResult | None:
    """Return the flux map of the pulse trains; None without them, or where the rotor turned and no flux is known.

    Raises IdentificationError: as the estimator refuses.
    """
    trains = [traces[f"map_{k}"] for k in range(sum(name.startswith("map_") for name in traces))]
    if not trains or result.resistance is None:
        return None
    facts = trains[0].meta
    held = bool(facts["held"])
    drive_offset = float(facts["offset_rad"])
    pole_pairs = int(facts["signed_pole_pairs"])
    if held:
        require_set_up(abs(pole_pairs), {SET_UP_BY[0]: drive_offset, SET_UP_BY[1]: float(facts["psi_f_wb"])})
    magnet = MagnetFlux(float(facts["psi_f_wb"]), 0.0)
    to_reference = 0.0
    offset = drive_offset
    if result.flux is not None and result.offset is not None:
        measured = result.flux.psi_measured
        i_d = result.flux.low_i_d_a
        magnet = MagnetFlux(result.flux.low_wb, result.flux.low_std_wb, (i_d, -i_d), (0.0, 0.0), (0.5, 0.5))
        to_reference = result.flux.psi_f.value - measured.value
        offset = result.offset.value
    elif not held:
        return None
    found = estimate_flux_map(
        trains,
        result.noise,
        result.resistance,
        Frame(pole_pairs, drive_offset, offset),
        magnet,
        to_reference_wb=to_reference,
        align=held,
        tolerance=tolerance,
        U_dc_v=U_dc_v,
        sampling=None if result.inductance is None else result.inductance.sampling,
    )
    if not held:
        return found
    turned = math.degrees(found.fit.frame.offset_rad - drive_offset)
    L_dd, _, L_qq = found.fit.inductance(np.zeros(1), np.zeros(1))[:, 0]
    if abs(L_dd - L_qq) > SALIENT * min(L_dd, L_qq) and abs(turned) > TURNED_MOST_DEG:
        raise refuse(
            "E_NOT_SET_UP",
            f"the map's axes stand {turned:+.2g} deg (electrical) at the nearest from those by the drive's "
            f"{abs(pole_pairs)} pole pairs and encoder offset of {drive_offset:.4g} rad, limit {TURNED_MOST_DEG:g} deg",
            stage=STAGE,
            likely="pole pairs or an encoder offset of another motor, or an encoder that was moved on its shaft",
        )
    told = (
        f"flux map: psi_f {magnet.psi_wb:.4g} Wb, {abs(pole_pairs)} pole pairs and encoder offset {drive_offset:.4g} "
        "rad are those that the drive holds, not measured: a held rotor shows increments of flux, and its axes to a "
        f"quarter of an electrical turn (the nearest stand {turned:+.2g} deg from the drive's)"
    )
    return replace(found, notes=(told, *found.notes))


def map_estimates(result: Evaluation, flux_map: FluxMapResult, traces: Mapping[str, Trace]) -> dict[str, Estimate]:
    """Return what the map states of the machine, by machine-file key.

    Inductances at the largest torque of the rated current; and psi_f, which the run over speeds measures at d currents
    and extrapolates, at none.
    """
    facts = traces["map_0"].meta
    found = flux_map.at_rated_current(abs(int(facts["signed_pole_pairs"])), float(facts["I_nom_a"]))
    if result.flux is not None:
        psi_f = float(flux_map.flux_map.flux(0.0, 0.0)[0])
        std = math.hypot(result.flux.psi_f.std, CORRECTION_STD * (psi_f - result.flux.psi_f.value))
        method = f"{result.flux.psi_f.method}, at zero current by the flux map"
        found["psi_f_wb"] = replace(result.flux.psi_f, value=psi_f, std=std, method=method)
    return found


def with_map(machine: MachineParameters, estimates: Mapping[str, Estimate]) -> MachineParameters:
    """Return the machine with the name of its map and its apparent inductances."""
    apparent = {name: estimates[name].value for name in ("L_d_app_h", "L_q_app_h") if name in estimates}
    return replace(machine, flux_map=MAP_FILE, **apparent)  # type: ignore[arg-type]


def save_map(run: RunDirectory, result: FluxMapResult | None) -> dict[str, str]:
    """Write the map's files into the run; returns their names as a stage lists them."""
    if result is None:
        return {}
    run.save(MAP_FILE, flux_map_npz(result.flux_map))
    run.save(MAP_CSV, flux_map_csv(result.flux_map))
    run.save(MAP_INTERVALS, npz_bytes(result.arrays()))
    return {MAP_FILE: "", MAP_CSV: "", MAP_INTERVALS: ""}


def map_acceptance(result: FluxMapResult | None) -> list[Acceptance]:
    """Return the criterion of a map: how well its fluxes are known."""
    if result is None:
        return []
    deviation = result.deviation
    return [
        Acceptance(
            "flux map: standard deviation of the fluxes that currents make, of their range",
            f"{100.0 * deviation:.2g} %",
            f"{100.0 * DEVIATION_LIMIT:.2g} %",
            deviation <= DEVIATION_LIMIT,
        )
    ]


def map_summary(result: FluxMapResult | None) -> str:
    """Return what a person reads of the map behind the other values."""
    if result is None:
        return ""
    kind = "symmetric in i_q" if result.fit.symmetric else "not symmetric in i_q"
    return (
        f"; flux map to {result.radius_a:.3g} A, deviation {100 * result.deviation:.2g} % of the flux range, {kind} "
        f"({100 * result.asymmetry:.2g} %), reciprocal to {100 * result.skew:.2g} %, misfit {100 * result.misfit:.2g} %"
    )
