# SPDX-License-Identifier: MIT
"""The move that an axis follows, limited in speed, acceleration and jerk, and what its record says.

With jerk j and acceleration a the torque rises over t_j = a / j. A load behind an elastic shaft is at rest again after
each of these ramps when t_j is a whole number of its own periods 1 / f_a: the acceleration is then a rectangle averaged
over one period of the swing (N. C. Singer, W. P. Seering, J. Dyn. Sys. Meas. Control 112 (1990) 76).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.errors import ConfigError, IdentificationError
from pmsmtool.trace import Trace

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

    def slower(self, share: float) -> Profile:
        """Return a share of every limit: ramps of the acceleration take the same time."""
        return Profile(share * self.speed, share * self.acceleration, share * self.jerk)


ENDED = 0.5
"""Following error at which a move is ended, of its way."""
KEPT_FROM_IT = 0.9
"""Largest predicted following error of a move, of the one that ends it."""
SLOWEST, STEP = 0.02, 0.95
"""Least share of the limits that is tried for that; every further one is at most this share of the last."""


def followed(
    way_rad: float, profile: Profile, error_rad: Callable[[Profile], float], slowest: float = SLOWEST
) -> Profile | None:
    """Return limits of a move, so slow that its following error does not end it; None where none are slow enough.

    ``error_rad`` says the predicted following error (rad) with some limits; ``slowest``: least share that is tried.
    """
    share, most = 1.0, KEPT_FROM_IT * ENDED * abs(way_rad)
    while share > slowest:
        slower = profile if share == 1.0 else profile.slower(share)
        error = error_rad(slower)
        if error <= most:
            return slower
        share *= min(most / error, STEP) if math.isfinite(error) else 0.0
    return None


@dataclass(frozen=True, slots=True)
class Move:
    """One move from rest to rest."""

    distance: float
    """Angle (rad), signed."""
    t_jerk: float
    t_acceleration: float
    t_speed: float
    """Times (s): of one ramp of the acceleration, from the first ramp's begin to the second's, and from the begin of
    the acceleration to that of the braking."""

    @property
    def duration_s(self) -> float:
        """Time of the whole move (s)."""
        return self.t_jerk + self.t_acceleration + self.t_speed

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


WINDOW = 0.01
"""Window in which the error of a move has settled, of its way."""
RESTING, NEAR, NOISES = 1e-4, 0.01, 3.0
"""Distance from an end of the move within which a demand rests, and within which its noise is looked for, of the way;
and how much of that noise (its upper quartile) still counts as rest."""
SAMPLES = 5
"""Of which the middle one counts: one that is far off ends no rest."""
LEAST_SAMPLES = 50
INSIDE = 20
"""Last samples of a rest that are inside where an error has settled."""
SAME_WAY = 0.01
"""Ways of two moves that are the same (relative)."""
SAME_SPEED = 0.1
"""Mean speeds of their demands that are the same (relative): samples over a bus are some milliseconds apart."""


@dataclass(frozen=True, slots=True)
class MoveResult:
    """One move there and back."""

    way_rad: float
    """Angle of the move (rad)."""
    error_peak_rad: float
    error_rms_rad: float
    """Largest following error, and its root mean square while the demand moves (rad)."""
    settling_s: float
    """Longest time from the end of a demand until the error stays inside 1 % of the way (s); infinity where it does
    not within the record."""
    error_end_rad: float
    """Largest error left at the end of the record or of a rest (rad)."""
    current_peak_a: float
    current_rms_a: float
    """Of the current while the demand moves, without what flowed at rest before (A)."""
    moving_s: float
    """Time in which the demand moved (s)."""
    samples: int
    """Rows."""


UNITS = {
    "way_rad": "rad", "error_peak_rad": "rad", "error_rms_rad": "rad", "settling_s": "s", "error_end_rad": "rad",
    "current_peak_a": "A", "current_rms_a": "A", "moving_s": "s", "samples": "1",
}  # fmt: skip


def shown(value: float, unit: str) -> str:
    """Return a number of a move as people read it."""
    if math.isinf(value):
        return "not within the record"
    factor, told = {"rad": (math.degrees(1.0), "deg"), "s": (1e3, "ms"), "1": (1.0, "")}.get(unit, (1.0, unit))
    return f"{factor * value:.4g} {told}".strip()


def moving(trace: Trace) -> NDArray[np.bool_]:
    """Return where the demand of moves there and back is at neither end of them, shape (n,).

    A demand that is the sum of position and following error is noisy at rest: a shaft that still swings was seen at
    another instant than its error.
    """
    from scipy.ndimage import median_filter  # only after a move

    demand, way = trace["theta_ref_rad"], float(trace.meta["way_rad"])
    off = np.min(np.abs(demand - demand[0] - np.array([[0.0], [way]])), axis=0)
    off = median_filter(off, SAMPLES, mode="nearest")
    noise = float(np.quantile(off[off < NEAR * abs(way)], 0.75))
    return np.asarray(off > max(RESTING * abs(way), NOISES * noise), dtype=np.bool_)


def move_result(trace: Trace) -> MoveResult:
    """Return what a move says. Raises IdentificationError: too few samples, or the demand did not move.

    Parameters
    ----------
    trace : Trace
        As ``experiments.move.record_move`` leaves it.
    """
    way = abs(float(trace.meta["way_rad"]))
    t, error = trace.t_s, trace["theta_ref_rad"] - trace["theta_m_rad"]
    moves = moving(trace)
    if t.size < LEAST_SAMPLES or not moves.any():
        raise IdentificationError(
            "E_EXCITATION", f"{t.size} samples, in {int(moves.sum())} of which the demand moved",
            likely="the bus is busy, or the drive did not take the set-point",
            hint="leave the bus to this program, then run the command again",
        )  # fmt: skip
    first = int(np.argmax(moves))
    rest = float(np.median(trace["i_q_a"][:first])) if first else 0.0
    current = trace["i_q_a"][moves] - rest
    stops = np.flatnonzero(moves[:-1] & ~moves[1:]) + 1
    ends = [int(k) for k in stops if not moves[k : k + LEAST_SAMPLES].any()]
    spans = [(k, next((int(m) for m in np.flatnonzero(moves[k:]) + k), t.size)) for k in ends]
    return MoveResult(
        way_rad=way,
        error_peak_rad=float(np.max(np.abs(error[first:]))),
        error_rms_rad=float(np.sqrt(np.mean(error[moves] ** 2))),
        settling_s=max((_settled(t[k:m], error[k:m], WINDOW * way) for k, m in spans), default=0.0),
        error_end_rad=max((float(np.mean(np.abs(error[max(k, m - 20) : m]))) for k, m in spans), default=0.0),
        current_peak_a=float(np.max(np.abs(current))),
        current_rms_a=float(np.sqrt(np.mean(current**2))),
        moving_s=float(np.sum(np.diff(t, append=t[-1:])[moves])),
        samples=int(t.size),
    )


def _settled(t: Array, error: Array, window: float) -> float:
    outside = np.flatnonzero(np.abs(error) > window)
    if outside.size and outside[-1] + INSIDE > error.size:
        return math.inf
    return float(t[outside[-1]] - t[0]) if outside.size else 0.0


@dataclass(frozen=True, slots=True)
class MoveDifference:
    """One number of two moves; ``ratio`` is second over first, NaN where the first is 0 or both have no end."""

    name: str
    unit: str
    first: float
    second: float

    @property
    def ratio(self) -> float:
        """Second over first."""
        return self.second / self.first if self.first else float("nan")

    @property
    def shown_ratio(self) -> str:
        """The ratio as people read it."""
        return f"{self.ratio:.3g}" if math.isfinite(self.ratio) and math.isfinite(self.first) else "-"


Rows = Iterable[Mapping[str, Any]]
"""``name``, ``value`` and ``unit`` of what the record of a move keeps."""


def compared_moves(first: MoveResult, second: MoveResult, kept: Sequence[Rows] = ((), ())) -> list[MoveDifference]:
    """Return two moves number by number, then the gains that both drives held, as their records keep them."""
    moves = [
        MoveDifference(name, unit, float(getattr(first, name)), float(getattr(second, name)))
        for name, unit in UNITS.items()
    ]
    before, after = ({str(row["name"]): row for row in rows} for rows in kept)
    return moves + [
        MoveDifference(name, str(row["unit"]), float(before[name]["value"]), float(row["value"]))
        for name, row in after.items()
        if name in before and name not in UNITS
    ]


def same_move(first: Trace, second: Trace) -> bool:
    """Whether two records are of moves by one way at one speed, however often they went."""
    (way, speed), (other_way, other_speed) = (demanded(trace) for trace in (first, second))
    return abs(other_way - way) <= SAME_WAY * way and abs(other_speed - speed) <= SAME_SPEED * speed


def demanded(trace: Trace) -> tuple[float, float]:
    """Return the way (rad) and the mean speed (rad/s) of the demand while it moves."""
    found = move_result(trace)
    return found.way_rad, float(np.abs(np.diff(trace["theta_ref_rad"])).sum()) / found.moving_s
