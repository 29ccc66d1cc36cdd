"""Exact discrete model of one axis at standstill, with a delay that is a real number and a first-order sensor.

    L di/dt = u - v0 - R i,    tau dy/dt = i - y,    u(t) = v[k] on [t_k + D T_s, t_k+1 + D T_s)

sampled at t_k. Computation delay and sampling instant enter only through D, so one number covers both; with D = 1 and
tau = 0 this is i[k+1] = a i[k] + (1 - a)/R (v[k-1] - v0), a = exp(-R T_s/L) (identification reference, 3.2 and its
addendum). The model runs free: no measured current enters it.

A slightly saturated machine bends the response: the measured current is y + c_2 x^2 + c_3 x^3 with x the
distance of y from the bias, so that L stays the incremental inductance *at* the bias whatever the ripple.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
FAST_POLE = 0.6
"""Poles up to this are summed by their impulse response, at most 82 taps."""
BLOCK_LOSS = 7.0
"""Decay over one block of a slow pole (nepers): three decimal digits of the running sum."""
FIRST_SAMPLE = 3
"""First sample that is modelled."""
SMALLEST_RATE = 1e-9
"""R T_s/L below which the limit of a pure inductance is used."""


@dataclass(frozen=True, slots=True)
class AxisModel:
    """Physical parameters of the response.

    Attributes
    ----------
    L_h, R_ohm : float
        Incremental inductance (H) and resistance of the axis at the injection, inverter slope included (ohm).
    delay : float
        Delay D from sample to acting voltage (T_s), 0 <= D.
    lag_s : float
        Time constant of the current sensor (s), 0 for none.
    """

    L_h: float
    R_ohm: float
    delay: float
    lag_s: float


def recursion(pole: float, drive: Vector, start: float) -> Vector:
    """Return x with x[0] = start and x[k+1] = pole x[k] + drive[k]; shape (n + 1,) for drive of shape (n,).

    Slow poles by scaled running sums in blocks that lose at most three digits, fast ones by their short impulse
    response.
    """
    n = len(drive)
    if pole <= FAST_POLE:
        taps = 1 if pole <= 0.0 else min(n, 2 + int(math.log(1e-18) / math.log(max(pole, 1e-300))))
        powers = pole ** np.arange(taps, dtype=np.float64)
        out = np.empty(n + 1)
        out[0] = start
        out[1:] = np.convolve(drive, powers)[:n]
        out[1 : taps + 1] += start * pole ** np.arange(1, min(taps, n) + 1, dtype=np.float64)
        return out
    rate = -math.log(pole)
    block = n if abs(rate) * n < BLOCK_LOSS else max(1, int(BLOCK_LOSS / abs(rate)))
    blocks = -(-n // block)
    padded = np.zeros(blocks * block)
    padded[:n] = drive
    decay = np.exp(-rate * np.arange(block + 1, dtype=np.float64))
    forced = np.cumsum(padded.reshape(blocks, block) / decay[1:], axis=1) * decay[1:]
    out = np.empty(blocks * block + 1)
    out[0] = carry = start
    for index in range(blocks):
        part = forced[index] + carry * decay[1:]
        out[index * block + 1 : (index + 1) * block + 1] = part
        carry = float(part[-1])
    return out[: n + 1]


def acting_voltages(command: Vector, delay: float) -> tuple[Vector, Vector, float]:
    """Split the voltage acting between two samples into its two constant parts.

    Parameters
    ----------
    command : ndarray, shape (n,)
        Voltage computed at each sample (V).
    delay : float
        Delay D >= 0 (T_s).

    Returns
    -------
    early, late : ndarray, shape (n - first,)
        Commands acting in the first and the second part of the interval from sample k, k = first ... n - 1; ``first``
        is :data:`FIRST_SAMPLE` for every delay below it, so that a fit sees no step where D crosses a whole number.
    fraction : float
        Length of the first part (T_s).
    """
    whole = math.floor(delay)
    fraction = delay - whole
    first = max(whole + 1, FIRST_SAMPLE)
    n = len(command)
    early = command[first - whole - 1 : n - whole - 1]
    late = command[first - whole : n - whole]
    return early, late, fraction


def _advance(model: AxisModel, h: float) -> tuple[float, float, float, float, float]:
    """Coefficients of one step of length h: i' = a i + b u, y' = e y + c i + d u."""
    rate = model.R_ohm / model.L_h
    if abs(rate * h) < SMALLEST_RATE:
        a, b = 1.0, h / model.L_h
        conductance_ratio = 0.0
    else:
        a = math.exp(-rate * h)
        b = -math.expm1(-rate * h) / model.R_ohm
        conductance_ratio = 1.0 / model.R_ohm
    if model.lag_s <= 0.0:
        return a, b, 0.0, a, b
    mu = 1.0 / model.lag_s
    e = math.exp(-mu * h)
    if conductance_ratio == 0.0:
        c = -math.expm1(-mu * h)
        return a, b, e, c, (h + math.expm1(-mu * h) / mu) / model.L_h
    c = mu * (a - e) / (mu - rate)
    return a, b, e, c, (1.0 - e - c) * conductance_ratio


def respond(model: AxisModel, command: Vector, period_s: float, start_a: float) -> Vector:
    """Measured current from the first modelled sample on, shape (n - first + 1,), in equilibrium at ``start_a``.

    Parameters
    ----------
    model : AxisModel
        Parameters.
    command : ndarray, shape (n,)
        Voltage computed at each sample minus its constant part (V).
    period_s : float
        Control period (s).
    start_a : float
        Current and sensor output at the first modelled sample (A).
    """
    early, late, fraction = acting_voltages(command, model.delay)
    a_1, b_1, e_1, c_1, d_1 = _advance(model, fraction * period_s)
    a_2, b_2, e_2, c_2, d_2 = _advance(model, (1.0 - fraction) * period_s)
    # i after both parts, then y after both parts with the current in between eliminated
    current = recursion(a_1 * a_2, a_2 * b_1 * early + b_2 * late, start_a)
    if model.lag_s <= 0.0:
        return current
    inside = a_1 * current[:-1] + b_1 * early
    forced = e_2 * (c_1 * current[:-1] + d_1 * early) + c_2 * inside + d_2 * late
    return recursion(e_1 * e_2, forced, start_a)


def bend(
    x: NDArray[np.float64], c_2: float | NDArray[np.float64], c_3: float | NDArray[np.float64]
) -> NDArray[np.float64]:
    """What saturation adds to a current x about the bias (A)."""
    return np.asarray(x * x * (c_2 + c_3 * x), dtype=np.float64)
