# SPDX-License-Identifier: MIT
"""A simulated drive on a line, and the tool's side of a download to it."""

from __future__ import annotations

import datetime
from dataclasses import dataclass
from pathlib import Path

from pmsmtool.bus.connect import Connection
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.port import Identity
from pmsmtool.drive_maps.drive_map import DriveMap, reference_map
from pmsmtool.firmware.image import crc32
from pmsmtool.flash.download import Download, Outcome
from pmsmtool.flash.journal import JournalFolder
from pmsmtool.flash.plan import Plan
from pmsmtool.flash.restore import marks_of, old_marks, plan_download, plan_restore
from pmsmtool.params.catalogue import CATALOGUE
from pmsmtool.params.parameter_set import ParameterSet, default_set
from pmsmtool.sim.node.memory import RamStorage
from tests.node.bench import Bench, open_bench

WHEN = datetime.datetime(2026, 11, 21, 9, 30, 0, 250_000)
SMALL = ParameterSet({"motor.R_s_ohm": 0.25, "motor.L_d_h": 0.003, "current.K_p_d_v_per_a": 7.5, "motor.pole_pairs": 5})


def with_tables(nodes: int = 9, kind: int = 1) -> ParameterSet:
    """Return a set with a look-up table of ``nodes`` x ``nodes`` cells."""
    descriptor = {"lut.format": kind, "lut.n_x": nodes, "lut.n_y": nodes, "lut.n_z": 1, "lut.lsb_a": 0.01}
    cells = nodes * nodes
    tables = {
        "lut.axis_x": [float(k) for k in range(nodes)],
        "lut.axis_y": [100.0 * (k + 1) for k in range(nodes)],
        "lut.axis_z": [300.0],
        "lut.i_d_a": [-0.01 * k for k in range(cells)],
        "lut.i_q_a": [0.02 * k for k in range(cells)],
    }
    return ParameterSet({**SMALL.values, **descriptor}, tables)


def with_changed_defaults() -> ParameterSet:
    """Return a full set with tables in which every REAL32 that can move has moved."""
    moved = {
        row.name: row.default * 1.01
        for row in CATALOGUE
        if not row.is_integer and row.default and row.minimum <= row.default * 1.01 <= row.maximum
    }
    return default_set().merged(ParameterSet(moved)).merged(with_tables())


@dataclass
class Rig:
    """One drive and one connection to it."""

    bench: Bench
    connection: Connection
    node: DriveNode
    identity: Identity
    root: Path

    def plan(self, wanted: ParameterSet) -> Plan:
        return plan_download(self.node, wanted)

    def download(self, wanted: ParameterSet, **options: bool) -> Outcome:
        plan = self.plan(wanted)
        return self.job(plan, marks_of(plan.content, WHEN)).run(**options)

    def job(self, plan: Plan, marks: dict[str, bytes]) -> Download:
        return Download(self.node, self.identity, plan, marks, self.folder)

    @property
    def folder(self) -> JournalFolder:
        return JournalFolder(self.identity, self.root)

    def restore(self) -> Outcome:
        """What ``pmsmtool restore`` without arguments does."""
        journal = self.folder.last()
        assert journal is not None
        return self.job(plan_restore(self.node, journal), old_marks(journal)).run(restoring=True)

    def image(self) -> bytes:
        """The drive's active set, asked of the drive itself behind the tool's back."""
        session = self.bench.node.session
        assert session is not None
        return session.parameters.active.pack()

    def crcs(self) -> tuple[int, int, int]:
        """CRC-32 of the active image, and what the drive reports for active and stored set."""
        session = self.bench.node.session
        assert session is not None
        return crc32(self.image()), session.parameters.active_crc, session.parameters.stored_crc


def open_rig(
    root: Path, *, storage: RamStorage | None = None, drive_map: DriveMap | None = None, faults: str | None = None
) -> Rig:
    bench = open_bench(storage=storage, faults=faults)
    bench.wait(0.1)
    return attach(bench, root, drive_map)


def attach(bench: Bench, root: Path, drive_map: DriveMap | None = None) -> Rig:
    """Connect (again) to the drive of a bench."""
    connection = Connection(bench.bus)
    node = DriveNode(connection, 1, drive_map=drive_map or reference_map())
    return Rig(bench, connection, node, node.identity(), root)
