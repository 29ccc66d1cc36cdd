# SPDX-License-Identifier: MIT
"""A plan: what is written, what the drive will hold, what it must hold already, and how a person reads it."""

from __future__ import annotations

import math
from dataclasses import replace
from unittest.mock import Mock

import pytest

from pmsmtool.cia402 import HOMING_LOST
from pmsmtool.design.ratings import GIVEN, rating_values, ratings
from pmsmtool.drive_maps.drive_map import IN_AMPERES, reference_map
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import ConfigError
from pmsmtool.flash.plan import KIND_LEAST, Change, Plan, differences, make_plan, names_to_read
from pmsmtool.flash.restore import tell_lacking
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.params.catalogue import INCREMENTS, TORQUE_PER_AMPERE
from pmsmtool.params.parameter_set import ASSUMED, ParameterSet

EPOS4 = load_family("epos4")
PER_INCREMENT = next(
    (family, name)
    for family in ("epos2", "faulhaber", "nanotec", "copley", "elmo", "zeroerr", "ingenia", "synapticon")
    for name, cell in load_family(family).cells.items()
    if cell.gain == INCREMENTS and INCREMENTS in load_family(family).cells
)
"""A shipped family whose position gain is counted by the increments that the drive holds."""


def u32(value: float) -> bytes:
    return round(value).to_bytes(4, "little")


def planned(expected: float, held: float) -> Plan:
    """Plan a speed gain of 0.2 N m s/rad for a machine of ``expected`` N m/A, on a drive that holds ``held``."""
    wanted = ParameterSet({TORQUE_PER_AMPERE: expected, "speed.K_p_nms_per_rad": 0.2})
    assert set(names_to_read(EPOS4, wanted)) == set(wanted.values)
    found = {TORQUE_PER_AMPERE: u32(1e6 * held), "speed.K_p_nms_per_rad": u32(1000)}
    return make_plan(EPOS4, wanted, found)


@pytest.mark.parametrize("ratio", [KIND_LEAST + 0.01, 2.0**-0.25, 1.0, 2.0**0.25, 1.0 / KIND_LEAST - 0.01])
def test_gains_are_counted_by_the_torque_constant_that_the_drive_holds(ratio: float) -> None:
    """Whether its ampere is peak or rms: a gain in ampere times its own N m/A is the designed torque."""
    own = round(0.5e6 * ratio) / 1e6
    plan = planned(0.5, own)
    gain = {change.name: change for change in plan.entries}["speed.K_p_nms_per_rad"]
    assert gain.new == u32(0.2e6 / own) and gain.held == pytest.approx(0.2, rel=1e-5)
    assert gain.old_value == pytest.approx(1e-3 * own, rel=1e-6)
    assert len(plan.changes) == len(plan.entries) == 1 and not plan.missing, "the constant stays the drive's"


@pytest.mark.parametrize("ratio", [KIND_LEAST - 0.01, 1.0 / KIND_LEAST + 0.01, 0.1, 10.0])
def test_a_drive_set_up_for_another_motor_is_refused(ratio: float) -> None:
    """A machine of 0.5 N m/A between peak and rms has 0.42 per ampere peak and 0.59 per ampere rms."""
    assert 0.7 < KIND_LEAST < 2.0**-0.25
    with pytest.raises(ConfigError) as caught:
        planned(0.5, 0.5 * ratio)
    assert "0.4204 per ampere peak and 0.5946 per ampere rms" in caught.value.what
    assert f"holds {0.5 * ratio:.4g} N m/A" in caught.value.what and "0x3001:05" in caught.value.where


def test_a_gain_in_amperes_without_the_torque_of_one_is_named() -> None:
    """It was counted among those that the map has no object for."""
    name, found = "speed.K_p_nms_per_rad", {"speed.K_p_nms_per_rad": u32(1000)}
    plan = make_plan(EPOS4, ParameterSet({name: 0.2}), found)
    assert not plan.entries and plan.missing == plan.kept == (name,)
    tell_lacking(Mock(map=EPOS4), plan)  # no row of the map is wrong
    assert plan.left_out() == [f"not written: {name}: {IN_AMPERES}"]


@pytest.mark.parametrize("increments", [0, 4, 4096, 524288])
def test_a_position_gain_is_counted_by_the_increments_that_the_drive_holds(increments: int) -> None:
    family, name = PER_INCREMENT
    drive_map = load_family(family)
    wanted = ParameterSet({INCREMENTS: 1000.0, name: 10.0})
    cells = drive_map.cells
    found = {INCREMENTS: increments.to_bytes(cells[INCREMENTS].size, "little"), name: bytes(cells[name].size)}
    if not cells[INCREMENTS].decode(found[INCREMENTS], {}) > 0.0:
        with pytest.raises(ConfigError, match="holds no increments of a turn"):
            make_plan(drive_map, wanted, found)
        return
    (gain,) = make_plan(drive_map, wanted, found).entries
    held = cells[INCREMENTS].decode(found[INCREMENTS], {})
    assert gain.name == name and gain.wanted == 10.0
    assert gain.new == cells[name].encode(10.0, {INCREMENTS: held}) != cells[name].encode(10.0, {INCREMENTS: 1000.0})


def test_without_an_object_for_it_the_machine_is_believed() -> None:
    cells = {name: cell for name, cell in EPOS4.cells.items() if name != TORQUE_PER_AMPERE}
    wanted = ParameterSet({TORQUE_PER_AMPERE: 0.25, "speed.K_p_nms_per_rad": 0.5})
    plan = make_plan(replace(EPOS4, cells=cells), wanted, {"speed.K_p_nms_per_rad": u32(0)})
    (gain,) = plan.entries
    assert gain.new == u32(2_000_000) and gain.held == pytest.approx(0.5)
    assert TORQUE_PER_AMPERE not in plan.missing


A = Change("motor.pole_pairs", 0x2010, 1, b"\3", b"\4", 3.0, 4.0, 4.0, "1")
B = Change("motor.R_s_ohm", 0x2010, 2, u32(1), u32(2), 0.5, 0.25, 0.2500001, "ohm")
SAME = Change("motor.L_d_h", 0x2010, 3, u32(7), u32(7), 0.003, 0.003, 0.003, "H")
FRESH = replace(B, name="motor.psi_f_wb", old_value=0.0, wanted=0.1, held=0.101, unit="Wb")


@pytest.mark.parametrize(
    ("change", "quantised", "relative"),
    [
        (A, False, 1.0 / 3.0), (B, False, -0.5), (FRESH, True, math.nan), (SAME, False, 0.0),
        (replace(B, held=0.25 * (1.0 + 1.1e-6)), True, -0.5), (replace(B, held=0.25 * (1.0 - 1.1e-6)), True, -0.5),
        (replace(B, wanted=-0.25, held=-0.25), False, -1.5), (replace(B, wanted=-0.25, held=-0.26), True, -1.52),
    ],
)  # fmt: skip
def test_what_the_drive_will_really_hold(change: Change, quantised: bool, relative: float) -> None:
    assert change.quantised == quantised
    assert change.relative == pytest.approx(relative, abs=1e-5, nan_ok=True)


def test_the_difference_list_is_aligned_and_complete() -> None:
    plan = Plan((A, B, FRESH, SAME), {"lut.axis_x": "", "map": "no object"}, reasons={"map": "no object"})
    assert plan.lines({"motor.R_s_ohm": "NOT CHECKED"}) == [
        "motor.pole_pairs    3 ->         4      +33.3 %",
        "motor.R_s_ohm     0.5 -> 0.2500001 ohm  -50 %    NOT CHECKED",
        "motor.psi_f_wb      0 ->     0.101 Wb   (asked for 0.1)",
        "3 of 4 objects change, 1 holds its value already",
        "not written: map: no object",
        "not written: 1 entries of the set that the drive's map has no object for",
    ]
    assert Plan((A,)).lines()[-1] == "1 of 1 objects change, 0 hold their value already"
    assert Plan((SAME, replace(SAME, name="x"))).lines() == ["0 of 2 objects change, 2 hold their value already"]


def blank(name: str, old: bytes, new: bytes) -> Change:
    return Change(name, 0x2042, 0, old, new)


WORDS = bytes(range(20))


@pytest.mark.parametrize(
    ("old", "new", "shown"),
    [
        (WORDS, WORDS[:4] + b"\xff" + WORDS[5:], "20 B -> 20 B   1 of 5 words differ"),
        (WORDS, b"\xff" + WORDS[1:7] + b"\xff" + WORDS[8:], "20 B -> 20 B   2 of 5 words differ"),
        (WORDS, WORDS[:8], "20 B ->  8 B   3 of 5 words differ"),
        (b"", WORDS[:6], "0 B -> 6 B   2 of 2 words differ"),
    ],
)
def test_a_table_is_compared_word_by_word(old: bytes, new: bytes, shown: str) -> None:
    line = Plan((blank("lut.i_d_a", old, new),)).lines()[0]
    assert " ".join(line.split()) == "lut.i_d_a " + " ".join(shown.split())


@pytest.mark.parametrize(
    ("data", "shown"),
    [(b"", "none"), (b"\x0a", "0x0A"), (b"\x01\x02", "0x0201"), (bytes(8), "0x" + 16 * "0"), (bytes(9), "9 B")],
)
def test_an_object_by_its_address_is_shown_as_the_number_on_the_wire(data: bytes, shown: str) -> None:
    line = Plan((blank("0x3001:05 constant", data, b"\xff\x01"),)).lines()[0]
    assert line == f"0x3001:05 constant  {shown} -> 0x01FF"


def test_differences_name_the_object_and_cut_long_bytes() -> None:
    table = replace(blank("lut.i_d_a", b"", bytes(9)), sub=3)
    lines = differences((A, SAME, table, B), {A.name: A.new, SAME.name: b"", table.name: bytes(8), B.name: b"\1\2"})
    assert lines == [
        "motor.L_d_h (0x2010:03): wrote 07 00 00 00, reads ",
        "lut.i_d_a (0x2042:03): wrote 00 00 00 00 .. (9 bytes), reads 00 00 00 00 00 00 00 00",
        "motor.R_s_ohm (0x2010:02): wrote 02 00 00 00, reads 01 02",
    ]
    assert differences((SAME,), {}) == ["motor.L_d_h (0x2010:03): wrote 07 00 00 00, reads "]


@pytest.mark.parametrize(
    ("change", "store", "lines"),
    [
        (A, True, [f"the set is stored, and the drive is reset to see it: {HOMING_LOST}"]),
        (A, False, ["not stored"]),
        (
            replace(A, name="encoder.offset_rad"),
            False,
            ["not stored", f"the encoder's parameters change: {HOMING_LOST}"],
        ),
        (replace(A, name="encoder.offset_rad", new=A.old), False, ["not stored"]),
    ],
)
def test_what_follows_a_download_is_said_before_it(change: Change, store: bool, lines: list[str]) -> None:
    assert Plan((change, SAME)).after_lines(store=store) == lines


def test_a_value_that_nobody_stated_leaves_a_drives_own_limit_alone() -> None:
    """A Copley set to 1 s of its largest current was given 10 s, which no machine file stated."""
    name, pairs = "motor.I_max_time_s", "motor.pole_pairs"
    stated, own = ParameterSet({name: 10.0, pairs: 4.0}), reference_map()
    assumed = replace(stated, provenance={name: ASSUMED})
    copley, found = load_family("copley"), {name: u32(1000)[:2], pairs: u32(3)[:2]}
    assert sorted(change.name for change in make_plan(copley, stated, found).changes) == [name, pairs]
    plan = make_plan(copley, assumed, found)
    assert [change.name for change in plan.changes] == [pairs] and plan.missing == plan.kept == (name,)
    tell_lacking(Mock(map=copley), plan)  # no row of the map is wrong
    assert "10 s is assumed, the machine file states no I_max_time_s" in plan.left_out()[0]
    assert len(make_plan(own, assumed, dict(own.encode(stated))).entries) == 2, "the reference drive has no set-up tool"
    source = load_machine_file("interior-2k2")
    for time_s, due in ((None, ASSUMED), (3.0, GIVEN)):
        file = replace(source, machine=replace(source.machine, I_max_time_s=time_s))
        assert rating_values(file, ratings(file, 300.0))[name].method == due
