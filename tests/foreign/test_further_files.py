# SPDX-License-Identifier: MIT
"""What files of some 40 makers' devices had, which none of ours had: each in a small file of the tests' own."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pmsmtool.drive_maps.drive_map_file import dump_drive_map
from pmsmtool.drive_maps.eds import parse_eds
from pmsmtool.drive_maps.sheet_check import family_of_sheet
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import ConfigError
from pmsmtool.machine.machine_file import machine_path
from pmsmtool.sim.foreign.file_rows import read_makers_objects
from tests.cli.conftest import Tool
from tests.foreign.data_sheets import COMMON, HEARTBEAT, TORQUE, Row, copley, epos4, identity, unknown, write_eds
from tests.foreign.test_foreign_drive import opened


def test_a_file_of_no_device_type_and_without_words_is_not_a_drives(tmp_path: Path) -> None:
    """The mandatory 0x1000 that the simulation adds made a drive of a file with ten objects of every data type."""
    path = write_eds(tmp_path / "x.eds", [(0x2000, 0, "U32", "rw", "7"), (0x2001, 0, "I16", "ro", "1")])
    with pytest.raises(ConfigError, match="without control and status word"):
        read_makers_objects(str(path))
    path = write_eds(tmp_path / "y.eds", [(0x1000, 0, "U32", "ro", "0x00020192")])
    assert (0x6040, 0) in read_makers_objects(str(path)).rows


def test_an_object_of_another_maker_holds_no_serial_number(tmp_path: Path) -> None:
    """0x6510:01 is Copley's serial number; of another maker it is the type of the motor, 0 to 9."""
    rows: tuple[Row, ...] = (*unknown(), (0x6510, 1, "I32", "rw", "3"), (0x2100, 1, "U32", "ro", "5"))
    with opened(write_eds(tmp_path / "x.eds", rows)) as node:
        assert node.sdo.read(0x6510, 1, size=4) == (3).to_bytes(4, "little")
        assert node.sdo.read(0x2100, 1, size=4) == (5).to_bytes(4, "little")


def test_the_smallest_epos4_has_its_familys_map(tmp_path: Path, tool: Tool) -> None:
    write_eds(Path("x.eds"), epos4(product=0x60500000))
    found = json.loads(tool("caps", "--eds", "x.eds", "--json")[1])
    assert (found["level"], found["map"]) == ("standard", "epos4")


PLATE = """schema = "pmsmtool.drive-map/1"
name = "mine"
vendor = 0x000001DD
product = 0x10305070
{more}
[motion]
rated_current = {{ number = 6.08, unit = "A peak", source = "plate" }}
[sources]
plate = "name plate"
"""


@pytest.mark.chain
@pytest.mark.parametrize("without", [(0x6075,), (0x608F,), (0x6075, 0x608F)])
def test_caps_prints_the_map_that_a_drive_without_numbers_needs(tool: Tool, without: tuple[int, ...]) -> None:
    write_eds(Path("x.eds"), unknown("0x225", without=without))
    _, printed, _ = tool("caps", "--eds", "x.eds")
    lines = [line.strip() for line in printed.splitlines() if line.startswith("    ")]
    text = "\n".join(lines[lines.index('schema = "pmsmtool.drive-map/1"') :])
    Path("mine.toml").write_text(text, encoding="utf-8")
    assert tool("caps", "--eds", "x.eds", "--map", "mine.toml")[0] == 2  # a question mark is no number
    Path("mine.toml").write_text(text.replace("?", "4096"), encoding="utf-8")
    found = json.loads(tool("caps", "--eds", "x.eds", "--map", "mine.toml", "--json")[1])
    assert found["level"] == "standard", found["quantities"]


def test_a_drive_that_moves_by_position_alone_is_told_the_map_for_that(tool: Tool) -> None:
    write_eds(Path("x.eds"), unknown("0x1", *MOVE, without=(0x608F,)))
    assert "`pmsmtool move` moves it with --map mine.toml" in tool("caps", "--eds", "x.eds")[1]


def test_caps_prints_no_map_that_would_move_nothing(tool: Tool) -> None:
    """Velocity mode alone, a maker who names no vendor, no supervision: numbers of a name plate would not help."""
    for rows in (unknown("0x5", without=(0x6075,)), unknown(without=(0x6075, 0x1016)),
                 unknown("0x225", (0x1018, 1, "U32", "ro", "0"), without=(0x6075,))):  # fmt: skip
        write_eds(Path("x.eds"), rows)
        assert "mine.toml" not in tool("caps", "--eds", "x.eds")[1]


@pytest.mark.chain
@pytest.mark.parametrize(("more", "code"), [("", 10), ("[capabilities]\ntorque_mode = false", 9)])
def test_a_map_with_the_name_plates_number_alone_moves_a_drive(tool: Tool, more: str, code: int) -> None:
    """Without [capabilities] in the map, a drive that announces modes 4 and 10 "needed torque mode (0x6502 bit 3)"."""
    write_eds(Path("x.eds"), unknown("0x225", without=(0x6075,)))
    Path("mine.toml").write_text(PLATE.format(more=more), encoding="utf-8")
    drive = ("--sim", "interior-2k2?nv=:memory:&eds=x.eds", "--map", "mine.toml", "--yes")
    ended, _, said = tool("check", str(machine_path("interior-2k2")), *drive)
    assert ended == code, said


LINK = """[signals.U_dc_v]
index = 0x2999
sub = 0
type = "INTEGER32"
unit = "mV"
source = "plate"
"""


@pytest.mark.parametrize(("link", "told"), [("", False), (LINK, True)])
def test_a_dc_link_that_the_map_names_may_give_the_flux(tool: Tool, link: str, told: bool) -> None:
    """psi "needs the DC link", while `check` read it through the map (Copley, Nanotec)."""
    write_eds(Path("x.eds"), unknown("0x225", (0x2999, 0, "I32", "ro", "540000")))
    Path("mine.toml").write_text(PLATE.format(more=link), encoding="utf-8")
    printed = tool("caps", "--eds", "x.eds", "--map", "mine.toml")[1]
    assert any(line.startswith("psi        standard") for line in printed.splitlines()) == told, printed


@pytest.mark.chain
def test_a_drive_that_gives_a_tenth_of_its_current_is_no_wrong_wiring(tool: Tool) -> None:
    """0x6072 = 100 permille as stored: `check` tried a hundredth of the rated current, and named a shut brake."""
    write_eds(Path("x.eds"), unknown("0x2D", (0x6072, 0, "U16", "rw", "100")))
    drive = ("--sim", "interior-2k2?nv=:memory:&eds=x.eds", "--yes")
    code, printed, said = tool("check", str(machine_path("interior-2k2")), *drive, "--json")
    assert code == 10 and {row["looked_at"]: row["verdict"] for row in json.loads(printed)["findings"]}["shaft"] == "ok"
    assert "10 % of its rated current (0x6072)" in said, said
    code, printed, said = tool("check", str(machine_path("interior-2k2")), *drive, "--i-max", "0.1Apk", "--json")
    (row,) = (row for row in json.loads(printed)["findings"] if row["looked_at"] == "shaft")
    assert code == 10 and row["verdict"] == "not seen" and "0.82 % of the motor's rated current" in row["shown"], row


MOVE: tuple[Row, ...] = ((0x607A, 0, "I32", "rw", "0"), (0x60F4, 0, "I32", "ro", ""))


@pytest.mark.chain
def test_a_move_says_that_the_drive_gives_little_current(tool: Tool) -> None:
    """It named 6.08 A alone, and showed a shaft that a tenth of it left 28 degrees behind."""
    write_eds(Path("x.eds"), unknown("0x2D", (0x6072, 0, "U16", "rw", "300"), *MOVE))
    drive = ("--sim", "interior-2k2?nv=:memory:&eds=x.eds", "--yes")
    ended, _, said = tool("move", "--by", "40deg", "--speed-max", "100rpm", *drive)
    assert ended == 0 and "30 % of its rated current (0x6072)" in said, said


@pytest.mark.parametrize(("rows", "told"), [(unknown("0x1", *MOVE), True), (unknown("0x1"), False)])
def test_a_drive_without_torque_mode_is_led_to_moves(tool: Tool, rows: tuple[Row, ...], told: bool) -> None:
    write_eds(Path("x.eds"), rows)
    drive = ("--sim", "interior-2k2?nv=:memory:&eds=x.eds", "--yes")
    for command in (("check", str(machine_path("interior-2k2"))), ("identify", "mechanics")):
        code, _, said = tool(*command, *drive)
        assert code == 9 and ("`pmsmtool move --identify` finds inertia" in said) == told, said


@pytest.mark.parametrize(("rows", "next_step"), [(epos4(), "or --map epos4"), (unknown(), "a map of the drive")])
def test_the_file_of_another_drive_is_refused_in_a_few_lines(tool: Tool, rows: tuple[Row, ...], next_step: str) -> None:
    """The hundred objects of the reference drive were listed one by one."""
    write_eds(Path("x.eds"), rows)
    profile = str(machine_path("interior-2k2"))
    assert tool("tune", profile, "-o", "design.toml")[0] == 0
    given = ("--into", "x.eds", "--map", "pmsmsim", "-o", "x.dcf")
    code, _, said = tool("export", "dcf", "design.toml", *given)
    assert code == 2 and next_step in said and "more" in said and len(said.splitlines()) < 20, said


@pytest.mark.chain
def test_a_current_beyond_what_the_drive_shows_is_not_asked_for(tool: Tool) -> None:
    """0x6078 in mA and 16 bits ends at 32.8 A: J of a machine of 160 A came from 491 samples of that, exit 0."""
    drive = ("--sim", "fast-ipm?drive=epos2&nv=:memory:", "--yes")
    code, _, said = tool("move", "--by", "90deg", "--i-max", "50Apk", *drive)
    assert code == 5 and "ends at 46.34 Apk" in said and "supervision tested" not in said, said
    code, _, said = tool("move", "--by", "90deg", *drive)
    assert code == 0 and "current   at most 46.34 Apk" in said, said


def test_a_file_without_a_product_is_of_the_only_family_of_its_vendor(tmp_path: Path) -> None:
    """Copley's own EDS leaves it blank: `caps` took the family's map, `export dcf --into` that of no drive."""
    for rows, family in ((copley(), "copley"), (epos4(), None)):  # maxon has two families
        blank = tuple(("" if row[:2] == (0x1018, 2) else row[4]) for row in rows)
        path = write_eds(tmp_path / "x.eds", [(*row[:4], value) for row, value in zip(rows, blank, strict=True)])
        found = family_of_sheet(parse_eds(path.read_bytes()))
        assert (found and found.name) == family
    other = write_eds(tmp_path / "y.eds", (*unknown(without=(0x1018,)), *identity(0xAB, 0)))
    assert family_of_sheet(parse_eds(other.read_bytes())) is None, "another maker with that number"


@pytest.mark.chain
def test_a_set_of_which_a_map_holds_nothing_is_no_equal_drive_and_no_file(tool: Tool) -> None:
    """ "0 of 0 objects change", exit code 0, said `flash-params --check`, and `export` wrote the file as it was."""
    write_eds(Path("x.eds"), (*COMMON, *HEARTBEAT, *TORQUE, *identity(0x9A, 0), (0x6502, 0, "U32", "ro", "0x20d")))
    tool("tune", str(machine_path("interior-2k2")), "-o", "design.toml")
    on = ("--sim", "interior-2k2?nv=:memory:&eds=x.eds")
    for words in (
        (*on, "flash-params", "design.toml", "--check"), (*on, "flash-params", "design.toml", "--dry-run"),
        ("export", "dcf", "design.toml", "--into", "x.eds", "-o", "new.dcf"),
    ):  # fmt: skip
        code, _, said = tool(*words)
        assert code == 9 and "no object for any value of the set" in said, words
    assert not Path("new.dcf").exists()


@pytest.mark.chain
def test_info_reads_the_rated_current_by_the_map_that_is_given(tool: Tool) -> None:
    """A map that says rms was of no use to it."""
    write_eds(Path("x.eds"), epos4())
    text = dump_drive_map(load_family("epos4"))
    Path("own.toml").write_text(text.replace("mA peak-or-rms", "mA rms"), encoding="utf-8")
    on = ("--sim", "interior-2k2?nv=:memory:&eds=x.eds", "info", "--json")
    undecided, decided = (json.loads(tool(*on, *more)[1])["limits"] for more in ((), ("--map", "own.toml")))
    assert undecided["rated_current_arms"] is None
    assert decided["rated_current_arms"] == pytest.approx(undecided["rated_current_a"])
