# SPDX-License-Identifier: MIT
"""Data sheets as they are: read what can be read, change nothing but the values, crash on nothing."""

from __future__ import annotations

import io
import struct

import canopen
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pmsmtool.drive_maps import dcf, eds
from pmsmtool.errors import ConfigError
from tests.concise_dcf import read_concise

SHEET = b"""; a drive, by hand
[FileInfo]
FileName=demo.eds
[DeviceInfo]
VendorNumber=0x01AA
ProductNumber=42
RevisionNumber=0x00010002
ProductName=Demo \xb5Drive
[1000]
ParameterName=Device type
ObjectType=0x7
DataType=0x0007
AccessType=ro
DefaultValue=0x00020192
PDOMapping=0

[2010]
ParameterName=Motor
ObjectType=0x9
SubNumber=3
[2010sub0]
ParameterName=Highest sub
ObjectType=0x7
DataType=0x5
AccessType=const
DefaultValue=2
[2010sub1]
ParameterName=Pole pairs
ObjectType=0x7
datatype=0005
accesstype=rw
LowLimit=1
HighLimit=64
DefaultValue=4
VendorKey=kept
; a comment inside
[2010sub2]
ParameterName=Rs
ObjectType=0x7
DataType=0x8
AccessType=rw
DefaultValue=0.137
ParameterValue = 0.2
[2020]
ParameterName=Offset
ObjectType=0x7
DataType=0x3
AccessType=rww
LowLimit=0xFF00
HighLimit=100
[2030]
ParameterName=Array
ObjectType=0x8
DataType=0x7
AccessType=rw
CompactSubObj=3
[2030Value]
NrOfEntries=1
2=77
[2042]
ParameterName=Table
ObjectType=0x2
AccessType=rw
[1400sub1]
ParameterName=COB-ID
ObjectType=0x7
DataType=0x7
AccessType=rw
DefaultValue=$NODEID + 0x200
"""


def test_reads_loose_spelling_and_says_so() -> None:
    sheet = eds.parse_eds(SHEET, "demo.eds", node_id=5)
    assert sheet.encoding == "cp1252" and sheet.product_name == "Demo µDrive"
    assert (sheet.vendor, sheet.product, sheet.revision) == (0x1AA, 42, 0x10002)
    pole_pairs = sheet.objects[0x2010, 1]
    assert (pole_pairs.data_type, pole_pairs.access, pole_pairs.low, pole_pairs.high) == (eds.UNSIGNED8, "rw", 1, 64)
    assert sheet.objects[0x2020, 0].low == -256, "a negative limit written in hex"
    assert sheet.objects[0x2042, 0].data_type == eds.DOMAIN
    assert sheet.objects[0x2030, 2].value == "77" and (0x2030, 3) in sheet.objects
    assert any("1400sub1: its object has no section" in line and "demo.eds:" in line for line in sheet.warnings)


def test_update_changes_only_the_values() -> None:
    new = dcf.update_dcf(
        SHEET, {(0x2010, 1): b"\x08", (0x2010, 2): struct.pack("<f", 0.137), (0x2030, 2): b"\x01\0\0\0"}
    )
    before, after = SHEET.split(b"\n"), new.split(b"\n")
    assert b"ParameterValue = 0.136999995"[:22] in new
    added = [line for line in after if line not in before]
    removed = [line for line in before if line not in after]
    assert sorted(added) == [b"2=0x00000001", b"ParameterValue = 0.136999995", b"ParameterValue=0x08"]
    assert sorted(removed) == [b"2=77", b"ParameterValue = 0.2"]
    assert len(after) == len(before) + 1
    again = eds.parse_eds(new)
    assert dcf.values_of(again)[0x2010, 2] == struct.pack("<f", 0.137)
    assert dcf.update_dcf(new, {}) == new
    odd = eds.parse_eds(new.replace(b"ParameterValue=0x08", b"ParameterValue=$NODEID+0x180"))
    assert dcf.values_of(odd, {(0x2010, 2)}) == {(0x2010, 2): struct.pack("<f", 0.137)}, "no other value is in the way"
    with pytest.raises(ConfigError, match="cannot be used"):
        dcf.values_of(odd)


VARIABLE = "[{}]\nParameterName=x\nObjectType=7\nDataType=6\nAccessType=rw\n"
COMPACT = VARIABLE.format("3210").replace("ObjectType=7", "ObjectType=8") + "DefaultValue=1\nCompactSubObj=4\n"


@pytest.mark.parametrize(
    ("text", "added"),
    [
        (VARIABLE.format("3210sub2") * 2 + "ParameterValue=7\n", 0),
        (VARIABLE.format("3210sub2") + "ParameterValue=5\n" + VARIABLE.format("3210sub02") + "ParameterValue=7\n", 0),
        (COMPACT, 4),
        (COMPACT + "[3210Value]\nNrOfEntries=0\n", 1),
        (COMPACT + VARIABLE.format("3210sub02").replace("=6", "=3"), 1),
    ],
    ids=[
        "section twice",
        "in two spellings",
        "compact without a list",
        "with an empty list",
        "with a section of its own",
    ],
)
def test_what_is_laid_into_a_file_is_what_the_file_holds(text: str, added: int) -> None:
    """The old value of a later section counted on, and one of a compact object was left out without a word."""
    new = dcf.update_dcf(text.encode(), {(0x3210, 2): b"\x09\0"})
    assert dcf.values_of(eds.parse_eds(new)) == {(0x3210, 2): b"\x09\0"}
    assert new.count(b"\n") == text.count("\n") + added
    assert eds.parse_eds(new).objects[0x3210, 2].data_type == (3 if "=3\n" in text else 6)


def test_crlf_files_stay_crlf() -> None:
    sheet = SHEET.replace(b"\n", b"\r\n")
    new = dcf.new_dcf(sheet, {(0x2010, 1): b"\x02"}, node_id=7)
    assert new.count(b"\n") == new.count(b"\r\n")
    assert eds.parse_eds(new).node_id == 7


def test_new_dcf_loads_in_an_independent_reader() -> None:
    values = {(0x2010, 1): b"\x08", (0x2010, 2): struct.pack("<f", 0.5), (0x2020, 0): struct.pack("<h", -7)}
    text = dcf.new_dcf(
        SHEET.replace(b"datatype=0005\naccesstype=rw", b"DataType=0x5\nAccessType=rw"), values, node_id=3
    )
    text = text.decode("cp1252").replace("[2042]", "[2042]\nDataType=0xF").split("[1400sub1]")[0]
    stream = io.StringIO(text + "\n[DeviceComissioning]\nNodeID=0x03\n")
    stream.name = "demo.dcf"
    dictionary = canopen.import_od(stream)
    assert dictionary[0x2010][1].value == 8
    assert dictionary[0x2010][2].value == pytest.approx(0.5)
    assert dictionary[0x2020].value == -7


@pytest.mark.parametrize(
    ("values", "message"),
    [({(0x2999, 0): b"\0"}, "not in the file"), ({(0x2010, 1): b"\0\0"}, "takes 1 bytes, 2 given")],
)
def test_values_that_do_not_fit_the_file_are_refused(values: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        dcf.update_dcf(SHEET, values)


@pytest.mark.parametrize("text", [b"", b"hello", b"[FileInfo]\nx=1\n", b"\xff\xfe\x00\x01"])
def test_a_file_without_objects_is_refused(text: bytes) -> None:
    with pytest.raises(ConfigError, match="no object dictionary"):
        eds.parse_eds(text)


integers = st.sampled_from(sorted(eds.INTEGER_BITS))


@given(integers, st.data())
def test_integer_text_round_trip(data_type: int, data: st.DataObject) -> None:
    bits, signed = eds.INTEGER_BITS[data_type], data_type in eds.SIGNED
    low, high = (-(1 << (bits - 1)), (1 << (bits - 1)) - 1) if signed else (0, (1 << bits) - 1)
    value = (
        data.draw(st.integers(low, high)) if bits < 64 else data.draw(st.integers(max(low, -(2**53)), min(high, 2**53)))
    )
    encoded = dcf.encode(data_type, value)
    assert dcf.decode_value(data_type, dcf.value_text(data_type, encoded)) == encoded


@given(st.floats(width=32, allow_nan=False))
def test_binary32_text_round_trip(value: float) -> None:
    encoded = dcf.encode(eds.REAL32, value)
    assert dcf.decode_value(eds.REAL32, dcf.value_text(eds.REAL32, encoded)) == encoded


entries = st.builds(dcf.Entry, st.integers(0, 0xFFFF), st.integers(0, 255), st.binary(max_size=40))


@pytest.mark.chain
@given(st.lists(entries, max_size=20))
def test_concise_round_trip(items: list[dcf.Entry]) -> None:
    data = dcf.write_concise(items)
    assert read_concise(data) == items
    if items:
        with pytest.raises(ConfigError, match="ends in entry"):
            read_concise(data[:-1])
    with pytest.raises(ConfigError, match="after the announced"):
        read_concise(data + b"\0")


@pytest.mark.chain
@settings(max_examples=300)
@given(st.binary(max_size=300) | st.text(alphabet="[]=;$0129abXxsub \n", max_size=200).map(str.encode))
def test_nothing_but_a_config_error_comes_out_of_any_bytes(data: bytes) -> None:
    for job in (eds.parse_eds, read_concise, lambda raw: dcf.values_of(eds.parse_eds(raw))):
        try:
            job(data)
        except ConfigError:
            pass


@pytest.mark.chain
@settings(max_examples=300)
@given(st.integers(0, len(SHEET) - 1), st.binary(min_size=1, max_size=6))
def test_a_damaged_sheet_never_crashes(place: int, damage: bytes) -> None:
    broken = SHEET[:place] + damage + SHEET[place + len(damage) :]
    try:
        sheet = eds.parse_eds(broken)
        dcf.values_of(sheet)
        dcf.update_dcf(broken, {(0x2010, 1): b"\x08"})
    except ConfigError:
        pass
