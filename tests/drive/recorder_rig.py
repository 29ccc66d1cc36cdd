# SPDX-License-Identifier: MIT
"""A recorder of every kind on a simulated drive whose DC link ripples: what one after the other must show."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from pmsmtool.bus.connect import connect
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.recorders.choice import recorder_of
from pmsmtool.drive.recorders.reference import Recorder
from pmsmtool.drive_maps import copley_objects, epos2_objects, ingenia_objects
from pmsmtool.drive_maps.drive_map_file import dump_drive_map, parse_drive_map
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.machine.machine_file import machine_path
from pmsmtool.sim.node.dictionary import Entry
from pmsmtool.trace import Trace

RIPPLE_V, RIPPLE_HZ, U_DC_V = 20.0, 37.0, 540.0
T_S = 1.0 / 12_000.0
STEP_V = 2.0 * math.pi * RIPPLE_HZ * T_S * RIPPLE_V
"""Most that the rippling DC link moves from one period to the next: a missing or doubled block jumps further."""

WHOLE_NS = 1e-5
"""The reference drive says its period in whole nanoseconds: 83333 of 83333.3."""


RINGS = f"""[recorder]
period = {{ unit = "{1e6 * T_S!r} us" }}
U_dc_v = {{ index = 0x2F00, sub = 0, type = "UNSIGNED16", unit = "10 mV" }}
i_q_a = {{ index = 0x6078, sub = 0, type = "INTEGER16", unit = "mA rms" }}
"""
"""What the map of EPOS2 leaves to its user, and a DC link, which no EPOS2 has: it shows gaps in a record."""


@dataclass(frozen=True)
class Kind:
    """A recorder and where its drive keeps what a test falsifies."""

    family: str
    signals: tuple[str, str]
    capacity_rows: int
    count: tuple[int, int]
    data: int
    row_counts: int = 1
    quantum_v: float = 0.0
    completed: str = ""

    def map_text(self) -> str:
        """The shipped map, and what its user must add."""
        return dump_drive_map(load_family(self.family)).replace("[left_out]", self.completed + "[left_out]")

    def open(self, node: DriveNode) -> Recorder:
        return recorder_of(node, T_S)


KINDS = {
    "domain": Kind("pmsmsim", ("U_dc_v", "u_q_v"), 8192, (0x2060, 9), 0x2062),
    "index": Kind(
        "ingenia", ("U_dc_v", "u_q_v"), 1024, (ingenia_objects.BYTES_LEFT[0], 0), ingenia_objects.DATA, row_counts=8
    ),
    "rows": Kind("copley", ("U_dc_v", "i_q_a"), 1024, copley_objects.RECORDED[:2], copley_objects.DATA, quantum_v=0.1),
    "rings": Kind(
        "epos2", ("U_dc_v", "i_q_a"), 256, epos2_objects.RECORDED[:2], epos2_objects.BUFFER, quantum_v=0.01,
        completed=RINGS,
    ),
}  # fmt: skip


@dataclass
class Rig:
    """A recorder on a simulated drive of its kind, whose DC link ripples."""

    kind: Kind
    node: DriveNode
    recorder: Recorder

    def record(self, samples: int, decimation: int = 1) -> Trace:
        self.recorder.arm(self.kind.signals, samples, decimation, 0, at_excitation=False)
        self.node.connection.wait(samples * decimation * T_S)
        return self.recorder.fetch(self.kind.signals, decimation)

    def entry(self, index: int, sub: int) -> Entry:
        """An object of the simulated drive, behind the tool's back."""
        session = self.node.connection.bus.line.nodes[0].session  # type: ignore[attr-defined]
        return session.dictionary.find(index, sub)


Opener = Callable[..., Rig]


def check(trace: Trace, samples: int, decimation: int, quantum_v: float = 0.1) -> None:
    """Complete, in order, nothing twice: the DC link moves as slowly as it can."""
    link = trace.signals["U_dc_v"]
    assert link.shape == trace.t_s.shape == (samples,)
    assert np.allclose(np.diff(trace.t_s), decimation * T_S, rtol=WHOLE_NS, atol=0.0)
    assert trace.meta["period_s"] == pytest.approx(decimation * T_S, rel=WHOLE_NS)
    assert trace.units["U_dc_v"] == "V"
    assert abs(float(link.mean()) - U_DC_V) < RIPPLE_V + quantum_v
    assert np.abs(np.diff(link, prepend=link[0])).max() <= decimation * STEP_V * 1.01 + 1e-3 + quantum_v
    assert samples == 1 or np.ptp(link) > quantum_v  # it is no constant either


@contextmanager
def rig_of(kind: Kind, tmp_path: Path, faults: str = "") -> Iterator[Rig]:
    """Open a recorder; ``faults`` is the text of a faults file."""
    text = machine_path("interior-2k2").read_text(encoding="utf-8")
    machine = tmp_path / "machine.toml"
    ripple = f"U_dc_ripple_v = {RIPPLE_V}\nU_dc_ripple_hz = {RIPPLE_HZ}\n"
    machine.write_text(text.replace("[simulation]\n", "[simulation]\n" + ripple), encoding="utf-8")
    drive_map = load_family(kind.family)
    drive = kind.family
    if kind.completed:
        path = tmp_path / "map.toml"
        path.write_text(kind.map_text(), encoding="utf-8")
        drive_map, drive = parse_drive_map(kind.map_text(), str(path)), str(path)
    channel = f"{machine}?nv=:memory:&drive={drive}"
    if faults:
        path = tmp_path / f"faults-{len(list(tmp_path.iterdir()))}.toml"  # programs with one channel share one line
        path.write_text(faults, encoding="utf-8")
        channel += f"&faults={path}"
    with connect("pmsmsim", channel) as connection:
        node = DriveNode(connection, 1, drive_map=drive_map)
        node.identity()
        try:
            yield Rig(kind, node, kind.open(node))
        finally:
            node.close()
