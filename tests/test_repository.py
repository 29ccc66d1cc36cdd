# SPDX-License-Identifier: MIT
"""Habits of the repository: licence lines, citations that a reader can follow, markers that workflows use."""

from __future__ import annotations

import ast
import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SOURCES = sorted(
    path
    for folder in ("pmsmtool", "tests", "benchmarks")
    for suffix in ("py", "c", "h")
    for path in (ROOT / folder).rglob(f"*.{suffix}")
)
CITED = re.compile(r"docs/([a-z_]+\.md)(?:``)?(?:,\s+(\d+(?:\.\d+)?))?")
FOLLOWED_BY_NOBODY = re.compile(r"(?:identification|CANopen|governor|polar-control)\s+reference,?\s+\(?(?:section|\d)")
"""Names of documents that are not in the repository."""


def headings(path: Path) -> set[str]:
    """Numbers of the headings of a document."""
    return set(re.findall(r"^#+ (\d+(?:\.\d+)?) ", path.read_text(encoding="utf-8"), re.MULTILINE))


def citation_faults(text: str) -> list[str]:
    """Citations whose document or section does not exist."""
    missing = []
    for name, section in CITED.findall(text):
        path = ROOT / "docs" / name
        if not path.is_file() or (section and section not in headings(path)):
            missing.append(f"docs/{name}, {section}")
    return missing + FOLLOWED_BY_NOBODY.findall(text)


def test_the_licence_is_declared_and_there() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert (project["license"], project["license-files"]) == ("MIT", ["LICENSE"])
    assert "the pmsmtool authors" in (ROOT / "LICENSE").read_text(encoding="utf-8")
    assert (ROOT / "pmsmtool" / "py.typed").is_file()


def test_cited_documents_and_sections_exist() -> None:
    texts = {path: path.read_text(encoding="utf-8") for path in SOURCES if path != Path(__file__)}
    assert sum(len(CITED.findall(text)) for text in texts.values()) > 30
    assert {str(path): found for path, text in texts.items() if (found := citation_faults(text))} == {}


@pytest.mark.parametrize(
    "text",
    [
        "(docs/attic.md, 3)",
        "(docs/identification.md, 3.9)",
        "(identification reference, 3.1)",
        "CANopen reference, section 6",
    ],
)
def test_a_citation_that_leads_nowhere_is_found(text: str) -> None:
    assert len(citation_faults(text)) == 1


def test_workflow_hooks_and_guide_use_markers_that_exist() -> None:
    options = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["pytest"]["ini_options"]
    known = {marker.split(":")[0] for marker in options["markers"]}
    for name in (".github/workflows/tests.yml", "CONTRIBUTING.md"):
        (selection,) = re.findall(r'-m "([^"]+)"', (ROOT / name).read_text(encoding="utf-8"))
        assert set(re.findall(r"not (\w+)", selection)) == known == {"chain", "slow_install", "wall_clock"}


def test_every_source_names_its_licence() -> None:
    rooms = ("pmsmtool", "tests", "benchmarks")
    sources = [path for room in rooms for ending in ("py", "c", "h") for path in (ROOT / room).rglob(f"*.{ending}")]
    heads = {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8")[:200] for path in sources}
    assert len(heads) > 700
    assert [name for name, head in heads.items() if "SPDX-License-Identifier: MIT" not in head] == []


def runs_before_its_end(text: str) -> bool:
    """Whether a module that is run as a program starts before all of its names are there."""
    body = ast.parse(text).body
    return any(isinstance(node, ast.If) and "__name__" in ast.unparse(node.test) for node in body[:-1])


def test_a_program_starts_at_the_end_of_its_module() -> None:
    programs = [path for path in SOURCES if path.suffix == ".py" and "__main__" in path.read_text(encoding="utf-8")]
    assert len(programs) > 30
    assert [str(path) for path in programs if runs_before_its_end(path.read_text(encoding="utf-8"))] == []
    assert runs_before_its_end('if __name__ == "__main__":\n    main()\n\ndef main(): ...\n')
