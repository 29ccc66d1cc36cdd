# SPDX-License-Identifier: MIT
"""``docs/architecture.md`` is true: every path and name on it exists, and its floors are those the tests enforce."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.test_layers import FLOORS, PURE, ROOT, room

PAGE = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
PATH = re.compile(r"`([\w./-]+/|[\w/-]+(?:\.\w+)*\.(?:py|c|h|md|toml))`")
FROM_A_RUN = frozenset({"machine.toml", "design.toml", "params.toml", "map.toml"})
"""Files that a run or a map's folder holds."""
STEPS_OF_R_MAX = 12
"""Steps of the walk of R_s that a reader can follow."""


def found(name: str) -> Path | None:
    """Return what a path of the page names: from the top, below the package, or a sub-folder named beside its room."""
    candidates = (ROOT / name, ROOT / "pmsmtool" / name, *(ROOT / "pmsmtool").glob(f"*/{name}"))
    return next((path for path in candidates if path.exists()), None)


def defined(path: Path) -> set[str]:
    """Return the names a source defines at its top, and methods as ``Class.method``."""
    source = path.read_text(encoding="utf-8")
    if path.suffix != ".py":
        return set(re.findall(r"^(?:[a-z_][\w ]*[ *])(\w+)\([^;]*?\)\n\{", source, flags=re.MULTILINE))
    names = set()
    for node in ast.parse(source).body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            names.add(node.name)
        if isinstance(node, ast.ClassDef):
            names |= {f"{node.name}.{part.name}" for part in node.body if isinstance(part, ast.FunctionDef)}
        targets = (
            node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        )
        names |= {target.id for target in targets if isinstance(target, ast.Name)}
    return names


def steps() -> Iterator[tuple[str, str]]:
    """File and name of every step of the walks, and of every name in brackets behind a path."""
    yield from re.findall(r"^\| \d+ \| `([\w./]+)` \| `([\w.]+)` \|", PAGE, flags=re.MULTILINE)
    yield from re.findall(r"`([\w./]+\.\w+)` \(`(\w+)`", PAGE)
    yield from ((path, name) for name, path in re.findall(r"`(\w+)` (?:of|in) `([\w./]+\.\w+)`", PAGE))


def walk(title: str) -> list[str]:
    """Return the lines of one walk's table."""
    section = PAGE.split(f"\n### {title}", 1)[1].split("\n#", 1)[0]
    return re.findall(r"^\| \d+ \|.*", section, flags=re.MULTILINE)


@pytest.mark.parametrize("name", sorted(set(PATH.findall(PAGE)) - FROM_A_RUN))
def test_every_path_exists(name: str) -> None:
    assert found(name) is not None


@pytest.mark.parametrize(("path", "name"), sorted(set(steps())), ids=lambda part: part)
def test_every_name_stands_in_its_file(path: str, name: str) -> None:
    where = found(path)
    assert where is not None and name in defined(where)


def test_a_name_that_is_not_there_is_seen() -> None:
    source = found("firmware/core/step.c")
    assert source is not None and {"pmsm_step", "control"} <= defined(source)
    assert "is_usable(m" not in defined(source) and "if" not in defined(source) and "pmsm_lookup" not in defined(source)
    assert found("workflow/") is None and found("estimators/absent.py") is None


def test_the_walks_are_short() -> None:
    assert 1 < len(walk("R_s")) <= STEPS_OF_R_MAX
    assert len(walk("The i_q reference")) > 1 and len(walk("The scale of a drive map")) > 1


def test_the_floors_are_those_that_are_enforced() -> None:
    shown: dict[str, int] = {}
    pure = set()
    for floor, cell in re.findall(r"^\| (\d+) \| ([^|]+) \|", PAGE.split("\n## Three walks")[0], flags=re.MULTILINE):
        for star, name in re.findall(r"(\*?)`([\w.]+?)(?:\.py|/)`", cell):
            shown[name] = int(floor)
            pure |= {name} if star else set()
    assert shown == FLOORS
    assert pure == PURE


def test_every_module_has_a_room_on_the_page() -> None:
    names = {room(f"pmsmtool.{path.stem}") for path in (ROOT / "pmsmtool").glob("*") if path.suffix in ("", ".py")}
    assert names - {"__init__", "__pycache__", "_native", "_data"} <= set(FLOORS)
