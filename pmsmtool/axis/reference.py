# SPDX-License-Identifier: MIT
"""The move that an axis follows: speed, acceleration and jerk limited, point to point.

With jerk j and acceleration a the torque rises over t_j = a / j. A load behind an elastic shaft is at rest again after
each of these ramps when t_j is a whole number of its own periods 1 / f_a: the acceleration is then a rectangle averaged
over one period of the swing (N. C. Singer, W. P. Seering, J. Dyn. Sys. Meas. Control 112 (1990) 76).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.errors import ConfigError

STARTS = (0.02, 0.1, 0.25, 0.45)
"""Time of a ramp over that of the whole move, from which the fit of a trapezoid begins."""
WITHIN = 0.02
"""Shares of the way from its ends between which a demand is seen to change: noise at rest stays outside."""
BOUNDS = (0.3, 0.0, -np.inf), (1.5, 1.0, np.inf)
SCALES = (0.1, 0.01, 0.01)
"""Even time, ramp and middle of a move over the time in which the demand is seen to change, and their typical sizes."""


@dataclass(frozen=True, slots=True)
class Profile:
    """Limits of a move: speed (rad/s), acceleration (rad/s2), jerk (rad/s3; infinity: none)."""

    speed: float
    acceleration: float
    jerk: float = math.inf

    def __post_init__(self) -> None:
        wrong = [name for name in ("speed", "acceleration", "jerk") if not getattr(self, name) > 0.0]
        if wrong:
            raise ConfigError(
                "a move needs positive limits", where="profile", hint="give a positive number", violations=wrong
            )


@dataclass(frozen=True, slots=True)
class Move:
    """One move from rest to rest.

    Attributes
    ----------
    distance : float
        Angle (rad), signed.
    t_jerk, t_acceleration, t_speed : float
        Times (s): of one ramp of the acceleration, from the first ramp's begin to the second's, and from the begin of
        the acceleration to that of the braking.
    """

    distance: float
    t_jerk: float
    t_acceleration: float
    t_speed: float

    @property
    def duration_s(self) -> float:
        """Time of the whole move (s)."""
        return self.t_jerk + self.t_acceleration + self.t_speed

    @property
    def peak_speed(self) -> float:
        """Largest speed (rad/s)."""
        return abs(self.distance) / self.t_speed if self.t_speed else 0.0

    def at(self, t_s: Array) -> tuple[Array, Array, Array]:
        """Return angle (rad), speed and acceleration at times from the begin of the move (s)."""
        if not self.distance:
            zero = np.zeros_like(np.asarray(t_s, dtype=np.float64))
            return zero, zero, zero
        # a step, averaged over t_speed, t_acceleration and t_jerk: every derivative is a signed sum of shifted powers
        signs, shifts = [1.0], [0.0]
        scale = self.distance
        for width in (self.t_speed, self.t_acceleration, self.t_jerk):
            if width > 0.0:
                signs, shifts = signs + [-s for s in signs], shifts + [at + width for at in shifts]
                scale /= width
        order = len(signs).bit_length() - 1
        age = np.maximum(np.asarray(t_s, dtype=np.float64)[:, None] - np.array(shifts), 0.0)

        def derivative(n: int) -> Array:
            power = order - n
            if power < 0:
                return np.zeros(age.shape[0])
            shape = (age > 0.0) * 1.0 if power == 0 else age**power / math.factorial(power)
            return np.asarray(scale * (shape @ np.array(signs)), dtype=np.float64)

        angle = np.where(np.asarray(t_s) >= self.duration_s, self.distance, derivative(0))
        return angle, derivative(1), derivative(2)


def plan(distance: float, profile: Profile) -> Move:
    """Return the fastest move within limits.

    The three times of a move limited in jerk, acceleration and speed: L = v t_v, v = a t_a, a = j t_j with
    t_j <= t_a <= t_v; a limit that a short move does not reach is not used up.
    """
    length = abs(distance)
    if not length:
        return Move(0.0, 0.0, 0.0, 0.0)
    v, a, j = profile.speed, profile.acceleration, profile.jerk
    # without reaching a limit: t_v >= t_a >= t_j, each the least that the limits and the order allow
    t_j = min(a / j, math.sqrt(v / j), (length / (2.0 * j)) ** (1.0 / 3.0) if math.isfinite(j) else 0.0)
    a = min(a, j * t_j) if t_j else a
    # v = a t_a, length = v (t_a + t_j) at least
    t_a = min(v / a, 0.5 * (-t_j + math.sqrt(t_j * t_j + 4.0 * length / a)))
    v = a * t_a
    t_v = length / v
    return Move(distance, t_j, t_a, t_v)


def jerk_limited(speed: float, acceleration: float, ramp_s: float) -> Profile:
    """Return the profile whose acceleration rises within a time (s)."""
    return Profile(speed, acceleration, acceleration / ramp_s if ramp_s else math.inf)


def trapezoid_of(t_s: Array, demand: Array) -> tuple[float, float]:
    """Return speed (rad/s) and time of a ramp (s) of a move, by least squares; ramps of equal length.

    Parameters
    ----------
    t_s, demand : ndarray
        Times (s) and demands (rad), shape (n,), from before the move until after it; the demand must change.
    """
    from scipy.optimize import least_squares  # half a second that only a drive without units of its profile takes

    first, last = float(demand[0]), float(demand[-1])
    share = (np.asarray(demand, dtype=np.float64) - first) / (last - first)
    moves = np.flatnonzero((share > WITHIN) & (share < 1.0 - WITHIN))
    seen = max(float(t_s[moves[-1]] - t_s[moves[0]]) if moves.size else 0.0, float(np.min(np.diff(t_s))))

    def off(x: Array) -> Array:
        even, ramp, middle = x * seen  # the way at full speed would take ``even``
        ramp = min(ramp, even)
        age = np.abs(t_s - middle)  # a move is symmetric
        left = np.maximum(0.5 * (even + ramp) - age, 0.0)
        way = np.where(left < ramp, 0.5 * left**2 / max(ramp, 1e-12), left - 0.5 * ramp) / even
        return np.asarray(np.where(t_s < middle, way, 1.0 - way) - share)

    middle = float(np.interp(0.5, share, t_s)) / seen
    fits = [least_squares(off, (1.0 - ramp, ramp, middle), bounds=BOUNDS, x_scale=SCALES) for ramp in STARTS]
    even, ramp, _ = min(fits, key=lambda fit: float(fit.cost)).x * seen
    return abs(last - first) / float(even), float(min(ramp, even))


def mirrored(t_s: Array, demand: Array) -> tuple[Array, Array]:
    """Return times and demands of a move that brakes as it speeds up: its way to the fastest place, there and back.

    Parameters
    ----------
    t_s, demand : ndarray
        As of :func:`trapezoid_of`.
    """
    middle = 0.5 * (float(demand[0]) + float(demand[-1]))
    half = int(np.argmin(np.abs(demand - middle)))
    t, angle = t_s[: half + 1], demand[: half + 1]
    return np.append(t, 2.0 * t[-1] - t[-2::-1]), np.append(angle, 2.0 * angle[-1] - angle[-2::-1])
