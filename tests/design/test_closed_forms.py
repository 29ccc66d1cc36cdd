# SPDX-License-Identifier: MIT
"""Parts of a design that have a closed form, or that scipy computes by another way."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.linalg import expm

from pmsmtool.design.lookup.design import LookupRequest, _Problem
from pmsmtool.design.lookup.grid import GridBounds, _voltage_excess
from pmsmtool.design.lookup.table import speed_table, torque_limits
from pmsmtool.design.loops.current_loop import second_order
from pmsmtool.design.loops.margins import BLOCK, BlockTask, evaluate_blocks, margin_problem
from pmsmtool.design.loops.sampled_loop import SampledLoop, margins
from pmsmtool.design.loops.speed_loop import (
    SpeedGains,
    SpeedMethod,
    companion,
    pole_placement,
    small_time_constants,
    speed_loop,
    symmetric_ratio,
)
from pmsmtool.design.minimum_time import Flow
from pmsmtool.design.operating_machine import at_temperature
from pmsmtool.design.prediction import (
    FLOOR_SHARE,
    LEAST_FACTOR,
    MODEL_ALLOWANCE,
    NEARBY,
    NORMALISING_QUANTILE,
    predict,
)
from pmsmtool.design.ratings import SAG_SHARE, ratings, voltage_facts
from pmsmtool.design.tolerance import HeadroomLimits, OperatingCells, Samples, headroom, tolerance_box
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.errors import ConfigError, DesignInfeasible
from pmsmtool.machine.machine_file import load_machine_file
from tests.design.test_speed_loop import path
from tests.design.test_tune import SURFACE

NEAR = 1e-11
"""Relative; measured below 2e-13."""


@pytest.mark.parametrize(
    "F", [np.zeros((2, 2)), [[-60.0, 0.0], [0.0, 0.0]], [[0.0, 300.0], [0.0, 0.0]], [[-60.0, 300.0], [-250.0, -70.0]]]
)
def test_a_flow_and_its_integral_are_those_of_the_matrix_exponential(F: list[list[float]]) -> None:
    """Singular matrices as well: no resistance, no speed."""
    flow, T = Flow(np.array(F, dtype=float)), 7e-3
    times = np.array([0.0, 1e-3, T])
    np.testing.assert_allclose(flow.at(times), [expm(np.array(F) * t) for t in times], rtol=NEAR, atol=NEAR)
    expected, _ = quad_vec(lambda t: expm(np.array(F) * t), 0.0, T, epsabs=1e-15, epsrel=1e-13)
    np.testing.assert_allclose(flow.integral(T), expected, rtol=NEAR, atol=NEAR * T)


def test_headroom_follows_the_flux_of_the_other_machine() -> None:
    """A map's derivatives in all four directions, an encoder offset, temperatures, a sagged link."""
    machine = replace(load_machine_file("interior-2k2").machine, alpha_R_per_k=0.004, alpha_psi_per_k=-0.001)
    rng = np.random.default_rng(1)
    i_d, i_q = np.array([-4.0, -1.0, 0.0]), np.array([5.0, -6.0, 0.0])
    psi, jacobian = rng.uniform(0.05, 0.3, (2, 3)), rng.uniform(1e-3, 9e-3, (4, 3))
    torque, omega = np.array([3.0, -4.0, 0.0]), np.array([300.0, -200.0, 500.0])
    cells = OperatingCells(torque, omega, omega, i_d, i_q, *psi, jacobian)
    row = {"R_s_ohm": 1.1, "L_d_h": 0.9, "L_q_h": 1.2, "psi_f_wb": 0.95, "encoder_rad": 0.02, "T_winding_c": 90.0,
           "T_magnet_c": 70.0, "U_dc_v": 250.0}  # fmt: skip
    limits = HeadroomLimits(0.55, 12.0, 8.0, 140.0)
    found = headroom(machine, cells, limits, Samples(tuple(row), np.array([list(row.values())])))
    heat = [1.0 + 0.004 * (T - machine.T_ref_c) for T in (90.0, 140.0)]
    R, R_hot = 1.1 * machine.R_s_ohm * heat[0], machine.R_s_ohm * heat[1]
    i = (i_d + 1j * i_q) * np.exp(0.02j)
    step = i - (i_d + 1j * i_q)
    swing = jacobian[0] * step.real + jacobian[1] * step.imag, jacobian[2] * step.real + jacobian[3] * step.imag
    magnet = 0.95 * machine.psi_f_wb * (1.0 - 0.001 * (70.0 - machine.T_ref_c))
    flux = magnet + 0.9 * (psi[0] - machine.psi_f_wb + swing[0]) + 1.2j * (psi[1] + swing[1])
    np.testing.assert_allclose(found.voltage[0], 1.0 - np.abs(R * i + 1j * omega * flux) / (0.55 * 250.0), rtol=NEAR)
    made = 1.5 * machine.pole_pairs * (flux.conjugate() * i).imag
    need = np.abs(i) * np.where(torque == 0.0, 1.0, np.abs(torque / np.where(torque == 0.0, 1.0, made)))
    need[np.sign(made) * np.sign(torque) < 0] = math.inf
    np.testing.assert_allclose(found.current[0], 1.0 - need / 12.0, rtol=NEAR)
    share = R * need[0] ** 2 / (R_hot * 8.0**2)
    assert found.thermal[0] == pytest.approx(1.0 - share, rel=1e-9)


def test_the_speed_loop_of_a_design_is_that_of_its_method() -> None:
    """With a bandwidth asked for and without: both methods, the crossover at the phase maximum for the default."""
    J, B = SURFACE.machine.J_kgm2 or 0.0, 0.02
    source = replace(SURFACE, machine=replace(SURFACE.machine, B_nms=B))
    plain = tune(source)
    alpha = plain["current.K_p_q_v_per_a"] / source.machine.L_q_h
    gains = {key: plain[f"encoder.{key}" if "pll" in key else f"speed.{key}"] for key in ("filter_hz", "decimation")}
    T_s = source.inverter.T_s
    T_sum = 1.0 / alpha + 1.5 * T_s + 2.0 / plain["encoder.pll_bandwidth_rad_s"]
    T_sum += 1.0 / (2.0 * math.pi * gains["filter_hz"]) + 0.5 * gains["decimation"] * T_s
    ratio = symmetric_ratio(math.radians(TuneRequest().speed_phase_margin_deg))
    assert plain["speed.K_p_nms_per_rad"] == pytest.approx(J / (ratio * T_sum), rel=1e-9)
    assert plain["speed.K_i_nm_per_rad"] == pytest.approx(J / (ratio**3 * T_sum**2), rel=1e-9)
    asked = tune(source, TuneRequest(speed_bandwidth_hz=8.0))
    omega = 2.0 * math.pi * 8.0
    assert asked["speed.K_p_nms_per_rad"] == pytest.approx(J * omega, rel=1e-9)
    assert asked["speed.K_i_nm_per_rad"] == pytest.approx(J * omega**3 * T_sum, rel=1e-9)
    for hz, w in ((8.0, omega), (None, 0.5 / (ratio * T_sum))):
        placed = tune(source, TuneRequest(speed_bandwidth_hz=hz, speed_method=SpeedMethod.POLE_PLACEMENT))
        zeta = TuneRequest().speed_damping
        assert placed["speed.K_p_nms_per_rad"] == pytest.approx(2.0 * zeta * w * J - B, rel=1e-9)
        assert placed["speed.K_i_nm_per_rad"] == pytest.approx(w**2 * J, rel=1e-9)
    slow = path()
    assert speed_loop(SpeedGains(1.0, 1.0, 1.0, SpeedMethod.SYMMETRIC_OPTIMUM), slow).delay_s == pytest.approx(
        slow.current.delay_s + 0.5 * slow.T_speed
    )
    assert small_time_constants(slow, 500.0) - small_time_constants(slow, 1000.0) == pytest.approx(1e-3)


def test_a_loop_that_is_unstable_is_refused_by_its_crossover() -> None:
    with pytest.raises(DesignInfeasible) as caught:
        tune(SURFACE, TuneRequest(speed_bandwidth_hz=400.0, speed_method=SpeedMethod.POLE_PLACEMENT))
    assert "crossover 400 Hz is unstable" in str(caught.value)


def test_what_a_placement_needs_is_said_with_its_number() -> None:
    with pytest.raises(DesignInfeasible) as caught:
        second_order(0.5, 2e-3, 50.0, 0.8)
    assert "above 156.2 rad/s" in caught.value.hint, "R / (2 zeta L)"
    with pytest.raises(DesignInfeasible) as caught:
        pole_placement(1e-4, 0.05, 100.0, 0.8)
    assert "above 312.5 rad/s" in caught.value.hint, "B / (2 zeta J)"


@pytest.mark.parametrize("decimation", [0, 1001])
def test_a_decimation_that_no_drive_has_is_refused(decimation: int) -> None:
    with pytest.raises(ConfigError, match="decimation"):
        tune(SURFACE, TuneRequest(speed_decimation=decimation))


def test_a_loop_without_a_crossing_is_as_fast_as_its_rate() -> None:
    """L = k: T = k / (1 + k) at all frequencies."""
    loop = SampledLoop((9.0,), (1.0,), 1e-3)
    assert margins(loop).bandwidth_rad_s == pytest.approx(math.pi / 1e-3)


def test_a_realisation_has_the_transfer_function_it_was_made_of() -> None:
    num, den = np.array([3.0, 0.5]), np.array([2.0, -1.2, 0.7])
    A, b, c, d = companion(num, den)
    z = np.exp(1j * np.linspace(0.1, 3.0, 7))
    found = [c @ np.linalg.solve(one * np.eye(2) - A, b) + d for one in z]
    np.testing.assert_allclose(found, np.polyval(num, z) / np.polyval(den, z), rtol=NEAR)


def test_overmodulation_costs_the_current_of_its_harmonics() -> None:
    inverter = replace(SURFACE.inverter, voltage_utilisation=0.62)
    source = replace(SURFACE, inverter=inverter)
    rated = ratings(source, inverter.V_max_v)
    facts = voltage_facts(source, rated, inverter.V_max_v)
    omega = rated.base_speed_rpm * math.pi / 30.0 * SURFACE.machine.pole_pairs
    flux = inverter.harmonic_flux_wb(omega)
    assert flux > 0.0
    assert facts["overmodulation_harmonic_apk"] == pytest.approx(flux / SURFACE.machine.L_d_h)


def test_a_sag_costs_torque() -> None:
    source = load_machine_file("interior-2k2")
    V = source.inverter.V_max_v
    rated, plane = ratings(source, V), at_temperature(source.machine, None)
    facts = voltage_facts(source, rated, V)
    for where, rpm in (("base_speed", rated.base_speed_rpm), ("n_max", rated.n_max_rpm)):
        omega = rpm * math.pi / 30.0 * source.machine.pole_pairs
        found = torque_limits(plane, [omega], [SAG_SHARE * V, V], rated.I_max_apk, rated.i_d_min_a).largest_nm[0]
        assert facts[f"sag_torque_share_{where}"] == pytest.approx(found[0] / found[1])


def test_an_interval_that_nobody_gave_says_why() -> None:
    box = tolerance_box(SURFACE)
    said = "; ".join(box.notes)
    assert "R_s_ohm: no standard deviation is given, 3 % assumed" in said
    assert "1 degree assumed" in said and "DC-link voltage: +-5 % assumed" in said


def test_a_band_is_made_of_runs_that_are_left_out_one_by_one() -> None:
    """Every run against mean and widest nearby variance of the others, written as loops."""
    rng, rows, n = np.random.default_rng(3), 2 * NEARBY + 10, 12
    t = np.arange(rows) * 1e-3
    runs = {
        ("step", "a"): np.sin(t) + (0.02 + 0.1 * t) * rng.standard_normal((n, rows)),
        ("step", "b"): 3.0 + 0.5 * rng.standard_normal((n, 1)) + 0.1 * rng.standard_normal((n, rows)),
        ("stop", "a"): rng.standard_normal((n, 4)),
    }
    scales = {("step", "a"): 1.0, ("step", "b"): 5.0, ("stop", "a"): 1.0}
    found = predict({"step": t, "stop": t[:4]}, runs, scales, allowances={"stop": 1.7})
    assert found.signals("step") == ("a", "b") and found.signals("stop") == ("a",)
    largest = {}
    for key, values in runs.items():
        floor, reach, worst = FLOOR_SHARE * scales[key], values.shape[1] // NEARBY, []

        def nearby(variance: np.ndarray, reach: int = reach) -> np.ndarray:
            wide = [variance[max(0, k - reach) : k + reach + 1].max() for k in range(variance.size)]
            return np.array(wide)

        for k in range(n):
            others = np.delete(values, k, axis=0)
            std = np.sqrt(nearby(others.var(axis=0, ddof=1)) + floor**2)
            worst.append(np.max(np.abs(values[k] - others.mean(axis=0)) / std))
        largest[key] = np.array(worst)
        band = found.bands[key]
        np.testing.assert_allclose(band.mean, values.mean(axis=0), rtol=NEAR, atol=NEAR)
        np.testing.assert_allclose(band.std, np.sqrt(nearby(values.var(axis=0, ddof=1)) + floor**2), rtol=1e-9)
    for experiment, allowance in (("step", MODEL_ALLOWANCE), ("stop", 1.7)):
        normal = {key: np.quantile(v, NORMALISING_QUANTILE) for key, v in largest.items() if key[0] == experiment}
        common = max(largest[key].max() / q for key, q in normal.items())
        for key, q in normal.items():
            assert found.bands[key].factor == pytest.approx(max(LEAST_FACTOR, allowance * common * q), rel=1e-9)


def test_blocks_have_as_many_samples_as_are_left() -> None:
    design = tune(SURFACE)
    task = BlockTask(margin_problem(design), tolerance_box(SURFACE), BLOCK + 17, 1, 0, 2)
    assert [len(block.values["headroom_voltage"]) for block in evaluate_blocks(task)] == [BLOCK, 17]


def test_a_table_of_one_link_reaches_to_the_speed_of_a_sagged_one() -> None:
    """The drive looks up at n U_dc / U_now; with links of its own, or by flux, it does not."""
    rated = ratings(SURFACE, 0.92 * SURFACE.inverter.V_max_v)
    machine = at_temperature(SURFACE.machine, None)
    tops = {}
    for axis, U_dc in (("speed", (210.0,)), ("speed", (180.0, 210.0)), ("flux", (210.0,))):
        request = LookupRequest(axis=axis, U_dc_v=U_dc, n_max_rpm=300.0)
        (first, uniform), _ = _Problem(machine, SURFACE, rated, request, 0.08).second_axis()
        tops[axis, len(U_dc)] = first
        assert first[[0, -1]] == pytest.approx(uniform[[0, -1]])
    assert tops["speed", 1][-1] == pytest.approx(300.0 / SAG_SHARE)
    assert tops["speed", 2][-1] == pytest.approx(300.0)
    V, omega = 0.92 * SURFACE.inverter.voltage_utilisation * 210.0, 300.0 * math.pi / 30.0 * SURFACE.machine.pole_pairs
    assert tops["flux", 1][0] == pytest.approx(V / omega, rel=1e-6)


def test_errors_between_voltages_are_over_what_is_asked() -> None:
    """Of currents between those of two voltages: half of the torque that is asked is twice the excess."""
    rated, volts = ratings(SURFACE, 0.92 * SURFACE.inverter.V_max_v), np.array([150.0, 230.0])
    machine = at_temperature(SURFACE.machine, None)
    V = 0.92 / math.sqrt(3.0) * volts
    table = speed_table(
        machine, torque_nm=np.linspace(-60.0, 60.0, 7), speed_rpm=[500.0, 700.0], V_max_v=V, I_max_apk=56.0,
        i_d_min_a=rated.i_d_min_a, U_dc_v=volts,
    )  # fmt: skip
    excess = _voltage_excess(table, GridBounds(0.5, 1e9))
    assert _voltage_excess(table, GridBounds(0.25, 1e9)) == pytest.approx([2.0 * excess[0]])
    m, worst = SURFACE.machine, 0.0
    omega = table.y * m.pole_pairs * math.pi / 30.0
    for share in (0.25, 0.5, 0.75):
        i_d, i_q = (a[..., 0] + share * (a[..., 1] - a[..., 0]) for a in (table.i_d_a, table.i_q_a))
        made = 1.5 * m.pole_pairs * (m.psi_f_wb + (m.L_d_h - m.L_q_h) * i_d) * i_q
        reach = torque_limits(machine, omega, [V[0] + share * (V[1] - V[0])], 56.0, rated.i_d_min_a)
        wanted = np.clip(table.torque_nm[:, None], reach.least_nm[:, 0], reach.largest_nm[:, 0])
        worst = max(worst, float(np.nanmax(np.abs(made - wanted))) / 0.5)
    assert excess == pytest.approx([worst], rel=1e-9)
    assert worst > 1e-3
