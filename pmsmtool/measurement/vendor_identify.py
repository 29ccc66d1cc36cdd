# SPDX-License-Identifier: MIT
"""Identification by the drive itself (``identify --method vendor``): its own measurements, started and read.

Same guard, same consent, same dead-man as every experiment of ours; the drive chooses currents and speeds by itself.
What it says is kept as it came, with source ``vendor``.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace

from pmsmtool.cia402 import HOMING_LOST
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.guard import guarded
from pmsmtool.drive.vendor_tuning import VendorDrive
from pmsmtool.drive_maps.drive_map_file import map_hash
from pmsmtool.drive_maps.vendor_tuning import RESULTS, VendorAnswer, VendorStep
from pmsmtool.errors import NotAvailable
from pmsmtool.identification.replay import MACHINE
from pmsmtool.identification.request import IdentifyRequest
from pmsmtool.identification.vendor_machine import (
    ANSWERS,
    NO_INTERVAL,
    SOURCE,
    VendorMachine,
    answer_facts,
    coarse_notes,
    vendor_estimates,
    vendor_facts,
    vendor_machine,
)
from pmsmtool.identification.verdicts import KEYS
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file, load_machine_file
from pmsmtool.machine.machine_keys import MEASURABLE
from pmsmtool.machine.parameters import Estimate
from pmsmtool.measurement.capabilities import Capabilities, Method
from pmsmtool.measurement.tier_identify import can_measure, tier_envelope, tier_stage
from pmsmtool.run_directory import Acceptance, RunDirectory, Stage
from pmsmtool.units import format_quantity

BY_ITSELF = "the drive chooses currents and speeds by itself: it keeps its limits 0x6073 and 0x6080, the tool watches"
Known = tuple[MachineFile, str] | None
Allow = Callable[[Sequence[str]], None]
Say = Callable[[str], None]


def vendor_quantities(found: Capabilities) -> tuple[str, ...]:
    """Return the quantities that the drive's own identification gives."""
    return tuple(name for name in dict.fromkeys(RESULTS.values()) if found.row(name, Method.VENDOR).available)


def vendor_line(found: Capabilities) -> list[str]:
    """Return what is told of it before anything moves; nothing where there is none."""
    told = vendor_quantities(found)
    return [f"{', '.join(told)} by the drive's own identification"] if told else []


def identify_vendor(
    drive: VendorDrive, envelope: Envelope, steps: Sequence[VendorStep], say: Say = lambda text: None
) -> list[VendorAnswer]:
    """Have the drive identify by itself, step by step; it is off and restored on return.

    Raises
    ------
    DriveFault, DriveTimeout
        A step fails or does not end.
    StopNotConfirmed, Interrupted, BusError, LimitExceeded
        As the guard ends it.
    """
    answers: list[VendorAnswer] = []
    known = _set_values(drive)
    with guarded(drive, envelope, say=say) as guard:
        for step in steps:
            used = {name: known[name] for name in step.uses if any(name in answer.values for answer in answers)}
            if used:  # into the drive's own objects while it is off; the guard brings back what they held
                guard.disable()
                drive.write(used)
            guard.enable()
            say(f"the drive's own {step.title}: {step.moves}")
            answer = drive.carry_out(step, guard.wait, known)
            answers.append(answer)
            known |= answer.values
    return answers


def _set_values(drive: VendorDrive) -> dict[str, float]:
    """Return what results are counted relative to, as the drive is set, until it tells better."""
    needed = {cell.gain for cell in drive.tuning.results.values() if cell.gain}
    return {name: drive.parameters.read_value(name) for name in needed if name in drive.node.map.cells}


def vendor_stage(
    run: RunDirectory,
    drive: CanopenDrive,
    found: Capabilities,
    request: IdentifyRequest,
    allow_motion: Allow,
    say: Say,
    *,
    known: Known = None,
) -> Stage:
    """Have the drive identify by itself, keep its answers, and complete the machine file where one was given.

    Parameters
    ----------
    request : IdentifyRequest
        Its quantities choose the steps; with a locked shaft those that turn it are left out.
    known : MachineFile and its source, optional
        What completes the values.

    Raises
    ------
    NotAvailable
        A step needs what the request excludes, or nothing of what was asked can be told.
    IdentificationError
        A result is a number that no machine has.
    Declined, DriveFault, DriveTimeout, StopNotConfirmed, Interrupted, BusError, LimitExceeded
        As the drive, the person and the guard end it.
    """
    with _own_drive(drive, found) as own:
        steps = _steps(own, request)
        envelope = tier_envelope(own, request, None if known is None else known[0])
        envelope.refuse_gravity()
        moves = [f"{step.title}: {step.moves}; at most {step.timeout_s:g} s" for step in steps]
        if request.shaft != "locked":
            moves.append(f"the drive moves the rotor: {HOMING_LOST}")
        restored = "nothing is stored in the drive; every changed object is restored"
        allow_motion([*envelope.lines(), *moves, BY_ITSELF, restored])
        clock = own.node.connection.clock
        start = clock.now()
        answers = identify_vendor(own, envelope, steps, say)
        seconds = clock.now() - start
        tuning = own.tuning
    facts = {"map_sha256": map_hash(found.drive_map), "answers": [answer_facts(tuning, a) for a in answers]}
    run.save(ANSWERS, json.dumps(facts, indent=1) + "\n")
    by_name = {name: answer for answer in answers for name in answer.values}
    values = vendor_estimates(tuning, by_name)
    made = vendor_machine(known, values)
    files = {ANSWERS: ""}
    if made.machine is not None:
        run.save(MACHINE, dump_machine_file(made.machine))
        files[MACHINE] = ""
    stage = _judged(answers, values, made, coarse_notes(tuning, by_name), "" if known is None else known[1])
    return replace(stage, seconds=seconds, files=files)


@contextmanager
def _own_drive(drive: CanopenDrive, found: Capabilities) -> Iterator[VendorDrive]:
    """Open the drive once more, as one that identifies by itself."""
    own = VendorDrive(drive.node.connection, drive.node.node, drive_map=found.drive_map)
    try:
        yield own
    finally:
        drive.may_be_energised = drive.may_be_energised or own.may_be_energised
        own.close()


def _steps(own: VendorDrive, request: IdentifyRequest) -> tuple[VendorStep, ...]:
    asked = frozenset(request.quantities)
    steps = own.tuning.steps_for(asked, turning=request.shaft != "locked")
    lacking = sorted(asked - {RESULTS[step.name] for step in steps if step.name in RESULTS})
    if lacking and request.shaft == "locked":
        raise NotAvailable(
            f"{', '.join(lacking)}: the drive's own identification turns the shaft, and it is locked",
            hint="free the shaft, or ask for less",
        )
    if request.brake == "drive" and any(step.turns for step in steps):
        raise NotAvailable(
            "the drive's own identification must turn the shaft, and in its mode the drive may leave its brake closed",
            hint="open the brake otherwise and give --brake open, or reduce the torque",
        )
    return steps


def _judged(
    answers: Sequence[VendorAnswer],
    values: Mapping[str, Estimate],
    made: VendorMachine,
    notes: Sequence[str],
    source: str,
) -> Stage:
    ended = Acceptance("the drive's own steps that ended without an error", str(len(answers)), str(len(answers)), True)
    table = None if made.machine is None else made.machine.machine
    given = [
        {"name": key, "value": getattr(table, key), "unit": MEASURABLE[key].unit, "source": source}
        for key in made.given
    ]
    summary = ", ".join(f"{name} {format_quantity(e.value, e.unit)}" for name, e in values.items())
    return Stage(
        "identify",
        "pass",  # a step that fails ends the run
        0.0,
        values=[*(vendor_facts(name, estimate) for name, estimate in values.items()), *given],
        acceptance=[ended],
        fallbacks=[f"{', '.join(values)}: {NO_INTERVAL}", *notes, *made.notes],
        summary=f"{summary} (the drive's own)" + (f"; {source}: {', '.join(made.given)}" if made.given else ""),
    )


# ---- with the standard tier's pushes ----------------------------------------------------------------


def chain_stage(
    run: RunDirectory,
    drive: CanopenDrive,
    found: Capabilities,
    request: IdentifyRequest,
    allow_motion: Allow,
    say: Say,
    *,
    known: Known = None,
) -> Stage:
    """Have the drive identify by itself, then measure what its tier measures besides; one stage of both.

    Raises
    ------
    PmsmtoolError
        As either ends.
    """
    asked = replace(request, quantities=vendor_quantities(found))
    own = vendor_stage(run, drive, found, asked, allow_motion, say, known=known)
    if not can_measure(drive, found, None if known is None else known[0]):
        return own
    reason = _wrong_set_up(drive, own)
    if reason:
        return replace(own, fallbacks=(*own.fallbacks, reason))
    completed = None if known is None else (load_machine_file(run.path / MACHINE), known[1])
    try:
        rest = tier_stage(run, drive, found, request, allow_motion, say, known=completed)
    except NotAvailable as lacking:
        return replace(own, fallbacks=(*own.fallbacks, *lacking.what.splitlines()))
    return _joined(run, own, rest, known)


def _wrong_set_up(drive: CanopenDrive, own: Stage) -> str:
    """Return why a drive must not be pushed by torque: it commutates by pole pairs that are not the machine's."""
    told = next((round(float(value["value"])) for value in own.values if value["name"] == "pole_pairs"), None)
    if told is None or "motor.pole_pairs" not in drive.node.map.cells:
        return ""
    held = round(drive.parameters.read_value("motor.pole_pairs"))
    if held == told:
        return ""
    return f"torque pulses: not available: the drive is set to {held} pole pairs and measures {told}; set it up first"


def _joined(run: RunDirectory, own: Stage, rest: Stage, known: Known) -> Stage:
    """Join both: a measured value with its interval outranks the drive's own, which is then named beside it."""
    measured = {str(value["name"]): value for value in rest.values if "std" in value and value.get("accepted", True)}
    vendor = {str(value["name"]): value for value in own.values if value["source"] == SOURCE}
    kept = {name: value for name, value in vendor.items() if name not in measured}
    refused = {name: why for name, why in rest.refused.items() if not set(KEYS.get(name, ())) & set(kept)}
    given = [value for value in rest.values if "std" not in value and value["name"] not in vendor]
    beside = [
        f"{name}: the drive's own value is {format_quantity(value['value'], value['unit'])}, "
        f"{100.0 * (value['value'] / measured[name]['value'] - 1.0):+.2g} % of the measured one"
        for name, value in vendor.items()
        if name in measured
    ]
    if known is not None and MACHINE in rest.files:
        _write_sources(run, [str(value["name"]) for value in given], known[1])
    return replace(
        rest,
        status="partial" if refused else "pass",  # the drive's own values are accepted, or it ended there
        refused=refused,
        seconds=own.seconds + rest.seconds,
        values=[*measured.values(), *kept.values(), *given],
        acceptance=[*own.acceptance, *(line for line in rest.acceptance if line.ok)],
        fallbacks=[*own.fallbacks, *beside, *rest.fallbacks],
        files={**own.files, **rest.files},
        summary="; ".join([own.summary.split("; ")[0], *rest.summary.split("; ")[:1], *_given_text(given, known)]),
    )


def _given_text(given: Sequence[Mapping[str, object]], known: Known) -> list[str]:
    return [f"{known[1]}: {', '.join(str(value['name']) for value in given)}"] if given and known is not None else []


def _write_sources(run: RunDirectory, given: Sequence[str], source: str) -> None:
    """Say in the machine file where each value comes from."""
    path = run.path / MACHINE
    machine = load_machine_file(path)
    by = {"measured": "pmsmtool", SOURCE: SOURCE}
    parts = {who: [name for name, e in machine.estimates.items() if e.source == said] for who, said in by.items()}
    text = "; ".join(f"{who}: {', '.join(names)}" for who, names in (*parts.items(), (source, given)) if names)
    run.save(MACHINE, dump_machine_file(replace(machine, provenance={"source": text})))
