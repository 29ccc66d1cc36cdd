# SPDX-License-Identifier: MIT
"""Inertia and Coulomb friction over the flux linkage, from torque pushes of known current: no voltage is needed.

With i_d = 0 the torque is 1.5 p psi i_q. Divided by J and integrated over a push, the mechanical speed is

    w(t) = (1.5 p psi / J) int i_q dt - (tau_c / J) int sgn(w) dt - (B / J) int w dt + w_0

One linear regression over all pushes, each way with its own w_0, gives 1.5 p psi/J and tau_c/J: J/psi and tau_c/psi.
A drive that does not decouple its current loops lets a d current flow, and (L_d - L_q) i_d i_q adds to the torque. i_d
is measured, or it is a high pass of omega i_q: what a PI of d without feed-forward leaves of the voltage omega L_q i_q,
when its zero lies on the pole of the winding. One more coefficient takes it up where that surely changes J/psi.
The speed is the slope of the counted position over a block. The spread is a jackknife over the pushes.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import TypeVar

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.estimate import CONDITION_LIMIT, SensorTolerance, statistical_half_width
from pmsmtool.machine.parameters import Estimate
from pmsmtool.machine.torque import torque_per_ampere
from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace

Part = tuple[Array, ...]
Push = TypeVar("Push")

STAGE = "inertia over flux linkage"
BLOCKS = 24
"""Blocks of a push."""
LEAST_PUSHES = 4
SKIP_SHARE = 0.12
"""Beginning of a push that is left out: the current is still rising."""
STILL = 0.05
"""Blocks slower than this share of the push's largest speed are left out: friction changes its sign there."""
LAGS_S = tuple(0.005 * 2.0 ** (0.5 * k) for k in range(11))
"""Time constants (s) of the high pass; one below them gives the slope of omega i_q, as the first one nearly does."""
SATURATED_SHARE = 0.15
"""Of what the d current's torque changes in J/psi, what is left open: saturation changes L_d - L_q; seen: 0.13."""
SURELY = 3.0
"""Standard deviations by which that torque changes J/psi where it is taken up; less is noise."""
SMOOTH = 5
"""Degree of the polynomial that a current under one command follows."""
RATIO_LIMIT = 0.10
"""Largest relative statistical 95 % half width of J/psi."""
MODEL_FLOOR = 0.01
"""Relative 95 % model error of J/psi: torque ripple, temperature of the magnets during the run."""
FRICTION_FLOOR = 0.01
"""95 % model error of tau_c/psi, relative to the torque of the smallest push; seen: 0.4 % (seeds 2000 to 2005)."""
METHOD = "regression over torque pulses"


def estimate_ratios(
    pushes: Sequence[Trace], *, pole_pairs: int, tolerance: SensorTolerance | None = None
) -> dict[str, Estimate]:
    """Return ``J_per_psi`` (kg m2/Wb) and ``tau_c_per_psi`` (N m/Wb).

    Raises IdentificationError: ``E_EXCITATION``, ``E_NOT_IDENTIFIABLE``.

    Parameters
    ----------
    pushes : sequence of Trace
        ``theta_M_rad`` (unwrapped), ``i_q_a``, ``i_d_a`` if known, under one command each; speed may pass zero.
    pole_pairs : int
        Pole pairs.
    tolerance : SensorTolerance
        Declared sensor tolerances.
    """
    tolerance = tolerance or SensorTolerance()

    def parts_at(lag: float, *, whole: bool = False, of: Sequence[Trace] = pushes) -> list[Part]:
        return [part for push in of if (part := _part(push, lag, whole)) is not None]

    n = len(parts := parts_at(LAGS_S[0]))
    if n < LEAST_PUSHES:
        raise refuse("E_EXCITATION", f"{n} usable torque pulses, {LEAST_PUSHES} needed", stage=STAGE)
    sense = math.copysign(1.0, sum(float(p[0] @ p[1]) for p in parts))
    (full, std), left_open = _with_spread(parts, sense, pole_pairs, 3), 0.0
    measured = any("i_d_a" in push.signals for push in pushes)
    with contextlib.suppress(IdentificationError):  # a d current that is zero, or follows the current as speed does
        lag = min(LAGS_S[: 1 if measured else None], key=lambda lag: _fit(parts_at(lag), sense, 4)[1])
        salient, its_std = _with_spread(parts_at(lag), sense, pole_pairs, 4)
        seen = max(std[0], abs(full[0] - salient[0]) / SURELY) > its_std[0]
        if seen and (measured or salient[0] < full[0]):  # what no loop decouples brakes where L_q > L_d
            salient, std = _with_spread(parts_at(lag, whole=True), sense, pole_pairs, 4)
            left_open, full = SATURATED_SHARE * abs(full[0] - salient[0]), salient
    driven = [push for push in pushes if push.meta.get("i_command_a") != 0.0]  # not those in which the shaft coasts
    weakest = min(abs(float(p[1] @ p[-1] / (p[-1] @ p[-1]))) for p in parts_at(LAGS_S[0], of=driven))
    excess = 0.0 if measured else _amplitude_excess(driven)
    floors = (
        math.hypot(full[0] * math.hypot(tolerance.current_gain, MODEL_FLOOR, excess), left_open),
        math.hypot(full[1] * tolerance.current_gain, FRICTION_FLOOR * torque_per_ampere(pole_pairs, weakest)),
    )
    rows = sum(len(p[0]) for p in parts)
    found = {
        name: Estimate(float(full[k]), float(std[k]), float(floors[k]), unit, n=rows, method=METHOD, dof=n - 1.0)
        for k, (name, unit) in enumerate((("J_per_psi", "kg m2/Wb"), ("tau_c_per_psi", "N m/Wb")))
    }
    if not (half := statistical_half_width(found["J_per_psi"])) <= RATIO_LIMIT * full[0]:
        raise refuse(
            "E_NOT_IDENTIFIABLE",
            f"J/psi is {full[0]:.3g} +-{half:.2g} kg m2/Wb between the torque pulses, limit {100.0 * RATIO_LIMIT:g} %",
            stage=STAGE,
            likely="torque pulses too short or too weak against friction, a load, or a drive that limits its current",
        )
    return found


def _amplitude_excess(pushes: Sequence[Trace]) -> float:
    """Return how much too large a current may be shown that is an amplitude: a d current varies as it does (relative).

    Without feed-forward the dead time makes both vary: 6 times per turn by 0.23 of 2.7 A, and J/psi 1.0 % too large.
    """
    shares = []
    for push in pushes:
        t, i = (np.asarray(values)[round(SKIP_SHARE * len(push)) :] for values in (push.t_s, push["i_q_a"]))
        rest = i - np.polyval(np.polyfit(t - t.mean(), i, SMOOTH), t - t.mean())
        shares.append(float(np.mean(rest**2) / np.mean(i**2)))
    return float(np.mean(shares))


def _part(push: Trace, lag_s: float, whole: bool) -> Part | None:
    """Return speed, integrals of current, sign of speed, speed and i_d i_q, and time, at the blocks of a push.

    But for a ``whole`` push each way has its own w_0: what friction does where the shaft turns back is not seen.
    """
    from scipy.integrate import cumulative_trapezoid

    skip = round(SKIP_SHARE * len(push))
    size = (len(push) - skip) // BLOCKS
    if size < 1:
        return None
    t, theta, i = (np.asarray(values, dtype=np.float64) for values in (push.t_s, push["theta_M_rad"], push["i_q_a"]))
    edges = np.minimum(skip + np.arange(BLOCKS + 1) * size, len(t) - 1)
    spans = np.diff(t[edges])
    if np.any(spans <= 0.0):
        return None
    w = np.diff(theta[edges]) / spans
    middle = 0.5 * (t[edges[1:]] + t[edges[:-1]])
    i_d = np.asarray(push["i_d_a"]) if "i_d_a" in push.signals else _left_of_slope(t, theta, i, size, lag_s)
    charge, reluctance = (np.interp(middle, t, passed) for passed in cumulative_trapezoid([i, i * i_d], t, initial=0.0))
    way = np.interp(middle, t, theta - theta[0])
    sign = np.sign(w)
    signs = cumulative_trapezoid(sign, middle, initial=0.0)
    moving = np.abs(w) >= STILL * np.abs(w).max()
    if moving.sum() < BLOCKS // 2:
        return None
    rows = np.array((w, charge, signs, way, reluctance, middle))[:, moving]
    ways = [rows] if whole else np.split(rows, 1 + np.flatnonzero(np.diff(sign[moving])), axis=1)
    return tuple(np.hstack([one - one.mean(axis=1, keepdims=True) for one in ways]))


def _left_of_slope(t: Array, theta: Array, i: Array, size: int, lag_s: float) -> Array:
    """Return the high pass of speed times current; the speed is a slope over a block."""
    k = np.arange(len(t))
    before, after = np.maximum(k - size // 2 - 1, 0), np.minimum(k + size // 2 + 1, len(t) - 1)
    product = (theta[after] - theta[before]) / (t[after] - t[before]) * i
    steps = zip(np.exp(-np.diff(t) / lag_s), np.diff(product), strict=True)
    return np.array(list(accumulate(steps, lambda left, new: new[0] * (left + new[1]), initial=0.0)))


def _with_spread(parts: Sequence[Part], sense: float, pole_pairs: int, columns: int) -> tuple[Array, Array]:
    """Return J/psi and tau_c/psi, and their standard deviations."""

    def ratios(kept: Sequence[Part]) -> Array:
        rise, slowing = _fit(kept, sense, columns)[0][:2]
        return np.array([1.0, -slowing]) * (torque_per_ampere(pole_pairs, 1.0) / float(rise))

    return ratios(parts), np.sqrt(jackknife_variance(ratios, parts))


def _fit(parts: Sequence[Part], sense: float, columns: int) -> tuple[Array, float]:
    """Return coefficients and squared residual."""
    w, charge, *others = np.hstack([part[: 1 + columns] for part in parts])
    found = regress(signed := [sense * charge, *others], w, what="current and friction", stage=STAGE)
    return found, float(np.sum((w - np.column_stack(signed) @ found) ** 2))


def regress(columns: Sequence[Array], measured: Array, *, what: str, stage: str) -> Array:
    """Return the least-squares coefficients, shape (k,); columns are scaled to unit mean square.

    Raises IdentificationError: ``E_NOT_IDENTIFIABLE``: a column of zeros, or columns that are nearly one another's sum.

    Parameters
    ----------
    columns : sequence of ndarray, shape (n,)
        Regressors.
    measured : ndarray, shape (n,)
        Left side.
    what, stage : str
        What is to be told apart and where, for the refusal.
    """
    matrix = np.column_stack(columns)
    scale = np.sqrt(np.mean(matrix**2, axis=0))
    if np.any(scale == 0.0):
        raise refuse("E_NOT_IDENTIFIABLE", f"the shaft did not turn during the torque pulses, for {what}", stage=stage)
    solution, _, _, singular = np.linalg.lstsq(matrix / scale, measured, rcond=None)
    with np.errstate(divide="ignore"):
        condition = float(singular[0] / singular[-1])
    if condition > CONDITION_LIMIT:
        raise refuse("E_NOT_IDENTIFIABLE", f"condition {condition:.3g} of {what} together", stage=stage)
    return np.asarray(solution / scale)


def jackknife_variance(estimate: Callable[[Sequence[Push]], Array], pushes: Sequence[Push]) -> Array:
    """Return the variance of an estimate over pushes left out one by one, shape (k,).

    What is wrong with a push (friction, heating) is the same in all its samples, so that the samples' own scatter
    would promise too much.

    References
    ----------
    Tukey, J. W. Ann. Math. Statist. 29, 614 (1958), DOI 10.1214/aoms/1177706647.
    """
    n = len(pushes)
    without = np.array([estimate([*pushes[:k], *pushes[k + 1 :]]) for k in range(n)])
    return np.asarray((n - 1) / n * np.sum((without - without.mean(axis=0)) ** 2, axis=0))
