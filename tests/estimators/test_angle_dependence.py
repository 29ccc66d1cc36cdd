# SPDX-License-Identifier: MIT
"""L over the angle of the rotor: harmonics of two and six per electrical turn are not in the mean of two angles."""

import math

import numpy as np
import pytest

from pmsmtool.estimators.injection.angle_dependence import UNEVEN, UNSEEN_RANGE, AngleDependence, over_angle
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


@pytest.mark.parametrize("first_rad", [math.radians(15.0), math.radians(11.0)])
def test_the_mean_over_the_angle_and_how_far_it_goes(first_rad: float) -> None:
    at = [0.0, first_rad, first_rad + 0.5 * math.pi]
    here, *others = (shot(L * harmonic(angle), 6, k) for k, angle in enumerate(at))
    fit = fit_axis([here, shot(L * harmonic(0.0), 9, 9)], NOISE, R, torque=False)
    found = over_angle(fit, here, others, at[1:])
    assert found is not None
    assert found.mean * fit.L_h == pytest.approx(L, rel=2e-3)  # measured 8e-4; at the first angle 5.9 % beside it
    assert found.spread == pytest.approx(max(abs(harmonic(angle) - 1.0) for angle in at), abs=3e-3)
    one = over_angle(fit, here, others[:1], at[1:2])  # one angle more shows that, but no mean
    assert one is not None and one.mean == 1.0 and one.spread >= UNSEEN_RANGE > UNEVEN
    even = [shot(L * harmonic(0.0), 6, k) for k in (3, 4)]
    assert over_angle(fit, here, even, at[1:]) == AngleDependence(1.0, 0.0)
    assert over_angle(fit, here, even[:1], at[1:2]) is None  # a sixth harmonic may have one value at two angles


def test_angles_of_one_phase_of_the_sixth_harmonic_say_nothing_of_it() -> None:
    """Cogging of two periods per pole pair held a rotor at 0, 4 and 114 deg: L_d 5 % off, at +-1.6 %."""
    here, *others = (shot(L, 6, k) for k in range(3))
    fit = fit_axis([here, shot(L, 9, 9)], NOISE, R, torque=False)
    assert over_angle(fit, here, others, [0.1, 0.1 + math.radians(110.0)]) is None


def test_what_the_frame_sees_of_the_other_axis_is_no_change_over_the_angle() -> None:
    here, *others = (shot(L * more, 6, k) for k, more in enumerate((1.0, 1.01, 1.02)))
    fit = fit_axis([here, shot(L, 9, 9)], NOISE, R, torque=False)
    angles = [0.1, 0.1 + 0.5 * math.pi]
    seen = over_angle(fit, here, others, angles)
    assert seen is not None and seen.spread > UNEVEN
    assert over_angle(fit, here, others, angles, [math.log(1.01), math.log(1.02)]) == AngleDependence(1.0, 0.0)
