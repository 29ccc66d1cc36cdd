# SPDX-License-Identifier: MIT
"""Numbers of governor and field weakening against the reference's own."""

from __future__ import annotations

import cmath
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pmsmtool.design.admissible_set import PredictionModel
from pmsmtool.design.field_weakening import (
    empty_above_rpm,
    limit_facts,
    mtpv,
    mtpv_entry_rpm,
    mtpva,
    overshoot_per_slope,
    ramp_limit_rpm_per_s,
    torque_constant,
)
from pmsmtool.design.governor import (
    CURRENT_ROW,
    MINIMUM_TIME,
    PRE_PROJECTION,
    PREDICTOR,
    design_governor,
    euler_error,
)
from pmsmtool.design.lookup.table import torque_limits
from pmsmtool.design.loops.current_loop import imc
from pmsmtool.design.operating_machine import at_temperature
from pmsmtool.design.ratings import ratings
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.errors import ConfigError
from pmsmtool.firmware.image import lut_size_words
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.machine.parameters import MachineParameters
from pmsmtool.machine.temperature import magnet_flux_at
from pmsmtool.papers.governed_drive import IDEAL
from pmsmtool.sim.closed_loop import simulate
from pmsmtool.sim.kernel import Application
from pmsmtool.sim.scenarios import Scenario

PROFILES = Path(__file__).resolve().parents[2] / "profiles"
R, L_D, L_Q, PSI, P, T_S = 0.137, 2.3e-3, 2.1e-3, 0.41, 4, 1.0 / 12e3
V_MAX = 210.0 / math.sqrt(3.0)
MODEL = PredictionModel(R, L_D, L_Q, PSI, T_S, imc(R, L_D, 4000.0), imc(R, L_Q, 4000.0))
MTPV_MACHINE = MachineParameters(4, 0.0, 1e-3, 2.5e-3, 0.1)


@pytest.mark.parametrize(("rpm", "percent"), [(620.0, 0.75), (1000.0, 1.55), (3000.0, 10.3), (6000.0, 37.7)])
def test_prediction_error_of_the_turning_frame(rpm: float, percent: float) -> None:
    """Reference: 0.7 / 1.5 / 10 / 37 % of V_max."""
    assert 100.0 * euler_error(MODEL, rpm * P * math.pi / 30.0, V_MAX, 28.0) == pytest.approx(percent, rel=0.01)


def test_prediction_error_without_resistance_magnet_and_saliency() -> None:
    """The stator-fixed current is then a ramp: the error of i and that of u are complex factors, and add."""
    model = PredictionModel(0.0, L_D, L_D, 0.0, T_S, imc(R, L_D, 4000.0), imc(R, L_D, 4000.0))
    angle, I_a = 3000.0 * P * math.pi / 30.0 * T_S, 28.0
    of_current = abs(cmath.exp(-1j * angle) - 1.0 + 1j * angle) * I_a
    of_voltage = abs(cmath.exp(-0.5j * angle) - 1.0) * T_S / L_D * V_MAX
    expected = (of_current + of_voltage) * model.gains_d.K_p / V_MAX
    # measured 4e-4 less: the directions are tried on a grid
    assert euler_error(model, angle / T_S, V_MAX, I_a) == pytest.approx(expected, rel=1e-3)


def test_at_rest_only_the_resistance_is_missed() -> None:
    assert euler_error(MODEL, 0.0, V_MAX, 28.0) < 2e-3


@pytest.mark.parametrize(("L_d", "L_q"), [(1e-3, 4e-3), (4e-3, 1e-3)])
def test_at_rest_each_axis_decays_by_its_own_inductance(L_d: float, L_q: float) -> None:
    """The faster axis is off by more: what is left of i, and what u adds, by the exponential of R T/L."""
    model = PredictionModel(2.0, L_d, L_q, PSI, T_S, imc(2.0, L_d, 4000.0), imc(2.0, L_q, 4000.0))
    L, gains = (L_d, model.gains_d) if L_d < L_q else (L_q, model.gains_q)
    x, I_a = 2.0 * T_S / L, 28.0
    of_current, of_voltage = (math.exp(-x) - 1.0 + x) * I_a, (x - 1.0 + math.exp(-x)) / 2.0 * V_MAX
    expected = (of_current + of_voltage) * gains.K_p / V_MAX
    assert euler_error(model, 0.0, V_MAX, I_a) == pytest.approx(expected, rel=1e-6)


@pytest.mark.chain
def test_modes_and_options() -> None:
    source = load_machine_file(PROFILES / "jercic-2017.toml")
    rated = ratings(source, 0.92 * V_MAX)
    gains = {"d": imc(R, L_D, 4000.0), "q": imc(R, L_Q, 4000.0)}
    best = design_governor(source, rated, gains, "best", predictor=True)
    options = int(best.values["governor.options"].value)
    assert options == CURRENT_ROW | PRE_PROJECTION | MINIMUM_TIME | PREDICTOR
    assert best.values["governor.k_max"].value == 0.0
    assert best.values["governor.eps"].value == 0.015
    assert best.values["governor.observer_gain"].value == pytest.approx(0.1, rel=0.05)
    assert best.facts["straight_segment"] is True
    paper = design_governor(source, rated, gains, "paper", predictor=False)
    assert paper.values["governor.options"].value == 0.0
    assert paper.values["governor.eps"].value == pytest.approx(
        euler_error(MODEL, 1200.0 * P * math.pi / 30.0, V_MAX, 28.0)
    )
    assert paper.facts["k_max_eps_0.01"] == 24
    assert paper.values["governor.k_max"].value == paper.facts["k_max_chosen"]
    assert any("half of a 12 kHz period" in note for note in paper.notes)
    with pytest.raises(ConfigError, match="mode"):
        design_governor(source, rated, gains, "wild", predictor=False)


def test_an_unreachable_reference_is_steered_within_the_current_limit() -> None:
    """Delay 1.5, no predictor, from braking to a torque that the voltage does not reach: 6.8 ms at up to 1.000 I_max.

    Without the direction 20 ms are not enough; from the sampled instead of the predicted current it passes 1.03 I_max.
    """
    source = load_machine_file(PROFILES / "jercic-2017.toml")
    delayed = replace(source, simulation=IDEAL, inverter=replace(source.inverter, delay_periods=1.5, V_dead_v=0.0))
    params = tune(delayed).parameter_set()
    courses = {"i_q_a": ((0.0, -50.0), (0.02, -50.0), (0.02, 50.0)), "driven_rpm": ((0.0, 640.0),)}
    trace = simulate(
        delayed, params, Scenario("step", 0.04, "current", courses, "driven", 640.0), application=Application.CORE
    )
    i = np.stack([trace["i_d_true_a"], trace["i_q_true_a"]])[:, trace.t_s >= 0.02]
    assert np.hypot(*i).max() <= 1.02 * source.machine.I_max_apk
    away = np.hypot(*(i - i[:, -20:].mean(axis=1)[:, None]))
    assert np.flatnonzero(away > 1.0)[-1] * source.inverter.T_s <= 0.010
    salient = tune(load_machine_file(PROFILES / "mtpv-test.toml"))
    assert int(salient["governor.options"]) & MINIMUM_TIME
    small = replace(source.machine, I_max_apk=0.1 * source.machine.I_max_apk, I_nom_apk=None)
    assert not int(tune(replace(source, machine=small))["governor.options"]) & MINIMUM_TIME


def test_overshoot_of_the_reference_ramps() -> None:
    """Excess over V_m on a ramp at N_FW = 50: 0.43 / 1.9 / 3.8 / 7.6 % at 667 / 3000 / 6000 / 12 000 rpm/s."""
    period = 50.0 * T_S
    for slope, percent in ((667.0, 0.43), (3000.0, 1.9), (6000.0, 3.8), (12000.0, 7.6)):
        assert 100.0 * slope * overshoot_per_slope(655.0, period) == pytest.approx(percent, rel=0.03)
    assert ramp_limit_rpm_per_s(655.0, period, 0.08) == pytest.approx(13_700.0, rel=0.01)


@pytest.mark.parametrize(
    ("omega", "i_d", "i_q"),
    [(1000.0, -140.40715, 36.58910), (2000.0, -112.97865, 19.31447), (-1000.0, -140.40715, 36.58910)],
)
def test_mtpv_closed_form(omega: float, i_d: float, i_q: float) -> None:
    assert mtpv(MTPV_MACHINE, omega, 100.0) == pytest.approx((i_d, i_q), rel=1e-6)


def test_mtpv_of_a_surface_machine_is_the_characteristic_current() -> None:
    machine = replace(MTPV_MACHINE, L_q_h=1e-3)
    assert mtpv(machine, 1000.0, 100.0) == pytest.approx((-100.0, 100.0))


def test_mtpva_closed_form() -> None:
    assert mtpva(MTPV_MACHINE, 600.0, 100.0, 150.0) == pytest.approx((-135.10258, 65.17127), rel=1e-6)
    assert mtpva(MTPV_MACHINE, 100.0, 100.0, 150.0) is None
    surface = MachineParameters(4, 0.0, 1e-3, 1e-3, 0.1)
    found = mtpva(surface, 1000.0, 100.0, 150.0)
    assert found is not None
    assert math.hypot(0.1 + 1e-3 * found[0], 1e-3 * found[1]) == pytest.approx(0.1)
    assert math.hypot(*found) == pytest.approx(150.0)


def test_mtpva_is_the_corner_the_table_kernel_finds() -> None:
    bounds = torque_limits(at_temperature(MTPV_MACHINE), [600.0], [100.0], 150.0)
    found = mtpva(MTPV_MACHINE, 600.0, 100.0, 150.0)
    assert found == pytest.approx((float(bounds.largest_i_d_a[0, 0]), float(bounds.largest_i_q_a[0, 0])), rel=1e-9)


def test_hot_magnet() -> None:
    """(36): 150 K at 0.12 %/K are 18 %."""
    assert magnet_flux_at(MTPV_MACHINE, 170.0) == pytest.approx(0.82 * 0.1)


def test_torque_constant_is_the_slope_of_the_torque() -> None:
    machine = at_temperature(MTPV_MACHINE)
    for i_d in (-40.0, 0.0, 20.0):
        slope = machine.torque_nm(i_d, 1.0) - machine.torque_nm(i_d, 0.0)
        assert torque_constant(MTPV_MACHINE, i_d) == pytest.approx(float(slope), rel=1e-12)


def test_a_machine_without_saliency_has_no_d_current_of_least_current() -> None:
    """It was 4e-16 A, and a difference to what the drive holds."""
    source = load_machine_file(PROFILES / "jercic-2017.toml")
    for L_h in (1.875e-4, 1e-3, 2.3e-3):
        machine = replace(source.machine, L_d_h=L_h, L_q_h=L_h, L_d_app_h=None, L_q_app_h=None)
        assert tune(replace(source, machine=machine))["field_weakening.i_d_lm_a"] == 0.0


def test_field_weakening_numbers_of_the_reference_machine() -> None:
    design = tune(load_machine_file(PROFILES / "jercic-2017.toml"))
    assert design["field_weakening.mode"] == 3.0
    assert design["field_weakening.N_fw"] == 50.0
    assert design["field_weakening.h2"] == pytest.approx(1e-3, rel=0.02)
    assert 0.05 <= design["field_weakening.beta"] <= 0.085
    assert design["field_weakening.i_d_lm_a"] == pytest.approx(0.38, abs=0.01)  # L_d > L_q: a little positive
    slope = design["speed.acceleration_rpm_per_s"]
    assert slope == pytest.approx(0.8 * float(design.facts["ramp_that_spends_the_reserve_rpm_per_s"]))


@pytest.mark.chain
def test_a_saturated_machine_gets_its_table() -> None:
    design = tune(load_machine_file(PROFILES / "saturated-pmsyrm.toml"))
    assert design["field_weakening.mode"] == 1.0
    cells = int(design["lut.n_x"]) * int(design["lut.n_y"]) * int(design["lut.n_z"])
    assert len(design.tables["lut.i_d_a"]) == cells > 100
    assert design.parameter_set().violations() == ()
    assert lut_size_words({name: value.value for name, value in design.values.items()}) > cells
    assert design["governor.observer_gain"] == pytest.approx(0.0104, abs=1e-4)  # 8 ms


@pytest.mark.chain
@pytest.mark.parametrize("mode", ["off", "lookup", "gradient", "uncompensated"])
def test_other_modes_on_request(mode: str) -> None:
    source = load_machine_file(PROFILES / "jercic-2017.toml")
    design = tune(source, TuneRequest(field_weakening=mode, governor="line", eps=0.03))
    assert design["field_weakening.mode"] == ["off", "lookup", "gradient", "accelerated", "uncompensated"].index(mode)
    assert bool(design.tables) == (mode == "lookup")
    assert design["governor.mode"] == 2.0
    assert design["governor.eps"] == 0.03


TABLE_1 = MachineParameters(P, R, L_D, L_Q, PSI)


@pytest.mark.parametrize(
    ("I_a", "share", "rpm"), [(28.0, 0.92, 770.0), (28.0, 1.0, 837.0), (56.0, 0.92, 945.0), (56.0, 1.0, 1027.0)]
)
def test_speed_above_which_no_current_holds_the_voltage(I_a: float, share: float, rpm: float) -> None:
    """Reference numbers hold for i_q = 0; a little negative i_q needs still less voltage, up to 0.8 % of the speed."""
    found = empty_above_rpm(TABLE_1, share * V_MAX, I_a)
    assert rpm - 1.0 <= found <= 1.009 * rpm
    angle = np.linspace(0.0, 2.0 * math.pi, 20001)
    i_d, i_q = I_a * np.cos(angle), I_a * np.sin(angle)

    def least(speed: float) -> float:
        w = speed * P * math.pi / 30.0
        return float(np.hypot(R * i_d - w * L_Q * i_q, R * i_q + w * (L_D * i_d + PSI)).min())

    assert least(0.9999 * found) <= share * V_MAX <= least(1.0001 * found)


def test_a_machine_that_can_cancel_its_magnet_has_no_such_speed_but_an_mtpv_entry() -> None:
    assert empty_above_rpm(MTPV_MACHINE, 100.0, 150.0) == math.inf
    entry = mtpv_entry_rpm(MTPV_MACHINE, 100.0, 150.0)
    assert math.hypot(*mtpv(MTPV_MACHINE, entry * P * math.pi / 30.0, 100.0)) == pytest.approx(150.0, rel=1e-9)
    assert mtpv_entry_rpm(TABLE_1, 0.92 * V_MAX, 56.0) == math.inf


@pytest.mark.parametrize("without", ["constant", "magnet"])
def test_a_flux_map_or_a_machine_without_magnet_has_no_constant_limits(without: str) -> None:
    source = load_machine_file(PROFILES / "saturated-pmsyrm.toml")
    assert source.flux_map is not None and source.machine.psi_f_wb > 0.0
    if without == "magnet":
        source = replace(source, flux_map=None, machine=replace(source.machine, psi_f_wb=0.0))
    assert "characteristic_current_apk" not in limit_facts(source, ratings(source, source.inverter.V_max_v), 100.0)


def test_tune_says_where_the_machine_ends_and_how_hot_magnets_are() -> None:
    facts = tune(load_machine_file(PROFILES / "jercic-2017.toml")).facts
    assert facts["mtpv_from_rpm"] == "unreachable: psi/L_d exceeds I_max"
    assert facts["characteristic_current_apk"] == pytest.approx(178.0, abs=0.5)
    assert facts["field_weakening_empty_above_rpm"] == pytest.approx(951.8, abs=0.1)
    assert math.hypot(float(facts["mtpva_i_d_a"]), float(facts["mtpva_i_q_a"])) == pytest.approx(56.0)
    assert facts["mtpva_speed_rpm"] == pytest.approx(0.95 * 951.8, abs=0.1)
    assert facts["psi_f_at_T_magnet_max_wb"] == pytest.approx(PSI * (1.0 - 0.0012 * 100.0))
    other = tune(load_machine_file(PROFILES / "mtpv-test.toml")).facts
    assert other["field_weakening_empty_above_rpm"] == "never"
    assert float(other["mtpv_from_rpm"]) > 0.0


@pytest.mark.chain
def test_the_paper_mode_reports_its_horizon_over_speed_eps_and_bounds() -> None:
    source = load_machine_file(PROFILES / "jercic-2017.toml")
    facts = tune(source, TuneRequest(governor="paper", bandwidth_hz=4000.0 / (2.0 * math.pi), eps=1e-3)).facts
    assert [facts[f"k_max_eps_{eps}"] for eps in ("0.1", "0.01", "0.001")] == [18, 24, 34]
    assert facts["k_max_without_steady_state_row"] == "not finitely determined"
    assert facts["k_max_bounded_states_at_620_rpm"] == pytest.approx(14, abs=2)
    assert 14 < int(facts["k_max_bounded_states_at_775_rpm"]) <= 34


@pytest.mark.chain
def test_no_tightening_is_not_finitely_determined_whatever_the_tolerance_says() -> None:
    source = load_machine_file(PROFILES / "jercic-2017.toml")
    request = TuneRequest(governor="paper", method="second-order", bandwidth_hz=2000.0 / (2.0 * math.pi), eps=0.0)
    design = tune(source, request)
    assert str(design.facts["k_max_chosen"]).startswith("not finitely determined")
    assert design["governor.k_max"] == 255.0
    assert any("not finitely determined" in note for note in design.notes)
