# SPDX-License-Identifier: MIT
"""Formulas and tables that have one home: a copy of them anywhere else in the package is found.

The rules work on source text, so each is also shown a line it must refuse.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import pmsmtool
from pmsmtool.data_types import BY_SHORT, DATA_TYPES
from tests.test_layers import parsed

PACKAGE = Path(__file__).resolve().parent.parent / "pmsmtool"
PATTERNS = {
    "arrays.py": re.compile(r"^\w+ = NDArray\[np\.(?:float64|complex128)\]$", re.MULTILINE),
    "native.py": re.compile(r"_fields_ = \("),
    "machine/temperature.py": re.compile(r"\b0?\.00393\d*\b|\b3\.93e-0?3\b"),
    "units.py": re.compile(r"\bpi / (?:30|60)(?:_?000)?\b|\b(?:30|60)(?:\.0)? / \(?(?:2(?:\.0)? \* )?(?:math|np)\.pi"),
    "machine/torque.py": re.compile(r"\b(?:1\.5|3\.0 / 2\.0|\w*FACTOR) \* (?:\w+\.)*(?:pole_pairs|p)\b"),
}
"""Home of each formula, type and struct of the kernels, and what a copy of it looks like."""
TYPE_NAMES = frozenset(DATA_TYPES) | frozenset(BY_SHORT)
OTHER_NUMBERS = frozenset({"ingenia_objects.py"})
"""A maker's own numbers of the types, which are not those of CiA 301."""


def copies(name: str, source: str) -> Iterator[str]:
    """Yield what of a module (its path below the package) has its home elsewhere.

    Simulated drives of other makers decode with code of their own, so that a mistake does not agree with itself.
    """
    if name.startswith("sim/foreign/"):
        return
    for home, pattern in PATTERNS.items():
        if name != home:
            yield from (f"{name}: {match[0]!r} belongs to {home}" for match in pattern.finditer(source))
    if name == "data_types.py" or Path(name).name in OTHER_NUMBERS:
        return
    for node in ast.walk(parsed(source)):
        if isinstance(node, ast.Dict):
            keys = {key.value for key in node.keys if isinstance(key, ast.Constant)}
            if len(keys & TYPE_NAMES) > 2:
                yield f"{name}:{node.lineno}: a table of data types belongs to data_types.py"


def listed_fields(name: str, source: str) -> Iterator[str]:
    """Yield the dataclasses whose docstring writes names and types of their fields a second time.

    ``help()`` shows the list of those that the package gives.
    """
    for node in ast.walk(parsed(source)):
        if not isinstance(node, ast.ClassDef) or node.name in pmsmtool.__all__:
            continue
        if "dataclass" in " ".join(map(ast.unparse, node.decorator_list)):
            fields = {ast.unparse(part.target) for part in node.body if isinstance(part, ast.AnnAssign)}
            listed = re.findall(r"^(\w+)(?:, \w+)* : ", ast.get_docstring(node) or "", flags=re.MULTILINE)
            if fields & set(listed):
                yield f"{name}:{node.lineno}: {node.name}: say what a field holds behind the field"


@pytest.mark.chain
def test_nothing_in_the_package_is_a_copy() -> None:
    found = [
        copy
        for path in sorted(PACKAGE.rglob("*.py"))
        for rule in (copies, listed_fields)
        for copy in rule(path.relative_to(PACKAGE).as_posix(), path.read_text(encoding="utf-8"))
    ]
    assert found == []


@pytest.mark.parametrize(
    "line",
    [
        "Array = NDArray[np.float64]",
        "_fields_ = (('pole_pairs', ctypes.c_double),)",
        "ALPHA = 0.00393",
        "rpm = omega * 30.0 / math.pi",
        "omega = rpm * math.pi / 30.0",
        "rpm = omega * 60.0 / (2.0 * math.pi)",
        "_RPM = 2.0 * math.pi / 60.0",
        "torque = 1.5 * machine.pole_pairs * psi * i_q",
        "rise = 1.5 * self.p**2 * psi",
        "LETTERS = {'UNSIGNED8': 'B', 'INTEGER8': 'b', 'REAL32': 'f'}",
        "SHORT = {'U8': 1, 'I8': 1, 'I16': 2}",
    ],
)
def test_a_copy_is_found(line: str) -> None:
    assert len(list(copies("design/x.py", line))) == 1


@pytest.mark.parametrize(
    "line", ["loss = 1.5 * R * i**2", "late = 1.5 * (theta[-1] - theta[-2])", "half = math.pi / 3"]
)
def test_what_only_looks_like_one_is_not(line: str) -> None:
    assert list(copies("design/x.py", line)) == []


@pytest.mark.parametrize(("name", "found"), [("Mass", 1), ("Estimate", 0)])
def test_a_list_of_fields_is_found(name: str, found: int) -> None:
    doc = '    """One.\n\n    J, B : float\n        Both.\n    """'
    source = f"@dataclass(frozen=True)\nclass {name}:\n{doc}\n    J: float\n    B: float"
    assert len(list(listed_fields("design/x.py", source))) == found
