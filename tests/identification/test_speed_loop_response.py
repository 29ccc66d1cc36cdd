# SPDX-License-Identifier: MIT
"""A speed loop out of its step responses, against a loop that is simulated sample by sample."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pmsmtool.arrays import Array
from pmsmtool.errors import IdentificationError
from pmsmtool.identification.speed_loop_response import (
    AT_BOUND_S,
    LEAST_LAG_S,
    MOST_LEFT,
    Emf,
    SpeedLoop,
    StepRecord,
    _weighted,
    fit_pulses,
    fit_speed_loop,
    phase_margin_rad,
)
from pmsmtool.measurement.learn_gains import TICK_S, staircase

PLANT_S = 1e-4
AMPS_PER_RAD_S2 = 0.011
NO_EMF = Emf(0.0, 100.0)


def simulated(
    a: float, b: float, filter_s: float, every: int, latency_s: float, steps: Sequence[tuple[float, float]], seed: int
) -> StepRecord:
    """Run the loop in periods of 100 us, its controller every few of them, and sample it every millisecond."""
    rng = np.random.default_rng(seed)
    end = steps[-1][0] + 0.4
    omega = filtered = steps[0][1]
    angle = integral = torque = 0.0
    rows = []
    times, values = [at for at, _ in steps], [value for _, value in steps]
    for k in range(int(end / PLANT_S)):
        t = k * PLANT_S
        reference = values[max(0, int(np.searchsorted(times, t - latency_s, side="right")) - 1)]
        filtered += PLANT_S / filter_s * (omega - filtered)
        if k % every == 0:
            integral += b * (reference - filtered) * every * PLANT_S
            torque = a * (reference - filtered) + integral
        omega += torque * PLANT_S
        angle += omega * PLANT_S
        if k % 10 == 0:
            rows.append((t, angle, AMPS_PER_RAD_S2 * torque))
    table = np.array(rows)
    count = 2.0 * math.pi / 16384
    position = np.round(table[:, 1] / count) * count
    current = table[:, 2] + rng.normal(0.0, 0.01, len(table))
    return StepRecord(table[:, 0], position, current, steps, [(0.05, end)], count / 3.5, 0.01)


def climbing(low: float, step: float) -> list[tuple[float, float]]:
    speeds, _ = staircase(low, step, 4, 50.0, 0.1)
    return [(TICK_S * k, speed) for k, speed in enumerate(speeds) if k == 0 or speed != speeds[k - 1]]


@pytest.mark.chain
@pytest.mark.parametrize(
    ("a", "b", "filter_s", "every", "latency_s"),
    [(40.0, 320.0, 8e-4, 5, 5e-4), (110.0, 2400.0, 3e-4, 2, 1.7e-3)],
)
def test_gains_over_inertia(a: float, b: float, filter_s: float, every: int, latency_s: float) -> None:
    found = fit_speed_loop(simulated(a, b, filter_s, every, latency_s, climbing(20.0, 8.0), 1), NO_EMF)
    assert found.K_p_per_J == pytest.approx(a, rel=0.02)
    assert found.K_i_per_J == pytest.approx(b, rel=0.03)
    assert found.amps_per_rad_s2 == pytest.approx(AMPS_PER_RAD_S2, rel=0.03) and not found.at_bound


@pytest.mark.chain
def test_a_fit_that_ends_at_a_bound_says_so() -> None:
    short = simulated(40.0, 320.0, 8e-4, 5, 5e-4, [(0.0, 20.0), (0.2, 28.0)], 1)
    first = SpeedLoop(40.0, 320.0, 2e-3, 1e-3, AMPS_PER_RAD_S2)
    assert fit_speed_loop(short, NO_EMF, first, LEAST_LAG_S + 0.5 * AT_BOUND_S).at_bound == "lag"


@pytest.mark.chain
def test_a_shaft_that_does_not_answer_gives_nothing() -> None:
    good = simulated(40.0, 320.0, 8e-4, 5, 5e-4, climbing(20.0, 8.0), 1)
    turning = StepRecord(good.t_s, 60.0 * good.t_s, np.zeros_like(good.t_s), good.references, good.segments, 1e-3, 0.01)
    with pytest.raises(IdentificationError, match="E_EXCITATION"):
        fit_speed_loop(turning, NO_EMF)
    short = StepRecord(
        *(x[:20] for x in (good.t_s, good.position_rad, good.current_a)), good.references, [(0, 1)], 1, 1
    )
    with pytest.raises(IdentificationError, match="too few samples"):
        fit_speed_loop(short, NO_EMF)


def test_phase_margin_is_that_of_the_open_loop() -> None:
    a, b, lag = 100.0, 1500.0, 3e-3
    omega = np.geomspace(1.0, 1e4, 200_001)
    s = 1j * omega
    loop = (a * s + b) / (s * s * (1.0 + lag * s / 3.0) ** 3)
    at = int(np.argmin(np.abs(np.abs(loop) - 1.0)))
    assert phase_margin_rad(a, b, lag) == pytest.approx(math.pi + np.angle(loop[at]), abs=1e-3)


SHARE, AT_ONCE, CORNER, LASTS_S = 0.19, 0.45, 186.0, 0.11
"""Of a drive with 10 % of its rated current: K_p of its response is 16 % too small."""
SHARE_TOL, AT_ONCE_TOL = 0.01, 0.05
"""Measured 0.001 and 0.029."""
RIPPLE, ORDER_RAD_S = 0.06, 700.0
ASSUMED = Emf(0.2, CORNER, 0.14)


def pulses(scale: float = 1.0, lasts_s: float = LASTS_S) -> list[tuple[Array, Array]]:
    """Integrate a PI current loop against the resistance of the dead time and an EMF; the limit is what it is asked."""
    w, extra, dt = 2500.0, 2500.0 * (1.0 / AT_ONCE - 1.0) - CORNER, 2e-5
    current = integral = emf = 0.0
    rows = []
    for k in range(round(0.2 / dt)):
        asked = 1.0 if k * dt < lasts_s else 0.0
        error = asked - current
        integral += w * CORNER * error * dt
        emf += w * CORNER * SHARE * current * dt
        current += (w * error + integral - emf - (CORNER + extra) * current) * dt
        rows.append((k * dt, scale * current))
    t, y = np.array(rows[::50]).T
    return [(t, y * (1.0 + RIPPLE * np.sin(ORDER_RAD_S * t + phase))) for phase in (0.0, 1.5, 3.0, 4.5)]


def test_torque_pulses_show_what_emf_and_dead_time_take() -> None:
    found = fit_pulses(pulses(), ASSUMED)
    assert found is not None and found.at_once == pytest.approx(AT_ONCE, abs=AT_ONCE_TOL)
    assert found.share == pytest.approx(SHARE, abs=SHARE_TOL) and found.share_std < 0.3 * ASSUMED.share_std


@pytest.mark.parametrize(
    ("shown", "assumed"),
    [
        (pulses(1.3), ASSUMED),  # more than the limit: that is another unit
        (pulses(), Emf(0.01, CORNER, 0.007)),
        (pulses(lasts_s=0.02), ASSUMED),
        (pulses(0.0), ASSUMED),  # no current at all
    ],
)
def test_pulses_that_are_none_show_nothing(shown: list[tuple[Array, Array]], assumed: Emf) -> None:
    assert fit_pulses(shown, assumed) is None


def test_a_loop_that_is_not_stable_ends_no_fit() -> None:
    """Its speed overflows on a long record: `map learn` of a light rotor ended with a traceback."""
    model: Any = SimpleNamespace(fitted=lambda p: (np.array([math.inf, math.nan]), np.array([-1e300, 2.0]), 1.0, 1.0))
    left = _weighted(model, np.zeros(5), (1.0, 2.0))
    assert left.tolist() == [MOST_LEFT, MOST_LEFT, -MOST_LEFT, 1.0] and math.isfinite(float(left @ left))
