# SPDX-License-Identifier: MIT
"""The bandwidth of the current loops: as asked for, or the modulus optimum lowered until the margins hold."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NoReturn

import numpy as np

from pmsmtool.design.loops.current_loop import (
    AxisPlant,
    CurrentGains,
    Method,
    axis_loop,
    imc,
    modulus_optimum_bandwidth,
    second_order,
)
from pmsmtool.design.loops.sampled_loop import LoopMargins, SampledLoop, margins
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.errors import DesignInfeasible
from pmsmtool.machine.machine_file import MachineFile

BANDWIDTH_RESOLUTION = 1e-4
"""Relative resolution of a bandwidth that is lowered until the margins are met."""

BANDWIDTH_SPAN = 1e-3
"""A bandwidth is lowered to this share of the first choice at most."""

_DISC_RADII, _DISC_ANGLES = 12, 48


@dataclass(frozen=True, slots=True)
class CurrentChoice:
    """Current loops at one bandwidth.

    Attributes
    ----------
    request : TuneRequest
        What was asked.
    plants : mapping of str to AxisPlant
        Axes ``d`` and ``q`` as the gains are designed for.
    least : mapping of str to float
        Least inductance of each axis inside the current limit (H); empty for a constant machine.
    alpha : float
        Bandwidth (rad/s).
    why : str
        How it was chosen, as the end of a sentence.
    """

    request: TuneRequest
    plants: Mapping[str, AxisPlant]
    least: Mapping[str, float]
    alpha: float
    why: str = ""

    def gains(self, axis: str) -> CurrentGains:
        """Return the gains of an axis."""
        plant = self.plants[axis]
        if self.request.method == Method.SECOND_ORDER:
            return second_order(plant.R, plant.L, self.alpha, self.request.damping)
        return imc(plant.R, plant.L, self.alpha)

    def loop(self, axis: str, plant: AxisPlant | None = None) -> SampledLoop:
        """Return the loop of an axis, on its design plant or another."""
        model = self.plants[axis] if self.request.predictor else None
        return axis_loop(self.gains(axis), self.plants[axis] if plant is None else plant, model)

    def loops(self) -> dict[str, LoopMargins]:
        """Return the margins of both axes, and with a flux map those at each axis' least inductance."""
        found = {}
        for axis in "dq":
            found[f"current_{axis}"] = margins(self.loop(axis))
            if self.least:
                saturated = replace(self.plants[axis], L=self.least[axis])
                found[f"current_{axis}_saturated"] = margins(self.loop(axis, saturated))
        return found

    def meets_request(self) -> bool:
        """Whether every loop has the margins asked for."""
        phase_deg, gain_db = self.request.phase_margin_deg, self.request.gain_margin_db
        try:
            loops = self.loops().values()
        except DesignInfeasible:
            return False
        return all(m.stable and m.phase_margin_deg >= phase_deg and m.gain_margin_db >= gain_db for m in loops)


def choose_current(source: MachineFile, request: TuneRequest, I_max_apk: float) -> CurrentChoice:
    """Choose the bandwidth.

    Raises DesignInfeasible: the bandwidth asked for does not reach the margins asked for; the hint names one that does.
    """
    machine, inverter = source.machine, source.inverter
    if request.predictor and inverter.delay_periods < 1.0:
        raise DesignInfeasible(
            f"a delay of {inverter.delay_periods:g} periods leaves the predictor nothing to predict",
            where="inverter.delay_periods",
            hint="leave the predictor off",
        )
    plants = {
        axis: AxisPlant(machine.R_s_ohm, L, inverter.T_s, inverter.delay_periods)
        for axis, L in (("d", machine.L_d_h), ("q", machine.L_q_h))
    }
    least = least_inductance(source, I_max_apk)
    if request.bandwidth_hz is not None and request.method != Method.MODULUS_OPTIMUM:
        choice = CurrentChoice(request, plants, least, 2.0 * math.pi * request.bandwidth_hz)
        if not choice.meets_request():
            _refuse(choice, _lowered(choice))
        return choice
    alpha = modulus_optimum_bandwidth(inverter.T_s, inverter.delay_periods)
    choice = CurrentChoice(request, plants, least, alpha, " (modulus optimum)")
    if choice.meets_request():
        return choice
    lowered = _lowered(choice)
    if lowered is None:
        _refuse(choice, None)
    return replace(lowered, why=" (modulus optimum lowered to the margins asked for)")


def _lowered(choice: CurrentChoice) -> CurrentChoice | None:
    """Return the largest bandwidth below that meets the margins; None when none does."""
    low, high = BANDWIDTH_SPAN * choice.alpha, choice.alpha
    if not replace(choice, alpha=low).meets_request():
        return None
    while high - low > BANDWIDTH_RESOLUTION * high:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if replace(choice, alpha=middle).meets_request() else (low, middle)
    return replace(choice, alpha=low)


def _refuse(choice: CurrentChoice, reachable: CurrentChoice | None) -> NoReturn:
    request, loops = choice.request, choice.loops()
    worst = min(loops, key=lambda name: loops[name].phase_margin_deg if loops[name].stable else -math.inf)
    loop = loops[worst]
    state = f"{loop.phase_margin_deg:.1f} degree, {loop.gain_margin_db:.1f} dB" if loop.stable else "unstable"
    hint = "ask for smaller margins"
    if reachable is not None:
        hint = f"ask for at most {reachable.alpha / (2.0 * math.pi):.4g} Hz"
    raise DesignInfeasible(
        f"loop {worst}: {state}; asked for: {request.phase_margin_deg:g} degree, {request.gain_margin_db:g} dB",
        where="current loop",
        likely="the bandwidth is too high for the delay" if reachable else "no bandwidth meets these margins",
        hint=hint,
    )


def least_inductance(source: MachineFile, I_max_apk: float) -> dict[str, float]:
    """Return the least incremental inductance of each axis (H) over the current disc; empty without a flux map."""
    flux_map = source.flux_map
    if flux_map is None:
        return {}
    radius = np.linspace(0.0, 1.0, _DISC_RADII)[:, None] * I_max_apk
    angle = np.linspace(-math.pi, math.pi, _DISC_ANGLES, endpoint=False)
    i_d = np.clip(radius * np.cos(angle), flux_map.i_d_a[0], flux_map.i_d_a[-1])
    i_q = np.clip(radius * np.sin(angle), flux_map.i_q_a[0], flux_map.i_q_a[-1])
    inductance = flux_map.incremental_inductance(i_d, i_q)
    return {"d": float(inductance[0, 0].min()), "q": float(inductance[1, 1].min())}
