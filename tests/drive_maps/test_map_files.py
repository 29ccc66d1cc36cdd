# SPDX-License-Identifier: MIT
"""Map files: every shipped one can be used, every kind of mistake is refused with file and line."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest

from pmsmtool.drive_maps.drive_map import REFERENCE_PRODUCT, REFERENCE_VENDOR, Cell, DriveMap, reference_map
from pmsmtool.drive_maps.drive_map_file import dump_drive_map, map_hash, parse_drive_map
from pmsmtool.drive_maps.wire_units import counted_in, wire_unit
from pmsmtool.errors import ConfigError
from pmsmtool.files import data_folder
from pmsmtool.params.catalogue import BY_NAME
from pmsmtool.params.parameter_set import ParameterSet
from pmsmtool.toml_file import line_of

FOLDER = data_folder("firmware-params")
FAMILIES = sorted(path.parent.name for path in FOLDER.glob("*/map.toml"))
NAMED = {"epos4", "epos2", "copley", "nanotec", "synapticon", "faulhaber", "elmo", "ingenia", "pmsmsim", "zeroerr"}

GOOD = """\
schema = "pmsmtool.drive-map/1"
name = "mine"
vendor = 0x123
product = 7

[objects]
"motor.pole_pairs" = { index = 0x2001, sub = 1, type = "UNSIGNED8", unit = "1", source = "doc" }
"current.K_p_q_v_per_a" = { index = 0x2001, sub = 2, type = "UNSIGNED16", unit = "mV/A", factor = 1e-3, source = "doc" }
"current.K_i_q_v_per_as" = { index = 0x2001, sub = 3, type = "UNSIGNED16", unit = "us", gain = "current.K_p_q_v_per_a" }
"encoder.offset_rad" = { index = 0x2001, sub = 4, type = "INTEGER32", unit = "deg" }

[signals]
omega_M_rad_s = { index = 0x606C, sub = 0, type = "INTEGER32", unit = "rpm" }

[left_out]
"motor.R_s_ohm" = "no object"

[sources]
doc = "manual, p. 3"
"""

MISTAKES = [
    # (what is replaced, by what, part of the message, line)
    ("index = 0x2001, sub = 1,", "sub = 1,", "needs index", 7),
    ("index = 0x2001, sub = 1,", "index = 0x12001, sub = 1,", "needs index", 7),
    ("index = 0x2001, sub = 1,", 'index = "0x2001", sub = 1,', "needs index", 7),
    ("index = 0x2001, sub = 1,", "index = 0x2001, sub = 255,", "needs index", 7),
    ("index = 0x2001, sub = 1,", "index = 0x1010, sub = 1,", "outside 0x2000", 7),
    ("index = 0x2001, sub = 1,", "index = 0xA000, sub = 1,", "outside 0x2000", 7),
    ("index = 0x2001, sub = 1,", "index = 0x6071, sub = 0,", "moves the machine", 7),
    ("index = 0x2001, sub = 2,", "index = 0x2001, sub = 1,", "already motor.pole_pairs", 8),
    ('"UNSIGNED8"', '"UNSIGNED7"', "is not one of", 7),
    ('"UNSIGNED8"', '"REAL64"', "is not one of", 7),
    ('type = "UNSIGNED8", ', "", "type None", 7),
    ('"INTEGER32", unit = "deg"', '"UNSIGNED32", unit = "deg"', "cannot hold the negative", 10),
    ("factor = 1e-3", "factor = -1e-3", "is negative", 8),
    ("factor = 1e-3", "factor = 1e-6", "contradicts the unit", 8),
    ("factor = 1e-3", "factor = 0", "not zero", 8),
    ("factor = 1e-3", "factor = inf", "finite", 8),
    ("factor = 1e-3", 'factor = "1e-3"', "finite", 8),
    ('unit = "mV/A", ', "", "unit is missing", 8),
    ('unit = "mV/A"', 'unit = ""', "unit is missing", 8),
    ('unit = "mV/A"', 'unit = "mA rms"', "current, expected gain V/A", 8),
    ('unit = "mV/A"', 'unit = "bananas"', "unknown unit", 8),
    ('unit = "mV/A"', 'unit = "mV/A rms"', "no rms value", 8),
    ('unit = "mV/A"', 'unit = "mV/A peak"', "no peak value", 8),
    ('unit = "us"', 'unit = "V/(A s)"', "expected time", 9),
    ('gain = "current.K_p_q_v_per_a"', 'gain = "current.K_p_d_v_per_a"', "does not hold", 9),
    ('gain = "current.K_p_q_v_per_a"', 'gain = "K_p"', "not in the parameter catalogue", 9),
    ('gain = "current.K_p_q_v_per_a"', 'form = "rate"', "needs the gain", 9),
    ('gain = "current.K_p_q_v_per_a"', 'form = "sum"', "is not one of value", 9),
    ('unit = "deg" }', 'unit = "deg", rounding = "up or down" }', "rounding", 10),
    ('unit = "deg" }', 'unit = "deg", offset = "1" }', "offset", 10),
    ('unit = "deg" }', 'unit = "deg", scale = 2 }', "unknown key scale", 10),
    ('source = "doc" }\n"current.K_p', 'source = "hearsay" }\n"current.K_p', "not in [sources]", 7),
    ('"motor.pole_pairs"', '"motor.poles"', "not in the parameter catalogue", 7),
    ('"INTEGER32", unit = "rpm"', '"INTEGER32", unit = "N m"', "torque, expected angular speed", 13),
    ("omega_M_rad_s", "omega", "no signal of that name", 13),
    ('"motor.R_s_ohm" = "no object"', '"motor.R_s_ohm" = ""', "say why", 16),
    ('"motor.R_s_ohm"', '"motor.pole_pairs"', "mapped all the same", 16),
    ("vendor = 0x123", 'vendor = "0x123"', "vendor: not a whole number", 3),
    ("product = 7", "product = -7", "product: not a whole number", 4),
    ("product = 7", "product = 7\nproducts = [8]", "products: unknown key", 5),
    ('name = "mine"', "name = 3", "name is missing", 2),
    ("[left_out]", "[capabilities]\ntorque_mode = 1\n[left_out]", "expected a bool", 16),
    ("[left_out]", '[capabilities]\nrecorder = "paper"\n[left_out]', "expected none, domain", 16),
    ("[left_out]", "[capabilities]\nflight = true\n[left_out]", "unknown capability", 16),
]

ROWS = """[capabilities]
recorder = "rows"
[recorder]
i_q_a = { number = 14, unit = "0.01 A peak", source = "doc" }
u_q_v = { number = 20, unit = "0.1 V" }
[left_out]"""
RINGS = """[capabilities]
recorder = "rings"
[recorder]
period = { unit = "100 us", source = "doc" }
i_q_a = { index = 0x6078, sub = 0, type = "INTEGER16", unit = "mA rms", source = "doc" }
[left_out]"""
RECORDER_MISTAKES = [
    # (the table, what is replaced, by what, part of the message, line)
    (ROWS, "number = 14, ", "", "number must be a trace variable's", 18),
    (ROWS, "number = 14", "number = 0", "number must be a trace variable's", 18),
    (ROWS, "number = 14", "number = 70000", "number must be a trace variable's", 18),
    (ROWS, "number = 14", "number = true", "number must be a trace variable's", 18),
    (ROWS, "number = 20", "number = 14", "is recorded as i_q_a already", 19),
    (ROWS, "number = 14", "index = 0x6078", "unknown key index", 18),
    (ROWS, 'unit = "0.01 A peak"', 'unit = ""', "unit is missing", 18),
    (ROWS, 'unit = "0.01 A peak"', 'unit = "0.01 V"', "voltage, expected current", 18),
    (ROWS, 'unit = "0.01 A peak"', 'unit = "permille of 0x6075"', "a record holds no 0x6075", 18),
    (ROWS, 'unit = "0.01 A peak"', 'unit = "0 A peak"', "worth something", 18),
    (ROWS, 'source = "doc"', 'source = "hearsay"', "not in [sources]", 18),
    (ROWS, "i_q_a =", "i_x_a =", "no signal of that name", 18),
    (ROWS, "i_q_a =", "target_torque_nm =", "no signal of that name", 18),
    (ROWS, 'i_q_a = { number = 14, unit = "0.01 A peak", source = "doc" }', "i_q_a = 14", "needs number and unit", 18),
    (ROWS, "u_q_v = {", 'period = { unit = "us" }\nu_q_v = {', "says its period itself", 19),
    (ROWS, 'recorder = "rows"', 'recorder = "index"', "takes no channels", 17),
    (RINGS, "index = 0x6078, ", "", "needs index", 19),
    (RINGS, "index = 0x6078", "index = 0x1018", "outside 0x2000", 19),
    (RINGS, '"INTEGER16"', '"INTEGER32"', "a ring is read in words", 19),
    (RINGS, '"INTEGER16"', '"INTEGER17"', "is not one of", 19),
    (RINGS, "index = 0x6078", "number = 14, index = 0x6078", "unknown key number", 19),
    (RINGS, 'unit = "mA rms"', 'unit = "mV"', "voltage, expected current", 19),
    (RINGS, 'unit = "100 us"', 'unit = "100 V"', "voltage, expected time", 18),
    (RINGS, 'unit = "100 us"', 'units = "100 us"', "unknown key units", 18),
    (RINGS, '"100 us", source = "doc"', '"100 us", source = "hearsay"', "not in [sources]", 18),
]


def parse(text: str) -> DriveMap:
    return parse_drive_map(text, "mine/map.toml")


@pytest.mark.parametrize(("old", "new", "complaint", "line"), MISTAKES)
def test_a_mistake_is_refused_with_file_and_line(old: str, new: str, complaint: str, line: int) -> None:
    assert GOOD.count(old) == 1
    with pytest.raises(ConfigError) as caught:
        parse(GOOD.replace(old, new))
    said = [text for text in caught.value.violations if complaint in text]
    assert said, caught.value.violations
    assert said[0].startswith(f"mine/map.toml:{line}: ")


@pytest.mark.parametrize(("table", "old", "new", "complaint", "line"), RECORDER_MISTAKES)
def test_a_mistake_about_the_recorder_is_refused(table: str, old: str, new: str, complaint: str, line: int) -> None:
    text = GOOD.replace("[left_out]", table)
    assert text.count(old) >= 1
    before, place, after = text.partition("[capabilities]")
    with pytest.raises(ConfigError) as caught:
        parse(before + place + after.replace(old, new, 1))
    said = [text for text in caught.value.violations if complaint in text]
    assert said, caught.value.violations
    assert said[0].startswith(f"mine/map.toml:{line}: ")


@pytest.mark.parametrize("table", [ROWS, RINGS])
def test_what_a_recorder_takes_is_read_and_written_back(table: str) -> None:
    found = parse(GOOD.replace("[left_out]", table))
    assert found.recorder.channels["i_q_a"].source == "doc"
    assert parse(dump_drive_map(found)) == found
    assert map_hash(found) != map_hash(parse(GOOD))
    if table is RINGS:
        assert (found.recorder.period, found.recorder.period_source) == ("100 us", "doc")


LIMIT = '"motor.I_max_apk" = {{ index = 0x2001, sub = 5, type = "UNSIGNED16", unit = "{0}", rounding = "down" }}'
SIGNAL = 'i_q_a = {{ index = 0x6078, sub = 0, type = "INTEGER16", unit = "{0}" }}'
WITH_CURRENT = [
    # (the table the row is added to, the row, its line)
    ("[signals]\n", LIMIT + "\n\n[signals]\n", 12),
    ("[left_out]\n", SIGNAL + "\n\n[left_out]\n", 15),
    ("[left_out]\n", ROWS.replace("0.01 A peak", "{0}").replace("{ ", "{{ ").replace(" }", " }}") + "\n", 18),
    ("[left_out]\n", RINGS.replace("mA rms", "{0}").replace("{ ", "{{ ").replace(" }", " }}") + "\n", 19),
]


@pytest.mark.parametrize("bare", ["A", "mA", "0.01 A"])
@pytest.mark.parametrize(("table", "row", "line"), WITH_CURRENT)
def test_a_current_says_whether_it_is_peak_or_rms(table: str, row: str, line: int, bare: str) -> None:
    assert GOOD.count(table) == 1
    for kind in ("peak", "rms"):
        parse(GOOD.replace(table, row.format(f"{bare} {kind}")))
    with pytest.raises(ConfigError) as caught:
        parse(GOOD.replace(table, row.format(bare)))
    (said,) = caught.value.violations
    assert said.startswith(f"mine/map.toml:{line}: ")
    assert f"write '{bare} peak' or '{bare} rms'" in said


def test_a_limit_in_rms_is_written_41_percent_lower_than_one_in_peak() -> None:
    limit = "motor.I_max_apk"
    raw = {
        kind: parse(GOOD.replace("[signals]", LIMIT.format(f"mA {kind}") + "\n[signals]")).cells[limit].encode(10.0, {})
        for kind in ("peak", "rms")
    }
    assert {kind: int.from_bytes(data, "little") for kind, data in raw.items()} == {"peak": 10_000, "rms": 7_071}


def test_a_current_without_a_unit_of_its_own_is_written_as_peak() -> None:
    cell = Cell("motor.I_max_apk", 0x2001, 5, "UNSIGNED16", 1e-3)
    found = parse(dump_drive_map(DriveMap("mine", 1, 2, {cell.name: cell}))).cells[cell.name]
    assert (found.factor, found.unit) == (1e-3, "0.001 A peak")


def test_all_mistakes_are_listed_at_once() -> None:
    text = GOOD.replace("factor = 1e-3", "factor = -1e-3").replace('"UNSIGNED8"', '"REAL64"').replace('"deg"', '""')
    with pytest.raises(ConfigError) as caught:
        parse(text)
    assert [int(re.match(r".*?:(\d+):", said).group(1)) for said in caught.value.violations] == [7, 8, 10]  # type: ignore[union-attr]


def test_other_files_are_refused() -> None:
    for text, complaint in (("a = ", "is not TOML"), ("a = 1", "has no schema")):
        with pytest.raises(ConfigError, match=complaint):
            parse(text)


def test_lines_are_found_in_both_ways_of_writing() -> None:
    text = '[objects."a.b"]\nindex = 1\n\n[objects]\n"c.d" = { index = 2 }\n'
    assert line_of(text, ("objects", "a.b", "index")) == 2
    assert line_of(text, ("objects", "c.d", "index")) == 5
    assert line_of(text, ("nothing",)) == 1


def test_forms_of_an_integral_gain_and_of_a_torque_constant() -> None:
    K_p = Cell("current.K_p_q_v_per_a", 0x2500, 0, "REAL32", unit="V/A")
    rate = Cell("current.K_i_q_v_per_as", 0x2501, 0, "REAL32", 1.0, 0.0, "nearest", K_p.name, "1/s", "rate")
    values = {K_p.name: 2.0, rate.name: 5000.0}
    data = rate.encode(5000.0, values)
    assert Cell("x", 0, 0, "REAL32").decode(data, {}) == 2500.0
    assert rate.decode(data, values) == 5000.0
    pairs = {"motor.pole_pairs": 3.0}
    constant = Cell(
        "motor.psi_f_wb", 0x6410, 12, "UNSIGNED32", 1e-5, 0.0, "nearest", "motor.pole_pairs", "0.01 N mm/A",
        "torque constant",
    )  # fmt: skip
    data = constant.encode(0.1, pairs)  # K_t = 1.5 * 3 * 0.1 = 0.45 N m/A
    assert int.from_bytes(data, "little") == 45_000
    assert constant.decode(data, pairs) == pytest.approx(0.1, rel=1e-12)


@pytest.mark.parametrize(
    ("unit", "symbol", "value"),
    [
        ("uV/(A ms)", "V/(A s)", 1e-3),
        ("10 mohm line-line", "ohm", 5e-3),
        ("mA rms", "A", 1.4142135623730951e-3),
        ("mA peak", "A", 1e-3),
        ("0.01 A peak", "A", 0.01),
        ("V rms", "V", 1.4142135623730951),
        ("0.1 V", "V", 0.1),
        ("us", "ns", 1000.0),
        ("rpm", "rpm", 1.0),
        ("rev", "rad", 6.283185307179586),
        ("N m/(rev/s)", "N m s/rad", 0.15915494309189535),
    ],
)
def test_what_a_count_is_worth(unit: str, symbol: str, value: float) -> None:
    assert counted_in(unit, symbol) == pytest.approx(value, rel=1e-14)


def test_relative_units_know_their_base() -> None:
    assert wire_unit("permille of 0x6075").relative_to == 0x6075
    with pytest.raises(ValueError, match="relative to 0x6076"):
        counted_in("permille of 0x6076", "N m")


def test_the_named_families_are_there() -> None:
    assert set(FAMILIES) >= NAMED


@pytest.mark.parametrize("family", FAMILIES)
def test_shipped_maps_can_be_used_and_say_where_they_come_from(family: str) -> None:
    path = FOLDER / family / "map.toml"
    drive_map = parse_drive_map(path.read_text(encoding="utf-8"), str(path))
    assert drive_map.name == family
    assert parse_drive_map(dump_drive_map(drive_map)) == drive_map
    if family == "pmsmsim":
        return
    rows = [*drive_map.cells.values(), *drive_map.signals.values(), *drive_map.recorder.channels.values()]
    assert all(row.source in drive_map.sources for row in rows)
    # the gains decide whether a design can be sent: mapped, or said why not
    for name in ("current.K_p_q_v_per_a", "current.K_i_q_v_per_as"):
        assert (name in drive_map.cells) != (name in drive_map.left_out)


def test_hash_follows_content_not_layout() -> None:
    again = parse(GOOD.replace("[left_out]", "# a remark\n\n[left_out]"))
    assert map_hash(again) == map_hash(parse(GOOD))
    assert map_hash(parse(GOOD.replace("sub = 4", "sub = 5"))) != map_hash(parse(GOOD))


def test_an_offset_is_what_the_drive_shows_at_zero() -> None:
    """SI = raw factor + offset, here of an encoder whose zero is at 30 degrees."""
    angle = 'type = "INTEGER32", unit = "deg"'
    cell = parse(GOOD.replace(angle, f"{angle}, offset = {math.radians(30.0)!r}")).cells["encoder.offset_rad"]
    assert int.from_bytes(cell.encode(math.radians(75.0), {}), "little") == 45
    assert cell.decode((45).to_bytes(4, "little"), {}) == pytest.approx(math.radians(75.0), rel=1e-12)


def test_identity() -> None:
    mine = parse(GOOD.replace("product = 7", "product = 7\nmore_products = [9]"))
    assert mine.is_for(0x123, 7) and mine.is_for(0x123, 9) and not mine.is_for(0x123, 8) and not mine.is_for(1, 7)
    assert reference_map().is_for(REFERENCE_VENDOR, REFERENCE_PRODUCT)


@pytest.mark.parametrize("family", FAMILIES)
def test_every_default_that_is_mapped_can_be_written(family: str) -> None:
    path = FOLDER / family / "map.toml"
    drive_map = parse_drive_map(path.read_text(encoding="utf-8"), str(path))
    defaults = ParameterSet({name: BY_NAME[name].default for name in drive_map.cells})
    held = drive_map.quantised(defaults).values
    for name, cell in drive_map.cells.items():
        if cell.form == "value" and cell.wire != "REAL32":
            assert abs(held[name] - defaults.values[name]) <= cell.factor


def test_the_guide_shows_a_map_that_is_accepted() -> None:
    guide = (Path(FOLDER) / "README.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```toml\n(.*?)```", guide, re.DOTALL)
    assert blocks
    assert parse(blocks[0]).cells
