# SPDX-License-Identifier: MIT
"""What all estimators share: gates, intervals, covariances, noise, least squares; against other formulas for them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import optimize, stats

from pmsmtool.arrays import Array
from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.current_sensors import MINIMUM_SAMPLES, estimate_noise
from pmsmtool.estimators.estimate import (
    CHI2_REFUSE,
    CHI2_WARN,
    SensorTolerance,
    Verdict,
    chi2_gate,
    condition_gate,
    coverage_factor,
    information_bound,
    information_weights,
    scaled_covariance,
    total_half_width,
)
from pmsmtool.estimators.least_squares import DAMPING_START, central_jacobian, levenberg_marquardt, linear_solve
from pmsmtool.machine.parameters import Estimate
from pmsmtool.trace import Trace

EXACT = 1e-12
"""Formulas of the same numbers (relative); measured: below 3e-15."""
INVERSE = 1e-9
"""Two ways to the inverse of a matrix of condition 1e2 (relative); measured: below 1e-13."""


# ---- gates and intervals ----------------------------------------------------------------------------------------


def test_the_scales_of_the_sensors() -> None:
    leg = SensorTolerance(voltage_scale=1.02, bridge_difference_v=0.5, U_dc_v=50.0, bridge_threshold_v=0.4)
    assert leg.applied_scale == pytest.approx(1.02 * 1.01, rel=EXACT)
    assert leg.voltage_scale_std == pytest.approx(0.008, rel=EXACT)
    assert SensorTolerance(voltage_scale=0.97, U_dc_v=50.0).applied_scale == 0.97
    gains = SensorTolerance(current_gain=0.03, voltage_gain=0.04)
    assert gains.impedance == gains.inertia == pytest.approx(0.05, rel=EXACT) and gains.flux == 0.04


@pytest.mark.parametrize(
    ("chi2", "verdict", "factor"),
    [
        (0.3, Verdict.PASS, 1.0), (CHI2_WARN, Verdict.PASS, math.sqrt(1.25)),
        (1.26, Verdict.WARN, math.sqrt(1.26)), (CHI2_REFUSE, Verdict.WARN, math.sqrt(3.0)),
    ],
)  # fmt: skip
def test_a_residual_widens_the_deviation_and_is_marked(chi2: float, verdict: Verdict, factor: float) -> None:
    assert chi2_gate(chi2, "s") == (verdict, pytest.approx(factor, rel=EXACT))


@pytest.mark.parametrize(("chi2", "reason"), [(3.001, "E_MODEL_MISMATCH"), (math.nan, "E_NOT_CONVERGED")])
def test_a_residual_that_no_factor_explains_is_refused(chi2: float, reason: str) -> None:
    with pytest.raises(IdentificationError) as caught:
        chi2_gate(chi2, "here")
    assert caught.value.reason == reason


@pytest.mark.parametrize("dof", [1.0, 3.3, 20.0, 1e4])
def test_intervals_are_those_of_students_t(dof: float) -> None:
    t = stats.t.ppf(0.975, dof)
    assert coverage_factor(dof) == pytest.approx(t, rel=EXACT)
    estimate = Estimate(1.0, 0.3, 0.4, "1", dof=dof)
    assert total_half_width(estimate) == pytest.approx(math.sqrt((0.3 * t) ** 2 + 0.4**2), rel=EXACT)


def test_intervals_of_many_or_no_degrees_of_freedom() -> None:
    assert coverage_factor(math.inf) == coverage_factor(10_001.0) == pytest.approx(stats.norm.ppf(0.975), rel=EXACT)
    with pytest.raises(ValueError, match="0.9 degrees"):
        coverage_factor(0.9)


def test_a_bound_is_the_root_of_the_inverse_information() -> None:
    jacobian = np.random.default_rng(1).standard_normal((9, 3)) * np.array([1.0, 1e-5, 1e4])
    covariance, condition = scaled_covariance(jacobian)
    unit = jacobian / np.linalg.norm(jacobian, axis=0)
    expected = np.linalg.inv(unit.T @ unit) / np.outer(*2 * [np.linalg.norm(jacobian, axis=0)])
    assert np.allclose(covariance / expected, 1.0, rtol=0.0, atol=INVERSE)
    assert condition == pytest.approx(np.linalg.cond(unit), rel=INVERSE)
    std, same = information_bound(jacobian)
    assert std == pytest.approx(np.sqrt(np.diag(expected)), rel=INVERSE) and same == condition


@pytest.mark.parametrize("column", [np.zeros(5), np.arange(5.0)])
def test_a_parameter_that_shows_nothing_of_its_own_has_no_bound(column: Array) -> None:
    covariance, condition = scaled_covariance(np.stack([np.arange(5.0), column], axis=1))
    assert np.all(np.isinf(covariance)) and covariance.shape == (2, 2) and condition == math.inf


def test_parameters_that_cannot_be_separated_are_named() -> None:
    condition_gate(100.0, "a and b", "s", 100.0)
    with pytest.raises(IdentificationError, match=r"a and b cannot be separated.* 1.1e\+02 > 100"):
        condition_gate(110.0, "a and b", "s", 100.0)


def test_weights_of_models_are_those_of_their_criteria() -> None:
    found = information_weights([1000.0, 1000.0 + 2.0 * math.log(3.0), 1000.0 + 2.0 * math.log(6.0)])
    assert found == pytest.approx([2.0 / 3.0, 2.0 / 9.0, 1.0 / 9.0], rel=EXACT)


# ---- noise ------------------------------------------------------------------------------------------------------


def _idle(n: int, *, q: float = 1.0) -> tuple[Trace, Array]:
    currents = np.random.default_rng(2).standard_normal((2, n)) * np.array([[0.02], [0.03 * q]])
    currents += np.array([[0.5], [-0.7 * q]]) + np.linspace(0.0, 1.0, n) * np.array([[0.2], [0.1 * q]])
    signals = {"i_d_a": currents[0], "i_q_a": currents[1]}
    return Trace(np.arange(float(n)), signals, dict.fromkeys(signals, "A")), currents


def test_noise_is_the_scatter_about_a_straight_line() -> None:
    """The offsets are the means, a drift included; the sum of squares of both axes has 2 (n - 2) degrees of freedom."""
    trace, currents = _idle(MINIMUM_SAMPLES)
    noise = estimate_noise(trace)
    left = [stats.linregress(trace.t_s, i) for i in currents]
    power = sum(np.var(i) * (1.0 - fit.rvalue**2) for i, fit in zip(currents, left, strict=True)) * len(trace)
    assert noise.sigma_a == pytest.approx(math.sqrt(power / (2.0 * len(trace) - 4.0)), rel=INVERSE)
    assert (noise.offset_d_a, noise.offset_q_a) == pytest.approx(np.mean(currents, axis=1), rel=EXACT)


@pytest.mark.parametrize("hertz", [0.0521, 0.31, 0.44])
def test_what_oscillates_at_zero_current_is_no_noise(hertz: float) -> None:
    """Measured: 1.21 to 1.37 of the noise, by leakage where the line is a dozen times as large."""
    trace, currents = _idle(1024)
    plain = estimate_noise(trace).sigma_a
    for share, largest in ((1.0, 2.0), (12.0, 1.5)):
        for current, phase in zip(currents, (0.3, 1.9), strict=True):
            current += share * 0.025 * np.sin(2.0 * math.pi * hertz * trace.t_s + phase)
        found = estimate_noise(Trace(trace.t_s, dict(zip(trace.signals, currents, strict=True)), trace.units)).sigma_a
        assert plain < found < largest * plain


def test_too_few_samples_and_a_converter_that_shows_one_step_are_refused() -> None:
    assert estimate_noise(_idle(MINIMUM_SAMPLES, q=0.0)[0]).sigma_a > 0.0  # one axis that rests is no fault
    with pytest.raises(IdentificationError, match="E_EXCITATION: 255 samples"):
        estimate_noise(_idle(MINIMUM_SAMPLES - 1)[0])
    trace, _ = _idle(MINIMUM_SAMPLES)
    for name in ("i_d_a", "i_q_a"):
        trace.signals[name][:] = 0.25
    with pytest.raises(IdentificationError, match="E_SNR"):
        estimate_noise(trace)


# ---- least squares ----------------------------------------------------------------------------------------------


def _decay(x: Array) -> Array:
    t = np.linspace(0.0, 3.0, 25)
    return np.asarray(x[0] * np.exp(-x[1] * t) + x[2] - (2.0 * np.exp(-1.3 * t) + 0.4 + 0.02 * np.cos(9.0 * t)))


def test_differences_from_both_sides_are_exact_for_a_parabola() -> None:
    def parabola(x: Array) -> Array:
        return np.array([3.0 * x[0] ** 2 + x[1], x[0] * x[1], x[1] ** 2])

    found = central_jacobian(parabola, np.array([2.0, -1.0]), np.array([0.25, 0.5]))
    assert found == pytest.approx(np.array([[12.0, 1.0], [-1.0, 2.0], [0.0, -2.0]]), rel=EXACT)


def test_a_fit_is_that_of_another_optimiser() -> None:
    """Measured against scipy: 2e-10 of the parameters."""
    start, scale = np.array([1.0, 0.5, 0.0]), np.array([2.0, 1.0, 1.0])
    fit = levenberg_marquardt(_decay, start, scale)
    other = optimize.least_squares(_decay, start, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert fit.converged and fit.iterations < 15 and fit.dof == 22
    assert fit.x == pytest.approx(other.x, rel=1e-8)
    assert fit.cost == pytest.approx(2.0 * other.cost, rel=INVERSE)
    assert fit.jacobian == pytest.approx(optimize.approx_fprime(fit.x, _decay, 1e-7), abs=1e-6)  # 3e-8
    given = levenberg_marquardt(_decay, start, scale, derivative=lambda x: central_jacobian(_decay, x, 1e-6 * scale))
    assert given.x == pytest.approx(other.x, rel=1e-8)


def test_the_first_step_is_damped_and_the_damping_falls() -> None:
    """Of a straight line a step with damping d leaves d/(1 + d) of the way; it falls tenfold from step to step."""
    target, left, damping = 7.0, 1.0, DAMPING_START
    for iterations in (1, 2, 3):
        left *= damping / (1.0 + damping)
        damping /= 10.0
        fit = levenberg_marquardt(lambda x: x - target, np.zeros(1), np.ones(1), iterations=iterations)
        assert target - fit.x[0] == pytest.approx(left * target, rel=1e-4) and not fit.converged
        assert fit.iterations == iterations


def test_steps_are_judged_by_the_sizes_of_the_parameters() -> None:
    """The difference steps are 1e-5 of them, and a step below the tolerance of them is the last."""
    asked = []

    def residual(x: Array) -> Array:
        asked.append(x[0])
        return np.asarray(x - 0.5)

    fit = levenberg_marquardt(residual, np.zeros(1), np.array([1000.0]), tolerance=1e-3)
    assert asked[1:3] == pytest.approx([0.01, -0.01], rel=EXACT) and fit.converged and fit.iterations == 1


def test_a_step_that_leads_uphill_is_taken_back() -> None:
    """Newton's steps for the arc tangent run away from 3."""
    fit = levenberg_marquardt(np.arctan, np.array([3.0]), np.ones(1))
    assert fit.converged and abs(fit.x[0]) < INVERSE


def test_a_fit_that_no_step_improves_has_not_converged() -> None:
    fit = levenberg_marquardt(lambda x: x - 1.0, np.zeros(1), np.ones(1), tolerance=0.0,
                              derivative=lambda x: -np.ones((1, 1)))  # fmt: skip
    assert not fit.converged and fit.x[0] == 0.0


def test_a_parameter_that_changes_nothing_stays() -> None:
    fit = levenberg_marquardt(lambda x: np.array([x[0] - 3.0, 0.5]), np.array([0.0, 5.0]), np.ones(2))
    assert fit.converged and fit.x == pytest.approx([3.0, 5.0], rel=INVERSE)


def test_a_cost_that_hardly_falls_is_the_end_where_that_is_asked() -> None:
    """The steps have costs of 1e-6, 1e-14 and so on, of 1: the second one gains less than what is asked."""
    asked = {"cost_tolerance": 1e-5, "tolerance": 0.0}
    fit = levenberg_marquardt(lambda x: np.append(x - 1.0, 9.0), np.zeros(1), np.ones(1), **asked)
    assert fit.converged and fit.iterations == 2
    assert not levenberg_marquardt(lambda x: x - 1.0, np.zeros(1), np.ones(1), iterations=2, tolerance=0.0).converged


def test_a_weighted_line_is_that_of_polyfit() -> None:
    rng = np.random.default_rng(3)
    t, y, weight = np.linspace(1.0, 5.0, 12), rng.standard_normal(12), rng.uniform(0.5, 3.0, 12)
    x, covariance, residual, condition = linear_solve(np.stack([1e6 * t, np.ones(12)], axis=1), y, weight)
    line, expected = np.polyfit(t, y, 1, w=weight, cov="unscaled")
    assert x * np.array([1e6, 1.0]) == pytest.approx(line, rel=INVERSE)
    assert covariance * np.outer([1e6, 1.0], [1e6, 1.0]) == pytest.approx(expected, rel=INVERSE)
    assert residual == pytest.approx(weight * (y - np.polyval(line, t)), abs=INVERSE)
    unit = np.stack([weight * t / np.linalg.norm(weight * t), weight / np.linalg.norm(weight)], axis=1)
    assert condition == pytest.approx(np.linalg.cond(unit), rel=INVERSE)


def test_a_column_of_nothing_has_no_size() -> None:
    x, covariance, residual, condition = linear_solve(np.array([[2.0, 0.0], [2.0, 0.0]]), np.array([4.0, 6.0]),
                                                      np.ones(2))  # fmt: skip
    assert x == pytest.approx([2.5, 0.0]) and residual == pytest.approx([-1.0, 1.0])
    assert condition == math.inf and np.all(np.isinf(covariance))
