# SPDX-License-Identifier: MIT
"""Second methods beside the first: what they say, and whether the two agree within their intervals.

The flux linkage is measured with d currents while the shaft coasts. The same run holds q currents of both signs for a
moment, which drive it: their sum cancels resistance and inverter error,

    psi = (u_q+ + u_q-)/(w+ + w-),

so that the error sits in other currents, at another place of the inverter's curve, and in an accelerating shaft; what
both have in common is the scale of the voltage. The drive cannot see the voltage of a machine that it does not drive:
with its gates off the terminals float, and there is no signal for them. The apparent inductance of the q axis follows
from the d voltage of the same q currents, where the injection at standstill has seen the incremental one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pmsmtool.estimators.estimate import COVERAGE_FACTOR, SensorTolerance
from pmsmtool.estimators.flux.linkage_rows import Corrected
from pmsmtool.machine.parameters import Estimate

RIPPLE_DOUBT = 0.2
"""Standard deviation of the ripple's share of the inverter error, relative: twice that of ``flux.linkage``. Of 52
random drives whose dead time takes more than 3 R I, 51 agree with it."""
LAG_STD = 0.2
"""Relative standard deviation of the lag of the speed: the shaft has just begun to accelerate, and the lag of the
drive's estimate is not steady yet (13 low-voltage drives: 0.0 to 0.19)."""
SATURATION_DOUBT = 0.05
"""Standard deviation of what the q currents take from the flux of the d axis, of the curvature of that axis (27 drives
around two machines that saturate: the two methods differ by 0.02 to 0.07 of it)."""
FLOOR = 1e-4
"""Relative model floor, one standard deviation."""
LEAST_PAIRS = 2
JUDGES = 0.3
"""Interval of the difference, relative, above which agreement says little."""


@dataclass(frozen=True, slots=True)
class CrossCheck:
    """What a second method says about a quantity."""

    name: str
    of: str
    """Key of the check's own estimate, and of the quantity it checks."""
    estimate: Estimate
    """The second method's value."""
    difference: float
    half_width: float
    """Second less first method, and its 95 % half width without what both have in common, of the first's value."""

    @property
    def agrees(self) -> bool:
        """Whether the difference is within its interval."""
        return abs(self.difference) <= self.half_width

    @property
    def verdict(self) -> str:
        """What a person reads."""
        agrees = "agrees with" if self.half_width <= JUDGES else "too uncertain to judge"
        word = agrees if self.agrees else "DISAGREES with"
        return (
            f"{word} {self.of}: {100.0 * self.difference:+.2g} % off, interval of that {100.0 * self.half_width:.3g} %"
        )


def cross_check(name: str, of: str, second: Estimate, first: Estimate, common_std: float = 0.0) -> CrossCheck:
    """Compare two estimates of one quantity.

    Parameters
    ----------
    name, of : str
        Keys of both.
    second, first : Estimate
        Of the check and of the quantity.
    common_std : float
        Relative standard deviation that both have from the same cause.
    """
    own = [max(0.0, (e.std / e.value) ** 2 - common_std**2) for e in (second, first)]
    ratio = second.value / first.value
    return CrossCheck(name, of, second, ratio - 1.0, COVERAGE_FACTOR * abs(ratio) * math.sqrt(sum(own)))


def driven_flux_linkage(
    rows: Corrected,
    L_d_h: float,
    across_wb: float,
    curvature: float,
    lag_s: float,
    tolerance: SensorTolerance,
    T_c: float,
) -> Estimate | None:
    """Return the flux linkage (Wb) by the pairs of q currents at the temperature of the run; None without them.

    Parameters
    ----------
    rows : Corrected
        Windows of the speed run.
    L_d_h : float
        Rough inductance of the d axis (H), for the d current that is left.
    across_wb : float
        What the frame, which is off the d axis, shows of the flux linkage in the d voltage (Wb).
    curvature : float
        Of the d axis, as ``flux.linkage.FluxResult`` has it.
    lag_s : float
        Delay of the drive's speed behind the rotor's (s).
    tolerance : SensorTolerance
        Declared sensor tolerances.
    T_c : float
        Temperature of the magnets (degC).
    """
    w, i_q = rows.w, rows.i_q
    driven = np.nonzero(~rows.is_d)[0]
    pairs = [
        (int(a), int(b)) for a, b in pairwise(driven) if b == a + 1 and i_q[a] * i_q[b] < 0.0 and w[a] * w[b] > 0.0
    ]
    if len(pairs) < LEAST_PAIRS:
        return None
    first, second = (np.array([pair[k] for pair in pairs]) for k in (0, 1))

    def mean(voltage_v: np.ndarray[tuple[int], np.dtype[np.float64]]) -> tuple[float, float]:
        flux = (voltage_v[first] + voltage_v[second]) / (w[first] + w[second])
        return float(np.mean(flux)), float(np.std(flux, ddof=1)) / math.sqrt(len(flux))

    along, scatter = mean(rows.u_q - L_d_h * w * rows.i_d)
    value = math.hypot(along, across_wb)
    std = math.hypot(
        scatter,
        RIPPLE_DOUBT * mean(rows.ripple_q_v)[0],
        LAG_STD * lag_s * value * mean(rows.acceleration_rad_s2)[0],
        SATURATION_DOUBT * curvature * value,
        FLOOR * value,
        tolerance.voltage_scale_std * value,
    )
    return Estimate(value, std, tolerance.flux * value, "Wb", n=len(pairs), T_c=T_c,
                    method="driven by q currents of both signs", i_d_apk=0.0,
                    i_q_apk=float(np.mean(np.abs(i_q[driven]))))  # fmt: skip
