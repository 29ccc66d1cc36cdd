# SPDX-License-Identifier: MIT
"""The planned experiments on the machine: recorded by the drive, within the guard.

A record counts only if it begins at its speed. A machine that does not get there, or does not stay, ends the proof by
name, with what the drive shows of the reason.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

from pmsmtool.design.design_file import Design
from pmsmtool.drive.port import Drive, Injection
from pmsmtool.errors import CheckFailed
from pmsmtool.experiments.speed_run import reach
from pmsmtool.proof.conditions import Conditions, room_k, warmth
from pmsmtool.proof.plan import Experiment, ProofPlan
from pmsmtool.trace import Trace
from pmsmtool.units import RAD_S_PER_RPM

REACH_S = 4.0
REACH_FACTOR = 2.0
"""A speed that is not reached by then, and by this many times what the design's slope takes, is not waited for any
longer."""
REACH_TIMES = 60.0
"""The same, of the time constant of the speed loop: the one of a shaft with play (1 Hz) was 12 % short after 4 s."""
REACHED = 0.05
"""Relative distance from its speed at which an experiment is not begun."""
KEPT = (-0.05, 0.02)
"""Relative range of the speed in the first row of a record (predicted: -3 to 1 %; measured on 31 random drives: -0.4 to
0.4 %). A shaft that is slower has coasted while a slow host armed the recorder."""
ATTEMPTS = 3
"""A record that begins at another speed is taken again, this often in all."""
STATE = ("omega_e_rad_s", "i_d_a", "i_q_a", "u_d_lim_v", "u_q_lim_v", "U_dc_v")
STATE_S, TURN_MOST_S = 0.02, 2.0
"""Averaged over a turn of the shaft, within these times, it shows whether and why a speed was not reached: friction
over the angle swung one by 8 % within a turn."""
AT_SPEED, PASSING_S = 0.01, 0.01
"""Relative distance from its speed at which the record of a shaft that swings begins, looked for this often (s)."""
ALL_IN_D = 0.95
"""Share of i_d in a current vector that leaves next to no torque."""
USED_UP = 0.95
"""Share of the largest voltage at which none is left."""
SAGGED = 0.95
"""DC link over what it showed at rest, below which it has sagged."""
VELOCITY_FF = "position.velocity_ff"
CURRENT_LIMITED = 1 << 2
"""Flag of the drive: the current asked for was cut (``PMSM_FLAG_CURRENT_LIMITED`` of ``pmsm_core.h``)."""
STANDSTILL_S = 2.0
STANDSTILL_RAD_S = 1.0
"""Longest wait for the shaft, beyond what the design's slope takes, and electrical speed that counts as standstill (the
noise of a 12-bit encoder)."""
LOOK_S = 0.05
RESTING_RAD = 2e-3
"""Change of the position from look to look that counts as none (rad): a step of a 12-bit encoder is 1.5e-3."""
RESTING_LOOKS = 2
KEPT_LOOKS, BRAKED = 5, 0.25
"""Looks in a row that show standstill, or a speed that something keeps (loop or load): no more is to be waited for. It
must fall by less than this part of what the design's slope takes: a heavy shaft loses less than 2 % from look to look,
and a position move was begun at 577 rad/s (electrical)."""
RISE_STEPS = 64
RISE_SHARE = 0.25
RISE_S = 3.0
"""A speed is approached in this many steps, on average with this share of the design's slope, but within this time (s):
at full torque a current limit below the design's leaves no i_q beside the i_d that the look-up tables ask for, and the
machine stays where it is (interior-2k2 at 5 A: at 375 of 474 rad/s with i_d = -4.99 A). It is left as gently: braking
with full torque feeds the DC link, which nobody may have made for it."""
COOL_MOST_S, LEAST_ROOM_K = 30.0, 1.0
"""Longest time for the sake of a warm winding, and least rise and room that count: braking a heavy shaft from 208 rpm
in 3 s took one to its trip."""

Keep = Callable[[Experiment, Trace], bool]
"""Told every record as soon as it is there; returns whether to go on."""


class SpeedNotReached(CheckFailed):
    """The machine does not reach the speed of an experiment, or does not keep it until the experiment begins."""


def run_experiments(
    drive: Drive, plan: ProofPlan, design: Design, conditions: Conditions, keep: Keep, say: Callable[[str], None]
) -> None:
    """Run the experiments in their order; the drive is guarded and off on entry.

    Raises SpeedNotReached: the machine does not do what the next experiment begins with.

    Parameters
    ----------
    drive : Drive
        Guarded.
    plan : ProofPlan
        What is run.
    design, conditions
        What the plan was made of.
    keep : callable
        Takes each record; the rest is not run when it returns False.
    say : callable
        Told one line per experiment.
    """
    drive.enable()
    drive.command_current(0.0, 0.0)  # the frame follows the rotor; what a later current step starts from
    for experiment in plan.experiments:
        say(experiment.text)
        trace = _recorded(drive, experiment, design, conditions, say)
        if not keep(experiment, replace(trace, meta={**trace.meta, **_facts(experiment)})):
            break
    if any(e.base_rad_s for e in plan.experiments):
        _approach(drive, 0.0, design)
        _come_to_rest(drive, design.machine.machine.pole_pairs)


def _recorded(
    drive: Drive, experiment: Experiment, design: Design, conditions: Conditions, say: Callable[[str], None]
) -> Trace:
    pole_pairs = design.machine.machine.pole_pairs
    omega_e = pole_pairs * experiment.base_rad_s
    likely = "the shaft coasts too long while the bus or this computer is slow, or something brakes or drives it"
    for left in reversed(range(ATTEMPTS)):
        if experiment.base_rad_s or experiment.excitation.point is Injection.SPEED:
            _approach(drive, experiment.base_rad_s, design)
            if not omega_e:
                _come_to_rest(drive, pole_pairs)  # the shaft may still turn from what was done before
        if omega_e:
            crossover = float(design.facts.get("speed_crossover_rad_s", math.inf))
            limit_s = max(REACH_S, _ramp_s(drive, experiment.base_rad_s, pole_pairs), REACH_TIMES / crossover)
            swings = reach(drive, omega_e, limit_s=limit_s) >= limit_s
            if swings:
                _refuse_other_speed(drive, experiment, omega_e, limit_s, design, conditions)
            drive.wait(experiment.settle_s)
            if swings:
                say("the shaft swings about its speed: the record begins where it passes it")
                likely = "the speed loop swings the shaft: play, or an elastic coupling it is too fast for"
                _await_passing(drive, omega_e, _turn_s(experiment))
        if experiment.move is not None:
            return _moved(drive, experiment, design)
        trace = drive.record(experiment.signals, experiment.rows, decimation=experiment.decimation,
                             excitation=experiment.excitation)  # fmt: skip
        off = float(trace["omega_e_rad_s"][0]) / omega_e - 1.0 if omega_e else 0.0
        if KEPT[0] <= off <= KEPT[1]:
            return trace
        say(f"the record began {100.0 * off:+.2g} % off its speed" + ("; again" if left else ""))
    raise SpeedNotReached(
        f"the speed was not kept: {ATTEMPTS} times {experiment.name} began more than {-100.0 * KEPT[0]:g} % below "
        f"{experiment.base_rad_s / RAD_S_PER_RPM:.4g} rpm, or {100.0 * KEPT[1]:g} % above",
        likely=likely,
    )


def _turn_s(experiment: Experiment) -> float:
    """Return the time of a turn of the shaft, within bounds (s)."""
    return min(TURN_MOST_S, max(STATE_S, 2.0 * math.pi / abs(experiment.base_rad_s)))


def _await_passing(drive: Drive, omega_e_rad_s: float, turn_s: float) -> None:
    """Wait until a shaft that swings about its speed passes it, for a turn at most."""
    for _ in range(math.ceil(turn_s / PASSING_S)):
        if abs(drive.live("omega_e_rad_s") - omega_e_rad_s) <= AT_SPEED * abs(omega_e_rad_s):
            break
        drive.wait(PASSING_S)


def _moved(drive: Drive, experiment: Experiment, design: Design) -> Trace:
    """Move with the share of the speed fed forward that the experiment asks for; the design's own is back behind it.

    The position stays when it begins: a slow loop let a load of 14 rotors roll on by 3 degrees while it held them.
    """
    assert experiment.move is not None
    at = [drive.live("theta_m_rad")]
    while len(at) * LOOK_S < STANDSTILL_S:
        drive.wait(LOOK_S)
        at.append(drive.live("theta_m_rad"))
        last = at[-KEPT_LOOKS:]
        if len(last) == KEPT_LOOKS and max(last) - min(last) <= RESTING_RAD:
            break
    designed = design[VELOCITY_FF]
    drive.write({VELOCITY_FF: experiment.velocity_ff * designed})
    trace = drive.record_move(experiment.signals, experiment.rows, experiment.decimation, experiment.move)
    drive.write({VELOCITY_FF: designed})
    return trace


def _refuse_other_speed(
    drive: Drive, experiment: Experiment, omega_e_rad_s: float, limit_s: float, design: Design, conditions: Conditions
) -> None:
    """Raise when the machine is not near the speed it should have reached."""
    state = drive.average(STATE, max(1, round(_turn_s(experiment) / drive.period_s)))
    limited = bool(round(drive.live("flags")) & CURRENT_LIMITED)
    omega = state["omega_e_rad_s"]
    if abs(omega - omega_e_rad_s) <= REACHED * abs(omega_e_rad_s):
        return  # it only does not rest there
    rpm = design.machine.machine.pole_pairs * RAD_S_PER_RPM
    raise SpeedNotReached(
        f"the speed was not reached: {omega / rpm:.4g} of {omega_e_rad_s / rpm:.4g} rpm after {limit_s:.3g} s, with "
        f"i_d = {state['i_d_a']:.3g} A and i_q = {state['i_q_a']:.3g} A, before {experiment.name}",
        likely=_why_not(state, limited, design, conditions)
        if abs(omega) < abs(omega_e_rad_s)
        else "the speed loop has not settled, or something drives the shaft",
    )


def _why_not(state: Mapping[str, float], limited: bool, design: Design, conditions: Conditions) -> str:
    """Return the likely reason for a speed that was not reached."""
    U_dc, U_rest = state["U_dc_v"], conditions.U_dc_v
    voltage = math.hypot(state["u_d_lim_v"], state["u_q_lim_v"])
    used_up = voltage >= USED_UP * design.machine.inverter.voltage_utilisation * U_dc
    if U_dc < SAGGED * U_rest:
        return f"the voltage is too low: the DC link falls to {U_dc:.4g} V, at rest it shows {U_rest:.4g} V"
    if limited and abs(state["i_d_a"]) >= ALL_IN_D * math.hypot(state["i_d_a"], state["i_q_a"]):
        return "all current stays in i_d: the current limit leaves none for torque beside the field weakening"
    if limited:
        return "the torque at the current limit does not suffice: something brakes the shaft"
    if used_up:
        return "the voltage is too low: none is left at this speed"
    return "the drive commands no more current: a speed or torque limit of its own"


def _approach(drive: Drive, speed_rad_s: float, design: Design) -> None:
    """Ask for a mechanical speed (rad/s) in small steps, up and down: full torque either way may be too much."""
    present = drive.live("omega_e_rad_s") / design.machine.machine.pole_pairs
    change = speed_rad_s - present
    slope = RISE_SHARE * drive.read("speed.acceleration_rpm_per_s") * RAD_S_PER_RPM
    if present >= 0.0 and slope > 0.0:
        seconds = _cool_s(drive, change, min(abs(change) / slope, RISE_S), design)
        for k in range(1, RISE_STEPS):
            drive.command_speed(present + change * k / RISE_STEPS)
            drive.wait(seconds / RISE_STEPS)
    drive.command_speed(speed_rad_s)


def _cool_s(drive: Drive, change_rad_s: float, least_s: float, design: Design) -> float:
    """Return the time over which a change of the speed leaves the winding below its trip, and no less than wanted (s).

    A rise that is less than what a temperature is told from another by is none.
    """
    warms = warmth(design) * change_rad_s**2
    if warms <= LEAST_ROOM_K * least_s:
        return least_s
    return max(least_s, min(COOL_MOST_S, warms / max(LEAST_ROOM_K, room_k(design, drive.live("T_winding_c")))))


def _ramp_s(drive: Drive, speed_rad_s: float, pole_pairs: int) -> float:
    """Time to allow for a mechanical speed (s): what a heavy shaft needs with the design's slope, and as much again."""
    slope = drive.read("speed.acceleration_rpm_per_s") * RAD_S_PER_RPM
    change = abs(speed_rad_s - drive.live("omega_e_rad_s") / pole_pairs)
    return REACH_FACTOR * change / slope if slope > 0.0 else 0.0


def _come_to_rest(drive: Drive, pole_pairs: int) -> None:
    """Wait for the shaft as long as it gets slower; the guard's stop brakes what is left."""
    ramp_s = _ramp_s(drive, 0.0, pole_pairs)
    speeds = [abs(drive.live("omega_e_rad_s"))]
    resting = kept = 0  # looks in a row: a shaft that swings passes standstill, and is faster for a moment
    least = BRAKED * REACH_FACTOR * KEPT_LOOKS * LOOK_S * speeds[0] / max(ramp_s, LOOK_S)
    for _ in range(math.ceil((STANDSTILL_S + ramp_s) / LOOK_S)):
        resting = resting + 1 if speeds[-1] < STANDSTILL_RAD_S else 0
        kept = kept + 1 if speeds[-1] > 0.98 * speeds[-2:][0] and len(speeds) > 1 else 0
        if resting == RESTING_LOOKS or (kept >= KEPT_LOOKS and speeds[-1 - KEPT_LOOKS] - speeds[-1] < least):
            return
        drive.wait(LOOK_S)
        speeds.append(abs(drive.live("omega_e_rad_s")))


def _facts(experiment: Experiment) -> dict[str, object]:
    return {"experiment": experiment.name, "text": experiment.text, "repeats": experiment.repeats}
