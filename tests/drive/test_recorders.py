"""One contract for every kind of recorder: the reference drive's DOMAIN with its CRC, the monitor's blocks by count."""

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
from pmsmtool.drive.monitor import MonitorRecorder, recorder_of
from pmsmtool.drive.recorder import Recorder
from pmsmtool.errors import BusError, DriveTimeout, NotAvailable, PmsmtoolError, SdoAbort, VerifyMismatch
from pmsmtool.firmware import monitor_objects
from pmsmtool.firmware.shipped_maps import load_family
from pmsmtool.machine.profile import machine_path
from pmsmtool.sim.node.dictionary import Entry
from pmsmtool.trace import Trace

RIPPLE_V, RIPPLE_HZ, U_DC_V = 20.0, 37.0, 540.0
T_S = 1.0 / 12_000.0
STEP_V = 2.0 * math.pi * RIPPLE_HZ * T_S * RIPPLE_V
"""Most that the rippling DC link moves from one period to the next: a missing or doubled block jumps further."""

WHOLE_NS = 1e-5
"""The reference drive says its period in whole nanoseconds: 83333 of 83333.3."""


@dataclass(frozen=True)
class Kind:
    """A recorder and where its drive keeps what a test falsifies."""

    family: str
    signals: tuple[str, str]
    capacity_rows: int
    count: tuple[int, int]

    def open(self, node: DriveNode) -> Recorder:
        return recorder_of(node, T_S)


KINDS = {
    "domain": Kind("pmsmsim", ("U_dc_v", "u_q_v"), 8192, (0x2060, 9)),
    "index": Kind("ingenia", ("U_dc_v", "u_q_v"), 1024, (monitor_objects.BYTES_LEFT[0], 0)),
}


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
LOST_FRAME = """[[frame]]
action = "drop"
direction = "from-drive"
ids = "0x581"
after = {after}
count = 1
"""


@pytest.fixture(params=KINDS)
def opened(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Opener]:
    kind = KINDS[request.param]
    text = machine_path("interior-2k2").read_text(encoding="utf-8")
    machine = tmp_path / "machine.toml"
    ripple = f"U_dc_ripple_v = {RIPPLE_V}\nU_dc_ripple_hz = {RIPPLE_HZ}\n"
    machine.write_text(text.replace("[simulation]\n", "[simulation]\n" + ripple), encoding="utf-8")
    stack = []

    @contextmanager
    def rig(faults: str) -> Iterator[Rig]:
        channel = f"{machine}?nv=:memory:&drive={kind.family}"
        if faults:
            path = tmp_path / f"faults-{len(stack)}.toml"  # programs with one channel share one line
            path.write_text(faults, encoding="utf-8")
            channel += f"&faults={path}"
        with connect("pmsmsim", channel) as connection:
            node = DriveNode(connection, 1, drive_map=load_family(kind.family))
            node.identity()
            try:
                yield Rig(kind, node, kind.open(node))
            finally:
                node.close()

    def start(faults: str = "") -> Rig:
        stack.append(rig(faults))
        return stack[-1].__enter__()

    yield start
    for one in reversed(stack):
        one.__exit__(None, None, None)


def check(trace: Trace, samples: int, decimation: int) -> None:
    """Complete, in order, nothing twice: the DC link moves as slowly as it can."""
    link = trace.signals["U_dc_v"]
    assert link.shape == trace.t_s.shape == (samples,)
    assert np.allclose(np.diff(trace.t_s), decimation * T_S, rtol=WHOLE_NS, atol=0.0)
    assert trace.meta["period_s"] == pytest.approx(decimation * T_S, rel=WHOLE_NS)
    assert trace.units["U_dc_v"] == "V"
    assert abs(float(link.mean()) - U_DC_V) < RIPPLE_V
    assert np.abs(np.diff(link, prepend=link[0])).max() <= decimation * STEP_V * 1.01 + 1e-3


@pytest.mark.parametrize(("samples", "decimation"), [(1, 1), (63, 1), (64, 1), (65, 3), (500, 1), (1000, 4)])
def test_a_record_is_complete_and_in_order(opened: Opener, samples: int, decimation: int) -> None:
    """Sizes around the blocks of 512 bytes (64 rows of two signals) and around segments."""
    rig = opened()
    check(rig.record(samples, decimation), samples, decimation)


def test_one_record_after_another(opened: Opener) -> None:
    rig = opened()
    for samples in (200, 64, 300):
        check(rig.record(samples, 2), samples, 2)


def test_the_largest_record_fits_and_one_row_more_does_not(opened: Opener) -> None:
    rig = opened()
    check(rig.record(rig.kind.capacity_rows), rig.kind.capacity_rows, 1)
    with pytest.raises(NotAvailable, match="do not fit"):
        rig.record(rig.kind.capacity_rows + 1)
    check(rig.record(100), 100, 1)


def test_a_signal_it_has_not_is_named(opened: Opener) -> None:
    rig = opened()
    with pytest.raises(NotAvailable, match="warp_factor"):
        rig.recorder.arm(("warp_factor",), 10, 1, 0, at_excitation=False)


def test_lost_frames_never_give_a_wrong_record(opened: Opener) -> None:
    """One frame of the drive lost, at 24 places from set-up to data: the right record, or an error that says so."""
    right = wrong = 0
    for after in range(20, 260, 10):
        rig = opened(LOST_FRAME.format(after=after))
        try:
            trace = rig.record(300)
        except (VerifyMismatch, BusError, SdoAbort):
            wrong += 1
            continue
        check(trace, 300, 1)
        right += 1
    assert right > 0
    assert right + wrong == 24
    if isinstance(rig.recorder, MonitorRecorder):
        assert wrong > 10  # a block that was taken cannot be asked for again


@pytest.mark.parametrize("off", [-1, 1])
def test_a_wrong_count_is_refused(opened: Opener, off: int) -> None:
    rig = opened()
    entry = rig.entry(*rig.kind.count)
    honest = entry.source
    assert honest is not None
    row = 8 if rig.kind.family == "ingenia" else 1
    entry.source = lambda: entry.encode(max(0, int.from_bytes(honest(), "little") + off * row))
    with pytest.raises(PmsmtoolError) as caught:
        rig.record(100)
    assert isinstance(caught.value, VerifyMismatch | BusError | SdoAbort)


def test_data_cut_short_is_refused(opened: Opener) -> None:
    data = {"pmsmsim": "0x2062:00", "ingenia": "0x58B2:00"}
    probe = opened()
    rig = opened(f'[[lie]]\nobject = "{data[probe.kind.family]}"\nannounce = 0\ncut = 40\n')
    with pytest.raises(PmsmtoolError) as caught:
        rig.record(100)
    assert isinstance(caught.value, VerifyMismatch | BusError | SdoAbort)


# ---- the monitor alone -------------------------------------------------------------------------------


@pytest.fixture
def monitor(opened: Opener) -> Rig:
    rig = opened()
    if not isinstance(rig.recorder, MonitorRecorder):
        pytest.skip("of the monitor")
    return rig


def test_a_block_that_came_twice_is_refused(monitor: Rig) -> None:
    """The drive counts on, but gives the first block again: the count betrays it when it does not match the bytes."""
    entry = monitor.entry(monitor_objects.DATA, 0)
    honest = entry.source
    assert honest is not None
    first: list[bytes] = []

    def twice() -> bytes:
        first.append(honest())
        return first[-1] if len(first) < 3 else honest()  # the third takes two blocks off

    entry.source = twice
    with pytest.raises(VerifyMismatch, match="damaged"):
        monitor.record(500)


def test_a_monitor_that_never_triggers_ends_in_time(monitor: Rig) -> None:
    monitor.entry(monitor_objects.FORCE_TRIGGER[0], 0).sink = lambda data: None
    with pytest.raises(DriveTimeout, match="does not finish"):
        monitor.record(100)


def test_another_row_length_is_refused(monitor: Rig) -> None:
    entry = monitor.entry(monitor_objects.ROW_BYTES[0], 0)
    entry.source = lambda: entry.encode(12)
    with pytest.raises(VerifyMismatch, match="has not taken"):
        monitor.record(100)


def test_triggers_it_has_not_are_named(monitor: Rig) -> None:
    for pretrigger, at_excitation in ((10, False), (0, True)):
        with pytest.raises(NotAvailable, match="by command"):
            monitor.recorder.arm(("U_dc_v",), 10, 1, pretrigger, at_excitation=at_excitation)


def test_mapping_words_are_the_makers() -> None:
    """u_q: register 0x06F of axis 1, a float (8) of 4 bytes; as the maker's library arranges it."""
    assert monitor_objects.mapping_word(0x206F, "REAL32", 4) == 0x106F_0804
    assert monitor_objects.mapped_index(0x106F_0804) == 0x206F


def test_a_drive_without_a_readable_recorder_says_so() -> None:
    with connect("pmsmsim", "interior-2k2?nv=:memory:&drive=copley") as connection:
        node = DriveNode(connection, 1, drive_map=load_family("copley"))
        with pytest.raises(NotAvailable, match="no recorder that this program reads"):
            recorder_of(node, T_S)
        node.close()


def test_a_drive_whose_map_is_wrong_about_it_says_so() -> None:
    with connect("pmsmsim", "interior-2k2?nv=:memory:&drive=epos4") as connection:
        node = DriveNode(connection, 1, drive_map=load_family("ingenia"))
        with pytest.raises(NotAvailable, match="no monitor"):
            recorder_of(node, T_S)
        node.close()
