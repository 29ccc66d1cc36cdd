# SPDX-License-Identifier: MIT
"""The trace of a simulated Copley amplifier: numbered variables, rows of 32-bit counts.

It runs until its memory is full or it is stopped. Data read while it runs are torn: the row being written is half old.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.drive_maps import copley_objects as objects
from pmsmtool.drive_maps.drive_map import DriveMap
from pmsmtool.drive_maps.recorder_map import Address, Channel
from pmsmtool.sim.node.dictionary import Dictionary, Entry, Refused
from pmsmtool.sim.node.objects import ObjectRow
from pmsmtool.sim.node.power_drive import Plant
from pmsmtool.sim.node.recorder_face import RecorderFace, whole

MEMORY_NUMBERS = 2048
"""Size of the simulated trace's memory."""
_TRIGGERED_BIT = 1 << 1


class TraceRows(RecorderFace):
    """Objects 0x2500 to 0x2509 of one session.

    Parameters
    ----------
    drive_map : DriveMap
        The family; its channels are the variables there are.
    dictionary : Dictionary
        Dressed as the family's.
    plant : Plant
        The drive behind.
    """

    def __init__(self, drive_map: DriveMap, dictionary: Dictionary, plant: Plant) -> None:
        super().__init__(dictionary, plant)
        self._known = {channel.number: (name, channel) for name, channel in drive_map.recorder.channels.items()}
        self._running = False
        self._rows = b""
        self._held = 0
        self._register(objects.DELAY, objects.PERIOD)
        self._keep(objects.PERIOD, b"\x01\0")
        self._shows(objects.COUNT, lambda: objects.CHANNELS)
        self._shows(objects.STATUS, self._status)
        self._shows(objects.REFERENCE_PERIOD_NS, lambda: self._plant.core.period_ns)
        self._shows(objects.RECORDED, self._recorded)
        self._shows(objects.LARGEST, self._largest)
        self._takes(objects.START, self._start, (0, 1))
        for k in range(objects.CHANNELS):
            self._takes(_channel(k), self._choose(_channel(k)))
        self._gives(objects.DATA, self._data)
        dictionary.show(_trigger_entry())

    # ---- set-up --------------------------------------------------------------------------------

    def _choose(self, address: Address) -> Callable[[bytes], None]:
        def sink(data: bytes) -> None:
            number = int.from_bytes(data, "little")
            if self._is_running():
                raise Refused(AbortCode.DEVICE_STATE)
            if number and number not in self._known:
                raise Refused(AbortCode.VALUE)
            self._keep(address, data)

        return sink

    def _chosen(self) -> list[tuple[str, Channel]]:
        numbers = [self._number(_channel(k)) for k in range(objects.CHANNELS)]
        return [self._known[number] for number in numbers if number]

    def _largest(self) -> int:
        return MEMORY_NUMBERS // max(1, len(self._chosen()))

    def _start(self, data: bytes) -> None:
        if not int.from_bytes(data, "little"):
            self._halt()
        elif not self._chosen() or not self._number(objects.PERIOD):
            raise Refused(AbortCode.NO_DATA)
        else:
            self._running, self._rows, self._held = True, b"", 0
            self._record([name for name, _ in self._chosen()], self._largest(), self._number(objects.PERIOD))
        self._keep(objects.START, data)

    # ---- data ----------------------------------------------------------------------------------

    def _is_running(self) -> bool:
        if self._running and self._complete():
            self._halt()
        return self._running

    def _halt(self) -> None:
        if self._running:
            self._running = False
            self._rows, self._held = self._so_far(), self._stored()
            self._forget()

    def _so_far(self) -> bytes:
        self._plant.look()
        chosen = self._chosen()
        counts = self._counts([name for name, _ in chosen], [channel.unit for _, channel in chosen])
        return whole(counts, "<i4").tobytes()

    def _status(self) -> int:
        return objects.RUNNING_BIT | _TRIGGERED_BIT if self._is_running() else 0

    def _recorded(self) -> int:
        return self._stored() if self._is_running() else self._held

    def _data(self) -> bytes:
        if not self._is_running():
            return self._rows
        torn = np.frombuffer(self._so_far(), "<i4").copy()
        torn[-len(self._chosen()) :] = 0
        return torn.tobytes()


def _channel(k: int) -> Address:
    index, sub, letter = objects.FIRST_CHANNEL
    return index, sub + k, letter


def _trigger_entry() -> Entry:
    """Return the trigger: kept, and without effect, since only "none" is what a caller can rely on."""
    row = ObjectRow(objects.TRIGGER, 0, "", "Trigger", "DOMAIN", "rw", "0", "", "", None, None, False)
    entry = Entry(row, 0)

    def sink(data: bytes) -> None:
        if len(data) != len(objects.NO_TRIGGER):
            raise Refused(AbortCode.LENGTH)
        if data != objects.NO_TRIGGER:
            raise Refused(AbortCode.VALUE)
        entry.value = data

    entry.value = objects.NO_TRIGGER
    entry.sink = sink
    return entry
