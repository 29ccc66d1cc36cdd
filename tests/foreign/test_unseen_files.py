# SPDX-License-Identifier: MIT
"""EDS files that nobody has seen: objects missing or changed, odd texts. No command ends in a traceback."""

from __future__ import annotations

import json
import math
import random
import re
import struct
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.eds_nodes import entries_of, faults_of, mutated, text_of
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.motion_objects import POSITION, position_units, rated_apk
from pmsmtool.drive_maps.drive_map_file import parse_drive_map
from pmsmtool.errors import NotAvailable
from pmsmtool.machine.machine_file import machine_path
from pmsmtool.params.parameter_set import ParameterSet
from pmsmtool.sim.foreign import families
from pmsmtool.sim.foreign.drive import assumptions_of
from pmsmtool.sim.foreign.file_rows import read_makers_objects
from pmsmtool.sim.node.dictionary import Entry
from tests.cli.conftest import Tool
from tests.foreign.data_sheets import Row, copley, epos4, faulhaber, unknown, write_eds
from tests.foreign.test_foreign_drive import opened
from tests.simulated_bus import settle

SEEDS = 8


@pytest.fixture
def sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    settle(tmp_path, monkeypatch)
    makers = (epos4, copley, faulhaber)
    return [str(write_eds(tmp_path / f"{rows.__name__}.eds", rows())) for rows in makers]


@pytest.mark.chain
def test_caps_names_what_is_missing_and_never_breaks(sources: list[str]) -> None:
    for seed in range(SEEDS):
        _, codes, wrong = faults_of(seed, sources, 0, None)
        assert not wrong and codes, (seed, wrong)


ODD_TEXTS: dict[str, Callable[[str], bytes]] = {
    "UTF-16 with a mark": lambda text: text.encode("utf-16"),
    "UTF-16 without one": lambda text: text.encode("utf-16-le"),
    "remarks behind the numbers": lambda text: re.sub(r"(?m)^((?!Param).*=.+)$", r"\1 # said; by hand", text).encode(),
    "no ObjectType": lambda text: text.replace("ObjectType=9\n", "").encode(),
    "a record called a variable": lambda text: text.replace("ObjectType=9\n", "ObjectType=7\nDataType=7\n").encode(),
}


@pytest.mark.parametrize("odd", ODD_TEXTS)
def test_an_odd_text_says_the_same(tmp_path: Path, odd: str) -> None:
    plain = write_eds(tmp_path / "plain.eds", (*epos4(), (0x1018, 0, "U8", "const", "4")))
    other = tmp_path / "odd.eds"
    other.write_bytes(ODD_TEXTS[odd](plain.read_text("ascii")))
    assert read_makers_objects(str(other)).rows == read_makers_objects(str(plain)).rows


def test_an_identity_of_another_type_and_an_invented_device_type(tmp_path: Path, tool: Tool) -> None:
    rows = [row for row in epos4() if row[0] not in (0x1000, 0x1018)]
    odd: tuple[Row, ...] = (
        (0x1000, 0, "U32", "ro", "0x00220811"), (0x1018, 1, "U32", "ro", "0xFB"), (0x1018, 2, "VSTR", "ro", "EPOS4"),
        (0x1018, 3, "U16", "ro", "7"),
    )  # fmt: skip
    code, printed, said = tool("caps", "--eds", str(write_eds(tmp_path / "x.eds", [*rows, *odd])))
    assert code == 0 and "vendor 0x000000fb  product 0x0" in printed, said


@pytest.mark.parametrize("row", [(0x6080, 0, "VSTR", "rw", "fast"), (0x6080, 0, "U32", "rw", "4294967295")])
def test_a_limit_of_another_type_or_beyond_everything_is_no_end(tmp_path: Path, tool: Tool, row: Row) -> None:
    rows = [each for each in epos4() if each[0] != 0x6080]
    code, printed, said = tool("caps", "--eds", str(write_eds(tmp_path / "x.eds", [*rows, row])))
    assert code == 0 and "capability level" in printed, said


@pytest.mark.parametrize(
    ("row", "value"),
    [
        ((0x6075, 0, "U8", "rw", "$NODEID+0x180"), 0x81),  # what a type cannot hold wraps
        ((0x6075, 0, "U32", "rw", "$NODEID+0x180"), 0x181),
        ((0x2000, 0, "U64", "rw", "0xFFFFFFFFFFFFFFFF"), 2**64 - 1),
        ((0x2000, 0, "I8", "rw", "-1"), -1),
        ((0x2000, 0, "U16", "rw", "abc"), 0),
    ],
)
def test_a_stored_value_that_its_type_cannot_hold_is_cut(tmp_path: Path, row: Row, value: int) -> None:
    objects = read_makers_objects(str(write_eds(tmp_path / "x.eds", [*epos4(), row])))
    entry = Entry(objects.rows[row[0], row[1]], 1)
    assert entry.integer() == value or int.from_bytes(entry.value, "little") == value


@pytest.mark.parametrize(
    ("row", "kind", "access"),
    [
        ((0x6502, 0, "VSTR", "ro", "modes"), "U32", "ro"),
        ((0x6041, 0, "U8", "ro", "0"), "U16", "ro"),
        ((0x6041, 0, "U16", "wo", "0"), "U16", "ro"),
        ((0x6040, 0, "U16", "const", "0"), "U16", "rw"),
    ],
)
def test_a_mandatory_object_that_cannot_be_so_is_the_standards(
    tmp_path: Path, row: Row, kind: str, access: str
) -> None:
    """A status word of one byte, or one that cannot be read, is a mistake of the file, and said so."""
    rows = [each for each in epos4() if each[0] != row[0]] + [row]
    path = str(write_eds(tmp_path / "x.eds", rows))
    found = read_makers_objects(path).rows[row[0], 0]
    assert (found.type, found.access) == (kind, access)
    assert any(line.startswith(f"0x{row[0]:04X}:00 is ") and "the standard" in line for line in assumptions_of(path))


def test_files_differ_and_follow_from_their_seed(sources: list[str]) -> None:
    entries = entries_of(sources[0])
    texts = [text_of(mutated(entries, random.Random(seed)), random.Random(seed)) for seed in (1, 1, 2)]
    assert texts[0] == texts[1] != texts[2]


@pytest.mark.chain
def test_a_row_of_the_map_that_this_drive_lacks_is_no_wiring(tool: Tool) -> None:
    """Copley's winding resistance is missing in some firmware; the shaft is checked without it."""
    write_eds(Path("x.eds"), [row for row in copley() if row[:2] != (0x6410, 7)])
    profile = str(machine_path("interior-2k2"))
    code, out, _ = tool("--sim", "interior-2k2?nv=:memory:&eds=x.eds", "--yes", "check", profile, "--json")
    rows = {row["looked_at"]: row["verdict"] for row in json.loads(out)["findings"]}
    assert code == 10 and rows["shaft"] == rows["encoder sign"] == "ok"


def test_a_position_too_coarse_for_a_speed_moves_nothing(tool: Tool) -> None:
    rows = [*(row for row in faulhaber() if row[0] != 0x608F), (0x608F, 1, "U32", "ro", "5")]
    write_eds(Path("x.eds"), rows)
    code, out, _ = tool("caps", "--eds", "x.eds", "--json")
    ways = {(row["quantity"], row["method"]): row for row in json.loads(out)["quantities"]}
    assert code == 0 and "position" in str(ways["mechanics", "standard"]["needs"])


def test_a_position_that_cannot_be_read_moves_nothing(tmp_path: Path, tool: Tool) -> None:
    rows = [*(each for each in epos4() if each[0] != 0x6064), (0x6064, 0, "I32", "wo", "")]
    channel = f"interior-2k2?nv=:memory:&eds={write_eds(tmp_path / 'x.eds', rows)}"
    code, _, said = tool("--sim", channel, "--yes", "check", str(machine_path("interior-2k2")))
    assert code == 9 and "position in units" in said and "supervision tested" not in said


@pytest.mark.parametrize("command", [("check", str(machine_path("interior-2k2"))), ("move", "--by", "5deg")])
def test_a_rotary_axis_whose_position_begins_again_every_turn_moves_nothing(
    tmp_path: Path, tool: Tool, command: tuple[str, ...]
) -> None:
    """A wrap between two looks would be a speed that is not there, or hide one that is."""
    ends: tuple[Row, ...] = ((0x607B, 1, "I32", "rw", "0"), (0x607B, 2, "I32", "rw", "4095"))
    channel = f"interior-2k2?nv=:memory:&eds={write_eds(tmp_path / 'x.eds', unknown('0x2D', *ends))}"
    code, _, said = tool("--sim", channel, "--yes", *command)
    assert code == 9 and "0x607B" in said and "begins again" in said and "supervision tested" not in said, said


def checked(tool: Tool, rows: tuple[Row, ...]) -> tuple[int, dict[str, str], str]:
    """Return exit code, verdicts and words of `check` on a drive with these objects."""
    channel = f"interior-2k2?nv=:memory:&eds={write_eds(Path('x.eds'), rows)}"
    code, out, said = tool("--sim", channel, "--yes", "check", str(machine_path("interior-2k2")), "--json")
    findings = json.loads(out)["findings"] if out.startswith("{") else ()
    return code, {row["looked_at"]: row["verdict"] for row in findings}, said


WIDTHS: tuple[Row, ...] = (
    (0x6071, 0, "I32", "rw", "0"), (0x6073, 0, "U32", "rw", "1000"), (0x6075, 0, "U16", "rw", ""),
    (0x6078, 0, "I32", "ro", ""), (0x6080, 0, "U16", "rw", ""), (0x6502, 0, "U16", "ro", "0x2D"),
    (0x6040, 0, "U32", "rw", "0"), (0x6041, 0, "U32", "ro", "0"), (0x6060, 0, "U8", "rw", ""),
)  # fmt: skip


@pytest.mark.chain
def test_whole_numbers_of_another_width_are_taken_as_the_drive_has_them(tool: Tool) -> None:
    code, verdicts, said = checked(tool, unknown("0x2D", *WIDTHS))
    assert code == 10 and verdicts["shaft"] == verdicts["encoder sign"] == "ok", said


WIDE: tuple[Row, ...] = ((0x6071, 0, "I32", "rw", "0"), (0x6077, 0, "I32", "ro", ""), (0x6078, 0, "I32", "ro", ""))


def test_a_torque_of_32_bits_is_no_share_where_the_drive_has_no_rated_current(tool: Tool) -> None:
    """The file does not say what a count is. They were commanded in permille of the rated current of a name plate."""
    write_eds(Path("x.eds"), unknown("0x2D", *WIDE, without=(0x6075,)))
    code, said, _ = tool("caps", "--eds", "x.eds")
    assert code == 0 and "0x6071, in permille" in said and "in place of ?" not in said
    rated = 'rated_current = { number = 4.3, unit = "A rms", source = "plate" }'
    head = 'schema = "pmsmtool.drive-map/1"\nname = "mine"\nvendor = 0x1DD\nproduct = 0x10305070\n[motion]\n'
    Path("mine.toml").write_text(f'{head}{rated}\n[sources]\nplate = "its plate"\n', encoding="ascii")
    channel = "interior-2k2?nv=:memory:&eds=x.eds"
    assert tool("--sim", channel, "--yes", "identify", "mechanics", "--map", "mine.toml")[0] == 9
    own = [
        f'{name} = {{ index = {index}, sub = 0, type = "INTEGER32", unit = "mA rms"{mode}, source = "plate" }}'
        for name, index, mode in (("target_current", 0x6071, ", mode = 4"), ("current", 0x6078, ""))
    ]
    Path("mine.toml").write_text("\n".join((head, rated, *own, '[sources]\nplate = "a"\n')), encoding="ascii")
    code, said, _ = tool("--sim", channel, "caps", "--map", "mine.toml")
    assert code == 0 and "capability level standard" in said


@pytest.mark.parametrize("gone", [(0x6075, 0x6077, 0x6078), (0x6075, 0x1016)])
def test_a_map_is_not_offered_for_a_drive_that_it_would_not_move(tool: Tool, gone: tuple[int, ...]) -> None:
    """ "`pmsmtool move` moves it with --map mine.toml": it ended so, "the drive shows neither current nor torque"."""
    position = ((0x607A, 0, "I32", "rw", "0"), (0x6062, 0, "I32", "ro", "0"), (0x6081, 0, "U32", "rw", "1000"))
    write_eds(Path("x.eds"), unknown("0x25", *position, without=(*gone, 0x6071)))
    assert "in place of ?" not in tool("caps", "--eds", "x.eds")[1]
    write_eds(Path("x.eds"), unknown("0x25", *position, without=(0x6075, 0x6071)))
    assert "`pmsmtool move` moves it with --map mine.toml" in tool("caps", "--eds", "x.eds")[1]


@pytest.mark.chain
def test_a_drive_that_no_map_names_needs_no_speed_limit_of_its_own(tool: Tool) -> None:
    code, verdicts, said = checked(tool, unknown(without=(0x6080,)))
    assert code == 10 and verdicts["shaft"] == "ok", said


TURN = {0xFDB40000: 1000.0, 0xFD100000: 2000.0 * math.pi, 0xFF410000: 3600.0, 0x00420000: 21600.0, 0x00B50000: 131072.0}
"""Units of position per turn by 0x60A8 (CiA 303-2): thousandths of a turn, milliradians, tenths of a degree, minutes of
arc, increments of the machine's encoder."""


@pytest.mark.parametrize("word", TURN)
@pytest.mark.parametrize("polarity", ["0", "0x80"])
def test_the_unit_of_position_is_the_one_that_the_drive_states(tmp_path: Path, word: int, polarity: str) -> None:
    rows = unknown("0x2D", (0x60A8, 0, "U32", "rw", hex(word)), (0x607E, 0, "U8", "rw", polarity))
    path = write_eds(tmp_path / "x.eds", rows)
    assert families.position_units(read_makers_objects(str(path)), 131072) == pytest.approx(TURN[word])
    with opened(path) as node:
        assert position_units(node) == pytest.approx(TURN[word] * (-1.0 if polarity == "0x80" else 1.0))


def test_a_length_says_nothing_of_a_turn_without_a_feed(tmp_path: Path) -> None:
    metre = (0x60A8, 0, "U32", "rw", "0xFD010000")
    with opened(write_eds(tmp_path / "x.eds", unknown("0x2D", metre))) as node, pytest.raises(NotAvailable) as refused:
        position_units(node)
    assert "0xfd010000" in str(refused.value) and "0x6092" in str(refused.value)
    feed = ((0x6092, 1, "U32", "rw", "6000"), (0x6092, 2, "U32", "rw", "1"))
    with opened(write_eds(tmp_path / "y.eds", unknown("0x2D", metre, *feed))) as node:
        assert position_units(node) == 6000.0


def with_map(node: DriveNode, counts_per_turn: str) -> DriveNode:
    """Give a node the map of its owner, with that number from the name plate."""
    node.map = parse_drive_map(
        'schema = "pmsmtool.drive-map/1"\nname = "mine"\nvendor = 0x1DD\nproduct = 0x10305070\n[motion]\n'
        f'counts_per_turn = {{ number = {counts_per_turn}, source = "plate" }}\n[sources]\nplate = "name plate"\n',
        "mine.toml",
    )
    return node


@pytest.mark.parametrize(
    ("rows", "units"),
    [
        (((0x6093, 1, "U32", "rw", "128"), (0x6093, 2, "U32", "rw", "1")), None),
        (((0x6093, 1, "U32", "rw", "6"), (0x6093, 2, "U32", "rw", "6")), 131072.0),
        (((0x6092, 1, "U32", "rw", "4096"), (0x6093, 1, "U32", "rw", "32"), (0x6093, 2, "U32", "rw", "1")), 4096.0),
        (((0x6091, 1, "U32", "rw", "50"), (0x6091, 2, "U32", "rw", "1")), None),
        (((0x608F, 1, "U32", "ro", "5"),), None),
    ],
)
def test_a_factor_or_gear_of_unknown_meaning_moves_nothing_until_its_owner_states_the_units(
    tmp_path: Path, rows: tuple[Row, ...], units: float | None
) -> None:
    """J was 128 times the true one behind a factor of 128; the map that 'caps' printed for a gear was not read."""
    with opened(write_eds(tmp_path / "x.eds", unknown("0x2D", *rows))) as node:
        if units is None:
            with pytest.raises(NotAvailable, match="counts_per_turn"):
                position_units(node)
        else:
            assert position_units(node) == units
        assert position_units(with_map(node, "1024")) == (units or 1024.0)


ODD_NUMBERS: tuple[Row, ...] = (
    (0x6075, 0, "REAL32", "rw", "4300.0"), (0x6064, 0, "I64", "ro", ""), (0x2003, 0, "REAL64", "rw", "1e-300"),
)  # fmt: skip


def test_numbers_of_types_that_the_standard_does_not_have_there(tmp_path: Path) -> None:
    """A rated current of 1.2e6 A, a transfer of 8 bytes that ended the motion, a limit that ended in a traceback."""
    path = write_eds(tmp_path / "x.eds", unknown("0x2D", *ODD_NUMBERS), {(0x2003, 0): (-(10**300), 10**300)})
    with opened(path) as node:
        with pytest.raises(NotAvailable, match="0x6075"):
            rated_apk(node)
        assert position_units(node) == 131072.0 and node.get(POSITION) != 0.0
        assert struct.unpack("<d", node.sdo.read(0x2003, 0, size=8)) == (1e-300,)


NO_MODE_11 = {(0x6060, 0): (-128, 10)}
"""One maker's file: 0x6502 announces mode 11 (bit 10), 0x60EA is there, and 0x6060 takes 10 at the most."""


def vector_drive() -> str:
    rows = unknown("0x42D", (0x60EA, 0, "U16", "rw", "0"))
    return f"interior-2k2?nv=:memory:&eds={write_eds(Path('x.eds'), rows, NO_MODE_11)}"


@pytest.mark.chain
def test_a_mode_that_is_announced_and_refused_ends_no_check(tool: Tool) -> None:
    code, out, said = tool("--sim", vector_drive(), "--yes", "check", str(machine_path("interior-2k2")), "--json")
    assert code == 10 and "torque pulses instead" in said
    rows = {row["looked_at"]: row for row in json.loads(out)["findings"]}
    assert rows["shaft"]["verdict"] == "ok" and "torque forth and back" in str(rows["shaft"])


@pytest.mark.chain
def test_a_mode_that_is_announced_and_refused_costs_its_own_quantities_alone(tool: Tool) -> None:
    code, out, said = tool("--sim", vector_drive(), "--yes", "identify", "--json", "--speed-max", "400rpm")
    facts = json.loads(out)
    assert code == 10 and "J_per_kt" in {row["name"] for row in facts["values"]}, said
    assert "(11), which 0x6502 announces" in facts["refused"]["poles"] and "encoder" in facts["refused"]
    code, _, said = tool("--sim", vector_drive(), "--yes", "identify", "poles")
    assert code == 9 and "no mode of operation" in said


def test_modes_that_a_file_leaves_blank_are_assumed_by_its_objects_and_said(tool: Tool) -> None:
    write_eds(Path("x.eds"), unknown(""))
    code, out, said = tool("caps", "--eds", "x.eds", "--json")
    assert code == 0 and json.loads(out)["level"] == "standard"
    assert "0x6502 is blank: modes 3, 4 are assumed" in said
    write_eds(Path("y.eds"), unknown("0x2D"))
    assert "0x6502" not in tool("caps", "--eds", "y.eds")[2]


def test_a_file_without_control_and_status_word_is_no_drives(tool: Tool) -> None:
    master = [row for row in unknown("") if row[0] not in (0x6040, 0x6041, 0x1000)]
    write_eds(Path("x.eds"), [*master, (0x1000, 0, "U32", "ro", "0")])
    code, _, said = tool("caps", "--eds", "x.eds")
    assert code == 2 and "without control and status word" in said


def test_a_maker_whom_no_map_names_is_not_told_of_another_map(tool: Tool) -> None:
    write_eds(Path("x.eds"), unknown())
    write_eds(Path("known.eds"), epos4())
    assert tool("tune", str(machine_path("interior-2k2")), "-o", "design.toml")[0] == 0
    code, _, said = tool("--sim", "interior-2k2?nv=:memory:&eds=x.eds", "--yes", "flash-params", "design.toml")
    assert code == 2 and "no map names this drive: vendor 0x000001dd" in said and "pmsmsim" not in said
    assert "the maker's own tool" in said and "`pmsmtool restore --other-drive`" in said
    code, _, said = tool("--sim", "interior-2k2?nv=:memory:&eds=x.eds", "--yes", "prove", "design.toml")
    assert code == 9 and "needs set-points for d and q" in said and "`pmsmtool commission` runs what it allows" in said
    code, _, said = tool(
        "--sim", "interior-2k2?nv=:memory:&eds=known.eds", "--yes", "prove", "design.toml", "--map", "epos4"
    )
    assert code == 9 and "needs set-points for d and q" in said, "it was: no object for inverter.T_s_ns"
    code, _, said = tool("--sim", "interior-2k2?nv=:memory:&eds=x.eds", "monitor", "--for", "0.1s")
    assert code == 9 and "has none of these live quantities" in said and "param get 0x6064" in said
    write_eds(Path("y.eds"), unknown("0x225", (0x2070, 1, "U16", "rw", "15"), (0x2070, 2, "U32", "rw", "0x42280000")))
    code, printed, said = tool("--sim", "interior-2k2?nv=:memory:&eds=y.eds", "monitor", "--for", "0.1s")
    assert code == 9 and "42" not in printed and "has none of these live quantities" in said, "its inputs, as 42 A"
    code, _, said = tool("--sim", "interior-2k2?nv=:memory:&eds=x.eds", "monitor", "-g", "speeed")
    assert code == 9 and "there is no live quantity of that name" in said and "theta_m_rad" in said
    code, _, said = tool("--sim", "interior-2k2?nv=:memory:&eds=known.eds", "--yes", "flash-params", "design.toml")
    assert code == 9 and "of family epos4" in said and "`flash-params --no-store`" in said


def test_a_gain_that_the_drive_lacks_is_asked_for_by_its_address(tool: Tool) -> None:
    write_eds(Path("x.eds"), unknown())
    profile = str(machine_path("interior-2k2"))
    channel = "interior-2k2?nv=:memory:&eds=x.eds"
    code, _, said = tool("--sim", channel, "--yes", "map", "learn", "--machine", profile)
    assert code == 9 and "it has no 0x60F9:01" in said and "=0xINDEX:SUB" in said


@pytest.mark.parametrize(
    ("low", "high", "kept"), [(65535, 0, (None, None)), (0, 0, (None, None)), (7, 7, (7, 7)), (0, 9, (0, 9))]
)
def test_limits_the_wrong_way_round_say_nothing(
    tmp_path: Path, low: int, high: int, kept: tuple[int | None, int | None]
) -> None:
    path = write_eds(tmp_path / "x.eds", unknown(), {(0x6073, 0): (low, high)})
    row = read_makers_objects(str(path)).rows[0x6073, 0]
    assert (row.low, row.high) == kept


@pytest.mark.chain
def test_a_slow_slope_of_a_healthy_drive_is_no_wiring(tool: Tool) -> None:
    """200 permille per second, mode 4 alone: 'check' named an open phase, and 'identify' ended after 600 s."""
    code, verdicts, said = checked(tool, unknown("0x2D", (0x6087, 0, "U32", "rw", "200")))
    assert code == 10 and verdicts["shaft"] == "ok", said


@pytest.mark.chain
def test_a_ramp_that_was_never_set_up_is_named_and_replaced(tool: Tool, monkeypatch: pytest.MonkeyPatch) -> None:
    """0x6083 = 1 count of unknown unit: the demand makes 0.01 rad of 90 degrees until the move is given up."""
    loop: tuple[Row, ...] = (
        (0x6062, 0, "I32", "ro", ""), (0x607A, 0, "I32", "rw", "0"), (0x6081, 0, "U32", "rw", "16384"),
        (0x6083, 0, "U32", "rw", "1"), (0x6084, 0, "U32", "rw", "1"),
    )  # fmt: skip
    write_eds(Path("x.eds"), unknown("0x2D", *loop))
    move = (
        "--sim",
        "interior-2k2?nv=:memory:&eds=x.eds&bitrate=250000",
        "--yes",
        "move",
        "--by",
        "90deg",
        "--speed-max",
        "500rpm",
    )
    with monkeypatch.context() as patch:
        patch.setattr("pmsmtool.experiments.move.LONGEST_S", 2.0)
        code, _, said = tool(*move)
    assert code == 3 and "a profile that is too slow" in said and "give --speed and --acceleration" in said, said
    code, out, said = tool(*move, "--speed", "100rpm", "--acceleration", "100", "--json")
    assert code == 0 and json.loads(out)["move"]["moving_s"] < 2.0, said


@pytest.mark.chain
def test_a_position_of_unknown_unit_stands_in_no_chains_way(tool: Tool) -> None:
    """Everything else of the standard level is there: the chain ended with exit 9 before its design."""
    write_eds(Path("x.eds"), unknown(without=(0x608F,)))
    assert json.loads(tool("caps", "--eds", "x.eds", "--json")[1])["level"] == "manual"
    code, _, said = tool("--yes", "commission", str(machine_path("interior-2k2")), "--eds", "x.eds", "--json")
    assert code == 10, said


def test_a_fault_is_shown_without_an_error_code(tool: Tool) -> None:
    """0x603F is optional (CiA 402-2): of 33 makers' files 21 lack it, and `fault show` ended in exit code 4."""
    write_eds(Path("x.eds"), unknown())
    code, said, _ = tool("--sim", "interior-2k2?nv=:memory:&eds=x.eds", "fault", "show")
    assert code == 0 and "SWITCH ON DISABLED" in said


def test_parameters_of_a_drive_that_no_map_names_are_those_of_the_standard(tool: Tool) -> None:
    """They were read through the reference drive's map: what 0x2010:01 holds on it was the number of pole pairs."""
    write_eds(Path("x.eds"), unknown("0x2D", (0x2010, 1, "U8", "rw", "7"), (0x6080, 0, "U32", "rw", "4500")))
    channel = "interior-2k2?nv=:memory:&eds=x.eds"
    code, said, _ = tool("--sim", channel, "param", "dump", "--all")
    assert code == 0 and "n_max_rpm = " in said and "pole_pairs" not in said
    code, _, said = tool("--sim", channel, "param", "get", "motor.pole_pairs")
    assert code == 9 and "the map 'cia402' has no object for motor.pole_pairs" in said


def test_a_row_that_this_drive_of_the_family_lacks_ends_no_dump(tool: Tool) -> None:
    rows = tuple(row for row in epos4() if row[:2] != (0x3001, 3))
    write_eds(Path("x.eds"), rows)
    code, said, told = tool("--sim", "interior-2k2?nv=:memory:&eds=x.eds", "param", "dump", "--all")
    assert code == 0 and "profile_speed_rpm = " in said
    assert "left out: motor.pole_pairs: the drive has no object 0x3001:03" in told
    code, said, _ = tool("--sim", "interior-2k2?nv=:memory:&eds=x.eds", "param", "get", "0x3001:01", "--json")
    held = bytes.fromhex(json.loads(said)["parameters"][0]["bytes"])
    assert code == 0 and int.from_bytes(held, "little") == 6080, "the rehearsed motor's current (mA), 0 before"


def test_the_file_of_a_known_family_needs_no_map_and_that_of_an_unknown_one_is_told_so(tool: Tool) -> None:
    """Both were compared with the reference drive: "the file contradicts 100 rows of the map 'pmsmsim'"."""
    rows = [(*row[:4], "30600000") if row[:2] == (0x30A0, 1) else row for row in epos4()]
    path = write_eds(Path("known.dcf"), rows)
    path.write_text(path.read_text("ascii").replace("DefaultValue=30600000", "ParameterValue=30600000"), "ascii")
    channel = "interior-2k2?nv=:memory:&eds=known.dcf"
    code, _, said = tool("--sim", channel, "--yes", "flash-params", "known.dcf", "--dry-run")
    assert code == 0, said
    write_eds(Path("x.eds"), unknown())
    write_eds(Path("kin.eds"), epos4(product=0x61000000))
    assert tool("tune", str(machine_path("interior-2k2")), "-o", "design.toml")[0] == 0
    for name, why in (("x.eds", "no shipped map"), ("kin.eds", "epos2, epos4 describes")):
        of_it = ("--sim", f"interior-2k2?nv=:memory:&eds={name}", "--yes")
        for words in (("export", "dcf", "design.toml", "--into", name), (*of_it, "flash-params", name, "--dry-run")):
            code, _, said = tool(*words)
            assert code == 2 and "no map names this drive" in said and why in said and "pmsmsim" not in said
    code, _, said = tool("caps", "--eds", "kin.eds")
    assert code == 0 and "no map names this drive (epos2, epos4: of other products of its maker)" in said


def test_caps_names_the_gains_whose_unit_the_drive_itself_shows(tool: Tool) -> None:
    """That `map learn` measures them stood in one page of docs/ alone."""
    gains: list[Row] = [(0x60F9, 1, "I16", "rw", "500"), (0x60F9, 2, "I16", "rw", "80")]
    for more, learned in (([], []), (gains, ["speed.K_p_nms_per_rad", "speed.K_i_nm_per_rad"])):
        write_eds(Path("x.eds"), [*copley(), *more])
        code, out, said = tool("caps", "--eds", "x.eds", "--json")
        assert code == 0 and json.loads(out)["learned"] == learned
        assert ("`pmsmtool map learn` measures" in said) == bool(learned)


@pytest.mark.parametrize(("word", "code"), [("0x0240", 0), ("0x0237", 8)])
def test_a_further_axis_that_stays_on_is_no_confirmed_stop(tool: Tool, word: str, code: int) -> None:
    """ "stopped", exit code 0, was said of a device whose second axis was in operation enabled."""
    axis = ((0x6840, 0, "U16", "rw", "0"), (0x6841, 0, "U16", "ro", word))
    write_eds(Path("x.eds"), unknown("0x2D", *axis))
    ended, _, said = tool("--sim", "interior-2k2?nv=:memory:&eds=x.eds", "stop")
    assert ended == code and ("axis 2 shows OPERATION ENABLED (0x6841)" in said) == (code == 8)


@pytest.mark.chain
def test_what_caps_says_is_written_is_written_where_the_drive_lacks_another_row(
    tool: Tool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A drive without a pole number: `flash-params` refused the set, `backup` ended with exit code 4."""
    rows = tuple(row for row in epos4() if row[:2] != (0x3001, 3))
    write_eds(Path("x.eds"), (*rows, (0x1010, 1, "U32", "rw", "1")))
    facts = json.loads(tool("caps", "--eds", "x.eds", "--json")[1])
    assert "reference.profile_speed_rpm" in facts["written"] and "motor.pole_pairs" not in facts["written"]
    lacking = "the drive has no object 0x3001:03 (UNSIGNED8 in the map 'epos4', source 'eds')"
    assert facts["not_written"]["motor.pole_pairs"] == lacking
    wanted = {"motor.pole_pairs": 2.0, "reference.profile_speed_rpm": 700.0}
    Path("set.toml").write_text(ParameterSet(wanted).to_toml())
    channel = "interior-2k2?nv=:memory:&eds=x.eds"
    code, said, told = tool("--sim", channel, "--yes", "flash-params", "set.toml", "--json")
    assert code == 10 and json.loads(said)["outcome"]["written"] == 1, told
    assert "not written: motor.pole_pairs: the drive has no object 0x3001:03" in told, "before the consent"
    assert tool("--sim", channel, "backup", "-o", "b.json")[0] == 0
    monkeypatch.setattr("pmsmtool.cli.flash_params._ask", lambda *args, **options: None)
    code, said, told = tool("--sim", channel, "flash-params", "set.toml", "--nodes", "1")
    assert code == 10 and "PASS" in said and "motor.pole_pairs: the drive has no object 0x3001:03" in told


def test_nothing_that_a_map_names_is_no_backup(tool: Tool) -> None:
    """The map of Elmo has no parameter: a file without entries, exit code 0, which `restore` and `verify` refused."""
    channel = "interior-2k2?nv=:memory:&drive=elmo"
    code, _, said = tool("--sim", channel, "backup", "-o", "b.json")
    assert code == 9 and "backup --eds FILE" in said and not Path("b.json").exists()


def test_a_record_in_the_place_of_the_control_word_is_another_profile(tool: Tool) -> None:
    """CiA 418 has the vehicle's name in 0x6041: `caps` called it a drive, and `stop` was not confirmed."""
    rows = tuple(row for row in unknown() if row[0] not in (0x1000, 0x6041))
    record = ((0x1000, 0, "U32", "ro", "0"), (0x6041, 0, "U8", "ro", "1"), (0x6041, 1, "U32", "ro", "0"))
    write_eds(Path("x.eds"), (*rows, *record))
    assert tool("caps", "--eds", "x.eds")[0] == 2


def test_what_is_told_and_refused_of_a_device_with_a_further_axis(tool: Tool) -> None:
    """Only `stop` knew of it: a set was stored and the device reset while its second axis was energised."""
    axis = ((0x6840, 0, "U16", "rw", "0"), (0x6841, 0, "U16", "ro", "0x0237"), (0x1010, 1, "U32", "rw", "1"))
    write_eds(Path("x.eds"), (*faulhaber(), (0x6081, 0, "U32", "rw", "1000"), *axis))
    assert "axis      the first of 2 (0x6041, 0x6841)" in tool("caps", "--eds", "x.eds")[1]
    assign = ("param", "set", "reference.profile_speed_rpm=700", "--store")
    code, _, said = tool("--sim", "interior-2k2?nv=:memory:&eds=x.eds", "--yes", *assign)
    assert code == 5 and "axis 2 is in OPERATION ENABLED" in said
    assert tool("--sim", "interior-2k2?nv=:memory:&eds=x.eds", "nmt", "reset-node")[0] == 5
