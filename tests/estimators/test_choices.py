# SPDX-License-Identifier: MIT
"""Where an estimator chooses: which fit explains, which swing is one, which knee, which ripple; both sides."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from pmsmtool.arrays import Array
from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.angle_harmonics import AngleHarmonics, Harmonic
from pmsmtool.estimators.encoder import PER_TURN_LEAST_RAD, PER_TURN_SURE, EncoderResult, _per_turn
from pmsmtool.estimators.flux import map_fit
from pmsmtool.estimators.flux.coenergy_spline import CoenergySpline
from pmsmtool.estimators.inverter_error import InverterCurve
from pmsmtool.estimators.least_squares import Fit
from pmsmtool.estimators.shaft import frequency_response as fr
from pmsmtool.estimators.shaft import mechanics, response_lines
from pmsmtool.estimators.shaft.disturbances import Disturbances, Extent
from pmsmtool.estimators.shaft.model import Run
from pmsmtool.identification import swing
from pmsmtool.machine.parameters import Estimate
from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace
from tests.estimators.traces import trace_of

# ---- which swing is one -----------------------------------------------------------------------------------------


def _swing_of(
    monkeypatch: pytest.MonkeyPatch, peaks: dict[float, float], resonance: float = 0.0, doubt: float = 0.0
) -> float:
    """What is told of pushes of 0.2 s at 1 kHz that swing explains so: at a frequency and a percent around it."""

    def explained(hz: float) -> float:
        return max((share for at, share in peaks.items() if abs(hz / at - 1.0) < 0.04), default=0.0)

    monkeypatch.setattr(swing, "_explained", lambda *_: explained)
    t = 3.0 + 1e-3 * np.arange(201)
    return swing.swing_of([trace_of(t, x=t), trace_of(t[:101], x=t[:101])], lambda d, q: q, resonance, doubt)


def test_a_swing_must_explain_half_of_what_a_rigid_shaft_leaves(monkeypatch: pytest.MonkeyPatch) -> None:
    for share, found in ((0.5, True), (0.499, False)):
        assert (_swing_of(monkeypatch, {80.0: share}) > 0.0) is found
    assert _swing_of(monkeypatch, {80.0: 0.9}) == pytest.approx(80.0, rel=0.05)
    assert _swing_of(monkeypatch, {10.0: 0.9}) == 0.0  # two swings of the longest: the slowest is friction
    assert _swing_of(monkeypatch, {11.0: 0.9}) > 10.3
    assert _swing_of(monkeypatch, {210.0: 0.9}) == 0.0  # a fifth of the rows' rate is 200
    slow = _swing_of(monkeypatch, {16.0: 0.9})
    assert _swing_of(monkeypatch, {16.0: 0.9}, 0.5 * slow) == slow  # twice a resonance is another


def test_another_resonance_is_twice_the_claimed_one_and_that_explains_less_than_half_as_much(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert _swing_of(monkeypatch, {70.0: 0.8}, 30.0) == pytest.approx(70.0, rel=0.05)
    assert _swing_of(monkeypatch, {50.0: 0.8, 30.0: 0.3}, 30.0) == 0.0
    for claimed, found in ((0.39, True), (0.4, False)):
        assert (_swing_of(monkeypatch, {70.0: 0.8, 30.0: claimed}, 30.0) > 0.0) is found
    for claimed in (27.0, 33.0):  # within its doubt it is looked for, too
        assert _swing_of(monkeypatch, {70.0: 0.8, claimed: 0.7}, 30.0, 3.0) == 0.0
    for most, claimed, found in ((0.2, 0.019, True), (0.199, 0.0, False), (0.3, 0.03, False), (0.3, 0.029, True)):
        assert (_swing_of(monkeypatch, {50.0: most, 30.0: claimed}, 30.0) > 0.0) is found  # a bounce: at any distance
    assert _swing_of(monkeypatch, {80.0: 0.9}, 170.0) == 0.0  # nothing is left between 1.2 of it and 200 Hz


# ---- which fit explains -----------------------------------------------------------------------------------------


def _fitted(noises: Sequence[float | None]) -> Any:
    """A fit of the whole traces and of their fast part, with so much noise of the torque each; None: refused."""
    theta, torque = np.linspace(0.0, 1.0, 11), np.ones(10)
    answers = iter(noises)

    def fitted(runs: Sequence[Trace]) -> Any:
        noise = next(answers)
        if noise is None:
            raise refuse("E_NOT_CONVERGED", "none", stage="s")
        blocks = [Run(theta, torque, 0.1, np.ones(11), 1e-3, False)]
        return blocks, len(runs[0]), 1.0, [Run(theta, torque, 0.1, np.ones(11), noise, False)]

    return fitted


@pytest.mark.parametrize(
    ("noises", "whole"),
    [
        ([1.9e-3], True),
        ([2.1e-3, 2.0e-3], False),
        ([2.1e-3, 2.2e-3], True),
        ([2.1e-3, None], True),
        ([None, 9.0], False),
    ],
)
def test_the_fast_part_of_the_traces_is_taken_where_it_needs_less_noise(
    noises: Sequence[float | None], whole: bool
) -> None:
    t = 0.01 * np.arange(400)
    run = trace_of(t, theta_M_rad=np.where(t < 2.0, 3.0 * t, 6.0 + 0.1 * (t - 2.0)))
    found = mechanics._explained(_fitted(noises), [run])
    assert (found[1] == 400) is whole
    with pytest.raises(IdentificationError, match="E_NOT_CONVERGED"):
        mechanics._explained(_fitted([None, None]), [run])


def _fit(x: Sequence[float]) -> Fit:
    return Fit(np.array(x), np.ones(90), np.zeros((90, len(x))), True, 5)


def test_cogging_is_taken_along_with_the_inertia_of_the_fit_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """And with orders that its residual shows; what it says beyond shaft and states is not kept for the next."""
    t = 1e-2 * np.arange(101.0)
    traces = [
        trace_of(t, {"coasting": k % 2 == 1}, theta_M_rad=0.01 * np.floor(1e2 * (t + t * t)), flagged=0.0 * t)
        for k in range(4)
    ]
    one = Run(np.linspace(0.0, 1.0, 101), np.full(100, 0.5), 1e-2, np.full(101, 1e-4), 1e-4, False)
    cogging = AngleHarmonics((), (Harmonic(6, 3.0, 0.0, 0.1),), 2.0)
    begun, first = np.array([math.log(2e-3), 1e-3, 0.05, *range(8)]), [math.log(3e-3), 2e-3, 0.06]
    states = [10.0 + k for k in range(8)]
    inertias: list[float] = []
    orders: list[Sequence[int]] = []
    starts: list[list[float]] = []

    def blocks(run: Trace, *given: Any) -> tuple[Array, Run]:
        assert given[-2].acceleration_rad_s2 is cogging.acceleration_rad_s2
        inertias.append(given[-1])
        return one.theta, one

    def fit(runs: Sequence[Run], start: Array, elastic: bool) -> tuple[Fit, float, Sequence[Run]]:
        starts.append(start.tolist())
        return _fit([*first, 7.0, 8.0, 9.0, *states]), 1.0, [replace(run, torque_std=1e-2) for run in runs]

    def shapes(theta: Array, torque: Array, T: float, extent: Extent, pole_pairs: int) -> Disturbances:
        orders.append(extent.orders)
        return one.disturbances

    def enough(runs: Sequence[Run], residual: Array, *, slow: bool) -> Sequence[Run]:
        assert slow and runs[0].torque_std == 1e-2
        raise Enough

    class Enough(Exception):
        pass

    for name, value in (
        ("angle_harmonics", lambda *_: cogging), ("_blocks", blocks), ("disturbances", shapes), ("noisier", enough),
        ("_start", lambda _: begun), ("_fit", fit), ("cogging_orders", lambda runs, fit: [9, 4]),
    ):  # fmt: skip
        monkeypatch.setattr(mechanics, name, value)
    with pytest.raises(Enough):
        mechanics.estimate_mechanics(traces, lambda d, q: q, 1.0, 0.01, 0.02)
    assert inertias == pytest.approx([0.0] * 4 + [2e-3] * 4 + [3e-3] * 8)
    assert starts == [begun.tolist(), [*first, *states], [*first, *states]]
    assert orders == [()] * 12 + [[9, 4]] * 4, "what the residual of a fit shows is in the next"


def test_noise_of_the_torque_is_refused_beyond_its_limit_unless_it_is_expected(monkeypatch: pytest.MonkeyPatch) -> None:
    run = Run(np.linspace(0.0, 1.0, 101), np.full(100, 0.5), 4e-3, np.full(101, 1e-4), 1e-4, False)
    found = _fit([0.0] * 6)
    monkeypatch.setattr(mechanics, "_minimum", lambda *_: found)
    monkeypatch.setattr(mechanics, "noisier", lambda runs, *_, **__: runs)

    def fitted(noise: float, *, elastic: bool) -> Fit:
        monkeypatch.setattr(mechanics, "torque_noise", lambda _: {False: noise, True: 0.0})
        return mechanics._fit([run], np.zeros(5), elastic)[0]

    assert fitted(mechanics.RIPPLE_MOST, elastic=False) is found and fitted(0.2, elastic=True) is found
    told = r"torque off by 20 % of that of the pulses, and more, from one 4 ms to the next, limit 15 %"
    with pytest.raises(IdentificationError, match=told):
        fitted(0.2, elastic=False)


# ---- which knee, which slope ------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_the_knee_is_the_ramp_that_fits_best(seed: int) -> None:
    """Against another optimiser from every point; measured: 2e-8."""
    rng = np.random.default_rng(seed)
    i = np.geomspace(0.1, 10.0, 14)
    u = -2.0 * np.tanh(i / rng.uniform(0.3, 3.0)) * rng.uniform(0.95, 1.05, 14)
    found = InverterCurve(i, u, 0.0).knee_a(-2.0)

    def cost(log_knee: float) -> float:
        return float(np.sum((u / -2.0 - np.minimum(1.0, i / math.exp(log_knee))) ** 2))

    tried = [minimize_scalar(cost, bracket=(math.log(x), math.log(x) + 0.05)) for x in np.geomspace(0.1, 10.0, 25)]
    assert cost(math.log(found)) <= min(one.fun for one in tried) * (1.0 + 1e-6)
    assert InverterCurve(i, u, 0.0).knee_a(0.0) == 0.1


def test_inductances_below_a_tenth_of_their_median_are_told_with_it() -> None:
    """psi_d = L (i - i^3/300): its slope falls from L to nothing at 10 A, within the circle of the data."""
    spline = CoenergySpline.over(np.array([-12.0, 12.0]), np.array([-12.0, 12.0]), (5, 5))
    d, q = (grid.ravel() for grid in np.meshgrid(*2 * [np.linspace(-12.0, 12.0, 40)], indexing="ij"))
    rows = np.concatenate([spline.derivative(d, q, 1, 0), spline.derivative(d, q, 0, 1)])
    x = np.linalg.lstsq(rows, np.concatenate([1e-3 * (d - d**3 / 300.0), 2e-3 * q]), rcond=None)[0]
    i = np.array([[-10.5, 10.5, 0.0], [0.0, 0.0, 10.5]])
    found, least = map_fit._falling(spline, x, i)
    axis_d, axis_q = np.linspace(-10.5, 10.5, 50), np.linspace(0.0, 10.5, 50)
    i_d, i_q = (grid.ravel() for grid in np.meshgrid(axis_d, axis_q, indexing="ij"))
    inside = np.hypot(i_d, i_q) <= 10.5
    L = 1e-3 * (1.0 - i_d[inside] ** 2 / 100.0)
    bound = 0.1 * np.median(L)
    assert (
        least == pytest.approx(np.full(np.count_nonzero(bound > L), bound), rel=1e-3) and len(found) == len(least) > 3
    )
    assert found @ x == pytest.approx(L[bound > L], abs=1e-6)


# ---- which order ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("once", "differs", "clear"),
    [(1.01, 0.0, True), (0.99, 0.0, False), (4.0, 0.99, True), (4.0, 1.01, False)],
)
def test_an_error_of_the_encoder_is_large_and_alike_in_both_directions(
    once: float, differs: float, clear: bool
) -> None:
    """In units of 2 mrad; what the directions do not share counts four times."""
    size = once * PER_TURN_LEAST_RAD
    apart = differs * size / PER_TURN_SURE
    runs = []
    for sign in (1.0, -1.0):
        theta = np.arange(0.0, 2.0 * math.pi, 2.0 * math.pi / 720.0)
        off = size * np.cos(theta - 0.4) + sign * apart * np.cos(theta - 2.0) + 0.3 * size * np.sin(2.0 * theta)
        runs.append(trace_of(theta, theta_M_rad=theta, theta_imposed_rad=-5.0 * (theta - off)))
    turned = _per_turn(runs[0], runs[1], -1, 5)
    assert (turned[0].cosine, turned[0].sine) == pytest.approx((-size * math.cos(0.4), size * math.sin(0.4)), rel=1e-6)
    assert turned[0].std == pytest.approx(apart, rel=1e-6, abs=1e-12)
    found = EncoderResult(Estimate(5.0, 0.0, 0.0, "1"), -1, Estimate(0.0, 0.0, 0.0, "rad"), 0.0, turned).per_turn_rad
    assert found[0] == pytest.approx(size if clear else 0.0, rel=1e-6, abs=1e-12)
    assert found[1] == pytest.approx(0.3 * size if 0.3 * size > PER_TURN_LEAST_RAD else 0.0, rel=1e-6, abs=1e-12)


def test_one_pole_pair_has_orders_to_compare_with_too() -> None:
    theta = np.arange(0.0, 2.0 * math.pi, 2.0 * math.pi / 720.0)
    run = trace_of(theta, theta_M_rad=theta, theta_imposed_rad=theta - 0.01 * np.cos(theta))
    once, twice = _per_turn(run, run, 1, 1)
    assert (once.amplitude, twice.amplitude) == pytest.approx((0.01, 0.0), abs=1e-9)
    assert once.std == twice.std == math.inf, "once per electrical turn: offsets of the current sensors have it, too"


@pytest.mark.chain
@pytest.mark.parametrize("amplitude", [0.3, 0.005, 0.001])
def test_a_torque_over_the_angle_that_one_mass_leaves_is_taken_along(amplitude: float) -> None:
    """Its transforms come back with size and phase, where it stands out of the noise: off by 2.2 and 0.7 deviations."""
    rng = np.random.default_rng(101)
    n, T, J, order = 2502, 4e-4, 2e-3, 7
    t = T * np.arange(n)
    runs, torques, ripples = [], [], []
    for _ in range(3):
        theta = 25.0 * t + 0.5 * np.cumsum(rng.standard_normal(n)) * T
        torques.append(rng.standard_normal(n))
        ripples.append(amplitude * np.cos(order * theta - 0.6))
        runs.append(trace_of(t, theta_M_rad=-theta))
    omega, U, _, _ = response_lines.transforms(runs, torques, -1)
    ripple = response_lines.transforms(runs, ripples, -1)[1]
    noise = rng.standard_normal(U.shape) + 1j * rng.standard_normal(U.shape)
    Y = (U + ripple) / J + 300.0 * noise
    inner = slice(fr.HALF_WIDTH, U.shape[1] - fr.HALF_WIDTH)
    sigma = np.full(U.shape[1], 300.0 * math.sqrt(2.0))[inner]
    lines = fr._Lines(omega[inner], np.exp(-1j * omega[inner] * T), T, U[:, inner], Y[:, inner], sigma)
    rigid = fr._fit(lines, fr._rigid, np.array([math.log(1.0 / J), 0.0]))
    found = fr._ripple(lines, rigid, runs, -1, U.shape[1])
    # what it explains of white noise, against what the information criterion asks of two more numbers
    gain = 2.0 * float(np.sum(np.abs(ripple[:, inner] / J) ** 2 / sigma**2))
    asked = 2.0 * math.log(len(rigid.residual)) + 10.0
    assert (found is None) is (gain < asked)
    if found is not None:
        assert float(np.linalg.norm(found - ripple)) < 3.0 * math.sqrt(2.0 / gain) * float(np.linalg.norm(ripple))
