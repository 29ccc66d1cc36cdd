# SPDX-License-Identifier: MIT
"""A drive's speed loop from the current that it asks for, whatever its current loop makes of that.

What is asked for is K_p (omega_ref - omega_f) + K_i (theta_ref - theta_f). Reference and position are known, so that
both gains follow from linear least squares; the reference's delay and the lag of the feedback are found beside them.
Dead time of the inverter, and an EMF that is not fed forward, lie behind what is asked for.

The samples are noisy: the bus tells their instants to some 0.1 ms, which at speed is an angle. A regression on noisy
signals makes the gains smaller. So only that share of every signal counts that the references explain: low passes of
them, slow and fast, are the instruments.

Source: L. Ljung, System Identification, 2nd ed., 1999, sections 7.6 (instrumental variables) and 13.4.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.identification.speed_loop_response import (
    AGE_S,
    EARLY_S,
    FIRST_LAG_S,
    GRID_S,
    LATE_S,
    LEAST_LAG_S,
    LEAST_SAMPLES,
    MOST_LAG_S,
    STAGES,
    Emf,
    SpeedLoop,
    StepRecord,
)

KEPT = (1.0, 0.5)
"""Corners of the low pass that everything is looked at through, over the loop's bandwidth: the loop is the middle of
both, and half the difference is its doubt. Above, ripple of torque and jitter of the samples are most."""
FAST = 4.0
"""The same where currents are compared alone."""
INSTRUMENTS = (8.0, 4.0, 2.0, 1.0, 0.5, 0.25, 0.125)
"""Corners of the low passes of the reference, over the loop's bandwidth: once and twice each."""
SHIFTS, MOVED_S = 16, 1e-5
"""Parts of a record by which the instruments are shifted; change of a delay by which its slope is found."""
LEAST_SHARE, MOST_SHARE = 0.15, 0.35
"""What is asked for exceeds what flows: by less than that of what the EMF is assumed to take, both objects may show the
same; by more than this share of the current, their units may differ by peak and rms."""
SAME_UNIT, MOST_OF_EMF = 0.1, 3.0
"""Unless both are the same at a held speed, to this share: a current loop's integral leaves no error there. Up to the
second share it then is the EMF of a light rotor; 0.31 to 0.66 on three drives, which held 0.3 to 0.6 % apart."""


@dataclass(frozen=True, slots=True)
class AskedLoop:
    """The loop, and what K_p, K_i and K_i / K_p hang on how it is looked at (standard deviation, relative)."""

    loop: SpeedLoop
    std: tuple[float, float, float]


def _low(x: Array, corner_rad_s: float, times: int = 1) -> Array:
    """Return a signal behind so many low passes of first order, at rest before (trapezoid rule)."""
    from scipy.signal import lfilter

    g = 0.5 * GRID_S * corner_rad_s
    for _ in range(times):
        x = lfilter([g / (1.0 + g)] * 2, [1.0, -(1.0 - g) / (1.0 + g)], x - x[0]) + x[0]
    return x


def _rate(x: Array, corner_rad_s: float) -> Array:
    """Return the derivative behind one low pass."""
    return corner_rad_s * (x - _low(x, corner_rad_s))


class _Answers:
    """One record on an even grid, against the speed that is held before its first step."""

    def __init__(self, record: StepRecord, asked_a: Array, bandwidth_rad_s: float) -> None:
        t = record.t_s
        self.record, self.bandwidth = record, bandwidth_rad_s
        self.grid = np.arange(t[0], t[-1], GRID_S)
        self.current = np.interp(self.grid, t, record.current_a)
        self.asked = np.interp(self.grid, t + record.asked_later_s, asked_a)
        angle = np.interp(self.grid, t, record.position_rad)
        still = self.grid < record.references[1][0]
        self.held = np.polyval(np.polyfit(self.grid[still], angle[still], 1), self.grid)
        self.angle = angle - self.held
        inside = [np.flatnonzero((self.grid >= begin) & (self.grid < end)) for begin, end in record.segments]
        self.parts = [part for part in inside if len(part) >= LEAST_SAMPLES]
        speed = np.gradient(self.reference(0.0), GRID_S)
        corners = [share * bandwidth_rad_s for share in INSTRUMENTS]
        self.basis = np.linalg.qr(self.centred([_low(speed, c, n) for c in corners for n in (1, 2)]))[0]

    def reference(self, late_s: float) -> Array:
        """Return the angle that was asked for until then."""
        angle: Array = self.record.asked_angle(self.grid - late_s) - self.held
        return angle

    def centred(self, columns: Sequence[Array]) -> Array:
        """Return columns of all parts, each part without its mean."""
        table = np.column_stack(columns)
        return np.vstack([table[part] - table[part].mean(axis=0) for part in self.parts])

    def share(self, emf_corner_rad_s: float) -> float:
        """Return by which share what is asked for exceeds what flows below the EMF's corner, beside a lag."""
        corner = FAST * self.bandwidth
        flows = _low(self.current, corner, 2)
        more = _low(self.asked, corner, 2) - flows
        lagging = _rate(_low(self.current, corner), corner)
        table = self.basis.T @ self.centred((_low(flows, emf_corner_rad_s), lagging, more))
        return float(np.linalg.lstsq(table[:, :2], table[:, 2], rcond=None)[0][0])

    def covariance(self, slopes: Array, rest: Array) -> Array:
        """Return the covariance of coefficients, from what is left of all samples.

        Noise that has a colour is as large in the instruments as in the same ones at other times.
        """
        shifts = len(rest) // SHIFTS
        noise = [np.mean(np.square(np.roll(self.basis, k * shifts, axis=0).T @ rest)) for k in range(1, SHIFTS)]
        return np.asarray(float(np.mean(noise)) * np.linalg.pinv(slopes.T @ slopes), dtype=np.float64)

    def amps_per_rad_s2(self, corner: float) -> tuple[float, float]:
        """Return the current per acceleration, beside a friction that grows with the speed, and a lag; relative std."""
        speed = _rate(self.angle, corner)
        flows = _low(self.current, corner)
        columns = _low(flows, corner, 2), _low(_rate(flows, corner), corner), _low(speed, corner, 2)
        full = self.centred((*columns, _low(_rate(speed, corner), corner)))
        table = self.basis.T @ full
        found = np.linalg.lstsq(table[:, :3], table[:, 3], rcond=None)[0]
        covariance = self.covariance(table[:, :3], full[:, 3] - full[:, :3] @ found)
        return 1.0 / float(found[0]), math.sqrt(float(covariance[0, 0])) / abs(float(found[0]))

    def gains(self, corner: float) -> AskedLoop:
        """Return the loop whose gains explain what is asked for best, with everything behind two low passes."""
        from scipy.optimize import least_squares

        amps, amps_std = self.amps_per_rad_s2(corner)
        speed, angle = _low(_rate(self.angle, corner), corner), _low(self.angle, corner, 2)
        asked = _low(self.asked, corner, 2)

        def full(p: Array) -> Array:
            wanted = self.reference(p[0])
            return self.centred(
                (
                    asked,
                    _low(np.gradient(wanted, GRID_S), corner, 2) - _low(speed, STAGES / p[1], STAGES),
                    _low(wanted, corner, 2) - _low(angle, STAGES / p[1], STAGES),
                )
            )

        def left(p: Array) -> tuple[Array, Array]:
            table = self.basis.T @ full(p)
            # the error of the speed is the noisiest of them: it is what is explained
            of_asked, of_angle = np.linalg.lstsq(table[:, (0, 2)], table[:, 1], rcond=None)[0]
            gains = np.array([1.0, -of_angle]) / of_asked
            return table[:, 0] - table[:, 1:] @ gains, gains

        low, high = (-EARLY_S - AGE_S, LEAST_LAG_S), (LATE_S, MOST_LAG_S)
        tried = [
            least_squares(lambda p: left(p)[0], (0.0, lag_s), bounds=(low, high), x_scale=1e-3, diff_step=1e-2)
            for lag_s in (FIRST_LAG_S, 2.5 * FIRST_LAG_S)
        ]
        best = min(tried, key=lambda one: float(one.cost)).x
        gains, seen = left(best)[1], full(best)
        later = [(full(best + step) - seen)[:, 1:] @ gains / MOVED_S for step in MOVED_S * np.eye(2)]
        slopes = self.basis.T @ np.column_stack((seen[:, 1:], *later))
        rest = seen[:, 0] - seen[:, 1:] @ gains
        covariance = self.covariance(slopes, rest)[:2, :2] / np.outer(gains, gains)
        K_p, K_i = gains / amps
        loop = SpeedLoop(
            float(K_p), float(K_i), float(best[1]), float(best[0]), amps,
            math.sqrt(float(np.mean(rest**2))) / self.record.noise_a,
        )  # fmt: skip
        rate = math.sqrt(max(0.0, covariance[0, 0] + covariance[1, 1] - 2.0 * covariance[0, 1]))
        of_K_p, of_K_i = (math.hypot(amps_std, math.sqrt(covariance[k, k])) for k in (0, 1))
        return AskedLoop(loop, (of_K_p, of_K_i, rate))


def asked_share(record: StepRecord, loop: SpeedLoop, emf: Emf) -> float:
    """Return by which share of the current what is asked for exceeds what flows; NaN where only one is shown.

    ``loop`` is what the response alone says, ``emf`` what the EMF is assumed to take.
    """
    if record.asked_a is None:
        return math.nan
    return _Answers(record, record.asked_a, loop.K_p_per_J).share(emf.corner_rad_s)


def held_apart(record: StepRecord) -> float:
    """Return by which share of the current both differ at the held speed; infinity where that has too little current.

    It is friction's: what is left of the noise must tell peak from rms.
    """
    still = record.t_s < record.references[1][0]
    flows = float(np.mean(record.current_a[still]))
    if record.asked_a is None or abs(flows) < record.noise_a * math.sqrt(10.0 / np.count_nonzero(still)) / SAME_UNIT:
        return math.inf
    return abs(float(np.mean(record.asked_a[still])) / flows - 1.0)


def shows_asked(shares: Sequence[float], emf: Emf, apart: float = math.inf) -> bool:
    """Return whether what the drive shows beside the current surely is what its loop asks for, in the same unit.

    ``shares`` are those of records with the same gains: short steps at a small current leave much noise in one.
    ``apart`` is the largest of :func:`held_apart`.
    """
    most = MOST_OF_EMF if apart < SAME_UNIT else MOST_SHARE
    return LEAST_SHARE * emf.share < sum(shares) / len(shares) < most


def fit_asked_current(record: StepRecord, loop: SpeedLoop) -> AskedLoop | None:
    """Return the loop by the current that it asks for; None where no gains explain that.

    ``loop`` is what the response alone says.
    """
    if record.asked_a is None:
        return None
    answers = _Answers(record, record.asked_a, loop.K_p_per_J)
    first, second = (answers.gains(kept * loop.K_p_per_J) for kept in KEPT)
    one, other = first.loop, second.loop
    if not min(one.K_p_per_J, one.K_i_per_J, other.K_p_per_J, other.K_i_per_J) > 0.0:
        return None
    K_p, K_i = (math.log(b / a) for a, b in ((one.K_p_per_J, other.K_p_per_J), (one.K_i_per_J, other.K_i_per_J)))
    middle = replace(one, K_p_per_J=one.K_p_per_J * math.exp(0.5 * K_p), K_i_per_J=one.K_i_per_J * math.exp(0.5 * K_i))
    of_K_p, of_K_i, of_rate = (
        math.hypot(0.5 * change, std) for change, std in zip((K_p, K_i, K_i - K_p), first.std, strict=True)
    )
    return AskedLoop(middle, (of_K_p, of_K_i, of_rate))
