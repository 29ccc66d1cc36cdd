"""Identification on drives without injection: what CiA 402 alone gives, and what a recorder adds.

``standard``: pole pairs, direction and encoder offset from a vector turned by the commutation angle 0x60EA.
``recorder``: flux linkage and L_q from recorded torque pushes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from pmsmtool.drive import objects
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.guard import guarded
from pmsmtool.drive.standard_drive import RecorderDrive, StandardDrive
from pmsmtool.errors import ConfigError, IdentificationError, NotAvailable
from pmsmtool.estimators.encoder import EncoderResult, estimate_encoder
from pmsmtool.estimators.estimate import SensorTolerance, total_half_width
from pmsmtool.estimators.recorded_push import PushResult, estimate_pushes
from pmsmtool.estimators.rotation_offset import offset_by_turns
from pmsmtool.experiments.recorded_push import PushPlan, swing
from pmsmtool.experiments.rotation import RotationPlan, rotate_vector
from pmsmtool.machine.parameters import Estimate
from pmsmtool.trace import Trace
from pmsmtool.trace_file import trace_npz
from pmsmtool.units import format_estimate
from pmsmtool.workflow.identify import IdentifyRequest, value_facts
from pmsmtool.workflow.run_directory import RunDirectory, Stage

VECTOR_SHARES = (0.35, 0.7)
"""Length of the turned vector, of the test current; the larger one where the rotor does not stay on the first."""
OFF_THE_VECTOR = ("E_ROTOR_MOVED", "E_POLE_PAIRS")
SWING_SHARE = 0.4
"""Speed of the recorded pushes, of the largest one."""
DURATION_S = 600.0
"""Longest time the machine is energised."""
NO_RESISTANCE = "the inverter's error at running currents hides it; needs DC levels by current set-points"
NO_LIMIT_RPM = 100_000.0
HEADROOM = 1.2
"""Largest current of the envelope over the test current."""


@dataclass(frozen=True, slots=True)
class TierResult:
    """Estimates of a run without injection.

    Attributes
    ----------
    estimates : mapping of str to Estimate
        By the keys of a machine file.
    missing : mapping of str to str
        What was asked and cannot be told, with the reason.
    traces : mapping of str to Trace
        What was recorded.
    """

    estimates: Mapping[str, Estimate]
    missing: Mapping[str, str]
    traces: Mapping[str, Trace]


def identify_standard(
    drive: StandardDrive, envelope: Envelope, say: Callable[[str], None] = lambda text: None
) -> TierResult:
    """Turn a current vector through one mechanical turn each way; the drive is off on return.

    Raises
    ------
    IdentificationError
        A trap was seen; no number is given.
    StopNotConfirmed, Interrupted, BusError, DriveFault, LimitExceeded
        As the guard ends the experiment.
    """
    traces: dict[str, Trace] = {}
    with guarded(drive, envelope, say=say) as guard:
        guard.enable()
        for share in VECTOR_SHARES:
            plan = RotationPlan(i_a=share * envelope.i_max_apk / HEADROOM)
            say(f"pole pairs, direction, offset: one slow turn each way with {plan.i_a:.3g} A")
            traces["rotation_forward"], traces["rotation_backward"] = rotate_vector(guard, plan)
            try:
                found = estimate_encoder(traces["rotation_forward"], traces["rotation_backward"])
                break
            except IdentificationError as error:
                if error.reason not in OFF_THE_VECTOR or share == VECTOR_SHARES[-1]:
                    raise
    return TierResult(encoder_estimates(found, traces), {}, traces)


def encoder_estimates(found: EncoderResult, traces: Mapping[str, Trace]) -> dict[str, Estimate]:
    """Return pole pairs, direction and offset by the keys of a machine file."""
    direction = Estimate(float(found.direction), 0.0, 0.0, "1", n=found.offset.n, method=found.pole_pairs.method)
    offset = offset_by_turns(found, traces["rotation_forward"], traces["rotation_backward"])
    return {"pole_pairs": found.pole_pairs, "direction": direction, "offset_rad": offset}


def identify_recorder(
    drive: RecorderDrive,
    envelope: Envelope,
    *,
    tolerance: SensorTolerance | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> TierResult:
    """Swing the shaft by torque pushes and record them; the drive is off on return.

    Raises
    ------
    IdentificationError
        A trap was seen; no number is given.
    StopNotConfirmed, Interrupted, BusError, DriveFault, LimitExceeded
        As the guard ends the experiment.
    """
    traces: dict[str, Trace] = {}
    pole_pairs = round(drive.read("motor.pole_pairs"))
    plan = PushPlan(envelope.i_max_apk / HEADROOM, SWING_SHARE * envelope.speed_max_rad_s)
    with guarded(drive, envelope, say=say) as guard:
        guard.enable()
        say(f"psi, L_q: {4 * len(plan.shares)} recorded torque pushes up to {plan.i_test_a:.3g} A")
        swing(guard, plan, traces.__setitem__)
    found = estimate_pushes(
        list(traces.values()), period_s=drive.period_s, pole_pairs=pole_pairs, tolerance=tolerance
    )
    return TierResult(push_estimates(found), {"R_s_ohm": NO_RESISTANCE}, traces)


def push_estimates(found: PushResult) -> dict[str, Estimate]:
    """Return what the pushes told by the keys of a machine file.

    Their R is left out: on 18 fresh random drives its error went up to 22 %, beyond its interval on four of them
    (benchmarks.tier_intervals recorder --drives 24 --first 400, with R told).
    """
    return {"psi_f_wb": found.psi_f, "L_q_app_h": found.L_q, "frame_offset_rad": found.frame_offset}


def tier_envelope(drive: CanopenDrive, request: IdentifyRequest) -> Envelope:
    """Return the motion envelope: what the request says, else the drive's own rated current and largest speed.

    Raises
    ------
    ConfigError
        The drive's largest speed is no limit, and none was given.
    """
    rated_apk = 1e-3 * math.sqrt(2.0) * drive.node.get(objects.RATED_CURRENT_MA)
    rpm = drive.node.get(objects.MAX_SPEED_RPM)
    if request.speed_max_rad_s is None and rpm > NO_LIMIT_RPM:
        raise ConfigError(
            f"the drive's largest speed (0x6080) is {rpm:.0f} rpm: that is no limit", hint="give --speed-max"
        )
    return Envelope(
        i_max_apk=HEADROOM * rated_apk if request.i_max_apk is None else request.i_max_apk,
        speed_max_rad_s=rpm * math.pi / 30.0 if request.speed_max_rad_s is None else request.speed_max_rad_s,
        duration_s=DURATION_S,
        shaft=request.shaft,
        load=request.load,
        brake=request.brake,
    )


def tier_stage(
    run: RunDirectory,
    drive: StandardDrive | RecorderDrive,
    request: IdentifyRequest,
    allow_motion: Callable[[Sequence[str]], None],
    say: Callable[[str], None],
) -> Stage:
    """Run the tier's experiment and keep its traces; there is no machine file, a part of the machine is unknown.

    Raises
    ------
    NotAvailable
        The shaft is locked.
    Declined
        The person did not consent; nothing was moved.
    IdentificationError, StopNotConfirmed, Interrupted, BusError, DriveFault, LimitExceeded
        As :func:`identify_standard` and :func:`identify_recorder`.
    """
    if request.shaft == "locked":
        raise NotAvailable("without injection the rotor must turn, and the shaft is locked", hint="free the shaft")
    envelope = tier_envelope(drive, request)
    envelope.refuse_gravity()
    moves = (
        "the shaft turns slowly through one turn each way"
        if isinstance(drive, StandardDrive)
        else f"the shaft swings up to {100.0 * SWING_SHARE:.0f} % of the largest speed, both ways"
    )
    allow_motion([*envelope.lines(), moves, "nothing is stored in the drive; every changed object is restored"])
    clock = drive.node.connection.clock
    start = clock.now()
    if isinstance(drive, StandardDrive):
        result = identify_standard(drive, envelope, say)
    else:
        result = identify_recorder(drive, envelope, tolerance=request.tolerance, say=say)
    for name, trace in result.traces.items():
        run.save(f"traces/{name}.npz", trace_npz(trace))
    return Stage(
        "identify",
        "pass",
        clock.now() - start,
        values=[value_facts(name, estimate) for name, estimate in result.estimates.items()],
        fallbacks=[f"{name}: not available: {why}" for name, why in result.missing.items()],
        files={f"traces/{name}.npz": "" for name in result.traces},
        note="a part of the machine only, at the temperature of the run: no machine file is written",
        summary=", ".join(
            f"{name} {format_estimate(e.value, total_half_width(e), e.unit)}" for name, e in result.estimates.items()
        ),
    )
