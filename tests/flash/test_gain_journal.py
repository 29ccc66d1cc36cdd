# SPDX-License-Identifier: MIT
"""Gains that a measurement changed and a killed program left: what the next connection brings back, and when not."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.objects import STATUSWORD, DriveObject
from pmsmtool.drive.port import Identity
from pmsmtool.errors import ConfigError, SafetyRefusal, VerifyMismatch
from pmsmtool.flash.gain_journal import GainJournal, any_left, path_of, restore_left
from pmsmtool.flash.journal import Entry, read_snapshot
from tests.drive.table_drive import TableDrive, node_of

GAIN, RATE = DriveObject(0x60F6, 1, "H"), DriveObject(0x60F6, 2, "H")
OLD = {GAIN: 300, RATE: 100}


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[TableDrive, DriveNode, Identity]]:
    monkeypatch.setenv("PMSMTOOL_HOME", str(tmp_path))
    with node_of(OLD) as (table, node):
        yield table, node, node.identity()


def journal_of(identity: Identity) -> GainJournal:
    entries = [Entry("gain", 0x60F6, 1, GAIN.encode(300)), Entry("rate", 0x60F6, 2, RATE.encode(100))]
    return GainJournal(identity, entries)


def change(table: TableDrive, journal: GainJournal, item: DriveObject, value: int) -> None:
    journal.note(item.index, item.sub, item.encode(value))
    table.objects[item.index, item.sub] = item.encode(value)


def left_changed(table: TableDrive, identity: Identity) -> GainJournal:
    """A run that has changed one gain and was killed."""
    journal = journal_of(identity)
    journal.begin()
    change(table, journal, GAIN, 210)
    return journal


def test_what_was_left_changed_comes_back_once(rig: tuple[TableDrive, DriveNode, Identity]) -> None:
    table, node, identity = rig
    assert restore_left(node, identity) == 0 and not any_left()
    journal = journal_of(identity)
    journal.begin()
    assert any_left() and restore_left(node, identity) == 0, "nothing had been changed yet"
    assert not any_left() and table.writes == []
    journal.begin()
    change(table, journal, GAIN, 210)
    snapshot = read_snapshot(path_of(identity))
    assert (snapshot.state, snapshot.signature, snapshot.identity.serial) == ("open", 0, 77)
    assert [entry.new for entry in snapshot.entries] == [GAIN.encode(210), None]
    assert restore_left(node, identity) == 1
    assert table.written(GAIN, RATE) == [(GAIN, 300)], "the one that was changed, and no other"
    assert not any_left() and restore_left(node, identity) == 0


def test_killed_between_the_note_of_the_old_value_and_its_write(rig: tuple[TableDrive, DriveNode, Identity]) -> None:
    """The gain stayed changed, and every later command was refused: it held "neither" (four writes of every run)."""
    table, node, identity = rig
    left_changed(table, identity).note(0x60F6, 1, GAIN.encode(300))
    assert restore_left(node, identity) == 1 and table.written(GAIN, RATE) == [(GAIN, 300)] and not any_left()


@pytest.mark.parametrize("status", [0x0237, 0x0217, 0x021F, 0x0000 | 0x77FF])
def test_an_energised_drive_keeps_what_it_holds(rig: tuple[TableDrive, DriveNode, Identity], status: int) -> None:
    table, node, identity = rig
    left_changed(table, identity)
    table.objects[0x6041, 0] = STATUSWORD.encode(status)
    with pytest.raises(SafetyRefusal, match="left gains of this drive changed"):
        restore_left(node, identity)
    assert table.writes == [] and any_left()


def test_what_neither_held_nor_was_written_is_left_alone(rig: tuple[TableDrive, DriveNode, Identity]) -> None:
    table, node, identity = rig
    left_changed(table, identity)
    table.objects[0x60F6, 2] = RATE.encode(99)
    with pytest.raises(SafetyRefusal, match="0x60F6:02 hold neither"):
        restore_left(node, identity)
    assert table.writes == [] and any_left()


def test_a_gain_that_does_not_come_back_keeps_the_journal(rig: tuple[TableDrive, DriveNode, Identity]) -> None:
    table, node, identity = rig
    journal = left_changed(table, identity)
    with pytest.raises(VerifyMismatch) as caught:
        journal.end(node)
    assert caught.value.differences == ("0x60F6:01 holds d2 00, before 2c 01",) and any_left()
    table.objects[0x60F6, 1] = GAIN.encode(300)
    journal.end(node)
    assert not any_left()


def test_of_another_drive_nothing_is_taken(rig: tuple[TableDrive, DriveNode, Identity]) -> None:
    table, node, identity = rig
    other = Identity(identity.node, identity.vendor, identity.product, identity.revision, 78, "", "", "")
    journal = journal_of(other)
    journal.begin()
    change(table, journal, GAIN, 210)
    assert restore_left(node, identity) == 0 and any_left() and table.writes == []


def test_a_damaged_journal_says_what_to_do(rig: tuple[TableDrive, DriveNode, Identity]) -> None:
    """It asked for a file of `pmsmtool backup`."""
    _, node, identity = rig
    path_of(identity).parent.mkdir(parents=True)
    path_of(identity).write_text("{", encoding="ascii")
    with pytest.raises(ConfigError, match="reset the drive"):
        restore_left(node, identity)
