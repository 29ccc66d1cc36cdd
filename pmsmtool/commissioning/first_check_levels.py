# SPDX-License-Identifier: MIT
"""The first check of drives below the full level: what their objects let be seen, and by name what they do not.

A drive that takes the master's commutation angle is led by a turned vector, as at the full level. A drive that
commutates by itself is pushed by torque. Currents of single phases, and so the current sensors, are seen by neither.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pmsmtool.cia402 import LEAST_LINK_V
from pmsmtool.commissioning.first_check import (
    CURRENT_SHARE,
    DURATION_S,
    HEADROOM,
    ORDER,
    SPEED_RAD_S,
    SPEED_SHARE,
    TRAVEL_RAD,
    led_beyond,
    look_at_inputs,
    why_unseen,
    with_fault,
)
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.guard import guarded
from pmsmtool.drive.motion_objects import rated_apk
from pmsmtool.drive.standard_drive import StandardDrive
from pmsmtool.drive.torque_drives import TorqueDrive, pushing_drive
from pmsmtool.errors import DriveFault, IdentificationError, LimitExceeded, NotAvailable, SdoAbort
from pmsmtool.experiments.first_turn import WAY_RAD, lead_half_a_turn, push_forth_and_back
from pmsmtool.experiments.rotation import TURN_RAD, lead_onto_vector
from pmsmtool.identification.request import IdentifyRequest, Method
from pmsmtool.identification.wiring import (
    COUNT_FACTORS,
    NOT_CHECKED,
    NOT_SEEN,
    OK,
    WRONG,
    Finding,
    judge_current,
    judge_push,
    judge_supply,
    judge_turn,
)
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.measurement.by_pulses import envelope_of
from pmsmtool.measurement.capabilities import Capabilities
from pmsmtool.trace import Trace

UNITS = {"V": 1e3, "0.1 V": 1e2, "0.01 V": 10.0}
"""What makers count in 0x6079 in place of mV, and how much more that is."""
UNSEEN = {
    "supply": "the drive does not show its DC link (0x6079, or an object in its map)",
    "phases": "the drive shows no current of a single phase",
    "current sensors": "the drive shows no current of a single phase",
    "shaft": "",
    "pole pairs": "the drive cannot turn a current vector: it has no commutation angle (0x60EA)",
    "encoder sign": "",
}
"""Why a thing is not seen; empty: the check ended before it."""
RUNS_OFF_BY = "an open or shorted phase, or gains of the current loop that do not fit the motor"
LATE_S = 0.005
"""Answer time from which on a push may run on: up to 4 ms none of 6 healthy drives did, at 7 ms 1, at 20 ms 3."""
KEPT = (0.5, 1.5)
"""Current shown at the end of a push, of the one asked for: 0.63 to 1.05 on 16 healthy drives, 0.71 and 1.41 of that
where peak and rms are taken for each other. With an open phase one of both ways was outside on 11 of 11 drives whose
current stayed within its limit. Where the push made its whole way, less is a slow current loop (0.28 was seen)."""
POLE_PAIRS = "motor.pole_pairs"
ENOUGH_SHARE = 0.07
"""Least share of the motor's rated current under which a healthy shaft moves: cogging takes up to 5 % of the rated
torque, friction 2 %. One behind a drive for a ninth of its current stood still at 1.5 %."""


def turns_a_vector(found: Capabilities) -> bool:
    """Whether the drive takes the master's commutation angle."""
    return found.row("poles", Method.STANDARD).available


def envelope_below_full(
    drive: CanopenDrive, found: Capabilities, request: IdentifyRequest, stated: MachineFile
) -> Envelope:
    """Return what the check may do: a tenth of the rated current, half a turn, 15 s; raises as ``envelope_of``."""
    allowed = envelope_of(drive, replace(request, i_max_apk=None), stated)
    largest = min(HEADROOM * CURRENT_SHARE * rated_of(drive, stated), allowed.i_max_apk)
    return replace(
        allowed,
        i_max_apk=largest if request.i_max_apk is None else min(request.i_max_apk, largest),
        speed_max_rad_s=min(allowed.speed_max_rad_s, max(SPEED_RAD_S, SPEED_SHARE * allowed.speed_max_rad_s)),
        duration_s=DURATION_S,
        travel_rad=TRAVEL_RAD if turns_a_vector(found) else math.pi,
    )


def rated_of(drive: CanopenDrive, stated: MachineFile) -> float:
    """Return the smaller rated current of drive and machine (A peak), whatever the drive's own limit allows of it."""
    return min(rated_apk(drive.node), stated.machine.I_nom_apk or math.inf)


def check_below_full(
    drive: CanopenDrive, found: Capabilities, stated: MachineFile, envelope: Envelope, say: Callable[[str], None]
) -> list[Finding]:
    """Look at a drive that nobody has seen move, and return one row per thing, those it cannot show included.

    Parameters
    ----------
    drive : CanopenDrive
        As ``identify.open_for_level`` gives it.
    found : Capabilities
        What it has.
    stated : MachineFile
        What is connected.
    envelope : Envelope
        As :func:`envelope_below_full`.
    """
    connection, node = drive.node.connection, drive.node.node
    rows = [look_at_inputs(drive)]
    turns = turns_a_vector(found)
    moving: StandardDrive | TorqueDrive
    if turns:
        moving = StandardDrive(connection, node, drive_map=found.drive_map)
    else:
        moving = pushing_drive(connection, node, found.drive_map)
    try:
        rows += [_counts(moving, stated), *_held_pole_pairs(drive, stated)]
        rest_v = _link_v(moving)
        if rest_v is not None:
            rows.append(_supply(rest_v, None, stated.inverter.U_dc_v))
        if any(row.verdict == WRONG for row in rows):
            return _whole(rows, turns)  # nothing is energised against what is known to be wrong
        i_a = envelope.i_max_apk / HEADROOM
        answer_s = moving.node.answer_s()
        if isinstance(moving, TorqueDrive):
            moving.top_rad_s = envelope.speed_max_rad_s
        try:
            with guarded(moving, envelope, say=say) as guard:
                guard.enable()
                if turns:
                    say("shaft: half a turn forward and back by a turned vector")
                    pole_pairs = round(stated.machine.pole_pairs)
                    # a rotor half a turn off it may still stand there by friction: the turn to 0 takes it along
                    lead_onto_vector(guard, i_a, TURN_RAD)
                    link = () if rest_v is None else ("U_dc_v",)
                    turn = lead_half_a_turn(guard, i_a, pole_pairs, TURN_RAD, signals=("theta_m_rad", "i_q_a", *link))
                    judged = [*judge_current(turn, i_a), *judge_turn(turn, pole_pairs, counts_against=False)]
                else:
                    say(f"shaft: torque pulses up to {i_a:.3g} A, forth and back")
                    speed_rad_s = 0.5 * envelope.speed_max_rad_s
                    turn = push_forth_and_back(guard, i_a, speed_rad_s, link=rest_v is not None)
                    judged = judge_kept(turn) or judge_push(turn)
                if rest_v is not None:
                    judged.append(_supply(rest_v, turn, stated.inverter.U_dc_v))
            rows = [row for row in rows if row.looked_at not in {each.looked_at for each in judged}] + judged
        except IdentificationError as error:
            rows.append(unmoved(error, turns, i_a / (stated.machine.I_nom_apk or rated_of(drive, stated))))
        except NotAvailable as refused:  # mode 11: announced in 0x6502, and refused when it is asked for
            if not turns:
                raise
            say(f"{refused.what}: torque pulses instead")
            lacking = replace(found, features=found.features - {"commutation angle"})
            return check_below_full(drive, lacking, stated, replace(envelope, travel_rad=math.pi), say)
        except SdoAbort:
            raise  # a refused object is no wiring
        except DriveFault as error:  # the guard has stopped the machine
            rows = with_fault(rows, error)
        except LimitExceeded as error:
            rows.append(beyond(error, turns, answer_s))
    finally:
        drive.may_be_energised = drive.may_be_energised or moving.may_be_energised
        moving.close()
    return _whole(rows, turns)


def unmoved(error: IdentificationError, turns: bool, share: float) -> Finding:
    """Return the row of a shaft that did not move; less than enough of the motor's rated current blames nobody."""
    likely = error.likely + ("; an open phase" if turns else "")
    if share > ENOUGH_SHARE:
        return Finding("shaft", WRONG, error.what, likely)
    seen = f"{error.what}, with {100.0 * share:.2g} % of the motor's rated current: no more is allowed"
    few = "friction, for want of current: a small drive for this motor, or the limits above"
    return Finding("shaft", NOT_SEEN, seen, f"{few}; {likely}")


def beyond(error: LimitExceeded, turns: bool, answer_s: float = 0.0) -> Finding:
    """Return the row of a limit that ended the check; its time is over where a rotor does not come to rest.

    A push is ended by its way: what runs off then has more current than was asked for, or its way is seen too late.
    """
    if not turns and answer_s > LATE_S and not error.quantity.startswith("current"):
        seen = f"{error.what}, and an answer takes {1e3 * answer_s:.0f} ms: the end of a torque pulse shows too late"
        return Finding("shaft", NOT_SEEN, seen, "a slow adapter, bus or drive; or an open phase, if it is none of them")
    if error.quantity.startswith("time") or (turns and not error.quantity.startswith("current")):
        return led_beyond(error)
    return Finding("phases", WRONG, error.what, f"{RUNS_OFF_BY}; a load that turns the shaft")


def judge_kept(pushes: Trace) -> list[Finding]:
    """Judge whether every push had its current at its end; with an open phase the angle decides what flows.

    Less than that current is a fault only where the shaft did not make the whole way of a push, either.
    """
    shares = pushes["i_q_a"] / pushes["i_command_a"]
    arrived = np.abs(pushes["way_rad"]) >= WAY_RAD
    if np.all((shares <= KEPT[1]) & ((shares >= KEPT[0]) | arrived)):
        return []
    seen = " and ".join(f"{100.0 * share:.0f} %" for share in shares)
    shown = f"forth and back the drive shows {seen} of the current asked for"
    return [
        Finding("phases", WRONG, shown, "an open phase, or the supply in current limit"),
        Finding("shaft", NOT_SEEN, "mend what is wrong first"),
    ]


def _whole(rows: list[Finding], turns: bool) -> list[Finding]:
    """Return the rows in their order, with one for each thing that this level does not see."""
    seen = {row.looked_at for row in rows}
    unseen = UNSEEN | ({"pole pairs": UNSEEN["shaft"]} if turns else {})
    left = {name: why or why_unseen(rows) for name, why in unseen.items() if name not in seen}
    rows = [*rows, *(Finding(name, NOT_CHECKED, why) for name, why in left.items())]
    return sorted(rows, key=lambda row: ORDER.index(row.looked_at))


def _link_v(drive: StandardDrive) -> float | None:
    try:
        return drive.live("U_dc_v")
    except NotAvailable:
        return None


def _supply(rest_v: float, turn: Trace | None, stated_v: float | None) -> Finding:
    """Judge the DC link (V); one that is the stated one in another unit than mV is not known, not wrong."""
    if stated_v and rest_v < LEAST_LINK_V:
        for unit, factor in UNITS.items():
            if judge_supply(factor * rest_v, None, stated_v).verdict != OK:
                continue
            fallen = judge_supply(rest_v, turn, None)
            shown = (
                f"DC link {rest_v:.3g} V if it is counted in mV (CiA 402); in {unit} it is the stated {stated_v:.4g} V"
            )
            odd = Finding("supply", NOT_CHECKED, shown, "state its unit in a map of your own ([signals] U_dc_v)")
            return odd if fallen.verdict == OK else fallen
    return judge_supply(rest_v, turn, stated_v)


def _counts(drive: StandardDrive, stated: MachineFile) -> Finding:
    held, bits = abs(drive.counts_per_turn), stated.encoder.bits
    factor = held / (1 << bits) if bits else math.nan
    if not bits:
        return Finding("encoder counts", NOT_CHECKED, "not stated: bits in [encoder] of the machine file")
    if any(math.isclose(factor, usual, rel_tol=1e-9) for usual in COUNT_FACTORS):
        shown = f"the drive is set for {held:.6g} per turn, {1 << bits} are stated"
        return Finding("encoder counts", WRONG, shown, "lines given for counts, or the reverse")
    if math.isclose(factor, 1.0, rel_tol=1e-9):
        return Finding("encoder counts", OK, f"{held:.6g} units of position per turn, as stated")
    return Finding(
        "encoder counts", NOT_CHECKED,
        f"the drive counts {held:.6g} units of position per turn, {1 << bits} counts are stated: units may be scaled",
    )  # fmt: skip


def _held_pole_pairs(drive: CanopenDrive, stated: MachineFile) -> list[Finding]:
    """Compare the pole pairs that the drive is set for, where its map knows them; that is no measurement."""
    held, said = drive.parameters.held_value(POLE_PAIRS), round(stated.machine.pole_pairs)
    if held is None:
        return []
    if round(held) == said:
        return [Finding("pole pairs", NOT_CHECKED, f"the drive is set for the stated {said}; not measured")]
    shown = f"the drive is set for {held:.0f}, {said} are stated"
    return [Finding("pole pairs", WRONG, shown, "poles given for pole pairs, or another motor's set-up")]
