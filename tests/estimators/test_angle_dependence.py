# SPDX-License-Identifier: MIT
"""L over the angle of the rotor: harmonics of two and six per electrical turn are not in the mean."""

import math

import numpy as np
import pytest

from pmsmtool.estimators.injection import angle_dependence
from pmsmtool.estimators.injection.angle_dependence import (
    HARMONICS,
    RATIO_STD,
    UNEVEN,
    AngleDependence,
    over_angle,
    unseen_std,
)
from pmsmtool.estimators.injection.axis_fit import fit_axis
from pmsmtool.estimators.injection.axis_response import Shot

pytestmark = pytest.mark.chain

R, L, T_S, NOISE = 0.5, 3e-3, 1e-4, 2e-3


def shot(L_h: float, half_period: int, seed: int) -> Shot:
    """i[k+1] = a i[k] + (1 - a)/R v[k-1], with noise."""
    n = 600
    u = 20.0 * np.where(np.arange(n) // half_period % 2 == 0, 1.0, -1.0)
    a, i = math.exp(-R * T_S / L_h), np.zeros(n)
    for k in range(1, n - 1):
        i[k + 1] = a * i[k] + (1.0 - a) / R * u[k - 1]
    i += NOISE * np.random.default_rng(seed).standard_normal(n)
    return Shot(u, i + 10.0, np.zeros(n), half_period, T_S)


def harmonic(angle: float) -> float:
    return 1.0 + 0.02 * math.cos(2.0 * angle + 0.3) + 0.04 * math.cos(6.0 * angle)


def degrees(*angles: float) -> list[float]:
    return [math.radians(angle) for angle in angles]


@pytest.mark.parametrize("angles", [degrees(0, 15, 105), degrees(2, 11, 101), degrees(0, 4, 114, 204)])
def test_the_mean_over_the_angle_and_how_far_it_goes(angles: list[float]) -> None:
    here, *others = (shot(L * harmonic(angle), 6, k) for k, angle in enumerate(angles))
    fit = fit_axis([here, shot(L * harmonic(angles[0]), 9, 9)], NOISE, R, torque=False)
    found = over_angle(fit, here, others, angles)
    assert found.mean * fit.L_h == pytest.approx(L, rel=2e-3)  # measured 1.1e-3; at the first angle 5.9 % beside it
    seen = max(abs(harmonic(angle) - 1.0) for angle in angles)
    assert seen - 3e-3 < found.spread < seen + 8e-3
    even = [shot(L * harmonic(angles[0]), 6, k) for k in range(3, 2 + len(angles))]
    assert over_angle(fit, here, even, angles) == AngleDependence(1.0, 0.0)


def test_angles_that_show_the_sixth_harmonic_badly_leave_it_in_the_interval() -> None:
    """Cogging of two periods per pole pair held a rotor at 0, 4 and 114 deg: L_d 5 % off, at +-1.6 %."""
    at = degrees(0, 4, 114)
    here, *others = (shot(L * harmonic(angle), 6, k) for k, angle in enumerate(at))
    fit = fit_axis([here, shot(L * harmonic(0.0), 9, 9)], NOISE, R, torque=False)
    found = over_angle(fit, here, others, at)
    assert abs(found.mean * fit.L_h / L - 1.0) < found.spread  # measured 0.5 of it
    even = [shot(L * harmonic(0.0), 6, k) for k in (3, 4)]
    assert over_angle(fit, here, even, at) == AngleDependence(1.0, pytest.approx(0.018, abs=3e-3))  # type: ignore[arg-type]


def test_what_angles_leave_unseen_of_the_mean() -> None:
    assert unseen_std(degrees(0, 15, 105)) < 1.2e-3 < RATIO_STD
    assert unseen_std(degrees(0, 15)) > 0.015 < unseen_std(degrees(0, 4, 114)) < unseen_std(degrees(0, 60, 180))
    whole = math.sqrt(sum(std**2 for std in HARMONICS.values()))
    assert unseen_std(degrees(20)) == pytest.approx(whole, rel=1e-12)  # nothing is seen


def test_harmonics_of_any_phase_scatter_about_the_mean_as_is_said() -> None:
    """Drawn harmonics at the angles where rotors stood: the mean of the logarithm against its standard deviation."""
    rng = np.random.default_rng(7)
    for at in (degrees(0, 15, 105), degrees(1, 6.4, 109.2), degrees(0, 10.5, 111), degrees(0, 7, 107, 197)):
        misses = []
        for _ in range(400):
            parts = {n: std * rng.standard_normal(2) for n, std in HARMONICS.items()}
            logs = [sum(a * math.cos(n * t) + b * math.sin(n * t) for n, (a, b) in parts.items()) for t in at]
            covariance, lever, std = angle_dependence._harmonics(at)
            ratios = np.array(logs[1:]) - logs[0] + RATIO_STD * rng.standard_normal(len(at) - 1)
            misses.append((float(lever @ np.linalg.solve(covariance, ratios)) + logs[0]) / std)
        assert float(np.std(misses)) == pytest.approx(1.0, abs=0.12)  # measured 0.97 to 1.05


def test_what_the_frame_sees_of_the_other_axis_is_no_change_over_the_angle() -> None:
    here, *others = (shot(L * more, 6, k) for k, more in enumerate((1.0, 1.01, 1.02)))
    fit = fit_axis([here, shot(L, 9, 9)], NOISE, R, torque=False)
    angles = [0.0, 0.1, 0.1 + 0.5 * math.pi]
    assert over_angle(fit, here, others, angles).spread > UNEVEN
    assert over_angle(fit, here, others, angles, [math.log(1.01), math.log(1.02)]) == AngleDependence(1.0, 0.0)
