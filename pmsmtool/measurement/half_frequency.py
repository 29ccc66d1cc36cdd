# SPDX-License-Identifier: MIT
"""The levels of the resistance once more at half the control frequency, where that was asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from pmsmtool.drive.port import Drive
from pmsmtool.errors import NotAvailable
from pmsmtool.estimators.resistance import (
    FIT_FROM,
    HARD_RATIO,
    ResistanceResult,
)
from pmsmtool.experiments.half_frequency import hold_at_half_frequency
from pmsmtool.experiments.standstill import LevelPlan, calm_sequence
from pmsmtool.identification.half_frequency import TRACE
from pmsmtool.trace import Trace

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
                f"  one control frequency (no --half-frequency); dead time and devices drop "
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
