# SPDX-License-Identifier: MIT
"""The control core from Python: ctypes structures read from the core's own headers, and the loaded libraries.

The structures follow the C declarations word for word (:func:`parse_structs`), so a member added to a header is a
member here. ``struct pmsm_params`` is the generated one, in catalogue order.
"""

from __future__ import annotations

import ctypes
import functools
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pmsmtool.errors import PmsmtoolError
from pmsmtool.firmware.image import pack_image
from pmsmtool.native import load

HEADER_FOLDER = Path(__file__).parent / "core"
APPLICATION_HEADER = Path(__file__).parent / "application" / "pmsm_application.h"
CORE_HEADERS = ("pmsm_types.h", "pmsm_params.h", "pmsm_core.h", "pmsm_projection.h")

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
                fields.append((declarator.strip()[1:], types["*"]))
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
    text: str, known: Mapping[str, CType] | None = None, *, double: bool = False, pointer: CType = ctypes.c_void_p
) -> dict[str, CType]:
    """Return a ctypes Structure for every ``typedef struct {...} name;`` of C header text.

    Parameters
    ----------
    text : str
        One header, or several in the order of their dependence. Members are scalars of fixed width, ``pmsm_real``,
        earlier structures, arrays of them with a literal or ``#define``d length, or pointers.
    known : mapping, optional
        Types the text refers to but does not define.
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
        types[name] = type(name, (ctypes.Structure,), {"_fields_": _fields(body, types, sizes)})
    return types


@dataclass(frozen=True, slots=True)
class CoreBinding:
    """A loaded core and its types.

    Attributes
    ----------
    library : ctypes.CDLL
        ``pmsm_core`` (float) or ``pmsm_core_f64`` (double), with argument types set.
    types : mapping of str to ctypes type
        ``pmsm_params``, ``pmsm_state``, ``pmsm_measurement``, ``pmsm_reference``, ``pmsm_output``, ...
    """

    library: ctypes.CDLL
    types: Mapping[str, CType]

    def make(self, name: str, **members: Any) -> Any:
        """Return a new structure, zero but for the members given."""
        return self.types[name](**members)

    def params(self, values: Mapping[str, float], lut: bytes = b"") -> Any:
        """Return ``pmsm_params`` of a complete set of catalogue values; refuses what :func:`pack_image` refuses."""
        return self.types["pmsm_params"].from_buffer_copy(pack_image(values, lut))

    def state(self) -> Any:
        """Return an initialised ``pmsm_state``."""
        state = self.types["pmsm_state"]()
        self.library.pmsm_init(ctypes.byref(state))
        return state


_STEP_ARGUMENTS = ("pmsm_measurement", "pmsm_reference", "pmsm_output")


def _declare(library: ctypes.CDLL, types: Mapping[str, CType]) -> None:
    pointer = ctypes.POINTER
    u32, words, octets = ctypes.c_uint32, pointer(ctypes.c_uint32), ctypes.c_char_p
    params, state = pointer(types["pmsm_params"]), pointer(types["pmsm_state"])
    signatures: dict[str, tuple[CType, list[CType]]] = {
        "pmsm_init": (None, [state]),
        "pmsm_parameters_changed": (None, [state]),
        "pmsm_reset_fault": (None, [state]),
        "pmsm_step": (
            None,
            [state, params, words, *(pointer(types[name]) for name in _STEP_ARGUMENTS)],
        ),
        "pmsm_image_crc32": (u32, [octets, u32]),
        "pmsm_params_check": (u32, [params]),
        "pmsm_lut_words": (u32, [params]),
        "pmsm_image_check": (u32, [octets, u32, u32, u32, u32]),
        "pmsm_image_check_content": (u32, [octets, u32]),
        "pmsm_image_load": (u32, [octets, u32, params, words, u32]),
        "pmsm_image_store": (u32, [params, words, pointer(ctypes.c_uint8)]),
    }
    row, dq, steps = pointer(types["pmsm_row"]), types["pmsm_dq"], words
    signatures |= {
        "pmsm_row_voltage": (dq, [row, dq]),
        "pmsm_project_row": (dq, [row, dq, steps]),
        "pmsm_project_rows": (u32, [row, u32, dq, pointer(dq), words, steps]),
        "pmsm_smallest_voltage": (dq, [row, row, steps]),
        "pmsm_project_half_planes": (
            u32,
            [pointer(dq), pointer(types["pmsm_real"]), u32, dq, pointer(dq), words, steps],
        ),
    }
    for name, (result, arguments) in signatures.items():
        function = getattr(library, name)
        function.restype = result
        function.argtypes = arguments


def bind(library: ctypes.CDLL, *, double: bool = False) -> CoreBinding:
    """Return a binding of a loaded library that contains the core, for instance one compiled from an export."""
    text = "\n".join((HEADER_FOLDER / name).read_text(encoding="ascii") for name in CORE_HEADERS)
    types = parse_structs(text, double=double)
    _declare(library, types)
    return CoreBinding(library, types)


def core(*, double: bool = False) -> CoreBinding:
    """Load the core, as flashed (float) or in double.

    Raises
    ------
    PmsmtoolError
        The compiled library is missing or does not load.
    """
    return _bind(double)


@functools.cache
def _bind(double: bool) -> CoreBinding:
    return bind(load("pmsm_core_f64" if double else "pmsm_core"), double=double)
