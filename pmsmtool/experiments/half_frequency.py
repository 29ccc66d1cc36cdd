# SPDX-License-Identifier: MIT
"""DC levels again at half the drive's control frequency: dead time halves with it, resistance and devices do not."""

from __future__ import annotations

from dataclasses import replace

from pmsmtool.drive.port import Drive
from pmsmtool.errors import ConfigError, DriveFault, NotAvailable, SdoAbort
from pmsmtool.experiments.standstill import LevelPlan, hold_levels
from pmsmtool.trace import Trace

PERIOD = "inverter.T_s_ns"
RATIO = 2
"""Control periods of the second sequence, of the drive's own."""
GAINS = tuple(f"current.K_{k}" for k in ("p_d_v_per_a", "i_d_v_per_as", "p_q_v_per_a", "i_q_v_per_as"))
"""They shrink with the frequency: the current loop keeps its margin over a period that is longer."""


def hold_at_half_frequency(drive: Drive, plan: LevelPlan) -> Trace:
    """Hold DC levels at half the control frequency; control period and current gains are put back.

    The drive is off while they change, for a period acts on a drive that is off only. It is enabled on entry and holds
    zero current on return; on every other exit the guard restores what was changed.

    Returns
    -------
    Trace
        As :func:`~pmsmtool.experiments.standstill.hold_levels`, with ``period_s`` and ``own_period_s``.

    Raises
    ------
    NotAvailable
        The drive does not take half its control frequency; it is enabled, and as it was.
    """
    own_s = drive.period_s
    before = {name: drive.read(name) for name in (PERIOD, *GAINS)}
    drive.disable()
    try:
        drive.write({PERIOD: RATIO * before[PERIOD], **{name: before[name] / RATIO for name in GAINS}})
    except (NotAvailable, ConfigError, DriveFault, SdoAbort) as refusal:
        drive.enable()
        raise NotAvailable(
            "half of the control frequency cannot be set on this drive",
            likely=str(refusal).splitlines()[0],
            hint="identify without --half-frequency",
        ) from refusal
    drive.enable()
    trace = hold_levels(drive, plan)
    facts = {"period_s": drive.period_s, "own_period_s": own_s}
    drive.disable()
    drive.write(before)
    drive.enable()
    return replace(trace, meta={**trace.meta, **facts})
