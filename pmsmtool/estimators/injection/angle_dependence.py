# SPDX-License-Identifier: MIT
"""Inductances over the angle of the rotor: from square waves at further angles, a quarter of a turn apart at best.

Unequal phases make a second harmonic of L over the electrical angle, slots and saturation a sixth. Both change their
sign over a quarter of a turn, whatever their phase: the mean of two such angles has neither. Cogging and friction keep
rotors off them; the mean is then the most likely one (Rasmussen and Williams, Gaussian Processes for Machine Learning,
2006, eq. 2.19), with what the angles leave unseen of it. The shots there are compared with the one of the same half
period where the inductances were measured, by a fit of L alone with everything else as that measurement found it, so
that what this fit leaves out is in both.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.estimators.estimate import COVERAGE_FACTOR
from pmsmtool.estimators.injection.axis_fit import AxisFit
from pmsmtool.estimators.injection.axis_response import SKIP_SAMPLES, Response, Shot, projected, simulate
from pmsmtool.estimators.injection.output_error import AxisModel

STEPS = 6
"""Gauss-Newton steps of the logarithm of L."""
LOG_STEP = 1e-4
"""Step of its derivative."""
HARMONICS: Mapping[int, float] = {2: 0.01, 6: 0.02}
"""Relative standard deviation of L by a harmonic of unknown phase: 3 % in a phase make 1.0 %, a sixth of 3 % 2.1 %."""
RATIO_STD = 1.5e-3
"""Standard deviation of a comparison of two shots: a drive with equal phases showed 0.0014 on d and 0.0008 on q."""
UNSEEN_RANGE = 0.05
"""Deviation from the mean that is assumed where no further angle was seen: of the 1 to 5 % that phases and slots make,
a sixth harmonic of 4.3 % put L 5.0 % off, a phase with 3 % more 3.0 %."""
UNEVEN = 0.004
"""Change over the angle from which on it counts."""


@dataclass(frozen=True, slots=True)
class AngleDependence:
    """An inductance over the angle."""

    mean: float
    """Of all angles, over that where it was measured; 1 where no change is seen."""
    spread: float
    """Largest deviation from the mean that was seen, and what the angles leave unseen of the mean (95 %), relative
    to it; 0: none."""


def over_angle(
    fit: AxisFit, first: Shot, others: Sequence[Shot], angles_rad: Sequence[float],
    mixed: Sequence[float] = (), std: float = 0.0,
) -> AngleDependence:  # fmt: skip
    """Return how an inductance depends on the angle.

    Parameters
    ----------
    fit : AxisFit
        Of the axis, where it was measured.
    first : Shot
        One of its shots.
    others : sequence of Shot
        At further angles, with the half period of ``first``.
    angles_rad : sequence of float
        Electrical angles of the rotor during ``first`` and during these.
    mixed : sequence of float, optional
        Logarithms of what these see more of L, because the frame stood otherwise to the rotor than at ``first``.
    std : float
        Standard deviation of the comparison beside :data:`RATIO_STD`.
    """
    here = _log_inductance(fit, first)
    more = np.array(mixed or [0.0] * len(others))
    ratios = np.array([_log_inductance(fit, shot) - here for shot in others]) - more
    covariance, lever, left = _harmonics(angles_rad, std)
    likely = np.linalg.solve(covariance, ratios)
    mean = float(lever @ likely)
    seen = float(np.max(np.abs(np.append(ratios, 0.0) - mean)))
    if not seen > UNEVEN:
        mean = seen = 0.0
    # harmonics are as large as usual, and as the ratios say
    unseen = COVERAGE_FACTOR * left * math.sqrt((1.0 + float(ratios @ likely)) / (1.0 + len(ratios)))
    return AngleDependence(math.exp(mean), seen + unseen if seen + unseen > UNEVEN else 0.0)


def unseen_std(angles_rad: Sequence[float]) -> float:
    """Return the relative standard deviation of the mean that shots at some angles leave; angles of the rotor (rad)."""
    return _harmonics(angles_rad)[2]


def _harmonics(angles_rad: Sequence[float], std: float = 0.0) -> tuple[Array, Array, float]:
    """Covariance of the ratios to the first angle, theirs with the mean over it, and what they leave of the mean."""
    apart = np.subtract.outer(angles_rad, angles_rad)
    harmonics = sum(size**2 * np.cos(number * apart) for number, size in HARMONICS.items())
    lever = harmonics[0, 0] - harmonics[1:, 0]
    ratios = harmonics[1:, 1:] - harmonics[1:, :1] + lever + (RATIO_STD**2 + std**2) * np.eye(len(lever))
    left = harmonics[0, 0] - lever @ np.linalg.solve(ratios, lever)
    return ratios, lever, math.sqrt(max(0.0, float(left)))


def _log_inductance(fit: AxisFit, shot: Shot) -> float:
    """Logarithm of L over that of the fit by one shot; the current at its start is the slow part's."""
    slow = shot.slow_basis()

    def rest(log_L: float) -> np.ndarray:
        model = AxisModel(
            fit.L_h * math.exp(log_L), fit.R_ohm, fit.delay, fit.lag_s, fit.eddy_s * math.exp(log_L), fit.eddy_tau_s
        )
        modelled = simulate([Response(model, 0.0, 0.0, 0.0, fit.motion_per_f)], shot, slow)[0]
        return projected(modelled - shot.i_a[SKIP_SAMPLES:], slow)

    log_L = 0.0
    for _ in range(STEPS):
        here = rest(log_L)
        slope = (rest(log_L + LOG_STEP) - here) / LOG_STEP
        log_L = float(np.clip(log_L - (slope @ here) / (slope @ slope), -1.0, 1.0))
    return log_L
