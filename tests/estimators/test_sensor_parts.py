# SPDX-License-Identifier: MIT
"""Current sensors of unequal gain and the slowly turned encoder, against sums over phases and closed forms."""

from __future__ import annotations

import math
from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest

from pmsmtool.arrays import Array
from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.current_sensors import (
    DOUBT,
    Noise,
    SensorMismatch,
    estimate_mismatch,
    widened,
    without_mismatch,
)
from pmsmtool.estimators.encoder import INTEGER_LIMIT, check_encoder_counts, estimate_encoder
from pmsmtool.machine.parameters import Estimate
from pmsmtool.trace import Trace

EXACT = 1e-9
"""The same numbers by another formula (relative); measured: below 1e-12."""


def _trace(t: Array, meta: dict[str, Any] | None = None, **signals: Array) -> Trace:
    return Trace(t, signals, dict.fromkeys(signals, "1"), meta or {})


# ---- current sensors --------------------------------------------------------------------------------------------


def _pairs(gains: tuple[float, float, float]) -> Trace:
    """Two currents with phase a, b and c idle in turn, as sensors of these gains show them; offsets beside."""
    rows = []
    for idle in range(3):
        for current in (2.0, 6.0):
            phases = np.array([current, -current])
            row = np.insert(phases, idle, 0.0) * (1.0 + np.array(gains)) + np.array([0.3, -0.1, 0.2])
            rows.append(row)
    shown = np.array(rows)
    return _trace(np.arange(6.0), i_a_a=shown[:, 0], i_b_a=shown[:, 1], i_c_a=shown[:, 2])


def test_three_pairs_show_the_gains_over_their_mean() -> None:
    """To first order in them; the deviation is that of one equation in three over the step of 4 A."""
    gains = (4e-3, -1e-3, -3e-3)
    found = estimate_mismatch(_pairs(gains), Noise(0.05, 0.0, 0.0))
    assert found.gains == pytest.approx(gains, abs=3e-5)  # squares: 2e-5
    assert found.std == pytest.approx(0.05 / (16.0 * 4.0), rel=0.01)
    assert found.spread == pytest.approx(7e-3, abs=5e-5)
    assert found.doubt == pytest.approx(math.hypot(DOUBT * found.spread, found.std), rel=EXACT)


@pytest.mark.parametrize(
    ("largest", "std", "corrected"),
    [(0.002, 1e-5, False), (0.0021, 1e-5, True), (-0.0021, 1e-5, True), (0.01, 0.0025, False), (0.01, 0.00249, True)],
)
def test_a_mismatch_counts_where_it_is_large_and_sure(largest: float, std: float, corrected: bool) -> None:
    mismatch = SensorMismatch((largest, -0.5 * largest, -0.5 * largest), std)
    assert mismatch.corrected is corrected
    doubt = math.hypot(DOUBT * 1.5 * abs(largest), std) if corrected else 0.0
    assert mismatch.doubt == pytest.approx(doubt, rel=EXACT)
    estimate = Estimate(-3.0, 0.04, 0.0, "1")
    assert widened(estimate, mismatch).std == pytest.approx(math.hypot(0.04, 3.0 * doubt), rel=EXACT)
    assert widened(estimate, None) is estimate


def test_currents_of_unequal_sensors_are_shown_as_equal_ones() -> None:
    gains, angle = (0.02, -0.015, -0.005), 0.7
    true = np.array([[5.0, -2.0], [1.0, 3.0]])  # d and q at two instants
    vector = (true[0] + 1j * true[1]) * np.exp(1j * angle)
    phases = [(vector * np.exp(-2j * math.pi / 3.0 * k)).real * (1.0 + gains[k]) for k in range(3)]
    seen = (
        2.0 / 3.0 * sum(phase * np.exp(2j * math.pi / 3.0 * k) for k, phase in enumerate(phases)) * np.exp(-1j * angle)
    )
    shown = _trace(np.arange(2.0), i_d_a=seen.real, i_q_a=seen.imag, i_d_first_a=seen.real, u_d_v=seen.real)
    found = without_mismatch(shown, SensorMismatch(gains, 1e-5), angle)
    assert found["i_d_a"] == pytest.approx(true[0], rel=EXACT) and found["i_q_a"] == pytest.approx(true[1], rel=EXACT)
    assert found["u_d_v"] == pytest.approx(seen.real)
    # halves have no current across: what it is there is taken for none
    only = without_mismatch(
        _trace(np.arange(2.0), i_d_a=seen.real, i_q_a=0.0 * seen.imag), SensorMismatch(gains, 1e-5), angle
    )
    assert found["i_d_first_a"] == pytest.approx(only["i_d_a"], rel=EXACT)


# ---- encoder ----------------------------------------------------------------------------------------------------


def test_an_encoder_must_count_what_friction_leaves_of_the_vectors_way() -> None:
    for measured in (0.99 * 0.25 * 6.4 / 64.0, 1.01 * 0.25 * 6.4 / 64.0):
        turned = _trace(
            np.arange(2.0), theta_imposed_rad=np.array([0.2, 6.6]), theta_M_rad=np.array([0.5, 0.5 - measured])
        )
        told = pytest.raises(IdentificationError, match="turned by 366.7 deg .electrical. and the encoder by 1.4 deg")
        with nullcontext() if measured > 0.025 else told:
            check_encoder_counts(turned)


def _slow(pairs: float, lag: float, ripple: float, turns: float = 1.05) -> tuple[Trace, Trace]:
    imposed = np.linspace(0.0, 2.0 * math.pi * abs(round(pairs)) * turns, 2001)
    runs = []
    for sign, angle in ((1.0, imposed), (-1.0, imposed[::-1])):
        ahead = angle - sign * lag + ripple * np.cos(9.0 * angle + sign) + 0.6
        runs.append(_trace(imposed, theta_imposed_rad=angle, theta_M_rad=ahead / pairs))
    return runs[0], runs[1]


@pytest.mark.parametrize("pairs", [3.0, -4.0])
def test_the_offset_of_a_turned_rotor_has_the_scatter_of_both_runs(pairs: float) -> None:
    found = estimate_encoder(*_slow(pairs, 0.2, 0.1))
    assert (found.pole_pairs.value, found.direction) == (
        abs(pairs),
        math.copysign(1, pairs),
    ) and found.pole_pairs.n == 4002
    assert found.offset.value == pytest.approx(0.6, abs=1e-3) and found.lag_rad == pytest.approx(-0.2, abs=1e-3)
    scatter = 0.1 / math.sqrt(2.0)
    assert found.offset.std == pytest.approx(math.hypot(scatter * math.sqrt(2.0) / 2.0, 0.25 * 0.2), rel=1e-2)
    assert found.pole_pairs.std < 0.02


def test_the_count_of_pole_pairs_is_an_integer_within_a_tenth() -> None:
    for pairs, integer in ((3.0 + 0.99 * INTEGER_LIMIT, True), (3.0 + 1.01 * INTEGER_LIMIT, False)):
        told = pytest.raises(
            IdentificationError, match=f"E_POLE_PAIRS: .* is {pairs:.3f} forward and {pairs:.3f} backward"
        )
        turning = _slow(pairs, 0.0, 0.0, 1.05)
        with nullcontext() if integer else told:
            assert estimate_encoder(*turning).pole_pairs.std == pytest.approx(0.99 * INTEGER_LIMIT, rel=1e-6)
