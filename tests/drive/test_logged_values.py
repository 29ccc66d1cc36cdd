# SPDX-License-Identifier: MIT
"""What a recorded bus says of a drive: frames written down by hand after CiA 301."""

from __future__ import annotations

import struct

import pytest

from pmsmtool.bus.bus_log import LogFrame
from pmsmtool.drive.logged_values import LoggedDrive, Quantity, logged_values, nodes_in, quantities
from pmsmtool.drive_maps.eds import Eds, EdsObject
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import ConfigError

NODE = 5
NAMED = {
    (0x6041, 0): Quantity("statusword", "1", "H"),
    (0x6064, 0): Quantity("position", "counts", "i"),
    (0x2031, 3): Quantity("T_winding_c", "degC", "h", 0.5, -40.0),
}
STATUSWORD, POSITION, WINDING = 0x6041_00_10, 0x6064_00_20, 0x2031_03_10


def sdo(base: int, command: int, index: int, sub: int, data: bytes = b"") -> LogFrame:
    return LogFrame(0.0, base + NODE, struct.pack("<BHB", command, index, sub) + data.ljust(4, b"\0"))


def written(index: int, sub: int, value: int) -> list[LogFrame]:
    """A write of four bytes, and its confirmation."""
    return [sdo(0x600, 0x23, index, sub, struct.pack("<I", value)), sdo(0x580, 0x60, index, sub)]


def said(drive: LoggedDrive, frames: list[LogFrame]) -> dict[str, float]:
    found: dict[str, float] = {}
    for frame in frames:
        found |= drive.take(frame)
    return found


def test_a_number_is_scaled_and_shifted_and_of_another_length_none() -> None:
    assert NAMED[0x2031, 3].decode(struct.pack("<h", 100)) == 10.0
    assert NAMED[0x2031, 3].decode(b"\1") is None


@pytest.mark.parametrize(("k", "cob_id"), [(0, 0x185), (1, 0x285), (3, 0x485), (2, 0x1A7)])
def test_process_data_are_read_as_the_log_has_set_them_up(k: int, cob_id: int) -> None:
    """Two and four bytes in a row; the identifier is CiA 301's where none was written."""
    drive = LoggedDrive(NODE, NAMED)
    set_up = written(0x1A00 + k, 1, STATUSWORD) + written(0x1A00 + k, 2, POSITION)
    if cob_id == 0x1A7:
        set_up += written(0x1800 + k, 1, 0x4000_01A7)
    assert said(drive, set_up) == {}
    assert drive.take(LogFrame(1.0, cob_id, struct.pack("<Hi", 0x237, -4000))) == {
        "statusword": 0x237,
        "position": -4000.0,
    }
    assert said(drive, written(0x1A00 + k, 0, 1)) == {}  # from now on the first object alone
    assert drive.take(LogFrame(2.0, cob_id, struct.pack("<Hi", 0x637, -4000))) == {"statusword": 0x637}
    assert not drive.unknown


def test_what_a_master_sends_is_read_too_and_an_invalid_identifier_is_not() -> None:
    drive = LoggedDrive(NODE, NAMED)
    said(drive, written(0x1600, 1, WINDING) + written(0x1A00, 1, WINDING) + written(0x1800, 1, 0x8000_0185))
    assert drive.take(LogFrame(1.0, 0x205, struct.pack("<h", 0))) == {"T_winding_c": -40.0}
    assert drive.take(LogFrame(1.0, 0x185, struct.pack("<h", 0))) == {}
    assert drive.unknown == {0x185: 1}


def test_only_the_four_predefined_pdos_count_as_unknown() -> None:
    drive = LoggedDrive(NODE, NAMED)
    for base in (0x080, 0x180, 0x200, 0x280, 0x480, 0x500, 0x700):
        drive.take(LogFrame(0.0, base + NODE, b"\0"))
    assert sorted(drive.unknown) == [base + NODE for base in (0x180, 0x200, 0x280, 0x480, 0x500)]


@pytest.mark.parametrize(
    ("command", "address", "data", "value"),
    [
        (0x4B, (0x6041, 0), b"\x37\x02", 0x237),
        (0x43, (0x6064, 0), b"\xff\xff\xff\xff", -1.0),
        (0x42, (0x6064, 0), b"\x07\0\0\0", 7.0),  # without a size: all four bytes
        (0x4F, (0x6041, 0), b"\x37", None),  # one byte where there are two
        (0x41, (0x6064, 0), b"\x07\0\0\0", None),  # a segmented answer: a length, no value
        (0x60, (0x6064, 0), b"", None),  # confirms a write that the log does not hold
        (0x80, (0x6064, 0), b"\0\0\2\6", None),
    ],
)
def test_an_answer_is_a_value(command: int, address: tuple[int, int], data: bytes, value: float | None) -> None:
    found = LoggedDrive(NODE, NAMED).take(sdo(0x580, command, *address, data))
    assert list(found.values()) == ([] if value is None else [value])


def test_a_write_counts_when_it_is_confirmed() -> None:
    drive = LoggedDrive(NODE, NAMED)
    ask = sdo(0x600, 0x2B, 0x6041, 0, b"\x0f\0")
    assert said(drive, [ask, sdo(0x580, 0x80, 0x6041, 0), sdo(0x580, 0x60, 0x6064, 0)]) == {}
    assert said(drive, [ask, sdo(0x580, 0x60, 0x6041, 0)]) == {"statusword": 15.0}
    assert said(drive, [sdo(0x580, 0x60, 0x6041, 0)]) == {}, "once"
    assert said(drive, [ask, sdo(0x600, 0x40, 0x6041, 0), sdo(0x580, 0x60, 0x6041, 0)]) == {}, "a read came between"
    assert drive.take(LogFrame(0.0, 0x585, sdo(0x580, 0x4B, 0x6041, 0, b"\1").data[:7])) == {}, "cut short"


def test_a_data_sheet_counts_until_the_log_says_otherwise() -> None:
    entries = {
        (0x1A00, 0): "1", (0x1A00, 1): f"{STATUSWORD:#x}", (0x1800, 1): "$NODEID+0x180",
        (0x1A01, 1): "not a number", (0x1A04, 1): f"{POSITION:#x}",
    }  # fmt: skip
    objects = {key: EdsObject(*key, "", 0x07, "rw", None, None, text, "", 0) for key, text in entries.items()}
    objects[0x6064, 0] = EdsObject(0x6064, 0, "Position actual value", 0x04, "ro", None, None, "", "", 0)
    sheet = Eds(objects, None, None, None, "", None, "utf-8", ())
    drive = LoggedDrive(NODE, NAMED, sheet)
    frame = LogFrame(0.0, 0x185, struct.pack("<i", 0x237))
    assert drive.take(frame) == {"statusword": 0x237}
    said(drive, written(0x1A00, 1, POSITION))
    assert drive.take(frame) == {"position": 0x237}

    named = quantities(load_family("epos4"), sheet)
    assert named[0x6041, 0].name == "statusword" and named[0x1A00, 1].name == "0x1A00:01 "
    assert named[0x30A0, 1].name == "current.K_p_q_v_per_a" and (0x2070, 1) not in named
    reference = quantities(load_family("pmsmsim"))
    assert reference[0x6040, 0].letter == "H" and reference[0x2070, 1].name == "i_d_a"


def test_emergencies_are_told_with_their_time_and_an_end_of_one_is_none() -> None:
    drive = LoggedDrive(NODE, NAMED)
    for data in (b"\x10\x84\0\0\0\0\0\0", b"\0\0\0\0\0\0\0\0", b"\x10", b"\x10\x84"):
        assert drive.take(LogFrame(1.25, 0x085, data)) == {}
    assert len(drive.emergencies) == 2 and drive.emergencies[0].startswith("1.250 s: emergency 0x8410")


def test_the_nodes_of_a_log_answered_beat_sent_or_complained() -> None:
    frames = [LogFrame(0.0, cob_id, b"") for cob_id in (0x703, 0x582, 0x084, 0x181, 0x605, 0x206, 0x287, 0x080, 0x000)]
    assert nodes_in(frames) == [1, 2, 3, 4]


def test_one_node_is_taken_and_of_several_one_must_be_named() -> None:
    answer = sdo(0x580, 0x4B, 0x6041, 0, b"\x37\x02")
    drive, values = logged_values([LogFrame(0.0, 0x705, b"\5"), answer], None, NAMED, None, "x.log")
    assert drive.node == NODE and list(values) == [(0.0, {"statusword": 0x237})]
    with pytest.raises(ConfigError, match="2 nodes are in the log") as caught:
        logged_values([answer, LogFrame(0.0, 0x707, b"\5")], None, NAMED, None, "x.log")
    assert "-n 5, -n 7" in caught.value.hint
    assert logged_values([answer, LogFrame(0.0, 0x707, b"\5")], 7, NAMED, None, "x.log")[0].node == 7
    with pytest.raises(ConfigError, match="no CAN frame"):
        logged_values([], None, NAMED, None, "x.log")
