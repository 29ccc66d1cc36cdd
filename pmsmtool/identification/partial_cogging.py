# SPDX-License-Identifier: MIT
"""Cogging over a part of a turn, from slow moves there and back: for shafts that may not turn round.

In every pass torque of the current, acceleration and cogging balance, but for friction and what else changes slowly
over the way, which a polynomial takes. How much the shaft speeds up where the current does not says the inertia better
than a data sheet. All go through the same filter, three means over a row, so that the encoder's steps are averaged
before they are differentiated. Orders are regressed over all passes together, the largest first. Of two that differ by
less than a period over the way the larger one is taken, and what it leaves near it is in its interval; it has a
phase where its neighbours explain clearly less.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial.legendre import legvander

from pmsmtool.arrays import Array, Complex
from pmsmtool.axis.move import moving
from pmsmtool.estimators.angle_harmonics import HIGHEST_ORDER, ORDERS_MOST, SURE, AngleHarmonics, Harmonic
from pmsmtool.estimators.estimate import COVERAGE_FACTOR
from pmsmtool.identification.cogging import MODEL_SHARE, NEIGHBOURS, ORDERS_PER_POLE_PAIR, Cogging, Part
from pmsmtool.identification.move_mechanics import GAP_S
from pmsmtool.machine.parameters import Estimate
from pmsmtool.machine.torque import torque_per_ampere
from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace

STAGE, HOW = "cogging over a way", "slow moves both ways, over the angle that the drive shows"
PERIODS_LEAST = 2.5
"""Periods of an order within the way from which on it is looked for: fewer look like friction that changes slowly."""
PASS_DEGREE = 3
"""Of the polynomial of a pass over its time."""
ROWS_A_PERIOD = 6.0
"""Rows in a period of the highest order: the three means leave 0.87 of it, of the regressed waves as of the torque."""
ROWS_LEAST = 60
"""Of a pass: 10 periods of the highest order."""
EVEN = 0.1
"""Change of the demanded speed within which a pass is even."""
OF_LARGEST = 0.03
"""Least size of an order, of the largest one: the regression left 1.7 % of it at twice its order, seen once."""
SENSORS = (1, 2, 3)
"""Orders per pole pair that offsets and gains of current sensors hide, and are left out."""
FURTHER = 1.5
"""Inertia by the passes from the one that is given, of its doubt, up to which it is taken."""
STUDENT = 1.6
"""Of a deviation that four passes show: 3.18 over 1.96."""
SURELY = 2.0
"""Current of friction, of what passes of one direction differ by, from which on its sign counts."""
AGE_S = 4e-3
"""By which a drive may show its current later than its position (s): half of what `move --identify` looks for. In the
balance it looks like friction, so that it is not fitted: 2 to 4 ms found so made amplitudes 14 to 18 % too large."""
ALL_ROWS = slice(None)
SPEED_SAMPLES = 20
"""Samples over which the demand's speed is seen."""


@dataclass(frozen=True, slots=True, eq=False)
class Pass:
    """An even way: angles of all samples (rad), and by rows current (A) and acceleration (rad/s2), less what is slow.

    ``samples`` are those of a row, ``mean_a`` the mean current.
    """

    sense: float
    mean_a: float
    theta: Array
    samples: int
    current: Array
    acceleration: Array

    def wave(self, order: int) -> Array:
        """Return cosine and sine of an order by rows, less what is slow, shape (n, 2)."""
        rows = [_thrice(wave(order * self.theta), self.samples)[: len(self.current)] for wave in (np.cos, np.sin)]
        return _without_slow(np.stack(rows, axis=1))


def _mean(values: Array, n: int) -> Array:
    summed = np.concatenate([[0.0], np.cumsum(values)])
    return np.asarray((summed[n:] - summed[:-n]) / n)


def _thrice(values: Array, n: int) -> Array:
    """Return three means over rows, each in the middle of the second difference of the same row."""
    return _mean(_mean(_mean(values[1:], n), n), n)[::n]


def _second_difference(values: Array, n: int, period_s: float) -> Array:
    """Return the second derivative of the mean over a row, which is that of three means over rows."""
    mean = _mean(values, n)
    return np.asarray((mean[2 * n :] - 2.0 * mean[n:-n] + mean[: -2 * n])[::n] / (n * period_s) ** 2)


def _without_slow(rows: Array) -> Array:
    slow, _ = np.linalg.qr(legvander(np.linspace(-1.0, 1.0, len(rows)), PASS_DEGREE))
    return np.asarray(rows - slow @ (slow.T @ rows))


def passes_of(trace: Trace, highest: int, delay_s: float = 0.0) -> list[Pass]:
    """Return the even part of every move, with the current taken that much later.

    Parameters
    ----------
    trace : Trace
        As ``experiments.move.record_move`` leaves it.
    highest : int
        Highest order that is looked for.
    delay_s : float
        By which the drive shows its current later than its position (s).
    """
    t, demand = trace.t_s, trace["theta_ref_rad"]
    at = np.flatnonzero(moving(trace))
    breaks = np.flatnonzero(np.diff(t[at]) > GAP_S)
    found = []
    for first, last in zip((at[0], *at[breaks + 1]), (*at[breaks], at[-1]), strict=True) if at.size else ():
        period = float(np.median(np.diff(t[first : last + 1]))) if last > first else 0.0
        looks = np.arange(t[first], t[last], SPEED_SAMPLES * period) if period else np.empty(0)
        if len(looks) < 3:
            continue
        speed = np.diff(np.interp(looks, t, demand)) / (SPEED_SAMPLES * period)
        largest = float(np.quantile(np.abs(speed), 0.8))  # single looks are noisy where samples are asked for
        even = np.flatnonzero(np.abs(speed) > (1.0 - EVEN) * largest)
        times = np.arange(looks[even[0]], looks[even[-1] + 1], period)
        samples = max(1, int(math.tau / (ROWS_A_PERIOD * highest * largest * period)))
        if len(times) < (ROWS_LEAST + 3) * samples:
            continue
        theta = np.interp(times, t, trace["theta_m_rad"]) + float(trace.meta["start_rad"])
        current = _thrice(np.interp(times + delay_s, t, trace["i_q_a"]), samples)
        acceleration = _second_difference(theta, samples, period)
        rows = min(len(current), len(acceleration))
        parts = (_without_slow(values[:rows]) for values in (current, acceleration))
        found.append(Pass(math.copysign(1.0, float(speed[even[0]])), float(np.mean(current)), theta, samples, *parts))
    return found


def counts_against(passes: Sequence[Pass]) -> bool:
    """Whether the drive shows the current against the position: friction would push the shaft."""
    forth, back = ([one.mean_a for one in passes if one.sense == sense] for sense in (1.0, -1.0))
    return float(np.mean(forth) - np.mean(back)) < -SURELY * (float(np.ptp(forth)) + float(np.ptp(back)))


class Regression:
    """Torque of the passes (N m) over orders, by rows of all of them."""

    def __init__(self, passes: Sequence[Pass], per_a: float, J_kgm2: float, orders: Iterable[int]) -> None:
        self.senses = np.concatenate([np.full(len(one.current), one.sense) for one in passes])
        self.number = np.concatenate([np.full(len(one.current), k) for k, one in enumerate(passes)])
        self.acceleration = np.concatenate([one.acceleration for one in passes])
        self.J_kgm2, self.current_nm = J_kgm2, per_a * np.concatenate([one.current for one in passes])
        self.torque = J_kgm2 * self.acceleration - self.current_nm
        self.waves = {order: np.concatenate([one.wave(order) for one in passes]) for order in orders}

    def fitted(self, target: Array, orders: Sequence[int], rows: Array | slice = ALL_ROWS) -> tuple[Complex, Array]:
        """Return the phasors of orders, target = Re(phasor exp(-j order theta)), and what they leave."""
        if not orders:
            return np.empty(0, complex), target[rows]
        columns = np.concatenate([self.waves[order][rows] for order in orders], axis=1)
        found = np.linalg.lstsq(columns, target[rows], rcond=None)[0]
        return found[::2] + 1j * found[1::2], np.asarray(target[rows] - columns @ found)

    def left(self, orders: Sequence[int]) -> float:
        """Return the sum of squares that orders leave."""
        rest = self.fitted(self.torque, orders)[1]
        return float(rest @ rest)

    def seen(self, rest: Array) -> dict[int, float]:
        """Return the amplitude of every order alone in what is left."""
        return {order: float(abs(self.fitted(rest, [order])[0][0])) for order in self.waves}

    def chosen(self, besides: Sequence[int], apart: int) -> list[int]:
        """Return the orders that stand out, the largest first, each at least so far from the others."""
        chosen: list[int] = []
        largest = 0.0
        while len(chosen) < ORDERS_MOST:
            seen = self.seen(self.fitted(self.torque, [*besides, *chosen])[1])
            free = [n for n in seen if n not in besides and all(abs(n - m) >= apart for m in chosen)]
            if not free:
                break
            best = max(free, key=lambda n: seen[n])
            near = [n for n in range(best - apart + 1, best + apart) if n in free]
            best = min(near, key=lambda n: self.left([*besides, *chosen, n]))
            rest = self.fitted(self.torque, [*besides, *chosen, best])[1]
            largest = max(largest, seen[best])
            if seen[best] < max(SURE * noise_of(self.seen(rest), best), OF_LARGEST * largest):
                break
            chosen.append(best)
        return chosen

    def inertia(self, orders: Sequence[int]) -> tuple[float, float]:
        """Return by how much the inertia balances the current better than as given, and 95 % of it (kg m2).

        Noise of the acceleration makes it too small where that is the regressor, noise of the current too large where
        that is: the middle of both, with half of what lies between, and what the passes differ by.
        """
        found = []
        for k in range(int(self.number[-1]) + 1):
            rows = self.number == k
            left = [self.fitted(values, orders, rows)[1] for values in (self.current_nm, self.acceleration)]
            both = float(left[0] @ left[1])
            found.append((both / float(left[1] @ left[1]), float(left[0] @ left[0]) / both))
        least, most = np.mean(found, axis=0)
        spread = STUDENT * float(np.max(np.std(found, axis=0, ddof=1))) / math.sqrt(len(found))
        return 0.5 * float(least + most) - self.J_kgm2, 0.5 * abs(float(most - least)) + COVERAGE_FACTOR * spread

    def cogging(self, besides: Sequence[int], part: Part, shares: tuple[float, float], later: Regression) -> Cogging:
        """Return the orders that stand out, with their deviations; parameters as of :func:`partial_cogging`.

        ``later`` is the same with the current taken as late as it may be.
        """
        J_kgm2 = self.J_kgm2
        chosen = self.chosen(besides, part.apart)
        fitted = [*besides, *chosen]
        phasors, rest = self.fitted(self.torque, fitted)
        seen = self.seen(rest)
        ways = [self.fitted(self.torque, fitted, self.senses == sense)[0] for sense in (1.0, -1.0)]
        inertia = self.fitted(J_kgm2 * self.acceleration, fitted)[0]
        delayed = later.fitted(later.torque, fitted)[0] - phasors
        columns = np.concatenate([self.waves[n] for n in fitted], axis=1) if fitted else np.empty((len(rest), 0))
        inverse = np.diag(np.linalg.inv(columns.T @ columns))
        harmonics, ambiguous = [], []
        for n, k in sorted((n, fitted.index(n)) for n in chosen):
            torque = complex(phasors[k])
            noise = noise_of(seen, n)
            # what other orders within the way cost
            noise *= math.sqrt(float(np.max(inverse[2 * k : 2 * k + 2]) * np.mean(np.sum(self.waves[n] ** 2, axis=0))))
            beside = max((seen[m] for m in seen if m != n and abs(m - n) < part.apart), default=0.0)
            std = max(noise, 0.5 * abs(ways[0][k] - ways[1][k]) / math.sqrt(2.0), beside / math.sqrt(2.0))
            doubts = MODEL_SHARE * abs(torque), shares[1] * abs(inertia[k]), abs(delayed[k])
            std = math.hypot(std, *(doubt / COVERAGE_FACTOR for doubt in doubts))
            harmonics.append(Harmonic(n, torque.real / J_kgm2, torque.imag / J_kgm2, std / J_kgm2))
            others = [m for m in (n - 1, n + 1) if m in self.waves and m not in fitted]
            worse = min((self.left([*fitted[:k], m, *fitted[k + 1 :]]) for m in others), default=math.inf)
            if worse - self.left(fitted) < 0.5 * float(np.sum(self.waves[n] ** 2)) * (SURE * noise) ** 2:
                ambiguous.append(n)
        sizes = [J_kgm2 * h.amplitude for h in harmonics]
        floor = max(SURE * max(noise_of(seen, n) for n in seen), OF_LARGEST * max(sizes, default=0.0))
        J = Estimate(J_kgm2, 0.0, shares[0] * J_kgm2, "kg m2")  # the scale of all torques
        part = replace(part, ambiguous=tuple(ambiguous))
        return Cogging(AngleHarmonics((), tuple(harmonics)), J, max(self.waves), floor, HOW, part)


def noise_of(seen: dict[int, float], order: int) -> float:
    """Return the standard deviation of an order's parts by the amplitudes near it: their median is 1.18 of it."""
    near = [size for n, size in seen.items() if abs(n - order) <= NEIGHBOURS]
    return float(np.median(near)) / math.sqrt(2.0 * math.log(2.0))


def partial_cogging(
    trace: Trace, *, pole_pairs: int, psi_wb: float, J_kgm2: float, shares: tuple[float, float]
) -> Cogging:
    """Return the cogging over the way of slow moves.

    Raises IdentificationError: ``E_EXCITATION``: too few even rows in either direction.

    Parameters
    ----------
    trace : Trace
        ``theta_m_rad`` and ``theta_ref_rad`` (from ``meta["start_rad"]``), ``i_q_a``.
    pole_pairs : int
        Of the machine.
    psi_wb, J_kgm2 : float
        Flux linkage (Wb) and inertia (kg m2): torque of current and acceleration.
    shares : (float, float)
        What the torque of the current, and the inertia, may be off, relative (95 %).
    """
    highest = min(HIGHEST_ORDER, ORDERS_PER_POLE_PAIR * pole_pairs)
    passes = passes_of(trace, highest)
    if {one.sense for one in passes} != {1.0, -1.0}:
        raise refuse(
            "E_EXCITATION",
            f"{len(passes)} moves have {ROWS_LEAST} rows of an even speed, one each way is needed",
            stage=STAGE,
            likely="a short way, or one that is all ramp",
            hint="move further (--by)",
        )
    start = min(float(np.min(one.theta)) for one in passes)
    way = max(float(np.max(one.theta)) for one in passes) - start
    turns = min(float(np.ptp(one.theta)) for one in passes) / math.tau
    lowest = math.ceil(PERIODS_LEAST / turns)
    orders = range(lowest, highest + 1)
    besides = [k * pole_pairs for k in SENSORS if k * pole_pairs in orders]
    per_a, apart = torque_per_ampere(pole_pairs, psi_wb), math.ceil(1.0 / turns)
    per_a = -per_a if counts_against(passes) else per_a
    fit = Regression(passes, per_a, J_kgm2, orders)
    chosen = [*besides, *fit.chosen(besides, apart)]
    more, half = fit.inertia(chosen)
    left_nm = math.sqrt(fit.left(chosen) / len(fit.torque))
    part = Part(start, way, lowest, apart, left_nm=left_nm, J_least_kgm2=J_kgm2 + more - half)
    if half < shares[1] * J_kgm2 and abs(more) < FURTHER * shares[1] * J_kgm2:  # better known than in the file
        J_kgm2 += more
        shares = shares[0], half / J_kgm2
        fit = Regression(passes, per_a, J_kgm2, orders)
    later = Regression(passes_of(trace, highest, AGE_S), per_a, J_kgm2, orders)
    return fit.cogging(besides, part, shares, later)
