# SPDX-License-Identifier: MIT
"""The current sensors: noise and offset at zero current, gains of the phases over their mean, traces without these.

The currents of a machine add up to nothing, those of sensors with the gains 1 + g_x (sum of the g_x zero) do not:

    i_a + i_b + i_c = sum of i_x g_x        to first order, offsets cancel between two levels of a pair.

Three pairs give three equations of rank two; the mean gain stays a tolerance. The drive takes the Clarke transform of
what it measures: along a fixed vector the mismatch is a gain and a cross term, over whole turns of a frame that follows
the rotor it averages out.

Every gate of identification compares a residual with the noise at zero current, never with the scatter of its own fit.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pmsmtool.machine.parameters import Estimate
from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace

MINIMUM_SAMPLES = 256
"""Samples below which the noise is not known to 5 % (relative error 1/sqrt(2 n))."""
OSCILLATES = 0.5
"""White part of the scatter at zero current, by the median of its spectrum, below which most of it is a line: a loop
that rang at 0.44 of its rate made the noise eight times too large, which hid eddy currents. White noise: 0.9 to 1.1."""


@dataclass(frozen=True, slots=True)
class Noise:
    """White noise of one axis current."""

    sigma_a: float
    """Standard deviation of one sample of i_d or i_q (A)."""
    offset_d_a: float
    offset_q_a: float
    """Mean of the zero-current trace (A)."""


def estimate_noise(trace: Trace) -> Noise:
    """Pooled standard deviation of both axis currents about a straight line, of its white part where a loop oscillates.

    Raises IdentificationError: ``E_EXCITATION`` for too few samples, ``E_SNR`` when the trace is constant: the
    quantiser hides the noise, and averaging cannot resolve less than one step.

    Parameters
    ----------
    trace : Trace
        ``i_d_a`` and ``i_q_a`` at zero current in a fixed frame.
    """
    if (n := len(trace)) < MINIMUM_SAMPLES:
        raise refuse("E_EXCITATION", f"{n} samples at zero current, {MINIMUM_SAMPLES} needed", stage="noise")
    basis = np.stack([np.ones(n), np.linspace(-1.0, 1.0, n)], axis=1)
    power, median, means = 0.0, 0.0, []
    for name in ("i_d_a", "i_q_a"):
        current = trace[name]
        residual = current - basis @ np.linalg.lstsq(basis, current, rcond=None)[0]
        power += float(residual @ residual)
        median += float(np.median(np.abs(np.fft.rfft(residual)) ** 2))
        means.append(float(np.mean(current)))
    sigma, white = math.sqrt(power / (2 * (n - 2))), math.sqrt(median / (2.0 * n * math.log(2.0)))
    sigma = white if white < OSCILLATES * sigma else sigma
    if all(float(np.ptp(trace[name])) == 0.0 for name in ("i_d_a", "i_q_a")):
        raise refuse(
            "E_SNR",
            f"{n} samples at zero current are all equal: the noise is below the converter's step",
            stage="noise",
            likely="a converter coarser than its noise, or a current measurement that is switched off",
            hint="check that the current measurement works, and the range of its converter",
        )
    return Noise(sigma, means[0], means[1])


MEAN_SAMPLES = 512
"""Samples of a mean, where a trace does not say."""
LEAST = 0.002
"""Largest gain over the mean up to which nothing is corrected: leaves 0.1 % of R or L, a tenth of their tolerance."""
SURE = 4.0
"""Standard deviations that it must exceed besides."""
DOUBT = 0.05
"""Standard deviation of what was corrected, of the mismatch (measured: seven drives at 2 %, 0.013 to 0.073)."""


@dataclass(frozen=True, slots=True)
class SensorMismatch:
    """Relative gains of the sensors of a, b and c over their mean, their standard deviation, and whether it counts."""

    gains: tuple[float, float, float]
    std: float

    @property
    def spread(self) -> float:
        """Largest difference between two gains, relative."""
        return max(self.gains) - min(self.gains)

    @property
    def corrected(self) -> bool:
        """Whether it is large and sure enough to be taken out of the traces."""
        largest = max(map(abs, self.gains))
        return largest > LEAST and largest > SURE * self.std

    @property
    def doubt(self) -> float:
        """Relative standard deviation that the correction leaves in a current along a fixed vector."""
        return math.hypot(DOUBT * self.spread, self.std) if self.corrected else 0.0


def estimate_mismatch(pairs: Trace, noise: Noise) -> SensorMismatch:
    """Return the gains over their mean.

    Parameters
    ----------
    pairs : Trace
        Six rows, two currents with phase a, b and c idle in turn: ``i_a_a i_b_a i_c_a`` (means).
    noise : Noise
        From the zero-current trace.
    """
    phases = np.stack([pairs[f"i_{phase}_a"] for phase in "abc"], axis=1)
    steps = np.diff(phases, axis=0)[::2]
    rows = np.vstack([steps, np.full(3, float(np.max(np.abs(steps))))])  # the last one: their sum is zero
    inverse = np.linalg.pinv(rows)
    gains = inverse @ np.append(np.sum(steps, axis=1), 0.0)
    # three phases, each with sqrt(3/2) of the noise of an axis, at two levels
    sum_std = noise.sigma_a * math.sqrt(1.5 * 3.0 * 2.0 / int(pairs.meta.get("samples", MEAN_SAMPLES)))
    std = sum_std * float(np.max(np.linalg.norm(inverse[:, :3], axis=1)))
    return SensorMismatch((float(gains[0]), float(gains[1]), float(gains[2])), std)


def widened(estimate: Estimate, mismatch: SensorMismatch | None) -> Estimate:
    """Return an estimate from corrected currents with what the correction leaves open."""
    if mismatch is None or not mismatch.corrected:
        return estimate
    return replace(estimate, std=math.hypot(estimate.std, mismatch.doubt * abs(estimate.value)))


def without_mismatch(trace: Trace, mismatch: SensorMismatch, angle_rad: float) -> Trace:
    """Return a trace of currents in a frame at a fixed angle (rad electrical) as equal sensors would have shown it."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    turn = np.array([[c, -s], [s, c]])
    shown = np.linalg.inv(turn.T @ _clarke(mismatch.gains) @ turn)
    signals = copy(trace.signals)  # its own kind: it names its file when something is missing
    assert isinstance(signals, dict)
    for part in ("", "_first", "_second"):
        d, q = f"i_d{part}_a", f"i_q{part}_a"
        if d not in signals:
            continue
        # halves of a window are recorded along the vector only
        across = signals.get(q, np.zeros_like(signals[d]))
        signals[d] = shown[0, 0] * trace[d] + shown[0, 1] * across
        if q in signals:
            signals[q] = shown[1, 0] * trace[d] + shown[1, 1] * across
    return replace(trace, signals=signals)


def _clarke(gains: tuple[float, float, float]) -> NDArray[np.float64]:
    """Clarke transform of what the sensors show, of alpha and beta."""
    a, b, c = (1.0 + gain for gain in gains)
    across = (c - b) / (2.0 * math.sqrt(3.0))
    return np.array([[(4.0 * a + b + c) / 6.0, across], [across, 0.5 * (b + c)]])
