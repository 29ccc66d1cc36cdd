# SPDX-License-Identifier: MIT
"""Square-wave voltage on a current bias in a frozen frame: the drive generates and records it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from pmsmtool.drive.port import Drive, Excitation, Injection, Shape
from pmsmtool.experiments.signals import readable
from pmsmtool.experiments.standstill import settle
from pmsmtool.trace import Trace

Axis = Literal["d", "q"]

SHOT_SAMPLES = 2048
SEARCH_SAMPLES = 240
SEARCH_LEAD_S, SEARCH_LEAD_SHARE = 0.05, 0.5
"""Lead of a shot of the search, and at most so much of the plan's: the ripple is there at once, the bias moves."""
BUS_ALLOWANCE_S = 2.0
"""The injection goes on this much longer than lead and record need: slow adapters arm the recorder late."""
BIAS_BANDWIDTH_RAD_S = 2.0 * math.pi * 15.0
"""Bandwidth of the loop that holds the bias (rad/s): far below every injection."""
FIRST_SHARE = 0.01
"""First amplitude of the search, of the largest voltage: 1 % moves no machine of this population over its limit."""
NEXT_SHARE = 0.3
"""First amplitude of the second axis, of what the first axis took."""
GROWTH = 10.0
"""Largest step of the search: on a bias the ripple grows with the amplitude from the first volt."""
SEARCH_STEPS = 12
SLOW_S, FAST_S = 600e-6, 450e-6
"""Half period that shows eddy currents of 20 to 200 us, where those of a fast control last less than the second: with
an iron loss of 5.6 % and eddy currents of 6.8 %, 100 us, L was 4 % too small at 39 kHz, 2.2 times its interval."""
SLOW_OF_WINDING = 1.0
"""Longest such half period, of the winding's L/R: beyond it the current is the resistance's."""
ENOUGH = 0.2
"""A ripple of this share of the wanted one ends the search; the next shot is scaled from it."""


@dataclass(frozen=True, slots=True)
class SquarePlan:
    """A square wave on a bias."""

    bias_d_a: float
    """Current along the frame's d axis (A peak)."""
    ripple_a: float
    """Wanted ripple, peak to peak (A)."""
    u_max_v: float
    """Largest amplitude (V)."""
    half_periods: tuple[int, ...] = (6, 9)
    """Half periods (control periods), one record each, of about the same ripple from the second on."""
    samples: int = SHOT_SAMPLES
    """Length of a record."""
    bias_bandwidth_rad_s: float = BIAS_BANDWIDTH_RAD_S
    """Bandwidth of the loop that holds the bias; far below the injection."""
    lead_s: float = 0.1
    """How long the injection runs before the record: its first half wave pushes the rotor and the bias (s)."""
    angle_rad: float = 0.0
    """Electrical angle of the frozen frame."""


def hold_bias(drive: Drive, plan: SquarePlan) -> None:
    """Bring the current to the bias with the drive's own current loop, and wait for it."""
    drive.command_current(plan.bias_d_a, 0.0, fixed_angle_rad=plan.angle_rad)
    settle(drive, plan.bias_d_a)


def find_amplitude(drive: Drive, plan: SquarePlan, axis: Axis, first_v: float | None = None) -> float:
    """Return the amplitude (V) that makes the wanted ripple at the first half period, by rising small shots.

    ``first_v`` is the amplitude of the first one; None: small enough for any machine.
    """
    lead_s = min(SEARCH_LEAD_S, SEARCH_LEAD_SHARE * plan.lead_s)
    quick = replace(plan, lead_s=lead_s, samples=SEARCH_SAMPLES)
    amplitude = min(FIRST_SHARE * plan.u_max_v if first_v is None else first_v, plan.u_max_v)
    for _ in range(SEARCH_STEPS):
        trace = inject_square(drive, quick, axis, plan.half_periods[0], amplitude, (f"i_{axis}_a",))
        ripple = ripple_of(trace, axis)
        wanted = min(plan.u_max_v, amplitude * plan.ripple_a / max(ripple, 1e-9))
        if ripple >= ENOUGH * plan.ripple_a or amplitude >= plan.u_max_v:
            return wanted
        amplitude = min(plan.u_max_v, GROWTH * amplitude, max(wanted, amplitude))
    return amplitude


def slow_half_period(plan: SquarePlan, period_s: float, winding_s: float) -> int:
    """Return a further half period that shows slow eddy currents (control periods); 0 where the plan's show them.

    ``winding_s`` is the winding's L/R (s).
    """
    last = plan.half_periods[-1]
    slow = round(min(SLOW_S, SLOW_OF_WINDING * winding_s) / period_s)
    return slow if last * period_s < FAST_S and slow > last else 0


def ripple_of(trace: Trace, axis: Axis) -> float:
    """Return the ripple of one axis current, peak to peak (A): of the triangle with the record's fundamental."""
    current = trace[f"i_{axis}_a"]
    period = 2 * int(trace.meta["half_period"])
    whole = current[len(current) - (2 * len(current) // 3) // period * period :]
    turns = np.exp(-2j * math.pi * np.arange(len(whole)) / period)
    return 0.25 * math.pi**2 * 2.0 * float(np.abs(np.mean((whole - np.mean(whole)) * turns)))


def inject_square(
    drive: Drive,
    plan: SquarePlan,
    axis: Axis,
    half_period: int,
    amplitude_v: float,
    signals: Sequence[str] | None = None,
) -> Trace:
    """Record one shot, by default of all that an estimate needs; the bias stays on before and after it.

    Raises DriveFault: the drive aborted the excitation at one of its limits.
    """
    # the lead and the bus time between starting the injection and arming the recorder
    running_s = plan.lead_s + BUS_ALLOWANCE_S + plan.samples * drive.period_s
    excitation = Excitation(
        shape=Shape.SQUARE,
        point=Injection.U_D if axis == "d" else Injection.U_Q,
        amplitude=amplitude_v,
        bias_d_a=plan.bias_d_a,
        bias_bandwidth_rad_s=plan.bias_bandwidth_rad_s,
        hold_periods=half_period,
        duration_s=running_s,
        fixed_angle_rad=plan.angle_rad,
        lead_s=plan.lead_s,
    )
    facts: dict[str, Any] = {"half_period": half_period, "fixed_angle_rad": plan.angle_rad}
    facts |= {"axis": axis, "amplitude_v": amplitude_v}
    if signals is None:
        signals = ("i_d_a", "i_q_a", f"u_{axis}_v", "theta_m_rad", "flags")
        facts["T_winding_c"] = drive.live("T_winding_c")
    return readable(drive.record(signals, plan.samples, excitation=excitation), **facts)
