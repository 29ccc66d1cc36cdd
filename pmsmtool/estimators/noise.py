# SPDX-License-Identifier: MIT
"""Noise and offset of the current measurement from a trace at zero current.

Every gate of identification compares a residual with this number, never with the scatter of its own fit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace

MINIMUM_SAMPLES = 256
"""Samples below which the noise is not known to 5 % (relative error 1/sqrt(2 n))."""


@dataclass(frozen=True, slots=True)
class Noise:
    """White noise of one axis current.

    Attributes
    ----------
    sigma_a : float
        Standard deviation of one sample of i_d or i_q (A).
    offset_d_a, offset_q_a : float
        Mean of the zero-current trace (A).
    """

    sigma_a: float
    offset_d_a: float
    offset_q_a: float


def estimate_noise(trace: Trace) -> Noise:
    """Pooled standard deviation of both axis currents about a straight line.

    Raises IdentificationError: ``E_EXCITATION`` for too few samples, ``E_SNR`` when the trace is constant: the
    quantiser hides the noise, and averaging cannot resolve less than one step.

    Parameters
    ----------
    trace : Trace
        ``i_d_a`` and ``i_q_a`` at zero current in a fixed frame.
    """
    n = len(trace)
    if n < MINIMUM_SAMPLES:
        raise refuse("E_EXCITATION", f"{n} samples at zero current, {MINIMUM_SAMPLES} needed", stage="noise")
    basis = np.stack([np.ones(n), np.linspace(-1.0, 1.0, n)], axis=1)
    power, means = 0.0, []
    for name in ("i_d_a", "i_q_a"):
        current = trace[name]
        coefficients, *_ = np.linalg.lstsq(basis, current, rcond=None)
        residual = current - basis @ coefficients
        power += float(residual @ residual)
        means.append(float(np.mean(current)))
    sigma = math.sqrt(power / (2 * (n - 2)))
    if all(float(np.ptp(trace[name])) == 0.0 for name in ("i_d_a", "i_q_a")):
        raise refuse(
            "E_SNR",
            f"{n} samples at zero current are all equal: the noise is below the converter's step",
            stage="noise",
            likely="a converter coarser than its noise, or a current measurement that is switched off",
            hint="check that the current measurement works, and the range of its converter",
        )
    return Noise(sigma, means[0], means[1])
