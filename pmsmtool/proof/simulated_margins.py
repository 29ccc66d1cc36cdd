# SPDX-License-Identifier: MIT
"""A design's drive in closed loop on many machines of its tolerance box: margins, and the step that a page recomputes.

The analytic part (``design.margins``) judges loops and steady references; here the whole firmware runs, governor and
field weakening included, and what counts is what the machines did. Only the box varies: sensors and inverter are ideal,
the ``[simulation]`` table of the machine file is left out. Drives come in blocks that are seeded one by one, and every
drive runs as it would alone: the result is the same whatever executor and however many workers or threads.

The page of a report recomputes a step by the C code of the kernel ``pmsm_sim``, as WebAssembly. What it needs is bytes:
the parameter image, and one setup per machine. Both have the same layout in WebAssembly and here: the one pointer of a
setup (to a flux map) is followed by doubles, which are aligned to 8 bytes there, too.
"""

from __future__ import annotations

import concurrent.futures
import ctypes
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.cia402 import error_text
from pmsmtool.design.design_file import Design
from pmsmtool.design.loops.margins import JUDGED_PERCENTILE, PERCENTILES, MarginRequest
from pmsmtool.design.tolerance import Samples, ToleranceBox, tolerance_box
from pmsmtool.errors import NotAvailable
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.params.parameter_set import ParameterSet
from pmsmtool.sim.closed_loop import (
    DriveRuns,
    Variation,
    cores,
    drive_values,
    image_of,
    open_simulation,
    simulate_many,
    vary,
)
from pmsmtool.sim.kernel import STRUCTS, Params, Part, Setup, Signal, Truth
from pmsmtool.sim.scenarios import MODES, SCHEDULES, Scenario, built_in
from pmsmtool.units import rad_s_from_rpm

BLOCK = 64
"""Drives of one block, which an executor gets as one task: about 0.1 s of work per simulated 0.1 s; fixed, because it
decides the numbers."""

BLOCKS_PER_CALL = 4
"""Blocks of one call in this process, over all its cores."""

REVERSALS = 10
"""Torque steps of the default scenario."""

SEED_STRIDE = 1_000_003
"""Apart of the noise seeds of two blocks."""


class SimulationExecutor(Protocol):
    """What is used of a ``concurrent.futures.Executor``."""

    def map(
        self, function: Callable[[SimulationTask], DriveRuns], tasks: Iterable[SimulationTask], /
    ) -> Iterator[DriveRuns]:
        """Apply a function to tasks, results in their order."""


@dataclass(frozen=True, slots=True, eq=False)
class SimulationTask:
    """Blocks ``first .. first + blocks - 1`` of the drives, ``drives`` in all blocks together."""

    machine: MachineFile
    params: ParameterSet
    scenario: Scenario
    box: ToleranceBox
    drives: int
    seed: int
    first: int
    blocks: int = 1
    threads: int = 1


@dataclass(frozen=True, slots=True)
class Observed:
    """One quantity over the simulated drives."""

    name: str
    unit: str
    """``simulated_current`` 1 - peak |i| / I_max, ``simulated_voltage`` 1 - peak |u| / V_max (transients may use all
    of it), ``simulated_thermal`` 1 - mean |i|^2 / I_cont^2, ``simulated_speed`` 1 - peak speed / trip speed,
    ``simulated_feasible`` share of the periods in which governor and field weakening found an admissible
    current, ``simulated_torque`` mean |torque| over that of the nominal drive; unit 1."""
    nominal: float
    worst: float
    """Of the nominal drive; the least of all."""
    worst_sample: Mapping[str, float]
    """The machine that did worst."""
    percentiles: Mapping[float, float]
    """Over the drives."""
    least: float | None
    """What was asked."""

    @property
    def ok(self) -> bool:
        """Whether what was asked holds at the judged percentile (the worst of many gets worse with their number)."""
        return self.least is None or self.percentiles[JUDGED_PERCENTILE] >= self.least


@dataclass(frozen=True, slots=True)
class SimulatedMargins:
    """What the drives of a box did."""

    scenario: str
    """What was simulated."""
    duration_s: float
    """For how long (s)."""
    drives: int
    """How many."""
    quantities: tuple[Observed, ...]
    """Over all of them."""
    trips: Mapping[str, int]
    """Trips by name, and how many drives had them."""
    outside_flux_map: int
    """Drives that left their flux map, whose numbers are to be doubted."""

    @property
    def ok(self) -> bool:
        """Whether everything that was asked holds, and no more drives tripped than the judged percentile leaves."""
        tripped = sum(self.trips.values()) <= JUDGED_PERCENTILE / 100.0 * self.drives
        return tripped and all(quantity.ok for quantity in self.quantities)


def torque_reversals(design: Design) -> Scenario:
    """Return the default scenario: torque steps between half of the rated torque and its negative, up to top speed.

    Speed and torque are those of the built-in ``field-weakening-sweep``.
    """
    sweep = built_in("field-weakening-sweep", design.machine, drive_values(design.machine, design.parameter_set()))
    torque = max(value for _, value in sweep.schedule["torque_nm"])
    step = sweep.duration_s / REVERSALS
    nodes = [(0.0, 0.0), (0.05, 0.0)]
    for k in range(REVERSALS):
        sign = -1.0 if k % 2 else 1.0
        nodes += [(max(0.05, k * step), sign * torque), ((k + 1) * step, sign * torque)]
    return replace(sweep, name="torque-reversals", schedule={**sweep.schedule, "torque_nm": tuple(nodes)})


def variations(samples: Samples, seed: int, block: int) -> list[Variation]:
    """Return the machines of a block's samples."""
    columns = {
        "R": "R_s_ohm", "L_d": "L_d_h", "L_q": "L_q_h", "psi_f": "psi_f_wb", "J": "J_kgm2",
        "encoder_rad": "encoder_rad", "T_winding_c": "T_winding_c", "T_magnet_c": "T_magnet_c", "U_dc_v": "U_dc_v",
    }  # fmt: skip
    values = {field: samples.column(name)[:, 0].tolist() for field, name in columns.items()}
    return [
        Variation(**{field: column[k] for field, column in values.items()}, seed=seed + SEED_STRIDE * block + k)
        for k in range(len(samples))
    ]


def run_task(task: SimulationTask) -> DriveRuns:
    """Draw and simulate the drives of a task (a module-level function, so that any executor can send it)."""
    machines: list[Variation] = []
    for block in range(task.first, task.first + task.blocks):
        count = min(BLOCK, task.drives - block * BLOCK)
        machines += variations(task.box.draw(count, task.seed, block), task.seed, block)
    return simulate_many(task.machine, task.params, task.scenario, machines, threads=task.threads)


def simulated_margins(
    design: Design,
    box: ToleranceBox,
    request: MarginRequest | None = None,
    *,
    drives: int,
    seed: int = 0,
    scenario: Scenario | None = None,
    executor: SimulationExecutor | None = None,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> SimulatedMargins:
    """Simulate a design's drive on machines of its tolerance box.

    Raises ConfigError: the scenario does not fit the drive.

    Parameters
    ----------
    design : Design
        What is judged; its parameters run in every drive.
    box : ToleranceBox
        What the machines may be.
    request : MarginRequest, optional
        What must hold: ``current_headroom`` and ``thermal_headroom`` are held against the simulated ones.
    drives : int
        How many machines, at least one.
    seed : int
        Of the machines.
    scenario : Scenario, optional
        What happens; :func:`torque_reversals` where none is given.
    executor : optional
        Anything with ``map`` (``concurrent.futures``, Dask), a block of drives per task. Without one, batches run in
        one call of the kernel over ``threads`` cores of this process (all of them by default).
    progress : callable, optional
        Told the drives done and wanted.
    """
    request = MarginRequest() if request is None else request
    scenario = torque_reversals(design) if scenario is None else scenario
    machine, params = replace(design.machine, simulation={}), design.parameter_set()
    task = SimulationTask(machine, params, scenario, box, drives, seed, 0)
    nominal = simulate_many(machine, params, scenario, variations(box.nominal(machine), seed, -1), threads=1)
    runs: list[DriveRuns] = []
    for run in _runs(task, executor, cores() if threads is None else threads):
        runs.append(run)
        if progress is not None:
            progress(sum(len(part.trip) for part in runs), drives)
    return _judge(design, nominal, runs, task, request)


def _runs(task: SimulationTask, executor: SimulationExecutor | None, threads: int) -> Iterator[DriveRuns]:
    blocks = math.ceil(task.drives / BLOCK)
    done = 0
    if executor is not None:
        try:
            for run in executor.map(run_task, [replace(task, first=k) for k in range(blocks)]):
                done += 1
                yield run
        except concurrent.futures.BrokenExecutor:
            pass  # a worker died: blocks are seeded one by one, so doing the rest here gives the same numbers
    while done < blocks:
        count = min(BLOCKS_PER_CALL, blocks - done)
        yield run_task(replace(task, first=done, blocks=count, threads=threads))
        done += count


def _quantities(design: Design, run: DriveRuns, torque_nm: float) -> dict[str, Array]:
    trip_rad_s = rad_s_from_rpm(design["protection.n_trip_rpm"])
    return {
        "simulated_current": 1.0 - run.i_peak_a / design["motor.I_max_apk"],
        "simulated_voltage": 1.0 - run.u_peak / design["inverter.voltage_utilisation"],
        "simulated_thermal": 1.0 - (run.i_rms_a / design["protection.I_cont_apk"]) ** 2,
        "simulated_speed": 1.0 - run.omega_peak_rad_s / trip_rad_s,
        "simulated_feasible": 1.0 - run.infeasible,
        "simulated_torque": run.torque_nm / torque_nm if torque_nm else np.ones_like(run.torque_nm),
    }


def _judge(
    design: Design, nominal: DriveRuns, runs: list[DriveRuns], task: SimulationTask, request: MarginRequest
) -> SimulatedMargins:
    torque = float(nominal.torque_nm[0])
    at_nominal = _quantities(design, nominal, torque)
    parts = [_quantities(design, run, torque) for run in runs]
    asked = {"simulated_current": request.current_headroom, "simulated_thermal": request.thermal_headroom}
    found = []
    for name, own in at_nominal.items():
        values = np.concatenate([part[name] for part in parts])
        row = int(np.argmin(values))
        count = min(BLOCK, task.drives - row // BLOCK * BLOCK)
        sample = task.box.draw(count, task.seed, row // BLOCK).describe(row % BLOCK)
        shares = {p: float(np.percentile(values, p)) for p in PERCENTILES}
        found.append(Observed(name, "1", float(own[0]), float(values[row]), sample, shares, asked.get(name)))
    codes, counts = np.unique(np.concatenate([run.trip for run in runs]), return_counts=True)
    trips = {error_text(int(c)): int(n) for c, n in zip(codes, counts, strict=True) if c}
    outside = sum(int(np.count_nonzero(run.outside)) for run in runs)
    return SimulatedMargins(task.scenario.name, task.scenario.duration_s, task.drives, tuple(found), trips, outside)


DRAWN = 32
"""Machines drawn from the tolerance box: the page runs them within 0.1 s, and their range holds 91 % of all."""
SCENARIO = "q-step"
SETTLED = 20.0
"""Time after the step over the time constant that the current loops were designed for."""
LONGEST_S = 0.2
SIGNALS: Mapping[str, int] = {"i_q": Truth.I_Q, "i_d": Truth.I_D, "reference": Signal.I_Q_REF, "trip": Truth.TRIP}
"""Recorded in every period."""


@dataclass(frozen=True, slots=True)
class Moved:
    """Where a quantity stands that a reader moves: byte offsets in the setup (doubles) and the parameters (floats)."""

    setup: tuple[int, ...] = ()
    params: tuple[int, ...] = ()


def _machine(*names: str) -> tuple[int, ...]:
    return tuple(int(Setup.machine.offset + getattr(STRUCTS["pmsm_machine"], name).offset) for name in names)


MOVED: Mapping[str, Moved] = {
    "R": Moved(setup=_machine("R_copper", "R_fixed")),
    "L": Moved(setup=_machine("L_d", "L_q")),
    "U_dc": Moved(setup=(int(Setup.U_dc.offset),)),
    "I_max": Moved(params=(int(Params.motor_I_max_apk.offset), int(Params.governor_I_transient_apk.offset))),
}
"""Factors; the delay moves the sampling instant (:data:`SHIFT`)."""
PARTS: Mapping[str, int] = {"params": Part.PARAMS, "reference": Part.REFERENCE, "enabled": Part.ENABLED}
"""Parts of the drive that the page writes to."""
SHIFT = int(Setup.sampling_shift.offset)


@dataclass(frozen=True, slots=True)
class StepTask:
    """Everything that decides the bytes of the step."""

    image: bytes
    """Parameter image of the drive."""
    setups: Sequence[bytes]
    """The machine as designed, then the drawn ones."""
    schedules: Sequence[tuple[int, Sequence[float], Sequence[float]]]
    """What is asked. Sequence of (target, times in s, values)."""
    mode: int
    """Of the drive."""
    periods: int
    """Control periods that are run."""
    T_s: float
    """Control period (s)."""
    step_s: float
    """When the step is asked (s)."""
    U_dc_v: float
    """DC link (V)."""
    scenario: Scenario
    """Where the above come from."""


def step_task(design: Design, drawn: int = DRAWN) -> StepTask:
    """Return the step of a design.

    Raises NotAvailable: the machine saturates: its flux map does not go into the page; ConfigError: the design cannot
    be simulated.
    """
    if design.machine.flux_map is not None:
        raise NotAvailable("the machine saturates, and its flux map is not in the page")
    machine, params = replace(design.machine, simulation={}), design.parameter_set()
    scenario = built_in(SCENARIO, machine, drive_values(machine, params))
    step_s = scenario.schedule["i_q_a"][-1][0]
    settled_s = min(SETTLED / design["governor.alpha_rad_s"], LONGEST_S)
    scenario = replace(scenario, duration_s=step_s + settled_s)
    changed, model, periods = open_simulation(machine, params, scenario)
    machines = variations(tolerance_box(machine).draw(drawn, 0, 0), 0, 0)
    setups = [model.setup, *(Setup() for _ in machines)]
    for setup, variation in zip(setups[1:], machines, strict=True):
        vary(setup, model.setup, None, variation)
    schedules = []
    for name, profile in scenario.schedule.items():
        target, factor = SCHEDULES[name]
        schedules.append((int(target), [t for t, _ in profile], [factor * v for _, v in profile]))
    return StepTask(
        image_of(changed, params), [ctypes.string_at(ctypes.addressof(s), ctypes.sizeof(Setup)) for s in setups],
        schedules, int(MODES[scenario.mode]), periods, 1e-9 * model.params.inverter_T_s_ns, step_s, model.setup.U_dc,
        scenario,
    )  # fmt: skip
