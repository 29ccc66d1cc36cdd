# SPDX-License-Identifier: MIT
"""Speed and position loops of an axis as the drive samples them, cut where the torque leaves the controller.

The path from torque to angle and speed runs at the control period: the closed current loop, the shaft, and the drive's
speed estimate. It is lifted to the period of the loops exactly, as in ``design.loops.speed_loop``. Two structures:

- ``cascade``: torque = PI(K_v (theta_ref - theta) + omega_ref - omega), PI(e) = K_p e + K_i T sum(e);
- ``pid``: torque = K_P e + K_I T sum(e) + K_D de/dt of the position error e, its derivative behind a pole at
  10 K_P / K_D. A cascade is this PID with K_P = K_p K_v + K_i, K_I = K_i K_v, K_D = K_p, but for the filters.

The following error of a move that the loops make, and how much feed-forward of the inertia makes it least.

A load behind an elastic shaft answers a feed-forward of the whole inertia well below its antiresonance only; above, the
motor alone takes the torque. So a trapezoid, whose acceleration steps, may be followed better with less of it.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array, Complex
from pmsmtool.axis.move import Move
from pmsmtool.design.loops.sampled_loop import SampledLoop
from pmsmtool.design.loops.speed_loop import (
    Notch,
    SpeedPath,
    companion,
    feedback_filter,
    notch_coefficients,
    speed_estimate,
    torque_path,
)
from pmsmtool.machine.two_masses import Mechanics, sampled

Structure = Literal["cascade", "pid"]
Loop = Literal["speed", "position"]

NO_NOTCH = Notch()
DERIVATIVE_POLE = 10.0
"""Pole of the derivative of the ``pid`` structure times K_D / K_P (maxon, EPOS4 application notes, rel6835)."""


@dataclass(frozen=True, slots=True)
class AxisGains:
    """Gains of both loops, torque at the motor."""

    K_p: float
    K_i: float
    """Of the speed (N m s/rad, N m/rad)."""
    K_v: float
    """Of the position (1/s); 0 leaves the position loop open."""
    notch: Notch = NO_NOTCH
    """On the torque."""

    @property
    def pid(self) -> tuple[float, float, float]:
        """K_P (N m/rad), K_I (N m/(rad s)), K_D (N m s/rad) of the same control as one controller of the position."""
        return self.K_p * self.K_v + self.K_i, self.K_i * self.K_v, self.K_p


@dataclass(frozen=True, slots=True)
class AxisPath:
    """What lies between the controller's torque and what it sees of the shaft."""

    shaft: Mechanics
    """What turns."""
    current: SampledLoop
    """Loop of the q axis, at the control period."""
    decimation: int
    """Control periods per period of both loops."""
    late: int = 0
    """Periods of the loops between a sample and its torque, besides the delay of the current loop."""
    structure: Structure = "cascade"
    """``cascade`` or ``pid``."""
    pll_rad_s: float = 0.0
    """Natural frequency of the drive's tracking filter on the angle, at the control period; 0: the speed is the
    difference of two angles over a period of the loops."""
    filter_hz: float = 0.0
    """First-order filter on that speed; 0: none."""

    @property
    def T(self) -> float:
        """Period of both loops (s)."""
        return self.decimation * self.current.T_s

    @property
    def lag_s(self) -> float:
        """Sum of the small time constants and delays between speed and torque (s)."""
        current = 1.0 / bandwidth(self.current)
        estimate = 2.0 / self.pll_rad_s if self.pll_rad_s else 0.5 * self.T
        smoothing = 1.0 / (2.0 * math.pi * self.filter_hz) if self.filter_hz else 0.0
        return current + self.current.delay_s + estimate + smoothing + (0.5 + self.late) * self.T


def bandwidth(loop: SampledLoop) -> float:
    """Return about where a loop that crosses once has |L| = 1 (rad/s)."""
    omega = np.geomspace(1e-4, 1.0, 200) * math.pi / loop.T_s
    return float(omega[np.argmin(np.abs(np.log(np.abs(loop.at(omega)))))])


@dataclass(frozen=True, slots=True, eq=False)
class Lifted:
    """The path at the period of the loops: x(k+1) = A x + b u, y = c x + d u, y = (angle, speed seen)."""

    A: Array
    b: Array
    c: Array
    d: Array
    """Shapes (n, n), (n,), (2, n), (2,)."""
    T: float
    """Period (s)."""

    def at(self, omega: Array) -> Complex:
        """Return angle and speed seen per torque at angular frequencies (rad/s) of shape (m,); shape (2, m)."""
        z = np.exp(1j * omega * self.T)
        inner = z[:, None, None] * np.eye(self.b.size) - self.A
        x = np.linalg.solve(inner, np.broadcast_to(self.b[:, None], (omega.size, self.b.size, 1)))[..., 0]
        return np.asarray(self.c @ x.T + self.d[:, None], dtype=np.complex128)


def lifted(path: AxisPath) -> Lifted:
    """Return the path at the period of its loops."""
    T_s = path.current.T_s
    A, b, c, d = _behind(torque_path(path.current), sampled(path.shaft.system(), T_s))
    rows = [(c[1], d[1]), (c[0], d[0])]  # angle, speed
    if path.pll_rad_s:
        # the tracking filter and the filter behind it see the speed; both run at the control period
        speed = SpeedPath(path.shaft.J, path.shaft.B, path.current, path.decimation, path.pll_rad_s, path.filter_hz)
        for stage in (speed_estimate(speed), feedback_filter(speed)):
            A, b, rows = _extended(A, b, rows, stage)
    n = b.size
    held = np.zeros(n)
    for _ in range(path.decimation):
        held = A @ held + b
    A = np.linalg.matrix_power(A, path.decimation)
    c, d = np.array([row for row, _ in rows]), np.array([feed for _, feed in rows])
    for _ in range(path.late):
        A, held, c, d = _delayed(A, held, c, d)
    return Lifted(A, held, c, d, path.T)


def _behind(
    first: tuple[Array, Array, Array, float], second: tuple[Array, Array, Array, Array]
) -> tuple[Array, Array, Array, Array]:
    """Return a system of several outputs behind one of one output."""
    A, b, c, d = first
    A2, b2, c2, d2 = second
    n = b.size
    joined = np.zeros((n + b2.size, n + b2.size))
    joined[:n, :n], joined[n:, n:], joined[n:, :n] = A, A2, np.outer(b2, c)
    return joined, np.concatenate((b, b2 * d)), np.hstack((np.outer(d2, c), c2)), d2 * d


def _extended(
    A: Array, b: Array, rows: list[tuple[Array, float]], stage: tuple[Array, Array, Array, float]
) -> tuple[Array, Array, list[tuple[Array, float]]]:
    """Put a stage behind the last output; the others stay."""
    A2, b2, c2, d2 = stage
    n, m = b.size, b2.size
    row, feed = rows[-1]
    joined = np.zeros((n + m, n + m))
    joined[:n, :n], joined[n:, n:], joined[n:, :n] = A, A2, np.outer(b2, row)
    kept = [(np.concatenate((one, np.zeros(m))), value) for one, value in rows[:-1]]
    return joined, np.concatenate((b, b2 * feed)), [*kept, (np.concatenate((d2 * row, c2)), d2 * feed)]


def _delayed(A: Array, b: Array, c: Array, d: Array) -> tuple[Array, Array, Array, Array]:
    """Return a system whose input acts one period later."""
    n = b.size
    joined = np.zeros((n + 1, n + 1))
    joined[:n, :n], joined[:n, n] = A, b
    late = np.zeros(n + 1)
    late[n] = 1.0
    return joined, late, np.hstack((c, d[:, None])), np.zeros_like(d)


# ---- the controller ----------------------------------------------------------------------------------------

Rational = tuple[Array, Array]


def _times(*parts: Rational) -> Rational:
    return functools.reduce(lambda one, other: (np.convolve(one[0], other[0]), np.convolve(one[1], other[1])), parts)


def _plus(first: Rational, second: Rational) -> Rational:
    num = np.polyadd(np.convolve(first[0], second[1]), np.convolve(second[0], first[1]))
    return np.asarray(num, dtype=np.float64), np.convolve(first[1], second[1])


def _pi(gains: AxisGains, T: float) -> Rational:
    return np.array([gains.K_p, gains.K_i * T - gains.K_p]), np.array([1.0, -1.0])


def _filter(filter_hz: float, T: float) -> Rational:
    if not filter_hz:
        return np.ones(1), np.ones(1)
    x = 2.0 * math.pi * filter_hz * T
    return np.array([x / (1.0 + x), 0.0]), np.array([1.0, -1.0 / (1.0 + x)])


def _notch(gains: AxisGains, T: float) -> Rational:
    num, den = notch_coefficients(gains.notch, T)
    return np.array(num), np.array(den)


def speed_from_angle(path: AxisPath) -> Rational:
    """Return the difference of two angles over a period, and the filter behind it."""
    return _times((np.array([1.0, -1.0]) / path.T, np.array([1.0, 0.0])), _filter(path.filter_hz, path.T))


@functools.lru_cache(maxsize=64)
def controllers(path: AxisPath, gains: AxisGains, loop: Loop) -> tuple[Rational, Rational]:
    """Return what the angle and what the speed seen is multiplied with: torque = -(first theta + second omega).

    ``loop`` is ``speed`` (position loop open) or ``position`` (everything).
    """
    T, none = path.T, (np.zeros(1), np.ones(1))
    if path.structure == "pid" and loop == "position":
        K_P, K_I, K_D = gains.pid
        pole = DERIVATIVE_POLE * K_P / K_D
        proportional = _plus((np.array([K_P]), np.ones(1)), (np.array([K_I * T]), np.array([1.0, -1.0])))
        smooth = 1.0 / (1.0 + pole * T)
        derivative = np.array([K_D * pole * smooth, -K_D * pole * smooth]), np.array([1.0, -smooth])
        return _times(_plus(proportional, derivative), _notch(gains, T)), none
    control = _times(_pi(gains, T), _notch(gains, T))
    K_v = gains.K_v if loop == "position" else 0.0
    if path.pll_rad_s:
        return _times((np.array([K_v]), np.ones(1)), control), control
    seen = _plus((np.array([K_v]), np.ones(1)), speed_from_angle(path))
    return _times(seen, control), none


def open_loop(plant: Lifted, path: AxisPath, gains: AxisGains, loop: Loop, omega: Array, seen: Complex) -> Complex:
    """Return the loop at angular frequencies (rad/s), from ``seen = plant.at(omega)``."""
    z = np.exp(1j * omega * plant.T)
    angle, speed = (np.polyval(num, z) / np.polyval(den, z) for num, den in controllers(path, gains, loop))
    return np.asarray(angle * seen[0] + speed * seen[1], dtype=np.complex128)


def closed_loop_poles(plant: Lifted, path: AxisPath, gains: AxisGains, loop: Loop) -> Complex:
    """Return the poles of the closed loop; the angle's own, which nothing moves in the speed loop, is left out."""
    c, d = plant.c, plant.d
    control, other = controllers(path, gains, loop)
    row, feed = c[0], float(d[0])
    if np.any(other[0]):
        # one controller for both: K_v theta + omega goes into it
        ratio = gains.K_v if loop == "position" else 0.0
        control, row, feed = other, ratio * c[0] + c[1], float(ratio * d[0] + d[1])
    A2, b2, c2, d2 = companion(*control)
    scale = 1.0 / (1.0 + d2 * feed)
    u_x, u_c = -scale * d2 * row, -scale * c2
    closed = np.block(
        [
            [plant.A + np.outer(plant.b, u_x), np.outer(plant.b, u_c)],
            [np.outer(b2, row + feed * u_x), A2 + np.outer(b2, feed * u_c)],
        ]
    )
    poles = np.linalg.eigvals(closed)
    if loop == "speed":
        poles = np.delete(poles, int(np.argmin(np.abs(poles - 1.0))))
    return np.asarray(poles, dtype=np.complex128)


REST_S = 0.5
"""Rest behind each of the two moves of a period: what the first leaves has decayed."""
SHARES = np.linspace(0.0, 1.0, 21)
"""Shares of the inertia that are compared."""


def following_error(
    plant: Lifted, path: AxisPath, gains: AxisGains, move: Move, speed_share: float = 1.0, *, leads: bool = False
) -> tuple[Array, Array]:
    """Return following error (rad) and torque (N m) of a move there and back, shape (2, n), by samples of the loops.

    Both are periodic and without their mean.

    ``speed_share``: of the move's speed, that a cascade feeds forward. ``leads``: the acceleration is fed forward to
    the reference of the speed; one unit of it is then J / K_p times the acceleration.

    Returns
    -------
    tuple of ndarray
        Without feed-forward of the acceleration, and what one unit of it (the whole inertia) adds.
    """
    T = plant.T
    half = math.ceil((move.duration_s + REST_S) / T)
    t = np.asarray(np.arange(half) * T, dtype=np.float64)
    place, speed, acceleration = (np.concatenate(pair) for pair in _there_and_back(move, t))
    omega = np.asarray(2.0 * math.pi * np.fft.rfftfreq(2 * half, T)[1:], dtype=np.float64)
    seen = plant.at(omega)
    z = np.exp(1j * omega * T)
    angle, slip = (np.polyval(num, z) / np.polyval(den, z) for num, den in controllers(path, gains, "position"))
    back = 1.0 + angle * seen[0] + slip * seen[1]
    reference, fast, force = (np.fft.rfft(signal)[1:] for signal in (place, speed, acceleration))
    # what the controller multiplies the reference with: as the angle that is fed back, its speed exact where a cascade
    # takes that from the profile
    asked, through = angle * reference, np.ones_like(z)
    if path.structure == "cascade":
        control = slip if path.pll_rad_s else _speed_control(path, gains, z)
        asked = control * (gains.K_v * reference + speed_share * fast)
        through = control / gains.K_p if leads else through
    torque, more = asked / back, path.shaft.J * through * force / back
    plain, added = np.zeros((2, 2, half + 1), np.complex128)
    plain[:, 1:], added[:, 1:] = (reference - seen[0] * torque, torque), (-seen[0] * more, more)
    return np.fft.irfft(plain, 2 * half), np.fft.irfft(added, 2 * half)


def _there_and_back(move: Move, t: Array) -> list[tuple[Array, Array]]:
    place, speed, acceleration = move.at(t)
    return [(place, move.distance - place), (speed, -speed), (acceleration, -acceleration)]


def _speed_control(path: AxisPath, gains: AxisGains, z: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return the speed controller: what acts on K_v times the error of the position."""
    (num, den), _ = controllers(path, AxisGains(gains.K_p, gains.K_i, 1.0, gains.notch), "position")
    (slow, den_slow), _ = controllers(path, AxisGains(gains.K_p, gains.K_i, 0.0, gains.notch), "position")
    return np.asarray(np.polyval(num, z) / np.polyval(den, z) - np.polyval(slow, z) / np.polyval(den_slow, z))


def best_share(plain: Array, added: Array) -> tuple[float, float]:
    """Return the share of the inertia whose feed-forward leaves the least peak of the error, and that peak (rad)."""
    peaks = np.max(np.abs(plain[0] + SHARES[:, None] * added[0]), axis=1)
    best = int(np.argmin(peaks))
    return float(SHARES[best]), float(peaks[best])
