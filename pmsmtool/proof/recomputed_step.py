# SPDX-License-Identifier: MIT
"""The step that the page of a report computes again: the design's drive, its machine, and machines of its box.

The page runs the same C code as the kernel ``pmsm_sim``, as WebAssembly. What it needs is bytes: the parameter image,
and one setup per machine. Both have the same layout in WebAssembly and here: the one pointer of a setup (to a flux
map) is followed by doubles, which are aligned to 8 bytes there, too.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from pmsmtool.design.design_file import Design
from pmsmtool.design.tolerance import tolerance_box
from pmsmtool.errors import NotAvailable
from pmsmtool.proof.simulated_margins import variations
from pmsmtool.sim.closed_loop import drive_values, image_of, open_simulation
from pmsmtool.sim.kernel import STRUCTS, Params, Part, Setup, Signal, Truth
from pmsmtool.sim.monte_carlo import vary
from pmsmtool.sim.scenarios import MODES, SCHEDULES, Scenario, built_in

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
    """Everything that decides the bytes of the step.

    Attributes
    ----------
    image : bytes
        Parameter image of the drive.
    setups : sequence of bytes
        The machine as designed, then the drawn ones.
    schedules : sequence of (target, times in s, values)
        What is asked.
    mode : int
        Of the drive.
    periods : int
        Control periods that are run.
    T_s : float
        Control period (s).
    step_s : float
        When the step is asked (s).
    U_dc_v : float
        DC link (V).
    scenario : Scenario
        Where the above come from.
    """

    image: bytes
    setups: Sequence[bytes]
    schedules: Sequence[tuple[int, Sequence[float], Sequence[float]]]
    mode: int
    periods: int
    T_s: float
    step_s: float
    U_dc_v: float
    scenario: Scenario


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
