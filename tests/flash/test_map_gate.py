# SPDX-License-Identifier: MIT
"""Which map a drive is moved, read and written through: the one that names it, and the same as the last time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive.port import Identity
from pmsmtool.drive_maps.drive_map import DriveMap, reference_map
from pmsmtool.drive_maps.drive_map_file import map_hash
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import ConfigError, SafetyRefusal
from pmsmtool.flash.journal import JournalFolder
from pmsmtool.flash.map_gate import (
    check_map,
    check_motion,
    check_nodes,
    forget_map,
    map_on,
    memory_of,
    other_drive,
    remember_map,
    unknown_firmware,
)
from tests.bus.scripted import NODE
from tests.drive.table_drive import opened

EPOS4, GENERIC, OURS = load_family("epos4"), load_family("cia402"), reference_map()
COPIED = replace(GENERIC, vendor=7, product=8)
"""A copy of the generic map whose owner wrote his drive's identity into it."""
NOBODY = replace(EPOS4, vendor=0, product=0)


def identity(vendor: int, product: int, *, revision: int = 0x01100000, doubt: str = "") -> Identity:
    return Identity(5, vendor, product, revision, 9, "drive", "", "", doubt)


MAXON = identity(0xFB, 0x61500000)


def test_drives_of_several_families_on_one_bus_are_named_together() -> None:
    """Before, the first node of another family was named alone, and its map advised, which the others then lacked."""
    reference, nanotec = identity(OURS.vendor, OURS.product), identity(0x26C, 0x10)
    with pytest.raises(ConfigError) as caught:
        check_nodes(OURS, [reference, MAXON, nanotec, identity(1, 2)])
    said = str(caught.value)
    for line in ("drive, map pmsmsim", "drive, map epos4", "drive, map nanotec", "drive, no shipped map", "--nodes"):
        assert line in said
    with pytest.raises(ConfigError, match="give --map epos4"):
        check_nodes(OURS, [MAXON, MAXON])
    check_nodes(EPOS4, [MAXON, identity(0xFB, 0x65510000)])


@pytest.mark.parametrize(
    ("drive_map", "who", "moved", "written", "hint"),
    [
        (EPOS4, MAXON, True, True, ""),
        (EPOS4, identity(0xFB, 0x65510000), True, True, ""),
        (EPOS4, identity(0xFB, 0x61500001), False, False, "give the map of this drive"),
        (EPOS4, identity(0xFC, 0x61500000), False, False, "give the map of this drive"),
        (OURS, MAXON, False, False, "give --map epos4"),
        (GENERIC, MAXON, True, False, "write vendor = 0x000000fb, product = 0x61500000"),
        (GENERIC, identity(0, 0), True, False, "names no vendor either"),
        (NOBODY, MAXON, False, False, "write vendor = 0x000000fb"),
        (NOBODY, identity(0, 0), False, False, "names no vendor either"),
        (COPIED, identity(7, 8), True, True, ""),
        (COPIED, identity(7, 9), False, False, "give the map of this drive"),
        (replace(EPOS4, cells={}), MAXON, True, True, ""),  # scales nothing
    ],
)  # fmt: skip
def test_a_map_is_for_the_drive_that_it_names(
    drive_map: DriveMap, who: Identity, moved: bool, written: bool, hint: str, tmp_path: Path
) -> None:
    checks: tuple[tuple[bool, Callable[[], None]], ...] = (
        (moved, lambda: check_motion(drive_map, who)),
        (written, lambda: check_map(drive_map, who, JournalFolder(who, tmp_path))),
    )
    for allowed, check in checks:
        if allowed:
            check()
            continue
        with pytest.raises(ConfigError) as caught:
            check()
        assert hint in caught.value.hint and caught.value.where == "node 5, 0x1018"


def test_how_a_map_and_a_drive_differ_is_said() -> None:
    assert other_drive(EPOS4, 0xFB, 0x61500000) == "" == other_drive(EPOS4, 0xFB, 0x61500000, "")
    assert other_drive(EPOS4, 0xFB, 0x61500000, "it calls itself otherwise") == "it calls itself otherwise"
    assert "is for vendor 0x000000fb product 0x61500000, the drive is vendor 0x00000001 product 0x2" in other_drive(
        EPOS4, 1, 2
    )
    assert "does not state whose drive it is for" in other_drive(GENERIC, 0xFB, 1)


def test_the_map_a_drive_was_written_through_is_remembered(tmp_path: Path) -> None:
    folder = JournalFolder(MAXON, tmp_path)
    edited = replace(EPOS4, cells={**EPOS4.cells, "motor.pole_pairs": replace(EPOS4.cells["motor.pole_pairs"], sub=4)})
    for drive_map in (EPOS4, edited):  # nothing is remembered yet
        check_map(drive_map, MAXON, folder)
    remember_map(EPOS4, folder)
    check_map(EPOS4, MAXON, folder)
    with pytest.raises(SafetyRefusal) as caught:
        check_map(edited, MAXON, folder)
    assert f"sha256 {map_hash(EPOS4)[:12]} then, {map_hash(edited)[:12]} now" in caught.value.what
    assert str(memory_of(folder)) in caught.value.hint
    memory_of(folder).write_text('{"map": 1}', encoding="utf-8")
    with pytest.raises(ConfigError, match="damaged"):
        check_map(EPOS4, MAXON, folder)
    forget_map(folder)
    check_map(edited, MAXON, folder)


def test_of_a_drive_that_shows_its_layout_no_map_is_remembered(tmp_path: Path) -> None:
    who = identity(OURS.vendor, OURS.product)
    folder = JournalFolder(who, tmp_path)
    for drive_map in (OURS, replace(EPOS4, cells={})):
        remember_map(drive_map, folder)
        assert not memory_of(folder).exists()
    memory_of(folder).parent.mkdir(parents=True)
    memory_of(folder).write_text('{"sha256": "another"}', encoding="utf-8")
    check_map(OURS, who, folder)


@pytest.mark.parametrize(
    ("drive_map", "revision", "told"),
    [
        (EPOS4, 0x01100000, ""), (EPOS4, 0x01700001, ""),
        (EPOS4, 0x01110000, "describe 0x0110, 0x0150, 0x0170 (eds: maxon"),
        (EPOS4, 0x00000110, "firmware 0x00000110"), (load_family("ingenia"), 0x00010000, "do not say for which"),
        (OURS, 0, ""), (replace(EPOS4, cells={}), 0, ""),
    ],
)  # fmt: skip
def test_firmware_that_no_source_describes_is_told(drive_map: DriveMap, revision: int, told: str) -> None:
    text = unknown_firmware(drive_map, identity(drive_map.vendor, drive_map.product, revision=revision))
    assert (told in text) if told else text == ""
    assert len(text) < 240, "a person reads it in every plan: it named all files of the source"


def test_rows_that_a_drive_lacks_go_with_what_acts_only_with_them() -> None:
    """The hash stays that of the file: what is kept of a drive must not depend on what it lacks."""
    rows = ("motor.pole_pairs", "current.K_p_q_v_per_a", "current.K_i_q_v_per_as", "speed.K_p_nms_per_rad")
    asked = replace(EPOS4, cells={name: EPOS4.cells[name] for name in (*rows, "reference.K_t_nm_per_a")})
    there = {DriveObject(0x3001, 3, "B"): 3, DriveObject(0x30A0, 1, "H"): 1, DriveObject(0x30A0, 2, "I"): 1}
    with opened({**there, DriveObject(0x30A2, 1, "I"): 1}) as (_, connection):
        held = map_on(DriveNode(connection, NODE, drive_map=asked))
    assert list(held.cells) == ["motor.pole_pairs"] and map_hash(held) == map_hash(asked)
    other_size = "the drive holds 2 bytes in 0x30A0:01 (UNSIGNED32 in the map 'epos4', source 'being')"
    no_object = "the drive has no object 0x3001:05 (UNSIGNED32 in the map 'epos4', source 'eds')"
    assert held.left_out["current.K_p_q_v_per_a"] == other_size
    assert held.left_out["current.K_i_q_v_per_as"] == f"not without current.K_p_q_v_per_a, and {other_size}"
    assert held.left_out["reference.K_t_nm_per_a"] == no_object
    assert held.left_out["speed.K_p_nms_per_rad"] == f"not without reference.K_t_nm_per_a, and {no_object}"
