# SPDX-License-Identifier: MIT
"""Inductances over the angle of the rotor: from square waves at two further angles, a quarter of a turn apart.

Unequal phases make a second harmonic of L over the electrical angle, slots and saturation a sixth. Both change their
sign over a quarter of a turn, whatever their phase: the mean of two such angles has neither. The shots there are
compared with the one of the same half period where the inductances were measured, by a fit of L alone with everything
else as that measurement found it, so that what this fit leaves out is in both.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pmsmtool.estimators.injection.axis_fit import AxisFit
from pmsmtool.estimators.injection.axis_response import SKIP_SAMPLES, Response, Shot, projected, simulate
from pmsmtool.estimators.injection.output_error import AxisModel

STEPS = 6
"""Gauss-Newton steps of the logarithm of L."""
LOG_STEP = 1e-4
"""Step of its derivative."""
QUARTER_OFF_RAD = math.radians(10.0)
"""Distance from a quarter of a turn up to which a mean is one. Of a sixth harmonic sin(3 times it) stays, half of it at
this limit; the spread has as much more."""
UNSEEN = 2.0
"""Deviation from a mean that is not known, of the change that was seen: where cogging kept the rotor off a quarter of a
turn, 2.4 % of deviation showed as 1.7 %."""
UNSEEN_RANGE = 0.05
"""Deviation from the mean that is assumed where no two angles a quarter of a turn apart were seen: of the 1 to 5 % that
phases and slots make, a sixth harmonic of 4.3 % put L 5.0 % off, a phase with 3 % more 3.0 %."""
UNEVEN = 0.004
"""Change over the angle from which on it counts; a drive with equal phases showed 0.0014 on d and 0.0008 on q."""


@dataclass(frozen=True, slots=True)
class AngleDependence:
    """An inductance over the angle.

    Attributes
    ----------
    mean : float
        Of all angles, over that where it was measured; 1 where the angles do not show it.
    spread : float
        Largest deviation from the mean that was seen, relative to it; without a mean, what it may be; 0: none.
    """

    mean: float
    spread: float


def over_angle(
    fit: AxisFit, first: Shot, others: Sequence[Shot], angles_rad: Sequence[float], mixed: Sequence[float] = ()
) -> AngleDependence | None:
    """Return how an inductance depends on the angle; None where angles no quarter of a turn apart show no change.

    A harmonic may have one value at all of them.

    Parameters
    ----------
    fit : AxisFit
        Of the axis, where it was measured.
    first : Shot
        One of its shots.
    others : sequence of Shot
        At further angles, with the half period of ``first``.
    angles_rad : sequence of float
        Electrical angles of the rotor during these.
    mixed : sequence of float, optional
        Logarithms of what these see more of L, because the frame stood otherwise to the rotor than at ``first``.
    """
    here = _log_inductance(fit, first)
    ratios = [_log_inductance(fit, shot) - here for shot in others]
    ratios = [ratio - more for ratio, more in zip(ratios, mixed or [0.0] * len(ratios), strict=True)]
    off = [abs(abs(math.remainder(angle - angles_rad[0], math.pi)) - 0.5 * math.pi) for angle in angles_rad[1:]]
    quarter = len(off) == 1 and off[0] <= QUARTER_OFF_RAD
    mean = sum(ratios) / len(ratios) if quarter else 0.0
    spread = max(abs(ratio - mean) for ratio in (0.0, *ratios))
    if not spread > UNEVEN:
        return AngleDependence(1.0, 0.0) if quarter else None
    if quarter:
        return AngleDependence(math.exp(mean), spread * (1.0 + math.sin(3.0 * off[0])))
    return AngleDependence(1.0, max(UNSEEN * spread, UNSEEN_RANGE))


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
