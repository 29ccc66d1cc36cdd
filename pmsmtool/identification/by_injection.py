# SPDX-License-Identifier: MIT
"""From the stored traces of an identification by injection to its machine file and the judged stage.

The machine file that an identification leaves: accepted values in place of the nameplate's.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache

from pmsmtool.estimators.resistance import copper_of
from pmsmtool.identification import flux_map, frequency_response, value_verdict
from pmsmtool.identification.cogging import save_cogging
from pmsmtool.identification.evaluate import Evaluation, evaluate
from pmsmtool.identification.flux_map import with_map
from pmsmtool.identification.request import (
    COUNTS,
    MACHINE,
    NAMEPLATE,
    PREDICTED,
    REFUSED,
    REQUEST,
    IdentifyRequest,
    accuracy_facts,
    accuracy_line,
    dump_request,
    left_out_of,
    place_of,
    refused_in,
    stored_traces,
    trace_files,
)
from pmsmtool.identification.sampling import timing_estimates, with_timing
from pmsmtool.identification.verdicts import ENDED, verdicts_of
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file
from pmsmtool.machine.temperature import magnet_tolerance_per_k
from pmsmtool.run_directory import RunDirectory, Stage


def evaluated_stage(run: RunDirectory, nameplate: MachineFile, request: IdentifyRequest) -> Stage:
    """Estimate from the stored traces, write ``machine.toml``, and judge every value.

    Where a design or a parameter set was already made from the machine file, another one does not take its place: it
    goes into the folder ``replayed``, with the map and the response that belong to it.

    Raises IdentificationError: a trap was seen; no machine file is written.
    """
    evaluation = evaluation_of(run, nameplate, request)
    timing = timing_estimates(evaluation.inductance, evaluation.shown, request.tolerance)
    conditions = value_verdict.conditions_of(evaluation, request)
    found = evaluation.estimates()
    designed = machine_of(evaluation, nameplate, conditions)
    acceptance = value_verdict.acceptance_of(evaluation, found, designed, request.quantities)
    had = value_verdict.had_of(evaluation)
    verdicts = verdicts_of(request.quantities, evaluation.refused, had, acceptance)
    tried = evaluation.flux_map is not None or "map" in evaluation.refused
    unasked = ("map",) if tried and "map" not in request.quantities else ()
    if not verdicts.accepted and ENDED not in evaluation.refused:
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
    left_out = left_out_of(run)
    told = ", ".join(f"{what} ({name})" for name, what in left_out.items())
    accuracy = accuracy_facts(request.accuracy, request.quantities, found, left_out)
    missed = not all(fact["reached"] for fact in accuracy.values())
    bend_per_a = conditions.get("L_d_bend_per_a")
    facts = [
        {
            **value_verdict.value_facts(name, estimate),
            "accepted": name not in rejected,
            **({"accuracy": accuracy[name]} if name in accuracy else {}),
            **({"bend_per_a": bend_per_a} if name == "L_d_h" and bend_per_a else {}),
        }
        for name, estimate in (found | timing | kept.effects()).items()
    ]
    good = {name: estimate for name, estimate in found.items() if name not in rejected}
    summary = value_verdict.summary_of(kept, good, request.quantities)
    return Stage(
        "identify",
        "partial" if missed and verdicts.status == "pass" else verdicts.status,
        0.0,
        values=[*facts, *map(value_verdict.check_facts, evaluation.checks)],
        # what is refused is no criterion of the values that go on
        acceptance=[line for line in acceptance.values() if line.ok or verdicts.status == "fail"],
        fallbacks=[*verdicts.lines(), *verdicts_of(unasked, evaluation.refused, had, acceptance).lines(), *fallen],
        files={**files, NAMEPLATE: "", REQUEST: "", **{f"traces/{path.name}": "" for path in trace_files(run)}},
        note="; ".join(
            [
                *([accuracy_line(accuracy)] if missed else []),
                *([f"left out for the accuracy asked: {told}"] if left_out else []),
                *value_verdict.warnings_of(evaluation, request),
            ]
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

    Raises IdentificationError: no value can be trusted.
    """
    files = [*trace_files(run), *(path for path in [run.path / REFUSED] if path.is_file())]
    states = tuple((str(path.resolve()), path.stat().st_size, path.stat().st_mtime_ns) for path in files)
    asked = dump_machine_file(nameplate), dump_request(request)
    return _evaluation(_Question(run, nameplate, request, asked, states))


@lru_cache(maxsize=1)
def _evaluation(question: _Question) -> Evaluation:
    run, nameplate, request = question.run, question.nameplate, question.request
    inverter, traces = nameplate.inverter, stored_traces(run)
    found = evaluate(
        traces,
        inverter.T_s,
        copper=copper_of(nameplate),
        alpha_psi_per_k=nameplate.machine.alpha_psi_per_k,
        U_dc_v=inverter.U_dc_v,
        plateau_v=inverter.U_dc_v * inverter.dead_time_s * inverter.f_s_hz,
        tolerance=replace(request.tolerance, magnet_per_k=magnet_tolerance_per_k(nameplate.machine)),
        ended=refused_in(run),
    )
    counts = traces["zero_current"].meta.get(COUNTS)
    if found.encoder is None or counts is None:
        return found
    pairs = found.encoder.pole_pairs
    told = f"{pairs.method}; by the drive's {counts:.0f} encoder counts per turn, like J, B, tau_c and speeds"
    return replace(found, encoder=replace(found.encoder, pole_pairs=replace(pairs, method=told)))


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
    friction = {name: max(0.0, found[name].value) for name in ("tau_c_nm", "B_nms") if name in found}
    machine = replace(machine, **friction)  # type: ignore[arg-type]
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
            **evaluation.effects(),
            **{check.name: check.estimate for check in evaluation.checks},
        },
        conditions=dict(conditions),
        simulation={},
        flux_map=flux_map,
    )
