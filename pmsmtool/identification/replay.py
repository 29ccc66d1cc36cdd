# SPDX-License-Identifier: MIT
"""From a run's stored traces to its machine file and the judged stage; years later, the same bytes again."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

from pmsmtool.errors import ConfigError
from pmsmtool.estimators.estimate import SensorTolerance
from pmsmtool.estimators.resistance import copper_of
from pmsmtool.files import read_text
from pmsmtool.identification import flux_map, frequency_response, value_verdict
from pmsmtool.identification.accuracy import accuracy_facts, accuracy_line
from pmsmtool.identification.calibration import calibrated_tolerance
from pmsmtool.identification.cogging import save_cogging
from pmsmtool.identification.evaluate import Evaluation, evaluate
from pmsmtool.identification.identified_machine import machine_of
from pmsmtool.identification.request import (
    REQUEST,
    IdentifyRequest,
    dump_request,
    parse_request,
)
from pmsmtool.identification.run_files import PREDICTED, REFUSED, refused_in
from pmsmtool.identification.sampling import timing_estimates, with_timing
from pmsmtool.identification.verdicts import verdicts_of
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file, load_machine_file
from pmsmtool.machine.temperature import magnet_tolerance_per_k
from pmsmtool.run_directory import RunDirectory, Stage
from pmsmtool.trace import Trace
from pmsmtool.trace_file import read_trace

MACHINE = "machine.toml"
NAMEPLATE = "nameplate.toml"
REPLAYED = "replayed"
"""Folder of a run for what a replay makes of it once a design stands on its machine file."""
_MADE_FROM_MACHINE = ("design.toml", "params.toml")


def evaluated_stage(run: RunDirectory, nameplate: MachineFile, request: IdentifyRequest) -> Stage:
    """Estimate from the stored traces, write ``machine.toml``, and judge every value.

    Where a design or a parameter set was already made from the machine file, another one does not take its place: it
    goes into the folder ``replayed``, with the map and the response that belong to it.

    Raises
    ------
    IdentificationError
        A trap was seen; no machine file is written.
    """
    evaluation = evaluation_of(run, nameplate, request)
    timing = timing_estimates(evaluation.inductance, evaluation.shown, request.tolerance)
    conditions = value_verdict.conditions_of(evaluation, request)
    found = evaluation.estimates()
    designed = machine_of(evaluation, nameplate, conditions)
    acceptance = value_verdict.acceptance_of(evaluation, found, designed, request.quantities)
    had = value_verdict.had_of(evaluation)
    verdicts = verdicts_of(request.quantities, evaluation.refused, had, acceptance)
    if not verdicts.accepted:
        evaluation.whole()
    rejected = {key for key, line in acceptance.items() if not line.ok}
    kept = evaluation if "flux map" not in rejected else replace(evaluation, flux_map=None, map_estimates={})
    machine = machine_of(kept, nameplate, conditions, rejected)
    machine = with_timing(machine, timing)
    text = dump_machine_file(machine)
    files = {}
    if verdicts.accepted:
        target, prefix = place_of(run, text)
        made = flux_map.save_map(target, kept.flux_map)
        made |= frequency_response.save_response(target, kept.frequency_response)
        if kept.encoder is not None:
            made |= save_cogging(target, kept.cogging, kept.encoder.direction)
        target.save(MACHINE, text)
        files = {f"{prefix}{name}": "" for name in (MACHINE, *made)}
    files |= {name: "" for name in (PREDICTED, REFUSED) if (run.path / name).is_file()}
    fallen = [f"{name}: {estimate.fallback}" for name, estimate in found.items() if estimate.fallback]
    accuracy = accuracy_facts(request.accuracy, request.quantities, found)
    missed = not all(fact["reached"] for fact in accuracy.values())
    facts = [
        {
            **value_verdict.value_facts(name, estimate),
            "accepted": name not in rejected,
            **({"accuracy": accuracy[name]} if name in accuracy else {}),
        }
        for name, estimate in (found | timing | kept.ripples()).items()
    ]
    summary = value_verdict.summary_of(kept, {name: e for name, e in found.items() if name not in rejected})
    return Stage(
        "identify",
        "partial" if missed and verdicts.status == "pass" else verdicts.status,
        0.0,
        values=[*facts, *map(value_verdict.check_facts, evaluation.checks)],
        # what is refused is no criterion of the values that go on
        acceptance=[line for line in acceptance.values() if line.ok or verdicts.status == "fail"],
        fallbacks=[*verdicts.lines(), *fallen],
        files={**files, NAMEPLATE: "", REQUEST: "", **{f"traces/{path.name}": "" for path in _trace_files(run)}},
        note="; ".join(
            [*([accuracy_line(accuracy)] if missed else []), *value_verdict.warnings_of(evaluation, request)]
        ),
        summary="; ".join(filter(None, (summary, *(f"{name} refused" for name in verdicts.refused)))),
        refused=dict(verdicts.refused),
    )


@dataclass(frozen=True, slots=True)
class _Question:
    """What is evaluated; equal where the files and what was asked are."""

    run: RunDirectory = field(compare=False)
    nameplate: MachineFile = field(compare=False)
    request: IdentifyRequest = field(compare=False)
    asked: tuple[str, ...]
    files: tuple[tuple[str, int, int], ...]


def evaluation_of(run: RunDirectory, nameplate: MachineFile, request: IdentifyRequest) -> Evaluation:
    """Return what the stored traces say; the last one is kept, as a report is drawn from it right after.

    Raises
    ------
    IdentificationError
        No value can be trusted.
    """
    files = [*_trace_files(run), *(path for path in [run.path / REFUSED] if path.is_file())]
    states = tuple((str(path.resolve()), path.stat().st_size, path.stat().st_mtime_ns) for path in files)
    asked = dump_machine_file(nameplate), dump_request(request)
    return _evaluation(_Question(run, nameplate, request, asked, states))


@lru_cache(maxsize=1)
def _evaluation(question: _Question) -> Evaluation:
    run, nameplate, request = question.run, question.nameplate, question.request
    return evaluate(
        stored_traces(run),
        nameplate.inverter.T_s,
        copper=copper_of(nameplate),
        alpha_psi_per_k=nameplate.machine.alpha_psi_per_k,
        U_dc_v=nameplate.inverter.U_dc_v,
        tolerance=replace(request.tolerance, magnet_per_k=magnet_tolerance_per_k(nameplate.machine)),
        ended=refused_in(run),
    )


def place_of(run: RunDirectory, text: str) -> tuple[RunDirectory, str]:
    """Return where a machine file goes, and the beginning of its name in the run: beside one a design was made from."""
    return (run, "") if _may_write(run, text) else (_beside(run), f"{REPLAYED}/")


def _may_write(run: RunDirectory, text: str) -> bool:
    """Whether a machine file may stand in the run: nothing was made from it yet, or it is the one that was used."""
    if not any((run.path / name).is_file() for name in _MADE_FROM_MACHINE):
        return True
    recorded = run.read().stage("identify")
    used = run.sha256(MACHINE) if (run.path / MACHINE).is_file() else recorded and recorded.files.get(MACHINE)
    return hashlib.sha256(text.encode()).hexdigest() == used


def _beside(run: RunDirectory) -> RunDirectory:
    folder = run.path / REPLAYED
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise ConfigError(
            f"cannot be made: {error.strerror or error}",
            where=str(folder),
            hint="check your rights there and the space on the disk",
        ) from error
    return RunDirectory(folder)


def replay(run: RunDirectory, tolerance: SensorTolerance | None = None, calibration: Sequence[str] = ()) -> Stage:
    """Recompute every estimate of a run from its traces.

    Parameters
    ----------
    run : RunDirectory
        Of ``identify`` or ``commission``. When the machine file becomes another one, the stage is recorded anew; a run
        with a design keeps its own and its record, and the other one goes beside it (:data:`REPLAYED`).
    tolerance : SensorTolerance, optional
        Replaces the sensor tolerances that the run was made with.
    calibration : sequence of str
        Scales against an instrument (``identification/calibration.py``).

    Raises
    ------
    ConfigError
        The run has no nameplate, no record of what was asked, or no traces.
    IdentificationError
        A trap is seen in the traces.
    """
    request = asked_again(run, (NAMEPLATE, REQUEST), tolerance, calibration)
    recorded = run.read().stage("identify")
    stage = evaluated_stage(run, load_machine_file(run.path / NAMEPLATE), request)
    if recorded is not None and MACHINE in stage.files and recorded.files.get(MACHINE) != run.sha256(MACHINE):
        run.save(REQUEST, dump_request(request))
        run.add(replace(stage, seconds=recorded.seconds))
    return stage


def asked_again(
    run: RunDirectory, needed: Sequence[str], tolerance: SensorTolerance | None, calibration: Sequence[str]
) -> IdentifyRequest:
    """Return what a run was asked, with the tolerances of its replay; refuse a run without the files this needs."""
    for name in needed:
        if not (run.path / name).is_file():
            raise ConfigError(f"the run has no {name}", where=str(run.path), hint="it is not a run of identify")
    request = parse_request(read_text(run.path / REQUEST), where=str(run.path / REQUEST))
    if tolerance is not None:
        request = replace(request, tolerance=tolerance)
    return replace(request, tolerance=calibrated_tolerance(request.tolerance, calibration))


def stored_traces(run: RunDirectory) -> dict[str, Trace]:
    """Return the traces of a run by name."""
    return {path.stem: read_trace(path) for path in _trace_files(run)}


def _trace_files(run: RunDirectory) -> list[Path]:
    return sorted((run.path / "traces").glob("*.npz"))
