# SPDX-License-Identifier: MIT
"""The trace of Copley Controls amplifiers behind the recorder's port: numbered variables, a row of them per sample.

The trace stops by itself when its buffer is full; a shorter record is stopped when it is long enough. Data read while
it runs may be torn: the trace must stand still before the data are read, and must not have moved afterwards.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pmsmtool.drive.recorders.commanded import CommandedRecorder, numbered
from pmsmtool.drive_maps import copley_objects as objects
from pmsmtool.drive_maps.recorder_map import Channel
from pmsmtool.errors import NotAvailable, SdoAbort
from pmsmtool.trace import Trace


class RowRecorder(CommandedRecorder):
    """Recorder of a drive whose map says ``recorder = "rows"``."""

    what = "trace"
    start = "0x2508:00"
    data = "0x2509:00"
    memory = "0x2504:00"

    def _base_period_s(self) -> float:
        reference_ns = self._get(objects.REFERENCE_PERIOD_NS)
        self._channels_there = min(self._get(objects.COUNT), objects.CHANNELS)
        if reference_ns <= 0:
            raise NotAvailable("the drive reports no sampling period", where=f"node {self._node.node}, 0x2502:00")
        return 1e-9 * reference_ns

    def _start(self, signals: Sequence[str], samples: int, decimation: int) -> None:
        self._put(objects.PERIOD, decimation)
        self._put(objects.DELAY, 0)
        self._node.write_bytes(objects.TRIGGER, 0, objects.NO_TRIGGER)
        self._command(objects.START, 1)

    def room(self, signals: Sequence[str]) -> int:
        """Stop the trace, choose its variables, and return how many rows of them fit."""
        channels = self._variables(signals)
        self.halt()
        for k in range(self._channels_there):
            number = channels[k].number if k < len(channels) else 0
            try:
                self._put(numbered(objects.FIRST_CHANNEL, k), number)
            except SdoAbort as abort:
                raise NotAvailable(
                    f"the drive does not trace variable {number} ({signals[k] if k < len(signals) else 'none'})",
                    where=abort.where,
                ) from abort
        return self._get(objects.LARGEST)

    def fetch(self, signals: Sequence[str], decimation: int) -> Trace:
        """Wait until the record is long enough, stop the trace and read it.

        Raises
        ------
        DriveFault
            The drive went into fault meanwhile.
        DriveTimeout
            The trace does not fill, or does not stop.
        VerifyMismatch
            It holds fewer rows than asked for or more than it can, or it moved while it was read.
        """
        channels = self._variables(signals)
        self._until(
            lambda: self._get(objects.RECORDED) >= self._samples or not self._running(),
            "the trace",
            "0x2503:00",
            lasts_s=self._lasts_s(decimation),
        )
        self.halt()
        stored, largest = self._get(objects.RECORDED), self._get(objects.LARGEST)
        if not self._samples <= stored <= largest:
            raise self._wrong(f"{self._samples} rows were asked for, {stored} of at most {largest} are there")
        size = stored * len(channels) * objects.NUMBER_BYTES
        data = self._node.sdo.upload(objects.DATA, 0, size=size).data
        if self._running() or self._get(objects.RECORDED) != stored:
            raise self._wrong("the trace ran on while it was read")
        table = np.frombuffer(data, "<i4").reshape(stored, len(channels))[: self._samples]
        counts = {name: table[:, k] for k, name in enumerate(signals)}
        return self._in_si(counts, [channel.unit for channel in channels], decimation)

    def _variables(self, signals: Sequence[str]) -> list[Channel]:
        return self._chosen(signals, self._node.map.recorder.channels, self._channels_there)

    def _running(self) -> bool:
        return bool(self._get(objects.STATUS) & objects.RUNNING_BIT)

    def halt(self) -> None:
        """Stop the trace; what was recorded stays."""
        self._command(objects.START, 0)
        self._until(lambda: not self._running(), "stopping the trace", "0x2501:00")
