"""Identification on drives without injection: what CiA 402 alone gives, and what a recorder adds.

``standard``: pole pairs, direction and encoder offset from a vector turned by the commutation angle 0x60EA; inertia and
friction over the flux linkage from torque pushes; the flux linkage from the voltage of the coasting machine where the
drive shows it, else from the speed at which the voltage ends.
``recorder``: resistance, flux linkage, L_q and inertia from recorded torque pushes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from pmsmtool.drive import objects
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.guard import guarded
from pmsmtool.drive.standard_drive import RecorderDrive, StandardDrive
from pmsmtool.drive.tier_drives import TorqueDrive
from pmsmtool.errors import ConfigError, IdentificationError, NotAvailable, SdoAbort
from pmsmtool.estimators.encoder import EncoderResult, estimate_encoder
from pmsmtool.estimators.estimate import SensorTolerance, total_half_width
from pmsmtool.estimators.inertia_ratio import estimate_ratios
from pmsmtool.estimators.recorded_push import PushResult, estimate_pushes
from pmsmtool.estimators.rotation_offset import offset_by_turns
from pmsmtool.estimators.voltage_flux import flux_by_undriven_voltage, flux_by_voltage_limit
from pmsmtool.experiments.polled_push import PolledPushPlan, coast_both_ways, push_both_ways, run_to_voltage
from pmsmtool.experiments.recorded_push import PushPlan, swing
from pmsmtool.experiments.rotation import RotationPlan, rotate_vector
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file
from pmsmtool.machine.parameters import Estimate, InverterParameters
from pmsmtool.trace import Trace
from pmsmtool.trace_file import trace_npz
from pmsmtool.units import format_estimate
from pmsmtool.workflow.capabilities import Capabilities, Method
from pmsmtool.workflow.identify import MACHINE, IdentifyRequest, value_facts
from pmsmtool.workflow.run_directory import Acceptance, RunDirectory, Stage
from pmsmtool.workflow.tier_machine import TierMachine, tier_machine

VECTOR_SHARES = (0.35, 0.7)
"""Length of the turned vector, of the test current; the larger one where the rotor does not stay on the first."""
DWELL_S = 0.03
"""Time per step of the vector: nothing finer follows, so the rotor is given time to come to rest."""
OFF_THE_VECTOR = ("E_ROTOR_MOVED", "E_POLE_PAIRS")
SWING_SHARE = 0.4
"""Speed of the recorded pushes, of the largest one."""
UTILISATION = 1.0 / math.sqrt(3.0)
"""Largest phase voltage amplitude over the DC link where no machine file says it."""
DURATION_S = 600.0
"""Longest time the machine is energised."""
NO_RESISTANCE = "the inverter's error at running currents hides it on this drive; needs current set-points"
NO_POWER = "needs a recorder of voltages, or the power of a bench supply at several currents read by a person"
NO_VOLTAGE = "needs injection, or a recorder of voltages at loop rate"
BELOW_VOLTAGE = (
    "needs a speed at which the voltage ends, and none was reached: allow a larger --speed-max, or lower the DC link"
)
NO_POLE_PAIRS = "needs the pole pairs: mode 11, an object in the drive's map, or a machine file"
NO_LINK = "needs the DC link (0x6079) or the machine's voltage"
TOP_SHARE = 0.98
"""Speed at which a run-up is given up, of the largest one."""
OFFSET_LIMIT_RAD = math.radians(2.5)
"""Largest total 95 % half width of an accepted encoder offset; measured: 1.7 deg on nine of ten drives."""
LIMITS: Mapping[str, float] = {
    "R_s_ohm": 0.15, "psi_f_wb": 0.08, "L_q_app_h": 0.15, "J_per_psi": 0.05, "pole_pairs": 0.05,
}  # fmt: skip
"""Largest relative total 95 % half width of an accepted value."""
TOLD_BY = {
    "R": "R_s_ohm", "L": "L_q_app_h", "psi": "psi_f_wb", "encoder": "offset_rad", "poles": "pole_pairs",
    "mechanics": "J_per_psi",
}  # fmt: skip
"""Key of the estimate that answers for a quantity."""
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
            plan = RotationPlan(i_a=share * envelope.i_max_apk / HEADROOM, dwell_s=DWELL_S)
            say(f"pole pairs, direction, offset: one slow turn each way with {plan.i_a:.3g} A")
            traces["rotation_forward"], traces["rotation_backward"] = rotate_vector(guard, plan)
            try:
                found = estimate_encoder(traces["rotation_forward"], traces["rotation_backward"])
                break
            except IdentificationError as error:
                if error.reason not in OFF_THE_VECTOR or share == VECTOR_SHARES[-1]:
                    raise
    return TierResult(encoder_estimates(found, traces), {}, traces)


def identify_by_torque(
    drive: TorqueDrive,
    envelope: Envelope,
    *,
    pole_pairs: int,
    inverter: InverterParameters | None = None,
    tolerance: SensorTolerance | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> TierResult:
    """Push the shaft by torque and poll it; run it up to its voltage, or let it coast; the drive is off on return.

    Parameters
    ----------
    pole_pairs : int
        As measured or given.
    inverter : InverterParameters, optional
        Its voltage utilisation and dead time, where known.

    Raises
    ------
    IdentificationError
        The shaft does not answer; a single quantity that cannot be told is in ``missing``.
    StopNotConfirmed, Interrupted, BusError, DriveFault, LimitExceeded
        As the guard ends the experiment.
    """
    traces: dict[str, Trace] = {}
    top = None
    largest = envelope.speed_max_rad_s
    plan = PolledPushPlan(envelope.i_max_apk / HEADROOM, SWING_SHARE * largest, TOP_SHARE * largest)
    shows_voltage = all(name in drive.node.map.signals for name in ("u_d_v", "u_q_v"))
    shows_link = _shows_link(drive)
    with guarded(drive, envelope, say=say) as guard:
        guard.enable()
        say(f"J/psi, tau_c/psi: torque pushes up to {max(plan.shares) * plan.i_test_a:.3g} A, polled")
        rate = push_both_ways(guard, plan, traces.__setitem__)
        pushes = list(traces.values())
        if shows_voltage:
            say("psi: the voltage of the coasting machine")
            coast_both_ways(guard, plan, rate, ("theta_m_rad", "u_d_v", "u_q_v"), traces.__setitem__)
        elif shows_link:
            say("psi: the speed at which the voltage ends")
            top = run_to_voltage(guard, plan, rate)
    if top is not None:
        traces["voltage_limit"] = top
    known = {"pole_pairs": pole_pairs, "tolerance": tolerance}
    estimates = dict(estimate_ratios(pushes, **known))  # type: ignore[arg-type]
    missing = {"R_s_ohm": NO_POWER, "L_d_h, L_q_h": NO_VOLTAGE}
    try:
        if shows_voltage:
            coasts = [traces[name] for name in traces if name.startswith("coast")]
            estimates["psi_f_wb"] = flux_by_undriven_voltage(coasts, **known)  # type: ignore[arg-type]
        elif top is not None:
            estimates["psi_f_wb"] = _at_the_limit(top, inverter, **known)  # type: ignore[arg-type]
        else:
            missing["psi_f_wb"] = BELOW_VOLTAGE if shows_link else NO_LINK
    except IdentificationError as error:
        missing["psi_f_wb"] = error.what
    return TierResult(estimates, missing, traces)


def _at_the_limit(
    top: Trace, inverter: InverterParameters | None, *, pole_pairs: int, tolerance: SensorTolerance | None
) -> Estimate:
    utilisation = UTILISATION if inverter is None else inverter.voltage_utilisation
    share = None if inverter is None or not inverter.dead_time_s else inverter.dead_time_s / inverter.T_s
    return flux_by_voltage_limit(
        top, pole_pairs=pole_pairs, utilisation=utilisation, dead_time_share=share, tolerance=tolerance
    )


def _shows_link(drive: TorqueDrive) -> bool:
    try:
        return drive.live("U_dc_v") > 0.0
    except NotAvailable:
        return False


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
        say(f"R, psi, L_q, J: {4 * len(plan.shares)} recorded torque pushes up to {plan.i_test_a:.3g} A")
        swing(guard, plan, traces.__setitem__)
    pushes = list(traces.values())
    found = estimate_pushes(pushes, period_s=drive.period_s, pole_pairs=pole_pairs, tolerance=tolerance)
    estimates = push_estimates(found, _temperature(drive, "T_winding_c"), _temperature(drive, "T_magnet_c"))
    missing = {} if "R_s_ohm" in estimates else {"R_s_ohm": NO_RESISTANCE}
    try:
        estimates |= estimate_ratios(pushes, pole_pairs=pole_pairs, tolerance=tolerance)
    except IdentificationError as error:
        missing["J_per_psi"] = error.what
    return TierResult(estimates, missing, traces)


def _temperature(drive: RecorderDrive, name: str) -> float:
    """Return what the drive shows for winding or magnets (degC), NaN where it shows nothing."""
    try:
        return float(drive.live(name))
    except SdoAbort:
        return math.nan


def push_estimates(
    found: PushResult, T_winding_c: float = math.nan, T_magnet_c: float = math.nan
) -> dict[str, Estimate]:
    """Return what the pushes told by the keys of a machine file; R only where the inverter's error does not hide it."""
    told = {
        "psi_f_wb": replace(found.psi_f, T_c=T_magnet_c),
        "L_q_app_h": found.L_q,
        "frame_offset_rad": found.frame_offset,
    }
    return told if found.R is None else {"R_s_ohm": replace(found.R, T_c=T_winding_c), **told}


def tier_envelope(drive: CanopenDrive, request: IdentifyRequest, known: MachineFile | None = None) -> Envelope:
    """Return the motion envelope: what the request says, else the least of the drive's ratings and the machine's.

    Raises
    ------
    ConfigError
        The drive's largest speed is no limit, and none was given.
    """
    rated_apk = 1e-3 * math.sqrt(2.0) * drive.node.get(objects.RATED_CURRENT_MA)
    rpm = drive.node.get(objects.MAX_SPEED_RPM)
    if known is not None:
        rated_apk = min(rated_apk, known.machine.I_nom_apk or math.inf)
        rpm = min(rpm, known.machine.n_max_rpm or math.inf)
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


def can_measure(drive: CanopenDrive, found: Capabilities, known: MachineFile | None = None) -> list[str]:
    """Return what the tier's experiments tell, one line each; empty when nothing can be measured.

    Parameters
    ----------
    known : MachineFile, optional
        What is given; torque pushes need the pole pairs from it, from mode 11 or from the drive's map.
    """
    if isinstance(drive, RecorderDrive):
        return ["R, psi, L_q, J, tau_c from recorded torque pushes"]
    lines = []
    turns = found.row("poles", Method.STANDARD).available
    if turns:
        lines.append("pole pairs, direction, offset from a vector turned by the commutation angle")
    pole_pairs = turns or known is not None or "motor.pole_pairs" in found.drive_map.cells
    if pole_pairs and found.row("mechanics", Method.STANDARD).available:
        lines.append("J/psi, tau_c/psi from polled torque pushes, psi from the voltage limit or the coasting machine")
    return lines


def tier_stage(
    run: RunDirectory,
    drive: CanopenDrive,
    found: Capabilities,
    request: IdentifyRequest,
    allow_motion: Callable[[Sequence[str]], None],
    say: Callable[[str], None],
    *,
    known: tuple[MachineFile, str] | None = None,
) -> Stage:
    """Run the tier's experiments, keep their traces, and write the machine file where it is whole.

    Parameters
    ----------
    drive : CanopenDrive
        A ``RecorderDrive``, or a drive of the standard tier.
    found : Capabilities
        What it has.
    request : IdentifyRequest
        ``poles`` or ``encoder`` asks for the turned vector, ``psi`` or ``mechanics`` for torque pushes.
    known : MachineFile and its source, optional
        What completes the measured values.

    Raises
    ------
    NotAvailable
        The shaft is locked, the pole pairs are not known, or nothing of what was asked could be told.
    Declined
        The person did not consent; nothing was moved.
    IdentificationError, StopNotConfirmed, Interrupted, BusError, DriveFault, LimitExceeded
        As the experiments end.
    """
    if request.shaft == "locked":
        raise NotAvailable("without injection the rotor must turn, and the shaft is locked", hint="free the shaft")
    envelope = tier_envelope(drive, request, None if known is None else known[0])
    envelope.refuse_gravity()
    moves = can_measure(drive, found, None if known is None else known[0])
    if not moves:
        raise NotAvailable(NO_POLE_PAIRS, where=f"node {drive.node.node}", hint="give a machine file")
    allow_motion([*envelope.lines(), *moves, "nothing is stored in the drive; every changed object is restored"])
    clock = drive.node.connection.clock
    start = clock.now()
    if isinstance(drive, RecorderDrive):
        result = identify_recorder(drive, envelope, tolerance=request.tolerance, say=say)
    else:
        result = _standard(drive, found, request, envelope, known, say)
    for name, trace in result.traces.items():
        run.save(f"traces/{name}.npz", trace_npz(trace))
    if not any(TOLD_BY.get(name) in result.estimates for name in request.quantities):
        reasons = [f"{name}: not available: {why}" for name, why in result.missing.items()]
        raise NotAvailable("\n  - ".join(["nothing of what was asked could be told", *reasons]), where=str(run.path))
    made = tier_machine(None if known is None else known[0], result.estimates, "" if known is None else known[1])
    files = {f"traces/{name}.npz": "" for name in result.traces}
    if made.machine is not None:
        run.save(MACHINE, dump_machine_file(made.machine))
        files[MACHINE] = ""
    return replace(_judged(result, made, "" if known is None else known[1]), seconds=clock.now() - start, files=files)


def _judged(result: TierResult, made: TierMachine, source: str) -> Stage:
    criteria = [*(_accepted(name, e) for name, e in result.estimates.items() if _limit(name)), *made.criteria]
    values = [value_facts(name, estimate) for name, estimate in result.estimates.items()]
    summary = ", ".join(
        f"{name} {format_estimate(e.value, total_half_width(e), e.unit)}" for name, e in result.estimates.items()
    )
    note = "a part of the machine only, at the temperature of the run: no machine file is written"
    return Stage(
        "identify",
        "pass" if all(line.ok for line in criteria) else "fail",
        0.0,
        values=[*values, *made.given_values(source)],
        acceptance=criteria,
        fallbacks=[*(f"{name}: not available: {why}" for name, why in result.missing.items()), *made.notes],
        note=note if made.machine is None else "",
        summary=summary + (f"; {source}: {', '.join(made.given)}" if made.given else ""),
    )


def _limit(name: str) -> float:
    return OFFSET_LIMIT_RAD if name == "offset_rad" else LIMITS.get(name, 0.0)


def _accepted(name: str, estimate: Estimate) -> Acceptance:
    half, limit, what = total_half_width(estimate), _limit(name), f"{name}: total 95 % interval"
    if name == "offset_rad":
        return Acceptance(what, f"{math.degrees(half):.3g} deg", f"{math.degrees(limit):.3g} deg", half <= limit)
    share = half / abs(estimate.value)
    return Acceptance(what, f"{100.0 * share:.2g} %", f"{100.0 * limit:.2g} %", share <= limit)


def _standard(
    drive: CanopenDrive,
    found: Capabilities,
    request: IdentifyRequest,
    envelope: Envelope,
    known: tuple[MachineFile, str] | None,
    say: Callable[[str], None],
) -> TierResult:
    """Turn the vector where the drive takes an angle, then push by torque, with the pole pairs that are then known."""
    connection, node = drive.node.connection, drive.node.node
    result = TierResult({}, {}, {})
    asked = set(request.quantities)
    if asked & {"poles", "encoder"} and found.row("poles", Method.STANDARD).available:
        turning = drive if type(drive) is StandardDrive else StandardDrive(connection, node, drive_map=found.drive_map)
        result = identify_standard(turning, envelope, say)
    if not asked & {"psi", "mechanics"} or not found.row("mechanics", Method.STANDARD).available:
        return result
    pole_pairs = _pole_pairs(result, drive, known)
    if not pole_pairs:
        return replace(result, missing={**result.missing, "J_per_psi, psi_f_wb": NO_POLE_PAIRS})
    pushing = TorqueDrive(connection, node, drive_map=found.drive_map)
    inverter = None if known is None else known[0].inverter
    try:
        pushed = identify_by_torque(
            pushing, envelope, pole_pairs=pole_pairs, inverter=inverter, tolerance=request.tolerance, say=say
        )
    finally:
        drive.may_be_energised = drive.may_be_energised or pushing.may_be_energised
        pushing.close()
    return TierResult(
        {**result.estimates, **pushed.estimates}, {**result.missing, **pushed.missing},
        {**result.traces, **pushed.traces},
    )  # fmt: skip


def _pole_pairs(result: TierResult, drive: CanopenDrive, known: tuple[MachineFile, str] | None) -> int:
    """Return the pole pairs: measured, else given, else what the maker's set-up left in the drive; 0 when unknown."""
    if "pole_pairs" in result.estimates:
        return round(result.estimates["pole_pairs"].value)
    if known is not None:
        return known[0].machine.pole_pairs
    if "motor.pole_pairs" in drive.node.map.cells:
        return round(drive.parameters.read_value("motor.pole_pairs"))
    return 0
