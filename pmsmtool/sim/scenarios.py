# SPDX-License-Identifier: MIT
"""What happens in a simulation: built-in scenarios and TOML scenario files (:data:`FILE_EXAMPLE`)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from pmsmtool.errors import ConfigError, next_step
from pmsmtool.machine.key import Key, Value, check_table, did_you_mean, not_numbers
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.sim.kernel import Target
from pmsmtool.sim.simulated_machine import ROTORS
from pmsmtool.toml_file import read_toml
from pmsmtool.units import RAD_S_PER_RPM

NEXT_STEP = "`pmsmtool help scenario` lists the keys; `pmsmtool simulate --list` names what is built in"

SCHEMA = "pmsmtool.scenario/1"

FILE_EXAMPLE = """\
schema = "pmsmtool.scenario/1"
name = "reversal"
duration_s = 0.4
mode = "speed"            # current, torque, speed, voltage
rotor = "free"            # free, locked, driven; default: as the machine file says
start_rpm = 0.0
decimation = 1            # control periods per row of the trace

[schedule]                # nodes [time in s, value], straight lines between them, two nodes at one time are a step
speed_rpm = [[0.0, 0.0], [0.05, 1000.0], [0.2, 1000.0], [0.2, -1000.0]]
load_nm = 0.5             # a number is a constant

[simulation]              # other values of the machine file's [simulation], for this scenario only
sensor_noise_apk = 0.0
"""
"""A scenario file with every key; what ``pmsmtool help scenario`` shows."""

Profile = Sequence[tuple[float, float]]
"""Nodes (time in s, value), times not decreasing."""

MODES = {"voltage": 1, "current": 2, "torque": 3, "speed": 4}
"""Running modes and their number in the core (``enum pmsm_mode``)."""

SCHEDULES: dict[str, tuple[Target, float]] = {
    "i_d_a": (Target.I_D, 1.0),
    "i_q_a": (Target.I_Q, 1.0),
    "torque_nm": (Target.TORQUE, 1.0),
    "speed_rpm": (Target.SPEED, RAD_S_PER_RPM),
    "u_d_v": (Target.U_D, 1.0),
    "u_q_v": (Target.U_Q, 1.0),
    "load_nm": (Target.LOAD, 1.0),
    "driven_rpm": (Target.DRIVEN_SPEED, RAD_S_PER_RPM),
    "U_dc_v": (Target.U_DC, 1.0),
}
"""Names of a ``[schedule]``, what they move, and the factor to SI."""

LONGEST_S = 3600.0
LATE = 100.0
"""First change after this many durations: milliseconds where seconds are asked for, from a tenth of the run on."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """One run of the simulated drive.

    Attributes
    ----------
    name : str
        What the trace is called.
    duration_s : float
        Simulated time (s).
    mode : str
        Running mode of the drive, a key of :data:`MODES`.
    schedule : mapping of str to Profile
        Names of :data:`SCHEDULES` and their course over time.
    rotor : str
        ``free``, ``locked``, ``driven``, or empty: as the machine file says.
    start_rpm : float
        Mechanical speed at the start (rpm).
    decimation : int
        Control periods per row of the trace.
    simulation : mapping
        ``[simulation]`` keys that differ from the machine file's.
    """

    name: str
    duration_s: float
    mode: str
    schedule: Mapping[str, Profile] = field(default_factory=dict)
    rotor: str = ""
    start_rpm: float = 0.0
    decimation: int = 1
    simulation: Mapping[str, Value] = field(default_factory=dict)

    def __post_init__(self) -> None:
        violations = list(_violations(self))
        if violations:
            raise ConfigError("the scenario cannot be used", where=self.name, violations=violations)


def _violations(scenario: Scenario) -> list[str]:
    found = not_numbers(scenario)
    if found:
        return found
    if not 0.0 < scenario.duration_s <= LONGEST_S:
        found.append(f"duration_s = {scenario.duration_s:g} is outside 0..{LONGEST_S:g} s")
    if scenario.mode not in MODES:
        near = did_you_mean(scenario.mode, list(MODES))
        found.append(f"mode = {scenario.mode!r} is none of {', '.join(MODES)}{near}")
    if scenario.rotor and scenario.rotor not in ROTORS:
        found.append(f"rotor = {scenario.rotor!r} is none of {', '.join(ROTORS)}")
    if scenario.decimation < 1:
        found.append(f"decimation = {scenario.decimation} is below 1")
    if not math.isfinite(scenario.start_rpm):
        found.append("start_rpm is not finite")
    for name, profile in scenario.schedule.items():
        if name not in SCHEDULES:
            near = did_you_mean(name, list(SCHEDULES)) or f", known are {', '.join(SCHEDULES)}"
            found.append(f"[schedule] {name}: unknown{near}")
        elif isinstance(profile, (int, float)):
            found.append(f"[schedule] {name} is a number; write [(0.0, {profile!r})]: times in s and values")
        elif len(profile) == 0:
            found.append(f"[schedule] {name}: has no nodes")
        elif not all(np.shape(node) == (2,) for node in profile):
            found.append(f"[schedule] {name}: a node is not a time in s and a value; write [(0.0, 0.0), (0.01, 1.0)]")
        elif not all(math.isfinite(t) and math.isfinite(v) for t, v in profile):
            found.append(f"[schedule] {name}: a node is not finite")
        elif any(b[0] < a[0] for a, b in pairwise(profile)):
            found.append(f"[schedule] {name}: the times decrease")
        elif len(profile) > 1 and profile[1][0] > LATE * scenario.duration_s:
            found.append(
                f"[schedule] {name}: the first change is at {profile[1][0]:g} s, the run ends at "
                f"{scenario.duration_s:g} s; times are in s"
            )
    return found


# ---- files ---------------------------------------------------------------------------------------------------

KEYS: tuple[Key, ...] = (
    Key("", "name", "text", "", 0, 0, None, "what the trace is called"),
    Key("", "duration_s", "float", "s", 1e-9, LONGEST_S, None, "simulated time", required=True),
    Key("", "mode", "text", "", 0, 0, None, "running mode of the drive", required=True, choices=tuple(MODES)),
    Key("", "rotor", "text", "", 0, 0, "", "how the rotor moves", choices=tuple(ROTORS)),
    Key("", "start_rpm", "float", "rpm", -1e6, 1e6, 0.0, "mechanical speed at the start"),
    Key("", "decimation", "int", "1", 1, 2**31, 1, "control periods per row of the trace"),
)
"""The values of a scenario file outside its tables ``[schedule]`` and ``[simulation]``."""


@next_step(NEXT_STEP)
def load_scenario(path: Path) -> Scenario:
    """Read a scenario file. Raises ConfigError: it cannot be read, or everything that is wrong in it."""
    where = str(path)
    tables = read_toml(Path(path), hint=f"or one of {', '.join(BUILT_IN)}")
    if tables.pop("schema", None) != SCHEMA:
        raise ConfigError("has another schema", where=where, hint=f'a scenario starts with schema = "{SCHEMA}"')
    return _from_tables(tables, where, Path(path).stem)


def _from_tables(tables: dict[str, Any], where: str, stem: str) -> Scenario:
    wrong: list[str] = []
    head = {name: value for name, value in tables.items() if name not in ("schedule", "simulation")}
    values: dict[str, Any] = dict(check_table(head, KEYS, {"": where, **{k: f"{where}: {k}" for k in head}}, wrong, {}))
    profiles: dict[str, Profile] = {}
    for key in ("schedule", "simulation"):
        if not isinstance(tables.get(key, {}), dict):
            wrong.append(f"{key} is not a table")
    if not wrong:
        profiles = {name: _profile(name, nodes, wrong) for name, nodes in tables.get("schedule", {}).items()}
    if wrong:
        raise ConfigError("the scenario cannot be used", where=where, violations=wrong)
    try:
        return Scenario(**{"name": stem, **values}, schedule=profiles, simulation=tables.get("simulation", {}))
    except ConfigError as error:
        raise ConfigError(error.what, where=where, violations=error.violations) from None


def _profile(name: str, nodes: Any, wrong: list[str]) -> Profile:
    if isinstance(nodes, int | float) and not isinstance(nodes, bool):
        return ((0.0, float(nodes)),)
    good = isinstance(nodes, list) and all(
        isinstance(node, list)
        and len(node) == 2
        and all(isinstance(number, int | float) and not isinstance(number, bool) for number in node)
        for node in nodes
    )
    if not good:
        wrong.append(f"[schedule] {name}: is neither a number nor a list of [time, value]")
        return ()
    return tuple((float(t), float(v)) for t, v in nodes)


# ---- built-in -----------------------------------------------------------------------------------------------------


SAG_FALL_S = 0.005
"""Time (s) in which the link falls to the share of its voltage that designs reckon with, and comes back."""
REACHED_SHARE = 0.95
"""End of the field-weakening sweep over the speed whose back-EMF the most negative i_d still holds."""


@dataclass(frozen=True, slots=True)
class _Scale:
    """What the built-in scenarios are sized with."""

    i_a: float
    i_d_min_a: float
    n_rpm: float
    n_top_rpm: float
    torque_nm: float
    J_kgm2: float
    U_dc_v: float


def _scale(machine_file: MachineFile, values: Mapping[str, float]) -> _Scale:
    machine = machine_file.machine
    i_a = machine.I_nom_apk or values["motor.I_nom_apk"]
    psi = math.hypot(machine.psi_f_wb, machine.L_q_decoupling_h * i_a)
    base_rpm = 0.9 * machine_file.inverter.V_max_v / (machine.pole_pairs * psi) / RAD_S_PER_RPM
    n_rpm = machine.n_nom_rpm or base_rpm
    psi_least = machine.psi_f_wb + machine.L_d_h * values["field_weakening.i_d_min_a"]
    V_m = (1.0 - values["field_weakening.margin"]) * machine_file.inverter.V_max_v
    reached_rpm = V_m / (machine.pole_pairs * psi_least) / RAD_S_PER_RPM if psi_least > 0.0 else math.inf
    return _Scale(
        i_a=i_a,
        i_d_min_a=max(values["field_weakening.i_d_min_a"], -i_a),
        n_rpm=n_rpm,
        n_top_rpm=max(n_rpm, min(machine.n_max_rpm or 2.0 * n_rpm, REACHED_SHARE * reached_rpm)),
        torque_nm=abs(machine.torque_nm(0.0, i_a)),
        J_kgm2=machine.J_kgm2 or 0.0,
        U_dc_v=machine_file.inverter.U_dc_v,
    )


def _current_steps(scale: _Scale, name: str) -> Scenario:
    half, speed = 0.5 * scale.i_a, 0.5 * scale.n_rpm
    return Scenario(
        name=name,
        duration_s=0.1,
        mode="current",
        rotor="driven",
        start_rpm=speed,
        schedule={
            "i_d_a": (
                (0.0, 0.0),
                (0.02, 0.0),
                (0.02, 0.5 * scale.i_d_min_a),
                (0.08, 0.5 * scale.i_d_min_a),
                (0.08, 0.0),
            ),
            "i_q_a": ((0.0, 0.0), (0.04, 0.0), (0.04, half), (0.06, half), (0.06, -half)),
            "driven_rpm": ((0.0, speed),),
        },
    )


def _q_step(scale: _Scale, name: str) -> Scenario:
    speed = 0.5 * scale.n_rpm
    return Scenario(
        name=name,
        duration_s=0.05,
        mode="current",
        rotor="driven",
        start_rpm=speed,
        schedule={"i_q_a": ((0.0, 0.0), (0.01, 0.0), (0.01, scale.i_a)), "driven_rpm": ((0.0, speed),)},
    )


def _ramp_time(scale: _Scale, speed_rpm: float) -> float:
    """Time that a third of the rated torque needs to a speed, 0.2 s to 5 s."""
    if not scale.J_kgm2 or not scale.torque_nm:
        return 1.0
    return min(max(3.0 * scale.J_kgm2 * speed_rpm * RAD_S_PER_RPM / scale.torque_nm, 0.2), 5.0)


def _speed_ramp(scale: _Scale, name: str) -> Scenario:
    ramp = _ramp_time(scale, scale.n_rpm)
    return Scenario(
        name=name,
        duration_s=2.5 * ramp + 0.1,
        mode="speed",
        rotor="free",
        schedule={"speed_rpm": ((0.0, 0.0), (0.05, 0.0), (0.05 + ramp, scale.n_rpm))},
    )


def _load_step(scale: _Scale, name: str) -> Scenario:
    speed, load = 0.5 * scale.n_rpm, 0.5 * scale.torque_nm
    return Scenario(
        name=name,
        duration_s=1.0,
        mode="speed",
        rotor="free",
        start_rpm=speed,
        schedule={
            "speed_rpm": ((0.0, speed),),
            "load_nm": ((0.0, 0.0), (0.2, 0.0), (0.2, load), (0.6, load), (0.6, 0.0)),
        },
    )


def _field_weakening_sweep(scale: _Scale, name: str) -> Scenario:
    low, torque = 0.2 * scale.n_rpm, 0.5 * scale.torque_nm
    return Scenario(
        name=name,
        duration_s=1.0,
        mode="torque",
        rotor="driven",
        start_rpm=low,
        schedule={
            "torque_nm": ((0.0, 0.0), (0.05, torque)),
            "driven_rpm": ((0.0, low), (0.1, low), (0.9, scale.n_top_rpm)),
        },
    )


def _dc_sag(scale: _Scale, name: str) -> Scenario:
    from pmsmtool.design.ratings import SAG_SHARE

    U, low = scale.U_dc_v, SAG_SHARE * scale.U_dc_v
    return Scenario(
        name=name,
        duration_s=0.3,
        mode="torque",
        rotor="driven",
        start_rpm=scale.n_rpm,
        schedule={
            "torque_nm": ((0.0, 0.0), (0.05, 0.5 * scale.torque_nm)),
            "driven_rpm": ((0.0, scale.n_rpm),),
            "U_dc_v": ((0.0, U), (0.1, U), (0.1 + SAG_FALL_S, low), (0.2, low), (0.2 + SAG_FALL_S, U)),
        },
    )


BUILT_IN: dict[str, tuple[str, Callable[[_Scale, str], Scenario]]] = {
    "current-steps": ("steps of i_d and i_q at half the rated speed, rotor driven", _current_steps),
    "q-step": ("one step of i_q to the rated current at half the rated speed, rotor driven", _q_step),
    "speed-ramp": ("speed ramp from standstill to the rated speed, rotor free", _speed_ramp),
    "load-step": ("half the rated torque on and off at half the rated speed, rotor free", _load_step),
    "field-weakening-sweep": (
        "half the rated torque while the rotor is driven to n_max, or as far as i_d_min holds the voltage",
        _field_weakening_sweep,
    ),
    "dc-sag": ("the DC link falls to 70 % and comes back under half the rated torque at the rated speed", _dc_sag),
}
"""Built-in scenarios: what they do, and how they are sized for a machine."""


def built_in(name: str, machine_file: MachineFile, values: Mapping[str, float]) -> Scenario:
    """Return a built-in scenario sized for a machine and its drive's parameters.

    Raises ConfigError: no scenario has that name.
    """
    if name not in BUILT_IN:
        raise ConfigError(
            f"there is no scenario {name!r}{did_you_mean(name, list(BUILT_IN))}",
            hint=f"a scenario file, or one of {', '.join(BUILT_IN)}",
        )
    return BUILT_IN[name][1](_scale(machine_file, values), name)
