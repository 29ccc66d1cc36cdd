# SPDX-License-Identifier: MIT
"""The machine file where a part is measured: that part, and the rest as it was given, by source.

Nothing is made up: a value that was neither measured nor given is named as lacking, and there is no machine file.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from pmsmtool.estimators.estimate import total_half_width
from pmsmtool.estimators.resistance import R_MEASURED
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.machine_keys import MEASURABLE
from pmsmtool.machine.parameters import Estimate
from pmsmtool.machine.temperature import magnet_flux_at

NEEDED = ("pole_pairs", "R_s_ohm", "L_d_h", "L_q_h", "psi_f_wb")
"""Keys of a machine that a design stands on."""
ALSO = ("J_kgm2", "tau_c_nm")
"""Keys it uses where they are known."""
UNKNOWN_TEMPERATURE_K = 20.0
"""A magnet whose temperature nothing tells is taken within this of the reference temperature (95 %)."""
PER_PSI = {"J_per_psi": "J_kgm2", "tau_c_per_psi": "tau_c_nm"}
"""Ratios to the flux linkage, and what they are with it."""


@dataclass(frozen=True, slots=True)
class CompletedMachine:
    """What is known of a machine after an identification without injection."""

    machine: MachineFile | None
    """None when values are lacking."""
    given: tuple[str, ...]
    """Keys whose values were not measured."""
    notes: tuple[str, ...] = ()
    """What was done to the values."""

    def given_values(self, source: str) -> list[Mapping[str, Any]]:
        """Return what was given as a stage records it: with its source, without an interval of ours."""
        if self.machine is None:
            return []
        table = self.machine.machine
        return [
            {"name": name, "value": getattr(table, name), "unit": MEASURABLE[name].unit, "source": source}
            for name in self.given
        ]


def completed_machine(
    known: MachineFile | None, found: Mapping[str, Estimate], source: str, flux_doubt: float = 0.0
) -> CompletedMachine:
    """Put measured values into a machine that is known otherwise.

    Parameters
    ----------
    known : MachineFile, optional
        Data sheet, or what the maker's set-up left in the drive.
    found : mapping of str to Estimate
        Measured: keys of a machine file, ``direction``, ``frame_offset_rad`` and the ratios of :data:`PER_PSI`.
    source : str
        Where ``known`` comes from.
    flux_doubt : float
        Share (95 %) by which the flux linkage as given may be wrong, where J and tau_c are to stand without it. 0: what
        is designed takes the same flux linkage, so that their ratio to it is what counts.
    """
    if known is None:
        return CompletedMachine(None, ())
    values, notes = _at_reference(known, found)
    psi = _flux_of_the_run(known, values.get("psi_f_wb"))
    for ratio, key in PER_PSI.items():
        if ratio in found:
            measured_psi = values.get("psi_f_wb")
            doubt = psi * flux_doubt if measured_psi is None else total_half_width(measured_psi)
            values[key] = _times(found[ratio], psi, doubt, MEASURABLE[key].unit)
    fields = {name for name in values if hasattr(known.machine, name)}
    table = {name: values[name].value for name in fields}
    if "pole_pairs" in table:
        table["pole_pairs"] = round(table["pole_pairs"])
    encoder, more = _encoder(known, found)
    given = tuple(name for name in (*NEEDED, *ALSO) if name not in fields and getattr(known.machine, name) is not None)
    measured = tuple(name for name in MEASURABLE if name in values)
    kept = {name: values[name] for name in measured}
    at_test = {name: found[name] for name in (R_MEASURED,) if name in found and "R_s_ohm" in found}
    machine = replace(
        known,
        machine=replace(known.machine, **table),  # type: ignore[arg-type]
        encoder=encoder,
        std={**known.std, **{name: e.std for name, e in kept.items()}},
        systematic={**known.systematic, **{name: e.systematic for name, e in kept.items()}},
        estimates={**known.estimates, **kept, **at_test},
        provenance={"source": f"measured: {', '.join(measured) or 'nothing'}; {source}: {', '.join(given)}"},
        simulation={},
    )
    return CompletedMachine(machine, given, (*notes, *more))


def _at_reference(known: MachineFile, found: Mapping[str, Estimate]) -> tuple[dict[str, Estimate], tuple[str, ...]]:
    """Return the measured values; the flux linkage of an unknown temperature with the doubt that leaves.

    The resistance has that already, and where temperatures are known both are at the reference (``by_pulses``).
    """
    values = {name: estimate for name, estimate in found.items() if name in MEASURABLE}
    notes = []
    for name, alpha in (("psi_f_wb", known.machine.alpha_psi_per_k),):
        if name in values and not math.isfinite(values[name].T_c):
            estimate = values[name]
            doubt = abs(alpha) * UNKNOWN_TEMPERATURE_K * estimate.value
            values[name] = replace(estimate, systematic=math.hypot(estimate.systematic, doubt))
            notes.append(
                f"{name}: no sensor shows its temperature; {known.machine.T_ref_c:g} +-{UNKNOWN_TEMPERATURE_K:g} degC "
                "is assumed"
            )
    return values, tuple(notes)


def _flux_of_the_run(known: MachineFile, measured: Estimate | None) -> float:
    """Return the flux linkage at the temperature the ratios to it were measured at (Wb), as far as that is known."""
    if measured is None:
        return known.machine.psi_f_wb
    if not math.isfinite(measured.T_c):
        return measured.value
    return magnet_flux_at(replace(known.machine, psi_f_wb=measured.value), measured.T_c)


def _times(ratio: Estimate, psi: float, doubt: float, unit: str) -> Estimate:
    return replace(
        ratio, value=ratio.value * psi, std=ratio.std * psi, unit=unit,
        systematic=math.hypot(ratio.systematic * psi, ratio.value * doubt),
        method=f"{ratio.method}, times the flux linkage",
    )  # fmt: skip


def _encoder(known: MachineFile, found: Mapping[str, Estimate]) -> tuple[Any, tuple[str, ...]]:
    """Return the encoder: as measured, or corrected where the drive's frame is seen to be off."""
    if "offset_rad" in found:
        direction = round(found["direction"].value) if "direction" in found else known.encoder.direction
        return replace(known.encoder, offset_rad=found["offset_rad"].value, direction=direction), ()
    frame = found.get("frame_offset_rad")
    if frame is not None and abs(frame.value) > total_half_width(frame):
        offset = math.remainder(known.encoder.offset_rad + frame.value, 2.0 * math.pi)
        text = f"encoder offset corrected: the frame is {math.degrees(frame.value):.2g} deg ahead of the d axis"
        return replace(known.encoder, offset_rad=offset), (text,)
    return known.encoder, ()
