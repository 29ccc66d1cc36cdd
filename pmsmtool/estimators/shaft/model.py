# SPDX-License-Identifier: MIT
"""Whitened residual of the positions of pushes and coasting: the model behind estimate and prediction.

The motion under viscous and Coulomb friction is in closed form where the torque is constant over intervals.
Sigma = s_theta^2 I + s_T^2 G G', G_kj = (k - j - 1/2) T^2/J for j < k (docs/identification.md, 3.5).
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.estimators.angle_harmonics import ENCODER_ORDERS, HIGHEST_ORDER, ORDERS_MOST, SURE
from pmsmtool.estimators.estimate import CHI2_WARN
from pmsmtool.estimators.least_squares import Fit
from pmsmtool.estimators.shaft.disturbances import NONE, Disturbances, waves_of

SHAFT = 3
"""Parameters of the shaft without drag: ln J, B, tau_c."""

SERIES_BELOW = 1e-3
"""B T/J of an interval below which the way is a series; its next term is 1e-15."""
DECAY_MOST = 50.0
"""Largest B T/J that is summed up at once."""
LARGEST_LN_J = 700.0
"""Above, the exponential function may overflow."""
SMALLEST_DECAY = 1e-9
"""B T/J below which an interval is a parabola."""


COASTING_FLOOR = 1e-4
"""Deviation of a block's torque in a coasting, of the push's, from where it grows."""
GROWTH_MOST = 2.5
"""Largest growth of the torque's noise from one fit to the next: a fit that has not arrived asks for too much."""
SLOW_LEAST = 6
"""Least slow modes of a trace's residual that are looked at; its first position and speed take two of them."""
SLOW_PART = 8
"""Modes of a residual for each slow one: friction and inertia move the first 10 of 250, a swing more of them."""
SLOW_SURE = 5.0
"""Standard deviations of a mean square from which on slow modes hold more than noise."""
STEEPEST = 1.5
"""Largest angle of an order over a block (rad): a cogging that is finer goes through half a period within one."""


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """A trace in blocks: positions (n + 1,), mean torques (n,), period; deviations of positions (n + 1,) and torque.

    ``square`` is that of the speed in every block, with its sign (rad2/s2), shape (n,).
    """

    theta: Array
    torque: Array
    T: float
    theta_std: Array
    torque_std: float
    coasting: bool
    disturbances: Disturbances = NONE
    square: Array = field(init=False)

    def __post_init__(self) -> None:
        speed = np.diff(self.theta) / self.T
        object.__setattr__(self, "square", speed * np.abs(speed))


def fastest(runs: Sequence[Run]) -> float:
    """Largest speed of the traces (rad/s)."""
    return max(float(np.max(np.abs(np.diff(run.theta)))) / run.T for run in runs)


def largest_torque(runs: Sequence[Run]) -> float:
    """Largest torque of a block (N m)."""
    return max(float(np.max(np.abs(run.torque))) for run in runs)


def sizes_of(runs: Sequence[Run], *, drag: bool = False) -> Array:
    """Typical sizes of the parameters of :class:`Problem`, shape (k,)."""
    speed, largest = fastest(runs), largest_torque(runs)
    common = (1.0, largest / speed, largest, largest / speed**2)[: SHAFT + drag]
    disturbed = (1.0,) * runs[0].disturbances.torque.shape[1]
    return np.array([*common, *disturbed, *(value for _ in runs for value in (1.0, speed))])


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Whitened residual of all traces; a trace knows the common parameters and its own two.

    Common are ln J, B and tau_c, with ``drag`` a torque against the square of the speed, which the positions show well
    enough, and the sizes of the disturbances, each with a row of its own: its size is 0 with a deviation of 1.
    """

    runs: Sequence[Run]
    factors: Sequence[Array]
    step: Array
    drag: bool = False

    @property
    def sizes(self) -> slice:
        """Where the sizes of the disturbances are among the parameters."""
        return slice(SHAFT + self.drag, self.shared)

    @property
    def shared(self) -> int:
        """Parameters before the traces' own."""
        return SHAFT + int(self.drag) + int(self.runs[0].disturbances.torque.shape[1])

    def _off(self, k: int, x: Array) -> Array:
        """Residual of one trace's positions (rad), of rows of parameters; NaN where no motion follows."""
        run, first = self.runs[k], self.shared + 2 * k
        torque = run.torque - x[:, SHAFT : SHAFT + 1] * run.square if self.drag else run.torque
        shown = run.theta
        if self.shared > self.sizes.start:
            sizes = list(x[:, self.sizes])
            torque = torque + [run.disturbances.torque @ row for row in sizes]
            shown = shown - [run.disturbances.position @ row for row in sizes]
        own = x[:, [*range(SHAFT), first, first + 1]]
        return _positions_of(np.broadcast_to(torque, (len(x), len(run.torque))), run.T, own) - shown

    def residual(self, x: Array) -> Array:
        """Whitened residual of the traces, one after the other, and of the disturbances, shape (n,)."""
        off = (self._off(k, x[np.newaxis])[0] for k in range(len(self.runs)))
        return np.concatenate([*(factor @ one for factor, one in zip(self.factors, off, strict=True)), x[self.sizes]])

    def jacobian(self, x: Array) -> Array:
        """Its derivative, shape (n, k); one-sided for the disturbances, which hardly bend it."""
        blocks = []
        for k, run in enumerate(self.runs):
            block = np.zeros((len(run.theta), self.shared + 2))  # of the traces' own parameters only its own move it
            first, own = self.sizes.start, [*range(self.shared), self.shared + 2 * k, self.shared + 2 * k + 1]
            if self.shared > first:
                block[:, self.sizes] = run.disturbances.position
            block[:, self.shared] = 1.0  # the first position
            turning = first + np.flatnonzero(np.any(run.disturbances.torque, axis=0))
            moved = np.array([*turning, *range(first), self.shared + 2 * k + 1])
            plus, minus = np.tile(x, (2, len(moved), 1))
            at, same = (np.arange(len(moved)), moved), max(0, len(turning) - 1)
            plus[at] += self.step[moved]
            minus[at] -= self.step[moved]
            minus[: len(turning)] = x  # one of these rows serves all
            off = self._off(k, np.concatenate([plus, minus[same:]]))
            change = off[: len(moved)] - off[np.maximum(at[0] - same, 0) + len(moved)]
            block[:, [*moved[:-1], self.shared + 1]] = (change / (plus[at] - minus[at])[:, np.newaxis]).T
            blocks.append(np.zeros((len(run.theta), len(x))))
            blocks[k][:, own] = self.factors[k] @ block  # one product of matrices, not one per column and side
        return np.concatenate([*blocks, np.eye(len(x))[self.sizes]])


def whitener(run: Run, J: float) -> Array:
    """Return the inverse of the Cholesky factor of the position residual's covariance."""
    from scipy.linalg.lapack import dtrtri  # a third of the time of numpy's inverse

    if run.torque_std == 0.0:
        return np.diag(1.0 / run.theta_std)
    covariance = (run.torque_std * run.T**2 / J) ** 2 * _spread(len(run.theta))
    covariance[np.diag_indices(len(run.theta))] += run.theta_std**2
    return np.asarray(dtrtri(np.linalg.cholesky(covariance), lower=1)[0])


def _ways(run: Run, J: float) -> Array:
    """Return the ways that a torque in each interval has made at each position (rad/(N m)), without friction."""
    return _lags(len(run.theta)) * (run.T**2 / J)


def _lags(n: int) -> Array:
    """Return n positions' distances behind the middle of each interval before them, in intervals."""
    return np.asarray(np.maximum(np.arange(n)[:, None] - np.arange(n - 1)[None, :] - 0.5, 0.0))


@lru_cache(maxsize=16)
def _spread(n: int) -> Array:
    """Return G G' over (T^2/J)^2: every fit of a trace asks for it, and only its factor changes."""
    lags = _lags(n)
    spread = np.asarray(lags @ lags.T)
    spread.setflags(write=False)
    return spread


def torque_noise(runs: Sequence[Run]) -> dict[bool, float]:
    """Deviation of a block's torque in pushes (False) and coasting (True), of the push's torque."""
    largest = largest_torque(runs)
    return {
        kind: max((run.torque_std for run in runs if run.coasting is kind), default=0.0) / largest
        for kind in (False, True)
    }


def noisier(runs: Sequence[Run], residual: Array, *, slow: bool = False) -> Sequence[Run]:
    """Return the runs with as much more noise of the torque as the residual asks for; the same where it agrees.

    Every push by itself, one through standstill asks for more than one from rest; coasting together. ``slow``: as much
    as its slow modes ask for, of a fit whose noise agrees as a whole.
    """
    ends = np.cumsum([len(run.theta) for run in runs])
    parts = np.split(residual[: ends[-1]], ends[:-1])
    coasting = [part for part, run in zip(parts, runs, strict=True) if run.coasting]
    own = [coasting if run.coasting else [part] for part, run in zip(parts, runs, strict=True)]
    more = [math.sqrt(_slow_excess(part)) if slow else min(math.sqrt(_excess(part)), GROWTH_MOST) for part in own]
    if max(more) == 1.0:
        return runs
    floor = COASTING_FLOOR * largest_torque(runs)
    return [
        run if factor == 1.0 else replace(run, torque_std=factor * max(run.torque_std, floor))
        for run, factor in zip(runs, more, strict=True)
    ]


def _excess(parts: Sequence[Array]) -> float:
    """Return the mean square of whitened residuals; 1 where it is no more than noise."""
    whole = float(np.mean(np.concatenate(parts) ** 2))
    return whole if whole > CHI2_WARN else 1.0


def _slow_excess(parts: Sequence[Array]) -> float:
    """Return the mean square of their slow modes; 1 where it is no more than noise.

    What is slow moves friction and inertia, and hides in the mean of all: over the cogging of a light shaft that was
    1.2, of 12 modes 10, and B was 5 times too large at +-199 %.
    """
    from scipy.fft import dct

    count = min(map(len, parts)) // SLOW_PART
    power = np.mean([np.asarray(dct(part, norm="ortho"))[:count] ** 2 for part in parts], axis=0)
    modes = np.arange(SLOW_LEAST, count + 1)
    means = np.cumsum(power)[SLOW_LEAST - 1 :] / modes
    return float(max([1.0, *means[means > 1.0 + SLOW_SURE * np.sqrt(2.0 / (len(parts) * modes))]]))


def cogging_orders(runs: Sequence[Run], fit: Fit) -> list[int]:
    """Return orders per turn of a torque over the angle that stand out of a fit's residual, the largest first.

    Beside what the fit's own parameters take, one order after the other (as ``estimators/angle_harmonics``, which
    needs a turn of coasting and sees no push); linear about the fit.

    Parameters
    ----------
    runs : sequence of Run
        With the torque's noise of the fit.
    fit : Fit
        Of a :class:`Problem` of them.
    """
    steepest = max(float(np.max(np.abs(np.diff(run.theta)))) for run in runs)
    orders = np.arange(max(ENCODER_ORDERS) + 1, min(HIGHEST_ORDER, int(STEEPEST / steepest)) + 1)
    if not len(orders):
        return []
    J = math.exp(float(fit.x[0]))
    shown = [whitener(run, J) @ np.dot(_ways(run, J), waves_of(run.theta, orders.tolist())) for run in runs]
    columns = np.concatenate([*shown, np.zeros((len(fit.residual) - sum(map(len, shown)), 2 * len(orders)))])
    taken, rest, chosen = np.linalg.qr(fit.jacobian)[0], fit.residual, list[int]()
    while len(chosen) < min(ORDERS_MOST, len(orders)):
        columns, rest = columns - taken @ (taken.T @ columns), rest - taken @ (taken.T @ rest)
        pairs = columns.reshape(len(rest), -1, 2)
        power = [float(np.sum((np.linalg.qr(pairs[:, k])[0].T @ rest) ** 2)) for k in range(len(orders))]
        best = int(np.argmax(power))
        if not power[best] > SURE**2:
            break
        chosen.append(int(orders[best]))
        taken = np.linalg.qr(pairs[:, best])[0]
        orders, columns = np.delete(orders, best), np.delete(columns, (2 * best, 2 * best + 1), axis=1)
    return chosen


def positions(torque: Array, T: float, x: Array) -> Array:
    """Return the positions (rad) at the ends of intervals of constant torque, shape (n + 1,).

    Raises OverflowError: the speed would grow or decay within a fiftieth of an interval: a step of a fit that leads
    nowhere.

    Parameters
    ----------
    torque : ndarray, shape (n,)
        Mean torque of each interval (N m).
    T : float
        Length of an interval (s).
    x : ndarray, shape (5,)
        ln J, B, tau_c, first position and first speed.
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


def _positions_of(torque: Array, T: float, x: Array) -> Array:
    """Return :func:`positions` of rows of torques and parameters, NaN where they overflow, shape (k, n + 1).

    All that turn one way throughout at once.
    """
    out = np.full((len(x), torque.shape[1] + 1), np.nan)
    alone = np.ones(len(x), dtype=bool)
    if len(x) > 1:
        J = np.array([math.exp(ln_J) if ln_J < LARGEST_LN_J else math.inf for ln_J in x[:, 0].tolist()])
        decay, omega = x[:, 1] * T / J, x[:, 4]
        rows = np.flatnonzero(np.isfinite(J) & (omega != 0.0) & (np.abs(decay) * torque.shape[1] <= DECAY_MOST))
        means = np.array([_means(part) for part in decay[rows].tolist()]).reshape(-1, 2)
        of_rows = (omega[rows], J[rows], x[rows, 2], decay[rows], means[:, 0], means[:, 1])
        speed, ways = _one_way(torque[rows], T, *(column[:, np.newaxis] for column in of_rows))
        out[rows, 0], out[rows, 1:] = x[rows, 3], x[rows, 3:4] + ways
        alone[rows] = np.any(speed[:, 1:] * np.copysign(1.0, speed[:, :1]) <= 0.0, axis=1)
    for k in np.flatnonzero(alone):
        out[k] = np.nan
        with contextlib.suppress(OverflowError):
            out[k] = positions(torque[k], T, x[k])
    return out


def _turning(torque: Array, T: float, omega: float, shaft: tuple[float, float, float]) -> tuple[Array, float]:
    """Return ways (rad) to the ends of the intervals before the speed changes its sign, and the speed after them.

    Within an interval it is monotone, so that its ends tell.
    """
    J, B, tau_c = shaft
    sign, x = math.copysign(1.0, omega), B * T / J
    n = len(torque) if abs(x) * len(torque) <= DECAY_MOST else max(1, int(DECAY_MOST / abs(x)))
    speed, ways = _one_way(torque[:n], T, omega, J, tau_c, x, *_means(x))
    turned = np.flatnonzero(speed[1:] * sign <= 0.0)
    n = int(turned[0]) if len(turned) else n
    return ways[:n], float(speed[n])


def _means(x: float) -> tuple[float, float]:
    """Return what an interval with a decay of B T/J = x leaves on average: of the first speed, and of the torque."""
    gone = 1.0 if x == 0.0 else -math.expm1(-x) / x
    later = 0.5 - x / 6.0 + x * x / 24.0 - x**3 / 120.0 if abs(x) < SERIES_BELOW else (1.0 - gone) / x
    return gone, later


def _one_way(
    torque: Array, T: float, omega: Any, J: Any, tau_c: Any, x: Any, gone: Any, later: Any
) -> tuple[Array, Array]:
    """Return speeds and ways at the ends of intervals while friction has the sign of the first speed.

    Along the last axis; the others are numbers, or columns beside rows of torques.
    """
    rate = (torque - tau_c * np.copysign(1.0, omega)) / J
    grown = np.exp(x * np.arange(1.0, torque.shape[-1] + 1.0))
    speed = np.empty((*torque.shape[:-1], torque.shape[-1] + 1))
    speed[..., :1] = omega
    speed[..., 1:] = (omega + np.cumsum(rate * (T * gone) * grown, axis=-1)) / grown
    return speed, np.cumsum(speed[..., :-1] * (T * gone) + rate * (T * T * later), axis=-1)


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
