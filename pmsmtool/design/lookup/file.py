# SPDX-License-Identifier: MIT
"""Look-up tables as files and as drive parameters.

``.npz``: axes ``torque_nm`` and ``speed_rpm`` (``flux_wb`` for a flux table), ``U_dc_v`` when there is more than one
voltage; tables ``i_d_a i_q_a achieved_torque_nm binding margin_v margin_i margin_torque_nm`` over them; least and
largest torque per speed; the loci; and the facts of the table as JSON text in ``meta``. A cell that cannot have its
torque holds the nearest feasible one (``achieved_torque_nm``), and ``margin_torque_nm`` says how far off that is
(negative). ``.csv``: one row per cell, units in the second row. Both have the same bytes for the same table.
"""

from __future__ import annotations

import hashlib
import json
import math
import struct
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pmsmtool.design.lookup.grid import InterpolationError, StoredFormat, int16_step_a
from pmsmtool.design.lookup.table import AxisKind, Locus, LookupTable
from pmsmtool.errors import ConfigError, next_step
from pmsmtool.npz_file import npz_bytes
from pmsmtool.params.parameter_set import LUT_NAMES, ParameterSet

_SECOND = {"speed": ("speed_rpm", "rpm", "V"), "flux": ("flux_wb", "Wb", "Wb")}
"""By the kind of the second axis: its name, its unit, and that of the voltage margin."""
NEXT_STEP = "make the table again: `pmsmtool lut DESIGN -o lut.npz`"

SCHEMA = "pmsmtool.lut/1"

_FORMATS: dict[StoredFormat, int] = {"float32": 1, "int16": 2}
"""``lut.format`` of the catalogue."""


def table_hash(table: LookupTable) -> str:
    """Return ``sha256:<hex>`` over machine, limits, axes and stored currents."""
    limits = f"{table.axis_kind} {table.I_max_apk!r} {table.i_d_min_a!r}"
    digest = hashlib.sha256(f"{table.machine.content()} {limits}".encode())
    for array in (table.torque_nm, table.y, table.U_dc_v, table.V_max_v, table.i_d_a, table.i_q_a):
        digest.update(np.ascontiguousarray(array, dtype="<f8").tobytes())
    return "sha256:" + digest.hexdigest()


def table_facts(table: LookupTable, stored: StoredFormat | None, error: InterpolationError | None) -> dict[str, Any]:
    """Return what belongs to a table besides its numbers, JSON-serialisable."""
    machine = table.machine
    facts: dict[str, Any] = {
        "schema": SCHEMA,
        "content": table_hash(table),
        "axis_kind": table.axis_kind,
        "R_ohm": machine.R,
        "psi_f_wb": machine.psi_f,
        "psi_shift_wb": machine.psi_shift,
        "pole_pairs": machine.pole_pairs,
        "U_dc_v": table.U_dc_v.tolist(),
        "V_max_v": table.V_max_v.tolist(),
        "I_max_apk": table.I_max_apk,
        "i_d_min_a": table.i_d_min_a if np.isfinite(table.i_d_min_a) else None,
        "machine": "constant" if machine.flux_map is None else machine.flux_map.interpolation(),
        "flux_map_sha256": None if machine.flux_map is None else machine.flux_map.content_hash(),
        "objective": "copper loss" if machine.loss_map is None else "copper and iron loss",
        "stored": stored or "float64",
    }
    if stored is not None:
        facts["words_crc32"] = zlib.crc32(lut_words(table, stored))
    if error is not None:
        facts["interpolation_error"] = {
            "torque_nm": error.torque_nm, "voltage_v": error.voltage_v, "current_a": error.current_a,
            "cells_with_holes": error.holes,
        }  # fmt: skip
    return facts


def table_npz(table: LookupTable, facts: Mapping[str, Any], lines: Mapping[str, Locus] | None = None) -> bytes:
    """Return the bytes of ``lut.npz``."""
    flat = table.U_dc_v.size == 1
    cells = {
        "i_d_a": table.i_d_a, "i_q_a": table.i_q_a, "achieved_torque_nm": table.achieved_torque_nm,
        "binding": table.binding, "margin_v": table.margin_v, "margin_i": table.margin_i,
        "margin_torque_nm": table.margin_torque_nm,
    }  # fmt: skip
    bounds = {"least_torque_nm": table.torque_limits.least_nm, "largest_torque_nm": table.torque_limits.largest_nm}
    arrays: dict[str, NDArray[Any]] = {"torque_nm": table.torque_nm, _SECOND[table.axis_kind][0]: table.y}
    if not flat:
        arrays["U_dc_v"] = table.U_dc_v
    arrays |= {name: array[..., 0] if flat else array for name, array in {**cells, **bounds}.items()}
    for name, locus in (lines or {}).items():
        arrays |= {f"{name}_{field}": getattr(locus, field) for field in ("torque_nm", "i_d_a", "i_q_a")}
        if name != "mtpa":
            arrays[f"{name}_speed_rpm"] = locus.speed_rpm
    arrays["meta"] = np.array(json.dumps(dict(facts), sort_keys=True))
    return npz_bytes(arrays)


def table_csv(table: LookupTable) -> str:
    """Return the text of the table, one row per cell: names, units, then torque slowest and voltage fastest."""
    second, second_unit, margin_unit = _SECOND[table.axis_kind]
    columns = {
        "torque_nm": ("N m", table.torque_nm[:, None, None]),
        second: (second_unit, table.y[None, :, None]),
        "U_dc_v": ("V", table.U_dc_v[None, None, :]),
        "i_d_a": ("A", table.i_d_a),
        "i_q_a": ("A", table.i_q_a),
        "achieved_torque_nm": ("N m", table.achieved_torque_nm),
        "margin_v": (margin_unit, table.margin_v),
        "margin_i": ("A", table.margin_i),
        "margin_torque_nm": ("N m", table.margin_torque_nm),
    }
    if table.U_dc_v.size == 1:
        del columns["U_dc_v"]
    flat = [np.broadcast_to(array, table.i_d_a.shape).ravel().tolist() for _, array in columns.values()]
    lines = [(*columns, "binding"), (*(unit for unit, _ in columns.values()), "")]
    lines += [(*map(repr, numbers), binding) for *numbers, binding in zip(*flat, table.binding.ravel(), strict=True)]
    return "".join(",".join(map(str, line)) + "\n" for line in lines)


def lut_values(table: LookupTable, stored: StoredFormat) -> tuple[dict[str, float], dict[str, tuple[float, ...]]]:
    """Return the ``lut.*`` values of the catalogue and the tables of a parameter set for a stored table."""
    return _values(table.axis_kind, stored, _arrays(table))


def lut_words(table: LookupTable, stored: StoredFormat) -> bytes:
    """Return the look-up words of the drive image: axes x, y, z as binary32, then both tables, padded to four bytes."""
    return _words(stored, _arrays(table))


@next_step(NEXT_STEP)
def table_parameters(arrays: Mapping[str, NDArray[Any]], where: str) -> ParameterSet:
    """Return what ``lut.npz`` gives a drive: the ``lut.*`` values, the axes and both tables.

    Raises ConfigError: it is no table, or its words are not those its ``meta`` has the CRC-32 of.

    Parameters
    ----------
    arrays : mapping of str to ndarray
        Content of the file.
    where : str
        Its name, for messages.
    """
    hint = "give lut.npz as `lut` writes it"
    try:
        facts = json.loads(str(arrays["meta"]))
        kind, stored = str(facts["axis_kind"]), str(facts["stored"])
        z = arrays["U_dc_v"] if "U_dc_v" in arrays else facts["U_dc_v"]
        names = ("torque_nm", _SECOND[kind][0], "i_d_a", "i_q_a")
        x, y, i_d, i_q, z = (np.asarray(one, dtype=np.float64) for one in (*(arrays[name] for name in names), z))
    except (KeyError, TypeError, ValueError, RecursionError, OverflowError) as error:
        raise ConfigError(f"is no look-up table: {error}", where=where, hint=hint) from None
    parts = (x, y, z, i_d, i_q)
    cells = math.prod(axis.size for axis in (x, y, z))
    if facts.get("schema") != SCHEMA or kind not in _KINDS or stored not in _FORMATS or {i_d.size, i_q.size} != {cells}:
        raise ConfigError("is no look-up table as a drive stores it", where=where, hint=hint)
    if zlib.crc32(_words(stored, parts)) != facts.get("words_crc32"):
        raise ConfigError(
            "its numbers are not those its CRC-32 was made of", where=where, likely="the file was edited", hint=hint
        )
    values, tables = _values(kind, stored, parts)
    return ParameterSet(values, tables, {"lut": str(facts.get("content", ""))}, "look-up table")


_KINDS: tuple[AxisKind, ...] = ("speed", "flux")
"""``lut.axis_kind`` of the catalogue."""

_Parts = tuple[NDArray[np.float64], ...]
"""Axes x, y, z and the tables i_d, i_q."""


def _arrays(table: LookupTable) -> _Parts:
    return table.torque_nm, table.y, table.U_dc_v, table.i_d_a, table.i_q_a


def _values(
    kind: AxisKind, stored: StoredFormat, parts: _Parts
) -> tuple[dict[str, float], dict[str, tuple[float, ...]]]:
    values = {
        "lut.format": float(_FORMATS[stored]),
        "lut.axis_kind": float(_KINDS.index(kind)),
        "lut.n_x": float(parts[0].size),
        "lut.n_y": float(parts[1].size),
        "lut.n_z": float(parts[2].size),
        "lut.lsb_a": int16_step_a(*parts[3:]) if stored == "int16" else 0.0,
    }
    return values, {name: tuple(array.ravel().tolist()) for name, array in zip(LUT_NAMES, parts, strict=True)}


def _words(stored: StoredFormat, parts: _Parts) -> bytes:
    axes = b"".join(np.ascontiguousarray(a, dtype="<f4").tobytes() for a in parts[:3])
    tables = b""
    for currents in parts[3:]:
        if stored == "float32":
            tables += np.ascontiguousarray(currents, dtype="<f4").tobytes()
        else:
            steps = np.rint(np.nan_to_num(currents) / int16_step_a(*parts[3:]))
            tables += np.where(np.isnan(currents), -32768, steps).astype("<i2").tobytes()
            tables += struct.pack("<h", 0) * (currents.size % 2)
    return axes + tables
