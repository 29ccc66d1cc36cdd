# SPDX-License-Identifier: MIT
"""Cost of simulating the whole drive of Jercic et al. 2017, per period, as a ratio to the bare loop of the same run.

Run from the repository: ``python benchmarks/governor_drive.py``; some seconds. The drive runs its whole firmware on a
free rotor with friction and inertia: speed control, field weakening or look-up, reference governor, recording of every
period (ten signals). The speed reference steps between 500 and 750 rpm every 0.1 s: work for governor and field
weakening. Processor time, best of several. Exit code 1 when a limit is missed.
"""

from __future__ import annotations

import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks.simulation import bare_loop, best_ns
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.machine.machine_file import load_machine_file, machine_path
from pmsmtool.papers.governed_drive import IDEAL, PROFILE
from pmsmtool.sim.closed_loop import image_of
from pmsmtool.sim.kernel import Part, Signal, Simulation, Target, Truth
from pmsmtool.sim.scenarios import MODES
from pmsmtool.sim.simulated_machine import build_setup, with_simulation
from pmsmtool.units import RAD_S_PER_RPM

PERIODS = 12_000
REPEATS = 9
LIMIT = 6.0
"""Ratio to the bare loop that must hold."""
RECORDED = (
    Truth.T, Truth.I_D, Truth.I_Q, Truth.OMEGA_M, Truth.TORQUE, Signal.I_D_REF, Signal.I_Q_REF, Signal.U_D_LIM,
    Signal.U_Q_LIM, Signal.FLAGS,
)  # fmt: skip

CASES: dict[str, TuneRequest] = {
    "governor off, field weakening off": TuneRequest(governor="off", field_weakening="off"),
    "best, accelerated (the design's choice)": TuneRequest(),
    "best, look-up table": TuneRequest(field_weakening="lookup"),
    "line search, look-up table": TuneRequest(governor="line", field_weakening="lookup"),
    "paper, gradient": TuneRequest(governor="paper", field_weakening="gradient"),
}
"""What is designed."""


def drive_ns(request: TuneRequest) -> float:
    """Return the least processor time per period (ns) of the drive's first second."""
    ideal = {name: value for name, value in IDEAL.items() if name != "rotor"}
    source = with_simulation(load_machine_file(machine_path(PROFILE)), {**ideal, "rotor": "free"})
    source = replace(source, inverter=replace(source.inverter, delay_periods=1.5))
    setup, keep = build_setup(source, start_rad_s=RAD_S_PER_RPM * 500.0)
    image = image_of(source, tune(source, request).parameter_set())
    times = [0.1 * k for k in range(12) for _ in range(2)][1:-1]
    speeds = [RAD_S_PER_RPM * (500.0 if k % 2 else 750.0) for k in range(11) for _ in range(2)]
    spent = []
    for _ in range(REPEATS):
        simulation = Simulation(setup, image, keep)
        simulation.schedule(Target.SPEED, times, speeds)
        simulation.reference.mode = MODES["speed"]
        simulation.word(Part.ENABLED).value = 1
        simulation.record(RECORDED, PERIODS)[:] = 0.0  # the memory is there before the clock starts
        start = time.process_time_ns()
        simulation.run(PERIODS)
        spent.append(time.process_time_ns() - start)
        assert simulation.word(Part.TRIP).value == 0
    return min(spent) / PERIODS


def main() -> int:
    """Print a table in Markdown; return the exit code."""
    missed = 0
    with tempfile.TemporaryDirectory() as folder:
        bare = bare_loop(Path(folder))
        bare_ns = best_ns(bare)
        print("| drive | ns per period | x bare loop | limit |\n|---|---|---|---|")
        for name, request in CASES.items():
            ns = drive_ns(request)
            bare_ns = min(bare_ns, best_ns(bare, 3))
            ratio = ns / bare_ns
            missed += ratio > LIMIT
            print(f"| {name} | {ns:.0f} | {ratio:.2f} | {LIMIT} |")
    print(f"\nbare loop: {bare_ns:.1f} ns per period")
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
