# SPDX-License-Identifier: MIT
"""Table ``[motion]`` of a map: read, written back, and refused with the line; a current of unknown kind."""

from __future__ import annotations

import math

import pytest

from pmsmtool.drive_maps.drive_map_file import dump_drive_map, parse_drive_map
from pmsmtool.errors import ConfigError

GOOD = """\
schema = "pmsmtool.drive-map/1"
name = "mine"
vendor = 0x123
product = 7

[motion]
current_limit = { index = 0x2001, sub = 1, type = "UNSIGNED32", unit = "mA peak-or-rms", source = "doc" }
target_current = { index = 0x2002, sub = 0, type = "INTEGER16", unit = "0.01 A peak", mode = -3, source = "doc" }
counts_per_turn = { number = 524288, source = "doc" }
rated_current = { number = 4.2, unit = "A rms", source = "doc" }

[sources]
doc = "manual, p. 3"
"""


def test_rows_are_read_and_written_back() -> None:
    drive_map = parse_drive_map(GOOD)
    limit, target = drive_map.motion["current_limit"], drive_map.motion["target_current"]
    assert limit.undecided and limit.per_count == pytest.approx(1e-3 * math.sqrt(2.0)), "as if rms"
    assert not target.undecided and target.per_count == pytest.approx(0.01) and target.mode == -3
    assert drive_map.motion["counts_per_turn"].number == 524288 and not drive_map.motion["counts_per_turn"].index
    rated = drive_map.motion["rated_current"]
    assert rated.per_count * rated.number == pytest.approx(4.2 * math.sqrt(2.0))
    assert parse_drive_map(dump_drive_map(drive_map)) == drive_map


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("current_limit =", "torque_limit =", "no such row"),
        ("mA peak-or-rms", "mA", "peak or rms"),
        ("mA peak-or-rms", "V", "expected current"),
        (", mode = -3", "", "needs the mode"),
        ('"mA peak-or-rms"', '"mA peak-or-rms", mode = 4', "needs the mode"),
        ("number = 524288", "number = 0", "must be positive"),
        ('number = 524288, source = "doc"', "number = 524288", "needs a source"),
        ("index = 0x2001", "index = 0x1016", "outside 0x2000"),
        ('"A rms"', '"A"', "peak or rms"),
        ('unit = "A rms", ', "", "unit"),
        ('"A rms"', '"A peak-or-rms"', "unit"),
        ("rated_current =", "speed_limit =", "no fixed number"),
    ],
)
def test_mistakes_are_named(old: str, new: str, said: str) -> None:
    with pytest.raises(ConfigError, match="cannot be used") as caught:
        parse_drive_map(GOOD.replace(old, new))
    assert said in str(caught.value)


def test_a_current_of_unknown_kind_is_no_parameter() -> None:
    """A value written in the wrong kind is 41 % off: only what motion needs may be undecided."""
    text = GOOD.replace("[motion]", '[objects]\n"motor.I_max_apk" = { index = 0x2009, sub = 1, type = "UNSIGNED32", '
                        'unit = "mA peak-or-rms" }\n\n[motion]')  # fmt: skip
    with pytest.raises(ConfigError, match="cannot be used") as caught:
        parse_drive_map(text)
    assert "peak-or-rms" in str(caught.value)
