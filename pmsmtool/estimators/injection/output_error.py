# SPDX-License-Identifier: MIT
"""Exact discrete model of one axis at standstill, with a delay that is a real number and a first-order sensor.

    L di/dt = u - v0 - R i,    tau dy/dt = i - y,    u(t) = v[k] on [t_k + D T_s, t_k+1 + D T_s)

sampled at t_k. A bridge applies v[k] as two pulses around a quarter and three quarters of its period with nothing
between them (``Pulses``): a sample that is late inside the zero vector sees no voltage, where a mean voltage would move
it by u d T_s/L. Computation delay and sampling instant enter only through D, so one number covers both; with D = 1 and
tau = 0 this is i[k+1] = a i[k] + (1 - a)/R (v[k-1] - v0), a = exp(-R T_s/L) (docs/identification.md, 3.2).
The model runs free: no measured current enters it.

A slightly saturated machine bends the response: the measured current is y + c_2 x^2 + c_3 x^3 with x the
distance of y from the bias, so that L stays the incremental inductance *at* the bias whatever the ripple.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array

FIRST_SAMPLE = 3
"""First sample that is modelled."""
PULSE_CENTRES = (0.25, 0.75)
PULSES_EACH = 0.5
"""Middles of the two pulses in a period of centre-aligned modulation, and the part of the command that each carries."""
PULSE_EDGES = np.array([[c, side * PULSES_EACH] for c in PULSE_CENTRES for side in (-0.5, 0.5)])
WIDTH_NODES = np.cos(math.pi * (np.arange(5) + 0.5) / 5.0)
WIDTHS_TO_POWERS = np.linalg.inv(np.vander(WIDTH_NODES, increasing=True))
"""Widths in -1 ... 1 at which the effect of a pulse is calculated, and what makes a polynomial of it (measured: 1e-9 of
the effect)."""
LEAST_SPREAD = 1e-6
"""Spread of the widths below which they are calculated one by one (1)."""


@dataclass(frozen=True, slots=True)
class AxisModel:
    """Physical parameters of the response."""

    L_h: float
    R_ohm: float
    """Incremental inductance (H) and resistance of the axis at the injection, inverter slope included (ohm)."""
    delay: float
    """Delay D from sample to acting voltage (T_s), 0 <= D."""
    lag_s: float
    """Time constant of the current sensor (s), 0 for none."""
    eddy_s: float = 0.0
    eddy_tau_s: float = 1.0
    """Eddy currents add ``eddy_s``/(L tau) of the flux that a first order of time constant tau lags behind; iron loss
    is a tau far below the period (s)."""

    @property
    def flux_inductance_h(self) -> float:
        """Inductance of the flux alone (H): what eddy currents drop over R makes ``L_h`` larger.

        A branch across the flux behind R has an admittance of two poles, those of this model: Y = 1/(R + s L) +
        g/(1 + s tau) with g = ``eddy_s``/L. The flux's inductance is the slope of 1/Y at s = 0.
        """
        shunt = self.eddy_s / self.L_h
        return (self.L_h + shunt * self.eddy_tau_s * self.R_ohm**2) / (1.0 + shunt * self.R_ohm) ** 2

    def fall(self, omega_rad_s: float) -> float:
        """Part of that inductance which is not seen at an angular frequency (1)."""
        s = 1j * omega_rad_s
        Y = 1.0 / (self.R_ohm + s * self.L_h) + self.eddy_s / self.L_h / (1.0 + s * self.eddy_tau_s)
        return 1.0 - (1.0 / Y).imag / omega_rad_s / self.flux_inductance_h

    def advance(self, h: float) -> tuple[float, float, float, float, float]:
        """Coefficients of one step of length h: i' = a i + b u, y' = e y + c i + d u."""
        rate = self.R_ohm / self.L_h
        a, (b, d) = math.exp(-rate * h), _stepped(self, np.array(h)).tolist()
        if self.lag_s <= 0.0:
            return a, b, 0.0, a, d
        mu = 1.0 / self.lag_s
        e = math.exp(-mu * h)
        return a, b, e, mu * (a - e) / (mu - rate), d


@dataclass(frozen=True, slots=True, eq=False)
class Pulses:
    """The commands as the bridge applies them."""

    share: Array
    """Part of the period during which the command's two pulses stand (1). Shape (n,)."""
    height_v: Array
    """Their voltage (V). Shape (n,)."""
    rest_v: float
    """Constant voltage beside them (V): minus the mean of the commands."""


def recursion(
    pole: float | NDArray[np.float64], drive: NDArray[np.float64], start: float | Array
) -> NDArray[np.float64]:
    """Return x with x[0] = start and x[k+1] = pole x[k] + drive[k] along the last axis, shape (..., n + 1).

    ``pole`` is a number, or a column (m, 1) beside rows of drives, shape (m, n), with m starts or one. A bidiagonal
    system: the bits of ``scipy.signal.lfilter`` in half its time, and without the 0.6 s that its import takes.
    """
    from scipy.linalg.lapack import dtbtrs

    x = np.empty((*drive.shape[:-1], drive.shape[-1] + 1))
    x[..., 0], x[..., 1:] = start, drive
    bands = np.ones((*x.shape, 2))
    bands[..., 1] = -pole
    bands[..., -1, 1] = 0.0  # the next row begins afresh
    solved, _ = dtbtrs(bands.reshape(-1, 2).T, x.reshape(-1), uplo="L", diag="U", overwrite_b=1)
    return np.asarray(solved).reshape(x.shape)


def acting_voltages(command: Array, delay: float) -> tuple[Array, Array, float]:
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


def respond(
    models: Sequence[AxisModel], command: Array, period_s: float, start_a: Array, pulses: Pulses | None = None
) -> NDArray[np.float64]:
    """Measured currents from the first modelled sample on, shape (m, n - first + 1), in equilibrium at ``start_a``.

    Parameters
    ----------
    models : sequence of AxisModel
        Parameters; the delays have the same whole part, and all have a lag or none.
    command : ndarray, shape (n,)
        Voltage computed at each sample minus its constant part (V).
    period_s : float
        Control period (s).
    start_a : ndarray, shape (m,)
        Current and sensor output at the first modelled sample (A).
    pulses : Pulses or None
        How the bridge applies the commands; None: as their mean.
    """
    if pulses is not None:
        return _respond_to_pulses(models, pulses, period_s, start_a)
    early, late, _ = acting_voltages(command, models[0].delay)
    fractions = [model.delay - math.floor(model.delay) for model in models]
    pairs = list(zip(models, fractions, strict=True))
    a_1, b_1, e_1, c_1, d_1 = _columns([model.advance(part * period_s) for model, part in pairs])
    a_2, b_2, e_2, c_2, d_2 = _columns([model.advance((1.0 - part) * period_s) for model, part in pairs])
    # i after both parts, then y after both parts with the current in between eliminated
    current = recursion(a_1 * a_2, a_2 * b_1 * early + b_2 * late, start_a)
    if models[0].lag_s <= 0.0:
        return current
    inside = a_1 * current[:, :-1] + b_1 * early
    forced = e_2 * (c_1 * current[:, :-1] + d_1 * early) + c_2 * inside + d_2 * late
    return recursion(e_1 * e_2, forced, start_a)


def _columns(rows: Sequence[tuple[float, ...]]) -> NDArray[np.float64]:
    """Return coefficients of models as columns beside their responses, shape (k, m, 1)."""
    return np.array(rows).T[..., np.newaxis]


def eddy_current(model: AxisModel, command: Array, period_s: float) -> Array:
    """Current of the eddy branch (A) at the samples of :func:`respond`: flux, less what has got through, over L.

    The voltage counts as constant over each command's period, and its resistive part as none of it.
    """
    early, late, fraction = acting_voltages(command, model.delay)
    tau = model.eddy_tau_s
    decay_1, decay_2 = (math.exp(-h * period_s / tau) for h in (fraction, 1.0 - fraction))
    # the slope's mean over tau, with a weight of 1 for a voltage that stands
    slope = recursion(decay_1 * decay_2, decay_2 * (1.0 - decay_1) * early + (1.0 - decay_2) * late, 0.0)
    return np.asarray(slope * (model.eddy_s / model.L_h))


def _respond_to_pulses(
    models: Sequence[AxisModel], pulses: Pulses, period_s: float, start_a: Array
) -> NDArray[np.float64]:
    """As :func:`respond`, every edge of a pulse at its own time."""
    early_v, late_v, _ = acting_voltages(pulses.height_v, models[0].delay)
    early_w, late_w, _ = acting_voltages(pulses.share, models[0].delay)
    a, b, e, c, d = _columns([model.advance(period_s) for model in models])
    forced = np.array([b, d]) * np.full(len(early_v), pulses.rest_v)
    for k, model in enumerate(models):
        begun = 1.0 - (model.delay - math.floor(model.delay))  # of the early command's period, at the sample
        for height, share, gone in ((early_v, early_w, begun), (late_v, late_w, begun - 1.0)):
            forced[:, k] += height * _charged(model, share, gone, period_s)
    current = recursion(a, forced[0], start_a)
    if models[0].lag_s <= 0.0:
        return current
    return recursion(e, c * current[:, :-1] + forced[1], start_a)


def _charged(model: AxisModel, share: Array, gone: float, period_s: float) -> NDArray[np.float64]:
    """Current and sensor output at an interval's end per volt of two pulses, shape (2, n).

    The interval begins ``gone`` periods after the pulses' own period. What a pulse does depends smoothly on its width
    as long as no end of the interval cuts it: a polynomial through a few widths then serves all of them.
    """
    low, high = float(np.min(share)), float(np.max(share))
    reach = 0.5 * PULSES_EACH * high
    if all(abs(centre - gone - 0.5) >= 0.5 + reach for centre in PULSE_CENTRES):
        return np.zeros((2, len(share)))
    cut = [abs(centre - gone - end) < reach for centre in PULSE_CENTRES for end in (0.0, 1.0)]
    if any(cut) or high - low < LEAST_SPREAD:
        return _charged_exactly(model, share, gone, period_s)
    middle, half = 0.5 * (high + low), 0.5 * (high - low)
    coefficients = WIDTHS_TO_POWERS @ _charged_exactly(model, middle + half * WIDTH_NODES, gone, period_s).T
    x = (share - middle) / half
    out = np.tile(coefficients[-1][:, None], (1, len(x)))
    for row in coefficients[-2::-1]:
        out *= x
        out += row[:, None]
    return out


def _charged_exactly(model: AxisModel, share: Array, gone: float, period_s: float) -> NDArray[np.float64]:
    # rising and falling edges from the sample on, in periods: the interval is 0 ... 1
    edges = PULSE_EDGES[:, :1] + PULSE_EDGES[:, 1:] * share - gone
    risen = _stepped(model, (1.0 - np.clip(edges, 0.0, 1.0)) * period_s)
    return np.asarray(risen[:, 0] - risen[:, 1] + risen[:, 2] - risen[:, 3])


def _stepped(model: AxisModel, t_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Current and sensor output a time after a voltage of 1 V began, shape (2, ...)."""
    out = np.empty((2, *t_s.shape))
    rate = model.R_ohm / model.L_h
    out[0] = -np.expm1(-rate * t_s) / model.R_ohm if model.R_ohm else t_s / model.L_h
    if model.lag_s <= 0.0:
        out[1] = out[0]
        return out
    mu = 1.0 / model.lag_s
    # i and the lag's own exponential make y
    out[1] = (mu * out[0] + np.expm1(-mu * t_s) / model.L_h) / (mu - rate)
    return out


def bend(
    x: NDArray[np.float64], c_2: float | NDArray[np.float64], c_3: float | NDArray[np.float64]
) -> NDArray[np.float64]:
    """What saturation adds to a current x about the bias (A)."""
    return np.asarray(x * x * (c_2 + c_3 * x), dtype=np.float64)
