# SPDX-License-Identifier: MIT
"""Current loops: gains of the papers, margins against python-control and against the loop's own poles."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pmsmtool.design.loops.current_loop import (
    AxisPlant,
    CurrentGains,
    axis_loop,
    imc,
    maximum_delay_periods,
    modulus_optimum_bandwidth,
    second_order,
)
from pmsmtool.design.loops.sampled_loop import SampledLoop, _real_roots, margins
from pmsmtool.errors import DesignInfeasible

R, L_D, L_Q, T_S = 0.137, 2.3e-3, 2.1e-3, 1.0 / 12e3

MARGIN_TOLERANCE = 1e-7
"""Relative agreement with python-control, whose polynomial roots scatter by up to 1e-8 (measured 6e-9)."""

MARGINAL_RADIUS = 1e-9
"""|z| - 1 of the critical pole with the gain or delay at its margin (measured 4e-13, 2e-11)."""

GAINS = [imc(R, L_D, 4000.0), imc(8.0 * R, 1.3 * L_D, 2000.0), second_order(R, L_D, 2000.0, 1.0)]


def scaled(loop: SampledLoop, gain: float) -> SampledLoop:
    return replace(loop, num=tuple(gain * b for b in loop.num))


def delayed(loop: SampledLoop, samples: int) -> SampledLoop:
    return replace(loop, den=loop.den + (0.0,) * samples, delay_s=loop.delay_s + samples * loop.T_s)


def spectral_radius(loop: SampledLoop) -> float:
    return float(np.abs(loop.closed_loop_poles()).max())


def test_modulus_optimum_of_the_reference_machine() -> None:
    alpha = modulus_optimum_bandwidth(T_S, 1.5)
    d, q = imc(R, L_D, alpha), imc(R, L_Q, alpha)
    assert (alpha, d.K_p, q.K_p, d.K_i) == pytest.approx((4000.0, 9.2, 8.4, 548.0), rel=1e-12)


def test_second_order_places_the_poles() -> None:
    gains = second_order(R, L_D, 2000.0, 0.7)
    poles = np.roots([L_D, R + gains.K_p, gains.K_i])
    assert np.abs(poles) == pytest.approx(2000.0)
    assert -poles.real / np.abs(poles) == pytest.approx(0.7)


def test_second_order_refuses_a_loop_slower_than_the_plant() -> None:
    with pytest.raises(DesignInfeasible, match="K_p"):
        second_order(5.0, 1e-3, 100.0, 1.0)


@pytest.mark.chain
@pytest.mark.parametrize("delay", [1.25, 1.5, 2.0, 2.5])
@pytest.mark.parametrize("gains", GAINS, ids=("imc", "imc of another plant", "second-order"))
def test_margins_agree_with_python_control(gains: CurrentGains, delay: float) -> None:
    control = pytest.importorskip("control")
    loop = axis_loop(gains, AxisPlant(R, L_D, T_S, delay))
    ours = margins(loop)
    gain, phase, modulus, _, w_gain_crossing, _ = control.stability_margins(
        control.tf(list(loop.num), list(loop.den), T_S)
    )
    assert ours.gain_margin == pytest.approx(gain, rel=MARGIN_TOLERANCE)
    assert ours.phase_margin_deg == pytest.approx(phase, rel=MARGIN_TOLERANCE)
    assert ours.modulus_margin == pytest.approx(modulus, rel=MARGIN_TOLERANCE)
    assert ours.crossover_rad_s == pytest.approx(w_gain_crossing, rel=MARGIN_TOLERANCE)


@pytest.mark.parametrize("delay", [0.5, 0.8, 1.5, 1.75])
@pytest.mark.parametrize("gains", GAINS, ids=("imc", "imc of another plant", "second-order"))
def test_the_loop_is_marginal_exactly_at_its_margins(gains: CurrentGains, delay: float) -> None:
    plant = AxisPlant(R, L_D, T_S, delay)
    found = margins(axis_loop(gains, plant))
    assert found.stable
    assert spectral_radius(scaled(axis_loop(gains, plant), found.gain_margin)) == pytest.approx(
        1.0, abs=MARGINAL_RADIUS
    )
    largest = maximum_delay_periods(gains, plant)
    assert spectral_radius(axis_loop(gains, replace(plant, delay_periods=largest))) < 1.0
    slower = axis_loop(gains, replace(plant, delay_periods=largest * (1.0 + 1e-9)))
    assert spectral_radius(slower) == pytest.approx(1.0, abs=MARGINAL_RADIUS)
    # Phase margin over crossover is that delay up to the aliasing of the extra delay.
    assert found.delay_margin_s / T_S == pytest.approx(largest - delay, rel=0.02)


def test_the_largest_delay_of_a_slow_loop_needs_no_poles_of_hundreds_of_periods(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """`tune --bandwidth-hz 6` took a minute: each trial of the delay was an eigenvalue problem of 400 rows."""
    asked: list[int] = []
    poles = SampledLoop.closed_loop_poles
    monkeypatch.setattr(SampledLoop, "closed_loop_poles", lambda loop: (asked.append(len(loop.den)), poles(loop))[1])
    plant = AxisPlant(R=3.6, L=0.051, T_s=1.0 / 12000.0, delay_periods=1.5)
    for rad_s, periods in ((120.0, 157.2952), (50.0, 377.0289)):  # by the poles, which took 0.4 and 34 s
        found = maximum_delay_periods(CurrentGains(rad_s * plant.L, rad_s * plant.R), plant)
        assert found == pytest.approx(periods, rel=2e-4)
    assert max(asked) < 10


def test_the_largest_delay_is_the_first_limit_though_the_loop_is_stable_again_beyond() -> None:
    """A predictor made for two periods: unstable from 2.19 to 2.81, stable to 2.95, unstable from there on."""
    plant = AxisPlant(R=2.2785e-3, L=0.42428e-3, T_s=152.03e-6, delay_periods=2.0)
    gains = CurrentGains(K_p=2.3804, K_i=3017.3)

    def radius(delay: float) -> float:
        return spectral_radius(axis_loop(gains, replace(plant, delay_periods=delay), plant))

    assert radius(2.4) > 1.0 > radius(2.88)
    assert all(radius(delay) > 1.0 for delay in (2.96, 3.5, 5.0))
    assert maximum_delay_periods(gains, plant, plant) == pytest.approx(2.192, abs=0.001)


def test_delay_margin_where_a_resonance_leads() -> None:
    """An integrator and a resonance that crosses once more above -180 degree: its delay goes nearly once around.

    Whole samples of delay are exact: the loop must stay stable up to the sample before its delay margin, and no longer.
    """
    pair = [1.0, -2.0 * 0.986 * math.cos(1.566), 0.986**2]
    num = np.convolve([0.171], pair) - 0.0355 * np.convolve([1.0, -math.cos(1.566)], [1.0, -1.0])
    loop = SampledLoop(tuple(num.tolist()), tuple(np.convolve([1.0, -1.0], pair).tolist()), T_S)
    found = margins(loop)
    assert found.phase_margin_deg < 0.0
    assert 2.0 < found.delay_margin_s / T_S < 3.0  # 2.69
    assert [margins(delayed(loop, samples)).stable for samples in range(4)] == [True, True, True, False]


def test_pulse_response_of_a_fractional_delay() -> None:
    """The voltage of sample k acts over [t_k + 0.3 T, t_k + 1.3 T): step the exact plant piece by piece."""
    delay, fraction = 0.8, 0.3
    loop = axis_loop(CurrentGains(1.0, 0.0), AxisPlant(R, L_D, T_S, delay))
    # A pure unit gain: the controller's pole at z = 1 cancels its zero there.
    current, voltage_before, expected = 0.0, 0.0, []
    for k in range(6):
        voltage = 1.0 if k == 0 else 0.0
        for share, u in ((fraction, voltage_before), (1.0 - fraction, voltage)):
            decay = math.exp(-R * share * T_S / L_D)
            current = current * decay + u * (1.0 - decay) / R
        voltage_before = voltage
        expected.append(current)
    den, response = np.asarray(loop.den), list[float]()
    num = np.concatenate((np.zeros(den.size - len(loop.num)), loop.num))
    for k in range(7):
        past = sum(den[m] * response[k - m] for m in range(1, den.size) if k >= m)
        response.append((num[k] if k < num.size else 0.0) - past)
    assert response[1:7] == pytest.approx(expected, rel=1e-12)


def test_slow_loop_meets_the_continuous_margin() -> None:
    """Far below the sampling rate the phase margin is 90 degree minus alpha times the delay."""
    alpha = 500.0
    found = margins(axis_loop(imc(R, L_D, alpha), AxisPlant(R, L_D, T_S, 1.5)))
    # 0.02 degree come from the forward-Euler integrator, whose zero lies (R T/L)^2 / 2 beside the pole.
    assert found.phase_margin_deg == pytest.approx(90.0 - math.degrees(alpha * 1.5 * T_S), abs=0.03)
    assert found.bandwidth_rad_s == pytest.approx(alpha * (1.0 + alpha * 1.5 * T_S), rel=0.02)


def test_predictor_gives_the_phase_of_the_computation_delay_back() -> None:
    gains, plant = imc(R, L_D, 7540.0), AxisPlant(R, L_D, T_S, 1.5)
    without, with_predictor = margins(axis_loop(gains, plant)), margins(axis_loop(gains, plant, plant))
    assert without.phase_margin_deg < 40.0 < 60.0 < with_predictor.phase_margin_deg
    # The nominal predictor moves the poles to where they lie without delay, the new ones to zero.
    undelayed = axis_loop(gains, replace(plant, delay_periods=0.5)).closed_loop_poles()
    poles = np.sort(np.abs(axis_loop(gains, plant, plant).closed_loop_poles()))
    assert poles[-1] == pytest.approx(np.abs(undelayed).max(), abs=5e-4)


def test_a_delay_shorter_than_the_hold_is_refused() -> None:
    with pytest.raises(DesignInfeasible, match="hold"):
        axis_loop(GAINS[0], AxisPlant(R, L_D, T_S, 0.4))


def test_unstable_and_conditionally_stable_loops_are_told() -> None:
    integrating_twice = SampledLoop((0.02, -0.0199), (1.0, -2.0, 1.0, 0.0, 0.0), 1.0)
    found = margins(integrating_twice)
    assert found.stable is (spectral_radius(integrating_twice) < 1.0)
    assert not margins(axis_loop(imc(R, L_D, 40_000.0), AxisPlant(R, L_D, T_S, 1.5))).stable
    conditionally = margins(SampledLoop((1.2, -2.1, 0.93), (1.0, -3.0, 3.0, -1.0), 1.0))
    assert conditionally.stable
    reduced = scaled(SampledLoop((1.2, -2.1, 0.93), (1.0, -3.0, 3.0, -1.0), 1.0), conditionally.gain_reduction)
    assert spectral_radius(reduced) == pytest.approx(1.0, abs=1e-7)


def test_a_constant_has_no_roots() -> None:
    """The gain of such a loop crosses nothing; (x - 0.5) (x + 2) has one root in cos(theta)."""
    assert _real_roots(np.array([2.0])).size == 0 and _real_roots(np.array([0.0])).size == 0
    assert _real_roots(np.array([-0.5, 1.5, 0.5])) == pytest.approx([math.pi / 3.0])
