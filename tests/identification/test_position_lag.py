# SPDX-License-Identifier: MIT
"""A position gain from the lag of moves: loops written out here, with friction, feed-forward and other structures."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pmsmtool.errors import IdentificationError
from pmsmtool.identification.position_lag import (
    PositionLag,
    _fed_by_delays,
    fed_share,
    forward_scale,
    led_s,
    position_lag,
    position_scale,
    ramp_areas,
)
from pmsmtool.trace import Trace

NAME, FORWARD, LEAD = "position.K_p_per_s", "position.velocity_ff", "position.acceleration_ff_s"
T_S, J, COUNT = 1e-3, 2e-4, 2.0 * math.pi / 4096.0
K_TORQUE = 0.4
SPEED, RAMP_S, EVEN_S, REST_S = 2.0 * math.pi, 0.25, 2.0, 1.0
LAG_TOL = 1e-3
"""Largest error of the gain without feed-forward (relative); measured 2e-5."""
LED_TOL = 0.02
"""Of the time by which the acceleration leads (relative); measured 0.013."""
JITTER_S = 5e-4
FORWARD_TOL = 0.03
"""Of the share that is fed forward; measured 0.016."""


def demand() -> np.ndarray:
    """One move there and back, trapezoids of speed with a rest after each (rad)."""
    up = np.linspace(0.0, 1.0, round(RAMP_S / T_S))
    there = np.concatenate([up, np.ones(round(EVEN_S / T_S)), up[::-1], np.zeros(round(REST_S / T_S))])
    speed = SPEED * np.concatenate([np.zeros(200), there, -there])
    return np.cumsum(speed) * T_S


def moves(
    K_v: float, forward: float = 0.0, K_i_v: float = 0.0, tau_c: float = 0.02, coarse: float | None = None,
    lead_s: float = 0.0,
) -> Trace:  # fmt: skip
    """Answer of a position gain (and its integral part) on a PI speed loop that turns a shaft with friction.

    ``coarse``: angle of a count where the loop takes its speed from counts, as drives do.
    """
    theta_ref = demand()
    K_p = 60.0 * J
    K_i = 15.0 * K_p
    theta = omega = total = integral = asked = torque = shown = 0.0
    seen, current = [], []
    faster = np.diff(theta_ref, 2, prepend=theta_ref[0], append=theta_ref[-1]) / T_S**2
    pairs = zip(np.concatenate([theta_ref[:1], theta_ref[:-1]]), theta_ref, faster, strict=True)
    for before, now, acceleration in pairs:
        last, shown = shown, round(theta / (coarse or COUNT)) * (coarse or COUNT)
        error = now - shown
        total += K_i_v * error * T_S
        slip = K_v * error + total + forward * (now - before) / T_S + lead_s * acceleration
        slip -= (shown - last) / T_S if coarse else omega
        integral += K_i * slip * T_S
        asked = K_p * slip + integral
        seen.append(shown)
        current.append(torque / K_TORQUE)
        for _ in range(10):
            torque += (asked - torque) * 0.1 * T_S / 5e-4
            drag = math.copysign(tau_c, omega) if omega else min(max(torque, -tau_c), tau_c)
            new = omega + (torque - drag) / J * 0.1 * T_S
            omega = 0.0 if omega * new < 0.0 and abs(torque) < tau_c else new
            theta += omega * 0.1 * T_S
    signals = {"theta_m_rad": np.array(seen), "theta_ref_rad": theta_ref, "i_q_a": np.array(current)}
    return Trace(T_S * np.arange(len(theta_ref)), signals, {"theta_m_rad": "rad", "theta_ref_rad": "rad", "i_q_a": "A"})


@pytest.mark.parametrize("K_v", [8.0, 15.0, 30.0])
def test_speed_over_lag_is_the_gain(K_v: float) -> None:
    found = position_lag(moves(K_v), COUNT)
    assert found.gain_per_s == pytest.approx(K_v, rel=LAG_TOL)
    assert abs(found.forward) < FORWARD_TOL and found.std < 0.02


def test_samples_whose_instants_jitter_keep_a_demand_even() -> None:
    """A Copley whose demand is as even as any: over 20 ms its speed seemed to change by 5 %."""
    trace = moves(15.0)
    jitter = np.random.default_rng(0).normal(0.0, JITTER_S, len(trace.t_s))
    found = position_lag(Trace(np.sort(trace.t_s + jitter), trace.signals, trace.units), COUNT)
    assert found.gain_per_s == pytest.approx(15.0, rel=10.0 * LAG_TOL)


@pytest.mark.parametrize("forward", [0.3, 0.7])
def test_what_is_fed_forward_is_seen_and_keeps_the_gain_unknown(forward: float) -> None:
    """The lag alone says a gain that is 1.4 or 3.3 times too large."""
    lags = [(counts, position_lag(moves(15.0 * counts / 1000, forward), COUNT)) for counts in (1000, 700)]
    assert all(lag.forward == pytest.approx(forward, abs=FORWARD_TOL) for _, lag in lags)
    assert _fed_by_delays(lags[0][1], lags[1][1])[0] == pytest.approx(forward, abs=DELAY_TOL)
    told = position_scale(lags[0], lags[1], NAME)
    assert told.scale is None and "fed forward" in told.why


DELAY_TOL = 2e-3
"""Of the share that is fed forward by the delays of moves with two gains; measured 7e-4."""


@pytest.mark.chain
@pytest.mark.parametrize("forward", [0.0, 0.3])
def test_noise_of_a_counted_speed_is_no_feed_forward(forward: float) -> None:
    """Faulhaber, Nanotec PD4-C: by the current alone 36 to 69 % of the speed seemed fed forward of none."""
    coarse = 3.0 * COUNT
    lags = [(counts, position_lag(moves(0.03 * counts, forward, coarse=coarse), coarse)) for counts in (1000, 700)]
    assert all(abs(lag.forward) < 2.0 * lag.forward_std for _, lag in lags), "the current says nothing"
    share, std = _fed_by_delays(lags[0][1], lags[1][1])
    assert share == pytest.approx(forward, abs=COARSE_TOL) and abs(share - forward) < 2.0 * std
    for is_zero in (False, True):
        told = position_scale(lags[0], lags[1], NAME, forward_is_zero=is_zero)
        assert told.scale == (pytest.approx(0.03, rel=0.01) if forward == 0.0 else None)


COARSE_TOL = 0.1
"""Of the share that is fed forward by the delays of coarse counts; measured 0.03."""
FED_TOL = 2e-3
"""Largest error of the share that a feed-forward's counts feed (1); measured 2e-4."""


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_counts_of_a_feed_forward_are_told_by_the_lag_that_they_leave(share: float) -> None:
    """It was set to 0, and stayed without a unit: `tune --axis` could not write it."""
    found, std = fed_share(moves(15.0, share), position_lag(moves(15.0), COUNT))
    assert found == pytest.approx(share, abs=FED_TOL) and std < 0.02
    told = forward_scale(500.0, found, std, FORWARD)
    assert told.scale == pytest.approx(share / 500.0, rel=2.0 * FED_TOL) and told.unit == "1"
    for seen in (0.0, 0.1):
        unsure = forward_scale(8.0, seen, 0.02, FORWARD)
        assert unsure.scale is None and "8 counts feed" in unsure.why


@pytest.mark.parametrize("lead", [8e-3, 30e-3])
def test_counts_of_an_acceleration_are_told_by_the_integral_of_the_lag(lead: float) -> None:
    """An axis of a Copley lagged while it sped up: the unit of its 0x60FB:03 was not known."""
    doubled = moves(15.0, lead_s=lead)
    once_more = np.sort(np.concatenate([doubled.t_s, doubled.t_s + 0.2e-3]))  # a demand is shown twice
    signals = {name: np.repeat(signal, 2) for name, signal in doubled.signals.items()}
    found, std = led_s(Trace(once_more, signals, doubled.units), ramp_areas(moves(15.0)))
    assert found == pytest.approx(lead, rel=LED_TOL) and std < 0.05 * lead
    told = forward_scale(500.0, found, std, LEAD, "s")
    assert told.scale == pytest.approx(lead / 500.0, rel=LED_TOL) and told.unit == "s"
    unsure = forward_scale(8.0, 1e-3, 1e-3, LEAD, "s")
    assert unsure.scale is None and "1 +-2 ms of the acceleration forward" in unsure.why


def test_an_integral_part_of_the_position_is_refused() -> None:
    with pytest.raises(IdentificationError, match="lag"):
        position_lag(moves(15.0, K_i_v=30.0), COUNT)


def test_a_demand_that_is_never_even_is_refused() -> None:
    trace = moves(15.0)
    swing = 3.0 * np.sin(2.0 * math.pi * 2.0 * trace.t_s)
    signals = {**trace.signals, "theta_ref_rad": swing, "theta_m_rad": np.roll(swing, 60)}
    with pytest.raises(IdentificationError, match="even"):
        position_lag(Trace(trace.t_s, signals, trace.units), COUNT)


def lag(gain: float, forward: float = 0.0) -> PositionLag:
    return PositionLag(gain, 0.005, forward, 0.01)


def test_one_count_is_told_where_the_lag_follows_the_counts() -> None:
    told = position_scale((1000, lag(15.0)), (700, lag(10.5)), NAME)
    assert told.scale == pytest.approx(0.015) and told.form == "value" and told.unit == "1/s"
    assert told.half_width == pytest.approx(1.96 * math.hypot(0.005, 0.01 / math.sqrt(2.0)), rel=1e-3)
    unsure = position_scale((1000, lag(15.0, -0.08)), (700, lag(10.5, -0.08)), NAME)
    assert unsure.scale is None and unsure.half_width > 0.12
    wide = PositionLag(15.0, 0.005, 0.1, 0.5)
    known = position_scale((1000, lag(15.0, -0.08)), (700, lag(10.5, -0.08)), NAME, forward_is_zero=True)
    assert known.scale == pytest.approx(0.015) and known.half_width < 0.02
    unsure = position_scale((1000, wide), (700, replace(wide, gain_per_s=10.5)), NAME, forward_is_zero=True)
    assert unsure.scale is None, "as little as nothing is known of what is fed forward"
    other = position_scale((1000, lag(15.0, 0.4)), (700, lag(10.5, 0.4)), NAME, forward_is_zero=True)
    assert other.scale is None, "something else feeds the speed forward"
    as_time = position_scale((1000, lag(15.0)), (700, lag(15.0 / 0.7)), NAME)
    assert as_time.scale is None and "exponent 1.00, not -1" in as_time.why
    without_effect = position_scale((1000, lag(15.0)), (700, lag(15.0)), NAME)
    assert without_effect.scale is None and "exponent" in without_effect.why
