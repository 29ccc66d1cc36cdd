# SPDX-License-Identifier: MIT
"""Interval of the encoder offset from a slowly turned vector, where no finer experiment follows.

Every electrical turn of the run gives an offset of its own, the mean of the forward and the backward run; their
spread is the statistical part. What friction that differs between the two senses leaves is systematic: it does not
show in the spread.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pmsmtool.estimators.encoder import EncoderResult
from pmsmtool.machine.parameters import Estimate
from pmsmtool.trace import Trace

ASYMMETRY = 0.25
"""Part of the lag that may differ between the two senses of turning (95 %)."""
FLOOR_RAD = math.radians(0.2)
"""Least 95 % half width of the systematic part: what repeats every turn, cogging and the encoder's errors."""
METHOD = "slow rotation, electrical turns of both directions"

Vector = NDArray[np.float64]


def offset_by_turns(found: EncoderResult, forward: Trace, backward: Trace) -> Estimate:
    """Return the offset with an interval from its spread over electrical turns (rad electrical).

    Parameters
    ----------
    found : EncoderResult
        Of the same two runs.
    forward, backward : Trace
        ``theta_imposed_rad`` and ``theta_M_rad``.

    Returns
    -------
    Estimate
        ``found.offset`` itself when there are fewer than two whole electrical turns.
    """
    deviations = [_by_turn(found, trace) for trace in (forward, backward)]
    turns = min(map(len, deviations))
    if turns < 2:
        return found.offset
    # the backward run passes the same places in the opposite order
    pairs = 0.5 * (deviations[0][:turns] + deviations[1][::-1][:turns])
    return replace(
        found.offset,
        value=math.remainder(found.offset.value + float(pairs.mean()), 2.0 * math.pi),
        std=float(pairs.std(ddof=1)) / math.sqrt(turns),
        systematic=math.hypot(ASYMMETRY * found.lag_rad, FLOOR_RAD),
        dof=turns - 1.0,
        method=METHOD,
    )


def _by_turn(found: EncoderResult, trace: Trace) -> Vector:
    """Return the mean deviation from the found offset in every whole electrical turn of a run."""
    imposed = np.asarray(trace["theta_imposed_rad"], dtype=np.float64)
    ahead = found.direction * round(found.pole_pairs.value) * np.asarray(trace["theta_M_rad"], dtype=np.float64)
    off = np.asarray((ahead - imposed - found.offset.value + math.pi) % (2.0 * math.pi) - math.pi)
    steps = max(1, round(2.0 * math.pi / abs(float(imposed[1] - imposed[0]))))
    turns = len(off) // steps
    return np.asarray(off[: turns * steps].reshape(turns, steps).mean(axis=1))
