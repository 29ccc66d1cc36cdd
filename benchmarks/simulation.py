# SPDX-License-Identifier: MIT
"""Cost and accuracy of the simulation, as ratios to a bare C loop compiled in the same run.

Run from the repository: ``python benchmarks/simulation.py`` (``--accuracy`` adds the comparison with scipy's DOP853
over 1 s of all scenarios, about a minute). The bare loop (``bare_loop.c``) is one float PI controller and one RK4 step
of the linear machine per period in one function, compiled with the kernel's flags. Times are processor
times, best of several; the ratios are what counts. Exit code 1 when a limit is missed.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from pmsmtool.firmware.image import pack_image
from pmsmtool.native import library_name
from pmsmtool.packaging.compiler import Kernel, build_compiler, compile_library
from pmsmtool.sim.kernel import Application, Part, Rotor, Setup, Simulation, Target, Truth
from tests.sim.reference import SCENARIOS, Scenario, reference_run, relative_error, setup_of, simulate

PERIODS = 12_000
REPEATS = 15
MONTE_CARLO_DRIVES = 64
START_REPEATS = 7

PI_LIMIT = 2.0
"""Ratio of the PI-only library call to the bare loop that must hold."""
DRIVE_LIMIT, SATURATED_LIMIT, SWITCHED_LIMIT = 6.0, 3.0, 15.0
"""Ratios of the whole drive, the saturated machine and the PWM-resolved plant (ideal devices) that must hold."""
ERROR_LIMIT = 1e-6
"""Current error against DOP853 that must hold, relative to the largest current."""
START_LIMIT_S = 0.25
"""Wall time of a fresh process that simulates 1 s."""

MOTULATOR_US = (217.0, 259.0)
"""Context: motulator 0.18 on S1, us per control step, on the machine of the project's reference (Zen 4, 71 ns bare)."""


class BareSetup(ctypes.Structure):
    """``bare_setup`` of ``bare_loop.c``."""

    _fields_ = tuple(
        (name, ctypes.c_double)
        for name in (
            *("R_s", "L_d", "L_q", "psi_f", "U_dc", "omega_e", "T_s"),
            *("K_p_d", "K_p_q", "K_i", "i_d_ref", "i_q_ref"),
        )
    )


def bare_loop(folder: Path) -> Callable[[], None]:
    """Compile the bare loop and return a run of one second of S1 at 26 A."""
    kernel = Kernel("bare", ("bare_loop.c",))
    library = folder / library_name(kernel.name)
    compile_library(build_compiler(), kernel, Path(__file__).resolve().parent, library)
    run = ctypes.CDLL(str(library)).bare_run
    s = SCENARIOS[0]
    setup = BareSetup(
        s.R_s, s.L_d, s.L_q, s.psi_f, s.U_dc, s.omega_M * s.pole_pairs, 83333e-9,
        s.alpha * s.L_d, s.alpha * s.L_q, 4.0 * s.alpha * s.R_s, 0.0, 26.0,
    )  # fmt: skip
    out = np.empty((PERIODS, 2))
    return lambda: run(ctypes.byref(setup), ctypes.c_uint64(PERIODS), ctypes.c_void_p(out.ctypes.data))


@dataclass(frozen=True)
class Case:
    """One row of the table: what is simulated, and the ratio to the bare loop it must not exceed."""

    name: str
    scenario: Scenario
    change: Callable[[Setup], None]
    limit: float | None = None
    mode: int = 2


def as_is(setup: Setup) -> None:
    """Change nothing: control core alone."""


def whole_drive(setup: Setup) -> None:
    """Speed estimate, trips, recorder and excitation checks around the core; noise, ADC grid, encoder grid."""
    setup.application = Application.DRIVE
    setup.sensors.noise, setup.sensors.adc_bits, setup.sensors.full_scale = 0.02, 12, 100.0
    setup.sensors.encoder_bits = 17


def everything_averaged(setup: Setup) -> None:
    """Add mechanics, dead time and device drop, sensor lag, thermal model."""
    whole_drive(setup)
    setup.machine.rotor, setup.machine.J, setup.machine.B, setup.machine.tau_c = Rotor.FREE, 0.05, 0.01, 0.4
    setup.machine.thermal_capacity, setup.machine.thermal_resistance = 1000.0, 0.5
    setup.inverter.shape, setup.inverter.dead_time[:], setup.inverter.i_knee = 3, [1e-6] * 3, 0.5
    setup.inverter.V_switch, setup.inverter.r_switch = 0.8, 0.01


def switched(setup: Setup) -> None:
    """Every edge, ideal devices."""
    setup.inverter.model = 1


def switched_devices(setup: Setup) -> None:
    """Every edge, dead time, output capacitance, thresholds and slopes."""
    switched(setup)
    setup.inverter.dead_time[:] = [1e-6] * 3
    setup.inverter.V_switch, setup.inverter.r_switch = 1.0, 0.01
    setup.inverter.V_diode, setup.inverter.r_diode, setup.inverter.capacitance = 0.8, 0.008, 500e-12


CASES = (
    Case("PI only (control core)", SCENARIOS[0], as_is, PI_LIMIT),
    Case("saturated machine, PI only", SCENARIOS[3], as_is, SATURATED_LIMIT),
    Case("whole drive, sensors with noise", SCENARIOS[0], whole_drive, DRIVE_LIMIT),
    Case("  and free rotor, dead time, thermal", SCENARIOS[0], everything_averaged, None),
    Case("switch-level, ideal devices", SCENARIOS[0], switched, SWITCHED_LIMIT),
    Case("switch-level, all device effects", SCENARIOS[0], switched_devices, None),
    Case("whole drive, gates off", SCENARIOS[0], whole_drive, None, mode=0),
)


def open_case(case: Case) -> Simulation:
    """Return the case's simulation, its current step done."""
    setup, keep = setup_of(case.scenario)
    case.change(setup)
    simulation = Simulation(setup, pack_image(case.scenario.values()), keep)
    simulation.reference.mode = case.mode
    simulation.word(Part.ENABLED).value = 1
    simulation.reference.i_d_ref, simulation.reference.i_q_ref = case.scenario.i_d[0], case.scenario.i_q[0]
    if setup.machine.rotor == Rotor.FREE:  # a load that keeps the speed near where it is
        simulation.schedule(Target.LOAD, [0.0], [60.0])
    return simulation


def run_case(case: Case) -> Callable[[], None]:
    """Return a call that simulates one second with two recorded outputs."""
    simulation = open_case(case)

    def run() -> None:
        simulation.record([Truth.I_D, Truth.I_Q], PERIODS)
        simulation.run(PERIODS)

    return run


def best_ns(run: Callable[[], None], repeats: int = REPEATS) -> float:
    """Return the least processor time per period (ns)."""
    times = []
    for _ in range(repeats):
        start = time.process_time_ns()
        run()
        times.append(time.process_time_ns() - start)
    return min(times) / PERIODS


def monte_carlo_ns(threads: int) -> float:
    """Return the wall time per drive and period of many drives in threads (ctypes releases the lock)."""
    simulations = [open_case(CASES[0]) for _ in range(MONTE_CARLO_DRIVES)]
    with ThreadPoolExecutor(threads) as pool:
        start = time.perf_counter_ns()
        list(pool.map(lambda simulation: simulation.run(PERIODS), simulations))
        return (time.perf_counter_ns() - start) / (PERIODS * MONTE_CARLO_DRIVES)


def fresh_process(arguments: list[str], folder: Path) -> tuple[float, float]:
    """Return the least wall and processor time (s) of a command in a fresh process."""
    wall, cpu = [], []
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    environment["PYTHONPYCACHEPREFIX"] = str(folder / "compiled")  # an installed package is compiled once
    subprocess.run([sys.executable, *arguments], check=True, capture_output=True, cwd=folder, env=environment)
    for _ in range(START_REPEATS):
        before = os.times()
        start = time.perf_counter()
        subprocess.run([sys.executable, *arguments], check=True, capture_output=True, cwd=folder, env=environment)
        wall.append(time.perf_counter() - start)
        after = os.times()
        cpu.append(after.children_user + after.children_system - before.children_user - before.children_system)
    return min(wall), min(cpu)


def command_times(folder: Path) -> dict[str, tuple[float, float]]:
    """Time the command line: a design, a profile (which is designed first), and what Python and numpy cost alone."""
    one_second = ["--scenario", "load-step", "-o", "trace.npz"]  # 1 s, the whole drive, 25 signals in every period
    root = str(Path(__file__).resolve().parent.parent)
    program = ["-c", f"import sys; sys.path.insert(0, {root!r}); from pmsmtool.cli.main import main; main()"]
    subprocess.run(
        [sys.executable, *program, "tune", f"{root}/profiles/interior-2k2.toml", "-o", "design.toml"],
        check=True, capture_output=True, cwd=folder,
    )  # fmt: skip
    return {
        "python -c pass": fresh_process(["-c", "pass"], folder),
        "python -c 'import numpy'": fresh_process(["-c", "import numpy"], folder),
        "simulate design.toml, 1 s": fresh_process([*program, "simulate", "design.toml", *one_second], folder),
        "simulate profile, 1 s": fresh_process([*program, "simulate", "interior-2k2", *one_second], folder),
    }


def accuracy() -> dict[str, float]:
    """Return the current error of each scenario over one second against DOP853."""
    return {s.name: relative_error(simulate(s, PERIODS), reference_run(s, PERIODS)) for s in SCENARIOS}


def main() -> int:
    """Measure, print, and judge."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--accuracy", action="store_true", help="compare with DOP853")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    missed: list[str] = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        bare = bare_loop(folder)
        bare_ns = best_ns(bare)
        rows = {}
        for case in CASES:
            ns = best_ns(run_case(case))
            bare_ns = min(bare_ns, best_ns(bare, 3))  # again: the machine's clock moves
            rows[case.name] = ns
        ratios = {name: ns / bare_ns for name, ns in rows.items()}
        missed += [
            f"{case.name}: {ratios[case.name]:.2f} x"
            for case in CASES
            if case.limit is not None and ratios[case.name] > case.limit
        ]
        threads = os.cpu_count() or 1
        fleet = monte_carlo_ns(threads)
        commands = command_times(folder)
    if commands["simulate design.toml, 1 s"][0] > START_LIMIT_S:
        missed.append(f"fresh process: {commands['simulate design.toml, 1 s'][0]:.3f} s")
    errors = accuracy() if options.accuracy else {}
    missed += [f"{name}: error {error:.2g}" for name, error in errors.items() if error > ERROR_LIMIT]
    if options.json:
        data = {"bare_ns": bare_ns, "ns": rows, "ratio": ratios, "monte_carlo_ns": fleet, "threads": threads,
                "fresh_process_s": commands, "error": errors, "missed": missed}  # fmt: skip
        print(json.dumps({"schema": "pmsmtool.benchmark.simulation/1", **data}))
        return int(bool(missed))
    print(f"{'bare C loop':38} {bare_ns:8.1f} ns per period")
    for case in CASES:
        limit = "" if case.limit is None else f"  (limit {case.limit:g} x)"
        print(f"{case.name:38} {rows[case.name]:8.1f} ns  {ratios[case.name]:6.2f} x{limit}")
    print(f"{f'{MONTE_CARLO_DRIVES} drives, {threads} threads':38} {fleet:8.1f} ns per drive and period, wall clock")
    for name, (wall, cpu) in commands.items():
        print(f"{name:38} {1e3 * wall:8.0f} ms wall, {1e3 * cpu:.0f} ms processor")
    for name, error in errors.items():
        print(f"{name:38} {error:8.1e} of the largest current against DOP853  (limit {ERROR_LIMIT:g})")
    low, high = MOTULATOR_US
    print(f"context: motulator 0.18 on the same scenario, {low:g} to {high:g} us per step where a bare loop took 71 ns")
    for line in missed:
        print(f"MISSED {line}")
    return int(bool(missed))


if __name__ == "__main__":
    sys.exit(main())
