# SPDX-License-Identifier: MIT
"""Cogging torque and encoder error from coasting traces with a known truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.estimators.angle_harmonics import AngleHarmonics, angle_harmonics
from pmsmtool.estimators.shaft.position import position_std

STEP = 2.0 * math.pi / 2**17
RATE_S, ROWS = 1.1e-3, 780
SHAFTS = (77, 119, 133)
"""Seeds of 150 at which a row counted as every other one made an order of the rounding."""


def coasting(
    start_rad_s: float, cogging: dict[int, complex], encoder: dict[int, complex], friction_once: float = 0.0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A shaft with friction and accelerations Re(c exp(-j n theta)), integrated finely, and what its encoder shows.

    Its friction varies by ``friction_once`` of the Coulomb part over the angle.
    """
    fine = 40
    theta, omega, shown = 0.3, start_rad_s, []
    h = RATE_S / fine
    for k in range(ROWS * fine):
        if k % fine == 0:
            shown.append(theta)

        def a(x: float, w: float) -> float:
            ripple = sum((c * complex(math.cos(n * x), -math.sin(n * x))).real for n, c in cogging.items())
            return ripple - 0.15 * w - math.copysign(8.0 * (1.0 + friction_once * math.cos(x)), start_rad_s)

        middle = omega + 0.5 * h * a(theta, omega)
        theta, omega = theta + h * middle, omega + h * a(theta + 0.5 * h * omega, middle)
    true = np.array(shown)
    error = sum(((c * np.exp(-1j * n * true)).real for n, c in encoder.items()), np.zeros(ROWS))
    return RATE_S * np.arange(ROWS), STEP * np.floor((true + error) / STEP)


def found_in(traces: Sequence[tuple[Array, Array]], step: float = STEP) -> AngleHarmonics:
    return angle_harmonics([(t, shown, position_std(shown, step)) for t, shown in traces])


def test_the_rounding_of_large_angles_is_no_torque() -> None:
    """27 turns of an encoder of 22 bits in binary32: order 270 with 0.8 N m, and J 3.8 % off, on a smooth shaft."""
    t, step = 1.38286e-3 * np.arange(374), 2.0 * math.pi / 2**22
    found = []
    for seed in SHAFTS:
        rng = np.random.default_rng(seed)
        traces = []
        for sense in (1.0, -1.0):
            theta = rng.uniform(-3.0, 3.0) + sense * (rng.uniform(515.0, 530.0) * t - 398.0 * t**2)
            traces.append((t, (step * np.floor(theta / step)).astype(np.float32).astype(np.float64)))
        found.append(found_in(traces, step))
    assert not any(one.acceleration_rad_s2 or one.encoder_rad for one in found)


def test_nothing_is_found_where_nothing_repeats() -> None:
    found = found_in([coasting(start, {}, {}) for start in (65.0, -70.0)])
    assert not found.encoder_rad and not found.acceleration_rad_s2 and found.turns > 5.0


@pytest.mark.chain
def test_cogging_of_two_orders_and_an_encoder_off_centre_are_told_apart() -> None:
    cogging, encoder = {12: 30.0 * np.exp(0.7j), 6: 6.0 * np.exp(-2.0j)}, {1: 3e-3 * np.exp(1.1j)}
    traces = [coasting(start, cogging, encoder) for start in (65.0, -70.0)]
    found = found_in(traces)
    assert [h.order for h in found.acceleration_rad_s2] == [6, 12] and [h.order for h in found.encoder_rad] == [1]
    for h in found.acceleration_rad_s2:
        assert h.amplitude == pytest.approx(abs(cogging[h.order]), rel=0.05)
        assert h.phase_rad == pytest.approx(np.angle(cogging[h.order]), abs=math.radians(5.0))
    (once,) = found.encoder_rad
    assert complex(once.cosine, once.sine) == pytest.approx(encoder[1], abs=3e-5)
    # what is left of the way is that of a shaft without either
    t, shown = traces[0]
    way = found.shaft(found.without_ripple(t, shown))
    smooth = coasting(65.0, {}, {})[1]
    off = way - np.polyval(np.polyfit(t, way, 5), t)
    assert np.std(off) < 0.1 * np.std(shown - np.polyval(np.polyfit(t, shown, 5), t))
    assert np.std(off) < 4.0 * np.std(smooth - np.polyval(np.polyfit(t, smooth, 5), t))


def test_friction_over_the_angle_hides_no_cogging() -> None:
    """It is the other way round in the other direction, so no error of the encoder; 2 % of cogging went unseen."""
    found = found_in([coasting(start, {18: 12.0}, {}, friction_once=0.1) for start in (65.0, -70.0)])
    assert sum(h.amplitude for h in found.encoder_rad) < 6e-6  # measured 3.2e-6; friction moves the shaft by 1.9e-4
    (order,) = found.acceleration_rad_s2
    assert order.order == 18 and order.amplitude == pytest.approx(12.0, rel=0.1)


LINE_TOLERANCE = 0.05
"""Relative, of an interpolation's error; measured: 0.017 and 0.032."""


def braked(error: Callable[[Array], Array], step: float, speed: float = 1.0) -> list[tuple[Array, Array]]:
    """Two shafts that slow down evenly, as an encoder shows them: 6.5 turns and more, times ``speed``."""
    t = RATE_S * np.arange(ROWS)
    ways = [0.3 + speed * (start * t - 0.5 * slope * t * t) for start, slope in ((65.0, 40.0), (-70.0, -45.0))]
    return [(t, step * np.floor((way + error(way)) / step)) for way in ways]


def test_the_error_of_an_interpolation_is_found_with_its_lines() -> None:
    """At its first speed a row is 11 lines after the other: the falling speed tells the lines from their aliases."""
    lines, once, twice = 1024, 2e-4, 8e-5
    traces = braked(lambda way: once * np.sin(lines * way) + twice * np.cos(2 * lines * way + 0.7), STEP)
    found = angle_harmonics([(t, shown, position_std(shown, STEP)) for t, shown in traces], STEP)
    assert [h.order for h in found.line_rad] == [lines, 2 * lines]
    assert [h.amplitude for h in found.line_rad] == pytest.approx([once, twice], rel=LINE_TOLERANCE)
    assert not found.encoder_rad and not found.acceleration_rad_s2


def test_a_torque_that_would_have_held_the_shaft_is_an_error_of_the_lines() -> None:
    """A speed that falls little does not tell them apart: 128 lines were a cogging of 63 times the push's torque."""
    once, most = 1e-3, 100.0
    traces = [(t[:200], shown[:200]) for t, shown in braked(lambda way: once * np.sin(128 * way), STEP)]
    shown = [(t, way, position_std(way, STEP)) for t, way in traces]
    (held,) = angle_harmonics(shown, STEP).acceleration_rad_s2
    assert held.order == 128 and held.amplitude > most  # measured: 6.3e4
    found = angle_harmonics(shown, STEP, most)
    assert [h.order for h in found.line_rad] == [128, 256] and not found.acceleration_rad_s2
    assert found.line_rad[0].amplitude == pytest.approx(once, rel=LINE_TOLERANCE)


@pytest.mark.parametrize("turns", [1.5, 2.7, 5.0])
def test_an_encoder_error_over_few_turns_is_no_torque(turns: float) -> None:
    """1 degree once per turn, 0.5 twice: two orders of torque that are none, B 14 times the truth and tau_c below 0."""
    for phase in (0.4, 2.0, 3.6, 5.2):
        traces = braked(
            lambda way, at=phase: math.radians(1.0) * np.cos(way + at) + math.radians(0.5) * np.sin(2.0 * way - at),
            STEP,
            turns / 6.5,
        )
        assert not found_in(traces).acceleration_rad_s2


def test_the_steps_of_a_position_are_no_lines() -> None:
    step = 2.0 * math.pi / 2**12
    traces = braked(lambda way: 0.0 * way, step)
    assert not angle_harmonics([(t, shown, position_std(shown, step)) for t, shown in traces], step).line_rad
    assert not found_in(traces, step).line_rad  # nor where the step is not known
