# SPDX-License-Identifier: MIT
"""Objects of a drive that are changed come back, also after a killed run; its own limits are lowered."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from pmsmtool.bus.nmt import NmtState
from pmsmtool.drive import heartbeat as beating
from pmsmtool.drive import objects
from pmsmtool.drive.changed_objects import (
    LEAST_COUNTS,
    OFTEN,
    ChangedObjects,
    any_lent,
    lower_limits,
    put_limit,
    restore_lent,
)
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.motion_objects import MAX_TORQUE_PERMILLE, Quantity
from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive.parameters import DriveParameters
from pmsmtool.drive.port import Identity
from pmsmtool.drive_maps.drive_map import reference_map
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import DriveFault, NotAvailable, SafetyRefusal, SdoAbort, VerifyMismatch
from tests.bus.scripted import NODE
from tests.drive.table_drive import Held, node_of

GENERIC = load_family("cia402")


def changed_of(node: DriveNode) -> ChangedObjects:
    drive: Any = SimpleNamespace(node=node, parameters=DriveParameters(node), replace=None, identity=LENT)
    return ChangedObjects(drive)


A, B, LIMIT = DriveObject(0x6071, 0, "h"), DriveObject(0x60FF, 0, "i"), DriveObject(0x6073, 0, "H")
LENT = Identity(NODE, 0xA51, 2, 3, 417, "", "", "")


@pytest.mark.parametrize("serial", [417, 0])
def test_what_a_killed_run_left_comes_back_with_the_next_command(
    serial: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next download stored the lowered limits of a killed `identify` with its own values, and exited with 0."""
    monkeypatch.setenv("PMSMTOOL_HOME", str(tmp_path))  # other tests leave records of drives that fell silent
    killed, identity = {A: 5, B: 6, objects.MODE: 3, objects.STATUSWORD: 0x40}, replace(LENT, serial=serial)
    with node_of(killed, GENERIC) as (table, node):
        changed = changed_of(node)
        changed._drive.identity = identity
        changed.begin()
        for item, value in ((A, 50), (B, 60), (A, 70), (objects.MODE, 4)):
            node.put(item, value)
        assert any_lent() is bool(serial)
        table.objects[0x60FF, 0] = B.encode(61)  # somebody else wrote it since: it stays
        node.before_write = None
        table.objects[0x6041, 0] = objects.STATUSWORD.encode(0x27)
        assert restore_lent(node, identity, print) == 0, "energised"
        table.objects[0x6041, 0] = objects.STATUSWORD.encode(0x40)
        assert restore_lent(node, identity, print) == (2 if serial else 0)
        assert (node.get(A), node.get(B)) == (5.0 if serial else 70.0, 61.0) and not any_lent()
    with node_of({A: 5}, GENERIC) as (_, node):
        changed = changed_of(node)
        changed.begin()
        node.put(A, 50)
        assert any_lent() and changed.restore() == 1 and not any_lent()


@pytest.mark.parametrize("held", [50, 70, 5])
def test_what_was_written_before_the_last_note_comes_back_too(
    held: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A program killed between a note and its write left its limits lowered, and the record was removed."""
    monkeypatch.setenv("PMSMTOOL_HOME", str(tmp_path))
    with node_of({A: 5, objects.STATUSWORD: 0x40}, GENERIC) as (table, node):
        changed_of(node).begin()
        node.put(A, 50)
        node.put(A, 70)
        node.before_write = None
        table.objects[0x6071, 0] = A.encode(held)
        assert restore_lent(node, LENT, print) == (held != 5) and node.get(A) == 5.0 and not any_lent()


def test_an_object_that_is_commanded_again_and_again_is_recorded_no_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PMSMTOOL_HOME", str(tmp_path))
    kept: list[int] = []
    keep = ChangedObjects._keep
    monkeypatch.setattr(ChangedObjects, "_keep", lambda self: (kept.append(1), keep(self)))
    with node_of({A: 5, B: 6, objects.STATUSWORD: 0x40}, GENERIC) as (_, node):
        changed_of(node).begin()
        for value in range(100, 300):
            node.put(A, value)
            node.put(B, 60 + value % 2)
        node.before_write = None
        assert len(kept) == OFTEN + 1 + 2
        assert restore_lent(node, LENT, print) == 2 and (node.get(A), node.get(B)) == (5.0, 6.0) and not any_lent()


def test_what_a_drive_refuses_to_take_back_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PMSMTOOL_HOME", str(tmp_path))
    with node_of({A: 5, B: 6, objects.STATUSWORD: 0x40}, GENERIC) as (table, node):
        changed = changed_of(node)
        changed.begin()
        node.put(A, 50)
        node.put(B, 60)
        node.before_write = None
        kept = table.objects.pop((0x6071, 0))
        assert restore_lent(node, LENT, print) == 1 and node.get(B) == 6.0 and any_lent()
        table.objects[0x6071, 0] = kept
        assert restore_lent(node, LENT, print) == 1 and node.get(A) == 5.0 and not any_lent()


@pytest.mark.parametrize("text", ["{", "[1]", '{"6073:00": 5}', '{"6073:00": ["zz", "05"]}', "\xff"])
def test_a_damaged_record_of_a_killed_run_is_said(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It was dropped without a word, or ended in a traceback, and the lowered limits could have been stored."""
    monkeypatch.setenv("PMSMTOOL_HOME", str(tmp_path))
    said: list[str] = []
    with node_of({A: 5, objects.STATUSWORD: 0x40}, GENERIC) as (_, node):
        changed_of(node)._keep()
        (record,) = (tmp_path / "lent").glob("*.json")
        record.write_text(text, encoding="latin-1")
        assert restore_lent(node, LENT, said.append) == 0 and not any_lent()
    assert "may still be lowered" in said[0] and "nmt reset-node" in said[0] and str(record) in said[0]


def test_what_was_changed_comes_back_in_reverse_and_once() -> None:
    with node_of({A: 5, B: 6, objects.MODE: 3}, GENERIC) as (table, node):
        changed = changed_of(node)
        changed.begin()
        for item, value in ((A, 50), (B, 60), (A, 70), (objects.MODE, 4)):
            node.put(item, value)
        assert (changed.held_before(A), changed.held_before(B)) == (5.0, 6.0)
        assert changed.held_before(objects.STATUSWORD) is None
        table.objects[0x60FF, 0] = B.encode(6)  # the drive brought it back by itself
        table.writes.clear()
        assert changed.restore() == 2
        assert table.written(A, B, objects.MODE) == [(objects.MODE, 3), (A, 5)]
        node.put(A, 1)
        assert changed.held_before(A) == 5.0 and node.before_write is None, "no longer noted"


@pytest.mark.parametrize(
    ("item", "code", "named"),
    [(LIMIT, 0x06090030, "0x6073:00: node refused"), (objects.MODE, 0x06090030, ""), (A, 0x08000022, "")],
)  # fmt: skip
def test_a_refused_old_value_is_named_but_of_mode_and_targets(item: DriveObject, code: int, named: str) -> None:
    with node_of({A: 5, objects.MODE: 3, LIMIT: 5}, GENERIC) as (table, node):
        changed = changed_of(node)
        changed.begin()
        node.put(item, 9)
        table.fixed[item.index, 0] = code
        if not named:
            assert changed.restore() == 0
            return
        with pytest.raises(VerifyMismatch) as caught:
            changed.restore()
        assert caught.value.differences[0].startswith(named) and len(caught.value.differences) == 1


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (VerifyMismatch("the drive does not hold it", differences=["motor.R_s_ohm: wrote 1, reads 2"]), "wrote 1"),
        (DriveFault("the drive refused 1 of 1 value"), "refused 1 of 1"),
        (SdoAbort(0x06090030, 0x2010, 2, "node refused: value"), "node refused"),
    ],
)  # fmt: skip
def test_the_limits_come_back_where_a_parameter_does_not(error: Exception, told: str) -> None:
    """They had stayed lowered: the parameters came first, and their error ended the restore."""

    def refused(changed: object) -> None:
        raise error

    with node_of({A: 5, B: 6}, reference_map()) as (table, node):
        table.objects[0x2010, 2] = bytes(4)
        changed = changed_of(node)
        changed._drive.replace = refused  # type: ignore[method-assign]
        changed.begin()
        node.put(A, 50)
        node.put(B, 60)
        node.write_bytes(0x2010, 2, b"\0\0\x80\x3f")
        with pytest.raises(VerifyMismatch, match="not everything could be restored") as caught:
            changed.restore()
        assert [told in line for line in caught.value.differences] == [True]
        assert (table.number(A), table.number(B)) == (5, 6)


@pytest.mark.parametrize(("code", "busy_s", "comes_back"), [(0x08000021, 4.5, True), (0x08000022, 9.0, False)])
def test_a_busy_drive_is_asked_again_for_its_old_values(code: int, busy_s: float, comes_back: bool) -> None:
    """It had been left with lowered limits where it was busy for an instant, or refused one object for its state."""
    with node_of({A: 5, LIMIT: 6}, GENERIC) as (table, node):
        changed = changed_of(node)
        changed.begin()
        node.put(A, 50)
        node.put(LIMIT, 60)
        table.fixed[LIMIT.index, 0] = code
        table.bus.clock.after(busy_s, table.fixed.clear)
        if comes_back:
            assert changed.restore() == 2 and busy_s < node.connection.clock.now() < busy_s + 0.2
        else:
            with pytest.raises(SdoAbort):
                changed.restore()
            assert node.connection.clock.now() < 5.3 and table.number(A) == 5, "the others came back"


def test_an_object_that_takes_its_old_value_and_does_not_keep_it() -> None:
    item = DriveObject(0x2042, 0, "Q")
    with node_of({item: 0x0102030405060708}, GENERIC) as (table, node):
        changed = changed_of(node)
        changed.begin()
        node.write_bytes(0x2042, 0, bytes(12))
        table.shown[item] = lambda: 7
        with pytest.raises(VerifyMismatch) as caught:
            changed.restore()
        assert caught.value.differences == ("0x2042:00 does not hold 08 07 06 05 04 03 02 01 again",)


@pytest.mark.parametrize(
    ("wanted", "most", "kept"),
    [(1.0, 9.0, 1.0), (1.09, 9.0, 1.0), (9.0, 1.05, 1.0), (LEAST_COUNTS * 0.1, 9.0, LEAST_COUNTS * 0.1),
     (LEAST_COUNTS * 0.1 - 0.01, 9.0, None), (9.0, 0.2, None)],
)  # fmt: skip
def test_a_limit_is_kept_in_whole_counts_and_never_above(wanted: float, most: float, kept: float | None) -> None:
    """One count is 0.1 A; below four of them the drive is not asked."""
    with node_of({objects.MAX_CURRENT_PERMILLE: 77}) as (table, node):
        found = put_limit(node, Quantity(objects.MAX_CURRENT_PERMILLE, 0.1), wanted, most)
        assert found == (None if kept is None else pytest.approx(kept))
        held = table.number(objects.MAX_CURRENT_PERMILLE)
        assert held == (77 if kept is None else round(10.0 * kept))
        table.fixed[0x6073, 0] = 0x08000022
        assert put_limit(node, Quantity(objects.MAX_CURRENT_PERMILLE, 0.1), 2.0, 9.0) is None
        assert put_limit(node, None, 2.0, 9.0) is None


RATED: Held = {objects.RATED_CURRENT_MA: 4000}
RATED_APK = 4.0 * math.sqrt(2.0)


@pytest.mark.parametrize(
    ("more", "bounded", "current", "speed"),
    [
        ({objects.MAX_CURRENT_PERMILLE: 3000, objects.MAX_SPEED_RPM: 6000}, False, ("0x6073", 531), ("0x6080", 955)),
        ({objects.MAX_CURRENT_PERMILLE: 500, objects.MAX_SPEED_RPM: 900}, False, ("0x6073", 500), ("0x6080", 900)),
        ({MAX_TORQUE_PERMILLE: 3000}, True, ("0x6072", 531), None), ({}, True, None, None),
        ({objects.MAX_CURRENT_PERMILLE: 3000}, False, "lacks", r"of its speed \(0x6080\)$"),
        ({objects.MAX_SPEED_RPM: 6000}, False, "lacks", r"of its current \(0x6073, 0x6072\)$"),
    ],
)  # fmt: skip
def test_the_drives_own_limits_are_lowered_to_the_envelope(more: Held, bounded: bool, current: Any, speed: Any) -> None:
    """3 A of 5.66 A are 530.3 permille, 100 rad/s are 954.9 rpm: rounded up, and never raised."""
    with node_of({**RATED, **more}, GENERIC) as (table, node):
        drive: Any = SimpleNamespace(node=node, commands_bounded_current=bounded, shows_apk=math.inf)
        envelope = Envelope(i_max_apk=3.0, speed_max_rad_s=100.0)
        if current == "lacks":
            with pytest.raises(NotAvailable) as caught:
                lower_limits(drive, envelope)
            assert re.search(speed, caught.value.what), "the limit that it has is not named"
            return
        found = lower_limits(drive, envelope)
        for quantity, most, expected, unit in (
            (found.current, found.most_apk, current, 1e-3 * RATED_APK), (found.speed, found.most_rpm, speed, 1.0),
        ):  # fmt: skip
            if expected is None:
                assert quantity is None and most == math.inf
            else:
                assert str(quantity) == expected[0] and most == pytest.approx(expected[1] * unit)
                assert quantity is not None and table.number(quantity.item) == expected[1]


@pytest.mark.parametrize(("ratio", "refused"), [(30.0, False), (30.1, True), (math.inf, True), (math.nan, True)])
def test_a_limit_of_more_than_thirty_times_the_rated_current_is_none(ratio: float, refused: bool) -> None:
    with node_of(RATED, GENERIC) as (_, node):
        drive: Any = SimpleNamespace(node=node, commands_bounded_current=True, shows_apk=math.inf)
        envelope = Envelope(i_max_apk=ratio * RATED_APK, speed_max_rad_s=100.0)
        if not refused:
            lower_limits(drive, envelope)
            return
        with pytest.raises(SafetyRefusal, match="is none: the drive is rated 5.657 A"):
            lower_limits(drive, envelope)


@pytest.mark.parametrize(("holds", "refused"), [(600, True), (531, False), (400, False)])
def test_a_limit_that_the_drive_does_not_hold_is_refused(holds: int, refused: bool) -> None:
    with node_of({**RATED, objects.MAX_CURRENT_PERMILLE: 3000}, GENERIC) as (table, node):
        reads = [3000, holds]
        table.shown[objects.MAX_CURRENT_PERMILLE] = lambda: reads[bool(table.writes)]
        drive: Any = SimpleNamespace(node=node, commands_bounded_current=True, shows_apk=math.inf)
        envelope = Envelope(i_max_apk=3.0, speed_max_rad_s=100.0)
        if not refused:
            assert lower_limits(drive, envelope).most_apk == pytest.approx(531e-3 * RATED_APK)
            return
        with pytest.raises(SafetyRefusal, match="holds the limit 600, not the 531") as caught:
            lower_limits(drive, envelope)
        assert "0x6073:00" in caught.value.where


def test_states_that_the_tool_says_of_itself() -> None:
    assert (NmtState.OPERATIONAL, beating.DUMMY, len(beating.NUMBERS)) == (5, b"\0", 4)
