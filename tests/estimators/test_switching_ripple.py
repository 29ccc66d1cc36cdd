"""Ripple at the switching edges against legs switched and integrated in small steps."""

import math

import numpy as np
import pytest

from pmsmtool.estimators.inverter_error import InverterCurve
from pmsmtool.estimators.switching_ripple import Modulation, phases_of, ripple_at_edges, rippled_error_dq_v

MODULATION = Modulation(U_dc_v=300.0, L_h=2e-3, period_s=1e-4, dead_time_s=0.0)
STEPS = 20000


def brute_force(v: np.ndarray) -> np.ndarray:
    """Current beyond its mean course at the rising edge of each leg: one period of three legs, integrated."""
    zero = -0.5 * (v.max() + v.min())
    edges = (0.5 - (v + zero) / MODULATION.U_dc_v) * 0.5 * MODULATION.period_s
    t = (np.arange(STEPS) + 0.5) * MODULATION.period_s / STEPS
    legs = MODULATION.U_dc_v * ((t > edges[:, None]) & (t < MODULATION.period_s - edges[:, None]))
    phase = legs - legs.mean(axis=0)
    ripple = np.cumsum(phase - v[:, None], axis=1) * MODULATION.period_s / STEPS / MODULATION.L_h
    return np.array([np.interp(edges[x], t, ripple[x]) for x in range(3)])


@pytest.mark.parametrize("size", [0.1, 0.5, 0.95])
@pytest.mark.parametrize("angle", [0.0, 0.3, 1.9, 4.4])
def test_the_ripple_is_that_of_switched_legs(size: float, angle: float) -> None:
    v = phases_of(np.array([size * 300.0 / math.sqrt(3.0)]), np.zeros(1), np.array([angle]))
    found = ripple_at_edges(v, MODULATION)[:, 0]
    assert found == pytest.approx(brute_force(v[:, 0]), abs=2e-3)  # of up to 3 A; a step moves 1e-3 A


def test_without_voltage_and_dead_time_the_curve_is_as_measured() -> None:
    rng = np.random.default_rng(4)
    curve = InverterCurve(np.array([0.1, 1.0, 5.0]), np.array([2.0, 4.0, 4.2]), 0.0)
    d, q, theta = (rng.normal(0.0, 2.0, 50) for _ in range(3))
    still = (np.zeros(50), np.zeros(50))
    found = rippled_error_dq_v(curve, (d, q), still, theta, MODULATION)
    for mine, plain in zip(found, curve.error_dq_v(d, q, theta), strict=True):
        assert mine == pytest.approx(plain, abs=1e-12)


def test_ripple_takes_the_error_away_around_a_zero_crossing() -> None:
    """A current smaller than the ripple rises through zero at one edge and falls through it at the other."""
    curve = InverterCurve(np.array([1e-6, 10.0]), np.array([5.0, 5.0]), 0.0)
    theta = np.array([0.0])
    small, voltage = (np.array([0.05]), np.zeros(1)), (np.array([120.0]), np.zeros(1))
    sharp = curve.error_dq_v(*small, theta)[0]
    soft = rippled_error_dq_v(curve, small, voltage, theta, MODULATION)[0]
    assert sharp[0] > 6.0
    assert abs(soft[0]) < 0.5 * sharp[0]
