# SPDX-License-Identifier: MIT
"""Map files (``firmware-params/<family>/map.toml``): written, read back, and refused with file and line.

A wrong map writes a wrong number into a drive that moves a machine, so that everything that can be told from the file
alone is checked: the object may hold a parameter at all and only one, the type can hold the value's sign, the unit
is there, measures the right thing, and agrees with the factor.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, fields, replace
from typing import Any, get_args

from pmsmtool.drive_maps.drive_map import (
    LETTERS,
    SIGNALS,
    Capabilities,
    Cell,
    DriveMap,
    Form,
    Injecting,
    Rounding,
    SignalCell,
)
from pmsmtool.drive_maps.identity_rows import TABLE as IDENTITY
from pmsmtool.drive_maps.identity_rows import IdentityRows, dump_identity, parse_identity
from pmsmtool.drive_maps.motion_objects import TABLE as MOTION
from pmsmtool.drive_maps.motion_objects import dump_motion, parse_motion
from pmsmtool.drive_maps.recorder_map import TABLE as RECORDER
from pmsmtool.drive_maps.recorder_map import Recording, dump_recorder, parse_recorder
from pmsmtool.drive_maps.vendor_tuning import TABLE, VendorTuning, dump_vendor_tuning, parse_vendor_tuning
from pmsmtool.drive_maps.wire_units import as_peak, counted_in, wire_unit
from pmsmtool.errors import ConfigError, next_step
from pmsmtool.params.catalogue import BY_NAME, EVERY, Parameter
from pmsmtool.params.parameter_set import TABLE_NAMES
from pmsmtool.toml_file import line_of, parse_toml, refuse_schema, toml_text

NEXT_STEP = "firmware-params/README.md says what each key of a map means; the maps beside it are examples"

SCHEMA = "pmsmtool.drive-map/1"
FACTOR_AGREES = 1e-6
"""Relative difference up to which a factor and the unit's own value are the same number."""
COMMANDS = frozenset({0x6040, 0x6060, 0x6071, 0x607A, 0x60B1, 0x60B2, 0x60FF})
"""Objects whose writing moves the machine: never a parameter."""
POLE_PAIRS = "motor.pole_pairs"
_GAINS = {"torque constant": POLE_PAIRS, "current": "reference.K_t_nm_per_a"}
"""Other value of a form that needs always the same one."""
_HEAD = ("schema", "name", "vendor", "product", "more_products", "staging")
_TABLES = (IDENTITY, "capabilities", "objects", "signals", MOTION, RECORDER, "tables", "left_out", "sources", TABLE)
_CELL_KEYS = ("index", "sub", "type", "factor", "offset", "unit", "rounding", "form", "gain", "low", "high", "source")
_TEXT_KEYS = ("type", "unit", "form", "rounding", "gain", "source")
_SIGNAL_KEYS = ("index", "sub", "type", "unit", "source")
_FORM_UNIT: dict[str, str] = {"time": "s", "rate": "1/s", "relative": "1", "torque constant": "N m/A"}
_IN_AMPERES = {
    "N m s/rad": "A s/rad", "N m/rad": "A/rad", "N m/(rad s)": "A/(rad s)", "kg m2": "A s2/rad",
}  # fmt: skip
"""Units of gains whose output is a torque, as a drive keeps them that takes a current for it."""
_RECORDED = {name: dimension for name, dimension in SIGNALS.items() if not name.startswith("target_")}
_CHOICES = {"recorder": get_args(Recording), "injection": get_args(Injecting)}

Complain = Callable[[str, str], None]
"""Told the key of a row ("" for the row) and what is wrong with it."""


def map_hash(drive_map: DriveMap) -> str:
    """Return the content hash of a map: comments, order of the file and what only identifies drives do not count.

    Neither does what a drive lacks of it: the hash is that of the file.
    """
    whole = replace(drive_map.whole or drive_map, identity=IdentityRows())
    return hashlib.sha256(dump_drive_map(whole).encode("utf-8")).hexdigest()


# ---- writing ----------------------------------------------------------------------------------------


def dump_drive_map(drive_map: DriveMap) -> str:
    """Return the text of a map file, which :func:`parse_drive_map` reads back."""
    head: dict[str, Any] = {
        "schema": SCHEMA, "name": drive_map.name, "vendor": drive_map.vendor, "product": drive_map.product,
    }  # fmt: skip
    if drive_map.more_products:
        head["more_products"] = drive_map.more_products
    plain = asdict(Capabilities())
    capabilities = {key: value for key, value in asdict(drive_map.capabilities).items() if value != plain[key]}
    tuning, recorder = drive_map.vendor_tuning, dump_recorder(drive_map.recorder)
    identity = dump_identity(drive_map.identity)
    return toml_text(
        {
            **head,
            "staging": drive_map.staging,
            **({IDENTITY: identity} if identity else {}),
            "capabilities": capabilities,
            "objects": {name: _cell_row(cell) for name, cell in drive_map.cells.items()},
            "signals": {name: _signal_row(cell) for name, cell in drive_map.signals.items()},
            **({MOTION: dump_motion(drive_map.motion)} if drive_map.motion else {}),
            **({RECORDER: recorder} if recorder else {}),
            "tables": {name: {"index": index, "sub": sub} for name, (index, sub) in drive_map.tables.items()},
            **({} if tuning is None else {TABLE: dump_vendor_tuning(tuning, _cell_row)}),
            "left_out": dict(drive_map.left_out),
            "sources": dict(drive_map.sources),
        }
    )


def _cell_row(cell: Cell) -> dict[str, Any]:
    unit = cell.unit or f"{abs(cell.factor):.17g} {as_peak(_expected_unit(BY_NAME[cell.name], cell.form))}"
    row: dict[str, Any] = {"index": cell.index, "sub": cell.sub, "type": cell.wire, "unit": unit}
    row |= {"factor": cell.factor} if cell.factor != _unit_factor(cell) else {}
    row |= {"offset": cell.offset} if cell.offset else {}
    row |= {"rounding": cell.rounding} if cell.rounding != "nearest" else {}
    row |= {"form": cell.form} if cell.form != "value" else {}
    row |= {"gain": cell.gain} if cell.gain else {}
    row |= {key: limit for key, limit in (("low", cell.low), ("high", cell.high)) if math.isfinite(limit)}
    return row | ({"source": cell.source} if cell.source else {})


def _signal_row(cell: SignalCell) -> dict[str, Any]:
    row = {"index": cell.index, "sub": cell.sub, "type": cell.wire, "unit": cell.unit}
    return row | ({"source": cell.source} if cell.source else {})


def _unit_factor(cell: Cell) -> float | None:
    try:
        return counted_in(cell.unit, _expected_unit(BY_NAME[cell.name], cell.form))
    except ValueError:
        return None


def _expected_unit(parameter: Parameter, form: str) -> str:
    if form == "current":
        return _IN_AMPERES.get(parameter.unit, parameter.unit)
    return _FORM_UNIT.get(form, parameter.unit)


# ---- reading ----------------------------------------------------------------------------------------


@next_step(NEXT_STEP)
def parse_drive_map(text: str, where: str = "map.toml") -> DriveMap:
    """Read a map file. Raises ConfigError: everything that is wrong with it, at once, each with its line."""
    document = parse_toml(text, where=where)
    refuse_schema(document.get("schema"), SCHEMA, where=where)
    wrong: list[str] = []

    def complain(path: tuple[str, ...], what: str) -> None:
        wrong.append(f"{where}:{line_of(text, path)}: {what}")

    _check_head(document, complain)
    found = _parse_tables(document, complain)
    if wrong:
        raise ConfigError("the drive map cannot be used", where=where, violations=wrong)
    return DriveMap(
        name=document["name"],
        vendor=document["vendor"],
        product=document["product"],
        more_products=tuple(document.get("more_products", ())),
        staging=bool(document.get("staging", False)),
        **found,
    )


def _check_head(document: Mapping[str, Any], complain: Callable[[tuple[str, ...], str], None]) -> None:
    for key in document:
        if key not in (*_HEAD, *_TABLES):
            complain((key,), f"{key}: unknown key")
    if not isinstance(document.get("name"), str) or not document["name"]:
        complain(("name",), "name: the family's name is missing")
    for key in ("vendor", "product"):
        if not _is_word(document.get(key)):
            complain((key,), f"{key}: not a whole number (0 .. 0xFFFFFFFF)")
    more = document.get("more_products", [])
    if not isinstance(more, list) or not all(map(_is_word, more)):
        complain(("more_products",), "more_products: not a list of whole numbers")
    for key in _TABLES:
        if not isinstance(document.get(key, {}), dict):
            complain((key,), f"{key}: not a table")


def _parse_tables(document: Mapping[str, Any], complain: Callable[[tuple[str, ...], str], None]) -> dict[str, Any]:
    def table(key: str) -> dict[str, Any]:
        found = document.get(key, {})
        return found if isinstance(found, dict) else {}

    def about(*path: str) -> Complain:
        return lambda key, what: complain((*path, key) if key else path, f"{path[-1]}: {what}")

    sources = {key: text for key, text in table("sources").items() if isinstance(text, str)}
    cells: dict[str, Cell] = {}
    taken: dict[tuple[int, int], str] = {}
    for name, row in table("objects").items():
        cell = _parse_cell(name, row, sources, about("objects", name))
        if cell is None:
            continue
        if (cell.index, cell.sub) in taken:
            other = taken[cell.index, cell.sub]
            about("objects", name)("index", f"0x{cell.index:04X}:{cell.sub:02X} is already {other}")
        taken[cell.index, cell.sub] = name
        cells[name] = cell
    for name, cell in cells.items():
        if cell.gain and cell.gain not in table("objects") and cell.form != "current":
            about("objects", name)("gain", f"its form needs {cell.gain}, which this map does not hold")
    live = table("signals").items()
    capabilities = _parse_capabilities(table("capabilities"), complain)

    def check_object(row: Any, keys: tuple[str, ...], tell: Complain) -> bool:
        return _check_row(row, keys, sources, tell)

    def check_motion(row: Any, keys: tuple[str, ...], tell: Complain) -> bool:
        return _check_row(row, keys, sources, tell, commands=True)

    signals = {name: _parse_signal(name, row, sources, about("signals", name)) for name, row in live}
    return {
        "cells": {row.name: cells[row.name] for row in EVERY if row.name in cells},
        "tables": {name: _parse_table(name, row, about("tables", name)) for name, row in table("tables").items()},
        "capabilities": capabilities,
        "signals": {name: signal for name, signal in signals.items() if signal is not None},
        "motion": parse_motion(table(MOTION), sources, complain, check_motion),
        "recorder": parse_recorder(table(RECORDER), capabilities.recorder, _RECORDED, sources, complain, check_object),
        "left_out": _parse_left_out(table("left_out"), cells, complain),
        "sources": sources,
        TABLE: _parse_tuning(document.get(TABLE), cells, sources, complain),
        IDENTITY: parse_identity(table(IDENTITY), sources, complain),
    }


def _parse_tuning(
    table: Any,
    cells: Mapping[str, Cell],
    sources: Mapping[str, str],
    complain: Callable[[tuple[str, ...], str], None],
) -> VendorTuning | None:
    if not isinstance(table, dict):
        return None

    def row_of(name: str, row: Any, path: tuple[str, ...]) -> Cell | None:
        def tell(key: str, what: str) -> None:
            complain((*path, key) if key else path, f"{path[-1]}: {what}")

        return _parse_cell(name, row, sources, tell, anywhere=True)

    return parse_vendor_tuning(table, cells, sources, complain, row_of)


def _parse_cell(
    name: str, row: Any, sources: Mapping[str, str], complain: Complain, *, anywhere: bool = False
) -> Cell | None:
    said: list[str] = []

    def tell(key: str, what: str) -> None:
        said.append(what)
        complain(key, what)

    if name not in BY_NAME:
        tell("", "not in the parameter catalogue")
    if not _check_row(row, _CELL_KEYS, sources, tell, anywhere=anywhere):
        return None
    form = row.get("form", "time" if "gain" in row else "value")
    if form not in get_args(Form):
        tell("form", f"form {form!r} is not one of {', '.join(get_args(Form))}")
    if row.get("rounding", "nearest") not in get_args(Rounding):
        tell("rounding", f"rounding {row['rounding']!r} is not one of {', '.join(get_args(Rounding))}")
    elif row["type"] == "REAL32" and row.get("rounding", "nearest") != "nearest":
        tell("rounding", "a REAL32 is not rounded to counts")
    gain = row.get("gain", _GAINS.get(form, ""))
    if gain and gain not in BY_NAME:
        tell("gain", f"gain {gain!r} is not in the parameter catalogue")
    if form in ("time", "rate", "relative") and not gain:
        tell("form", f"form {form!r} needs the gain it is relative to")
    if said:
        return None
    parameter = BY_NAME[name]
    factor = _factor(row, _expected_unit(parameter, form), parameter, tell)
    offset = row.get("offset", 0.0)
    if not _is_number(offset):
        tell("offset", "offset must be a finite number")
    limits = {key: row[key] for key in ("low", "high") if key in row}
    for key in (key for key, limit in limits.items() if not _is_number(limit)):
        tell(key, f"{key} must be a finite number of counts")
    if said:
        return None
    if row["type"].startswith("UNSIGNED") and parameter.minimum < 0.0 <= min(offset, offset + factor):
        tell("type", f"{row['type']} cannot hold the negative values of this parameter")
        return None
    return Cell(
        name, row["index"], row["sub"], row["type"], factor, float(offset), row.get("rounding", "nearest"), gain,
        row["unit"], form, row.get("source", ""), **limits,
    )  # fmt: skip


def _factor(row: Mapping[str, Any], expected: str, parameter: Parameter, tell: Complain) -> float:
    """Return the SI value of one count: what the unit says, and the factor if there is one must say the same."""
    try:
        own = counted_in(row["unit"], expected)
    except ValueError as error:
        tell("unit", f"unit {row['unit']!r}: {error}")
        return 1.0
    given = row.get("factor", own)
    if not _is_number(given) or given == 0:
        tell("factor", "factor must be a finite number and not zero")
    elif given < 0 and parameter.minimum >= 0:
        tell("factor", f"factor {given:g} is negative, and a negative {parameter.name} has no meaning")
    elif not math.isclose(abs(given), own, rel_tol=FACTOR_AGREES):
        tell("factor", f"factor {given:g} contradicts the unit {row['unit']!r}, which makes it {own:g} {expected}")
    else:
        return float(given)
    return 1.0


def _parse_signal(name: str, row: Any, sources: Mapping[str, str], complain: Complain) -> SignalCell | None:
    if name not in SIGNALS:
        complain("", f"no signal of that name; there are {', '.join(SIGNALS)}")
        return None
    if not _check_row(row, _SIGNAL_KEYS, sources, complain, commands=True):
        return None
    try:
        unit = wire_unit(row["unit"])
    except ValueError as error:
        complain("unit", f"unit {row['unit']!r}: {error}")
        return None
    if unit.dimension != SIGNALS[name]:
        complain("unit", f"unit {row['unit']!r}: {unit.dimension}, expected {SIGNALS[name]}")
        return None
    return SignalCell(row["index"], row["sub"], row["type"], row["unit"], row.get("source", ""))


def _check_row(
    row: Any,
    keys: tuple[str, ...],
    sources: Mapping[str, str],
    tell: Complain,
    *,
    commands: bool = False,
    anywhere: bool = False,
) -> bool:
    """Address, type, unit, source and unknown keys of an object; returns whether the row can be used further."""
    if not isinstance(row, dict) or not _is_address(row):
        tell("index", "needs index (0x2000 .. 0x9FFF) and sub (0 .. 0xFE)")
        return False
    for key in row:
        if key not in keys:
            tell(key, f"unknown key {key}")
    index = row["index"]
    if not anywhere and not 0x2000 <= index <= 0x9FFF:
        tell("index", f"index 0x{index:04X} is outside 0x2000 .. 0x9FFF, where devices keep their parameters")
    elif index in COMMANDS and not commands:
        tell("index", f"index 0x{index:04X} is a command that moves the machine, not a parameter")
    no_text = [key for key in _TEXT_KEYS if key in row and not isinstance(row[key], str)]
    for key in no_text:
        tell(key, f"{key} must be text")
    if no_text:
        return False
    usable = True
    if row.get("type") not in LETTERS:
        tell("type", f"type {row.get('type')!r} is not one of {', '.join(LETTERS)}")
        usable = False
    if not isinstance(row.get("unit"), str) or not row["unit"]:
        tell("unit", 'unit is missing: say what one count is worth, such as "uV/A" or "mA rms"')
        usable = False
    if "source" in row and row["source"] not in sources:
        tell("source", f"source {row['source']!r} is not in [sources]")
    return usable


def _parse_table(name: str, row: Any, complain: Complain) -> tuple[int, int]:
    if name not in TABLE_NAMES or not isinstance(row, dict) or not _is_address(row):
        complain("", "unknown table, or without index and sub")
        return (0, 0)
    return row["index"], row["sub"]


def _parse_capabilities(table: Mapping[str, Any], complain: Callable[[tuple[str, ...], str], None]) -> Capabilities:
    kinds = {item.name: bool if item.default is None else type(item.default) for item in fields(Capabilities)}
    good: dict[str, Any] = {}
    for key, value in table.items():
        if key not in kinds:
            complain(("capabilities", key), f"unknown capability {key}; there are {', '.join(kinds)}")
        elif type(value) is not kinds[key] or value not in _CHOICES.get(key, (value,)):
            expected = ", ".join(_CHOICES[key]) if key in _CHOICES else "a " + kinds[key].__name__
            complain(("capabilities", key), f"{key} = {value!r}: expected {expected}")
        else:
            good[key] = value
    return Capabilities(**good)


def _parse_left_out(
    table: Mapping[str, Any], cells: Mapping[str, Cell], complain: Callable[[tuple[str, ...], str], None]
) -> dict[str, str]:
    good = {}
    for name, why in table.items():
        if name not in BY_NAME and name not in SIGNALS:
            complain(("left_out", name), f"{name}: neither a parameter nor a signal")
        elif not isinstance(why, str) or not why:
            complain(("left_out", name), f"{name}: say why it is left out")
        elif name in cells:
            complain(("left_out", name), f"{name}: left out, and mapped all the same")
        else:
            good[name] = why
    return good


def _is_address(row: Mapping[str, Any]) -> bool:
    index, sub = row.get("index"), row.get("sub")
    return type(index) is int and type(sub) is int and 0 <= index <= 0xFFFF and 0 <= sub <= 0xFE


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)


def _is_word(value: Any) -> bool:
    return type(value) is int and 0 <= value <= 0xFFFFFFFF
