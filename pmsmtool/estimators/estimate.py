# SPDX-License-Identifier: MIT
"""From a fit to an :class:`~pmsmtool.machine.parameters.Estimate`: gates, verdicts and intervals.

The statistical part comes from the fit, the systematic part from the declared tolerances of the sensors. They are kept
apart everywhere; only :func:`total_half_width` joins them, in the manner of the GUM (JCGM 100:2008, 5.1.2).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from pmsmtool.machine.parameters import Estimate
from pmsmtool.refusals import refuse

CHI2_WARN = 1.25
"""Reduced chi-square above which a result is widened and marked (docs/identification.md, 4)."""
CHI2_REFUSE = 3.0
"""Reduced chi-square above which no number is given."""
CONDITION_LIMIT = 1e6
"""Largest condition number of a column-scaled Jacobian (docs/identification.md, 7)."""
SINGULAR = 1e-14
"""Ratio of eigenvalues of the scaled normal matrix below which it counts as singular."""
MEDIAN_TO_STD = 1.4826
"""Standard deviation over the median of the absolute deviations, of a normal distribution."""
COVERAGE_FACTOR = 1.959963984540054
"""Two-sided 95 % quantile of the normal distribution."""
SENSOR_GAIN_TOLERANCE = 0.01
"""Default tolerance of the current and the voltage scale (95 % half width, relative)."""

ENCODER_LATENCY_S = 2e-6
"""Default tolerance of the encoder angle's age (95 %, s): reading and transfer beyond what the drive compensates."""
BRIDGE_THRESHOLD_V = 0.35
"""Diode minus switch threshold, one standard deviation (V): IGBT data sheets put either at 0.3 to 1.2 V."""


class Verdict(StrEnum):
    """What the gates say about one result."""

    PASS = "pass"
    WARN = "warn"


@dataclass(frozen=True, slots=True)
class SensorTolerance:
    """Declared tolerances that no experiment on the machine itself can see (95 % half widths)."""

    current_gain: float = SENSOR_GAIN_TOLERANCE
    voltage_gain: float = SENSOR_GAIN_TOLERANCE
    """Relative scale errors of the current measurement and of the DC-link measurement."""
    temperature_k: float = 2.0
    """Error of the temperature sensor (K)."""
    device_share_max: float = 0.3
    """Largest part of the loop resistance that devices and shunts may have when the split is unknown (1)."""
    bridge_threshold_v: float = BRIDGE_THRESHOLD_V
    U_dc_v: float = math.inf
    """Standard deviation of diode minus switch threshold (V; 0 for a bridge of MOSFETs) and the DC link it acts on: a
    conducting leg swings by U_dc + V_diode - V_switch, which no experiment tells from a voltage gain. It is a model
    error that differs from drive to drive, so it belongs to the statistical part. Infinite link: not counted."""
    encoder_latency_s: float = ENCODER_LATENCY_S
    """Age of the encoder's angle at the period's start (s): looks like a late current sample."""
    current_scale: float = 1.0
    voltage_scale: float = 1.0
    """True over shown, where an instrument said so; the gains are then the instrument's tolerances."""
    bridge_difference_v: float | None = None
    """Diode minus switch threshold, where the devices' data sheet said so (V); the standard deviation is then its."""
    magnet_per_k: float = 0.0
    """Error of the magnets' temperature coefficient (1/K): what a flux linkage at the reference temperature has from
    an assumed one."""

    @property
    def applied_scale(self) -> float:
        """True over shown of the applied voltage: of the DC-link measurement, and of what a leg swings by beyond it."""
        return self.voltage_scale * (1.0 + (self.bridge_difference_v or 0.0) / self.U_dc_v)

    @property
    def voltage_scale_std(self) -> float:
        """Relative standard deviation of the applied voltage's scale from the bridge's thresholds."""
        return self.bridge_threshold_v / self.U_dc_v

    @property
    def impedance(self) -> float:
        """Relative systematic half width of R and L, which scale as (1 + g)/(1 + e)."""
        return math.hypot(self.current_gain, self.voltage_gain)

    @property
    def flux(self) -> float:
        """Relative systematic half width of a flux linkage measured as voltage over speed, (1 + g)."""
        return self.voltage_gain

    @property
    def inertia(self) -> float:
        """Relative systematic half width of J, B and tau_c, (1 + g)(1 + e)."""
        return math.hypot(self.current_gain, self.voltage_gain)


def chi2_gate(chi2: float, stage: str) -> tuple[Verdict, float]:
    """Return the verdict of a reduced chi-square and the factor on the standard deviation.

    Raises IdentificationError: ``E_MODEL_MISMATCH`` above :data:`CHI2_REFUSE`.
    """
    if not math.isfinite(chi2):
        raise refuse("E_NOT_CONVERGED", f"reduced chi-square is {chi2}", stage=stage)
    if chi2 > CHI2_REFUSE:
        raise refuse("E_MODEL_MISMATCH", f"reduced chi-square {chi2:.3g} > {CHI2_REFUSE:g}", stage=stage)
    verdict = Verdict.WARN if chi2 > CHI2_WARN else Verdict.PASS
    return verdict, math.sqrt(max(1.0, chi2))


def coverage_factor(dof: float) -> float:
    """Two-sided 95 % quantile of Student's t with ``dof`` degrees of freedom (normal when infinite)."""
    if math.isinf(dof) or dof > 1e4:
        return COVERAGE_FACTOR
    if dof < 1:
        raise ValueError(f"no interval with {dof} degrees of freedom")
    from scipy.special import stdtrit

    return float(stdtrit(dof, 0.975))


def statistical_half_width(estimate: Estimate) -> float:
    """95 % half width of the statistical part (same unit as the estimate)."""
    return coverage_factor(estimate.dof) * estimate.std


def total_half_width(estimate: Estimate) -> float:
    """95 % half width of statistical and systematic part together (root sum of squares, GUM 5.1.2)."""
    return math.hypot(statistical_half_width(estimate), estimate.systematic)


def information_bound(jacobian: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Standard deviations of the Cramer-Rao bound and the condition number of the scaled Jacobian.

    Parameters
    ----------
    jacobian : ndarray, shape (n, k)
        Derivative of the whitened residual with respect to the parameters.

    Returns
    -------
    std : ndarray, shape (k,)
        Square roots of the diagonal of the inverse Fisher information, nuisance parameters included.
    condition : float
        Ratio of the largest to the smallest singular value after scaling every column to unit length.
    """
    covariance, condition = scaled_covariance(jacobian)
    return np.sqrt(np.diag(covariance)), condition


def scaled_covariance(jacobian: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Inverse of J'J with columns scaled to unit length, and the condition number of the scaled columns."""
    scale = np.sqrt(np.sum(jacobian**2, axis=0))
    if not np.all(scale > 0.0):
        size = jacobian.shape[1]
        return np.full((size, size), np.inf), math.inf
    scaled = jacobian / scale
    # the normal matrix squares the condition number: good to 1e7, and CONDITION_LIMIT is below that
    values, vectors = np.linalg.eigh(scaled.T @ scaled)
    if not values[0] > SINGULAR * values[-1]:
        return np.full((len(scale), len(scale)), np.inf), math.inf
    root = vectors / np.sqrt(values)
    return (root @ root.T) / np.outer(scale, scale), math.sqrt(float(values[-1] / values[0]))


def condition_gate(condition: float, pair: str, stage: str, limit: float = CONDITION_LIMIT) -> None:
    """Refuse a fit whose parameters cannot be separated; ``pair`` names them."""
    if condition > limit:
        raise refuse(
            "E_NOT_IDENTIFIABLE",
            f"{pair} cannot be separated, scaled condition number {condition:.2g} > {limit:g}",
            stage=stage,
        )


def information_weights(criteria: Sequence[float]) -> NDArray[np.float64]:
    """Weights of models with information criteria B (chi2 + k ln n): exp(-(B - min B)/2), normalised."""
    b = np.asarray(criteria, dtype=np.float64)
    w = np.exp(-0.5 * (b - np.min(b)))
    return np.asarray(w / np.sum(w))
