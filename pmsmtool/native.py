# SPDX-License-Identifier: MIT
"""Find and load the compiled kernels: plain shared libraries, no ``Python.h``, one file for all Pythons."""

from __future__ import annotations

import ctypes
import functools
import sys
from pathlib import Path

from pmsmtool.errors import PmsmtoolError

LIBRARY_FOLDER = Path(__file__).parent / "_native"
"""Where the wheel carries the kernels and where ``build_kernels`` puts them in a checkout."""

PAGE_MODULE = "pmsm_page.wasm"
"""Core, application and machine as WebAssembly, for the page of a report; beside the kernels."""

_SUFFIX = {"win32": "dll", "darwin": "dylib"}


def library_name(kernel: str, platform: str = sys.platform) -> str:
    """Return the file name of a kernel on a platform (spelled as ``sys.platform``)."""
    return f"lib{kernel}.{_SUFFIX.get(platform, 'so')}"


def page_module() -> bytes | None:
    """Return the WebAssembly module of the report's page; None where the build had no ziglang to make it."""
    path = LIBRARY_FOLDER / PAGE_MODULE
    return path.read_bytes() if path.is_file() else None


@functools.cache
def load(name: str) -> ctypes.CDLL:
    """Load a kernel, once per process.

    Parameters
    ----------
    name : str
        ``pmsm_core``, ``pmsm_core_f64``, ``pmsm_sim`` or ``pmsm_design`` (``packaging/kernels.py``).

    Raises
    ------
    PmsmtoolError
        The library is not there, or the system refuses to load it.
    """
    path = LIBRARY_FOLDER / library_name(name)
    if not path.is_file():
        raise PmsmtoolError(
            f"the compiled kernel {name} is missing",
            where=str(path),
            likely="the C sources were never built in this checkout, or the installation is damaged",
            hint="in a checkout: python -m pmsmtool.packaging.build_kernels; otherwise install pmsmtool again",
        )
    try:
        return ctypes.CDLL(str(path))
    except OSError as error:
        raise PmsmtoolError(
            f"the compiled kernel {name} cannot be loaded: {error}",
            where=str(path),
            likely="it was built for another machine, or for a newer C library",
            hint="install pmsmtool again on this machine (pip install --force-reinstall --no-deps)",
        ) from error
