# SPDX-License-Identifier: MIT
"""The machine file that an identification leaves: accepted values in place of the nameplate's."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

from pmsmtool.identification.evaluate import Evaluation
from pmsmtool.identification.flux_map import with_map
from pmsmtool.machine.machine_file import MachineFile

RESONANCE = ("resonance_hz", "antiresonance_hz", "resonance_zeta")
"""Keys of a second mass: a response without one takes them out of the machine file."""


def machine_of(
    evaluation: Evaluation,
    nameplate: MachineFile,
    conditions: Mapping[str, object],
    rejected: Collection[str] = (),
) -> MachineFile:
    """Return the machine file with every identified value in place of the nameplate's.

    What was not identified, and what is ``rejected`` by its key, keeps the nameplate's value; ``[estimate]`` names
    what was.
    """
    found = {name: estimate for name, estimate in evaluation.estimates().items() if name not in rejected}
    values = {name: found[name].value for name in ("R_s_ohm", "L_d_h", "L_q_h", "psi_f_wb", "J_kgm2") if name in found}
    machine = replace(nameplate.machine, **values)  # type: ignore[arg-type]
    if evaluation.mechanics is not None:
        B, tau_c = evaluation.mechanics.B, evaluation.mechanics.tau_c
        machine = replace(machine, tau_c_nm=max(0.0, tau_c.value), B_nms=max(0.0, B.value))
    if evaluation.frequency_response is not None:
        resonant = {name: estimate.value for name, estimate in evaluation.frequency_response.found.items()}
        machine = replace(machine, **{**dict.fromkeys(RESONANCE), **resonant})  # type: ignore[arg-type]
    if machine.R_winding_ohm is not None and machine.R_winding_ohm > machine.R_s_ohm:
        machine = replace(machine, R_winding_ohm=machine.R_s_ohm)  # a copper part is no more than what was measured
    flux_map = nameplate.flux_map
    if evaluation.flux_map is not None:
        machine, flux_map = with_map(machine, evaluation.map_estimates), evaluation.flux_map.flux_map
    inverter, encoder = nameplate.inverter, nameplate.encoder
    if evaluation.encoder is not None:
        machine = replace(machine, pole_pairs=round(evaluation.encoder.pole_pairs.value))
        encoder = replace(encoder, direction=evaluation.encoder.direction)
    if "offset_rad" in found:
        encoder = replace(encoder, offset_rad=found["offset_rad"].value)
    if evaluation.resistance is not None:
        curve = evaluation.resistance.curve
        plateau = max(0.0, evaluation.resistance.V_dead_v)
        inverter = replace(
            inverter,
            V_dead_v=plateau,
            i_knee_apk=curve.knee_a(plateau),
            voltage_error_i_apk=tuple(map(float, curve.i_phase_a)),
            voltage_error_v=tuple(map(float, curve.u_error_v)),
        )
    measurable = {name: estimate for name, estimate in found.items() if name != "pole_pairs"}
    return replace(
        nameplate,
        machine=machine,
        inverter=inverter,
        encoder=encoder,
        std={**nameplate.std, **{name: e.std for name, e in measurable.items()}},
        systematic={**nameplate.systematic, **{name: e.systematic for name, e in measurable.items()}},
        estimates={
            **nameplate.estimates,
            **found,
            **evaluation.ripples(),
            **{check.name: check.estimate for check in evaluation.checks},
        },
        conditions=dict(conditions),
        simulation={},
        flux_map=flux_map,
    )
