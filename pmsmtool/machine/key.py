# SPDX-License-Identifier: MIT
"""One key of a file: its unit, bounds and meaning. The tables of keys are validation and documentation in one."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from difflib import get_close_matches
from numbers import Real
from typing import Any, Literal

from pmsmtool.errors import ConfigError
from pmsmtool.units import parse_quantity

Value = float | int | bool | str | tuple[float, ...]
KeyKind = Literal["float", "int", "bool", "text", "floats"]


@dataclass(frozen=True, slots=True)
class Key:
    """One key of a table."""

    table: str
    name: str
    """Where it stands; the unit is the suffix of the name."""
    kind: KeyKind
    """Type of its value; ``floats`` is an array."""
    unit: str
    """Unit, as in ``units.UNITS``; empty for text and booleans."""
    minimum: float
    maximum: float
    """Inclusive bounds."""
    default: Value | None
    """What holds without the key; None where there is no value without it."""
    meaning: str
    """One line."""
    required: bool = False
    """Whether a file must give it."""
    choices: tuple[str, ...] = ()
    """Allowed texts; empty for free text."""
    falls_back: str = ""
    """Key in another table that holds without this one, ``[table] key``."""
    besides: tuple[float, ...] = ()
    """Numbers allowed outside the bounds, among them infinity and NaN: zero for "none", infinity for "no limit"."""

    def check(self, value: Any) -> tuple[Value | None, str]:
        """Return the value as its type and an empty text, or None and what is wrong with it."""
        if self.kind == "bool":
            return (value, "") if isinstance(value, bool) else (None, f"is {_kind(value)}, allowed are true and false")
        if self.kind == "text":
            return self._check_text(value)
        if self.kind == "floats":
            return self._check_floats(value)
        if isinstance(value, str):
            return None, f"is text; {self._number_hint(value)}"
        if isinstance(value, bool) or not isinstance(value, int | float):
            return None, f"is {_kind(value)}, not a number"
        problem = self._bounds(_as_float(value))
        if problem:
            return None, problem
        if self.kind == "int":
            return (int(value), "") if value == int(value) else (None, f"= {value!r} is not a whole number")
        return float(value), ""

    def _check_text(self, value: Any) -> tuple[Value | None, str]:
        if not isinstance(value, str):
            return None, f"is {_kind(value)}, not text"
        if self.choices and value not in self.choices:
            return None, f"= {value!r} is not one of {', '.join(self.choices)}{did_you_mean(value, self.choices)}"
        return value, ""

    def _check_floats(self, value: Any) -> tuple[Value | None, str]:
        if not isinstance(value, list | tuple) or any(
            isinstance(item, bool) or not isinstance(item, int | float) for item in value
        ):
            return None, "is not an array of numbers"
        problems = [problem for item in value if (problem := self._bounds(_as_float(item)))]
        return (None, problems[0]) if problems else (tuple(float(item) for item in value), "")

    def _bounds(self, value: float) -> str:
        if any(value == other or (math.isnan(value) and math.isnan(other)) for other in self.besides):
            return ""
        if not math.isfinite(value):
            return f"= {value} is not finite"
        unit = "" if self.unit in ("", "1") else f" {self.unit}"
        if value < self.minimum:
            return f"= {value:g} is below {self.minimum:g}{unit} ({self.meaning})"
        if value > self.maximum:
            return f"= {value:g} is above {self.maximum:g}{unit} ({self.meaning})"
        return ""

    def _number_hint(self, text: str) -> str:
        try:
            return f"write the number {parse_quantity(text, self.unit)!r} (in {self.unit})"
        except ConfigError:
            return f"write a number{f' in {self.unit}' if self.unit not in ('', '1') else ''}"


def _as_float(value: float) -> float:
    """Return a number as a float; a whole number of hundreds of digits is infinite."""
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def _kind(value: Any) -> str:
    names = {bool: "true or false", dict: "a table", list: "an array", str: "text", int: "a number", float: "a number"}
    return names.get(type(value), f"a {type(value).__name__}")


def did_you_mean(name: str, known: Sequence[str]) -> str:
    """Return ``; did you mean X?`` for the first known name that begins so, holds it, or is near; or an empty text."""
    begins = [each for each in known if name and each.startswith(name)]
    holds = [each for each in known if len(name) > 2 and name in each]
    near = begins or holds or get_close_matches(name, known, n=1, cutoff=0.6)
    return f"; did you mean {near[0]}?" if near else ""


def not_numbers(request: Any) -> list[str]:
    """Return what a dataclass declares a number and holds as something else, as violations."""
    given = [(item.name, str(item.type).split(" ")[0], getattr(request, item.name)) for item in fields(request)]
    return [
        f"{name} is {value!r}, not a number"
        for name, kind, value in given
        if kind in ("float", "int") and not (value is None or isinstance(value, Real))
    ]


def check_table(
    table: Mapping[str, Any],
    keys: Sequence[Key],
    where: Mapping[str, str],
    violations: list[str],
    elsewhere: Mapping[str, str],
) -> dict[str, Value]:
    """Check one table against its keys.

    Parameters
    ----------
    table : mapping
        As read.
    keys : sequence of Key
        The keys it may have.
    where : mapping of str to str
        Place of each key (``file:line: [table] key``); the place of the table under the empty key.
    violations : list of str
        Everything that is wrong is appended.
    elsewhere : mapping of str to str
        Keys of other tables and the table they belong to, for better advice.

    Returns
    -------
    dict
        The valid values.
    """
    known = {key.name: key for key in keys}
    values: dict[str, Value] = {}
    for name, raw in table.items():
        key = known.get(name)
        if key is None:
            advice = f"; it belongs to [{elsewhere[name]}]" if name in elsewhere else did_you_mean(name, list(known))
            violations.append(f"{where.get(name, where[''])}: unknown key{advice}")
            continue
        value, problem = key.check(raw)
        if problem or value is None:
            violations.append(f"{where.get(name, where[''])} {problem}")
        else:
            values[name] = value
    missing = [key.name for key in keys if key.required and key.name not in table]
    violations.extend(f"{where['']}: {name} is missing ({known[name].meaning})" for name in missing)
    return values
