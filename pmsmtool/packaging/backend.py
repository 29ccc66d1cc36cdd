# SPDX-License-Identifier: MIT
"""The build backend (PEP 517, PEP 660) of this package.

setuptools makes the metadata out of ``pyproject.toml``; this module adds what it cannot do: a C compiler that
is required only where none works, plain shared libraries in a wheel that fits every Python
(``py3-none-<platform>``), and the data folders from beside the package. It writes nothing into the source tree
but the kernels of an editable installation.

Wheels and source archives: same content, same bytes (no dates, sorted entries); plain rules over the tree say what goes
in, no list to keep by hand.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import io
import os
import sys
import tarfile
import tempfile
import tomllib
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pmsmtool.files import BUNDLE
from pmsmtool.packaging.build_kernels import build_all, build_page_module
from pmsmtool.packaging.compiler import Compiler, build_compiler, here, local_wheel_tag, system_compiler

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
    (``files.data_folder`` knows both).
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


Settings = Mapping[str, Any] | None


def ziglang_requirement(root: Path) -> str:
    """Return the pinned requirement of the fallback compiler, as the extra ``cross`` states it."""
    with (root / "pyproject.toml").open("rb") as file:
        extra: Sequence[str] = tomllib.load(file)["project"]["optional-dependencies"]["cross"]
    return next(requirement for requirement in extra if requirement.startswith("ziglang=="))


def get_requires_for_build_wheel(config_settings: Settings = None) -> list[str]:
    """Require ziglang where no compiler of this machine builds a library that loads, and for the page of reports.

    A compiler that ``CC`` names is the only one that is taken, and the module of the page is left out with it.
    """
    compiler, reasons = system_compiler()
    requirement = ziglang_requirement(Path.cwd())
    if compiler is not None:
        return [requirement] if here() is not None and not os.environ.get("CC") else []
    print(f"no C compiler works here ({'; '.join(reasons)}): the build takes {requirement}", file=sys.stderr)
    return [requirement]


def get_requires_for_build_editable(config_settings: Settings = None) -> list[str]:
    """As for a wheel: an editable installation needs compiled kernels too."""
    return get_requires_for_build_wheel(config_settings)


def get_requires_for_build_sdist(config_settings: Settings = None) -> list[str]:
    """Nothing: a source archive is not compiled."""
    return []


def prepare_metadata_for_build_wheel(metadata_directory: str, config_settings: Settings = None) -> str:
    """Write the ``.dist-info`` folder and return its name."""
    from setuptools import build_meta

    name: str = build_meta.prepare_metadata_for_build_wheel(metadata_directory)
    return name


def prepare_metadata_for_build_editable(metadata_directory: str, config_settings: Settings = None) -> str:
    """As for a wheel."""
    return prepare_metadata_for_build_wheel(metadata_directory, config_settings)


def build_wheel(wheel_directory: str, config_settings: Settings = None, metadata_directory: str | None = None) -> str:
    """Build the wheel for this machine and return its file name."""
    compiler = build_compiler()
    with tempfile.TemporaryDirectory() as scratch:
        _keep_zig_cache_in(scratch)
        metadata = _metadata(Path(scratch))
        return wheel_for(Path(wheel_directory), Path.cwd(), metadata, compiler, sys.platform, local_wheel_tag()).name


def build_editable(
    wheel_directory: str, config_settings: Settings = None, metadata_directory: str | None = None
) -> str:
    """Compile the kernels into the checkout and return a wheel that only points to it."""
    root = Path.cwd()
    with tempfile.TemporaryDirectory() as scratch:
        _keep_zig_cache_in(scratch)
        native = root / "pmsmtool" / "_native"
        build_all(root / "pmsmtool", native, build_compiler(), force=True)
        build_page_module(root / "pmsmtool", native, force=True)
        metadata = _metadata(Path(scratch))
        pointer = {"__editable__.pmsmtool.pth": f"{root}\n".encode()}
        return write_wheel(Path(wheel_directory), metadata, "py3-none-any", pointer).name


def build_sdist(sdist_directory: str, config_settings: Settings = None) -> str:
    """Write the source archive and return its file name."""
    root = Path.cwd()
    with tempfile.TemporaryDirectory() as scratch:
        metadata = _metadata(Path(scratch))
        name = metadata.name.removesuffix(".dist-info")
        return write_source_archive(Path(sdist_directory), name, metadata, source_files(root)).name


def wheel_for(
    folder: Path,
    root: Path,
    metadata: Path,
    compiler: Compiler,
    platform: str,
    platform_tag: str,
    *,
    strict: bool = False,
) -> Path:
    """Build the wheel of one platform from the checkout ``root`` with a compiler for that platform."""
    with tempfile.TemporaryDirectory() as scratch:
        built = build_all(root / "pmsmtool", Path(scratch), compiler, platform=platform, strict=strict)
        built += build_page_module(root / "pmsmtool", Path(scratch), strict=strict)
        files: dict[str, Path | bytes] = {**package_files(root)}
        files |= {f"pmsmtool/_native/{library.name}": library for library in built}
        return write_wheel(folder, metadata, f"py3-none-{platform_tag}", files)


def _keep_zig_cache_in(scratch: str) -> None:
    """Leave nothing in the home of the person who installs (it may even be read-only); this process ends soon."""
    for name in ("ZIG_GLOBAL_CACHE_DIR", "ZIG_LOCAL_CACHE_DIR"):
        os.environ.setdefault(name, os.path.join(scratch, "zig"))


def _metadata(scratch: Path) -> Path:
    return scratch / prepare_metadata_for_build_wheel(str(scratch))
