# SPDX-License-Identifier: MIT
"""Resistance from a bench supply's readings: truth, rounding, the current gain's doubt, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.estimate import SensorTolerance, total_half_width
from pmsmtool.experiments.standstill import LEVELS
from pmsmtool.identification.supply_power import LOSS_DOUBT, SUPPLY_TOLERANCE, resistance_by_supply
from pmsmtool.trace import Trace

R, DROP, IDLE, U = 0.12, 1.5, 6.0, 48.0


def readings(i_max: float = 20.0, digit_a: float = 0.0, R_ohm: float = R, seed: int = 0) -> Trace:
    i = i_max * np.array(LEVELS)
    amps = (IDLE + DROP * i + 1.5 * R_ohm * i**2) / U
    if digit_a:
        amps = np.round((amps + np.random.default_rng(seed).uniform(-0.5, 0.5, len(i)) * digit_a) / digit_a) * digit_a
    signals = {"i_command_a": i, "supply_v": np.full(len(i), U), "supply_i_a": amps}
    return Trace(0.5 * np.arange(len(i)), signals, {"i_command_a": "A", "supply_v": "V", "supply_i_a": "A"}, {})


def test_the_loop_resistance_without_idle_power_and_drops() -> None:
    found = resistance_by_supply(readings())
    assert found.value == pytest.approx(R, rel=1e-9) and found.unit == "ohm"
    assert found.systematic == pytest.approx(R * np.sqrt((2 * 0.01) ** 2 + SUPPLY_TOLERANCE**2 + LOSS_DOUBT**2))
    wide = resistance_by_supply(readings(), tolerance=SensorTolerance(current_gain=0.03))
    assert wide.systematic == pytest.approx(R * np.sqrt(0.06**2 + SUPPLY_TOLERANCE**2 + LOSS_DOUBT**2))


def test_the_statistical_part_covers_a_coarse_display() -> None:
    found = [resistance_by_supply(readings(digit_a=0.01, seed=seed)) for seed in range(100)]
    hits = sum(abs(e.value - R) <= total_half_width(e) for e in found)
    assert hits >= 88  # 95 %, binomial at 100: below 88 once in a thousand
    assert 1e-4 < np.median([e.std / e.value for e in found]) < 0.01  # measured: 0.2 %


def first(trace: Trace, rows: int) -> Trace:
    return Trace(trace.t_s[:rows], {name: s[:rows] for name, s in trace.signals.items()}, trace.units, {})


@pytest.mark.parametrize(
    ("trace", "reason"),
    [
        (readings(i_max=2.0, digit_a=0.05), "E_SNR"),
        (readings(R_ohm=-0.1), "E_NOT_CONNECTED"),
        (first(readings(), 4), "E_EXCITATION"),
    ],
)
def test_readings_that_tell_nothing_are_refused(trace: Trace, reason: str) -> None:
    with pytest.raises(IdentificationError, match=reason):
        resistance_by_supply(trace)
