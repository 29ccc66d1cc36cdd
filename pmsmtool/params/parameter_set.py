# SPDX-License-Identifier: MIT
"""ParameterSet: catalogue names with SI values, where each came from, and the text form ``params.toml``.

The text is canonical: groups and keys in catalogue order, shortest decimals, one content hash over
values and tables. Two equal sets are equal byte for byte, whoever wrote them.

Differences between two sets of drive parameters, entry by entry in catalogue order.
"""

from __future__ import annotations

import difflib
import hashlib
import itertools
import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pmsmtool.errors import ConfigError, next_step
from pmsmtool.files import read_text
from pmsmtool.params.catalogue import BY_NAME, CATALOGUE, EVERY, LUT_CAPACITY_WORDS, SATURATION_VALUES
from pmsmtool.toml_file import LARGEST_WHOLE, parse_toml, refuse_schema, toml_text

NEXT_STEP = (
    "`pmsmtool tune` and `pmsmtool export` write such a file; `pmsmtool param help NAME` shows a parameter's bounds"
)

SCHEMA = "pmsmtool.params/1"
ASSUMED = "assumed"
"""Provenance of a value that nobody stated."""

LUT_NAMES = ("lut.axis_x", "lut.axis_y", "lut.axis_z", "lut.i_d_a", "lut.i_q_a")
"""Axes (torque in N m; rpm or Wb; V) and tables (A peak, row-major x, y, z) of the reference look-up."""

SATURATION = "saturation.nodes"
"""The saturation table: nodes of ``SATURATION_VALUES`` numbers (Wb and H), row-major i_d, i_q."""

TABLE_NAMES = (*LUT_NAMES, SATURATION)
"""Every table, in the order of the parameter image."""


@dataclass(frozen=True, slots=True)
class ParameterSet:
    """Values of drive parameters, all or some of the catalogue.

    Parameters
    ----------
    values : mapping of str to float
        Catalogue name -> value in SI.
    tables : mapping of str to sequence of float
        Look-up axes and tables, names as in ``TABLE_NAMES``.
    provenance : mapping of str to str
        Catalogue name, or any fact's name -> where it came from (hashes, methods; no dates).
    name : str
        What the set is for.
    """

    values: Mapping[str, float]
    tables: Mapping[str, Sequence[float]] = field(default_factory=dict)
    provenance: Mapping[str, str] = field(default_factory=dict)
    name: str = ""

    def __post_init__(self) -> None:
        unknown = [_unknown(key, BY_NAME) for key in self.values if key not in BY_NAME]
        unknown += [_unknown(key, TABLE_NAMES) for key in self.tables if key not in TABLE_NAMES]
        if unknown:
            raise ConfigError("not in the parameter catalogue", violations=unknown)
        object.__setattr__(self, "values", {r.name: float(self.values[r.name]) for r in EVERY if r.name in self.values})
        object.__setattr__(
            self, "tables", {n: tuple(map(float, self.tables[n])) for n in TABLE_NAMES if n in self.tables}
        )
        object.__setattr__(self, "provenance", dict(self.provenance))

    def violations(self) -> tuple[str, ...]:
        """List every value out of bounds and every table that does not fit its descriptor."""
        return (*self.bound_violations(), *_table_violations(self.values, self.tables))

    def bound_violations(self) -> tuple[str, ...]:
        """List every value out of bounds."""
        return tuple(line for name, value in self.values.items() for line in _bound_violations(name, value))

    def content_hash(self) -> str:
        """Return ``sha256:<hex>`` over values and tables in canonical form (provenance not included)."""
        return "sha256:" + hashlib.sha256(toml_text(self._groups()).encode("ascii")).hexdigest()

    def to_toml(self) -> str:
        """Return the canonical text of ``params.toml``."""
        head = {"schema": SCHEMA, "name": self.name, "content": self.content_hash()}
        tail = {"provenance": dict(sorted(self.provenance.items()))} if self.provenance else {}
        return toml_text({**head, **self._groups(), **tail})

    def merged(self, other: ParameterSet) -> ParameterSet:
        """Return this set with every entry of ``other`` laid over it."""
        return ParameterSet(
            values={**self.values, **other.values},
            tables={**self.tables, **other.tables},
            provenance={**self.provenance, **other.provenance},
            name=other.name or self.name,
        )

    def _groups(self) -> dict[str, dict[str, Any]]:
        groups: dict[str, dict[str, Any]] = {}
        for name, entry in [*((n, _plain(n, v)) for n, v in self.values.items()), *self.tables.items()]:
            group, key = name.split(".", 1)
            groups.setdefault(group, {})[key] = entry
        return groups


@next_step(NEXT_STEP)
def parse_parameter_set(text: str, where: str = "params.toml") -> ParameterSet:
    """Read the text of a parameter set.

    Raises ConfigError: not TOML, wrong schema, unknown names, values that are no numbers, or a content hash that does
    not fit the content; all violations at once.
    """
    document = parse_toml(text, where=where)
    refuse_schema(document.pop("schema", None), SCHEMA, where=where, hint="give a params.toml as `tune` writes it")
    name, content = document.pop("name", ""), document.pop("content", None)
    provenance = document.pop("provenance", {})
    values, tables, wrong = _read_groups(document)
    if not isinstance(name, str):
        wrong.append("name: not a string")
    if not isinstance(provenance, dict) or not all(isinstance(v, str) for v in provenance.values()):
        wrong.append("[provenance]: not a table of strings")
    if wrong:
        raise ConfigError("the parameter set cannot be used", where=where, violations=wrong)
    found = ParameterSet(values=values, tables=tables, provenance=provenance, name=name)
    if content is not None and content != found.content_hash():
        raise ConfigError(
            f"the content is {found.content_hash()}, the file states {content}",
            where=f"{where}:content",
            likely="the file was edited or cut",
            hint="delete the line `content` to accept the file as it is",
        )
    return found


@next_step(NEXT_STEP)
def read_parameter_set(path: Path) -> ParameterSet:
    """Read ``params.toml`` from a file; raises ``ConfigError`` naming the file."""
    return parse_parameter_set(read_text(path), str(path))


def default_set() -> ParameterSet:
    """Return the factory values of the reference drive."""
    return ParameterSet({row.name: row.default for row in CATALOGUE}, name="factory defaults")


def _plain(name: str, value: float) -> float | int:
    """Return an integer parameter as an integer; violations of that stay visible as floats."""
    whole = BY_NAME[name].is_integer and abs(value) < LARGEST_WHOLE and value == int(value)
    return int(value) if whole else value


def _unknown(name: str, known: Sequence[str] | Mapping[str, object]) -> str:
    close = difflib.get_close_matches(name, list(known), n=1)
    return f"{name}: unknown" + (f", did you mean {close[0]}?" if close else "")


def _read_groups(document: Mapping[str, Any]) -> tuple[dict[str, float], dict[str, list[float]], list[str]]:
    values: dict[str, float] = {}
    tables: dict[str, list[float]] = {}
    wrong: list[str] = []
    for group, entries in document.items():
        if not isinstance(entries, dict):
            wrong.append(_unknown(group, {row.name.split(".")[0]: None for row in EVERY}))
            continue
        for key, value in entries.items():
            name = f"{group}.{key}"
            if name in TABLE_NAMES and isinstance(value, list) and all(map(_is_number, value)):
                tables[name] = value
            elif name in BY_NAME and _is_number(value):
                values[name] = value
            elif name in BY_NAME or name in TABLE_NAMES:
                wrong.append(f"{name}: {value!r} is not {'a number' if name in BY_NAME else 'a list of numbers'}")
            else:
                wrong.append(_unknown(name, [*BY_NAME, *TABLE_NAMES]))
    return values, tables, wrong


def _is_number(value: object) -> bool:
    return type(value) in (int, float)  # a truth value is an int, too


def to_binary32(value: float) -> float:
    """Return the nearest binary32 value, infinity when it is too large for one."""
    try:
        return float(struct.unpack("<f", struct.pack("<f", value))[0])
    except OverflowError:
        return math.copysign(math.inf, value)


def _bound_violations(name: str, value: float) -> list[str]:
    row = BY_NAME[name]
    if not math.isfinite(value):
        return [f"{name} = {value!r} is not finite"]
    # The drive judges the binary32 value, so a bound that is not one must not refuse its own image.
    low, x, high = (value_ if row.is_integer else to_binary32(value_) for value_ in (row.minimum, value, row.maximum))
    found = []
    if not low <= x <= high:
        found.append(f"{name} = {value:.9g} {row.unit} is outside [{row.minimum:.9g}, {row.maximum:.9g}]")
    if row.is_integer and value != int(value):
        found.append(f"{name} = {value:.9g} is not an integer")
    return found


def _table_violations(values: Mapping[str, float], tables: Mapping[str, Sequence[float]]) -> list[str]:
    """Compare the tables with their descriptors, as far as the set holds them."""
    look_up = {name: table for name, table in tables.items() if name in LUT_NAMES}
    nodes = tables.get(SATURATION, ())
    return [*_saturation_violations(values, nodes), *_look_up_violations(values, look_up, len(nodes))]


def _saturation_violations(values: Mapping[str, float], nodes: Sequence[float]) -> list[str]:
    n_d, n_q = (values.get(f"saturation.n_{axis}", math.nan) for axis in "dq")
    if math.isnan(n_d + n_q):
        return [f"{SATURATION} without its descriptor saturation.n_d, saturation.n_q"] if nodes else []
    if len(nodes) != n_d * n_q * SATURATION_VALUES:
        return [f"{SATURATION} has {len(nodes)} numbers, the descriptor says {n_d * n_q * SATURATION_VALUES:g}"]
    return []


def _look_up_violations(
    values: Mapping[str, float], tables: Mapping[str, Sequence[float]], saturation_words: int
) -> list[str]:
    """NaN marks a cell without a point."""
    found = []
    for name, table in tables.items():
        axis = name.startswith("lut.axis_")
        found += [f"{name}[{k}] is {x!r}" for k, x in enumerate(table) if math.isinf(x) or (axis and math.isnan(x))]
        if axis and any(b <= a for a, b in itertools.pairwise(table)):
            found.append(f"{name} does not rise strictly")
    descriptor = [values.get(name, math.nan) for name in ("lut.format", "lut.n_x", "lut.n_y", "lut.n_z")]
    if not all(map(math.isfinite, descriptor)):
        return [*found, "tables without their descriptor lut.format, lut.n_x, lut.n_y, lut.n_z"] if tables else found
    kind, n_x, n_y, n_z = map(int, descriptor)
    present = kind != 0
    expected = {"lut.axis_x": n_x, "lut.axis_y": n_y, "lut.axis_z": n_z}
    expected |= dict.fromkeys(("lut.i_d_a", "lut.i_q_a"), n_x * n_y * n_z)
    for name, count in expected.items():
        given = len(tables.get(name, ()))
        if given != (count if present else 0):
            found.append(f"{name} has {given} numbers, the descriptor says {count if present else 'no table'}")
    words = n_x + n_y + n_z + 2 * (n_x * n_y * n_z if kind == 1 else (n_x * n_y * n_z + 1) // 2) + saturation_words
    if present and words > LUT_CAPACITY_WORDS:
        found.append(f"axes and tables need {words} words, the drive has {LUT_CAPACITY_WORDS}")
    return found


@dataclass(frozen=True, slots=True)
class Difference:
    """One entry that two sets do not share."""

    name: str
    """Catalogue or table name."""
    old: float | None
    new: float | None
    """Values in SI, None where a set has no such entry; for a table the entries that differ are
    counted in ``cells`` and ``old``, ``new`` are those of the first one."""
    unit: str
    """Unit of both."""
    cells: int = 0
    """How many numbers of a table differ; 0 for a scalar."""

    @property
    def relative(self) -> float:
        """Relative change ``new / old - 1``; NaN where it has no meaning."""
        if self.old is None or self.new is None or self.old == 0:
            return math.nan
        return self.new / self.old - 1.0


def compare(old: ParameterSet, new: ParameterSet, *, common_only: bool = False) -> tuple[Difference, ...]:
    """List the entries in which ``new`` differs from ``old``.

    ``common_only``: leave out what only one of the sets holds.
    """
    found = []
    for row in EVERY:
        a, b = old.values.get(row.name), new.values.get(row.name)
        if a != b and not (common_only and None in (a, b)):
            found.append(Difference(row.name, a, b, row.unit))
    for name in TABLE_NAMES:
        table_a, table_b = old.tables.get(name), new.tables.get(name)
        if common_only and (table_a is None or table_b is None):
            continue
        difference = _compare_tables(name, table_a or (), table_b or ())
        if difference is not None:
            found.append(difference)
    return tuple(found)


def _compare_tables(name: str, old: Sequence[float], new: Sequence[float]) -> Difference | None:
    shared = [(a, b) for a, b in zip(old, new, strict=False) if a != b and not (math.isnan(a) and math.isnan(b))]
    cells = len(shared) + abs(len(old) - len(new))
    if cells == 0:
        return None
    first_old, first_new = shared[0] if shared else (None, None)
    return Difference(name, first_old, first_new, table_unit(name), cells)


def table_unit(name: str) -> str:
    """Return the unit of a look-up axis or table, the second axis's only in words (it has two kinds)."""
    units = {"lut.axis_x": "N m", "lut.axis_y": "rpm or Wb", "lut.axis_z": "V", SATURATION: "Wb and H"}
    return BY_NAME[name].unit if name in BY_NAME else units.get(name, "A")
