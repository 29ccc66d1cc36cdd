# SPDX-License-Identifier: MIT
"""The monitor of Novanta/Ingenia Summit drives behind the recorder's port: rows read block by block from one register.

The drive has no CRC over its rows. What it has is a count of the bytes left: every block must take exactly its own
length off it, else a block was lost or came twice, and the record is refused.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pmsmtool.drive.recorders.commanded import CommandedRecorder
from pmsmtool.drive_maps import ingenia_objects as objects
from pmsmtool.drive_maps.drive_map import LETTERS, SignalCell
from pmsmtool.errors import NotAvailable, VerifyMismatch
from pmsmtool.trace import Trace


class MonitorRecorder(CommandedRecorder):
    """Recorder of a drive whose map says ``recorder = "index"``."""

    what = "monitor"
    start = "0x58F0:00"
    data = "0x58B2:00"
    memory = "0x58B5:00"

    def _base_period_s(self) -> float:
        rate_hz, self._largest = self._get(objects.LOOP_RATE_HZ), self._get(objects.LARGEST_BYTES)
        if rate_hz <= 0:
            raise NotAvailable(
                f"the drive reports a loop rate of {rate_hz} Hz", where=f"node {self._node.node}, 0x2520:00"
            )
        return 1.0 / rate_hz

    def room(self, signals: Sequence[str]) -> int:
        """Return how many samples of signals fit."""
        return self._largest // sum(cell.size for cell in self._cells(signals))

    def _start(self, signals: Sequence[str], samples: int, decimation: int) -> None:
        cells = self._cells(signals)
        row_bytes = sum(cell.size for cell in cells)
        self.halt()
        self._put(objects.MAPPED, 0)
        self._command(objects.REMOVE_DATA, 1)
        for k, cell in enumerate(cells):
            word = objects.mapping_word(cell.index, cell.wire, cell.size)
            self._put((objects.FIRST_MAP[0] + k, *objects.FIRST_MAP[1:]), word)
            self._put(objects.MAPPED, k + 1)
        self._put(objects.DIVIDER, decimation)
        self._put(objects.TRIGGER_KIND, objects.FORCED)
        self._put(objects.WINDOW, samples)
        self._command(objects.ENABLE, 1)
        said = self._get(objects.ROW_BYTES)
        if said != row_bytes:
            raise VerifyMismatch(
                "the monitor has not taken the signals", where=f"node {self._node.node}, 0x58E4:00",
                differences=[f"{row_bytes} bytes per row are mapped, the drive reports {said}"],
                hint="compare the types in the map's [signals] with the drive's manual",
            )  # fmt: skip
        if not self._get(objects.STATUS) & objects.ENABLED_BIT:
            raise NotAvailable("the monitor does not start", where=f"node {self._node.node}, 0x58B0:00")
        self._command(objects.FORCE_TRIGGER, 1)

    def fetch(self, signals: Sequence[str], decimation: int) -> Trace:
        """Wait until the record is complete and read it.

        Raises
        ------
        DriveFault
            The drive went into fault meanwhile.
        DriveTimeout
            The monitor does not fill.
        VerifyMismatch
            Blocks are missing, came twice, or the number of rows is another.
        """
        cells = self._cells(signals)
        row = np.dtype([(name, "<" + LETTERS[cell.wire]) for name, cell in zip(signals, cells, strict=True)])
        expected = self._samples * row.itemsize
        self._until(
            lambda: bool(self._get(objects.STATUS) & objects.AVAILABLE_BIT),
            "the monitor",
            "0x58B0:00",
            lasts_s=self._lasts_s(decimation),
        )
        table = np.frombuffer(self._read(expected), row)
        self.halt()
        return self._in_si({name: table[name] for name in signals}, [cell.unit for cell in cells], decimation)

    def halt(self) -> None:
        """Disable the monitor."""
        self._command(objects.ENABLE, 0)

    def _read(self, expected: int) -> bytes:
        """Read blocks until nothing is left."""
        data = b""
        left = self._get(objects.BYTES_LEFT)
        if left != expected:
            raise self._wrong(f"{expected} bytes were asked for, {left} are there")
        while left:
            size = min(left, objects.BLOCK_BYTES)
            block = self._node.sdo.upload(objects.DATA, 0).data
            now = self._get(objects.BYTES_LEFT)
            if len(block) < size or left - now != size:
                raise self._wrong(f"a block of {len(block)} bytes took {left - now} off the count, {size} were due")
            data += block[:size]
            left = now
        return data

    def _known(self) -> dict[str, SignalCell]:
        return {name: cell for name, cell in self._node.map.signals.items() if not name.startswith("target_")}

    def _cells(self, signals: Sequence[str]) -> list[SignalCell]:
        return self._chosen(signals, self._known(), objects.CHANNELS)
