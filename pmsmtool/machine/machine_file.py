# SPDX-License-Identifier: MIT
"""The machine file: one TOML text that holds what is known of a machine, its inverter and their doubt.

``parse_machine`` lists everything that is wrong at once; ``dump_machine_file`` writes the same file, same bytes. A
design file embeds the same tables (``machine_tables``, ``machine_from_tables``).
A machine is named by a file, a run directory, or a profile that ships with the package.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from pmsmtool.errors import ConfigError, next_step
from pmsmtool.files import data_folder, near_names, read_text
from pmsmtool.machine.flux_map import FluxMap
from pmsmtool.machine.key import Value
from pmsmtool.machine.machine_keys import MEASURABLE
from pmsmtool.machine.machine_reader import MachineReader, flux_map_table
from pmsmtool.machine.parameters import (
    EncoderParameters,
    Estimate,
    InverterParameters,
    MachineLimits,
    MachineParameters,
)
from pmsmtool.machine.simulation_keys import SIMULATION_KEYS, resolved_simulation
from pmsmtool.plain_text import Summarised, Summary
from pmsmtool.toml_file import parse_toml, refuse_schema, toml_lines, toml_text

NAMED = "`pmsmtool sim list` names the profiles, `pmsmtool machine new` writes a file from a data sheet"
"""Next step where a machine is not found."""


def profile_names() -> list[str]:
    """Return the names of the profiles that ship with the package."""
    return sorted(path.stem for path in data_folder("profiles").glob("*.toml"))


def machine_path(source: str | Path) -> Path:
    """Return the machine file of a path, a run directory or a profile name; a path that ends in .toml may be missing.

    Raises ConfigError: there is neither such a file nor such a profile.
    """
    path = Path(source)
    if path.suffix == ".toml" or path.is_file():
        return path
    if (path / "machine.toml").is_file():
        return path / "machine.toml"
    profile = data_folder("profiles") / f"{source}.toml"
    if profile.is_file():
        return profile
    if path.is_dir():
        raise ConfigError(
            "there is no machine.toml in this folder",
            where=str(path),
            hint="give the machine file itself, a run directory of identify or commission, or the name of a profile",
        )
    from difflib import get_close_matches

    near = get_close_matches(str(source).lower(), profile_names(), 3)
    raise ConfigError(
        f"no profile and no file is named {str(source)!r}",
        likely=f"did you mean {' or '.join(near)}?" if near else near_names(path),
        hint=NAMED,
    )


NEXT_STEP = "`pmsmtool help machine-file` lists the keys; `pmsmtool machine new` writes a file from a data sheet"

SCHEMA = "pmsmtool.machine/1"

_HASHED: tuple[str, ...] = ("machine", "inverter", "std", "systematic", "encoder", "limits")

Record = Mapping[str, Any]


@dataclass(frozen=True, slots=True, repr=False)
class MachineFile(Summarised):
    """What a machine file says.

    Attributes
    ----------
    name : str
        Name of machine and drive together.
    machine, inverter, encoder, limits
        The parameters, as numbers.
    std, systematic : mapping of str to float
        Standard deviation and 95 % systematic part of keys of machine, inverter and encoder, in their unit.
    estimates : mapping of str to Estimate
        What ``identify`` left, by key; a key may carry a bias label after an underscore (``L_q_h_at_rated``).
    conditions, provenance : mapping
        Records: free keys, plain values.
    simulation : mapping of str to float, int, bool or str
        ``[simulation]`` as given; :meth:`simulation_settings` fills in the defaults.
    flux_map : FluxMap or None
        The saturated machine; ``machine.flux_map`` is its file, None when it is embedded.
    """

    name: str
    machine: MachineParameters
    inverter: InverterParameters
    std: Mapping[str, float] = field(default_factory=dict)
    systematic: Mapping[str, float] = field(default_factory=dict)
    estimates: Mapping[str, Estimate] = field(default_factory=dict)
    encoder: EncoderParameters = field(default_factory=EncoderParameters)
    limits: MachineLimits = field(default_factory=MachineLimits)
    conditions: Record = field(default_factory=dict)
    provenance: Record = field(default_factory=dict)
    simulation: Mapping[str, Value] = field(default_factory=dict)
    flux_map: FluxMap | None = None

    def summary(self) -> Summary:
        """Return the values of machine and inverter."""
        given = {**asdict(self.machine), **asdict(self.inverter)}
        rows = [
            (
                key,
                value if isinstance(value, str) else f"{value:.6g}",
                f"{self.std[key]:.2g}" if key in self.std else "",
            )
            for key, value in given.items()
            if isinstance(value, (str, int, float)) and not isinstance(value, bool)
        ]
        return Summary(f"machine file {self.name}", ("key", "value", "std"), rows)

    def seen(self, condition: str) -> float:
        """Return a number among the conditions, 0 where there is none."""
        value = self.conditions.get(condition)
        return float(value) if isinstance(value, (int, float)) else 0.0

    def simulation_settings(self) -> dict[str, Value]:
        """Return every ``[simulation]`` key with the value that holds, defaults and fall-backs filled in."""
        tables = {name: _plain(getattr(self, name)) for name in ("machine", "inverter", "encoder")}
        return resolved_simulation(dict(self.simulation), tables)

    def content_hash(self) -> str:
        """Return the SHA-256 of what decides a design: parameters, deviations, encoder, limits and flux map.

        Name, estimates, conditions, provenance and ``[simulation]`` do not enter, nor where the map lies.
        """
        tables = machine_tables(self)
        kept = {name: tables[name] for name in _HASHED if name in tables}
        kept["machine"] = {key: value for key, value in kept["machine"].items() if key != "flux_map"}
        text = toml_text(kept) + (self.flux_map.content_hash() if self.flux_map else "")
        return hashlib.sha256(text.encode()).hexdigest()


@next_step(NEXT_STEP)
def load_machine_file(source: str | Path) -> MachineFile:
    """Read a machine file, or that of a run directory or of a shipped profile's name, and the flux map it names.

    Raises
    ------
    ConfigError
        There is no such file, it cannot be read, or everything that is wrong in it.
    """
    path = machine_path(source)
    text = read_text(path, hint=NAMED)
    return parse_machine(text, where=str(path), folder=Path(path).parent)


@next_step(NEXT_STEP)
def parse_machine(text: str, *, where: str = "machine file", folder: Path | None = None) -> MachineFile:
    """Parse the text of a machine file. Raises ConfigError: not TOML, another schema, or a list of all violations.

    Parameters
    ----------
    text : str
        TOML.
    where : str
        Named in errors.
    folder : Path or None
        Where relative file names start; None refuses files beside the text.
    """
    tables = parse_toml(text, where=where)
    hint = f'give a machine file: one that begins with schema = "{SCHEMA}"'
    refuse_schema(tables.pop("schema", None), SCHEMA, where=where, hint=hint)
    return machine_from_tables(tables, where=where, folder=folder, lines=toml_lines(text))


def no_design(schema: object, path: str, hint: str = "") -> dict[str, str]:
    """Return cause and next step of a file that was given where a design is due; ``hint`` where it is no machine."""
    if schema != SCHEMA:
        return {"hint": hint}
    return {"likely": "a machine has no gains yet", "hint": f"`pmsmtool tune {path} -o design.toml` designs them"}


@next_step(NEXT_STEP)
def machine_from_tables(
    tables: Record,
    *,
    where: str = "machine",
    folder: Path | None = None,
    lines: Mapping[tuple[str, ...], int] | None = None,
    path: tuple[str, ...] = (),
) -> MachineFile:
    """Build a machine from tables as in a machine file, without its schema. Raises ConfigError: with all violations.

    Parameters
    ----------
    tables : mapping
        ``name`` and the tables.
    where, folder
        As in :func:`parse_machine`.
    lines : mapping, optional
        Line of each key (``toml_text.toml_lines``).
    path : tuple of str
        Tables these tables stand in, for a file that embeds a machine.
    """
    reader = MachineReader(tables, where, dict(lines or {}), path)
    parts = reader.read(folder)
    if reader.violations:
        count = len(reader.violations)
        what = "1 thing is wrong in this machine" if count == 1 else f"{count} things are wrong in this machine"
        raise ConfigError(what, where=where, violations=reader.violations)
    return MachineFile(
        name=parts["name"],
        machine=MachineParameters(**parts["machine"]),
        inverter=InverterParameters(**parts["inverter"]),
        std=parts["std"],
        systematic=parts["systematic"],
        estimates=parts["estimate"],
        encoder=EncoderParameters(**parts["encoder"]),
        limits=MachineLimits(**parts["limits"]),
        conditions=parts["conditions"],
        provenance=parts["provenance"],
        simulation=parts["simulation"],
        flux_map=parts["flux_map"],
    )


def _plain(values: Any) -> dict[str, Any]:
    """Fields of a dataclass that hold a value, in their order."""
    pairs = ((item.name, getattr(values, item.name)) for item in fields(values))
    return {name: value for name, value in pairs if value is not None and value != ()}


def _estimate_table(estimate: Estimate) -> dict[str, Any]:
    pairs = _plain(estimate).items()
    return {
        name: value
        for name, value in pairs
        if value != "" and not (isinstance(value, float) and not math.isfinite(value))
    }


def machine_tables(machine_file: MachineFile, *, embed_flux_map: bool = False) -> dict[str, Any]:
    """Return the tables of a machine file, without its schema.

    Parameters
    ----------
    machine_file : MachineFile
        The machine.
    embed_flux_map : bool
        Put the flux map itself in instead of the name of its file, so that the tables are complete alone.
    """
    machine = _plain(machine_file.machine)
    embed = machine_file.flux_map is not None and (embed_flux_map or "flux_map" not in machine)
    if embed:
        machine.pop("flux_map", None)
    tables: dict[str, Any] = {
        "name": machine_file.name,
        "machine": machine,
        "inverter": _plain(machine_file.inverter),
        "std": _in_order(machine_file.std),
        "systematic": _in_order(machine_file.systematic),
        "encoder": _plain(machine_file.encoder),
        "limits": _plain(machine_file.limits),
        "estimate": {name: _estimate_table(e) for name, e in sorted(machine_file.estimates.items())},
        "conditions": dict(sorted(machine_file.conditions.items())),
        "provenance": dict(sorted(machine_file.provenance.items())),
        "simulation": {
            key.name: machine_file.simulation[key.name]
            for key in SIMULATION_KEYS
            if key.name in machine_file.simulation
        },
    }
    if embed and machine_file.flux_map is not None:
        tables["flux_map"] = flux_map_table(machine_file.flux_map)
    return {name: value for name, value in tables.items() if value != {}}


def _in_order(values: Mapping[str, float]) -> dict[str, float]:
    return {name: float(values[name]) for name in MEASURABLE if name in values}


def dump_machine_file(machine_file: MachineFile, *, embed_flux_map: bool = False) -> str:
    """Return the machine file's text: same machine, same bytes, and ``parse_machine`` gives it back.

    A map that has no file of its own is always embedded.
    """
    return toml_text({"schema": SCHEMA, **machine_tables(machine_file, embed_flux_map=embed_flux_map)})
