# SPDX-License-Identifier: MIT
"""The data recorder of maxon EPOS2 drives behind the recorder's port: a ring of words for each variable, in one buffer.

A ring is read from its oldest sample on. The recorder is triggered by command with nothing kept from before, so that
the oldest sample is the first after the trigger.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pmsmtool.drive.recorders.commanded import CommandedRecorder, numbered
from pmsmtool.drive_maps import epos2_objects as objects
from pmsmtool.drive_maps.drive_map import LETTERS
from pmsmtool.drive_maps.recorder_map import Channel
from pmsmtool.drive_maps.wire_units import wire_unit
from pmsmtool.errors import NotAvailable, SdoAbort, VerifyMismatch
from pmsmtool.trace import Trace


class RingRecorder(CommandedRecorder):
    """Recorder of a drive whose map says ``recorder = "rings"``."""

    what = "data recorder"
    start = "0x2010:00"
    data = "0x201B:00"
    memory = "0x2018:00"

    def _base_period_s(self) -> float:
        self._get(objects.STATUS)
        unit = self._node.map.recorder.period
        if not unit:
            raise NotAvailable(
                f"the drive map {self._node.map.name!r} does not state what one count of the recorder's period is",
                where=f"node {self._node.node}, 0x2012:00",
                hint='from the manual of the drive, a row such as `period = { unit = "us" }` in its table [recorder]',
            )
        return wire_unit(unit).scale

    def _start(self, signals: Sequence[str], samples: int, decimation: int) -> None:
        self._put(objects.CONFIGURATION, 0)
        self._put(objects.PERIOD, decimation)
        self._put(objects.PRECEDING, 0)
        self._command(objects.CONTROL, objects.START)
        self._command(objects.CONTROL, objects.FORCE_TRIGGER)

    def room(self, signals: Sequence[str]) -> int:
        """Stop the recorder, choose its variables, and return how many samples of them fit."""
        channels = self._variables(signals)
        self.halt()
        for k, channel in enumerate(channels):
            try:
                self._put(numbered(objects.FIRST_INDEX, k), channel.index)
                self._put(numbered(objects.FIRST_SUB, k), channel.sub)
            except SdoAbort as abort:
                raise NotAvailable(
                    f"the drive does not record 0x{channel.index:04X}:{channel.sub:02X} ({signals[k]})",
                    where=abort.where,
                ) from abort
        self._put(objects.USED, len(channels))
        largest = self._get(objects.LARGEST)
        if largest * len(channels) > objects.BUFFER_WORDS:
            raise VerifyMismatch(
                "the data recorder has not taken the variables", where=f"node {self._node.node}, 0x2018:00",
                differences=[f"{len(channels)} rings of {largest} do not fit {objects.BUFFER_WORDS} words"],
                hint="reset the drive: another program may be using its recorder",
            )  # fmt: skip
        return largest

    def fetch(self, signals: Sequence[str], decimation: int) -> Trace:
        """Wait until the record is long enough, stop the recorder and read its buffer.

        Raises
        ------
        DriveFault
            The drive went into fault meanwhile.
        DriveTimeout
            The recorder was not triggered, does not fill, or does not stop.
        VerifyMismatch
            It holds fewer samples than asked for or more than it can, or it moved while it was read.
        """
        channels = self._variables(signals)
        self._until(
            lambda: (
                bool(self._get(objects.STATUS) & objects.TRIGGERED_BIT)
                and (self._get(objects.RECORDED) >= self._samples or not self._running())
            ),
            "the data recorder",
            "0x2017:00",
            lasts_s=self._lasts_s(decimation),
        )
        self.halt()
        place = self._place()
        stored, largest, first = place
        if not self._samples <= stored <= largest:
            raise self._wrong(f"{self._samples} samples were asked for, {stored} of at most {largest} are there")
        if first >= largest:
            raise self._wrong(f"a ring of {largest} samples cannot begin at {first}")
        words = largest * len(channels)
        data = self._node.sdo.upload(objects.BUFFER, 0).data
        if self._running() or self._place() != place:
            raise self._wrong("the data recorder ran on while it was read")
        if len(data) < words * objects.WORD_BYTES:
            raise self._wrong(f"{words} words are in use, {len(data)} bytes came")
        counts = {}
        for k, (name, channel) in enumerate(zip(signals, channels, strict=True)):
            ring = np.frombuffer(
                data, "<" + LETTERS[channel.wire], count=largest, offset=k * largest * objects.WORD_BYTES
            )
            counts[name] = np.roll(ring, -first)[: self._samples]
        return self._in_si(counts, [channel.unit for channel in channels], decimation)

    def _variables(self, signals: Sequence[str]) -> list[Channel]:
        return self._chosen(signals, self._node.map.recorder.channels, objects.VARIABLES)

    def _place(self) -> tuple[int, int, int]:
        """Return how many samples there are, how many there may be, and where the oldest is."""
        return self._get(objects.RECORDED), self._get(objects.LARGEST), self._get(objects.FIRST)

    def _running(self) -> bool:
        return bool(self._get(objects.STATUS) & objects.RUNNING_BIT)

    def halt(self) -> None:
        """Stop the recorder; what was recorded stays."""
        self._command(objects.CONTROL, objects.STOP)
        self._until(lambda: not self._running(), "stopping the data recorder", "0x2017:00")
