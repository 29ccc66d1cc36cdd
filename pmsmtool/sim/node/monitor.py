# SPDX-License-Identifier: MIT
"""The monitor of a simulated Novanta/Ingenia drive: its objects over the recorder of the drive behind.

Rows are REAL32 in the family's units. Reading the data register takes a block of 512 bytes out of the memory, whether
its answer arrives or not.
"""

from __future__ import annotations

from collections.abc import Callable

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.drive_maps import ingenia_objects as objects
from pmsmtool.drive_maps.drive_map import DriveMap, SignalCell
from pmsmtool.drive_maps.recorder_map import Address
from pmsmtool.sim.node.dictionary import Dictionary, Refused
from pmsmtool.sim.node.power_drive import Plant
from pmsmtool.sim.node.recorder_face import SIGNALS, RecorderFace

MEMORY_BYTES = 8192
"""Size of the simulated monitor's memory."""


class Monitor(RecorderFace):
    """Objects 0x58B0 to 0x58F3 of one session.

    Parameters
    ----------
    drive_map : DriveMap
        The family; its signals can be mapped.
    dictionary : Dictionary
        Dressed as the family's.
    plant : Plant
        The drive behind.
    """

    def __init__(self, drive_map: DriveMap, dictionary: Dictionary, plant: Plant) -> None:
        super().__init__(dictionary, plant)
        self._cells = {cell.index: (name, cell) for name, cell in drive_map.signals.items() if name in SIGNALS}
        self._rows = b""
        self._running = False
        self._fetched = True
        self._register(objects.DIVIDER, objects.WINDOW)
        self._keeps(objects.MAPPED, range(objects.CHANNELS + 1))
        self._keeps(objects.TRIGGER_KIND, (0, objects.FORCED))  # no edge trigger here
        self._shows(objects.STATUS, self._status)
        self._shows(objects.LARGEST_BYTES, lambda: MEMORY_BYTES)
        self._shows(objects.BYTES_LEFT, lambda: len(self._collected()))
        self._shows(objects.ROW_BYTES, lambda: 4 * len(self._mapped()))
        self._shows(objects.LOOP_RATE_HZ, lambda: round(1e9 / self._plant.core.period_ns))
        self._takes(objects.ENABLE, self._enable, (0, 1))
        self._takes(objects.REMOVE_DATA, self._remove, (1,))
        self._takes(objects.FORCE_TRIGGER, self._trigger, (1,))
        for k in range(objects.CHANNELS):
            self._takes(_map_word(k), self._map(_map_word(k)))
        self._gives(objects.DATA, self._block)

    # ---- set-up --------------------------------------------------------------------------------

    def _map(self, address: Address) -> Callable[[bytes], None]:
        def sink(data: bytes) -> None:
            word = int.from_bytes(data, "little")
            if self._running or (word and objects.mapped_index(word) not in self._cells):
                raise Refused(AbortCode.NOT_MAPPABLE)
            self._keep(address, data)

        return sink

    def _mapped(self) -> list[tuple[str, SignalCell]]:
        words = [self._number(_map_word(k)) for k in range(self._number(objects.MAPPED))]
        return [self._cells[objects.mapped_index(word)] for word in words]

    def _enable(self, data: bytes) -> None:
        wanted = bool(int.from_bytes(data, "little"))
        channels = self._mapped() if wanted else []
        if wanted and not (channels and self._number(objects.DIVIDER) and self._number(objects.WINDOW)):
            raise Refused(AbortCode.NO_DATA)
        if 4 * len(channels) * self._number(objects.WINDOW) > MEMORY_BYTES:
            raise Refused(AbortCode.PDO_LENGTH)
        self._running = wanted
        self._fetched = True  # nothing before a trigger
        self._keep(objects.ENABLE, data)

    def _remove(self, data: bytes) -> None:
        self._forget()
        self._rows = b""
        self._fetched = True

    def _trigger(self, data: bytes) -> None:
        if not self._running or self._number(objects.TRIGGER_KIND) != objects.FORCED:
            raise Refused(AbortCode.DEVICE_STATE)
        self._rows, self._fetched = b"", False
        names = [name for name, _ in self._mapped()]
        self._record(names, self._number(objects.WINDOW), self._number(objects.DIVIDER))

    # ---- data ----------------------------------------------------------------------------------

    def _status(self) -> int:
        available = objects.AVAILABLE_BIT if self._collected() else 0
        return available | (objects.ENABLED_BIT if self._running else 0)

    def _collected(self) -> bytes:
        """Return the bytes left, with a complete record taken over from the core first."""
        if not self._fetched and self._running and self._complete():
            mapped = self._mapped()
            rows = self._counts([name for name, _ in mapped], [cell.unit for _, cell in mapped])
            self._rows, self._fetched = rows.astype("<f4").tobytes(), True
        return self._rows

    def _block(self) -> bytes:
        block, self._rows = self._collected()[: objects.BLOCK_BYTES], self._rows[objects.BLOCK_BYTES :]
        return block.ljust(objects.BLOCK_BYTES, b"\0")


def _map_word(k: int) -> Address:
    index, sub, letter = objects.FIRST_MAP
    return index + k, sub, letter
