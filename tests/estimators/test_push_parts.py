# SPDX-License-Identifier: MIT
"""Each step of the recorded and the polled torque pushes by itself: rows, regressions, scatter, doubts, limits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from pmsmtool.arrays import Array
from pmsmtool.errors import IdentificationError
from pmsmtool.estimators import recorded_push, resolved_push
from pmsmtool.estimators.estimate import SensorTolerance, coverage_factor
from pmsmtool.estimators.recorded_push import (
    DELAY_DOUBT,
    FRAME_FLOOR_RAD,
    L_Q_FLOOR,
    L_Q_PER_ERROR,
    LEAST_PUSHES,
    PSI_FLOOR,
    PSI_LIMIT,
    R_FLOOR,
    R_LIMIT,
    R_PER_ERROR,
    PushResult,
    estimate_pushes,
)
from pmsmtool.estimators.resolved_push import (
    BLOCK,
    CLEAN_SHARE,
    LEAST_BLOCKS,
    Blocks,
    Resolved,
    Rows,
    Shape,
    push_blocks,
)
from pmsmtool.estimators.shaft.inertia_ratio import jackknife_variance, regress
from pmsmtool.trace import Trace
from tests.estimators.traces import trace_of

EXACT = 1e-9
"""The same numbers by another formula (relative); measured: below 1e-10."""
T_S = 1e-4


# ---- recorded: judgement ----------------------------------------------------------------------------------------

PSI_Q, PSI_D, L_Q, V_DEAD = 0.2, 0.05, 3e-3, 1.5
SIZE = math.hypot(PSI_Q, PSI_D)
STD = np.array([0.002, 0.001, 0.0012, 2e-5, 0.1])
HALF = coverage_factor(5.0)


def _judged(
    monkeypatch: pytest.MonkeyPatch, *, std: Array = STD, psi_q: float = PSI_Q, R_ohm: float = 0.4,
    tolerance: SensorTolerance | None = None, doubts: Sequence[dict[str, float]] = ({},) * 6,
) -> PushResult:  # fmt: skip
    """Six pushes whose regression has known results; accelerations over currents of 100 to 350, lags of 0.1 to 0.6."""
    rows: Rows = np.zeros(1, np.complex128)
    blocks = iter([
        Blocks(np.zeros(1), rows, rows, rows, np.ones(1), rate=(100.0 + 50.0 * k) * (k + 2.0),
               lag=(-1.0) ** k * 0.1 * (k + 1) * (k + 2.0), i_q=(-1.0) ** k * (k + 2.0))
        for k in range(6)
    ])  # fmt: skip
    found = Resolved(np.array([R_ohm, psi_q, PSI_D, L_Q, V_DEAD]), std, 40.0, 700)
    monkeypatch.setattr(recorded_push, "push_blocks", lambda *_: next(blocks))
    monkeypatch.setattr(recorded_push, "resolve", lambda _: found)
    pushes = [trace_of(np.zeros(1), meta) for meta in doubts]
    return estimate_pushes(pushes, period_s=T_S, pole_pairs=3, tolerance=tolerance)


@pytest.mark.parametrize(
    ("doubts", "doubt"), [(({},) * 6, 0.5), (({DELAY_DOUBT: 0.1}, *({DELAY_DOUBT: 1.2},) * 5), 1.2)]
)
def test_doubts_of_recorded_pushes_add_up(
    monkeypatch: pytest.MonkeyPatch, doubts: Sequence[dict[str, float]], doubt: float
) -> None:
    tolerance = SensorTolerance(current_gain=0.003, voltage_gain=0.004)
    found = _judged(monkeypatch, tolerance=tolerance, doubts=doubts)
    assert found.R is not None
    parts = (0.4 * 0.005, 0.4 * R_FLOOR, R_PER_ERROR * V_DEAD / 7.0, SIZE * doubt * T_S * 225.0)
    assert found.R.systematic == pytest.approx(math.hypot(*parts), rel=EXACT)
    assert found.psi_f.value == pytest.approx(SIZE, rel=EXACT)
    assert found.psi_f.systematic == pytest.approx(SIZE * math.hypot(0.004, PSI_FLOOR), rel=EXACT)
    parts = (L_Q * 0.005, L_Q * L_Q_FLOOR, L_Q * L_Q_PER_ERROR * V_DEAD / 40.0, SIZE * doubt * T_S * 0.35)
    assert found.L_q.systematic == pytest.approx(math.hypot(*parts), rel=EXACT)
    assert found.frame_offset.value == pytest.approx(math.atan(0.25), rel=EXACT)
    assert found.frame_offset.std == pytest.approx(0.0012 / SIZE, rel=EXACT)
    assert found.frame_offset.systematic == FRAME_FLOOR_RAD and found.V_dead_v == V_DEAD
    each = (found.R, found.psi_f, found.L_q)
    assert [e.std for e in each] == [0.002, 0.001, 2e-5] and {(e.n, e.dof) for e in each} == {(700, 5.0)}


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_a_flux_linkage_that_scatters_is_refused_and_a_resistance_left_out(
    monkeypatch: pytest.MonkeyPatch, share: float
) -> None:
    std = STD.copy()
    std[1] = share * PSI_LIMIT * SIZE / HALF
    told = pytest.raises(IdentificationError, match=r"psi scatters by 3 % between the torque pulses, limit 3 %")
    with nullcontext() if share < 1.0 else told:
        _judged(monkeypatch, std=std)
    systematic = _judged(monkeypatch).R.systematic  # type: ignore[union-attr]
    std = STD.copy()
    std[0] = math.sqrt((share * R_LIMIT * 0.4) ** 2 - systematic**2) / HALF
    assert (_judged(monkeypatch, std=std).R is not None) is (share < 1.0)


def test_negative_numbers_of_recorded_pushes_are_none(monkeypatch: pytest.MonkeyPatch) -> None:
    assert _judged(monkeypatch, R_ohm=-0.4).R is None
    for psi_q in (-0.2, 0.0):
        with pytest.raises(IdentificationError, match=rf"E_EXCITATION: the voltage over speed is {psi_q:g} Wb"):
            _judged(monkeypatch, psi_q=psi_q)
    with pytest.raises(
        IdentificationError, match=f"E_EXCITATION: {LEAST_PUSHES - 1} torque pulses, {LEAST_PUSHES} needed"
    ):
        _judged(monkeypatch, doubts=({},) * (LEAST_PUSHES - 1))


# ---- recorded: rows ---------------------------------------------------------------------------------------------


def _push(blocks: int = 20, *, flagged: Array | None = None, sense: float = 1.0) -> Trace:
    """Currents and voltages that rise in time, a shaft that gains speed, a drive whose speed is 3 rad/s behind."""
    n = blocks * BLOCK + 3  # three samples are left over
    t = 2.0 + 5e-4 * np.arange(n)
    s = t - t[0]
    return trace_of(
        t, i_d_a=0.2 + 0.5 * s, i_q_a=4.0 + 2.0 * s, u_d_v=-3.0 + 40.0 * s, u_q_v=20.0 + 90.0 * s,
        theta_M_rad=sense * (30.0 * s + 0.5 * 800.0 * s**2), omega_e_rad_s=3.0 * (30.0 + 800.0 * s) - 3.0,
        flagged=np.zeros(n) if flagged is None else flagged,
    )  # fmt: skip


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_rows_of_a_push_are_those_of_the_middle_of_its_voltage(sense: float) -> None:
    blocks = push_blocks(_push(sense=sense), T_S, 3)
    s = 5e-4 * (BLOCK * np.arange(1, 19) + 0.5 * (BLOCK - 1))  # the middle of every block but the first and the last
    late = 1.5 * T_S
    speed = 3.0 * (30.0 + 800.0 * s)
    w = speed + 3.0 * 800.0 * late
    # speeds are differences of neighbouring blocks; at the ends one-sided, which makes their slope 1.4 % smaller
    assert blocks.w == pytest.approx(w, rel=1e-3)  # 8e-4
    assert blocks.i == pytest.approx((0.2 + 0.5 * (s + late)) + 1j * (4.0 + 2.0 * (s + late)), rel=EXACT)
    assert blocks.slope == pytest.approx(np.full(18, 0.5 + 2.0j), rel=EXACT)
    x = 0.5 * blocks.w * T_S
    turned = np.exp(1j * late * -3.0)
    u = ((-3.0 + 40.0 * s) + 1j * (20.0 + 90.0 * s)) * x / np.sin(x) * turned
    assert blocks.u == pytest.approx(u, rel=EXACT)
    assert blocks.rate == pytest.approx(2400.0, rel=0.02) and blocks.lag == pytest.approx(-3.0, rel=EXACT)
    assert blocks.i_q == pytest.approx(4.0 + 2.0 * 5e-4 * (20 * BLOCK - 1) / 2.0, rel=EXACT)
    cycles = 6.0 * speed * 5e-4 / (2.0 * math.pi)
    beats = np.clip(8.0 * np.minimum(cycles % 1.0, 1.0 - cycles % 1.0), 0.15, 1.0)
    assert blocks.weight == pytest.approx(beats, rel=EXACT) and np.min(beats) < np.max(beats)


def test_a_push_that_is_short_or_limited_is_refused() -> None:
    with pytest.raises(IdentificationError, match="E_EXCITATION: a torque pulse of 59 samples is too short"):
        push_blocks(_push(LEAST_BLOCKS - 1), T_S, 3)
    assert len(push_blocks(_push(LEAST_BLOCKS), T_S, 3).w) == LEAST_BLOCKS - 2
    for limited in (8, 9):  # of 20 blocks: 0.6 of them must be clean
        flagged = np.zeros(20 * BLOCK + 3)
        flagged[5 : limited * BLOCK : BLOCK] = 1.0
        told = pytest.raises(IdentificationError, match="E_CLIPPED: 45 % of a torque pulse were limited")
        with nullcontext() if 1.0 - limited / 20.0 >= CLEAN_SHARE else told:
            assert len(push_blocks(_push(flagged=flagged), T_S, 3).w) == 20 - limited - 2


# ---- recorded: regression ---------------------------------------------------------------------------------------


def test_slopes_within_the_noise_of_the_others_are_none() -> None:
    """The median is 0.6 and half of all lie within 0.5 of it: 2.965 is the limit."""
    part = np.array([0.6, 1.1, 0.1, 0.7, 0.5, 2.96, -2.97, 2.97, -0.9])
    found = resolved_push._above_noise(part)
    assert np.array_equal(found, np.where(np.abs(part) > 2.965, part, 0.0)) and np.count_nonzero(found) == 2


def _rows() -> tuple[Array, Rows, Rows, Rows]:
    rng = np.random.default_rng(11)
    w = rng.uniform(-300.0, 300.0, 40)
    i = rng.uniform(-1.0, 1.0, 40) + 1j * rng.choice([-1.0, 1.0], 40) * rng.uniform(2.0, 8.0, 40)
    slope = rng.standard_normal(40) + 1j * rng.standard_normal(40)
    return w, i, slope, 10.0 * rng.standard_normal(40) + 1j * w


@pytest.mark.parametrize(
    "shape", [Shape((1,), (0, 1), linear=True), Shape((1, 2), (0, 1, 2), (0.3,)), Shape((2,), (0,), turned=True)]
)
def test_the_regressors_are_those_of_the_model(shape: Shape) -> None:
    """A row's voltage by the model's formula, term by term, is the sum of the columns with the same coefficients."""
    w, i, slope, u = _rows()
    columns = resolved_push._columns(shape, w, i, slope, u)
    rng = np.random.default_rng(12)
    c = iter(coefficients := rng.standard_normal(len(columns)))
    size, speed = np.abs(i), np.abs(w)
    e, share = i / size, size / np.max(size)
    voltage = next(c) * i + 1j * w * next(c) + w * next(c)  # R, psi_q, psi_d
    L_q, V = next(c), next(c)
    L_d = next(c)
    voltage += 1j * w * (L_d * i.real + 1j * L_q * i.imag) + V * e
    if shape.linear:
        voltage += L_d * slope.real + 1j * L_q * slope.imag
    else:
        voltage += next(c) * slope.real
        voltage += 1j * next(c) * slope.imag
    voltage += next(c)
    voltage += 1j * next(c)
    voltage += next(c) * speed * e
    voltage += next(c) * 1j * w * u if shape.turned else 0.0
    for power in shape.along:
        voltage += next(c) * e / share**power
    top = np.quantile(speed, 0.95)
    for knot in range(5):
        hat = np.clip(1.0 - np.abs(np.minimum(speed, top) / top * 4.0 - knot), 0.0, None)
        for power in shape.across:
            voltage += next(c) * 1j * np.sign(w) * e * hat / share**power
    for scale in shape.crossing:
        s = speed * share / (scale * np.max(speed))
        voltage += next(c) * 1j * np.sign(w) * e * s / (1.0 + s**2)
    assert next(c, None) is None
    found = np.column_stack(columns) @ coefficients
    assert found == pytest.approx(voltage, rel=EXACT)


def test_rows_count_by_their_beats_and_large_residuals_less() -> None:
    """Five rounds of Huber's weights, and the same weights without each push in turn."""
    rng = np.random.default_rng(13)
    n, k = 60, 7
    columns = [rng.standard_normal(n) + 1j * rng.standard_normal(n) for _ in range(k)]
    columns[2] = columns[2] * 1e4
    owner, weight = np.repeat(np.arange(4), 15), rng.uniform(0.2, 1.0, n)
    u = np.column_stack(columns) @ np.arange(1.0, k + 1.0) + 0.1 * (
        rng.standard_normal(n) + 1j * rng.standard_normal(n)
    )
    u[[5, 30]] += 20.0
    matrix = np.vstack([np.real(np.column_stack(columns)), np.imag(np.column_stack(columns))])
    target, beats = np.concatenate([u.real, u.imag]), np.tile(weight, 2)
    weights = beats**2
    for _ in range(5):
        root = np.sqrt(weights)
        x = np.linalg.lstsq(matrix * root[:, None], target * root, rcond=None)[0]
        off = np.abs(target - matrix @ x) * beats
        weights = beats**2 / np.maximum(1.0, off / (2.0 * 1.4826 * np.median(off)))
    value, without = resolved_push._fit(columns, u, weight, owner, 4)
    assert value == pytest.approx(x[:5], rel=1e-6)
    assert np.min(weights / beats**2) < 0.05
    for j in range(4):
        keep = np.tile(owner, 2) != j
        root = np.sqrt(weights[keep])
        less = np.linalg.lstsq(matrix[keep] * root[:, None], target[keep] * root, rcond=None)[0]
        assert without[j] == pytest.approx(less[:5], rel=1e-6)


def test_columns_that_differ_only_where_nothing_counts_are_refused() -> None:
    rng = np.random.default_rng(15)
    columns = [rng.standard_normal(40) + 1j * rng.standard_normal(40) for _ in range(6)]
    first = np.arange(40) < 5
    columns[1] = columns[0] + np.where(first, columns[1], 0.0)
    with pytest.raises(IdentificationError, match="condition .* of R, psi, L_q"):
        resolved_push._fit(columns, columns[2], np.where(first, 1e-9, 1.0), np.arange(40) // 10, 4)


def test_a_column_of_nothing_counts_only_where_it_is_told() -> None:
    rng = np.random.default_rng(14)
    columns = [rng.standard_normal(20) + 1j * rng.standard_normal(20) for _ in range(6)]
    u, owner = np.column_stack(columns) @ np.ones(6), np.repeat(np.arange(2), 10)
    value, _ = resolved_push._fit([*columns, 0j * columns[0]], u, np.ones(20), owner, 2)
    assert value == pytest.approx(np.ones(5), rel=1e-6)
    with pytest.raises(IdentificationError, match="did not turn"):
        resolved_push._fit([0j * columns[0], *columns], u, np.ones(20), owner, 2)
    with pytest.raises(IdentificationError, match=r"E_NOT_IDENTIFIABLE: condition"):
        resolved_push._fit([*columns, columns[0] + columns[1]], u, np.ones(20), owner, 2)


def test_the_mean_of_the_shapes_is_told_with_their_spread_and_that_of_the_pushes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fits = np.random.default_rng(15).standard_normal((4, 5)) + 3.0
    without = np.random.default_rng(16).standard_normal((4, 3, 5))
    given = iter(zip(fits, without, strict=True))
    seen: list[int] = []
    slopes: list[Rows] = []

    def fit(columns: Sequence[Rows], u: Rows, weight: Array, owner: Array, n: int) -> tuple[Array, Array]:
        slopes.extend(columns[6:8])
        seen.extend((len(u), len(weight), n, *np.bincount(owner)))
        return next(given)

    monkeypatch.setattr(resolved_push, "_fit", fit)
    w, i, slope, u = _rows()
    slope[[10, 20]] = 30.0, 40.0j
    small = np.where(np.arange(40) < 4, 0.17j * 5.0, np.where(np.arange(40) < 8, 0.19j * 5.0, i))
    blocks = Blocks(w, small, slope, u, np.ones(40), 1.0, 0.0, -5.0)
    found = resolved_push.resolve([blocks, replace(blocks, i_q=4.0), replace(blocks, i_q=3.0)])
    assert seen == [108, 108, 3, 36, 36, 36] * 4 and found.rows == 108
    # of the last shape, whose machine is not linear: slopes above the noise of all, real and imaginary by themselves
    used = np.tile(slope[4:], 3)
    assert slopes[6] == pytest.approx(resolved_push._above_noise(used.real))
    assert slopes[7] == pytest.approx(1j * resolved_push._above_noise(used.imag)) and np.any(slopes[7])
    assert found.value == pytest.approx(np.mean(fits, axis=0), rel=EXACT)
    pushes = np.mean(without, axis=0)
    variance = 2.0 / 3.0 * 3.0 * np.var(pushes, axis=0) + np.var(fits, axis=0, ddof=1)
    assert found.std == pytest.approx(np.sqrt(variance), rel=EXACT)
    rms = math.sqrt(np.mean((w[4:] * small[4:].imag) ** 2))
    assert found.reactance_v == pytest.approx(abs(np.mean(fits[:, 3])) * rms, rel=EXACT)


# ---- polled: inertia over flux linkage --------------------------------------------------------------------------


def test_coefficients_of_columns_of_any_size() -> None:
    rng = np.random.default_rng(17)
    columns = [rng.standard_normal(30), 1e-6 * rng.standard_normal(30), 1e5 * rng.standard_normal(30)]
    x = np.array([2.0, -3e6, 4e-5])
    found = regress(columns, np.column_stack(columns) @ x, what="a and b", stage="s")
    assert found == pytest.approx(x, rel=EXACT)
    for bad, told in ((0.0 * columns[0], "did not turn during the torque pulses, for a and b"),
                      (columns[0] * (1.0 + 1e-9), r"condition .* of a and b together")):  # fmt: skip
        with pytest.raises(IdentificationError, match=f"E_NOT_IDENTIFIABLE: .*{told}"):
            regress([columns[0], bad], columns[0], what="a and b", stage="s")


def test_the_jackknife_of_a_mean_is_its_variance() -> None:
    values = [3.0, 5.0, 4.5, 7.0]
    found = jackknife_variance(lambda some: np.array([np.mean(some), 2.0 * np.mean(some)]), values)
    assert found == pytest.approx(np.array([1.0, 4.0]) * np.var(values, ddof=1) / 4.0, rel=EXACT)
