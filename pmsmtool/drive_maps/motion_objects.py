# SPDX-License-Identifier: MIT
"""Table ``[motion]`` of a drive map: the maker's own objects for what CiA 402 leaves optional, and motion needs.

A current whose manual does not say peak or rms is written ``mA peak-or-rms``. It is then taken as rms everywhere: that
is the smaller physical current for a limit or a command, and the larger one for what is watched.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from pmsmtool.drive_maps.wire_units import wire_unit

TABLE = "motion"
DIMENSIONS: Mapping[str, str] = {
    "current_limit": "current",
    "rated_current": "current",
    "current": "current",
    "asked_current": "current",
    "target_current": "current",
    "target_speed": "angular speed",
    "speed_limit": "angular speed",
    "counts_per_turn": "ratio",
    "loop_period": "time",
}
"""Rows the table may have, and what each counts."""
FIXED: Mapping[str, str] = {"counts_per_turn": "1", "loop_period": "s", "rated_current": ""}
"""Rows that may be a number, which the drive's owner knows where no object holds it, and their unit without one."""
UNDECIDED = " peak-or-rms"
"""End of a unit of current whose kind no source says."""
_KEYS = ("index", "sub", "type", "unit", "mode", "number", "source")

Complain = Callable[[str, str], None]
CheckObject = Callable[[Any, tuple[str, ...], Complain], bool]


@dataclass(frozen=True, slots=True)
class MotionObject:
    """Where a drive keeps, shows or takes one of :data:`DIMENSIONS`."""

    index: int = 0
    sub: int = 0
    wire: str = "UNSIGNED32"
    unit: str = "1"
    source: str = ""
    """As of a signal of the map; ``index`` 0 where the maker fixes the ``number``."""
    mode: int = 0
    """Mode of operation in which a target acts; 0: none is needed."""
    number: float = 0.0
    """The value itself where no object holds it; 0: an object does."""

    @property
    def undecided(self) -> bool:
        """Whether no source says if the current is peak or rms."""
        return self.unit.endswith(UNDECIDED)

    @property
    def per_count(self) -> float:
        """SI value of one count; of an undecided current as if it were rms."""
        return wire_unit(_decided(self.unit)).scale


def _decided(unit: str) -> str:
    return unit.removesuffix(UNDECIDED) + " rms" if unit.endswith(UNDECIDED) else unit


def parse_motion(
    table: Mapping[str, Any],
    sources: Mapping[str, str],
    complain: Callable[[tuple[str, ...], str], None],
    check_object: CheckObject,
) -> dict[str, MotionObject]:
    """Return the rows that can be used; tells what is wrong with the others."""
    good: dict[str, MotionObject] = {}
    for name, row in table.items():

        def tell(key: str, what: str, name: str = name) -> None:
            complain((TABLE, name, key) if key else (TABLE, name), f"{name}: {what}")

        if name not in DIMENSIONS:
            tell("", f"no such row; there are {', '.join(DIMENSIONS)}")
        elif isinstance(row, dict) and "number" in row:
            found = _fixed(name, row, sources, tell)
            good |= {} if found is None else {name: found}
        elif check_object(row, _KEYS, tell):
            found = _object(name, row, tell)
            good |= {} if found is None else {name: found}
    return good


def _fixed(name: str, row: Mapping[str, Any], sources: Mapping[str, str], tell: Complain) -> MotionObject | None:
    number, source, unit = row["number"], row.get("source", ""), row.get("unit", FIXED.get(name, ""))
    if type(number) not in (int, float) or not 0.0 < number < 2.0**32:
        tell("number", "number must be positive")
    elif source not in sources:
        tell("source", "a fixed number needs a source in [sources]")
    elif set(row) - {"number", "source", "unit"}:
        tell("", "a fixed number has a source, a unit, and nothing else")
    elif name not in FIXED:
        tell("number", f"no fixed number, but an object; a number may be {', '.join(FIXED)}")
    elif _dimension(unit, tell) == DIMENSIONS[name]:
        return MotionObject(number=float(number), unit=unit, source=source)
    else:
        tell("unit", f"unit {unit!r}: {DIMENSIONS[name]} expected, of a current peak or rms")
    return None


def _dimension(unit: object, tell: Complain) -> str:
    try:
        return wire_unit(str(unit)).dimension
    except ValueError as error:
        tell("unit", f"unit {unit!r}: {error}")
        return ""


def _object(name: str, row: Mapping[str, Any], tell: Complain) -> MotionObject | None:
    try:
        dimension = wire_unit(_decided(row["unit"])).dimension
    except ValueError as error:
        tell("unit", f"unit {row['unit']!r}: {error}")
        return None
    if dimension != DIMENSIONS[name]:
        tell("unit", f"unit {row['unit']!r}: {dimension}, expected {DIMENSIONS[name]}")
        return None
    mode = row.get("mode", 0)
    if type(mode) is not int or not -128 <= mode <= 127 or (mode != 0) != name.startswith("target_"):
        tell("mode", "a target needs the mode of operation in which it acts, the others none")
        return None
    return MotionObject(row["index"], row["sub"], row["type"], row["unit"], row.get("source", ""), mode)


PLATE: Mapping[str, str] = {
    "rated_current": '{ number = ?, unit = "A rms", source = "plate" }  # or "A peak": 0x6071 counts permille of it',
    "counts_per_turn": '{ number = ?, source = "plate" }  # units of 0x6064 per turn of the motor',
}
"""Rows that a name plate or a manual fills, as text; what is to be written there is a question mark, no number."""


def blank_map(vendor: int, product: int, rows: Iterable[str]) -> list[str]:
    """Return the lines of a map file that says only whose drive it is for, and asks for numbers of its name plate."""
    return [
        'schema = "pmsmtool.drive-map/1"', 'name = "mine"', f"vendor = {vendor:#010x}", f"product = {product:#010x}",
        f"[{TABLE}]", *(f"{name} = {PLATE[name]}" for name in rows), "[sources]", 'plate = "its name plate"',
    ]  # fmt: skip


def dump_motion(rows: Mapping[str, MotionObject]) -> dict[str, dict[str, Any]]:
    """Return the table as a map file holds it."""

    def row(name: str, item: MotionObject) -> dict[str, Any]:
        if item.number:
            unit = {} if item.unit == FIXED[name] else {"unit": item.unit}
            return {"number": item.number, "source": item.source} | unit
        found: dict[str, Any] = {"index": item.index, "sub": item.sub, "type": item.wire, "unit": item.unit}
        found |= {"mode": item.mode} if item.mode else {}
        return found | ({"source": item.source} if item.source else {})

    return {name: row(name, item) for name, item in rows.items()}
