# SPDX-License-Identifier: MIT
"""The check of a first power-on: small currents and half a turn say what is miswired, before anything larger does."""

from __future__ import annotations

import math
import re
from collections.abc import Callable

from pmsmtool.commissioning.compared_stage import held_values
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.guard import guarded
from pmsmtool.drive.objects import LIVE, DriveObject
from pmsmtool.drive.port import Drive
from pmsmtool.errors import DriveFault, IdentificationError, LimitExceeded, SdoAbort
from pmsmtool.estimators.current_sensors import estimate_noise
from pmsmtool.experiments import standstill
from pmsmtool.experiments.first_turn import HALL, SIGNALS, lead_half_a_turn
from pmsmtool.identification.phase_check import check_phases
from pmsmtool.identification.wiring import (
    NOT_SEEN,
    OK,
    WRONG,
    Finding,
    judge_halls,
    judge_sensors,
    judge_supply,
    judge_turn,
)
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.parameters import HallCommutation
from pmsmtool.measurement.limits import Limits
from pmsmtool.measurement.measure import COMPENSATION, starting_gains
from pmsmtool.units import rad_s_from_rpm

CURRENT_SHARE = 0.1
"""Current of the check, of the rated one."""
PHASES_SHARE = 0.5
"""Current of the phases' test, of that: half the jump onto its first vector."""
HEADROOM = 2.0
"""Limit of the current, over that of the check: a rotor that swings onto a vector induces more than gains from the
ratings alone can hold (interior-2k2: 1.7 times)."""
SPEED_RAD_S = 8.0 * math.pi
SPEED_SHARE = 0.3
"""Speed limit without one, the larger: a machine of one pole pair is turned at 19 rad/s, and a light rotor swings onto
the first vector with up to this share of its largest speed."""
TRAVEL_RAD = 2.5 * math.pi
"""The jump onto the first vector and the way to the third, of a machine of one pole pair; others stay within half."""
DURATION_S = 15.0
ABOUT = {"E_CURRENT_SENSOR": "current sensors", "E_SNR": "current sensors"}
"""What a refusal of the phase check is about, where that is not the phases."""
ALL = ("supply", "phases", "current sensors", "shaft", "pole pairs", "encoder sign")
ORDER = (
    "safe torque off", "supply", "limit switches", "current sensors", "phases", "shaft", "encoder sign",
    "encoder counts", "pole pairs", "Hall wires",
)  # fmt: skip
"""Rows of the table. The sign is seen whatever is stated; counts and pole pairs are compared with what is, and a drive
that was never set up states another motor's."""
TURNED_BY = "a load that turns the shaft; wrong counts per turn or pole pairs"
FAULTS = (
    ("does not enable", "safe torque off", "safe torque off or the enable input open; no DC link"),
    ("0x2", "phases", "two motor leads touch each other or earth; gains of the current loop that do not fit the motor"),
    ("0x3", "supply", "the supply is off, too weak, or in current limit"),
    ("0x73", "encoder counts", "the encoder's cable or supply, or another encoder than is set"),
)
"""What a fault of the drive is about, by its text: error codes by their class (CiA 301, 7.2.8; CiA 402-2, 0x603F)."""
CODE = re.compile(r"\b(?:fault|emergency) (0x[0-9a-f]{4})")
DIGITAL_INPUTS = DriveObject(0x60FD, 0, "I")
INPUTS = {0: "negative limit switch", 1: "positive limit switch", 3: "interlock"}
"""Bits of 0x60FD (CiA 402-2, digital inputs)."""


def envelope_of(nameplate: MachineFile, i_max_apk: float | None, speed_max_rad_s: float | None) -> Envelope:
    """Return what the check may do: a tenth of the rated current, half a turn, 15 s."""
    rated = nameplate.machine.I_nom_apk or i_max_apk or 0.0
    largest = HEADROOM * CURRENT_SHARE * rated
    n_max = nameplate.machine.top_rpm
    fastest = rad_s_from_rpm(n_max) if n_max else SPEED_RAD_S
    speed = min(fastest, max(SPEED_RAD_S, SPEED_SHARE * fastest))
    return Envelope(
        i_max_apk=largest if i_max_apk is None else min(i_max_apk, largest),
        speed_max_rad_s=speed if speed_max_rad_s is None else min(speed, speed_max_rad_s),
        duration_s=DURATION_S,
        travel_rad=TRAVEL_RAD,
    )


def check_wiring(
    drive: CanopenDrive, stated: MachineFile, envelope: Envelope, say: Callable[[str], None]
) -> list[Finding]:
    """Look at a drive that nobody has seen move, and return one row per thing looked at.

    Parameters
    ----------
    drive : CanopenDrive
        Off, and allowed to move within the envelope.
    stated : MachineFile
        What the file, or without one the drive, says of machine and supply.
    envelope : Envelope
        As :func:`envelope_of`.
    say : callable
        Told one line per step.
    """
    found = [_counts(drive, stated), look_at_inputs(drive)]
    against = drive.read("encoder.reversed") > 0.5
    limits = Limits(
        envelope.i_max_apk / (HEADROOM * CURRENT_SHARE), envelope.i_max_apk, envelope.speed_max_rad_s,
        stated.inverter.V_max_v,
    )  # fmt: skip
    rest_v = drive.live("U_dc_v")
    halls = (HALL,) if drive.node.has(LIVE[HALL].index, LIVE[HALL].sub) else ()
    supply = judge_supply(rest_v, None, stated.inverter.U_dc_v)
    if supply.verdict != OK:  # with half of its voltage a drive does not even switch on
        return _ordered([*found, supply])
    try:
        with guarded(drive, envelope, first=starting_gains(limits), say=say) as guard:
            _look(guard, stated, envelope.i_max_apk / HEADROOM, rest_v, against, halls, found, say)
    except SdoAbort:
        raise  # a refused object is no wiring
    except DriveFault as error:  # the guard has stopped the machine
        found = with_fault(found, error)
    except LimitExceeded as error:
        found.append(led_beyond(error))
    return _ordered(found)


def led_beyond(error: LimitExceeded) -> Finding:
    """Return the row of a limit that ended a turn by a vector; its time is over where the rotor swings on."""
    if not error.quantity.startswith("time"):
        return Finding("shaft", WRONG, error.what, error.likely or TURNED_BY)
    seen = f"the rotor had not come to rest on the vector when {error.limit:g} s were over"
    return Finding("shaft", NOT_SEEN, seen, "an open phase, or so little friction that it swings on")


def with_fault(rows: list[Finding], error: DriveFault) -> list[Finding]:
    """Return the rows with that of the fault in place of what was seen of it before."""
    row = fault_row(error.what, error.likely)
    return [*(each for each in rows if each.looked_at != row.looked_at), row]


def fault_row(what: str, likely: str) -> Finding:
    """Return the row of a fault that ended the check; ``what`` as the drive's error says it.

    A fault that names nothing is the shaft's: it turned where it was not to.
    """
    code = CODE.search(what)
    known = code[1] if code else what
    for mark, about, usual in FAULTS:
        if known.startswith(mark) if code else mark in known:
            return Finding(about, WRONG, what, likely or usual)
    return Finding("shaft", WRONG, what, likely or "a limit switch; " + TURNED_BY)


def why_unseen(found: list[Finding]) -> str:
    """Say why other things were not looked at, beside what was."""
    wrong = any(finding.verdict == WRONG for finding in found)
    return "mend what is wrong first" if wrong else "the check ended before it"


def _ordered(found: list[Finding]) -> list[Finding]:
    """Return the rows in their order, with one for each thing that was not looked at."""
    missing = set(ALL) - {finding.looked_at for finding in found}
    rows = [*found, *(Finding(name, NOT_SEEN, why_unseen(found)) for name in missing)]
    return sorted(rows, key=lambda row: ORDER.index(row.looked_at))


def _look(
    drive: Drive,
    stated: MachineFile,
    i_a: float,
    rest_v: float,
    against: bool,
    halls: tuple[str, ...],
    found: list[Finding],
    say: Callable[[str], None],
) -> None:
    """Energise step by step; ends at the first thing that is wrong with the phases."""
    if drive.read(COMPENSATION) != 0.0:
        drive.write({COMPENSATION: 0.0})
    say(f"phases: three vectors of {PHASES_SHARE * i_a:.3g} A")
    try:
        noise = estimate_noise(standstill.record_zero_current(drive))
        drive.enable()
        vectors = standstill.hold_phase_vectors(drive, PHASES_SHARE * i_a)
        check_phases(vectors, noise)
    except IdentificationError as error:
        found.append(Finding(ABOUT.get(error.reason, "phases"), WRONG, error.what, error.likely))
        return
    found += [Finding("phases", OK, "all three carry the current"), judge_sensors(vectors)]
    say("shaft: half a turn forward and back")
    pole_pairs = round(stated.machine.pole_pairs)
    turn = lead_half_a_turn(
        drive, i_a, pole_pairs, standstill.PHASE_ANGLES_RAD[-1], signals=(*SIGNALS, *halls)
    )  # fmt: skip
    found += [judge_supply(rest_v, turn, stated.inverter.U_dc_v), *judge_turn(turn, pole_pairs, against)]
    if halls and found[-1].verdict != NOT_SEEN:
        used = round(drive.read("hall.commutation")) != HallCommutation.NONE
        axes = [drive.read(f"hall.axis_{wire}_rad") for wire in (1, 2, 3)] if used else []
        found.append(judge_halls(turn, axes))


def _counts(drive: CanopenDrive, stated: MachineFile) -> Finding:
    """Compare the counts per turn that the drive is set for with the file's."""
    held, bits = held_values(drive).get("encoder_counts"), stated.encoder.bits
    if held is None or not bits:
        missing = (
            "the drive does not show them" if held is None else "not stated: bits in [encoder] of the machine file"
        )
        return Finding("encoder counts", NOT_SEEN, missing)
    if round(held) == 1 << bits:
        return Finding("encoder counts", OK, f"{held:.0f} per turn, as stated")
    return Finding(
        "encoder counts", WRONG, f"the drive is set for {held:.0f} per turn, {1 << bits} are stated",
        "lines given for counts, or another encoder",
    )  # fmt: skip


def look_at_inputs(drive: CanopenDrive) -> Finding:
    """Look at limit switches and interlock, where the drive shows its inputs."""
    if not drive.node.has(DIGITAL_INPUTS.index, DIGITAL_INPUTS.sub):
        return Finding("limit switches", NOT_SEEN, "the drive does not show its inputs (0x60FD)")
    word = round(drive.node.get(DIGITAL_INPUTS))
    active = [name for bit, name in INPUTS.items() if word >> bit & 1]
    if active:
        return Finding("limit switches", WRONG, f"active: {', '.join(active)}", "the axis is there, or a wire is off")
    return Finding("limit switches", OK, "none is active")
