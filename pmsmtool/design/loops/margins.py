# SPDX-License-Identifier: MIT
"""Margins of a design over its tolerance box: loop margins and limit headroom, kept apart.

Interval corners give the worst case of the 95 % box with the corner that causes it, random samples give percentiles.
Random samples come in blocks that are seeded one by one: the result is the same whatever executor draws them, with
however many workers.
"""

from __future__ import annotations

import concurrent.futures
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.design.design_file import Design
from pmsmtool.design.loops.current_loop import AxisPlant, CurrentGains, axis_loop
from pmsmtool.design.loops.designed_loops import designed_speed_loop, least_inductance
from pmsmtool.design.loops.sampled_loop import SampledLoop, margins
from pmsmtool.design.loops.vector_margins import (
    Response,
    VectorMargins,
    current_response,
    speed_response,
    vector_margins,
)
from pmsmtool.design.ratings import ratings_of
from pmsmtool.design.tolerance import (
    Headroom,
    HeadroomLimits,
    OperatingCells,
    Samples,
    ToleranceBox,
    headroom,
    operating_cells,
)
from pmsmtool.machine.parameters import MachineParameters
from pmsmtool.machine.temperature import magnet_flux_at, resistance_at
from pmsmtool.plain_text import Summarised, Summary

BLOCK = 2048
"""Random samples of one block (40 ms of work); fixed, because it decides the numbers."""

BLOCKS_PER_TASK = 4
"""Blocks that an executor gets as one task: 0.16 s of work, next to which the 3 ms of a Dask task are negligible."""

PERCENTILES = (1.0, 5.0, 50.0, 95.0)
"""Reported percentiles."""

JUDGED_PERCENTILE = 5.0
"""A requested margin must hold at this percentile of the random samples, and at every corner."""

CELLS_NAMED = 8
"""Cells beyond a limit that are named, the most frequent first."""

_PREDICTOR_OPTION = 1 << 4
_AXES = ("d", "q")


class BlockExecutor(Protocol):
    """What is used of a ``concurrent.futures.Executor``."""

    def map(self, function: Callable[[BlockTask], Blocks], tasks: Iterable[BlockTask], /) -> Iterator[Blocks]:
        """Apply a function to tasks, results in their order."""


@dataclass(frozen=True, slots=True)
class MarginRequest:
    """Least margins; None is reported and not judged."""

    phase_margin_deg: float = 30.0
    gain_margin_db: float = 4.0
    """Of the current loops, worst corner and fifth percentile."""
    speed_phase_margin_deg: float | None = 30.0
    """Of the speed loop."""
    voltage_headroom: float | None = None
    current_headroom: float | None = None
    thermal_headroom: float | None = None
    """Ratios of the limits."""

    def least(self, quantity: str) -> float | None:
        """Return what is asked of a quantity by its name."""
        if quantity.startswith("speed"):
            return self.speed_phase_margin_deg if quantity.endswith("phase") else None
        return {
            "phase": self.phase_margin_deg,
            "gain": self.gain_margin_db,
            "voltage": self.voltage_headroom,
            "current": self.current_headroom,
            "thermal": self.thermal_headroom,
        }.get(quantity.rpartition("_")[2])


@dataclass(frozen=True, slots=True)
class Spread:
    """One quantity over the box."""

    name: str
    unit: str
    """``current_d_phase`` (deg), ``current_d_gain`` (dB), ``current_d_delay`` (us), likewise q and speed;
    ``headroom_voltage``, ``headroom_current``, ``headroom_thermal`` (1)."""
    nominal: float
    worst: float
    """At the nominal machine, and the least over the corners."""
    worst_sample: Mapping[str, float]
    """The corner that causes it."""
    worst_cell: str
    """Operating point, for headroom."""
    percentiles: Mapping[float, float]
    """Of the random samples; empty without."""
    least: float | None
    """What was asked."""

    @property
    def unjudged(self) -> bool:
        """Whether this is a headroom that ends beyond its limit, without a least one that was asked."""
        return self.least is None and self.worst < 0.0 and self.name in _BEYOND

    @property
    def ok(self) -> bool:
        """Whether what was asked holds at every corner and at the judged percentile."""
        if self.least is None:
            return True
        return self.worst >= self.least and self.percentiles.get(JUDGED_PERCENTILE, math.inf) >= self.least


@dataclass(frozen=True, slots=True)
class CellRisk:
    """An operating point that some machines cannot hold: shares of samples beyond each limit."""

    cell: str
    voltage: float
    current: float


@dataclass(frozen=True, slots=True, repr=False)
class MarginReport(Summarised):
    """Margins of a design over its box."""

    loops: tuple[Spread, ...]
    headroom: tuple[Spread, ...]
    """Loop margins; limit headroom."""
    cells: tuple[CellRisk, ...]
    """Operating points beyond a limit, over the random samples where there are any, else over the corners."""
    unreachable: tuple[str, ...]
    """Operating points up to rated torque that the nominal machine does not reach."""
    corners: int
    samples: int
    """How many were evaluated."""
    notes: tuple[str, ...]
    """What was assumed, and each headroom below zero that nobody asked to be judged."""

    def summary(self) -> Summary:
        """Return the margins at the worst corner."""
        rows = [
            (
                s.name,
                s.unit,
                f"{s.nominal:.4g}",
                f"{s.worst:.4g}",
                *(("-", "-") if s.least is None else (s.least, s.ok)),
            )
            for s in (*self.loops, *self.headroom)
        ]
        head = f"margins over {self.corners} corners and {self.samples} samples, ok: {self.ok}"
        return Summary(head, ("margin", "unit", "nominal", "worst corner", "asked", "ok"), rows)

    @property
    def ok(self) -> bool:
        """Whether everything that was asked holds."""
        return all(spread.ok for spread in (*self.loops, *self.headroom))


@dataclass(frozen=True, slots=True, eq=False)
class MarginProblem:
    """Everything a block needs, small enough to be sent to a worker."""

    machine: MachineParameters
    plants: Mapping[str, AxisPlant]
    least: Mapping[str, float]
    gains: Mapping[str, CurrentGains]
    predictor: bool
    speed: SampledLoop | None
    speed_crossover: float
    cells: OperatingCells
    limits: HeadroomLimits


@dataclass(frozen=True, slots=True, eq=False)
class BlockTask:
    """Blocks ``first .. first + blocks - 1`` of the random samples, ``samples`` in all blocks together."""

    problem: MarginProblem
    box: ToleranceBox
    samples: int
    seed: int
    first: int
    blocks: int


@dataclass(frozen=True, slots=True, eq=False)
class BlockResult:
    """Quantities of a block, shape (n,) each, with the worst cell of each headroom and the cells beyond limits."""

    values: Mapping[str, Array]
    cells: Mapping[str, NDArray[np.intp]]
    beyond: Mapping[str, Array]


def margin_problem(design: Design) -> MarginProblem:
    """Collect what the evaluation needs from a design."""
    source = design.machine
    rated = ratings_of(design)
    T_s, delay = source.inverter.T_s, design["inverter.delay_periods"]
    machine = source.machine
    plants = {
        axis: AxisPlant(machine.R_s_ohm, L, T_s, delay)
        for axis, L in zip(_AXES, (machine.L_d_h, machine.L_q_h), strict=True)
    }
    gains = {
        axis: CurrentGains(design[f"current.K_p_{axis}_v_per_a"], design[f"current.K_i_{axis}_v_per_as"])
        for axis in _AXES
    }
    predictor = bool(int(design["current.options"]) & _PREDICTOR_OPTION) and delay >= 1.0
    limits = HeadroomLimits(
        design["inverter.voltage_utilisation"], design["motor.I_max_apk"], design["protection.I_cont_apk"],
        design["protection.T_winding_max_c"],
    )  # fmt: skip
    speed = designed_speed_loop(design, axis_loop(gains["q"], plants["q"], plants["q"] if predictor else None))
    crossover = 0.0 if speed is None else margins(speed).crossover_rad_s
    least = least_inductance(source, rated.I_max_apk)
    cells = operating_cells(source, rated, design["field_weakening.margin"])
    return MarginProblem(machine, plants, least, gains, predictor, speed, crossover, cells, limits)


def evaluate(problem: MarginProblem, samples: Samples) -> BlockResult:
    """Evaluate every quantity on every sample."""
    values: dict[str, Array] = {}
    responses: dict[str, Response] = {}
    R = samples.column("R_s_ohm") * resistance_at(problem.machine, samples.column("T_winding_c"))
    for axis in _AXES:
        plant = problem.plants[axis]
        span = problem.least.get(axis, plant.L) - plant.L
        L = samples.column(f"L_{axis}_h") * (plant.L + samples.column("operating_point") * span)
        model = (plant.R, plant.L) if problem.predictor else None
        responses[axis] = current_response(problem.gains[axis], R, L, plant.T_s, plant.delay_periods, model)
        alpha = problem.gains[axis].K_p / plant.L
        _store(values, f"current_{axis}", vector_margins(responses[axis], plant.T_s, alpha))
    if problem.speed is not None:
        plant = problem.plants["q"]
        model = (plant.R, plant.L) if problem.predictor else None
        here = np.array([[plant.R]]), np.array([[plant.L]])
        nominal = current_response(problem.gains["q"], *here, plant.T_s, plant.delay_periods, model)
        psi = magnet_flux_at(problem.machine, samples.column("T_magnet_c")) / (problem.machine.psi_f_wb or 1.0)
        gain = samples.column("psi_f_wb") * psi / samples.column("J_kgm2")
        loop = speed_response(problem.speed, gain, responses["q"], nominal)
        _store(values, "speed", vector_margins(loop, problem.speed.T_s, problem.speed_crossover))
    found = headroom(problem.machine, problem.cells, problem.limits, samples)
    return _with_headroom(values, found)


def _store(values: dict[str, Array], name: str, found: VectorMargins) -> None:
    values[f"{name}_phase"] = found.phase_deg
    values[f"{name}_gain"] = found.gain_db
    values[f"{name}_delay"] = 1e6 * found.delay_s


def _with_headroom(values: dict[str, Array], found: Headroom) -> BlockResult:
    parts = {"headroom_voltage": found.voltage, "headroom_current": found.current}
    worst = {name: np.argmin(part, axis=1) for name, part in parts.items()}
    values |= {name: part.min(axis=1) for name, part in parts.items()}
    values["headroom_thermal"] = found.thermal
    beyond = {name: (part < 0.0).sum(axis=0).astype(np.float64) for name, part in parts.items()}
    return BlockResult(values, worst, beyond)


Blocks = tuple[BlockResult, ...]
"""Results of the blocks of a task, in their order."""


def evaluate_blocks(task: BlockTask) -> Blocks:
    """Draw and evaluate the blocks of a task (a module-level function, so that any executor can send it)."""
    return tuple(
        evaluate(task.problem, task.box.draw(min(BLOCK, task.samples - block * BLOCK), task.seed, block))
        for block in range(task.first, task.first + task.blocks)
    )


def margin_report(
    design: Design,
    box: ToleranceBox,
    request: MarginRequest | None = None,
    *,
    samples: int = 0,
    seed: int = 0,
    executor: BlockExecutor | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> MarginReport:
    """Evaluate a design over its tolerance box; of its loops those that it names (``Design.loops``).

    Parameters
    ----------
    design : Design
        What is judged.
    box : ToleranceBox
        What the machine may be (``tolerance.tolerance_box``).
    request : MarginRequest, optional
        What must hold.
    samples : int
        Random samples; 0 for corners only.
    seed : int
        Of the random samples.
    executor : optional
        Anything with ``map`` (``concurrent.futures``, Dask); this process where none is given.
    progress : callable, optional
        Told the random samples done and wanted.
    """
    request = MarginRequest() if request is None else request
    problem = margin_problem(design)
    nominal = evaluate(problem, box.nominal(design.machine))
    corners = box.corners()
    at_corners = evaluate(problem, corners)
    blocks = []
    for block in _draw(problem, box, samples, seed, executor):
        blocks.append(block)
        if progress is not None:
            progress(min(len(blocks) * BLOCK, samples), samples)
    random = {name: np.concatenate([b.values[name] for b in blocks]) for name in nominal.values} if blocks else {}
    spreads = []
    judged = {"headroom", *(name.partition("_")[0] for name in design.loops)}
    for name in nominal.values:
        if name.partition("_")[0] not in judged:
            continue
        row = int(np.argmin(at_corners.values[name]))
        cell = problem.cells.name(int(at_corners.cells[name][row])) if name in at_corners.cells else ""
        shares = {p: float(np.percentile(random[name], p)) for p in PERCENTILES} if blocks else {}
        spreads.append(
            Spread(
                name, _UNITS[name.rpartition("_")[2]], float(nominal.values[name][0]),
                float(at_corners.values[name][row]), corners.describe(row), cell, shares, request.least(name),
            )
        )  # fmt: skip
    return MarginReport(
        tuple(s for s in spreads if not s.name.startswith("headroom")),
        tuple(s for s in spreads if s.name.startswith("headroom")),
        _risks(problem, blocks or [at_corners]),
        problem.cells.unreachable,
        len(corners),
        samples,
        (*box.notes, *(_told(spread) for spread in spreads if spread.unjudged)),
    )


_BEYOND = {
    "headroom_voltage": "the references need more voltage than there is",
    "headroom_current": "rated torque needs more than the largest current",
    "headroom_thermal": "rated torque warms the winding more than the continuous current at its limit does",
}


def _told(spread: Spread) -> str:
    option = spread.name.replace("headroom_", "--") + "-headroom"
    return (
        f"{spread.name} {spread.worst:.3g} at the worst corner: {_BEYOND[spread.name]}; not judged "
        f"(`pmsmtool margins {option} RATIO` judges it)"
    )


_UNITS = {"phase": "deg", "gain": "dB", "delay": "us", "voltage": "1", "current": "1", "thermal": "1"}


def _draw(
    problem: MarginProblem, box: ToleranceBox, samples: int, seed: int, executor: BlockExecutor | None
) -> Iterator[BlockResult]:
    blocks = math.ceil(samples / BLOCK)

    def task(first: int, most: int) -> BlockTask:
        return BlockTask(problem, box, samples, seed, first, min(most, blocks - first))

    done = 0
    if executor is not None:
        try:
            for results in executor.map(
                evaluate_blocks, [task(first, BLOCKS_PER_TASK) for first in range(0, blocks, BLOCKS_PER_TASK)]
            ):
                done += len(results)
                yield from results
        except concurrent.futures.BrokenExecutor:
            pass  # a worker died: blocks are seeded one by one, so doing the rest here gives the same numbers
    for first in range(done, blocks):
        yield from evaluate_blocks(task(first, 1))


def _risks(problem: MarginProblem, blocks: list[BlockResult]) -> tuple[CellRisk, ...]:
    count = sum(len(block.values["headroom_thermal"]) for block in blocks)
    shares = {name: sum(b.beyond[name] for b in blocks) / count for name in ("headroom_voltage", "headroom_current")}
    voltage, current = np.asarray(shares["headroom_voltage"]), np.asarray(shares["headroom_current"])
    order = np.argsort(-np.maximum(voltage, current), kind="stable")[:CELLS_NAMED]
    return tuple(
        CellRisk(problem.cells.name(int(k)), float(voltage[k]), float(current[k]))
        for k in order
        if max(voltage[k], current[k]) > 0.0
    )
