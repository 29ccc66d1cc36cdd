# SPDX-License-Identifier: MIT
"""Motion of a shaft with viscous and Coulomb friction, in closed form where the torque is constant over intervals."""

from __future__ import annotations

import math

import numpy as np

from pmsmtool.arrays import Array

SERIES_BELOW = 1e-3
"""B T/J of an interval below which the way is a series; its next term is 1e-15."""
DECAY_MOST = 50.0
"""Largest B T/J that is summed up at once."""
SMALLEST_DECAY = 1e-9
"""B T/J below which an interval is a parabola."""


def positions(torque: Array, T: float, x: Array) -> Array:
    """Return the positions (rad) at the ends of intervals of constant torque, shape (n + 1,).

    Parameters
    ----------
    torque : ndarray, shape (n,)
        Mean torque of each interval (N m).
    T : float
        Length of an interval (s).
    x : ndarray, shape (5,)
        ln J, B, tau_c, first position and first speed.

    Raises
    ------
    OverflowError
        The speed would grow or decay within a fiftieth of an interval: a step of a fit that leads nowhere.
    """
    J, B, tau_c = math.exp(float(x[0])), float(x[1]), float(x[2])
    if not abs(B) * T <= DECAY_MOST * J:
        raise OverflowError("a shaft without a motion between the intervals")
    theta, omega = float(x[3]), float(x[4])
    out = np.empty(len(torque) + 1)
    out[0] = theta
    k = 0
    while k < len(torque):
        if omega != 0.0:
            ways, omega = _turning(torque[k:], T, omega, (J, B, tau_c))
            out[k + 1 : k + 1 + len(ways)] = theta + ways
            k += len(ways)
            theta = float(out[k])
        if k < len(torque):
            way, omega = _interval(float(torque[k]), T, omega, (J, B, tau_c))
            theta += way
            k += 1
            out[k] = theta
    return out


def _turning(torque: Array, T: float, omega: float, shaft: tuple[float, float, float]) -> tuple[Array, float]:
    """Return ways (rad) to the ends of the intervals before the speed changes its sign, and the speed after them.

    Within an interval it is monotone, so that its ends tell.
    """
    J, B, tau_c = shaft
    sign, x = math.copysign(1.0, omega), B * T / J
    n = len(torque) if abs(x) * len(torque) <= DECAY_MOST else max(1, int(DECAY_MOST / abs(x)))
    gone = 1.0 if x == 0.0 else -math.expm1(-x) / x
    later = 0.5 - x / 6.0 + x * x / 24.0 - x**3 / 120.0 if abs(x) < SERIES_BELOW else (1.0 - gone) / x
    rate = (torque[:n] - tau_c * sign) / J
    grown = np.exp(x * np.arange(1.0, n + 1.0))
    speed = np.empty(n + 1)
    speed[0] = omega
    speed[1:] = (omega + np.cumsum(rate * (T * gone) * grown)) / grown
    turned = np.flatnonzero(speed[1:] * sign <= 0.0)
    n = int(turned[0]) if len(turned) else n
    ways = np.cumsum(speed[:n] * (T * gone) + rate[:n] * (T * T * later))
    return np.asarray(ways), float(speed[n])


def _interval(tau: float, T: float, omega: float, shaft: tuple[float, float, float]) -> tuple[float, float]:
    """Return the way and the last speed of one interval, with the instants of standstill and breaking away."""
    J, B, tau_c = shaft
    way, left = 0.0, T
    while left > 0.0:
        if omega == 0.0 and abs(tau) <= tau_c:
            break
        sign = math.copysign(1.0, omega if omega != 0.0 else tau)
        drive = tau - tau_c * sign
        stop = _stops_after(omega, drive, B, J)
        step = left if not 0.0 < stop < left else stop
        part, end = _coast(omega, drive, B, J, step)
        way += part
        omega = 0.0 if step == stop else end
        left -= step
    return way, omega


def _coast(omega: float, drive: float, B: float, J: float, t: float) -> tuple[float, float]:
    """Return way and final speed after a time of constant net torque."""
    decay = B * t / J
    if abs(decay) < SMALLEST_DECAY:
        return omega * t + 0.5 * drive / J * t * t, omega + drive / J * t
    final = drive / B
    gone = -math.expm1(-decay)
    return final * t + (omega - final) * gone * J / B, omega + (final - omega) * gone


def _stops_after(omega: float, drive: float, B: float, J: float) -> float:
    """Return when the speed comes to zero (s), infinity when it does not."""
    if omega * drive >= 0.0:
        return math.inf
    ratio = B * omega / drive  # negative where the torque opposes the motion
    if abs(ratio) < SMALLEST_DECAY:
        return -omega * J / drive
    return math.log1p(-ratio) * J / B if ratio < 1.0 else math.inf
