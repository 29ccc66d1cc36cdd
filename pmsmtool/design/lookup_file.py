"""Look-up tables as files and as drive parameters.

``.npz``: axes ``torque_nm`` and ``speed_rpm`` (``flux_wb`` for a flux table), ``U_dc_v`` when there is more than one
voltage; tables ``i_d_a i_q_a achieved_torque_nm binding margin_v margin_i margin_torque_nm`` over them; least and
largest torque per speed; the loci; and the facts of the table as JSON text in ``meta``. A cell that cannot have its
torque holds the nearest feasible one (``achieved_torque_nm``), and ``margin_torque_nm`` says how far off that is
(negative). ``.csv``: one row per cell, units in the second row. Both have the same bytes for the same table.
"""

from __future__ import annotations

import hashlib
import io
import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pmsmtool.design.lookup_grid import InterpolationError, StoredFormat, lsb_a
from pmsmtool.design.lookup_loci import Locus
from pmsmtool.design.lookup_table import LookupTable
from pmsmtool.npz_file import npz_bytes

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
    arrays: dict[str, NDArray[Any]] = {"torque_nm": table.torque_nm, _second(table): table.y}
    if not flat:
        arrays["U_dc_v"] = table.U_dc_v
    arrays |= {name: array[..., 0] if flat else array for name, array in {**cells, **bounds}.items()}
    for name, locus in (lines or {}).items():
        arrays |= {f"{name}_{field}": getattr(locus, field) for field in ("torque_nm", "i_d_a", "i_q_a")}
        if name != "mtpa":
            arrays[f"{name}_speed_rpm"] = locus.speed_rpm
    arrays["meta"] = np.array(json.dumps(dict(facts), sort_keys=True))
    return npz_bytes(arrays)


def _second(table: LookupTable) -> str:
    return "speed_rpm" if table.axis_kind == "speed" else "flux_wb"


def table_csv(table: LookupTable) -> str:
    """Return the text of the table, one row per cell: names, units, then torque slowest and voltage fastest."""
    second_unit = "rpm" if table.axis_kind == "speed" else "Wb"
    margin_unit = "V" if table.axis_kind == "speed" else "Wb"
    columns = {
        "torque_nm": ("N m", table.torque_nm[:, None, None]),
        _second(table): (second_unit, table.y[None, :, None]),
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
    flat = [np.broadcast_to(array, table.i_d_a.shape).ravel() for _, array in columns.values()]
    out = io.StringIO()
    out.write(",".join((*columns, "binding")) + "\n")
    out.write(",".join((*(unit for unit, _ in columns.values()), "")) + "\n")
    for *numbers, binding in zip(*flat, table.binding.ravel(), strict=True):
        out.write(",".join((*(repr(float(x)) for x in numbers), str(binding))) + "\n")
    return out.getvalue()


def lut_values(table: LookupTable, stored: StoredFormat) -> tuple[dict[str, float], dict[str, tuple[float, ...]]]:
    """Return the ``lut.*`` values of the catalogue and the tables of a parameter set for a stored table."""
    values = {
        "lut.format": float(_FORMATS[stored]),
        "lut.axis_kind": 0.0 if table.axis_kind == "speed" else 1.0,
        "lut.n_x": float(table.torque_nm.size),
        "lut.n_y": float(table.y.size),
        "lut.n_z": float(table.U_dc_v.size),
        "lut.lsb_a": lsb_a(table) if stored == "int16" else 0.0,
    }
    tables = {
        "lut.axis_x": table.torque_nm, "lut.axis_y": table.y, "lut.axis_z": table.U_dc_v,
        "lut.i_d_a": table.i_d_a.ravel(), "lut.i_q_a": table.i_q_a.ravel(),
    }  # fmt: skip
    return values, {name: tuple(array.tolist()) for name, array in tables.items()}


def lut_words(table: LookupTable, stored: StoredFormat) -> bytes:
    """Return the look-up words of the drive image: axes x, y, z as binary32, then both tables, padded to four bytes."""
    axes = b"".join(np.ascontiguousarray(a, dtype="<f4").tobytes() for a in (table.torque_nm, table.y, table.U_dc_v))
    tables = b""
    for currents in (table.i_d_a, table.i_q_a):
        if stored == "float32":
            tables += np.ascontiguousarray(currents, dtype="<f4").tobytes()
        else:
            whole = np.where(np.isnan(currents), -32768, np.rint(np.nan_to_num(currents) / lsb_a(table)))
            tables += whole.astype("<i2").tobytes()
            tables += struct.pack("<h", 0) * (currents.size % 2)
    return axes + tables
