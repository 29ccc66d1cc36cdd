# SPDX-License-Identifier: MIT
"""The model that tracking fits, its windows and their ripple, against differences and written-out means."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pmsmtool.estimators.inverter_error import InverterCurve
from pmsmtool.estimators.tracking_model import (
    Known,
    inputs,
    model_slopes,
    model_voltage,
    ripple_v,
    steady,
    tail_of,
    windows,
)
from pmsmtool.trace import Trace
from tests.estimators.traces import trace_of

EXACT = 1e-9
"""The same numbers by another formula (relative); measured: below 1e-12."""
T_S = 1e-4


CURVE = InverterCurve(np.array([0.5, 1.0, 4.0]), np.array([0.4, 0.8, 1.0]), 0.0)
KNOWN = Known(0.5, 0.1, 2e-3, 3e-3, T_S, curve=CURVE)


def test_slopes_of_the_tracked_model_are_those_of_differences() -> None:
    given = np.array([3.0, -4.0, 350.0, 0.7, -0.9, 40.0, -60.0, 900.0, 0.3, -0.2])
    scale, x = KNOWN.scale, np.array([1.1, 0.9, 1.0, 1.05, 0.97, 0.4, 0.0])
    slopes = []
    for k in range(7):
        h = 1e-5 * np.eye(7)[k]
        slopes.append(
            (
                model_voltage(np.ones(7) * (np.arange(7) < 5) + h, given, scale)
                - model_voltage(np.ones(7) * (np.arange(7) < 5) - h, given, scale)
            )
            / 2e-5
        )
    assert model_slopes(given, scale) == pytest.approx(np.array(slopes).T, rel=1e-6, abs=1e-9)
    R, psi, _, L_d, L_q, _, _ = x * scale
    u_d = R * 3.0 + 350.0 * L_q * 4.0 + 0.7 + 0.4 * 0.3 + L_d * 40.0
    u_q = -R * 4.0 + 350.0 * (psi + L_d * 3.0) - 0.9 - 0.4 * 0.2 - L_q * 60.0
    assert model_voltage(x, given, scale) == pytest.approx([u_d, u_q], rel=EXACT)
    late = model_voltage(np.append(x[:6], 2.0), given, scale) - model_voltage(x, given, scale)
    assert late == pytest.approx([2e-3 * 900.0 * L_q * 4.0, 2e-3 * 900.0 * (psi + L_d * 3.0)], rel=EXACT)


def test_the_start_of_a_track_is_what_is_known() -> None:
    known = replace(KNOWN, error_share=(0.3, 0.2), L_std=(0.04, 0.05))
    assert known.start.tolist() == [1.0, 1.0, 0.3, 1.0, 1.0, 0.0, 0.0]
    assert known.start_std == pytest.approx([0.3, 0.1, 0.2, 0.04, 0.05, 0.2, 5.0])
    assert known.scale == pytest.approx([0.5, 0.1, 1.0, 2e-3, 3e-3, 1.0, 1e-3])


def _rows(n: int = 46) -> Trace:
    k = np.arange(float(n))
    return trace_of(0.01 * k, u_d_v=k, u_q_v=-k, i_d_a=1.0 + 0.02 * k, i_q_a=3.0 - 0.01 * k, omega_e_rad_s=100.0 + k,
                  T_winding_c=20.0 + k, flags=np.where(k == 13.0, 4.0, 0.0))  # fmt: skip


def test_windows_are_means_and_rises_of_their_rows() -> None:
    found = windows(_rows(), 9)
    assert len(found) == 5 and found.meta["window_s"] == pytest.approx(0.09) and found.meta["rows"] == 9
    assert found.t_s == pytest.approx(0.01 * (4.0 + 9.0 * np.arange(5)))
    assert found["u_d_v"] == pytest.approx(4.0 + 9.0 * np.arange(5)) and found["T_winding_c"][1] == pytest.approx(33.0)
    # halves of four rows are five rows apart; twice that is the rise of the window
    assert found["d_rise_a"] == pytest.approx(np.full(5, 0.2)) and found["q_rise_a"] == pytest.approx(np.full(5, -0.1))
    assert found["omega_rise_rad_s"] == pytest.approx(np.full(5, 10.0))
    assert found["limited"].tolist() == [0.0, 1.0, 0.0, 0.0, 0.0] and windows(_rows(), 9, 0.5).meta["window_s"] == 4.5
    with pytest.raises(ValueError, match="has no u_q_v"):
        windows(
            trace_of(np.arange(3.0), **{n: np.arange(3.0) for n in ("u_d_v", "i_d_a", "i_q_a", "omega_e_rad_s")}), 1
        )


def test_windows_of_a_transient_and_the_next_are_left_out() -> None:
    n = 60
    base = windows(_rows(9 * n), 9)
    rises = {name: np.full(n, 1e-4) for name in ("d_rise_a", "q_rise_a", "omega_rise_rad_s")}
    part = trace_of(base.t_s, **{**base.signals, **rises, "limited": np.zeros(n)})
    largest, fastest = np.max(np.hypot(part["i_d_a"], part["i_q_a"])), np.max(part["omega_e_rad_s"])
    for name, size in (("d_rise_a", largest), ("q_rise_a", largest), ("omega_rise_rad_s", fastest)):
        for share, gone in ((-0.049, []), (0.049, []), (0.051, [20, 21]), (-0.051, [20, 21])):
            rise = rises[name].copy()
            rise[20] = share * size
            kept = steady([trace_of(part.t_s, **{**part.signals, name: rise})])[0]
            assert kept.t_s == pytest.approx(np.delete(part.t_s, gone))
    noisy = trace_of(
        part.t_s, **{**part.signals, "d_rise_a": np.full(n, 0.02 * largest) + 0.07 * largest * (np.arange(n) == 5)}
    )
    assert len(steady([noisy])[0]) == n  # five times the median is more than a twentieth
    limited = trace_of(part.t_s, **{**part.signals, "limited": (np.arange(n) == 3).astype(float)})
    assert len(steady([limited])[0]) == n - 1


def test_the_inputs_hold_the_sampled_speed_the_curve_and_its_tail() -> None:
    found = windows(_rows(), 9)
    given = inputs(found, KNOWN)
    w = found["omega_e_rad_s"]
    x = 0.5 * w * T_S
    assert given[:, 2] == pytest.approx(w * np.sin(x) / x, rel=EXACT)
    assert given[:, 5:8] == pytest.approx(
        np.column_stack([np.full(5, 0.2), np.full(5, -0.1), np.full(5, 10.0)]) / 0.09, rel=1e-6
    )
    assert not np.any(inputs(found, replace(KNOWN, curve=None))[:, [3, 4, 8, 9]])
    tail = tail_of(CURVE)
    assert tail.u_error_v == pytest.approx([0.4 / 1.5, 0.4, 0.2]) and np.all(tail.i_phase_a == CURVE.i_phase_a)


def test_a_window_keeps_what_the_mean_of_its_rows_leaves_of_the_sixth_harmonic() -> None:
    """The mean of cos(6 w t + phase) over rows, its largest over the phase; 12/35 across and 2/35 along."""
    found = windows(_rows(), 9)
    given = inputs(found, KNOWN)
    expected = []
    for row, w in zip(given, found["omega_e_rad_s"], strict=True):
        left = abs(np.mean(np.exp(6j * w * 0.01 * np.arange(9))))
        i, e = np.hypot(row[0], row[1]), np.hypot(row[3], row[4])
        along = np.array([row[0], row[1]]) / i
        across = np.array([-along[1], along[0]])
        expected.append(e * left * np.hypot(12.0 / 35.0 * np.abs(across), 2.0 / 35.0 * np.abs(along)))
    assert ripple_v(found, given) == pytest.approx(np.array(expected), rel=1e-6)
    still = trace_of(found.t_s, dict(found.meta), **{**found.signals, "omega_e_rad_s": np.zeros(5)})
    whole = ripple_v(still, given)
    assert np.max(np.hypot(*whole.T)) == pytest.approx(
        np.max(np.hypot(given[:, 3], given[:, 4])) * math.hypot(12.0, 2.0) / 35.0
    )
    assert not np.any(ripple_v(trace_of(found.t_s, **found.signals), given))
