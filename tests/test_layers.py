# SPDX-License-Identifier: MIT
"""The plan of the house, enforced: who may import whom, what the pure rooms never touch, how long a file may get.

The rules work on source text, so each is also shown a line it must refuse.
"""

from __future__ import annotations

import ast
import itertools
import re
import sys
import tomllib
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "pmsmtool"

FLOORS: dict[str, int] = {
    "errors": 0,
    "arrays": 1,
    "plain_text": 1,
    "refusals": 1,
    "cia402": 1,
    "data_types": 1,
    "files": 1,
    "bus": 2,
    "units": 2,
    "native": 2,
    "npz_file": 2,
    "toml_file": 2,
    "run_directory": 2,
    "machine": 3,
    "trace": 3,
    "packaging": 3,
    "params": 4,
    "estimators": 5,
    "design": 5,
    "firmware": 5,
    "axis": 6,
    "drive_maps": 6,
    "drive": 7,
    "sim": 7,
    "report": 7,
    "experiments": 8,
    "flash": 8,
    "identification": 8,
    "measurement": 9,
    "proof": 10,
    "commissioning": 11,
    "papers": 12,
    "cli": 13,
}
SAME_ROOM = {"__main__": "cli"}
PURE = frozenset(
    {
        *("machine", "params", "estimators", "design", "firmware", "axis", "drive_maps", "identification"),
        *("report", "trace", "units"),
    }
)
IMPURE_ROOMS = frozenset(FLOORS) - PURE - frozenset(room for room, floor in FLOORS.items() if floor <= 2) | {"bus"}
IMPURE_LIBRARIES = frozenset({"click", "rich", "can", "canopen", "time", "random"})
MAY_IMPORT_SIM = frozenset({"sim", "proof", "papers", "cli"})
TYPES_ONLY = "pmsmtool.drive.port"
"""Types alone; every room that stands as high as drive may name them."""

SLOW_LIBRARIES = frozenset({"scipy", "matplotlib", "filterpy"})
"""0.2 to 0.6 s each: imported inside the function that needs them (start-up budget)."""
SLOW_FOR_CLI = SLOW_LIBRARIES | {"numpy", "can", "canopen", "rich", "jinja2"}

MAY_PRINT = frozenset({"cli", "packaging"})
RANDOM_TYPES = frozenset({"Generator", "BitGenerator", "SeedSequence", "PCG64", "Philox", "default_rng"})
EMPTY_WORDS = frozenset({"manager", "handler", "util", "utils", "helper", "helpers", "engine", "service"})
LINES_MAX = 600
ROOM_LINES_MAX = 9000
OWN_COUNT = ("sim/node", "sim/foreign")
"""Folders that count as rooms of their own."""


@dataclass(frozen=True)
class Import:
    """One imported module, and where the import stands."""

    module: str
    line: int
    top_level: bool
    typing_only: bool


def room(module: str) -> str:
    """Return the room of a module of the package."""
    name = module.split(".")[1] if "." in module else ""
    return SAME_ROOM.get(name, name)


def _is_type_checking(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


@cache
def imports(tree: ast.Module) -> tuple[Import, ...]:
    """Return every import of a module with its place."""
    found: list[Import] = []

    def visit(node: ast.AST, top_level: bool, typing_only: bool) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.expr):
                continue  # no expression holds a statement
            if isinstance(child, ast.Import):
                found.extend(Import(alias.name, child.lineno, top_level, typing_only) for alias in child.names)
            elif isinstance(child, ast.ImportFrom):
                source = child.module or ""
                submodules = source == "pmsmtool"  # `from pmsmtool import trace` names rooms
                for name in [f"{source}.{alias.name}" for alias in child.names] if submodules else [source]:
                    found.append(Import(name, child.lineno, top_level, typing_only))
            inside = isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef))
            visit(child, top_level and not inside, typing_only or _is_type_checking(child))

    visit(tree, True, False)
    return tuple(found)


def arrow_faults(module: str, tree: ast.Module) -> Iterator[str]:
    """Imports that go up, sideways, or out of a pure room."""
    here = room(module)
    if not here:
        return  # pmsmtool/__init__.py names its public modules without importing them
    for found in imports(tree):
        top = found.module.split(".")[0]
        if here in PURE and top in IMPURE_LIBRARIES:
            yield f"{found.line}: the pure room {here} imports {top}"
        there = room(found.module) if top == "pmsmtool" else ""
        if there in ("", here, "__version__"):
            continue
        if there not in FLOORS:
            yield f"{found.line}: no floor is known for {found.module}"
        elif here in PURE and there in IMPURE_ROOMS:
            yield f"{found.line}: the pure room {here} imports {there}"
        elif there == "sim" and here not in MAY_IMPORT_SIM:
            yield f"{found.line}: {here} imports sim"
        elif there == "packaging":
            yield f"{found.line}: {here} imports the build tools"
        elif FLOORS[there] >= FLOORS[here] and not (found.module == TYPES_ONLY and FLOORS[here] >= FLOORS["drive"]):
            yield f"{found.line}: {here} (floor {FLOORS[here]}) imports {there} (floor {FLOORS[there]})"


def start_up_faults(module: str, tree: ast.Module) -> Iterator[str]:
    """Slow libraries imported where merely importing the module pays for them."""
    slow = SLOW_FOR_CLI if room(module) == "cli" else SLOW_LIBRARIES
    for found in imports(tree):
        if found.module.split(".")[0] in slow and found.top_level and not found.typing_only:
            yield f"{found.line}: imports {found.module} at top level"


def call_faults(module: str, tree: ast.Module) -> Iterator[str]:
    """Printing outside the command line, and random numbers nobody passed in."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print":
            if room(module) not in MAY_PRINT:
                yield f"{node.lineno}: print outside cli"
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Attribute) and node.value.attr == "random":
            if ast.unparse(node.value) in ("np.random", "numpy.random") and node.attr not in RANDOM_TYPES:
                yield f"{node.lineno}: global random state np.random.{node.attr}"
        elif isinstance(node, ast.Call) and not node.args and ast.unparse(node.func).endswith("random.default_rng"):
            yield f"{node.lineno}: a random generator without a seed"


def _words(name: str) -> set[str]:
    return {word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+", name)}


def name_faults(module: str, tree: ast.Module) -> Iterator[str]:
    """Words that say nothing about what a thing is."""
    if EMPTY_WORDS & _words(module):
        yield f"the name {module} says nothing"
    for node in ast.walk(tree):
        if isinstance(node, (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)) and EMPTY_WORDS & _words(node.name):
            yield f"{node.lineno}: the name {node.name} says nothing"


RULES = (arrow_faults, start_up_faults, call_faults, name_faults)


@cache
def parsed(source: str) -> ast.Module:
    """Return the syntax tree of a source."""
    return ast.parse(source)


def faults(module: str, source: str) -> list[str]:
    """Return all violations of one module."""
    tree = parsed(source)
    return [fault for rule in RULES for fault in rule(module, tree)]


def module_name(path: Path) -> str:
    """Return the dotted name of a file of the package."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


MODULES = sorted(PACKAGE.rglob("*.py"))


@pytest.mark.parametrize("path", MODULES, ids=module_name)
def test_module_keeps_the_rules(path: Path) -> None:
    assert faults(module_name(path), path.read_text(encoding="utf-8")) == []


@cache
def arrows() -> dict[str, set[str]]:
    """Every module of the package and the modules it imports, also for type checkers and inside functions."""
    known = {module_name(path) for path in MODULES}
    found: dict[str, set[str]] = {}
    for path in MODULES:
        tree = parsed(path.read_text(encoding="utf-8"))
        named = {item.module for item in imports(tree)}
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module:
                named |= {f"{node.module}.{alias.name}" for alias in node.names}
        found[module_name(path)] = named & known - {"pmsmtool"}
    return found


def circle(graph: Mapping[str, Collection[str]]) -> list[str]:
    """Return the names of one circle of a graph, in its order; empty where there is none."""
    done: set[str] = set()

    def walk(name: str, path: list[str]) -> list[str]:
        if name in path:
            return path[path.index(name) :]
        if name in done:
            return []
        found = next((way for there in sorted(graph.get(name, ())) if (way := walk(there, [*path, name]))), [])
        done.add(name)
        return found

    return next((way for name in sorted(graph) if (way := walk(name, []))), [])


def rooms(modules: Mapping[str, Collection[str]]) -> dict[str, set[str]]:
    """Return which room imports which."""
    found: dict[str, set[str]] = {}
    for module, imported in modules.items():
        if room(module):
            found.setdefault(room(module), set()).update({room(there) for there in imported} - {room(module), ""})
    return found


def reached(module: str, modules: Mapping[str, Collection[str]]) -> set[str]:
    """Return all modules that importing one imports, over any number of others."""
    found: set[str] = set()
    left = [module]
    while left:
        new = set(modules.get(left.pop(), ())) - found
        found |= new
        left += new
    return found


@pytest.mark.chain
def test_no_circle_between_rooms() -> None:
    assert circle(rooms(arrows())) == []
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": ()}) == ["b", "c"]


def test_identification_moves_nothing() -> None:
    """From stored traces to values, whoever imports it, years later, without a bus."""
    mine = [module for module in arrows() if room(module) == "identification"]
    assert mine
    for module in mine:
        assert {room(there) for there in reached(module, arrows())} & {"drive", "experiments", "bus", "sim"} == set(), (
            module
        )
    assert reached("a", {"a": {"b"}, "b": {"c", "a"}}) == {"a", "b", "c"}


def test_no_room_is_too_large() -> None:
    lines: dict[str, int] = {}
    for path in (path for suffix in ("py", "c", "h") for path in PACKAGE.rglob(f"*.{suffix}")):
        inside = path.relative_to(PACKAGE).as_posix()
        name = next((own for own in OWN_COUNT if inside.startswith(f"{own}/")), inside.split("/")[0])
        lines[name] = lines.get(name, 0) + path.read_text(encoding="utf-8").count("\n")
    assert {"sim", "design", "identification"} <= set(lines)
    assert {name: count for name, count in lines.items() if count > ROOM_LINES_MAX} == {}


@pytest.mark.parametrize("folder", ["pmsmtool", "tests", "benchmarks"])
def test_no_file_is_too_long(folder: str) -> None:
    files = [path for suffix in ("py", "c", "h") for path in (ROOT / folder).rglob(f"*.{suffix}")]
    lengths = {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8").count("\n") for path in files}
    assert lengths
    assert {name: lines for name, lines in lengths.items() if lines > LINES_MAX} == {}


@pytest.mark.parametrize(
    ("module", "source", "complaint"),
    [
        ("pmsmtool.machine.x", "import pmsmtool.bus.connect", "pure room machine imports bus"),
        ("pmsmtool.design.x", "def f():\n    from pmsmtool.sim import plant", "pure room design imports sim"),
        ("pmsmtool.report.x", "from pmsmtool import sim", "pure room report imports sim"),
        ("pmsmtool.estimators.x", "import time", "imports time"),
        ("pmsmtool.trace", "from random import random", "pure room trace imports random"),
        ("pmsmtool.machine.x", "from pmsmtool.design.tune import tune", "machine (floor 3) imports design (floor 5)"),
        ("pmsmtool.design.x", "from pmsmtool.estimators import noise", "design (floor 5) imports estimators"),
        ("pmsmtool.machine.x", "if TYPE_CHECKING:\n    from pmsmtool.firmware import image", "(floor 5)"),
        ("pmsmtool.estimators.x", "from pmsmtool.drive.port import Drive", "pure room estimators imports drive"),
        ("pmsmtool.bus.x", "from pmsmtool.drive.port import Drive", "bus (floor 2) imports drive"),
        ("pmsmtool.flash.x", "from pmsmtool.sim.bus import PmsmSimBus", "flash imports sim"),
        ("pmsmtool.measurement.x", "from pmsmtool.sim.bus import PmsmSimBus", "measurement imports sim"),
        (
            "pmsmtool.identification.x",
            "from pmsmtool.drive.port import Drive",
            "pure room identification imports drive",
        ),
        ("pmsmtool.identification.x", "from pmsmtool.experiments import signals", "imports experiments"),
        ("pmsmtool.identification.x", "from pmsmtool.measurement import limits", "identification imports measurement"),
        (
            "pmsmtool.firmware.x",
            "from pmsmtool.drive_maps.eds import parse_eds",
            "firmware (floor 5) imports drive_maps",
        ),
        ("pmsmtool.measurement.x", "from pmsmtool.proof import plan", "measurement (floor 9) imports proof"),
        ("pmsmtool.commissioning.x", "from pmsmtool.papers import figure", "commissioning (floor 11) imports papers"),
        ("pmsmtool.cli.x", "from pmsmtool.packaging import kernels", "build tools"),
        ("pmsmtool.cli.x", "from pmsmtool.attic import y", "no floor is known"),
        ("pmsmtool.design.x", "from scipy import linalg", "imports scipy at top level"),
        ("pmsmtool.design.x", "class A:\n    import matplotlib.figure", "imports matplotlib.figure at top level"),
        ("pmsmtool.cli.x", "import numpy as np", "imports numpy at top level"),
        ("pmsmtool.cli.x", "if True:\n    import can", "imports can at top level"),
        ("pmsmtool.measurement.x", "print('x')", "print outside cli"),
        ("pmsmtool.sim.x", "np.random.normal(0, 1)", "global random state"),
        ("pmsmtool.sim.x", "rng = np.random.default_rng()", "without a seed"),
        ("pmsmtool.sim.x", "class BusManager: ...", "BusManager says nothing"),
        ("pmsmtool.sim.util", "", "says nothing"),
    ],
)
def test_rules_refuse(module: str, source: str, complaint: str) -> None:
    found = faults(module, source)
    assert len(found) == 1
    assert complaint in found[0]


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("pmsmtool.sim.x", "from pmsmtool.drive.port import Excitation"),
        ("pmsmtool.proof.x", "from pmsmtool.sim.bus import PmsmSimBus"),
        ("pmsmtool.design.x", "import numpy as np\ndef f(rng: np.random.Generator):\n    from scipy import linalg"),
        ("pmsmtool.cli.x", "if TYPE_CHECKING:\n    import numpy\ndef f():\n    import can\n    print(1)"),
        ("pmsmtool.sim.x", "rng = np.random.default_rng(7)\nUTILISATION = 1\ndef utilisation(): ..."),
        ("pmsmtool.cli.x", "from pmsmtool import __version__"),
    ],
)
def test_rules_allow(module: str, source: str) -> None:
    assert faults(module, source) == []


def test_every_third_party_import_is_declared_and_the_reverse() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    requirements = [*project["dependencies"], *itertools.chain(*project["optional-dependencies"].values())]
    names = {re.match(r"[A-Za-z0-9-]+", text)[0].lower() for text in requirements}  # type: ignore[index]
    imported_as = {"python-can": "can"}
    declared = {imported_as.get(name, name) for name in names}
    used = set()
    for path in MODULES:
        for found in imports(parsed(path.read_text(encoding="utf-8"))):
            top = found.module.split(".")[0]
            if top not in sys.stdlib_module_names and top != "pmsmtool":
                assert top in declared, f"{path.name}:{found.line} imports {top}"
                used.add(top)
    runtime = {re.match(r"[A-Za-z0-9-]+", text)[0].lower() for text in project["dependencies"]}  # type: ignore[index]
    assert {imported_as.get(name, name) for name in runtime} <= used
