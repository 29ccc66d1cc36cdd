# SPDX-License-Identifier: MIT
"""Values that lie on a bound, and formulas of the rarer choices against their closed forms."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from pmsmtool.design import field_weakening, polar
from pmsmtool.design.lookup import table
from pmsmtool.design.lookup.design import LookupRequest, _fitting
from pmsmtool.design.lookup.grid import table_words
from pmsmtool.design.loops.current_loop import second_order
from pmsmtool.design.loops.speed_loop import pole_placement, symmetric_optimum
from pmsmtool.design.operating_machine import OperatingMachine
from pmsmtool.design.polar_map import share_above
from pmsmtool.design.polar_values import _options
from pmsmtool.design.tune import _notch, tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.errors import ConfigError, DesignInfeasible
from pmsmtool.machine.machine_file import load_machine_file

PROFILE = Path(__file__).resolve().parents[2] / "profiles" / "interior-2k2.toml"
ROUNDING = 1e-12  # relative; measured 2e-16


@pytest.mark.parametrize(
    "name", ["bandwidth_hz", "damping", "speed_bandwidth_hz", "speed_damping", "speed_filter_hz", "pll_rad_s"]
)
def test_zero_is_not_positive(name: str) -> None:
    with pytest.raises(ConfigError, match="not a positive number"):
        TuneRequest(**cast(Any, {name: 0.0}))


def test_the_ends_of_a_range_belong_to_it() -> None:
    assert [TuneRequest(speed_decimation=n).speed_decimation for n in (1, 1000)] == [1, 1000]
    for n in (0, 1001):
        with pytest.raises(ConfigError, match=r"outside 1\.\.1000"):
            TuneRequest(speed_decimation=n)
    for refused in ({"torque_bound": 0.0}, {"U_dc_v": (0.0,)}):
        with pytest.raises(ConfigError, match="positive"):
            LookupRequest(**cast(Any, refused))
    size = {kind: table_words(9, 7, 1, kind) for kind in ("float32", "int16")}
    for capacity, stored in ((size["float32"], "float32"), (size["int16"], "int16"), (size["int16"] - 1, "float32")):
        assert _fitting(LookupRequest(), capacity, 9, 7, 1) == stored
    assert _options(1.0, "unified")[1].count("prediction") == 1 and "prediction" not in _options(0.5, "unified")[1]


def test_what_a_table_is_made_for() -> None:
    def refused(I_max: float = 1.0, i_d_min: float = 0.0, V: float = 1.0, L: tuple[float, float] = (1.0, 1.0)) -> str:
        machine = cast(OperatingMachine, SimpleNamespace(flux_map=None, L_d=L[0], L_q=L[1]))
        one = np.ones(1)
        try:
            table._check(machine, one, one, V * one, I_max, i_d_min)
        except DesignInfeasible as error:
            return str(error)
        return ""

    assert not refused()
    assert "I_max" in refused(I_max=0.0) and "voltage" in refused(V=0.0) and "i_d_min" in refused(i_d_min=1e-9)
    assert all("inductance" in refused(L=L) for L in ((0.0, 1.0), (1.0, 0.0)))
    ends = SimpleNamespace(i_d_a=np.array([-2.0, 0.0]), i_q_a=np.array([-1.0, 1.0]))
    covered = cast(OperatingMachine, SimpleNamespace(loss_map=ends))
    table._require_loss_data(covered, np.array([-2.0, 0.0]), np.array([-1.0, 1.0]))
    with pytest.raises(ConfigError, match="1 of 2 references lie outside"):
        table._require_loss_data(covered, np.array([-2.0, 0.1]), np.array([-1.0, 1.0]))


def test_a_gain_of_zero_is_refused_with_the_frequency_that_gives_it() -> None:
    """2 zeta w L = R, so K_p = 0; above w = R/(2 zeta L) = 2 it is positive."""
    for placed in (second_order, lambda R, L, w, zeta: pole_placement(L, R, w, zeta)):
        with pytest.raises(DesignInfeasible) as caught:
            placed(1.0, 0.5, 2.0, 0.5)
        assert "w_n above 2 rad/s" in str(caught.value.hint)
    with pytest.raises(DesignInfeasible, match="beyond the small time constants"):
        symmetric_optimum(1.0, 1e-3, 1.0)


def test_a_notch_needs_a_rate_that_shows_the_resonance() -> None:
    machine = load_machine_file(PROFILE)
    swings = replace(machine, machine=replace(machine.machine, resonance_hz=50.0, antiresonance_hz=20.0))
    assert _notch(swings, TuneRequest(), 1e-3)[0].hz == 50.0
    notch, _, notes = _notch(swings, TuneRequest(), 20e-3)
    assert notch.hz == 0.0 and notes[0].endswith("rate, 50 Hz")


def test_where_the_largest_torque_stays_outside_the_circle() -> None:
    """psi/L_d = I_max: neither does the MTPV point come in, nor is any speed out of reach."""
    machine = replace(load_machine_file(PROFILE).machine, psi_f_wb=0.5, L_d_h=0.125, L_q_h=0.25)
    characteristic_a = machine.psi_f_wb / machine.L_d_decoupling_h
    assert field_weakening.mtpv_entry_rpm(machine, 100.0, characteristic_a) == math.inf
    assert field_weakening.empty_above_rpm(machine, 100.0, characteristic_a) == math.inf


def test_what_the_voltage_just_holds_is_within_reach() -> None:
    surface = polar.SurfaceMachine(0.5, 1e-3, 0.02, 4)
    assert polar.equilibrium_at_amplitude(surface, 0.0, 4.0, 2.0).reachable
    assert not polar.equilibrium_at_amplitude(surface, 0.0, 4.25, 2.0).reachable
    assert share_above(np.array([1.0, 2.0, np.nan]), 2.0) == 0.0


def test_gains_of_the_coefficient_diagram_method() -> None:
    """(24)-(37): a1 = gamma/tau, a0 = gamma/tau^2 over the plant's gain, cos delta and -V_a cos delta."""
    surface, tau, V_a, delta = polar.SurfaceMachine(0.5, 1e-3, 0.02, 4), 1e-3, 8.0, 0.3
    found = polar.cdm_gains(surface, V_a, delta, 20.0, 1e-4, tau)
    K_P, K_I = (polar.CDM_GAMMA / tau * 1e-3 - 0.5, polar.CDM_GAMMA / tau**2 * 1e-3)
    gain = math.cos(delta)
    assert (found.K_P21, found.K_I21) == pytest.approx((K_P / gain, K_I / gain), rel=ROUNDING)
    assert (found.K_P12, found.K_I12) == pytest.approx((-K_P / (V_a * gain), -K_I / (V_a * gain)), rel=ROUNDING)


def test_a_delay_of_one_period_can_be_predicted() -> None:
    machine = load_machine_file(PROFILE)
    source = replace(machine, inverter=replace(machine.inverter, delay_periods=1.0))
    design = tune(source, TuneRequest(predictor=True, field_weakening="off", governor="off"))
    assert design.request["predictor"] is True and design.content_hash().startswith("sha256:")
