# SPDX-License-Identifier: MIT
"""The machine in steady operation as the tracking filter sees it: observations, and the voltages they should show.

Observation k is a window in which the machine ran steadily (s = sinc(omega T_s / 2), the exact sampled-data factor of
a drive that advances its voltage, docs/identification.md, 3.4):

    u_d = R i_d - s omega L_q i_q + k e_d + h f_d + L_d di_d/dt
    u_q = R i_q + s omega (psi + L_d i_d) + k e_q + h f_q + L_q di_q/dt

e is the inverter's mean error of the identified curve, of which the recorded voltage contains the share k. A curve of
another shape differs by a tail f that falls with 1/i, as thresholds and output capacitances leave it, of unknown share
h; a resistance is nearest to it. omega is that of the drive and lags: omega + t domega/dt.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.estimators.flux.linkage_rows import mean_inverter_error
from pmsmtool.estimators.inverter_error import InverterCurve
from pmsmtool.trace import Trace

SIGNALS = ("u_d_v", "u_q_v", "i_d_a", "i_q_a", "omega_e_rad_s")
"""What an observation is made of; ``T_winding_c`` is kept beside it where it is recorded."""
STATES = ("R_s_ohm", "psi_f_wb", "inverter error", "L_d_h", "L_q_h", "inverter tail", "speed lag")
TRACKED = ("R_s_ohm", "psi_f_wb")

RISES = {"d_rise_a": ("i_d_a", "A"), "q_rise_a": ("i_q_a", "A"), "omega_rise_rad_s": ("omega_e_rad_s", "rad/s")}
"""Rises over a window, of what and in what."""
LIMITED = "limited"
"""Column of :func:`windows`: 1 where a voltage or a current was limited."""

PRIOR = {"R_s_ohm": 0.30, "psi_f_wb": 0.10}
"""Relative standard deviation at the start: what the temperature may have done since identification."""
INDUCTANCE_STD = 0.02
"""Least relative standard deviation of an inductance away from its bias point."""
LAG_UNIT_S = 1e-3
LAG_STD = 5.0
"""Standard deviation of the lag of the drive's speed, in that unit: its filter is not known. Without it 1 to 4 times
L di/dt was left in u_q while the speed settled, on each of 17 random drives of the second profile."""
TAIL_RATIO = 1.0
"""Doubt of the tail of the inverter's error over that of its size."""
STEADY = 0.05
NOISY = 5.0
"""Largest change of a current or the speed within a window, of the largest there is: transients are left out. What is
only noise (a machine at rest) is told by the median change times the second."""
ACROSS, ALONG = 12.0 / 35.0, 2.0 / 35.0
"""Sixth harmonic of a square phase error in the frame of its fundamental: the difference and sum of 1/5 and 1/7."""


@dataclass(frozen=True, slots=True)
class Known:
    """What is known of the machine before."""

    R_s_ohm: float
    psi_f_wb: float
    L_d_h: float
    L_q_h: float
    """Values to start from; inductances are apparent ones."""
    T_s: float
    """Control period (s)."""
    L_std: tuple[float, float] = (INDUCTANCE_STD, INDUCTANCE_STD)
    """Relative standard deviations of the inductances."""
    curve: InverterCurve | None = None
    """Error of one phase."""
    error_share: tuple[float, float] = (1.0, 0.1)
    """Mean and standard deviation of the part of the curve that the recorded voltage contains: (1, 0.1) without
    a compensation, (0, 0.2) when the drive compensates it."""

    @property
    def scale(self) -> Array:
        """Unit of each state."""
        return np.array([self.R_s_ohm, self.psi_f_wb, 1.0, self.L_d_h, self.L_q_h, 1.0, LAG_UNIT_S])

    @property
    def start(self) -> Array:
        """States at the start, in their units."""
        return np.array([1.0, 1.0, self.error_share[0], 1.0, 1.0, 0.0, 0.0])

    @property
    def start_std(self) -> Array:
        """Their standard deviations."""
        share = max(self.error_share[1], 1e-6)
        return np.array([PRIOR["R_s_ohm"], PRIOR["psi_f_wb"], share, *self.L_std, TAIL_RATIO * share, LAG_STD])


# ---- observations ---------------------------------------------------------------------------------------------


def windows(trace: Trace, rows: int, period_s: float | None = None) -> Trace:
    """Return means and rises over all windows of ``rows``; :data:`LIMITED` tells in which something was limited.

    Raises ValueError: the trace lacks a signal of :data:`SIGNALS`.

    Parameters
    ----------
    trace : Trace
        Rows without a gap.
    rows : int
        Length of a window.
    period_s : float, optional
        Time from row to row; default: the trace's.
    """
    missing = [name for name in SIGNALS if name not in trace.signals]
    if missing:
        raise ValueError(f"the trace has no {', '.join(missing)}")
    count = len(trace) // rows

    def blocks(column: Array) -> Array:
        return column[: count * rows].reshape(count, rows)

    names = [*SIGNALS, *(["T_winding_c"] if "T_winding_c" in trace.signals else [])]
    flags = trace.signals.get("flags", np.zeros(len(trace)))
    columns = {name: blocks(trace[name]).mean(axis=1) for name in names}
    columns |= {name: _rise(blocks(trace[signal])) for name, (signal, _) in RISES.items()}
    columns[LIMITED] = np.any(blocks(flags) != 0.0, axis=1).astype(float)
    units = {name: trace.units[name] for name in names} | {name: unit for name, (_, unit) in RISES.items()}
    window_s = rows * (trace.period_s if period_s is None else period_s)
    meta = {**trace.meta, "window_s": window_s, "rows": rows}
    return Trace(blocks(trace.t_s).mean(axis=1), columns, {**units, LIMITED: "1"}, meta)


def steady(parts: Sequence[Trace]) -> list[Trace]:
    """Return of each part the windows in which nothing was limited and the machine ran steadily.

    What is steady is measured by the largest current and speed of all parts: a part alone may hold nothing but a
    transient, whose noise it would be taken for.

    ``parts``: as :func:`windows` returns them, each without a gap.
    """
    size = {name: np.concatenate([np.zeros(0), *(part[name] for part in parts)]) for name in SIGNALS}
    rise = {name: np.concatenate([np.zeros(0), *(np.abs(part[name]) for part in parts)]) for name in RISES}
    largest = float(np.max(np.hypot(size["i_d_a"], size["i_q_a"]), initial=0.0))
    fastest = float(np.max(np.abs(size["omega_e_rad_s"]), initial=0.0))
    scale = {"d_rise_a": largest, "q_rise_a": largest, "omega_rise_rad_s": fastest}
    limit = {n: max(STEADY * scale[n], NOISY * float(np.median(r)) if len(r) else 0.0) for n, r in rise.items()}
    return [_kept(part, _calm(part, limit) & (part[LIMITED] == 0.0)) for part in parts]


def _calm(part: Trace, limit: Mapping[str, float]) -> NDArray[np.bool_]:
    """Whether currents and speed changed little within each window, and within the one before."""
    calm = np.ones(len(part), dtype=bool)
    for name in RISES:
        small = np.abs(part[name]) <= limit[name]
        calm &= small
        calm[1:] &= small[:-1]
    return calm


def _kept(part: Trace, keep: NDArray[np.bool_]) -> Trace:
    names = [name for name in part.signals if name != LIMITED]
    return Trace(part.t_s[keep], {n: part[n][keep] for n in names}, {n: part.units[n] for n in names}, part.meta)


def _rise(block: Array) -> Array:
    """Rise over each window, from the means of its halves."""
    half = max(1, block.shape[1] // 2)
    return np.asarray(2.0 * (block[:, -half:].mean(axis=1) - block[:, :half].mean(axis=1)))


def inputs(observations: Trace, known: Known) -> Array:
    """Columns i_d, i_q, s omega, e_d, e_q, slopes of both currents and of the speed, f_d, f_q, shape (n, 10)."""
    i_d, i_q, omega = (observations[name] for name in ("i_d_a", "i_q_a", "omega_e_rad_s"))
    e_d = e_q = f_d = f_q = np.zeros_like(i_d)
    if known.curve is not None:
        e_d, e_q = mean_inverter_error(known.curve, (i_d, i_q))
        f_d, f_q = mean_inverter_error(tail_of(known.curve), (i_d, i_q))
    window = float(observations.meta.get("window_s", 0.0))
    rises = [observations[name] / window if window and name in observations.signals else 0.0 * i_d for name in RISES]
    return np.column_stack([i_d, i_q, omega * np.sinc(omega * known.T_s / (2.0 * np.pi)), e_d, e_q, *rises, f_d, f_q])


def tail_of(curve: InverterCurve) -> InverterCurve:
    """Return the curve's tail: itself below the current of its half height, falling with 1/i far above."""
    i, u = curve.i_phase_a, curve.u_error_v
    half = float(i[int(np.argmax(np.abs(u) >= 0.5 * np.max(np.abs(u))))])
    return InverterCurve(i, u * half / (i + half), 0.0)


def ripple_v(observations: Trace, given: Array) -> Array:
    """Amplitude of the inverter error's sixth harmonic that the windows leave in u_d and u_q (V), shape (n, 2).

    Six steps of a phase error of fundamental e ripple by 12/35 e across the current and 2/35 e along it; the mean over
    n rows keeps |sin(n x)/(n sin x)| of it, x half its step between two rows. A slow machine's windows are a part of a
    period. Without the number of rows, as earlier observations are, zero.
    """
    rows = int(observations.meta.get("rows", 0))
    if not rows:
        return np.zeros((len(given), 2))
    i_d, i_q, _, e_d, e_q = given.T[:5]
    x = 3.0 * observations["omega_e_rad_s"] * float(observations.meta["window_s"]) / rows
    bottom = rows * np.sin(x)
    flat = np.abs(bottom) < 1e-9
    left = np.where(flat, 1.0, np.abs(np.sin(rows * x) / np.where(flat, 1.0, bottom)))
    size = np.hypot(e_d, e_q) * left / np.maximum(np.hypot(i_d, i_q), 1e-12)
    return np.column_stack([size * np.hypot(ACROSS * i_q, ALONG * i_d), size * np.hypot(ACROSS * i_d, ALONG * i_q)])


def model_voltage(x: Array, given: Array, scale: Array) -> Array:
    """Voltages of the model (V), shape (2,)."""
    R, psi, k, L_d, L_q, h, lag = x * scale
    i_d, i_q, omega, e_d, e_q, rise_d, rise_q, rise_omega, f_d, f_q = given
    omega = omega + lag * rise_omega
    return np.array(
        [
            R * i_d - omega * L_q * i_q + k * e_d + h * f_d + L_d * rise_d,
            R * i_q + omega * (psi + L_d * i_d) + k * e_q + h * f_q + L_q * rise_q,
        ]
    )


def model_slopes(given: Array, scale: Array) -> Array:
    """Derivative of the voltages with respect to the states where the lag is none, shape (2, 7)."""
    i_d, i_q, omega, e_d, e_q, rise_d, rise_q, rise_omega, f_d, f_q = given
    _, psi, _, L_d, L_q, _, _ = scale
    d = np.array([i_d, 0.0, e_d, rise_d, -omega * i_q, f_d, -rise_omega * L_q * i_q])
    q = np.array([i_q, omega, e_q, omega * i_d, rise_q, f_q, rise_omega * (psi + L_d * i_d)])
    return np.asarray(np.stack([d, q]) * scale)
