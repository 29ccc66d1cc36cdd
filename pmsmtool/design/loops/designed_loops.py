# SPDX-License-Identifier: MIT
"""The loops of a design: the bandwidth of its current loops, and all loops made again from the gains that stand in it.

The bandwidth is what is asked for, or the modulus optimum lowered until the margins hold. Loops are made again to draw
them, and to judge other gains.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import NoReturn

import numpy as np

from pmsmtool.design.design_file import Design, DesignValue, Scalar
from pmsmtool.design.loops.current_loop import (
    AxisPlant,
    CurrentGains,
    Method,
    axis_loop,
    imc,
    maximum_delay_periods,
    modulus_optimum_bandwidth,
    second_order,
)
from pmsmtool.design.loops.sampled_loop import LoopMargins, SampledLoop, margins
from pmsmtool.design.loops.speed_loop import Notch, SpeedGains, SpeedMethod, SpeedPath, speed_loop
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.errors import DesignInfeasible
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.two_masses import shafts_of

CURRENT_GAINS = (
    "current.K_p_d_v_per_a", "current.K_i_d_v_per_as", "current.K_p_q_v_per_a", "current.K_i_q_v_per_as",
)  # fmt: skip
"""What the current loops are made of, besides machine and delay."""
SPEED_GAINS = ("speed.K_p_nms_per_rad", "speed.K_i_nm_per_rad", "speed.filter_hz")
"""What the speed loop is made of, besides the current loop, machine and delays."""
ONE_PAIR = {CURRENT_GAINS[2]: CURRENT_GAINS[0], CURRENT_GAINS[3]: CURRENT_GAINS[1]}
"""Gains of q that serve both axes on a drive without an object for those of d."""
SMALLER = "the smaller of both axes: the drive has one pair"
CURRENT_LOOPS, SPEED_LOOP = "current", "speed"
_FACTS = {
    CURRENT_LOOPS: ("current_bandwidth_rad_s", "maximum_delay_d_periods", "maximum_delay_q_periods"),
    SPEED_LOOP: ("speed_crossover_rad_s",),
}


def open_loops(design: Design) -> dict[str, SampledLoop]:
    """Return the open loops that a design is judged by, from the gains that stand in it."""
    predicts = bool(design.request.get("predictor", False))
    loops = {}
    for axis in "dq":
        plant = _plant(design, axis)
        loops[f"current_{axis}"] = axis_loop(_gains(design, axis), plant, plant if predicts else None)
    speed = designed_speed_loop(design, loops["current_q"])
    if speed is not None:
        loops[SPEED_LOOP] = speed
    return {name: loop for name, loop in loops.items() if name in design.loops}


def designed_speed_loop(design: Design, current: SampledLoop) -> SampledLoop | None:
    """Return the speed loop of a design's gains above a current loop of the q axis; None where it has none."""
    machine, K_p = design.machine.machine, design["speed.K_p_nms_per_rad"]
    if machine.J_kgm2 is None or K_p == 0.0:
        return None
    path = SpeedPath(
        machine.J_kgm2, machine.B_nms or 0.0, current, int(design["speed.decimation"]),
        design["encoder.pll_bandwidth_rad_s"], design["speed.filter_hz"],
        Notch(design["speed.notch_hz"], design["speed.notch_zeta_num"], design["speed.notch_zeta_den"]),
        next(iter(shafts_of(design.machine)), None),
    )  # fmt: skip
    return speed_loop(SpeedGains(K_p, design["speed.K_i_nm_per_rad"], 0.0, SpeedMethod.SYMMETRIC_OPTIMUM), path)


def lacking_gains(offers: Collection[str]) -> dict[str, tuple[str, ...]]:
    """Return by loop the gains that a drive has no object for.

    ``offers``: catalogue names it has an object for; those of q serve both axes where d has none.
    """
    served = {*offers, *(d for q, d in ONE_PAIR.items() if q in offers)}
    needs = {CURRENT_LOOPS: CURRENT_GAINS, SPEED_LOOP: SPEED_GAINS}
    return {loop: tuple(name for name in names if name not in served) for loop, names in needs.items()}


def smaller_gains(values: Mapping[str, float], offers: Collection[str]) -> dict[str, float]:
    """Return the gains of a drive that has one pair for both axes: the smaller of each, so that both keep margins.

    Parameters
    ----------
    values : mapping of str to float
        Gains by catalogue name; where only one axis has one there is nothing to choose.
    offers : collection of str
        Catalogue names the drive has an object for.
    """
    return {
        name: min(values[q], values[d])
        for q, d in ONE_PAIR.items()
        if q in offers and d not in offers and {q, d} <= set(values)
        for name in (q, d)
    }


def one_pair(design: Design, offers: Collection[str]) -> dict[str, DesignValue]:
    """Return what :func:`smaller_gains` makes of a design's gains."""
    gains = {name: design[name] for name in CURRENT_GAINS}
    return {name: DesignValue(value, SMALLER) for name, value in smaller_gains(gains, offers).items()}


def with_gains(design: Design, gains: Mapping[str, DesignValue], judged: Collection[str]) -> Design:
    """Return a design with other gains, judged by the loops they make.

    Parameters
    ----------
    design : Design
        With the gains as designed, without a predictor.
    gains : mapping of str to DesignValue
        What the drive will hold instead.
    judged : collection of str
        ``current``, ``speed``: loops whose gains are known. Of the others nothing is said; their facts go too.
    """
    kept = {name: loop for name, loop in design.loops.items() if name.startswith(tuple(judged))}
    changed = replace(design, values={**design.values, **gains}, loops=kept)
    if gains:
        found = {name: margins(loop) for name, loop in open_loops(changed).items()}
        kept = {**found, **_saturated(changed)}
        changed = replace(changed, loops=kept)
    values = {name: value if value.loop in kept else replace(value, loop="") for name, value in changed.values.items()}
    facts = {name: fact for name, fact in design.facts.items() if name not in _facts_without(judged)}
    if gains and CURRENT_LOOPS in judged:
        alpha = min(changed[f"current.K_p_{axis}_v_per_a"] / _plant(design, axis).L for axis in "dq")
        values["governor.alpha_rad_s"] = DesignValue(alpha, "bandwidth of the current loops")
        facts["current_bandwidth_rad_s"] = alpha
        for axis in "dq":
            facts[f"maximum_delay_{axis}_periods"] = maximum_delay_periods(_gains(changed, axis), _plant(design, axis))
    if SPEED_LOOP in kept:
        facts["speed_crossover_rad_s"] = kept[SPEED_LOOP].crossover_rad_s
    ordered: dict[str, Scalar] = {name: facts[name] for name in design.facts if name in facts}
    return replace(changed, values=values, facts={**ordered, **facts})


def _facts_without(judged: Collection[str]) -> set[str]:
    return {fact for loop, facts in _FACTS.items() if loop not in judged for fact in facts}


def _plant(design: Design, axis: str) -> AxisPlant:
    machine, inverter = design.machine.machine, design.machine.inverter
    L = machine.L_d_h if axis == "d" else machine.L_q_h
    return AxisPlant(machine.R_s_ohm, L, inverter.T_s, inverter.delay_periods)


def _gains(design: Design, axis: str) -> CurrentGains:
    return CurrentGains(design[f"current.K_p_{axis}_v_per_a"], design[f"current.K_i_{axis}_v_per_as"])


def _saturated(design: Design) -> dict[str, LoopMargins]:
    """Return the margins at each axis' least inductance, of a machine with a flux map."""
    names = [axis for axis in "dq" if f"current_{axis}_saturated" in design.loops]
    least = least_inductance(design.machine, design["motor.I_max_apk"]) if names else {}
    return {
        f"current_{axis}_saturated": margins(
            axis_loop(_gains(design, axis), replace(_plant(design, axis), L=least[axis]))
        )
        for axis in names
    }


BANDWIDTH_RESOLUTION = 1e-4
"""Relative resolution of a bandwidth that is lowered until the margins are met."""

BANDWIDTH_SPAN = 1e-3
"""A bandwidth is lowered to this share of the first choice at most."""

_DISC_RADII, _DISC_ANGLES = 12, 48


@dataclass(frozen=True, slots=True)
class CurrentChoice:
    """Current loops at one bandwidth."""

    request: TuneRequest
    """What was asked."""
    plants: Mapping[str, AxisPlant]
    """Axes ``d`` and ``q`` as the gains are designed for."""
    least: Mapping[str, float]
    """Least inductance of each axis inside the current limit (H); empty for a constant machine."""
    alpha: float
    """Bandwidth (rad/s)."""
    why: str = ""
    """How it was chosen, as the end of a sentence."""

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
