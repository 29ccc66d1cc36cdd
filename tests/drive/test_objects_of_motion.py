# SPDX-License-Identifier: MIT
"""What the tool writes to and reads from objects of motion and supervision, on a drive that is a table of objects."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.drive import dead_man, objects
from pmsmtool.drive.canopen_drive import _buffer_periods
from pmsmtool.drive.guard import GuardedDrive
from pmsmtool.drive.motion_objects import PERIOD_EXPONENT, PERIOD_VALUE, TORQUE_SLOPE, cyclic_period_s, slow_slope_s
from pmsmtool.drive.objects import DC_LINK_MV, DriveObject
from pmsmtool.drive.port import Excitation, Injection, Shape
from pmsmtool.drive.torque_drives import TorqueDrive
from pmsmtool.drive_maps.drive_map import SignalCell
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import NotAvailable, SdoAbort
from tests.drive.table_drive import node_of


class Node:
    """Objects by address; what is ``fixed`` takes no write, and others do not exist."""

    def __init__(self, held: dict[DriveObject, float], fixed: tuple[DriveObject, ...] = ()) -> None:
        self.objects, self.fixed = held, fixed
        self.node = 1
        self.puts: list[tuple[DriveObject, float]] = []

    def get(self, item: DriveObject) -> float:
        if item not in self.objects:
            raise SdoAbort(AbortCode.NO_OBJECT, item.index, item.sub, "no such object")
        return self.objects[item]

    def held(self, item: DriveObject) -> float | None:
        return self.objects.get(item)

    def put(self, item: DriveObject, value: float) -> None:
        if item in self.fixed or item not in self.objects:
            raise SdoAbort(AbortCode.READ_ONLY, item.index, item.sub, "cannot be written")
        self.puts.append((item, value))
        self.objects[item] = value


@pytest.mark.parametrize(
    ("held", "fixed", "wanted_s", "period_s", "written"),
    [
        ({PERIOD_VALUE: 1, PERIOD_EXPONENT: -3}, (), 4.2e-3, 4e-3, [4]),
        ({PERIOD_VALUE: 4, PERIOD_EXPONENT: -3}, (), 4e-3, 4e-3, []),
        ({PERIOD_VALUE: 8, PERIOD_EXPONENT: -4}, (), 2e-3, 2e-3, [-3, 2]),
        ({PERIOD_VALUE: 20, PERIOD_EXPONENT: -4}, (PERIOD_VALUE, PERIOD_EXPONENT), 4e-3, 2e-3, []),
        ({PERIOD_VALUE: 5}, (PERIOD_VALUE,), 4e-3, 5e-3, []),  # without an exponent: milliseconds
        ({}, (), 4.2e-3, 4.2e-3, []),
    ],
)
def test_a_drive_is_asked_for_whole_milliseconds_and_believed_what_it_holds(
    held: dict[DriveObject, float], fixed: tuple[DriveObject, ...], wanted_s: float, period_s: float, written: list[int]
) -> None:
    node = Node(dict(held), fixed)
    assert cyclic_period_s(node, wanted_s) == pytest.approx(period_s)  # type: ignore[arg-type]
    assert [value for _, value in node.puts] == written


@pytest.mark.parametrize(
    ("slope", "seconds"), [(None, 0.0), (0, 0.0), (100, 10.0), (1999, 1000.0 / 1999.0), (2001, 0.0)]
)
def test_a_slope_of_more_than_half_a_second_leaves_nothing_of_a_push(slope: int | None, seconds: float) -> None:
    node = Node({} if slope is None else {TORQUE_SLOPE: slope})
    assert slow_slope_s(node) == pytest.approx(seconds)  # type: ignore[arg-type]


def test_node_guarding_waits_as_long_as_the_heartbeat_would(monkeypatch: pytest.MonkeyPatch) -> None:
    """50 ms between remote frames, five of which may be lost; the drive's own heartbeat goes off."""
    watched = {objects.LIFE_TIME_FACTOR: 0, objects.GUARD_TIME_MS: 0, objects.PRODUCER_HEARTBEAT_MS: 100}
    monkeypatch.setattr(dead_man, "_start", lambda node: None)
    for held, answers in ((watched, True), ({}, True), (watched, False)):
        node: Any = Node(dict(held))
        requested: list[int] = []
        node.supervision = SimpleNamespace(heartbeat_period_s=1.0, nmt_state=None)
        node.connection = SimpleNamespace(
            request=lambda cob_id, size, seen=requested: seen.append(cob_id),
            wait_until=lambda condition, seconds, answers=answers: answers,
        )
        heartbeat = SimpleNamespace(guarded_node=None)
        drive = SimpleNamespace(node=node, identity=SimpleNamespace(name="drive"))
        if not answers:
            with pytest.raises(Exception, match="does not answer the remote frames"):
                dead_man._set_guarding(drive, heartbeat)  # type: ignore[arg-type]
            continue
        assert dead_man._set_guarding(drive, heartbeat) == bool(held)  # type: ignore[arg-type]
        if held:
            assert node.objects == {
                objects.LIFE_TIME_FACTOR: pytest.approx(5.0), objects.GUARD_TIME_MS: pytest.approx(50.0),
                objects.PRODUCER_HEARTBEAT_MS: 0,
            }  # fmt: skip
            assert requested == [0x701] and heartbeat.guarded_node == 1


def test_of_the_voltages_only_the_link_has_an_object_of_every_drives() -> None:
    drive, family = object.__new__(TorqueDrive), load_family("cia402")
    shown = SignalCell(0x2100, 1, "INTEGER16", "10 mV")
    held = {DC_LINK_MV: 48_000, DriveObject(0x2100, 1, "h"): 1234}
    with node_of(held, family) as (_, drive.node):
        assert drive.live("U_dc_v") == pytest.approx(48.0)
        with pytest.raises(NotAvailable, match="does not show u_d_v"):
            drive.live("u_d_v")
    with node_of(held, replace(family, signals={"u_d_v": shown, "U_dc_v": shown})) as (table, drive.node):
        assert drive.live("u_d_v") == drive.live("U_dc_v") == pytest.approx(12.34)
        del table.objects[0x2100, 1]
        assert drive.live("U_dc_v") == pytest.approx(48.0), "the standard's, where it lacks its maker's own"
        del table.objects[0x6079, 0]
        with pytest.raises(NotAvailable, match="does not show U_dc_v"):
            drive.live("U_dc_v")


@pytest.mark.parametrize("by_ramp", [True, False])
@pytest.mark.parametrize(("name", "unproven"), [("motor.R_s_ohm", True), ("protection.n_trip_rpm", False)])
def test_a_ramp_stops_no_more_what_an_unproven_parameter_moves(by_ramp: bool, name: str, unproven: bool) -> None:
    guard = object.__new__(GuardedDrive)
    written: list[object] = []
    guard._drive = SimpleNamespace(stops_by_ramp=by_ramp, write=written.append)  # type: ignore[assignment]
    guard._stop_without_ramp = lambda: written.append("no ramp")  # type: ignore[method-assign]
    guard._pole_pairs, guard._R_s_ohm = 4.0, 1.0
    guard.write({name: 2.0})
    assert written == (["no ramp"] if by_ramp and unproven else []) + [{name: 2.0}]
    assert (guard._pole_pairs, guard._R_s_ohm) == (4.0, 2.0 if unproven else 1.0)


def test_a_buffer_lasts_as_often_as_each_of_its_values_is_held() -> None:
    stairs = Excitation(Shape.BUFFER, Injection.SPEED, 0.0, hold_periods=5, buffer=(1.0, 2.0, 3.0))
    assert (_buffer_periods(None), _buffer_periods(stairs)) == (0, 15)
