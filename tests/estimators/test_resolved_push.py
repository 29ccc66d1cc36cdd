# SPDX-License-Identifier: MIT
"""Pushes resolved in time: a plant with the rise of the current, a lagging frame and an error along and across it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.resolved_push import BLOCK, HARMONIC, LEAST_WEIGHT, Resolved, push_blocks, resolve
from pmsmtool.trace import Trace

T_S, PAIRS, SAMPLES = 1e-4, 3, 1024
R, PSI, L_D, L_Q, V_DEAD = 0.3, 0.11, 1.5e-3, 2.4e-3, 1.2
LEVELS = (2.0, 3.0, 4.5, 6.0, 8.0, 10.0)
RISE_S, TURN_RAD_S = 0.02, 70.0
OBSERVER_S = 5e-3  # lag of the drive's own speed


def push(level: float, *, incremental: float = 1.0, lag_s: float = OBSERVER_S, rises: bool = True) -> Trace:
    """One push from -level to level, of a shaft that swings between -w and w; no noise, so no seed decides.

    The drive turns its voltage ahead by a speed that lags, the inverter's error lies along and across the current, and
    the incremental inductances are a share of the apparent ones.
    """
    t = np.arange(SAMPLES) * round(5.0 * LEVELS[-1] / level) * T_S  # the same speeds with less current
    rate = 60.0 * level * PAIRS

    def current(at: np.ndarray) -> np.ndarray:
        left = np.exp((1j * TURN_RAD_S - 1.0 / RISE_S) * at)
        return np.asarray(1j * level * (1.0 - 2.0 * rises * left))

    def speed(at: np.ndarray) -> np.ndarray:
        return np.asarray(rate * (at - t[-1] / 2.0))

    late = t + 1.5 * T_S
    i, w = current(late), speed(late)
    slope = (current(late + 1e-6) - current(late - 1e-6)) / 2e-6
    along = i / np.abs(i)
    u = R * i + 1j * w * (PSI + L_D * i.real + 1j * L_Q * i.imag)
    u += incremental * (L_D * slope.real + 1j * L_Q * slope.imag)
    u += V_DEAD * (1.0 - 0.3 / np.abs(i)) * along
    u += 1j * np.sign(w) * 0.15 * V_DEAD * np.minimum(1.0, np.abs(w) / 300.0) * along
    x = 0.5 * w * T_S
    own = speed(t) - lag_s * rate
    u *= np.sinc(x / math.pi) * np.exp(-1.5j * T_S * (own - speed(t)))
    signals = {
        "i_d_a": current(t).real, "i_q_a": current(t).imag, "u_d_v": u.real, "u_q_v": u.imag, "omega_e_rad_s": own,
        "theta_M_rad": 0.5 * rate * (t - t[-1] / 2.0) ** 2 / PAIRS, "flagged": np.zeros(SAMPLES),
    }  # fmt: skip
    return Trace(t, signals, dict.fromkeys(signals, "1"), {})


def solved(pushes: Sequence[Trace]) -> Resolved:
    return resolve([push_blocks(one, T_S, PAIRS) for one in pushes])


def swing(**how: float) -> list[Trace]:
    """Both signs: a push the other way is the same one turned by half a turn, with the speed reversed."""
    forward = [push(level, **how) for level in LEVELS]
    return [one for trace in forward for one in (trace, _mirrored(trace))]


def _mirrored(trace: Trace) -> Trace:
    even = ("i_d_a", "u_d_v", "flagged")
    return replace(trace, signals={k: v if k in even else -np.asarray(v) for k, v in trace.signals.items()})


def test_a_push_shows_its_acceleration_its_lag_and_its_current() -> None:
    """A lag of 5 ms behind a shaft that gains 900 rad/s a second is 4.5 rad/s; backwards the other way."""
    forward = push(5.0)
    for trace, sign in ((forward, 1.0), (_mirrored(forward), -1.0)):
        blocks = push_blocks(trace, T_S, PAIRS)
        assert blocks.rate == pytest.approx(60.0 * 5.0 * PAIRS, rel=1e-3)
        assert blocks.lag == pytest.approx(-sign * OBSERVER_S * 900.0, rel=1e-3)
        assert blocks.i_q == pytest.approx(float(np.mean(trace["i_q_a"])), rel=1e-9)


@pytest.mark.parametrize("incremental", [1.0, 0.6])
def test_the_whole_push_gives_resistance_flux_and_apparent_inductance(incremental: float) -> None:
    found = solved(swing(incremental=incremental))
    R_ohm, psi_q, psi_d, L_q_h, V_v = found.value
    # measured: R 0.02 and 0.16 %, psi 4e-6, L_q 0.05 and 0.20 %, V 0.06 and 0.5 %
    assert pytest.approx(R, rel=3e-3) == R_ohm
    assert psi_q == pytest.approx(PSI, rel=3e-5) and abs(psi_d) < 1e-6 * PSI
    assert pytest.approx(L_Q, rel=3e-3) == L_q_h
    assert pytest.approx(V_DEAD, rel=1e-2) == V_v
    assert found.rows > 0.9 * 2 * len(LEVELS) * SAMPLES / BLOCK
    assert found.reactance_v == pytest.approx(found.value[3] * 140.0 * 10.0, rel=0.6)


def test_the_lag_of_the_drives_own_speed_is_taken_back() -> None:
    """Believing that its voltages stand in the true frame counts the lag as inductance: 0.63 % here."""
    lagging, ideal = solved(swing()), solved(swing(lag_s=0.0))
    assert lagging.value == pytest.approx(ideal.value, rel=1e-9, abs=1e-12)
    believed = [
        replace(p, signals={**p.signals, "omega_e_rad_s": PAIRS * np.gradient(p["theta_M_rad"], p.t_s[1])})
        for p in swing()
    ]
    assert solved(believed).value[3] > 1.004 * L_Q


def test_the_error_across_the_current_is_no_inductance() -> None:
    """On random drives it was up to a quarter of the one along it, as here with more of it; measured: 0.12 %."""
    more = [replace(p, signals={**p.signals, "u_d_v": p["u_d_v"] + _across(p)}) for p in swing()]
    assert solved(more).value[3] == pytest.approx(L_Q, rel=3e-3)


def _across(trace: Trace) -> np.ndarray:
    """Return more of the error across the current, for a settled one (V)."""
    w = PAIRS * np.gradient(np.asarray(trace["theta_M_rad"]), trace.t_s[1])
    return np.asarray(
        -0.1 * V_DEAD * np.sign(w) * np.sign(np.mean(trace["i_q_a"])) * np.minimum(1.0, np.abs(w) / 115.0)
    )


def test_blocks_without_a_beat_count_less() -> None:
    """At standstill, and where the samples come once per period of the sixth harmonic."""
    spacing_s = 5.0 * T_S
    alias = 2.0 * math.pi / (HARMONIC * spacing_s)
    trace = push(LEVELS[-1])
    fast = replace(trace, t_s=trace.t_s, signals={**trace.signals, "theta_M_rad": alias * trace.t_s / PAIRS})
    assert push_blocks(fast, T_S, PAIRS).weight.max() == LEAST_WEIGHT
    usual = push_blocks(trace, T_S, PAIRS)
    assert usual.weight[np.abs(usual.w) < 0.01 * alias].max() == LEAST_WEIGHT
    assert usual.weight[np.abs(usual.w) > 0.2 * alias].min() == 1.0


def test_limited_samples_and_their_neighbours_are_left_out() -> None:
    trace = push(LEVELS[-1])
    flagged = np.zeros(SAMPLES)
    flagged[40 * BLOCK + 3] = 1.0
    marked = push_blocks(replace(trace, signals={**trace.signals, "flagged": flagged}), T_S, PAIRS)
    assert len(marked.w) == len(push_blocks(trace, T_S, PAIRS).w) - 3


def test_a_push_too_short_is_refused() -> None:
    trace = push(LEVELS[-1])
    short = Trace(trace.t_s[:60], {k: v[:60] for k, v in trace.signals.items()}, trace.units, {})
    with pytest.raises(IdentificationError, match="too short"):
        push_blocks(short, T_S, PAIRS)
