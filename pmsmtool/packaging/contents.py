# SPDX-License-Identifier: MIT
"""What goes into a wheel and a source archive: plain rules over the tree, no list to keep by hand."""

from __future__ import annotations

from pathlib import Path

from pmsmtool.resources import BUNDLE

PACKAGE_SUFFIXES = frozenset(
    {".py", ".pyi", ".typed", ".c", ".h", ".j2", ".toml", ".json", ".csv", ".npz", ".css", ".svg", ".md"}
)
"""Kinds of files the package may hold; a tracked file of another kind fails ``tests/packaging``."""

DATA_FOLDERS: tuple[str, ...] = ("profiles", "firmware-params")
SOURCE_FOLDERS: tuple[str, ...] = ("pmsmtool", *DATA_FOLDERS, "tests", "benchmarks", "docs", ".github", ".ci")
SOURCE_FILES: tuple[str, ...] = (
    "pyproject.toml",
    "README.md",
    "LICENSE",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
    "CITATION.cff",
    "mkdocs.yml",
    ".gitignore",
    ".editorconfig",
    ".pre-commit-config.yaml",
)

_GENERATED = frozenset({"__pycache__", "_native", BUNDLE})


def _files(folder: Path) -> list[Path]:
    paths = (path for path in folder.rglob("*") if path.is_file() and not path.name.endswith((".pyc", ".orig", "~")))
    return sorted(path for path in paths if _GENERATED.isdisjoint(path.relative_to(folder).parts))


def package_files(root: Path) -> dict[str, Path]:
    """Return path in the wheel -> file, for everything but the compiled kernels.

    The two data folders stand beside the package in a checkout and inside it in a wheel
    (``resources.data_folder`` knows both).
    """
    chosen = {
        path.relative_to(root).as_posix(): path
        for path in _files(root / "pmsmtool")
        if path.suffix in PACKAGE_SUFFIXES or path.name == "py.typed"
    }
    for name in DATA_FOLDERS:
        for path in _files(root / name):
            chosen[f"pmsmtool/{BUNDLE}/{path.relative_to(root).as_posix()}"] = path
    return chosen


def source_files(root: Path) -> dict[str, Path]:
    """Return path in the source archive -> file."""
    chosen = {name: root / name for name in SOURCE_FILES if (root / name).is_file()}
    for folder in SOURCE_FOLDERS:
        chosen.update({path.relative_to(root).as_posix(): path for path in _files(root / folder)})
    return chosen
