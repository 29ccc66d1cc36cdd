# SPDX-License-Identifier: MIT
"""What pushes and coasting hold besides inertia and friction, as shapes of unknown size that are fitted along.

Each shape has a size of mean 0 and a standard deviation of 1, so that what the traces do not show of it widens J, B and
tau_c instead of moving them:

- torque of the pushes in proportion to the speed. The voltage displaces samples from the currents' mean, and iron loss
  takes a current of its own; an angle that is old turns i_q into i_d. Without it a shaft whose friction leaves little
  coasting takes that for B;
- friction over the angle, once and twice per turn: it changes its sign with the speed;
- torque over the angle, once and twice per turn: unbalance, tolerances of the stator;
- the encoder's error, once and twice per turn.

Higher orders are found in coasting (``estimators/angle_harmonics``) and taken out before the fit. A coasting of few
turns does not show these; all four traces together do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pmsmtool.estimators.angle_harmonics import ENCODER_ORDERS

Array = NDArray[np.float64]

TILT_FLOOR = 2e-3
"""Relative deviation of the pushes' torque at their fastest speed, beyond that of the samples' displacement. Fits of
real machines take 0.3 to 1.9 of it."""
ANGLE_STD = 0.03
"""Standard deviation of a torque or friction of one order, of the push's."""
ENCODER_STD_RAD = 0.01
"""Standard deviation of the encoder's error of one order (rad): 0.3 to 1 degree of magnetic encoders, 0.02 to 0.5 of
others."""
WAVES = (np.cos, np.sin)


@dataclass(frozen=True, slots=True, eq=False)
class Disturbances:
    """Torques of the blocks (N m), shape (n, k), and errors of the positions (rad), shape (n + 1, k), per unit size."""

    torque: Array
    position: Array


NONE = Disturbances(np.zeros((0, 0)), np.zeros((0, 0)))


@dataclass(frozen=True, slots=True)
class Extent:
    """Sizes of a run: fastest speed (rad/s), largest torque (N m) and the pushes' doubt in proportion to the speed.

    ``tilt_std`` is the standard deviation of a push's torque at the fastest speed, of the largest.
    """

    speed_rad_s: float
    torque_nm: float
    tilt_std: float


def disturbances(theta: Array, torque: Array, T: float, extent: Extent) -> Disturbances:
    """Return the shapes of a trace.

    Parameters
    ----------
    theta : ndarray, shape (n * rows + 1,)
        Positions (rad).
    torque : ndarray, shape (n,)
        Mean torque of every block (N m); 0 of a coasting.
    T : float
        Length of a block (s).
    extent : Extent
        Sizes of the run.
    """
    blocks = len(torque)
    rows = (len(theta) - 1) // blocks
    way = np.diff(theta)
    middle = theta[:-1] + 0.5 * way
    # a voltage displaces the current, and takes of it, whichever way the torque is
    share = (theta[rows::rows] - theta[:-1:rows]) / (T * extent.speed_rad_s)
    torques = [extent.tilt_std * extent.torque_nm * share * (torque != 0.0)]
    positions = []
    for order in ENCODER_ORDERS:
        for wave in WAVES:
            # the mean over an interval of nearly constant speed
            means = wave(order * middle) * np.sinc(order * way / (2.0 * np.pi))
            for mean in (means, means * np.sign(way)):
                torques.append(ANGLE_STD * extent.torque_nm * mean.reshape(blocks, rows).mean(axis=1))
            positions.append(ENCODER_STD_RAD * wave(order * theta[::rows]))
    return Disturbances(
        np.column_stack([*torques, np.zeros((blocks, len(positions)))]),
        np.column_stack([np.zeros((blocks + 1, len(torques))), *positions]),
    )
