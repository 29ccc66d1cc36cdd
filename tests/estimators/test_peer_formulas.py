# SPDX-License-Identifier: MIT
"""The formulas of other tools are exact where their assumptions hold, and off where they do not: the table is fair."""

import math

import numpy as np
import pytest

from benchmarks.peer_formulas import (
    curve_fit_resistance,
    single_point_resistance,
    speed_flux,
    table,
    two_point_resistance,
)
from pmsmtool.trace import Trace

I_A = np.array([sign * k / 12.0 for k in range(1, 13) for sign in (1.0, -1.0)])


def trace(**signals: np.ndarray) -> Trace:
    n = len(next(iter(signals.values())))
    return Trace(np.arange(n, dtype=np.float64), signals, dict.fromkeys(signals, "1"), {})


def levels(V_dead_v: float, knee_a: float, shape: str = "tanh") -> Trace:
    x = I_A / knee_a
    e = np.tanh(x) if shape == "tanh" else 2.0 / math.pi * np.arctan(x)
    return trace(i_d_a=I_A, u_d_v=2.0 * I_A + V_dead_v * e)


def test_every_resistance_is_exact_without_dead_time() -> None:
    ideal = levels(0.0, 0.1)
    for formula in (single_point_resistance, two_point_resistance, curve_fit_resistance):
        assert formula(ideal) == pytest.approx(2.0)


def test_a_fixed_curve_is_exact_in_its_class_and_biased_out_of_it() -> None:
    assert curve_fit_resistance(levels(3.0, 0.05)) == pytest.approx(2.0, rel=0.01)
    assert abs(curve_fit_resistance(levels(3.0, 0.05, "atan")) / 2.0 - 1.0) > 0.03
    assert single_point_resistance(levels(3.0, 0.05)) == pytest.approx(5.0, rel=1e-3)


def test_the_flux_of_one_speed_takes_the_dead_time_for_flux() -> None:
    w = np.array([100.0, 200.0, -100.0, -200.0])
    i_q = 0.5 * np.sign(w)
    ideal = trace(omega_e_rad_s=w, i_q_a=i_q, u_q_v=0.3 * w + 2.0 * i_q)
    real = trace(omega_e_rad_s=w, i_q_a=i_q, u_q_v=0.3 * w + 2.0 * i_q + 3.0 * np.sign(w))
    for slope in (False, True):
        assert speed_flux({"speeds": ideal}, 2.0, slope=slope) == pytest.approx(0.3)
    assert speed_flux({"speeds": real}, 2.0, slope=False) == pytest.approx(0.3 + 3.0 / 200.0)
    assert speed_flux({"speeds": real}, 2.0, slope=True) > 0.3


def test_the_table_prints_quantiles_in_percent() -> None:
    text = table({("R", "ours"): [0.01, -0.02, 0.03]}, 3, 0)
    assert text.splitlines()[-1].split() == ["R", "ours", "2.000", "2.800", "3.000"]
