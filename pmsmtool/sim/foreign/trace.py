# SPDX-License-Identifier: MIT
"""The trace of Copley amplifiers whose file has its objects, over the recorder behind; nothing of the tool's reading.

Numbers of the variables and counts of 0.01 A and 0.1 V: Copley Motion Libraries, CML_AmpDef.h (``AMP_TRACE_VAR``) and
class Amp. Size of the memory, and refusals while it runs: assumed.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.sim.foreign.behind import Behind
from pmsmtool.sim.foreign.file_rows import MakersObjects
from pmsmtool.sim.kernel import Signal
from pmsmtool.sim.node.dictionary import Dictionary, Entry, Refused
from pmsmtool.sim.node.drive_core import RecorderSetup, RecorderState

MARKS = ((0x2500, 1), (0x2501, 0), (0x2502, 0), (0x2503, 0), (0x2504, 0), (0x2505, 0), (0x2508, 0), (0x2509, 0))
VOLT = 10.0 * math.sqrt(3.0)
VARIABLES = {
    6: (Signal.U_DC, 10.0), 9: (Signal.I_D_REF, 100.0), 10: (Signal.I_Q_REF, 100.0), 13: (Signal.I_D, 100.0),
    14: (Signal.I_Q, 100.0), 19: (Signal.U_D, VOLT), 20: (Signal.U_Q, VOLT),
}  # fmt: skip
"""Variable, and its counts per SI unit; what the drive's 0.1 V are, between lines or rms, no source says (assumed)."""
MEMORY_NUMBERS = 2048


class RowTrace:
    """Runs until its memory is full; before, it shows nothing, and a stop leaves nothing: as the recorder behind."""

    def __init__(self, objects: MakersObjects, dictionary: Dictionary, behind: Behind) -> None:
        self._plant, self._behind = behind.plant, behind
        find = dictionary.find
        self._channels = [find(0x2500, sub) for sub in range(1, 7) if objects.has((0x2500, sub))]
        self._period = find(0x2505, 0)
        self._period.put(1)
        self._running, self._rows = False, b""
        if objects.has((0x2500, 0)):
            find(0x2500, 0).shows(lambda: len(self._channels))
        find(0x2501, 0).shows(lambda: 3 * self._runs())
        find(0x2502, 0).shows(lambda: self._plant.core.period_ns)
        find(0x2503, 0).shows(lambda: 0 if self._runs() else len(self._rows) // (4 * max(1, len(self._chosen()))))
        find(0x2504, 0).shows(self._most)
        find(0x2508, 0).sink = self._command
        find(0x2509, 0).source = lambda: b"" if self._runs() else self._rows
        for entry in self._channels:
            entry.sink = self._choosing(entry)

    def _chosen(self) -> list[int]:
        return [entry.integer() for entry in self._channels if entry.integer()]

    def _most(self) -> int:
        return MEMORY_NUMBERS // max(1, len(self._chosen()))

    def _choosing(self, entry: Entry) -> Callable[[bytes], None]:
        def sink(data: bytes) -> None:
            if self._runs():
                raise Refused(AbortCode.DEVICE_STATE)
            if (number := int.from_bytes(data, "little")) and number not in VARIABLES:
                raise Refused(AbortCode.VALUE)
            entry.value = bytes(data)

        return sink

    def _command(self, data: bytes) -> None:
        word = int.from_bytes(data, "little")
        if word > 1:
            raise Refused(AbortCode.VALUE)
        if not word:
            if self._runs():
                self._running = False
                self._plant.core.record(None)
            return
        chosen, every = self._chosen(), self._period.integer()
        if not chosen or not every:
            raise Refused(AbortCode.NO_DATA)
        self._running, self._rows = True, b""
        self._behind.record(RecorderSetup([VARIABLES[number][0] for number in chosen], self._most(), every))

    def _runs(self) -> bool:
        self._plant.look()
        if self._running and self._plant.core.recorder().state is RecorderState.COMPLETE:
            recorded = self._plant.core.recording()
            scales = [VARIABLES[number][1] for number in self._chosen()]
            values = struct.unpack(f"<{len(recorded) // 4}f", recorded)
            counts = (round(scales[k % len(scales)] * value) for k, value in enumerate(values))
            self._rows, self._running = struct.pack(f"<{len(values)}i", *counts), False
        return self._running
