# SPDX-License-Identifier: MIT
"""When the currents are sampled: what a late instant and a slow sensor make of the ripple, and how u_d shows it.

In the middle of the zero vector a current passes its mean. A sample that is late by d, or a sensor with the time
constant tau, holds a piece of the ripple, some -w psi (d - tau)/L_q on q of a machine that turns. The controller takes
it for current: at a sampled i_q = 0 the machine carries the opposite one, R and the inverter's error follow that, and

    u_d = -w L_q (i_q - ripple(d, tau) + ripple_0) - R i_par + ...

shows it, in proportion to w^2: ripple_0 is what the sample of the period's start would hold, and i_par the course of
i_d within a period, over which the voltage stands and the rotor turns by w T_s: w^2 psi/(2 L_d) ((t - T_s/2)^2 -
T_s^2/12), T_s^2/6 of it at the start. An encoder angle that is old shows the same as a late sample; its tolerance is
declared.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.estimators.inverter_error import LEG_ANGLES, Modulation, duties, phases_of

ANGLES = 12
"""Angles over which the ripple is averaged: a sixth of a turn, after which three equal phases repeat."""
HIGH_LEVEL, LOW_LEVEL = 0.8, 0.6
"""d currents that count here, of the largest: beside the ripple's own size the error of a small one is not odd."""
RIPPLES = 6.5
"""A d current of so many amplitudes of the ripple counts from the lower of the two on, and there is less noise."""
FLOOR_PERIODS, FLOOR_OF_DEAD_TIME = 0.0008, 0.06
"""Standard deviation of the shown instant beside its noise: in periods, and of the dead time; see
:func:`shown_instant`."""
LATEST, RISE = 0.12, 0.7
"""Instant past which the prediction keeps rising (T_s), and its least slope there: with less, four of 400 drives whose
samples are 0.06 to 0.09 T_s late came to rest at 0.24."""
INSTANTS = tuple(float(x) for x in np.linspace(-0.06, 0.24, 11))
LAGS = (0.0, 0.02, 0.05, 0.08, 0.12, 0.17, 0.23, 0.3, 0.4, 0.55, 0.75, 1.0, 1.5)
"""Grid of the prediction (T_s)."""


@dataclass(frozen=True, slots=True)
class Sampling:
    """When and how the currents are sampled."""

    instant_s: float = 0.0
    """How late after the period's start, at which the angle is read (s)."""
    lag_s: float = 0.0
    """Time constant of the current sensor (s)."""


def sampled_ripple(
    voltage: tuple[Array, Array], current: tuple[Array, Array], modulation: Modulation, sampling: Sampling
) -> NDArray[np.float64]:
    """Sampled current beyond the mean of the period, from the pulses of the legs (A), shape (2, n).

    A leg that feeds current out switches on late by the dead time, one that takes it in switches off late.

    Parameters
    ----------
    voltage, current : (ndarray, ndarray)
        d and q means of every window (V, A), shape (n,).
    modulation : Modulation
        Link, inductances, period and dead time.
    sampling : Sampling
        Instant and lag.
    """
    n, T_s = len(voltage[0]), modulation.period_s
    angle = np.tile((np.arange(ANGLES) + 0.5) * (math.pi / 3.0 / ANGLES), n)
    v, i = (
        phases_of(np.repeat(vector[0], ANGLES), np.repeat(vector[1], ANGLES), angle) for vector in (voltage, current)
    )
    edge = (1.0 - duties(v, modulation.U_dc_v)) * 0.5 * T_s
    on = edge + np.where(i > 0.0, modulation.dead_time_s, 0.0)
    off = T_s - edge + np.where(i < 0.0, modulation.dead_time_s, 0.0)
    width, t = np.maximum(0.0, off - on), sampling.instant_s % T_s  # before the start is late in the period before
    share = width / T_s
    mean = (0.5 * width**2 + width * (T_s - off)) / T_s - 0.5 * width
    conducted = np.clip(t - on, 0.0, width) - share * t - mean
    if sampling.lag_s > 0.0:
        conducted = conducted - sampling.lag_s * (_lagging(on, off, t, sampling.lag_s, T_s) - share)
    leg = angle - LEG_ANGLES[:, None]
    scale = 2.0 / 3.0 * modulation.U_dc_v
    d = scale / modulation.L_h[0] * np.sum(np.cos(leg) * conducted, axis=0)
    q = -scale / modulation.L_h[1] * np.sum(np.sin(leg) * conducted, axis=0)
    return np.asarray(np.stack([d, q]).reshape(2, n, ANGLES).mean(axis=2))


def sampled_flux(
    on_s: NDArray[np.float64], off_s: NDArray[np.float64], modulation: Modulation, sampling: Sampling
) -> NDArray[np.float64]:
    """Return the volt-seconds of each leg that a sample after its period holds beyond that period's (V s), (3, n).

    By the times of the edges in the period (s), (3, n); those of the next one count as the same.
    """
    t, width = sampling.instant_s % modulation.period_s, off_s - on_s
    beyond = np.clip(t - on_s, 0.0, width) - (width if sampling.instant_s < 0.0 else 0.0)
    if sampling.lag_s > 0.0:
        beyond = beyond - sampling.lag_s * _lagging(on_s, off_s, t, sampling.lag_s, modulation.period_s)
    return np.asarray(modulation.U_dc_v * beyond)


def _lagging(on: NDArray[np.float64], off: NDArray[np.float64], t: float, lag_s: float, T_s: float) -> Array:
    """Periodic pulses of height 1 behind a first-order lag, at a time within the period."""
    ended = np.maximum(0.0, t + T_s - off)  # a pulse that fills the period ends late by the dead time
    before = (np.exp(-ended / lag_s) - np.exp(-(t + T_s - on) / lag_s)) / -math.expm1(-T_s / lag_s)
    during = np.exp(-np.maximum(0.0, t - off) / lag_s) - np.exp(-np.maximum(0.0, t - on) / lag_s)
    return np.asarray(before + during)


def standstill_instant_s(sampling: Sampling, modulation: Modulation) -> float:
    """Time by which a sample is late on the slope of the zero vectors of a small voltage (s).

    Two short pulses a period make a saw tooth of half its length; a lag rounds it. The dead time shifts it by half.
    """
    quarter, lag = 0.25 * modulation.period_s, sampling.lag_s
    late = sampling.instant_s - 0.5 * modulation.dead_time_s
    if lag <= 0.0:
        return late
    return late - lag + quarter / math.sinh(min(quarter / lag, 500.0)) * math.exp(-late / lag)


def course_s2(sampling: Sampling, period_s: float) -> float:
    """Sampled (t - T_s/2)^2 less its mean T_s^2/12: the course of i_d within a period of a turning machine (s^2)."""
    t, lag, T_s = sampling.instant_s % period_s, sampling.lag_s, period_s
    plain = (t - 0.5 * T_s) ** 2 - T_s**2 / 12.0
    if lag <= 0.0:
        return plain
    fading = 2.0 * lag * T_s * math.exp(-t / lag) / -math.expm1(-T_s / lag)
    return plain - 2.0 * lag * (t - 0.5 * T_s) + 2.0 * lag**2 - fading


@dataclass(frozen=True, slots=True, eq=False)
class ShownInstant:
    """The part of u_d in proportion to -psi w^2, and what instant and lag would make of it."""

    value_s: float
    std_s: float
    """Measured, and its standard deviation (s)."""
    period_s: float
    dead_time_s: float
    """Control period, and the dead time that shifts the pulses by half of it (s)."""
    computation_periods: float
    """From the period's start to the voltage that was computed there (T_s)."""
    predicted_s: NDArray[np.float64]
    """Prediction (s). Shape (len(INSTANTS), len(LAGS))."""

    def sampling(self, delay: float, lag_s: float) -> Sampling:
        """Return the instant that a delay from sample to acting voltage (T_s) stands for."""
        late = (self.computation_periods - delay) * self.period_s
        return Sampling(late + 0.5 * self.dead_time_s, lag_s)

    def knows(self, delay: float) -> bool:
        """Whether a delay (T_s) stands for an instant of the prediction, or for one at most an interval beside it."""
        return self.outside(delay) <= INSTANTS[1] - INSTANTS[0]

    def outside(self, delay: float) -> float:
        """Return how far a delay (T_s) lies from those of the prediction's instants (T_s)."""
        late = self.sampling(delay, 0.0).instant_s / self.period_s
        return max(INSTANTS[0] - late, late - INSTANTS[-1], 0.0)

    def distance(self, delay: float, lag_s: float) -> float:
        """Whitened distance of a delay (T_s) and a lag from what is shown."""
        place = self.sampling(delay, lag_s)
        j, x = _place(INSTANTS, place.instant_s / self.period_s)
        k, y = _place(LAGS, lag_s / self.period_s)
        (a, b), (c, d) = self.predicted_s[j : j + 2, k : k + 2].tolist()
        predicted = (1.0 - x) * ((1.0 - y) * a + y * b) + x * ((1.0 - y) * c + y * d)
        return float(predicted - self.value_s) / self.std_s


def _place(grid: tuple[float, ...], value: float) -> tuple[int, float]:
    """Interval of a grid and the place in it, 0 to 1; beyond an end it nears one more interval.

    What lies far outside is no instant, but at the end itself a change must still be seen, or it decides nothing.
    """
    k = min(max(bisect.bisect_right(grid, value) - 1, 0), len(grid) - 2)
    x = (value - grid[k]) / (grid[k + 1] - grid[k])
    inside = min(max(x, 0.0), 1.0)
    return k, inside + (x - inside) / (1.0 + abs(x - inside))


@dataclass(frozen=True, slots=True, eq=False)
class CoastingPairs:
    """Rows of a speed run as this module needs them."""

    w: Array
    """Electrical speed of every row (rad/s). Shape (n,)."""
    u_d: Array
    """d voltage of the flux linkages, if the currents were sampled at the period's start (V). Shape (n,)."""
    i_d: Array
    i_q: Array
    v_d: Array
    v_q: Array
    """Mean of the samples, and command (A, V). Shape (n,)."""
    pairs: Sequence[tuple[int, int]]
    """Rows with d currents of both signs."""


def shown_instant(
    rows: CoastingPairs, R_ohm: float, psi_wb: float, modulation: Modulation, computation_periods: float
) -> ShownInstant | None:
    """Read the sampling instant off the d voltage of pairs of d currents; None with fewer than five pairs.

    The sum over a pair has no part of i_d or of the inverter's error; what is left is the frame's offset (w), the
    instant (w^2) and a constant. Of 736 random switched drives, half of them with late samples, it was off from what
    the simulated instants should show by 0.0007 T_s rms where the dead time is 0.003 T_s, and by 0.0039 where it is
    0.05: 0.66 of the standard deviation, 0.90 in the class of large dead times. A ripple as large as the d currents
    blurs it.

    Parameters
    ----------
    rows : CoastingPairs
        Of the run.
    R_ohm, psi_wb : float
        Resistance and flux linkage (ohm, Wb).
    modulation : Modulation
        Link, inductances, period and dead time.
    computation_periods : float
        From the period's start to the voltage that was computed there (T_s).
    """
    first, second = (np.array([pair[k] for pair in rows.pairs], dtype=np.int64) for k in (0, 1))
    level = 0.5 * np.abs(rows.i_d[first] - rows.i_d[second])
    ripple_a = modulation.U_dc_v * modulation.period_s / (8.0 * modulation.L_h[1])
    high = level > min(HIGH_LEVEL, max(LOW_LEVEL, RIPPLES * ripple_a / float(np.max(level)))) * np.max(level)
    first, second = first[high], second[high]
    if len(first) < 5:
        return None

    def even(values: Array) -> Array:
        return np.asarray(0.5 * (values[first] + values[second]))

    L_d, L_q = modulation.L_h
    w = even(rows.w)
    columns = np.stack([-(w**2) * psi_wb, w, np.ones_like(w)], axis=1)
    functional = np.linalg.pinv(columns)
    seen = even(rows.u_d + L_q * rows.w * rows.i_q)
    found = functional @ seen
    residual = seen - columns @ found
    variance = float(residual @ residual) / (len(w) - 3)
    noise = math.sqrt(variance * float(functional[0] @ functional[0]))
    use = np.concatenate([first, second])
    voltage, current = (rows.v_d[use], rows.v_q[use]), (rows.i_d[use], rows.i_q[use])
    at_start = sampled_ripple(voltage, current, modulation, Sampling())[1]
    table = np.empty((len(INSTANTS), len(LAGS)))
    T_s, count = modulation.period_s, len(first)
    for j, instant in enumerate(INSTANTS):
        for k, lag in enumerate(LAGS):
            place = Sampling(float(instant) * T_s, lag * T_s)
            ripple = sampled_ripple(voltage, current, modulation, place)[1] - at_start
            course = course_s2(place, T_s) - course_s2(Sampling(), T_s)
            u = rows.w[use] * L_q * ripple - R_ohm * 0.5 * rows.w[use] ** 2 * psi_wb / L_d * course
            table[j, k] = functional[0] @ (0.5 * (u[:count] + u[count:]))
    # past the end of the zero vectors the ripple turns back; a second instant with the same value is not meant
    for j in range(1, len(INSTANTS)):
        if INSTANTS[j] > LATEST:
            least = table[j - 1] + RISE * T_s * (INSTANTS[j] - INSTANTS[j - 1])
            table[j] = np.maximum(table[j], least)
    return ShownInstant(
        value_s=float(found[0]),
        std_s=math.hypot(noise, FLOOR_PERIODS * T_s, FLOOR_OF_DEAD_TIME * modulation.dead_time_s),
        period_s=T_s,
        dead_time_s=modulation.dead_time_s,
        computation_periods=computation_periods,
        predicted_s=table,
    )
