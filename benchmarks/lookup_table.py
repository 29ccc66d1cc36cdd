# SPDX-License-Identifier: MIT
"""Cost and error of a look-up table against motulator's reference generator and scipy's SLSQP per point, in one run.

Run from the repository: ``python benchmarks/lookup_table.py [--map FILE] [--motulator PYTHON]``; PYTHON is an
interpreter with motulator >= 0.18 (a Python 3.12 environment of its own, never a dependency). Without a map
the machine is the analytic PM-SyRM (Lelli, Hinkkanen, Giulii Capponi, ICEM 2024) sampled to 21 x 27 nodes. 100 x 100
cells with winding resistance, both torque signs. Errors are taken on random cells against the brute-force search of the
tests: current over I_max where the torque is reachable, torque over the largest elsewhere; with them the cells that
exceed a limit by more than 1e-4. SLSQP minimises |i| under the same constraints on the same map (its exact
derivatives); where it finds no feasible point it maximises the torque instead. Times are processor times. Exit code 1
when a target is missed.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.optimize import minimize

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks.analytic_saturation import BridgeSaturation
from pmsmtool.design.lookup.table import STANDSTILL_V, LookupTable, electrical_speed, speed_table, torque_limits
from pmsmtool.design.operating_machine import OperatingMachine
from pmsmtool.machine.flux_map import FluxMap
from pmsmtool.machine.flux_map_import import load_flux_map
from tests.design.brute_force import Case, extreme_torque, least_current

CELLS = 100
TRUE_CELLS = 40
"""Random cells whose optimum is searched, and that SLSQP solves."""
REPEATS = 9
I_MAX, U_DC, N_MAX = 20.0, 540.0, 6000.0
V_MAX = U_DC / math.sqrt(3.0)
POLE_PAIRS, R = 2, 0.63

TIME_LIMIT_MS, MOTULATOR_LIMIT, SLSQP_LIMIT, ERROR_LIMIT, EXCESS_LIMIT = 60.0, 25.0, 500.0, 1e-6, 1e-9
NAMED_EXCESS = 1e-4


def measured_size_map() -> FluxMap:
    """Sample the analytic machine to the size of a measured map."""
    i_d, i_q = np.linspace(-20.0, 20.0, 21), np.linspace(-26.0, 26.0, 27)
    return FluxMap(i_d, i_q, *BridgeSaturation().flux(*np.meshgrid(i_d, i_q, indexing="ij")))


def largest_torque(machine: OperatingMachine) -> float:
    """Return the largest torque under the current limit (N m)."""
    return float(torque_limits(machine, [0.0], [STANDSTILL_V], I_MAX).largest_nm[0, 0])


def solve(machine: OperatingMachine, torque_nm: np.ndarray) -> LookupTable:
    """Make the table of the benchmark."""
    return speed_table(
        machine,
        torque_nm=torque_nm,
        speed_rpm=np.linspace(0.0, N_MAX, CELLS),
        V_max_v=[V_MAX],
        I_max_apk=I_MAX,
    )


def splines(flux_map: FluxMap) -> list[RectBivariateSpline]:
    """Interpolate both fluxes by scipy; the same numbers as the product's bicubic map, to 3e-15."""
    grids = (flux_map.psi_d_wb, flux_map.psi_q_wb)
    return [RectBivariateSpline(flux_map.i_d_a, flux_map.i_q_a, grid, s=0) for grid in grids]


def slsqp_cell(flux: list[RectBivariateSpline], torque: float, omega: float, T_MAX: float) -> tuple[float, float]:
    """i_d and i_q of one cell by SLSQP from one start, NaN without success; every point is evaluated once."""
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
    start = np.array([-0.5 * I_MAX, sign * 0.3 * I_MAX])
    found = minimize(
        lambda i: i @ i / I_MAX**2, start, jac=lambda i: 2.0 * i / I_MAX**2, constraints=[*inside, equal],
        method="SLSQP", options=options,
    )  # fmt: skip
    if found.success and room(found.x) > -1e-7 and abs(torque_of(found.x) - torque) < 1e-6 * T_MAX:
        return float(found.x[0]), float(found.x[1])
    found = minimize(
        lambda i: -sign * torque_of(i) / T_MAX, start, jac=lambda i: -sign * torque_slope(i) / T_MAX,
        constraints=inside, method="SLSQP", options=options,
    )  # fmt: skip
    ok = found.success and room(found.x) > -1e-7
    return (float(found.x[0]), float(found.x[1])) if ok else (math.nan, math.nan)


@dataclass(frozen=True)
class Truth:
    """Optimum of one cell by search: its machine, the torque it can reach, and the least current where it can."""

    case: Case
    torque: float
    current: float


def search(flux: list[RectBivariateSpline], machine: OperatingMachine, edge: float, T: float, omega: float) -> Truth:
    """Search one cell on scipy's spline."""
    reach = float(machine.flux_map.i_q_a[-1]) if machine.flux_map is not None else math.inf

    def psi(d: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        d, q = np.broadcast_arrays(d, q)
        value = [part.ev(d.ravel(), q.ravel()).reshape(d.shape) for part in flux]
        return value[0], value[1]

    case = Case(psi, POLE_PAIRS, R, omega, V_MAX, I_MAX, edge=(-edge, edge, reach))
    least, largest = extreme_torque(case, -1.0)[2], extreme_torque(case, 1.0)[2]
    reached = min(max(T, least), largest)
    return Truth(case, reached, least_current(case, T)[2] if reached == T else math.nan)


def judged(
    truths: dict[tuple[int, int], Truth], found: dict[tuple[int, int], tuple[float, float]], T_max: float
) -> dict[str, float]:
    """Return the largest errors of a method over the searched cells."""
    current = torque = excess = 0.0
    missed = violated = 0
    for at, truth in truths.items():
        d, q = found[at]
        i_d, i_q = np.asarray(d), np.asarray(q)
        if not (math.isfinite(d) and math.isfinite(q)):
            missed += not math.isnan(truth.torque)
            continue
        if not math.isnan(truth.current):
            current = max(current, abs(math.hypot(d, q) - truth.current) / I_MAX)
        torque = max(torque, abs(float(truth.case.torque(i_d, i_q)) - truth.torque) / T_max)
        over = max(math.hypot(d, q) / I_MAX, float(truth.case.voltage(i_d, i_q)) / V_MAX) - 1.0
        excess, violated = max(excess, over), violated + (over > NAMED_EXCESS)
    return {
        "current_error_over_I_max": current, "torque_error_over_T_max": torque, "largest_excess": excess,
        "cells_beyond_a_limit": violated, "cells_not_solved": missed,
    }  # fmt: skip


def motulator_table(python: str, machine: OperatingMachine, table: LookupTable) -> tuple[np.ndarray, np.ndarray, float]:
    """Let another interpreter make the table; returns i_d, i_q and its time (s)."""
    flux_map = machine.flux_map
    assert flux_map is not None
    with tempfile.TemporaryDirectory() as scratch:
        given, back = Path(scratch) / "in.npz", Path(scratch) / "out.npz"
        np.savez(
            given, i_d_a=flux_map.i_d_a, i_q_a=flux_map.i_q_a, psi_d_wb=flux_map.psi_d_wb, psi_q_wb=flux_map.psi_q_wb,
            torque_nm=table.torque_nm, omega_e=electrical_speed(machine, table.y), I_max=I_MAX, V_max=V_MAX, R=R,
            pole_pairs=POLE_PAIRS, psi_max=np.hypot(flux_map.psi_d_wb, flux_map.psi_q_wb).max(),
        )  # fmt: skip
        program = str(Path(__file__).resolve().parent / "motulator_loci.py")
        subprocess.run([python, program, str(given), str(back)], check=True)
        made = np.load(back)
        return made["i_d_a"], made["i_q_a"], float(made["seconds"])


def main() -> int:
    """Print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--map", type=Path, help="flux map of the machine")
    parser.add_argument("--motulator", metavar="PYTHON", help="interpreter that has motulator")
    options = parser.parse_args()
    flux_map = measured_size_map() if options.map is None else load_flux_map(options.map)
    machine = OperatingMachine(POLE_PAIRS, R, 1.0, 1.0, float(flux_map.flux(0.0, 0.0)[0]), flux_map)
    T_max = largest_torque(machine)
    torque = np.linspace(-1.1 * T_max, 1.1 * T_max, CELLS)
    table = solve(machine, torque)
    fastest = math.inf
    for _ in range(REPEATS):
        start = time.process_time()
        solve(machine, torque)
        fastest = min(fastest, time.process_time() - start)
    omega = electrical_speed(machine, table.y)
    rng = np.random.default_rng(1)
    cells = [tuple(int(k) for k in cell) for cell in rng.integers(0, CELLS, (TRUE_CELLS, 2))]
    flux = splines(flux_map)
    edge = float(min(-flux_map.i_d_a[0], flux_map.i_d_a[-1]))
    truths = {(x, y): search(flux, machine, edge, float(torque[x]), float(omega[y])) for x, y in cells}
    start = time.process_time()
    slow = {(x, y): slsqp_cell(flux, float(torque[x]), float(omega[y]), T_max) for x, y in truths}
    per_cell = (time.process_time() - start) / len(slow)
    own = {(x, y): (float(table.i_d_a[x, y, 0]), float(table.i_q_a[x, y, 0])) for x, y in truths}
    excess = float(max(-np.nanmin(table.margin_v) / V_MAX, -np.nanmin(table.margin_i) / I_MAX))
    errors = judged(truths, own, T_max)
    result: dict[str, object] = {
        "cells": CELLS * CELLS,
        "library_call_ms": 1e3 * fastest,
        "errors": errors,
        "largest_excess_of_all_cells": excess,
        "slsqp": {"ms_per_cell": 1e3 * per_cell, **judged(truths, slow, T_max)},
        "times_faster_than_slsqp": per_cell * CELLS * CELLS / fastest,
    }
    missed = [f"{1e3 * fastest:.1f} ms"] if 1e3 * fastest > TIME_LIMIT_MS else []
    worst = max(errors["current_error_over_I_max"], errors["torque_error_over_T_max"])
    missed += [f"error {worst:.2g}"] if worst > ERROR_LIMIT or errors["cells_not_solved"] else []
    missed += [f"limit exceeded by {excess:.2g}"] if excess > EXCESS_LIMIT else []
    missed += ["SLSQP"] if per_cell * CELLS * CELLS / fastest < SLSQP_LIMIT else []
    if options.motulator:
        i_d, i_q, seconds = motulator_table(options.motulator, machine, table)
        theirs = {(x, y): (float(i_d[x, y]), float(i_q[x, y])) for x, y in truths}
        result["motulator"] = {"ms": 1e3 * seconds, **judged(truths, theirs, T_max)}
        result["times_faster_than_motulator"] = seconds / fastest
        missed += ["motulator"] if seconds / fastest < MOTULATOR_LIMIT else []
    json.dump({**result, "missed": missed}, sys.stdout, indent=1)
    print()
    return int(bool(missed))


if __name__ == "__main__":
    sys.exit(main())
