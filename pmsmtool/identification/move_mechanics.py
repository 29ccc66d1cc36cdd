# SPDX-License-Identifier: MIT
"""Inertia and friction from position moves: for drives that have no torque mode, within the travel that is allowed.

Every move speeds up and brakes; each half is what a torque pulse is to the estimator, with the current that the drive's
own position loop asked for. Both directions and both signs of the acceleration tell friction from inertia.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pmsmtool.axis.move import RESTING
from pmsmtool.estimators.shaft.inertia_ratio import estimate_ratios
from pmsmtool.identification.by_pulses import either_reading
from pmsmtool.machine.parameters import Estimate
from pmsmtool.trace import Trace

METHOD = "regression over position moves"
GAP_S = 0.05
"""A demand that rests for less than this is still the same move: it counts whole increments."""
LEAST_SAMPLES = 60
"""Samples of half a move: the estimator makes 24 blocks of them."""


def move_mechanics(trace: Trace, *, pole_pairs: int, undecided: bool) -> dict[str, Estimate]:
    """Return ``J_per_psi`` (kg m2/Wb) and ``tau_c_per_psi`` (N m/Wb) of recorded moves.

    Parameters
    ----------
    trace : Trace
        As ``experiments.move.record_move`` leaves it, any number of moves.
    pole_pairs : int
        Of the machine.
    undecided : bool
        Whether no source says if the drive's amperes are peak or rms; they were read as rms.

    Raises
    ------
    IdentificationError
        Too few moves, or they do not tell inertia from friction.
    """
    found = estimate_ratios(halves_of_moves(trace), pole_pairs=pole_pairs)
    if undecided:
        found = {name: either_reading(estimate) for name, estimate in found.items()}
    return {name: replace(estimate, method=METHOD) for name, estimate in found.items()}


def halves_of_moves(trace: Trace) -> Sequence[Trace]:
    """Return the two halves of every move: before and after the demand is fastest."""
    t, demand = trace.t_s, trace["theta_ref_rad"]
    moving = np.abs(np.diff(demand, prepend=demand[:1])) > RESTING * abs(float(trace.meta["way_rad"]))
    at = np.flatnonzero(moving)
    if not at.size:
        return []
    breaks = np.flatnonzero(np.diff(t[at]) > GAP_S)
    edges = zip((at[0], *at[breaks + 1]), (*at[breaks], at[-1]), strict=True)
    halves = []
    for first, last in edges:
        middle = first + int(np.argmin(np.abs(demand[first : last + 1] - 0.5 * (demand[first] + demand[last]))))
        halves += [
            _part(trace, int(a), int(b)) for a, b in ((first, middle), (middle, last + 1)) if b - a >= LEAST_SAMPLES
        ]
    return halves


def _part(trace: Trace, first: int, last: int) -> Trace:
    signals = {"theta_M_rad": trace["theta_m_rad"][first:last], "i_q_a": trace["i_q_a"][first:last]}
    return Trace(trace.t_s[first:last] - trace.t_s[first], signals, {"theta_M_rad": "rad", "i_q_a": "A"})
