# SPDX-License-Identifier: MIT
"""The parameter vector of an axis fit: which effects are in it, where each value sits, and the weak priors on them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.estimators.injection.axis_response import SKIP_SAMPLES, Response
from pmsmtool.estimators.injection.output_error import AxisModel
from pmsmtool.estimators.injection.sampling_instant import ShownInstant

DELAY_CENTRE = 1.0
"""Sample to voltage (T_s), +-1. A sample within a zero vector does not show it: nothing kept it, and L had 48 %."""
LAG_CENTRE = 0.1
"""Centre of the prior of the sensor time constant (T_s)."""
LAG_PRIOR_STD = 1.5
"""Prior standard deviation of ln(lag/T_s): 0.005 to 2 T_s in 95 %; keeps the fit where lag and delay are one."""
R_PRIOR_STD = 0.5
"""Prior of the effective resistance at the injection, relative to the loop resistance (eddy currents raise it)."""
BEND_PRIOR_STD = 3.0
"""Prior of the bend: relative change of L over one rms ripple, in tenths."""
MOTION_PRIOR_STD = 10.0
"""Prior of the motional term, in hundredths of L over the square of a half period."""
RATIO_PRIOR_STD = 0.3
"""Prior of the relative difference of L and R between injection frequencies."""
EDDY_TAU_CENTRE, EDDY_TAU_PRIOR_STD = 0.5, 1.5
"""Centre (T_s) and standard deviation (of the logarithm) of the prior of its time constant."""
EDDY_R_PRIOR_STD = 0.05
"""Prior of the resistance beside it: what eddy currents add is then their own."""
LARGEST_LOG_L, LARGEST_LOG_LAG = 3.0, 10.0
SMALLEST_DECAY, LARGEST_DECAY = -0.3, 5.0
"""Region of the fit: L relative to its first guess, lag relative to T_s, and R T_s/L."""
BEND_LIMIT = 10.0
"""Bend at which L would change by its own size over one rms ripple."""
TIMING_FLOOR = 1e-3
"""Difference of the delays of two axes that the pulses of the inverter may make (T_s)."""


@dataclass(frozen=True, slots=True)
class Motion:
    """Back-EMF per charge of the rotor that follows, 1.5 p^2 psi^2/J, as other experiments say (1/F)."""

    per_f: float
    std_per_f: float


@dataclass(frozen=True, slots=True)
class Timing:
    """Delay and sensor lag as another axis of the same drive has shown them."""

    total: float
    total_std: float
    """Delay and lag together, of the models with a lag (T_s)."""
    log_lag: float
    log_lag_std: float
    """Logarithm of the lag in T_s, of the same models."""
    delay: float
    delay_std: float
    """Delay of the model without lag (T_s)."""
    lag_criterion: float
    plain_criterion: float
    """Information criterion of the best model with lag, and of the one without."""
    bend_gain: float = 0.0
    """What a bend of the magnetisation curve gained there in the criterion, 0 where it gained nothing."""

    def criterion(self, lag: bool) -> float:
        """Criterion of the other axis's model with or without lag."""
        return self.lag_criterion if lag else self.plain_criterion

    def prior(self, delay: float, log_lag: float | None) -> list[float]:
        """Whitened distance of an axis's timing from the other's."""
        if log_lag is None:
            return [(delay - self.delay) / math.hypot(self.delay_std, TIMING_FLOOR)]
        return [
            (delay + math.exp(log_lag) - self.total) / math.hypot(self.total_std, TIMING_FLOOR),
            (log_lag - self.log_lag) / self.log_lag_std,
        ]


@dataclass(frozen=True, slots=True)
class Effects:
    """Which optional effects a fit has."""

    lag: bool = True
    bend: bool = False
    motion: bool = False
    dispersion: bool = False
    eddy: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects in use."""
        return tuple(name for name in ("lag", "bend", "motion", "dispersion", "eddy") if getattr(self, name))


@dataclass(frozen=True, slots=True)
class Layout:
    """Where each parameter sits in the vector, and its typical size.

    ``symmetric`` is an axis without bias: its magnetisation curve bends alike on both sides. ``instant`` is what a
    turning machine shows of delay and lag.
    """

    shots: int
    effects: Effects
    L_scale: float
    R_scale: float
    period_s: float
    ripple_a: float
    motion_scale: float
    timing: Timing | None = None
    motion: Motion | None = None
    symmetric: bool = False
    instant: ShownInstant | None = None

    def blocks(self) -> Iterator[tuple[str, int]]:
        """Names and lengths of the parts of the vector."""
        yield "main", 3
        if self.effects.lag:
            yield "lag", 1
        if self.effects.bend:
            yield "bend", 1 if self.symmetric else 2
        if self.effects.motion:
            yield "motion", 1
        if self.effects.dispersion:
            yield "dispersion", 2 * (self.shots - 1)
        if self.effects.eddy:
            yield "eddy", 2
        yield "start", self.shots

    def split(self, x: Array) -> dict[str, list[float]]:
        """The parts of the vector by name."""
        parts, first = {}, 0
        for name, length in self.blocks():
            parts[name] = [float(value) for value in x[first : first + length]]
            first += length
        return parts

    def responses(self, x: Array) -> list[Response]:
        """Parameters of every shot."""
        parts = self.split(x)
        log_L, R, delay = parts["main"]
        lag = math.exp(parts["lag"][0]) * self.period_s if self.effects.lag else 0.0
        b_2, b_3 = [0.0, 0.0, *parts.get("bend", [])][-2:]
        motion = parts.get("motion", [0.0])[0] * self.motion_scale
        eddy, log_tau = parts.get("eddy", [0.0, 0.0])
        ratios = [0.0, 0.0, *parts.get("dispersion", [0.0] * (2 * (self.shots - 1)))]
        return [
            Response(
                model=AxisModel(
                    self.L_scale * math.exp(log_L + ratios[2 * k]),
                    R * self.R_scale * (1.0 + ratios[2 * k + 1]),
                    delay,
                    lag,
                    eddy * self.period_s,
                    math.exp(log_tau) * self.period_s,
                ),
                start_a=parts["start"][k] * self.ripple_a,
                c_2=0.1 * b_2 / self.ripple_a,
                c_3=0.1 * b_3 / self.ripple_a**2,
                motion=motion,
            )
            for k in range(self.shots)
        ]

    def prior(self, x: Array) -> Array:
        """Residuals of the weak priors that keep an undetermined effect from running away."""
        parts = self.split(x)
        rows = [(parts["main"][1] - 1.0) / (EDDY_R_PRIOR_STD if self.effects.eddy else R_PRIOR_STD)]
        rows.append(parts["main"][2] - DELAY_CENTRE)
        if self.timing is not None:
            rows += self.timing.prior(parts["main"][2], parts["lag"][0] if self.effects.lag else None)
        elif self.effects.lag:
            rows.append((parts["lag"][0] - math.log(LAG_CENTRE)) / LAG_PRIOR_STD)
        if self.instant is not None:
            lag = math.exp(parts["lag"][0]) if self.effects.lag else 0.0
            rows.append(self.instant.distance(parts["main"][2], lag * self.period_s))
        rows += [value / BEND_PRIOR_STD for value in parts.get("bend", [])]
        for value in parts.get("motion", []):
            if self.motion is None:
                rows.append(value / MOTION_PRIOR_STD)
            else:
                rows.append((value * self.motion_scale - self.motion.per_f) / self.motion.std_per_f)
        rows += [value / RATIO_PRIOR_STD for value in parts.get("dispersion", [])]
        if self.effects.eddy:
            eddy, log_tau = parts["eddy"]  # per voltage over T_s/L: 5 % of iron loss make 0.1 to 1.3, a branch 0.1
            rows += [eddy, (log_tau - math.log(EDDY_TAU_CENTRE)) / EDDY_TAU_PRIOR_STD]
        return np.array(rows)

    def changed(self, x: Array, effects: Effects) -> tuple[Layout, Array]:
        """The layout with more effects, or without the lag, and its starting vector."""
        richer = replace(self, effects=effects)
        parts = self.split(x)
        if self.effects.lag and not effects.lag:
            # the pure delay takes over what the lag was, as far as the record allows
            parts["main"][2] = min(parts["main"][2] + math.exp(parts["lag"][0]), SKIP_SAMPLES - 3.5)
        start = {
            "bend": [0.0] * (1 if self.symmetric else 2),
            "motion": [0.0],
            "dispersion": [0.0] * (2 * (self.shots - 1)),
            "eddy": [0.0, math.log(EDDY_TAU_CENTRE)],
        }
        values = [value for name, _ in richer.blocks() for value in parts.get(name, start.get(name, []))]
        return richer, np.array(values)

    def with_eddy(self, x: Array, eddy: float, tau: float, delay: float | None) -> Array:
        """Return the vector with an eddy branch (T_s/L, T_s), a delay (T_s; None: its own), and no loss beside it."""
        parts = self.split(x)
        parts["main"][1] = 1.0
        parts["eddy"] = [eddy, math.log(tau)]
        if delay is not None:
            parts["main"][2] = delay
        return np.array([value for name, _ in self.blocks() for value in parts[name]])

    def defined(self, x: Array) -> bool:
        """Whether the model can be evaluated at x."""
        parts = self.split(x)
        (log_L, _, delay), log_lag = parts["main"], parts.get("lag", [0.0])[0]
        sizes = [log_L, *(log_L + ratio for ratio in parts.get("dispersion", [0.0])[::2])]
        bent = max(abs(value) for value in parts.get("bend", [0.0]))
        slow = max(map(abs, (log_lag, parts.get("eddy", [0.0, 0.0])[1])))
        if max(map(abs, sizes)) > LARGEST_LOG_L or slow > LARGEST_LOG_LAG or bent > BEND_LIMIT:
            return False
        decays = [r.model.R_ohm * self.period_s / r.model.L_h for r in self.responses(x)]
        return 0.0 <= delay <= SKIP_SAMPLES - 3 and min(decays) > SMALLEST_DECAY and max(decays) < LARGEST_DECAY
