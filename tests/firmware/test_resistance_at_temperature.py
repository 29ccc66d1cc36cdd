# SPDX-License-Identifier: MIT
"""The core's resistance over temperature against the design's: both heat the copper part of the loop only."""

from __future__ import annotations

from dataclasses import replace

import pytest

from pmsmtool.design.operating_machine import at_temperature
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.files import data_folder
from pmsmtool.firmware.core_binding import core
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.machine.temperature import loop_coefficient_per_k, magnet_flux_at, resistance_at
from tests.firmware.closed_loop import MODE_CURRENT, Loop

TOLERANCE = 2e-4
"""Relative; the core computes in binary32, measured 5e-6."""
PREDICTOR_OPTION = 16.0
I_D = 5.0


def core_resistance(values: dict[str, float], T_c: float) -> float:
    """Return the R with which the core predicts the decay of a current of ``I_D`` over one period at no voltage.

    i - i' = T_s R i / (L + T_s R/2), and the controller answers with K_p of it.
    """
    L, T_s, K_p = values["motor.L_d_h"], 1e-9 * values["inverter.T_s_ns"], 2.0 * values["motor.L_d_h"] * 1e4
    alone = {
        "current.options": PREDICTOR_OPTION, "current.K_p_d_v_per_a": K_p, "current.K_i_d_v_per_as": 0.0,
        "current.K_i_q_v_per_as": 0.0, "governor.mode": 0.0, "inverter.deadtime_compensation": 0.0,
    }  # fmt: skip
    loop = Loop(core(), {**values, **alone}, omega=0.0)
    loop.measurement.T_winding = T_c
    loop.reference.mode, loop.reference.i_d_ref, loop.reference.i_q_ref = MODE_CURRENT, I_D, 0.0
    loop.state.reference_held.d = I_D
    loop.step_with((I_D, -0.5 * I_D, -0.5 * I_D))
    d = (loop.output.duty_a, loop.output.duty_b, loop.output.duty_c)
    fallen = loop.U_dc * (2.0 * d[0] - d[1] - d[2]) / 3.0 / K_p
    return L * fallen / (T_s * (I_D - 0.5 * fallen))


@pytest.mark.parametrize("share", [1.0, 0.8, None])
def test_the_core_heats_what_the_design_heats(share: float | None) -> None:
    """All of R_s heated is 7.1 % more at 140 degC where a fifth of the loop is devices."""
    base = load_machine_file(data_folder("profiles") / "interior-2k2.toml")
    R_s = base.machine.R_s_ohm
    machine = replace(base.machine, R_winding_ohm=None if share is None else share * R_s, alpha_R_per_k=0.0041)
    values = {
        name: float(value.value)
        for name, value in tune(replace(base, machine=machine), TuneRequest(field_weakening="off")).values.items()
    }
    for T_c in (-20.0, 20.0, 90.0, 140.0):
        designed = at_temperature(machine, T_winding_c=T_c).R
        assert core_resistance(values, T_c) == pytest.approx(designed, rel=TOLERANCE), T_c
    copper = R_s if share is None else share * R_s
    assert designed == pytest.approx(R_s + copper * 0.0041 * 120.0)


def test_one_home_of_both_laws() -> None:
    machine = load_machine_file(data_folder("profiles") / "interior-2k2.toml").machine
    split = replace(machine, R_winding_ohm=0.75 * machine.R_s_ohm, alpha_R_per_k=0.004, alpha_psi_per_k=-0.002)
    assert loop_coefficient_per_k(split) == pytest.approx(0.003)
    assert resistance_at(split, 120.0) == pytest.approx(1.3 * split.R_s_ohm)
    assert magnet_flux_at(split, 70.0) == pytest.approx(0.9 * split.psi_f_wb)
