# SPDX-License-Identifier: MIT
"""Cost of simulating many drives: per drive and control period against the single drive, and how it scales.

Run from the repository: ``python benchmarks/batch_simulation.py``. 256 drives x 1 s of the whole firmware, governor and
field weakening on (torque reversals up to top speed), each drive another machine of the tolerance box. One core:
processor time of the batch over that of the same drives run one by one (no batch code), taken in turns in one run.
Two cores: wall time of one call with one thread over that with two, best of several; it needs two idle cores. On a busy
machine the processor time of both says what two cores would give: 2 x that of one thread over that of two (threads take
one drive after the other, so the last one to finish costs less than a hundredth). The 100 000-sample analytic margins
are timed as well. Exit code 1 when a limit is missed.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from pmsmtool.design.design_file import Design
from pmsmtool.design.loops.margins import margin_report
from pmsmtool.design.tolerance import tolerance_box
from pmsmtool.design.tune import tune
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.proof.simulated_margins import torque_reversals, variations
from pmsmtool.sim.closed_loop import Variation, cores, open_simulation, simulate_many
from pmsmtool.sim.scenarios import Scenario

PROFILES = Path(__file__).resolve().parent.parent / "profiles"
MACHINES = ("jercic-2017", "saturated-pmsyrm")
DRIVES = 256
SINGLES = 12
"""Drives run one by one between two batches."""
REPEATS = 3
SAMPLES = 100_000

COST_LIMIT, SCALING_LIMIT, MARGINS_LIMIT_S = 1.5, 1.8, 10.0


def singles_ns(design: Design, scenario: Scenario, machines: list[Variation]) -> float:
    """Return the processor time per period of drives run one by one (ns)."""
    used = periods = 0
    for k in range(SINGLES):
        by = machines[k * len(machines) // SINGLES]
        file = design.machine
        m = file.machine
        if file.flux_map is None:  # a mapped machine is timed at its nominal values: the code run is the same
            own = replace(m, R_s_ohm=by.R * m.R_s_ohm, L_d_h=by.L_d * m.L_d_h, L_q_h=by.L_q * m.L_q_h)
            file = replace(file, machine=own)
        _, simulation, count = open_simulation(file, design.parameter_set(), scenario)
        start = time.process_time_ns()
        simulation.run(count)
        used += time.process_time_ns() - start
        periods += count
    return used / periods


def measured(name: str) -> dict[str, float]:
    """Return what is judged for one machine."""
    design = tune(load_machine_file(PROFILES / f"{name}.toml"))
    design = replace(design, machine=replace(design.machine, simulation={}))
    scenario = torque_reversals(design)
    machines = variations(tolerance_box(design.machine).draw(DRIVES, 0, 0), 0, 0)
    params = design.parameter_set()
    periods = DRIVES * round(scenario.duration_s / design.machine.inverter.T_s)
    single: list[float] = []
    cpu: dict[int, list[float]] = {1: [], 2: []}
    wall: dict[int, list[float]] = {1: [], 2: []}
    for _ in range(REPEATS):
        single.append(singles_ns(design, scenario, machines))
        for threads, walls in wall.items():
            start, used = time.perf_counter_ns(), time.process_time_ns()
            simulate_many(design.machine, params, scenario, machines, threads=threads)
            walls.append((time.perf_counter_ns() - start) / periods)
            cpu[threads].append((time.process_time_ns() - used) / periods)
    return {
        "single_ns": min(single),
        "batch_ns": min(cpu[1]),
        "cost_ratio": min(cpu[1]) / min(single),
        "scaling_by_processor_time": 2.0 * min(cpu[1]) / min(cpu[2]),
        "wall_1_thread_ns": min(wall[1]),
        "wall_2_threads_ns": min(wall[2]),
        "scaling": min(wall[1]) / min(wall[2]),
    }


def margins_seconds() -> tuple[float, float]:
    """Return wall and processor time of the analytic margins in this process, no pool (s)."""
    design = tune(load_machine_file(PROFILES / f"{MACHINES[0]}.toml"))
    box = tolerance_box(design.machine)
    start, used = time.perf_counter(), time.process_time()
    margin_report(design, box, samples=SAMPLES)
    return time.perf_counter() - start, time.process_time() - used


def main() -> int:
    """Measure, print, and judge."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    rows = {name: measured(name) for name in MACHINES}
    wall, used = margins_seconds()
    missed = [f"{n}: {r['cost_ratio']:.2f} x the single drive" for n, r in rows.items() if r["cost_ratio"] > COST_LIMIT]
    if cores() >= 2:
        missed += [f"{n}: {r['scaling']:.2f} x on two cores" for n, r in rows.items() if r["scaling"] < SCALING_LIMIT]
    missed += [f"margins: {wall:.1f} s"] if wall > MARGINS_LIMIT_S else []
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    if options.json:
        data = {"machines": rows, "margins_wall_s": wall, "margins_processor_s": used, "load": load, "missed": missed}
        print(json.dumps({"schema": "pmsmtool.benchmark.batch-simulation/1", **data}))
        return int(bool(missed))
    for name, r in rows.items():
        print(f"{name}: {DRIVES} drives x 1 s")
        print(f"  one by one     {r['single_ns']:8.1f} ns per drive and period, processor time")
        print(f"  batch          {r['batch_ns']:8.1f} ns  {r['cost_ratio']:5.2f} x  (limit {COST_LIMIT:g} x)")
        walls = f"{r['wall_1_thread_ns']:.1f} and {r['wall_2_threads_ns']:.1f} ns wall"
        print(f"  1 and 2 threads {walls}, {r['scaling']:.2f} x  (at least {SCALING_LIMIT:g} x)")
        print(f"  by processor time {r['scaling_by_processor_time']:.2f} x")
    print(f"{SAMPLES} analytic samples, one process: {wall:.2f} s wall, {used:.2f} s processor  (limit 10 s)")
    print(f"load average at the end {load:.1f} on {cores()} cores")
    for line in missed:
        print(f"MISSED {line}")
    return int(bool(missed))


if __name__ == "__main__":
    sys.exit(main())
