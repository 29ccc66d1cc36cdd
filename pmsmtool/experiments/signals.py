# SPDX-License-Identifier: MIT
"""Signals of the drive as the estimators read them: one name each, and one flag for samples that must not be used."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pmsmtool.drive.objects import signal_unit
from pmsmtool.trace import Trace

UNUSABLE_FLAGS = 1 << 0 | 1 << 1 | 1 << 9
"""Voltage limited, duty clipped, ADC at full scale (``enum pmsm_flag``)."""


def readable(trace: Trace, **facts: Any) -> Trace:
    """Return a recording with ``theta_M_rad`` and ``flagged``, and with facts added to its meta."""
    signals = dict(trace.signals)
    if "theta_m_rad" in signals:
        signals["theta_M_rad"] = signals.pop("theta_m_rad")
    if "flags" in signals:
        signals["flagged"] = flagged(signals.pop("flags"))
    return Trace(trace.t_s, signals, {name: signal_unit(name) for name in signals}, {**trace.meta, **facts})


def flagged(flags: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return 1 where a flag word names a limit, else 0."""
    return np.asarray((np.asarray(flags).astype(np.int64) & UNUSABLE_FLAGS) != 0, dtype=np.float64)


def table(rows: Sequence[Mapping[str, float]], times: Sequence[float], **facts: Any) -> Trace:
    """Return one trace with a row per measurement.

    Parameters
    ----------
    rows : sequence of mapping of str to float
        The same names in every row.
    times : sequence of float
        When each was taken (s, bus clock), increasing.
    """
    names = list(rows[0])
    start = times[0]
    return Trace(
        np.array([time - start for time in times], dtype=np.float64),
        {name: np.array([row[name] for row in rows], dtype=np.float64) for name in names},
        {name: signal_unit(name) for name in names},
        dict(facts),
    )
