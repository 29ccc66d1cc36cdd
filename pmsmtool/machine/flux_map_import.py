# SPDX-License-Identifier: MIT
"""Flux maps from and to files: ``.npz``, ``.mat``, ``.csv``, real grids or complex ones.

Accepted names (case and underscores do not matter): currents ``i_d_a i_d id``, ``i_q_a i_q iq``; fluxes
``psi_d_wb psi_d psid fd flux_d lambda_d``, likewise for q; or complex ``i_s_dq i_dq`` with ``psi_s_dq psi_dq``
(as motulator stores them). Currents in A peak, fluxes in Wb peak; a CSV may say otherwise in its unit row.
Axes are vectors, or grids as from ``meshgrid`` in either index order.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.errors import ConfigError, next_step
from pmsmtool.files import read_text
from pmsmtool.machine.flux_map import INVERSE_NODES, FluxMap, meta_json
from pmsmtool.machine.flux_map_cells import Kind
from pmsmtool.machine.flux_map_repair import FluxGrid, fill_holes
from pmsmtool.machine.mat_file import read_mat
from pmsmtool.npz_file import npz_bytes, read_npz
from pmsmtool.units import parse_quantity

NEXT_STEP = "`pmsmtool machine map FILE` checks and repairs a map; `pmsmtool help files` says what it may be"


MESH_TOLERANCE = 1e-6
"""Largest deviation, of the axis range, of a current grid from a true rectangle."""

_NAMES: dict[str, tuple[str, ...]] = {
    "i_d_a": ("ida", "id", "idapk", "idgrid", "isd"),
    "i_q_a": ("iqa", "iq", "iqapk", "iqgrid", "isq"),
    "psi_d_wb": ("psidwb", "psid", "fd", "fluxd", "lambdad", "psisd"),
    "psi_q_wb": ("psiqwb", "psiq", "fq", "fluxq", "lambdaq", "psisq"),
    "i_complex": ("isdq", "idq", "iscomplex"),
    "psi_complex": ("psisdq", "psidq", "psiscomplex"),
}
_FILL = "cut the map, or fill them: `pmsmtool machine map FILE --fill-holes -o whole.npz`"
_CSV_HEADER = ("i_d_a", "i_q_a", "psi_d_wb", "psi_q_wb")


@dataclass(frozen=True, slots=True, eq=False)
class RawFluxMap:
    """What a file held: the grid, its settings, and notes on how it was read."""

    grid: FluxGrid
    kind: Kind
    inverse_nodes: tuple[int, int]
    meta: Mapping[str, Any]
    notes: tuple[str, ...]


@next_step(NEXT_STEP)
def load_flux_map(path: Path, *, fill: bool = False) -> FluxMap:
    """Read a flux map.

    Raises ConfigError: the file is missing, truncated, not numeric, not a grid, has an axis that does not increase, or
    holes.

    Parameters
    ----------
    path : Path
        ``.npz``, ``.mat`` or ``.csv``.
    fill : bool
        Fill holes (``fill_holes``) instead of refusing them; what was filled is in ``meta["repairs"]``.
    """
    raw = read_flux_map(path)
    meta = dict(raw.meta)
    grid = raw.grid
    if grid.holes.any():
        if not fill:
            raise ConfigError(grid.holes_text(), where=str(path), hint=_FILL)
        grid, text = fill_holes(grid)
        meta["repairs"] = [*meta.get("repairs", []), text]
    if raw.notes:
        meta["notes"] = [*meta.get("notes", []), *raw.notes]
    try:
        return FluxMap(
            grid.i_d_a, grid.i_q_a, grid.psi_d_wb, grid.psi_q_wb, raw.kind, raw.inverse_nodes, meta
        )  # fmt: skip
    except ConfigError as error:
        raise ConfigError(error.what, where=str(path), violations=error.violations) from None


@next_step(NEXT_STEP)
def read_flux_map(path: Path) -> RawFluxMap:
    """Read grids, settings and notes; holes stay NaN (see :func:`load_flux_map` for the errors)."""
    readers = {".npz": read_npz, ".mat": _read_mat, ".csv": _read_csv}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        what = f"{path.suffix or 'a name without suffix'} is no flux-map format"
        raise ConfigError(what, where=str(path), hint="use .npz, .mat or .csv")
    return _raw(reader(path), str(path))


# -- naming and shapes ---------------------------------------------------------------------------------------


def _raw(arrays: Mapping[str, NDArray[Any]], where: str) -> RawFluxMap:
    named = _by_meaning(arrays, where)
    notes: list[str] = []
    if "i_complex" in named and "psi_complex" in named:
        current, flux = named["i_complex"], named["psi_complex"]
        i_d, i_q, psi_d, psi_q = current.real, current.imag, flux.real, flux.imag
    else:
        missing = [name for name in _CSV_HEADER if name not in named]
        if missing:
            raise ConfigError(
                f"holds no {', '.join(missing)}",
                where=where,
                likely=f"it holds {', '.join(sorted(arrays)) or 'nothing'}",
                hint=f"name the arrays {', '.join(_CSV_HEADER)}",
            )
        i_d, i_q, psi_d, psi_q = (_numeric(named[name], name, where) for name in _CSV_HEADER)
    own = set(_CSV_HEADER) <= set(arrays)
    grid = _grid(i_d, i_q, psi_d, psi_q, own=own, where=where, notes=notes)
    kind, nodes, meta = _settings(arrays, where)
    return RawFluxMap(grid, kind, nodes, meta, tuple(notes))


def _by_meaning(arrays: Mapping[str, NDArray[Any]], where: str) -> dict[str, NDArray[Any]]:
    found: dict[str, NDArray[Any]] = {}
    for name, array in arrays.items():
        plain = re.sub(r"[^a-z]", "", name.lower())
        meaning = next((m for m, names in _NAMES.items() if plain in names), None)
        if meaning is None:
            continue
        if meaning in found:
            raise ConfigError(f"two arrays could be {meaning}; one is {name!r}", where=where, hint="keep one of them")
        found[meaning] = array
    return found


def _numeric(array: NDArray[Any], name: str, where: str) -> Array:
    if array.dtype.kind not in "fiub":
        raise ConfigError(f"{name} is not numeric (its type is {array.dtype})", where=where)
    return np.asarray(array, dtype=np.float64)


def _settings(arrays: Mapping[str, NDArray[Any]], where: str) -> tuple[Kind, tuple[int, int], dict[str, Any]]:
    kind: Kind = "bicubic"
    if "kind" in arrays and str(arrays["kind"]) == "bilinear":
        kind = "bilinear"
    elif "kind" in arrays and str(arrays["kind"]) != "bicubic":
        raise ConfigError(f"kind is {str(arrays['kind'])!r}, allowed are bicubic and bilinear", where=where)
    nodes = INVERSE_NODES
    if "inverse_nodes" in arrays:
        try:
            first, second = (int(n) for n in np.ravel(arrays["inverse_nodes"]))
        except (ValueError, OverflowError, TypeError):
            raise ConfigError("inverse_nodes is not two whole numbers", where=where) from None
        nodes = (first, second)
    try:
        meta = dict(json.loads(str(arrays["meta"]))) if "meta" in arrays else {}
    except (TypeError, ValueError, RecursionError):
        raise ConfigError("meta is not JSON with names", where=where) from None
    return kind, nodes, meta


def _grid(i_d: Array, i_q: Array, psi_d: Array, psi_q: Array, *, own: bool, where: str, notes: list[str]) -> FluxGrid:
    psi_d, psi_q = np.squeeze(psi_d), np.squeeze(psi_q)
    if psi_d.ndim != 2 or psi_d.shape != psi_q.shape:
        raise ConfigError(f"the fluxes have shapes {psi_d.shape} and {psi_q.shape}, not one grid", where=where)
    i_d, i_q = np.squeeze(i_d), np.squeeze(i_q)
    if i_d.ndim == 2:
        axis_d, axis_q, transposed = _mesh_axes(i_d, i_q, psi_d.shape, where)
    else:
        axis_d, axis_q = np.atleast_1d(i_d), np.atleast_1d(i_q)
        transposed = not own and _transposed(axis_d, axis_q, psi_d, psi_q, where)
    if transposed:
        psi_d, psi_q = psi_d.T, psi_q.T
        notes.append("the fluxes were indexed [i_q, i_d] and were transposed")
    axis_d, psi_d, psi_q = _rising(axis_d, psi_d, psi_q, 0, "i_d", notes)
    axis_q, psi_d, psi_q = _rising(axis_q, psi_d, psi_q, 1, "i_q", notes)
    if (axis_d.shape, axis_q.shape) != (psi_d.shape[:1], psi_d.shape[1:]):
        raise ConfigError(
            f"the currents have shapes {axis_d.shape} and {axis_q.shape}, the fluxes {psi_d.shape}",
            where=where,
            likely="an array was cut, or is one of another map",
        )
    return FluxGrid(*(np.ascontiguousarray(a, dtype=np.float64) for a in (axis_d, axis_q, psi_d, psi_q)))


def _mesh_axes(i_d: Array, i_q: Array, shape: tuple[int, ...], where: str) -> tuple[Array, Array, bool]:
    if i_d.shape != shape or i_q.shape != shape:
        raise ConfigError(f"the currents have shapes {i_d.shape}, {i_q.shape}, the fluxes {shape}", where=where)
    transposed = bool(np.ptp(i_d[0]) > np.ptp(i_d[:, 0]))
    if transposed:
        i_d, i_q = i_d.T, i_q.T
    off = max(
        float(np.abs(i_d - i_d[:, :1]).max()) / max(float(np.ptp(i_d)), 1e-300),
        float(np.abs(i_q - i_q[:1]).max()) / max(float(np.ptp(i_q)), 1e-300),
    )
    if not off <= MESH_TOLERANCE:
        raise ConfigError(
            f"the currents are not on a rectangular grid: they deviate by {100 * off:.3g} % of their range",
            where=where,
            hint="interpolate the map to a grid first",
        )
    return i_d[:, 0], i_q[0], transposed


def _transposed(axis_d: Array, axis_q: Array, psi_d: Array, psi_q: Array, where: str) -> bool:
    """Whether vectors and grids of another tool are indexed [q, d]; a square one is judged by its slopes."""
    if len(axis_d) != len(axis_q):
        return psi_d.shape == (len(axis_q), len(axis_d))
    first = np.nanmean(np.abs(np.diff(psi_d, axis=0))) - np.nanmean(np.abs(np.diff(psi_q, axis=0)))
    second = np.nanmean(np.abs(np.diff(psi_d, axis=1))) - np.nanmean(np.abs(np.diff(psi_q, axis=1)))
    if np.sign(first) * np.sign(second) > 0:
        raise ConfigError(
            "a square map with vector axes does not show which index is i_d",
            where=where,
            hint=f"give both currents as grids, or name the arrays {', '.join(_CSV_HEADER)} with index [i_d, i_q]",
        )
    return bool(first < second)


def _rising(
    axis: Array, psi_d: Array, psi_q: Array, along: int, name: str, notes: list[str]
) -> tuple[Array, Array, Array]:
    if len(axis) > 1 and np.all(np.diff(axis) < 0):
        notes.append(f"{name} was falling and was turned round")
        return axis[::-1], np.flip(psi_d, along), np.flip(psi_q, along)
    return axis, psi_d, psi_q


# -- the formats -----------------------------------------------------------------------------------------------


def _read_mat(path: Path) -> dict[str, NDArray[Any]]:
    arrays: dict[str, NDArray[Any]] = {}
    _collect(arrays, read_mat(path))
    return arrays


def _collect(arrays: dict[str, NDArray[Any]], values: Mapping[str, Any]) -> None:
    """Gather arrays, also out of MATLAB structures, by their last name."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            _collect(arrays, value)
        else:
            arrays.setdefault(name, value)


def _read_csv(path: Path) -> dict[str, NDArray[Any]]:
    where = str(path)
    rows, meta = _csv_rows(read_text(path, encoding="utf-8-sig"), where)
    if not rows:
        raise ConfigError("is empty", where=where)
    columns = [re.sub(r"[^a-z]", "", cell.lower()) for cell in rows[0][1]]
    try:
        order = [next(k for k, c in enumerate(columns) if c in _NAMES[name]) for name in _CSV_HEADER]
    except StopIteration:
        raise ConfigError(
            f"the first row must name {', '.join(_CSV_HEADER)}", where=where, likely=f"it is {','.join(rows[0][1])}"
        ) from None
    scale, rows = _unit_row(rows[1:], order, where)
    points = _csv_points(rows, order, where) * scale
    return {**_points_to_grid(points, where), **meta}


def _csv_rows(text: str, where: str) -> tuple[list[tuple[int, list[str]]], dict[str, NDArray[Any]]]:
    """Rows with their line numbers, and the settings of a trailing ``# {json}`` line."""
    rows: list[tuple[int, list[str]]] = []
    meta: dict[str, NDArray[Any]] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        if line.startswith("# {"):
            try:
                facts = json.loads(line[2:])
            except (ValueError, RecursionError):
                raise ConfigError(
                    "the settings line is not JSON", where=f"{where}:{number}", likely="a truncated file"
                ) from None
            meta = {
                "kind": np.array(facts.get("kind", "bicubic")),
                "inverse_nodes": np.array(facts.get("inverse_nodes", INVERSE_NODES)),
                "meta": np.array(json.dumps(facts.get("meta", {}))),
            }
        elif line.strip() and not line.startswith("#"):
            rows.append((number, next(csv.reader([line], delimiter=";" if ";" in line else ","))))
    return rows, meta


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _unit_row(
    rows: list[tuple[int, list[str]]], order: Sequence[int], where: str
) -> tuple[Array, list[tuple[int, list[str]]]]:
    """Factors to A and Wb, and the rows that are left."""
    if not rows or any(_is_number(cell) for cell in rows[0][1]):
        return np.ones(4), rows
    scale = np.ones(4)
    for k, column in enumerate(order):
        unit = rows[0][1][column].strip() if column < len(rows[0][1]) else ""
        try:
            scale[k] = parse_quantity(f"1{'Apk' if unit == 'A' else unit}", "A" if k < 2 else "Wb")
        except ConfigError as error:
            raise ConfigError(f"unit row: {error.what}", where=f"{where}:{rows[0][0]}", hint=error.hint) from None
    return scale, rows[1:]


def _csv_points(rows: list[tuple[int, list[str]]], order: Sequence[int], where: str) -> Array:
    points = np.empty((len(rows), 4))
    for k, (number, row) in enumerate(rows):
        for m, column in enumerate(order):
            cell = row[column].strip() if column < len(row) else ""
            if not _is_number(cell) and cell.lower() not in ("", "nan"):
                likely = "a decimal comma" if "," in cell else ""
                what = f"{cell!r} in {_CSV_HEADER[m]} is not a number"
                raise ConfigError(what, where=f"{where}:{number}", likely=likely)
            if cell == "" and (m < 2 or column >= len(row)):
                raise ConfigError(
                    f"the row ends before {_CSV_HEADER[m]}", where=f"{where}:{number}", likely="a truncated file"
                )
            points[k, m] = float(cell) if cell else math.nan
    return points


def _points_to_grid(points: Array, where: str) -> dict[str, NDArray[Any]]:
    axis_d, at_d = np.unique(points[:, 0], return_inverse=True)
    axis_q, at_q = np.unique(points[:, 1], return_inverse=True)
    nodes = len(axis_d) * len(axis_q)
    if len(points) == 0 or not np.all(np.isfinite(points[:, :2])):
        raise ConfigError("holds no points, or currents that are not finite", where=where)
    if len(points) < nodes / 2:
        raise ConfigError(
            f"{len(points)} points give {len(axis_d)} x {len(axis_q)} different currents: not a grid",
            where=where,
            hint="interpolate the points to a grid first",
        )
    place = at_d * len(axis_q) + at_q
    if len(np.unique(place)) < len(points):
        twice = points[int(np.flatnonzero(np.bincount(place, minlength=nodes)[place] > 1)[0])]
        raise ConfigError(f"the point ({twice[0]:g}, {twice[1]:g}) A is given twice", where=where)
    grids = np.full((2, nodes), math.nan)
    grids[:, place] = points[:, 2:].T
    psi_d, psi_q = grids.reshape(2, len(axis_d), len(axis_q))
    return dict(zip(_CSV_HEADER, (axis_d, axis_q, psi_d, psi_q), strict=True))


def flux_map_npz(flux_map: FluxMap) -> bytes:
    """Return the map as a ``.npz`` file, same map, same bytes."""
    return npz_bytes(
        {
            **{name: getattr(flux_map, name) for name in _CSV_HEADER},
            "kind": np.array(flux_map.kind),
            "inverse_nodes": np.array(flux_map.inverse_nodes, dtype="<i8"),
            "meta": np.array(meta_json(flux_map)),
        }
    )


def flux_map_csv(flux_map: FluxMap) -> str:
    """Return the map as CSV: names, units, one point per row, settings in a last line that starts with ``# {``."""
    out = io.StringIO()
    out.write(",".join(_CSV_HEADER) + "\nA,A,Wb,Wb\n")
    for m, i_d in enumerate(flux_map.i_d_a):
        for n, i_q in enumerate(flux_map.i_q_a):
            row = (i_d, i_q, flux_map.psi_d_wb[m, n], flux_map.psi_q_wb[m, n])
            out.write(",".join(repr(float(value)) for value in row) + "\n")
    facts = {"kind": flux_map.kind, "inverse_nodes": list(flux_map.inverse_nodes), "meta": dict(flux_map.meta)}
    out.write(f"# {json.dumps(facts, sort_keys=True)}\n")
    return out.getvalue()
