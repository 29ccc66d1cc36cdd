# SPDX-License-Identifier: MIT
"""A drive's position gain from moves at even speed: what the shaft lags behind its demand.

A position gain K_v on a speed loop with integral part turns the shaft by omega = K_v e + f omega_ref. At even speed
that loop follows exactly, so that the lag e is (1 - f) omega / K_v, whatever inertia, friction and the speed loop are.
The share f of the speed that the drive feeds forward is told by the current of the same moves, whose ramps change
demanded and seen speed apart:

    i = a (K_v e + f omega_ref - omega) + b (K_v int e dt + f theta_ref - theta) + c,

so that f is the coefficient of omega_ref over that of -omega. A drive takes its speed from counts, whose noise stands
in position and current alike: least squares then find a feed-forward that is none. What the ramp of a move takes from
the integral of the lag has no such noise. Over the settled lag it is 1 / K_v and what friction and the speed loop add,
which is the same with every K_v: from moves with two gains follows K_v, and f from it and the lag.

A feed-forward that has an object is 0 for this; what it counts then follows from the lag with it over that without.
Where a drive adds T_a times the acceleration of the demand to the reference of its speed, that acts as the derivative
of a speed fed forward. So over a ramp it takes T_a omega / K_v from the integral of the lag, once that has settled: T_a
is the difference of two integrals over the lag. What friction does on the way is gone by then: the loop has an integral
part. A loop whose lag does not settle (an integral part of the position, or one controller of the position) is none of
this kind.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.errors import IdentificationError
from pmsmtool.identification.learned_gains import NORMAL_95, NOT_SAME, WIDEST, Learned
from pmsmtool.trace import Trace

EVEN, EVEN_OVER_S = 0.05, 0.1
"""Change of the demanded speed within which a move is even, of its largest; time over which that is taken (s): a bus
tells the instants of samples to some 0.3 ms, which over 20 ms was 5 % of the speed."""
WINDOW_S = 0.02
"""Over which speeds are taken: counts of the position are no speed from one sample to the next."""
LEAST_S = 0.4
"""Time for which a demand must be even: the second half of it counts."""
LEAST_COUNTS = 20.0
"""Least lag, in counts of the position."""
SETTLED = 0.03
"""Largest difference of the lag in both quarters that count, relative."""
ALIKE = 4.0
"""Windows after one another that the rest of the current is alike in: cogging and friction are no noise."""
LATE_S = 0.5e-3
"""Standard deviation of the time between demand and position of one sample: half a period of a loop at 1 kHz."""
NOISE_DOUBT = 2.0
"""Doubt of what the current says is fed forward, over the share of the noise of counts in what tells it; measured on 16
moves: up to 2.2."""
DELAY_STD_S = 0.7e-3
"""Standard deviation of the difference of two gains' delays (s): cogging where a move begins; of 16 drives 0.5 ms."""
AGREES = 0.25
"""Largest share, with its standard deviation, that is still none: a slow speed loop and its filter made up to -0.10."""
CHANGE_STD = 0.02
"""Of a ratio of two gains of one drive (relative)."""
UNIT = "1/s"


@dataclass(frozen=True, slots=True)
class PositionLag:
    """What moves with one gain showed."""

    gain_per_s: float
    """Speed over lag (1/s)."""
    std: float
    """Its standard deviation (relative)."""
    forward: float
    forward_std: float
    """Share of the demanded speed that is fed forward, and its standard deviation, by the current."""
    delays_s: tuple[float, ...] = ()
    """What the ramp of each move takes from the integral of the lag, over the lag (s)."""


def position_lag(trace: Trace, rad_per_count: float) -> PositionLag:
    """Return speed over lag of moves there and back.

    Raises IdentificationError: the moves are not even for long enough, or the lag does not settle, or it is too small
    to be seen.

    Parameters
    ----------
    trace : Trace
        As ``experiments.move.record_move`` leaves it.
    rad_per_count : float
        Angle of one count of the position (rad).
    """
    speeds, lags = _even_lags(trace)
    lag = float(np.mean(lags))
    if lag < LEAST_COUNTS * rad_per_count:
        least = f"{lag / rad_per_count:.3g} counts, {LEAST_COUNTS:g} needed"
        raise _refused(f"the shaft lags behind its demand by {least}", "the drive feeds the speed of a move forward")
    drift = float(np.max(np.abs(lags[1::2] - lags[::2]))) / lag
    if drift > SETTLED:
        raise _refused(f"the lag still changes by {100.0 * drift:.2g} % while the speed is even", "")
    gain = float(np.mean(speeds)) / lag
    spread = float(np.std(lags[::2] + lags[1::2], ddof=1)) / (2.0 * lag)
    areas, _, settled = ramp_areas(trace)
    std = math.hypot(spread, drift, LATE_S * gain)
    return PositionLag(gain, std, *_fed_forward(trace, rad_per_count), tuple(map(float, -areas / settled)))


def _even_lags(trace: Trace) -> tuple[Array, Array]:
    """Return speed and lag along it of the third and the last quarter of every even part."""
    t, demand, position = trace.t_s, trace["theta_ref_rad"], trace["theta_m_rad"]
    quarters = []
    for first, last in _even_parts(t, demand):
        edges = np.searchsorted(t, t[first] + (t[last] - t[first]) * np.array([0.5, 0.75, 1.0]))
        for a, b in pairwise(edges):
            speed = float(np.polyfit(t[a:b], demand[a:b], 1)[0])
            quarters.append((abs(speed), math.copysign(1.0, speed) * float(np.mean(demand[a:b] - position[a:b]))))
    if len(quarters) < 4:
        raise _refused("the demand was even for too short a time", "give the drive its head: no limit below the speed")
    return np.array(quarters).T[0], np.array(quarters).T[1]


def fed_share(trace: Trace, without: PositionLag) -> tuple[float, float]:
    """Return the share of the demanded speed that is fed forward in moves, and its standard deviation.

    ``without``: what moves with the same position gain and no feed-forward showed. Raises IdentificationError: as
    :func:`position_lag`.
    """
    speeds, lags = _even_lags(trace)
    times = lags / speeds
    drift = float(np.max(np.abs(times[1::2] - times[::2])))
    share = 1.0 - without.gain_per_s * float(np.mean(times))
    spread = float(np.std(times[::2] + times[1::2], ddof=1)) / 2.0
    own = without.gain_per_s * math.hypot(spread, drift)
    return share, math.hypot(own, (1.0 - share) * without.std, LATE_S * without.gain_per_s)


def ramp_areas(trace: Trace) -> Array:
    """Return what the ramp of a move adds to the integral of the lag over time, with its doubt, and the settled lag.

    In rad s, rad s and rad, shape (3, moves). A constant time between demand and position adds nothing. Raises
    IdentificationError: as :func:`position_lag`.
    """
    t, demand, position = trace.t_s, trace["theta_ref_rad"], trace["theta_m_rad"]
    speeds, lags = (quarters.reshape(-1, 2) for quarters in _even_lags(trace))
    rests = np.flatnonzero(np.interp(t - WINDOW_S, t, demand) == demand)  # one sample may show a demand twice
    found = []
    for (first, last), speed, (lag, later) in zip(_even_parts(t, demand), speeds.mean(axis=1), lags, strict=True):
        began = rests[np.searchsorted(rests, first) - 1]
        ended = int(np.searchsorted(t, 0.5 * (t[first] + t[last])))
        way, settled = demand[ended] - demand[began], 0.5 * (lag + later)
        lagged = np.trapezoid((demand - position)[began : ended + 1], t[began : ended + 1])
        even_s = abs(way) / speed
        area = math.copysign(1.0, way) * float(lagged) - even_s * settled
        found.append((area, even_s * 0.5 * abs(later - lag), settled))
    return np.array(found).T


def led_s(trace: Trace, without: Array) -> tuple[float, float]:
    """Return the time by which the acceleration leads the speed (s) in moves, and its standard deviation.

    ``without``: :func:`ramp_areas` of the same moves, the same gains, and nothing fed forward.
    """
    areas, doubts, lags = without
    less, more_doubts, _ = ramp_areas(trace)
    led = (areas - less) / np.mean(lags)
    drift = np.hypot(doubts, more_doubts) / np.mean(lags)
    each = math.hypot(float(np.std(led, ddof=1)), float(np.sqrt(np.mean(drift**2))))
    return float(np.mean(led)), math.hypot(each / math.sqrt(led.size), CHANGE_STD * float(np.max(led)))


def _even_parts(t: Array, demand: Array) -> Iterator[tuple[int, int]]:
    """Yield first and last sample of every part in which the demand moves evenly at its largest speed."""
    ahead, behind = (np.interp(t + 0.5 * over_s, t, demand) for over_s in (EVEN_OVER_S, -EVEN_OVER_S))
    speed = np.abs(ahead - behind) / EVEN_OVER_S
    even = np.flatnonzero(speed > (1.0 - EVEN) * np.quantile(speed, 0.9))
    for part in np.split(even, np.flatnonzero(np.diff(even) > 1) + 1):
        if part.size and t[part[-1]] - t[part[0]] > LEAST_S:
            yield int(part[0]), int(part[-1])


def _fed_forward(trace: Trace, rad_per_count: float) -> tuple[float, float]:
    """Return the share of the demanded speed that is fed forward, and its standard deviation, by the current."""
    from scipy.integrate import cumulative_trapezoid

    t, demand, position = trace.t_s, trace["theta_ref_rad"], trace["theta_m_rad"]
    lag, charge = cumulative_trapezoid([demand - position, trace["i_q_a"]], t, initial=0.0)
    matrix = _changes(t, (demand, -position, *cumulative_trapezoid([lag, demand, position], t, initial=0.0)))
    current = _changes(t, [charge])[:, 0]
    size = np.sqrt(np.mean(matrix**2, axis=0))
    found, *_ = np.linalg.lstsq(matrix / size, current, rcond=None)
    inverse = np.linalg.inv((matrix / size).T @ (matrix / size))
    covariance = inverse * float(np.mean((current - matrix / size @ found) ** 2)) * ALIKE
    of_demand, of_speed = (float(found[k] / size[k]) for k in (0, 1))
    share = of_demand / of_speed
    gradient = np.array([1.0 / size[0], -share / size[1]]) / of_speed
    noise = len(matrix) * rad_per_count**2 / 6.0 * float(inverse[1, 1]) / size[1] ** 2  # two roundings, over the rest
    return share, math.hypot(math.sqrt(float(gradient @ covariance[:2, :2] @ gradient)), NOISE_DOUBT * noise)


def _changes(t: Array, signals: Sequence[Array]) -> Array:
    """Return what signals change by over windows, one column each, and a column of ones."""
    grid = np.arange(t[0] + WINDOW_S, t[-1] - WINDOW_S, 0.5 * WINDOW_S)
    ends = [[np.interp(grid + side * WINDOW_S, t, x) for x in signals] for side in (0.5, -0.5)]
    return np.column_stack([*(after - before for after, before in zip(*ends, strict=True)), np.ones_like(grid)])


def position_scale(
    own: tuple[float, PositionLag], changed: tuple[float, PositionLag], name: str, *, forward_is_zero: bool = False
) -> Learned:
    """Return what one count of the position gain is worth (1/s), from its counts and lags before and after a change.

    ``forward_is_zero``: the drive's own object of the feed-forward is known to be 0; the current must only agree.
    """
    counts, lag = own

    def unknown(why: str, half_width: float = math.inf) -> Learned:
        return Learned(name, None, half_width, None, "", why)

    asked = math.log(changed[0] / counts)
    seen = math.log(changed[1].gain_per_s / lag.gain_per_s)
    if abs(seen - asked) > NOT_SAME * math.hypot(CHANGE_STD, lag.std, changed[1].std):
        return unknown(f"the lag follows the counts with the exponent {-seen / asked:.2f}, not -1")
    told = [(lag.forward, lag.forward_std), (changed[1].forward, changed[1].forward_std)]
    told += [_fed_by_delays(lag, changed[1])] if lag.delays_s else []
    shares, stds = np.array(told).T
    weights = stds**-2.0
    forward = float(weights @ shares / weights.sum())
    forward_std = float(weights.sum()) ** -0.5
    per_count = 0.5 * (lag.gain_per_s / counts + changed[1].gain_per_s / changed[0])
    known = forward_is_zero and abs(forward) + forward_std < AGREES
    half = NORMAL_95 * math.hypot(lag.std, seen - asked, 0.0 if known else math.hypot(forward_std, forward))
    if half > WIDEST:
        fed = f"{100.0 * forward:.0f} +-{100.0 * NORMAL_95 * forward_std:.0f} % of the speed fed forward"
        return unknown(f"its interval of {100.0 * half:.0f} % is too wide, with {fed}", half)
    return Learned(name, per_count, half, "value", UNIT)


def _fed_by_delays(lag: PositionLag, changed: PositionLag) -> tuple[float, float]:
    """Return the share of the speed that is fed forward, and its standard deviation, from moves with two gains."""
    apart = np.subtract(changed.delays_s, lag.delays_s)
    delay, without = float(np.mean(apart)), 1.0 / changed.gain_per_s - 1.0 / lag.gain_per_s
    std = math.hypot(float(np.std(apart, ddof=1)) / math.sqrt(apart.size), DELAY_STD_S)
    return 1.0 - without / delay, abs(without) * std / delay**2


def forward_scale(counts: float, share: float, std: float, name: str, unit: str = "1") -> Learned:
    """Return what one count of a feed-forward is worth, from what some counts feed.

    ``unit``: 1, the share of the speed; s, the time by which the acceleration leads.
    """
    half = NORMAL_95 * std / abs(share) if share else math.inf
    if not share > 0.0 or half > WIDEST:
        size, of = (100.0, "% of the speed") if unit == "1" else (1e3, "ms of the acceleration")
        fed = f"{counts:.9g} counts feed {size * share:.2g} +-{size * NORMAL_95 * std:.2g} {of} forward"
        return Learned(name, None, half, None, "", fed)
    return Learned(name, share / counts, half, "value", unit)


def _refused(what: str, likely: str) -> IdentificationError:
    return IdentificationError(
        "E_EXCITATION", what, likely=likely or "an integral part of the position, or one controller of the position",
        hint="where the drive's manual states the unit of the gain, write it into a map (--map FILE)",
    )  # fmt: skip
