# SPDX-License-Identifier: MIT
"""The table as the drive uses it: stored numbers, the error between its nodes, and a grid that keeps it in bounds.

A table is exact at its nodes and linear between them; over the kinks where another limit takes over the currents
bend, and linear interpolation misses torque and overshoots limits. The error is measured with the numbers as stored
(binary32, or int16 times a step) on points inside every cell, and axes are refined where it is largest.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.design.lookup.table import LookupTable, torque_limits
from pmsmtool.design.operating_machine import design_library
from pmsmtool.errors import DesignInfeasible
from pmsmtool.params.catalogue import LUT_CAPACITY_WORDS
from pmsmtool.units import RPM_PER_RAD_S

StoredFormat = Literal["float32", "int16"]

POINTS_PER_INTERVAL = 16
"""Points per interval and axis at which the error is measured."""

SEARCH_POINTS = 5
"""The same while a table over three axes is refined: 16^3 points of every cell are taken of the last grid only."""

BOUND_SAFETY = 1.1
"""The reported bound over the largest error measured: peaks between the points (measured: at most 1.034)."""

INT16_LARGEST = 32767
"""Full scale of a stored current; -32768 says that a cell has no point."""

AXIS_NODES_MAX, VOLTAGES_MAX = 255, 16
"""Nodes of an axis in the drive (``lut.n_x`` is one byte), and of its DC-link voltages (``lut.n_z``)."""

Axes = tuple[Array, Array, Array]
"""Torque (N m), speed (rpm) or flux (Wb), DC-link voltage (V)."""


@dataclass(frozen=True, slots=True)
class InterpolationError:
    """Largest errors of a stored table between its nodes, each a bound (``BOUND_SAFETY`` included)."""

    torque_nm: float
    """|torque of the interpolated currents - nearest admissible torque| (N m)."""
    voltage_v: float
    """Voltage beyond the limit (V; Wb for a flux table); 0 when it is never exceeded."""
    current_a: float
    """Current beyond I_max (A); 0 when it is never exceeded."""
    holes: int
    """Cells with a corner without a point; the bounds hold outside them only as far as points exist."""


def stored_axes(*axes: Array) -> tuple[Array, ...]:
    """Round axes to binary32, as the drive holds them."""
    return tuple(axis.astype(np.float32).astype(np.float64) for axis in axes)


def lsb_a(table: LookupTable) -> float:
    """Return the int16 step (A) that spans the table's currents, a binary32 number."""
    return int16_step_a(table.i_d_a, table.i_q_a)


def int16_step_a(*currents: Array) -> float:
    """Return the int16 step (A) that spans currents; the same for those it has rounded."""
    largest = max(float(np.nanmax(np.abs(t), initial=0.0)) for t in currents)
    step = np.float32(max(largest, 1e-6) / INT16_LARGEST)
    return float(step if float(step) * INT16_LARGEST >= largest else np.nextafter(step, np.float32(np.inf)))


def as_stored(table: LookupTable, stored: StoredFormat) -> LookupTable:
    """Return the table with the currents the drive will read back; torque and margins follow them."""
    if stored == "float32":
        currents = (t.astype(np.float32).astype(np.float64) for t in (table.i_d_a, table.i_q_a))
    else:
        step = lsb_a(table)
        currents = (np.rint(t / step) * step for t in (table.i_d_a, table.i_q_a))
    return table.with_currents(*currents)


def cell_errors(table: LookupTable, points: int = POINTS_PER_INTERVAL) -> Array:
    """Measure a stored table between its nodes.

    Returns
    -------
    ndarray, shape (n_x - 1, n_y - 1, 3, 3)
        Between nodes of torque only, of speed only, inside the cell; each torque error (N m), voltage and current
        beyond the limit (negative: below), as ``pmsm_lookup_error`` says.
    """
    worst = np.empty((table.torque_nm.size - 1, table.y.size - 1, 3, 3))
    speed = table.axis_kind == "speed"
    per_y = ctypes.c_double(table.machine.pole_pairs / RPM_PER_RAD_S)
    plane = table.machine.as_struct(table.I_max_apk, table.i_d_min_a)
    if not speed:
        plane.R = 0.0
    range_nm = _fine_limits(table, points)
    x, y, z = (np.ascontiguousarray(a) for a in (table.torque_nm, table.y, table.U_dc_v))
    limit = np.ascontiguousarray(table.V_max_v)
    i_d, i_q = np.ascontiguousarray(table.i_d_a), np.ascontiguousarray(table.i_q_a)
    design_library().pmsm_lookup_error(
        ctypes.byref(plane), x.size, x.ctypes.data, y.size, y.ctypes.data, ctypes.addressof(per_y) if speed else None,
        z.size, z.ctypes.data, limit.ctypes.data if speed else None, i_d.ctypes.data, i_q.ctypes.data, points,
        range_nm.ctypes.data, worst.ctypes.data,
    )  # fmt: skip
    return worst


def _fine(axis: Array, points: int) -> Array:
    if axis.size < 2:
        return axis
    share = np.arange(points) / points
    inner = axis[:-1, None] + np.diff(axis)[:, None] * share
    return np.append(inner.ravel(), axis[-1])


def _fine_limits(table: LookupTable, points: int) -> Array:
    """Least and largest torque at the fine nodes of y and z, shape (f_y, f_z, 2)."""
    y = _fine(table.y, points)
    if table.axis_kind == "flux":
        bounds = torque_limits(replace(table.machine, R=0.0), [1.0], y, table.I_max_apk, table.i_d_min_a)
        return np.ascontiguousarray(np.stack((bounds.least_nm.T, bounds.largest_nm.T), axis=-1))
    omega = y * table.machine.pole_pairs / RPM_PER_RAD_S
    bounds = torque_limits(table.machine, omega, _fine(table.V_max_v, points), table.I_max_apk, table.i_d_min_a)
    return np.ascontiguousarray(np.stack((bounds.least_nm, bounds.largest_nm), axis=-1))


def interpolation_error(table: LookupTable) -> InterpolationError:
    """Return the bounds of a stored table (see :func:`as_stored`)."""
    return _bounds(table, cell_errors(table))


def _bounds(table: LookupTable, errors: Array) -> InterpolationError:
    worst = errors.max(axis=2)
    missing = np.asarray(np.isnan(table.i_d_a).any(axis=2))
    holes = missing[:-1, :-1] | missing[1:, :-1] | missing[:-1, 1:] | missing[1:, 1:]
    torque, voltage, current = (max(0.0, BOUND_SAFETY * float(worst[..., k].max())) for k in range(3))
    return InterpolationError(torque, voltage, current, int(holes.sum()))


@dataclass(frozen=True, slots=True)
class GridBounds:
    """What is asked of a grid."""

    torque_nm: float
    voltage_v: float
    """Largest error between the nodes."""
    stored: StoredFormat = "float32"
    """Number format in the drive. One of "float32", "int16"."""
    capacity_words: int = LUT_CAPACITY_WORDS
    """Four-byte words for axes and tables."""


def table_words(n_x: int, n_y: int, n_z: int, stored: StoredFormat) -> int:
    """Return the words of axes and tables in the drive."""
    cells = n_x * n_y * n_z
    return n_x + n_y + n_z + 2 * (cells if stored == "float32" else (cells + 1) // 2)


Solver = Callable[[Array, Array, Array], LookupTable]
"""Solve a table over torque, a second axis and DC-link voltages."""


def refined_table(
    solve: Solver, torque_nm: Array, y: Array, U_dc_v: Array, bounds: GridBounds
) -> tuple[LookupTable, InterpolationError]:
    """Refine the axes until the stored table keeps its bounds.

    Raises DesignInfeasible: the drive's memory is full before the bounds hold; the message names what was reached.

    Parameters
    ----------
    solve : callable
        Solves a table over all axes.
    torque_nm, y, U_dc_v : ndarray
        First axes; their nodes are kept. A single voltage stays single.
    bounds : GridBounds
        What is asked.
    """
    x, y, z = stored_axes(*(np.asarray(axis, dtype=np.float64) for axis in (torque_nm, y, U_dc_v)))
    axes: Axes = (x, y, z)
    search = POINTS_PER_INTERVAL if z.size < 2 else SEARCH_POINTS
    for _ in range(_TURNS_MAX):
        table = as_stored(solve(*axes), bounds.stored)
        for points in dict.fromkeys((search, POINTS_PER_INTERVAL)):
            worst = cell_errors(table, points)
            error = _bounds(table, worst)
            if error.torque_nm > bounds.torque_nm or error.voltage_v > bounds.voltage_v:
                break
        else:
            return table, error
        finer = _split_voltages(table, axes, bounds) or _split(*axes, worst, bounds)
        if finer is None:
            break
        axes = finer
    error = interpolation_error(table)
    nodes = " x ".join(str(axis.size) for axis in (table.torque_nm, table.y, table.U_dc_v))
    raise DesignInfeasible(
        f"{nodes} nodes keep the torque within {error.torque_nm:.3g} N m and the "
        f"voltage within {error.voltage_v:.3g} V; asked for: {bounds.torque_nm:.3g} N m, {bounds.voltage_v:.3g} V",
        where=f"look-up table ({bounds.stored}, {bounds.capacity_words} words)",
        likely="the drive's memory for tables is full, or the admissible torque jumps within the range of speed",
        hint=f"ask for larger bounds{', take int16' if bounds.stored == 'float32' else ''}, or reduce the range of "
        "torque, speed or DC-link voltage",
    )


VOLTAGE_SHARE = 0.6
"""An interval of the voltages is split when its own error, at nodes of torque and speed, is this much of the bound."""

_BETWEEN = np.array([0.25, 0.5, 0.75])
"""Shares of an interval of the voltages at which that error is taken."""


def _split_voltages(table: LookupTable, axes: Axes, bounds: GridBounds) -> Axes | None:
    """Halve the intervals of the voltages that no other node of torque or speed could cure, where memory allows."""
    z = _halved(axes[2], np.array([e > VOLTAGE_SHARE for e in _voltage_excess(table, bounds)], dtype=np.bool_))
    words = table_words(axes[0].size, axes[1].size, z.size, bounds.stored)
    fits = axes[2].size < z.size <= VOLTAGES_MAX and words <= bounds.capacity_words
    return (axes[0], axes[1], z) if fits else None


def _voltage_excess(table: LookupTable, bounds: GridBounds) -> list[float]:
    """Largest error inside each interval of the voltages at the nodes of torque and speed, over what is asked."""
    found = []
    omega = table.y * table.machine.pole_pairs / RPM_PER_RAD_S
    for k in range(table.U_dc_v.size - 1):
        i_d, i_q = (
            currents[..., k, None] * (1.0 - _BETWEEN) + currents[..., k + 1, None] * _BETWEEN
            for currents in (table.i_d_a, table.i_q_a)
        )
        V = table.V_max_v[k] * (1.0 - _BETWEEN) + table.V_max_v[k + 1] * _BETWEEN
        reach = torque_limits(table.machine, omega, V, table.I_max_apk, table.i_d_min_a)
        torque = np.abs(table.machine.torque_nm(i_d, i_q) - reach.nearest(table.torque_nm[:, None, None]))
        over = table.machine.voltage_v(i_d, i_q, omega[None, :, None]) - V
        excess = np.maximum(torque / bounds.torque_nm, over / bounds.voltage_v)
        found.append(float(np.nanmax(excess, initial=0.0)))
    return found


def _excess(worst: Array, bounds: GridBounds) -> Array:
    return np.asarray(np.maximum(worst[..., 0] / bounds.torque_nm, worst[..., 1] / bounds.voltage_v))


_TURNS_MAX = 24
"""Refinements; 6 to 12 where the bound fits, the rest would fill the memory node by node."""

_SPLIT_SHARES = (0.5, 0.7, 0.85, 0.95, 1.0)
"""Intervals whose error is at least this share of the largest are split together; fewer where memory ends."""


def _split(x: Array, y: Array, z: Array, worst: Array, bounds: GridBounds) -> Axes | None:
    """Halve the intervals that matter, each along the axis whose interpolation alone is the worse one."""
    excess = _excess(worst, bounds)
    total = excess.max(axis=2)
    for share in _SPLIT_SHARES:
        cells = total >= max(1.0 / BOUND_SAFETY, share * float(total.max()))
        along_x = cells & (excess[..., 0] >= excess[..., 1])
        finer = _halved(x, along_x.any(axis=1)), _halved(y, (cells & ~along_x).any(axis=0))
        n_x, n_y = finer[0].size, finer[1].size
        fits = table_words(n_x, n_y, z.size, bounds.stored) <= bounds.capacity_words and max(n_x, n_y) <= AXIS_NODES_MAX
        if fits and n_x + n_y > x.size + y.size:
            return (*finer, z)
    return None


def _halved(axis: Array, split: NDArray[np.bool_]) -> Array:
    middle = 0.5 * (axis[:-1] + axis[1:])[split]
    return np.unique(np.concatenate((axis, stored_axes(middle)[0])))


def largest_speed_rpm(reachable: Callable[[float], bool], n_max_rpm: float) -> float:
    """Return the largest speed up to n_max that is reachable (rpm), a binary32 number.

    Parameters
    ----------
    reachable : callable
        Whether a speed (rpm) is.
    n_max_rpm : float
        Largest speed of interest (rpm).
    """
    if reachable(n_max_rpm):
        return n_max_rpm
    low, high = 0.0, n_max_rpm
    while high - low > 1e-9 * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if reachable(middle) else (low, middle)
    return float(np.nextafter(np.float32(low), np.float32(0.0)))
