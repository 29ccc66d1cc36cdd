# SPDX-License-Identifier: MIT
"""A drive made from its maker's file: what the file lacks is not there, what it says counts, units are the drive's."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import can
import pytest

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.connect import connect
from pmsmtool.bus.nmt import HEARTBEAT_ID
from pmsmtool.cia402 import State
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive_maps.eds import Eds, parse_eds
from pmsmtool.errors import ConfigError, SdoAbort
from pmsmtool.machine.machine_file import dump_machine_file, load_machine_file, machine_path
from pmsmtool.sim import foreign
from pmsmtool.sim.channel import build_line, parse_channel
from pmsmtool.sim.foreign import file_rows
from pmsmtool.sim.foreign.drive import ForeignDrive
from pmsmtool.sim.foreign.file_rows import read_makers_objects
from pmsmtool.sim.node.node import Node
from tests.foreign.data_sheets import Row, copley, epos4, write_eds

RATED_APK = 6.1
"""Rated current of interior-2k2 (A peak)."""


@contextmanager
def opened(path: Path, machine: str = "interior-2k2") -> Iterator[DriveNode]:
    with connect("pmsmsim", f"{machine}?nv=:memory:&eds={path}") as connection:
        node = DriveNode(connection, 1)
        yield node
        node.close()


def simulated(node: DriveNode) -> Node:
    return cast(Node, node.connection.bus.line.nodes[0])  # type: ignore[attr-defined]


def number(node: DriveNode, index: int, sub: int = 0, *, signed: bool = False) -> int:
    return int.from_bytes(node.sdo.read(index, sub), "little", signed=signed)


def code_of(node: DriveNode, index: int, sub: int, data: bytes | None = None) -> int:
    with pytest.raises(SdoAbort) as caught:
        node.sdo.read(index, sub) if data is None else node.sdo.download(index, sub, data)
    return caught.value.code


def test_only_the_files_objects_are_there(tmp_path: Path) -> None:
    rows = epos4()
    with opened(write_eds(tmp_path / "drive.eds", rows)) as node:
        listed = {(index, sub) for index, sub, *_ in rows}
        for address in listed:
            assert node.has(*address)
        for index in (0x1016, 0x6073, 0x6075, 0x6078, 0x608F, 0x2050, 0x2060, 0x1021):
            if (index, 0) not in listed and index != 0x1016:
                assert code_of(node, index, 0) == AbortCode.NO_OBJECT
        assert code_of(node, 0x1016, 2) == AbortCode.NO_SUBINDEX
        identity = node.identity()
        assert (identity.vendor, identity.product) == (0xFB, 0x65510000) and identity.serial != 0
        face = cast(ForeignDrive, simulated(node).face)
        assert "0x1001:00 mandatory" in face.assumed and "0x3001:01 mA; peak assumed" in face.assumed


def test_types_limits_and_access_are_the_files(tmp_path: Path) -> None:
    rows: tuple[Row, ...] = (*copley(), (0x2300, 0, "U16", "rw", "7"), (0x2301, 0, "U32", "ro", "9"))
    with opened(write_eds(tmp_path / "drive.eds", rows, {(0x2300, 0): (5, 10)})) as node:
        assert node.sdo.read(0x2300, 0) == b"\7\0"
        assert code_of(node, 0x2300, 0, b"\13\0") == AbortCode.VALUE_HIGH
        assert code_of(node, 0x2300, 0, b"\4\0") == AbortCode.VALUE_LOW
        assert code_of(node, 0x2300, 0, b"\6\0\0\0") == AbortCode.TOO_LONG
        assert code_of(node, 0x2301, 0, b"\1\0\0\0") == AbortCode.READ_ONLY
        assert len(node.sdo.read(0x6060, 0)) == 1


def test_a_drive_offers_the_modes_it_announces(tmp_path: Path) -> None:
    with opened(write_eds(tmp_path / "drive.eds", epos4(modes=0x225))) as node:  # 1, 3, 6, 10
        assert code_of(node, 0x6060, 0, b"\4") == AbortCode.VALUE
        node.sdo.download(0x6060, 0, b"\12")
        assert number(node, 0x6061) == 10 and number(node, 0x6502) == 0x225


def test_the_motor_stands_in_the_makers_own_units(tmp_path: Path) -> None:
    with opened(write_eds(tmp_path / "e.eds", epos4())) as node:
        nominal, constant = number(node, 0x3001, 1), number(node, 0x3001, 5)
        assert nominal == pytest.approx(1000.0 * RATED_APK, rel=0.01)
        assert number(node, 0x6076) == pytest.approx(nominal * constant / 1000.0, rel=1e-6)  # uN m
        assert number(node, 0x3001, 3) == 3 and number(node, 0x3001, 2) >= nominal
    with opened(write_eds(tmp_path / "c.eds", copley())) as node:
        assert number(node, 0x2111) == pytest.approx(100.0 * RATED_APK, rel=0.01)  # 0.01 A peak
        torque, constant = number(node, 0x6076), number(node, 0x6410, 12)
        assert 1e-3 * torque == pytest.approx(1e-5 * constant * RATED_APK, rel=0.01)


def test_torque_moves_the_machine_and_is_shown(tmp_path: Path) -> None:
    with opened(write_eds(tmp_path / "drive.eds", epos4())) as node:
        node.sdo.download(0x6060, 0, b"\12")
        node.enable()
        before = number(node, 0x6064, signed=True)
        node.sdo.download(0x6071, 0, (200).to_bytes(2, "little"))
        node.connection.wait(0.06)  # the current lags: its integral gain is low, and the EMF grows
        shown = number(node, 0x30D1, 2, signed=True)
        asked = number(node, 0x30D0, signed=True)
        assert asked == pytest.approx(0.2 * number(node, 0x3001, 1), rel=1e-3) and 0.8 * asked < shown < asked
        assert number(node, 0x6077, signed=True) == pytest.approx(1000.0 * shown / number(node, 0x3001, 1), rel=0.02)
        turns = (number(node, 0x6064, signed=True) - before) / (4.0 * number(node, 0x3010, 1))
        assert turns > 0.01
        face = cast(ForeignDrive, simulated(node).face)
        assert face.behind is not None and face.behind.largest_step == pytest.approx(0.2, rel=0.01)
        node.disable_voltage()


@pytest.mark.parametrize("counts_down", [False, True])
@pytest.mark.parametrize("rows", [epos4(), copley()])  # one controller of the position, and a cascade
def test_the_shaft_follows_whichever_way_its_encoder_counts(
    tmp_path: Path, rows: tuple[Row, ...], counts_down: bool
) -> None:
    """The loop of a drive with an encoder against the phase order ran away at the first degree."""
    machine = load_machine_file(machine_path("interior-2k2"))
    turned = replace(machine, simulation={**machine.simulation, "encoder_reversed": counts_down})
    (tmp_path / "drive.toml").write_text(dump_machine_file(turned), encoding="utf-8")
    eds = write_eds(tmp_path / "drive.eds", (*rows, (0x607A, 0, "I32", "rw", "0")))
    with opened(eds, str(tmp_path / "drive.toml")) as node:
        node.sdo.download(0x6060, 0, b"\1")
        node.enable()
        start = number(node, 0x6064, signed=True)
        target = start + cast(ForeignDrive, simulated(node).face).set_up.counts // 4
        node.sdo.download(0x607A, 0, target.to_bytes(4, "little", signed=True))
        node.sdo.download(0x6040, 0, (0x3F).to_bytes(2, "little"))
        node.connection.wait(0.5)
        assert abs(number(node, 0x6064, signed=True) - target) < 0.1 * (target - start)
        node.disable_voltage()


@pytest.mark.parametrize("at_once", [False, True])
def test_a_second_set_point_waits_unless_it_shall_act_at_once(tmp_path: Path, at_once: bool) -> None:
    """CiA 402-2, profile position mode: bit 5 of the controlword."""
    moves: tuple[Row, ...] = tuple(
        (index, 0, kind, "rw", "") for index, kind in ((0x607A, "I32"), (0x6062, "I32"))
    )  # fmt: skip
    with opened(write_eds(tmp_path / "drive.eds", (*epos4(), *moves))) as node:
        node.sdo.download(0x6060, 0, b"\1")
        node.enable()
        start = number(node, 0x6064, signed=True)
        turn = round(4.0 * number(node, 0x3010, 1))
        for target in (start + turn // 2, start):
            node.sdo.download(0x607A, 0, target.to_bytes(4, "little", signed=True))
            node.sdo.download(0x6040, 0, (0x3F if at_once else 0x1F).to_bytes(2, "little"))
            node.sdo.download(0x6040, 0, (0x0F).to_bytes(2, "little"))
            node.connection.wait(0.01)
        highest = start
        for _ in range(40):
            node.connection.wait(0.01)
            highest = max(highest, number(node, 0x6062, signed=True))
        assert abs(number(node, 0x6062, signed=True) - start) < 0.01 * turn
        assert (highest - start > 0.49 * turn) is not at_once
        node.disable_voltage()


def test_a_position_demand_that_a_file_makes_a_text_stays_one(tmp_path: Path) -> None:
    """Reading it raised in the simulated drive, whose clock ran on: the reader hung."""
    rows = (*epos4(), (0x607A, 0, "I32", "rw", ""), (0x6062, 0, "VSTR", "ro", "none"))
    with opened(write_eds(tmp_path / "drive.eds", rows)) as node:
        assert node.sdo.upload(0x6062, 0).data == b"none"


def test_its_own_current_limit_acts(tmp_path: Path) -> None:
    with opened(write_eds(tmp_path / "drive.eds", copley())) as node:
        node.sdo.download(0x2110, 0, (60).to_bytes(2, "little"))  # 0.6 A peak
        node.sdo.download(0x6060, 0, b"\4")
        node.enable()
        node.sdo.download(0x6071, 0, (500).to_bytes(2, "little"))
        shown = []
        for _ in range(12):
            node.connection.wait(0.005)
            shown.append(number(node, 0x221C, signed=True))
        assert 45 <= max(shown) <= 66, "of 305 that were asked for"
        node.disable_voltage()


def test_node_guarding_takes_the_voltage_away(tmp_path: Path) -> None:
    with opened(write_eds(tmp_path / "drive.eds", copley())) as node:
        answers: list[bytes] = []
        node.connection.subscribe(HEARTBEAT_ID + 1, lambda cob_id, data, stamp: answers.append(data))
        node.sdo.download(0x100C, 0, (50).to_bytes(2, "little"))
        node.sdo.download(0x100D, 0, b"\5")
        node.enable()

        def ask() -> None:
            frame = can.Message(arbitration_id=HEARTBEAT_ID + 1, is_remote_frame=True, dlc=1, is_extended_id=False)
            node.connection.bus.send(frame)
            node.connection.wait(0.05)

        node.connection.wait(0.5)
        assert node.state() is State.OPERATION_ENABLED, "before the first remote frame nobody watches"
        for _ in range(8):
            ask()
        assert node.state() is State.OPERATION_ENABLED
        assert [data[0] >> 7 for data in answers] == [0, 1] * 4, "the bit toggles"
        node.connection.wait(0.19)
        assert node.state() is State.OPERATION_ENABLED
        node.connection.wait(0.02)
        assert node.state() in (State.FAULT, State.FAULT_REACTION_ACTIVE)


def test_a_table_and_an_eds_say_the_same(tmp_path: Path) -> None:
    rows = epos4()
    names = {"I8": "INTEGER8", "I16": "INTEGER16", "I32": "INTEGER32", "U8": "UNSIGNED8", "U16": "UNSIGNED16",
             "U32": "UNSIGNED32"}  # fmt: skip
    lines = ["family,source,index,sub,name,type,access,default_or_stored,low,high"]
    lines += [f"mine,test,{i:#06x},{s},object,{names[k]},{a},{v},," for i, s, k, a, v in rows]
    table = tmp_path / "table.csv"
    table.write_text("\n".join(lines) + "\n", encoding="ascii")
    by_table = read_makers_objects(f"{table}#mine")
    by_eds = read_makers_objects(str(write_eds(tmp_path / "drive.eds", rows)))
    assert by_table.assumed == by_eds.assumed
    assert {a: (r.type, r.access, r.default) for a, r in by_table.rows.items() if a[1]} == {
        a: (r.type, r.access, r.default) for a, r in by_eds.rows.items() if a[1]
    }
    with pytest.raises(ConfigError, match="no rows of family 'yours'"):
        read_makers_objects(f"{table}#yours")


def test_an_eds_is_read_by_another_reader_than_the_tools(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_eds(tmp_path / "drive.eds", epos4())
    right = read_makers_objects(str(path)).rows

    def mistaken(*args: Any) -> Eds:
        sheet = parse_eds(*args)
        wrong = {at: replace(entry, data_type=5, access="ro", value="7") for at, entry in sheet.objects.items()}
        return replace(sheet, objects=wrong)

    monkeypatch.setattr(file_rows, "parse_eds", mistaken)
    assert read_makers_objects(str(path)).rows == right
    # canopen rejects a file with an object that says no access; what the tool reads counts then
    path.write_text(path.read_text() + "\n[2FFF]\nParameterName=odd\nObjectType=0x7\nDataType=0x5\n")
    assert read_makers_objects(str(path)).stored(0x6040) == 7


def test_files_that_are_no_drives_are_refused(tmp_path: Path) -> None:
    other = [row if row[0] != 0x1000 else (0x1000, 0, "U32", "ro", "0x000F0191") for row in epos4()]
    with pytest.raises(ConfigError, match="profile 401"):
        read_makers_objects(str(write_eds(tmp_path / "io.eds", other)))
    with pytest.raises(ConfigError, match="no such file"):
        build_line(parse_channel(f"interior-2k2?nv=:memory:&eds={tmp_path / 'none.eds'}"))
    path = write_eds(tmp_path / "drive.eds", epos4())
    with pytest.raises(ConfigError, match="names an EDS file and also a drive"):
        build_line(parse_channel(f"interior-2k2?nv=:memory:&drive=epos4&eds={path}"))


def test_its_units_are_its_own() -> None:
    """Nothing of the tool's maps and units decides what the simulated drive takes its bytes for."""
    forbidden = ("wire_units", "drive_maps.drive_map", "drive_maps.map_", "shipped_maps", "pmsmtool.units")
    folder = Path(foreign.__file__).parent
    assert len(list(folder.glob("*.py"))) >= 6
    for path in folder.glob("*.py"):
        for part in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(part, ast.ImportFrom):
                assert not any(word in (part.module or "") for word in forbidden), path.name
