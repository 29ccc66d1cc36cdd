# SPDX-License-Identifier: MIT
"""Closed-loop simulation: machine, parameters and scenario in, a trace out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pmsmtool.errors import ConfigError
from pmsmtool.firmware.image import pack_image
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.params.catalogue import CATALOGUE
from pmsmtool.params.parameter_set import TABLE_NAMES, ParameterSet
from pmsmtool.sim.kernel import Application, Part, Rotor, Signal, Simulation, Truth
from pmsmtool.sim.scenarios import MODES, SCHEDULES, Scenario
from pmsmtool.sim.simulated_machine import (
    RECORD_COMPENSATION,
    ROTORS,
    build_setup,
    own_compensation,
    records_compensation,
    with_simulation,
)
from pmsmtool.trace import Trace
from pmsmtool.units import RAD_S_PER_RPM

ROWS_MAX = 20_000_000
"""Rows of a trace; more do not fit a memory that has other things to do (26 signals: 4 GB)."""

DRIVE_SIGNALS: dict[str, tuple[Signal, str]] = {
    "i_d_a": (Signal.I_D, "A"),
    "i_q_a": (Signal.I_Q, "A"),
    "i_d_req_a": (Signal.I_D_REQ, "A"),
    "i_q_req_a": (Signal.I_Q_REQ, "A"),
    "i_d_ref_a": (Signal.I_D_REF, "A"),
    "i_q_ref_a": (Signal.I_Q_REF, "A"),
    "u_d_v": (Signal.U_D, "V"),
    "u_q_v": (Signal.U_Q, "V"),
    "u_d_lim_v": (Signal.U_D_LIM, "V"),
    "u_q_lim_v": (Signal.U_Q_LIM, "V"),
    "theta_e_rad": (Signal.THETA_E, "rad"),
    "omega_e_rad_s": (Signal.OMEGA_E, "rad/s"),
    "torque_nm": (Signal.TAU, "N m"),
    "U_dc_v": (Signal.U_DC, "V"),
    "T_winding_c": (Signal.T_WINDING, "degC"),
    "kappa": (Signal.KAPPA, "1"),
    "flags": (Signal.FLAGS, "1"),
}
"""What the drive itself sees; names as in its live values."""

TRUE_SIGNALS: dict[str, tuple[Truth, str]] = {
    "i_d_true_a": (Truth.I_D, "A"),
    "i_q_true_a": (Truth.I_Q, "A"),
    "torque_true_nm": (Truth.TORQUE, "N m"),
    "load_nm": (Truth.LOAD, "N m"),
    "omega_m_rad_s": (Truth.OMEGA_M, "rad/s"),
    "theta_m_rad": (Truth.THETA_M, "rad"),
    "T_winding_true_c": (Truth.T_WINDING, "degC"),
    "trip": (Truth.TRIP, "1"),
}
"""What only the simulation knows."""


def drive_values(machine_file: MachineFile, params: ParameterSet) -> dict[str, float]:
    """Return every parameter of the simulated drive: defaults, the set, and the compensation built into the drive."""
    values = {row.name: row.default for row in CATALOGUE} | dict(params.values)
    values |= own_compensation(machine_file)
    if records_compensation(machine_file):
        values["current.options"] = float(int(values["current.options"]) | RECORD_COMPENSATION)
    return values


def image_of(machine_file: MachineFile, params: ParameterSet) -> bytes:
    """Return the parameter image of the simulated drive.

    Raises ConfigError: values out of range, or tables that do not fit their descriptor.
    """
    values = drive_values(machine_file, params)
    if not params.tables:
        return pack_image(values)
    from pmsmtool.drive_maps.map_tables import encode_table, look_up_words

    encoded = {name: encode_table(name, params.tables[name], values) for name in TABLE_NAMES if name in params.tables}
    return pack_image(values, look_up_words(encoded))


def simulate(
    machine_file: MachineFile,
    params: ParameterSet,
    scenario: Scenario,
    *,
    seed: int | None = None,
    application: Application = Application.DRIVE,
) -> Trace:
    """Run a scenario on the simulated drive.

    Row k holds what was sampled at ``t_s[k]`` and what the drive computed from it; with the usual delay of 1.5 periods
    the voltage of row k acts from ``t_s[k + 1]`` on.

    Parameters
    ----------
    machine_file : MachineFile
        The machine and its ``[simulation]`` table.
    params : ParameterSet
        Parameters of the drive; what is missing has the catalogue's default.
    scenario : Scenario
        What happens.
    seed : int, optional
        Seed of the noise; default the machine file's.
    application : Application
        The whole drive (speed estimate, trips), or the control core with the exact angle speed.

    Returns
    -------
    Trace
        Signals of :data:`DRIVE_SIGNALS` and :data:`TRUE_SIGNALS`; ``meta`` says what was simulated and what of it
        is to be doubted (``outside_flux_map``, ``event_overruns``: evaluations outside the map, events not resolved).

    Raises
    ------
    ConfigError
        The machine, the parameters or the scenario cannot be simulated together.
    """
    machine_file, simulation, periods = open_simulation(machine_file, params, scenario, seed, application)
    rows = -(-periods // scenario.decimation)
    if rows > ROWS_MAX:
        raise ConfigError(f"{rows} rows are too many", where=scenario.name, hint="choose a larger decimation")
    columns: dict[str, tuple[Any, str]] = {**DRIVE_SIGNALS, **TRUE_SIGNALS}
    record = simulation.record([Truth.T, *(signal for signal, _ in columns.values())], rows, scenario.decimation)
    simulation.run(periods)
    values = np.ascontiguousarray(record[: simulation.recorded_rows].T)
    return Trace(
        t_s=values[0],
        signals={name: values[k] for k, name in enumerate(columns, start=1)},
        units={name: unit for name, (_, unit) in columns.items()},
        meta=_meta(machine_file, params, scenario, simulation, seed),
    )


def open_simulation(
    machine_file: MachineFile,
    params: ParameterSet,
    scenario: Scenario,
    seed: int | None = None,
    application: Application = Application.DRIVE,
) -> tuple[MachineFile, Simulation, int]:
    """Return the machine as the scenario changes it, the enabled drive at time zero, and the periods to run.

    Parameters and errors are those of :func:`simulate`.
    """
    changed = ({"rotor": scenario.rotor} if scenario.rotor else {}) | dict(scenario.simulation)
    machine_file = with_simulation(machine_file, changed)
    setup, keep = build_setup(
        machine_file, seed=seed, application=application, start_rad_s=RAD_S_PER_RPM * scenario.start_rpm
    )
    _check(machine_file, params, scenario, setup.machine.rotor)
    simulation = Simulation(setup, image_of(machine_file, params), keep)
    for name, profile in scenario.schedule.items():
        target, factor = SCHEDULES[name]
        simulation.schedule(target, [t for t, _ in profile], [factor * v for _, v in profile])
    simulation.reference.mode = MODES[scenario.mode]
    simulation.word(Part.ENABLED).value = 1
    T_s = 1e-9 * simulation.params.inverter_T_s_ns
    return machine_file, simulation, max(1, round(scenario.duration_s / T_s))


def _check(machine_file: MachineFile, params: ParameterSet, scenario: Scenario, rotor: int) -> None:
    wrong: list[str] = []
    if scenario.mode == "speed" and drive_values(machine_file, params)["speed.K_p_nms_per_rad"] == 0.0:
        wrong.append("mode speed needs a speed controller, speed.K_p_nms_per_rad is 0")
    if "driven_rpm" in scenario.schedule and rotor != Rotor.DRIVEN:
        names = {number: name for name, number in ROTORS.items()}
        wrong.append(f'driven_rpm needs rotor = "driven", it is "{names[Rotor(rotor)]}"')
    if rotor == Rotor.LOCKED and scenario.start_rpm != 0.0:
        wrong.append("a locked rotor does not turn: start_rpm must be 0")
    if wrong:
        raise ConfigError(
            "the scenario does not fit the drive",
            where=scenario.name,
            violations=wrong,
            hint="correct the scenario, or the parameters it runs with",
        )


def _meta(
    machine_file: MachineFile,
    params: ParameterSet,
    scenario: Scenario,
    simulation: Simulation,
    seed: int | None,
) -> Mapping[str, Any]:
    settings = machine_file.simulation_settings()
    flux_map = machine_file.flux_map
    return {
        "machine": machine_file.name,
        "machine_sha256": machine_file.content_hash(),
        "params": params.content_hash(),
        "scenario": scenario.name,
        "mode": scenario.mode,
        "T_s": 1e-9 * simulation.params.inverter_T_s_ns,
        "delay_periods": machine_file.inverter.delay_periods,
        "inverter_model": settings["inverter_model"],
        "magnetics": "constant inductances" if flux_map is None else flux_map.interpolation(),
        "seed": settings["seed"] if seed is None else seed,
        **simulation.counts(),
    }
