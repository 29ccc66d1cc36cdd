# SPDX-License-Identifier: MIT
"""The list of compiled kernels: what is built from which sources. To add a kernel, add a row.

Platforms a wheel is built for, and the platform this Python runs on.
"""

from __future__ import annotations

import platform
import re
import sys
import sysconfig
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Kernel:
    """One shared library.

    Attributes
    ----------
    name : str
        Library name without prefix and suffix; what ``native.load`` takes.
    sources : tuple of str
        Globs relative to the package folder. A glob that matches nothing adds nothing.
    defines : tuple of str
        Preprocessor symbols besides :data:`COMMON_DEFINES`.
    without : tuple of str
        Sources that are left out.
    """

    name: str
    sources: tuple[str, ...]
    defines: tuple[str, ...] = ()
    without: tuple[str, ...] = ()

    def source_files(self, package: Path) -> list[Path]:
        """Return the sources relative to ``package``, each once, in a fixed order."""
        found = {path.relative_to(package) for pattern in self.sources for path in package.glob(pattern)}
        return sorted(path for path in found if path.as_posix() not in self.without)


_CORE = "firmware/core/*.c"
SIMULATION = ("sim/*.c", "machine/*.c", "firmware/application/*.c", _CORE)
"""The simulated drive and its machine."""

KERNELS: tuple[Kernel, ...] = (
    Kernel("pmsm_core", (_CORE,)),
    Kernel("pmsm_core_f64", (_CORE,), ("PMSM_REAL_DOUBLE",)),
    Kernel("pmsm_sim", SIMULATION),
    Kernel("pmsm_design", ("design/lookup/*.c", "machine/*.c")),
)

INCLUDE_FOLDERS: tuple[str, ...] = ("firmware/core", "firmware/application", "machine", "sim", "design/lookup")
"""Searched for quoted includes only, so that no header here can hide one of the C library."""

HEADERS: tuple[str, ...] = tuple(f"{folder}/*.h" for folder in INCLUDE_FOLDERS)

COMMON_DEFINES: tuple[str, ...] = ("PMSM_SHARED",)
"""``PMSM_EXPORT`` becomes visibility or ``__declspec(dllexport)`` (``firmware/core/pmsm_types.h``)."""

COMPILE_FLAGS: tuple[str, ...] = (
    "-std=c99",
    "-O3",
    # The same bits on every platform: no fused multiply-add, no reassociation (-O3 without -ffast-math keeps order).
    "-ffp-contract=off",
    # Lets sqrt be one instruction; changes no value.
    "-fno-math-errno",
    "-fvisibility=hidden",
)

WARNING_FLAGS: tuple[str, ...] = (
    "-Wall",
    "-Wextra",
    "-Wshadow",
    "-Wdouble-promotion",
    "-Wfloat-conversion",
    "-Werror",
)
"""For development and release builds; ``pip install`` must not fail on a warning a later compiler invents."""


def is_current(library: Path, kernel: Kernel, package: Path) -> bool:
    """Return whether a compiled file is newer than its sources, all headers and the build rules."""
    if not library.is_file():
        return False
    inputs = [package / source for source in kernel.source_files(package)]
    inputs += [path for pattern in HEADERS for path in package.glob(pattern)]
    inputs += Path(__file__).parent.glob("*.py")
    return library.stat().st_mtime > max(path.stat().st_mtime for path in inputs)


@dataclass(frozen=True, slots=True)
class Target:
    """One platform.

    Attributes
    ----------
    name : str
        Name on the command line of ``cross_wheels``.
    platform : str
        As ``sys.platform``; decides the library's file name.
    machine : str
        ``x86_64`` or ``aarch64``, as the library's header says it.
    zig : str
        Target triple of zig; with the oldest C library (Linux) or system (macOS) that must run it.
    wheel_tag : str
        Platform tag of the wheel (PEP 425, PEP 600).
    """

    name: str
    platform: str
    machine: str
    zig: str
    wheel_tag: str


TARGETS: tuple[Target, ...] = (
    Target("linux-x86_64", "linux", "x86_64", "x86_64-linux-gnu.2.17", "manylinux_2_17_x86_64"),
    Target("linux-aarch64", "linux", "aarch64", "aarch64-linux-gnu.2.17", "manylinux_2_17_aarch64"),
    Target("windows-x86_64", "win32", "x86_64", "x86_64-windows-gnu", "win_amd64"),
    Target("macos-x86_64", "darwin", "x86_64", "x86_64-macos.11.0", "macosx_11_0_x86_64"),
    Target("macos-arm64", "darwin", "aarch64", "aarch64-macos.11.0", "macosx_11_0_arm64"),
)

_MACHINE = {"amd64": "x86_64", "arm64": "aarch64"}


def here() -> Target | None:
    """Return the row of :data:`TARGETS` this Python can load, None for any other platform."""
    machine = platform.machine().lower()
    machine = _MACHINE.get(machine, machine)
    if sys.platform == "linux" and (platform.libc_ver()[0] != "glibc" or sys.maxsize < 2**32):
        return None
    matching = (row for row in TARGETS if (row.platform, row.machine) == (sys.platform, machine))
    return next(matching, None)


def local_wheel_tag() -> str:
    """Return the platform tag of a wheel that is built here for here."""
    if sys.platform == "darwin":
        # get_platform() names the interpreter, which may be universal; the library has one architecture.
        return f"macosx_11_0_{platform.machine()}"
    return re.sub(r"[^A-Za-z0-9_]", "_", sysconfig.get_platform())
