# SPDX-License-Identifier: MIT
"""A simulated drive for tests: one linear machine, everything ideal until a test changes it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from pmsmtool.firmware.image import pack_image
from pmsmtool.params.catalogue import CATALOGUE
from pmsmtool.sim.kernel import Application, Part, Rotor, Setup, Simulation

R_S, L_D, L_Q, PSI, POLE_PAIRS = 0.5, 3e-3, 4.5e-3, 0.1, 3
U_DC, T_S_NS = 300.0, 100_000
T_S = 1e-9 * T_S_NS
OFF, VOLTAGE, CURRENT, TORQUE, SPEED = range(5)


def values(**changes: float) -> dict[str, float]:
    """Drive parameters that fit the machine; keys with two underscores for the dot."""
    alpha = 1200.0
    found = {row.name: row.default for row in CATALOGUE} | {
        "motor.pole_pairs": POLE_PAIRS,
        "motor.R_s_ohm": R_S,
        "motor.L_d_h": L_D,
        "motor.L_q_h": L_Q,
        "motor.L_d_app_h": L_D,
        "motor.L_q_app_h": L_Q,
        "motor.psi_f_wb": PSI,
        "motor.J_kgm2": 2e-3,
        "motor.I_max_apk": 40.0,
        "motor.I_nom_apk": 20.0,
        "motor.I_max_time_s": 100.0,
        "motor.n_max_rpm": 6000.0,
        "protection.I_cont_apk": 40.0,
        "protection.i_trip_apk": 60.0,
        "protection.n_trip_rpm": 9000.0,
        "protection.U_dc_max_v": 800.0,
        "inverter.T_s_ns": T_S_NS,
        "inverter.U_dc_nom_v": U_DC,
        "current.K_p_d_v_per_a": alpha * L_D,
        "current.K_p_q_v_per_a": alpha * L_Q,
        "current.K_i_d_v_per_as": alpha * R_S,
        "current.K_i_q_v_per_as": alpha * R_S,
    }
    return found | {name.replace("__", "."): value for name, value in changes.items()}


def ideal_setup() -> Setup:
    """Ideal sensors and inverter, rotor locked at angle zero, one period of delay."""
    setup = Setup()
    machine = setup.machine
    machine.pole_pairs, machine.R_copper = POLE_PAIRS, R_S
    machine.L_d, machine.L_q, machine.psi_f = L_D, L_Q, PSI
    machine.T_ref, machine.alpha_R, machine.alpha_psi = 20.0, 0.00393, -0.0012
    machine.J, machine.rotor = 2e-3, Rotor.LOCKED
    setup.sensors.gain[:] = [1.0, 1.0, 1.0]
    setup.sensors.U_dc_gain = 1.0
    setup.inverter.i_knee = 0.5
    setup.U_dc, setup.T_winding, setup.T_magnet = U_DC, 20.0, 20.0
    setup.delay, setup.application = 1, Application.CORE
    return setup


Change = Callable[[Setup], None]


def open_simulation(
    change: Change | None = None, *, mode: int = CURRENT, params: Mapping[str, float] | None = None
) -> Simulation:
    """Return an enabled drive in a mode, its setup changed by a function."""
    setup = ideal_setup()
    if change is not None:
        change(setup)
    simulation = Simulation(setup, pack_image(dict(params) if params else values()))
    simulation.reference.mode = mode
    simulation.word(Part.ENABLED).value = 1
    return simulation


def record(simulation: Simulation, signals: Sequence[int], periods: int, decimation: int = 1) -> np.ndarray:
    """Run and return the columns of the signals, shape (signals, rows)."""
    rows = simulation.record(signals, -(-periods // decimation), decimation)
    assert simulation.run(periods) == periods
    return np.ascontiguousarray(rows.T)


def plant_run(simulation: Simulation, u: Sequence[complex] | np.ndarray, h: float) -> np.ndarray:
    """Run the plant alone under stator-frame voltages; returns i_d + j i_q after each interval."""
    voltages = np.asarray(u, dtype=complex)
    flat = np.ascontiguousarray(np.column_stack((voltages.real, voltages.imag)))
    out = np.empty((len(voltages), 2))
    simulation.library.pmsm_sim_drive_plant(simulation.sim, len(voltages), h, flat.ctypes.data, out.ctypes.data)
    return out[:, 0] + 1j * out[:, 1]


def turning(omega_rad_s: float) -> Change:
    """Rotor driven at a mechanical speed."""

    def change(setup: Setup) -> None:
        setup.machine.rotor = Rotor.DRIVEN
        setup.omega_M = omega_rad_s

    return change


def free(**machine: float) -> Change:
    """Rotor free, with machine data."""

    def change(setup: Setup) -> None:
        setup.machine.rotor = Rotor.FREE
        for name, value in machine.items():
            setattr(setup.machine, name, value)

    return change


TURN = 2.0 * math.pi
