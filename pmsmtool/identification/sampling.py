# SPDX-License-Identifier: MIT
"""What the instant at which currents are sampled does to the other estimates of a run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pmsmtool.estimators.estimate import SensorTolerance
from pmsmtool.estimators.injection.inductance import InductanceResult
from pmsmtool.estimators.injection.sampling_instant import ShownInstant, standstill_instant_s
from pmsmtool.estimators.inverter_error import Modulation
from pmsmtool.estimators.resistance import Copper, ResistanceResult, normalised
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.parameters import Estimate

LAG = "current_lag_s"
INSTANT = "sampling_instant_s"
"""Keys of the current sensors' time constant, and of the sampling instant after the PWM centre."""
APART_PERIODS = 0.02
"""Standard deviation of instant and lag beside what they do together, which is known better (T_s): a short lag and an
earlier sample look alike (five late drives: 0.003 to 0.04 T_s off)."""


def resistance_as_sampled(
    resistance: ResistanceResult,
    inductance: InductanceResult,
    shown: ShownInstant,
    modulation: Modulation,
    copper: Copper,
    tolerance: SensorTolerance,
) -> ResistanceResult:
    """Return R for the mean current: what is sampled late in the zero vector is less by R t/L of it.

    Where an old encoder angle would show the same, R is the middle of both.

    Parameters
    ----------
    resistance : ResistanceResult
        From the sampled currents.
    inductance, shown : InductanceResult, ShownInstant
        When and how currents are sampled by all models that count, and how well that is known.
    modulation : Modulation
        Link, inductances, period and dead time.
    copper : Copper
        Temperature coefficient and reference.
    tolerance : SensorTolerance
        Declared sensor tolerances.
    """
    measured = resistance.R_measured
    rate = measured.value / modulation.L_h[0]
    weights = np.array([weight for weight, _ in inductance.samplings])
    late = np.array([standstill_instant_s(sampling, modulation) for _, sampling in inductance.samplings])
    mean_s = float(np.average(late, weights=weights))
    instant_std_s = math.hypot(shown.std_s, math.sqrt(float(np.average((late - mean_s) ** 2, weights=weights))))
    half_apart = 0.5 * rate * max(0.0, shown.value_s)  # to what an old angle leaves: the middle, both are inside
    value = measured.value / (1.0 + rate * mean_s) * (1.0 + half_apart)
    at_mean = replace(
        measured,
        value=value,
        std=math.hypot(measured.std, value * rate * instant_std_s),
        systematic=math.hypot(measured.systematic, value * rate * tolerance.encoder_latency_s) + value * half_apart,
    )
    normal = replace(normalised(at_mean, copper, tolerance), fallback=resistance.R_s.fallback)
    return replace(resistance, R_measured=at_mean, R_s=normal)


def timing_estimates(
    inductance: InductanceResult | None, shown: ShownInstant | None, tolerance: SensorTolerance
) -> dict[str, Estimate]:
    """Return sampling instant and lag of the current sensors (s), by the names a stage lists them under."""
    if inductance is None or inductance.sampling is None or shown is None:
        return {}
    std = math.hypot(shown.std_s, APART_PERIODS * shown.period_s)
    found = {INSTANT: inductance.sampling.instant_s, LAG: inductance.sampling.lag_s}
    method = "d voltage of a coasting machine and square waves"
    return {
        name: Estimate(value, std, tolerance.encoder_latency_s, "s", method=method) for name, value in found.items()
    }


def with_timing(machine: MachineFile, timing: Mapping[str, Estimate]) -> MachineFile:
    """Return a machine file with the identified timing of its current sensors: a proof's prediction needs it."""
    if not timing:
        return machine
    lag_s, instant_s = max(0.0, timing[LAG].value), timing[INSTANT].value
    inverter = replace(machine.inverter, current_lag_s=lag_s, sampling_instant_s=instant_s)
    return replace(machine, inverter=inverter, estimates={**machine.estimates, **timing})
