# SPDX-License-Identifier: MIT
"""What a recorded position is good for: the encoder's step, and the rounding of binary32, which grows with the angle.

A recorder that carries angles as REAL32 rounds them to 24 bits: beyond 256 rad to 3e-5 rad, more than a step of an
encoder of 18 bits. Where a trace's positions are all binary32 numbers, that rounding is added to the encoder's step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pmsmtool.estimators.estimate import MEDIAN_TO_STD
from pmsmtool.estimators.refusals import refuse

Array = NDArray[np.float64]

STAGE = "mechanics"
ENCODER_STEPS_LEAST = 200
"""Way of the shaft in encoder steps below which the run says nothing."""
ROUNDINGS_LEAST = 8.0
"""Second difference of positions that is the encoder's and no rounding's, in roundings: those of three positions make
two at most, so that the step is told to a quarter."""
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
    """Return one step of the encoder (rad), from second differences: of a turning shaft every first one is many.

    Parameters
    ----------
    traces : sequence of ndarray, shape (n,)
        Positions of every trace (rad).

    Raises
    ------
    IdentificationError
        ``E_EXCITATION``: the shaft turned by too few steps in a trace.
    """
    step = _finest(np.concatenate([_steps(theta) for theta in traces], axis=1))
    way = min(float(np.ptp(theta)) for theta in traces)
    if step == 0.0 or way < ENCODER_STEPS_LEAST * step:
        raise refuse(
            "E_EXCITATION",
            f"the shaft turned by {way:.3g} rad during a trace, {ENCODER_STEPS_LEAST} steps of the encoder are needed",
            stage=STAGE,
            likely="a held shaft, much friction, or a speed limit that leaves no motion",
        )
    return step


def _steps(theta: Array) -> Array:
    """Second differences that are larger than the roundings of their positions, and those roundings, shape (2, n)."""
    second = np.abs(np.diff(theta, 2))
    rounding = np.maximum(rounding_rad(theta), FINEST_RAD / ROUNDINGS_LEAST * np.maximum(1.0, np.abs(theta)))
    largest = np.maximum(np.maximum(rounding[:-2], rounding[1:-1]), rounding[2:])
    found: Array = np.stack([second, largest])[:, second > ROUNDINGS_LEAST * largest]
    return found


def _finest(steps: Array) -> float:
    """Return the mean of what is one step, where the rounding is finest; the least alone is too small by roundings."""
    if not steps.shape[1]:
        return 0.0
    second, rounding = steps
    single = second < 1.5 * np.min(second)
    return float(np.mean(second[single & (rounding == np.min(rounding[single]))]))
