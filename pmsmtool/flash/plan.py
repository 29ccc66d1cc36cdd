# SPDX-License-Identifier: MIT
"""What a download would change: old bytes, new bytes, and what the drive will really hold.

Pure: bytes read from a drive go in, a plan comes out; nothing here speaks to a bus.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from pmsmtool.cia402 import HOMING_LOST
from pmsmtool.drive_maps.drive_map import DriveMap, address_in
from pmsmtool.errors import ConfigError
from pmsmtool.params.catalogue import BY_NAME, INCREMENTS, MIDDLE_KIND, TORQUE_PER_AMPERE
from pmsmtool.params.parameter_set import ASSUMED, ParameterSet, table_unit

QUANTISATION_SHOWN = 1e-6
"""Relative rounding from which the value the drive holds is shown beside the one asked for (binary32: 6e-8)."""

KIND_LEAST = 0.72
"""Smallest ratio of a drive's torque per ampere to the middle of peak and rms (0.84 and 1.19 of it), with 15 % for the
difference of a data sheet to the machine that was measured."""


@dataclass(frozen=True, slots=True)
class Change:
    """One object of a plan."""

    name: str
    """Catalogue or table name."""
    index: int
    sub: int
    """The object."""
    old: bytes
    new: bytes
    """Contents before and after; equal bytes are not written."""
    old_value: float = math.nan
    wanted: float = math.nan
    held: float = math.nan
    """Value on the drive, value asked for, value the drive will hold (SI); NaN for tables, and where nobody says what
    the drive's own scale is."""
    unit: str = ""
    """Of the values."""

    @property
    def changes(self) -> bool:
        """Whether the object must be written."""
        return self.old != self.new

    @property
    def quantised(self) -> bool:
        """Whether the drive will visibly hold another value than the one asked for."""
        return abs(self.held - self.wanted) > QUANTISATION_SHOWN * abs(self.wanted)

    @property
    def relative(self) -> float:
        """Relative change, NaN where it has no meaning."""
        return self.held / self.old_value - 1.0 if self.old_value else math.nan

    @property
    def where(self) -> str:
        """The object as people write it."""
        return f"0x{self.index:04X}:{self.sub:02X}"


@dataclass(frozen=True, slots=True)
class Plan:
    """All objects of a set, those that already hold their value included."""

    entries: tuple[Change, ...]
    """In writing order."""
    not_written: Mapping[str, str] = field(default_factory=dict)
    """Entries of the set that the drive's map has no object for, and why."""
    content: str = ""
    """Content hash of the set."""
    reasons: Mapping[str, str] = field(default_factory=dict)
    """What the drive's map leaves out by name: these entries are told one by one."""
    kept: tuple[str, ...] = ()
    """Entries whose object is there and stays as it is."""

    @property
    def missing(self) -> tuple[str, ...]:
        """Entries of the set that the drive has no object for."""
        return tuple(self.not_written)

    @property
    def changes(self) -> tuple[Change, ...]:
        """Entries that must be written."""
        return tuple(entry for entry in self.entries if entry.changes)

    def lines(self, marks: Mapping[str, str] | None = None) -> list[str]:
        """Return the difference list a person consents to.

        ``marks``: what to say behind an entry, by its name.
        """
        rows = [_row(change, (marks or {}).get(change.name, "")) for change in self.changes]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = [
            f"{r[0]:<{widths[0]}}  {r[1]:>{widths[1]}} -> {r[2]:>{widths[2]}} {r[3]:<{widths[3]}}  {r[4]}".rstrip()
            for r in rows
        ]
        equal = len(self.entries) - len(rows)
        held = "1 holds its value" if equal == 1 else f"{equal} hold their value"
        lines.append(f"{len(rows)} of {len(self.entries)} objects change, {held} already")
        return [*lines, *self.left_out()]

    def after_lines(self, *, store: bool) -> list[str]:
        """Return what follows once the set is written: storing and reset, and homing where either takes it."""
        if store:
            return [f"the set is stored, and the drive is reset to see it: {HOMING_LOST}"]
        encoder = any(change.name.startswith("encoder.") for change in self.changes)
        return ["not stored", *([f"the encoder's parameters change: {HOMING_LOST}"] if encoder else [])]

    def facts(self) -> dict[str, Any]:
        """Return the plan for scripts."""
        changes = [
            {
                "name": change.name, "object": change.where, "old": change.old_value, "wanted": change.wanted,
                "held": change.held, "unit": change.unit, "old_bytes": change.old.hex(), "new_bytes": change.new.hex(),
            }
            for change in self.changes
        ]  # fmt: skip
        equal = len(self.entries) - len(changes)
        said = {"missing": self.missing, "not_written": self.not_written}
        return {"content": self.content, "changes": changes, "equal": equal, **said}

    def left_out(self) -> list[str]:
        """Return what of the set is not written: by name where the map states why, the rest as a number."""
        named = [name for name in self.missing if name in self.reasons]
        lines = [f"not written: {name}: {self.reasons[name]}" for name in named]
        others = len(self.missing) - len(named)
        if others:
            lines.append(f"not written: {others} entries of the set that the drive's map has no object for")
        return lines


def make_plan(drive_map: DriveMap, wanted: ParameterSet, found: Mapping[str, bytes]) -> Plan:
    """Return the plan that brings a drive from what it holds to a set.

    Raises ConfigError: values out of bounds, or that do not fit the drive's types; all of them.

    Parameters
    ----------
    found : mapping of str to bytes
        What the drive holds now, for every name of :func:`names_to_read`.
    """
    violations = wanted.violations()
    if violations:
        raise ConfigError(
            "the parameter set cannot be written",
            where=wanted.name,
            hint="`pmsmtool param help NAME` shows the bounds of a parameter",
            violations=violations,
        )
    wanted, given = _with_own_torque(drive_map, wanted, found)
    wanted, own = _with_own_increments(drive_map, wanted, found)
    given |= own
    wanted, kept = without_assumed(drive_map, wanted)
    encoded = drive_map.encode(wanted)
    held = drive_map.decode(encoded, given).values
    before = drive_map.decode({name: data for name, data in found.items() if name in drive_map.cells}, given).values
    entries = []
    for name, new in encoded.items():
        index, sub = drive_map.address(name)
        scalar = name in drive_map.cells
        values = (before.get(name, math.nan), wanted.values[name], held[name]) if scalar else (math.nan,) * 3
        unit = BY_NAME[name].unit if scalar else table_unit(name)
        entries.append(Change(name, index, sub, found[name], new, *values, unit))
    lacking = drive_map.not_written([*wanted.values, *wanted.tables])
    lacking = {name: why for name, why in lacking.items() if name not in given} | kept
    stay = {name: why for name, why in lacking.items() if name in drive_map.cells}
    return Plan(tuple(entries), lacking, wanted.content_hash(), {**drive_map.left_out, **stay}, tuple(stay))


def without_assumed(drive_map: DriveMap, wanted: ParameterSet) -> tuple[ParameterSet, dict[str, str]]:
    """Return the set without what another maker's drive keeps, and why: nobody stated it, and it may lift a limit."""
    rows = () if drive_map.staging else drive_map.cells
    kept = {
        name: f"{value:g} {BY_NAME[name].unit} is assumed, the machine file states no {name.partition('.')[2]}: the "
        "drive keeps its own"
        for name, value in wanted.values.items()
        if name in rows and wanted.provenance.get(name) == ASSUMED
    }
    return replace(wanted, values={name: v for name, v in wanted.values.items() if name not in kept}), kept


def _with_own_torque(
    drive_map: DriveMap, wanted: ParameterSet, found: Mapping[str, bytes]
) -> tuple[ParameterSet, dict[str, float]]:
    """Return the set with the torque per ampere that the drive itself holds, where gains are counted by it.

    Raises ConfigError: it is neither that of an ampere peak nor rms of the machine that was designed for.
    """
    expected = wanted.values.get(TORQUE_PER_AMPERE)
    if expected is None:
        return wanted, {}
    cell = drive_map.cells.get(TORQUE_PER_AMPERE)
    if cell is None:
        return wanted, {TORQUE_PER_AMPERE: expected}
    own = cell.decode(found[TORQUE_PER_AMPERE], {})
    if not KIND_LEAST < own / expected < 1.0 / KIND_LEAST:
        raise ConfigError(
            f"the drive holds {own:.4g} N m/A, the machine has {expected / MIDDLE_KIND:.4g} per ampere peak and "
            f"{expected * MIDDLE_KIND:.4g} per ampere rms",
            where=f"{TORQUE_PER_AMPERE} -> 0x{cell.index:04X}:{cell.sub:02X}",
            likely="the drive is set up for another motor: its gains in amperes would give another torque",
            hint="enter the motor's torque constant with the maker's software, or correct psi_f_wb in the machine file",
        )  # fmt: skip
    values = {**wanted.values, TORQUE_PER_AMPERE: own}
    return replace(wanted, values=values), {TORQUE_PER_AMPERE: own}


def _with_own_increments(
    drive_map: DriveMap, wanted: ParameterSet, found: Mapping[str, bytes]
) -> tuple[ParameterSet, dict[str, float]]:
    """Return the set with the increments of a turn that the drive itself holds, where gains are counted by them.

    Raises ConfigError: it holds none.
    """
    cell = drive_map.cells.get(INCREMENTS)
    if cell is None or INCREMENTS not in wanted.values:
        return wanted, {}
    own = cell.decode(found[INCREMENTS], {})
    if not own > 0.0:
        raise ConfigError(
            "the drive holds no increments of a turn, and its position gain is counted by them",
            where=f"{INCREMENTS} -> 0x{cell.index:04X}:{cell.sub:02X}", likely="its encoder is not set up",
            hint="set the encoder up with the maker's software",
        )  # fmt: skip
    return replace(wanted, values={**wanted.values, INCREMENTS: own}), {INCREMENTS: own}


def names_to_read(drive_map: DriveMap, wanted: ParameterSet) -> tuple[str, ...]:
    """Return the entries whose present content a plan needs: the set's own, and gains that scale others."""
    names = [name for name in [*wanted.values, *wanted.tables] if name in drive_map.cells or name in drive_map.tables]
    gains = [drive_map.cells[n].gain for n in names if n in drive_map.cells and drive_map.cells[n].gain]
    return tuple(dict.fromkeys([*names, *(gain for gain in gains if gain in drive_map.cells)]))


def differences(entries: Sequence[Change], found: Mapping[str, bytes]) -> list[str]:
    """Return one line per entry whose content is not the planned one."""
    lines = []
    for entry in entries:
        data = found.get(entry.name, b"")
        if data != entry.new:
            lines.append(f"{entry.name} ({entry.where}): wrote {_hex(entry.new)}, reads {_hex(data)}")
    return lines


def _hex(data: bytes) -> str:
    return data.hex(" ") if len(data) <= 8 else f"{data[:4].hex(' ')} .. ({len(data)} bytes)"


def _row(change: Change, mark: str = "") -> tuple[str, str, str, str, str]:
    if math.isnan(change.wanted) and (change.name in BY_NAME or address_in(change.name) is not None):
        return change.name, _number(change.old), _number(change.new), "", mark
    if math.isnan(change.wanted):
        return change.name, f"{len(change.old)} B", f"{len(change.new)} B", "", f"{_cells(change)}  {mark}".strip()
    relative = "" if math.isnan(change.relative) else f"{100.0 * change.relative:+.3g} %"
    held = f"(asked for {change.wanted:.9g})" if change.quantised else ""
    unit = "" if change.unit == "1" else change.unit
    return change.name, f"{change.old_value:.7g}", f"{change.held:.7g}", unit, f"{relative}  {held}  {mark}".strip()


def _number(data: bytes) -> str:
    """Return an object's bytes as the number they are on the wire; whether it has a sign the bytes do not say."""
    if not data:
        return "none"
    return f"0x{data[::-1].hex().upper()}" if len(data) <= 8 else f"{len(data)} B"


def _cells(change: Change) -> str:
    words = range(0, max(len(change.old), len(change.new)), 4)
    different = sum(change.old[k : k + 4] != change.new[k : k + 4] for k in words)
    return f"{different} of {len(words)} words differ"
