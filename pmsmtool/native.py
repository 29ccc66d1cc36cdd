# SPDX-License-Identifier: MIT
"""Find and load the compiled kernels: plain shared libraries, no ``Python.h``, one file for all Pythons.

Structs that Python shares with them follow the C declarations word for word (:func:`parse_structs`), so a member added
to a header is a member here.
"""

from __future__ import annotations

import ctypes
import functools
import re
import sys
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

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

    Raises PmsmtoolError: the library is not there, or the system refuses to load it.

    Parameters
    ----------
    name : str
        ``pmsm_core``, ``pmsm_core_f64``, ``pmsm_sim`` or ``pmsm_design`` (``packaging/compiler.py``).
    """
    path = LIBRARY_FOLDER / library_name(name)
    if not path.is_file():
        raise PmsmtoolError(
            f"the compiled kernel {name} is missing",
            where=str(path),
            likely="Python was started in the folder of the sources, which hides the installed pmsmtool",
            hint="start Python in another folder; or build it here: python -m pmsmtool.packaging.build_kernels",
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


CType = Any
"""A ctypes type: a simple type, or a Structure subclass."""

_SCALARS: dict[str, CType] = {
    "uint8_t": ctypes.c_uint8,
    "uint32_t": ctypes.c_uint32,
    "int32_t": ctypes.c_int32,
    "uint64_t": ctypes.c_uint64,
    "float": ctypes.c_float,
    "double": ctypes.c_double,
}
_COMMENT = re.compile(r"/\*.*?\*/", re.DOTALL)
_MACRO = re.compile(r"^#define\s+(\w+)\s+(0x[0-9A-Fa-f]+|\d+)u?\s*(?:/\*.*)?$", re.MULTILINE)
_STRUCT = re.compile(r"typedef\s+struct\s*\w*\s*\{([^{}]*)\}\s*(\w+)\s*;")
_DECLARATOR = re.compile(r"(\w+)\s*(?:\[\s*(\w+)\s*\])?$")


def _fields(body: str, types: Mapping[str, CType], sizes: Mapping[str, int]) -> list[tuple[str, CType]]:
    fields: list[tuple[str, CType]] = []
    for declaration in filter(None, (part.strip() for part in body.split(";"))):
        kind, rest = declaration.removeprefix("const ").split(None, 1)
        for declarator in rest.split(","):
            if declarator.strip().startswith("*"):
                fields.append((declarator.strip()[1:], types.get(f"{kind}*", types["*"])))
                continue
            match = _DECLARATOR.match(declarator.strip())
            if match is None:
                raise PmsmtoolError(f"member {declarator.strip()!r} is not understood", where="C header")
            name, length = match.groups()
            if length is None:
                fields.append((name, types[kind]))
            else:
                count = sizes[length] if length in sizes else int(length.rstrip("u"))
                fields.append((name, types[kind] * count))
    return fields


def parse_structs(
    text: str,
    known: Mapping[str, CType] | None = None,
    *,
    names: Collection[str] | None = None,
    double: bool = False,
    pointer: CType = ctypes.c_void_p,
) -> dict[str, CType]:
    """Return a ctypes Structure for every ``typedef struct {...} name;`` of C header text.

    Parameters
    ----------
    text : str
        One header, or several in the order of their dependence. Members are scalars of fixed width, ``pmsm_real``,
        earlier structures, arrays of them with a literal or ``#define``d length, or pointers.
    known : mapping, optional
        Types the text refers to but does not define; ``name*`` is what stands for pointers to that type.
    names : collection of str, optional
        Structures that are wanted; default all.
    double : bool
        Whether ``pmsm_real`` is double (``PMSM_REAL_DOUBLE``).
    pointer : ctypes type
        What stands for a pointer: this computer's, or ``c_uint32`` for the layout on a 32-bit processor.

    Returns
    -------
    dict
        The types of ``known`` and of the text, by name.
    """
    sizes = {name: int(value, 0) for name, value in _MACRO.findall(text)}
    types: dict[str, CType] = {**_SCALARS, **(known or {})}
    types["pmsm_real"] = ctypes.c_double if double else ctypes.c_float
    types["*"] = pointer
    for body, name in _STRUCT.findall(_COMMENT.sub(" ", text)):
        if names is None or name in names:
            types[name] = type(name, (ctypes.Structure,), {"_fields_": _fields(body, types, sizes)})
    return types
