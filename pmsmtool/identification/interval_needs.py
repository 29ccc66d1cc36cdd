# SPDX-License-Identifier: MIT
"""What an interval costs the design: the worst margin and headroom while one value moves over its total interval.

A value is good enough when the default design keeps what is asked of it wherever the value lies in its interval: the
phase and gain margins of its loops (``margins.MarginRequest``), and up to base speed the voltage limit and the torque
within the current limit. Above base speed field weakening acts on the measured voltage. So no value has a percentage
of its own.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from pmsmtool.design.loops.margins import MarginProblem, MarginRequest, evaluate, margin_problem
from pmsmtool.design.ratings import base_speed_rpm, ratings_of
from pmsmtool.design.tolerance import PARAMETERS, Samples, headroom
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.errors import ConfigError, DesignInfeasible
from pmsmtool.machine.machine_file import MachineFile

OFFSET = "offset_rad"
JUDGED = (*PARAMETERS, OFFSET)
"""Machine keys whose interval moves a loop or a limit."""
TORQUE_SHORTFALL = 0.10
"""Rated torque that may be missing at the current limit (IEC 60034-1, tolerances: pull-out torque of synchronous
machines -10 %)."""
STEPS = 5
"""Values over an interval that are evaluated, its ends among them."""
_BARE = TuneRequest(governor="off", field_weakening="off", overspeed_protection="chopper")
"""Loops and limits alone; what protects the DC link is tune's question."""
_COLUMNS = (*PARAMETERS, "encoder_rad", "T_winding_c", "T_magnet_c", "U_dc_v", "operating_point")


@dataclass(frozen=True, slots=True)
class Need:
    """One criterion of the design over the interval of one value."""

    what: str
    unit: str
    """``current_q phase margin`` (deg), ``voltage headroom to base speed`` (%), ..."""
    nominal: float
    worst: float
    least: float
    """Of the machine as written, the least over the interval, and the limit."""

    @property
    def ok(self) -> bool:
        """Whether the limit holds all over the interval."""
        return self.worst >= self.least

    @property
    def reserve(self) -> float:
        """Share of the nominal distance to the limit that is left; the smallest names what binds."""
        return (self.worst - self.least) / max(self.nominal - self.least, 1e-9)


def interval_needs(
    source: MachineFile | None, half_widths: Mapping[str, float], request: MarginRequest | None = None
) -> dict[str, tuple[Need, ...]]:
    """Return the criteria of every value's interval, the others at their nominal value.

    Parameters
    ----------
    source : MachineFile or None
        The machine; its own default design is what is judged. None: no machine is known.
    half_widths : mapping of str to float
        Half of the total 95 % interval (SI) of keys of ``JUDGED``; others are left out.
    request : MarginRequest, optional
        Margins that must hold.

    Returns
    -------
    dict of str to tuple of Need
        Where no design can be made, tune says why, and only an angle is judged: by the torque that it takes.
    """
    request = MarginRequest() if request is None else request
    without_design: dict[str, tuple[Need, ...]] = (
        {OFFSET: (_torque_of_angle(half_widths[OFFSET]),)} if OFFSET in half_widths else {}
    )
    if source is None:
        return without_design
    try:
        design = tune(source, _BARE)
        problem = margin_problem(design)
        rated = ratings_of(design)
        base_rpm = base_speed_rpm(source, rated.I_nom_apk, rated.i_d_min_a, source.inverter.V_max_v)
    except (ConfigError, DesignInfeasible):
        return without_design
    loops = (*(f"current_{axis}" for axis in "dq"), *(("speed",) if problem.speed is not None else ()))
    found: dict[str, tuple[Need, ...]] = {}
    for name, half in half_widths.items():
        if name in JUDGED and (name == OFFSET or getattr(source.machine, name)):
            found[name] = tuple(_needs(source, problem, loops, base_rpm, request, name, half))
    return found


def _torque_of_angle(half: float) -> Need:
    """Return the torque per current over the interval of the encoder's angle: its cosine."""
    worst = 100.0 * math.cos(min(half, math.pi))
    return Need("torque per current", "%", 100.0, worst, 100.0 * (1.0 - TORQUE_SHORTFALL))


def _needs(
    source: MachineFile,
    problem: MarginProblem,
    loops: tuple[str, ...],
    base_rpm: float,
    request: MarginRequest,
    name: str,
    half: float,
) -> Iterator[Need]:
    relative = 0.0 if name == OFFSET else half / abs(getattr(source.machine, name))
    if relative >= 1.0:  # not even the sign of the value is known
        yield Need("value over half of its interval", "1", math.inf, 1.0 / relative, 1.0)
        return
    nominal, moved = (_samples(source, name, width) for width in (0.0, half if name == OFFSET else relative))
    at, over = evaluate(problem, nominal).values, evaluate(problem, moved).values
    turned = math.degrees(half) if name == OFFSET else 0.0  # a frame that is turned takes as much of the phase margin
    for loop in loops:
        for part, unit in (("phase", "deg"), ("gain", "dB")):
            key, least = f"{loop}_{part}", request.least(f"{loop}_{part}")
            nominally, lost = float(np.min(at[key])), turned if part == "phase" and loop != "speed" else 0.0
            if least is not None and nominally >= least:  # else tune and margins say so, whatever the interval
                yield Need(f"{loop} {part} margin", unit, nominally, float(np.min(over[key])) - lost, least)
    cells = problem.cells
    here, there = (headroom(problem.machine, cells, problem.limits, rows) for rows in (nominal, moved))
    below = cells.speed_rpm <= base_rpm
    voltage = 100.0 * float(np.min(here.voltage[:, below], initial=1.0))
    if voltage >= 0.0:
        worst = 100.0 * float(np.min(there.voltage[:, below], initial=1.0))
        yield Need("voltage headroom to base speed", "%", voltage, worst, 0.0)
    # headroom is 1 - I/I_max, with the current I that the torque of a cell takes
    driving = below & (cells.torque_nm != 0.0)
    before, after = 1.0 - here.current[:1, driving], 1.0 - there.current[:, driving]
    reached = np.where(after <= 1.0, 1.0, before / np.maximum(after, 1e-9))
    torque = 100.0 * float(np.min(reached, initial=1.0))
    yield Need("torque within the current limit", "%", 100.0, torque, 100.0 * (1.0 - TORQUE_SHORTFALL))


def _samples(source: MachineFile, name: str, half: float) -> Samples:
    """Return rows over +-half of one column, at either end of the inductances; one of each where half is 0."""
    T_ref = source.machine.T_ref_c
    nominal = [*(1.0 for _ in PARAMETERS), 0.0, T_ref, T_ref, source.inverter.U_dc_v, 0.0]
    steps = np.linspace(-half, half, STEPS) if half > 0.0 else np.zeros(1)
    rows = np.array([nominal] * (2 * len(steps)))
    rows[:, _COLUMNS.index("encoder_rad" if name == OFFSET else name)] += np.repeat(steps, 2)
    rows[1::2, -1] = 1.0
    return Samples(_COLUMNS, rows)
