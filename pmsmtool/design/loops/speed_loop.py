# SPDX-License-Identifier: MIT
"""Speed controller: PI gains from the inertia and the sum of the small time constants, and the exact sampled loop.

The path runs at the control period (current loop, speed estimate, filter), the controller every ``decimation``
periods with its torque held between. The loop is lifted to the controller's period exactly, so the margins contain
the multirate hold, the current loop's own delay, the speed estimate and the feedback filter.

Source: symmetric optimum after Kessler (1958), C. Kessler, Regelungstechnik 6; textbook form K_p = J / (a T_sum),
K_i = K_p / (a^2 T_sum), phase margin atan(a) - atan(1/a).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.design.loops.sampled_loop import SampledLoop, margins, modulus_margin
from pmsmtool.errors import DesignInfeasible
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.two_masses import Mechanics, sampled

TORQUE_SHARE = 0.1
"""Largest rms torque that the encoder's noise and errors make a speed loop ask for, of the largest torque. Of 75 drawn
drives with errors of up to 0.44 degrees two go beyond (28, 150 %), both with loads of over 10 rotors: their current
shook from limit to limit at speed."""
SPEEDS = np.geomspace(1e-3, 1.0, 61)
"""Speeds at which the errors are looked at, of the rated speed: within a line they are worst where it is slow (1)."""


def speed_noise(machine: MachineFile, pll_rad_s: float, filter_hz: float) -> float:
    """Return the standard deviation of the filtered speed (rad/s, mechanical) by the encoder noise that was identified.

    White noise n of the position, sampled every T_s, through a loop with both poles at a and a filter at b gives the
    variance n^2 T_s a^3/4 (b/(a + b))^2: the integral of w^2 a^4 b^2/((w^2 + a^2)^2 (w^2 + b^2)) over all frequencies.
    """
    a, b = pll_rad_s, 2.0 * math.pi * filter_hz
    return machine.seen("encoder_noise_rad") * math.sqrt(machine.inverter.T_s * a**3 / 4.0) * b / (a + b)


def encoder_torque(machine: MachineFile, path: SpeedPath, K_p: float, rated_rad_s: float) -> float:
    """Return the rms torque (N m) that noise and errors of the encoder, as identified, make a speed loop ask for.

    An error e sin(k theta) moves the speed by w e at w = k omega_m. The loop of K_p, speed estimate and filter around a
    rigid shaft answers it with a torque; the worst speed up to the rated one counts.
    """
    a, b, lines = path.pll_rad_s, 2.0 * math.pi * path.filter_hz, machine.seen("encoder_lines")
    square = np.zeros(SPEEDS.size)
    for name, order in (("once", 1.0), ("twice", 2.0), ("line", lines), ("line_twice", 2.0 * lines)):
        w, error_rad = order * rated_rad_s * SPEEDS, machine.seen(f"encoder_{name}_rad")
        if error_rad:
            gain = K_p * a * a * b / ((1j * w + a) ** 2 * (1j * w + b))
            square += 0.5 * np.abs(gain * w * error_rad / (1.0 + gain / (1j * w * path.J))) ** 2
    return math.hypot(K_p * speed_noise(machine, a, path.filter_hz), math.sqrt(float(square.max())))


def quieter(
    machine: MachineFile, path: SpeedPath, K_p: float, tau_max_nm: float, rated_rad_s: float
) -> tuple[float, str]:
    """Return the share of a speed loop's gain that keeps the encoder's torque within bounds, and why it is less."""
    asked_nm, most_nm = encoder_torque(machine, path, K_p, rated_rad_s), TORQUE_SHARE * tau_max_nm
    if asked_nm <= most_nm:
        return 1.0, ""
    from scipy.optimize import brentq

    share = brentq(lambda share: encoder_torque(machine, path, share * K_p, rated_rad_s) - most_nm, 1e-6, 1.0)
    errors = {"noise": "noise", "once": "once per turn", "twice": "twice per turn", "line": "in each line"}
    found = [
        f"{math.degrees(error):.2g} deg {said}" for name, said in errors.items()
        if (error := machine.seen(f"encoder_{name}_rad"))
    ]  # fmt: skip
    return share, (
        f"the speed loop is {1.0 / share:.3g} times slower than its phase margin allows: the encoder "
        f"({', '.join(found)}) would make it ask for {100.0 * asked_nm / tau_max_nm:.3g} % of the largest torque (rms)"
    )


System = tuple[Array, Array, Array, float]
"""A, b, c, d of a single-input single-output system, x(k+1) = A x + b u, y = c x + d u."""


class SpeedMethod(StrEnum):
    """Rule that gives the speed gains."""

    SYMMETRIC_OPTIMUM = "symmetric-optimum"
    POLE_PLACEMENT = "pole-placement"


@dataclass(frozen=True, slots=True)
class SpeedGains:
    """Gains of the speed controller, torque over mechanical speed."""

    K_p: float
    """Proportional gain (N m s/rad)."""
    K_i: float
    """Integral gain (N m/rad)."""
    omega_c: float
    """Crossover (symmetric optimum) or natural frequency (placement) they were designed for (rad/s)."""
    method: SpeedMethod
    """Rule that gave them."""

    def slower(self, share: float) -> SpeedGains:
        """Return gains of the same shape, at this share of the crossover."""
        return replace(self, K_p=share * self.K_p, K_i=share**2 * self.K_i, omega_c=share * self.omega_c)


@dataclass(frozen=True, slots=True)
class Notch:
    """Notch at the controller's period; ``hz`` = 0 is off."""

    hz: float = 0.0
    zeta_num: float = 0.05
    zeta_den: float = 0.5


@dataclass(frozen=True, slots=True)
class SpeedPath:
    """Everything between the speed controller's torque and the speed it sees."""

    J: float
    B: float
    """Inertia (kg m2) and viscous friction (N m s)."""
    current: SampledLoop
    """Loop of the q axis; its closed form is the torque path."""
    decimation: int
    """Control periods per controller period."""
    pll_rad_s: float
    """Natural frequency of the speed estimate (rad/s)."""
    filter_hz: float
    """Cut-off of the first-order feedback filter (Hz)."""
    notch: Notch = Notch()
    """Notch on the torque."""
    shaft: Mechanics | None = None
    """A load behind an elastic shaft; None: rigid."""

    @property
    def T_speed(self) -> float:
        """Period of the speed controller (s)."""
        return self.decimation * self.current.T_s


def small_time_constants(path: SpeedPath, alpha_current: float) -> float:
    """Return T_sum (s): current loop 1/alpha and delay, speed estimate, filter, half the controller's hold."""
    estimate = 2.0 / path.pll_rad_s  # a double pole
    feedback = 1.0 / (2.0 * math.pi * path.filter_hz)
    return 1.0 / alpha_current + path.current.delay_s + estimate + feedback + 0.5 * path.T_speed


def symmetric_optimum(J: float, T_sum: float, a: float) -> SpeedGains:
    """Place the crossover 1 / (a T_sum) at the phase maximum atan(a) - atan(1/a).

    Raises DesignInfeasible: when a <= 1: the crossover would lie beyond the small time constants.
    """
    if a <= 1.0:
        raise DesignInfeasible(
            f"a crossover of {1.0 / (a * T_sum):.4g} rad/s lies beyond the small time constants, {T_sum * 1e3:.3g} ms",
            hint=f"ask for a speed bandwidth below {1.0 / (2.0 * math.pi * T_sum):.3g} Hz, or a faster speed estimate",
        )
    K_p = J / (a * T_sum)
    return SpeedGains(K_p, K_p / (a * a * T_sum), 1.0 / (a * T_sum), SpeedMethod.SYMMETRIC_OPTIMUM)


def symmetric_ratio(phase_margin_rad: float) -> float:
    """Return a with atan(a) - atan(1/a) = phase margin: a = (1 + sin PM) / cos PM."""
    return (1.0 + math.sin(phase_margin_rad)) / math.cos(phase_margin_rad)


def pole_placement(J: float, B: float, omega_n: float, zeta: float) -> SpeedGains:
    """Place J s^2 + (B + K_p) s + K_i: K_p = 2 zeta w_n J - B, K_i = w_n^2 J.

    Raises DesignInfeasible: when friction alone damps more than asked.
    """
    K_p = 2.0 * zeta * omega_n * J - B
    if K_p <= 0.0:
        raise DesignInfeasible(
            f"placing w_n = {omega_n:.4g} rad/s, zeta = {zeta:.3g} needs K_p = {K_p:.4g} N m s/rad",
            likely="the viscous friction is larger than the damping asked for",
            hint=f"ask for w_n above {B / (2.0 * zeta * J):.4g} rad/s",
        )
    return SpeedGains(K_p, omega_n**2 * J, omega_n, SpeedMethod.POLE_PLACEMENT)


def speed_loop(gains: SpeedGains, path: SpeedPath) -> SampledLoop:
    """Return the loop at the controller's period, broken at the torque."""
    T = path.T_speed
    parts = (torque_path(path.current), _mechanics(path), speed_estimate(path), feedback_filter(path))
    num, den = _rational(_lift(_series(*parts), path.decimation))
    for factor_num, factor_den in (
        ((gains.K_p, gains.K_i * T - gains.K_p), (1.0, -1.0)),
        notch_coefficients(path.notch, T),
    ):
        num, den = _product(num, factor_num), _product(den, factor_den)
    return SampledLoop(tuple(num.tolist()), tuple(den.tolist()), T, path.current.delay_s + 0.5 * T)


ELASTIC_PHASE_DEG, ELASTIC_MODULUS = 40.0, 0.4
"""Least phase margin (degree) of the speed loop with an elastic shaft, and least distance of L from -1 over what that
shaft may be: |S| stays below 8 dB."""
_SLOWER, _SLOWER_STEPS = 0.85, 40


def slowed(gains: SpeedGains, paths: Sequence[SpeedPath]) -> SpeedGains:
    """Return gains of the same shape, as slow as all paths, the nominal one first, need to keep their margins.

    Raises DesignInfeasible: none does.
    """
    for k in range(_SLOWER_STEPS):
        slower = gains.slower(_SLOWER**k)
        loops = (speed_loop(slower, path) for path in paths)
        held = all(modulus_margin(loop) >= ELASTIC_MODULUS and margins(loop).stable for loop in loops)
        if held and margins(speed_loop(slower, paths[0])).phase_margin_deg >= ELASTIC_PHASE_DEG:
            return slower
    raise DesignInfeasible(
        "no speed loop keeps its margins with this elastic shaft",
        where="speed loop", hint="ask for a --speed-bandwidth-hz, or correct resonance_hz and antiresonance_hz",
    )  # fmt: skip


POSITION_PHASE_DEG, POSITION_MODULUS, POSITION_GAIN = 60.0, 0.5, 2.0
"""Least phase margin (degree), distance of L from -1 (|S| <= 6 dB) and gain margin of the position loop."""
_FREQUENCIES = 4000
_GAIN_STEP = 0.95


def position_gain(gains: SpeedGains, path: SpeedPath) -> tuple[float, float]:
    """Return the largest gain K_p (1/s) of a position controller above the speed loop, and its crossover (rad/s).

    The loop is the speed loop, reference to position of the shaft, closed over K_p every period of the speed
    controller. It is open-loop stable but for its integrator, so its frequency response decides.
    """
    T = path.T_speed
    omega = np.geomspace(1e-3 * gains.omega_c, 0.999 * math.pi / T, _FREQUENCIES)
    z = np.exp(1j * omega * T)
    speed = speed_loop(gains, path).at(omega)
    integral = companion(np.array([0.5 * path.current.T_s] * 2), np.array([1.0, -1.0]))
    num, den = _rational(_lift(_series(torque_path(path.current), _mechanics(path), integral), path.decimation))
    notch_num, notch_den = notch_coefficients(path.notch, T)
    controller = (gains.K_p + gains.K_i * T / (z - 1.0)) * np.polyval(notch_num, z) / np.polyval(notch_den, z)
    unit = controller * np.polyval(num, z) / np.polyval(den, z) / (1.0 + speed)
    lag_deg = -np.degrees(np.unwrap(np.angle(unit)))
    late = lag_deg >= 180.0 - POSITION_PHASE_DEG
    K_p = float(1.0 / np.abs(unit[late]).max())
    past = lag_deg >= 180.0
    if past.any():
        K_p = min(K_p, float(1.0 / (POSITION_GAIN * np.abs(unit[past]).max())))
    while np.abs(1.0 + K_p * unit).min() < POSITION_MODULUS:
        K_p *= _GAIN_STEP
    return K_p, float(omega[np.abs(K_p * unit) >= 1.0].max(initial=min(K_p, omega[0])))


def notch_coefficients(notch: Notch, T: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return num, den of (s^2 + 2 zeta_num w s + w^2) / (s^2 + 2 zeta_den w s + w^2) by the prewarped bilinear rule."""
    if notch.hz == 0.0:
        return (1.0,), (1.0,)
    g = math.tan(math.pi * notch.hz * T)
    if not 0.0 < notch.hz * T < 0.5:
        raise DesignInfeasible(
            f"a notch at {notch.hz:.4g} Hz is not below half the speed controller's rate, {0.5 / T:.4g} Hz",
            where="speed.notch_hz",
            hint="lower speed.decimation",
        )
    middle = 2.0 * (g * g - 1.0)
    num = (1.0 + 2.0 * notch.zeta_num * g + g * g, middle, 1.0 - 2.0 * notch.zeta_num * g + g * g)
    den = (1.0 + 2.0 * notch.zeta_den * g + g * g, middle, 1.0 - 2.0 * notch.zeta_den * g + g * g)
    return num, den


def torque_path(current: SampledLoop) -> System:
    """Closed current loop, reference to current, from the loop transfer function: L / (1 + L)."""
    return companion(np.asarray(current.num), np.asarray(np.polyadd(current.den, current.num), dtype=np.float64))


def _mechanics(path: SpeedPath) -> System:
    """Torque to speed, torque linear between samples: w(k+1) = a w(k) + b (t(k) + t(k+1)) / 2, b exact."""
    T = path.current.T_s
    if path.shaft is not None and path.shaft.elastic:
        A, torque, c = path.shaft.system()  # its last state is the angle, which the speed does not show
        A, torque, c, d = sampled((A[:-1, :-1], torque[:-1], c[:1, :-1]), T)
        return A, torque, c[0], float(d[0])
    y = path.B * T / path.J
    a = math.exp(-y)
    b = T / path.J * (1.0 if y == 0.0 else -math.expm1(-y) / y)
    return companion(np.array([0.5 * b, 0.5 * b]), np.array([1.0, -a]))


def speed_estimate(path: SpeedPath) -> System:
    """Tracking filter on the sampled position with a double pole at z0 = exp(-w_n T); output w^ after its update.

    e = th - (th^ + T w^), th^ += T w^ + (1 - z0^2) e, w^ += (1 - z0)^2 / T e. The position rises over a period by the
    mean of the speeds at its ends; the part of the later one is moved from the state (th - th^, w^) to the output.
    """
    T = path.current.T_s
    z0 = math.exp(-path.pll_rad_s * T)
    keep, gain = z0 * z0, (1.0 - z0) ** 2 / T
    A = np.array([[keep, -T * keep], [gain, 1.0 - T * gain]])
    half_step = 0.5 * T * np.array([keep, gain])
    return A, A @ half_step + half_step, np.array([0.0, 1.0]), float(half_step[1])


def feedback_filter(path: SpeedPath) -> System:
    """First-order filter behind the speed estimate, backward Euler as in ``firmware/core``."""
    x = 2.0 * math.pi * path.filter_hz * path.current.T_s
    share = x / (1.0 + x)
    return companion(np.array([share, 0.0]), np.array([1.0, share - 1.0]))


def companion(num: Array, den: Array) -> System:
    """Return a controllable realisation of num / den."""
    num = np.concatenate((np.zeros(den.size - num.size), num)) / den[0]
    den = den / den[0]
    order = den.size - 1
    A = np.zeros((order, order))
    A[0] = -den[1:]
    A[np.arange(1, order), np.arange(order - 1)] = 1.0
    b = np.zeros(order)
    b[0] = 1.0
    return A, b, num[1:] - num[0] * den[1:], float(num[0])


def _series(*systems: System) -> System:
    A, b, c, d = systems[0]
    for A2, b2, c2, d2 in systems[1:]:
        n, m = A.shape[0], A2.shape[0]
        joined = np.zeros((n + m, n + m))
        joined[:n, :n], joined[n:, n:], joined[n:, :n] = A, A2, np.outer(b2, c)
        A, b = joined, np.concatenate((b, b2 * d))
        c, d = np.concatenate((d2 * c, c2)), d2 * d
    return A, b, c, d


def _lift(system: System, periods: int) -> System:
    """Hold the input for some periods and look at the output once per hold."""
    A, b, c, d = system
    held = np.zeros_like(b)
    for _ in range(periods):
        held = A @ held + b
    return np.linalg.matrix_power(A, periods), held, c, d


def _rational(system: System) -> tuple[Array, Array]:
    A, b, c, d = system
    den = np.poly(A)
    num = np.poly(A - np.outer(b, c)) + (d - 1.0) * den
    return np.real(num), np.real(den)


def _product(p: Array, q: tuple[float, ...]) -> Array:
    return np.asarray(np.polymul(p, q), dtype=np.float64)
