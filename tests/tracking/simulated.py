# SPDX-License-Identifier: MIT
"""A machine that warms up while it runs, recorded by the kernel: what the tracking filter is judged on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pmsmtool.design.tune import tune
from pmsmtool.estimators.inverter_error import InverterCurve
from pmsmtool.estimators.tracking_model import SIGNALS, Known
from pmsmtool.files import data_folder
from pmsmtool.machine.key import Value
from pmsmtool.machine.machine_file import MachineFile, load_machine_file
from pmsmtool.sim.closed_loop import DRIVE_SIGNALS, image_of
from pmsmtool.sim.kernel import Part, Simulation, Target, Truth
from pmsmtool.sim.scenarios import MODES
from pmsmtool.sim.simulated_machine import build_setup, device_slope_ohm, settings_of, with_simulation
from pmsmtool.trace import Trace

DECIMATION = 4
STEP_S = 0.5
"""Time at one operating point."""
MAGNET_K_PER_S = 1.0
SPEEDS_RAD_S = (60.0, 90.0, 120.0, 150.0, -80.0)
LOADS_NM = (-10.0, 12.0)
TRUTH = {"R_s_ohm": Truth.R, "T_magnet_c": Truth.T_MAGNET}


def machine() -> MachineFile:
    """The interior-magnet profile; its numbers are the truth."""
    return load_machine_file(data_folder("profiles") / "interior-2k2.toml")


def known(drive: MachineFile, *, curve: bool = True) -> Known:
    """What an identification without error would have left."""
    settings = drive.simulation_settings()
    plateau = 540.0 * 2e-6 * 12000.0 + float(settings["device_drop_v"])  # type: ignore[arg-type]
    i = np.linspace(0.05, 20.0, 400)
    error = InverterCurve(i, plateau * np.tanh(i / float(settings["i_knee_apk"])), 0.0)  # type: ignore[arg-type]
    m = drive.machine
    return Known(m.R_s_ohm, m.psi_f_wb, m.L_d_h, m.L_q_h, drive.inverter.T_s, curve=error if curve else None)


def warming_run(
    drive: MachineFile,
    seconds: float,
    seed: int,
    *,
    vary: bool = True,
    simulation: dict[str, Value] | None = None,
    speeds_rad_s: Sequence[float] = SPEEDS_RAD_S,
    loads_nm: tuple[float, float] = LOADS_NM,
    magnet_k_per_s: float = MAGNET_K_PER_S,
) -> Trace:
    """Run at speeds and loads that change every half second (or never), the winding heated by its loss.

    The magnets warm at a steady rate. Returns what the drive records, with R of the loop and T_magnet as they are.
    """
    changed = {"thermal_on": True, "thermal_capacity_j_per_k": 40.0, **(simulation or {})}
    machine_file = with_simulation(drive, changed)
    setup, keep = build_setup(machine_file)
    run = Simulation(setup, image_of(machine_file, tune(drive).parameter_set()), keep)
    rng = np.random.default_rng(seed)
    starts = np.arange(0.0, seconds, STEP_S)
    speeds = rng.choice(speeds_rad_s, len(starts)) if vary else np.full(len(starts), 100.0)
    loads = rng.uniform(*loads_nm, len(starts)) if vary else np.full(len(starts), 8.0)
    nodes = np.column_stack([starts, starts + STEP_S - 1e-3]).ravel()
    run.schedule(Target.SPEED, nodes, np.repeat(speeds, 2))
    run.schedule(Target.LOAD, nodes, np.repeat(loads, 2))
    run.reference.mode = MODES["speed"]
    run.word(Part.ENABLED).value = 1
    names = (*SIGNALS, "T_winding_c", "flags")
    T_s = drive.inverter.T_s
    rows = int(seconds / (DECIMATION * T_s))
    record = run.record([Truth.T, *(DRIVE_SIGNALS[n][0] for n in names), *TRUTH.values()], rows, DECIMATION)
    for k in range(int(10.0 * seconds)):
        run.run(round(0.1 / T_s))
        magnet = float(changed.get("T_magnet_c", 25.0)) + 0.1 * k * magnet_k_per_s  # type: ignore[arg-type]
        run.library.pmsm_sim_set_temperatures(run.sim, run.signal(Truth.T_WINDING), magnet)
    columns = np.ascontiguousarray(record[: run.recorded_rows].T)
    units = {**{n: DRIVE_SIGNALS[n][1] for n in names}, "R_s_ohm": "ohm", "T_magnet_c": "degC"}
    signals = {name: columns[k] for k, name in enumerate((*names, *TRUTH), 1)}
    signals["R_s_ohm"] = signals["R_s_ohm"] + device_slope_ohm(settings_of(machine_file))  # the plant's is the winding
    return Trace(columns[0], signals, units)


def true_values(drive: MachineFile, trace: Trace, t_s: np.ndarray) -> dict[str, np.ndarray]:  # type: ignore[type-arg]
    """R (ohm) and psi (Wb) at the given instants."""
    m, psi_f = drive.machine, settings_of(drive).number("psi_f_wb")
    magnet = np.interp(t_s, trace.t_s, trace["T_magnet_c"])
    psi = psi_f * (1.0 + m.alpha_psi_per_k * (magnet - m.T_ref_c))
    return {"R_s_ohm": np.interp(t_s, trace.t_s, trace["R_s_ohm"]), "psi_f_wb": psi}
