# SPDX-License-Identifier: MIT
"""``pmsmtool identify hall``: order of the wires and alignment of Hall sensors."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from pmsmtool.cli.drive_access import new_run, open_drive
from pmsmtool.cli.options import BusOptions, MotionOptions
from pmsmtool.cli.output import Output, table
from pmsmtool.errors import NotAvailable
from pmsmtool.units import rad_s_from_rpm

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pmsmtool.drive_maps.drive_map import DriveMap
    from pmsmtool.identification.hall import HallAlignment

I_SHARE = 0.6
"""Current of the vector, of the rated one."""
SPEED_RPM = 120.0
DURATION_S = 90.0
TRACE = "traces/hall.npz"


def identify_hall(bus: BusOptions, motion: MotionOptions, out: Output, runs: Path, drive_map: DriveMap) -> None:
    """Turn the rotor over an electrical turn both ways, and say how the Hall sensors are wired and placed.

    Raises NotAvailable: the drive shows no Hall wires; IdentificationError: E_HALL.
    """
    from pmsmtool.cli.consent import ask_motion
    from pmsmtool.drive import objects
    from pmsmtool.drive.envelope import Envelope
    from pmsmtool.drive.guard import guarded
    from pmsmtool.experiments.rotation import WAY_RAD, turn_over_halls
    from pmsmtool.identification.hall import hall_alignment
    from pmsmtool.run_directory import Stage
    from pmsmtool.trace import trace_npz

    with open_drive(bus, drive_map) as drive:
        shown = objects.LIVE["hall_pattern"]
        if not drive.node.has(shown.index, shown.sub):
            raise NotAvailable(
                "the drive has no object that shows its Hall wires", where=f"node {drive.identity.node}",
                hint="only the reference drive is read so far (0x2070:1A)",
            )  # fmt: skip
        rated = drive.read("motor.I_nom_apk")
        envelope = Envelope(
            i_max_apk=motion.i_max_apk or rated, speed_max_rad_s=motion.speed_max_rad_s or rad_s_from_rpm(SPEED_RPM),
            duration_s=DURATION_S, shaft=motion.shaft or "free", load=motion.load, brake=motion.brake,
        )  # fmt: skip
        envelope.refuse_gravity()
        way = f"a current vector turns the shaft by {math.degrees(WAY_RAD):.0f} electrical degrees and back"
        lines = [*envelope.lines(), way, "nothing is stored in the drive; every changed object is restored"]
        ask_motion(lines, motion, simulated=bus.simulated(), serial=drive.identity.serial, out=out)
        run = new_run(bus, drive, runs)
        began = drive.node.connection.clock.now()
        with guarded(drive, envelope, say=out.note) as guard:
            guard.enable()
            trace = turn_over_halls(guard, min(I_SHARE * rated, envelope.i_max_apk))
        seconds = drive.node.connection.clock.now() - began
    run.save(TRACE, trace_npz(trace))
    found = hall_alignment(trace)
    wiring = found.wiring or "the wires are right"
    axes = {f"hall.axis_{wire}_rad": axis for wire, axis in enumerate(found.axes_rad, 1)}
    named = {"hall_offset_rad": found.offset_rad, "hall_lag_rad": found.lag_rad, **axes}
    values = [{"name": name, "value": value, "unit": "rad"} for name, value in named.items()]
    summary = f"Hall sensors {found.order}, {math.degrees(found.offset_rad):.3g} deg; {wiring}"
    run.add(Stage("identify hall", "pass", seconds, values=values, files={TRACE: ""}, summary=summary))
    data = {"run": run.path, **asdict(found), "wiring": found.wiring, "sectors": found.sectors(), **axes}
    out.result("identify.hall", data, lambda: _lines(found))
    if found.wiring:
        out.warn(found.wiring)
    out.note("by them: pmsmtool param set hall.commutation=2 " + " ".join(f"{k}={axes[k]:.4f}" for k in axes))
    out.note(f"run: {run.path}")


def _lines(found: HallAlignment) -> Iterator[str]:
    degrees = math.degrees
    rows = [
        ("order", found.order, "phase of the sensor on wires 1, 2, 3"),
        ("offset", f"{degrees(found.offset_rad):.1f} +- {degrees(found.offset_half_rad):.1f} deg", "electrical"),
        *(
            (f"error {x}", f"{degrees(error):+.1f} deg", "placement, electrical")
            for x, error in zip("abc", found.errors_rad, strict=True)
        ),
        ("lag", f"{degrees(found.lag_rad):.1f} deg", "of the rotor behind the vector: friction"),
    ]
    yield from table(("Hall sensors", "value", ""), rows)
    yield ""
    sectors = sorted(found.sectors().items(), key=lambda one: one[1])
    heads = ("wires 3 2 1", "middle of the sector")
    yield from table(heads, [(f"{pattern:03b}", f"{degrees(middle):.1f} deg") for pattern, middle in sectors])
