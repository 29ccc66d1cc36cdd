# SPDX-License-Identifier: MIT
"""Order and alignment of Hall sensors on random simulated drives, over CANopen frames.

    python -m benchmarks.hall_alignment --drives 100

Machines follow from their seeds (``random_drives.py``). Their sensors are wired in each of the six orders in turn,
turned by up to 25 degrees, and each is misplaced by 5 to 15 degrees, electrical. Right is the order; the angle is
compared with the best fit of sectors, which is the turn plus the mean of the three errors.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.random_drives import draw_drive
from pmsmtool.bus.connect import connect
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.guard import guarded
from pmsmtool.errors import PmsmtoolError
from pmsmtool.experiments.rotation import turn_over_halls
from pmsmtool.identification.hall import HallAlignment, hall_alignment
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file
from pmsmtool.machine.parameters import HALL_ORDERS
from pmsmtool.sim.simulated_machine import settings_of

ERROR_DEG, TURN_DEG = (5.0, 15.0), 25.0
I_SHARE = 0.6
"""Current of the vector, of the rated one: that of ``identify hall``."""


def with_halls(seed: int) -> tuple[MachineFile, str, float]:
    """Return a drive with Hall sensors, the order of their wires, and the angle of the best fit of sectors (rad)."""
    rng = np.random.default_rng([20261124, seed])
    order = HALL_ORDERS[seed % len(HALL_ORDERS)]
    turn = math.radians(float(rng.uniform(-TURN_DEG, TURN_DEG)))
    errors = np.radians(rng.uniform(*ERROR_DEG, 3) * rng.choice([-1.0, 1.0], 3))
    drive = draw_drive(seed)
    halls = {f"hall_error_{phase}_rad": float(error) for phase, error in zip("abc", errors, strict=True)}
    settings = {**drive.simulation, **halls, "hall_order": order, "hall_offset_rad": turn}
    truth = replace(drive, simulation=settings)
    seen = settings_of(truth)  # with leads exchanged the sensors stand otherwise to the drive's phases
    middle = float(np.mean([seen.number(f"hall_error_{phase}_rad") for phase in "abc"]))
    return truth, seen.text("hall_order"), seen.number("hall_offset_rad") + middle


def aligned(truth: MachineFile) -> HallAlignment:
    """Return what the sensors of a simulated drive are found to be."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.toml"
        path.write_text(dump_machine_file(truth), encoding="utf-8")
        with connect("pmsmsim", f"{path}?nv=:memory:") as connection:
            drive = CanopenDrive(connection, 1)
            rated = drive.read("motor.I_nom_apk")
            with guarded(drive, Envelope(rated, 60.0)) as guard:
                guard.enable()
                trace = turn_over_halls(guard, I_SHARE * rated)
            drive.close()
    return hall_alignment(trace)


def main() -> None:
    """Run the drives; print a line for every one, and what was right."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    asked = parser.parse_args()
    right, off, inside = 0, [], 0
    for seed in range(asked.first, asked.first + asked.drives):
        truth, order, angle = with_halls(seed)
        try:
            found = aligned(truth)
        except PmsmtoolError as refusal:
            print(f"{seed}: {type(refusal).__name__}: {refusal.what}", flush=True)
            continue
        error = math.remainder(found.offset_rad - angle, 2.0 * math.pi)
        right += found.order == order
        off.append(abs(math.degrees(error)))
        inside += abs(error) <= found.offset_half_rad
        print(f"{seed}: {order} found {found.order}, {math.degrees(error):+.2f} deg off", flush=True)
    print(f"order right: {right} of {asked.drives}")
    print(f"angle: median {np.median(off):.2f} deg, largest {max(off):.2f} deg off; {inside} inside their interval")


if __name__ == "__main__":
    main()
