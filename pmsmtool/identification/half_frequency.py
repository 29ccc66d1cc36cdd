# SPDX-License-Identifier: MIT
"""What a second control frequency makes of R and the inverter, from the stored traces."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pmsmtool.estimators.estimate import SensorTolerance
from pmsmtool.estimators.frequency_extrapolation import FrequencySplit, extrapolated, split_by_frequency
from pmsmtool.estimators.noise import Noise
from pmsmtool.estimators.resistance import (
    FIT_FROM,
    Copper,
    ResistanceResult,
    at_one_temperature,
    settled_levels,
)
from pmsmtool.machine.parameters import Estimate
from pmsmtool.trace import Trace

TRACE = "levels_half_frequency"


def resistance_at_two_frequencies(
    traces: Mapping[str, Trace],
    noise: Noise,
    result: ResistanceResult,
    copper: Copper,
    tolerance: SensorTolerance,
) -> tuple[ResistanceResult, FrequencySplit | None]:
    """Return the resistance extrapolated to zero frequency, where both were measured, else as it is.

    Raises
    ------
    IdentificationError
        The second sequence cannot be fitted together with the first.
    """
    if TRACE not in traces:
        return result, None
    fast, slow = (
        at_one_temperature(settled_levels(traces[name], noise)[0], result.R_measured, copper)
        for name in ("levels", TRACE)
    )
    split = split_by_frequency(fast, slow, noise, tolerance=tolerance, least_current=FIT_FROM)
    return extrapolated(result, split, copper, tolerance), split


def split_estimates(split: FrequencySplit | None, U_dc_v: float, tolerance: SensorTolerance) -> dict[str, Estimate]:
    """Return both parts as values of a stage: the devices' drop (V), and the dead time that takes the other one (s)."""
    if split is None:
        return {}
    method = "multi-level DC at two control frequencies"

    def estimate(value: float, std: float, unit: str) -> Estimate:
        return Estimate(value=value, std=std, systematic=tolerance.voltage_gain * abs(value), unit=unit, method=method)

    dead_time_s = split.dead_time_s(U_dc_v)
    std_s = split.V_dead_std_v * split.periods_s[0] / U_dc_v
    return {
        "dead_time_equivalent_s": estimate(dead_time_s, std_s, "s"),
        "device_drop_v": estimate(split.V_device_v, split.V_device_std_v, "V"),
    }


def split_conditions(split: FrequencySplit | None, parts: Mapping[str, Estimate]) -> dict[str, Any]:
    """Return the inverter's error in its two parts, as a machine file keeps it under ``[conditions]``."""
    if split is None:
        return {}
    return {
        "control_frequencies_hz": [1.0 / period for period in split.periods_s],
        "dead_time_error_i_apk": list(map(float, split.curve.i_phase_a)),
        "dead_time_error_v": list(map(float, split.curve.u_error_v)),
        **{name: part.value for name, part in parts.items()},
    }
