# SPDX-License-Identifier: MIT
"""What repeats with the angle of the shaft, from coasting with the voltage off: cogging torque and encoder error.

On a shaft that coasts with the speed w a torque T cos(n theta) moves the position by -T cos(n theta)/(J (n w)^2), an
error of the encoder by itself, whatever the speed. Once and twice per turn count as the encoder's, or as friction over
the angle where it is the other way round in the other direction, which hides cogging but is none; higher orders count
as torque. Position minus a polynomial of time is regressed on one order after the other, both directions together, the
largest first (orthogonal matching pursuit; Pati et al., Asilomar 1993, DOI 10.1109/ACSSC.1993.342465), and an order
stays while it stands out of what is left. Rows count by their deviation: after 27 turns binary32 rounds to 10 steps of
22 bits, where the shaft is slow and shows a torque best, and an order 270 stood out that a smooth shaft does not have.

What stands out of the rest by far, at whatever speed, is the error of an interpolation within each line of the encoder.
A share of a line is that share times tau of a speed that is measured so slowly that its filter passes it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import Legendre, legvander

from pmsmtool.arrays import Array
from pmsmtool.estimators.least_squares import linear_solve

ENCODER_ORDERS = (1, 2)
"""Orders that are the encoder's: mounted off centre, and oval."""
ENCODER, FRICTION, TORQUE = "encoder", "friction", "torque"
"""What an order is: an error of the position, a torque that changes its sign with the direction, or one that does not.
"""
HIGHEST_ORDER = 400
"""Highest order per turn that is looked for: least common multiples of slots and poles lie below."""
LINES = (64, 10_000)
"""Lines per turn that are looked for."""
STEPS_OF_A_LINE = 8.0
"""Least steps of the position in a line: the steps themselves repeat with the angle, too."""
LINE_SURE = 10.0
"""As :data:`SURE`, of a line: seen 31 to 35, and 5.9 of an elastic shaft whose swing is no line."""
LINE_MOST = 0.7
"""Largest error of an interpolation, in radians of its line: 11 % of it; the steps of a position are off by 2."""
ORDERS_MOST = 8
DEGREE = 6
"""Of the polynomial of time: a coasting without ripple is an exponential."""
SURE = 6.0
"""Amplitude of an order, in standard deviations, from which on it is there: 800 are looked for."""
LEAST_SPEED = 0.2
"""Speed below which a coasting is not used, of its first: near standstill a torque does more than ripple."""
LEAST_WAY_RAD = math.tau
SHAFT_STEPS = 3  # of a fixed point: an error of 1 degree is left with its fourth power, 1e-7 rad
LEAST_ROWS = 100


@dataclass(frozen=True, slots=True)
class Harmonic:
    """One order per turn: ``cosine`` and ``sine`` of the encoder's angle along the phase order, and their deviation."""

    order: int
    cosine: float
    sine: float
    std: float

    @property
    def amplitude(self) -> float:
        """Amplitude."""
        return math.hypot(self.cosine, self.sine)

    @property
    def phase_rad(self) -> float:
        """Phase p of amplitude cos(order theta - p) (rad)."""
        return math.atan2(self.sine, self.cosine)

    def at(self, theta: Array) -> Array:
        """Value at angles (rad)."""
        return np.asarray(self.cosine * np.cos(self.order * theta) + self.sine * np.sin(self.order * theta))


@dataclass(frozen=True, slots=True)
class AngleHarmonics:
    """Encoder error (rad) and acceleration by torque (rad/s2), order by order; travel of the shorter trace (turns).

    ``line_rad``: the encoder's error once and twice per line (rad); empty where none is seen.
    """

    encoder_rad: tuple[Harmonic, ...] = ()
    acceleration_rad_s2: tuple[Harmonic, ...] = ()
    turns: float = 0.0
    line_rad: tuple[Harmonic, ...] = ()

    def torque_nm(self, theta: Array, J_kgm2: float) -> Array:
        """Cogging torque at angles."""
        return np.asarray(J_kgm2 * sum((h.at(theta) for h in self.acceleration_rad_s2), np.zeros_like(theta)))

    def shaft(self, theta: Array) -> Array:
        """Angle of the shaft of what the encoder shows: its error is a function of that angle, not of the shown one."""
        angle = theta
        for _ in range(SHAFT_STEPS):
            angle = np.asarray(theta - sum((h.at(angle) for h in self.encoder_rad), np.zeros_like(theta)))
        return angle

    def without_ripple(self, t_s: Array, theta: Array) -> Array:
        """Positions of a coasting as they were without torque over the angle; alike where it comes to rest."""
        if not self.acceleration_rad_s2:
            return theta
        used = fast_part(t_s, theta)
        smooth, omega = _smooth(t_s[:used], theta[:used])
        out = theta.copy()
        for h in self.acceleration_rad_s2:
            out[:used] += h.at(smooth) / (h.order * omega) ** 2
        return out


def fast_part(t_s: Array, theta: Array) -> int:
    """Rows of a coasting before it is slow."""
    count = max(2, len(theta) // 40)
    speed = np.abs(theta[count:] - theta[:-count])
    slow = np.nonzero(speed < LEAST_SPEED * speed[0])[0]
    return int(slow[0]) if len(slow) else len(theta)


def _smooth(t_s: Array, theta: Array) -> tuple[Array, Array]:
    fit = Legendre.fit(t_s, theta, DEGREE)
    return np.asarray(fit(t_s)), np.asarray(fit.deriv()(t_s))


def angle_harmonics(
    coastings: Sequence[tuple[Array, Array, Array]], step_rad: float = 0.0, most_rad_s2: float = math.inf
) -> AngleHarmonics:
    """Return what repeats with the angle; nothing where the shaft turned too little.

    Parameters
    ----------
    coastings : sequence of (ndarray, ndarray, ndarray)
        Times (s), positions along the phase order (rad, unwrapped) and their standard deviations (rad) of each trace.
    step_rad : float
        Step of the position (rad).
    most_rad_s2 : float
        Largest acceleration by torque that a shaft may have which pushes turned; more is no torque, but a line's error.
    """
    used = [(fast_part(t, theta), t, theta, std) for t, theta, std in coastings]
    parts = [(t[:n], theta[:n], std[:n]) for n, t, theta, std in used]
    parts = [part for part in parts if len(part[0]) > LEAST_ROWS and np.ptp(part[1]) > LEAST_WAY_RAD]
    if not parts:
        return AngleHarmonics()
    turns = min(float(np.ptp(theta)) for _, theta, _ in parts) / (2.0 * math.pi)
    lowest = math.ceil(DEGREE / turns)  # slower ones are the polynomial's
    smooth, bases = [], []
    for t, theta, std in parts:
        courses, error = legvander(np.linspace(-1.0, 1.0, len(t)), DEGREE), np.zeros_like(theta)
        for _ in range(SHAFT_STEPS):
            angle, speed = _smooth(t, theta - error)
            waves = np.column_stack([wave(order * angle) for order in ENCODER_ORDERS for wave in (np.cos, np.sin)])
            error = waves @ np.linalg.lstsq(np.column_stack([courses, waves]), theta, rcond=None)[0][DEGREE + 1 :]
        smooth.append((angle, speed, std))
        # what the polynomial leaves of an encoder's error that is as slow is no torque
        hidden = waves[:, : 2 * sum(order < lowest for order in ENCODER_ORDERS)]
        bases.append(np.linalg.qr(np.column_stack([courses, hidden]) / std[:, None])[0])
    left = np.concatenate([_without(basis, theta / std) for basis, (_, theta, std) in zip(bases, parts, strict=True)])

    def pair(order: int, of: str) -> Array:
        rows = []
        for (angle, speed, std), basis in zip(smooth, bases, strict=True):
            size = (1.0 if of == ENCODER else -1.0 / (order * speed) ** 2) / std
            size = np.copysign(size, -speed) if of == FRICTION else size
            rows.append(np.stack([_without(basis, size * wave(order * angle)) for wave in (np.cos, np.sin)], axis=1))
        return np.concatenate(rows)

    looked_for = [
        (order, ENCODER if order in ENCODER_ORDERS else TORQUE) for order in range(max(1, lowest), HIGHEST_ORDER + 1)
    ]
    if len(parts) > 1:  # one direction alone does not tell it from an error of the encoder
        looked_for += [(order, FRICTION) for order in ENCODER_ORDERS if order >= lowest]
    pairs = {what: pair(*what) for what in looked_for}
    unit = {what: np.linalg.qr(columns)[0] for what, columns in pairs.items()}
    chosen: list[tuple[int, str]] = []
    fit, std, rest = np.empty(0), np.empty(0), left
    while len(chosen) < ORDERS_MOST:
        power = {what: float(np.sum((rest @ unit[what]) ** 2)) for what in pairs if what not in chosen}
        best = max(power, key=lambda what: power[what])
        matrix = np.concatenate([pairs[what] for what in (*chosen, best)], axis=1)
        found, covariance, after, _ = linear_solve(matrix, left, np.ones(len(left)))
        dof = len(left) - sum(basis.shape[1] for basis in bases) - matrix.shape[1]
        deviation = np.sqrt(np.diag(covariance) * float(after @ after) / dof)
        if math.hypot(*found[-2:]) < SURE * max(deviation[-2:]):
            break
        if best[1] == TORQUE and math.hypot(*found[-2:]) > most_rad_s2:
            del pairs[best]
            continue
        chosen, fit, std, rest = [*chosen, best], found, deviation, after

    def found_of(wanted: str) -> tuple[Harmonic, ...]:
        harmonics = [
            Harmonic(order, float(fit[2 * k]), float(fit[2 * k + 1]), float(max(std[2 * k : 2 * k + 2])))
            for k, (order, of) in enumerate(chosen)
            if of == wanted
        ]
        return tuple(sorted(harmonics, key=lambda h: h.order))

    shown = np.concatenate([theta for _, theta, _ in parts])
    weight = np.concatenate([1.0 / std for _, _, std in parts])
    most = math.tau / (STEPS_OF_A_LINE * step_rad) if step_rad > 0.0 else LINES[1]
    line = _line_error(shown, rest, weight, min(LINES[1], int(most)))
    return AngleHarmonics(found_of(ENCODER), found_of(TORQUE), turns, line)


def _line_error(shown: Array, rest: Array, weight: Array, most: int) -> tuple[Harmonic, ...]:
    """Return the error once and twice per line, of the weighted ``rest``: the order that stands out, if one does."""
    orders = np.arange(LINES[0], most + 1)
    turn, wave = np.exp(1j * shown), np.exp(1j * orders[:1, None] * shown)[0] if len(orders) else shown
    parts = np.empty(len(orders), complex)
    for k in range(len(orders)):
        parts[k] = (weight * rest) @ wave
        wave = wave * turn
    power = float(weight @ weight)
    std = math.sqrt(2.0 * float(rest @ rest) / (len(rest) * power)) if len(rest) else 0.0
    size = 2.0 * np.abs(parts) / power
    if not len(orders) or not np.max(size) > LINE_SURE * std:
        return ()
    lines = int(orders[np.argmax(size)])
    if lines % 2 == 0 and lines // 2 >= LINES[0] and size[lines // 2 - orders[0]] > SURE * std:
        lines //= 2  # more is wrong between the amplitudes of its tracks than in their middles
    found: tuple[Harmonic, ...] = ()
    for _ in range(SHAFT_STEPS):
        angle = shown - sum((h.at(shown) for h in found), np.zeros_like(shown))
        matrix = np.stack([w(n * angle) * weight for n in (lines, 2 * lines) for w in (np.cos, np.sin)], axis=1)
        a, b, c, d = map(float, np.linalg.lstsq(matrix, rest, rcond=None)[0])
        found = Harmonic(lines, a, b, std), Harmonic(2 * lines, c, d, std)
    return found if max(lines * h.amplitude for h in found) <= LINE_MOST else ()


def _without(basis: Array, values: Array) -> Array:
    return np.asarray(values - basis @ (basis.T @ values))
