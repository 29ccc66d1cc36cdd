# SPDX-License-Identifier: MIT
"""The data recorder of a simulated maxon EPOS2 drive: a ring of words per variable, at a period of its own.

Its period is counted in the map's unit and need not be a multiple of the control period: a sample is what the drive
last held at its instant. It stops by itself when the rings are full; before, the buffer is being written.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.drive_maps import epos2_objects as objects
from pmsmtool.drive_maps.drive_map import LETTERS, DriveMap
from pmsmtool.drive_maps.recorder_map import Address, Channel
from pmsmtool.drive_maps.wire_units import wire_unit
from pmsmtool.sim.node.dictionary import Dictionary, Refused
from pmsmtool.sim.node.power_drive import Plant
from pmsmtool.sim.node.recorder_face import RecorderFace, whole

STOOD_AT = 5
"""Where in its ring a variable stands when the trigger comes."""
FINE = 8
"""Rows kept per sample where the period is no multiple of the control period."""
MULTIPLE = 1e-6
COUNT_S = 1e-4
"""What a count of the period is worth where the map does not say it: the drive has one all the same."""


class Rings(RecorderFace):
    """Objects 0x2010 to 0x201B of one session.

    Parameters
    ----------
    drive_map : DriveMap
        The family; its channels are the objects that can be recorded.
    dictionary : Dictionary
        Dressed as the family's.
    plant : Plant
        The drive behind.
    """

    def __init__(self, drive_map: DriveMap, dictionary: Dictionary, plant: Plant) -> None:
        super().__init__(dictionary, plant)
        channels = drive_map.recorder.channels
        self._known = {(channel.index, channel.sub): (name, channel) for name, channel in channels.items()}
        self._count_s = wire_unit(drive_map.recorder.period).scale if drive_map.recorder.period else COUNT_S
        self._armed = self._triggered = False
        self._held: tuple[int, bytes] = (0, b"")
        self._row_s = self._sample_s = 1.0
        self._register(objects.PERIOD, objects.PRECEDING)
        self._keeps(objects.CONFIGURATION, range(1 << 4))
        self._keeps(objects.USED, range(objects.VARIABLES + 1))
        self._keep(objects.PERIOD, (10).to_bytes(2, "little"))
        for k in range(objects.VARIABLES):
            for first in (objects.FIRST_INDEX, objects.FIRST_SUB):
                self._takes(_of(first, k), self._choose(_of(first, k)))
        self._takes(objects.CONTROL, self._control, (objects.START, objects.FORCE_TRIGGER, objects.STOP))
        self._shows(objects.STATUS, self._status)
        self._shows(objects.LARGEST, self._largest)
        self._shows(objects.RECORDED, lambda: self._taken()[0])
        self._shows(objects.FIRST, lambda: STOOD_AT % max(1, self._largest()))
        self._gives(objects.BUFFER, lambda: self._taken()[1])

    # ---- set-up --------------------------------------------------------------------------------

    def _choose(self, address: Address) -> Callable[[bytes], None]:
        def sink(data: bytes) -> None:
            if self._is_running():
                raise Refused(AbortCode.DEVICE_STATE)
            index = int.from_bytes(data, "little")
            if address[0] == objects.FIRST_INDEX[0] and index and index not in {place[0] for place in self._known}:
                raise Refused(AbortCode.NOT_MAPPABLE)
            self._keep(address, data)

        return sink

    def _chosen(self) -> list[tuple[str, Channel]]:
        places = [
            (self._number(_of(objects.FIRST_INDEX, k)), self._number(_of(objects.FIRST_SUB, k)))
            for k in range(min(self._number(objects.USED), objects.VARIABLES))
        ]
        return [self._known[place] for place in places if place in self._known]

    def _largest(self) -> int:
        return objects.BUFFER_WORDS // max(1, len(self._chosen()))

    def _control(self, data: bytes) -> None:
        word = int.from_bytes(data, "little")
        if word == objects.FORCE_TRIGGER:
            self._trigger()
        elif word & objects.START:
            if not self._chosen() or not self._number(objects.PERIOD):
                raise Refused(AbortCode.NO_DATA)
            self._halt()
            self._armed, self._triggered, self._held = True, False, (0, b"")
        else:
            self._halt()

    def _trigger(self) -> None:
        if not self._armed or self._triggered:
            return
        self._triggered = True
        self._sample_s = self._number(objects.PERIOD) * self._count_s
        period_s = 1e-9 * self._plant.core.period_ns
        periods = self._sample_s / period_s
        whole_periods = abs(periods - round(periods)) < MULTIPLE * periods
        decimation = max(1, round(periods) if whole_periods else int(periods / FINE))
        self._row_s = decimation * period_s
        rows = 1 + int(np.ceil((self._largest() - 1) * self._sample_s / self._row_s))
        self._record([name for name, _ in self._chosen()], rows, decimation)

    # ---- data ----------------------------------------------------------------------------------

    def _is_running(self) -> bool:
        if self._armed and self._triggered and self._complete():
            self._halt()
        return self._armed

    def _halt(self) -> None:
        if self._armed:
            self._held = self._filled()
            self._armed = False
            self._forget()

    def _status(self) -> int:
        running = objects.RUNNING_BIT if self._is_running() else 0
        return running | (objects.TRIGGERED_BIT if self._triggered else 0)

    def _taken(self) -> tuple[int, bytes]:
        """Return how many samples there are, and the buffer."""
        return self._filled() if self._is_running() else self._held

    def _filled(self) -> tuple[int, bytes]:
        """Return samples and buffer as the recorder stands now."""
        stored, largest, chosen = self._stored() if self._triggered else 0, self._largest(), self._chosen()
        buffer = np.zeros(objects.BUFFER_WORDS, "<u2")
        if not stored:
            return 0, buffer.tobytes()
        counts = self._counts([name for name, _ in chosen], [channel.unit for _, channel in chosen])
        at = np.floor(np.arange(largest) * (self._sample_s / self._row_s) + MULTIPLE).astype(np.int64)
        samples = counts[at[at < stored]]
        for k, (_, channel) in enumerate(chosen):
            words = whole(samples[:, k], "<" + LETTERS[channel.wire]).view("<u2")
            ring = np.zeros(largest, "<u2")
            ring[: len(words)] = words
            buffer[k * largest : (k + 1) * largest] = np.roll(ring, STOOD_AT % largest)
        return len(samples), buffer.tobytes()


def _of(first: Address, k: int) -> Address:
    index, sub, letter = first
    return index, sub + k, letter
