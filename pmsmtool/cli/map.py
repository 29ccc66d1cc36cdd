# SPDX-License-Identifier: MIT
"""``pmsmtool map``: what the objects of a drive count."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pmsmtool.cli.drive_access import claimed_node, map_of_drive, map_option, new_file
from pmsmtool.cli.options import FILE, BusOptions, MotionOptions, bus_options, examples, motion_options, output_options
from pmsmtool.cli.output import Output, table
from pmsmtool.errors import CheckFailed, ConfigError, IdentificationError, LimitExceeded, Partial
from pmsmtool.files import write_file

if TYPE_CHECKING:
    from pmsmtool.drive.speed_loop_drive import SpeedLoopDrive
    from pmsmtool.identification.learned_gains import Learned
    from pmsmtool.machine.machine_file import MachineFile
    from pmsmtool.measurement.changed_gains import GainObject
    from pmsmtool.measurement.learn_gains import LearnedLoop

OBJECT = re.compile(r"0x([0-9A-Fa-f]{4})(?::0?x?([0-9A-Fa-f]{1,2}))?")
NORMAL = 1.96


@click.group("map", epilog=examples("pmsmtool map learn --help"))
def map_group() -> None:
    """Find out what the objects of a drive count."""


@map_group.command(
    "learn",
    epilog=examples(
        "pmsmtool -n 5 map learn --machine motor.toml -o my-drive.toml --shaft free",
        "pmsmtool -n 5 map learn speed.K_p_nms_per_rad=0x30A2:01 --map epos4 --machine motor.toml -o my-drive.toml",
    ),
)
@click.argument("names", metavar="[NAME[=0xINDEX:SUB]]...", nargs=-1)
@click.option("--machine", "machine_path", type=FILE, required=True, metavar="FILE", help="The machine: its inertia.")
@new_file(help="Map file to write; none is written without it.")
@map_option
@bus_options
@motion_options
@output_options
def learn_command(
    bus: BusOptions,
    motion: MotionOptions,
    out: Output,
    names: tuple[str, ...],
    machine_path: Path,
    output: Path | None,
    map_file: Path | None,
) -> None:
    """Find out what one count of a gain of the speed, position or current loop is worth, by its response.

    The gains are changed by known ratios while the voltage is off, the speed is stepped, and the answers say scale and
    form of both gains, and whether shown currents are peak or rms; moves at even speed say what a position gain counts
    that its map names without a unit, a recorder at loop rate what current gains do. What is not decided stays unknown.
    The drive keeps its own gains: they are restored when the command ends, and if it is killed, by the next connection.

    The shaft must be free and without load. Scales rest on the inertia in the machine file and on its standard
    deviation in [std]; without one nothing that rests on the inertia is decided. Published scales of the map are
    checked. Exit code 0: all decided; 1: a published scale is contradicted; 5: a limit ended a move; 6: none; 10: some.
    """
    from pmsmtool.cli.consent import ask_motion
    from pmsmtool.drive.motion_objects import unlike_stated
    from pmsmtool.drive.speed_loop_drive import SpeedLoopDrive
    from pmsmtool.flash.map_gate import check_motion
    from pmsmtool.machine.machine_file import load_machine_file
    from pmsmtool.measurement.changed_gains import GAIN, INTEGRAL, gain_address, gain_object, refuse_unsafe
    from pmsmtool.measurement.learn_current_gains import current_gain_objects, learn_current_gains
    from pmsmtool.measurement.learn_gains import learn_speed_loop, learning_envelope
    from pmsmtool.measurement.learn_position_gain import BESIDE, POSITION, learn_position_gain, position_gain_objects
    from pmsmtool.measurement.learned_rows import emf_of, learned_gains, winding_of

    asked = _addresses(names)
    file = load_machine_file(machine_path)
    machine = file.machine
    if not machine.J_kgm2 or not machine.top_rpm:
        raise ConfigError(
            "the scale of a gain rests on the inertia, and the speed limit on the largest speed",
            where=f"{machine_path}: [machine]", hint="add J_kgm2, and n_max_rpm or n_nom_rpm",
        )  # fmt: skip
    drive_map = map_of_drive(bus, map_file)
    with bus.connect() as connection:
        drive = SpeedLoopDrive(connection, claimed_node(connection, bus.node), drive_map=drive_map)
        node = drive.node
        check_motion(node.map, drive.identity)
        found = {}
        for name in (GAIN, INTEGRAL):
            found[name] = gain_object(node, name, *(asked.get(name) or gain_address(node, name)))
        found |= position_gain_objects(node, asked) | current_gain_objects(node, asked)
        envelope = learning_envelope(
            drive, file, motion.i_max_apk, motion.speed_max_rad_s, motion.shaft, motion.load, motion.brake
        )
        refuse_unsafe(node, envelope)
        lines = [
            *envelope.lines(),
            *unlike_stated(node),
            "the shaft turns at up to 70 % of the speed limit, both ways; its own speed loop takes steps",
            *(["then its position loop moves it by up to five turns, 25 times at most"] if POSITION in found else []),
            *(f"{gain.name} in {gain.address} holds {gain.counts:.9g}: it is changed while the voltage is off, and "
              "restored" for gain in found.values()),
            "nothing is stored in the drive; every changed object is restored",
        ]  # fmt: skip
        ask_motion(lines, motion, simulated=bus.simulated(), serial=drive.identity.serial, out=out)

        def decided(measured: LearnedLoop) -> bool:
            return all(gain.scale is not None for gain in learned_gains(file, measured).values())

        measured = learn_speed_loop(drive, found[GAIN], found[INTEGRAL], envelope, emf_of(file), out.note, decided)
        results, loop = learned_gains(file, measured), measured.base[0].loop
        of_currents, stopped = learn_current_gains(drive, found, envelope, loop, winding_of(file), out.note)
        results |= of_currents
        if POSITION in found and stopped is None:
            of_moves, stopped = learn_position_gain(connection, node, found[POSITION], envelope, out.note)
            results |= of_moves
        drive.close()
    for note in measured.notes:
        out.warn(note)
    told = {name: results[name] for name in (*asked, *BESIDE) if name in results}
    _tell(file, drive, measured, found, told, output, out, stopped)


def _addresses(names: tuple[str, ...]) -> dict[str, tuple[int, int] | None]:
    """Return the wanted names with their objects, None where none is given."""
    from pmsmtool.measurement.changed_gains import STANDARD
    from pmsmtool.measurement.learn_current_gains import CURRENT_GAIN, CURRENT_INTEGRAL
    from pmsmtool.measurement.learn_position_gain import POSITION

    known = (*STANDARD, POSITION, CURRENT_GAIN, CURRENT_INTEGRAL)
    asked: dict[str, tuple[int, int] | None] = {}
    for text in names:
        name, mark, where = text.partition("=")
        match = OBJECT.fullmatch(where)
        if name not in known or (mark and match is None):
            raise ConfigError(
                f"{text!r} is no gain that can be learned",
                hint=f"NAME or NAME=0xINDEX:SUB, with {' or '.join(known)}",
            )
        asked[name] = (int(match[1], 16), int(match[2] or "0", 16)) if match else None
    return asked or dict.fromkeys(known)


def _tell(
    file: MachineFile,
    drive: SpeedLoopDrive,
    measured: LearnedLoop,
    found: Mapping[str, GainObject],
    results: Mapping[str, Learned],
    output: Path | None,
    out: Output,
    stopped: LimitExceeded | None,
) -> None:
    """Print what was learned, write the map, and end as it deserves: first of all with a limit that stopped a move."""
    from pmsmtool.drive_maps.drive_map_file import dump_drive_map
    from pmsmtool.measurement.learned_rows import map_with, measured_row, shown_currents

    currents = shown_currents(file, measured, drive)
    rows = [measured_row(found[name], result) for name, result in results.items() if result.scale is not None]
    cells = drive.node.map.cells
    against = [text for row in rows if row.name in cells and (text := row.against(cells[row.name]))]
    facts = {
        "gains": [{"object": found[name].address, "counts": found[name].counts, **asdict(result)}
                  for name, result in results.items()],
        "currents": asdict(currents), "speed_unit_rad_s": measured.speed_unit_rad_s, "contradicts": against,
    }  # fmt: skip
    heads = ("gain", "object", "one count", "+- 95 %", "form", "why not")
    lines = [
        (name, found[name].address, "unknown" if r.scale is None else f"{r.scale:.4g} {r.unit}",
         f"{100 * r.half_width:.0f} %" if math.isfinite(r.half_width) else "-", r.form or "unknown", r.why or "-")
        for name, r in results.items()
    ]  # fmt: skip
    lines.append(
        ("shown current", "-", "-", f"{100 * NORMAL * currents.std_log:.0f} %", currents.kind or "unknown",
         currents.why or "-")
    )  # fmt: skip
    out.result("map.learn", facts, lambda: table(heads, lines))
    if output is not None and rows and not against:
        write_file(output, dump_drive_map(map_with(drive, rows, currents.kind)))
        out.note(f"wrote {output}")
    if stopped is not None:
        raise stopped
    if against:
        raise CheckFailed(
            "; ".join(against), likely="the map is of another firmware, or of other settings of the drive",
            hint="nothing was written; compare the map with the drive's manual",
        )  # fmt: skip
    unknown = [name for name, result in results.items() if result.scale is None]
    if len(unknown) == len(results):
        raise IdentificationError("E_EXCITATION", "no gain was decided", hint="the table has the reason of each")
    if unknown:
        raise Partial(f"not decided: {', '.join(unknown)}", hint="the table has the reason")
