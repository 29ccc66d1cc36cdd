# SPDX-License-Identifier: MIT
"""Makers' recorders under the guard: every setting is again what somebody else had left in the drive."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.guard import guarded
from pmsmtool.drive.port import Recording
from pmsmtool.drive.recorder_drives import MappedRecorderDrive
from pmsmtool.drive.recorders.commanded import numbered
from pmsmtool.drive_maps import epos2_objects as rings
from pmsmtool.drive_maps import ingenia_objects as monitor
from pmsmtool.drive_maps.recorder_map import Address
from pmsmtool.errors import Interrupted, VerifyMismatch
from tests.drive.recorder_rig import KINDS, Rig, rig_of

ENVELOPE = Envelope(i_max_apk=5.0, speed_max_rad_s=100.0, duration_s=60.0)
U_Q, U_D = 0x206F, 0x206E
SECOND_MAP: Address = (monitor.FIRST_MAP[0] + 1, *monitor.FIRST_MAP[1:])

LEFT: dict[str, dict[Address, int]] = {
    "index": {
        monitor.FIRST_MAP: monitor.mapping_word(U_D, "REAL32", 4),
        SECOND_MAP: monitor.mapping_word(U_Q, "REAL32", 4),
        monitor.MAPPED: 2,
        monitor.DIVIDER: 7,
        monitor.WINDOW: 33,
        monitor.TRIGGER_KIND: 0,
    },
    "rings": {
        rings.FIRST_INDEX: 0x2F00,
        rings.FIRST_SUB: 0,
        numbered(rings.FIRST_INDEX, 1): 0x6078,
        numbered(rings.FIRST_SUB, 1): 0,
        rings.USED: 2,
        rings.PERIOD: 9,
        rings.PRECEDING: 3,
        rings.CONFIGURATION: 2,
    },
}
"""What a maker's own program left: other signals, another period, triggers of its own."""
SIGNALS = {"index": ("u_q_v", "omega_e_rad_s"), "rings": ("i_q_a",)}


@pytest.fixture(params=LEFT)
def left(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[Rig, MappedRecorderDrive, str]]:
    """A drive whose recorder somebody has set up."""
    with rig_of(KINDS[request.param], tmp_path) as rig:
        for address, value in LEFT[request.param].items():
            entry = rig.entry(*address[:2])
            entry.value = entry.encode(value)
        drive = MappedRecorderDrive(rig.node.connection, 1, drive_map=rig.node.map)
        yield rig, drive, request.param
        drive.close()


def held(rig: Rig, kind: str) -> dict[Address, int]:
    return {a: int.from_bytes(rig.entry(*a[:2]).read(), "little") for a in LEFT[kind]}


@pytest.mark.parametrize("interrupted", [False, True])
def test_its_settings_are_brought_back(left: tuple[Rig, MappedRecorderDrive, str], interrupted: bool) -> None:
    """Also after a record that ends in its middle: while it runs its settings could not be written."""
    rig, drive, kind = left
    assert held(rig, kind) == LEFT[kind]
    with contextlib.suppress(Interrupted), guarded(drive, ENVELOPE, prove=False):
        drive.may_be_energised = True  # as between enabling and stopping
        recording = Recording(SIGNALS[kind], 200, 2)
        drive.begin_record(recording, drive.wait)
        changed = [address for address, value in held(rig, kind).items() if value != LEFT[kind][address]]
        assert len(changed) >= 5
        if interrupted:
            raise KeyboardInterrupt
        drive.wait(0.1)
        assert len(drive.traces.fetch(drive._names(recording.signals), 2)) == 200
    assert held(rig, kind) == LEFT[kind]


def test_a_setting_that_does_not_come_back_is_named(left: tuple[Rig, MappedRecorderDrive, str]) -> None:
    rig, drive, kind = left
    stuck = {"index": monitor.WINDOW, "rings": rings.PERIOD}[kind]
    with pytest.raises(VerifyMismatch) as caught, guarded(drive, ENVELOPE, prove=False):
        drive.may_be_energised = True
        drive.begin_record(Recording(SIGNALS[kind], 200, 2), drive.wait)
        rig.entry(*stuck[:2]).sink = lambda data: None
    assert any(f"0x{stuck[0]:04X}:{stuck[1]:02X} does not hold" in line for line in caught.value.differences)
