# SPDX-License-Identifier: MIT
"""Many drives at once: the same parameters and the same scenario on machines that differ, in one call over all cores.

Every drive runs exactly as :func:`pmsmtool.sim.closed_loop.simulate` runs it alone (``monte_carlo.c``): the numbers
depend neither on the number of threads nor on the other drives.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.machine.flux_map import FluxScale, ScalableMap
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.params.parameter_set import ParameterSet
from pmsmtool.sim.closed_loop import open_simulation
from pmsmtool.sim.kernel import STRUCTS, Setup, library
from pmsmtool.sim.scenarios import Scenario

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
