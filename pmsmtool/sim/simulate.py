# SPDX-License-Identifier: MIT
"""Simulate a design, a machine file or a profile: find the drive, find the scenario, run it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from pmsmtool.errors import ConfigError
from pmsmtool.machine.key import Value
from pmsmtool.machine.machine_file import SCHEMA as MACHINE_SCHEMA
from pmsmtool.machine.machine_file import MachineFile, load_machine_file
from pmsmtool.machine.profile import machine_path
from pmsmtool.params.parameter_set import ParameterSet, read_parameter_set
from pmsmtool.sim.closed_loop import drive_values, simulate
from pmsmtool.sim.scenarios import Scenario, built_in, load_scenario
from pmsmtool.sim.simulated_machine import with_simulation
from pmsmtool.toml_file import read_toml
from pmsmtool.trace import Trace

DESIGN_SCHEMA = "pmsmtool.design/1"


@dataclass(frozen=True, slots=True)
class SimulatedDrive:
    """A machine and the parameters of its drive.

    Attributes
    ----------
    machine : MachineFile
        Machine and ``[simulation]``.
    params : ParameterSet
        What the drive runs with.
    origin : str
        ``design``, or how the parameters were found.
    notes : tuple of str
        What its design has to say.
    """

    machine: MachineFile
    params: ParameterSet
    origin: str
    notes: tuple[str, ...] = ()


def find_drive(source: str, params: Path | None = None) -> SimulatedDrive:
    """Return the drive that a design, a machine file, a run directory or a profile's name describes.

    A machine without a design is given the parameters that ``tune`` makes for it.

    Parameters
    ----------
    source : str
        File, folder or profile name.
    params : Path, optional
        A parameter set that is laid over the others.

    Raises
    ------
    ConfigError
        There is no such thing, or what is wrong with it.
    DesignInfeasible
        No design for this machine.
    """
    path = _path(source)
    schema = _schema(path)
    if schema == DESIGN_SCHEMA:
        from pmsmtool.design.design_file import load_design

        design = load_design(path)
        found = SimulatedDrive(design.machine, design.parameter_set(), "design")
    elif schema == MACHINE_SCHEMA:
        from pmsmtool.design.tune import tune

        machine_file = load_machine_file(path)
        made = tune(machine_file)
        found = SimulatedDrive(machine_file, made.parameter_set(), "designed by the rules of `tune`", made.notes)
    else:
        raise ConfigError(
            f"schema is {schema!r}, expected {DESIGN_SCHEMA!r} or {MACHINE_SCHEMA!r}",
            where=str(path),
            hint="give a design.toml, a machine file or the name of a profile",
        )
    if params is None:
        return found
    return replace(
        found, params=found.params.merged(read_parameter_set(params)), origin=f"{found.origin}, {params.name}"
    )


def _path(source: str) -> Path:
    design = Path(source) / "design.toml"
    return design if design.is_file() else machine_path(source)


def _schema(path: Path) -> object:
    return read_toml(path, hint="`pmsmtool sim list` names the profiles").get("schema")


def find_scenario(name: str, drive: SimulatedDrive) -> Scenario:
    """Return a scenario file, or a built-in scenario sized for the drive.

    Raises
    ------
    ConfigError
        Neither a file nor a built-in name, or what is wrong with the file.
    """
    path = Path(name)
    if path.suffix == ".toml" or path.is_file():
        return load_scenario(path)
    return built_in(name, drive.machine, drive_values(drive.machine, drive.params))


def run_scenario(
    drive: SimulatedDrive,
    scenario: Scenario,
    *,
    seed: int | None = None,
    duration_s: float | None = None,
    simulation: Mapping[str, Value] | None = None,
) -> Trace:
    """Simulate a scenario on a drive.

    Parameters
    ----------
    drive, scenario
        From :func:`find_drive` and :func:`find_scenario`.
    seed : int, optional
        Seed of the noise.
    duration_s : float, optional
        Another duration than the scenario's (s).
    simulation : mapping, optional
        ``[simulation]`` keys that differ from the machine file's and the scenario's.

    Raises
    ------
    ConfigError
        What cannot be simulated together.
    """
    if duration_s is not None:
        scenario = replace(scenario, duration_s=duration_s)
    if simulation:
        with_simulation(drive.machine, simulation)  # names the wrong keys before anything runs
        scenario = replace(scenario, simulation={**scenario.simulation, **simulation})
    return simulate(drive.machine, drive.params, scenario, seed=seed)
