# SPDX-License-Identifier: MIT
"""Platforms a wheel is built for, and the platform this Python runs on."""

from __future__ import annotations

import platform
import re
import sys
import sysconfig
from dataclasses import dataclass


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
