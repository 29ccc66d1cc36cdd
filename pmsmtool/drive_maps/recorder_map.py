# SPDX-License-Identifier: MIT
"""``[recorder]`` of a drive map: what the recorder of a drive can be told to record; written, read back, refused.

A wrong number here records another quantity than its name says, and nothing later can tell: a channel must have its
own number or object, a unit of the right dimension, and a type the recorder is known to lay out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from pmsmtool.drive_maps.wire_units import wire_unit

TABLE = "recorder"
PERIOD = "period"
UNSCALED = "asked_u_q"
"""Output of the q current loop in counts of unknown worth; ``u_q_v`` of the same variable says it in volts instead."""
LARGEST_NUMBER = 0x7FFF
RING_TYPES = ("UNSIGNED16", "INTEGER16")
"""One word each: how two words make a number is in no source read."""
_KEYS = {"rows": ("number", "unit", "source"), "rings": ("index", "sub", "type", "unit", "source")}
_PERIOD_KEYS = ("unit", "source")

Complain = Callable[[tuple[str, ...], str], None]
"""Told the path of a key and what is wrong with it."""
CheckObject = Callable[[Any, tuple[str, ...], Callable[[str, str], None]], bool]
"""Checks address, type, unit and source of a row; returns whether it can be used further."""

Recording = Literal["none", "domain", "index", "rows", "rings"]
"""How a recorder is set up and read, by what its data are: ``domain``, one upload with a CRC-32 (the reference drive);
``index``, blocks out of one register (Ingenia's monitor); ``rows``, numbered trace variables, a row of them per sample
(Copley); ``rings``, a ring of words per variable (maxon EPOS2)."""

Address = tuple[int, int, str]
"""Index, sub-index and ``struct`` letter of an object."""


@dataclass(frozen=True, slots=True)
class Channel:
    """A signal that a recorder can take."""

    unit: str
    """What one recorded count is worth (``drive_maps/wire_units.py``)."""
    number: int = 0
    """Number of the trace variable; 0 where the recorder takes objects."""
    index: int = 0
    sub: int = 0
    wire: str = ""
    """The object and its CiA 301 type; empty where the recorder takes numbers."""
    source: str = ""
    """Key of ``DriveMap.sources``."""


@dataclass(frozen=True, slots=True)
class RecorderMap:
    """The table ``[recorder]``."""

    channels: Mapping[str, Channel] = field(default_factory=dict)
    """By the names of ``drive_map.SIGNALS``."""
    period: str = ""
    """What one count of the recorder's period is worth, where the drive itself does not say it; empty: not known."""
    period_source: str = ""
    """Key of ``DriveMap.sources``."""


def dump_recorder(recorder: RecorderMap) -> dict[str, Any]:
    """Return the table of a map file."""
    period = {PERIOD: _sourced({"unit": recorder.period}, recorder.period_source)} if recorder.period else {}
    return {**period, **{name: _row(channel) for name, channel in recorder.channels.items()}}


def _row(channel: Channel) -> dict[str, Any]:
    where: dict[str, Any] = {"number": channel.number}
    if not channel.number:
        where = {"index": channel.index, "sub": channel.sub, "type": channel.wire}
    return _sourced({**where, "unit": channel.unit}, channel.source)


def _sourced(row: dict[str, Any], source: str) -> dict[str, Any]:
    return row | ({"source": source} if source else {})


def parse_recorder(
    table: Mapping[str, Any],
    kind: str,
    dimensions: Mapping[str, str],
    sources: Mapping[str, str],
    complain: Complain,
    check_object: CheckObject,
) -> RecorderMap:
    """Read the table.

    Parameters
    ----------
    kind : str
        What the map states of the recorder (``capabilities.recorder``).
    dimensions : mapping of str to str
        Signals there are, with their dimension.
    sources : mapping of str to str
        ``[sources]`` of the map.
    """
    if not table:
        return RecorderMap()
    if kind not in _KEYS:
        complain((TABLE,), f"a recorder of kind {kind!r} takes no channels; those of kind {', '.join(_KEYS)} do")
        return RecorderMap()
    channels: dict[str, Channel] = {}
    taken: dict[tuple[int, int, int], str] = {}
    period = period_source = ""
    for name, row in table.items():

        def tell(key: str, what: str, name: str = name) -> None:
            complain((TABLE, name, key) if key else (TABLE, name), f"{name}: {what}")

        if name == PERIOD:
            period, period_source = _parse_period(row, kind, sources, tell)
            continue
        channel = _parse_channel(row, kind, dimensions.get(name, ""), sources, tell, check_object)
        if channel is None:
            continue
        place = (channel.number, channel.index, channel.sub)
        if name == UNSCALED and place in taken:
            continue  # recorded in volts
        if taken.get(place) == UNSCALED:
            del channels[UNSCALED]
        elif place in taken:
            tell("number" if channel.number else "index", f"is recorded as {taken[place]} already")
        taken[place] = name
        channels[name] = channel
    return RecorderMap(channels, period, period_source)


def _parse_period(row: Any, kind: str, sources: Mapping[str, str], tell: Callable[[str, str], None]) -> tuple[str, str]:
    if kind != "rings":
        tell("", f"a recorder of kind {kind!r} says its period itself")
    elif _usable(row, _PERIOD_KEYS, sources, tell) and _measures(row["unit"], "time", tell):
        return row["unit"], row.get("source", "")
    return "", ""


def _parse_channel(
    row: Any,
    kind: str,
    dimension: str,
    sources: Mapping[str, str],
    tell: Callable[[str, str], None],
    check_object: CheckObject,
) -> Channel | None:
    if not dimension:
        tell("", "no signal of that name that can be recorded")
        return None
    if kind == "rings":
        if not check_object(row, _KEYS[kind], tell) or not _measures(row["unit"], dimension, tell):
            return None
        if row["type"] not in RING_TYPES:
            tell("type", f"type {row['type']!r} is not one of {', '.join(RING_TYPES)}: a ring is read in words")
            return None
        return Channel(row["unit"], 0, row["index"], row["sub"], row["type"], row.get("source", ""))
    if not _usable(row, _KEYS[kind], sources, tell) or not _measures(row["unit"], dimension, tell):
        return None
    number = row.get("number")
    if type(number) is not int or not 0 < number <= LARGEST_NUMBER:
        tell("number", f"number must be a trace variable's, 1 .. {LARGEST_NUMBER}")
        return None
    return Channel(row["unit"], number, source=row.get("source", ""))


def _usable(row: Any, keys: tuple[str, ...], sources: Mapping[str, str], tell: Callable[[str, str], None]) -> bool:
    if not isinstance(row, dict):
        tell("", f"needs {keys[0]} and unit")
        return False
    for key in row:
        if key not in keys:
            tell(key, f"unknown key {key}")
    if "source" in row and (not isinstance(row["source"], str) or row["source"] not in sources):
        tell("source", f"source {row['source']!r} is not in [sources]")
    if not isinstance(row.get("unit"), str) or not row["unit"]:
        tell("unit", 'unit is missing: say what one count is worth, such as "0.01 A peak"')
        return False
    return True


def _measures(text: str, dimension: str, tell: Callable[[str, str], None]) -> bool:
    try:
        unit = wire_unit(text)
    except ValueError as error:
        tell("unit", f"unit {text!r}: {error}")
        return False
    if unit.dimension != dimension:
        tell("unit", f"unit {text!r}: {unit.dimension}, expected {dimension}")
    elif unit.relative_to:
        tell("unit", f"unit {text!r}: a record holds no 0x{unit.relative_to:04X} to relate it to")
    elif not unit.scale > 0.0:
        tell("unit", f"unit {text!r}: one count must be worth something")
    else:
        return True
    return False
