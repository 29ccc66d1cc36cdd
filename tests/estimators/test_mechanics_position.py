# SPDX-License-Identifier: MIT
"""The encoder's step and the rounding of positions that a recorder carries in binary32."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.mechanics_accuracy import realisation
from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.estimate import CHI2_WARN
from pmsmtool.estimators.shaft.mechanics import estimate_mechanics
from pmsmtool.estimators.shaft.model import positions
from pmsmtool.estimators.shaft.position import encoder_step, position_std, rounding_rad
from pmsmtool.trace import Trace

STEP_LIMIT = 0.01
"""Measured on these: 3e-6 at most; the smallest second difference alone is off by up to 0.13."""

COARSE_LIMIT = 0.1
"""Deviation of J at 60 and 140 steps; see there for what was measured."""
WIDER = 1.1
"""Growth of the fit's deviations by binary32; measured 1.01."""


def turning(bits: int, far_rad: float, seed: int = 1) -> NDArray[np.float64]:
    """Positions of a shaft that speeds up, of an encoder, without the recorder's rounding."""
    step = 2.0 * math.pi / 2**bits
    t = np.linspace(0.0, 1.0, 2000)
    return step * np.floor((far_rad * t**2 + np.random.default_rng(seed).uniform(0.0, step)) / step)


@pytest.mark.parametrize("bits", [12, 17, 18, 19])
@pytest.mark.parametrize("far_rad", [20.0, 600.0])
def test_the_encoder_s_step_is_seen_below_the_rounding_of_large_angles(bits: int, far_rad: float) -> None:
    traces = [turning(bits, part * far_rad) for part in (0.1, 1.0)]
    true = 2.0 * math.pi / 2**bits
    for recorded in (traces, [theta.astype(np.float32).astype(np.float64) for theta in traces]):
        assert encoder_step(recorded) == pytest.approx(true, rel=STEP_LIMIT)


def test_a_fine_encoder_s_step_is_seen_on_a_shaft_that_changes_its_speed_by_many_of_them_from_row_to_row() -> None:
    """A push to 800 rad/s in 0.18 s and coasting: second differences are 56 and 1000 steps of 22 bits, and more."""
    true = 2.0 * math.pi / 2**22
    t, slow = 1.38e-4 * np.arange(1300), 1.38e-3 * np.arange(380)
    ways = -1.6 + 2200.0 * t**2, 0.5 + 520.0 * slow - 400.0 * slow**2
    shown = [true * np.floor(way / true) for way in ways]
    for recorded in (shown, [theta.astype(np.float32).astype(np.float64) for theta in shown]):
        assert encoder_step(recorded) == pytest.approx(true, rel=STEP_LIMIT)


def test_the_deviation_of_a_position_is_the_encoder_s_and_grows_with_binary32() -> None:
    rng = np.random.default_rng(2)
    step = 2.0 * math.pi / 2**19
    for far_rad in (3.0, 100.0, 600.0):
        theta = rng.uniform(0.9 * far_rad, far_rad, 20_000)
        stepped = step * np.round(theta / step)
        recorded = stepped.astype(np.float32).astype(np.float64)
        for shown in (stepped, recorded):
            std = position_std(shown, step)
            assert np.std((shown - theta) / std) == pytest.approx(1.0, abs=0.03)  # measured 0.01
    assert np.all(rounding_rad(stepped) == 0.0)
    assert rounding_rad(np.array([600.0])) == pytest.approx(2.0**-14)


def test_a_shaft_that_stands_still_is_refused() -> None:
    with pytest.raises(IdentificationError, match="E_EXCITATION"):
        encoder_step([np.zeros(100), turning(17, 20.0)])


@pytest.mark.chain
def test_binary32_makes_no_torque_noise_of_the_coasting() -> None:
    """With a step that is a rounding too small, the residual asks for noise of the coasting: B by ten times worse."""
    rng = np.random.default_rng(5)
    seen = 0
    while seen < 2:
        traces, truth, per_a, sigma = realisation(rng)
        step = encoder_step([trace["theta_M_rad"] for trace in traces])
        if max(float(np.max(np.abs(trace["theta_M_rad"]))) for trace in traces) < 300.0 or step > 3e-5:
            continue
        seen += 1
        fine = estimate_mechanics(traces, lambda i_d, i_q, k=per_a: k * i_q, per_a, sigma, 0.0)
        found = estimate_mechanics([*map(single, traces)], lambda i_d, i_q, k=per_a: k * i_q, per_a, sigma, 0.0)
        assert found.chi2 < CHI2_WARN and not found.unexplained
        for k, (value, true) in enumerate(zip((found.J, found.B, found.tau_c), truth, strict=True)):
            assert found.fit_std[k] < WIDER * fine.fit_std[k]
            assert abs(value.value - true) < 4.0 * value.std


def single(trace: Trace) -> Trace:
    """Return the trace as a recorder carries it, in binary32."""
    theta = trace["theta_M_rad"].astype(np.float32).astype(np.float64)
    return replace(trace, signals={**trace.signals, "theta_M_rad": theta})


@pytest.mark.chain
@pytest.mark.parametrize("steps", [60.0, 140.0])
def test_few_steps_of_a_coarse_encoder_leave_a_wide_interval_that_holds_the_truth(steps: float) -> None:
    """A direct drive for 165 rpm, 11 bits: its pulses turn by 73 steps, and J was refused below 200."""
    rng, off = np.random.default_rng(8), []
    per_a, current, unit, step = 0.9, 4.0, 0.2, 2.0 * math.pi / 2**11
    speed = 2.0 * steps * step / unit
    J, B, tau_c = per_a * current * unit / speed, 0.01 * per_a * current / speed, 0.02 * per_a * current
    for _ in range(4):
        traces, omega = [], 0.0
        for i, seconds in ((current, unit), (0.0, 6.0 * unit), (-current, 2.0 * unit), (0.0, 6.0 * unit)):
            rows = 1000
            T = seconds / rows
            theta = positions(np.full(rows, per_a * i), T, np.array([math.log(J), B, tau_c, 0.0, omega]))
            omega = float(theta[-1] - theta[-2]) / T
            signals = {
                "i_d_a": np.zeros(rows + 1),
                "i_q_a": i + 0.02 * rng.standard_normal(rows + 1),
                "theta_M_rad": step * np.round((theta + rng.uniform(0.0, step)) / step),
                "flagged": np.zeros(rows + 1),
            }
            traces.append(Trace(T * np.arange(rows + 1.0), signals, dict.fromkeys(signals, "1"), {"coasting": not i}))
        found = estimate_mechanics(traces, lambda i_d, i_q: per_a * i_q, per_a, 0.02, 0.0)
        off.append([(v.value - t) / v.std for v, t in zip((found.J, found.B, found.tau_c), (J, B, tau_c), strict=True)])
        assert found.J.std < COARSE_LIMIT * J
    assert float(np.max(np.abs(off))) < 3.0, off
