# SPDX-License-Identifier: MIT
"""The control core from Python: ctypes structures read from the core's own headers, and the loaded libraries.

``struct pmsm_params`` is the generated one, in catalogue order.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pmsmtool.firmware.image import pack_image
from pmsmtool.native import CType, load, parse_structs

HEADER_FOLDER = Path(__file__).parent / "core"
APPLICATION_HEADER = Path(__file__).parent / "application" / "pmsm_application.h"
CORE_HEADERS = ("pmsm_types.h", "pmsm_params.h", "pmsm_core.h", "pmsm_projection.h")


@dataclass(frozen=True, slots=True)
class CoreBinding:
    """A loaded core and its types."""

    library: ctypes.CDLL
    """``pmsm_core`` (float) or ``pmsm_core_f64`` (double), with argument types set."""
    types: Mapping[str, CType]
    """``pmsm_params``, ``pmsm_state``, ``pmsm_measurement``, ``pmsm_reference``, ``pmsm_output``, ..."""

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

    Raises PmsmtoolError: the compiled library is missing or does not load.
    """
    return _bind(double)


@functools.cache
def _bind(double: bool) -> CoreBinding:
    return bind(load("pmsm_core_f64" if double else "pmsm_core"), double=double)
