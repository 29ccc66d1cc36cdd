# SPDX-License-Identifier: MIT
"""The windows of a speed run as the flux estimator needs them: paired, gated, and without what is known."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.estimators.injection.sampling_instant import Sampling, course_s2, sampled_ripple
from pmsmtool.estimators.inverter_error import InverterCurve, Modulation, rippled_error_dq_v
from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace

STAGE = "flux linkage"

MINIMUM_PAIRS = 4
"""Pairs of d currents in each direction."""
SPEED_RATIO = 1.6
"""Largest over smallest speed below which delay and offset are one."""
PAIR_RATIO = 1.2
"""Ratio of two d currents of opposite sign up to which they are one level."""
Q_SHARE = 3.0
"""Part of i_d up to which a window holds a d current: beside it a q current may keep the speed against friction."""
CURRENT_SETTLE_LIMIT = 0.25
"""Change of a current between the halves of a window, of the largest current."""
SETTLE_LIMIT = 0.4
"""Relative change of the speed between the halves of a window: the shaft coasts, but slowly."""
DELAY_PERIODS = 1.5
"""Periods from the samples of a row to the middle of its voltage."""
STOPPED = "a speed limit too low for the shaft to coast through a window, or a load or friction that stops it"
STOPPED_STEP = "allow more speed (--speed-max), or take away what brakes the shaft; R, L and inverter do without it"
ANGLES = 60
"""Angles over which an error is averaged: a sixth of a turn, after which three equal phases repeat."""


@dataclass(frozen=True, slots=True)
class Corrected:
    """Rows without resistance and inverter error."""

    w: Array
    acceleration_rad_s2: Array
    """Electrical speed at the time of the voltage, and its slope. Shape (n,)."""
    i_d: Array
    i_q: Array
    """Mean currents (A). Shape (n,)."""
    u_d: Array
    u_q: Array
    """Voltage of the flux linkages (V). Shape (n,)."""
    ripple_q_v: Array
    curve_q_v: Array
    """q parts of the error that was taken off: of the ripple, and of the sampled current (V). Shape (n,)."""
    error_d_v: Array
    """Its d part (V). Shape (n,)."""
    is_d: NDArray[np.bool_]
    """Rows with a d current. Shape (n,)."""


def pairs_of(speeds: Trace) -> list[tuple[int, int]]:
    """Return the rows that follow each other with d currents of one size and opposite signs."""
    i_d, i_q, w = speeds["i_d_a"], speeds["i_q_a"], speeds["omega_e_rad_s"]
    pairs = []
    k = 0
    while k + 1 < len(w):
        sizes = sorted((abs(float(i_d[k])), abs(float(i_d[k + 1]))))
        quiet = max(abs(float(i_q[k])), abs(float(i_q[k + 1]))) < Q_SHARE * sizes[0]
        if quiet and i_d[k] * i_d[k + 1] < 0.0 and w[k] * w[k + 1] > 0.0 and sizes[1] < PAIR_RATIO * sizes[0]:
            pairs.append((k, k + 1))
            k += 1
        k += 1
    return pairs


def fastest_pair(speeds: Trace) -> tuple[int, int]:
    """Return the rows of the run's highest speed that hold i_d with both signs, one after the other.

    A shaft that does not coast through a window is driven through some at a higher speed; those hold i_q. Without a
    pair, which no estimate takes, the first two rows.
    """
    return max(pairs_of(speeds), key=lambda rows: float(speeds["omega_e_rad_s"][rows[0]]), default=(0, 1))


def corrected(
    speeds: Trace,
    R_ohm: float,
    period_s: float,
    inverter: InverterCurve | None,
    modulation: Modulation | None,
    lag_s: float,
    sampling: Sampling | None = None,
) -> Corrected:
    """Take off what is known: lag of the speed, resistance, inverter error, and sampling.

    Resistance and error follow the mean current and the one at the period's start; the flux linkages are those of the
    start, at which the rotor's angle is read. Without a ``sampling`` the samples are taken for those of the start.
    """
    i_d, i_q = speeds["i_d_a"], speeds["i_q_a"]
    acceleration = (speeds["omega_second_rad_s"] - speeds["omega_first_rad_s"]) / speeds["half_s"]
    w = speeds["omega_e_rad_s"] + (lag_s + DELAY_PERIODS * period_s) * acceleration
    voltage = (speeds["u_d_v"], speeds["u_q_v"])
    mean = np.stack([i_d, i_q])
    at_start = np.zeros((2, len(w)))
    course_wb = np.zeros_like(w)
    flux = float(np.median(voltage[1] / w))
    # the drive turns the voltage by the delay times a speed that is old
    turned_rad = DELAY_PERIODS * period_s * lag_s * acceleration
    if modulation is not None:
        sampling = sampling or Sampling()
        course = 0.5 * w**2 * flux * course_s2(sampling, period_s)
        course_at_start = 0.5 * w**2 * flux * course_s2(Sampling(), period_s)
        course_wb = course - course_at_start
        mean = mean - sampled_ripple(voltage, (i_d, i_q), modulation, sampling)
        mean[0] -= course / modulation.L_h[0]
        at_start = sampled_ripple(voltage, (i_d, i_q), modulation, Sampling())
        at_start[0] += course_at_start / modulation.L_h[0]
    plain = shifted = rippled = np.zeros((2, len(w)))
    if inverter is not None:
        plain = shifted = rippled = mean_inverter_error(inverter, (i_d, i_q))
        if modulation is not None:
            start = mean + at_start
            shifted = mean_inverter_error(inverter, (start[0], start[1]))
            rippled = mean_inverter_error(inverter, (start[0], start[1]), voltage, modulation)
    x = 0.5 * w * period_s
    correction = x / np.sin(x)
    return Corrected(
        w=w,
        acceleration_rad_s2=acceleration,
        i_d=i_d,
        i_q=i_q,
        u_d=(voltage[0] - rippled[0] - R_ohm * mean[0]) * correction + turned_rad * w * flux,
        u_q=(voltage[1] - rippled[1] - R_ohm * mean[1]) * correction + w * course_wb,
        ripple_q_v=rippled[1] - shifted[1],
        curve_q_v=plain[1],
        error_d_v=rippled[0],
        is_d=np.abs(i_q) < Q_SHARE * np.abs(i_d),
    )


def mean_inverter_error(
    curve: InverterCurve,
    current: tuple[Array, Array],
    voltage: tuple[Array, Array] | None = None,
    modulation: Modulation | None = None,
) -> NDArray[np.float64]:
    """Mean of the three-phase error over one electrical turn in the rotor frame (V), shape (2, n).

    Parameters
    ----------
    curve : InverterCurve
        Error of one phase.
    current, voltage : (ndarray, ndarray)
        d and q means of every window (A, V), shape (n,).
    modulation : Modulation or None
        With a voltage: the ripple at the switching edges counts.
    """
    n = len(current[0])
    angle = np.tile((np.arange(ANGLES) + 0.5) * (math.pi / 3.0 / ANGLES), n)
    i_d, i_q = (np.repeat(part, ANGLES) for part in current)
    if voltage is not None and modulation is not None:
        v_d, v_q = (np.repeat(part, ANGLES) for part in voltage)
        error = rippled_error_dq_v(curve, (i_d, i_q), (v_d, v_q), angle, modulation)
    else:
        error = curve.error_dq_v(i_d, i_q, angle)
    return np.asarray(np.stack(error).reshape(2, n, ANGLES).mean(axis=2))


def usable(speeds: Trace) -> tuple[Trace, str]:
    """Return the windows in which nothing was limited or moved, of two with d currents of both signs both or none.

    And a word about the others: an encoder's error turns the frame, and moves currents within a part of a turn.
    """
    limited = speeds["flagged"] > 0.0 if "flagged" in speeds.signals else np.zeros(len(speeds), bool)
    moved = np.any([change > limit for change, limit, *_ in _changes(speeds)], axis=0)
    left_out = limited | moved
    for pair in map(list, pairs_of(speeds)):
        left_out[pair] = np.any(left_out[pair])
    whys = ("limited by voltage or current",) * bool(np.any(limited)) + ("not settled",) * bool(np.any(moved))
    told = f"{np.sum(left_out)} of {len(speeds)} windows left out, {' or '.join(whys)}" if whys else ""
    return speeds.rows(~left_out), told


def check_speeds(speeds: Trace, pairs: Sequence[tuple[int, int]], whole: Trace) -> None:
    """Refuse a run whose usable windows have too few pairs or speeds, by what the ``whole`` run shows.

    Raises IdentificationError: ``E_EXCITATION``, ``E_CLIPPED``, ``E_NOT_SETTLED``.
    """
    w = speeds["omega_e_rad_s"]
    for sign, name in ((1.0, "forward"), (-1.0, "backward")):
        mine = np.array([abs(w[k]) for k, _ in pairs if np.sign(w[k]) == sign])
        if len(mine) >= MINIMUM_PAIRS and float(np.max(mine)) >= SPEED_RATIO * float(np.min(mine)):
            continue
        limited = np.sum(whole["flagged"] > 0.0) if "flagged" in whole.signals else 0
        if limited:
            raise refuse("E_CLIPPED", f"voltage or current limited in {limited} windows", stage=STAGE)
        for change, limit, what, unit, likely, hint in _changes(whole):
            worst = int(np.argmax(change))
            if change[worst] > limit:
                told = f"{what} moves by {change[worst]:.2g} {unit} in one window, limit {limit:.2g} {unit}"
                where = f"at {whole['omega_e_rad_s'][worst]:.4g} rad/s {told}"
                raise refuse("E_NOT_SETTLED", where, stage=STAGE, likely=likely, hint=hint)
        raise refuse(
            "E_EXCITATION",
            f"{len(mine)} pairs of d currents {name}; {MINIMUM_PAIRS} over speeds of {SPEED_RATIO:g} to 1 are needed",
            stage=STAGE,
        )


def _changes(speeds: Trace) -> list[tuple[Array, float, str, str, str, str]]:
    """Return the changes between the halves of the windows, their limit, name, unit, likely cause and next step."""
    speed = np.abs(speeds["omega_second_rad_s"] - speeds["omega_first_rad_s"]) / np.abs(speeds["omega_e_rad_s"])
    limit = CURRENT_SETTLE_LIMIT * float(np.max(np.hypot(speeds["i_d_a"], speeds["i_q_a"])))
    currents = [
        (np.abs(speeds[f"{k}_second_a"] - speeds[f"{k}_first_a"]), limit, k, "A", "", "") for k in ("i_d", "i_q")
    ]
    return [(100.0 * speed, 100.0 * SETTLE_LIMIT, "the speed", "%", STOPPED, STOPPED_STEP), *currents]
