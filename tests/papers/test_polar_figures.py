# SPDX-License-Identifier: MIT
"""Figures of the polar-coordinate paper: every expected number within its range, baselines beside every comparison."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pmsmtool.papers import polar_limit, polar_linear, polar_steps, polar_sweep, statistics
from pmsmtool.papers.figure import Reproduction
from pmsmtool.papers.polar_scene import (
    BASELINES,
    CONVENTIONAL,
    EXPERIMENT,
    K_T,
    SIMULATION,
    UNIFIED_TUNED,
    Response,
    machine_file,
    run,
    steps,
)
from pmsmtool.papers.registry import FIGURES, MIYAJIMA, reproduce

ROWS = {row.name: row for row in FIGURES if row.source == MIYAJIMA}
REDUCED = {
    "polar-noise": lambda: polar_linear.at_zero_voltage(0, realisations=6, spikes=6),
    "polar-sweep": lambda: polar_sweep.sweep(0, machines=8),
}
"""Figures with sizes of their own; full size by ``pmsmtool reproduce``."""
WITHOUT_CONTROL = ("polar-equilibria", "polar-map", "polar-gains")
PRINTED_FIGURES = {f"miyajima-fig{number}" for number in (2, 3, 4, 5, 7, 8, 9, 10)}


def compute(name: str) -> Reproduction:
    return REDUCED[name]() if name in REDUCED else reproduce(name, 0)


def test_every_plotted_figure_of_the_paper_is_there() -> None:
    assert set(ROWS) >= PRINTED_FIGURES  # 1 and 6 are block diagrams


@pytest.mark.chain
@pytest.mark.parametrize("name", sorted(ROWS))
def test_figure_is_within_its_ranges_and_prints_the_baselines(name: str) -> None:
    figure = compute(name)
    assert figure.checks
    missed = [(check.what, check.ours, check.allowed) for check in figure.checks if not check.within]
    assert missed == []
    assert figure.panels
    assert all(series.x.shape == series.y.shape for panel in figure.panels for series in panel.series)
    if name not in WITHOUT_CONTROL:
        printed = {str(row[0]) for table in figure.tables for row in table.rows}
        assert {law.name for law in BASELINES} <= {name.split(":")[0] for name in printed}


@pytest.mark.chain
def test_a_wrong_law_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(polar_steps, "PROPOSED", CONVENTIONAL)
    found = {check.what: check.within for check in polar_steps.figure_3(0).checks}
    assert not found["proposed: steady |i_d|"]
    assert not found["area of i_d > 0 / conventional"]


def test_same_seed_same_numbers() -> None:
    first, again, other = (polar_steps.response(UNIFIED_TUNED, EXPERIMENT, seed) for seed in (3, 3, 4))
    assert np.array_equal(first.i_q, again.i_q)
    assert not np.array_equal(first.i_q, other.i_q)


def test_amperes_are_power_invariant() -> None:
    r = run(UNIFIED_TUNED, SIMULATION, steps([(0.0, 0.0), (0.01, 2.0)]), [(0.0, 300.0)], 0.05)
    assert r.torque[-1] == pytest.approx(K_T * r.i_q[-1], rel=1e-4)
    assert machine_file().machine.torque_nm(0.0, math.sqrt(2 / 3) / K_T) == pytest.approx(1.0, rel=1e-4)
    assert np.hypot(r.u_d[-1], r.u_q[-1]) == pytest.approx(abs(r.V_a[-1]), rel=1e-12)


# ---- measures --------------------------------------------------------------------------------------------------


def response(i_d: np.ndarray, i_q: np.ndarray, delta: np.ndarray | None = None) -> Response:
    t = 1e-4 * np.arange(len(i_q))
    zero = np.zeros_like(t)
    return Response(t, i_d, i_q, K_T * i_q, zero, zero, zero if delta is None else delta, zero, zero, zero, zero, zero)


def test_settling_counts_to_the_last_sample_outside() -> None:
    t = 1e-3 * np.arange(5)
    assert statistics.settling_ms(t, np.array([0.0, 1.2, 1.0, 1.2, 1.0]), 1.0, 0.1) == pytest.approx(4.0)
    assert statistics.settling_ms(t, np.ones(5), 1.0, 0.1) == 0.0
    assert math.isinf(statistics.settling_ms(t, np.array([1.0, 1.0, 1.0, 1.0, 1.2]), 1.0, 0.1))


def test_torque_step_measures() -> None:
    low, high = 1.0 / K_T, 3.0 / K_T
    i_q = np.repeat([low, high, low], 400)
    i_q[400:420] = np.linspace(low, high, 20)
    i_q[420] = high + 0.1 * (high - low)
    i_d = np.zeros(1200)
    i_d[810:820] = 2.0
    m = statistics.torque_step(response(i_d, i_q), 0.04, 0.08, 1.0, 3.0)
    assert m.up_ms == pytest.approx(2.1)
    assert (m.over_up, m.over_down) == pytest.approx((10.0, 0.0))
    assert (m.peak_a, m.area_mas) == pytest.approx((2.0, 2.0))
    assert m.loss_w == pytest.approx(0.157 * high**2)


def test_phase_steps_are_counted_modulo_pi() -> None:
    delta = np.tile([1.5, -1.5], 50)
    r = response(np.zeros(100), np.zeros(100), delta)
    assert statistics.phase_step_rms(r, 0.0) == pytest.approx(math.pi - 3.0)


def test_bump_is_what_deviates_from_the_slow_error() -> None:
    i_q = np.zeros(2000)
    i_q[1000:1010] = 1.0
    r = response(np.zeros(2000), i_q)
    assert statistics.torque_bump(r, 0.05, 0.15) == pytest.approx(K_T * (1 - 10 / 200))


# ---- modulation ------------------------------------------------------------------------------------------------


def test_delivered_fundamental_is_linear_up_to_the_limit_and_ends_in_six_step() -> None:
    ratios = np.array([0.5, 1.0, 1.05, 1.2, 1e4])
    got = polar_limit.delivered(ratios)
    assert got[:2] == pytest.approx(ratios[:2], rel=1e-6)
    assert (np.diff(got) > 0).all()
    assert got[-1] == pytest.approx(polar_limit.SIX_STEP, rel=1e-4)
