# SPDX-License-Identifier: MIT
"""From the stored traces of an identification by injection to its machine file and the judged stage."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache

from pmsmtool.estimators.resistance import copper_of
from pmsmtool.identification import flux_map, frequency_response, value_verdict
from pmsmtool.identification.accuracy import accuracy_facts, accuracy_line
from pmsmtool.identification.cogging import save_cogging
from pmsmtool.identification.evaluate import Evaluation, evaluate
from pmsmtool.identification.identified_machine import machine_of
from pmsmtool.identification.request import REQUEST, IdentifyRequest, dump_request
from pmsmtool.identification.run_files import (
    MACHINE,
    NAMEPLATE,
    PREDICTED,
    REFUSED,
    place_of,
    refused_in,
    stored_traces,
    trace_files,
)
from pmsmtool.identification.sampling import timing_estimates, with_timing
from pmsmtool.identification.verdicts import verdicts_of
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file
from pmsmtool.machine.temperature import magnet_tolerance_per_k
from pmsmtool.run_directory import RunDirectory, Stage


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
        files={**files, NAMEPLATE: "", REQUEST: "", **{f"traces/{path.name}": "" for path in trace_files(run)}},
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
    files = [*trace_files(run), *(path for path in [run.path / REFUSED] if path.is_file())]
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
