# SPDX-License-Identifier: MIT
"""Recorders of makers: started by command, counted instead of checked by a CRC; what each of them must refuse."""

from __future__ import annotations

import math
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pmsmtool.bus.connect import connect
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.recorders.choice import described, recorder_of
from pmsmtool.drive.recorders.commanded import CommandedRecorder
from pmsmtool.drive_maps import copley_objects, epos2_objects, ingenia_objects
from pmsmtool.drive_maps.drive_map_file import parse_drive_map
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import DriveTimeout, NotAvailable, VerifyMismatch
from pmsmtool.machine.machine_file import machine_path
from tests.drive.recorder_rig import KINDS, RIPPLE_HZ, RIPPLE_V, STEP_V, T_S, WHOLE_NS, Opener, Rig

COMMANDED = pytest.mark.parametrize("opened", ["index", "rows", "rings"], indirect=True)
COUNTED_ONCE = pytest.mark.parametrize("opened", ["rows", "rings"], indirect=True)
RINGS_ONLY = pytest.mark.parametrize("opened", ["rings"], indirect=True)
MONITOR_ONLY = pytest.mark.parametrize("opened", ["index"], indirect=True)


@pytest.fixture
def commanded(opened: Opener) -> Rig:
    return opened()


@COMMANDED
def test_triggers_it_has_not_are_named(commanded: Rig) -> None:
    for pretrigger, at_excitation in ((10, False), (0, True)):
        with pytest.raises(NotAvailable, match="by command"):
            commanded.recorder.arm(("U_dc_v",), 10, 1, pretrigger, at_excitation=at_excitation)


@COMMANDED
def test_what_it_cannot_count_or_average_is_refused(commanded: Rig) -> None:
    for decimation in (0, 0x10000):
        with pytest.raises(NotAvailable, match="not every"):
            commanded.recorder.arm(("U_dc_v",), 10, decimation, 0, at_excitation=False)
    with pytest.raises(NotAvailable, match="no averages"):
        commanded.recorder.start_average(("U_dc_v",), 10)
    with pytest.raises(NotAvailable, match="takes 1 to"):
        commanded.recorder.arm((), 10, 1, 0, at_excitation=False)


@COMMANDED
def test_it_says_what_it_can_take_and_how_fast(commanded: Rig) -> None:
    assert isinstance(commanded.recorder, CommandedRecorder)
    assert set(commanded.kind.signals) <= set(commanded.recorder.signals)
    assert commanded.recorder.period_s == pytest.approx(T_S, rel=WHOLE_NS)
    named = ", ".join(commanded.recorder.signals)
    assert described(commanded.node) == f"{commanded.recorder.what} of {named}, every {1e6 * T_S:.4g} us"


@COMMANDED
def test_a_recorder_that_does_not_fill_ends_in_time(commanded: Rig) -> None:
    where = {
        "monitor": ingenia_objects.FORCE_TRIGGER,
        "trace": copley_objects.RECORDED,
        "data recorder": epos2_objects.CONTROL,
    }
    assert isinstance(commanded.recorder, CommandedRecorder)
    entry = commanded.entry(*where[commanded.recorder.what][:2])
    entry.sink = lambda data: None
    if entry.source is not None:
        entry.source = lambda: entry.encode(0)
        commanded.entry(*copley_objects.STATUS[:2]).source = lambda: b"\x01\0"  # runs and runs
    with pytest.raises(DriveTimeout, match="does not finish"):
        commanded.record(100)


def _ran_on(rig: Rig) -> None:
    """The drive takes the stop, says that it stands, and records on."""
    control, status = {
        "rows": (copley_objects.START, copley_objects.STATUS),
        "rings": (epos2_objects.CONTROL, epos2_objects.STATUS),
    }[rig.node.map.capabilities.recorder]
    entry, told = rig.entry(*control[:2]), rig.entry(*status[:2])
    sink, source = entry.sink, told.source
    assert sink is not None and source is not None
    stops = (b"\0\0", b"\xfe\xff")
    entry.sink = lambda data: None if data in stops else sink(data)
    told.source = lambda: bytes([source()[0] & 0xFE, 0])


@pytest.mark.parametrize(("counted", "runs"), [(11, False), (10, True)])
@pytest.mark.parametrize("opened", ["rows"], indirect=True)
def test_a_trace_that_counts_or_says_that_it_runs_after_it_was_read_is_refused(
    commanded: Rig, monkeypatch: pytest.MonkeyPatch, counted: int, runs: bool
) -> None:
    commanded.recorder.arm(commanded.kind.signals, 10, 1, 0, at_excitation=False)
    commanded.node.connection.wait(20 * T_S)
    shown = {copley_objects.RECORDED: 10, copley_objects.LARGEST: 20, copley_objects.STATUS: 0}
    rows = bytes(10 * len(commanded.kind.signals) * copley_objects.NUMBER_BYTES)

    def upload(*_: Any, **__: Any) -> SimpleNamespace:
        shown.update({copley_objects.RECORDED: counted, copley_objects.STATUS: copley_objects.RUNNING_BIT * runs})
        return SimpleNamespace(data=rows)

    monkeypatch.setattr(commanded.recorder, "_get", lambda item: shown[item])
    monkeypatch.setattr(commanded.node.sdo, "upload", upload)
    with pytest.raises(VerifyMismatch, match="ran on while it was read"):
        commanded.recorder.fetch(commanded.kind.signals, 1)


@COUNTED_ONCE
def test_a_record_that_runs_on_while_it_is_read_is_refused(commanded: Rig) -> None:
    _ran_on(commanded)
    commanded.recorder.arm(commanded.kind.signals, 10, 1, 0, at_excitation=False)
    commanded.node.connection.wait(11 * T_S)
    with pytest.raises(VerifyMismatch, match="ran on|are there"):
        commanded.recorder.fetch(commanded.kind.signals, 1)


@COUNTED_ONCE
def test_the_drive_says_a_signal_of_the_map_is_none_of_its(commanded: Rig) -> None:
    channels = commanded.node.map.recorder.channels
    known = dict(channels)
    object.__setattr__(known["i_q_a"], "number" if known["i_q_a"].number else "index", 0x2F7F)
    with pytest.raises(NotAvailable, match=r"does not (trace|record) .*i_q_a"):
        commanded.record(10)


# ---- the trace and the rings alone -------------------------------------------------------------------


@RINGS_ONLY
@pytest.mark.parametrize(
    ("address", "lie", "complaint"),
    [
        (epos2_objects.LARGEST, 400, "has not taken"),
        (epos2_objects.FIRST, 300, "cannot begin at 300"),
        (epos2_objects.FIRST, 256, "cannot begin at 256"),
        (epos2_objects.RECORDED, 9, "9 of at most 256 are there"),
        (epos2_objects.RECORDED, 999, "999 of at most 256 are there"),
    ],
)
def test_rings_that_cannot_be_are_refused(
    commanded: Rig, address: tuple[int, int, str], lie: int, complaint: str
) -> None:
    entry = commanded.entry(*address[:2])
    entry.source = lambda: entry.encode(lie)
    with pytest.raises(VerifyMismatch) as caught:
        commanded.record(256)
    assert complaint in f"{caught.value} {caught.value.differences}"


@RINGS_ONLY
def test_a_buffer_without_the_last_word_is_refused(commanded: Rig) -> None:
    entry = commanded.entry(epos2_objects.BUFFER, 0)
    honest = entry.source
    assert honest is not None
    entry.source = lambda: honest()[: 2 * 256 * 2 - 1]
    with pytest.raises(VerifyMismatch) as caught:
        commanded.record(256)
    assert "512 words are in use, 1023 bytes came" in str(caught.value.differences)


@RINGS_ONLY
@pytest.mark.parametrize(("address", "later"), [(epos2_objects.FIRST, 1), (epos2_objects.STATUS, 0x3)])
def test_one_sign_of_a_ring_that_ran_on_is_enough(commanded: Rig, address: tuple[int, int, str], later: int) -> None:
    """The oldest sample has moved where the drive says that it stands, or it runs and nothing has moved yet."""
    buffer, entry = commanded.entry(epos2_objects.BUFFER, 0), commanded.entry(*address[:2])
    honest = buffer.source
    assert honest is not None

    def read() -> bytes:
        entry.source = lambda: entry.encode(later)
        return honest()

    buffer.source = read
    with pytest.raises(VerifyMismatch) as caught:
        commanded.record(256)
    assert "ran on while it was read" in str(caught.value.differences)


@RINGS_ONLY
def test_a_record_is_taken_as_soon_as_it_is_long_enough(commanded: Rig) -> None:
    """Ten samples are there and the drive runs on until it is told to stop."""
    recorded, status = (commanded.entry(*each[:2]) for each in (epos2_objects.RECORDED, epos2_objects.STATUS))
    control = commanded.entry(*epos2_objects.CONTROL[:2])
    honest, sink, bits = recorded.source, control.sink, [0x2, 0x3]
    assert honest is not None and sink is not None

    def told(data: bytes) -> None:
        bits[1:] = [] if int.from_bytes(data, "little") == epos2_objects.STOP else [0x3]
        sink(data)

    control.sink, status.source = told, lambda: status.encode(bits[-1])
    recorded.source = lambda: recorded.encode(min(10, int.from_bytes(honest(), "little")))
    assert len(commanded.record(10)) == 10


@RINGS_ONLY
def test_what_another_program_left_in_the_set_up_is_taken_back(commanded: Rig) -> None:
    """Automatic triggers, and samples kept from before the trigger."""
    entries = [commanded.entry(*each[:2]) for each in (epos2_objects.CONFIGURATION, epos2_objects.PRECEDING)]
    for entry in entries:
        entry.put(1)
    commanded.record(10)
    assert [entry.integer() for entry in entries] == [0, 0]


def test_a_period_that_is_no_multiple_of_the_drives_keeps_time(tmp_path: Path) -> None:
    """100 us in a drive that controls every 83.3 us: the ripple has its frequency."""
    path = tmp_path / "map.toml"
    text = re.sub(r'period = \{ unit = "[^"]*" \}', 'period = { unit = "100 us" }', KINDS["rings"].map_text())
    path.write_text(text, encoding="utf-8")
    machine = tmp_path / "machine.toml"
    ripple = f"[simulation]\nU_dc_ripple_v = {RIPPLE_V}\nU_dc_ripple_hz = {RIPPLE_HZ}\n"
    machine.write_text(machine_path("interior-2k2").read_text(encoding="utf-8").replace("[simulation]\n", ripple))
    with connect("pmsmsim", f"{machine}?nv=:memory:&drive={path}") as connection:
        node = DriveNode(connection, 1, drive_map=parse_drive_map(text, str(path)))
        recorder = recorder_of(node, T_S)
        recorder.arm(("U_dc_v",), 512, 3, 0, at_excitation=False)
        connection.wait(512 * 3e-4)
        trace = recorder.fetch(("U_dc_v",), 3)
        node.close()
    assert trace.meta["period_s"] == pytest.approx(3e-4)
    phase = 2.0 * math.pi * RIPPLE_HZ * trace.t_s
    basis = np.stack([np.ones_like(phase), np.cos(phase), np.sin(phase)], axis=1)
    rest = trace["U_dc_v"] - basis @ np.linalg.lstsq(basis, trace["U_dc_v"], rcond=None)[0]
    assert np.abs(rest).max() < 1.1 * STEP_V


def test_the_trace_of_a_completed_map_holds_six_variables(tmp_path: Path) -> None:
    """What a user's manual may add: voltages of the current loop, speed and position of his encoder."""
    more = [
        ("u_d_v", 19, "0.1 V"),
        ("u_q_v", 20, "0.1 V"),
        ("omega_M_rad_s", 23, "2.44140625e-05 rev/s"),
        ("position_rad", 31, "2.44140625e-04 rev"),
    ]
    rows = "".join(f'[recorder.{name}]\nnumber = {number}\nunit = "{unit}"\n' for name, number, unit in more)
    text = KINDS["rows"].map_text().replace("[left_out]", rows + "[left_out]")
    path = tmp_path / "map.toml"
    path.write_text(text, encoding="utf-8")
    with connect("pmsmsim", f"interior-2k2?nv=:memory:&drive={path}") as connection:
        node = DriveNode(connection, 1, drive_map=parse_drive_map(text, str(path)))
        recorder = recorder_of(node, T_S)
        names = ("i_d_a", "i_q_a", "u_d_v", "u_q_v", "omega_M_rad_s", "position_rad")
        recorder.arm(names, 341, 2, 0, at_excitation=False)
        connection.wait(341 * 2 * T_S)
        trace = recorder.fetch(names, 2)
        with pytest.raises(NotAvailable, match="takes 1 to 6"):
            recorder.arm((*names, "U_dc_v"), 10, 1, 0, at_excitation=False)
        node.close()
    assert len(trace) == 341 and set(trace.signals) == set(names)
    assert {name: trace.units[name] for name in ("u_q_v", "omega_M_rad_s")} == {"u_q_v": "V", "omega_M_rad_s": "rad/s"}


def test_the_shipped_map_of_epos2_says_which_line_is_missing() -> None:
    with connect("pmsmsim", "interior-2k2?nv=:memory:&drive=epos2") as connection:
        node = DriveNode(connection, 1, drive_map=load_family("epos2"))
        with pytest.raises(NotAvailable, match="one count of the recorder's period") as caught:
            recorder_of(node, T_S)
        assert "[recorder]" in caught.value.hint
        node.close()


# ---- the monitor alone -------------------------------------------------------------------------------


@MONITOR_ONLY
def test_a_block_that_came_twice_is_refused(commanded: Rig) -> None:
    """The drive counts on, but gives the first block again: the count betrays it when it does not match the bytes."""
    entry = commanded.entry(ingenia_objects.DATA, 0)
    honest = entry.source
    assert honest is not None
    first: list[bytes] = []

    def twice() -> bytes:
        first.append(honest())
        return first[-1] if len(first) < 3 else honest()  # the third takes two blocks off

    entry.source = twice
    with pytest.raises(VerifyMismatch, match="damaged") as caught:
        commanded.record(500)
    assert caught.value.differences == ("a block of 512 bytes took 1024 off the count, 512 were due",)


@MONITOR_ONLY
def test_another_row_length_is_refused(commanded: Rig) -> None:
    entry = commanded.entry(ingenia_objects.ROW_BYTES[0], 0)
    entry.source = lambda: entry.encode(12)
    with pytest.raises(VerifyMismatch, match="has not taken"):
        commanded.record(100)


def test_mapping_words_are_the_makers() -> None:
    """u_q: register 0x06F of axis 1, a float (8) of 4 bytes; as the maker's library arranges it."""
    assert ingenia_objects.mapping_word(0x206F, "REAL32", 4) == 0x106F_0804
    assert ingenia_objects.mapped_index(0x106F_0804) == 0x206F
