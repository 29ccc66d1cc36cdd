# SPDX-License-Identifier: MIT
"""The stored traces of a run evaluated again, by the functions that evaluated them live: the same bytes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace

from pmsmtool.errors import ConfigError
from pmsmtool.estimators.estimate import SensorTolerance
from pmsmtool.files import read_text
from pmsmtool.identification import by_injection, by_pulses
from pmsmtool.identification.by_vendor import ANSWERS
from pmsmtool.identification.calibration import calibrated_tolerance
from pmsmtool.identification.request import MACHINE, NAMEPLATE, REQUEST, dump_request, parse_request
from pmsmtool.identification.value_verdict import with_left_out
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.run_directory import RunDirectory, Stage


def replay(run: RunDirectory, tolerance: SensorTolerance | None = None, calibration: Sequence[str] = ()) -> Stage:
    """Recompute every estimate of a run from its traces, whatever its capability level.

    Raises ConfigError: the run has no traces, or a file that the estimates depend on is gone or damaged;
    IdentificationError: a trap is seen in the traces.

    Parameters
    ----------
    run : RunDirectory
        Of ``identify`` or ``commission``. When its values become others, the stage is recorded anew; a run with a
        design keeps its machine file and its record, and the other one goes beside it (``run_files.REPLAYED``).
    tolerance : SensorTolerance, optional
        Replaces the sensor tolerances that the run was made with.
    calibration : sequence of str
        Scales against an instrument (``identification/calibration.py``).
    """
    if (run.path / ANSWERS).is_file():
        raise ConfigError(
            "the run holds what the drive identified by itself: nothing of that can be recomputed",
            where=str(run.path),
            hint="`pmsmtool identify --method vendor` has the drive measure again",
        )
    pulses = by_pulses.read_facts(run)
    named = pulses is None or bool(pulses.source)
    for name in (NAMEPLATE, REQUEST) if named else (REQUEST,):
        if not (run.path / name).is_file():
            raise ConfigError(f"the run has no {name}", where=str(run.path), hint="it is not a run of identify")
    request = parse_request(read_text(run.path / REQUEST), where=str(run.path / REQUEST))
    if tolerance is not None:
        request = replace(request, tolerance=tolerance)
    request = replace(request, tolerance=calibrated_tolerance(request.tolerance, calibration))
    known = load_machine_file(run.path / NAMEPLATE) if named else None
    recorded = run.read().stage("identify")
    if pulses is not None:
        stage = by_pulses.evaluated_stage(run, pulses, request, known)
    else:
        assert known is not None
        stage = by_injection.evaluated_stage(run, known, request)
    stage = with_left_out(stage, request)
    if recorded is not None and _are_others(run, recorded, stage):
        run.save(REQUEST, dump_request(request))
        run.add(replace(stage, seconds=recorded.seconds))
    return stage


def _are_others(run: RunDirectory, recorded: Stage, stage: Stage) -> bool:
    """Whether the values of the run itself, not those beside a design, are others than the recorded ones."""
    if MACHINE in stage.files:
        return recorded.files.get(MACHINE) != run.sha256(MACHINE) or _values(recorded) != _values(stage)
    beside = any(name.endswith(MACHINE) for name in stage.files)
    return not beside and _values(recorded) != _values(stage)


def _values(stage: Stage) -> str:
    return json.dumps(list(stage.values))
