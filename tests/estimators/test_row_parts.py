# SPDX-License-Identifier: MIT
"""Rows that go into fits: pulses of a flux map, blocks of a push, records of a response, passes of the tracking."""

from __future__ import annotations

import math
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.polynomial.legendre import legvander

from pmsmtool.arrays import Array, Complex
from pmsmtool.errors import IdentificationError
from pmsmtool.estimators import angle_harmonics, tracking
from pmsmtool.estimators.angle_harmonics import AngleHarmonics, Harmonic
from pmsmtool.estimators.estimate import SensorTolerance
from pmsmtool.estimators.flux import map_rows
from pmsmtool.estimators.flux.coenergy_spline import CoenergySpline
from pmsmtool.estimators.flux.map_rows import (
    Frame,
    PulseIntegrals,
    integrate_pulses,
    mean_error,
    normal_equations,
)
from pmsmtool.estimators.inverter_error import InverterCurve
from pmsmtool.estimators.shaft import disturbances, mechanics, response_lines
from pmsmtool.estimators.shaft import frequency_response as fr
from pmsmtool.estimators.shaft.disturbances import ANGLE_STD, ELECTRICAL_STD, ENCODER_STD_RAD, UNKNOWN, Extent
from pmsmtool.estimators.tracking import INFLATION_MAX, MINIMUM, NIS_GATE, NOISE_FLOOR, Track
from pmsmtool.estimators.tracking_model import Known
from pmsmtool.trace import Trace
from tests.estimators.traces import trace_of

EXACT = 1e-9
"""The same numbers by another formula (relative); measured: below 1e-12."""
T_S = 1e-4


def _pair(vector: Complex) -> Array:
    return np.stack([vector.real, vector.imag])


# ---- pulses of a flux map ---------------------------------------------------------------------------------------

CURVE = InverterCurve(np.array([0.5, 4.0]), np.array([0.8, 1.2]), 0.0)


@pytest.mark.parametrize("lag", [1, 2])
def test_pulses_are_integrated_in_the_frame_of_the_stator(lag: int) -> None:
    """A voltage acts ``lag`` periods after its sample, where the drive expected its frame half a period on."""
    rng = np.random.default_rng(90)
    n = 60
    t = T_S * np.arange(n)
    i, u = (rng.standard_normal(n) + 1j * rng.standard_normal(n) for _ in range(2))
    meta = {"voltage_lag": lag, "control_period_s": T_S}
    trace = trace_of(t, meta, theta_M_rad=0.2 + 30.0 * t, omega_e_rad_s=np.full(n, 61.0), i_d_a=i.real, i_q_a=i.imag,
                   u_d_v=20.0 * u.real, u_q_v=20.0 * u.imag)  # fmt: skip
    found = integrate_pulses(trace, Frame(2, 0.1, 0.15), CURVE, 0.4)
    turned = 2.0 * (0.2 + 30.0 * t) - 0.1
    i_s = np.exp(1j * turned) * i
    u_s = 20.0 * u * np.exp(1j * (turned + (lag + 0.5) * T_S * 61.0))
    acting = np.concatenate([np.zeros(lag), u_s])[:n]  # in the interval after each sample
    volts = np.concatenate([[0.0], np.cumsum(T_S * acting[:-1])])
    amperes = np.concatenate([[0.0], np.cumsum(0.5 * T_S * (i_s[1:] + i_s[:-1]))])
    assert found.volt_seconds == pytest.approx(_pair(volts), rel=EXACT)
    assert found.current_seconds == pytest.approx(_pair(amperes), rel=EXACT)
    assert found.volts_before[:, 1:] == pytest.approx(_pair(acting[:-1]), rel=EXACT) and found.first == lag + 2
    assert found.theta == pytest.approx(turned + 0.1 - 0.15, rel=EXACT)
    assert found.i == pytest.approx(_pair(i_s * np.exp(-1j * found.theta)), rel=EXACT)
    error = np.cumsum(T_S * mean_error(CURVE, _pair(i_s)), axis=1)
    assert found.error_seconds == pytest.approx(np.concatenate([np.zeros((2, 1)), error], axis=1), rel=EXACT)


@pytest.mark.parametrize("skewed", [False, True])
def test_the_equations_are_those_of_segments_with_a_line_each(skewed: bool) -> None:
    """Their squares at any point are those of rows, written out, with the best constant and slope of each segment."""
    rng = np.random.default_rng(91)
    spline = CoenergySpline.over(np.array([-3.0, 3.0]), np.array([-3.0, 3.0]), (3, 3))
    field = CoenergySpline.over(np.array([-3.0, 3.0]), np.array([-3.0, 3.0]), (2, 2)) if skewed else None
    n, first = 365, 3  # segments of 150, 150 and 62 samples
    parts = [rng.standard_normal((2, n)) for _ in range(5)]
    i = np.clip(parts[0], -2.9, 2.9)
    trace = PulseIntegrals(i, rng.uniform(0.0, 6.0, n), *parts[1:], first)
    whiten = rng.standard_normal((n, 2, 2))
    sums = normal_equations([trace], spline, lambda _: whiten, field)
    x = rng.standard_normal(spline.size + len(map_rows.NUISANCES) + (0 if field is None else field.size))
    nuisance = x[spline.size : spline.size + len(map_rows.NUISANCES)]
    stator = parts[1] - nuisance[0] * parts[2] - nuisance[1] * parts[3] - nuisance[4] * parts[4]
    turn = np.exp(-1j * trace.theta)
    seen = _pair((stator[0] + 1j * stator[1]) * turn)
    off = seen - spline.flux(x[: spline.size], *i)
    if field is not None:
        off[0] -= field.derivative(*i, 0, 0) @ x[spline.size + len(map_rows.NUISANCES) :]
    off = np.einsum("nij,jn->ni", whiten, off)
    late = (1.0 - np.exp(-0.5)) * np.exp(-0.5 * np.arange(17))  # a branch of two periods
    for size, kernel in zip(nuisance[2:4], (np.ones(1), late), strict=True):
        lost = np.convolve(parts[4][0], kernel)[:n] + 1j * np.convolve(parts[4][1], kernel)[:n]
        off -= size * float(np.mean(np.trace(whiten, axis1=1, axis2=2))) / 2.0 * _pair(lost * turn).T
    constants = np.einsum("nij,jkn->nik", whiten, np.stack([_pair(turn), _pair(1j * turn)], axis=1))
    squares, count = 0.0, 0
    for start in range(first, n, 150):
        part = slice(start, min(start + 150, n))
        rising = np.arange(start, part.stop)[:, None, None] * constants[part]
        y, c = off[part].ravel(), np.concatenate([constants[part], rising], axis=2).reshape(-1, 4)
        squares += float(np.sum((y - c @ np.linalg.lstsq(c, y, rcond=None)[0]) ** 2))
        count += len(y) - 4
    assert sums.squares(x) == pytest.approx(squares, rel=1e-6) and sums.n == count == 2 * 362 - 12
    names = ("i", "theta", "volt_seconds", "current_seconds", "error_seconds", "volts_before")
    short = PulseIntegrals(**{name: getattr(trace, name)[..., : first + 189] for name in names}, first=first)
    rest = normal_equations([short], spline, lambda at: whiten[: at.shape[1]], field)
    longer = replace(trace, first=n - 40)
    assert rest.n == 296  # 39 samples are no segment, and 40 are one
    assert normal_equations([longer], spline, lambda _: whiten, field).n == 76


def test_a_sum_of_sums_is_that_of_a_torque_between_its_rows() -> None:
    x = np.random.default_rng(92).standard_normal(9)
    expected = [sum(x[:k]) * 1.0 + 0.5 * x[k] + sum(sum(x[:j]) + 0.5 * x[j] for j in range(k)) for k in range(9)]
    found = map_rows._twice_summed(x)
    assert found == pytest.approx(np.cumsum(np.cumsum(x) - 0.5 * x), rel=EXACT) and found == pytest.approx(
        expected, rel=1e-6
    )


# ---- blocks of a push -------------------------------------------------------------------------------------------

HARMONICS = AngleHarmonics((Harmonic(1, 2e-3, -1e-3, 1e-5),), (Harmonic(6, 4.0, 3.0, 0.1),))


def _run(*, coasting: bool, powered: bool = False, n: int = 1006) -> Trace:
    t = 1e-3 * np.arange(n)
    rng = np.random.default_rng(93)
    meta = {"coasting": coasting, "powered": powered}
    return trace_of(
        t,
        meta,
        theta_M_rad=-(0.4 + 12.0 * t + 3.0 * t**2),
        i_d_a=rng.standard_normal(n),
        i_q_a=3.0 + rng.standard_normal(n),
    )


@pytest.mark.parametrize(("coasting", "powered"), [(False, False), (True, False), (True, True)])
def test_blocks_hold_mean_torques_in_the_frame_without_the_encoders_error(coasting: bool, powered: bool) -> None:
    """1006 rows make 251 blocks of four; each torque is the mean of trapezoids, the noise that of four rows."""
    run = _run(coasting=coasting, powered=powered)
    shown = -run["theta_M_rad"]
    theta, found = mechanics._blocks(run, lambda d, q: 0.2 * d + 0.5 * q, 0.04, -1, 3, 1e-3, HARMONICS, 2e-3)
    true = shown.copy()
    for _ in range(60):
        true = shown - HARMONICS.encoder_rad[0].at(true)
    i = (run["i_d_a"] + 1j * run["i_q_a"]) * np.exp(3j * (shown - true))
    tau = 0.2 * i.real + 0.5 * i.imag if powered or not coasting else np.zeros(1006)
    if not coasting:
        tau = tau + 2e-3 * (4.0 * np.cos(6.0 * shown) + 3.0 * np.sin(6.0 * shown))
    means = np.array([np.mean(0.5 * (tau[4 * k : 4 * k + 4] + tau[4 * k + 1 : 4 * k + 5])) for k in range(251)])
    assert found.torque == pytest.approx(means, rel=1e-6, abs=1e-12) and pytest.approx(4e-3) == found.T
    noise = 0.02 if powered or not coasting else 0.0
    floor = 0.0 if coasting else mechanics.TORQUE_FLOOR * float(np.max(np.abs(means)))
    assert found.torque_std == pytest.approx(math.hypot(noise, floor), rel=1e-6) and found.coasting is coasting
    if not coasting:
        assert theta == pytest.approx(true[:1005], abs=1e-9) and found.theta == pytest.approx(true[:1005:4], abs=1e-9)
    std = mechanics.position_std(shown[:1005:4], 1e-3)
    assert found.theta_std == pytest.approx(np.maximum(std, mechanics.position_noise(shown)), rel=EXACT)


def test_way_that_cogging_makes_is_taken_out_of_a_coasting() -> None:
    t = 1e-3 * np.arange(400)
    smooth, speed = 0.3 + 20.0 * t - 4.0 * t**2, 20.0 - 8.0 * t
    theta = smooth - (4.0 * np.cos(6.0 * smooth) + 3.0 * np.sin(6.0 * smooth)) / (6.0 * speed) ** 2
    found = HARMONICS.without_ripple(t, theta)
    assert found == pytest.approx(smooth, abs=1e-5)  # of 3.5e-4; measured 4e-6, the ripple bends the polynomial
    assert HARMONICS.torque_nm(smooth, 0.5) == pytest.approx(0.5 * HARMONICS.acceleration_rad_s2[0].at(smooth))
    assert AngleHarmonics().without_ripple(t, theta) is theta
    assert HARMONICS.acceleration_rad_s2[0].amplitude == 5.0
    assert HARMONICS.acceleration_rad_s2[0].phase_rad == pytest.approx(math.atan2(3.0, 4.0))
    slows = 3.0 * (1.0 - np.exp(-t / 0.05))
    count = len(t) // 40
    ways = slows[count:] - slows[:-count]
    assert angle_harmonics.fast_part(t, slows) == int(np.argmax(ways < 0.2 * ways[0]))
    assert angle_harmonics.fast_part(t, t) == 400


def test_orders_have_the_sizes_and_deviations_of_one_regression() -> None:
    """Two directions, an error of the encoder and one torque: polynomials of time and all waves, by least squares."""
    rng = np.random.default_rng(94)
    traces, rows, targets = [], [], []
    for k, sense in enumerate((1.0, -1.0)):
        t = 1e-3 * np.arange(600)
        smooth = 0.2 + sense * (100.0 * t - 20.0 * t**2)
        speed = sense * (100.0 - 40.0 * t)
        wave = 2e-3 * np.cos(smooth) - 60.0 * np.sin(12.0 * smooth) / (12.0 * speed) ** 2
        theta = smooth + wave + 2e-5 * rng.standard_normal(600)
        std = np.full(600, 2e-5 * (k + 1.0))
        traces.append((t, theta, std))
        angle, rate = angle_harmonics._smooth(t, theta - 2e-3 * np.cos(smooth))  # the angle is the shaft's
        base = np.zeros((600, 14))
        base[:, 7 * k : 7 * k + 7] = legvander(np.linspace(-1.0, 1.0, 600), 6)
        waves = [f(angle) for f in (np.cos, np.sin)] + [-f(12.0 * angle) / (12.0 * rate) ** 2 for f in (np.cos, np.sin)]
        rows.append(np.column_stack([*waves, base]) / std[:, None])
        targets.append(theta / std)
    matrix, target = np.vstack(rows), np.concatenate(targets)
    scale = np.linalg.norm(matrix, axis=0)
    x, rest, *_ = np.linalg.lstsq(matrix / scale, target, rcond=None)
    inverse = np.linalg.inv((matrix / scale).T @ (matrix / scale))
    found = angle_harmonics.angle_harmonics(traces)
    (once,), (torque,) = found.encoder_rad, found.acceleration_rad_s2
    assert (once.order, torque.order) == (1, 12)
    value = (x / scale)[:4]  # within 6e-5: the error that the angle is without is a rough one
    assert (once.cosine, once.sine, torque.cosine, torque.sine) == pytest.approx(tuple(value), rel=1e-3, abs=1e-9)
    dof = 1200 - 7 * 2 - 4
    std = np.sqrt(np.diag(inverse)[:4] * rest[0] / dof) / scale[:4]
    assert (once.std, torque.std) == pytest.approx((max(std[:2]), max(std[2:])), rel=1e-5)
    assert found.turns == pytest.approx(min(np.ptp(theta) for _, theta, _ in traces) / 2.0 / math.pi, rel=EXACT)


def test_disturbances_are_shapes_of_the_angle_and_the_speed() -> None:
    """A shaft at constant speed, two rows a block: means of waves over rows by integrals."""
    n, rows, T, w, pairs = 40, 2, 2e-3, 30.0, 5
    theta = 0.7 + w * T / rows * np.arange(n * rows + 1)
    torque = np.where(np.arange(n) < 20, -0.5, 0.0)
    found = disturbances.disturbances(theta, torque, T, Extent(60.0, 0.8, 0.02), pairs)
    begin, end = theta[:-1:rows], theta[rows::rows]

    def means(order: int) -> tuple[Array, Array]:
        return (
            (np.sin(order * end) - np.sin(order * begin)) / order / (end - begin),
            -(np.cos(order * end) - np.cos(order * begin)) / order / (end - begin),
        )

    expected = [0.02 * 0.8 * w / 60.0 * (torque != 0.0)]
    for order in (1, 2):
        for mean in means(order):
            expected += [0.8 * ANGLE_STD * mean, 0.8 * ANGLE_STD * mean]  # forwards friction is a torque
    for order, driven in ((pairs, torque != 0.0), (2 * pairs, np.sign(torque))):
        expected += [0.8 * ELECTRICAL_STD * mean * driven for mean in means(order)]
    assert found.torque.shape == (n, 17) and found.position.shape == (n + 1, 17)
    assert found.torque[:, :13] == pytest.approx(np.column_stack(expected), abs=1e-9) and not np.any(
        found.torque[:, 13:]
    )
    at = theta[::rows]
    waves = np.column_stack([np.cos(at), np.sin(at), np.cos(2.0 * at), np.sin(2.0 * at)])
    assert found.position[:, 13:] == pytest.approx(ENCODER_STD_RAD * waves, abs=1e-9) and not np.any(
        found.position[:, :13]
    )
    back = disturbances.disturbances(-theta, torque, T, Extent(60.0, 0.8, 0.02), 1)
    assert back.torque.shape == (n, 13)  # once and twice per electrical turn are those of the shaft
    assert back.torque[:, 2] == pytest.approx(-back.torque[:, 1]) and np.all(back.torque[:20, 0] < 0.0)


def test_an_encoder_s_error_is_fitted_about_what_a_slow_rotation_shows() -> None:
    """By as much as that does not tell: product of two normal densities."""
    turned = (Harmonic(1, 0.006, -0.002, 0.003), Harmonic(2, 0.001, 0.004, 0.0))
    prior = disturbances.encoder_prior(turned, 5)
    for h, seen in zip(prior, turned, strict=True):
        weights = 1.0 / ENCODER_STD_RAD**2, 1.0 / (seen.std**2 + 0.002**2)  # 0.01 rad electrical
        share = weights[1] / sum(weights)
        assert (h.cosine, h.sine) == pytest.approx((share * seen.cosine, share * seen.sine))
        assert h.std == pytest.approx(sum(weights) ** -0.5)
    theta = np.linspace(0.0, 1.0, 9)
    found = disturbances.disturbances(theta, np.ones(8), 0.1, Extent(1.0, 1.0, 0.0, prior), 5)
    along = disturbances.disturbances(theta, np.ones(8), 0.1, Extent(1.0, 1.0, 0.0, prior, (9,)), 5)
    assert along.orders == (9,) and not found.orders and along.torque.shape[1] == found.torque.shape[1] + 2
    assert found.position[:, -4] == pytest.approx(prior[0].std * np.cos(theta), abs=1e-9)
    unknown = replace(turned[1], std=math.inf)
    assert tuple(disturbances.encoder_prior((turned[0], unknown), 2))[1] == UNKNOWN[1]
    assert disturbances.encoder_prior((), 5) == UNKNOWN


# ---- records of a response --------------------------------------------------------------------------------------


def test_records_go_in_with_cogging_and_without_the_noise_of_their_current(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(95)
    n = 3000
    t = 2e-4 * np.arange(n)
    runs = [trace_of(t, theta_M_rad=-(20.0 * t + 1e-3 * rng.standard_normal(n)), i_d_a=rng.standard_normal(n),
                   i_q_a=rng.standard_normal(n), flagged=np.zeros(n)) for _ in range(3)]  # fmt: skip
    given: list[Any] = []

    def judged(*arguments: Any) -> Any:
        given.append(arguments)
        nothing = np.zeros(0)
        return fr.FrequencyResponse(nothing, nothing + 0j, nothing, nothing, 0.0, 1.0, 1.0, 0.0), None, None

    monkeypatch.setattr(fr, "_judged", judged)
    tolerance = SensorTolerance()
    fr.estimate_frequency_response(
        runs, lambda d, q: 0.3 * d + q, direction=-1, scale_std=0.02, noise_nm=0.05, angle_std=0.1,
        over_angle=lambda theta: 0.4 * np.cos(40.0 * theta), tolerance=tolerance,
    )  # fmt: skip
    (omega, U, Y, T, unsure, scale), = given  # fmt: skip
    band = slice(fr.HALF_WIDTH + 1, None)
    torques = [0.3 * run["i_d_a"] + run["i_q_a"] for run in runs]
    cogging = [0.4 * np.cos(40.0 * -run["theta_M_rad"]) for run in runs]
    every, of_current, answer, _ = response_lines.transforms(runs, torques, -1)
    of_angle = response_lines.transforms(runs, cogging, -1)[1]
    expected = response_lines.without_noise(of_current + of_angle, (n - 2) * 0.05**2)
    count = expected.shape[1]
    assert U == pytest.approx(expected, rel=EXACT) and Y == pytest.approx(answer[:, :count], rel=EXACT)
    assert omega == pytest.approx(every[:count]) and pytest.approx(2e-4) == T and scale == (0.02, tolerance)
    assert unsure == pytest.approx(0.1 * np.sqrt(np.mean(np.abs(of_angle[:, :count]) ** 2, axis=0)), rel=EXACT)
    assert band.start == 4


@pytest.mark.parametrize(("gains", "asked", "taken"), [((0.0,), 0, 0), ((1.0, 0.0), 1, 1), ((1.0, 1.0), 1, 0)])
def test_a_ripple_is_taken_along_where_no_second_mass_is_left(
    monkeypatch: pytest.MonkeyPatch, gains: tuple[float, ...], asked: int, taken: int
) -> None:
    """Gains beyond what the criterion asks of a second mass, without and with the ripple."""
    n = 3000
    t = 2e-4 * np.arange(n)
    run = trace_of(t, theta_M_rad=20.0 * t, i_d_a=0.0 * t, i_q_a=np.sin(900.0 * t), flagged=0.0 * t)
    nothing = np.zeros(0)
    results = [
        fr.FrequencyResponse(nothing, nothing + 0j, nothing, nothing, 0.0, 1.0, 1.0, fr.INFORMATION_GAIN + gain)
        for gain in gains
    ]
    told, ripples = iter(results), []

    def ripple(*_: Any) -> float:
        ripples.append(1)
        return 0.0

    monkeypatch.setattr(fr, "_judged", lambda *_: (next(told), None, None))
    monkeypatch.setattr(fr, "_ripple", ripple)
    monkeypatch.setattr(fr, "counted", lambda _, omega: np.zeros(len(omega), dtype=np.bool_))  # no steps of the encoder
    found = fr.estimate_frequency_response([run] * 3, lambda d, q: q)
    assert found is results[taken] and len(ripples) == asked


def test_a_record_needs_lines_to_average_over() -> None:
    """The longest record that is refused lacks one; the first is the fourth, for three on either side make its mean."""
    lines = 0
    for n in range(100, 2000):
        t = 1e-3 * np.arange(n)
        try:
            omega, *_ = response_lines.transforms([trace_of(t, theta_M_rad=t)], [t], 1)
            assert omega[0] == pytest.approx(2.0 * math.pi * (fr.HALF_WIDTH + 1) / (1e-3 * (n - 2)))
            break
        except IdentificationError as refused:
            lines = int(str(refused).split(" lines")[0].split()[-1])
    assert lines == response_lines.LINES_LEAST + 2 * fr.HALF_WIDTH - 1


def test_records_must_be_three_of_one_length_that_turn_and_are_not_limited() -> None:
    n = 3000
    t = 2e-4 * np.arange(n)
    good = trace_of(t, theta_M_rad=20.0 * t, i_d_a=np.zeros(n), i_q_a=np.zeros(n), flagged=np.zeros(n))
    stopped = replace(good, signals={**good.signals, "theta_M_rad": np.abs(t - 0.3)})
    short = replace(good, t_s=t[:-1], signals={name: x[:-1] for name, x in good.signals.items()})
    limited = replace(good, signals={**good.signals, "flagged": np.where(t < 3.5e-4, 2.0, 0.0)})
    for runs, told in (
        ([good, good, stopped, stopped], "E_EXCITATION: the shaft stopped in 2 of 4 records"),
        ([good, good], "E_EXCITATION: 2 records, 3 of one length needed"),
        ([good, good, short], "E_EXCITATION: 3 records, 3 of one length needed"),
        ([good, limited, limited], "E_CLIPPED: 4 samples"),
    ):
        with pytest.raises(IdentificationError, match=told):
            fr.estimate_frequency_response(runs, lambda d, q: q)


# ---- passes of the tracking -------------------------------------------------------------------------------------

KNOWN = Known(0.5, 0.1, 2e-3, 3e-3, T_S)


def _observations(n: int) -> Trace:
    rng = np.random.default_rng(96)
    i_d, i_q, w = rng.uniform(-2.0, 2.0, n), rng.uniform(-5.0, 5.0, n), rng.uniform(100.0, 300.0, n)
    x = 0.5 * w * T_S
    w_s = w * np.sin(x) / x
    u_d = 0.5 * i_d - w_s * 3e-3 * i_q
    u_q = 0.5 * i_q + w_s * (0.1 + 2e-3 * i_d)
    return trace_of(0.1 * np.arange(float(n)), i_d_a=i_d, i_q_a=i_q, omega_e_rad_s=w, u_d_v=u_d, u_q_v=u_q)


def test_the_noise_of_observations_is_that_of_their_second_differences() -> None:
    plain = _observations(400)
    rng = np.random.default_rng(97)
    noisy = replace(plain, signals={**plain.signals, "u_d_v": plain["u_d_v"] + 0.02 * rng.standard_normal(400),
                                    "u_q_v": plain["u_q_v"] + 0.05 * rng.standard_normal(400)})  # fmt: skip
    found = tracking.observation_noise(noisy, KNOWN)
    for value, name, size in zip(found, ("u_d_v", "u_q_v"), (0.02, 0.05), strict=True):
        off = noisy[name] - plain[name]
        bent = np.abs(off[2:] - 2.0 * off[1:-1] + off[:-2])
        assert value == pytest.approx(1.4826 * np.median(bent) / math.sqrt(6.0), rel=1e-6) and value == pytest.approx(
            size, rel=0.2
        )
    largest = np.max(np.hypot(plain["u_d_v"], plain["u_q_v"]))
    assert tracking.observation_noise(plain, KNOWN) == pytest.approx((NOISE_FLOOR * largest,) * 2, rel=EXACT)
    for count in (MINIMUM, MINIMUM - 1):
        told = pytest.raises(
            IdentificationError, match=f"E_EXCITATION: {MINIMUM - 1} usable observations, {MINIMUM} are"
        )
        with nullcontext() if count == MINIMUM else told:
            tracking.observation_noise(_observations(count), KNOWN)


def _track(std_R: float = 0.01, std_psi: float = 0.01) -> Track:
    one = np.ones(3)
    value = {"R_s_ohm": 0.5 * one, "psi_f_wb": -0.1 * one}
    return Track(one, value, {"R_s_ohm": 0.5 * std_R * one, "psi_f_wb": 0.1 * std_psi * one}, 2.0, 1.0, (0.01, 0.01))


def test_noise_is_inflated_until_the_innovations_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    """By half of the mean innovation each time, with standard deviations by its root."""
    given: list[Any] = []
    answers = iter([3.0, 2.65, 2.1])

    def passed(observations: Trace, known: Known, rows: Array, noise: tuple[float, float], walk: float) -> Any:
        given.append(noise)
        return _track(), next(answers), 7.0

    monkeypatch.setattr(tracking, "_pass", passed)
    found = tracking._consistent(_observations(4), KNOWN, np.zeros(0), (0.01, 0.02), 5.0)
    assert (found.first_nis, found.last_nis, found.walk, found.log_likelihood) == (3.0, 2.1, 5.0, 7.0)
    assert found.inflation == pytest.approx(1.5 * 1.325, rel=EXACT) and len(given) == 3
    assert given[1] == pytest.approx((0.01 * math.sqrt(1.5), 0.02 * math.sqrt(1.5)))
    assert given[2] == pytest.approx((0.01 * math.sqrt(1.9875), 0.02 * math.sqrt(1.9875)))
    answers = iter([2.6])
    assert tracking._consistent(_observations(4), KNOWN, np.zeros(0), (0.01, 0.02), 1.0).inflation == 1.0
    answers = iter([5.0, 2.7, 2.0])  # 2.5 is more than may be: no third pass
    found = tracking._consistent(_observations(4), KNOWN, np.zeros(0), (0.01, 0.02), 1.0)
    assert found.inflation == 2.5 and found.last_nis == 2.7


@pytest.mark.parametrize(
    ("nis", "inflation", "refused"),
    [(NIS_GATE[1], 1.0, False), (2.61, 1.0, True), (2.0, INFLATION_MAX, False), (2.0, 2.01, True)],
)
def test_innovations_that_stay_too_large_are_refused(nis: float, inflation: float, refused: bool) -> None:
    run = tracking._Run(_track(), 1.0, 5.0, nis, inflation, 0.0)
    told = (
        f"E_MODEL_MISMATCH: mean normalised innovation 5 instead of 2, still {nis:.3g} .* inflated by {inflation:.3g}"
    )
    with pytest.raises(IdentificationError, match=told) if refused else nullcontext():
        tracking._refuse_inconsistent(run)


def test_what_a_reader_is_told_of_a_track(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tracking, "_refuse_entangled", lambda *_: None)
    for likelihoods, inflation, nis, told in (
        ((9.0, 8.0, 7.0), 1.0, 2.0, ()), ((9.0, 8.0, 7.0), 1.0, 1.49, ("the intervals are wider",)),
        ((1.0, 8.0, 7.0), 1.0, NIS_GATE[0], ("the values change 5 times faster",)),
        ((1.0, 2.0, 7.0), 1.4, 2.8, ("2.8 instead of 2: the noise's variance is inflated by 1.4", "25 times")),
    ):  # fmt: skip
        runs = iter([tracking._Run(_track(), walk, nis, 2.0, inflation, likelihood)
                     for walk, likelihood in zip(tracking.WALK_FACTORS, likelihoods, strict=True)])  # fmt: skip
        monkeypatch.setattr(tracking, "_consistent", lambda *_, runs=runs: next(runs))
        found = tracking.track(_observations(20), KNOWN)
        assert (found.nis, found.inflation) == (nis, inflation) and len(found.notes) == len(told)
        assert all(part in note for part, note in zip(told, found.notes, strict=True))


def test_what_cannot_be_told_apart_is_named_with_its_partner() -> None:
    """At one operating point only R i + omega psi shows; at standstill psi in nothing, without current R."""
    steady = np.tile([0.0, 4.0, 200.0, 0, 0, 0, 0, 0, 0, 0], (30, 1))
    wanted = ("R_s_ohm", "psi_f_wb")
    for std, refused in ((0.05, False), (0.0501, True)):
        told = pytest.raises(
            IdentificationError, match=r"R_s_ohm and psi_f_wb cannot be separated; .* is 5.01 %, limit 5 %"
        )
        with told if refused else nullcontext():
            tracking._refuse_entangled(_track(std_R=std), steady, KNOWN, (0.01, 0.01), wanted)
    for std, refused in ((0.0199, False), (0.0201, True)):
        told = pytest.raises(
            IdentificationError, match=r"psi_f_wb shows in nothing: the shaft hardly turns; .* 2.01 %, limit 2 %"
        )
        with told if refused else nullcontext():
            tracking._refuse_entangled(_track(std_psi=std), steady * (np.arange(10) != 2), KNOWN, (0.01, 0.01), wanted)
    with pytest.raises(IdentificationError, match="R_s_ohm shows in nothing: no current flows"):
        tracking._refuse_entangled(_track(std_R=0.06), steady * (np.arange(10) != 1), KNOWN, (0.01, 0.01), wanted)
    tracking._refuse_entangled(_track(std_R=0.06), steady, KNOWN, (0.01, 0.01), ("psi_f_wb",))


def test_the_walk_of_a_value_grows_with_the_time_since_the_last_observation() -> None:
    """Observations that say nothing: the variances are those of the start and five times the walk, of 0.5 s."""
    tracker = tracking.Tracker(KNOWN, (1e6, 1e6), 5.0)
    for t in (100.0, 100.5):
        tracker.update(t, np.array([1.0, 2.0, 100.0, *np.zeros(7)]), np.zeros(2))
    value, std = tracker.state()
    assert value[:2] == pytest.approx([0.5, 0.1], rel=1e-6)
    expected = np.sqrt(np.array([0.3, 0.1]) ** 2 + 0.5 * (5.0 * np.array([2e-3, 3e-4])) ** 2) * np.array([0.5, 0.1])
    assert std[:2] == pytest.approx(expected, rel=1e-8)  # the walk is 3e-4 and 6e-5 of it
    assert std[3:5] == pytest.approx([0.02 * 2e-3, 0.02 * 3e-3], rel=1e-6)
