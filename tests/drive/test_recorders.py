# SPDX-License-Identifier: MIT
"""One contract for every kind of recorder: a DOMAIN with its CRC, blocks by count, numbered rows, rings of words."""

from __future__ import annotations

import pytest

from pmsmtool.bus.connect import connect
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.recorders.choice import described, recorder_of
from pmsmtool.drive.recorders.ingenia import MonitorRecorder
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import BusError, NotAvailable, PmsmtoolError, SdoAbort, VerifyMismatch
from tests.drive.recorder_rig import T_S, Opener, check

LOST_FRAME = """[[frame]]
action = "drop"
direction = "from-drive"
ids = "0x581"
after = {after}
count = 1
"""


@pytest.mark.parametrize(("samples", "decimation"), [(1, 1), (63, 1), (64, 1), (65, 3), (500, 1), (1000, 4)])
def test_a_record_is_complete_and_in_order(opened: Opener, samples: int, decimation: int) -> None:
    """Sizes around the blocks of 512 bytes (64 rows of two signals) and around segments."""
    rig = opened()
    samples = min(samples, rig.kind.capacity_rows)
    trace = rig.record(samples, decimation)
    check(trace, samples, decimation, rig.kind.quantum_v)
    assert trace.meta.get("control_period_s", T_S) == pytest.approx(T_S, rel=1e-5)


def test_one_record_after_another(opened: Opener) -> None:
    rig = opened()
    for wanted in (200, 64, 300):
        samples = min(wanted, rig.kind.capacity_rows)
        check(rig.record(samples, 2), samples, 2)


@pytest.mark.chain
def test_the_largest_record_fits_and_one_row_more_does_not(opened: Opener) -> None:
    rig = opened()
    check(rig.record(rig.kind.capacity_rows), rig.kind.capacity_rows, 1)
    with pytest.raises(NotAvailable, match="do not fit"):
        rig.record(rig.kind.capacity_rows + 1)
    check(rig.record(100), 100, 1)


def test_a_signal_it_has_not_is_named(opened: Opener) -> None:
    rig = opened()
    with pytest.raises(NotAvailable, match="warp_factor") as caught:
        rig.recorder.arm(("warp_factor",), 10, 1, 0, at_excitation=False)
    assert all(name in caught.value.hint for name in rig.kind.signals) or rig.kind.family == "pmsmsim"


@pytest.mark.chain
def test_lost_frames_never_give_a_wrong_record(opened: Opener) -> None:
    """One frame of the drive lost, at 12 places from set-up to data: the right record, or an error that says so."""
    right = wrong = 0
    rows = min(300, opened().kind.capacity_rows)
    for after in range(20, 260, 20):
        rig = opened(LOST_FRAME.format(after=after))
        try:
            trace = rig.record(rows)
        except (VerifyMismatch, BusError, SdoAbort):
            wrong += 1
            continue
        check(trace, rows, 1)
        right += 1
    assert right > 0
    assert right + wrong == 12
    if isinstance(rig.recorder, MonitorRecorder):
        assert wrong > 5  # a block that was taken cannot be asked for again


@pytest.mark.parametrize("off", [-1, 1])
def test_a_wrong_count_is_refused(opened: Opener, off: int) -> None:
    rig = opened()
    entry = rig.entry(*rig.kind.count)
    honest = entry.source
    assert honest is not None
    row = rig.kind.row_counts
    entry.source = lambda: entry.encode(max(0, int.from_bytes(honest(), "little") + off * row))
    with pytest.raises(PmsmtoolError) as caught:
        rig.record(rig.kind.capacity_rows)
    assert isinstance(caught.value, VerifyMismatch | BusError | SdoAbort)


def test_data_cut_short_is_refused(opened: Opener) -> None:
    where = f"0x{opened().kind.data:04X}:00"
    rig = opened(f'[[lie]]\nobject = "{where}"\nannounce = 0\ncut = 40\n')
    with pytest.raises(PmsmtoolError) as caught:
        rig.record(100)
    assert isinstance(caught.value, VerifyMismatch | BusError | SdoAbort)


def test_a_drive_without_a_readable_recorder_says_so() -> None:
    with connect("pmsmsim", "interior-2k2?nv=:memory:&drive=elmo") as connection:
        node = DriveNode(connection, 1, drive_map=load_family("elmo"))
        with pytest.raises(NotAvailable, match="no recorder that this program reads"):
            recorder_of(node, T_S)
        assert described(node).startswith("not read: the drive map 'elmo' has no recorder")
        assert described(DriveNode(connection, 1, drive_map=load_family("epos4"))) == "", "the map names none"
        node.close()


@pytest.mark.parametrize(("family", "what"), [("ingenia", "monitor"), ("copley", "trace"), ("epos2", "data recorder")])
def test_a_drive_whose_map_is_wrong_about_it_says_so(family: str, what: str) -> None:
    with connect("pmsmsim", "interior-2k2?nv=:memory:&drive=epos4") as connection:
        node = DriveNode(connection, 1, drive_map=load_family(family))
        with pytest.raises(NotAvailable, match=f"no {what}") as caught:
            recorder_of(node, T_S)
        assert described(node) == f"not read: {caught.value.what}" + f" ({caught.value.hint})" * bool(caught.value.hint)
        node.close()
