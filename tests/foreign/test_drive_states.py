# SPDX-License-Identifier: MIT
"""Drives that take a mode or a target in certain states only (0x08000022 in others): enabled, moved, and given back."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import cast

import pytest

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.connect import connect
from pmsmtool.bus.nmt import find_nodes
from pmsmtool.cia402 import State
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.guard import WATCH_S, guarded
from pmsmtool.drive.position_drive import PositionDrive
from pmsmtool.drive.standard_drive import TorqueCurrent
from pmsmtool.drive.torque_drives import TorqueDrive
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.sim.line import Frame
from pmsmtool.sim.node.dictionary import Refused
from pmsmtool.sim.node.node import Node
from tests.foreign.data_sheets import Row, unknown, write_eds

ENVELOPE = Envelope(i_max_apk=3.0, speed_max_rad_s=100.0)
POSITION: tuple[Row, ...] = (
    (0x6062, 0, "I32", "ro", ""), (0x607A, 0, "I32", "rw", "0"), (0x6081, 0, "U32", "rw", "0"),
    (0x6083, 0, "U32", "rw", "0"),
)  # fmt: skip
OFF = (State.SWITCH_ON_DISABLED,)
NOT_ENABLED = tuple(state for state in State if state is not State.OPERATION_ENABLED)


@pytest.mark.parametrize(
    ("index", "refused_in", "kind"),
    [
        (0x6060, OFF, TorqueDrive),
        (0x6060, OFF, PositionDrive),
        (0x6071, NOT_ENABLED, TorqueDrive),
        (0x607A, NOT_ENABLED, PositionDrive),
    ],
)
def test_what_is_taken_in_some_states_only(
    tmp_path: Path, index: int, refused_in: tuple[State, ...], kind: Callable[..., TorqueCurrent]
) -> None:
    """`identify` and `move` had ended here, the latter with the current limit left lowered."""
    eds = write_eds(tmp_path / "drive.eds", unknown("0x2D", *POSITION))
    with connect("pmsmsim", f"interior-2k2?nv=:memory:&eds={eds}") as connection:
        node = cast(Node, connection.bus.line.nodes[0])  # type: ignore[attr-defined]
        assert node.session is not None
        power, find = node.session.power, node.session.dictionary.find
        entry = find(index, 0)
        take = entry.sink

        def choosy(data: bytes) -> None:
            if power.state in refused_in:
                raise Refused(AbortCode.DEVICE_STATE)
            entry.value = bytes(data)
            if take is not None:
                take(data)

        entry.sink = choosy
        before = {limit: find(limit, 0).read() for limit in (0x6073, 0x6080, 0x6007)}
        drive = kind(connection, 1, drive_map=load_family("cia402"))
        with guarded(drive, ENVELOPE) as guard:
            guard.enable()
            if isinstance(drive, PositionDrive):
                drive.move_to(0.1)
            else:
                guard.command_current(0.0, 0.5)
            guard.wait(3.0 * WATCH_S)
            assert power.state is State.OPERATION_ENABLED and find(0x6073, 0).read() != before[0x6073]
        drive.close()
        assert not power.state.energised
        assert {limit: find(limit, 0).read() for limit in before} == before


def test_one_lost_answer_is_no_missing_drive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """ "no drive answers", and the wiring as its cause, where one frame was lost."""
    hear, lost = PmsmSimBus.hear, []

    def hears(self: PmsmSimBus, frame: Frame, own: bool) -> None:
        if not own and frame.can_id == 0x581 and not lost:
            lost.append(frame)
        else:
            hear(self, frame, own)

    monkeypatch.setattr(PmsmSimBus, "hear", hears)
    eds = write_eds(tmp_path / "drive.eds", unknown())
    with connect("pmsmsim", f"interior-2k2?nv=:memory:&eds={eds}") as connection:
        assert [found.node for found in find_nodes(connection)] == [1] and lost
