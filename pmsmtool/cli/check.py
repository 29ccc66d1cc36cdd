# SPDX-License-Identifier: MIT
"""``pmsmtool check``: the first power-on."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pmsmtool.cli.drive_access import open_drive
from pmsmtool.cli.options import FILE, BusOptions, MotionOptions, bus_options, examples, motion_options, output_options
from pmsmtool.cli.output import Output, table

if TYPE_CHECKING:
    from pmsmtool.drive.canopen_drive import CanopenDrive
    from pmsmtool.machine.machine_file import MachineFile


@click.command(
    "check",
    epilog=examples(
        "pmsmtool -i pmsmsim --yes check",
        "pmsmtool -n 5 check motor.toml --shaft free --speed-max 200rpm",
    ),
)
@click.argument("machine_file", metavar="[MACHINE]", type=FILE, required=False)
@bus_options
@motion_options
@output_options
def check_command(bus: BusOptions, motion: MotionOptions, out: Output, machine_file: Path | None) -> None:
    """Look for wrong wiring at a first power-on: a tenth of the rated current, half a turn, 15 s at most.

    One table names what is wrong with supply, phases, current sensors, shaft or brake, pole pairs, counts per turn and
    encoder sign, the most likely cause first. MACHINE says what is connected; without it the drive's own set does.
    Nothing is stored in the drive. Exit code 1 when something is wrong, 10 when the shaft could not be judged.
    """
    from pmsmtool.cia402 import HOMING_LOST
    from pmsmtool.cli.consent import ask_motion
    from pmsmtool.commissioning.first_check import check_wiring, envelope_of
    from pmsmtool.errors import CheckFailed, Partial
    from pmsmtool.identification.wiring import NOT_SEEN, WRONG

    with open_drive(bus) as drive:
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
    out.result(
        "check",
        {"findings": [asdict(finding) for finding in found]},
        lambda: table(("looked at", "verdict", "seen", "likely"), [tuple(asdict(f).values()) for f in found]),
    )
    wrong = [finding for finding in found if finding.verdict == WRONG]
    if wrong:
        first = wrong[0]
        raise CheckFailed(
            f"{first.looked_at}: {first.shown}", likely=first.likely, hint="switch off, correct it, and check again"
        )
    unseen = [finding.looked_at for finding in found if finding.verdict == NOT_SEEN]
    if any(name in unseen for name in ("phases", "shaft", "pole pairs")):
        raise Partial(f"not judged: {', '.join(unseen)}", hint="correct what the table names, and check again")


def _stated(drive: CanopenDrive, path: Path | None) -> MachineFile:
    """Return what is stated of the machine; of two rated currents the smaller one."""
    from pmsmtool.machine.machine_file import load_machine_file
    from pmsmtool.measurement.identify import nameplate_of

    held = nameplate_of(drive, "held by the drive")
    if path is None:
        return held
    stated = load_machine_file(path)
    currents = [file.machine.I_nom_apk for file in (stated, held) if file.machine.I_nom_apk]
    return replace(stated, machine=replace(stated.machine, I_nom_apk=min(currents, default=None)))
