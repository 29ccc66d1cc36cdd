# SPDX-License-Identifier: MIT
"""The second control frequency of the resistance: asked for, measured, and what it makes of R and the inverter."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from pmsmtool.drive.port import Drive
from pmsmtool.errors import NotAvailable
from pmsmtool.estimators.estimate import SensorTolerance
from pmsmtool.estimators.frequency_extrapolation import FrequencySplit, extrapolated, split_by_frequency
from pmsmtool.estimators.noise import Noise
from pmsmtool.estimators.resistance import (
    FIT_FROM,
    HARD_RATIO,
    Copper,
    ResistanceResult,
    at_one_temperature,
    settled_levels,
)
from pmsmtool.experiments.half_frequency import hold_at_half_frequency
from pmsmtool.experiments.standstill import LevelPlan, calm_sequence
from pmsmtool.machine.parameters import Estimate
from pmsmtool.trace import Trace

TRACE = "levels_half_frequency"
PLAN_LINE = "the control frequency is halved for one series of levels, and put back"


def measure_at_half_frequency(
    drive: Drive,
    plan: LevelPlan,
    resistance: ResistanceResult,
    asked: bool,
    keep: Callable[[str, Trace], None],
    say: Callable[[str], None],
) -> None:
    """Hold the levels that R is fitted to at half the control frequency, where that was asked for.

    It is not done by itself: it takes some 8 s, and on switched drives of the hard class R is as good without, for
    what is off are the bridge's thresholds, which no current shows (p90 0.12 and 0.13 %, max 0.18 and 0.18 %). What
    it gives is half the statistical interval of R and the two parts of the inverter's error
    (``benchmarks/tables/half_frequency.txt``).
    """
    if not asked:
        if resistance.hardness > HARD_RATIO:
            say(
                f"  one control frequency: not asked for half of it; dead time and devices take "
                f"{resistance.hardness:.1f} R I here, --half-frequency halves the statistical interval of R"
            )
        return
    largest = max(map(abs, plan.levels_a))
    magnitudes = sorted({abs(level) for level in plan.levels_a if abs(level) >= FIT_FROM * largest})
    levels = calm_sequence(magnitudes)
    say(f"R and inverter at half the control frequency: {len(levels)} levels up to {largest:.3g} A")
    try:
        trace = hold_at_half_frequency(drive, replace(plan, levels_a=levels, start_rad=plan.angle_rad))
    except NotAvailable as refusal:
        say(f"  not used: {refusal.what}: {refusal.likely}")
        return
    keep(TRACE, trace)


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
