"""Many simulated drives by one call of the kernel: what a Monte Carlo prediction runs on."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

from pmsmtool.sim.kernel import Simulation, library


def run_batch(simulations: Sequence[Simulation], periods: int) -> None:
    """Run every simulation by ``periods`` control periods.

    Parameters
    ----------
    simulations : sequence of Simulation
        Each with its own drive; none may watch for news (that ends a run early).
    periods : int
        Control periods, the same for all.
    """
    function = library().pmsm_sim_run_batch
    function.argtypes, function.restype = (ctypes.c_void_p, ctypes.c_uint64, ctypes.c_uint64), None
    addresses = (ctypes.c_void_p * len(simulations))(*(simulation.sim for simulation in simulations))
    function(addresses, len(simulations), periods)
