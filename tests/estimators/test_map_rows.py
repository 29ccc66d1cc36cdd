# SPDX-License-Identifier: MIT
"""The rows of a flux map: the inverter's error over an interval, and what is in pulses beside the flux of a machine."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pmsmtool.arrays import Array
from pmsmtool.estimators.flux import map_fit, map_rows
from pmsmtool.estimators.flux.coenergy_spline import CoenergySpline
from pmsmtool.estimators.flux.map_rows import (
    IRON_PERIODS,
    NUISANCES,
    Frame,
    Legs,
    PulseIntegrals,
    correlation,
    integrate_pulses,
    mean_error,
    normal_equations,
    turn,
)
from pmsmtool.estimators.injection.sampling_instant import Sampling
from pmsmtool.estimators.inverter_error import InverterCurve, Modulation, duties, phases_of
from pmsmtool.trace import Trace

KNEE_A = 0.5
ROUNDING, SHARP = 1e-12, 0.05
"""Exact where the error is linear; a knee within an interval meets two points: measured 0.006 and 0.030 V of 1 V."""


@pytest.mark.parametrize(
    ("begin", "end", "tolerance"),
    [
        ((0.1, -0.2), (0.3, 0.05), ROUNDING), ((-0.4, 0.1), (0.4, -0.1), ROUNDING), ((2.0, 0.1), (3.0, 0.2), ROUNDING),
        ((0.0, 0.0), (2.0, 0.0), SHARP), ((-0.1, 0.3), (1.5, 0.9), SHARP),
    ],
)  # fmt: skip
def test_an_error_is_the_mean_over_the_interval(
    begin: tuple[float, float], end: tuple[float, float], tolerance: float
) -> None:
    curve = InverterCurve(np.array([KNEE_A, 2.0 * KNEE_A]), np.ones(2), 0.0)
    way = np.linspace(0.0, 1.0, 20_001)[:, None]
    path = (1.0 - way) * np.array(begin) + way * np.array(end)
    expected = np.mean(np.stack(curve.error_dq_v(path[:, 0], path[:, 1], np.zeros(len(path)))), axis=1)
    found = mean_error(curve, np.array([begin, end, begin]).T)
    assert found.shape == (2, 2)
    assert found[:, 0] == pytest.approx(expected, abs=tolerance) and found[:, 1] == pytest.approx(
        found[:, 0], abs=1e-12
    )


# ---- a machine of constant inductances under square waves --------------------------------------------------------

SAMPLES, T_S, L_H, PSI_F = 600, 1e-4, np.array([4e-3, 9e-3]), 0.2
VOLTS = np.array([40.0, 90.0])
IRON_S = (0.1 * T_S, 0.3 * T_S)
"""What flows in the iron, per volt and by the mean inductance."""
EXACT = 1e-9
"""The same numbers by another formula (relative); measured: 4e-13."""
KERNEL = 2e-6
"""Of 3.6e-3 Wb: where the kernel of a branch ends. Measured: 9.5e-7."""
SPLINE = CoenergySpline.over(np.array([-12.0, 12.0]), np.array([-12.0, 12.0]), (5, 5))


def _whiten(i: Array) -> Array:
    return np.broadcast_to(np.diag(1.0 / L_H), (i.shape[1], 2, 2))


def _pulses(offset_v: tuple[float, float], iron_s: tuple[float, ...]) -> PulseIntegrals:
    """Unequal square waves on both axes, recorded with voltages that are off and with the current of the iron in it."""
    k = np.arange(SAMPLES)
    theta = 0.9 + 0.2 * np.sin(0.01 * k)
    square = np.stack([np.where((k + 11) // 22 % 2 == 0, 1.0, -1.0), np.where((k + 15) // 31 % 2 == 0, 1.0, -1.0)])
    psi = np.cumsum(T_S * VOLTS[:, None] * square, axis=1)
    flux_s = turn(theta, psi + np.array([[PSI_F], [0.0]]))
    acting = np.diff(flux_s, axis=1, prepend=flux_s[:, :1]) / T_S
    eddy = np.zeros_like(psi)
    for periods, share in zip(IRON_PERIODS, iron_s, strict=True):
        fade = math.exp(-1.0 / periods) if periods else 0.0
        faded = np.zeros_like(acting)
        for n in range(SAMPLES):
            faded[:, n] = (fade * faded[:, n - 1] if n else 0.0) + (1.0 - fade) * acting[:, n]
        eddy += share * np.mean(1.0 / L_H) * turn(-theta, faded)
    seconds = T_S * k * np.array(offset_v)[:, None]
    none = np.zeros_like(psi)
    return PulseIntegrals(psi / L_H[:, None] + eddy, theta, flux_s + seconds, none, none, acting, 2)


def test_a_voltage_that_is_off_leaves_no_flux() -> None:
    """One volt of 90 over the 150 samples of a segment is 40 % of the flux that the currents make."""
    off, right = (
        normal_equations([_pulses(volts, (0.0, 0.0))], SPLINE, _whiten) for volts in ((1.0, -0.7), (0.0, 0.0))
    )
    assert off.b == pytest.approx(right.b, rel=EXACT, abs=EXACT * float(np.max(np.abs(right.b))))
    assert off.n == right.n


def test_the_current_of_the_iron_is_in_its_columns() -> None:
    """The flux that the recorded current would make beside that of the machine."""
    pulses, bare = _pulses((0.0, 0.0), IRON_S), _pulses((0.0, 0.0), (0.0, 0.0))
    columns = map_rows._iron_columns(pulses, _whiten(pulses.i))
    assert columns @ np.array(IRON_S) == pytest.approx((L_H[:, None] * (pulses.i - bare.i)).T, abs=KERNEL)


def test_residuals_that_hang_together_count_as_fewer() -> None:
    """As many as one time constant of their memory, twice: (1 + a)/(1 - a) of a first-order one."""
    rng, pulses = np.random.default_rng(41), _pulses((0.0, 0.0), (0.0, 0.0))
    x = np.zeros(SPLINE.size + len(NUISANCES))
    whole = [turn(0.0 * pulses.theta, rng.standard_normal((2, SAMPLES))) for _ in range(8)]
    for memory, low, high in ((0.0, 0.9, 1.3), (0.6, 3.0, 5.0)):  # 1.05 of 1 and 3.6 of 4, less what constants took
        traces = []
        for noise in whole:
            out = noise.copy()
            for n in range(1, SAMPLES):
                out[:, n] = memory * out[:, n - 1] + noise[:, n]
            traces.append(_with_flux(pulses, L_H[:, None] * out))
        assert low < correlation(traces, SPLINE, _whiten, x) < high


def _with_flux(pulses: PulseIntegrals, flux: Array) -> PulseIntegrals:
    """Pulses whose integral of the voltage is a flux of the rotor frame."""
    none = np.zeros_like(flux)
    return PulseIntegrals(none, pulses.theta, turn(pulses.theta, flux), none, none, none, 2)


def test_what_the_angles_of_the_pulses_leave_of_the_inductance() -> None:
    """Phases of 3 % and slots: 2.2 % at one angle, nothing over a turn, the slots alone left out by 60 degrees."""

    def at(*angles: float) -> float:
        none = np.zeros((2, len(angles)))
        return map_fit._unseen([PulseIntegrals(none, np.array(angles), none, none, none, none, 0)])

    assert at(0.3) == pytest.approx(math.hypot(0.01, 0.02), rel=1e-9)
    assert at(*np.linspace(0.0, 2.0 * math.pi, 25)[:-1]) == pytest.approx(0.0, abs=1e-12)
    assert at(0.3, 0.3 + math.pi / 6.0) == pytest.approx(0.01 * math.cos(math.pi / 6.0), rel=1e-9)


SWITCHED = 0.03
"""Of the flux that a straight course of the currents leaves; measured 0.016."""


def test_pulses_of_switched_legs_are_the_flux_at_late_samples() -> None:
    """Dead time and ripple within the periods of an unequal machine at rest, by switches and diodes in small steps."""
    link, sampling = Modulation(300.0, (4e-3, 9e-3), T_S, dead_time_s=2.5e-6), Sampling(5e-6, 1.2e-5)
    u = np.array([[-90.0, 110.0, -80.0, -90.0, 110.0, -70.0], [70.0, 90.0, -110.0, 70.0, 90.0, -80.0]])
    phases = phases_of(*np.eye(2), np.full(2, 0.7))
    t, step_s = np.linspace(0.0, T_S, 200, endpoint=False), T_S / 200
    i = seen = np.array([2.5, -1.2])
    psi, samples = L_H * i, []
    for v in (phases @ np.roll(u, 1, axis=1)).T[:, :, None]:  # a command acts one period later
        on, off = (0.5 * T_S * (1.0 + sign * duties(v, link.U_dc_v)) for sign in (-1.0, 1.0))
        after = [np.clip(t + step_s - edge, 0.0, step_s) for edge in (on, on + 2.5e-6, off, off + 2.5e-6)]
        upper, free = after[1] - after[2], after[0] - after[1] + after[2] - after[3]
        for k in range(200):
            if k == 10:
                samples.append(seen)
            psi = psi + 2.0 / 3.0 * link.U_dc_v * (upper[:, k] + np.where(phases @ i < 0.0, free[:, k], 0.0)) @ phases
            seen = seen + step_s / sampling.lag_s * (i - seen)
            i = psi / L_H
    names = ("i_d_a", "i_q_a", "u_d_v", "u_q_v", "omega_e_rad_s", "theta_M_rad")
    signals = dict(zip(names, [*np.array(samples).T, *u, np.zeros(6), np.full(6, 0.35)], strict=True))
    trace = Trace(T_S * np.arange(6.0), signals, dict.fromkeys(names, "1"), {"control_period_s": T_S})
    curve = InverterCurve(np.array([0.02, 10.0]), np.full(2, link.plateau_v), 0.0)

    def left(legs: Legs | None) -> float:
        found = integrate_pulses(trace, Frame(2, 0.0, 0.0), curve, 0.0, legs)
        flux = turn(-found.theta, found.volt_seconds - found.error_seconds) - L_H[:, None] * found.i
        return float(np.max(np.ptp(flux[:, found.first :], axis=1)))

    legs = Legs(link, sampling, lambda x: np.broadcast_to(L_H[:, None], x.shape))
    assert left(legs) < SWITCHED * left(None)
