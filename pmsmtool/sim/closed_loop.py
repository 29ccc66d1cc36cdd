# SPDX-License-Identifier: MIT
"""Closed-loop simulation: machine, parameters and scenario in, a trace out; or many drives at once.

Many drives run in one call over all cores, with the same parameters and the same scenario on machines that differ. Each
runs exactly as :func:`simulate` runs it alone (``monte_carlo.c``): the numbers depend neither on the number of threads
nor on the other drives.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.errors import ConfigError
from pmsmtool.firmware.image import pack_image
from pmsmtool.machine.flux_map import FluxScale, ScalableMap
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.params.catalogue import CATALOGUE
from pmsmtool.params.parameter_set import TABLE_NAMES, ParameterSet
from pmsmtool.sim.kernel import STRUCTS, Application, Part, Rotor, Setup, Signal, Simulation, Truth, library
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


THREADS_MAX = 64
"""``PMSM_MONTE_CARLO_THREADS_MAX``."""


@dataclass(frozen=True, slots=True)
class Variation:
    """One machine among many."""

    R: float = 1.0
    L_d: float = 1.0
    L_q: float = 1.0
    psi_f: float = 1.0
    J: float = 1.0
    """Factors over the machine file; L_d and L_q of what the currents add to a flux map."""
    encoder_rad: float = 0.0
    """Electrical angle that the encoder's offset is off (rad)."""
    T_winding_c: float | None = None
    T_magnet_c: float | None = None
    U_dc_v: float | None = None
    """Temperatures (degC) and DC link (V); the machine file's where none is given."""
    seed: int = 0
    """Of the sensors' noise."""


@dataclass(frozen=True, slots=True, eq=False)
class DriveRuns:
    """What is kept of every drive, of its machine and not of what its sensors say; each shape (n,)."""

    i_peak_a: Array
    i_rms_a: Array
    """Largest current amplitude at the end of a control period, and its root mean square (A peak)."""
    torque_nm: Array
    """Mean amount of the torque (N m)."""
    omega_peak_rad_s: Array
    """Largest mechanical speed (rad/s)."""
    u_peak: Array
    """Largest voltage demanded, behind the limiter, over the DC link."""
    infeasible: Array
    """Share of the periods with no admissible current at all."""
    trip: NDArray[np.int64]
    """Latched trip as CiA 402 error code, 0 without."""
    outside: NDArray[np.int64]
    """Evaluations outside the flux map."""


_Task, _RESULT = STRUCTS["pmsm_monte_carlo"], np.dtype(STRUCTS["pmsm_drive_run"])


@cache
def _library() -> Any:
    lib = library()
    lib.pmsm_monte_carlo_run.argtypes, lib.pmsm_monte_carlo_run.restype = (ctypes.POINTER(_Task),), ctypes.c_uint32
    lib.pmsm_monte_carlo_memory.argtypes, lib.pmsm_monte_carlo_memory.restype = (), ctypes.c_uint64
    lib.pmsm_monte_carlo_layout.argtypes, lib.pmsm_monte_carlo_layout.restype = (ctypes.c_uint32,), ctypes.c_uint32
    if [lib.pmsm_monte_carlo_layout(k) for k in (0, 1)] != [ctypes.sizeof(_Task), _RESULT.itemsize]:
        raise RuntimeError("the structs of monte_carlo.h have other sizes in the library pmsm_sim; rebuild it")
    return lib


def cores() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def simulate_many(
    machine_file: MachineFile,
    params: ParameterSet,
    scenario: Scenario,
    variations: Sequence[Variation],
    *,
    threads: int | None = None,
) -> DriveRuns:
    """Run a scenario on many drives, in one call of the kernel. Raises ConfigError: what cannot be simulated together.

    Parameters
    ----------
    machine_file, params, scenario
        As for :func:`pmsmtool.sim.closed_loop.simulate`; every drive gets the same parameters.
    variations : sequence of Variation
        One per drive.
    threads : int, optional
        Threads; one per core when not given. The result does not depend on it.
    """
    lib = _library()
    machine_file, model, periods = open_simulation(machine_file, params, scenario, None)
    n = len(variations)
    setups = (Setup * n)()
    flux_map = machine_file.flux_map
    scalable = None if flux_map is None else ScalableMap.of(flux_map, machine_file.machine.psi_f_wb)
    keep = [vary(setups[k], model.setup, scalable, variation) for k, variation in enumerate(variations)]
    workers = min(max(1, cores() if threads is None else threads), max(1, n), THREADS_MAX)
    memory = np.zeros(workers * lib.pmsm_monte_carlo_memory() // 8)
    result: NDArray[Any] = np.zeros(n, dtype=_RESULT)
    task = _Task(model.sim, ctypes.addressof(setups), n, workers, periods, memory.ctypes.data, result.ctypes.data)
    lib.pmsm_monte_carlo_run(ctypes.byref(task))
    del keep  # the flux maps of the machines had to live until here
    return DriveRuns(
        i_peak_a=result["i_peak"].copy(),
        i_rms_a=np.sqrt(result["i_square"]),
        torque_nm=result["torque"].copy(),
        omega_peak_rad_s=result["omega_peak"].copy(),
        u_peak=result["u_peak"].copy(),
        infeasible=result["infeasible"] / periods,
        trip=result["trip"].astype(np.int64),
        outside=result["outside"].astype(np.int64),
    )


def vary(out: Setup, nominal: Setup, flux_map: ScalableMap | None, by: Variation) -> object:
    """Write one machine over the nominal one; returns what must live as long as the setup."""
    ctypes.memmove(ctypes.byref(out), ctypes.byref(nominal), ctypes.sizeof(Setup))
    machine = out.machine
    machine.R_copper *= by.R
    machine.R_fixed *= by.R
    machine.L_d *= by.L_d
    machine.L_q *= by.L_q
    machine.psi_f *= by.psi_f
    machine.J *= by.J
    out.sensors.encoder_offset_e += by.encoder_rad
    out.T_winding = out.T_winding if by.T_winding_c is None else by.T_winding_c
    out.T_magnet = out.T_magnet if by.T_magnet_c is None else by.T_magnet_c
    out.U_dc = out.U_dc if by.U_dc_v is None else by.U_dc_v
    out.seed = by.seed
    scale = FluxScale(by.L_d, by.L_q, by.psi_f)
    if flux_map is None or scale == FluxScale():
        return None
    struct = flux_map.struct(scale)
    machine.map = ctypes.pointer(struct)
    return struct
