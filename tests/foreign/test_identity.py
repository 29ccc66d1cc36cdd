# SPDX-License-Identifier: MIT
"""Who a drive is: the serial number where its maker keeps it, makers that share a vendor number, known firmware."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import cast

import pytest

from pmsmtool.bus.connect import connect
from pmsmtool.cli.main import run
from pmsmtool.drive.drive_node import DriveNode, vendor_product_serial
from pmsmtool.drive.parameters import DriveParameters
from pmsmtool.drive.port import Identity
from pmsmtool.drive_maps.drive_map_file import dump_drive_map, map_hash, parse_drive_map
from pmsmtool.drive_maps.eds import parse_eds
from pmsmtool.drive_maps.identity_rows import IdentityRows
from pmsmtool.drive_maps.sheet_check import map_of_sheet
from pmsmtool.drive_maps.shipped_maps import GENERIC, family_names, load_family
from pmsmtool.errors import ConfigError
from pmsmtool.flash.journal import Snapshot, parse_snapshot
from pmsmtool.flash.map_gate import check_motion, unknown_firmware
from pmsmtool.flash.restore import plan_download, take_backup
from pmsmtool.measurement.capabilities import examine
from pmsmtool.params.catalogue import BY_NAME, OWN_SCALES
from pmsmtool.params.parameter_set import ParameterSet
from pmsmtool.sim.node.node import Node
from tests.foreign.data_sheets import COMMON, Row, copley, epos4, faulhaber, identity, write_eds
from tests.simulated_bus import settle

OWN_SERIALS = [("epos4", (0x2100, 1), "U64", 0x0123_4567_89AB_CDEF), ("copley", (0x6510, 1), "U32", 0x89AB_CDEF)]
SHEETS = {"epos4": epos4(), "copley": copley()}


@contextmanager
def opened(folder: Path, rows: tuple[Row, ...], family: str = "") -> Iterator[tuple[DriveNode, Node]]:
    eds = write_eds(folder / "drive.eds", rows)
    with connect("pmsmsim", f"interior-2k2?nv=:memory:&eds={eds}") as connection:
        node = DriveNode(connection, 1, drive_map=load_family(family) if family else None)
        yield node, cast(Node, connection.bus.line.nodes[0])  # type: ignore[attr-defined]
        node.close()


def put(simulated: Node, index: int, sub: int, number: int) -> None:
    assert simulated.session is not None
    entry = simulated.session.dictionary.find(index, sub)
    entry.value = entry.encode(number)


# ---- serial number ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("family", "place", "kind", "serial"), OWN_SERIALS)
@pytest.mark.parametrize("absent", [False, True])
@pytest.mark.parametrize("map_given", [False, True])
def test_serial_where_its_maker_keeps_it(
    tmp_path: Path, family: str, place: tuple[int, int], kind: str, serial: int, absent: bool, map_given: bool
) -> None:
    rows: tuple[Row, ...] = (*SHEETS[family], (*place, kind, "ro", ""))
    rows = tuple(row for row in rows if not (absent and row[:2] == (0x1018, 4)))
    with opened(tmp_path, rows, family if map_given else "") as (node, simulated):
        put(simulated, *place, serial)
        if not absent:
            put(simulated, 0x1018, 4, 0)
        found = node.identity()
        assert found.serial == serial and vendor_product_serial(node.sdo)[2] == serial
        if not absent:
            put(simulated, 0x1018, 4, 77)
            assert node.identity().serial == 77, "the standard's object counts where it tells one"


def test_a_serial_of_64_bits_goes_through_backup_and_options(tmp_path: Path) -> None:
    rows: tuple[Row, ...] = (*epos4(), (0x2100, 1, "U64", "ro", ""))
    with opened(tmp_path, rows, "epos4") as (node, simulated):
        put(simulated, 0x1018, 4, 0)
        put(simulated, 0x2100, 1, (1 << 64) - 2)
        backup = take_backup(node, node.identity())
        again = parse_snapshot(backup.dumps(), "backup")
        assert isinstance(again, Snapshot) and again.identity == backup.identity
        assert again.identity.serial == (1 << 64) - 2


def test_of_another_type_it_is_no_serial(tmp_path: Path) -> None:
    rows: tuple[Row, ...] = (*epos4(), (0x2100, 1, "U16", "ro", ""))
    with opened(tmp_path, rows) as (node, simulated):
        put(simulated, 0x1018, 4, 0)
        assert node.identity().serial == 0


# ---- a vendor number that makers share --------------------------------------------------------------


def stranger() -> tuple[Row, ...]:
    """Return a drive with Copley's numbers and another maker's objects: 0x2110 is one of them, in another type."""
    return (*COMMON, *identity(0xAB, 0x20B), (0x2110, 0, "U32", "rw", "7"), (0x6502, 0, "U32", "ro", "0x0D"))


def test_the_makers_own_objects_tell_it(tmp_path: Path) -> None:
    with opened(tmp_path, copley()) as (node, _):
        found = node.identity()
        assert found.doubt == "" and found.vendor_product == (0xAB, 0x20B)
        assert examine(node).drive_map.name == "copley"


def test_another_maker_of_the_same_number_is_not_moved_or_written(tmp_path: Path) -> None:
    copleys = load_family("copley")
    with opened(tmp_path, stranger()) as (node, _):
        found = node.identity()
        assert "makers share vendor number 0x000000ab" in found.doubt and "lacks 0x2110:00, 0x2111:00" in found.doubt
        assert examine(node).drive_map.name == GENERIC
        with pytest.raises(ConfigError, match="it is no copley") as caught:
            check_motion(copleys, found)
        assert "[identity]" in caught.value.hint
        chosen = examine(node, copleys)
        assert not chosen.map_is_drives, "not even where its map is asked for"
        own = replace(copleys, identity=replace(copleys.identity, names=(), marks=()))
        node.map = own
        check_motion(own, node.identity())  # a person's own map decides


@pytest.mark.parametrize("brushed", [False, True])
def test_a_controller_of_a_brushed_motor_is_not_taken_for_one_of_poles(tmp_path: Path, brushed: bool) -> None:
    """One maker gives both kinds the same vendor and product; on the bus, and in a data sheet."""
    rows = tuple(row for row in faulhaber() if not brushed or row[0] != 0x2350)
    with opened(tmp_path, rows) as (node, _):
        doubt = node.identity().doubt
        assert examine(node).drive_map.name == (GENERIC if brushed else "faulhaber")
    assert ("lacks 0x2350:03" in doubt and "other kinds of drive" in doubt) if brushed else not doubt
    sheet = parse_eds(write_eds(tmp_path / "x.eds", rows).read_bytes())
    assert map_of_sheet(sheet).name == (GENERIC if brushed else "faulhaber")


def test_the_name_tells_it_where_it_says_so() -> None:
    with connect("pmsmsim", "interior-2k2?nv=:memory:&drive=copley") as connection:
        node = DriveNode(connection, 1)
        found = node.identity()
        assert "copley" in found.name.lower() and found.doubt == ""
        named = load_family("copley")
        node.map = replace(named, identity=replace(named.identity, names=("another",), marks=((0x2A00, 0, 2),)))
        assert "calls itself 'simulated copley" in node.identity().doubt
        node.close()


def test_commands_refuse_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    settle(tmp_path, monkeypatch)
    eds = write_eds(tmp_path / "drive.eds", stranger())
    values = tmp_path / "params.toml"
    values.write_text(ParameterSet({"motor.I_nom_apk": 3.0}).to_toml())
    command = ["--sim", f"interior-2k2?nv=:memory:&eds={eds}", "--yes"]
    assert run([*command, "flash-params", str(values), "--map", "copley"]) == 2
    said = capsys.readouterr().err
    assert "0x2110:00" in said and "copley" in said and "nothing was moved or written" in said
    assert run(["caps", "--eds", str(eds)]) == 0
    assert "so it is no copley" in capsys.readouterr().err


# ---- firmware ----------------------------------------------------------------------------------------

SCALING = [name for name in family_names() if load_family(name).scales and not load_family(name).staging]


@pytest.mark.parametrize("family", SCALING)
def test_unknown_firmware_is_named_with_family_object_and_source(family: str) -> None:
    drive_map = load_family(family)
    for major in drive_map.identity.revisions:
        known = Identity(1, drive_map.vendor, drive_map.product, major << 16 | 7, 1)
        assert unknown_firmware(drive_map, known) == ""
    said = unknown_firmware(drive_map, Identity(1, drive_map.vendor, drive_map.product, 0x7FFE0000, 1))
    assert "0x7ffe0000 (0x1018:03)" in said and f"family {family}" in said
    assert "do not say for which" in said or drive_map.sources[drive_map.identity.source][:40] in said


@pytest.mark.parametrize(("revision", "told"), [("0x01700000", False), ("0x02000000", True)])
def test_it_is_said_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], revision: str, told: bool
) -> None:
    settle(tmp_path, monkeypatch)
    eds = write_eds(tmp_path / "drive.eds", (*epos4(), (0x1018, 3, "U32", "ro", revision)))
    values = tmp_path / "params.toml"
    values.write_text(ParameterSet({"current.K_p_q_v_per_a": 3.0}).to_toml())
    command = ["--sim", f"interior-2k2?nv=:memory:&eds={eds}", "flash-params", str(values), "--map", "epos4"]
    assert run([*command, "--dry-run"]) == 0
    assert ("0x1018:03) of family epos4" in capsys.readouterr().err) is told
    assert run(["caps", "--eds", str(eds)]) == 0
    assert ("0x1018:03) of family epos4" in capsys.readouterr().err) is told


# ---- rows that the drive contradicts -----------------------------------------------------------------


@pytest.mark.parametrize("family", SCALING)
def test_every_row_of_every_map_is_left_out_where_the_drive_has_it_otherwise(family: str) -> None:
    """Each row in turn at an object that is not there, and in a type of another size."""
    drive_map = load_family(family)
    with connect("pmsmsim", f"interior-2k2?nv=:memory:&drive={family}") as connection:
        node = DriveNode(connection, 1)
        for name in drive_map.cells.keys() - {*OWN_SCALES}:
            cell = drive_map.cells[name]
            size = "UNSIGNED16" if cell.size != 2 else "UNSIGNED32"
            for wrong in (replace(cell, index=0x5FF0), replace(cell, wire=size)):
                node.map = replace(drive_map, cells={**drive_map.cells, name: wrong})
                held = DriveParameters(node).held_value(cell.gain) or 1.0
                wanted = {name: max(1.0, BY_NAME[name].minimum)} | ({cell.gain: held} if cell.gain else {})
                plan = plan_download(node, ParameterSet(wanted))
                assert name not in {entry.name for entry in plan.entries}
                assert f"0x{wrong.index:04X}:{wrong.sub:02X}" in plan.not_written[name]
                assert any(line.startswith(f"not written: {name}: the drive h") for line in plan.lines())
        node.close()


# ---- the file ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("family", family_names())
def test_the_table_is_written_and_read_back_and_scales_nothing(family: str) -> None:
    drive_map = load_family(family)
    assert parse_drive_map(dump_drive_map(drive_map)) == drive_map
    assert map_hash(drive_map) == map_hash(replace(drive_map, identity=IdentityRows()))


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("serial = 7", "needs index, sub and a type"),
        ('serial = { index = 0x2100, sub = 1, type = "REAL32" }', "needs index, sub and a type"),
        ("revisions = [0x10000]", "not a list of major revisions"),
        ('names = ""', "not a list of words"),
        ("marks = [7]", "every mark needs"),
        ('colour = "red"', "unknown key"),
        ('source = "nowhere"', "is not in \\[sources\\]"),
    ],
)
def test_what_is_wrong_in_it_is_named_with_its_line(line: str, said: str) -> None:
    head = 'schema = "pmsmtool.drive-map/1"\nname = "x"\nvendor = 1\nproduct = 1\n'
    text = f'{head}[identity]\n{line}\n[sources]\na = "b"\n'
    with pytest.raises(ConfigError) as caught:
        parse_drive_map(text, "my.toml")
    assert any(re.search(said, text) and "my.toml:" in text for text in caught.value.violations)
