# SPDX-License-Identifier: MIT
"""What pushes and coasting hold besides inertia and friction, as shapes of unknown size that are fitted along.

Each shape has a size of mean 0 and a standard deviation of 1, so that what the traces do not show of it widens J, B and
tau_c instead of moving them:

- torque of the pushes in proportion to the speed. The voltage displaces samples from the currents' mean, and iron loss
  takes a current of its own; an angle that is old turns i_q into i_d. Without it a shaft whose friction leaves little
  coasting takes that for B;
- friction over the angle, once and twice per turn: it changes its sign with the speed;
- torque over the angle, once and twice per turn: unbalance, tolerances of the stator;
- torque of the pushes over the electrical angle: an offset of a current sensor shows a q current that is not there
  once per electrical turn, a gain one in proportion to the current twice; a push of few turns takes it for inertia;
- the encoder's error, once and twice per turn, about what the slow rotation showed of it: a heavy shaft that makes
  less than a turn shows little of its own (J 5.5 % off at +-1.6 %).

The angles are those of a smooth course: with the encoder's own, an error of the encoder would take its rounding along,
which makes a large one likely (0.08 rad where there was 0.0016, and J 8 % too large).

Higher orders are found in coasting (``estimators/angle_harmonics``) and taken out before the fit. A coasting of few
turns does not show these; all four traces together do.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from pmsmtool.arrays import Array
from pmsmtool.estimators.angle_harmonics import ENCODER_ORDERS, Harmonic

TILT_FLOOR = 2e-3
"""Relative deviation of the pushes' torque at their fastest speed, beyond that of the samples' displacement. Fits of
real machines take 0.3 to 1.9 of it."""
ANGLE_STD = 0.03
"""Standard deviation of a torque or friction of one order, of the push's."""
ENCODER_STD_RAD = 0.01
"""Standard deviation of the encoder's error of one order (rad): 0.3 to 1 degree of magnetic encoders, 0.02 to 0.5 of
others."""
TURNED_STD_RAD = 0.01
"""What a torque once or twice per turn leaves a slow rotation to show (rad electrical): 1 % of the holding torque."""
ELECTRICAL_STD = 0.01
"""Standard deviation of a torque once or twice per electrical turn, of the push's: what calibrated current sensors
leave of their offsets and gains; 0.6 % was found on a machine whose gains differ by 0.8 %."""
SMOOTH_DEGREE = 6
"""Of the polynomial of time that the angle follows: seven numbers take 0.7 % of the rounding of a thousand rows."""
WAVES = (np.cos, np.sin)
UNKNOWN = tuple(Harmonic(order, 0.0, 0.0, ENCODER_STD_RAD) for order in ENCODER_ORDERS)
"""Encoder's error of which nothing is known."""


@dataclass(frozen=True, slots=True, eq=False)
class Disturbances:
    """Torques of the blocks (N m), shape (n, k), and errors of the positions (rad), shape (n + 1, k), per unit size."""

    torque: Array
    position: Array
    orders: Sequence[int] = ()
    """Per turn, of the cogging among them."""


NONE = Disturbances(np.zeros((0, 0)), np.zeros((0, 0)))


@dataclass(frozen=True, slots=True)
class Extent:
    """Sizes of a run: fastest speed (rad/s), largest torque (N m) and the pushes' doubt in proportion to the speed.

    ``tilt_std`` is the standard deviation of a push's torque at the fastest speed, of the largest; ``encoder`` what
    the positions are without of the encoder's error (rad), and how well that is known; ``orders`` per turn are those of
    the cogging that a fit without it left (``cogging_orders``).
    """

    speed_rad_s: float
    torque_nm: float
    tilt_std: float
    encoder: Sequence[Harmonic] = UNKNOWN
    orders: Sequence[int] = ()


def encoder_prior(turned: Sequence[Harmonic], pole_pairs: int) -> Sequence[Harmonic]:
    """Return the encoder's error (rad), order by order, with what a slow rotation ``turned`` showed of it."""
    prior = []
    for h in turned:
        std = math.hypot(h.std, TURNED_STD_RAD / pole_pairs)
        share = ENCODER_STD_RAD**2 / (ENCODER_STD_RAD**2 + std**2)
        prior.append(Harmonic(h.order, share * h.cosine, share * h.sine, ENCODER_STD_RAD * math.sqrt(1.0 - share)))
    return prior or UNKNOWN


def _mean(wave: Callable[[Array], Array], order: int, theta: Array) -> Array:
    """Mean of a wave of the angle between positions, over intervals of nearly constant speed."""
    way = np.diff(theta)
    return np.asarray(wave(order * (theta[:-1] + 0.5 * way)) * np.sinc(order * way / (2.0 * np.pi)))


def waves_of(theta: Array, orders: Sequence[int]) -> Array:
    """Return the means of cosine and sine of every order between positions, shape (n, 2 k), theta of shape (n + 1,)."""
    return np.stack([_mean(wave, order, theta) for order in orders for wave in WAVES], axis=1)


def disturbances(theta: Array, torque: Array, T: float, extent: Extent, pole_pairs: int) -> Disturbances:
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
    pole_pairs : int
        Of the machine.
    """
    blocks = len(torque)
    rows = (len(theta) - 1) // blocks
    sign = np.sign(np.diff(theta))
    t = np.linspace(-1.0, 1.0, len(theta))
    shown, theta = theta, np.asarray(legendre.legval(t, legendre.legfit(t, theta, SMOOTH_DEGREE)), dtype=np.float64)

    def means(wave: Callable[[Array], Array], order: int) -> Array:
        return _mean(wave, order, theta)

    def blocked(torque_share: Array) -> Array:
        return np.asarray(extent.torque_nm * torque_share.reshape(blocks, rows).mean(axis=1))

    # a voltage displaces the current, and takes of it, whichever way the torque is
    share = (theta[rows::rows] - theta[:-1:rows]) / (T * extent.speed_rad_s)
    torques = [extent.tilt_std * extent.torque_nm * share * (torque != 0.0)]
    positions = []
    for h in extent.encoder:
        for wave in WAVES:
            mean = means(wave, h.order)
            torques += [ANGLE_STD * blocked(mean), ANGLE_STD * blocked(mean * sign)]
            positions.append(h.std * wave(h.order * theta[::rows]))
    for order, driven in ((pole_pairs, torque != 0.0), (2 * pole_pairs, np.sign(torque))):
        if order not in ENCODER_ORDERS:
            torques += [ELECTRICAL_STD * blocked(means(wave, order)) * driven for wave in WAVES]
    torques += [ANGLE_STD * blocked(_mean(wave, order, shown)) for order in extent.orders for wave in WAVES]
    return Disturbances(
        np.column_stack([*torques, np.zeros((blocks, len(positions)))]),
        np.column_stack([np.zeros((blocks + 1, len(torques))), *positions]),
        extent.orders,
    )
