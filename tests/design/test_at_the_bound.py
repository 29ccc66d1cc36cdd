# SPDX-License-Identifier: MIT
"""Values that lie on a bound, and formulas of the rarer choices against their closed forms."""

from __future__ import annotations

import ctypes
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from pmsmtool.design import field_weakening, governor, polar
from pmsmtool.design import ratings as rating
from pmsmtool.design import tune as tuning
from pmsmtool.design.admissible_set import Horizon, PredictionModel
from pmsmtool.design.closed_drive import _Projection
from pmsmtool.design.lookup import grid, table
from pmsmtool.design.lookup.design import LookupRequest, _fitting
from pmsmtool.design.lookup.grid import GridBounds, table_words
from pmsmtool.design.lookup.table import LookupTable, speed_table
from pmsmtool.design.loops.current_loop import second_order
from pmsmtool.design.loops.designed_loops import CURRENT_GAINS, choose_current, smaller_gains
from pmsmtool.design.loops.margins import margin_problem
from pmsmtool.design.loops.sampled_loop import SampledLoop, margins
from pmsmtool.design.loops.speed_loop import pole_placement, symmetric_optimum
from pmsmtool.design.operating_machine import OperatingMachine
from pmsmtool.design.polar_values import _facts, _options, share_above
from pmsmtool.design.ratings import Ratings, ratings
from pmsmtool.design.tune import NOTCH_RATE_SHARE, _notch, tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.errors import ConfigError, DesignInfeasible
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.machine.parameters import MachineParameters

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
    assert _notch(swings, TuneRequest(), NOTCH_RATE_SHARE / 50.0)[0].hz == 0.0


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
    # (37): the d axis is slowed down below a hundredth of the voltage, V_a cos delta
    K_I12 = polar.cdm_gains(surface, 0.2, 0.0, 20.0, 1e-4, tau).K_I12
    assert K_I12 == pytest.approx(-polar.CDM_GAMMA / tau**2 * 1e-3 / 0.2, rel=ROUNDING)
    V_d = 0.3 * math.cos(1.2)
    K_I12 = polar.cdm_gains(surface, 0.3, 1.2, 20.0, 1e-4, tau).K_I12
    slowed = 0.1 * 20.0 / V_d * 1e-4
    assert K_I12 == pytest.approx(-polar.CDM_GAMMA / slowed**2 * 1e-3 / V_d, rel=ROUNDING)


def test_how_far_inductances_may_differ_for_the_polar_laws() -> None:
    """L_d and L_q of 101 and 99 differ by the limit, 2 % of their mean."""
    at_limit = MachineParameters(4, 0.5, 101.0, 99.0, 0.02)
    assert polar.SurfaceMachine.of(at_limit).L_s_h == 100.0
    with pytest.raises(DesignInfeasible, match=r"differ by 2\.1 %"):
        polar.SurfaceMachine.of(replace(at_limit, L_d_h=101.1))
    standing = cast(Ratings, SimpleNamespace(base_speed_rpm=0.0))
    assert _facts(polar.SurfaceMachine(0.5, 1e-3, 0.02, 4), standing, 20.0) == {}


def test_a_delay_of_one_period_can_be_predicted() -> None:
    machine = load_machine_file(PROFILE)
    source = replace(machine, inverter=replace(machine.inverter, delay_periods=1.0))
    design = tune(source, TuneRequest(predictor=True, field_weakening="off", governor="off"))
    assert design.request["predictor"] is True and design.content_hash().startswith("sha256:")
    assert margin_problem(design).predictor


def test_margins_asked_for_are_met_by_a_loop_that_just_has_them() -> None:
    source = load_machine_file(PROFILE)
    choice = choose_current(source, TuneRequest(), 20.0)
    loops = choice.loops().values()
    phase_deg, gain_db = min(one.phase_margin_deg for one in loops), min(one.gain_margin_db for one in loops)
    for phase, gain, met in ((phase_deg, gain_db, True), (phase_deg + 1e-9, 1.0, False), (1.0, gain_db + 1e-9, False)):
        asked = replace(choice.request, phase_margin_deg=phase, gain_margin_db=gain)
        assert replace(choice, request=asked).meets_request() is met


def test_a_loop_on_its_limit_is_not_stable_and_has_no_gain_margin() -> None:
    """L = 2/(z - 1) closes to a pole at -1: L = -1 at the Nyquist frequency."""
    found = margins(SampledLoop((2.0,), (1.0, -1.0), 1.0))
    assert (found.stable, found.gain_margin, found.gain_reduction) == (False, math.inf, 0.0)


def test_a_noisy_speed_slows_its_loop_down(monkeypatch: pytest.MonkeyPatch) -> None:
    """The symmetric optimum's K_p is J omega_c."""
    source, request = load_machine_file(PROFILE), TuneRequest()
    rated = ratings(source, 0.9 * source.inverter.V_max_v)
    choice = choose_current(source, request, rated.I_max_apk)

    def K_p() -> float:
        return tuning._design_speed(source, request, rated, choice, math.inf).values["speed.K_p_nms_per_rad"].value

    quiet = K_p()
    monkeypatch.setattr(tuning, "quieter", lambda *_: (0.5, "it is loud"))
    assert K_p() == pytest.approx(0.5 * quiet, rel=ROUNDING)


def test_one_pair_of_gains_alone_has_a_smaller_one() -> None:
    d, _, q, _ = CURRENT_GAINS
    assert smaller_gains({d: 2.0, q: 1.0}, {q}) == {d: 1.0, q: 1.0}
    assert smaller_gains({q: 1.0}, {q}) == {}


def test_horizons_that_the_drive_can_hold() -> None:
    model = cast(PredictionModel, None)
    assert not Horizon(0, None).by_tolerance and Horizon(1, None).by_tolerance
    for rows, notes in ((governor.SHORT_HORIZON, 0), (governor.SHORT_HORIZON + 1, 1)):
        assert len(governor._notes("paper", 0.01, 0.01, Horizon(rows, 0.01), model)) == notes


def test_a_grid_may_fill_the_memory() -> None:
    """One cell of four is in error: halved along the torque, 4 x 3 nodes."""
    nodes = np.arange(3.0)
    worst = np.zeros((2, 2, 3, 3))
    worst[0, 0, 0] = 2.0
    one = np.ones(1)
    words = table_words(4, 3, 1, "float32")
    split = grid._split(nodes, nodes, one, worst, GridBounds(1.0, 1.0, capacity_words=words))
    assert split is not None and split[0].tolist() == [0.0, 0.5, 1.0, 2.0] and split[1].size == 3
    assert grid._split(nodes, nodes, one, worst, GridBounds(1.0, 1.0, capacity_words=words - 1)) is None
    ends = np.array([1.0, 2.0])
    words = table_words(3, 3, 3, "float32")
    for share, capacity, fits in ((2.0, words, True), (2.0, words - 1, False), (grid.VOLTAGE_SHARE, words, False)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(grid, "_voltage_excess", lambda *_, e=share: [e])
            found = grid._split_voltages(
                cast(LookupTable, None), (nodes, nodes, ends), GridBounds(1.0, 1.0, capacity_words=capacity)
            )
        assert (found is not None) is fits


def test_bounds_that_are_just_met_need_no_finer_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    found, axis = cast(LookupTable, SimpleNamespace()), np.arange(3.0)
    met = grid.InterpolationError(0.5, 2.0, 0.0, 0)
    monkeypatch.setattr(grid, "as_stored", lambda *_: found)
    monkeypatch.setattr(grid, "cell_errors", lambda *_: np.zeros((2, 2, 3, 3)))
    monkeypatch.setattr(grid, "_bounds", lambda *_: met)
    assert grid.refined_table(lambda *_: found, axis, axis, np.ones(1), GridBounds(0.5, 2.0)) == (found, met)


def test_ratings_that_are_their_own_limits_keep_their_reasons(monkeypatch: pytest.MonkeyPatch) -> None:
    source = load_machine_file(PROFILE)
    source = replace(source, limits=replace(source.limits, tau_max_nm=None))
    V = 0.9 * source.inverter.V_max_v
    free = ratings(source, V)
    at_most = SimpleNamespace(trip_most_rpm=free.n_trip_rpm, n_most_rpm=free.n_max_rpm)
    monkeypatch.setattr(rating, "fault_reaction", lambda *_: at_most)
    given = replace(source, limits=replace(source.limits, tau_max_nm=free.tau_max_nm))
    assert ratings(given, V).methods == free.methods
    below = SimpleNamespace(trip_most_rpm=0.99 * free.n_trip_rpm, n_most_rpm=0.99 * free.n_max_rpm)
    monkeypatch.setattr(rating, "fault_reaction", lambda *_: below)
    told = ratings(source, V).methods
    assert "uncontrolled generation" in told["n_trip"] and "uncontrolled generation" in told["n_max"]
    weakened = rating.MAGNET_SHARE * source.machine.psi_f_wb / source.machine.L_d_decoupling_h
    assert rating._assumed_i_d_min(source.machine, weakened, 99.0)[1].startswith("assumed: -I_nom")


def test_a_closed_drive_may_take_all_of_its_limits() -> None:
    for demand, deviation, held in ((1.0, 2.0, True), (1.1, 2.0, False), (1.0, 2.1, False)):
        drive = SimpleNamespace(
            demand=lambda *_, told=(demand, deviation): told, limit=1.0, rated=SimpleNamespace(I_max_apk=5.0)
        )
        assert _Projection.holds(cast(_Projection, drive), 3.0, 0.0, 1) is held


def test_a_cell_without_a_solution_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(*arguments: Any) -> int:
        ctypes.memset(arguments[-2], 0, 6)
        ctypes.memset(arguments[-2] + 4, 255, 1)  # of two speeds, the third torque and the first of them
        return 1

    monkeypatch.setattr(table, "design_library", lambda: SimpleNamespace(pmsm_lookup_table=failing))
    machine = OperatingMachine(1, 0.1, 1e-3, 1e-3, 0.1)
    with pytest.raises(DesignInfeasible, match=r"1 of 6 cells .* first at 30 N m, 0 rad/s, 7 V"):
        speed_table(machine, torque_nm=[10.0, 20.0, 30.0], speed_rpm=[0.0, 60.0], V_max_v=[7.0], I_max_apk=9.0)
