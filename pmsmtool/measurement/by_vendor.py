# SPDX-License-Identifier: MIT
"""Identification by the drive itself (``identify --method vendor``): its own measurements, started and read.

Same guard, same consent, same dead-man as every experiment of ours; the drive chooses currents and speeds by itself.
What it says is kept as it came, with source ``vendor``.
"""

from __future__ import annotations

import json
from collections.abc import Sequence

from pmsmtool.cia402 import HOMING_LOST
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.guard import guarded
from pmsmtool.drive.vendor_tuning import VendorDrive
from pmsmtool.drive_maps.drive_map_file import map_hash
from pmsmtool.drive_maps.vendor_tuning import RESULTS, VendorAnswer, VendorStep
from pmsmtool.errors import NotAvailable
from pmsmtool.identification.by_vendor import ANSWERS, answer_facts, evaluated_stage
from pmsmtool.identification.request import IdentifyRequest, Method
from pmsmtool.measurement.by_pulses import envelope_of
from pmsmtool.measurement.capabilities import Capabilities
from pmsmtool.measurement.limits import Keep, Say, Task
from pmsmtool.run_directory import Stage

BY_ITSELF = "the drive chooses currents and speeds by itself: it keeps its limits 0x6073 and 0x6080, the tool watches"


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

    Raises DriveFault, DriveTimeout: a step fails or does not end; StopNotConfirmed, Interrupted, BusError,
    LimitExceeded: as the guard ends it.
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
    held = {name: drive.parameters.held_value(name) for name in needed}
    return {name: value for name, value in held.items() if value is not None}


def plan(task: Task) -> tuple[Envelope, list[str]]:
    """Return envelope and plan; refuses what the request excludes."""
    own = _own(task)
    steps = _steps(own, task.request)
    envelope = envelope_of(own, task.request, task.machine)
    envelope.refuse_gravity()
    moves = [f"{step.title}: {step.moves}; at most {step.timeout_s:g} s" for step in steps]
    if task.request.shaft != "locked":
        moves.append(f"the drive moves the rotor: {HOMING_LOST}")
    return envelope, [*moves, BY_ITSELF]


def measure(task: Task, envelope: Envelope, keep: Keep, say: Say) -> list[VendorAnswer]:
    """Have the drive identify by itself; its answers go into the run, byte by byte."""
    own = _own(task)
    answers = identify_vendor(own, envelope, _steps(own, task.request), say)
    facts = {"map_sha256": map_hash(task.found.drive_map), "answers": [answer_facts(own.tuning, a) for a in answers]}
    task.run.save(ANSWERS, json.dumps(facts, indent=1) + "\n")
    return answers


def evaluate(task: Task, answers: Sequence[VendorAnswer]) -> Stage:
    """Take over what the drive answered; its request chose the steps, with a locked shaft those that do not turn it."""
    return evaluated_stage(task.run, _own(task).tuning, answers, task.known)


def _own(task: Task) -> VendorDrive:
    assert isinstance(task.drive, VendorDrive)
    return task.drive


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
