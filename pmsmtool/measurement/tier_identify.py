# SPDX-License-Identifier: MIT
"""Identification on drives without injection: what CiA 402 alone gives, and what a recorder adds.

``standard``: pole pairs, direction and encoder offset from a vector turned by the commutation angle 0x60EA; inertia and
friction over the flux linkage from torque pushes; the flux linkage from the voltage of the coasting machine where the
drive shows it, else from the speed at which the voltage ends.
``recorder``: resistance, flux linkage, L_q and inertia from recorded torque pulses.

What the traces tell is decided in ``tier_evaluate``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

from pmsmtool.cia402 import HOMING_LOST
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.envelope import OFF_S, Envelope, largest_acceleration
from pmsmtool.drive.guard import OVERSHOOT, GuardedDrive, guarded
from pmsmtool.drive.motion_objects import allowed, current_limits, rated_apk, speed_limits, trips_itself
from pmsmtool.drive.standard_drive import RecorderDrive, StandardDrive, TorqueCurrent
from pmsmtool.drive.tier_drives import SpeedPushDrive, TorqueDrive, pushing_drive
from pmsmtool.errors import ConfigError, IdentificationError, NotAvailable, SafetyRefusal, SdoAbort
from pmsmtool.estimators.encoder import estimate_encoder
from pmsmtool.experiments.current_limit import LimitShown, require_limit, show_torque_limit, unproven
from pmsmtool.experiments.polled_push import PolledPushPlan, coast_both_ways, push_both_ways, run_to_voltage
from pmsmtool.experiments.recorded_push import PushPlan, swing
from pmsmtool.experiments.rotation import STEP_RAD, RotationPlan, dwell_within, rotate_vector
from pmsmtool.experiments.shaft_answer import ShaftAnswer
from pmsmtool.experiments.supply_levels import LEVELS, ReadSupply, hold_supply_levels
from pmsmtool.experiments.vector_turn import lead_onto_vector
from pmsmtool.identification.request import REQUEST, IdentifyRequest, dump_request
from pmsmtool.identification.tier_evaluate import (
    FACTS,
    NO_POLE_PAIRS,
    SUPPLY_LEVELS,
    TierFacts,
    Voltage,
    dump_facts,
    evaluated_stage,
)
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.measurement.capabilities import QUANTITIES, Capabilities, Method
from pmsmtool.measurement.limits import DURATION_S
from pmsmtool.run_directory import RunDirectory, Stage
from pmsmtool.trace import Trace
from pmsmtool.trace_file import trace_npz
from pmsmtool.units import RAD_S_PER_RPM

TURNS = ((0.35, 0.035), (0.7, 0.08))
"""Current, of the test current, and time per ``STEP_RAD`` (s) of every try, besides that of looks at the encoder. Six
times per electrical turn a phase current passes zero, and the inverter's dead time kicks the rotor: a vector turned at
a sixth of a rotor's swing drives it to 90 degrees. The first try kicks at 5 Hz, below the swing of most (3 to 17 Hz),
the second at 3 Hz, where that of every one is above 4: friction takes more of a swing that outruns a slower vector."""
STEP_PARTS = 3
"""Parts of that step: 15 deg every 36 ms kept rotors of random drives swinging by 10 deg, 5 deg every 12 ms by 4."""
OFF_THE_VECTOR = ("E_ROTOR_MOVED", "E_POLE_PAIRS")
SWING_SHARE = 0.4
"""Speed of the recorded pushes, of the largest one."""
ASKED_SHARE = 0.75
"""Speed that a drive without a torque mode is asked for, of the largest: above the pushes, with room to overshoot."""
TOP_SHARE = 0.98
"""Speed at which a run-up is given up, of the largest one."""
NO_LIMIT_RPM = 100_000.0
OVER_TORQUE_CONSTANT = "J/K_T, tau_c/K_T from polled torque pulses; J/psi and psi need the pole pairs"
"""What is told without pole pairs: nothing a design goes on from."""
UNLIMITED_RPM = 1000.0
"""Largest speed on a drive that has no limit of its own and tells none, unless a person or a machine file says more."""
HEADROOM = 1.2
"""Largest current of the envelope over the test current."""
RPM = RAD_S_PER_RPM
Keep = Callable[[str, Trace], None]
Say = Callable[[str], None]


def turn_both_ways(drive: StandardDrive, envelope: Envelope, keep: Keep, say: Say) -> TierFacts:
    """Turn a current vector through one mechanical turn each way; the drive is off on return.

    Raises
    ------
    IdentificationError
        A trap was seen; no number is given.
    StopNotConfirmed, Interrupted, BusError, DriveFault, LimitExceeded
        As the guard ends the experiment.
    """
    with guarded(drive, envelope, say=say) as guard:
        guard.enable()
        for share, dwell_s in TURNS:
            part_s = dwell_within(dwell_s, envelope.speed_max_rad_s) / STEP_PARTS
            plan = RotationPlan(share * envelope.i_max_apk / HEADROOM, STEP_RAD / STEP_PARTS, part_s)
            say(f"pole pairs, direction, offset: one slow turn each way with {plan.i_a:.3g} A")
            lead_onto_vector(guard, plan.i_a, 0.0)
            forward, backward = rotate_vector(guard, plan)
            keep("rotation_forward", forward)
            keep("rotation_backward", backward)
            try:
                estimate_encoder(forward, backward)
                break
            except IdentificationError as error:
                if error.reason not in OFF_THE_VECTOR or share == TURNS[-1][0]:
                    raise
    return TierFacts("standard")


def push_by_torque(drive: TorqueDrive, envelope: Envelope, keep: Keep, say: Say) -> TierFacts:
    """Push the shaft by torque and poll it; run it up to its voltage, or let it coast; the drive is off on return.

    Raises
    ------
    IdentificationError
        The shaft does not answer.
    StopNotConfirmed, Interrupted, BusError, DriveFault, LimitExceeded
        As the guard ends the experiment.
    """
    largest = envelope.speed_max_rad_s
    plan = PolledPushPlan(
        envelope.i_max_apk / HEADROOM, SWING_SHARE * largest, TOP_SHARE * largest,
        omega_failure_rad_s=OVERSHOOT * largest, off_s=OFF_S,
    )  # fmt: skip
    shows_voltage = all(name in drive.node.map.signals for name in ("u_d_v", "u_q_v"))
    U_dc = _link_v(drive)
    drive.top_rad_s = ASKED_SHARE * largest
    limit: list[str] = []
    with guarded(drive, envelope, say=say) as guard:
        guard.enable()
        say(f"J/psi, tau_c/psi: torque pulses up to {max(plan.shares) * plan.i_test_a:.3g} A, polled")

        def answered(answer: ShaftAnswer) -> None:
            if not isinstance(drive, SpeedPushDrive):  # its limit is the push
                limit.append(unproven(show_limit(guard, answer, min(plan.i_test_a, plan.most_a(answer, 0.0)), say)))

        answer = push_both_ways(guard, plan, keep, answered)
        if shows_voltage:
            say("psi: the voltage of the coasting machine")
            coast_both_ways(guard, plan, answer, ("theta_m_rad", "u_d_v", "u_q_v"), keep)
        elif U_dc > 0.0:
            say("psi: the speed at which the voltage ends")
            top = run_to_voltage(guard, plan, answer)
            if top is not None:
                keep("voltage_limit", top)
    voltage: Voltage = "machine" if shows_voltage else "link" if U_dc > 0.0 else ""
    return TierFacts(
        "standard", pushed=True, voltage=voltage, top_rpm=plan.omega_top_rad_s / RPM, U_dc_v=max(0.0, U_dc),
        current_undecided=drive.current_undecided, limit="".join(limit),
    )  # fmt: skip


def show_limit(guard: GuardedDrive, answer: ShaftAnswer, most_a: float, say: Say) -> LimitShown | None:
    """Say whether the drive keeps its own current limit, asked for at most a torque current (A peak)."""
    shown = show_torque_limit(guard, guard.limit_current, answer, most_a)
    say(unproven(shown) or str(shown))
    return shown


def _link_v(drive: TorqueCurrent) -> float:
    """Return the DC link (V), 0 where the drive does not show it."""
    try:
        return drive.live("U_dc_v")
    except NotAvailable:
        return 0.0


def swing_and_record(drive: RecorderDrive, envelope: Envelope, keep: Keep, say: Say) -> TierFacts:
    """Swing the shaft by torque pushes and record them; the drive is off on return.

    Raises
    ------
    IdentificationError
        A trap was seen; no number is given.
    StopNotConfirmed, Interrupted, BusError, DriveFault, LimitExceeded
        As the guard ends the experiment.
    """
    pole_pairs = round(drive.read("motor.pole_pairs"))
    U_dc = _link_v(drive)
    plan = PushPlan(
        envelope.i_max_apk / HEADROOM,
        SWING_SHARE * envelope.speed_max_rad_s,
        u_max_v=U_dc / math.sqrt(3.0) if U_dc > 0.0 else math.inf,
        i_max_a=envelope.i_max_apk,
        omega_failure_rad_s=math.inf if trips_itself(drive.node) else OVERSHOOT * envelope.speed_max_rad_s,
        off_s=OFF_S,
    )
    limit: list[str] = []
    with guarded(drive, envelope, say=say) as guard:
        guard.enable()
        say(f"R, psi, L_q, J: {4 * len(plan.shares)} recorded torque pulses up to {plan.i_test_a:.3g} A")

        def answered(answer: ShaftAnswer) -> None:
            most = min(plan.i_test_a, answer.most_a(plan.omega_failure_rad_s, plan.off_s))
            shown = show_limit(guard, answer, most, say)
            require_limit(shown)
            limit.append(unproven(shown))

        swing(guard, plan, keep, answered)
    T_winding_c, T_magnet_c = (_temperature(drive, name) for name in ("T_winding_c", "T_magnet_c"))
    return TierFacts(
        "recorder", drive.period_s, pole_pairs, T_winding_c, T_magnet_c, limit="".join(limit),
    )  # fmt: skip


def _temperature(drive: RecorderDrive, name: str) -> float | None:
    """Return what the drive shows for winding or magnets (degC), None where it shows nothing."""
    try:
        shown = float(drive.live(name))
    except SdoAbort:
        return None
    return shown if math.isfinite(shown) else None


def tier_envelope(drive: CanopenDrive, request: IdentifyRequest, known: MachineFile | None = None) -> Envelope:
    """Return the motion envelope: what the request says, else the least of the drive's ratings and the machine's.

    Raises
    ------
    ConfigError
        The drive's largest speed is no limit, and none was given.
    SafetyRefusal
        The drive allows no current.
    """
    node = drive.node
    rated = rated_apk(node)
    for limit in current_limits(node, rated):  # what the drive allows now is not raised
        held = allowed(node, iter((limit,)))
        rated = rated if held is None else min(rated, held[1] / HEADROOM)
    speed = allowed(node, speed_limits(node))
    if speed is not None:
        rpm = speed[1]
    elif "motor.n_max_rpm" in node.map.cells:
        rpm = drive.parameters.read_value("motor.n_max_rpm")
    else:
        rpm = UNLIMITED_RPM
    if known is not None:
        rated = min(rated, known.machine.I_nom_apk or math.inf)
        rpm = min(rpm, known.machine.n_max_rpm or math.inf)
    if request.speed_max_rad_s is None and rpm > NO_LIMIT_RPM:
        raise ConfigError(
            f"the drive's largest speed (0x6080) is {rpm:.0f} rpm: that is no limit", hint="give --speed-max"
        )
    i_max = HEADROOM * rated if request.i_max_apk is None else request.i_max_apk
    if not i_max > 0.0:
        raise SafetyRefusal(
            "the drive allows no current: its rated current or one of its limits (0x6073, 0x6072) is 0",
            where=f"node {node.node}", likely="the drive is as it left its factory: the motor is not set up",
            hint="run the maker's own set-up first",
        )  # fmt: skip
    return Envelope(
        i_max_apk=i_max,
        speed_max_rad_s=rpm * RPM if request.speed_max_rad_s is None else request.speed_max_rad_s,
        duration_s=DURATION_S,
        shaft=request.shaft,
        load=request.load,
        brake=request.brake,
        acceleration_rad_s2=None if known is None else largest_acceleration(known.machine, i_max),
    )


def can_measure(
    drive: CanopenDrive,
    found: Capabilities,
    known: MachineFile | None = None,
    asked: Sequence[str] = QUANTITIES,
) -> list[str]:
    """Return what the tier's experiments tell, one line each; empty when nothing can be measured.

    Parameters
    ----------
    known : MachineFile, optional
        What is given; torque pushes need the pole pairs from it, from mode 11 or from the drive's map.
    asked : sequence of str
        Quantities.
    """
    if isinstance(drive, RecorderDrive):
        return ["R, psi, L_q, J, tau_c from recorded torque pulses"]
    lines = []
    turns = found.row("poles", Method.STANDARD).available
    if turns and {"poles", "encoder"} & set(asked):
        lines.append("pole pairs, direction, offset from a vector turned by the commutation angle")
    pole_pairs = turns or known is not None or "motor.pole_pairs" in found.drive_map.cells
    available = found.row("mechanics", Method.STANDARD).available
    if available and pole_pairs and {"psi", "mechanics"} & set(asked):
        lines.append("J/psi, tau_c/psi from polled torque pulses, psi from the voltage limit or the coasting machine")
    elif available and "mechanics" in asked:
        lines.append(OVER_TORQUE_CONSTANT)
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
    read_supply: ReadSupply | None = None,
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
    read_supply : ReadSupply, optional
        Reads the bench supply where R was asked for at the standard tier.

    Raises
    ------
    NotAvailable
        The shaft is locked, the pole pairs are not known, or nothing that was asked for could be identified.
    Declined
        The person did not consent; nothing was moved.
    IdentificationError, StopNotConfirmed, Interrupted, BusError, DriveFault, LimitExceeded
        As the experiments end.
    """
    if request.shaft == "locked":
        raise NotAvailable("without injection the rotor must turn, and the shaft is locked", hint="free the shaft")
    envelope = tier_envelope(drive, request, None if known is None else known[0])
    envelope.refuse_gravity()
    moves = can_measure(drive, found, None if known is None else known[0], request.quantities)
    if read_supply is not None and found.row("R", Method.STANDARD).available:
        moves.append(f"R from the power of a bench supply, read {len(LEVELS)} times")
    if not moves:
        raise NotAvailable(
            NO_POLE_PAIRS,
            where=f"node {drive.node.node}",
            hint="`pmsmtool commission MACHINE` takes them from a machine file (`pmsmtool machine new` writes one)",
        )
    moves.append(f"the shaft does not come back to where it stood: {HOMING_LOST}")
    stored = "nothing is stored in the drive; every changed object is restored"
    allow_motion([*envelope.lines(), *found.replaced, *moves, stored])
    clock = drive.node.connection.clock
    start = clock.now()
    names: dict[str, None] = {}

    def keep(name: str, trace: Trace) -> None:
        run.save(f"traces/{name}.npz", trace_npz(trace))
        names[name] = None

    if isinstance(drive, RecorderDrive):
        facts = swing_and_record(drive, envelope, keep, say)
    else:
        facts = _standard(drive, found, request, envelope, known, keep, say, read_supply)
    facts = replace(facts, source="" if known is None else known[1], traces=tuple(names))
    run.save(REQUEST, dump_request(request))
    run.save(FACTS, dump_facts(facts))
    stage = evaluated_stage(run, facts, request, None if known is None else known[0])
    return replace(stage, seconds=clock.now() - start)


def _standard(
    drive: CanopenDrive,
    found: Capabilities,
    request: IdentifyRequest,
    envelope: Envelope,
    known: tuple[MachineFile, str] | None,
    keep: Keep,
    say: Say,
    read_supply: ReadSupply | None,
) -> TierFacts:
    """Turn the vector where the drive takes an angle, then push by torque where the pole pairs are then known."""
    connection, node = drive.node.connection, drive.node.node
    facts = TierFacts("standard", pole_pairs=_given_pole_pairs(drive, known))
    asked = set(request.quantities)
    turns = bool(asked & {"poles", "encoder"}) and found.row("poles", Method.STANDARD).available
    reads = "R" in asked and found.row("R", Method.STANDARD).available
    if reads or turns:
        turning = drive if type(drive) is StandardDrive else StandardDrive(connection, node, drive_map=found.drive_map)
        if reads and read_supply is not None:
            i_a = envelope.i_max_apk / HEADROOM
            keep(SUPPLY_LEVELS, hold_supply_levels(turning, envelope, i_a, read_supply, say))
        if turns:
            turn_both_ways(turning, envelope, keep, say)
    told = {"psi", "mechanics"} if turns or facts.pole_pairs else {"mechanics"}
    if not asked & told or not found.row("mechanics", Method.STANDARD).available:
        return facts
    pushing = pushing_drive(connection, node, found.drive_map)
    try:
        pushed = push_by_torque(pushing, envelope, keep, say)
    finally:
        drive.may_be_energised = drive.may_be_energised or pushing.may_be_energised
        pushing.close()
    return replace(pushed, pole_pairs=facts.pole_pairs)


def _given_pole_pairs(drive: CanopenDrive, known: tuple[MachineFile, str] | None) -> int:
    """Return the pole pairs as given, else as the maker's set-up left them in the drive; 0 when neither tells them."""
    if known is not None:
        return known[0].machine.pole_pairs
    if "motor.pole_pairs" in drive.node.map.cells:
        return round(drive.parameters.read_value("motor.pole_pairs"))
    return 0
