# SPDX-License-Identifier: MIT
"""From pulse traces to the linear equations of a flux map (docs/identification.md, 3.3).

The flux in the stator frame is an integral of what is known, psi_ab(t_n) = psi_ab(t_0) + integral of u - R i - e, and
psi_dq(i) = R(-theta_n) psi_ab(t_n) is linear in the spline coefficients, in R, in the plateau of the inverter's error,
in currents of iron loss and in a small delay of the current sample. Integration in the stator frame makes the motion of
a free rotor exact and shows the magnet's flux as far as the rotor turned; constant and slope of each short segment are
projected out: nothing drifts, and a voltage that is off (legs, offsets, the inverter's error at rest) is no flux.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.estimators.flux.coenergy_spline import CoenergySpline
from pmsmtool.estimators.injection.sampling_instant import Sampling, sampled_flux
from pmsmtool.estimators.inverter_error import (
    InverterCurve,
    Modulation,
    edge_curve,
    edge_error_v,
    edges_of,
    phases_of,
    stator_frame,
)
from pmsmtool.trace import Trace

SEGMENT = 150
"""Samples that share their constants: long enough for a pulse, short enough for what R and inverter leave to add up."""
SEGMENT_LEAST = 40
CONSTANTS = 4
"""Of a segment: its flux and a voltage that does not change, by two axes."""
GAUSS = (0.5 - 0.5 / math.sqrt(3.0), 0.5 + 0.5 / math.sqrt(3.0))
"""Points of an interval at which the inverter's error is averaged."""
STEPS_LEFT = 0.6
"""Largest rms between measured and smooth angle, in steps of the encoder; steps alone leave 0.29."""
ROUNDING = 1e-6
"""Of an angle recorded in binary32, as a second difference of the electrical angle."""
IRON_PERIODS = (0.0, 2.0)
"""Time constants of branches of iron loss (control periods): what flows in them is in the current and makes no flux."""
NUISANCES = ("R_ohm", "inverter", *(f"iron_{n:g}_s" for n in IRON_PERIODS), "delay_s")
"""Columns behind the spline coefficients."""


@dataclass(frozen=True, slots=True)
class Frame:
    """How the recorded angle becomes the angle of the d axis: theta_e = direction p theta_M - offset."""

    pole_pairs: int
    """Pole pairs times direction."""
    drive_offset_rad: float
    """Offset the drive used while it recorded."""
    offset_rad: float
    """The right one."""


@dataclass(frozen=True, slots=True, eq=False)
class Legs:
    """What flows within a period: edges see another current than the samples, and these are late by ``sampling``.

    ``inductances`` makes of currents (2, n) L_d and L_q there (H), shape (2, n); those of ``modulation`` are typical.
    """

    modulation: Modulation
    sampling: Sampling
    inductances: Callable[[Array], Array]


@dataclass(frozen=True, slots=True, eq=False)
class PulseIntegrals:
    """One trace as integrals; arrays of shape (2, n) unless stated."""

    i: Array
    """Currents in the rotor frame (A)."""
    theta: Array
    """Electrical angle of the d axis (rad). Shape (n,)."""
    volt_seconds: Array
    current_seconds: Array
    error_seconds: Array
    """Integrals of voltage, current and the inverter's measured error up to each sample, stator frame (V s, A s)."""
    volts_before: Array
    """Voltage of the interval before each sample, stator frame (V)."""
    first: int
    """First row whose voltages are all known."""


def integrate_pulses(
    trace: Trace, frame: Frame, curve: InverterCurve, R_ohm: float, legs: Legs | None = None
) -> PulseIntegrals:
    """Return the integrals of a trace.

    Parameters
    ----------
    trace : Trace
        ``i_d_a i_q_a u_d_v u_q_v omega_e_rad_s theta_M_rad`` in the drive's rotor frame; ``meta["voltage_lag"]``.
    frame : Frame
        Angles.
    curve : InverterCurve
        Voltage error of one phase.
    R_ohm : float
        Loop resistance, for the torque that smooths the angle (ohm).
    legs : Legs, optional
        None: the error of a current that runs evenly from sample to sample.
    """
    lag = int(trace.meta.get("voltage_lag", 1))
    T_s = float(trace.meta["control_period_s"])
    turned = frame.pole_pairs * trace["theta_M_rad"] - frame.drive_offset_rad
    i_s = turn(turned, np.stack([trace["i_d_a"], trace["i_q_a"]]))
    # what is computed at t_k acts lag periods later, in the frame the drive expected there
    u_s = turn(turned + (lag + 0.5) * T_s * trace["omega_e_rad_s"], np.stack([trace["u_d_v"], trace["u_q_v"]]))
    acting = np.zeros_like(u_s)
    acting[:, lag:] = u_s[:, : u_s.shape[1] - lag]
    acting = acting[:, :-1]
    before = np.zeros_like(u_s)
    before[:, 1:] = acting
    mean_current = 0.5 * (i_s[:, :-1] + i_s[:, 1:])
    error_seconds = _cumulated(T_s * mean_error(curve, i_s))
    volt_seconds, current_seconds = _cumulated(T_s * acting), _cumulated(T_s * mean_current)
    flux = volt_seconds - R_ohm * current_seconds - error_seconds
    theta = smooth_angle(turned, i_s, flux, T_s) + frame.drive_offset_rad - frame.offset_rad
    if legs is not None:
        error, beyond = _within_periods(curve, i_s, acting, theta, legs)
        error_seconds, volt_seconds = _cumulated(T_s * error), volt_seconds + beyond
    return PulseIntegrals(
        i=turn(-theta, i_s),
        theta=theta,
        volt_seconds=volt_seconds,
        current_seconds=current_seconds,
        error_seconds=error_seconds,
        volts_before=before,
        first=lag + 2,
    )


def _within_periods(curve: InverterCurve, i_s: Array, acting: Array, theta: Array, legs: Legs) -> tuple[Array, Array]:
    """Return the error of each period (V), and by what each sample is beyond its period's end (V s); stator frame.

    What a sample holds beyond that end is known by the edges, which the current at that end moves: two rounds.
    """
    v, sharp = phases_of(acting[0], acting[1], np.zeros(1)), edge_curve(curve, legs.modulation)
    i = turn(-theta, i_s)
    L, L_mean = legs.inductances(i), legs.inductances(0.5 * (i[:, :-1] + i[:, 1:]))
    middle, beyond = 0.5 * (theta[:-1] + theta[1:]), np.zeros_like(i_s)
    for _ in range(2):
        at_end = i_s - turn(theta, turn(-theta, beyond) / L)
        phases = phases_of(at_end[0], at_end[1], np.zeros(1))
        edges = edges_of(sharp, phases[:, :-1], np.diff(phases), v, middle, legs.modulation, L_mean)
        beyond[:, 1:] = stator_frame(sampled_flux(*edges, legs.modulation, legs.sampling))
    return edge_error_v(*edges, v, legs.modulation), beyond


def mean_error(curve: InverterCurve, i: Array) -> Array:
    """Return the error of each interval in the stator frame (V), shape (2, n - 1), of the interpolated current."""
    still = np.zeros(i.shape[1] - 1)
    error = np.zeros((2, i.shape[1] - 1))
    for share in GAUSS:
        at = (1.0 - share) * i[:, :-1] + share * i[:, 1:]
        error += 0.5 * np.stack(curve.error_dq_v(at[0], at[1], still))
    return error


def smooth_angle(theta: Array, i: Array, flux: Array, T_s: float) -> Array:
    """Return the electrical angle without the steps of the encoder, where a rigid rotor explains it.

    J theta'' = k (psi x i) + constant - friction sgn(theta') is linear in 1/J, in the two unknown constants of the
    stator flux and in the friction: one least squares over the train. Magnet flux times a step of a coarse encoder is a
    percent of the flux range of many machines; the fit has some eight parameters for two thousand samples. Where what
    it leaves is more than steps can be (an elastic shaft, cogging), the measured angle stays.

    Parameters
    ----------
    theta : ndarray, shape (n,)
        Measured angle (rad electrical).
    i, flux : ndarray, shape (2, n)
        Current (A) and integral of the voltage behind R (V s), stator frame.
    T_s : float
        Sampling period (s).
    """
    # second differences: of a turning rotor every first one is many steps; what binary32 rounds is none
    steps = np.abs(np.diff(theta, 2))
    steps = steps[steps > ROUNDING * max(1.0, float(np.max(np.abs(theta))))]
    if len(steps) == 0:
        return theta
    one_step = float(np.min(steps))
    t = np.linspace(-1.0, 1.0, len(theta))
    torque = flux[0] * i[1] - flux[1] * i[0]
    columns = [np.ones_like(t), t, t * t, *(_twice_summed(x) for x in (torque, i[0], i[1]))]
    smooth = _fitted(columns, theta)
    smooth = _fitted([*columns, _twice_summed(np.sign(np.gradient(smooth)))], theta)
    left = float(np.sqrt(np.mean(np.square(theta - smooth))))
    return smooth if left <= STEPS_LEFT * one_step else theta


def _twice_summed(x: Array) -> Array:
    once = np.cumsum(x)
    return np.cumsum(once - 0.5 * x)


def _fitted(columns: Sequence[Array], y: Array) -> Array:
    A = np.stack([column / max(float(np.max(np.abs(column))), 1e-300) for column in columns], axis=1)
    x, *_ = np.linalg.lstsq(A, y, rcond=None)
    return np.asarray(A @ x)


def turn(angle: Array, x: Array) -> Array:
    """Return vectors (2, n) turned by angles (n,)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * x[0] - s * x[1], s * x[0] + c * x[1]])


def _cumulated(per_interval: Array) -> Array:
    return np.concatenate([np.zeros((2, 1)), np.cumsum(per_interval, axis=1)], axis=1)


@dataclass(slots=True)
class NormalEquations:
    """Sums of the whitened rows: x minimises x' A x - 2 b' x + c."""

    A: Array
    """Shape (k, k)."""
    b: Array
    """Shape (k,)."""
    c: float = 0.0
    n: int = 0
    """Number of residuals, the projected constants taken off."""

    def add(self, rows: Array, target: Array) -> None:
        """Add rows (n, k) with their targets (n,)."""
        self.A += rows.T @ rows
        self.b += rows.T @ target
        self.c += float(target @ target)

    def squares(self, x: Array) -> float:
        """Return the sum of squared residuals at x."""
        return float(self.c - 2.0 * (self.b @ x) + x @ self.A @ x)


Whitener = Callable[[Array], Array]
"""From currents (2, n) to the matrices (n, 2, 2) that turn flux residuals into residuals of equal weight."""


def normal_equations(
    traces: Sequence[PulseIntegrals], spline: CoenergySpline, whiten: Whitener, skew: CoenergySpline | None = None
) -> NormalEquations:
    """Add up the equations of all traces.

    Parameters
    ----------
    traces : sequence of PulseIntegrals
        The data.
    spline : CoenergySpline
        The space of W.
    whiten : callable
        Weights of the two rows of a sample.
    skew : CoenergySpline, optional
        A coarse space of flux that has no co-energy, put on psi_d behind all other columns: the test of reciprocity.
    """
    size = spline.size + len(NUISANCES) + (0 if skew is None else skew.size)
    sums = NormalEquations(np.zeros((size, size)), np.zeros(size))
    for rows, target in _segments(traces, spline, whiten, skew):
        sums.add(rows, target)
        sums.n += len(target) - CONSTANTS
    return sums


def correlation(traces: Sequence[PulseIntegrals], spline: CoenergySpline, whiten: Whitener, x: Array) -> float:
    """Return how many neighbouring residuals at a solution say the same: one where they are noise alone."""
    sums = np.zeros(SEGMENT)
    for rows, target in _segments(traces, spline, whiten, None):
        left = (target - rows @ x).reshape(-1, 2)
        for apart in range(min(SEGMENT, len(left))):
            sums[apart] += float(np.sum(left[apart:] * left[: len(left) - apart]))
    falling = sums / sums[0]
    end = int(np.argmax(falling <= 0.0))
    return 1.0 + 2.0 * float(np.sum(falling[1:end]))


def _segments(
    traces: Sequence[PulseIntegrals], spline: CoenergySpline, whiten: Whitener, skew: CoenergySpline | None
) -> Iterator[tuple[Array, Array]]:
    """Yield rows (n, k) and targets (n,) of each segment without its constants."""
    for trace in traces:
        rows, target, constants = _rows(trace, spline, whiten, skew)
        for start in range(trace.first, len(trace.theta), SEGMENT):
            part = slice(start, min(start + SEGMENT, len(trace.theta)))
            n = part.stop - part.start
            if n < SEGMENT_LEAST:
                continue
            x, y = rows[part].reshape(2 * n, -1), target[part].ravel()
            level = constants[part]
            q, _ = np.linalg.qr(np.concatenate([level, np.arange(n)[:, None, None] * level], axis=2).reshape(2 * n, -1))
            yield x - q @ (q.T @ x), y - q @ (q.T @ y)


def _rows(
    trace: PulseIntegrals, spline: CoenergySpline, whiten: Whitener, skew: CoenergySpline | None
) -> tuple[Array, Array, Array]:
    """Rows (n, 2, k), targets (n, 2) and the columns (n, 2, 2) of a segment's constant, whitened."""

    def seen(vector: Array) -> Array:
        return turn(-trace.theta, vector).T

    i_d, i_q = trace.i
    w = whiten(trace.i)
    parts = [
        np.stack([spline.derivative(i_d, i_q, 1, 0), spline.derivative(i_d, i_q, 0, 1)], axis=1),
        seen(trace.current_seconds)[:, :, None],
        seen(trace.error_seconds)[:, :, None],
        _iron_columns(trace, w),
        seen(trace.volts_before)[:, :, None],
    ]
    if skew is not None:
        field = skew.derivative(i_d, i_q, 0, 0)
        parts.append(np.stack([field, np.zeros_like(field)], axis=1))
    c, s = np.cos(trace.theta), np.sin(trace.theta)
    constants = np.stack([np.stack([c, s], axis=1), np.stack([-s, c], axis=1)], axis=1)

    def weighted(x: Array) -> Array:
        # two products of the wide array instead of thousands of small matrix products
        return np.stack([w[:, k, :1] * x[:, 0] + w[:, k, 1:] * x[:, 1] for k in range(2)], axis=1)

    rows, target = weighted(np.concatenate(parts, axis=2)), weighted(seen(trace.volt_seconds)[:, :, None])
    return rows, target[:, :, 0], weighted(constants)


def _iron_columns(trace: PulseIntegrals, w: Array) -> Array:
    """Flux (n, 2, k) of the currents of iron loss: of one ampere per volt, in seconds by the mean inductance."""
    columns = []
    for periods in IRON_PERIODS:
        fade = math.exp(-1.0 / periods) if periods else 0.0
        kernel = (1.0 - fade) * fade ** np.arange(1.0 + round(8.0 * periods))
        volts = np.stack([np.convolve(u, kernel)[: len(trace.theta)] for u in trace.volts_before])
        columns.append(turn(-trace.theta, volts).T)
    mean = float(np.mean(np.diagonal(w, axis1=1, axis2=2)))
    return np.asarray(np.linalg.solve(w, mean * np.stack(columns, axis=2)))
