# SPDX-License-Identifier: MIT
"""Recorders of simulated drives of other makers: maxon EPOS2, Novanta/Ingenia and Copley, over the one behind."""

from __future__ import annotations

from functools import partial

import numpy as np

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.drive_maps import copley_objects as copley
from pmsmtool.drive_maps import epos2_objects as epos2
from pmsmtool.drive_maps import ingenia_objects as ingenia
from pmsmtool.drive_maps.drive_map import LETTERS, DriveMap, SignalCell
from pmsmtool.drive_maps.recorder_map import Address, Channel
from pmsmtool.drive_maps.wire_units import wire_unit
from pmsmtool.sim.node.dictionary import Dictionary, Entry, Refused
from pmsmtool.sim.node.objects import ObjectRow
from pmsmtool.sim.node.power_drive import Plant
from pmsmtool.sim.node.recorder_face import SIGNALS, RecorderFace, whole

STOOD_AT = 5
"""Where in its ring a variable stands when the trigger comes."""
FINE = 8
"""Rows kept per sample where the period is no multiple of the control period."""
MULTIPLE = 1e-6
COUNT_S = 1e-4
"""What a count of the period is worth where the map does not say it: the drive has one all the same."""
MEMORY_BYTES = 8192
"""Of the monitor."""
MEMORY_NUMBERS = 2048
"""Of the trace."""
_TRIGGERED_BIT = 1 << 1


class Rings(RecorderFace):
    """The data recorder of an EPOS2, objects 0x2010 to 0x201B: a ring of words per variable.

    Its period is counted in the map's unit and need not be a multiple of the control period: a sample is what the drive
    last held at its instant. It stops by itself when the rings are full; before, the buffer is being written.
    """

    def __init__(self, drive_map: DriveMap, dictionary: Dictionary, plant: Plant) -> None:
        super().__init__(dictionary, plant)
        channels = drive_map.recorder.channels
        self._known = {(channel.index, channel.sub): (name, channel) for name, channel in channels.items()}
        self._count_s = wire_unit(drive_map.recorder.period).scale if drive_map.recorder.period else COUNT_S
        self._armed = self._triggered = False
        self._held: tuple[int, bytes] = (0, b"")
        self._row_s = self._sample_s = 1.0
        self._register(epos2.PERIOD, epos2.PRECEDING)
        self._keeps(epos2.CONFIGURATION, range(1 << 4))
        self._keeps(epos2.USED, range(epos2.VARIABLES + 1))
        self._keep(epos2.PERIOD, (10).to_bytes(2, "little"))
        for k in range(epos2.VARIABLES):
            for first in (epos2.FIRST_INDEX, epos2.FIRST_SUB):
                self._takes(_of(first, k), partial(self._choose, _of(first, k)))
        self._takes(epos2.CONTROL, self._control, (epos2.START, epos2.FORCE_TRIGGER, epos2.STOP))
        self._shows(epos2.STATUS, self._status)
        self._shows(epos2.LARGEST, self._largest)
        self._shows(epos2.RECORDED, lambda: self._taken()[0])
        self._shows(epos2.FIRST, lambda: STOOD_AT % max(1, self._largest()))
        self._gives(epos2.BUFFER, lambda: self._taken()[1])

    # ---- set-up --------------------------------------------------------------------------------

    def _choose(self, address: Address, data: bytes) -> None:
        if self._is_running():
            raise Refused(AbortCode.DEVICE_STATE)
        index = int.from_bytes(data, "little")
        if address[0] == epos2.FIRST_INDEX[0] and index and index not in {place[0] for place in self._known}:
            raise Refused(AbortCode.NOT_MAPPABLE)
        self._keep(address, data)

    def _chosen(self) -> list[tuple[str, Channel]]:
        places = [
            (self._number(_of(epos2.FIRST_INDEX, k)), self._number(_of(epos2.FIRST_SUB, k)))
            for k in range(min(self._number(epos2.USED), epos2.VARIABLES))
        ]
        return [self._known[place] for place in places if place in self._known]

    def _largest(self) -> int:
        return epos2.BUFFER_WORDS // max(1, len(self._chosen()))

    def _control(self, data: bytes) -> None:
        word = int.from_bytes(data, "little")
        if word == epos2.FORCE_TRIGGER:
            self._trigger()
        elif word & epos2.START:
            if not self._chosen() or not self._number(epos2.PERIOD):
                raise Refused(AbortCode.NO_DATA)
            self._halt()
            self._armed, self._triggered, self._held = True, False, (0, b"")
        else:
            self._halt()

    def _trigger(self) -> None:
        if not self._armed or self._triggered:
            return
        self._triggered = True
        self._sample_s = self._number(epos2.PERIOD) * self._count_s
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
        running = epos2.RUNNING_BIT if self._is_running() else 0
        return running | (epos2.TRIGGERED_BIT if self._triggered else 0)

    def _taken(self) -> tuple[int, bytes]:
        """Return how many samples there are, and the buffer."""
        return self._filled() if self._is_running() else self._held

    def _filled(self) -> tuple[int, bytes]:
        """Return samples and buffer as the recorder stands now."""
        stored, largest, chosen = self._stored() if self._triggered else 0, self._largest(), self._chosen()
        buffer = np.zeros(epos2.BUFFER_WORDS, "<u2")
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


class Monitor(RecorderFace):
    """The monitor of an Ingenia drive, objects 0x58B0 to 0x58F3: rows of REAL32 in the family's units.

    Reading the data register takes a block of 512 bytes out of the memory, whether its answer arrives or not.
    """

    def __init__(self, drive_map: DriveMap, dictionary: Dictionary, plant: Plant) -> None:
        super().__init__(dictionary, plant)
        self._cells = {cell.index: (name, cell) for name, cell in drive_map.signals.items() if name in SIGNALS}
        self._rows = b""
        self._running = False
        self._fetched = True
        self._register(ingenia.DIVIDER, ingenia.WINDOW)
        self._keeps(ingenia.MAPPED, range(ingenia.CHANNELS + 1))
        self._keeps(ingenia.TRIGGER_KIND, (0, ingenia.FORCED))  # no edge trigger here
        self._shows(ingenia.STATUS, self._status)
        self._shows(ingenia.LARGEST_BYTES, lambda: MEMORY_BYTES)
        self._shows(ingenia.BYTES_LEFT, lambda: len(self._collected()))
        self._shows(ingenia.ROW_BYTES, lambda: 4 * len(self._mapped()))
        self._shows(ingenia.LOOP_RATE_HZ, lambda: round(1e9 / self._plant.core.period_ns))
        self._takes(ingenia.ENABLE, self._enable, (0, 1))
        self._takes(ingenia.REMOVE_DATA, self._remove, (1,))
        self._takes(ingenia.FORCE_TRIGGER, self._trigger, (1,))
        for k in range(ingenia.CHANNELS):
            self._takes(_map_word(k), partial(self._map, _map_word(k)))
        self._gives(ingenia.DATA, self._block)

    # ---- set-up --------------------------------------------------------------------------------

    def _map(self, address: Address, data: bytes) -> None:
        word = int.from_bytes(data, "little")
        if self._running or (word and ingenia.mapped_index(word) not in self._cells):
            raise Refused(AbortCode.NOT_MAPPABLE)
        self._keep(address, data)

    def _mapped(self) -> list[tuple[str, SignalCell]]:
        words = [self._number(_map_word(k)) for k in range(self._number(ingenia.MAPPED))]
        return [self._cells[ingenia.mapped_index(word)] for word in words]

    def _enable(self, data: bytes) -> None:
        wanted = bool(int.from_bytes(data, "little"))
        channels = self._mapped() if wanted else []
        if wanted and not (channels and self._number(ingenia.DIVIDER) and self._number(ingenia.WINDOW)):
            raise Refused(AbortCode.NO_DATA)
        if 4 * len(channels) * self._number(ingenia.WINDOW) > MEMORY_BYTES:
            raise Refused(AbortCode.PDO_LENGTH)
        self._running = wanted
        self._fetched = True  # nothing before a trigger
        self._keep(ingenia.ENABLE, data)

    def _remove(self, data: bytes) -> None:
        self._forget()
        self._rows = b""
        self._fetched = True

    def _trigger(self, data: bytes) -> None:
        if not self._running or self._number(ingenia.TRIGGER_KIND) != ingenia.FORCED:
            raise Refused(AbortCode.DEVICE_STATE)
        self._rows, self._fetched = b"", False
        names = [name for name, _ in self._mapped()]
        self._record(names, self._number(ingenia.WINDOW), self._number(ingenia.DIVIDER))

    # ---- data ----------------------------------------------------------------------------------

    def _status(self) -> int:
        available = ingenia.AVAILABLE_BIT if self._collected() else 0
        return available | (ingenia.ENABLED_BIT if self._running else 0)

    def _collected(self) -> bytes:
        """Return the bytes left, with a complete record taken over from the core first."""
        if not self._fetched and self._running and self._complete():
            mapped = self._mapped()
            rows = self._counts([name for name, _ in mapped], [cell.unit for _, cell in mapped])
            self._rows, self._fetched = rows.astype("<f4").tobytes(), True
        return self._rows

    def _block(self) -> bytes:
        block, self._rows = self._collected()[: ingenia.BLOCK_BYTES], self._rows[ingenia.BLOCK_BYTES :]
        return block.ljust(ingenia.BLOCK_BYTES, b"\0")


def _map_word(k: int) -> Address:
    index, sub, letter = ingenia.FIRST_MAP
    return index + k, sub, letter


class TraceRows(RecorderFace):
    """The trace of a Copley amplifier, objects 0x2500 to 0x2509: numbered variables, rows of 32-bit counts.

    It runs until its memory is full or it is stopped. Data read while it runs are torn: the row being written is half
    old.
    """

    def __init__(self, drive_map: DriveMap, dictionary: Dictionary, plant: Plant) -> None:
        super().__init__(dictionary, plant)
        self._known = {channel.number: (name, channel) for name, channel in drive_map.recorder.channels.items()}
        self._running = False
        self._rows = b""
        self._held = 0
        self._register(copley.DELAY, copley.PERIOD)
        self._keep(copley.PERIOD, b"\x01\0")
        self._shows(copley.COUNT, lambda: copley.CHANNELS)
        self._shows(copley.STATUS, self._status)
        self._shows(copley.REFERENCE_PERIOD_NS, lambda: self._plant.core.period_ns)
        self._shows(copley.RECORDED, self._recorded)
        self._shows(copley.LARGEST, self._largest)
        self._takes(copley.START, self._start, (0, 1))
        for k in range(copley.CHANNELS):
            self._takes(_channel(k), partial(self._choose, _channel(k)))
        self._gives(copley.DATA, self._data)
        dictionary.show(_trigger_entry())

    # ---- set-up --------------------------------------------------------------------------------

    def _choose(self, address: Address, data: bytes) -> None:
        number = int.from_bytes(data, "little")
        if self._is_running():
            raise Refused(AbortCode.DEVICE_STATE)
        if number and number not in self._known:
            raise Refused(AbortCode.VALUE)
        self._keep(address, data)

    def _chosen(self) -> list[tuple[str, Channel]]:
        numbers = [self._number(_channel(k)) for k in range(copley.CHANNELS)]
        return [self._known[number] for number in numbers if number]

    def _largest(self) -> int:
        return MEMORY_NUMBERS // max(1, len(self._chosen()))

    def _start(self, data: bytes) -> None:
        if not int.from_bytes(data, "little"):
            self._halt()
        elif not self._chosen() or not self._number(copley.PERIOD):
            raise Refused(AbortCode.NO_DATA)
        else:
            self._running, self._rows, self._held = True, b"", 0
            self._record([name for name, _ in self._chosen()], self._largest(), self._number(copley.PERIOD))
        self._keep(copley.START, data)

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
        return copley.RUNNING_BIT | _TRIGGERED_BIT if self._is_running() else 0

    def _recorded(self) -> int:
        return self._stored() if self._is_running() else self._held

    def _data(self) -> bytes:
        if not self._is_running():
            return self._rows
        torn = np.frombuffer(self._so_far(), "<i4").copy()
        torn[-len(self._chosen()) :] = 0
        return torn.tobytes()


def _channel(k: int) -> Address:
    index, sub, letter = copley.FIRST_CHANNEL
    return index, sub + k, letter


def _trigger_entry() -> Entry:
    """Return the trigger: kept, and without effect, since only "none" is what a caller can rely on."""
    entry = Entry(ObjectRow(copley.TRIGGER, 0, "", "Trigger", "DOMAIN", "rw"))

    def sink(data: bytes) -> None:
        if len(data) != len(copley.NO_TRIGGER):
            raise Refused(AbortCode.LENGTH)
        if data != copley.NO_TRIGGER:
            raise Refused(AbortCode.VALUE)
        entry.value = data

    entry.value = copley.NO_TRIGGER
    entry.sink = sink
    return entry
