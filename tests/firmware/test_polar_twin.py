# SPDX-License-Identifier: MIT
"""The polar laws against their numpy twin, bit for bit over closed loops."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pmsmtool.firmware.core_binding import core
from tests.firmware.closed_loop import DEFAULTS, FLAG_CURRENT, FLAG_DUTY, MODE_CURRENT, MODE_TORQUE, Loop
from tests.firmware.core_twin import f
from tests.firmware.polar_twin import (
    CONVENTIONAL,
    LINEAR,
    NO_ANTI_WINDUP,
    ON_MEASUREMENT,
    PREDICT,
    PRINTED,
    PROPOSED,
    REGULARISED,
    SWITCH,
    UNIFIED,
    PolarTwin,
)

U_DC, POLE_PAIRS, PERIODS = 36.0, 8, 240
RPM = POLE_PAIRS * math.pi / 30


def values(mode: int, options: int = 0, **changes: float) -> dict[str, float]:
    """Peak quantities of the assumed machine of the paper."""
    machine = {
        "motor.pole_pairs": POLE_PAIRS,
        "motor.R_s_ohm": 0.157,
        "motor.psi_f_wb": 0.026944,
        "motor.I_max_apk": 40.0,
        "protection.I_cont_apk": 40.0,
        "field_weakening.i_d_min_a": -30.0,
        "inverter.T_s_ns": 100_000,
        "inverter.delay_periods": 0.5,
        "polar.mode": mode,
        "polar.options": options,
        "inverter.voltage_utilisation": 1 / math.sqrt(3),
    }
    machine |= {f"motor.L_{axis}_h": 0.0009 for axis in ("d", "q", "d_app", "q_app")}
    return DEFAULTS | machine | {name.replace("__", "."): value for name, value in changes.items()}


SALIENT = {"motor__L_d_h": 0.0006, "motor__L_d_app_h": 0.0006, "motor__L_q_h": 0.0014, "motor__L_q_app_h": 0.0014}
CASES = {
    "conventional": (values(CONVENTIONAL), 800.0, 14.0),
    "conventional, backwards, on measurement": (values(CONVENTIONAL, ON_MEASUREMENT), -900.0, 14.0),
    "proposed": (values(PROPOSED), 800.0, 14.0),
    "proposed without anti-windup": (values(PROPOSED, NO_ANTI_WINDUP | ON_MEASUREMENT), -800.0, 14.0),
    "proposed, torque out of reach": (values(PROPOSED, ON_MEASUREMENT), 1000.0, 39.0),
    "proposed, switched": (values(PROPOSED, SWITCH), 800.0, 14.0),
    "conventional, switched, delay": (
        values(CONVENTIONAL, SWITCH | PREDICT | ON_MEASUREMENT, inverter__delay_periods=1.5),
        -880.0,
        20.0,
    ),
    "proposed near standstill": (values(PROPOSED, ON_MEASUREMENT), 60.0, 3.0),
    "linear": (values(LINEAR), 300.0, 6.0),
    "linear at standstill": (values(LINEAR), 0.0, 6.0),
    "printed": (values(PRINTED), 300.0, 3.0),
    "regularised": (values(REGULARISED, polar__b=0.5), -400.0, 6.0),
    "regularised, interior, delay": (values(REGULARISED, PREDICT, inverter__delay_periods=1.5, **SALIENT), 500.0, 8.0),
    "unified": (values(UNIFIED, polar__V_ref_ratio=0.97), 900.0, 14.0),
    "unified, delay": (values(UNIFIED, PREDICT, inverter__delay_periods=1.0), -1000.0, 12.0),
    "unified, interior, limits": (values(UNIFIED, polar__V_ref_ratio=0.97, **SALIENT), 1300.0, 38.0),
    "unified, interior, torque": (
        values(UNIFIED, polar__V_ref_ratio=0.97, field_weakening__i_d_lm_a=-2.0, **SALIENT),
        1000.0,
        7.0,
    ),
    "unified in overmodulation": (values(UNIFIED, polar__V_a_max_ratio=1.1, polar__V_ref_ratio=1.05), 900.0, 18.0),
    "unified at standstill": (values(UNIFIED), 0.0, 10.0),
}


FLAGS = {"unified, interior, limits": FLAG_CURRENT, "unified in overmodulation": FLAG_DUTY}
"""What a case is there for."""


@pytest.mark.parametrize("case", CASES)
def test_polar_law_equals_the_twin_bit_for_bit(case: str) -> None:
    settings, rpm, size = CASES[case]
    loop, twin = Loop(core(), settings, omega=rpm * RPM, U_dc=U_DC), PolarTwin(settings)
    loop.plant.psi *= 0.95  # a machine that is not the controller's
    rng = np.random.default_rng(3)
    target, moved, flags, switched = 0.0, 0.0, 0, set()
    in_torque = case.endswith("torque")
    for k in range(PERIODS):
        if k % 40 == 0:
            target = float(rng.uniform(-size, size)) if k else size
        asked = {"mode": MODE_TORQUE, "tau_ref": target} if in_torque else {"mode": MODE_CURRENT, "i_q_ref": target}
        live = loop.step(**asked)
        m, out = loop.measurement, loop.output
        duties, u, realised = twin.period(
            (f(m.i_a), f(m.i_b), f(m.i_c)),
            f(m.theta_e),
            f(m.omega_e),
            f(m.U_dc),
            **({"tau": f(target)} if in_torque else {"request": (f(0), f(target))}),
        )
        mine = np.array([live.u_d, live.u_q, live.u_d_lim, live.u_q_lim, out.duty_a, out.duty_b, out.duty_c], dtype=f)
        shown = (x + f(0) for x in realised)  # the recorded voltage adds the compensation, here none: -0 becomes 0
        other = np.array([*u, *shown, *duties], dtype=f)
        assert mine.tobytes() == other.tobytes(), (k, mine, other)
        moved, flags = max(moved, abs(live.i_q)), flags | live.flags
        switched.add(twin.linear_on)
    assert flags & FLAGS.get(case, 0) == FLAGS.get(case, 0)
    assert len(switched) == (2 if "switched" in case else 1)
    assert moved > 0.3 * size or rpm > 1200  # the loop did follow; deep in field weakening the limits leave less


@pytest.mark.parametrize("rpm", [1100.0, -1300.0])
def test_the_unified_law_rests_where_voltage_and_current_limit_meet(rpm: float) -> None:
    """Asked for more than both allow, it holds both limits: i_q gives way on the voltage circle.

    Three Newton steps leave 0.4 and 1.3 % of the current limit, and 4e-4 of the voltage.
    """
    limits = {"motor__I_max_apk": 20.0, "protection__I_cont_apk": 20.0, "field_weakening__i_d_min_a": -60.0}
    settings = values(UNIFIED, polar__V_ref_ratio=0.97, **limits, **SALIENT)
    loop = Loop(core(double=True), settings, omega=rpm * RPM, U_dc=U_DC)
    for _ in range(400):
        live = loop.step(mode=MODE_CURRENT, i_q_ref=math.copysign(40.0, rpm))
    i, plant = complex(live.i_d_ref, live.i_q_ref), loop.plant
    rotation = plant.omega * complex(-plant.L_q * i.imag, plant.L_d * i.real + plant.psi)
    assert abs(i) == pytest.approx(20.0, rel=0.02) and i.imag * rpm > 0.0
    assert abs(plant.R * i + rotation) == pytest.approx(0.97 * U_DC / math.sqrt(3), rel=1e-3)
    assert plant.i == pytest.approx([i.real, i.imag], abs=0.01)
