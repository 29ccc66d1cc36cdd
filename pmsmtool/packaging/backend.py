# SPDX-License-Identifier: MIT
"""The build backend (PEP 517, PEP 660) of this package.

setuptools makes the metadata out of ``pyproject.toml``; this module adds what it cannot do: a C compiler that
is required only where none works, plain shared libraries in a wheel that fits every Python
(``py3-none-<platform>``), and the data folders from beside the package. It writes nothing into the source tree
but the kernels of an editable installation.
"""

from __future__ import annotations

import os
import sys
import tempfile
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pmsmtool.packaging import wheel
from pmsmtool.packaging.build_kernels import build_all, build_page_module
from pmsmtool.packaging.compiler import Compiler, build_compiler, system_compiler
from pmsmtool.packaging.kernels import here, local_wheel_tag

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
        return wheel.write_wheel(Path(wheel_directory), metadata, "py3-none-any", pointer).name


def build_sdist(sdist_directory: str, config_settings: Settings = None) -> str:
    """Write the source archive and return its file name."""
    root = Path.cwd()
    with tempfile.TemporaryDirectory() as scratch:
        metadata = _metadata(Path(scratch))
        name = metadata.name.removesuffix(".dist-info")
        return wheel.write_source_archive(Path(sdist_directory), name, metadata, wheel.source_files(root)).name


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
        files: dict[str, Path | bytes] = {**wheel.package_files(root)}
        files |= {f"pmsmtool/_native/{library.name}": library for library in built}
        return wheel.write_wheel(folder, metadata, f"py3-none-{platform_tag}", files)


def _keep_zig_cache_in(scratch: str) -> None:
    """Leave nothing in the home of the person who installs (it may even be read-only); this process ends soon."""
    for name in ("ZIG_GLOBAL_CACHE_DIR", "ZIG_LOCAL_CACHE_DIR"):
        os.environ.setdefault(name, os.path.join(scratch, "zig"))


def _metadata(scratch: Path) -> Path:
    return scratch / prepare_metadata_for_build_wheel(str(scratch))
