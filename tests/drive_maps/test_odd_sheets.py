# SPDX-License-Identifier: MIT
"""Data sheets written in every odd way, by property: they are read, or refused by name, and no number is invented."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pmsmtool.data_types import DATA_TYPES
from pmsmtool.drive_maps.eds import parse_eds, parse_integer
from pmsmtool.errors import ConfigError
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
@settings(max_examples=300, deadline=None)
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
