# SPDX-License-Identifier: MIT
"""Simulate a design, a machine file or a profile: find the drive, find the scenario, run it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from pmsmtool.machine.key import Value
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.params.parameter_set import ParameterSet, read_parameter_set
from pmsmtool.sim import closed_loop
from pmsmtool.sim.closed_loop import drive_values
from pmsmtool.sim.scenarios import Scenario, built_in, load_scenario
from pmsmtool.sim.simulated_machine import with_simulation
from pmsmtool.trace import Trace

if TYPE_CHECKING:
    from pmsmtool.design.design_file import Design


@dataclass(frozen=True, slots=True)
class SimulatedDrive:
    """A machine and the parameters of its drive."""

    machine: MachineFile
    """Machine and ``[simulation]``."""
    params: ParameterSet
    """What the drive runs with."""
    origin: str
    """``design``, or how the parameters were found."""
    notes: tuple[str, ...] = ()
    """What its design has to say."""


def find_drive(source: str | Path | Design | MachineFile, params: Path | None = None) -> SimulatedDrive:
    """Return the drive that a design, a machine file, a run directory or a profile's name describes.

    A machine without a design is given the parameters that ``tune`` makes for it.

    Raises ConfigError: there is no such thing, or what is wrong with it; DesignInfeasible: no design for this machine.

    Parameters
    ----------
    source : str, Path, Design or MachineFile
        File, folder or profile name, or what such a file holds.
    params : Path, optional
        A parameter set that is laid over the others.
    """
    from pmsmtool.design.design_file import load_machine_or_design

    machine, design = load_machine_or_design(source)
    if design is None:
        from pmsmtool.design.tune import tune

        made = tune(machine)
        found = SimulatedDrive(machine, made.parameter_set(), "designed by the rules of `tune`", made.notes)
    else:
        found = SimulatedDrive(machine, design.parameter_set(), "design")
    if params is None:
        return found
    return replace(
        found, params=found.params.merged(read_parameter_set(params)), origin=f"{found.origin}, {params.name}"
    )


def find_scenario(name: str, drive: SimulatedDrive) -> Scenario:
    """Return a scenario file, or a built-in scenario sized for the drive.

    Raises ConfigError: neither a file nor a built-in name, or what is wrong with the file.
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
    """Simulate a scenario on a drive. Raises ConfigError: what cannot be simulated together.

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
    """
    if duration_s is not None:
        scenario = replace(scenario, duration_s=duration_s)
    if simulation:
        with_simulation(drive.machine, simulation)  # names the wrong keys before anything runs
        scenario = replace(scenario, simulation={**scenario.simulation, **simulation})
    return closed_loop.simulate(drive.machine, drive.params, scenario, seed=seed)


def simulate(
    source: str | Path | Design | MachineFile,
    scenario: str | Scenario = "current-steps",
    *,
    seed: int | None = None,
    duration_s: float | None = None,
    simulation: Mapping[str, Value] | None = None,
) -> Trace:
    """Simulate a drive in closed loop and return its signals, as the command of the same name does.

    Parameters
    ----------
    source : str, Path, Design or MachineFile
        What is simulated; text names a file, a run directory or a shipped profile.
    scenario : str or Scenario
        Built-in name (``pmsmtool simulate --list``), scenario file, or a scenario.
    seed, duration_s, simulation
        As for :func:`run_scenario`.

    Examples
    --------
    >>> import pmsmtool
    >>> trace = pmsmtool.simulate("jercic-2017", "current-steps")
    >>> trace.units["i_q_a"], bool(abs(trace["i_q_a"]).max() > 1.0)
    ('A', True)
    """
    drive = find_drive(source)
    wanted = scenario if isinstance(scenario, Scenario) else find_scenario(scenario, drive)
    return run_scenario(drive, wanted, seed=seed, duration_s=duration_s, simulation=simulation)
