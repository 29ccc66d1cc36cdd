# SPDX-License-Identifier: MIT
"""Data sheets written in every odd way, by property: they are read, or refused by name, and no number is invented."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pmsmtool.data_types import DATA_TYPES
from pmsmtool.drive_maps.dcf import decode_value
from pmsmtool.drive_maps.eds import parse_eds, parse_integer
from pmsmtool.errors import ConfigError
from pmsmtool.sim.foreign import file_rows
from pmsmtool.sim.foreign.drive import assumptions_of
from pmsmtool.sim.foreign.file_rows import read_makers_objects
from pmsmtool.sim.node.dictionary import Entry
from tests.foreign.data_sheets import unknown, write_eds

ENCODINGS = ("utf-8", "utf-8-sig", "utf-16", "utf-16-le", "cp1252")
INTEGERS = sorted((row.code, 8 * row.size, row.is_signed) for row in DATA_TYPES.values() if row.is_integer)
LINE_ENDS = ("\n", "\r\n", "\r")
REMARKS = ("", " ; a remark", " # another", " // a third", "\t")
CASES: tuple[Callable[[str], str], ...] = (str, str.lower, str.upper)
KEYS = ("ParameterName", "ObjectType", "DataType", "AccessType", "DefaultValue", "ParameterValue", "LowLimit",
        "HighLimit", "PDOMapping", "SubNumber", "CompactSubObj", "ObjFlags")  # fmt: skip
NUMBERS = ("", "0", "-1", "0x7", "007", "7h", "nan", "inf", "1e9", "9" * 5000, "0xFFFFFFFF", "1_0", "\u0663", '"5"')
OTHERS = ("$NODEID", "$NODEID+0x180", "0x200-$NODEID", "rw", "RO", "wo", "const", "Read/Write", "%(x)s")
WORDS = st.sampled_from((*NUMBERS, *OTHERS)) | st.text(st.characters(codec="utf-8"), max_size=12)
OBJECTS = ("1000", "1018", "1018sub1", "6040", "6041", "6502", "6060", "1A00", "1A00sub1", "2000", "2000Sub0A")
SECTIONS = st.sampled_from((*OBJECTS, "2000value", "DeviceInfo", "DeviceComissioning", "6075", "608Fsub1", "FFFF", "0"))


@st.composite
def sheets(draw: st.DrawFn) -> bytes:
    """Return the bytes of a file of random sections and keys."""
    end, lines = draw(st.sampled_from(LINE_ENDS)), ["; a file"]
    for name in draw(st.lists(SECTIONS, max_size=12)):
        lines.append(f"[{draw(st.sampled_from(CASES))(name)}]{draw(st.sampled_from(REMARKS))}")
        for key in draw(st.lists(st.sampled_from(KEYS), max_size=7)):
            lines.append(f"{draw(st.sampled_from(CASES))(key)}={draw(WORDS)}{draw(st.sampled_from(REMARKS))}")
    text = end.join(lines)
    return draw(st.one_of(
        st.sampled_from(ENCODINGS).map(lambda name: text.encode(name, "replace")), st.binary(max_size=300)
    ))  # fmt: skip


@pytest.mark.chain
@settings(max_examples=120, deadline=None)
@given(sheets())
def test_any_file_is_read_or_refused_by_name(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "x.eds"
    path.write_bytes(data)
    refused = None
    try:
        eds = parse_eds(data, "x.eds")
        assert all(0 <= index <= 0xFFFF and 0 <= sub <= 0xFF for index, sub in eds.objects)
        for row in read_makers_objects(str(path)).rows.values():
            Entry(row, 1)  # its stored value fits its type
    except ConfigError as error:
        refused = error
    assert refused is None or (refused.hint and refused.where)


@settings(max_examples=200, deadline=None)
@given(
    st.sampled_from(INTEGERS), st.data(), st.sampled_from(("{}", "{:#x}", "0X{:X}", "{:#06x}", " {} ", '"{}"')),
    st.sampled_from(REMARKS), st.sampled_from(LINE_ENDS), st.sampled_from(ENCODINGS), st.sampled_from(CASES),
)  # fmt: skip
def test_a_number_is_the_same_however_it_is_written(
    kind: tuple[int, int, bool],
    data: st.DataObject,
    form: str,
    remark: str,
    end: str,
    encoding: str,
    case: Callable[[str], str],
) -> None:
    code, bits, signed = kind
    low = -(1 << bits - 1) if signed else 0
    value = data.draw(st.integers(low, (1 << bits - signed) - 1))
    written = value if value >= 0 or "x" not in form.lower() else value + (1 << bits)  # hex of two's complement
    lines = ["[2000]", f"{case('DataType')}={code:#06x}{remark}", f"{case('AccessType')}=rw{remark}",
             f"{case('LowLimit')}={form.format(written)}{remark}"]  # fmt: skip
    (entry,) = parse_eds(end.join(lines).encode(encoding)).objects.values()
    assert (entry.low, entry.access, entry.data_type) == (value, "rw", code)


@pytest.mark.parametrize("behind", ["]", "] # until 1003subFE", "] // x = 3", "] ; x", "] and more", "", " ]"])
def test_a_section_is_seen_whatever_follows_it(behind: str) -> None:
    """Not seen, its keys were those of the object before: a length that could be written where there is none."""
    text = f"[2000]\nDataType=5\nAccessType=ro\n[2001{behind}\nDataType=7\nAccessType=rw\nObjFlags=0x1 ; no download\n"
    before, entry = parse_eds(text.encode()).objects.values()
    assert (before.data_type, before.access, before.copied) == (5, "ro", True)
    assert (entry.index, entry.data_type, entry.access, entry.copied) == (0x2001, 7, "rw", False)


@given(st.integers(0, 127), st.integers(0, 0x7FF))
def test_the_node_id_is_added_on_either_side(node: int, number: int) -> None:
    for text in (f"$NODEID+{number:#x}", f"{number}+$NodeID", f"{number:#X} + $nodeid ; remark"):
        assert parse_integer(text.replace("0X", "0x"), node) == node + number
    with pytest.raises(ValueError, match="node id"):
        parse_integer("$NODEID")


def test_a_file_of_another_size_than_is_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.eds"
    with path.open("wb") as file:
        file.truncate(50 << 20)
    with pytest.raises(ConfigError, match="more than the 8 MiB"):
        read_makers_objects(str(path))


@pytest.mark.parametrize(
    ("written", "so"),
    [("[", "[0x"), ("sub", " sub "), ("sub", "_Sub"), ("DataType=0x0007", "DataType=UNSIGNED32")],
)
def test_sections_and_types_in_other_spellings(tmp_path: Path, written: str, so: str) -> None:
    """Whole records were left out, without a word."""
    path = write_eds(tmp_path / "x.eds", unknown())
    plain = path.read_bytes()
    other = plain.replace(written.encode(), so.encode()).replace(b"[0xFileInfo", b"[FileInfo")
    assert other != plain
    kept = [{at: replace(entry, line=0) for at, entry in parse_eds(text).objects.items()} for text in (plain, other)]
    assert kept[0] == kept[1] and len(kept[0]) > 20


def test_how_odd_lines_are_read_is_told(tmp_path: Path) -> None:
    """A section that stood twice, and a number that CiA 306 lets be octal, were read one way without a word."""
    rows = [(*row[:4], "0762" if row[0] == 0x6073 else row[4]) for row in unknown()]
    path = write_eds(tmp_path / "x.eds", rows)
    assert assumptions_of(str(path)) == (
        "line 95: 6073sub0 defaultvalue: 0762 is taken for a decimal; an octal one is 498",
    )
    path.write_text(path.read_text("ascii") + 5 * "[6075]\nDefaultValue=9000\n", encoding="ascii")
    told = assumptions_of(str(path))
    assert "section [6075] stands twice, merged" in told[0] and told[3].startswith("and ")


@pytest.mark.parametrize(
    "text", ["16#1F0", "1F0h", "0x1F0ull", "0x1f0UL", "496.0", "496.", "(0x1F0)", "16#1F0 # a remark"]
)
def test_a_number_in_the_notations_of_other_tools(text: str) -> None:
    """``16#1F0`` was 16 without a word, as ``#`` begins a remark; the others were left out."""
    assert parse_integer(text) == 0x1F0


def test_the_node_id_in_brackets_or_by_its_other_name() -> None:
    assert parse_integer("(0x600 + $NODEID)", 5) == parse_integer("$MY_NODE_ID+0x600", 5) == 0x605


@pytest.mark.parametrize("text", ["0", "255", "300"])
def test_a_node_id_that_no_node_has_moves_no_value(text: str) -> None:
    """255 is a file whose node was given no id yet."""
    sheet = parse_eds(f"[1400sub1]\nDataType=7\nAccessType=rw\n[DeviceComissioning]\nNodeID={text}\n".encode(), "x", 5)
    assert sheet.node_id == 5
    assert f"NodeID {text} is none of 1..127" in sheet.warnings[0]


def test_a_value_that_is_no_number_is_told_and_blank(tmp_path: Path) -> None:
    """The simulated drive held 0 there: a PDO went out under the identifier of the NMT commands."""
    rows = [(*row[:4], "$NODEID|0x180" if row[0] == 0x6075 else row[4]) for row in unknown()]
    path = write_eds(tmp_path / "x.eds", rows)
    assert "6075sub0 defaultvalue: '$NODEID|0x180' is not a number, left out" in assumptions_of(str(path))[0]
    assert read_makers_objects(str(path)).rows[0x6075, 0].default == ""


def test_a_section_that_says_nothing_hides_no_object(tmp_path: Path) -> None:
    """A variable with an empty section of a sub-index beside it was read-only bytes then."""
    path = write_eds(tmp_path / "x.eds", unknown())
    plain = parse_eds(path.read_bytes()).objects[0x6075, 0]
    odd = parse_eds(path.read_bytes() + b"\n[6075sub0]\nSubNumber=1\n")
    assert odd.objects[0x6075, 0] == plain
    assert not odd.warnings


def test_an_array_that_states_its_type_once() -> None:
    head = "[2001]\nObjectType=8\nDataType=0x0006\nSubNumber=2\n[2001sub0]\nDataType=5\nAccessType=ro\n"
    sheet = parse_eds(f"{head}[2001sub1]\nAccessType=rw\nHighLimit=7\n".encode())
    entry = sheet.objects[0x2001, 1]
    assert (entry.data_type, entry.high) == (6, 7)
    assert not sheet.warnings


@pytest.mark.parametrize(
    ("data", "word"),
    [(b'\xef\xbb\xbf<?xml version="1.0"?>\n<X/>', "XML"), (b"PK\x03\x04", "archive"), (b"%PDF-1.7", "document")],
)
def test_a_file_of_another_kind_is_named(data: bytes, word: str) -> None:
    """A maker offers XDD, ESI, a manual and archives beside the EDS; the lines of the wrong one were listed."""
    with pytest.raises(ConfigError, match="no object dictionary entries") as refused:
        parse_eds(data, "x.xdd")
    assert word in str(refused.value)
    assert "not understood" not in str(refused.value)


def test_a_mark_of_tables_in_the_name_of_a_data_sheet(tmp_path: Path) -> None:
    """What stood in front of ``#`` was looked for: there was no such file."""
    path = write_eds(tmp_path / "drive #2.eds", unknown())
    assert (0x6075, 0) in read_makers_objects(str(path)).rows
    assert assumptions_of(str(path)) == ()


def test_a_real_number_as_the_word_of_its_bits(tmp_path: Path) -> None:
    """One maker writes limits of REAL32 so: they were left out, and a default was 0."""
    rows = (*unknown(), (0x2012, 0, "REAL32", "rw", "0x461C4000"))
    path = write_eds(tmp_path / "x.eds", rows, {(0x2012, 0): (0, "0x49742400")})
    entry = parse_eds(path.read_bytes()).objects[0x2012, 0]
    assert (entry.low, entry.high) == (0.0, 1e6)
    assert read_makers_objects(str(path)).rows[0x2012, 0].default == "10000.0"
    assert decode_value(entry.data_type, "0x461C4000") == decode_value(entry.data_type, "1e4")
    assert assumptions_of(str(path)) == ()
    odd = parse_eds(path.read_bytes().replace(b"0x461C4000", b"0x1461C4000")).warnings
    assert "2012sub0 defaultvalue: '0x1461C4000' is not a number, left out" in odd[0]


def test_an_object_of_the_standard_without_a_type_has_the_standards(tmp_path: Path) -> None:
    """Without the type of 0x6071 or 0x6075 it was a drive without torque mode, or without a rated current."""
    path = write_eds(tmp_path / "x.eds", unknown())
    text = path.read_bytes()
    for index, kind in (("6071", "I16"), ("6075", "U32")):
        path.write_bytes(re.sub(rf"(\[{index}\][^\[]*?)DataType=\w+\n".encode(), rb"\1", text))
        objects = read_makers_objects(str(path))
        assert objects.rows[int(index, 16), 0].type == kind
        assert f"0x{index}:00 is {kind} by the standard: the file has no type for it" in objects.assumed
        assert f"{index}sub0: no DataType" in assumptions_of(str(path))[0]


def test_access_and_types_in_the_words_of_programs(tmp_path: Path) -> None:
    """The simulated drive of such a file had no object that can be written, and types of no size."""
    plain = write_eds(tmp_path / "plain.eds", unknown())
    text = plain.read_text("ascii")
    for word, other in (("rw", "Read/Write"), ("ro", "R"), ("wo", "W")):
        text = text.replace(f"AccessType={word}", f"AccessType={other}")
    for code, other in (("0x0006", "UINT16"), ("0x0007", "uint32"), ("0x0003", "Int16")):
        text = text.replace(f"DataType={code}", f"DataType={other}")
    (tmp_path / "other.eds").write_text(text, encoding="ascii")
    assert read_makers_objects(str(tmp_path / "other.eds")).rows == read_makers_objects(str(plain)).rows


def test_what_is_left_out_of_a_file_is_told() -> None:
    """An object under another mark between its numbers was left out without a word, a remark alone was a limit of 0."""
    sheet = parse_eds(b"[2000]\nDataType=7\nAccessType=rw\nHighLimit= ; none\n[2001:01]\nDataType=7\n", "x")
    assert sheet.objects[0x2000, 0].high is None
    assert sheet.warnings == ("x:5: [2001:01] has a DataType and names no object, left out",)


def test_a_file_is_parsed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three times, before: 9 s in place of 3 s for `caps` with 12 000 objects."""
    parsed: list[str] = []
    monkeypatch.setattr(
        file_rows, "parse_eds", lambda data, where, node: parsed.append(where) or parse_eds(data, where, node)
    )
    path = str(write_eds(tmp_path / "x.eds", unknown()))
    assumptions_of(path)
    assert read_makers_objects(path).rows and parsed == [path]
