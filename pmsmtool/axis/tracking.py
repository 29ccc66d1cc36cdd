# SPDX-License-Identifier: MIT
"""The following error of a move that the loops make, and how much feed-forward of the inertia makes it least.

A load behind an elastic shaft answers a feed-forward of the whole inertia well below its antiresonance only; above, the
motor alone takes the torque. So a trapezoid, whose acceleration steps, may be followed better with less of it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pmsmtool.axis.loops import AxisGains, AxisPath, Lifted, controllers
from pmsmtool.axis.reference import Move

Array = NDArray[np.float64]

REST_S = 0.5
"""Rest behind each of the two moves of a period: what the first leaves has decayed."""
SHARES = np.linspace(0.0, 1.0, 21)
"""Shares of the inertia that are compared."""


def following_error(plant: Lifted, path: AxisPath, gains: AxisGains, move: Move) -> tuple[Array, Array]:
    """Return the following error (rad) of a move there and back, periodic, shape (n,), by samples of the loops.

    Returns
    -------
    tuple of ndarray
        Without feed-forward of the acceleration, and what one unit of it (the whole inertia) adds.
    """
    T = plant.T
    half = math.ceil((move.duration_s + REST_S) / T)
    t = np.asarray(np.arange(half) * T, dtype=np.float64)
    place, speed, acceleration = (np.concatenate(pair) for pair in _there_and_back(move, t))
    omega = np.asarray(2.0 * math.pi * np.fft.rfftfreq(2 * half, T)[1:], dtype=np.float64)
    seen = plant.at(omega)
    z = np.exp(1j * omega * T)
    angle, slip = (np.polyval(num, z) / np.polyval(den, z) for num, den in controllers(path, gains, "position"))
    back = 1.0 + angle * seen[0] + slip * seen[1]
    reference, fast, force = (np.fft.rfft(signal)[1:] for signal in (place, speed, acceleration))
    # what the controller multiplies the reference with: as the angle that is fed back, its speed exact where a cascade
    # takes that from the profile
    asked = angle * reference
    if path.structure == "cascade":
        control = slip if path.pll_rad_s else _speed_control(path, gains, z)
        asked = control * (gains.K_v * reference + fast)
    plain = reference - seen[0] * asked / back
    added = -seen[0] * path.shaft.J * force / back
    return tuple(np.fft.irfft(np.concatenate(([0.0], one)), 2 * half) for one in (plain, added))  # type: ignore[return-value]


def _there_and_back(move: Move, t: Array) -> list[tuple[Array, Array]]:
    place, speed, acceleration = move.at(t)
    return [(place, move.distance - place), (speed, -speed), (acceleration, -acceleration)]


def _speed_control(path: AxisPath, gains: AxisGains, z: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return the speed controller: what acts on K_v times the error of the position."""
    (num, den), _ = controllers(path, AxisGains(gains.K_p, gains.K_i, 1.0, gains.notch), "position")
    (slow, den_slow), _ = controllers(path, AxisGains(gains.K_p, gains.K_i, 0.0, gains.notch), "position")
    return np.asarray(np.polyval(num, z) / np.polyval(den, z) - np.polyval(slow, z) / np.polyval(den_slow, z))


def best_share(plain: Array, added: Array) -> tuple[float, float]:
    """Return the share of the inertia whose feed-forward leaves the least peak of the error, and that peak (rad)."""
    peaks = np.max(np.abs(plain - plain.mean() + SHARES[:, None] * (added - added.mean())), axis=1)
    best = int(np.argmin(peaks))
    return float(SHARES[best]), float(peaks[best])
