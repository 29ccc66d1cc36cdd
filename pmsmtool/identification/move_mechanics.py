# SPDX-License-Identifier: MIT
"""Inertia and friction from position moves: for drives that have no torque mode, within the travel that is allowed.

Every move speeds up and brakes; each half is what a torque pulse is to the estimator, with the current that the drive's
own position loop asked for. Both directions and both signs of the acceleration tell friction from inertia.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pmsmtool.axis.move import moving
from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.shaft.inertia_ratio import LEAST_PUSHES, estimate_ratios
from pmsmtool.identification.by_pulses import either_reading
from pmsmtool.machine.parameters import Estimate
from pmsmtool.machine.torque import torque_per_ampere
from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace

METHOD = "regression over position moves"
GAP_S = 0.05
"""A demand that rests for less than this is still the same move: it counts whole increments."""
OFFSET_SHARE = 0.003
"""95 % offset of the current sensors, of the rated current: 0.15 % of a range of twice that. Within a part of an
electrical turn it does not average out: 0.15 % made J 1.7 to 2.5 % small where 5 % of the rated current flowed."""
SMALL = 0.1
"""Part of it with which its effect is looked for, so that the estimate stays near."""
LEAST_SAMPLES = 60
"""Samples of half a move: the estimator makes 24 blocks of them."""
DELAYS_S, DELAY_STEP_S = (-2e-3, 8e-3), 0.5e-3
"""By which a drive may show its current later than its position (a filter of 0x6077 or 0x6078). 1 ms made friction 28 %
small where the current changes within half a move, at +-13 %."""


def move_mechanics(trace: Trace, *, pole_pairs: int, undecided: bool, rated_apk: float = 0.0) -> dict[str, Estimate]:
    """Return ``J_per_psi`` (kg m2/Wb) of recorded moves, and ``tau_c_per_psi`` (N m/Wb) where it is above zero.

    Raises IdentificationError: too few moves, moves too short for the samples, or they do not tell inertia from
    friction.

    Parameters
    ----------
    trace : Trace
        As ``experiments.move.record_move`` leaves it, any number of moves.
    pole_pairs : int
        Of the machine.
    undecided : bool
        Whether no source says if the drive's amperes are peak or rms; they were read as rms.
    rated_apk : float
        Rated current of the drive (A peak), of which the offsets of its current sensors are a share.
    """
    if trace.meta.get("speed_doubt"):
        raise IdentificationError(
            "E_ENCODER", str(trace.meta["speed_doubt"]), where="moves", likely="0x608F was never set for this encoder",
            hint="set it with the maker's software, or state counts_per_turn in a map",
        )  # fmt: skip
    halves = _long_halves(trace)
    if len(halves) < LEAST_PUSHES:
        raise _too_short(halves_of_moves(trace), len(halves))
    tried = np.arange(*DELAYS_S, DELAY_STEP_S)
    delay = float(min(tried, key=lambda delay: _unexplained(_long_halves(_earlier(trace, delay)))))
    halves = _long_halves(_earlier(trace, delay))
    found = estimate_ratios(halves, pole_pairs=pole_pairs)
    next_to_it = estimate_ratios(_long_halves(_earlier(trace, delay + DELAY_STEP_S)), pole_pairs=pole_pairs)
    for name, estimate in found.items():
        doubt = next_to_it[name].value - estimate.value
        found[name] = replace(estimate, systematic=math.hypot(estimate.systematic, doubt))
    found = _with_offset(found, halves, pole_pairs, OFFSET_SHARE * rated_apk)
    if undecided:
        found = {name: either_reading(estimate) for name, estimate in found.items()}
    if found["tau_c_per_psi"].value <= 0.0:  # cogging within the way, or a lag of the current, hides it
        del found["tau_c_per_psi"]
    return {name: replace(estimate, method=METHOD) for name, estimate in found.items()}


def _long_halves(trace: Trace) -> list[Trace]:
    return [half for half in halves_of_moves(trace) if len(half) >= LEAST_SAMPLES]


def _earlier(trace: Trace, delay_s: float) -> Trace:
    """Return a record whose current is taken that much later, as it flowed where the shaft was seen."""
    current = np.interp(trace.t_s + delay_s, trace.t_s, trace["i_q_a"])
    return Trace(trace.t_s, {**trace.signals, "i_q_a": current}, trace.units, trace.meta)


def _unexplained(halves: Sequence[Trace]) -> float:
    """Return the squared angle that torque, friction and drag leave, each half from its own place and speed."""
    from scipy.integrate import cumulative_trapezoid

    angles, columns = [], []
    for half in halves:
        t, angle = half.t_s, half["theta_M_rad"]
        k = np.arange(len(t))
        ways = np.sign(angle[np.minimum(k + 5, k[-1])] - angle[np.maximum(k - 5, 0)])
        *pushes, way = cumulative_trapezoid([half["i_q_a"], ways, angle - angle[0]], t, initial=0.0)
        own, _ = np.linalg.qr(np.stack([np.ones_like(t), t], axis=1))
        both = np.stack([angle, *cumulative_trapezoid(pushes, t, initial=0.0), way], axis=1)
        both -= own @ (own.T @ both)
        angles.append(both[:, 0])
        columns.append(both[:, 1:])
    matrix, angle = np.vstack(columns), np.concatenate(angles)
    matrix /= np.sqrt(np.mean(matrix**2, axis=0))
    return float(np.sum((angle - matrix @ np.linalg.lstsq(matrix, angle, rcond=None)[0]) ** 2))


def _with_offset(
    found: dict[str, Estimate], halves: Sequence[Trace], pole_pairs: int, offset_a: float
) -> dict[str, Estimate]:
    """Return the estimates with what offsets of the current sensors leave open: a current that turns with the rotor."""
    left_open = {"J_per_psi": 0.0, "tau_c_per_psi": torque_per_ampere(pole_pairs, offset_a)}
    for phase in (0.0, 0.5 * math.pi) if offset_a else ():
        shifted = []
        for half in halves:
            i_q = half["i_q_a"] + SMALL * offset_a * np.cos(pole_pairs * half["theta_M_rad"] + phase)
            shifted.append(Trace(half.t_s, {**half.signals, "i_q_a": i_q}, half.units))
        for name, estimate in estimate_ratios(shifted, pole_pairs=pole_pairs).items():
            left_open[name] = math.hypot(left_open[name], (estimate.value - found[name].value) / SMALL)
    return {
        name: replace(estimate, systematic=math.hypot(estimate.systematic, left_open[name]))
        for name, estimate in found.items()
    }


def halves_of_moves(trace: Trace) -> Sequence[Trace]:
    """Return the two halves of every move, however short: before and after the demand is fastest."""
    t, demand = trace.t_s, trace["theta_ref_rad"]
    at = np.flatnonzero(moving(trace))
    if not at.size:
        return []
    breaks = np.flatnonzero(np.diff(t[at]) > GAP_S)
    edges = zip((at[0], *at[breaks + 1]), (*at[breaks], at[-1]), strict=True)
    halves = []
    for first, last in edges:
        middle = first + int(np.argmin(np.abs(demand[first : last + 1] - 0.5 * (demand[first] + demand[last]))))
        halves += [_part(trace, int(a), int(b)) for a, b in ((first, middle), (middle, last + 1)) if b > a]
    return halves


def _too_short(halves: Sequence[Trace], enough: int) -> IdentificationError:
    """Return the refusal of moves whose halves have too few samples."""
    longest = max(halves, key=len, default=None)
    lasts = "nothing" if longest is None else f"{1e3 * longest.t_s[-1]:.3g} ms with {len(longest)} samples"
    return refuse(
        "E_EXCITATION",
        f"{enough} halves of moves have {LEAST_SAMPLES} samples, {LEAST_PUSHES} needed; half a move lasts {lasts}",
        stage="inertia from moves",
        likely="the drive's own profile is fast for this way, or its answers are slow",
        hint="move further (--by) or slower (--speed and --acceleration)",
    )


def _part(trace: Trace, first: int, last: int) -> Trace:
    signals = {"theta_M_rad": trace["theta_m_rad"][first:last], "i_q_a": trace["i_q_a"][first:last]}
    return Trace(trace.t_s[first:last] - trace.t_s[first], signals, {"theta_M_rad": "rad", "i_q_a": "A"})
