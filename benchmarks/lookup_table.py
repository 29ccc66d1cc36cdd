"""Cost and error of a look-up table, as a ratio to scipy's SLSQP per point on a part of it in the same run.

Run from the repository: ``python benchmarks/lookup_table.py``. The machine is the analytic PM-SyRM (Lelli, Hinkkanen,
Giulii Capponi, ICEM 2024) sampled to a map of 21 x 27 nodes, with winding resistance; 100 x 100 cells, both torque
signs. SLSQP minimises |i| under the same constraints on the same map (bicubic, its exact derivatives); where it finds
no feasible point it maximises the torque instead.
"""

from __future__ import annotations

import json
import math
import sys
import time

import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.optimize import minimize

from pmsmtool.design.lookup_table import CUT, LookupTable, electrical_speed, speed_table
from pmsmtool.design.operating_machine import OperatingMachine
from pmsmtool.machine.analytic_saturation import BridgeSaturation
from pmsmtool.machine.flux_map import FluxMap

CELLS = 100
SUB_GRID = 8
REPEATS = 9
I_MAX, U_DC, N_MAX, T_MAX = 20.0, 540.0, 6000.0, 60.0
V_MAX = U_DC / math.sqrt(3.0)
POLE_PAIRS, R = 2, 0.63


def measured_size_map() -> FluxMap:
    """Sample the analytic machine to the size of a measured map."""
    i_d, i_q = np.linspace(-20.0, 20.0, 21), np.linspace(-26.0, 26.0, 27)
    return FluxMap(i_d, i_q, *BridgeSaturation().flux(*np.meshgrid(i_d, i_q, indexing="ij")))


def solve(machine: OperatingMachine) -> LookupTable:
    """Make the table of the benchmark."""
    return speed_table(
        machine,
        torque_nm=np.linspace(-T_MAX, T_MAX, CELLS),
        speed_rpm=np.linspace(0.0, N_MAX, CELLS),
        V_max_v=[V_MAX],
        I_max_apk=I_MAX,
    )


def splines(flux_map: FluxMap) -> list[RectBivariateSpline]:
    """Interpolate both fluxes by scipy; the same numbers as the product's bicubic map, to 3e-15."""
    grids = (flux_map.psi_d_wb, flux_map.psi_q_wb)
    return [RectBivariateSpline(flux_map.i_d_a, flux_map.i_q_a, grid, s=0) for grid in grids]


def slsqp_cell(flux: list[RectBivariateSpline], torque: float, omega: float) -> tuple[float, float]:
    """Current and torque of one cell by SLSQP from one start; every point is evaluated once."""
    known: dict[tuple[float, float], tuple[np.ndarray, np.ndarray]] = {}

    def state(i: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        at = (float(i[0]), float(i[1]))
        if at not in known:
            known[at] = evaluate(i)
        return known[at]

    def evaluate(i: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        value = np.array([float(s.ev(i[0], i[1])) for s in flux])
        slopes = [[float(s.ev(i[0], i[1], dx=1)), float(s.ev(i[0], i[1], dy=1))] for s in flux]
        return value, np.array(slopes)

    def torque_of(i: np.ndarray) -> float:
        psi, _ = state(i)
        return float(1.5 * POLE_PAIRS * (psi[0] * i[1] - psi[1] * i[0]))

    def torque_slope(i: np.ndarray) -> np.ndarray:
        psi, jac = state(i)
        along_d = jac[0, 0] * i[1] - jac[1, 0] * i[0] - psi[1]
        along_q = jac[0, 1] * i[1] - jac[1, 1] * i[0] + psi[0]
        return 1.5 * POLE_PAIRS * np.array([along_d, along_q])

    def room(i: np.ndarray) -> float:
        psi, _ = state(i)
        v_d, v_q = R * i[0] - omega * psi[1], R * i[1] + omega * psi[0]
        return float(1.0 - (v_d**2 + v_q**2) / V_MAX**2)

    def room_slope(i: np.ndarray) -> np.ndarray:
        psi, jac = state(i)
        v_d, v_q = R * i[0] - omega * psi[1], R * i[1] + omega * psi[0]
        dv = np.array([[R - omega * jac[1, 0], -omega * jac[1, 1]], [omega * jac[0, 0], R + omega * jac[0, 1]]])
        return np.asarray(-2.0 * (v_d * dv[0] + v_q * dv[1]) / V_MAX**2)

    inside = [
        {"type": "ineq", "fun": room, "jac": room_slope},
        {"type": "ineq", "fun": lambda i: 1.0 - i @ i / I_MAX**2, "jac": lambda i: -2.0 * i / I_MAX**2},
    ]
    equal = {
        "type": "eq",
        "fun": lambda i: torque_of(i) / T_MAX - torque / T_MAX,
        "jac": lambda i: torque_slope(i) / T_MAX,
    }
    options = {"ftol": 1e-10, "maxiter": 100}
    sign = 1.0 if torque >= 0.0 else -1.0
    starts = [np.array([-0.5 * I_MAX, sign * 0.3 * I_MAX])]
    best: tuple[float, float] | None = None
    for start in starts:
        found = minimize(
            lambda i: i @ i / I_MAX**2, start, jac=lambda i: 2.0 * i / I_MAX**2, constraints=[*inside, equal],
            method="SLSQP", options=options,
        )  # fmt: skip
        ok = found.success and room(found.x) > -1e-7 and abs(torque_of(found.x) - torque) < 1e-6 * T_MAX
        if ok and (best is None or math.hypot(*found.x) < best[0]):
            best = math.hypot(*found.x), torque
    if best is not None:
        return best
    largest = -math.inf
    for start in starts:
        found = minimize(
            lambda i: -sign * torque_of(i) / T_MAX, start, jac=lambda i: -sign * torque_slope(i) / T_MAX,
            constraints=inside, method="SLSQP", options=options,
        )  # fmt: skip
        if found.success and room(found.x) > -1e-7 and sign * torque_of(found.x) > largest:
            largest, current = sign * torque_of(found.x), math.hypot(*found.x)
            best = current, sign * largest
    return (math.nan, math.nan) if best is None else best


def main() -> int:
    """Print one JSON object."""
    machine = OperatingMachine(POLE_PAIRS, R, 1.0, 1.0, 0.445, measured_size_map())
    table = solve(machine)
    fastest = math.inf
    for _ in range(REPEATS):
        start = time.perf_counter()
        solve(machine)
        fastest = min(fastest, time.perf_counter() - start)
    at = np.linspace(0, CELLS - 1, SUB_GRID).round().astype(int)
    omega = electrical_speed(machine, table.y)
    start = time.perf_counter()
    flux = splines(machine.flux_map) if machine.flux_map is not None else []
    slow = {(x, y): slsqp_cell(flux, float(table.torque_nm[x]), float(omega[y])) for x in at for y in at}
    per_cell = (time.perf_counter() - start) / len(slow)
    current_error, torque_error, missed = 0.0, 0.0, 0
    for (x, y), (current, torque) in slow.items():
        if math.isnan(current):
            missed += 1
        elif table.limits[x, y, 0] & CUT:
            torque_error = max(torque_error, abs(torque - table.achieved_torque_nm[x, y, 0]) / T_MAX)
        else:
            ours = math.hypot(table.i_d_a[x, y, 0], table.i_q_a[x, y, 0])
            current_error = max(current_error, abs(current - ours) / I_MAX)
    result = {
        "cells": CELLS * CELLS,
        "library_call_ms": 1e3 * fastest,
        "slsqp_ms_per_cell": 1e3 * per_cell,
        "times_faster_than_slsqp": per_cell * CELLS * CELLS / fastest,
        "largest_current_difference_over_I_max": current_error,
        "largest_torque_difference_over_T_max": torque_error,
        "cells_slsqp_did_not_solve": missed,
        "voltage_excess_relative": float(-np.nanmin(table.margin_v) / V_MAX),
        "current_excess_relative": float(-np.nanmin(table.margin_i) / I_MAX),
    }
    json.dump(result, sys.stdout, indent=1)
    print()
    return 0


if __name__ == "__main__":
    sys.exit(main())
