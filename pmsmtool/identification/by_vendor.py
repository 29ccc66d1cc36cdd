# SPDX-License-Identifier: MIT
"""What a drive's own identification says of the machine, as it came: its source is ``vendor``, and it has no interval.

Its maker states none, and one of ours would be a guess. What stands on such a value says so: ``margins`` names the
deviation that it assumes instead.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from pmsmtool.drive_maps.drive_map import Cell
from pmsmtool.drive_maps.vendor_tuning import OS_COMMAND, VendorAnswer, VendorTuning
from pmsmtool.identification.completed_machine import ALSO, NEEDED, CompletedMachine
from pmsmtool.identification.request import MACHINE
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file
from pmsmtool.machine.machine_keys import MEASURABLE
from pmsmtool.machine.parameters import Estimate
from pmsmtool.refusals import refuse
from pmsmtool.run_directory import Acceptance, RunDirectory, Stage
from pmsmtool.units import format_quantity

SOURCE = "vendor"
PHASE_INDUCTANCE = "L_phase_h"
"""One inductance for both axes: neither L_d nor L_q, but somewhere between or at one of them."""
ANSWERS = "vendor_tuning.json"
"""What the drive answered, byte by byte."""
NO_INTERVAL = "the drive's own, without an interval: its maker states none"
COARSE = 0.005
"""Half a count, of a value, from which the rounding is told."""


def vendor_estimates(tuning: VendorTuning, answers: Mapping[str, VendorAnswer]) -> dict[str, Estimate]:
    """Return the results by the keys of a machine file; a lone inductance is :data:`PHASE_INDUCTANCE`.

    Raises IdentificationError: a result is a number that no machine has.

    Parameters
    ----------
    answers : mapping of str to VendorAnswer
        By catalogue name of the result.
    """
    both = {"motor.L_d_h", "motor.L_q_h"} <= set(tuning.results)
    found = {}
    for name, answer in answers.items():
        key = name.removeprefix("motor.")
        bounds = MEASURABLE[key]
        if key in ("L_d_h", "L_q_h") and not both:
            key = PHASE_INDUCTANCE
        value = answer.values[name]
        if not max(bounds.minimum, 1e-12) <= value <= bounds.maximum:
            raise refuse(
                "E_VENDOR_VALUE",
                f"{key} = {format_quantity(value, bounds.unit)}",
                stage=f"the drive's own {answer.step}",
            )
        method = f"OS command {tuning.steps[answer.step].command}"
        found[key] = Estimate(value, math.nan, 0.0, bounds.unit, method=f"the drive's own: {method}", source=SOURCE)
    return found


def vendor_facts(name: str, estimate: Estimate) -> dict[str, Any]:
    """Return a value as a stage records it: with its source, without an interval."""
    keys = ("value", "unit", "method", "source")
    return {"name": name, **{key: getattr(estimate, key) for key in keys}}


def vendor_machine(known: tuple[MachineFile, str] | None, found: Mapping[str, Estimate]) -> CompletedMachine:
    """Put the drive's own values into a machine that is known otherwise."""
    if known is None:
        return CompletedMachine(None, (), ("no machine file is written: it needs ratings and the inverter, too",))
    given_file, source = known
    table = {key: e for key, e in found.items() if key != PHASE_INDUCTANCE}
    notes = []
    phase = found.get(PHASE_INDUCTANCE)
    if phase is not None:
        told = format_quantity(phase.value, "H")
        if given_file.machine.L_d_h == given_file.machine.L_q_h:
            table |= {"L_d_h": phase, "L_q_h": phase}
            notes.append(f"L_d = L_q = {told}: the machine is given without saliency")
        else:
            notes.append(f"L_d_h, L_q_h stay as given: the drive measures one inductance ({told}) for both axes")
    if "R_s_ohm" in table:
        notes.append(f"R_s_ohm: at an unknown temperature, taken as of {given_file.machine.T_ref_c:g} degC; with cable")
    numbers: dict[str, float | None] = {key: e.value for key, e in table.items()}
    if "pole_pairs" in numbers:
        numbers["pole_pairs"] = round(table["pole_pairs"].value)
    if {"L_d_h", "L_q_h"} & set(numbers):
        numbers |= {"L_d_app_h": None, "L_q_app_h": None}  # the given ones belong to the given inductances
    given = tuple(k for k in (*NEEDED, *ALSO) if k not in table and getattr(given_file.machine, k) is not None)
    machine = replace(
        given_file,
        machine=replace(given_file.machine, **numbers),  # type: ignore[arg-type]
        std={key: value for key, value in given_file.std.items() if key not in table},
        systematic={key: value for key, value in given_file.systematic.items() if key not in table},
        estimates={**given_file.estimates, **table},
        provenance={"source": f"{SOURCE}: {', '.join(table) or 'nothing'}; {source}: {', '.join(given)}"},
        simulation={},
    )
    return CompletedMachine(machine, given, tuple(notes))


def coarse_notes(tuning: VendorTuning, answers: Mapping[str, VendorAnswer]) -> list[str]:
    """Return which results are counted so coarsely that their rounding alone matters."""
    lines = []
    for name, answer in answers.items():
        share = 0.5 / max(abs(_counts(tuning.results[name], answer)), 0.5)
        if name != "motor.pole_pairs" and tuning.results[name].wire != "REAL32" and share > COARSE:
            unit = tuning.results[name].unit
            lines.append(f"{name.removeprefix('motor.')}: counted in {unit}, which alone makes +-{100.0 * share:.2g} %")
    return lines


def _counts(cell: Cell, answer: VendorAnswer) -> float:
    return cell.counts(answer.values[cell.name], answer.relative_to)


def answer_facts(tuning: VendorTuning, answer: VendorAnswer) -> dict[str, Any]:
    """Return an answer as the run keeps it: the bytes as they came."""
    return {
        "step": answer.step,
        "seconds": round(answer.seconds, 3),
        "bytes": answer.data.hex(" "),
        "object": f"0x{OS_COMMAND:04X}",
        "command": tuning.steps[answer.step].command,
        "values": answer.values,
    }


def evaluated_stage(
    run: RunDirectory, tuning: VendorTuning, answers: Sequence[VendorAnswer], known: tuple[MachineFile, str] | None
) -> Stage:
    """Take over what the drive answered; the machine file is written where one was given to complete.

    Raises IdentificationError: a result is a number that no machine has.
    """
    by_name = {name: answer for answer in answers for name in answer.values}
    values = vendor_estimates(tuning, by_name)
    made = vendor_machine(known, values)
    files = {ANSWERS: ""}
    if made.machine is not None:
        run.save(MACHINE, dump_machine_file(made.machine))
        files[MACHINE] = ""
    source = "" if known is None else known[1]
    ended = Acceptance("the drive's own steps that ended without an error", str(len(answers)), str(len(answers)), True)
    summary = ", ".join(f"{name} {format_quantity(e.value, e.unit)}" for name, e in values.items())
    return Stage(
        "identify",
        "pass",  # a step that fails ends the run
        0.0,
        values=[*(vendor_facts(name, estimate) for name, estimate in values.items()), *made.given_values(source)],
        acceptance=[ended],
        fallbacks=[f"{', '.join(values)}: {NO_INTERVAL}", *coarse_notes(tuning, by_name), *made.notes],
        files=files,
        summary=f"{summary} (the drive's own)" + (f"; {source}: {', '.join(made.given)}" if made.given else ""),
    )
