# SPDX-License-Identifier: MIT
"""Interrupt ``identify`` by Ctrl-C at many moments and look at the drive afterwards.

    python -m benchmarks.interrupted_identification --moments 50

A moment is a wait of the bus clock, evenly spread over one whole run. After each the drive must be off by its own
statusword and hold what it held before: checksums of the active and the stored set, limits, heartbeat, mode. One line
per moment that breaks this; exit 1 when there is one.
"""

from __future__ import annotations

import argparse
import signal
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pmsmtool.bus.clock import VirtualClock
from pmsmtool.bus.connect import connect
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.drive_node import is_safe
from pmsmtool.drive.parameters import DriveParameters
from pmsmtool.errors import Interrupted
from pmsmtool.identification.request import IdentifyRequest
from pmsmtool.measurement.identify import identify_stage, nameplate_of
from pmsmtool.run_directory import RunDirectory, new_record

OBJECTS = ((0x6073, 0), (0x6080, 0), (0x1016, 1), (0x6007, 0), (0x6060, 0))


@contextmanager
def interrupted_at(moment: int | None) -> Iterator[list[int]]:
    """Raise SIGINT at the given wait of the bus clock; yields a list whose only entry counts the waits."""
    counter = [0]
    pass_time = VirtualClock.wait

    def wait(self: VirtualClock, seconds: float) -> None:
        counter[0] += 1
        if counter[0] == moment:
            signal.raise_signal(signal.SIGINT)
        pass_time(self, seconds)

    VirtualClock.wait = wait  # type: ignore[method-assign]
    try:
        yield counter
    finally:
        VirtualClock.wait = pass_time  # type: ignore[method-assign]


def held(drive: CanopenDrive) -> tuple[int, int, tuple[bytes, ...]]:
    """Return what must be as before."""
    parameters = DriveParameters(drive.node)
    return parameters.crc_active, parameters.crc_stored, tuple(bytes(drive.node.sdo.read(*o)) for o in OBJECTS)


def attempt(profile: str, moment: int | None) -> tuple[int, list[str]]:
    """Identify once, interrupted at a moment or not at all; return the waits and what is wrong afterwards."""
    wrong = []
    with tempfile.TemporaryDirectory() as folder, connect("pmsmsim", f"{profile}?nv=:memory:") as connection:
        drive = CanopenDrive(connection, 1)
        before = held(drive)
        record = new_record(["benchmark"], drive={}, bus={}, versions={}, operator="nobody")
        run = RunDirectory.create(Path(folder), drive.identity.serial, record)
        ended = False
        with interrupted_at(moment) as counter:
            try:
                nameplate = nameplate_of(drive, profile)
                identify_stage(run, drive, nameplate, IdentifyRequest(), lambda lines: None, lambda text: None)
            except (Interrupted, KeyboardInterrupt):
                ended = True
        if ended != (moment is not None):
            wrong.append("not interrupted")
        if not is_safe(drive.node.state()) or drive.may_be_energised:
            wrong.append("not off")
        if held(drive) != before:
            wrong.append("not restored")
        drive.close()
    return counter[0], wrong


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--moments", type=int, default=50)
    parser.add_argument("--profile", default="interior-2k2")
    options = parser.parse_args()
    waits, wrong = attempt(options.profile, None)
    bad = len(wrong)
    moments = sorted({1 + k * (waits - 1) // options.moments for k in range(options.moments)})
    for moment in moments:
        _, wrong = attempt(options.profile, moment)
        if wrong:
            bad += 1
            print(f"wait {moment}: {', '.join(wrong)}")
    print(f"{len(moments)} moments over {waits} waits: {bad} not stopped or not restored")
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
