# SPDX-License-Identifier: MIT
"""``[vendor_tuning]`` of map files: read back as written, and every kind of mistake refused with file and line."""

from __future__ import annotations

import copy
import math
import re
import tomllib
from collections.abc import Iterator
from typing import Any

import pytest

from pmsmtool.drive_maps.drive_map import DriveMap
from pmsmtool.drive_maps.drive_map_file import dump_drive_map, map_hash, parse_drive_map
from pmsmtool.drive_maps.shipped_maps import family_names, load_family
from pmsmtool.drive_maps.wire_units import counted_in
from pmsmtool.errors import ConfigError
from pmsmtool.files import data_folder
from pmsmtool.toml_file import toml_text

HEAD = """\
schema = "pmsmtool.drive-map/1"
name = "mine"
vendor = 0x123
product = 7
[objects]
"motor.pole_pairs" = { index = 0x2001, sub = 1, type = "UNSIGNED8", unit = "1" }
"motor.R_s_ohm" = { index = 0x2001, sub = 2, type = "UNSIGNED32", unit = "uohm" }
[sources]
doc = "manual, p. 3"
[vendor_tuning]
"""
COMMANDS = (
    HEAD
    + """\
kind = "os_command"
mode = -2
order = "big"
source = "doc"
failures = { 251 = "not now" }
[vendor_tuning.steps]
"cable" = { command = 6, timeout_s = 5, turns = false, moves = "nothing", failures = { 0 = "broken" } }
"motor.pole_pairs" = { command = 7, type = "UNSIGNED8", unit = "1", timeout_s = 9.5, turns = true, moves = "turns" }
"motor.R_s_ohm" = { command = 8, type = "UNSIGNED32", unit = "mohm", timeout_s = 5, turns = false, moves = "jerks" }
"motor.psi_f_wb" = { command = 9, type = "INTEGER32", unit = "mN m/A rms", form = "torque constant", timeout_s = 60, \
turns = true, moves = "runs up", uses = ["motor.R_s_ohm"] }
"""
)
COMMAND_MISTAKES = [
    ('kind = "os_command"', "", "kind None is not os_command", 10),
    ('kind = "os_command"', 'kind = "manual"', "kind 'manual' is not os_command", 11),
    ("mode = -2", "mode = 2", "a maker's own mode of operation", 12),
    ("mode = -2", 'mode = "-2"', "a maker's own mode of operation", 12),
    ('order = "big"', 'order = "odd"', "order 'odd' is not one of little, big", 13),
    ('source = "doc"', 'source = "rumour"', "not in [sources]", 14),
    ("251", "256", "error codes from 0 to 255", 15),
    ('251 = "not now"', '251 = ""', "each with what it means", 15),
    ("failures = { 251", "start_bit = 4\nfailures = { 251", "unknown key start_bit; there are", 15),
    ("command = 6", "command = 256", "command 256 is no number from 0 to 255", 17),
    ("command = 6, ", "", "command None is no number", 17),
    ("command = 7", "command = 6", "command 6 is already cable", 18),
    ("5, turns = false, moves = \"nothing\"", "0, turns = false, moves = \"nothing\"", "no time up to 600 s", 17),
    ("timeout_s = 9.5", "timeout_s = -1", "no time up to 600 s", 18),
    ("timeout_s = 9.5", "timeout_s = inf", "no time up to 600 s", 18),
    ("turns = true, moves = \"turns\"", "moves = \"turns\"", "say whether the shaft must be free", 18),
    ("moves = \"nothing\"", "moves = \"\"", "say what it does to the machine", 17),
    ("\"cable\" = { command = 6,", "\"cable\" = { command = 6, unit = \"1\",", "so it has no unit", 17),
    ("\"cable\"", "\"motor.n_max_rpm\"", "no result this program takes", 17),
    ("\"cable\" = { command = 6,", "\"cable\" = { command = 6, sub = 1,", "unknown key sub", 17),
    ("command = 7, type = \"UNSIGNED8\",", "command = 7,", "type None is not one of", 18),
    ("unit = \"mohm\", ", "", "unit is missing", 19),
    ("unit = \"mohm\"", "unit = \"mH\"", "inductance, expected resistance", 19),
    ("form = \"torque constant\"", "form = \"time\"", "needs the gain", 20),
    ("unit = \"mN m/A rms\"", "unit = \"mohm rms\"", "has no rms value", 20),
    ("uses = [\"motor.R_s_ohm\"]", "uses = [\"motor.L_q_h\"]", "which no step before it measures", 20),
    ("uses = [\"motor.R_s_ohm\"]", "uses = \"motor.R_s_ohm\"", "uses must be a list", 20),
    ("\"motor.R_s_ohm\" = { index = 0x2001", "\"motor.J_kgm2\" = { index = 0x2001", "[objects] does not hold", 20),
]  # fmt: skip


def parse(text: str) -> DriveMap:
    return parse_drive_map(text, "mine/map.toml")


def test_what_is_written_is_read_back() -> None:
    mine = parse(COMMANDS)
    assert parse(dump_drive_map(mine)) == mine
    assert map_hash(mine) != map_hash(parse(COMMANDS.replace("mode = -2", "mode = -3")))


@pytest.mark.parametrize(("old", "new", "complaint", "line"), COMMAND_MISTAKES)
def test_a_mistake_is_refused_with_file_and_line(old: str, new: str, complaint: str, line: int) -> None:
    assert COMMANDS.count(old) == 1
    with pytest.raises(ConfigError) as caught:
        parse(COMMANDS.replace(old, new))
    said = [text for text in caught.value.violations if complaint in text]
    assert said, caught.value.violations
    assert said[0].startswith(f"mine/map.toml:{line}: ")


def test_a_torque_constant_needs_pole_pairs_from_somewhere() -> None:
    lines = [line for line in COMMANDS.splitlines(keepends=True) if not line.startswith('"motor.pole_pairs"')]
    with pytest.raises(ConfigError, match="cannot be used") as caught:
        parse("".join(lines))
    assert any("its form needs motor.pole_pairs" in text for text in caught.value.violations)


def test_steps_are_chosen_by_what_is_asked_with_what_they_use() -> None:
    tuning = parse(COMMANDS).vendor_tuning
    assert tuning is not None

    def names(*quantities: str, turning: bool = True) -> list[str]:
        return [step.title for step in tuning.steps_for(frozenset(quantities), turning=turning)]

    assert names("psi") == ["cable", "R_s_ohm", "psi_f_wb"]  # the check always, the resistance because psi uses it
    assert names("poles", "R") == ["cable", "pole_pairs", "R_s_ohm"]
    assert names("R", "psi", turning=False) == ["cable", "R_s_ohm"]


def test_torque_over_an_rms_current_is_smaller_over_its_peak() -> None:
    """1 N m per A rms flows with a peak of sqrt 2 A."""
    assert counted_in("mN m/A rms", "N m/A") == pytest.approx(1e-3 / 2.0**0.5, rel=1e-14)


def test_shipped_maps_name_the_source_of_what_they_start() -> None:
    told = {name: load_family(name) for name in family_names() if load_family(name).vendor_tuning is not None}
    assert set(told) >= {"synapticon"}
    for drive_map in told.values():
        tuning = drive_map.vendor_tuning
        assert tuning is not None and tuning.source in drive_map.sources
        assert all(cell.source in drive_map.sources for cell in tuning.results.values())
        assert all(used in drive_map.cells for step in tuning.steps.values() for used in step.uses)


def test_the_guide_shows_a_procedure_that_is_accepted() -> None:
    guide = (data_folder("firmware-params") / "README.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```toml\n(.*?)```", guide, re.DOTALL)
    (own,) = [block for block in blocks if "[vendor_tuning]" in block]
    tuning = parse(blocks[0] + own).vendor_tuning
    assert tuning is not None and tuning.quantities == {"R"}
    assert tuning.results["motor.R_s_ohm"].factor == pytest.approx(0.5e-3)  # between two terminals


def _leaves(table: dict[str, Any], path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    for key, value in table.items():
        yield (*path, key)
        if isinstance(value, dict):
            yield from _leaves(value, (*path, key))


@pytest.mark.chain
def test_any_value_of_any_kind_is_refused_in_words() -> None:
    """Every key and table of the section in turn holds something else: read, or refused, never anything worse."""
    document = tomllib.loads(COMMANDS)
    reasons: list[int] = []
    for path in _leaves(document["vendor_tuning"]):
        for other in (True, -1, 3.5, math.inf, "x", "", [], [["x"]], {}, {"x": {"y": []}}):
            changed = copy.deepcopy(document)
            table = changed["vendor_tuning"]
            for key in path[:-1]:
                table = table[key]
            table[path[-1]] = other
            try:
                parse(toml_text(changed))
            except ConfigError as error:
                reasons.append(len(error.violations))
    assert len(reasons) > 100 and min(reasons) > 0
