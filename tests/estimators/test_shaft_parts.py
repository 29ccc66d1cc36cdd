# SPDX-License-Identifier: MIT
"""Each step of the shaft's estimates by itself: lines, models, regressions, noise, gates; against other formulas."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.fft import idct
from scipy.signal import dlsim

from pmsmtool.arrays import Array, Complex
from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.angle_harmonics import AngleHarmonics, Harmonic
from pmsmtool.estimators.encoder import EncoderResult
from pmsmtool.estimators.estimate import COVERAGE_FACTOR, SensorTolerance
from pmsmtool.estimators.least_squares import Fit
from pmsmtool.estimators.shaft import frequency_response as fr
from pmsmtool.estimators.shaft import mechanics, model, position, response_lines
from pmsmtool.estimators.shaft.disturbances import Disturbances, waves_of
from pmsmtool.estimators.shaft.mechanics import MechanicsResult
from pmsmtool.estimators.shaft.model import Problem, Run, fastest, largest_torque, positions, sizes_of, whitener
from pmsmtool.machine.parameters import Estimate
from pmsmtool.trace import Trace

EXACT = 1e-9
"""The same numbers by another formula (relative); measured: below 1e-12."""


def _trace(t: Array, meta: dict[str, Any] | None = None, **signals: Array) -> Trace:
    return Trace(t, signals, dict.fromkeys(signals, "1"), meta or {})


# ---- positions --------------------------------------------------------------------------------------------------


def test_a_position_is_rounded_by_the_encoder_and_by_binary32() -> None:
    fine = np.array([0.1, 3.0, 300.0])
    assert position.position_std(fine, 0.01) == pytest.approx(np.full(3, 0.01 / math.sqrt(12.0)), rel=EXACT)
    single = fine.astype(np.float32).astype(np.float64)
    rounding = np.array([2.0**-27, 2.0**-22, 2.0**-15])
    assert position.rounding_rad(single) == pytest.approx(rounding, rel=EXACT)
    assert position.position_std(single, 1e-5) == pytest.approx(np.hypot(1e-5, rounding) / math.sqrt(12.0), rel=EXACT)


def test_positions_scatter_by_what_their_third_differences_say() -> None:
    scatter = 3e-4 * np.random.default_rng(41).standard_normal(20_000)
    t = np.linspace(0.0, 1.0, 20_000)
    assert position.position_noise(5.0 * t + 3.0 * t**2 + scatter) == pytest.approx(3e-4, rel=0.02)  # 0.006
    assert position.position_noise(t[:3]) == 0.0


def _rotation(pairs: int, turns: float, offset: float, *, direction: int = 1) -> tuple[Trace, Trace, list[Array]]:
    """Both runs of a rotor that is off by so much in every electrical turn (rad electrical), each by its own."""
    rng = np.random.default_rng(42)
    angle = np.arange(round(100 * pairs * turns)) * 2.0 * math.pi / 100.0
    runs, off = [], []
    for imposed in (angle, angle[-1] - angle):
        each = rng.uniform(-0.3, 0.3, math.ceil(pairs * turns) + 1)
        off.append(each[: math.floor(pairs * turns)])
        ahead = imposed + offset + each[np.arange(len(imposed)) // 100]
        runs.append(_trace(angle, theta_imposed_rad=imposed, theta_M_rad=direction * ahead / pairs))
    return runs[0], runs[1], off


@pytest.mark.parametrize(("pairs", "direction"), [(3, 1), (4, -1)])
def test_the_offset_is_that_of_pairs_of_electrical_turns(pairs: int, direction: int) -> None:
    forward, backward, (ahead, back) = _rotation(pairs, 1.1, 3.0, direction=direction)
    coarse = Estimate(2.9, 0.2, 0.0, "rad")
    found = position.offset_by_turns(
        EncoderResult(Estimate(float(pairs), 0.0, 0.0, "1"), direction, coarse, 0.4), forward, backward
    )
    n = len(ahead)
    each = 0.5 * (ahead + back[::-1])
    assert math.remainder(found.value - 3.0 - np.mean(each), 2.0 * math.pi) == pytest.approx(0.0, abs=EXACT)
    assert found.std == pytest.approx(np.std(each, ddof=1) / math.sqrt(n), rel=1e-6) and found.dof == n - 1
    assert found.systematic == pytest.approx(math.hypot(0.25 * 0.4, math.radians(0.2)), rel=EXACT)
    short = position.offset_by_turns(
        EncoderResult(Estimate(1.0, 0.0, 0.0, "1"), 1, coarse, 0.4), *_rotation(1, 1.1, 3.0)[:2]
    )
    assert short is coarse
    two = position.offset_by_turns(
        EncoderResult(Estimate(1.0, 0.0, 0.0, "1"), 1, coarse, 0.4), *_rotation(1, 2.1, 3.0)[:2]
    )
    assert two.dof == 1.0


def test_a_trace_of_just_enough_steps_shows_the_encoder() -> None:
    theta = 2.0**-10 * np.cumsum([0, *[1, 0] * (position.ENCODER_STEPS_LEAST - 1), 1])
    assert position.encoder_step([theta, 2.0 * theta]) == 2.0**-10
    with pytest.raises(IdentificationError, match="50 steps of the encoder are needed"):
        position.encoder_step([theta[:-1], 2.0 * theta])


def test_the_least_coherent_lines_are_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    n = 40
    omega, ones = np.arange(1.0, n + 1.0), np.ones((1, n), dtype=np.complex128)
    inner = n - 2 * fr.HALF_WIDTH
    G, std = ones[0, :inner], np.ones(inner)
    monkeypatch.setattr(fr, "_fit", lambda *_: None)
    for count in (fr.COHERENT_LEAST, fr.COHERENT_LEAST - 1):
        coherence = np.where(np.arange(inner) < count, fr.COHERENT, 0.0)
        monkeypatch.setattr(fr, "local_polynomials", lambda *_, seen=coherence: (G, std, std, seen))
        told = pytest.raises(IdentificationError, match="7 of .* lines have a coherence of 0.5, 8 are needed")
        with nullcontext() if count == fr.COHERENT_LEAST else told:
            fr._rigid_shaft(omega, ones, ones, 1e-3, np.zeros(n))


# ---- blocks and their motion ------------------------------------------------------------------------------------


def _run(theta: Array, torque: Array, T: float = 1e-3, *, coasting: bool = False, noise: float = 0.0) -> Run:
    return Run(theta, torque, T, np.full(len(theta), 1e-4), noise, coasting)


def test_sizes_of_runs_are_those_of_the_fastest_and_the_strongest() -> None:
    runs = [
        _run(np.array([0.0, 0.01, -0.02]), np.array([0.1, -0.2])),
        _run(np.array([0.0, 0.02, 0.03]), np.array([0.3, 0.0])),
    ]
    assert (fastest(runs), largest_torque(runs)) == pytest.approx((30.0, 0.3))
    assert runs[0].square == pytest.approx([100.0, -900.0])
    plain = Disturbances(np.zeros((2, 1)), np.zeros((3, 1)))
    runs = [replace(run, disturbances=plain) for run in runs]
    assert sizes_of(runs) == pytest.approx([1.0, 0.01, 0.3, 1.0, 1.0, 30.0, 1.0, 30.0])
    assert sizes_of(runs, drag=True) == pytest.approx([1.0, 0.01, 0.3, 0.3 / 900.0, 1.0, 1.0, 30.0, 1.0, 30.0])


def test_noise_of_the_torque_walks_into_the_positions() -> None:
    """Each block's torque moves all later positions as half a block later; covariance by its matrix."""
    run = replace(_run(np.zeros(6), np.zeros(5), 0.01, noise=0.2), theta_std=np.linspace(1e-4, 2e-4, 6))
    J = 3e-3
    impulse = np.array([[max(0.0, k - j - 0.5) for j in range(5)] for k in range(6)]) * 0.01**2 / J
    covariance = np.diag(run.theta_std**2) + 0.2**2 * impulse @ impulse.T
    factor = whitener(run, J)
    assert factor @ covariance @ factor.T == pytest.approx(np.eye(6), abs=1e-9)
    assert whitener(replace(run, torque_std=0.0), J) == pytest.approx(np.diag(1.0 / run.theta_std), rel=EXACT)


@pytest.mark.parametrize("drag", [False, True])
def test_the_derivative_of_a_run_is_that_of_differences(drag: bool) -> None:
    rng = np.random.default_rng(43)
    runs = [
        replace(_run(np.cumsum(rng.uniform(0.01, 0.02, 9)), rng.uniform(0.1, 0.2, 8), 0.01, noise=0.1),
                disturbances=Disturbances(np.column_stack([rng.standard_normal((8, 2)) * 0.02, np.zeros(8)]),
                                          np.column_stack([np.zeros((9, 2)), 0.01 * rng.standard_normal(9)])))
        for _ in range(2)
    ]  # fmt: skip
    first = 4 if drag else 3
    x = np.array([math.log(2e-3), 1e-3, 0.02, *([3e-6] if drag else []), 0.3, -0.2, 0.5, 0.0, 1.5, 0.01, 1.4])
    step = 1e-6 * np.maximum(np.abs(x), 1e-3)
    problem = Problem(runs, [whitener(run, 2e-3) for run in runs], step, drag)
    assert problem.sizes == slice(first, first + 3) and problem.shared == first + 3
    found, columns = problem.jacobian(x), []
    for k, h in enumerate(step):
        plus, minus = x.copy(), x.copy()
        plus[k] += h
        minus[k] -= h
        columns.append((problem.residual(plus) - problem.residual(minus)) / (2.0 * h))
    expected = np.stack(columns, axis=1)
    scale = np.max(np.abs(expected), axis=0)
    assert found / scale == pytest.approx(expected / scale, abs=1e-4)  # measured 2e-6: one side for the disturbances
    assert problem.residual(x)[-3:] == pytest.approx(x[first : first + 3])


@pytest.mark.parametrize(("power", "drag"), [(0.0, False), (1.0, False), (1.0, True)])
def test_mean_motions_are_a_weighted_regression_of_mean_torques(power: float, drag: bool) -> None:
    """Parabolas in halves of what moves; a rest at the end is left out. Errors as shares: pushes are whole."""
    rng = np.random.default_rng(44)
    runs, rows, torques, states = [], [], [], []
    for a, w, coasting in ((40.0, 1.0, False), (-15.0, 9.0, True), (-35.0, -2.0, False), (12.0, -8.0, True)):
        t = 0.01 * np.arange(41)
        theta = 0.2 + w * t + 0.5 * a * t**2
        torque = rng.uniform(0.05, 0.1) * np.sign(a)
        runs.append(_run(theta, np.full(40, torque), 0.01, coasting=coasting))
        way = np.abs(np.diff(theta))
        moving = max(16, int(np.nonzero(way > 0.2 * np.max(way))[0][-1]) + 1)
        half = (moving + 1) // 2
        for part in (slice(moving),) if power and not coasting else (slice(half), slice(half, moving)):
            omega = w + a * float(np.mean(t[part]))
            rows.append([a, omega * abs(omega) if drag else omega, math.copysign(1.0, omega)])
            torques.append(torque)
        states += [0.2, w]
    matrix, target = np.array(rows), np.array(torques)
    change = np.abs(matrix[:, 0])
    weight = (change + 1e-3 * np.max(change)) ** -power
    weighted = matrix * weight[:, None]
    x, rest, *_ = np.linalg.lstsq(weighted, target * weight, rcond=None)
    std = np.sqrt(np.diag(np.linalg.inv(weighted.T @ weighted)) * rest[0] / (len(target) - 3))
    found, covariance, begun, misfit = mechanics._mean_motion(runs, power, drag)
    assert misfit == pytest.approx(float(rest[0]), rel=1e-3)
    deviations = np.sqrt(np.diag(covariance))
    assert found == pytest.approx(x, rel=1e-4) and deviations == pytest.approx(std, rel=1e-3)
    assert begun == pytest.approx(states, rel=1e-6, abs=1e-9)


def test_a_torque_that_falls_within_a_half_counts_as_a_parabola_weighs_it() -> None:
    """What was left of a current in the first tenth of a coasting made B ten times too large, at +-13 %."""
    J, B, tau_c, T = 2e-3, 1e-3, 0.05, 0.005
    t, runs = T * np.arange(201), []
    for sign, left, held in ((1.0, 0.6, 0.5), (1.0, 0.4, 0.0), (-1.0, 0.6, 0.5), (-1.0, 0.4, 0.0)):
        torque = sign * (held + left * np.exp(-t[:-1] / 0.05))
        x = np.array([math.log(J), B, tau_c, 0.0, sign * 40.0])
        runs.append(_run(positions(torque, T, x), torque, T))
    found, *_ = mechanics._mean_motion(runs)
    assert found == pytest.approx([J, B, tau_c], rel=1e-4)  # measured 6e-6; by mean torques 11, 32 and 62 % off


def test_more_noise_is_what_the_residual_of_each_push_and_of_all_coasting_asks_for() -> None:
    runs = [_run(np.zeros(n + 1), np.full(n, 0.5), coasting=kind, noise=noise)
            for n, kind, noise in ((9, False, 0.01), (19, True, 0.0), (9, False, 0.02), (29, True, 2e-4))]  # fmt: skip
    parts = [np.full(10, 1.5), np.full(20, 1.0), np.full(10, 4.0), np.full(30, 2.0)]
    found = model.noisier(runs, np.concatenate([*parts, np.full(7, 99.0)]))
    coasting = math.sqrt((20.0 * 1.0 + 30.0 * 4.0) / 50.0)
    floor = model.COASTING_FLOOR * 0.5
    expected = [1.5 * 0.01, coasting * floor, model.GROWTH_MOST * 0.02, coasting * 2e-4]
    assert [run.torque_std for run in found] == pytest.approx(expected, rel=EXACT)
    quiet = np.concatenate([np.full(10, 1.1), np.full(20, 1.1), np.full(10, 1.1), np.full(30, 1.1)])
    assert model.noisier(runs, quiet) is runs
    assert model.noisier(runs, np.tile([0.5, 1.5], 35)) is runs  # 1.25 each
    assert model.torque_noise(runs) == pytest.approx({False: 0.04, True: 4e-4})
    assert mechanics._unexplained(runs, [replace(runs[0], torque_std=0.081)])
    assert not mechanics._unexplained(runs, [replace(runs[0], torque_std=0.04), replace(runs[1], torque_std=3.9e-4)])


def test_slow_modes_ask_for_noise_that_the_mean_of_all_hides() -> None:
    """One mode of 250 is 0.2 of the noise of all, and 3 or 4 times that of the slow ones."""
    for square, push in ((30.0, 1.0), (40.0, 2.0)):
        for mode, coasting in ((9, math.sqrt(square / 10.0)), (32, 1.0)):
            modes = np.zeros(250)
            modes[mode] = math.sqrt(square)
            part = np.asarray(idct(modes, norm="ortho"))
            runs = [_run(np.zeros(250), np.full(249, 0.5), coasting=k > 0, noise=0.01) for k in range(3)]
            found = model.noisier(runs, np.tile(part, 3), slow=True)
            factors = (min(push, coasting), coasting, coasting)
            assert [run.torque_std / 0.01 for run in found] == pytest.approx(factors, rel=EXACT)
            assert model.noisier(runs, np.tile(part, 3)) is runs
    part = np.asarray(idct(20.0 * np.eye(250)[33], norm="ortho"))
    assert model.noisier(runs, np.tile(part, 3), slow=True) is runs, "beyond the slow modes, an eighth of all"


def test_orders_of_a_cogging_stand_out_of_a_residual_beside_what_its_fit_takes() -> None:
    J, t = 1e-3, np.linspace(0.0, 0.5, 121)
    runs = [
        _run(sign * (6.0 * t - 5.0 * t * t), np.zeros(120), 0.5 / 120, coasting=True, noise=1e-3) for sign in (1, -1)
    ]

    def fitted(sizes: dict[int, float], taken: int = 0) -> Fit:
        def columns(order: int) -> Array:
            return np.concatenate(
                [whitener(run, J) @ model._ways(run, J) @ waves_of(run.theta, [order]) for run in runs]
            )

        residual = np.append(sum((size * columns(order)[:, 1] for order, size in sizes.items()), np.zeros(242)), 0.0)
        jacobian = np.append(columns(taken), [[0.0, 0.0]], axis=0) if taken else np.eye(243, 1)
        return Fit(np.array([math.log(J)]), residual, jacobian, True, 1)

    assert model.cogging_orders(runs, fitted({15: 0.01, 31: 0.004})) == [15, 31]
    assert (
        model.cogging_orders(runs, fitted({15: 0.01, 31: 1e-5})) == [15]
        and model.cogging_orders(runs, fitted({})) == []
    )
    assert model.cogging_orders(runs, fitted({15: 0.01}, taken=15)) == []
    steep = [_run(np.array([0.0, 0.6, 1.1]), np.zeros(2), coasting=True, noise=1e-3)]
    assert model.cogging_orders(steep, fitted({})) == [], "no order above the encoder's in blocks of 0.6 rad"


def test_friction_that_may_be_all_of_the_torque_is_useless() -> None:
    runs = [_run(np.array([0.0, 0.02, 0.03]), np.array([0.3, -0.1]))]  # 20 rad/s and 0.3 N m
    for share in (0.99, 1.01):
        limit = share * 0.3 / COVERAGE_FACTOR
        for stds in ((limit / 20.0, 0.0), (0.0, limit)):
            told = pytest.raises(IdentificationError, match=r"friction is known to \+-0.3 N m, the pulses made 0.3 N m")
            with nullcontext() if share < 1.0 else told:
                mechanics.require_useful(runs, *stds)


def test_a_trace_begins_where_the_shaft_moves_and_its_step_is_over() -> None:
    n = 400
    t = 0.01 * np.arange(n)
    theta = np.where(t < 0.3, 0.0, t - 0.3)
    flagged = np.zeros(n)
    flagged[[33, 60]] = 1.0
    coast = _trace(t, {"coasting": True}, theta_M_rad=theta, flagged=flagged)
    at = int(np.argmax(theta > 0.005 * np.ptp(theta)))
    assert mechanics._window(coast).t_s[0] == t[at]
    assert mechanics._window(replace(coast, meta={"coasting": False})).t_s[0] == pytest.approx(t[34])
    flagged[:] = 0.0
    assert mechanics._window(replace(coast, meta={"coasting": False})).t_s[0] == t[at]


def test_a_coasting_ends_before_the_shaft_rests() -> None:
    """Under Coulomb friction half a percent of the way is left at 7 % of the speed; a push and a turning shaft stay."""
    t = 0.01 * np.arange(400)
    theta = -np.minimum(t, 2.0) * (4.0 - np.minimum(t, 2.0))
    last = int(np.flatnonzero(theta - theta[-1] > 0.005 * np.ptp(theta))[-1]) + 1
    for direction in (-1.0, 1.0):
        run = _trace(t, {"coasting": True}, theta_M_rad=direction * theta)
        assert mechanics._window(run).t_s[-1] == t[last] == pytest.approx(2.0 * (1.0 - math.sqrt(0.005)), abs=0.01)
        pushed = _trace(t, {"coasting": False}, theta_M_rad=direction * theta, flagged=np.zeros(400))
        assert mechanics._window(pushed).t_s[-1] == t[-1]
    turning = _trace(t, {"coasting": True}, theta_M_rad=t)
    assert mechanics._window(turning).t_s[-1] == pytest.approx(t[-1], abs=0.021)


def test_the_fast_part_of_a_trace_is_its_longest_above_a_fifth_of_its_speed() -> None:
    speed = np.concatenate([np.full(50, 10.0), np.full(100, 1.0), np.full(200, 8.0), np.full(50, 0.5)])
    theta = np.concatenate([[0.0], np.cumsum(speed)])
    run = _trace(np.arange(401.0), theta_M_rad=theta)
    found = mechanics._fast(run)
    assert found.t_s[0] == pytest.approx(150.0, abs=10.0) and found.t_s[-1] == pytest.approx(350.0, abs=10.0)
    part = found["theta_M_rad"]
    count = len(theta) // 40
    ways = part[count:] - part[:-count]
    assert np.min(ways) >= 0.2 * np.max(theta[count:] - theta[:-count])
    before = theta[int(found.t_s[0]) - 1 + count] - theta[int(found.t_s[0]) - 1]
    assert before < 0.2 * np.max(theta[count:] - theta[:-count])


def test_what_a_reader_is_told_of_the_torque() -> None:
    def result(**parts: Any) -> MechanicsResult:
        J, B, tau = Estimate(2e-3, 0.0, 0.0, "kg m2"), Estimate(1e-3, 0.0, 0.0, "N m s"), Estimate(0.1, 0.0, 0.0, "N m")
        return replace(MechanicsResult(J, B, tau, (0.0, 0.0, 0.0), 0.0234, 1.0, True), **parts)

    assert "torque noise of 2.3 % of that of the pulses" in result().note
    assert result(unexplained=False).note == "" == result(ripple=0.0099).note and result(ripple=0.01).note
    cogging = AngleHarmonics((), (Harmonic(6, 3.0, 4.0, 0.1), Harmonic(12, 1.0, 0.0, 0.1)))
    drag = Estimate(1.5e-6, 0.0, 0.0, "N m s2")
    told = result(harmonics=cogging, drag=drag, unexplained=False).note
    assert told == ("drag over the square of the speed, 1.5e-06 N m s2, is in neither B nor tau_c; "
                    "cogging of 0.01 N m (orders per turn: 6, 12) was taken out of J, B and tau_c")  # fmt: skip
    along = result(orders=(15, 30), unexplained=False).note
    assert along.startswith("cogging (orders per turn: 15, 30), which so short a coasting")


# ---- lines of a frequency response ------------------------------------------------------------------------------

T_ROW = 2e-4


def test_transforms_are_those_of_torque_and_acceleration_between_the_ends() -> None:
    """A position that swings at a line: its second difference over the square of a sinc is the acceleration."""
    n, line = 4000, 400
    t = T_ROW * np.arange(n + 2)
    w = 2.0 * math.pi * line / (n * T_ROW)
    theta, torque = 0.01 * np.cos(w * (t - T_ROW) + 0.3), 2.0 * np.cos(w * (t - T_ROW) + 1.0) + 7.0
    runs = [_trace(t, theta_M_rad=theta)]
    omega, U, Y, T = response_lines.transforms(runs, [torque], -1)
    k = int(np.argmin(np.abs(omega - w)))
    assert pytest.approx(T_ROW) == T and omega[k] == pytest.approx(w, rel=EXACT)
    assert omega[0] == pytest.approx(2.0 * math.pi * 5.0, rel=EXACT) and omega[-1] < 2.0 * math.pi * 0.2 / T_ROW
    assert U[0, k] == pytest.approx(0.5 * n * 2.0 * np.exp(1j), rel=1e-6)
    assert Y[0, k] == pytest.approx(-0.5 * n * 0.01 * -(w**2) * np.exp(0.3j), rel=1e-6)
    with pytest.raises(IdentificationError, match=r"E_EXCITATION: records of 0.0[0-9]+ s give \d+ lines"):
        short = [_trace(t[:203], theta_M_rad=theta[:203])]
        response_lines.transforms(short, [torque[:203]], 1)


def test_noise_of_the_input_is_taken_from_its_power() -> None:
    U = np.sqrt(np.where(np.arange(120) < 80, 10.0, np.where(np.arange(120) < 90, 3.0, 1.0))) * np.exp(
        1j * np.arange(120.0)
    )
    U = np.stack([U, -U])
    power = np.mean(np.abs(U) ** 2, axis=0)
    smooth = np.array([np.mean(power[max(0, k - 3) : k + 4]) for k in range(120)])
    share = 1.0 - 1.2 / smooth
    end = int(np.flatnonzero(share >= 0.5)[-1]) + 1
    found = response_lines.without_noise(U, 1.2)
    assert found.shape == (2, end) and end < 120
    assert found == pytest.approx((U * np.maximum(share, 0.5))[:, :end], rel=EXACT)
    flat = np.ones((2, 46)) + 0j
    assert response_lines.without_noise(flat, 0.5) == pytest.approx(0.5 * flat)
    with pytest.raises(IdentificationError, match="on 45 of 45 lines, 46 are needed"):
        response_lines.without_noise(flat[:, 1:], 0.5)
    with pytest.raises(
        IdentificationError, match="E_COHERENCE: the torque is above .* on 0 of 120 lines, 46 are needed"
    ):
        response_lines.without_noise(U, 30.0)


def test_lines_are_a_regression_on_polynomials_beside_a_transient() -> None:
    """Seven lines of three records: response and transient of second order, by one least squares for each line."""
    rng = np.random.default_rng(45)
    U, noise = (rng.standard_normal((3, 12)) + 1j * rng.standard_normal((3, 12)) for _ in range(2))
    line = np.arange(12.0)
    Y = (2.0 + 0.1j * line - 0.01 * line**2) * U + (1.0 + 0.3j * line) + 0.05 * noise
    G, sigma, std, coherence = response_lines.local_polynomials(U, Y)
    r = np.linspace(-1.0, 1.0, 7)
    for k in range(6):
        rows = np.zeros((21, 3 + 9), np.complex128)
        for record in range(3):
            part = slice(7 * record, 7 * record + 7)
            rows[part, :3] = U[record, k : k + 7, None] * r[:, None] ** np.arange(3)
            rows[part, 3 + 3 * record : 6 + 3 * record] = r[:, None] ** np.arange(3)
        y = Y[:, k : k + 7].ravel()
        x, rest, *_ = np.linalg.lstsq(rows, y, rcond=None)
        variance = rest[0] / (21 - 12)
        inverse = np.linalg.inv(rows.conj().T @ rows)[0, 0].real
        assert G[k] == pytest.approx(x[0], rel=1e-6) and sigma[k] == pytest.approx(math.sqrt(variance), rel=1e-6)
        assert std[k] == pytest.approx(math.sqrt(0.5 * variance * inverse), rel=1e-6)
        explained = abs(x[0]) ** 2 * np.mean(np.abs(U[:, k : k + 7]) ** 2)
        assert coherence[k] == pytest.approx(explained / (explained + variance), rel=1e-6)


# ---- models of a frequency response -----------------------------------------------------------------------------

OMEGA = 2.0 * math.pi * np.linspace(10.0, 300.0, 120)
SHAFT = (math.log(500.0), 0.4, math.log(700.0), math.log(0.05), math.log(550.0), 0.03)


def _lines(x: Sequence[float] = SHAFT, *, records: int = 4, noise: float = 0.0) -> fr._Lines:
    rng = np.random.default_rng(46)
    U, rest = (rng.standard_normal((records, 120)) + 1j * rng.standard_normal((records, 120)) for _ in range(2))
    return fr._Lines(OMEGA, np.exp(-1j * OMEGA * T_ROW), T_ROW, U, _response(x) * U + noise * rest, np.full(120, 40.0))


def _response(x: Sequence[float], omega: Array = OMEGA) -> Complex:
    s = 1j * omega
    w_r, zeta_r, w_a = (math.exp(value) for value in x[2:5])
    G = np.polyval([1.0, 2.0 * x[5] * w_a, w_a**2], s) / np.polyval([1.0, 2.0 * zeta_r * w_r, w_r**2], s)
    return np.asarray(math.exp(x[0]) * G * np.exp(-s * x[1] * T_ROW))


def test_the_response_of_two_masses_and_the_transients_that_it_leaves() -> None:
    """The poles of a sampled transient are those of an impulse invariant filter."""
    lines = _lines()
    G, basis = fr._two_mass(lines, np.array(SHAFT))
    assert G == pytest.approx(_response(SHAFT), rel=EXACT)
    rigid, two = fr._rigid(lines, np.array(SHAFT))
    assert rigid == pytest.approx(500.0 * np.exp(-0.4j * OMEGA * T_ROW), rel=EXACT)
    assert two == pytest.approx(np.stack([np.ones(120), np.exp(-1j * OMEGA * T_ROW)], axis=1), rel=EXACT)
    pole = np.exp((-0.05 + 1j * math.sqrt(1.0 - 0.05**2)) * 700.0 * T_ROW)
    z = np.exp(1j * OMEGA * T_ROW)
    ringing = 1.0 / ((1.0 - pole / z) * (1.0 - np.conj(pole) / z))
    assert basis[:, :2] == pytest.approx(two, rel=EXACT) and basis[:, 2:] == pytest.approx(
        two * ringing[:, None], rel=1e-7
    )
    impulse = dlsim((np.array([1.0, 0.0, 0.0]), np.poly([pole, np.conj(pole)]).real, T_ROW), np.eye(1, 4000)[0])[1][
        :, 0
    ]
    assert ringing[50] == pytest.approx(np.sum(impulse * z[50] ** -np.arange(4000.0)), rel=1e-6)


def test_residuals_are_real_and_imaginary_parts_in_their_deviations() -> None:
    found = fr._stacked(np.array([[3.0 + 4.0j, 1.0j]]), np.array([2.0, 0.5]))
    assert found == pytest.approx(math.sqrt(2.0) * np.array([[1.5, 0.0, 2.0, 2.0]]))


def test_a_start_is_the_pair_of_poles_whose_numerator_fits() -> None:
    """A frequency and a damping of those that are tried: then all of it is linear. Measured: 1e-9."""
    w_r = 1.5 * OMEGA[0] * math.exp(100.0 * fr.START_STEP)
    x = (math.log(500.0), 0.0, math.log(w_r), math.log(0.05), math.log(0.8 * w_r), 0.03)
    start = fr._start(OMEGA, _response(x), np.full(120, 1.0))
    assert start is not None and start == pytest.approx(x, abs=1e-6)
    mirrored = (x[0], 0.0, x[4], x[3], x[2], x[5])  # zeros above the poles are no load
    found = fr._start(OMEGA, _response(mirrored), np.full(120, 1.0))
    assert found is None or found[4] < found[2]


def _solved(x: Sequence[float], cost: float = 1.0) -> Fit:
    rng = np.random.default_rng(47)
    residual = rng.standard_normal(400)
    residual *= math.sqrt(cost / float(residual @ residual))
    return Fit(np.array(x), residual, 50.0 * rng.standard_normal((400, len(x))), True, 9)


def test_frequencies_and_damping_have_the_deviations_of_their_logarithms() -> None:
    fit = _solved(SHAFT)
    bound = np.sqrt(np.diag(np.linalg.inv(fit.jacobian.T @ fit.jacobian)))
    for chi2, widen in ((0.5, 1.0), (2.25, 1.5)):
        found = fr._estimates(fit, chi2)
        for name, k, value, floor in (
            ("resonance_hz", 2, 700.0 / 2.0 / math.pi, 0.0),
            ("resonance_zeta", 3, 0.05, 0.01),
            ("antiresonance_hz", 4, 550.0 / 2.0 / math.pi, 0.0),
        ):
            assert found[name].value == pytest.approx(value, rel=EXACT)
            assert found[name].std == pytest.approx(value * math.hypot(bound[k] * widen, floor), rel=1e-6)


def test_the_inertia_is_that_of_all_that_turns() -> None:
    fit, weights = _solved(SHAFT), np.array([-1.0, 0.0, 2.0, 0.0, -2.0, 0.0])
    covariance = np.linalg.inv(fit.jacobian.T @ fit.jacobian)
    tolerance = SensorTolerance(current_gain=0.03, voltage_gain=0.04)
    for chi2, widen in ((0.8, 1.0), (2.0, 2.0)):
        found = fr._inertia(fit, chi2, tuple(weights.tolist()), 0.02, tolerance)
        assert found is not None
        value = (700.0 / 550.0) ** 2 / 500.0
        own = widen * weights @ covariance @ weights
        assert found.value == pytest.approx(value, rel=EXACT) and found.systematic == pytest.approx(
            0.05 * value, rel=EXACT
        )
        assert found.std == pytest.approx(value * math.sqrt(own + 0.02**2 + 1e-6), rel=1e-6)
    assert fr._inertia(fit, 3.0, tuple(weights.tolist()), 0.02, tolerance) is not None
    assert fr._inertia(fit, 3.01, tuple(weights.tolist()), 0.02, tolerance) is None
    assert fr._inertia(replace(fit, converged=False), 1.0, tuple(weights.tolist()), 0.02, tolerance) is None


def test_a_small_load_shows_where_its_change_stands_out_of_the_noise() -> None:
    lines = _lines((math.log(500.0), 0.0, math.log(700.0), math.log(0.05), math.log(700.0), 0.05))
    fit = _solved([math.log(500.0), 0.0])
    highest = 0.0
    for w_r in np.geomspace(OMEGA[0], OMEGA[-1], fr.SHOWN_TRIED):
        w_a = w_r / math.sqrt(1.2)
        G = _response((math.log(500.0 * 1.2), 0.0, math.log(w_r), math.log(0.01), math.log(w_a), 0.01 * w_a / w_r))
        change = 2.0 * np.sum(np.abs(lines.U * (G - 500.0)) ** 2 / lines.sigma**2)
        if change > fr.INFORMATION_GAIN + (4 + 8) * math.log(400.0):
            highest = w_r / (2.0 * math.pi)
    told, found = fr._shown(lines, fit)
    assert found == pytest.approx(highest, rel=EXACT) and found > 0.0
    assert told == f"a load of 0.2 of the motor's inertia at 1 % damping would show up to {highest:.3g} Hz"
    deaf = replace(lines, sigma=lines.sigma * 1e6)
    assert fr._shown(deaf, fit) == (
        "a load of 0.2 of the motor's inertia at 1 % damping would not show at any frequency",
        0.0,
    )


def _claimed(**parts: tuple[float, float]) -> dict[str, Estimate]:
    values = {"resonance_hz": (100.0, 0.5), "antiresonance_hz": (80.0, 1.0), "resonance_zeta": (0.05, 0.01)} | parts
    return {name: Estimate(value, std, 0.0, "1") for name, (value, std) in values.items()}


@pytest.mark.parametrize(
    ("parts", "told"),
    [
        ({}, ""), ({"antiresonance_hz": (9.9, 0.1)}, "9.9 and 100 Hz are not the pair"),
        ({"antiresonance_hz": (10.1, 0.1)}, ""),
        ({"resonance_hz": (291.0, 0.5)}, ""), ({"resonance_hz": (294.0, 0.5)}, "80 and 294 Hz are not the pair"),
        ({"antiresonance_hz": (101.0, 0.1)}, "101 and 100 Hz are not the pair"),
        ({"antiresonance_hz": (98.1, 0.01), "resonance_hz": (100.0, 0.01)}, "at 100 Hz are less than 2 % apart"),
        ({"antiresonance_hz": (97.9, 0.01), "resonance_hz": (100.0, 0.01)}, ""),
        ({"antiresonance_hz": (90.0, 2.4), "resonance_hz": (100.0, 0.8)}, "Hz are no 4 standard deviations apart"),
        ({"antiresonance_hz": (90.0, 2.3), "resonance_hz": (100.0, 0.8)}, ""),
        ({"resonance_hz": (51.0, 0.01), "antiresonance_hz": (50.0, 0.01)}, ""), ({"resonance_zeta": (0.1, 0.0)}, ""),
        ({"resonance_hz": (100.0, 0.3), "antiresonance_hz": (98.0, 0.4)}, ""), ({"resonance_hz": (100.0, 3.0)}, ""),
        ({"antiresonance_hz": (80.0, 8.0), "resonance_hz": (200.0, 0.1)}, ""),
        ({"antiresonance_hz": (10.0, 0.1)}, "10 and 100 Hz are not the pair"),
        ({"resonance_zeta": (0.101, 0.0)}, "damped by 0.1, and no coupling by 0.1"),
        ({"resonance_zeta": (0.119, 0.01)}, ""), ({"resonance_zeta": (0.23, 0.05)}, "damped by 0.23, and no coupling"),
        ({"resonance_hz": (100.0, 3.1)}, "known to 3.1 Hz and zeros at 80 Hz to 1 Hz, limits 3 and 10 %"),
        ({"resonance_hz": (200.0, 5.9)}, ""), ({"antiresonance_hz": (60.0, 5.9)}, ""),
        ({"antiresonance_hz": (60.0, 6.1)}, "zeros at 60 Hz to 6.1 Hz"),
    ],
)  # fmt: skip
def test_what_speaks_against_a_second_mass(parts: dict[str, tuple[float, float]], told: str) -> None:
    frequency = np.linspace(10.0, 300.0, 120)
    found = fr._against(_solved(SHAFT), 1.0, 20.0, _claimed(**parts), frequency)
    assert (told in found and found) if told else found == ""


def test_what_no_information_or_no_fit_speaks_for_is_no_second_mass() -> None:
    frequency, fit = np.linspace(10.0, 300.0, 120), _solved(SHAFT)
    assert "gains 10 by a second mass" in fr._against(fit, 1.0, 10.0, _claimed(), frequency)
    assert fr._against(fit, 1.0, 10.1, _claimed(), frequency) == ""
    assert "did not converge" in fr._against(replace(fit, converged=False), 1.0, 20.0, _claimed(), frequency)
    assert fr._against(fit, 3.0, 20.0, _claimed(), frequency) == ""
    assert "reduced chi-square 3.1" in fr._against(fit, 3.1, 20.0, _claimed(), frequency)


def test_a_shaft_that_turns_back_in_a_record_has_stopped() -> None:
    t = 1e-3 * np.arange(500)
    assert not fr._stopped(_trace(t, theta_M_rad=5.0 * t)) and not fr._stopped(_trace(t, theta_M_rad=-5.0 * t))
    assert fr._stopped(_trace(t, theta_M_rad=np.abs(t - 0.2))) and fr._stopped(
        _trace(t, theta_M_rad=np.minimum(t, 0.3))
    )
    assert not fr._stopped(_trace(t, theta_M_rad=t - 0.9e-2 * (t > 0.2) * np.minimum(1.0, (t - 0.2) / 0.01)))
    assert not fr._stopped(_trace(t[:15], theta_M_rad=-t[:15]))
