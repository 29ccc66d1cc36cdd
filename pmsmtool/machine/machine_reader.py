# SPDX-License-Identifier: MIT
"""Reading the tables of a machine file: everything that is wrong is found in one pass."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pmsmtool.errors import ConfigError, next_step
from pmsmtool.machine.flux_map import INVERSE_NODES, FluxMap, meta_json, require_monotonic
from pmsmtool.machine.key import Key, check_table, did_you_mean
from pmsmtool.machine.machine_keys import (
    ENCODER_KEYS,
    ESTIMATE_KEYS,
    INVERTER_KEYS,
    LIMIT_KEYS,
    MACHINE_KEYS,
    MEASURABLE,
    deviation_keys,
    estimate_keys,
    estimated_key,
)
from pmsmtool.machine.parameters import LINEAR_UTILISATION, Estimate, InverterParameters, MachineParameters
from pmsmtool.machine.simulation_keys import SIMULATION_KEYS
from pmsmtool.units import UNITS

Record = Mapping[str, Any]

TABLES: dict[str, tuple[Key, ...]] = {
    "machine": MACHINE_KEYS,
    "inverter": INVERTER_KEYS,
    "std": deviation_keys("std"),
    "systematic": deviation_keys("systematic"),
    "encoder": ENCODER_KEYS,
    "limits": LIMIT_KEYS,
    "simulation": SIMULATION_KEYS,
}
OTHER_TABLES = ("estimate", "conditions", "provenance", "flux_map")
LARGEST_RATIO = 10
"""Of a standard deviation to its value, and of a value to its estimate; more is another unit or a slip of the pen."""
ELSEWHERE = {key.name: table for table in ("limits", "encoder", "inverter", "machine") for key in TABLES[table]}


OVERMODULATION_NEEDS = ("min_off_time_s", "sample_window_s", "shunts")
"""Keys of ``[inverter]`` without which no voltage is beyond the linear range."""

NEXT_STEP = "make the file again from the machine file: the map in it was edited"

_GRIDS = ("i_d_a", "i_q_a", "psi_d_wb", "psi_q_wb")
_KEYS = (*_GRIDS, "kind", "inverse_nodes", "meta")


class MachineReader:
    """One reading of tables: collects values and, in ``violations``, everything that is wrong."""

    def __init__(self, tables: Record, where: str, lines: dict[tuple[str, ...], int], path: tuple[str, ...]) -> None:
        self.tables, self.where, self.lines, self.path = tables, where, lines, path
        self.violations: list[str] = []

    def place(self, *names: str) -> str:
        """``file:line: [table] key``."""
        full = (*self.path, *names)
        line = next((self.lines[full[:n]] for n in range(len(full), 0, -1) if full[:n] in self.lines), None)
        start = self.where if line is None else f"{self.where}:{line}"
        table = f"[{'.'.join(full[:-1])}] " if len(full) > 1 else ""
        return f"{start}: {table}{full[-1]}" if full else start

    def places(self, table: Record, *names: str) -> dict[str, str]:
        """Place of each key of a table, and of the table itself."""
        header = self.place(*names)
        return {"": header, **{name: self.place(*names, name) for name in table}}

    def table(self, name: str, keys: tuple[Key, ...]) -> dict[str, Any]:
        """Checked values of one table."""
        raw = self.tables.get(name, {})
        if not isinstance(raw, Mapping):
            self.violations.append(f"{self.place(name)} is not a table")
            return {}
        elsewhere = {key: table for key, table in ELSEWHERE.items() if table != name}
        return dict(check_table(raw, keys, self.places(raw, name), self.violations, elsewhere))

    def read(self, folder: Path | None) -> dict[str, Any]:
        """Return the checked parts; they make a machine only if ``violations`` is empty."""
        self.names()
        parts: dict[str, Any] = {"name": self.tables.get("name", "")}
        parts.update({name: self.table(name, keys) for name, keys in TABLES.items()})
        parts["estimate"] = self.estimates()
        parts["conditions"], parts["provenance"] = self.record("conditions"), self.record("provenance")
        parts["flux_map"] = self.flux_map(parts["machine"].get("flux_map"), folder)
        self.iron_loss_map(parts["machine"].get("iron_loss_map"), folder)
        self.consistency(parts)
        self.overmodulation(parts["inverter"])
        return parts

    def names(self) -> None:
        """Title and tables at the top."""
        known = ["name", *TABLES, *OTHER_TABLES]
        for name in self.tables:
            if name not in known:
                advice = did_you_mean(name, known)
                if name in ELSEWHERE:
                    advice = f"; it belongs to [{ELSEWHERE[name]}]"
                self.violations.append(f"{self.place(name)}: unknown key or table{advice}")
        title = self.tables.get("name", "")
        if not isinstance(title, str) or not title:
            self.violations.append(f"{self.place('name')} is missing or not text")

    def record(self, name: str) -> dict[str, Any]:
        """A table of free keys with plain values."""
        raw = self.tables.get(name, {})
        if not isinstance(raw, Mapping):
            self.violations.append(f"{self.place(name)} is not a table")
            return {}
        for key, value in raw.items():
            items = value if isinstance(value, list | tuple) else [value]
            if any(not isinstance(item, str | bool | int | float) for item in items):
                self.violations.append(f"{self.place(name, key)} is neither text nor number nor an array of them")
        return dict(raw)

    def estimates(self) -> dict[str, Estimate]:
        """``[estimate.<key>]``."""
        raw = self.tables.get("estimate", {})
        found: dict[str, Estimate] = {}
        if not isinstance(raw, Mapping):
            self.violations.append(f"{self.place('estimate')} is not a table")
            return found
        for name, table in raw.items():
            key = estimated_key(name)
            if key is None or not isinstance(table, Mapping):
                advice = did_you_mean(name, list(MEASURABLE)) if key is None else ", or not a table"
                self.violations.append(f"{self.place('estimate', name)}: no key of the machine{advice}")
                continue
            before = len(self.violations)
            places = self.places(table, "estimate", name)
            keys = estimate_keys(key) if name == key.name else ESTIMATE_KEYS
            values: dict[str, Any] = dict(check_table(table, keys, places, self.violations, {}))
            unit = values.setdefault("unit", key.unit)
            if unit not in UNITS or UNITS[unit].dimension != UNITS[key.unit].dimension:
                self.violations.append(f"{self.place('estimate', name, 'unit')} = {unit!r} is not {key.unit!r}")
            if len(self.violations) == before:
                found[name] = Estimate(**{"std": math.nan, "systematic": 0.0, **values})
        return found

    def flux_map(self, file: str | None, folder: Path | None) -> FluxMap | None:
        """The map of ``machine.flux_map`` or of the table ``[flux_map]``; only one that a machine can have."""
        table = self.tables.get("flux_map")
        if table is None and file is None:
            return None
        try:
            if table is not None and file is not None:
                raise ConfigError("is embedded and also named as a file in [machine]; keep one")
            found = flux_map_from_table(table) if file is None else _map_file(file, folder)
            require_monotonic(found)
            return found
        except ConfigError as error:
            place = self.place("flux_map") if table is not None else self.place("machine", "flux_map")
            reason = f"{place}: {f'{error.where}: ' if error.where else ''}{error.what}"
            advice = [f"try: {error.hint}"] if error.hint else []
            self.violations.append("; ".join([reason, *error.violations, *advice]))
            return None

    def iron_loss_map(self, file: str | None, folder: Path | None) -> None:
        """``machine.iron_loss_map``: only that the file is there."""
        if file is not None and folder is not None and not (folder / file).is_file():
            self.violations.append(f"{self.place('machine', 'iron_loss_map')}: no such file: {folder / file}")

    def consistency(self, values: Mapping[str, dict[str, Any]]) -> None:
        """Relations between keys."""

        def ordered(table: str, low: str, high: str) -> None:
            small, large = values[table].get(low), values[table].get(high)
            if small is not None and large is not None and small > large:
                self.violations.append(f"{self.place(table, low)} = {small:g} is above {high} = {large:g}")

        for key in MEASURABLE.values():
            self.deviation(key, values)
        self.friction(values["machine"])
        ordered("machine", "I_nom_apk", "I_max_apk")
        ordered("machine", "n_nom_rpm", "n_max_rpm")
        ordered("machine", "R_winding_ohm", "R_s_ohm")
        ordered("limits", "U_dc_min_v", "U_dc_max_v")
        if values["encoder"].get("direction") == 0:
            self.violations.append(f"{self.place('encoder', 'direction')} = 0, allowed are 1 and -1")
        currents = values["inverter"].get("voltage_error_i_apk", ())
        errors = values["inverter"].get("voltage_error_v", ())
        if len(currents) != len(errors) or len(currents) == 1:
            self.violations.append(
                f"{self.place('inverter', 'voltage_error_v')} has {len(errors)} values for {len(currents)} currents "
                "(two or more of each, or none)"
            )
        elif any(b <= a for a, b in pairwise(currents)):
            self.violations.append(f"{self.place('inverter', 'voltage_error_i_apk')} does not increase")

    def overmodulation(self, values: dict[str, Any]) -> None:
        """Voltages beyond the linear range: what they need and where they end. Below, the linear range is the limit."""
        if any(name not in values for name in ("U_dc_v", "f_s_hz")):
            return
        inverter = InverterParameters(**values)
        if inverter.linear_utilisation < LINEAR_UTILISATION / 2.0:
            self.violations.append(f"{self.place('inverter', 'min_off_time_s')} is more than half of a period")
        place = self.place("inverter", "voltage_utilisation")
        missing = [name for name in OVERMODULATION_NEEDS if values.get(name) is None]
        asked = inverter.voltage_utilisation
        if not inverter.overmodulates:
            values["voltage_utilisation"] = min(asked, inverter.linear_utilisation)
        elif missing:
            self.violations.append(
                f"{place} = {asked:g} is overmodulation (above {LINEAR_UTILISATION:.4f}): "
                f"state {', '.join(missing)}, too"
            )
        elif inverter.shunts == 2:
            self.violations.append(f"{self.place('inverter', 'shunts')} = 2, allowed are 0, 1 and 3")
        elif asked > inverter.largest_utilisation:
            self.violations.append(
                f"{place} = {asked:g} is above {inverter.largest_utilisation:.4f}, the fundamental of six steps with "
                f"this min_off_time_s, sample_window_s and shunts"
            )

    def deviation(self, key: Key, values: Mapping[str, dict[str, Any]]) -> None:
        """A deviation many times the value, or an estimate of another size than the value beside it."""
        value = values[key.table].get(key.name)
        if value is None or key.minimum <= 0.0 or value == 0.0:
            return
        for table in ("std", "systematic"):
            if values[table].get(key.name, 0.0) > LARGEST_RATIO * value:
                self.violations.append(
                    f"{self.place(table, key.name)} = {values[table][key.name]:g} is more than {LARGEST_RATIO} times "
                    f"the value {value:g} {key.unit}"
                )
        found = values["estimate"].get(key.name)
        if found is not None and not value <= LARGEST_RATIO * found.value <= LARGEST_RATIO**2 * value:
            self.violations.append(
                f"{self.place('estimate', key.name, 'value')} = {found.value:g} differs more than {LARGEST_RATIO} "
                f"times from [{key.table}] {key.name} = {value:g} {key.unit}: likely one of the two in another unit"
            )

    def friction(self, machine: Mapping[str, Any]) -> None:
        """Friction at rated speed that the machine could not overcome by far: likely another unit."""
        needed = ("pole_pairs", "R_s_ohm", "psi_f_wb", "L_d_h", "L_q_h", "n_nom_rpm")
        i_a = machine.get("I_max_apk", machine.get("I_nom_apk"))
        if i_a is None or any(name not in machine for name in needed):
            return
        truth = MachineParameters(**{name: machine[name] for name in needed})
        most = max(abs(truth.torque_nm(i_d, i_a)) for i_d in (-i_a, i_a))
        viscous, coulomb = (
            machine.get("B_nms", 0.0) * machine["n_nom_rpm"] * UNITS["rpm"].factor,
            machine.get("tau_c_nm", 0.0),
        )
        friction = viscous + coulomb
        if friction > LARGEST_RATIO * most:
            key = "B_nms" if viscous > coulomb else "tau_c_nm"
            self.violations.append(
                f"{self.place('machine', key)} = {machine[key]:g}: friction of {friction:.3g} N m at n_nom is more "
                f"than {LARGEST_RATIO} times the largest torque, {most:.3g} N m; likely another unit"
            )


def _map_file(file: str, folder: Path | None) -> FluxMap:
    from pmsmtool.machine.flux_map_import import load_flux_map  # start-up: most machine files name no map

    if folder is None:
        raise ConfigError("names a file, but these tables have no folder; embed the map")
    return load_flux_map(folder / file)


def flux_map_table(flux_map: FluxMap) -> dict[str, Any]:
    """Return the table: axes (A peak), ``psi_d_wb[i_d][i_q]``, kind, inverse nodes, metadata as JSON text."""
    table: dict[str, Any] = {"kind": flux_map.kind, "inverse_nodes": list(flux_map.inverse_nodes)}
    if flux_map.meta:
        table["meta"] = meta_json(flux_map)
    return {**table, **{name: getattr(flux_map, name).tolist() for name in _GRIDS}}


@next_step(NEXT_STEP)
def flux_map_from_table(table: Any) -> FluxMap:
    """Return the map of a table.

    Raises ConfigError: a key is missing, unknown or not of numbers, or the grids are no map.
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
