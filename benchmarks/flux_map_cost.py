# SPDX-License-Identifier: MIT
"""Cost of a flux-map evaluation in C, as a ratio to scipy's spline of the same map in the same run.

Run from the repository: ``python benchmarks/flux_map_cost.py``. Forward is both fluxes and the 2 x 2 Jacobian (what a
look-up table or a Newton step needs), inverse both currents (what a plant stage needs). A trajectory visits
neighbouring cells, as a simulation does; random points meet the cache cold.
"""

from __future__ import annotations

import ctypes
import json
import sys
import time
from collections.abc import Callable

import numpy as np
from scipy.interpolate import RectBivariateSpline

from benchmarks.analytic_saturation import saturated_pmsyrm_map
from pmsmtool.machine.flux_map import FluxMap
from pmsmtool.machine.flux_map_cells import library

POINTS = 20_000
REPEATS = 15
SCALAR_POINTS = 300


def best_ns(run: Callable[[], object], points: int, repeats: int = REPEATS) -> float:
    """Fastest of several runs, per point (ns)."""
    fastest = float("inf")
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        fastest = min(fastest, time.perf_counter() - start)
    return fastest / points * 1e9


def c_costs(flux_map: FluxMap, i_d: np.ndarray, i_q: np.ndarray) -> tuple[float, float]:
    """Forward and inverse cost of one call in a C loop (ns)."""
    n, lib, struct = len(i_d), library(), ctypes.byref(flux_map.as_struct())
    psi_d, psi_q, jac = np.empty(n), np.empty(n), np.empty(4 * n)
    back_d, back_q = np.empty(n), np.empty(n)
    forward = (i_d.ctypes.data, i_q.ctypes.data, psi_d.ctypes.data, psi_q.ctypes.data, jac.ctypes.data, None)
    inverse = (psi_d.ctypes.data, psi_q.ctypes.data, back_d.ctypes.data, back_q.ctypes.data, None)
    return (
        best_ns(lambda: lib.pmsm_flux_map_flux_many(struct, n, *forward), n),
        best_ns(lambda: lib.pmsm_flux_map_current_many(struct, n, *inverse), n),
    )


def scipy_costs(flux_map: FluxMap, i_d: np.ndarray, i_q: np.ndarray) -> tuple[float, float]:
    """The same six numbers from two scipy splines: per point of one array call, and per scalar call (ns)."""
    splines = [
        RectBivariateSpline(flux_map.i_d_a, flux_map.i_q_a, grid, s=0)
        for grid in (flux_map.psi_d_wb, flux_map.psi_q_wb)
    ]

    def all_six(at_d: object, at_q: object) -> None:
        for spline in splines:
            for dx, dy in ((0, 0), (1, 0), (0, 1)):
                spline.ev(at_d, at_q, dx=dx, dy=dy)

    def one_by_one() -> None:
        for at_d, at_q in zip(i_d[:SCALAR_POINTS], i_q[:SCALAR_POINTS], strict=True):
            all_six(at_d, at_q)

    return best_ns(lambda: all_six(i_d, i_q), len(i_d), 3), best_ns(one_by_one, SCALAR_POINTS, 3)


def main() -> None:
    """Print the costs, or one JSON object with ``--json``."""
    flux_map = saturated_pmsyrm_map()
    angle = np.linspace(0.0, 40.0, POINTS)
    rng = np.random.default_rng(0)
    paths = {
        "trajectory": (9.0 * np.cos(angle), 11.0 * np.sin(1.3 * angle)),
        "random": (rng.uniform(-25, 25, POINTS), rng.uniform(-25, 25, POINTS)),
    }
    build_s = best_ns(lambda: build_tables(flux_map), 1, 5) * 1e-9
    result: dict[str, float] = {"build_tables_s": build_s, "inverse_error_a": flux_map.tables.inverse_error_a}
    for name, (i_d, i_q) in paths.items():
        result[f"{name}_forward_ns"], result[f"{name}_inverse_ns"] = c_costs(flux_map, i_d, i_q)
        result[f"{name}_scipy_array_ns"], result[f"{name}_scipy_scalar_ns"] = scipy_costs(flux_map, i_d, i_q)
        result[f"{name}_ratio_array"] = result[f"{name}_scipy_array_ns"] / result[f"{name}_forward_ns"]
        result[f"{name}_ratio_scalar"] = result[f"{name}_scipy_scalar_ns"] / result[f"{name}_forward_ns"]
    if "--json" in sys.argv:
        print(json.dumps(result))
        return
    print(f"{flux_map.interpolation()}")
    print(f"built in {1e3 * build_s:.1f} ms, inverse at most {result['inverse_error_a']:.2g} A off")
    print(f"{'':10} {'psi, Jacobian':>14} {'i(psi)':>9} {'scipy array':>14} {'ratio':>6} {'scipy scalar':>14} ratio")
    for name in paths:
        forward, inverse, array, scalar, of_array, of_scalar = (
            result[f"{name}_{key}"]
            for key in ("forward_ns", "inverse_ns", "scipy_array_ns", "scipy_scalar_ns", "ratio_array", "ratio_scalar")
        )
        print(
            f"{name:10} {forward:11.1f} ns {inverse:6.1f} ns {array:11.0f} ns {of_array:6.0f} {scalar:11.0f} ns "
            f"{of_scalar:6.0f}"
        )


def build_tables(flux_map: FluxMap) -> None:
    """Build both tables of a fresh copy (the map caches its own)."""
    _ = FluxMap(flux_map.i_d_a, flux_map.i_q_a, flux_map.psi_d_wb, flux_map.psi_q_wb).tables


if __name__ == "__main__":
    main()
