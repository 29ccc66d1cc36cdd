# SPDX-License-Identifier: MIT
"""Identify the machine on a drive: envelope and consent, the experiments, and the machine file from their traces.

What the estimates are is decided from the stored traces alone (``evaluate``), so that :func:`replay` gives the same
bytes years later. Nothing is stored in the drive.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from pmsmtool.cia402 import HOMING_LOST
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.envelope import Brake, Envelope, Load, Shaft, largest_acceleration
from pmsmtool.drive.guard import guarded
from pmsmtool.drive.port import Drive
from pmsmtool.errors import ConfigError, DriveFault, IdentificationError, NotAvailable, PmsmtoolError, SafetyRefusal
from pmsmtool.estimators.estimate import SensorTolerance
from pmsmtool.estimators.resistance import copper_of
from pmsmtool.experiments.rotation import dwell_within
from pmsmtool.files import read_text
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file, load_machine_file
from pmsmtool.machine.parameters import EncoderParameters, InverterParameters, MachineLimits, MachineParameters
from pmsmtool.machine.temperature import magnet_tolerance_per_k
from pmsmtool.trace import Trace
from pmsmtool.trace_file import read_trace, trace_npz
from pmsmtool.units import rad_s_from_rpm
from pmsmtool.workflow import frequency_stage, half_frequency, identify_verdict, map_stage, mechanics_stage
from pmsmtool.workflow.calibration import calibrated_tolerance
from pmsmtool.workflow.cogging_file import cogging_estimates, save_cogging
from pmsmtool.workflow.evaluate import evaluate
from pmsmtool.workflow.identified_machine import machine_of
from pmsmtool.workflow.limits import HEADROOM, Limits, require_speed, unused_current
from pmsmtool.workflow.measure import NEEDS, QUANTITIES, Measurement, starting_gains, steps_of
from pmsmtool.workflow.predicted_file import PREDICTED, dump_predicted
from pmsmtool.workflow.refused_file import REFUSED, dump_refused, refused_in
from pmsmtool.workflow.run_account import status_of, text_of
from pmsmtool.workflow.run_directory import RunDirectory, Stage
from pmsmtool.workflow.sampling_stage import timing_estimates, with_timing
from pmsmtool.workflow.verdicts import verdicts_of

MACHINE = "machine.toml"
NAMEPLATE = "nameplate.toml"
REQUEST = "request.json"
"""What was asked, as far as the estimates depend on it: a replay is to give the same bytes."""
REPLAYED = "replayed"
"""Folder of a run for what a replay makes of it once a design stands on its machine file."""
_MADE_FROM_MACHINE = ("design.toml", "params.toml")


@dataclass(frozen=True, slots=True)
class IdentifyRequest:
    """What is asked, and what the machine may do meanwhile; None leaves the choice to the drive's own ratings.

    Attributes
    ----------
    quantities : tuple of str
        Out of ``R L psi encoder poles inverter mechanics map frf``.
    i_max_apk, speed_max_rad_s : float or None
        Envelope (A peak, rad/s mechanical).
    shaft, load, brake : str
        What hangs on the shaft and may happen to it.
    half_frequency : bool
        Whether R and inverter are measured at half the control frequency, too.
    map_if_saturated : bool
        Whether a machine that the run over speeds shows to saturate is mapped, too.
    tolerance : SensorTolerance
        Declared sensor tolerances.
    """

    quantities: tuple[str, ...] = QUANTITIES
    i_max_apk: float | None = None
    speed_max_rad_s: float | None = None
    shaft: Shaft = "free"
    load: Load = "none"
    brake: Brake = "none"
    half_frequency: bool = False
    map_if_saturated: bool = False
    tolerance: SensorTolerance = field(default_factory=SensorTolerance)

    def check(self) -> None:
        """Refuse what cannot be asked.

        Raises
        ------
        ConfigError
            An unknown quantity.
        NotAvailable
            A quantity that needs a turning shaft, on a shaft that must not turn.
        """
        unknown = [name for name in self.quantities if name not in NEEDS]
        if unknown or not self.quantities:
            raise ConfigError(
                f"cannot identify {', '.join(unknown) or 'nothing'}", hint=f"choose from {', '.join(NEEDS)}, or all"
            )
        if self.half_frequency and self.quantities == ("poles",):
            raise ConfigError(
                "pole pairs alone do not measure R", hint="leave --half-frequency out, or identify R, too"
            )
        turning = [name for name in self.quantities if name != "map" and set(NEEDS[name]) & {"rotation", "speeds"}]
        if turning and self.shaft == "locked":
            raise NotAvailable(
                f"{', '.join(turning)} cannot be identified on a locked shaft: the rotor must turn",
                hint="free the shaft, or identify R, inverter and map only",
            )


def nameplate_of(drive: Drive, name: str) -> MachineFile:
    """Return the machine file of a drive before anything is identified: its ratings, and what its set says so far."""

    def read(parameter: str) -> float:
        return drive.read(parameter)

    machine = MachineParameters(
        pole_pairs=round(read("motor.pole_pairs")),
        R_s_ohm=read("motor.R_s_ohm"),
        L_d_h=read("motor.L_d_h"),
        L_q_h=read("motor.L_q_h"),
        psi_f_wb=read("motor.psi_f_wb"),
        I_nom_apk=read("motor.I_nom_apk"),
        I_max_apk=read("motor.I_max_apk"),
        I_max_time_s=read("motor.I_max_time_s"),
        n_max_rpm=read("motor.n_max_rpm"),
        T_ref_c=read("motor.T_ref_c"),
        alpha_R_per_k=read("motor.alpha_R_per_k"),
        alpha_psi_per_k=read("motor.alpha_psi_per_k"),
    )
    inverter = InverterParameters(
        U_dc_v=read("inverter.U_dc_nom_v"),
        f_s_hz=1e9 / read("inverter.T_s_ns"),
        dead_time_s=1e-9 * read("inverter.dead_time_ns"),
        delay_periods=read("inverter.delay_periods"),
        voltage_utilisation=read("inverter.voltage_utilisation"),
    )
    i_d_min = read("field_weakening.i_d_min_a")
    limits = MachineLimits(
        # what is no nearer than I_max is no demagnetisation limit: the design then assumes one
        i_d_min_apk=i_d_min if i_d_min > -read("motor.I_max_apk") else None,
        i_trip_apk=read("protection.i_trip_apk"),
        I_cont_apk=read("protection.I_cont_apk"),
        U_dc_min_v=read("protection.U_dc_min_v"),
        U_dc_max_v=read("protection.U_dc_max_v"),
        n_trip_rpm=read("protection.n_trip_rpm"),
        T_winding_max_c=read("protection.T_winding_max_c"),
    )
    return MachineFile(
        name,
        machine,
        inverter,
        encoder=EncoderParameters(),
        limits=limits,
        provenance={"source": "parameter set and ratings of the drive; what was identified stands in [estimate]"},
    )


def envelope_of(nameplate: MachineFile, request: IdentifyRequest) -> Envelope:
    """Return the motion envelope: what the request says, else the drive's ratings.

    Raises
    ------
    ConfigError
        The nameplate has no rated current or speed, and none was given.
    """
    machine = nameplate.machine
    if machine.I_nom_apk is None or machine.n_max_rpm is None:
        raise ConfigError("rated current and largest speed must be known", hint="give --i-max and --speed-max")
    i_max = HEADROOM * machine.I_nom_apk if request.i_max_apk is None else request.i_max_apk
    speed = rad_s_from_rpm(machine.n_max_rpm) if request.speed_max_rad_s is None else request.speed_max_rad_s
    i_d_min = nameplate.limits.i_d_min_apk
    return Envelope(
        i_max_apk=i_max,
        speed_max_rad_s=speed,
        duration_s=300.0,
        shaft=request.shaft,
        load=request.load,
        brake=request.brake,
        acceleration_rad_s2=largest_acceleration(machine, i_max),
        i_d_max_apk=machine.I_nom_apk if i_d_min is None else -i_d_min,
    )


def plan_lines(envelope: Envelope, request: IdentifyRequest, nameplate: MachineFile) -> list[str]:
    """Return what a person reads before consenting: the envelope and what will happen inside it."""
    steps = steps_of(request.quantities, request.shaft == "locked")
    allowed = [*envelope.lines(), *unused_current(envelope.i_max_apk, nameplate, pulses="map" in steps)]
    lines = [*allowed, f"the rotor aligns with current vectors: it may jump by half an electrical turn; {HOMING_LOST}"]
    if request.half_frequency:
        lines.append(half_frequency.PLAN_LINE)
    if "rotation" in steps:
        lines.append("the shaft turns slowly through one turn each way")
    if "speeds" in steps:
        lines.append("the shaft is pushed both ways and coasts with current from four speeds in each direction")
    if "coasting" in steps:
        lines.append(mechanics_stage.PLAN_LINE)
    if "response" in steps:
        lines.append(frequency_stage.PLAN_LINE)
    if "map" in steps:
        lines += map_stage.plan_lines(nameplate)
    elif request.map_if_saturated and "speeds" in steps:
        lines.append(map_stage.IF_SATURATED)
    lines.append("nothing is stored in the drive; every changed object is restored")
    return lines


def identify_stage(
    run: RunDirectory,
    drive: CanopenDrive,
    nameplate: MachineFile,
    request: IdentifyRequest,
    allow_motion: Callable[[Sequence[str]], None],
    say: Callable[[str], None],
) -> Stage:
    """Run the experiments and write ``machine.toml`` and the traces.

    Raises
    ------
    Declined
        The person did not consent; nothing was moved.
    IdentificationError
        A trap was seen; no number is given.
    StopNotConfirmed, Interrupted, BusError, DriveFault, LimitExceeded
        As the guard ends the experiment.
    """
    request.check()
    envelope = envelope_of(nameplate, request)
    envelope.refuse_gravity()
    steps = steps_of(request.quantities, request.shaft == "locked")
    if "speeds" in steps:
        require_speed(envelope.speed_max_rad_s, nameplate.machine.n_max_rpm or 0.0)
    if "rotation" in steps:
        dwell_within(0.0, envelope.speed_max_rad_s)
    allow_motion(plan_lines(envelope, request, nameplate))
    run.save(NAMEPLATE, dump_machine_file(nameplate))
    run.save(REQUEST, dump_request(request))
    limits = Limits(
        I_nom_apk=nameplate.machine.I_nom_apk or envelope.i_max_apk,
        i_max_apk=envelope.i_max_apk,
        omega_max_rad_s=envelope.speed_max_rad_s,
        V_max_v=nameplate.inverter.V_max_v,
        i_d_max_apk=envelope.i_d_max_apk,
    )

    clock = drive.node.connection.clock
    start = clock.now()
    try:
        _measure(run, drive, envelope, limits, request, say)
    except (DriveFault, IdentificationError, SafetyRefusal) as error:
        # what was measured before is not lost: it is evaluated and recorded, and the run ends as it did
        with contextlib.suppress(PmsmtoolError):
            kept = evaluated_stage(run, nameplate, request)
            run.add(replace(kept, status=status_of(error), note=text_of(error), seconds=clock.now() - start))
        raise
    stage = evaluated_stage(run, nameplate, request)
    return replace(stage, seconds=clock.now() - start)


def _measure(
    run: RunDirectory,
    drive: CanopenDrive,
    envelope: Envelope,
    limits: Limits,
    request: IdentifyRequest,
    say: Callable[[str], None],
) -> None:
    """Run the experiments inside the guard; traces, predictions and refusals go into the run."""

    def keep(name: str, trace: Trace) -> None:
        run.save(f"traces/{name}.npz", trace_npz(trace))

    with guarded(drive, envelope, first=starting_gains(limits), say=say) as guard:
        locked = request.shaft == "locked"
        measurement = Measurement(
            guard,
            limits,
            keep,
            say,
            held=locked,
            half_frequency=request.half_frequency,
            map_if_saturated=request.map_if_saturated,
        )
        measurement.spent = lambda: (guard.energised_s, guard.energy_j)
        predictions: list[dict[str, Any]] = []

        def predicted(prediction: dict[str, Any]) -> None:
            predictions.append(prediction)
            run.save(PREDICTED, dump_predicted(predictions))

        measurement.predicted = predicted
        try:
            measurement.run(request.quantities)
        finally:
            if measurement.refused:
                run.save(REFUSED, dump_refused(measurement.refused))


def evaluated_stage(run: RunDirectory, nameplate: MachineFile, request: IdentifyRequest) -> Stage:
    """Estimate from the stored traces, write ``machine.toml``, and judge every value.

    Where a design or a parameter set was already made from the machine file, another one does not take its place: it
    goes into the folder ``replayed``, with the map and the response that belong to it.

    Raises
    ------
    IdentificationError
        A trap was seen; no machine file is written.
    """
    traces = stored_traces(run)
    evaluation = evaluate(
        traces,
        nameplate.inverter.T_s,
        copper=copper_of(nameplate.machine),
        alpha_psi_per_k=nameplate.machine.alpha_psi_per_k,
        U_dc_v=nameplate.inverter.U_dc_v,
        tolerance=replace(request.tolerance, magnet_per_k=magnet_tolerance_per_k(nameplate.machine)),
        ended=refused_in(run),
    )
    parts = half_frequency.split_estimates(evaluation.split, nameplate.inverter.U_dc_v, request.tolerance)
    timing = timing_estimates(evaluation.inductance, evaluation.shown, request.tolerance)
    conditions = identify_verdict.conditions_of(evaluation, request) | half_frequency.split_conditions(
        evaluation.split, parts
    )
    found = evaluation.estimates()
    designed = machine_of(evaluation, nameplate, conditions)
    acceptance = identify_verdict.acceptance_of(evaluation, found, designed, request.quantities)
    had = identify_verdict.had_of(evaluation)
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
        made = map_stage.save_map(target, kept.flux_map)
        made |= frequency_stage.save_response(target, kept.frequency_response)
        if kept.encoder is not None:
            made |= save_cogging(target, kept.mechanics, kept.encoder.direction)
        target.save(MACHINE, text)
        files = {f"{prefix}{name}": "" for name in (MACHINE, *made)}
    files |= {name: "" for name in (PREDICTED, REFUSED) if (run.path / name).is_file()}
    fallen = [f"{name}: {estimate.fallback}" for name, estimate in found.items() if estimate.fallback]
    facts = [
        {**identify_verdict.value_facts(name, estimate), "accepted": name not in rejected}
        for name, estimate in (found | parts | timing | cogging_estimates(kept.mechanics)).items()
    ]
    summary = identify_verdict.summary_of(kept, {name: e for name, e in found.items() if name not in rejected})
    return Stage(
        "identify",
        verdicts.status,
        0.0,
        values=[*facts, *map(identify_verdict.check_facts, evaluation.checks)],
        # what is refused is no criterion of the values that go on
        acceptance=[line for line in acceptance.values() if line.ok or verdicts.status == "fail"],
        fallbacks=[*verdicts.lines(), *fallen],
        files={**files, NAMEPLATE: "", REQUEST: "", **{f"traces/{name}.npz": "" for name in traces}},
        note="; ".join(identify_verdict.warnings_of(evaluation, request)),
        summary="; ".join(filter(None, (summary, *(f"{name} refused" for name in verdicts.refused)))),
        refused=dict(verdicts.refused),
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
        Scales against an instrument (``workflow/calibration.py``).

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


def dump_request(request: IdentifyRequest) -> str:
    """Return a request as JSON: what an estimate depends on besides traces and nameplate."""
    facts = asdict(request)
    if math.isinf(request.tolerance.U_dc_v):
        del facts["tolerance"]["U_dc_v"]  # comes from the nameplate, and JSON has no infinity
    return json.dumps(facts, indent=1) + "\n"


def parse_request(text: str, *, where: str) -> IdentifyRequest:
    """Return the request of a run.

    Raises
    ------
    ConfigError
        It is not what :func:`dump_request` writes.
    """
    try:
        facts = json.loads(text)
        tolerance = SensorTolerance(**facts.pop("tolerance"))
        request = IdentifyRequest(tolerance=tolerance, **{**facts, "quantities": tuple(facts["quantities"])})
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ConfigError(
            f"the recorded request is damaged: {error}",
            where=where,
            hint="identify again; or take the file from a copy of the run",
        ) from error
    request.check()
    return request


def stored_traces(run: RunDirectory) -> dict[str, Trace]:
    """Return the traces of a run by name."""
    return {path.stem: read_trace(path) for path in sorted((run.path / "traces").glob("*.npz"))}
