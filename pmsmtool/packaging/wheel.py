# SPDX-License-Identifier: MIT
"""Write wheels and source archives: same content, same bytes (no dates, sorted entries).

What goes into a wheel and a source archive: plain rules over the tree, no list to keep by hand.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import io
import tarfile
import zipfile
from collections.abc import Mapping
from pathlib import Path

from pmsmtool.resources import BUNDLE

_EPOCH = (1980, 1, 1, 0, 0, 0)
_MODE = 0o100644 << 16


def _record_line(name: str, content: bytes) -> str:
    digest = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode("ascii")
    return f"{name},sha256={digest},{len(content)}\n"


def write_wheel(folder: Path, metadata: Path, tag: str, files: Mapping[str, Path | bytes]) -> Path:
    """Write a wheel (PEP 427).

    Parameters
    ----------
    folder : Path
        Where to put it.
    metadata : Path
        The ``.dist-info`` folder; its METADATA, entry points and licences are taken.
    tag : str
        ``python-abi-platform``.
    files : mapping
        Path in the wheel -> file or content.

    Returns
    -------
    Path
        The wheel.
    """
    content = {name: source if isinstance(source, bytes) else source.read_bytes() for name, source in files.items()}
    info = metadata.name
    for path in sorted(metadata.rglob("*")):
        inside = path.relative_to(metadata)
        if inside.parts[0] in ("METADATA", "entry_points.txt", "licenses") and path.is_file():
            content[f"{info}/{inside.as_posix()}"] = path.read_bytes()
    pure = str(tag.endswith("-any")).lower()
    lines = f"Wheel-Version: 1.0\nGenerator: pmsmtool.packaging\nRoot-Is-Purelib: {pure}\nTag: {tag}\n"
    content[f"{info}/WHEEL"] = lines.encode("ascii")
    names = sorted(content, key=lambda name: (name.startswith(info), name))
    record = "".join(_record_line(name, content[name]) for name in names) + f"{info}/RECORD,,\n"
    target = folder / f"{info.removesuffix('.dist-info')}-{tag}.whl"
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name in [*names, f"{info}/RECORD"]:
            entry = zipfile.ZipInfo(name, _EPOCH)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = _MODE
            archive.writestr(entry, content.get(name, record.encode("utf-8")))
    return target


def write_source_archive(folder: Path, name: str, metadata: Path, files: Mapping[str, Path]) -> Path:
    """Write a source archive (PEP 625): ``name/`` with the files and ``PKG-INFO``."""
    content = {path: source.read_bytes() for path, source in files.items()}
    content["PKG-INFO"] = (metadata / "METADATA").read_bytes()
    target = folder / f"{name}.tar.gz"
    with (
        target.open("wb") as raw,
        gzip.GzipFile(filename="", fileobj=raw, mode="wb", mtime=0) as packed,
        tarfile.open(fileobj=packed, mode="w", format=tarfile.PAX_FORMAT) as archive,
    ):
        for path in sorted(content):
            entry = tarfile.TarInfo(f"{name}/{path}")
            entry.size = len(content[path])
            entry.mode = 0o755 if path.startswith(".ci/") else 0o644
            archive.addfile(entry, io.BytesIO(content[path]))
    return target


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
