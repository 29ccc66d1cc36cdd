# SPDX-License-Identifier: MIT
"""A foreign drive saved by its data sheet and brought to a spare part: all equal, what is refused is named."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import cast

import pytest
from click.testing import CliRunner, Result

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.connect import connect
from pmsmtool.cli.main import cli
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.parameters import DriveParameters
from pmsmtool.drive.port import Identity
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import ConfigError, Interrupted, Partial
from pmsmtool.flash.download import Download
from pmsmtool.flash.journal import JournalFolder, Snapshot, read_snapshot
from pmsmtool.flash.restore import check_snapshot, old_marks, plan_download, plan_restore
from pmsmtool.flash.whole_drive import (
    Listed,
    WholeDrive,
    kept_objects,
    other_product,
    readdressed,
    require_read,
    take_whole_backup,
    whole_map,
)
from pmsmtool.params.parameter_set import ParameterSet
from pmsmtool.sim.node.dictionary import Refused
from pmsmtool.sim.node.node import Node
from tests.foreign.data_sheets import Row, epos4, write_eds
from tests.simulated_bus import settle

STORE: tuple[Row, ...] = ((0x1010, 0, "U8", "ro", "1"), (0x1010, 1, "U32", "rw", "1"))
PDO: tuple[Row, ...] = (
    (0x1800, 0, "U8", "ro", "2"), (0x1800, 1, "U32", "rw", "$NODEID+0x180"), (0x1800, 2, "U8", "rw", "255"),
    (0x1A00, 0, "U8", "rw", "1"), (0x1A00, 1, "U32", "rw", "0x60410010"), (0x1A00, 2, "U32", "rw", "0"),
)  # fmt: skip
ROWS = (*epos4(), *STORE, *PDO, (0x2000, 0, "U8", "rw", "1"), (0x31E4, 1, "U16", "rw", "0"))
CHANGED = {(0x30A0, 1): 777_000, (0x30A0, 2): 888_000, (0x3001, 2): 9000, (0x6080, 0): 2900, (0x1017, 0): 250}


@contextmanager
def opened(path: Path, machine: str = "interior-2k2") -> Iterator[DriveNode]:
    with connect("pmsmsim", f"{machine}?nv=:memory:&eds={path}") as connection:
        node = DriveNode(connection, 1)
        yield node
        node.close()


def listed() -> list[Listed]:
    names = {0x2000: "Node ID", 0x31E4: "Internal data recorder controlword"}
    return [Listed(i, s, names.get(i, "object")) for i, s, _, access, _ in ROWS if access == "rw"]


def write(node: DriveNode, values: dict[tuple[int, int], int]) -> None:
    for (index, sub), value in values.items():
        node.sdo.download(index, sub, value.to_bytes(len(node.sdo.read(index, sub)), "little"))


def map_pdo(node: DriveNode) -> None:
    write(node, {(0x1800, 1): 0x80000181, (0x1A00, 0): 0, (0x1A00, 1): 0x60640020, (0x1A00, 2): 0x60410010})
    write(node, {(0x1A00, 0): 2, (0x1800, 2): 1, (0x1800, 1): 0x181})


def refuse(node: DriveNode, *places: tuple[int, int]) -> None:
    simulated = cast(Node, node.connection.bus.line.nodes[0])  # type: ignore[attr-defined]
    simulated.set_faults(
        refuse=lambda index, sub: AbortCode.VALUE if (index, sub) in places else None, distort=None, store_scale=1.0
    )


def job(node: DriveNode, snapshot, folder: Path) -> Download:  # type: ignore[no-untyped-def]
    identity = node.identity()
    node.map = whole_map(identity)
    plan = plan_restore(node, snapshot)
    return Download(node, identity, plan, old_marks(snapshot), JournalFolder(identity, folder))


def test_commands_set_points_and_what_is_of_one_device_are_left_out() -> None:
    kept, left_out = kept_objects(listed())
    order = [(item.index, item.sub) for item in kept]
    assert order.index((0x6080, 0)) < order.index((0x1017, 0)), "communication last"
    reasons = {label[:9]: why for label, why in left_out.items()}
    for place in ("0x2000:00", "0x31E4:01", "0x1010:01", "0x6040:00", "0x6071:00", "0x60FF:00"):
        assert place in reasons
    names = ("Internal LR Identification Control", "Current Mode Setting Value", "Serial number", "Controller gain")
    kept, left_out = kept_objects(Listed(0x2400, sub, name) for sub, name in enumerate(names))
    assert [item.name for item in kept] == ["Controller gain"] and len(left_out) == 3
    (kept, left_out) = kept_objects([Listed(0x2706, 1, "Save all Parameters", copied=False)])
    assert not kept and "ObjFlags" in left_out["0x2706:01 Save all Parameters"], "one maker's own save command"
    commands = (0x1003, 0x1010, 0x1011, 0x1013, 0x1023, 0x1026, 0x6040)
    assert not kept_objects(Listed(index, 1, "object") for index in commands)[0]
    # of the second and the last axis: a torque and a brake's output were saved, and restored into a spare part
    further = [index + axis * 0x800 for index in (0x6040, 0x6071, 0x607A, 0x60FE, 0x60FF) for axis in (1, 7)]
    kept, left_out = kept_objects(Listed(index, 1, "object") for index in (*further, 0x6873, 0xA071))
    assert [item.index for item in kept] == [0x6873, 0xA071] and len(left_out) == len(further)


def test_a_spare_part_holds_all_of_it(tmp_path: Path) -> None:
    path = write_eds(tmp_path / "x.eds", ROWS)
    with opened(path) as node:
        write(node, CHANGED)
        map_pdo(node)
        saved, _ = take_whole_backup(node, node.identity(), listed())
    with opened(path, "mtpv-test") as node:
        with pytest.raises(ConfigError, match="--other-drive|serial"):
            check_snapshot(whole_map(node.identity()), saved, node.identity())
        check_snapshot(whole_map(node.identity()), saved, node.identity(), other_drive=True)
        outcome = job(node, saved, tmp_path).run()
        assert not outcome.refused and outcome.stored and outcome.written >= len(CHANGED) + 3
        for entry in saved.entries:
            assert node.sdo.read(entry.index, entry.sub) == entry.old, entry.name


def test_what_a_backup_lacks_is_told_from_what_the_drive_lacks(tmp_path: Path) -> None:
    """An object that is there and could not be read was left out with exit code 0."""
    with opened(write_eds(tmp_path / "x.eds", ROWS)) as node:
        asked = (*listed(), Listed(0x2FFF, 0, "of another firmware"))
        require_read(take_whole_backup(node, node.identity(), asked)[1], tmp_path)
        simulated = cast(Node, node.connection.bus.line.nodes[0])  # type: ignore[attr-defined]
        assert simulated.session is not None

        def refused() -> bytes:
            raise Refused(AbortCode.DEVICE_STATE)

        simulated.session.dictionary.find(0x30A0, 1).source = refused
        with pytest.raises(Partial, match="in the backup: 1") as caught:
            require_read(take_whole_backup(node, node.identity(), asked)[1], tmp_path)
        assert len(caught.value.missing) == 1 and caught.value.missing[0].startswith("0x30A0:01")


def test_an_object_where_the_reference_drive_keeps_its_set(tmp_path: Path) -> None:
    """0x2001 of a maker's own was overwritten by the simulated drive's set when it was stored."""
    with opened(write_eds(tmp_path / "x.eds", (*ROWS, (0x2001, 0, "I32", "rw", "-5")))) as node:
        node.sdo.download(0x2001, 0, b"\xf7\xff\xff\xff")
        node.store()
        node.reset()
        assert node.sdo.read(0x2001, 0) == b"\xf7\xff\xff\xff"


def test_a_refused_object_is_named_and_takes_nothing_along(tmp_path: Path) -> None:
    path = write_eds(tmp_path / "x.eds", ROWS)
    with opened(path) as node:
        write(node, CHANGED)
        saved, _ = take_whole_backup(node, node.identity(), listed())
    with opened(path, "mtpv-test") as node:
        refuse(node, (0x30A0, 1), (0x6080, 0))
        outcome = job(node, saved, tmp_path).run()
        assert {name[:9] for name in outcome.refused} == {"0x30A0:01", "0x6080:00"}
        for entry in saved.entries:
            equal = node.sdo.read(entry.index, entry.sub) == entry.old
            assert equal == (entry.name not in outcome.refused), entry.name
        journal = JournalFolder(node.identity(), tmp_path).last()
        assert journal is not None and journal.state == "done"


def test_what_is_never_taken_is_written_twice_and_no_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A second time, for what stood in its way may be gone; a third one would find nothing new."""
    rounds: list[tuple[str, ...]] = []
    inner = WholeDrive._write_in_order
    monkeypatch.setattr(
        WholeDrive, "_write_in_order", lambda self, due, wanted: (rounds.append(tuple(due)), inner(self, due, wanted))
    )
    path = write_eds(tmp_path / "x.eds", ROWS)
    for refused, times in (((), 1), (((0x6080, 0),), 2)):
        rounds.clear()
        with opened(path) as node:
            write(node, CHANGED)
            saved, _ = take_whole_backup(node, node.identity(), listed())
        with opened(path, "mtpv-test") as node:
            refuse(node, *refused)
            job(node, saved, tmp_path).run()
        assert len(rounds) == times and len(rounds[-1]) == (len(refused) or len(rounds[0]))


@pytest.mark.parametrize("at", [3, 8, 12])
def test_an_interrupt_brings_the_old_objects_back(tmp_path: Path, at: int) -> None:
    """Also in the middle of a PDO, which is off then."""
    path = write_eds(tmp_path / "x.eds", ROWS)
    with opened(path) as node:
        write(node, CHANGED)
        map_pdo(node)
        saved, _ = take_whole_backup(node, node.identity(), listed())
    with opened(path, "mtpv-test") as node:
        before, _ = take_whole_backup(node, node.identity(), listed())
        download, original, count = job(node, saved, tmp_path), node.sdo.download, 0

        def interrupted(*arguments: object, **options: object) -> object:
            nonlocal count
            count += 1
            if count == at:
                raise KeyboardInterrupt
            return original(*arguments, **options)  # type: ignore[arg-type]

        node.sdo.download = interrupted  # type: ignore[method-assign, assignment]
        with pytest.raises(Interrupted, match="exactly the old set"):
            download.run()
        assert count > at
        for entry in before.entries:
            if entry.name.startswith("0x"):
                assert node.sdo.read(entry.index, entry.sub) == entry.old, entry.name


def test_identifiers_follow_the_node_id(tmp_path: Path) -> None:
    with opened(write_eds(tmp_path / "x.eds", ROWS)) as node:
        saved, _ = take_whole_backup(node, node.identity(), listed())
    words = {(e.index, e.sub): int.from_bytes(e.old, "little") for e in readdressed(saved, 7).entries}
    assert words[0x1800, 1] & 0x7FF == 0x187 and readdressed(saved, 1) == saved
    other = replace(saved, identity=replace(saved.identity, node=9))
    assert readdressed(other, 7) == other, "an identifier that somebody chose stays"


def tool(*arguments: str) -> Result:
    return CliRunner().invoke(cli, [*arguments])


@pytest.mark.chain
def test_from_the_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settle(tmp_path, monkeypatch)
    path = write_eds(tmp_path / "x.eds", ROWS)
    first, spare = f"interior-2k2?nv=a.nv&eds={path}", f"mtpv-test?nv=b.nv&eds={path}"
    with connect("pmsmsim", first) as connection:
        node = DriveNode(connection, 1)
        write(node, CHANGED)
        node.store()
    outcome = tool("--sim", first, "backup", "--eds", str(path), "-o", "drive.json", "--json")
    left_out = json.loads(outcome.stdout)["left_out"]
    assert outcome.exit_code == 0 and "0x6040:00" in str(left_out)
    same = tool("--sim", first, "verify", "drive.json")  # it was refused: "no map names this drive"
    assert same.exit_code == 0 and "objects match" in same.stdout, same.stderr
    told = [line for line in outcome.stderr.splitlines() if line.startswith("not saved")]
    assert len(told) == len(set(left_out.values())), "one line for a reason"
    assert "serial" in str(tool("--sim", spare, "--yes", "restore", "drive.json").exception)
    assert tool("--sim", spare, "--yes", "restore", "drive.json", "--other-drive").exit_code == 0
    with connect("pmsmsim", spare) as connection:
        node = DriveNode(connection, 1)
        for entry in read_snapshot(tmp_path / "drive.json").entries:
            assert node.sdo.read(entry.index, entry.sub) == entry.old
    assert tool("--sim", spare, "verify", "drive.json", "--other-drive").exit_code == 0
    again = tool("--sim", spare, "--yes", "restore", "drive.json", "--other-drive")
    assert again.exit_code == 0 and "nothing was done" in again.stdout
    undone = tool("--sim", spare, "--yes", "restore")
    assert undone.exit_code == 0, undone.exception
    with connect("pmsmsim", spare) as connection:
        assert int.from_bytes(DriveNode(connection, 1).sdo.read(0x30A0, 1), "little") != CHANGED[0x30A0, 1]


def test_a_file_that_names_no_maker_or_product_fits_every_drive(tmp_path: Path) -> None:
    drive = Identity(5, 0xFB, 0x61500000, 1, 9, "drive", "", "", "")
    for said, warning in (("", ""), ("ProductNumber=0x61500000\n", ""), ("ProductNumber=0x7\n", "is for product 0x7")):
        (tmp_path / "some.eds").write_text(f"[DeviceInfo]\n{said}{OTHERS}")
        assert warning in (told := other_product(str(tmp_path / "some.eds"), drive)) and bool(told) == bool(warning)


def test_the_file_of_another_maker_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settle(tmp_path, monkeypatch)
    path = write_eds(tmp_path / "x.eds", ROWS)
    (tmp_path / "other.eds").write_text("[DeviceInfo]\nVendorNumber=0x1234\n" + OTHERS)
    outcome = tool("--sim", f"interior-2k2?nv=a.nv&eds={path}", "backup", "--eds", "other.eds", "-o", "drive.json")
    assert "for vendor 0x00001234, the drive is of vendor" in str(outcome.exception)
    assert not (tmp_path / "drive.json").exists()


OTHERS = "".join(
    f"[{index}]\nParameterName={name}\nDataType=0x0006\nAccessType=rw\nDefaultValue=0\n"
    for index, name in (("1017", "Heartbeat"), ("6040", "Controlword"), ("6041", "Statusword"))
)


def test_a_drive_that_cannot_store_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settle(tmp_path, monkeypatch)
    path = write_eds(tmp_path / "x.eds", tuple(row for row in ROWS if row not in STORE))
    with opened(path) as node:
        write(node, CHANGED)
        saved, _ = take_whole_backup(node, node.identity(), listed())
    (tmp_path / "drive.json").write_text(saved.dumps())
    error = tool("--sim", f"mtpv-test?nv=:memory:&eds={path}", "--yes", "restore", "drive.json", "--other-drive")
    assert isinstance(error.exception, Partial) and "cannot store all (0x1010:01)" in str(error.exception)
    count = len(saved.entries)
    assert f"{count} of {count} objects are as saved" in str(error.exception)


def test_a_set_that_the_drive_holds_is_stored_only_where_it_waits_for_that(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every download to another maker's drive ended with a store and a reset, also where nothing changed."""
    with opened(write_eds(tmp_path / "x.eds", (*epos4(), *STORE))) as node:
        node.map = load_family("epos4")
        identity, done = node.identity(), cast(list[str], [])
        store, reset = node.store, node.reset
        monkeypatch.setattr(node, "store", lambda: (done.append("store"), store()))
        monkeypatch.setattr(node, "reset", lambda: (done.append("reset"), reset()))
        held = node.map.decode(DriveParameters(node).read(("motor.pole_pairs",))).values
        wanted = ParameterSet({"motor.pole_pairs": held["motor.pole_pairs"] + 1})

        def flashed(values: ParameterSet, store: bool | None = None) -> tuple[int, bool | None, list[str]]:
            done.clear()
            plan = plan_download(node, values)
            outcome = Download(node, identity, plan, {}, JournalFolder(identity, tmp_path)).run(store=store)
            return outcome.written, outcome.stored, list(done)

        both = ["store", "reset"]
        assert flashed(ParameterSet(held)) == (0, None, []), "the maker's software may have stored it or not"
        assert flashed(ParameterSet(held), store=True) == (0, True, both)
        assert flashed(wanted, store=False) == (1, False, [])
        assert flashed(wanted, store=False) == (0, False, [])
        assert flashed(wanted) == (0, True, both), "it was in the RAM only"
        assert flashed(wanted) == (0, True, []) == flashed(wanted, store=False)
        assert flashed(wanted, store=True) == (0, True, both)
        folder = JournalFolder(identity, tmp_path)
        folder.close(cast(Snapshot, folder.last()), "open")
        assert flashed(wanted) == (0, True, both), "an interrupted download may have left it in the RAM"
