# SPDX-License-Identifier: MIT
"""What public files of makers do that the standard does not say: objects that only take, marks that are not kept."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from pmsmtool.drive_maps.eds import parse_eds
from pmsmtool.machine.machine_file import load_machine_file, machine_path
from pmsmtool.sim.foreign.drive import assumptions_of, rehearsed_motor
from pmsmtool.sim.foreign.families import encoder_resolution
from pmsmtool.sim.foreign.file_rows import read_makers_objects
from tests.cli.conftest import Tool
from tests.foreign.data_sheets import COMMON, HEARTBEAT, TORQUE, Row, epos4, faulhaber, identity, write_eds

KEPT: tuple[Row, ...] = (
    (0x1010, 1, "U32", "rw", ""), (0x1020, 1, "U32", "rw", "0"), (0x1020, 2, "U32", "rw", "0"),
)  # fmt: skip
"""A command to store; the simulated drive forgets 0x1020, the date of its configuration, in a reset."""
PROFILE = "interior-2k2"


def commissioned(
    tool: Tool, rows: tuple[Row, ...], limits: dict[tuple[int, int], tuple[int, int]] | None = None
) -> tuple[int, str]:
    write_eds(Path("x.eds"), rows, limits)
    machine = str(machine_path(PROFILE))
    code, printed, said = tool("--yes", "commission", machine, "--eds", "x.eds", "--speed-max", "400rpm")
    assert f"try: `pmsmtool caps --sim '{machine}?nv=:memory:&eds=x.eds'` lists" in printed, "it can be typed"
    return code, said


@pytest.mark.chain
def test_a_drive_that_holds_the_set_is_neither_stored_nor_reset(tool: Tool) -> None:
    """Its encoder, 2048 as the file has it, is entered like the rest of the motor: no contradiction."""
    rows = tuple(row for row in faulhaber() if row[0] != 0x608F)
    code, said = commissioned(tool, (*rows, *KEPT, (0x608F, 1, "U32", "rw", "2048")))
    assert code == 10 and "[1/7] identify  PASS" in said, said
    assert "objects written: the drive holds them already; nothing was stored, no reset" in said
    assert "drive is reset" not in said


@pytest.mark.chain
def test_a_date_that_the_drive_does_not_keep_is_no_failure(tool: Tool) -> None:
    code, said = commissioned(tool, (*epos4(), *KEPT))
    assert code == 10 and "[5/7] flash     PASS  2 of 3 objects written" in said, said


@pytest.mark.chain
def test_a_date_that_the_drive_refuses_is_no_failure(tool: Tool) -> None:
    """The download alone, which the stage of the test above runs, too."""
    marks = ((0x1020, 1, "U32", "ro", "0"), (0x1020, 2, "U32", "ro", "0"))
    write_eds(Path("x.eds"), (*epos4(), KEPT[0], *marks))
    assert tool("tune", str(machine_path(PROFILE)), "-o", "d.toml")[0] == 0
    sim = ("--sim", f"{PROFILE}?nv=:memory:&eds=x.eds", "--yes")
    code, printed, said = tool(*sim, "flash-params", "d.toml", "--map", "epos4")
    assert code == 0 and "2 written, 1 held already, stored" in printed, said


ANGLE: tuple[Row, ...] = (
    *COMMON, *HEARTBEAT, *TORQUE, *identity(0x3FF, 7), (0x6502, 0, "U32", "ro", "0x60D"), (0x60EA, 0, "U16", "rw", "0"),
    *((index, 0, "U16", "rw", "") for index in (0x6072, 0x6073)), (0x608F, 1, "U32", "rw", "1"),
    *((index, 0, "U32", "rw", "") for index in (0x6075, 0x6076, 0x6080)), (0x6078, 0, "I16", "ro", ""),
    (0x6007, 0, "I16", "rw", "1"), (0x605A, 0, "I16", "rw", "2"),
)  # fmt: skip
"""A drive by CiA 402 alone, with mode 11 and its commutation angle."""


@pytest.mark.chain
@pytest.mark.parametrize("taken", [True, False])
def test_mode_11_tells_pole_pairs_and_its_refusal_leaves_the_pulses(tool: Tool, taken: bool) -> None:
    """Some drives announce bit 10 of 0x6502 and refuse the mode; torque pulses need it not, a design neither.

    The one that refuses it wakes up in a mode (-1) that it does not take back when it is written.
    """
    rows = tuple((*row[:4], "-1") if row[0] == 0x6060 and not taken else row for row in ANGLE)
    code, said = commissioned(tool, rows, None if taken else {(0x6060, 0): (-128, 10)})
    pole_pairs = next(line.split()[-2:] for line in said.splitlines() if line.split()[:1] == ["pole_pairs"])
    assert code == 10 and "[1/7] identify  PASS" in said and "J_per_psi" in said, said
    assert said.count("at most 6.08 Apk") == 1, "asked once"
    assert pole_pairs == (["3", "agrees"] if taken else ["NOT", "CHECKED"]), said
    assert "E_NOT_ACCEPTED" not in said
    (record,) = Path("runs").glob("*/run.json")
    assert ("(11), which 0x6502 announces" in record.read_text(encoding="utf-8")) is not taken


def test_a_drive_that_is_off_and_takes_no_controlword_is_off(tool: Tool) -> None:
    """One file's limits let no controlword be written; its statusword shows that nothing is energised."""
    write_eds(Path("x.eds"), epos4(), {(0x6040, 0): (0x8000, 0xFFFF)})
    channel = f"{PROFILE}?nv=:memory:&eds=x.eds"
    code, printed, said = tool("--sim", channel, "stop")
    assert code == 0 and "NOT CONFIRMED" not in said + printed, said
    code, _, said = tool("--sim", channel, "--yes", "jog", "--current", "1Apk", "--for", "0.1s")
    assert code in (4, 9) and "NOT CONFIRMED" not in said, said


@pytest.mark.chain
def test_what_the_drive_cannot_hold_is_said(tool: Tool) -> None:
    rows = tuple(row for row in faulhaber() if row[0] != 0x608F)
    code, said = commissioned(tool, (*rows, (0x608F, 1, "U32", "rw", "2048")), {(0x608F, 1): (1, 65535)})
    assert code == 10 and "x.eds: 0x608F stays 65535 / 1, this motor's encoder has 131072" in said, said


def test_a_motor_of_more_poles_than_the_drive_holds_is_refused_first(tool: Tool) -> None:
    """Before, the rehearsal moved it with the largest number allowed, and FAIL blamed the data sheet."""
    write_eds(Path("x.eds"), faulhaber(), {(0x2350, 3): (2, 4)})
    for command in (("caps", str(machine_path(PROFILE))), ("--yes", "commission", str(machine_path(PROFILE)))):
        code, printed, said = tool(*command, "--eds", "x.eds")
        assert code == 9 and not printed and not Path("runs").exists(), said
        assert "cannot commutate this motor of 3 pole pairs: 0x2350:03 (" in said and "takes 2 to 4" in said
        assert "this motor needs 6" in said and "where:  x.eds" in said and "try:" in said
    assert tool("caps", "--eds", "x.eds")[0] == 0
    code, _, said = tool("caps", str(machine_path(PROFILE)))
    assert code == 2 and "a drive on the bus has its own motor" in said


def test_currents_that_the_drive_does_not_hold_are_named_by_the_makers_words(tmp_path: Path) -> None:
    small = write_eds(tmp_path / "x.eds", faulhaber(), {(0x2333, 1): (0, 900), (0x2333, 2): (60_000, 65_000)})
    told = "\n".join(assumptions_of(str(small), load_machine_file(machine_path(PROFILE))))
    assert re.search(r"0x2333:01 \(\S.*\) takes 0 to 900, .* needs 6\d{3}: 900 is set, .* smaller motors", told), told
    assert re.search(r"0x2333:02 .* needs 12\d{3}: 60000 is set, likely a drive for larger motors", told), told


def test_a_motor_is_rehearsed_without_an_encoder_that_the_drive_cannot_count(tmp_path: Path) -> None:
    """A drive with an encoder of its own: before, the rehearsal ended FAIL, "correct [encoder] bits"."""
    rows = tuple(row for row in faulhaber() if row[0] != 0x608F)
    fixed = write_eds(tmp_path / "fixed.eds", (*rows, (0x608F, 1, "U32", "ro", "3000")))
    free = write_eds(tmp_path / "free.eds", (*rows, (0x608F, 1, "U32", "rw", "3000")))
    stated = machine_path(PROFILE)
    assert rehearsed_motor(stated, str(free)) == rehearsed_motor(stated, None)
    assert rehearsed_motor(stated, None).encoder.bits == 17 and rehearsed_motor(stated, str(fixed)).encoder.bits is None
    told = assumptions_of(str(fixed), load_machine_file(stated))
    assert any("0x608F stays 3000 / 1, this motor's encoder has 131072" in line for line in told)


def test_the_supply_of_an_epos4_is_seen(tool: Tool) -> None:
    """Its 0x2200:01 had no row in the map: `check` passed over half of the voltage, and psi was not available."""
    write_eds(Path("x.eds"), (*epos4(), (0x2200, 1, "U16", "ro", "")))
    code, printed, said = tool("caps", "--eds", "x.eds", "--json")
    psi = [row for row in json.loads(printed)["quantities"] if (row["quantity"], row["method"]) == ("psi", "standard")]
    assert code == 0 and psi[0]["available"], said
    weak = f"{PROFILE}?nv=:memory:&eds=x.eds&U_dc_v=270"
    code, printed, said = tool("--sim", weak, "--yes", "check", str(machine_path(PROFILE)))
    assert code == 1 and "supply: DC link 270 V, 540 V are stated" in said, said


def test_a_limit_that_only_takes_is_no_limit(tool: Tool) -> None:
    write_eds(Path("x.eds"), (*epos4(), (0x6073, 0, "U16", "wo", "1000")))
    code, printed, said = tool("caps", "--eds", "x.eds")
    assert code == 0 and "capability level standard" in printed, said


def test_a_file_that_states_two_vendors_is_for_both(tool: Tool) -> None:
    path = write_eds(Path("x.eds"), epos4())
    path.write_text(path.read_text().replace("[DeviceInfo]\n", "[DeviceInfo]\nVendorNumber=0x65\n"))
    channel = f"{PROFILE}?nv=:memory:&eds=x.eds"
    code, _, said = tool("--sim", channel, "backup", "--eds", "x.eds", "-o", "b.json")
    assert code == 0, said
    path.write_text(path.read_text().replace("DefaultValue=0xfb", "DefaultValue=0x66"))
    code, _, said = tool("--sim", channel.replace("x.eds", "y.eds"), "caps")
    write_eds(Path("y.eds"), epos4())
    code, _, said = tool("--sim", channel.replace("x.eds", "y.eds"), "backup", "--eds", "x.eds", "-o", "c.json")
    assert code == 2 and "the file is for vendor 0x00000065" in said


@pytest.mark.parametrize("kind", ['"0x0006" // word', '"UNSIGNED16"', "UINT16 ; word"])
def test_quotes_remarks_and_words_for_access(kind: str) -> None:
    text = f'[2000]\nParameterName="a"\nDataType={kind}\nAccessType=Read/Write\nLowLimit = "5" ; low\n'
    (entry,) = parse_eds(text.encode()).objects.values()
    assert (entry.data_type, entry.access, entry.low) == (6, "rw", 5)


@pytest.mark.parametrize(("access", "high", "held"), [("rw", 1 << 20, 4096), ("rw", 1000, 1000), ("ro", 1 << 20, 2048)])
def test_the_encoder_is_entered_where_the_object_takes_it(tmp_path: Path, access: str, high: int, held: int) -> None:
    rows = ((0x608F, 1, "U32", access, "2048"), *epos4())
    objects = read_makers_objects(str(write_eds(tmp_path / "x.eds", rows, {(0x608F, 1): (1, high)})))
    assert encoder_resolution(objects, 4096) == held
