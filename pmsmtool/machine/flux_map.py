# SPDX-License-Identifier: MIT
"""Flux map of a saturated machine: grids of psi(i), and the two tables everything evaluates.

The machine of a map is *the map plus its interpolation*. Two tables are built, once per map
(``flux_map.h`` has their arithmetic):

* forward, psi(i): an interpolating bicubic (or bilinear) table through the grid. Design, look-up tables, checks and
  inductances use it.
* inverse, i(psi): a table of the same kind over an equidistant grid of fluxes, whose nodes are solved on the
  forward table. **The simulated machine is this table**; ``FluxTables.inverse_error_a`` states how far it is
  from the forward one.

Both kinds, the node counts and the error are part of the map's metadata and of its hash.

A flux map as another machine of the same kind has it: other inductances and another magnet, nothing fitted again.

psi_d' = k_psi psi_f + k_d (psi_d - psi_f), psi_q' = k_q psi_q. The inverse table i(psi), which is the simulated
machine, holds polynomials over normalised cells: stretching its flux axes is the scaled machine exactly, and all
machines share the cells. Of the forward table a simulation asks only for the flux without current and for the smallest
inductance; it is replaced by one cell with just these.
"""

from __future__ import annotations

import ctypes
import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pmsmtool.arrays import Array
from pmsmtool.errors import ConfigError
from pmsmtool.machine.flux_map_cells import (
    KINDS,
    NODES_MIN,
    FluxMapStruct,
    Kind,
    Table,
    library,
    per_step,
    pointer,
)
from pmsmtool.machine.torque import air_gap_torque

NODES_MAX = 1 << 19
"""Of each of the two tables: 724 x 724, 130 MB of cells."""
INVERSE_NODES = (129, 129)
"""Flux nodes of the inverse table unless the map states otherwise: 4 MB of cells, built in 20 ms."""

INVERSE_MARGIN = 0.01
"""The inverse table reaches beyond the fluxes of the grid by this share of their range."""

NEWTON_TOLERANCE = 1e-13
"""Residual of an inverse node relative to the largest flux (rounding leaves 3e-16)."""

NEWTON_STEPS = 60
"""Cap of Newton steps per node; 4 are usual from a neighbour."""

CHECK_POINTS = 3
"""Points per cell and axis at which a map's Jacobian is looked at."""


@dataclass(frozen=True, eq=False)  # no slots: the built tables are cached on the instance
class FluxMap:
    """Flux linkages over a grid of currents (amplitude-invariant, rotor frame, d axis along the magnets).

    Raises ConfigError: shapes that do not fit, an axis that does not increase, too few nodes, or holes.
    """

    i_d_a: Array
    i_q_a: Array
    """Increasing axes (A peak). Shape (n_d,), (n_q,)."""
    psi_d_wb: Array
    psi_q_wb: Array
    """Flux linkages (Wb peak), finite. Shape (n_d, n_q)."""
    kind: Kind = "bicubic"
    """Interpolation of both tables. One of "bicubic", "bilinear"."""
    inverse_nodes: tuple[int, int] = INVERSE_NODES
    """Nodes of the inverse table along psi_d and psi_q."""
    meta: Mapping[str, Any] = field(default_factory=dict)
    """JSON-serialisable facts: origin, what was repaired."""

    def __post_init__(self) -> None:
        violations = _violations(self)
        if violations:
            raise ConfigError("the flux map is not usable", violations=violations)

    def __getstate__(self) -> dict[str, Any]:
        """Leave the built tables behind when sent to another process: they hold addresses, and are built again."""
        return {item.name: getattr(self, item.name) for item in fields(self)}

    @property
    def shape(self) -> tuple[int, int]:
        """Nodes along i_d and i_q."""
        return len(self.i_d_a), len(self.i_q_a)

    @cached_property
    def forward(self) -> Table:
        """The forward table psi(i)."""
        return Table.fit(self.kind, self.i_d_a, self.i_q_a, (self.psi_d_wb, self.psi_q_wb))

    @cached_property
    def tables(self) -> FluxTables:
        """Both tables; building them needs an invertible map (``ConfigError`` names the cells)."""
        return _build(self)

    def as_struct(self, *, inverse: bool = True) -> FluxMapStruct:
        """Return ``pmsm_flux_map`` for the C kernels; it keeps its arrays alive.

        ``inverse=False`` leaves the inverse table out, which design does not need.
        """
        return self.tables.struct if inverse else _forward_struct(self)

    def flux(self, i_d_a: ArrayLike, i_q_a: ArrayLike) -> tuple[Array, Array]:
        """Return psi_d, psi_q (Wb) of the forward table at currents (A peak) of any shape."""
        value = self.forward.evaluate(i_d_a, i_q_a).value
        return value[0], value[1]

    def incremental_inductance(self, i_d_a: ArrayLike, i_q_a: ArrayLike) -> Array:
        """Return the Jacobian d psi/d i (H), shape (2, 2, ...): what current control sees."""
        return self.forward.evaluate(i_d_a, i_q_a).jacobian

    def apparent_inductance(self, i_d_a: ArrayLike, i_q_a: ArrayLike) -> tuple[Array, Array]:
        """Return L_d_app = (psi_d - psi_f)/i_d and L_q_app = psi_q/i_q (H), what torque and decoupling see.

        psi_f is psi_d at zero current, so that psi_f + L_d_app i_d and L_q_app i_q are the fluxes of the map at that
        very point (cross-saturation makes L_d_app meaningless near i_d = 0). At zero current of an axis the
        incremental one is given.
        """
        i_d, i_q = np.broadcast_arrays(np.asarray(i_d_a, float), np.asarray(i_q_a, float))
        psi_f = self.flux(0.0, 0.0)[0]
        psi, jac = self.forward.evaluate(i_d, i_q).value, self.incremental_inductance(i_d, i_q)
        with np.errstate(divide="ignore", invalid="ignore"):
            return (
                np.where(i_d == 0, jac[0, 0], (psi[0] - psi_f) / i_d),
                np.where(i_q == 0, jac[1, 1], psi[1] / i_q),
            )

    def current(self, psi_d_wb: ArrayLike, psi_q_wb: ArrayLike) -> tuple[Array, Array]:
        """Return i_d, i_q (A peak) of the inverse table, the simulated machine, at fluxes of any shape."""
        value = self.tables.inverse.evaluate(psi_d_wb, psi_q_wb).value
        return value[0], value[1]

    def torque_nm(self, pole_pairs: int, i_d_a: ArrayLike, i_q_a: ArrayLike) -> Array:
        """Return 1.5 p (psi_d i_q - psi_q i_d) (N m) on the forward table."""
        psi_d, psi_q = self.flux(i_d_a, i_q_a)
        return air_gap_torque(pole_pairs, psi_d, psi_q, np.asarray(i_d_a, float), np.asarray(i_q_a, float))

    def content_hash(self) -> str:
        """Return the SHA-256 of axes, fluxes, kind and inverse nodes: what decides the machine."""
        digest = hashlib.sha256(f"{self.kind} {self.inverse_nodes[0]}x{self.inverse_nodes[1]}\n".encode())
        for array in (self.i_d_a, self.i_q_a, self.psi_d_wb, self.psi_q_wb):
            digest.update(str(array.shape).encode())
            digest.update(np.ascontiguousarray(array, dtype="<f8").tobytes())
        return digest.hexdigest()

    def with_meta(self, **facts: Any) -> FluxMap:
        """Return a copy with more metadata."""
        return replace(self, meta={**self.meta, **facts})

    def interpolation(self) -> str:
        """Return one line that says what this map means between its nodes, for results and reports."""
        tables = f"{self.shape[0]} x {self.shape[1]} nodes"
        inverse = f"{self.inverse_nodes[0]} x {self.inverse_nodes[1]} flux nodes"
        return f"{self.kind} psi(i) on {tables}, {self.kind} i(psi) on {inverse}"


@dataclass(frozen=True, eq=False, slots=True)
class FluxTables:
    """The built tables of a map."""

    inverse: Table
    """i(psi)."""
    struct: FluxMapStruct
    """psi(i) and i(psi) for C."""
    inverse_error_a: float
    """Largest |i(psi(i)) - i| (A) over the nodes and the cell centres of the map."""
    inverse_error_rms_a: float
    """Its root mean square (A)."""


def _violations(flux_map: FluxMap) -> list[str]:
    found: list[str] = []
    if flux_map.kind not in KINDS:
        return [f"kind is {flux_map.kind!r}, allowed are {', '.join(KINDS)}"]
    least = NODES_MIN[flux_map.kind]
    for name, axis in (("i_d_a", flux_map.i_d_a), ("i_q_a", flux_map.i_q_a)):
        if axis.ndim != 1 or len(axis) < least:
            found.append(
                f"axis {name} has shape {axis.shape}; {flux_map.kind} needs a vector of at least {least} nodes"
            )
        elif not np.all(np.isfinite(axis)):
            found.append(f"axis {name} holds values that are not finite")
        elif not np.all(np.diff(axis) > 0):
            at = int(np.argmin(np.diff(axis) > 0))
            found.append(f"axis {name} does not increase: {axis[at]:g} A is followed by {axis[at + 1]:g} A")
        elif not axis[0] <= 0.0 <= axis[-1]:
            found.append(f"axis {name} runs from {axis[0]:g} to {axis[-1]:g} A and leaves out zero current")
    shape = (len(flux_map.i_d_a), len(flux_map.i_q_a)) if not found else None
    for name, extent in (("the grid", shape or (0, 0)), ("inverse_nodes", flux_map.inverse_nodes)):
        if math.prod(extent) > NODES_MAX:
            found.append(f"{name} has {math.prod(extent)} nodes, at most {NODES_MAX} are taken")
    for name, grid in (("psi_d_wb", flux_map.psi_d_wb), ("psi_q_wb", flux_map.psi_q_wb)):
        if shape is not None and grid.shape != shape:
            found.append(f"{name} has shape {grid.shape}, the axes say {shape}")
        elif not np.all(np.isfinite(grid)):
            found.append(f"{name} has {int(np.sum(~np.isfinite(grid)))} holes (values that are not finite)")
    for nodes in flux_map.inverse_nodes:
        if not least <= nodes <= 4096:
            found.append(f"inverse_nodes is {nodes}, allowed are {least}..4096")
    return found


def _forward_struct(flux_map: FluxMap) -> FluxMapStruct:
    table = flux_map.forward
    struct = FluxMapStruct(
        i_d=pointer(table.axis_1),
        i_q=pointer(table.axis_2),
        cells=pointer(table.cells),
        i_d_per_step=per_step(table.axis_1),
        i_q_per_step=per_step(table.axis_2),
        n_i_d=len(table.axis_1),
        n_i_q=len(table.axis_2),
    )
    struct.arrays = (table.axis_1, table.axis_2, table.cells)
    return struct


def jacobian_samples(flux_map: FluxMap) -> tuple[Array, Array, Array]:
    """Return i_d, i_q, shape (n,), and the Jacobian, shape (2, 2, n), at CHECK_POINTS^2 points per cell."""
    share = np.arange(CHECK_POINTS) / CHECK_POINTS
    axes = []
    for axis in (flux_map.i_d_a, flux_map.i_q_a):
        inner = (axis[:-1, None] + np.diff(axis)[:, None] * share).ravel()
        axes.append(np.append(inner, axis[-1]))
    i_d, i_q = (grid.ravel() for grid in np.meshgrid(axes[0], axes[1], indexing="ij"))
    return i_d, i_q, _forward_in_c(_forward_struct(flux_map), i_d, i_q)[1]


def _forward_in_c(struct: FluxMapStruct, i_d: Array, i_q: Array) -> tuple[Array, Array]:
    """Fluxes (2, n) and Jacobian (2, 2, n) of many points: the bits of ``Table.evaluate``, without its temporaries."""
    psi, jac = np.empty((2, i_d.size)), np.empty((i_d.size, 2, 2))
    library().pmsm_flux_map_flux_many(
        ctypes.byref(struct), i_d.size, i_d.ctypes.data, i_q.ctypes.data, psi[0].ctypes.data, psi[1].ctypes.data,
        jac.ctypes.data, None,
    )  # fmt: skip
    return psi, np.moveaxis(jac, 0, 2)


def require_monotonic(flux_map: FluxMap) -> None:
    """Refuse a map whose flux does not rise with the current everywhere: no machine has it, nothing can invert it.

    Raises ConfigError: at how many of the sampled points, and where it is worst.
    """
    i_d, i_q, jac = jacobian_samples(flux_map)
    det = jac[0, 0] * jac[1, 1] - jac[0, 1] * jac[1, 0]
    bad = np.flatnonzero((det <= 0.0) | (jac[0, 0] <= 0.0) | (jac[1, 1] <= 0.0))
    if bad.size:
        worst = bad[np.argmin(det[bad])]
        raise ConfigError(
            f"the flux map cannot be inverted: flux does not rise with current at {bad.size} of {det.size} points, "
            f"worst near i_d = {i_d[worst]:.4g} A, i_q = {i_q[worst]:.4g} A",
            likely="noise, a hole filled badly, or axes swapped",
            hint="`pmsmtool machine map FILE` shows more; correct the map, or cut it to the currents in use",
        )


def _inverse_axes(flux_map: FluxMap) -> tuple[Array, Array]:
    axes = []
    for grid, nodes in zip((flux_map.psi_d_wb, flux_map.psi_q_wb), flux_map.inverse_nodes, strict=True):
        margin = INVERSE_MARGIN * float(np.ptp(grid))
        axes.append(np.linspace(float(grid.min()) - margin, float(grid.max()) + margin, nodes))
    return axes[0], axes[1]


def _build(flux_map: FluxMap) -> FluxTables:
    require_monotonic(flux_map)
    struct = _forward_struct(flux_map)
    psi_d, psi_q = _inverse_axes(flux_map)
    struct.psi_d_min, struct.psi_d_step = psi_d[0], (psi_d[-1] - psi_d[0]) / (len(psi_d) - 1)
    struct.psi_q_min, struct.psi_q_step = psi_q[0], (psi_q[-1] - psi_q[0]) / (len(psi_q) - 1)
    struct.psi_d_per_step, struct.psi_q_per_step = per_step(psi_d), per_step(psi_q)
    struct.n_psi_d, struct.n_psi_q = len(psi_d), len(psi_q)
    i_d, i_q = np.empty((2, len(psi_d), len(psi_q)))
    status = np.empty((len(psi_d), len(psi_q)), dtype=np.uint32)
    largest = max(float(np.abs(flux_map.psi_d_wb).max()), float(np.abs(flux_map.psi_q_wb).max()))
    library().pmsm_flux_map_invert(
        ctypes.byref(struct), NEWTON_TOLERANCE * largest, NEWTON_STEPS, i_d.ctypes.data, i_q.ctypes.data,
        status.ctypes.data,
    )  # fmt: skip
    inverse = Table.fit(flux_map.kind, psi_d, psi_q, (i_d, i_q))
    struct.inverse_cells = pointer(inverse.cells)
    struct.arrays = (*struct.arrays, inverse.cells)
    error = _round_trip(flux_map, struct)
    return FluxTables(inverse, struct, float(error.max()), float(np.sqrt(np.mean(error**2))))


def _round_trip(flux_map: FluxMap, struct: FluxMapStruct) -> Array:
    """|i(psi(i)) - i| (A) at the nodes and the cell centres."""
    centres = [axis[:-1] + np.diff(axis) / 2 for axis in (flux_map.i_d_a, flux_map.i_q_a)]
    grids = [np.meshgrid(*axes, indexing="ij") for axes in ((flux_map.i_d_a, flux_map.i_q_a), centres)]
    i_d, i_q = (np.concatenate([grid[k].ravel() for grid in grids]) for k in range(2))
    psi, _ = _forward_in_c(struct, i_d, i_q)
    back = np.empty_like(psi)
    library().pmsm_flux_map_current_many(
        ctypes.byref(struct), i_d.size, psi[0].ctypes.data, psi[1].ctypes.data, back[0].ctypes.data,
        back[1].ctypes.data, None,
    )  # fmt: skip
    return np.asarray(np.hypot(back[0] - i_d, back[1] - i_q))


def meta_json(flux_map: FluxMap) -> str:
    """Return the metadata as one line of JSON with sorted keys."""
    return json.dumps(dict(flux_map.meta), sort_keys=True, ensure_ascii=True)


__all__ = ["FluxMap", "FluxTables", "INVERSE_NODES", "jacobian_samples", "meta_json", "require_monotonic"]


_AXIS = np.array([-1.0, 1.0])
"""Nodes (A) of the one forward cell; beyond, it is continued linearly."""


@dataclass(frozen=True, slots=True)
class FluxScale:
    """Factors over the nominal machine."""

    L_d: float = 1.0
    L_q: float = 1.0
    """Of what the currents add to the flux along each axis."""
    psi_f: float = 1.0
    """Of the magnet's flux."""


@dataclass(frozen=True, slots=True, eq=False)
class ScalableMap:
    """A map prepared for many machines."""

    base: FluxMapStruct
    """Both tables of the nominal machine."""
    psi_f_wb: float
    """Magnet flux (Wb) that ``FluxScale.psi_f`` applies to."""
    psi_zero_wb: tuple[float, float]
    """Fluxes without current (Wb)."""
    L_least_h: float
    """Smallest differential inductance over the nodes (H)."""

    @classmethod
    def of(cls, flux_map: FluxMap, psi_f_wb: float) -> ScalableMap:
        """Prepare a map; ``ConfigError`` when it cannot be inverted."""
        psi_d, psi_q = flux_map.flux(0.0, 0.0)
        L = np.moveaxis(flux_map.incremental_inductance(*np.meshgrid(flux_map.i_d_a, flux_map.i_q_a)), (0, 1), (-2, -1))
        least = np.linalg.eigvalsh(0.5 * (L + np.swapaxes(L, -2, -1)))[..., 0]
        return cls(flux_map.as_struct(), psi_f_wb, (float(psi_d), float(psi_q)), float(least[least > 0.0].min()))

    def struct(self, scale: FluxScale) -> FluxMapStruct:
        """Return the scaled machine for the simulation; the struct keeps its arrays alive."""
        base, shift = self.base, (scale.psi_f - scale.L_d) * self.psi_f_wb
        L = min(scale.L_d, scale.L_q) * self.L_least_h
        cells = np.zeros((1, 1, 4, 4, 2))
        cells[0, 0, 0, 0] = scale.L_d * self.psi_zero_wb[0] + shift - L, scale.L_q * self.psi_zero_wb[1] - L
        cells[0, 0, 0, 1, 0] = cells[0, 0, 1, 0, 1] = 2.0 * L
        made = FluxMapStruct.from_buffer_copy(base)
        made.i_d = made.i_q = pointer(_AXIS)
        made.i_d_per_step = made.i_q_per_step = 0.5
        made.n_i_d = made.n_i_q = len(_AXIS)
        made.cells = pointer(cells)
        made.psi_d_min = scale.L_d * base.psi_d_min + shift
        made.psi_d_step, made.psi_d_per_step = scale.L_d * base.psi_d_step, base.psi_d_per_step / scale.L_d
        made.psi_q_min = scale.L_q * base.psi_q_min
        made.psi_q_step, made.psi_q_per_step = scale.L_q * base.psi_q_step, base.psi_q_per_step / scale.L_q
        made.arrays = (*base.arrays, cells)
        return made
