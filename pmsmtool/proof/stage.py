# SPDX-License-Identifier: MIT
"""``prove``: refuse a drive that holds another set, predict, commit, measure, compare; everything in a run directory.

The prediction is written, synced to the disk and named by its hash before the first step. Traces and prediction stay
in ``prove/<first digits of the hash>/`` of the run, so a proof that is repeated does not replace an earlier one.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, count
from pathlib import Path
from typing import Any

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.design.design_file import Design
from pmsmtool.design.prediction import Prediction
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.envelope import Envelope, largest_acceleration, voltage_speed
from pmsmtool.drive.guard import guarded
from pmsmtool.errors import (
    ConfigError,
    DriveFault,
    LimitExceeded,
    NotAvailable,
    PmsmtoolError,
    SdoAbort,
    VerifyMismatch,
)
from pmsmtool.files import make_folder, write_file
from pmsmtool.flash.restore import plan_download
from pmsmtool.identification.wiring import LINK_AT_REST, SUPPLY
from pmsmtool.machine.parameters import Brake, Load, Shaft
from pmsmtool.measurement.limits import within_supply
from pmsmtool.npz_file import npz_bytes, read_npz
from pmsmtool.proof.conditions import Conditions, conditions_of
from pmsmtool.proof.drawn_machine import BENT, SEEN_SHARES, U_DC_SPREAD, bend_of
from pmsmtool.proof.judgement import Judgement, from_arrays, judge, patterns, to_arrays, with_ripple
from pmsmtool.proof.measured import SpeedNotReached, run_experiments
from pmsmtool.proof.plan import LINK, SPEED, Experiment, ProofPlan, plan_proof
from pmsmtool.proof.simulated import RUNS, predict_proof
from pmsmtool.run_directory import Acceptance, RunDirectory, Stage
from pmsmtool.trace import Trace, read_trace, trace_npz
from pmsmtool.units import RAD_S_PER_RPM

FOLDER = "prove"
PREDICTION = "prediction.npz"
GROSS = 3.0
"""A response this far outside its band, in half widths, ends the proof: what is demanded next needs what has failed."""
LOWEST_LINK = 0.05
"""Quantile of a record that is the link under load: its noise is not."""
LINK_KEPT = 0.87
"""Least part of the link at rest that a usual supply keeps under load (2 to 10 % less at rated power, and a proof may
take more); one that falls further is judged, and named."""
RATED_SHARE = 1.12
"""Largest rated power that is proven, of that from which on the link gives way: 10 % less at rated power, as a supply
gives it (1.11), stay above ``LINK_KEPT`` with 8 % of losses. Two healthy drives of 9.1 and 9.6 % were proven at 65 and
63 % of their rated current."""
AT_REST = 0.1
"""Predicted end of a speed, of its largest, below which the experiment ends at rest: a move."""
_HASH_DIGITS = 12
ROUNDING = 1e-6
"""Relative: a rating that went through a drive's units and back is the same rating."""
WIDEST_BAND = 2.0
"""Largest half width of a predicted speed, of the speed: beyond, the design does not hold it on machines within its
intervals (seen: 9 in the field weakening of a machine of 4e-6 kg m2; 1.3 of a healthy one of 1.2e-5 kg m2)."""


@dataclass(frozen=True, slots=True)
class ProofRequest:
    """What is asked, and what the machine may do meanwhile; None leaves the choice to the design's ratings."""

    i_max_apk: float | None = None
    speed_max_rad_s: float | None = None
    """Envelope (A peak, rad/s mechanical)."""
    shaft: Shaft = "free"
    load: Load = "none"
    brake: Brake = "none"
    """What hangs on the shaft; it must be what the design was made for."""
    runs: int = RUNS
    seed: int = 0
    """Machines drawn for the prediction, and the seed of the draw."""
    experiments: tuple[str, ...] = ()
    """Names of the experiments the drive can show; empty: all."""


@dataclass(slots=True)
class _Record:
    """What has been measured so far, and whether it went on."""

    prediction: Prediction
    save: Callable[[str, bytes], None]
    conditions: Conditions
    rated_v: float
    """DC link of the machine file (V)."""
    measured: dict[tuple[str, str], Array] = field(default_factory=dict)
    done: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)

    def keep(self, experiment: Experiment, trace: Trace) -> bool:
        """Store a record and compare it, unless its link is not the predicted one; False when it is grossly outside."""
        self.save(f"{experiment.name}.npz", trace_npz(trace))
        self.done.append(experiment.name)
        if apart := _link_apart(experiment, trace, self.conditions, self.rated_v):
            self.left_out.append(f"{experiment.text}: {apart}")
            return True
        self.measured |= responses({experiment.name: trace}, self.prediction)
        self.prediction = with_ripple(self.prediction, {experiment.name: trace})
        shares = [self.prediction.bands[key].largest(v)[0] for key, v in self.measured.items()
                  if key[0] == experiment.name]  # fmt: skip
        return max(shares) <= GROSS


def _with_the_supply(conditions: Conditions, design: Design) -> Conditions:
    """Return the conditions with the link that the supply gives, where braking has raised it since identification.

    A rectifier takes nothing back: on one of 556 V the link stood at 633 V, and a healthy drive failed at 540 V.
    """
    supplied = design.machine.conditions.get(LINK_AT_REST)
    if isinstance(supplied, float) and supplied < conditions.U_dc_v * (1.0 - U_DC_SPREAD):
        return replace(conditions, U_dc_v=supplied)
    return conditions


def _link_apart(experiment: Experiment, trace: Trace, conditions: Conditions, rated_v: float) -> str:
    """Return how far the link is from rest in a record that it decides; empty where it is as predicted, or failed.

    A link behind a rectifier keeps what braking before the proof has charged it by: its first load brings it back.
    """
    if LINK not in experiment.signals:
        return ""
    low, high = (float(v) for v in np.quantile(trace[LINK], (LOWEST_LINK, 1.0 - LOWEST_LINK)))
    rest, ripple_v = conditions.U_dc_v, SEEN_SHARES[1] * conditions.U_dc_ripple_v
    if LINK_KEPT * min(rest, rated_v) <= low < rest * (1.0 - U_DC_SPREAD) - ripple_v:
        return f"not judged: under load the DC link falls from {rest:.4g} to {low:.4g} V, and it decides the response"
    if high > rest * (1.0 + U_DC_SPREAD) + ripple_v:
        return f"not judged: braking raised the DC link from {rest:.4g} to {high:.4g} V, and it decides the response"
    return ""


def envelope_of(design: Design, request: ProofRequest, plan: ProofPlan | None = None) -> Envelope:
    """Return the motion envelope: what the request says, else the design's largest current and speed.

    On a supply that gives way less of both, so that a current at any speed leaves the DC link up: not less than what
    is rated, where the supply gives that.
    """
    T_s, slope = design.machine.inverter.T_s, design["speed.acceleration_rpm_per_s"] * RAD_S_PER_RPM
    i_max = design["motor.I_max_apk"] if request.i_max_apk is None else request.i_max_apk
    speed_max = (
        design["motor.n_max_rpm"] * RAD_S_PER_RPM if request.speed_max_rad_s is None else request.speed_max_rad_s
    )
    supply_w = design.machine.conditions.get(SUPPLY)
    if isinstance(supply_w, float):
        per_ampere = abs(design.machine.machine.torque_nm(0.0, 1.0))
        i_nom, rated_rad_s = min(i_max, design["motor.I_nom_apk"]), min(speed_max, rated_rpm(design) * RAD_S_PER_RPM)
        rated_w = i_nom * rated_rad_s * per_ampere
        if 0.0 < rated_w <= RATED_SHARE * supply_w:  # what is rated can be proven
            supply_w = max(supply_w, rated_w)
            i_max = max(i_nom, min(i_max, supply_w / (speed_max * per_ampere)))
            speed_max = min(speed_max, supply_w / (i_max * per_ampere))
        else:
            i_max, speed_max = within_supply(supply_w, i_max, speed_max, per_ampere)
    return Envelope(
        i_max_apk=i_max,
        speed_max_rad_s=speed_max,
        duration_s=60.0 if plan is None else 45.0 + 2.0 * plan.seconds(T_s, slope),
        shaft=request.shaft,
        load=request.load,
        brake=request.brake,
        acceleration_rad_s2=largest_acceleration(design.machine.machine, i_max),
        voltage_speed_rad_s=voltage_speed(design.machine, i_max),
    )


def prove_stage(
    run: RunDirectory,
    drive: CanopenDrive,
    design: Design,
    request: ProofRequest,
    allow_motion: Callable[[Sequence[str]], None],
    say: Callable[[str], None],
) -> Stage:
    """Prove a design on the machine; the stage says pass or fail, ``run`` holds prediction and traces.

    Raises
    ------
    VerifyMismatch
        The drive holds another set than the design's.
    Declined
        The person did not consent; nothing was moved.
    StopNotConfirmed, Interrupted, BusError, SafetyRefusal
        As the guard ends it.
    """
    refuse_other_set(drive.node, design)
    envelope = envelope_of(design, request)
    envelope.refuse_gravity()
    shown = conditions_of(drive, envelope)
    conditions = _with_the_supply(shown, design)
    plan = _shown(plan_proof(design, conditions), request.experiments)
    envelope = envelope_of(design, request, plan)
    allow_motion([*envelope.lines(), *(e.text for e in plan.experiments), "nothing is stored in the drive"])
    say(f"predicting {len(plan.experiments)} responses on {request.runs} machines")
    prediction = predict_proof(design, conditions, plan, runs=request.runs, seed=request.seed)
    digest, folder = commit(run, prediction)
    say(f"prediction committed: sha256:{digest}")
    for line in band_lines(prediction):
        say(line)

    def save(name: str, data: bytes) -> None:
        run.save(f"{folder}/{name}", data)

    record = _Record(prediction, save, conditions, design.machine.inverter.U_dc_v)
    drive.recorder.forget()  # a download before this may have reset the drive
    event: PmsmtoolError | None = None
    try:
        with guarded(drive, envelope, say=say) as guard:
            run_experiments(guard, plan, design, conditions, record.keep, say)
    except (DriveFault, LimitExceeded, SpeedNotReached) as error:
        if isinstance(error, SdoAbort):
            raise
        event = error  # the guard has stopped the machine and restored the drive
    stage = _stage(plan, record, event, digest, folder)
    told = [BENT] if bend_of(design.machine) else []
    if conditions.U_dc_v < shown.U_dc_v:
        told.append(
            f"the DC link stands at {shown.U_dc_v:.4g} V, raised by braking: predicted with the "
            f"{conditions.U_dc_v:.4g} V that identification met"
        )
    return replace(stage, not_checked=_beyond(design, conditions), fallbacks=(*stage.fallbacks, *told))


def rated_rpm(design: Design) -> float:
    """Return the rated speed, the largest one where none is stated (rpm)."""
    return design.machine.machine.n_nom_rpm or float(design["motor.n_max_rpm"])


def _beyond(design: Design, conditions: Conditions) -> list[str]:
    """Return what a proof within its envelope leaves open of the machine's ratings."""
    rows = (
        ("current", conditions.i_max_apk, design["motor.I_nom_apk"], "A pk"),
        ("speed", conditions.speed_max_rad_s / RAD_S_PER_RPM, rated_rpm(design), "rpm"),
    )
    supply_w = design.machine.conditions.get(SUPPLY)
    limit = f": the DC link gives way at {supply_w:.3g} W" if isinstance(supply_w, float) else ""
    lines = [
        f"{name} beyond {allowed:.4g} of rated {rated:.4g} {unit} (the envelope of the proof{limit}): NOT CHECKED"
        for name, allowed, rated, unit in rows
        if allowed < rated * (1.0 - ROUNDING)
    ]
    return [*lines, *(["turning shaft (locked): NOT CHECKED"] if conditions.shaft == "locked" else [])]


def _shown(plan: ProofPlan, names: tuple[str, ...]) -> ProofPlan:
    """Return the plan without the experiments that the drive cannot show. Raises NotAvailable: nothing is left."""
    if not names:
        return plan
    left = tuple(f"{e.text}: the drive has no excitation" for e in plan.experiments if e.name not in names)
    kept = tuple(e for e in plan.experiments if e.name in names)
    if not kept:
        raise NotAvailable(f"needs one of {', '.join(names)}, and the design has none", hint="see `pmsmtool caps`")
    return ProofPlan(kept, (*plan.left_out, *left))


def refuse_other_set(node: DriveNode, design: Design) -> None:
    """Refuse a drive that does not hold the design's bytes.

    Raises VerifyMismatch: every object that holds something else.
    """
    plan = plan_download(node, design.parameter_set())
    if plan.changes:
        before = "`pmsmtool flash-params` of a set of `tune` without --axis, then DESIGN: its set holds the axis alone"
        hint = before if design.request.get("axis") else "`pmsmtool flash-params DESIGN` first"
        raise VerifyMismatch(
            f"the drive does not hold this design: {len(plan.changes)} of {len(plan.entries)} objects differ",
            where=f"node {node.node}",
            differences=plan.lines()[: len(plan.changes)],
            likely="another design was flashed, or none",
            hint=f"{hint}; nothing was moved",
        )


def commit(run: RunDirectory, prediction: Prediction) -> tuple[str, str]:
    """Write a prediction, sync it to the disk, and return its SHA-256 (hex) and its folder in the run.

    Raises ConfigError: it cannot be written: then nothing may be moved.
    """
    data = npz_bytes(to_arrays(prediction))
    digest = hashlib.sha256(data).hexdigest()
    stem = f"{FOLDER}/{digest[:_HASH_DIGITS]}"
    names = chain((stem,), (f"{stem}-{k}" for k in count(2)))
    folder = next(name for name in names if not (run.path / name).exists())
    path = run.path / folder / PREDICTION
    hint = "the prediction is not committed: check your rights there and the space on the disk"
    make_folder(path.parent, hint=hint)
    write_file(path, data, synced=True, hint=hint)
    return digest, folder


def band_lines(prediction: Prediction) -> list[str]:
    """Return the predicted band as lines: final value and width of every signal, and every derived quantity."""
    lines = []
    for (experiment, signal), band in prediction.bands.items():
        lines.append(
            f"predicted {experiment} {signal}: {float(band.mean.min()):.4g} to {float(band.mean.max()):.4g}, "
            f"95 % within +-{float(np.median(band.half)):.2g} (median), +-{float(band.half.max()):.2g} (largest)"
        )
    lines += [f"predicted {name}: {quantity.band}" for name, quantity in prediction.quantities.items()]
    return lines


def responses(traces: Mapping[str, Trace], prediction: Prediction) -> dict[tuple[str, str], Array]:
    """Return the judged responses of recorded experiments, repeated patterns averaged without what turns in them."""
    found = {}
    for (experiment, signal), band in prediction.bands.items():
        if experiment in traces:
            trace = traces[experiment]
            repeats = int(trace.meta.get("repeats", 1))
            if len(trace) != repeats * len(band.mean):
                raise ConfigError(
                    f"{experiment}: the record has {len(trace)} rows of {repeats * len(band.mean)}",
                    hint="prove the design again: the record is not of this prediction",
                )
            found[experiment, signal] = np.asarray(patterns(trace, signal, len(band.mean)).mean(axis=0))
    return found


def read_proof(folder: Path) -> tuple[Prediction, dict[str, Trace]]:
    """Read prediction and traces of a proof again. Raises ConfigError: a file is missing or damaged."""
    prediction = from_arrays(read_npz(folder / PREDICTION), where=str(folder / PREDICTION))
    names = [name for name in prediction.t_s if (folder / f"{name}.npz").is_file()]
    return prediction, {name: read_trace(folder / f"{name}.npz") for name in names}


def _stage(plan: ProofPlan, record: _Record, event: PmsmtoolError | None, digest: str, folder: str) -> Stage:
    found = judge(record.prediction, record.measured)
    missing = [e.name for e in plan.experiments if e.name not in record.done]
    criteria = [Acceptance(line.what, f"{100.0 * line.share:.3g} % of the band: {line.where}", "<= 100 %", line.inside)
                for line in found.seen]  # fmt: skip
    happened = "" if event is None else _happened(event, missing)
    if happened or missing:
        what = happened or f"not run after a response far outside its band: {', '.join(missing)}"
        criteria.append(Acceptance("all experiments are run to their end", what, "all", False))
    slow, unjudged = _speeds_reached(record.prediction, record.measured)
    if slow:
        criteria.append(Acceptance("the speed is reached", slow, "within the band", False))
    good = bool(found.seen) and all(line.ok for line in criteria)
    cause = found.cause or ("" if event is None else event.likely)
    outside = [line.what for line in found.seen if not line.inside]
    told = [happened, slow and f"the speed was not reached: {slow}",
            outside and f"outside the predicted band: {', '.join(outside)}"]  # fmt: skip
    note = "; ".join(str(text) for text in told if text) + (f"; likely {cause}" if cause else "; no known cause fits")
    values: list[Mapping[str, Any]] = [
        {"name": "prediction", "value": f"sha256:{digest}"},
        {"name": "cause", "value": cause},
        {"name": "event", "value": happened},
        *({"name": line.what, "value": line.share, "where": line.where} for line in found.seen),
    ]
    files = [f"{folder}/{PREDICTION}", *(f"{folder}/{name}.npz" for name in record.done)]
    not_shown = tuple(f"not shown: {line}" for line in (*plan.left_out, *record.left_out, *unjudged))
    return Stage(
        "prove", "pass" if good else "fail", 0.0, values=values, acceptance=criteria,
        files=dict.fromkeys(files, ""), fallbacks=not_shown, note="" if good else note,
        summary=_summary(found, len(record.done)),
    )  # fmt: skip


def _happened(event: PmsmtoolError, missing: Sequence[str]) -> str:
    """Return what ended the measurement, and where in the proof."""
    if isinstance(event, SpeedNotReached):
        return event.what
    return f"{event.what}, {f'during {missing[0]}' if missing else 'after the last experiment'}"


def _speeds_reached(prediction: Prediction, measured: Mapping[tuple[str, str], Array]) -> tuple[str, list[str]]:
    """Return which records end below the band of their speed, empty when none does, and which have no useful one.

    A heavy shaft whose friction is hardly known may end a speed step anywhere: that is no fault of the drive.
    """
    slow, unjudged = [], []
    for (experiment, signal), values in measured.items():
        band = prediction.bands[experiment, signal]
        if signal != SPEED or abs(band.mean[-1]) < AT_REST * float(np.max(np.abs(band.mean))):
            continue
        low, high = float(band.low[-1]), float(band.high[-1])
        if high - low > 2.0 * WIDEST_BAND * abs(band.mean[-1]):
            ends = f"between {low:.4g} and {high:.4g} rad/s (electrical)"
            unjudged.append(
                f"speed of {experiment}: predicted to end {ends}, inertia and friction are not known better"
            )
        elif abs(values[-1]) < max(low, -high):  # a band on both sides of standstill has no edge near it
            slow.append(f"{experiment} ends at {values[-1]:.4g} instead of {band.mean[-1]:.4g} rad/s (electrical)")
    return ", ".join(slow), unjudged


def _summary(found: Judgement, experiments: int) -> str:
    worst = max(found.seen, key=lambda line: line.share, default=None)
    share = "" if worst is None else f"; nearest to its edge: {worst.what}, {100.0 * worst.share:.2g} %"
    return f"{experiments} responses inside the predicted 95 % band{share}"


def not_proven(stage: Stage, run: RunDirectory) -> PmsmtoolError:
    """Return the error of a proof that failed: exit code 1, with the likely cause."""
    from pmsmtool.errors import CheckFailed

    cause = next((str(v["value"]) for v in stage.values if v["name"] == "cause"), "")
    return CheckFailed(
        f"the drive does not behave as predicted: {stage.note}",
        where=str(run.path), likely=cause, hint=f"pmsmtool report {run.path}",
    )  # fmt: skip


__all__ = ["ProofRequest", "envelope_of", "not_proven", "prove_stage", "read_proof", "responses"]
