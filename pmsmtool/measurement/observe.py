# SPDX-License-Identifier: MIT
"""What a machine in operation shows to whoever commands nothing: by process data, or recording after recording.

By process data transmit PDOs are borrowed, by recordings the drive's recorder; what either of them was is brought back.
Whatever ends it, the collected :class:`Observations` hold what was seen until then.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.drive import objects
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.objects import signal_unit
from pmsmtool.drive.process_data import live_values, sent_every_s
from pmsmtool.drive.stop import interrupts_deferred
from pmsmtool.errors import ConfigError
from pmsmtool.estimators.tracking_model import RISES, SIGNALS, steady, windows
from pmsmtool.trace import Trace

NAMES = (*SIGNALS, "T_winding_c")
"""What is asked of the drive: as much as three process data objects hold."""
SAMPLES_PER_WINDOW = 4
"""Process data that make one observation."""
EXTRA, GAP = 0.75, 1.5
"""Times the period that was asked for: what comes sooner is one too many, a longer step a gap that no window spans."""
RECORD_ROWS, RECORD_WINDOWS = 1024, 4
"""Rows of one recording, and observations that it makes."""
RECORD_S = 0.2
"""Time of one recording (s)."""
GIVEN_BACK = "nothing was commanded; all temporarily changed objects were restored"
"""What is said, and kept in the account of a run, when an observation is over."""
SAY_S = 1.0
LOOK_S = 0.05
"""While the drive sends by itself, its supervision is looked at this often."""

Say = Callable[[str], None]


class Observations:
    """What was observed so far."""

    def __init__(self) -> None:
        self._parts: list[Trace] = []

    def add(self, part: Trace, rows: int, period_s: float | None = None) -> None:
        """Take samples without a gap, ``rows`` of which make a window; as ``tracking_model.windows``."""
        self._parts.append(windows(part, rows, period_s))

    def __len__(self) -> int:
        return sum(map(len, self._parts))

    def trace(self) -> Trace:
        """Return those in which the machine ran steadily."""
        return joined(steady(self._parts))


def observe_process_data(
    node: DriveNode, seconds: float, rate_hz: float, seen: Observations, say: Say = lambda text: None
) -> None:
    """Collect what the drive sends by itself, ``rate_hz`` times a second.

    Raises NotAvailable: the drive cannot send these quantities; ConfigError: nothing arrived.
    """
    clock = node.connection.clock
    rows: list[tuple[float, ...]] = []
    with live_values(node, NAMES, 1.0 / rate_hz) as live:
        live.on_set = lambda stamp_s: rows.append((stamp_s, clock.now(), *(live.values[name] for name in NAMES)))
        start, told = clock.now(), 0.0
        try:
            while (t := clock.now() - start) < seconds:
                node.connection.wait(min(LOOK_S, seconds))
                node.supervision.check()
                if t - told >= SAY_S:
                    told = t
                    say(f"{t:.0f} s, {len(rows)} samples")
        finally:
            with interrupts_deferred():
                period_s, parts = without_gaps(np.array(rows).reshape(-1, 2 + len(NAMES)), sent_every_s(1.0 / rate_hz))
                for part in parts:
                    seen.add(part, SAMPLES_PER_WINDOW, period_s)
    if not rows:
        raise ConfigError("no process data arrived", hint="a lower --rate, or --by trace")


def without_gaps(rows: Array, asked_s: float) -> tuple[float, list[Trace]]:
    """Return the mean step (s) of process data and the data, cut where some is missing.

    Their instants are the bus's time stamps: when this computer came to read them says nothing of the drive. An
    adapter that stamps nothing leaves only that. What a drive sends besides, at every change of something, is left out:
    at uneven steps the halves of a window would be unequal.

    Parameters
    ----------
    rows : ndarray, shape (n, 2 + len(NAMES))
        Time stamp of the bus (s), instant of reading (s), values.
    asked_s : float
        Period that was asked for (s).
    """
    instants = rows[:, 0] if np.all(np.diff(rows[:, 0]) > 0.0) else rows[:, 1]
    taken, last = [], -math.inf
    for k, instant in enumerate(instants.tolist()):
        if instant - last >= EXTRA * asked_s:
            taken.append(k)
            last = instant
    rows, t_s = rows[taken], instants[taken] - instants[:1]
    step = np.diff(t_s)
    missing = step > GAP * asked_s
    if np.all(missing):
        return asked_s, []
    starts = [0, *(np.flatnonzero(missing) + 1), len(t_s)]
    pieces = [slice(a, b) for a, b in itertools.pairwise(starts)]
    units = {name: signal_unit(name) for name in NAMES}
    parts = [Trace(t_s[cut], {n: rows[cut, k] for k, n in enumerate(NAMES, 2)}, units) for cut in pieces]
    return float(np.mean(step[~missing])), parts


def observe_recordings(drive: CanopenDrive, seconds: float, seen: Observations, say: Say = lambda text: None) -> None:
    """Collect recordings of the drive's trace recorder, one after the other; its set-up is brought back.

    Raises NotAvailable: the drive has no recorder, or not these signals.
    """
    clock = drive.node.connection.clock
    decimation = max(1, round(RECORD_S / (RECORD_ROWS * drive.period_s)))
    with _recorder_kept(drive):
        start, told = clock.now(), 0.0
        while (t := clock.now() - start) < seconds:
            record = drive.record((*NAMES, "flags"), RECORD_ROWS, decimation=decimation)
            shifted = Trace(record.t_s - record.t_s[0] + t, record.signals, record.units, record.meta)
            seen.add(shifted, RECORD_ROWS // RECORD_WINDOWS)
            if t - told >= SAY_S:
                told = t
                say(f"{t:.0f} s, {len(seen)} windows")


@contextmanager
def _recorder_kept(drive: CanopenDrive) -> Iterator[None]:
    """Note the recorder's set-up and bring it back."""
    kept = (
        *objects.TRACE_CHANNELS,
        objects.TRACE_DECIMATION,
        objects.TRACE_PRETRIGGER,
        objects.TRACE_DEPTH,
        objects.TRACE_TRIGGER,
    )
    drive.recorder.forget()
    before = [(item, drive.node.whole(item)) for item in kept]
    try:
        yield
    finally:
        with interrupts_deferred() as noted:
            drive.node.put(objects.TRACE_PRETRIGGER, 0)
            for item, value in sorted(before, key=lambda pair: pair[0] is objects.TRACE_PRETRIGGER):
                drive.node.put(item, value)
            drive.recorder.forget()
        if noted:
            raise KeyboardInterrupt


def joined(parts: Sequence[Trace]) -> Trace:
    """Return observations one after the other, each part from where the last one ended, unless it starts later."""
    times, last = [], -math.inf
    for part in parts:
        if not len(part):
            continue
        step = float(part.meta.get("window_s", 0.0)) or (part.period_s if len(part) > 1 else 1.0)
        start = max(float(part.t_s[0]), last + step) if math.isfinite(last) else float(part.t_s[0])
        times.append(part.t_s - part.t_s[0] + start)
        last = float(times[-1][-1])
    filled = [part for part in parts if len(part)]
    names = [name for name in (*NAMES, *RISES) if all(name in part.signals for part in filled)]
    if not filled:
        return Trace(np.zeros(0), {name: np.zeros(0) for name in SIGNALS}, {n: signal_unit(n) for n in SIGNALS}, {})
    lengths = {(float(part.meta.get("window_s", 0.0)), int(part.meta.get("rows", 0))) for part in filled}
    if len(lengths) > 1:  # rises over windows of different lengths are no common column
        names = [name for name in names if name not in RISES]
    return Trace(
        np.concatenate(times),
        {name: np.concatenate([part[name] for part in filled]) for name in names},
        {name: filled[0].units[name] for name in names},
        dict(zip(("window_s", "rows"), lengths.pop(), strict=True)) if len(lengths) == 1 else {},
    )
