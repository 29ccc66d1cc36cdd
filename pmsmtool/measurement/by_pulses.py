# SPDX-License-Identifier: MIT
"""Identification on drives without injection: what CiA 402 alone gives, and what a recorder adds.

``standard``: pole pairs, direction and encoder offset from a vector turned by the commutation angle 0x60EA; inertia and
friction over the flux linkage from torque pushes; the flux linkage from the voltage of the coasting machine where the
drive shows it, else from the speed at which the voltage ends.
``recorder``: resistance, flux linkage, L_q and inertia from recorded torque pulses.

What the traces say is decided in ``identification/by_pulses``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from pmsmtool.cia402 import HOMING_LOST, LEAST_LINK_V
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.changed_objects import refuse_no_current
from pmsmtool.drive.envelope import OFF_S, Envelope, largest_acceleration, voltage_speed
from pmsmtool.drive.guard import OVERSHOOT, GuardedDrive, guarded
from pmsmtool.drive.motion_objects import allowed, held_current_limits, rated_apk, speed_limits, trips_itself
from pmsmtool.drive.standard_drive import RecorderDrive, StandardDrive, TorqueCurrent
from pmsmtool.drive.torque_drives import SpeedPushDrive, TorqueDrive, pushing_drive
from pmsmtool.drive_maps.drive_map import DriveMap
from pmsmtool.errors import ConfigError, IdentificationError, NotAvailable, PmsmtoolError, SdoAbort
from pmsmtool.estimators.encoder import estimate_encoder
from pmsmtool.experiments.current_limit import LimitShown, require_limit, show_torque_limit, unproven
from pmsmtool.experiments.mechanics_run import ShaftAnswer
from pmsmtool.experiments.polled_push import (
    PolledPushPlan,
    PushPlan,
    coast_both_ways,
    push_both_ways,
    run_to_voltage,
    swing,
)
from pmsmtool.experiments.rotation import STEP_RAD, RotationPlan, dwell_within, lead_onto_vector, rotate_vector
from pmsmtool.experiments.standstill import LEVELS, hold_supply_levels
from pmsmtool.identification.by_pulses import (
    BY_PUSH,
    FACTS,
    NO_POLE_PAIRS,
    SUPPLY_LEVELS,
    PulseFacts,
    Voltage,
    dump_facts,
    evaluated_stage,
    no_link,
    why_no_push,
)
from pmsmtool.identification.request import IdentifyRequest, Method
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.measurement.capabilities import QUANTITIES, UNDECIDED, Capabilities
from pmsmtool.measurement.limits import DURATION_S, Keep, Say, Task
from pmsmtool.run_directory import Stage
from pmsmtool.trace import Trace
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


def turn_both_ways(drive: StandardDrive, envelope: Envelope, keep: Keep, say: Say) -> PulseFacts:
    """Turn a current vector through one mechanical turn each way; the drive is off on return.

    Raises IdentificationError: a trap was seen; no number is given; StopNotConfirmed, Interrupted, BusError,
    DriveFault, LimitExceeded: as the guard ends the experiment.
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
    return PulseFacts(Method.STANDARD)


def push_by_torque(drive: TorqueDrive, envelope: Envelope, keep: Keep, say: Say) -> PulseFacts:
    """Push the shaft by torque and poll it; run it up to its voltage, or let it coast; the drive is off on return.

    Raises IdentificationError: the shaft does not answer; StopNotConfirmed, Interrupted, BusError, DriveFault,
    LimitExceeded: as the guard ends the experiment.
    """
    largest = envelope.speed_max_rad_s
    plan = PolledPushPlan(
        envelope.i_max_apk / HEADROOM, SWING_SHARE * largest, TOP_SHARE * largest,
        omega_failure_rad_s=OVERSHOOT * largest, off_s=OFF_S,
    )  # fmt: skip
    shows_voltage = _shows_voltage(drive.node.map)
    drive.top_rad_s = ASKED_SHARE * largest
    limit: list[str] = []
    with guarded(drive, envelope, say=say) as guard:
        guard.enable()
        U_dc = _link_v(drive)
        if 0.0 < U_dc < LEAST_LINK_V:
            say(no_link(U_dc))
        say(f"J/psi, tau_c/psi: torque pulses up to {max(plan.shares) * plan.i_test_a:.3g} A, polled")

        def answered(answer: ShaftAnswer) -> None:
            if not isinstance(drive, SpeedPushDrive):  # its limit is the push
                limit.append(unproven(show_limit(guard, answer, min(plan.i_test_a, plan.most_a(answer, 0.0)), say)))

        answer = push_both_ways(guard, plan, keep, answered)
        if shows_voltage:
            say("psi: the voltage of the coasting machine")
            coast_both_ways(guard, plan, answer, ("theta_m_rad", "u_d_v", "u_q_v"), keep)
        elif U_dc >= LEAST_LINK_V:
            say("psi: the speed at which the voltage ends")
            top = run_to_voltage(guard, plan, answer)
            if top is not None:
                keep("voltage_limit", top)
    voltage: Voltage = "machine" if shows_voltage else "link" if U_dc >= LEAST_LINK_V else ""
    return PulseFacts(
        Method.STANDARD, pushed=True, voltage=voltage, top_rpm=plan.omega_top_rad_s / RAD_S_PER_RPM,
        U_dc_v=max(0.0, U_dc), current_undecided=drive.current_undecided, limit="".join(limit),
    )  # fmt: skip


def _shows_voltage(drive_map: DriveMap) -> bool:
    return {"u_d_v", "u_q_v"} <= set(drive_map.signals)


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


def swing_and_record(drive: RecorderDrive, envelope: Envelope, keep: Keep, say: Say) -> PulseFacts:
    """Swing the shaft by torque pushes and record them; the drive is off on return.

    Raises IdentificationError: a trap was seen; no number is given; StopNotConfirmed, Interrupted, BusError,
    DriveFault, LimitExceeded: as the guard ends the experiment.
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
    return PulseFacts(
        Method.RECORDER, drive.period_s, pole_pairs, T_winding_c, T_magnet_c, limit="".join(limit),
    )  # fmt: skip


def _temperature(drive: RecorderDrive, name: str) -> float | None:
    """Return what the drive shows for winding or magnets (degC), None where it shows nothing."""
    try:
        shown = float(drive.live(name))
    except SdoAbort:
        return None
    return shown if math.isfinite(shown) else None


def envelope_of(drive: CanopenDrive, request: IdentifyRequest, known: MachineFile | None = None) -> Envelope:
    """Return the motion envelope: what the request says, else the least of the drive's ratings and the machine's.

    Raises ConfigError: the drive's largest speed is no limit, and none was given; SafetyRefusal: the drive allows no
    current.
    """
    node = drive.node
    rated = rated_apk(node)
    kept = [apk for _, apk in held_current_limits(node, rated)]  # what the drive allows now is not raised
    rated = min([rated, *(apk / HEADROOM for apk in (*kept, drive.shows_apk))])
    speed = allowed(node, speed_limits(node))
    rpm = (drive.parameters.held_value("motor.n_max_rpm") or UNLIMITED_RPM) if speed is None else speed[1]
    if known is not None:
        rated = min(rated, known.machine.I_nom_apk or math.inf)
        rpm = min(rpm, known.machine.top_rpm or math.inf)
    if request.speed_max_rad_s is None and rpm > NO_LIMIT_RPM:
        raise ConfigError(
            f"the drive's largest speed (0x6080) is {rpm:.0f} rpm: that is no limit", hint="give --speed-max"
        )
    i_max = HEADROOM * rated if request.i_max_apk is None else request.i_max_apk
    refuse_no_current(node, i_max)
    return Envelope(
        i_max_apk=i_max,
        speed_max_rad_s=rpm * RAD_S_PER_RPM if request.speed_max_rad_s is None else request.speed_max_rad_s,
        duration_s=DURATION_S,
        shaft=request.shaft,
        load=request.load,
        brake=request.brake,
        acceleration_rad_s2=None if known is None else largest_acceleration(known.machine, i_max),
        voltage_speed_rad_s=math.inf if known is None else voltage_speed(known, i_max),
    )


def measurable(
    method: Method, found: Capabilities, known: MachineFile | None = None, asked: Sequence[str] = QUANTITIES
) -> list[str]:
    """Return what the experiments of a method identify, one line each; empty when nothing can be measured.

    Parameters
    ----------
    method : Method
        Recorder or standard.
    known : MachineFile, optional
        What is given; torque pulses need the pole pairs from it, from mode 11 or from the drive's map.
    asked : sequence of str
        Quantities.
    """
    if method is Method.RECORDER:
        return ["R, psi, L_q, J, tau_c from recorded torque pulses"]
    lines = []
    turns = found.row("poles", method).available
    if turns and {"poles", "encoder"} & set(asked):
        lines.append("pole pairs, direction, offset from a vector turned by the commutation angle")
    pole_pairs = turns or known is not None or "motor.pole_pairs" in found.drive_map.cells
    available = found.row("mechanics", method).available
    if available and pole_pairs and {"psi", "mechanics"} & set(asked):
        psi = "no psi: it shows no voltage"
        if _shows_voltage(found.drive_map):
            psi = "psi from the voltage of the coasting machine"
        elif found.row("psi", method).available:
            psi = "psi where the speed at the voltage limit is reached"
        doubt = f" ({UNDECIDED}, a map of your own may say it: rated_current)" if found.current_undecided else ""
        lines.append(f"J/psi, tau_c/psi from polled torque pulses{doubt}; {psi}")
    elif available and "mechanics" in asked:
        lines.append(OVER_TORQUE_CONSTANT)
    return lines


# ---- the rows of the table of methods ---------------------------------------------------------------


def plan_recorded(task: Task) -> tuple[Envelope, list[str]]:
    """Return envelope and plan of the recorded torque pulses; refuses a locked shaft."""
    return _plan(task, measurable(Method.RECORDER, task.found))


def plan_polled(task: Task) -> tuple[Envelope, list[str]]:
    """Return envelope and plan of the standard method; refuses a locked shaft and what cannot be measured."""
    lines = measurable(Method.STANDARD, task.found, task.machine, task.request.quantities)
    if task.read_supply is not None and task.found.row("R", Method.STANDARD).available:
        lines.append(f"R from the power of a bench supply, read {len(LEVELS)} times")
    return _plan(task, lines)


def _plan(task: Task, lines: Sequence[str]) -> tuple[Envelope, list[str]]:
    if task.request.shaft == "locked":
        raise NotAvailable("without injection the rotor must turn, and the shaft is locked", hint="free the shaft")
    envelope = envelope_of(task.drive, task.request, task.machine)
    envelope.refuse_gravity()
    if not lines:
        raise NotAvailable(
            NO_POLE_PAIRS,
            where=f"node {task.drive.node.node}",
            hint="`pmsmtool commission MACHINE` takes them from a machine file (`pmsmtool machine new` writes one)",
        )
    moved = f"the shaft does not come back to where it stood: {HOMING_LOST}"
    return envelope, [*task.found.replaced, *lines, moved]


def measure_recorded(task: Task, envelope: Envelope, keep: Keep, say: Say) -> PulseFacts:
    """Swing the shaft by recorded torque pulses."""
    assert isinstance(task.drive, RecorderDrive)
    names: dict[str, None] = {}
    facts = swing_and_record(task.drive, envelope, _noting(names, keep), say)
    return _facts(task, facts, names)


def measure_polled(task: Task, envelope: Envelope, keep: Keep, say: Say) -> PulseFacts:
    """Turn the vector where the drive takes an angle, then push by torque where the pole pairs are then known.

    Where something ends the run, the facts of what was measured before are kept for its evaluation.
    """
    names: dict[str, None] = {}
    try:
        return _facts(task, _measure_polled(task, envelope, _noting(names, keep), say, names), names)
    except (IdentificationError, NotAvailable):
        raise
    except PmsmtoolError as error:
        if names:
            facts = PulseFacts(Method.STANDARD, pole_pairs=_given_pole_pairs(task), no_push=why_no_push(error))
            task.run.save(FACTS, dump_facts(_facts(task, facts, names)))
        raise


def _measure_polled(task: Task, envelope: Envelope, keep: Keep, say: Say, names: Mapping[str, None]) -> PulseFacts:
    drive, found = task.drive, task.found
    assert isinstance(drive, StandardDrive)
    facts = PulseFacts(Method.STANDARD, pole_pairs=_given_pole_pairs(task))
    asked = set(task.request.quantities)
    turns = bool(asked & {"poles", "encoder"}) and found.row("poles", Method.STANDARD).available
    if task.read_supply is not None and "R" in asked and found.row("R", Method.STANDARD).available:
        i_a = envelope.i_max_apk / HEADROOM
        keep(SUPPLY_LEVELS, hold_supply_levels(drive, envelope, i_a, task.read_supply, say))
    if turns:
        try:
            turn_both_ways(drive, envelope, keep, say)
        except NotAvailable as refused:  # announced in 0x6502, and refused when it is asked for
            if not asked & {"psi", "mechanics"}:
                raise
            turns, facts = False, replace(facts, no_vector=f"{refused.what}, which 0x6502 announces")
            say(f"pole pairs, direction, offset: not available: {facts.no_vector}")
    told = {"psi", "mechanics"} if turns or facts.pole_pairs else {"mechanics"}
    if asked & told and found.row("mechanics", Method.STANDARD).available:
        pushing = pushing_drive(drive.node.connection, drive.node.node, found.drive_map)
        try:
            pushed = push_by_torque(pushing, envelope, keep, say)
            facts = replace(pushed, pole_pairs=facts.pole_pairs, no_vector=facts.no_vector)
        except IdentificationError as error:
            if not {SUPPLY_LEVELS, "rotation_backward"} & set(names):
                raise
            facts = replace(facts, no_push=why_no_push(error))
            say(f"{BY_PUSH}: not available: {facts.no_push}")
        finally:
            drive.may_be_energised = drive.may_be_energised or pushing.may_be_energised
            pushing.close()
    return facts


def evaluate(task: Task, facts: PulseFacts) -> Stage:
    """Evaluate what is stored in the run."""
    task.run.save(FACTS, dump_facts(facts))
    return evaluated_stage(task.run, facts, task.request, task.machine)


def _noting(names: dict[str, None], keep: Keep) -> Keep:
    """Return what keeps a trace and notes its name, in the order they are taken."""

    def noted(name: str, trace: Trace) -> None:
        keep(name, trace)
        names[name] = None

    return noted


def _facts(task: Task, facts: PulseFacts, names: dict[str, None]) -> PulseFacts:
    return replace(facts, source="" if task.known is None else task.known[1], traces=tuple(names))


def _given_pole_pairs(task: Task) -> int:
    """Return the pole pairs as given, else as the maker's set-up left them in the drive; 0 when neither has them."""
    if task.machine is not None:
        return task.machine.machine.pole_pairs
    return round(task.drive.parameters.held_value("motor.pole_pairs") or 0.0)
