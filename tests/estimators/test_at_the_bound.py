# SPDX-License-Identifier: MIT
"""Values that lie on a bound, and closed forms of the rarer branches."""

from __future__ import annotations

import math
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from pmsmtool.errors import IdentificationError
from pmsmtool.estimators import estimate as gates
from pmsmtool.estimators import resistance, tracking, tracking_model
from pmsmtool.estimators.cross_check import JUDGES, CrossCheck
from pmsmtool.estimators.current_sensors import LEAST, MINIMUM_SAMPLES, SURE, SensorMismatch, estimate_noise
from pmsmtool.estimators.encoder import MINIMUM_TURNS, check_encoder_counts, estimate_encoder
from pmsmtool.estimators.flux import linkage_rows
from pmsmtool.estimators.flux.map_rows import smooth_angle
from pmsmtool.estimators.flux.voltage_flux import (
    HELD_SHARE,
    RISING,
    current_rise,
    flux_by_voltage_limit,
    voltage_drift,
)
from pmsmtool.estimators.injection import inductance, sampling_instant
from pmsmtool.estimators.injection.axis_layout import Motion
from pmsmtool.estimators.injection.inductance import _pulse_height
from pmsmtool.estimators.injection.sampling_instant import Sampling
from pmsmtool.estimators.inverter_error import InverterCurve, Modulation, curve_from_levels
from pmsmtool.estimators.resistance import Copper, copper_of, resistance_warmed
from pmsmtool.estimators.shaft.inertia_ratio import regress
from pmsmtool.estimators.shaft.mechanics import require_useful
from pmsmtool.estimators.shaft.model import DECAY_MOST, Run, _coast, _stops_after, positions
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.machine.parameters import Estimate
from pmsmtool.machine.temperature import WINDING_TOLERANCE
from pmsmtool.trace import Trace

PROFILE = Path(__file__).resolve().parents[2] / "profiles" / "interior-2k2.toml"
ROUNDING = 1e-12  # relative; measured 4e-16


def trace(t: np.ndarray, **signals: list[float] | np.ndarray) -> Trace:
    arrays = {name: np.asarray(values, dtype=float) for name, values in signals.items()}
    return Trace(t, arrays, dict.fromkeys(arrays, "1"), {"i_command_a": 4.0})


def test_a_limit_is_within_it() -> None:
    assert gates.chi2_gate(gates.CHI2_WARN, "x")[0] is gates.Verdict.PASS
    assert gates.chi2_gate(gates.CHI2_REFUSE, "x") == (gates.Verdict.WARN, math.sqrt(gates.CHI2_REFUSE))
    gates.condition_gate(5.0, "a and b", "x", limit=5.0)
    assert gates.coverage_factor(1e4) > gates.COVERAGE_FACTOR  # 1.9602 of Student, 1.9600 of Gauss
    assert gates.coverage_factor(1.0) == pytest.approx(12.7062, abs=1e-4)
    nothing = Estimate(1.0, 0.1, 0.0, "H")
    assert CrossCheck("a", "b", nothing, -0.2, 0.2).agrees
    assert CrossCheck("a", "b", nothing, 0.0, JUDGES).verdict.startswith("agrees")
    small, unsure = SensorMismatch((LEAST, -LEAST, 0.0), 0.0), SensorMismatch((SURE * 0.01, -SURE * 0.01, 0.0), 0.01)
    assert not small.corrected and not unsure.corrected


def test_the_least_samples_are_enough_for_the_noise() -> None:
    rng = np.random.default_rng(1)

    def record(n: int) -> Trace:
        return trace(1e-4 * np.arange(n), i_d_a=rng.normal(0.0, 0.1, n), i_q_a=rng.normal(0.0, 0.1, n))

    estimate_noise(record(MINIMUM_SAMPLES))
    with pytest.raises(IdentificationError, match="E_EXCITATION"):
        estimate_noise(record(MINIMUM_SAMPLES - 1))


def test_what_a_leg_swings_beyond_the_link_scales_the_voltage() -> None:
    assert gates.SensorTolerance(voltage_scale=1.25, bridge_difference_v=2.0, U_dc_v=100.0).applied_scale == 1.275
    assert gates.SensorTolerance(voltage_scale=1.25, U_dc_v=100.0).applied_scale == 1.25
    assert _pulse_height(0.0, "d", 300.0) == pytest.approx(200.0, rel=ROUNDING)  # legs at 1, -1/2, -1/2
    assert _pulse_height(0.0, "q", 300.0) == pytest.approx(300.0 / math.sqrt(3.0), rel=ROUNDING)


def test_the_winding_of_a_file() -> None:
    file = load_machine_file(PROFILE)
    machine = replace(file.machine, R_winding_ohm=3.0)
    name = "R_winding_ohm"
    assert copper_of(replace(file, machine=machine, std={}, systematic={})).winding_half_ohm == WINDING_TOLERANCE * 3.0
    stated = replace(file, machine=machine, std={name: 0.1}, systematic={name: 0.05})
    assert copper_of(stated).winding_half_ohm == pytest.approx(0.1 * gates.COVERAGE_FACTOR + 0.05, rel=ROUNDING)
    assert copper_of(replace(file, machine=replace(machine, R_winding_ohm=None), std={})).winding_half_ohm == 0.0


def test_a_resistance_follows_its_copper() -> None:
    """Copper alone: R (235 + T)/(235 + T_R); with devices, only the copper's share of it."""
    alpha = 1.0 / (235.0 + 20.0)
    R = Estimate(2.0, 0.01, 0.0, "ohm", T_c=30.0)
    assert resistance_warmed(R, 80.0, Copper(20.0, alpha)) == pytest.approx(2.0 * 315.0 / 265.0, rel=ROUNDING)
    shared = resistance_warmed(R, 80.0, Copper(20.0, alpha, R_winding_ohm=1.5))
    assert shared == pytest.approx(2.0 + 1.5 * alpha * 50.0, rel=ROUNDING)  # stated at 20 degC
    assert resistance_warmed(R, math.nan, Copper(20.0, alpha)) == 2.0


def test_motion_without_viscous_friction_is_a_parabola() -> None:
    J, drive, omega, t = 0.5, -4.0, 3.0, 0.2
    assert _coast(omega, drive, 0.0, J, t) == pytest.approx((omega * t + drive * t * t / (2.0 * J), 1.4), rel=ROUNDING)
    assert _stops_after(omega, drive, 0.0, J) == pytest.approx(0.375, rel=ROUNDING)
    assert _stops_after(2.0, -4.0, -2.0, J) == math.inf  # negative friction holds it: it never stops


@pytest.mark.parametrize("x", [1.0, DECAY_MOST])
def test_a_shaft_that_decays_within_the_record(x: float) -> None:
    """theta = omega J/B (1 - e^(-B t/J)), also where e^(B t/J) is beyond every number."""
    n, T, omega = 200, 1.0, 3.0
    found = positions(np.zeros(n), T, np.array([0.0, x, 0.0, 0.5, omega]))
    assert found == pytest.approx(0.5 - omega / x * np.expm1(-x * T * np.arange(n + 1.0)), rel=1e-9)  # measured 1e-15


def test_pairs_hold_one_size_in_both_directions() -> None:
    def pairs(i_d: tuple[float, float], i_q: float = 0.0, w: tuple[float, float] = (10.0, 9.0)) -> int:
        rows = trace(np.arange(2.0), i_d_a=list(i_d), i_q_a=[0.0, i_q], omega_e_rad_s=list(w))
        return len(linkage_rows.pairs_of(rows))

    assert pairs((-5.0, 5.0)) == 1
    assert pairs((-5.0, linkage_rows.PAIR_RATIO * 5.0)) == 0
    assert pairs((-5.0, 5.0), i_q=linkage_rows.Q_SHARE * 5.0) == 0
    assert pairs((-5.0, 5.0), w=(10.0, 0.0)) == 0
    assert pairs((-5.0, 5.0), w=(10.0, -9.0)) == 0


def test_the_course_of_the_current_within_a_period() -> None:
    """A late sample sees another flux of i_d, w^2 psi ((t - T/2)^2 - T^2/12)/2; u_q holds its change times w."""
    T, w, psi, L = 1e-4, np.array([400.0, -500.0]), 0.5, (5e-3, 8e-3)
    one = np.ones(2)
    speeds = trace(np.arange(2.0), i_d_a=3.0 * one, i_q_a=0.0 * one, u_d_v=0.0 * one, u_q_v=w * psi,
                   omega_e_rad_s=w, omega_first_rad_s=w, omega_second_rad_s=w, half_s=one)  # fmt: skip
    switched = Modulation(500.0, L, T, 0.0)
    late = linkage_rows.corrected(speeds, 0.0, T, None, switched, 0.0, Sampling(0.25 * T))
    fresh = linkage_rows.corrected(speeds, 0.0, T, None, switched, 0.0)
    of_instant = [0.5 * w**2 * psi * T**2 * (a - 1.0 / 12.0) for a in (1.0 / 16.0, 1.0 / 4.0)]
    assert late.u_q - fresh.u_q == pytest.approx(w * (of_instant[0] - of_instant[1]), rel=1e-6)


def test_columns_that_are_nearly_one_another_are_refused() -> None:
    x = np.random.default_rng(2).normal(size=50)
    with pytest.raises(IdentificationError, match="condition"):
        regress([x, x + 1e-9 * x[::-1]], x, what="a and b", stage="x")
    assert regress([x, x[::-1]], 2.0 * x, what="a and b", stage="x") == pytest.approx([2.0, 0.0], abs=ROUNDING)


def test_a_current_that_rises() -> None:
    assert current_rise(trace(np.arange(4.0), i_q_a=[1.0, 1.0, 2.0, 2.0])) == 0.25


@pytest.mark.parametrize("t", [0.05, 0.3, 0.7])
def test_a_lag_rounds_periodic_pulses(t: float) -> None:
    """Against the lag's exponentials one after another, before, within and after the pulse."""
    on, off, lag = 0.2, 0.5, 0.15
    rise, fall = math.exp(-(off - on) / lag), math.exp(-(1.0 - off + on) / lag)
    begun = (1.0 - rise) * fall / (1.0 - rise * fall)  # where the pulse begins
    ended = 1.0 + (begun - 1.0) * rise
    expected = (
        begun * math.exp((on - t) / lag) if t < on
        else 1.0 + (begun - 1.0) * math.exp((on - t) / lag) if t < off
        else ended * math.exp((off - t) / lag)
    )  # fmt: skip
    found = sampling_instant._lagging(np.array([on]), np.array([off]), t, lag, 1.0)
    assert found[0] == pytest.approx(expected, rel=ROUNDING)


def test_what_binary32_rounds_is_no_step_of_an_encoder() -> None:
    t = np.linspace(0.0, 1.0, 400)
    theta = (300.0 + 3.0 * t + 8.0 * t**2).astype(np.float32).astype(np.float64)
    i = np.stack([np.cos(theta), np.sin(theta)])
    assert smooth_angle(theta, i, 0.1 * i[::-1], 1e-3) is theta


def test_half_of_the_voltage_error_and_calm_windows_belong_to_them() -> None:
    tail = tracking_model.tail_of(InverterCurve(np.array([1.0, 2.0, 4.0]), np.array([1.0, 2.0, 4.0]), 0.0))
    assert tail.u_error_v == pytest.approx(np.array([1.0, 2.0, 4.0]) * 2.0 / np.array([3.0, 4.0, 6.0]))
    rises = trace(np.arange(4.0), d_rise_a=[0.5, -0.5, 0.6, 0.0], q_rise_a=[0.0] * 4, omega_rise_rad_s=[0.0] * 4)
    limit = dict.fromkeys(tracking_model.RISES, 0.5)
    assert tracking_model._calm(rises, limit).tolist() == [True, True, False, False]


def test_levels_of_one_current_are_one_point_of_the_curve() -> None:
    curve = curve_from_levels(np.array([10.0, -11.0]), np.array([1.0, -2.0]))
    phase = math.cos(math.pi / 6.0)  # current of a phase beside one without
    assert curve.i_phase_a == pytest.approx([10.5 * phase]) and curve.u_error_v == pytest.approx([1.5 * phase])
    assert curve.vector_error_v(np.array([10.5, -21.0])) == pytest.approx([1.5, -1.5])
    assert len(curve_from_levels(np.array([10.0, -11.1]), np.array([1.0, -2.0])).i_phase_a) == 2


def test_what_stands_still_at_the_voltage_limit_says_nothing() -> None:
    t = 0.01 * np.arange(16)

    def limit(theta: np.ndarray, first: float, second: float) -> float:
        i = np.repeat([first, second], 8)
        top = trace(t, theta_M_rad=theta, i_q_a=i, U_dc_v=300.0 + 0.0 * t)
        return flux_by_voltage_limit(top, pole_pairs=4, utilisation=0.5).value

    with pytest.raises(IdentificationError, match="the speed at the voltage limit is not steady"):
        limit(0.0 * t, 0.0, 0.0)
    assert limit(50.0 * t, HELD_SHARE * 4.0, HELD_SHARE * 4.0) == pytest.approx(0.5 * 300.0 / 200.0)
    assert limit(50.0 * t, 0.0, RISING * 4.0) == pytest.approx(0.5 * 300.0 / 200.0)
    for first, second in ((3.5, 3.5), (0.0, 0.1)):
        with pytest.raises(IdentificationError):
            limit(50.0 * t, first, second)
    t = 0.01 * np.arange(40)
    coast = trace(t, theta_M_rad=50.0 * t, u_d_v=0.0 * t, u_q_v=0.0 * t)
    assert voltage_drift(coast) == 0.0


def test_the_least_way_shows_an_encoder() -> None:
    """A quarter of what 64 pole pairs would turn."""
    for measured, told in ((0.25, nullcontext()), (0.249, pytest.raises(IdentificationError, match="E_ENCODER"))):
        with told:
            check_encoder_counts(trace(np.arange(2.0), theta_imposed_rad=[0.0, 64.0], theta_M_rad=[0.0, measured]))


def test_a_rotation_without_any_deviation_meets_every_limit() -> None:
    theta = np.linspace(0.0, 8.0, 129)
    ahead = trace(theta, theta_imposed_rad=4.0 * theta, theta_M_rad=theta)
    back = trace(theta, theta_imposed_rad=4.0 * theta[::-1], theta_M_rad=theta[::-1])
    found = estimate_encoder(ahead, back, limit_rad=0.0)
    assert (found.pole_pairs.value, found.direction) == (4.0, 1)


def test_a_rotation_may_be_just_long_enough() -> None:
    way = MINIMUM_TURNS * math.tau
    for last, told in ((way, nullcontext()), (0.999 * way, pytest.raises(IdentificationError, match="times, 0.98"))):
        theta = np.linspace(0.0, last, 129)
        runs = (trace(theta, theta_imposed_rad=3.0 * part, theta_M_rad=part) for part in (theta, theta[::-1]))
        with told:
            estimate_encoder(*runs)


def test_friction_that_may_be_just_all_of_the_torque_is_useful() -> None:
    run = Run(np.zeros(3), np.full(2, 0.25 * gates.COVERAGE_FACTOR), 1.0, np.ones(3), 0.0, False)
    require_useful([run], 0.0, 0.25)
    with pytest.raises(IdentificationError, match="friction is known to"):
        require_useful([run], 0.0, 0.2501)


def test_a_resistance_of_nothing_is_none() -> None:
    with pytest.raises(IdentificationError, match="cannot be separated"):
        resistance._check_result(0.0, 0.0, math.inf)
    resistance._check_result(2.0, 0.1, gates.COVERAGE_FACTOR * 0.1 / 2.0)


@pytest.mark.parametrize("lines", [0, 1, 5])
def test_a_fit_is_made_again_while_a_line_is_left(monkeypatch: pytest.MonkeyPatch, lines: int) -> None:
    """Whatever its chi-square: 1.8 of it was ripple of a link, and eddy currents took it for theirs."""
    fit, made = SimpleNamespace(chi2=1.0, residuals=[np.zeros(1)], motion_per_f=9.0), []
    monkeypatch.setattr(inductance, "fit_axis", lambda *_, **__: made.append(1) or fit)
    monkeypatch.setattr(inductance, "with_line", lambda shot, _: min(shot + 1, lines))
    shots = {axis: [cast(Any, 0)] for axis in "dq"}
    assert inductance._fitted(shots, 0.1, 1.0, None, None) == {"d": fit, "q": fit}
    assert len(made) == 2 * (1 + min(lines, inductance.LINES_MOST))


@pytest.mark.parametrize(("moved", "again"), [(12.0, False), (11.9, True), (8.1e1, True)])
def test_a_rotor_that_does_not_follow_as_pushes_say_is_fitted_without_them(
    monkeypatch: pytest.MonkeyPatch, moved: float, again: bool
) -> None:
    """Friction holds it: L_q of a motor of 1.2 A came out 50 % too large. The d axis moves nothing."""
    made: list[tuple[bool, Motion | None]] = []

    def fit_axis(*_: object, torque: bool, motion: Motion | None = None, **__: object) -> SimpleNamespace:
        made.append((torque, motion))
        return SimpleNamespace(residuals=[np.zeros(1)], motion_per_f=moved if torque else 0.0)

    monkeypatch.setattr(inductance, "fit_axis", fit_axis)
    monkeypatch.setattr(inductance, "with_line", lambda shot, _: shot)
    said = Motion(30.0, 6.0)
    inductance._fitted({axis: [cast(Any, 0)] for axis in "dq"}, 0.1, 1.0, said, None)
    assert made == [(False, said), (True, said), *[(True, None)] * again]


def test_a_q_current_of_the_least_share_is_one() -> None:
    T, one = 1e-4, np.ones(2)
    speeds = trace(np.arange(2.0), i_d_a=-2.0 * one, i_q_a=linkage_rows.Q_SHARE * 2.0 * one, u_d_v=one, u_q_v=one,
                   omega_e_rad_s=500.0 * one, omega_first_rad_s=500.0 * one, omega_second_rad_s=500.0 * one,
                   half_s=one)  # fmt: skip
    assert not linkage_rows.corrected(speeds, 0.0, T, None, None, 0.0).is_d.any()


def test_noise_is_widened_until_it_agrees_or_is_twice_the_assumed(monkeypatch: pytest.MonkeyPatch) -> None:
    for nis, inflation in ((tracking.NIS_GATE[1], 1.0), (4.0, 4.0)):  # from twice the noise on once more
        monkeypatch.setattr(tracking, "_pass", lambda *_, nis=nis: (None, nis, 0.0))
        nothing = cast(Any, None)
        assert tracking._consistent(nothing, nothing, nothing, (0.1, 0.1), 0.0).inflation == inflation
