# SPDX-License-Identifier: MIT
"""What may be wrong with a drive: what a failed proof is explained by, and what each changes in simulation."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from pmsmtool.design.design_file import Design
from pmsmtool.sim.kernel import Params, Setup

Change = Callable[[Setup, Params], None]


@dataclass(frozen=True, slots=True)
class Defect:
    """Something wrong with a drive: what a person reads, and what it changes in the simulated one."""

    text: str
    change: Change


def _gain(factor: float) -> Change:
    def change(setup: Setup, params: Params) -> None:
        params.current_K_p_d_v_per_a *= factor
        params.current_K_p_q_v_per_a *= factor

    return change


def _delayed(setup: Setup, params: Params) -> None:
    setup.delay += 1


def _decoupling_reversed(setup: Setup, params: Params) -> None:
    params.motor_L_d_app_h *= -1.0
    params.motor_L_q_app_h *= -1.0


def _pole_pairs(step: int) -> Change:
    def change(setup: Setup, params: Params) -> None:
        params.motor_pole_pairs = max(1, params.motor_pole_pairs + step)

    return change


def _link(factor: float) -> Change:
    def change(setup: Setup, params: Params) -> None:
        setup.U_dc *= factor

    return change


def _inertia(factor: float) -> Change:
    def change(setup: Setup, params: Params) -> None:
        setup.machine.J *= factor

    return change


WRONG_POLE_PAIRS = "wrong pole pairs"
"""Too many or too few: the shaft falls out of step either way, and where it is then tells nothing of the sign."""
HELD = 1e3
"""Inertia, over the machine's, of a shaft that does not move within an experiment."""


def _saturated(setup: Setup, params: Params) -> None:
    setup.machine.L_d *= 0.7
    setup.machine.L_q *= 0.7


def _compensation(setup: Setup, params: Params) -> None:
    params.inverter_V_dead_v *= 2.0


DEFECTS: Mapping[str, Defect] = {
    "gain_low": Defect("the gain of the current loops is lower than designed", _gain(0.8)),
    "gain_high": Defect("the gain of the current loops is higher than designed", _gain(1.25)),
    "delay": Defect("one more control period of delay than designed", _delayed),
    "decoupling": Defect("the decoupling has the wrong sign", _decoupling_reversed),
    "pole_pairs_high": Defect(WRONG_POLE_PAIRS, _pole_pairs(1)),
    "pole_pairs_low": Defect(WRONG_POLE_PAIRS, _pole_pairs(-1)),
    "voltage": Defect("the voltage is too low: the DC link falls below what it shows at rest", _link(0.85)),
    "inductance": Defect("less inductance than designed for, as when the machine saturates", _saturated),
    "compensation": Defect("the dead-time compensation does not fit the inverter", _compensation),
    "inertia_high": Defect("more inertia than designed for", _inertia(1.4)),
    "inertia_low": Defect("less inertia than designed for", _inertia(0.7)),
    "held": Defect("something holds the shaft", _inertia(HELD)),
}
"""What the likely cause is looked for among."""

QUANTITIES = {
    "loop gain over the designed one": ("gain_high", 1.25, "gain_low", 0.8, 1.0, "1"),
    "delay beyond the designed one": ("delay", 1.0, "", 0.0, 0.0, "1"),
    "decoupling over the designed one": ("", 1.0, "decoupling", -1.0, 1.0, "1"),
}
"""Derived quantity: the two sets of runs and their values (empty: the healthy drive), nominal value, unit."""


def is_possible(defect: str, design: Design) -> bool:
    """Return whether a drive with this design can have the defect."""
    if defect == "pole_pairs_low":
        return design["motor.pole_pairs"] >= 2
    return defect != "compensation" or design["inverter.deadtime_compensation"] != 0.0
