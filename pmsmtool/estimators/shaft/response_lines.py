# SPDX-License-Identifier: MIT
"""Lines of a mechanical frequency response: transforms of torque and acceleration, and the local polynomial method.

The method takes the transient of a record apart from the response and gives each line its noise (Pintelon and
Schoukens, System Identification, 2nd ed. 2012, chapter 7, DOI 10.1002/9781118287422).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array, Complex
from pmsmtool.estimators.shaft.position import encoder_step
from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace

STAGE = "frequency response"
LOWEST_HZ = 5.0
HIGHEST_SHARE = 0.2
"""Largest frequency, of the rate of rows: beyond it the spectrum of the sequence folds back."""
HALF_WIDTH = 3
"""Lines on each side of one that its polynomials use."""
ORDER = 2
SHARE_LEAST = 0.5
"""Share of the measured torque's power that is no noise, where the band ends: noise that is 10 % more than at rest
leaves 10 % of a response there."""
SPEEDS, COUNTED_HARMONICS, COUNTED_WITHIN, COUNTED_HZ = 10, 3, 0.1, 10.0
"""Parts of a record whose speeds are looked at; harmonics of an encoder's steps, their largest spread, of the rate of
rows, in a record that counts as a tone, and what is left out on either side of one (Hz)."""
LINES_LEAST = 40
"""Lines below which a record is too short."""


def transforms(
    runs: Sequence[Trace], torques: Sequence[Array], direction: int
) -> tuple[Array, Complex, Complex, float]:
    """Return frequency (rad/s), transforms of torque and acceleration in the band, and the period of rows."""
    T = runs[0].period_s
    n = len(runs[0]) - 2
    frequency = np.fft.rfftfreq(n, T)
    first = int(np.searchsorted(frequency, LOWEST_HZ))
    band = slice(max(HALF_WIDTH + 1, first), int(np.searchsorted(frequency, HIGHEST_SHARE / T)))
    U, Y = [], []
    for run, torque in zip(runs, torques, strict=True):
        tau = torque[1:-1]
        U.append(np.fft.rfft(tau - np.mean(tau))[band])
        Y.append(np.fft.rfft(direction * np.diff(run["theta_M_rad"], 2) / T**2)[band])
    omega: Array = np.asarray(2.0 * math.pi * frequency[band], dtype=np.float64)
    if len(omega) < LINES_LEAST + 2 * HALF_WIDTH:
        raise refuse("E_EXCITATION", f"records of {n * T:.3g} s give {len(omega)} lines", stage=STAGE)
    # the second difference of a position is the acceleration over a triangle of two rows
    return omega, np.array(U), np.array(Y) / np.sinc(0.5 * omega * T / math.pi) ** 2, T


def counted(runs: Sequence[Trace], omega: Array) -> NDArray[np.bool_]:
    """Return the lines to which the steps of a coarse encoder fold back: they move current and position alike.

    4445 steps a second, of 10 bits, in rows of 4 kHz passed for a second mass at 438 Hz: of 106, the motor had one.
    """
    frequency, step = omega / (2.0 * math.pi), encoder_step([run["theta_M_rad"] for run in runs])
    blind = np.zeros(len(omega), dtype=np.bool_)
    for run in runs:
        theta, count, rate = run["theta_M_rad"], len(run) // SPEEDS, 1.0 / run.period_s
        turned = np.abs(theta[count:] - theta[:-count]) / (count * run.period_s * step)
        for steps in (turned * harmonic for harmonic in range(1, COUNTED_HARMONICS + 1)):
            if np.ptp(steps) < COUNTED_WITHIN * rate:  # else they are a noise
                folded = np.abs(steps - rate * np.round(steps / rate))
                blind |= (frequency > np.min(folded) - COUNTED_HZ) & (frequency < np.max(folded) + COUNTED_HZ)
    return blind


def smooth_power(U: Complex) -> Array:
    """Return the mean squared magnitude of lines over records, and over as many lines as the polynomials use."""
    mean = np.mean(np.abs(U) ** 2, axis=0)
    around = np.ones(2 * HALF_WIDTH + 1)
    return np.asarray(np.convolve(mean, around, "same") / np.convolve(np.ones_like(mean), around, "same"))


def without_noise(U: Complex, power: float) -> Complex:
    """Return of measured lines what their noise lets expect of the true ones, up to the last that is no noise.

    Noise of the input makes a response too small where the input is weak, and its fall with the frequency looks like a
    second mass: with S + N measured, S/(S + N) of a line is expected (regression calibration; Carroll et al.,
    Measurement Error in Nonlinear Models, 2nd ed. 2006, chapter 4).

    Parameters
    ----------
    U : ndarray, shape (records, lines)
        Transforms of the measured torque.
    power : float
        Mean squared magnitude of a line's noise.
    """
    share = 1.0 - power / smooth_power(U)
    clear = np.flatnonzero(share >= SHARE_LEAST)
    if len(clear) < LINES_LEAST + 2 * HALF_WIDTH:
        raise refuse(
            "E_COHERENCE",
            f"the torque is above the noise of its current on {len(clear)} of {len(share)} lines, "
            f"{LINES_LEAST + 2 * HALF_WIDTH} are needed",
            stage=STAGE,
        )
    return np.asarray((U * np.maximum(share, SHARE_LEAST))[:, : int(clear[-1]) + 1])


def local_polynomials(U: Complex, Y: Complex) -> tuple[Complex, Array, Array, Array]:
    """Return response, noise of one record's line, deviation of the magnitude and coherence of the inner lines."""
    records = len(U)
    width = 2 * HALF_WIDTH + 1
    r = np.linspace(-1.0, 1.0, width)
    powers = np.stack([r**p for p in range(ORDER + 1)], axis=1)
    Q, _ = np.linalg.qr(powers)
    without_transient = np.eye(width) - Q @ Q.T
    windows = [np.lib.stride_tricks.sliding_window_view(X, width, axis=1) for X in (U, Y)]
    u, y = (np.moveaxis(window, 0, 1) for window in windows)  # (lines, records, width)
    W = np.einsum("ij,lrj,jp->lrip", without_transient, u, powers).reshape(len(u), records * width, ORDER + 1)
    z = (y @ without_transient).reshape(len(u), records * width)
    normal = np.conj(np.swapaxes(W, 1, 2)) @ W
    inverse = np.linalg.inv(normal)
    x = (inverse @ (np.conj(np.swapaxes(W, 1, 2)) @ z[..., None]))[..., 0]
    rest = z - (W @ x[..., None])[..., 0]
    dof = records * (width - ORDER - 1) - ORDER - 1
    variance = np.sum(np.abs(rest) ** 2, axis=1) / dof
    G = x[:, 0]
    std = np.sqrt(0.5 * variance * np.real(inverse[:, 0, 0]))
    explained = np.abs(G) ** 2 * np.mean(np.abs(u) ** 2, axis=(1, 2))
    return G, np.sqrt(variance), std, explained / (explained + variance)
