# SPDX-License-Identifier: MIT
"""Recorded torque pushes resolved in time: one regression over all short blocks, the rise of the current included.

A block of a few samples gives one complex row (d + j q), with x = w T_s / 2, e = i / abs(i) and the true angle of the
frame at the middle of the voltage,

    u x/sin x exp(j d T_s (w_drive - w)) = R i + j w psi + V(abs(i), w) e + j sgn(w) h(abs(w), abs(i)) e
                                         + j w (L_d i_d + j L_q i_q) + L_d' di_d/dt + j L_q' di_q/dt + c + j w m u

While the current rises, i_d and i_q go through other ratios than settled pushes ever have, and every term but R i and
j w psi turns or changes with them. Four things were found in recorded pushes of random drives (seeds 8000 to 8041) and
are in the model for that:

- The drive turns its voltage ahead by its own speed, which lags behind the rotor's under acceleration. The angle is a
  few milliradians, but it is proportional to the current and stands before w psi: L_q came 0.5 to 1 % too large.
- The inverter's error lies along the current; a part h lies across it, because a phase whose current passes zero stays
  there for a while. It depends on speed and current and is told apart from w L_q i_q by several currents at one speed.
- Its harmonics of six times the electrical speed beat with the samples. Where fewer than one beat is in a block, the
  block counts less: at low speed, and where rows come about once per period of the harmonic.
- Apparent inductances stand before the speed, incremental ones before the slope: they are one on a linear machine only.

What nobody knows is the shape of V and h, and whether the frame turns with the speed by more than that (m). Several
models are fitted (:data:`SHAPES`); the mean is the estimate and their spread is doubt. Large residuals count less
(Huber), and the pushes are left out one by one for the standard deviation.

References
----------
Huber, P. J. Ann. Math. Statist. 35, 73 (1964), DOI 10.1214/aoms/1177703732.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.estimators.estimate import CONDITION_LIMIT, MEDIAN_TO_STD, scaled_covariance
from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace

STAGE = "recorded torque pulses"
BLOCK = 8
"""Samples averaged to one row."""
LEAST_BLOCKS = 8
DELAY_PERIODS = 1.5
"""From a sample to the middle of the voltage computed from it, in control periods (d in the model)."""
CLEAN_SHARE = 0.6
"""Least share of blocks without a limited sample."""
HARMONIC = 6
"""What the inverter's error repeats per electrical turn."""
LEAST_WEIGHT = 0.15
"""Weight of a block that holds nothing of a beat."""
SMALLEST_SHARE = 0.18
"""Blocks with less current, of the largest push's mean, are left out: the ripple decides the inverter's error there."""
SLOPE_NOISE = 4.0
"""A current slope below so many standard deviations of its noise counts as none: noise in a regressor biases."""
KNOTS = 5
"""Speeds between which h is straight, from 0 to :data:`TOP_QUANTILE` of the speeds."""
TOP_QUANTILE = 0.95
HUBER = 2.0
"""Residuals beyond so many standard deviations count less."""
ITERATIONS = 5
TOLD = 5
"""Coefficients that are told: R, psi_q, psi_d, L_q, V."""

Rows = NDArray[np.complexfloating[Any, Any]]


@dataclass(frozen=True, slots=True)
class Shape:
    """One guess at the inverter's error, and whether the machine is taken as linear."""

    along: tuple[int, ...]
    """Powers of 1/abs(i) in V."""
    across: tuple[int, ...]
    """Powers of 1/abs(i) in h, each with its own function of the speed."""
    crossing: tuple[float, ...] = ()
    """Parts of h that follow the slope s at which a phase current passes zero, s/(1 + s^2), s over these shares of the
    largest speed times the largest current."""
    linear: bool = False
    """One inductance per axis for speed and slope."""
    turned: bool = False
    """The frame may be off by an angle in proportion to the speed."""


SHAPES = (
    Shape((1,), (0, 1), linear=True),
    Shape((1, 2), (0, 1, 2), linear=True, turned=True),
    Shape((1, 2), (0, 1), (0.1, 0.3), linear=True),
    Shape((1, 2), (0, 1), (0.1, 0.3)),
)
"""Chosen on 119 random drives (seeds 8000 to 8041 and 65000 to 65076). On nine of ten of them R was within 1.7, 1.4,
1.3 and 1.5 % with each alone and within 1.2 % with the mean, L_q within 2.6, 2.9, 1.7 and 1.5 % and within 1.6 %."""


@dataclass(frozen=True, slots=True)
class Blocks:
    """Rows of one push; shapes (n,)."""

    w: Array
    """Electrical speed at the middle of the voltage (rad/s)."""
    i: Rows
    slope: Rows
    u: Rows
    """Current there (A), its slope (A/s) and the voltage (V), d + j q."""
    weight: Array
    """1, less where harmonics of the inverter do not average out."""
    rate: float
    """Size of the electrical acceleration (rad/s2)."""
    lag: float
    """Mean of the drive's own speed less the rotor's (rad/s)."""
    i_q: float
    """Mean torque current (A)."""


@dataclass(frozen=True, slots=True)
class Resolved:
    """What the regression tells: values and standard deviations of R, psi_q, psi_d, L_q and V, shape (5,)."""

    value: Array
    std: Array
    reactance_v: float
    """Root mean square of w L_q i_q (V)."""
    rows: int


def push_blocks(push: Trace, period_s: float, pole_pairs: int) -> Blocks:
    """Return the rows of a push.

    Raises IdentificationError: ``E_EXCITATION``: too short; ``E_CLIPPED``: the voltage was limited in too much of it.

    Parameters
    ----------
    push : Trace
        ``i_d_a i_q_a u_d_v u_q_v omega_e_rad_s theta_M_rad flagged``.
    period_s : float
        Control period (s).
    pole_pairs : int
        Pole pairs.
    """
    blocks = len(push) // BLOCK
    if blocks < LEAST_BLOCKS:
        raise refuse("E_EXCITATION", f"a torque pulse of {len(push)} samples is too short", stage=STAGE)

    def means(name: str) -> Array:
        signal = np.asarray(push[name], dtype=np.float64)[: blocks * BLOCK]
        return np.asarray(signal.reshape(blocks, BLOCK).mean(axis=1))

    clean = means("flagged") == 0.0
    if clean.mean() < CLEAN_SHARE:
        raise refuse("E_CLIPPED", f"{100.0 * (1.0 - clean.mean()):.0f} % of a torque pulse were limited", stage=STAGE)
    spacing_s = float(push.t_s[1] - push.t_s[0])
    step_s = BLOCK * spacing_s
    # the mean angle of a block belongs to its middle: differences of neighbours
    w = pole_pairs * np.gradient(means("theta_M_rad"), step_s)
    own = means("omega_e_rad_s")
    w *= math.copysign(1.0, float(w @ own))  # an encoder that counts backwards
    index = np.arange(blocks)
    acceleration = np.polyval(np.polyfit(index, np.gradient(w, step_s), 2), index)
    ahead = w + DELAY_PERIODS * period_s * acceleration
    sampled = 1.0 / np.sinc(ahead * period_s / (2.0 * math.pi))
    u = (means("u_d_v") + 1j * means("u_q_v")) * sampled * np.exp(1j * DELAY_PERIODS * period_s * (own - w))
    i = means("i_d_a") + 1j * means("i_q_a")
    slope = np.gradient(i, step_s)
    used = clean.copy()
    used[1:] &= clean[:-1]  # the slopes of a block come from its neighbours
    used[:-1] &= clean[1:]
    used[[0, -1]] = False
    return Blocks(
        w=ahead[used],
        i=(i + DELAY_PERIODS * period_s * slope)[used],
        slope=slope[used],
        u=u[used],
        weight=_beats(w, spacing_s)[used],
        rate=abs(float(np.polyfit(index * step_s, w, 1)[0])),
        lag=float((own - w).mean()),
        i_q=float(i.imag.mean()),
    )


def _beats(w: Array, spacing_s: float) -> Array:
    """Return the weights of blocks: beats of the inverter's harmonic with the samples in a block, at most 1."""
    cycles = HARMONIC * np.abs(w) * spacing_s / (2.0 * math.pi)
    return np.asarray(np.clip(np.abs(cycles - np.round(cycles)) * BLOCK, LEAST_WEIGHT, 1.0))


def resolve(pushes: Sequence[Blocks]) -> Resolved:
    """Fit all shapes to the rows of all pushes.

    Raises IdentificationError: ``E_NOT_IDENTIFIABLE``: the pushes do not tell the terms apart.
    """
    smallest = SMALLEST_SHARE * max(abs(push.i_q) for push in pushes)
    kept = [np.abs(push.i) >= smallest for push in pushes]
    owner = np.concatenate([np.full(int(keep.sum()), k) for k, keep in enumerate(kept)])
    w, weight = (
        np.concatenate([getattr(push, name)[keep] for push, keep in zip(pushes, kept, strict=True)])
        for name in ("w", "weight")
    )
    i, slope, u = (
        np.concatenate([getattr(push, name)[keep] for push, keep in zip(pushes, kept, strict=True)])
        for name in ("i", "slope", "u")
    )
    slope = _above_noise(slope.real) + 1j * _above_noise(slope.imag)
    fits = [_fit(_columns(shape, w, i, slope, u), u, weight, owner, len(pushes)) for shape in SHAPES]
    values = np.array([fit[0] for fit in fits])
    without = np.mean([fit[1] for fit in fits], axis=0)
    n = len(pushes)
    jackknife = (n - 1) / n * np.sum((without - without.mean(axis=0)) ** 2, axis=0)
    value = values.mean(axis=0)
    reactance = abs(value[3]) * math.sqrt(float(np.mean((w * i.imag) ** 2)))
    return Resolved(value, np.sqrt(jackknife + values.var(axis=0, ddof=1)), reactance, len(w))


def _above_noise(part: Array) -> Array:
    """Return slopes with those that are only noise set to zero."""
    noise = MEDIAN_TO_STD * float(np.median(np.abs(part - np.median(part))))
    return np.asarray(np.where(np.abs(part) > SLOPE_NOISE * noise, part, 0.0))


def _columns(shape: Shape, w: Array, i: Rows, slope: Rows, u: Rows) -> list[Rows]:
    """Return the regressors, shape (n,) each; the first :data:`TOLD` are those that are told."""
    size, speed = np.abs(i), np.abs(w)
    along, share = i / size, size / size.max()
    across = 1j * np.sign(w) * along
    L_q, L_d = -w * i.imag + 0j, 1j * w * i.real
    slopes: list[Rows] = [slope.real + 0j, 1j * slope.imag]
    if shape.linear:
        L_q, L_d, slopes = L_q + slopes[1], L_d + slopes[0], []
    columns = [i, 1j * w, w + 0j, L_q, along, L_d, *slopes, np.ones_like(i), np.full_like(i, 1j), along * speed]
    columns += [1j * w * u] if shape.turned else []
    columns += [along / share**power for power in shape.along]
    knots = np.linspace(0.0, float(np.quantile(speed, TOP_QUANTILE)), KNOTS)
    hats = [np.interp(speed, knots, row) for row in np.eye(KNOTS)]
    columns += [across * hat / share**power for hat in hats for power in shape.across]
    for scale in shape.crossing:
        steep = speed * share / (scale * speed.max())
        columns.append(across * steep / (1.0 + steep * steep))
    return columns


def _fit(columns: Sequence[Rows], u: Rows, weight: Array, owner: NDArray[np.int64], n: int) -> tuple[Array, Array]:
    """Return the told coefficients, shape (5,), and those without each push, shape (n, 5)."""
    complex_matrix = np.column_stack(columns)
    matrix = np.vstack([complex_matrix.real, complex_matrix.imag])
    measured, whose = np.concatenate([u.real, u.imag]), np.concatenate([owner, owner])
    scale = np.sqrt(np.mean(matrix**2, axis=0))
    if np.any(scale[:TOLD] == 0.0):
        raise refuse("E_NOT_IDENTIFIABLE", "the shaft did not turn during the torque pulses", stage=STAGE)
    there = scale > 0.0
    matrix, scale = matrix[:, there] / scale[there], scale[there]
    beats = np.concatenate([weight, weight]) ** 2
    condition = scaled_covariance(matrix * np.sqrt(beats)[:, None])[1]
    if not condition <= CONDITION_LIMIT:
        what = "R, psi, L_q and the inverter's error"
        raise refuse("E_NOT_IDENTIFIABLE", f"condition {condition:.3g} of {what} together", stage=STAGE)
    weights = beats
    for _ in range(ITERATIONS):
        solution = np.linalg.solve(matrix.T @ (matrix * weights[:, None]), matrix.T @ (weights * measured))
        residual = np.abs(measured - matrix @ solution) * np.sqrt(beats)
        limit = HUBER * MEDIAN_TO_STD * float(np.median(residual))
        weights = beats / np.maximum(1.0, residual / limit) if limit > 0.0 else beats
    without = np.empty((n, TOLD))
    normal, right = _normal(matrix, measured, weights)
    for k in range(n):
        mine = whose == k
        less = _normal(matrix[mine], measured[mine], weights[mine])
        without[k] = (np.linalg.lstsq(normal - less[0], right - less[1], rcond=None)[0] / scale)[:TOLD]
    return (solution / scale)[:TOLD], without


def _normal(matrix: Array, measured: Array, weights: Array) -> tuple[Array, Array]:
    weighted = matrix * weights[:, None]
    return matrix.T @ weighted, weighted.T @ measured
