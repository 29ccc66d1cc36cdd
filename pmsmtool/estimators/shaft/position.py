# SPDX-License-Identifier: MIT
"""What a recorded position is good for: the encoder's step, and the rounding of binary32, which grows with the angle.

A recorder that carries angles as REAL32 rounds them to 24 bits: beyond 256 rad to 3e-5 rad, more than a step of an
encoder of 18 bits. Where a trace's positions are all binary32 numbers, that rounding is added to the encoder's step.

Interval of the encoder offset from a slowly turned vector, where no finer experiment follows.

Every electrical turn of the run gives an offset of its own, the mean of the forward and the backward run; their
spread is the statistical part. What friction that differs between the two senses leaves is systematic: it does not
show in the spread.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.estimators.encoder import EncoderResult, wrapped
from pmsmtool.estimators.estimate import MEDIAN_TO_STD
from pmsmtool.machine.parameters import Estimate
from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace

STAGE = "mechanics"
ENCODER_STEPS_LEAST = 50
"""Way of the shaft in encoder steps below which the run says nothing. The interval says what the steps leave: at 73 and
138 of them J was 0.6 % off at +-4.9 %, and 0.1 at 7.9."""
ROUNDINGS_LEAST = {2: 8.0, 3: 16.0}
"""Difference of positions by order that is the encoder's and no rounding's, in roundings: those of three positions
make two at most, of four four, so that the step is told to a quarter."""
FINEST_RAD = 1e-6
"""Least step of an encoder that is looked for, relative to angles above one; one of 22 bits has 1.5e-6 rad."""


def rounding_rad(theta: Array) -> Array:
    """Return the step of binary32 at each position (rad), shape (n,); 0 where the positions are finer numbers."""
    single = theta.astype(np.float32)
    if not np.array_equal(single.astype(np.float64), theta):
        return np.zeros_like(theta)
    return np.spacing(np.abs(single)).astype(np.float64)


def position_std(theta: Array, step_rad: float) -> Array:
    """Return the standard deviation of each position (rad), shape (n,): two uniform roundings, one after the other."""
    return np.asarray(np.hypot(step_rad, rounding_rad(theta)) / math.sqrt(12.0))


def position_noise(theta: Array) -> float:
    """Return the standard deviation of what positions scatter by themselves (rad), theta of shape (n,).

    Third differences of the recorded positions, whose median no jump and no reversal moves: those of independent
    errors are sqrt(20) of one, those of an encoder's rounding at speed as much, of a slow shaft's none.
    """
    differences = np.abs(np.diff(theta, 3))
    return MEDIAN_TO_STD * float(np.median(differences)) / math.sqrt(20.0) if len(differences) else 0.0


def encoder_step(traces: Sequence[Array]) -> float:
    """Return one step of the encoder (rad), from second and third differences: of a turning shaft a first one is many.

    A shaft that slows down turns by many steps of a fine encoder in second differences, too: 22 bits were taken for 13.

    Raises IdentificationError: ``E_EXCITATION``: the shaft turned by too few steps in a trace.

    Parameters
    ----------
    traces : sequence of ndarray, shape (n,)
        Positions of every trace (rad).
    """
    found = [_finest(np.concatenate([_steps(theta, order) for theta in traces], axis=1)) for order in ROUNDINGS_LEAST]
    step = min(filter(None, found), default=0.0)
    way = min(float(np.ptp(theta)) for theta in traces)
    if step == 0.0 or way < ENCODER_STEPS_LEAST * step:
        raise refuse(
            "E_EXCITATION",
            f"the shaft turned by {way:.3g} rad during a trace, {ENCODER_STEPS_LEAST} steps of the encoder are needed",
            stage=STAGE,
            likely="a held shaft, much friction, or a speed limit that leaves no motion",
        )
    return step


def _steps(theta: Array, order: int) -> Array:
    """Differences of an order that are larger than the roundings of their positions, and those roundings, (2, n)."""
    least = ROUNDINGS_LEAST[order]
    rounding = np.maximum(rounding_rad(theta), FINEST_RAD / least * np.maximum(1.0, np.abs(theta)))
    largest = np.lib.stride_tricks.sliding_window_view(rounding, order + 1).max(axis=1)
    size = np.abs(np.diff(theta, order))
    found: Array = np.stack([size, largest])[:, size > least * largest]
    return found


def _finest(steps: Array) -> float:
    """Return the mean of what is one step, where the rounding is finest; the least alone is too small by roundings."""
    if not steps.shape[1]:
        return 0.0
    size, rounding = steps
    single = size < 1.5 * np.min(size)
    return float(np.mean(size[single & (rounding == np.min(rounding[single]))]))


ASYMMETRY = 0.25
"""Part of the lag that may differ between the two senses of turning (95 %)."""
FLOOR_RAD = math.radians(0.2)
"""Least 95 % half width of the systematic part: what repeats every turn, cogging and the encoder's errors."""
METHOD = "slow rotation, electrical turns of both directions"


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


def _by_turn(found: EncoderResult, trace: Trace) -> Array:
    """Return the mean deviation from the found offset in every whole electrical turn of a run."""
    imposed = np.asarray(trace["theta_imposed_rad"], dtype=np.float64)
    ahead = found.direction * round(found.pole_pairs.value) * np.asarray(trace["theta_M_rad"], dtype=np.float64)
    off = wrapped(ahead - imposed - found.offset.value)
    steps = max(1, round(2.0 * math.pi / abs(float(imposed[1] - imposed[0]))))
    turns = len(off) // steps
    return np.asarray(off[: turns * steps].reshape(turns, steps).mean(axis=1))
