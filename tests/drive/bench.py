# SPDX-License-Identifier: MIT
"""A complete simulated drive (machine, inverter, firmware) in this process, and the tool's side of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from pmsmtool.bus.connect import Connection
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.envelope import Envelope
from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.sim.node.node import Node
from pmsmtool.sim.node.session import Session

PROFILE = "interior-2k2"
ENVELOPE = Envelope(i_max_apk=3.0, speed_max_rad_s=100.0)


@dataclass
class SimBench:
    """One simulated drive."""

    bus: PmsmSimBus
    connection: Connection
    drive: CanopenDrive

    @property
    def simulated(self) -> Node:
        """The drive behind the bus, to look behind the tool's back."""
        return self.bus.line.nodes[0]

    @property
    def session(self) -> Session:
        assert self.simulated.session is not None
        return self.simulated.session

    def memory(self) -> dict[tuple[int, int], bytes]:
        """Every writable object of the drive."""
        return {
            (entry.row.index, entry.row.sub): entry.read()
            for entry in self.session.dictionary
            if "w" in entry.row.access and entry.row.key not in COMMANDS
        }


COMMANDS = {
    "cia402.controlword",
    "excitation.command",
    "trace.command",
    "average.command",
    "parameter_set.command",
    "parameter_set.crc_expected",
    "error.history_length",
}
"""Written, but not what a restore brings back; the error history is a log."""


@contextmanager
def sim_bench(profile: str = PROFILE, **options: str) -> Iterator[SimBench]:
    query = "&".join(f"{key}={value}" for key, value in {"nv": ":memory:", "seed": "7", **options}.items())
    bus = PmsmSimBus(f"{profile}?{query}")
    with Connection(bus) as connection:
        yield SimBench(bus, connection, CanopenDrive(connection, 1))
