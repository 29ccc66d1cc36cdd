# SPDX-License-Identifier: MIT
"""A drive's speed loop from steps of its reference: K_p and K_i over the inertia, and the current per acceleration.

The loop is J d(omega)/dt = K_p e + K_i int e dt, with e = omega_ref - omega_f and a lag of everything that the loop
waits for: filter, sampling, the encoder's tracking, in as many equal stages. Position and current are compared with the
loop's answer to the very references that were written (output error), so that the loop's own noise feedback does not
bias the gains. The time from a write to its effect, the age of the current against the position, and the state at the
beginning are estimated with the gains.

A current loop without feed-forward of the EMF gives less than is asked for: up to the corner of its integral like a
larger inertia, beyond it like a friction.

Source: L. Ljung, System Identification, 2nd ed., 1999, section 13.4 (direct closed-loop identification).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.errors import IdentificationError

GRID_S = 0.5e-3
"""Step of the model (s): half of the fastest sampling."""
ENOUGH_SAMPLES = 2000
"""Of a longer record every second, third ... sample counts: what is looked for is far slower."""
STAGES = 3
"""One alone takes a loop of 140 1/s for one with a gain larger by 9 % (four random drives: 0 to 3 % with three)."""
FIRST_LAG_S, LEAST_LAG_S, MOST_LAG_S = 2e-3, 2e-5, 2e-2
EARLY_S, LATE_S, AGE_S = 2e-3, 1e-2, 5e-3
"""Bounds of the loop's lag, of the time from the write of a reference to its effect, and of the current's age (s)."""
FIRST_BANDWIDTHS = (25.0, 90.0)
FIRST_SHARE = 0.2
"""First values of K_p / J (1/s), and of K_i / K_p as a share of it: from each the fit is begun."""
ROUGHLY = 1e-5
"""Change of the squares at which these fits end; the last one begins at the better of both."""
LEAST_SAMPLES = 30
PULSE_BEGIN_S, PULSE_BIN_S, PULSE_HELD = 2e-3, 2e-3, 0.9
"""When the current of a torque pulse counts (s); the bins (s), and the share of its level, by which its end is seen."""
MOST_SHARE = 3.0
"""Largest share of the EMF that pulses may show, over the assumed one: that is right to 0.4 to 2.4."""
PULSE_STD, PULSE_STD_SHARE = 0.005, 0.15
"""Standard deviation of that share, absolute and relative: 16 simulated drives showed 0.000 to -0.010 of it beside
0.86 to 1.06, those with at least 0.8 of the current at once."""
FOLLOWS = 0.5
"""Share of the modelled answer below which the shaft does not answer."""
BOUNDS = {
    "K_p": (0.5, 5e3),
    "K_i": (0.05, 5e6),
    "lag": (LEAST_LAG_S, MOST_LAG_S),
    "late": (-EARLY_S, LATE_S),
    "age": (-AGE_S, AGE_S),
}
SAME = 1.01
"""Ratio within which a lag that is known is kept."""
AT_BOUND_S = 1e-4
"""Distance from a bound at which a time counts as being there: a lag that short hardly moves the fit. On 80 random
drives six fits, of two drives, ended at 0.02 to 0.05 ms, with K_p 6 to 49 % too large; the 493 others at 2 ms or more.
"""
_LOGARITHMIC = ("K_p", "K_i", "lag")
_STEPS = np.array([0.1, 0.1, 0.5, 1e-3, 1e-3])


class Emf(NamedTuple):
    """What the EMF takes from a current loop that does not feed it forward."""

    share: float
    """Of the inertia, by which this seems larger below the corner."""
    corner_rad_s: float
    """Of the current loop's integral: R over L."""
    share_std: float = 0.0
    """Standard deviation of the share."""
    at_once: float | None = None
    """Share of the current asked for that flows before this integral acts, where torque pulses showed it: less than one
    by the inverter's dead time, and by a slow current loop."""


@dataclass(frozen=True, slots=True)
class StepRecord:
    """Answers to steps of a speed reference, whose unit is known by the held speed before them."""

    t_s: Array
    position_rad: Array
    current_a: Array
    """Samples; the current as the drive shows it. Shape (n,)."""
    references: Sequence[tuple[float, float]]
    """When a reference was written, and which. Sequence of (s, rad/s)."""
    segments: Sequence[tuple[float, float]]
    """Where the samples count: the current keeps its sign there. Sequence of (s, s)."""
    noise_rad: float
    noise_a: float
    """Standard deviation of position and current at a held speed."""
    asked_a: Array | None = None
    """Current that the speed loop asks for, where the drive shows it. Shape (n,), or None."""
    asked_later_s: float = 0.0
    """How much later than the current that one was read."""

    def asked_angle(self, t_s: Array) -> Array:
        """Return the angle that the references ask for up to instants (rad). Shape as ``t_s``."""
        times, values = np.array(self.references).T
        passed = np.concatenate(([0.0], np.cumsum(np.diff(times) * values[:-1])))
        outside = values[0] * np.minimum(t_s - times[0], 0.0) + values[-1] * np.maximum(t_s - times[-1], 0.0)
        return np.asarray(np.interp(t_s, times, passed) + outside)


@dataclass(frozen=True, slots=True)
class SpeedLoop:
    """What one record says of a speed loop."""

    K_p_per_J: float
    K_i_per_J: float
    """Gains over the inertia (1/s and 1/s2)."""
    lag_s: float
    late_s: float
    """Of the loop; from the write of a reference to its effect."""
    amps_per_rad_s2: float
    """Shown current per acceleration: J over the torque per shown ampere."""
    misfit: float = 1.0
    """Root mean square of what the loop leaves of the current, in its noise."""
    at_bound: str = ""
    """Which time the fit ended at the bound of (``lag``, ``late``, ``age``): no loop of this kind answers so. Else
    empty."""


def fit_pulses(pulses: Sequence[tuple[Array, Array]], assumed: Emf) -> Emf | None:
    """Return what torque pulses at a current limit show of the current loop; None where they contradict the assumed.

    The limit is what a saturated speed loop asks for. Of that, a share g flows at once; the rest comes with the
    integral, up to 1 / (1 + share of the EMF): a + (g - a) exp(-g c t / a), with a for that and the corner c.

    Parameters
    ----------
    pulses : sequence of (ndarray, ndarray)
        Times since the reference was written (s), and the current above that of the held speed, over what the limit
        leaves above it.
    assumed : Emf
        What is known without them.
    """
    from scipy.optimize import curve_fit

    t, current = (np.concatenate(parts) for parts in zip(*pulses, strict=True))
    bins = np.floor(t / PULSE_BIN_S).astype(int)
    level = np.array([np.median(current[bins == k]) if np.any(bins == k) else 0.0 for k in range(bins.max() + 1)])
    flat = np.flatnonzero(level > PULSE_HELD * np.quantile(level, 0.8))
    inside = (t > PULSE_BEGIN_S) & (t < PULSE_BIN_S * (int(flat[-1]) - 2)) if len(flat) else np.zeros(len(t), bool)
    if np.count_nonzero(inside) < LEAST_SAMPLES:
        return None
    corner = assumed.corner_rad_s

    def flows(t: Array, at_once: float, last: float) -> Array:
        rest: Array = last + (at_once - last) * np.exp(-at_once * corner / last * (t - 0.5 * PULSE_BEGIN_S))
        return rest

    bounds = ((0.05, 0.3), (1.2, 1.3))
    (at_once, last), covariance = curve_fit(flows, t[inside], current[inside], (0.8, 0.9), bounds=bounds)
    share = 1.0 / last - 1.0
    if share < -PULSE_STD or share > MOST_SHARE * assumed.share + PULSE_STD:
        return None
    std = math.hypot(PULSE_STD, PULSE_STD_SHARE * share, math.sqrt(covariance[1, 1]) / last**2)
    return Emf(max(0.0, float(share)), corner, min(std, assumed.share_std), min(1.0, float(at_once)))


def phase_margin_rad(K_p_per_J: float, K_i_per_J: float, lag_s: float) -> float:
    """Return the phase margin of the loop (a s + b) / (s^2 (1 + T s / 3)^3) (rad), at its gain crossover."""
    stage_s = lag_s / STAGES

    def gain(omega: float) -> float:
        return math.hypot(K_p_per_J * omega, K_i_per_J) / (omega * omega * math.hypot(1.0, stage_s * omega) ** STAGES)

    low, high = 1e-3, 1e6
    for _ in range(80):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if gain(middle) > 1.0 else (low, middle)
    return math.atan2(K_p_per_J * low, K_i_per_J) - STAGES * math.atan(stage_s * low)


class _Model:
    """Answer of the loop to a record's references, for trial parameters."""

    def __init__(self, record: StepRecord, emf: Emf, lag_s: float | None = None, forward: bool = False) -> None:
        self.emf, self.forward = emf, forward
        self.bounds = BOUNDS if lag_s is None else {**BOUNDS, "lag": (lag_s / SAME, lag_s * SAME)}
        thin = max(1, len(record.t_s) // ENOUGH_SAMPLES)
        if thin > 1:
            t, position, current = record.t_s[::thin], record.position_rad[::thin], record.current_a[::thin]
            record = replace(record, t_s=t, position_rad=position, current_a=current)
        self.record = record
        t = record.t_s
        self.grid = np.arange(t[0], t[-1] + GRID_S, GRID_S)
        inside = [(t >= begin) & (t < end) for begin, end in record.segments]
        self.parts = [np.flatnonzero(part) for part in inside if np.count_nonzero(part) >= LEAST_SAMPLES]
        if not self.parts:
            raise IdentificationError(
                "E_EXCITATION", "too few samples of the steps", hint="the bus is busy, or the adapter slow"
            )

    def reference(self, late_s: float) -> Array:
        """Mean of the reference over each step of the grid, against the first one (rad/s)."""
        edges = np.append(self.grid, self.grid[-1] + GRID_S) - late_s
        mean: Array = np.diff(self.record.asked_angle(edges)) / GRID_S - self.record.references[0][1]
        return mean

    def modes(self, p: Array) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Return poles and residues of speed over reference; a pair as one pole with twice the residue."""
        a, b, lag_s = np.exp(p[:3])
        corner = self.emf.corner_rad_s
        numerator = np.array([a, b + a * corner, b * corner])
        lag = np.array([math.comb(STAGES, k) * (lag_s / STAGES) ** (STAGES - k) for k in range(STAGES + 1)])
        loop = np.convolve([1.0, corner * (1.0 + self.emf.share), 0.0, 0.0], lag)
        loop[-3:] += numerator
        if not self.forward:
            numerator = np.convolve(numerator, lag)
        poles = np.roots(loop).astype(np.complex128)
        poles = poles[poles.imag >= 0.0]
        poles *= 1.0 + 1e-7 * np.arange(len(poles))  # no two the same
        residues = np.polyval(numerator, poles) / np.polyval(np.polyder(loop), poles)
        return poles, np.where(poles.imag > 0.0, 2.0, 1.0) * residues

    def answer(self, p: Array) -> tuple[Array, Array, Array, NDArray[np.complex128]]:
        """Return angle, speed and acceleration on the grid, and the poles."""
        from scipy.signal import lfilter

        poles, residues = self.modes(p)
        reference = self.reference(p[3])
        driven = reference.astype(np.complex128)
        speed, acceleration = np.zeros_like(reference), residues.sum().real * reference
        for pole, residue in zip(poles, residues, strict=True):
            grown = np.exp(pole * GRID_S)
            answer = lfilter([0.0, residue * (grown - 1.0) / pole], [1.0, -grown], driven)
            speed = speed + answer.real
            acceleration = acceleration + (pole * answer).real
        angle = GRID_S * (np.cumsum(speed) - 0.5 * speed)
        return angle, speed, acceleration, poles

    def fitted(self, p: Array) -> tuple[Array, Array, float, float]:
        """Return the weighted residuals of position and of current, current per acceleration, and how far it answers.

        The last is one where the shaft follows as the model does. It is not fitted: what it has in common with a slow
        integral would move K_i by 10 to 30 %.
        """
        record, t = self.record, self.record.t_s
        angle, speed, acceleration, poles = self.answer(p)
        slow = poles[np.argsort(np.abs(poles))]
        slow = slow[: 1 if slow[0].imag else 2]
        position, current = [], []
        for part in self.parts:
            x = t[part] - t[part[0]]
            decay = np.exp(np.outer(x, slow))
            if slow[0].imag:  # that of a pair which is a little off, too
                decay = np.column_stack((decay, x[:, np.newaxis] * decay))
            free = np.column_stack((np.ones_like(x), x, decay.real, decay.imag))
            position.append((free, np.interp(t[part], self.grid, angle), record.position_rad[part]))
            then = t[part] - p[4]
            free = np.column_stack((np.ones_like(x), np.interp(then, self.grid, speed), decay.real, decay.imag))
            current.append((free, np.interp(then, self.grid, acceleration), record.current_a[part]))
        rest_position, follows = _projected(position, 1.0)
        rest_current, amps = _projected(current)
        return rest_position / record.noise_rad, rest_current / record.noise_a, amps, follows

    def start(self, a: float) -> Array:
        """Return first parameters at a bandwidth."""
        return np.array([math.log(a), math.log(FIRST_SHARE * a * a), math.log(FIRST_LAG_S), 1e-3, 0.0])


def _projected(parts: list[tuple[Array, Array, Array]], known: float | None = None) -> tuple[Array, float]:
    """Fit one coefficient in common beside each part's free columns; return it, and residuals with it or a known."""
    model, seen = [], []
    for free, answer, values in parts:
        basis = np.linalg.qr(free)[0]
        model.append(answer - basis @ (basis.T @ answer))
        seen.append(values - basis @ (basis.T @ values))
    x, y = np.concatenate(model), np.concatenate(seen)
    power = float(x @ x)
    share = float(x @ y) / power if power > 0.0 else 0.0
    return y - (share if known is None else known) * x, share


def fit_speed_loop(
    record: StepRecord,
    emf: Emf,
    first: SpeedLoop | None = None,
    lag_s: float | None = None,
    *,
    forward: bool = False,
) -> SpeedLoop:
    """Return the speed loop that answers as the record does.

    Raises IdentificationError: too few samples, or no loop of this kind answers so.

    Parameters
    ----------
    first : SpeedLoop, optional
        Of a similar record, to begin with.
    lag_s : float, optional
        The loop's lag where another record of the drive told it: a gain does not change it.
    forward : bool
        Whether it lies between the loop and the torque (a slow current loop), not in the speed that is fed back.
    """
    model = _Model(record, emf, lag_s, forward)
    firsts = [model.start(a) for a in FIRST_BANDWIDTHS]
    if first is not None:
        known = [math.log(first.K_p_per_J), math.log(first.K_i_per_J), math.log(first.lag_s), first.late_s, 0.0]
        firsts = [np.array(known) - np.array([0.0, smaller, 0.0, 0.0, 0.0]) for smaller in (0.0, math.log(2.0))]
    tried = [_solve(model, start, (1.0, 1.0), ROUGHLY) for start in firsts]
    plain = min(tried, key=lambda found: float(np.sum(np.square(_weighted(model, found, (1.0, 1.0))))))
    parts = model.fitted(plain)[:2]
    weights = tuple(max(1.0, float(np.sqrt(np.mean(part**2)))) for part in parts)
    plain = _solve(model, plain, weights)
    _, left, amps, follows = model.fitted(plain)
    if not follows > FOLLOWS or amps == 0.0:
        raise IdentificationError(
            "E_EXCITATION",
            "the shaft does not answer the steps of the speed reference",
            likely="a locked shaft or a closed brake, or a speed loop that is not set up",
            hint="free the shaft; run the maker's own set-up first",
        )
    K_p, K_i, lag = np.exp(plain[:3]).tolist()
    times = {"lag": lag, "late": float(plain[3]), "age": float(plain[4])}
    ends = (name for name, at in times.items() if min(at - BOUNDS[name][0], BOUNDS[name][1] - at) < AT_BOUND_S)
    return SpeedLoop(K_p, K_i, lag, times["late"], amps, math.sqrt(float(np.mean(left**2))), next(ends, ""))


MOST_LEFT = 1e9
"""Largest residual, in standard deviations of the noise: squares of all samples stay finite."""


def _weighted(model: _Model, p: Array, weights: Sequence[float]) -> Array:
    with np.errstate(over="ignore", invalid="ignore"):  # a loop that is not stable leaves everything
        position, current, _, _ = model.fitted(p)
        found = np.concatenate([position / weights[0], current / weights[1]])
    return np.asarray(np.clip(np.nan_to_num(found, nan=MOST_LEFT), -MOST_LEFT, MOST_LEFT))


def _solve(model: _Model, first: Array, weights: Sequence[float], ftol: float = 1e-8) -> Array:
    """Return the parameters of least squares."""
    from scipy.optimize import least_squares

    bounds = model.bounds.items()
    low, high = (np.array([math.log(of[k]) if name in _LOGARITHMIC else of[k] for name, of in bounds]) for k in (0, 1))
    start = np.clip(first, low + 1e-9, high - 1e-9)
    found = least_squares(
        lambda p: _weighted(model, p, weights), start, bounds=(low, high), x_scale=_STEPS,
        diff_step=1e-4, max_nfev=30, ftol=ftol,
    )  # fmt: skip
    return np.asarray(found.x, dtype=np.float64)
