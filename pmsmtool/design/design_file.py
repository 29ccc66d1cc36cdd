# SPDX-License-Identifier: MIT
"""The design as a value, and its text ``design.toml``: machine embedded, every number with unit, method and margin."""

from __future__ import annotations

import contextlib
import hashlib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from pmsmtool.design.loops.sampled_loop import LoopMargins
from pmsmtool.errors import ConfigError, next_step
from pmsmtool.files import read_text
from pmsmtool.machine.key import Key, check_table, did_you_mean
from pmsmtool.machine.machine_file import (
    MachineFile,
    load_machine_file,
    machine_from_tables,
    machine_path,
    machine_tables,
    no_design,
)
from pmsmtool.params.catalogue import BY_NAME, CATALOGUE, EVERY
from pmsmtool.params.parameter_set import TABLE_NAMES, ParameterSet
from pmsmtool.plain_text import Summarised, Summary
from pmsmtool.toml_file import parse_toml, refuse_schema, toml_lines, toml_text

NEXT_STEP = "make the design again: `pmsmtool tune MACHINE -o design.toml`"

SCHEMA = "pmsmtool.design/1"

Scalar = str | bool | int | float


@dataclass(frozen=True, slots=True)
class DesignValue:
    """One number of a design."""

    value: float
    """In the catalogue's unit."""
    method: str
    """How it was found, one line."""
    loop: str = ""
    """Loop whose margins it decides (a key of ``Design.loops``); empty for none."""


@dataclass(frozen=True, slots=True, repr=False)
class Design(Summarised):
    """A complete set of drive parameters with their reasons."""

    machine: MachineFile
    """What it was designed for."""
    request: Mapping[str, Scalar]
    """What was asked (``tune.TuneRequest``)."""
    values: Mapping[str, DesignValue]
    """Catalogue name -> number; every row of the catalogue."""
    loops: Mapping[str, LoopMargins] = field(default_factory=dict)
    """Achieved margins: ``current_d``, ``current_q``, ``speed`` and variants."""
    facts: Mapping[str, Scalar] = field(default_factory=dict)
    """Other results worth keeping, unit in the name."""
    notes: tuple[str, ...] = ()
    """What a person must know: assumptions and fall-backs."""
    tables: Mapping[str, Sequence[float]] = field(default_factory=dict)
    """Look-up axes and tables (``params.parameter_set.TABLE_NAMES``); empty without one."""

    def __getitem__(self, name: str) -> float:
        """Return one value by catalogue name; raises ``KeyError`` with the nearest names where there is none."""
        if name not in self.values:
            raise KeyError(f"a design has no {name!r}{did_you_mean(name, list(self.values))}")
        return self.values[name].value

    def summary(self) -> Summary:
        """Return the gains, and what their loops achieve."""
        gains = [(name, f"{v.value:.6g}", BY_NAME[name].unit, v.method) for name, v in self.values.items() if v.loop]
        head = f"design of {self.name}: {len(self.values)} values, of which"
        loops = [f"{k}: {achieved(x)}" for k, x in self.loops.items()]
        return Summary(head, ("gain", "value", "unit", "method"), gains, [*loops, *self.notes])

    @property
    def name(self) -> str:
        """Name of the machine."""
        return self.machine.name

    def parameter_set(self) -> ParameterSet:
        """Return what ``flash-params`` sends: all values and tables, their methods as provenance."""
        provenance = {name: value.method for name, value in self.values.items()}
        provenance["machine"] = f"sha256:{self.machine.content_hash()}"
        return ParameterSet({name: v.value for name, v in self.values.items()}, self.tables, provenance, self.name)

    def content_hash(self) -> str:
        """Return ``sha256:<hex>`` over the design's text."""
        return "sha256:" + hashlib.sha256(design_text(self).encode()).hexdigest()


def design_text(design: Design) -> str:
    """Return ``design.toml``: same machine and request, same bytes."""
    tables: dict[str, Any] = {
        "schema": SCHEMA,
        "machine_sha256": design.machine.content_hash(),
        "notes": list(design.notes),
        "request": dict(design.request),
        "facts": dict(design.facts),
        "loop": {name: asdict(loop) for name, loop in design.loops.items()},
    }
    groups: dict[str, dict[str, Any]] = {}
    for row in EVERY:
        if row.name in design.values:
            group, key = row.name.split(".", 1)
            groups.setdefault(group, {})[key] = _value_table(design, row.name)
    tables["value"] = groups
    if design.tables:
        tables["table"] = {name: list(design.tables[name]) for name in TABLE_NAMES if name in design.tables}
    tables["machine_file"] = machine_tables(design.machine, embed_flux_map=True)
    return toml_text({name: table for name, table in tables.items() if table not in ({}, [])}, comment=_COMMENT)


_COMMENT = """Design of one drive, written by `pmsmtool tune`. The machine it is for is embedded; params.toml beside it
holds the same values in the form that is sent to the drive."""


def _value_table(design: Design, name: str) -> dict[str, Scalar]:
    entry, row = design.values[name], BY_NAME[name]
    table: dict[str, Scalar] = {
        "value": int(entry.value) if row.is_integer else float(entry.value),
        "unit": row.unit,
        "method": entry.method,
    }
    if entry.loop:
        table["loop"] = entry.loop
        table["achieved"] = achieved(design.loops[entry.loop])
    return table


def achieved(loop: LoopMargins) -> str:
    """Return the margins of a loop as one line."""
    if not loop.stable:
        return "unstable"
    gain = "no gain limit" if math.isinf(loop.gain_margin) else f"gain margin {loop.gain_margin_db:.1f} dB"
    phase = "no crossover" if math.isinf(loop.phase_margin_deg) else f"phase margin {loop.phase_margin_deg:.1f} deg"
    return f"{phase}, {gain}, bandwidth {loop.bandwidth_rad_s / (2.0 * math.pi):.4g} Hz"


@next_step(NEXT_STEP)
def load_design(path: str | Path) -> Design:
    """Read ``design.toml``; raises ``ConfigError`` naming the file and everything that is wrong."""
    path = Path(path)
    return parse_design(read_text(path, hint="`pmsmtool tune MACHINE -o design.toml`"), where=str(path))


@next_step(NEXT_STEP)
def load_machine_or_design(source: str | Path | Design | MachineFile) -> tuple[MachineFile, Design | None]:
    """Return a machine, and its design where the source is one.

    Raises ConfigError: there is no such thing, or what is wrong with it.

    Parameters
    ----------
    source : str, Path, Design or MachineFile
        File, told apart by its schema, run directory, of which the design comes first, or profile name; or what such a
        file holds.
    """
    if isinstance(source, Design):
        return source.machine, source
    if isinstance(source, MachineFile):
        return source, None
    path = Path(source) / "design.toml"
    if not path.is_file():
        path = machine_path(source)
    text = ""
    with contextlib.suppress(ConfigError):  # the reader below says what is wrong
        text = read_text(path)
    if re.search(rf'^schema\s*=\s*"{re.escape(SCHEMA)}"', text, re.MULTILINE):
        design = load_design(path)
        return design.machine, design
    return load_machine_file(path), None


@next_step(NEXT_STEP)
def parse_design(text: str, *, where: str = "design.toml") -> Design:
    """Read the text of a design.

    Raises ConfigError: not TOML, another schema, unknown or missing values, or a machine that was changed after the
    design.
    """
    tables = parse_toml(text, where=where)
    schema = tables.get("schema")
    refuse_schema(schema, SCHEMA, where=where, **no_design(schema, where, "give a design as `tune` writes it"))
    machine_part = tables.get("machine_file")
    if not isinstance(machine_part, dict):
        raise ConfigError("the table [machine_file] is missing", where=where)
    machine = machine_from_tables(machine_part, where=where, lines=toml_lines(text), path=("machine_file",))
    if tables.get("machine_sha256") != machine.content_hash():
        raise ConfigError(
            "the embedded machine is not the one that was designed for",
            where=f"{where}:machine_sha256",
            likely="[machine_file] was edited after the design",
            hint="run `pmsmtool tune` on the changed machine",
        )
    values, wrong = _read_values(tables.get("value"))
    if not wrong:
        found = ParameterSet({name: entry.value for name, entry in values.items()})
        wrong += [f"{where}: {line}" for line in found.bound_violations()]
    loops, wrong_loops = _read_loops(tables.get("loop", {}), where)
    wrong += wrong_loops
    wrong += _odd_tables(tables, where)
    lost = {name: v.loop for name, v in values.items() if v.loop not in {"", *loops}}
    wrong += [f"{name}: names the loop {loop}, which is not there" for name, loop in lost.items()]
    if wrong:
        raise ConfigError("the design cannot be used", where=where, violations=wrong)
    return Design(
        machine=machine,
        request=tables.get("request", {}),
        values=values,
        loops=loops,
        facts=tables.get("facts", {}),
        notes=tuple(tables.get("notes", ())),
        tables={name: tuple(map(float, array)) for name, array in tables.get("table", {}).items()},
    )


def _read_values(table: Any) -> tuple[dict[str, DesignValue], list[str]]:
    values: dict[str, DesignValue] = {}
    wrong: list[str] = []
    for group, entries in (table if isinstance(table, dict) else {}).items():
        for key, entry in (entries if isinstance(entries, dict) else {}).items():
            name = f"{group}.{key}"
            row = BY_NAME.get(name)
            number = entry.get("value") if isinstance(entry, dict) else None
            if row is None:
                wrong.append(f"{name}: unknown{did_you_mean(name, tuple(BY_NAME))}")
            elif not isinstance(number, (int, float)) or isinstance(number, bool):
                wrong.append(f"{name}: its value is not a number")
            elif entry.get("unit") != row.unit:
                wrong.append(f"{name}: its unit is {entry.get('unit')!r}, the catalogue has {row.unit!r}")
            else:
                values[name] = DesignValue(float(number), str(entry.get("method", "")), str(entry.get("loop", "")))
    wrong += [f"{row.name}: is missing" for row in CATALOGUE if row.name not in values and not wrong]
    ordered = {row.name: values[row.name] for row in EVERY if row.name in values}
    return ordered, wrong


def _odd_tables(tables: Mapping[str, Any], where: str) -> list[str]:
    """Return what is wrong with the parts that are only carried along."""
    parts = ("request", "facts", "table")
    wrong = [f"[{name}] is not a table" for name in parts if not isinstance(tables.get(name, {}), dict)]
    notes = tables.get("notes", [])
    if not isinstance(notes, list) or not all(isinstance(note, str) for note in notes):
        wrong.append("notes is not a list of texts")
    if not wrong:
        from pmsmtool.design.tune_request import request_violations  # it needs this module

        wrong += request_violations(tables.get("request", {}), where)
        facts = {name: fact for name, fact in tables.get("facts", {}).items() if not isinstance(fact, str | bool)}
        check_table(facts, [replace(_FACT, name=name) for name in facts], _places(where, "facts", facts), wrong, {})
        arrays = tables.get("table", {})
        wrong += [
            f"table.{name} is not an array of numbers"
            for name, array in arrays.items()
            if not (isinstance(array, list) and all(type(value) in (int, float) for value in array))
        ]
    return wrong


_FACT = Key("facts", "", "float", "", -1e30, 1e30, None, "a result of the design")


def _besides(name: str) -> tuple[float, ...]:
    """Without a crossing a margin is infinite and the place of the crossing NaN (``LoopMargins``)."""
    return (math.inf, math.nan) if name.endswith("crossover_rad_s") else (math.inf,)


_LOOP_KEYS: tuple[Key, ...] = (
    Key("loop", "stable", "bool", "", 0, 1, None, "whether the loop is stable", required=True),
    *(
        Key("loop", item.name, "float", "", -1e12, 1e12, None, "a margin", required=True, besides=_besides(item.name))
        for item in fields(LoopMargins)
        if item.name != "stable"
    ),
)


def _places(where: str, table: str, found: Mapping[str, Any]) -> dict[str, str]:
    return {"": f"{where}: [{table}]", **{name: f"{where}: [{table}] {name}" for name in found}}


def _read_loops(table: Any, where: str) -> tuple[dict[str, LoopMargins], list[str]]:
    loops: dict[str, LoopMargins] = {}
    wrong: list[str] = []
    for name, entry in (table if isinstance(table, dict) else {}).items():
        if not isinstance(entry, dict):
            wrong.append(f"{where}: [loop.{name}] is not a table")
            continue
        before = len(wrong)
        values: dict[str, Any] = dict(check_table(entry, _LOOP_KEYS, _places(where, f"loop.{name}", entry), wrong, {}))
        if len(wrong) == before:
            loops[name] = LoopMargins(**values)
    return loops, wrong
