# SPDX-License-Identifier: MIT
"""A flux map inside a TOML file: the table ``[flux_map]``."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pmsmtool.errors import ConfigError, next_step
from pmsmtool.machine.flux_map import INVERSE_NODES, FluxMap, meta_json
from pmsmtool.machine.key import did_you_mean

NEXT_STEP = "make the file again from the machine file: the map in it was edited"

_GRIDS = ("i_d_a", "i_q_a", "psi_d_wb", "psi_q_wb")
_KEYS = (*_GRIDS, "kind", "inverse_nodes", "meta")


def flux_map_table(flux_map: FluxMap) -> dict[str, Any]:
    """Return the table: axes (A peak), ``psi_d_wb[i_d][i_q]``, kind, inverse nodes, metadata as JSON text."""
    table: dict[str, Any] = {"kind": flux_map.kind, "inverse_nodes": list(flux_map.inverse_nodes)}
    if flux_map.meta:
        table["meta"] = meta_json(flux_map)
    return {**table, **{name: getattr(flux_map, name).tolist() for name in _GRIDS}}


@next_step(NEXT_STEP)
def flux_map_from_table(table: Any) -> FluxMap:
    """Return the map of a table.

    Raises
    ------
    ConfigError
        A key is missing, unknown or not of numbers, or the grids are no map.
    """
    if not isinstance(table, Mapping):
        raise ConfigError("is not a table")
    unknown = [f"unknown key {name}{did_you_mean(name, _KEYS)}" for name in table if name not in _KEYS]
    missing = [f"{name} is missing" for name in _GRIDS if name not in table]
    if unknown or missing:
        raise ConfigError("is not a flux map", violations=[*unknown, *missing])
    try:
        i_d, i_q, psi_d, psi_q = (_numbers(table[name], name) for name in _GRIDS)
        first, second = (int(n) for n in table.get("inverse_nodes", INVERSE_NODES))
        meta = dict(json.loads(table.get("meta", "{}")))
    except (TypeError, ValueError) as error:
        raise ConfigError(f"holds something that is not a number or not JSON ({error})") from None
    return FluxMap(i_d, i_q, psi_d, psi_q, table.get("kind", "bicubic"), (first, second), meta)


def _numbers(values: Any, name: str) -> NDArray[np.float64]:
    array = np.asarray(values)
    if array.dtype.kind not in "fi":
        raise ValueError(f"{name} is not an array of numbers")
    return np.asarray(array, dtype=np.float64)
