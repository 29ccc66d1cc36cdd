# SPDX-License-Identifier: MIT
"""Instructions of the control core on Cortex-M3, M4F and M7, counted under emulation, against the budgets.

Run from the repository with ``pip install ziglang==0.14.1 unicorn``: ``python benchmarks/core_cost.py``
``[--markdown FILE]``; about two minutes of one core. How it is compiled, emulated and weighted stands in
``tests/firmware/cortex_m.py``. Instructions are exact; cycles are a model of the M4F, not silicon.

Two sets of inputs: *nominal*, a closed loop at 620 rpm with steps of the request; *adversarial*, a search over states
that no closed loop visits (current, integrators, observer, held reference, voltages, transfer under way, speed, DC
voltage, request): 2000 random ones, then climbs from the worst of them by random changes. Budgets belong to the
adversarial worst case. The governor's cost is that of the period with it less that of the same period without.

A search is no proof. What is bounded by construction are the Newton steps of a period (``PMSM_PROJECTION_STEPS``),
those of governor and field weakening together: a step of a corner counts as two, so does a trial of the minimum-time
direction, an iteration of the field weakening as three, a node of the look-up table beyond its third as one, and an
exchange of rows takes one at least; the other loops have fixed ends. The bound that is printed is the
dearest step times their number, on top of the dearest rest of a period: of all searched periods the largest cost less
its steps, each counted as the cheapest kind. The laws are as ``tune`` writes them: options, tightening and delay.

Exit code 0: every budget met; 1: one is missed; 77: skipped, a tool is absent (the line says which).
"""

from __future__ import annotations

import argparse
import ctypes
import math
import re
import struct
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from pmsmtool.commissioning.export import image_of, q_files
from pmsmtool.design.governor import EPS_LEAST
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.firmware.core_binding import CORE_HEADERS, HEADER_FOLDER, core
from pmsmtool.firmware.image import SCALAR_WORDS, pack_image
from pmsmtool.machine.flux_map import FluxMap
from pmsmtool.machine.machine_file import load_machine_file, machine_path
from pmsmtool.native import parse_structs
from tests.firmware import cortex_m
from tests.firmware.closed_loop import (
    BEST,
    CURRENT_ROW,
    LINE,
    MINIMUM_TIME,
    MODE_CURRENT,
    MODE_TORQUE,
    PAPER,
    PRE_PROJECTION,
    PREDICTOR,
    RPM,
    Loop,
    reference_case,
)
from tests.firmware.governor_q import FixedPointSignals
from tests.firmware.linear_plant import LinearPlant
from tests.firmware.test_projection import instances

SKIPPED = 77
BUDGET_12_KHZ, BUDGET_10_KHZ = 14_167, 17_000
"""Cycles of a control period at 170 MHz."""
LINE_LIMIT, EXACT_LIMIT = 900, 4500
"""Instructions: line search; exact projection on 12 rows (k_max 10 and the steady state)."""
BEST_MEAN, BEST_WORST, BOUND, UNIFIED_WORST = 0.40, 0.55, 0.65, 0.25
"""Shares of the whole period: best mode over 12 kHz, mean and worst found; best mode with field weakening, bound by
construction; unified polar law over 10 kHz."""
STEP_INSTANCES, STEP_MOST = 300, 150
"""Projections that are cut off step by step; more cycles per step than this are more than steps."""
TORQUE_I_MAX = 30.0
"""Current limit (A) of the torque law that is measured at its limits."""
SATURATES, MAP_NODES = 0.3, 15
"""Share of the flux of the current that a saturated machine lacks at I_max, and nodes of its map on an axis."""
SATURATED = ("saturated: best + table", "saturated: best + table, predictor")
"""Laws with the tables of a saturated machine: flux and inductances, and currents of a torque and a speed."""
BOUNDED = ("best, delay", "best + accelerated FW", *SATURATED)
"""Laws whose cost is bounded by construction."""
NOMINAL_STEPS, RANDOM_STATES, CLIMBS, CHANGES = 180, 2000, 12, 120
_HEADER = (HEADER_FOLDER / "pmsm_projection.h").read_text(encoding="ascii")
STEPS_BUDGET = int(re.findall(r"#define PMSM_PROJECTION_STEPS (\d+)u", _HEADER)[-1])
"""Newton steps of a period in binary32; a last step of a corner may count one more."""
STEP_LEAST = 61
"""Cycles that every Newton step takes at least (checked)."""
STACK_MOST, STACK_STATES, PAINT = 0x4000, 400, b"\xa5"
"""Bytes of stack that are looked at, random states for it, and what they hold before."""
V_DC = 210.0
STATE_SIZE = 24
"""Numbers that describe an adversarial state."""


class Target:
    """The core's structures in the emulated memory, and one period at a time."""

    def __init__(self, emulator: cortex_m.Emulator, law: Law) -> None:
        text = "\n".join((HEADER_FOLDER / name).read_text(encoding="ascii") for name in CORE_HEADERS)
        types = parse_structs(text)
        self.emulator = emulator
        self.state, self.measurement, self.reference, self.output = (
            types[f"pmsm_{name}"]() for name in ("state", "measurement", "reference", "output")
        )
        self.at = {name: cortex_m.DATA + 0x2000 * k for k, name in enumerate(("state", "m", "r", "o", "params"))}
        emulator.write(self.at["params"], law.image or pack_image(law.values))
        self.at["tables"] = self.at["params"] + 4 * SCALAR_WORDS if law.image else 0
        emulator.call("pmsm_init", self.at["state"])
        self.pull()
        self.reference.mode, self.measurement.U_dc = MODE_CURRENT, V_DC
        self.step()
        self.prepared = bytes(self.state)

    def pull(self) -> None:
        """Copy the controller's memory out of the emulator."""
        size = ctypes.sizeof(self.state)
        self.state = type(self.state).from_buffer_copy(self.emulator.read(self.at["state"], size))

    def step(self) -> tuple[int, int]:
        """Run one period on the present structures; return instructions and model cycles."""
        at, emulator = self.at, self.emulator
        for name, content in (("state", self.state), ("m", self.measurement), ("r", self.reference)):
            emulator.write(at[name], bytes(content))
        cost = emulator.call("pmsm_step", at["state"], at["params"], at["tables"], at["m"], at["r"], at["o"])
        self.pull()
        self.output = type(self.output).from_buffer_copy(emulator.read(at["o"], ctypes.sizeof(self.output)))
        return cost


@dataclass(frozen=True)
class Law:
    """One configuration: values, what is requested, and the law whose period is the same without the governor.

    ``image``: values and tables, where there are tables.
    """

    values: dict[str, float]
    mode: int = MODE_CURRENT
    without: str = ""
    image: bytes = b""


def saturated(predictor: bool) -> Law:
    """The machine of the reference case with a map whose flux falls short by SATURATES at I_max, as ``tune`` has it."""
    source = load_machine_file(machine_path("jercic-2017"))
    machine = source.machine
    axis = np.linspace(-1.2, 1.2, MAP_NODES) * reference_case(0.0)["motor.I_max_apk"]
    i_d, i_q = np.meshgrid(axis, axis, indexing="ij")
    falls = 1.0 / (1.0 + SATURATES * np.hypot(i_d, i_q) / axis[-1])
    given = FluxMap(axis, axis, machine.psi_f_wb + machine.L_d_h * falls * i_d, machine.L_q_h * falls * i_q)
    params = tune(replace(source, flux_map=given), TuneRequest(predictor=predictor)).parameter_set()
    return Law(dict(params.values), MODE_TORQUE, image=image_of(params))


@cache
def laws() -> dict[str, Law]:
    """Name -> measured configuration."""
    rows, options = CURRENT_ROW | PRE_PROJECTION, CURRENT_ROW | PRE_PROJECTION | MINIMUM_TIME
    best = {"governor__mode": BEST, "governor__eps": EPS_LEAST, "governor__observer_gain": 0.1}
    delay = {"inverter__delay_periods": 1.5}
    return {
        "PI": Law(reference_case(4000.0)),
        "PI, predictor": Law(reference_case(4000.0, current__options=23, **delay)),
        "line search": Law(
            reference_case(4000.0, governor__mode=LINE, governor__eps=EPS_LEAST, governor__options=rows, **delay),
            without="PI",
        ),
        "exact, 7 rows": Law(reference_case(4000.0, governor__mode=PAPER, governor__k_max=5), without="PI"),
        "exact, 12 rows": Law(reference_case(4000.0, governor__mode=PAPER, governor__k_max=10), without="PI"),
        "best, rows only": Law(reference_case(4000.0, **best, governor__options=CURRENT_ROW), without="PI"),
        "best": Law(reference_case(4000.0, **best, **delay, governor__options=options), without="PI"),
        "best, delay": Law(
            reference_case(7540.0, **best, **delay, governor__options=options | PREDICTOR), without="PI, predictor"
        ),
        "best + accelerated FW": Law(
            reference_case(4000.0, **best, **delay, governor__options=options, field_weakening__mode=3), MODE_TORQUE
        ),
        **{name: saturated(predictor="predictor" in name) for name in SATURATED},
        "polar, proposed": Law(reference_case(4000.0, polar__mode=2)),
        "polar, regularised": Law(reference_case(4000.0, polar__mode=5)),
        "polar, unified": Law(reference_case(4000.0, polar__mode=6, polar__options=4, **delay)),
        "polar, unified, torque": Law(
            reference_case(4000.0, polar__mode=6, polar__options=4, motor__I_max_apk=TORQUE_I_MAX, **delay), MODE_TORQUE
        ),
    }


@dataclass(frozen=True)
class Cost:
    """Mean and worst instructions and model cycles over a set of inputs, the input of the most cycles.

    ``rest`` is the largest cost less the cheapest conceivable cost of the Newton steps in it.
    """

    mean: float
    worst: int
    mean_cycles: float
    worst_cycles: int
    worst_input: np.ndarray | None = None
    rest: float = 0.0


def summary(costs: list[tuple[int, int]], worst_input: np.ndarray | None = None) -> Cost:
    """Collect single periods."""
    counts, cycles = np.array(costs).T
    return Cost(float(counts.mean()), int(counts.max()), float(cycles.mean()), int(cycles.max()), worst_input)


def nominal(target: Target, law: Law) -> Cost:
    """Closed loop at 620 rpm with a step of the request every 60 periods."""
    values = law.values
    plant = LinearPlant(
        R=values["motor.R_s_ohm"],
        L_d=values["motor.L_d_h"],
        L_q=values["motor.L_q_h"],
        psi=values["motor.psi_f_wb"],
        T_s=1e-9 * values["inverter.T_s_ns"],
        omega=620 * RPM,
        delayed=values["inverter.delay_periods"] >= 1,
    )
    m, r = target.measurement, target.reference
    costs = []
    target.state = type(target.state).from_buffer_copy(target.prepared)
    for k in range(NOMINAL_STEPS):
        m.i_a, m.i_b, m.i_c = plant.phases()
        m.theta_e, m.omega_e, m.U_dc, m.T_winding = plant.theta, plant.omega, V_DC, 20.0
        r.mode, r.i_q_ref, r.tau_ref = law.mode, (28.0, -28.0, 0.0)[k // 60], (40.0, -40.0, 0.0)[k // 60]
        costs.append(target.step())
        plant.advance(target.output.u_alpha, target.output.u_beta)
    return summary(costs)


def set_state(target: Target, law: Law, x: np.ndarray) -> None:
    """Any state of memory and inputs from numbers between 0 and 1."""
    target.state = type(target.state).from_buffer_copy(target.prepared)
    m, r, state, R = target.measurement, target.reference, target.state, law.values["motor.R_s_ohm"]
    top = 1300.0 if law.mode == MODE_CURRENT else 1000.0
    radius, angle = 56 * np.sqrt(x[:4]), 2 * math.pi * x[4:8]
    i, asked, held, before = (np.array([a * math.cos(p), a * math.sin(p)]) for a, p in zip(radius, angle, strict=True))
    theta = 6.0 * (x[8] - 0.5)
    alpha = math.cos(theta) * i[0] - math.sin(theta) * i[1]
    beta = math.sin(theta) * i[0] + math.cos(theta) * i[1]
    m.i_a, m.i_b = alpha, -alpha / 2 + math.sqrt(0.75) * beta
    m.i_c = -m.i_a - m.i_b
    m.theta_e, m.omega_e = theta, 2 * top * (x[9] - 0.5) * RPM
    m.U_dc, m.T_winding = V_DC * (0.8 + 0.3 * x[10]), 20.0
    r.mode, (r.i_d_ref, r.i_q_ref), r.tau_ref = law.mode, asked, 160 * (x[11] - 0.5)
    state.integrator.d, state.integrator.q = R * i + 16 * (x[12:14] - 0.5)
    state.disturbance.d, state.disturbance.q = 16 * (x[14:16] - 0.5)
    state.reference_held.d, state.reference_held.q = held
    state.current_before.d, state.current_before.q = before
    state.time_to_go = max(0.0, 0.016 * (x[16] - 0.5))
    state.landing = int(x[17] > 0.5)
    for k, held_voltage in enumerate((state.voltage_committed, state.voltage_before)):
        size, direction = 140 * math.sqrt(x[18 + 2 * k]), 2 * math.pi * x[19 + 2 * k]
        held_voltage.d, held_voltage.q = size * math.cos(direction), size * math.sin(direction)
    state.fw_reference.d, state.fw_reference.q = -abs(before[0]), before[1]
    state.lut_cut = int(x[22] * (law.values["lut.n_x"] + 1.0))
    state.reachable_age = int(x[23] > 0.5)
    state.reachable.d, state.reachable.q = held


def adversarial(target: Target, law: Law) -> Cost:
    """Random states, then climbs from the worst of them by changes of a few numbers."""
    rng = np.random.default_rng(1)
    rest = 0.0

    def cost(x: np.ndarray) -> tuple[int, int]:
        nonlocal rest
        set_state(target, law, x)
        found = target.step()
        rest = max(rest, found[1] - STEP_LEAST * target.state.live.iterations)
        return found

    return replace(climb(cost, rng, STATE_SIZE), rest=rest)


def climb(cost: Callable[[np.ndarray], tuple[int, int]], rng: np.random.Generator, size: int) -> Cost:
    """Random points of the unit cube, then from the worst of them changes that do not make it cheaper."""
    points = rng.uniform(size=(RANDOM_STATES, size))
    costs = [cost(x) for x in points]
    random_costs = summary(costs)
    worst, worst_input = 0, points[0]
    most = random_costs.worst
    for start in np.argsort([-c[1] for c in costs])[:CLIMBS]:
        x, now = points[start], costs[start][1]
        for _ in range(CHANGES):
            mask = rng.uniform(size=size) < 0.3
            width = 0.3 * rng.uniform() ** 2
            trial = np.clip(x + mask * width * rng.normal(size=size), 0.0, 1.0)
            count, cycles = cost(trial)
            most = max(most, count)
            if cycles >= now:
                x, now = trial, cycles
        if now > worst:
            worst, worst_input = now, x
    return Cost(random_costs.mean, most, random_costs.mean_cycles, worst, worst_input)


Table = dict[str, dict[str, Cost]]


def measure(emulator: cortex_m.Emulator, inputs: Callable[[Target, Law], Cost]) -> dict[str, Cost]:
    """Cost of every law on one set of inputs."""
    return {name: inputs(Target(emulator, law), law) for name, law in laws().items()}


def stack_bytes(emulator: cortex_m.Emulator) -> dict[str, int]:
    """Deepest byte of the stack that a period of every law has written: nominal run and random states."""
    top = cortex_m.STACK_TOP - cortex_m.ARGUMENTS
    found = {}
    for name, law in laws().items():
        target = Target(emulator, law)
        rng = np.random.default_rng(1)
        emulator.write(top - STACK_MOST, PAINT * STACK_MOST)
        nominal(target, law)
        for x in rng.uniform(size=(STACK_STATES, STATE_SIZE)):
            set_state(target, law, x)
            target.step()
        left = emulator.read(top - STACK_MOST, STACK_MOST)
        found[name] = len(left.lstrip(PAINT))
    return found


def replay(emulator: cortex_m.Emulator, worst: dict[str, Cost]) -> dict[str, int]:
    """Instructions of every law on the worst input that was found on the M4F."""
    out = {}
    for name, law in laws().items():
        target = Target(emulator, law)
        x = worst[name].worst_input
        if x is None:
            continue
        set_state(target, law, x)
        out[name] = target.step()[0]
    return out


def fixed_point(folder: Path, law: Law) -> tuple[Cost, Cost]:
    """One call of the Q4.27 line search on the Cortex-M3, in a closed loop and in a search for the worst input."""
    for name, text in q_files(law.values, prefix="motor").items():
        (folder / name).write_text(text)
    sources = [folder / "pmsm_governor_q.c", folder / "motor_cfg_q.c"]
    emulator, _ = cortex_m.emulator("Cortex-M3", sources, "pmsm_governor_q", folder)
    signals = FixedPointSignals(law.values)
    at = {name: cortex_m.DATA + 0x1000 * k for k, name in enumerate(("v", "state", "input"))}
    motor = emulator.elf.symbols["motor_cfg_q"][0]

    def call() -> tuple[int, int]:
        emulator.write(at["state"], bytes(signals.state))
        emulator.write(at["input"], bytes(signals.input))
        return emulator.call("pmsm_governor_q", at["v"], motor, at["state"], at["input"])

    loop = Loop(core(), law.values, omega=620 * RPM, U_dc=V_DC)
    costs = []
    for k in range(NOMINAL_STEPS):
        state = loop.state
        signals.hold((state.reference_held.d, state.reference_held.q))
        i, x = (float(loop.plant.i[0]), float(loop.plant.i[1])), (state.integrator.d, state.integrator.q)
        live = loop.step(mode=MODE_CURRENT, i_q_ref=(28.0, -28.0, 0.0)[k // 60])
        signals.give((live.i_d_req, live.i_q_req), i, x, loop.plant.omega, V_DC / math.sqrt(3))
        costs.append(call())
    R = law.values["motor.R_s_ohm"]

    def cost(x: np.ndarray) -> tuple[int, int]:
        held, asked, i = 112 * (x[:6].reshape(3, 2) - 0.5)
        signals.hold((held[0], held[1]))
        integrator = R * i + 16 * (x[6:8] - 0.5)
        omega, V_max = 2600 * (x[8] - 0.5) * RPM, V_DC * (0.8 + 0.3 * x[9]) / math.sqrt(3)
        signals.give((asked[0], asked[1]), (i[0], i[1]), (integrator[0], integrator[1]), omega, V_max)
        return call()

    return summary(costs), climb(cost, np.random.default_rng(1), 10)


def step_cycles(emulator: cortex_m.Emulator) -> tuple[float, float]:
    """Cheapest and dearest Newton step: projections cut off after n and some steps more, two rows and more active.

    The cheapest of two running, because a step of a corner counts as two; the dearest of four, so that the end of a
    solver, which the rest of a period has, too, is not taken for steps.
    """
    at = cortex_m.DATA
    least, most = [], []
    for rows, r in instances(STEP_INSTANCES):
        words = [float(x) for M, c, V in rows for x in (*M.ravel(), *c, V)]
        emulator.write(at + 0x8000, struct.pack(f"<{len(words)}f", *words))
        costs: list[int] = []
        for n in range(STEPS_BUDGET + 1):
            emulator.write(at + 0x9000, struct.pack("<I", STEPS_BUDGET - n))
            emulator.set_floats(*r)
            words_at = (at + 0x8000, len(rows), at + 0x9100, at + 0x9200, at + 0x9000)
            costs.append(emulator.call("pmsm_project_rows", *words_at)[1])
            used = int(struct.unpack("<I", emulator.read(at + 0x9000, 4))[0])
            if used < STEPS_BUDGET:
                break
        least += [0.5 * (later - earlier) for earlier, later in zip(costs[:-3], costs[2:-1], strict=True)]
        most += [0.25 * (later - earlier) for earlier, later in zip(costs[:-5], costs[4:-1], strict=False)]
    return min(least), max(cost for cost in most if cost <= STEP_MOST)


def verdicts(table: Table, bounds: dict[str, float]) -> list[tuple[str, float, float]]:
    """What is promised, the measured number, the limit; ``bounds`` by construction (cycles)."""

    def over(name: str) -> float:
        return table[name]["adversarial"].worst - table[laws()[name].without]["nominal"].mean

    delayed = table["best, delay"]
    return [
        ("line search, worst instructions over PI", over("line search"), LINE_LIMIT),
        ("exact 12 rows, worst instructions over PI", over("exact, 12 rows"), EXACT_LIMIT),
        ("best with delay, mean share of 12 kHz", delayed["nominal"].mean_cycles / BUDGET_12_KHZ, BEST_MEAN),
        (
            "best with delay, mean share of 12 kHz, adversarial",
            delayed["adversarial"].mean_cycles / BUDGET_12_KHZ,
            BEST_MEAN,
        ),
        ("best with delay, worst share of 12 kHz", delayed["adversarial"].worst_cycles / BUDGET_12_KHZ, BEST_WORST),
        *(
            (f"{name}, worst share of 12 kHz", table[name]["adversarial"].worst_cycles / BUDGET_12_KHZ, BEST_WORST)
            for name in SATURATED
        ),
        *(
            (f"{name}, share of 12 kHz by construction", bounds[name] / BUDGET_12_KHZ, BOUND)
            for name in ("best + accelerated FW", *SATURATED)
        ),
        *(
            (
                f"{name}, worst share of 10 kHz",
                table[name]["adversarial"].worst_cycles / BUDGET_10_KHZ,
                UNIFIED_WORST,
            )
            for name in ("polar, unified", "polar, unified, torque")
        ),
    ]


def table_lines(table: Table, elsewhere: dict[str, tuple[dict[str, Cost], dict[str, int]]]) -> list[str]:
    """The table in Markdown."""
    names = list(elsewhere)
    lines = [
        "| law, one whole period | nominal mean | nominal worst | adversarial mean | adversarial worst | "
        + " | ".join(f"{name} nominal mean | {name} on that worst input" for name in names)
        + " |",
        "|---|" + "---|" * (4 + 2 * len(names)),
    ]
    for law, row in table.items():
        n, a = row["nominal"], row["adversarial"]
        cells = [
            f"{n.mean:.0f} ({n.mean_cycles:.0f})",
            f"{n.worst} ({n.worst_cycles})",
            f"{a.mean:.0f} ({a.mean_cycles:.0f})",
            f"{a.worst} ({a.worst_cycles})",
        ]
        for loop, worst in elsewhere.values():
            cells += [f"{loop[law].mean:.0f}", f"{worst[law]}"]
        lines.append(f"| {law} | " + " | ".join(cells) + " |")
    return lines


def main() -> int:
    """Measure, print, compare with the limits."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--markdown", type=Path, help="write the table here")
    parser.add_argument("--m4f-only", action="store_true", help="leave Cortex-M3 and M7 out")
    parser.add_argument("--stack", action="store_true", help="print the bytes of stack of every law, nothing else")
    options = parser.parse_args()
    absent = cortex_m.missing()
    if absent:
        print(f"core_cost: skipped, absent: {absent}")
        return SKIPPED
    sources = sorted(HEADER_FOLDER.glob("*.c"))
    with tempfile.TemporaryDirectory() as folder:
        emulator, compiler = cortex_m.emulator("Cortex-M4F", sources, "pmsm_step", Path(folder))
        if options.stack:
            print(*(f"{name}: {size}" for name, size in stack_bytes(emulator).items()), sep="\n")
            return 0
        kinds: tuple[Callable[[Target, Law], Cost], ...] = (nominal, adversarial)
        found = {kind.__name__: measure(emulator, kind) for kind in kinds}
        table = {name: {kind: costs[name] for kind, costs in found.items()} for name in laws()}
        least, most = step_cycles(emulator)
        q_nominal, q_worst = fixed_point(Path(folder), laws()["line search"])
        elsewhere: dict[str, Any] = {}
        for name in () if options.m4f_only else ("Cortex-M3", "Cortex-M7"):
            other, _ = cortex_m.emulator(name, sources, "pmsm_step", Path(folder))
            elsewhere[name] = (measure(other, nominal), replay(other, found["adversarial"]))
    bounded = {name: table[name]["adversarial"] for name in BOUNDED}
    bounds = {name: cost.rest + (STEPS_BUDGET + 1) * most for name, cost in bounded.items()}
    assert least >= STEP_LEAST
    lines = [
        f"Compiled by {compiler}, {' '.join(('-O2', *cortex_m.FLAGS))}.",
        "Cortex-M4F: instructions (model cycles). Others: instructions.",
        "",
        *table_lines(table, elsewhere),
        "",
        "Fixed-point line search (`export c --fixed-point`) on Cortex-M3, one call: nominal "
        f"mean {q_nominal.mean:.0f}, worst {q_nominal.worst}; adversarial mean {q_worst.mean:.0f}, "
        f"worst {q_worst.worst} instructions. The float line search of the table costs there its period less "
        "that of the PI.",
        "",
        f"Bound by construction: at most {STEPS_BUDGET + 1} Newton steps in a period, {least:.0f} to {most:.0f} cycles "
        f"each, {(STEPS_BUDGET + 1) * most:.0f} in all; and the rest of a period, the most in the search:",
        "",
        *(
            f"- {name}: rest {cost.rest:.0f}, together {bounds[name]:.0f} cycles, {bounds[name] / BUDGET_12_KHZ:.3f} "
            f"of 12 kHz at 170 MHz; the worst found is {cost.worst_cycles / BUDGET_12_KHZ:.3f}"
            for name, cost in bounded.items()
        ),
        "",
        f"polar, unified, torque: torque mode, current limit {TORQUE_I_MAX:g} A, which the adversary runs into.",
        "",
    ]
    missed = 0
    for text, value, limit in verdicts(table, bounds):
        good = value <= limit
        missed += not good
        lines.append(f"- {'ok' if good else 'MISS'}: {text}: {value:.4g} (limit {limit:g})")
    print("\n".join(lines))
    if options.markdown:
        head = [
            "# Cost of the control core",
            "",
            "Written by `python benchmarks/core_cost.py --markdown "
            "benchmarks/core_cost.md`; what is counted and how stands in that program.",
            "",
        ]
        options.markdown.write_text("\n".join([*head, *lines]) + "\n")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
