"""The monitor of a simulated Novanta/Ingenia drive: its objects over the recorder of the drive behind.

Rows are REAL32 in the family's units. Reading the data register takes a block of 512 bytes out of the memory, whether
its answer arrives or not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.firmware import monitor_objects as objects
from pmsmtool.firmware.drive_map import DriveMap, SignalCell
from pmsmtool.firmware.wire_units import wire_unit
from pmsmtool.sim.node.dictionary import Dictionary, Entry, Refused
from pmsmtool.sim.node.drive_core import RecorderSetup, RecorderState
from pmsmtool.sim.node.objects import ObjectRow
from pmsmtool.sim.node.power_drive import Plant
from pmsmtool.sim.signals import Signal

MEMORY_BYTES = 8192
"""Size of the simulated monitor's memory."""
SIGNALS = {
    "omega_M_rad_s": Signal.OMEGA_E,
    "torque_nm": Signal.TAU,
    "u_q_v": Signal.U_Q,
    "u_d_v": Signal.U_D,
    "U_dc_v": Signal.U_DC,
}
"""Signals of a map, and the core's behind each; the speed is electrical there."""
_TYPES = {"H": "U16", "I": "U32"}


class Monitor:
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
        self._cells = {cell.index: (name, cell) for name, cell in drive_map.signals.items() if name in SIGNALS}
        self._plant = plant
        self._entries: dict[int, Entry] = {}
        self._rows = b""
        self._running = False
        self._fetched = True
        for entry in self._make():
            dictionary.show(entry)

    def _make(self) -> Iterator[Entry]:
        registers = [
            objects.STATUS, objects.LARGEST_BYTES, objects.BYTES_LEFT, objects.ENABLE, objects.DIVIDER,
            objects.WINDOW, objects.MAPPED, objects.ROW_BYTES, objects.REMOVE_DATA, objects.TRIGGER_KIND,
            objects.FORCE_TRIGGER, objects.LOOP_RATE_HZ,
            *((objects.FIRST_MAP[0] + k, objects.FIRST_MAP[1]) for k in range(objects.CHANNELS)),
        ]  # fmt: skip
        for index, letter in registers:
            self._entries[index] = Entry(_row(index, _TYPES[letter]), 0)
        sources: dict[objects.Address, Callable[[], int]] = {
            objects.STATUS: self._status,
            objects.LARGEST_BYTES: lambda: MEMORY_BYTES,
            objects.BYTES_LEFT: lambda: len(self._collected()),
            objects.ROW_BYTES: lambda: 4 * len(self._mapped()),
            objects.LOOP_RATE_HZ: lambda: round(1e9 / self._plant.core.period_ns),
        }
        for address, value in sources.items():
            self._hook(address[0], value)
        self._entries[objects.ENABLE[0]].sink = self._enable
        self._entries[objects.REMOVE_DATA[0]].sink = self._remove
        self._entries[objects.FORCE_TRIGGER[0]].sink = self._trigger
        for k in range(objects.CHANNELS):
            self._entries[objects.FIRST_MAP[0] + k].sink = self._map(objects.FIRST_MAP[0] + k)
        data = Entry(_row(objects.DATA, "DOMAIN", "ro"), 0)
        data.source = self._block
        yield from (*self._entries.values(), data)

    def _hook(self, index: int, value: Callable[[], int]) -> None:
        entry = self._entries[index]
        entry.source = lambda: entry.encode(value())

    def _number(self, address: objects.Address) -> int:
        return self._entries[address[0]].integer()

    # ---- set-up --------------------------------------------------------------------------------

    def _map(self, index: int) -> Callable[[bytes], None]:
        def sink(data: bytes) -> None:
            word = int.from_bytes(data, "little")
            if self._running or (word and objects.mapped_index(word) not in self._cells):
                raise Refused(AbortCode.NOT_MAPPABLE)
            self._entries[index].value = data

        return sink

    def _mapped(self) -> list[tuple[str, SignalCell]]:
        first = objects.FIRST_MAP[0]
        words = [self._entries[first + k].integer() for k in range(self._number(objects.MAPPED))]
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
        self._entries[objects.ENABLE[0]].value = data

    def _remove(self, data: bytes) -> None:
        self._plant.look()
        self._plant.core.record(None)
        self._rows = b""
        self._fetched = True

    def _trigger(self, data: bytes) -> None:
        if not self._running:
            raise Refused(AbortCode.DEVICE_STATE)
        self._plant.look()
        self._rows, self._fetched = b"", False
        self._plant.core.record(
            RecorderSetup(
                channels=[SIGNALS[name] for name, _ in self._mapped()],
                depth=self._number(objects.WINDOW),
                decimation=self._number(objects.DIVIDER),
            )
        )

    # ---- data ----------------------------------------------------------------------------------

    def _status(self) -> int:
        available = objects.AVAILABLE_BIT if self._collected() else 0
        return available | (objects.ENABLED_BIT if self._running else 0)

    def _collected(self) -> bytes:
        """Return the bytes left, with a complete record taken over from the core first."""
        self._plant.look()
        if not self._fetched and self._running and self._plant.core.recorder().state is RecorderState.COMPLETE:
            self._rows, self._fetched = self._in_units(self._plant.core.recording()), True
        return self._rows

    def _in_units(self, recording: bytes) -> bytes:
        mapped = self._mapped()
        rows = np.frombuffer(recording, "<f4").reshape(-1, len(mapped)).astype(np.float64)
        for k, (name, cell) in enumerate(mapped):
            if name == "omega_M_rad_s":
                rows[:, k] /= max(1.0, self._plant.parameter("motor.pole_pairs"))
            rows[:, k] /= wire_unit(cell.unit).scale
        return rows.astype("<f4").tobytes()

    def _block(self) -> bytes:
        block, self._rows = self._collected()[: objects.BLOCK_BYTES], self._rows[objects.BLOCK_BYTES :]
        return block.ljust(objects.BLOCK_BYTES, b"\0")


def _row(index: int, kind: str, access: str = "rw") -> ObjectRow:
    return ObjectRow(index, 0, "", "Monitor", kind, access, "0", "", "0" if kind != "DOMAIN" else "", None, None, False)
