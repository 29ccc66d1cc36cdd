# SPDX-License-Identifier: MIT
"""Tensor-product cells of a flux map: built in C, evaluated in numpy with the same operations as in C.

The layout and the continuation outside the table are those of ``flux_map.h``; the numpy evaluation here
is the reference a test can hand to an integrator, and gives the same bits as the C one.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pmsmtool import native
from pmsmtool.arrays import Array

Kind = Literal["bicubic", "bilinear"]
KINDS: dict[Kind, int] = {"bicubic": 0, "bilinear": 1}
"""Interpolation kinds and their number in C."""

NODES_MIN: dict[Kind, int] = {"bicubic": 4, "bilinear": 2}
"""Least nodes per axis: not-a-knot ends need four."""

OUTSIDE_I_D, OUTSIDE_I_Q, OUTSIDE_PSI, NOT_CONVERGED = 1, 2, 4, 8
"""Status bits of ``flux_map.h``."""

EQUIDISTANT_TOLERANCE = 1e-9
"""Deviation of a node, in steps, up to which an axis counts as equidistant (moves a value by 1e-9 of a
cell's change; ``numpy.linspace`` stays below 1e-13)."""

_STRUCTS = native.parse_structs(
    Path(__file__).with_name("flux_map.h").read_text(encoding="ascii"), {"double*": ctypes.POINTER(ctypes.c_double)}
)


class FluxMapStruct(ctypes.Structure):
    """``pmsm_flux_map``; the arrays it points to are kept alive in the attribute ``arrays``."""

    _fields_ = _STRUCTS["pmsm_flux_map"]._fields_
    arrays: tuple[Array, ...] = ()


@cache
def library() -> Any:
    """Return the shared library with the flux-map functions declared, its struct layout checked."""
    lib = native.load("pmsm_design")
    lib.pmsm_flux_map_size.restype = ctypes.c_uint32
    if lib.pmsm_flux_map_size() != ctypes.sizeof(FluxMapStruct):
        raise RuntimeError("struct pmsm_flux_map of the library differs from FluxMapStruct")
    data, integer, real, struct = ctypes.c_void_p, ctypes.c_int32, ctypes.c_double, ctypes.POINTER(FluxMapStruct)
    lib.pmsm_flux_map_fit.argtypes = (integer, integer, integer, data, integer, data, data, data, data)
    lib.pmsm_flux_map_fit.restype = None
    lib.pmsm_flux_map_invert.argtypes = (struct, real, integer, data, data, data)
    lib.pmsm_flux_map_invert.restype = integer
    lib.pmsm_flux_map_flux_many.argtypes = (struct, integer, data, data, data, data, data, data)
    lib.pmsm_flux_map_flux_many.restype = ctypes.c_uint32
    lib.pmsm_flux_map_current_many.argtypes = (struct, integer, data, data, data, data, data)
    lib.pmsm_flux_map_current_many.restype = ctypes.c_uint32
    lib.pmsm_flux_map_solve_many.argtypes = (struct, integer, data, data, real, integer, data, data, data)
    lib.pmsm_flux_map_solve_many.restype = ctypes.c_uint32
    return lib


def per_step(axis: Array) -> float:
    """Return 1/step of an equidistant axis, 0.0 for any other."""
    n = len(axis)
    even = axis[0] + (axis[-1] - axis[0]) * np.arange(n) / (n - 1)
    step = (axis[-1] - axis[0]) / (n - 1)
    return float(1.0 / step) if np.all(np.abs(axis - even) <= EQUIDISTANT_TOLERANCE * step) else 0.0


class Evaluation(NamedTuple):
    """What a table gives at points of any shape ``s``."""

    value: Array
    """The two quantities. Shape (2, *s)."""
    jacobian: Array
    """``jacobian[k, m]`` is the derivative of quantity k by argument m. Shape (2, 2, *s)."""
    outside: NDArray[np.bool_]
    """Whether argument m lies outside its axis (the value is the continuation). Shape (2, *s)."""


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """A table of two quantities over two axes, as cells."""

    axis_1: Array
    axis_2: Array
    """Increasing nodes. Shape (n_1,), (n_2,)."""
    cells: Array
    """``cells[m, n, b, a, k]``: coefficient of x^a y^b of quantity k in cell (m, n).
    Shape (n_1 - 1, n_2 - 1, 4, 4, 2)."""

    @classmethod
    def fit(cls, kind: Kind, axis_1: ArrayLike, axis_2: ArrayLike, values: tuple[ArrayLike, ArrayLike]) -> Table:
        """Interpolate two grids of shape (n_1, n_2); bicubic equals a not-a-knot tensor-product spline."""
        first, second = _contiguous(axis_1), _contiguous(axis_2)
        cells = np.zeros((len(first) - 1, len(second) - 1, 4, 4, 2))
        work = np.empty(3 * len(first) * len(second) + 2 * max(len(first), len(second)))
        for k, value in enumerate(values):
            grid = _contiguous(value)
            library().pmsm_flux_map_fit(
                KINDS[kind], k, len(first), first.ctypes.data, len(second), second.ctypes.data,
                grid.ctypes.data, work.ctypes.data, cells.ctypes.data,
            )  # fmt: skip
        return cls(first, second, cells)

    def evaluate(self, argument_1: ArrayLike, argument_2: ArrayLike) -> Evaluation:
        """Evaluate at points, by the operations of ``flux_map.c`` in their order."""
        first, second = np.broadcast_arrays(np.asarray(argument_1, float), np.asarray(argument_2, float))
        p, q = _place(self.axis_1, first), _place(self.axis_2, second)
        c = np.moveaxis(self.cells[p.k, q.k], (-3, -2, -1), (0, 1, 2))
        r = ((c[3] * q.x + c[2]) * q.x + c[1]) * q.x + c[0]
        s = (3.0 * c[3] * q.x + 2.0 * c[2]) * q.x + c[1]
        value = ((r[3] * p.x + r[2]) * p.x + r[1]) * p.x + r[0]
        f_1 = ((3.0 * r[3] * p.x + 2.0 * r[2]) * p.x + r[1]) * p.per_h
        f_2 = (((s[3] * p.x + s[2]) * p.x + s[1]) * p.x + s[0]) * q.per_h
        f_12 = ((3.0 * s[3] * p.x + 2.0 * s[2]) * p.x + s[1]) * p.per_h * q.per_h
        outside = np.array([p.beyond != 0.0, q.beyond != 0.0])
        beyond = outside.any(axis=0)
        value = np.where(beyond, value + (f_1 * p.beyond + f_2 * q.beyond + f_12 * p.beyond * q.beyond), value)
        f_1, f_2 = f_1 + np.where(beyond, f_12 * q.beyond, 0.0), f_2 + np.where(beyond, f_12 * p.beyond, 0.0)
        return Evaluation(value, np.stack([f_1, f_2], axis=1), outside)


class _Place(NamedTuple):
    """Cell, place inside it, 1/width, and signed distance outside the axis."""

    k: NDArray[np.intp]
    x: Array
    per_h: Array
    beyond: Array


def _place(axis: Array, v: Array) -> _Place:
    n, rate = len(axis), per_step(axis)
    if rate > 0.0:
        t = (v - axis[0]) * rate
        border = np.where(t > n - 1, n - 1.0, 0.0)
        inside = (t >= 0.0) & (t <= n - 1)
        beyond = np.where(inside, 0.0, (t - border) / rate)
        t = np.where(inside, t, border)
        k = np.minimum(t.astype(np.intp), n - 2)
        return _Place(k, t - k, np.full(v.shape, rate), beyond)
    inside = (v >= axis[0]) & (v <= axis[-1])
    border = np.where(v > axis[-1], axis[-1], axis[0])
    beyond = np.where(inside, 0.0, v - border)
    v = np.where(inside, v, border)
    k = np.clip(np.searchsorted(axis, v, side="right") - 1, 0, n - 2)
    width = 1.0 / (axis[k + 1] - axis[k])
    return _Place(k, (v - axis[k]) * width, width, beyond)


def _contiguous(values: ArrayLike) -> Array:
    return np.ascontiguousarray(values, dtype=np.float64)


def pointer(array: Array) -> Any:
    """Return a C pointer to the doubles of a contiguous array."""
    return array.ctypes.data_as(ctypes.POINTER(ctypes.c_double))
