"""The current loop of the flux run against an inverter whose error is large beside the winding's voltage."""

import math

import pytest

from pmsmtool.experiments.speed_run import SETTLE_MOST_S, SETTLE_S, SteadyLoop, steady_loop

R, L, I_LEAST, PERIOD_S, LEAST_RAD_S = 0.4, (1e-3, 1.5e-3), 2.0, 5e-5, 754.0
STEPS_PER_PERIOD = 4


def off_after(loop: SteadyLoop, V_dead_v: float, axis_q_a: float) -> float:
    """Largest distance from the wanted current, relative, once the loop's time is over after i_d changed its sign.

    The error is 4/pi V_dead along the current, softened at a hundredth of the current; speed adds what is feed-forward.
    """
    error_v, soft = 4.0 / math.pi * V_dead_v, 0.01 * I_LEAST
    i, wanted = [-I_LEAST, axis_q_a], (I_LEAST, 0.0)
    x = [-I_LEAST * (R + error_v / I_LEAST), 0.0]
    step = PERIOD_S / STEPS_PER_PERIOD
    worst = 0.0
    for k in range(round(1.5 * loop.settle_s / PERIOD_S)):
        u = [loop.K_p_v_per_a[n] * (wanted[n] - i[n]) + x[n] for n in (0, 1)]
        x = [x[n] + PERIOD_S * loop.K_i_v_per_as[n] * (wanted[n] - i[n]) for n in (0, 1)]
        for _ in range(STEPS_PER_PERIOD):
            along = error_v / math.hypot(*i, soft)
            # implicit in the error's resistance: it is stiff near zero
            i = [(i[n] + step / L[n] * u[n]) / (1.0 + step / L[n] * (R + along)) for n in (0, 1)]
        if k * PERIOD_S >= loop.settle_s:
            worst = max(worst, abs(i[0] - wanted[0]), abs(i[1]))
    return worst / I_LEAST


@pytest.mark.parametrize("V_dead_v", [0.0, 0.5, 5.0, 25.0])
def test_currents_are_steady_when_the_window_begins(V_dead_v: float) -> None:
    loop = steady_loop(R, L, V_dead_v, I_LEAST, PERIOD_S, LEAST_RAD_S)
    assert SETTLE_S <= loop.settle_s < 2.0 * SETTLE_S
    assert off_after(loop, V_dead_v, 0.1) < 0.03


def test_the_least_bandwidth_would_leave_the_current_at_zero() -> None:
    slow = steady_loop(R, L, 0.0, I_LEAST, PERIOD_S, LEAST_RAD_S)
    assert slow.K_p_v_per_a == pytest.approx((LEAST_RAD_S * L[0], LEAST_RAD_S * L[1]))
    assert off_after(slow, 25.0, 0.1) > 0.5


def test_a_slow_drive_waits_longer_but_not_for_ever() -> None:
    slow = steady_loop(R, L, 25.0, I_LEAST, 1.0 / 8000.0, 533.0)
    assert slow.K_p_v_per_a[0] == pytest.approx(8000.0 / 6.0 * L[0])
    assert SETTLE_S < slow.settle_s <= SETTLE_MOST_S
