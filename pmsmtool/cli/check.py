# SPDX-License-Identifier: MIT
"""``pmsmtool check``: the first power-on."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pmsmtool.cli.drive_access import LOOKING_S, claimed_node, map_option, open_node, read_map
from pmsmtool.cli.options import FILE, BusOptions, MotionOptions, bus_options, examples, motion_options, output_options
from pmsmtool.cli.output import Output, table
from pmsmtool.errors import CheckFailed, ConfigError, NotAvailable, Partial

if TYPE_CHECKING:
    from pmsmtool.drive.canopen_drive import CanopenDrive
    from pmsmtool.identification.wiring import Finding
    from pmsmtool.machine.machine_file import MachineFile
    from pmsmtool.measurement.capabilities import Capabilities


@click.command(
    "check",
    epilog=examples(
        "pmsmtool -i pmsmsim --yes check",
        "pmsmtool -n 5 check motor.toml --shaft free --speed-max 200rpm",
    ),
)
@click.argument("machine_file", metavar="[MACHINE]", type=FILE, required=False)
@map_option
@bus_options
@motion_options
@output_options
def check_command(
    bus: BusOptions, motion: MotionOptions, out: Output, machine_file: Path | None, map_file: Path | None
) -> None:
    """Look for wrong wiring at a first power-on: a tenth of the rated current, half a turn, 15 s at most.

    One table names what is wrong with supply, phases, current sensors, shaft or brake, pole pairs, counts per turn and
    encoder sign, the most likely cause first. MACHINE is the connected motor; without it the values of the drive are
    used. Nothing is stored in the drive.

    Exit code 1 when something is wrong, 10 when phases, shaft or pole pairs could not be judged. Drives of the levels
    recorder and standard cannot show all of these; what they cannot show is listed.
    """
    from pmsmtool.cia402 import HOMING_LOST
    from pmsmtool.cli.consent import ask_motion
    from pmsmtool.commissioning.first_check import check_wiring, envelope_of
    from pmsmtool.measurement.capabilities import CapabilityLevel
    from pmsmtool.measurement.identify import open_for_level

    given = _examined(bus, map_file)
    if given.level not in (CapabilityLevel.FULL, CapabilityLevel.INJECT):
        _conclude(out, _check_below_full(bus, motion, out, given, machine_file))
        return
    with bus.connect() as connection:
        drive = open_for_level(connection, claimed_node(connection, bus.node), given)
        stated = _stated(drive, machine_file)
        envelope = replace(
            envelope_of(stated, motion.i_max_apk, motion.speed_max_rad_s),
            shaft=motion.shaft or "free", load=motion.load, brake=motion.brake,
        )  # fmt: skip
        envelope.refuse_gravity()
        lines = [
            *envelope.lines(),
            f"the rotor aligns with current vectors: it may jump by half an electrical turn; {HOMING_LOST}",
            "the shaft turns slowly half a turn forward and back",
            "nothing is stored in the drive; every changed object is restored",
        ]
        ask_motion(lines, motion, simulated=bus.simulated(), serial=drive.identity.serial, out=out)
        found = check_wiring(drive, stated, envelope, out.note)
        drive.close()
    _conclude(out, found, "" if machine_file else OF_THE_DRIVE)


OF_THE_DRIVE = "what is stated is what the drive holds: name the connected motor, `pmsmtool check MACHINE`; else "
"""Before the next step where no motor was given: a new drive holds another one's values."""


def _conclude(out: Output, found: list[Finding], stated_by: str = "") -> None:
    """Print the table; raises where something is wrong, or what matters was not seen."""
    from pmsmtool.identification.wiring import NOT_CHECKED, NOT_SEEN, WRONG

    out.result(
        "check",
        {"findings": [asdict(finding) for finding in found]},
        lambda: table(("looked at", "verdict", "seen", "likely"), [tuple(asdict(f).values()) for f in found]),
    )
    wrong = [finding for finding in found if finding.verdict == WRONG]
    if wrong:
        first, *others = wrong
        also = f"; wrong, too: {', '.join(each.looked_at for each in others)}" if others else ""
        raise CheckFailed(
            f"{first.looked_at}: {first.shown}{also}", likely=first.likely,
            hint=f"{stated_by}switch off, correct it, and check again",
        )  # fmt: skip
    unseen = [finding.looked_at for finding in found if finding.verdict in (NOT_SEEN, NOT_CHECKED)]
    if any(name in unseen for name in ("phases", "shaft", "pole pairs")):
        by_hand = "see the table for the reason; by hand: leads with an ohmmeter, pole pairs on the name plate"
        raise Partial(f"not judged: {', '.join(unseen)}", hint=by_hand)


def _examined(bus: BusOptions, map_file: Path | None) -> Capabilities:
    """Return what the drive has."""
    from pmsmtool.measurement.capabilities import examine

    with open_node(bus, within_s=LOOKING_S) as node:
        node.refuse_late()
        return examine(node, None if map_file is None else read_map(map_file))


def _check_below_full(
    bus: BusOptions, motion: MotionOptions, out: Output, found: Capabilities, path: Path | None
) -> list[Finding]:
    """Ask, and check what the drive's level lets be seen."""
    from pmsmtool.cia402 import HOMING_LOST
    from pmsmtool.cli.consent import ask_motion
    from pmsmtool.commissioning.first_check_levels import check_below_full, envelope_below_full, turns_a_vector
    from pmsmtool.identification.request import IdentifyRequest, Method
    from pmsmtool.machine.machine_file import load_machine_file
    from pmsmtool.measurement.capabilities import CapabilityLevel
    from pmsmtool.measurement.identify import open_for_level

    missing = found.row("mechanics", Method.STANDARD).missing
    if found.level not in (CapabilityLevel.STANDARD, CapabilityLevel.RECORDER) or missing:
        raise NotAvailable(
            f"nothing can be moved on this drive: it needs {', '.join(missing) or 'objects of CiA 402'}",
            where=f"node {found.identity.node}", hint=f"`pmsmtool caps` lists what it can measure{found.by_moves}",
        )  # fmt: skip
    if path is None:
        raise ConfigError(
            "MACHINE is missing: this drive does not hold what is connected", hint="`pmsmtool machine new` writes one"
        )
    stated = load_machine_file(path)
    request = IdentifyRequest(
        i_max_apk=motion.i_max_apk, speed_max_rad_s=motion.speed_max_rad_s, shaft=motion.shaft or "free",
        load=motion.load, brake=motion.brake,
    )  # fmt: skip
    with bus.connect() as connection:
        drive = open_for_level(connection, claimed_node(connection, bus.node), found)
        envelope = envelope_below_full(drive, found, request, stated)
        envelope.refuse_gravity()
        lines = [
            *envelope.lines(),
            *found.replaced,
            f"{'a turned vector leads' if turns_a_vector(found) else 'torque pulses turn'} the shaft by at most half a "
            f"turn; {HOMING_LOST}",
            f"capability level {found.level}: what it cannot show is listed as NOT CHECKED",
            "nothing is stored in the drive; every changed object is restored",
        ]
        ask_motion(lines, motion, simulated=bus.simulated(), serial=drive.identity.serial, out=out)
        rows = check_below_full(drive, found, stated, envelope, out.note)
        drive.close()
    return rows


def _stated(drive: CanopenDrive, path: Path | None) -> MachineFile:
    """Return what is stated of the machine; of two rated currents the smaller one."""
    from pmsmtool.machine.machine_file import load_machine_file
    from pmsmtool.measurement.by_injection import nameplate_of

    held = nameplate_of(drive, "held by the drive")
    if path is None:
        return held
    stated = load_machine_file(path)
    currents = [file.machine.I_nom_apk for file in (stated, held) if file.machine.I_nom_apk]
    return replace(stated, machine=replace(stated.machine, I_nom_apk=min(currents, default=None)))
