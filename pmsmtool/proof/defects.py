# SPDX-License-Identifier: MIT
"""What may be wrong with a drive: what a failed proof is explained by, and what each changes in simulation."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from pmsmtool.design.design_file import Design
from pmsmtool.design.prediction import LEAST_CHANGE
from pmsmtool.sim.kernel import Params, Setup

Change = Callable[[Setup, Params], None]


@dataclass(frozen=True, slots=True)
class Defect:
    """Something wrong with a drive: what a person reads, what it changes in the simulated one, where that shows."""

    text: str
    change: Change
    moves_only: bool = False


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


def _position_gain(factor: float) -> Change:
    def change(setup: Setup, params: Params) -> None:
        params.position_K_p_per_s *= factor

    return change


def _speed_gain(factor: float) -> Change:
    def change(setup: Setup, params: Params) -> None:
        params.speed_K_p_nms_per_rad *= factor
        params.speed_K_i_nm_per_rad *= factor

    return change


def _forward_reversed(setup: Setup, params: Params) -> None:
    params.position_velocity_ff *= -1.0


def _inertia_reversed(setup: Setup, params: Params) -> None:
    params.position_inertia_ff_kgm2 *= -1.0


def _late_angle(setup: Setup, params: Params) -> None:
    setup.sensors.encoder_latency += params.speed_decimation * 1e-9 * params.inverter_T_s_ns


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
    "position_gain_low": Defect("the gain of the position loop is lower than designed", _position_gain(0.8), True),
    "position_gain_high": Defect("the gain of the position loop is higher than designed", _position_gain(1.25), True),
    "speed_gain_low": Defect("the gain of the speed loop is lower than designed", _speed_gain(0.8), True),
    "speed_gain_high": Defect("the gain of the speed loop is higher than designed", _speed_gain(1.25), True),
    "speed_ff": Defect("the speed of a move is fed forward with the wrong sign", _forward_reversed, True),
    "inertia_ff": Defect("the acceleration of a move is fed forward with the wrong sign", _inertia_reversed, True),
    "late_angle": Defect("the angle is one period of the speed loop older than designed", _late_angle),
    "held": Defect("something holds the shaft", _inertia(HELD)),
}
"""What the likely cause is looked for among."""

AGE_LEAST = 0.3
"""Least half width of the angle's age, in periods of the speed loop: cogging acts on a move where the shaft stands, and
the prediction draws one order of it (0.13 to 0.17 of a healthy machine whose cogging is 4 % of the rated torque)."""


@dataclass(frozen=True, slots=True)
class Derived:
    """A derived quantity.

    Which experiments show it (begin of their names), two sets of runs that differ in it (empty: the healthy drive) with
    their values, its nominal value, its least half width over their difference, and its unit.
    """

    shown_by: tuple[str, ...]
    high: str
    at_high: float
    low: str
    at_low: float
    nominal: float
    least: float = LEAST_CHANGE
    unit: str = "1"


STEPS, MOVES = ("q_", "d_"), ("move",)
QUANTITIES: Mapping[str, Derived] = {
    "loop gain over the designed one": Derived(STEPS, "gain_high", 1.25, "gain_low", 0.8, 1.0),
    "delay beyond the designed one": Derived(STEPS, "delay", 1.0, "", 0.0, 0.0, unit="control periods"),
    "decoupling over the designed one": Derived(STEPS, "", 1.0, "decoupling", -1.0, 1.0),
    "position gain over the designed one": Derived(MOVES, "position_gain_high", 1.25, "position_gain_low", 0.8, 1.0),
    "speed gain over the designed one": Derived(MOVES, "speed_gain_high", 1.25, "speed_gain_low", 0.8, 1.0),
    "age of the angle beyond the designed one": Derived(
        MOVES, "late_angle", 1.0, "", 0.0, 0.0, AGE_LEAST, "periods of the speed loop"
    ),
}


def is_possible(defect: str, design: Design, *, moves: bool) -> bool:
    """Return whether a drive with this design can have the defect, and a plan with or without moves may show it."""
    if DEFECTS[defect].moves_only and not moves:
        return False
    if defect == "pole_pairs_low":
        return design["motor.pole_pairs"] >= 2
    return defect != "compensation" or design["inverter.deadtime_compensation"] != 0.0
