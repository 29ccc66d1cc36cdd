"""The second control frequency of the resistance: asked for, measured, and what it makes of R and the inverter."""

from __future__ import annotations

import math
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

    It takes 7 to 13 s and does not make R itself better by much (24 switched drives of the hard class: p90 of the
    error 0.19 to 0.18 %, the rest are the bridge's thresholds, which no current shows), but its statistical interval
    half as wide; so it is not done by itself.
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


def split_conditions(split: FrequencySplit | None, U_dc_v: float) -> dict[str, Any]:
    """Return the inverter's error in its two parts, as a machine file keeps it under ``[conditions]``."""
    if split is None:
        return {}
    facts: dict[str, Any] = {
        "control_frequencies_hz": [1.0 / period for period in split.periods_s],
        "dead_time_error_i_apk": list(map(float, split.curve.i_phase_a)),
        "dead_time_error_v": list(map(float, split.curve.u_error_v)),
        "device_drop_v": split.V_device_v,
    }
    if math.isfinite(U_dc_v):
        facts["dead_time_equivalent_s"] = split.dead_time_s(U_dc_v)
    return facts


def split_summary(split: FrequencySplit | None, U_dc_v: float) -> str:
    """Return the inverter's error in its two parts, as a line of a summary goes on; empty without them."""
    if split is None:
        return ""
    dead_time_us = 1e6 * split.dead_time_s(U_dc_v)
    return f", dead time {dead_time_us:.3g} us ({split.V_dead_v:.3g} V), devices {split.V_device_v:.3g} V"
