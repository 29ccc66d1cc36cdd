# SPDX-License-Identifier: MIT
"""Snapshots from outside: one that is not this drive's is not compared, a damaged one blocks nothing and is kept."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from pmsmtool.cli.main import run
from pmsmtool.drive.port import Identity
from pmsmtool.drive_maps.eds import Eds, EdsObject
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import ConfigError, SafetyRefusal
from pmsmtool.flash.journal import (
    MARKS,
    DamagedSnapshot,
    Entry,
    JournalFolder,
    Snapshot,
    State,
    check_sum,
    parse_snapshot,
    read_snapshot,
    write_snapshot,
)
from pmsmtool.flash.plan import Change, Plan
from pmsmtool.flash.restore import check_snapshot, due_of_journal, take_backup
from pmsmtool.flash.whole_drive import _stated_vendor
from pmsmtool.params.catalogue import layout_signature
from tests.flash.rig import SMALL, open_rig
from tests.simulated_bus import settle

IDENTITY = Identity(1, 2, 3, 4, 5, "drive")
SNAPSHOT = Snapshot("journal", "open", IDENTITY, 7, "", (Entry("motor.R_s_ohm", 0x2010, 2, b"abcd", b"efgh"),))
BUS = ["-i", "pmsmsim", "-c", "interior-2k2"]


def changed(change) -> str:
    """The text of the snapshot after a change, with a check sum that fits."""
    body = json.loads(SNAPSHOT.dumps())
    del body["check"]
    change(body)
    return json.dumps({**body, "check": check_sum(body)})


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda body: body["identity"].update(vendor="x"), "vendor is text"),
        (lambda body: body["identity"].update(serial=-1), "serial = -1 is below 0"),
        (lambda body: body["identity"].pop("name"), "name is missing"),
        (lambda body: body["identity"].update(vendor=1 << 32), "vendor = 4.29497e+09 is above"),
        (lambda body: body["identity"].update(serial=1 << 65), "serial = 3.68935e+19 is above"),
        (lambda body: body.update(identity=[]), "identity is not a table"),
        (lambda body: body.update(signature=None), "signature is"),
        (lambda body: body.update(signature=1 << 32), "signature = 4.29497e+09 is above"),
        (lambda body: body.update(node=128), "node = 128 is above 127"),
        (lambda body: body.update(state="half"), "'half' is not one of open, done, restored"),
        (lambda body: body.update(node=1e400), "node = inf is not finite"),
        (lambda body: body.update(entries={}), "holds no entries"),
        (lambda body: body["entries"][0].update(object="0x2010"), "is not of the form 0x2010:02"),
        (lambda body: body["entries"][0].update(old="abc"), "not hexadecimal"),
        (lambda body: body["entries"][0].update(new=[]), "new is an array"),
        (lambda body: body["entries"].append(body["entries"][0]), "there twice"),
    ],
)
def test_every_part_of_a_snapshot_is_checked(change, said):
    with pytest.raises(DamagedSnapshot) as caught:
        parse_snapshot(changed(change), "journal.json")
    assert any(said in violation and "journal.json" in violation for violation in caught.value.violations)


def test_the_text_of_a_snapshot_comes_back():
    largest = replace(SNAPSHOT, signature=0xFFFFFFFF, identity=replace(IDENTITY, node=127, serial=0xFFFFFFFFFFFFFFFF))
    for snapshot in (SNAPSHOT, largest):
        assert parse_snapshot(snapshot.dumps(), "journal.json") == snapshot


def test_a_download_sets_a_damaged_journal_aside_and_says_so(tmp_path):
    rig = open_rig(tmp_path)
    rig.download(SMALL)
    good = rig.folder.last()
    assert good is not None
    older = rig.folder.path.with_name("journal-000000000000.json")
    write_snapshot(older, good)
    damaged = rig.folder.path.read_text()[:-40]
    rig.folder.path.write_text(damaged)
    with pytest.raises(DamagedSnapshot) as caught:
        rig.folder.last()
    assert "sets this one aside" in caught.value.hint and "journal-*.json" in caught.value.hint
    said: list[str] = []
    job = rig.job(rig.plan(replace(SMALL, values={**SMALL.values, "motor.R_s_ohm": 0.26})), {})
    job._say = said.append
    job.run()
    journal = rig.folder.last()
    assert journal is not None and journal.state == "done"
    (aside,) = rig.folder.path.parent.glob("journal-damaged-*.json")
    assert aside.read_text() == damaged and any(aside.name in line for line in said)
    assert read_snapshot(older) == good


def test_a_journal_of_another_version_is_not_set_aside(tmp_path):
    folder = JournalFolder(IDENTITY, tmp_path)
    folder.path.parent.mkdir(parents=True)
    folder.path.write_text(changed(lambda body: body.update(schema="pmsmtool.snapshot/2")))
    with pytest.raises(ConfigError, match=r"expected 'pmsmtool.snapshot/1'"):
        folder.set_aside_damaged()
    assert folder.path.exists()


@pytest.fixture(scope="module")
def backup(tmp_path_factory) -> Snapshot:
    rig = open_rig(tmp_path_factory.mktemp("rig"))
    found = take_backup(rig.node, rig.identity)
    return replace(found, identity=replace(found.identity, serial=22001))  # of the profile interior-2k2


def test_what_counts_as_old_until_another_set_follows(tmp_path: Path) -> None:
    """What stood there before the first of interrupted or repeated downloads; another set begins anew."""
    who = Identity(5, 1, 2, 3, 4, "", "", "")
    folder = JournalFolder(who, tmp_path)

    def begun(old: bytes, new: bytes) -> bytes:
        entries = (Entry("motor.R_s_ohm", 0x3000, 1, old, new),)
        return folder.begin(Snapshot("journal", "open", who, 0, "0" * 64, entries)).entries[0].old

    def done() -> None:
        last = folder.last()
        assert last is not None
        folder.close(last, "done")

    assert begun(b"\1", b"\2") == b"\1" and begun(b"\2", b"\3") == b"\1", "the first was interrupted"
    done()
    assert begun(b"\3", b"\3") == b"\1", "the same set again"
    done()
    assert begun(b"\3", b"\4") == b"\3", "another set"


def test_only_the_reference_set_has_a_layout(backup: Snapshot) -> None:
    assert backup.signature == layout_signature() and load_family("epos4").signature == 0
    assert {name for name, _, _ in MARKS} <= {entry.name for entry in backup.entries}


def of_identity(**change):
    return lambda snapshot: replace(snapshot, identity=replace(snapshot.identity, **change))


def first_entry(**change):
    return lambda snapshot: replace(snapshot, entries=(replace(snapshot.entries[0], **change), *snapshot.entries[1:]))


WRONG = {
    "another maker": (of_identity(vendor=0x9A), "vendor 0x0000009a"),
    "another product": (of_identity(product=0x77), "product 0x00000077"),
    "another serial": (of_identity(serial=99), "serial number 99"),
    "another layout": (lambda snapshot: replace(snapshot, signature=1), "layout 0x00000001"),
    "another object": (first_entry(sub=99), "the map states 0x"),
    "another size": (first_entry(old=b"abc"), "has 3 bytes"),
    "another name": (first_entry(name="motor.none"), "is not in the map"),
}


@pytest.mark.parametrize(("change", "said"), WRONG.values(), ids=WRONG)
def test_verify_compares_with_no_backup_of_another_drive(tmp_path, monkeypatch, capsys, backup, change, said):
    """Decoded with this drive's map, a gain of another maker read 7.7e-38 and was advised for `restore`."""
    settle(tmp_path, monkeypatch)
    write_snapshot(tmp_path / "b.json", change(backup))
    assert run([*BUS, "verify", "b.json"]) == 2
    printed = capsys.readouterr()
    assert said in printed.err and printed.out == ""


@pytest.mark.parametrize(("vendor", "refused"), [(0, True), (1, False)])
def test_drives_that_name_no_vendor_are_told_apart_by_their_name(vendor, refused):
    drive = replace(IDENTITY, vendor=vendor)
    mine = replace(SNAPSHOT, identity=drive, entries=(), signature=layout_signature())
    check_snapshot(load_family("pmsmsim"), mine, drive)
    other = replace(mine, identity=replace(drive, name="another"))
    if refused:
        with pytest.raises(ConfigError, match="calls itself 'drive', not 'another'"):
            check_snapshot(load_family("pmsmsim"), other, drive)
    else:
        check_snapshot(load_family("pmsmsim"), other, drive)


@pytest.mark.parametrize(
    ("value", "default", "vendor"),
    [("0x9A", "1", 0x9A), ("", "0x9A", 0x9A), ("7", "", 7), ("", "", 0), ("?", "", None)],
)
def test_a_data_sheet_states_its_vendor_by_value_or_default(value, default, vendor):
    item = EdsObject(0x1018, 1, "Vendor-ID", 0x07, "ro", None, None, default, value, 1)
    assert _stated_vendor(Eds({(0x1018, 1): item}, None, None, None, "", None, "utf-8", ())) == vendor
    assert _stated_vendor(Eds({}, 5, None, None, "", None, "utf-8", ())) is None


def test_a_spare_part_is_compared_when_that_is_asked_for(tmp_path, monkeypatch, capsys, backup):
    settle(tmp_path, monkeypatch)
    write_snapshot(
        tmp_path / "b.json", of_identity(serial=99)(first_entry(old=bytes(len(backup.entries[0].old)))(backup))
    )
    assert run([*BUS, "verify", "b.json"]) == 2
    assert "--other-drive" in capsys.readouterr().err
    assert run([*BUS, "verify", "b.json", "--other-drive"]) == 1
    assert "restore --other-drive b.json" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("state", "preparing", "holds", "due"),
    [
        ("open", False, b"other", 1),
        ("done", False, b"efgh", 1),
        ("done", True, b"other", 0),
        ("done", False, b"other", None),
        ("restored", False, b"efgh", None),
    ],
)
def test_a_journal_is_due_where_the_drive_holds_what_it_wrote(
    state: State, preparing: bool, holds: bytes, due: int | None
) -> None:
    entry = SNAPSHOT.entries[0]
    change = Change(entry.name, entry.index, entry.sub, holds, entry.old, 0.5, 0.4, 0.4, "ohm")
    folder: Any = SimpleNamespace(was_preparing=preparing, path="journal")
    plan = Plan((change,), {}, "")
    if due is None:
        with pytest.raises(SafetyRefusal, match="neither its old nor its new set"):
            due_of_journal(replace(SNAPSHOT, state=state), plan, folder)
    else:
        assert len(due_of_journal(replace(SNAPSHOT, state=state), plan, folder).entries) == due
